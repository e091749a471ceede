"""An interior-point Newton method made for drives: min f(A(x)) under dynamics, limits and rest at both ends.

The Lagrangian's Hessian is banded in time plus F F' on the few hundred entries of the information matrix A. Node
states are eliminated interval by interval, the band by a Riccati recursion over the torque knots, and the dense
part by a bordered system (Woodbury), so an exact Newton step costs about as much as evaluating the derivatives. The
inertia of every factor is known, hence whether the step descends (Waechter and Biegler, 2006, for the rest: slacks,
fraction to the boundary, filter line search).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from excite import objective as scores
from excite.collocation import Transcription, UnsettledError, settle


@dataclass(frozen=True)
class Point:
    """An iterate: states Z (K, J, n_z) and torques U (K + 1, n_u), scaled; slacks and multipliers of the limits.

    t, low, high belong to the node limits (K, J, n_g); tc, lowc, highc to the torque limits (K, n_c); te, lowe, highe
    to rest at the end (n_e,), in bands.
    """

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
    """What is minimised: an objective of A (or None) plus pull / 2 |U - goal|^2, limits moved in by `margin`.

    margin (K, J, n_g) and marginc (K, n_c), in half ranges. start (n_z,): the scaled state at the beginning.
    """

    objective: str | None
    start: np.ndarray
    margin: np.ndarray
    marginc: np.ndarray
    pull: float = 0.0
    goal: np.ndarray | None = None


@dataclass(frozen=True)
class State:
    """Values at a point: defects c (K, J, n_z), limits g, gc, entries of A, rest error e, objective f."""

    c: np.ndarray
    g: np.ndarray
    gc: np.ndarray
    entries: np.ndarray
    e: np.ndarray
    f: float


@dataclass(frozen=True)
class Progress:
    iteration: int
    level: int
    objective: float
    infeasibility: float
    decrement: float
    step: float
    regular: float


def _control(tr: Transcription, U: np.ndarray) -> np.ndarray:
    return np.concatenate([U[:-1], U[1:]], axis=1) @ tr.control.T + tr.control_centre


def _state(tr: Transcription, task: Task, Z: np.ndarray, U: np.ndarray, sharp: float) -> State:
    K, J = tr.intervals, tr.nodes
    c, g, entries = tr.values(tr.samples(task.start, Z, U))
    return _collect(tr, task, Z, U, sharp, c.reshape(K, J, -1), g.reshape(K, J, -1), tr.weight @ entries)


def _collect(
    tr: Transcription,
    task: Task,
    Z: np.ndarray,
    U: np.ndarray,
    sharp: float,
    c: np.ndarray,
    g: np.ndarray,
    a: np.ndarray,
) -> State:
    f = 0.0 if task.objective is None else scores.value(task.objective, tr.matrix(a), sharp)
    if task.pull and task.goal is not None:
        f += 0.5 * task.pull * float(((U - task.goal) ** 2).sum())
    e = Z[-1, -1, tr.at_rest] / tr.band
    return State(c, g, _control(tr, U), a, e, f)


def begin(tr: Transcription, task: Task, Z: np.ndarray, U: np.ndarray, barrier: float, push: float = 0.05) -> Point:
    """An interior point from states and torques: slacks moved inside, multipliers on the central path."""
    s = _state(tr, task, Z, U, 1.0)
    b, bc = 1 - task.margin, 1 - task.marginc
    a = -tr.floor - task.margin
    t, tc = np.clip(s.g, -a + push, b - push), np.clip(s.gc, -bc + push, bc - push)
    te = np.clip(s.e, -0.9, 0.9)
    return Point(
        Z,
        U,
        t,
        barrier / (t + a),
        barrier / (b - t),
        tc,
        barrier / (tc + bc),
        barrier / (bc - tc),
        te,
        barrier / (te + 1),
        barrier / (1 - te),
    )


def minimise(
    tr: Transcription,
    task: Task,
    point: Point,
    levels: tuple[Level, ...],
    watch: Callable[[Progress, Point, State], bool] | None = None,
) -> tuple[Point, State]:
    """Newton's method through the levels. `watch` sees every iterate and stops the search by returning True."""
    K, J, n_z, n_u = tr.intervals, tr.nodes, tr.n_z, tr.n_u
    L = tr.spread()
    n_g, n_a = point.t.shape[2], len(tr.rows)
    fixed = np.r_[0:n_z, n_z * (J + 1) : n_z * (J + 1) + 2 * n_u]
    inner = np.r_[n_z : n_z * (J + 1)]
    n_y, n_r = n_z + n_u, n_z + 2 * n_u
    b, bc = 1 - task.margin, 1 - task.marginc
    a_ = -tr.floor - task.margin
    last_regular = 0.0
    iteration = 0
    state = None
    for number, level in enumerate(levels):
        mu, sharp = level.barrier, level.sharp
        filter_: list[tuple[float, float]] = []
        small = 0
        for _ in range(level.iterations):
            s = tr.samples(task.start, point.Z, point.U)
            c, g, a, cs, gs, as_ = tr.first(s)
            c = c.reshape(K, J, n_z)
            g = g.reshape(K, J, n_g)
            entries = tr.weight @ a
            state = _collect(tr, task, point.Z, point.U, sharp, c, g, entries)
            if task.objective is not None:
                local = scores.local(task.objective, tr.matrix(entries), tr.rows, tr.columns, sharp)
                slope, F = local.slope, local.factor
            else:
                slope, F = np.zeros(n_a), np.zeros((n_a, 0))
            sigma = point.low / (point.t + a_) + point.high / (b - point.t)
            sigmac = point.lowc / (point.tc + bc) + point.highc / (bc - point.tc)
            force = mu / (b - point.t) - mu / (point.t + a_)
            forcec = mu / (bc - point.tc) - mu / (point.tc + bc)

            # dynamics: node states from the interval's ends
            C = np.einsum("njas,jsw->njaw", cs.reshape(K, J, n_z, -1), L, optimize=True).reshape(K, J * n_z, -1)
            CZ = C[:, :, inner]
            right = np.concatenate([C[:, :, fixed], c.reshape(K, J * n_z, 1)], axis=2)
            solved = -np.linalg.solve(CZ, right)
            T, t0 = solved[:, :, :-1], solved[:, :, -1]
            LZ = L[:, :, inner]
            LT = np.matmul(LZ[None], T[:, None]) + L[None][:, :, :, fixed]  # (K, J, n_s, n_r)
            Lt0 = np.einsum("jsw,kw->kjs", LZ, t0)

            # multipliers of the dynamics, by the adjoint
            y = point.high - point.low
            pulled = np.einsum("nas,a->ns", as_, slope) * tr.weight[:, None]
            grad = pulled + np.einsum("ngs,ng->ns", gs, y.reshape(-1, n_g))
            lam = _adjoint(tr, L, inner, CZ, T, grad.reshape(K, J, -1), (point.highe - point.lowe) / tr.band)
            weights = np.concatenate([lam.reshape(K * J, n_z), y.reshape(-1, n_g), tr.weight[:, None] * slope], axis=1)
            (H,) = tr.second(s, weights)
            H += np.matmul(gs.transpose(0, 2, 1) * sigma.reshape(-1, 1, n_g), gs)
            H = H.reshape(K, J, tr.n_s, tr.n_s)

            inside = force + sigma * (g - point.t)
            node_grad = (pulled + np.einsum("ngs,ng->ns", gs, inside.reshape(-1, n_g))).reshape(K, J, -1)
            HLT = np.matmul(H, LT)
            flatLT = LT.reshape(K, J * tr.n_s, n_r)
            Q = np.matmul(flatLT.transpose(0, 2, 1), HLT.reshape(K, J * tr.n_s, n_r))
            linear = node_grad + np.einsum("kjab,kjb->kja", H, Lt0)
            h = np.einsum("kjsr,kjs->kr", LT, linear)
            weighted = as_ * tr.weight[:, None, None]
            border = np.matmul(
                flatLT.transpose(0, 2, 1),
                weighted.reshape(K, J, n_a, -1).transpose(0, 1, 3, 2).reshape(K, J * tr.n_s, n_a),
            )  # (K, n_r, n_a)
            border0 = np.einsum("njas,njs->a", weighted.reshape(K, J, n_a, -1), Lt0)
            insidec = forcec + sigmac * (state.gc - point.tc)
            Q[:, n_z:, n_z:] += np.einsum("ca,kc,cb->kab", tr.control, sigmac, tr.control)
            h[:, n_z:] += insidec @ tr.control
            if task.pull and task.goal is not None:
                h[:, n_y:] += task.pull * (point.U - task.goal)[1:]
                Q[:, range(n_y, n_r), range(n_y, n_r)] += task.pull

            A = np.zeros((K, n_y, n_r))
            A[:, :n_z] = T[:, -n_z:]
            A[:, range(n_z, n_y), range(n_y, n_r)] = 1.0
            offset = np.zeros((K, n_y))
            offset[:, :n_z] = t0[:, -n_z:]
            sigmae = point.lowe / (point.te + 1) + point.highe / (1 - point.te)
            forcee = mu / (1 - point.te) - mu / (point.te + 1)
            last = np.zeros((n_y, n_y)), np.zeros(n_y)
            last[0][tr.at_rest, tr.at_rest] = sigmae / tr.band**2
            last[1][tr.at_rest] = (forcee + sigmae * (state.e - point.te)) / tr.band

            # The entries of A move by border0 even where the torques stay: F' J dx = F' (J T dr + border0)
            regular = 0.0 if last_regular == 0.0 else max(1e-10, last_regular / 3)
            tries = 0
            while True:
                dr = _newton(Q, h, A, offset, border, border0, F, last, regular, n_y, n_r)
                tries += 1
                if dr is not None:
                    break
                regular = max(1e-8, last_regular / 3, regular * (8 if last_regular else 30))
                if tries > 25:
                    return point, state
            last_regular = regular
            dw = np.einsum("kar,kr->ka", T, dr) + t0
            dZ = dw.reshape(K, J, n_z)
            dU = np.vstack([np.zeros((1, n_u)), dr[:, n_y:]])
            ds = np.einsum("kjsr,kr->kjs", LT, dr) + Lt0
            dt = np.einsum("ngs,ns->ng", gs, ds.reshape(K * J, -1)).reshape(K, J, n_g) + g - point.t
            dtc = np.concatenate([dU[:-1], dU[1:]], axis=1) @ tr.control.T + state.gc - point.tc
            dte = dZ[-1, -1, tr.at_rest] / tr.band + state.e - point.te
            da = np.einsum("kra,kr->a", border, dr) + border0
            descent = float(slope @ da + (force * dt).sum() + (forcec * dtc).sum() + forcee @ dte)
            if task.pull and task.goal is not None:
                descent += task.pull * float(((point.U - task.goal) * dU).sum())

            dlow = mu / (point.t + a_) - point.low - point.low / (point.t + a_) * dt
            dhigh = mu / (b - point.t) - point.high + point.high / (b - point.t) * dt
            dlowc = mu / (point.tc + bc) - point.lowc - point.lowc / (point.tc + bc) * dtc
            dhighc = mu / (bc - point.tc) - point.highc + point.highc / (bc - point.tc) * dtc
            dlowe = mu / (point.te + 1) - point.lowe - point.lowe / (point.te + 1) * dte
            dhighe = mu / (1 - point.te) - point.highe + point.highe / (1 - point.te) * dte
            tau = max(0.99, 1 - mu)
            primal = min(_boundary(point.t + a_, dt, tau), _boundary(b - point.t, -dt, tau))
            primal = min(primal, _boundary(point.tc + bc, dtc, tau), _boundary(bc - point.tc, -dtc, tau))
            primal = min(primal, _boundary(point.te + 1, dte, tau), _boundary(1 - point.te, -dte, tau))
            dual = min(_boundary(point.low, dlow, tau), _boundary(point.high, dhigh, tau))
            dual = min(dual, _boundary(point.lowc, dlowc, tau), _boundary(point.highc, dhighc, tau))

            dual = min(dual, _boundary(point.lowe, dlowe, tau), _boundary(point.highe, dhighe, tau))
            theta = _infeasibility(state, point)
            merit = state.f + _barrier(point.t, point.tc, point.te, a_, b, bc, mu)
            alpha, accepted = primal, False
            for _try in range(14):
                U = point.U + alpha * dU
                try:
                    Z = settle(tr, task.start, U, point.Z + alpha * dZ)
                except UnsettledError:
                    alpha *= 0.5
                    continue
                t, tc, te = point.t + alpha * dt, point.tc + alpha * dtc, point.te + alpha * dte
                new = _state(tr, task, Z, U, sharp)
                trial = replace(point, Z=Z, U=U, t=t, tc=tc, te=te)
                theta_new = _infeasibility(new, trial)
                merit_new = new.f + _barrier(t, tc, te, a_, b, bc, mu)
                if _acceptable(theta, merit, theta_new, merit_new, alpha, descent, filter_):
                    accepted = True
                    break
                alpha *= 0.5
            if descent >= 0 or theta > 1e-3:
                filter_.append((theta * (1 - 1e-5), merit - 1e-5 * theta))
            if not accepted:
                filter_.clear()
                last_regular = max(1e-6, 30 * max(last_regular, regular))
                small += 1
                if small > 6:
                    break
                if small < 3:
                    continue
            low = _safe(point.low + dual * dlow, t + a_, mu)
            high = _safe(point.high + dual * dhigh, b - t, mu)
            lowc = _safe(point.lowc + dual * dlowc, tc + bc, mu)
            highc = _safe(point.highc + dual * dhighc, bc - tc, mu)
            lowe = _safe(point.lowe + dual * dlowe, te + 1, mu)
            highe = _safe(point.highe + dual * dhighe, 1 - te, mu)
            point = Point(Z, U, t, low, high, tc, lowc, highc, te, lowe, highe)
            iteration += 1
            seen = Progress(iteration, number, new.f, theta_new, descent, alpha, regular)
            if watch is not None and watch(seen, point, new):
                return point, new
            if theta_new < 1e-3 and abs(descent) < level.decrement and alpha > 0.3:
                break
    assert state is not None
    return point, _state(tr, task, point.Z, point.U, levels[-1].sharp)


