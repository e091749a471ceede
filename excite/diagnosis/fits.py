"""Fit a machine's model to logs, alone or with further effects.

Exact dynamics come first. If they give no estimate, process noise as small as the logs allow is added; if the model is
still far from the logs, the sensor noise is inflated. Independent fits run side by side. Only their `Fit`s are sent
back from other processes, since models hold compiled code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import Any

import numpy as np

from excite import identification, smoothing
from excite.diagnosis import score_test
from excite.diagnosis.parallel import CallRunner, run_ahead, run_in_turn
from excite.logs import Log
from excite.model import Model, build, required_signs
from excite.model.effects import PlacedEffect
from excite.model.machine import Filter, Machine
from excite.smoothing import (
    PROCESS_NOISE_LEVELS,
    Fit,
    Measurements,
    NotConvergedError,
    StateSpace,
    Trajectory,
    build_state_space,
    common_sensors,
    encoders_with_offset,
    innovation_statistics,
    log_variance,
    prepare_logs,
    transfer_trajectory,
)
from excite.text import format_number

# Cost: sum of squared innovations over their variances. A right model's cost is about the number of readings.
TRACKING_COST_RATIO = 2.5  # cost over its expected value up to which exact dynamics track the logs; chosen
LOST_COST_RATIO = 10.0  # cost over the number of readings from which a fit is given up after a few passes; chosen
FRICTION_ERROR = 0.1  # share of friction near rest by which an effect's formula may err there; chosen
COST_TOLERANCE = 0.02  # share of its expected value by which a right model's cost may be larger; chosen
IMPOSSIBLE_SIGN_STDS = 3.0  # standard deviations beyond zero from which a parameter's sign is impossible; chosen
IMPOSSIBLE_SIGN_SHARE = 0.5  # share of the parameter's scale beyond zero, likewise; chosen
MAX_PASSES, RESUMED_PASSES = 20, 14  # of a fit from the start, and of one that continues another; chosen
SENSOR_NOISE_INFLATIONS = 10.0, 30.0  # factors on the sensors' standard deviations, tried in turn; chosen
PROCESS_NOISE_REDUCTIONS = 0.1, 0.3  # shares of a fit's process noise that are tried next, in turn; chosen
PROCESS_NOISE_LADDER = (  # all levels that are tried
    *(share * PROCESS_NOISE_LEVELS[0] for share in PROCESS_NOISE_REDUCTIONS),
    *PROCESS_NOISE_LEVELS,
)
CLOSE_FIT_COST_RATIO = 1.3  # cost over its expectation from noise; above it first-order gains are rough; chosen
FIRST_DAMPING, RESUMED_DAMPING = 25.0, 0.25  # see `smoothing.Settings`: of a fit from the start, and of one continued
SUFFICIENT_STEP = 0.5  # [standard deviations] that ends a fit whose intervals are not reported; chosen
FULL_STEP = 0.02  # [standard deviations] that ends a fit to full convergence
MIN_PROCESS_NOISE = PROCESS_NOISE_LADDER[0]


@dataclass(frozen=True)
class FitData:
    """Logs prepared for a model.

    space: state space of the model. measurements, starts: each log in it, and its initial trajectory. held (n_base,):
    parameters that stay at the machine file's values, as the logs do not show them. friction_near_rest: of each log,
    the size (N - 1, n_u) [N m] of friction that may have either sign, None if the model's friction holds near rest.
    """

    space: StateSpace
    logs: tuple[Log, ...]
    measurements: tuple[Measurements, ...]
    starts: tuple[Trajectory, ...]
    held: np.ndarray
    friction_near_rest: tuple[np.ndarray, ...] | None = None

    @property
    def noise_inflation(self) -> float:
        """Factor on the standard deviations of the sensors."""
        return self.measurements[0].noise_inflation

    @property
    def sticks(self) -> bool:
        """Tell if friction may have either sign where joints are near rest."""
        return self.friction_near_rest is not None

    @property
    def n_readings(self) -> float:
        """Number of readings in all logs: the cost expected of a right model with the true sensor noise."""
        return float(sum(r.used.sum() for r in self.measurements))

    @property
    def expected_cost(self) -> float:
        """Cost expected of a right model."""
        return self.n_readings / self.noise_inflation**2


@dataclass(frozen=True)
class ExtendedFit:
    """A model with the effects chosen so far, fitted to logs: one stage of the search.

    estimated: the parameters are estimates with the true sensor noise. If False, they are the machine file's, or
        estimates with inflated sensor noise.
    process_noise_fit: a fit of the same model with more process noise, if there is one: the one that this fit
        continues, or beside inflated sensor noise one that is far from the logs.
    """

    machine: Machine
    data: FitData
    fit: Fit
    estimated: bool = True
    process_noise_fit: ExtendedFit | None = None

    @property
    def model(self) -> Model:
        return self.data.space.model

    def placed(self, name: str) -> PlacedEffect:
        """Return an effect of the model by its name."""
        return next(e for e in self.model.effects if e.name == name)

    @property
    def exact(self) -> bool:
        return self.fit.process_noise == 0

    @property
    def expected_cost(self) -> float:
        return self.data.expected_cost

    @property
    def excess_cost(self) -> float:
        """Cost beyond what noise may cause."""
        return max(0.0, self.fit.cost - (1 + COST_TOLERANCE) * self.expected_cost)

    @cached_property
    def deviance(self) -> float:
        """Twice the negative log-likelihood, but for a constant, by which fits to the same logs are compared.

        Where friction is free near rest, the covariance of the innovations depends on the model and counts, too.
        """
        return self.fit.cost + (sum(map(log_variance, self.fit.linear)) if self.data.sticks else 0.0)

    @property
    def is_close(self) -> bool:
        """Tell if the cost is near its expected value."""
        return self.fit.cost <= CLOSE_FIT_COST_RATIO * self.expected_cost

    @cached_property
    def fitted_logs(self) -> tuple[score_test.FittedLog, ...]:
        """The fitted logs, along which candidates are scored."""
        return score_test.fitted_logs(self.data.space, self.data.measurements, self.fit)

    @cached_property
    def scores(self) -> list[tuple[score_test.Score, ...]]:
        """Scores of candidates along this fit: empty until `selection.score_effects` stores them."""
        return []

    @property
    def tracks_logs(self) -> bool:
        """Tell if the fit is close, or exact dynamics are not far off.

        A nearly right formula leaves a large misfit where its effect is large.
        """
        return self.is_close or (self.exact and self.fit.cost <= TRACKING_COST_RATIO * self.expected_cost)

    @property
    def dispersion(self) -> float:
        """Ratio of the cost to its expected value, at least 1: likelihood ratios count less by this factor."""
        return max(1.0, self.fit.cost / self.expected_cost)

    @property
    def first_order_is_rough(self) -> bool:
        """Tell if first-order likelihood ratios are unreliable."""
        return not self.exact or not self.is_close

    @property
    def std_inflation(self) -> float:
        """Factor on the standard deviations for slow innovations that the fit leaves unexplained."""
        sizes = np.concatenate([innovation_statistics(linear) for linear in self.fit.linear])
        valid = sizes[:, 2] > 0
        return float(np.sqrt(max(1.0, sizes[valid, 1].mean()))) if valid.any() else 1.0

    @cached_property
    def impossible(self) -> tuple[str, ...]:
        """Parameters whose sign no machine has, a line each: friction that drives, soil that pulls.

        An effect that makes them so is not the cause, however much it explains.
        """
        fit, base = self.fit, self.model.base
        required = required_signs(self.machine) | {e.name: 1.0 for e in self.model.effects if e.effect.opposes_motion}
        margin = np.maximum(
            IMPOSSIBLE_SIGN_STDS * self.std_inflation * fit.std, IMPOSSIBLE_SIGN_SHARE * self.model.scale
        )
        found: list[str] = []
        for k, (name, unit) in enumerate(zip(base.names, base.units, strict=True)):
            # A base parameter that is one standard parameter alone has its sign.
            alone = np.count_nonzero(base.matrix[k]) == 1
            sign = required.get(base.standard[base.independent[k]], 0.0) if alone else 0.0
            if sign * fit.X[k] < -margin[k]:
                found.append(f"{name} = {format_number(fit.X[k], 4)} {unit}")
        return tuple(found)

    @property
    def is_dead_end(self) -> bool:
        """Tell if effects leave only noise but make a parameter impossible.

        No misfit is left by which other effects could be told apart.
        """
        return bool(self.model.effects) and self.exact and self.excess_cost == 0 and bool(self.impossible)

    @property
    def suspect_sensors(self) -> list[str]:
        return identification.find_suspect_sensors(self.data.space, self.data.logs, self.fit)


FitPair = tuple[Fit, Fit | None]  # a fit, and the one with more process noise that it continues


def assemble_fit(machine: Machine, data: FitData, fit: Fit, process_noise_fit: Fit | None = None) -> ExtendedFit:
    """Build an extended fit from its fit and the one with more process noise that it continues."""
    larger_noise = None if process_noise_fit is None else assemble_fit(machine, data, process_noise_fit)
    return ExtendedFit(machine, data, fit, data.noise_inflation == 1, larger_noise)


def fit_machine_that_sticks(
    plain: ExtendedFit, logs: Sequence[Log], filter: Filter, runner: CallRunner = run_in_turn
) -> ExtendedFit:
    """Let friction have either sign where joints are near rest, if the logs ask for it and are followed then.

    A joint that sticks has any friction up to Fs there, which no formula of friction describes.
    """
    model = plain.model
    follows = plain.exact and plain.is_close
    if model.slips or (follows and not identification.shows_sticking(model, logs, filter, plain.fit)):
        return plain
    rests = identification.sticking(model, logs, filter)
    if rests is None:
        return plain
    soft, extra = rests
    try:
        found = fit_machine(soft.machine, logs, filter, runner, extra)
    except NotConvergedError:
        return plain
    return found if found.exact and found.is_close else plain


def fit_machine(
    machine: Machine,
    logs: Sequence[Log],
    filter: Filter,
    runner: CallRunner = run_in_turn,
    friction_near_rest: Sequence[np.ndarray] | None = None,
) -> ExtendedFit:
    """Fit a machine's model to logs, with the shapes of its effects free.

    Exact dynamics are given up if they stay LOST_COST_RATIO off after a few passes. Then comes process noise, as little
    as the logs allow: the less it absorbs, the clearer the cause; exact dynamics are tried again from there. If that is
    far from the logs too, sensor noise is inflated. If all fail, `fit_with_process_noise` applies.

    All attempts start at once where there are processes for them. friction_near_rest: see `FitData`. Raises
    NotConvergedError.
    """
    data = prepare_data(machine, logs, filter, friction_near_rest)
    calls: list[Callable[[], Any]] = [
        partial(_fit_exact_from_start, data),
        partial(_fit_reducing_process_noise, machine, data, PROCESS_NOISE_LEVELS[0]),
        *(
            partial(fit_from_start, inflate_sensor_noise(data, times), PROCESS_NOISE_LEVELS[0])
            for times in SENSOR_NOISE_INFLATIONS
        ),
    ]
    results = runner(calls)
    with closing(results):
        exact = next(results)
        if exact is not None:
            return assemble_fit(machine, data, *exact)
        with_noise = next(results)
        stage = None if with_noise is None else assemble_fit(machine, data, *with_noise)
        if stage is None or not stage.is_close:
            for times, fit in zip(SENSOR_NOISE_INFLATIONS, results, strict=True):
                if fit is not None:
                    return ExtendedFit(machine, inflate_sensor_noise(data, times), fit, False, stage)
    if stage is not None and stage.is_close:
        return exact_if_close(stage)
    return (
        _fit_by_noise_levels(machine, data, PROCESS_NOISE_LEVELS[1:], runner)
        if stage is None
        else _resume_with_least_noise(stage, runner)
    )


def fit_with_process_noise(stage: ExtendedFit, runner: CallRunner) -> ExtendedFit:
    """Replace a fit with inflated sensor noise by one with process noise, however much that leaves.

    If no level gives a fit within LOST_COST_RATIO, the machine file's parameters are kept: their misfit shows where to
    look. Raises NotConvergedError if these give none either.
    """
    if stage.process_noise_fit is not None:
        return _resume_with_least_noise(stage.process_noise_fit, runner)
    return _fit_by_noise_levels(stage.machine, inflate_sensor_noise(stage.data, 1.0), PROCESS_NOISE_LEVELS[1:], runner)


def _fit_by_noise_levels(
    machine: Machine, data: FitData, noise_levels: Sequence[float], runner: CallRunner
) -> ExtendedFit:
    """Fit with the first level of process noise that gives a fit, else with the machine file's parameters."""
    calls: list[Callable[[], Any]] = [
        *(partial(_fit_below_cost, data, d, LOST_COST_RATIO * data.n_readings) for d in noise_levels),
        partial(_fit_with_file_parameters, data),
    ]
    with closing(runner(calls)) as results:
        fit = next((fit for fit in islice(results, len(noise_levels)) if fit is not None), None)
        if fit is None:
            return ExtendedFit(machine, data, next(results), estimated=False)
    stage = assemble_fit(machine, data, fit)
    return (
        exact_if_close(assemble_fit(machine, data, *_reduce_noise_while_close(stage, runner)))
        if stage.is_close
        else stage
    )


