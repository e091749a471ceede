"""What readers of all formats share: limits of memory, errors in one line, channels at times of their own."""

from __future__ import annotations

import gc
import logging
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
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
MOST_COLUMNS = 10_000  # of a table of cells; chosen
MOST_BYTES = 2_000_000_000  # of unpacked text; chosen
MOST_PACKED = 1_100  # times that a packed block can unpack to; zlib's most is 1032
MOST_ELEMENTS = 64  # of an array in a message or a row that become columns of their own: no picture; chosen
WORDS = 120  # characters of a library's message that are shown


def guarded(reader: Reader, kind: str) -> Reader:
    """Make a reader whose library's errors, whatever they are, become one line of LogError. kind: "an MDF file"."""

    def read(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
        with quiet():
            try:
                return reader(path, wanted)
            except LogError:
                raise
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
    sys.unraisablehook = _ignore
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


def _ignore(_: object) -> None:
    """Say nothing of an error in a destructor."""


def lacking(path: Path, what: str, extra: str) -> LogError:
    """The error where a library is not installed."""
    return LogError(f"{path}: {what}: pip install 'excite[{extra}]'")


def refuse_huge(path: Path, rows: int, columns: int) -> None:
    """Raises LogError where a file claims more than fits into memory."""
    if rows * max(columns, 1) > MOST_CELLS:
        raise LogError(
            f"{path}: claims {count(rows, 'row')} of {count(columns, 'column')}, more than the {MOST_CELLS} numbers"
            " that are read; is the file damaged? otherwise cut it into shorter logs"
        )


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


def unique_name(name: str, taken: set[str]) -> str:
    """A name that no other column has: name, name_0, name_1, ..."""
    if name not in taken:
        return name
    return next(made for k in range(len(taken) + 1) if (made := f"{name}_{k}") not in taken)
