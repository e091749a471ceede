"""Excitation of arms as joint motions q(t), which position controllers follow; torques come from inverse dynamics.

An arm under gravity falls under torques alone, so its design varies the motion, linear in the coefficients c:
q_j(t) = path_j(t) + basis(t) c_j. The basis is a Fourier series or a spline; with `rest` every function of it ends at
rest, and the path leads from the start pose to the end pose. Limits on position, speed, torque, torque rate and power
are functions of the motion and its derivatives.

The program minimises the objective of the information matrix A = sum Phi' Phi over c by Ipopt. All derivatives are
exact: with G the gradient of the objective in A, d2F = H_F[dA, dA] + 2 <G, dPhi' dPhi + Phi' d2Phi>.

Dry friction turns within milliseconds at a reversal, too fast for the samples. The program smooths it over
`FRICTION_RATE`; scores and limits of the result are those of the machine file.

Source: Swevers et al., "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13, 1997 (the
Fourier series).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline

from excite.model import Model, build
from excite.model.machine import Problem, Quantity
from excite.simulation import Motion, inverse_dynamics, motion_along
from excite.trajectories import composite_objective
from excite.trajectories.collocation import MappedFunction
from excite.trajectories.composite_objective import CompositeObjective
from excite.trajectories.ipopt import OPTIONS, WARM, Evaluation, Pattern, Watch
from excite.trajectories.limits import Limit, check_limits, machine_limits, stack_limits

HARMONICS = 5  # of a Fourier series; usual in the field
SPLINE_DEGREE = 5  # torque rates are continuous; chosen
MAX_SPLINE_PIECES = 60  # of a free motion, which bounds the size of the program; chosen
FRICTION_RATE = 0.08  # rad/s or m/s over which the program smooths dry friction; chosen
OBJECTIVE_HZ = 25.0  # rate of the samples of the information in the program; chosen
LIMITS_HZ = {"fourier": 20.0, "free": 40.0}  # rate of the samples at which the program keeps limits; chosen
DENSE_PER_SAMPLE = 20  # points per sample at which limits of a result are judged; chosen
FIRST_MARGIN = 2e-3  # share of a limit's range kept free in the program, for what happens between its samples; chosen
REPAIR_FACTOR = 1.2  # further margin over the excess that it is for; chosen
LEAST_REPAIR = 1e-3  # least further margin, share of half a limit's range; chosen
MAX_MARGIN = 0.8  # largest margin, share of half a limit's range; chosen
SOLVED_EXCESS = 1e-6  # of scaled limits at which a point counts as one that keeps them; chosen
SOLVER_TOLERANCE = 1e-4  # of Ipopt; chosen
WARM_BARRIER = 1e-4  # barrier parameter of a warm start; chosen
USUAL_AMPLITUDE = 1.0  # rad or m, amplitude of a guess for a joint without limits; chosen


@dataclass(frozen=True)
class Basis:
    """Functions of time with derivatives, the same for every joint, and the path that they are added to.

    evaluate(t, order) -> (N, n_c): derivative of some order at times t (N,) [s]. start, end (n_q,): poses between which
    the path leads, at rest at both ends; None for no path.
    """

    kind: str
    duration: float
    count: int
    evaluate: Callable[[np.ndarray, int], np.ndarray]
    start: np.ndarray
    end: np.ndarray
    rest: bool

    def path(self, t: np.ndarray, order: int) -> np.ndarray:
        """Return the path (N, n_q), a polynomial of fifth order with zero speed and acceleration at both ends."""
        if not self.rest:
            return np.tile(self.start, (len(t), 1)) * (order == 0)
        rise = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
        shape = rise.deriv(order)(t / self.duration) / self.duration**order if order else rise(t / self.duration)
        return self.start * (order == 0) + np.outer(shape, self.end - self.start)


def fourier_basis(problem: Problem, start: np.ndarray, end: np.ndarray) -> Basis:
    """Return the Fourier series of HARMONICS harmonics; with `rest`, less polynomials with its values at the ends."""
    T, rest = float(problem.duration_s), problem.rest
    omega = 2 * np.pi / T * np.arange(1, HARMONICS + 1)

    def series(t: np.ndarray, order: int) -> np.ndarray:
        phase = np.outer(t, omega) + order * np.pi / 2
        waves = np.hstack([np.sin(phase), np.cos(phase)]) * np.tile(omega**order, 2)
        return waves if rest else np.hstack([np.full((len(t), 1), float(order == 0)), waves])

    powers = np.arange(6)

    def monomials(x: np.ndarray, order: int) -> np.ndarray:
        factor = np.array([np.prod(p - np.arange(order)) if order else 1.0 for p in powers])
        return factor * x[:, None] ** np.maximum(powers - order, 0) * (powers >= order)

    ends = np.array([0.0, T])
    at_ends = np.vstack([series(ends, k) * T**k for k in range(3)])
    correction = np.linalg.solve(np.vstack([monomials(ends / T, k) for k in range(3)]), at_ends)

    def evaluate(t: np.ndarray, order: int) -> np.ndarray:
        found = series(t, order)
        return found - monomials(t / T, order) @ correction / T**order if rest else found

    return Basis("fourier", T, 2 * HARMONICS + (not rest), evaluate, start, end, rest)


def spline_basis(problem: Problem, start: np.ndarray, end: np.ndarray) -> Basis:
    """Return B-splines with knots `knot_s` apart; with `rest`, those that are at rest at both ends."""
    T, rest = float(problem.duration_s), problem.rest
    pieces = min(MAX_SPLINE_PIECES, max(8, round(T / float(problem.knot_s))))
    knots = np.concatenate([np.zeros(SPLINE_DEGREE), np.linspace(0, T, pieces + 1), np.full(SPLINE_DEGREE, T)])
    count = len(knots) - SPLINE_DEGREE - 1
    kept = slice(3, count - 3) if rest else slice(0, count)
    spline = BSpline(knots, np.eye(count)[:, kept], SPLINE_DEGREE)
    by_order = [spline, *(spline.derivative(k) for k in range(1, 4))]

    def evaluate(t: np.ndarray, order: int) -> np.ndarray:
        return np.asarray(by_order[order](np.clip(t, 0, T)))

    return Basis("free", T, len(np.arange(count)[kept]), evaluate, start, end, rest)


BASES: dict[str, Callable[[Problem, np.ndarray, np.ndarray], Basis]] = {"fourier": fourier_basis, "free": spline_basis}


@dataclass(frozen=True)
class JointMotion:
    """A motion q(t) of all joints: a basis and its coefficients c (n_q, n_c)."""

    basis: Basis
    coefficients: np.ndarray

    def at(self, t: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative of the coordinates (N, n_q) at times t (N,) [s]."""
        return np.asarray(self.basis.path(t, order) + self.basis.evaluate(t, order) @ self.coefficients.T)

    def sample(self, model: Model) -> Motion:
        """Return the motion at the machine's sampling rate, with the torques of inverse dynamics."""
        rate = float(model.machine.sampling_hz)
        t = np.arange(round(self.basis.duration * rate) + 1) / rate
        return motion_along(model, t, self.at(t), self.at(t, 1), self.at(t, 2))


