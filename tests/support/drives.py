"""Drives that many tests share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from support.files import RESULTS

from excite.logs import profile
from excite.model import Model
from excite.simulation import Motion, simulate


def drive(model: Model, duration: float, seed: int, amplitude: dict[str, float]) -> np.ndarray:
    """A lively drive (N, n_u) [N m] from rest to about rest: a few sines of each torque, faded in and out."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * float(model.machine.sampling_hz)) + 1) / float(model.machine.sampling_hz)
    torque = np.zeros((len(t), len(model.inputs)))
    for k, name in enumerate(model.inputs):
        for frequency in (0.05, 0.08, 0.13, 0.2, 0.3):
            torque[:, k] += amplitude[name] * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 2 * np.pi))
    return torque * np.minimum(1, np.minimum(t, duration - t) / 2)[:, None]


def designed(name: str, model: Model) -> Motion:
    """A committed design, its torques on a machine."""
    torque, q0, nu0 = profile.read_profile(RESULTS / name / "design" / "profile.csv", model)
    return simulate(model, torque, q0=q0, nu0=nu0)


def held_straight() -> np.ndarray:
    """Torques (4001, 2) [N m] of a straight drive of 40 s, a design of S40 that stays when its study is rebuilt."""
    knots = pd.read_csv(Path(__file__).parent / "straight_drive.csv")
    t = np.arange(4001) / 100
    return np.column_stack([np.interp(t, knots["t_s"], knots[name]) for name in ("u1_Nm", "u4_Nm")])


def arm_motion(t: np.ndarray, pace: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles, rates and accelerations (2, N) [rad, s] of two joints from rest to rest at times t (N,) [s].

    pace [rad/s]: of the slowest of five sines.
    """
    phase = np.random.default_rng(5).uniform(0, 2 * np.pi, (2, 5))
    x = np.clip(np.minimum(t, t[-1] - t) / 3, 0, 1)
    fade = 6 * x**5 - 15 * x**4 + 10 * x**3
    q = np.array([sum(0.9 / k * np.sin(pace * k * t + phase[j, k - 1]) for k in range(1, 6)) * fade for j in (0, 1)])
    nu = np.gradient(q, t, axis=1)
    return q, nu, np.gradient(nu, t, axis=1)


def gentle(model: Model, seconds: float) -> Motion:
    """Little torque for a short time."""
    t = np.arange(0, seconds + 0.01, 0.01)
    slow = np.minimum(1, np.minimum(t, seconds - t) / 2)
    return simulate(model, np.column_stack([1500 * np.sin(1.7 * t) * slow, 1200 * np.sin(2.6 * t) * slow]))
