"""Fit a machine's model to logs, alone or with further effects.

Exact dynamics come first. Where they do not follow the logs, forces that the model lacks are fitted beside it.
Independent fits run side by side. Only their `Fit`s are sent back from other processes, since models hold compiled
code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from excite import identification, smoothing
from excite.diagnosis import evidence, score_test
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.logs import Log
from excite.model import Model, build, required_signs
from excite.model.effects import PlacedEffect
from excite.model.machine import Filter, Machine
from excite.smoothing import (
    Fit,
    Measurements,
    NotConvergedError,
    Settings,
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
TRACKING_COST_RATIO = 2.5  # cost over its expected value up to which exact dynamics follow the logs; chosen
LOST_COST_RATIO = 10.0  # the same with some of several effects in the model, and from which a fit is given up; chosen
FRICTION_ERROR = 0.1  # share of friction near rest by which an effect's formula may err there; chosen
CHANCE_STDS = 4.0  # standard deviations of a sum of squares that are no chance
COST_TOLERANCE = 0.02  # share of its expected value by which a right model's cost may be larger; chosen
CLOSE_FIT_COST_RATIO = 1.3  # cost over its expectation from noise up to which a fit is close; chosen
IMPOSSIBLE_SIGN_STDS = 3.0  # standard deviations beyond zero from which a parameter's sign is impossible; chosen
IMPOSSIBLE_SIGN_SHARE = 0.5  # share of the parameter's scale beyond zero, likewise; chosen
FROM_START = Settings(20, tolerance=0.3)  # of a fit from the filtered log
RESUMED = Settings(14, 0.25, tolerance=0.3)  # of a fit that continues another
COMPARED = Settings(9, 0.25, tolerance=0.5)  # of one that is compared with it
# Rounds of a fit beside unknown forces: parameters stay near their first values, as shapes and sizes come first.
ROUNDS_BESIDE = (Settings(6, 1e4, 1.0, tolerance=0.3), Settings(6, 1e3, 0.3, tolerance=0.3))


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
    def sticks(self) -> bool:
        """Tell if friction may have either sign where joints are near rest."""
        return self.friction_near_rest is not None

    @property
    def n_readings(self) -> float:
        """Number of readings in all logs: the cost expected of a right model."""
        return float(sum(r.used.sum() for r in self.measurements))

    @property
    def noise_cost(self) -> float:
        """Largest cost that noise may cause."""
        n = self.n_readings
        return n + max(COST_TOLERANCE * n, CHANCE_STDS * float(np.sqrt(2 * n)))

    @property
    def duration(self) -> float:
        """Duration of the longest log [s]."""
        return max(float(log.t[-1] - log.t[0]) for log in self.logs)


@dataclass(frozen=True)
class ExtendedFit:
    """A model with the effects chosen so far, fitted to logs: one stage of the search.

    measurements: with the noise of torques that the fit has, that of the data if it is exact.
    """

    machine: Machine
    data: FitData
    fit: Fit
    measurements: tuple[Measurements, ...]

    @property
    def model(self) -> Model:
        return self.data.space.model

    @property
    def duration(self) -> float:
        """Duration of the longest log [s]."""
        return self.data.duration

    def placed(self, name: str) -> PlacedEffect:
        """Return an effect of the model by its name."""
        return next(e for e in self.model.effects if e.name == name)

    def fitted(self, name: str) -> PlacedEffect:
        """Return an effect of the model with magnitude and shapes as fitted."""
        placed = self.placed(name)
        found = dict(zip(self.model.base.names, self.fit.X, strict=True))
        values = {key: float(found.get(p, placed.values[key])) for p, (key, _) in placed.parameters.items()}
        return replace(placed, values={**placed.values, **values})

    @property
    def exact(self) -> bool:
        """Tell if nothing is fitted beside the model."""
        unknown = self.fit.unknown
        return not unknown.count and not any(x.force_std.any() for x in unknown.lacking)

    @property
    def excess_cost(self) -> float:
        """Cost beyond what noise may cause, whose level nobody knows well where its tails are heavy."""
        return max(0.0, self.fit.cost - self.data.noise_cost - float(self.heavy_excess.sum()))

    @property
    def heavy_excess(self) -> np.ndarray:
        """Sum of squares by sensor (m,), beyond their number, of innovations with heavy tails; none of an encoder."""
        sensors = self.data.space.sensors
        total = np.zeros(len(sensors))
        for linear in self.fit.linear:
            for j, sensor in enumerate(sensors):
                z = linear.innovations[:, j]
                z = z[np.isfinite(z)]
                if sensor.resolution is None and smoothing.has_heavy_tails(z):
                    total[j] += max(0.0, float(z @ z) - len(z))
        return total

    @cached_property
    def deviance(self) -> float:
        """Twice the negative log-likelihood, but for a constant, by which fits to the same logs are compared.

        Where friction is free near rest, or forces are, the covariance of the innovations counts, too.
        """
        free = self.data.sticks or not self.exact
        return self.fit.cost + (sum(map(log_variance, self.fit.linear)) if free else 0.0)

    @property
    def is_close(self) -> bool:
        """Tell if the cost is near that of a right model."""
        return self.fit.cost <= CLOSE_FIT_COST_RATIO * self.data.n_readings

    @cached_property
    def lacking(self) -> smoothing.UnknownForces:
        """Shapes, along the fitted logs, of what the model may lack and no effect of the catalogue has."""
        pairs = list(zip(self.measurements, self.bare.trajectories, strict=True))
        white = self.bare.unknown.lacking[0].force_std
        return smoothing.catalogue(self.data.space, pairs, self.bare.X, white, False)

    @cached_property
    def fitted_logs(self) -> tuple[score_test.FittedLog, ...]:
        """The fitted logs along which candidates are scored, without unknown forces but white ones."""
        logs = score_test.fitted_logs(self.data.space, self.measurements, self.bare)
        return tuple(score_test.beside(x, own) for x, own in zip(logs, self.lacking.lacking, strict=True))

    @cached_property
    def bare(self) -> Fit:
        """The fit without unknown forces but white ones. Raises NotConvergedError."""
        if not self.fit.unknown.count:
            return self.fit
        return self._beside(self.fit.unknown.lacking[0].force_std, self.measurements).fit

    @cached_property
    def alone(self) -> ExtendedFit:
        """The fit without anything beside the model, along the same trajectories. Raises NotConvergedError."""
        return self if self.exact else self._beside(np.zeros(len(self.data.space.forces)), self.data.measurements)

    def _beside(self, force_std: np.ndarray, measurements: tuple[Measurements, ...]) -> ExtendedFit:
        """Return the fit, linearised along the same trajectories, beside white forces alone."""
        unknown = smoothing.UnknownForces((smoothing.Lacking((), (), 0, force_std),) * len(measurements))
        along = tuple(replace(t, lacking=np.zeros(0), force_error=None) for t in self.fit.trajectories)
        found = replace(self, fit=replace(self.fit, unknown=unknown, trajectories=along), measurements=measurements)
        return replace(found, fit=found.relinearised)

    @property
    def relinearised(self) -> Fit:
        """The fit linearised about its parameters and trajectories with all readings. Raises NotConvergedError."""
        data, fit = self.data, self.fit
        found = smoothing.linearise_with(
            data.space, self.measurements, fit.trajectories, fit.X, data.starts, fit.unidentifiable, fit.unknown
        )
        if found is None:
            raise NotConvergedError("a fit cannot be linearised: check the log with `excite log check`")
        return without_smoother_levels(found)

    def release(self) -> None:
        """Drop the logs along which candidates were scored, which take most of the memory."""
        for name in ("fitted_logs", "lacking", "bare"):
            self.__dict__.pop(name, None)

    def form(self, found: Sequence[score_test.Candidate], runner: CallRunner = run_in_turn) -> evidence.Form:
        """Return the form of parameters, of what else the model may lack, and of candidates about this fit."""
        return evidence.build_form(self.fitted_logs, self.bare, self.lacking, found, self.data.duration, runner)

    @property
    def dispersion(self) -> float:
        """Ratio of the cost to its expected value, at least 1: likelihood ratios count less by this factor."""
        return max(1.0, self.fit.cost / self.data.n_readings)

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
    def suspect_sensors(self) -> list[str]:
        return identification.find_suspect_sensors(self.data.space, self.data.logs, self.fit)

    def wald(self, name: str) -> float:
        """Return the squared distance of an effect's magnitude from zero, in standard deviations.

        Signed shapes count together with the magnitude, as one may stand for the other. It is 0 for unidentifiable
        parameters.
        """
        shapes, names, fit = self.placed(name).effect.shapes, self.model.base.names, self.fit
        parameters = [name, *(f"{name}.{s}" for s, shape in shapes.items() if shape.signed and not shape.circular)]
        at = [k for k in (names.index(n) for n in parameters if n in names) if not fit.unidentifiable[k]]
        std = fit.std[at]
        distance = fit.X[at] / std
        return float(distance @ np.linalg.solve(fit.covariance[np.ix_(at, at)] / np.outer(std, std), distance))

    def parameters_of(self, name: str) -> list[int]:
        """Return the places of an effect's magnitude and shapes among the base parameters."""
        return [k for k, n in enumerate(self.model.base.names) if n == name or n.startswith(f"{name}.")]


