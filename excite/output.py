"""Result folders and files that are whole or not there at all."""

from __future__ import annotations

import glob
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from excite.errors import FolderError

SUMMARY = "summary.json"
REQUEST_KEYS = (
    "objective",
    "duration_s",
    "method",
    "runs",
    "samples",
    "starts",
    "seed",
)  # what tells a result from another
OWN_NAMES = re.compile(
    r"summary\.json|machine\.(json|toml)|(profile|phases)\.csv|README\.md|[a-z0-9-]+\.(png|pdf|html|md)|design|verify|next"
    r"|drives|runs\.parquet|study\.json|machines"
)


def write_summary(place: Path, summary: Any) -> None:
    """Writes a folder's summary."""
    (place / SUMMARY).write_text(to_json(summary), encoding="utf-8")


def check_out_folder(out: Path, inputs: Iterable[Path] = ()) -> None:
    """Checks before the work that `out` can be written at its end. Raises FolderError.

    An empty folder may be replaced, and one of ours that holds nothing but our own files and none of the `inputs`;
    anything else is left alone.
    """
    if out.is_file():
        raise FolderError(f"{out}: is a file, --out needs a folder")
    place = out.resolve()
    if place == Path.cwd() or place in Path.cwd().parents:
        raise FolderError(f"{out}: is the folder that you are in or above it, choose another --out")
    for path in inputs:
        if place == path.resolve() or place in path.resolve().parents:
            raise FolderError(f"{out}: holds {path}, which is read, choose another --out")
    if out.is_dir():
        foreign = [p.name for p in out.iterdir() if not OWN_NAMES.fullmatch(p.name)]
        if foreign or (any(out.iterdir()) and not (out / SUMMARY).is_file()):
            what = foreign[0] if foreign else "something else"
            raise FolderError(f"{out}: exists and holds {what}, choose another --out")
        if not os.access(out, os.W_OK):
            raise FolderError(f"{out}: can't be replaced, it may not be written to")
    _check_writable(out)


def describe_result(out: Path) -> str | None:
    """When what is in a folder of ours was made and, as far as its summary says, how; None where nothing is there."""
    path = out / SUMMARY
    if not path.is_file():
        return None
    made = f"{datetime.fromtimestamp(path.stat().st_mtime):%Y-%m-%d %H:%M}"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return made
    if isinstance(found, dict) and isinstance(found.get("design"), dict):  # of `excite run`
        found = found["design"]
    known = [(key, found.get(key)) for key in REQUEST_KEYS] if isinstance(found, dict) else []
    told = [
        f"{key.removesuffix('_s')} {_short_text(value)}{' s' * key.endswith('_s')}"
        for key, value in known
        if value is not None
    ]
    return f"{made} ({', '.join(told)})" if told else made


def _short_text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _check_writable(out: Path) -> None:
    parent = out.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise FolderError(f"{out}: can't be written, {parent} is not a folder that you may write to")


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder to fill that becomes `out` when the block ends well, and vanishes otherwise.

    A killed run leaves only a hidden folder beside it. Raises FolderError.
    """
    check_out_folder(out)
    made = _make_parents(out)
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    try:
        yield partial
        partial.chmod(0o755)
        if out.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".old", dir=out.parent))
            out.replace(old / out.name)
            partial.replace(out)
            shutil.rmtree(old)
        else:
            partial.replace(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        _remove_empty(made)


def remove_partial_folders(out: Path) -> None:
    """Removes what killed runs left beside `out`; for a caller that knows no other one at work on it."""
    for left in out.absolute().parent.glob(f".{glob.escape(out.name)}.*.partial"):
        shutil.rmtree(left, ignore_errors=True)


@contextmanager
def new_file(out: Path) -> Iterator[Path]:
    """A file to write that becomes `out` when the block ends well. Raises FolderError."""
    if out.is_dir():
        raise FolderError(f"{out}: is a folder, --out needs a file name")
    _check_writable(out)
    made = _make_parents(out)
    handle, name = tempfile.mkstemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent)
    os.close(handle)
    try:
        yield Path(name)
        Path(name).chmod(0o644)
        Path(name).replace(out)
    finally:
        Path(name).unlink(missing_ok=True)
        _remove_empty(made)


def _make_parents(out: Path) -> list[Path]:
    """Makes the folders that `out` needs and returns those that were not there, the deepest first."""
    missing = [p for p in out.absolute().parents if not p.exists()]
    out.parent.mkdir(parents=True, exist_ok=True)
    return missing


def _remove_empty(made: list[Path]) -> None:
    """What failed leaves nothing behind, not even an empty folder."""
    for path in made:
        if any(path.iterdir()):
            return
        path.rmdir()


def to_json(summary: Mapping[str, Any]) -> str:
    """Strict JSON: a number that is not finite is null, never NaN."""
    return json.dumps(_plain_value(summary), indent=2, allow_nan=False) + "\n"


def _plain_value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain_value(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain_value(value.tolist())
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
