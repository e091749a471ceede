"""Units that logs are in: the values against their definitions, and a machine whose log has none of ours."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from excite import log, sensors
from excite.simulate import Motion
from model import machine, prediction
from model.machine import MachineError
from model.units import MEASURES, UNITS

# 8 l per turn of the roll: motor and gear together; the paper's transducers give 0-10 V over 0-400 bar
HYDRAULIC = """
extends = "va12"
name = "hydraulic"
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
    return prediction.build(machine.load(tmp_path / "hydraulic.toml"))


def test_values_are_those_of_the_definitions() -> None:
    assert UNITS["rpm"][1] * 60 == pytest.approx(2 * math.pi)
    assert UNITS["deg"][1] * 180 == pytest.approx(math.pi)
    assert UNITS["km/h"][1] * 36 == pytest.approx(10)
    assert UNITS["psi"][1] == pytest.approx(6894.757293168, rel=1e-12)  # NIST SP 811
    assert UNITS["lbf ft"][1] == pytest.approx(1.3558179483314, rel=1e-12)
    assert UNITS["mph"][1] == pytest.approx(0.44704)
    assert {q for qs in MEASURES.values() for q in qs} <= {q for q, _ in UNITS.values()}


def test_pressures_become_torque(hydraulic: prediction.Model) -> None:
    """100 bar across a motor of 8 l per turn: 1e7 Pa x 8e-3 m3 / (2 pi) = 12.7 kN m, whichever unit the log has."""
    sensor = {s.name: s for s in hydraulic.machine.sensor}
    assert sensor["u4"].gain * 100 == pytest.approx(1e7 * 8e-3 / (2 * math.pi))
    assert sensor["u1"].gain * 2.5 == pytest.approx(1e7 * 8e-3 / (2 * math.pi))  # 2.5 V are 100 bar
    table = pd.DataFrame({"p4 a": [20.0, 15.0], "p4 b": [15.0, 20.0]})
    assert log.values_of(sensor["u4"], table, 100.0, "log") == pytest.approx(
        np.array([1, -1]) * 5e5 * 8e-3 / (2 * math.pi)
    )


def test_a_log_in_other_units_says_the_same(
    hydraulic: prediction.Model, va12: prediction.Model, va12_motion: Motion
) -> None:
    """One motion through both machine files: the checked logs agree, sensor by sensor."""
    one = log.check(sensors.measure(va12, va12_motion, noise=False), va12.machine)
    wheelless = replace(va12_motion, wheels=va12_motion.wheels[:, :0])
    table = sensors.measure(hydraulic, wheelless, noise=False)
    assert table["Time"].iloc[-1] == pytest.approx(60_000)
    assert table[["p1 a", "p1 b", "p4 a", "p4 b"]].to_numpy().min() > 0
    assert table["p1 a"].max() < 10
    other = log.check(table, hydraulic.machine)
    assert set(other.values) == {"theta1", "theta4", "theta2", "u1", "u4", "u2", "vy"}
    for name, values in other.values.items():
        expected = one.values[name]
        if name == "theta1":  # summed up from its rate, so without the angle that it begins at
            assert values == pytest.approx(expected - expected[0], abs=2e-3)
        else:
            assert values == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())
    assert one.t == pytest.approx(other.t)


@pytest.mark.parametrize("stamp", ["2024-05-03 10:00:00", "03.05.2024 10:00:00"])
def test_dates_are_time_from_the_first_on(va12: prediction.Model, va12_motion: Motion, stamp: str) -> None:
    table = sensors.measure(va12, va12_motion, noise=False)
    first = pd.Timestamp("2024-05-03 10:00:00")
    written = first + pd.to_timedelta(table["t_s"], unit="s")
    table["t_s"] = written.dt.strftime("%Y-%m-%d %H:%M:%S.%f" if stamp[4] == "-" else "%d.%m.%Y %H:%M:%S.%f")
    read = log.check(table, va12.machine)
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
        machine.load(tmp_path / "m.toml")
    message = str(err.value)
    assert "\n" not in message
    for word in words:
        assert word in message
