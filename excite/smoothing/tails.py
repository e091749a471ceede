"""Heavy tails of noise: Student's t in the place of the normal distribution.

Source: Lange, Little and Taylor, "Robust statistical modeling using the t distribution", JASA 84, 1989.
"""

from __future__ import annotations

import numpy as np
import scipy.special
import scipy.stats

FREEDOMS = (np.inf, 30.0, 12.0, 7.0, 5.0, 4.0, 3.0)  # degrees of freedom that are compared
MANY_RESIDUALS = 5000  # that show tails well enough
PART_RESIDUALS = 100  # in a part of a log whose own size shows if tails are heavy there; chosen
CLEAR_GAIN = 12.0  # of log-likelihood from which tails of innovations are heavier than normal, for some 20 signals


def heaviness(z: np.ndarray, gain: float = 3.0) -> tuple[float, float]:
    """Return the degrees of freedom and the scale of Student's t under which residuals z (N,) are most likely.

    gain: of log-likelihood over the normal distribution (infinitely many degrees) that it takes.
    """
    best, found = -np.inf, (np.inf, 1.0)
    z = z[:: 1 + len(z) // MANY_RESIDUALS]
    for nu in FREEDOMS:
        scale = float(np.sqrt(np.mean(z**2))) or 1.0
        if np.isinf(nu):
            value = float(scipy.stats.norm.logpdf(z, scale=scale).sum()) + gain
        else:
            for _ in range(8):
                weight = (nu + 1) / (nu + (z / scale) ** 2)
                scale = float(np.sqrt(np.mean(weight * z**2))) or 1.0
            value = float(scipy.stats.t.logpdf(z, nu, scale=scale).sum())
        if value > best:
            best, found = value, (nu, scale)
    return found


def has_heavy_tails(z: np.ndarray) -> bool:
    """Tell if residuals z (N,) are of noise with heavy tails.

    A few large residuals in normal noise, and residuals that are large for a while, are none.
    """
    if len(z) < 5 * PART_RESIDUALS:
        return False
    parts = np.array_split(z, len(z) // PART_RESIDUALS)
    local = np.concatenate([part / (np.sqrt(np.mean(part**2)) or 1.0) for part in parts])
    limit = np.quantile(np.abs(local), 1 - 0.1 / PART_RESIDUALS)  # the largest may be faults
    return bool(np.isfinite(heaviness(local[np.abs(local) < limit], CLEAR_GAIN)[0]))


def normal_scores(z: np.ndarray) -> np.ndarray:
    """Return residuals z (N,) of noise with heavy tails as those of normal noise of the same size would be.

    Each goes to the same quantile. Unchanged without heavy tails.
    """
    if not has_heavy_tails(z):
        return z
    nu, scale = heaviness(z)
    score = -scipy.special.ndtri_exp(scipy.stats.t.logsf(np.abs(z) / scale, nu))
    return np.sign(z) * score * float(np.sqrt(np.mean(z**2) / np.mean(score**2)))
