"""Design a drive that people can follow: minimise the objective over traces of few phases.

A trace of speed and steering is linear between knots some seconds apart, and is judged by the motion of a simulated
driver. The search starts from the design for torques, smoothed into phases, and from random phases. Sequential
quadratic programs improve knots and levels: finite differences of the driven motion give the change of the information
matrix and of every limit, the objective's slope and convex curvature by that matrix are exact, and a step counts only
if the driven motion confirms it. Differences and single steps are of motions simulated at a lower rate. Finally times
are rounded to half seconds and levels to dial steps, and simulated people with slow errors drive the trace: limits that
they come near get a margin, limits that they still exceed are reported.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import joblib
import numpy as np

from excite import trajectories
from excite.errors import SimulationError, UndrivableError
from excite.model import Model
from excite.model.machine import Problem
from excite.operator import ground
from excite.operator.ground import ANGLE_STEP, GRID_S, PEOPLE, SPEED_STEP, DriveQuality, TouchedGround, Trace
from excite.simulation import STEADY_DRIVER, Motion, track_motion
from excite.trajectories import CompositeObjective, Design, Limit, Manoeuvre, process_count

MEAN_PHASE_RATIO = 1.3  # least mean length of a phase over the shortest one; chosen
N_RANDOM = 16  # random traces beside the smoothed design; chosen
RANDOM_STREAM = 4  # stream of random numbers of these traces
ROUNDS = 8  # passes over knots and levels; chosen
LEVELS = 3  # passes over levels alone; chosen
POLISHES = 2  # passes by single steps of the dial; chosen
SHARPNESS = (20.0, 200.0)  # of the smoothed objective in the first and last round; chosen
ZERO_KNOTS = (0, -2, -1)  # knots with zero levels: the start and the last phase, which stands still
THINNING = 5  # one of so many samples counts in the search; chosen
TRIAL_HZ = 50.0  # least rate of the motions whose differences are taken; chosen
CONFIRMED = 4  # sums of single steps that are simulated at the machine's rate; chosen
WINDOWS = 12  # parts of the drive: the extreme of each limit in each part is a constraint; chosen
DIFFERENCE_STEPS = (0.02, 0.01, 0.005)  # of finite differences: [s], [m/s], [rad]; chosen
STEP_SIZES = (1.0, 0.2, 0.1)  # largest changes in the first round: [s], [m/s], [rad]; chosen
EXCESS_PRICE = 30.0  # of a limit's excess (share of its range), in units of the objective; chosen
MIN_MARGIN = 0.01  # least margin of a limit, as a share of its range; chosen
REST_WEIGHT = 0.1  # weight of an excess over a tolerance for rest; chosen
START_AMPLITUDES = (1.0, 0.85, 0.7)  # of the smoothed design's speeds and angles, that the search tries; chosen
SAFE_AMPLITUDES = (1.0, 0.95, 0.9, 0.8)  # of the result's, to try until people keep every limit; chosen
VALVE_LIMITS = ("torque", "torque_rate")  # limits that the machine's valves keep, whoever drives


@dataclass(frozen=True)
class PhasedDrive:
    """A drive for people with its scores, lower is better.

    trace: phases, the last one stands still.
    motion: driven by a steady person; people: driven by PEOPLE with slow errors.
    scores, attained: of the designed torques played back, of people on the smoothed design, of people on this trace
    (the median of PEOPLE).
    over: limits that anybody exceeds, with the excess.
    room: the ground that the contacts touch when any of them drives. lane: length and width [m].
    """

    trace: Trace
    motion: Motion
    people: tuple[Motion, ...]
    scores: tuple[float, float, float]
    attained: tuple[DriveQuality, DriveQuality, DriveQuality]
    over: dict[str, float]
    room: TouchedGround
    lane: tuple[float, float]
    complete: bool


def design_phases(
    model: Model,
    problem: Problem,
    aim: CompositeObjective,
    designed: Motion,
    shortest: float = 3.0,
    seed: int = 0,
    stop: Callable[[], bool] = lambda: False,
    progress: trajectories.Report | None = None,
) -> PhasedDrive:
    """Design phases for people from a design for torques.

    shortest [s]: shortest phase. stop: returns True to end the search early. Without an early end, the same seed gives
    the same drive. Raises UndrivableError for a machine that nobody drives or a shortest phase out of range,
    SimulationError if no trace can be followed.
    """
    check_phase_length(model, problem, shortest)
    duration = float(designed.t[-1])
    shortest = float(np.ceil(shortest / GRID_S - 1e-9) * GRID_S)
    search = PhaseSearch(model, problem, aim, duration, shortest, *ground.trace_bounds(model))
    begin = initial_trace(search, designed)
    total = ROUNDS + LEVELS + POLISHES + 1
    with joblib.parallel_config("loky", inner_max_num_threads=1):
        run = joblib.Parallel(n_jobs=process_count())
        scaled = [scale_levels(search, begin, share) for share in START_AMPLITUDES]
        found = [t for t in try_traces(search, [*scaled, *random_traces(search, begin, seed)], run) if t is not None]
        if not found:
            raise SimulationError("no drive made of phases can be followed on this machine; make phases longer")
        # Calibrate the surrogate of the variances by the Cramer-Rao bound of a typical drive.
        worth = trajectories.surrogate_ratio(aim, model, _drive_steadily(search, found[0].trace))
        if worth is not None:
            search = replace(search, aim=trajectories.calibrate_surrogates(aim, worth))
        room = _required_margin(search, found[0].trace, seed)
        best = min(found, key=lambda t: merit(search, t, room))
        reach, whole = 1.0, True
        for k in range(ROUNDS + LEVELS + POLISHES):
            if progress is not None:
                doing = f"phases for people, round {k + 1} of {total - 1}"
                progress(k + 1, total, trajectories.BestSoFar(np.inf, doing))
            if stop():
                whole = False
                break
            if k == ROUNDS:
                best, reach = _try_trace(search, snap_times(search, best.trace), run), 0.5
                room = np.maximum(room, _required_margin(search, best.trace, seed))
            if k == ROUNDS + LEVELS:
                best = _try_trace(search, snap_levels(search, best.trace), run)
            if k >= ROUNDS + LEVELS:
                room = np.maximum(room, _required_margin(search, best.trace, seed))
                best = improve_by_steps(search, best, room, run)
            else:
                sharp = SHARPNESS[0] * (SHARPNESS[1] / SHARPNESS[0]) ** (min(k, ROUNDS - 1) / (ROUNDS - 1))
                best, reach = improve_by_program(search, best, room, reach, sharp, k < ROUNDS, run)
    way = reduce_levels(search, snap_times(search, best.trace), seed)
    return _rate_way(replace(search, aim=aim), way, begin, designed, seed, whole)


def check_phase_length(model: Model, problem: Problem, shortest: float) -> None:
    """Raise UndrivableError for a machine that nobody drives, or a shortest phase [s] that does not fit."""
    ground.find_levers(model)
    top = float(problem.duration_s) / 4
    if not GRID_S <= shortest <= top:
        raise UndrivableError(
            f"shortest phase (--phase-min): must be between {GRID_S:g} and {top:g} s (got {shortest:g})"
        )


def as_design(model: Model, problem: Problem, free: Design, made: PhasedDrive) -> Design:
    """Return the motion of a steady person on the phases as a design. free: the design for torques it began with."""
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


@dataclass(frozen=True)
class DrivenWay:
    """A trace with its motions in the lane, a steady person's first, and the limits that any of them exceeds."""

    trace: Trace
    motions: tuple[Motion, ...]
    over: dict[str, float]


