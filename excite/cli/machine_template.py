"""A machine file to start from: a commented template, a shipped machine explained, or one with columns to change."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jinja2

from excite import output, workflows
from excite.errors import MachineError
from excite.model import machine
from excite.model.machine import Machine

TEMPLATE = "machine.toml"


def start(name: str, file: Path, like: str | None = None, origin: str | None = None) -> tuple[str, ...]:
    """Write the template, all of `origin` (a shipped machine or a URDF), or what extends `like` with columns to change.

    Returns notes on a URDF that is read otherwise than it is written. Raises MachineError for an existing file, an
    impossible name, or a URDF that can't be expressed.
    """
    notes: tuple[str, ...] = ()
    if origin is not None and is_urdf(origin):
        text, notes = from_urdf(name, file, Path(origin))
    elif origin is not None:
        text = whole(name, file, origin)
    else:
        text = fresh(name, file) if like is None else renamed(name, file, machine.load_machine(like))
    if file.exists():
        raise MachineError(f"{file}: exists already, give another --out")
    with output.new_file(file) as place:
        place.write_text(text, encoding="utf-8", errors="replace")
    return notes


def fresh(name: str, file: Path) -> str:
    """Return the commented template. Raises MachineError for an impossible name."""
    _named(name)
    text = jinja2.Environment(
        loader=jinja2.PackageLoader("excite", "templates"), keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    ).get_template(TEMPLATE)
    return text.render(name=name, title=name.replace("_", " ").replace("-", " "), file=file)


def whole(name: str, file: Path, origin: str) -> str:
    """Return the whole file of a shipped machine, each key with unit and meaning. Raises MachineError."""
    _named(name)
    lines = [
        f"# {name}: a copy of the shipped machine {origin}, with unit and meaning of every key. Everything is SI: m,",
        "# kg, s, N, N m, rad. Change the values and their sources (paper, data sheet, measured, published,",
        f"# identified, assumed or definition), then run `excite machine check {file}`. `excite docs` lists the keys",
        f'# that may be added. To write only what differs, begin a file with extends = "{origin}" instead.',
        "",
    ]
    text, tables, wrong = machine.machine_tables(origin)
    machine.require_right_names(wrong)
    return "\n".join([*lines, *_with_meanings(name, _dumped(tables) if EXTENDS.search(text) else text)]) + "\n"


def is_urdf(origin: str) -> bool:
    """True if a path ends as URDF files do."""
    return Path(origin).suffix.lower() in (".urdf", ".xml")


def from_urdf(name: str, file: Path, origin: Path) -> tuple[str, tuple[str, ...]]:
    """Return the file of a robot described in URDF, each key with unit and meaning, and notes. Raises MachineError."""
    _named(name)
    tables, notes = workflows.machine_from_urdf(origin, name)
    missing = workflows.add_shapes(origin, tables)
    if missing is not None:
        notes = (*notes, f"Collisions won't be looked at: {missing}.")
    lines = [
        f"# {name}: the robot of {origin.name}, its base fixed, z up. Frames are those of modified Denavit-Hartenberg,",
        "# z along each joint's axis; coordinates are those of the URDF, and `published` values are its own. Columns,",
        "# sampling, filter and what is `assumed` must be changed to yours.",
        f"# Then run `excite machine check {file}`. Everything is SI: m, kg, s, N, N m, rad.",
        *(f"# {note}" for note in notes),
    ]
    head = [" ".join(line.split()) for line in lines]
    return "\n".join([*head, "", *_with_meanings(name, _dumped(tables))]) + "\n", notes


def _with_meanings(name: str, text: str) -> list[str]:
    """Return the lines of a machine file under another name, each key with unit and meaning."""
    lines = list[str]()
    record, header_of, open_list = "Machine", "", 0
    for line in text.splitlines():
        if header := HEADER.match(line):
            header_of = header[1]
            record = RECORDS.get("problems" if header_of.startswith("problems.") else header_of, "")
            lines.append(line if record else _explained(line, machine.MEANINGS["Machine"].get(header_of)))
            continue
        key = KEY.match(line)
        says = machine.MEANINGS.get(record, {}).get(key[1]) if key and not open_list else None
        open_list += 0 if line.lstrip().startswith("#") else line.count("[") - line.count("]")
        if key and not header_of and key[1] == "name":
            line = f'name = "{name}"'
        lines.append(_explained(line, says))
    return lines


EXTENDS = re.compile(r"^extends\s*=", re.MULTILINE)
HEADER = re.compile(r"^\[\[?([\w.-]+)\]\]?")
KEY = re.compile(r"^(\w+)\s*=")
COMMENT = re.compile(r"""^((?:"[^"]*"|[^"#])*)#\s*(.*)$""")
RECORDS = {  # of the tables of a machine file, by their headers
    "": "Machine",
    "body": "Body",
    "body.inertia": "Inertia",
    "body.friction": "Friction",
    "body.drive": "Drive",
    "body.spring": "Spring",
    "body.contact": "Contact",
    "body.limit": "JointLimit",
    "body.shape": "Shape",
    "world": "World",
    "world.shape": "Shape",
    "world.plane": "Plane",
    "world.box": "Box",
    "tool": "Tool",
    "sensor": "Sensor",
    "sensor.loop": "ForceLoop",
    "filter": "Filter",
    "problems": "Problem",
    "effect": "EffectEntry",
}


def _dumped(tables: dict[str, Any], header: str = "") -> str:
    """Write tables as TOML, quantities on one line each, tables of a machine file under their headers."""
    lines, below = [], []
    for key, value in tables.items():
        name = f"{header}.{key}".lstrip(".")
        of_names = not header and isinstance(value, dict) and "value" not in value  # [scale], [known] and so on
        own = of_names or name in RECORDS or header == "problems"
        if own and isinstance(value, list):
            below += [f"\n[[{name}]]\n{_dumped(one, name)}" for one in value]
        elif own and isinstance(value, dict):
            below.append(_dumped(value, name) if name == "problems" else f"\n[{name}]\n{_dumped(value, name)}")
        else:
            lines.append(f"{key} = {_toml(value)}\n")
    return "".join((*lines, *below))


def world_text(world: dict[str, Any]) -> str:
    """Return the text of [world] tables of a machine file, by key."""
    return _dumped(world, "world").strip()


def _explained(line: str, says: str | None) -> str:
    """Add a meaning to a line of TOML, before the comment that it has."""
    if says is None:
        return line
    there = COMMENT.match(line)
    if there and there[2] and there[2] in says:
        line, there = there[1], None  # the meaning has the comment's words
    code, rest = (there[1].rstrip(), f"; {there[2]}") if there else (line.rstrip(), "")
    return f"{code} # {says}{rest}"


def renamed(name: str, file: Path, like: Machine) -> str:
    """Return a file that extends a shipped machine, with columns to change. Raises MachineError."""
    _named(name)
    lines = [
        f"# {name}: the machine {like.name} with a logger of its own. Change columns and units to those of the log,",
        "# leave out sensors that are not there, then run",
        f"#     excite log check LOG --machine {file}",
        "# to find what is still wrong. Noise and sizes are in SI units, whatever the columns are in; `excite docs`",
        "# lists the units and all other keys. Add what else differs.",
        '# For a speed instead of an angle (unit = "rpm") delete counts_per_turn and give its noise [rad/s], say',
        '#     noise = { value = 0.01, source = "assumed" }',
        "",
        f'extends = "{like.name}"',
        f'name = "{name}"',
        'noise_unit = "SI"',
        f"sampling_hz = {_toml(like.sampling_hz.model_dump(exclude_defaults=True))} # of the logs",
        f'time_column = "{like.time_column}"',
        f'time_unit = "{like.time_unit}"',
    ]
    for sensor in like.sensor:
        keys = sensor.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        lines += ["", "[[sensor]]", *(f"{key} = {_toml(value)}" for key, value in keys.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    """Write a value on one line of a TOML file."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(inner) for inner in value) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _named(name: str) -> None:
    if not name.replace("_", "").replace("-", "").isalnum() or not name[0].isalpha() or not name.isascii():
        raise MachineError(f"{name}: a machine's name has letters, digits, _ and -, and begins with a letter")
    if name in machine.shipped_machines():
        raise MachineError(f"{name}: is the name of a shipped machine, choose another")
