"""Run calls side by side in forked processes that share this process's memory, so that models need not be built again.

A forked process starts within milliseconds; a fresh one takes seconds to load the program. It needs no copy of its
input. Only its answer is sent back, arrays in memory that this process maps. Forking is sound on Linux alone; elsewhere
all calls run in this process, with the same answers.
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

import joblib

R = TypeVar("R")

PR_SET_PDEATHSIG = 1  # from <linux/prctl.h>: signal that a process gets when its parent ends
ARRAY_ALIGNMENT = 64  # alignment of arrays [bytes]: a cache line
LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded before any fork


class CallRunner(Protocol):
    """Runs independent calls and yields their results in order.

    A caller that wants no more results closes the generator.
    """

    def __call__(self, calls: Sequence[Callable[[], R]], /) -> Generator[R, None, None]: ...


def usable_cores() -> int:
    """Return the number of processes that pay, also in a container with a quota; one where forking is not sound."""
    return joblib.cpu_count() if sys.platform == "linux" else 1


def run_in_turn(calls: Sequence[Callable[[], R]]) -> Generator[R, None, None]:
    """Run calls one after the other in this process."""
    return (call() for call in calls)


def run_forked(calls: Sequence[Callable[[], R]]) -> Generator[R, None, None]:
    """Run calls in as many forked processes at a time as there are cores, and yield results in order.

    A call that a process does not finish, because it raises or the process ends, is repeated here in its turn; so is a
    call for which no process can be had. However this process ends, the others end too.
    """
    n_processes = usable_cores()
    if min(n_processes, len(calls)) < 2:
        yield from run_in_turn(calls)
        return
    running: dict[Connection, tuple[int, _Worker]] = {}
    done: dict[int, R] = {}
    to_repeat: set[int] = set()  # calls that this process must run
    started = 0
    try:
        for k in range(len(calls)):
            while k not in done:
                for number in range(started, min(started + n_processes - len(running), len(calls))):
                    try:
                        worker = _start_worker(calls[number], list(running))
                        running[worker.answer] = number, worker
                    except OSError:  # no memory, processes or files left
                        to_repeat.add(number)
                    started += 1
                if k in to_repeat:
                    done[k] = calls[k]()
                    break
                ready = wait(list(running))
                for answer in [a for a in running if a in ready]:
                    number, worker = running[answer]
                    try:
                        done[number] = _receive(worker)
                    except (EOFError, OSError):
                        to_repeat.add(number)
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
    """A running process, the pipe of its answer, and the file that takes the answer's arrays."""

    process: BaseProcess
    answer: Connection
    arrays: int

    def close(self) -> None:
        self.answer.close()
        os.close(self.arrays)


def _start_worker(call: Callable[[], R], others: Sequence[Connection]) -> _Worker:
    """Start a process for a call. others: pipes of earlier processes."""
    fork = multiprocessing.get_context("fork")
    arrays = _memory_file()
    try:
        answer, own = fork.Pipe(duplex=False)
    except OSError:
        os.close(arrays)
        raise
    with own:  # close this process's copy in any case
        process = fork.Process(
            target=_run_worker, args=(call, own, arrays, [answer, *others], os.getpid()), daemon=True
        )
        worker = _Worker(process, answer, arrays)
        try:
            process.start()
        except OSError:
            worker.close()
            raise
    return worker


def _memory_file() -> int:
    """Open a file in memory, or a temporary file without a name where Python has none."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("answer")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _receive(worker: _Worker) -> Any:
    """Return the answer of a process, with its arrays in mapped memory. Raises EOFError or OSError if there is none."""
    rest, spans = worker.answer.recv()
    if not any(end > begin for begin, end in spans):
        return pickle.loads(rest, buffers=[bytearray()] * len(spans))
    # A private mapping: writing to an array changes this process's copy alone. It lives as long as one of the arrays.
    memory = memoryview(mmap.mmap(worker.arrays, 0, access=mmap.ACCESS_COPY))
    return pickle.loads(rest, buffers=[memory[a:b] for a, b in spans])


def _run_worker(
    call: Callable[[], object], answer: Connection, memory: int, others: Sequence[Connection], parent: int
) -> None:
    """Run a call in the forked process and send its answer.

    The process ends without Python's clean-up, since files and buffers belong to its parent.
    """
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Ctrl-C the waiting parent ends this process
        _end_with_parent(parent)
        for read in others:  # a pipe breaks only when no process can read it
            read.close()
        arrays: list[pickle.PickleBuffer] = []
        rest = pickle.dumps(call(), 5, buffer_callback=arrays.append)
        spans: list[tuple[int, int]] = []
        with open(memory, "wb") as file:
            for array in arrays:
                begin = file.seek(-(-file.tell() // ARRAY_ALIGNMENT) * ARRAY_ALIGNMENT)
                spans.append((begin, begin + file.write(array.raw())))
        answer.send((rest, spans))
    finally:
        os._exit(0)


def _end_with_parent(parent: int) -> None:
    """Let this process end when its parent, or the thread that forked it, ends for any reason."""
    if LIBC is not None:
        LIBC.prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL))
    if os.getppid() != parent:  # the parent had ended before
        os._exit(0)
