"""Repair of a log before it is used: spikes of a single reading."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from excite.logs.checks import findings, refuse
from excite.logs.log import Log
from excite.logs.outliers import dropouts_of, spikes_of, too_many
from excite.logs.plausibility import doubts
from excite.logs.record import Channel, Record, record_of_log
from excite.model.machine import Machine, Sensor
from excite.text import count, format_number


def is_needed(sensor: Sensor, machine: Machine) -> bool:
    """Tell if no method does without a sensor. The angle of a joint that moves with a measured one is optional."""
    lead = machine.find(sensor.body).moves_with if sensor.kind == "angle" else None
    angles = [s.body for s in machine.sensor if s.kind == "angle" and not s.is_rate]
    return sensor.kind in ("torque", "wheel", "angle") and (lead is None or lead.joint not in angles)


@dataclass(frozen=True)
class Examination:
    """A log repaired, and what was found: notes; spikes {sensor: rows}; drop-outs {sensor: [(first, last) row]}; and
    what else is doubtful about it, a line each."""

    log: Log
    notes: tuple[str, ...]
    spikes: dict[str, tuple[int, ...]]
    dropouts: dict[str, tuple[tuple[int, int], ...]]
    doubts: tuple[str, ...] = ()


def examine(machine: Machine, log: Log) -> Examination:
    """Replace spikes of a single sample by the mean of their neighbours, note drop-outs and what is doubtful.

    Raises LogError for every fault that `checks` finds; rows that were uneven were checked at their own times before.
    """
    values = dict(log.values)
    notes: list[str] = []
    doubtful: list[str] = []
    spikes: dict[str, tuple[int, ...]] = {}
    held: dict[str, tuple[tuple[int, int], ...]] = {}
    record = record_of_log(machine, log)
    if not log.interpolated:
        found = findings(record)
        doubtful += refuse(found, log.source)
        notes += [f"{log.source}: {f.text}" for f in found if f.check == "dropouts" and f.kind == "remark"]
        held = {c.sensor.name: ends for c in record.of("dropouts") if (ends := dropouts_of(c, record))}
    for c in record.of("spikes"):
        sensor, rows = c.sensor, spikes_of(c)
        if too_many(rows, c):
            doubtful.append(
                f"{log.source}: column {sensor.column}: {count(len(rows), 'reading is', 'readings are')} off what"
                " their neighbours and their times say, left as they are: were they taken at these times?"
            )
        elif len(rows):
            mean = _mean_of_neighbours(c, rows)
            clean = values[sensor.name].copy()
            clean[c.rows[rows]] = mean
            values[sensor.name] = clean
            spikes[sensor.name] = tuple(int(r) for r in c.rows[rows])
            notes.append(_note(sensor, machine, c.rows[rows], float(np.abs(c.x[rows] - mean).max()), log.source))
    lines = doubts(machine, values, log.interpolated)
    doubtful += [line for text in lines if (line := f"{log.source}: {text}") not in doubtful]
    return Examination(replace(log, values=values), tuple(notes), spikes, held, tuple(doubtful))


def mended(table: pd.DataFrame, record: Record, source: str) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Replace spikes in a table's columns by what the neighbours say at their time, with notes. record: its
    channels."""
    changed, notes = {}, []
    for c in record.of("spikes"):
        k = spikes_of(c) if len(c.sensor.columns) == 1 else np.zeros(0, int)
        if not len(k) or too_many(k, c):
            continue
        mean = _mean_of_neighbours(c, k)
        column = pd.to_numeric(table[c.sensor.column], errors="coerce").to_numpy(dtype=float).copy()
        column[c.rows[k]] = (mean + c.sensor.shift) / c.sensor.gain
        changed[c.sensor.column] = column
        notes.append(_note(c.sensor, record.machine, c.rows[k], float(np.abs(c.x[k] - mean).max()), source))
    if not changed:
        return table, ()
    clean = table.assign(**changed)
    clean.attrs = table.attrs
    return clean, tuple(notes)


def _mean_of_neighbours(c: Channel, k: np.ndarray) -> np.ndarray:
    """Means (m,) of the readings before and after some (m,), each weighted by its nearness in time."""
    before, after = c.t[k] - c.t[k - 1], c.t[k + 1] - c.t[k]
    whole = before + after
    part = np.where(whole > 0, before / np.where(whole > 0, whole, 1.0), 0.5)
    return np.asarray(c.x[k - 1] + part * (c.x[k + 1] - c.x[k - 1]))


def _note(sensor: Sensor, machine: Machine, rows: np.ndarray, size: float, source: str) -> str:
    """What is said of spikes in rows (from 0) that were replaced."""
    shown = ", ".join(str(r + 1) for r in rows[:5]) + (", ..." if len(rows) > 5 else "")
    return (
        f"{source}: column {sensor.column}: {count(len(rows), 'spike')} of up to {format_number(size, 3)}"
        f" {machine.si_unit(sensor)} replaced by the mean of the neighbours (row {shown})"
    )


def moves(machine: Machine, log: Log) -> bool:
    """Tell if any angle goes further than a count or two, or changes at all where it isn't counted."""
    turning = [s for s in machine.sensors("full") if s.kind in ("angle", "wheel") and s.name in log.values]
    return any(np.ptp(log.values[s.name]) > 2.5 * (s.resolution or 0.0) for s in turning)
