"""Clocks in a table: columns that are one, clocks that disagree, stamps that are rounded, counters that wrap."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.times import absolute_seconds
from excite.model.machine import TIME_UNITS, UNITS
from excite.text import format_number

TIME_NAME = re.compile(r"(?i)(.*[^a-z])?(t|.*time|timestamps?|stamp|clock)([^a-z].*)?")
TIME_WORD = re.compile(r"(?i).*(time|stamp|clock).*")
TIME_IN_UNIT = re.compile(r"(?i)(.*[^a-z])?t[ _]*[\[(]?(s|sec|ms|us|ns|min|day)[\])]?")
TEMPERATURE = re.compile(r"(?<![A-Za-z])T(?![A-Za-z])")  # T_oil
MIN_RISING_SHARE = 0.5  # of a clock's steps; coarse clocks repeat themselves, temperatures fall as often; chosen
CLOCK_EVEN = 0.02  # relative deviation of a clock's steps from the usual one; chosen
CLOCK_EVEN_SHARE = 0.9  # share of steps within it; chosen
SAME_SCALE = 2.0  # ratio of the lengths of two clocks' spans that one unit allows; chosen
CLOCK_UNITS_S = (1.0, 1e-3, 1e-6, 1e-7, 1e-9, 60.0, 3600.0, 86400.0)  # [s] of a clock whose unit nobody gives
OUTLIERS = 0.01  # share of stamps at either end that say nothing of a clock's drift; chosen
FIRST_ROWS = 64  # rows from which the step of rounded stamps is found, then twice as many, and so on; chosen
CLEARLY = 1.2  # ratio of the mean squares of two fits of positions that decides which times are right; chosen
REFINED = 3  # times that rows are placed again along a better line; chosen
ROUNDED = 1.05  # times the rounding step over which stamps of an even clock may spread; chosen
ROUNDED_SHARE = 0.02  # of a step: finer rounding does no harm; chosen
ROUNDED_MOST = 0.9  # of a step: a clock that is coarser has rows that share a stamp; chosen
HALF_DAY_S = 43200.0  # [s] of a clock with twelve hours
COUNTER_BITS = (16, 24, 32)  # of counters of ticks
TICKS_S = (1e-3, 1e-6, 1e-7, 1e-9)  # [s] of such counters
SEAM_STEPS = 3.5  # usual steps to the row after a clock begins anew; chosen
DECADES = range(10)  # decimals [s] to which stamps are rounded


def is_clock(name: str, column: pd.Series, unit: str | None = None) -> bool:
    """Tell if a column with such a name is a clock, by its name, its unit in the file, and its steps.

    Text may be a clock if its name says so. Temperatures (T_oil) are none, also while they rise.
    """
    if not TIME_NAME.fullmatch(name):
        return False
    values = pd.to_numeric(column, errors="coerce").dropna().to_numpy(dtype=float)
    if len(values) < 2:
        return bool(column.notna().any())
    steps = np.diff(values)
    if float(np.mean(steps > 0)) <= MIN_RISING_SHARE:
        return False
    if unit in TIME_UNITS or TIME_WORD.fullmatch(name) or TIME_IN_UNIT.fullmatch(name) or name.strip() == "t":
        return True
    if unit is not None or (name.strip() != "T" and TEMPERATURE.search(name)):
        return False
    usual = float(np.median(steps[steps > 0]))
    return float(np.mean(np.abs(steps / usual - 1) <= CLOCK_EVEN)) >= CLOCK_EVEN_SHARE


def other_clocks(table: pd.DataFrame, used: Collection[str]) -> dict[str, np.ndarray]:
    """Times (N,) of clocks that nothing uses, by column, in the file's unit or [s]; NaN in blank cells."""
    found = {}
    units: dict[str, str] = table.attrs.get("units", {})
    for name in map(str, table.columns):
        if name in used or not TIME_NAME.fullmatch(name) or not is_clock(name, table[name], units.get(name)):
            continue
        unit = units.get(name, "")
        try:
            t = absolute_seconds(table[name], UNITS[unit][1] if unit in TIME_UNITS else 1.0)
        except (LogError, ValueError, TypeError, OverflowError):
            continue
        if np.isfinite(t).sum() > 2:
            found[name] = t
    return found


