"""Files as tables of columns: CSV as people's programs write it, Parquet, MATLAB and MDF4."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import scipy

from excite.errors import LogError
from excite.model.machine import UNITS

SEPARATORS = ("\t", ";", ",", "|")
ENCODINGS = ("utf-8-sig", "cp1252")  # the second reads any byte: what European loggers write
COMMENTS = ("#", "%")
COMMA = re.compile(r"\s*[+-]?(?:\d*|\d{1,3}(?:\.\d{3})+),\d+(?:[eE][+-]?\d+)?\s*")  # perhaps with points: 1.238,5
THOUSANDS = re.compile(r"\s*[+-]?\d{1,3}(?:\.\d{3}){2,}\s*")  # 1.238.500
GROUPED = re.compile(r"\s*[+-]?[1-9]\d{0,2}\.\d{3}\s*")  # 1.238
POINT = re.compile(r"\s*[+-]?(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?\s*")
DATE = re.compile(r"\s*(\d{1,2}\.\d{1,2}\.\d{2,4})[ T]+(\d{1,2}:\d{2}:\d{2})([.,]\d+)?\s*")
NAMELESS = re.compile(r"[+-]?[.,]?\d[\d\s.,:/+eETZ-]*|(?i:[+-]?(?:nan|inf))")  # numbers, dates
ENOUGH = 200_000  # characters by which it is judged whether commas or points are decimal
LONGEST = 500  # characters of a column's name: a line that has more is no header
MDF_TIME = "timestamps"
UNCLEAR = "unclear"  # of a table's attrs: what is said of columns whose numbers may be read in two ways


def read_table(path: str | Path) -> pd.DataFrame:
    """The columns of a .csv (.txt, .tsv), .parquet, .mat or .mf4 file as they are. Raises LogError."""
    path = Path(path)
    if not path.is_file():
        raise LogError(f"{path}: no such file" if not path.is_dir() else f"{path}: is a folder, give a file")
    if path.stat().st_size == 0:
        raise LogError(f"{path}: the file is empty")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise LogError(f"{path}: unknown kind of file {path.suffix!r}, allowed: {', '.join(READERS)}")
    table = reader(path)
    if table.empty:
        raise LogError(f"{path}: no rows of data")
    return table


def _csv(path: Path) -> pd.DataFrame:
    """Any of the usual separators, decimal commas, lines of comment before the header, a line of units below it, which
    are kept by column in attrs["units"]."""
    lines = _text(path).split("\n")
    head = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith(COMMENTS)), None)
    if head is None:
        raise LogError(f"{path}: the file is empty, there is no header with the names of columns")
    if lines[head].strip().lower().startswith("sep="):
        head += 1
    separator = _separator(lines[head])
    header = _header(path, lines, head, separator)
    start = next((k for k in range(head + 1, len(lines)) if lines[k].strip()), len(lines))
    below = _row(path, lines, start, separator) if start < len(lines) else []
    units: dict[str, str] = {}
    if below and not any(_numeric(cell) for cell in below) and _numeric_below(lines, start + 1, separator):
        if not lines[start].lstrip().startswith(COMMENTS):
            units = {name: unit for name, cell in zip(header, below, strict=False) if (unit := cell.strip(" []()"))}
        start += 1
    body = "\n".join([lines[head], *lines[start:]])
    comma = _decimal_comma(body, separator)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                io.StringIO(body),
                sep=separator,
                decimal="," if comma else ".",
                skipinitialspace=True,
                low_memory=False,
                index_col=False,
            )
    except pd.errors.EmptyDataError:
        raise LogError(f"{path}: the file is empty") from None
    except (pd.errors.ParserWarning, pd.errors.ParserError) as err:
        why = _too_wide(path, lines, start, len(header), separator) or " ".join(str(err).split())
        raise LogError(f"{path}: not a table: {why}") from None
    table.columns = table.columns.astype(str).str.strip()
    if header and header[-1] == "" and table.iloc[:, -1].isna().all():  # a separator at the end of every line
        table = table.iloc[:, :-1].copy()
    unclear: dict[str, str] = {}
    for name in [n for n in table.columns if table[n].dtype.kind not in "biuf"]:
        if comma:
            table[name], unclear[name] = _without_commas(table[name], comma)
        table[name] = _dates(table[name])
    table.attrs |= {"units": units, UNCLEAR: unclear}
    return table


def _row(path: Path, lines: list[str], k: int, separator: str) -> list[str]:
    """The cells of a line (from 0)."""
    try:
        return next(csv.reader([lines[k]], delimiter=separator), [])
    except csv.Error:
        raise LogError(
            f"{path}: not a table: line {k + 1} has a cell of more than {csv.field_size_limit()} characters"
        ) from None


def _header(path: Path, lines: list[str], k: int, separator: str) -> list[str]:
    """The names of the columns, in a line (from 0)."""
    header = [name.strip() for name in _row(path, lines, k, separator)]
    longest = max(map(len, header), default=0)
    if longest > LONGEST:
        raise LogError(f"{path}: not a table: line {k + 1} should be the header, it has a name of {longest} characters")
    twice = [name for name in header if header.count(name) > 1]
    counted = not twice and all(name.isdigit() for name in header)  # 0,1,2,...: programs' names for columns without
    names = [name for name in header if name]
    if names and not counted and all(NAMELESS.fullmatch(name) for name in names):
        raise LogError(
            f"{path}: line {k + 1} holds numbers, there is no header: write a line with the names of the columns above"
        )
    if twice:
        raise LogError(f"{path}: line {k + 1}: column {twice[0] or 'without a name'} is there twice, keep one")
    return header


def _too_wide(path: Path, lines: list[str], start: int, names: int, separator: str) -> str:
    """What is said of the first line (from 0) that has more cells than there are names, "" where none has."""
    for k in range(start, len(lines)):
        cells = _row(path, lines, k, separator)
        if len(cells) <= names:
            continue
        line = f"line {k + 1} has more cells than the header has names ({len(cells)}, not {names})"
        if lines[k].lstrip().startswith(COMMENTS):
            return f"{line}; it is a comment, cut it"
        if separator == "," and all(re.fullmatch(r"\s*[+-]?\d+(?:[eE][+-]?\d+)?\s*", cell) for cell in cells):
            return f"{line}: decimal commas, and commas between columns? write decimal points, or semicolons between"
        return line
    return ""


def _decimal_comma(body: str, separator: str) -> str:
    """The first cell with a decimal comma, "" where there is none, or more cells behind it have a point."""
    if separator == "," or "," not in body:
        return ""
    inside = rf'[^{re.escape(separator)}\n"]'
    comma, point = (re.compile(f"(?<!{inside})(?:{p.pattern})(?!{inside})") for p in (COMMA, POINT))
    found = comma.search(body)
    if found is None:
        return ""
    part = body[found.start() : found.start() + ENOUGH]
    return found.group().strip() if len(comma.findall(part)) >= len(point.findall(part)) else ""


def _without_commas(column: pd.Series, comma: str) -> tuple[pd.Series, str]:
    """A column with decimal commas that was left as text, as some cells are not plain numbers: without points between
    thousands, with decimal points. comma: a cell that has one. Behind it what is said of a point that may be either, ""
    where there is none."""
    cells = column.tolist()
    if not any("," in str(cell) for cell in cells):
        pointed = [cell for cell in cells if isinstance(cell, str) and POINT.fullmatch(cell)]
        own = pd.to_numeric(column, errors="coerce")
        if not all(GROUPED.fullmatch(cell) for cell in pointed) and (own.isna() == column.isna()).all():
            return own, ""  # decimal points throughout: thousands don't look like that
    for k, cell in enumerate(cells):
        if isinstance(cell, str) and POINT.fullmatch(cell):
            return column, (
                f"row {k + 1}, column {column.name}: {cell.strip()[:30]!r} has a point, other cells a decimal comma"
                f" ({comma[:30]!r}); write all numbers alike, without marks between thousands"
            )
        if isinstance(cell, str) and (COMMA.fullmatch(cell) or THOUSANDS.fullmatch(cell)):
            cells[k] = cell.replace(".", "").replace(",", ".")
    plain = pd.Series(cells, column.index, object, column.name)
    number = pd.to_numeric(plain, errors="coerce")
    return (number if (number.isna() == plain.isna()).all() else plain), ""


def _dates(column: pd.Series) -> pd.Series:
    """Text as dates where all of it is dates with points, which have the day first; as it is otherwise."""
    first = column.iloc[0] if len(column) else None
    if not (isinstance(first, str) and DATE.fullmatch(first)):
        return column
    parts = column.astype(str).str.extract(DATE)
    day, clock, fraction = (parts[k] for k in range(3))
    for year in ("%Y", "%y"):
        date = pd.to_datetime(day + " " + clock, format=f"%d.%m.{year} %H:%M:%S", errors="coerce")
        if date.notna().all():
            part = pd.to_numeric("0." + fraction.str[1:].fillna("0"))
            return date + pd.to_timedelta(part, unit="s")
    return column


def _text(path: Path) -> str:
    try:
        raw = path.read_bytes()
    except OSError as err:
        raise LogError(f"{path}: can't be read: {err.strerror}") from None
    encodings = ("utf-16",) if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else ENCODINGS
    for encoding in encodings:
        try:
            text = raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\x00" not in text:
            return text.replace("\r\n", "\n").replace("\r", "\n")
        break
    raise LogError(f"{path}: not a text file, is it really CSV?")


def _separator(header: str) -> str:
    counts = {s: header.count(s) for s in SEPARATORS}
    best = max(SEPARATORS, key=lambda s: counts[s])
    return best if counts[best] else ","


def _cells(lines: list[str], start: int, separator: str) -> list[str]:
    return [cell for line in lines[start : start + 20] for cell in line.split(separator)]


def _numeric(cell: str) -> bool:
    if cell.strip(" []()") in UNITS:  # 1/min
        return False
    return bool(COMMA.fullmatch(cell)) or bool(re.match(r"^\s*[+-]?(\d|\.\d|nan\b|inf\b)", cell, re.IGNORECASE))


def _numeric_below(lines: list[str], start: int, separator: str) -> bool:
    return any(_numeric(cell) for cell in _cells(lines, start, separator)[:40])


def _parquet(path: Path) -> pd.DataFrame:
    try:
        return pd.read_parquet(path)
    except Exception as err:  # what the parsers of these formats raise on damaged bytes is anything at all
        raise LogError(f"{path}: not a Parquet file: {' '.join(str(err).split())[:120]}") from None


def _mat(path: Path) -> pd.DataFrame:
    try:
        raw = scipy.io.loadmat(path)
    except Exception as err:
        raise LogError(
            f"{path}: not a MATLAB file that can be read (v5 to v7): {' '.join(str(err).split())[:120]}"
        ) from None
    columns = {
        k: np.ravel(v)
        for k, v in raw.items()
        if not k.startswith("__")
        and isinstance(v, np.ndarray)
        and v.dtype.kind in "fiub"
        and 1 in v.shape
        and v.size > 1
    }
    if not columns:
        raise LogError(f"{path}: holds no columns of numbers")
    lengths = {k: len(v) for k, v in columns.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{k} {n}" for k, n in lengths.items())
        raise LogError(f"{path}: the variables have different lengths ({listed}), they must be one table")
    return pd.DataFrame(columns)


def _mdf(path: Path) -> pd.DataFrame:
    """Every channel at the times of the fastest one, time in `timestamps` [s] from the first sample on."""
    try:
        from asammdf import MDF
    except ImportError:
        raise LogError(f"{path}: MDF files need asammdf: pip install 'excite[mdf]'") from None
    try:
        with MDF(path) as mdf:
            times = set(mdf.masters_db.items())
            counts = {name: len(mdf.get(name, *at[0])) for name, at in mdf.channels_db.items() if not times & set(at)}
            fastest = max(counts, key=lambda name: counts[name])
            table = mdf.to_dataframe(raster=fastest, time_from_zero=True, ignore_value2text_conversions=True)
    except Exception as err:
        raise LogError(f"{path}: not an MDF file that can be read: {' '.join(str(err).split())[:120]}") from None
    table.insert(0, MDF_TIME, table.index.to_numpy(dtype=float))
    return table.reset_index(drop=True)


READERS: dict[str, Callable[[Path], pd.DataFrame]] = {
    ".csv": _csv,
    ".parquet": _parquet,
    ".mat": _mat,
    ".txt": _csv,
    ".tsv": _csv,
    ".mf4": _mdf,
    ".mdf": _mdf,
}
