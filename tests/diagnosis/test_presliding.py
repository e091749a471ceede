"""Friction by bristles that bend, on logs of a pendulum that LuGre moves: presliding, not Stribeck friction."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

import excite
from excite.model import Model, build
from excite.model.machine import Machine, load_machine

INERTIA, VISCOUS, DRY, WEIGHT = 0.9, 0.4, 1.1, 6.0  # [kg m2], [N m s], [N m], [N m]
BENDS, STRIBECK_SPEED = 5e-4, 0.05  # [rad], [rad/s]
STEPS = 16  # of the simulation in a row of the log


def rig() -> Model:
    """The shipped pendulum, heavier, with the rig's controller rate and parameters a little off its own."""
    table = load_machine("pendulum").model_dump(mode="json", exclude_none=True)

    def values(**own: Any) -> dict[str, Any]:
        return {key: {"value": value, "source": "assumed"} for key, value in own.items()}

    table |= values(sampling_hz=250) | {"scale": {}}
    table["body"][0]["inertia"] = values(mass=2, com=[0.3, 0, 0], ZZ=0.62)
    table["body"][0]["friction"] = values(Fv=0.3, Fs=1, u0=0, smoothing=0.005)
    table["body"][0]["limit"] = values(torque=25)
    table["filter"] |= {"cutoff_hz": {"value": 25, "source": "assumed"}, "decimation": 4, "drop": [10, 10]}
    return build(Machine.model_validate(table))


def bristle_log(breakaway: float, seed: int, seconds: float = 40.0) -> pd.DataFrame:
    """Simulate the pendulum under a controller, semi-implicitly: columns of the rig.

    breakaway [N m]: friction at rest; sliding fast it is DRY. Source: Canudas de Wit et al., IEEE TAC 40 (1995).
    """
    rng = np.random.default_rng(seed)
    dt = 1 / 250 / STEPS
    t = np.arange(0, seconds, dt)
    f, phase = rng.uniform(0.05, 0.8, 6), rng.uniform(0, 2 * np.pi, 6)
    wanted = np.sin(2 * np.pi * np.outer(t, f) + phase) @ (rng.uniform(0.4, 1, 6) / f**0.7)
    wanted *= 1.6 / np.abs(wanted).max() * np.minimum(1, np.minimum(t, seconds - t) / 2)
    speed = np.gradient(wanted, dt)
    x = v = z = 0.0
    kept = np.empty((len(t), 2))
    for k in range(len(t)):
        u = float(np.clip(60 * (wanted[k] - x) + 8 * (speed[k] - v), -25, 25))
        kept[k] = x, u
        most = DRY + (breakaway - DRY) * np.exp(-((v / STRIBECK_SPEED) ** 2))
        z = (z + dt * v) / (1 + dt * abs(v) * DRY / most / BENDS)
        v += dt * (u - VISCOUS * v - DRY / BENDS * z - WEIGHT * np.sin(x)) / INERTIA
        x += dt * v
    q, u = kept[::STEPS].T
    step = 2 * np.pi / 8192
    return pd.DataFrame(
        {"time": t[::STEPS], "position": np.round(q / step) * step, "torque": u + 0.05 * rng.standard_normal(len(u))}
    )


@pytest.mark.slow
@pytest.mark.parametrize(("breakaway", "name"), [(DRY, "presliding"), (1.6 * DRY, "stribeck_friction")])
def test_bristles_are_told_from_stribeck_friction(breakaway: float, name: str) -> None:
    found: Any = excite.diagnose(rig(), bristle_log(breakaway, seed=5)).summary
    assert name in [f["effect"] for f in found["findings"]], found["answer"]
    if name == "presliding":
        (finding,) = found["findings"]
        assert not finding["tied_with"]
        assert finding["amount"] == pytest.approx(BENDS, rel=0.3)
