"""A design that people can follow: the designer's own objective, sought among drives made of few phases.

What is sought is a trace of speed and steering, straight between knots that are some seconds apart, and what counts is
what the machine does in a person's hands (`driver`), not what torques could do. The design for torques, smoothed into
phases as `drive` does, and random phases are where it starts. Knots and levels are then improved by sequential
quadratic programs: differences of the driven motion tell how the information matrix and every limit change, the
objective's slope and convex curvature by that matrix are exact (`aim.local`), and a step counts only where the driven
motion says so. In the end times are rounded to half seconds and levels to what a dial shows, and people with their slow
errors drive it: limits that they come near are given more room, those that they break all the same are named.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import joblib
import numpy as np

from excite import trajectories
from excite.errors import SimulationError, UndrivableError
from excite.model import Model
from excite.model.machine import Problem
from excite.operator import ground
from excite.operator.ground import ANGLE_STEP, GRID, SPEED_STEP, Score, Trace
from excite.simulation import STEADY_DRIVER, Motion, track_motion
from excite.trajectories import Aim, Design, Manoeuvre, processes

PEOPLE = 3  # who drive it in the end, in simulation
EASY = 1.3  # times the shortest phase: how long phases are on average, at least
GUESSES = 16  # random drives beside the smoothed design
PHASES = 4  # stream of random numbers
ROUNDS, LEVELS, POLISHES = 8, 3, 2  # passes over knots and levels, over levels alone, by single steps of the dial
SHARP = (20.0, 200.0)  # of the objective, first and last round
FIXED = (0, -2, -1)  # knots whose levels are zero: the start, and the last phase
THIN = 5  # samples of which one counts in the search
WINDOWS = 12  # of the drive: every limit's extreme in each of them is a constraint
STEPS, SIZES = (0.02, 0.01, 0.005), (1.0, 0.2, 0.1)  # differences, and what a round changes at first: s, m/s, rad
PRICE = 30.0  # of a limit's excess, a fraction of its range, against the objective
ROOM = 0.01  # of a limit's range that is kept free at least
FINE = 0.1  # what an excess over a tolerance for rest counts against one over a limit's range
DRIVEN = ("torque", "torque_rate")  # limits that hidden valves keep, whoever drives

Report = Callable[[int, int, float], None]


@dataclass(frozen=True)
class Phased:
    """A drive for people and what it is worth, lower is better.

    trace: its phases, the last one stands still. motion: with a steady person; people: with PEOPLE who err. scores and
    attained, in this order: the designed torques played back, people on the phases that `drive` makes of these, people
    on this trace (the middle one of PEOPLE). over: limits that anybody exceeds, with the excess.
    """

    trace: Trace
    motion: Motion
    people: tuple[Motion, ...]
    scores: tuple[float, float, float]
    attained: tuple[Score, Score, Score]
    over: dict[str, float]
    complete: bool


def phased(
    model: Model,
    problem: Problem,
    aim: Aim,
    designed: Motion,
    shortest: float = 3.0,
    seed: int = 0,
    stop: Callable[[], bool] = lambda: False,
    progress: Report | None = None,
) -> Phased:
    """The best drive for people that is found from a design for torques; phases of `shortest` [s] or more.

    stop() ends the search early. The same seed gives the same drive where it doesn't. Raises DriveError for a machine
    that nobody steers or a shortest phase that does not fit, and SimulationError where nobody can drive any of it.
    """
    check(model, problem, shortest)
    duration = float(designed.t[-1])
    shortest = float(np.ceil(shortest / GRID - 1e-9) * GRID)
    task = Task(model, problem, aim, duration, shortest, *ground.bounds(model))
    begin = standing(task, designed)
    total = ROUNDS + LEVELS + POLISHES + 1
    with joblib.parallel_config("loky", inner_max_num_threads=1):
        run = joblib.Parallel(n_jobs=processes())
        found = [t for t in trials(task, [begin, *guesses(task, begin, seed)], run) if t is not None]
        if not found:
            raise SimulationError("no drive made of phases can be followed on this machine; make phases longer")
        # surrogates of variances count what the bound says of a drive like those that are sought
        worth = trajectories.optimism(aim, model, _driven(task, found[0].trace))
        if worth is not None:
            task = replace(task, aim=trajectories.calibrated(aim, worth))
        room = _room(task, found[0].trace, seed)
        best = min(found, key=lambda t: merit(task, t, room))
        reach, whole = 1.0, True
        for k in range(ROUNDS + LEVELS + POLISHES):
            if progress is not None:
                progress(k + 1, total, merit(task, best, room))
            if stop():
                whole = False
                break
            if k == ROUNDS:
                best, reach = _only(task, on_grid(task, best.trace), run), 0.5
                room = np.maximum(room, _room(task, best.trace, seed))
            if k == ROUNDS + LEVELS:
                best = _only(task, readable(task, best.trace), run)
            if k >= ROUNDS + LEVELS:
                room = np.maximum(room, _room(task, best.trace, seed))
                best = polished(task, best, room, run)
            else:
                sharp = SHARP[0] * (SHARP[1] / SHARP[0]) ** (min(k, ROUNDS - 1) / (ROUNDS - 1))
                best, reach = improved(task, best, room, reach, sharp, k < ROUNDS, run)
    trace = ground.merged(readable(task, on_grid(task, best.trace)))
    if progress is not None:
        progress(total, total, merit(task, best, room))
    return _judged(replace(task, aim=aim), trace, begin, designed, seed, whole)


def check(model: Model, problem: Problem, shortest: float) -> None:
    """Raises DriveError where nobody can be asked to drive phases of `shortest` [s] or more."""
    ground.levers(model)
    top = float(problem.duration_s) / 4
    if not GRID <= shortest <= top:
        raise UndrivableError(
            f"shortest phase (--phase-min): must be between {GRID:g} and {top:g} s (got {shortest:g})"
        )


def as_design(model: Model, problem: Problem, free: Design, made: Phased) -> Design:
    """The drive that a steady person makes of the phases, as a design; `free` is the one for torques it began with."""
    over = trajectories.check_limits(model, problem, made.motion)
    return replace(
        free,
        manoeuvre=Manoeuvre(made.motion.t, made.motion.u),
        motion=made.motion,
        cond_phi=trajectories.cond_phi(model, made.motion),
        cond_w=trajectories.cond_w(model, made.motion),
        violations=over,
        max_violation=max(over.values(), default=0.0),
        complete=free.complete and made.complete,
    )


def _judged(task: Task, trace: Trace, begin: Trace, designed: Motion, seed: int, whole: bool) -> Phased:
    """The drive by a steady person and by people, all from one start, and what each way of driving is worth."""
    model, aim = task.model, task.aim
    ways = (_driven(task, trace), *(ground.driven(model, trace, None, seed + k) for k in range(PEOPLE)))
    motions = ground.placed(model, task.problem, ways)
    over: dict[str, float] = {}
    for m in motions:
        for name, value in trajectories.check_limits(model, task.problem, m).items():
            if value > trajectories.TOLERANCE:
                over[name] = max(over.get(name, 0.0), value)

    def worth(motion: Motion, by: Callable[[Model], Motion]) -> float:
        return trajectories.judge(aim, [(model, motion), *((m, by(m)) for m in aim.machines[1:])]).score

    def people(way: Trace, driven: Sequence[Motion]) -> tuple[float, Score]:
        every = [ground.score(model, m) for m in driven]
        k = every.index(ground.middle(every))
        return worth(driven[k], lambda m: ground.driven(m, way, None, seed + k)), every[k]

    before = people(begin, [ground.driven(model, begin, None, seed + k) for k in range(PEOPLE)])
    after = people(trace, motions[1:])
    played = worth(designed, lambda m: track_motion(m, model, designed)), ground.score(model, designed)
    scores, attained = (played[0], before[0], after[0]), (played[1], before[1], after[1])
    return Phased(trace, motions[0], motions[1:], scores, attained, over, whole)


# ------------------------------------------------------------------------------------------------ traces


@dataclass(frozen=True, eq=False)
class Task:
    """What is sought: a trace of `duration` [s], phases of `shortest` [s] or more, within `fastest` [m/s], and of each
    steered joint `widest` (n,) [rad] and `swing` (n,) [rad/s]."""

    model: Model
    problem: Problem
    aim: Aim
    duration: float
    shortest: float
    fastest: float
    widest: np.ndarray
    swing: np.ndarray

    @property
    def most(self) -> int:
        """Phases before the last one, which stands still."""
        return max(2, int((self.duration - self.shortest) / (EASY * self.shortest)))


def standing(task: Task, motion: Motion) -> Trace:
    """A motion as phases, a little faster, so that the last one can stand still: what the driver is late ends there."""
    share = 1 - task.shortest / task.duration
    trace = ground.phases(task.model, replace(motion, t=motion.t * share), task.shortest, task.most)
    times, speed = np.append(trace.times, task.duration), np.append(trace.speed, 0)
    angle = np.concatenate([trace.angle, np.zeros((1, len(trace.levers)))])
    return on_grid(task, replace(trace, times=times, speed=speed, angle=angle))


def guesses(task: Task, like: Trace, seed: int) -> list[Trace]:
    """Random traces of as many phases as may be: levels anywhere within the machine, every one its own length."""
    fast = task.fastest if np.isfinite(task.fastest) else 2.0
    wide = np.where(np.isfinite(task.widest), task.widest, 0.5)
    found = []
    for k in range(GUESSES):
        rng = np.random.default_rng([seed, PHASES, k])
        spare = task.duration - (task.most + 1) * task.shortest
        cuts = np.sort(rng.uniform(0, spare, task.most))
        times = np.concatenate([[0], cuts + task.shortest * np.arange(1, task.most + 1), [task.duration]])
        levels = rng.uniform(-1, 1, (1 + len(wide), len(times)))
        levels[:, FIXED] = 0.0
        found.append(on_grid(task, Trace(times, fast * levels[0], wide * levels[1:].T, like.levers)))
    return found


def on_grid(task: Task, trace: Trace) -> Trace:
    """The trace with its knots on the grid of half seconds, phases long enough, steering slow enough."""
    t = np.round(trace.times / GRID) * GRID
    for k in range(1, len(t)):
        t[k] = max(t[k], t[k - 1] + task.shortest)
    t[-1] = task.duration
    for k in range(len(t) - 2, 0, -1):
        t[k] = min(t[k], t[k + 1] - task.shortest)
    return replace(trace, times=t, angle=ground.slowed(t, trace.angle, task.swing, FIXED))


def readable(task: Task, trace: Trace) -> Trace:
    """The trace with levels as a dial shows them."""
    v = np.clip(np.round(trace.speed / SPEED_STEP) * SPEED_STEP, -task.fastest, task.fastest)
    a = np.clip(np.round(trace.angle / ANGLE_STEP) * ANGLE_STEP, -task.widest, task.widest)
    return replace(trace, speed=v + 0.0, angle=ground.slowed(trace.times, a, task.swing, FIXED) + 0.0)


def _vector(trace: Trace) -> np.ndarray:
    """What may change: times of the knots, speeds, angles joint by joint, of those that move."""
    return np.concatenate([trace.times[1:-1], trace.speed[1:-2], trace.angle[1:-2].T.ravel()])


def _trace(like: Trace, x: np.ndarray) -> Trace:
    k = len(like.times) - 2
    times, speed, angle = like.times.copy(), like.speed.copy(), like.angle.copy()
    times[1:-1], speed[1:-2] = x[:k], x[k : 2 * k - 1]
    angle[1:-2] = x[2 * k - 1 :].reshape(angle.shape[1], k - 1).T
    return replace(like, times=times, speed=speed, angle=angle)


def _each(trace: Trace, by: Sequence[float]) -> np.ndarray:
    """One number for times, one for speeds, one for angles, for every entry of the vector."""
    k = len(trace.times) - 2
    return np.repeat(by, [k, k - 1, (k - 1) * len(trace.levers)])


def _kept(task: Task, like: Trace) -> tuple[np.ndarray, np.ndarray]:
    """C, d of C x <= d: phases long enough, levels within the machine, steering slow enough."""
    n = len(_vector(like))
    zero = _trace(like, np.zeros(n))
    unit = [_trace(like, row) for row in np.eye(n)]

    def rows(of: Callable[[Trace], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        base = of(zero)
        return np.column_stack([of(u) - base for u in unit]), base

    def within(t: Trace) -> np.ndarray:
        length = np.diff(t.times)
        parts = [task.shortest - length, t.speed - task.fastest, -t.speed - task.fastest]
        turn, most = np.diff(t.angle, axis=0), np.outer(length, task.swing)
        parts += [t.angle - task.widest, -t.angle - task.widest, turn - most, -turn - most]
        return np.concatenate([p[np.isfinite(p)] for p in parts])

    C, base = rows(within)
    return C, -base


# ------------------------------------------------------------------------------------------------ what a trace is worth


@dataclass(frozen=True)
class Trial:
    """A trace, its information matrices, and every limit's extremes (n_limits, WINDOWS), negative where kept."""

    trace: Trace
    A: list[np.ndarray]
    over: np.ndarray


