"""Inspection of a log: its content and everything that is wrong with it (`excite log check`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pandas as pd

from excite.logs import log
from excite.logs.plausibility import against, doubts, own_file, unchanging
from excite.logs.preparation import as_log, at_rate_of, read_stretches
from excite.logs.refusal import caught, lookalike, speed_for_angle, stray_rows, unbroken_rows, wrong_time_unit
from excite.logs.repair import NEEDED, examine, find_dropouts, find_spikes
from excite.logs.resampling import BRIDGED_STEPS, Stretch, held_every, ordinal
from excite.logs.time_axis import order_rows
from excite.logs.times import has_time, seconds
from excite.model.machine import UNITS, Machine, Sensor, load_machine, shipped_machines

T = TypeVar("T")
SHOWN = 5  # places named of a fault that is there many times
STUCK = 50  # equal extreme readings in a row that look like the end of a range
ALIKE = 0.6  # share of a machine's columns that makes a log look like one of its


@dataclass(frozen=True)
class Column:
    """A column: what it is for the machine ("" if nothing), its unit, range (low, high) and how many cells are bad."""

    name: str
    what: str
    unit: str
    low: float
    high: float
    bad: int


@dataclass(frozen=True)
class Inspection:
    """faults make the log unusable as it is, doubts and remarks don't. signals: by column what can be drawn, (t, values
    [SI])."""

    source: str
    machine: str | None
    rows: int
    duration_s: float
    rate_hz: float
    columns: tuple[Column, ...]
    faults: tuple[str, ...]
    doubts: tuple[str, ...]
    remarks: tuple[str, ...]
    signals: dict[str, tuple[np.ndarray, np.ndarray, str]]
    gaps: tuple[float, ...]

    @property
    def usable(self) -> bool:
        return not self.faults


def guess_machine(table: pd.DataFrame) -> Machine | None:
    """The shipped machine whose columns the table has most of, None where none is alike."""
    names = set(map(str, table.columns))

    def share(machine: Machine) -> float:
        own = {machine.time_column, *(c for s in machine.sensors("full") for c in s.columns)}
        return len(own & names) / len(own)

    known = [load_machine(name) for name in shipped_machines()]
    best = max(known, key=lambda m: (share(m), len(m.sensor)))
    return best if share(best) >= ALIKE else None


def inspect(table: pd.DataFrame, machine: Machine | None, source: str = "log") -> Inspection:
    """Everything that is wrong with a table of measurements, not only the first fault. Never raises for its content."""
    columns, faults, remarks = [], [], []
    found = {c: s for s in machine.sensors("full") for c in s.columns} if machine else {}
    strays = stray_rows(table)
    faults += list(strays.values())[:SHOWN]
    if len(strays) > SHOWN:
        faults.append(f"{len(strays) - SHOWN} more such rows")
    bridged = caught(lambda: read_stretches(table, machine), None) is not None if machine else False
    for name in map(str, table.columns):
        column, fault = _column(table, name, machine, found.get(name), list(strays))
        columns.append(column)
        if fault and machine and not bridged and (name in found or name == machine.time_column):
            faults.append(fault)
        elif fault and not machine:
            remarks.append(fault)
    if machine is None:
        remarks.append("no shipped machine has these columns: name yours with --machine to have them checked")
        remarks = [*faults, *remarks]
        return Inspection(source, None, len(table), np.nan, np.nan, tuple(columns), (), (), tuple(remarks), {}, ())
    t, gaps = _time(table, machine, faults, remarks, bool(strays))
    signals: dict[str, tuple[np.ndarray, np.ndarray, str]] = {}
    readings: dict[str, np.ndarray] = {}
    rate = float(machine.sampling_hz)
    if len(t) > 1 and t[-1] > t[0] and not gaps:
        rate = (len(t) - 1) / float(t[-1] - t[0])
    unbroken = unbroken_rows(t, machine) if len(t) else slice(None)
    after = tuple(f"row {int(np.searchsorted(t, gap)) + 2}," for gap in gaps)
    absent: list[str] = []
    pieces = _pieces(table, machine) if len(t) else []
    for sensor in machine.sensors("full"):
        missing = [c for c in sensor.columns if c not in table.columns]
        if missing:
            line = f"no column {', '.join(missing)} ({log.what_of(sensor, machine)})"
            line += lookalike(missing, table, machine)
            if sensor.kind in NEEDED:
                absent.append(f"{line}; no method does without it")
            else:
                remarks.append(line + ("; some methods need it" if "paper" in sensor.kits else "; optional"))
            continue
        values = caught(lambda s=sensor: log.values_of(s, machine, table, ""), None)  # type: ignore[misc]
        when = t if len(t) else np.arange(len(table)) / rate
        if values is None:  # shown as far as it can be read
            number = pd.to_numeric(table[sensor.column], errors="coerce").to_numpy(dtype=float)
            signals[sensor.column] = (when, number, sensor.unit)
            continue
        readings[sensor.name] = values
        signals[" - ".join(sensor.columns)] = (when, values, machine.si_unit(sensor))
        if pieces:
            continue  # looked at piece by piece
        jumps: list[str] = []
        caught(lambda s=sensor, v=values: log.check_values(s, v, rate, machine, ""), jumps)  # type: ignore[misc]
        speed = speed_for_angle(sensor, values[unbroken], table.iloc[unbroken], machine) if jumps else ""
        jumps = [speed] if speed else jumps
        faults += [line for line in jumps if not line.startswith(after)]  # across a gap an angle may jump
        remarks += _oddities(sensor, values)
    for stretch in pieces:
        more, odd = _piece(stretch, machine)
        faults += more
        remarks += odd
    faults += against(machine, readings)
    if readings or not found.keys().isdisjoint(table.columns):
        faults += absent
    else:
        own = f": `excite machine new NAME --like {machine.name}` writes a machine file to name them in"
        faults.append(
            f"none of the columns of {machine.name} is there; is it a log of another machine, or with columns"
            f" of its own{own if machine.name in shipped_machines() else '?'}"
        )
    contradicted, unheard = _units(table, machine)
    remarks += unheard
    unknown = [c.name for c in columns if not c.what]
    if unknown:
        remarks.append(f"not used: {', '.join(unknown)}")
    if line := log.too_short(len(table), machine):
        faults.append(line)
    if not faults:  # what the piecewise look does not see, and what `identify` would refuse
        caught(lambda: _ready(table, machine, remarks), faults)
    seconds = float(t[-1] - t[0]) if len(t) > 1 else np.nan
    typical = 1 / float(np.median(np.diff(t))) if len(t) > 1 and np.median(np.diff(t)) > 0 else np.nan
    remarks = [line for line in remarks if "that is held" not in line]
    doubtful = (
        *contradicted,
        *(() if any("there twice" in r for r in remarks) else _held(table, machine)),
        *(() if faults else doubts(machine, readings)),
    )
    return Inspection(
        source,
        machine.name,
        len(table),
        seconds,
        typical,
        tuple(columns),
        tuple(dict.fromkeys(faults)),
        doubtful,
        tuple(line for line in remarks if line not in doubtful),
        signals,
        gaps,
    )


def _units(table: pd.DataFrame, machine: Machine) -> tuple[list[str], list[str]]:
    """Compare a file's line of units with the machine file: contradictions, and units that are not known."""
    said: dict[str, str] = table.attrs.get("units", {})
    own: dict[str, tuple[str, str, float]] = {machine.time_column: (machine.time_unit, *UNITS[machine.time_unit])}
    for sensor in machine.sensors("full"):
        quantity, size = UNITS.get(sensor.unit, ("", 0.0))
        if sensor.factor is not None:  # whatever the unit's name says
            quantity, size = "", abs(float(sensor.factor))
        own |= dict.fromkeys(sensor.columns, (sensor.unit, quantity, size))
    differ, unknown = [], []
    for name, unit in said.items():
        if name not in own or unit in (own[name][0], "-"):
            continue
        named, quantity, size = own[name]
        if unit not in UNITS:
            unknown.append(f"{unit} for {name}")
        elif not np.isclose(UNITS[unit][1], size, rtol=1e-6, atol=0) or quantity not in ("", UNITS[unit][0]):
            line = f'{"time_unit" if name == machine.time_column else "unit"} = "{unit}"'
            mend = f"if the file is right, write {line} in {own_file(machine)}"
            what = mend if quantity == UNITS[unit][0] else "which is right?"
            differ.append(f"the file says {unit} in column {name}, the machine file {named}: {what}")
    listed = f"the line below the header is taken for units, which are not known: {', '.join(unknown)}"
    return differ, [listed] if unknown else []


