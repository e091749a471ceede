"""What is in a log, and everything that is wrong with it: `excite log check`."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import log
from excite.logs.plausibility import RATES, against, as_speed, doubts, is_speed, own_file, unchanging
from excite.logs.repair import NEEDED, find_dropouts, find_spikes
from excite.logs.tables import COMMENTS
from excite.model.machine import TURN, UNITS, Machine, Sensor, load_machine, shipped_machines

T = TypeVar("T")
SHOWN = 5  # places named of a fault that is there many times
STUCK = 50  # equal extreme readings in a row that look like the end of a range
ALIKE = 0.6  # share of a machine's columns that makes a log look like one of its
CLOSE = 0.05  # of a unit's size, when a wrong rate of sampling is taken for time in that unit


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
    strays = _strays(table)
    faults += list(strays.values())[:SHOWN]
    if len(strays) > SHOWN:
        faults.append(f"{len(strays) - SHOWN} more such rows")
    for name in map(str, table.columns):
        column, fault = _column(table, name, machine, found.get(name), list(strays))
        columns.append(column)
        if fault and machine and (name in found or name == machine.time_column):
            faults.append(fault)
        elif fault and not machine:
            remarks.append(fault)
    if machine is None:
        remarks.append("no shipped machine has these columns: name yours with --machine to have them checked")
        remarks = [*faults, *remarks]
        return Inspection(source, None, len(table), np.nan, np.nan, tuple(columns), (), (), tuple(remarks), {}, ())
    t, gaps = _time(table, machine, faults)
    signals: dict[str, tuple[np.ndarray, np.ndarray, str]] = {}
    readings: dict[str, np.ndarray] = {}
    rate = float(machine.sampling_hz)
    unbroken = _unbroken(t, machine) if len(t) else slice(None)
    after = tuple(f"row {int(np.searchsorted(t, gap)) + 2}," for gap in gaps)
    absent: list[str] = []
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
        values = _caught(lambda s=sensor: log.values_of(s, machine, table, ""), None)  # type: ignore[misc]
        when = t if len(t) else np.arange(len(table)) / rate
        if values is None:  # shown as far as it can be read
            number = pd.to_numeric(table[sensor.column], errors="coerce").to_numpy(dtype=float)
            signals[sensor.column] = (when, number, sensor.unit)
            continue
        readings[sensor.name] = values
        signals[" - ".join(sensor.columns)] = (when, values, machine.si_unit(sensor))
        jumps: list[str] = []
        _caught(lambda s=sensor, v=values: log.check_values(s, v, rate, machine, ""), jumps)  # type: ignore[misc]
        speed = _speed(sensor, values[unbroken], table.iloc[unbroken], machine) if jumps else ""
        jumps = [speed] if speed else jumps
        faults += [line for line in jumps if not line.startswith(after)]  # across a gap an angle may jump
        remarks += _oddities(sensor, values)
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
    if not faults:  # what the piecewise look does not see
        _caught(lambda: log.from_table(table, machine, (), ""), faults)
    seconds = float(t[-1] - t[0]) if len(t) > 1 else np.nan
    typical = 1 / float(np.median(np.diff(t))) if len(t) > 1 and np.median(np.diff(t)) > 0 else np.nan
    doubtful = (*contradicted, *(() if faults else doubts(machine, readings)))
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


def refuse(table: pd.DataFrame, machine: Machine, needs: Sequence[str] = (), source: str = "log") -> None:
    """Raises LogError for what `log.check` refuses as well, where it can be told what to write instead: a column of
    another name, time in another unit, a speed for an angle. needs: names of sensors that must be there."""
    lacking = [
        (f"{', '.join(missing)} ({log.what_of(s, machine)})", lookalike(missing, table, machine))
        for s in machine.sensors("full")
        if s.name in needs and (missing := [c for c in s.columns if c not in table.columns])
    ]
    if any(hint for _, hint in lacking):
        raise LogError(f"{source}: no column {', '.join(name + hint for name, hint in lacking)}")
    if lacking or machine.time_column not in table.columns:
        return
    for stray in _strays(table).values():
        raise LogError(f"{source}: {stray}")
    t = _caught(lambda: log.times(table, machine, source), None)
    if t is not None and (clock := _clock(t, machine)):
        raise LogError(f"{source}: {clock}")
    if t is not None:
        table = table.iloc[_unbroken(t, machine)].reset_index(drop=True)
    for sensor in machine.sensors("full"):
        if sensor.kind != "angle" or not set(sensor.columns) <= set(table.columns):
            continue
        values = _caught(lambda s=sensor: log.values_of(s, machine, table, source), None)  # type: ignore[misc]
        if values is not None and len(values) > 1 and (speed := _speed(sensor, values, table, machine)):
            raise LogError(f"{source}: {speed}")


def _unbroken(t: np.ndarray, machine: Machine) -> slice:
    """Rows of the longest stretch of times (N,) [s] without a gap: across one an angle may jump."""
    edges = [0, *log.gap_rows(t, machine), len(t)]
    return slice(*max(itertools.pairwise(edges), key=lambda ends: ends[1] - ends[0]))


def _speed(sensor: Sensor, values: np.ndarray, table: pd.DataFrame, machine: Machine) -> str:
    """What is wrong with an angle (N,) [SI] that its joint can't follow but that could be its speed, and goes with the
    torques as if it were; "" otherwise."""
    body, rate = machine.find(sensor.body), float(machine.sampling_hz)
    if sensor.kind != "angle" or sensor.is_rate or sensor.factor is not None or body.joint != "revolute":
        return ""
    if _possible(sensor, values, machine) or np.abs(np.diff(values)).max() > TURN / 2:
        return ""  # not unwrapped, say
    rates = {unit: sensor.model_copy(update={"unit": unit, "counts_per_turn": None}) for unit in RATES}
    units = [u for u, s in rates.items() if _possible(s, values * (s.gain / sensor.gain), machine)]
    # What moves a roll is the torque of all of them.
    pulling = [b.index for b in machine.actuated if b.contact is not None] if body.contact else [body.index]
    there = [s for s in machine.sensors("full") if set(s.columns) <= set(table.columns)]
    drives = [s for s in there if s.kind == "torque" and s.body in pulling]
    torques = [_caught(lambda s=s: log.values_of(s, machine, table, ""), None) for s in drives]  # type: ignore[misc]
    known = [u for u in torques if u is not None]
    if not units or not is_speed(values, known, rate):
        return ""
    return (
        f"column {sensor.column}: changes faster than the joint can turn, as its speed would: is it one? then"
        f" {as_speed(units, machine)}"
    )


def _possible(sensor: Sensor, values: np.ndarray, machine: Machine) -> bool:
    """Whether a joint can do what readings (N,) [SI] say."""
    said: list[str] = []
    _caught(lambda: log.check_values(sensor, values, float(machine.sampling_hz), machine, ""), said)
    return not said


def _clock(t: np.ndarray, machine: Machine) -> str:
    """What is wrong with times (N,) [s] that are in another unit than the machine file says, "" where they aren't."""
    typical, rate = float(np.median(np.diff(t))) if len(t) > 1 else 0.0, float(machine.sampling_hz)
    if typical <= 0:
        return ""
    for unit in ("s", "ms", "us", "min"):
        ratio = UNITS[unit][1] / UNITS[machine.time_unit][1]
        if unit != machine.time_unit and abs(typical * rate * ratio - 1) <= CLOSE:
            line = f'time_unit = "{unit}"'
            return (
                f"column {machine.time_column}: sampled at {1 / typical:.4g} Hz, the machine file says {rate:g} Hz:"
                f" is it in {unit}? then write {line} in {own_file(machine)}"
            )
    return ""