def fit_machine(
    machine: Machine,
    logs: Sequence[Log],
    filter: Filter,
    friction_near_rest: Sequence[np.ndarray] | None = None,
) -> ExtendedFit:
    """Fit a machine's model to logs, with the shapes of its effects free.

    Beside unknown forces if exact dynamics do not follow the logs. friction_near_rest: see `FitData`. Raises
    NotConvergedError.
    """
    data = prepare_data(machine, logs, filter, friction_near_rest)
    return ExtendedFit(machine, data, *_follow(data, data.starts, data.space.model.nominal, FROM_START))


def fit_machine_that_sticks(plain: ExtendedFit, logs: Sequence[Log], filter: Filter) -> ExtendedFit:
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
        found = fit_machine(soft.machine, logs, filter, extra)
    except NotConvergedError:
        return plain
    return found if found.exact and found.is_close else plain


Fitted = tuple[Fit, tuple[Measurements, ...]]


def _follow(
    data: FitData,
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    settings: Settings,
    most: float | None = None,
    before: ExtendedFit | None = None,
) -> Fitted:
    """Fit exact dynamics, or beside unknown forces if these do not follow the logs. Raises NotConvergedError.

    most: cost from which a fit is given up that has nothing beside the model. before: a fit that this one continues.
    """
    limit = (LOST_COST_RATIO if settings is RESUMED else TRACKING_COST_RATIO) * data.n_readings
    lost = (TRACKING_COST_RATIO if settings is COMPARED else LOST_COST_RATIO) * data.n_readings
    fit = smoothing.fit_logs(
        data.space,
        data.measurements,
        trajectories,
        X,
        data.starts,
        data.held,
        settings=replace(settings, cost_limit=lost if most is None else min(lost, most)),
    )
    # Of a dull drive the next step may be long although the cost is that of noise.
    near = data.noise_cost if fit.status == "stopped" else CLOSE_FIT_COST_RATIO * data.n_readings
    if fit.linear and fit.cost <= (limit if fit.step <= smoothing.ACCEPTABLE_STEP else near):
        return without_smoother_levels(fit), data.measurements
    if most is not None:
        raise NotConvergedError("exact dynamics do not follow the logs")
    known = None if before is None or before.exact else smoothing.FitBeside(before.fit, before.measurements)
    rounds = ROUNDS_BESIDE if known is None else ROUNDS_BESIDE[-1:]
    return _beside(data, rounds, (X, trajectories), known)


