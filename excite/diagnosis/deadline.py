"""A budget of time: a search asks now and then if it is spent, and ends with the best so far."""

from __future__ import annotations

import time


class Deadline:
    """The time until which a search may go on.

    seconds: from now on, None for no end. reached: whether the search was cut short by it.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds, self.reached = seconds, False
        self._end = None if seconds is None else time.monotonic() + seconds

    def is_over(self) -> bool:
        """Tell if the time is spent, and remember that something asked too late."""
        over = self._end is not None and time.monotonic() > self._end
        self.reached = self.reached or over
        return over
