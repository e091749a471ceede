"""Rigs whose joint is measured as a speed only."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from excite import diagnosis
from excite.identification import identify, needed_sensors
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import Machine
from excite.simulation import measure, simulate


@pytest.fixture(scope="module")
def rig(emps: Model) -> Model:
    """EMPS at 200 Hz with the carriage's speed in place of its position, and friction that changes sign smoothly."""
    machine: dict = emps.machine.model_dump(mode="json", exclude_none=True)  # type: ignore[type-arg]
    machine["sampling_hz"]["value"] = 200
    machine["body"][0]["friction"]["smoothing"]["value"] = 2e-3
    machine["filter"] |= {"decimation": 4, "drop": [0, 0]}
    machine["filter"]["cutoff_hz"]["value"] = 30
    position, force = machine["sensor"]
    position |= {"unit": "m/s", "noise": {"value": 2e-4, "source": "assumed"}}
    force |= {"noise": {"value": 0.5, "source": "assumed"}}
    return build(Machine.model_validate(machine))


@pytest.fixture(scope="module")
def table(rig: Model) -> pd.DataFrame:
    t = np.arange(0, 15, 1 / 200)
    force = 45 * np.sin(2 * np.pi * 0.7 * t) + 25 * np.sin(2 * np.pi * 1.9 * t + 1)
    return measure(rig, simulate(rig, force[:, None]), seed=3)


@pytest.mark.parametrize("method", ["ols", "wls", "iv", "tls", "oe", "joint"])
def test_a_speed_is_enough_for_every_method(rig: Model, table: pd.DataFrame, method: str) -> None:
    ready = prepare(rig, [table], needed_sensors(rig, method))
    estimate = identify(ready.model, ready.logs, method)
    assert np.abs(estimate.value / rig.nominal - 1)[:3].max() < 0.03


def test_a_speed_is_enough_to_diagnose(rig: Model, table: pd.DataFrame) -> None:
    ready = prepare(rig, [table], needed_sensors(rig, "joint"))
    assert diagnosis.diagnose(ready.model, ready.logs, rig.machine.filter).verdict == "clean"
