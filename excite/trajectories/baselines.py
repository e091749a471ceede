"""Comparison of a designed drive with usual ones: same machine, problem, limits and time.

Usual drives ignore the limits on the motion, so all are brought inside them in the same way:

1. Scale the torques down until every limit but rest and lane holds, the contacts' first, then the others'.
2. Find the nearest drive that keeps every limit (`interior_point`, least squares in shares of the torque limits), with
   softer friction at first.
3. Bring it to rest with small smooth torques (`continuation.bring_to_rest`).

These steps never use the score. A drive that still exceeds a limit by more than `limits.TOLERANCE` of its range is
reported with that limit. Fourier series (0.05 to 0.3 Hz; Swevers et al., 1997) are optimised for as long as the design
took, then treated in the same way. Work is shared among all processes; one optimisation uses one of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType

import casadi as ca
import joblib
import numpy as np
import scipy

from excite.errors import CollocationError, SimulationError
from excite.model import Model, mechanics
from excite.model.machine import Body, Problem
from excite.simulation import Motion, follow, left_turn_sign, simulate
from excite.trajectories import excitation, interior_point, objective
from excite.trajectories.collocation import (
    rest_band_factor,
    solve_states,
    transcribe,
    widen_transitions,
)
from excite.trajectories.composite_objective import compose_objective
from excite.trajectories.continuation import (
    LIMIT_MARGIN,
    ScoredDrive,
    SearchState,
    bring_to_rest,
    evaluate_drive,
    typical_sizes,
)
from excite.trajectories.excitation import FADE, Manoeuvre, scale_torques
from excite.trajectories.limits import (
    TOLERANCE,
    check_limits,
    is_lane_limit,
    keeps_motion_limits,
    lane_excess,
    machine_limits,
    sample_symbols,
)
from excite.trajectories.multistart import design, process_count
from excite.trajectories.scoring import Score, score

SLOW_TOP = 0.08  # Hz, highest frequency of slow multisines; chosen
SCALE_STEP = 0.9  # ratio of successive torque scales; chosen
MAX_ATTEMPTS = 4  # attempts at the nearest feasible drive; chosen
# Factors on the transitions of friction and of slip and on the knot spacing, in the first attempt; chosen. With sharp
# transitions, Newton's method is slow while the drive ends far from rest.
CONTINUATION = ((10.0, 3.0, 2), (3.0, 1.5, 1), (1.0, 1.0, 1))
FUNDAMENTAL = 0.05  # Hz, of the Fourier series; one period in 20 s; chosen
HARMONICS = 6  # of the Fourier series, up to 0.3 Hz; chosen
FINITE_DIFFERENCE = 1e-4  # step of a Fourier coefficient, well above the integrator's error; chosen
DESIGNED = "designed"  # name of the design's row

Make = Callable[[Model, Problem, int, float], Manoeuvre]
Progress = Callable[[int, int, float], None]


@dataclass(frozen=True)
class Baseline:
    """A usual drive: make(model, problem, seed, seconds it may search). random: worth several samples."""

    make: Make
    random: bool = False


@dataclass(frozen=True)
class ComparisonRow:
    """One drive of the comparison, scored on a fresh simulation from `start` (n_q,).

    worst_std_percent, median_std_percent: of the Cramer-Rao bound, kit `full`. breaks: the limit exceeded by more than
    the tolerance, or None. kept, samples: drives of this kind that keep every limit, out of all. wall_s [s]: for all of
    them, in parallel. equal_s [s]: until a feasible one reaches the design's cond(Phi), None if none does.
    own: True for a drive of the user's own.
    """

    name: str
    manoeuvre: Manoeuvre
    start: np.ndarray
    cond_phi: float
    cond_w: float
    worst_std_percent: float
    median_std_percent: float
    max_violation: float
    breaks: str | None
    kept: int
    samples: int
    wall_s: float
    equal_s: float | None
    own: bool = False


@dataclass(frozen=True)
class Comparison:
    """Rows, the design first.

    ratio_equal_time: lowest cond(Phi) of the usual drives that keep every limit within the design's time, over the
    design's; inf if there is none.
    """

    rows: tuple[ComparisonRow, ...]
    ratio_equal_time: float


@dataclass(frozen=True)
class _BaselineDrive:
    kind: str
    number: int
    found: ScoredDrive
    wall_s: float


# ------------------------------------------------------------------------------------------------ the usual drives


def multisine(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """Random multisine, 0.05 to 1 Hz."""
    return excitation.multisine(model, problem, seed)


def slow_multisine(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """Random multisine, 0.05 to 0.08 Hz: long pushes, so higher speeds and wider turns."""
    return excitation.multisine(model, problem, seed, top=SLOW_TOP)


def steps(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """Pseudo-random steps."""
    return excitation.steps(model, problem, seed)


def chirp(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """A sine sweep on every input, at random phases."""
    return excitation.chirp(model, problem, seed)


def hand_made(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """A driver's test drive: four legs forward and back at several speeds, each with a left and a right turn.

    The torques are those of the driver model. Joints that steer from both ends turn against each other; a machine
    without steered joints has its sides driven apart. Machines without driven contacts sweep joints over two thirds of
    their range.
    """
    times = excitation.knot_times(problem)
    rate = float(model.machine.sampling_hz)
    t = np.arange(round(times[-1] * rate) + 1) / rate
    share = t / times[-1]
    legs = ((1.0, 0.02, 0.25), (-1.0, 0.27, 0.50), (1.5, 0.52, 0.70), (-1.2, 0.72, 0.92))
    speed, turn = np.zeros_like(t), np.zeros_like(t)
    for fast, begin, end in legs:
        at = (share - begin) / (end - begin)
        speed += fast * np.interp(at, [0, 0.2, 0.8, 1], [0, 1, 1, 0])
        turn += np.interp(at, [0.1, 0.25, 0.4, 0.6, 0.75, 0.9], [0, 1, 1, -1, -1, 0]) * ((at > 0) & (at < 1))
    joints = [b for b in model.machine.actuated if b.contact is None]
    wide = [b.limit.reach or 0.5 for b in joints]
    ways = _left_turn_signs(model, joints)
    angles = np.column_stack([2 / 3 * w * s * turn for w, s in zip(wide, ways, strict=True)] or [np.zeros((len(t), 0))])
    driven = follow(model, speed, angles, seed=seed)
    u = np.column_stack([np.interp(times, t, x) for x in driven.u.T])
    if not joints:
        u += np.interp(times, t, turn)[:, None] * _side_torques(model)
    u[0] = u[-1] = 0.0
    return Manoeuvre(times, u)


def _left_turn_signs(model: Model, joints: Sequence[Body]) -> list[int]:
    """Return the sign of each joint's turn in forward travel, relative to the first: 1 or -1."""
    if len(joints) < 2 or sum(s.startswith("gy") for s in model.slips) < 2:
        return [1] * len(joints)
    ways = [left_turn_sign(model, b) for b in joints]
    return [ways[0] * way for way in ways]