def lookalike(missing: Sequence[str], table: pd.DataFrame, machine: Machine) -> str:
    """A question after the first of the columns that a sensor lacks: whether one that nothing uses is meant, "" where
    none has a name like it. Numbers in a name say which joint it is: they must be the same."""
    used = {machine.time_column, *(c for s in machine.sensor for c in s.columns)}
    free = [c for c in map(str, table.columns) if c not in used and _digits(c) == _digits(missing[0])]
    like = difflib.get_close_matches(missing[0], free, n=1)
    if not like:
        return ""
    key = "column" if any(s.column == missing[0] for s in machine.sensor) else "return_column"
    line = f'{key} = "{like[0]}"'
    return f": is {like[0]} this column? rename it, or write {line} in {own_file(machine)}"


def _digits(name: str) -> list[str]:
    return re.findall(r"\d+", name)


def _caught(work: Callable[[], T], faults: list[str] | None) -> T | None:
    """The result, or None with the fault's line kept."""
    try:
        return work()
    except LogError as err:
        if faults is not None:
            faults.append(str(err).removeprefix(": "))
        return None


def _strays(table: pd.DataFrame) -> dict[int, str]:
    """Rows (from 0) that are no data, each with what is said of it: the header once more, a comment."""
    names = [str(c) for c in table.columns]
    found = {}
    for k, cell in enumerate(table.iloc[:, 0].tolist() if names else ()):
        text = cell.strip() if isinstance(cell, str) else ""
        if text.startswith(COMMENTS) and table.iloc[k, 1:].isna().all():
            found[k] = f"row {k + 1}: is a comment ({text[:30]!r}), not data; cut it"
        elif text and text == names[0] and [str(c).strip() for c in table.iloc[k]] == names:
            found[k] = f"row {k + 1}: is the header once more, not data; cut it"
    return found


def _units(table: pd.DataFrame, machine: Machine) -> tuple[list[str], list[str]]:
    """What a line of units in a file says against the machine file's, and what of it nobody knows."""
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


def _time(table: pd.DataFrame, machine: Machine, faults: list[str]) -> tuple[np.ndarray, tuple[float, ...]]:
    """The times [s], empty where they can't be read, and where gaps begin [s]."""
    name, rate = machine.time_column, float(machine.sampling_hz)
    if name not in table.columns:
        faults.append(f"no column {name} (time)")
        return np.empty(0), ()
    t = _caught(lambda: log.times(table, machine, ""), None)
    if t is None or len(t) < 2:
        return np.empty(0), ()
    dt = np.diff(t)
    back = np.flatnonzero(dt <= 0)
    if len(back):
        rows = ", ".join(str(k + 2) for k in back[:SHOWN]) + (", ..." if len(back) > SHOWN else "")
        faults.append(f"column {name}: time goes back or stands still {len(back)} times (rows {rows}); sort or cut it")
    typical = float(np.median(dt))
    wide = np.flatnonzero(dt > log.GAP * typical) if typical > 0 else np.empty(0, int)
    if typical > 0 and abs(typical * rate - 1) <= log.OFF_RATE:
        for k in wide[:SHOWN]:
            faults.append(f"column {name}: a gap of {dt[k]:.4g} s in row {k + 2} (from {t[k]:g} s to {t[k + 1]:g} s)")
        if len(wide) > SHOWN:
            faults.append(f"column {name}: {len(wide) - SHOWN} more gaps")
    elif clock := _clock(t, machine):
        faults.append(clock)
    elif typical > 0:
        _caught(lambda: log.check_time(t, rate, name, ""), faults)
    return t, tuple(float(t[k]) for k in wide)


def _oddities(sensor: Sensor, values: np.ndarray) -> list[str]:
    """What leaves a log usable: a channel that never changes or is at the end of its range, spikes, drop-outs."""
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
