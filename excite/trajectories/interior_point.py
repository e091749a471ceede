"""An interior-point Newton method made for drives: min f(A(x)) under dynamics, limits and rest at both ends.

The Lagrangian's Hessian is banded in time plus F F' on the few hundred entries of the information matrix A. Node
states are eliminated interval by interval, the band by a Riccati recursion over the torque knots, and the dense
part by a bordered system (Woodbury), so an exact Newton step costs about as much as evaluating the derivatives. The
inertia of every factor is known, hence whether the step descends. The dynamics are kept exactly: after every step
the node states are settled again. Slacks, fraction to the boundary and filter as in Waechter and Biegler (2006).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import CollocationError
from excite.trajectories import composite_objective as aims
from excite.trajectories.collocation import FAR, Transcription, settle
from excite.trajectories.composite_objective import Aim

PRICE = 4.0  # of a soft limit, per half range and node


@dataclass(frozen=True)
class Point:
    """An iterate: start (n_z,), states Z (K, J, n_z) and torques U (K + 1, n_u), scaled; slacks and multipliers.

    Slack t and multipliers low, high belong to the node limits (K, J, n_g); tc, lowc, highc to the torque limits
    (K, n_c); te, lowe, highe to rest at the end (n_e,), in bands.
    """

    start: np.ndarray
    Z: np.ndarray
    U: np.ndarray
    t: np.ndarray
    low: np.ndarray
    high: np.ndarray
    tc: np.ndarray
    lowc: np.ndarray
    highc: np.ndarray
    te: np.ndarray
    lowe: np.ndarray
    highe: np.ndarray


@dataclass(frozen=True)
class Level:
    """How sharp the objective is, how hard the barrier, and when to go on."""

    sharp: float
    barrier: float
    decrement: float
    iterations: int


@dataclass(frozen=True)
class Task:
    """What is minimised: an aim (or None) plus pull / 2 |U - goal|^2, limits moved in by `margin`.

    margin (K, J, n_g) and marginc (K, n_c), in half ranges. Limits marked `soft` (n_g,) may be exceeded on the way,
    at a price of PRICE per half range: a smooth hinge. above, below (K, J, n_g): what the upper or the lower bound
    alone is moved in by.
    """

    aim: Aim | None
    margin: np.ndarray
    marginc: np.ndarray
    soft: np.ndarray
    pull: float = 0.0
    goal: np.ndarray | None = None
    above: np.ndarray | float = 0.0
    below: np.ndarray | float = 0.0

    @property
    def wall(self) -> np.ndarray:
        """Distance (K, J, n_g) of the upper bounds from the middle; that of soft limits is far away."""
        return np.where(self.soft, FAR, 1 - self.margin - self.above)

    def floor(self, tr: Transcription) -> np.ndarray:
        """The same of the lower bounds."""
        return np.where(self.soft, FAR, -tr.floor - self.margin - self.below)


@dataclass(frozen=True)
class State:
    """Values at a point: limits g, gc, rest at the end e (in bands), entries of A, objective f."""

    g: np.ndarray
    gc: np.ndarray
    e: np.ndarray
    entries: np.ndarray
    f: float


@dataclass(frozen=True)
class Quadratic:
    """The problem around a point, in the steps r = (left state, left torque, right torque) of the intervals (K, n_r).

    h'r + r'Q r / 2 for every interval, next (state, torque) A r, entries of A move by border' r with curvature F F',
    `last`: the same for the final (state, torque). T and LT lead from r to node states and to node samples.
    """

    Q: np.ndarray
    h: np.ndarray
    A: np.ndarray
    border: np.ndarray
    F: np.ndarray
    last: tuple[np.ndarray, np.ndarray]
    loose: np.ndarray
    T: np.ndarray
    LT: np.ndarray
    limits: np.ndarray
    slope: np.ndarray
    state: State


def begin(
    tr: Transcription, task: Task, start: np.ndarray, Z: np.ndarray, U: np.ndarray, barrier: float, push: float
) -> Point:
    """An interior point from settled states: slacks pushed inside by `push`, multipliers on the central path."""
    s = _evaluate(tr, task, start, Z, U, 1.0)
    a, b, bc = task.floor(tr), task.wall, 1 - task.marginc
    t, tc, te = np.clip(s.g, -a + push, b - push), np.clip(s.gc, -bc + push, bc - push), np.clip(s.e, -0.9, 0.9)
    low, high, lowc, highc, lowe, highe = (barrier / x for x in (t + a, b - t, tc + bc, bc - tc, te + 1, 1 - te))
    return Point(start, Z, U, t, low, high, tc, lowc, highc, te, lowe, highe)


def minimise(
    tr: Transcription, task: Task, point: Point, levels: tuple[Level, ...], over: Callable[[], bool] = lambda: False
) -> tuple[Point, State]:
    """Newton's method through the levels, until there is no more time: `over` says so after an iteration."""
    regular = 0.0
    for level in levels:
        mu, blocked, failures = level.barrier, list[tuple[float, float]](), 0
        for _ in range(level.iterations):
            near = _linearise(tr, task, point, level)
            found = _descend(near, regular)
            if found is None:
                return point, near.state
            dr, regular = found
            step, slope = _direction(tr, task, point, near, dr, mu)
            primal, dual = _lengths(tr, task, point, step)
            theta, merit = infeasibility(near.state, point), _merit(tr, task, point, near.state, mu)
            alpha, accepted = primal, False
            for _try in range(12):
                trial = _move(tr, point, step, alpha, dual)
                if trial is not None:
                    new = _evaluate(tr, task, trial.start, trial.Z, trial.U, level.sharp)
                    theta_new, merit_new = infeasibility(new, trial), _merit(tr, task, trial, new, mu)
                    accepted = _acceptable(theta, merit, theta_new, merit_new, alpha * slope, blocked)
                    if accepted:
                        break
                alpha *= 0.5
            if slope >= 0 or theta > 1e-3:
                blocked.append((theta * (1 - 1e-5), merit - 1e-5 * theta))
            if not accepted:
                blocked.clear()
                regular, failures = max(1e-6, 30 * regular), failures + 1
                if failures > 4:
                    break
                continue
            assert trial is not None
            point = _safe(tr, task, trial, mu)
            if over():
                return point, new
            if theta_new < 1e-3 and abs(slope) < level.decrement and alpha > 0.3:
                break
    return point, _evaluate(tr, task, point.start, point.Z, point.U, levels[-1].sharp)