def drive_way(search: PhaseSearch, trace: Trace, seed: int) -> DrivenWay:
    """Simulate a steady person and people with errors from one start; name the limits that they exceed."""
    model = search.model
    ways = (_drive_steadily(search, trace), *(ground.follow_trace(model, trace, None, seed + k) for k in range(PEOPLE)))
    motions = ground.place_in_lane(model, search.problem, ways)
    over: dict[str, float] = {}
    for m in motions:
        for name, value in trajectories.check_limits(model, search.problem, m).items():
            if value > trajectories.TOLERANCE:
                over[name] = max(over.get(name, 0.0), value)
    return DrivenWay(trace, motions, over)


def reduce_levels(search: PhaseSearch, trace: Trace, seed: int) -> DrivenWay:
    """Reduce speeds and angles until people keep every limit, then merge straight phases.

    Return the way with the least excess if none keeps them.
    """
    ways: list[DrivenWay] = []
    for share in SAFE_AMPLITUDES:
        merged = ground.merge_straight_phases(scale_levels(search, trace, share))
        try:
            ways.append(drive_way(search, merged, seed))
        except SimulationError:
            if share == SAFE_AMPLITUDES[0]:
                raise
            continue
        if not ways[-1].over:
            break
    return min(ways, key=lambda way: max(way.over.values(), default=0.0))


