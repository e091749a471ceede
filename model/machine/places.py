"""Lines of a TOML file at which its keys stand."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]#]+?)\s*\]\]?\s*(#.*)?$")
KEY = re.compile(r"""^\s*((?:[\w-]+|"[^"]*")(?:\s*\.\s*(?:[\w-]+|"[^"]*"))*)\s*=""")
STRINGS = re.compile(r"""\"(?:\\.|[^"\\])*\"|'[^']*'|#.*""")
LISTS = ("body", "sensor")  # lists of tables, of whose items one may be named: [body.NAME]
Path = tuple[int | str, ...]


def key_lines(text: str) -> dict[Path, int]:
    """Return the line, from 1, of every table and key of a TOML file that is valid.

    A table of a list has its number in the path: ("body", 1, "inertia", "mass"). A table without a header of its own
    has the line of the first one in it; `body` and `sensor` have none.
    """
    lines: dict[Path, int] = {}
    counts: dict[Path, int] = {}
    table: Path = ()
    depth = 0  # of brackets that are open: a value that goes on

    def resolved(parts: Sequence[str]) -> Path:
        way: Path = ()
        for part in parts:
            way = (*way, part)
            if way in counts:
                way = (*way, counts[way])
        return way

    for number, line in enumerate(text.splitlines(), start=1):
        header = HEADER.match(line) if depth == 0 else None
        key = KEY.match(line) if depth == 0 and header is None else None
        if header is not None:
            parts = _parts(header[2])
            if header[1] == "[[":
                whole = (*resolved(parts[:-1]), parts[-1])
                counts[whole] = counts.get(whole, -1) + 1
            table = resolved(parts)
            lines[table] = number
            for n in range(2 if table[0] in LISTS else 1, len(table)):
                lines.setdefault(table[:n], number)
        elif key is not None:
            lines[(*table, *_parts(key[1]))] = number
        if header is None:
            bare = STRINGS.sub("", line)
            depth = max(0, depth + sum(bare.count(c) for c in "[{") - sum(bare.count(c) for c in "]}"))
    return lines


def line_of(lines: dict[Path, int], where: Path) -> int | None:
    """Return the line of a key, or of the nearest table or key above it; None if there is none."""
    return next((lines[where[:n]] for n in range(len(where), 0, -1) if where[:n] in lines), None)


def named(where: Sequence[int | str], raw: Any) -> Path:
    """Return a path with the names of listed tables in place of their numbers, as a file that extends writes them."""
    way: list[int | str] = []
    at = raw
    for step in where:
        try:
            at = at[step]
        except (KeyError, IndexError, TypeError):
            at = None
        name = at.get("name") if isinstance(step, int) and isinstance(at, dict) else None
        way.append(name if isinstance(name, str) else step)
    return tuple(way)


def _parts(dotted: str) -> list[str]:
    return [p.strip().strip('"') for p in dotted.split(".")]
