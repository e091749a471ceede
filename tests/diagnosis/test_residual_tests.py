"""What a log holds beside noise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.signal

from excite.diagnosis import residual_tests
from excite.diagnosis.residual_tests import Anomaly, find_anomalies, is_shaking
from excite.model import Model


def times(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """A minute, and the twelve seconds of it in which something acts."""
    t = np.arange(round(60 * rate)) / rate
    return t, ((t > 20) & (t < 32)).astype(float)


def driven(seed: int, t: np.ndarray, steps: bool) -> np.ndarray:
    """A torque as a person drives it, or in ramps from step to step, with a sensor's noise."""
    rng = np.random.default_rng(seed)
    if steps:
        knots = np.repeat(rng.uniform(-3000, 3000, 40), 2)
        slow = np.interp(t, np.sort(np.concatenate([np.arange(40) * 1.5, np.arange(40) * 1.5 + 1.2])), knots)
    else:
        rate = 1 / (t[1] - t[0])
        low = scipy.signal.butter(2, 1.0, fs=rate, output="sos")
        slow = scipy.signal.sosfiltfilt(low, rng.normal(size=len(t))) * 80 * np.sqrt(rate)
    return np.asarray(slow + 40 * rng.normal(size=len(t)))


def torque_anomalies(model: Model, t: np.ndarray, u: np.ndarray) -> list[Anomaly]:
    """Return the anomalies of a torque's readings alone, without innovations."""
    log: Any = SimpleNamespace(t=t, values={"u1": u})
    fit: Any = SimpleNamespace(linear=[SimpleNamespace(innovations=np.zeros((len(t), 0)))])
    return find_anomalies(model.machine, (), log, fit)


@pytest.mark.parametrize("steps", [False, True])
@pytest.mark.parametrize(("rate", "frequency"), [(50, 18.0), (100, 18.0), (100, 29.3), (100, 61.0), (1000, 27.0)])
def test_a_channel_shakes_where_a_vibration_is_on_it(rate: float, frequency: float, steps: bool) -> None:
    """Of an amplitude like that of its noise; also at a frequency that the sampling folds."""
    t, there = times(rate)
    shaken = [driven(k, t, steps) + 50 * there * np.sin(2 * np.pi * frequency * t) for k in range(20)]
    assert sum(bool(is_shaking(u, there, rate)) for u in shaken) >= 19


@pytest.mark.parametrize("steps", [False, True])
@pytest.mark.parametrize("rate", [50, 100, 1000])
def test_no_channel_shakes_of_its_noise(rate: float, steps: bool) -> None:
    t, there = times(rate)
    told = [is_shaking(driven(k, t, steps), there, rate) for k in range(60)]
    assert None not in told
    assert sum(map(bool, told)) <= 2


def test_what_cannot_be_told() -> None:
    """What is always there, or never, and a rate at which no vibration is seen."""
    t, there = times(100)
    assert is_shaking(driven(0, t, False), np.ones(len(t)), 100) is None
    assert is_shaking(driven(0, t, False), np.zeros(len(t)), 100) is None
    t, there = times(20)
    assert is_shaking(driven(0, t, False), there, 20) is None


@pytest.mark.slow
def test_noise_alone_is_no_burst() -> None:
    """Of 3000 torque channels of two minutes a third of one is allowed a line. Median squares are no normal variables:
    thresholds for such ones gave two."""
    rng, t = np.random.default_rng(0), np.arange(12_000) / 100
    found = [
        a
        for _ in range(3000)
        for a in residual_tests._torque_anomalies("u", t, 40 * rng.standard_normal(len(t)), 100.0)
    ]
    assert [a for a in found if a.kind == "burst"] == []


@pytest.mark.parametrize(("bit", "steps"), [(16, False), (32, False), (32, True), (64, True), (256, True)])
def test_a_bit_that_is_always_set_leaves_bands(bit: int, steps: bool, straight: Model) -> None:
    """Smaller than the sensor's noise or far larger; values that are steps of a converter are no bands."""
    t, _ = times(100)

    def bands(u: np.ndarray) -> list[str]:
        return [str(a) for a in torque_anomalies(straight, t, u) if a.kind == "bands"]

    for seed in range(10):
        u = driven(seed, t, steps)
        stuck = u + np.where((u // bit) % 2 == 0, bit, 0)
        assert bands(stuck) == [
            "u1: values in bands of one width with nothing between them: a bit of its converter never changes"
        ]
        assert bands(u) == bands(np.round(u / bit) * bit) == bands(np.round(u)) == []


@pytest.mark.parametrize(
    ("level", "noise", "rise"), [(500.0, 40.0, 0), (60.0, 5.0, 0), (500.0, 40.0, 3), (1000.0, 40.0, 0)]
)
def test_a_drive_in_steps_of_one_size_is_no_converter(level: float, noise: float, rise: int, straight: Model) -> None:
    t, _ = times(100)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u = np.repeat(level * rng.integers(-4, 5, 40), len(t) // 40)
        if rise:
            u = np.convolve(np.pad(u, rise, mode="edge"), np.ones(2 * rise + 1) / (2 * rise + 1), mode="valid")
        found = torque_anomalies(straight, t, u + noise * rng.normal(size=len(u)))
        assert [a for a in found if a.kind == "bands"] == [], seed
