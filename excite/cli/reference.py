"""Reference pages made from the code: effects, machine file, choices, log files, commands, Python interface."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from pydantic import AfterValidator

import excite
from excite import identification, simulation, trajectories, workflows
from excite.cli import reference_html
from excite.logs import FORMATS
from excite.model import effects
from excite.model.effects import DEFAULT_DURATION, Effect, Shape, Site, unit_size
from excite.model.machine import MEANINGS, UNITS, FileRecord, Machine, load_machine, shipped_machines

MAX_SHAPE_SETS = 8  # sets of shapes that are listed one by one; chosen
LINK = re.compile(r"\[(\w+)\]\([^)]*\)")
SECTION = re.compile(r"^(Parameters|Returns|Raises|Example):\n", re.MULTILINE)  # of a docstring
PLAIN_DEFAULTS = (str, int, float, tuple, type(None))  # types of defaults that are shown
ADDRESS = re.compile(r"<(?:function |bound method |built-in function )?_?(\S+?)(?: object)? at 0x[0-9a-f]+>")
WORDS: Mapping[type, str] = {str: "text", int: "whole number", float: "number", bool: "true or false"}
FORMULA = re.compile(r"\S*[_=()]")  # begins with a formula or name, which keeps its small letter
PLACES = {
    "joints": "each joint with friction",
    "drives": "each driven joint",
    "contacts": "each contact with the ground",
    "driven_contacts": "each driven contact",
    "drive": "all driven contacts together; where it is the ground that changes, all contacts",
    "articulation": "each driven joint without a contact",
    "free_drives": "each driven joint of a machine that touches no ground",
    "links": "each joint away from the one before it, of a machine that touches no ground",
    "contact_group": "all contacts together",
    "wheels": "each measuring wheel",
    "wheel_pair": "all measuring wheels together",
    "yaw_rate": "the gyro",
    "lateral_speed": "the lateral speed sensor",
    "machine": "the machine as a whole",
}


def write(place: Path, app: typer.Typer) -> list[str]:
    """Write every page into a folder, and all of them as one `index.html`; return their names. app: the commands."""
    texts = {"commands.md": commands_page(app), **{name: page() for name, page in PAGES.items()}}
    texts = {name: ADDRESS.sub(r"\1", text) for name, text in texts.items()}  # without addresses in memory
    for name, text in texts.items():
        (place / name).write_text(text, encoding="utf-8")
    (place / reference_html.NAME).write_text(reference_html.page(texts), encoding="utf-8")
    return [reference_html.NAME, *texts]


def _table(heads: str, rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table. heads: separated by bars."""
    lines = [f"| {heads} |", "|" + "---|" * (heads.count("|") + 1)]
    return [*lines, *("| " + " | ".join(_cell(str(cell)) for cell in row) + " |" for row in rows), ""]


def _page(*lines: str) -> str:
    return "\n".join(lines).rstrip() + "\n"


# ------------------------------------------------------------------------------------------------ effects


def effects_page() -> str:
    """Write the page of effects: formula, places, magnitude and shapes, trace in a log, source."""
    catalogue, va12 = effects.CATALOGUE.values(), load_machine("va12")
    lines = [
        "# Effects",
        "",
        "What a real machine may do beyond the model. `excite diagnose` tests all of them, a machine file may",
        "contain them (`[[effect]]`), and `excite simulate MACHINE PROFILE --effect NAME[@WHERE]=MAGNITUDE` puts one",
        "into a log.",
        "In the formulas A is the magnitude in SI units, w a joint's speed, u its torque.",
        "",
        *_table("where | meaning", PLACES.items()),
        *_table(
            "effect | where | unit | meaning",
            ((f"[{e.name}](#{e.name})", ", ".join(e.places), e.unit, e.meaning) for e in catalogue),
        ),
    ]
    for e in catalogue:
        sites = effects.allowed_places(va12, e)
        sizes = {where: e.typical_magnitude(Site.of(va12, bodies)) for where, (bodies, _) in sites.items()}
        typical = [f"`{e.name}@{where}={size:.3g}`" for where, size in sizes.items()]
        lines += [f"## {e.name}", "", f"{_sentence(e.meaning)} {_magnitude(e)}", ""]
        lines += [f"Seen in a log: {e.signature.strip('.')}.", "", f"Source: {e.source.strip('.')}.", ""]
        if typical:
            lines += [f"Typical magnitudes on va12: {', '.join(typical)}", ""]
        if e.shapes:
            bodies, _ = next(iter(sites.values()), ((1,), ()))
            beside = e.extra_trials(Site.of(va12, bodies))
            lines += _table(
                "shape | unit | default | tried values | meaning",
                (_shape(n, s) for n, s in e.shapes.items()),
            )
            lines += (
                [f"Also tried, on va12 in a log of {DEFAULT_DURATION:g} s: {_shape_sets(beside)}.", ""]
                if beside
                else []
            )
    return _page(*lines)


