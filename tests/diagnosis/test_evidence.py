"""Evidence for effects beside unknown forces, against the same likelihoods computed from the data directly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy
from support.logs import calm

from excite.diagnosis import evidence, score_test
from excite.diagnosis.evidence import Form
from excite.diagnosis.score_test import Candidate
from excite.model import Model
from excite.model.effects import CATALOGUE, PlacedEffect
from excite.smoothing import SIZE_SCATTER, forward, state_scale, whiten_signatures


def candidates(widths: Sequence[int]) -> tuple[Candidate, ...]:
    """Candidates of either sign at places of their own, with so many columns each."""
    ends = np.cumsum(widths)
    torque_gain = CATALOGUE["torque_gain"]
    return tuple(
        Candidate(PlacedEffect(torque_gain, f"place_{k}", (1,), (), {"A": 1e-9}), tuple(range(end - width, end)))
        for k, (end, width) in enumerate(zip(ends, widths, strict=True))
    )


@dataclass(frozen=True)
class Linear:
    """Data y (N,) of unit noise: y = P theta + U c + V a + noise, with theta of a precision, c of groups."""

    y: np.ndarray
    P: np.ndarray
    U: np.ndarray
    V: np.ndarray
    precision: np.ndarray
    group: np.ndarray
    candidates: tuple[Candidate, ...]
    std: np.ndarray

    @property
    def form(self) -> Form:
        every = np.hstack([self.P, self.U, self.V])
        information = every.T @ every
        K = self.P.shape[1]
        information[:K, :K] += np.diag(self.precision)
        names = tuple(f"group {k}" for k in range(self.group.max() + 1))
        return Form(information, every.T @ self.y, K, self.group, names, self.candidates, self.std)

    def covariance(self, chosen: Sequence[Candidate], logs: np.ndarray | None) -> np.ndarray:
        """Return the covariance (N, N) of the data but for the parameters; without forces if logs is None."""
        columns = [c for x in chosen for c in x.columns]
        C = np.eye(len(self.y)) + (self.V[:, columns] * self.std[columns] ** 2) @ self.V[:, columns].T
        return C if logs is None else C + (self.U * np.exp(2 * logs[self.group])) @ self.U.T

    def gain(self, chosen: Sequence[Candidate], logs: np.ndarray) -> float:
        """Return twice the logarithm of the likelihood's ratio to that of neither candidates nor forces."""
        of_parameters = (self.P / self.precision) @ self.P.T
        covariances = self.covariance(chosen, logs), self.covariance((), None)
        with_them, without = (
            scipy.stats.multivariate_normal.logpdf(self.y, cov=C + of_parameters) for C in covariances
        )
        return 2 * float(with_them - without)


def linear(seed: int = 0, widths: Sequence[int] = (1, 2, 1), precision: float = 0.5) -> Linear:
    rng = np.random.default_rng(seed)
    N, K, group = 80, 3, np.array([0, 0, 0, 1, 1])
    P, U, V = (rng.standard_normal((N, n)) for n in (K, len(group), sum(widths)))
    V += 0.5 * P[:, :1] + 0.4 * U[:, :1]
    y = P @ np.array([1.0, -0.5, 0.3]) + 0.4 * U[:, 3] + V @ np.resize([0.6, -0.2, 0.3, 0.0], V.shape[1])
    std = rng.uniform(0.3, 1.5, V.shape[1])
    return Linear(
        y + rng.standard_normal(N), P, U, V, np.full(K, precision) * [1.0, 2.0, 3.0], group, candidates(widths), std
    )


LOGS = np.array([-1.0, 0.2])  # of the sizes


@pytest.mark.parametrize("chosen", [(), (0,), (1,), (0, 2), (2, 1, 0)])
def test_the_gain_is_the_ratio_of_marginal_likelihoods(chosen: Sequence[int]) -> None:
    """With parameters, coefficients and amounts integrated out of the data's own density; scattered sizes cost."""
    x = linear()
    own = [x.candidates[k] for k in chosen]
    found = evidence.posterior(x.form.reduced(), own, LOGS, 0)
    scatter = float(np.sum((LOGS - LOGS.mean()) ** 2)) / SIZE_SCATTER**2
    assert found.gain + scatter == pytest.approx(x.gain(own, LOGS), abs=1e-8)


