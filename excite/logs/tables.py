"""Files as tables of columns: CSV as people's programs write it, Parquet, MATLAB and MDF4."""

from __future__ import annotations

import csv
import gzip
import io
import re
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import scipy

from excite.errors import LogError
from excite.model.machine import UNITS

SEPARATORS = ("\t", ";", ",", "|")
ENCODINGS = ("utf-8-sig", "cp1252")  # the second reads any byte: what European loggers write
BLANK = " "  # columns between blanks, as numpy.savetxt and MATLAB's -ascii write them
MAX_METADATA_LINES = 60  # lines above the header
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
    notes: list[str] = []
    lines = _text(path, notes).split("\n")
    head = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith(COMMENTS)), None)
    if head is None:
        raise LogError(f"{path}: the file is empty, there is no header with the names of columns")
    if lines[head].strip().lower().startswith("sep="):
        head += 1
    head = _find_header(lines, head, notes)
    separator = _separator(lines[head])
    if separator == BLANK:
        lines = [",".join(line.replace(",", ".").split()) for line in lines]
        separator = ","
    _drop_cut_row(lines, head, separator, notes)
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
    table = _without_copies(table, header, path, head + 1, notes)
    table.columns = table.columns.astype(str).str.strip()
    if header and header[-1] == "" and table.iloc[:, -1].isna().all():  # a separator at the end of every line
        table = table.iloc[:, :-1].copy()
    unclear: dict[str, str] = {}
    for name in [n for n in table.columns if table[n].dtype.kind not in "biuf"]:
        if comma:
            table[name], unclear[name] = _without_commas(table[name], comma)
        table[name] = _dates(table[name])
    table.attrs |= {"units": units, UNCLEAR: unclear, "notes": notes}
    return table


def _find_header(lines: list[str], first: int, notes: list[str]) -> int:
    """The line (from 0) with the names of the columns; metadata may stand above it, a comment sign in front of it.

    first: the first line that is neither empty nor a comment.
    """
    ahead = range(first, min(first + MAX_METADATA_LINES, len(lines)))
    numbers = next((k for k in ahead if _is_data(lines[k])), None)
    if numbers is None:
        return first
    width = len(lines[numbers].split(_separator(lines[numbers])))
    if width < 2 and _separator(lines[numbers]) != BLANK:
        return first
    found, best = None, None
    for k in range(numbers - 1, -1, -1):
        bare = lines[k].lstrip().lstrip("".join(COMMENTS)).strip()
        blank = _separator(lines[numbers]) == BLANK
        cells = [c.strip() for c in (bare.split() if blank else bare.split(_separator(bare)))]
        if len(cells) != width or any(_numeric(c) for c in cells):
            break
        found = k
        if len(set(cells)) == width and all(cells):
            best = k
    head = best if best is not None else found
    if head is None or (head >= first and not lines[head].lstrip().startswith(COMMENTS)):
        return first if head is None else head
    if lines[head].lstrip().startswith(COMMENTS):
        if any(_is_names(lines[k], width) for k in range(first, numbers)):
            return first  # a header of its own stands below the comments
        notes.append(f"line {head + 1}: the header was taken from a comment")
        lines[head] = lines[head].lstrip().lstrip("".join(COMMENTS)).strip()
    return head


def _is_names(line: str, width: int) -> bool:
    """Tell if a line has as many names as the rows have cells."""
    cells = [c.strip() for c in line.split(_separator(line))]
    return len(cells) == width and not any(_numeric(c) for c in cells) and not line.lstrip().startswith(COMMENTS)


def _is_data(line: str) -> bool:
    """Tell if a line is one of numbers."""
    separator = _separator(line)
    cells = line.split() if separator == BLANK else line.split(separator)
    return bool(cells) and sum(_numeric(c) for c in cells) > len(cells) / 2


def _drop_cut_row(lines: list[str], head: int, separator: str, notes: list[str]) -> None:
    """Leave out a last row that has fewer cells than the header: the logger was stopped in it."""
    last = len(lines) - 1
    while last > head and not lines[last].strip():
        last -= 1
    width = lines[head].count(separator)
    if last > head + 1 and lines[last].count(separator) < width and lines[last - 1].count(separator) >= width:
        notes.append(f"line {last + 1}: the last row is cut short, left out")
        del lines[last:]


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
    if twice and not twice[0]:
        raise LogError(f"{path}: line {k + 1}: column without a name is there twice, keep one")
    return header


def _without_copies(table: pd.DataFrame, header: list[str], path: Path, line: int, notes: list[str]) -> pd.DataFrame:
    """A table without columns that are there twice with the same cells. Raises LogError where the cells differ."""
    for name in dict.fromkeys(n for n in header if n and header.count(n) > 1):
        first, *others = [k for k, n in enumerate(header) if n == name]
        if not all(table.iloc[:, k].equals(table.iloc[:, first]) for k in others):
            raise LogError(f"{path}: line {line}: column {name} is there twice, keep one")
        notes.append(f"column {name} is there {len(others) + 1} times with the same cells, used once")
        keep = [k for k in range(len(header)) if k not in others]
        table, header = table.iloc[:, keep], [header[k] for k in keep]
    return table


def _too_wide(path: Path, lines: list[str], start: int, names: int, separator: str) -> str:
    """Return a line about the first row that has more cells than there are names, "" if none has."""
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


def _text(path: Path, notes: list[str]) -> str:
    """Read a file as text; what was left out is added to the notes. Raises LogError."""
    try:
        raw = path.read_bytes()
    except OSError as err:
        raise LogError(f"{path}: can't be read: {err.strerror}") from None
    if path.suffix.lower() == ".gz":
        try:
            raw = gzip.decompress(raw)
        except (OSError, EOFError, zlib.error) as err:
            raise LogError(f"{path}: not a gzip file that can be read: {err}") from None
    encodings = ("utf-16",) if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else ENCODINGS
    if encodings is ENCODINGS and raw.endswith(b"\x00"):
        whole = raw.rstrip(b"\x00")
        notes.append(f"ends in {len(raw) - len(whole)} zero bytes (the logger lost power?), read up to them")
        raw = whole
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
    """The separator of a line: one of the usual ones, BLANK where words stand between blanks only."""
    counts = {s: header.count(s) for s in SEPARATORS}
    best = max(SEPARATORS, key=lambda s: counts[s])
    if counts[best]:
        return best
    return BLANK if len(header.split()) > 2 else ","


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
        table = pd.read_parquet(path)
    except Exception as err:  # what the parsers of these formats raise on damaged bytes is anything at all
        raise LogError(f"{path}: not a Parquet file: {' '.join(str(err).split())[:120]}") from None
    return table.reset_index() if table.index.name is not None else table


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
    lengths = [len(v) for v in columns.values()]
    usual = max(set(lengths), key=lambda n: (lengths.count(n), n))
    others = [k for k, v in columns.items() if len(v) != usual]
    table = pd.DataFrame({k: v for k, v in columns.items() if len(v) == usual})
    if others:
        table.attrs["notes"] = [f"variables of another length are not used: {', '.join(others)}"]
    return table


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
    ".gz": _csv,
    ".mf4": _mdf,
    ".mdf": _mdf,
}
