"""Instrumental variables: regressors along a simulated motion, which are independent of the sensors' noise.

The machine of the current estimate is simulated under the log's torques, and an observer pulls it towards the measured
speeds, slowly enough to reject their noise. Estimate and instruments are iterated (Janot, Vandanjon and Gautier, "A
generic instrumental variable approach for industrial robot identification", IEEE TCST 22, 2014, with the observer in
place of their controller).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from excite.errors import NotIdentifiableError, SimulationError
from excite.identification.estimate import Estimate
from excite.identification.identifiability import rest_projection
from excite.identification.linear_methods import (
    Block,
    build_estimate,
    effective_degrees,
    project_blocks,
    residual,
    robust_covariance,
    rows_in_motion,
    rows_to_trust,
    solve_blocks,
    whiten_block,
)
from excite.identification.near_rest import leave_out
from excite.identification.noise_propagation import FilteredNoise, filtered_noise, whitening_matrices
from excite.logs import Log, Samples, lowpass, regression, samples, unmeasured
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import simulate
from excite.text import format_number

OBSERVER_TIME = 4.0  # time constant of the observer [s]; chosen
MAX_PASSES = 30  # of the iteration; chosen
CONVERGED_STEP = 0.02  # largest step at the end [standard deviations]; chosen
CORRECTION_INTERVAL = 0.1  # between two corrections by the observer [s]; chosen
OBSERVED_SPEED_STD = 0.01  # of a speed that no sensor measures [m/s, rad/s]; chosen
OBSERVED_ACCELERATION_STD = 0.02  # [m/s2, rad/s2]; chosen
MAX_HALVINGS = 6  # of a step to a machine that cannot be simulated; chosen


def iv(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by instrumental variables, from the machine file's values.

    Solves Z'(Y - W X) = 0 with Z the regressor along the observed motion. It is consistent if the noise of W is
    independent of Z. A speed that no sensor measures (V_y with kit `paper`) is the observed one in W too. Rows are
    whitened at the current estimate (see `whitening_matrices`). Standard deviations account for autocorrelation.

    Raises NotIdentifiableError if the iteration does not converge, or leads to a machine that cannot be simulated.
    """
    measured = [samples(model, log, filter) for log in logs]
    unmeasured_rows = [unmeasured(model, log) for log in logs]
    noise = [
        _add_observer_error(filtered_noise(model, log, filter), rows)
        for log, rows in zip(logs, unmeasured_rows, strict=True)
    ]
    if any(unmeasured_rows):
        measured = [
            _fill_observed(s, observe(model, s, model.nominal, filter, rows), rows)
            for s, rows in zip(measured, unmeasured_rows, strict=True)
        ]
    projection = rest_projection(model, logs, filter, motions=measured)
    blocks = project_blocks([regression(model, s, filter) for s in measured], projection)
    moving, notes = rows_in_motion(model, blocks, rows_to_trust(model, logs, filter, blocks))
    initial = solve_blocks(leave_out(blocks, moving), model.scale)
    kept = list(initial.kept)
    x, step = model.nominal.copy(), np.full(len(model.nominal), np.nan)
    for _ in range(MAX_PASSES):
        observed, x = _observe_logs(model, measured, unmeasured_rows, x, step, filter)
        if any(unmeasured_rows):
            measured = [
                _fill_observed(s, o, rows) for s, o, rows in zip(measured, observed, unmeasured_rows, strict=True)
            ]
            blocks = project_blocks([regression(model, s, filter) for s in measured], projection)
        whitening = [whitening_matrices(model, s, x, n, filter) for s, n in zip(observed, noise, strict=True)]
        simulated_blocks = project_blocks([regression(model, s, filter) for s in observed], projection)
        simulated_blocks = leave_out(simulated_blocks, moving)
        Z = [whiten_block(b, L)[0] for b, L in zip(simulated_blocks, whitening, strict=True)]
        whitened = [whiten_block(b, L) for b, L in zip(leave_out(blocks, moving), whitening, strict=True)]
        proposed, covariance = _solve_instruments(model, whitened, Z, kept, x)
        step = proposed - x
        x = proposed
        ratio = np.abs(step[kept]) / np.sqrt(np.diag(covariance))
        if ratio.max() < CONVERGED_STEP:
            return build_estimate(
                model,
                blocks,
                initial,
                "iv",
                x,
                covariance,
                effective_degrees(solve_blocks(whitened, model.scale), covariance),
                notes,
            )
    worst = kept[int(np.argmax(ratio))]
    raise NotIdentifiableError(
        f"iv: no estimate reproduces itself after {MAX_PASSES} passes, {model.base.names[worst]} still moves by"
        f" {format_number(abs(step[worst]), 3)}: start from better values in the machine file, or record a drive with"
        " more excitation"
    )