def test_coefficients_and_amounts_are_those_of_the_conditional_density() -> None:
    x = linear()
    own = [x.candidates[1], x.candidates[0]]
    found = evidence.posterior(x.form.reduced(), own, LOGS, 0)
    columns = [*own[0].columns, *own[1].columns]
    both, size = np.hstack([x.U, x.V[:, columns]]), np.r_[np.exp(LOGS)[x.group], x.std[columns]]
    inverse = np.linalg.inv(x.covariance(own, LOGS) + (x.P / x.precision) @ x.P.T)
    cross = size[:, None] ** 2 * both.T
    np.testing.assert_allclose(found.mean, cross @ inverse @ x.y, atol=1e-9)
    np.testing.assert_allclose(found.std**2, size**2 - np.diag(cross @ inverse @ cross.T), atol=1e-9)
    first, second = found.factors(x.form, own)
    np.testing.assert_array_equal(np.r_[first, second], found.mean[len(x.group) :])
    assert (len(first), len(second)) == (2, 1)


@pytest.mark.parametrize("chosen", [(), (2,), (1,)])
def test_each_further_candidate_gains_the_ratio_of_the_likelihoods_with_and_without_it(chosen: Sequence[int]) -> None:
    x = linear()
    own = [x.candidates[k] for k in chosen]
    gains = evidence.first_gains(x.form.reduced(), own, LOGS)
    for k in set(range(3)) - set(chosen):
        assert gains[k] == pytest.approx(x.gain([*own, x.candidates[k]], LOGS) - x.gain(own, LOGS), abs=1e-8)


def test_sizes_are_the_most_likely_ones() -> None:
    x = linear()
    own = [x.candidates[0]]
    best = evidence.posterior(x.form.reduced(), own)
    for step in 0.05 * np.vstack([np.eye(2), -np.eye(2)]):
        logs = best.logs + step
        assert x.gain(own, logs) - float(np.sum((logs - logs.mean()) ** 2)) / SIZE_SCATTER**2 < best.gain


def test_a_sign_that_no_machine_has_gains_nothing() -> None:
    x = linear(widths=(1, 1, 1))
    lag = PlacedEffect(CATALOGUE["actuator_lag"], "front_roll", (1,), (), {"A": 1e-9})
    for sign, possible in ((1.0, True), (-1.0, False)):
        one = replace(x, candidates=(Candidate(lag, (0,)), *x.candidates[1:]), V=x.V * [sign, 1.0, 1.0])
        assert np.isfinite(evidence.first_gains(one.form.reduced(), (), LOGS)).tolist() == [possible, True, True]


def test_parameters_without_a_prior_take_no_part() -> None:
    """The ratio is that of what no parameter moves: the data across the parameters' columns."""
    x = linear(precision=0.0)
    across = scipy.linalg.null_space(x.P.T)

    def log_likelihood(chosen: Sequence[Candidate], logs: np.ndarray | None) -> float:
        C = across.T @ x.covariance(chosen, logs) @ across
        return float(scipy.stats.multivariate_normal.logpdf(across.T @ x.y, cov=C))

    form, own = x.form.reduced(), [x.candidates[0], x.candidates[1]]
    assert form.outer == 0
    assert len(form.right_side) == len(x.group) + len(x.std)
    for chosen in ([], own[:1], own):
        found = evidence.posterior(form, chosen, np.zeros(2), 0)
        assert found.gain == pytest.approx(
            2 * (log_likelihood(chosen, np.zeros(2)) - log_likelihood((), None)), abs=1e-8
        )


def test_a_form_without_parameters_is_that_of_data_without_what_they_hold() -> None:
    x, at, value = linear(), [2, 0], np.array([0.7, -1.1])
    held = x.form.without(at, value)
    rest = replace(x, y=x.y - x.P[:, at] @ value, P=x.P[:, [1]], precision=x.precision[[1]])
    assert held.outer == 1
    np.testing.assert_allclose(held.information, rest.form.information, atol=1e-10)
    np.testing.assert_allclose(held.right_side, rest.form.right_side, atol=1e-10)
    chosen = [x.candidates[1]]
    found = evidence.posterior(held.reduced(), chosen, LOGS, 0).gain
    assert found == pytest.approx(evidence.posterior(rest.form.reduced(), chosen, LOGS, 0).gain)


