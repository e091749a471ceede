"""Least squares by QR, in one piece or block by block, and deviations that know of autocorrelation.

Blocks: the triangle R of a tall matrix is that of the triangles of its blocks stacked (Demmel, Grigori, Hoemmen and
Langou, "Communication-optimal parallel and sequential QR", 2012), so that memory stays that of one block.
Autocorrelation: the noise is an autoregression, its order by Akaike's criterion (long enough for noise of
differentiated angles, which has little power at low frequencies), its innovations uncorrelated but of any level along
the log (White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 48, 1980; prewhitening as
in Andrews and Monahan, Econometrica 60, 1992).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite.model.mechanics import independent_columns

DEPENDENCE_TOLERANCE = 1e-10  # a column this close to a combination of the others carries nothing [relative]
BLOCK_ROWS = 20_000  # rows of a tall matrix that are reduced at once
MAX_COLUMN_RATIO = 10.0  # times a column that is kept, of one that is left out
MAX_LAGS = 20  # of the autoregression that describes noise


@dataclass(frozen=True)
class Triangle:
    """What is left of A x = y (m rows, n columns): R (k, n + 1) of [A y], k <= n + 1, upper triangular."""

    R: np.ndarray
    rows: int

    @property
    def columns(self) -> int:
        return self.R.shape[1] - 1


@dataclass(frozen=True)
class Solution:
    """x (n,) with zeros for columns left out; `kept` columns; R (k, k) of those; residual_norm |y - A x|; rows m."""

    x: np.ndarray
    kept: tuple[int, ...]
    dependent: dict[int, int | None]
    R: np.ndarray
    residual_norm: float
    rows: int

    @property
    def degrees(self) -> int:
        return self.rows - len(self.kept)

    @property
    def tied(self) -> list[int]:
        """Columns left out that are combinations of kept ones."""
        return [k for k, partner in self.dependent.items() if partner is not None]

    @property
    def inverse(self) -> np.ndarray:
        """(A'A)^-1 of the kept columns, (k, k)."""
        half = scipy.linalg.solve_triangular(self.R, np.eye(len(self.kept)))
        return half @ half.T

    def spread(self, S: np.ndarray) -> np.ndarray:
        """S (k, k) of the kept columns among all (n, n), NaN elsewhere."""
        full = np.full((len(self.x), len(self.x)), np.nan)
        full[np.ix_(self.kept, self.kept)] = S
        return full


def reduce(A: np.ndarray, y: np.ndarray) -> Triangle:
    """The triangle of A (m, n), y (m,), block by block."""
    R = np.zeros((0, A.shape[1] + 1))
    for at in range(0, len(y), BLOCK_ROWS):
        R = _stack(R, np.column_stack([A[at : at + BLOCK_ROWS], y[at : at + BLOCK_ROWS]]))
    return Triangle(R, len(y))


def merge(triangles: Iterable[Triangle]) -> Triangle:
    """The triangle of all rows together. Raises ValueError for none."""
    whole: Triangle | None = None
    for t in triangles:
        whole = t if whole is None else Triangle(_stack(whole.R, t.R), whole.rows + t.rows)
    if whole is None:
        raise ValueError("merge: no block given")
    return whole


def _stack(R: np.ndarray, block: np.ndarray) -> np.ndarray:
    both = np.concatenate([R, block])
    return np.asarray(np.linalg.qr(both, mode="r"))


def exchange_columns(A: np.ndarray, kept: Sequence[int], left: Sequence[int]) -> list[int]:
    """Of columns that make up one another those to keep, in order: none left out may be more than MOST times a kept
    one, which would stand for it and make its errors larger by that (a pivot rule of maximum volume).

    `kept` are independent, `left` combinations of them; a column that counts for nothing is in neither.
    """
    kept, left = list(kept), list(left)
    size = np.linalg.norm(A, axis=0)
    while left:
        C = np.linalg.lstsq(A[:, kept] / size[kept], A[:, left] / size[left], rcond=None)[0]
        C *= size[left] / size[kept][:, None]
        i, j = np.unravel_index(np.argmax(np.abs(C)), C.shape)
        if abs(C[i, j]) <= MAX_COLUMN_RATIO:
            break
        kept[i], left[j] = left[j], kept[i]
    return sorted(kept)


def solve(t: Triangle, tolerance: float = DEPENDENCE_TOLERANCE, scale: np.ndarray | None = None) -> Solution:
    """Least squares from a triangle; a column within `tolerance` of those before it is left out; with the size
    `scale` (n,) of the unknowns, maybe another of them (see `exchanged`).

    `dependent` names for each of these the kept column that it is most like, None for a column of zeros. Columns are
    scaled to unit length first, so that units don't matter.
    """
    n = t.columns
    A, y = t.R[:, :n], t.R[:, n]
    size = np.linalg.norm(A, axis=0)
    scaled = A / np.where(size > 0, size, 1.0)
    kept, left = independent_columns(scaled, tolerance)
    if scale is not None:
        kept = exchange_columns(A * scale, kept, left)
    dependent: dict[int, int | None] = {
        k: kept[int(np.argmax(np.abs(scaled[:, kept].T @ scaled[:, k])))] if size[k] > 0 else None
        for k in range(n)
        if k not in kept
    }
    x = np.zeros(n)
    if not kept:
        return Solution(x, (), dependent, np.zeros((0, 0)), float(np.linalg.norm(y)), t.rows)
    q, R = np.linalg.qr(scaled[:, kept])
    z = q.T @ y
    x[kept] = scipy.linalg.solve_triangular(R, z) / size[kept]
    return Solution(x, tuple(kept), dependent, R * size[kept], float(np.linalg.norm(y - q @ z)), t.rows)


def scores_covariance(Z: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of sum Z'e over rows and samples, Z (n_rows, n, k) and noise e (n_rows, n) of any colour.

    Every row of e is an autoregression of its innovations. What an innovation does to the sum later on is Z filtered
    backward in time by the same autoregression; the innovations then count by their squares, so that their level may
    change along the log and go together across rows at the same time. What one row's noise tells another's later on is
    not counted.
    """
    n, one = e.shape[1], np.ones(1)
    scores = np.zeros((n, Z.shape[2]))
    for z, own in zip(Z, e, strict=True):
        a = np.append(1.0, -autoregression(own, min(MAX_LAGS, n // 20)))
        innovation = scipy.signal.lfilter(a, one, own)
        effect = scipy.signal.lfilter(one, a, z[::-1], axis=0)[::-1]
        scores += effect * innovation[:, None]
    return np.asarray(scores.T @ scores)


def autoregression(x: np.ndarray, most: int) -> np.ndarray:
    """Coefficients (k,) of x_t = sum a_i x_(t-i) + white noise, k <= most by Akaike's criterion, Yule-Walker."""
    n = len(x)
    r = np.array([x[k:] @ x[: n - k] for k in range(most + 1)])
    if not r[0] > 0:
        return np.zeros(0)
    a, error = np.zeros(0), r[0]
    best, least = a, n * np.log(error)
    for k in range(1, most + 1):
        reflection = (r[k] - a @ r[1:k][::-1]) / error
        a = np.append(a - reflection * a[::-1], reflection)
        error *= 1 - reflection**2
        if not error > 1e-12 * r[0]:
            break
        score = n * np.log(error) + 2 * k
        if score < least:
            best, least = a, score
    return best


def lag_one_correlation(e: np.ndarray) -> np.ndarray:
    """Correlation of each row (n_rows, n) with itself a sample later, (n_rows,); 0 for a row of zeros."""
    energy = (e**2).sum(axis=1)
    return np.asarray((e[:, 1:] * e[:, :-1]).sum(axis=1) / np.where(energy > 0, energy, 1.0))
