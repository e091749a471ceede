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
    position |= {"unit": "m/s", "noise": {"value": 2e-4, "source": "assumed"}, "noise_unit": "SI"}
    force |= {"noise": {"value": 0.5, "source": "assumed"}, "noise_unit": "SI"}
    return build(Machine.model_validate(machine))


def with_unit(machine: Machine, unit: str) -> Machine:
    """The machine whose joint is measured in another unit, a speed or an angle."""
    given = machine.model_dump(mode="json", exclude_none=True)
    given["sensor"][0]["unit"] = unit
    return Machine.model_validate(given)


@pytest.fixture(scope="module")
def pendulum() -> Model:
    """A pendulum at 200 Hz with a speed sensor."""
    inertia = {"mass": assumed(1.0), "com": assumed([0.1, 0, 0]), "ZZ": assumed(0.15)}
    friction = {"Fv": assumed(0.05), "Fs": assumed(0.1), "u0": assumed(-0.1), "smoothing": assumed(0.05)}
    shaft = {"index": 1, "name": "shaft", "antecedent": "ground", "joint": "revolute", "actuated": True}
    speed = {"name": "speed", "kind": "angle", "body": 1, "column": "speed", "unit": "rad/s", "noise": assumed(1e-4)}
    torque = {"name": "torque", "kind": "torque", "body": 1, "column": "u", "unit": "N m", "noise": assumed(1e-3)}
    machine = {
        "name": "pendulum",
        "title": "pendulum",
        "gravity": [9.81, 0.0, 0.0],
        "sampling_hz": assumed(200.0),
        "time_column": "t",
        "body": [{**shaft, "inertia": inertia, "friction": friction}],
        "sensor": [speed, torque],
        "filter": {"source": "assumed", "cutoff_hz": assumed(20.0)},
    }
    return build(Machine.model_validate(machine))


def assumed(value: object) -> dict[str, object]:
    return {"value": value, "source": "assumed"}


@pytest.fixture(scope="module")
def table(rig: Model) -> pd.DataFrame:
    t = np.arange(0, 15, 1 / 200)
    force = 45 * np.sin(2 * np.pi * 0.7 * t) + 25 * np.sin(2 * np.pi * 1.9 * t + 1)
    return measure(rig, simulate(rig, force[:, None]), seed=3)


@pytest.mark.parametrize("method", ["ols", "joint"])
def test_a_speed_is_enough_for_every_method(rig: Model, table: pd.DataFrame, method: str) -> None:
    ready = prepare(rig, [table], needed_sensors(rig, method))
    estimate = identify(ready.model, ready.logs, method)
    assert np.abs(estimate.value / rig.nominal - 1)[:3].max() < 0.03


def test_a_speed_is_enough_to_diagnose(rig: Model, table: pd.DataFrame) -> None:
    ready = prepare(rig, [table], needed_sensors(rig, "joint"))
    assert diagnosis.diagnose(ready.model, ready.logs, rig.machine.filter).verdict == "clean"


@pytest.mark.parametrize("speed_only", [True, False], ids=["speed", "angle"])
def test_a_start_angle_that_nobody_knows_is_a_doubt(pendulum: Model, speed_only: bool) -> None:
    """Gravity depends on the angle, so a log that does not begin at 0 gives other values."""
    t = np.arange(0, 6, 1 / 200)
    torque = 1.5 * np.sin(2 * np.pi * 0.7 * t) + np.sin(2 * np.pi * 1.9 * t + 1)
    motion = simulate(pendulum, torque[:, None], q0=np.array([1.2]), nu0=np.zeros(1))
    model = pendulum if speed_only else build(with_unit(pendulum.machine, "rad"))
    ready = prepare(model, [measure(model, motion, seed=3)])
    estimate = identify(ready.model, ready.logs, "joint")
    assert estimate.status == ("doubtful" if speed_only else "valid")
    assert ("the start angle of joint 1 (shaft) is unknown" in estimate.doubt) == speed_only
