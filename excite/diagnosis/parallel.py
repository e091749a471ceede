"""Work side by side in processes that share this one's memory, so that models need not be built again.

A forked process begins where this one stands: what it is to do is passed without copying, only its answer is sent, its
arrays in memory that this one maps. That takes milliseconds, where a fresh process takes seconds to load the program.
Forking is sound on Linux alone; elsewhere all is done in this process, with the same answer.
"""

from __future__ import annotations

import ctypes
import mmap
import multiprocessing
import os
import pickle
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

R = TypeVar("R")

PR_SET_PDEATHSIG = 1  # <linux/prctl.h>: the signal that a process gets when its parent ends
ALIGNED = 64  # bytes: where an array may begin
LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded before any fork


class Together(Protocol):
    """Carries out calls that have nothing to do with each other, and gives what they return in their order.

    A caller that wants no more of them closes what it got."""

    def __call__(self, calls: Sequence[Callable[[], R]], /) -> Generator[R, None, None]: ...


def cores() -> int:
    """How many processes pay; one where forking isn't sound."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1


def in_turn(calls: Sequence[Callable[[], R]]) -> Generator[R, None, None]:
    """What each call returns, one after the other in this process."""
    return (call() for call in calls)


def ahead(calls: Sequence[Callable[[], R]], together: Together) -> Generator[R, None, None]:
    """What calls return, where the first is set out upon at once if there are processes for it, while this one goes
    on."""
    ways: Generator[Any, None, None] = together([_nothing, *calls])
    next(ways)
    return ways


def _nothing() -> None:
    pass


def forked(calls: Sequence[Callable[[], R]]) -> Generator[R, None, None]:
    """The same from as many processes at a time as there are cores, in the order of the calls.

    What a process does not finish, because the call raises or something ends it, is done again in this one when its
    turn comes, and so is what no process can be had for. However this one ends, the others end too.
    """
    at_once = cores()
    if min(at_once, len(calls)) < 2:
        yield from in_turn(calls)
        return
    running: dict[Connection, tuple[int, _Worker]] = {}
    done: dict[int, R] = {}
    left: set[int] = set()  # to this process
    begun = 0
    try:
        for k in range(len(calls)):
            while k not in done:
                for number in range(begun, min(begun + at_once - len(running), len(calls))):
                    try:
                        worker = _started(calls[number], list(running))
                        running[worker.answer] = number, worker
                    except OSError:  # no memory, processes or files left
                        left.add(number)
                    begun += 1
                if k in left:
                    done[k] = calls[k]()
                    break
                ready = wait(list(running))
                for answer in [a for a in running if a in ready]:
                    number, worker = running[answer]
                    try:
                        done[number] = _received(worker)
                    except (EOFError, OSError):
                        left.add(number)
                    worker.process.join()
                    worker.close()
                    del running[answer]
            yield done.pop(k)
    finally:
        for _, worker in running.values():
            worker.process.kill()
            worker.process.join()
            worker.close()


@dataclass(frozen=True)
class _Worker:
    """A process at work, where its answer comes, and the file that takes the arrays of it."""

    process: BaseProcess
    answer: Connection
    arrays: int

    def close(self) -> None:
        self.answer.close()
        os.close(self.arrays)


def _started(call: Callable[[], R], others: Sequence[Connection]) -> _Worker:
    """A process at work. others: where the answers of earlier processes come."""
    fork = multiprocessing.get_context("fork")
    arrays = _file()
    try:
        answer, own = fork.Pipe(duplex=False)
    except OSError:
        os.close(arrays)
        raise
    with own:  # here it is closed in any case: the process has its own
        process = fork.Process(target=_carry, args=(call, own, arrays, [answer, *others], os.getpid()), daemon=True)
        worker = _Worker(process, answer, arrays)
        try:
            process.start()
        except OSError:
            worker.close()
            raise
    return worker


def _file() -> int:
    """A file in memory, or where a Python knows none, a temporary one without a name."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("answer")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _received(worker: _Worker) -> Any:
    """The answer of a process, its arrays where it left them. Raises EOFError or OSError where there is none."""
    rest, spans = worker.answer.recv()
    if not any(end > begin for begin, end in spans):
        return pickle.loads(rest, buffers=[bytearray()] * len(spans))
    # Private: what is written to an array is seen here alone. The memory, and a descriptor of it, lives as long as one
    # of the arrays.
    memory = memoryview(mmap.mmap(worker.arrays, 0, access=mmap.ACCESS_COPY))
    return pickle.loads(rest, buffers=[memory[a:b] for a, b in spans])


def _carry(
    call: Callable[[], object], answer: Connection, memory: int, others: Sequence[Connection], parent: int
) -> None:
    """In the forked process. It ends without the clean-up of a Python program: files and buffers are not its own."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the process that waits, which ends this one
        _end_with(parent)
        for read in others:  # a pipe breaks only when nobody can read it: this process must not keep any open
            read.close()
        arrays: list[pickle.PickleBuffer] = []
        rest = pickle.dumps(call(), 5, buffer_callback=arrays.append)
        spans: list[tuple[int, int]] = []
        with open(memory, "wb") as file:
            for array in arrays:
                begin = file.seek(-(-file.tell() // ALIGNED) * ALIGNED)
                spans.append((begin, begin + file.write(array.raw())))
        answer.send((rest, spans))
    finally:
        os._exit(0)


def _end_with(parent: int) -> None:
    """This process ends when its parent does, or the parent's thread that began it, whatever ends that."""
    if LIBC is not None:
        LIBC.prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL))
    if os.getppid() != parent:  # it had ended before
        os._exit(0)
