"""Output error: simulate the log's torques and fit the parameters to the sensors' readings.

The log is cut into segments with free first states, so that torque noise has little time to accumulate and poor
starting values cannot diverge. Gauss-Newton with exact sensitivities. Source: Ljung, "System Identification", 2nd ed.,
1999, ch. 7 and 10; segments as in Bock's multiple shooting, without continuity.
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
from excite.text import format_number

SEGMENT_DURATION = 5.0  # of a segment with its own first state [s]; chosen
INITIAL_STATE_STD = (
    0.02  # of a first state's step in one pass, which bounds unobserved states [rad, m/s, rad/s]; chosen
)
SUBINTERVALS = 4  # of a sample, for the derivatives; chosen
MAX_PASSES = 20  # of Gauss-Newton; chosen
CONVERGED_STEP = 0.02  # largest step at the end [standard deviations]; chosen
# Smallest step of all passes that is accepted if sticking friction prevents convergence [standard deviations]; chosen.
ACCEPTABLE_STEP = 0.1
MAX_HALVINGS = 8  # of a step to a machine that cannot be simulated; chosen
MAX_RELATIVE_STEP = 0.5  # of a parameter in one pass, relative to its size; chosen

UNUSED_KINDS = ("ground_speed", "x", "y")  # of sensors that are often slower than the log


@dataclass(frozen=True)
class Segment:
    """Segment of a log: torque (L, n_u) as measured, reading (L, m), start (n,): first state of the state space."""

    torque: np.ndarray
    reading: np.ndarray
    start: np.ndarray


UNUSED_KINDS = ("ground_speed", "x", "y")  # of sensors that are often slower than the log


@dataclass(frozen=True)
class SegmentResponse:
    """Simulated segment.

    residual (L, m); slope (L, m, n + n_base): of the readings by start and parameters. For the noise: H (L, m, n) by
    the states, and A (L - 1, n, n), B (L - 1, n, n_u) from sample to sample.
    """

    residual: np.ndarray
    slope: np.ndarray
    H: np.ndarray
    A: np.ndarray
    B: np.ndarray


def oe(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by output error from the machine file's values, each sensor weighted by its residual level.

    Standard deviations: torque noise as found in the log, propagated through the dynamics, and sensor noise and counts,
    enlarged if the residuals exceed these. Raises NotIdentifiableError if Gauss-Newton does not converge.
    """
    common = set.intersection(*(set(log.values) for log in logs))
    names = tuple(s.name for s in model.machine.sensors("full") if s.name in common and s.kind not in UNUSED_KINDS)
    space = build_state_space(model, names)
    segments = [p for log in logs for p in _cut_into_segments(space, log, filter)]
    torque_noise = _torque_noise(model, logs)
    sensor_noise = np.array([_sensor_noise(s.resolution, [log.values[s.name] for log in logs]) for s in space.sensors])
    blocks = filtered_blocks(model, logs, filter)
    kept = list(solve_blocks(blocks, model.scale).kept)
    x, level = model.nominal.copy(), sensor_noise
    responses = _simulate_segments(space, segments, x)
    if responses is None:
        raise NotIdentifiableError(
            "oe: the machine file's values give no motion along this log; check masses and inertias"
        )
    best = np.inf, x, responses
    for _ in range(MAX_PASSES):
        step, starts, covariance = _gauss_newton_step(responses, level, torque_noise, sensor_noise, kept)
        limit = MAX_RELATIVE_STEP * np.maximum(model.scale, np.abs(x))
        share = min(1.0, float((limit[kept] / np.maximum(np.abs(step[kept]), 1e-300)).min()))
        for _ in range(MAX_HALVINGS):
            moved_segments = [
                Segment(p.torque, p.reading, p.start + share * d) for p, d in zip(segments, starts, strict=True)
            ]
            proposed = _simulate_segments(space, moved_segments, x + share * step)
            if proposed is not None and _cost(proposed, level) < 1.001 * _cost(responses, level):
                break
            share /= 2
        else:
            raise NotIdentifiableError(
                "oe: no step improves the fit before it has converged: start from better values in the machine file, or"
                " use another method"
            )
        segments, responses, x = moved_segments, proposed, x + share * step
        level = np.maximum(np.sqrt(_mean_square_residual(responses)), sensor_noise)
        largest_step = float((np.abs(step[kept]) / np.sqrt(np.diag(covariance))).max())
        best = min(best, (largest_step, x, responses), key=lambda one: one[0])
        if largest_step < CONVERGED_STEP:
            break
    largest_step, x, responses = best
    if largest_step > ACCEPTABLE_STEP:
        raise NotIdentifiableError(
            f"oe: not converged in {MAX_PASSES} passes (smallest step {format_number(largest_step, 2)} standard"
            " deviations): start from better values in the machine file, or use another method"
        )
    level = np.maximum(np.sqrt(_mean_square_residual(responses)), sensor_noise)
    _, _, covariance = _gauss_newton_step(responses, level, torque_noise, sensor_noise, kept)
    return _build_estimate(model, blocks, x, covariance, len(segments))