def trials(task: Task, traces: Sequence[Trace], run: joblib.Parallel) -> list[Trial | None]:
    """What a steady person makes of each trace, side by side; None where the motion can't be integrated."""
    blob, call = pickle.dumps(task), joblib.delayed(_tried)
    shares = [list(traces[k :: run.n_jobs]) for k in range(run.n_jobs)]
    found: list[Trial | None] = [None] * len(traces)
    for k, results in enumerate(run(call(blob, share) for share in shares if share)):
        for i, result in enumerate(results):
            at = k + i * run.n_jobs
            found[at] = None if result is None else Trial(traces[at], *result)
    return found


def _tried(blob: bytes, traces: Sequence[Trace]) -> list[tuple[list[np.ndarray], np.ndarray] | None]:
    task = _revived(blob)
    results: list[tuple[list[np.ndarray], np.ndarray] | None] = []
    for trace in traces:
        try:
            motion = _driven(task, trace)
        except SimulationError:
            results.append(None)
            continue
        results.append((_information(task, motion), _over(task, _placed(task, [motion])[0])))
    return results


@lru_cache(maxsize=1)
def _revived(blob: bytes) -> Task:
    """In a worker: the same object for the same bytes, so that what depends on the model is made once."""
    task = pickle.loads(blob)
    assert isinstance(task, Task)
    return task


