"""The command line in this process."""

from __future__ import annotations

from typing import Protocol


class Excite(Protocol):
    """Runs a command in this process: exit code, stdout, stderr."""

    def __call__(self, *args: object) -> tuple[int, str, str]: ...
