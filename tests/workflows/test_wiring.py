"""The lists for the person who wires the logger agree with what reading a log asks for."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from support.commands import Excite

from excite.model.machine import load_machine

SENSORS = """
extends = "va12"
name = "mine"
[sensor.theta2]
rate_hz = { value = 20, source = "data sheet" }
[sensor.u1]
column = "p forward"
return_column = "p backward"
unit = "bar"
displacement = { value = 8e-3, source = "data sheet" }
"""


def test_the_list_has_every_column_of_a_log(excite: Excite, tmp_path: Path) -> None:
    file, out = tmp_path / "mine.toml", tmp_path / "checked"
    file.write_text(SENSORS, encoding="utf-8")
    assert excite("machine", "check", file, "--out", out)[0] == 0
    rows = pd.read_csv(out / "wiring.csv", index_col="column")
    machine = load_machine(file)
    asked = {c for s in machine.sensors("full") for c in (s.column, s.return_column) if c} | {machine.time_column}
    assert set(rows.index) == asked
    assert list(pd.read_csv(out / "log_template.csv").columns) == list(rows.index)
    assert rows["unit"]["p forward"] == rows["unit"]["p backward"] == "bar"
    assert rows["readings per second"]["theta2_rad"] == 20
    assert rows["readings per second"]["theta4_rad"] == float(machine.sampling_hz)


def test_nothing_is_listed_of_a_file_that_cannot_be_used(excite: Excite, tmp_path: Path) -> None:
    file, out = tmp_path / "mine.toml", tmp_path / "checked"
    file.write_text(SENSORS.replace('"bar"', '"furlong"'), encoding="utf-8")
    assert excite("machine", "check", file, "--out", out)[0] == 2
    assert not (out / "wiring.csv").exists()
