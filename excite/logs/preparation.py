"""Logs made ready: read, placed on an even grid of time, cut at gaps and rests. The one way in for every command."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import log, refusal
from excite.logs.cells import as_meant
from excite.logs.clocks import is_clock
from excite.logs.files.common import UNCLEAR, UNITS_SAID, UNITS_UNKNOWN
from excite.logs.files.layout import known_unit
from excite.logs.log import Log
from excite.logs.repair import is_needed
from excite.logs.resampling import SAME_RATE, Stretch, at_rate, even_stretches, slower
from excite.logs.time_axis import Run, evenly, order_rows
from excite.logs.times import absolute_seconds, has_time, refuse_swapped_dates, seconds
from excite.model import Model
from excite.model.machine import TIME_UNITS, UNITS, Machine, Sensor
from excite.text import count, format_number

FASTEST_HZ = 150.0  # rate [Hz] beyond which a rolling machine tells nothing more: its slips relax within tens of ms
REST_S = 5.0  # [s] of standing still that is left out; chosen
REST_MARGIN_S = 0.3  # [s] of a rest that stays with the motion before and after it; chosen

DIGITS = 9  # decimals [s] of times by which those of two clocks are the same
SCALES = (1e3, 1e6, 1e9)  # by which the units of two clocks may differ
ALIKE_SPANS = 0.2  # by which the spans of two clocks of one log may differ; chosen
MERGED = "merged"  # of a table's attrs: channels are on one clock already

Source = str | Path | pd.DataFrame | Log


@dataclass(frozen=True)
class Prepared:
    """Logs on one even grid, the model at their rate of sampling, and notes of what was done to them."""

    model: Model
    logs: list[Log]
    notes: list[str]


def prepare(
    model: Model, sources: Sequence[Source], needs: Sequence[str] = (), use: str = "", rate: float | None = None
) -> Prepared:
    """Read logs (files, tables in the machine's columns, or logs as they are) and make them ready for estimation.

    Each row's own time counts: the model returned has the logs' rate of sampling, whatever the machine file says.
    needs: names of sensors that must be there. use: what the notes say that the logs are for. rate [Hz]: of the grid,
    that of the slowest log if not given. Raises LogError: file, row and column, what is wrong, what to do.
    """
    machine = model.machine
    sources = _numbered(sources)
    given = [one for one in sources if isinstance(one, Log)]
    files = [one for one in _joined(sources, machine) if not isinstance(one, Log)]
    read = [_read_limited(source, model, needs, rate) for source in files]
    rates = [s.rate for stretches, _ in read for s in stretches]
    rates += [(len(one) - 1) / float(one.t[-1] - one.t[0]) for one in given[:1]]
    common = rate or min(rates)
    differs = max(rates) / common - 1 > SAME_RATE
    if differs:
        read = [
            (stretches, said)
            if all(abs(s.rate / common - 1) < SAME_RATE for s in stretches)
            else _read_limited(source, model, needs, common)
            for source, (stretches, said) in zip(files, read, strict=True)
        ]
    notes, stretches = list[str](), list[tuple[str, Stretch, Machine]]()
    for source, (found, said) in zip(files, read, strict=True):
        name = _name(source)
        for stretch in found:
            where = name if len(found) == 1 else f"{name} from row {stretch.first_row + 1}"
            stretches.append((where, slower_to(stretch, machine, common), machine))
        notes += [f"{line} ({use})" if use else line for line in dict.fromkeys(said)]
    if differs:
        notes.append(
            f"logs at {format_number(common, 6)} to {format_number(max(rates), 6)} Hz are brought to"
            f" {format_number(common, 6)} Hz"
        )
    at_rate = with_rate(model, common)
    logs = [as_log(stretch, at_rate.machine, needs, name) for name, stretch, _ in stretches]
    return Prepared(
        at_rate, [*given, *(part for one in logs for part in without_rests(one, at_rate.machine, notes))], notes
    )


def _read_limited(
    source: str | Path | pd.DataFrame, model: Model, needs: Sequence[str], rate: float | None
) -> tuple[list[Stretch], list[str]]:
    """Read one log as even stretches that are no faster than the machine needs, with notes. Raises LogError."""
    found, said = read_stretches(source, model.machine, needs, rate)
    if not model.slips or rate is not None:
        return found, said
    thinned = [slower(stretch, model.machine, FASTEST_HZ) for stretch in found]
    said += [
        f"{_name(source)}: {format_number(old.rate, 4)} Hz is faster than the machine: reduced to"
        f" {format_number(new.rate, 4)} Hz"
        for old, new in zip(found, thinned, strict=True)
        if new is not old
    ]
    return thinned, said


def read_stretches(
    source: str | Path | pd.DataFrame, machine: Machine, needs: Sequence[str] = (), rate: float | None = None
) -> tuple[list[Stretch], list[str]]:
    """Read one log as even stretches, with notes. Raises LogError."""
    name = _name(source)
    table = as_meant(source, machine, name) if isinstance(source, pd.DataFrame) else log.table_of(source, machine)
    table = on_one_clock(table, machine, name)
    notes = [f"{name}: {line}" for line in table.attrs.get("notes", ())]
    accepted = refusal.accept(table, machine, needs, name)
    stretches, said = place_rows(accepted.table, machine, needs, name, rate)
    used = {line.partition(" row only")[0] for line in said}  # of held channels the note says how they are used
    doubts = [line for line in accepted.doubts if line.partition(" row only")[0] not in used]
    grave = tuple(line for line in accepted.grave if line.partition(" row only")[0] not in used)
    doubtful = [replace(stretch, doubts=grave) for stretch in stretches]
    return doubtful, [*notes, *accepted.notes, *said, *doubts]


def _numbered(sources: Sequence[Source]) -> list[Source]:
    """Name tables without a file log 1, log 2 and so on, if there are several."""
    named = list[Source]()
    count = sum(isinstance(s, pd.DataFrame) for s in sources)
    for k, source in enumerate(sources):
        if count > 1 and isinstance(source, pd.DataFrame) and "source" not in source.attrs:
            attrs = {**source.attrs, "source": f"log {k + 1}"}
            source = source.copy(deep=False)
            source.attrs = attrs
        named.append(source)
    return named


def _name(source: str | Path | pd.DataFrame) -> str:
    """Name a source in messages."""
    return str(source.attrs.get("source", "log")) if isinstance(source, pd.DataFrame) else str(source)


def place_rows(
    table: pd.DataFrame, machine: Machine, needs: Sequence[str] = (), name: str = "log", rate: float | None = None
) -> tuple[list[Stretch], list[str]]:
    """Order the rows of a checked table and bring them onto even grids, with notes. Raises LogError."""
    log.require_columns(table, machine, needs, name)
    t = seconds(table, machine, name)
    if line := log.too_short(len(t), machine):
        raise LogError(f"{name}: {line}")
    runs, said = _ordered(t, table, machine, machine.time_column, UNITS[machine.time_unit][1], name)
    stretches = list[Stretch]()
    for run in runs:
        found, more = even_stretches(table, run, machine, name, rate)
        stretches += found
        said += more
    least = log.fewest_rows(machine)
    long = [s for s in stretches if len(s.table) >= least]
    if long and len(long) < len(stretches):
        short = f"of less than {least} rows"
        left_out = count(len(stretches) - len(long), f"stretch {short} is", f"stretches {short} are")
        said.append(f"{name}: {left_out} left out")
    return long or stretches, said


def _ordered(
    t: np.ndarray, table: pd.DataFrame, machine: Machine, column: str, unit: float, source: str
) -> tuple[list[Run], list[str]]:
    """Order rows of a machine's channels with times t (N,) [s] of a clock, as `order_rows` does."""
    turning = [s.column for s in machine.sensor if s.kind in ("angle", "wheel") and not s.is_rate]
    positions = [c for c in turning if c in table.columns]
    runs, notes = order_rows(t, table, column, source, positions, 1 / float(machine.sampling_hz), unit)
    if machine.stamps == "arrival":
        runs = [evenly(run, column, source, notes) for run in runs]
    return runs, notes


def on_one_clock(table: pd.DataFrame, machine: Machine, source: str) -> pd.DataFrame:
    """Return a table with its channels on the machine's clock, if some have one of their own. Raises LogError."""
    own_clocks = not has_time(table, machine) or any(s.time_column or s.time_offset for s in machine.sensor)
    if MERGED in table.attrs or not own_clocks:
        return table
    merged = merge_own_times([table], machine, [source])
    if merged is None:
        return table
    notes = [*table.attrs.get("notes", ()), *(n.removeprefix(f"{source}: ") for n in merged.attrs["notes"])]
    merged.attrs = {**table.attrs, **merged.attrs, "notes": notes}
    return merged


def merge_own_times(tables: Sequence[pd.DataFrame], machine: Machine, sources: Sequence[str]) -> pd.DataFrame | None:
    """Merge channels that have times of their own into one table on all times; None if all are on the machine's clock.

    A channel's clock is the sensor's `time_column`, the machine's, or the time column to the left of it in its table;
    `time_offset` is added. Cells of a channel that has no reading at a time are blank. sources: names of the tables in
    messages. Raises LogError for a clock that begins anew or lasts a thousand times as long as another.
    """
    used = {c for s in machine.sensor for c in s.columns}
    parts = dict[tuple[int, str, str, float], list[str]]()
    for sensor in machine.sensors("full"):
        k = next((k for k, table in enumerate(tables) if set(sensor.columns) <= set(table.columns)), None)
        clock = None if k is None else _clock(tables[k], machine, sensor, used, sources[k])
        if k is None or clock is None:
            continue
        unit = sensor.time_unit or _unit_in_file(tables[k], clock) or machine.time_unit
        parts.setdefault((k, clock, unit, sensor.time_offset), []).extend(sensor.columns)
    if len(parts) < 2 and not any(clock in {s.time_column for s in machine.sensor} for _, clock, _, _ in parts):
        return None
    merged: pd.DataFrame | None = None
    one_unit = UNITS[machine.time_unit][1]
    notes = list[str]()
    spans = dict[str, float]()
    for (k, clock, unit, offset), columns in parts.items():
        t, one = _channels_in_order(tables[k], machine, clock, UNITS[unit][1], columns, sources[k], notes)
        spans[f"{sources[k]}: column {clock}"] = float(np.ptp(t)) if len(t) else 0.0
        one.insert(0, machine.time_column, np.round(t + offset, DIGITS) / one_unit)
        merged = one if merged is None else merged.merge(one, on=machine.time_column, how="outer")
    _refuse_other_scale(spans)
    assert merged is not None
    merged = merged.sort_values(machine.time_column, ignore_index=True)
    merged.attrs["notes"] = list(dict.fromkeys(notes))
    for key in (UNITS_SAID, UNITS_UNKNOWN, UNCLEAR):
        said = {c: v for table in tables for c, v in table.attrs.get(key, {}).items()}
        merged.attrs[key] = {c: v for c, v in said.items() if c in used}
    return merged


def _channels_in_order(
    table: pd.DataFrame,
    machine: Machine,
    clock: str,
    unit: float,
    columns: list[str],
    source: str,
    notes: list[str],
) -> tuple[np.ndarray, pd.DataFrame]:
    """Times (N,) [s] of channels with a clock of their own and their readings, in order. Raises LogError."""
    t = absolute_seconds(table[clock], unit)
    there = np.isfinite(t) & table[columns].notna().all(axis=1).to_numpy()
    rows = np.flatnonzero(there)
    refuse_swapped_dates(table.loc[there, clock], t[there], clock, source)
    part = table.loc[there, columns].reset_index(drop=True)
    runs, said = _ordered(t[there], part, machine, clock, unit, source) if len(rows) else ([], [])
    if len(runs) > 1:
        anew = ", ".join(str(rows[run.rows[0]] + 1) for run in runs[1:])
        raise LogError(
            f"{source}: row {anew}, column {clock}: time begins anew, and nobody knows where that is on the other"
            " clocks; give the rows before and after as logs of their own"
        )
    notes += said
    if not runs:
        return np.empty(0), part
    return runs[0].t, part.iloc[runs[0].rows].reset_index(drop=True)


def _refuse_other_scale(spans: dict[str, float]) -> None:
    """Raise LogError where a clock lasts as long as another if its numbers are in another unit. spans [s]: by clock."""
    for (one, lasts), (other, longer) in itertools.permutations(spans.items(), 2):
        near = [unit for unit in SCALES if lasts > 0 and abs(longer / lasts / unit - 1) < ALIKE_SPANS]
        if near:
            raise LogError(
                f"{other}: lasts {format_number(longer, 4)} s, {near[0]:g} times as long as {one.rpartition(': ')[2]}:"
                " is it in another unit? then write time_unit for its sensors in the machine file"
            )


def _clock(table: pd.DataFrame, machine: Machine, sensor: Sensor, used: set[str], source: str) -> str | None:
    """Find the time column of a sensor in its table. Raises LogError where one is named that is not there."""
    if sensor.time_column is not None and sensor.time_column not in table.columns:
        raise LogError(
            f"{source}: no column {sensor.time_column}, which the machine file names as time_column of sensor"
            f" {sensor.name} (column {sensor.column}): name the column of its times, or take time_column out"
        )
    for name in (sensor.time_column, machine.time_column):
        if name is not None and name in table.columns:
            return name
    before = map(str, list(table.columns)[: list(table.columns).index(sensor.column)])
    found = [c for c in before if c not in used and is_clock(c, table[c], table.attrs.get(UNITS_SAID, {}).get(c))]
    return found[-1] if found else None


def _unit_in_file(table: pd.DataFrame, clock: str) -> str | None:
    """Return the unit of a time column that the file states, if it is known."""
    unit = known_unit(table.attrs.get(UNITS_SAID, {}).get(clock, ""))
    return unit if unit in TIME_UNITS else None


def _joined(sources: Sequence[Source], machine: Machine) -> list[Source]:
    """Join files that hold some of the machine's columns each, and all of them together, to one log."""
    files = [s for s in sources if not isinstance(s, Log)]
    if len(files) < 2:
        return list(sources)
    needed = {c for s in machine.sensors("full") if is_needed(s, machine) for c in s.columns}
    tables = [s if isinstance(s, pd.DataFrame) else log.table_of(s, machine) for s in files]
    own = [needed & set(table.columns) for table in tables]
    whole = any(columns == needed for columns in own)
    if whole or set().union(*own) != needed or any(not columns for columns in own):
        return list(sources)
    merged = merge_own_times(tables, machine, [_name(s) for s in files])
    if merged is None:
        return list(sources)
    names = " and ".join(str(s) for s in files if not isinstance(s, pd.DataFrame))
    merged.attrs["source"] = names or "log"
    merged.attrs[MERGED] = True
    said = [
        f"{_name(s)}: {line}" for s, table in zip(files, tables, strict=True) for line in table.attrs.get("notes", ())
    ]
    merged.attrs["notes"] = [
        "channels of several files are put together by their times",
        *dict.fromkeys([*said, *merged.attrs["notes"]]),
    ]
    return [*(s for s in sources if isinstance(s, Log)), merged]


def slower_to(stretch: Stretch, machine: Machine, rate: float) -> Stretch:
    """A stretch at a given rate."""
    return stretch if abs(stretch.rate / rate - 1) < SAME_RATE else at_rate(stretch, machine, rate)


def with_rate(model: Model, rate: float) -> Model:
    """The model with another rate of sampling [Hz]; the same object if it is the machine file's."""
    machine = at_rate_of(model.machine, rate)
    return model if machine is model.machine else replace(model, machine=machine)


def at_rate_of(machine: Machine, rate: float) -> Machine:
    """The machine with another rate of sampling [Hz]; the same object if it is the machine file's."""
    nominal = machine.sampling_hz
    if abs(rate / float(nominal) - 1) < SAME_RATE:
        return machine
    said = nominal.model_copy(update={"value": rate, "source": "measured", "note": "of the log"})
    return machine.model_copy(update={"sampling_hz": said})


def as_log(stretch: Stretch, machine: Machine, needs: Sequence[str], source: str) -> Log:
    """A stretch as a checked log, from where the loops of commanded drives have forgotten what came before it.

    Raises LogError.
    """
    table = stretch.table.assign(**{machine.time_column: 0.0})
    table.attrs = {}
    sampled = {s.name: stretch.sampled[s.column] for s in machine.sensors("full") if s.column in stretch.sampled}
    made = log.from_table(table, machine, needs, source, np.arange(len(table)) / stretch.rate, sampled)
    counted = [s for s in machine.sensors("full") if s.column in stretch.edges]
    edges = {s.name: s.gain * stretch.edges[s.column] - s.shift for s in counted}
    made = replace(made, interpolated=stretch.interpolated, edges=edges, doubts=stretch.doubts)
    loops = [s.loop for s in machine.sensors("full") if s.loop is not None and s.name in made.values]
    settling = math.ceil(stretch.rate * max((loop.settling_s for loop in loops), default=0.0))
    if line := log.too_short(len(made) - settling, machine) if settling else "":
        raise LogError(f"{source}: {line} after the first {settling} rows, in which the drive's loop settles")
    return _part(made, settling, len(made) - 1) if settling else made


def without_rests(one: Log, machine: Machine, notes: list[str]) -> list[Log]:
    """A log's stretches of motion: standing still for long tells nothing and is left out, with a note."""
    moving = np.zeros(len(one), bool)
    for sensor in machine.sensors("full"):
        if sensor.name not in one.values or sensor.kind not in ("angle", "wheel"):
            continue
        x = one.values[sensor.name]
        if sensor.resolution is None:
            return [one]  # where noise moves the reading, rest can't be told by it
        change = np.flatnonzero(np.abs(np.diff(x)) > 0.5 * sensor.resolution)
        moving[change] = moving[change + 1] = True
    if not moving.any():
        return [one]
    rate = float(machine.sampling_hz)
    rows = np.flatnonzero(moving)
    margin = round(REST_MARGIN_S * rate)
    edges = np.flatnonzero(np.diff(rows) > REST_S * rate)
    first = [max(rows[0] - margin, 0) if rows[0] > REST_S * rate else 0, *(rows[edges + 1] - margin)]
    end = len(one) - 1
    last = [*(rows[edges] + margin), min(rows[-1] + margin, end) if end - rows[-1] > REST_S * rate else end]
    if len(first) == 1 and first[0] == 0 and last[0] == end:
        return [one]
    least = log.fewest_rows(machine)
    parts = [(a, b) for a, b in zip(first, last, strict=True) if b - a + 1 >= least]
    if not parts:
        return [one]
    used = sum(b - a for a, b in parts) / rate
    notes.append(
        f"{one.source}: the machine stands still for {format_number((end / rate) - used, 4)} s, which is left out"
    )
    return [
        replace(_part(one, a, b), source=one.source if len(parts) == 1 else f"{one.source} from row {a + 1}")
        for a, b in parts
    ]


def _part(one: Log, first: int, last: int) -> Log:
    """The rows of a log from one to another, that one included, with times from zero."""
    values, sampled, edges = (
        {n: v[first : last + 1] for n, v in own.items()} for own in (one.values, one.sampled, one.edges)
    )
    return replace(one, t=one.t[first : last + 1] - one.t[first], values=values, sampled=sampled, edges=edges)
