"""Continuation of a design: from a smooth, coarse problem to the machine as it is.

The first stages have wide transitions of friction and slip and torque knots far apart; later ones approach the real
machine. Every stage's result is simulated afresh by the accurate integrator at the machine's sampling rate. Scores and
limits are those of that simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import CollocationError, SimulationError
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, simulate, track_motion
from excite.trajectories import composite_objective, interior_point, ipopt, objective as objectives
from excite.trajectories.collocation import (
    Transcription,
    rest_band_factor,
    solve_states,
    transcribe,
    widen_transitions,
)
from excite.trajectories.composite_objective import COND_MAX, SIGMA_MAX, CompositeObjective
from excite.trajectories.excitation import Manoeuvre, knot_times, multisine, scale_torques
from excite.trajectories.lane import simulate_on_lane
from excite.trajectories.limits import (
    REST_POSITION,
    REST_SPEED,
    TOLERANCE,
    TRAVEL_LIMIT,
    check_limits,
    is_free_limit,
    is_lane_limit,
    is_rest_limit,
    keeps_motion_limits,
    lane_excess,
    machine_limits,
    rest_tolerances,
    resting_coordinates,
    travel_directions,
)

MAX_INFEASIBILITY = 20.0  # half ranges in sum; a program that ends above it is started again; chosen
LIMIT_MARGIN = 2e-3  # half ranges, distance that the program keeps from limits on the motion; chosen


@dataclass(frozen=True)
class ContinuationStage:
    """One stage: transitions of friction and slip and the knot spacing are wider by these factors.

    Level i has sharpness `sharpness` 2^i and barrier `barrier` / 3^i. It ends when the decrease that a Newton step
    expects is below `patience` / sharpness.

    elements: collocation elements per interval. Of the own solver alone: push, the distance in half ranges of the first
    slacks from their bounds; first_barrier, the least barrier parameter that gives the first multipliers; starts_again,
    whether a program that ends far outside its limits begins anew from torques that keep every limit.
    """

    friction: float
    slip: float
    coarse: int
    sharpness: float
    barrier: float
    levels: int
    iterations: int
    patience: float
    elements: int = 1
    push: float = 1e-3
    first_barrier: float = 0.0
    starts_again: bool = True

    def split_levels(self) -> list[ContinuationStage]:
        """Split the levels into stages, so that surrogates of variances are calibrated before each."""
        return [
            replace(self, sharpness=self.sharpness * 2**i, barrier=self.barrier / 3**i, levels=1)
            for i in range(self.levels)
        ]


# friction, slip, coarse, sharpness, barrier, levels, iterations, patience; all chosen
STAGES = (
    ContinuationStage(10, 3, 4, 8, 1e-3, 2, 40, 1.0),
    ContinuationStage(4, 1.7, 2, 16, 1e-4, 2, 30, 1.0),
    ContinuationStage(2, 1.2, 2, 40, 3e-5, 1, 30, 1.0),
    ContinuationStage(1, 1, 2, 60, 1e-5, 1, 30, 1.0),
    ContinuationStage(1, 1, 1, 100, 1e-5, 4, 30, 0.1),
)
SCREENING_STAGES = 3  # stages that every start goes through; the best third goes on; chosen
REPAIR_STAGE = ContinuationStage(
    1, 1, 1, 800, 3e-6, 1, 30, 0.1, elements=3, push=0.05, first_barrier=1e-5, starts_again=False
)
REFINE_STAGE = ContinuationStage(1, 1, 1, 800, 1e-6, 1, 30, 0.1)
MAX_REPAIRS = 4  # repairs of a drive that exceeds a limit, and one more for every machine; chosen
LARGE_EXCESS = 0.05  # share of a limit's range, above which margins grow by a ratio; chosen
MAX_REFINES = 5  # re-optimisations of an objective with a ceiling; chosen
MIN_SCORE_GAIN = 2e-3  # gain of the score that justifies another re-optimisation; chosen

StateReport = Callable[["SearchState"], None]


@dataclass(frozen=True)
class ScoredDrive:
    """A drive after fresh simulation: torques, start coordinates (n_q,), score, excess by limit."""

    manoeuvre: Manoeuvre
    start: np.ndarray
    score: float
    violations: Mapping[str, float]

    @property
    def excess(self) -> float:
        return max(self.violations.values(), default=0.0)

    @property
    def feasible(self) -> bool:
        return self.excess <= TOLERANCE


@dataclass(frozen=True)
class SearchState:
    """Progress of one start.

    begun_from: the drive before any stage. state_sizes: typical sizes by state name. latest, best: drives found.
    motion: of `latest`.
    times (N,) [s], node_states (N, n_z): nodes of the last program, scaled; at first the samples of `motion` and None.
    start_pose (n_q,): start coordinates, once limits of the lane matter.
    travel_direction (N,): +-1 at the machine's samples, if reversals are limited.
    surrogate_ratio (n_base,): correction of the surrogates of variances in the last stage.
    solver: a name in SOLVERS. iterations: of the solver, in all stages. failure: why its last solve found no optimum.
    complete: False if the search was cut short.
    """

    number: int
    begun_from: Manoeuvre
    start_cond_phi: float
    state_sizes: Mapping[str, float]
    latest: ScoredDrive
    best: ScoredDrive
    motion: Motion
    times: np.ndarray
    node_states: np.ndarray | None = None
    start_pose: np.ndarray | None = None
    travel_direction: np.ndarray | None = None
    surrogate_ratio: np.ndarray | None = None
    solver: str = "own"
    iterations: int = 0
    failure: str | None = None
    complete: bool = False


def rank(c: ScoredDrive) -> tuple[float, float]:
    """Order feasible drives before infeasible ones, then by score or by excess."""
    return (0.0, c.score) if c.feasible else (1.0, c.excess)


def selection_score(c: ScoredDrive) -> float:
    """Score a screened start: its score plus its excess, at most 1."""
    return c.score + min(1.0, c.excess)


def start_from_multisine(
    model: Model, problem: Problem, objective: CompositeObjective, number: int, seed: int, solver: str = "own"
) -> SearchState:
    """Start from a random multisine, as large as the limits on the motion allow."""
    largest = multisine(model, problem, seed, top=0.5)
    for factor in 0.85 ** np.arange(60):
        drive = scale_torques(largest, float(factor))
        try:
            motion = simulate(model, drive.sample(float(model.machine.sampling_hz)))
        except SimulationError:
            continue
        if keeps_motion_limits(check_limits(model, problem, motion)):
            break
    found, motion = evaluate_drive(model, problem, objective, drive)
    state_sizes = typical_sizes(model, problem, motion)
    travel_direction = None if problem.reversals is None else travel_directions(motion, problem.reversals)
    return SearchState(
        number,
        drive,
        objectives.cond_phi(model, motion),
        state_sizes,
        found,
        found,
        motion,
        motion.t,
        travel_direction=travel_direction,
        solver=solver,
    )


def start_from_drive(
    model: Model, problem: Problem, objective: CompositeObjective, number: int, drive: Manoeuvre, solver: str = "own"
) -> SearchState:
    """Start the last stages from a given drive.

    Raises SimulationError.
    """
    found, motion = evaluate_drive(model, problem, objective, drive)
    state_sizes = typical_sizes(model, problem, motion)
    travel_direction = None if problem.reversals is None else travel_directions(motion, problem.reversals)
    start_pose = found.start if model.machine.planar and problem.lane_points else None
    score = objectives.cond_phi(model, motion)
    return SearchState(
        number,
        drive,
        score,
        state_sizes,
        found,
        found,
        motion,
        motion.t,
        start_pose=start_pose,
        travel_direction=travel_direction,
        solver=solver,
    )


def typical_sizes(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Return twice the root mean square of every coordinate c, velocity c' and memory state in a motion.

    Half the lane for the position, 1 for the heading.
    """
    sizes = {}
    for k, c in enumerate(model.coordinates):
        sizes[c] = max(1e-3, 2 * float(np.sqrt((motion.q[:, k] ** 2).mean())))
        sizes[c + "'"] = max(1e-3, 2 * float(np.sqrt((motion.nu[:, k] ** 2).mean())))
    for name, values in zip(model.memory, motion.memory.T, strict=True):
        sizes[name] = max(1e-3, 2 * float(np.sqrt((values**2).mean())))
    if model.machine.planar:
        x, y, heading = model.machine.body[0].coordinates
        length, width = problem.lane
        sizes |= {x: length / 2, y: width / 2, heading: 1.0}
    return sizes


