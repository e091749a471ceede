"""Logs as the smoother reads them: what each sensor measures, when, and how accurately.

An encoder between edges says little, and its error follows the motion. The moment of an edge gives the angle, so only
samples right after a count are used. The noise of other sensors and of torques is estimated from the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from excite.errors import NotIdentifiableError
from excite.logs import Log, integrate_pose, passes, remember, samples, white_noise
from excite.model import Model
from excite.model.machine import Filter, Sensor, noise_of
from excite.smoothing.linearisation import StateSpace
from excite.text import format_number

LEAST_SENSOR_SHARE = 1e-7  # noise over a signal's range, at least: what integration and rounding leave
LEAST_TORQUE_SHARE = 1e-3  # noise of a torque over its root mean square, at least; no sensor is better
# Smallest standard deviation of an encoder edge [counts]: the division error of a good encoder. Without it, slow
# passages, whose edges are timed exactly, would outweigh everything else.
EDGE_STD = 0.1
LEAST_GROUND_SPEED = 5.0  # speed over ground from which a reading is used [standard deviations]; chosen
BEAT_HZ = 3.0  # a beat below this frequency is as slow as the machine's motion [Hz]; chosen
HARMONICS = 4  # of the sawtooth error that are considered; chosen
MAX_BEAT_READINGS = 200  # longest beat that is considered [readings]; chosen
MAX_COUNT_ERROR = 0.01  # deviation from whole counts up to which a signal is read as counts [counts]; chosen


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the noise: torque (n_u,) [N m], sensor (m,) [SI]; for an encoder its count [rad]."""

    torque: np.ndarray
    sensor: np.ndarray


@dataclass(frozen=True)
class Measurements:
    """A log as the smoother reads it.

    torque (N, n_u) [N m], reading (N, m) [SI]: as measured by torque sensors and the sensors of the state space.
    used (N, m): share of each sample that is used, 0 or 1 in a log.
    read_at_edges (m,): encoders of which only the edges are used.
    offset_sensors (m_o,): encoders with unknown start of the count, on whose angle forces depend.
    unbiased: torque and encoder noise enter with their actual covariance, and encoder errors that beat with the clock
        do not reduce a reading's weight (the uncertainty counts them). A torque error then acts on its own interval
        alone. If False, readings are weighted by their information: estimates are steadier, and poorly known
        directions are biased by half a standard deviation or more.
    extra_torque_noise (N - 1, n_u) [N m]: standard deviation that the delivered torque of an interval has beside the
        sensor's noise, or None.
    turned: the first heading may be any, not about zero, where no sensor tells it.
    """

    torque: np.ndarray
    reading: np.ndarray
    used: np.ndarray
    read_at_edges: np.ndarray
    offset_sensors: tuple[int, ...]
    noise: SensorNoise
    unbiased: bool = False
    extra_torque_noise: np.ndarray | None = None
    turned: bool = True

    def until(self, samples: int) -> Measurements:
        """The first samples only."""
        extra = self.extra_torque_noise
        return replace(
            self,
            torque=self.torque[:samples],
            reading=self.reading[:samples],
            used=self.used[:samples],
            extra_torque_noise=None if extra is None else extra[: samples - 1],
        )


@dataclass(frozen=True)
class Trajectory:
    """States and errors that explain one log.

    state (N, n), torque_error (N - 1, n_u) [N m] of each interval, offset (m_o,) of the encoders [SI], ground_inputs
    (N, n_ground): inputs from a map of the ground along the states. lacking (K,): coefficients of the shapes of what
    the model lacks. force_error (N - 1, n_forces): white forces [N, N m, m/s2] on the inputs `StateSpace.forces`.
    """

    state: np.ndarray
    torque_error: np.ndarray
    offset: np.ndarray
    ground_inputs: np.ndarray
    lacking: np.ndarray = field(default_factory=lambda: np.zeros(0))
    force_error: np.ndarray | None = None

    @property
    def sampled_torque_error(self) -> np.ndarray:
        """Torque errors of every sample (N, n_u) [N m]; the last sample has the error of the last interval."""
        return np.concatenate([self.torque_error, self.torque_error[-1:]])

    def until(self, samples: int) -> Trajectory:
        """The first samples only."""
        return replace(
            self,
            state=self.state[:samples],
            torque_error=self.torque_error[: samples - 1],
            ground_inputs=self.ground_inputs[:samples],
        )


