"""Output error: the log's torques simulated, the parameters fitted to what the sensors read.

The log is cut into stretches, each with a free first state: torque noise then has little time to build up, and a poor
guess of the parameters can't run away. Gauss-Newton with exact sensitivities. Source: Ljung, "System Identification",
2nd ed., 1999, ch. 7 and 10; stretches as in Bock's multiple shooting, without asking them to meet.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from excite.errors import NotIdentifiableError, SimulationError
from excite.identification.estimate import Estimate
from excite.identification.least_squares import Triangle, merge, solve
from excite.identification.linear_methods import build_estimate, filtered_blocks, solve_blocks
from excite.logs import Log, lowpass, samples, white_noise
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import simulate
from excite.smoothing import StateSpace, build_state_space

SEGMENT_DURATION = 5.0  # between two fresh starts [s]
INITIAL_STATE_STD = 0.02  # of a first state in one pass [rad, m/s, rad/s]: what no reading shows must not run away
SUBINTERVALS = 4  # of a sample, for the slopes
MAX_PASSES = 20  # of Gauss-Newton, at most
CONVERGED_STEP = 0.02  # a step this small against the standard deviation ends it
# What ends it where friction that sticks makes steps jump about: the smallest step of all passes, if it is so small.
ACCEPTABLE_STEP = 0.1
MAX_HALVINGS = 8  # times that a step is halved where the machine it leads to can't be simulated
MAX_RELATIVE_STEP = 0.5  # step of a parameter in one pass, relative to its scale


@dataclass(frozen=True)
class Segment:
    """A piece of a log: torque (L, n_u) as measured, reading (L, m), start (n,) of the chart's states."""

    torque: np.ndarray
    reading: np.ndarray
    start: np.ndarray


@dataclass(frozen=True)
class SegmentResponse:
    """A stretch simulated: residual (L, m); slopes of the readings by start and parameters (L, m, n + n_base); and,
    for what noise does, H (L, m, n) by the states, A (L - 1, n, n), B (L - 1, n, n_u) from sample to sample."""

    residual: np.ndarray
    slope: np.ndarray
    H: np.ndarray
    A: np.ndarray
    B: np.ndarray