def _column(
    table: pd.DataFrame, name: str, machine: Machine | None, sensor: Sensor | None, strays: list[int]
) -> tuple[Column, str]:
    """strays: rows (from 0) that are no data."""
    raw = table[name]
    time = machine is not None and name == machine.time_column
    dated = raw.dtype.kind == "M" or (raw.dtype.kind in "OTU" and pd.to_numeric(raw, errors="coerce").isna().all())
    if time and dated:
        return Column(name, "time (dates)", "", np.nan, np.nan, 0), ""
    number = pd.to_numeric(raw, errors="coerce").to_numpy(dtype=float) if raw.dtype.kind != "M" else np.zeros(len(raw))
    bad = ~np.isfinite(number)
    good = number[~bad]
    bad[strays] = False
    what, unit = "", ""
    if machine is not None and time:
        what, unit = "time", machine.time_unit
    elif machine is not None and sensor is not None:
        what, unit = log.what_of(sensor, machine), sensor.unit
    low, high = (float(good.min()), float(good.max())) if len(good) else (np.nan, np.nan)
    fault = ""
    if bad.any():
        rows = ", ".join(str(k + 1) for k in np.flatnonzero(bad)[:SHOWN]) + (", ..." if bad.sum() > SHOWN else "")
        which = f"{int(bad.sum())} cells are" if bad.sum() > 1 else "a cell is"
        what = f"empty or no numbers (rows {rows})" if bad.sum() > 1 else f"empty or no number (row {rows})"
        fault = f"column {name}: {which} {what}; repair or cut there"
    return Column(name, what, unit, low, high, int(bad.sum())), fault