def between_channels(table: pd.DataFrame, clock: str, time_column: str, channels: Collection[str]) -> bool:
    """Tell if a second clock stands as one of loggers that each write a clock and channels: some on either side of
    it, and the machine's clock has numbers that count from an origin of its own."""
    names = list(map(str, table.columns))
    if time_column not in names or not pd.api.types.is_numeric_dtype(table[time_column]):
        return False
    at = names.index(clock)
    return any(c in channels for c in names[:at]) and any(c in channels for c in names[at:])


def disagreement(t: np.ndarray, other: np.ndarray, name: str, column: str, one_origin: bool) -> str:
    """Return a line for a clock `column` with times other (N,) that runs otherwise than the times t (N,) [s] of
    `name`, "" where they agree within a row or a tick.

    The unit of the other clock is the one in which both last about as long. one_origin: a shift counts as well, unless
    it is longer than the log.
    """
    there = np.isfinite(other)
    t, other = t[there], other[there]
    edges = [0, *(int(k) + 1 for k in np.flatnonzero(np.diff(t) < 0)), len(t)]
    first, last = max(itertools.pairwise(edges), key=lambda ends: ends[1] - ends[0])
    t, other = t[first:last], other[first:last]
    if len(t) < 2:
        return ""
    steps = np.diff(other)
    rise = float(steps[steps > 0].sum())
    if np.ptp(t) <= 0 or rise <= 0:
        return ""
    ratio = np.ptp(t) / rise
    unit = min(CLOCK_UNITS_S, key=lambda one: abs(np.log(ratio / one)))
    if abs(np.log(ratio / unit)) > np.log(SAME_SCALE):
        return ""
    if (steps < 0).any() and (period := period_of(unit * other, unit)):
        other = np.concatenate([[other[0]], other[0] + np.cumsum(steps + (steps < 0) * period / unit)])
    ahead = unit * other - t
    least = max(_tick(t), _tick(unit * other))
    low, high = (float(x) for x in np.quantile(ahead, (OUTLIERS, 1 - OUTLIERS)))
    lasts = float(np.ptp(t))
    advice = f"which is right? name it as time_column in the machine file, or leave column {column} out"
    if high - low > least:
        return (
            f"column {column}: a second clock, whose lead over column {name} changes by {format_number(high - low, 3)}"
            f" s in {format_number(lasts, 4)} s: {advice}"
        )
    shift = (low + high) / 2
    if one_origin and least < abs(shift) < lasts:
        where = "ahead of" if shift > 0 else "behind"
        return (
            f"column {column}: a second clock, {format_number(abs(shift), 3)} s {where} column {name}: was it that of"
            f" some channels? then write time_column for them in the machine file, or leave column {column} out"
        )
    return ""


def _tick(t: np.ndarray) -> float:
    """The usual step [s] between times that differ."""
    steps = np.diff(np.unique(t))
    return float(np.median(steps)) if len(steps) else 0.0


