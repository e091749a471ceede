"""The functions of `import excite`.

A machine is given by its name, its file or a model; a problem by name; a log as a path, a pandas DataFrame in the
machine's columns, or a `Log`; a drive as a profile, its DataFrame, a design folder, a `Design` or a `Motion`.
Defaults are those of the command of the same name.

A result prints as its command prints it, in a notebook too. `to_frame()` gives its numbers as a DataFrame with units in
`attrs["units"]`, `plot()` the figure of its report, `save(folder)` the files of the command (`excite.reports.Shown`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from excite import (
    identification,
    logs as readers,
    model as models,
    reports,
    simulation,
    trajectories,
    workflows,
)
from excite.errors import LogError
from excite.identification import Estimate, fit_slip_laws
from excite.logs import Log, PlannedDrive, Prepared
from excite.model import Model
from excite.model.machine import load_machine
from excite.model.mechanics import SoilConstants
from excite.reports import (
    Account,
    ShownAssessment,
    ShownCampaign,
    ShownComparison,
    ShownDesign,
    ShownEstimate,
    ShownLog,
    ShownPrediction,
    ShownScore,
    ShownSlip,
    ShownVerification,
)
from excite.simulation import Motion
from excite.trajectories import Design
from excite.workflows import CampaignRequest, DesignRequest, DiagnoseResult

__version__ = version("excite")

Machine = str | Path | Model
Source = str | Path | pd.DataFrame | Log
Drive = str | Path | np.ndarray | pd.DataFrame | Design | Motion


def load(machine: Machine) -> Model:
    """Load a machine and build its equations.

    machine: a shipped name (`excite machines` lists them) or a machine file (.toml); a model is returned as it is.
    Raises MachineError: file, key, what is wrong, what is allowed.
    """
    return machine if isinstance(machine, Model) else models.build(load_machine(machine))


def read_log(machine: Machine, source: Source) -> ShownLog:
    """Read and check a log of a machine.

    source: a file of any kind in `excite.logs.FORMATS` or a DataFrame in the machine's columns.
    Raises LogError: what is wrong, where (row, column), what to do.
    """
    model = load(machine)
    found = readers.prepare(model, [source]).logs
    if len(found) > 1:
        raise LogError(f"{found[0].source}: has gaps or rests, which make it {len(found)} logs: give it as it is")
    return ShownLog.of(found[0], partial(_log_account, model, source))


def design(
    machine: Machine,
    problem: str | None = None,
    objective: str = "cond",
    *,
    duration: float | None = None,
    sigma_max: float | None = None,
    cond_slack: float = 12.0,
    robust: bool = False,
    between: Sequence[str] = (),
    of: str | Path | None = None,
    starts: int = 2,
    seed: int = 0,
    budget: float | None = None,
    solver: str = "own",
    trajectory: str | None = None,
    payload: float | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> ShownDesign:
    """Design a test drive that makes the parameters of a machine identifiable.

    problem: a design problem of the machine file, its default one if not given.
    objective: a name of `excite.trajectories.OBJECTIVES`.
    duration [s]: length of the drive, if not the problem's.
    sigma_max [%]: bound on the largest attainable standard deviation.
    cond_slack [%]: with objective cond, by how much cond(Phi) may grow for the most accurate drive; 0 for the lowest.
    robust: design for machines up to 20 % off the nominal one.
    between: with objective discrimination, the effects NAME[@WHERE]=MAGNITUDE to separate, two or more.
    of: with objective prediction (mean) or prediction-max, the profile or design folder of the drive to predict.
    starts, seed: starting guesses and their random seed.
    budget [s]: time after which the search stops.
    solver: a name of `excite.trajectories.SOLVERS`: `own`, or `ipopt` for a check.
    trajectory: of an arm, a name of `excite.trajectories.TRAJECTORIES`: `free`, the default, or `fourier`.
    payload [kg]: of an arm, design for the payload's parameters, from drives without and with it.
    progress(done, total, best score): called during the search.
    Raises InfeasibleError with the limit that can't be kept, SolverError if the solver finds no optimum, UsageError for
    an unknown name.
    """
    request = DesignRequest(
        objective,
        sigma_max,
        robust,
        (),
        starts,
        seed,
        budget,
        tuple(between),
        cond_slack=cond_slack,
        solver=solver,
        of=None if of is None else Path(of),
        trajectory=trajectory,
        payload_kg=payload,
    )
    model, name, chosen = workflows.prepare_design(_as_given(machine), problem, duration, request)
    begin = time.perf_counter()
    found = workflows.design_from(model, chosen, request, progress)
    wall_s = time.perf_counter() - begin
    return ShownDesign.of(found.design, partial(workflows.design_account, found, name, chosen, request, wall_s))


def campaign(
    machine: Machine,
    target: float | Mapping[str, float],
    problem: str | None = None,
    objective: str = "worst",
    *,
    drives: int = 1,
    duration: float | None = None,
    within: float | None = None,
    after: Sequence[str | Path] = (),
    of: str | Path | None = None,
    payload: float | None = None,
    starts: int = 2,
    seed: int = 0,
    budget: float | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> ShownCampaign:
    """Design the fewest drives, then the shortest, that attain an accuracy together; the best found if none do.

    target [%]: of the worst parameter's standard deviation, or of single parameters by name, of which the others then
    don't matter (those of "" is the target of all others); with another objective in per cent, of its value.
    drives: the most. duration [s]: longest of one drive, the problem's if not given. within [s]: longest time of all.
    after: earlier logs, whose information counts. Other arguments as in `design`.
    `reached` tells whether the target is. Raises what `design` raises.
    """
    single = dict(target) if isinstance(target, Mapping) else {}
    general = single.pop("", None) if isinstance(target, Mapping) else target
    one = DesignRequest(
        objective,
        after=tuple(map(Path, after)),
        starts=starts,
        seed=seed,
        budget_s=budget,
        of=None if of is None else Path(of),
        payload_kg=payload,
    )
    model, name, chosen = workflows.prepare_design(_as_given(machine), problem, duration, one)
    request = workflows.check_campaign(CampaignRequest(general, single, drives, within, one), model, chosen)
    begin = time.perf_counter()
    found = workflows.campaign_from(model, chosen, request, progress)
    wall_s = time.perf_counter() - begin
    return ShownCampaign.of(found.campaign, partial(workflows.campaign_account, found, name, chosen, request, wall_s))


def simulate(
    machine: Machine,
    drive: Drive,
    *,
    seed: int = 0,
    noise: bool = True,
    kit: str = "full",
    effects: Sequence[str] = (),
    friction: str = "smoothed",
) -> pd.DataFrame:
    """Drive a machine in simulation and return the log that its sensors would write, units in `attrs["units"]`.

    drive: a profile (.csv), a design folder, a design, a motion, or torques (N, n_u) [N m] from rest.
    noise: False for exact signals.
    kit: a name of `excite.simulation.KITS`.
    effects: effects that the model lacks, NAME[@WHERE]=MAGNITUDE each.
    friction: a name of `excite.simulation.FRICTION_LAWS`; with "set-valued", joints stick.
    Raises LogError for a profile, MachineError for an effect, SimulationError for a motion that can't be integrated,
    UsageError for an unknown kit or friction.
    """
    model = load(machine)
    workflows.require_known("kit", kit, simulation.KITS)
    workflows.require_known("friction", friction, simulation.FRICTION_LAWS)
    given = _planned(model, drive)
    true = workflows.with_effects(model, effects, len(given.torque))
    motion = simulation.play_back(true, given.torque, given.q0, given.nu0, given.planned, friction=friction)
    return reports.log_frame(simulation.measure(true, motion, kit=kit, seed=seed, noise=noise), true.machine)


def identify(
    machine: Machine,
    logs: Source | Sequence[Source],
    method: str | None = None,
    unloaded: Estimate | None = None,
) -> ShownEstimate:
    """Estimate the parameters of a machine, with uncertainty, from one log or several.

    method: a name of `excite.identification.METHODS`, the one recommended for the machine if not given.
    unloaded: estimate of the machine without the payload that it carries in the logs; the summary then has the payload.
    Raises LogError for an unusable log, NoEstimateError if there is no estimate, UsageError for an unknown method.
    """
    model = load(machine)
    name = workflows.choose_method(method, model)
    ready = readers.prepare(model, _several(logs), identification.needed_sensors(model, name))
    found = workflows.identify_from(ready.model, ready.logs, name)
    said = () if found.agreement is None else (identification.describe_agreement(found.agreement),)
    noted = replace(found.estimate, notes=(*said, *ready.notes, *found.estimate.notes))
    return ShownEstimate.of(noted, partial(workflows.identify_account, model, ready, found, unloaded=unloaded))


def predict(machine: Machine, estimate: Estimate, target: Source | Drive) -> ShownPrediction:
    """Predict signals along another log or drive, with 95 % bands from the estimate's covariance.

    target: a log gives the torque of every drive along the motion that it shows, compared with the readings; a profile
    or any other drive as in `simulate` gives the motion under its torques, in open loop. A table is a profile if it
    has the columns of one.
    Raises NoEstimateError for an invalid estimate, LogError for an unusable target, SimulationError if the estimate is
    no machine that can be simulated.
    """
    model = load(machine)
    found = workflows.predict_from(model, estimate, _target(model, target))
    called = _called(target, "the log" if found.along == "log" else "the drive")
    account = partial(workflows.predict_account, model, estimate, found, f"by {estimate.method}", called)
    return ShownPrediction.of(found.prediction, account)


def diagnose(machine: Machine, logs: Source | Sequence[Source], *, budget_s: float | None = None) -> ShownAssessment:
    """Find what the model of a machine gets wrong along logs: named causes, their magnitudes, the gain of each.

    budget_s [s]: nothing new is begun after it, and the best answer so far is given.
    Raises LogError for an unusable log, NoEstimateError if nothing can be fitted.
    """
    model = load(machine)
    ready = readers.prepare(model, _several(logs), identification.needed_sensors(model, "joint"))
    found = workflows.diagnose_from(ready.model, ready.logs, budget_s=budget_s)
    name = model.machine.name if isinstance(machine, Model) else str(machine)
    return ShownAssessment.of(found.assessment, partial(_diagnose_account, name, ready, found))


def slip(
    table: str | Path | pd.DataFrame,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    per: str = "rim",
    radius: float | None = None,
    soil: SoilConstants | None = None,
    machine: str | None = None,
    where: str | None = None,
) -> ShownSlip:
    """Fit contact laws to a single-wheel test; `supported` has the laws that its data do not rule out.

    table: a file, or a DataFrame. columns: role -> column, "-NAME" for the opposite sign, where names are not
    recognised; roles are keys of `excite.logs.SLIP_ROLES`. units: role -> unit where headers say none.
    per: what the laws divide slip by, "rim" as in machine files or the "larger" of rim and forward speed; the laws
    depend on it. A column of slips is taken as divided by the larger speed, and converted.
    radius [m]: of the wheel, for a rate of turn. soil: constants whose law (18) is compared with the table.
    machine, where: for which `contact.toml` of `save` is written, a table to paste by default.
    Raises LogError for an unusable table, UsageError for an unknown `per` or contact, NotIdentifiableError for too few
    settings.
    """
    workflows.require_known("per", per, readers.SLIP_PER)
    fit = fit_slip_laws(readers.read_slip_table(table, columns, units, per, radius))
    return ShownSlip.of(fit, partial(workflows.slip_account, fit, soil, machine, where))


def verify(
    machine: Machine,
    drive: Drive,
    *,
    runs: int = 50,
    method: str | None = None,
    kit: str = "full",
    seed: int = 0,
) -> ShownVerification:
    """Simulate a drive with sensor flaws and identify from it, many times.

    drive: as in `simulate`. runs: simulated test days. The verification gives each parameter's bias, dispersion,
    predicted standard deviation and coverage of the 95 % interval. Raises UsageError for an unknown method or kit.
    """
    model = load(machine)
    workflows.require_known("kit", kit, simulation.KITS)
    name = workflows.choose_method(method, model, kit)
    motion = drive if isinstance(drive, Motion) else _motion(model, drive)
    found = identification.verify(model, motion, name, kit, runs, seed)
    called = _called(drive, "the drive")
    return ShownVerification.of(found, partial(workflows.verify_account, model, motion, found, seed, called))


def score(
    machine: Machine,
    drive: Drive,
    problem: str | None = None,
    *,
    duration: float | None = None,
    sensors: bool = False,
    kit: str = "full",
) -> ShownScore:
    """Judge any drive as a design: condition numbers, attainable accuracy, limits, on a fresh simulation.

    drive: as in `simulate`; one that gives no pose is placed on the lane as a design is. problem: a design problem of
    the machine file, its default one if not given. duration [s]: the problem's own if not given. sensors: also find
    what each sensor of a kit buys, in `summary["sensors"]`, printed and drawn (`plot("sensors")`).
    Raises LogError for a profile, MachineError for sensors of unknown noise, UsageError for an unknown problem or kit,
    SimulationError for a motion that can't be integrated.
    """
    model = workflows.build_model(str(machine), fit_sensor_effects=False) if not isinstance(machine, Model) else machine
    model, zeros = workflows.without_hidden_zeros(model)
    name, chosen = workflows.choose_problem(model.machine, problem, duration)
    workflows.require_noise_figures(model)
    given = _planned(model, drive, any_rate=True)
    found = trajectories.score(model, chosen, given.torque, given.start, given.nu0, given.planned)
    workflows.require_known("kit", kit, simulation.KITS)
    called = _called(drive, "the drive")
    valued = kit if sensors else None
    return ShownScore.of(found, partial(workflows.score_account, model, name, chosen, found, called, valued, zeros))


def compare(
    machine: Machine,
    problem: str | None = None,
    *,
    against: Sequence[str] = (),
    samples: int = 20,
    seed: int = 0,
    budget: float | None = None,
) -> ShownComparison:
    """Compare the designed drive with the usual ones on the same problem, limits and time.

    against: names of `excite.trajectories.BASELINES`, and profiles (.csv) or folders of designs; all the usual drives
    if not given. samples: drives of every random kind.
    Raises UsageError for an unknown name, MachineError for sensors of unknown noise.
    """
    model = workflows.build_model(str(machine), fit_sensor_effects=False) if not isinstance(machine, Model) else machine
    name, chosen = workflows.choose_problem(model.machine, problem, None)
    model, zeros = workflows.without_hidden_zeros(model)
    workflows.require_noise_figures(model)
    usual, own = workflows.read_rivals("against", against, model, chosen)
    found = trajectories.compare(model, chosen, samples, seed, budget, None, usual, own)
    account = partial(workflows.compare_account, model, name, found, samples, seed, budget, zeros)
    return ShownComparison.of(found, account)


def _as_given(machine: Machine) -> str | Model:
    return machine if isinstance(machine, Model) else str(machine)


def _called(given: object, otherwise: str) -> str:
    """Return what a log or drive is called: its path, or a word for one that has none."""
    return str(given) if isinstance(given, str | Path) else otherwise


def _log_account(model: Model, source: Source) -> Account:
    machine = model.machine
    if isinstance(source, Log):
        table = readers.table_from(machine, source)
    else:
        table = source if isinstance(source, pd.DataFrame) else readers.table_of(source, machine)
    name = source.source if isinstance(source, Log) else _called(source, "the table")
    return reports.log_account(table, machine, name, workflows.package_versions())


def _diagnose_account(machine: str, ready: Prepared, found: DiagnoseResult) -> Account:
    drive = workflows.separating_drive(Path(), ready.model.machine, workflows.rivals(found), design_next=False)
    return workflows.diagnose_account(machine, ready, found, drive)


def _several(logs: Source | Sequence[Source]) -> list[Source]:
    return [logs] if isinstance(logs, str | Path | pd.DataFrame | Log) else list(logs)


def _target(model: Model, target: Source | Drive) -> Source | PlannedDrive:
    """Return what a prediction is along: a log or profile as it is, any other drive with its planned motion."""
    if isinstance(target, np.ndarray | Design | Motion):
        return _planned(model, target)
    return target


def _planned(model: Model, drive: Drive, any_rate: bool = False) -> PlannedDrive:
    """Return the torques of a drive, the state at its start and the motion that it expects.

    any_rate: as for `excite.logs.read_drive`.
    """
    if isinstance(drive, np.ndarray):
        rest = np.zeros(len(model.coordinates))
        return PlannedDrive(drive, rest, rest, placed=False)
    if isinstance(drive, Design):
        drive = drive.motion
    if isinstance(drive, Motion):
        return PlannedDrive(drive.u, drive.q[0], drive.nu[0], drive.q, drive.nu)
    return readers.read_drive(drive, model, any_rate)


def _motion(model: Model, drive: Drive) -> Motion:
    given = _planned(model, drive)
    return simulation.play_back(model, given.torque, given.q0, given.nu0, given.planned)
