"""Positive definite block tridiagonal systems: factors, solutions, and the blocks of the inverse near the diagonal.

Source of the inverse: K. Takahashi, J. Fagan, M. Chen, "Formation of a sparse bus impedance matrix", 1973.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack


@dataclass(frozen=True)
class BlockTridiagonal:
    """A symmetric matrix: diagonal blocks (n, m, m) and those below them (n - 1, m, m)."""

    diagonal: np.ndarray
    below: np.ndarray


@dataclass(frozen=True)
class Factor:
    """Cholesky factor L: inverses of its diagonal blocks (n, m, m), and the blocks below them (n - 1, m, m)."""

    inverse: np.ndarray
    below: np.ndarray

    @property
    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the matrix."""
        return float(-2 * np.log(np.diagonal(self.inverse, axis1=1, axis2=2)).sum())


def factorise(matrix: BlockTridiagonal) -> Factor | None:
    """Return the Cholesky factor of a matrix, None if it is not positive definite."""
    n, m, _ = matrix.diagonal.shape
    inverse, below = np.empty((n, m, m)), np.empty((max(n - 1, 0), m, m))
    for k in range(n):
        pivot = matrix.diagonal[k]
        if k:
            below[k - 1] = matrix.below[k - 1] @ inverse[k - 1].T
            pivot = pivot - below[k - 1] @ below[k - 1].T
        root, fault = lapack.dpotrf(pivot, lower=1, clean=1)
        if fault:
            return None
        inverse[k], fault = lapack.dtrtri(root, lower=1)
        if fault or not np.isfinite(inverse[k, 0, 0]):
            return None
    return Factor(inverse, below)


def forward(factor: Factor, b: np.ndarray) -> np.ndarray:
    """Return L^-1 b for b (n, m, c)."""
    y = np.empty_like(b)
    y[0] = factor.inverse[0] @ b[0]
    for k in range(1, len(b)):
        y[k] = factor.inverse[k] @ (b[k] - factor.below[k - 1] @ y[k - 1])
    return y


def backward(factor: Factor, y: np.ndarray) -> np.ndarray:
    """Return L'^-1 y for y (n, m, c)."""
    x = np.empty_like(y)
    x[-1] = factor.inverse[-1].T @ y[-1]
    for k in range(len(y) - 2, -1, -1):
        x[k] = factor.inverse[k].T @ (y[k] - factor.below[k].T @ x[k + 1])
    return x


def inverse_blocks(factor: Factor) -> BlockTridiagonal:
    """Return the blocks of the inverse on the diagonal and below it."""
    diagonal, below = np.empty_like(factor.inverse), np.empty_like(factor.below)
    last = factor.inverse[-1]
    diagonal[-1] = last.T @ last
    for k in range(len(below) - 1, -1, -1):
        back = factor.below[k] @ factor.inverse[k]
        down = diagonal[k + 1] @ back
        below[k] = -down
        own = factor.inverse[k].T @ factor.inverse[k] + back.T @ down
        diagonal[k] = (own + own.T) / 2
    return BlockTridiagonal(diagonal, below)


@dataclass(frozen=True)
class Windows:
    """Where the overlapping windows of a chain lie in blocks.

    count: number of windows; window k covers the entries k .. k + reach - 1, `width` unknowns each. per_block: entries
    in a block, at least `reach`.
    """

    count: int
    reach: int
    width: int
    per_block: int

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return -(-(self.count + self.reach - 1) // self.per_block)

    @property
    def block_size(self) -> int:
        """Number of unknowns of a block."""
        return self.per_block * self.width


def windows(count: int, reach: int, width: int) -> Windows:
    """Choose blocks of about thirty unknowns or more, large enough for BLAS and small enough for the cache."""
    return Windows(count, reach, width, max(reach, -(-36 // width)))


def assemble(w: Windows, local: np.ndarray) -> BlockTridiagonal:
    """Sum the matrices (count, reach width, reach width) of all windows; unused unknowns get a unit diagonal."""
    size = w.block_size
    diagonal, below = np.zeros((w.blocks, size, size)), np.zeros((w.blocks - 1, size, size))
    for r in range(min(w.per_block, w.count)):
        own = local[r :: w.per_block]
        n, first = len(own), r * w.width
        inside = min(size - first, w.reach * w.width)
        diagonal[:n, first : first + inside, first : first + inside] += own[:, :inside, :inside]
        over = w.reach * w.width - inside
        if over:
            diagonal[1 : n + 1, :over, :over] += own[:, inside:, inside:]
            below[:n, :over, first : first + inside] += own[:, inside:, :inside]
    unused = w.blocks * w.per_block - (w.count + w.reach - 1)
    if unused:
        tail = np.arange(size - unused * w.width, size)
        diagonal[-1, tail, tail] += 1.0
    return BlockTridiagonal(diagonal, below)


def gather(w: Windows, matrix: BlockTridiagonal) -> np.ndarray:
    """Return the part (count, reach width, reach width) of a symmetric matrix that each window covers."""
    size, reach = w.block_size, w.reach * w.width
    local = np.empty((w.count, reach, reach))
    for r in range(min(w.per_block, w.count)):
        own = local[r :: w.per_block]
        n, first = len(own), r * w.width
        inside = min(size - first, reach)
        own[:, :inside, :inside] = matrix.diagonal[:n, first : first + inside, first : first + inside]
        over = reach - inside
        if over:
            own[:, inside:, inside:] = matrix.diagonal[1 : n + 1, :over, :over]
            own[:, inside:, :inside] = matrix.below[:n, :over, first : first + inside]
            own[:, :inside, inside:] = own[:, inside:, :inside].transpose(0, 2, 1)
    return local


def assemble_columns(w: Windows, local: np.ndarray, first: int, into: np.ndarray) -> None:
    """Add the columns (n, reach width, c) of windows first .. first + n to `into` (blocks per_block, width, c)."""
    n, _, c = local.shape
    split = local.reshape(n, w.reach, w.width, c)
    for i in range(w.reach):
        into[first + i : first + i + n] += split[:, i]