def _side_torques(model: Model) -> np.ndarray:
    """Return torques (n_u,) that turn the machine left by driving its sides apart, a quarter of the limits."""
    if not model.machine.planar:
        return np.zeros(len(model.inputs))
    poses = mechanics.body_poses(model.machine, {})
    left = np.array([np.sign(poses[b.index][1][1].round(6)) for b in model.machine.actuated])
    top = [float(b.limit.torque) if b.limit.torque is not None else 0.0 for b in model.machine.actuated]
    return -left * np.array(top) / 4


def fourier_slsqp(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """A Fourier series on every input, optimised by SLSQP with finite differences: log cond(Phi) within the limits.

    Returns the best drive when SLSQP converges or time is up.
    """
    search = _FourierSearch(model, problem, seed, seconds)
    return search.run(
        lambda: scipy.optimize.fmin_slsqp(
            search.score,
            search.start,
            f_ieqcons=search.room,
            epsilon=FINITE_DIFFERENCE,
            iter=10_000,
            acc=1e-4,
            iprint=-1,
        )
    )


def fourier_evolution(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """The same series by differential evolution (scipy), limits as penalties."""
    search = _FourierSearch(model, problem, seed, seconds)

    def penalised(x: np.ndarray) -> float:
        score, room = search(x)
        return score - 20 * float(np.minimum(room, 0).sum())

    return search.run(
        lambda: scipy.optimize.differential_evolution(
            penalised,
            scipy.optimize.Bounds(np.full(len(search.start), -3.0), np.full(len(search.start), 3.0)),
            x0=search.start,
            init=search.start + 0.5 * np.random.default_rng(seed).standard_normal((40, len(search.start))),
            rng=seed,
            maxiter=100_000,
            tol=0.0,
            polish=False,
        )
    )


BASELINES: dict[str, Baseline] = {
    "Fourier SLSQP": Baseline(fourier_slsqp),
    "Fourier differential evolution": Baseline(fourier_evolution),
    "multisine": Baseline(multisine, random=True),
    "slow multisine": Baseline(slow_multisine, random=True),
    "random steps": Baseline(steps, random=True),
    "chirp": Baseline(chirp, random=True),
    "hand-made": Baseline(hand_made),
}


class _TimeUp(Exception):
    pass


class _FourierSearch:
    """Evaluate Fourier coefficients x: log cond(Phi) and the distance (n_g,) to each limit, in half ranges.

    Keeps the best x and raises _TimeUp when time is up.
    """

    def __init__(self, model: Model, problem: Problem, seed: int, seconds: float) -> None:
        self._model, self._deadline = model, time.monotonic() + seconds
        self._times = excitation.knot_times(problem)
        phase = 2 * np.pi * FUNDAMENTAL * np.outer(self._times, np.arange(1, HARMONICS + 1))
        fade = np.clip(np.minimum(self._times, self._times[-1] - self._times) / FADE, 0, 1)
        self._waves = np.hstack([np.sin(phase), np.cos(phase)]) * fade[:, None]
        self._size = np.ones(len(model.inputs))
        every = [g for g in machine_limits(model, problem) if not is_lane_limit(g.name)]
        s = sample_symbols(model)
        room = [1 - ca.fabs(g.expression(s.q, s.nu, s.u, s.du) - g.centre) * (2 / g.range) for g in every]
        self._room = ca.Function("room", [s.q, s.nu, s.u, s.du], [ca.vertcat(*room)])
        self._known: dict[bytes, tuple[float, np.ndarray]] = {}
        # Coefficients of about one for torques as large as the limits allow
        self.start = np.random.default_rng(seed).uniform(-1, 1, self._waves.shape[1] * len(model.inputs))
        target = self._drive(self.start)
        self._size = np.abs(target.torque).max(axis=0)
        torque = [float(b.limit.torque) if b.limit.torque is not None else 1.0 for b in model.machine.actuated]
        full = scale_torques(target, np.array(torque) / self._size)
        kept = scale_into_limits(model, problem, full)
        self._size = np.abs(kept.torque).max(axis=0) / self._size
        self.best, self._rank = self.start, (1.0, np.inf)

    def _drive(self, x: np.ndarray) -> Manoeuvre:
        return Manoeuvre(self._times, self._waves @ x.reshape(self._waves.shape[1], -1) * self._size)

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        if time.monotonic() > self._deadline:
            raise _TimeUp
        key = np.asarray(x, float).tobytes()
        if key not in self._known:
            self._known[key] = self._evaluate(np.asarray(x, float))
        return self._known[key]

    def score(self, x: np.ndarray) -> float:
        return self(x)[0]

    def room(self, x: np.ndarray) -> np.ndarray:
        return self(x)[1]

    def _evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            m = simulate(self._model, self._drive(x).sample(float(self._model.machine.sampling_hz)))
        except SimulationError:
            return 50.0, np.full(self._room.numel_out(0), -10.0)
        du = np.diff(m.u, axis=0, append=m.u[-1:]) / (m.t[1] - m.t[0])
        room = self._room(m.q.T, m.nu.T, m.u.T, du.T).full().min(axis=1)
        score = float(np.log(objective.cond_phi(self._model, m)))
        outside = float(-np.minimum(room, 0).sum())
        rank = (0.0, score) if outside < 2 * TOLERANCE else (1.0, outside)
        if rank < self._rank:
            self.best, self._rank = x.copy(), rank
        return score, room

    def run(self, optimise: Callable[[], object]) -> Manoeuvre:
        with suppress(_TimeUp):
            optimise()
        return self._drive(self.best)


# ------------------------------------------------------------------------------------------------ inside the limits


def scale_into_limits(model: Model, problem: Problem, target: Manoeuvre) -> Manoeuvre:
    """Scale a drive down until every limit but rest and lane holds: the contacts first, then the others."""
    pulling = np.array([b.contact is not None for b in model.machine.actuated])
    groups = [g for g in (pulling, ~pulling) if g.any()]
    factor = np.zeros(len(pulling))

    def holds() -> bool:
        try:
            motion = simulate(model, scale_torques(target, factor).sample(float(model.machine.sampling_hz)))
        except SimulationError:
            return False
        return keeps_motion_limits(check_limits(model, problem, motion))

    for left, group in enumerate(groups, 1 - len(groups)):
        low, high = 0, 50
        while low < high:
            middle = min(2 * low + 1, (low + high) // 2)  # most drives are only a little outside
            factor[group] = SCALE_STEP**middle
            low, high = (low, middle) if holds() else (middle + 1, high)
        factor[group] = SCALE_STEP ** (high + (left < 0))  # leave room for the other group
    return scale_torques(target, factor)


def bring_within_limits(model: Model, problem: Problem, target: Manoeuvre) -> ScoredDrive:
    """Bring a drive inside every limit (see the module); else return the one with the least excess."""
    small = scale_into_limits(model, problem, target)
    found, motion = score_drive(model, problem, small)
    state = SearchState(
        0, found.manoeuvre, found.score, typical_sizes(model, problem, motion), found, found, motion, motion.t
    )
    margins: dict[str, float] = {}
    least = found
    for attempt in range(MAX_ATTEMPTS):
        if state.latest.feasible:
            break
        moved = _nearest_feasible(model, problem, state, small, margins, attempt)
        if moved is None:
            break
        state = bring_to_rest(model, problem, compose_objective(model, "cond"), moved, lambda: False)
        least = min(least, state.latest, key=lambda c: c.excess)
        for name, excess in state.latest.violations.items():
            if excess > 0.3 * TOLERANCE:
                margins[name] = margins.get(name, 0.0) + min(0.05, 3 * excess)
    return least


def score_drive(model: Model, problem: Problem, drive: Manoeuvre) -> tuple[ScoredDrive, Motion]:
    """Simulate, place and score a drive by cond, as a design is."""
    return evaluate_drive(model, problem, compose_objective(model, "cond"), drive)


def _nearest_feasible(
    model: Model, problem: Problem, state: SearchState, target: Manoeuvre, margins: dict[str, float], attempt: int
) -> SearchState | None:
    """Find the drive nearest to `target` that keeps every limit, moved in by `margins` (shares of the ranges).

    The first attempt runs the whole CONTINUATION, later ones only its end with finer collocation. Returns None if no
    motion follows the torques.
    """
    with_pose = model.machine.planar and (state.start_pose is not None or lane_excess(state.latest.violations) > 0)
    times, known = excitation.knot_times(problem), state.motion.t
    names = [*model.coordinates, *[c + "'" for c in model.coordinates], *model.memory]
    every = dict(zip(names, np.hstack([state.motion.q, state.motion.nu, state.motion.memory]).T, strict=True))
    moved = Manoeuvre(times, state.latest.manoeuvre.at(times) - target.at(times))
    node_states: np.ndarray | None = None
    for friction, slip, coarse in CONTINUATION if attempt == 0 else CONTINUATION[-1:]:
        at = excitation.knot_times(problem, coarse)
        tr = transcribe(
            widen_transitions(model, friction, slip),
            problem,
            state.state_sizes,
            len(at) - 1,
            state.motion,
            elements=1 if attempt == 0 else 3,
            with_pose=with_pose,
            rest_factor=rest_band_factor(friction),
            weights=np.empty((0, len(model.coordinates))),  # without information
        )
        if node_states is None:
            node_states = np.column_stack(
                [every[c] / size for c, size in zip(tr.state_names, tr.state_scale, strict=True)]
            )
            start = node_states[0]
        nodes = ((np.arange(tr.intervals)[:, None] + tr.node_position) * tr.interval_s).ravel()
        goal, change = (d.at(at) / tr.torque_scale for d in (target, moved))
        U = goal + change
        U[0] = U[-1] = goal[0] = goal[-1] = 0.0
        Z = np.column_stack([np.interp(nodes, known, x) for x in node_states.T]).reshape(tr.intervals, tr.nodes, tr.n_z)
        moved_in = np.array([LIMIT_MARGIN + 2 * margins.get(name, 0.0) for name in tr.limit_names])
        task = interior_point.Subproblem(
            None,
            np.tile(moved_in, (tr.intervals, tr.nodes, 1)),
            np.tile([1e-4 + 2 * margins.get(name, 0.0) for name in tr.torque_limit_names], (tr.intervals, 1)),
            np.array([is_lane_limit(name) for name in tr.limit_names], bool),
            (len(times) - 1) / tr.intervals,  # knots per interval, so that the distance keeps its weight
            goal,
        )
        levels = (interior_point.BarrierLevel(1.0, 1e-3, 1e-2, 40), interior_point.BarrierLevel(1.0, 1e-4, 1e-3, 20))
        try:
            point = interior_point.initial_iterate(tr, task, start, solve_states(tr, start, U, Z), U, 1e-3, 0.05)
            point, _ = interior_point.minimise(tr, task, point, levels if friction == 1 else levels[:1])
        except CollocationError:
            if friction == 1:
                return None
            continue  # the sharp machine may succeed without this step
        known, node_states, start = nodes, point.Z.reshape(-1, tr.n_z), point.start
        moved = Manoeuvre(at, (point.U - goal) * tr.torque_scale)
    try:
        found, motion = score_drive(model, problem, Manoeuvre(at, point.U * tr.torque_scale))
    except SimulationError:
        return None
    start_pose = found.start if with_pose else None
    return replace(state, latest=found, best=found, motion=motion, start_pose=start_pose)


# ------------------------------------------------------------------------------------------------ the comparison


def compare(
    model: Model,
    problem: Problem,
    samples: int = 20,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Progress | None = None,
    baselines: Sequence[str] = (),
    own: Mapping[str, Score] = MappingProxyType({}),
) -> Comparison:
    """Compare a designed drive with usual ones on one problem.

    samples: drives of every random kind.
    budget_s [s]: time of the design; optimised usual drives get as long as it took.
    progress(done, total, lowest cond(Phi) so far).
    baselines: names in BASELINES, all by default if there is no drive of one's own.
    own: scores by name of drives to set beside them, as they are.

    Raises InfeasibleError if the design finds no drive, KeyError for an unknown name, KeyboardInterrupt on Ctrl-C.
    """
    baselines = tuple(dict.fromkeys(baselines)) or (() if own else tuple(BASELINES))
    for name in baselines:
        if name not in BASELINES:
            raise KeyError(f"no usual drive {name}, allowed: {', '.join(BASELINES)}")
    jobs = [(name, k) for name in baselines for k in range(samples if BASELINES[name].random else 1)]
    total = len(jobs) + 1
    begin = time.monotonic()
    designed = design(model, problem, seed=seed, budget_s=budget_s)
    wall = time.monotonic() - begin
    if not designed.complete and (budget_s is None or wall < budget_s):
        raise KeyboardInterrupt  # an interrupted design would make the comparison misleading
    best = ScoredDrive(
        designed.manoeuvre, designed.motion.q[0], 2 * float(np.log(designed.cond_phi)), designed.violations
    )
    rows = [_judged_row(DESIGNED, best.manoeuvre, _judge(model, problem, best), 1, 1, wall, wall)]
    rows += [_own_row(name, found) for name, found in own.items()]
    lowest = designed.cond_phi
    if progress is not None:
        progress(1, total, lowest)
    seeds = np.random.SeedSequence(seed).generate_state(max(samples, 1))
    with joblib.parallel_config("loky", inner_max_num_threads=1):
        run = joblib.Parallel(n_jobs=process_count(), return_as="generator_unordered")
        call = joblib.delayed(_make_drive)
        found: list[_BaselineDrive] = []
        for done, one in enumerate(
            run(call(model, problem, n, BASELINES[n], k, int(seeds[k]), wall) for n, k in jobs), 2
        ):
            found.append(one)
            if one.found.feasible:
                lowest = min(lowest, objective.reported_value("cond", one.found.score))
            if progress is not None:
                progress(done, total, lowest)
    found.sort(key=lambda s: s.number)
    in_time = [np.inf]
    for name in baselines:
        rows += _rows(model, problem, name, [s for s in found if s.kind == name], designed.cond_phi)
        in_time += _scores_in_time([s for s in found if s.kind == name], wall)
    return Comparison(tuple(rows), min(in_time) / designed.cond_phi)


def _make_drive(
    model: Model, problem: Problem, kind: str, baseline: Baseline, number: int, seed: int, seconds: float
) -> _BaselineDrive:
    begin = time.monotonic()
    found = bring_within_limits(model, problem, baseline.make(model, problem, seed, seconds))
    return _BaselineDrive(kind, number, found, time.monotonic() - begin)


def _drive_rank(s: _BaselineDrive) -> tuple[bool, float]:
    return not s.found.feasible, s.found.score if s.found.feasible else s.found.excess


def _scores_in_time(samples: Sequence[_BaselineDrive], seconds: float) -> list[float]:
    """Return cond(Phi) of feasible drives among those made in the given time [s]; the first always counts."""
    used = np.cumsum([s.wall_s for s in samples]) / process_count()
    return [
        objective.reported_value("cond", s.found.score)
        for k, (s, t) in enumerate(zip(samples, used, strict=True))
        if s.found.feasible and (k == 0 or t <= seconds)
    ]


def _time_to_equal_score(samples: Sequence[_BaselineDrive], cond_phi: float) -> float | None:
    """Return the time [s] until one of these drives reaches cond_phi, made one after another; else None."""
    used = np.cumsum([s.wall_s for s in samples]) / min(process_count(), len(samples))
    for s, t in zip(samples, used, strict=True):
        if s.found.feasible and objective.reported_value("cond", s.found.score) <= cond_phi:
            return float(t)
    return None


def _rows(
    model: Model, problem: Problem, name: str, samples: Sequence[_BaselineDrive], designed: float
) -> list[ComparisonRow]:
    """Return the row of a kind, or the best and the median of a random kind."""
    ranked, n = sorted(samples, key=_drive_rank), len(samples)
    kept, wall = sum(s.found.feasible for s in samples), sum(s.wall_s for s in samples) / min(process_count(), n)
    equal = _time_to_equal_score(samples, designed)
    shown = {f"{name}, best of {n}": ranked[0].found, f"{name}, median of {n}": ranked[(n - 1) // 2].found}
    return [
        _judged_row(called, c.manoeuvre, _judge(model, problem, c), kept, n, wall, equal)
        for called, c in (shown if BASELINES[name].random else {name: ranked[0].found}).items()
    ]


def _judge(model: Model, problem: Problem, c: ScoredDrive) -> Score:
    return score(model, problem, c.manoeuvre.sample(float(model.machine.sampling_hz)), c.start)


def _own_row(name: str, judged: Score) -> ComparisonRow:
    kept = int(judged.max_violation <= TOLERANCE)
    row = _judged_row(name, Manoeuvre(judged.motion.t, judged.motion.u), judged, kept, 1, 0.0, None)
    return replace(row, own=True)


def _judged_row(
    name: str, drive: Manoeuvre, judged: Score, kept: int, samples: int, wall_s: float, equal_s: float | None
) -> ComparisonRow:
    over = judged.violations
    return ComparisonRow(
        name,
        drive,
        judged.motion.q[0],
        judged.cond_phi,
        judged.cond_w,
        judged.worst_percent,
        judged.median_percent,
        judged.max_violation,
        max(over, key=lambda limit: over[limit]) if judged.max_violation > TOLERANCE else None,
        kept,
        samples,
        wall_s,
        equal_s,
    )
