"""Worlds of a roller in which two to six moderate effects act at once, as on every real machine.

The effects are listed ones, drawn at random with sizes about those that such machines have. What counts is the estimate
of the parameters, not the names of the effects.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from support.files import RESULTS

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
DRIVES = {"va12": ("R60_accuracy", "R60"), "va12_straight": ("S40",)}  # designs in results/ of each machine


def names_of(machine: str) -> tuple[str, ...]:
    """Return the effects that a machine can have."""
    return tuple(USUAL) if machine == "va12" else STRAIGHT


def drives_of(machine: str) -> list[str]:
    """Return the designs of a machine."""
    return [str(RESULTS / d / "design") for d in DRIVES[machine]]


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


def simulated(machine: str, drives: Sequence[str], effects: Sequence[str], seed: int) -> list[pd.DataFrame]:
    """Simulate a log along each drive with the effects."""
    return [excite.simulate(machine, drive, seed=seed + k, effects=effects) for k, drive in enumerate(drives)]


def judge(machine: str, drives: Sequence[str], effects: Sequence[str], seed: int) -> Judged:
    """Identify from a log along each drive, and compare with the true values."""
    logs = simulated(machine, drives, effects, seed)
    found, true = excite.identify(machine, logs), excite.load(machine).nominal
    error = found.value - true
    return Judged(
        tuple(effects), found.status, float(100 * error[0] / true[0]), error / found.std, error / found.std_total
    )


@dataclass(frozen=True)
class Named:
    """Diagnosis of one world: verdict, names that are right (also in a tie), of the right kind elsewhere, and wrong.

    z (n,): deviations of the parameters from the true values after mending. wall_s [s]: of the whole diagnosis.
    """

    effects: tuple[str, ...]
    verdict: str
    right: tuple[str, ...]
    elsewhere: tuple[str, ...]
    wrong: tuple[str, ...]
    mass_error_percent: float
    z: np.ndarray
    wall_s: float


def judge_names(machine: str, drives: Sequence[str], effects: Sequence[str], seed: int) -> Named:
    """Diagnose a log along each drive, and compare names and mended parameters with the truth."""
    logs = simulated(machine, drives, effects, seed)
    begin = time.monotonic()
    found = excite.diagnose(machine, logs).diagnosis
    wall = time.monotonic() - begin
    true, names = excite.load(machine).nominal, {e.partition("=")[0] for e in effects}
    kinds = {n.partition("@")[0] for n in names}
    groups: dict[str, list[str]] = {"right": [], "elsewhere": [], "wrong": []}
    for f in found.findings:
        right = names & {f.name, *f.tied_with}
        groups["right" if right else "elsewhere" if f.effect in kinds else "wrong"].append(f.name)
    after = np.array([p.after for p in found.parameters])
    std = np.array([p.std_after for p in found.parameters])
    mass = float(100 * (after[0] / true[0] - 1))
    told = {key: tuple(own) for key, own in groups.items()}
    return Named(tuple(effects), found.verdict, **told, mass_error_percent=mass, z=(after - true) / std, wall_s=wall)