def _fit_with_file_parameters(data: FitData) -> Fit:
    """Fit the trajectories alone, with the machine file's parameters and small process noise."""
    all_held = replace(data, held=np.ones_like(data.held))
    fit = iterate(all_held, data.starts, data.space.model.nominal, PROCESS_NOISE_LEVELS[0])
    if not fit.linear:
        fit.required()
    unknown = np.full_like(fit.covariance, np.nan)
    known = smoothing.prior_information(data.space.model, data.held, fit.X)
    return without_smoother_levels(replace(fit, unidentifiable=data.held, prior=known, covariance=unknown))


def inflate_sensor_noise(data: FitData, noise_inflation: float) -> FitData:
    """Return the same logs with the sensors' standard deviations times `noise_inflation`."""
    return replace(data, measurements=tuple(replace(r, noise_inflation=noise_inflation) for r in data.measurements))


def with_true_sensor_noise(stage: ExtendedFit) -> ExtendedFit:
    """Evaluate a fit's trajectories and parameters against the true sensor noise."""
    if stage.data.noise_inflation == 1:
        return stage
    data, fit = inflate_sensor_noise(stage.data, 1.0), stage.fit
    linear = smoothing.linearise_logs(
        data.space, data.measurements, fit.trajectories, data.starts, fit.X, fit.process_noise
    )
    if linear is None:
        return stage
    cost = sum(float(x.Z[0, 0]) for x in linear)
    return replace(stage, data=data, fit=without_smoother_levels(replace(fit, linear=tuple(linear), cost=cost)))


