"""Least squares by QR, at once or block by block, and covariances for autocorrelated noise.

Blocks: the triangle R of a tall matrix is that of its blocks' triangles stacked (Demmel, Grigori, Hoemmen and Langou,
"Communication-optimal parallel and sequential QR", 2012), so memory is that of one block. Autocorrelation: the noise is
an autoregression with an order by Akaike's criterion. Its innovations are uncorrelated, with any variance along the log
(White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 48, 1980; prewhitening as in Andrews
and Monahan, Econometrica 60, 1992).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite.model.mechanics import independent_columns

DEPENDENCE_TOLERANCE = 1e-10  # relative distance from a combination of other columns, below which a column is dependent
ROUNDING = 1e-13  # size of a column of rounding errors over the largest one; chosen
BLOCK_ROWS = 20_000  # rows of a tall matrix that are reduced at once; chosen
MAX_COLUMN_RATIO = 10.0  # largest ratio of a dropped column to a kept one; chosen
CLUSTERS = 10  # stretches of a log between which residuals are independent; chosen
MAX_LAGS = 20  # largest order of the noise's autoregression; chosen


@dataclass(frozen=True)
class Triangle:
    """A x = y (m rows, n columns) reduced to the upper triangle R (k, n + 1) of [A y], k <= n + 1."""

    R: np.ndarray
    rows: int

    @property
    def columns(self) -> int:
        """Number of unknowns."""
        return self.R.shape[1] - 1


@dataclass(frozen=True)
class Solution:
    """Least-squares solution x (n,), zero for dropped columns.

    kept: columns. dependent: for each dropped column the kept column most similar to it, None for a zero column. R (k,
    k): triangle of the kept columns. residual_norm: |y - A x|. rows: m.
    """

    x: np.ndarray
    kept: tuple[int, ...]
    dependent: dict[int, int | None]
    R: np.ndarray
    residual_norm: float
    rows: int

    @property
    def degrees(self) -> int:
        """Degrees of freedom."""
        return self.rows - len(self.kept)

    @property
    def tied(self) -> list[int]:
        """Dropped columns that are combinations of kept ones."""
        return [k for k, partner in self.dependent.items() if partner is not None]

    @property
    def inverse(self) -> np.ndarray:
        """(A'A)^-1 of the kept columns, (k, k)."""
        half = scipy.linalg.solve_triangular(self.R, np.eye(len(self.kept)))
        return half @ half.T

    def expand(self, S: np.ndarray) -> np.ndarray:
        """Expand a matrix S (k, k) of the kept columns to all columns (n, n), with NaN elsewhere."""
        full = np.full((len(self.x), len(self.x)), np.nan)
        full[np.ix_(self.kept, self.kept)] = S
        return full


def reduce(A: np.ndarray, y: np.ndarray) -> Triangle:
    """Compute the triangle of A (m, n) and y (m,), block by block."""
    R = np.zeros((0, A.shape[1] + 1))
    for begin in range(0, len(y), BLOCK_ROWS):
        R = _stack(R, np.column_stack([A[begin : begin + BLOCK_ROWS], y[begin : begin + BLOCK_ROWS]]))
    return Triangle(R, len(y))


def merge(triangles: Iterable[Triangle]) -> Triangle:
    """Compute the triangle of all rows together. Raises ValueError for none."""
    merged: Triangle | None = None
    for t in triangles:
        merged = t if merged is None else Triangle(_stack(merged.R, t.R), merged.rows + t.rows)
    if merged is None:
        raise ValueError("merge: no block given")
    return merged


def _stack(R: np.ndarray, block: np.ndarray) -> np.ndarray:
    both = np.concatenate([R, block])
    return np.asarray(np.linalg.qr(both, mode="r"))


def exchange_columns(A: np.ndarray, kept: Sequence[int], dropped: Sequence[int]) -> list[int]:
    """Exchange columns until none dropped is more than MAX_COLUMN_RATIO times a kept one; return the kept, in order.

    A small kept column would stand for a large dropped one and magnify its errors (pivoting for maximum volume).
    kept: independent columns. dropped: combinations of these. Zero columns are in neither.
    """
    kept, dropped = list(kept), list(dropped)
    size = np.linalg.norm(A, axis=0)
    while dropped:
        C = np.linalg.lstsq(A[:, kept] / size[kept], A[:, dropped] / size[dropped], rcond=None)[0]
        C *= size[dropped] / size[kept][:, None]
        i, j = np.unravel_index(np.argmax(np.abs(C)), C.shape)
        if abs(C[i, j]) <= MAX_COLUMN_RATIO:
            break
        kept[i], dropped[j] = dropped[j], kept[i]
    return sorted(kept)


def solve(triangle: Triangle, tolerance: float = DEPENDENCE_TOLERANCE, scale: np.ndarray | None = None) -> Solution:
    """Solve least squares from a triangle; drop columns within `tolerance` of a combination of others.

    scale (n,): sizes of the unknowns, by which `exchange_columns` chooses the columns to keep, and by which columns of
    rounding errors are told from others. Columns are scaled to unit length first, so the units have no influence.
    """
    n = triangle.columns
    A, y = triangle.R[:, :n], triangle.R[:, n]
    size = np.linalg.norm(A, axis=0)
    if scale is not None:
        size[size * scale <= ROUNDING * (size * scale).max()] = 0.0
    scaled = A / np.where(size > 0, size, 1.0)
    kept, dropped = independent_columns(scaled, tolerance)
    if scale is not None:
        kept = [k for k in exchange_columns(A * scale, kept, dropped) if size[k] > 0]
    dependent: dict[int, int | None] = {
        k: kept[int(np.argmax(np.abs(scaled[:, kept].T @ scaled[:, k])))] if size[k] > 0 else None
        for k in range(n)
        if k not in kept
    }
    x = np.zeros(n)
    if not kept:
        return Solution(x, (), dependent, np.zeros((0, 0)), float(np.linalg.norm(y)), triangle.rows)
    q, R = np.linalg.qr(scaled[:, kept])
    z = q.T @ y
    x[kept] = scipy.linalg.solve_triangular(R, z) / size[kept]
    return Solution(x, tuple(kept), dependent, R * size[kept], float(np.linalg.norm(y - q @ z)), triangle.rows)


def scores_covariance(Z: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of the sum of Z'e, Z (n_rows, n, k), for autocorrelated noise e (n_rows, n).

    Every row of e is an autoregression. The effect of an innovation on the sum is Z filtered backward in time by the
    same autoregression. Innovations enter by their squares, so their variance may change along the log and they may
    correlate across rows at one time. Correlation across rows at different times is neglected.
    """
    n, one = e.shape[1], np.ones(1)
    scores = np.zeros((n, Z.shape[2]))
    for z, noise in zip(Z, e, strict=True):
        a = np.append(1.0, -autoregression(noise, min(MAX_LAGS, n // 20)))
        innovation = scipy.signal.lfilter(a, one, noise)
        effect = scipy.signal.lfilter(one, a, z[::-1], axis=0)[::-1]
        scores += effect * innovation[:, None]
    return np.asarray(scores.T @ scores)


def cluster_scores(Z: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of the sum of Z'e, Z (n_rows, n, k), e (n_rows, n), for errors that last long.

    Errors may correlate in any way within each of CLUSTERS stretches, and not beyond (Cameron and Miller, "A
    practitioner's guide to cluster-robust inference", Journal of Human Resources 50, 2015).
    """
    n = e.shape[1]
    count = max(2, min(CLUSTERS, n))
    edges = np.linspace(0, n, count + 1).astype(int)
    scores = np.add.reduceat(np.einsum("inp,in->np", Z, e), edges[:-1], axis=0)
    return np.asarray(scores.T @ scores * (count / (count - 1)))


def autoregression(x: np.ndarray, max_order: int) -> np.ndarray:
    """Fit coefficients (k,) of x_t = sum a_i x_(t-i) + white noise by Yule-Walker, with k by Akaike's criterion."""
    n = len(x)
    r = np.array([x[k:] @ x[: n - k] for k in range(max_order + 1)])
    if not r[0] > 0:
        return np.zeros(0)
    a, error = np.zeros(0), r[0]
    best, lowest = a, n * np.log(error)
    for k in range(1, max_order + 1):
        reflection = (r[k] - a @ r[1:k][::-1]) / error
        a = np.append(a - reflection * a[::-1], reflection)
        error *= 1 - reflection**2
        if not error > 1e-12 * r[0]:
            break
        criterion = n * np.log(error) + 2 * k
        if criterion < lowest:
            best, lowest = a, criterion
    return best


def lag_one_correlation(e: np.ndarray) -> np.ndarray:
    """Correlation of each row (n_rows, n) with itself one sample later, (n_rows,); 0 for a row of zeros."""
    energy = (e**2).sum(axis=1)
    return np.asarray((e[:, 1:] * e[:, :-1]).sum(axis=1) / np.where(energy > 0, energy, 1.0))
