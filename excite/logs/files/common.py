"""What readers of all formats share: limits of memory, errors in one line, channels at times of their own."""

from __future__ import annotations

import gc
import itertools
import logging
import math
import re
import sys
import warnings
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.formats import BAG_FOLDER
from excite.text import count, format_number

Reader = Callable[[Path, frozenset[str]], pd.DataFrame]  # of a file, and names of the columns that are wanted

TIMESTAMPS = "timestamps"  # column of time [s] from the first sample on, of formats that name none
NOTES = "notes"  # of a table's attrs: what reading it left out or took for what
UNITS_SAID = "units"  # of a table's attrs: units that the file gives, by column
UNITS_UNKNOWN = "units_unknown"  # of a table's attrs: what else the file gives as a unit in brackets, by column
OTHER_NAMES = "other_names"  # of a table's attrs: further names of columns -> the column
UNCLEAR = "unclear"  # of a table's attrs: what is said of columns whose numbers may be read in two ways
LATE_S = 1.0  # [s] by which a message may be late; a clock that goes back further begins anew; chosen
MOST_CELLS = 250_000_000  # numbers of a table, 2 GB: an hour at 1 kHz of 70 columns; chosen
UNASKED_CELLS = 20_000_000  # numbers, 160 MB, that a small file may unpack to; chosen
MOST_COLUMNS = 10_000  # of a table of cells; chosen
MOST_BYTES = 2_000_000_000  # of unpacked text; chosen
MOST_PACKED = 1_100  # times that a packed block can unpack to; zlib's most is 1032
MOST_ELEMENTS = 64  # of an array in a message or a row that become columns of their own: no picture; chosen
SHOWN = 3  # names, rows or places that a line lists of many
VECTOR = re.compile(r"\s*(?:array)?\(?\s*[\[({][-+\d.eE,;\s]*[\])}]\s*\)?\s*")  # [0.1, 0.2] or (0.1 0.2)
NUMBERS = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
CHECKED_ROWS = 1000  # rows after which their number is looked at again
WORDS = 120  # characters of a library's message that are shown


