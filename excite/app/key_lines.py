"""Lines of a machine file that messages of its check are about."""

from __future__ import annotations

import re
import tomllib
from itertools import takewhile
from typing import Any

from excite.model.machine import key_lines, named

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
    lines, tables = key_lines(text), _tables(text)

    def found(path: tuple[int | str, ...]) -> int:
        steps = {str(step) for step in (*path, *named(path, tables))}
        return sum(word in steps for word in words)

    best = max(lines, key=found, default=())
    return lines[best] if best and found(best) else None


def _tables(text: str) -> dict[str, Any]:
    """Return the content of a TOML file, nothing if it is no TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}
