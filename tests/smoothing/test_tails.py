"""Heavy tails: found in noise that has them, and not in faults of normal noise."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from excite.smoothing import normal_scores

N = 6000
FAULT = slice(1000, 1100)


def noise(kind: str, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if kind == "Laplace":
        return rng.laplace(0, 1 / np.sqrt(2), N)
    if kind == "t3":
        return rng.standard_t(3, N) / np.sqrt(3)
    z = rng.standard_normal(N)
    if kind == "outliers":
        z[rng.random(N) < 0.01] *= 8
    return z


@pytest.mark.parametrize("kind", ["Laplace", "t3", "outliers"])
def test_heavy_tails_become_normal_ones_of_the_same_size(kind: str) -> None:
    z = noise(kind)
    score = normal_scores(z)
    assert np.abs(z).max() > 6
    assert np.abs(score).max() < 6.5
    assert np.mean(score**2) == pytest.approx(np.mean(z**2))
    assert scipy.stats.spearmanr(z, score).statistic == pytest.approx(1)


def test_normal_noise_is_left_as_it_is() -> None:
    for seed in range(100):
        z = noise("normal", seed)
        assert normal_scores(z) is z


@pytest.mark.parametrize("fault", ["one outlier", "burst", "slow error", "late tone"])
def test_a_fault_in_normal_noise_is_no_heavy_tail(fault: str) -> None:
    z = noise("normal")
    if fault == "one outlier":
        z[FAULT.start] = 20
    elif fault == "burst":
        z[FAULT] *= 5
    elif fault == "slow error":
        z += 2 * np.sin(np.arange(N) / 500)
    else:
        z += 3 * np.sin(np.arange(N) / 5) * (np.arange(N) > 5000)
    assert normal_scores(z) is z


def test_a_burst_in_heavy_tailed_noise_is_still_seen() -> None:
    z = noise("Laplace")
    z[FAULT] *= 4
    score = normal_scores(z)
    assert np.mean(score[FAULT] ** 2) > 3 * np.mean(score**2)