def _driven(task: Task, trace: Trace) -> Motion:
    return ground.driven(task.model, trace, STEADY_DRIVER, 0)


def _placed(task: Task, motions: Sequence[Motion]) -> list[Motion]:
    """The drives, all from where the first lies best in the lane, even where it keeps the lane: what is free counts."""
    start = trajectories.placed(task.model, task.problem, motions[0])
    return [ground.moved(task.model, m, start) for m in motions]


def _information(task: Task, motion: Motion) -> list[np.ndarray]:
    names = ("t", "q", "nu", "a", "u", "wheels", "memory")
    thin = replace(motion, **{n: getattr(motion, n)[::THIN] for n in names})
    return [THIN * A for A in trajectories.information(task.aim, task.model, thin)]


@lru_cache(maxsize=2)
def _limits(task: Task) -> tuple[ca.Function, np.ndarray, np.ndarray, np.ndarray]:
    """Every limit that driving can break, stacked: values of (q, nu, u, du), low, high, range."""
    every = [g for g in trajectories.machine_limits(task.model, task.problem) if g.kind not in DRIVEN]
    low, high, size = np.array([(g.low, g.high, g.range) for g in every]).reshape(-1, 3).T
    return trajectories.stacked(task.model, every), low, high, size


def _over(task: Task, motion: Motion) -> np.ndarray:
    within, low, high, size = _limits(task)
    values = within(motion.q.T, motion.nu.T, motion.u.T, 0).full()
    above = np.maximum(values - high[:, None], low[:, None] - values) / size[:, None]
    found = np.column_stack([part.max(axis=1) for part in np.array_split(above, WINDOWS, axis=1)])
    if task.problem.rest:
        centred = list(trajectories.resting(task.model))
        moving = np.abs(motion.nu[-1]) / trajectories.rest_tolerances(task.model) - 1
        away = np.abs(motion.q[-1, centred]) / trajectories.REST_POSITION - 1
        still = FINE * np.concatenate([moving, away])
        found = np.vstack([found, np.repeat(still[:, None], WINDOWS, axis=1)])
    if task.problem.reversals is None:
        return found
    turns = trajectories.WHOLE[trajectories.REVERSALS](task.model, task.problem, motion).get(
        trajectories.REVERSALS, 0.0
    )
    return np.vstack([found, np.full(WINDOWS, turns if turns > 0 else -1.0)])


