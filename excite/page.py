"""Self-contained web pages: the driver's aid and the reports. One file each, no network, from the templates."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup, escape

from excite import drive
from excite.drive import Trace
from model.prediction import Model
from model.units import UNITS

WORD, COMMAND, NUMBER = re.compile(r"a|[a-z]{3,},?"), re.compile("`([^`]+)`"), re.compile(r"[<≤]?\s*[-+−]?\d")
TIMES = re.compile(r" (in|for) [\d.]+ s| at \d+:[\d.]+")  # the page counts down, so its words need no times


@lru_cache(maxsize=1)
def templates() -> jinja2.Environment:
    loader = jinja2.PackageLoader("excite", "templates")
    made = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    made.filters["sentence"] = sentence
    return made


def sentence(text: str) -> Markup:
    """A remark as a page shows it: a capital letter first, unless it begins with a name, a full stop, `commands` set
    off."""
    first = text.partition(" ")[0]
    text = text[:1].upper() + text[1:] if WORD.fullmatch(first) else text
    whole = text if text.endswith((".", "!", "?", ":")) else f"{text}."
    return Markup(COMMAND.sub(r"<code>\1</code>", str(escape(whole))))


def driver_page(model: Model, trace: Trace, title: str, start: str = "") -> str:
    """The driver's aid: a moving reference of speed and steering, with the countdown to what comes next.

    It shows what was driven beside it, from a log in the machine's own columns or from `serve`, and scores it.
    start: where to place the machine, in words, shown until the drive begins.
    """
    return templates().get_template("driver.html").render(data={**driver_data(model, trace, title), "start": start})


def driver_data(model: Model, trace: Trace, title: str) -> dict[str, Any]:
    """What the page knows: the trace (angles in degrees, positive to the left), its phases in words, the columns."""
    machine = model.machine
    by_body = {s.body: s for s in machine.sensors("full") if s.kind == "angle"}
    rims = [
        {
            "column": by_body[b.index].column,
            "gain": float(b.contact.radius) * by_body[b.index].gain,
            "rate": by_body[b.index].is_rate,
        }
        for b in machine.contacts
        if b.contact is not None and b.index in by_body
    ]
    levers = []
    for lever, degrees in zip(trace.levers, trace.degrees.T, strict=True):
        sensor, degree = by_body.get(lever.body.index), lever.left * 180 / np.pi
        levers.append(
            {
                "name": lever.name,
                "said": lever.column,
                "column": sensor.column if sensor else "",
                "gain": degree * sensor.gain if sensor else 0.0,
                "rate": sensor is not None and sensor.is_rate,
                "degrees": degree,
                "values": degrees.tolist(),
            }
        )
    words = [drive.parts(trace, k) for k in range(len(trace))]
    words = [(TIMES.sub("", go), steer) for go, steer in words]
    return {
        "title": title,
        "times": trace.times.tolist(),
        "speed": trace.speed.tolist(),
        "levers": levers,
        "phases": [
            {"start": float(t), "go": go, "steer": steer}
            for t, (go, steer) in zip(trace.times[:-1], words, strict=True)
        ],
        "band": {"speed": drive.BAND_SPEED, "angle": float(np.rad2deg(drive.BAND_ANGLE)), "time": drive.BAND_S},
        "log": {"time": machine.time_column, "second": UNITS[machine.time_unit][1], "rims": rims},
    }


@dataclass(frozen=True)
class Picture:
    """A figure of a report: a file (.png, .svg) and what it shows, in a sentence with its units."""

    path: Path
    caption: str

    @property
    def kind(self) -> str:
        return {".png": "image/png", ".svg": "image/svg+xml"}[self.path.suffix]

    @property
    def data(self) -> str:
        return base64.b64encode(self.path.read_bytes()).decode("ascii")


@dataclass(frozen=True)
class Table:
    """A table of a report: cells are written as they are; `marked` rows (indices) are set off."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    marked: tuple[int, ...] = ()

    @property
    def texts(self) -> tuple[int, ...]:
        """Columns of words, which are set from the left; those of numbers from the right."""
        return tuple(k for k in range(len(self.columns)) if k == 0 or not any(_number(r[k]) for r in self.rows))

    def __post_init__(self) -> None:
        for k, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(f"table {self.caption!r}: row {k} has {len(row)} cells, not {len(self.columns)}")


def _number(cell: str) -> bool:
    return bool(NUMBER.match(cell))


def report_page(
    title: str,
    answer: str,
    figures: Sequence[Picture] = (),
    tables: Sequence[Table] = (),
    how: Mapping[str, str] | None = None,
    remarks: Sequence[str] = (),
) -> str:
    """A report as one printable file: the answer first, then figures, tables and how it was made.

    answer: one sentence; remarks: what else must be known, a line each; how: name -> value, `command` among them.
    """
    template = templates().get_template("report.html")
    return template.render(
        title=title, answer=answer, figures=figures, tables=tables, how=dict(how or {}), remarks=remarks
    )
