"""Instrumental variables: regressors along a simulated motion, which know nothing of the sensors' noise.

The current estimate drives the log's torques; an observer pulls its speeds towards the measured ones, slowly enough to
leave their noise behind. Iterated: better parameters, better motion, better instruments (Janot, Vandanjon and Gautier,
"A generic instrumental variable approach for industrial robot identification", IEEE TCST 22, 2014, with the observer
in place of their controller).
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
    solve_blocks,
    total_scores_covariance,
    whiten_block,
)
from excite.identification.noise_propagation import FilteredNoise, filtered_noise, whitening_matrices
from excite.logs import Log, Samples, lowpass, regression, samples, unmeasured
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import simulate

OBSERVER_TIME = 4.0  # time constant of the observer [s]
MAX_PASSES = 30  # of the iteration, at most
CONVERGED_STEP = 0.02  # a step this small against the standard deviation ends it
CORRECTION_INTERVAL = 0.1  # between two corrections by the observer [s]
OBSERVED_SPEED_STD = 0.01  # error of an observed speed that nothing measures [m/s, rad/s]
OBSERVED_ACCELERATION_STD = 0.02  # and of its slope, per second
MAX_HALVINGS = 6  # times that a step is halved where the machine it leads to can't be simulated


def iv(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Instrumental variables, from the machine file's values.

    Z'(Y - W X) = 0 with Z the regressor along the observed motion: consistent where W's noise has nothing to do with
    Z's. A speed that no sensor measures, V_y with kit `paper`, is the observed one in W too. Rows are made white at the
    current estimate, along the observed motion (see `whitener`). Deviations account for autocorrelation. Raises
    NotIdentifiable where the iteration finds no machine that can be simulated, or none that reproduces itself.
    """
    measured = [samples(model, log, filter) for log in logs]
    unseen = [unmeasured(model, log) for log in logs]
    noise = [
        _add_observer_error(filtered_noise(model, log, filter), rows) for log, rows in zip(logs, unseen, strict=True)
    ]
    if any(unseen):
        measured = [
            _fill_observed(s, observe(model, s, model.nominal, filter, rows), rows)
            for s, rows in zip(measured, unseen, strict=True)
        ]
    rest = rest_projection(model, logs, filter, motions=measured)
    blocks = project_blocks([regression(model, s, filter) for s in measured], rest)
    first = solve_blocks(blocks, model.scale)
    kept = list(first.kept)
    x, step = model.nominal.copy(), np.full(len(model.nominal), np.nan)
    for _ in range(MAX_PASSES):
        seen, x = _observe_logs(model, measured, unseen, x, step, filter)
        if any(unseen):
            measured = [_fill_observed(s, o, rows) for s, o, rows in zip(measured, seen, unseen, strict=True)]
            blocks = project_blocks([regression(model, s, filter) for s in measured], rest)
        turned = [whitening_matrices(model, s, x, n, filter) for s, n in zip(seen, noise, strict=True)]
        ahead = project_blocks([regression(model, s, filter) for s in seen], rest)
        Z = [whiten_block(b, L)[0] for b, L in zip(ahead, turned, strict=True)]
        own = [whiten_block(b, L) for b, L in zip(blocks, turned, strict=True)]
        found, covariance = _solve_instruments(own, Z, kept, x)
        step = found - x
        x = found
        ratio = np.abs(step[kept]) / np.sqrt(np.diag(covariance))
        if ratio.max() < CONVERGED_STEP:
            return build_estimate(
                model,
                blocks,
                first,
                "iv",
                x,
                covariance,
                effective_degrees(solve_blocks(own, model.scale), covariance),
                (),
            )
    worst = kept[int(np.argmax(ratio))]
    raise NotIdentifiableError(
        f"iv: no estimate reproduces itself after {MAX_PASSES} passes, {model.base.names[worst]} still moves by"
        f" {abs(step[worst]):.3g}: start from better values in the machine file, or drive more lively"
    )


