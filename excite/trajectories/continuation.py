"""The continuation of a design: a drive carried from a smooth, coarse problem to the machine as it is.

Wide friction and slip transitions and far-apart torque knots first, where the problem is smooth, then ever closer to
the machine as it is. Every stage's answer is simulated afresh by the accurate integrator at the machine's sampling
rate; its score and its limits are those of that motion, never the optimiser's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import CollocationError, SimulationError
from excite.model import Model
from excite.model.machine import Machine, Problem
from excite.simulation import Motion, simulate, track_motion
from excite.trajectories import composite_objective as aims, interior_point, objective as _objective
from excite.trajectories.collocation import Transcription, settle, transcribe
from excite.trajectories.composite_objective import SIGMA_MAX, Aim
from excite.trajectories.excitation import Manoeuvre, knots, multisine, scaled
from excite.trajectories.limits import (
    REST_POSITION,
    REST_SPEED,
    TOLERANCE,
    TRAVEL,
    check_limits,
    directions,
    free,
    kept_between,
    lane_excess,
    machine_limits,
    of_lane,
    of_rest,
    placed,
    rest_tolerances,
    resting,
)

STUCK = 20.0  # half ranges in all that a program still exceeds: it is not going to keep its limits
MARGIN = 2e-3  # of half a range: what the program keeps from every limit


@dataclass(frozen=True)
class Stage:
    """One solve of the continuation: transitions and knots wider by these factors, and the levels that follow.

    Level i follows the objective with sharpness sharp 2^i at barrier / 3^i, and ends when the decrease that a Newton
    step promises is below `patience` / sharpness.
    """

    friction: float
    slip: float
    coarse: int
    sharp: float
    barrier: float
    levels: int
    iterations: int
    patience: float
    elements: int = 1

    def apart(self) -> list[Stage]:
        """Its levels as stages of their own: surrogates of variances are then calibrated before each."""
        return [
            replace(self, sharp=self.sharp * 2**i, barrier=self.barrier / 3**i, levels=1) for i in range(self.levels)
        ]


PLAN = (
    Stage(10, 3, 4, 8, 1e-3, 2, 40, 1.0),
    Stage(4, 1.7, 2, 16, 1e-4, 2, 30, 1.0),
    Stage(2, 1.2, 2, 40, 3e-5, 1, 30, 1.0),
    Stage(1, 1, 2, 60, 1e-5, 1, 30, 1.0),
    Stage(1, 1, 1, 100, 1e-5, 4, 30, 0.1),
)
SCOUTS = 3  # stages that every start goes through; the best third of the starts go on to the end
REPAIR = Stage(1, 1, 1, 800, 1e-6, 1, 30, 0.1, elements=3)
REFINE = Stage(1, 1, 1, 800, 1e-6, 1, 30, 0.1)
REPAIRS = 3  # of a drive whose fresh simulation exceeds a limit, at most, and one more for every machine it is for
MUCH = 0.05  # of a limit's range: exceeded by more, its ratio counts
REFINES = 5  # of an aim with a ceiling, at most
GAINED = 2e-3  # of the score by which another one is worth its time


Tell = Callable[["Track"], None]


@dataclass(frozen=True)
class Candidate:
    """A drive and the fresh simulation's verdict: torques at the knots, start coordinates (n_q,), score, violations."""

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
class Track:
    """How far one start has come, ready to be carried on.

    times (N,) [s] and states (N, n_z), scaled by `sizes`, are the last program's nodes, or the guess's samples and
    none yet. pose (n_q,): the start coordinates once the lane matters. best: the best candidate on the way.
    going (N,): the direction of travel at the machine's samples, +-1, where reversals are counted. optimism (n_base,):
    of the surrogates of variances, as the next stage corrects them.
    """

    number: int
    guess: float
    sizes: Mapping[str, float]
    latest: Candidate
    best: Candidate
    motion: Motion
    times: np.ndarray
    states: np.ndarray | None = None
    pose: np.ndarray | None = None
    going: np.ndarray | None = None
    optimism: np.ndarray | None = None
    complete: bool = False


def rank(c: Candidate) -> tuple[float, float]:
    """Feasible before infeasible, then by score, or by excess."""
    return (0.0, c.score) if c.feasible else (1.0, c.excess)


def promise(c: Candidate) -> float:
    """What a start may come to: its score, dearer by what it exceeds."""
    return c.score + min(1.0, c.excess)


