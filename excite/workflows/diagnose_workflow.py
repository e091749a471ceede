"""`excite diagnose`: from logs to named causes, figures, a report and the extended machine file."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from excite import diagnosis, identification, reports
from excite.diagnosis import Assessment, Diagnosis, RivalPair, TorqueDiagnosis, run_forked
from excite.errors import InfeasibleError, MachineError, NotIdentifiableError, SimulationError, StoppedError
from excite.logs import Log, Prepared, doubts_in_errors, examine, moves, prepare
from excite.model import Model, build, signal_descriptions
from excite.model.machine import Machine
from excite.reports import Account, Explorable
from excite.workflows import design_request, design_workflow, requests
from excite.workflows.design_request import DesignRequest
from excite.workflows.progress import Bar, no_bar

MACHINE = "machine.toml"
NEXT = "next"  # folder of the drive that separates tied causes


@dataclass(frozen=True)
class PreparedLogs:
    """Repaired logs with the notes and doubts of the repair."""

    logs: list[Log]
    notes: list[str]
    doubts: list[str]


def _prepare_logs(model: Model, logs: Sequence[Log]) -> PreparedLogs:
    examined = [examine(model.machine, one) for one in logs]
    repaired = [e.log for e in examined]
    doubts = [line for e in examined for line in e.doubts]
    if not any(moves(model.machine, one) for one in repaired):
        sources = ", ".join(one.source for one in repaired)
        raise NotIdentifiableError(f"{sources}: nothing moves, which shows no cause; give a log of a drive as well")
    notes = [note for e in examined for note in e.notes] + doubts
    return PreparedLogs(repaired, notes, doubts)


@dataclass(frozen=True)
class DiagnoseResult:
    """An assessment, the repaired logs that it is of, and notes."""

    assessment: Assessment
    logs: list[Log]
    notes: list[str]


def diagnose_from(
    model: Model,
    logs: Sequence[Log],
    report: Callable[[float, str], None] = lambda share, what: None,
    budget_s: float | None = None,
) -> DiagnoseResult:
    """Diagnose checked logs and measure the gain of each finding.

    report(share of the work, what is being done): called now and then.
    budget_s [s]: ends the search with the best answer so far.
    Raises LogError, NotIdentifiableError, NoEstimateError.
    """
    prepared = _prepare_logs(model, logs)
    with doubts_in_errors(prepared.doubts):
        assessment = diagnosis.explain(model, prepared.logs, model.machine.filter, report, run_forked, budget_s)
    notes = [*prepared.notes, *_baseline_note(assessment.diagnosis)]
    if assessment.cut_short:
        notes.append(
            f"the search was ended by {assessment.cut_short}: this is the best answer so far, and further effects were"
            " not tried"
        )
    return DiagnoseResult(assessment, prepared.logs, notes)


def diagnose(
    place: Path,
    machine: str,
    logs: Sequence[Path],
    design_next: bool = False,
    bar: Bar = no_bar,
    budget_s: float | None = None,
    accepted: str | None = None,
    false_alarms: int = 0,
) -> dict[str, Any]:
    """Diagnose logs into a folder: report, figures, and machine.toml if a cause is named; return the summary.

    machine: a shipped name or a path. design_next: design the drive that separates
    tied causes. budget_s [s]: ends the search with the best answer so far, and the count of false alarms. accepted:
    why doubts about the logs may stand. false_alarms: number of clean simulated logs of the fitted machine that are
    diagnosed as well.
    Raises LogError, MachineError, NoEstimateError.
    """
    begin = time.monotonic()
    model = requests.build_model(machine)
    with bar("diagnosing") as advance:
        ready = prepare(model, logs, identification.needed_sensors(model, "joint"))
        found = diagnose_from(
            ready.model, ready.logs, lambda share, what: advance(round(1000 * share), 1000, what), budget_s
        )
    left = None if budget_s is None else budget_s - (time.monotonic() - begin)
    counted, note = _count_false_alarms(found, false_alarms, bar, left) if false_alarms else (None, "")
    drive = separating_drive(place, ready.model.machine, rivals(found), design_next, bar)
    found = replace(found, notes=[*found.notes, *([note] if note else [])])
    account = diagnose_account(machine, ready, found, drive, accepted)
    return replace(account, summary={**account.summary, "false_alarms": counted}).write(place)


def _count_false_alarms(
    found: DiagnoseResult, runs: int, bar: Bar, budget_s: float | None
) -> tuple[dict[str, Any] | None, str]:
    """Diagnose clean simulated logs of the fitted machine; return the counts and a sentence."""
    d = found.assessment.diagnosis
    try:
        with bar("diagnosing clean logs") as advance:
            counted = diagnosis.count_false_alarms(
                d, runs, lambda share, what: advance(round(1000 * share), 1000, what), run_forked, budget_s
            )
    except NotIdentifiableError as err:
        return None, str(err)
    if not counted.runs:
        return None, "no false alarms were counted: stopped before the first simulated log was diagnosed"
    return counted.summary(), str(counted)


def rivals(found: DiagnoseResult) -> Sequence[RivalPair]:
    """Return the pairs of tied causes; one of torques has none."""
    d = found.assessment.diagnosis
    return diagnosis.rival_pairs(d) if isinstance(d, Diagnosis) else ()


def diagnose_account(
    machine: str,
    ready: Prepared,
    found: DiagnoseResult,
    drive: Mapping[str, Any] | None,
    accepted: str | None = None,
) -> Account:
    """Give an account of a diagnosis.

    machine: the name or path that machine.toml extends. drive: as `separating_drive` returns it. accepted: why
    doubts about the logs may stand.
    """
    model, d, title = ready.model, found.assessment.diagnosis, ready.model.machine.title
    text = diagnosis.machine_file(machine, model.machine, d)
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "logs": [one.source for one in found.logs],
        **diagnosis.summarise(found.assessment),
        "machine_file": MACHINE if text is not None else None,
        "separating_drive": drive,
        "notes": [*requests.acceptance_notes(accepted), *ready.notes, *found.notes],
        "accepted": accepted,
        "versions": requests.package_versions(),
    }
    keys = ("kind", "amount", "amount_std", "unit", "share_percent", "p_value", "gain_percent", "gain_ci95")
    rows = {f"{f['effect']}@{f['where']}": {k: f[k] for k in keys} for f in summary["findings"]}
    words = signal_descriptions(model.machine)
    signals = partial(reports.signals_figure, summary["signals"], d.extended, title, words)
    return Account(
        "diagnose",
        reports.with_sentences("diagnose", summary),
        {"signals.png": signals},
        partial(reports.rows_frame, rows, "finding"),
        (partial(_write_machine, text),),
        reports.figures_by_file(d, title),
        partial(_draw, d, title),
    )


def _draw(d: Diagnosis | TorqueDiagnosis, title: str, place: Path) -> dict[str, Explorable]:
    """Write the figures of each log, several at a time."""
    return {k: v for one in run_forked(reports.figure_calls(place, d, title)) for k, v in one.items()}


def _write_machine(machine_file: str | None, place: Path) -> None:
    if machine_file is not None:
        (place / MACHINE).write_text(machine_file, encoding="utf-8")


def _baseline_note(found: Diagnosis | TorqueDiagnosis) -> list[str]:
    """Say which model the "before" numbers are of, if the model without the findings can't follow the logs."""
    if not isinstance(found, Diagnosis):
        tried = [f"tried and not given: {'; '.join(found.rejected)}"] if found.rejected else []
        return ["the torques are explained along the measured motion", *tried]
    if found.sticks:
        return [
            "friction sticks: where a joint is near rest, its friction may have any value up to Fs in the model without"
            " what was found, and up to a tenth of that where presliding was found"
        ]
    if found.before.exact:
        return []
    return ["no model without what was found follows the log: unknown forces stand beside the one before"]


