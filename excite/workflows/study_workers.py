"""Compute the tasks of a study on this computer (joblib) or on a cluster (Dask), also if workers die.

Tasks of a worker that dies are computed again; a task that kills every worker that has it alone is given up.
"""

from __future__ import annotations

import itertools
import logging
import signal
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import joblib

from excite.errors import WorkerError

MAX_DEATHS = 3  # of workers that had a task alone, before it is given up; chosen: workers die by other causes too
CHUNK_S = 0.5  # work sent to a worker of a cluster at once [s]; chosen: Dask takes a few milliseconds for it
CHUNKS_PER_WORKER = 2  # in flight: one being computed, one waiting
LOGGERS = ("distributed", "distributed.client")  # Dask's
SCHEDULER_GONE = "the cluster's scheduler is gone; start it and repeat the command"

T = TypeVar("T")
R = TypeVar("R")
Results = Generator[tuple[T, R | None], None, None]


def compute(
    call: Callable[[T], R], tasks: Iterable[T], jobs: int | None = None, cluster: str | None = None
) -> Results[T, R]:
    """Yield each task with the result of `call` as they come; tasks are taken from the iterable as needed.

    jobs: processes, all cores by default, 1 for this process. cluster: address of a Dask scheduler instead. The result
    is None for a task that killed its workers. Closing the generator ends the workers. Raises WorkerError, and the
    exceptions of `call`.
    """
    if cluster is not None:
        return _compute_on_cluster(call, iter(tasks), cluster)
    return _compute_here(call, iter(tasks), joblib.cpu_count() if jobs is None else jobs)


# ------------------------------------------------------------------------------------------------ this computer


def _compute_here(call: Callable[[T], R], tasks: Iterator[T], jobs: int) -> Results[T, R]:
    """Compute tasks in processes; what was in flight as one died is computed again, after a second death alone."""
    numbers, flying, again = itertools.count(), dict[int, tuple[T, bool]](), deque[T]()

    def take() -> Iterator[Any]:
        repeated = ((again.popleft(), True) for _ in range(len(again)))
        for task, before in itertools.chain(repeated, ((task, False) for task in tasks)):
            number = next(numbers)
            flying[number] = task, before
            yield joblib.delayed(_numbered)(call, number, task)

    while True:
        results = _parallel(jobs, return_as="generator_unordered", batch_size=1)(take())
        try:
            for number, value in results:
                yield flying.pop(number)[0], value
            return
        except BrokenExecutor:  # a worker died, and with it all that was in flight
            lost = list(flying.values())
            flying.clear()
            again.extend(task for task, before in lost if not before)
            yield from ((task, _compute_alone(call, task)) for task, before in lost if before)
        finally:
            with warnings.catch_warnings(action="ignore"):  # of tasks that are left when the user stops
                results.close()


def _parallel(jobs: int, **options: Any) -> joblib.Parallel:
    """Return processes with one BLAS thread each, so that results do not depend on the number of processes."""
    with joblib.parallel_config("loky", inner_max_num_threads=1, initializer=_ignore_interrupt):
        return joblib.Parallel(jobs, **options)


def _ignore_interrupt() -> None:
    """Ignore Ctrl-C in a worker: the main process ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _numbered(call: Callable[[T], R], number: int, task: T) -> tuple[int, R]:
    return number, call(task)


def _compute_alone(call: Callable[[T], R], task: T) -> R | None:
    """Compute a task in a process of its own, None if it dies MAX_DEATHS times."""
    for _ in range(MAX_DEATHS):
        with suppress(BrokenExecutor):
            (value,) = _parallel(2)([joblib.delayed(call)(task)])
            return value
    return None


# ------------------------------------------------------------------------------------------------ cluster


def _compute_on_cluster(call: Callable[[T], R], tasks: Iterator[T], address: str) -> Results[T, R]:
    """Send tasks in chunks. Dask repeats the work of a lost worker, up to four times."""
    with _connection(address) as client:
        from distributed import KilledWorker, as_completed

        done, flying, size = as_completed(loop=client.loop, with_results=True, raise_errors=False), {}, 1

        def send(chunk: list[T]) -> None:
            future = client.submit(_timed, call, chunk, pure=False)
            flying[future.key] = chunk
            done.add(future)

        while True:
            room = CHUNKS_PER_WORKER * max(1, sum(client.nthreads().values()))
            while len(flying) < room and (chunk := list(itertools.islice(tasks, size))):
                send(chunk)
            if not flying:
                return
            future, result = next(done)
            chunk = flying.pop(future.key)
            match result:  # a future's status may change once its worker dies
                case (values, seconds):
                    size = max(1, int(CHUNK_S * len(chunk) / max(seconds, 1e-3)))
                    yield from zip(chunk, values, strict=True)
                case (_, KilledWorker(), _) if len(chunk) == 1:
                    yield chunk[0], None
                case (_, KilledWorker(), _):
                    for task in chunk:
                        send([task])
                case (_, err, _):
                    raise err
                case _:
                    raise WorkerError(SCHEDULER_GONE)


def _timed(call: Callable[[T], R], chunk: list[T]) -> tuple[list[R], float]:
    begin = time.perf_counter()
    return [call(task) for task in chunk], time.perf_counter() - begin


@contextmanager
def _connection(address: str) -> Iterator[Any]:
    """Yield a client of a Dask scheduler. Raises WorkerError if it does not answer, or no longer."""
    try:
        import distributed
    except ImportError:
        raise WorkerError("--cluster needs Dask: pip install 'excite[cluster]'") from None
    levels = {logger: logger.level for logger in map(logging.getLogger, LOGGERS)}
    client = None
    try:
        for logger in levels:  # a lost connection is reported in one line instead
            logger.setLevel(logging.CRITICAL)
        try:
            client = distributed.Client(address, timeout=10, set_as_default=False)
            client.wait_for_workers(1, timeout=30)
        except (OSError, ValueError, TimeoutError) as err:
            raise WorkerError(f"--cluster {address}: no scheduler with a worker answers: {err}") from None
        try:
            yield client
        except Exception as err:
            if isinstance(err, OSError) or client.status != "running":
                raise WorkerError(SCHEDULER_GONE) from None
            raise
    finally:
        if client is not None:
            with suppress(Exception):  # the scheduler may be gone
                client.close(timeout=5)
        for logger, level in levels.items():
            logger.setLevel(level)