def oe(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Output error, from the machine file's values; every sensor weighted by its residual level.

    Deviations: torque noise as found in the log, carried through the dynamics, and the sensors' noise and counts;
    larger where the residuals are larger than these explain. Raises NotIdentifiable where Gauss-Newton finds no end.
    """
    common = set.intersection(*(set(log.values) for log in logs))
    names = tuple(s.name for s in model.machine.sensors("full") if s.name in common)
    space = build_state_space(model, names)
    pieces = [p for log in logs for p in _cut_into_segments(space, log, filter)]
    torque_noise = _torque_noise(model, logs)
    sensor_noise = np.array([_sensor_noise(s.resolution, [log.values[s.name] for log in logs]) for s in space.sensors])
    blocks = filtered_blocks(model, logs, filter)
    kept = list(solve_blocks(blocks, model.scale).kept)
    x, level = model.nominal.copy(), sensor_noise
    runs = _simulate_segments(space, pieces, x)
    if runs is None:
        raise NotIdentifiableError(
            "oe: the machine file's values give no motion along this log; check masses and inertias"
        )
    nearest = np.inf, x, runs
    for _ in range(MAX_PASSES):
        step, starts, covariance = _gauss_newton_step(runs, level, torque_noise, sensor_noise, kept)
        limit = MAX_RELATIVE_STEP * np.maximum(model.scale, np.abs(x))
        share = min(1.0, float((limit[kept] / np.maximum(np.abs(step[kept]), 1e-300)).min()))
        for _ in range(MAX_HALVINGS):
            moved = [Segment(p.torque, p.reading, p.start + share * d) for p, d in zip(pieces, starts, strict=True)]
            ahead = _simulate_segments(space, moved, x + share * step)
            if ahead is not None and _cost(ahead, level) < 1.001 * _cost(runs, level):
                break
            share /= 2
        else:
            raise NotIdentifiableError(
                "oe: no step makes the fit better, and it is none yet; start from better values in the machine file, or"
                " use another method"
            )
        pieces, runs, x = moved, ahead, x + share * step
        level = np.maximum(np.sqrt(_mean_square_residual(runs)), sensor_noise)
        left = float((np.abs(step[kept]) / np.sqrt(np.diag(covariance))).max())
        nearest = min(nearest, (left, x, runs), key=lambda one: one[0])
        if left < CONVERGED_STEP:
            break
    left, x, runs = nearest
    if left > ACCEPTABLE_STEP:
        raise NotIdentifiableError(
            f"oe: no end after {MAX_PASSES} passes (the smallest step is {left:.2g} standard deviations); start from"
            " better values in the machine file, or use another method"
        )
    level = np.maximum(np.sqrt(_mean_square_residual(runs)), sensor_noise)
    _, _, covariance = _gauss_newton_step(runs, level, torque_noise, sensor_noise, kept)
    return _build_estimate(model, blocks, x, covariance, len(pieces))


def _build_estimate(
    model: Model, blocks: Sequence[tuple[np.ndarray, np.ndarray]], x: np.ndarray, covariance: np.ndarray, pieces: int
) -> Estimate:
    solution = solve_blocks(blocks, model.scale)
    note = f"oe: {pieces} stretches of {SEGMENT_DURATION:g} s, each from a state of its own"
    return build_estimate(model, blocks, solution, "oe", x, covariance, solution.degrees, (note,))


def _cut_into_segments(space: StateSpace, log: Log, filter: Filter) -> list[Segment]:
    model, machine = space.model, space.model.machine
    rate, n_q = float(machine.sampling_hz), len(space.model.coordinates)
    s = samples(model, log, filter)
    wheels = [x.name for x in machine.sensor if x.kind == "wheel"]
    rolled = [lowpass(log.values[w], rate, filter) if w in log.values else np.zeros(len(log)) for w in wheels]
    state = np.concatenate([s.q, s.nu, np.reshape(rolled, (len(wheels), len(log)))])[space.index].T
    torque = s.Y[list(model.actuated)].T
    reading = np.column_stack([log.values[x.name] for x in space.sensors])
    first, last = filter.drop[0], len(log) - filter.drop[1]
    count = max(1, round((last - first) / (SEGMENT_DURATION * rate)))
    edges = np.linspace(first, last, count + 1).astype(int)
    assert space.full_size == 2 * n_q + len(wheels)
    return [Segment(torque[a:b], reading[a:b], state[a]) for a, b in itertools.pairwise(edges)]


def _torque_noise(model: Model, logs: Sequence[Log]) -> np.ndarray:
    """Level (n_u,) of the white noise on the torques."""
    names = [
        next(s.name for s in model.machine.sensor if s.kind == "torque" and s.body == b.index)
        for b in model.machine.actuated
    ]
    return np.array([np.sqrt(np.mean([white_noise(log.values[n]) ** 2 for log in logs])) for n in names])


def _sensor_noise(step: float | None, values: Sequence[np.ndarray]) -> float:
    found = float(np.sqrt(np.mean([white_noise(v) ** 2 for v in values])))
    return max(step / np.sqrt(12) if step is not None else found, 1e-9 * max(float(np.abs(v).max()) for v in values))


def _simulate_segments(space: StateSpace, pieces: Sequence[Segment], x: np.ndarray) -> list[SegmentResponse] | None:
    """Every stretch at the parameters x (n_base,); None where a motion can't be integrated."""
    try:
        runs = [_simulate_segment(space, p, x) for p in pieces]
    except SimulationError:
        return None
    return runs if all(np.isfinite(r.residual).all() and np.isfinite(r.slope).all() for r in runs) else None


def _simulate_segment(space: StateSpace, p: Segment, x: np.ndarray) -> SegmentResponse:
    n_q, n, n_p = len(space.model.coordinates), space.n, len(x)
    u = p.torque - x @ space.torque_offsets.T
    full = np.zeros(space.full_size)
    full[space.index] = p.start
    motion = simulate(space.model, u, x, full[:n_q], full[n_q : 2 * n_q])
    s = np.hstack([motion.q, motion.nu, motion.wheels + full[2 * n_q :]])[:, space.index]
    rate = np.hstack([motion.nu, motion.a, np.zeros_like(motion.wheels)])[:, space.index]
    h, H, *_ = space.readings(s, u, x)
    A, B, X = _transition_jacobians(space, s, rate, u, x)
    forced = X - B @ space.torque_offsets
    moved = np.zeros((len(s), n, n + n_p))
    moved[0, :, :n] = np.eye(n)
    for k in range(len(s) - 1):
        moved[k + 1] = A[k] @ moved[k]
        moved[k + 1, :, n:] += forced[k]
    return SegmentResponse(p.reading - h[:, :, 0], H @ moved, H, A, B)


def _transition_jacobians(
    space: StateSpace, s: np.ndarray, rate: np.ndarray, u: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How each sample's state moves with the one before it A (K, n, n), a torque that is constant in between B
    (K, n, n_u) and base parameters at fixed delivered torque (K, n, n_base).

    Radau IIA of order 3 on PARTS parts of a sample, between which states are cubic (they carry `rate`, per second) and
    torques linear: a stretch is only as well fitted as its slopes are true, to 1e-3 here.
    """
    h = 1 / float(space.model.machine.sampling_hz)
    K, n, core = len(s) - 1, space.n, space.core
    t = (np.arange(SUBINTERVALS) / SUBINTERVALS)[:, None]
    hermite = (
        (1 + 2 * t) * (1 - t) ** 2 * s[:-1, None]
        + t * (1 - t) ** 2 * h * rate[:-1, None]
        + t**2 * (3 - 2 * t) * s[1:, None]
        + t**2 * (t - 1) * h * rate[1:, None]
    )
    fine = np.concatenate([hermite.reshape(K * SUBINTERVALS, n), s[-1:]])
    torque = np.concatenate([((1 - t) * u[:-1, None] + t * u[1:, None]).reshape(K * SUBINTERVALS, -1), u[-1:]])
    J, B, JX, _, R = space.jacobians(fine, torque, x)
    direct = np.concatenate([B, JX], axis=2)
    step = h / SUBINTERVALS

    def inside(e: np.ndarray) -> np.ndarray:
        return e[:-1] * (2 / 3) + e[1:] * (1 / 3)

    J1, J2, D1, D2 = inside(J), J[1:], inside(direct), direct[1:]
    system = np.concatenate(
        [
            np.concatenate([J1 * (-step * 5 / 12), J2 * (step / 12)], axis=2),
            np.concatenate([J1 * (-step * 3 / 4), J2 * (-step / 4)], axis=2),
        ],
        axis=1,
    )
    system[:, range(2 * core), range(2 * core)] += 1.0
    eye = np.broadcast_to(np.eye(core), (K * SUBINTERVALS, core, core))
    known = np.concatenate(
        [
            np.concatenate([eye, D1 * (step * 5 / 12) - D2 * (step / 12)], axis=2),
            np.concatenate([eye, D1 * (step * 3 / 4) + D2 * (step / 4)], axis=2),
        ],
        axis=1,
    )
    Y = np.linalg.solve(system, known)
    moved = np.concatenate([Y[:, core:], step * (0.75 * inside(R) @ Y[:, :core] + 0.25 * R[1:] @ Y[:, core:])], axis=1)
    moved = moved.reshape(K, SUBINTERVALS, n, -1)
    A = np.zeros((K, SUBINTERVALS, n, n))
    A[..., :core] = moved[..., :core]
    A[..., range(core, n), range(core, n)] = 1.0
    whole, forced = A[:, 0], moved[:, 0, :, core:]
    for k in range(1, SUBINTERVALS):
        whole, forced = A[:, k] @ whole, A[:, k] @ forced + moved[:, k, :, core:]
    n_u = u.shape[1]
    return whole, forced[..., :n_u], forced[..., n_u:]


def _mean_square_residual(runs: Sequence[SegmentResponse]) -> np.ndarray:
    """Mean square of the residual of each sensor (m,)."""
    return sum((r.residual**2).sum(axis=0) for r in runs) / sum(len(r.residual) for r in runs)


def _cost(runs: Sequence[SegmentResponse], level: np.ndarray) -> float:
    return float((_mean_square_residual(runs) / level**2).sum())


def _gauss_newton_step(
    runs: Sequence[SegmentResponse], level: np.ndarray, torque: np.ndarray, sensor: np.ndarray, kept: list[int]
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """The step of the parameters (n_base,), of each stretch's start (n,), and the parameters' covariance (k, k)."""
    n = runs[0].H.shape[2]
    halves, triangles, tops = [], [], []
    for r in runs:
        L, m, width = r.slope.shape
        J = (r.slope / level[:, None]).reshape(L * m, width)
        e = (r.residual / level).reshape(L * m)
        own = J[:, [*range(n), *(n + k for k in kept)]]
        held = np.zeros((n, own.shape[1] + 1))
        held[:, :n] = np.eye(n) / INITIAL_STATE_STD
        Q, R = np.linalg.qr(np.concatenate([np.column_stack([own, e]), held]))
        triangles.append(Triangle(R[n:, n:], L * m))
        tops.append(R[:n])
        # A slip at the start is gone within milliseconds: nothing but the leeway holds its step.
        # What is left of the parameters' columns once the first state has taken its share.
        halves.append((own[:, n:] - Q[: L * m, :n] @ R[:n, n:-1]).reshape(L, m, len(kept)) / level[:, None])
    solution = solve(merge(triangles), 0.0)
    step = np.zeros(runs[0].slope.shape[2] - n)
    step[kept] = solution.x
    starts = [np.linalg.lstsq(t[:, :n], t[:, -1] - t[:, n:-1] @ solution.x, rcond=None)[0] for t in tops]
    S, expected = np.zeros((len(kept),) * 2), np.zeros(len(level))
    for r, half in zip(runs, halves, strict=True):
        added, seen = _propagate_noise(r, half, torque, sensor)
        S += added
        expected += seen
    excess = np.mean(_mean_square_residual(runs) * sum(len(r.residual) for r in runs) / expected)
    bread = solution.inverse
    return step, starts, bread @ S @ bread * max(1.0, float(excess))


def _propagate_noise(
    r: SegmentResponse, half: np.ndarray, torque: np.ndarray, sensor: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What noise does to the scores: their covariance (k, k); and to the readings: their summed variances (m,).

    Torque noise per sample acts on the intervals on both sides of it; backward in time for the scores, forward for the
    readings.
    """
    L, _, k = half.shape
    n, n_u = r.B.shape[1:]
    S = np.einsum("tmi,tmj->ij", half * sensor[:, None], half * sensor[:, None])
    behind = np.zeros((n_u, k))
    pull = r.H[-1].T @ half[-1]
    for t in range(L - 2, -1, -1):
        now = r.B[t].T @ pull / 2
        G = (now + behind) * torque[:, None]
        S += G.T @ G
        behind = now
        pull = r.A[t].T @ pull + r.H[t].T @ half[t]
    P, seen = np.zeros((n, n)), L * sensor**2
    for t in range(L - 1):
        B = r.B[t] * torque
        P = r.A[t] @ P @ r.A[t].T + B @ B.T
        seen = seen + np.einsum("mi,ij,mj->m", r.H[t + 1], P, r.H[t + 1])
    return S, seen
