"""Store of the rows of a running study: one SQLite file.

Rows are added in transactions, so a kill or a full disk never leaves part of one. The run's number is the key, so no
row is stored twice. The file is locked while it is open, so only one process works on a study.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from excite.errors import FolderError, RowStoreError

COMMIT_S = 0.2  # longest time [s] until a row is safe; chosen: a transaction takes some hundredths of it

Row = dict[str, Any]


class RowStore:
    """The rows stored so far. Open it with `open_store`."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self._db, self._committed = path, connection, 0.0

    def add(self, number: int, row: Row, seconds: float = 0.0) -> None:
        """Store a run and the time [s] that it took. Raises RowStoreError."""
        self._write("INSERT INTO runs VALUES (?, ?, ?)", (number, json.dumps(row, allow_nan=False), seconds))

    def add_failure(self, drive: int, reason: str) -> None:
        """Store the reason why a drive could not be designed. Raises RowStoreError."""
        self._write("INSERT INTO failures VALUES (?, ?)", (drive, reason))
        self.commit()

    def _write(self, command: str, values: tuple[Any, ...]) -> None:
        with self._guarded():
            self._db.execute(command, values)
        if time.monotonic() - self._committed > COMMIT_S:
            self.commit()

    def commit(self) -> None:
        """Make all rows safe. Raises RowStoreError."""
        with self._guarded():
            self._db.commit()
        self._committed = time.monotonic()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.IntegrityError, sqlite3.ProgrammingError):
            raise
        except sqlite3.DatabaseError as err:
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
        return float(self._db.execute("SELECT total(seconds) FROM runs").fetchone()[0])


@contextmanager
def open_store(path: Path, fingerprint: str) -> Iterator[RowStore]:
    """Open the store of the study with this fingerprint, created if missing; rows are safe however the block ends.

    Raises FolderError for a damaged store, one of another study, or one that another process has open.
    """
    try:
        db = sqlite3.connect(path, timeout=0)
    except sqlite3.Error as err:
        raise FolderError(f"{path}: can't be opened: {err}") from None
    with closing(db):
        _prepare_tables(db, path, fingerprint)
        store = RowStore(path, db)
        try:
            yield store
        finally:
            store.commit()


def _prepare_tables(db: sqlite3.Connection, path: Path, fingerprint: str) -> None:
    try:
        db.execute("PRAGMA locking_mode = EXCLUSIVE")
        db.execute("PRAGMA synchronous = FULL")
        db.execute("BEGIN EXCLUSIVE")
        db.execute("CREATE TABLE IF NOT EXISTS study (fingerprint TEXT NOT NULL)")
        db.execute("CREATE TABLE IF NOT EXISTS runs (number INTEGER PRIMARY KEY, row TEXT NOT NULL, seconds REAL)")
        db.execute("CREATE TABLE IF NOT EXISTS failures (drive INTEGER PRIMARY KEY, reason TEXT NOT NULL)")
        known = db.execute("SELECT fingerprint FROM study").fetchone()
        if known is None:
            db.execute("INSERT INTO study VALUES (?)", (fingerprint,))
        elif known[0] != fingerprint:
            raise FolderError(
                f"{path}: holds the rows of another study file or another version of the program;"
                " choose another --out, or delete it to begin afresh"
            )
        db.commit()
    except sqlite3.OperationalError as err:
        if "locked" in str(err):
            raise FolderError(f"{path}: another process works on this study, wait or choose another --out") from None
        raise RowStoreError(
            f"{path}: can't be written: {err}; is the disk full? Mend this, repeat the command"
        ) from None
    except sqlite3.DatabaseError as err:
        raise FolderError(f"{path}: damaged ({err}), delete it to begin afresh") from None
