"""From a log to the rows of a regression: filtering, derivatives, decimation, the model's regressor."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy

from excite.errors import LogError
from excite.logs.log import Log
from excite.model import Model
from excite.model.machine import Filter, Sensor

BLOCK = 10_000  # samples whose regressor is in memory at once
REACH = 200  # decimated rows after which the decimation filter has forgotten the edge of a block (1e-15)


@dataclass(frozen=True)
class Samples:
    """A log as the regressor needs it: q, nu, a (n_q, N) and Y (n_rows, N), all at the log's rate; for a machine with
    effects also what they answer to, torques (n_u, N) and what they remember (n_z, N)."""

    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    Y: np.ndarray
    beside: tuple[np.ndarray, ...] = ()


def filtered_regression(model: Model, log: Log, filter: Filter, block: int = BLOCK) -> tuple[np.ndarray, np.ndarray]:
    """W (n_rows, n, n_base) and Y (n_rows, n) of a log: prediction's regressor, filtered in parallel and decimated."""
    return regression(model, samples(model, log, filter), filter, block)


def regression(model: Model, s: Samples, filter: Filter, block: int = BLOCK) -> tuple[np.ndarray, np.ndarray]:
    """Return filtered, decimated rows of regressor and measurement from samples. The regressor at the log's rate is
    never in memory as a whole: it is made, filtered and decimated in blocks that overlap as far as the filter
    reaches."""
    first, last = filter.drop[0], s.q.shape[1] - filter.drop[1]
    W = np.concatenate(list(_blocks(model, s, first, last, filter.decimation, block)), axis=1)
    # Linearised at the nominal values, the prediction is W X less the columns of encoder zeros times these.
    return W, decimate(s.Y[:, first:last], filter.decimation) + W[:, :, model.zeros] @ model.nominal[model.zeros]


