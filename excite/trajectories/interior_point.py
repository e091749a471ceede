"""Interior-point Newton method for drives: minimise f(A(x)) under dynamics, limits and rest at both ends.

The Lagrangian's Hessian is banded in time plus F F' on the few hundred entries of the information matrix A. Node states
are eliminated interval by interval, the band by a Riccati recursion over the torque knots, and the dense part by a
bordered system (Woodbury). An exact Newton step costs about as much as the derivatives, and the inertia of its factors
tells whether it descends. The node states are solved exactly after every step. Slacks, fraction to the boundary and
filter follow Waechter and Biegler (2006).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import CollocationError
from excite.trajectories import composite_objective
from excite.trajectories.collocation import NO_BOUND, Transcription, solve_states
from excite.trajectories.composite_objective import CompositeObjective

SOFT_LIMIT_PRICE = 4.0  # price of exceeding a soft limit, per half range and node; chosen


@dataclass(frozen=True)
class Iterate:
    """Primal and dual variables: start (n_z,), states Z (K, J, n_z), torques U (K + 1, n_u), all scaled.

    slack, low, high (K, J, n_g): slacks and multipliers of the node limits. torque_* (K, n_c): of the torque limits.
    rest_* (n_e,): of rest at the end, in tolerances.
    """

    start: np.ndarray
    Z: np.ndarray
    U: np.ndarray
    slack: np.ndarray
    low: np.ndarray
    high: np.ndarray
    torque_slack: np.ndarray
    torque_low: np.ndarray
    torque_high: np.ndarray
    rest_slack: np.ndarray
    rest_low: np.ndarray
    rest_high: np.ndarray


@dataclass(frozen=True)
class BarrierLevel:
    """Settings of one barrier problem: sharpness of the objective and barrier parameter.

    decrement: expected decrease below which the level ends. iterations: the most Newton steps.
    """

    sharpness: float
    barrier: float
    decrement: float
    iterations: int


@dataclass(frozen=True)
class Subproblem:
    """The minimised function, objective (or none) plus goal_weight / 2 |U - goal|^2, and the limits' margins.

    margin (K, J, n_g), torque_margin (K, n_c): in half ranges. above, below (K, J, n_g): further margin of the upper or
    lower bound alone. soft (n_g,): limits that may be exceeded at SOFT_LIMIT_PRICE per half range, by a smooth hinge.
    """

    objective: CompositeObjective | None
    margin: np.ndarray
    torque_margin: np.ndarray
    soft: np.ndarray
    goal_weight: float = 0.0
    goal: np.ndarray | None = None
    above: np.ndarray | float = 0.0
    below: np.ndarray | float = 0.0

    @property
    def upper_distance(self) -> np.ndarray:
        """Distance (K, J, n_g) of the upper bounds from the middle; NO_BOUND for soft limits."""
        return np.where(self.soft, NO_BOUND, 1 - self.margin - self.above)

    def lower_distance(self, tr: Transcription) -> np.ndarray:
        """Distance (K, J, n_g) of the lower bounds from the middle; NO_BOUND for soft limits."""
        return np.where(self.soft, NO_BOUND, -tr.lower_bound - self.margin - self.below)


@dataclass(frozen=True)
class IterateValues:
    """Values at an iterate: limits, torque limits, rest at the end (in tolerances), entries of A, objective."""

    limits: np.ndarray
    torque_values: np.ndarray
    rest_errors: np.ndarray
    entries: np.ndarray
    objective: float


@dataclass(frozen=True)
class QuadraticModel:
    """Quadratic model in the steps r = (left state, left torque, right torque) (K, n_r) of the intervals.

    h'r + r'Q r / 2: cost of an interval. A r: the next (state, torque). |sum_k border' r|^2 / 2: curvature of the
    objective in the entries of the information matrix, border (K, n_r, n_f). slope (K, n_r): of the objective.
    terminal: quadratic cost of the final (state, torque). T, sample_step: from r to node states and node samples.
    limit_slopes: of the limits, by node sample.
    """

    Q: np.ndarray
    h: np.ndarray
    A: np.ndarray
    border: np.ndarray
    terminal: tuple[np.ndarray, np.ndarray]
    free_states: np.ndarray
    T: np.ndarray
    sample_step: np.ndarray
    limit_slopes: np.ndarray
    slope: np.ndarray
    values: IterateValues


def initial_iterate(
    tr: Transcription, task: Subproblem, start: np.ndarray, Z: np.ndarray, U: np.ndarray, barrier: float, push: float
) -> Iterate:
    """Start the iteration: slacks at least `push` inside their bounds, multipliers on the central path."""
    s = _evaluate(tr, task, start, Z, U, 1.0)
    a, b, bc = task.lower_distance(tr), task.upper_distance, 1 - task.torque_margin
    slack, torque_slack, rest_slack = (
        np.clip(s.limits, -a + push, b - push),
        np.clip(s.torque_values, -bc + push, bc - push),
        np.clip(s.rest_errors, -0.9, 0.9),
    )
    low, high, torque_low, torque_high, rest_low, rest_high = (
        barrier / x
        for x in (slack + a, b - slack, torque_slack + bc, bc - torque_slack, rest_slack + 1, 1 - rest_slack)
    )
    return Iterate(
        start, Z, U, slack, low, high, torque_slack, torque_low, torque_high, rest_slack, rest_low, rest_high
    )


def minimise(
    tr: Transcription,
    task: Subproblem,
    point: Iterate,
    levels: tuple[BarrierLevel, ...],
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[Iterate, IterateValues]:
    """Minimise a subproblem by Newton's method, through the barrier levels.

    should_stop() is asked after every iteration. Returns the last iterate and its values.
    """
    regularisation = 0.0
    for level in levels:
        mu, rejected, failures = level.barrier, list[tuple[float, float]](), 0
        for _ in range(level.iterations):
            near = _linearise(tr, task, point, level)
            found = _descent_step(near, regularisation)
            if found is None:
                return point, near.values
            dr, regularisation = found
            step, slope = _direction(tr, task, point, near, dr, mu)
            primal, dual = _step_lengths(tr, task, point, step)
            theta, merit = infeasibility(near.values, point), _barrier_merit(tr, task, point, near.values, mu)
            alpha, accepted = primal, False
            for _try in range(12):
                trial = _take_step(tr, point, step, alpha, dual)
                if trial is not None:
                    new = _evaluate(tr, task, trial.start, trial.Z, trial.U, level.sharpness)
                    theta_new, merit_new = infeasibility(new, trial), _barrier_merit(tr, task, trial, new, mu)
                    accepted = _acceptable(theta, merit, theta_new, merit_new, alpha * slope, rejected)
                    if accepted:
                        break
                alpha *= 0.5
            if slope >= 0 or theta > 1e-3:
                rejected.append((theta * (1 - 1e-5), merit - 1e-5 * theta))
            if not accepted:
                rejected.clear()
                regularisation, failures = max(1e-6, 30 * regularisation), failures + 1
                if failures > 4:
                    break
                continue
            assert trial is not None
            point = _clip_multipliers(tr, task, trial, mu)
            if should_stop():
                return point, new
            if theta_new < 1e-3 and abs(slope) < level.decrement and alpha > 0.3:
                break
    return point, _evaluate(tr, task, point.start, point.Z, point.U, levels[-1].sharpness)


def _evaluate(
    tr: Transcription, task: Subproblem, start: np.ndarray, Z: np.ndarray, U: np.ndarray, sharpness: float
) -> IterateValues:
    _, g, entries = tr.values(tr.samples(start, Z, U), tr.map_values)
    return _values(tr, task, Z, U, g, tr.weight @ entries, sharpness)


def _values(
    tr: Transcription,
    task: Subproblem,
    Z: np.ndarray,
    U: np.ndarray,
    g: np.ndarray,
    entries: np.ndarray,
    sharpness: float,
) -> IterateValues:
    f = (
        0.0
        if task.objective is None
        else composite_objective.score_matrices(task.objective, tr.matrices(entries), sharpness)
    )
    if task.goal is not None:
        f += 0.5 * task.goal_weight * float(((U - task.goal) ** 2).sum())
    torque_values = np.concatenate([U[:-1], U[1:]], axis=1) @ tr.torque_rows.T + tr.torque_centre
    return IterateValues(
        g.reshape(tr.intervals, tr.nodes, len(tr.limit_names)),
        torque_values,
        Z[-1, -1, tr.rest_states] / tr.rest_band,
        entries,
        f,
    )


def _barrier_terms(
    p: np.ndarray, a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, mu: float
) -> list[np.ndarray]:
    """Return the barrier's slope for slacks p between -a and b, and the curvature from its multipliers."""
    return [mu / (b - p) - mu / (p + a), low / (p + a) + high / (b - p)]


