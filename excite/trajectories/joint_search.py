"""Search for the motion of an arm that shows its parameters best, from several random starts in parallel processes.

A start is the best of many random Fourier series within the limits. Its coefficients are optimised in stages of a
sharper and sharper maximum; a free motion then goes on from the Fourier series as a spline. Scores and limits are those
of the machine file, the limits at DENSE_PER_SAMPLE points per sample; limits that are exceeded between the program's
samples get a margin, and the last stage is repeated. The best motion is made a little smaller if it exceeds limits
where a position controller follows it. A motion that is known begins at the last stage.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import joblib
import numpy as np

from excite.errors import MachineError, SimulationError
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, motion_along
from excite.trajectories import composite_objective, objective as objectives
from excite.trajectories.clearance import drive_ranges, random_poses
from excite.trajectories.composite_objective import COND_MAX, SIGMA_MAX, CompositeObjective
from excite.trajectories.excitation import Manoeuvre
from excite.trajectories.joint_motion import (
    Basis,
    JointMotion,
    MotionProgram,
    all_violations,
    exceeded,
    motion_basis,
    violations_as_followed,
    with_smooth_friction,
)
from excite.trajectories.limits import (
    LIGHTEN,
    TOLERANCE,
    check_limits,
    chosen_poses,
    describe_overload,
    end_poses,
    machine_limits,
    stack_limits,
)
from excite.trajectories.multistart import (
    NO_START_YET,
    Design,
    Report,
    begin_worker,
    ignore_killed_workers,
    infeasible_error,
    no_drive_yet,
    process_count,
    progress_reports,
    reported_score,
    stop_file,
    write_stage,
)

GUESSES = 100  # random series of which the best is a start; chosen
GUESS_REACH = 0.9  # share of the limits on position and speed that a guess may use; chosen
START_POSES = 1000  # random poses of which those that keep every limit may be the start
START_REACH = 0.7  # share of a joint's range that they are drawn from: a start at its end leaves no room
SHRINK, SHRINKS = 0.7, 6  # factor of a guess outside of its limits, and how often it is applied; chosen
DRAWN_BACK = (0.995, 0.98, 0.95, 0.9, 0.8)  # factors of coefficients that keep limits in the end; chosen
DRAWN_BACK_FOLLOWED = (0.998, 0.995, 0.99, 0.98, 0.95)  # those that keep limits as followed; chosen
REPAIR_ITERATIONS = 30  # of a solve with larger margins; chosen
ROUNDING = 1e-6  # excess that counts as none, share of a limit's range; chosen
REPAIRS = 3  # solves with larger margins; chosen


@dataclass(frozen=True)
class Stage:
    """One solve: of a basis, with a sharpness of the objective's maximum, in so many iterations at most."""

    basis: str
    sharpness: float
    iterations: int


FIRST_STAGE = Stage("fourier", 30, 200)
NEAR_REACH = 0.1  # rad or m that a coefficient of a motion near its optimum may move before a new beginning; chosen
WARM_ITERATIONS = 120  # of a motion that is known, at the last stage: it is near an optimum already; chosen
TRAJECTORIES: dict[str, tuple[Stage, ...]] = {  # stages by the kind of motion; iterations chosen for a minute
    "free": (FIRST_STAGE, Stage("free", 30, 150), Stage("free", 100, 250)),
    "fourier": (FIRST_STAGE, Stage("fourier", 100, 300), Stage("fourier", 300, 300)),
}


@dataclass(frozen=True)
class ScoredMotion:
    """A motion by its coefficients (n_q, n_c) in a basis. score: of the objective; violations: excess by limit.

    followed: excess by limit where a position controller follows the motion, None if that was not simulated.
    """

    basis: str
    coefficients: np.ndarray
    score: float
    violations: dict[str, float]
    followed: dict[str, float] | None = None

    @property
    def excess(self) -> float:
        return max(self.violations.values(), default=0.0)

    @property
    def followed_excess(self) -> float:
        return max((self.followed or {}).values(), default=0.0)

    @property
    def rank(self) -> tuple[int, float]:
        """Order motions: those that keep every limit, by score, those within the tolerance, and others by excess."""
        group = int(self.excess > ROUNDING) + int(self.excess > TOLERANCE)
        return group, self.score if group < 2 else self.excess