def _beside(
    data: FitData,
    rounds: Sequence[Settings],
    first: tuple[np.ndarray, Sequence[Trajectory]],
    known: smoothing.FitBeside | None = None,
) -> Fitted:
    """Fit beside unknown forces; arguments as `fit_unknown_forces` has them. Raises NotConvergedError."""
    found = smoothing.fit_unknown_forces(
        data.space, data.measurements, data.starts, data.held, rounds, True, first, known
    )
    if not found.fit.linear:
        found.fit.required()
    return without_smoother_levels(found.fit), found.measurements


def beside_unknown_forces(stage: ExtendedFit) -> ExtendedFit:
    """Return a fit beside unknown forces, also where exact dynamics follow the logs. Raises NotConvergedError."""
    if not stage.exact:
        return stage
    fit, measurements = _beside(stage.data, ROUNDS_BESIDE, (stage.fit.X, stage.fit.trajectories))
    return replace(stage, fit=fit, measurements=measurements)


def _continued(machine: Machine, previous: ExtendedFit) -> tuple[FitData, list[Trajectory], np.ndarray]:
    """Return data of a machine with other effects, and where a fit of it begins from a previous fit."""
    data = adapt_data(machine, previous)
    space = data.space
    old = dict(zip(previous.model.base.names, previous.fit.X, strict=True))
    X = np.array([old.get(n, x) for n, x in zip(space.model.base.names, space.model.nominal, strict=True)])
    X = np.where(data.held, space.model.nominal, X)
    along = [
        transfer_trajectory(space, r, p, previous.data.space, X)
        for r, p in zip(data.measurements, previous.fit.trajectories, strict=True)
    ]
    return data, along, X


