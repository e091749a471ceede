"""Sensor noise in regression rows: by simulated readings of the filtered log, and by propagation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.logs import Log, Samples, decimate, kept_samples, lowpass, regression, samples
from excite.model import Model
from excite.model.machine import Filter, Sensor

REREADINGS = 6  # simulated readings of each log; chosen
MIN_ROW_NOISE = 1e-6  # smallest noise of a row, of the torques' size; chosen


@dataclass(frozen=True)
class FilteredNoise:
    """Error covariance (3 n_q, 3 n_q) of filtered, decimated (q, nu, a), and error variance (n_rows,) of Y."""

    motion: np.ndarray
    rows: np.ndarray


def measure_again(sensor: Sensor, exact: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """Simulate a reading (N,) of an exact signal: whole counts from a random start, or white noise of a level."""
    if sensor.resolution is not None:
        return (np.floor(exact / sensor.resolution + rng.uniform()) - 0.5) * sensor.resolution
    level = max(level, sensor.least_noise)
    return exact + level * rng.standard_normal(len(exact))


def simulate_rereadings(
    model: Model, log: Log, filter: Filter, count: int = REREADINGS, seed: int = 0
) -> Iterator[Log]:
    """Yield the filtered log as the truth, then `count` logs that its sensors would read from it.

    Noise is white, as found in the log; counts are those of the machine file.
    """
    rate = float(model.machine.sampling_hz)
    rng = np.random.default_rng(seed)
    present = [s for s in model.machine.sensors("full") if s.name in log.values]
    truth = {s.name: lowpass(log.values[s.name], rate, filter) for s in present}
    level = {s.name: log.white_noise(s.name) for s in present}
    yield Log(log.source, log.t, truth)
    for _ in range(count):
        yield Log(log.source, log.t, {s.name: measure_again(s, truth[s.name], level[s.name], rng) for s in present})


def row_errors(model: Model, log: Log, filter: Filter, count: int = REREADINGS) -> list[np.ndarray]:
    """Simulate the errors of [W Y], (n_rows, n, n_base + 1) for each of `count` readings."""
    rereadings = simulate_rereadings(model, log, filter, count)
    W0, Y0 = regression(model, samples(model, next(rereadings), filter), filter)
    errors = []
    for reading in rereadings:
        W, Y = regression(model, samples(model, reading, filter), filter)
        errors.append(np.concatenate([W - W0, (Y - Y0)[:, :, None]], axis=2))
    return errors


def filtered_noise(model: Model, log: Log, filter: Filter, count: int = REREADINGS) -> FilteredNoise:
    """Estimate the noise of the filtered motion and torques of a log, averaged over the log."""
    rereadings = simulate_rereadings(model, log, filter, count)
    first, last = filter.drop[0], len(log) - filter.drop[1]

    def motion(reading: Log) -> tuple[np.ndarray, np.ndarray]:
        s = samples(model, reading, filter)
        whole = np.concatenate([s.q, s.nu, s.a])[:, first:last]
        return decimate(whole, filter.decimation), decimate(s.Y[:, first:last], filter.decimation)

    q0, Y0 = motion(next(rereadings))
    motion_covariance, row_variance = np.zeros((len(q0), len(q0))), np.zeros(len(Y0))
    for reading in rereadings:
        q, Y = motion(reading)
        motion_covariance += (q - q0) @ (q - q0).T / (q.shape[1] * count)
        row_variance += ((Y - Y0) ** 2).mean(axis=1) / count
    return FilteredNoise(motion_covariance, row_variance)


def whitening_matrices(
    model: Model, motion: Samples, x: np.ndarray, noise: FilteredNoise, filter: Filter
) -> np.ndarray:
    """Compute L (n, n_rows, n_rows) that makes the errors of Y - W x white across rows and along the log.

    First order: errors of (q, nu, a) act through the prediction's slopes at x (n_base,). Rows with noisy slips get
    little weight, and combinations of rows in which a noisy speed cancels get much.
    """
    keep = kept_samples(filter.drop[0], motion.q.shape[1] - filter.drop[1], filter.decimation)
    n_rows = len(noise.rows)
    sample = [v[:, keep] for v in (motion.q, motion.nu, motion.a, *motion.beside)]
    J = _prediction_jacobian(model)(*sample, model.expand @ x).full()
    J = J.reshape(n_rows, len(keep), 3 * n_rows).transpose(1, 0, 2)
    row_variance = noise.rows + (MIN_ROW_NOISE * np.sqrt(np.mean(motion.Y**2))) ** 2
    covariance = J @ noise.motion @ J.transpose(0, 2, 1) + np.diag(row_variance)
    return np.linalg.inv(np.linalg.cholesky(covariance))


@lru_cache(maxsize=8)
def _prediction_jacobian(model: Model) -> ca.Function:
    """Build (q, nu, a, effect inputs, standard parameters) -> slopes (n_rows, 3 n_q) by (q, nu, a)."""
    q, nu, a = model.symbols()
    beside = model.effect_symbols()
    p = ca.SX.sym("p", len(model.base.standard))
    slope = ca.jacobian(model.predict(q, nu, a, p, *beside), ca.vertcat(q, nu, a))
    return ca.Function("slopes", [q, nu, a, *beside, p], [ca.densify(slope)], {"cse": True})


def row_levels(errors: Sequence[list[np.ndarray]], x: np.ndarray, used: Sequence[np.ndarray]) -> np.ndarray:
    """Level (n_rows,) of Y - W x from errors of [W Y], over the rows of all logs that are used, (n_rows, n) each.

    Near rest the sign of a noisy speed turns friction over: such rows tell nothing of the noise of others.
    """
    v = np.append(-x, 1.0)
    square = sum(((E @ v) ** 2 * own).sum(axis=1) for log, own in zip(errors, used, strict=True) for E in log)
    count = sum(own.sum(axis=1) * len(log) for log, own in zip(errors, used, strict=True))
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))
