"""Excel workbooks: the first sheet that holds a table, or the one that has the wanted columns."""

from __future__ import annotations

import datetime
import itertools
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files import layout
from excite.logs.files.common import (
    MOST_BYTES,
    MOST_CELLS,
    MOST_COLUMNS,
    NOTES,
    OTHER_NAMES,
    UNITS_SAID,
    UNITS_UNKNOWN,
    lacking,
    refuse_huge,
)

BEGIN = 200  # rows in which the header is looked for; chosen
LONGEST = 1_048_576  # rows of a sheet: Excel's own limit
OBJECT_ROOM = 8  # times the room of a number that a cell takes while it is read; measured
NOT_BEFORE = datetime.datetime(1899, 12, 30)  # day 0 of Excel


def read_excel(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the values of a sheet; cells of dates and times as these."""
    try:
        import openpyxl
    except ImportError:
        raise lacking(path, "Excel files need openpyxl", "xlsx") from None
    with zipfile.ZipFile(path) as packed:
        if sum(item.file_size for item in packed.infolist()) > MOST_BYTES:
            raise LogError(f"{path}: unpacks to more than {MOST_BYTES // 10**9} GB; save it as CSV in shorter logs")
    book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    best, most, count = None, -1, len(book.worksheets)
    try:
        for sheet in book.worksheets:
            table = _sheet(path, sheet)
            if table is None:
                continue
            has = len(wanted & {*map(str, table.columns), *table.attrs[OTHER_NAMES]})
            if has > most:
                best, most = table, has
                best.attrs[NOTES] += [f"read from sheet {sheet.title}"] if count > 1 else []
            if has == len(wanted):
                break
    finally:
        book.close()
    if best is None:
        raise LogError(f"{path}: no sheet has a line with the names of columns and numbers below it")
    return best


def _sheet(path: Path, sheet: Any) -> pd.DataFrame | None:
    """Read the table of a sheet, None where there is none."""
    sheet.reset_dimensions()  # what the file says of them may be anything
    lines = sheet.iter_rows(values_only=True)
    begin = list(itertools.islice(lines, BEGIN))
    rows = [["" if cell is None else str(cell) for cell in line[:MOST_COLUMNS]] for line in begin]
    at = layout.search([[*cells[: layout.width(cells)], ""] for cells in rows])
    if at is None:
        return None
    count = layout.width(at.names)
    cells: list[tuple[Any, ...]] = []
    for line in itertools.chain(begin[at.start :], lines):
        cells.append(tuple(line[:count]) + (None,) * (count - len(line)))
        if len(cells) > LONGEST:
            raise LogError(f"{path}: sheet {sheet.title} claims more than {LONGEST} rows; the file is damaged")
        if len(cells) * count > MOST_CELLS // OBJECT_ROOM:
            refuse_huge(path, OBJECT_ROOM * len(cells), count)
    while cells and all(map(_blank, cells[-1])):
        cells.pop()
    names = at.names[:count]
    twice = [name for name, times in Counter(names).items() if name and times > 1]
    if twice:
        raise LogError(f"{path}: sheet {sheet.title}, row {at.header + 1}: column {twice[0]} is there twice, keep one")
    table = pd.DataFrame({name: _column([line[k] for line in cells]) for k, name in enumerate(names) if name})
    table.attrs |= {
        NOTES: layout.left_out([cells if any(map(str.strip, cells)) else [] for cells in rows], at),
        UNITS_UNKNOWN: layout.unknown_units(names),
        UNITS_SAID: layout.bracketed_units(names) | at.units,
        OTHER_NAMES: layout.without_units(names) | at.other,
    }
    return table


def _blank(cell: Any) -> bool:
    return cell is None or (isinstance(cell, str) and not cell.strip())


def _column(cells: list[Any]) -> pd.Series:
    """Cells as numbers, dates or durations where all are; as they are otherwise."""
    kinds = {type(cell) for cell in cells if not _blank(cell)}
    full = not any(map(_blank, cells))
    if kinds <= {int, float, bool}:
        if full and kinds in ({int}, {bool}) and all(abs(cell) < 2**63 for cell in cells):
            return pd.Series(cells)
        return pd.Series([np.nan if _blank(cell) else float(cell) for cell in cells], dtype=float)
    if kinds <= {datetime.datetime, datetime.date}:
        return pd.Series(
            pd.to_datetime(pd.Series([None if _blank(cell) else cell for cell in cells], dtype=object)).dt.as_unit("ns")
        )
    if kinds <= {datetime.time, datetime.timedelta, datetime.datetime}:
        since = [None if _blank(cell) else _since_midnight(cell) for cell in cells]
        return pd.Series(pd.to_timedelta(pd.Series(since, dtype=object)).dt.as_unit("ns"))
    return pd.Series([None if _blank(cell) else cell for cell in cells], dtype=object)


def _since_midnight(cell: Any) -> datetime.timedelta:
    if isinstance(cell, datetime.timedelta):
        return cell
    if isinstance(cell, datetime.datetime):
        return cell - NOT_BEFORE
    return datetime.timedelta(hours=cell.hour, minutes=cell.minute, seconds=cell.second, microseconds=cell.microsecond)