def _room(task: Task, trace: Trace, seed: int) -> np.ndarray:
    """(n_limits,) what people come nearer to every limit than the steady person does, ROOM at least."""
    ways = [_driven(task, trace), *(ground.driven(task.model, trace, None, seed + k) for k in range(PEOPLE))]
    every = np.array([_over(task, m).max(axis=1) for m in _placed(task, ways)])
    return np.maximum(every[1:].max(axis=0) - every[0], ROOM)


def merit(task: Task, trial: Trial, room: np.ndarray) -> float:
    """The aim's score, and a price for every limit that is not kept with its room."""
    excess = np.maximum(trial.over.max(axis=1) + room, 0)
    return trajectories.value(task.aim, trial.A) + PRICE * float(excess.sum())


def _only(task: Task, trace: Trace, run: joblib.Parallel) -> Trial:
    found = trials(task, [trace], run)[0]
    if found is None:
        raise SimulationError("the drive in phases can't be followed once its times are round; make phases longer")
    return found


# ------------------------------------------------------------------------------------------------ improvement


def improved(
    task: Task, best: Trial, room: np.ndarray, reach: float, sharp: float, times: bool, run: joblib.Parallel
) -> tuple[Trial, float]:
    """One sequential quadratic program's step from the best, and how far the next may go; `times`: knots move too."""
    import cvxpy as cp  # takes as long to load as all the rest, and few who load this module get here

    x, step = _vector(best.trace), _each(best.trace, STEPS)
    free = np.arange(0 if times else len(best.trace.times) - 2, len(x))
    near = trials(
        task, [_trace(best.trace, x + step[k] * row) for k, row in enumerate(np.eye(len(x))) if k in free], run
    )
    rows, columns = np.triu_indices(len(task.aim.scale))
    local = trajectories.local(task.aim, best.A, rows, columns, sharp)
    dA, dg = np.zeros((len(local.slope), len(free))), np.zeros((best.over.size, len(free)))
    for i, (k, trial) in enumerate(zip(free, near, strict=True)):
        if trial is not None:
            change = [(B - A)[rows, columns] for A, B in zip(best.A, trial.A, strict=True)]
            dA[:, i] = np.concatenate(change) / step[k]
            dg[:, i] = (trial.over - best.over).ravel() / step[k]
    C, d = _kept(task, best.trace)
    size = _each(best.trace, SIZES)[free]
    slack, by = cp.Variable(len(best.over), nonneg=True), cp.Variable(len(free))
    spread = np.repeat(np.eye(len(best.over)), WINDOWS, axis=0)
    model = (local.slope @ dA * size) @ by + 0.5 * cp.sum_squares((local.factor.T @ dA * size) @ by)
    reached = cp.Parameter(nonneg=True)
    program = cp.Problem(
        cp.Minimize(model + PRICE * cp.sum(slack)),
        [
            best.over.ravel() + np.repeat(room, WINDOWS) + (dg * size) @ by <= spread @ slack,
            (C[:, free] * size) @ by <= np.maximum(d - C @ x, 0),
            cp.abs(by) <= reached,
        ],
    )
    steps = []
    for share in (1.0, 0.5, 0.2, 0.05):
        reached.value = reach * share
        try:
            program.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            continue
        if by.value is not None and np.isfinite(by.value).all():
            moved = x.copy()
            moved[free] += size * by.value
            steps.append((share, _trace(best.trace, moved)))
    before = merit(task, best, room)
    tried = zip(steps, trials(task, [t for _, t in steps], run), strict=True)
    found = [(merit(task, t, room), share, t) for (share, _), t in tried if t is not None]
    if not found:
        return best, reach / 10
    least, share, trial = min(found, key=lambda f: f[0])
    if not least < before:
        return best, reach / 10
    return trial, min(1.5 * reach * share if share == 1.0 else reach * share, 2.0)


def polished(task: Task, best: Trial, room: np.ndarray, run: joblib.Parallel) -> Trial:
    """The best of all single steps on the grid and the dial, and of the most useful of them together."""
    x, step = _vector(best.trace), _each(best.trace, (GRID, SPEED_STEP, ANGLE_STEP))
    C, d = _kept(task, best.trace)
    moves = [sign * step[k] * row for k, row in enumerate(np.eye(len(x))) for sign in (1, -1)]
    moves = [m for m in moves if (C @ (x + m) <= d + 1e-9).all()]
    before = merit(task, best, room)
    each = trials(task, [_trace(best.trace, x + m) for m in moves], run)
    ranked = sorted((merit(task, t, room), i) for i, t in enumerate(each) if t is not None)
    useful = [moves[i] for score, i in ranked if score < before]
    sums: list[np.ndarray] = []
    for m in useful:
        total = m + (sums[-1] if sums else 0)
        if (C @ (x + total) <= d + 1e-9).all() and (np.abs(total) <= step + 1e-9).all():
            sums.append(total)
    together = trials(task, [_trace(best.trace, x + m) for m in sums], run)
    return min((best, *(t for t in (*each, *together) if t is not None)), key=lambda t: merit(task, t, room))
