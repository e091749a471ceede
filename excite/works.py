"""The work of commands: each fills a folder with figures, a report and summary.json, and gives back the summary."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite import (
    asked,
    crosscheck,
    examine,
    figures,
    gaps,
    identify,
    profiles,
    reports,
    sensors,
    stored,
    terminal,
)
from excite import brief as briefs
from excite import compare as comparisons
from excite import verify as verification
from excite.asked import UsageError
from excite.brief import Brief
from excite.estimate import Estimate, NotIdentifiable
from excite.log import Log
from excite.meaning import meanings
from excite.simulate import SimulationError
from model.machine import Filter, MachineError, Problem
from model.prediction import Model


def design(place: Path, machine: str, problem: str | None, duration: float | None, brief: Brief) -> dict[str, Any]:
    """A drive for a machine as a brief asks for it."""
    model = asked.model(machine, flaws=False)
    name, chosen = asked.problem(model.machine, problem, duration)
    if brief.between:
        model = briefs.rivals(model, brief.between, float(chosen.duration_s))
    asked.objective(brief.objective, model.machine)
    asked.positive("--budget", brief.budget_s, "s")
    asked.positive("--sigma-max", brief.sigma_max, "%")
    return designed(place, model, name, chosen, brief)


def designed(place: Path, model: Model, name: str, chosen: Problem, brief: Brief) -> dict[str, Any]:
    """The same for a model and a problem of this name that are there already."""
    begin = time.perf_counter()
    with terminal.bar("designing") as advance:
        try:
            found = briefs.answer(model, chosen, brief, advance)
        except np.linalg.LinAlgError:
            raise MachineError(
                f"{model.machine.name}: {briefs.unmoved(name)}; is an effect outside of what the drive can reach?"
            ) from None
    wall = time.perf_counter() - begin
    profiles.of(found.model, found.design.motion).to_csv(place / "profile.csv", index=False)
    (place / "machine.json").write_text(model.machine.model_dump_json(indent=1) + "\n", encoding="utf-8")
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "problem": name,
        "duration_s": float(chosen.duration_s),
        **briefs.summary(brief, found),
        "meanings": meanings(found.model),
        "wall_s": wall,
        "versions": asked.versions(),
    }
    title = f"{model.machine.title}: {name}, cond(Phi) = {found.design.cond_phi:.2f}"
    figures.save(figures.design_figure(found.model, chosen, found.design.motion, title), place / "design.png")
    figures.save(figures.sigma_figure(summary["sigma_percent"], title), place / "sigma.png")
    reports.finish(place, "design", summary)
    return summary


def verify(
    place: Path, design_dir: Path, runs: int, method: str | None, kit: str, seed: int, name: Path | None = None
) -> dict[str, Any]:
    """How true and how sure parameters from a design are. name: what the design's folder will be called."""
    asked.known("--kit", kit, sensors.KITS)
    made = stored.read(design_dir)
    if made.summary.get("after"):
        raise UsageError(
            f"{design_dir}: was designed for the machine that {', '.join(made.summary['after'])} told of, not for the"
            " machine file's; verify a design made without --after"
        )
    model, motion = made.model, made.motion
    method = asked.method(method, model, kit)
    with terminal.bar("verifying") as advance:
        result = verification.verify(
            model, motion, method, kit, runs, seed, progress=lambda done, total: advance(done, total, None)
        )
    if len(result.failures) == runs:
        raise NotIdentifiable(f"all {runs} runs failed, the first one: {result.failures[0]}")
    parameters = verification.summary(result)
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
        "meanings": meanings(model),
        "biased": verification.biased(parameters),
        "versions": asked.versions(),
    }
    title = f"{model.machine.title}: {runs} simulated runs, {method}, kit {kit}"
    figures.save(figures.verify_figure(result, title), place / "verify.png")
    reports.finish(place, "verify", summary)
    return summary


