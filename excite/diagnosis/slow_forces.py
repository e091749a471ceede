"""Slow unknown forces and torques as a rival of every named effect.

Each row of the equations of motion may have an unknown force that varies slowly: a sum of cosines over the log with
unknown amplitudes. Their size is the most likely one given what a fit leaves (empirical Bayes: MacKay, "Bayesian
interpolation", Neural Computation 4, 1992). Where a fit leaves noise, they vanish. Where it leaves a slow misfit, a
magnitude that such forces could replace loses its significance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from excite.diagnosis.fits import ExtendedFit, with_true_sensor_noise
from excite.diagnosis.score_test import FittedLog, without_offsets
from excite.smoothing import prior_terms, whiten_signatures

SHORTEST_PERIOD_S = 10.0  # of a slow force [s]; chosen: longer than a manoeuvre
PASSES = 60  # of the iteration for the sizes; chosen
MIN_SIZE = 1e-6  # of a force, of the size that equals noise, below which it is none; chosen


@dataclass(frozen=True)
class SlowForces:
    """Parameters X (n_base,) and covariance (n_base, n_base) [SI] of a fit beside slow unknown forces."""

    X: np.ndarray
    covariance: np.ndarray


def allow_slow_forces(stage: ExtendedFit) -> SlowForces:
    """Estimate the parameters of a fit anew, to first order, with slow unknown forces on every row."""
    stage = with_true_sensor_noise(stage)
    fit, model = stage.fit, stage.model
    n = len(fit.X)
    prior, slope, _ = prior_terms(model, fit.prior, fit.X)
    forms, rows = zip(*(_marginal_form(fitted_log, n) for fitted_log in stage.fitted_logs), strict=True)
    n_rows = 1 + max(int(r.max()) for r in rows)
    size = np.ones(n_rows)  # [units in which a coefficient of 1 equals its noise]
    p = slice(1, 1 + n)
    for _ in range(PASSES):
        precision = [1 / np.maximum(size[r], MIN_SIZE) ** 2 for r in rows]
        inverses = [np.linalg.inv(Z[1 + n :, 1 + n :] + np.diag(a)) for Z, a in zip(forms, precision, strict=True)]
        information, g = prior.copy(), slope.copy()
        for Z, B in zip(forms, inverses, strict=True):
            cross = Z[p, 1 + n :]
            information += Z[p, p] - cross @ B @ cross.T
            g += Z[p, 0] - cross @ B @ Z[1 + n :, 0]
        covariance = np.linalg.inv(information)
        step = -covariance @ g
        square, determined = np.zeros(n_rows), np.full(n_rows, 1e-12)
        for Z, B, a, r in zip(forms, inverses, precision, rows, strict=True):
            mean = -B @ (Z[1 + n :, 0] + Z[1 + n :, p] @ step)
            spread = B @ Z[1 + n :, p]
            variance = np.diag(B) + np.einsum("ij,jk,ik->i", spread, covariance, spread)
            square += np.bincount(r, mean**2, n_rows)
            determined += np.bincount(r, np.maximum(1 - variance * a, 0.0), n_rows)
        size = np.maximum(np.sqrt(square / determined), MIN_SIZE)
    return SlowForces(fit.X + step * model.scale, covariance * np.outer(model.scale, model.scale))


def _marginal_form(fitted_log: FittedLog, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadratic form of one log in [1, parameters, slow forces], its encoder offsets integrated out.

    The c slow forces are scaled so that those of a row have the information one on average. Also the row (c,) of each.
    """
    linear, slopes = fitted_log.linear, fitted_log.slopes
    N, n_rows = len(fitted_log.t), slopes.shape[2]
    orders = np.arange(1, max(2, int(2 * (fitted_log.t[-1] - fitted_log.t[0]) / SHORTEST_PERIOD_S)) + 1)
    phi = np.cos(np.pi * np.outer(np.arange(N) + 0.5, orders) / N)
    row = np.repeat(np.arange(n_rows), len(orders))

    def along(at: slice) -> tuple[np.ndarray, np.ndarray]:
        K = at.stop - at.start
        ends = phi[at.start : at.stop + 1]
        push = np.zeros((K, slopes.shape[1], len(row)), np.float32)
        mean = (ends[:-1] + ends[1:]).astype(np.float32)
        moved = slopes[at][:, :, :, None] * mean[:, None, None, :]
        push[: len(mean)] = moved.reshape(len(mean), slopes.shape[1], len(row))
        return push, np.zeros((K, linear.H.shape[1], len(row)), np.float32)

    E0 = fitted_log.white.E
    own = E0.shape[2]
    form = np.zeros((own + len(row),) * 2)
    for at, E in whiten_signatures(linear, fitted_log.white, along):
        both = np.concatenate([E0[at], E], axis=2).reshape(-1, len(form)).astype(float)
        form += both.T @ both
    Z = without_offsets(form, n, fitted_log.n_offsets)
    information = np.array([np.mean(np.diag(Z)[1 + n :][row == k]) for k in range(n_rows)])
    scale = 1 / np.sqrt(np.maximum(information, 1e-300))[row]
    by = np.concatenate([np.ones(1 + n), scale])
    return Z * np.outer(by, by), row
