"""The least-squares solver: where it ends is a minimum, and no step on the way raises the merit."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
import scipy

from excite.smoothing import solver
from excite.smoothing.solver import Quadratic, Settings, minimise

Function = Callable[[np.ndarray], np.ndarray]
TIGHT = Settings(passes=200, tolerance=1e-7)


def at_least(lowest: np.ndarray) -> solver.Limits:
    """Limits of a step that is nowhere below `lowest` (n,)."""
    bounded = np.isfinite(lowest)
    return np.eye(len(lowest))[bounded], lowest[bounded]


@dataclass
class Residuals:
    """Sum of squares of residuals (m,) of parameters (n,); `turned` swaps the sign of their slopes."""

    residuals: Function
    jacobian: Function
    lowest: float = -np.inf
    turned: bool = False
    point: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def enter(self, point: np.ndarray) -> bool:
        with np.errstate(invalid="ignore"):
            found = self.residuals(point)
        if not np.isfinite(found).all():
            return False
        self.point, self.found = point, found
        return True

    def quadratic(self) -> Quadratic | None:
        J = self.jacobian(self.point) * (-1 if self.turned else 1)
        if not J.any(axis=0).all():
            return None
        every = np.ones(len(self.point), bool)
        return Quadratic(
            J.T @ J, J.T @ self.found, float(self.found @ self.found), every, at_least(self.lowest - self.point), every
        )

    def weigh(self, step: np.ndarray) -> None:
        assert np.isfinite(step).all()

    def merit(self) -> float:
        return float(self.found @ self.found)

    def moved(self, step: np.ndarray) -> tuple[Callable[[float], np.ndarray], float]:
        here = self.point
        return lambda fraction: here + fraction * step, 1.0


def rosenbrock() -> Residuals:
    return Residuals(
        lambda p: np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]]), lambda p: np.array([[-20 * p[0], 10.0], [-1.0, 0.0]])
    )


def decay(seed: int, lowest: float = -np.inf) -> Residuals:
    """Two exponentials, measured with noise."""
    t = np.linspace(0, 4, 80)
    rng = np.random.default_rng(seed)
    measured = 2 * np.exp(-0.4 * t) + np.exp(-2.5 * t) + 0.02 * rng.standard_normal(len(t))

    def residuals(p: np.ndarray) -> np.ndarray:
        return np.asarray((p[0] * np.exp(-p[1] * t) + p[2] * np.exp(-p[3] * t) - measured) / 0.02)

    def jacobian(p: np.ndarray) -> np.ndarray:
        slow, fast = np.exp(-p[1] * t), np.exp(-p[3] * t)
        return np.column_stack([slow, -p[0] * t * slow, fast, -p[2] * t * fast]) / 0.02

    return Residuals(residuals, jacobian, lowest)


DECAY_START = np.array([1.0, 0.1, 3.0, 6.0])


@dataclass
class Growth:
    """Logistic growth x' = x + p x (1 - x), seen with noise, by multiple shooting.

    A point is (p, x), with x (N,) any states; their defects are constraints. Steps are those of p and the first state.
    """

    measured: np.ndarray
    noise: float
    defect: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def enter(self, point: tuple[float, np.ndarray]) -> bool:
        self.p, self.x = point
        self.defect = self.x[:-1] + self.p * self.x[:-1] * (1 - self.x[:-1]) - self.x[1:]
        return bool(np.isfinite(self.defect).all())

    def quadratic(self) -> Quadratic:
        self.slope = 1 + self.p * (1 - 2 * self.x[:-1])
        by_p = self.x[:-1] * (1 - self.x[:-1])
        self.constant, self.ways = np.zeros(len(self.x)), np.zeros((len(self.x), 2))
        self.ways[0] = 0.0, 1.0
        for k, a in enumerate(self.slope):
            self.constant[k + 1] = a * self.constant[k] + self.defect[k]
            self.ways[k + 1] = a * self.ways[k] + (by_p[k], 0.0)
        residual, J = (self.x + self.constant - self.measured) / self.noise, self.ways / self.noise
        every = np.ones(2, bool)
        return Quadratic(
            J.T @ J, J.T @ residual, float(residual @ residual), every, at_least(np.full(2, -np.inf)), every
        )

    def weigh(self, step: np.ndarray) -> None:
        pull = 2 * (self.x + self.constant + self.ways @ step - self.measured) / self.noise**2
        self.weight = np.zeros(len(self.defect))
        multiplier = 0.0
        for k in reversed(range(len(self.defect))):
            multiplier = pull[k + 1] + (self.slope[k + 1] * multiplier if k + 1 < len(self.slope) else 0.0)
            self.weight[k] = 1.5 * abs(multiplier)

    def merit(self) -> float:
        cost = np.sum((self.x - self.measured) ** 2) / self.noise**2
        return float(cost + self.weight @ np.abs(self.defect))

    def moved(self, step: np.ndarray) -> tuple[Callable[[float], tuple[float, np.ndarray]], float]:
        p, x, change = self.p, self.x, self.constant + self.ways @ step
        return lambda fraction: (p + fraction * step[0], x + fraction * change), 1.0


def grow(p: float, first: float, n: int) -> np.ndarray:
    x = [first]
    for _ in range(n - 1):
        x.append(x[-1] + p * x[-1] * (1 - x[-1]))
    return np.array(x)


def falls(history: tuple[tuple[float, float], ...]) -> bool:
    return len(history) > 0 and all(after <= before for before, after in history)


@pytest.mark.parametrize("start", [(-1.2, 1.0), (2.0, -3.0), (-5.0, 40.0)])
@pytest.mark.parametrize("damping", [0.0, 25.0])
def test_a_curved_valley_is_followed_to_its_end(start: tuple[float, float], damping: float) -> None:
    found = minimise(rosenbrock(), np.array(start), Settings(passes=200, damping=damping, tolerance=1e-7))
    assert found.status == "converged"
    np.testing.assert_allclose(found.point, [1.0, 1.0], atol=1e-6)
    assert falls(found.history)
    # Without constraints the merit is the cost: each step begins where the last one ended.
    assert [before for before, _ in found.history[1:]] == [after for _, after in found.history[:-1]]


@pytest.mark.parametrize("seed", range(5))
def test_a_misfit_that_stays_is_the_least_there_is(seed: int) -> None:
    """Against scipy's solver; the predicted cost and the covariance are those at the end."""
    problem = decay(seed)
    found = minimise(problem, DECAY_START, TIGHT)
    known = scipy.optimize.least_squares(
        problem.residuals, DECAY_START, problem.jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    covariance = np.linalg.inv(known.jac.T @ known.jac)
    assert found.status == "converged"
    assert falls(found.history)
    assert (np.abs(found.point - known.x) < 1e-4 * np.sqrt(np.diag(covariance))).all()
    assert found.cost == pytest.approx(2 * known.cost, rel=1e-9)
    assert found.quadratic is not None
    np.testing.assert_allclose(solver.inverse(found.quadratic.information), covariance, rtol=1e-3)


def test_the_end_is_within_bounds() -> None:
    """What would go below stays at its bound, beside the best of the others."""
    problem = decay(0, lowest=0.5)
    found = minimise(problem, DECAY_START.clip(0.6), TIGHT)
    known = scipy.optimize.least_squares(
        problem.residuals, DECAY_START.clip(0.6), problem.jacobian, bounds=(0.5, np.inf), xtol=1e-15, ftol=1e-15
    )
    assert falls(found.history)
    assert found.point.min() == pytest.approx(0.5, abs=1e-12)
    np.testing.assert_allclose(found.point, known.x, rtol=1e-4)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("far", [False, True], ids=["readings", "far"])
def test_multiple_shooting_ends_where_single_shooting_does(seed: int, far: bool) -> None:
    """From states that are no motion at all; in the end they are one."""
    rng, noise = np.random.default_rng(seed), 0.01
    measured = grow(0.3, 0.05, 40) + noise * rng.standard_normal(40)
    start = np.full(40, 0.9) if far else measured
    found = minimise(Growth(measured, noise), (1.5, start), TIGHT)
    known = scipy.optimize.least_squares(
        lambda x: (grow(x[0], x[1], 40) - measured) / noise, (0.3, 0.05), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert found.status == "converged"
    assert falls(found.history)
    std = np.sqrt(np.diag(np.linalg.inv(known.jac.T @ known.jac)))
    p, x = found.point
    assert (np.abs(np.array([p, x[0]]) - known.x) < 1e-3 * std).all()
    np.testing.assert_allclose(x, grow(p, x[0], 40), atol=1e-9)
    assert found.cost == pytest.approx(2 * known.cost, rel=1e-8)


@pytest.mark.parametrize("damping", [0.0, 25.0])
def test_a_step_to_where_nothing_can_be_evaluated_is_shortened(damping: float) -> None:
    problem = Residuals(lambda p: 10 * np.log(p / 0.1), lambda p: np.array([[10 / p[0]]]))
    assert not problem.enter(np.array([-1.0]))
    found = minimise(problem, np.array([5.0]), Settings(passes=100, damping=damping, tolerance=1e-6))
    assert found.status == "converged"
    assert found.point[0] == pytest.approx(0.1, rel=1e-6)
    assert falls(found.history)


def test_a_start_without_a_cost_is_out_of_range() -> None:
    start = np.array([-1.0])
    found = minimise(Residuals(np.log, lambda p: 1 / p[:, None]), start, Settings())
    assert (found.status, found.quadratic, found.history) == ("out of range", None, ())
    assert found.point is start


@pytest.mark.parametrize("passes", [1, 3])
def test_passes_that_run_out_are_no_end(passes: int) -> None:
    found = minimise(rosenbrock(), np.array([-1.2, 1.0]), Settings(passes=passes))
    assert found.status == "stalled"
    assert len(found.history) == passes
    assert found.step > Settings().tolerance


def test_where_no_step_lowers_the_merit_the_start_is_kept() -> None:
    """Slopes of the wrong sign: every step, however short, goes uphill."""
    problem, start = replace_sign(decay(0)), DECAY_START
    found = minimise(problem, start, Settings(passes=100))
    assert found.status == "stalled"
    assert found.history == ()
    np.testing.assert_array_equal(found.point, start)
    np.testing.assert_array_equal(problem.point, start)


def replace_sign(problem: Residuals) -> Residuals:
    return Residuals(problem.residuals, problem.jacobian, turned=True)


def test_a_start_that_tells_nothing_of_a_parameter_is_no_end() -> None:
    problem = Residuals(lambda p: p[:1] - 1, lambda p: np.array([[1.0, 0.0]]))
    found = minimise(problem, np.zeros(2), Settings())
    assert (found.status, found.quadratic, found.history) == ("stalled", None, ())


@pytest.mark.parametrize(
    ("limit", "settled", "status"),
    [(1e3, 0, "converged"), (20.0, 0, "stopped"), (20.0, 1, "stopped"), (20.0, 50, "converged")],
)
def test_a_cost_that_stays_too_large_stops_it(limit: float, settled: int, status: str) -> None:
    """About 80 at the end: the limit counts once the first passes are made."""
    found = minimise(decay(0), DECAY_START, Settings(passes=100, cost_limit=limit, settled=settled))
    assert found.status == status
    if status == "stopped":
        assert found.cost > limit
        assert found.step > 1.0
        assert len(found.history) == settled


def test_the_minimum_is_found_at_once_where_it_is() -> None:
    found = minimise(decay(0), minimise(decay(0), DECAY_START, TIGHT).point, Settings())
    assert found.status == "converged"
    assert len(found.history) <= 1
    assert found.step < 1e-3


@pytest.mark.parametrize("alike", [-0.9, 0.9])
def test_steps_within_bounds_are_the_best_there_are(alike: float) -> None:
    """Of two parameters that would both go below, one may go up beside the other; and one that would go up may go below
    beside another: against all four ways of holding them."""
    information = np.array([[1.0, alike, 0.1], [alike, 1.0, 0.0], [0.1, 0.0, 2.0]])
    lowest = np.array([-0.1, -0.2, -np.inf])
    for wanted in ((-10.0, -5.0, 1.0), (-1.0, 0.5, 3.0), (2.0, -3.0, 0.0)):
        slope = -information @ wanted
        best, least = np.array(wanted), np.inf
        for held in itertools.product((False, True), (False, True), (False,)):
            free = ~np.array(held)
            step = np.where(free, 0.0, lowest)
            rest = slope + information[:, ~free] @ step[~free]
            step[free] = -np.linalg.solve(information[np.ix_(free, free)], rest[free])
            cost = 2 * slope @ step + step @ information @ step
            if (step >= lowest - 1e-12).all() and cost < least:
                best, least = step, cost
        np.testing.assert_allclose(solver.limited_step(information, slope, *at_least(lowest)), best, atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_limited_steps_agree_with_scipy(seed: int) -> None:
    """Limits of combinations of parameters, whatever the units of these; scipy bounds the combinations themselves."""
    rng, n = np.random.default_rng(seed), 6
    root, slope, rows = rng.normal(size=(n, n)), 3 * rng.normal(size=n), rng.normal(size=(n, n))
    information = root @ root.T + 0.1 * np.eye(n)
    lowest = np.where(rng.uniform(size=n) < 0.3, -np.inf, -rng.uniform(0, 1, n))
    unit, limited = 10.0 ** rng.uniform(-6, 6, n), np.isfinite(lowest)
    found = solver.limited_step(
        information * np.outer(unit, unit), slope * unit, (rows * unit)[limited], lowest[limited]
    )
    back = np.linalg.inv(rows)
    turned, pull = back.T @ information @ back, back.T @ slope
    known = scipy.optimize.minimize(
        lambda y: 2 * pull @ y + y @ turned @ y,
        np.zeros(n),
        jac=lambda y: 2 * pull + 2 * turned @ y,
        bounds=[(low if np.isfinite(low) else None, None) for low in lowest],
        method="L-BFGS-B",
        options={"ftol": 1e-16, "gtol": 1e-12, "maxiter": 10000},
    )
    np.testing.assert_allclose(rows @ (found * unit), known.x, atol=1e-5 * np.abs(known.x).max())
    assert (rows @ (found * unit) >= lowest - 1e-9 * np.abs(known.x).max()).all()


def test_what_nothing_determines_has_no_small_deviation() -> None:
    """Rounding may make an information matrix indefinite: its inverse stays finite, and honest where it tells much."""
    ways = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    singular = (ways * [4.0, 1.0, 1.0, -1e-13]) @ ways.T
    variance = np.array([way @ solver.inverse(singular) @ way for way in ways.T])
    np.testing.assert_allclose(variance[:3], [0.25, 1.0, 1.0], rtol=1e-4)
    assert 1e6 < variance[3] < np.inf
    assert np.isfinite(solver.limited_step(singular, np.ones(4), np.zeros((0, 4)), np.zeros(0))).all()
