"""Worlds of a roller in which two to six moderate effects act at once, as on every real machine.

The effects are listed ones, drawn at random with sizes about those that such machines have. What counts is the estimate
of the parameters, not the names of the effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import excite

# Usual sizes on a roller of 11 t, and places; each draw is between half and one and a half times as large.
USUAL = {
    "rolling_resistance": (120.0, ("front_roll", "rear_roll")),
    "shear_saturation": (0.35, ("front_roll", "rear_roll")),
    "actuator_lag": (0.012, ("front_roll", "rear_roll")),
    "ground_slope": (0.003, ("machine",)),
    "measuring_wheel_radius": (0.001, ("measuring_wheel_left", "measuring_wheel_right")),
    "stribeck_friction": (70.0, ("front_roll", "rear_roll")),
    "friction_warm_up": (0.3, ("front_roll", "rear_roll")),
    "asymmetric_viscous": (15.0, ("front_roll", "rear_roll")),
    "compaction_per_pass": (0.1, ("drive",)),
    "drive_brake_asymmetry": (0.08, ("front_roll", "rear_roll")),
    "torque_ripple": (25.0, ("front_roll", "rear_roll")),
}
STRAIGHT = tuple(name for name in USUAL if name not in ("measuring_wheel_radius",))


@dataclass(frozen=True)
class Judged:
    """Estimate of one world: effects, status, error of M [%], z (n,) by noise and discrepancy, and by the total."""

    effects: tuple[str, ...]
    status: str
    mass_error_percent: float
    z: np.ndarray
    z_total: np.ndarray


def draw(seed: int, names: Sequence[str] = tuple(USUAL)) -> tuple[str, ...]:
    """Draw two to six effects as `excite.simulate` takes them."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(names, rng.integers(2, 7), replace=False)
    found = []
    for name in chosen:
        size, places = USUAL[name]
        found.append(f"{name}@{rng.choice(places)}={size * rng.uniform(0.5, 1.5):.6g}")
    return tuple(found)


def judge(machine: str, drives: Sequence[str], effects: Sequence[str], seed: int) -> Judged:
    """Simulate a log along each drive with the effects, identify from all, and compare with the true values."""
    logs = [excite.simulate(machine, drive, seed=seed + k, effects=effects) for k, drive in enumerate(drives)]
    found, true = excite.identify(machine, logs), excite.load(machine).nominal
    error = found.value - true
    return Judged(
        tuple(effects), found.status, float(100 * error[0] / true[0]), error / found.std, error / found.std_total
    )