def _observe_logs(
    model: Model,
    logs: Sequence[Samples],
    unmeasured_rows: Sequence[Sequence[int]],
    x: np.ndarray,
    step: np.ndarray,
    filter: Filter,
) -> tuple[list[Samples], np.ndarray]:
    """Observed motions of the logs and their parameters; the step to x is halved until x can be simulated."""
    for _ in range(MAX_HALVINGS):
        try:
            return [observe(model, s, x, filter, rows) for s, rows in zip(logs, unmeasured_rows, strict=True)], x
        except SimulationError:
            if np.isnan(step).any():
                break
            step = step / 2
            x = x - step
    raise NotIdentifiableError(
        "iv: the iteration leads to a machine that cannot be simulated: start from better values in the machine file"
    )


def _add_observer_error(noise: FilteredNoise, rows: Sequence[int]) -> FilteredNoise:
    """Add the error of speeds that are observed instead of measured."""
    covariance, n = noise.motion.copy(), len(noise.rows)
    for k in rows:
        covariance[n + k, n + k] += OBSERVED_SPEED_STD**2
        covariance[2 * n + k, 2 * n + k] += OBSERVED_ACCELERATION_STD**2
    return FilteredNoise(covariance, noise.rows)


def _fill_observed(s: Samples, observed: Samples, rows: Sequence[int]) -> Samples:
    """Samples with speeds and accelerations of some coordinates taken from the observed motion."""
    nu, a = s.nu.copy(), s.a.copy()
    nu[list(rows)], a[list(rows)] = observed.nu[list(rows)], observed.a[list(rows)]
    return Samples(s.q, nu, a, s.Y)


def _solve_instruments(
    model: Model, blocks: Sequence[Block], Z: Sequence[np.ndarray], kept: list[int], x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve Z'(Y - W x) = 0 for x (n_base,); return x and the covariance (k, k) of the kept parameters."""
    instruments = np.concatenate([z[:, :, kept].reshape(-1, len(kept)) for z in Z])
    W = np.concatenate([w[:, :, kept].reshape(-1, len(kept)) for w, _ in blocks])
    fixed = x.copy()
    fixed[kept] = 0.0
    y = np.concatenate([residual(b, fixed).reshape(-1) for b in blocks])
    size = np.linalg.norm(instruments, axis=0)
    if not (size > 0).all():
        raise NotIdentifiableError("iv: one of the parameters has no effect along the simulated motion")
    Q, R = np.linalg.qr(instruments / size)
    A = Q.T @ W
    found = x.copy()
    found[kept] = np.linalg.solve(A, Q.T @ y)
    half = np.linalg.solve(A, scipy.linalg.solve_triangular(R, np.diag(1 / size), trans="T"))
    return found, robust_covariance(model, half, blocks, found, kept, Z)


def observe(model: Model, s: Samples, x: np.ndarray, filter: Filter, unmeasured_rows: Sequence[int] = ()) -> Samples:
    """Simulate the machine x (n_base,) under a log's low-passed torques, pulled towards the log's motion.

    The pull has time constant OBSERVER_TIME and leaves out `unmeasured_rows`. Raises SimulationError.
    """
    rate = float(model.machine.sampling_hz)
    interval = max(1, round(CORRECTION_INTERVAL * rate))
    gain = np.full(len(s.q), 1 - np.exp(-interval / rate / OBSERVER_TIME))
    gain[list(unmeasured_rows)] = 0.0
    torque = lowpass(s.Y[list(model.actuated)], rate, filter).T - model.offsets @ x
    q, nu = s.q[:, 0].copy(), s.nu[:, 0].copy()
    N = s.q.shape[1]
    positions, speeds, slopes = np.empty((3, *s.q.shape))
    for begin in range(0, N - 1, interval):
        end = min(begin + interval, N - 1)
        motion = simulate(model, torque[begin : end + 1], x, q, nu)
        positions[:, begin : end + 1], speeds[:, begin : end + 1] = motion.q.T, motion.nu.T
        slopes[:, begin : end + 1] = motion.a.T
        q = motion.q[-1] + gain * (s.q[:, end] - motion.q[-1])
        nu = motion.nu[-1] + gain * (s.nu[:, end] - motion.nu[-1])
    return Samples(positions, speeds, slopes, s.Y)
