"""Where work is computed: in this process, in processes of this machine, or on a Dask cluster.

All three are executors of `concurrent.futures`; what is here keeps a bounded number of pieces in flight, sees to it
that a worker that dies costs no result, and finds the piece that kills every worker that takes it.
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

PIECES_PER_WORKER = 2  # pieces in flight per worker: one at work, one at hand
MAX_DEATHS = 3  # deaths of a worker that had a piece alone before the piece is to blame: others kill workers too
LOGGERS = ("distributed", "distributed.client")  # of Dask, with levels of their own
SCHEDULER_GONE = "the cluster's scheduler is gone; start it and repeat the command"
THREADS = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class PieceResult(Generic[T, R]):
    """What came of a piece of work, in so many seconds; value None where it killed its workers."""

    piece: T
    value: R | None
    seconds: float


class Pool(Protocol):
    """Workers, and what to do where they die.

    shared: one's death is the end of all that is in flight; foreign: they have a program of their own.
    """

    shared: bool
    foreign: bool

    @property
    def size(self) -> int: ...
    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]: ...
    def died(self, err: BaseException) -> bool: ...
    def renew(self) -> None: ...


class _Inline(Executor):
    """In this process, at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as err:
            future.set_exception(err)
        return future


class ThisProcess:
    """This process."""

    size, shared, foreign = 1, False, False

    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]:
        return _Inline().submit(call, *args)

    def died(self, err: BaseException) -> bool:
        return False

    def renew(self) -> None: ...


def _ignore_interrupt() -> None:
    """Ctrl-C is for the driver; its workers end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class LocalProcesses:
    """Processes of this machine."""

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

        # One BLAS thread each: the same bytes whatever the number of workers.
        self._executor: Executor = get_reusable_executor(
            max_workers=self.size, timeout=60, env=THREADS, initializer=_ignore_interrupt
        )

    def close(self) -> None:
        """Ends the processes; those at work are killed."""
        self._executor.shutdown(wait=True, kill_workers=True)  # type: ignore[call-arg]


class DaskCluster:
    """The workers of a Dask scheduler, which itself repeats what was lost with a worker."""

    shared, foreign = False, True

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError:
            raise WorkerError("--cluster needs Dask: pip install 'excite[cluster]'") from None
        self._levels = {logger: logger.level for logger in map(logging.getLogger, LOGGERS)}
        for logger in self._levels:  # their tracebacks of a lost connection: what it means is said in a line
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
        """What is asked of the scheduler fails in several ways once that is gone. Raises EngineError."""
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
    """Workers: `jobs` processes of this machine (all its cores by default; 1: this process), or those of a cluster.

    Raises EngineError.
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
    """Results of `call` on the pieces as they come, AHEAD pieces per worker in flight; pieces are taken as needed.

    Where a worker dies, what was in flight is done again, a piece at a time, and split; a piece that kills TRIES
    workers alone comes back without a value. Exceptions of `call` are passed on. Raises EngineError.
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
            except BrokenExecutor:  # died before it got anything
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
