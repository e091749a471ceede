"""Motions from the readings of encoders and speed sensors alone, by marginal likelihood; a derivative is white noise.

Readings stand at their own times. An encoder is read right after its count has changed, as the moment of an edge gives
the angle; while a count stays, all its readings together say no more than one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.logs import Log, white_noise
from excite.model import Model
from excite.model.machine import noise_of
from excite.smoothing.block_tridiagonal import (
    Factor,
    assemble,
    assemble_columns,
    backward,
    factorise,
    forward,
    gather,
    inverse_blocks,
    windows,
)
from excite.smoothing.measurements import EDGE_STD, MAX_COUNT_ERROR
from excite.smoothing.splines import (
    ORDER,
    WHITE,
    Knots,
    even_knots,
    motion_basis,
    penalty,
    place,
    roughness,
    start_basis,
    unit_log_determinant,
)

START_RANGES = 10.0  # standard deviation of the first state, in ranges of the motion; wide enough to tell nothing
MAX_UPDATES = 40  # of the sizes of motion and noise
SETTLED = 0.02  # relative change of a size that ends them
LEAST_GAIN = 1.0  # of log-likelihood by a size or a finer step that is kept: one more costs as much (Akaike)
COARSEST_STEP = 0.1  # [s] from which knots are refined; machines move within less
FINEST_SHARE = 0.75  # of the rows' distance, below which knots are not halved: two unknowns for two readings
CONDITION = 1e7  # largest ratio of the prior's information to that of a reading; double precision
MANY_UNKNOWNS = 12_000  # of a motion, from which knots are no finer than encoders ask for; for the time's sake
READINGS_PER_STEP = 64  # of the coarsest knots


@dataclass(frozen=True)
class Readings:
    """Readings of one coordinate by one sensor.

    joint: index of the coordinate. derivative: 0 for an angle, 1 for a speed. t, value, std (M,) [s, SI]: std relative
    to a level that the data set, at least `least`. count: size of a count [SI], 0 for an analogue sensor; edge (M,):
    readings of edges, which the angle has passed by `past` (M,) on average. sample: time between rows [s].
    """

    sensor: str
    joint: int
    derivative: int
    t: np.ndarray
    value: np.ndarray
    std: np.ndarray
    least: float
    count: float = 0.0
    edge: np.ndarray | None = None
    sample: float = 0.0


@dataclass(frozen=True)
class Sight:
    """Readings on knots: their intervals (M,), basis rows (M, 6), values (M,) and standard deviations (M,)."""

    readings: Readings
    interval: np.ndarray
    basis: np.ndarray
    rate_basis: np.ndarray
    value: np.ndarray
    std: np.ndarray

    def along(self, coefficients: np.ndarray) -> Sight:
        """Return the readings corrected for the rates of a motion with coefficients (K + 5,)."""
        r = self.readings
        if r.edge is None:
            return self
        near = coefficients[self.interval[:, None] + np.arange(ORDER)]
        travel = np.clip(np.einsum("ri,ri->r", self.rate_basis, near) * r.sample, -r.count, r.count)
        value = np.where(r.edge, r.value + travel / 2, r.value)
        std = np.where(r.edge, np.maximum(np.abs(travel) / np.sqrt(12), EDGE_STD * r.count), r.std)
        return replace(self, value=value, std=std)


def read_motion(model: Model, log: Log) -> list[list[Readings]]:
    """Return the readings of each coordinate of a fully driven machine in a log."""
    found: list[list[Readings]] = [[] for _ in model.coordinates]
    sample = float(log.t[1] - log.t[0])
    for sensor in model.machine.sensors("full"):
        if sensor.kind != "angle" or sensor.name not in log.values:
            continue
        body = model.machine.find(sensor.body)
        joint, ratio = model.coordinates.index(model.machine.coordinate(body)), float(model.machine.ratio(body))
        there = log.read_in(sensor.name)
        value, count = log.values[sensor.name] / ratio, float(sensor.resolution or 0) / abs(ratio)
        known = noise_of(model.machine, sensor) / abs(ratio)
        least = max(float(sensor.least_noise) / abs(ratio), 1e-3 * known, 1e-9 * float(np.ptp(value)), 1e-12)
        if not count or sensor.is_rate:
            noise = max(min(white_noise(log.readings(sensor.name)) / abs(ratio), known or np.inf), least)
            std = np.full(int(there.sum()), noise)
            found[joint].append(
                Readings(sensor.name, joint, int(sensor.is_rate), log.t[there], value[there], std, least)
            )
            continue
        found[joint].append(_encoder_readings(log, sensor.name, joint, value, count, there, sample))
    return found


def _encoder_readings(
    log: Log, name: str, joint: int, value: np.ndarray, count: float, there: np.ndarray, sample: float
) -> Readings:
    """Return the readings of an encoder: edges, and one reading's worth while a count stays."""
    counts = np.round(value / count)
    uniform = count / np.sqrt(12)
    if name in log.edges:
        passed = log.edges[name] / (log.values[name][0] / value[0] if value[0] else 1.0)
        edge = np.isfinite(passed) & there
        at = np.where(edge, passed, value)
    elif np.abs(value - counts * count)[there].max() > MAX_COUNT_ERROR * count:
        return Readings(name, joint, 0, log.t[there], value[there], np.full(int(there.sum()), uniform), uniform)
    else:
        change = np.diff(counts, prepend=counts[0])
        edge = (change != 0) & there & np.append(True, there[:-1])
        at = np.where(edge, (counts + (change < 0)) * count, (counts + 0.5) * count)
    run = np.cumsum(edge)
    length = np.bincount(run)[run]
    std = np.where(edge, uniform, uniform * np.sqrt(length))
    return Readings(name, joint, 0, log.t[there], at[there], std[there], 1.0, count, edge[there], sample)


