"""Turn a designed motion into phases that a person can follow, in words, with the ground it takes and its accuracy.

A person follows a trace of speed and steering angles, as in drive-cycle testing. A design is smoothed into few straight
pieces of some seconds: piecewise linear least squares with knots from dynamic programming (Bellman and Roth, 1969),
rounded to what a dial shows. Simulated drivers (`simulation.Driver`) show how much of the accuracy a person keeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from excite import simulation, smoothing, trajectories
from excite.errors import UndrivableError
from excite.model import Model
from excite.model.machine import Body, Problem
from excite.simulation import Motion, left_turn_sign
from excite.text import format_number

BROKEN_SHARE = 0.02  # excess, as a share of a limit's range, from which the limit counts as broken; chosen
GRID_S = 0.5  # [s]: phases begin at multiples of it; chosen
PEOPLE = 3  # simulated drivers; chosen
SPEED_STEP = 0.1  # [m/s]: what a person reads from a dial; chosen
ANGLE_STEP = np.deg2rad(2)  # [rad]: what a person steers to; chosen
LIMIT_SHARE = 0.93  # of speed and rate limits that a trace uses, as a person overshoots; chosen
# Tolerance of the trace: 1 s and 2 km/h of 130 km/h in drive-cycle testing (WLTP, UN GTR 15), scaled to the machine's
# speed, but no narrower than a practised person's slow errors (`simulation.Driver`).
BAND_S = 1.0  # [s]
BAND_SPEED = 0.1  # [m/s]
BAND_ANGLE = np.deg2rad(2)  # [rad]
FREE_MARGIN_M = 3.0  # free ground around what the machine touches, for overhangs and stopping [m]; chosen
MAX_ERROR_RATIO = 2.0  # person's error over that of torques played back, up to which a drive is worth it; chosen


@dataclass(frozen=True)
class Lever:
    """A joint that a person steers. left: sign of the angle that turns the machine left when it goes forward."""

    body: Body
    left: int

    @property
    def name(self) -> str:
        """Name of the joint in the machine file, as words."""
        return self.body.where.replace("_", " ")

    @property
    def column(self) -> str:
        """Column of the joint's angle in tables."""
        return f"{self.body.where}_rad"


@dataclass(frozen=True)
class Trace:
    """Reference of speed and steering for a driver, linear between knots.

    times: (K,) [s].
    speed: (K,) [m/s], forward positive.
    angle: (K, n) [rad] of the n steered joints `levers`, in the machine's signs.
    """

    times: np.ndarray
    speed: np.ndarray
    angle: np.ndarray
    levers: tuple[Lever, ...]

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    @property
    def degrees(self) -> np.ndarray:
        """Angles (K, n) [deg], positive to the left."""
        return np.asarray(np.rad2deg(self.angle) * [lever.left for lever in self.levers])

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return speed (N,) [m/s] and angles (N, n) [rad] at times (N,) [s], constant beyond the ends."""
        angle = [np.interp(t, self.times, a) for a in self.angle.T]
        return np.interp(t, self.times, self.speed), np.reshape(angle, (len(angle), len(t))).T

    def __len__(self) -> int:
        return len(self.times) - 1


@dataclass(frozen=True)
class DriveQuality:
    """cond(Phi) of a drive, and the attainable standard deviation [%] of the worst and the median parameter."""

    cond_phi: float
    worst_percent: float
    worst: str
    median_percent: float


@dataclass(frozen=True)
class TouchedGround:
    """Box around the ground that the contacts touch, along the lane's axes [m]: length, width, lower corner (x, y)."""

    length: float
    width: float
    corner: tuple[float, float]

    @property
    def free(self) -> tuple[float, float]:
        """Length and width [m] to keep free: what is touched with FREE_MARGIN_M all around, in whole metres."""
        length, width = (float(np.ceil(side + 2 * FREE_MARGIN_M - 1e-9)) for side in (self.length, self.width))
        return length, width

    def summary(self, lane: tuple[float, float]) -> dict[str, Any]:
        """Return touched and free ground, lane, and touched ground beyond the lane [m]; no lane if it is infinite."""
        found: dict[str, Any] = {"room_m": [self.length, self.width], "free_ground_m": list(self.free)}
        if np.isfinite(lane).all():
            found |= {"lane_m": list(lane), "beyond_lane_m": list(self.beyond(lane))}
        return found

    def beyond(self, lane: tuple[float, float]) -> tuple[float, float]:
        """Return how far touched ground lies beyond the ends and beyond the sides of a lane [m], negative within it."""
        ends = zip(self.corner, (self.length, self.width), lane, strict=True)
        over = [max(-side / 2 - low, low + size - side / 2) for low, size, side in ends]
        return over[0], over[1]

    def words(self, lane: tuple[float, float]) -> str:
        """Compare the ground that a person needs with a lane (length, width) [m]; empty without a lane."""
        if not np.isfinite(lane).all():
            return ""
        size = f"the lane of {lane[0]:g} m x {lane[1]:g} m"
        over = self.beyond(lane)
        sides = [
            f"{FREE_MARGIN_M + metres:.1f} m beyond its {name}"
            for metres, name in zip(over, ("ends", "sides"), strict=True)
            if metres + FREE_MARGIN_M > 0.05
        ]
        if max(over) > 0.05:
            return f"The machine leaves {size}, by {max(over):.1f} m: keep {' and '.join(sides)} free."
        if sides:
            return f"The machine stays on {size}, but keep {' and '.join(sides)} free."
        return f"That lies within {size}."


