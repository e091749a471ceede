"""Read what a folder holds, as people and other programs leave it: results of excite, and files that are none."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from excite import output, reports

MAX_BYTES = 50_000_000  # of a summary; those of long studies have a few MB
# what a damaged or foreign summary raises where a description reads it
ODD = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError)


def _possible(name: str) -> str:
    """Check that a text can be the name of a file here. Raises ValueError."""
    if "\0" in name or len(name) > 4096 or any(len(part.encode()) > 255 for part in Path(name).parts):
        raise ValueError(f"no file can have the name {name[:40]!r}...")
    return name


FileName = Annotated[str, AfterValidator(_possible)]


class _Summary(BaseModel):
    """Entries that the window uses of every summary."""

    model_config = ConfigDict(extra="ignore")
    machine: str | None = None


class _Check(_Summary):
    faults: list[str]
    doubts: list[str]


class _MachineCheck(_Check):
    file: FileName
    remarks: list[str]


class _LogCheck(_Check):
    log: FileName


class _Design(_Summary):
    machine: str
    worst_percent: float | None
    worst_parameter: str | None
    sigma_percent: dict[str, float | None]


class _Drive(_Summary):
    design: FileName


class _Fit(_Summary):
    machine: str
    logs: list[FileName]


# kind of result -> the key that only summaries of that kind have, and the entries that are used
KINDS: dict[str, tuple[str, type[_Summary]]] = {
    "machine": ("coordinates", _MachineCheck),
    "design": ("cond_phi_start", _Design),
    "drive": ("phases", _Drive),
    "log": ("columns", _LogCheck),
    "identify": ("unidentifiable", _Fit),
    "diagnose": ("findings", _Fit),
}


@dataclass(frozen=True)
class Result:
    """A result folder: its kind, summary and time [s since 1970]."""

    kind: str
    folder: Path
    summary: dict[str, Any]
    time: float


def read_result(folder: Path, time: float) -> Result | str | None:
    """Read the result in a folder. Returns why it is none that can be shown, None for a kind that no step shows."""
    path = folder / output.SUMMARY
    try:
        if not path.is_file():
            return f"{path}: is no file"
        if path.stat().st_size > MAX_BYTES:
            return f"{path}: is too large for a summary"
        summary = output.read_json(path)
        json.dumps(summary, ensure_ascii=False).encode()  # half a surrogate pair can't be sent to the page
    except (OSError, ValueError) as err:
        said = err.strerror if isinstance(err, OSError) else "no JSON"
        return f"{path}: can't be read: {said}"
    if not isinstance(summary, dict):
        return f"{path}: is none that excite wrote"
    kind = next((kind for kind, (key, _) in KINDS.items() if key in summary), None)
    if kind is None:
        return None
    try:
        KINDS[kind][1].model_validate(summary)
        reports.result_fragment(reports.describe(kind, summary))
    except ValidationError as err:
        first = err.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        return f"{path}: is none that excite wrote: {where[:60]}: {first['msg'].removeprefix('Value error, ')[:120]}"
    except ODD:
        return f"{path}: is none that excite wrote, or a damaged one"
    return Result(kind, folder, summary, time)


def is_readable_file(path: str | Path) -> bool:
    """True for a file, whatever text its name is; False for a folder, a pipe or a device."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


class Stored(BaseModel):
    """Choices of the day as `app.json` holds them; what is of another type is left out."""

    model_config = ConfigDict(extra="ignore")
    machine: FileName | None = None
    logs: list[FileName] = []
    accepted: dict[str, str | list[str]] = {}
    forms: dict[str, dict[str, str | float | bool | None]] = {}


def read_stored(path: Path) -> Stored:
    """Read the choices of before, none from a file that holds others."""
    try:
        return Stored.model_validate_json(path.read_bytes()) if path.is_file() else Stored()
    except (OSError, ValueError):
        return Stored()


def is_possible_name(name: str) -> bool:
    """True if a file here can have this name."""
    try:
        return bool(_possible(name))
    except ValueError:
        return False
