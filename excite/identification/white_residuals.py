"""White residuals of an estimate along a log, with the signatures of parameters and of torque errors.

Whatever the method, the states of a log are smoothed with the parameters held at the estimate. The innovations of that
smoothing are white with variance one if estimate, model and noise are right. Every parameter, and every torque error of
a given course, has a signature in them, filtered the same way. Neither encoder counts that beat with the clock nor
torques that are linear between noisy readings are white noise to the last digit, so the innovations that noise gives
are simulated along the same motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.identification.noise_propagation import MIN_ROW_NOISE, row_errors
from excite.logs import Log, decimate, derivative, kept_samples, lowpass, regression, samples
from excite.model import Model
from excite.model.machine import Filter
from excite.smoothing import (
    Measurements,
    NotConvergedError,
    Settings,
    StateSpace,
    Trajectory,
    build_state_space,
    common_sensors,
    fit_logs,
    initial_trajectory,
    linearise_logs,
    prepare_measurements,
    smoothed_motion,
    state_scale,
    torque_sensor,
    transfer_trajectory,
    whiten,
    whiten_signatures,
)

SIMULATIONS = 8  # simulated noises of a log; chosen
SMOOTHED = Settings(passes=10, tolerance=0.3)  # states to well below a standard deviation

Courses = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class WhiteResiduals:
    """White residuals of one log, N samples of m sensors.

    source: of the log. names (m,): of the sensors. counted (m,): encoders, whose errors are correlated by themselves.
    t (N,) [s]. used (N, m). z (N, m): residuals.
    noise (N, m, B): residuals of simulated noise.
    parameters (N, m, n), offsets (N, m, n_o): signatures of one scale of each parameter, and of one count of each
    encoder offset, whose standard deviation that is.
    courses (N, m, C): signatures of torque errors torque_error (N, C) [N m].
    misfit (n_u,) [N m]: low-passed torque errors (rms).
    noise_in_columns (n, n): products of the errors that noise makes in the signatures; zero where it makes none.
    """

    source: str
    names: tuple[str, ...]
    counted: np.ndarray
    t: np.ndarray
    used: np.ndarray
    z: np.ndarray
    noise: np.ndarray
    parameters: np.ndarray
    offsets: np.ndarray
    courses: np.ndarray
    torque_error: np.ndarray
    misfit: np.ndarray
    noise_in_columns: np.ndarray


def white_residuals(
    model: Model, log: Log, filter: Filter, courses: Courses, near: tuple[StateSpace, Trajectory] | None = None
) -> WhiteResiduals:
    """Smooth a log with all parameters held at the nominal values, and whiten residuals and signatures.

    courses: function of the motion q, nu, a (N, n_q) and the low-passed torques u (N, n_u) that returns torque errors
    (N, n_u, C) [N m] of each drive. near: a trajectory to start from, and its state space. Raises NotConvergedError if
    no motion of the machine follows the log.
    """
    X = model.nominal
    space = build_state_space(model, common_sensors(model, [log]))
    data = prepare_measurements(space, log, unbiased=True)
    start = initial_trajectory(space, data, log, filter)
    begin = start if near is None else transfer_trajectory(space, data, near[1], near[0], X)
    fit = fit_logs(space, [data], [begin], X, [start], np.ones(len(X), bool), settings=SMOOTHED)
    trajectory = (fit if fit.linear else fit.required()).trajectories[0]
    found = linearise_logs(space, [data], [trajectory], [start], X)
    if found is None:
        raise NotConvergedError("the smoothed motion can't be linearised")
    chain, n, n_o = found[0], len(X), len(data.offset_sensors)
    white = whiten(chain)
    rate = float(model.machine.sampling_hz)
    q, nu, _, u, a = smoothed_motion(space, data, trajectory, X)
    errors = courses(q, nu, lowpass(a.T, rate, filter).T, lowpass(u.T, rate, filter).T)
    torques, fall, readings = _simulated_noise(space, data, trajectory, X)
    C = errors.shape[2]
    inverse = np.concatenate([1 / chain.noise, np.zeros((1, chain.noise.shape[1]))])
    gain = np.concatenate([chain.gain, np.zeros((1, *chain.gain.shape[1:]))])
    farther = _farther(space)

    def signatures(own: slice) -> tuple[np.ndarray, np.ndarray]:
        push = gain[own] @ (np.concatenate([errors[own], torques[own]], axis=2) * inverse[own, :, None])
        push[:, :, C:] += farther @ gain[own] @ (fall[own] * inverse[own, :, None])
        return push, np.concatenate([np.zeros((len(push), white.E.shape[1], C)), readings[own]], axis=2)

    filtered = np.zeros((*white.E.shape[:2], C + SIMULATIONS), np.float32)
    for own, made in whiten_signatures(chain, white, signatures):
        filtered[own] = made
    return WhiteResiduals(
        log.source,
        tuple(s.name for s in space.sensors),
        data.read_at_edges,
        log.t,
        chain.weight > 0,
        white.E[:, :, 0],
        filtered[:, :, C:],
        white.E[:, :, 1 : 1 + n],
        white.E[:, :, 1 + n : 1 + n + n_o],
        filtered[:, :, :C],
        errors.sum(axis=1),
        np.sqrt(np.mean(lowpass(trajectory.sampled_torque_error.T, rate, filter) ** 2, axis=1)),
        np.zeros((n, n)),
    )


def with_channels(
    model: Model, log: Log, filter: Filter, courses: Courses, gains: Sequence[tuple[int, float]], lacking: np.ndarray
) -> WhiteResiduals:
    """Whiten what is left of a log beyond the torques that a discrepancy explains, at the nominal values.

    gains: drive and standard deviation of the gains of torque channels that stand behind the parameters.
    lacking (n_u, N): torque read that the discrepancy explains. Raises NotConvergedError.
    """
    names = [torque_sensor(model, b.index).name for b in model.machine.actuated]
    values = {**log.values, **{s: log.values[s] - x for s, x in zip(names, lacking, strict=True)}}

    def with_gains(q: np.ndarray, nu: np.ndarray, a: np.ndarray, u: np.ndarray) -> np.ndarray:
        errors = np.zeros((*u.shape, len(gains)))
        for column, (drive, std) in enumerate(gains):
            errors[:, drive, column] = -std * u[:, drive]
        return np.concatenate([courses(q, nu, a, u), errors], axis=2)

    found = white_residuals(model, replace(log, values=values), filter, with_gains)
    own = slice(0, found.courses.shape[2] - len(gains))
    return replace(
        found,
        parameters=np.concatenate([found.parameters, found.courses[:, :, own.stop :]], axis=2),
        courses=found.courses[:, :, own],
        torque_error=found.torque_error[:, own],
    )


def row_residuals(
    model: Model,
    log: Log,
    X: np.ndarray,
    filter: Filter,
    courses: Courses,
    channels: Sequence[tuple[int, str, float]],
    innovations: np.ndarray | None = None,
) -> WhiteResiduals:
    """Take the filtered rows of the driven joints as white residuals, or the innovations that a method has.

    channels: drive, effect and standard deviation of errors of torque channels that stand behind the parameters.
    innovations (n_u, N): of every sample. They are smoothed, so that nothing is said of their whiteness.
    """
    if innovations is not None:
        filter = filter.model_copy(update={"decimation": 1, "drop": (0, 0)})
    at, rate = replace(model, nominal=X), float(model.machine.sampling_hz)
    motion, drives = samples(at, log, filter), list(model.actuated)
    W, Y = (x[drives] for x in regression(at, motion, filter))
    keep = slice(filter.drop[0], len(log) - filter.drop[1])
    needed = at.predict(motion.q, motion.nu, motion.a, at.expand @ X, *motion.beside).full()[drives]
    needed = lowpass(needed, rate, filter)
    errors = courses(motion.q.T, motion.nu.T, motion.a.T, needed.T)[keep].transpose(1, 0, 2)
    errors = decimate(errors, filter.decimation)
    signals = {"channel_delay": -derivative(needed, rate), "torque_gain": needed}
    by_channel = np.zeros((*Y.shape, len(channels)))
    for column, (drive, effect, std) in enumerate(channels):
        by_channel[drive, :, column] = std * decimate(signals[effect][drive : drive + 1, keep], filter.decimation)
    residual = Y - W @ X
    if innovations is None:
        every = [E[drives] for E in row_errors(at, log, filter, SIMULATIONS)]
        noise = np.stack([E @ np.append(-X, 1.0) for E in every], axis=2)
        level = np.sqrt(np.mean(noise**2, axis=(1, 2))) + MIN_ROW_NOISE * np.sqrt(np.mean(Y**2))
    else:
        every, level = [np.zeros((*Y.shape, len(X) + 1))], np.sqrt(np.mean(residual**2, axis=1))
        residual = innovations / np.sqrt(np.mean(innovations**2, axis=1, keepdims=True)) * level[:, None]
        noise = np.random.default_rng(0).standard_normal((*Y.shape, SIMULATIONS)) * level[:, None, None]

    scaled = [(E[:, :, :-1] * model.scale / level[:, None, None]).reshape(-1, len(X)) for E in every]

    def over_noise(x: np.ndarray) -> np.ndarray:
        return np.asarray((x / level[:, None, None]).transpose(1, 0, 2))

    return WhiteResiduals(
        log.source,
        model.inputs,
        np.zeros(len(model.inputs), bool),
        log.t[kept_samples(filter.drop[0], len(log) - filter.drop[1], filter.decimation)],
        np.full(residual.T.shape, innovations is None),
        over_noise(residual[:, :, None])[:, :, 0],
        over_noise(noise),
        over_noise(-np.concatenate([W * model.scale, by_channel], axis=2)),
        np.zeros((*residual.T.shape, 0)),
        over_noise(-errors),
        errors.sum(axis=0),
        np.sqrt(np.mean(residual**2, axis=1)),
        np.mean([E.T @ E for E in scaled], axis=0),
    )


def _farther(space: StateSpace) -> np.ndarray:
    """Return how much farther joints get where a torque falls by 1 within an interval than where it stays at its mean.

    (n, n), by the speeds that a constant torque of 1 gives in the interval; of scaled states. A constant torque moves a
    joint by half its change of speed times the interval; one that falls by 1 about the same mean, by a twelfth more.
    """
    scale, at, n_q = state_scale(space), list(space.index), len(space.model.coordinates)
    farther = np.zeros((space.n, space.n))
    for row, coordinate in enumerate(at):
        if coordinate < n_q and coordinate + n_q in at:
            speed = at.index(coordinate + n_q)
            farther[row, speed] = scale[speed] / scale[row] / (12 * float(space.model.machine.sampling_hz))
    return farther


def _simulated_noise(
    space: StateSpace, data: Measurements, trajectory: Trajectory, X: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate noise along a motion: of torques in each interval (N, n_u, B) [N m], and of readings (N, m, B).

    Of a torque error, its mean in the interval, and how far it falls within.

    An encoder counts from a random start. Where an edge falls on another sample than in the log, the nearest one lends
    its error.
    """
    rng = np.random.default_rng(0)
    N, m = data.reading.shape
    u = space.delivered_torques(data.torque, X)[0] + trajectory.sampled_torque_error
    angle = space.readings(trajectory.state, space.inputs(u, trajectory.ground_inputs), X)[0][:, :, 0]
    readings = rng.standard_normal((N, m, SIMULATIONS)) * data.noise.sensor[:, None]
    for j in np.flatnonzero(data.read_at_edges):
        for b in range(SIMULATIONS):
            readings[:, j, b] = _edge_errors(angle[:, j], data.noise.sensor[j], rng.uniform())
    at_samples = rng.standard_normal((N + 1, data.torque.shape[1], SIMULATIONS)) * data.noise.torque[:, None]
    return (at_samples[1:] + at_samples[:-1]) / 2, at_samples[:-1] - at_samples[1:], readings


def _edge_errors(angle: np.ndarray, count: float, start: float) -> np.ndarray:
    """Errors (N,) of the edges of an encoder along an angle (N,), each taken as passed half a sample ago."""
    counts = np.floor(angle / count + start)
    change = np.diff(counts, prepend=counts[0])
    edges = np.flatnonzero(change)
    if not len(edges):
        return np.zeros(len(angle))
    travel = np.clip(np.gradient(angle), -count, count)
    error = (counts + (change < 0) - start) * count - (angle - travel / 2)
    samples = np.arange(len(angle))
    after = np.clip(np.searchsorted(edges, samples), 0, len(edges) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(samples - edges[before] < edges[after] - samples, before, after)
    return np.asarray(error[edges[nearest]])
