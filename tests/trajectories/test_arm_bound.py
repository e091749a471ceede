"""The bound of an arm's motion: against the forward form, against least squares, and where the forward form ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from excite import smoothing, trajectories
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.simulation import Motion, motion_along
from excite.trajectories.arm_bound import arm_bound
from excite.workflows.design_request import with_assumed_noise

ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"


def swinging(model: Model, amplitude: float, rate: float, seconds: float = 4.0) -> Motion:
    n, hz = len(model.coordinates), float(model.machine.sampling_hz)
    t = np.arange(round(seconds * hz) + 1) / hz
    w = rate * (1 + 0.13 * np.arange(n))
    rest = np.resize([0.0, -1.5, 0.5], n)
    q, nu, a = np.tile(rest, (len(t), 1)), np.zeros((len(t), n)), np.zeros((len(t), n))
    for share, times in ((1.0, 1.0), (0.5, 2.3)):
        phase = times * w * t[:, None] + np.linspace(0, 2, n)
        q = q + share * amplitude * np.sin(phase)
        nu = nu + share * amplitude * times * w * np.cos(phase)
        a = a - share * amplitude * (times * w) ** 2 * np.sin(phase)
    return motion_along(model, t, q, nu, a)


def finer(model: Model, counts: float) -> Model:
    """Return the model with encoders of so many counts per turn."""
    sensors = tuple(
        s.model_copy(update={"counts_per_turn": s.counts_per_turn.model_copy(update={"value": counts})})
        if s.counts_per_turn is not None
        else s
        for s in model.machine.sensor
    )
    return model.for_machine(model.machine.model_copy(update={"sensor": sensors}))


def test_bound_of_two_joints_is_that_of_the_forward_form() -> None:
    model = finer(build(load_machine(str(ARM))), 65536.0)
    motion = swinging(model, 0.8, 4.0)
    ratio = np.sqrt(np.diag(arm_bound(model, motion)) / np.diag(smoothing.cramer_rao(model, motion)))
    assert ratio == pytest.approx(1, abs=0.05)


def test_bound_is_that_of_residuals_with_both_errors() -> None:
    """Generalised least squares on noisy torques, along noisy angles; the covariance of both from random draws."""
    model = finer(build(load_machine(str(ARM))), 20000.0)
    motion = swinging(model, 0.8, 4.0)
    h = 1 / float(model.machine.sampling_hz)
    rng = np.random.default_rng(0)
    noise = trajectories.row_noise(model)
    step = 2 * np.pi / 20000
    W = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T)[1:-1]

    # weights by the covariance of the residual, from many draws of noise at the true parameters
    left = []
    for _ in range(3000):
        q = motion.q + rng.uniform(-step / 2, step / 2, motion.q.shape)
        nu, a = (q[2:] - q[:-2]) / (2 * h), (q[2:] - 2 * q[1:-1] + q[:-2]) / h**2
        wrong = model.stacked_regressor(q[1:-1].T, nu.T, a.T) @ model.nominal
        left.append((wrong - W @ model.nominal).ravel())
    C = np.cov(np.array(left).T) + np.diag(np.tile(noise**2, len(W)))
    flat = W.reshape(-1, W.shape[2])
    expected = np.sqrt(np.diag(np.linalg.inv(flat.T @ np.linalg.solve(C, flat)))) / model.scale
    found = np.sqrt(np.diag(arm_bound(model, motion))) / model.scale
    assert found == pytest.approx(expected, rel=0.15)


def test_light_joints_have_a_bound() -> None:
    """Friction stops a wrist of the UR10 within 10 us."""
    model, _ = with_assumed_noise(build(load_machine("ur10")))
    sigma = trajectories.sigma_percent(trajectories.compose_objective(model, "cond"), model, swinging(model, 0.5, 3.0))
    assert np.isfinite(sigma).all()
    assert np.median(sigma) < 10


def test_less_noise_of_a_sensor_never_harms() -> None:
    model = build(load_machine(str(ARM)))
    motion = swinging(model, 0.5, 3.0)
    usual = np.diag(arm_bound(model, motion))
    for sensor in model.machine.sensor:
        assert (np.diag(arm_bound(model, motion, {sensor.name: 0.5})) <= usual * (1 + 1e-9)).all(), sensor.name
        assert (np.diag(arm_bound(model, motion, {sensor.name: 0.5})) < usual).any(), sensor.name
