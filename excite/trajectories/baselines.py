"""A designed drive against the usual ones: same machine, problem, limits and time.

The usual drives know nothing of the limits on the motion, so each is brought inside them in the same way. It is scaled
down until every limit but rest and lane holds, first the torques of the contacts alone, then the others with them. Rest
at the end and the lane are then met by the nearest drive that keeps every limit (`interior`, no aim, least squares
distance in the share of the torque limits, by way of a machine that is softer at standstill), and small smooth torques
land it (`continuation.land`). This moves a drive as little as can be and never looks at the score. A drive that still
exceeds a limit by more than `limit.TOLERANCE` of its range is reported with the limit that it breaks.

Fourier series (0.05 to 0.3 Hz; Swevers et al., 1997) are searched, from a random one scaled down like that, for the
time that the design took, with rest and lane left to the same treatment afterwards. All work runs in as many processes
as the design had; one search uses one of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import joblib
import numpy as np
import scipy

from excite import smoothing
from excite.errors import CollocationError, SimulationError
from excite.model import Model, mechanics
from excite.model.machine import Body, Problem
from excite.simulation import Motion, follow, left_turn_sign, simulate
from excite.trajectories import excitation, interior_point, objective
from excite.trajectories.collocation import settle, transcribe
from excite.trajectories.composite_objective import aim
from excite.trajectories.continuation import MARGIN, Candidate, Track, land, rest_band, soften, typical_sizes, verdict
from excite.trajectories.excitation import Manoeuvre, scaled
from excite.trajectories.limits import (
    TOLERANCE,
    check_limits,
    kept_between,
    lane_excess,
    machine_limits,
    of_lane,
    symbols,
)
from excite.trajectories.multistart import design, processes

SLOW = 0.08  # Hz, top of the band of slow multisines
SHRINK = 0.9  # from one scale that is tried to the next
ATTEMPTS = 4  # at the nearest drive that keeps every limit
# The way to the first of them: transitions of friction and slip wider, and knots further apart, by these factors. With
# sharp ones Newton's method creeps for as long as rest at the end is far.
WAY = ((10.0, 3.0, 2), (3.0, 1.5, 1), (1.0, 1.0, 1))
FUNDAMENTAL, HARMONICS = 0.05, 6  # of the Fourier series [Hz]
DIFFERENCE = 1e-4  # of a coefficient, for finite differences: well above the integrator's error
OURS = "designed"

Make = Callable[[Model, Problem, int, float], Manoeuvre]
Progress = Callable[[int, int, float], None]


@dataclass(frozen=True)
class Usual:
    """A usual way to a drive: make(model, problem, seed, seconds it may search); `random`: worth many samples."""

    make: Make
    random: bool = False


@dataclass(frozen=True)
class Row:
    """One drive of the comparison, scored on its fresh simulation from `start` (n_q,).

    worst_std_percent, median_std_percent: of the Cramer-Rao bound, kit `full`. breaks: the limit that is exceeded by
    more than the tolerance, None where every one is kept. kept, samples: how many drives of this kind kept every limit,
    out of how many. wall_s [s]: for all of them, in the processes there are. equal_s [s]: until one of this kind has
    the designed drive's cond(Phi) within the limits, None where none got there in wall_s.
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


@dataclass(frozen=True)
class Comparison:
    """Rows, the designed drive first, and how many times lower its cond(Phi) is than the lowest of the usual drives
    that keep every limit and were had within its time (inf where there is none)."""

    rows: tuple[Row, ...]
    ratio_equal_time: float


@dataclass(frozen=True)
class _Sample:
    kind: str
    number: int
    found: Candidate
    wall_s: float


# ------------------------------------------------------------------------------------------------ the usual drives


