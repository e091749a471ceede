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

import pandas as pd

from excite import (
    identification,
    logs as readers,
    model as models,
    reports,
    simulation,
    workflows,
)
from excite.calls import (
    Drive,
    Machine,
    Source,
    as_given,
    as_list,
    motion_of,
    name_of,
    planned_drive,
    prediction_target,
    recorded,
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
from excite.workflows import CampaignRequest, DesignRequest, DiagnoseResult

__version__ = version("excite")


@recorded
def load(machine: Machine) -> Model:
    """Load a machine and build its equations.

    Parameters:
        machine: a shipped name (`excite machines` lists them), a machine file (.toml), or a model.

    Returns:
        The model; one that was given is returned as it is.

    Raises:
        MachineError: file, key, what is wrong, what is allowed.

    Example:
        >>> excite.load("va12_straight").base.names[:3]
        ('M', 'ZZ1', 'Fv1')
    """
    return machine if isinstance(machine, Model) else models.build(load_machine(machine))


@recorded
def read_log(machine: Machine, source: Source) -> ShownLog:
    """Read and check a log of a machine.

    Parameters:
        machine: a name, a file or a model.
        source: a file of any kind in `excite.logs.FORMATS`, or a DataFrame in the machine's columns.

    Returns:
        The log; printed, it is the check of the log.

    Raises:
        LogError: what is wrong, where (row, column), what to do.

    Example:
        >>> table = excite.simulate("emps", 20 * np.sin(np.arange(3000) / 100)[:, None])
        >>> len(excite.read_log("emps", table).t)
        3000
    """
    model = load(machine)
    found = readers.prepare(model, [source]).logs
    if len(found) > 1:
        raise LogError(f"{found[0].source}: has gaps or rests, which make it {len(found)} logs: give it as it is")
    return ShownLog.of(found[0], partial(_log_account, model, source))


@recorded
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
    of: Drive | None = None,
    starts: int = 2,
    seed: int = 0,
    budget: float | None = None,
    solver: str = "own",
    trajectory: str | None = None,
    payload: float | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> ShownDesign:
    """Design a test drive that makes the parameters of a machine identifiable.

    Parameters:
        machine: a name, a file or a model.
        problem: a design problem of the machine file, its default one if not given.
        objective: a name of `excite.trajectories.OBJECTIVES`.
        duration: [s] length of the drive, if not the problem's.
        sigma_max: [%] bound on the largest attainable standard deviation.
        cond_slack: [%] with objective cond, by how much cond(Phi) may grow for the most accurate drive.
        robust: design for machines up to 20 % off the nominal one.
        between: with objective discrimination, the effects NAME[@WHERE]=MAGNITUDE to separate, two or more.
        of: with objective prediction (mean) or prediction-max, the drive to predict, as in `simulate`.
        starts: starting guesses.
        seed: of the starting guesses.
        budget: [s] time after which the search stops.
        solver: a name of `excite.trajectories.SOLVERS`: `own`, or `ipopt` for a check.
        trajectory: of an arm, a name of `excite.trajectories.TRAJECTORIES`: `free`, the default, or `fourier`.
        payload: [kg] of an arm, design for the payload's parameters, from drives without and with it.
        progress: called with (done, total, best score) during the search.

    Returns:
        The drive: `motion`, `cond_phi`, `sigma` and `joints` as DataFrames; `to_frame()` is its profile.

    Raises:
        InfeasibleError: no drive keeps every limit; names the limit.
        SolverError: the solver finds no optimum.
        UsageError: an unknown name, or arguments that do not go together.

    Example:
        >>> drive = excite.design("va12_straight", objective="accuracy", duration=10, starts=1)
        >>> list(drive.sigma.columns)
        ['std_percent', 'meaning']
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
        of=_predicted(machine, of),
        trajectory=trajectory,
        payload_kg=payload,
    )
    model, name, chosen = workflows.prepare_design(as_given(machine), problem, duration, request)
    begin = time.perf_counter()
    found = workflows.design_from(model, chosen, request, progress)
    wall_s = time.perf_counter() - begin
    return ShownDesign.of(found.design, partial(workflows.design_account, found, name, chosen, request, wall_s))


@recorded
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
    of: Drive | None = None,
    payload: float | None = None,
    starts: int = 2,
    seed: int = 0,
    budget: float | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> ShownCampaign:
    """Design the fewest drives, then the shortest, that attain an accuracy together.

    Parameters:
        machine: a name, a file or a model.
        target: [%] of the worst parameter's standard deviation, or of single parameters by name, of which the others
            then don't matter ("" is the target of all others); with another objective in per cent, of its value.
        problem, objective, of, starts, seed, budget, progress: as in `design`.
        drives: the most.
        duration: [s] longest of one drive, the problem's if not given.
        within: [s] longest time of all drives.
        payload: [kg] of an arm, drives without and with a payload whose parameters are to be accurate.
        after: earlier logs, whose information counts.

    Returns:
        The drives, the best found if none attain the target; `reached` tells which.

    Raises:
        InfeasibleError, SolverError, UsageError: as in `design`.

    Example:
        >>> day = excite.campaign("va12_straight", target=20.0, duration=10, starts=1)
        >>> len(day.drives)
        1
    """
    single = dict(target) if isinstance(target, Mapping) else {}
    general = single.pop("", None) if isinstance(target, Mapping) else target
    one = DesignRequest(
        objective,
        after=tuple(map(Path, after)),
        starts=starts,
        seed=seed,
        budget_s=budget,
        of=_predicted(machine, of),
        payload_kg=payload,
    )
    model, name, chosen = workflows.prepare_design(as_given(machine), problem, duration, one)
    request = workflows.check_campaign(CampaignRequest(general, single, drives, within, one), model, chosen)
    begin = time.perf_counter()
    found = workflows.campaign_from(model, chosen, request, progress)
    wall_s = time.perf_counter() - begin
    return ShownCampaign.of(found.campaign, partial(workflows.campaign_account, found, name, chosen, request, wall_s))


@recorded
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
    """Drive a machine in simulation and return the log that its sensors would write.

    Parameters:
        machine: a name, a file or a model.
        drive: a profile (.csv) or its DataFrame, a design folder, a design, a motion, or torques (N, n_u) [N m] from
            rest at the machine's sampling rate.
        seed: of the noise.
        noise: False for exact signals.
        kit: a name of `excite.simulation.KITS`.
        effects: effects that the model lacks, NAME[@WHERE]=MAGNITUDE each.
        friction: a name of `excite.simulation.FRICTION_LAWS`; with "set-valued", joints stick.

    Returns:
        The log in the machine's columns, with units in `attrs["units"]`.

    Raises:
        LogError: a profile that can't be used.
        MachineError: an unknown effect.
        SimulationError: a motion that can't be integrated.
        UsageError: an unknown kit or friction.

    Example:
        >>> log = excite.simulate("va12_straight", 2000 * np.ones((200, 2)), seed=1)
        >>> log.attrs["units"]["u1_Nm"]
        'N m'
    """
    model = load(machine)
    workflows.require_known("kit", kit, simulation.KITS)
    workflows.require_known("friction", friction, simulation.FRICTION_LAWS)
    given = planned_drive(model, drive)
    true = workflows.with_effects(model, effects, len(given.torque))
    motion = simulation.play_back(true, given.torque, given.q0, given.nu0, given.planned, friction=friction)
    return reports.log_frame(simulation.measure(true, motion, kit=kit, seed=seed, noise=noise), true.machine)


@recorded
def identify(
    machine: Machine, logs: Source | Sequence[Source], method: str | None = None, unloaded: Estimate | None = None
) -> ShownEstimate:
    """Estimate the parameters of a machine, with uncertainty, from one log or several.

    Parameters:
        machine: a name, a file or a model.
        logs: a file, a DataFrame or a `Log`, or several.
        method: a name of `excite.identification.METHODS`, the one recommended for the machine if not given.
        unloaded: estimate of the machine without the payload that it carries in the logs; the summary then has the
            payload.

    Returns:
        The estimate: `value`, `std`, `interval95`; `estimate["M"]` is the row of a parameter, `to_frame()` all rows.

    Raises:
        LogError: an unusable log.
        NoEstimateError: there is no estimate.
        UsageError: an unknown method.

    Example:
        >>> log = excite.simulate("va12_straight", 2000 * np.sin(np.arange(1500) / 80)[:, None] * [1, 1], seed=1)
        >>> estimate = excite.identify("va12_straight", log, "ols")
        >>> estimate["M"]["unit"]
        'kg'
    """
    model = load(machine)
    name = workflows.choose_method(method, model)
    ready = readers.prepare(model, as_list(logs), identification.needed_sensors(model, name))
    found = workflows.identify_from(ready.model, ready.logs, name)
    said = () if found.agreement is None else (identification.describe_agreement(found.agreement),)
    noted = replace(found.estimate, notes=(*said, *ready.notes, *found.estimate.notes))
    return ShownEstimate.of(noted, partial(workflows.identify_account, model, ready, found, unloaded=unloaded))


@recorded
def predict(machine: Machine, estimate: Estimate, target: Source | Drive) -> ShownPrediction:
    """Predict signals along another log or drive, with 95 % bands from the estimate's covariance.

    Parameters:
        machine: a name, a file or a model.
        estimate: of that machine.
        target: a log gives the torque of every drive along the motion that it shows, compared with the readings; a
            profile or any other drive as in `simulate` gives the motion under its torques, in open loop. A table is a
            profile if it has the columns of one.

    Returns:
        The prediction: `value`, `band`, and along a log `measured`; `to_frame()` is a table over time.

    Raises:
        NoEstimateError: an invalid estimate.
        LogError: an unusable target.
        SimulationError: the estimate is no machine that can be simulated.

    Example:
        >>> log = excite.simulate("va12_straight", 2000 * np.sin(np.arange(1500) / 80)[:, None] * [1, 1], seed=1)
        >>> estimate = excite.identify("va12_straight", log, "ols")
        >>> excite.predict("va12_straight", estimate, log).names
        ('u1_Nm', 'u4_Nm')
    """
    model = load(machine)
    found = workflows.predict_from(model, estimate, prediction_target(model, target))
    called = name_of(target, "the log" if found.along == "log" else "the drive")
    account = partial(workflows.predict_account, model, estimate, found, f"by {estimate.method}", called)
    return ShownPrediction.of(found.prediction, account)


@recorded
def diagnose(machine: Machine, logs: Source | Sequence[Source], *, budget_s: float | None = None) -> ShownAssessment:
    """Find what the model of a machine gets wrong along logs: named causes, their magnitudes, the gain of each.

    Parameters:
        machine: a name, a file or a model.
        logs: a file, a DataFrame or a `Log`, or several.
        budget_s: [s] nothing new is begun after it, and the best answer so far is given.

    Returns:
        The diagnosis with the gain of its findings; `to_frame()` has a row for each finding.

    Raises:
        LogError: an unusable log.
        NoEstimateError: nothing can be fitted.

    Example:
        >>> log = excite.simulate("emps", 20 * np.sin(np.arange(3000) / 100)[:, None], seed=1)
        >>> excite.diagnose("emps", log, budget_s=1).summary["verdict"] in ("clean", "named", "tied", "unexplained")
        True
    """
    model = load(machine)
    ready = readers.prepare(model, as_list(logs), identification.needed_sensors(model, "joint"))
    found = workflows.diagnose_from(ready.model, ready.logs, budget_s=budget_s)
    name = model.machine.name if isinstance(machine, Model) else str(machine)
    return ShownAssessment.of(found.assessment, partial(_diagnose_account, name, ready, found))


@recorded
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

    Parameters:
        table: a file, or a DataFrame.
        columns: role -> column, "-NAME" for the opposite sign, where names are not recognised; roles are keys of
            `excite.logs.SLIP_ROLES`.
        units: role -> unit where headers say none.
        per: what the laws divide slip by, "rim" as in machine files or the "larger" of rim and forward speed; the laws
            depend on it. A column of slips is taken as divided by the larger speed, and converted.
        radius: [m] of the wheel, for a rate of turn.
        soil: constants whose law (18) is compared with the table.
        machine, where: for which `contact.toml` of `save` is written, a table to paste by default.

    Returns:
        The fitted laws; `save(folder)` writes `contact.toml` for a machine file.

    Raises:
        LogError: an unusable table.
        UsageError: an unknown `per` or contact.
        NotIdentifiableError: too few settings.

    Example:
        >>> test = pd.DataFrame({"slip [%]": [-20, -10, -5, 5, 10, 20], "Fx [kN]": [-23, -11, -5.4, 5.1, 9.8, 20]})
        >>> excite.slip(test).table.slip.shape
        (6,)
    """
    workflows.require_known("per", per, readers.SLIP_PER)
    fit = fit_slip_laws(readers.read_slip_table(table, columns, units, per, radius))
    return ShownSlip.of(fit, partial(workflows.slip_account, fit, soil, machine, where))


@recorded
def verify(
    machine: Machine, drive: Drive, *, runs: int = 50, method: str | None = None, kit: str = "full", seed: int = 0
) -> ShownVerification:
    """Simulate a drive with sensor flaws and identify from it, many times.

    Parameters:
        machine: a name, a file or a model.
        drive: as in `simulate`.
        runs: simulated test days.
        method: a name of `excite.identification.METHODS`, the one recommended for the machine if not given.
        kit: a name of `excite.simulation.KITS`.
        seed: of the noise.

    Returns:
        Each parameter's bias, dispersion, predicted standard deviation and coverage of the 95 % interval.

    Raises:
        UsageError: an unknown method or kit.

    Example:
        >>> drive = excite.score("va12_straight", 2000 * np.sin(np.arange(1500) / 80)[:, None] * [1, 1])
        >>> excite.verify("va12_straight", drive.motion, runs=2, method="ols").value.shape
        (2, 11)
    """
    model = load(machine)
    workflows.require_known("kit", kit, simulation.KITS)
    name = workflows.choose_method(method, model, kit)
    motion = drive if isinstance(drive, Motion) else motion_of(model, drive)
    found = identification.verify(model, motion, name, kit, runs, seed)
    called = name_of(drive, "the drive")
    return ShownVerification.of(found, partial(workflows.verify_account, model, motion, found, seed, called))


@recorded
def score(
    machine: Machine,
    drive: Drive,
    problem: str | None = None,
    *,
    duration: float | None = None,
    sensors: bool = False,
    kit: str = "full",
) -> ShownScore:
    """Judge any drive as a design is: condition numbers, attainable accuracy, limits, on a fresh simulation.

    Parameters:
        machine: a name, a file or a model.
        drive: as in `simulate`; one that gives no pose is placed on the lane as a design is.
        problem: a design problem of the machine file, its default one if not given.
        duration: [s] the problem's own if not given.
        sensors: also find what each sensor of a kit buys, in `summary["sensors"]`, printed and drawn
            (`plot("sensors")`).
        kit: a name of `excite.simulation.KITS`.

    Returns:
        The score: `cond_phi`, `worst_percent`, `violations`, `motion`; `sigma` is a DataFrame.

    Raises:
        LogError: a profile that can't be used.
        MachineError: sensors of unknown noise.
        UsageError: an unknown problem or kit.
        SimulationError: a motion that can't be integrated.

    Example:
        >>> sines = excite.score("va12_straight", 2000 * np.sin(np.arange(1500) / 80)[:, None] * [1, 1])
        >>> sines.sigma["std_percent"].idxmax() == sines.worst_parameter
        True
    """
    model = workflows.build_model(str(machine), fit_sensor_effects=False) if not isinstance(machine, Model) else machine
    given = planned_drive(model, drive, any_rate=True)
    return ShownScore.of(
        *workflows.score_from(model, given, name_of(drive, "the drive"), problem, sensors, kit, duration)
    )


@recorded
def compare(
    machine: Machine,
    problem: str | None = None,
    *,
    against: Sequence[Drive] = (),
    samples: int = 20,
    seed: int = 0,
    budget: float | None = None,
) -> ShownComparison:
    """Compare the designed drive with the usual ones on the same problem, limits and time.

    Parameters:
        machine: a name, a file or a model.
        problem: a design problem of the machine file, its default one if not given.
        against: names of `excite.trajectories.BASELINES`, and drives as in `simulate`; all the usual ones if not given.
        samples: drives of every random kind.
        seed: of the random drives and the search.
        budget: [s] time after which the search stops.

    Returns:
        The drives side by side; `to_frame()` has a row for each.

    Raises:
        UsageError: an unknown name.
        MachineError: sensors of unknown noise, or an arm.

    Example:
        >>> drives = excite.compare("va12_straight", against=["multisine"], samples=2)
        >>> "designed" in drives.to_frame().index
        True
    """
    model = workflows.build_model(str(machine), fit_sensor_effects=False) if not isinstance(machine, Model) else machine
    rivals = [str(one) if isinstance(one, str | Path) else planned_drive(model, one, any_rate=True) for one in against]
    return ShownComparison.of(*workflows.compare_from(model, problem, samples, rivals, seed, budget))


def _log_account(model: Model, source: Source) -> Account:
    machine = model.machine
    if isinstance(source, Log):
        table = readers.table_from(machine, source)
    else:
        table = source if isinstance(source, pd.DataFrame) else readers.table_of(source, machine)
    name = source.source if isinstance(source, Log) else name_of(source, "the table")
    return reports.log_account(table, machine, name, workflows.package_versions())


def _diagnose_account(machine: str, ready: Prepared, found: DiagnoseResult) -> Account:
    drive = workflows.separating_drive(Path(), ready.model.machine, workflows.rivals(found), design_next=False)
    return workflows.diagnose_account(machine, ready, found, drive)


def _predicted(machine: Machine, drive: Drive | None) -> Path | PlannedDrive | None:
    """Return the drive that a design is to predict: a path, or its torques and planned motion."""
    if drive is None or isinstance(drive, str | Path):
        return None if drive is None else Path(drive)
    return planned_drive(load(machine), drive)
