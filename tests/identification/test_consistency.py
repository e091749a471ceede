"""Physically possible parameters: which are, and the nearest ones to those that aren't."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.logs import make_log

from excite.identification import Estimate, methods
from excite.identification.consistency import is_possible, nearest_possible
from excite.model import Model, standard_parameters
from excite.simulation import Motion


def estimate(model: Model, value: np.ndarray, std: np.ndarray) -> Estimate:
    return Estimate(
        "ols", model.base.names, model.base.units, value, np.diag(std**2), 1, 1, 1, np.zeros((1, 1)), 100, {}, ()
    )


@pytest.mark.parametrize("fixture", ["va12", "straight", "emps"])
def test_machine_files_are_possible(request: pytest.FixtureRequest, fixture: str) -> None:
    model: Model = request.getfixturevalue(fixture)
    assert is_possible(model, model.nominal)


@pytest.mark.parametrize("name", ["M", "ZZ1", "ZZ2", "ZZ0R", "Fv1", "Fs2", "Kx1", "Ky4"])
def test_wrong_signs_are_not_possible(va12: Model, name: str) -> None:
    X = va12.nominal.copy()
    X[va12.base.names.index(name)] *= -1
    assert not is_possible(va12, X)
    found = nearest_possible(va12, estimate(va12, X, 0.05 * va12.scale))
    assert is_possible(va12, found.value)
    assert "no real machine" in found.notes[-1]


def test_offsets_and_moments_may_have_any_sign(va12: Model) -> None:
    X = va12.nominal.copy()
    for name in ("u10", "u20", "u40", "MY0", "MY2"):
        X[va12.base.names.index(name)] *= -1
    assert is_possible(va12, X)


def test_inertia_about_the_centre_of_mass_counts(va12: Model) -> None:
    """A rear chassis with a positive ZZ2 that is less than its first moment allows: MX2^2 / mass <= ZZ2."""
    X = va12.nominal.copy()
    mass, moment = (X[va12.base.names.index(n)] for n in ("M", "MX2"))
    k = va12.base.names.index("ZZ2")
    X[k] = 0.9 * moment**2 / mass
    assert X[k] > 0
    assert not is_possible(va12, X)


def test_what_is_possible_stays_as_it_is(straight: Model) -> None:
    before = estimate(straight, 1.02 * straight.nominal, 0.1 * straight.scale)
    after = nearest_possible(straight, before)
    assert (after.value == before.value).all()
    assert after.method == "ols+consistent"
    assert "possible as it is" in after.notes[-1]


def test_the_nearest_machine_in_the_metric_of_the_data(straight: Model) -> None:
    """One negative friction, correlated 0.8 with another parameter: the closed form of the projection."""
    a, b = straight.base.names.index("Fv1"), straight.base.names.index("Fs1")
    X = straight.nominal.copy()
    X[a] = -10.0
    std = 0.05 * straight.scale
    covariance = np.diag(std**2)
    covariance[a, b] = covariance[b, a] = 0.8 * std[a] * std[b]
    before = replace(estimate(straight, X, std), covariance=covariance)
    after = nearest_possible(straight, before)
    assert after.value[a] == pytest.approx(0.0, abs=1e-3)
    assert after.value[b] == pytest.approx(X[b] + 10.0 * covariance[a, b] / covariance[a, a], rel=1e-4)
    others = [k for k in range(len(X)) if k not in (a, b)]
    assert after.value[others] == pytest.approx(X[others], rel=1e-5)


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_random_bodies_are_possible_and_random_vectors_become_so(straight: Model, seed: int) -> None:
    rng = np.random.default_rng(seed)
    table = standard_parameters(straight.machine)
    bodies = {n: v * rng.uniform(0.3, 3) for n, (v, _) in table.items() if n[0] in "FK" or n in ("M1", "M4")}
    assert is_possible(straight, straight.base_values(bodies))
    X = straight.nominal * rng.uniform(-1, 2, len(straight.nominal))
    assert is_possible(straight, nearest_possible(straight, estimate(straight, X, 0.1 * straight.scale)).value)


def test_unknown_parameters_stay_unknown(straight: Model) -> None:
    X = straight.nominal.copy()
    X[0], X[2] = np.nan, -1.0
    std = np.where(np.isfinite(X), 0.1 * straight.scale, np.nan)
    found = nearest_possible(straight, estimate(straight, X, std))
    assert np.isnan(found.value[0])
    assert found.value[2] >= 0


def test_composes_with_least_squares(va12: Model, va12_motion: Motion) -> None:
    """Ordinary least squares on this drive gives a negative viscous friction, ten times too large."""
    one = make_log(va12, va12_motion, seed=100)
    plain = methods.identify(va12, [one], "ols")
    found = methods.identify(va12, [one], "ols+consistent")
    assert not is_possible(va12, plain.value)
    assert is_possible(va12, found.value)
    assert found.relative_error_percent >= plain.relative_error_percent
    assert {f"{m}+consistent" for m in ("ols", "inverse")} <= set(methods.METHODS)
