"""CSV and other tables of text as people's programs write them."""

from __future__ import annotations

import csv
import io
import re
import warnings
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files import common, layout
from excite.logs.files.layout import COMMA, Layout, is_data, is_numeric, is_words
from excite.logs.files.scopes import read_scope

SEPARATORS = ("\t", ";", ",", "|")
BLANKS = " "  # stands for any number of blanks between columns
ENCODINGS = ("utf-8", "cp1252")  # the second reads nearly any byte: what European loggers write
COMMENTS = ("#", "%")
NAMELESS = re.compile(r"[+-]?[.,]?\d[\d\s.,:/+eETZ-]*|(?i:[+-]?(?:nan|inf))")  # numbers, dates
THOUSANDS = re.compile(r"\s*[+-]?\d{1,3}(?:\.\d{3}){2,}\s*")  # 1.238.500
GROUPED = re.compile(r"\s*[+-]?[1-9]\d{0,2}\.\d{3}\s*")  # 1.238
POINT = re.compile(r"\s*[+-]?(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?\s*")
NUMBER = re.compile(r"\s*[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?\s*")
STUMP = re.compile(r"\s*[+-]?(?:\d*[.,]?\d*(?:[eE][+-]?)?)?\s*")  # of a number that breaks off
DATE = re.compile(r"\s*(\d{1,2}\.\d{1,2}\.\d{2,4})[ T]+(\d{1,2}:\d{2}:\d{2})([.,]\d+)?\s*")
DATE_ALONE = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}")
CLOCK_ALONE = re.compile(r"\d{1,2}:\d{2}(:\d{2})?([.,:]\d+)?")
ENOUGH = 200_000  # characters by which it is judged whether commas or points are decimal
LONGEST = 500  # characters of a column's name: a line that has more is no header
UNASKED_BYTES = 50_000_000  # to which a small file may unpack; chosen
MOST_TIMES = 200  # its own size to which a larger one may; tables of numbers do to 3 to 100 times; chosen
HEAD = 1_000_000  # bytes in which the header and the first rows are looked for; chosen
TAIL = 100_000  # bytes in which the last rows are looked at; chosen
SEEN = 100  # lines in which the data must begin; chosen