def run_stages(
    model: Model,
    problem: Problem,
    objective: CompositeObjective,
    state: SearchState,
    plan: Sequence[ContinuationStage],
    should_stop: Callable[[], bool],
    report: StateReport = lambda state: None,
) -> SearchState:
    """Take a start through stages until `should_stop` or a stage has no optimum; `report` is called after each."""
    if objective.sigma_max is not None:
        plan = [one for stage in plan for one in (stage.split_levels() if stage.friction == 1 else [stage])]
    for stage in plan:
        if should_stop() or state.failure is not None:
            break
        moved = _run_stage(model, problem, objective, state, stage, {}, should_stop)
        if moved is None:
            break
        state = moved
        if state.start_pose is not None or (stage.friction <= 4 and lane_excess(state.latest.violations) > 0):
            state = replace(state, start_pose=state.latest.start)
        report(state)
    return state


def refine(
    model: Model,
    problem: Problem,
    objective: CompositeObjective,
    state: SearchState,
    should_stop: Callable[[], bool],
    report: StateReport = lambda state: None,
) -> SearchState:
    """Calibrate the accuracy ceiling to the Cramer-Rao bound again and re-optimise, as long as the score improves."""
    if objective.sigma_max is None:
        return state
    for _ in range(MAX_REFINES):
        before = state.best
        if should_stop() or state.failure is not None:
            break
        state = _run_stage(model, problem, objective, state, REFINE_STAGE, {}, should_stop) or state
        report(state)
        if before.feasible and state.latest.feasible and before.score - state.best.score < MIN_SCORE_GAIN:
            break
    return state


