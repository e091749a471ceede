"""Vectors of several lengths, as containers without tables hold them, made one table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import NOTES, OTHER_NAMES, SHOWN, merged, refuse_huge

TIMES = ("time", "t", "timestamps")  # fields that are the time of their struct or group


def one_table(
    path: Path,
    columns: dict[str, np.ndarray],
    other: dict[str, str],
    wanted: frozenset[str],
    objects: Sequence[str] = (),
) -> pd.DataFrame:
    """Make one table of the columns that are wanted, or else of those of the length that most have.

    other: further names of columns -> the column. objects: what only MATLAB reads. Raises LogError.
    """
    hint = "; save timetables and timeseries as structs, or with writetimetable" if objects else ""
    if not columns:
        raise LogError(f"{path}: holds no columns of numbers{hint}")
    lengths = {name: len(values) for name, values in columns.items()}
    notes = [f"objects of MATLAB are not read{hint}"] if objects else []
    if len(set(lengths.values())) > 1:
        series = _series(columns)
        there = {name.strip().lower(): column for name, column in [*other.items(), *((n, n) for n in columns)]}
        used = {there[w.strip().lower()] for w in wanted if w.strip().lower() in there}
        sizes = {lengths[name] for name in used}
        counts = Counter(lengths.values())
        most = max(counts, key=lambda n: (counts[n], n))
        of_series = {time for time, _ in series} | {name for _, members in series for name in members}
        if series and (len(sizes) > 1 if used else counts[most] < len(columns) / 2) and used <= of_series:
            return _merged(path, columns, series, other, notes)
        if len(sizes) > 1 or (not used and counts[most] < 2):
            listed = ", ".join(f"{k} {n}" for k, n in lengths.items() if k in (used or lengths))
            raise LogError(
                f"{path}: some variables are of another length than others ({listed}), they must be one table"
            )
        length = sizes.pop() if sizes else most
        left = [name for name in columns if lengths[name] != length]
        columns = {name: values for name, values in columns.items() if lengths[name] == length}
        other = {name: column for name, column in other.items() if column in columns}
        more = ", ..." if len(left) > SHOWN else ""
        notes.append(f"variables of another length are not used: {', '.join(left[:SHOWN])}{more}")
    refuse_huge(path, len(next(iter(columns.values()))), len(columns))
    table = pd.DataFrame(columns)
    table.attrs |= {NOTES: notes, OTHER_NAMES: other}
    return table


def _series(columns: Mapping[str, np.ndarray]) -> list[tuple[str, list[str]]]:
    """Times and the columns that have them: vectors of the same struct, as long as its time."""
    found = []
    for time, t in columns.items():
        end = max(time.rfind("."), time.rfind("/")) + 1
        if end and time[end:].lower() in TIMES:
            own = [n for n, v in columns.items() if n != time and n.startswith(time[:end]) and len(v) == len(t)]
            found += [(time, own)] if own else []
    return found


def _merged(
    path: Path,
    columns: Mapping[str, np.ndarray],
    series: list[tuple[str, list[str]]],
    other: dict[str, str],
    notes: list[str],
) -> pd.DataFrame:
    """Put time series of several lengths on all their times."""
    table = merged(path, [(columns[t].astype(float), {n: columns[n] for n in members}) for t, members in series])
    kept = {name: column for name, column in other.items() if column in table.columns}
    table.attrs |= {NOTES: [*table.attrs.get(NOTES, []), *notes], OTHER_NAMES: kept}
    return table
