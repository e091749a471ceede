"""Uncertainty budgets and tests of what is left, on a rig whose truth is known."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import CubicSpline
from support.damaged_logs import lively, machine_model, one_log, summary

from excite.errors import LogError
from excite.identification import Estimate, compare_logs, identify, widen
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import Tolerances
from excite.simulation import Motion, measure, simulate

METHODS = ("joint", "inverse")


@lru_cache
def drive() -> Motion:
    """A lively motion of the rig."""
    return lively(machine_model("rig"), np.random.default_rng(7))


@lru_cache
def smooth_drive() -> Motion:
    """A motion by a force of sines, whose readings between samples are known."""
    t, rng = np.arange(3000) / 100, np.random.default_rng(7)
    waves = [np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for f in (0.17, 0.31, 0.53, 0.79, 1.1)]
    return simulate(machine_model("rig"), 30 * np.sum(waves, axis=0)[:, None])


@lru_cache
def estimate(how: str = "clean", amount: float = 0.0, method: str = "joint", seed: int = 1) -> Estimate:
    """Estimate from a log of the rig in which the force is late by an amount [s], or too large by a share."""
    model = machine_model("rig")
    motion = smooth_drive() if how == "late" else drive()
    table = measure(model, motion, seed=seed)
    force = table["u_N"].to_numpy(float)
    exact = measure(model, motion, noise=False)["u_N"].to_numpy(float)
    at = np.arange(len(force))
    change: dict[str, Callable[[], np.ndarray]] = {
        "clean": lambda: force,
        # Noise comes with the reading, so it stays white: shifted between samples, it would be less than stated.
        "late": lambda: CubicSpline(at, exact)(np.clip(at - 100 * amount, 0, at[-1])) + force - exact,
        "scaled": lambda: force * (1 + amount),
        "sign lost": lambda: np.where((force < 0) & (at // 50 % 4 == 0), -force, force),
        "sign lost at times": lambda: np.where((force < 0) & (at % 4 == 0), -force, force),
    }
    return of(model, table.assign(u_N=change[how]()), method)


def of(model: Model, table: pd.DataFrame, method: str = "joint") -> Estimate:
    ready = prepare(model, [table])
    return identify(ready.model, ready.logs, method)


def inside(found: Estimate) -> bool:
    """Tell if every true value is within 4 total standard deviations."""
    return bool((np.abs(found.value - machine_model("rig").nominal) < 4 * found.std_total).all())


def test_a_clean_log_is_valid_with_the_truth_in_its_intervals() -> None:
    found = estimate()
    low, high = found.noise_interval95
    true = machine_model("rig").nominal
    assert found.status == "valid"
    assert found.tests
    assert ((low <= true) & (true <= high)).sum() >= 3


def test_a_gain_is_in_the_budget_of_all_that_it_scales() -> None:
    """One per cent of gain is one per cent of mass and friction, and leaves the offset, which is read behind it."""
    found = estimate()
    shift = np.abs(found.tolerated["torque gain of carriage"])
    assert shift[:3] == pytest.approx(0.01 * np.abs(found.value[:3]), rel=0.02)
    assert shift[3] < 0.1 * found.std[3]
    for shares in found.budget.values():
        assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3)


def test_tolerances_of_zero_leave_the_interval_to_noise() -> None:
    model = machine_model("rig")
    exact = Tolerances(alignment=0, length=0, radius=0, gain=0, level=0)
    known = build(model.machine.model_copy(update={"tolerance": exact}))
    found = of(known, measure(model, drive(), seed=1))
    assert found.std_total == pytest.approx(found.std)
    assert np.array_equal(found.interval95, found.noise_interval95)


@pytest.mark.parametrize(("how", "amount"), [("late", 0.005), ("scaled", 0.008), ("late", -0.005)])
def test_an_error_within_its_tolerance_is_within_the_interval(how: str, amount: float) -> None:
    found = estimate(how, amount)
    assert found.status == "valid", found.doubt
    assert inside(found)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("how", "amount"), [("late", 0.03), ("sign lost", 0.0)])
def test_an_error_beyond_its_tolerance_is_doubted(how: str, amount: float, method: str) -> None:
    found = estimate(how, amount, method)
    assert found.status == "doubtful"


def test_a_sign_lost_in_single_samples_is_refused() -> None:
    with pytest.raises(LogError, match=r"u_N: .* spikes of a single sample"):
        estimate("sign lost at times")


def test_a_gain_is_doubted_where_the_values_of_the_file_testify() -> None:
    found = estimate("scaled", 0.1)
    assert found.status == "doubtful"
    assert "torque gain of carriage is" in found.doubt
    shown = {t.signal: t for t in found.tests if t.what == "tolerance"}["torque gain of carriage"]
    assert shown.fails


def test_logs_that_differ_more_than_they_say_widen_the_interval() -> None:
    """Two estimates of one covariance, each parameter three standard deviations of the difference apart."""
    one = estimate()
    apart = 2.2 * np.sqrt(2) * one.std * np.array([1, -1, 1, -1])
    compared = compare_logs(["a", "b"], [one, Estimate(**{**vars(one), "value": one.value + apart})])
    assert compared is not None
    expected = np.sqrt(apart @ np.linalg.inv(2 * one.covariance) @ apart / 4)
    assert compared.ratio == pytest.approx(expected, rel=1e-6)
    wide = widen(one, compared.ratio)
    assert wide.std == pytest.approx(compared.ratio * one.std)
    assert wide.budget["Fc"]["differences between logs"] > 0


@pytest.mark.slow
def test_damaged_logs_are_not_called_valid_wrongly() -> None:
    rows = [one_log("rig", "joint", 900 + k, clean) for clean, runs in ((True, 12), (False, 8)) for k in range(runs)]
    told = "\n".join(summary(rows))
    clean = [r for r in rows if r["what"] == "clean"]
    wrong = [r for r in rows if r["what"] != "clean" and r["status"] == "valid" and r["worst"] > 4]
    assert sum(r["status"] == "valid" for r in clean) >= 11, told
    assert sum(r["inside"] for r in clean) > 0.82 * sum(r["of"] for r in clean), told
    assert len(wrong) <= 1, told
