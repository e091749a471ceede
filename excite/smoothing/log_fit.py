"""Most likely parameters and trajectories of logs, with what the model lacks.

Every log is linearised about its trajectory, its states are integrated out by the parallel smoother, and the solver
steps in what is left: base parameters, coefficients of what the model lacks, offsets of encoders.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from excite.errors import NoEstimateError
from excite.model import Model
from excite.smoothing import forward, solver
from excite.smoothing.forward import Evaluation
from excite.smoothing.innovations import LinearisedLog
from excite.smoothing.linearisation import StateSpace
from excite.smoothing.measurements import Measurements, Trajectory, offset_scale
from excite.smoothing.solver import Quadratic, Settings, Solution
from excite.smoothing.unknown_forces import UnknownForces, no_unknown_forces
from excite.text import format_number

# Prior of the parameters, relative to each parameter's scale.
PRIOR_STD = 3.0  # prior standard deviation; a value further off than this counts as its own prior
MAX_IDENTIFIABLE_STD = 1.0  # a parameter known less well than its size is held at the machine file's value
HELD_STD = 1e-6  # prior standard deviation of a held parameter
ACCEPTABLE_STEP = 1.0  # [standard deviations] next step of a fit that may be continued or compared
DEFAULT = Settings()
PENALTY = 1.5  # weight of a defect over its multiplier; an exact penalty needs more than 1
LEAST_PENALTY = 0.05  # weight of a defect over the largest multiplier of its state
MAX_TURN = 1.0  # [rad] of a joint in one pass: sines and cosines are not straight beyond
MAX_RELATIVE_DECREASE = 0.8  # of a positive parameter in one pass, relative to its value
LEAST_INERTIA = 1e-3  # share of the machine file's inertia that an estimate may have; chosen
SETTLING_PASSES = 3  # until the states fit the dynamics well enough to judge which parameters are identifiable


class NotConvergedError(NoEstimateError):
    """Joint smoothing found no estimate."""


@dataclass(frozen=True)
class Fit:
    """Parameters and trajectories that explain logs best.

    X (n_base,) [SI], covariance (n_base, n_base) [SI]. unidentifiable (n_base,): parameters held at the machine file's
    values. prior (n_base,): information about these values, scaled. cost: twice the negative log-likelihood.
    trajectories, linear: of each log. status, step
    [standard deviations], history: see `solver.Solution`. unknown: what the model lacks. information: of all unknowns,
    scaled; right_side: information times the most likely values, where parameters count from X and coefficients from
    zero.
    """

    X: np.ndarray
    covariance: np.ndarray
    unidentifiable: np.ndarray
    prior: np.ndarray
    trajectories: tuple[Trajectory, ...]
    linear: tuple[LinearisedLog, ...]
    cost: float
    status: solver.Status
    step: float
    history: tuple[tuple[float, float], ...]
    unknown: UnknownForces
    information: np.ndarray
    right_side: np.ndarray

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    @property
    def indices(self) -> list[np.ndarray]:
        """For each log, the places of parameters, coefficients and own offsets among those of all logs."""
        return places(len(self.X), self.unknown, [len(t.offset) for t in self.trajectories])

    def required(self) -> Fit:
        """Return the fit if it converged. Raises NotConvergedError."""
        if self.status == "converged":
            return self
        raise NotConvergedError(
            f"joint smoothing found no estimate: {self.status} after {len(self.history)} steps (last step"
            f" {format_number(self.step, 3)} standard deviations): check the log with `excite log check` and `excite"
            " diagnose`, or start from better values in the machine file"
        )


def places(n: int, unknown: UnknownForces, offsets: Sequence[int]) -> list[np.ndarray]:
    """Return, for each log, the places of n parameters, its coefficients and its own offsets among those of all logs.

    offsets: their number in each log.
    """
    ends = n + unknown.count + np.cumsum(offsets)
    logs = zip(unknown.index, ends, offsets, strict=True)
    return [np.r_[0:n, n + index, end - count : end] for index, end, count in logs]


def prior_information(model: Model, held: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return the information (n_base,) about the machine file's values, scaled, at parameters X (n_base,).

    A value far from the estimate must not attract it, as the error would be taken for another cause. Parameters of
    effects have no value in the machine file.
    """
    effect_parameters = {name for e in model.effects for name in e.parameters}
    from_file = np.array([n not in effect_parameters for n in model.base.names])
    return np.where(held, HELD_STD**-2, np.maximum(from_file * np.abs(X) / model.scale, PRIOR_STD) ** -2)