def depart(model: Model, problem: Problem, aim: Aim, number: int, seed: int) -> Track:
    """A start: a random multisine, as large as the limits on the motion allow."""
    wish = multisine(model, problem, seed, top=0.5)
    for factor in 0.85 ** np.arange(60):
        drive = scaled(wish, float(factor))
        try:
            motion = simulate(model, drive.sample(float(model.machine.sampling_hz)))
        except SimulationError:
            continue
        if kept_between(check_limits(model, problem, motion)):
            break
    found, motion = verdict(model, problem, aim, drive)
    sizes = typical_sizes(model, problem, motion)
    going = None if problem.reversals is None else directions(motion, problem.reversals)
    return Track(number, _objective.cond_phi(model, motion), sizes, found, found, motion, motion.t, going=going)


def resume(model: Model, problem: Problem, aim: Aim, number: int, drive: Manoeuvre) -> Track:
    """A start from a drive that is there already, for the last stages. Raises SimulationError."""
    found, motion = verdict(model, problem, aim, drive)
    sizes = typical_sizes(model, problem, motion)
    going = None if problem.reversals is None else directions(motion, problem.reversals)
    pose = found.start if model.machine.planar and problem.lane_points else None
    score = _objective.cond_phi(model, motion)
    return Track(number, score, sizes, found, found, motion, motion.t, pose=pose, going=going)


