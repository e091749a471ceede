"""Excitation of arms as joint motions q(t), which position controllers follow; torques come from inverse dynamics.

An arm under gravity falls under torques alone, so its design varies the motion, linear in the coefficients c:
q_j(t) = path_j(t) + basis(t) c_j. The basis is a Fourier series or a spline; with `rest` every function of it ends at
rest, and the path leads from the start pose to the end pose. Joints without a given pose have a constant as a further
function, so that the program chooses where they start. Limits on position, speed, acceleration, jerk, torque, torque
rate, power, distances and the tool are functions of the motion and its derivatives.

The program minimises the objective of the information matrix A = sum Phi' Phi over c by SLSQP. Gradients are exact:
with G the gradient of the objective in A, dF = 2 <Phi G, dPhi>.

Dry friction turns within milliseconds at a reversal, too fast for the samples. The program smooths it over
`FRICTION_RATE`; scores and limits of the result are those of the machine file.

Source: Swevers et al., "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13, 1997 (the
Fourier series).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import minimize

from excite.errors import SimulationError
from excite.model import Model, with_least_smoothing
from excite.model.machine import Problem
from excite.simulation import Motion, inverse_dynamics, motion_along, play_back
from excite.trajectories import composite_objective
from excite.trajectories.clearance import random_poses
from excite.trajectories.collocation import MappedFunction
from excite.trajectories.composite_objective import CompositeObjective
from excite.trajectories.limits import (
    Limit,
    check_limits,
    chosen_poses,
    machine_limits,
    planned_limits,
    stack_limits,
    stack_planned,
)

HARMONICS = 5  # of a Fourier series; usual in the field
SPLINE_DEGREE = 5  # torque rates are continuous; chosen
MAX_SPLINE_PIECES = 60  # of a free motion, which bounds the size of the program; chosen
FRICTION_RATE = 0.08  # rad/s or m/s over which the program smooths dry friction; chosen
OBJECTIVE_HZ = 25.0  # rate of the samples of the information in the program; chosen
LIMITS_HZ = {"fourier": 20.0, "free": 40.0}  # rate of the samples at which the program keeps limits; chosen
FORCED = ("torque", "torque_rate", "power")  # kinds of limits that another machine on the same path has of its own
DENSE_PER_SAMPLE = 20  # points per sample at which limits of a result are judged, at most; chosen
DENSE_HZ = 2000.0  # rate of these points that suffices: a tenth of a knot's time is 20 ms
FIRST_MARGIN = 4e-3  # share of a limit's range kept free in the program, for what happens between its samples; chosen
REPAIR_FACTOR = 1.2  # further margin over the excess that it is for; chosen
MAX_MARGIN = 1.0  # largest margin, share of half a limit's range: the bound is then the middle; chosen
SOLVER_TOLERANCE = 1e-6  # of SLSQP, in the objective; chosen
RESTART_GAIN = 1e-3  # gain of the objective that justifies another beginning; chosen
SINGULAR_VALUE = 1e3  # objective where no parameter set is identifiable, above any other; chosen
FOLLOWING = "following the motion"  # the limit that a motion exceeds whose simulation under a controller fails
REACH_POSES = 5000  # random poses in which a distance is looked at before it becomes a limit of the program
REACH_RESERVE = 0.5  # of the least distance, which all poses keep beyond it if it is left out; results are judged by it
USUAL_AMPLITUDE = 1.0  # rad or m, amplitude of a guess for a joint without limits; chosen


@dataclass(frozen=True)
class Basis:
    """Functions of time with derivatives, the same for every joint, and the path that they are added to.

    evaluate(t, order) -> (N, n_c): derivative of some order at times t (N,) [s]. start, end (n_q,): poses between which
    the path leads, at rest at both ends. chosen: joints whose pose is a coefficient, of a last function that is 1.
    """

    kind: str
    duration: float
    count: int
    evaluate: Callable[[np.ndarray, int], np.ndarray]
    start: np.ndarray
    end: np.ndarray
    rest: bool
    chosen: tuple[int, ...] = ()

    @property
    def free(self) -> np.ndarray:
        """Coefficients (n_q, n_c) that may differ from zero."""
        free = np.ones((len(self.start), self.count), bool)
        if self.chosen:
            free[:, -1] = np.isin(np.arange(len(self.start)), self.chosen)
        return free

    def shrunk(self, coefficients: np.ndarray, share: float) -> np.ndarray:
        """Return coefficients (n_q, n_c) of a smaller motion about the same poses."""
        moving = slice(0, self.count - bool(self.chosen))
        found = np.array(coefficients)
        found[:, moving] *= share
        return found

    def path(self, t: np.ndarray, order: int) -> np.ndarray:
        """Return the path (N, n_q), a polynomial of fifth order with zero speed and acceleration at both ends."""
        if not self.rest:
            return np.tile(self.start, (len(t), 1)) * (order == 0)
        rise = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
        shape = rise.deriv(order)(t / self.duration) / self.duration**order if order else rise(t / self.duration)
        return self.start * (order == 0) + np.outer(shape, self.end - self.start)


def motion_basis(model: Model, problem: Problem, kind: str, start: np.ndarray, end: np.ndarray) -> Basis:
    """Return the basis of a kind in BASES, with a constant if the poses at rest of some joints are to be chosen."""
    basis = BASES[kind](problem, start, end)
    chosen = chosen_poses(model, problem) if problem.rest else ()
    if not chosen:
        return basis

    def evaluate(t: np.ndarray, order: int) -> np.ndarray:
        return np.hstack([basis.evaluate(t, order), np.full((len(t), 1), float(order == 0))])

    return replace(basis, count=basis.count + 1, evaluate=evaluate, chosen=chosen)


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
    """Return B-splines with knots `knot_s` apart, further in a long drive (MAX_SPLINE_PIECES pieces at most).

    With `rest`, those that are at rest at both ends; of a periodic drive, those that go on from its end at its start.
    """
    T, rest = float(problem.duration_s), problem.rest
    pieces = min(MAX_SPLINE_PIECES, max(8, round(T / float(problem.knot_s))))
    if problem.periodic:
        return _periodic_spline(T, pieces, start, end)
    knots = np.concatenate([np.zeros(SPLINE_DEGREE), np.linspace(0, T, pieces + 1), np.full(SPLINE_DEGREE, T)])
    count = len(knots) - SPLINE_DEGREE - 1
    kept = slice(3, count - 3) if rest else slice(0, count)
    spline = BSpline(knots, np.eye(count)[:, kept], SPLINE_DEGREE)
    by_order = [spline, *(spline.derivative(k) for k in range(1, 4))]

    def evaluate(t: np.ndarray, order: int) -> np.ndarray:
        return np.asarray(by_order[order](np.clip(t, 0, T)))

    return Basis("free", T, len(np.arange(count)[kept]), evaluate, start, end, rest)


def _periodic_spline(T: float, pieces: int, start: np.ndarray, end: np.ndarray) -> Basis:
    """Return B-splines of period T [s]."""
    knots = np.arange(-SPLINE_DEGREE, pieces + SPLINE_DEGREE + 1) * (T / pieces)
    wrapped = np.eye(pieces)[np.arange(pieces + SPLINE_DEGREE) % pieces]
    spline = BSpline(knots, wrapped, SPLINE_DEGREE)
    by_order = [spline, *(spline.derivative(k) for k in range(1, 4))]

    def evaluate(t: np.ndarray, order: int) -> np.ndarray:
        return np.asarray(by_order[order](np.clip(t, 0, T)))

    return Basis("free", T, pieces, evaluate, start, end, False)


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


def between_samples(
    model: Model, problem: Problem, motion: JointMotion, kinds: Sequence[str] | None = None
) -> dict[str, float]:
    """Return the largest excess over every limit between samples, as a fraction of its range; `excess_over_time`."""
    _, excess = excess_over_time(model, problem, motion, kinds)
    return {name: float(np.abs(e).max()) for name, e in excess.items()}


def excess_over_time(
    model: Model, problem: Problem, motion: JointMotion, kinds: Sequence[str] | None = None
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return times (N,) [s] and by how much every limit is exceeded (N,), as a fraction of its range.

    Positive above the highest value, negative below the lowest. kinds: keys of LIMITS, to look at these alone; None for
    all. It is judged DENSE_PER_SAMPLE times per sample, or at DENSE_HZ if that is less.

    Torque rates are those over one sample's time, from any of these points on: a drive delivers torques that are linear
    between samples.
    """
    rate = float(model.machine.sampling_hz)
    points = min(DENSE_PER_SAMPLE, max(2, round(DENSE_HZ / rate)))
    count = round(motion.basis.duration * rate) * points + 1
    t = np.linspace(0, motion.basis.duration, count)
    q, nu, a = (motion.at(t, k) for k in range(3))
    u = motion_along(model, t, q, nu, a).u
    du = (u[points:] - u[:-points]) * rate
    du = np.vstack([du, np.tile(du[-1:], (points, 1))])
    limits, planned = machine_limits(model, problem), planned_limits(model)
    if kinds is not None:
        limits, planned = tuple(g for g in limits if g.kind in kinds), ()
    values = [
        *(stack_limits(model, limits)(q.T, nu.T, u.T, du.T).full() if limits else ()),
        *(stack_planned(model, planned)(a.T, motion.at(t, 3).T).full() if planned else ()),
    ]
    return t, {
        g.name: (np.maximum(v - g.high, 0.0) + np.minimum(v - g.low, 0.0)) / g.range
        for g, v in zip((*limits, *planned), values, strict=True)
    }