def prior_terms(model: Model, prior: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return information (n_base, n_base), slope (n_base,) and cost at X (n_base,) without any log, scaled.

    They are those of `prior` (n_base,), about the nominal values, and of what the machine file calls known.
    """
    deviation, known = (X - model.nominal) / model.scale, model.known
    misfit = known.rows @ X - known.values
    return (
        np.diag(prior) + known.information(model.scale),
        prior * deviation + (known.rows * model.scale).T @ misfit,
        float(prior @ deviation**2 + misfit @ misfit),
    )


@dataclass(frozen=True)
class Determinant:
    """Log determinant of the innovations' covariance as a function of parameters and coefficients.

    slope (n_base,): by the scaled parameters, at X (n_base,). by_coefficients (count,), at coefficients (count,).
    White forces move an inertia or a stiff contact the less the larger it is, so where the determinant falls with a
    parameter's size it is a multiple of its logarithm.
    """

    slope: np.ndarray
    X: np.ndarray
    by_coefficients: np.ndarray
    coefficients: np.ndarray

    def terms(self, X: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return information (n_base,), slope (n_base,) and cost at X (n_base,), of steps over the scale."""
        as_log = self.slope * self.X < -scale  # else a change by its size changes nothing
        if (X[as_log] * self.X[as_log] <= 0).any():
            return np.zeros_like(X), np.zeros_like(X), np.inf
        ratio = np.where(as_log, self.X / np.where(as_log, X, 1.0), 1.0)
        cost = np.where(as_log, -self.X * np.log(ratio), X - self.X) / scale
        curvature = np.where(as_log, -self.slope * ratio * scale / np.where(as_log, X, 1.0), 0.0)
        return curvature / 2, self.slope * ratio / 2, float(self.slope @ cost)


def log_determinant(
    space: StateSpace, measurements: Sequence[Measurements], starts: Sequence[Trajectory], fit: Fit
) -> Determinant:
    """Return the log determinant of all innovations' covariance about a fit."""
    slope, by_coefficients = np.zeros(len(fit.X)), np.zeros(fit.unknown.count)
    unknown = fit.unknown
    logs = zip(measurements, fit.trajectories, starts, unknown.lacking, unknown.index, fit.linear, strict=True)
    for data, trajectory, start, lacking, index, linear in logs:
        at = forward.evaluate(space, data, trajectory, start.state[0], fit.X, lacking)
        assert at is not None  # the fit ended there
        own, by_own = forward.log_variance_slopes(space, at, linear, fit.X, ~fit.unidentifiable)
        slope += own
        by_coefficients[index] += by_own
    return Determinant(slope, fit.X, by_coefficients, unknown.coefficients(fit.trajectories))


@dataclass(frozen=True)
class Point:
    """Parameters X (n_base,) [SI] and the trajectories of all logs."""

    X: np.ndarray
    trajectories: tuple[Trajectory, ...]


@dataclass
class LogProblem:
    """Logs as a least-squares problem (`solver.Problem`).

    prior (n_base,): information about the machine file's values, scaled. held (n_base,): parameters that stay there.
    pull: log determinant of the innovations, which belongs to twice the negative log-likelihood. Its curvature,
    pull_curvature (n_base,), shortens steps and is no information, as unknown forces change the determinant alike.
    """

    space: StateSpace
    measurements: Sequence[Measurements]
    starts: Sequence[Trajectory]
    prior: np.ndarray
    held: np.ndarray
    unknown: UnknownForces
    pull: Determinant | None = None
    point: Point = field(init=False)
    evaluations: list[Evaluation] = field(init=False)
    linear: tuple[LinearisedLog, ...] = ()
    weights: list[np.ndarray] = field(default_factory=list)
    linearised_coefficients: np.ndarray = field(default_factory=lambda: np.zeros(0))
    pull_curvature: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def least_pivots(self) -> np.ndarray:
        """Lowest pivots (n_q,) of the mass matrix: a share of the machine file's, below which motions are too stiff."""
        states = np.concatenate([t.state[::10] for t in self.starts])
        nominal = self.space.pivots(states, self.space.model.nominal)[0][:, :, 0]
        return LEAST_INERTIA * np.maximum(nominal.min(axis=0), 0.0)

    @property
    def indices(self) -> list[np.ndarray]:
        """For each log, the places of parameters, coefficients and own offsets among those of all logs."""
        return places(len(self.prior), self.unknown, [len(data.offset_sensors) for data in self.measurements])

    def enter(self, point: Point) -> bool:
        """Evaluate a point; return False if soil pushes, a mass matrix is not positive, or no motion follows."""
        if (self.space.soil @ point.X > 0).any():
            return False
        found = list[Evaluation]()
        logs = zip(self.measurements, point.trajectories, self.starts, self.unknown.lacking, strict=True)
        for data, trajectory, start, lacking in logs:
            if not (self.space.pivots(trajectory.state[::10], point.X)[0][:, :, 0] > self.least_pivots).all():
                return False
            own = forward.evaluate(self.space, data, trajectory, start.state[0], point.X, lacking)
            if own is None:
                return False
            found.append(own)
        self.point, self.evaluations = point, found
        return True

    def beside_logs(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return information, slope and cost of the priors of parameters, coefficients and offsets, scaled."""
        n_p, n_c, size = len(self.prior), self.unknown.count, max((int(i.max()) + 1 for i in self.indices), default=0)
        size = max(size, n_p + n_c)
        information, slope = np.zeros((size, size)), np.zeros(size)
        information[:n_p, :n_p], slope[:n_p], cost = prior_terms(self.space.model, self.prior, self.point.X)
        if self.pull is not None:
            curvature, own_slope, own_cost = self.pull.terms(self.point.X, self.space.model.scale)
            information[range(n_p), range(n_p)] += curvature
            slope[:n_p] += own_slope
            cost += own_cost
        coefficients = self.unknown.coefficients(self.point.trajectories)
        precision = self.unknown.precision
        where = np.arange(n_p, n_p + n_c)
        information[where, where], slope[where] = precision, precision * coefficients
        cost += float(precision @ coefficients**2)
        if self.pull is not None:
            slope[where] += self.pull.by_coefficients / 2
            cost += float(self.pull.by_coefficients @ (coefficients - self.pull.coefficients))
        for data, trajectory, own in zip(self.measurements, self.point.trajectories, self.indices, strict=True):
            offsets = own[len(own) - len(data.offset_sensors) :]
            deviation = trajectory.offset / offset_scale(self.space, data) - 0.5
            information[offsets, offsets] += 1.0
            slope[offsets] += deviation
            cost += float(deviation @ deviation)
        return information, slope, cost

    def with_logs(self, linear: Sequence[LinearisedLog]) -> tuple[np.ndarray, np.ndarray, float]:
        """Return information, slope and cost of the priors and of linearised logs, scaled."""
        information, slope, cost = self.beside_logs()
        for log, own in zip(linear, self.indices, strict=True):
            information[np.ix_(own, own)] += log.Z[1:, 1:]
            slope[own] += log.Z[1:, 0]
            cost += float(log.Z[0, 0])
        return information, slope, cost

    def quadratic(self) -> Quadratic | None:
        """Linearise every log and integrate out its states; return None if a chain is singular."""
        X, self.linear = self.point.X, ()  # both at once take twice the memory
        try:
            linear = tuple(
                forward.linearise(self.space, e, start.state[0], X)
                for e, start in zip(self.evaluations, self.starts, strict=True)
            )
            information, slope, cost = self.with_logs(linear)
        except np.linalg.LinAlgError:  # the chain is numerically singular this far off
            return None
        if not (np.isfinite(information).all() and (np.diag(information) > 0).all()):
            return None
        self.linear, self.linearised_coefficients = linear, self.unknown.coefficients(self.point.trajectories)
        self.pull_curvature = np.zeros(len(X)) if self.pull is None else self.pull.terms(X, self.space.model.scale)[0]
        n_p = len(self.prior)
        parameter = np.arange(len(slope)) < n_p
        free = parameter.copy()
        free[:n_p] = ~self.held
        values, rows = self.positive_quantities()
        rows = np.hstack([rows * self.space.model.scale, np.zeros((len(rows), len(slope) - n_p))])
        return Quadratic(information, slope, cost, parameter, (rows, -MAX_RELATIVE_DECREASE * values), free)

    def positive_quantities(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances (m,) of quantities from their lowest values, with their slopes by X (m, n_base).

        Positive parameters, drags of the soil, pivots of the mass matrix where they are smallest. Steps keep them above
        zero, and may follow such a limit.
        """
        X, model = self.point.X, self.space.model
        free = np.flatnonzero(model.positive & ~self.held)
        states = np.concatenate([t.state[::10] for t in self.point.trajectories])
        where = states[np.argmin(self.space.pivots(states, X)[0][:, :, 0], axis=0)]

        def smallest(X: np.ndarray) -> np.ndarray:
            return np.diagonal(self.space.pivots(where, X)[0][:, :, 0])

        here = smallest(X)
        step = forward.DETERMINANT_STEP * model.scale
        slopes = np.array([(smallest(X + d) - here) for d in np.diag(step)]).T / step
        values = np.concatenate([X[free], -self.space.soil @ X, here - self.least_pivots])
        return values, np.vstack([np.eye(len(X))[free], -self.space.soil, slopes])

    def weigh(self, step: np.ndarray) -> None:
        """Set the weights of the defects from the multipliers of a step."""
        new = []
        for log, own in zip(self.linear, self.indices, strict=True):
            multiplier = log.states(step[own])[1][1:]
            if log.closing is not None:
                multiplier = (log.closing.transpose(0, 2, 1) @ multiplier[:, :, None])[:, :, 0]
            multiplier = 2 * np.abs(multiplier)
            new.append(np.maximum(PENALTY * multiplier, LEAST_PENALTY * multiplier.max(axis=0)))
        self.weights = new

    def merit(self) -> float:
        """Return cost plus weighted defects at the current point."""
        cost, scale = self.beside_logs()[2], forward.state_scale(self.space)
        for e, weight in zip(self.evaluations, self.weights, strict=True):
            cost += e.cost + float(np.sum(weight * np.abs(e.defect / scale)))
        return cost

    def moved(self, step: np.ndarray) -> tuple[Callable[[float], Point], float]:
        """Return the path from the current point to the one after a step, with its most likely states.

        No joint turns farther than MAX_TURN from the trajectory at which the logs were linearised.
        """
        here, X = self.point, self.point.X + step[: len(self.prior)] * self.space.model.scale
        there = tuple(
            forward.move(self.space, trajectory, log, lacking, step[own], X, data)
            for trajectory, log, lacking, own, data in zip(
                here.trajectories, self.linear, self.unknown.lacking, self.indices, self.measurements, strict=True
            )
        )

        def path(fraction: float) -> Point:
            if fraction == 1.0:
                return Point(X, there)
            between = (forward.interpolate(a, b, fraction) for a, b in zip(here.trajectories, there, strict=True))
            return Point(here.X + fraction * (X - here.X), tuple(between))

        turns = forward.is_turning(self.space)
        farthest = max(
            float(np.abs(a.state - b.state)[:, turns].max(initial=0.0))
            for a, b in zip(here.trajectories, there, strict=True)
        )
        return path, min(1.0, MAX_TURN / max(farthest, MAX_TURN))


def fit_logs(
    space: StateSpace,
    measurements: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    starts: Sequence[Trajectory],
    held: np.ndarray,
    settings: Settings = DEFAULT,
    unknown: UnknownForces | None = None,
    pull: Determinant | None = None,
) -> Fit:
    """Find the most likely parameters and trajectories of logs; the fit has a status.

    trajectories, X (n_base,): where the iteration starts. starts: trajectories whose first states are the prior means
    of the first states. held (n_base,): parameters that stay at the machine file's values. unknown: forces beside the
    model, of given sizes. pull: see `LogProblem`.
    """
    unknown = no_unknown_forces(space, len(measurements)) if unknown is None else unknown
    X = np.where(held, space.model.nominal, X)
    point = Point(X, tuple(trajectories))

    def solve(fixed: np.ndarray, at: Point, how: Settings) -> tuple[LogProblem, Solution[Point]]:
        at = Point(np.where(fixed, space.model.nominal, at.X), at.trajectories)
        prior = prior_information(space.model, fixed, at.X)
        own = None if pull is None else replace(pull, slope=np.where(fixed, 0.0, pull.slope))
        problem = LogProblem(space, measurements, starts, prior, fixed, unknown, own)
        return problem, solver.minimise(problem, at, how)

    fixed, history = held, tuple[tuple[float, float], ...]()
    done, stage = 0, 0
    while True:
        passes = min(SETTLING_PASSES if not done else 2 * done, settings.passes - done)
        damping = settings.damping * settings.decrease**done
        how = replace(settings, passes=passes, damping=damping, settled=0 if done else settings.settled)
        later = solve(fixed, point, how)
        if later[1].quadratic is None and stage > 0:  # what is held now leads out of the range of motions
            break
        (problem, solution), judged = later, fixed
        point, history, done, stage = solution.point, history + solution.history, done + passes, stage + 1
        if solution.quadratic is None or done == settings.passes:
            break
        # What was held while the fit was far off is judged once more; then parameters are only added.
        fixed = find_unidentifiable(problem, solution.quadratic, held if stage == 2 else judged)
        finished = solution.status != "stalled" or not solution.history
        if finished and (fixed == judged).all():
            break
    return _as_fit(problem, solution, judged, history)


def linearise_with(
    space: StateSpace,
    measurements: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    starts: Sequence[Trajectory],
    held: np.ndarray,
    unknown: UnknownForces,
) -> Fit | None:
    """Return the quadratic form of parameters and unknown forces about a point as a fit; None if there is none."""
    prior = prior_information(space.model, held, X)
    problem = LogProblem(space, measurements, starts, prior, held, unknown)
    point = Point(X, tuple(trajectories))
    quadratic = problem.quadratic() if problem.enter(point) else None
    if quadratic is None:
        return None
    return _as_fit(problem, Solution(point, "stalled", quadratic, quadratic.cost, np.inf, ()), held, ())


def _as_fit(
    problem: LogProblem, solution: Solution[Point], fixed: np.ndarray, history: tuple[tuple[float, float], ...]
) -> Fit:
    n = len(fixed)
    if solution.quadratic is None:
        information, right_side, covariance = np.zeros((n, n)), np.zeros(n), np.full((n, n), np.inf)
    else:
        information, here = solution.quadratic.information.copy(), np.zeros(len(solution.quadratic.slope))
        information[range(n), range(n)] -= problem.pull_curvature
        here[n : n + problem.unknown.count] = problem.linearised_coefficients
        right_side = information @ here - solution.quadratic.slope
        covariance = covariance_in_si(problem.space, solver.inverse(information))
    status = "out of range" if solution.quadratic is None else solution.status
    return Fit(
        solution.point.X,
        covariance,
        fixed,
        problem.prior,
        solution.point.trajectories,
        problem.linear if solution.quadratic is not None else (),
        solution.cost,
        status,
        solution.step,
        history,
        problem.unknown,
        information,
        right_side,
    )


def find_unidentifiable(problem: LogProblem, quadratic: Quadratic, held: np.ndarray) -> np.ndarray:
    """Find the parameters (n_base,) to hold, besides `held`, so that no other's standard deviation exceeds its size.

    Those that the problem holds beyond `held` are judged by what the logs tell of them.

    The one that exceeds its size most is held first, then the next given that: of parameters that the logs show only
    together, such as dry friction and offset in one direction, one is held. The size is that of the estimate or the
    scale, whichever is larger, as the machine file's value may be far too small.
    """
    X, information, model = problem.point.X, quadratic.information.copy(), problem.space.model
    judged = np.flatnonzero(problem.held & ~held)
    information[judged, judged] += (prior_information(model, held, X) - problem.prior)[judged]
    information[range(len(X)), range(len(X))] -= problem.pull_curvature
    size = np.maximum(np.abs(X) / model.scale, 1.0)
    return held_in_turn(solver.inverse(information)[: len(X), : len(X)], size, held)


def held_in_turn(covariance: np.ndarray, size: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Hold parameters (n,), besides `held`, one after another until no other's standard deviation exceeds its size.

    covariance (n, n), scaled; size (n,), over the scale.
    """
    left, found = covariance, held.copy()
    while True:
        excess = np.where(found, 0.0, np.sqrt(np.maximum(np.diag(left), 0.0)) / size)
        k = int(np.argmax(excess))
        if not excess[k] > MAX_IDENTIFIABLE_STD:
            return found
        found[k] = True
        left = left - np.outer(left[:, k], left[k]) / left[k, k]


def linearise_logs(
    space: StateSpace,
    measurements: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    starts: Sequence[Trajectory],
    X: np.ndarray,
) -> list[LinearisedLog] | None:
    """Linearise every log; return None if a mass matrix is not positive or a motion cannot be integrated."""
    unknown, held = no_unknown_forces(space, len(measurements)), np.zeros(len(X), bool)
    fit = linearise_with(space, measurements, trajectories, X, starts, held, unknown)
    return None if fit is None else list(fit.linear)


def newton_step(
    space: StateSpace,
    measurements: Sequence[Measurements],
    linear: Sequence[LinearisedLog],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    prior: np.ndarray,
    fixed: np.ndarray | None = None,
) -> tuple[np.ndarray, list[np.ndarray], float]:
    """Compute one unbounded Gauss-Newton step of parameters and offsets, from logs linearised without unknown forces.

    fixed (n_base,): parameters that stay at their values, also in the covariance. Returns the scaled covariance of all
    parameters and offsets, each log's step, and the predicted cost after it. Raises NotConvergedError if the covariance
    is not positive.
    """
    problem = LogProblem(
        space, measurements, (), prior, np.zeros(len(X), bool), no_unknown_forces(space, len(measurements))
    )
    problem.point = Point(X, tuple(trajectories))
    information, slope, cost = problem.with_logs(linear)
    if fixed is not None:
        information[range(len(X)), range(len(X))] += fixed * HELD_STD**-2
    try:
        covariance = np.linalg.inv(information)
    except np.linalg.LinAlgError:  # far off, readings may tell nothing of a parameter
        covariance = np.zeros_like(information)
    if not (np.diag(covariance) > 0).all():
        raise NotConvergedError(
            "joint smoothing: the parameters' covariance is not positive: check the log with `excite log check`"
        )
    step = -covariance @ slope
    return covariance, [step[own] for own in problem.indices], cost + float(slope @ step)


def covariance_in_si(space: StateSpace, covariance: np.ndarray) -> np.ndarray:
    """Extract the base parameters' covariance (n_base, n_base) [SI] from a scaled one of parameters and offsets."""
    scale = space.model.scale
    return np.asarray(covariance[: len(scale), : len(scale)] * np.outer(scale, scale))


def apply_step(
    space: StateSpace,
    data: Measurements,
    trajectory: Trajectory,
    linear: LinearisedLog,
    move: np.ndarray,
    X: np.ndarray,
) -> Trajectory:
    """Return the trajectory after a scaled step of parameters and offsets to X, with its most likely states."""
    lacking = no_unknown_forces(space, 1).lacking[0]
    return forward.move(space, trajectory, linear, lacking, move, X, data)