@dataclass(frozen=True)
class MotionState:
    """The best motion of a start. complete: False if cut short. start_cond_phi: of the guess, begun_from."""

    number: int
    best: ScoredMotion
    start_cond_phi: float
    begun_from: Motion
    iterations: int
    complete: bool


def check_joint_motion(model: Model, trajectory: str) -> None:
    """Raise MachineError for a machine whose designs are no joint motions, KeyError for an unknown trajectory."""
    if trajectory not in TRAJECTORIES:
        raise KeyError(f"no trajectory {trajectory}, allowed: {', '.join(TRAJECTORIES)}")
    name = model.machine.name
    if not model.follows_positions:
        raise MachineError(
            f"{name}: designs are torques over time here, joint motions are for arms, whose joints are all driven and"
            " whose torques depend on positions; leave out --trajectory"
        )
    if not model.plain:
        effects = ", ".join(e.name for e in model.effects)
        raise MachineError(
            f"{name}: an arm is designed without effects; take out {effects} (in the machine file, or --between)"
        )


def design_joint_motion(
    model: Model,
    problem: Problem,
    objective: str | CompositeObjective = "cond",
    starts: int = 2,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Report | None = None,
    trajectory: str = "free",
    warm: Sequence[Motion] = (),
) -> Design:
    """Design the excitation of an arm as a motion of its joints: the best of several random starts.

    trajectory: a name in TRAJECTORIES. warm: motions that start at the last stage; `starts` may then be 0. Other
    arguments and Ctrl-C as in `multistart.design`, its errors too, and MachineError for a machine that is no arm.
    """
    check_joint_motion(model, trajectory)
    composite = composite_objective.compose_objective(model, objective) if isinstance(objective, str) else objective
    if starts < (0 if warm else 1):
        raise ValueError(f"starts must be at least 1, got {starts}")
    free_poses(model, problem, composite.machines[1:])
    deadline = None if budget_s is None else time.time() + budget_s
    seeds = np.random.SeedSequence(seed).generate_state(starts)
    begins: list[int | Motion] = [*(int(s) for s in seeds), *warm]
    states: dict[int, MotionState] = {}
    stages = starts * len(TRAJECTORIES[trajectory]) + len(warm)
    with (
        stop_file() as stop,
        progress_reports(stop.parent, progress, stages, len(begins)),
        joblib.parallel_config("loky", inner_max_num_threads=1),
    ):
        run = joblib.Parallel(n_jobs=process_count(), return_as="generator_unordered")
        call = joblib.delayed(_run_start)
        with ignore_killed_workers(stop):
            for state in run(
                call(model, problem, composite, trajectory, k, begin, deadline, stop) for k, begin in enumerate(begins)
            ):
                if state is not None:
                    states[state.number] = state
        interrupted = stop.exists()
    if not states:
        raise KeyboardInterrupt(NO_START_YET)
    best = min(states.values(), key=lambda t: (*t.best.rank, t.number))
    complete = len(states) == len(begins) and all(t.complete for t in states.values())
    if best.best.excess > TOLERANCE:
        if interrupted:
            raise KeyboardInterrupt(no_drive_yet(model, best.best.violations))
        raise infeasible_error(model, composite, best.best.violations, complete)
    chosen = keep_as_followed(model, problem, composite, best.best)
    states[best.number] = replace(best, best=chosen)
    motion = _as_motion(model, problem, chosen.basis, chosen.coefficients).sample(model)
    reported = {k: reported_score(composite, t.best.score, t.best.excess) for k, t in states.items()}
    return Design(
        composite.name,
        Manoeuvre(motion.t, motion.u),
        motion,
        objectives.cond_phi(model, motion),
        objectives.cond_w(model, motion),
        min(t.start_cond_phi for t in states.values()),
        dict(chosen.violations),
        chosen.excess,
        tuple(reported.get(k, float("inf")) for k in range(len(begins))),
        complete,
        "slsqp",
        best.iterations,
        trajectory,
        chosen.followed,
        tuple(states[k].begun_from for k in range(starts) if k in states),
        interrupted,
    )