def _observe_logs(
    model: Model,
    logs: Sequence[Samples],
    unseen: Sequence[Sequence[int]],
    x: np.ndarray,
    step: np.ndarray,
    filter: Filter,
) -> tuple[list[Samples], np.ndarray]:
    """The observed motion of each log and the parameters behind it: x, or short of it where x is no machine."""
    for _ in range(MAX_HALVINGS):
        try:
            return [observe(model, s, x, filter, rows) for s, rows in zip(logs, unseen, strict=True)], x
        except SimulationError:
            if np.isnan(step).any():
                break
            step = step / 2
            x = x - step
    raise NotIdentifiableError(
        "iv: the machine that it leads to can't be simulated; start from better values in the machine file"
    )


def _add_observer_error(noise: FilteredNoise, rows: Sequence[int]) -> FilteredNoise:
    """The spread of a log, some of whose speeds are observed only."""
    P, n = noise.motion.copy(), len(noise.rows)
    for k in rows:
        P[n + k, n + k] += OBSERVED_SPEED_STD**2
        P[2 * n + k, 2 * n + k] += OBSERVED_ACCELERATION_STD**2
    return FilteredNoise(P, noise.rows)


def _fill_observed(s: Samples, observed: Samples, rows: Sequence[int]) -> Samples:
    """Samples with the speeds and accelerations of some coordinates taken from the observed motion."""
    nu, a = s.nu.copy(), s.a.copy()
    nu[list(rows)], a[list(rows)] = observed.nu[list(rows)], observed.a[list(rows)]
    return Samples(s.q, nu, a, s.Y)


def _solve_instruments(
    blocks: Sequence[Block], Z: Sequence[np.ndarray], kept: list[int], x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """x (n_base,) of Z'(Y - W x) = 0, and the covariance (k, k) of the kept parameters."""
    tall = np.concatenate([z[:, :, kept].reshape(-1, len(kept)) for z in Z])
    W = np.concatenate([w[:, :, kept].reshape(-1, len(kept)) for w, _ in blocks])
    given = x.copy()
    given[kept] = 0.0
    y = np.concatenate([residual(b, given).reshape(-1) for b in blocks])
    size = np.linalg.norm(tall, axis=0)
    if not (size > 0).all():
        raise NotIdentifiableError("iv: along the simulated motion nothing depends on one of the parameters")
    Q, R = np.linalg.qr(tall / size)
    A = Q.T @ W
    found = x.copy()
    found[kept] = np.linalg.solve(A, Q.T @ y)
    half = np.linalg.solve(A, scipy.linalg.solve_triangular(R, np.diag(1 / size), trans="T"))
    return found, half @ total_scores_covariance(blocks, found, kept, Z) @ half.T


def observe(model: Model, s: Samples, x: np.ndarray, filter: Filter, unseen: Sequence[int] = ()) -> Samples:
    """The motion of the machine x (n_base,) under a log's low-passed torques, drawn towards the log's speeds and joint
    angles with time constant PULL [s], but for coordinates `unseen`. Raises SimulationError."""
    rate = float(model.machine.sampling_hz)
    stretch = max(1, round(CORRECTION_INTERVAL * rate))
    gain = np.full(len(s.q), 1 - np.exp(-stretch / rate / OBSERVER_TIME))
    gain[list(unseen)] = 0.0
    torque = lowpass(s.Y[list(model.actuated)], rate, filter).T - model.offsets @ x
    q, nu = s.q[:, 0].copy(), s.nu[:, 0].copy()
    N = s.q.shape[1]
    places, speeds, slopes = np.empty((3, *s.q.shape))
    for at in range(0, N - 1, stretch):
        end = min(at + stretch, N - 1)
        motion = simulate(model, torque[at : end + 1], x, q, nu)
        places[:, at : end + 1], speeds[:, at : end + 1] = motion.q.T, motion.nu.T
        slopes[:, at : end + 1] = motion.a.T
        q = motion.q[-1] + gain * (s.q[:, end] - motion.q[-1])
        nu = motion.nu[-1] + gain * (s.nu[:, end] - motion.nu[-1])
    return Samples(places, speeds, slopes, s.Y)
