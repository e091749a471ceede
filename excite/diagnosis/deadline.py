"""The end of a search: it asks now and then if its time is spent or it shall stop, and ends with the best so far."""

from __future__ import annotations

import time
from collections.abc import Callable


class Deadline:
    """The time until which a search may go on.

    seconds: from now on, None for no end. should_stop: tells if it shall end at once. reached: whether the search was
    cut short.
    """

    def __init__(self, seconds: float | None = None, should_stop: Callable[[], bool] = lambda: False) -> None:
        self.seconds, self.reached, self.should_stop = seconds, False, should_stop
        self._end = None if seconds is None else time.monotonic() + seconds

    def is_over(self) -> bool:
        """Tell if the search must end, and remember that something asked too late."""
        over = self.should_stop() or (self._end is not None and time.monotonic() > self._end)
        self.reached = self.reached or over
        return over
