"""Compute pieces of work in this process, in processes of this computer, or on a Dask cluster.

All three are executors of `concurrent.futures`. A bounded number of pieces is in flight; pieces of a worker that dies
are computed again, and a piece that kills every worker is given up.
"""

from __future__ import annotations

import logging
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import joblib

from excite.errors import WorkerError

PIECES_PER_WORKER = 2  # in flight: one being computed, one waiting
MAX_DEATHS = (
    3  # of workers that had a piece alone, before the piece is given up; chosen: workers die by other causes too
)
LOGGERS = ("distributed", "distributed.client")  # Dask's
SCHEDULER_GONE = "the cluster's scheduler is gone; start it and repeat the command"
THREADS = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class PieceResult(Generic[T, R]):
    """Value of a piece of work, None if it killed its workers, and the time [s] it took."""

    piece: T
    value: R | None
    seconds: float


class Pool(Protocol):
    """Workers of some kind.

    shared: the death of one ends everything in flight. foreign: the workers have their own copy of the program.
    """

    shared: bool
    foreign: bool

    @property
    def size(self) -> int: ...
    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]: ...
    def died(self, err: BaseException) -> bool: ...
    def renew(self) -> None: ...


class _Inline(Executor):
    """An executor that computes at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as err:
            future.set_exception(err)
        return future


class ThisProcess:
    """This process as the only worker."""

    size, shared, foreign = 1, False, False

    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]:
        return _Inline().submit(call, *args)

    def died(self, err: BaseException) -> bool:
        return False

    def renew(self) -> None: ...


def _ignore_interrupt() -> None:
    """Ignore Ctrl-C in a worker: the main process ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class LocalProcesses:
    """Processes of this computer."""

    shared, foreign = True, False

    def __init__(self, jobs: int) -> None:
        self.size = jobs
        self.renew()

    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]:
        return self._executor.submit(call, *args)

    def died(self, err: BaseException) -> bool:
        return isinstance(err, BrokenExecutor)

    def renew(self) -> None:
        from joblib.externals.loky import get_reusable_executor

        # One BLAS thread each, so that results do not depend on the number of workers.
        self._executor: Executor = get_reusable_executor(
            max_workers=self.size, timeout=60, env=THREADS, initializer=_ignore_interrupt
        )

    def close(self) -> None:
        """End the processes, killing those at work."""
        self._executor.shutdown(wait=True, kill_workers=True)  # type: ignore[call-arg]


class DaskCluster:
    """Workers of a Dask scheduler, which repeats the work of a lost worker itself."""

    shared, foreign = False, True

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError:
            raise WorkerError("--cluster needs Dask: pip install 'excite[cluster]'") from None
        self._levels = {logger: logger.level for logger in map(logging.getLogger, LOGGERS)}
        for logger in self._levels:  # a lost connection is reported in one line instead
            logger.setLevel(logging.CRITICAL)
        try:
            client: Any = distributed.Client  # has no types
            self._client = client(address, timeout=10, set_as_default=False)
            self._client.wait_for_workers(1, timeout=30)
        except (OSError, ValueError, TimeoutError) as err:
            self._loud()
            raise WorkerError(f"--cluster {address}: no scheduler with a worker answers: {err}") from None
        self._executor = self._client.get_executor(pure=False)

    @property
    def size(self) -> int:
        with self._asked():
            return max(1, sum(self._client.nthreads().values()))

    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]:
        with self._asked():
            return self._executor.submit(call, *args)

    @contextmanager
    def _asked(self) -> Iterator[None]:
        """Turn any failure of a call to a lost scheduler into a WorkerError."""
        try:
            yield
        except Exception as err:
            if isinstance(err, OSError) or self._client.status != "running":
                raise WorkerError(SCHEDULER_GONE) from None
            raise

    def died(self, err: BaseException) -> bool:
        from distributed import KilledWorker

        return isinstance(err, KilledWorker)

    def renew(self) -> None: ...

    def close(self) -> None:
        with suppress(Exception):  # the scheduler may be gone
            self._client.close(timeout=5)
        self._loud()

    def _loud(self) -> None:
        for logger, level in self._levels.items():
            logger.setLevel(level)


@contextmanager
def open_pool(jobs: int | None = None, cluster: str | None = None) -> Iterator[Pool]:
    """Open workers: `jobs` processes (all cores by default; 1: this process), or those of a cluster.

    Raises WorkerError.
    """
    if cluster is not None:
        remote = DaskCluster(cluster)
        try:
            yield remote
        finally:
            remote.close()
        return
    jobs = joblib.cpu_count() if jobs is None else jobs
    if jobs < 1:
        raise ValueError(f"jobs: must be at least 1 (got {jobs})")
    if jobs == 1:
        yield ThisProcess()
        return
    local = LocalProcesses(jobs)
    try:
        yield local
    finally:
        local.close()


def _timed(call: Callable[[T], R], piece: T) -> tuple[R, float]:
    begin = time.perf_counter()
    return call(piece), time.perf_counter() - begin


def run_pieces(
    call: Callable[[T], R], pieces: Iterable[T], workers: Pool, split: Callable[[T], list[T]] = lambda piece: [piece]
) -> Iterator[PieceResult[T, R]]:
    """Yield the results of `call` on pieces as they come; pieces are taken from the iterable as needed.

    After the death of a worker, pieces in flight are split and computed again one at a time. A piece that kills
    MAX_DEATHS workers alone comes back without a value. Raises WorkerError, and the exceptions of `call`.
    """
    source = iter(pieces)
    suspects: deque[tuple[T, int]] = deque()
    flying: dict[Future[tuple[R, float]], tuple[T, int]] = {}
    while True:
        room = 1 if suspects else PIECES_PER_WORKER * workers.size
        while len(flying) < room:
            if suspects:
                piece, deaths = suspects.popleft()
            else:
                try:
                    piece, deaths = next(source), 0
                except StopIteration:
                    break
            try:
                flying[workers.submit(_timed, call, piece)] = piece, deaths
            except BrokenExecutor:  # the pool died before it got the piece
                workers.renew()
                suspects.append((piece, deaths))
            if suspects:
                room = 1
        if not flying:
            return
        alone = len(flying) == 1
        done, _ = wait(flying, return_when=FIRST_COMPLETED)
        dead = False
        for future in done:
            piece, deaths = flying.pop(future)
            try:
                value, seconds = future.result()
            except CancelledError:
                raise WorkerError(SCHEDULER_GONE) from None
            except Exception as err:
                if not workers.died(err):
                    raise
                dead = True
                parts = split(piece)
                if len(parts) > 1:
                    suspects += [(p, 0) for p in parts]
                elif alone and deaths + 1 >= MAX_DEATHS:
                    yield PieceResult(piece, None, 0.0)
                else:
                    suspects.append((piece, deaths + alone))
            else:
                yield PieceResult(piece, value, seconds)
        if dead and workers.shared:
            suspects += [(p, deaths) for piece, deaths in flying.values() for p in split(piece)]
            flying.clear()
            workers.renew()
