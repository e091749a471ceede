"""Excel workbooks: the first sheet that holds a table, or the one that has the wanted columns."""

from __future__ import annotations

import contextlib
import datetime
import itertools
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files import common, layout

BEGIN = 200  # rows in which the header is looked for; chosen
LONGEST = 1_048_576  # rows of a sheet: Excel's own limit
# Parts that take ten times as long as cells.
AROUND = (".rels", "workbook.xml", "styles.xml", "Types].xml", "core.xml", "custom.xml")
UNASKED_BYTES = 20_000_000  # to which a small workbook may unpack, in some ten seconds; chosen
MOST_TIMES = 60  # its own size to which a larger one may; tables of numbers do to 5 to 30 times; chosen
BLOCK_CELLS = 500_000  # cells that are read before they become numbers
NOT_BEFORE = datetime.datetime(1899, 12, 30)  # day 0 of Excel


def read_excel(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the values of a sheet; cells of dates and times as these."""
    import openpyxl

    with zipfile.ZipFile(path) as packed:
        parts, small = packed.infolist(), UNASKED_BYTES // 10
        unpacked = sum(part.file_size for part in parts)
        slow = sum(part.file_size for part in parts if part.filename.endswith(AROUND)) > small
        slow |= any(part.file_size > max(small, MOST_TIMES * part.compress_size) for part in parts)
        books = [part for part in parts if part.filename.endswith("workbook.xml") and not slow]
        slow |= any(packed.read(part).count(b"sheetId=") > 500 for part in books)
    if slow or unpacked > max(UNASKED_BYTES, min(MOST_TIMES * path.stat().st_size, common.MOST_BYTES)):
        size = f"unpacks to {unpacked // 10**6} MB, most of it repeats, or more than 500 sheets"
        raise LogError(f"{path}: {size}, more than is read; save it as CSV in shorter logs")
    best, most = None, -1
    with contextlib.closing(openpyxl.load_workbook(path, read_only=True, data_only=True, keep_links=False)) as book:
        sheets = {sheet._worksheet_path: sheet for sheet in book.worksheets}  # some may share a part
        for sheet in sheets.values():
            if (table := _sheet(path, sheet, unpacked)) is None:
                continue
            has = len(wanted & {*map(str, table.columns), *table.attrs[common.OTHER_NAMES]})
            if has > most:
                best, most = table, has
                best.attrs[common.NOTES] += [f"read from sheet {sheet.title}"] if len(sheets) > 1 else []
            if has == len(wanted):
                break
    if best is None:
        raise LogError(f"{path}: no sheet has a line with the names of columns and numbers below it")
    return best


def _sheet(path: Path, sheet: Any, unpacked: int) -> pd.DataFrame | None:
    """Read the table of a sheet of a workbook of so many unpacked bytes, None where there is none."""
    sheet.reset_dimensions()  # what the file says of them may be anything
    lines = sheet.iter_rows(values_only=True)
    begin = list(itertools.islice(lines, BEGIN))
    rows = [["" if cell is None else str(cell) for cell in line[: common.MOST_COLUMNS]] for line in begin]
    at = layout.search([[*cells[: layout.width(cells)], ""] for cells in rows])
    if at is None:
        return None
    count = layout.width(at.names)
    if any(cell is not None for cell in begin[at.header][common.MOST_COLUMNS :]):
        raise LogError(f"{path}: sheet {sheet.title}, row {at.header + 1} has more than {common.MOST_COLUMNS} columns")
    blocks: list[list[pd.Series]] = []
    rows_read, held, cells = 0, 0, list[tuple[Any, ...]]()
    for line in itertools.chain(sheet.iter_rows(min_row=at.start + 1, max_col=count, values_only=True), [None]):
        if line is not None:
            cells.append(line)
            rows_read += 1
            held += count - line.count(None)
            common.refuse_huge(path, rows_read, count, unpacked)
        if cells and (line is None or held > BLOCK_CELLS):
            blocks.append([_column([row[k] for row in cells]) for k in range(count)])
            held, cells = 0, []
        if rows_read > LONGEST:
            raise LogError(f"{path}: sheet {sheet.title} claims more than {LONGEST} rows; the file is damaged")
    columns = [_joined([block[k] for block in blocks]) for k in range(count)]
    last = max((int(np.flatnonzero(c.notna())[-1]) for c in columns if c.notna().any()), default=-1)
    columns = [c.iloc[: last + 1] for c in columns]
    names = at.names[:count]
    called = common.numbered(names)
    table = pd.DataFrame({called[k]: columns[k] for k, name in enumerate(names) if name})
    table = common.vectors_apart(table)
    table.attrs |= {
        common.NOTES: common.name_the_same(names, f"sheet {sheet.title}, row {at.header + 1}")
        + layout.left_out([cells if any(map(str.strip, cells)) else [] for cells in rows], at),
        common.UNITS_UNKNOWN: layout.unknown_units(names),
        common.UNITS_SAID: layout.bracketed_units(names) | at.units,
        common.OTHER_NAMES: layout.without_units(names) | at.other,
    }
    return table


def _joined(parts: list[pd.Series]) -> pd.Series:
    """Put the blocks of a column one after the other: numbers, dates or durations where all are, else cells."""
    types = {p.dtype for p in parts if p.notna().any()}
    if {t.kind for t in types} <= set("fiub"):
        parts = [p.astype(float) for p in parts] if len({p.dtype for p in parts}) > 1 else parts
    elif len(types) == 1:
        parts = [p if p.notna().any() else pd.Series(index=p.index, dtype=next(iter(types))) for p in parts]
    else:
        parts = [p.astype(object) for p in parts]
    return pd.concat(parts, ignore_index=True) if parts else pd.Series(dtype=float)


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
        days = pd.Series([None if _blank(cell) else cell for cell in cells], dtype=object)
        return pd.Series(pd.to_datetime(days).dt.as_unit("ns"))
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