def refit(machine: Machine, previous: ExtendedFit) -> ExtendedFit:
    """Fit a machine with other effects to the same logs, from a previous fit. Raises NotConvergedError."""
    data, along, X = _continued(machine, previous)
    return ExtendedFit(machine, data, *_follow(data, along, X, RESUMED, before=previous))


def refit_all(
    machines: Sequence[Machine],
    previous: ExtendedFit,
    runner: CallRunner,
    held: Sequence[str] = (),
    most: float = np.inf,
) -> Iterator[ExtendedFit | None]:
    """Refit several machines side by side with exact dynamics; None for each that does not follow the logs.

    held: for each machine a parameter that stays at its file's value. most: cost from which a fit is given up.
    """
    begun = [_continued(machine, previous) for machine in machines]
    if held:
        begun = [(_hold_parameter(data, name), s, X) for (data, s, X), name in zip(begun, held, strict=True)]
    calls: list[Callable[[], Any]] = [partial(_follow_or_none, *own, most) for own in begun]
    for machine, (data, *_), fitted in zip(machines, begun, runner(calls), strict=True):
        yield None if fitted is None else ExtendedFit(machine, data, *fitted)


def _follow_or_none(data: FitData, trajectories: Sequence[Trajectory], X: np.ndarray, most: float) -> Fitted | None:
    try:
        return _follow(data, trajectories, X, COMPARED, most)
    except NotConvergedError:
        return None


def _hold_parameter(data: FitData, name: str) -> FitData:
    return replace(data, held=data.held | (np.array(data.space.model.base.names) == name))


def without_smoother_levels(fit: Fit) -> Fit:
    """Drop what only the fit's own iteration needs."""
    return replace(fit, linear=tuple(replace(x, chain=x.chain.without_levels) for x in fit.linear))


def _build_space(machine: Machine, logs: Sequence[Log]) -> StateSpace:
    model = build(machine, fit_shapes=True)
    return build_state_space(model, common_sensors(model, logs), bool(machine.contacts))


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
