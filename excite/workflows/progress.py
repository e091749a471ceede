"""Progress of a workflow, reported to a bar that the caller supplies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

Advance = Callable[[int, int, float | str | None], None]  # done, total, best score so far or what is being done
PROGRESS_VARIABLE = "EXCITE_PROGRESS"  # environment: with "json", commands report progress on stderr as JSON lines
Bar = Callable[[str], AbstractContextManager[Advance]]  # opened with the name of the work


@contextmanager
def no_bar(label: str) -> Iterator[Advance]:
    """Show nothing."""
    yield lambda done, total, best: None
