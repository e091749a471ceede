"""Files as tables of columns, whatever the format, with the names that a machine file gives them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from excite.errors import LogError
from excite.logs.files import reader_of
from excite.logs.files.canbus import is_candump
from excite.logs.files.common import NOTES, OTHER_NAMES, TIMESTAMPS, UNCLEAR as UNCLEAR, UNITS_SAID, UNITS_UNKNOWN
from excite.logs.files.text import COMMENTS as COMMENTS
from excite.logs.formats import BAG_FOLDER, ENDINGS, PROFILE

MDF_TIME = TIMESTAMPS


def read_table(path: str | Path, wanted: Iterable[str] = ()) -> pd.DataFrame:
    """Read the columns of a file as they are. Raises LogError.

    wanted: names of columns that are used; formats that hold more than one table give the one that has them.

    The table's attrs: "units" that the file gives, by column; "notes" of what was left out or taken for what;
    "other_names" of columns -> the column; "unclear", what is said of columns that may be read in two ways.
    """
    path = Path(path)
    folder = path.is_dir() and (path / BAG_FOLDER).is_file()
    if (path / PROFILE).is_file() and not folder:
        raise LogError(
            f"{path}: is the folder of a drive, no log: give what the machine's sensors wrote along it; `excite"
            " simulate` writes what they may write"
        )
    if not path.is_file() and not folder:
        raise LogError(f"{path}: no such file" if not path.is_dir() else f"{path}: is a folder, give a file")
    if not folder and path.stat().st_size == 0:
        raise LogError(f"{path}: the file is empty")
    suffix = ".db3" if folder or path.name == BAG_FOLDER else path.suffix.lower()
    reader = reader_of(".log" if suffix == ".txt" and is_candump(path) else suffix)
    if reader is None:
        raise LogError(f"{path}: unknown kind of file {path.suffix!r}, allowed: {ENDINGS}")
    table = reader(path, frozenset(wanted))
    if table.empty:
        raise LogError(f"{path}: no rows of data")
    for key, none in ((UNITS_SAID, {}), (UNITS_UNKNOWN, {}), (NOTES, []), (OTHER_NAMES, {}), (UNCLEAR, {})):
        table.attrs.setdefault(key, none)
    return table


def with_names(table: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    """Rename columns that are these names but for case, blanks and what `other_names` says, where only one is."""
    there = [str(c) for c in table.columns]
    other: dict[str, str] = table.attrs.get(OTHER_NAMES, {})
    renamed: dict[str, str] = {}
    for name in dict.fromkeys(names):
        if name in there:
            continue
        for same in (str.strip, _plain, _bare):
            found = {c for c in there if same(c) == same(name)} or {
                c for own, c in other.items() if same(own) == same(name) and c in there
            }
            if found:
                break
        if len(found) == 1 and (column := found.pop()) not in renamed and column not in names:
            renamed[column] = name
    if not renamed:
        return table
    attrs = dict(table.attrs)
    table = table.rename(columns=renamed)
    for key in (UNITS_SAID, UNITS_UNKNOWN, UNCLEAR):
        attrs[key] = {renamed.get(c, c): v for c, v in attrs.get(key, {}).items()}
    attrs[OTHER_NAMES] = {own: renamed.get(c, c) for own, c in other.items()} | renamed
    table.attrs = attrs
    return table


def _plain(name: str) -> str:
    return " ".join(name.split()).lower()


def _bare(name: str) -> str:
    """A name of a topic's field, whatever is between its parts."""
    return _plain(name).strip("/").replace("/", ".")