def exceeded(
    model: Model, problem: Problem, motion: JointMotion, others: Sequence[Model] = ()
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return `excess_over_time` of the model, and of the torques of other machines where theirs is larger."""
    t, found = excess_over_time(model, problem, motion)
    for other in others:
        for name, e in excess_over_time(other, problem, motion, FORCED)[1].items():
            found[name] = np.where(np.abs(e) > np.abs(found[name]), e, found[name])
    return t, found


def all_violations(
    model: Model, problem: Problem, motion: JointMotion, others: Sequence[Model] = ()
) -> dict[str, float]:
    """Return the largest excess over every limit, at the samples and between them, as a fraction of its range.

    others: machines whose torques along the motion have to keep their limits as well.
    """
    found = check_limits(model, problem, motion.sample(model))
    for excess in (
        between_samples(model, problem, motion),
        *(between_samples(m, problem, motion, FORCED) for m in others),
    ):
        found = {name: max(found.get(name, 0.0), excess.get(name, 0.0)) for name in found | excess}
    return found


def violations_as_followed(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Return the largest excess over every limit of machine and problem where a position controller follows a motion.

    As a fraction of the limit's range. Rest at the ends does not count. A motion that the controller cannot follow
    exceeds FOLLOWING without bound.
    """
    try:
        followed = play_back(model, motion.u, motion.q[0], motion.nu[0], (motion.q, motion.nu))
    except SimulationError:
        return {FOLLOWING: np.inf}
    names = {g.name for g in machine_limits(model, problem)}
    return {n: x for n, x in check_limits(model, problem, followed).items() if n in names}


def with_smooth_friction(model: Model) -> Model:
    """Return the model with dry friction that turns over `FRICTION_RATE` at the fastest."""
    return with_least_smoothing(model, dict.fromkeys((b.index for b in model.machine.body), FRICTION_RATE))


class MotionProgram:
    """The program of a joint motion in x (n_x,), its free coefficients: an objective and limits scaled to -1 ... 1.

    sharpness: of the objective's maximum. margins (2, N, n_g): share of each limit's half range that is kept free below
    its highest and above its lowest value, at every sample.
    """

    def __init__(self, model: Model, problem: Problem, objective: CompositeObjective, basis: Basis) -> None:
        self.basis, self.objective = basis, objective
        self.sharpness = 10.0
        self._valued: tuple[np.ndarray, float, float] | None = None
        self._limited: tuple[np.ndarray, np.ndarray] | None = None
        self.n_q, self.n_c, self.n_b = len(model.coordinates), basis.count, len(model.base.names)
        self._free = basis.free
        self._columns = self._free.ravel()
        machine = reachable_limits(model, machine_limits(model, problem))
        forced = tuple(g for g in machine if g.kind in FORCED)
        planned = planned_limits(model)
        others = objective.machines[1:]
        self.limits = (*machine, *forced * len(others), *planned)
        self.n_g = len(self.limits)
        rate, T = float(model.machine.sampling_hz), basis.duration
        n_w = round(T * min(OBJECTIVE_HZ, rate)) + 1
        # samples of the log per sample of the program
        self._column_scale = objective.scale * np.sqrt((round(T * rate) + 1) / n_w)
        self._path, self._B = self._tables(np.linspace(0, T, n_w), 3)
        self._limit_path, self._limit_B = self._tables(np.linspace(0, T, round(T * LIMITS_HZ[basis.kind]) + 1), 4)
        self.margins = np.full((2, len(self._limit_path), self.n_g), FIRST_MARGIN)
        self._bounded = np.array([np.isfinite(g.low) for g in self.limits], bool)
        self._functions(model, machine, [m.nominal for m in others], forced, planned)

    def _tables(self, t: np.ndarray, orders: int) -> tuple[np.ndarray, np.ndarray]:
        """Return path (N, orders, n_q) and basis (N, orders, n_c) with their derivatives."""
        path = np.stack([self.basis.path(t, k) for k in range(orders)], axis=1)
        return path, np.stack([self.basis.evaluate(t, k) for k in range(orders)], axis=1)

    def _functions(
        self,
        model: Model,
        machine: tuple[Limit, ...],
        others: Sequence[np.ndarray],
        forced: tuple[Limit, ...],
        planned: tuple[Limit, ...],
    ) -> None:
        """Build the regressor, the limits and their derivatives over all samples.

        others: base parameters (n_base,) of further machines, whose torques keep the limits `forced`.
        """
        n_q = self.n_q
        q, nu, a = model.symbols()
        jerk = ca.SX.sym("j", n_q)
        z, y = ca.vertcat(q, nu, a), ca.vertcat(q, nu, a, jerk)
        W = model.regressor(q, nu, a)
        C = ca.SX.sym("C", *W.shape)
        N = len(self._path)
        self._W = _mapped([z], W, N, (self.n_b, n_q))
        self._W_slope = _mapped([z, C], ca.gradient(ca.sum1(ca.sum2(W * C)), z), N, (3 * n_q,))
        values = []
        for X, limits in ((model.nominal, machine), *((X, forced) for X in others if forced)):
            u = inverse_dynamics(model)(q, nu, a, X)
            values.append(stack_limits(model, limits)(q, nu, u, ca.jtimes(u, z, ca.vertcat(nu, a, jerk))))
        centre, half = np.array([_centre(g) for g in self.limits]), np.array([_half(g) for g in self.limits])
        scaled = (ca.vertcat(*values, stack_planned(model, planned)(a, jerk)) - centre) / half
        pattern = np.array(ca.DM(ca.jacobian_sparsity(scaled, y), 1).full(), bool).reshape(self.n_g, 4, n_q)
        self._depends: np.ndarray = np.asarray(pattern.any(axis=1))
        N = len(self._limit_path)
        self._g = _mapped([y], scaled, N, (self.n_g,))
        sign = ca.SX.sym("sign", self.n_g)
        self._slack_slope = _mapped([y, sign], ca.jtimes(scaled, y, sign, True), max(1, 2 * self.n_g), (4 * n_q,))
        self._signs = np.vstack([-np.eye(self.n_g), np.diag(np.where(self._bounded, 1.0, 0.0))])

    @property
    def size(self) -> int:
        """Number of free coefficients."""
        return int(self._columns.sum())

    def coefficients(self, x: np.ndarray) -> np.ndarray:
        """Return all coefficients (n_q, n_c) of the free ones x (n_x,)."""
        found = np.zeros((self.n_q, self.n_c))
        found[self._free] = x
        return found

    def unknowns(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the free ones x (n_x,) of all coefficients (n_q, n_c)."""
        return np.asarray(coefficients[self._free])

    @property
    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Path (N, 3, n_q) and basis (N, 3, n_c) with their derivatives where the information is summed."""
        return self._path, self._B

    @property
    def limit_samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Path (N, 4, n_q) and basis (N, 4, n_c) with their derivatives where limits are kept."""
        return self._limit_path, self._limit_B

    def _states(self, x: np.ndarray, path: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Return q and its derivatives (N, orders n_q) at all samples."""
        return np.asarray((path + B @ self.coefficients(x).T).reshape(len(path), -1))

    # ------------------------------------------------------------------------------------------ objective

    def _regressor(self, z: np.ndarray) -> np.ndarray:
        """Return W in the scale of the objective (N, n_q, n_b)."""
        (W,) = self._W(z)
        return np.asarray(W.transpose(0, 2, 1) * self._column_scale)

    def _gram(self, W: np.ndarray) -> np.ndarray:
        weighted = [(W * w[:, None]).reshape(-1, self.n_b) for w in self.objective.row_weights]
        return np.stack([P.T @ P for P in weighted])

    def matrices(self, x: np.ndarray) -> np.ndarray:
        """Return the information matrices (n_blocks, n_b, n_b) of a full log."""
        return self._gram(self._regressor(self._states(x, self._path, self._B)))

    def value(self, x: np.ndarray) -> float:
        """Return the objective, SINGULAR_VALUE if the information is singular."""
        if self._valued is not None and self.sharpness == self._valued[1] and np.array_equal(x, self._valued[0]):
            return self._valued[2]
        found = composite_objective.score_matrices(self.objective, self.matrices(x), self.sharpness)
        return found if np.isfinite(found) else SINGULAR_VALUE

    def value_and_gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the objective and its gradient (n_x,); SINGULAR_VALUE and zero if the information is singular."""
        z = self._states(x, self._path, self._B)
        W = self._regressor(z)
        try:
            value, G = composite_objective.matrix_gradient(self.objective, self._gram(W), self.sharpness)
        except np.linalg.LinAlgError:
            return SINGULAR_VALUE, np.zeros(self.size)
        C = np.zeros_like(W)
        for w, g in zip(self.objective.row_weights, G, strict=True):
            C += 2 * w[:, None] ** 2 * (W.reshape(-1, self.n_b) @ g).reshape(W.shape)
        self._valued = np.array(x), self.sharpness, value
        (slope,) = self._W_slope(z, (C * self._column_scale).transpose(0, 2, 1))
        gradient = slope.reshape(-1, self.n_q).T @ self._B.reshape(-1, self.n_c)
        return value, self.unknowns(gradient)

    # ------------------------------------------------------------------------------------------ limits

    def limit_values(self, x: np.ndarray) -> np.ndarray:
        """Return the limits (N, n_g), scaled to -1 ... 1, at all their samples."""
        if self._limited is None or not np.array_equal(x, self._limited[0]):
            self._limited = np.array(x), self._g(self._states(x, self._limit_path, self._limit_B))[0]
        return self._limited[1]

    def slack(self, x: np.ndarray) -> np.ndarray:
        """Return what is left of every limit (2 n_g,) at its highest and lowest sample, negative where exceeded."""
        g = self.limit_values(x)
        below = np.where(self._bounded, (g + 1 - self.margins[1]).min(axis=0), 1.0)
        return np.concatenate([(1 - self.margins[0] - g).min(axis=0), below])

    def slack_jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the derivative (2 n_g, n_x) of `slack`, at the samples that are highest and lowest."""
        g = self.limit_values(x)
        sample = np.concatenate([(g + self.margins[0]).argmax(axis=0), (g - self.margins[1]).argmin(axis=0)])
        y = self._states(x, self._limit_path[sample], self._limit_B[sample])
        (slope,) = self._slack_slope(y, self._signs)
        local = slope.reshape(-1, 4, self.n_q)
        full = np.matmul(local.transpose(0, 2, 1), self._limit_B[sample]).reshape(-1, self.n_q * self.n_c)
        return np.asarray(full[:, self._columns])

    def room(self, x: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the factor (n_q,) by which each joint's motion about a pose may grow, by position and speed.

        x, pose (n_x,): the motion, and the pose alone. Without such limits a joint's amplitude is USUAL_AMPLITUDE. The
        least room is a tenth of a limit, as a joint at the end of its range can still move the other way.
        """
        base = self.limit_values(pose)
        moved = np.abs(self.limit_values(x) - base).max(axis=0)
        left = np.maximum(1 - np.abs(base).max(axis=0), 0.1)
        found = np.full(self.n_q, np.inf)
        for k, g in enumerate(self.limits):
            if g.kind in ("position", "rate"):
                on = self._depends[k]
                found[on] = np.minimum(found[on], left[k] / max(moved[k], 1e-9))
        q = self._states(x, self._limit_path, self._limit_B) - self._states(pose, self._limit_path, self._limit_B)
        usual = USUAL_AMPLITUDE / np.maximum(np.abs(q[:, : self.n_q]).max(axis=0), 1e-9)
        return np.where(np.isfinite(found), found, usual)

    def widen_margins(self, x: np.ndarray, t: np.ndarray, excess: Mapping[str, np.ndarray]) -> None:
        """Lower the bounds beside each point where x exceeds a limit, below what the program sees of it there.

        t (N,), excess: as from `excess_over_time`. Friction that turns faster than in the program, and what happens
        between its samples, is thus met where it happens.
        """
        g, last = self.limit_values(x), len(self._limit_path) - 1
        place = t / self.basis.duration * last
        beside = np.concatenate([np.floor(place), np.ceil(place)]).astype(int)
        for k, limit in enumerate(self.limits):
            over = np.tile(excess[limit.name] * limit.range / _half(limit), 2)
            for side, sign in enumerate((1.0, -1.0)):
                most = np.zeros(last + 1)
                np.maximum.at(most, beside, sign * over)
                more = np.where(most > 0, 1 - sign * g[:, k] + REPAIR_FACTOR * most + FIRST_MARGIN, 0.0)
                self.margins[side, :, k] = np.minimum(np.maximum(self.margins[side, :, k], more), MAX_MARGIN)

    # ------------------------------------------------------------------------------------------ solve

    def solve(
        self, x: np.ndarray, should_stop: Callable[[], bool], max_iterations: int, reach: float = np.inf
    ) -> MotionOptimum:
        """Minimise the objective from x (n_x,) under the limits, in so many iterations at most.

        SLSQP gives up where the highest sample of a limit changes; it then begins anew from there. reach: farthest that
        a coefficient may move before that [rad, m]. The first steps know no curvature and may leave the limits far
        behind: a motion that is near its optimum needs a small one.
        """
        best = np.inf, np.inf, np.array(x)
        latest, done = np.array(x), 0

        def keep(x: np.ndarray) -> None:
            nonlocal best, latest, done
            latest, done = np.array(x), done + 1
            over = float(np.maximum(0.0, -self.slack(latest).min(initial=0.0) - FIRST_MARGIN / 10))
            best = min(best, (over, self.value(latest), latest), key=lambda b: b[:2])
            if should_stop() or done >= max_iterations:
                raise _StopSearch

        limits = {"type": "ineq", "fun": self.slack, "jac": self.slack_jacobian}
        constraints = [limits] if self.n_g else []
        before = float("inf")
        slsqp: Any = minimize  # its types know no callback that ends it
        try:
            while True:
                latest = best[2] if np.isfinite(reach) else latest
                slsqp(
                    self.value_and_gradient,
                    latest,
                    bounds=None if np.isinf(reach) else np.column_stack([latest - reach, latest + reach]),
                    jac=True,
                    method="SLSQP",
                    constraints=constraints,
                    callback=keep,
                    options={"maxiter": max_iterations, "ftol": SOLVER_TOLERANCE},
                )
                now = best[1] if best[0] == 0 else float("inf")
                if not now < before - RESTART_GAIN:
                    break
                before = now
        except _StopSearch:
            pass
        return MotionOptimum(best[2], latest, done)


def reachable_limits(model: Model, limits: tuple[Limit, ...]) -> tuple[Limit, ...]:
    """Return the limits that a motion can come near: all but those on distances that no random pose comes near."""
    clear = [g for g in limits if g.kind == "clearance"]
    if not clear:
        return limits
    n_q, n_u = len(model.coordinates), len(model.inputs)
    poses = random_poses(model, REACH_POSES).T
    still = np.zeros((n_u, poses.shape[1]))
    nearest = stack_limits(model, clear)(poses, np.zeros((n_q, poses.shape[1])), still, still).full().max(axis=1)
    far = {g.name for g, x in zip(clear, nearest, strict=True) if x < g.high - REACH_RESERVE}
    return tuple(g for g in limits if g.name not in far)


class _StopSearch(Exception):
    """Raised in a callback to end a minimisation."""


@dataclass(frozen=True)
class MotionOptimum:
    """Result of a solve: the best point (n_x,) that keeps the limits at their samples, or nearly; and the last."""

    x: np.ndarray
    last: np.ndarray
    iterations: int


def _mapped(inputs: list[ca.SX], output: ca.SX, samples: int, shape: tuple[int, ...]) -> MappedFunction:
    return MappedFunction(ca.Function("mapped", inputs, [ca.densify(output)], {"cse": True}), samples, [shape])


def _half(g: Limit) -> float:
    return g.range / 2 if np.isfinite(g.low) else g.range


def _centre(g: Limit) -> float:
    return g.centre if np.isfinite(g.low) else 0.0
