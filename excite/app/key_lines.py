"""Lines of a machine file that messages of its check are about."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import takewhile

HEADER = re.compile(r"\s*\[{1,2}([^\[\]]+)\]{1,2}\s*(#.*)?$")
KEY = re.compile(r"\s*([\w.\"-]+)\s*=")
NAME = re.compile(r"\s*name\s*=\s*[\"']([^\"']+)[\"']")
WORD = re.compile(r"[A-Za-z_]\w*|(?<=\[)\d+(?=\])")
AT_LINE = re.compile(r"^line (\d+): |\(at line (\d+)")  # of the check, of tomllib


def find_line(text: str, message: str) -> int | None:
    """Return the line (from 1) of a machine file that a message is about, None if it names no key of the file.

    The message gives its line, or begins with the path of a key, such as `front_roll: contact.Kx: ...` or
    `body[1].limit.torque: ...`; the line whose path has most of these words counts, of several the first.
    """
    said = AT_LINE.search(message)
    if said:
        return int(said[1] or said[2])
    keys = takewhile(lambda part: " " not in part, message.split(": ")[:-1])
    words = list(dict.fromkeys(word for part in keys for word in WORD.findall(part)))
    best, place = 0, None
    for number, path in _paths(text):
        found = sum(word in path for word in words)
        if found > best:
            best, place = found, number
    return place


def _paths(text: str) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield each line with a header or key, and the words of its path: tables, names and indices of entries, key."""
    lines = text.splitlines()
    table: tuple[str, ...] = ()
    entries: dict[str, int] = {}
    entry: dict[str, tuple[str, ...]] = {}
    for k, line in enumerate(lines):
        header, key = HEADER.match(line), KEY.match(line)
        if header:
            table = tuple(p.strip().strip("\"'") for p in header[1].split("."))
            if line.lstrip().startswith("[["):
                entries[table[0]] = entries.get(table[0], -1) + 1
                entry[table[0]] = (str(entries[table[0]]), *_name_below(lines[k + 1 :]))
            table = (table[0], *entry.get(table[0], ()), *table[1:])
            yield k + 1, table
        elif key:
            yield k + 1, (*table, *(p.strip("\"'") for p in key[1].split(".")))


def _name_below(lines: list[str]) -> Iterator[str]:
    """Yield the name that the keys below a header give."""
    for line in lines:
        if HEADER.match(line):
            return
        found = NAME.match(line)
        if found:
            yield found[1]
            return
