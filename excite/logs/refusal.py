"""Faults of a table of measurements for which it can be told what to write instead."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import log
from excite.logs.plausibility import RATES, as_speed, is_speed, own_file
from excite.logs.tables import COMMENTS
from excite.logs.times import has_time, seconds
from excite.model.machine import TURN, UNITS, Machine, Sensor

T = TypeVar("T")

CLOSE = 0.05  # of a unit's size, when a wrong rate of sampling is taken for time in that unit


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
    if lacking or not has_time(table, machine):
        return
    for stray in stray_rows(table).values():
        raise LogError(f"{source}: {stray}")
    t = caught(lambda: seconds(table, machine, source), None)
    if t is not None and (clock := wrong_time_unit(t, machine)):
        raise LogError(f"{source}: {clock}")
    if t is not None:
        table = table.iloc[unbroken_rows(t, machine)].reset_index(drop=True)
    for sensor in machine.sensors("full"):
        if sensor.kind != "angle" or not set(sensor.columns) <= set(table.columns):
            continue
        values = caught(lambda s=sensor: log.values_of(s, machine, table, source), None)  # type: ignore[misc]
        if values is not None and len(values) > 1 and (speed := speed_for_angle(sensor, values, table, machine)):
            raise LogError(f"{source}: {speed}")


def unbroken_rows(t: np.ndarray, machine: Machine) -> slice:
    """Rows of the longest stretch of times (N,) [s] without a gap: across one an angle may jump."""
    edges = [0, *log.gap_rows(t, machine), len(t)]
    return slice(*max(itertools.pairwise(edges), key=lambda ends: ends[1] - ends[0]))


def speed_for_angle(sensor: Sensor, values: np.ndarray, table: pd.DataFrame, machine: Machine) -> str:
    """Return a line for an angle (N,) [SI] that its joint can't follow but that could be its speed, and goes with the
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
    torques = [caught(lambda s=s: log.values_of(s, machine, table, ""), None) for s in drives]  # type: ignore[misc]
    known = [u for u in torques if u is not None]
    if not units or not is_speed(values, known, rate):
        return ""
    return (
        f"column {sensor.column}: changes faster than the joint can turn, as its speed would: is it one? then"
        f" {as_speed(units, machine)}"
    )


def _possible(sensor: Sensor, values: np.ndarray, machine: Machine) -> bool:
    """Tell if a joint can do what readings (N,) [SI] say."""
    said: list[str] = []
    caught(lambda: log.check_values(sensor, values, float(machine.sampling_hz), machine, ""), said)
    return not said


def wrong_time_unit(t: np.ndarray, machine: Machine) -> str:
    """Return a line for times (N,) [s] in another unit than the machine file says, "" otherwise."""
    typical, rate = float(np.median(np.diff(t))) if len(t) > 1 else 0.0, float(machine.sampling_hz)
    if typical <= 0:
        return ""
    for unit in ("s", "ms", "us", "ns", "min", "day"):
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