def separating_drive(
    place: Path, machine: Machine, tied: Sequence[RivalPair], design_next: bool, bar: Bar = no_bar
) -> dict[str, Any] | None:
    """Return the first pair of tied causes that a drive can separate; None without such a pair or a design problem.

    None for an arm, too, which is designed without effects.
    design_next: design that drive into the folder `next`. A failed design gives its reason: the diagnosis is kept.
    """
    if machine.problem is None:
        return None
    name, problem = requests.choose_problem(machine, None, None)
    for pair in tied:
        try:
            model = design_request.with_rivals(build(pair.machine, fit_sensor_effects=False), pair.between)
        except MachineError:
            continue  # a sensor's effect: no equation of motion shows it
        if model.follows_positions:
            return None
        between = tuple(f"{e.label}={float(e.amount):.5g}" for e in pair.between)
        drive: dict[str, Any] = {"between": list(between), "folder": None}
        if design_next:
            (place / NEXT).mkdir()
            request = DesignRequest("discrimination", between=between)
            try:
                made = design_workflow.design_model(place / NEXT, model, name, problem, request, bar)
            except (InfeasibleError, MachineError, SimulationError, KeyboardInterrupt, StoppedError) as failed:
                shutil.rmtree(place / NEXT)
                said = failed.why if isinstance(failed, StoppedError) else str(failed)
                return drive | {"failed": said or "interrupted"}
            sigma = max(made["sigma_percent"][x.partition("=")[0]] for x in between)
            drive |= {"folder": NEXT, "sigma_percent": sigma, "complete": made["complete"]}
        return drive
    return None
