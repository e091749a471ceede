"""A log as joint smoothing sees it: what each sensor tells, when, and how well.

Encoders count. A count between edges says little, and its error follows the motion; the moment of an edge says where
the angle was, so only samples right after a count are used. Noise of the other sensors and of the torques is found in
the log; the data sheet is for comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.integrate

from excite.errors import NotIdentifiableError
from excite.logs import Log, passes, remember, samples, white_noise
from excite.model import Model
from excite.model.machine import Filter, Sensor
from excite.smoothing.linearisation import Chart

# Least standard deviation of an encoder edge [counts]: what a good encoder's divisions are off. Slow passages, where
# edges come at exact moments, would be believed without end; a third of a count would make little of them.
EDGE = 0.1
BEAT_HZ, HARMONICS = 3.0, 4  # [Hz] below which a beat is as slow as the machine; those of a sawtooth that matter
LONGEST = 200  # readings that one beat is taken to last, at most


@dataclass(frozen=True)
class Noise:
    """What the sensors' noise is taken to be: `torque` (n_u,) [N m]; `sensor` (m,) [SI] of those of a chart, for an
    encoder that counts its step."""

    torque: np.ndarray
    sensor: np.ndarray


@dataclass(frozen=True)
class Record:
    """A log as the smoother sees it: torque (N, n_u) as measured, reading (N, m) of the chart's sensors.

    used (N, m): which samples tell something; counts (m,): encoders read at their edges. origin (m_o,): sensors
    whose absolute value matters and whose count starts anywhere. unbiased: torques' and encoders' noise are set against
    each other as they are, or what a dull drive shows poorly would be off by half a deviation and more. An error of
    the torques acts on its own interval alone; and readings weigh alike whether an encoder beats with the clock or
    not, as noise that beats is white on average over a drive (how sure an estimate is counts the beats all the same).
    Else each reading weighs by what it tells, and weak directions are drawn in a little: steadier, for evidence.
    coarse: how many times as noisy as they are the sensors are taken to be.
    """

    torque: np.ndarray
    reading: np.ndarray
    used: np.ndarray
    counts: np.ndarray
    origin: tuple[int, ...]
    noise: Noise
    unbiased: bool = False
    coarse: float = 1.0

    def until(self, samples: int) -> Record:
        """The first samples only."""
        return replace(self, torque=self.torque[:samples], reading=self.reading[:samples], used=self.used[:samples])


@dataclass(frozen=True)
class Point:
    """Where an iteration stands: states (N, n), torque errors (N - 1, n_u), offsets (m_o,) of one log, and over (N,
    n_over), what a map of the ground tells along these states."""

    s: np.ndarray
    w: np.ndarray
    offset: np.ndarray
    over: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Torque errors of every sample (N, n_u); no interval leads on from the last, which has the one before."""
        return np.concatenate([self.w, self.w[-1:]])

    def until(self, samples: int) -> Point:
        """The first samples only."""
        return replace(self, s=self.s[:samples], w=self.w[: samples - 1], over=self.over[:samples])


def common_sensors(model: Model, logs: Sequence[Log]) -> tuple[str, ...]:
    """Sensors that every log has."""
    common = set.intersection(*(set(log.values) for log in logs))
    for body in model.machine.actuated:
        if not any(s.kind == "torque" and s.body == body.index and s.name in common for s in model.machine.sensor):
            raise NotIdentifiableError(f"joint smoothing needs the torque of every driven joint, {body.where} has none")
    return tuple(s.name for s in model.machine.sensors("full") if s.name in common)


def record(c: Chart, log: Log, unbiased: bool = False) -> Record:
    """A log prepared: encoder edges found, noise of the others estimated from the log itself."""
    model = c.model
    torques = [torque_sensor(model, body.index) for body in model.machine.actuated]
    torque = np.column_stack([log.values[s.name] for s in torques])
    N, m = len(log), len(c.sensors)
    reading, used = np.empty((N, m)), np.ones((N, m), bool)
    counts = np.zeros(m, bool)
    sigma = np.empty(m)
    for j, sensor in enumerate(c.sensors):
        value = log.values[sensor.name]
        step = sensor.resolution
        reading[:, j] = value
        if step is None:
            sigma[j] = max(white_noise(value), 1e-9 + 1e-3 * float(sensor.noise or 0))
            continue
        sigma[j] = step
        n = np.round(value / step)
        if np.abs(value - n * step).max() > 0.01 * step:
            sigma[j] = step / np.sqrt(12)
            continue
        counts[j] = True
        change = np.diff(n, prepend=n[0])
        reading[:, j] = (n + (change < 0)) * step
        used[:, j] = change != 0
    level = np.array([max(white_noise(u), 1e-3 * float(s.noise or 1)) for u, s in zip(torque.T, torques, strict=True)])
    return Record(torque, reading, used.astype(float), counts, origins(c, counts), Noise(level, sigma), unbiased)