def _as_motion(model: Model, problem: Problem, basis: str, coefficients: np.ndarray) -> JointMotion:
    return JointMotion(motion_basis(model, problem, basis, *end_poses(model, problem)), coefficients)


def score_joint_motion(
    model: Model, problem: Problem, objective: CompositeObjective, basis: str, coefficients: np.ndarray
) -> ScoredMotion:
    """Score a motion by the machine file: the objective on all samples, every limit between samples too."""
    made = _as_motion(model, problem, basis, coefficients)
    motion = made.sample(model)
    found = composite_objective.score_motions(objective, [(m, made.sample(m)) for m in objective.judged(model)])
    violations = all_violations(model, problem, made, objective.machines[1:])
    if objective.sigma_max is not None:
        violations[SIGMA_MAX] = max(0.0, found.worst_percent / objective.sigma_max - 1)
    if objective.cond_max is not None:
        violations[COND_MAX] = max(0.0, objectives.cond_phi(model, motion) / objective.cond_max - 1)
    score = found.score if np.isfinite(found.score) else float("inf")
    return ScoredMotion(basis, coefficients, score, violations)


def _run_start(
    model: Model,
    problem: Problem,
    objective: CompositeObjective,
    trajectory: str,
    number: int,
    begin: int | Motion,
    deadline: float | None,
    stop: Path,
) -> MotionState | None:
    """Run one start in a worker process; None if time is up before it begins, start 0 always runs.

    begin: a seed, or a motion to go on from.
    """
    should_stop = begin_worker(stop, deadline)
    if number > 0 and should_stop():
        return None
    state = None
    for k, found in enumerate(search(model, problem, objective, trajectory, begin, should_stop)):
        state = replace(found, number=number)
        score = reported_score(objective, state.best.score, state.best.excess)
        write_stage(model, stop, number, k, score, state.best.violations)
    return state


def search(
    model: Model,
    problem: Problem,
    objective: CompositeObjective,
    trajectory: str,
    begin: int | Motion,
    should_stop: Callable[[], bool],
) -> Iterator[MotionState]:
    """Yield the best motion so far after every stage of a start: from a seed, or from a motion at the last stage."""
    smooth = with_smooth_friction(model)
    poses = end_poses(model, problem)
    stages = TRAJECTORIES[trajectory]
    if isinstance(begin, Motion):
        stages = (replace(stages[-1], iterations=WARM_ITERATIONS),)
    program = MotionProgram(smooth, problem, objective, motion_basis(model, problem, stages[0].basis, *poses))
    if isinstance(begin, Motion):
        x = program.unknowns(fit_coefficients(program.basis, begin.t, begin.q))
    else:
        x = best_guess(program, free_poses(model, problem, objective.machines[1:]), begin, should_stop)
    best = score_joint_motion(model, problem, objective, stages[0].basis, program.coefficients(x))
    guess = _as_motion(model, problem, stages[0].basis, best.coefficients).sample(model)
    first = objectives.cond_phi(model, guess)
    iterations = 0
    for stage in stages:
        if program.basis.kind != stage.basis:
            before = program
            program = MotionProgram(smooth, problem, objective, motion_basis(model, problem, stage.basis, *poses))
            x = _carried_over(before, program, x)
        program.sharpness = stage.sharpness
        program.objective = _calibrated(model, problem, objective, best)
        for repair in range(1 + REPAIRS * (stage is stages[-1])):
            most = REPAIR_ITERATIONS if repair else stage.iterations
            reach = NEAR_REACH if isinstance(begin, Motion) or repair else np.inf
            found = program.solve(x, should_stop, most, reach)
            iterations += found.iterations
            x = found.x
            scored = score_joint_motion(model, problem, objective, stage.basis, program.coefficients(x))
            best = min(best, scored, _drawn_back(model, problem, objective, scored), key=lambda s: s.rank)
            if scored.excess <= ROUNDING or should_stop():
                break
            made = _as_motion(model, problem, stage.basis, scored.coefficients)
            program.widen_margins(x, *exceeded(model, problem, made, objective.machines[1:]))
            over = max(scored.violations.get(name, 0.0) for name in (SIGMA_MAX, COND_MAX))
            program.objective = composite_objective.lower_ceilings(program.objective, over)
        yield MotionState(0, best, first, guess, iterations, not should_stop())
        if should_stop():
            return