def _build_estimate(
    model: Model,
    blocks: Sequence[tuple[np.ndarray, np.ndarray]],
    x: np.ndarray,
    covariance: np.ndarray,
    segment_count: int,
) -> Estimate:
    solution = solve_blocks(blocks, model.scale)
    note = f"oe: {segment_count} stretches of {SEGMENT_DURATION:g} s, each from a state of its own"
    return build_estimate(model, blocks, solution, "oe", x, covariance, solution.degrees, (note,))


def _cut_into_segments(space: StateSpace, log: Log, filter: Filter) -> list[Segment]:
    model, machine = space.model, space.model.machine
    rate, n_q = float(machine.sampling_hz), len(space.model.coordinates)
    motion = samples(model, log, filter)
    wheels = [x.name for x in machine.sensor if x.kind == "wheel"]
    wheel_angles = [lowpass(log.values[w], rate, filter) if w in log.values else np.zeros(len(log)) for w in wheels]
    state = np.concatenate([motion.q, motion.nu, np.reshape(wheel_angles, (len(wheels), len(log)))])[space.index].T
    torque = motion.Y[list(model.actuated)].T
    reading = np.column_stack([log.values[x.name] for x in space.sensors])
    first, last = filter.drop[0], len(log) - filter.drop[1]
    count = max(1, round((last - first) / (SEGMENT_DURATION * rate)))
    edges = np.linspace(first, last, count + 1).astype(int)
    assert space.full_size == 2 * n_q + len(wheels)
    return [Segment(torque[a:b], reading[a:b], state[a]) for a, b in itertools.pairwise(edges)]


def _torque_noise(model: Model, logs: Sequence[Log]) -> np.ndarray:
    """Level (n_u,) of the white noise on the torques [N m]."""
    names = [
        next(s.name for s in model.machine.sensor if s.kind == "torque" and s.body == b.index)
        for b in model.machine.actuated
    ]
    return np.array([np.sqrt(np.mean([log.white_noise(n) ** 2 for log in logs])) for n in names])


def _sensor_noise(step: float | None, values: Sequence[np.ndarray]) -> float:
    found = float(np.sqrt(np.mean([white_noise(v) ** 2 for v in values])))
    return max(step / np.sqrt(12) if step is not None else found, 1e-9 * max(float(np.abs(v).max()) for v in values))


def _simulate_segments(space: StateSpace, segments: Sequence[Segment], x: np.ndarray) -> list[SegmentResponse] | None:
    """Simulate every segment with the parameters x (n_base,); None if a motion cannot be integrated."""
    try:
        responses = [_simulate_segment(space, p, x) for p in segments]
    except SimulationError:
        return None
    return responses if all(np.isfinite(r.residual).all() and np.isfinite(r.slope).all() for r in responses) else None


def _simulate_segment(space: StateSpace, segment: Segment, x: np.ndarray) -> SegmentResponse:
    n_q, n, n_p = len(space.model.coordinates), space.n, len(x)
    u = segment.torque - x @ space.torque_offsets.T
    full = np.zeros(space.full_size)
    full[space.index] = segment.start
    motion = simulate(space.model, u, x, full[:n_q], full[n_q : 2 * n_q])
    s = np.hstack([motion.q, motion.nu, motion.wheels + full[2 * n_q :]])[:, space.index]
    rate = np.hstack([motion.nu, motion.a, np.zeros_like(motion.wheels)])[:, space.index]
    h, H, *_ = space.readings(s, u, x)
    A, B, X = _transition_jacobians(space, s, rate, u, x)
    parameter_input = X - B @ space.torque_offsets
    sensitivity = np.zeros((len(s), n, n + n_p))
    sensitivity[0, :, :n] = np.eye(n)
    for k in range(len(s) - 1):
        sensitivity[k + 1] = A[k] @ sensitivity[k]
        sensitivity[k + 1, :, n:] += parameter_input[k]
    return SegmentResponse(segment.reading - h[:, :, 0], H @ sensitivity, H, A, B)


