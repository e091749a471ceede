"""The description of a result: title, headline, tables, remarks, verdict; and what several kinds say alike."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from excite.text import format_number, format_percent
from excite.trajectories import TOLERANCE

Summary = Mapping[str, Any]

# A word that a sentence may begin with in a capital letter; a name stays as it is.
WORD = re.compile(r"a|no|[a-z]{3,},?")
NUMBER = re.compile(r"[<≤]?\s*[-+−]?\d")


@dataclass(frozen=True)
class Table:
    """A table of text cells.

    marked: rows (indices) that are set off. optional: columns (indices) that a narrow terminal leaves out. grey: not
    to be relied on.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    marked: tuple[int, ...] = ()
    optional: tuple[int, ...] = ()
    grey: bool = False

    @property
    def text_columns(self) -> tuple[int, ...]:
        """Columns of words, aligned left; columns of numbers are aligned right."""
        return tuple(
            k for k in range(len(self.columns)) if k == 0 or not any(NUMBER.match(row[k]) for row in self.rows)
        )

    def __post_init__(self) -> None:
        for k, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(f"table {self.caption!r}: row {k} has {len(row)} cells, not {len(self.columns)}")


@dataclass(frozen=True)
class Description:
    """A result for people.

    title: what it is. headline: the answer in a sentence. remarks: what else the reader must know, a sentence each.
    status: `valid`, `doubtful` or `invalid`. verdict: what to think of it and do, the last sentence, "" for none.
    """

    title: str
    headline: str
    tables: tuple[Table, ...] = ()
    remarks: tuple[str, ...] = ()
    status: str = "valid"
    verdict: str = ""

    @property
    def closing(self) -> tuple[str, ...]:
        """The remarks and the verdict."""
        return (*self.remarks, f"Verdict: {self.verdict}") if self.verdict else self.remarks


def as_sentence(text: str) -> str:
    """Begin a remark with a capital letter, unless it begins with a name, and end it with a full stop."""
    first = text.partition(" ")[0]
    text = text[:1].upper() + text[1:] if WORD.fullmatch(first) else text
    return text if text.endswith((".", "!", "?", ":")) else f"{text}."


def describe_outside_law(share: float | None) -> tuple[str, ...]:
    """Return a remark on the share of samples that lie outside the linear soil law, none if there are no such."""
    if not share:
        return ()
    return (
        f"In {format_percent(100 * share)} of the samples a contact slips more than its slip_limit, up to which the"
        " linear soil law holds: real ground gives less force there than the model says.",
    )


def describe_violations(
    violations: Mapping[str, float], said: Mapping[str, str] | None = None, tolerance: float = TOLERANCE
) -> str:
    """Name the limits that are exceeded by more than the tolerance, the worst first, "" if there is none.

    said: what is said of a limit instead of a share of its range, as from `trajectories.excesses_in_units`.
    """
    said = said or {}
    over = sorted(((v, n) for n, v in violations.items() if v > tolerance), reverse=True)
    lines = [said[n] for _, n in over if n in said][:MAX_NAMES]
    shares = [f"{n} by {format_percent(100 * v)}" for v, n in over if n not in said]
    return "; ".join([*lines, *([f"{join_some(shares)} of the range"] if shares else [])])


def describe_drive_faults(s: Summary) -> tuple[str, ...]:
    """Return a line on the limits that a simulated drive breaks, and one on its samples outside the soil law."""
    over = describe_violations(s["violations"], s.get("excesses"))
    return (*((f"limits broken: {over}",) if over else ()), *describe_outside_law(s["share_outside_law"]))


def meaning_column(s: Summary) -> tuple[str, ...]:
    """Return the heading of the column that explains parameters, if the summary does."""
    return ("what it is",) if s.get("meanings") else ()


def meaning(s: Summary, name: str) -> tuple[str, ...]:
    """Return the cell of that column for a parameter."""
    return (s["meanings"].get(name, "-"),) if s.get("meanings") else ()


def meaning_index(s: Summary) -> tuple[int, ...]:
    """Return the index of that column, which a narrow terminal leaves out."""
    return (1,) if s.get("meanings") else ()


MAX_NAMES = 4  # parameters that a headline names


def join_some(names: Sequence[str]) -> str:
    """Join the first names, and count the others."""
    shown = ", ".join(names[:MAX_NAMES])
    return shown if len(names) <= MAX_NAMES else f"{shown} and {len(names) - MAX_NAMES} more"


def format_sum(parts: Mapping[str, float]) -> str:
    """Write the sum that a base parameter stands for: "MX0 + 1.45 M3"."""
    text = ""
    for name, c in parts.items():
        text += ("-" if not text else " - ") if c < 0 else " + " if text else ""
        text += name if abs(abs(c) - 1) < 1e-9 else f"{format_number(abs(c), 4)} {name}"
    return text