def _magnitude(e: Effect) -> str:
    unit = "without unit" if e.unit == "-" else f"in {e.unit}"
    sign = ", positive" if e.positive else "; the smaller, the larger the effect" if e.inverse else ""
    return f"Magnitude {unit}{sign}."


def _shape(name: str, shape: Shape) -> tuple[str, str, str, str, str]:
    of = "" if shape.size is unit_size else " of the site's size"
    tried = ", ".join(f"{x:.3g}" for x in shape.grid) + of
    form = f"where {shape.form[0]} is {shape.form[1]:g}" if shape.form else ""
    ends = "from {:g} to {:g}".format(*shape.within) + of if shape.within else ""
    return name, shape.unit, f"{shape.default:.3g}{of}", tried, "; ".join(filter(None, (shape.meaning, ends, form)))


def _shape_sets(beside: Sequence[Mapping[str, float]]) -> str:
    """List sets of shapes; of many the first and the last."""
    listed = ["`" + ",".join(f"{name}={x:.3g}" for name, x in shapes.items()) + "`" for shapes in beside]
    return (
        "; ".join(listed) if len(listed) <= MAX_SHAPE_SETS else f"{listed[0]}; {listed[1]}; and so on to {listed[-1]}"
    )


# ------------------------------------------------------------------------------------------------ files


def machine_page() -> str:
    """Write the page of the machine file: every record with its keys, and the units of columns."""
    return _page(
        "# Machine file",
        "",
        'TOML; a file may say `extends = "va12"` and give only what differs: `[sensor.u1]` changes a sensor,',
        "`[body.front_roll.limit]` limits of a body. `excite machine new NAME` writes one with comments to start from.",
        "",
        *_keys(Machine),
        "## Units",
        "",
        "Units of columns in logs.",
        "",
        *_table("unit | quantity | SI value of one", ((u, quantity, f"{x:.9g}") for u, (quantity, x) in UNITS.items())),
    )


def study_page() -> str:
    """Write the page of the study file: every record with its keys."""
    return _page("# Study file", "", _doc(inspect.getmodule(workflows.Study)), "", *_keys(workflows.Study))