def resume_with_true_sensor_noise(
    found: Sequence[ExtendedFit], process_noise: float, runner: CallRunner
) -> Iterator[ExtendedFit | None]:
    """Continue fits with inflated sensor noise with the true noise and a level of process noise, side by side.

    The first starts at once. None stands for a fit that gets nowhere near the logs.
    """
    data = [inflate_sensor_noise(x.data, 1.0) for x in found]
    calls = [
        partial(_resume_or_none, p, x, process_noise, LOST_COST_RATIO * p.n_readings)
        for p, x in zip(data, found, strict=True)
    ]
    answers = zip(data, found, run_ahead(calls, runner), strict=True)
    return (None if fit is None else assemble_fit(x.machine, p, fit) for p, x, fit in answers)


def fit_from_start(
    data: FitData, process_noise: float, cost_limit: float = np.inf, patient: bool = False
) -> Fit | None:
    """Fit from initial trajectories; None if no fit is found.

    cost_limit: cost above which the fit is given up. patient: iterate to the end; nearly converged fits count as none.
    """
    fit = iterate(data, data.starts, data.space.model.nominal, process_noise, cost_limit=cost_limit, patient=patient)
    usable = fit.status == "converged" or (not patient and fit.step <= smoothing.ACCEPTABLE_STEP)
    return without_smoother_levels(fit) if usable else None


