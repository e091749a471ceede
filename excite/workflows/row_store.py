"""Rows of a study that is under way, each there whole or not at all, each once.

One SQLite file: a batch of rows is one transaction, so neither a kill nor a full disk leaves half of one; the number of
the run is its key, so none is kept twice; and the file is locked while somebody writes, so two can't work on one study.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from excite.errors import FolderError, RowStoreError

Row = dict[str, Any]


class Store:
    """The rows kept so far. Open it with `opened`."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self._db = path, connection

    def keep(self, rows: Iterable[tuple[int, Row]], seconds: float = 0.0) -> None:
        """Keeps the rows of a batch, all or none, that took so long [s]. Raises StoreError; ValueError for a run that
        is there already."""
        texts = [(n, json.dumps(row, allow_nan=False)) for n, row in rows]
        with self._guarded(), self._db:
            self._db.executemany("INSERT INTO runs VALUES (?, ?)", texts)
            self._db.execute("UPDATE spent SET seconds = seconds + ?", (seconds,))

    def fail(self, drive: int, reason: str) -> None:
        """Keeps why there is no such drive. Raises StoreError."""
        with self._guarded(), self._db:
            self._db.execute("INSERT INTO failures VALUES (?, ?)", (drive, reason))

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.IntegrityError as err:
            raise ValueError(f"{self.path}: a run is there already: {err}") from None
        except (sqlite3.OperationalError, sqlite3.DatabaseError) as err:
            raise RowStoreError(
                f"{self.path}: can't be written: {err}; what was kept is safe, mend that and repeat the command"
            ) from None

    def numbers(self) -> set[int]:
        """Numbers of the runs that are kept."""
        return {n for (n,) in self._db.execute("SELECT number FROM runs")}

    def rows(self) -> Iterator[tuple[int, Row]]:
        """All rows in the order of their runs, one at a time."""
        for number, text in self._db.execute("SELECT number, row FROM runs ORDER BY number"):
            yield number, json.loads(text)

    def failures(self) -> dict[int, str]:
        """Drives that can't be had, with why."""
        return dict(self._db.execute("SELECT drive, reason FROM failures ORDER BY drive"))

    @property
    def seconds(self) -> float:
        """Time [s] that the workers spent on the rows, all together."""
        return float(self._db.execute("SELECT seconds FROM spent").fetchone()[0])


@contextmanager
def opened(path: Path, fingerprint: str) -> Iterator[Store]:
    """The rows of the study with this fingerprint, kept in `path`, which is made where it isn't there.

    Raises FolderError where it holds another study's, is damaged, or somebody is at work on it.
    """
    try:
        db = sqlite3.connect(path, timeout=0)
    except sqlite3.Error as err:
        raise FolderError(f"{path}: can't be opened: {err}") from None
    try:
        _begin(db, path, fingerprint)
        yield Store(path, db)
    finally:
        db.close()


def _begin(db: sqlite3.Connection, path: Path, fingerprint: str) -> None:
    try:
        db.execute("PRAGMA locking_mode = EXCLUSIVE")
        db.execute("PRAGMA synchronous = FULL")
        db.execute("BEGIN EXCLUSIVE")
        db.execute("CREATE TABLE IF NOT EXISTS study (fingerprint TEXT NOT NULL)")
        db.execute("CREATE TABLE IF NOT EXISTS runs (number INTEGER PRIMARY KEY, row TEXT NOT NULL)")
        db.execute("CREATE TABLE IF NOT EXISTS failures (drive INTEGER PRIMARY KEY, reason TEXT NOT NULL)")
        db.execute("CREATE TABLE IF NOT EXISTS spent (seconds REAL NOT NULL)")
        known = db.execute("SELECT fingerprint FROM study").fetchone()
        if known is None:
            db.execute("INSERT INTO study VALUES (?)", (fingerprint,))
            db.execute("INSERT INTO spent VALUES (0)")
        elif known[0] != fingerprint:
            raise FolderError(
                f"{path}: holds the rows of another study file or another version of the program;"
                " choose another --out, or delete it to begin afresh"
            )
        db.commit()
    except sqlite3.OperationalError as err:
        if "locked" in str(err):
            raise FolderError(f"{path}: somebody is at work on this study, wait or choose another --out") from None
        raise RowStoreError(f"{path}: can't be written: {err}") from None
    except sqlite3.DatabaseError as err:
        raise FolderError(f"{path}: damaged ({err}), delete it to begin afresh") from None
