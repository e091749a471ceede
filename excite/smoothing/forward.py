"""Forward likelihood of a log: torques and forces drive the motion, sensors read it.

Between samples the dynamics hold exactly under the delivered torques, what the model lacks, and white errors of both.
A log is linearised about a trajectory that need not be a motion of the model (multiple shooting): the defects between
its samples are constraints. Source: Bock, "Recent advances in parameter identification techniques for O.D.E.", 1983.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from excite.smoothing import parallel_smoother
from excite.smoothing.innovations import LinearisedLog
from excite.smoothing.linearisation import BATCH_SIZE, StateSpace
from excite.smoothing.measurements import Measurements, Trajectory, ground_inputs, offset_scale, predict_readings
from excite.smoothing.transitions import TransitionJacobians, Transitions, differentiate, integrate
from excite.smoothing.unknown_forces import Lacking

PART_SIZE = 200  # samples whose chain stays in the processor's cache; measured


@dataclass(frozen=True)
class Evaluation:
    """A log at a trajectory: what its sensors and its dynamics miss there.

    steps: motion from each sample to the next. behind (N - 1, n_u, n_base): derivatives of the delivered torques by the
    parameters. defect (N - 1, n): where the steps end, minus the next state. residual (N, m), weight (N, m): of the
    readings; their derivatives H by the state, D by their offsets, reading_slopes by `StateSpace.reading_parameters`.
    beat_inflation (N, m): of readings that beat with the clock. noise (N - 1, n_e): standard deviation of the white
    errors, of torques and forces; error (N - 1, n_e): the errors. start (n,): first state, from its prior mean, over
    its standard deviation. features (N, n_features): `StateSpace.features` along the states.
    """

    data: Measurements
    trajectory: Trajectory
    lacking: Lacking
    steps: Transitions
    behind: np.ndarray
    defect: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    H: np.ndarray
    D: np.ndarray
    reading_slopes: np.ndarray
    beat_inflation: np.ndarray
    noise: np.ndarray
    error: np.ndarray
    start: np.ndarray
    features: np.ndarray

    @property
    def cost(self) -> float:
        """Twice the negative log-likelihood of readings and errors, without the defects."""
        relative = np.divide(self.error, self.noise, out=np.zeros_like(self.error), where=self.noise > 0)
        return float(np.sum(self.weight * self.residual**2) + np.sum(relative**2) + np.sum(self.start**2))


def evaluate(
    space: StateSpace,
    data: Measurements,
    trajectory: Trajectory,
    guess: np.ndarray,
    X: np.ndarray,
    lacking: Lacking,
    exact: bool = False,
) -> Evaluation | None:
    """Evaluate a log at a trajectory; return None if the motion cannot be integrated.

    guess (n,): prior mean of the first state. exact: the trajectory is a motion of the model, without defects.
    """
    N = len(trajectory.state)
    delivered, behind = space.delivered_torques(data.torque, X, trajectory.torque_error)
    noise = space.delivered_noise(data.noise.torque, X)
    noise = np.broadcast_to(noise, trajectory.torque_error.shape)
    if data.extra_torque_noise is not None:
        noise = np.hypot(noise, data.extra_torque_noise)
    n_f = len(space.forces)
    features = space.features(trajectory.state)[0][:, :, 0] if lacking.count else np.zeros((N, 0))
    force_error = np.zeros((N - 1, n_f)) if trajectory.force_error is None else trajectory.force_error
    error = np.concatenate([trajectory.torque_error, force_error], axis=1)
    noise = np.concatenate([noise, np.broadcast_to(lacking.force_std, (N - 1, n_f))], axis=1)
    left, right = _driving_inputs(space, trajectory, delivered, error, lacking, features)
    steps = integrate(space, trajectory.state, left, right, X)
    defect = np.zeros_like(steps.end) if exact else steps.end - trajectory.state[1:]
    if not np.isfinite(steps.end).all():
        return None
    u = delivered + trajectory.sampled_torque_error
    h, H, weight, D, reading_slopes, beat_inflation = predict_readings(space, data, trajectory, u, X)
    h = h + lacking.reading_errors(trajectory.lacking, features, h.shape[1])
    residual = np.zeros_like(h) if exact else np.where(data.used > 0, data.reading - h, 0.0)
    start = (trajectory.state[0] - guess) / initial_std(space, data)
    return Evaluation(
        data,
        trajectory,
        lacking,
        steps,
        behind,
        defect,
        residual,
        weight,
        H,
        D,
        reading_slopes,
        beat_inflation,
        noise,
        error,
        start,
        features,
    )


def _driving_inputs(
    space: StateSpace,
    trajectory: Trajectory,
    delivered: np.ndarray,
    error: np.ndarray,
    lacking: Lacking,
    features: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs (N - 1, n_inputs) at both ends of every interval, errors (N - 1, n_e) included."""
    inputs, n_u = space.inputs(delivered, trajectory.ground_inputs), delivered.shape[1]
    if lacking.count:
        inputs = inputs + lacking.added_inputs(trajectory.lacking, features, space.n_inputs)
    added = space.inputs(error[:, :n_u], np.zeros_like(trajectory.ground_inputs[1:]), error[:, n_u:])
    return inputs[:-1] + added, inputs[1:] + added