def _blocks(model: Model, s: Samples, first: int, last: int, factor: int, block: int) -> Iterator[np.ndarray]:
    """Decimated rows W (n_rows, n, n_base) of samples first .. last, one stretch after another."""
    kept = kept_samples(first, last, factor)
    reach = REACH * factor if factor > 1 else 0
    count = max(1, block // factor)
    for at in range(0, len(kept), count):
        mine = kept[at : at + count]
        low, high = max(first, mine[0] - reach), min(last, mine[-1] + 1 + reach)
        W = model.stacked_regressor(*(x[:, low:high] for x in (s.q, s.nu, s.a, *s.beside))).transpose(1, 0, 2)
        yield (W if factor == 1 else smooth(W, factor))[:, mine - low]


def kept_samples(first: int, last: int, factor: int) -> np.ndarray:
    """Return the samples that a decimation keeps: the last of first .. last and every factor-th before it."""
    return np.arange(first + (last - first - 1) % factor, last, factor)


def samples(model: Model, log: Log, filter: Filter) -> Samples:
    """Coordinates, velocities and accelerations of a log: zero-phase Butterworth of what is measured, then central
    differences. V_x and yaw rate come from measuring wheels (32), forward speeds and, if these leave it open, the gyro;
    V_y from its sensor; the heading begins at zero. A V_x that none of them measures is that of rolls without slip.
    """
    machine = model.machine
    rate = float(machine.sampling_hz)
    n_q, N = len(model.coordinates), len(log)
    q, nu = np.zeros((n_q, N)), np.zeros((n_q, N))
    filtered = {
        s.name: lowpass(log.values[s.name], rate, filter) for s in machine.sensors("full") if s.name in log.values
    }
    for sensor in machine.sensors("full"):
        if sensor.name not in filtered:
            continue
        if sensor.kind == "angle":
            body = machine.find(sensor.body)
            k = model.coordinates.index(machine.coordinate(body))
            q[k], nu[k] = (x / machine.ratio(body) for x in _angle_and_rate(sensor, filtered[sensor.name], rate))
    if machine.planar:
        _planar_speed(model, filtered, rate, nu)
        turn = machine.body[0].coordinates[2]
        if turn in model.coordinates:
            k = model.coordinates.index(turn)
            q[k] = scipy.integrate.cumulative_trapezoid(nu[k], dx=1 / rate, initial=0)
    a = np.array([derivative(v, rate) for v in nu])
    Y = np.zeros((n_q, N))
    for sensor in machine.sensors("full"):
        if sensor.kind == "torque":
            Y[model.coordinates.index(machine.find(sensor.body).coordinates[0])] = log.values[sensor.name]
    return Samples(q, nu, a, Y, _beside(model, q, nu, Y))


def _angle_and_rate(sensor: Sensor, x: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Angle and rate (N,) of which a sensor reads one: a rate is summed up from zero, an angle differentiated."""
    if sensor.is_rate:
        return np.asarray(scipy.integrate.cumulative_trapezoid(x, dx=1 / rate, initial=0)), x
    return x, derivative(x, rate)


def _beside(model: Model, q: np.ndarray, nu: np.ndarray, Y: np.ndarray) -> tuple[np.ndarray, ...]:
    """Torques as far as the machine file's offsets tell, and what effects remember, along measured motion."""
    if model.plain:
        return ()
    u = Y[list(model.actuated)] - (model.offsets @ model.nominal)[:, None]
    return u, remember(model, q.T, nu.T, u.T, model.nominal).T


def remember(model: Model, q: np.ndarray, nu: np.ndarray, u: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return the memory of a model's effects (N, n_z) along a motion, from rest, and what a map of the ground tells."""
    n_q, n_u, sample = len(model.coordinates), len(model.inputs), 1 / float(model.machine.sampling_hz)
    at, z = ca.SX.sym("at", 2 * n_q + n_u), ca.SX.sym("z", len(model.memory))
    rate = model.flow(at[:n_q], at[n_q : 2 * n_q], at[2 * n_q :], z, ca.DM(X))
    over = passes(model, model.true_coordinates(q, X), nu, sample) if model.map_inputs else np.zeros((len(q), 0))
    return implicit(ca.Function("flow", [z, at], [rate]), model.initial_memory, np.hstack([q, nu, u]), sample, over)


def passes(model: Model, q: np.ndarray, nu: np.ndarray, step: float) -> np.ndarray:
    """Return the inputs from a map of the ground (N, n_contacts MOST) along a motion with samples `step` [s] apart,
    whose pose follows from its velocities; q (N, n_q): true coordinates."""
    if not model.machine.contacts:
        return np.zeros((len(q), 0))
    at = integrate_pose(model, q, nu, step)
    ground = model.new_ground_map()
    return np.array([ground(one) for one in at])


def integrate_pose(model: Model, q: np.ndarray, nu: np.ndarray, step: float) -> np.ndarray:
    """Return coordinates (N, n_q) with the pose that follows from velocities (N, n_q), from zero, `step` [s] apart."""
    at = q.copy()
    if model.machine.planar:
        x, y, turn = (
            model.coordinates.index(c) if c in model.coordinates else None for c in model.machine.body[0].coordinates
        )

        def summed(v: np.ndarray) -> np.ndarray:
            return np.asarray(scipy.integrate.cumulative_trapezoid(v, dx=step, initial=0))

        none = np.zeros(len(q))
        heading = none if turn is None else summed(nu[:, turn])
        ahead, aside = (none if k is None else nu[:, k] for k in (x, y))
        for k, own in (
            (turn, heading),
            (x, summed(ahead * np.cos(heading) - aside * np.sin(heading))),
            (y, summed(ahead * np.sin(heading) + aside * np.cos(heading))),
        ):
            if k is not None:
                at[:, k] = own
    return at


def implicit(flow: ca.Function, start: np.ndarray, along: np.ndarray, step: float, told: np.ndarray) -> np.ndarray:
    """z (N, n_z) of dz/dt = flow(z, along) for given signals (N, k): linearly implicit Euler, a step [s] a sample. told
    (N, n_told): the last ones of z, which have no rate."""
    if told.shape[1] == len(start):
        return told
    z, at = ca.SX.sym("z", len(start)), ca.SX.sym("at", along.shape[1])
    rate = flow(z, at)
    ahead = z + ca.solve(ca.SX.eye(len(start)) - step * ca.jacobian(rate, z), step * rate)
    buffer, evaluate = ca.Function("step", [z, at], [ca.densify(ahead)], {"cse": True}).buffer()
    # Ten times faster than CasADi's mapaccum, which first makes a node of every step.
    path, now, here = np.empty((len(along), len(start))), np.array(start, float), np.empty(along.shape[1])
    after = np.empty_like(now)
    buffer.set_arg(0, now.data)
    buffer.set_arg(1, here.data)
    buffer.set_res(0, after.data)
    path[0] = now
    for k in range(len(along) - 1):
        here[:] = along[k]
        evaluate()
        path[k + 1] = now[:] = after
    path[:, len(start) - told.shape[1] :] = told
    return path


def unmeasured(model: Model, log: Log) -> tuple[int, ...]:
    """Coordinates of which a log says nothing: `samples` leaves their speed at zero."""
    machine = model.machine
    seen: set[str] = set()
    for sensor in machine.sensors("full"):
        if sensor.name not in log.values:
            continue
        if sensor.kind == "angle":
            seen.add(machine.coordinate(machine.find(sensor.body)))
        elif sensor.kind == "lateral_speed":
            seen.add(machine.body[0].coordinates[1])
    if machine.planar:
        found = planar_speed_sensors(model, log.values)
        seen |= {c for c, known in zip(found.coordinates, found.determined, strict=True) if known}
    return tuple(k for k, c in enumerate(model.coordinates) if c not in seen)


@dataclass(frozen=True)
class PlanarSpeedSensors:
    """Sensors of V_x and yaw rate of the root, linear in both: A (k, n) per unit of each of n free `coordinates`."""

    coordinates: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    A: np.ndarray

    @property
    def determined(self) -> np.ndarray:
        """Coordinates (n,) whose speed the sensors determine."""
        projection = np.linalg.pinv(self.A) @ self.A
        return np.abs(projection - np.eye(len(projection))).max(axis=1, initial=0.0) < 1e-9


def planar_speed_sensors(model: Model, names: Collection[str]) -> PlanarSpeedSensors:
    """Choose the sensors with these names that V_x and yaw rate come from: gyros only if all others leave one open.

    A measuring wheel reads R rate = V_x - lateral yaw (32), as a forward speed does.
    """
    x, _, turn = model.machine.body[0].coordinates
    free = tuple(c for c in (x, turn) if c in model.coordinates)
    there = [s for s in model.machine.sensors("full") if s.name in names]
    rows = {s: np.array([1.0, -s.mounted_at[1]])[: len(free)] for s in there if s.kind in ("wheel", "forward_speed")}
    found = PlanarSpeedSensors(free, tuple(rows), np.array([*rows.values()]).reshape(-1, len(free)))
    gyros = tuple(s for s in there if s.kind == "yaw_rate")
    if found.determined.all() or not gyros:
        return found
    A = np.concatenate([found.A, np.tile([c == turn for c in free], (len(gyros), 1))])
    return PlanarSpeedSensors(free, (*found.sensors, *gyros), A)


def _planar_speed(model: Model, filtered: Mapping[str, np.ndarray], rate: float, nu: np.ndarray) -> None:
    """Put V_x, V_y and yaw rate of the root into velocities nu (n_q, N), from low-passed readings."""
    machine = model.machine
    found = planar_speed_sensors(model, filtered)
    if found.sensors:
        speeds = [
            float(s.radius or 0) * _angle_and_rate(s, filtered[s.name], rate)[1]
            if s.kind == "wheel"
            else filtered[s.name]
            for s in found.sensors
        ]
        for c, value in zip(found.coordinates, np.linalg.lstsq(found.A, np.array(speeds), rcond=None)[0], strict=True):
            nu[model.coordinates.index(c)] = value
    x, across, turn = machine.body[0].coordinates
    if x in found.coordinates and not found.determined[0]:
        rims = [
            float(b.contact.radius) * machine.joint_values(b, nu) for b in machine.contacts if b.contact is not None
        ]
        if rims:
            nu[model.coordinates.index(x)] = np.mean(rims, axis=0)
    yaw = nu[model.coordinates.index(turn)] if turn in model.coordinates else 0.0
    for sensor in machine.sensors("full"):
        if sensor.kind == "lateral_speed" and sensor.name in filtered:
            nu[model.coordinates.index(across)] = filtered[sensor.name] - sensor.mounted_at[0] * yaw


def lowpass(x: np.ndarray, rate: float, filter: Filter) -> np.ndarray:
    """Zero-phase low-pass Butterworth (forward and backward), the ends continued by 3 x order reflected samples.

    Raises LogError for a sampling rate that is too low for the filter.
    """
    if line := too_slow(rate, filter):
        raise LogError(line)
    b, a = scipy.signal.butter(filter.order, float(filter.cutoff_hz) / (rate / 2))
    return np.asarray(scipy.signal.filtfilt(b, a, x, padlen=3 * filter.order))


def too_slow(rate: float, filter: Filter) -> str:
    """Return a line for a rate [Hz] of a log that is too low for the filter, "" otherwise."""
    cutoff = float(filter.cutoff_hz)
    if cutoff < rate / 2:
        return ""
    return (
        f"the log is sampled at {rate:g} Hz, and the filter's cutoff_hz = {cutoff:g} needs more than {2 * cutoff:g}"
        " Hz: write a lower cutoff_hz under [filter] in the machine file"
    )


def derivative(x: np.ndarray, rate: float) -> np.ndarray:
    """Central difference along the last axis; one-sided at the two ends."""
    return np.asarray(np.gradient(x, 1 / rate, axis=-1))


def decimate(x: np.ndarray, factor: int) -> np.ndarray:
    """Every column (axis 1) through one zero-phase low-pass (Chebyshev I, order 8), then every factor-th row.

    The rows kept end with the last one.
    """
    return x if factor == 1 else smooth(x, factor)[:, (x.shape[1] - 1) % factor :: factor]


def smooth(x: np.ndarray, factor: int) -> np.ndarray:
    """The low-pass before a decimation along axis 1."""
    b, a = scipy.signal.cheby1(8, 0.05, 0.8 / factor)
    return np.asarray(scipy.signal.filtfilt(b, a, x, axis=1, padlen=24))
