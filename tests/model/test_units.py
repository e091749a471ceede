"""Units that logs are in: the values against their definitions, and a machine whose log has none of ours."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tomli_w
from hypothesis import given, strategies as st
from support.logs import make_log

from excite.errors import LogError, MachineError
from excite.identification import identify
from excite.logs import log, samples
from excite.model import prediction
from excite.model.machine import UNITS, Sensor, hydraulics, machine
from excite.model.machine.hydraulics import Cylinder
from excite.model.machine.units import QUANTITIES_BY_KIND
from excite.simulation import Motion, sensors
from excite.smoothing import cramer_rao

# 8 l per turn of the roll: motor and gear together; the paper's transducers give 0-10 V over 0-400 bar
HYDRAULIC = """
extends = "va12"
name = "hydraulic"
noise_unit = "SI"
time_column = "Time"
time_unit = "ms"
[[sensor]]
name = "theta1"
kind = "angle"
body = 1
column = "n1"
unit = "rpm"
[[sensor]]
name = "theta4"
kind = "angle"
body = 4
column = "turns4"
unit = "turn"
counts_per_turn = { value = 8192, source = "assumed" }
[[sensor]]
name = "theta2"
kind = "angle"
body = 2
column = "steer"
unit = "deg"
counts_per_turn = { value = 16384, source = "assumed" }
[[sensor]]
name = "u1"
kind = "torque"
body = 1
column = "p1 a"
return_column = "p1 b"
unit = "V"
factor = { value = 4e6, source = "data sheet", note = "Pa/V" }
displacement = { value = 8e-3, source = "data sheet" }
noise = { value = 40, source = "assumed" }
[[sensor]]
name = "u4"
kind = "torque"
body = 4
column = "p4 a"
return_column = "p4 b"
unit = "bar"
displacement = { value = 8e-3, source = "data sheet" }
noise = { value = 40, source = "assumed" }
[[sensor]]
name = "u2"
kind = "torque"
body = 2
column = "M2"
unit = "kN m"
noise = { value = 100, source = "assumed" }
[[sensor]]
name = "vy"
kind = "lateral_speed"
body = 0
column = "vy"
unit = "km/h"
noise = { value = 0.01, source = "assumed" }
"""


@pytest.fixture
def hydraulic(tmp_path: Path) -> prediction.Model:
    (tmp_path / "hydraulic.toml").write_text(HYDRAULIC)
    return prediction.build(machine.load_machine(tmp_path / "hydraulic.toml"))


def test_values_are_those_of_the_definitions() -> None:
    assert UNITS["rpm"][1] * 60 == pytest.approx(2 * math.pi)
    assert UNITS["deg"][1] * 180 == pytest.approx(math.pi)
    assert UNITS["km/h"][1] * 36 == pytest.approx(10)
    assert UNITS["psi"][1] == pytest.approx(6894.757293168, rel=1e-12)  # NIST SP 811
    assert UNITS["lbf ft"][1] == pytest.approx(1.3558179483314, rel=1e-12)
    assert UNITS["mph"][1] == pytest.approx(0.44704)
    assert {q for qs in QUANTITIES_BY_KIND.values() for q in qs} <= {q for q, _ in UNITS.values()}


def test_pressures_become_torque(hydraulic: prediction.Model) -> None:
    """100 bar across a motor of 8 l per turn: 1e7 Pa x 8e-3 m3 / (2 pi) = 12.7 kN m, whichever unit the log has."""
    sensor = {s.name: s for s in hydraulic.machine.sensor}
    assert sensor["u4"].gain * 100 == pytest.approx(1e7 * 8e-3 / (2 * math.pi))
    assert sensor["u1"].gain * 2.5 == pytest.approx(1e7 * 8e-3 / (2 * math.pi))  # 2.5 V are 100 bar
    table = pd.DataFrame({"p4 a": [20.0, 15.0], "p4 b": [15.0, 20.0]})
    assert log.values_of(sensor["u4"], hydraulic.machine, table, "log") == pytest.approx(
        np.array([1, -1]) * 5e5 * 8e-3 / (2 * math.pi)
    )


def test_a_log_in_other_units_says_the_same(
    hydraulic: prediction.Model, va12: prediction.Model, va12_motion: Motion
) -> None:
    """One motion through both machine files: the checked logs agree, sensor by sensor."""
    one = make_log(va12, va12_motion, noise=False)
    wheelless = replace(va12_motion, wheels=va12_motion.wheels[:, :0])
    table = sensors.measure(hydraulic, wheelless, noise=False)
    assert table["Time"].iloc[-1] == pytest.approx(60_000)
    assert table[["p1 a", "p1 b", "p4 a", "p4 b"]].to_numpy().min() > 0
    assert table["p1 a"].max() < 10
    other = log.from_table(table, hydraulic.machine)
    assert set(other.values) == {"theta1", "theta4", "theta2", "u1", "u4", "u2", "vy"}
    for name, values in other.values.items():
        expected = one.values[name]
        if name == "theta1":  # a rate stays a rate
            assert values == pytest.approx(va12_motion.nu[:, va12.coordinates.index("theta1")], rel=1e-9, abs=1e-9)
        else:
            assert values == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())
    assert one.t == pytest.approx(other.t)


@pytest.mark.parametrize("stamp", ["2024-05-03 10:00:00", "03.05.2024 10:00:00"])
def test_dates_are_time_from_the_first_on(va12: prediction.Model, va12_motion: Motion, stamp: str) -> None:
    table = sensors.measure(va12, va12_motion, noise=False)
    first = pd.Timestamp("2024-05-03 10:00:00")
    written = first + pd.to_timedelta(table["t_s"], unit="s")
    table["t_s"] = written.dt.strftime("%Y-%m-%d %H:%M:%S.%f" if stamp[4] == "-" else "%d.%m.%Y %H:%M:%S.%f")
    read = log.from_table(table, va12.machine)
    assert read.t[-1] == pytest.approx(60)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('unit = "rpm"', 'unit = "bar"', ["sensor[0].unit", "'bar'", "angle", "deg", "factor"]),
        ('unit = "rpm"', 'unit = "furlong"', ["'furlong'", "kind angle: rad"]),
        ('unit = "km/h"', 'unit = "deg"', ["lateral_speed", "km/h"]),
        ('return_column = "p4 b"\n', "", ["return_column", "two pressures"]),
        ('unit = "bar"\ndisplacement = { value = 8e-3, source = "data sheet" }', 'unit = "bar"', ["displacement"]),
        ('column = "p4 b"', 'column = "p1 a"', ["p1 a is used twice"]),
        ('unit = "rpm"', 'unit = "rpm"\ncounts_per_turn = { value = 5, source = "assumed" }', ["counts_per_turn"]),
        ('time_unit = "ms"', 'time_unit = "h"', ["time_unit", "'ms'"]),
        ('factor = { value = 4e6, source = "data sheet", note = "Pa/V" }\n', "", ["'V'", "pressure", "bar", "factor"]),
    ],
)
def test_what_does_not_fit_is_one_clear_line(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in HYDRAULIC
    (tmp_path / "m.toml").write_text(HYDRAULIC.replace(old, new))
    with pytest.raises(MachineError) as err:
        machine.load_machine(tmp_path / "m.toml")
    message = str(err.value)
    assert "\n" not in message
    for word in words:
        assert word in message


# Two cylinders cross-connected as on an articulated steering: what pushes one pulls the other. Pins from the joint's
# axis [m]: the left one 0.35 m to the left, 0.6 m before the axis and 0.5 m behind it.
CYLINDERS = """
extends = "va12"
name = "cylinders"
noise_unit = "SI"
[[sensor]]
name = "u2"
kind = "torque"
body = 2
column = "p2 left"
return_column = "p2 right"
unit = "bar"
noise = { value = 100, source = "assumed" }
[[sensor.cylinders]]
area = { value = 5.027e-3, source = "data sheet", note = "bore 80 mm" }
rod_area = { value = 3.064e-3, source = "data sheet", note = "rod 50 mm" }
anchor = { value = [0.6, 0.35], source = "measured" }
pin = { value = [-0.5, 0.35], source = "measured" }
[[sensor.cylinders]]
piston = "return_column"
area = { value = 5.027e-3, source = "data sheet" }
rod_area = { value = 3.064e-3, source = "data sheet" }
anchor = { value = [0.6, -0.35], source = "measured" }
pin = { value = [-0.5, -0.35], source = "measured" }
"""


def variant(folder: Path, text: str) -> machine.Machine:
    """The machine va12 with some of its sensors as the text has them."""
    own = tomllib.loads(text)
    names = {s["name"]: s for s in own["sensor"]}
    shipped = tomllib.loads((machine.MACHINES / "va12.toml").read_text(encoding="utf-8"))["sensor"]
    own["sensor"] = [names.get(s["name"], s) for s in shipped]
    (folder / "variant.toml").write_text(tomli_w.dumps(own))
    return machine.load_machine(folder / "variant.toml")


@pytest.fixture
def cylinders(tmp_path: Path) -> prediction.Model:
    return prediction.build(variant(tmp_path, CYLINDERS))


def length(c: Cylinder, angle: float) -> float:
    """How long a cylinder is, from its pins."""
    assert c.anchor is not None
    assert c.pin is not None
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return float(np.linalg.norm(turn @ c.pin.value - np.array(c.anchor.value)))


@given(
    angle=st.floats(-0.6, 0.6),
    left=st.floats(0, 4e7),
    right=st.floats(0, 4e7),
    pins=st.tuples(*[st.floats(0.2, 0.8)] * 4),
)
def test_cylinders_do_the_work_that_their_oil_does(
    angle: float, left: float, right: float, pins: tuple[float, ...]
) -> None:
    """Virtual work: the torque times a small turn is the pressure times the volume that each side takes up."""
    ax, ay, px, py = pins
    point = {"source": "assumed"}
    c = Cylinder.model_validate(
        {
            "area": {"value": 5e-3, **point},
            "rod_area": {"value": 3e-3, **point},
            "anchor": {"value": (ax, ay), **point},
            "pin": {"value": (-px, py), **point},
        }
    )
    sensor = Sensor.model_validate(
        {
            "name": "u2",
            "kind": "torque",
            "body": 2,
            "column": "a",
            "return_column": "b",
            "unit": "bar",
            "cylinders": (c,),
        }
    )
    turn = 1e-5
    grown = length(c, angle + turn) - length(c, angle - turn)
    push, pull = hydraulics.torque_per_pressure(sensor.displacement, sensor.cylinders, np.array([angle]))
    work = (5e-3 * left - 3e-3 * right) * grown
    assert 2 * turn * (push[0] * left + pull[0] * right) == pytest.approx(work, rel=1e-5, abs=1e-7)


def test_a_piston_without_its_rod_is_no_larger_than_the_piston() -> None:
    areas = {"area": {"value": 3e-3, "source": "assumed"}, "rod_area": {"value": 5e-3, "source": "assumed"}}
    with pytest.raises(ValueError, match="rod_area: the piston without the rod"):
        Cylinder.model_validate({**areas, "lever": {"value": 0.3, "source": "assumed"}})


def test_pressures_of_cylinders_become_the_joints_torque(cylinders: prediction.Model) -> None:
    """Straight, both cylinders have the lever 0.35 m: 100 bar on one side turn by p (A + A_rod) 0.35 m = 28.3 kN m."""
    sensor = next(s for s in cylinders.machine.sensor if s.name == "u2")
    table = pd.DataFrame({"theta2_rad": [0.0, 0.0, 0.0], "p2 left": [110.0, 10, 60], "p2 right": [10.0, 110, 60]})
    torque = log.values_of(sensor, cylinders.machine, table, "log")
    most = 1e7 * (5.027e-3 + 3.064e-3) * 0.35
    assert np.abs(torque) == pytest.approx([most, most, 0.0], abs=1e-6 * most)
    assert torque[0] == pytest.approx(-torque[1])


def test_a_log_of_cylinders_says_the_torque_that_was_delivered(
    cylinders: prediction.Model, va12_motion: Motion
) -> None:
    """From torque to pressures, at angles up to the stop, and back."""
    table = sensors.measure(cylinders, va12_motion, noise=False)
    assert table[["p2 left", "p2 right"]].to_numpy().min() > 0
    read = log.from_table(table, cylinders.machine)
    true = sensors.exact_readings(cylinders, va12_motion)["u2"]
    assert read.values["u2"] == pytest.approx(true, abs=1e-6 * np.abs(true).max())
    bent = np.abs(va12_motion.q[:, 4]) > 0.3
    straight = log.values_of(
        next(s for s in cylinders.machine.sensor if s.name == "u2"), cylinders.machine, table.assign(theta2_rad=0.0), ""
    )
    assert np.abs(straight - true)[bent].max() > 0.03 * np.abs(true).max()  # the lever must follow the angle
    with pytest.raises(LogError, match=r"theta2_rad .angle of articulation.*lever"):
        log.from_table(table.drop(columns="theta2_rad"), cylinders.machine)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('pin = { value = [-0.5, 0.35], source = "measured" }\n', "", ["cylinders[0]", "lever", "both anchor and pin"]),
        ("value = [-0.5, 0.35]", "value = [-0.5, -0.85]", ["no lever", "check the pins"]),
        ('return_column = "p2 right"\n', "", ["return_column", "two pressures"]),
        ("body = 2\n", 'body = 2\ndisplacement = { value = 1, source = "assumed" }\n', ["cylinders", "not both"]),
        ('unit = "bar"', 'unit = "N m"', ["pressure", "bar"]),
    ],
)
def test_cylinders_that_make_no_sense_are_one_clear_line(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in CYLINDERS
    with pytest.raises(MachineError) as err:
        variant(tmp_path, CYLINDERS.replace(old, new, 1))
    message = str(err.value)
    assert "\n" not in message
    for word in words:
        assert word in message


WHEEL = """place = "measuring_wheel_{place}"
lateral = {{ value = {lateral}, source = "assumed" }}
radius = {{ value = 0.33, source = "assumed" }}
"""
# Every angle as a rate, as CAN buses give them, with the noise of such sensors.
RATES = """
extends = "va12"
name = "rates"
noise_unit = "SI"
""" + "".join(
    f"""