def study_keys() -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Yield the tables of a study file: title, and each key with what it takes, its names and its default."""
    titles = {"Study": "Keys of a study file", "Grid": "Keys of [grid]", "RandomSample": "More keys of [sample]"}
    seen: dict[str, str] = {}
    for record in _records(workflows.Study, set()):
        if record.__name__ not in titles:
            continue
        told = {}
        for name, field in record.model_fields.items():
            text = LINK.sub(r"\1", _type(field))
            text = text if '"' in text else workflows.help_with_choices(name, text)
            default = {"needed": "required"}.get(_default(field), _default(field).strip("`[](){}'-"))
            told[name] = f"{text}  [{default}]" if default else text
        yield titles[record.__name__], [(name, text) for name, text in told.items() if seen.get(name) != text]
        seen = told


def _keys(root: type[FileRecord]) -> Iterator[str]:
    """Yield the lines of a table of keys for a record and each record inside it."""
    for record in _records(root, set()):
        yield from (f"## {record.__name__}", "", _doc(record), "")
        said = MEANINGS.get(record.__name__, {})
        heads = "key | value | default" + " | meaning" * bool(said)
        keys = ((n, _type(f), _default(f)) for n, f in record.model_fields.items())
        yield from _table(heads, ((*k, *([said.get(k[0], "-")] if said else [])) for k in keys))


def _records(record: type[FileRecord], seen: set[type[FileRecord]]) -> Iterator[type[FileRecord]]:
    """Yield a record and those inside it, each once."""
    if record in seen:
        return
    seen.add(record)
    yield record
    for field in record.model_fields.values():
        for inner in _inside(field.annotation):
            yield from _records(inner, seen)


def _inside(annotation: Any) -> list[type[FileRecord]]:
    if isinstance(annotation, type) and issubclass(annotation, FileRecord):
        return [annotation]
    return [r for a in get_args(annotation) for r in _inside(a)]


def _type(field: Any) -> str:
    """Describe the type of a key in words."""
    return _worded(field.annotation) + _checked(field.metadata)


def _worded(annotation: Any) -> str:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _worded(inner[0]) + _checked(annotation.__metadata__)
    if origin is Literal:
        return ", ".join(f'"{x}"' for x in inner)
    if origin in (Union, types.UnionType):
        return " or ".join(_worded(a) for a in inner if a is not type(None))
    if origin is tuple:
        return f"list: {_worded(inner[0])}" if inner[-1] is Ellipsis else f"{len(inner)} x {_worded(inner[0])}"
    if origin is dict:
        return f"table, for each name: {_worded(inner[1])}"
    if isinstance(annotation, type) and issubclass(annotation, FileRecord):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    return WORDS.get(annotation, str(annotation))


def _checked(metadata: Iterable[Any]) -> str:
    """Describe the range of a value by the names of its checks."""
    names = [m.func.__name__.strip("_").replace("_", " ") for m in metadata if isinstance(m, AfterValidator)]
    return "".join(f", {name}" for name in names if name in ("positive", "not negative", "negative"))


def _default(field: Any) -> str:
    if field.is_required():
        return "needed"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, FileRecord):
        return "0" if getattr(value, "value", None) == 0 else "its own defaults"
    if isinstance(value, bool):
        return str(value).lower()
    return "-" if value in (None, "", (), {}) else f"`{list(value) if isinstance(value, tuple) else value}`"


# ------------------------------------------------------------------------------------------------ choices


def choices_page() -> str:
    """Write the page of names that commands and studies take: objectives, limits, methods, kits, usual drives."""
    every, yes = [load_machine(name) for name in shipped_machines()], {True: "yes", False: "no"}
    return _page(
        "# Choices",
        "",
        "## Objectives",
        "",
        "Scores of a drive by the information that it gives: `--objective`. Lower is better.",
        "",
        *_table(
            "objective | what it is | of | equations count by their noise",
            ((n, _what(o.function), o.of, yes[o.weighted]) for n, o in trajectories.OBJECTIVES.items()),
        ),
        "## Limits",
        "",
        "Every drive keeps them. The `limits` of a study are factors on the machine file's values.",
        "",
        *_table(
            "limit | bounded quantity | key in the machine file",
            (
                *(
                    (n, _what(k.bounds), ", ".join(f"`{s}`" for s in k.stated) or "-")
                    for n, k in trajectories.LIMITS.items()
                ),
                *((n, _what(whole), "-") for n, whole in trajectories.MOTION_LIMITS.items()),
            ),
        ),
        "## Methods",
        "",
        "Methods of identification: `--method`; by default `inverse` if every joint is driven, `joint` otherwise.",
        "",
        *_table(
            "method | what it does | effects that it estimates | needs the lateral speed",
            ((n, _what(m.find), m.effects, yes[not m.simulates]) for n, m in identification.METHODS.items()),
        ),
        "## Kits",
        "",
        "Sets of sensors: `--kit`.",
        "",
        *_table(
            "machine | kit | columns",
            ((m.name, kit, ", ".join(s.column for s in m.sensors(kit))) for m in every for kit in simulation.KITS),
        ),
        "## Usual drives",
        "",
        "`excite compare` compares a design with all of them, or those given by `--against`.",
        "",
        *_table(
            "drive | what it is | drawn at random",
            ((n, _what(u.make), yes[u.random]) for n, u in trajectories.BASELINES.items()),
        ),
    )


def _what(function: Callable[..., object]) -> str:
    """Return the first paragraph of a function's docstring."""
    return _doc(function).partition("\n\n")[0]


# ------------------------------------------------------------------------------------------------ commands, Python


def commands_page(app: typer.Typer) -> str:
    """Write the page of commands with their arguments and options."""
    lines = ["# Commands", "", "`excite COMMAND --help` shows the same.", ""]
    for name, command in _commands(typer.main.get_command(app), "excite"):
        lines += [f"## {name}", "", command.help or "", "", *_table("option | default | meaning", _options(command))]
    return _page(*lines)


