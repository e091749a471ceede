"""Result folders and files that are written completely or not at all."""

from __future__ import annotations

import glob
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from excite.errors import DISK, DiskError, FolderError

SUMMARY = "summary.json"
MAX_NAME = 60  # letters of a result's name: of four bytes each they fit into a file name
MOST_DIGITS = 300  # of an integer: floats end at 1.8e308
# entries of a summary that say how a result was made
REQUEST_KEYS = ("objective", "duration_s", "method", "runs", "samples", "starts", "seed")
# names of the files that the program writes into a result folder
OWN_NAMES = re.compile(
    r"summary\.json|machine\.(json|toml)|contact\.toml|(profile|phases|covariance|tolerances|prediction|wiring|log_template)\.csv|README\.md"
    r"|motion\.(csv|yaml|script|src|mod)|bag|[a-z0-9-]+\.(png|svg|pdf|html|md)|design|accurate|verify|next|drives|runs\.parquet|study\.json|machines"
)


def write_summary(place: Path, summary: Mapping[str, Any], command: str | None = None) -> None:
    """Write a folder's summary with the command that made it and the commit of the program, unless it has its own.

    command: how it was made, this process's command line by default.
    """
    origin = {"command": command or command_line(), "commit": commit()}
    (place / SUMMARY).write_text(to_json({**summary, **{k: summary.get(k, v) for k, v in origin.items()}}), "utf-8")


def command_line() -> str:
    """Return this process's command as it is typed in a shell."""
    name = Path(sys.argv[0]).name
    return shlex.join(["excite" if name == "__main__.py" else name, *sys.argv[1:]])


def commit() -> str | None:
    """Return the commit of the program's checkout, with "-dirty" if its files differ from it; None outside one."""
    package = Path(__file__).parent
    try:
        if not _git(package, "ls-files", Path(__file__).name):  # installed somewhere below another project
            return None
        changed = _git(package, "status", "--porcelain", "--", ".", str((package / "model").resolve()))
        return _git(package, "rev-parse", "--short", "HEAD") + "-dirty" * bool(changed)
    except (OSError, ValueError, subprocess.SubprocessError):  # no git, or one that does not answer
        return None


def _git(place: Path, *arguments: str) -> str:
    command = ["git", "--no-optional-locks", *arguments]
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, cwd=place, check=True, timeout=10
    ).stdout.strip()


def real(path: str | Path) -> Path:
    """Return the absolute path behind links; of a link that leads to itself its own, where Path.resolve raises."""
    return Path(os.path.realpath(path))


def folder_of_check(place: Path, log: Path) -> Path:
    """Return the folder in `place` for the check of a log: that of its last one, or one that is not there yet."""
    plain = f"log-{log.name[:MAX_NAME]}"
    named = (place / (plain if k == 1 else f"{plain}-{k}") for k in itertools.count(1))
    return next(folder for folder in named if not os.path.lexists(folder) or _is_check_of(folder, log))


def _is_check_of(folder: Path, log: Path) -> bool:
    try:
        return real(read_json(folder / SUMMARY)["log"]) == real(log)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def check_out_folder(out: Path, inputs: Iterable[Path] = (), option: str = "--out") -> None:
    """Check before the work that `out` can be written at its end. Raises FolderError.

    An empty folder may be replaced, and a result folder with only the program's own files and none of the `inputs`.
    option: what the user gives the folder by.
    """
    if os.path.lexists(out) and not out.is_dir():  # a file, a pipe, a link that leads nowhere or to itself
        raise FolderError(f"{out}: is a file, give a folder")
    place = real(out)
    if place == Path.cwd() or place in Path.cwd().parents:
        raise FolderError(f"{out}: is the current folder or one above it, choose another {option}")
    for path in inputs:
        if place == real(path) or place in real(path).parents:
            raise FolderError(f"{out}: contains the input {path}, choose another {option}")
    if out.is_dir():
        foreign = [p.name for p in out.iterdir() if not OWN_NAMES.fullmatch(p.name)]
        if foreign or (any(out.iterdir()) and not (out / SUMMARY).is_file()):
            what = foreign[0] if foreign else "something else"
            raise FolderError(f"{out}: exists and holds {what}, choose another {option}")
        if not os.access(out, os.W_OK):
            raise FolderError(f"{out}: can't be replaced, no permission to write")
    _check_writable(out)


