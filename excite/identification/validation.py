"""Validation on other data: predicted torques and simulated signals against measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from excite.identification.estimate import Estimate
from excite.identification.noise_propagation import REREADINGS, measure_again, simulate_rereadings
from excite.logs import BLOCK, Log, lowpass, samples
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import Motion, delivered_torques, exact_readings, simulate
from excite.smoothing import (
    Measurements,
    NotConvergedError,
    StateSpace,
    Trajectory,
    apply_step,
    build_state_space,
    common_sensors,
    fit_logs,
    initial_trajectory,
    linearise_logs,
    prepare_measurements,
    torque_sensor,
)
from excite.text import format_number

FAR_RATIO = 4.0  # ratio to the machine file's value, or its inverse, that is reported; chosen
NOTABLE_RATIO = 1.25  # of the residual to what is expected, beyond which a signal is not explained; chosen
FAR_STDS = 3.0  # distance from it that is significant [standard deviations]; chosen
SETTLING_PERIODS = 6.0  # of the cut-off at either end, in which the filter's transient is no error; measured on EMPS
MAX_NAMED = 4  # parameters in the note; chosen


@dataclass(frozen=True)
class SignalComparison:
    """Measured and predicted values (m, N) of m signals in their units, over t (N,) [s].

    noise, parameters (m, N): standard deviations of the residual by the sensors' noise, which also disturbs the
    prediction, and by the parameters' uncertainty; None if unknown. prediction_noise (m, N): standard deviation of the
    prediction alone by the sensors' noise, None if not computed.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    noise: np.ndarray | None = None
    parameters: np.ndarray | None = None
    prediction_noise: np.ndarray | None = None

    @property
    def expected(self) -> np.ndarray | None:
        """Standard deviation (m, N) of the residual if the model is right; None if unknown."""
        return None if self.noise is None or self.parameters is None else np.hypot(self.noise, self.parameters)

    def share_percent(self, deviation: np.ndarray) -> np.ndarray:
        """Size of a deviation (m, N) as `percent` gives the residual (m,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100 * np.linalg.norm(deviation, axis=1) / np.linalg.norm(self.measured, axis=1)

    def outside(self) -> list[tuple[str, float, float, float]]:
        """List signals whose residual is beyond what is expected: name, times [s] of the worst second, ratio in it."""
        expected = self.expected
        if expected is None:
            return []
        step = float(self.t[1] - self.t[0])
        width = max(1, min(round(1.0 / step), len(self.t)))
        found = []
        for name, e, s in zip(self.names, self.residual, expected, strict=True):
            if np.linalg.norm(e) <= NOTABLE_RATIO * np.linalg.norm(s):
                continue
            kernel = np.ones(width) / width
            ratio = np.sqrt(np.convolve(e**2, kernel, "valid") / np.convolve(s**2, kernel, "valid"))
            k = int(np.argmax(ratio))
            found.append((name, float(self.t[k]), float(self.t[k + width - 1]), float(ratio[k])))
        return found

    @property
    def residual(self) -> np.ndarray:
        """Measured minus predicted (m, N)."""
        return self.measured - self.predicted

    @property
    def percent(self) -> np.ndarray:
        """100 |measured - predicted| / |measured| (m,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100 * np.linalg.norm(self.residual, axis=1) / np.linalg.norm(self.measured, axis=1)

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the residual (m,), in the signal's unit."""
        return np.sqrt(np.mean(self.residual**2, axis=1))


@dataclass(frozen=True)
class SignalErrors:
    """Errors of m signals: rms (m,) in their units, and in per cent of what was measured (rms)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    rms: np.ndarray
    percent: np.ndarray


def compare_torques(model: Model, log: Log, estimate: Estimate, filter: Filter | None = None) -> SignalComparison:
    """Predict the torques of a log from its motion and compare them, both low-passed.

    Unidentifiable parameters have the machine file's values. Noisy slips make this test less sensitive than
    `compare_motions`: `noise` says how much of the residual they make, from simulated readings of the same motion,
    averaged over a second.
    """
    filter = filter or model.machine.filter
    plain = _filtered_torques(model, log, estimate, filter)
    first, *again = (
        _filtered_torques(model, one, estimate, filter) for one in simulate_rereadings(model, log, filter, REREADINGS)
    )
    compared = replace(
        plain,
        noise=_local_rms(model, [c.residual - first.residual for c in again]),
        parameters=_parameter_band(model, log, estimate, filter),
        prediction_noise=_local_rms(model, [c.predicted - first.predicted for c in again]),
    )
    return _with_discrepancy(model, estimate, compared)


def _with_discrepancy(model: Model, estimate: Estimate, compared: SignalComparison) -> SignalComparison:
    """Add what the model lacks, as an error of the prediction, to the noise of a comparison of torques."""
    lacks = np.zeros((len(model.inputs), 1))
    for k, body in enumerate(model.machine.actuated):
        own = [d.rms for d in estimate.discrepancy if d.signal == torque_sensor(model, body.index).name]
        lacks[k] = np.linalg.norm(own)
    if not lacks.any():
        return compared
    noise, own_noise = (None if x is None else np.hypot(x, lacks) for x in (compared.noise, compared.prediction_noise))
    return replace(compared, noise=noise, prediction_noise=own_noise)


def _settled(log: Log, filter: Filter, rate: float) -> slice:
    """Return the samples beyond the filter's transients at both ends, or those that it keeps of a short log."""
    settling = round(SETTLING_PERIODS * rate / float(filter.cutoff_hz))
    settling = settling if 4 * settling <= len(log) else 0
    return slice(max(filter.drop[0], settling), len(log) - max(filter.drop[1], settling))


def _local_rms(model: Model, errors: Sequence[np.ndarray]) -> np.ndarray:
    """Root mean square (m, N) of repeated errors (m, N) within a second."""
    width = max(1, round(float(model.machine.sampling_hz)))
    square = np.mean(np.square(errors), axis=0)
    return np.sqrt(np.maximum(scipy.ndimage.uniform_filter1d(square, width, axis=1), 0.0))


def validate_torques(
    model: Model, log: Log, estimate: Estimate, filter: Filter | None = None, prediction_noise: bool = False
) -> SignalComparison:
    """Compare the torques of a log that was not fitted with those that its smoothed motion needs.

    The states are smoothed with the parameters held at the estimate, so the noise of slips does not count as an error.
    Machines without slips, and logs that these parameters cannot follow, are compared by `compare_torques`.
    prediction_noise: smooth simulated readings of the smoothed motion as well, which gives the noise of the prediction,
    and that of the residual as the smoother leaves it; without, the residual's noise is the torque sensor's, an upper
    bound.
    """
    filter = filter or model.machine.filter
    if not model.slips or not np.isfinite(estimate.value).all():
        return compare_torques(model, log, estimate, filter)
    held = replace(model, nominal=estimate.value)
    space = build_state_space(held, common_sensors(held, [log]))
    try:
        data, start, trajectory = _smooth(space, log, filter)
        band = _smoothed_parameter_band(space, data, start, trajectory, estimate.total_covariance, filter)
        errors = _smoothing_errors(space, log, data, trajectory, filter) if prediction_noise else None
    except NotConvergedError:
        return compare_torques(model, log, estimate, filter)
    rate = float(model.machine.sampling_hz)
    impulse = np.zeros(len(log))
    impulse[len(log) // 2] = 1.0
    gain = float(np.linalg.norm(lowpass(impulse, rate, filter)))  # of white noise
    error = lowpass(trajectory.sampled_torque_error.T, rate, filter)
    measured = lowpass(data.torque.T, rate, filter)
    noise, own = errors or (np.broadcast_to(gain * data.noise.torque[:, None], error.shape), None)
    units = tuple(_torque_unit(model, k) for k in model.actuated)
    compared = SignalComparison(model.inputs, units, log.t, measured, measured + error, noise, band, own)
    return _with_discrepancy(model, estimate, compared)


def _smooth(space: StateSpace, log: Log, filter: Filter) -> tuple[Measurements, Trajectory, Trajectory]:
    """Smooth the states of a log with all parameters held; return start and result. Raises NotConvergedError."""
    data, X = prepare_measurements(space, log), space.model.nominal
    start = initial_trajectory(space, data, log, filter)
    fit = fit_logs(space, [data], [start], X, [start], np.ones(len(X), bool))
    if not fit.linear:
        fit.required()
    return data, start, fit.trajectories[0]


def _smoothed_parameter_band(
    space: StateSpace,
    data: Measurements,
    start: Trajectory,
    trajectory: Trajectory,
    covariance: np.ndarray,
    filter: Filter,
) -> np.ndarray:
    """Standard deviation (n_u, N) of smoothed, low-passed torques by the parameters' uncertainty.

    Each independent step of the parameters moves the most likely states, to first order, and with them the torques.
    Unlike `_parameter_band` it has neither the noise of slips nor the ends of the filter. Raises NotConvergedError.
    """
    X = space.model.nominal
    linear = linearise_logs(space, [data], [trajectory], [start], X)
    if linear is None:
        raise NotConvergedError("the smoothed motion can't be linearised")
    n, Z, rate = len(X), linear[0].Z[1:, 1:], float(space.model.machine.sampling_hz)
    offsets = -np.linalg.pinv(Z[n:, n:]) @ Z[n:, :n]  # most likely offsets of the encoders for a step of parameters
    still = apply_step(space, data, trajectory, linear[0], np.zeros(len(Z)), X).sampled_torque_error
    variance = np.zeros_like(still.T)
    for step in (covariance_root(covariance) / space.model.scale[:, None]).T:
        if step.any():
            moved = apply_step(space, data, trajectory, linear[0], np.concatenate([step, offsets @ step]), X)
            variance += lowpass((moved.sampled_torque_error - still).T, rate, filter) ** 2
    return np.sqrt(variance)


def _smoothing_errors(
    space: StateSpace, log: Log, data: Measurements, trajectory: Trajectory, filter: Filter
) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (n_u, N) of residual and prediction, low-passed, from simulated readings of a motion.

    Each of REREADINGS logs that the sensors would read along the trajectory is smoothed, and compared with the
    trajectory. Raises NotConvergedError.
    """
    model, rng = space.model, np.random.default_rng(0)
    u = space.delivered_torques(data.torque, model.nominal)[0] + trajectory.sampled_torque_error
    true = data.torque + trajectory.sampled_torque_error
    reading = space.readings(trajectory.state, space.inputs(u, trajectory.ground_inputs), model.nominal)[0]
    exact = {sensor.name: reading[:, j, 0] for j, sensor in enumerate(space.sensors)}
    exact |= {torque_sensor(model, b.index).name: true[:, k] for k, b in enumerate(model.machine.actuated)}
    present = [s for s in model.machine.sensors("full") if s.name in exact]
    level = {s.name: log.white_noise(s.name) for s in present}
    rate = float(model.machine.sampling_hz)
    residual, prediction = list[np.ndarray](), list[np.ndarray]()
    for _ in range(REREADINGS):
        values = {s.name: measure_again(s, exact[s.name], level[s.name], rng) for s in present}
        again, _, smoothed = _smooth(space, Log(log.source, log.t, values), filter)
        residual.append(lowpass(smoothed.sampled_torque_error.T, rate, filter))
        prediction.append(lowpass((again.torque + smoothed.sampled_torque_error - true).T, rate, filter))
    return _local_rms(model, residual), _local_rms(model, prediction)


def _parameter_band(model: Model, log: Log, estimate: Estimate, filter: Filter) -> np.ndarray:
    """Standard deviation (n_u, N) of predicted torques by the parameters' uncertainty."""
    motion = samples(model, log, filter)
    keep = _settled(log, filter, float(model.machine.sampling_hz))
    root = covariance_root(np.nan_to_num(estimate.total_covariance))
    band = []
    for row in model.actuated:
        parts = []
        for begin in range(0, motion.q.shape[1], BLOCK):
            block = slice(begin, begin + BLOCK)
            W = model.stacked_regressor(*(x[:, block] for x in (motion.q, motion.nu, motion.a, *motion.beside)))
            parts.append(np.linalg.norm(W[:, row] @ root, axis=1))
        band.append(np.concatenate(parts)[keep])
    return np.array(band)


def covariance_root(covariance: np.ndarray) -> np.ndarray:
    """Return R (n, n) with R R' = covariance, positive semi-definite: columns are independent steps of one sigma."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0))
    unit = np.where(size > 0, size, 1.0)
    variance, v = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray(unit[:, None] * v * np.sqrt(np.maximum(variance, 0)))


def _filtered_torques(model: Model, log: Log, estimate: Estimate, filter: Filter) -> SignalComparison:
    """Predict low-passed torques and compare them with the measured ones."""
    rate = float(model.machine.sampling_hz)
    motion = samples(model, log, filter)
    p = model.expand @ estimate.value_or(model.nominal)
    rows = list(model.actuated)
    predicted = model.predict(motion.q, motion.nu, motion.a, p, *motion.beside).full()[rows]
    units = tuple(_torque_unit(model, k) for k in rows)
    keep = _settled(log, filter, rate)
    measured, predicted = lowpass(motion.Y[rows], rate, filter), lowpass(predicted, rate, filter)
    return SignalComparison(model.inputs, units, log.t[keep], measured[:, keep], predicted[:, keep])


def torque_errors(model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter) -> SignalErrors:
    """Return the error of an estimate by joint, on the rows that it was fitted to."""
    rate, rows = float(model.machine.sampling_hz), list(model.actuated)
    measured = np.concatenate(
        [lowpass(samples(model, log, filter).Y[rows], rate, filter)[:, _settled(log, filter, rate)] for log in logs],
        axis=1,
    )
    rms = np.sqrt(np.mean(estimate.residual[rows] ** 2, axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = 100 * rms / np.sqrt(np.mean(measured**2, axis=1))
    return SignalErrors(
        tuple(b.where for b in model.machine.actuated), tuple(_torque_unit(model, k) for k in rows), rms, percent
    )


def _torque_unit(model: Model, row: int) -> str:
    turns = model.coordinates[row].startswith("theta")
    return model.machine.torque_unit or ("N m" if turns else "N")


def far_from_nominal(model: Model, estimate: Estimate) -> tuple[str, ...]:
    """Describe parameters that differ significantly from the machine file's values in sign, or in size by FAR_RATIO.

    Offsets are left out.
    """
    nominal = model.nominal
    is_offset = np.abs(model.offsets).sum(axis=0) > 0
    effects = {name for e in model.effects for name in e.parameters}
    from_file = np.array([name not in effects for name in model.base.names])
    comparable = np.isfinite(estimate.value) & from_file & ~is_offset & (nominal != 0)
    significant = np.abs(estimate.value - nominal) > FAR_STDS * estimate.std
    ratio = np.divide(estimate.value, nominal, out=np.ones_like(nominal), where=comparable)
    far = [k for k in np.flatnonzero(comparable & significant) if not 1 / FAR_RATIO < ratio[k] < FAR_RATIO]
    if not far:
        return ()
    worst = sorted(far, key=lambda k: -abs(np.log(max(ratio[k], 1e-12))))[:MAX_NAMED]
    listed = ", ".join(
        f"{estimate.names[k]} {format_number(estimate.value[k])} ({format_number(nominal[k])}) {estimate.units[k]}"
        for k in worst
    )
    rest = f" and {len(far) - len(worst)} more" if len(far) > len(worst) else ""
    return (
        f"{estimate.method}: far from the machine file's values (in brackets): {listed}{rest}; check columns, units and"
        " signs, and compare another --method",
    )


def simulate_open_loop(model: Model, log: Log, X: np.ndarray, filter: Filter | None = None) -> Motion:
    """Simulate the machine X (n_base,) under the log's torques from the log's first state. Raises SimulationError."""
    initial = samples(model, log, filter or model.machine.filter)
    channels = [x.full() for x in model.channels(log.t[None], X)]
    torque = delivered_torques(log.t, initial.Y[list(model.actuated)].T, channels)
    return simulate(model, torque, X, initial.q[:, 0], initial.nu[:, 0])


def compare_motions(model: Model, log: Log, estimate: Estimate, filter: Filter | None = None) -> SignalComparison:
    """Simulate the log's torques in open loop from its first state, and compare every signal except torques.

    Angles count from their first reading. Errors of torques and parameters accumulate, as in use. Raises ValueError if
    a parameter is unknown, SimulationError if the parameters are no machine.
    """
    unknown = [n for n, v in zip(estimate.names, estimate.value, strict=True) if not np.isfinite(v)]
    if unknown:
        raise ValueError(f"a simulation needs every parameter, unknown: {', '.join(unknown)}")
    X = estimate.value
    motion = simulate_open_loop(model, log, X, filter)
    exact = exact_readings(model, motion, X)
    sensors = [x for x in model.machine.sensors("full") if x.name in log.values and x.kind not in ("torque", "x", "y")]
    is_angle = {x.name: x.kind in ("angle", "wheel") and not x.is_rate for x in sensors}

    def counted(name: str, v: np.ndarray) -> np.ndarray:
        return v - v[0] if is_angle[name] else v

    return SignalComparison(
        tuple(x.name for x in sensors),
        tuple(model.machine.si_unit(x) for x in sensors),
        log.t,
        np.array([counted(x.name, log.values[x.name]) for x in sensors]),
        np.array([counted(x.name, exact[x.name]) for x in sensors]),
    )
