"""Every error that the program raises for the person who must act, with its exit code.

A message is one line: where, what is wrong, what to do. Bad input ends with 2, what could not be done with 1;
whatever is not an `ExciteError` is a defect of the program.
"""

from __future__ import annotations


class ExciteError(Exception):
    """An error whose message is meant for the user."""

    exit_code = 1


class InputError(ExciteError, ValueError):
    """Something given can't be used."""

    exit_code = 2


class FailedError(ExciteError, RuntimeError):
    """Valid input, but the work could not be done."""


class MachineError(InputError):
    """A machine file that can't be used: file, key, what is wrong, what is allowed."""


class LogError(InputError):
    """A log or profile that can't be used: file, row and column, what is wrong, what to do."""


class UsageError(InputError):
    """A command or function called with an unknown name or contradictory options."""


class StudyError(UsageError):
    """A study file that can't be carried out: file, key, what is wrong, what is allowed."""


class FolderError(InputError):
    """An output folder that can't be written."""


class DesignFolderError(InputError):
    """A folder that holds no design, or a damaged one."""


class UndrivableError(InputError):
    """A design that no person can be asked to follow."""


class NoEstimateError(FailedError):
    """A method found no estimate, or none that it stands by."""


class NotIdentifiableError(NoEstimateError):
    """The log says nothing of any parameter, or has fewer rows than parameters."""


class NotConsistentError(NoEstimateError):
    """No physically possible machine was found near an estimate."""


class SimulationError(FailedError):
    """A motion could not be integrated; the message says when and from which state."""


class CollocationError(FailedError):
    """The collocation equations of an interval have no solution that Newton's method finds."""


class InfeasibleError(ExciteError, ValueError):
    """No drive keeps every limit.

    limit: name of the one that can't be met. excess: by how much, as a fraction of its range.
    """

    def __init__(self, message: str, limit: str, excess: float) -> None:
        super().__init__(message)
        self.limit, self.excess = limit, excess

    def __reduce__(self) -> tuple[type[InfeasibleError], tuple[str, str, float]]:
        return type(self), (str(self), self.limit, self.excess)


class ServeError(FailedError):
    """The driver's page can't be served."""


class WorkerError(FailedError):
    """The workers of a study can't be had any more."""


class RowStoreError(FailedError):
    """Rows of a study can't be kept now (a full disk, say); what was kept before is safe."""
