"""Ctrl-C during calls of CasADi.

CasADi's Python wrapper drops a KeyboardInterrupt that arrives inside one of its calls: the call returns None in place
of a matrix, or raises NotImplementedError (CasADi 3.7, about a tenth of 230 interrupts). Without a check this looks
like a defect of the program or a failed run of a study.
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
    """Set once the user asked to stop."""

    def __init__(self) -> None:
        self.stop = False


@contextmanager
def watch_interrupts() -> Iterator[InterruptFlag]:
    """Note SIGINT and SIGTERM in the block, then pass them to the previous handlers (main thread only)."""
    flag = InterruptFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}

    def note(number: int, frame: FrameType | None) -> None:
        flag.stop = True
        before[signal.Signals(number)](number, frame)

    for number in before:
        signal.signal(number, note)
    try:
        yield flag
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is note:  # unless `ignore_interrupts` replaced it
                signal.signal(number, handler)


@contextmanager
def note_first_interrupt() -> Iterator[InterruptFlag]:
    """Note the first SIGINT in the block and go on; a second one has its usual effect (main thread only)."""
    flag = InterruptFlag()
    if threading.current_thread() is not threading.main_thread() or not callable(signal.getsignal(signal.SIGINT)):
        yield flag
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        if flag.stop and callable(before):
            before(number, frame)
        flag.stop = True

    signal.signal(signal.SIGINT, note)
    try:
        yield flag
    finally:
        if signal.getsignal(signal.SIGINT) is note:
            signal.signal(signal.SIGINT, before)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C from here on, while the program only waits for its processes to end."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def call_interruptible(call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Return the result of a call. Raises KeyboardInterrupt if the user asked to stop meanwhile."""
    with watch_interrupts() as flag:
        result = call(*args, **kwargs)
    if flag.stop:
        raise KeyboardInterrupt
    return result