def between_samples(model: Model, problem: Problem, motion: JointMotion) -> dict[str, float]:
    """Return the largest excess over every limit at DENSE_PER_SAMPLE points per sample, as a fraction of its range.

    Torque rates are those over one sample's time, from any of these points on: a drive delivers torques that are linear
    between samples.
    """
    rate = float(model.machine.sampling_hz)
    count = round(motion.basis.duration * rate) * DENSE_PER_SAMPLE + 1
    t = np.linspace(0, motion.basis.duration, count)
    q, nu, a = (motion.at(t, k) for k in range(3))
    u = motion_along(model, t, q, nu, a).u
    du = (u[DENSE_PER_SAMPLE:] - u[:-DENSE_PER_SAMPLE]) * rate
    du = np.vstack([du, np.tile(du[-1:], (DENSE_PER_SAMPLE, 1))])
    limits = machine_limits(model, problem)
    if not limits:
        return {}
    values = stack_limits(model, limits)(q.T, nu.T, u.T, du.T).full()
    return {
        g.name: max(0.0, float(v.max() - g.high), float(g.low - v.min())) / g.range
        for g, v in zip(limits, values, strict=True)
    }


def all_violations(model: Model, problem: Problem, motion: JointMotion) -> dict[str, float]:
    """Return the largest excess over every limit, at the samples and between them, as a fraction of its range."""
    found = check_limits(model, problem, motion.sample(model))
    between = between_samples(model, problem, motion)
    return {name: max(x, between.get(name, 0.0)) for name, x in found.items()}