def repair(
    model: Model, problem: Problem, objective: CompositeObjective, state: SearchState, should_stop: Callable[[], bool]
) -> SearchState:
    """Re-optimise a drive that exceeds a limit with finer elements, and move exceeded limits in, a few times at most.

    Most of an excess is the collocation error of the coarser elements, so the first repair keeps the limits where they
    are, unless other machines exceed them. Then a margin grows by the excess, for a large excess by its ratio, since a
    range can't shrink below zero; other machines may need much more torque and power for the same motion.
    """
    margins: dict[str, float] = {}
    state = bring_to_rest(model, problem, objective, state, should_stop)
    for attempt in range(MAX_REPAIRS + len(objective.machines)):
        if state.latest.feasible or should_stop() or state.failure is not None:
            break
        for name, excess in state.latest.violations.items():
            if excess > 0.3 * TOLERANCE and (attempt > 0 or objective.machines):
                old, more = margins.get(name, 0.0), min(3 * excess, excess + 0.01)
                margins[name] = old + more if more < LARGE_EXCESS else 0.5 - (0.5 - old) / (1 + 2 * more)
        state = replace(state, start_pose=state.latest.start) if state.start_pose is not None else state
        state = _run_stage(model, problem, objective, state, REPAIR_STAGE, margins, should_stop) or state
        state = bring_to_rest(model, problem, objective, state, should_stop)
    return state


