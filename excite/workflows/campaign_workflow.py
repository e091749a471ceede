"""`excite design --target`: the fewest and shortest drives that attain an accuracy, one design folder each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from excite import reports, trajectories
from excite.errors import MachineError, UsageError
from excite.model import Model, parameter_descriptions
from excite.model.machine import Problem
from excite.reports import Account
from excite.trajectories import Campaign
from excite.workflows import design_request, design_workflow, requests
from excite.workflows.design_request import DesignRequest, DesignResult
from excite.workflows.payload_design import loaded_machines, payload_summary
from excite.workflows.progress import Bar, no_bar

DEFAULT_OBJECTIVE = "worst"


@dataclass(frozen=True)
class CampaignRequest:
    """Options of drives designed together.

    target [%]: of the objective's value. parameters [%]: of single parameters, if their targets differ; `target` is
    then that of all others, None if the others don't matter. drives: the most. within_s [s]: longest time of driving.
    design: options of every design.
    """

    target: float | None
    parameters: Mapping[str, float] = field(default_factory=dict)
    drives: int = 1
    within_s: float | None = None
    design: DesignRequest = field(default_factory=lambda: DesignRequest(DEFAULT_OBJECTIVE))

    @property
    def tightest(self) -> float:
        """Smallest target [%], in which the others are expressed."""
        return min([*self.parameters.values(), *([] if self.target is None else [self.target])])


def read_targets(targets: Sequence[str]) -> tuple[float | None, dict[str, float]]:
    """Read PERCENT and NAME=PERCENT as the target of all parameters, None if not given, and those of single ones."""
    general: float | None = None
    single: dict[str, float] = {}
    for text in targets:
        name, _, number = text.rpartition("=")
        try:
            percent = float(number)
        except ValueError:
            raise UsageError(f"--target {text}: give a number in per cent, or PARAMETER=PERCENT") from None
        if (name in single) if name else (general is not None):
            raise UsageError(f"--target {text}: {name or 'the general target'} is given twice")
        if name:
            single[name] = percent
        else:
            general = percent
    return general, single


def check_campaign(request: CampaignRequest, model: Model, problem: Problem) -> CampaignRequest:
    """Return a request with its objective chosen.

    Raises UsageError for options that do not go together, MachineError for a trajectory of a machine that is no arm.
    """
    one = request.design
    objective = DEFAULT_OBJECTIVE if one.objective == "cond" else one.objective
    allowed = [n for n, o in trajectories.OBJECTIVES.items() if o.shown_as == "percent"]
    if objective not in allowed:
        raise UsageError(f"--target: needs an --objective in per cent: {', '.join(allowed)} (got {objective})")
    design_request.check_arm_options(model, one)
    if one.driver or one.robust or one.sigma_max is not None:
        raise UsageError("--target: does not go with --driver, --robust or --sigma-max")
    if request.parameters and (objective != DEFAULT_OBJECTIVE or one.payload_kg is not None):
        raise UsageError(
            f"--target: targets of single parameters need --objective {DEFAULT_OBJECTIVE}, and go without --payload"
        )
    for name, percent in request.parameters.items():
        requests.require_known("--target", name, model.base.names)
        requests.require_positive(f"--target {name}", percent, "%")
    requests.require_positive("--target", request.target, "%")
    least = 4 * float(problem.knot_s)
    if request.within_s is not None and not request.within_s >= least:
        raise UsageError(f"--within: must be at least {least:g} s, the shortest drive (got {request.within_s:g})")
    if request.drives < 1:
        raise UsageError(f"--drives: must be at least 1 (got {request.drives})")
    return replace(request, design=replace(one, objective=objective))


@dataclass(frozen=True)
class CampaignResult:
    """Drives designed together for a model; with earlier logs, its nominal values are their estimate.

    given_zeros, assumed_noise: as in `DesignResult`.
    """

    model: Model
    campaign: Campaign
    given_zeros: tuple[str, ...] = ()
    assumed_noise: tuple[str, ...] = ()


def campaign_from(
    model: Model,
    problem: Problem,
    request: CampaignRequest,
    progress: Callable[[int, int, float], None] | None = None,
) -> CampaignResult:
    """Design drives together for a model and a problem as requested (`check_campaign` first).

    Raises MachineError for sensors of unknown noise, and the errors of `trajectories.design_campaign`.
    """
    one = request.design
    model, assumed = design_request.with_assumed_noise(model)
    design_request.require_noise_figures(model)
    model, zeros = design_request.without_hidden_zeros(model)
    model, prior = design_request.with_earlier_logs(model, one.after)
    contrasts, machines = design_request.contrasts(model, one), loaded_machines(model, one.payload_kg)
    if request.parameters:
        by = {n: request.parameters.get(n, request.target) for n in model.base.names}
        counted = {n: t for n, t in by.items() if t is not None}
        contrasts = trajectories.rival_contrasts(model, list(counted))
        contrasts = contrasts * [request.tightest / t for t in counted.values()]
    found = trajectories.design_campaign(
        model,
        problem,
        request.tightest,
        request.drives,
        request.within_s,
        one.objective,
        contrasts,
        prior,
        one.starts,
        one.seed,
        one.budget_s,
        progress,
        one.solver,
        one.trajectory,
        machines,
    )
    return CampaignResult(model, found, zeros, assumed)


def campaign(
    place: Path,
    machine: str,
    problem: str | None,
    duration: float | None,
    request: CampaignRequest,
    bar: Bar = no_bar,
) -> dict[str, Any]:
    """Design drives together into a folder, each in a folder of its own; return the summary.

    duration [s]: longest of one drive, None for the problem's own. Raises UsageError, MachineError, InfeasibleError,
    LogError.
    """
    model, name, chosen = design_workflow.prepare_design(machine, problem, duration, request.design)
    request = check_campaign(request, model, chosen)
    begin = time.perf_counter()
    with bar("designing") as advance:
        try:
            found = campaign_from(model, chosen, request, advance)
        except np.linalg.LinAlgError:
            raise MachineError(f"{model.machine.name}: {design_request.singular_message(name)}") from None
    return campaign_account(found, name, chosen, request, time.perf_counter() - begin).write(place)


def campaign_account(
    found: CampaignResult, name: str, problem: Problem, request: CampaignRequest, wall_s: float
) -> Account:
    """Give an account of drives designed together for a problem of some name. wall_s [s]: what it took."""
    model, c = found.model, found.campaign
    sigma = c.sigma_percent
    worst = max(sigma, key=lambda n: sigma[n])
    drives = [
        {
            "folder": f"drive-{k}",
            "duration_s": c.duration_s,
            "alone_percent": alone,
            "cond_phi": d.cond_phi,
            "max_violation": d.max_violation,
        }
        for k, (d, alone) in enumerate(zip(c.drives, c.alone_percent, strict=True), 1)
    ]
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "problem": name,
        "objective": c.objective,
        "reached": c.reached,
        "target_percent": c.target,
        "targets": {**({} if request.target is None else {"": request.target}), **request.parameters},
        "attained_percent": c.percent,
        "drives": drives,
        "most_drives": request.drives,
        "within_s": request.within_s,
        "longest_s": float(problem.duration_s),
        "duration_s": c.duration_s,
        "total_s": c.total_s,
        "sigma_percent": sigma,
        "worst_parameter": worst,
        "worst_percent": sigma[worst],
        "median_percent": float(np.median(list(sigma.values()))),
        "trials": [vars(t) for t in c.trials],
        "max_violation": max(d.max_violation for d in c.drives),
        "complete": c.complete,
        "meanings": parameter_descriptions(model),
        "starts": request.design.starts,
        "seed": request.design.seed,
        "wall_s": wall_s,
        "versions": requests.package_versions(),
    }
    if found.given_zeros:
        summary["given_zeros"] = list(found.given_zeros)
    if found.assumed_noise:
        summary["assumed_noise"] = list(found.assumed_noise)
    if request.design.payload_kg is not None:
        summary["payload"] = payload_summary(found.model, request.design.payload_kg, [d.motion for d in c.drives])
    if request.design.after:
        summary["after"] = [str(p) for p in request.design.after]
    title = f"{model.machine.title}: {name}"
    return Account(
        "campaign",
        summary,
        {
            "campaign.png": partial(reports.campaign_figure, summary, title),
            "sigma.png": partial(reports.sigma_figure, sigma, f"{title}, all drives together"),
        },
        partial(reports.rows_frame, {str(d["folder"]): d for d in drives}, "drive"),
        tuple(partial(_write_drive, found, k, name, problem, request) for k in range(len(c.drives))),
    )


def _write_drive(
    found: CampaignResult, k: int, name: str, problem: Problem, request: CampaignRequest, place: Path
) -> None:
    """Write drive k as a design folder of its own; its accuracy is that of the drive alone."""
    c = found.campaign
    aim = trajectories.compose_objective(found.model, DEFAULT_OBJECTIVE)
    alone = DesignResult(found.model, aim, c.drives[k], assumed_noise=found.assumed_noise)
    account = design_workflow.design_account(alone, name, problem.lasting(c.duration_s), request.design, 0.0)
    account.summary["advice"] = (
        f"drive {k + 1} of {len(c.drives)} that were designed together: the accuracy here is that of this drive alone"
    )
    folder = place / f"drive-{k + 1}"
    folder.mkdir()
    account.write(folder)