def _newton(
    Q: np.ndarray,
    h: np.ndarray,
    A: np.ndarray,
    offset: np.ndarray,
    border: np.ndarray,
    border0: np.ndarray,
    F: np.ndarray,
    last: tuple[np.ndarray, np.ndarray],
    regular: float,
    n_y: int,
    n_r: int,
) -> np.ndarray | None:
    """The Newton step (K, n_r), or None where the reduced Hessian isn't positive."""
    K, n_a = len(Q), border.shape[2]
    n_v = n_r - n_y
    columns = 1 + n_a
    P, p = last[0], np.zeros((n_y, columns))
    p[:, 0] = last[1]
    gains = np.zeros((K, n_v, n_y))
    roots = np.tile(np.eye(n_v), (K, 1, 1))
    feeds = np.zeros((K, n_v, columns))
    slopes = np.zeros((K, n_v, columns))
    extra = regular * np.eye(n_v)
    for k in range(K - 1, -1, -1):
        Ak = A[k]
        M = Ak.T @ (P @ Ak)
        M += Q[k]
        push = p.copy()
        push[:, 0] += P @ offset[k]
        r = Ak.T @ push
        r[:, 0] += h[k]
        r[:, 1:] += border[k]
        if k == K - 1:  # the last torque is zero
            P, p = M[:n_y, :n_y], r[:n_y]
            continue
        R = M[n_y:, n_y:] + extra
        inverse = np.linalg.inv(R)
        gain = -inverse @ M[n_y:, :n_y]
        feed = -inverse @ r[n_y:]
        P = M[:n_y, :n_y] + M[:n_y, n_y:] @ gain
        P = 0.5 * (P + P.T)
        p = r[:n_y] + M[:n_y, n_y:] @ feed
        gains[k], roots[k], feeds[k], slopes[k] = gain, R, feed, r[n_y:]
    if not np.isfinite(P).all():
        return None
    negative = int((np.linalg.eigvalsh(roots) <= 0).sum())
    S = -np.tensordot(slopes[:, :, 1:], feeds[:, :, 1:], axes=([0, 1], [0, 1]))  # J K^-1 J'
    B = np.eye(F.shape[1]) + F.T @ S @ F
    if int((np.linalg.eigvalsh(0.5 * (B + B.T)) <= 0).sum()) != negative:
        return None
    dr = _forward(A, offset, gains, feeds[:, :, 0])
    moved = np.einsum("kra,kr->a", border, dr) + border0
    alpha = F @ np.linalg.solve(B, F.T @ moved)
    return _forward(A, offset, gains, feeds[:, :, 0] + feeds[:, :, 1:] @ alpha)


