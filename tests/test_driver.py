"""A driven machine: late, smooth, within the machine's limits, never quite the same."""

from __future__ import annotations

import numpy as np
import pytest

from excite.driver import Driver, follow
from model.prediction import Model

T = np.arange(3001) / 100
SPEED = np.interp(T, [0, 2, 5, 14, 17, 19, 22, 27, 30], [0, 0, 1.5, 1.5, 0, 0, -1.5, -1.5, 0])
ANGLE = np.interp(T, [0, 6, 8, 12, 14, 22, 24, 26, 28], [0, 0, 0.4, 0.4, 0, 0, -0.3, -0.3, 0])[:, None]
PERFECT = Driver(speed_error_m_s=0, angle_error_rad=0)


def test_follows_late_but_follows(va12: Model) -> None:
    motion = follow(va12, SPEED, ANGLE, PERFECT)
    speed, angle = motion.nu[:, 0], motion.q[:, 4]
    lags = np.arange(0, 200)
    misfit = [np.mean((SPEED[: len(T) - lag] - speed[lag:]) ** 2) for lag in lags]
    assert 0.3 <= lags[int(np.argmin(misfit))] / 100 <= 1.2
    assert np.sqrt(min(misfit)) < 0.1
    assert angle.max() == pytest.approx(0.4, abs=0.05)
    assert angle.min() == pytest.approx(-0.3, abs=0.05)


def test_keeps_the_machines_limits(va12: Model) -> None:
    motion = follow(va12, 2 * SPEED, 2 * ANGLE, seed=3)
    rates = np.abs(np.diff(motion.u, axis=0)).max(axis=0) * 100
    assert (np.abs(motion.u).max(axis=0) <= [5000, 15000, 5000]).all()
    assert (rates <= np.array([10000, 40000, 10000]) * 1.001).all()


def test_no_two_drives_are_the_same_but_a_seed_is(va12: Model) -> None:
    one, again, other = (follow(va12, SPEED[:801], ANGLE[:801], seed=s) for s in (1, 1, 2))
    assert np.array_equal(one.q, again.q)
    assert np.abs(one.nu[:, 0] - other.nu[:, 0]).max() > 0.01


def test_another_machine_is_driven_by_what_it_does(va12: Model) -> None:
    """The driver steers by what is seen: a machine a fifth heavier still reaches the speed."""
    heavy = va12.base_values({"M0": 2 * 2600.0})
    motion = follow(va12, SPEED, ANGLE, PERFECT, X=heavy)
    assert motion.nu[1200:1400, 0].mean() == pytest.approx(1.5, abs=0.1)


def test_shapes_are_checked(va12: Model) -> None:
    with pytest.raises(ValueError, match=r"needs shape \(3001, 1\)"):
        follow(va12, SPEED, np.zeros((3001, 2)))