def _fit_exact_from_start(data: FitData) -> FitPair | None:
    """Fit exact dynamics from initial trajectories; None if that does not settle below LOST_COST_RATIO."""
    fit = fit_from_start(data, 0.0, LOST_COST_RATIO * data.n_readings, patient=True)
    return None if fit is None else (fit, None)


def _fit_reducing_process_noise(machine: Machine, data: FitData, process_noise: float) -> FitPair | None:
    """Fit from initial trajectories with process noise, and reduce that if the fit is close; None if none is found."""
    fit = fit_from_start(data, process_noise)
    if fit is None:
        return None
    stage = assemble_fit(machine, data, fit)
    return _reduce_noise_while_close(stage) if stage.is_close else (fit, None)


def _fit_below_cost(data: FitData, process_noise: float, max_cost: float) -> Fit | None:
    """Fit from initial trajectories with process noise; None if it costs more than max_cost."""
    fit = fit_from_start(data, process_noise, max_cost)
    return None if fit is None or fit.cost > max_cost else fit


def _resume_with_least_noise(stage: ExtendedFit, runner: CallRunner) -> ExtendedFit:
    """Continue a fit with the least process noise that gives one, and without any if that is close."""
    if stage.process_noise_fit is not None:
        return exact_if_close(stage)
    return exact_if_close(assemble_fit(stage.machine, stage.data, *_reduce_noise_while_close(stage, runner)))


