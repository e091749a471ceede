"""Reference pages made from the code: effects, machine file, units, commands and the Python interface."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import excite
import model
from model import effects, units
from model import machine as machines
from model.machine import Machine, Record

HIDDEN = ("__main__",)
ADDRESS = re.compile(r"<(?:function |bound method |built-in function )?_?(\S+?)(?: object)? at 0x[0-9a-f]+>")


def write(place: Path) -> list[str]:
    """Writes every page into a folder; returns their names."""
    for name, page in PAGES.items():
        text = ADDRESS.sub(r"\1", page())  # where something lies in memory is no documentation
        (place / name).write_text(text, encoding="utf-8")
    return list(PAGES)


def effects_page() -> str:
    """The catalogue of effects: what each does, where it may sit, its amount and shapes, its trace in a log, source."""
    lines = [
        "# Effects",
        "",
        "What a real machine may do beyond the model. `excite simulate MACHINE PROFILE --effect NAME[@WHERE]=AMOUNT`",
        "puts one into a log; a machine file may hold it for good (`[[effect]]`). Amounts in SI units.",
        "",
        "| effect | where | unit | what it does |",
        "|---|---|---|---|",
    ]
    catalogue = effects.CATALOGUE
    for e in catalogue.values():
        lines.append(f"| [{e.name}](#{e.name}) | {', '.join(e.places)} | {e.unit} | {_cell(e.meaning)} |")
    va12 = machines.load("va12")
    for e in catalogue.values():
        lines += ["", f"## {e.name}", "", f"{_sentence(e.meaning)} Amount in {_unit(e.unit)}" + _sign(e) + "."]
        lines += ["", f"Seen in a log: {_sentence(e.signature)}", "", f"Source: {_sentence(e.source)}"]
        sites = effects.places(va12, e)
        if sites:
            shown = []
            for where, (bodies, _) in sites.items():
                site = effects.Site(va12, va12.find(bodies[0]), effects.DURATION)
                shown.append(f"`{e.name}@{where}={e.amount(site):.3g}`")
            lines += ["", f"On va12, at a typical size: {', '.join(shown)}"]
        if e.shapes:
            lines += ["", "| shape | unit | default | looked for at |", "|---|---|---|---|"]
            for name, shape in e.shapes.items():
                own = "" if shape.size is effects._one else " of the site's size"
                grid = ", ".join(f"{x:.3g}" for x in shape.grid)
                lines.append(f"| {name} | {shape.unit} | {shape.default:.3g}{own} | {grid}{own} |")
    return "\n".join(lines) + "\n"


def _sign(e: effects.Effect) -> str:
    if e.positive:
        return ", positive"
    return "; the smaller, the larger the effect" if e.inverse else ""


def machine_page() -> str:
    """The machine file: every record with its keys, and the units that columns may be in."""
    lines = ["# Machine file", "", 'TOML; a file may say `extends = "va12"` and give only what differs.', ""]
    for record in _records(Machine, set()):
        lines += [f"## {record.__name__}", "", _doc(record), "", "| key | type | default |", "|---|---|---|"]
        for name, field in record.model_fields.items():
            default = "needed" if field.is_required() else _cell(_plain(field.get_default(call_default_factory=True)))
            lines.append(f"| {name} | {_cell(_type(field.annotation))} | {default} |")
        lines.append("")
    lines += ["## Units", "", "| unit | quantity | SI value of one |", "|---|---|---|"]
    lines += [f"| {unit} | {quantity} | {value:.9g} |" for unit, (quantity, value) in units.UNITS.items()]
    return "\n".join(lines) + "\n"


def _records(record: type[Record], seen: set[type[Record]]) -> Iterator[type[Record]]:
    """A record and those inside it, each once."""
    if record in seen:
        return
    seen.add(record)
    yield record
    for field in record.model_fields.values():
        inner = _inside(field.annotation)
        if inner is not None:
            yield from _records(inner, seen)


def _inside(annotation: Any) -> type[Record] | None:
    if isinstance(annotation, type) and issubclass(annotation, Record):
        return annotation
    return next((r for a in getattr(annotation, "__args__", ()) if (r := _inside(a)) is not None), None)


def _type(annotation: Any) -> str:
    plain = isinstance(annotation, type) and not hasattr(annotation, "__args__")
    text = annotation.__name__ if plain else str(annotation)
    for noise in ("model.machine.", "typing.", "pathlib.", "<class '", "'>"):
        text = text.replace(noise, "")
    text = re.sub(r"Annotated\[(\w+), AfterValidator\(func=<function _(\w+) at 0x\w+>\)\]", r"\1 (\2)", text)
    text = text.replace("_", " ") if "(" in text else text
    return text if len(text) < 90 else text[:86] + " ..."


def _plain(value: Any) -> str:
    if isinstance(value, Record):
        return "value 0" if getattr(value, "value", None) == 0 else "its own defaults"
    return f"`{value}`"


def commands_page() -> str:
    """Every command with its arguments and options, as `--help` says them."""
    import typer

    from excite.__main__ import app

    lines = ["# Commands", "", "`excite COMMAND --help` says the same.", ""]
    for name, command in _commands(typer.main.get_command(app), "excite"):
        lines += [f"## {name}", "", command.help or "", "", "| option | default | what |", "|---|---|---|"]
        for p in command.params:
            named = p.param_type_name == "option"
            label = ", ".join(f"`{o}`" for o in p.opts) if named else f"`{p.metavar or p.name.upper()}`"
            default = "" if p.default in (None, False) or callable(p.default) else str(p.default)
            default = "needed" if p.required else default
            lines.append(f"| {label} | {default} | {_cell(getattr(p, 'help', None) or '')} |")
        lines.append("")
    return "\n".join(lines) + "\n"


def _commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    if not hasattr(command, "commands"):
        yield name, command
        return
    for key, inner in command.commands.items():
        yield from _commands(inner, f"{name} {key}")


def python_page() -> str:
    """Every public function and class of both packages, by module, with its docstring."""
    lines = ["# Python interface", ""]
    for package in (model, excite):
        for module in _modules(package):
            entries = list(_public(module))
            lines += [f"## {module.__name__}", "", _doc(module), ""]
            for name, thing in entries:
                where = f"{module.__name__.rpartition('.')[2]}.{name}"
                lines += [f"### {where}", "", "```python", _signature(name, thing), "```", "", _doc(thing), ""]
    return "\n".join(lines) + "\n"


def _modules(package: ModuleType) -> Iterator[ModuleType]:
    yield package
    for found in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
        if found.name not in HIDDEN:
            yield importlib.import_module(f"{package.__name__}.{found.name}")


def _public(module: ModuleType) -> Iterator[tuple[str, Any]]:
    """Functions and classes that the module itself defines."""
    for name, thing in vars(module).items():
        own = getattr(thing, "__module__", None) == module.__name__
        if own and not name.startswith("_") and (inspect.isfunction(thing) or inspect.isclass(thing)):
            yield name, thing


def _signature(name: str, thing: Any) -> str:
    if inspect.isclass(thing):
        bases = ", ".join(b.__name__ for b in thing.__bases__ if b is not object)
        head = f"class {name}({bases})" if bases else f"class {name}"
        fields = [f"    {key}: {kind}" for key, kind in inspect.get_annotations(thing).items() if key[0] != "_"]
        return "\n".join([head, *fields])
    try:
        text = str(inspect.signature(thing))
    except (TypeError, ValueError):
        return name
    return f"def {name}{text}".replace("'", "")


def _doc(thing: Any) -> str:
    own = thing.__doc__ if not inspect.isclass(thing) else thing.__dict__.get("__doc__")
    return inspect.cleandoc(own) if own else ""


def _cell(text: str) -> str:
    return " ".join(str(text).split()).replace("|", "\\|")


def _sentence(text: str) -> str:
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _unit(text: str) -> str:
    return "no unit" if text == "-" else text


PAGES: dict[str, Callable[[], str]] = {
    "effects.md": effects_page,
    "machine-file.md": machine_page,
    "commands.md": commands_page,
    "python.md": python_page,
}
