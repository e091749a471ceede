"""The command line: runs a command, and says in one line what its errors mean for the person who must act."""

from __future__ import annotations

import errno
import os
import signal
import sys

# One BLAS thread: our matrices are small, and threads turn a 0.3 ms eigenproblem into 100 ms.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402

from excite import interrupt  # noqa: E402
from excite.cli import (  # noqa: E402
    INTERRUPTED,
    app,
    fail,
)
from excite.errors import UsageError  # noqa: E402


def main() -> None:
    """Runs a command: exit 0 done, 1 could not be done, 2 bad input or usage; one clear line on stderr."""
    signal.signal(signal.SIGTERM, _terminate)
    with interrupt.watch_interrupts() as said:
        try:
            try:
                result = app(args=sys.argv[1:] or ["--help"], standalone_mode=False)
            finally:
                interrupt.ignore_interrupts()
        except typer.TyperException as err:
            fail(" ".join(err.format_message().split()), 2)
        except (KeyboardInterrupt, typer.Abort):
            fail("interrupted, nothing was written", INTERRUPTED)
        except Exception as err:
            if isinstance(err, OSError) and err.errno == errno.ENAMETOOLONG:
                fail(f"{str(err.filename)[:40]}...: is too long a name for a file", 2)
            code = _exit_code(err)
            if code is not None:
                fail(" ".join(str(err).split()), code)
            if not said.stop:
                raise
            fail("interrupted, nothing was written", INTERRUPTED)
    if result == INTERRUPTED:  # typer makes an exit code of Ctrl-C
        fail("interrupted, nothing was written", INTERRUPTED)
    sys.exit(result if isinstance(result, int) else 0)


def _terminate(*_: object) -> None:
    """A polite kill ends like Ctrl-C: workers are stopped, nothing half written stays."""
    raise KeyboardInterrupt


def _exit_code(err: Exception) -> int | None:
    """What an error means for the person who must act; None for a defect of ours, which shows its traceback."""
    from excite.errors import (
        DesignFolderError,
        FolderError,
        InfeasibleError,
        LogError,
        MachineError,
        NoEstimateError,
        RowStoreError,
        ServeError,
        SimulationError,
        UndrivableError,
        WorkerError,
    )

    if isinstance(err, UsageError | MachineError | LogError | FolderError | DesignFolderError | UndrivableError):
        return 2
    if isinstance(err, OSError) and err.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
        return 1
    if isinstance(err, NoEstimateError | InfeasibleError | SimulationError | ServeError | WorkerError | RowStoreError):
        return 1
    return None


if __name__ == "__main__":
    main()
