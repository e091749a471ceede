"""`excite score`: any trajectory judged as a design is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from excite import identification, reports, trajectories
from excite.logs import PlannedDrive, read_drive
from excite.model import Model, parameter_descriptions
from excite.model.machine import Problem
from excite.reports import Account
from excite.simulation import KITS, Motion
from excite.trajectories import Score
from excite.workflows import design_request, design_workflow, requests


def score(
    place: Path,
    machine: str,
    profile: Path,
    problem: str | None,
    sensors: bool = False,
    kit: str = "full",
    duration: float | None = None,
) -> dict[str, Any]:
    """Judge a profile as a design into a folder; return the summary.

    machine: a shipped name or a path. profile: a file, or the folder of a design. problem: None for the machine's own.
    sensors: also find what each sensor of a kit buys. duration [s]: None for the problem's own. The folder can be
    verified as a design can.
    Raises UsageError, MachineError, LogError, SimulationError.
    """
    model = requests.build_model(machine, fit_sensor_effects=False)
    drive = read_drive(profile, model, any_rate=True)
    _, account = score_from(model, drive, str(profile), problem, sensors, kit, duration)
    return account().write(place)


def score_from(
    model: Model, drive: PlannedDrive, called: str, problem: str | None, sensors: bool, kit: str, duration: float | None
) -> tuple[Score, Callable[[], Account]]:
    """Judge a drive as a design; return the score and its account. called: what the drive is called."""
    name, chosen = requests.choose_problem(model.machine, problem, duration)
    requests.require_known("--kit", kit, KITS)
    model, given = design_request.without_hidden_zeros(model)
    model, assumed = design_request.with_assumed_noise(model)
    design_request.require_noise_figures(model)
    found = trajectories.score(model, chosen, drive.torque, drive.start, drive.nu0, drive.planned)
    valued = kit if sensors else None
    return found, partial(score_account, model, name, chosen, found, called, valued, given, assumed)


def score_account(
    model: Model,
    name: str,
    problem: Problem,
    found: Score,
    profile: str,
    kit: str | None = None,
    given_zeros: Sequence[str] = (),
    assumed_noise: Sequence[str] = (),
) -> Account:
    """Give an account of a drive judged on a problem of some name.

    profile: what the drive is called. kit: whose sensors are valued, None for none. given_zeros: encoder zeros that
    are sought, but that no torque shows by itself: those of the machine file are taken. assumed_noise: sensors of an
    arm whose noise figure is assumed.
    """
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "problem": name,
        "profile": profile,
        "duration_s": float(found.motion.t[-1]),
        "cond_phi": found.cond_phi,
        "cond_w": found.cond_w,
        "sigma_percent": found.sigma_percent,
        "worst_parameter": found.worst_parameter,
        "worst_percent": found.worst_percent,
        "median_percent": found.median_percent,
        "max_violation": found.max_violation,
        "violations": found.violations,
        "excesses": trajectories.excesses_in_units(model, problem, found.motion, found.violations),
        "share_outside_law": found.share_outside_law,
        "meanings": parameter_descriptions(model),
        "versions": requests.package_versions(),
    }
    taken = {"given_zeros": list(given_zeros), "assumed_noise": list(assumed_noise)}
    summary |= {key: names for key, names in taken.items() if names}
    title = f"{model.machine.title}: {name}, {Path(profile).name}"
    figures = {
        "design.png": partial(reports.design_figure, model, problem, found.motion, title),
        "sigma.png": partial(reports.sigma_figure, found.sigma_percent, title),
    }
    if kit is not None:
        needed = identification.needed_sensors(model, identification.recommend_method(model))
        values = trajectories.value_sensors(model, found.motion, kit, needed)
        summary |= {"kit": kit, "sensors": [vars(v) for v in values]}
        figures["sensors.png"] = partial(reports.sensors_figure, values, f"{title}, kit {kit}")
    rows = {n: {"sigma_percent": v, "what": summary["meanings"].get(n, "")} for n, v in found.sigma_percent.items()}
    return Account(
        "score",
        summary,
        figures,
        partial(reports.rows_frame, rows, "parameter"),
        (partial(design_workflow.write_drive, model, found.motion),),
    )


def judge_limits(model: Model, motion: Motion, placed: bool) -> Mapping[str, float]:
    """Return the excess of a motion over every limit of the machine's own problem, none if it has no problem.

    placed: whether the start pose is the drive's own; else the drive is placed on the lane as a design is.
    """
    if model.machine.problem is None:
        return {}
    problem = model.machine.problems[model.machine.problem]
    if not placed:
        motion = trajectories.simulate_on_lane(model, problem, motion.u, motion.nu[0])
    return trajectories.check_limits(model, problem, motion)


def excesses(model: Model, motion: Motion, violations: Mapping[str, float]) -> dict[str, str]:
    """Say in units what shares of a range do not, of the violations that `judge_limits` finds."""
    if model.machine.problem is None:
        return {}
    return trajectories.excesses_in_units(model, model.machine.problems[model.machine.problem], motion, violations)