def _calibrated(
    model: Model, problem: Problem, objective: CompositeObjective, best: ScoredMotion
) -> CompositeObjective:
    """Return an objective whose surrogates of variances agree with the Cramer-Rao bound along a motion."""
    motion = _as_motion(model, problem, best.basis, best.coefficients).sample(model)
    try:
        ratio = composite_objective.surrogate_ratio(objective, model, motion)
    except SimulationError:
        ratio = None
    return objective if ratio is None else composite_objective.calibrate_surrogates(objective, ratio)


def _drawn_back(model: Model, problem: Problem, objective: CompositeObjective, found: ScoredMotion) -> ScoredMotion:
    """Return a motion that exceeds a limit with its coefficients reduced until it keeps all of them, or as it is."""
    basis = _as_motion(model, problem, found.basis, found.coefficients).basis
    for share in DRAWN_BACK if found.excess > ROUNDING else ():
        coefficients = basis.shrunk(found.coefficients, share)
        at_samples = check_limits(model, problem, JointMotion(basis, coefficients).sample(model))
        if max(at_samples.values(), default=0.0) > ROUNDING:
            continue  # what happens between the samples, which takes longest to find, no longer counts
        less = score_joint_motion(model, problem, objective, found.basis, coefficients)
        if less.excess <= ROUNDING:
            return less
    return found


def keep_as_followed(
    model: Model, problem: Problem, objective: CompositeObjective, found: ScoredMotion
) -> ScoredMotion:
    """Return a motion with what it exceeds as followed, its coefficients reduced if that keeps all limits.

    A motion that exceeds limits as planned, or that no reduction helps, stays as it is.
    """
    first = _with_followed(model, problem, found)
    basis = _as_motion(model, problem, found.basis, found.coefficients).basis
    for share in DRAWN_BACK_FOLLOWED if first.excess <= ROUNDING < first.followed_excess else ():
        less = score_joint_motion(model, problem, objective, first.basis, basis.shrunk(first.coefficients, share))
        less = _with_followed(model, problem, less)
        if max(less.excess, less.followed_excess) <= ROUNDING:
            return less
    return first


def _with_followed(model: Model, problem: Problem, found: ScoredMotion) -> ScoredMotion:
    motion = _as_motion(model, problem, found.basis, found.coefficients).sample(model)
    return replace(found, followed=violations_as_followed(model, problem, motion))


def _carried_over(before: MotionProgram, program: MotionProgram, x: np.ndarray) -> np.ndarray:
    """Return the coefficients of the program's basis that follow those of another one best."""
    t = np.linspace(0, program.basis.duration, 8 * program.n_c)
    return program.unknowns(fit_coefficients(program.basis, t, JointMotion(before.basis, before.coefficients(x)).at(t)))


