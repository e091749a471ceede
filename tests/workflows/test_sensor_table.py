"""The sensors' table of `excite machine check`, the units of noise, and what gear ratios must be asked about."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.files import SHARED

import excite
from excite.model.machine import Machine, load_machine, noise_of, shipped_machines
from excite.simulation import Motion
from excite.workflows import machine_check
from excite.workflows.sensor_table import doubt_sensors, sensor_rows

ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"
DISPLACEMENT, LEVER, AREA = 780e-6, 0.3, 50e-4  # [m3], [m], [m2]


def given(value: float) -> dict[str, Any]:
    return {"value": value, "source": "assumed"}


def with_sensor(name: str, machine: Path | str = ARM, **keys: Any) -> Machine:
    """A machine with keys of one of its sensors."""
    table = load_machine(machine).model_dump()
    table["sensor"] = [{**s, **keys} if s["name"] == name else s for s in table["sensor"]]
    return Machine.model_validate(table)


@pytest.mark.parametrize(
    ("keys", "noise", "si"),
    [
        ({"unit": "kN m"}, 0.002, 2.0),
        ({"unit": "A", "torque_constant": given(0.1), "gear_ratio": given(100.0)}, 0.2, 2.0),
        ({"unit": "mA", "torque_constant": given(0.1), "gear_ratio": given(100.0)}, 200.0, 2.0),
        ({"unit": "V", "factor": given(-4.0)}, 0.5, 2.0),
        (
            {"unit": "bar", "return_column": "back", "displacement": given(DISPLACEMENT)},
            0.5,
            0.5e5 * DISPLACEMENT / (2 * math.pi),
        ),
        (
            {
                "unit": "psi",
                "return_column": "back",
                "cylinders": [{"area": given(AREA), "rod_area": given(31e-4), "lever": given(LEVER)}],
            },
            7.25189,
            0.5e5 * AREA * LEVER,
        ),
    ],
    ids=["kN m", "A", "mA", "factor", "motor", "cylinder"],
)
def test_noise_of_a_torque_is_in_the_unit_of_its_column(keys: dict[str, Any], noise: float, si: float) -> None:
    machine = with_sensor("u1", noise=given(noise), **keys)
    sensor = next(s for s in machine.sensor if s.name == "u1")
    assert noise_of(machine, sensor) == pytest.approx(si, rel=1e-5)
    row = next(r for r in sensor_rows(machine) if r["name"] == "u1")
    assert (row["noise"], row["noise_si"]) == (pytest.approx(noise), pytest.approx(si, rel=1e-5))
    assert row["at_limit"] * si / noise == pytest.approx(float(machine.find(1).limit.torque))


@pytest.mark.parametrize(("unit", "one"), [("rpm", math.pi / 30), ("deg/s", math.pi / 180), ("rad/s", 1.0)])
def test_noise_of_a_rate_is_in_the_unit_of_its_column(unit: str, one: float) -> None:
    keys = {"unit": unit, "counts_per_turn": None, "noise": given(0.5)}
    machine = with_sensor("q1", **keys)
    assert noise_of(machine, machine.sensor[0]) == pytest.approx(0.5 * one)
    for said in ("SI", "rad/s"):  # of files whose noise is in SI units
        machine = with_sensor("q1", **keys, noise_unit=said)
        assert noise_of(machine, machine.sensor[0]) == pytest.approx(0.5)
    table = with_sensor("q1", **keys).model_dump() | {"noise_unit": "SI"}
    machine = Machine.model_validate(table)
    assert noise_of(machine, machine.sensor[0]) == pytest.approx(0.5)


def test_noise_that_a_file_inherits_keeps_its_unit(tmp_path: Path) -> None:
    (tmp_path / "two_joints.toml").write_text(ARM.read_text())
    keys = 'unit = "A"\ntorque_constant = { value = 0.1, source = "assumed" }\n'
    own = 'extends = "two_joints.toml"\n[sensor.u1]\n' + keys
    (tmp_path / "own.toml").write_text(own)
    base, machine = load_machine(ARM), load_machine(tmp_path / "own.toml")
    before, after = (next(s for s in m.sensor if s.name == "u1") for m in (base, machine))
    assert noise_of(machine, after) == noise_of(base, before) > 0
    (tmp_path / "own.toml").write_text(own + 'noise = { value = 3, source = "assumed" }\n')
    machine = load_machine(tmp_path / "own.toml")
    assert noise_of(machine, next(s for s in machine.sensor if s.name == "u1")) == pytest.approx(0.3)


def test_a_noise_unit_of_another_quantity_is_refused() -> None:
    with pytest.raises(ValueError, match="noise_unit: 'bar' is no unit of this sensor's noise"):
        with_sensor("u1", noise_unit="bar")


def test_noise_in_other_units_promises_the_same(straight_motion: Motion) -> None:
    """The bound knows no unit: a column in kN m with a thousandth of the noise is the same sensor."""
    table = load_machine("va12_straight").model_dump()
    table["sensor"] = [
        s | {"unit": "kN m", "noise": given(float(s["noise"]["value"]) / 1e3)} if s["kind"] == "torque" else s
        for s in table["sensor"]
    ]
    from excite.model import build
    from excite.smoothing import cramer_rao

    other = build(Machine.model_validate(table))
    bound = cramer_rao(excite.load("va12_straight"), straight_motion)
    assert np.allclose(cramer_rao(other, straight_motion), bound, rtol=1e-9)


@pytest.mark.parametrize("name", shipped_machines())
def test_shipped_sensors_are_not_doubted(name: str) -> None:
    assert list(doubt_sensors(load_machine(name))) == []


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (
            {"gear_ratio": given(1 / 101)},
            r"gear_ratio: 0.0099\d*: limit.torque takes .* A: upside down\? .* = 101 turns",
        ),
        ({"gear_ratio": given(1e5)}, "gear_ratio: limit.torque takes 0.004 A, usual are"),
        ({"gear_ratio": given(50.0), "noise": given(1e-9)}, "noise: 1e-09 A: no such sensor has so little"),
        ({"gear_ratio": given(50.0), "noise": given(9.0)}, "noise: 9 A beside 8 A at the limit"),
    ],
)
def test_what_no_sensor_has_is_asked_about(keys: dict[str, Any], words: str) -> None:
    machine = with_sensor("u1", **{"unit": "A", "torque_constant": given(0.1), "noise": given(0.01), **keys})
    assert re.search(words, " ".join(doubt_sensors(machine)))


@pytest.mark.parametrize("name", ["G13_gear_ratio/amp.toml", "G14_noise_in_bar/roller.toml"])
def test_shared_machines_are_asked_about(name: str) -> None:
    path = SHARED.parent / "cases" / name
    if not path.is_file():
        pytest.skip(f"the shared cases are not here ({path})")
    machine = load_machine(path)
    rows, doubts = {r["name"]: r for r in sensor_rows(machine)}, " ".join(doubt_sensors(machine))
    if "amp" in name:
        assert "takes 40400 A: upside down? (1 / 0.0099 = 101" in doubts
    else:
        assert rows["u_front"]["noise_si"] == pytest.approx(6.207, rel=1e-3)
        assert rows["u_front_steering"]["noise_si"] == pytest.approx(75)
        assert rows["front_drum"]["noise_si"] == pytest.approx(0.05 * math.pi / 30)
        assert doubts == ""


@pytest.mark.parametrize("off", [("M", "X", "Y", "Z", "F"), ("Fv1", "Fs1")], ids=["all", "friction of a joint"])
def test_values_off_by_the_square_of_a_gear_ratio_name_it(off: tuple[str, ...]) -> None:
    """Currents of a log, read with the ratio upside down, at all joints or at one whose other values are near zero."""
    from excite.identification import status
    from excite.model import build

    right = with_sensor("u1", unit="A", torque_constant=given(0.1), gear_ratio=given(20.0), noise=given(0.01))
    model = build(right)
    named = np.array([n.startswith(off) for n in model.base.names])
    model = replace(model, scale=np.where(named & (len(off) < 3), 2 * np.abs(model.nominal), model.scale))
    estimate = type("E", (), {})()
    estimate.value = np.where(named, model.nominal / 400.0, model.nominal)
    estimate.std_total = 1e-6 * np.ones(len(model.nominal))
    assert "the square of the gear_ratio 20: is it upside down?" in status._unit_suspicion(model, estimate)


def test_check_shows_the_sensors(tmp_path: Path) -> None:
    found = machine_check.check_machine(tmp_path, ARM, {})
    assert [r["name"] for r in found["sensors"]] == [s.name for s in load_machine(ARM).sensor]
