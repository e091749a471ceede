"""Nonlinear least squares with equality constraints: Levenberg-Marquardt steps, none of which raises the merit.

The merit is the cost plus an exact penalty of the constraints' violation, with weights above the Lagrange multipliers
(Han 1977; Nocedal and Wright, "Numerical Optimization", 18.3). The problem does the linear algebra: it eliminates the
constrained variables, such as the states of logs, and leaves a quadratic form in a few parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeVar

import numpy as np
import scipy

Status = Literal["converged", "stalled", "stopped", "out of range"]
Limits = tuple[np.ndarray, np.ndarray]
Point = TypeVar("Point")


@dataclass(frozen=True)
class Settings:
    """Settings of the solver.

    passes: largest number of linearisations. damping: information added to every parameter in the first pass
    (Levenberg), in its scale; it falls by `decrease` with each full step. After a refused step it grows by INCREASE,
    from this value at least; after a much shortened one by the root of that, from 1 at least.
    tolerance: largest step of a parameter that ends the iteration [standard deviations]. halvings: shortenings of a
    step before more damping is tried. sufficient_decrease: share of the predicted decrease that a step must reach.
    cost_limit: cost above which the iteration is stopped once `settled` steps are made and the next exceeds one
    standard deviation.
    """

    passes: int = 30
    damping: float = 25.0
    decrease: float = 0.1
    tolerance: float = 0.02
    halvings: int = 6
    sufficient_decrease: float = 1e-4
    cost_limit: float = np.inf
    settled: int = 3


@dataclass(frozen=True)
class Quadratic:
    """Cost about a point, constrained variables eliminated: cost + 2 slope' p + p' information p.

    information (n, n), slope (n,), cost. damped (n,): parameters that damping acts on. limits: rows (m, n) whose
    products with a step are at least the bounds (m,), none of which is above zero. free (n,): parameters whose steps
    decide about convergence; without any, the decrease of the merit does, as one standard deviation lowers it by one.
    """

    information: np.ndarray
    slope: np.ndarray
    cost: float
    damped: np.ndarray
    limits: Limits
    free: np.ndarray

    def value(self, step: np.ndarray) -> float:
        """Return the predicted cost after a step (n,)."""
        return float(self.cost + 2 * self.slope @ step + step @ self.information @ step)

    def step(self, damping: float) -> np.ndarray:
        """Return the damped step (n,) within its limits."""
        information = self.information + np.diag(np.where(self.damped, damping, 0.0))
        return limited_step(information, self.slope, *self.limits)


class Problem(Protocol[Point]):
    """A least-squares problem whose points hold parameters and constrained variables."""

    def enter(self, point: Point) -> bool:
        """Evaluate a point and make it the current one to compare with; return False if it has no cost."""

    def quadratic(self) -> Quadratic | None:
        """Linearise about the current point; return None if that is numerically singular."""

    def weigh(self, step: np.ndarray) -> None:
        """Set the weights of violations from the multipliers of a step (n,) at the current point."""

    def merit(self) -> float:
        """Return the merit of the current point."""

    def moved(self, step: np.ndarray) -> tuple[Callable[[float], Point], float]:
        """Return the path from the current point, fraction of the step (n,) -> point, and the largest fraction.

        Beyond that fraction the linearisation holds no more, whatever the merit there.
        """


@dataclass(frozen=True)
class Solution(Generic[Point]):
    """A point with its status.

    "converged": the next step is below the tolerance. "stalled": no step lowers the merit by much, or passes ran out.
    "stopped": the cost exceeded its limit, or hardly falls with no minimum near. "out of range": the start has no cost.
    quadratic: about the last linearised point, None if there is none. cost: predicted after the last undamped step.
    step: that step [standard deviations], infinite if the last point cannot be linearised. history: merit before and
    after each accepted step, with the same weights.
    """

    point: Point
    status: Status
    quadratic: Quadratic | None
    cost: float
    step: float
    history: tuple[tuple[float, float], ...]


def minimise(problem: Problem[Point], start: Point, settings: Settings) -> Solution[Point]:
    """Minimise the cost from a start; every accepted step lowers the merit."""
    history = list[tuple[float, float]]()
    point, damping = start, settings.damping
    found: Quadratic | None = None
    cost, length = np.inf, np.inf
    status: Status = "stalled"
    if not problem.enter(start):
        return Solution(start, "out of range", None, np.inf, np.inf, ())
    slow, refused = 0, False
    for _ in range(settings.passes):
        latest = found if refused else problem.quadratic()
        if latest is None:
            length = np.inf
            break
        found = latest
        deviation = np.sqrt(np.diag(inverse(found.information)))
        undamped = found.step(0.0)
        length = float(np.abs(undamped / deviation)[found.free].max(initial=0.0))
        cost = found.value(undamped)
        if len(history) >= settings.settled and cost > settings.cost_limit and length > 1.0:
            status = "stopped"
            break
        step = undamped if damping == 0 else found.step(damping)
        problem.weigh(step)
        before, (path, largest) = problem.merit(), problem.moved(step)
        predicted = before - found.value(step)
        if not found.free.any():
            length = float(np.sqrt(max(predicted, 0.0)))
        if length < settings.tolerance and predicted < MERIT_ROUNDING * before:
            status = "converged"
            break
        fraction, merit = _descend(problem, path, largest, before, predicted, settings)
        if fraction == 0.0:
            problem.enter(point)
            if length < STALLED_STEP or damping > MAX_DAMPING:
                status = "converged" if length < STALLED_STEP else "stalled"
                break
            damping, refused = max(damping, settings.damping, 1.0) * INCREASE, True
            continue
        refused = False
        history.append((before, merit))
        point = path(fraction)
        little = before - merit < SLOW_DECREASE * before
        slow = slow + 1 if fraction < largest and little else 0
        if slow == SLOW_STEPS and length > SLOW_LENGTH:
            status = "stopped"
            break
        if fraction == 1.0:
            damping *= settings.decrease
            if length < settings.tolerance:
                status = "converged"
                break
        elif fraction < 0.3 * largest:
            damping = max(damping, 1.0) * np.sqrt(INCREASE)
    return Solution(point, status, found, cost, length, tuple(history))


INCREASE = 10.0  # of the damping after a refused step
STALLED_STEP = 0.1  # a step below this that no longer lowers the merit is lost in rounding [standard deviations]
SLOW_STEPS = 3  # shortened steps in a row that hardly lower the merit, after which no minimum is near
SLOW_DECREASE = 0.01  # relative, of a merit
SLOW_LENGTH = 3.0  # of the next step, below which a minimum is near [standard deviations]
MERIT_ROUNDING = 1e-10  # relative decrease of a merit that may be lost in rounding
MAX_DAMPING = 1e8  # information of a parameter known to 1e-4 of its scale


def _descend(
    problem: Problem[Point],
    path: Callable[[float], Point],
    fraction: float,
    before: float,
    predicted: float,
    settings: Settings,
) -> tuple[float, float]:
    """Return the largest tried fraction of a step that lowers the merit, with the merit there; zero if none does.

    fraction: the first to be tried.
    """
    for _ in range(settings.halvings):
        merit = problem.merit() if problem.enter(path(fraction)) else np.inf
        if merit <= before - settings.sufficient_decrease * fraction * max(predicted, 0.0):
            return fraction, merit
        bend = merit - before + fraction * predicted
        fraction *= (
            float(np.clip(0.5 * fraction * predicted / bend, 0.1, 0.5)) if np.isfinite(bend) and bend > 0 else 0.3
        )
    return 0.0, before


def limited_step(information: np.ndarray, slope: np.ndarray, rows: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Minimise a quadratic cost with information (n, n) and slope (n,) over steps p (n,) with rows @ p >= bounds.

    rows (m, n), bounds (m,), none above zero. Source: Lawson and Hanson, "Solving Least Squares Problems", 23.4 (least
    distance programming by non-negative least squares). Where that fails by rounding, the free step is shortened.
    """
    root, size = _scaled_root(information)
    target = -scipy.linalg.solve_triangular(root, slope / size, lower=True)
    free = scipy.linalg.solve_triangular(root.T, target) / size
    if (rows @ free >= bounds).all():
        return np.asarray(free)
    G = scipy.linalg.solve_triangular(root, (rows / size).T, lower=True).T
    length = np.maximum(np.linalg.norm(G, axis=1), np.finfo(float).tiny)
    G, missing = G / length[:, None], (bounds - rows @ free) / length
    with suppress(RuntimeError):  # too many iterations
        weights, _ = scipy.optimize.nnls(np.vstack([G.T, missing]), np.append(np.zeros(len(target)), 1.0))
        left = np.append(G.T @ weights, missing @ weights - 1.0)
        if left[-1] < 0:
            found = free + scipy.linalg.solve_triangular(root.T, -left[:-1] / left[-1]) / size
            if np.isfinite(found).all():
                return np.asarray(found)
    beyond = rows @ free < bounds
    return np.asarray(free * (bounds[beyond] / (rows[beyond] @ free)).min())


def inverse(information: np.ndarray) -> np.ndarray:
    """Invert an information matrix (n, n), scaled by its diagonal."""
    root, size = _scaled_root(information)
    return np.asarray(scipy.linalg.cho_solve((root, True), np.eye(len(size))) / np.outer(size, size))


def _scaled_root(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Cholesky factor (n, n) of an information matrix over its diagonal, and the roots (n,) of that.

    Negative eigenvalues are those of rounding: directions that nothing determines.
    """
    size = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information / np.outer(size, size)
    try:
        return np.linalg.cholesky(scaled), size
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
        return np.linalg.cholesky((vectors * np.maximum(values, ROUNDING)) @ vectors.T), size


ROUNDING = 1e-9  # relative error of an information matrix summed over a log