def read_json(path: Path) -> Any:
    """Return the content of a JSON file. Raises OSError, ValueError as `parse_json`."""
    return parse_json(path.read_text(encoding="utf-8"))


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text. Raises ValueError, also for deep nesting and integers beyond any float."""
    try:
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _integer(digits: str) -> int:
    """Read an integer that a float can hold. Raises ValueError."""
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)


def describe_result(out: Path) -> str | None:
    """Return the date of the result in a folder, and its settings if its summary has them; None for no result."""
    path = out / SUMMARY
    if not path.is_file():
        return None
    made = f"{datetime.fromtimestamp(path.stat().st_mtime):%Y-%m-%d %H:%M}"
    try:
        found = read_json(path)
    except (OSError, ValueError):
        return made
    if isinstance(found, dict) and isinstance(found.get("design"), dict):  # written by `excite run`
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
    """Check that the nearest existing parent folder may be written. Raises FolderError."""
    parent = out.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise FolderError(f"{out}: can't be written, {parent} is not a folder with write permission")


@contextmanager
def new_folder(out: Path, option: str = "--out") -> Iterator[Path]:
    """Yield a folder to fill that becomes `out` if the block succeeds, and is removed if it fails.

    A killed run leaves only a hidden folder next to `out`. option: as in `check_out_folder`. Raises FolderError.
    """
    check_out_folder(out, option=option)
    made = _make_parents(out)
    partial: Path | None = None
    try:
        with _disk(out):
            partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
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
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
        _remove_empty(made)


@contextmanager
def _disk(out: Path) -> Iterator[None]:
    """Say what could not be written, and where. Raises DiskError."""
    try:
        yield
    except OSError as err:
        if err.errno not in DISK:
            raise
        part = f" ({Path(os.fsdecode(err.filename)).name})" if err.filename else ""
        raise DiskError(
            f"{out}: could not be written{part}: {os.strerror(err.errno)}; free some space, or write to another disk"
        ) from None


def remove_partial_folders(out: Path) -> None:
    """Remove the hidden folders of killed runs next to `out`; no other run may be writing it."""
    for left in out.absolute().parent.glob(f".{glob.escape(out.name)}.*.partial"):
        shutil.rmtree(left, ignore_errors=True)


@contextmanager
def new_file(out: Path, replace: bool = True) -> Iterator[Path]:
    """Yield a file to write that becomes `out` if the block succeeds.

    replace: False to raise FileExistsError rather than to replace a file that appeared meanwhile. Raises FolderError.
    """
    if out.is_dir():
        raise FolderError(f"{out}: is a folder, --out needs a file name")
    _check_writable(out)
    made = _make_parents(out)
    name: str | None = None
    try:
        with _disk(out):
            handle, name = tempfile.mkstemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent)
            os.close(handle)
            yield Path(name)
            Path(name).chmod(0o644)
            if replace:
                Path(name).replace(out)
            else:
                os.link(name, out)
    finally:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        _remove_empty(made)


def _make_parents(out: Path) -> list[Path]:
    """Make the parent folders of `out` and return the new ones, deepest first."""
    missing = [p for p in out.absolute().parents if not p.exists()]
    out.parent.mkdir(parents=True, exist_ok=True)
    return missing


def _remove_empty(made: list[Path]) -> None:
    """Remove new parent folders that stayed empty."""
    for path in made:
        if any(path.iterdir()):
            return
        path.rmdir()


def to_json(summary: Mapping[str, Any]) -> str:
    """Return a summary as strict JSON, with null for a number that is not finite."""
    return json.dumps(_plain_value(summary), indent=2, allow_nan=False) + "\n"


def _plain_value(value: Any) -> Any:
    """Convert arrays and NumPy numbers to plain ones, and numbers that are not finite to None."""
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