def find_levers(model: Model) -> tuple[Lever, ...]:
    """Return the joints that a person steers. Raises UndrivableError for a machine without contacts."""
    if not model.machine.planar or not model.machine.contacts:
        raise UndrivableError(f"{model.machine.name}: touches the ground nowhere, so there is nobody to drive it")
    return tuple(Lever(b, left_turn_sign(model, b)) for b in model.machine.actuated if b.contact is None)


def trace_from_motion(model: Model, motion: Motion, shortest: float = 2.0, most: int | None = None) -> Trace:
    """Smooth a motion into a trace that starts and ends at rest and keeps the machine's limits with a reserve.

    shortest [s]: shortest phase. most: largest number of phases, one in three seconds by default.
    Raises UndrivableError for a machine without contacts and arguments out of range.
    """
    duration = float(motion.t[-1])
    most = max(2, round(duration / 3)) if most is None else most
    if most < 2:
        raise UndrivableError(f"phases: at least 2 are needed, to go and to stop (got {most})")
    if not GRID_S <= shortest <= duration / 2:
        raise UndrivableError(f"shortest phase: must be between {GRID_S:g} and {duration / 2:g} s (got {shortest:g})")
    own = trace_as_designed(model, motion)
    speed, angle = own.speed, own.angle
    fastest, widest, swing = trace_bounds(model)
    signal = np.column_stack([speed / (SPEED_STEP * 5), angle / (ANGLE_STEP * 5)])
    knots = _segments(motion.t, signal, shortest, most)
    fit = _refit(motion.t, np.column_stack([speed, angle]), knots)
    v = np.clip(np.round(fit[:, 0] / SPEED_STEP) * SPEED_STEP, -fastest, fastest)
    a = np.clip(np.round(fit[:, 1:] / ANGLE_STEP) * ANGLE_STEP, -widest, widest)
    return merge_straight_phases(Trace(knots, v + 0.0, limit_steering_rate(knots, a, swing) + 0.0, own.levers))


def limit_steering_rate(
    times: np.ndarray, angle: np.ndarray, swing: np.ndarray, fixed: Sequence[int] = (0, -1)
) -> np.ndarray:
    """Return angles (K, n) [rad] at times (K,) [s] that change no faster than `swing` (n,) [rad/s]; `fixed` ones stay.

    Angles are clipped to what the fixed ones allow, then replaced by the mean of the lower and upper Lipschitz
    envelopes (McShane, 1934).
    """
    slow, ends = angle.copy(), list(fixed)
    for j in np.flatnonzero(np.isfinite(swing)):
        reach, a = swing[j] * np.abs(times[:, None] - times), angle[:, j]
        a = np.clip(a, (a[ends] - reach[:, ends]).max(axis=1), (a[ends] + reach[:, ends]).min(axis=1))
        slow[:, j] = ((a + reach).min(axis=1) + (a - reach).max(axis=1)) / 2
    return slow


