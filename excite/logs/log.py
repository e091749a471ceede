"""Logs: reading, checking, naming what is wrong in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError as LogError
from excite.logs import tables
from excite.logs.cells import as_meant
from excite.logs.plausibility import rated_speed
from excite.logs.tables import MDF_TIME, UNCLEAR
from excite.logs.times import has_time, seconds
from excite.model.machine import (
    UNITS,
    Machine,
    Sensor,
    behind_loop,
    load_machine,
    noise_of,
    shipped_machines,
    torque_per_pressure,
)
from excite.text import count, format_number

SHORTEST = 100  # samples: below this no filter and no estimate makes sense
OFF_RATE = 0.02  # by which the usual rate of sampling may differ from the machine file's
SMALLEST, LARGEST = 1e-30, 1e20  # reading in the column's unit: zero below; none beyond; squares of both are floats
LARGEST_SI = 1e10  # reading [SI] beyond all of a machine's
GAP = 1.5  # samples from one row to the next that leave something out
LIVELY_RATIO = 0.8  # of two estimates of noise, below which the one from higher differences counts; chosen


@dataclass(frozen=True)
class Log:
    """Checked measurements: t (N,) [s] evenly spaced, values (N,) by sensor name [SI].

    interpolated: rows were uneven and are readings between those of the file. sampled: by sensor name the rows (N,) at
    which a channel was read, if not in all; the readings between are interpolated. edges: by encoder (N,) the edges
    that it passed, moved to the rows' times, NaN where it passed none; for rows that were uneven. noise: by sensor name
    the white noise [SI] of a command whose response is in `values`, the machine file's at least. doubts: why an
    estimate from it is doubtful.
    """

    source: str
    t: np.ndarray
    values: dict[str, np.ndarray]
    interpolated: bool = False
    sampled: dict[str, np.ndarray] = field(default_factory=dict)
    edges: dict[str, np.ndarray] = field(default_factory=dict)
    noise: dict[str, float] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()

    def read_in(self, sensor: str) -> np.ndarray:
        """Rows (N,) in which a sensor was read."""
        return self.sampled.get(sensor, np.ones(len(self), bool))

    def readings(self, sensor: str) -> np.ndarray:
        """The readings (M,) of a sensor at the rows where it was read."""
        return self.values[sensor][self.sampled.get(sensor, slice(None))]

    def white_noise(self, sensor: str) -> float:
        """Standard deviation [SI] of the white noise on a channel; on a command before its loop."""
        return self.noise.get(sensor) or white_noise(self.values[sensor])

    def __len__(self) -> int:
        return len(self.t)


def read_log(path: str | Path, machine: Machine, needs: Sequence[str] = ()) -> Log:
    """A log (a file that `tables` reads) as the machine file names its columns, checked.

    `needs`: names of sensors that must be there. Raises LogError: a missing column, a NaN, time that goes back, a
    gap, a wrong rate, another machine's log, an empty file.
    """
    return from_table(table_of(path, machine), machine, needs, str(path))


def table_of(path: str | Path, machine: Machine) -> pd.DataFrame:
    """The columns of a log as they are; MDF files give the machine's time column its name. Raises LogError."""
    others = {s.time_column for s in machine.sensor} | {machine.enabled_column}
    wanted = [machine.time_column, *(c for s in machine.sensor for c in s.columns), *sorted(filter(None, others))]
    table = tables.with_names(tables.read_table(path, wanted), wanted)
    if MDF_TIME in table.columns and machine.time_column not in table.columns:
        one = UNITS[machine.time_unit][1]
        table.insert(0, machine.time_column, table[MDF_TIME] / one)
    return as_meant(table, machine, str(path))


def white_noise(x: np.ndarray) -> float:
    """Standard deviation of the white part of a signal, from the median size of its third differences.

    Where a lively motion shows in these, the fifth differences give clearly less and count.
    """
    third, fifth = (_noise_of_differences(x, order) for order in (3, 5))
    return fifth if fifth < LIVELY_RATIO * third else third


def _noise_of_differences(x: np.ndarray, order: int) -> float:
    """Standard deviation of white noise from the median size of its differences of an order."""
    median = float(np.median(np.abs(np.diff(x, order)))) if len(x) > order else 0.0
    return median / (0.6744897501960817 * math.sqrt(math.comb(2 * order, order)))