def multisine(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """Random multisine, 0.05 to 1 Hz."""
    return excitation.multisine(model, problem, seed)


def slow_multisine(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """Random multisine, 0.05 to 0.08 Hz: long pushes, so higher speeds and wider turns."""
    return excitation.multisine(model, problem, seed, top=SLOW)


def steps(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """Pseudo-random steps."""
    return excitation.steps(model, problem, seed)


def chirp(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """A sine sweep on every input, at random phases."""
    return excitation.chirp(model, problem, seed)


def hand_made(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """What an engineer asks a driver for: four legs forward and back at several speeds, each with a turn to the left
    and to the right, braking at its end; the torques of the driver model at the knots.

    Joints that steer from both ends turn against each other; a machine that has none to steer with has its sides driven
    at different torques. Machines without driven contacts get the joints swept to two thirds of their range instead.
    """
    times = excitation.knots(problem)
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
    wide = [float(b.limit.position) if b.limit.position is not None else 0.5 for b in joints]
    ways = _leftward(model, joints)
    angles = np.column_stack([2 / 3 * w * s * turn for w, s in zip(wide, ways, strict=True)] or [np.zeros((len(t), 0))])
    driven = follow(model, speed, angles, seed=seed)
    u = np.column_stack([np.interp(times, t, x) for x in driven.u.T])
    if not joints:
        u += np.interp(times, t, turn)[:, None] * _sides(model)
    u[0] = u[-1] = 0.0
    return Manoeuvre(times, u)


def _leftward(model: Model, joints: Sequence[Body]) -> list[int]:
    """Which way each joint turns the machine when it goes forward, against the first one's: 1 the same way, -1 the
    other."""
    if len(joints) < 2 or sum(s.startswith("gy") for s in model.slips) < 2:
        return [1] * len(joints)
    ways = [left_turn_sign(model, b) for b in joints]
    return [ways[0] * way for way in ways]


def _sides(model: Model) -> np.ndarray:
    """(n_u,) torques that turn a machine to the left by driving its sides apart: a quarter of what the drives have."""
    if not model.machine.planar:
        return np.zeros(len(model.inputs))
    poses = mechanics.body_poses(model.machine, {})
    left = np.array([np.sign(poses[b.index][1][1].round(6)) for b in model.machine.actuated])
    top = [float(b.limit.torque) if b.limit.torque is not None else 0.0 for b in model.machine.actuated]
    return -left * np.array(top) / 4


def fourier_slsqp(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """A Fourier series on every input, its coefficients by SLSQP with finite differences: least log cond(Phi) within
    the limits on the motion. Ends at its optimum or when the time is over, with the best so far."""
    search = _Search(model, problem, seed, seconds)
    return search.run(
        lambda: scipy.optimize.fmin_slsqp(
            search.score,
            search.start,
            f_ieqcons=search.room,
            epsilon=DIFFERENCE,
            iter=10_000,
            acc=1e-4,
            iprint=-1,
        )
    )


def fourier_evolution(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """The same series by differential evolution (scipy), limits as penalties."""
    search = _Search(model, problem, seed, seconds)

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


USUAL: dict[str, Usual] = {
    "Fourier SLSQP": Usual(fourier_slsqp),
    "Fourier differential evolution": Usual(fourier_evolution),
    "multisine": Usual(multisine, random=True),
    "slow multisine": Usual(slow_multisine, random=True),
    "random steps": Usual(steps, random=True),
    "chirp": Usual(chirp, random=True),
    "hand-made": Usual(hand_made),
}


class _TimeUp(Exception):
    pass


class _Search:
    """Fourier coefficients x to log cond(Phi) and the room left to each limit (n_g,), in half ranges.

    Keeps the best x; _TimeUp ends it.
    """

    def __init__(self, model: Model, problem: Problem, seed: int, seconds: float) -> None:
        self._model, self._deadline = model, time.monotonic() + seconds
        self._times = excitation.knots(problem)
        phase = 2 * np.pi * FUNDAMENTAL * np.outer(self._times, np.arange(1, HARMONICS + 1))
        fade = np.clip(np.minimum(self._times, self._times[-1] - self._times) / 0.5, 0, 1)
        self._waves = np.hstack([np.sin(phase), np.cos(phase)]) * fade[:, None]
        self._size = np.ones(len(model.inputs))
        every = [g for g in machine_limits(model, problem) if not of_lane(g.name)]
        s = symbols(model)
        room = [1 - ca.fabs(g.expression(s.q, s.nu, s.u, s.du) - g.centre) * (2 / g.range) for g in every]
        self._room = ca.Function("room", [s.q, s.nu, s.u, s.du], [ca.vertcat(*room)])
        self._known: dict[bytes, tuple[float, np.ndarray]] = {}
        # coefficients of about one, of torques as large as the limits allow
        self.start = np.random.default_rng(seed).uniform(-1, 1, self._waves.shape[1] * len(model.inputs))
        wish = self._drive(self.start)
        self._size = np.abs(wish.torque).max(axis=0)
        torque = [float(b.limit.torque) if b.limit.torque is not None else 1.0 for b in model.machine.actuated]
        full = scaled(wish, np.array(torque) / self._size)
        kept = shrunk(model, problem, full)
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


def shrunk(model: Model, problem: Problem, wish: Manoeuvre) -> Manoeuvre:
    """The wish scaled down until every limit but rest and lane holds: the contacts alone first, then the others too."""
    pulling = np.array([b.contact is not None for b in model.machine.actuated])
    groups = [g for g in (pulling, ~pulling) if g.any()]
    factor = np.zeros(len(pulling))

    def holds() -> bool:
        try:
            motion = simulate(model, scaled(wish, factor).sample(float(model.machine.sampling_hz)))
        except SimulationError:
            return False
        return kept_between(check_limits(model, problem, motion))

    for left, group in enumerate(groups, 1 - len(groups)):
        low, high = 0, 50
        while low < high:
            middle = min(2 * low + 1, (low + high) // 2)  # most drives are not far outside
            factor[group] = SHRINK**middle
            low, high = (low, middle) if holds() else (middle + 1, high)
        factor[group] = SHRINK ** (high + (left < 0))  # room for what the others add
    return scaled(wish, factor)


def within(model: Model, problem: Problem, wish: Manoeuvre) -> Candidate:
    """The drive of a wish that keeps every limit, as this module's docstring says; else the one that exceeds least."""
    small = shrunk(model, problem, wish)
    found, motion = judge(model, problem, small)
    track = Track(0, found.score, typical_sizes(model, problem, motion), found, found, motion, motion.t)
    margins: dict[str, float] = {}
    least = found
    for attempt in range(ATTEMPTS):
        if track.latest.feasible:
            break
        moved = _nearest(model, problem, track, small, margins, attempt)
        if moved is None:
            break
        track = land(model, problem, aim(model, "cond"), moved, lambda: False)
        least = min(least, track.latest, key=lambda c: c.excess)
        for name, excess in track.latest.violations.items():
            if excess > 0.3 * TOLERANCE:
                margins[name] = margins.get(name, 0.0) + min(0.05, 3 * excess)
    return least


def judge(model: Model, problem: Problem, drive: Manoeuvre) -> tuple[Candidate, Motion]:
    """A design's own verdict on a drive: simulated afresh, placed on the lane as well as can be, scored by cond."""
    return verdict(model, problem, aim(model, "cond"), drive)


def _nearest(
    model: Model, problem: Problem, track: Track, wish: Manoeuvre, margins: dict[str, float], attempt: int
) -> Track | None:
    """From where the track stands, the drive nearest to the wish that keeps every limit, moved in by margins (of the
    ranges). None where no motion follows the torques. The first attempt goes the whole WAY, later ones refine."""
    with_pose = model.machine.planar and (track.pose is not None or lane_excess(track.latest.violations) > 0)
    times, known = excitation.knots(problem), track.motion.t
    names = [*model.coordinates, *[c + "'" for c in model.coordinates], *model.memory]
    every = dict(zip(names, np.hstack([track.motion.q, track.motion.nu, track.motion.memory]).T, strict=True))
    moved = Manoeuvre(times, track.latest.manoeuvre.at(times) - wish.at(times))
    states: np.ndarray | None = None
    for friction, slip, coarse in WAY if attempt == 0 else WAY[-1:]:
        at = excitation.knots(problem, coarse)
        tr = transcribe(
            soften(model, friction, slip),
            problem,
            track.sizes,
            len(at) - 1,
            track.motion,
            elements=1 if attempt == 0 else 3,
            with_pose=with_pose,
            rest=rest_band(friction),
            weights=np.empty((0, len(model.coordinates))),  # information isn't looked at
        )
        if states is None:
            states = np.column_stack([every[c] / size for c, size in zip(tr.state_names, tr.state_scale, strict=True)])
            start = states[0]
        nodes = ((np.arange(tr.intervals)[:, None] + tr.place) * tr.knot).ravel()
        goal, change = (d.at(at) / tr.torque_scale for d in (wish, moved))
        U = goal + change
        U[0] = U[-1] = goal[0] = goal[-1] = 0.0
        Z = np.column_stack([np.interp(nodes, known, x) for x in states.T]).reshape(tr.intervals, tr.nodes, tr.n_z)
        moved_in = np.array([MARGIN + 2 * margins.get(name, 0.0) for name in tr.limit_names])
        task = interior_point.Task(
            None,
            np.tile(moved_in, (tr.intervals, tr.nodes, 1)),
            np.tile([1e-4 + 2 * margins.get(name, 0.0) for name in tr.control_names], (tr.intervals, 1)),
            np.array([of_lane(name) for name in tr.limit_names], bool),
            (len(times) - 1) / tr.intervals,  # knots in one: the distance stays the same
            goal,
        )
        levels = (interior_point.Level(1.0, 1e-3, 1e-2, 40), interior_point.Level(1.0, 1e-4, 1e-3, 20))
        try:
            point = interior_point.begin(tr, task, start, settle(tr, start, U, Z), U, 1e-3, 0.05)
            point, _ = interior_point.minimise(tr, task, point, levels if friction == 1 else levels[:1])
        except CollocationError:
            if friction == 1:
                return None
            continue  # a soft machine only shows the way; the sharp one may follow without it
        known, states, start = nodes, point.Z.reshape(-1, tr.n_z), point.start
        moved = Manoeuvre(at, (point.U - goal) * tr.torque_scale)
    try:
        found, motion = judge(model, problem, Manoeuvre(at, point.U * tr.torque_scale))
    except SimulationError:
        return None
    pose = found.start if with_pose else None
    return replace(track, latest=found, best=found, motion=motion, pose=pose)


# ------------------------------------------------------------------------------------------------ the comparison


def compare(
    model: Model,
    problem: Problem,
    samples: int = 20,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Progress | None = None,
    usual: Sequence[str] = (),
) -> Comparison:
    """A designed drive and the usual ones on one problem. Random ones are drawn `samples` times.

    usual: names of the table, every one by default. budget_s [s]: of the design; the searches among the usual ones get
    the time that it took. progress(done, total, lowest cond(Phi) so far). Ctrl-C is KeyboardInterrupt. Raises
    InfeasibleError where the design finds nothing, and KeyError for an unknown kind.
    """
    usual = tuple(dict.fromkeys(usual)) or tuple(USUAL)
    for name in usual:
        if name not in USUAL:
            raise KeyError(f"no usual drive {name}, allowed: {', '.join(USUAL)}")
    jobs = [(name, k) for name in usual for k in range(samples if USUAL[name].random else 1)]
    total = len(jobs) + 1
    begin = time.monotonic()
    ours = design(model, problem, seed=seed, budget_s=budget_s)
    wall = time.monotonic() - begin
    if not ours.complete and (budget_s is None or wall < budget_s):
        raise KeyboardInterrupt  # the design kept its best so far; a comparison with it would mislead
    best = Candidate(ours.manoeuvre, ours.motion.q[0], 2 * float(np.log(ours.cond_phi)), ours.violations)
    rows = [_row(model, OURS, best, 1, 1, wall, wall)]
    lowest = ours.cond_phi
    if progress is not None:
        progress(1, total, lowest)
    seeds = np.random.SeedSequence(seed).generate_state(max(samples, 1))
    with joblib.parallel_config("loky", inner_max_num_threads=1):
        run = joblib.Parallel(n_jobs=processes(), return_as="generator_unordered")
        call = joblib.delayed(_sample)
        found: list[_Sample] = []
        for done, one in enumerate(run(call(model, problem, n, USUAL[n], k, int(seeds[k]), wall) for n, k in jobs), 2):
            found.append(one)
            if one.found.feasible:
                lowest = min(lowest, objective.reported("cond", one.found.score))
            if progress is not None:
                progress(done, total, lowest)
    found.sort(key=lambda s: s.number)
    in_time = [np.inf]
    for name in usual:
        rows += _rows(model, name, [s for s in found if s.kind == name], ours.cond_phi)
        in_time += _in_time([s for s in found if s.kind == name], wall)
    return Comparison(tuple(rows), min(in_time) / ours.cond_phi)


def _sample(model: Model, problem: Problem, kind: str, usual: Usual, number: int, seed: int, seconds: float) -> _Sample:
    begin = time.monotonic()
    found = within(model, problem, usual.make(model, problem, seed, seconds))
    return _Sample(kind, number, found, time.monotonic() - begin)


def _order(s: _Sample) -> tuple[bool, float]:
    return not s.found.feasible, s.found.score if s.found.feasible else s.found.excess


def _in_time(samples: Sequence[_Sample], seconds: float) -> list[float]:
    """cond(Phi) of those that keep every limit, of as many samples as are had in the given time; a search always is."""
    used = np.cumsum([s.wall_s for s in samples]) / processes()
    return [
        objective.reported("cond", s.found.score)
        for k, (s, t) in enumerate(zip(samples, used, strict=True))
        if s.found.feasible and (k == 0 or t <= seconds)
    ]


def _equal(samples: Sequence[_Sample], cond_phi: float) -> float | None:
    """Time [s] until one of these samples, taken one after the other, is as good as cond(Phi); None where none is."""
    used = np.cumsum([s.wall_s for s in samples]) / min(processes(), len(samples))
    for s, t in zip(samples, used, strict=True):
        if s.found.feasible and objective.reported("cond", s.found.score) <= cond_phi:
            return float(t)
    return None


def _rows(model: Model, name: str, samples: Sequence[_Sample], ours: float) -> list[Row]:
    """The one row of a kind, or the best and the median sample of a random one."""
    ranked = sorted(samples, key=_order)
    row = partial(
        _row,
        model,
        kept=sum(s.found.feasible for s in samples),
        samples=len(samples),
        equal_s=_equal(samples, ours),
    )
    wall = sum(s.wall_s for s in samples) / min(processes(), len(samples))
    if not USUAL[name].random:
        return [row(name, s.found, wall_s=wall) for s in ranked]
    n = len(ranked)
    return [
        row(f"{name}, best of {n}", ranked[0].found, wall_s=wall),
        row(f"{name}, median of {n}", ranked[(n - 1) // 2].found, wall_s=wall),
    ]


def _row(model: Model, name: str, c: Candidate, kept: int, samples: int, wall_s: float, equal_s: float | None) -> Row:
    motion = simulate(model, c.manoeuvre.sample(float(model.machine.sampling_hz)), q0=c.start)
    spread = objective.percent(model, smoothing.cramer_rao(model, motion))
    breaks = None if c.feasible else max(c.violations, key=lambda limit: c.violations[limit])
    return Row(
        name,
        c.manoeuvre,
        c.start,
        objective.cond_phi(model, motion),
        objective.cond_w(model, motion),
        float(spread.max()),
        float(np.median(spread)),
        c.excess,
        breaks,
        kept,
        samples,
        wall_s,
        equal_s,
    )
