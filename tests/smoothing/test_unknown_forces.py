"""What a model lacks: nothing along clean logs, and what is hidden along others, with parameters that stay right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from support.drives import designed, drive
from support.logs import make_log

from excite.logs import Log
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.model.machine.machine import load_machine
from excite.simulation import Motion, simulate
from excite.smoothing import (
    Fit,
    LinearisedLog,
    Measurements,
    Settings,
    StateSpace,
    Trajectory,
    average_over_sizes,
    build_state_space,
    common_sensors,
    describe_missing,
    fit_logs,
    fit_unknown_forces,
    forward,
    lacks_forces,
    log_variance,
    prepare_logs,
    sizes,
)
from excite.smoothing.innovations import expected_squares
from excite.smoothing.log_fit import Determinant, linearise_with
from excite.smoothing.sizes import FORCES
from excite.smoothing.unknown_forces import Group, Lacking, UnknownForces, catalogue

SUPPORT = Path(__file__).parents[1] / "support"


@pytest.fixture(scope="module")
def S40(straight: Model) -> Motion:
    return designed("S40", straight)


def prepared(model: Model, log: Log) -> tuple[StateSpace, Sequence[Measurements], Sequence[Trajectory], np.ndarray]:
    space = build_state_space(model, common_sensors(model, [log]), True)
    measurements, starts = prepare_logs(space, [log], model.machine.filter, unbiased=True)
    return space, measurements, starts, np.zeros(len(model.nominal), bool)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_clean_log_lacks_nothing(straight: Model, S40: Motion, seed: int) -> None:
    """Its fit of exact dynamics is the answer, found in a few steps that each lower the merit."""
    space, measurements, starts, held = prepared(straight, make_log(straight, S40, seed=seed))
    exact = fit_logs(space, measurements, starts, straight.nominal, starts, held)
    assert exact.status == "converged"
    assert len(exact.history) <= 8
    assert all(after < before for before, after in exact.history)
    assert not lacks_forces(space, measurements, starts, held, exact)
    assert (np.abs(exact.X - straight.nominal) < 4 * exact.std).all()


@pytest.mark.parametrize("name", ["va12_straight", "rig"])
def test_slopes_of_the_innovations_determinant(name: str) -> None:
    """By every parameter and by the size of every torque error, they are difference quotients of the determinant."""
    model = prediction.build(load_machine(str(SUPPORT / "rig.toml") if name == "rig" else name))
    motion = simulate(model, drive(model, 5, 0, dict.fromkeys(model.inputs, 100.0 if name == "rig" else 1200.0)))
    space, (data,), (start,), held = prepared(model, make_log(model, motion, seed=1))
    white = np.array([300.0 * (kind in FORCES) for _, kind in space.forces])
    unknown = catalogue(space, [(data, start)], model.nominal, white)
    fit = fit_logs(space, [data], [start], model.nominal, [start], held, settings=Settings(4))
    some = 0.02 * np.random.default_rng(0).standard_normal(unknown.count)

    def linearised(
        X: np.ndarray, data: Measurements = data, more: float | np.ndarray = 0.0
    ) -> tuple[forward.Evaluation, LinearisedLog]:
        along = replace(fit.trajectories[0], lacking=some + more, force_error=None)
        at = forward.evaluate(space, data, along, start.state[0], X, unknown.lacking[0])
        assert at is not None
        return at, forward.linearise(space, at, start.state[0], X)

    def change(step: np.ndarray, noise: np.ndarray) -> float:
        values = []
        for sign in (1, -1):
            louder = replace(data.noise, torque=data.noise.torque * np.exp(sign * noise))
            values.append(log_variance(linearised(fit.X + sign * step, replace(data, noise=louder))[1]))
        return values[0] - values[1]

    at, linear = linearised(fit.X)
    n, n_u = len(fit.X), len(model.inputs)
    slope, by_coefficients = forward.log_variance_slopes(space, at, linear, fit.X, ~held)
    step, none = 1e-3 * np.diag(model.scale), np.zeros(n_u)
    np.testing.assert_allclose(slope, [change(s, none) / 2e-3 for s in step], rtol=0.01, atol=1e-3)
    of_soil = np.argsort(-np.abs(by_coefficients))[: 5 * len(model.machine.contacts)]
    for k in of_soil:
        more = 1e-2 * np.eye(unknown.count)[k]
        there = [log_variance(linearised(fit.X, more=sign * more)[1]) for sign in (1, -1)]
        assert by_coefficients[k] == pytest.approx((there[0] - there[1]) / 2e-2, rel=0.05)
    explained = expected_squares(linear)[:n_u]
    np.testing.assert_allclose(explained, [change(np.zeros(n), s) / 4e-3 for s in 1e-3 * np.eye(n_u)], rtol=1e-3)


def test_constant_errors_are_shares_of_stiffness_and_torque(va12: Model) -> None:
    motion = simulate(va12, drive(va12, 6, 0, dict.fromkeys(va12.inputs, 1200.0)))
    space, (data,), (start,), _ = prepared(va12, make_log(va12, motion, seed=1))
    names = list(va12.base.names)
    typical = catalogue(space, [(data, start)], va12.nominal, np.zeros(len(space.forces))).constant_errors
    assert typical[names.index("Kx1")] == pytest.approx(0.05 * abs(va12.nominal[names.index("Kx1")]))
    large = np.quantile(np.abs(data.torque[:, 0]), 0.99)
    assert typical[names.index("Fs1")] == pytest.approx(0.02 * large, rel=0.1)
    assert typical[names.index("u10")] == pytest.approx(0.005 * large, rel=0.1)
    assert {n for n, x in zip(names, typical, strict=True) if x} == {n for n in names if n[0] in "uFK"}


def test_the_pull_of_the_determinant_moves_values_and_is_no_information(straight: Model, S40: Motion) -> None:
    space, measurements, starts, held = prepared(straight, make_log(straight, S40, seed=1))
    exact = fit_logs(space, measurements, starts, straight.nominal, starts, held)
    slope = np.zeros(len(held))
    slope[0] = -0.1 * exact.information[0, 0]
    pull = Determinant(slope, exact.X, np.zeros(0), np.zeros(0))
    pulled = fit_logs(space, measurements, exact.trajectories, exact.X, starts, held, pull=pull)
    assert pulled.status == "converged"
    assert pulled.X[0] > exact.X[0] + 3 * exact.std[0]
    alone = linearise_with(space, measurements, pulled.trajectories, pulled.X, starts, held, pulled.unknown)
    assert alone is not None
    np.testing.assert_allclose(pulled.std, alone.std, rtol=2e-3)


@pytest.mark.slow
def test_hidden_effects_are_told_and_leave_the_mass_right(straight: Model, S40: Motion) -> None:
    texts = ("rolling_resistance@front_roll=150", "ground_slope@machine=0.003", "actuator_lag@front_roll=0.015")
    entries = [placing.parse_effect(text, straight.machine, float(S40.t[-1])) for text in texts]
    hidden = prediction.build(placing.with_effects(straight.machine, *entries))
    motion = simulate(hidden, S40.u, q0=S40.q[0], nu0=S40.nu[0])
    space, measurements, starts, held = prepared(straight, make_log(hidden, motion, seed=1, known=straight))
    found = fit_unknown_forces(space, measurements, starts, held)

    fit = found.fit
    assert fit.status == "converged"
    assert all(after < before for before, after in fit.history)
    assert fit.X[straight.base.names.index("M")] == pytest.approx(11000, rel=0.02)
    late = next(g for g in fit.unknown.groups if g.name == "front_roll: torque late")
    (coefficient,) = fit.unknown.coefficients(fit.trajectories)[late.every]
    assert coefficient * late.typical == pytest.approx(0.015, abs=0.003)
    assert late.name in {m.name for m in describe_missing(space, fit.unknown, fit.trajectories)}


def test_values_are_averaged_over_sizes_as_the_whole_form_says() -> None:
    """By the evidence, mean and covariance of every size, from dense matrices."""
    rng, n, count = np.random.default_rng(3), 2, 3
    A = rng.standard_normal((12, n + count))
    likelihood, right = A.T @ A, A.T @ (3 * rng.standard_normal(12))
    size = 0.05
    prior = np.diag([0.0] * n + [1.0] * count)
    information = likelihood + prior / size**2
    group = Group("force", "N", 1.0, (np.arange(count),))
    constant_errors = np.array([0.3, 0.0])
    unknown = UnknownForces((Lacking((), (), count, np.zeros(0)),), (group,), np.array([size]), constant_errors)
    X, scale, spread = np.array([5.0, -1.0]), np.array([2.0, 0.1]), np.array([1.0, 1.7])
    covariance = np.linalg.inv(information)[:n, :n] * np.outer(scale * spread, scale * spread)
    free = np.zeros(n, bool)
    fit = Fit(X, covariance, free, np.zeros(n), (), (), 1.0, "converged", 0.0, (), unknown, information, right)
    model = SimpleNamespace(scale=scale, positive=free)
    found = average_over_sizes(cast(StateSpace, SimpleNamespace(model=model, soil=np.zeros((0, n)))), fit)

    means, covariances, evidence, prior_weight = [], [], [], []
    for log in sizes.LEVELS:
        own = likelihood + prior * np.exp(-2 * log)
        means.append(np.linalg.solve(own, right)[:n])
        covariances.append(np.linalg.inv(own)[:n, :n])
        evidence.append(right @ np.linalg.solve(own, right) / 2 - np.linalg.slogdet(own)[1] / 2 - count * log)
        prior_weight.append(np.exp(-((log - np.log(size)) ** 2) / 2 / sizes.AVERAGED_SCATTER**2))
        evidence[-1] += np.log(prior_weight[-1])
    weight = np.exp(evidence - np.max(evidence))
    weight /= weight.sum()
    mean = weight @ means
    whole = sum(w * (C + np.outer(m - mean, m - mean)) for w, C, m in zip(weight, covariances, means, strict=True))
    share = np.average(np.exp(2 * sizes.LEVELS), weights=prior_weight)  # of which no log tells anything
    moved = mean - np.linalg.solve(information, right)[:n]
    np.testing.assert_allclose(found.X, X + scale * moved)
    expected = whole * np.outer(scale * spread, scale * spread) + np.diag(share * constant_errors**2)
    np.testing.assert_allclose(found.covariance, expected)
    back = np.diag(np.sign(moved)) / scale  # what falls with every move
    held = average_over_sizes(cast(StateSpace, SimpleNamespace(model=model, soil=back)), replace(fit, X=np.zeros(n)))
    np.testing.assert_array_equal(held.X, np.zeros(n))


def test_clustered_inflation_equals_refits_without_each_stretch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By fits anew without each stretch of 2 s, of readings whose errors are slow, and of white ones."""
    rng, rate, N, n, count = np.random.default_rng(5), 10.0, 400, 2, 4
    A = rng.standard_normal((N, 1, n + count))
    A[:, 0, 0] = 1.0
    slow = np.repeat(rng.standard_normal(N // 20), 20)
    prior = np.eye(n + count) / 9
    for errors, correlated in ((slow, True), (rng.standard_normal(N), False)):
        readings = A[:, 0] @ rng.standard_normal(n + count) + errors
        information = prior + A[:, 0].T @ A[:, 0]
        best = np.linalg.solve(information, A[:, 0].T @ readings)
        E = np.concatenate([(A[:, 0] @ best - readings)[:, None, None], A], axis=2)
        monkeypatch.setattr(sizes, "whiten", lambda log, E=E: SimpleNamespace(E=E))
        free = np.zeros(n, bool)
        lacking = UnknownForces((Lacking((), (), count, np.zeros(0)),), (Group("f", "N", 1.0, (np.arange(count),)),))
        trajectory = cast(Trajectory, SimpleNamespace(offset=np.zeros(0)))
        log = (cast(LinearisedLog, None),)
        fit = Fit(
            best[:n], np.eye(n), free, free, (trajectory,), log, 1.0, "converged", 0.0, (), lacking, information, best
        )
        moved = []
        for begin in range(0, N, 20):
            kept = np.r_[0:begin, begin + 20 : N]
            own = prior + A[kept, 0].T @ A[kept, 0]
            moved.append(np.linalg.solve(own, A[kept, 0].T @ readings[kept]) - best)
        expected = np.sqrt(np.sum(np.square(moved), axis=0) / np.diag(np.linalg.inv(information)))[:n]
        found = sizes.clustered_inflation(fit, rate)
        np.testing.assert_allclose(found, np.maximum(expected, 1.0))
        assert (found[0] > 3.0) == correlated