def _reduce_noise_while_close(first: ExtendedFit, runner: CallRunner = run_in_turn) -> FitPair:
    """Reduce process noise once, then on as long as the fit stays close: large levels hide other effects.

    Return the fit and the one that it came from.
    """
    stage = _reduce_noise(first, runner)
    if stage is None:
        return first.fit, None
    while (smaller := _reduce_noise(stage, runner)) is not None and smaller.is_close:
        stage = smaller
    return stage.fit, first.fit


def _reduce_noise(stage: ExtendedFit, runner: CallRunner) -> ExtendedFit | None:
    """Continue a fit with the smallest of the reduced levels that gives one; None if none does."""
    smaller = [
        d for d in (less * stage.fit.process_noise for less in PROCESS_NOISE_REDUCTIONS) if d >= MIN_PROCESS_NOISE
    ]
    with closing(runner([partial(_resume_or_none, stage.data, stage, level) for level in smaller])) as fits:
        return next((replace(stage, fit=fit) for fit in fits if fit is not None), None)


def refit(machine: Machine, previous: ExtendedFit, process_noise: float) -> ExtendedFit:
    """Fit a machine with other effects to the same logs, from a previous fit. Raises NotConvergedError."""
    data = adapt_data(machine, previous)
    return assemble_fit(machine, data, resume_fit(data, previous, process_noise))


RefitRequest = tuple[Machine, ExtendedFit, float]  # machine, previous fit and process noise of a refit