def bring_to_rest(
    model: Model, problem: Problem, objective: CompositeObjective, state: SearchState, should_stop: Callable[[], bool]
) -> SearchState:
    """Add small smooth torques that bring the fresh simulation to rest at the end.

    States that integrate forces, such as a steered joint, drift in open loop by the collocation error. Newton's method
    on the end of the motion removes the drift with the least torque, as a share of the limits. Kept if the drive
    improves.
    """
    rate = float(model.machine.sampling_hz)
    scale = np.array([float(b.limit.torque) if b.limit.torque is not None else 1.0 for b in model.machine.actuated])
    for _ in range(4):
        late = [name for name, v in state.latest.violations.items() if v > 0 and is_rest_limit(name)]
        if not late or should_stop():
            break
        drive, x0 = state.latest.manoeuvre, _rest_errors(model, state.motion)
        shapes = [
            shape[:, None] * scale * np.eye(len(scale))[k]
            for shape in _bumps(drive.times / drive.duration)
            for k in range(len(scale))
        ]
        step = 1e-3
        try:
            moved = [
                simulate(model, Manoeuvre(drive.times, drive.torque + step * s).sample(rate), q0=state.motion.q[0])
                for s in shapes
            ]
            J = np.column_stack([(_rest_errors(model, m) - x0) / step for m in moved])
            off = np.abs(x0) > 0.5  # in tolerances
            sizes = np.linalg.lstsq(J[off], -x0[off], rcond=1e-3)[0]
            added = sum((size * s for size, s in zip(sizes, shapes, strict=True)), np.zeros_like(drive.torque))
            found, motion = evaluate_drive(model, problem, objective, Manoeuvre(drive.times, drive.torque + added))
        except SimulationError:
            break
        if rank(found) >= rank(state.latest):
            break
        state = replace(state, latest=found, best=min(state.best, found, key=rank), motion=motion)
    return state


def _bumps(share: np.ndarray) -> list[np.ndarray]:
    """Return smooth bumps (K,) in the second half of a drive; share (K,): time over duration."""
    return [
        np.where(np.abs(share - middle) < 0.1, np.cos(5 * np.pi * (share - middle)) ** 2, 0.0)
        for middle in (0.6, 0.75, 0.88)
    ]


def _rest_errors(model: Model, motion: Motion) -> np.ndarray:
    """Return resting coordinates and velocities at the end of a motion, in tolerances."""
    still = motion.q[-1, list(resting_coordinates(model))] / REST_POSITION
    return np.concatenate([still, motion.nu[-1] / rest_tolerances(model)])


def _run_stage(
    model: Model,
    problem: Problem,
    objective: CompositeObjective,
    state: SearchState,
    stage: ContinuationStage,
    margins: Mapping[str, float],
    should_stop: Callable[[], bool],
) -> SearchState | None:
    """Run one stage; None if no motion follows the torques or the information is singular."""
    state, wanted = _calibrate(model, objective, state) if stage.friction == 1 else (state, objective)
    wanted = composite_objective.lower_ceilings(wanted, max(margins.get(x, 0.0) for x in (SIGMA_MAX, COND_MAX)))
    times = knot_times(problem, stage.coarse)
    intervals = len(times) - 1
    softer = widen_transitions(model, stage.friction, stage.slip)
    tr = transcribe(
        softer,
        problem,
        state.state_sizes,
        intervals,
        state.motion,
        elements=stage.elements,
        with_pose=state.start_pose is not None,
        rest_factor=rest_band_factor(stage.friction),
        weights=objective.row_weights,
    )
    nodes = (np.arange(intervals)[:, None] + tr.node_position) * tr.interval_s
    U = state.latest.manoeuvre.at(times) / tr.torque_scale
    U[0] = U[-1] = 0.0
    start, Z = _begin(model, state, tr, nodes)
    moved_in = np.array([LIMIT_MARGIN + 2 * margins.get(name, 0.0) for name in tr.limit_names])
    task = interior_point.Subproblem(
        wanted,
        np.tile(moved_in, (intervals, tr.nodes, 1)),
        np.tile([1e-4 + 2 * margins.get(name, 0.0) for name in tr.torque_limit_names], (intervals, 1)),
        np.array([is_lane_limit(name) for name in tr.limit_names], bool),
    )
    if state.travel_direction is not None and TRAVEL_LIMIT in tr.limit_names:
        above, below = _direction_margins(tr, nodes, model, problem, state.travel_direction)
        task = replace(task, above=above, below=below)

    try:
        Z = solve_states(tr, start, U, Z)
    except CollocationError:
        return None
    sharpness = [stage.sharpness * 2**i for i in range(stage.levels)]
    levels = tuple(
        interior_point.BarrierLevel(p, stage.barrier / 3**i, stage.patience / p, stage.iterations)
        for i, p in enumerate(sharpness)
    )
    asked = 0

    def count_and_stop() -> bool:  # every solver asks after each of its iterations
        nonlocal asked
        asked += 1
        return should_stop()

    try:
        solution = SOLVERS[state.solver](
            StageProgram(tr, task, start, Z, U, levels, state.node_states is None, stage), count_and_stop
        )
    except np.linalg.LinAlgError:  # singular information: the machine hardly moves
        return None
    try:
        found, motion = evaluate_drive(model, problem, objective, Manoeuvre(times, solution.U * tr.torque_scale))
    except SimulationError:
        return None
    return replace(
        state,
        latest=found,
        best=min(state.best, found, key=rank),
        motion=motion,
        times=nodes.ravel(),
        node_states=solution.Z.reshape(-1, tr.n_z),
        iterations=state.iterations + asked,
        failure=solution.failure,
    )


