"""Ctrl-C that doesn't get lost.

CasADi's Python wrapper drops a KeyboardInterrupt that falls into one of its calls: what comes back is a None in the
place of a matrix, or a NotImplementedError about the number of arguments (seen with 3.7 in about a tenth of 230
interrupts). Taken at its word that is a defect of the program, or a run of a study that failed.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import ParamSpec, TypeVar

SIGNALS = (signal.SIGINT, signal.SIGTERM)

P = ParamSpec("P")
R = TypeVar("R")


class InterruptFlag:
    """Whether somebody asked to stop."""

    def __init__(self) -> None:
        self.stop = False


@contextmanager
def watch_interrupts() -> Iterator[InterruptFlag]:
    """Notes Ctrl-C and a polite kill within, and leaves them to the handlers that were there (main thread only)."""
    said = InterruptFlag()
    if threading.current_thread() is not threading.main_thread():
        yield said
        return
    before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}

    def note(number: int, frame: FrameType | None) -> None:
        said.stop = True
        before[signal.Signals(number)](number, frame)

    for number in before:
        signal.signal(number, note)
    try:
        yield said
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is note:  # not deaf by now
                signal.signal(number, handler)


def ignore_interrupts() -> None:
    """From here on Ctrl-C is ignored: the program is at its end, and waits for its processes alone."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def call_interruptible(call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """What a call returns, where nobody asked to stop meanwhile. Raises KeyboardInterrupt where somebody did."""
    with watch_interrupts() as said:
        result = call(*args, **kwargs)
    if said.stop:
        raise KeyboardInterrupt
    return result