def _rate_way(
    search: PhaseSearch, way: DrivenWay, begin: Trace, designed: Motion, seed: int, whole: bool
) -> PhasedDrive:
    """Score each way of driving."""
    model, aim, trace, motions = search.model, search.aim, way.trace, way.motions

    def worth(motion: Motion, by: Callable[[Model], Motion]) -> float:
        return trajectories.score_motions(aim, [(model, motion), *((m, by(m)) for m in aim.machines[1:])]).score

    def people(way: Trace, driven: Sequence[Motion]) -> tuple[float, DriveQuality]:
        every = [ground.rate_motion(model, m) for m in driven]
        k = every.index(ground.middle_quality(every))
        return worth(driven[k], lambda m: ground.follow_trace(m, way, None, seed + k)), every[k]

    before = people(begin, [ground.follow_trace(model, begin, None, seed + k) for k in range(PEOPLE)])
    after = people(trace, motions[1:])
    played = worth(designed, lambda m: track_motion(m, model, designed)), ground.rate_motion(model, designed)
    scores, attained = (played[0], before[0], after[0]), (played[1], before[1], after[1])
    room = ground.touched_ground(model, motions)
    return PhasedDrive(trace, motions[0], motions[1:], scores, attained, way.over, room, search.problem.lane, whole)


# ------------------------------------------------------------------------------------------------ traces


@dataclass(frozen=True, eq=False)
class PhaseSearch:
    """The search for a trace: model, problem, objective and bounds.

    duration [s]: of the trace. shortest [s]: shortest phase. fastest [m/s]: largest speed.
    widest (n,) [rad], swing (n,) [rad/s]: largest angle and rate of each steered joint.
    stride: samples of the machine in one of the search's.
    """

    model: Model
    problem: Problem
    aim: CompositeObjective
    duration: float
    shortest: float
    fastest: float
    widest: np.ndarray
    swing: np.ndarray
    stride: int = 1

    @cached_property
    def coarser(self) -> PhaseSearch:
        """This search with motions sampled at TRIAL_HZ or a little more, or at the machine's rate if that is lower."""
        hz = self.model.machine.sampling_hz
        stride = max(1, int(float(hz) / TRIAL_HZ))
        lower = hz.model_copy(update={"value": float(hz) / stride})
        machine = self.model.machine.model_copy(update={"sampling_hz": lower})
        return replace(self, model=replace(self.model, machine=machine), stride=stride)

    @property
    def most(self) -> int:
        """Largest number of phases before the last one, which stands still."""
        return max(2, int((self.duration - self.shortest) / (MEAN_PHASE_RATIO * self.shortest)))


def initial_trace(search: PhaseSearch, motion: Motion) -> Trace:
    """Smooth a motion, sped up a little, into phases, and append one that stands still, where a late driver ends."""
    share = 1 - search.shortest / search.duration
    trace = ground.trace_from_motion(search.model, replace(motion, t=motion.t * share), search.shortest, search.most)
    times, speed = np.append(trace.times, search.duration), np.append(trace.speed, 0)
    angle = np.concatenate([trace.angle, np.zeros((1, len(trace.levers)))])
    return snap_times(search, replace(trace, times=times, speed=speed, angle=angle))


def random_traces(search: PhaseSearch, like: Trace, seed: int) -> list[Trace]:
    """Draw traces with the largest number of phases, random lengths, and random levels within the machine's limits."""
    fast = search.fastest if np.isfinite(search.fastest) else 2.0
    wide = np.where(np.isfinite(search.widest), search.widest, 0.5)
    found = []
    for k in range(N_RANDOM):
        rng = np.random.default_rng([seed, RANDOM_STREAM, k])
        spare = search.duration - (search.most + 1) * search.shortest
        cuts = np.sort(rng.uniform(0, spare, search.most))
        times = np.concatenate([[0], cuts + search.shortest * np.arange(1, search.most + 1), [search.duration]])
        levels = rng.uniform(-1, 1, (1 + len(wide), len(times)))
        levels[:, ZERO_KNOTS] = 0.0
        found.append(snap_times(search, Trace(times, fast * levels[0], wide * levels[1:].T, like.levers)))
    return found


def snap_times(search: PhaseSearch, trace: Trace) -> Trace:
    """Round the knots to half seconds and keep the shortest phase and the steering rate."""
    t = np.round(trace.times / GRID_S) * GRID_S
    for k in range(1, len(t)):
        t[k] = max(t[k], t[k - 1] + search.shortest)
    t[-1] = search.duration
    for k in range(len(t) - 2, 0, -1):
        t[k] = min(t[k], t[k + 1] - search.shortest)
    return replace(trace, times=t, angle=ground.limit_steering_rate(t, trace.angle, search.swing, ZERO_KNOTS))