def typical_sizes(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Typical size of every coordinate and velocity (c and c') in a motion, and of what effects remember; of the pose,
    half the lane."""
    sizes = {}
    for k, c in enumerate(model.coordinates):
        sizes[c] = max(1e-3, 2 * float(np.sqrt((motion.q[:, k] ** 2).mean())))
        sizes[c + "'"] = max(1e-3, 2 * float(np.sqrt((motion.nu[:, k] ** 2).mean())))
    for name, values in zip(model.memory, motion.memory.T, strict=True):
        sizes[name] = max(1e-3, 2 * float(np.sqrt((values**2).mean())))
    if model.machine.planar:
        x, y, heading = model.machine.body[0].coordinates
        sizes |= {x: problem.lane_m[0] / 2, y: problem.lane_m[1] / 2, heading: 1.0}
    return sizes


def search(
    model: Model,
    problem: Problem,
    aim: Aim,
    track: Track,
    plan: Sequence[Stage],
    over: Callable[[], bool],
    tell: Tell = lambda track: None,
) -> Track:
    """A track carried through the stages of a plan, until `over`; `tell` sees it after each."""
    if aim.sigma_max is not None:
        plan = [one for stage in plan for one in (stage.apart() if stage.friction == 1 else [stage])]
    for stage in plan:
        if over():
            break
        moved = _advance(model, problem, aim, track, stage, {}, over)
        if moved is None:
            break
        track = moved
        if track.pose is not None or (stage.friction <= 4 and lane_excess(track.latest.violations) > 0):
            track = replace(track, pose=track.latest.start)
        tell(track)
    return track


def refine(
    model: Model, problem: Problem, aim: Aim, track: Track, over: Callable[[], bool], tell: Tell = lambda track: None
) -> Track:
    """The same drive with its ceiling calibrated anew to the Cramer-Rao bound, as long as that helps."""
    if aim.sigma_max is None:
        return track
    for _ in range(REFINES):
        before = track.best
        if over():
            break
        track = _advance(model, problem, aim, track, REFINE, {}, over) or track
        tell(track)
        if before.feasible and track.latest.feasible and before.score - track.best.score < GAINED:
            break
    return track


def repair(model: Model, problem: Problem, aim: Aim, track: Track, over: Callable[[], bool]) -> Track:
    """The same drive with what the fresh simulation exceeds moved in, a few times at most.

    By what is exceeded; by its ratio where that is much, as for other machines, which need more torque and power for
    the same motion: a range can't be narrowed by more than itself.
    """
    margins: dict[str, float] = {}
    track = land(model, problem, aim, track, over)
    for _ in range(REPAIRS + len(aim.machines)):
        if track.latest.feasible or over():
            break
        for name, excess in track.latest.violations.items():
            if excess > 0.3 * TOLERANCE:
                old, more = margins.get(name, 0.0), min(3 * excess, excess + 0.01)
                margins[name] = old + more if more < MUCH else 0.5 - (0.5 - old) / (1 + 2 * more)
        track = replace(track, pose=track.latest.start) if track.pose is not None else track
        track = _advance(model, problem, aim, track, REPAIR, margins, over) or track
        track = land(model, problem, aim, track, over)
    return track


def land(model: Model, problem: Problem, aim: Aim, track: Track, over: Callable[[], bool]) -> Track:
    """The same drive with small smooth torques added that bring the fresh simulation to rest where it should end.

    What the forces integrate, a steered joint say, drifts in open loop by what the collocation neglects; Newton's
    method on the end of the motion, least in the share of the torque limits, takes that out. Kept where it helps.
    """
    rate = float(model.machine.sampling_hz)
    scale = np.array([float(b.limit.torque) if b.limit.torque is not None else 1.0 for b in model.machine.actuated])
    for _ in range(4):
        late = [name for name, v in track.latest.violations.items() if v > 0 and of_rest(name)]
        if not late or over():
            break
        drive, x0 = track.latest.manoeuvre, _end(model, track.motion)
        shapes = [
            shape[:, None] * scale * np.eye(len(scale))[k]
            for shape in _bumps(drive.times / drive.duration)
            for k in range(len(scale))
        ]
        step = 1e-3
        try:
            moved = [
                simulate(model, Manoeuvre(drive.times, drive.torque + step * s).sample(rate), q0=track.motion.q[0])
                for s in shapes
            ]
            J = np.column_stack([(_end(model, m) - x0) / step for m in moved])
            off = np.abs(x0) > 0.5  # what is at rest already needs no torque
            sizes = np.linalg.lstsq(J[off], -x0[off], rcond=1e-3)[0]
            added = sum((size * s for size, s in zip(sizes, shapes, strict=True)), np.zeros_like(drive.torque))
            found, motion = verdict(model, problem, aim, Manoeuvre(drive.times, drive.torque + added))
        except SimulationError:
            break
        if rank(found) >= rank(track.latest):
            break
        track = replace(track, latest=found, best=min(track.best, found, key=rank), motion=motion)
    return track


def _bumps(share: np.ndarray) -> list[np.ndarray]:
    """Smooth bumps (K,) in the second half of a drive, share (K,) of its duration."""
    return [
        np.where(np.abs(share - middle) < 0.1, np.cos(5 * np.pi * (share - middle)) ** 2, 0.0)
        for middle in (0.6, 0.75, 0.88)
    ]


def _end(model: Model, motion: Motion) -> np.ndarray:
    """What must be zero at the end of a motion, in its tolerances: coordinates that rest and velocities."""
    still = motion.q[-1, list(resting(model))] / REST_POSITION
    return np.concatenate([still, motion.nu[-1] / rest_tolerances(model)])


def _advance(
    model: Model,
    problem: Problem,
    aim: Aim,
    track: Track,
    stage: Stage,
    margins: Mapping[str, float],
    over: Callable[[], bool],
) -> Track | None:
    """One stage from where the track stands. None where no motion follows its torques."""
    wanted = aim
    if stage.friction == 1:
        seen = aims.optimism(aim, model, track.motion)
        if seen is not None:
            careful = _careful(seen, track.optimism)
            track, wanted = replace(track, optimism=careful), aims.calibrated(aim, careful)
    wanted = aims.lowered(wanted, margins.get(SIGMA_MAX, 0.0))
    times = knots(problem, stage.coarse)
    intervals = len(times) - 1
    softer = soften(model, stage.friction, stage.slip)
    tr = transcribe(
        softer,
        problem,
        track.sizes,
        intervals,
        track.motion,
        elements=stage.elements,
        with_pose=track.pose is not None,
        rest=rest_band(stage.friction),
        weights=aim.rows,
    )
    nodes = (np.arange(intervals)[:, None] + tr.place) * tr.knot
    U = track.latest.manoeuvre.at(times) / tr.torque_scale
    U[0] = U[-1] = 0.0
    start = np.zeros(tr.n_z)
    if track.pose is not None:
        for k, c in enumerate(tr.state_names):
            start[k] = track.pose[model.coordinates.index(c)] / tr.state_scale[k] if c in model.coordinates else 0.0
    fresh = track.states is None
    if track.states is None or track.states.shape[1] != tr.n_z:
        names = [*model.coordinates, *[c + "'" for c in model.coordinates], *model.memory]
        every = np.hstack([track.motion.q, track.motion.nu, track.motion.memory])
        columns = [every[:, names.index(c)] / size for c, size in zip(tr.state_names, tr.state_scale, strict=True)]
        Z = np.stack([np.interp(nodes, track.motion.t, x) for x in columns], axis=-1)
    else:
        Z = np.stack([np.interp(nodes, track.times, x) for x in track.states.T], axis=-1)
    moved_in = np.array([MARGIN + 2 * margins.get(name, 0.0) for name in tr.limit_names])
    task = interior_point.Task(
        wanted,
        np.tile(moved_in, (intervals, tr.nodes, 1)),
        np.tile([1e-4 + 2 * margins.get(name, 0.0) for name in tr.control_names], (intervals, 1)),
        np.array([of_lane(name) for name in tr.limit_names], bool),
    )
    if track.going is not None and TRAVEL in tr.limit_names:
        above, below = _one_way(tr, nodes, model, problem, track.going)
        task = replace(task, above=above, below=below)

    try:
        Z = settle(tr, start, U, Z)
    except CollocationError:
        return None
    sharp = [stage.sharp * 2**i for i in range(stage.levels)]
    levels = tuple(
        interior_point.Level(p, stage.barrier / 3**i, stage.patience / p, stage.iterations) for i, p in enumerate(sharp)
    )
    kept = not fresh
    try:
        if kept:
            point = interior_point.begin(tr, task, start, Z, U, stage.barrier, 1e-3)
            point, state = interior_point.minimise(tr, task, point, levels, over)
            kept = interior_point.infeasibility(state, point) < STUCK
        if not kept:  # by way of the nearest torques that keep every limit and come to rest
            near = replace(task, aim=None, pull=1.0, goal=U)
            point = interior_point.begin(tr, near, start, Z, U, 1e-3, 0.05)
            point, _ = interior_point.minimise(tr, near, point, (interior_point.Level(1.0, 1e-3, 1e-3, 40),), over)
            point = interior_point.begin(tr, task, point.start, point.Z, point.U, max(stage.barrier, 1e-4), 0.05)
            point, _ = interior_point.minimise(tr, task, point, levels, over)
    except np.linalg.LinAlgError:  # the information is singular: the machine hardly moves
        return None
    try:
        found, motion = verdict(model, problem, aim, Manoeuvre(times, point.U * tr.torque_scale))
    except SimulationError:
        return None
    return replace(
        track,
        latest=found,
        best=min(track.best, found, key=rank),
        motion=motion,
        times=nodes.ravel(),
        states=point.Z.reshape(-1, tr.n_z),
    )


def _careful(seen: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """The optimism to correct for, where `before` was corrected for and this is seen: half of a growth is expected
    again, half of a decline is believed. Drives would go back and forth otherwise."""
    if before is None:
        return seen
    return np.asarray(np.where(seen > before, seen * np.sqrt(seen / before), np.sqrt(seen * before)))


def _one_way(
    tr: Transcription, nodes: np.ndarray, model: Model, problem: Problem, going: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What moves the upper and the lower bound of the forward speed in (K, J, n_g), so that it keeps its direction."""
    k = tr.limit_names.index(TRAVEL)
    (travel,) = (g for g in machine_limits(model, problem) if g.name == TRAVEL)
    shut = 1 - REST_SPEED / travel.high  # what counts as at rest may go either way
    above, below = np.zeros((2, *nodes.shape, len(tr.limit_names)))
    ahead = going[np.clip(np.rint(nodes * float(model.machine.sampling_hz)).astype(int), 0, len(going) - 1)] > 0
    above[..., k], below[..., k] = np.where(ahead, 0, shut), np.where(ahead, shut, 0)
    return above, below


def verdict(model: Model, problem: Problem, aim: Aim, drive: Manoeuvre) -> tuple[Candidate, Motion]:
    """The fresh simulation of a drive, placed on the lane as well as can be; other machines that the aim is for follow
    its motion, and their limits count too."""
    torque = drive.sample(float(model.machine.sampling_hz))
    motion = simulate(model, torque)
    start = placed(model, problem, motion)
    if not np.array_equal(start, motion.q[0]):
        motion = simulate(model, torque, q0=start)
    violations = check_limits(model, problem, motion)
    motions = [(model, motion), *((m, track_motion(m, model, motion)) for m in aim.machines[1:])]
    for m, other in motions[1:]:  # what people see to themselves, where the machine goes, is left out
        for name, excess in check_limits(m, problem, other).items():
            if not free(name):
                violations[name] = max(violations[name], excess)
    judged = aims.judge(aim, motions)
    if aim.sigma_max is not None:
        violations[SIGMA_MAX] = max(0.0, judged.worst_percent / aim.sigma_max - 1)
    return Candidate(drive, start, judged.score, violations), motion


def rest_band(friction: float) -> float:
    """How many times wider than usual the band is that counts as rest, for a machine of that friction.

    Near standstill a soft machine's friction only damps, so what it is left with when the torques end grows with the
    width of the transition. No verdict is spoken on it, so it need not leave that much of the tolerance unused: 2.
    """
    return 2 * friction if friction > 1 else 1.0


def soften(model: Model, friction: float, slip: float) -> Model:
    """The same model with transitions of friction and slip at standstill wider by these factors."""
    if friction == 1 and slip == 1:
        return model
    bodies = []
    for body in model.machine.body:
        changed: dict[str, object] = {}
        if body.friction is not None:
            wider = body.friction.smoothing.model_copy(update={"value": friction * float(body.friction.smoothing)})
            changed["friction"] = body.friction.model_copy(update={"smoothing": wider})
        if body.contact is not None:
            wider = body.contact.v_eps.model_copy(update={"value": slip * float(body.contact.v_eps)})
            changed["contact"] = body.contact.model_copy(update={"v_eps": wider})
        bodies.append(body.model_copy(update=changed))
    machine: Machine = model.machine.model_copy(update={"body": tuple(bodies)})
    return replace(model.for_machine(machine), nominal=model.nominal, scale=model.scale)