def from_table(
    table: pd.DataFrame,
    machine: Machine,
    needs: Sequence[str] = (),
    source: str = "log",
    t: np.ndarray | None = None,
    sampled: Mapping[str, np.ndarray] | None = None,
) -> Log:
    """Check a table of even rows and return it as a Log; commands become what their loops deliver.

    t (N,) [s]: times that are known to be even; by default those of the time column, which must be at the machine
    file's rate. sampled: as in a `Log`. Raises LogError.
    """
    wanted = machine.sensors("full")
    known = require_columns(table, machine, needs, source)
    table = unwrapped(table, machine)
    given, t = t, seconds(table, machine, source) if t is None else t
    if line := too_short(len(t), machine):
        raise LogError(f"{source}: {line}")
    rate = float(machine.sampling_hz)
    values = {s.name: values_of(s, machine, table, source) for s in known}
    if given is None:
        check_time(t, rate, machine.time_column, source)
    for s in known:
        check_values(s, values[s.name], rate, machine, source)
    for s in machine.sensor:
        if s.kind == "angle" and s not in wanted and s.column in table.columns:
            moved = values_of(s, machine, table, source)
            if np.ptp(moved) > 0.05:
                raise LogError(
                    f"{source}: column {s.column}: moves by {format_number(np.ptp(moved), 2)} {machine.si_unit(s)},"
                    f" {machine.name} holds it still; is this a log of another machine?"
                )
    t, sampled, noise = np.arange(len(t)) / rate if given is None else t, dict(sampled or {}), {}
    for s in known:
        if s.loop is not None:
            read = values[s.name][sampled.get(s.name, slice(None))]
            noise[s.name] = max(white_noise(read), noise_of(machine, s))  # what the drive adds, no command shows
            values[s.name] = behind_loop(s.loop, values[s.name], float(t[1] - t[0]))
    return Log(source, t, values, sampled=sampled, noise=noise)


def require_columns(table: pd.DataFrame, machine: Machine, needs: Sequence[str], source: str) -> list[Sensor]:
    """Return the sensors that a table has. Raises LogError without a time column or a sensor of `needs`."""
    wanted = machine.sensors("full")
    known = [s for s in wanted if set(s.columns) <= set(table.columns)]
    if not has_time(table, machine):
        rate = f"{float(machine.sampling_hz):g}"
        raise LogError(
            f"{source}: no column {machine.time_column} (time), {columns_of(table)}{looks_like(table, machine)}; if the"
            f" rows are even, write a column {machine.time_column} with row number / rate (at {rate} Hz 0, "
            f"{1 / float(machine.sampling_hz):g}, ...)"
        )
    missing = [s for s in wanted if s.name in needs and s not in known]
    if missing:
        names = ", ".join(f"{c} ({what_of(s, machine)})" for s in missing for c in s.columns if c not in table.columns)
        kit = without_optional(table, machine)
        read = "".join(f"; {line}" for line in table.attrs.get("notes", ()))
        raise LogError(f"{source}: no column {names}, {columns_of(table)}{read}{kit or looks_like(table, machine)}")
    return known


def values_of(sensor: Sensor, machine: Machine, table: pd.DataFrame, source: str) -> np.ndarray:
    """A sensor's readings (N,) [SI] from its columns: units, torques of pressures. Raises LogError."""
    number = numbers(table, sensor.column, source)
    if sensor.return_column is None:
        return _of_a_size(sensor.gain * number, sensor.column, source, LARGEST_SI) - sensor.shift
    back = numbers(table, sensor.return_column, source)
    if not sensor.cylinders:
        return sensor.gain * (number - back)
    push, pull = torque_per_pressure(
        sensor.displacement, sensor.cylinders, _joint_angle(sensor, machine, table, source)
    )
    return sensor.gain * (push * number + pull * back)


def _joint_angle(sensor: Sensor, machine: Machine, table: pd.DataFrame, source: str) -> np.ndarray:
    """The angle (N,) [rad] of the joint that cylinders turn; zero where their lever is the same at every angle."""
    still = machine.find(sensor.body).coordinates[0] in machine.locked
    if still or all(c.lever is not None for c in sensor.cylinders):
        return np.zeros(len(table))
    angle = next(s for s in machine.sensor if s.kind == "angle" and s.body == sensor.body)
    if angle.column not in table.columns:
        raise LogError(
            f"{source}: no column {angle.column} ({what_of(angle, machine)}), on which the lever of the cylinders of"
            f" {sensor.column} depends"
        )
    return values_of(angle, machine, table, source)


def columns_read(sensor: Sensor, machine: Machine) -> tuple[str, ...]:
    """Columns behind a sensor's readings, with that of the angle on which the lever of its cylinders depends."""
    if not sensor.cylinders or all(c.lever is not None for c in sensor.cylinders):
        return sensor.columns
    angles = [s.column for s in machine.sensor if s.kind == "angle" and s.body == sensor.body]
    return (*sensor.columns, *angles[:1])


def columns_known(machine: Machine) -> frozenset[str]:
    """Columns that a machine file names."""
    own = {c for s in machine.sensor for c in (*s.columns, s.time_column) if c is not None}
    return frozenset({machine.time_column, machine.enabled_column or machine.time_column, *own})


