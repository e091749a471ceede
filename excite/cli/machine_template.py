"""A machine file to start from: a commented template, or a shipped machine with columns to change."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jinja2

from excite import output
from excite.errors import MachineError
from excite.model import machine
from excite.model.machine import Machine

TEMPLATE = "machine.toml"


def start(name: str, file: Path, like: str | None = None) -> None:
    """Write the template, or a copy of the shipped machine `like` with its columns to change.

    Raises MachineError for an existing file or an impossible name.
    """
    text = fresh(name, file) if like is None else renamed(name, file, machine.load_machine(like))
    if file.exists():
        raise MachineError(f"{file}: exists already, give another --out")
    with output.new_file(file) as place:
        place.write_text(text, encoding="utf-8")


def fresh(name: str, file: Path) -> str:
    """Return the commented template. Raises MachineError for an impossible name."""
    _named(name)
    text = jinja2.Environment(
        loader=jinja2.PackageLoader("excite", "templates"), keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    ).get_template(TEMPLATE)
    return text.render(name=name, title=name.replace("_", " ").replace("-", " "), file=file)


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
    return json.dumps(value, ensure_ascii=False)


def _named(name: str) -> None:
    if not name.replace("_", "").replace("-", "").isalnum() or not name[0].isalpha() or not name.isascii():
        raise MachineError(f"{name}: a machine's name has letters, digits, _ and -, and begins with a letter")
    if name in machine.shipped_machines():
        raise MachineError(f"{name}: is the name of a shipped machine, choose another")