def trace_as_designed(model: Model, motion: Motion) -> Trace:
    """Return a motion's own speed and steering as a trace with a knot per sample. Raises UndrivableError."""
    joints = find_levers(model)
    angle = motion.q[:, [model.coordinates.index(j.body.coordinates[0]) for j in joints]]
    return Trace(motion.t, motion.nu[:, 0], angle, joints)


def trace_bounds(model: Model) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the largest speed [m/s], angles (n,) [rad] and rates (n,) [rad/s] of a trace."""
    rims = [float(b.limit.rim_speed) for b in model.machine.contacts if b.limit.rim_speed is not None]
    fastest = np.floor(LIMIT_SHARE * min(rims) / SPEED_STEP + 1e-9) * SPEED_STEP if rims else np.inf
    stated = [j.body.limit for j in find_levers(model)]
    top = np.array([x.reach or np.inf for x in stated])
    rate = np.array([np.inf if x.rate is None else float(x.rate) for x in stated])
    return float(fastest), np.floor(LIMIT_SHARE * top / ANGLE_STEP) * ANGLE_STEP, LIMIT_SHARE * rate


def _segments(t: np.ndarray, signal: np.ndarray, shortest: float, most: int) -> np.ndarray:
    """Return knot times (K + 1,) of the fewest chords whose squared misfit is close to the best with `most` chords."""
    count = max(round(t[-1] / GRID_S), 2)
    grid = np.round(np.linspace(0, len(t) - 1, count + 1)).astype(int)
    least = max(1, int(np.ceil(shortest * count / t[-1] - 1e-9)))
    cost = np.full((count + 1, count + 1), np.inf)
    # Cumulative sums give the squared misfit of the chord between any two samples.
    n = np.arange(len(t), dtype=float)
    sums = [np.vstack([np.zeros((1, signal.shape[1])), np.cumsum(x, axis=0)]) for x in (signal, signal**2)]
    moment = np.vstack([np.zeros((1, signal.shape[1])), np.cumsum(n[:, None] * signal, axis=0)])
    for i in range(count + 1):
        for j in range(i + least, count + 1):
            p, q = grid[i], grid[j]
            m = q - p
            slope = (signal[q] - signal[p]) / m
            s, ss, ns = (x[q] - x[p] for x in (sums[0], sums[1], moment))
            k1, k2 = m * (m - 1) / 2, (m - 1) * m * (2 * m - 1) / 6
            chord = m * signal[p] ** 2 + 2 * signal[p] * slope * k1 + slope**2 * k2
            cost[i, j] = float((ss - 2 * (signal[p] * s + slope * (ns - p * s)) + chord).sum())
    best = np.full((most + 1, count + 1), np.inf)
    came = np.zeros((most + 1, count + 1), int)
    best[0, 0] = 0.0
    for k in range(1, most + 1):
        total = best[k - 1][:, None] + cost
        came[k], best[k] = np.argmin(total, axis=0), np.min(total, axis=0)
    ends = best[1:, count]
    chosen = 1 + int(np.argmax(ends <= 1.1 * np.min(ends) + 1e-6 * len(t)))
    path = [count]
    for k in range(chosen, 0, -1):
        path.append(int(came[k, path[-1]]))
    return np.asarray(t[grid[path[::-1]]])


def _refit(t: np.ndarray, signal: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return knot values (K + 1, n) of the piecewise linear least-squares fit to a signal, zero at both ends."""
    hats = np.column_stack([np.interp(t, knots, row) for row in np.eye(len(knots))])[:, 1:-1]
    values = np.zeros((len(knots), signal.shape[1]))
    if hats.shape[1]:
        values[1:-1] = np.linalg.lstsq(hats, signal, rcond=None)[0]
    return values


