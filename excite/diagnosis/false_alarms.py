"""Count what a diagnosis names on clean simulated logs of the fitted machine: its level for this machine and drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from excite import interrupt
from excite.diagnosis import selection
from excite.diagnosis.clean_simulation import can_be_simulated, simulate_clean
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.diagnosis import Diagnosis
from excite.diagnosis.findings import explain
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.selection import ProgressCallback
from excite.diagnosis.torque_regression import TorqueDiagnosis, names_in_clean_torques
from excite.errors import NoEstimateError, NotIdentifiableError, SimulationError
from excite.model import Model, build
from excite.text import count

FIRST_SEED = 100  # of the simulated logs, apart from those that measure the remainder; chosen


@dataclass(frozen=True)
class FalseAlarms:
    """Answers to clean simulated logs.

    verdicts: number of logs by verdict; failed: logs without an answer. names: number of logs by effect@where.
    """

    verdicts: dict[str, int]
    failed: int
    names: dict[str, int]

    @property
    def runs(self) -> int:
        return sum(self.verdicts.values()) + self.failed

    @property
    def named(self) -> int:
        """Number of logs in which something was named, a false alarm."""
        return self.verdicts.get("named", 0) + self.verdicts.get("tied", 0)

    def __str__(self) -> str:
        others = [
            f"{n} {what}"
            for n, what in ((self.verdicts.get("unexplained", 0), "unexplained"), (self.failed, "without an answer"))
            if n
        ]
        names = f" ({', '.join(self.names)})" if self.names else ""
        rest = f"; {' and '.join(others)}" if others else ""
        return (
            f"Of {count(self.runs, 'clean simulated log')} of the fitted machine along this drive,"
            f" {self.named or 'none'} got a name{names}{rest}."
        )

    def summary(self) -> dict[str, Any]:
        """Return the counts, ready for JSON; "named" counts logs of verdict `tied`, too."""
        return {
            "runs": self.runs,
            "named": self.named,
            "failed": self.failed,
            "verdicts": self.verdicts,
            "names": self.names,
        }


def count_false_alarms(
    d: Diagnosis | TorqueDiagnosis,
    runs: int,
    progress: ProgressCallback | None = None,
    runner: CallRunner = run_in_turn,
    budget_s: float | None = None,
) -> FalseAlarms:
    """Diagnose clean logs of the machine that a diagnosis ends with, its findings included.

    budget_s [s]: no log is begun after it, None for no end. A first Ctrl-C ends the count with the logs diagnosed so
    far. Raises NotIdentifiableError if no machine follows the logs with exact dynamics.
    """
    if isinstance(d, TorqueDiagnosis):
        diagnosed: Callable[[int], tuple[str, list[str]] | None] = partial(_of_torques, d)
    else:
        if not can_be_simulated(d.after):
            raise NotIdentifiableError(
                "no false alarms were counted: no model follows the logs that could be simulated"
            )
        diagnosed = partial(_of_motion, d, build(selection.fitted_machine(d.after)), runner)
    report = progress or (lambda share, what: None)
    verdicts, names, failed = Counter[str](), Counter[str](), 0
    with interrupt.note_first_interrupt() as asked:
        deadline = Deadline(budget_s, lambda: asked.stop)
        for k in range(runs):
            if deadline.is_over():
                break
            report(k / runs, f"diagnosing clean log {k + 1} of {runs}")
            found = diagnosed(FIRST_SEED + k)
            if asked.stop:
                break
            if found is None:
                failed += 1
                continue
            verdict, own = found
            verdicts[verdict] += 1
            names.update(own)
    return FalseAlarms(dict(verdicts), failed, dict(names))


def _of_motion(d: Diagnosis, model: Model, runner: CallRunner, seed: int) -> tuple[str, list[str]] | None:
    """Return verdict and names of a clean simulated log, None without an answer."""
    try:
        logs, _ = simulate_clean(d.after, seed)
        found = explain(model, logs, model.machine.filter, runner=runner).diagnosis
    except (NoEstimateError, SimulationError):
        return None
    return found.verdict, [f.name for f in found.findings if f.kind == "cause"]


def _of_torques(d: TorqueDiagnosis, seed: int) -> tuple[str, list[str]]:
    """Return verdict and names of clean torques along the measured motion."""
    names = names_in_clean_torques(d, seed)
    return "named" if names else "clean", names
