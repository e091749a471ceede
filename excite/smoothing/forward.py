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

# Process noise of level 1, white from sample to sample, as acceleration [m/s2, rad/s2]: 500 N on a roller of 11 t.
PROCESS_NOISE_UNIT = 0.045
PROCESS_NOISE_LEVELS = (1.0, 4.0, 16.0)  # tried in turn until a fit is close; chosen
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
    inputs = space.inputs(delivered, trajectory.ground_inputs)
    n_f, features = len(space.forces), np.zeros((N, 0))
    if lacking.count:
        features = space.features(trajectory.state)[0][:, :, 0]
        inputs = inputs + lacking.added_inputs(trajectory.lacking, features, space.n_inputs)
    force_error = np.zeros((N - 1, n_f)) if trajectory.force_error is None else trajectory.force_error
    error = np.concatenate([trajectory.torque_error, force_error], axis=1)
    noise = np.concatenate([noise, np.broadcast_to(lacking.force_std, (N - 1, n_f))], axis=1)
    added = space.inputs(trajectory.torque_error, np.zeros((N - 1, trajectory.ground_inputs.shape[1])), force_error)
    left, right = inputs[:-1] + added, inputs[1:] + added
    steps = integrate(space, trajectory.state, left, right, X)
    defect = np.zeros_like(steps.end) if exact else steps.end - trajectory.state[1:]
    if not np.isfinite(steps.end).all():
        return None
    u = delivered + trajectory.sampled_torque_error
    h, H, weight, D, reading_slopes, beat_inflation = predict_readings(space, data, trajectory, u, X)
    h = h + lacking.reading_errors(trajectory.lacking, features, h.shape[1])
    residual = np.zeros_like(h) if exact else np.where(data.used > 0, data.reading - h, 0.0)
    start = (trajectory.state[0] - guess) / initial_std(space)
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


def transitions(space: StateSpace, at: Evaluation, X: np.ndarray) -> TransitionJacobians:
    """Return the derivatives of all transitions along an evaluated log, at parameters X (n_base,).

    A and B contain what is lacking where it follows the state; X, F and rising do not.
    """
    found = differentiate(space, at.steps, X, False, bool(at.lacking.count))
    A, inverse = close(space, found, feedback_of(space, at))
    return found if inverse is None else replace(found, A=inverse @ A, B=inverse @ found.B)


def feedback_of(space: StateSpace, at: Evaluation) -> np.ndarray | None:
    """Return the slopes (N, n_e, core) of what is lacking by the state, None if there are none."""
    if not at.lacking.count:
        return None
    feedback = at.lacking.feedback(at.trajectory.lacking, at.features, space.n_inputs)
    if feedback is None:
        return None
    return np.asarray(feedback[:, space.input_columns] @ space.features(at.trajectory.state)[1])