def merge_straight_phases(trace: Trace) -> Trace:
    """Merge neighbouring phases that are one straight line."""
    keep = [0]
    for k in range(1, len(trace.times) - 1):
        before, after = keep[-1], k + 1
        share = (trace.times[k] - trace.times[before]) / (trace.times[after] - trace.times[before])
        bend_v = trace.speed[k] - (trace.speed[before] + share * (trace.speed[after] - trace.speed[before]))
        bend_a = trace.angle[k] - (trace.angle[before] + share * (trace.angle[after] - trace.angle[before]))
        if abs(bend_v) > SPEED_STEP / 10 or (np.abs(bend_a) > ANGLE_STEP / 10).any():
            keep.append(k)
    keep.append(len(trace.times) - 1)
    return replace(trace, times=trace.times[keep], speed=trace.speed[keep], angle=trace.angle[keep])


# ------------------------------------------------------------------------------------------------ words


def format_clock(t: float) -> str:
    """Format seconds as minutes and seconds: 0:12, 1:04.5."""
    tenths = round(10 * t)
    minutes, rest = divmod(tenths, 600)
    return f"{minutes}:{rest // 10:02d}" + (f".{rest % 10}" if rest % 10 else "")


def reversal_letter(k: int) -> str:
    """Name the k-th change of direction on the map: A, B, ... Z, A1, B1, ..."""
    return chr(ord("A") + k % 26) + (str(k // 26) if k >= 26 else "")


def phase_words(trace: Trace, k: int, letters: bool = False) -> str:
    """Describe phase k for the driver: "accelerate to 1.5 m/s in 4 s, straight".

    letters: with the names of changes of direction on the map.
    """
    go, steer = phase_parts(trace, k, letters)
    return ", ".join((go, *steer))


def trace_table(trace: Trace) -> list[dict[str, Any]]:
    """Return every phase as numbers and words."""
    return [
        {
            "start_s": float(trace.times[k]),
            "end_s": float(trace.times[k + 1]),
            "speed_m_s": [float(trace.speed[k]), float(trace.speed[k + 1])],
            **{lever.column: trace.angle[k : k + 2, j].tolist() for j, lever in enumerate(trace.levers)},
            "do": phase_words(trace, k),
        }
        for k in range(len(trace))
    ]


def trace_from_table(model: Model, rows: Sequence[Mapping[str, Any]]) -> Trace:
    """Read a trace back from `trace_table`. Raises UndrivableError for a table of another version or machine."""
    joints = find_levers(model)
    try:
        ends = [(r["end_s"], r["speed_m_s"][1], *(r[j.column][1] for j in joints)) for r in rows]
        times, speed, *angle = np.array([(0.0,) * (2 + len(joints)), *ends], float).T
    except (KeyError, IndexError, TypeError, ValueError) as err:
        other = isinstance(err, KeyError) and err.args[0] in [j.column for j in joints]
        why = f"of another version or machine (no column {err.args[0]})" if other else "damaged"
        raise UndrivableError(f"summary.json: the design's phases are {why}, design again") from None
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise UndrivableError("summary.json: the design's phases are damaged, design again")
    return Trace(times, speed, np.reshape(angle, (len(joints), len(times))).T, joints)


def phase_parts(trace: Trace, k: int, letters: bool = False) -> tuple[str, tuple[str, ...]]:
    """Return what to do in phase k with the speed lever, and with each steered joint."""
    start = float(trace.times[k])
    took = float(trace.times[k + 1]) - start
    v0, v1 = float(trace.speed[k]), float(trace.speed[k + 1])
    names = [
        reversal_letter(n) for n, t in enumerate(reversal_times(trace)) if letters and _stopping_phase(trace, t) == k
    ]
    go = _speed_words(v0, v1, took, start, names[0] if names else "")
    several = len(trace.levers) > 1
    each = zip(trace.levers, trace.degrees[k], trace.degrees[k + 1], strict=True)
    return go, tuple(_steer_words(a0, a1, lever.name if several else "") for lever, a0, a1 in each)


def _stopping_phase(trace: Trace, t: float) -> int:
    """Return the phase that stops the machine before it goes the other way at time t [s], even if it stands between."""
    v = trace.speed
    stops = (trace.times[:-1] < t) & (v[:-1] != 0) & (v[:-1] * v[1:] <= 0)
    return int(np.flatnonzero(stops)[-1])


def _speed_words(v0: float, v1: float, took: float, start: float, name: str) -> str:
    seconds = f"in {format_number(took, 3)} s"
    way = " backward" if min(v0, v1) < 0 else ""
    if v0 == v1:
        return (
            f"hold {abs(v1):.1f} m/s{way} for {format_number(took, 3)} s"
            if v1
            else f"stand still for {format_number(took, 3)} s"
        )
    if v0 * v1 < 0:
        turn, way = format_clock(start + took * v0 / (v0 - v1)), "backward" if v1 < 0 else "forward"
        return f"through a stop {name + ' ' if name else ''}at {turn} to {abs(v1):.1f} m/s {way} {seconds}"
    if v1 == 0:
        return f"brake to a stop {name + ' ' if name else ''}{seconds}"
    if abs(v1) > abs(v0):
        return f"accelerate{way} to {abs(v1):.1f} m/s {seconds}"
    return f"slow down to {abs(v1):.1f} m/s{way} {seconds}"


def _steer_words(a0: float, a1: float, name: str) -> str:
    """Describe steering from one angle to another [deg], positive to the left. name: empty for the only joint."""
    kept, angle = abs(a0 - a1) < np.rad2deg(ANGLE_STEP) / 10, angle_words(a1)
    if not round(abs(a1)):
        return f"{name} straight".strip() if kept else f"straighten {name or 'up'}"
    if kept:
        return f"keep {name} {angle}".replace("  ", " ")
    return f"{name or 'steer'} to {angle}"


def angle_words(degrees: float) -> str:
    """Format an angle [deg], positive to the left: 20° left."""
    return f"{abs(degrees):.0f}°" + ("" if abs(degrees) < 0.5 else " left" if degrees > 0 else " right")


def start_words(model: Model, motion: Motion, trace: Trace, lane: tuple[float, float] | None = None) -> str:
    """Describe place and heading of the first contact at the start, seen along the lane from its middle.

    lane: length and width [m], to give its distances from the corner behind on the right as well, as a tape is laid.
    Empty for a machine that can't turn on the plane.
    """
    machine = model.machine
    if not set(machine.body[0].coordinates) <= set(model.coordinates):
        return ""
    first = machine.contacts[0]
    x, y = contact_edges(model, motion)[0].mean(axis=0)[0]
    heading = float(np.rad2deg(_headings(model, motion)[machine.body.index(first), 0]))
    heading = (heading + 180) % 360 - 180
    along = _offset_words(
        float(x), "ahead of the lane's middle", "behind the lane's middle", "level with the lane's middle"
    )
    across = _offset_words(float(y), "left of it", "right of it", "on its line")
    way = {0: "ahead", 180: "back"}.get(round(abs(heading)), angle_words(heading))
    steered = "".join(
        f"; {lever.name} {angle_words(a) if round(abs(a)) else 'straight'}"
        for lever, a in zip(trace.levers, trace.degrees[0], strict=True)
    )
    name = first.where.replace("_", " ")
    text = f"Start, seen along the lane: the middle of the {name} {along} and {across}, pointing {way}{steered}."
    if lane is None:
        return text
    from_end, from_side = float(x) + lane[0] / 2, float(y) + lane[1] / 2
    return f"{text} By tape: {from_end:.1f} m from the lane's near end, {from_side:.1f} m from its right side."


def _offset_words(metres: float, more: str, less: str, none: str) -> str:
    return none if abs(metres) < 0.05 else f"{abs(metres):.1f} m {more if metres > 0 else less}"


def reversal_times(trace: Trace) -> list[float]:
    """Return the times [s] at which the direction of travel changes."""
    t = np.arange(0, trace.duration, 0.01)
    v = trace.at(t)[0]
    moving = np.flatnonzero(np.abs(v) > SPEED_STEP / 4)
    turns = moving[1:][np.sign(v[moving[1:]]) != np.sign(v[moving[:-1]])]
    return [float(t[k]) for k in turns]


# ------------------------------------------------------------------------------------------------ driven by a person


def follow_trace(
    model: Model, trace: Trace, who: simulation.Driver | None, seed: int, q0: np.ndarray | None = None
) -> Motion:
    """Simulate a person who follows a trace. Raises SimulationError."""
    rate = float(model.machine.sampling_hz)
    t = np.arange(round(trace.duration * rate) + 1) / rate
    return simulation.follow(model, *trace.at(t), who, seed=seed, q0=q0)


def rate_motion(model: Model, motion: Motion) -> DriveQuality:
    """Return cond(Phi) and attainable accuracy of a motion (Cramer-Rao bound, kit full)."""
    sigma = trajectories.relative_std_percent(model, smoothing.cramer_rao(model, motion))
    worst = int(np.argmax(sigma))
    return DriveQuality(
        trajectories.cond_phi(model, motion), float(sigma[worst]), model.base.names[worst], float(np.median(sigma))
    )


def middle_quality(scores: Sequence[DriveQuality]) -> DriveQuality:
    """Return the median of several drives, ordered by the worst parameter."""
    return sorted(scores, key=lambda s: s.worst_percent)[(len(scores) - 1) // 2]


def broken_limits(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Return limits that a motion exceeds by more than BROKEN_SHARE of their range, with the excess."""
    over = trajectories.check_limits(model, problem, motion)
    return {
        name: value for name, value in over.items() if value > BROKEN_SHARE and not trajectories.is_rest_limit(name)
    }


# ------------------------------------------------------------------------------------------------ room


def contact_edges(model: Model, motion: Motion) -> np.ndarray:
    """Return ground tracks (n_contacts, 2, N, 2) [m] of the right and left end of every contact line."""
    machine = model.machine
    q = model.true_coordinates(motion.q, model.nominal)
    places = model.kinematics(q.T, motion.nu.T)[3].full().reshape(3, len(motion.t), len(machine.body))
    heading = _headings(model, motion)
    tracks = []
    for b in machine.contacts:
        assert b.contact is not None
        k = machine.body.index(b)
        turn = heading[k]
        half = float(b.contact.width) / 2
        across = np.column_stack([-np.sin(turn), np.cos(turn)])
        tracks.append([places[:2, :, k].T - half * across, places[:2, :, k].T + half * across])
    return np.array(tracks)


def _headings(model: Model, motion: Motion) -> np.ndarray:
    """Return the heading (n_bodies, N) [rad] of every body, summed over the vertical joints from the root."""
    machine = model.machine
    at = dict(zip(model.coordinates, model.true_coordinates(motion.q, model.nominal).T, strict=True))
    still = np.zeros(len(motion.t))
    heading: dict[int, np.ndarray] = {}
    for b in machine.body:
        own = at.get(f"theta{b.index}", still)
        if isinstance(b.antecedent, str):
            heading[b.index] = own
        else:  # a contact spins about its axle, not about the vertical
            spins = b.contact is not None or b.joint != "revolute"
            heading[b.index] = heading[b.antecedent] + (0.0 if spins else own)
    return np.array([heading[b.index] for b in machine.body])


def touched_ground(model: Model, motions: Sequence[Motion]) -> TouchedGround:
    """Return the ground that the contacts touch in any of the drives."""
    points = np.concatenate([contact_edges(model, m).reshape(-1, 2) for m in motions])
    low, high = points.min(axis=0), points.max(axis=0)
    return TouchedGround(float(high[0] - low[0]), float(high[1] - low[1]), (float(low[0]), float(low[1])))


def place_in_lane(model: Model, problem: Problem, motions: Sequence[Motion]) -> tuple[Motion, ...]:
    """Move drives with a common start so that it points along the lane, if they all stay in the lane then.

    Otherwise move them so that the first lies best in the lane; one that keeps the lane stays. On flat ground a motion
    does not depend on its start.
    """
    first = motions[0]
    start = trajectories.place_along_lane(model, problem, motions)
    if start is None:
        if trajectories.lane_excess(trajectories.check_limits(model, problem, first)) == 0:
            return tuple(motions)
        start = trajectories.place_on_lane(model, problem, first)
    return tuple(trajectories.move_motion(model, m, start) for m in motions)


def tolerance_band(t: np.ndarray, value: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper edge (N,) of the tolerance around a reference (N,) at evenly spaced times (N,) [s].

    As in drive-cycle testing: `tolerance` beyond the extremes of the reference within BAND_S.
    """
    reach = round(BAND_S / (t[1] - t[0]))
    padded = np.pad(value, reach, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return windows.min(axis=1) - tolerance, windows.max(axis=1) + tolerance
