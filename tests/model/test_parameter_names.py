"""What parameters are called in words: every one of every shipped machine, effects too, no two alike."""

from __future__ import annotations

import pytest

from excite.model import Model, parameter_descriptions, prediction
from excite.model.effects import placing
from excite.model.machine import machine


def test_words_for_the_roller(va12: Model) -> None:
    said = parameter_descriptions(va12)
    assert said["M"] == "mass, whole machine"
    assert said["MX0R"] == "regrouped first moment x, front chassis"
    assert said["ZZ0R"] == "regrouped inertia about the vertical, front chassis"
    assert said["ZZ1"] == "inertia about the axis, front roll"
    assert said["MX2"].endswith("first moment x, rear chassis")
    assert said["Fv1"] == "viscous friction, front roll"
    assert said["Fs1"] == "dry friction, front roll"
    assert said["Ky4"] == "sideways force per slip, rear roll"
    assert said["u20"] == "torque offset, articulation"


@pytest.mark.parametrize("name", machine.shipped_machines())
def test_every_parameter_has_words_of_its_own(name: str) -> None:
    model = prediction.build(machine.load_machine(name))
    said = parameter_descriptions(model)
    assert tuple(said) == model.base.names
    assert len(set(said.values())) == len(said)
    assert not any("_" in text or "@" in text for text in said.values())


def test_other_names_and_effects_keep_the_words(emps: Model, va12: Model) -> None:
    assert parameter_descriptions(emps)["Fc"] == "dry friction, carriage"
    assert parameter_descriptions(emps)["offset"] == "force offset, carriage"
    entry = placing.parse_effect("torque_deadband@rear_roll=80", va12.machine, 60.0)
    said = parameter_descriptions(prediction.build(placing.with_effects(va12.machine, entry)))
    assert said["torque_deadband@rear_roll"] == "torque deadband, rear roll"