def close(
    space: StateSpace, by: TransitionJacobians, feedback: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the derivatives A (K, n, n) of K transitions by the first state if inputs at both ends follow the states
    there, and what multiplies them and all others (K, n, n): the last state moves itself, too. None if nothing does.

    feedback (K + 1, n_e, core): slopes of the inputs by the state. It is left out where it makes a motion grow.
    """
    if feedback is None:
        return by.A, None
    c = space.core
    first, last = (by.B - by.rising) @ feedback[:-1], by.rising @ feedback[1:]
    A, whole = by.A.copy(), np.broadcast_to(np.eye(space.n), by.A.shape).copy()
    A[:, :, :c] += first
    whole[:, :, :c] -= last
    inverse = np.linalg.inv(whole)
    alone, together = (np.abs(np.linalg.eigvals(x[:, :c, :c])).max(axis=1) for x in (by.A, inverse @ A))
    grows = together > np.maximum(alone, 1.0) * np.exp(MAX_GROWTH / float(space.model.machine.sampling_hz))
    A[grows], inverse[grows] = by.A[grows], np.eye(space.n)
    return A, inverse


MAX_GROWTH = 1.0  # [1/s] that forces may add to a motion: what grows faster over a log can't be smoothed


def linearise(
    space: StateSpace,
    at: Evaluation,
    guess: np.ndarray,
    X: np.ndarray,
    process_noise: float = 0.0,
    probe: np.random.Generator | None = None,
) -> LinearisedLog:
    """Linearise an evaluated log and integrate out its states.

    probe: draws of white errors and readings' noise; what they would leave becomes a last column of Z and the chain.
    """
    data, trajectory, lacking = at.data, at.trajectory, at.lacking
    scale, n_p, n_o = state_scale(space), len(X), len(data.offset_sensors)
    n_c = lacking.count
    N, n_u = len(trajectory.state), data.torque.shape[1]
    count = 1 + n_p + n_c + n_o
    total = count + (probe is not None)
    S, offset_unit = at.H * scale, offset_scale(space, data)
    slopes = at.reading_slopes * space.model.scale[list(space.reading_parameters)]
    seen = sorted({int(c) for term in lacking.readings for c in term.columns})
    # Columns that act on readings directly.
    columns = np.concatenate(
        [1 + np.array(space.reading_parameters, int), 1 + n_p + np.array(seen, int), np.arange(1 + n_p + n_c, count)]
    )
    by_reading = np.zeros((N, at.residual.shape[1], len(seen)))
    for term in lacking.readings:
        by_reading[:, term.at, [seen.index(c) for c in term.columns]] += term.values(at.features)
    direct = np.concatenate(
        [slopes, by_reading, np.broadcast_to(at.D * offset_unit, (*at.residual.shape, n_o))], axis=2
    )
    noisy = np.sqrt(at.weight) * probe.standard_normal(at.weight.shape) if probe is not None else None
    drawn = probe.standard_normal(at.noise.shape) if probe is not None else None
    first = np.zeros((1, space.n, total))
    first[0, :, 0] = (guess - trajectory.state[0]) / scale
    std = initial_std(space) / scale
    if probe is not None:
        first[0, :, -1] = std * probe.standard_normal(space.n)
    zero = np.zeros((1, space.n, space.n))
    sections = [
        parallel_smoother.combine(
            parallel_smoother.Elements(zero, first, np.diag(std**2)[None], np.zeros_like(first), zero)
        )
    ]
    stages, gains, processes, inverses = [], [], [], []
    acting = np.concatenate([np.arange(n_u), n_u + np.flatnonzero(lacking.force_std > 0)])

    def readings(part: slice) -> tuple[np.ndarray, np.ndarray]:
        weighted = (S[part] * at.weight[part][:, :, None]).transpose(0, 2, 1)
        eta = np.zeros((part.stop - part.start, space.n, total))
        eta[:, :, 0] = (weighted @ at.residual[part][:, :, None])[:, :, 0]
        eta[:, :, columns] = -(weighted @ direct[part])
        if noisy is not None:
            eta[:, :, -1] = (S[part].transpose(0, 2, 1) @ noisy[part][:, :, None])[:, :, 0]
        return weighted @ S[part], eta

    terms = [(t.columns, list(space.input_columns).index(t.at), t.values(at.features)) for t in lacking.inputs]
    feedback = feedback_of(space, at)
    for begin in range(0, N - 1, BATCH_SIZE):
        end = min(begin + BATCH_SIZE, N - 1)
        by = differentiate(space, at.steps.between(begin, end), X, process_noise > 0, bool(lacking.count))
        A, inverse = close(space, by, None if feedback is None else feedback[begin : end + 1])
        A = A * (scale / scale[:, None])
        gain = by.B[:, :, acting] * at.noise[begin:end, None, acting] / scale[:, None]
        b = np.zeros((end - begin, space.n, total))
        relative_error = at.error[begin:end, acting] / at.noise[begin:end, acting]
        b[:, :, 0] = at.defect[begin:end] / scale - (gain @ relative_error[:, :, None])[:, :, 0]
        b[:, :, 1 : 1 + n_p] = (by.X + by.B[:, :, :n_u] @ at.behind[begin:end]) * (space.model.scale / scale[:, None])
        for own, j, values in terms:
            at_start, at_end = values[begin:end, None, :], values[begin + 1 : end + 1, None, :]
            change = by.B[:, :, j, None] * at_start + by.rising[:, :, j, None] * (at_end - at_start)
            b[:, :, 1 + n_p + own] += change / scale[:, None]
        if drawn is not None:
            b[:, :, -1] = (gain @ drawn[begin:end, acting, None])[:, :, 0]
        process = np.zeros((end - begin, space.n, 0))
        if process_noise > 0:
            process = by.F * (process_noise * PROCESS_NOISE_UNIT * space.forced_inertia) / scale[:, None]
            processes.append(process)
        if inverse is not None:
            inverse = inverse * (scale / scale[:, None])
            inverses.append(inverse)
            A, b, gain, process = (inverse @ x for x in (A, b, gain, process))
        C = gain @ gain.transpose(0, 2, 1) + process @ process.transpose(0, 2, 1)
        gains.append(gain)
        for k in range(begin, end, PART_SIZE):
            part_end = min(k + PART_SIZE, end)
            J, eta = readings(slice(k, part_end))
            inside = slice(k - begin, part_end - begin)
            stages.append(parallel_smoother.Elements(A[inside], b[inside], C[inside], eta, J))
            sections.append(parallel_smoother.combine(stages[-1]))
    # The last sample has no transition.
    J, eta = readings(slice(N - 1, N))
    none = np.zeros_like(J)
    stages.append(parallel_smoother.Elements(none, np.zeros_like(eta), none, eta, J))
    sections.append(parallel_smoother.combine(stages[-1]))
    chain = parallel_smoother.smooth_chain(sections)
    root = np.sqrt(at.weight)
    parts = [(at.residual * root)[:, :, None], -direct * root[:, :, None]]
    where = np.concatenate([[0], columns])
    if noisy is not None:
        unit = np.divide(noisy, root, out=np.zeros_like(noisy), where=root > 0)
        parts.append(unit[:, :, None])
        where = np.append(where, total - 1)
    flat = np.concatenate(parts, axis=2).reshape(-1, len(where))
    Z = chain.Z.copy()
    Z[np.ix_(where, where)] += flat.T @ flat
    return LinearisedLog(
        chain,
        Z,
        np.concatenate(gains),
        tuple(stages),
        S,
        at.weight,
        at.residual,
        direct,
        at.noise[:, acting],
        at.beat_inflation,
        acting,
        columns,
        np.concatenate(processes) if processes else None,
        np.concatenate(inverses) if inverses else None,
    )


@dataclass(frozen=True)
class ProcessNoise:
    """What process noise does to a linearised log: G (N - 1, n, n_forced), scaled, by noise of unit variance."""

    G: np.ndarray
    inverse: np.ndarray

    def split(self, defect: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost of the noise in scaled defects (N - 1, n), and what no process noise makes (N - 1, n)."""
        w = (self.inverse @ defect[:, :, None])[:, :, 0]
        return float(np.sum(w**2)), defect - (self.G @ w[:, :, None])[:, :, 0]


def process_noise_of(linear: LinearisedLog) -> ProcessNoise | None:
    """Return the process noise of a linearised log; None if it was linearised without any."""
    return None if linear.process is None else ProcessNoise(linear.process, np.linalg.pinv(linear.process))


INITIAL_SPEED_STD = 0.05  # [m/s, rad/s]
INITIAL_ANGLE_STD = 0.1  # [rad, m]


def initial_std(space: StateSpace) -> np.ndarray:
    """Return the standard deviation (n,) of the first state about the filtered log, in its unit."""
    return np.where(
        np.isfinite(space.initial_std),
        space.initial_std,
        np.where(is_speed(space), INITIAL_SPEED_STD, INITIAL_ANGLE_STD),
    )


def is_speed(space: StateSpace) -> np.ndarray:
    """Tell which states (n,) are velocities."""
    n_q = len(space.model.coordinates)
    return (space.index >= n_q) & (space.index < 2 * n_q)


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
    probe = len(linear.chain.Z) - 1 - len(step)
    x, slope = linear.chain.states(np.concatenate([step, np.zeros(probe)]))
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
