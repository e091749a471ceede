"""A design request, and the design that fulfils it.

A request combines an objective, a required accuracy (`sigma_max`), uncertain machines (`robust`) and information from
earlier logs (`after`). The result's summary gives the condition number beside the attainable accuracy, with advice if
a low condition number comes with poor accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from excite import identification, logs, operator, simulation, text as wording, trajectories
from excite.errors import InfeasibleError, MachineError, SolverError, UsageError
from excite.interrupt import call_interruptible, note_first_interrupt
from excite.model import Model, build, effects, hidden_zeros, with_given_zeros
from excite.model.machine import EffectEntry, Problem, Quantity
from excite.operator import PhasedDrive
from excite.simulation import Motion
from excite.trajectories import (
    AccuracyBound,
    BestSoFar,
    CompositeObjective,
    Design,
    Manoeuvre,
    Report,
    design_drive,
)
from excite.workflows import requests
from excite.workflows.payload_design import loaded_machines, payload_contrasts, payload_summary

ASSUMED_TORQUE_NOISE = 0.005  # of the torque limit, standard deviation, without a figure of the sensor; chosen
ASSUMED_COUNTS_PER_TURN = 65536.0  # of an encoder without a figure; chosen
# Objectives with a bound, as functions of the relative standard deviations [%].
BOUNDED: dict[str, Callable[[np.ndarray], float]] = {
    "worst": lambda sigma: float(sigma.max()),
    "accuracy": lambda sigma: float(np.sqrt(sigma.max() * sigma.mean())),
}
CEILINGS = (trajectories.COND_MAX, trajectories.SIGMA_MAX)  # limits of a search that are no limits of a drive
OTHER_END = "accurate"  # folder of the drive for accuracy alone, in that of a design
SINGULAR_COND = 1e12  # cond(Phi) from which an arm's information matrix is singular to working accuracy; chosen
POOR_PERCENT = 5.0  # attainable standard deviation [%] above which the summary gives advice; chosen
ROBUST_MACHINES = 5  # machines of a robust design; chosen
ROBUST_SPREAD = 0.2  # share of the nominal values by which these machines may be off; chosen


@dataclass(frozen=True)
class DesignRequest:
    """Options of a design.

    objective: a name of `OBJECTIVES`.
    sigma_max [%]: bound on the largest attainable standard deviation.
    robust: design for machines up to ROBUST_SPREAD off the nominal one.
    after: logs of earlier drives, whose information counts.
    starts, seed: starting guesses and their random seed.
    budget_s [s]: time after which the search stops.
    between: two effects or more, NAME[@WHERE]=MAGNITUDE, that the drive must separate.
    trajectory: kind of joint motion of an arm, a name of `TRAJECTORIES`; None for the usual one, or torques of others.
    of: profile (.csv) or design folder of the drive to predict, for the objectives of a prediction.
    payload_kg [kg]: of an arm, design for the payload's parameters, from drives without and with it.
    other_end: with objective cond, also find the drive for accuracy alone, to compare with.
    driver: design for people, in phases of phase_min_s [s] or more.
    cond_slack [%]: with objective cond, by how much cond(Phi) may grow for the most accurate drive; 0 for the lowest.
    solver: a name of `SOLVERS`.
    """

    objective: str = "cond"
    sigma_max: float | None = None
    robust: bool = False
    after: tuple[Path, ...] = ()
    starts: int = 2
    seed: int = 0
    budget_s: float | None = None
    between: tuple[str, ...] = ()
    driver: bool = False
    phase_min_s: float = 3.0
    cond_slack: float = 12.0
    solver: str = "own"
    of: Path | logs.PlannedDrive | None = None
    trajectory: str | None = None
    other_end: bool = True
    payload_kg: float | None = None

    @property
    def second_step(self) -> bool:
        """True if the drive of lowest cond(Phi) is made more accurate within `cond_slack`."""
        plain = self.sigma_max is None and not (self.robust or self.between or self.driver or self.payload_kg)
        return self.objective == "cond" and self.cond_slack > 0 and plain


@dataclass(frozen=True)
class DesignResult:
    """A design with its model and objective.

    model: with `after`, its nominal values are the estimate from the logs.
    contrasts (n_base, m): combinations of relative errors that the objective judges, None for each parameter.
    phased: the phases of a design for people; `design` is then the motion of a steady driver.
    first: the drive of lowest cond(Phi), if `design` is the most accurate one near it.
    accurate: a drive for accuracy alone, to compare with; None without one. random_percent [%]: the worst parameter of
    the most accurate random start.
    assumed_noise: sensors of an arm whose noise figure is assumed, as its machine file has none.
    given_zeros: encoder zeros that are sought, but that no torque shows by itself: the design takes the file's.
    bound: numerical lower bound of every drive, for objectives in BOUNDED of a machine with one driven joint.
    """

    model: Model
    aim: CompositeObjective
    design: Design
    phased: PhasedDrive | None = None
    first: Design | None = None
    contrasts: np.ndarray | None = None
    assumed_noise: tuple[str, ...] = ()
    given_zeros: tuple[str, ...] = ()
    bound: AccuracyBound | None = None
    accurate: Design | None = None
    random_percent: float | None = None


def add_rival_effects(model: Model, between: tuple[str, ...], duration: float) -> Model:
    """Add effects, NAME[@WHERE]=MAGNITUDE each, that a drive of some duration [s] must separate.

    Raises MachineError for an effect that is unknown, impossible on this machine, or invisible to a drive.
    """
    return with_rivals(model, [effects.parse_effect(text, model.machine, duration) for text in between])


def with_rivals(model: Model, rivals: Sequence[EffectEntry]) -> Model:
    """Add the entries of effects to a model. Raises MachineError for an effect that no drive shows.

    Shapes become parameters too, unless they are times of a log: a rival effect may have any shape.
    """
    machine = effects.with_effects(model.machine, *rivals)
    times = any(effects.CATALOGUE[e.name].timed for e in machine.effect)
    both = build(machine, model.fit_sensor_effects, fit_shapes=not times)
    for e in both.effects[-len(rivals) :]:
        if e.name not in both.base.names:
            raise MachineError(
                f"effect {e.name}: no equation of motion shows its magnitude at once (it sits in a sensor, or acts"
                " through its memory), so no drive can be designed for it by the regressor"
            )
    return both


def require_noise_figures(model: Model) -> None:
    """Raise MachineError for a sensor of unknown noise, without which no accuracy can be stated."""
    for s in model.machine.sensors("full"):
        if s.kind not in ("x", "y") and not s.has_noise_figure:
            raise MachineError(
                f"{model.machine.name}: sensor {s.name}: give noise or counts_per_turn in the machine file, a design"
                " states the accuracy that it makes attainable"
            )


def with_earlier_logs(model: Model, after: Sequence[Path]) -> tuple[Model, np.ndarray | None]:
    """Return the model with the estimate from logs as nominal values, and their information [1/SI^2], None without."""
    if not after:
        return model, None
    if model.follows_positions:
        method = identification.recommend_method(model)
        ready = logs.prepare(model, list(after), identification.needed_sensors(model, method))
        estimate = identification.identify(ready.model, ready.logs, method)
        known = identification.prior_from_estimate(ready.model, estimate)
    else:
        ready = logs.prepare(model, list(after), identification.needed_sensors(model, "joint"))
        known = identification.prior_from_logs(ready.model, ready.logs)
    return replace(known.model, machine=model.machine), known.information


def contrasts(model: Model, request: DesignRequest) -> np.ndarray | None:
    """Return what the objective judges (n_base, m), None for each parameter or effect. Raises LogError."""
    if request.between:
        return trajectories.rival_contrasts(model, [e.name for e in model.effects[-len(request.between) :]])
    if request.payload_kg is not None:
        return payload_contrasts(model, request.payload_kg)
    if request.of is None:
        return None
    drive = logs.read_drive(request.of, model) if isinstance(request.of, Path) else request.of
    motion = simulation.play_back(model, drive.torque, drive.q0, drive.nu0, drive.planned)
    return trajectories.prediction_contrasts(model, motion)


def singular_message(problem: str) -> str:
    """Return the message for a problem whose information matrix is singular."""
    return f"some parameter moves nothing in problem {problem}, so no drive shows it"


def design_from(model: Model, problem: Problem, request: DesignRequest, progress: Report | None = None) -> DesignResult:
    """Design a drive for a model and a problem as requested.

    Raises MachineError for sensors of unknown noise, UndrivableError for a drive that no person can follow, and the
    errors of `trajectories.design`, `logs.prepare` and `identification.identify`.
    """
    model, given = without_hidden_zeros(model)
    request = check_arm_options(model, request)
    model, assumed = with_assumed_noise(model)
    found = _design_with_noise(model, problem, request, progress)
    if model.follows_positions and not found.design.cond_phi < SINGULAR_COND:
        raise np.linalg.LinAlgError(f"cond(Phi) {found.design.cond_phi:g}")
    return replace(found, assumed_noise=assumed, given_zeros=given)


def _design_with_noise(model: Model, problem: Problem, request: DesignRequest, progress: Report | None) -> DesignResult:
    """Design a drive for a machine whose sensors have noise figures; errors as of `design_from`."""
    if request.driver:
        operator.check_phase_length(model, problem, request.phase_min_s)
    require_noise_figures(model)
    model, prior = with_earlier_logs(model, request.after)
    judged = contrasts(model, request)
    machines = (
        simulation.perturbed_machines(model, ROBUST_MACHINES, ROBUST_SPREAD, request.seed) if request.robust else ()
    )
    aim = trajectories.compose_objective(model, request.objective, request.sigma_max, prior, machines, None, judged)
    if request.payload_kg is not None:
        aim = replace(aim, machines=loaded_machines(model, request.payload_kg))
    until = None if request.budget_s is None else time.time() + request.budget_s
    first = request.budget_s / 2 if request.budget_s and (request.driver or request.second_step) else request.budget_s
    search = request.starts, request.seed, first, progress, (), request.solver, request.trajectory
    found = design_drive(model, problem, aim, *search)
    near = _NearSearch(model, problem, request, prior, until, progress, found.stopped)
    if request.second_step:
        return _make_accurate(near, aim, found)
    if not request.driver:
        bound = _bound_on_objective(model, problem, request) if found.complete else None
        return DesignResult(model, aim, found, contrasts=judged, bound=bound)
    phases = request.phase_min_s, request.seed
    with note_first_interrupt() as asked:
        made = operator.design_phases(
            model, problem, aim, found.motion, *phases, lambda: near.over or asked.stop, progress
        )
    return DesignResult(model, aim, operator.as_design(model, problem, found, made), made, contrasts=judged)


PAYLOAD_OBJECTIVE = "accuracy"  # of a payload, where none is asked for


def check_arm_options(model: Model, request: DesignRequest) -> DesignRequest:
    """Return a request with the objective that a payload needs.

    Raises UsageError for options that are not for an arm, or not for a payload; MachineError for options of arms with
    another machine.
    """
    if not model.follows_positions:
        if request.trajectory is not None:
            trajectories.check_joint_motion(model, request.trajectory)
        if request.payload_kg is not None:
            payload_contrasts(model, request.payload_kg)
        return request
    for option, given in (
        ("--driver", request.driver),
        ("--between", bool(request.between)),
        (f"--solver {request.solver}", request.solver != "own"),
    ):
        if given:
            raise UsageError(f"{option}: not for {model.machine.name}, an arm, whose designs are motions of its joints")
    if request.payload_kg is None:
        return request
    requests.require_positive("--payload", request.payload_kg, "kg")
    if request.robust or request.after or request.sigma_max is not None or request.of is not None:
        raise UsageError("--payload: does not go with --robust, --after, --sigma-max or --of")
    objective = PAYLOAD_OBJECTIVE if request.objective == "cond" else request.objective
    chosen = trajectories.OBJECTIVES[objective]
    if chosen.of != "variances" or chosen.contrasts != "parameters":
        allowed = [n for n, o in trajectories.OBJECTIVES.items() if (o.of, o.contrasts) == ("variances", "parameters")]
        raise UsageError(f"--payload: needs an --objective of accuracy: {', '.join(allowed)} (got {objective})")
    return replace(request, objective=objective)


def without_hidden_zeros(model: Model) -> tuple[Model, tuple[str, ...]]:
    """Return a model that takes the file's values of encoder zeros that no torque shows by itself, and their names."""
    hidden = tuple(hidden_zeros(model, by_known=False))
    return with_given_zeros(model, hidden), hidden