def _forward(A: np.ndarray, offset: np.ndarray, gains: np.ndarray, feed: np.ndarray) -> np.ndarray:
    """Steps (K, n_r) of (left state, left torque, right torque) under the feedback from the start."""
    K, n_y = offset.shape
    y = np.zeros(n_y)
    dr = np.empty((K, A.shape[2]))
    for k in range(K):
        dr[k, :n_y] = y
        dr[k, n_y:] = gains[k] @ y + feed[k]
        y = A[k] @ dr[k] + offset[k]
    return dr


def _adjoint(
    tr: Transcription,
    L: np.ndarray,
    inner: np.ndarray,
    CZ: np.ndarray,
    T: np.ndarray,
    grad: np.ndarray,
    end: np.ndarray,
) -> np.ndarray:
    """Multipliers (K, J n_z) of the equations of motion that make the Lagrangian stationary in the node states."""
    K, n_z = tr.intervals, tr.n_z
    by_z = np.einsum("jsa,kjs->ka", L[:, :, :n_z], grad)
    by_inner = np.einsum("jsa,kjs->ka", L[:, :, inner], grad)
    direct = by_z + np.einsum("kar,ka->kr", T[:, :, :n_z], by_inner)
    p = np.zeros(n_z)
    p[tr.at_rest] = end[: len(tr.at_rest)]
    q = by_inner.copy()
    for k in range(K - 1, -1, -1):
        q[k, -n_z:] += p
        p = direct[k] + T[k, -n_z:, :n_z].T @ p
    return -np.linalg.solve(CZ.transpose(0, 2, 1), q[:, :, None])[:, :, 0]


