"""Counts of what a diagnosis names on clean simulated logs, and shares of a misfit, as they are stated."""

from __future__ import annotations

import pytest

from excite.diagnosis import FalseAlarms
from excite.diagnosis.findings import format_share


def test_a_tied_log_counts_as_named() -> None:
    counted = FalseAlarms({"named": 1, "tied": 2, "clean": 4}, 1, {"ground_slope@machine": 3})
    summary = counted.summary()
    assert summary["runs"] == 8
    assert summary["named"] == 3
    assert summary["verdicts"] == {"named": 1, "tied": 2, "clean": 4}
    assert "Of 8 clean simulated logs" in str(counted)
    assert "3 got a name (ground_slope@machine); 1 without an answer" in str(counted)


@pytest.mark.parametrize(
    ("share", "text"), [(1.0, "100 %"), (0.99974, "99.97 %"), (0.999999, "99.99 %"), (0.9951, "99.51 %"), (0.5, "50 %")]
)
def test_a_share_below_one_is_never_given_as_all(share: float, text: str) -> None:
    assert format_share(share) == text