def with_assumed_noise(model: Model) -> tuple[Model, tuple[str, ...]]:
    """Return a model whose sensors all have noise figures, and the names of those that are assumed.

    Noise is assumed for an arm where the machine file has none; other machines stay as they are.
    """
    machine = model.machine
    found = {}
    for s in machine.sensor if model.follows_positions else ():
        if s.has_noise_figure or s.kind in ("x", "y"):
            continue
        limit = None if s.body is None else machine.find(s.body).limit.torque
        if s.kind == "torque" and limit is not None:
            noise = Quantity(value=ASSUMED_TORQUE_NOISE * float(limit), source="assumed")
            found[s.name] = s.model_copy(update={"noise": noise, "noise_unit": "SI"})
        elif s.kind == "angle":
            found[s.name] = s.model_copy(
                update={"counts_per_turn": Quantity(value=ASSUMED_COUNTS_PER_TURN, source="assumed")}
            )
    if not found:
        return model, ()
    sensors = tuple(found.get(s.name, s) for s in machine.sensor)
    return replace(model, machine=machine.model_copy(update={"sensor": sensors})), tuple(found)


@dataclass
class _NearSearch:
    """Searches that begin from drives that are known.

    until: time at which they end, None for no limit. stopped: True after Ctrl-C; later searches are left out.
    progress: as of `design_from`, with what is sought and the worst parameter so far in words.
    """

    model: Model
    problem: Problem
    request: DesignRequest
    prior: np.ndarray | None
    until: float | None
    progress: Report | None
    stopped: bool = False

    @property
    def over(self) -> bool:
        """True if there is no time for another search."""
        return self.stopped or (self.until is not None and time.time() >= self.until)

    def find(
        self,
        sought: str,
        objective: str,
        warm: Sequence[Manoeuvre | Motion],
        share: float,
        sigma_max: float | None = None,
        cond_max: float | None = None,
    ) -> Design | None:
        """Return the best drive near some, None if none keeps every limit or time is up. share: of the time left.

        sought: what is sought, in words. sigma_max, cond_max: see `trajectories.compose_objective`.
        """
        if self.over:
            return None
        aim = trajectories.compose_objective(self.model, objective, sigma_max, self.prior, cond_max=cond_max)
        left = None if self.until is None else share * (self.until - time.time())
        asked = self.request
        try:
            tell = _in_words(self.progress, sought, objective)
            found = design_drive(
                self.model, self.problem, aim, 0, asked.seed, left, tell, warm, asked.solver, asked.trajectory
            )
        except (InfeasibleError, SolverError):
            return None
        except KeyboardInterrupt:
            self.stopped = True
            return None
        self.stopped = found.stopped
        return found

    def worst(self, drive: Manoeuvre | Motion) -> float:
        """Return the attainable standard deviation [%] of the worst parameter along a drive, inf after Ctrl-C."""
        rate = float(self.model.machine.sampling_hz)
        aim = trajectories.compose_objective(self.model, "cond", prior=self.prior)

        def sigma_percent() -> np.ndarray:
            motion = drive if isinstance(drive, Motion) else simulation.simulate(self.model, drive.sample(rate))
            return trajectories.sigma_percent(aim, self.model, motion)

        try:
            return float(call_interruptible(sigma_percent).max())
        except KeyboardInterrupt:
            self.stopped = True
            return float("inf")


