"""The work of `excite diagnose`: logs in, a folder with the answer, its figures and the extended machine file out."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from excite import diagnosis, identification, reports
from excite.diagnosis import Account, Diagnosis, Rivals, diagnose, forked
from excite.errors import InfeasibleError, MachineError, NotIdentifiableError, SimulationError
from excite.identification import FILTERS
from excite.logs import Log, doubts_in_errors, examine, moves, read_stretches
from excite.model import Model, build
from excite.model.machine import Filter, Machine
from excite.reports import save
from excite.workflows import design_request, design_workflow, requests
from excite.workflows.design_request import Brief
from excite.workflows.progress import Bar, silent

MACHINE = "machine.toml"
NEXT = "next"  # folder of the drive that separates what is tied
PARTS = 0.8  # of the time that diagnosing takes; the rest measures gains and draws

Advance = Callable[[int, int, float | None], None]


@dataclass(frozen=True)
class Ready:
    """Logs repaired for a diagnosis, what was found on the way, and the filter of the first guess."""

    logs: list[Log]
    notes: list[str]
    doubts: list[str]
    filter: Filter


def _ready(model: Model, logs: Sequence[Log], filtering: str) -> Ready:
    examined = [examine(model, one) for one in logs]
    mended = [e.log for e in examined]
    doubtful = [line for e in examined for line in e.doubts]
    if not any(moves(model, one) for one in mended):
        sources = ", ".join(one.source for one in mended)
        raise NotIdentifiableError(f"{sources}: nothing moves, which shows no cause; give a log of a drive as well")
    chosen, reason = FILTERS[filtering](model, mended)
    notes = [note for e in examined for note in e.notes] + doubtful + ([reason] if reason else [])
    return Ready(mended, notes, doubtful, chosen)


def diagnose_from(model: Model, logs: Sequence[Log], filtering: str = "machine") -> Account:
    """Diagnose checked logs and measure what each finding gains.

    filtering: a name of `FILTERS`, of the first guess. Raises LogError, NotIdentifiable, NoEstimate.
    """
    ready = _ready(model, logs, filtering)
    with doubts_in_errors(ready.doubts):
        found = diagnose(model, ready.logs, ready.filter, together=forked)
    return diagnosis.account(found, together=forked)


def diagnose_logs(
    place: Path,
    machine: str,
    model: Model,
    logs: Sequence[Path],
    filtering: str,
    advance: Advance,
) -> tuple[dict[str, Any], list[Rivals]]:
    """Diagnoses logs and fills the folder: figures, and machine.toml where something is named. Its summary, and what a
    drive could be designed to tell apart.

    machine: as it was asked for, a shipped name or a path. filtering: a name of `examine.FILTERS`. Raises LogError,
    MachineError, NoEstimate.
    """
    needs = identification.needed_sensors(model, "joint")
    read, notes = read_stretches(logs, model.machine, needs)
    ready = _ready(model, read, filtering)
    mended, notes = ready.logs, [*notes, *ready.notes]

    def tell(begin: float, end: float) -> Callable[[float, str], None]:
        return lambda share, what: advance(round(1000 * (begin + share * (end - begin))), 1000, None)

    with doubts_in_errors(ready.doubts):
        found = diagnose(model, mended, ready.filter, tell(0.0, PARTS), forked)
    title = model.machine.title
    account = diagnosis.account(found, tell(PARTS, 1.0), forked, reports.drawings(place, found, title))
    text = diagnosis.machine_file(machine, model.machine, found)
    if text is not None:
        (place / MACHINE).write_text(text, encoding="utf-8")
    said = diagnosis.summarise(account)
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "logs": [one.source for one in mended],
        **said,
        "machine_file": MACHINE if text is not None else None,
        "separating_drive": None,
        "notes": [*notes, *_followed(found)],
        "versions": requests.versions(),
    }
    save(reports.signals_figure(summary["signals"], bool(found.stages), title), place / "signals.png")
    return summary, diagnosis.rivals(found)


def _followed(found: Diagnosis) -> list[str]:
    """What is said of the model without what was found, where none follows the logs."""
    if found.before.settled:
        return []
    coarse = found.before.prepared.coarse
    other = f"fitted to sensors taken for {coarse:g} times as noisy as they are" if coarse > 1 else "the machine file's"
    return [f"no model without what was found follows the log: what is given of the one before is {other}"]


def separating_drive(
    place: Path, machine: Machine, tied: Sequence[Rivals], onward: bool, bar: Bar = silent
) -> dict[str, Any] | None:
    """The first pair of tied causes that driving can tell apart, and if it is wanted the drive, designed into a folder
    of its own, or why there is none. None where there is no such pair, or no problem to design for."""
    if machine.problem is None:
        return None
    name, problem = requests.choose_problem(machine, None, None)
    for pair in tied:
        try:
            model = design_request.beside(build(pair.machine, fit_sensor_effects=False), pair.between)
        except MachineError:
            continue  # a sensor's: no equation of motion shows it
        between = tuple(f"{e.label}={float(e.amount):.5g}" for e in pair.between)
        told: dict[str, Any] = {"between": list(between), "folder": None}
        if onward:
            (place / NEXT).mkdir()
            try:
                made = design_workflow.designed(
                    place / NEXT, model, name, problem, Brief("discrimination", between=between)
                )
            except (InfeasibleError, MachineError, SimulationError, KeyboardInterrupt) as failed:
                # The diagnosis is done, and not lost for it.
                shutil.rmtree(place / NEXT)
                return told | {"failed": str(failed) or "interrupted"}
            sigma = max(made["sigma_percent"][x.partition("=")[0]] for x in between)
            told |= {"folder": NEXT, "sigma_percent": sigma, "complete": made["complete"]}
        return told
    return None
