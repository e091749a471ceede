"""Numbers as people read them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from excite.text import count, format_number, format_percent, format_rounded, format_uncertain

ROOT = Path(__file__).parents[1]
EXEMPT = ("excite/cli/reference.py",)  # grids of shapes, as they are typed


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


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (11035.3, 84.4, "11035 +- 84 kg"),
        (11612.8, 546.0, "11610 +- 550 kg"),
        (0.02, 0.001, "0.0200 +- 0.0010 kg"),
        (-0.3, 12.0, "0 +- 12 kg"),
        (0.5, 0.0996, "0.50 +- 0.10 kg"),
        (2.351e6, 1.04e4, "2.351e+06 +- 10000 kg"),
        (1e-7, 1e-8, "1.00e-07 +- 1.0e-08 kg"),
        (5.0, float("nan"), "5 kg"),
    ],
)
def test_a_value_has_the_digits_of_its_deviation(value: float, std: float, text: str) -> None:
    assert format_uncertain(value, std, "kg") == text
    assert format_uncertain(value, std, "-") == text.removesuffix(" kg")


def test_numbers_of_numpy_are_numbers() -> None:
    assert format_number(np.float32(0.1), 2) == "0.1"
    assert format_number(np.int64(123456), 2) == "123456"
    assert format_rounded(None, None) == "-"


def test_one_thing_and_several() -> None:
    assert [count(n, "spike") for n in (0, 1, 2)] == ["0 spikes", "1 spike", "2 spikes"]
    assert count(1, "row shares its", "rows share their") == "1 row shares its"
    assert count(2, "row shares its", "rows share their") == "2 rows share their"


def test_no_message_has_a_number_with_a_needless_exponent() -> None:
    """`.2g` writes 100 as 1e+02: words go through `format_number`; names, commands and files may use `.5g` and more."""
    bare = re.compile(r"\{[^{}\n]*:\.[1-4]g\}")
    for package in ("excite", "model"):
        for path in (ROOT / package).rglob("*.py"):
            if path.relative_to(ROOT).as_posix() in EXEMPT or "excite/model/" in path.as_posix():
                continue
            found = [x for line in path.read_text().splitlines() if '"note"' not in line for x in bare.findall(line)]
            assert not found, f"{path}: {found}"