def _options(command: Any) -> Iterator[tuple[str, str, str]]:
    for p in command.params:
        named = p.param_type_name == "option"
        label = ", ".join(f"`{o}`" for o in p.opts) if named else f"`{p.metavar or p.name.upper()}`"
        none = p.default is None or p.default is False or callable(p.default)
        yield (
            label,
            "needed" if p.required else "" if none else str(p.default),
            workflows.help_with_choices(p.name, getattr(p, "help", None)),
        )


def _commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    if not hasattr(command, "commands"):
        yield name, command
        return
    for key, inner in command.commands.items():
        yield from _commands(inner, f"{name} {key}")


def python_page() -> str:
    """Write the page of the Python interface: public functions and classes by package, with their docstrings."""
    lines = ["# Python interface", ""]
    for package in _packages(excite):
        lines += [f"## {package.__name__}", "", _doc(package), ""]
        for name in sorted(package.__all__):
            thing = getattr(package, name)
            if inspect.isfunction(thing) or inspect.isclass(thing):
                where = f"{package.__name__}.{name}"
                lines += [f"### {where}", "", "```python", _signature(name, thing), "```", ""]
                lines += [_sections(_doc(thing)), ""]
    return _page(*lines)


def _packages(package: ModuleType) -> Iterator[ModuleType]:
    """Yield a package and those inside it, except the command line, which has a page of its own."""
    yield package
    for found in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
        if found.ispkg and found.name != "cli":
            yield from _packages(importlib.import_module(f"{package.__name__}.{found.name}"))


def _signature(name: str, thing: Any) -> str:
    if inspect.isclass(thing):
        own = vars(thing)
        bases = ", ".join(b.__name__ for b in thing.__bases__ if b is not object)
        head = f"class {name}({bases})" if bases else f"class {name}"
        fields = [
            f"    {key}: {kind}" + (f" = {own[key]!r}" if isinstance(own.get(key, ...), PLAIN_DEFAULTS) else "")
            for key, kind in inspect.get_annotations(thing).items()
            if key[0] != "_"
        ]
        return "\n".join([head, *fields])
    try:
        text = str(inspect.signature(thing))
    except (TypeError, ValueError):
        return name
    return f"def {name}{text}".replace("'", "")


def _doc(thing: Any) -> str:
    own = thing.__doc__ if not inspect.isclass(thing) else thing.__dict__.get("__doc__")
    return inspect.cleandoc(own) if own else ""


def _sections(text: str) -> str:
    """Return a docstring with its parameters and errors as tables, and its example as code."""
    head, *rest = SECTION.split(text)
    parts = [head]
    for title, body in zip(rest[::2], map(inspect.cleandoc, rest[1::2]), strict=True):
        if title == "Example":
            parts += ["```python", body, "```", ""]
        elif title == "Returns":
            parts += [f"Returns: {' '.join(body.split())}", ""]
        else:
            rows = (tuple(row.partition(": ")[::2]) for row in re.split(r"\n(?=\S)", body))
            parts += _table(f"{title.lower()} | meaning", rows)
    return "\n".join(parts).strip()


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _sentence(text: str) -> str:
    text = text.strip()
    first = text if FORMULA.match(text) else text[:1].upper() + text[1:]
    return first + ("" if text.endswith(".") else ".")


# ------------------------------------------------------------------------------------------------ log files


def log_files_page() -> str:
    """Write the page of the formats of log files: endings, names of columns, extra to install."""
    rows = (
        (f.kind, ", ".join(f"`{s}`" for s in f.suffixes), f.columns, f"`{f.extra}`" if f.extra else "-")
        for f in FORMATS
    )
    return _page(
        "# Log files",
        "",
        "Formats that every command reads; an extra is installed by `pip install 'excite[EXTRA]'`. The folder of a bag",
        "of ROS 2 is given as it is. Text may have any usual separator, decimal commas, comments and lines of units.",
        "",
        *_table("format | endings | columns are named | extra", rows),
        "Columns that share a name are told apart by position: `u`, `u.1`; elements of a list in a cell are `q[0]`,",
        "`q[1]`.",
    )


PAGES: dict[str, Callable[[], str]] = {
    "machine-file.md": machine_page,
    "study-file.md": study_page,
    "choices.md": choices_page,
    "effects.md": effects_page,
    "python.md": python_page,
    "log-files.md": log_files_page,
}