def _transition_jacobians(
    space: StateSpace, s: np.ndarray, rate: np.ndarray, u: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the derivatives of each sample's state by the state before, by a constant torque and by base parameters.

    Returns A (K, n, n), B (K, n, n_u), and the derivatives by base parameters at fixed delivered torque (K, n, n_base).
    Radau IIA of order 3 on SUBINTERVALS of a sample, with cubic states (slopes `rate` per second) and linear torques.
    The error is about 1e-3, as the fit is only as good as these derivatives.
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
    inputs = np.concatenate([B, JX], axis=2)
    step = h / SUBINTERVALS

    def inside(e: np.ndarray) -> np.ndarray:
        return e[:-1] * (2 / 3) + e[1:] * (1 / 3)

    J1, J2, D1, D2 = inside(J), J[1:], inside(inputs), inputs[1:]
    system = np.concatenate(
        [
            np.concatenate([J1 * (-step * 5 / 12), J2 * (step / 12)], axis=2),
            np.concatenate([J1 * (-step * 3 / 4), J2 * (-step / 4)], axis=2),
        ],
        axis=1,
    )
    system[:, range(2 * core), range(2 * core)] += 1.0
    eye = np.broadcast_to(np.eye(core), (K * SUBINTERVALS, core, core))
    right_hand_side = np.concatenate(
        [
            np.concatenate([eye, D1 * (step * 5 / 12) - D2 * (step / 12)], axis=2),
            np.concatenate([eye, D1 * (step * 3 / 4) + D2 * (step / 4)], axis=2),
        ],
        axis=1,
    )
    Y = np.linalg.solve(system, right_hand_side)
    response = np.concatenate(
        [Y[:, core:], step * (0.75 * inside(R) @ Y[:, :core] + 0.25 * R[1:] @ Y[:, core:])], axis=1
    )
    response = response.reshape(K, SUBINTERVALS, n, -1)
    A = np.zeros((K, SUBINTERVALS, n, n))
    A[..., :core] = response[..., :core]
    A[..., range(core, n), range(core, n)] = 1.0
    transition, input_response = A[:, 0], response[:, 0, :, core:]
    for k in range(1, SUBINTERVALS):
        transition, input_response = A[:, k] @ transition, A[:, k] @ input_response + response[:, k, :, core:]
    n_u = u.shape[1]
    return transition, input_response[..., :n_u], input_response[..., n_u:]


def _mean_square_residual(responses: Sequence[SegmentResponse]) -> np.ndarray:
    """Mean square of the residual of each sensor (m,)."""
    return sum((r.residual**2).sum(axis=0) for r in responses) / sum(len(r.residual) for r in responses)


def _cost(responses: Sequence[SegmentResponse], level: np.ndarray) -> float:
    return float((_mean_square_residual(responses) / level**2).sum())


def _gauss_newton_step(
    responses: Sequence[SegmentResponse],
    level: np.ndarray,
    torque_noise: np.ndarray,
    sensor_noise: np.ndarray,
    kept: list[int],
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Compute the step of the parameters (n_base,), of each segment's start (n,), and the covariance (k, k)."""
    n = responses[0].H.shape[2]
    projected, triangles, tops = [], [], []
    for r in responses:
        L, m, width = r.slope.shape
        J = (r.slope / level[:, None]).reshape(L * m, width)
        e = (r.residual / level).reshape(L * m)
        columns = J[:, [*range(n), *(n + k for k in kept)]]
        initial_prior = np.zeros((n, columns.shape[1] + 1))
        initial_prior[:, :n] = np.eye(n) / INITIAL_STATE_STD
        Q, R = np.linalg.qr(np.concatenate([np.column_stack([columns, e]), initial_prior]))
        triangles.append(Triangle(R[n:, n:], L * m))
        tops.append(R[:n])
        # A slip at the start decays within milliseconds, so only INITIAL_STATE_STD bounds its step. The parameters'
        # columns are projected orthogonal to those of the first state.
        projected.append((columns[:, n:] - Q[: L * m, :n] @ R[:n, n:-1]).reshape(L, m, len(kept)) / level[:, None])
    solution = solve(merge(triangles), 0.0)
    step = np.zeros(responses[0].slope.shape[2] - n)
    step[kept] = solution.x
    starts = [np.linalg.lstsq(t[:, :n], t[:, -1] - t[:, n:-1] @ solution.x, rcond=None)[0] for t in tops]
    scores_covariance, expected = np.zeros((len(kept),) * 2), np.zeros(len(level))
    for r, projection in zip(responses, projected, strict=True):
        scores, variances = _propagate_noise(r, projection, torque_noise, sensor_noise)
        scores_covariance += scores
        expected += variances
    excess = np.mean(_mean_square_residual(responses) * sum(len(r.residual) for r in responses) / expected)
    bread = solution.inverse
    return step, starts, bread @ scores_covariance @ bread * max(1.0, float(excess))


def _propagate_noise(
    r: SegmentResponse, projection: np.ndarray, torque_noise: np.ndarray, sensor_noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (k, k) of the scores and summed variances (m,) of the readings that noise causes.

    Torque noise of a sample acts on both adjacent intervals. It is propagated backward in time for the scores and
    forward for the readings.
    """
    L, _, k = projection.shape
    n, n_u = r.B.shape[1:]
    scores_covariance = np.einsum("tmi,tmj->ij", projection * sensor_noise[:, None], projection * sensor_noise[:, None])
    later = np.zeros((n_u, k))
    adjoint = r.H[-1].T @ projection[-1]
    for t in range(L - 2, -1, -1):
        earlier = r.B[t].T @ adjoint / 2
        G = (earlier + later) * torque_noise[:, None]
        scores_covariance += G.T @ G
        later = earlier
        adjoint = r.A[t].T @ adjoint + r.H[t].T @ projection[t]
    covariance, variances = np.zeros((n, n)), L * sensor_noise**2
    for t in range(L - 1):
        B = r.B[t] * torque_noise
        covariance = r.A[t] @ covariance @ r.A[t].T + B @ B.T
        variances = variances + np.einsum("mi,ij,mj->m", r.H[t + 1], covariance, r.H[t + 1])
    return scores_covariance, variances