def unrounded(t: np.ndarray, nominal_step: float, positions: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Even times (N,) [s] behind stamps t (N,) [s] that are rounded to a decimal, and the rounding step [s].

    None where stamps are finer, or where even rows, some of them lost, do not explain every stamp to within half the
    rounding step. Stamps of 1, 1, 1, 2 ms are those of 800 Hz, or of 1 kHz with every fifth row lost: positions (N, p)
    tell which, as they move more smoothly along the right times. nominal_step [s]: of the machine file.
    """
    found = _even_times(t, nominal_step)
    if found is None:
        return None
    even, _ = found
    rough, smooth = _bends(t, positions), _bends(even, positions)
    if max(rough, smooth) > CLEARLY * min(rough, smooth):
        return found if smooth < rough else None
    return None if _are_multiples(t - t[0], nominal_step) else found


def _bends(t: np.ndarray, x: np.ndarray) -> float:
    """Mean square of what readings x (N, p) at times t (N,) are off the straight line between their neighbours."""
    if not x.size:
        return 0.0
    part = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None]
    off = x[1:-1] - x[:-2] - part * (x[2:] - x[:-2])
    scale = np.maximum(np.abs(x).max(axis=0), np.finfo(float).tiny)
    return float(np.nanmean((off / scale) ** 2)) if np.isfinite(off).any() else 0.0


def _even_times(t: np.ndarray, nominal_step: float) -> tuple[np.ndarray, float] | None:
    """Even times (N,) [s] that explain every stamp t (N,) [s], and the rounding step [s]."""
    if len(t) < FIRST_ROWS or (np.diff(t) <= 0).any():
        return None
    usual = float(np.mean(np.diff(t)))
    rounding = next((r for k in DECADES if _are_multiples(t - t[0], r := 10.0**-k)), 0.0)
    if not ROUNDED_SHARE * usual < rounding <= ROUNDED_MOST * usual:
        return None
    even, _ = _line(np.arange(len(t)), t)
    if np.ptp(t - even) <= ROUNDED * rounding:
        return even, rounding
    first = float(t[FIRST_ROWS - 1] - t[0]) / (FIRST_ROWS - 1)
    for step in (nominal_step, first):
        if (found := _even_grid(t, step, rounding)) is not None:
            return found, rounding
    return None


def _are_multiples(x: np.ndarray, one: float) -> bool:
    return bool(np.abs(x / one - np.rint(x / one)).max() < 1e-3)


def _line(k: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Times (N,) on the straight line through times t (N,) of rows k (N,), its slope and its start."""
    slope, start = np.polyfit(k, t, 1)
    return start + slope * k, (float(slope), float(start))


def _even_grid(t: np.ndarray, step: float, rounding: float) -> np.ndarray | None:
    """Even times (N,) of rows, some of them lost, within half the rounding of stamps t (N,), None if there are none.

    step [s]: a first guess.
    """
    start, n = float(t[0]), FIRST_ROWS
    while True:
        n = min(n, len(t))
        for _ in range(REFINED):
            k = np.rint((t[:n] - start) / step)
            if k[-1] <= k[0]:
                return None
            even, (step, start) = _line(k, t[:n])
        apart = np.diff(k)
        if step <= 0 or np.ptp(t[:n] - even) > ROUNDED * rounding or apart.min() < 1 or np.median(apart) > 1:
            return None
        if n == len(t):
            return even
        n *= 2


def period_of(t: np.ndarray, unit: float) -> float:
    """The period [s] after which a clock with times t (N,) [s], which go back, begins anew; 0 where none fits.

    unit [s]: of its numbers, which may be ticks of a counter.
    """
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    back = steps[steps < 0]
    counters = {2.0**bits * tick for bits in COUNTER_BITS for tick in (unit, *TICKS_S)}
    for period in sorted({1.0, 60.0, HALF_DAY_S, *counters}):
        ahead = back + period
        if usual > 0 and np.ptp(t) < period and (ahead > 0).all() and (ahead <= SEAM_STEPS * usual).all():
            return period
    return 0.0


def goes_on(positions: np.ndarray, seams: np.ndarray) -> bool:
    """Tell if positions (N, p) move on from each row before `seams` to the next as they do elsewhere."""
    steps = np.abs(np.diff(positions, axis=0))
    if not steps.size or not np.isfinite(steps).all() or not (steps > 0).any():
        return False
    inside = np.delete(steps, seams - 1, axis=0)
    return bool((steps[seams - 1] <= SEAM_STEPS * inside.max(axis=0)).all())