def guarded(reader: Reader, kind: str, extra: str) -> Reader:
    """Make a reader whose library's errors, whatever they are, become one line of LogError.

    kind: "an MDF file". extra: that brings the library.
    """

    def read(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
        with quiet():
            try:
                return reader(path, wanted)
            except LogError:
                raise
            except ModuleNotFoundError as err:
                fault = f"{kind} needs {err.name}: pip install 'excite[{extra}]'"
            except MemoryError:
                fault = "needs more memory than there is; is the file damaged?"
            except PermissionError as err:
                fault = f"can't be read: {err.strerror}"
            except Exception as err:  # what the parsers of these formats raise on damaged bytes is anything at all
                fault = f"not {kind} that can be read: {said(err)}"
            gc.collect()  # objects of asammdf that failed complain when they are freed
        raise LogError(f"{path}: {fault}")

    return read


def said(err: BaseException) -> str:
    """An error's message in one short line."""
    line = re.sub(r"[^\x20-\x7e\xa0-\uffff]+", " ", " ".join(str(err).split()))[:WORDS].strip()
    return line or type(err).__name__


@contextmanager
def quiet() -> Iterator[None]:
    """Keep what libraries print, log and warn of from the terminal."""
    before, hook = logging.root.manager.disable, sys.unraisablehook
    sys.unraisablehook = lambda _: None
    logging.disable(logging.CRITICAL)
    try:
        with (
            warnings.catch_warnings(),
            redirect_stdout(StringIO()),
            redirect_stderr(StringIO()),
            np.errstate(all="ignore"),
        ):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
        sys.unraisablehook = hook


def refuse_huge(path: Path, rows: int, columns: int, unpacked: int | None = None) -> None:
    """Raises LogError where a file claims more than fits into memory, or far more than its bytes can hold.

    unpacked: bytes that these are, where the file says so.
    """
    cells = rows * max(columns, 1)
    if cells > MOST_CELLS or (cells > UNASKED_CELLS and 8 * cells > (unpacked or MOST_PACKED * _size(path))):
        raise LogError(
            f"{path}: claims {count(rows, 'row')} of {count(columns, 'column')}, more numbers than its bytes hold, or"
            f" than the {MOST_CELLS} that are read; is the file damaged? otherwise cut it into shorter logs"
        )


def _size(path: Path) -> int:
    """Return the bytes of a file; of a bag's folder, or the file that describes it, those of all in it."""
    folder = path if path.is_dir() else path.parent if path.name == BAG_FOLDER else None
    return path.stat().st_size if folder is None else sum(p.stat().st_size for p in folder.iterdir() if p.is_file())


def refuse_swollen(path: Path, claimed: int) -> None:
    """Raises LogError where a file claims more bytes than its own can unpack to."""
    if claimed > MOST_PACKED * path.stat().st_size:
        raise LogError(f"{path}: claims {claimed} bytes of data, far more than the file can hold; it is damaged")


def columns_of_array(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns (N,) by name of a channel's samples (N, ...): fields as name.field, elements as name[0], name[1]."""
    if values.dtype.names:
        found: dict[str, np.ndarray] = {}
        for field in values.dtype.names:
            found |= columns_of_array(f"{name}.{field}", values[field])
        return found
    if values.dtype.kind not in "fiub":
        return {}
    if values.ndim == 1:
        return {name: values}
    if values.ndim == 2 and values.shape[1] <= MOST_ELEMENTS:
        return {f"{name}[{k}]": values[:, k] for k in range(values.shape[1])}
    return {}


def merged(path: Path, groups: Sequence[tuple[np.ndarray, Mapping[str, np.ndarray]]]) -> pd.DataFrame:
    """Put channels of groups with times (N_g,) [s] of their own on all times: NaN where a channel has no sample.

    Groups with equal times are one. Samples of a channel that share their time keep a row each.
    """
    joined: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
    for t, columns in groups:
        same = next((c for at, c in joined if len(at) == len(t) and np.array_equal(at, t)), None)
        if same is None:
            joined.append((t, dict(columns)))
        else:
            same.update(columns)
    if len(joined) == 1:
        t, columns = joined[0]
        return pd.DataFrame({TIMESTAMPS: t, **columns})
    notes, nths = [], []
    for k, (t, columns) in enumerate(joined):
        if (np.diff(t) < 0).any():
            last = int(np.argmin(np.diff(t)))
            if (back := t[last] - t[last + 1]) > LATE_S:
                raise LogError(
                    f"{path}: the times of {next(iter(columns), 'a group')} go back by {format_number(back, 4)} s"
                    f" after sample {last + 1}: its clock begins anew there; cut the file into logs of their own"
                )
            notes.append(f"the times of {next(iter(columns), 'a group')} go back, its samples were put in order")
            order = np.argsort(t, kind="stable")
            joined[k] = t[order], {name: values[order] for name, values in columns.items()}
        t = joined[k][0]
        nths.append(np.arange(len(t)) - np.searchsorted(t, t, side="left"))  # 1 for the second sample of one time
    every, nth = np.concatenate([t for t, _ in joined]), np.concatenate(nths)
    order = np.lexsort((nth, every))
    new = np.append(True, (np.diff(every[order]) != 0) | (np.diff(nth[order]) != 0))
    row = np.empty(len(every), dtype=np.int64)
    row[order] = np.cumsum(new) - 1
    count = int(new.sum())
    refuse_huge(path, count, 1 + sum(len(columns) for _, columns in joined))
    table: dict[str, np.ndarray] = {TIMESTAMPS: every[order][new]}
    begin = 0
    for t, columns in joined:
        at = row[begin : begin + len(t)]
        begin += len(t)
        for name, values in columns.items():
            table[name] = values
            if len(at) < count:
                table[name] = np.full(count, np.nan)
                table[name][at] = values
    frame = pd.DataFrame(table)
    frame.attrs[NOTES] = notes
    return frame


class Rows:
    """Rows of numbers by name, of which each may have some only, kept as columns: eight bytes a number."""

    def __init__(self, path: Path) -> None:
        self.path, self.count = path, 0
        self.columns: dict[str, array[float]] = {}

    def add(self, row: Mapping[str, float]) -> None:
        """Add a row. Raises LogError where they are more than fit into memory."""
        for name, value in row.items():
            column = self.columns.setdefault(name, array("d"))
            if len(column) < self.count:
                column.extend(itertools.repeat(math.nan, self.count - len(column)))
            column.append(value)
        self.count += 1
        if not self.count % CHECKED_ROWS:
            refuse_huge(self.path, self.count, len(self.columns))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the columns (N,), NaN in rows without a number."""
        refuse_huge(self.path, self.count, len(self.columns))
        for column in self.columns.values():
            column.extend(itertools.repeat(math.nan, self.count - len(column)))
        return {name: np.array(column) for name, column in self.columns.items()}


def numbered(names: Sequence[str]) -> list[str]:
    """Return names that differ: one that is there again gets a number, .1 for the second."""
    made: dict[str, None] = {}
    last: Counter[str] = Counter()
    for k, name in enumerate(names):
        own = new = name or f"Unnamed: {k}"
        while new in made:
            last[own] += 1
            new = f"{own}.{last[own]}"
        made[new] = None
    return list(made)


def name_the_same(names: Sequence[str], where: str) -> list[str]:
    """Say which names of columns are there several times, and how `numbered` calls these."""
    made, notes = numbered(names), list[str]()
    for name, times in Counter(names).items():
        if name and times > 1:
            called = [own for own, n in zip(made, names, strict=True) if n == name]
            notes.append(f"{where}: column {name} is there {times} times; by position: {', '.join(called[:SHOWN])}")
    return notes


def vectors_apart(table: pd.DataFrame, comma: bool = False) -> pd.DataFrame:
    """Put lists of numbers in a cell, such as "[0.1, 0.2]", into columns of their own: name[0], name[1].

    comma: the table has decimal commas. A comma between two digits is one if something else parts the numbers.
    """
    apart = re.compile(r"\d(?:,\s|\s|;)\s*[-+\d]" if comma else r"\d\s+[-+\d]")
    for name in [n for n in table.columns if table[n].dtype.kind in "OTU"]:
        cells = table[name]
        first = next((c for c in cells if isinstance(c, str) and c.strip()), "")
        if not VECTOR.fullmatch(first):
            continue
        if apart.search(first) and not cells.astype(str).str.contains(r"\d,\d+,\d|\d\.\d").any():
            cells = cells.str.replace(r"(?<=\d),(?=\d)", ".", regex=True)
            first = next(c for c in cells if isinstance(c, str) and c.strip())
        wide = len(NUMBERS.findall(first))
        rows = [NUMBERS.findall(c) if isinstance(c, str) and VECTOR.fullmatch(c) else None for c in cells]
        blank = cells.isna() | (cells.astype(str).str.strip() == "")
        if 0 < wide <= MOST_ELEMENTS and all(
            b if r is None else len(r) == wide for r, b in zip(rows, blank, strict=True)
        ):
            parts = np.array([[np.nan] * wide if r is None else r for r in rows], dtype=float)
            place = list(table.columns).index(name)
            attrs, table = table.attrs, table.drop(columns=name)
            for k in reversed(range(wide)):
                table.insert(place, f"{name}[{k}]", parts[:, k], allow_duplicates=True)
            table.attrs = attrs
    return table


def unique_name(name: str, taken: set[str]) -> str:
    """A name that no other column has: name, name_0, name_1, ..."""
    if name not in taken:
        return name
    return next(made for k in range(len(taken) + 1) if (made := f"{name}_{k}") not in taken)