def _evaluate(tr: Transcription, task: Task, start: np.ndarray, Z: np.ndarray, U: np.ndarray, sharp: float) -> State:
    _, g, entries = tr.values(tr.samples(start, Z, U), tr.over)
    return _state(tr, task, Z, U, g, tr.weight @ entries, sharp)


def _state(
    tr: Transcription, task: Task, Z: np.ndarray, U: np.ndarray, g: np.ndarray, entries: np.ndarray, sharp: float
) -> State:
    f = 0.0 if task.aim is None else aims.value(task.aim, tr.matrices(entries), sharp)
    if task.goal is not None:
        f += 0.5 * task.pull * float(((U - task.goal) ** 2).sum())
    gc = np.concatenate([U[:-1], U[1:]], axis=1) @ tr.control.T + tr.control_centre
    return State(
        g.reshape(tr.intervals, tr.nodes, len(tr.limit_names)), gc, Z[-1, -1, tr.at_rest] / tr.band, entries, f
    )


def _pressure(
    p: np.ndarray, a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, mu: float
) -> list[np.ndarray]:
    """Slope of the barrier of slacks p between -a and b, and the curvature that their multipliers give."""
    return [mu / (b - p) - mu / (p + a), low / (p + a) + high / (b - p)]


def _linearise(tr: Transcription, task: Task, point: Point, level: Level) -> Quadratic:
    K, J, n_z, n_u, n_a, mu = tr.intervals, tr.nodes, tr.n_z, tr.n_u, tr.n_a, level.barrier
    n_g = point.t.shape[2]
    n_y, n_r = n_z + n_u, n_z + 2 * n_u
    L = tr.spread
    outer, inner = np.r_[0:n_z, n_z * (J + 1) : n_z * (J + 1) + 2 * n_u], np.r_[n_z : n_z * (J + 1)]
    s = tr.samples(point.start, point.Z, point.U)
    _, g, a, cs, gs, as_ = tr.first(s, tr.over)
    state = _state(tr, task, point.Z, point.U, g, tr.weight @ a, level.sharp)
    slope, F = np.zeros(n_a), np.zeros((n_a, 0))
    if task.aim is not None:
        local = aims.local(task.aim, tr.matrices(state.entries), tr.rows, tr.columns, level.sharp)
        slope, F = local.slope, local.factor

    # node states from the interval's ends
    C = np.matmul(cs.reshape(K, J, n_z, -1), L[None]).reshape(K, J * n_z, -1)
    CZ = C[:, :, inner]
    T = -np.linalg.solve(CZ, C[:, :, outer])
    LT = np.matmul(L[None, :, :, inner], T[:, None]) + L[None][:, :, :, outer]

    # what the limits push with, and how stiff they are
    force, sigma = _pressure(point.t, task.floor(tr), task.wall, point.low, point.high, mu)
    bc = 1 - task.marginc
    forcec, sigmac = _pressure(point.tc, bc, bc, point.lowc, point.highc, mu)
    one = np.ones_like(point.te)
    forcee, sigmae = _pressure(point.te, one, one, point.lowe, point.highe, mu)
    _, hinge, bend = _hinge(task, state.g, mu)

    # the Lagrangian's curvature, with the multipliers of the dynamics by the adjoint
    pulled = np.matmul(slope[None, None], as_)[:, 0] * tr.weight[:, None]
    y = (point.high - point.low + hinge).reshape(K * J, n_g)
    grad = pulled + np.matmul(y[:, None], gs)[:, 0]
    lam = _adjoint(tr, CZ, T, grad.reshape(K, J, -1), (point.highe - point.lowe) / tr.band)
    (H,) = tr.second(s, tr.over, np.concatenate([lam.reshape(K * J, n_z), y, tr.weight[:, None] * slope], axis=1))
    H += np.matmul(gs.transpose(0, 2, 1) * (sigma + bend).reshape(K * J, 1, n_g), gs)

    # all of it in the steps of the intervals
    inside = (force + sigma * (state.g - point.t) + hinge).reshape(K * J, 1, n_g)
    node = pulled + np.matmul(inside, gs)[:, 0]
    flat = LT.reshape(K, -1, n_r)
    back = flat.transpose(0, 2, 1)
    Q = np.matmul(back, np.matmul(H.reshape(K, J, tr.n_s, tr.n_s), LT).reshape(K, -1, n_r))
    h = np.matmul(back, node.reshape(K, -1, 1))[:, :, 0]
    counted = (as_ * tr.weight[:, None, None]).reshape(K, J, n_a, tr.n_s)
    border = np.matmul(back, counted.transpose(0, 1, 3, 2).reshape(K, J * tr.n_s, n_a))
    Q[:, n_z:, n_z:] += np.matmul(tr.control.T * sigmac[:, None], tr.control)
    h[:, n_z:] += (forcec + sigmac * (state.gc - point.tc)) @ tr.control
    if task.goal is not None:
        h[:, n_y:] += task.pull * (point.U - task.goal)[1:]
        Q[:, range(n_y, n_r), range(n_y, n_r)] += task.pull
    A = np.zeros((K, n_y, n_r))
    A[:, :n_z] = T[:, -n_z:]
    A[:, range(n_z, n_y), range(n_y, n_r)] = 1.0
    last = np.zeros((n_y, n_y)), np.zeros(n_y)
    last[0][tr.at_rest, tr.at_rest] = sigmae / tr.band**2
    last[1][tr.at_rest] = (forcee + sigmae * (state.e - point.te)) / tr.band
    return Quadratic(Q, h, A, border, F, last, tr.loose, T, LT, gs, slope, state)


