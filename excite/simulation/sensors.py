"""Simulated sensors: the log of a motion with quantisation, noise and offsets, and its inverse for torques."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import scipy

from excite.model import Model, machine
from excite.model.machine import Sensor
from excite.simulation.integrator import Motion

KITS = ("paper", "full")
BOOST_PRESSURE = 15e5  # Pa, in the hydraulic line that does not push; chosen
SENSOR_STREAM = 1  # stream of random numbers, independent of the driver's under the same seed


def measure(
    model: Model, motion: Motion, X: np.ndarray | None = None, kit: str = "full", seed: int = 0, noise: bool = True
) -> pd.DataFrame:
    """Return the log (N rows) of a motion that a kit's sensors would write, in their own units and columns.

    X (n_base,): parameters, with the torque offsets u0. noise: False for exact readings, which keep these offsets.
    An encoder counts whole steps from a random phase between two edges; noise is white and normal. A sensor slower than
    the log has no number in the rows between its readings. The column of a drive with a known loop holds its command.
    Raises ValueError for an unknown kit.
    """
    if kit not in KITS:
        raise ValueError(f"kit: {kit} is unknown, allowed: {', '.join(KITS)}")
    exact = exact_readings(model, motion, X)
    rng = np.random.default_rng([seed, SENSOR_STREAM])
    columns = model.machine.clocks(motion.t)
    for sensor in model.machine.sensors(kit):
        read = exact[sensor.name]
        if sensor.loop is not None:
            read = machine.before_loop(sensor.loop, read, 1 / float(model.machine.sampling_hz))
        if noise:
            read = _with_sensor_errors(sensor, read, machine.noise_of(model.machine, sensor), rng)
        if sensor.rate_hz is not None:
            read = np.where(_reads_in_row(motion.t, float(sensor.rate_hz)), read, np.nan)
        columns |= _as_columns(sensor, read, _joint_angle(model, motion, sensor))
    return pd.DataFrame(columns)


def _reads_in_row(t: np.ndarray, rate: float) -> np.ndarray:
    """Tell the rows (N,) at times t (N,) [s] in which a sensor with `rate` readings per second has one."""
    count = np.floor((t - t[0]) * rate + 1e-6)
    return np.diff(count, prepend=-1) > 0


def _as_columns(sensor: Sensor, read: np.ndarray, angle: np.ndarray) -> dict[str, np.ndarray]:
    """Convert a reading (N,) [SI] to its columns: in the file's unit, or two pressures at joint angles (N,) [rad].

    One side of a motor or cylinder pushes, the other is at BOOST_PRESSURE.
    """
    if sensor.return_column is None:
        return {sensor.column: (read + sensor.shift) / sensor.gain}
    push, pull = machine.torque_per_pressure(sensor.displacement, sensor.cylinders, angle)
    more = read - (push + pull) * BOOST_PRESSURE
    forward = more * push > 0
    pascal = sensor.gain if sensor.displacement is None else sensor.gain * 2 * np.pi / float(sensor.displacement)
    return {
        sensor.column: (BOOST_PRESSURE + np.where(forward, more / push, 0)) / pascal,
        sensor.return_column: (BOOST_PRESSURE + np.where(forward, 0, more / pull)) / pascal,
    }


def _joint_angle(model: Model, motion: Motion, sensor: Sensor) -> np.ndarray:
    """Return the angle (N,) [rad] of a sensor's joint, zero if it is locked or has none."""
    names = model.machine.find(sensor.body).coordinates
    k = model.coordinates.index(names[0]) if names and names[0] in model.coordinates else None
    return np.zeros(len(motion.t)) if k is None else motion.q[:, k]


def exact_readings(model: Model, motion: Motion, X: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return readings (N,) [SI] by sensor name without noise and quantisation.

    Torques include the offset u0, and readings the effects that sit in a sensor.
    """
    X = model.nominal if X is None else X
    arrays = (motion.q, motion.nu, motion.wheels, motion.u, motion.memory)
    values = dict(zip(model.reading_names, model.read(*(x.T for x in arrays), X).full(), strict=True))
    torques = measured_torques(model, motion.t, motion.u, X)
    for sensor in model.machine.sensors("full"):
        if sensor.kind == "torque":
            values[sensor.name] = torques[:, model.inputs.index(f"u{sensor.body}")]
    return values


def measured_torques(model: Model, t: np.ndarray, u: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return readings (N, n_u) of the torque channels from delivered torques u (N, n_u) [N m] at times t (N,) [s]."""
    channels = (x.full() for x in model.channels(t[None], X))
    each = zip(u.T, *channels, strict=True)
    return np.column_stack([measured_torque(t, *one) for one in each])


def measured_torque(
    t: np.ndarray, delivered: np.ndarray, gain: np.ndarray, offset: np.ndarray, delay: np.ndarray
) -> np.ndarray:
    """Return the readings (N,) of a channel from the delivered torque (N,) [N m]; gain, offset, delay [s]: (N,)."""
    return np.asarray(gain * np.interp(t - delay, t, delivered) + offset)


def delivered_torque(
    t: np.ndarray, read: np.ndarray, gain: np.ndarray, offset: np.ndarray, delay: np.ndarray
) -> np.ndarray:
    """Return the delivered torque (N,) [N m] behind the readings (N,) of a channel; gain, offset, delay [s]: (N,).

    A delay shifts the smooth part only: noise that is shifted between samples would be averaged, and every delay but
    zero would seem to explain it.
    """
    if np.any(delay):
        smooth = smooth_part(read)
        late = np.clip(t + delay, t[0], t[-1])
        read = read + scipy.interpolate.CubicSpline(t, smooth)(late) - smooth
    return np.asarray((read - offset) / gain)


SMOOTHING_SAMPLES = 4  # standard deviation of the window that leaves the smooth part of readings; chosen


def smooth_part(read: np.ndarray) -> np.ndarray:
    """Return the smooth part of readings (N, ...), without most of their noise."""
    return np.asarray(scipy.ndimage.gaussian_filter1d(read, SMOOTHING_SAMPLES, axis=0))


def delivered_torques(t: np.ndarray, read: np.ndarray, channels: Sequence[np.ndarray]) -> np.ndarray:
    """Return the delivered torques (N, n_u) [N m] behind the readings (N, n_u) of all channels.

    channels: gain, offset, delay, (n_u, N) each.
    """
    return np.column_stack([delivered_torque(t, *each) for each in zip(read.T, *channels, strict=True)])


def _with_sensor_errors(sensor: Sensor, exact: np.ndarray, std: float, rng: np.random.Generator) -> np.ndarray:
    """Add quantisation or noise to exact readings (N,). std [SI]: of the noise."""
    step = sensor.resolution
    if step is not None:
        phase = rng.uniform()
        counts = np.floor(exact / step + phase)
        return (counts - counts[0]) * step + np.round(exact[0] / step) * step
    read = exact
    if sensor.noise is not None:
        read = exact + std * rng.standard_normal(len(exact))
    if sensor.kind == "ground_speed":
        read = np.abs(read)
    if sensor.step is not None:
        read = np.round(read / float(sensor.step)) * float(sensor.step)
    return read
