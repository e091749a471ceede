"""`excite design` and `excite compare`: from a machine to drives, figures, a report and summary.json."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite import reports, trajectories
from excite.errors import MachineError, UsageError
from excite.interrupt import note_first_interrupt
from excite.logs import PlannedDrive, profile_of, read_drive, torque_column
from excite.model import Model, parameter_descriptions
from excite.model.machine import Problem
from excite.reports import Account
from excite.simulation import Motion
from excite.trajectories import Comparison, ComparisonRow, Score
from excite.workflows import design_request, requests
from excite.workflows.design_request import DesignRequest, DesignResult
from excite.workflows.progress import Bar, no_bar


def design(
    place: Path, machine: str, problem: str | None, duration: float | None, request: DesignRequest, bar: Bar = no_bar
) -> dict[str, Any]:
    """Design a drive for a machine into a folder; return the summary.

    machine: a shipped name or a path. problem: None for the machine's own. duration [s]: None for the problem's own.
    Raises UsageError, MachineError, InfeasibleError, LogError.
    """
    model, name, chosen = prepare_design(machine, problem, duration, request)
    return design_model(place, model, name, chosen, request, bar)


def prepare_design(
    machine: str | Model, problem: str | None, duration: float | None, request: DesignRequest
) -> tuple[Model, str, Problem]:
    """Return model, problem and its name for a request, with the effects that the drive must separate.

    Raises UsageError, MachineError.
    """
    model = machine if isinstance(machine, Model) else requests.build_model(machine, fit_sensor_effects=False)
    name, chosen = requests.choose_problem(model.machine, problem, duration)
    if name not in model.machine.problems:
        model = replace(model, machine=model.machine.model_copy(update={"problem": name, "problems": {name: chosen}}))
    if request.between:
        model = design_request.add_rival_effects(model, request.between, float(chosen.duration_s))
    requests.require_objective(request.objective, model.machine, request.of)
    requests.require_known("--solver", request.solver, tuple(trajectories.SOLVERS))
    if request.trajectory is not None:
        requests.require_known("--trajectory", request.trajectory, tuple(trajectories.TRAJECTORIES))
    requests.require_positive("--budget", request.budget_s, "s")
    requests.require_positive("--sigma-max", request.sigma_max, "%")
    return model, name, chosen


def design_model(
    place: Path, model: Model, name: str, chosen: Problem, request: DesignRequest, bar: Bar = no_bar
) -> dict[str, Any]:
    """Design a drive for a model and a problem of some name into a folder; return the summary."""
    begin = time.perf_counter()
    with bar("designing") as advance:
        try:
            found = design_request.design_from(model, chosen, request, advance)
        except np.linalg.LinAlgError:
            effects = "; is an effect outside of what the drive can reach?" if model.effects else ""
            raise MachineError(f"{model.machine.name}: {design_request.singular_message(name)}{effects}") from None
    wall = time.perf_counter() - begin
    with note_first_interrupt():  # a drive that was found is written
        return design_account(found, name, chosen, request, wall).write(place)


def design_account(found: DesignResult, name: str, problem: Problem, request: DesignRequest, wall_s: float) -> Account:
    """Give an account of a design for a problem of some name; its frame is the profile. wall_s [s]: what it took."""
    model = found.model
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "problem": name,
        "duration_s": float(problem.duration_s),
        **design_request.summarise_result(request, found),
        "excesses": trajectories.excesses_in_units(model, problem, found.design.motion, found.design.violations),
        "meanings": parameter_descriptions(model),
        "wall_s": wall_s,
        "versions": requests.package_versions(),
    }
    title = f"{model.machine.title}: {name}, cond(Phi) = {found.design.cond_phi:.2f}"
    return Account(
        "design",
        summary,
        {
            "design.png": partial(reports.design_figure, model, problem, found.design.motion, title),
            "sigma.png": partial(reports.sigma_figure, summary["sigma_percent"], title),
        },
        partial(reports.drive_frame, model, found.design.motion),
        (
            partial(write_drive, model, found.design.motion),
            *(() if found.accurate is None else (partial(_write_other_end, found, name, problem, request, wall_s),)),
        ),
        scene=partial(reports.motion_scene, model, found.design.motion) if model.follows_positions else None,
        joints=partial(reports.joints_frame, model, found.design.motion),
    )


def _write_other_end(
    found: DesignResult, name: str, problem: Problem, request: DesignRequest, wall_s: float, place: Path
) -> None:
    """Write the drive for accuracy alone as a design folder of its own, to choose it without another search."""
    assert found.accurate is not None
    aim = replace(found.aim, name="accuracy")
    alone = replace(found, aim=aim, design=found.accurate, first=None, bound=None, accurate=None, random_percent=None)
    folder = place / design_request.OTHER_END
    folder.mkdir()
    design_account(alone, name, problem, replace(request, objective="accuracy"), wall_s).write(folder)


def write_drive(model: Model, motion: Motion, place: Path) -> None:
    """Write profile.csv and machine.json, from which `trajectories.read_design` reads a drive back."""
    profile_of(model, motion).to_csv(place / "profile.csv", index=False)
    (place / "machine.json").write_text(model.machine.model_dump_json(indent=1) + "\n", encoding="utf-8")


def is_own_drive(name: str) -> bool:
    """Tell a profile or a design's folder from the name of a usual drive."""
    return name not in trajectories.BASELINES and (bool(Path(name).suffix) or Path(name).is_dir())


