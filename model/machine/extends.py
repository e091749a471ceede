"""Machine files that `extends` another: read the chain and merge it into one."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from excite.model.machine.places import LISTS
from excite.model.machine.records import read_toml
from excite.text import closest, did_you_mean

MAX_DEPTH = 4  # files that one file may extend in a chain; chosen


def file_names(folder: Path) -> tuple[str, ...]:
    """Return the names of the files in a folder that others may extend by name."""
    return tuple(sorted(p.stem for p in folder.glob("*.toml")))


def chain(path: Path, shipped: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Read a TOML file and those that it extends, one after another: files beside it, or shipped ones by name.

    Raises ValueError, one line.
    """
    found = [(path, read_toml(path))]
    while (base := _base(found[-1][0], found[-1][1].get("extends"), shipped)) is not None:
        if len(found) > MAX_DEPTH:
            raise ValueError(f"{base}: extends: more than {MAX_DEPTH} files deep, a loop?")
        found.append((base, read_toml(base)))
    return found


@dataclass(frozen=True)
class WrongName:
    """A table [body.NAME] or [sensor.NAME] that names no body or sensor of the extended file; where: its key."""

    path: Path
    where: tuple[str, str]
    message: str

    def __str__(self) -> str:
        return f"{'.'.join(self.where)}: {self.message}"


def read(path: Path, shipped: Path) -> tuple[dict[str, Any], tuple[WrongName, ...]]:
    """Read a TOML file merged over those that it extends (see `chain`), and its wrong names, read as probably meant.

    Raises ValueError, one line.
    """
    whole: dict[str, Any] = {}
    wrong: list[WrongName] = []
    for one, raw in reversed(chain(path, shipped)):
        whole = _override(one, whole, raw, raw.pop("extends", None), wrong)
    return whole, tuple(wrong)


def _base(path: Path, parent: object, shipped: Path) -> Path | None:
    """Return the file that one extends, None for none. Raises ValueError."""
    if parent is None:
        return None
    if not isinstance(parent, str):
        raise ValueError(f"{path}: extends: must be a shipped name or a file name")
    known = file_names(shipped)
    base = shipped / f"{parent}.toml" if parent in known else path.parent / parent
    if parent not in known and (Path(parent).name != parent or "\x00" in parent or not base.is_file()):
        raise ValueError(f"{path}: extends: no machine {parent}, allowed: {', '.join(known)}, or a file beside it")
    return base


def _override(
    path: Path, whole: dict[str, Any], raw: dict[str, Any], parent: str | None, wrong: list[WrongName]
) -> dict[str, Any]:
    """Merge a file over the one that it extends, add its wrong names. Raises ValueError."""
    own, listed = (x if isinstance(x, list) else [] for x in (raw.get("sensor"), whole.get("sensor")))
    sensors = [x.get("name") for x in listed if isinstance(x, dict)]
    if any(isinstance(x, dict) and x.get("name") in sensors and "kind" not in x for x in own):
        raise ValueError(
            f"{path}: sensor: a list replaces that of {parent}, so every sensor needs all its keys;"
            " [sensor.NAME] changes one, `excite machine new NAME --like` writes all"
        )
    if whole.get("noise_unit") == "SI":  # of the file that is extended
        whole["sensor"] = [{"noise_unit": "SI"} | x if isinstance(x, dict) else x for x in listed]
        whole.pop("noise_unit")
    for key in LISTS:
        if isinstance(raw.get(key), dict) and isinstance(whole.get(key), list):
            raw[key] = _change_named(path, key, whole[key], raw[key], wrong)
    return _merge(whole, raw)


def _change_named(path: Path, key: str, known: list[Any], changes: dict[str, Any], wrong: list[WrongName]) -> list[Any]:
    """Change some of a list's named tables, each by the table of its name; add wrong names. Raises ValueError."""
    names = [str(x.get("name")) if isinstance(x, dict) else "" for x in known]
    meant: dict[str, Any] = {}
    for name, change in changes.items():
        if not isinstance(change, dict):
            raise ValueError(
                f"{path}: {key}.{name}: must be a table of the keys that differ (got {reprlib.repr(change)})"
            )
        if name not in names:
            hint = did_you_mean(name, names)
            wrong.append(WrongName(path, (key, name), f"no such {key}, allowed: {', '.join(names)}{hint}"))
        one = name if name in names else closest(name, names)
        if one is not None:
            meant[one] = _merge(meant.get(one, {}), change)
    merged = [_merge(x, meant[n]) if n in meant else x for n, x in zip(names, known, strict=True)]
    return [_in_own_unit(x, meant.get(n, {}), m) for n, x, m in zip(names, known, merged, strict=True)]


def _in_own_unit(base: Any, change: dict[str, Any], merged: Any) -> Any:
    """Keep the unit of a noise that a sensor inherits, where its column gets another one."""
    renewed = {"unit", "factor"} & change.keys()
    if not isinstance(base, dict) or not renewed or {"noise", "noise_unit"} & change.keys() or "noise" not in base:
        return merged
    return merged | {"noise_unit": base.get("noise_unit", base.get("unit"))}


def _merge(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Merge tables, replace values and lists."""
    merged = dict(base)
    for key, value in change.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        # A quantity is replaced as a whole: source and note are those of its value.
        merged[key] = _merge(merged[key], value) if both and "value" not in value else value
    return merged
