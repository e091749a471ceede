"""A flexible gear with an encoder on either side: its spring and the inertias on both sides, with honest intervals."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from excite.errors import MachineError
from excite.identification import identify, needed_sensors, recommend_method, require_sensors
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import Machine
from excite.simulation import measure, simulate

EXAMPLE: Any = tomllib.loads((Path(__file__).parents[2] / "docs" / "examples" / "flexible_joint.toml").read_text())


def table(**values: float) -> Any:
    """The example's file with other values, by the last key."""
    made = copy.deepcopy(EXAMPLE)
    for body in made["body"][1:]:
        for part in ("inertia", "drive", "spring", "friction"):
            for key in set(values) & set(body.get(part, {})):
                body[part][key]["value"] = values[key]
    return made


def flexible(**values: float) -> Model:
    return build(Machine.model_validate(table(**values)))


def log_of(model: Model, seed: int) -> pd.DataFrame:
    """A log of 10 s of a current of forty sines between 0.15 and 15 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(5000) / 500
    wave = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for f in np.geomspace(0.15, 15, 40))
    return measure(model, simulate(model, (60 * wave / np.abs(wave).max())[:, None]), seed=seed)


def test_spring_between_joints_is_that_of_the_textbook() -> None:
    """Spong's equations of a flexible joint, written out by hand."""
    model = flexible()
    q, w, a = np.random.default_rng(0).uniform(-1, 1, (3, 2, 30))
    (motor, link), (motor_w, link_w), (motor_a, link_a) = q, w, a
    bend = 1e4 * (link - motor) + 10 * (link_w - motor_w)
    drive = 1.0 * motor_a + 10 * motor_w + 5 * np.tanh(motor_w / 0.02) - bend
    load = (0.1 + 8 * 0.3**2) * link_a + 8 * 9.81 * 0.3 * np.sin(link) + bend
    load += 0.5 * link_w + 0.2 * np.tanh(link_w / 0.02)
    found = model.predict(q, w, a, model.expand @ model.nominal).full()
    assert found == pytest.approx(np.array([drive, load]), rel=1e-9, abs=1e-9)


def test_encoder_of_the_motor_counts_behind_the_gear() -> None:
    motor, link, current = Machine.model_validate(EXAMPLE).sensor
    assert motor.resolution == pytest.approx(2 * np.pi / 819200)
    assert link.resolution == pytest.approx(2 * np.pi / 524288)
    assert (motor.gain, link.gain, current.gain) == (0.01, 1.0, 10.0)


@pytest.mark.parametrize(("stiffness", "damping"), [(1e4, 10.0), (6e2, 2.0)])
def test_hidden_spring_and_inertias_are_found(stiffness: float, damping: float) -> None:
    """From 20 to 30 % off, a robot's gear that bends by a milliradian, and one twenty times as soft."""
    truth = flexible(stiffness=stiffness, damping=damping)
    guess = flexible(stiffness=1.3 * stiffness, damping=0.7 * damping, mass=10.0, rotor_inertia=1.3)
    assert recommend_method(guess) == "joint"
    z = []
    for seed in range(3):
        ready = prepare(guess, [log_of(truth, seed)], needed_sensors(guess, "joint"))
        found = identify(ready.model, ready.logs, "joint")
        assert found.status == "valid"
        assert not found.unidentifiable
        z.append((found.value - truth.nominal) / found.std)
        for name, percent in (("Ks2", 0.5), ("Ds2", 3.0), ("ZZ2", 0.5), ("Ia1", 0.5)):
            assert found.std_percent[found.names.index(name)] < percent
    assert np.abs(z).max() < 3.5
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_without_the_link_s_encoder_it_is_refused() -> None:
    made = table()
    del made["sensor"][1]
    with pytest.raises(MachineError, match=r"none of kind angle on joint 2 .*bends between two encoders"):
        require_sensors(build(Machine.model_validate(made)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint": 0}, r"no other free joint 0, allowed: \[1\]"),
        ({"joint": 2}, r"no other free joint 2, allowed: \[1\]"),
        ({"damping": {"value": -1, "source": "assumed"}}, "must be >= 0"),
    ],
)
def test_impossible_springs_are_refused(change: Any, message: str) -> None:
    made = table()
    made["body"][2]["spring"] |= change
    with pytest.raises(ValueError, match=message):
        Machine.model_validate(made)
    sliding = table()
    sliding["body"][1]["joint"] = "prismatic"
    with pytest.raises(ValueError, match="turns with one that slides"):
        Machine.model_validate(sliding)