def read_rivals(
    against: Sequence[str | PlannedDrive], model: Model, problem: Problem
) -> tuple[tuple[str, ...], dict[str, Score]]:
    """Split what a design is compared with into names of `BASELINES`, and scores of profiles by their files' names.

    Drives without a file are called drive 1, drive 2 and so on. Raises UsageError for an
    unknown name or two drives of one name, MachineError for an arm, LogError.
    """
    if model.follows_positions:
        raise MachineError(
            f"{model.machine.name}: is an arm, and falls under the torques of the usual drives; compare designs by"
            " `excite score` instead"
        )
    named = [name for name in against if isinstance(name, str)]
    usual = tuple(name for name in named if not is_own_drive(name))
    files = [Path(name) for name in named if is_own_drive(name)]
    for name in usual:
        requests.require_known("--against", name, tuple(trajectories.BASELINES))
    twice = sorted({f.name for f in files if [g.name for g in files].count(f.name) > 1})
    if twice:
        raise UsageError(f"--against: two drives are called {twice[0]}, rename one: a row is named after its file")
    given = [one for one in against if not isinstance(one, str)]
    drives = {f.name: read_drive(f, model, any_rate=True) for f in files}
    drives |= {f"drive {k}": one for k, one in enumerate(given, 1)}
    return usual, {
        n: trajectories.score(model, problem, d.torque, d.start, d.nu0, d.planned) for n, d in drives.items()
    }


def compare(
    place: Path,
    machine: str,
    problem: str | None,
    samples: int,
    against: Sequence[str],
    seed: int,
    budget: float | None,
    bar: Bar = no_bar,
) -> dict[str, Any]:
    """Compare the designed drive with usual ones into a folder; return the summary.

    samples: drives of each random kind. against: names of `BASELINES` and profiles of one's own, all of the former if
    empty. budget [s].
    Raises UsageError, MachineError, LogError.
    """
    model = requests.build_model(machine, fit_sensor_effects=False)
    _, account = compare_from(model, problem, samples, against, seed, budget, bar)
    return account().write(place)


def compare_from(
    model: Model,
    problem: str | None,
    samples: int,
    against: Sequence[str | PlannedDrive],
    seed: int,
    budget: float | None,
    bar: Bar = no_bar,
) -> tuple[Comparison, Callable[[], Account]]:
    """Compare the designed drive of a model with usual ones; return the comparison and its account."""
    name, chosen = requests.choose_problem(model.machine, problem, None)
    model, zeros = design_request.without_hidden_zeros(model)
    design_request.require_noise_figures(model)
    requests.require_positive("--budget", budget, "s")
    usual, own = read_rivals(against, model, chosen)
    with bar("comparing") as advance:
        result = trajectories.compare(model, chosen, samples, seed, budget, advance, usual, own)
    return result, partial(compare_account, model, name, result, samples, seed, budget, zeros)


def compare_account(
    model: Model,
    name: str,
    result: Comparison,
    samples: int,
    seed: int,
    budget: float | None,
    given_zeros: Sequence[str] = (),
) -> Account:
    """Give an account of a comparison on a problem of some name; options as in `compare`, zeros as in a score."""
    designs = [
        {
            "name": row.name,
            "cond_phi": row.cond_phi,
            "cond_w": row.cond_w,
            "worst_std_percent": row.worst_std_percent,
            "median_std_percent": row.median_std_percent,
            "max_violation": row.max_violation,
            "breaks": row.breaks,
            "excess": _excess(model, row, result.rows[0]),
            "kept": row.kept,
            "samples": row.samples,
            "wall_s": row.wall_s,
            "equal_score_s": row.equal_s,
            "knots": _knots_file(row),
            "own": row.own,
            "start": dict(zip(model.coordinates, row.start, strict=True)),
        }
        for row in result.rows
    ]
    summary = {
        "machine": model.machine.name,
        "problem": name,
        "objective": "cond",
        "samples": samples,
        "seed": seed,
        "budget_s": budget,
        "designs": designs,
        "ratio_equal_time": result.ratio_equal_time,
        "versions": requests.package_versions(),
    }
    if given_zeros:
        summary["given_zeros"] = list(given_zeros)
    title = f"{model.machine.title}: {name}, the designed drive and the usual ones"
    shown = {str(d["name"]): {k: v for k, v in d.items() if k not in ("name", "start", "knots")} for d in designs}
    return Account(
        "compare",
        summary,
        {"compare.png": partial(reports.compare_figure, result.rows, title)},
        partial(reports.rows_frame, shown, "drive"),
        (partial(_write_knots, model, result),),
    )


def _excess(model: Model, row: ComparisonRow, designed: ComparisonRow) -> str | None:
    """Say in units by how much a drive breaks a limit, None where it is a share of its range or nothing."""
    if row.breaks == trajectories.DURATION_LIMIT:
        lasts, wanted = (float(np.ptp(r.manoeuvre.times)) for r in (row, designed))
        return f"it lasts {lasts:g} s instead of {wanted:g} s"
    if row.breaks is None or not trajectories.is_rest_limit(row.breaks):
        return None
    return trajectories.describe_excess(model, row.breaks, row.max_violation)


def _knots_file(row: ComparisonRow) -> str:
    """Return the file of a drive's torques in the folder of a comparison."""
    file = row.name.replace(",", "").replace(" ", "-").removesuffix(".csv")
    return f"drives/{'own-' if row.own else ''}{file}.csv"


def _write_knots(model: Model, result: Comparison, place: Path) -> None:
    """Write the torques of every drive at its knots."""
    columns = ["t_s", *(torque_column(model, u) for u in model.inputs)]
    (place / "drives").mkdir()
    for row in result.rows:
        table = pd.DataFrame([[t, *u] for t, u in zip(row.manoeuvre.times, row.manoeuvre.torque, strict=True)])
        table.to_csv(place / _knots_file(row), index=False, header=columns, float_format="%.12g")