def _in_words(progress: Report | None, sought: str, objective: str) -> Report | None:
    """Return a report of progress that says what is sought and the best value of its own objective so far."""
    if progress is None:
        return None

    def report(done: int, total: int, best: BestSoFar) -> None:
        value = f"{trajectories.describe_value(objective, best)} so far; " if np.isfinite(best) else ""
        progress(done, total, BestSoFar(np.inf, f"{sought}: {value}{best.doing}"))

    progress(0, 0, BestSoFar(np.inf, sought))
    return report


def _make_accurate(search: _NearSearch, aim: CompositeObjective, lowest: Design) -> DesignResult:
    """Find the most accurate drive (worst parameter) whose cond(Phi) is within `cond_slack` of the lowest one.

    The drive for accuracy alone is found as well, to compare with. If a random start is more accurate than the drive
    near the lowest cond(Phi), the drive of lowest cond(Phi) that is as accurate takes its place.
    """
    slack = search.request.cond_slack
    near = f"the most accurate drive within {slack:g} % of cond(Phi) {wording.format_number(lowest.cond_phi, 4)}"
    cond_max = (1 + slack / 100) * lowest.cond_phi
    found = search.find(near, "worst", [lowest.drive], 0.5, cond_max=cond_max) or lowest
    accurate = None
    if search.request.other_end:
        accurate = search.find("the drive for accuracy alone", "accuracy", [found.drive], 0.5)
    reached = {k: search.worst(drive) for k, drive in enumerate(lowest.random) if not search.over}
    best = None if search.stopped else min(reached, key=lambda k: reached[k], default=None)
    if best is not None and search.worst(found.drive) > reached[best]:
        beaten = accurate is not None and search.worst(accurate.drive) <= reached[best]
        warm = [found.drive, accurate.drive if accurate is not None and beaten else lowest.random[best]]
        sought = f"the lowest cond(Phi) with every parameter to {wording.format_percent(reached[best], 3)}"
        found = search.find(sought, "cond", warm, 1.0, sigma_max=reached[best]) or found
    random = None if best is None else reached[best]
    ends = DesignResult(search.model, aim, lowest, accurate=accurate, random_percent=random)
    complete = lowest.complete and found.complete and not search.stopped
    if found is lowest or np.isclose(found.cond_phi, lowest.cond_phi, rtol=1e-9):
        return replace(ends, design=replace(lowest, complete=complete))
    found = replace(
        found,
        objective=lowest.objective,
        cond_phi_start=lowest.cond_phi_start,
        scores=lowest.scores,
        iterations=lowest.iterations + found.iterations,
        complete=complete,
        violations={n: v for n, v in found.violations.items() if n not in CEILINGS},
    )
    return replace(ends, design=found, first=lowest)


