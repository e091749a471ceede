"""The prior of smooth motions: quadratic forms, determinants and spectra by other means; which derivative is white."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy
from support.damaged_logs import lively

from excite.logs import prepare
from excite.model import build
from excite.model.machine import load_machine
from excite.simulation import measure
from excite.smoothing import InverseSettings, fit_inverse
from excite.smoothing.inverse_fit import unresolved_variance
from excite.smoothing.motion_readings import (
    JointMotion,
    Readings,
    StartPrior,
    choose_knots,
    prior_log_determinant,
    prior_terms_of_motion,
    read_motion,
    speed_std,
)
from excite.smoothing.splines import DEGREE, ORDER, WHITE, Knots, place, roughness, sampled_basis

SUPPORT = Path(__file__).parents[1] / "support"


def spline(knots: Knots, coefficients: np.ndarray) -> scipy.interpolate.BSpline:
    at = knots.start + knots.step * np.arange(-DEGREE, knots.count + DEGREE + 1)
    return scipy.interpolate.BSpline(at, coefficients, DEGREE)


@pytest.mark.parametrize("white", WHITE)
def test_roughness_is_the_integral_of_the_squared_white_derivative(white: int) -> None:
    knots, rng = Knots(0.3, 0.2, 7, white), np.random.default_rng(white)
    coefficients = rng.standard_normal(knots.size)
    near = coefficients[np.arange(knots.count)[:, None] + np.arange(ORDER)]
    derivative = spline(knots, coefficients).derivative(white)
    edges = knots.start + knots.step * np.arange(knots.count + 1)
    x, w = np.polynomial.legendre.leggauss(6)
    inside = (edges[:-1, None] + edges[1:, None]) / 2 + knots.step / 2 * x
    assert roughness(knots, near)[0] == pytest.approx((derivative(inside) ** 2 @ w) * knots.step / 2, rel=1e-9)


@pytest.mark.parametrize("white", WHITE)
def test_the_determinant_of_the_prior_is_that_of_its_dense_matrix(white: int) -> None:
    """Also between counts, steps and orders, as these are compared by likelihood."""
    for count, step, intensity in ((4, 0.5, 2.0), (9, 0.5, 0.3), (9, 2.0, 5.0)):
        knots = Knots(0.0, step, count, white)
        start = StartPrior(np.zeros(white), np.arange(1.0, white + 1))
        local, _ = prior_terms_of_motion(knots, start, intensity, np.zeros(knots.size))
        dense = np.zeros((knots.size, knots.size))
        for k in range(count):
            dense[k : k + ORDER, k : k + ORDER] += local[k]
        assert prior_log_determinant(knots, start, intensity) == pytest.approx(np.linalg.slogdet(dense)[1], abs=1e-6)


@pytest.mark.parametrize("white", WHITE)
def test_the_error_of_a_smoothed_speed_is_the_integral_of_its_spectrum(white: int) -> None:
    t, noise, intensity = np.arange(1000) / 50, 1e-3, 7.0
    readings = Readings("q", 0, 0, t, np.zeros(1000), np.full(1000, noise), noise)
    R = noise**2 * np.ptp(t) / 1000
    spectrum = lambda w: w**2 * R / (1 + w ** (2 * white) * R / intensity) / np.pi  # noqa: E731
    expected = np.sqrt(scipy.integrate.quad(spectrum, 0, 2000, limit=500)[0])
    found = speed_std([[readings]], JointMotion((), white, intensity, {"q": 1.0}, 0.0))
    assert found == pytest.approx(expected, rel=1e-2)


def test_an_acceleration_that_is_linear_between_samples_moves_as_the_smooth_one_of_its_basis() -> None:
    """A sine sampled n times a turn and linear in between has a fundamental (n / pi sin(pi / n))^2 as large."""
    sample, w = 0.02, 2 * np.pi / (25 * 0.02)
    knots = Knots(0.0, 0.01, 200)
    at = np.linspace(knots.start, 2.0, 2001)
    smooth = scipy.interpolate.make_lsq_spline(
        at, np.sin(w * at), knots.step * np.arange(-DEGREE, knots.count + DEGREE + 1), DEGREE
    )
    interval, share = place(knots, at[200:-200])
    rows = sampled_basis(knots, share, sample)[:, 2]
    sampled = np.einsum("ri,ri->r", rows, smooth.c[interval[:, None] + np.arange(ORDER)])
    expected = -(w**2) * np.sin(w * at[200:-200]) / (25 / np.pi * np.sin(np.pi / 25)) ** 2
    assert np.abs(sampled - expected).max() < 2e-4 * w**2  # the next term of the series; 5e-3 without the first


def test_noise_is_told_from_motion_and_intervals_hold_on_clean_logs() -> None:
    """White jerk takes noise for motion: forces came out 4.6 times too noisy, encoders a thousand times too exact."""
    rig, z = build(load_machine(SUPPORT / "rig.toml")), []
    for seed in range(6):
        prepared = prepare(rig, [measure(rig, lively(rig, np.random.default_rng(seed)), seed=seed)])
        assert choose_knots(prepared.logs, [read_motion(prepared.model, log) for log in prepared.logs])[1][0].white == 5
        fit = fit_inverse(prepared.model, prepared.logs, InverseSettings(discrepancy=False))
        assert fit.sizes.noise[0] == pytest.approx(1.0, rel=0.1)
        assert fit.sizes.level["q1"] == pytest.approx(1.0, rel=0.4)
        std = np.sqrt(np.diag(fit.covariance))
        assert std[0] < 0.04  # [kg], a fifth of what it was
        z.append((fit.X - rig.nominal) / std)
    assert np.sqrt(np.mean(np.square(z), axis=0)).max() < 2.0
    assert np.abs(z).max() < 4.0


@pytest.mark.parametrize("offset", [0.0, 0.3])  # of the reversal from a row, in rows
def test_friction_that_turns_between_rows_is_unresolved_there_alone(offset: float) -> None:
    """20 N that turn within 2 mm/s, at 1 m/s2: rows of 20 ms see a jump, rows of 0.1 ms all of it."""
    friction: Any = SimpleNamespace(
        torque=SimpleNamespace(prediction=lambda chain, motion, X: 20 * np.tanh(motion[:, 1] / 2e-3) + motion[:, 1] * 5)
    )
    variance = []
    for sample in (0.02, 1e-4):
        t: Any = sample * np.arange(401)
        v = t - t[200] - offset * sample
        motion = np.stack([v**2 / 2, v, np.ones_like(v)], axis=1)[:, :, None]
        here = friction.torque.prediction(None, motion, None)
        variance.append(unresolved_variance(friction, SimpleNamespace(t=t), motion, here, np.zeros(0))[:, 0])  # type: ignore[arg-type]
    coarse, fine = variance
    assert (coarse[199:202] > 19.9**2 / 3).all()
    assert coarse.max() < 40.1**2 / 3
    assert max(coarse[:197].max(), coarse[204:].max()) < 1e-6
    assert fine.max() < 0.1**2


def test_a_motion_that_jolts_has_white_jerk() -> None:
    t, rng = np.arange(2000) / 100, np.random.default_rng(3)
    a = np.cumsum(rng.standard_normal(2000)) / 10
    q = np.cumsum(np.cumsum(a)) * 1e-4 + 1e-6 * rng.standard_normal(2000)
    rig = build(load_machine(SUPPORT / "rig.toml"))
    log = replace(prepare(rig, [measure(rig, lively(rig, np.random.default_rng(0)), seed=0)]).logs[0], t=t)
    motion = choose_knots([log], [[[Readings("q1", 0, 0, t, q, np.full(2000, 1e-6), 1e-9)]]])[1][0]
    assert motion.white == 3
    assert motion.intensity == pytest.approx(1.0, rel=0.5)  # steps of 0.1 m/s2 a hundred times a second
