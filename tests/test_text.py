"""Numbers as people read them."""

from __future__ import annotations

import numpy as np
import pytest

from excite.text import format_number, format_percent


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (171.3, 2, "170"),
        (-1.04e5, 2, "-100000"),
        (99.6, 2, "100"),
        (0.0123, 2, "0.012"),
        (1.5e-7, 2, "1.5e-07"),
        (-90000.0, 6, "-90000"),
        (np.float64(3e9), 3, "3e+09"),
        (12, 2, "12"),
        (None, 2, "-"),
        (float("nan"), 2, "-"),
    ],
)
def test_a_number_has_no_exponent_that_it_does_not_need(value: float | None, digits: int, text: str) -> None:
    assert format_number(value, digits) == text


def test_per_cent_in_a_sentence() -> None:
    assert format_percent(171.3) == "170 %"
    assert format_percent(4, 3) == "4 %"
