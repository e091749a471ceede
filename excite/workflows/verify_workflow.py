"""`excite verify`: simulate a designed drive and identify from it, many times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from excite import identification, reports, simulation, trajectories
from excite.errors import NotIdentifiableError, UsageError
from excite.model import parameter_descriptions
from excite.workflows import requests
from excite.workflows.progress import Bar, silent


def verify(
    place: Path,
    design_dir: Path,
    runs: int,
    method: str | None,
    kit: str,
    seed: int,
    name: Path | None = None,
    bar: Bar = silent,
) -> dict[str, Any]:
    """How true and how sure parameters from a design are. name: what the design's folder will be called."""
    requests.require_known("--kit", kit, simulation.KITS)
    made = trajectories.read_design(design_dir)
    if made.summary.get("after"):
        raise UsageError(
            f"{design_dir}: was designed for the machine that {', '.join(made.summary['after'])} told of, not for the"
            " machine file's; verify a design made without --after"
        )
    model, motion = made.model, made.motion
    method = requests.choose_method(method, model, kit)
    with bar("verifying") as advance:
        result = identification.verify(
            model, motion, method, kit, runs, seed, progress=lambda done, total: advance(done, total, None)
        )
    if len(result.failures) == runs:
        raise NotIdentifiableError(f"all {runs} runs failed, the first one: {result.failures[0]}")
    parameters = identification.summarise_runs(result)
    summary = {
        "machine": model.machine.name,
        "problem": made.summary.get("problem"),
        "design": str(name or design_dir),
        "runs": runs,
        "method": method,
        "kit": kit,
        "seed": seed,
        "failed": len(result.failures),
        "failures": result.failures,
        "parameters": parameters,
        "meanings": parameter_descriptions(model),
        "biased": identification.biased(parameters),
        "versions": requests.versions(),
    }
    title = f"{model.machine.title}: {runs} simulated runs, {method}, kit {kit}"
    reports.save(reports.verify_figure(result, title), place / "verify.png")
    reports.write_report(place, "verify", summary)
    return summary