def look(knots: Knots, readings: Sequence[Readings]) -> tuple[Sight, ...]:
    """Put readings on knots."""
    found = []
    for r in readings:
        interval, share = place(knots, r.t)
        basis = motion_basis(knots, share)
        found.append(Sight(r, interval, basis[:, r.derivative], basis[:, 1], r.value, r.std))
    return tuple(found)


def reading_terms(
    knots: Knots, sight: Sight, level: float, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return information (K, 6, 6), slope (K, 6) and cost of readings at coefficients (K + 5,), by interval."""
    weight = 1 / (level * sight.std) ** 2
    misfit = sight.value - predicted(sight, coefficients)
    weighted = sight.basis * weight[:, None]
    information, slope = np.zeros((knots.count, ORDER, ORDER)), np.zeros((knots.count, ORDER))
    first = np.flatnonzero(np.diff(sight.interval, prepend=-1))
    if len(first):
        at = sight.interval[first]
        information[at] = np.add.reduceat(weighted[:, :, None] * sight.basis[:, None, :], first, axis=0)
        slope[at] = np.add.reduceat(weighted * misfit[:, None], first, axis=0)
    return information, slope, float(weight @ misfit**2)


def predicted(sight: Sight, coefficients: np.ndarray) -> np.ndarray:
    """Return what a sensor should read (M,) along a motion with coefficients (K + 5,)."""
    near = coefficients[sight.interval[:, None] + np.arange(ORDER)]
    return np.asarray(np.einsum("ri,ri->r", sight.basis, near))


def reading_freedom(sight: Sight, level: float, covariance: np.ndarray) -> float:
    """Return the degrees of freedom that readings spend, from covariances (K, 6, 6) of each interval's coefficients."""
    spread = np.einsum("ri,rij,rj->r", sight.basis, covariance[sight.interval], sight.basis, optimize=True)
    return float((spread / (level * sight.std) ** 2).sum())


@dataclass(frozen=True)
class StartPrior:
    """Prior of q, q', q'' and on (m,), up to the white derivative, at the first knot: mean and information."""

    mean: np.ndarray
    information: np.ndarray


def start_prior(readings: Sequence[Readings], knots: Knots) -> StartPrior:
    """Return a prior of the first state that tells nothing, but that the angle is zero if only speeds are read."""
    angles = [r for r in readings if r.derivative == 0]
    mean, duration = np.zeros(knots.white), knots.step * knots.count
    if angles:
        span = max(float(np.ptp(r.value)) for r in angles)
        mean[0] = angles[0].value[0]
    else:
        span = max(float(np.ptp(r.value)) for r in readings) * duration
    size = START_RANGES * max(span, 1e-6)
    least = min(float(r.std.min()) for r in readings)
    shortest = max(duration / 100, 1e-3)
    std = size / shortest ** np.arange(float(knots.white))
    std[0] = size if angles else least * 1e-2
    return StartPrior(mean, std**-2)


def prior_log_determinant(knots: Knots, start: StartPrior, intensity: float) -> float:
    """Natural logarithm of the determinant of the prior's information about the coefficients of one coordinate."""
    m, free = knots.white, knots.count + ORDER - 1 - knots.white
    return float(
        np.log(start.information).sum()
        - free * np.log(intensity)
        - ((2 * m - 1) * free + m * (m - 1)) * np.log(knots.step)
        + unit_log_determinant(knots.count, m)
    )


def prior_terms_of_motion(
    knots: Knots, start: StartPrior, intensity: np.ndarray | float, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return information (K, 6, 6) and slope (K, 6) of a motion's prior; intensity: one, or that of each interval."""
    near = coefficients[np.arange(knots.count)[:, None] + np.arange(ORDER)]
    stiffness = np.broadcast_to(1 / np.asarray(intensity), (knots.count,))
    information = stiffness[:, None, None] * penalty(knots)
    slope = -stiffness[:, None] * roughness(knots, near)[1]
    first = start_basis(knots)
    weighted = first.T * start.information
    information[0] += weighted @ first
    slope[0] += weighted @ (start.mean - first @ near[0])
    return information, slope


def start_cost(knots: Knots, start: StartPrior, coefficients: np.ndarray) -> float:
    """Return twice the negative logarithm of the density of the first state."""
    off = start_basis(knots) @ coefficients[:ORDER] - start.mean
    return float(start.information @ off**2)


@dataclass(frozen=True)
class JointMotion:
    """Motion of one joint in all logs: coefficients (K + 5,) of each, intensity, level of each sensor's noise.

    log_likelihood: marginal, of all readings of the joint.
    """

    coefficients: tuple[np.ndarray, ...]
    white: int
    intensity: float
    level: dict[str, float]
    log_likelihood: float


def speed_std(readings: Sequence[Sequence[Readings]], motion: JointMotion) -> float | None:
    """Return the standard deviation of a joint's smoothed speed [rad/s, m/s]; None without readings of its position.

    readings: of the joint in each log. With positions of information density 1 / R [1/SI^2 s] and a white derivative
    of order m and intensity r, the error of the speed has the spectrum w^2 R / (1 + w^2m R / r), whose integral is
    R (r / R)^(3 / 2m) / (2 m sin(3 pi / 2m)); for m = 3 that is sqrt(r R) / 6.
    """
    information, time = 0.0, 0.0
    for own in readings:
        positions = [r for r in own if r.derivative == 0]
        information += sum(float(((motion.level[r.sensor] * r.std) ** -2.0).sum()) for r in positions)
        time += max((float(np.ptp(r.t)) for r in positions), default=0.0)
    if not (information > 0 and time > 0):
        return None
    R, share = time / information, 1.5 / motion.white
    return float(np.sqrt(R * (motion.intensity / R) ** share / (2 * motion.white * np.sin(np.pi * share))))


def smooth_joint(
    knots: Sequence[Knots], readings: Sequence[Sequence[Readings]], before: JointMotion | None = None
) -> JointMotion | None:
    """Smooth the readings of one joint in all logs, with the sizes that are most likely.

    before: a motion whose sizes are good ones to begin with. Returns None if the readings leave the motion open.
    """
    sights = [look(k, r) for k, r in zip(knots, readings, strict=True)]
    starts = [start_prior(r, k) for k, r in zip(knots, readings, strict=True)]
    level = dict(before.level) if before else {s.readings.sensor: 1.0 for own in sights for s in own}
    white = knots[0].white
    intensity = before.intensity if before and before.white == white else _first_intensity(readings, white)
    coefficients = [np.zeros(k.size) for k in knots]
    for pass_count in range(MAX_UPDATES):
        rough, free, value = 0.0, 0.0, 0.0
        square = dict.fromkeys(level, 0.0)
        freedom = dict.fromkeys(level, 0.0)
        number = dict.fromkeys(level, 0)
        for n, (k, start) in enumerate(zip(knots, starts, strict=True)):
            solved = _smooth_chain(k, sights[n], start, intensity, level)
            if solved is None:
                return None
            coefficients[n], factor = solved
            covariance = gather(windows(k.count, ORDER, 1), inverse_blocks(factor))
            own_rough = float(roughness(k, coefficients[n][np.arange(k.count)[:, None] + np.arange(ORDER)])[0].sum())
            rough += own_rough
            free += k.size - white - float((covariance * penalty(k)).sum()) / intensity
            value += (
                prior_log_determinant(k, start, intensity)
                - factor.log_determinant
                - own_rough / intensity
                - start_cost(k, start, coefficients[n])
            )
            for s in sights[n]:
                name, misfit = s.readings.sensor, s.value - predicted(s, coefficients[n])
                own = float(((misfit / s.std) ** 2).sum())
                square[name] += own
                number[name] += len(misfit)
                freedom[name] += reading_freedom(s, level[name], covariance)
                value -= own / level[name] ** 2 + 2 * float(np.log(level[name] * s.std).sum())
            sights[n] = tuple(s.along(coefficients[n]) for s in sights[n])
        changed = np.clip(rough / max(free, 1e-3 * len(knots)) / intensity, 0.05, 20.0)
        largest = abs(np.log(changed))
        intensity = max(intensity * changed, least_intensity(knots, sights, level))
        for own_sights in sights[:1]:
            for s in own_sights:
                name = s.readings.sensor
                if s.readings.edge is not None:
                    continue  # the size of a count is known
                left = max(number[name] - freedom[name], 1e-3 * number[name])
                least = s.readings.least / float(s.readings.std[0])
                new = max(level[name] * np.clip(np.sqrt(square[name] / left) / level[name], 0.3, 3.0), least)
                largest = max(largest, 2 * abs(np.log(new / level[name])))
                level[name] = float(new)
        if largest < SETTLED and pass_count:
            break
    return JointMotion(tuple(coefficients), white, float(intensity), level, value / 2)


def least_intensity(knots: Sequence[Knots], sights: Sequence[Sequence[Sight]], level: dict[str, float]) -> float:
    """Return an intensity so small that a larger prior would only spoil the condition of the system."""
    noise = min(level[s.readings.sensor] * float(s.std.min()) for own in sights for s in own)
    return noise**2 / (CONDITION * max(k.step for k in knots) ** (2 * knots[0].white - 1))


def _first_intensity(readings: Sequence[Sequence[Readings]], white: int) -> float:
    """Return an intensity to begin with, from the range of the angles and a usual time of a second."""
    spans = [float(np.ptp(r.value)) for own in readings for r in own]
    return max(max(spans), 1e-6) ** 2 * 10.0**white


def _smooth_chain(
    knots: Knots, sights: Sequence[Sight], start: StartPrior, intensity: float, level: dict[str, float]
) -> tuple[np.ndarray, Factor] | None:
    """Return the most likely coefficients (K + 5,) and the factor of their information, None if it is singular."""
    zero = np.zeros(knots.size)
    information, slope = prior_terms_of_motion(knots, start, intensity, zero)
    for s in sights:
        own, pull, _ = reading_terms(knots, s, level[s.readings.sensor], zero)
        information += own
        slope += pull
    w = windows(knots.count, ORDER, 1)
    factor = factorise(assemble(w, information))
    if factor is None:
        return None
    columns = np.zeros((w.blocks * w.per_block, 1, 1))
    assemble_columns(w, slope[:, :, None], 0, columns)
    solution = backward(factor, forward(factor, columns.reshape(w.blocks, w.block_size, 1)))
    return solution.reshape(-1)[: knots.size], factor


def choose_knots(
    logs: Sequence[Log], readings: Sequence[Sequence[Sequence[Readings]]]
) -> tuple[list[Knots], list[JointMotion]]:
    """Choose the widest knots that lose no likelihood of the readings, and for each joint its most likely motion.

    readings: by log and joint. Returns knots, and the motion of each joint with the derivative that is white. All logs
    have knots of one step, which is halved down to a row while the marginal likelihood of the readings gains by it.
    """
    sample = min(float(log.t[1] - log.t[0]) for log in logs)
    halvings = 1 + max(0, int(np.floor(np.log2(min(COARSEST_STEP / sample, READINGS_PER_STEP)))))
    best: tuple[list[Knots], list[JointMotion]] | None = None
    for k in range(halvings, 0, -1):
        knots = [even_knots(float(log.t[0]), float(log.t[-1]), sample * 2.0 ** (k - 1)) for log in logs]
        motions = _smooth_joints(knots, readings, best[1] if best else None)
        if motions is None or (best is not None and _likelihood(motions) - _likelihood(best[1]) < LEAST_GAIN):
            break
        best = knots, motions
    assert best is not None
    best = best[0], [_whiter(best[0], [own[j] for own in readings], m) for j, m in enumerate(best[1])]
    unknowns = sum(k.count for k in best[0]) * len(readings[0])
    while best[0][0].step > FINEST_SHARE * sample and unknowns <= MANY_UNKNOWNS:  # torques show more than encoders do
        unknowns *= 2
        knots = [replace(k, step=k.step / 2, count=2 * k.count) for k in best[0]]
        motions = _smooth_joints(knots, readings, best[1])
        if motions is None:
            break
        best = knots, motions
    return best


def _whiter(knots: Sequence[Knots], readings: Sequence[Sequence[Readings]], motion: JointMotion) -> JointMotion:
    """Return the motion of one joint with the derivative that is most likely white."""
    for white in WHITE[1:]:
        found = smooth_joint([replace(k, white=white) for k in knots], readings, motion)
        if found is None or found.log_likelihood - motion.log_likelihood < LEAST_GAIN:
            break
        motion = found
    return motion


def _smooth_joints(
    knots: Sequence[Knots],
    readings: Sequence[Sequence[Sequence[Readings]]],
    before: Sequence[JointMotion] | None,
) -> list[JointMotion] | None:
    found: list[JointMotion] = []
    for j in range(len(readings[0])):
        start = before[j] if before else None
        own = [replace(k, white=start.white) for k in knots] if start else knots
        motion = smooth_joint(own, [log[j] for log in readings], start)
        if motion is None:
            return None
        found.append(motion)
    return found


def _likelihood(motions: Sequence[JointMotion]) -> float:
    return sum(m.log_likelihood for m in motions)
