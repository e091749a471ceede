"""Smooth motions as quintic splines on even knots, with the prior of an integrated white jerk.

A coordinate is q(t) = sum_k c_k B((t - start) / step - k + 5) with the cardinal B-spline B of degree five. The prior
density of white jerk of intensity S (a power per hertz, [m2/s5]) is exp(-1/2 integral q'''^2 / S); its minimisers are
quintic splines. Source: G. Wahba, "Spline Models for Observational Data", 1990, ch. 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy

DEGREE = 5  # of the splines that minimise the integral of the squared jerk
ORDER = DEGREE + 1  # number of coefficients that act in one interval
QUADRATIC = np.array([[0.5, 0.5, 0.0], [-1.0, 1.0, 0.0], [0.5, -1.0, 0.5]])  # pieces of the quadratic B-spline
THIRD_GRAM = QUADRATIC.T @ scipy.linalg.hilbert(3) @ QUADRATIC  # integrals of products of its pieces
THIRD_DIFFERENCE = np.array([[-1, 3, -3, 1, 0, 0], [0, -1, 3, -3, 1, 0], [0, 0, -1, 3, -3, 1]], float)


@dataclass(frozen=True)
class Knots:
    """Even knots: `count` intervals of `step` [s] from `start` [s]; a spline has count + 5 coefficients."""

    start: float
    step: float
    count: int

    @property
    def size(self) -> int:
        """Number of coefficients of one coordinate."""
        return self.count + DEGREE


def even_knots(first: float, last: float, step: float) -> Knots:
    """Return knots about `step` [s] apart that cover all times from first to last [s]."""
    count = max(1, round((last - first) / step))
    return Knots(first, (last - first) / count, count)


def place(knots: Knots, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interval (N,) of each time t (N,) [s] and the share of it (N,) that has passed."""
    passed = (np.asarray(t) - knots.start) / knots.step
    interval = np.clip(np.floor(passed).astype(int), 0, knots.count - 1)
    return interval, passed - interval


def motion_basis(knots: Knots, share: np.ndarray) -> np.ndarray:
    """Return q, q' and q'' (N, 3, 6) per coefficient of an interval, at shares (N,) of it."""
    found = np.empty((len(share), 3, ORDER))
    for k in range(3):
        powers = share[:, None] ** np.arange(ORDER - k)
        found[:, k] = powers @ _polynomials(k) / knots.step**k
    return found


def jerk_penalty(knots: Knots) -> np.ndarray:
    """Return the integral of the squared jerk (6, 6) over one interval, as a quadratic form of its coefficients."""
    return np.asarray(THIRD_DIFFERENCE.T @ THIRD_GRAM @ THIRD_DIFFERENCE / knots.step**5)


def squared_jerk(knots: Knots, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the integral of the squared jerk (K,) over each interval and half its slope (K, 6) by its coefficients.

    near (K, 6): coefficients of each interval.
    """
    third = np.diff(near, 3, axis=1)
    pull = third @ THIRD_GRAM / knots.step**5
    return (pull * third).sum(axis=1), pull @ THIRD_DIFFERENCE


@cache
def _polynomials(derivative: int) -> np.ndarray:
    """Coefficients (6 - derivative, 6) of the powers of the share, of each basis function in an interval."""
    element = scipy.interpolate.BSpline(np.arange(2 * ORDER), np.eye(ORDER), DEGREE)
    piece = [element(DEGREE, nu=k) / scipy.special.factorial(k) for k in range(ORDER)]
    found = np.array(piece)
    for _ in range(derivative):
        found = found[1:] * np.arange(1, len(found))[:, None]
    return found