def cells_of(table: pd.DataFrame, column: str, source: str) -> np.ndarray:
    """The numbers of a column (N,), NaN where a cell is blank. Raises LogError for a cell that holds anything else."""
    raw = table[column]
    clear = not table.attrs.get(UNCLEAR, {}).get(column)
    if clear and raw.dtype.kind in "fiub" and not np.isinf(values := raw.to_numpy(dtype=float)).any():
        return _of_a_size(values, column, source)
    blank = raw.isna().to_numpy().copy()
    if raw.dtype.kind in "OTU":
        blank |= (raw.astype(str).str.strip() == "").to_numpy()
    part = raw[~blank].to_frame()
    part.attrs = table.attrs
    values = np.full(len(raw), np.nan)
    values[~blank] = numbers(part, column, source, np.flatnonzero(~blank))
    return values


def numbers(table: pd.DataFrame, column: str, source: str, rows: np.ndarray | None = None) -> np.ndarray:
    """The numbers of a column (N,). rows: numbers of the rows in their file. Raises LogError where a cell is none."""
    raw = table[column]
    if unclear := table.attrs.get(UNCLEAR, {}).get(column):
        raise LogError(f"{source}: {unclear}")
    if raw.dtype.kind == "c":
        raise LogError(f"{source}: column {column}: complex numbers, a measurement is real")
    values = _of_a_size(pd.to_numeric(raw, errors="coerce").to_numpy(dtype=float), column, source, rows=rows)
    bad = ~np.isfinite(values)
    if bad.any():
        k = int(np.argmax(bad))
        cell = raw.iloc[k]
        what = "is empty or not a number (NaN)" if pd.isna(cell) else f"is {str(cell)[:30]!r}, not a finite number"
        count = int(bad.sum())
        more = f"; {count} such cells in this column" if count > 1 else ""
        row = k if rows is None else int(rows[k])
        raise LogError(f"{source}: row {row + 1}, column {column}: {what}{more}; cut the log there or repair the value")
    return values


def _of_a_size(
    values: np.ndarray, column: str, source: str, largest: float = LARGEST, rows: np.ndarray | None = None
) -> np.ndarray:
    """Return readings (N,), zero where they are next to nothing. Raises LogError for one that no measurement has."""
    size = np.abs(values)
    huge = np.isfinite(values) & (size > largest)
    if huge.any():
        k = int(np.argmax(huge))
        row = k if rows is None else int(rows[k])
        cells, unit = count(int(huge.sum()), "such cell"), " in SI units" if largest == LARGEST_SI else ""
        raise LogError(
            f"{source}: row {row + 1}, column {column}: is {values[k]:g}{unit}, which no measurement is; {cells} in"
            " this column; cut the log there or repair the value"
        )
    return np.where(size < SMALLEST, 0.0, values) if (size[size > 0] < SMALLEST).any() else values


def fewest_rows(machine: Machine) -> int:
    """The fewest rows of which an estimate can be made."""
    return max(SHORTEST, sum(machine.filter.drop) + 12 * machine.filter.decimation)


def too_short(rows: int, machine: Machine) -> str:
    """Return a line for a log of too few rows, "" otherwise."""
    least = fewest_rows(machine)
    return f"only {count(rows, 'row')}, at least {least} are needed: is the file complete?" if rows < least else ""


def check_time(t: np.ndarray, rate: float, column: str, source: str) -> None:
    dt = np.diff(t)
    if (dt <= 0).any():
        k = int(np.argmax(dt <= 0))
        what = "goes back" if dt[k] < 0 else "stands still"
        raise LogError(
            f"{source}: row {k + 2}, column {column}: time {what} ({t[k]:g} s, then {t[k + 1]:g} s);"
            " sort or cut the log"
        )
    typical = float(np.median(dt))
    if abs(typical * rate - 1) > OFF_RATE:
        raise LogError(
            f"{source}: column {column}: sampled at {format_number(1 / typical, 4)} Hz, the machine file says {rate:g}"
            " Hz; resample the log or correct sampling_hz"
        )
    jump = np.abs(dt * rate - 1) > GAP - 1
    if jump.any():
        k = int(np.argmax(jump))
        raise LogError(
            f"{source}: row {k + 2}, column {column}: a gap of {format_number(dt[k], 4)} s (from {t[k]:g} s to"
            f" {t[k + 1]:g} s) where {1 / rate:g} s is expected; give the stretches before and after as two logs"
        )
    drift = (t[-1] - t[0]) * rate / (len(t) - 1)
    if abs(drift - 1) > 0.01:
        raise LogError(f"{source}: column {column}: the clock is {100 * (drift - 1):+.1f} % off {rate:g} Hz on average")