def origins(c: Chart, counts: np.ndarray) -> tuple[int, ...]:
    """Encoders whose count starts anywhere while forces depend on the angle itself."""
    return tuple(j for j in range(len(counts)) if counts[j] and c.angle[j] < c.core)


def torque_sensor(model: Model, body: int) -> Sensor:
    return next(s for s in model.machine.sensor if s.kind == "torque" and s.body == body)


def first_point(c: Chart, r: Record, log: Log, filter: Filter) -> Point:
    """States from the filtered log."""
    guess = samples(c.model, log, filter)
    full = np.zeros((len(log), c.full))
    n_q, n_z = len(c.model.coordinates), len(c.model.memory)
    full[:, :n_q], full[:, n_q : 2 * n_q] = guess.q.T, guess.nu.T
    if n_z:
        u, _ = c.delivered(r.torque, c.model.nominal)
        full[:, c.full - n_z :] = remember(c.model, guess.q.T, guess.nu.T, u, c.model.nominal)
    s, over = c.charted(full)
    rate = float(c.model.machine.sampling_hz)
    for j, k in enumerate(c.angle):
        if c.index[k] >= 2 * n_q and k >= 0:
            speed = c.readings(s, c.inputs(r.torque, over), c.model.nominal)[2][:, j, 0]
            s[:, k] = log.values[c.sensors[j].name][0] + np.concatenate(
                [[0], np.cumsum(speed[1:] + speed[:-1]) / (2 * rate)]
            )
    return Point(s, np.zeros_like(r.torque[1:]), np.zeros(len(r.origin)), over)


def driven_over(c: Chart, s: np.ndarray) -> np.ndarray:
    """What a map of the ground tells (N, n_over) along states (N, n)."""
    if not c.model.mapped:
        return np.zeros((len(s), 0))
    q, nu, _ = c.parts(s)
    return passes(c.model, q, nu, 1 / float(c.model.machine.sampling_hz))


