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

SEPARATORS = ("\t", ";", ",", "|")
ENCODINGS = ("utf-8-sig", "cp1252")  # the second reads any byte: what European loggers write
COMMA = re.compile(r"^\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*$")
MDF_TIME = "timestamps"


class LogError(ValueError):
    """A log or profile that can't be used: one line with file, place, what is wrong and what to do."""


def read(path: str | Path) -> pd.DataFrame:
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
    """Any of the usual separators, decimal commas, lines of comment before the header, a line of units below it."""
    text = _text(path)
    lines = text.split("\n")
    head = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith(("#", "%"))), None)
    if head is None:
        raise LogError(f"{path}: the file is empty, there is no header with the names of columns")
    if lines[head].strip().lower().startswith("sep="):
        head += 1
    separator = _separator(lines[head])
    header = [name.strip() for name in next(csv.reader([lines[head]], delimiter=separator))]
    twice = [name for name in header if header.count(name) > 1]
    if twice:
        raise LogError(f"{path}: line {head + 1}: column {twice[0]} is there twice, keep one")
    first = next((line for line in lines[head + 1 :] if line.strip()), "")
    cells = next(csv.reader([first], delimiter=separator), [])
    skip = int(bool(cells) and not any(_numeric(cell) for cell in cells) and _numeric_below(lines, head + 2, separator))
    commas = separator != "," and any(COMMA.match(c) for c in _cells(lines, head + 1 + skip, separator))
    body = "\n".join([lines[head], *lines[head + 1 + skip :]])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                io.StringIO(body),
                sep=separator,
                decimal="," if commas else ".",
                skipinitialspace=True,
                low_memory=False,
                index_col=False,
            )
    except pd.errors.EmptyDataError:
        raise LogError(f"{path}: the file is empty") from None
    except pd.errors.ParserWarning:
        raise LogError(f"{path}: not a table: lines have more cells than the header has names") from None
    except pd.errors.ParserError as err:
        raise LogError(f"{path}: not a table: {' '.join(str(err).split())}") from None
    table.columns = table.columns.astype(str).str.strip()
    if header and header[-1] == "" and table.iloc[:, -1].isna().all():  # a separator at the end of every line
        table = table.iloc[:, :-1]
    return table


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
    return bool(COMMA.match(cell)) or bool(re.match(r"^\s*[+-]?(\d|\.\d|nan\b|inf\b)", cell, re.IGNORECASE))


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
