"""From a designed motion to a drive that a person can follow: phases of some seconds, their words, room and score.

People follow a trace of speed and of every steered joint's angle, as in drive-cycle testing, not torques. A design is
smoothed into few straight pieces of at least some seconds (piecewise linear least squares; the knots by dynamic
programming, Bellman and Roth, 1969), rounded to what a dial shows, and driven in simulation by `driver`: what is left
of the attainable accuracy is what a person can keep.
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

BROKEN = 0.02  # of its range, by which a limit is broken
GRID = 0.5  # s between places where a phase may begin
SPEED_STEP, ANGLE_STEP = 0.1, np.deg2rad(2)  # what is read from a dial and steered to
RESERVE = 0.93  # of speed and rate limits that a trace asks for: a person overshoots
# Tolerance of the trace, in proportion to the 2 km/h of 130 km/h and 1 s of drive-cycle testing (WLTP, UN GTR 15),
# but no narrower than a practised person's slow errors (`driver.Driver`).
BAND_S = 1.0
BAND_SPEED, BAND_ANGLE = 0.1, np.deg2rad(2)
LOST = 2.0  # times the attainable error: a drive that loses more in a person's hands is not worth the day


@dataclass(frozen=True)
class Lever:
    """A joint that a person steers; `left` is +1 or -1, the sign of its angle that, alone, turns the machine to the
    left when it goes forward."""

    body: Body
    left: int

    @property
    def name(self) -> str:
        """What the machine file calls the joint, in words."""
        return self.body.where.replace("_", " ")

    @property
    def column(self) -> str:
        """Its angle in tables."""
        return f"{self.body.where}_rad"


@dataclass(frozen=True)
class Trace:
    """What a driver follows, linear between knots: times (K,) [s], speed (K,) [m/s] forward, angle (K, n) [rad] of the
    n steered joints `levers`, in the machine's own signs."""

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
        """Speed (N,) [m/s] and angles (N, n) [rad] at times (N,) [s], held at the ends."""
        angle = [np.interp(t, self.times, a) for a in self.angle.T]
        return np.interp(t, self.times, self.speed), np.reshape(angle, (len(angle), len(t))).T

    def __len__(self) -> int:
        return len(self.times) - 1


@dataclass(frozen=True)
class Score:
    """What a drive gives: cond(Phi), and the attainable standard deviation [%], worst and median parameter."""

    cond_phi: float
    worst_percent: float
    worst: str
    median_percent: float


@dataclass(frozen=True)
class Room:
    """The ground that the contacts' edges touch, along the lane's axes [m]: length, width, corner (x, y) of the box."""

    length: float
    width: float
    corner: tuple[float, float]


def levers(model: Model) -> tuple[Lever, ...]:
    """The joints that a person steers, none on a straight lane. Raises DriveError where nobody drives: no wheels."""
    if not model.machine.planar or not model.machine.contacts:
        raise UndrivableError(f"{model.machine.name}: touches the ground nowhere, so there is nobody to drive it")
    return tuple(Lever(b, left_turn_sign(model, b)) for b in model.machine.actuated if b.contact is None)


def phases(model: Model, motion: Motion, shortest: float = 2.0, most: int | None = None) -> Trace:
    """A motion as a trace of at most `most` straight pieces, one in three seconds by default, `shortest` [s] or longer.

    Starts and ends at rest; speed and steering rate keep the machine's limits with a reserve. Raises DriveError for a
    machine that nobody steers, and for arguments out of range.
    """
    duration = float(motion.t[-1])
    most = max(2, round(duration / 3)) if most is None else most
    if most < 2:
        raise UndrivableError(f"phases: at least 2 are needed, to go and to stop (got {most})")
    if not GRID <= shortest <= duration / 2:
        raise UndrivableError(f"shortest phase: must be between {GRID:g} and {duration / 2:g} s (got {shortest:g})")
    own = as_designed(model, motion)
    speed, angle = own.speed, own.angle
    fastest, widest, swing = bounds(model)
    signal = np.column_stack([speed / (SPEED_STEP * 5), angle / (ANGLE_STEP * 5)])
    knots = _segments(motion.t, signal, shortest, most)
    fit = _refit(motion.t, np.column_stack([speed, angle]), knots)
    v = np.clip(np.round(fit[:, 0] / SPEED_STEP) * SPEED_STEP, -fastest, fastest)
    a = np.clip(np.round(fit[:, 1:] / ANGLE_STEP) * ANGLE_STEP, -widest, widest)
    return merged(Trace(knots, v + 0.0, slowed(knots, a, swing) + 0.0, own.levers))