[[sensor]]
name = "{name}"
kind = "{kind}"
body = {body}
column = "{name}_rpm"
unit = "rpm"
noise = {{ value = 0.005, source = "assumed" }}
{extra}"""
    for name, kind, body, extra in (
        ("theta1", "angle", 1, ""),
        ("theta4", "angle", 4, ""),
        ("thetal", "wheel", 0, WHEEL.format(place="left", lateral=1.25)),
        ("thetar", "wheel", 0, WHEEL.format(place="right", lateral=-1.25)),
    )
)


@pytest.mark.slow
def test_rates_identify_as_well_as_the_bound_says(tmp_path: Path, va12_motion: Motion) -> None:
    """Rolls and measuring wheels logged in rpm: joint smoothing takes them for the rates that they are, so its errors
    are as large as it says, and as the Cramer-Rao bound of such sensors does. A rate summed up to an angle whose noise
    counts as white gives deviations that are far too small."""
    model = prediction.build(variant(tmp_path, RATES))
    off, said = [], []
    for seed in range(2):
        table = sensors.measure(model, va12_motion, seed=seed)
        found = identify(model, [log.from_table(table, model.machine)], "joint")
        off.append((found.value - model.nominal) / found.std)
        said.append(found.std)
    z = np.array(off)
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.35
    assert (np.abs(z) < 4.5).all()
    bound = np.sqrt(np.diag(cramer_rao(model, va12_motion)))
    assert np.median(np.mean(said, axis=0) / bound) == pytest.approx(1.0, abs=0.25)


def test_a_rate_that_is_summed_up_or_differentiated_is_the_same_motion(
    tmp_path: Path, va12: prediction.Model, va12_motion: Motion
) -> None:
    """What classic methods make of a log: rates and angles of one motion give the same samples."""
    model = prediction.build(variant(tmp_path, RATES))
    one, other = (samples(m, make_log(m, va12_motion, noise=False), m.machine.filter) for m in (va12, model))
    rolls = [va12.coordinates.index(n) for n in ("x0", "theta0", "theta1", "theta4")]
    inner = slice(200, -200)
    assert other.nu[rolls, inner] == pytest.approx(one.nu[rolls, inner], abs=3e-3)
    turned = [va12.coordinates.index(n) for n in ("theta1", "theta4")]
    grown = [s.q[turned] - s.q[turned][:, 200:201] for s in (one, other)]
    assert grown[1][:, inner] == pytest.approx(grown[0][:, inner], abs=5e-3)


def test_values_are_told_in_the_unit_that_they_are_in(tmp_path: Path, va12: prediction.Model) -> None:
    """A log is SI once it is read, whatever its columns were in; a sliding joint's angle is a length."""
    emps = machine.load_machine("emps")
    assert {s.kind: emps.si_unit(s) for s in emps.sensor} == {"angle": "m", "torque": "N"}
    rpm = prediction.build(variant(tmp_path, RATES)).machine
    assert {s.name: rpm.si_unit(s) for s in rpm.sensor if s.unit == "rpm"} == dict.fromkeys(
        ("theta1", "theta4", "thetal", "thetar"), "rad/s"
    )
    told = {s.kind: va12.machine.si_unit(s) for s in va12.machine.sensor}
    assert told == {"angle": "rad", "wheel": "rad", "torque": "N m", "yaw_rate": "rad/s", "lateral_speed": "m/s"}
