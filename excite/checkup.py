"""The work of `excite diagnose`: logs in, a folder with the answer, its figures and the extended machine file out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from excite import examine, findings, folder, gaps, identify, portrait, reports
from excite.diagnose import diagnose
from model.prediction import Model

MACHINE = "machine.toml"
PARTS = 0.8  # of the time that diagnosing takes; the rest measures gains

Advance = Callable[[int, int, float | None], None]


def write(
    place: Path,
    machine: str,
    model: Model,
    logs: Sequence[Path],
    filtering: str,
    versions: Mapping[str, str],
    advance: Advance,
) -> dict[str, Any]:
    """Diagnoses logs and fills the folder: summary, figures, report, and machine.toml where something is named.

    machine: as it was asked for, a shipped name or a path. filtering: machine or auto. Raises LogError, MachineError,
    NoEstimate.
    """
    needs = identify.needed_sensors(model, "joint")
    parts = [gaps.read(path, model.machine, needs) for path in logs]
    notes = [note for _, some in parts for note in some]
    examined = [examine.examine(model, one) for several, _ in parts for one in several]
    mended = [e.log for e in examined]
    notes += [note for e in examined for note in e.notes]
    chosen = model.machine.filter
    if filtering == "auto":
        chosen, reason = examine.choose(model, mended)
        notes.append(reason)

    def tell(begin: float, end: float) -> Callable[[float, str], None]:
        return lambda share, what: advance(round(1000 * (begin + share * (end - begin))), 1000, None)

    found = diagnose(model, mended, chosen, tell(0.0, PARTS))
    account = findings.account(found, tell(PARTS, 1.0))
    text = findings.machine_file(machine, model.machine, found)
    if text is not None:
        (place / MACHINE).write_text(text, encoding="utf-8")
    said = findings.summary(account)
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "logs": [one.source for one in mended],
        **said,
        "machine_file": MACHINE if text is not None else None,
        "notes": notes,
        "versions": dict(versions),
    }
    portrait.write(place, account, summary["signals"], model.machine.title)
    reports.write(place, "diagnose", summary)
    (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")
    return summary