def slowed(times: np.ndarray, angle: np.ndarray, swing: np.ndarray, fixed: Sequence[int] = (0, -1)) -> np.ndarray:
    """Angles (K, n) [rad] at times (K,) [s], steered no faster than `swing` (n,) [rad/s] between; those `fixed` stay.

    Within reach of the fixed ones first, then the mean of the lower and upper envelopes (McShane, 1934).
    """
    slow, ends = angle.copy(), list(fixed)
    for j in np.flatnonzero(np.isfinite(swing)):
        reach, a = swing[j] * np.abs(times[:, None] - times), angle[:, j]
        a = np.clip(a, (a[ends] - reach[:, ends]).max(axis=1), (a[ends] + reach[:, ends]).min(axis=1))
        slow[:, j] = ((a + reach).min(axis=1) + (a - reach).max(axis=1)) / 2
    return slow


def as_designed(model: Model, motion: Motion) -> Trace:
    """A motion's own speed and steering as a trace, sample by sample: what the phases are compared with.

    Raises DriveError as `levers`.
    """
    joints = levers(model)
    angle = motion.q[:, [model.coordinates.index(j.body.coordinates[0]) for j in joints]]
    return Trace(motion.t, motion.nu[:, 0], angle, joints)


def bounds(model: Model) -> tuple[float, np.ndarray, np.ndarray]:
    """Speed [m/s], angles (n,) [rad] and rates (n,) [rad/s] that a trace may ask for; speed and angles on the dial's
    grid."""
    rims = [float(b.limit.rim_speed) for b in model.machine.contacts if b.limit.rim_speed is not None]
    fastest = np.floor(RESERVE * min(rims) / SPEED_STEP + 1e-9) * SPEED_STEP if rims else np.inf
    stated = [j.body.limit for j in levers(model)]
    top = np.array([np.inf if x.position is None else float(x.position) for x in stated])
    rate = np.array([np.inf if x.rate is None else float(x.rate) for x in stated])
    return float(fastest), np.floor(RESERVE * top / ANGLE_STEP) * ANGLE_STEP, RESERVE * rate


def _segments(t: np.ndarray, signal: np.ndarray, shortest: float, most: int) -> np.ndarray:
    """Knot times (K + 1,) of the best chords: the fewest whose squared misfit is close to the best with `most`."""
    count = max(round(t[-1] / GRID), 2)
    grid = np.round(np.linspace(0, len(t) - 1, count + 1)).astype(int)
    least = max(1, int(np.ceil(shortest * count / t[-1] - 1e-9)))
    cost = np.full((count + 1, count + 1), np.inf)
    # a chord between two samples: its misfit is a sum of squares that cumulative sums give at once
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
    """Knot values (K + 1, n) of the continuous piecewise linear function nearest to the signal, zero at both ends."""
    hats = np.column_stack([np.interp(t, knots, row) for row in np.eye(len(knots))])[:, 1:-1]
    values = np.zeros((len(knots), signal.shape[1]))
    if hats.shape[1]:
        values[1:-1] = np.linalg.lstsq(hats, signal, rcond=None)[0]
    return values


def merged(trace: Trace) -> Trace:
    """Neighbours that are one straight line become one phase."""
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


def clock(t: float) -> str:
    """Seconds as a person reads them: 0:12, 1:04.5."""
    tenths = round(10 * t)
    minutes, rest = divmod(tenths, 600)
    return f"{minutes}:{rest // 10:02d}" + (f".{rest % 10}" if rest % 10 else "")