def common_sensors(model: Model, logs: Sequence[Log]) -> tuple[str, ...]:
    """Return the names of the sensors that every log has.

    Raises NotIdentifiableError if a driven joint has no torque.
    """
    common = set.intersection(*(set(log.values) for log in logs))
    for body in model.machine.actuated:
        if not any(s.kind == "torque" and s.body == body.index and s.name in common for s in model.machine.sensor):
            raise NotIdentifiableError(f"joint smoothing needs the torque of every driven joint, {body.where} has none")
    return tuple(s.name for s in model.machine.sensors("full") if s.name in common)


def prepare_measurements(space: StateSpace, log: Log, unbiased: bool = False) -> Measurements:
    """Find the encoder edges of a log and estimate the noise of its other sensors."""
    model = space.model
    torques = [torque_sensor(model, body.index) for body in model.machine.actuated]
    torque = np.column_stack([log.values[s.name] for s in torques])
    N, m = len(log), len(space.sensors)
    reading, used = np.empty((N, m)), np.ones((N, m), bool)
    at_edges = np.zeros(m, bool)
    sigma = np.empty(m)
    for j, sensor in enumerate(space.sensors):
        value = log.values[sensor.name]
        count_size = sensor.resolution
        reading[:, j] = value
        there = log.read_in(sensor.name)
        used[:, j] = there
        if count_size is None:
            found = white_noise(log.readings(sensor.name))
            least = 1e-3 * noise_of(model.machine, sensor) or LEAST_SENSOR_SHARE * float(np.ptp(value))
            sigma[j] = max(found, sensor.least_noise, 1e-9 + least)
            if sensor.kind == "ground_speed":  # near standstill noise has no sign, and the mean reading is above zero
                used[:, j] &= value > LEAST_GROUND_SPEED * sigma[j]
            continue
        sigma[j] = count_size
        if sensor.name in log.edges:
            edge = log.edges[sensor.name]
            at_edges[j], used[:, j] = True, np.isfinite(edge) & there
            reading[:, j] = np.where(np.isfinite(edge), edge, value)
            continue
        counts = np.round(value / count_size)
        if np.abs(value - counts * count_size)[there].max() > MAX_COUNT_ERROR * count_size:
            sigma[j] = count_size / np.sqrt(12)
            continue
        at_edges[j] = True
        change = np.diff(counts, prepend=counts[0])
        reading[:, j] = (counts + (change < 0)) * count_size
        used[:, j] = (change != 0) & there & np.append(True, there[:-1])
    # Torques interpolated over k rows err alike in all of them: as much as white noise that is sqrt(k) times as large.
    rows_per_reading = [N / max(len(log.readings(s.name)), 1) for s in torques]
    torque_noise = np.array(
        [
            np.sqrt(k)
            * max(
                log.noise.get(s.name) or white_noise(log.readings(s.name)),
                1e-3 * noise_of(model.machine, s) or LEAST_TORQUE_SHARE * root_mean_square([log], s) or 1e-3,
            )
            for k, s in zip(rows_per_reading, torques, strict=True)
        ]
    )
    return Measurements(
        torque,
        reading,
        used.astype(float),
        at_edges,
        encoders_with_offset(space, at_edges),
        SensorNoise(torque_noise, sigma),
        unbiased,
    )


def encoders_with_offset(space: StateSpace, read_at_edges: np.ndarray) -> tuple[int, ...]:
    """Return the encoders with unknown start of the count, on whose angle forces depend."""
    return tuple(j for j in range(len(read_at_edges)) if read_at_edges[j] and space.angle_state[j] < space.core)


def root_mean_square(logs: Sequence[Log], sensor: Sensor) -> float:
    """Return the root mean square [SI] of a sensor's readings in all logs."""
    return float(np.sqrt(np.mean(np.concatenate([log.values[sensor.name] for log in logs]) ** 2)))


def torque_sensor(model: Model, body: int) -> Sensor:
    return next(s for s in model.machine.sensor if s.kind == "torque" and s.body == body)


