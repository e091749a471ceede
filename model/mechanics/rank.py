"""Which columns of a matrix others make up: of a regressor, parameters that no motion tells apart."""

from __future__ import annotations

import numpy as np


def independent_columns(A: np.ndarray, nothing: float) -> tuple[list[int], list[int]]:
    """Columns of A longer than `nothing`: those whose part that no earlier ones make up is so too, and the others."""
    kept: list[int] = []
    left: list[int] = []
    Q = np.zeros((len(A), 0))
    for k in np.flatnonzero(np.linalg.norm(A, axis=0) > nothing):
        rest = A[:, k] - Q @ (Q.T @ A[:, k])
        rest -= Q @ (Q.T @ rest)
        if np.linalg.norm(rest) > nothing:
            kept.append(int(k))
            Q = np.column_stack([Q, rest / np.linalg.norm(rest)])
        else:
            left.append(int(k))
    return kept, left