def letter(k: int) -> str:
    """The name of the k-th change of direction on the map: A, B, ... Z, A1, B1, ..."""
    return chr(ord("A") + k % 26) + (str(k // 26) if k >= 26 else "")


def words(trace: Trace, k: int, letters: bool = False) -> str:
    """What to do in phase k: "accelerate to 1.5 m/s in 4 s, straight".

    `letters`: with the names that changes of direction have on the map.
    """
    return ", ".join(part for part in trace_parts(trace, k, letters) if part)


def trace_table(trace: Trace) -> list[dict[str, Any]]:
    """Every phase as numbers and words."""
    return [
        {
            "start_s": float(trace.times[k]),
            "end_s": float(trace.times[k + 1]),
            "speed_m_s": [float(trace.speed[k]), float(trace.speed[k + 1])],
            **{lever.column: trace.angle[k : k + 2, j].tolist() for j, lever in enumerate(trace.levers)},
            "do": words(trace, k),
        }
        for k in range(len(trace))
    ]


def from_table(model: Model, rows: Sequence[Mapping[str, Any]]) -> Trace:
    """The trace that `table` was made of. Raises DriveError for one of another version or machine, or damaged."""
    joints = levers(model)
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


def trace_parts(trace: Trace, k: int, letters: bool = False) -> tuple[str, str]:
    """What to do in phase k with the speed lever and with what steers, the latter empty where nothing does."""
    start = float(trace.times[k])
    took = float(trace.times[k + 1]) - start
    v0, v1 = float(trace.speed[k]), float(trace.speed[k + 1])
    names = [letter(n) for n, t in enumerate(reversals(trace)) if letters and _stopping(trace, t) == k]
    go = _speed_words(v0, v1, took, start, names[0] if names else "")
    several = len(trace.levers) > 1
    each = zip(trace.levers, trace.degrees[k], trace.degrees[k + 1], strict=True)
    return go, ", ".join(_steer_words(a0, a1, lever.name if several else "") for lever, a0, a1 in each)


def _stopping(trace: Trace, t: float) -> int:
    """The phase that brings the machine to the stop from which it goes the other way at time t [s]: braking, however
    long it stands still then, or through the stop."""
    v = trace.speed
    stops = (trace.times[:-1] < t) & (v[:-1] != 0) & (v[:-1] * v[1:] <= 0)
    return int(np.flatnonzero(stops)[-1])


def _speed_words(v0: float, v1: float, took: float, start: float, name: str) -> str:
    seconds = f"in {took:.3g} s"
    way = " backward" if min(v0, v1) < 0 else ""
    if v0 == v1:
        return f"hold {abs(v1):.1f} m/s{way} for {took:.3g} s" if v1 else f"stand still for {took:.3g} s"
    if v0 * v1 < 0:
        turn, way = clock(start + took * v0 / (v0 - v1)), "backward" if v1 < 0 else "forward"
        return f"through a stop {name + ' ' if name else ''}at {turn} to {abs(v1):.1f} m/s {way} {seconds}"
    if v1 == 0:
        return f"brake to a stop {name + ' ' if name else ''}{seconds}"
    if abs(v1) > abs(v0):
        return f"accelerate{way} to {abs(v1):.1f} m/s {seconds}"
    return f"slow down to {abs(v1):.1f} m/s{way} {seconds}"


def _steer_words(a0: float, a1: float, name: str) -> str:
    """From angle to angle [deg], positive to the left; name: of the joint, empty where there is one only."""
    kept, angle = abs(a0 - a1) < np.rad2deg(ANGLE_STEP) / 10, angle_words(a1)
    if not round(abs(a1)):
        return f"{name} straight".strip() if kept else f"straighten {name or 'up'}"
    if kept:
        return f"keep {name} {angle}".replace("  ", " ")
    return f"{name or 'steer'} to {angle}"


def angle_words(degrees: float) -> str:
    """An angle, positive to the left, as a person reads it: 20° left."""
    return f"{abs(degrees):.0f}°" + ("" if abs(degrees) < 0.5 else " left" if degrees > 0 else " right")


def start_words(model: Model, motion: Motion, trace: Trace) -> str:
    """Where the first contact stands at the start, seen along the lane from its middle, and where it points; empty
    for a machine that can't be turned on the plane."""
    machine = model.machine
    if not set(machine.body[0].coordinates) <= set(model.coordinates):
        return ""
    first = machine.contacts[0]
    x, y = edges(model, motion)[0].mean(axis=0)[0]
    heading = float(np.rad2deg(_headings(model, motion)[machine.body.index(first), 0]))
    heading = (heading + 180) % 360 - 180
    along = _beside(float(x), "ahead of the lane's middle", "behind the lane's middle", "level with the lane's middle")
    across = _beside(float(y), "left of it", "right of it", "on its line")
    way = {0: "ahead", 180: "back"}.get(round(abs(heading)), angle_words(heading))
    steered = "".join(
        f"; {lever.name} {angle_words(a) if round(abs(a)) else 'straight'}"
        for lever, a in zip(trace.levers, trace.degrees[0], strict=True)
    )
    name = first.where.replace("_", " ")
    return f"Start, seen along the lane: the middle of the {name} {along} and {across}, pointing {way}{steered}."


def _beside(metres: float, more: str, less: str, none: str) -> str:
    return none if abs(metres) < 0.05 else f"{abs(metres):.1f} m {more if metres > 0 else less}"


def reversals(trace: Trace) -> list[float]:
    """Times [s] at which the direction of travel changes."""
    t = np.arange(0, trace.duration, 0.01)
    v = trace.at(t)[0]
    moving = np.flatnonzero(np.abs(v) > SPEED_STEP / 4)
    turns = moving[1:][np.sign(v[moving[1:]]) != np.sign(v[moving[:-1]])]
    return [float(t[k]) for k in turns]


# ------------------------------------------------------------------------------------------------ driven by a person


def driven(
    model: Model, trace: Trace, who: simulation.Driver | None, seed: int, q0: np.ndarray | None = None
) -> Motion:
    """A person follows the trace, in simulation. Raises SimulationError."""
    rate = float(model.machine.sampling_hz)
    t = np.arange(round(trace.duration * rate) + 1) / rate
    return simulation.follow(model, *trace.at(t), who, seed=seed, q0=q0)


def score(model: Model, motion: Motion) -> Score:
    """cond(Phi) and what accuracy a motion makes attainable (Cramer-Rao, kit full), whoever drives it."""
    sigma = trajectories.percent(model, smoothing.cramer_rao(model, motion))
    worst = int(np.argmax(sigma))
    return Score(
        trajectories.cond_phi(model, motion), float(sigma[worst]), model.base.names[worst], float(np.median(sigma))
    )


def middle(scores: Sequence[Score]) -> Score:
    """The score in the middle of several, by the worst parameter."""
    return sorted(scores, key=lambda s: s.worst_percent)[(len(scores) - 1) // 2]


def broken(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Limits of machine and lane that a motion exceeds by more than BROKEN of their range, with the excess."""
    over = trajectories.check_limits(model, problem, motion)
    return {name: value for name, value in over.items() if value > BROKEN and not trajectories.of_rest(name)}


# ------------------------------------------------------------------------------------------------ room


def edges(model: Model, motion: Motion) -> np.ndarray:
    """Ground tracks of every contact's edges (n_contacts, 2, N, 2) [m]: right and left end of its line of contact."""
    machine = model.machine
    places = model.kinematics(motion.q.T, motion.nu.T)[3].full().reshape(3, len(motion.t), len(machine.body))
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
    """(n_bodies, N) heading [rad] of every body: the root's and the vertical joints' between."""
    machine = model.machine
    at = {c: motion.q[:, k] for k, c in enumerate(model.coordinates)}
    still = np.zeros(len(motion.t))
    heading: dict[int, np.ndarray] = {}
    for b in machine.body:
        own = at.get(f"theta{b.index}", still)
        if isinstance(b.antecedent, str):
            heading[b.index] = own
        else:  # what touches the ground spins about its axle, not about the vertical
            spins = b.contact is not None or b.joint != "revolute"
            heading[b.index] = heading[b.antecedent] + (0.0 if spins else own)
    return np.array([heading[b.index] for b in machine.body])


def room(model: Model, motions: Sequence[Motion]) -> Room:
    """The ground that the contacts' edges touch in any of the drives."""
    points = np.concatenate([edges(model, m).reshape(-1, 2) for m in motions])
    low, high = points.min(axis=0), points.max(axis=0)
    return Room(float(high[0] - low[0]), float(high[1] - low[1]), (float(low[0]), float(low[1])))


def placed(model: Model, problem: Problem, motions: Sequence[Motion]) -> tuple[Motion, ...]:
    """The drives, all from one start, moved there where the first of them lies best in the lane.

    What a machine does on flat ground doesn't depend on where it starts. A drive that keeps the lane stays.
    """
    first = motions[0]
    if trajectories.lane_excess(trajectories.check_limits(model, problem, first)) == 0:
        return tuple(motions)
    return tuple(moved(model, m, trajectories.placed(model, problem, first)) for m in motions)


def moved(model: Model, motion: Motion, start: np.ndarray) -> Motion:
    """The same motion from another place and heading, start (n_q,): turned and shifted over the ground."""
    names = model.machine.body[0].coordinates
    x, y, head = (model.coordinates.index(c) if c in model.coordinates else None for c in names)
    q = motion.q.copy()
    turn = 0.0 if head is None else float(start[head] - q[0, head])
    c, s = np.cos(turn), np.sin(turn)
    flat = np.column_stack([q[:, k] if k is not None else np.zeros(len(q)) for k in (x, y)])
    flat = (flat - flat[0]) @ np.array([[c, s], [-s, c]])
    for k, values in ((x, flat[:, 0]), (y, flat[:, 1])):
        if k is not None:
            q[:, k] = values + start[k]
    if head is not None:
        q[:, head] += turn
    return replace(motion, q=q)


def band(t: np.ndarray, value: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper edge (N,) of the tolerance around a reference (N,) at even times (N,) [s].

    As in drive-cycle testing: within `tolerance` of any value that the reference has less than BAND_S away.
    """
    reach = round(BAND_S / (t[1] - t[0]))
    padded = np.pad(value, reach, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return windows.min(axis=1) - tolerance, windows.max(axis=1) + tolerance