def prepare_logs(
    space: StateSpace,
    logs: Sequence[Log],
    filter: Filter,
    unbiased: bool = False,
    extra_torque_noise: Sequence[np.ndarray] | None = None,
) -> tuple[tuple[Measurements, ...], tuple[Trajectory, ...]]:
    """Prepare logs for fits: their measurements, and trajectories to begin with.

    The heading begins at zero in the first log, and at any angle in the others, as nobody logs how a machine was turned
    between them. unbiased: see `prepare_measurements`. extra_torque_noise: of each log, see `Measurements`.
    """
    first, *others = (prepare_measurements(space, log, unbiased) for log in logs)
    measurements = (replace(first, turned=False), *others)
    if extra_torque_noise is not None:
        noisy = zip(measurements, extra_torque_noise, strict=True)
        measurements = tuple(replace(r, extra_torque_noise=x) for r, x in noisy)
    starts = tuple(initial_trajectory(space, r, log, filter) for r, log in zip(measurements, logs, strict=True))
    return measurements, starts


def initial_trajectory(space: StateSpace, data: Measurements, log: Log, filter: Filter) -> Trajectory:
    """Build a first trajectory from the filtered log."""
    filtered = samples(space.model, log, filter)
    full = np.zeros((len(log), space.full_size))
    n_q, n_z = len(space.model.coordinates), len(space.model.memory)
    full[:, :n_q], full[:, n_q : 2 * n_q] = filtered.q.T, filtered.nu.T
    if n_z:
        u, _ = space.delivered_torques(data.torque, space.model.nominal)
        full[:, space.full_size - n_z :] = remember(space.model, filtered.q.T, filtered.nu.T, u, space.model.nominal)
    rate = float(space.model.machine.sampling_hz)
    if any(s.kind in ("x", "y") for s in space.sensors):
        full[:, :n_q] = _on_the_ground(space, data, integrate_pose(space.model, full[:, :n_q], filtered.nu.T, 1 / rate))
    state, ground = space.from_full_state(full)
    for j, k in enumerate(space.angle_state):
        if space.index[k] >= 2 * n_q and k >= 0:
            speed = space.readings(state, space.inputs(data.torque, ground), space.model.nominal)[2][:, j, 0]
            state[:, k] = log.values[space.sensors[j].name][0] + np.concatenate(
                [[0], np.cumsum(speed[1:] + speed[:-1]) / (2 * rate)]
            )
    return Trajectory(state, np.zeros_like(data.torque[1:]), np.zeros(len(data.offset_sensors)), ground)


def _on_the_ground(space: StateSpace, data: Measurements, q: np.ndarray) -> np.ndarray:
    """Turn and shift a path (N, n_q) that begins at zero onto the measured positions, by least squares (Kabsch)."""
    model = space.model
    x, y, turn = (
        model.coordinates.index(c) if c in model.coordinates else None for c in model.machine.body[0].coordinates
    )
    place = {s.kind: (s, j) for j, s in enumerate(space.sensors) if s.kind in ("x", "y")}
    q, rows = q.copy(), [k for k in (x, y) if k is not None]
    heading = q[:, turn] if turn is not None else np.zeros(len(q))
    path = q[:, x or 0] + 1j * (q[:, y] if y is not None else 0.0)
    measured = np.zeros(len(q), complex)
    used = np.ones(len(q), bool)
    for kind, unit in (("x", 1), ("y", 1j)):
        if kind in place:
            sensor, j = place[kind]
            measured += unit * data.reading[:, j]
            used &= data.used[:, j] > 0
            lever = complex(*sensor.mounted_at)
    antenna = path + lever * np.exp(1j * heading)
    if len(place) == 2 and turn is not None:
        correlation = np.vdot(antenna[used] - antenna[used].mean(), measured[used] - measured[used].mean())
        angle = np.angle(correlation)
        q[:, turn] += angle
        path, antenna = path * np.exp(1j * angle), antenna * np.exp(1j * angle)
    path += (measured - antenna)[used].mean()
    for k, part in zip(rows, (path.real, path.imag) if x is not None else (path.imag,), strict=False):
        q[:, k] = part
    return q


