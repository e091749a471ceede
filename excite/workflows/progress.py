"""Progress of a workflow: the caller gives a bar, the workflow says how far it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

Advance = Callable[[int, int, float | None], None]  # done, total, best score so far
Bar = Callable[[str], AbstractContextManager[Advance]]  # opened with the name of what is being done


@contextmanager
def silent(label: str) -> Iterator[Advance]:
    """A bar that shows nothing."""
    yield lambda done, total, best: None
