"""Web pages as single files that need no network, from the templates: the reports and the driver's page."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from excite.reports import charts
from excite.reports.description import Description, Table, as_sentence

COMMAND = re.compile("`([^`]+)`")


@lru_cache(maxsize=1)
def templates() -> jinja2.Environment:
    """Return the environment of the program's templates."""
    loader = jinja2.PackageLoader("excite", "templates")
    made = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    made.filters["sentence"] = sentence
    made.filters["script_source"] = script_source
    return made


def script_source(text: str) -> Markup:
    """Return what allows an inline script in a Content-Security-Policy: no other script of the page runs."""
    return Markup(f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'")


def sentence(text: str) -> Markup:
    """Return a remark as a sentence, with its `commands` set as code."""
    return Markup(COMMAND.sub(r"<code>\1</code>", str(escape(as_sentence(text)))))


@dataclass(frozen=True)
class Picture:
    """A figure of a report: a file (.png, .svg) and its caption, with units.

    chart: the same to zoom into, as `charts.documents` gives it, "" for none. whole: whether it shows all of it.
    folded: what the figure is called until it is opened, "" if it is always shown.
    """

    path: Path
    caption: str
    chart: str = ""
    whole: bool = False
    folded: str = ""

    @property
    def kind(self) -> str:
        return {".png": "image/png", ".svg": "image/svg+xml"}[self.path.suffix]

    @property
    def data(self) -> str:
        return base64.b64encode(self.path.read_bytes()).decode("ascii")


def report_page(
    title: str,
    answer: str,
    figures: Sequence[Picture] = (),
    tables: Sequence[Table] = (),
    how: Mapping[str, str] | None = None,
    remarks: Sequence[str] = (),
    status: str = "valid",
    verdict: str = "",
    scene: str = "",
    scene_script: str = "",
) -> str:
    """Render a printable report: the answer first, then remarks, figures, tables and how it was made.

    answer: one sentence, coloured by status (valid, doubtful or invalid); below the verdict, if there is one. remarks:
    a sentence each. how: name -> value, `command` among them. scene, scene_script: data and drawing of a motion.
    """
    own = Path(__file__).parents[1].joinpath("templates", "report.js").read_text(encoding="utf-8")
    library = [charts.library()] if any(figure.chart for figure in figures) else []
    template = templates().get_template("report.html")
    return template.render(
        title=title,
        answer=answer,
        verdict=verdict,
        figures=figures,
        tables=tables,
        how=dict(how or {}),
        remarks=remarks,
        status=status,
        scene=scene,
        scripts=[*library, own, *([scene_script] if scene else [])],
    )


def result_fragment(description: Description) -> str:
    """Render a result for a notebook: title, headline, tables, remarks, in the notebook's own style."""
    shown = description.status != "invalid"
    return (
        templates()
        .get_template("result.html")
        .render(
            title=description.title,
            answer=description.headline,
            tables=[one for one in description.tables if shown or not one.grey],
            remarks=description.closing,
        )
    )