def refit_all(
    requests: Sequence[RefitRequest],
    runner: CallRunner,
    cost_limit: float = np.inf,
    held: Sequence[str] = (),
) -> Iterator[ExtendedFit | None]:
    """Refit several machines side by side; None for each that fails or moves on above cost_limit.

    held: for each machine a parameter that stays at its file's value.
    """
    data = [adapt_data(machine, previous) for machine, previous, _ in requests]
    if held:
        data = [_hold_parameter(p, name) for p, name in zip(data, held, strict=True)]
    calls = [
        partial(_resume_or_none, p, previous, process_noise, cost_limit)
        for p, (_, previous, process_noise) in zip(data, requests, strict=True)
    ]
    answers = zip(data, requests, runner(calls), strict=True)
    return (None if fit is None else assemble_fit(machine, p, fit) for p, (machine, _, _), fit in answers)


def fit_all_from_start(
    requests: Sequence[RefitRequest], runner: CallRunner, cost_limit: float = np.inf
) -> Iterator[ExtendedFit | None]:
    """Fit several machines side by side from the initial trajectories of the logs; None for each that fails."""
    data = [adapt_data(machine, previous) for machine, previous, _ in requests]
    calls = [
        partial(fit_from_start, p, process_noise, min(cost_limit, LOST_COST_RATIO * p.n_readings))
        for p, (_, _, process_noise) in zip(data, requests, strict=True)
    ]
    answers = zip(data, requests, runner(calls), strict=True)
    return (None if fit is None else assemble_fit(machine, p, fit) for p, (machine, _, _), fit in answers)


def _hold_parameter(data: FitData, name: str) -> FitData:
    return replace(data, held=data.held | (np.array(data.space.model.base.names) == name))


def drop_process_noise(found: Sequence[ExtendedFit], runner: CallRunner) -> Iterator[ExtendedFit | None]:
    """Refit without process noise, side by side; None where exact dynamics are far from the logs."""
    for stage, fit in zip(found, runner([partial(_exact_fit, x) for x in found]), strict=True):
        yield None if fit is None else replace(stage, fit=fit)


def exact_if_close(stage: ExtendedFit) -> ExtendedFit:
    """Drop a fit's process noise if exact dynamics come close to the logs; otherwise return it unchanged."""
    without = None if stage.exact or not stage.is_close else next(drop_process_noise([stage], run_in_turn))
    return without if without is not None and without.is_close else stage


def _exact_fit(stage: ExtendedFit) -> Fit | None:
    cost_limit = LOST_COST_RATIO * stage.data.n_readings
    try:
        fit = resume_fit(stage.data, stage, 0.0, cost_limit)
    except NotConvergedError:
        return None
    return fit if fit.cost < cost_limit else None


def _resume_or_none(
    data: FitData, previous: ExtendedFit, process_noise: float, cost_limit: float = np.inf
) -> Fit | None:
    try:
        return resume_fit(data, previous, process_noise, cost_limit)
    except NotConvergedError:
        return None


def resume_fit(data: FitData, previous: ExtendedFit, process_noise: float, cost_limit: float = np.inf) -> Fit:
    """Fit data of another model, starting from a previous fit.

    A fit that ran out of passes is accepted if its cost is close to what noise makes. Raises NotConvergedError.
    """
    space = data.space
    old = dict(zip(previous.model.base.names, previous.fit.X, strict=True))
    X = np.array([old.get(n, x) for n, x in zip(space.model.base.names, space.model.nominal, strict=True)])
    X = np.where(data.held, space.model.nominal, X)
    trajectories = [
        transfer_trajectory(space, r, p, previous.data.space, X)
        for r, p in zip(data.measurements, previous.fit.trajectories, strict=True)
    ]
    X = np.where(_initially_held(data, previous, process_noise), space.model.nominal, X)
    fit = iterate(data, trajectories, X, process_noise, RESUMED_DAMPING, RESUMED_PASSES, cost_limit)
    near = fit.status != "stopped" and fit.cost <= min(CLOSE_FIT_COST_RATIO * data.expected_cost, cost_limit)
    if fit.step > smoothing.ACCEPTABLE_STEP and not near:
        fit.required()
    return without_smoother_levels(fit)