def _pieces(table: pd.DataFrame, machine: Machine) -> list[Stretch]:
    """The even stretches of a log whose rows are uneven, have gaps or begin anew; none of an even log."""
    read = caught(lambda: read_stretches(table, machine), None)
    if read is None or (len(read[0]) == 1 and not read[0][0].interpolated and len(read[0][0].table) == len(table)):
        return []
    return read[0]


def _piece(stretch: Stretch, machine: Machine) -> tuple[list[str], list[str]]:
    """Faults and remarks of one even stretch, sensor by sensor."""
    faults, remarks = list[str](), list[str]()
    for sensor in machine.sensors("full"):
        if not set(sensor.columns) <= set(stretch.table.columns):
            continue
        values = caught(lambda s=sensor: log.values_of(s, machine, stretch.table, ""), faults)  # type: ignore[misc]
        if values is None:
            continue
        caught(lambda s=sensor, v=values: log.check_values(s, v, stretch.rate, machine, ""), faults)  # type: ignore[misc]
        remarks += _oddities(sensor, values)
    where = f"from row {stretch.first_row + 1}: " if stretch.first_row else ""
    return [where + line for line in faults], [where + line for line in remarks]


def _held(table: pd.DataFrame, machine: Machine) -> list[str]:
    """A line for each channel that changes in every n-th row only."""
    lines = []
    for sensor in machine.sensors("full"):
        if sensor.column not in table.columns or sensor.resolution is not None:
            continue
        x = pd.to_numeric(table[sensor.column], errors="coerce").dropna().to_numpy(dtype=float)
        if (n := held_every(x)) > 1:
            lines.append(
                f"column {sensor.column}: changes in every {ordinal(n)} row only: a slower signal that is held"
            )
    return lines


def _ready(table: pd.DataFrame, machine: Machine, remarks: list[str]) -> None:
    """Make a log ready as for an estimate, with notes of what is done. Raises LogError for what is refused."""
    stretches, notes = read_stretches(table, machine)
    remarks += [line.removeprefix("log: ") for line in notes if line.removeprefix("log: ") not in remarks]
    for stretch in stretches:
        one = as_log(stretch, at_rate_of(machine, stretch.rate), (), "")
        repaired = examine(machine, one)
        remarks += [line.removeprefix(": ") for line in repaired.notes]


def _time(
    table: pd.DataFrame, machine: Machine, faults: list[str], remarks: list[str], strays: bool
) -> tuple[np.ndarray, tuple[float, ...]]:
    """The times [s], empty where they can't be read or ordered, and where gaps begin [s]."""
    if not has_time(table, machine):
        faults.append(f"no column {machine.time_column} (time)")
        return np.empty(0), ()
    t = caught(lambda: seconds(table, machine, ""), None if strays else faults)
    if t is None or len(t) < 2:
        return np.empty(0), ()
    if clock := wrong_time_unit(t, machine):
        faults.append(clock)
        return t, ()
    read = t
    ordered = caught(lambda: order_rows(read, table, machine.time_column, ""), faults)
    if ordered is None:
        return t, ()
    remarks += [line.removeprefix(": ") for line in ordered[1]]
    if len(ordered[0]) == 1 and len(ordered[0][0].t) == len(t):
        t = ordered[0][0].t
    dt = np.diff(t)
    typical = float(np.median(dt))
    wide = np.flatnonzero(dt > BRIDGED_STEPS * typical) if typical > 0 else np.empty(0, int)
    return t, tuple(float(t[k]) for k in wide)


def _oddities(sensor: Sensor, values: np.ndarray) -> list[str]:
    """Remark on what leaves a log usable: channels that never change or stand at an end, spikes, drop-outs."""
    name = sensor.column
    if line := unchanging(sensor, values):
        return [line]
    lines = []
    for end, word in ((values.max(), "highest"), (values.min(), "lowest")):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], values == end, [0]])))
        runs = edges[1::2] - edges[::2]
        if sensor.counts_per_turn is None and len(runs) and runs.max() >= STUCK:
            lines.append(f"column {name}: stands at its {word} value for {runs.max()} rows: the end of its range?")
    if not sensor.is_rate:
        spikes = find_spikes(sensor, values)
        if len(spikes):
            lines.append(f"column {name}: {len(spikes)} spikes of a single row, the first in row {spikes[0] + 1}")
        for first, last in find_dropouts(sensor, values)[:SHOWN]:
            lines.append(f"column {name}: held in rows {first + 1} to {last + 1} while the machine moved: a drop-out?")
    return lines
