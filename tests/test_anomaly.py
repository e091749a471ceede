"""What a log holds beside noise."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from excite.anomaly import shakes

T = np.arange(6000) / 100
THERE = ((T > 20) & (T < 32)).astype(float)


def driven(seed: int) -> np.ndarray:
    """A torque as a person drives it, with a sensor's noise."""
    rng = np.random.default_rng(seed)
    slow = scipy.signal.sosfiltfilt(scipy.signal.butter(2, 0.02, output="sos"), rng.normal(size=len(T)))
    return np.asarray(8000 * slow + 40 * rng.normal(size=len(T)))


@pytest.mark.parametrize("frequency", [18.0, 29.3, 45.0, 61.0])
def test_a_channel_shakes_where_a_vibration_is_on_it(frequency: float) -> None:
    """Down to an amplitude below its noise; also at a frequency that the sampling folds."""
    shaken = [driven(k) + 30 * THERE * np.sin(2 * np.pi * frequency * T) for k in range(20)]
    assert all(shakes(u, THERE) for u in shaken)


def test_no_channel_shakes_of_its_noise() -> None:
    assert sum(shakes(driven(k), THERE) for k in range(200)) <= 2


def test_what_is_always_there_cannot_be_told() -> None:
    assert shakes(driven(0), np.ones(len(T)))
