"""The order of a log's rows in time: clocks that wrap, restart or tick coarsely, rows that are there twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.clocks import ROUNDED, goes_on, period_of, unrounded
from excite.logs.files.common import SHOWN
from excite.logs.times import DAY_S
from excite.text import count, format_number

HOUR_S = 3600.0  # [s] by which a clock is set for summer time
SLACK_STEPS = 20.0  # steps by which a clock's jump may differ from a whole day or hour; chosen
MIN_RUN_ROWS = 20  # rows that a part of a log must have to be a log of its own; chosen
GAP_STEPS = 10.0  # usual steps to the next row, from which a clock may have stood between; chosen
SORTED_EVEN = 0.05  # relative deviation of steps up to which sorted rows count as even; chosen


@dataclass(frozen=True)
class Run:
    """Rows (N,) of a table whose times t (N,) [s] increase."""

    rows: np.ndarray
    t: np.ndarray


def order_rows(
    t: np.ndarray,
    table: pd.DataFrame,
    column: str,
    source: str,
    positions: Sequence[str] = (),
    nominal_step: float = 0.0,
    unit: float = 1.0,
) -> tuple[list[Run], list[str]]:
    """Bring rows with times t (N,) [s] into runs of increasing time, with a note for each thing that was done.

    A time of day past midnight, a clock set back an hour and a counter that begins anew while positions move on are
    read on; rows that repeat the one before are dropped; a clock coarser than the rows, or rounded, is replaced by even
    steps along it; where time begins anew a new run begins.

    positions: columns of positions. nominal_step [s]: of the machine file. unit [s]: of the clock's numbers.
    Raises LogError where the order can't be known.
    """
    rows, notes = np.arange(len(t)), list[str]()
    t = t.copy()
    positive = np.diff(t)[np.diff(t) > 0]
    step = float(np.median(positive)) if len(positive) else 0.0
    for span, what in ((DAY_S, "time of day passes midnight"), (HOUR_S, "the clock is set back an hour")):
        for k in np.flatnonzero(np.abs(np.diff(t) + span) <= SLACK_STEPS * step):
            t[k + 1 :] += span
            notes.append(f"{source}: row {k + 2}, column {column}: {what}, read on")
    known = _numbers(table, positions)
    back = np.flatnonzero(np.diff(t) < 0) + 1
    if len(back) and (period := period_of(t, unit)) and goes_on(known, back):
        t += period * np.searchsorted(back, rows, side="right")
        where = ", ".join(str(k + 1) for k in back[:SHOWN]) + (", ..." if len(back) > SHOWN else "")
        notes.append(
            f"{source}: row {where}, column {column}: the clock begins anew every {format_number(period, 6)} s, read on"
        )
    repeated = np.flatnonzero(np.diff(t) == 0) + 1
    if len(repeated):
        before = table.iloc[repeated - 1].reset_index(drop=True)
        same = (table.iloc[repeated].reset_index(drop=True).eq(before) | before.isna()).all(axis=1).to_numpy()
        if same.all() or same.sum() > len(t) // 3:
            drop = repeated[same]
            keep = np.setdiff1d(rows, drop)
            rows, t = rows[keep], t[keep]
            which = (
                "every row is there twice"
                if len(drop) >= len(keep) - 1
                else f"{count(len(drop), 'row repeats', 'rows repeat')} the one before"
            )
            notes.append(f"{source}: {which}, the copies are left out")
    runs = _split(rows, t, column, source, notes)
    runs = [_even_ticks(run, column, nominal_step, source, notes) for run in runs]
    return [_unrounded(run, known, nominal_step, source, notes) for run in runs], notes


def _numbers(table: pd.DataFrame, columns: Sequence[str]) -> np.ndarray:
    """Numbers (N, p) of columns."""
    found = [pd.to_numeric(table[c], errors="coerce").to_numpy(dtype=float) for c in columns]
    return np.column_stack(found) if found else np.empty((len(table), 0))


def _split(rows: np.ndarray, t: np.ndarray, column: str, source: str, notes: list[str]) -> list[Run]:
    """Runs between the rows where time begins anew; sorted rows where these are even."""
    back = np.flatnonzero(np.diff(t) < 0) + 1
    if not len(back):
        return [Run(rows, t)]
    parts = np.split(np.arange(len(t)), back)
    if min(map(len, parts)) >= MIN_RUN_ROWS:
        where = ", ".join(str(rows[k] + 1) for k in back)
        notes.append(f"{source}: time begins anew in row {where}: read as {len(parts)} logs in one file")
        return [Run(rows[p], t[p]) for p in parts]
    order = np.argsort(t, kind="stable")
    steps = np.diff(t[order])
    if (steps > 0).all() and np.abs(steps / np.median(steps) - 1).max() < SORTED_EVEN:
        notes.append(f"{source}: {count(len(back), 'row is', 'rows are')} not in order of time, sorted")
        return [Run(rows[order], t[order])]
    k = int(back[0])
    raise LogError(
        f"{source}: row {rows[k] + 1}, column {column}: time goes back ({t[k - 1]:g} s, then {t[k]:g} s;"
        f" {count(len(back), 'time')} in all), and no order of the rows is even: is it the time of all channels?"
    )


def _even_ticks(run: Run, column: str, nominal_step: float, source: str, notes: list[str]) -> Run:
    """A run whose times increase strictly: rows that share a tick of a coarse clock are spread evenly along it.

    The first and the last tick hold part of their rows only, so the step is that from the first row of the second tick
    to the first row of the last one, or nominal_step [s] if the ticks allow it.
    """
    t = run.t
    shared = int((np.diff(t) == 0).sum())
    if not shared:
        return run
    ticks = np.unique(t)
    tick = float(np.median(np.diff(ticks))) if len(ticks) > 1 else 0.0
    k = np.arange(len(t))
    slope, start = np.polyfit(k, t, 1)
    off = float(np.abs(t - (start + slope * k)).max())
    if tick <= 0 or slope <= 0 or off > 1.5 * tick:
        first = int(np.argmax(np.diff(t) == 0)) + 1
        raise LogError(
            f"{source}: row {run.rows[first] + 1}, column {column}:"
            f" {count(shared, 'row shares its', 'rows share their')} time with the row before, and rows are not even"
            " along the clock: log a finer time"
        )
    begin = np.flatnonzero(np.diff(t) > 0) + 1
    allowed = _ticks_allow(t, begin, tick, nominal_step)
    if allowed:
        slope = nominal_step
    elif len(begin) > 1:
        slope = float(np.polyfit(begin, t[begin], 1)[0])
    said = ", as in the machine file, which the ticks allow" if allowed else ""
    notes.append(
        f"{source}: {count(shared, 'row shares its', 'rows share their')} time with the row before: the clock ticks"
        f" every {format_number(tick, 3)} s, the rows are taken to be {format_number(slope, 4)} s apart{said}"
    )
    return Run(run.rows, float(np.mean(t - slope * k)) + slope * k)


def evenly(run: Run, column: str, source: str, notes: list[str]) -> Run:
    """A run whose rows were sampled evenly and stamped when they arrived: even times along the stamps.

    Raises LogError where the stamps leave an even clock, as rows are lost or the rate changes.
    """
    if len(run.t) < MIN_RUN_ROWS:
        return run
    k = np.arange(len(run.t))
    slope, start = np.polyfit(k, run.t, 1)
    late = np.abs(run.t - (start + slope * k))
    if slope <= 0 or late.max() > GAP_STEPS * slope:
        raise LogError(
            f"{source}: row {run.rows[int(np.argmax(late))] + 1}, column {column}: stamps of arrival leave an even"
            f" clock by {format_number(float(late.max()), 3)} s: rows are lost, or the rate changes; take stamps out of"
            " the machine file"
        )
    notes.append(
        f"{source}: stamps of arrival, up to {format_number(1e3 * float(late.max()), 3)} ms off: rows are taken to be"
        f" {format_number(1e3 * slope, 4)} ms apart"
    )
    return Run(run.rows, start + slope * k)


def _ticks_allow(t: np.ndarray, begin: np.ndarray, tick: float, step: float) -> bool:
    """Tell if rows `step` [s] apart explain times t (N,) [s] in ticks, which begin in rows (M,) within a step each."""
    off = t - step * np.arange(len(t))
    return step > 0 and bool(np.ptp(off) <= tick + step and np.ptp(off[begin]) <= ROUNDED * step)


def _unrounded(run: Run, positions: np.ndarray, nominal_step: float, source: str, notes: list[str]) -> Run:
    """A run whose stamps are those of an even clock, but rounded, at that clock's times, between one gap and the
    next."""
    steps = np.diff(run.t)
    usual = float(np.mean(steps)) if len(steps) else 0.0
    usual = float(np.mean(steps[steps <= GAP_STEPS * usual])) if usual > 0 else 0.0
    gaps = np.flatnonzero(steps > GAP_STEPS * usual) + 1
    parts, times, rounding = np.split(np.arange(len(run.t)), gaps), list[np.ndarray](), 0.0
    for part in parts:
        found = unrounded(run.t[part], nominal_step, positions[run.rows[part]])
        if found is None:
            return run
        times.append(found[0])
        rounding = max(rounding, found[1])
    rate = 1 / float(np.median(np.diff(times[0])))
    notes.append(
        f"{source}: times are rounded to {format_number(1e3 * rounding, 3)} ms: an even clock of"
        f" {format_number(rate, 5)} Hz explains all of them and is used"
    )
    return Run(run.rows, np.concatenate(times))
