"""The inverse form of maximum likelihood finds the truth of rigs and arms, also with faulty sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy
from support.drives import arm_motion

from excite.identification import Estimate, identify, recommend_method
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.simulation import measure, motion_along
from excite.smoothing import InverseSettings, fit_inverse

SUPPORT = Path(__file__).parents[1] / "support"


@pytest.fixture(scope="module")
def rig() -> Model:
    return build(load_machine(SUPPORT / "rig.toml"))


def driven(model: Model, seed: int, seconds: float = 10.0) -> pd.DataFrame:
    """A log of the rig along exact sines, which begins and ends in motion."""
    t = np.arange(round(seconds * 1000)) / 1000
    phase = np.random.default_rng(3).uniform(0, 6.28, 5)
    q = sum(0.08 / k * np.sin(2 * np.pi * 0.2 * k * t + phase[k - 1]) for k in range(1, 6))
    spline = scipy.interpolate.make_interp_spline(t, q, k=5)
    at = t[::10]
    return measure(model, motion_along(model, at, *(spline(at, k)[:, None] for k in range(3))), seed=seed)


def found(model: Model, table: pd.DataFrame) -> Estimate:
    prepared = prepare(model, [table])
    return identify(prepared.model, prepared.logs, "inverse")


def off(model: Model, estimate: Estimate) -> np.ndarray:
    """Errors in standard deviations."""
    return np.asarray((estimate.value - model.nominal) / estimate.std)


def test_fully_driven_machines_get_the_inverse_form(rig: Model) -> None:
    assert recommend_method(rig) == "inverse"
    assert recommend_method(build(load_machine("va12"))) == "joint"


def test_clean_logs_are_unbiased_and_known_well(rig: Model) -> None:
    estimates = [found(rig, driven(rig, seed)) for seed in range(4)]
    errors = np.array([off(rig, e) for e in estimates])
    assert np.abs(errors).max() < 3.3
    assert np.abs(errors.mean(axis=0)).max() < 2.0  # four logs of unit deviation: 0.5
    assert max(e.std[0] for e in estimates) < 0.3  # kg of 95


def test_a_late_force_is_seen_and_leaves_the_mass_right(rig: Model) -> None:
    table = driven(rig, 1)
    table["u_N"] = np.roll(table["u_N"], 3)
    prepared = prepare(rig, [table.iloc[5:]])
    fit = fit_inverse(prepared.model, prepared.logs)
    assert fit.shift[0] == pytest.approx(0.03, abs=0.001)
    assert fit.X[0] == pytest.approx(95.1, abs=1.0)


def test_outliers_and_heavy_tails_do_no_harm(rig: Model) -> None:
    table, rng = driven(rig, 2), np.random.default_rng(5)
    hit = rng.random(len(table)) < 0.05
    table["u_N"] += np.where(hit, rng.normal(0, 12, len(table)), rng.laplace(0, 0.7, len(table)))
    prepared = prepare(rig, [table])
    fit = fit_inverse(prepared.model, prepared.logs)
    std = np.sqrt(np.diag(fit.covariance))
    assert np.abs((fit.X - rig.nominal) / std).max() < 4
    assert std[0] < 0.6


def test_accepted_steps_never_raise_the_cost(rig: Model) -> None:
    prepared = prepare(rig, [driven(rig, 4)])
    fit = fit_inverse(prepared.model, prepared.logs, InverseSettings(discrepancy=False))
    assert fit.status == "converged"
    assert all(after <= before * (1 + 1e-8) for before, after in fit.costs)


def test_a_force_that_the_model_lacks_is_reported_and_widens_intervals(rig: Model) -> None:
    table = driven(rig, 6)
    clean = found(rig, table)
    table["u_N"] += 6 * np.sin(table["q_m"] / 0.03)
    with_cogging = found(rig, table)
    assert not any(d.rms > 1 for d in clean.discrepancy)
    assert any(d.kind == "with position" and d.rms > 2 for d in with_cogging.discrepancy)
    assert with_cogging.std[0] > 1.2 * clean.std[0]
    assert abs(off(rig, with_cogging)[0]) < 4


def test_constant_speed_leaves_the_mass_unidentified(rig: Model) -> None:
    t, rng = np.arange(1000) / 100, np.random.default_rng(7)
    sign = np.array([1.0, -1.0])
    tables = [
        pd.DataFrame(
            {
                "t_s": t[:300],
                "q_m": s * v * t[:300] + 1e-6 * rng.standard_normal(300),
                "u_N": s * (203.5 * v + 20.4) - 3.16 + rng.standard_normal(300),
            }
        )
        for v in (0.03, 0.07)
        for s in sign
    ]
    prepared = prepare(rig, tables)
    estimate = identify(prepared.model, prepared.logs, "inverse")
    assert "M" in estimate.unidentifiable
    assert np.abs(off(rig, estimate)[1:]).max() < 4


def test_an_arm_of_two_joints_comes_out_right() -> None:
    model = build(load_machine(SUPPORT / "two_joints.toml"))
    fine = np.arange(0, 12, 0.002)
    q, _, _ = arm_motion(fine, 0.9)
    spline = scipy.interpolate.make_interp_spline(fine, q.T, k=5)
    t = fine[::10]
    estimate = found(model, measure(model, motion_along(model, t, spline(t), spline(t, 1), spline(t, 2)), seed=2))
    assert np.abs(off(model, estimate)).max() < 4