def _begin(model: Model, state: SearchState, tr: Transcription, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return start (n_z,) and states (K, J, n_z), scaled, that a stage begins with at times `nodes` (K, J) [s]."""
    start = np.zeros(tr.n_z)
    if state.start_pose is not None:
        for k, c in enumerate(tr.state_names):
            if c in model.coordinates:
                start[k] = state.start_pose[model.coordinates.index(c)] / tr.state_scale[k]
    if state.node_states is not None and state.node_states.shape[1] == tr.n_z:
        return start, np.stack([np.interp(nodes, state.times, x) for x in state.node_states.T], axis=-1)
    names = [*model.coordinates, *[c + "'" for c in model.coordinates], *model.memory]
    every = np.hstack([state.motion.q, state.motion.nu, state.motion.memory])
    columns = [every[:, names.index(c)] / size for c, size in zip(tr.state_names, tr.state_scale, strict=True)]
    return start, np.stack([np.interp(nodes, state.motion.t, x) for x in columns], axis=-1)


@dataclass(frozen=True)
class StageProgram:
    """Program of a stage: start (n_z,), states Z (K, J, n_z) and torques U (K + 1, n_u) to begin with, scaled.

    levels: of sharpness and barrier, in turn. fresh: no stage before has found torques that keep the limits.
    stage: the stage that this program solves.
    """

    tr: Transcription
    task: interior_point.Subproblem
    start: np.ndarray
    Z: np.ndarray
    U: np.ndarray
    levels: tuple[interior_point.BarrierLevel, ...]
    fresh: bool
    stage: ContinuationStage


@dataclass(frozen=True)
class StageSolution:
    """Solution of a stage: states Z (K, J, n_z) and torques U (K + 1, n_u), scaled.

    failure: why this is no optimum, if the solver can tell.
    """

    Z: np.ndarray
    U: np.ndarray
    failure: str | None = None


Solver = Callable[[StageProgram, Callable[[], bool]], StageSolution]


def _solve_own(program: StageProgram, should_stop: Callable[[], bool]) -> StageSolution:
    """Solve a stage by `interior_point`; a fresh start first moves to torques that keep every limit and end at rest."""
    tr, task, start, Z, U = program.tr, program.task, program.start, program.Z, program.U
    levels, fresh, barrier = program.levels, program.fresh, program.levels[0].barrier
    if not fresh:
        first = max(barrier, program.stage.first_barrier)
        point = interior_point.initial_iterate(tr, task, start, Z, U, first, program.stage.push)
        point, values = interior_point.minimise(tr, task, point, levels, should_stop)
        far = interior_point.infeasibility(values, point) >= MAX_INFEASIBILITY
        fresh = far and program.stage.starts_again
    if fresh:
        near = replace(task, objective=None, goal_weight=1.0, goal=U)
        point = interior_point.initial_iterate(tr, near, start, Z, U, 1e-3, 0.05)
        point, _ = interior_point.minimise(
            tr, near, point, (interior_point.BarrierLevel(1.0, 1e-3, 1e-3, 40),), should_stop
        )
        point = interior_point.initial_iterate(tr, task, point.start, point.Z, point.U, max(barrier, 1e-4), 0.05)
        point, _ = interior_point.minimise(tr, task, point, levels, should_stop)
    return StageSolution(point.Z, point.U)


def _solve_with_ipopt(program: StageProgram, should_stop: Callable[[], bool]) -> StageSolution:
    """Solve a stage by Ipopt."""
    p = program
    found = ipopt.minimise(p.tr, p.task, p.start, p.Z, p.U, p.levels, should_stop)
    if found.converged or found.status == ipopt.STOPPED:
        return StageSolution(found.Z, found.U)
    return StageSolution(found.Z, found.U, f"{found.status} after {found.iterations} iterations")


SOLVERS: dict[str, Solver] = {"own": _solve_own, "ipopt": _solve_with_ipopt}


def _calibrate(
    model: Model, objective: CompositeObjective, state: SearchState
) -> tuple[SearchState, CompositeObjective]:
    """Return state and objective with surrogates as far from what they stand for as at the state's motion."""
    ratio = composite_objective.surrogate_ratio(objective, model, state.motion)
    if ratio is None:
        return state, objective
    careful = _damped_ratio(ratio, state.surrogate_ratio)
    return replace(state, surrogate_ratio=careful), composite_objective.calibrate_surrogates(objective, careful)


def _damped_ratio(ratio: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Extrapolate half of a growth of the surrogate ratio and take half of a decline, in logarithms.

    This keeps successive designs from alternating.
    """
    if before is None:
        return ratio
    return np.asarray(np.where(ratio > before, ratio * np.sqrt(ratio / before), np.sqrt(ratio * before)))


def _direction_margins(
    tr: Transcription, nodes: np.ndarray, model: Model, problem: Problem, travel_direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return margins (K, J, n_g) above and below that keep the direction of travel at every node."""
    k = tr.limit_names.index(TRAVEL_LIMIT)
    (travel,) = (g for g in machine_limits(model, problem) if g.name == TRAVEL_LIMIT)
    shut = 1 - REST_SPEED / travel.high  # speeds that count as rest may have either sign
    above, below = np.zeros((2, *nodes.shape, len(tr.limit_names)))
    ahead = (
        travel_direction[
            np.clip(np.rint(nodes * float(model.machine.sampling_hz)).astype(int), 0, len(travel_direction) - 1)
        ]
        > 0
    )
    above[..., k], below[..., k] = np.where(ahead, 0, shut), np.where(ahead, shut, 0)
    return above, below


def evaluate_drive(
    model: Model, problem: Problem, objective: CompositeObjective, drive: Manoeuvre
) -> tuple[ScoredDrive, Motion]:
    """Simulate a drive afresh, place it on the lane and score it.

    Other machines of the objective follow its motion, and their limits count too, except lane and rest.
    """
    motion = simulate_on_lane(model, problem, drive.sample(float(model.machine.sampling_hz)))
    violations = check_limits(model, problem, motion)
    motions = [(model, motion), *((m, track_motion(m, model, motion)) for m in objective.machines[1:])]
    for m, other in motions[1:]:  # lane and rest are left to the driver
        for name, excess in check_limits(m, problem, other).items():
            if not is_free_limit(name):
                violations[name] = max(violations[name], excess)
    judged = composite_objective.score_motions(objective, motions)
    if objective.sigma_max is not None:
        violations[SIGMA_MAX] = max(0.0, judged.worst_percent / objective.sigma_max - 1)
    if objective.cond_max is not None:
        violations[COND_MAX] = max(0.0, objectives.cond_phi(model, motion) / objective.cond_max - 1)
    return ScoredDrive(drive, motion.q[0], judged.score, violations), motion
