"""Where the table begins in rows of cells: header, units and other names below it, lines above that are no part."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from excite.model.machine import UNITS

COMMA = re.compile(r"\s*[+-]?(?:\d*|\d{1,3}(?:\.\d{3})+),\d+(?:[eE][+-]?\d+)?\s*")  # perhaps with points: 1.238,5
UNIT_WORDS = ("unit", "units", "einheit", "einheiten")  # what stands before a line of units
BRACKETED = re.compile(r"(.*?\S)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]")  # theta1 [deg]
UNIT_LIKE = re.compile(r"[^\W\d_][^\W_]{0,11}([ */^.-][^\W_]{1,6}){0,2}|[%\u2030]")  # no number of an element, no name
SPELLINGS = {
    "radian": "rad",
    "degree": "deg",
    "rad/sec": "rad/s",
    "deg/sec": "deg/s",
    "u/min": "rpm",
    "r/min": "rpm",
    "rev/min": "rpm",
    "hz": "Hz",
    "meter": "m",
    "metre": "m",
    "m/sec": "m/s",
    "kph": "km/h",
    "kmh": "km/h",
    "newton": "N",
    "n m": "N m",
    "kn m": "kN m",
    "ampere": "A",
    "amp": "A",
    "volt": "V",
    "sec": "s",
    "second": "s",
    "msec": "ms",
    "usec": "us",
    "days": "day",
}  # of units; written without case and without the s of a plural
WORD_LINES = 2  # lines of units and of other names below a header
LONGEST_UNIT = 12  # characters; what is longer is a name; chosen
ALIKE = 5  # rows below the first one of data that are looked at as well; chosen


@dataclass
class Layout:
    """Rows (from 0) of the header and of the first data, names of the columns, and what else the header says.

    units: by column; other: further names of columns -> the column.
    """

    header: int
    start: int
    names: list[str]
    units: dict[str, str] = field(default_factory=dict)
    other: dict[str, str] = field(default_factory=dict)


def is_numeric(cell: str) -> bool:
    """Tell whether a cell begins as a number, a date or a time does."""
    if _unit(cell) in UNITS:  # 1/min
        return False
    return bool(COMMA.fullmatch(cell)) or bool(re.match(r"^\s*[+-]?(\d|\.\d|nan\b|inf\b)", cell, re.IGNORECASE))


def is_data(cells: Sequence[str]) -> bool:
    """Tell whether cells are a row of data: the first that is not blank is a number or a time, and half of all are."""
    full = [cell for cell in cells if cell.strip()]
    return bool(full) and is_numeric(full[0]) and 2 * sum(map(is_numeric, full)) >= len(full)


def is_words(cells: Sequence[str]) -> bool:
    """Tell whether cells hold something, and none a number."""
    return any(cell.strip() for cell in cells) and not any(map(is_numeric, cells))


def width(cells: Sequence[str]) -> int:
    """Number of cells without the blank ones at the end."""
    n = len(cells)
    while n and not cells[n - 1].strip():
        n -= 1
    return n


def search(rows: Sequence[Sequence[str]], comments: Collection[int] = ()) -> Layout | None:
    """Find the table in rows of cells by its data: the header is above them, as wide as they are.

    comments: rows (from 0) that are comments, without their mark. None where nothing can be the header.
    """
    plain = [k for k in range(len(rows)) if k not in comments and width(rows[k])]
    data = {k: is_data(rows[k]) for k in plain}
    start = None
    for n, k in enumerate(plain):
        after = plain[n + 1 : n + 1 + ALIKE]
        alike = sum(data[j] and abs(len(rows[j]) - len(rows[k])) <= 1 for j in after)
        if data[k] and 2 * alike >= len(after):
            start = k
            break
    if start is None:
        return None
    first = [rows[k] for k in plain if start <= k][: 1 + ALIKE]
    most, least = max(map(len, first)), max(map(width, first))
    above = [k for k in range(start) if is_words(rows[k]) and least <= width(rows[k]) <= most]
    if not above:
        return None
    named = [k for k in above if not _are_units([cell.strip() for cell in rows[k]])] or above
    unique = [k for k in named if len({cell.strip() for cell in rows[k]}) == len(rows[k])]
    header = (unique or named)[-1]
    names = [cell.strip() for cell in rows[header]]
    units, other = beside_header(
        names, [rows[k] for k in above if k > header], [rows[k] for k in above if k < header and k not in comments]
    )
    return Layout(header, start, names, units, other)


def _unit(cell: str) -> str:
    return cell.strip(" []()")


def _are_units(cells: Sequence[str]) -> bool:
    """Tell whether cells are a line of units: one is known, or they stand after the word."""
    return cells[0].lower().strip(":") in UNIT_WORDS or any(_unit(cell) in UNITS for cell in cells)


def left_out(rows: Sequence[Sequence[str]], found: Layout) -> list[str]:
    """Say which rows between the header and the first one of data are left out: they hold numbers, or are more than
    lines of units and of other names would be."""
    between = [k for k in range(found.header + 1, min(found.start, len(rows))) if rows[k]]
    if len(between) <= WORD_LINES and not any(is_numeric(cell) for k in between for cell in rows[k]):
        return []
    lines = f"line {between[0] + 1}" if len(between) == 1 else f"lines {between[0] + 1} to {between[-1] + 1}"
    return [f"{lines}: no row of data yet, left out"]


def beside_header(
    names: Sequence[str], below: Sequence[Sequence[str]], above: Sequence[Sequence[str]] = ()
) -> tuple[dict[str, str], dict[str, str]]:
    """Take units by column, and other names of columns, from lines of words below and above the header."""
    units: dict[str, str] = {}
    other: dict[str, str] = {}
    known = set(names)
    best = max(below, key=lambda cells: sum(_unit(c) in UNITS for c in cells), default=None)
    for cells in (*below, *above):
        texts = [cell.strip() for cell in cells]
        counts = Counter(texts)
        for name, text in zip(names, texts, strict=False):
            unit, word = _unit(text), text.lower().strip(":") in UNIT_WORDS
            if cells is best and unit and not word and (unit in UNITS or len(unit) <= LONGEST_UNIT):
                units[name] = unit
            if text and not word and text not in known and counts[text] == 1 and unit not in UNITS:
                other.setdefault(text, name)
    return units, other


def known_unit(text: str) -> str:
    """The unit that a text means in any usual spelling, as UNITS has it; "" where none is meant."""
    plain = text.strip()
    if plain in UNITS:
        return plain
    plain = re.sub(r"\s*[\u00b7\u22c5*.\u2219-]\s*", " ", plain).replace("\u03bc", "u").replace("\u00b5", "u")
    words = (plain.lower(), plain.lower().removesuffix("s"))
    return next((u for u in (plain, *(SPELLINGS.get(word, "") for word in words)) if u in UNITS), "")


def bracketed_units(names: Sequence[str]) -> dict[str, str]:
    """Known units in brackets behind names, by column: theta1 [deg] -> deg."""
    matches = {name: BRACKETED.fullmatch(name) for name in names}
    return {name: unit for name, m in matches.items() if m is not None and (unit := known_unit(m.group(2)))}


def unknown_units(names: Sequence[str]) -> dict[str, str]:
    """Return what stands in brackets behind names and is no known unit, by column: vir [mV] -> [mV]."""
    matches = {name: BRACKETED.fullmatch(name) for name in names}
    return {
        name: name[m.end(1) :].strip()
        for name, m in matches.items()
        if m is not None and not known_unit(m.group(2)) and UNIT_LIKE.fullmatch(m.group(2))
    }


def without_units(names: Sequence[str]) -> dict[str, str]:
    """Names without a unit in brackets -> the column: theta1 -> theta1 [deg]."""
    bare = [(match.group(1), name) for name in names if (match := BRACKETED.fullmatch(name))]
    counts, known = Counter(own for own, _ in bare), set(names)
    return {own: name for own, name in bare if own not in known and counts[own] == 1}
