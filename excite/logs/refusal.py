"""The refusal of a table of measurements with faults, and advice what to write instead."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import log
from excite.logs.checks import findings, refuse
from excite.logs.files.common import UNITS_UNKNOWN
from excite.logs.files.layout import known_unit
from excite.logs.plausibility import own_file
from excite.logs.record import WRONG_RATE, Finding, record_of
from excite.logs.repair import mended
from excite.logs.tables import COMMENTS
from excite.logs.times import has_time, seconds
from excite.model.machine import TIME_UNITS, UNITS, Machine
from excite.text import format_number

T = TypeVar("T")

GRAVE = (
    "clocks",
    "slow",
    "counts",
)  # checks whose doubts, as those of units and held positions, make an estimate doubtful
NO_UNIT = ("-", "1", "n/a", "na", "none", "raw")  # written where a unit would be; compared without case
PREFIXES = "numkMG"  # of units: nano to giga
CLOSE = 0.05  # of a unit's size, when a wrong rate of sampling is taken for time in that unit


@dataclass(frozen=True)
class Accepted:
    """A table without faults, repaired, with what was done to it and what is doubtful about it.

    grave: those doubts that make an estimate doubtful.
    """

    table: pd.DataFrame
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    grave: tuple[str, ...] = ()


def accept(table: pd.DataFrame, machine: Machine, needs: Sequence[str] = (), source: str = "log") -> Accepted:
    """Check a table as `inspect` does and repair its spikes. needs: names of sensors that must be there.

    Raises LogError for all faults at once. What only placing rows on even steps shows, `even_stretches` refuses.
    """
    lacking = [
        (f"{', '.join(missing)} ({log.what_of(s, machine)})", lookalike(missing, table, machine))
        for s in machine.sensors("full")
        if s.name in needs and (missing := [c for c in s.columns if c not in table.columns])
    ]
    if any(hint for _, hint in lacking):
        raise LogError(f"{source}: no column {', '.join(name + hint for name, hint in lacking)}")
    if lacking or not has_time(table, machine):
        return Accepted(table, (), ())
    for stray in stray_rows(table).values():
        raise LogError(f"{source}: {stray}")
    table = log.unwrapped(table, machine)
    t = caught(lambda: seconds(table, machine, source), None)
    if t is not None and (clock := wrong_time_unit(t, machine)):
        raise LogError(f"{source}: {clock}")
    record, unread = record_of(table, machine)
    cells = [Finding("cells", "fault", "", line) for line in unread.values()]
    seen = findings(record)
    doubtful = refuse([*cells, *seen], source)
    clean, notes = mended(table, record, source)
    bridged = [f"{source}: {f.text}" for f in seen if f.check == "dropouts" and f.kind == "remark"]
    differ, unheard = unit_doubts(table, machine)
    units = [f"{source}: {line}" for line in differ]
    notes = (*notes, *(f"{source}: {line}" for line in unheard))
    positions = {s.name for s in machine.sensors("full") if s.kind in ("angle", "wheel")}
    grave = [
        f"{source}: {f.text}"
        for f in seen
        if f.kind == "doubt" and (f.check in GRAVE or (f.check == "held" and f.sensor in positions))
    ]
    return Accepted(clean, (*notes, *bridged), (*units, *doubtful), (*units, *grave))


def unit_doubts(table: pd.DataFrame, machine: Machine) -> tuple[list[str], list[str]]:
    """Compare a file's line of units with the machine file: contradictions, and units that are not known."""
    said: dict[str, str] = table.attrs.get("units", {})
    own: dict[str, tuple[str, str, float]] = {machine.time_column: (machine.time_unit, *UNITS[machine.time_unit])}
    for sensor in (s for s in machine.sensors("full") if "units" not in s.checks_off):
        quantity, size = UNITS.get(sensor.unit, ("", 0.0))
        if sensor.factor is not None:  # whatever the unit's name says
            quantity, size = "", abs(float(sensor.factor))
        own |= dict.fromkeys(sensor.columns, (sensor.unit, quantity, size))
    differ, unknown = [], []
    for name, text in said.items():
        unit = known_unit(text)
        if name not in own or own[name][0] in (text, unit) or text == "-":
            continue
        named, quantity, size = own[name]
        if not unit:
            unknown.append(f"{text} for {name}")
        elif not np.isclose(UNITS[unit][1], size, rtol=1e-6, atol=0) or quantity not in ("", UNITS[unit][0]):
            line = f'{"time_unit" if name == machine.time_column else "unit"} = "{unit}"'
            mend = f"if the file is right, write {line} in {own_file(machine)}"
            what = mend if quantity == UNITS[unit][0] else "which is right?"
            differ.append(f"the file says {unit} in column {name}, the machine file {named}: {what}")
    bracketed: dict[str, str] = table.attrs.get(UNITS_UNKNOWN, {})
    for name, text in bracketed.items():
        unit = text[1:-1].strip()
        if name not in own or name.endswith(text) or unit.lower() in (own[name][0].lower(), *NO_UNIT):
            continue  # a machine file that has the name with its brackets knows of it
        named = own[name][0]
        if any(one[:1] in PREFIXES and one[1:] == other for one, other in ((unit, named), (named, unit))):
            differ.append(f"the file says {unit} in column {name}, the machine file {named}: which is right?")
        elif text[0] == "[":
            differ.append(
                f"the file says {unit} in column {name}, which is not a known unit, the machine file {named}: which is"
                " right?"
            )
    listed = f"the file's units are not known, those of the machine file are taken: {', '.join(unknown)}"
    return differ, [listed] if unknown else []


def wrong_time_unit(t: np.ndarray, machine: Machine) -> str:
    """Return a line for times (N,) [s] in another unit than the machine file says, "" otherwise."""
    typical, rate = float(np.median(np.diff(t))) if len(t) > 1 else 0.0, float(machine.sampling_hz)
    if typical <= 0:
        return ""
    for unit in TIME_UNITS:
        ratio = UNITS[unit][1] / UNITS[machine.time_unit][1]
        if unit != machine.time_unit and abs(typical * rate * ratio - 1) <= CLOSE:
            line = f'time_unit = "{unit}"'
            return (
                f"column {machine.time_column}: sampled at {format_number(1 / typical, 4)} Hz, the machine file says"
                f" {rate:g} Hz: is it in {unit}? then write {line} in {own_file(machine)}"
            )
    if typical * rate > WRONG_RATE and 1 / typical <= 2 * float(machine.filter.cutoff_hz):
        return (
            f"column {machine.time_column}: rows are {format_number(typical, 4)} s apart"
            f" ({format_number(1 / typical, 4)} Hz), the machine file has {rate:g} Hz: is it a row number, or in"
            " another unit? Give the time of each row in seconds"
        )
    least, span = log.fewest_rows(machine), float(np.ptp(t))
    if typical * rate < 1 / WRONG_RATE and span * rate < least <= len(t):
        days = span * UNITS["day"][1] / UNITS[machine.time_unit][1]
        unit = ": is it in another unit, such as min or day?" if days * rate > least else "."
        return (
            f"column {machine.time_column}: {len(t)} rows span {format_number(span, 4)} s only, at {rate:g} Hz"
            f" at least {format_number(least / rate, 3)} s are needed{unit} Give the time of each row in seconds"
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


def caught(work: Callable[[], T], faults: list[str] | None) -> T | None:
    """The result, or None with the fault's line kept."""
    try:
        return work()
    except LogError as err:
        if faults is not None:
            faults.append(str(err).removeprefix(": "))
        return None


def stray_rows(table: pd.DataFrame) -> dict[int, str]:
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