def snap_levels(search: PhaseSearch, trace: Trace) -> Trace:
    """Round the levels to dial steps."""
    v = np.clip(np.round(trace.speed / SPEED_STEP) * SPEED_STEP, -search.fastest, search.fastest)
    a = np.clip(np.round(trace.angle / ANGLE_STEP) * ANGLE_STEP, -search.widest, search.widest)
    return replace(
        trace, speed=v + 0.0, angle=ground.limit_steering_rate(trace.times, a, search.swing, ZERO_KNOTS) + 0.0
    )


def scale_levels(search: PhaseSearch, trace: Trace, share: float) -> Trace:
    """Reduce all speeds and angles to a share, and round them to dial steps."""
    return snap_levels(search, replace(trace, speed=share * trace.speed, angle=share * trace.angle))


def _vector(trace: Trace) -> np.ndarray:
    """Return the free values of a trace: times of knots, speeds, angles joint by joint."""
    return np.concatenate([trace.times[1:-1], trace.speed[1:-2], trace.angle[1:-2].T.ravel()])


def _trace(like: Trace, x: np.ndarray) -> Trace:
    k = len(like.times) - 2
    times, speed, angle = like.times.copy(), like.speed.copy(), like.angle.copy()
    times[1:-1], speed[1:-2] = x[:k], x[k : 2 * k - 1]
    angle[1:-2] = x[2 * k - 1 :].reshape(angle.shape[1], k - 1).T
    return replace(like, times=times, speed=speed, angle=angle)


def _per_entry(trace: Trace, by: Sequence[float]) -> np.ndarray:
    """Expand one number each for times, speeds and angles to the entries of the vector."""
    k = len(trace.times) - 2
    return np.repeat(by, [k, k - 1, (k - 1) * len(trace.levers)])


