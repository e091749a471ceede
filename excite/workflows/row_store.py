"""Store of the rows of a running study: one SQLite file.

A batch of rows is one transaction, so a kill or a full disk never leaves half a batch. The run's number is the key, so
no row is stored twice. The file is locked while it is open, so only one process works on a study.
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


class RowStore:
    """The rows stored so far. Open it with `open_store`."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self._db = path, connection

    def add_rows(self, rows: Iterable[tuple[int, Row]], seconds: float = 0.0) -> None:
        """Store a batch of numbered rows, all or none, and the time [s] that they took.

        Raises RowStoreError; ValueError for a run that is stored already.
        """
        texts = [(n, json.dumps(row, allow_nan=False)) for n, row in rows]
        with self._guarded(), self._db:
            self._db.executemany("INSERT INTO runs VALUES (?, ?)", texts)
            self._db.execute("UPDATE spent SET seconds = seconds + ?", (seconds,))

    def add_failure(self, drive: int, reason: str) -> None:
        """Store the reason why a drive could not be designed. Raises RowStoreError."""
        with self._guarded(), self._db:
            self._db.execute("INSERT INTO failures VALUES (?, ?)", (drive, reason))

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.IntegrityError as err:
            raise ValueError(f"{self.path}: a run is stored already: {err}") from None
        except (sqlite3.OperationalError, sqlite3.DatabaseError) as err:
            raise RowStoreError(
                f"{self.path}: can't be written: {err}; the rows so far are safe, correct this and repeat the command"
            ) from None

    def numbers(self) -> set[int]:
        """Return the numbers of the stored runs."""
        return {n for (n,) in self._db.execute("SELECT number FROM runs")}

    def rows(self) -> Iterator[tuple[int, Row]]:
        """Yield number and row of every stored run, in order."""
        for number, text in self._db.execute("SELECT number, row FROM runs ORDER BY number"):
            yield number, json.loads(text)

    def failures(self) -> dict[int, str]:
        """Return the failed drives with their reasons."""
        return dict(self._db.execute("SELECT drive, reason FROM failures ORDER BY drive"))

    @property
    def seconds(self) -> float:
        """Time [s] that all workers spent on the rows."""
        return float(self._db.execute("SELECT seconds FROM spent").fetchone()[0])


@contextmanager
def open_store(path: Path, fingerprint: str) -> Iterator[RowStore]:
    """Open the store of the study with this fingerprint, created if missing.

    Raises FolderError for a damaged store, one of another study, or one that another process has open.
    """
    try:
        db = sqlite3.connect(path, timeout=0)
    except sqlite3.Error as err:
        raise FolderError(f"{path}: can't be opened: {err}") from None
    try:
        _prepare_tables(db, path, fingerprint)
        yield RowStore(path, db)
    finally:
        db.close()


def _prepare_tables(db: sqlite3.Connection, path: Path, fingerprint: str) -> None:
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
            raise FolderError(f"{path}: another process works on this study, wait or choose another --out") from None
        raise RowStoreError(f"{path}: can't be written: {err}") from None
    except sqlite3.DatabaseError as err:
        raise FolderError(f"{path}: damaged ({err}), delete it to begin afresh") from None
