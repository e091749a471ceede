"""Inspection of a log: its content and everything that is wrong with it (`excite log check`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from excite.logs import log
from excite.logs.checks import findings
from excite.logs.filtered import too_slow
from excite.logs.log import Log
from excite.logs.plausibility import doubts
from excite.logs.preparation import as_log, at_rate_of, on_one_clock, place_rows
from excite.logs.record import Record, record_of
from excite.logs.refusal import caught, lookalike, stray_rows, unit_doubts, wrong_time_unit
from excite.logs.repair import is_needed, mended
from excite.logs.resampling import BRIDGED_STEPS
from excite.logs.times import has_time, seconds
from excite.model.machine import Machine, Sensor, load_machine, shipped_machines

SHOWN = 5  # places named of a fault that is there many times
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
    """The content of a log. faults make it unusable as it is, doubts and remarks don't.

    signals: by column what can be drawn, (t, values [SI]). bad: sensor and (first, last) time [s] of each stretch that
    a finding is about. used: the logs that are made of it, each with the machine at its rate and its first time [s].
    """

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
    bad: tuple[tuple[str, tuple[float, float]], ...] = ()
    used: tuple[tuple[Machine, Log, float], ...] = ()

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
    strays = stray_rows(table)
    lines = list(strays.values())[:SHOWN]
    if len(strays) > SHOWN:
        lines.append(f"{len(strays) - SHOWN} more such rows")
    found = {c: s for s in machine.sensors("full") for c in s.columns} if machine else {}
    read = [_column(table, name, machine, found.get(name), list(strays)) for name in map(str, table.columns)]
    columns = tuple(column for column, _ in read)
    if machine is None:
        lines += [said for _, said in read if said]
        lines.append("no shipped machine has these columns: name yours with --machine to have them checked")
        return Inspection(source, None, len(table), np.nan, np.nan, columns, (), (), tuple(lines), {}, ())
    faults, remarks = lines, []
    unmerged = list[str]()
    merged = caught(lambda: on_one_clock(table, machine, ""), unmerged)
    faults += unmerged
    table = table if merged is None else merged
    unwrapped = caught(lambda: log.unwrapped(table, machine), None)
    table = table if unwrapped is None else unwrapped
    record, unread = record_of(table, machine)
    faults += () if strays else unread.values()
    absent, lacking = _absent(table, machine)
    remarks += lacking
    known = bool(record.channels) or not found.keys().isdisjoint(table.columns)
    faults += absent if known else [_no_column(machine)]
    seen = findings(record)
    faults += [f.text for f in seen if f.kind == "fault"]
    units, unheard = unit_doubts(table, machine)
    doubtful = [*units, *(f.text for f in seen if f.kind == "doubt")]
    remarks += [*(f.text for f in seen if f.kind == "remark" and f.check != "spikes"), *unheard]
    remarks += table.attrs.get("notes", ())
    t = caught(lambda: seconds(table, machine, ""), None) if has_time(table, machine) else None
    clock = "" if t is None or strays else wrong_time_unit(t, machine)
    used: list[tuple[Machine, Log, float]] = []
    if clock:
        faults.append(clock)
    elif not strays:
        faulty = {f.sensor for f in seen if f.kind == "fault"}
        accused = {c for s in machine.sensors("full") for c in s.columns if s.name in faulty}
        used = _as_used(table, record, machine, accused | {*unread}, faults, remarks)
        doubtful += _doubts_of_used(used, faults)
    unknown = [c.name for c in columns if not c.what and c.name not in log.columns_known(machine)]
    if unknown:
        remarks.append(f"not used: {', '.join(unknown)}")
    t = np.empty(0) if t is None else t
    dt = np.diff(t)
    usual = float(np.median(dt[dt > 0])) if (dt > 0).any() else np.nan
    return Inspection(
        source,
        machine.name,
        len(table),
        float(np.ptp(t)) if len(t) > 1 else np.nan,
        1 / usual,
        columns,
        tuple(dict.fromkeys(faults)),
        tuple(dict.fromkeys(doubtful)),
        tuple(line for line in dict.fromkeys(remarks) if line not in doubtful),
        _signals(table, record, machine, t),
        tuple(float(t[k]) for k in np.flatnonzero(dt > BRIDGED_STEPS * usual)),
        tuple((f.sensor, span) for f in seen for span in f.spans),
        tuple(used),
    )


def _no_column(machine: Machine) -> str:
    """Say that a table has none of a machine's columns."""
    own = f": `excite machine new NAME --like {machine.name}` writes a machine file to name them in"
    return (
        f"none of the columns of {machine.name} is there; is it a log of another machine, or with columns of its"
        f" own{own if machine.name in shipped_machines() else '?'}"
    )


