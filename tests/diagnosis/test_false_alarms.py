"""Counts of what a diagnosis names on clean simulated logs, and shares of a misfit, as they are stated."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from excite.diagnosis import FalseAlarms, deadline, false_alarms
from excite.diagnosis.findings import format_share
from excite.errors import NoEstimateError


def test_a_tied_log_counts_as_named() -> None:
    counted = FalseAlarms({"named": 1, "tied": 2, "clean": 4}, 1, {"ground_slope@machine": 3})
    summary = counted.summary()
    assert summary["runs"] == 8
    assert summary["named"] == 3
    assert summary["verdicts"] == {"named": 1, "tied": 2, "clean": 4}
    assert "Of 8 clean simulated logs" in str(counted)
    assert "3 got a name (ground_slope@machine); 1 without an answer" in str(counted)


def test_no_log_is_begun_after_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(deadline.time, "monotonic", lambda: clock[0])

    def diagnosed(*given: Any, **more: Any) -> Any:
        clock[0] += 20.0
        raise NoEstimateError("a log like this has no answer")

    for name in ("can_be_simulated", "build"):
        monkeypatch.setattr(false_alarms, name, lambda stage: True)
    monkeypatch.setattr(false_alarms, "simulate_clean", diagnosed)
    monkeypatch.setattr(false_alarms.selection, "fitted_machine", lambda stage: None)
    d: Any = SimpleNamespace(after=None)
    assert false_alarms.count_false_alarms(d, 2).runs == 2
    assert false_alarms.count_false_alarms(d, 100, budget_s=30.0).runs == 2
    assert false_alarms.count_false_alarms(d, 100, budget_s=-1.0).runs == 0


@pytest.mark.parametrize(
    ("share", "text"), [(1.0, "100 %"), (0.99974, "99.97 %"), (0.999999, "99.99 %"), (0.9951, "99.51 %"), (0.5, "50 %")]
)
def test_a_share_below_one_is_never_given_as_all(share: float, text: str) -> None:
    assert format_share(share) == text
