"""Verification: honest bookkeeping, the same whatever the number of workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from excite.identification import Verification, summarise_runs, verify
from excite.model import Model
from excite.reports import describe, figures
from excite.simulation import Motion


@pytest.fixture(scope="module")
def four(straight: Model, straight_motion: Motion) -> Verification:
    return verify(straight, straight_motion, "ols", "paper", runs=4, seed=7, jobs=1)


@pytest.mark.slow
def test_same_seed_same_numbers_on_any_number_of_workers(
    straight: Model, straight_motion: Motion, four: Verification
) -> None:
    side_by_side = verify(straight, straight_motion, "ols", "paper", runs=4, seed=7, jobs=2)
    assert np.array_equal(four.value, side_by_side.value)
    assert np.array_equal(four.std, side_by_side.std)


def test_runs_differ_and_more_runs_keep_the_first_ones(
    straight: Model, straight_motion: Motion, four: Verification
) -> None:
    assert len(np.unique(four.value[:, 0])) == 4
    two = verify(straight, straight_motion, "ols", "paper", runs=2, seed=7, jobs=1)
    assert np.array_equal(two.value, four.value[:2])


def test_progress_is_told(straight: Model, straight_motion: Motion) -> None:
    told: list[tuple[int, int]] = []
    verify(
        straight, straight_motion, "ols", "paper", 3, jobs=1, progress=lambda done, total: told.append((done, total))
    )
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_summary_is_what_its_names_say() -> None:
    """Three estimates of a parameter whose truth is -100, one failed run."""
    v = Verification(
        "m",
        "full",
        ("K",),
        ("N",),
        np.array([-100.0]),
        np.array([100.0]),
        np.array([[-90.0], [-100.0], [-104.0], [np.nan]]),
        np.array([[2.0], [2.0], [2.0], [np.nan]]),
        np.array([[[-94.0], [-86.0]], [[-104.0], [-96.0]], [[-108.0], [-98.0]], [[np.nan], [np.nan]]]),
        {3: "no"},
    )
    row = summarise_runs(v)["K"]
    assert row["mean"] == pytest.approx(-98)
    assert row["bias_percent"] == pytest.approx(-2)  # too small in size
    assert row["std_percent"] == pytest.approx(np.std([-10, 0, 4], ddof=1))
    assert row["predicted_std_percent"] == pytest.approx(2)
    assert row["coverage95"] == pytest.approx(2 / 3)


def spread(percent: float) -> Verification:
    """Two parameters of 100 units, their errors in three runs up to so many per cent; one run failed."""
    value = 100 + percent * np.array([[-1.0, 0.1], [0.2, 0.0], [1.0, -0.1], [np.nan, np.nan]])
    ends = np.stack([value - percent / 2, value + percent / 2], axis=1)
    names, units, true = ("A", "B"), ("kg", "kg"), np.array([100.0, 100.0])
    return Verification("m", "full", names, units, true, true, value, np.full((4, 2), percent / 4), ends, {3: "no"})


def test_small_errors_have_an_even_axis() -> None:
    axis = figures.verify_figure(spread(1.4), "t").axes[0]
    assert axis.get_xscale() == "linear"
    assert axis.get_xlim()[1] > 1.4
    assert axis.get_xlabel().replace("\xa0", " ") == "error [% of the true value]"


@pytest.mark.parametrize("percent", [7.0, 40.0, 350.0, 9e4])
def test_large_errors_have_an_axis_that_says_that_it_is_logarithmic(percent: float) -> None:
    axis = figures.verify_figure(spread(percent), "t").axes[0]
    assert "logarithmic beyond 1 %" in axis.get_xlabel()
    low, high = axis.get_xlim()
    ticks = axis.get_xticks()
    assert (np.sort(-ticks) == ticks).all()
    assert percent <= ticks.max() <= high  # the ends of bars lie between two of them
    assert (ticks > 1).sum() >= 2
    assert low == -high < -percent


def test_no_runs_is_refused(straight: Model, straight_motion: Motion) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        verify(straight, straight_motion, "ols", runs=0)


def test_what_no_run_finds_is_left_out_of_the_answer(straight: Model, straight_motion: Motion) -> None:
    """And one run has an error, though no spread."""
    one = verify(straight, straight_motion, "ols", "paper", runs=1, seed=7, jobs=1)
    lost = one.value.copy()
    lost[:, 0] = np.nan
    for v, words in (
        (one, "worst"),
        (replace(one, value=lost), "worst"),
        (replace(one, value=lost * np.nan), "No parameter"),
    ):
        made = {"machine": "x", "runs": 1, "failed": 0, "biased": [], "meanings": {}, "parameters": summarise_runs(v)}
        answer = describe("verify", made).headline
        assert words in answer
        assert "nan" not in answer
        assert " - %" not in answer