def _doubts_of_used(used: Sequence[tuple[Machine, Log, float]], faults: list[str]) -> list[str]:
    """Return what is doubtful about the stretches that are used, unless there are faults; add those that are slow."""
    faults += [line for own, _, _ in used if (line := too_slow(float(own.sampling_hz), own.filter))]
    return [] if faults else [x for own, one, _ in used for x in doubts(own, one.values, one.interpolated)]


def _absent(table: pd.DataFrame, machine: Machine) -> tuple[list[str], list[str]]:
    """Columns that are missing: those that no method does without, and others."""
    absent, lacking = [], []
    for sensor in machine.sensors("full"):
        missing = [c for c in sensor.columns if c not in table.columns]
        if not missing:
            continue
        line = f"no column {', '.join(missing)} ({log.what_of(sensor, machine)}){lookalike(missing, table, machine)}"
        if is_needed(sensor, machine):
            absent.append(f"{line}; no method does without it")
        else:
            some = "paper" in sensor.kits and sensor.kind != "angle"  # an angle that is not needed follows another
            lacking.append(line + ("; some methods need it" if some else "; optional"))
    return absent, lacking


def _as_used(
    table: pd.DataFrame, record: Record, machine: Machine, bad: set[str], faults: list[str], remarks: list[str]
) -> list[tuple[Machine, Log, float]]:
    """Logs that a table makes without bad columns, each with the machine at its rate.

    What is done to the table is added to remarks, what else is wrong to faults.
    """
    if not has_time(table, machine):
        faults.append(f"no column {machine.time_column} (time)")
        return []
    clean, repaired = mended(table, record, "")
    rest = clean.drop(columns=[c for c in bad if c in clean.columns])
    rest.attrs = table.attrs
    said: list[str] = []
    placed = caught(lambda: place_rows(rest, machine, (), ""), said)
    faults += [line for line in said if not (bad and "none of the columns" in line)]
    if placed is None:
        return []
    remarks += [line.removeprefix(": ") for line in (*repaired, *placed[1]) if "that is held" not in line]
    logs = []
    t = seconds(table, machine, "")
    for stretch in placed[0]:
        own = at_rate_of(machine, stretch.rate)
        made = caught(lambda s=stretch, m=own: as_log(s, m, (), ""), faults)  # type: ignore[misc]
        logs += [(own, made, float(t[min(stretch.first_row, len(t) - 1)]))] if made is not None else []
    return logs


def _signals(
    table: pd.DataFrame, record: Record, machine: Machine, t: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    """What can be drawn, by column: times [s] and readings, as far as they can be read."""
    signals = {}
    for sensor in machine.sensors("full"):
        if sensor.name in record.channels:
            c = record.channels[sensor.name]
            signals[" - ".join(sensor.columns)] = (c.t, c.x, machine.si_unit(sensor))
        elif sensor.column in table.columns:
            number = pd.to_numeric(table[sensor.column], errors="coerce").to_numpy(dtype=float)
            number = np.where(np.abs(number) < log.LARGEST, number, np.nan)
            when = t if len(t) == len(number) else np.arange(len(number)) / float(machine.sampling_hz)
            signals[sensor.column] = (when, number, sensor.unit)
    return signals


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
