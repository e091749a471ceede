"""The work of `excite diagnose`: logs in, a folder with the answer, its figures and the extended machine file out."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from excite import asked, brief, doubts, examine, findings, gaps, identify, portrait, separate, works
from excite.brief import Brief
from excite.diagnose import Diagnosis, diagnose
from excite.estimate import NotIdentifiable
from excite.figures import save
from excite.limit import InfeasibleError
from excite.separate import Rivals
from excite.sidebyside import forked
from excite.simulate import SimulationError
from model.machine import Machine, MachineError
from model.prediction import Model, build

MACHINE = "machine.toml"
NEXT = "next"  # folder of the drive that separates what is tied
PARTS = 0.8  # of the time that diagnosing takes; the rest measures gains and draws

Advance = Callable[[int, int, float | None], None]


def write(
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
    needs = identify.needed_sensors(model, "joint")
    read, notes = gaps.read(logs, model.machine, needs)
    examined = [examine.examine(model, one) for one in read]
    mended = [e.log for e in examined]
    doubtful = [line for e in examined for line in e.doubts]
    notes += [note for e in examined for note in e.notes] + doubtful
    if not any(examine.moves(model, one) for one in mended):
        sources = ", ".join(one.source for one in mended)
        raise NotIdentifiable(f"{sources}: nothing moves, which shows no cause; give a log of a drive as well")
    chosen, reason = examine.FILTERS[filtering](model, mended)
    notes += [reason] if reason else []

    def tell(begin: float, end: float) -> Callable[[float, str], None]:
        return lambda share, what: advance(round(1000 * (begin + share * (end - begin))), 1000, None)

    with doubts.told(doubtful):
        found = diagnose(model, mended, chosen, tell(0.0, PARTS), forked)
    title = model.machine.title
    account = findings.account(found, tell(PARTS, 1.0), forked, portrait.drawings(place, found, title))
    text = findings.machine_file(machine, model.machine, found)
    if text is not None:
        (place / MACHINE).write_text(text, encoding="utf-8")
    said = findings.summary(account)
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "logs": [one.source for one in mended],
        **said,
        "machine_file": MACHINE if text is not None else None,
        "separating_drive": None,
        "notes": [*notes, *_followed(found)],
        "versions": asked.versions(),
    }
    save(portrait.signals_figure(summary["signals"], bool(found.stages), title), place / "signals.png")
    return summary, separate.rivals(found)


def _followed(found: Diagnosis) -> list[str]:
    """What is said of the model without what was found, where none follows the logs."""
    if found.before.settled:
        return []
    coarse = found.before.prepared.coarse
    other = f"fitted to sensors taken for {coarse:g} times as noisy as they are" if coarse > 1 else "the machine file's"
    return [f"no model without what was found follows the log: what is given of the one before is {other}"]


def separating(place: Path, machine: Machine, tied: Sequence[Rivals], onward: bool) -> dict[str, Any] | None:
    """The first pair of tied causes that driving can tell apart, and if it is wanted the drive, designed into a folder
    of its own, or why there is none. None where there is no such pair, or no problem to design for."""
    if machine.problem is None:
        return None
    name, problem = asked.problem(machine, None, None)
    for pair in tied:
        try:
            model = brief.beside(build(pair.machine, flaws=False), pair.between)
        except MachineError:
            continue  # a sensor's: no equation of motion shows it
        between = tuple(f"{e.label}={float(e.amount):.5g}" for e in pair.between)
        told: dict[str, Any] = {"between": list(between), "folder": None}
        if onward:
            (place / NEXT).mkdir()
            try:
                made = works.designed(place / NEXT, model, name, problem, Brief("discrimination", between=between))
            except (InfeasibleError, MachineError, SimulationError, KeyboardInterrupt) as failed:
                # The diagnosis is done, and not lost for it.
                shutil.rmtree(place / NEXT)
                return told | {"failed": str(failed) or "interrupted"}
            sigma = max(made["sigma_percent"][x.partition("=")[0]] for x in between)
            told |= {"folder": NEXT, "sigma_percent": sigma, "complete": made["complete"]}
        return told
    return None
