"""Objectives against finite differences, against what they are named after, and against the bound they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr
from support.drives import drive

from excite import smoothing
from excite.model import Model
from excite.simulation import Motion, simulate
from excite.trajectories import objective


def matrix(n: int, seed: int) -> np.ndarray:
    B = np.random.default_rng(seed).normal(size=(3 * n, n)) * np.logspace(0, 1, n)
    return B.T @ B


def along(name: str, A: np.ndarray, H: np.ndarray, sharp: float, h: float) -> tuple[float, float]:
    """First and second derivative of an objective at A along H, by differences."""
    low, middle, high = (objective.score_matrix(name, A + s * h * H, sharp) for s in (-1, 0, 1))
    return (high - low) / (2 * h), (high - 2 * middle + low) / h**2


@pytest.mark.parametrize("name", objective.OBJECTIVES)
@pytest.mark.parametrize("sharp", [3.0, 20.0])
def test_slope_is_the_derivative(name: str, sharp: float) -> None:
    A = matrix(5, 1)
    rows, columns = np.triu_indices(5)
    found = objective.local_model(name, A, rows, columns, sharp)
    assert found.value == pytest.approx(objective.score_matrix(name, A, sharp))
    for k, (i, j) in enumerate(zip(rows, columns, strict=True)):
        H = np.zeros_like(A)
        H[i, j] = H[j, i] = 1.0
        assert found.slope[k] == pytest.approx(along(name, A, H, sharp, 1e-5)[0], rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("name", ["D", "A", "worst", "accuracy"])
def test_curvature_is_exact_where_the_objective_is_convex(name: str) -> None:
    A = matrix(5, 2)
    rows, columns = np.triu_indices(5)
    found = objective.local_model(name, A, rows, columns, 4.0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        d = rng.normal(size=len(rows))
        H = np.zeros_like(A)
        H[rows, columns] = H[columns, rows] = d
        assert ((found.factor.T @ d) ** 2).sum() == pytest.approx(along(name, A, H, 4.0, 1e-3)[1], rel=2e-2, abs=1e-7)


def test_scores_are_what_they_are_called() -> None:
    A = matrix(6, 3)
    eigenvalues, variances = np.linalg.eigvalsh(A), np.diag(np.linalg.inv(A))
    assert objective.reported_value("cond", objective.score_matrix("cond", A)) == pytest.approx(
        np.sqrt(eigenvalues[-1] / eigenvalues[0]), rel=1e-5
    )
    assert objective.score_matrix("D", A) == pytest.approx(-np.linalg.slogdet(A)[1] / 6)
    assert objective.score_matrix("A", A) == pytest.approx(np.log(variances.sum()))
    assert objective.score_matrix("E", A) == pytest.approx(-np.log(eigenvalues[0]), rel=1e-5)
    assert objective.reported_value("worst", objective.score_matrix("worst", A)) == pytest.approx(
        100 * np.sqrt(variances.max()), rel=1e-5
    )


def test_singular_information_is_infinitely_bad() -> None:
    A = matrix(4, 4)
    A[:, 3] = A[3] = 0
    for name in objective.OBJECTIVES:
        assert objective.score_matrix(name, A) == np.inf


def test_unknown_objective_is_refused() -> None:
    with pytest.raises(KeyError):
        objective.score_matrix("beauty", matrix(3, 0))


def test_rows_count_by_what_disturbs_them(va12: Model) -> None:
    """Torque rows by their sensor, the root's by the torque noise that the rolls pass on."""
    noise = dict(zip(va12.coordinates, objective.row_noise(va12), strict=True))
    assert (noise["theta1"], noise["theta2"], noise["theta4"]) == (40, 100, 40)
    assert noise["x0"] == noise["y0"] == pytest.approx(40 / 0.65)


@pytest.mark.slow
def test_accuracy_ranks_drives_as_the_bound_of_all_sensors_does(va12: Model) -> None:
    """Over random drives the worst weighted variance ranks as the Cramer-Rao bound; cond(Phi) does not."""
    rng = np.random.default_rng(0)
    bound, score, cond = [], [], []
    for seed in range(12):
        size = rng.uniform(0.4, 1.4)
        motion: Motion = simulate(
            va12, drive(va12, 60, seed, {"u1": 1200 * size, "u2": 4500 * size, "u4": 1200 * size})
        )
        std = np.sqrt(np.diag(smoothing.cramer_rao(va12, motion, "full"))) / np.abs(va12.nominal)
        P = objective.phi(va12, motion, "worst")
        bound.append(std.max())
        score.append(objective.score_matrix("worst", P.T @ P))
        cond.append(objective.cond_phi(va12, motion))
    assert spearmanr(bound, score)[0] > 0.8
    assert spearmanr(bound, score)[0] > spearmanr(bound, cond)[0]
