"""The `excite` program: run a command, report an error in one line, and end with its exit code."""

from __future__ import annotations

import errno
import os
import signal
import sys

# One BLAS thread: the matrices are small, and threads turn a 0.3 ms eigenproblem into 100 ms.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402

from excite import interrupt  # noqa: E402
from excite.cli import INTERRUPTED, app, fail  # noqa: E402
from excite.errors import DISK, ExciteError, StoppedError  # noqa: E402

BESIDE_THE_WORK = str(StoppedError("the machine was being read, or the result written"))


def main() -> None:
    """Run a command; exit 0: done, 1: could not be done, 2: bad input or usage, 130: interrupted.

    An error of the user's is one line on stderr, a defect of the program a traceback.
    """
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
            fail(BESIDE_THE_WORK, INTERRUPTED)
        except Exception as err:
            if isinstance(err, OSError) and err.errno == errno.ENAMETOOLONG:
                fail(f"{str(err.filename)[:40]}...: is too long a name for a file", 2)
            code = _exit_code(err)
            if code is not None:
                where = getattr(err, "filename", None) or "the output"
                said_of = f"{where}: can't be written: {err.strerror or err}" if isinstance(err, OSError) else str(err)
                fail(" ".join(said_of.split()), code)
            if not said.stop:
                raise
            fail(BESIDE_THE_WORK, INTERRUPTED)
    if result == INTERRUPTED:  # typer makes an exit code of Ctrl-C
        fail(BESIDE_THE_WORK, INTERRUPTED)
    sys.exit(result if isinstance(result, int) else 0)


def _terminate(*_: object) -> None:
    """End on SIGTERM as on Ctrl-C: workers are stopped, no folder is left half written."""
    raise KeyboardInterrupt


def _exit_code(err: Exception) -> int | None:
    """Return the exit code of an error, None for a defect of the program."""
    if isinstance(err, ExciteError):
        return err.exit_code
    return 1 if isinstance(err, OSError) and err.errno in (*DISK, errno.EACCES) else None


if __name__ == "__main__":
    main()
