"""Logs as estimation uses them, as tables: on an even grid, repaired, in the machine file's columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from excite.logs.log import Log
from excite.logs.preparation import prepare
from excite.logs.repair import examine
from excite.model import Model
from excite.model.machine import Machine, Sensor

SLOW_SHARE = 0.7  # of its rows that a channel was read in, below which it is a slower one, blank in the others; chosen


def convert(model: Model, path: str | Path, si: bool = False) -> tuple[list[pd.DataFrame], float, list[str]]:
    """Read a log as estimation does; return a table of each stretch, their rate [Hz], and notes of what was done.

    Columns are the machine file's, in its units; si: named after the sensors, in SI units. Time begins at zero in each
    table. Raises LogError for a log that cannot be used.
    """
    ready = prepare(model, [path])
    machine, tables, notes = ready.model.machine, list[pd.DataFrame](), list(ready.notes)
    for one in ready.logs:
        found = examine(machine, one)
        notes += [*found.notes, *found.doubts]
        tables.append(table_from(machine, found.log, si))
    return tables, float(machine.sampling_hz), list(dict.fromkeys(notes))


def table_from(machine: Machine, log: Log, si: bool = False) -> pd.DataFrame:
    """Build the table of a log; columns as in `convert`."""
    columns = {"t_s": log.t} if si else machine.clocks(log.t)
    for sensor in machine.sensors("full"):
        if sensor.name not in log.values:
            continue
        x, there = log.values[sensor.name], log.read_in(sensor.name)
        if there.mean() < SLOW_SHARE:
            x = np.where(there, x, np.nan)
        columns |= {f"{sensor.name} [{machine.si_unit(sensor)}]": x} if si else _in_file_units(machine, sensor, x)
    return pd.DataFrame(columns)


def _in_file_units(machine: Machine, sensor: Sensor, x: np.ndarray) -> dict[str, np.ndarray]:
    """Build the columns of a sensor; pressures of cylinders and commands of drives become the torque in SI."""
    if sensor.cylinders or sensor.loop is not None:
        return {f"{sensor.name} [{machine.si_unit(sensor)}]": x}
    columns = {sensor.column: (x + sensor.shift) / sensor.gain}
    if sensor.return_column is not None:
        columns[sensor.return_column] = np.zeros_like(x)  # only the difference of two pressures counts
    return columns
