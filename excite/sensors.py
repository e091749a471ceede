"""What sensors make of a motion: counts, noise, offsets; and the profile of what is expected."""

from __future__ import annotations

import numpy as np
import pandas as pd

from excite.simulate import Motion
from model.machine import Sensor
from model.prediction import Model
from model.units import UNITS

KITS = ("paper", "full")
IDLE = 15e5  # Pa in the line of a hydraulic motor that does not push (boost pressure)
SENSORS = 1  # stream of random numbers: one seed drives and measures, but not with the same numbers


def measure(
    model: Model, motion: Motion, X: np.ndarray | None = None, kit: str = "full", seed: int = 0, noise: bool = True
) -> pd.DataFrame:
    """The log (N rows) that a kit's sensors would write, in their own units and columns.

    X (n_base,) gives the torque offsets u0, which are parameters and stay without noise. An encoder counts whole
    steps from where it was switched on, at a random place between two edges; noise is white and normal.
    Raises ValueError for an unknown kit.
    """
    if kit not in KITS:
        raise ValueError(f"kit: {kit} is unknown, allowed: {', '.join(KITS)}")
    exact = signals(model, motion, X)
    rng = np.random.default_rng([seed, SENSORS])
    columns = {model.machine.time_column: motion.t / UNITS[model.machine.time_unit][1]}
    for sensor in model.machine.sensors(kit):
        read = _flawed(sensor, exact[sensor.name], rng) if noise else exact[sensor.name]
        columns |= _written(sensor, read, float(model.machine.sampling_hz))
    return pd.DataFrame(columns)


def _written(sensor: Sensor, read: np.ndarray, rate: float) -> dict[str, np.ndarray]:
    """A reading (N,) [SI] as its columns: in the file's unit, as a rate, or as the two pressures of a motor."""
    if sensor.summed:
        read = np.gradient(read) * rate
    number = read / sensor.gain
    if sensor.return_column is None:
        return {sensor.column: number}
    idle = IDLE / (sensor.gain * 2 * np.pi / float(sensor.displacement or 1))
    return {sensor.column: np.maximum(number, 0) + idle, sensor.return_column: np.maximum(-number, 0) + idle}


def signals(model: Model, motion: Motion, X: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """What ideal sensors would read, (N,) each by sensor name [SI]; torques include the offset u0.

    Effects that sit in a sensor are in its reading.
    """
    X = model.nominal if X is None else X
    arrays = (motion.q, motion.nu, motion.wheels, motion.u, motion.memory)
    values = dict(zip(model.readable, model.read(*(x.T for x in arrays), X).full(), strict=True))
    gain, offset, delay = (x.full() for x in model.channels(motion.t[None], X))
    for sensor in model.machine.sensors("full"):
        if sensor.kind == "torque":
            k = model.inputs.index(f"u{sensor.body}")
            late = np.interp(motion.t - delay[k], motion.t, motion.u[:, k])
            values[sensor.name] = gain[k] * late + offset[k]
    return values


def _flawed(sensor: Sensor, exact: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    step = sensor.resolution
    if step is not None:
        phase = rng.uniform()
        counts = np.floor(exact / step + phase)
        return (counts - counts[0]) * step + np.round(exact[0] / step) * step
    if sensor.noise is not None:
        return exact + float(sensor.noise) * rng.standard_normal(len(exact))
    return exact