def with_smooth_friction(model: Model, least: float = FRICTION_RATE) -> Model:
    """Return the model with dry friction that turns over `least` [rad/s, m/s] at the fastest."""
    bodies = tuple(
        b
        if b.friction is None or float(b.friction.smoothing) >= least
        else b.model_copy(
            update={"friction": b.friction.model_copy(update={"smoothing": Quantity(value=least, source="definition")})}
        )
        for b in model.machine.body
    )
    smooth = build(model.machine.model_copy(update={"body": bodies}), model.fit_sensor_effects, model.fit_shapes)
    return replace(smooth, nominal=model.nominal, scale=model.scale)


class MotionProgram:
    """The nonlinear program of a joint motion: x (n_q n_c,) the coefficients, limits g scaled to -1 ... 1.

    sharpness: of the objective. margins (n_g,): share of each limit's half range that is kept free.
    """

    def __init__(self, model: Model, problem: Problem, objective: CompositeObjective, basis: Basis) -> None:
        self.basis, self.objective = basis, objective
        self.sharpness = 10.0
        self.model = model
        self.n_q, self.n_c, self.n_b = len(model.coordinates), basis.count, len(model.base.names)
        self.limits = machine_limits(model, problem)
        self.n_g = len(self.limits)
        self.margins = np.full(self.n_g, FIRST_MARGIN)
        rate, T = float(model.machine.sampling_hz), basis.duration
        n_w = round(T * min(OBJECTIVE_HZ, rate)) + 1
        self.share = (round(T * rate) + 1) / n_w  # samples of the log per sample here
        self._column_scale = objective.scale * np.sqrt(self.share)
        self._path, self._B = self._tables(np.linspace(0, T, n_w), 3)
        self.times = np.linspace(0, T, round(T * LIMITS_HZ[basis.kind]) + 1)
        self._limit_path, self._limit_B = self._tables(self.times, 4)
        self._functions()
        self._places()
        # Work space of the Hessian, which is larger than what the allocator keeps
        self._moved = np.empty((n_w, 3, self.n_b, self.n_b))
        self._pulled = np.empty((n_w, 3 * self.n_q, self.n_b, self.n_q))

    def _tables(self, t: np.ndarray, orders: int) -> tuple[np.ndarray, np.ndarray]:
        """Return path (N, orders, n_q) and basis (N, orders, n_c) with their derivatives."""
        path = np.stack([self.basis.path(t, k) for k in range(orders)], axis=1)
        return path, np.stack([self.basis.evaluate(t, k) for k in range(orders)], axis=1)

    def _functions(self) -> None:
        model, n_q = self.model, self.n_q
        q, nu, a = model.symbols()
        jerk = ca.SX.sym("j", n_q)
        W = model.regressor(q, nu, a)
        z = ca.vertcat(q, nu, a)
        C = ca.SX.sym("C", *W.shape)
        picked = ca.sum1(ca.sum2(W * C))
        N, n_b, n = len(self._path), self.n_b, 3 * n_q
        slope, bent = ca.gradient(picked, z), ca.hessian(picked, z)[0]
        self._W = _mapped([z], ca.densify(W), N, (n_b, n_q))
        self._W_slope = _mapped([z, C], ca.densify(slope), N, (n,))
        self._W_jacobian = _mapped([z], ca.densify(ca.jacobian(ca.vec(W), z)), N, (n, n_b, n_q))
        self._W_hessian = _mapped([z, C], ca.densify(bent), N, (n, n))
        u = inverse_dynamics(model)(q, nu, a, model.nominal)
        du = ca.jtimes(u, z, ca.vertcat(nu, a, jerk))
        y = ca.vertcat(z, jerk)
        centre = np.array([_centre(g) for g in self.limits])
        half = np.array([_half(g) for g in self.limits])
        values = (stack_limits(model, self.limits)(q, nu, u, du) - centre) / half if self.n_g else ca.SX(0, 1)
        multipliers = ca.SX.sym("m", self.n_g)
        slope = ca.jacobian(values, y)
        pattern = np.array(ca.DM(slope.sparsity(), 1).full(), bool).reshape(self.n_g, 4, n_q)
        self._depends: np.ndarray = np.asarray(pattern.any(axis=1))
        N, n = len(self._limit_path), 4 * n_q
        self._g = _mapped([y], ca.densify(values), N, (self.n_g,))
        self._g_jacobian = _mapped([y], ca.densify(slope), N, (n, self.n_g))
        bent = ca.densify(ca.hessian(ca.dot(multipliers, values), y)[0])
        self._g_hessian = _mapped([y, multipliers], bent, N, (n, n))

    def _places(self) -> None:
        """Lay out the sparse Jacobian: limit by joint by basis function where neither is always zero."""
        used = np.abs(self._limit_B).max(axis=1) > 0  # (N, n_c)
        k, i, j, c = np.nonzero(self._depends[None, :, :, None] & used[:, None, None, :])
        self._entries = (k, i, j, c)
        n_x = self.n_q * self.n_c
        self.sizes = (n_x, len(self.times) * self.n_g)
        self._jacobian = Pattern((self.sizes[1], n_x), k * self.n_g + i, j * self.n_c + c)
        self._upper = np.triu_indices(n_x)
        self._hessian = Pattern((n_x, n_x), *self._upper)

    @property
    def jacobian_sparsity(self) -> ca.Sparsity:
        return self._jacobian.sparsity

    @property
    def hessian_sparsity(self) -> ca.Sparsity:
        return self._hessian.sparsity

    # ------------------------------------------------------------------------------------------ objective

    def _states(self, x: np.ndarray, path: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Return q and its derivatives (N, orders n_q) at all samples."""
        return np.asarray((path + B @ x.reshape(self.n_q, self.n_c).T).reshape(len(path), -1))

    def _regressor(self, z: np.ndarray) -> np.ndarray:
        """Return W in the scale of the objective (N, n_q, n_b)."""
        (W,) = self._W(z)
        return np.asarray(W.transpose(0, 2, 1) * self._column_scale)

    def matrices(self, x: np.ndarray) -> np.ndarray:
        """Return the information matrices (n_blocks, n_b, n_b) of a full log."""
        return self._gram(self._regressor(self._states(x, self._path, self._B)))

    def _gram(self, W: np.ndarray) -> np.ndarray:
        weighted = [(W * w[:, None]).reshape(-1, self.n_b) for w in self.objective.row_weights]
        return np.stack([P.T @ P for P in weighted])

    def value(self, x: np.ndarray) -> float:
        """Return the objective, NaN where the information is singular: Ipopt then takes a shorter step."""
        found = composite_objective.score_matrices(self.objective, self.matrices(x), self.sharpness)
        return found if np.isfinite(found) else float("nan")

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return the gradient (n_x,) of the objective, NaN where the information is singular."""
        z = self._states(x, self._path, self._B)
        W = self._regressor(z)
        try:
            G = self._derivatives(self._gram(W), np.zeros((len(self.objective.row_weights), 1, self.n_b, self.n_b)))[3]
        except np.linalg.LinAlgError:
            return np.full(self.sizes[0], np.nan)
        (slope,) = self._W_slope(z, self._cotangent(W, G))
        slope = slope.reshape(-1, self.n_q)  # (3 N, n_q)
        return np.asarray((slope.T @ self._B.reshape(-1, self.n_c)).ravel())

    def _derivatives(self, A: np.ndarray, directions: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        return composite_objective.directional_derivatives(self.objective, A, directions, self.sharpness)

    def _cotangent(self, W: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return dF/dW' of the plain regressor (N, n_b, n_q)."""
        C = np.zeros_like(W)
        for w, g in zip(self.objective.row_weights, G, strict=True):
            C += 2 * w[:, None] ** 2 * (W.reshape(-1, self.n_b) @ g).reshape(W.shape)
        return np.asarray((C * self._column_scale).transpose(0, 2, 1))

    def hessian_of_objective(self, x: np.ndarray) -> np.ndarray:
        """Return the Hessian (n_x, n_x) of the objective."""
        z = self._states(x, self._path, self._B)
        W = self._regressor(z)
        n, N, n_b = 3 * self.n_q, len(W), self.n_b
        (J,) = self._W_jacobian(z)  # (N, 3 n_q, n_b, n_q), of W'
        J *= self._column_scale[:, None]
        weights = self.objective.row_weights
        directions = np.empty((len(weights), self.n_q * self.n_c, n_b, n_b))
        flat = np.ascontiguousarray(self._B.transpose(2, 0, 1)).reshape(self.n_c, -1)
        for b, w in enumerate(weights):
            right = (W * w[:, None] ** 2)[:, None]
            for j in range(self.n_q):
                moved = np.matmul(J[:, j :: self.n_q], right, out=self._moved)
                dA = (flat @ moved.reshape(N * 3, -1)).reshape(self.n_c, n_b, n_b)
                directions[b, j * self.n_c : (j + 1) * self.n_c] = dA + dA.transpose(0, 2, 1)
        _, _, H, G = self._derivatives(self._gram(W), directions)
        (local,) = self._W_hessian(z, self._cotangent(W, G))
        rows = J.reshape(N, n, -1)
        for w, g in zip(weights, G, strict=True):
            pulled = np.matmul(g, J, out=self._pulled)
            pulled *= 2 * w**2
            local += np.matmul(pulled.reshape(N, n, -1), rows.transpose(0, 2, 1))
        return np.asarray(H + self._spread(local, self._B))

    def _spread(self, local: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Return sum_k T_k' L_k T_k (n_x, n_x) of local Hessians L (N, orders n_q, orders n_q), T from basis B."""
        N, orders, n_c = B.shape
        found = np.empty((self.n_q, n_c, self.n_q, n_c))
        blocks = local.reshape(N, orders, self.n_q, orders, self.n_q)
        flat = B.reshape(N * orders, n_c)
        for i in range(self.n_q):
            for j in range(i, self.n_q):
                half = np.matmul(blocks[:, :, i, :, j], B).reshape(N * orders, n_c)
                found[i, :, j] = flat.T @ half
                found[j, :, i] = found[i, :, j].T
        return found.reshape(self.n_q * n_c, -1)

    # ------------------------------------------------------------------------------------------ limits

    def constraints(self, x: np.ndarray) -> np.ndarray:
        """Return the limits (N n_g,), scaled to -1 ... 1, at all their samples."""
        return np.asarray(self._g(self._states(x, self._limit_path, self._limit_B))[0].ravel())

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the non-zeros of the Jacobian of the limits."""
        y = self._states(x, self._limit_path, self._limit_B)
        (J,) = self._g_jacobian(y)
        J = J.reshape(len(self.times), 4, self.n_q * self.n_g).transpose(0, 2, 1)
        k, i, j, c = self._entries
        full = np.matmul(J, self._limit_B).reshape(len(self.times), self.n_q, self.n_g, self.n_c).transpose(0, 2, 1, 3)
        return self._jacobian.gather(full[k, i, j, c])

    def hessian(self, x: np.ndarray, factor: float, multipliers: np.ndarray) -> np.ndarray:
        """Return the non-zeros of the Lagrangian's Hessian on and above its diagonal."""
        found = np.zeros((self.sizes[0], self.sizes[0]))
        if factor:
            try:
                found += factor * self.hessian_of_objective(x)
            except np.linalg.LinAlgError:
                found[:] = np.nan
        if self.n_g:
            y = self._states(x, self._limit_path, self._limit_B)
            (local,) = self._g_hessian(y, multipliers.reshape(len(self.times), self.n_g))
            found += self._spread(local, self._limit_B)
        return self._hessian.gather(found[self._upper])

    def reach(self, x: np.ndarray) -> np.ndarray:
        """Return the share (n_q,) of its limits on position and speed that each joint uses; amplitude without them."""
        used = np.abs(self.constraints(x)).reshape(-1, self.n_g).max(axis=0, initial=0.0)
        found = np.zeros(self.n_q)
        for k, g in enumerate(self.limits):
            if g.kind in ("position", "rate"):
                found[self._depends[k]] = np.maximum(found[self._depends[k]], used[k])
        q = self._states(x, self._path, self._B)[:, : self.n_q]
        return np.where(found > 0, found, np.abs(q).max(axis=0) / USUAL_AMPLITUDE)

    def widen_margins(self, violations: Mapping[str, float]) -> None:
        """Add to the margins of limits that a motion exceeds; violations as fractions of their ranges."""
        over = np.array([violations.get(g.name, 0.0) * g.range / _half(g) for g in self.limits])
        more = np.where(over > 0, REPAIR_FACTOR * over + LEAST_REPAIR, 0.0)
        self.margins = np.minimum(self.margins + more, MAX_MARGIN)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds (N n_g,) of the limits."""
        low = np.array([-1.0 if np.isfinite(g.low) else -np.inf for g in self.limits]) + self.margins
        return np.tile(low, len(self.times)), np.tile(1 - self.margins, len(self.times))

    # ------------------------------------------------------------------------------------------ solve

    def solve(
        self,
        x: np.ndarray,
        should_stop: Callable[[], bool],
        max_iterations: int,
        multipliers: dict[str, Any] | None = None,
    ) -> MotionOptimum:
        """Solve from x (n_x,), warm with the multipliers of another solve. Raises nothing: see `MotionOptimum`."""
        n_x, n_g = self.sizes
        at, p, m = ("x", n_x), ("p", 0), ("lam_g", n_g)
        f, g = ("f", ca.Sparsity.dense(1, 1)), ("g", ca.Sparsity.dense(n_g, 1))
        best: list[tuple[float, np.ndarray]] = []
        low, high = self.bounds()

        def slope(x: np.ndarray, p: np.ndarray) -> tuple[float, np.ndarray]:
            value, limits = self.value(x), self.constraints(x)
            kept = bool((limits <= high + SOLVED_EXCESS).all() and (limits >= low - SOLVED_EXCESS).all())
            if kept and np.isfinite(value) and (not best or value < best[0][0]):
                best[:] = [(value, np.array(x))]
            return value, self.gradient(x)

        program = Evaluation("nlp", [at, p], [f, g], lambda x, p: (self.value(x), self.constraints(x)))
        grad_f = Evaluation("nlp_grad_f", [at, p], [f, ("grad_f_x", ca.Sparsity.dense(n_x, 1))], slope)
        jac_g = Evaluation(
            "nlp_jac_g",
            [at, p],
            [g, ("jac_g_x", self.jacobian_sparsity)],
            lambda x, p: (self.constraints(x), self.jacobian(x)),
        )
        hess_lag = Evaluation(
            "nlp_hess_l",
            [at, p, ("lam_f", 1), m],
            [("triu_hess_gamma_x_x", self.hessian_sparsity)],
            lambda x, p, factor, multipliers: (self.hessian(x, float(factor[0]), multipliers),),
        )
        watch = Watch(n_x, n_g, should_stop)
        given = {"grad_f": grad_f, "jac_g": jac_g, "hess_lag": hess_lag, "iteration_callback": watch}
        own = {"ipopt.max_iter": max_iterations, "ipopt.tol": SOLVER_TOLERANCE, "ipopt.acceptable_iter": 5}
        own |= {"ipopt.acceptable_tol": 10 * SOLVER_TOLERANCE, "ipopt.acceptable_obj_change_tol": 1e-4}
        warm = {} if multipliers is None else WARM | {"ipopt.mu_init": WARM_BARRIER}
        solver = ca.nlpsol("ipopt", "ipopt", program, OPTIONS | own | warm | given)
        found = solver(x0=x, lbg=low, ubg=high, **(multipliers or {}))
        slope(found["x"].full().ravel(), np.zeros(0))
        stats = solver.stats()
        return MotionOptimum(
            best[0][1] if best else found["x"].full().ravel(),
            bool(best),
            {"lam_x0": found["lam_x"], "lam_g0": found["lam_g"]},
            str(stats["return_status"]),
            int(stats["iter_count"]),
        )


@dataclass(frozen=True)
class MotionOptimum:
    """The best point x (n_x,) of a solve that keeps the program's limits, the last one if none does (feasible False).

    multipliers: of the last point, for `MotionProgram.solve`. status: as Ipopt names it.
    """

    x: np.ndarray
    feasible: bool
    multipliers: dict[str, Any]
    status: str
    iterations: int


def _mapped(inputs: list[ca.SX], output: ca.SX, samples: int, shape: tuple[int, ...]) -> MappedFunction:
    return MappedFunction(ca.Function("mapped", inputs, [output], {"cse": True}), samples, [shape])


def _half(g: Limit) -> float:
    return g.range / 2 if np.isfinite(g.low) else g.range


def _centre(g: Limit) -> float:
    return g.centre if np.isfinite(g.low) else 0.0