def pairs(rng: np.random.Generator, amounts: np.ndarray) -> Linear:
    """Thirty columns in pairs that correlate at 0.9, with these amounts, beside two groups of unknown forces."""
    N, group = 300, np.repeat([0, 1], 6)
    P, U = rng.standard_normal((N, 4)), rng.standard_normal((N, len(group)))
    common, own = rng.standard_normal((N, 15)).repeat(2, axis=1), rng.standard_normal((N, 30))
    V = np.sqrt(0.9) * common + np.sqrt(0.1) * own
    y = P.sum(axis=1) + V @ amounts + rng.standard_normal(N)
    return Linear(y, P, U, V, np.full(4, 1e-2), group, candidates([1] * 30), np.full(30, 2.0))


def test_two_hidden_causes_are_told_from_what_is_like_them() -> None:
    """Each among its like, which alone would explain eight tenths of it, both at once."""
    amounts = np.zeros(30)
    amounts[[4, 21]] = 0.8, -0.6
    for seed in range(10):
        x = pairs(np.random.default_rng(seed), amounts)
        found = evidence.choose(x.form)
        assert {c.name for c in found.candidates} == {x.candidates[4].name, x.candidates[21].name}
        for c, factor in zip(found.candidates, found.factors, strict=True):
            assert factor == pytest.approx(amounts[list(c.columns)], abs=0.7)
        assert min(found.gains) > evidence.least_gain(x.form)
        assert found.left < evidence.least_gain(x.form)


def test_noise_has_no_name() -> None:
    named = [bool(evidence.choose(pairs(np.random.default_rng(k), np.zeros(30)).form).candidates) for k in range(200)]
    assert np.mean(named) <= 0.02


def test_forces_that_nothing_names_give_no_name() -> None:
    """What the columns of unknown forces make, no candidate gets, though it may look like it."""
    rng, named = np.random.default_rng(0), 0
    for k in range(50):
        x = pairs(np.random.default_rng(k), np.zeros(30))
        V = x.V + 0.5 * x.U[:, rng.integers(0, 12, 30)]
        lacking = x.U @ rng.normal(0, 1.0, 12)
        x = replace(x, V=V, y=x.y + lacking)
        found = evidence.choose(x.form)
        named += bool(found.candidates)
        assert found.left > evidence.least_gain(x.form)
    assert named <= 1


def test_a_force_moves_the_innovations_as_its_column_says(straight: Model) -> None:
    """The change of the motion from sample to sample when a force that the model may lack acts, filtered."""
    stage = calm(straight)
    space, (own,), bare = stage.data.space, stage.lacking.lacking, stage.fit
    (log,) = score_test.fitted_logs(space, stage.measurements, bare)
    columns = score_test.beside(log, own).white.E[:, :, log.white.E.shape[2] :]
    assert columns.shape[2] == own.count > 20

    def ends(coefficients: np.ndarray) -> np.ndarray:
        along = replace(bare.trajectories[0], lacking=coefficients)
        at = forward.evaluate(space, stage.measurements[0], along, stage.data.starts[0].state[0], bare.X, own)
        assert at is not None
        return at.defect / state_scale(space)

    push = np.zeros((len(log.t), space.n, own.count))
    for k, step in enumerate(0.05 * np.eye(own.count)):
        push[:-1, :, k] = (ends(step) - ends(-step)) / 0.1
    reading = np.zeros((*log.linear.residual.shape, own.count))
    filtered = whiten_signatures(log.linear, log.white, lambda at: (push[at], reading[at]))
    moved = np.concatenate([E for _, E in filtered])
    size = np.linalg.norm(moved, axis=(0, 1))
    assert (size > 1).sum() > 20
    assert (np.linalg.norm(columns - moved, axis=(0, 1)) < 0.01 * size + 1e-3).all()
