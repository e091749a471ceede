"""Linearly independent columns of a matrix, such as the identifiable parameters of a regressor."""

from __future__ import annotations

import numpy as np


def independent_columns(A: np.ndarray, tolerance: float) -> tuple[list[int], list[int]]:
    """Split the nonzero columns of A into independent and dependent ones, by Gram-Schmidt in their order.

    tolerance: a column, or its part orthogonal to earlier ones, that is no longer than this counts as zero.
    """
    kept: list[int] = []
    left: list[int] = []
    Q = np.zeros((len(A), 0))
    for k in np.flatnonzero(np.linalg.norm(A, axis=0) > tolerance):
        rest = A[:, k] - Q @ (Q.T @ A[:, k])
        rest -= Q @ (Q.T @ rest)
        if np.linalg.norm(rest) > tolerance:
            kept.append(int(k))
            Q = np.column_stack([Q, rest / np.linalg.norm(rest)])
        else:
            left.append(int(k))
    return kept, left
