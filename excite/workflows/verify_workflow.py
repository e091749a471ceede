"""`excite verify`: from a design to the errors of identification over many simulated runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from excite import identification, reports, simulation, trajectories
from excite.errors import NotIdentifiableError, UsageError
from excite.identification import Verification
from excite.model import Model, parameter_descriptions
from excite.reports import Account
from excite.simulation import Motion
from excite.text import count
from excite.workflows import requests
from excite.workflows.progress import Bar, no_bar


def verify(
    place: Path,
    design_dir: Path,
    runs: int,
    method: str | None,
    kit: str,
    seed: int,
    shown_as: Path | None = None,
    bar: Bar = no_bar,
) -> dict[str, Any]:
    """Simulate a design with sensor noise and identify from it, `runs` times, into a folder; return the summary.

    method: None for the recommended one. kit: a name of `KITS`. shown_as: the design's folder as the summary gives it.
    Raises UsageError, DesignFolderError, NotIdentifiableError if every run fails.
    """
    requests.require_known("--kit", kit, simulation.KITS)
    made = trajectories.read_design(design_dir)
    if made.summary.get("after"):
        raise UsageError(
            f"{design_dir}: was designed for the machine as identified from {', '.join(made.summary['after'])}, not as"
            " in the machine file; verify a design made without --after"
        )
    model, motion = made.model, made.motion
    method = requests.choose_method(method, model, kit)
    with bar("verifying") as advance:
        result = identification.verify(
            model, motion, method, kit, runs, seed, progress=lambda done, total: advance(done, total, None)
        )
    if len(result.failures) == runs:
        raise NotIdentifiableError(f"all {count(runs, 'run')} failed, the first one: {result.failures[0]}")
    return verify_account(model, motion, result, seed, str(shown_as or design_dir), made.summary.get("problem")).write(
        place
    )


def verify_account(
    model: Model, motion: Motion, result: Verification, seed: int, drive: str, problem: str | None = None
) -> Account:
    """Give an account of a verification. drive: what the drive is called; problem: that it was designed for."""
    parameters = identification.summarise_runs(result)
    runs = len(result.value)
    summary = {
        "machine": model.machine.name,
        "problem": problem,
        "design": drive,
        "runs": runs,
        "method": result.method,
        "kit": result.kit,
        "seed": seed,
        "failed": len(result.failures),
        "failures": result.failures,
        "share_outside_law": simulation.share_outside_law(model, motion),
        "parameters": parameters,
        "meanings": parameter_descriptions(model),
        "biased": identification.biased_parameters(parameters),
        "versions": requests.package_versions(),
    }
    title = f"{model.machine.title}: {count(runs, 'simulated run')}, {result.method}, kit {result.kit}"
    return Account(
        "verify",
        reports.with_sentences("verify", summary),
        {"verify.png": partial(reports.verify_figure, result, title)},
        partial(reports.rows_frame, parameters, "parameter"),
    )
