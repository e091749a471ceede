"""Every error that the program raises for its user, with its exit code.

A message is one line: where, what is wrong, what to do. Exit code 2 means bad input, 1 that the work could not be done.
Any exception that is not an `ExciteError` is a defect of the program.
"""

from __future__ import annotations

import errno

DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # what the user can mend, and no defect of the program


class ExciteError(Exception):
    """An error whose message is meant for the user."""

    exit_code = 1


class InputError(ExciteError, ValueError):
    """Input that can't be used."""

    exit_code = 2


class FailedError(ExciteError, RuntimeError):
    """Valid input, but the work could not be done."""


class MachineError(InputError):
    """A machine file that can't be used: file, key, problem, what is allowed."""


class LogError(InputError):
    """A log or profile that can't be used: file, row and column, problem, what to do."""


class UsageError(InputError):
    """A command or function called with an unknown name or contradictory options."""


class StudyError(UsageError):
    """A study file that can't be carried out: file, key, problem, what is allowed."""


class FolderError(InputError):
    """An output folder that can't be written."""


class DesignFolderError(InputError):
    """A folder that holds no design, or a damaged one."""


class EstimateFolderError(InputError):
    """A folder that holds no estimate, or a damaged one."""


class UndrivableError(InputError):
    """A design that no person can follow."""


class NoEstimateError(FailedError):
    """A method found no estimate, or none that is reliable."""


class NotIdentifiableError(NoEstimateError):
    """No parameter is identifiable from the log, or it has fewer rows than parameters."""


class NotConsistentError(NoEstimateError):
    """No physically possible machine was found near an estimate."""


class SimulationError(FailedError):
    """A motion could not be integrated; the message gives time and state."""


class CollocationError(FailedError):
    """Newton's method found no solution of an interval's collocation equations."""


class SolverError(FailedError):
    """A solver ended without an optimum."""


class InfeasibleError(ExciteError, ValueError):
    """No drive keeps every limit.

    limit: name of the violated limit; excess: violation as a fraction of its range.
    """

    def __init__(self, message: str, limit: str, excess: float) -> None:
        super().__init__(message)
        self.limit, self.excess = limit, excess

    def __reduce__(self) -> tuple[type[InfeasibleError], tuple[str, str, float]]:
        return type(self), (str(self), self.limit, self.excess)


class StoppedError(ExciteError):
    """Work that was stopped (Ctrl-C) before it had a result. why: how far it was, or what it has not yet."""

    exit_code = 130  # as shells have it

    def __init__(self, why: str) -> None:
        super().__init__(f"interrupted, nothing was written: {why}")
        self.why = why


class ServeError(FailedError):
    """The driver's page can't be served."""


class WorkerError(FailedError):
    """The workers of a study are lost."""


class DiskError(FailedError):
    """A result can't be written: a full disk, a quota, a limit of the size of files."""


class RowStoreError(FailedError):
    """Rows of a study can't be stored now (a full disk, for example); rows stored before are safe."""
