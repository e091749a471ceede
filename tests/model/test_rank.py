"""Which columns others make up, against the rank that a singular value decomposition tells."""

from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from excite.model.mechanics import independent_columns


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(0, 5), st.integers(0, 2))
def test_columns_kept_make_up_those_left(seed: int, rank: int, more: int, zeros: int) -> None:
    rng = np.random.default_rng(seed)
    own = rng.normal(size=(12, rank))
    A = np.column_stack([own, own @ rng.normal(size=(rank, more)), np.zeros((12, zeros))])
    A = A[:, rng.permutation(A.shape[1])]
    kept, left = independent_columns(A, 1e-9)
    assert len(kept) == np.linalg.matrix_rank(A) == rank
    assert sorted([*kept, *left]) == np.flatnonzero(A.any(axis=0)).tolist()
    for k in left:  # those before it are enough
        before = A[:, [j for j in kept if j < k]]
        made = before @ np.linalg.lstsq(before, A[:, k], rcond=None)[0]
        np.testing.assert_allclose(made, A[:, k], atol=1e-9 * np.linalg.norm(A[:, k]) * np.linalg.cond(before))


def test_a_regressor_of_nothing_keeps_nothing() -> None:
    assert independent_columns(np.zeros((5, 3)), 1e-9) == ([], [])
    assert independent_columns(np.zeros((5, 0)), 1e-9) == ([], [])
