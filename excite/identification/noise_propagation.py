"""What the sensors' noise makes of regression rows: by measuring the filtered log again, and by propagation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.logs import Log, Samples, decimate, kept_samples, lowpass, regression, samples, white_noise
from excite.model import Model
from excite.model.machine import Filter, Sensor

REREADINGS = 6  # times that a log is measured again
MIN_ROW_NOISE = 1e-6  # of the torques' size: no row is trusted further


@dataclass(frozen=True)
class FilteredNoise:
    """Covariance (3 n_q, 3 n_q) of the errors of filtered, decimated (q, nu, a), variance (n_rows,) of those of Y."""

    motion: np.ndarray
    rows: np.ndarray


def measure_again(sensor: Sensor, exact: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """A signal (N,) measured anew: whole counts from a random place between two edges, or white noise of a level."""
    if sensor.resolution is not None:
        return (np.floor(exact / sensor.resolution + rng.uniform()) - 0.5) * sensor.resolution
    return exact + level * rng.standard_normal(len(exact))


def simulate_rereadings(
    model: Model, log: Log, filter: Filter, count: int = REREADINGS, seed: int = 0
) -> Iterator[Log]:
    """First the filtered log, which counts as the truth, then `count` times what its sensors would have read: white
    noise as found in the log, counts as in the machine file."""
    rate = float(model.machine.sampling_hz)
    rng = np.random.default_rng(seed)
    present = [s for s in model.machine.sensors("full") if s.name in log.values]
    truth = {s.name: lowpass(log.values[s.name], rate, filter) for s in present}
    level = {s.name: white_noise(log.values[s.name]) for s in present}
    yield Log(log.source, log.t, truth)
    for _ in range(count):
        yield Log(log.source, log.t, {s.name: measure_again(s, truth[s.name], level[s.name], rng) for s in present})


def row_errors(model: Model, log: Log, filter: Filter, count: int = REREADINGS) -> list[np.ndarray]:
    """Errors of [W Y], (n_rows, n, n_base + 1) each, of `count` readings."""
    again = simulate_rereadings(model, log, filter, count)
    W0, Y0 = regression(model, samples(model, next(again), filter), filter)
    errors = []
    for reading in again:
        W, Y = regression(model, samples(model, reading, filter), filter)
        errors.append(np.concatenate([W - W0, (Y - Y0)[:, :, None]], axis=2))
    return errors


def filtered_noise(model: Model, log: Log, filter: Filter, count: int = REREADINGS) -> FilteredNoise:
    """How far the filtered motion and torques of a log are from the truth, on average over the log."""
    again = simulate_rereadings(model, log, filter, count)
    first, last = filter.drop[0], len(log) - filter.drop[1]

    def motion(reading: Log) -> tuple[np.ndarray, np.ndarray]:
        s = samples(model, reading, filter)
        whole = np.concatenate([s.q, s.nu, s.a])[:, first:last]
        return decimate(whole, filter.decimation), decimate(s.Y[:, first:last], filter.decimation)

    q0, Y0 = motion(next(again))
    P, R = np.zeros((len(q0), len(q0))), np.zeros(len(Y0))
    for reading in again:
        q, Y = motion(reading)
        P += (q - q0) @ (q - q0).T / (q.shape[1] * count)
        R += ((Y - Y0) ** 2).mean(axis=1) / count
    return FilteredNoise(P, R)


def whitening_matrices(model: Model, s: Samples, x: np.ndarray, noise: FilteredNoise, filter: Filter) -> np.ndarray:
    """L (n, n_rows, n_rows) that makes the errors of Y - W x white across rows and even along the log.

    First order: errors of (q, nu, a) act through the slopes of the prediction at x (n_base,). Where the machine hardly
    moves, slips are mostly noise and the rows they enter count little; combinations of rows in which a badly measured
    speed cancels count much.
    """
    keep = kept_samples(filter.drop[0], s.q.shape[1] - filter.drop[1], filter.decimation)
    n_rows = len(noise.rows)
    sample = [v[:, keep] for v in (s.q, s.nu, s.a, *s.beside)]
    J = _prediction_jacobian(model)(*sample, model.expand @ x).full()
    J = J.reshape(n_rows, len(keep), 3 * n_rows).transpose(1, 0, 2)
    least = noise.rows + (MIN_ROW_NOISE * np.sqrt(np.mean(s.Y**2))) ** 2
    C = J @ noise.motion @ J.transpose(0, 2, 1) + np.diag(least)
    return np.linalg.inv(np.linalg.cholesky(C))


@lru_cache(maxsize=8)
def _prediction_jacobian(model: Model) -> ca.Function:
    """(q, nu, a, beside, standard parameters) -> slopes (n_rows, 3 n_q) of the prediction by (q, nu, a)."""
    q, nu, a = model.symbols()
    beside = model.effect_symbols()
    p = ca.SX.sym("p", len(model.base.standard))
    slope = ca.jacobian(model.predict(q, nu, a, p, *beside), ca.vertcat(q, nu, a))
    return ca.Function("slopes", [q, nu, a, *beside, p], [ca.densify(slope)], {"cse": True})


def row_levels(errors: Sequence[list[np.ndarray]], x: np.ndarray) -> np.ndarray:
    """Level (n_rows,) of Y - W x that errors of [W Y] make, over all logs."""
    v = np.append(-x, 1.0)
    every = [(E @ v) ** 2 for log in errors for E in log]
    return np.sqrt(sum(e.sum(axis=1) for e in every) / sum(e.shape[1] for e in every))


def second_moments(errors: Sequence[list[np.ndarray]]) -> np.ndarray:
    """E'E (n_base + 1, n_base + 1) of errors of [W Y], summed over rows and logs, the mean over readings."""
    total = np.zeros((errors[0][0].shape[2],) * 2)
    for log in errors:
        for E in log:
            flat = E.reshape(-1, E.shape[2])
            total += flat.T @ flat / len(log)
    return total