def check_values(sensor: Sensor, values: np.ndarray, rate: float, machine: Machine, source: str) -> None:
    """Raise LogError for angles (N,) [SI] that are not unwrapped and for readings far beyond the machine's limits."""
    if len(values) < 2:
        return  # nothing moves in one row
    turns = sensor.kind == "wheel" or (sensor.kind == "angle" and machine.find(sensor.body).joint == "revolute")
    if turns and not sensor.is_rate and "jumps" not in sensor.checks_off:
        step = np.abs(np.diff(values))
        k = int(np.argmax(step))
        if step[k] > 2.0:
            raise LogError(
                f"{source}: row {k + 2}, column {sensor.column}: the angle jumps by {format_number(step[k], 3)} rad in"
                " one sample; unwrap it (encoder angles are counted on) or cut the log there"
            )
    if "limits" not in sensor.checks_off:
        check_limits(sensor, values, rate, machine, source)


def check_limits(sensor: Sensor, values: np.ndarray, rate: float, machine: Machine, source: str) -> None:
    """Raise LogError where readings (N,) [SI] are far beyond what the machine's limits allow."""
    body = machine.find(sensor.body)
    if sensor.is_rate:
        fastest, usual = rated_speed(sensor, machine), float(np.percentile(np.abs(values), 99))
        if fastest is not None and usual > 3 * fastest:
            raise LogError(
                f"{source}: column {sensor.column}: turns at {format_number(usual, 3)} rad/s, the machine allows"
                f" {format_number(fastest, 3)} rad/s; is the unit {sensor.unit} right?"
            )
        return
    if sensor.kind == "angle" and body.joint == "revolute":
        step = np.abs(np.diff(values))
        fastest, usual = rated_speed(sensor, machine), float(np.percentile(step, 99)) * rate
        if fastest is not None and step.max() * rate > 5 * fastest and usual > 3 * fastest:
            raise LogError(
                f"{source}: column {sensor.column}: turns at {format_number(usual, 3)} rad/s, the machine allows"
                f" {format_number(fastest, 3)} rad/s; is the column in degrees?"
            )
        limit = body.limit.reach
        if limit is not None and np.abs(values).max() > 3 * limit:
            raise LogError(
                f"{source}: column {sensor.column}: up to {format_number(np.abs(values).max(), 3)} rad, the machine"
                f" allows {limit:g} rad; is the column in degrees?"
            )
    if sensor.kind == "torque" and body.limit.torque is not None:
        top, most = float(np.abs(values).max()), float(body.limit.torque)
        if top > 10 * most:
            raise LogError(
                f"{source}: column {sensor.column}: up to {format_number(top, 3)}, more than ten times the drive's"
                f" limit {most:g}; is the unit right?"
            )


def unwrapped(table: pd.DataFrame, machine: Machine) -> pd.DataFrame:
    """The table with encoders counted on that begin anew after `wraps_at`."""
    on = {}
    for s in machine.sensor:
        if s.wraps_at is None or s.column not in table.columns:
            continue
        x = cells_of(table, s.column, "log").copy()
        there = np.isfinite(x)
        x[there] = np.unwrap(x[there], period=s.wraps_at)
        on[s.column] = x
    if not on:
        return table
    changed = table.assign(**on)
    changed.attrs = table.attrs
    return changed


def what_of(sensor: Sensor, machine: Machine) -> str:
    where = sensor.place or machine.find(sensor.body).where
    kind = {"angle": "angle", "wheel": "angle", "torque": "torque"}.get(sensor.kind, sensor.kind.replace("_", " "))
    kind = "rate" if sensor.is_rate else "pressure" if sensor.return_column is not None else kind
    return f"{kind} of {where.replace('_', ' ')}"


def columns_of(table: pd.DataFrame) -> str:
    """List the columns of a file for a message."""
    names = [str(c) for c in table.columns]
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    return f"the file has {shown}"


def without_optional(table: pd.DataFrame, machine: Machine) -> str:
    """Advice where only sensors are missing that joint smoothing does without."""
    paper = {s.column for s in machine.sensors("paper")}
    return "; without it --method joint works" if paper <= {str(c) for c in table.columns} else ""


def looks_like(table: pd.DataFrame, machine: Machine) -> str:
    """A shipped machine whose log this looks like."""
    for name in shipped_machines():
        if name == machine.name:
            continue
        other = load_machine(name)
        columns = {other.time_column, *(s.column for s in other.sensors("paper"))}
        if columns <= {str(c) for c in table.columns}:
            return f"; this looks like a log of {name}"
    if machine.name not in shipped_machines():
        return f"; is this a log of {machine.name}? The machine file names each sensor's column"
    return (
        f"; is this a log of {machine.name}? The machine file names each sensor's column: `excite machine new NAME"
        f" --like {machine.name}` writes one with columns and units to change"
    )
