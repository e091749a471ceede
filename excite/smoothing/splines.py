"""Smooth motions as quintic splines on even knots, with the prior that one of their derivatives is white noise.

A coordinate is q(t) = sum_k c_k B((t - start) / step - k + 5) with the cardinal B-spline B of degree five. The prior
density of a white derivative of order m (3, the jerk, to 5) and intensity S (a power per hertz, [m2/s5] of jerk) is
exp(-1/2 integral (d^m q / dt^m)^2 / S). Source: G. Wahba, "Spline Models for Observational Data", 1990, ch. 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
import scipy

DEGREE = 5  # of the splines, which minimise the integral of the squared jerk
ORDER = DEGREE + 1  # number of coefficients that act in one interval
WHITE = (3, 4, 5)  # orders of the derivatives that may be white; the acceleration is none


@dataclass(frozen=True)
class Knots:
    """Even knots: `count` intervals of `step` [s] from `start` [s]; a spline has count + 5 coefficients.

    white: order of the derivative that the prior takes as white noise.
    """

    start: float
    step: float
    count: int
    white: int = WHITE[0]

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
    return _derivatives(knots, share, 3)


def sampled_basis(knots: Knots, share: np.ndarray, sample: float) -> np.ndarray:
    """Return q, q' and q'' (N, 3, 6) at times where torques are sampled, every `sample` [s], and linear in between.

    An acceleration that is linear between samples turns at each of them: the smooth one that moves a joint alike is
    lower by its curvature times sample^2 / 12 there.
    """
    found = _derivatives(knots, share, DEGREE)
    found[:, 2] -= sample**2 / 12 * found[:, 4]
    return found[:, :3]


def start_basis(knots: Knots) -> np.ndarray:
    """Return the derivatives (white, 6) below the white one per coefficient of the first interval, at its start."""
    return np.asarray(_derivatives(knots, np.zeros(1), knots.white)[0])


def _derivatives(knots: Knots, share: np.ndarray, count: int) -> np.ndarray:
    found = np.empty((len(share), count, ORDER))
    for k in range(count):
        powers = share[:, None] ** np.arange(ORDER - k)
        found[:, k] = powers @ _polynomials(k) / knots.step**k
    return found


def penalty(knots: Knots) -> np.ndarray:
    """Return the integral of the squared white derivative (6, 6) over an interval, by its coefficients."""
    D = _difference(knots.white)
    return np.asarray(D.T @ _gram(knots.white) @ D / knots.step ** (2 * knots.white - 1))


def roughness(knots: Knots, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the integral of the squared white derivative (K,) over each interval and half its slope (K, 6).

    near (K, 6): coefficients of each interval.
    """
    differences = np.diff(near, knots.white, axis=1)
    pull = differences @ _gram(knots.white) / knots.step ** (2 * knots.white - 1)
    return (pull * differences).sum(axis=1), pull @ _difference(knots.white)


@lru_cache(maxsize=64)
def unit_log_determinant(count: int, white: int) -> float:
    """Return the log determinant of the prior's information about a spline on unit knots.

    The white derivative is a spline of the differences of the coefficients, whose Gram matrix is banded and well
    conditioned; differences and the first state are another set of coordinates, of one determinant for all counts.
    """
    size, gram = ORDER - white, _gram(white)
    banded = np.zeros((size, count + size - 1))
    for i in range(size):
        for j in range(i + 1):
            banded[i - j, j : j + count] += gram[i, j]
    first = np.concatenate([start_basis(Knots(0.0, 1.0, 1, white)), _difference(white)])
    differences = float(np.log(scipy.linalg.cholesky_banded(banded, lower=True)[0]).sum())
    return 2 * (differences + float(np.linalg.slogdet(first)[1]))


@cache
def _difference(order: int) -> np.ndarray:
    """Differences (6 - order, 6) of the coefficients of an interval."""
    return np.diff(np.eye(ORDER), order, axis=0)


@cache
def _gram(order: int) -> np.ndarray:
    """Integrals (6 - order, 6 - order) of products of the pieces of a cardinal B-spline of degree 5 - order."""
    size = ORDER - order
    pieces = np.array({3: [[0.5, 0.5, 0], [-1, 1, 0], [0.5, -1, 0.5]], 4: [[1, 0], [-1, 1]], 5: [[1]]}[order], float)
    return np.asarray(pieces.T @ scipy.linalg.hilbert(size) @ pieces)


@cache
def _polynomials(derivative: int) -> np.ndarray:
    """Coefficients (6 - derivative, 6) of the powers of the share, of each basis function in an interval."""
    element = scipy.interpolate.BSpline(np.arange(2 * ORDER), np.eye(ORDER), DEGREE)
    piece = [element(DEGREE, nu=k) / scipy.special.factorial(k) for k in range(ORDER)]
    found = np.array(piece)
    for _ in range(derivative):
        found = found[1:] * np.arange(1, len(found))[:, None]
    return found