def _linearise(tr: Transcription, task: Subproblem, point: Iterate, level: BarrierLevel) -> QuadraticModel:
    K, J, n_z, n_u, mu = tr.intervals, tr.nodes, tr.n_z, tr.n_u, level.barrier
    n_g = point.slack.shape[2]
    n_y, n_r = n_z + n_u, n_z + 2 * n_u
    L = tr.sample_map
    outer, inner = np.r_[0:n_z, n_z * (J + 1) : n_z * (J + 1) + 2 * n_u], np.r_[n_z : n_z * (J + 1)]
    s = tr.samples(point.start, point.Z, point.U)
    _, g, a, cs, gs, entry_derivatives = tr.first_derivatives(s, tr.map_values)
    values = _values(tr, task, point.Z, point.U, g, tr.weight @ a, level.sharpness)
    slope, F = np.zeros(tr.n_a), np.zeros((tr.n_a, 0))
    if task.objective is not None:
        local = composite_objective.local_model(
            task.objective, tr.matrices(values.entries), tr.rows, tr.columns, level.sharpness
        )
        slope, F = local.slope, local.factor

    # Node states as linear functions of the interval's ends
    C = tr.interval_slopes(cs)
    CZ = C[:, :, inner]
    T = -np.linalg.solve(CZ, C[:, :, outer])
    sample_step = np.matmul(L[None, :, :, inner], T[:, None]) + L[None][:, :, :, outer]

    # Slopes and curvatures of the barriers
    force, stiffness = _barrier_terms(
        point.slack, task.lower_distance(tr), task.upper_distance, point.low, point.high, mu
    )
    bc = 1 - task.torque_margin
    torque_force, torque_stiffness = _barrier_terms(point.torque_slack, bc, bc, point.torque_low, point.torque_high, mu)
    one = np.ones_like(point.rest_slack)
    rest_force, rest_stiffness = _barrier_terms(point.rest_slack, one, one, point.rest_low, point.rest_high, mu)
    _, hinge, bend = _soft_penalty(task, values.limits, mu)

    # Hessian of the Lagrangian, with the multipliers of the dynamics from the adjoint
    counted = tr.entry_slopes(entry_derivatives, np.column_stack([slope, F])) * tr.weight[:, None, None]
    pulled = counted[:, :, 0]
    y = (point.high - point.low + hinge).reshape(K * J, n_g)
    grad = pulled + np.matmul(y[:, None], gs)[:, 0]
    lam = _adjoint(tr, CZ, T, grad.reshape(K, J, -1), (point.rest_high - point.rest_low) / tr.rest_band)
    (H,) = tr.lagrangian_hessian(
        s, tr.map_values, np.concatenate([lam.reshape(K * J, n_z), y, tr.weight[:, None] * slope], axis=1)
    )
    H += np.matmul(gs.transpose(0, 2, 1) * (stiffness + bend).reshape(K * J, 1, n_g), gs)

    # Everything in terms of the steps of the intervals
    inside = (force + stiffness * (values.limits - point.slack) + hinge).reshape(K * J, 1, n_g)
    node = pulled + np.matmul(inside, gs)[:, 0]
    flat = sample_step.reshape(K, -1, n_r)
    back = flat.transpose(0, 2, 1)
    Q = np.matmul(back, np.matmul(H.reshape(K, J, tr.n_s, tr.n_s), sample_step).reshape(K, -1, n_r))
    h = np.matmul(back, node.reshape(K, -1, 1))[:, :, 0]
    along = np.matmul(back, counted.reshape(K, J * tr.n_s, -1))
    Q[:, n_z:, n_z:] += np.matmul(tr.torque_rows.T * torque_stiffness[:, None], tr.torque_rows)
    h[:, n_z:] += (torque_force + torque_stiffness * (values.torque_values - point.torque_slack)) @ tr.torque_rows
    if task.goal is not None:
        h[:, n_y:] += task.goal_weight * (point.U - task.goal)[1:]
        Q[:, range(n_y, n_r), range(n_y, n_r)] += task.goal_weight
    A = np.zeros((K, n_y, n_r))
    A[:, :n_z] = T[:, -n_z:]
    A[:, range(n_z, n_y), range(n_y, n_r)] = 1.0
    terminal = np.zeros((n_y, n_y)), np.zeros(n_y)
    terminal[0][tr.rest_states, tr.rest_states] = rest_stiffness / tr.rest_band**2
    terminal[1][tr.rest_states] = (rest_force + rest_stiffness * (values.rest_errors - point.rest_slack)) / tr.rest_band
    return QuadraticModel(
        Q, h, A, along[:, :, 1:], terminal, tr.free_states, T, sample_step, gs, along[:, :, 0], values
    )


