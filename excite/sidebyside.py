"""Work side by side in processes that share this one's memory, so that models need not be built again.

A forked process begins where this one stands: what it is to do is passed without copying, only its answer is sent. That
takes milliseconds, where a fresh process takes seconds to load the program. Forking is sound on Linux alone; elsewhere
all is done in this process, with the same answer.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Protocol, TypeVar

R = TypeVar("R")


class Together(Protocol):
    """Carries out calls that have nothing to do with each other, and gives what they return in their order."""

    def __call__(self, calls: Sequence[Callable[[], R]], /) -> Iterator[R]: ...


def cores() -> int:
    """How many processes pay; one where forking isn't sound."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1


def in_turn(calls: Sequence[Callable[[], R]]) -> Iterator[R]:
    """What each call returns, one after the other in this process."""
    return (call() for call in calls)


def forked(calls: Sequence[Callable[[], R]]) -> Iterator[R]:
    """The same from as many processes at a time as there are cores, in the order of the calls.

    What a process does not finish, because the call raises or something ends it, is done again in this one.
    """
    at_once = cores()
    if min(at_once, len(calls)) < 2:
        yield from in_turn(calls)
        return
    running: dict[Connection, tuple[int, BaseProcess]] = {}
    done: dict[int, R] = {}
    begun = 0
    try:
        for k in range(len(calls)):
            while k not in done:
                for number in range(begun, min(begun + at_once - len(running), len(calls))):
                    worker, answer = _started(calls[number])
                    running[answer] = number, worker
                    begun += 1
                ready = wait(list(running))
                for answer in [a for a in running if a in ready]:
                    number, worker = running.pop(answer)
                    try:
                        done[number] = answer.recv()
                    except (EOFError, OSError):
                        done[number] = calls[number]()
                    answer.close()
                    worker.join()
            yield done.pop(k)
    finally:
        for answer, (_, worker) in running.items():
            worker.kill()
            worker.join()
            answer.close()


def _started(call: Callable[[], R]) -> tuple[BaseProcess, Connection]:
    fork = multiprocessing.get_context("fork")
    answer, own = fork.Pipe(duplex=False)
    worker = fork.Process(target=_carry, args=(call, own), daemon=True)
    worker.start()
    own.close()
    return worker, answer


def _carry(call: Callable[[], object], answer: Connection) -> None:
    """In the forked process. It ends without the clean-up of a Python program: files and buffers are not its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the process that waits, which ends this one
    try:
        answer.send(call())
    finally:
        os._exit(0)
