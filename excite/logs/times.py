"""Time columns in any notation as seconds: numbers, dates (ISO 8601 and others), times of day, durations."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.model.machine import UNITS, Machine

DAY_S = 86400.0  # [s]
SECONDS_BY_WORD = {
    "s": 1.0,
    "sec": 1.0,
    "secs": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "ms": 1e-3,
    "msec": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,
    "ns": 1e-9,
    "min": 60.0,
    "minutes": 60.0,
    "hr": 3600.0,
    "h": 3600.0,
    "hours": 3600.0,
    "day": DAY_S,
    "days": DAY_S,
}
NUMBER_AND_UNIT = re.compile(r"\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([a-zµ]+)\s*")
CLOCK = re.compile(r"\s*([+-]?)(?:(\d+)\s+days?,?\s*)?\+?(\d+):(\d{1,2})(?::(\d{1,2}))?(?:[.,:](\d+))?\s*")
DAY_MONTH = re.compile(r"(\d{1,2})([-./])(\d{1,2})[-./]\d{2,4}(?!\d)")  # 22/11/2026
MONTHS = 12
DAYS_PER_MONTH = 30.4  # [day]
LATEST_S = 1e20  # [s] of a clock, whatever its unit: nanoseconds since 1970 are 2e18
FIRST_YEAR, LAST_YEAR = 1678, 2261  # whose nanoseconds fit 64 bits


def has_time(table: pd.DataFrame, machine: Machine) -> bool:
    """Tell if a table has the machine's time column, or a date and a time of day in two columns."""
    return machine.time_column in table.columns or date_and_time(table) is not None


def seconds(table: pd.DataFrame, machine: Machine, source: str) -> np.ndarray:
    """Read the times (N,) [s] of a table, counted from its first row; order and gaps are not checked.

    Numbers are in the machine file's `time_unit`. Raises LogError with the first cell that is not understood.
    """
    name = machine.time_column
    pair = date_and_time(table)
    if pair is not None and (name not in table.columns or name in pair):
        raw = table[pair[0]].astype(str).str.strip() + " " + table[pair[1]].astype(str).str.strip()
    else:
        raw = table[name]
    found = _parse(raw, UNITS[machine.time_unit][1])
    bad = ~(np.abs(found) < LATEST_S)
    if bad.any():
        k = int(np.argmax(bad))
        cell = raw.iloc[k]
        empty = pd.isna(cell) or not str(cell).strip()
        what = "is empty" if empty else f"is {str(cell)[:40]!r}, which is not understood as a time"
        more = f"; {int(bad.sum())} such cells in this column" if bad.sum() > 1 else ""
        advice = "cut the row" if empty else "write seconds, or ISO 8601 (2026-11-22T10:00:00.010)"
        raise LogError(f"{source}: row {k + 1}, column {name}: {what}{more}; {advice}")
    refuse_swapped_dates(raw, found, name, source)
    return found


def absolute_seconds(raw: pd.Series, unit: float) -> np.ndarray:
    """Read a clock's times (N,) [s] with its origin, so that several clocks agree; NaN in blank cells.

    unit [s]: of numbers.
    """
    there = raw.notna().to_numpy() & (raw.astype(str).str.strip() != "").to_numpy()
    found = np.full(len(raw), np.nan)
    cells = raw[there]
    if not len(cells):
        return found
    number = pd.to_numeric(cells, errors="coerce")
    origin = 0.0
    if number.notna().all() and cells.dtype.kind != "M":
        origin = float(number.iloc[0]) * unit
    else:
        first = pd.to_datetime(cells.iloc[0], errors="coerce", utc=True)
        origin = 0.0 if first is pd.NaT else first.timestamp()
    parsed = _parse(cells, unit)
    found[there] = parsed - parsed[0] + origin
    return found


def date_and_time(table: pd.DataFrame) -> tuple[str, str] | None:
    """Find the names of a date column and a time-of-day column."""
    names = {str(c).strip().lower(): str(c) for c in table.columns}
    if "date" not in names or "time" not in names:
        return None
    date, clock = table[names["date"]], table[names["time"]]
    if not len(table) or not CLOCK.fullmatch(str(clock.iloc[0])) or pd.api.types.is_numeric_dtype(date):
        return None
    return names["date"], names["time"]


def _parse(raw: pd.Series, unit_s: float) -> np.ndarray:
    """Times (N,) [s] from the first one, NaN where a cell is not understood."""
    if not len(raw):
        return np.empty(0)
    if raw.dtype == object and isinstance(raw.iloc[0], pd.Timedelta):
        raw = pd.to_timedelta(raw, errors="coerce")
    if raw.dtype.kind == "M" or isinstance(raw.dtype, pd.DatetimeTZDtype):
        return _since_first(pd.to_datetime(raw, utc=True).astype("datetime64[ns, UTC]").astype("int64"), raw.isna())
    if raw.dtype.kind == "m":
        return _since_first(raw.astype("timedelta64[ns]").astype("int64"), raw.isna())
    if raw.dtype.kind in "iu":  # nanoseconds since 1970 have more digits than a float
        first = int(raw.iloc[0])
        start = first * unit_s if abs(first) < 2**53 and abs(first) * unit_s < 1e6 else 0.0
        return np.array([int(x) - first for x in raw.tolist()], float) * unit_s + start
    number = pd.to_numeric(raw, errors="coerce").to_numpy(dtype=float)
    if np.isfinite(number).any() or raw.dtype.kind not in "OTU":
        return number * unit_s
    text = raw.fillna("").astype(str).str.strip()
    filled = np.flatnonzero((text != "").to_numpy())
    for parse in (_with_unit, _clock, _dates) if len(filled) else ():
        found = parse(text)
        if np.isfinite(found[filled[0]]):
            return found
    return np.full(len(raw), np.nan)


