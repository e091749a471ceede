"""A driven machine: foreseen, smooth, within the machine's limits, never quite the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from excite.model import Model
from excite.simulation import STEADY_DRIVER, Driver, Motion, follow

T = np.arange(3001) / 100
SPEED = np.interp(T, [0, 2, 5, 14, 17, 19, 22, 27, 30], [0, 0, 1.5, 1.5, 0, 0, -1.5, -1.5, 0])
ANGLE = np.interp(T, [0, 6, 8, 12, 14, 22, 24, 26, 28], [0, 0, 0.4, 0.4, 0, 0, -0.3, -0.3, 0])[:, None]


def lag(motion: Motion) -> tuple[float, float]:
    """How late [s] the speed is on the trace, and how far off [m/s] it is then."""
    misfit = [np.mean((SPEED[: len(T) - k] - motion.nu[k:, 0]) ** 2) for k in range(200)]
    k = int(np.argmin(misfit))
    return k / 100, float(np.sqrt(misfit[k]))


def test_follows_as_late_as_the_machine_is(va12: Model) -> None:
    """What comes is seen: reaction and hand cost nothing, the drive's 0.3 s stay."""
    motion = follow(va12, SPEED, ANGLE, STEADY_DRIVER)
    late, misfit = lag(motion)
    assert 0.2 <= late <= 0.45
    assert misfit < 0.05
    angle = motion.q[:, 4]
    assert angle.max() == pytest.approx(0.4, abs=0.03)
    assert angle.min() == pytest.approx(-0.3, abs=0.03)
    assert abs(angle[-1]) < 0.02


def test_without_a_view_ahead_reaction_and_hand_come_on_top(va12: Model) -> None:
    blind = follow(va12, SPEED, ANGLE, replace(STEADY_DRIVER, preview_s=0.0))
    seeing = follow(va12, SPEED, ANGLE, STEADY_DRIVER)
    assert lag(blind)[0] - lag(seeing)[0] == pytest.approx(STEADY_DRIVER.preview_s, abs=0.05)


def test_torques_do_not_chatter(va12: Model) -> None:
    """Above 3 Hz there is next to nothing: a third of the torque sensors' noise."""
    motion = follow(va12, SPEED, ANGLE, seed=5)
    b, a = scipy.signal.butter(4, 3 / 50)
    fast = (motion.u - scipy.signal.filtfilt(b, a, motion.u, axis=0)).std(axis=0)
    assert (fast < np.array([40, 100, 40]) / 3).all()


def test_slow_errors_are_as_large_as_said(va12: Model) -> None:
    """A minute of steady driving: speed and angle wander by the driver's errors, less what attention corrects."""
    speed, angle = np.full(6001, 1.0), np.full((6001, 1), 0.2)
    t = np.arange(6001) / 100
    speed *= np.clip(np.minimum(t, 60 - t) / 4, 0, 1)
    steady = follow(va12, speed, angle, STEADY_DRIVER)
    many = [follow(va12, speed, angle, seed=s) for s in range(4)]
    at = slice(1000, 5500)
    off = np.std([m.nu[at, 0] - steady.nu[at, 0] for m in many])
    turned = np.std([m.q[at, 4] - steady.q[at, 4] for m in many])
    assert 0.3 * Driver().speed_error_m_s < off < 1.3 * Driver().speed_error_m_s
    assert 0.3 * Driver().angle_error_rad < turned < 1.3 * Driver().angle_error_rad


def test_nobody_errs_with_the_lever_in_neutral(va12: Model) -> None:
    """Stopped for five seconds the machine stands, as in any drive with a brake in neutral."""
    speed = np.interp(T, [0, 2, 5, 10, 13, 25, 30], [0, 0, 1.5, 1.5, 0, 0, 0])
    motion = follow(va12, speed, 0 * ANGLE, seed=2)
    assert np.abs(motion.nu[1500:, 0]).max() < 0.02


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
    motion = follow(va12, SPEED, ANGLE, STEADY_DRIVER, X=heavy)
    assert motion.nu[1200:1400, 0].mean() == pytest.approx(1.5, abs=0.1)


def test_shapes_are_checked(va12: Model) -> None:
    with pytest.raises(ValueError, match=r"needs shape \(3001, 1\)"):
        follow(va12, SPEED, np.zeros((3001, 2)))