def _bound_on_objective(model: Model, problem: Problem, request: DesignRequest) -> AccuracyBound | None:
    """Compute the bound on the objective of a request; None without one, after Ctrl-C, or if its program fails."""
    extra = request.sigma_max is not None or request.robust or request.between or request.after
    if extra or request.objective not in BOUNDED or trajectories.bound_refusal(model, problem) is not None:
        return None
    try:
        return trajectories.bound_accuracy(model, problem, request.objective)
    except (RuntimeError, KeyboardInterrupt):  # the design stands without its bound
        return None


def _bound_summary(result: DesignResult, bound: AccuracyBound) -> dict[str, Any]:
    """Compare what a design attains with the bound."""
    sigma = trajectories.sigma_percent(result.aim, result.model, result.design.motion)
    attained = BOUNDED[bound.of](sigma)
    return {
        "of": bound.of,
        "certified_percent": bound.certified_percent,
        "attained_percent": attained,
        "gap_percent": bound.gap_percent(attained),
    }


def summarise_result(request: DesignRequest, result: DesignResult) -> dict[str, Any]:
    """Summarise a design: request, scores, attainable accuracy, limits."""
    names, drive = result.model.base.names, result.design
    request = replace(request, objective=result.aim.name)
    sigma = dict(zip(names, trajectories.sigma_percent(result.aim, result.model, drive.motion).tolist(), strict=True))
    worst = max(sigma, key=lambda n: sigma[n])
    summary: dict[str, Any] = {
        "objective": request.objective,
        "cond_phi": drive.cond_phi,
        "cond_w": drive.cond_w,
        "cond_phi_start": drive.cond_phi_start,
        "sigma_percent": sigma,
        "worst_parameter": worst,
        "worst_percent": sigma[worst],
        "median_percent": float(np.median(list(sigma.values()))),
        "hides_poor_accuracy": sigma[worst] > POOR_PERCENT,
        "advice": advice(request, worst, sigma[worst]),
        "complete": drive.complete,
        "max_violation": drive.max_violation,
        "violations": dict(drive.violations),
        "share_outside_law": simulation.share_outside_law(result.model, drive.motion),
        "scores": list(drive.scores),
        "starts": request.starts,
        "seed": request.seed,
        "solver": drive.solver,
        "trajectory": drive.trajectory,
        "iterations": drive.iterations,
    }
    if drive.trajectory is not None:
        summary |= _arm_summary(result.model, drive)
    if drive.followed is not None:
        summary["followed"] = dict(drive.followed)
    if result.first is not None:
        summary["cond_slack_percent"] = max(request.cond_slack, 100 * (drive.cond_phi / result.first.cond_phi - 1))
        summary["lowest_cond"] = _end(result, result.first)
    if result.accurate is not None:
        summary["most_accurate"] = {**_end(result, result.accurate), "folder": OTHER_END}
    if result.random_percent is not None:
        summary["random_start_percent"] = result.random_percent
    if result.assumed_noise:
        summary["assumed_noise"] = list(result.assumed_noise)
    if request.payload_kg is not None:
        summary["payload"] = payload_summary(result.model, request.payload_kg, [drive.motion])
    if result.given_zeros:
        summary["given_zeros"] = list(result.given_zeros)
    if result.bound is not None:
        summary["bound"] = _bound_summary(result, result.bound)
    if result.phased is not None:
        summary["driver"] = _by_hand(request, result.aim, result.phased)
    if request.of is not None:
        C = trajectories.covariance_bound(result.aim, result.model, drive.motion)
        by = trajectories.reference_values(result.model)
        variances = trajectories.contrast_variances(C / np.outer(by, by), result.contrasts)
        summary["prediction"] = {
            "of": str(request.of) if isinstance(request.of, Path) else "the drive",
            "mean_percent": 100 * float(np.sqrt(variances.mean())),
            "max_percent": 100 * float(np.sqrt(variances.max())),
        }
    if request.sigma_max is not None:
        summary["sigma_max"] = request.sigma_max
    if request.between:
        summary["between"] = list(request.between)
    if request.robust:
        summary["robust"] = {"machines": ROBUST_MACHINES, "spread": ROBUST_SPREAD}
    if request.after:
        summary["after"] = [str(p) for p in request.after]
        summary["nominal"] = dict(zip(names, result.model.nominal.tolist(), strict=True))
    return summary