def fit_coefficients(basis: Basis, t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the coefficients (n_q, n_c) of a basis that follow a motion q (N, n_q) at times t (N,) [s] best.

    The first sample gives the poses that are chosen.
    """
    target = q - basis.path(t, 0)
    moving = basis.count - bool(basis.chosen)
    found = np.zeros((q.shape[1], basis.count))
    if basis.chosen:
        chosen = list(basis.chosen)
        found[chosen, -1] = target[0, chosen]
        target = target - found[:, -1]
    found[:, :moving] = np.linalg.lstsq(basis.evaluate(t, 0)[:, :moving], target, rcond=None)[0].T
    return found


def best_guess(program: MotionProgram, poses: np.ndarray, seed: int, should_stop: Callable[[], bool]) -> np.ndarray:
    """Return the best of GUESSES random motions (n_x,), scaled into the limits where that can be done.

    poses (k, n_q): where they may start. Each joint is scaled into its limits on position and speed, then all together.
    """
    rng = np.random.default_rng(seed)
    basis = program.basis
    best, chosen = (True, float("inf")), None
    for _ in range(GUESSES):
        guess = rng.normal(size=(program.n_q, program.n_c)) * rng.uniform(0.3, 1.0, (program.n_q, 1))
        pose = np.zeros_like(guess)
        if basis.chosen:
            pose[:, -1] = poses[rng.integers(len(poses))] - basis.start
            guess[:, -1] = pose[:, -1]
        room = GUESS_REACH * program.room(program.unknowns(guess), program.unknowns(pose))
        moving = guess - pose
        guess = pose + moving * np.minimum(room, 1.0)[:, None]
        for _ in range(SHRINKS):
            over = bool((program.slack(program.unknowns(guess)) < 0).any())
            if not over:
                break
            guess = basis.shrunk(guess, SHRINK)
        if chosen is None or not over:
            x = program.unknowns(guess)
            value = program.value(x)
            found = over, value if np.isfinite(value) else float("inf")
            if chosen is None or found < best:
                best, chosen = found, x
        if should_stop():
            break
    assert chosen is not None
    return np.asarray(chosen)


def free_poses(model: Model, problem: Problem, others: Sequence[Model] = ()) -> np.ndarray:
    """Return poses (k, n_q) that keep every limit at rest, the given ones as they are; half of each range is tried.

    others: machines that keep them there as well. Raises MachineError if no pose does.
    """
    start, end = end_poses(model, problem)
    chosen = list(chosen_poses(model, problem))
    low, high = drive_ranges(model)
    drawn = (low + high) / 2 + (random_poses(model, START_POSES) - (low + high) / 2) * START_REACH
    tried = np.tile(start, (len(drawn) if chosen else 1, 1))
    tried[:, chosen] = drawn[: len(tried), chosen]
    every = np.vstack([tried, end[None, :]]) if not chosen else tried
    limits = machine_limits(model, problem)
    still = np.zeros_like(every)
    each = [motion_along(m, np.arange(float(len(every))), every, still, still).u for m in (model, *others)]
    values = np.stack([stack_limits(model, limits)(every.T, still.T, u.T, 0 * u.T).full() for u in each])
    low_g, high_g = (np.array([getattr(g, key) for g in limits])[:, None] for key in ("low", "high"))
    off = np.maximum(values - high_g, low_g - values).max(axis=0).reshape(len(limits), -1)
    over = off > 0
    kept = ~over.any(axis=0)
    if (kept.all() if not chosen else kept.any()) or not limits:
        return tried[kept[: len(tried)]]
    often = limits[int(np.argmax(over.mean(axis=1)))]
    name = model.machine.name
    if chosen:
        share = np.where(over, off, 0) / [[g.range] for g in limits]
        nearest = every[[int(np.argmin(share.max(axis=0)))]]
        where = f"none of {len(tried)} random poses keeps every limit at rest"
        change = "give the problem a start_pose that does, or change shapes, floor or limits in the machine file"
    else:
        nearest = every
        where = "the start or end pose exceeds a limit at rest"
        change = "give the problem another start_pose, or change shapes, floor or limits in the machine file"
    if often.kind == "torque" and (overload := describe_overload(model, nearest)):
        best = "even in the best of them " if chosen else ""
        other = "" if chosen else "give the problem poses that it can hold, or "
        raise MachineError(f"{name}: {where}: {best}{overload}; {other}{LIGHTEN}")
    raise MachineError(f"{name}: {where}, first of all {often.name}: {change}")
