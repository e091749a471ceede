"""Find all faults of a machine file at once: each is put right as it was probably meant, and the reading goes on."""

from __future__ import annotations

import copy
import pathlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from excite.model.machine.extends import WrongName
from excite.model.machine.machine import Machine
from excite.model.machine.places import Path, key_lines, line_of, named
from excite.model.machine.records import MOST_SAID, error_text, record_at
from excite.text import closest

ROUNDS = 10  # of putting right and reading again; chosen
KEY = re.compile(r"^(\w+(?:\[\d+\]|\.\w+)*): ")
SIGNS = re.compile(r"must be (>|>=|<) 0 ")
BODY = re.compile(r"^(sensor )?(\w+): ([\w.]+): ")


@dataclass(frozen=True)
class FileFaults:
    """Faults of a machine file, a line each, and the machine as it was probably meant, None if that can't be guessed.

    complete: False if a part of the file was left out of that machine.
    """

    lines: tuple[str, ...]
    machine: Machine | None
    complete: bool


def find_faults(
    text: str, tables: dict[str, Any], wrong: Sequence[WrongName] = (), path: pathlib.Path | None = None
) -> FileFaults:
    """Return all faults of a machine file. text: the file itself; tables: its content, with what it extends.

    wrong: names, in it or a file that it extends, of no body or sensor, read as probably meant. path: the file's.
    """
    raw, complete = copy.deepcopy(tables), True
    lines = key_lines(text)
    found: dict[str, None] = {}
    for name in wrong:
        own = path is None or name.path == path
        number = lines.get(name.where) if own else None
        said = str(name) if own else f"{name.path}: {name}"
        found[said if number is None else f"line {number}: {said}"] = None
    for _ in range(ROUNDS):
        try:
            return FileFaults(tuple(found), Machine.model_validate(raw), complete)
        except ValidationError as err:
            errors = err.errors(include_url=False)
        if len(errors) > MOST_SAID:
            lines_said = [_line(*_located(one), raw, lines) for one in errors[:MOST_SAID]]
            return FileFaults((*found, *lines_said, f"{len(errors) - MOST_SAID} more faults"), None, False)
        meant = {(*e["loc"][:-1], _meant(e)) for e in errors if e["type"] == "extra_forbidden"}
        dropped: set[int] = set()
        mended = False
        for one in errors:
            where, message = _located(one)
            if not (one["type"] == "missing" and tuple(one["loc"]) in meant):
                found[_line(where, message, raw, lines)] = None
            if (
                where[:1] == ("sensor",)
                and len(where) > 1
                and one["type"] == "value_error"
                and not SIGNS.search(message)
            ):
                dropped.add(int(where[1]))
            else:
                mended |= _mend(raw, one, where)
        for k in sorted(dropped, reverse=True):
            del raw["sensor"][k]
        complete &= not dropped
        if not mended and not dropped:
            break
    return FileFaults(tuple(found), None, False)


def with_line(said: str, machine: Machine, text: str) -> str:
    """Put the line of a file before what is said of one of its keys: "front_roll: limit.torque: ..."."""
    of_body = BODY.match(said)
    where: Path = ()
    if of_body is not None:
        table = "sensor" if of_body[1] else "body"
        names = [s.name for s in machine.sensor] if of_body[1] else [b.name for b in machine.body]
        if of_body[2] in names:
            where = (table, names.index(of_body[2]), *of_body[3].split("."))
    elif (key := KEY.match(said)) is not None:
        where = tuple(key[1].split("."))
    lines = key_lines(text)
    raw = {"body": [{"name": b.name} for b in machine.body], "sensor": [{"name": s.name} for s in machine.sensor]}
    number = line_of(lines, where) or line_of(lines, named(where, raw))
    return said if number is None else f"line {number}: {said}"


def _located(one: ErrorDetails) -> tuple[Path, str]:
    """Return the key that an error is of, and what is wrong with it."""
    key, message = error_text(one, Machine)
    whole = f"{key}: {message}" if key else message
    path = KEY.match(whole)
    if path is None:
        return tuple(one["loc"]), message
    steps = re.findall(r"\w+", path[1])
    return tuple(int(s) if s.isdigit() else s for s in steps), whole[path.end() :]


def _line(where: Path, message: str, raw: dict[str, Any], lines: dict[Path, int]) -> str:
    called = named(where, raw)
    number = line_of(lines, where) or line_of(lines, called)
    listed = called[:1] in (("body",), ("sensor",)) and len(called) > 1
    owner = f"{'sensor ' if called[0] == 'sensor' else ''}{called[1]}" if listed else ""
    steps = called[2:] if listed else called
    key = "".join(f"[{s}]" if isinstance(s, int) else f".{s}" for s in steps).lstrip(".")
    text = ": ".join(part for part in (owner, key, message) if part)
    return " ".join((text if number is None else f"line {number}: {text}").split())


def _meant(one: ErrorDetails) -> str | None:
    """Return the key or name that a misspelt one was probably meant to be, None for none."""
    if one["type"] == "extra_forbidden":
        allowed: Sequence[str] = list(record_at(one["loc"][:-1], Machine).model_fields)
        return closest(one["loc"][-1], allowed)
    allowed = re.findall(r"'([^']*)'", one.get("ctx", {}).get("expected", ""))
    return closest(one["input"], allowed)


def _mend(raw: dict[str, Any], one: ErrorDetails, where: Path) -> bool:
    """Put a fault right as it was probably meant. Return False if that can't be guessed."""
    *way, key = one["loc"] or where or ("",)
    nothing = object()
    parent = _at(raw, way)
    kind, meant = one["type"], _meant(one) if one["type"] in ("extra_forbidden", "literal_error") else None
    if kind == "missing" and key == "source" and isinstance(parent, dict):
        parent["source"] = "assumed"
        return True
    value = _at(raw, (*way, key), nothing)
    if not isinstance(parent, dict | list) or value is nothing:
        return False
    if kind == "extra_forbidden" and isinstance(parent, dict):
        del parent[str(key)]
        if meant is not None:
            parent.setdefault(meant, value)
        return True
    if kind == "literal_error" and (meant is not None or key == "source"):
        parent[key] = meant or "assumed"  # type: ignore[index]
        return True
    if kind == "model_type" and isinstance(value, int | float) and not isinstance(value, bool):
        parent[key] = {"value": value, "source": "assumed"}  # type: ignore[index]
        return True
    quantity = _at(raw, where)  # which a message of its record may name
    number = quantity.get("value") if isinstance(quantity, dict) else None
    if kind == "value_error" and SIGNS.search(one["msg"]) and isinstance(number, int | float) and number:
        quantity["value"] = -number
        return True
    return kind == "value_error" and where == ("problem",) and raw.pop("problem", None) is not None


def _at(raw: Any, way: Sequence[int | str], nothing: object = None) -> Any:
    """Return what stands at a place of nested tables and lists, `nothing` where the place does not exist."""
    for step in way:
        try:
            raw = raw[step]
        except (KeyError, IndexError, TypeError):
            return nothing
    return raw