def _adjoint(tr: Transcription, CZ: np.ndarray, T: np.ndarray, grad: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Multipliers (K, J n_z) of the equations of motion that make the Lagrangian stationary in the node states."""
    n_z, L = tr.n_z, tr.spread
    q = np.einsum("jsa,kjs->ka", L[:, :, n_z : n_z * (tr.nodes + 1)], grad)
    direct = np.einsum("jsa,kjs->ka", L[:, :, :n_z], grad) + np.matmul(q[:, None], T[:, :, :n_z])[:, 0]
    p = np.zeros(n_z)
    p[tr.at_rest] = end
    for k in range(tr.intervals - 1, -1, -1):
        q[k, -n_z:] += p
        p = direct[k] + p @ T[k, -n_z:, :n_z]
    return -np.linalg.solve(CZ.transpose(0, 2, 1), q[:, :, None])[:, :, 0]


def _descend(near: Quadratic, regular: float) -> tuple[np.ndarray, float] | None:
    """A Newton step (K, n_r) that descends, with as little regularisation as it takes (and how much that was)."""
    tried = 0.0 if regular == 0 else max(1e-10, regular / 3)
    for _ in range(25):
        dr = newton(near.Q, near.h, near.A, near.border, near.F, near.last, near.loose, tried)
        if dr is not None:
            return dr, tried
        tried = max(1e-8, regular / 3, tried * (8 if regular else 30))
    return None


def newton(
    Q: np.ndarray,
    h: np.ndarray,
    A: np.ndarray,
    border: np.ndarray,
    F: np.ndarray,
    last: tuple[np.ndarray, np.ndarray],
    loose: np.ndarray,
    regular: float,
) -> np.ndarray | None:
    """The minimiser (K, n_r) of sum_k h'r + r'Q r / 2 + |F' sum_k border' r|^2 / 2 + last, or None if there is none.

    Riccati recursion over the band, Sylvester's law of inertia for band plus border. The last torque stays; of the
    start, the `loose` components are free.
    """
    K, n_y, n_r = A.shape
    n_v, columns = n_r - n_y, 1 + border.shape[2]
    P, p = last[0], np.zeros((n_y, columns))
    p[:, 0] = last[1]
    gains, feeds, slopes = np.zeros((K, n_v, n_y)), np.zeros((K, n_v, columns)), np.zeros((K, n_v, columns))
    roots = np.tile(np.eye(n_v), (K, 1, 1))
    extra = regular * np.eye(n_v)
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
    root = P[np.ix_(loose, loose)] + max(regular, 1e-8) * np.eye(len(loose))
    feed = -np.linalg.solve(root, p[loose])
    negative = int((np.linalg.eigvalsh(roots) <= 0).sum() + (np.linalg.eigvalsh(root) <= 0).sum())
    S = -np.tensordot(slopes, feeds, axes=([0, 1], [0, 1])) - p[loose].T @ feed  # sides' K^-1 sides
    B = np.eye(F.shape[1]) + F.T @ S[1:, 1:] @ F
    B = 0.5 * (B + B.T)
    if int((np.linalg.eigvalsh(B) <= 0).sum()) != negative:
        return None
    chosen = np.concatenate([[1.0], -F @ np.linalg.solve(B, F.T @ S[1:, 0])])
    along = feeds @ chosen
    y, dr = np.zeros(n_y), np.empty((K, n_r))
    y[loose] = feed @ chosen
    for k in range(K):
        dr[k, :n_y] = y
        dr[k, n_y:] = gains[k] @ y + along[k]
        y = A[k] @ dr[k]
    return dr


def _direction(
    tr: Transcription, task: Task, point: Point, near: Quadratic, dr: np.ndarray, mu: float
) -> tuple[Point, float]:
    """The step in every unknown, and the slope of the merit function along it."""
    K, J, n_y = tr.intervals, tr.nodes, tr.n_z + tr.n_u
    n_g = point.t.shape[2]
    dU = np.vstack([np.zeros((1, tr.n_u)), dr[:, n_y:]])
    dZ = np.matmul(near.T, dr[:, :, None]).reshape(K, J, -1)
    ds = np.matmul(near.LT, dr[:, None, :, None]).reshape(K * J, -1, 1)
    dg = np.matmul(near.limits, ds).reshape(K, J, n_g)
    dt = dg + near.state.g - point.t
    dtc = np.concatenate([dU[:-1], dU[1:]], axis=1) @ tr.control.T + near.state.gc - point.tc
    dte = dZ[-1, -1, tr.at_rest] / tr.band + near.state.e - point.te
    slope = float(near.slope @ np.einsum("kra,kr->a", near.border, dr))
    slope += float((_hinge(task, near.state.g, mu)[1] * dg).sum())
    if task.goal is not None:
        slope += task.pull * float(((point.U - task.goal) * dU).sum())
    duals: list[np.ndarray] = []
    for p, dp, low, high, a, b in (
        (point.t, dt, point.low, point.high, task.floor(tr), task.wall),
        (point.tc, dtc, point.lowc, point.highc, 1 - task.marginc, 1 - task.marginc),
        (point.te, dte, point.lowe, point.highe, np.ones_like(point.te), np.ones_like(point.te)),
    ):
        duals += [(mu - low * dp) / (p + a) - low, (mu + high * dp) / (b - p) - high]
        slope += float(((mu / (b - p) - mu / (p + a)) * dp).sum())
    low, high, lowc, highc, lowe, highe = duals
    return Point(dr[0, : tr.n_z], dZ, dU, dt, low, high, dtc, lowc, highc, dte, lowe, highe), slope


def _lengths(tr: Transcription, task: Task, point: Point, step: Point) -> tuple[float, float]:
    """How far slacks and multipliers can go without leaving the interior."""
    a, b, bc = task.floor(tr), task.wall, 1 - task.marginc
    slacks = (
        (point.t + a, step.t),
        (b - point.t, -step.t),
        (point.tc + bc, step.tc),
        (bc - point.tc, -step.tc),
        (point.te + 1, step.te),
        (1 - point.te, -step.te),
    )
    duals = (
        (point.low, step.low),
        (point.high, step.high),
        (point.lowc, step.lowc),
        (point.highc, step.highc),
        (point.lowe, step.lowe),
        (point.highe, step.highe),
    )
    return min(_boundary(x, dx) for x, dx in slacks), min(_boundary(x, dx) for x, dx in duals)


def _boundary(x: np.ndarray, dx: np.ndarray, share: float = 0.99) -> float:
    if not x.size:
        return 1.0
    worst = float((dx / x).min())
    return 1.0 if worst >= -share else -share / worst


def _move(tr: Transcription, point: Point, step: Point, alpha: float, dual: float) -> Point | None:
    """The point after a step, its states settled; None where no motion follows the torques."""
    start, U = point.start + alpha * step.start, point.U + alpha * step.U
    try:
        Z = settle(tr, start, U, point.Z + alpha * step.Z)
    except CollocationError:
        return None
    return Point(
        start,
        Z,
        U,
        point.t + alpha * step.t,
        point.low + dual * step.low,
        point.high + dual * step.high,
        point.tc + alpha * step.tc,
        point.lowc + dual * step.lowc,
        point.highc + dual * step.highc,
        point.te + alpha * step.te,
        point.lowe + dual * step.lowe,
        point.highe + dual * step.highe,
    )


def _safe(tr: Transcription, task: Task, p: Point, mu: float) -> Point:
    """The point with its multipliers kept near the central path, at most a factor of 1e6 away."""

    def near(z: np.ndarray, gap: np.ndarray) -> np.ndarray:
        return np.clip(z, 1e-6 * mu / gap, 1e6 * mu / gap)

    a, b, bc = task.floor(tr), task.wall, 1 - task.marginc
    return replace(
        p,
        low=near(p.low, p.t + a),
        high=near(p.high, b - p.t),
        lowc=near(p.lowc, p.tc + bc),
        highc=near(p.highc, bc - p.tc),
        lowe=near(p.lowe, p.te + 1),
        highe=near(p.highe, 1 - p.te),
    )


def _hinge(task: Task, g: np.ndarray, mu: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Price of soft limits, its slope and its curvature: PRICE width log(1 + exp(excess / width)), either side."""
    price, slope, bend = 0.0, np.zeros_like(g), np.zeros_like(g)
    on = task.soft
    width = max(1e-3, min(0.05, 50 * mu))
    for side in (1.0, -1.0) if on.any() else ():
        x = (side * g[..., on] - 1 + task.margin[..., on]) / width
        share = 1 / (1 + np.exp(-np.clip(x, -500, 500)))
        price += PRICE * width * float(np.logaddexp(0, x).sum())
        slope[..., on] += side * PRICE * share
        bend[..., on] += PRICE / width * share * (1 - share)
    return price, slope, bend


def infeasibility(s: State, p: Point) -> float:
    """Sum of the distances between limits and their slacks, in half ranges; inf where the objective is."""
    if not np.isfinite(s.f):
        return float("inf")
    return float(np.abs(s.g - p.t).sum() + np.abs(s.gc - p.tc).sum() + np.abs(s.e - p.te).sum())


def _merit(tr: Transcription, task: Task, p: Point, s: State, mu: float) -> float:
    a, b, bc = task.floor(tr), task.wall, 1 - task.marginc
    inside = (p.t + a, b - p.t, p.tc + bc, bc - p.tc, p.te + 1, 1 - p.te)
    with np.errstate(divide="ignore"):  # at the edge itself it is infinite: no step goes there
        return s.f + _hinge(task, s.g, mu)[0] - mu * sum(float(np.log(x).sum()) for x in inside)


def _acceptable(
    theta: float,
    merit: float,
    theta_new: float,
    merit_new: float,
    expected: float,
    blocked: list[tuple[float, float]],
) -> bool:
    """Whether a step improves limits or merit enough, and isn't dominated by what was left before."""
    if not (np.isfinite(theta_new) and np.isfinite(merit_new)):
        return False
    if any(theta_new >= th and merit_new >= m for th, m in blocked):
        return False
    if theta < 1e-2 and expected < 0 and theta_new < 1e-2:
        return merit_new <= merit + 1e-4 * expected + 1e-12
    return theta_new <= (1 - 1e-5) * theta or merit_new <= merit - 1e-5 * theta