def compare(
    place: Path,
    machine: str,
    problem: str | None,
    samples: int,
    against: Sequence[str],
    seed: int,
    budget: float | None,
) -> dict[str, Any]:
    model = asked.model(machine, flaws=False)
    name, chosen = asked.problem(model.machine, problem, None)
    briefs.graded(model)
    asked.positive("--budget", budget, "s")
    for usual in against:
        asked.known("--against", usual, tuple(comparisons.USUAL))
    with terminal.bar("comparing") as advance:
        result = comparisons.compare(model, chosen, samples, seed, budget, advance, against)
    columns = ["t_s", *(profiles.torque_column(model, u) for u in model.inputs)]
    (place / "drives").mkdir()
    designs = []
    for row in result.rows:
        knots = f"drives/{row.name.replace(',', '').replace(' ', '-')}.csv"
        table = pd.DataFrame([[t, *u] for t, u in zip(row.manoeuvre.times, row.manoeuvre.torque, strict=True)])
        table.to_csv(place / knots, index=False, header=columns, float_format="%.12g")
        designs.append(
            {
                "name": row.name,
                "cond_phi": row.cond_phi,
                "cond_w": row.cond_w,
                "worst_std_percent": row.worst_std_percent,
                "median_std_percent": row.median_std_percent,
                "max_violation": row.max_violation,
                "breaks": row.breaks,
                "kept": row.kept,
                "samples": row.samples,
                "wall_s": row.wall_s,
                "equal_score_s": row.equal_s,
                "knots": knots,
                "start": dict(zip(model.coordinates, row.start, strict=True)),
            }
        )
    summary = {
        "machine": model.machine.name,
        "problem": name,
        "objective": "cond",
        "samples": samples,
        "seed": seed,
        "budget_s": budget,
        "designs": designs,
        "ratio_equal_time": result.ratio_equal_time,
        "versions": asked.versions(),
    }
    title = f"{model.machine.title}: {name}, the designed drive and the usual ones"
    figures.save(figures.compare_figure(result.rows, title), place / "compare.png")
    reports.finish(place, "compare", summary)
    return summary


def identified(
    place: Path,
    model: Model,
    logs: Sequence[Path],
    method: str | None,
    filtering: str,
    validate: Sequence[Path],
) -> dict[str, Any]:
    """Parameters from logs. filtering: a name of `examine.FILTERS`; validate: logs that the result is to predict."""
    method = asked.method(method, model)
    needs = identify.needed_sensors(model, method)
    read, cut = gaps.read(logs, model.machine, needs)
    others, torn = gaps.read(validate, model.machine, needs, "validated on")
    seen = [examine.examine(model, one) for one in others]
    fresh, said = [e.log for e in seen], [*torn, *(line for e in seen for line in (*e.notes, *e.doubts))]
    with terminal.busy("identifying"):
        chosen, reason = examine.FILTERS[filtering](model, read)
        estimate = identify.identify(model, read, method, chosen)
        read = [examine.examine(model, one).log for one in read]  # as it was identified from
        if model.slips and identify.METHODS[method].biased:
            estimate = identify.with_bias(model, read, estimate, chosen)
        found = estimate.value if estimate.method == "joint" and np.isfinite(estimate.value).all() else None
        late = [remark for one in read for remark in examine.late_channels(model, one, chosen, found)]
    summary = {
        "machine": model.machine.name,
        "logs": [one.source for one in read],
        "method": estimate.method,
        "parameters": _parameters(estimate),
        "meanings": meanings(model),
        "cond_w": estimate.cond_w,
        "cond_phi": estimate.cond_phi,
        "relative_error_percent": estimate.relative_error_percent,
        "unidentifiable": list(estimate.unidentifiable),
        "reasons": dict(estimate.unidentifiable),
        "notes": [*cut, *([reason] if reason else []), *estimate.notes, *crosscheck.far(model, estimate), *late, *said],
        "validation": [_check(model, one, estimate, chosen) for one in fresh],
        "versions": asked.versions(),
    }
    for kind, several in (("fit", read), ("validation", fresh)):
        for k, one in enumerate(several):
            title = f"{model.machine.title}: {one.source}"
            figure = figures.comparison_figure(model, crosscheck.torques(model, one, estimate, chosen), title)
            figures.save(figure, place / (f"{kind}-{k + 1}.png" if len(several) > 1 else f"{kind}.png"))
    reports.finish(place, "identify", summary)
    return summary


def _parameters(estimate: Estimate) -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    low, high = estimate.interval95
    for k, (name, unit) in enumerate(zip(estimate.names, estimate.units, strict=True)):
        rows[name] = {
            "unit": unit,
            "value": estimate.value[k],
            "std": estimate.std[k],
            "std_percent": estimate.std_percent[k],
            "low95": low[k],
            "high95": high[k],
        }
        if estimate.bias is not None and estimate.bias_std is not None:
            rows[name] |= {"bias": estimate.bias[k], "bias_std": estimate.bias_std[k]}
    return rows


def _check(model: Model, one: Log, estimate: Estimate, chosen: Filter) -> dict[str, Any]:
    """How well an estimate predicts a log that it was not fitted on: torques, and signals by direct simulation."""
    torques = crosscheck.torques(model, one, estimate, chosen)
    shown: dict[str, Any] = {
        "log": one.source,
        "torque_error_percent": dict(zip(torques.names, torques.percent, strict=True)),
    }
    try:
        signals = crosscheck.motions(model, one, estimate, chosen)
    except (ValueError, SimulationError) as err:
        return shown | {"simulation": f"not possible: {err}"}
    return shown | {
        "simulation_rms": {
            n: {"rms": r, "unit": u} for n, r, u in zip(signals.names, signals.rms, signals.units, strict=True)
        }
    }