def feedback_of(space: StateSpace, at: Evaluation) -> np.ndarray | None:
    """Return the slopes (2, N - 1, n_e, core) of what is lacking at both ends of every interval by the state there.

    None if there are none.
    """
    if not at.lacking.count:
        return None
    feedback = at.lacking.feedback(at.trajectory.lacking, at.features, space.n_inputs)
    if feedback is None:
        return None
    by_state = feedback[:, space.input_columns] @ space.features(at.trajectory.state)[1]
    return np.stack([by_state[:-1], by_state[1:]])


def close(
    space: StateSpace, by: TransitionJacobians, feedback: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the derivatives A (K, n, n) of K transitions by the first state if inputs at both ends follow the states
    there, and what multiplies them and all others (K, n, n): the last state moves itself, too. None if nothing does.

    feedback (2, K, n_e, core): slopes of the inputs at both ends by the state.
    """
    if feedback is None:
        return by.A, None
    A, whole = by.A.copy(), np.broadcast_to(np.eye(space.n), by.A.shape).copy()
    A[:, :, : space.core] += (by.B - by.rising) @ feedback[0]
    whole[:, :, : space.core] -= by.rising @ feedback[1]
    return A, np.linalg.inv(whole)


def without_growth(space: StateSpace, by: TransitionJacobians, feedback: np.ndarray | None) -> np.ndarray | None:
    """Return the feedback (2, K, n_e, core) of K transitions, zero where it makes a motion grow."""
    A, inverse = close(space, by, feedback)
    if feedback is None or inverse is None:
        return None
    c = space.core
    alone, together = (np.abs(np.linalg.eigvals(x[:, :c, :c])).max(axis=1) for x in (by.A, inverse @ A))
    stays = together <= np.maximum(alone, 1.0) * np.exp(MAX_GROWTH / float(space.model.machine.sampling_hz))
    return feedback * stays[:, None, None]


MAX_GROWTH = 1.0  # [1/s] that forces may add to a motion: what grows faster over a log can't be smoothed


def _direct_slopes(space: StateSpace, at: Evaluation, n_p: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes (N, m, n_d) of readings by what they depend on directly, and its columns (n_d,) in `drive`."""
    parameters, readings, shape = list(space.reading_parameters), at.lacking.readings, at.residual.shape
    seen = sorted({int(c) for term in readings for c in term.columns})
    by_coefficient = np.zeros((*shape, len(seen)))
    for term in readings:
        by_coefficient[:, term.at, [seen.index(c) for c in term.columns]] += term.values(at.features)
    by_offset = at.D * offset_scale(space, at.data)
    by_offset = np.broadcast_to(by_offset, (*shape, by_offset.shape[-1]))
    offsets = 1 + n_p + at.lacking.count + np.arange(by_offset.shape[-1])
    columns = np.concatenate([1 + np.array(parameters, int), 1 + n_p + np.array(seen, int), offsets])
    slopes = at.reading_slopes * space.model.scale[parameters]
    return np.concatenate([slopes, by_coefficient, by_offset], axis=2), columns


def linearise(space: StateSpace, at: Evaluation, guess: np.ndarray, X: np.ndarray) -> LinearisedLog:
    """Linearise an evaluated log."""
    data, trajectory, lacking = at.data, at.trajectory, at.lacking
    scale, n_p, n_u, N = state_scale(space), len(X), data.torque.shape[1], len(trajectory.state)
    count = 1 + n_p + lacking.count + len(data.offset_sensors)
    S, (direct, columns) = at.H * scale, _direct_slopes(space, at, n_p)
    std = initial_std(space, data) / scale
    zero = np.zeros((1, space.n, space.n))
    sections = [parallel_smoother.combine(parallel_smoother.Elements(zero, np.diag(std**2)[None], zero))]
    elements, gains, inverses = [], [], []
    acting = np.concatenate([np.arange(n_u), n_u + np.flatnonzero(lacking.force_std > 0)])
    J = (S * at.weight[:, :, None]).transpose(0, 2, 1) @ S
    drive = np.zeros((N, space.n, count))
    terms = [(t.columns, list(space.input_columns).index(t.at), t.values(at.features)) for t in lacking.inputs]
    feedback = feedback_of(space, at)
    for begin in range(0, N - 1, BATCH_SIZE):
        end = min(begin + BATCH_SIZE, N - 1)
        by = differentiate(space, at.steps.between(begin, end), X, rising=bool(lacking.count))
        own_feedback = without_growth(space, by, None if feedback is None else feedback[:, begin:end])
        A, inverse = close(space, by, own_feedback)
        A = A * (scale / scale[:, None])
        gain = by.B[:, :, acting] * at.noise[begin:end, None, acting] / scale[:, None]
        b = drive[begin:end]
        relative_error = at.error[begin:end, acting] / at.noise[begin:end, acting]
        b[:, :, 0] = at.defect[begin:end] / scale - (gain @ relative_error[:, :, None])[:, :, 0]
        b[:, :, 1 : 1 + n_p] = (by.X + by.B[:, :, :n_u] @ at.behind[begin:end]) * (space.model.scale / scale[:, None])
        for own, j, values in terms:
            ends = np.stack([by.B[:, :, j] - by.rising[:, :, j], by.rising[:, :, j]], axis=2) / scale[:, None]
            both = np.stack([values[begin:end], values[begin + 1 : end + 1]], axis=1)
            b[:, :, 1 + n_p + own[0] : 2 + n_p + own[-1]] += ends @ both
        if inverse is not None:
            inverse = inverse * (scale / scale[:, None])
            inverses.append(inverse)
            A, gain = inverse @ A, inverse @ gain
            drive[begin:end] = inverse @ b
        C = gain @ gain.transpose(0, 2, 1)
        gains.append(gain)
        for k in range(0, end - begin, PART_SIZE):
            part = slice(k, min(k + PART_SIZE, end - begin))
            elements.append(parallel_smoother.Elements(A[part], C[part], J[begin:end][part]))
            sections.append(parallel_smoother.combine(elements[-1]))
    # The last sample has no transition.
    elements.append(parallel_smoother.Elements(zero, zero, J[-1:]))
    sections.append(parallel_smoother.combine(elements[-1]))
    return LinearisedLog(
        parallel_smoother.smooth_chain(sections),
        drive,
        (guess - trajectory.state[0]) / scale,
        np.concatenate(gains),
        tuple(elements),
        S,
        at.weight,
        at.residual,
        direct,
        at.noise[:, acting],
        at.beat_inflation,
        acting,
        columns,
        np.concatenate(inverses) if inverses else None,
    )


DETERMINANT_STEP = 1e-3  # of a parameter over its scale, for the difference quotient of transitions
DETERMINANT_TRANSITIONS = 1500  # of a log, of which difference quotients are taken: neighbours change alike


def log_variance_slopes(
    space: StateSpace, at: Evaluation, linear: LinearisedLog, X: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes of `innovations.log_variance` by scaled parameters (n_base,) and coefficients (count,).

    Zero where a parameter is not free (n_base,). The covariance P' = A P A' + B Q B' that a transition predicts, P from
    all readings before, changes the determinant by the trace of N dP', N the covariance of the multiplier after it.
    """
    scale, K = state_scale(space), len(at.defect)
    places = np.arange(0, K, max(1, K // DETERMINANT_TRANSITIONS))
    A, J = (np.concatenate([getattr(x, name) for x in linear.elements])[:-1] for name in ("A", "J"))
    P, N = linear.moments
    by_A = 2 * (N @ A @ parallel_smoother.shrink(P[:-1], J)) * (scale / scale[:, None])
    by_B = 2 * (N @ linear.gain) * linear.noise[:, None] / scale[:, None]
    by_A, by_B = (np.add.reduceat(x, places) for x in (by_A, by_B))
    state = at.trajectory.state[np.append(places, -1)]
    feedback = feedback_of(space, at)
    feedback = None if feedback is None else feedback[:, places]

    def transitions(X: np.ndarray) -> TransitionJacobians:
        delivered = space.delivered_torques(at.data.torque, X, at.trajectory.torque_error)[0]
        left, right = _driving_inputs(space, at.trajectory, delivered, at.error, at.lacking, at.features)
        steps = integrate(space, state, left[places], right[places], X)
        return differentiate(space, steps, X, False, at.lacking.count > 0)

    def closed(by: TransitionJacobians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        A, inverse = close(space, by, feedback)
        inverse = np.broadcast_to(np.eye(space.n), A.shape) if inverse is None else inverse
        return inverse @ A, inverse @ by.B[:, :, linear.acting], inverse

    def value(by: TransitionJacobians) -> float:
        A, B, _ = closed(by)
        return float(np.sum(by_A * A) + np.sum(by_B * B))

    by = transitions(X)
    feedback = without_growth(space, by, feedback)
    here, found = value(by), np.zeros(len(X))
    for k in np.flatnonzero(free):
        moved = X.copy()
        moved[k] += DETERMINANT_STEP * space.model.scale[k]
        found[k] = (value(transitions(moved)) - here) / DETERMINANT_STEP
    if not at.lacking.count:
        return found, np.zeros(0)
    A, B, inverse = closed(by)
    back = inverse.transpose(0, 2, 1)
    behind = back @ (by_A @ A.transpose(0, 2, 1) + by_B @ B.transpose(0, 2, 1))
    ends = (
        ((by.B - by.rising).transpose(0, 2, 1) @ back @ by_A, places),
        (by.rising.transpose(0, 2, 1) @ behind, places + 1),
    )
    coefficients = np.zeros(at.lacking.count)
    for by_input, own in ends:
        weights = np.zeros((len(own), space.n_inputs, at.features.shape[1]))
        slopes = space.features(at.trajectory.state[own])[1]
        weights[:, space.input_columns] = by_input[:, :, : space.core] @ slopes.transpose(0, 2, 1)
        coefficients += at.lacking.along_slopes(weights, at.features[own])
    return found, coefficients


INITIAL_SPEED_STD = 0.05  # [m/s, rad/s]
INITIAL_ANGLE_STD = 0.1  # [rad, m]


def initial_std(space: StateSpace, data: Measurements) -> np.ndarray:
    """Return the standard deviation (n,) of the first state about the filtered log, in its unit."""
    usual = np.where(is_speed(space), INITIAL_SPEED_STD, INITIAL_ANGLE_STD)
    if data.turned and space.model.heading is not None:
        any_angle = np.pi / np.sqrt(3)  # between half a turn either way
        usual = np.where(space.index == space.model.heading, any_angle, usual)
    return np.where(np.isfinite(space.initial_std), space.initial_std, usual)


def is_speed(space: StateSpace) -> np.ndarray:
    """Tell which states (n,) are velocities."""
    n_q = len(space.model.coordinates)
    return (space.index >= n_q) & (space.index < 2 * n_q)


def is_turning(space: StateSpace) -> np.ndarray:
    """Tell which states (n,) are angles of the heading or of a joint that turns."""
    angles = [k for k, c in enumerate(space.model.coordinates) if c.startswith("theta")]
    return np.isin(space.index, angles)


def state_scale(space: StateSpace) -> np.ndarray:
    """Return a typical error of each state (n,), in its unit."""
    return np.where(is_speed(space), 1e-2, 1e-3)


def move(
    space: StateSpace,
    trajectory: Trajectory,
    linear: LinearisedLog,
    lacking: Lacking,
    step: np.ndarray,
    X: np.ndarray,
    data: Measurements,
) -> Trajectory:
    """Return the trajectory after a scaled step of all unknowns to parameters X, with its most likely states."""
    x, slope = linear.states(step)
    e = (linear.gain.transpose(0, 2, 1) @ slope[1:, :, None])[:, :, 0] * linear.noise
    n_u, n_o = data.torque.shape[1], len(data.offset_sensors)
    n_c = lacking.count
    state = trajectory.state + x * state_scale(space)
    force = np.zeros((len(e), len(space.forces)))
    force[:, lacking.force_std > 0] = e[:, n_u:]
    end = len(step) - n_o
    return replace(
        trajectory,
        state=state,
        torque_error=e[:, :n_u],
        force_error=force,
        offset=trajectory.offset + step[end:] * offset_scale(space, data),
        lacking=trajectory.lacking + step[end - n_c : end],
        ground_inputs=ground_inputs(space, state, X),
    )


def interpolate(a: Trajectory, b: Trajectory, fraction: float) -> Trajectory:
    """Return the trajectory at a fraction of the way from one to another."""

    def mix(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return x + fraction * (y - x)

    force = b.force_error
    if force is not None:
        force = mix(np.zeros_like(force) if a.force_error is None else a.force_error, force)
    return Trajectory(
        mix(a.state, b.state),
        mix(a.torque_error, b.torque_error),
        mix(a.offset, b.offset),
        mix(a.ground_inputs, b.ground_inputs),
        mix(a.lacking, b.lacking),
        force,
    )