def read_text(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read a table of text.

    Columns between any of the usual separators or blanks, decimal commas, comments and other things above the header,
    lines of units and of other names below it.
    """
    notes: list[str] = []
    raw = _utf8(path, _without_nuls(_bytes(path, notes), notes))
    exported = read_scope(path, raw, notes)
    if exported is not None:
        return exported
    lines = _head(raw).split("\n")
    found, separator = _layout(path, lines)
    comment = lines[found.header].lstrip().startswith(COMMENTS)
    if comment:
        notes.append(f"line {found.header + 1}: the header was taken from a comment")
    below = range(found.header + 1, found.start)
    cells = {k: _row(path, lines, k, separator) for k in below if lines[k].strip()}
    comments = {k for k, c in cells.items() if lines[k].lstrip().startswith(COMMENTS) and len(c) < len(found.names)}
    rows = [cells[k] if k in cells and k not in comments else [] for k in range(found.start)]
    notes += layout.left_out(rows, found)
    raw = raw[: _whole_rows(path, raw, found, separator, notes)]
    raw = _without_repeated_header(raw, lines, found, notes)
    twice = [name for name, times in Counter(found.names).items() if times > 1]
    names: list[str] | None = None
    if comment or twice or separator == BLANKS:
        names = common.numbered(found.names)
        body = raw[_offset(raw, found.start) :]
        if separator == BLANKS and _has_date_and_clock(body, len(names)):
            body = re.sub(rb"(?m)^([ \t]*\S+)[ \t]+", rb"\1T", body)
    elif found.start == found.header + 1:
        body = raw[_offset(raw, found.header) :]
    else:
        body = lines[found.header].encode() + b"\n" + raw[_offset(raw, found.start) :]
    comma = _decimal_comma(body, separator)
    try:
        table = _parsed(body, separator, comma, names)
    except pd.errors.EmptyDataError:
        raise LogError(f"{path}: {'no rows of data' if names else 'the file is empty'}") from None
    except (pd.errors.ParserWarning, pd.errors.ParserError) as err:
        every = raw.decode(errors="replace").split("\n")
        why = _too_wide(path, every, found.start, len(found.names), separator) or " ".join(str(err).split())
        raise LogError(f"{path}: not a table: {why}") from None
    table.columns = table.columns.astype(str).str.strip()
    if separator == BLANKS:
        _refuse_blank_cells(path, table, body)
    unnamed = [k for k, name in enumerate(found.names) if not name and table.iloc[:, k].isna().all()]
    if unnamed:  # a separator at the end of each line
        table = table.drop(columns=table.columns[unnamed])
    for name in filter(None, twice):
        same = [n for n, own in zip(common.numbered(found.names), found.names, strict=True) if own == name]
        if all(table[same[0]].equals(table[n]) for n in same[1:]):
            notes.append(f"column {name} is there {len(same)} times with equal cells; one is kept")
            table = table.drop(columns=same[1:])
        else:
            notes += common.name_the_same([n for n in found.names if n == name], f"line {found.header + 1}")
    unclear: dict[str, str] = {}
    for name in [n for n in table.columns if table[n].dtype.kind not in "biuf"]:
        if comma:
            table[name], unclear[name] = _without_commas(table[name], comma)
        table[name] = _dates(table[name])
    table = common.vectors_apart(table, bool(comma))
    other = layout.without_units(found.names) | found.other
    table.attrs |= {
        common.UNITS_UNKNOWN: layout.unknown_units(found.names),
        common.UNITS_SAID: layout.bracketed_units(found.names) | found.units,
        common.UNCLEAR: unclear,
        common.OTHER_NAMES: other,
        common.NOTES: notes,
    }
    return table


def _parsed(body: bytes, separator: str, comma: str, names: list[str] | None) -> pd.DataFrame:
    """Read lines of a header (without names) and rows as pandas does."""
    apart = b"" if separator == BLANKS else separator.encode()
    blanks = any(sign in body for sign in (apart + b" ", apart + b"\t", b"\n ", b"\n\t"))  # 20 % slower to skip
    for at_once in (False, True):  # by pieces takes half the time, but not where a column has words and numbers
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", pd.errors.ParserWarning)
                warnings.simplefilter("error", pd.errors.DtypeWarning)
                return pd.read_csv(
                    io.BytesIO(body),
                    sep=r"\s+" if separator == BLANKS else separator,
                    decimal="," if comma else ".",
                    header=0 if names is None else None,
                    names=names,
                    skipinitialspace=blanks or body[:1].isspace(),
                    low_memory=not at_once,
                    index_col=False,
                )
        except pd.errors.DtypeWarning:
            continue
    raise pd.errors.ParserError("columns of words and numbers")


def _bytes(path: Path, notes: list[str]) -> bytes:
    """The file's bytes, unpacked."""
    try:
        return _unpacked(path, notes) if path.suffix.lower() == ".gz" else path.read_bytes()
    except OSError as err:
        raise LogError(f"{path}: can't be read: {err.strerror}") from None


def _unpacked(path: Path, notes: list[str]) -> bytes:
    """The bytes of a .gz file, up to where it breaks off."""
    parts: list[bytes] = []
    size = 0
    unpack = zlib.decompressobj(31)
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            while piece:
                try:
                    part = unpack.decompress(piece, 1 << 24)
                except zlib.error as err:
                    raise LogError(f"{path}: not a gzip file that can be read: {err}") from None
                parts.append(part)
                size += len(part)
                if size > max(UNASKED_BYTES, min(MOST_TIMES * path.stat().st_size, common.MOST_BYTES)):
                    raise LogError(f"{path}: unpacks to more than {size // 10**6} MB; cut it into shorter logs")
                piece = unpack.unconsumed_tail
                if unpack.eof:
                    piece = unpack.unused_data.lstrip(b"\0")
                    unpack = zlib.decompressobj(31) if piece else unpack
    if not unpack.eof:
        notes.append("the compressed file breaks off; read up to there")
    if not size:
        raise LogError(f"{path}: the file is empty")
    return b"".join(parts)


def _without_nuls(raw: bytes, notes: list[str]) -> bytes:
    """Bytes up to the zeros that a logger leaves when it loses power."""
    kept = raw.rstrip(b"\0")
    if len(kept) == len(raw) or raw[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in kept or not kept:
        return raw
    line = kept.count(b"\n") + (not kept.endswith(b"\n"))
    count = len(raw) - len(kept)
    notes.append(f"ends in {count} zero bytes after line {line} (the logger lost power?); read up to them")
    return kept


def _utf8(path: Path, raw: bytes) -> bytes:
    """Text as UTF-8 without a byte-order mark, lines between line feeds. Raises LogError."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            raw = raw.decode("utf-16").encode()
        except UnicodeError:
            raise LogError(f"{path}: not a text file, is it really CSV?") from None
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if not raw.isascii():
        for encoding in ENCODINGS:
            try:
                raw = raw.decode(encoding).encode()
                break
            except UnicodeDecodeError:
                continue
        else:
            raise LogError(f"{path}: not a text file, is it really CSV?")
    at = raw.find(b"\0")
    if at >= 0:
        line = raw.count(b"\n", 0, at) + 1
        if line > 2 and not any(byte < 32 and byte not in b"\t\n\r\f" for byte in raw[: min(at, ENOUGH)]):
            raise LogError(f"{path}: line {line}: holds zero bytes (the logger lost power?); cut that line")
        raise LogError(f"{path}: not a text file, is it really CSV?")
    return raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in raw else raw


def _head(raw: bytes) -> str:
    """Whole lines at the beginning."""
    end = raw.rfind(b"\n", 0, HEAD) if len(raw) > HEAD else -1
    return raw[: end if end >= 0 else HEAD].decode(errors="replace")


def _offset(raw: bytes, line: int) -> int:
    """Where a line (from 0) begins."""
    at = 0
    for _ in range(line):
        at = raw.find(b"\n", at) + 1
        if at == 0:
            return len(raw)
    return at


def _layout(path: Path, lines: list[str]) -> tuple[Layout, str]:
    """Find where the table is, and what is between its columns. Raises LogError."""
    head = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith(COMMENTS)), None)
    if head is not None and lines[head].strip().lower().startswith("sep="):
        head = head + 1 if head + 1 < len(lines) else None
    if head is None:
        raise LogError(f"{path}: the file is empty, there is no header with the names of columns")
    separator = BLANKS if _blanks_between(lines, head) else _separator(lines[head])
    header = [name.strip() for name in _row(path, lines, head, separator)]
    if len(header) > common.MOST_COLUMNS:
        raise LogError(f"{path}: not a table: line {head + 1} has {len(header)} cells, more than {common.MOST_COLUMNS}")
    below = [k for k in range(head + 1, min(len(lines), head + 1 + SEEN)) if lines[k].strip()]
    rows = {k: _row(path, lines, k, separator) for k in below}
    plain = [rows[k] for k in below if not lines[k].lstrip().startswith(COMMENTS)]
    fault = _no_header(path, header, head)
    if fault or len(set(header)) < len(header) or not _follows(header, plain):
        found = _searched(lines)
        if found is not None:
            return found
    if fault:
        raise LogError(fault)
    start, words = (below[0] if below else len(lines)), []
    for n, k in enumerate(below):
        again = [cell.strip() for cell in rows[k]] == header
        if (
            any(map(is_numeric, rows[k]))
            or again
            or not any(is_numeric(c) for j in below[n + 1 :] for c in rows[j][:40])
        ):
            break
        words.append(k)
        start = below[n + 1]
    told = [rows[k] for k in words if not lines[k].lstrip().startswith(COMMENTS)]
    return Layout(head, start, header, *layout.beside_header(header, told)), separator


def _follows(header: list[str], below: list[list[str]]) -> bool:
    """Tell whether what is below a header is its table: lines of words, then data that are no wider."""
    data = next((k for k, cells in enumerate(below) if is_data(cells)), None)
    if data is None:
        return True
    return all(is_words(cells) for cells in below[:data]) and layout.width(below[data]) <= len(header)


def _searched(lines: list[str]) -> tuple[Layout, str] | None:
    """Find the table by its data, with the separator that makes most columns."""
    lines = lines[: 2 * SEEN]
    comments = {k for k, line in enumerate(lines) if line.lstrip().startswith(COMMENTS)}
    plain = [line.lstrip().lstrip("#% ") if k in comments else line for k, line in enumerate(lines)]
    best: tuple[Layout, str] | None = None
    for separator in (*SEPARATORS, BLANKS):
        try:
            rows = [_split(line, separator) for line in plain]
        except csv.Error:
            continue
        if max(map(len, rows)) > common.MOST_COLUMNS:
            continue
        found = layout.search(rows, comments)
        if found is None or len(found.names) < 2 or max(map(len, found.names)) > LONGEST:
            continue
        if best is None or (len(found.names) > len(best[0].names) and separator != BLANKS):
            best = found, separator
    return best


def _blanks_between(lines: list[str], head: int) -> bool:
    """Tell whether blanks are between the columns: rows have as many cells as the header, and nothing else is."""
    if any(s in lines[head] for s in SEPARATORS) or len(lines[head]) > ENOUGH:
        return False
    names = lines[head].split()
    below = [line for line in lines[head + 1 : head + 20] if line.strip() and not line.lstrip().startswith(COMMENTS)]
    rows = [cells for line in below if is_data(cells := line.split())]
    if len(names) < 2 or not rows or any(s in line for s in ("\t", ";", "|") for line in below):
        return False
    wide = len(rows[0])
    return wide == len(_split(lines[head], BLANKS)) or (wide == len(names) + 1 and _are_date_and_clock(rows[0]))


def _are_date_and_clock(cells: list[str]) -> bool:
    return len(cells) > 1 and bool(DATE_ALONE.fullmatch(cells[0])) and bool(CLOCK_ALONE.fullmatch(cells[1]))


def _has_date_and_clock(body: bytes, names: int) -> bool:
    """Tell whether rows between blanks have a cell more than there are names, as a date and a time are two."""
    cells = body[: body.find(b"\n")].decode(errors="replace").split()
    return len(cells) == names + 1 and _are_date_and_clock(cells)


def _split(line: str, separator: str) -> list[str]:
    """The cells of a line. Raises csv.Error."""
    if separator == BLANKS:
        line = " ".join(line.split())
    return next(csv.reader([line], delimiter=separator), [])


def _row(path: Path, lines: list[str], k: int, separator: str) -> list[str]:
    """The cells of a line (from 0)."""
    try:
        return _split(lines[k], separator)
    except csv.Error:
        raise LogError(
            f"{path}: not a table: line {k + 1} has a cell of more than {csv.field_size_limit()} characters"
        ) from None


def _no_header(path: Path, header: list[str], k: int) -> str:
    """Say why a line (from 0) can't be the header, "" where it can."""
    longest = max(map(len, header), default=0)
    if longest > LONGEST:
        return f"{path}: not a table: line {k + 1} should be the header, it has a name of {longest} characters"
    counted = len(set(header)) == len(header) and all(name.isdigit() for name in header)  # 0,1,2,...: made by programs
    names = [name for name in header if name]
    if names and not counted and all(NAMELESS.fullmatch(name) for name in names):
        return (
            f"{path}: line {k + 1} holds numbers, there is no header: write a line with the names of the columns above"
        )
    return ""


def _without_repeated_header(raw: bytes, lines: list[str], found: Layout, notes: list[str]) -> bytes:
    """Leave out header lines, with what stands between them and the rows, that come again further down."""
    between = [line for line in lines[found.header + 1 : found.start] if line.strip()]
    begin = _offset(raw, found.start)
    header = lines[found.header].rstrip(" \t").encode()
    if not is_words(found.names) or raw.find(b"\n" + header, max(begin - 1, 0)) < 0:
        return raw
    again = rb"(?m)^" + re.escape(header) + rb"[ \t]*(?:\n|\Z)"
    again += b"".join(b"(?:" + re.escape(line.encode()) + rb"(?:\n|\Z))?" for line in between)
    body, times = re.subn(again, b"", raw[begin:])
    if times:
        notes.append(f"the header comes again {times} times among the rows; left out")
    return raw[:begin] + body


def _whole_rows(path: Path, raw: bytes, found: Layout, separator: str, notes: list[str]) -> int:
    """Bytes up to the end of the last row that is whole; a row that breaks off is noted."""
    tail = raw[max(len(raw) - TAIL, _offset(raw, found.start)) :]
    text = tail.rstrip(b"\n\t ") if separator != "\t" else tail.rstrip(b"\n ")
    at = text.rfind(b"\n")
    last, before = text[at + 1 :], text[: max(at, 0)].rstrip(b"\n ").rpartition(b"\n")[2]
    if at < 0 or not before or b'"' in last + before or last.lstrip().startswith(tuple(c.encode() for c in COMMENTS)):
        return len(raw)
    short, whole = (_row(path, [line.decode(errors="replace")], 0, separator) for line in (last, before))
    if not is_data(whole) or len(whole) < len(found.names):
        return len(raw)
    cut = len(short) < len(whole)
    if len(short) == len(whole) and not tail.endswith(b"\n"):
        cut = bool(STUMP.fullmatch(short[-1]) and NUMBER.fullmatch(whole[-1]) and not NUMBER.fullmatch(short[-1]))
    if not cut:
        return len(raw)
    end = len(raw) - len(tail) + at + 1
    row = raw.count(b"\n", 0, end) + 1
    notes.append(f"line {row} is cut short ({len(short)} of {len(whole)} cells); it is left out")
    return end


def _refuse_blank_cells(path: Path, table: pd.DataFrame, body: bytes) -> None:
    """Raises LogError where a row between blanks has fewer cells than names: nobody knows which is missing."""
    if not len(table) or not table.iloc[:, -1].isna().any():
        return
    rows = [line for line in body.decode(errors="replace").split("\n") if line.strip()]
    for k in np.flatnonzero(table.iloc[:, -1].isna()):
        count = len(rows[k].split()) if k < len(rows) else table.shape[1]
        if count < table.shape[1]:
            raise LogError(
                f"{path}: row {k + 1}: has {count} cells of {table.shape[1]}; between blanks a cell can't be left"
                " empty: write nan there, or commas between the columns"
            )


def _too_wide(path: Path, lines: list[str], start: int, names: int, separator: str) -> str:
    """Describe the first line (from 0) that has more cells than there are names, "" where none has."""
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


def _decimal_comma(raw: bytes, separator: str) -> str:
    """The first cell with a decimal comma, "" where there is none, or more cells behind it have a point."""
    if separator == "," or b"," not in raw:
        return ""
    body = raw.decode(errors="replace")
    inside = r'[^\s"]' if separator == BLANKS else rf'[^{re.escape(separator)}\n"]'
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


def _separator(header: str) -> str:
    counts = {s: header.count(s) for s in SEPARATORS}
    best = max(SEPARATORS, key=lambda s: counts[s])
    return best if counts[best] else ","
