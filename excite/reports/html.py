"""Self-contained web pages: the driver's aid and the reports. One file each, no network, from the templates."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

WORD, COMMAND, NUMBER = re.compile(r"a|[a-z]{3,},?"), re.compile("`([^`]+)`"), re.compile(r"[<≤]?\s*[-+−]?\d")


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