def _boundary(x: np.ndarray, dx: np.ndarray, tau: float) -> float:
    if not x.size:
        return 1.0
    worst = float((dx / x).min())
    return 1.0 if worst >= -tau else -tau / worst


def _safe(z: np.ndarray, gap: np.ndarray, mu: float) -> np.ndarray:
    return np.clip(z, mu / (1e6 * gap), 1e6 * mu / gap)


def _infeasibility(s: State, p: Point) -> float:
    if not np.isfinite(s.f):
        return float("inf")
    return float(np.abs(s.c).sum() + np.abs(s.g - p.t).sum() + np.abs(s.gc - p.tc).sum() + np.abs(s.e - p.te).sum())


def _barrier(
    t: np.ndarray, tc: np.ndarray, te: np.ndarray, a: np.ndarray, b: np.ndarray, bc: np.ndarray, mu: float
) -> float:
    inside = np.log(t + a).sum() + np.log(b - t).sum() + np.log(tc + bc).sum() + np.log(bc - tc).sum()
    inside += np.log(te + 1).sum() + np.log(1 - te).sum()
    return float(-mu * inside)


def _acceptable(
    theta: float,
    merit: float,
    theta_new: float,
    merit_new: float,
    alpha: float,
    descent: float,
    filter_: list[tuple[float, float]],
) -> bool:
    if not (np.isfinite(theta_new) and np.isfinite(merit_new)):
        return False
    if any(theta_new >= th and merit_new >= m for th, m in filter_):
        return False
    if theta < 1e-2 and descent < 0 and theta_new < 1e-2:
        return merit_new <= merit + 1e-4 * alpha * descent + 1e-12
    return theta_new <= (1 - 1e-5) * theta or merit_new <= merit - 1e-5 * theta