def smoothed(
    c: Chart, r: Record, p: Point, X: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The motion at a point: q, nu (N, n_q), what effects remember (N, n_z), delivered torques u (N, n_u), and the
    accelerations (N, n_q) that follow from these."""
    q, nu, z = c.parts(p.s)
    z[:, z.shape[1] - p.over.shape[1] :] = p.over
    u = c.delivered(r.torque, X)[0] + p.errors
    known = () if c.model.plain else (z.T,)
    return q, nu, z, u, c.model.acceleration(q.T, nu.T, u.T, *known, X).full().T


def carried(c: Chart, r: Record, p: Point, of: Chart, X: np.ndarray) -> Point:
    """A point of another chart of the same machine and sensors, whose effects differ, in this chart's states."""
    q, nu, _ = of.parts(p.s)
    machine, rate = c.model.machine, float(c.model.machine.sampling_hz)
    n_q, n_z = len(c.model.coordinates), len(c.model.memory)
    if machine.planar and machine.body[0].coordinates[2] in c.model.coordinates:
        k = c.model.coordinates.index(machine.body[0].coordinates[2])
        if k not in of.index:
            q[:, k] = scipy.integrate.cumulative_trapezoid(nu[:, k], dx=1 / rate, initial=0)
    full = np.zeros((len(p.s), c.full))
    shared = of.index < of.full - len(of.model.memory)
    full[:, of.index[shared]] = p.s[:, shared]
    full[:, :n_q] = q
    if n_z:
        u, _ = c.delivered(r.torque, X)
        full[:, c.full - n_z :] = remember(c.model, q, nu, u, X)
    old = dict(zip(origins(of, r.counts), p.offset, strict=True))
    offset = np.array([old.get(j, 0.0) for j in r.origin])
    s, over = c.charted(full)
    return Point(s, p.w, offset, over)


def one_count(c: Chart, r: Record) -> np.ndarray:
    """Scale of the offsets (m_o,): a count starts at a random place between two edges, half a count on average."""
    return np.array([float(c.sensors[j].resolution or 0) for j in r.origin])


def readings(
    c: Chart, r: Record, p: Point, u: np.ndarray, X: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Expected readings (N, m) under torques u (N, n_u), their slopes (N, m, n), weights (N, m) = 1 / variance, offset
    columns (m, m_o), how readings move with the chart's `flawed` parameters (N, m, n_f), and by how much the noise
    exceeds that variance where it beats, as far as the weights don't say so (N, m).

    Right after a count the angle is past the edge by half of what it travels in a sample, at most half a step.
    """
    sample = 1 / float(c.model.machine.sampling_hz)
    h, H, rate, Hrate, *flaws = c.readings(p.s, c.inputs(u, p.over), X)
    h, H, travel = h[:, :, 0].copy(), H.copy(), rate[:, :, 0] * sample
    step = r.noise.sensor
    slow = (np.abs(travel) < step) & r.counts
    h -= np.where(r.counts, np.clip(travel, -step, step) / 2, 0.0)
    H[slow] -= Hrate[slow] * (sample / 2)
    width = np.where(r.counts, np.maximum(np.minimum(np.abs(travel), step) / np.sqrt(12), EDGE * step), step)
    beats = np.where(r.counts, beating(travel / step, sample), 1.0)
    if not r.unbiased:
        width, beats = width * np.sqrt(beats), np.ones_like(beats)
    width = width * r.coarse
    own, width = width, np.hypot(width, _through(c, r, p, u, X))
    beats = 1 + (beats - 1) * (own / width) ** 2
    D = np.zeros((len(c.sensors), len(r.origin)))
    for k, j in enumerate(r.origin):
        D[j, k] = 1.0
    by = flaws[0] if flaws else np.zeros((*h.shape, 0))
    return h + D @ p.offset, H, r.used / width**2, D, by, beats


def beating(counts: np.ndarray, sample: float) -> np.ndarray:
    """By how much more an encoder's error weighs (N, m) where it beats with the clock, from counts per sample (N, m).

    Where a multiple k of them is nearly whole, the k-th harmonic of the error (a sawtooth's: 6 / (pi k)^2 of its power)
    is as slow as the machine, and a hundred readings tell no more than one: white noise that tells as little is larger
    by half a period of the beat in readings, or by as many as it lasts. Between beats the error counts as white. Of an
    encoder with less than one count per sample only its edges are read, and it is the clock's samples per edge that
    count.
    """
    speed = np.abs(counts)
    change = np.abs(np.gradient(speed, axis=0)) if len(speed) > 1 else np.zeros_like(speed)
    edges = np.clip(speed, 1e-3, 1.0)  # readings per sample
    turns, change = np.maximum(speed, 1.0) / edges, change / edges**3  # per reading: of the one in periods of the other
    slow = BEAT_HZ * sample / edges  # per reading
    more = np.ones_like(speed)
    for k in range(1, HARMONICS + 1):
        off = np.abs(k * turns - np.round(k * turns))
        lasts = 0.5 / np.sqrt(off**2 + k * change / 4 + (0.5 / LONGEST) ** 2)
        more += 6 / (np.pi * k) ** 2 * np.where(slow < 0.5, lasts / (1 + (off / slow) ** 4) - 1, 0.0)
    return np.maximum(more, 1.0)


def _through(c: Chart, r: Record, p: Point, u: np.ndarray, X: np.ndarray) -> np.ndarray | float:
    """Standard deviation that noise of the torques makes in readings (N, m) which they enter at once, as by a play."""
    if not c.leaning:
        return 0.0
    parts = []
    for k, noise in enumerate(c.felt(r.noise.torque, X)):
        shift = np.eye(u.shape[1])[k] * noise
        high, low = (c.readings(p.s, c.inputs(u + sign * shift, p.over), X)[0][:, :, 0] for sign in (1, -1))
        parts.append((high - low) / 2)
    return np.linalg.norm(parts, axis=0)


def expected(c: Chart, r: Record, p: Point, u: np.ndarray, X: np.ndarray) -> Record:
    """The record with how often each encoder counts, on average, in place of when."""
    travel = np.abs(c.readings(p.s, c.inputs(u, p.over), X)[2][:, :, 0]) / float(c.model.machine.sampling_hz)
    return replace(r, used=np.where(r.counts, np.minimum(travel / r.noise.sensor, 1.0), 1.0))


def noise_notes(c: Chart, records: Sequence[Record]) -> tuple[str, ...]:
    """The noise found in the logs beside the machine file's."""
    model = c.model
    found: list[tuple[Sensor, float]] = []
    for k, body in enumerate(model.machine.actuated):
        level = float(np.sqrt(np.mean([r.noise.torque[k] ** 2 for r in records])))
        found.append((torque_sensor(model, body.index), level))
    for j, sensor in enumerate(c.sensors):
        if sensor.resolution is None:
            found.append((sensor, float(np.sqrt(np.mean([r.noise.sensor[j] ** 2 for r in records])))))
    texts = []
    for sensor, level in found:
        sheet = f"data sheet {float(sensor.noise):.3g}" if sensor.noise is not None else "no data sheet"
        texts.append(f"{sensor.name} {level:.3g} ({sheet})")
    return (f"noise per sample found in the log, SI: {', '.join(texts)}",)