def _initially_held(data: FitData, previous: ExtendedFit, process_noise: float) -> np.ndarray:
    """Return the parameters (n_base,) that the previous fit could not identify and that nothing new may show.

    Smaller process noise or sensor noise may show them. Free from the first pass, they would lead each refit astray.
    """
    names = data.space.model.base.names
    if (
        previous.fit.process_noise > process_noise
        or previous.data.noise_inflation != data.noise_inflation
        or not previous.estimated
    ):
        return np.zeros(len(names), bool)
    unseen = {n for n, yes in zip(previous.model.base.names, previous.fit.unidentifiable, strict=True) if yes}
    return np.array([n in unseen for n in names])


def iterate(
    data: FitData,
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    process_noise: float,
    damping: float = FIRST_DAMPING,
    passes: int = MAX_PASSES,
    cost_limit: float = np.inf,
    patient: bool = False,
) -> Fit:
    """Fit from given trajectories and parameters X (n_base,); the fit has a status.

    With process noise above its minimum an acceptable step ends the fit: likelihood ratios are much larger than what a
    further pass changes. Otherwise a sufficient step ends it; a patient fit goes to full convergence.
    """
    tolerance = FULL_STEP if patient else SUFFICIENT_STEP
    if process_noise > MIN_PROCESS_NOISE:
        tolerance = smoothing.ACCEPTABLE_STEP
    settings = smoothing.Settings(passes, damping, tolerance=tolerance, cost_limit=cost_limit)
    return smoothing.fit_logs(
        data.space, data.measurements, trajectories, X, data.starts, data.held, process_noise, settings
    )


def without_smoother_levels(fit: Fit) -> Fit:
    """Drop what only the fit's own iteration needs."""
    return replace(fit, linear=tuple(replace(x, chain=x.chain.without_levels) for x in fit.linear))


def _build_space(machine: Machine, logs: Sequence[Log]) -> StateSpace:
    model = build(machine, fit_shapes=True)
    return build_state_space(model, common_sensors(model, logs))


def prepare_data(
    machine: Machine, logs: Sequence[Log], filter: Filter, friction_near_rest: Sequence[np.ndarray] | None = None
) -> FitData:
    """Prepare logs for a machine; friction_near_rest: see `FitData`."""
    space = _build_space(machine, logs)
    measurements, starts = prepare_logs(space, logs, filter)
    free = None if friction_near_rest is None else tuple(friction_near_rest)
    return FitData(
        space,
        tuple(logs),
        _with_free_friction(measurements, space.model, free),
        starts,
        identification.parameters_at_rest(space.model, logs, filter, slow=False),
        free,
    )


def _with_free_friction(
    measurements: Sequence[Measurements], model: Model, friction_near_rest: Sequence[np.ndarray] | None
) -> tuple[Measurements, ...]:
    """Free the friction near rest; a small share of it where an effect says what it is at its joint."""
    if friction_near_rest is None:
        return tuple(measurements)
    known = {k for e in model.effects if e.unsticking for k in e.bodies}
    share = np.array([FRICTION_ERROR if body.index in known else 1.0 for body in model.machine.actuated])
    sizes = zip(measurements, friction_near_rest, strict=True)
    return tuple(replace(r, extra_torque_noise=size * share) for r, size in sizes)


def adapt_data(machine: Machine, previous: ExtendedFit) -> FitData:
    """Prepare a previous fit's logs for a machine with other effects."""
    before = previous.data
    if machine is previous.machine:
        return before
    space = _build_space(machine, before.logs)
    model = space.model
    measurements = _with_free_friction(
        [replace(r, offset_sensors=encoders_with_offset(space, r.read_at_edges)) for r in before.measurements],
        model,
        before.friction_near_rest,
    )
    starts = tuple(
        transfer_trajectory(space, r, p, before.space, model.nominal)
        for r, p in zip(measurements, before.starts, strict=True)
    )
    held = dict(zip(previous.model.base.names, before.held, strict=True))
    return FitData(
        space,
        before.logs,
        measurements,
        starts,
        np.array([held.get(n, False) for n in model.base.names]),
        before.friction_near_rest,
    )
