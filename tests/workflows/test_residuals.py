"""Fit and correlations of residuals agree with signals of known size and colour."""

from __future__ import annotations

import numpy as np
import pytest

from excite.identification import SignalComparison
from excite.model.machine import Filter, Quantity
from excite.workflows.residuals import describe_residuals

RATE, SAMPLES = 100.0, 40_000


def compared(residual: np.ndarray) -> SignalComparison:
    t = np.arange(SAMPLES) / RATE
    measured = 100 * np.random.default_rng(1).normal(size=SAMPLES)
    pair = measured[None], (measured - residual)[None]
    return SignalComparison(("u1",), ("N m",), t, *pair, noise=10 + 0 * t[None], parameters=0 * t[None])


def described(residual: np.ndarray) -> dict[str, float]:
    cutoff = Filter(source="assumed", cutoff_hz=Quantity(value=RATE / 2, source="assumed"))
    return describe_residuals([compared(residual)], cutoff)["u1"]


def test_white_residuals_stay_within_the_bound() -> None:
    found = described(10 * np.random.default_rng(2).normal(size=SAMPLES))
    assert found["fit_percent"] == pytest.approx(90, abs=0.2)
    assert found["noise_percent"] == pytest.approx(90, abs=0.2)
    assert found["rms"] == pytest.approx(found["expected_rms"], rel=0.02)
    assert found["auto_outside"] < 20
    assert found["bound"] == pytest.approx(1.96 / np.sqrt(SAMPLES))


def test_coloured_residuals_show_their_correlation() -> None:
    white = np.random.default_rng(3).normal(size=SAMPLES + 1)
    found = described(white[1:] + white[:-1])
    assert found["auto"] == pytest.approx(0.5, abs=0.03)
    assert found["auto_outside"] >= 4


def test_a_gain_that_is_wrong_shows_in_the_cross_correlation() -> None:
    measured = 100 * np.random.default_rng(1).normal(size=SAMPLES)
    found = described(0.1 * measured)
    assert found["cross"] == pytest.approx(1.0)
    assert found["fit_percent"] == pytest.approx(90, abs=0.1)