def ground_inputs(space: StateSpace, state: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Compute the inputs from a map of the ground (N, n_ground) along states (N, n), at parameters X (n_base,)."""
    if not space.model.map_inputs:
        return np.zeros((len(state), 0))
    q, nu, _ = space.unpack(state)
    return passes(space.model, space.model.true_coordinates(q, X), nu, 1 / float(space.model.machine.sampling_hz))


def smoothed_motion(
    space: StateSpace, data: Measurements, trajectory: Trajectory, X: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the motion of a trajectory: q, nu (N, n_q), memory (N, n_z), delivered torques u (N, n_u),
    accelerations (N, n_q)."""
    q, nu, z = _with_heading(space, trajectory.state)
    z[:, z.shape[1] - trajectory.ground_inputs.shape[1] :] = trajectory.ground_inputs
    u = space.delivered_torques(data.torque, X)[0] + trajectory.sampled_torque_error
    known = () if space.model.plain else (z.T,)
    return q, nu, z, u, space.model.acceleration(q.T, nu.T, u.T, *known, X).full().T


def _with_heading(space: StateSpace, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split states as `unpack`, with a heading that follows from its speed, from zero, where it is no state."""
    q, nu, z = space.unpack(state)
    k = space.model.heading
    if k is not None and k not in space.index:
        q[:, k] = integrate_pose(space.model, q, nu, 1 / float(space.model.machine.sampling_hz))[:, k]
    return q, nu, z


def transfer_trajectory(
    space: StateSpace, data: Measurements, trajectory: Trajectory, source: StateSpace, X: np.ndarray
) -> Trajectory:
    """Convert a trajectory from the state space `source` of the same machine and sensors with other effects."""
    q, nu, _ = _with_heading(source, trajectory.state)
    n_q, n_z = len(space.model.coordinates), len(space.model.memory)
    full = np.zeros((len(trajectory.state), space.full_size))
    shared = source.index < source.full_size - len(source.model.memory)
    full[:, source.index[shared]] = trajectory.state[:, shared]
    full[:, :n_q] = q
    if n_z:
        u, _ = space.delivered_torques(data.torque, X)
        full[:, space.full_size - n_z :] = remember(space.model, q, nu, u, X)
    offsets = dict(zip(encoders_with_offset(source, data.read_at_edges), trajectory.offset, strict=True))
    offset = np.array([offsets.get(j, 0.0) for j in data.offset_sensors])
    state, ground = space.from_full_state(full)
    return Trajectory(state, trajectory.torque_error, offset, ground)


def offset_scale(space: StateSpace, data: Measurements) -> np.ndarray:
    """Scale of the encoder offsets (m_o,) [SI]: one count, as a count starts anywhere between two edges."""
    return np.array([float(space.sensors[j].resolution or 0) for j in data.offset_sensors])


def predict_readings(
    space: StateSpace, data: Measurements, trajectory: Trajectory, u: np.ndarray, X: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Predict the readings along a trajectory under delivered torques u (N, n_u).

    Right after a count, the angle is past the edge by half its travel in a sample, at most half a count.

    Returns readings (N, m), slopes (N, m, n), weights 1 / variance (N, m), offset columns (m, m_o), slopes by
    reading_parameters (N, m, n_f), and the factor by which beating encoder errors exceed this variance (N, m).
    """
    sample = 1 / float(space.model.machine.sampling_hz)
    h, H, rate, Hrate, *direct_slopes = space.readings(trajectory.state, space.inputs(u, trajectory.ground_inputs), X)
    h, H, travel = h[:, :, 0].copy(), H.copy(), rate[:, :, 0] * sample
    count_size = data.noise.sensor
    slow = (np.abs(travel) < count_size) & data.read_at_edges
    h -= np.where(data.read_at_edges, np.clip(travel, -count_size, count_size) / 2, 0.0)
    H[slow] -= Hrate[slow] * (sample / 2)
    std = np.where(
        data.read_at_edges,
        np.maximum(np.minimum(np.abs(travel), count_size) / np.sqrt(12), EDGE_STD * count_size),
        count_size,
    )
    inflation = np.where(data.read_at_edges, beat_inflation(travel / count_size, sample), 1.0)
    if not data.unbiased:
        std, inflation = std * np.sqrt(inflation), np.ones_like(inflation)
    sensor_std, std = std, np.hypot(std, _torque_noise_in_readings(space, data, trajectory, u, X))
    inflation = 1 + (inflation - 1) * (sensor_std / std) ** 2
    D = np.zeros((len(space.sensors), len(data.offset_sensors)))
    for k, j in enumerate(data.offset_sensors):
        D[j, k] = 1.0
    parameter_slopes = direct_slopes[0] if direct_slopes else np.zeros((*h.shape, 0))
    return h + D @ trajectory.offset, H, data.used / std**2, D, parameter_slopes, inflation


def beat_inflation(counts_per_sample: np.ndarray, sample: float) -> np.ndarray:
    """Variance inflation (N, m) of encoder errors that beat with the clock, from counts per sample (N, m).

    If a multiple k of the counts per sample is nearly whole, the k-th harmonic of the sawtooth error (6 / (pi k)^2 of
    its power) is as slow as the machine, and many readings are worth one. White noise worth as little has a variance
    larger by half the beat's period in readings, or by its duration. Between beats the error is white. An encoder with
    less than one count per sample is read at its edges, and samples per edge take the place of counts per sample.
    """
    speed = np.abs(counts_per_sample)
    change = np.abs(np.gradient(speed, axis=0)) if len(speed) > 1 else np.zeros_like(speed)
    edges = np.clip(speed, 1e-3, 1.0)  # per sample
    periods, change = np.maximum(speed, 1.0) / edges, change / edges**3  # encoder periods per reading, or their inverse
    slow = BEAT_HZ * sample / edges  # frequency per reading
    inflation = np.ones_like(speed)
    for k in range(1, HARMONICS + 1):
        distance = np.abs(k * periods - np.round(k * periods))
        duration = 0.5 / np.sqrt(distance**2 + k * change / 4 + (0.5 / MAX_BEAT_READINGS) ** 2)
        inflation += 6 / (np.pi * k) ** 2 * np.where(slow < 0.5, duration / (1 + (distance / slow) ** 4) - 1, 0.0)
    return np.maximum(inflation, 1.0)


def _torque_noise_in_readings(
    space: StateSpace, data: Measurements, trajectory: Trajectory, u: np.ndarray, X: np.ndarray
) -> np.ndarray | float:
    """Standard deviation (N, m) of readings that depend on the torque at the same sample, from torque noise."""
    if not space.readings_use_torque:
        return 0.0
    parts = []
    for k, noise in enumerate(space.delivered_noise(data.noise.torque, X)):
        shift = np.eye(u.shape[1])[k] * noise
        high, low = (
            space.readings(trajectory.state, space.inputs(u + sign * shift, trajectory.ground_inputs), X)[0][:, :, 0]
            for sign in (1, -1)
        )
        parts.append((high - low) / 2)
    return np.linalg.norm(parts, axis=0)


def with_mean_edge_rates(
    space: StateSpace, data: Measurements, trajectory: Trajectory, u: np.ndarray, X: np.ndarray
) -> Measurements:
    """Replace the moments of encoder edges by each encoder's expected rate of edges."""
    travel = np.abs(space.readings(trajectory.state, space.inputs(u, trajectory.ground_inputs), X)[2][:, :, 0]) / float(
        space.model.machine.sampling_hz
    )
    return replace(data, used=np.where(data.read_at_edges, np.minimum(travel / data.noise.sensor, 1.0), 1.0))


def describe_noise(space: StateSpace, measurements: Sequence[Measurements]) -> tuple[str, ...]:
    """Describe the noise found in the logs beside the machine file's, as a note."""
    model = space.model
    levels: list[tuple[Sensor, float]] = []
    for k, body in enumerate(model.machine.actuated):
        level = float(np.sqrt(np.mean([data.noise.torque[k] ** 2 for data in measurements])))
        levels.append((torque_sensor(model, body.index), level))
    for j, sensor in enumerate(space.sensors):
        if sensor.resolution is None:
            levels.append((sensor, float(np.sqrt(np.mean([data.noise.sensor[j] ** 2 for data in measurements])))))
    texts = []
    for sensor, level in levels:
        given = noise_of(model.machine, sensor)
        sheet = f"data sheet {format_number(given, 3)}" if given else "no data sheet"
        texts.append(f"{sensor.name} {format_number(level, 3)} ({sheet})")
    return (f"noise per sample found in the log, SI: {', '.join(texts)}",)