def _since_first(ns: pd.Series, missing: pd.Series) -> np.ndarray:
    values = ns.to_numpy()
    return np.where(missing.to_numpy(), np.nan, (values - values[0]) / 1e9)


def _with_unit(text: pd.Series) -> np.ndarray:
    """Cells such as "0.01 sec"."""
    parts = text.str.extract(f"^{NUMBER_AND_UNIT.pattern}$")
    number = pd.to_numeric(parts[0], errors="coerce").to_numpy(dtype=float)
    return number * parts[1].map(SECONDS_BY_WORD).to_numpy(dtype=float)


def _clock(text: pd.Series) -> np.ndarray:
    """Cells such as "10:00:00.010", "10:00:00:010" or "0 days 00:00:00.010000"; "mm:ss.fff" has two parts."""
    if not CLOCK.fullmatch(text[text != ""].iloc[0]):
        return np.full(len(text), np.nan)
    parts = text.str.extract(f"^{CLOCK.pattern}$")
    first, second, third = (pd.to_numeric(parts[k], errors="coerce").to_numpy(dtype=float) for k in (2, 3, 4))
    days = pd.to_numeric(parts[1], errors="coerce").fillna(0).to_numpy(dtype=float)
    fraction = pd.to_numeric("0." + parts[5].fillna("0"), errors="coerce").to_numpy(dtype=float)
    whole = np.where(np.isfinite(third), 3600 * first + 60 * second + third, 60 * first + second)
    sign = np.where(parts[0] == "-", -1.0, 1.0)
    return sign * (days * DAY_S + whole + fraction)


def _dates(text: pd.Series) -> np.ndarray:
    """Times (N,) [s] of dates from the first one, NaN where a cell is none."""
    parsed = _datetimes(text)
    return _since_first(parsed.astype("datetime64[ns, UTC]").astype("int64"), parsed.isna())


def _datetimes(text: pd.Series) -> pd.Series:
    """Dates: ISO 8601 in all its forms, with the day first where `_day_first` says so, or what pandas recognises."""
    text = text.str.replace(r"(:\d{2}),(\d)", r"\1.\2", regex=True)
    best = pd.Series(pd.NaT, text.index, dtype="datetime64[ns, UTC]")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a format that pandas has to guess
        for how in ({"format": "ISO8601"}, {"format": "mixed", "dayfirst": _day_first(text)}):
            parsed = pd.to_datetime(text, errors="coerce", utc=True, **how)
            parsed = parsed.where(parsed.dt.year.between(FIRST_YEAR, LAST_YEAR))
            if parsed.notna().sum() > best.notna().sum():
                best = parsed
            if best.notna().all():
                break
    return best


def _day_first(text: pd.Series) -> bool:
    """Tell if dates such as 3/4/2026 have the day first: one day has no month of its number, or they have points, or
    then all of them are nearer to each other."""
    first, second, separator = _day_and_month(text)
    if not len(first) or (first > MONTHS).any() or (second > MONTHS).any():
        return bool((first > MONTHS).any())
    if separator == ".":
        return True
    return bool(np.ptp(first + DAYS_PER_MONTH * second) < np.ptp(second + DAYS_PER_MONTH * first))


def _day_and_month(text: pd.Series) -> tuple[np.ndarray, np.ndarray, str]:
    """The two numbers (M,) before the year of dates that end with it, and what is between, "" where there is none."""
    if not DAY_MONTH.match(text[text != ""].iloc[0] if (text != "").any() else ""):
        return np.empty(0), np.empty(0), ""
    parts = text.str.extract(DAY_MONTH).dropna()
    return parts[0].to_numpy(dtype=float), parts[2].to_numpy(dtype=float), str(parts[1].iloc[0])


def refuse_swapped_dates(raw: pd.Series, t: np.ndarray, column: str, source: str) -> None:
    """Raise LogError where day and month are swapped in some of the dates behind times t (N,) [s]."""
    is_text = raw.dtype.kind in "OTU"
    far = np.flatnonzero(np.abs(np.diff(t)) >= DAY_S)
    if not len(far) or not (is_text or raw.dtype.kind == "M" or isinstance(raw.dtype, pd.DatetimeTZDtype)):
        return
    advice = "write all dates alike, best as 2026-11-22"
    text = raw.astype(str).str.strip()
    if is_text:
        if pd.to_numeric(text, errors="coerce").notna().any():
            return
        first, second, _ = _day_and_month(text)
        if (first > MONTHS).any() and (second > MONTHS).any():
            a, b = sorted((int(np.argmax(first > MONTHS)), int(np.argmax(second > MONTHS))))
            raise LogError(
                f"{source}: rows {a + 1} and {b + 1}, column {column}: dates with the day first and with the month"
                f" first ({text.iloc[a][:30]}, {text.iloc[b][:30]}); {advice}"
            )
    dates = _datetimes(text)
    for k in far:
        before, after = dates.iloc[k], dates.iloc[k + 1]
        if pd.isna(before) or pd.isna(after):
            continue
        if any(abs((b - a).total_seconds()) < DAY_S for a, b in ((_swapped(before), after), (before, _swapped(after)))):
            raise LogError(
                f"{source}: row {k + 2}, column {column}: the date goes from {before:%Y-%m-%d} to {after:%Y-%m-%d}: are"
                f" day and month swapped in one of them? {advice}"
            )


def _swapped(date: pd.Timestamp) -> pd.Timestamp:
    """A date with day and month swapped, as it is where that is none."""
    return date.replace(month=date.day, day=date.month) if date.day <= MONTHS else date