def _end(result: DesignResult, drive: Design) -> dict[str, Any]:
    """Summarise a drive beside the one that was designed."""
    sigma = trajectories.sigma_percent(result.aim, result.model, drive.motion)
    return {
        "cond_phi": drive.cond_phi,
        "cond_w": drive.cond_w,
        "worst_parameter": result.model.base.names[int(np.argmax(sigma))],
        "worst_percent": float(sigma.max()),
        "median_percent": float(np.median(sigma)),
    }


def _arm_summary(model: Model, drive: Design) -> dict[str, Any]:
    """Summarise what belongs to arms: where the motion starts, and what its search knew of things to run into."""
    world = model.machine.world
    return {
        "start": dict(zip(model.coordinates, drive.motion.q[0].tolist(), strict=True)),
        "collisions": {
            "looked_at": trajectories.has_shapes(model.machine),
            "margin_m": float(world.margin),
            "floor_m": None if world.floor == "none" else float(world.floor),
            "left_out": [list(pair) for pair in trajectories.pairs_left_out(model)],
        },
    }


def _by_hand(request: DesignRequest, aim: CompositeObjective, made: PhasedDrive) -> dict[str, Any]:
    """Summarise a design for people: phases, scores of three ways of driving, limits that people exceed, ground."""
    ways = ("played_back", "smoothed", "by_hand")
    scores = {
        way: {
            "score": trajectories.reported_value(aim.name, score),
            "cond_phi": attained.cond_phi,
            "worst_parameter": attained.worst,
            "worst_percent": attained.worst_percent,
            "median_percent": attained.median_percent,
        }
        for way, score, attained in zip(ways, made.scores, made.attained, strict=True)
    }
    return {
        "phase_min_s": request.phase_min_s,
        "people": len(made.people),
        **scores,
        "limits_broken": made.over,
        **made.room.summary(made.lane),
        "complete": made.complete,
        "phases": operator.trace_table(made.trace),
    }


def advice(request: DesignRequest, worst: str, percent: float) -> str | None:
    """Return what to do about a poorly identifiable parameter, None if all are below POOR_PERCENT."""
    if percent <= POOR_PERCENT:
        return None
    condition_only = trajectories.is_condition_number(request.objective) and request.sigma_max is None
    poor = f"{worst} can't be found better than {wording.format_percent(percent)}"
    if not condition_only:
        return f"poor accuracy: {poor}; drive longer, or on more room"
    return (
        f"cond(Phi) says nothing of accuracy here: {poor}; --objective accuracy designs for small errors"
        ", --sigma-max PERCENT for the lowest cond(Phi) among drives that are accurate enough"
    )