def _adjoint(tr: Transcription, CZ: np.ndarray, T: np.ndarray, grad: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the multipliers (K, J n_z) of the equations of motion: stationarity in the node states."""
    n_z, L = tr.n_z, tr.sample_map
    q = np.einsum("jsa,kjs->ka", L[:, :, n_z : n_z * (tr.nodes + 1)], grad)
    direct = np.einsum("jsa,kjs->ka", L[:, :, :n_z], grad) + np.matmul(q[:, None], T[:, :, :n_z])[:, 0]
    p = np.zeros(n_z)
    p[tr.rest_states] = end
    for k in range(tr.intervals - 1, -1, -1):
        q[k, -n_z:] += p
        p = direct[k] + p @ T[k, -n_z:, :n_z]
    return -np.linalg.solve(CZ.transpose(0, 2, 1), q[:, :, None])[:, :, 0]


def _descent_step(near: QuadraticModel, regularisation: float) -> tuple[np.ndarray, float] | None:
    """Return a Newton step (K, n_r) that descends and the regularisation it took; None if none does."""
    tried = 0.0 if regularisation == 0 else max(1e-10, regularisation / 3)
    for _ in range(25):
        dr = solve_newton_system(near.Q, near.h, near.A, near.border, near.terminal, near.free_states, tried)
        if dr is not None:
            return dr, tried
        tried = max(1e-8, regularisation / 3, tried * (8 if regularisation else 30))
    return None


def solve_newton_system(
    Q: np.ndarray,
    h: np.ndarray,
    A: np.ndarray,
    border: np.ndarray,
    terminal: tuple[np.ndarray, np.ndarray],
    free_states: np.ndarray,
    regularisation: float,
) -> np.ndarray | None:
    """Minimise sum_k h'r + r'Q r / 2 + |sum_k border' r|^2 / 2 + terminal over the steps r (K, n_r).

    Riccati recursion over the band; the inertia of band plus border by Sylvester's law. The last torque is fixed, and
    of the start only `free_states` move. Returns None if there is no minimum.
    """
    K, n_y, n_r = A.shape
    n_v, columns = n_r - n_y, 1 + border.shape[2]
    P, p = terminal[0], np.zeros((n_y, columns))
    p[:, 0] = terminal[1]
    gains, feeds, slopes = np.zeros((K, n_v, n_y)), np.zeros((K, n_v, columns)), np.zeros((K, n_v, columns))
    roots = np.tile(np.eye(n_v), (K, 1, 1))
    extra = regularisation * np.eye(n_v)
    sides = np.concatenate([h[:, :, None], border], axis=2)
    for k in range(K - 1, -1, -1):
        back = A[k].T
        M = back @ P @ A[k] + Q[k]
        r = back @ p + sides[k]
        P, p = M[:n_y, :n_y], r[:n_y]
        if k == K - 1:
            continue
        roots[k] = M[n_y:, n_y:] + extra
        known = np.linalg.solve(roots[k], np.concatenate([M[n_y:, :n_y], r[n_y:]], axis=1))
        gains[k], feeds[k], slopes[k] = -known[:, :n_y], -known[:, n_y:], r[n_y:]
        P = P + M[:n_y, n_y:] @ gains[k]
        P = 0.5 * (P + P.T)
        p = p + M[:n_y, n_y:] @ feeds[k]
    if not np.isfinite(P).all():
        return None
    root = P[np.ix_(free_states, free_states)] + max(regularisation, 1e-8) * np.eye(len(free_states))
    feed = -np.linalg.solve(root, p[free_states])
    negative = int((np.linalg.eigvalsh(roots) <= 0).sum() + (np.linalg.eigvalsh(root) <= 0).sum())
    S = -np.tensordot(slopes, feeds, axes=([0, 1], [0, 1])) - p[free_states].T @ feed  # sides' K^-1 sides
    B = np.eye(columns - 1) + S[1:, 1:]
    B = 0.5 * (B + B.T)
    if int((np.linalg.eigvalsh(B) <= 0).sum()) != negative:
        return None
    chosen = np.concatenate([[1.0], -np.linalg.solve(B, S[1:, 0])])
    along = feeds @ chosen
    y, dr = np.zeros(n_y), np.empty((K, n_r))
    y[free_states] = feed @ chosen
    for k in range(K):
        dr[k, :n_y] = y
        dr[k, n_y:] = gains[k] @ y + along[k]
        y = A[k] @ dr[k]
    return dr


def _direction(
    tr: Transcription, task: Subproblem, point: Iterate, near: QuadraticModel, dr: np.ndarray, mu: float
) -> tuple[Iterate, float]:
    """Return the step in every variable and the slope of the merit function along it."""
    K, J, n_y = tr.intervals, tr.nodes, tr.n_z + tr.n_u
    n_g = point.slack.shape[2]
    dU = np.vstack([np.zeros((1, tr.n_u)), dr[:, n_y:]])
    dZ = np.matmul(near.T, dr[:, :, None]).reshape(K, J, -1)
    ds = np.matmul(near.sample_step, dr[:, None, :, None]).reshape(K * J, -1, 1)
    dg = np.matmul(near.limit_slopes, ds).reshape(K, J, n_g)
    dt = dg + near.values.limits - point.slack
    dtc = np.concatenate([dU[:-1], dU[1:]], axis=1) @ tr.torque_rows.T + near.values.torque_values - point.torque_slack
    dte = dZ[-1, -1, tr.rest_states] / tr.rest_band + near.values.rest_errors - point.rest_slack
    slope = float((near.slope * dr).sum())
    slope += float((_soft_penalty(task, near.values.limits, mu)[1] * dg).sum())
    if task.goal is not None:
        slope += task.goal_weight * float(((point.U - task.goal) * dU).sum())
    duals: list[np.ndarray] = []
    for p, dp, low, high, a, b in (
        (point.slack, dt, point.low, point.high, task.lower_distance(tr), task.upper_distance),
        (point.torque_slack, dtc, point.torque_low, point.torque_high, 1 - task.torque_margin, 1 - task.torque_margin),
        (
            point.rest_slack,
            dte,
            point.rest_low,
            point.rest_high,
            np.ones_like(point.rest_slack),
            np.ones_like(point.rest_slack),
        ),
    ):
        duals += [(mu - low * dp) / (p + a) - low, (mu + high * dp) / (b - p) - high]
        slope += float(((mu / (b - p) - mu / (p + a)) * dp).sum())
    low, high, torque_low, torque_high, rest_low, rest_high = duals
    return Iterate(
        dr[0, : tr.n_z], dZ, dU, dt, low, high, dtc, torque_low, torque_high, dte, rest_low, rest_high
    ), slope


def _step_lengths(tr: Transcription, task: Subproblem, point: Iterate, step: Iterate) -> tuple[float, float]:
    """Return the longest steps of slacks and of multipliers that stay in the interior."""
    a, b, bc = task.lower_distance(tr), task.upper_distance, 1 - task.torque_margin
    slacks = (
        (point.slack + a, step.slack),
        (b - point.slack, -step.slack),
        (point.torque_slack + bc, step.torque_slack),
        (bc - point.torque_slack, -step.torque_slack),
        (point.rest_slack + 1, step.rest_slack),
        (1 - point.rest_slack, -step.rest_slack),
    )
    duals = (
        (point.low, step.low),
        (point.high, step.high),
        (point.torque_low, step.torque_low),
        (point.torque_high, step.torque_high),
        (point.rest_low, step.rest_low),
        (point.rest_high, step.rest_high),
    )
    return min(_longest_step(x, dx) for x, dx in slacks), min(_longest_step(x, dx) for x, dx in duals)


def _longest_step(x: np.ndarray, dx: np.ndarray, share: float = 0.99) -> float:
    if not x.size:
        return 1.0
    worst = float((dx / x).min())
    return 1.0 if worst >= -share else -share / worst


def _take_step(tr: Transcription, point: Iterate, step: Iterate, alpha: float, dual: float) -> Iterate | None:
    """Return the iterate after a step, its states solved; None if no motion follows the torques."""
    start, U = point.start + alpha * step.start, point.U + alpha * step.U
    try:
        Z = solve_states(tr, start, U, point.Z + alpha * step.Z)
    except CollocationError:
        return None
    return Iterate(
        start,
        Z,
        U,
        point.slack + alpha * step.slack,
        point.low + dual * step.low,
        point.high + dual * step.high,
        point.torque_slack + alpha * step.torque_slack,
        point.torque_low + dual * step.torque_low,
        point.torque_high + dual * step.torque_high,
        point.rest_slack + alpha * step.rest_slack,
        point.rest_low + dual * step.rest_low,
        point.rest_high + dual * step.rest_high,
    )


def _clip_multipliers(tr: Transcription, task: Subproblem, p: Iterate, mu: float) -> Iterate:
    """Keep the multipliers within a factor of 1e6 of the central path."""

    def near(z: np.ndarray, gap: np.ndarray) -> np.ndarray:
        return np.clip(z, 1e-6 * mu / gap, 1e6 * mu / gap)

    a, b, bc = task.lower_distance(tr), task.upper_distance, 1 - task.torque_margin
    return replace(
        p,
        low=near(p.low, p.slack + a),
        high=near(p.high, b - p.slack),
        torque_low=near(p.torque_low, p.torque_slack + bc),
        torque_high=near(p.torque_high, bc - p.torque_slack),
        rest_low=near(p.rest_low, p.rest_slack + 1),
        rest_high=near(p.rest_high, 1 - p.rest_slack),
    )


def _soft_penalty(task: Subproblem, g: np.ndarray, mu: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the price width log(1 + exp(excess / width)) of soft limits, its slope and its curvature."""
    price, slope, bend = 0.0, np.zeros_like(g), np.zeros_like(g)
    on = task.soft
    width = max(1e-3, min(0.05, 50 * mu))
    for side in (1.0, -1.0) if on.any() else ():
        x = (side * g[..., on] - 1 + task.margin[..., on]) / width
        share = 1 / (1 + np.exp(-np.clip(x, -500, 500)))
        price += SOFT_LIMIT_PRICE * width * float(np.logaddexp(0, x).sum())
        slope[..., on] += side * SOFT_LIMIT_PRICE * share
        bend[..., on] += SOFT_LIMIT_PRICE / width * share * (1 - share)
    return price, slope, bend


def infeasibility(s: IterateValues, p: Iterate) -> float:
    """Sum the distances between limits and slacks, in half ranges; inf if the objective is infinite."""
    if not np.isfinite(s.objective):
        return float("inf")
    return float(
        np.abs(s.limits - p.slack).sum()
        + np.abs(s.torque_values - p.torque_slack).sum()
        + np.abs(s.rest_errors - p.rest_slack).sum()
    )


def _barrier_merit(tr: Transcription, task: Subproblem, p: Iterate, s: IterateValues, mu: float) -> float:
    a, b, bc = task.lower_distance(tr), task.upper_distance, 1 - task.torque_margin
    inside = (p.slack + a, b - p.slack, p.torque_slack + bc, bc - p.torque_slack, p.rest_slack + 1, 1 - p.rest_slack)
    with np.errstate(divide="ignore"):  # infinite at a bound, so that no step ends there
        return s.objective + _soft_penalty(task, s.limits, mu)[0] - mu * sum(float(np.log(x).sum()) for x in inside)


def _acceptable(
    theta: float,
    merit: float,
    theta_new: float,
    merit_new: float,
    expected: float,
    rejected: list[tuple[float, float]],
) -> bool:
    """Return True if the filter accepts a step: less infeasibility or merit, and not dominated."""
    if not (np.isfinite(theta_new) and np.isfinite(merit_new)):
        return False
    if any(theta_new >= th and merit_new >= m for th, m in rejected):
        return False
    if theta < 1e-2 and expected < 0 and theta_new < 1e-2:
        return merit_new <= merit + 1e-4 * expected + 1e-12
    return theta_new <= (1 - 1e-5) * theta or merit_new <= merit - 1e-5 * theta