def _linear_constraints(search: PhaseSearch, like: Trace) -> tuple[np.ndarray, np.ndarray]:
    """Return C, d of C x <= d: shortest phase, largest levels, largest steering rate."""
    n = len(_vector(like))
    zero = _trace(like, np.zeros(n))
    unit = [_trace(like, row) for row in np.eye(n)]

    def rows(of: Callable[[Trace], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        base = of(zero)
        return np.column_stack([of(u) - base for u in unit]), base

    def within(t: Trace) -> np.ndarray:
        length = np.diff(t.times)
        parts = [search.shortest - length, t.speed - search.fastest, -t.speed - search.fastest]
        turn, most = np.diff(t.angle, axis=0), np.outer(length, search.swing)
        parts += [t.angle - search.widest, -t.angle - search.widest, turn - most, -turn - most]
        return np.concatenate([p[np.isfinite(p)] for p in parts])

    C, base = rows(within)
    return C, -base


# ------------------------------------------------------------------------------------------------ what a trace is worth


@dataclass(frozen=True)
class TraceTrial:
    """A trace with its information matrices and the extremes (n_limits, WINDOWS) of every limit, negative if kept."""

    trace: Trace
    A: list[np.ndarray]
    over: np.ndarray


def try_traces(
    search: PhaseSearch, traces: Sequence[Trace], run: joblib.Parallel, coarse: bool = False
) -> list[TraceTrial | None]:
    """Simulate a steady person on each trace, in parallel; None for a motion that can't be integrated.

    coarse: at the lower rate of `PhaseSearch.coarser`.
    """
    blob, call = pickle.dumps(search), joblib.delayed(_try_in_worker)
    shares = [list(traces[k :: run.n_jobs]) for k in range(run.n_jobs)]
    found: list[TraceTrial | None] = [None] * len(traces)
    for k, results in enumerate(run(call(blob, share, coarse) for share in shares if share)):
        for i, result in enumerate(results):
            at = k + i * run.n_jobs
            found[at] = None if result is None else TraceTrial(traces[at], *result)
    return found


def _try_in_worker(
    blob: bytes, traces: Sequence[Trace], coarse: bool
) -> list[tuple[list[np.ndarray], np.ndarray] | None]:
    search = _load_search(blob).coarser if coarse else _load_search(blob)
    results: list[tuple[list[np.ndarray], np.ndarray] | None] = []
    for trace in traces:
        try:
            motion = _drive_steadily(search, trace)
        except SimulationError:
            results.append(None)
            continue
        results.append((_information(search, motion), _limit_excess(search, _place_in_lane(search, [motion])[0])))
    return results


@lru_cache(maxsize=1)
def _load_search(blob: bytes) -> PhaseSearch:
    """Unpickle a search once per worker, so that functions of its model are built once."""
    search = pickle.loads(blob)
    assert isinstance(search, PhaseSearch)
    return search


def _drive_steadily(search: PhaseSearch, trace: Trace) -> Motion:
    return ground.follow_trace(search.model, trace, STEADY_DRIVER, 0)


def _place_in_lane(search: PhaseSearch, motions: Sequence[Motion]) -> list[Motion]:
    """Move drives so that the first lies best in the lane, even if it keeps the lane already."""
    start = trajectories.place_on_lane(search.model, search.problem, motions[0])
    return [trajectories.move_motion(search.model, m, start) for m in motions]


def _information(search: PhaseSearch, motion: Motion) -> list[np.ndarray]:
    names = ("t", "q", "nu", "a", "u", "wheels", "memory")
    step = max(1, THINNING // search.stride)
    thin = replace(motion, **{n: getattr(motion, n)[::step] for n in names})
    return [step * search.stride * A for A in trajectories.information_matrices(search.aim, search.model, thin)]


def _driver_limits(search: PhaseSearch) -> list[Limit]:
    return [g for g in trajectories.machine_limits(search.model, search.problem) if g.kind not in VALVE_LIMITS]


@lru_cache(maxsize=4)
def _limits(search: PhaseSearch) -> tuple[ca.Function, np.ndarray, np.ndarray, np.ndarray]:
    """Stack the limits that a driver can break: function of (q, nu, u, du), low, high, range."""
    every = _driver_limits(search)
    low, high, size = np.array([(g.low, g.high, g.range) for g in every]).reshape(-1, 3).T
    return trajectories.stack_limits(search.model, every), low, high, size


def _limit_excess(search: PhaseSearch, motion: Motion) -> np.ndarray:
    within, low, high, size = _limits(search)
    values = within(motion.q.T, motion.nu.T, motion.u.T, 0).full()
    above = np.maximum(values - high[:, None], low[:, None] - values) / size[:, None]
    found = np.column_stack([part.max(axis=1) for part in np.array_split(above, WINDOWS, axis=1)])
    if search.problem.rest:
        centred = list(trajectories.resting_coordinates(search.model))
        moving = np.abs(motion.nu[-1]) / trajectories.rest_tolerances(search.model) - 1
        away = np.abs(motion.q[-1, centred]) / trajectories.REST_POSITION - 1
        still = REST_WEIGHT * np.concatenate([moving, away])
        found = np.vstack([found, np.repeat(still[:, None], WINDOWS, axis=1)])
    if search.problem.reversals is None:
        return found
    turns = trajectories.MOTION_LIMITS[trajectories.REVERSALS_LIMIT](search.model, search.problem, motion).get(
        trajectories.REVERSALS_LIMIT, 0.0
    )
    return np.vstack([found, np.full(WINDOWS, turns if turns > 0 else -1.0)])


def _required_margin(search: PhaseSearch, trace: Trace, seed: int) -> np.ndarray:
    """Return by how much people come nearer to each limit (n_limits,) than the steady person, MIN_MARGIN at least."""
    ways = [
        _drive_steadily(search, trace),
        *(ground.follow_trace(search.model, trace, None, seed + k) for k in range(PEOPLE)),
    ]
    every = np.array([_limit_excess(search, m).max(axis=1) for m in _place_in_lane(search, ways)])
    least = np.full(every.shape[1], MIN_MARGIN)
    overhang = contact_overhang(search)
    least[: len(overhang)] = np.maximum(overhang, MIN_MARGIN)
    return np.maximum(every[1:].max(axis=0) - every[0], least)


def contact_overhang(search: PhaseSearch) -> np.ndarray:
    """Return by how much contacts reach beyond the points that each limit of the lane counts (n_limits,), else 0.

    Half the widest contact, as a share of the limit's range, so that people stay in the lane with the whole contact.
    """
    half = max(float(b.contact.width) for b in search.model.machine.contacts if b.contact is not None) / 2
    every = _driver_limits(search)
    return np.array([half / g.range if trajectories.is_lane_limit(g.name) else 0.0 for g in every])


def merit(search: PhaseSearch, trial: TraceTrial, room: np.ndarray) -> float:
    """Return the objective plus a price for every limit that is not kept with its margin."""
    excess = np.maximum(trial.over.max(axis=1) + room, 0)
    return trajectories.score_matrices(search.aim, trial.A) + EXCESS_PRICE * float(excess.sum())


def _try_trace(search: PhaseSearch, trace: Trace, run: joblib.Parallel) -> TraceTrial:
    found = try_traces(search, [trace], run)[0]
    if found is None:
        raise SimulationError("the drive in phases can't be followed once its times are round; make phases longer")
    return found


# ------------------------------------------------------------------------------------------------ improvement


def improve_by_program(
    search: PhaseSearch,
    best: TraceTrial,
    room: np.ndarray,
    reach: float,
    sharp: float,
    times: bool,
    run: joblib.Parallel,
) -> tuple[TraceTrial, float]:
    """Take one step by a quadratic program; return the best trace and the reach of the next step.

    reach: largest change in STEP_SIZES. sharp: sharpness of the smoothed objective. times: move knots too.
    """
    import cvxpy as cp  # slow to load, and rarely needed

    x, step = _vector(best.trace), _per_entry(best.trace, DIFFERENCE_STEPS)
    free = np.arange(0 if times else len(best.trace.times) - 2, len(x))
    moves = [step[k] * row for k, row in enumerate(np.eye(len(x))) if k in free]
    base, *near = try_traces(search, [best.trace, *(_trace(best.trace, x + m) for m in moves)], run, coarse=True)
    rows, columns = np.triu_indices(len(search.aim.scale))
    local = trajectories.local_model(search.aim, best.A, rows, columns, sharp)
    dA, dg = np.zeros((len(local.slope), len(free))), np.zeros((best.over.size, len(free)))
    for i, (k, trial) in enumerate(zip(free, near, strict=True)):
        if trial is not None and base is not None:
            change = [(B - A)[rows, columns] for A, B in zip(base.A, trial.A, strict=True)]
            dA[:, i] = np.concatenate(change) / step[k]
            dg[:, i] = (trial.over - base.over).ravel() / step[k]
    C, d = _linear_constraints(search, best.trace)
    size = _per_entry(best.trace, STEP_SIZES)[free]
    slack, by = cp.Variable(len(best.over), nonneg=True), cp.Variable(len(free))
    spread = np.repeat(np.eye(len(best.over)), WINDOWS, axis=0)
    model = (local.slope @ dA * size) @ by + 0.5 * cp.sum_squares((local.factor.T @ dA * size) @ by)
    reached = cp.Parameter(nonneg=True)
    program = cp.Problem(
        cp.Minimize(model + EXCESS_PRICE * cp.sum(slack)),
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
    before = merit(search, best, room)
    tried = zip(steps, try_traces(search, [t for _, t in steps], run), strict=True)
    found = [(merit(search, t, room), share, t) for (share, _), t in tried if t is not None]
    if not found:
        return best, reach / 10
    least, share, trial = min(found, key=lambda f: f[0])
    if not least < before:
        return best, reach / 10
    return trial, min(1.5 * reach * share if share == 1.0 else reach * share, 2.0)


def improve_by_steps(search: PhaseSearch, best: TraceTrial, room: np.ndarray, run: joblib.Parallel) -> TraceTrial:
    """Return the best sum of useful single steps on the grid and the dial."""
    x, step = _vector(best.trace), _per_entry(best.trace, (GRID_S, SPEED_STEP, ANGLE_STEP))
    C, d = _linear_constraints(search, best.trace)
    moves = [sign * step[k] * row for k, row in enumerate(np.eye(len(x))) for sign in (1, -1)]
    moves = [m for m in moves if (C @ (x + m) <= d + 1e-9).all()]

    def merits(steps: Sequence[np.ndarray]) -> list[float]:
        tried = try_traces(search, [_trace(best.trace, x + m) for m in steps], run, coarse=True)
        return [np.inf if t is None else merit(search, t, room) for t in tried]

    before, *each = merits([np.zeros(len(x)), *moves])
    sums: list[np.ndarray] = []
    for k in np.argsort(each):
        total = moves[k] + (sums[-1] if sums else 0)
        if each[k] < before and (C @ (x + total) <= d + 1e-9).all() and (np.abs(total) <= step + 1e-9).all():
            sums.append(total)
    order = np.argsort(merits(sums))[:CONFIRMED]
    confirmed = try_traces(search, [_trace(best.trace, x + sums[k]) for k in order], run)
    return min((best, *(t for t in confirmed if t is not None)), key=lambda t: merit(search, t, room))
