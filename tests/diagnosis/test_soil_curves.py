"""Curves without a name on a roller: what the soil does beyond its law, hidden in a simulated log, and found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tomli_w
from support.files import RESULTS

import excite
from excite.model.effects import MAP_NODES, soil_table

DISTANCE = np.linspace(-6.0, 12.0, MAP_NODES)  # m that the front roll has rolled


def softer(distance: np.ndarray) -> np.ndarray:
    """Share by which the soil is stiffer lengthwise: a soft place 3 m ahead, which no effect of the catalogue has."""
    return np.asarray(-0.3 * np.exp(-(((distance - 3.0) / 2.5) ** 2)))


@pytest.fixture(scope="module")
def true_machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The straight roller on soil with a soft place under its front roll."""
    shapes = soil_table("rolled distance", DISTANCE.tolist(), softer(DISTANCE).tolist(), "stiffness")
    quantity = {n: {"value": x, "source": "assumed"} for n, x in shapes.items()}
    amount = {"value": 1.0, "source": "assumed"}
    entry = {"name": "lengthwise_map", "where": "front_roll", "amount": amount, "shape": quantity}
    file = tmp_path_factory.mktemp("soil") / "true.toml"
    file.write_text(tomli_w.dumps({"extends": "va12_straight", "effect": [entry]}))
    return file


@pytest.mark.slow
def test_a_soft_place_is_drawn_as_a_curve_and_holds_on_another_drive(true_machine: Path, tmp_path: Path) -> None:
    """No name, a curve of the stiffness over the distance within its band, which holds on another drive there."""
    log = excite.simulate(str(true_machine), str(RESULTS / "S40" / "design"), seed=1)
    found = excite.diagnose("va12_straight", log)
    assert found.summary["verdict"] == "unexplained"
    assert not found.summary["findings"]
    assert found.summary["gain_ci95"][0] > 0
    (curve,) = found.diagnosis.curves
    assert curve.entry.label == "lengthwise_map@front_roll"
    assert curve.signal == ("its rolled distance", "m")
    true = 100 * softer(curve.at)
    off = curve.value - true
    off -= np.average(off, weights=curve.std**-2)  # a constant share is another stiffness
    assert np.mean(np.abs(off) < 3 * curve.std) > 0.85
    assert np.corrcoef(curve.value, true)[0, 1] > 0.7
    found.save(tmp_path / "diagnosis")
    drive = pd.read_csv(RESULTS / "S40" / "design" / "profile.csv")[["t_s", "u1_Nm", "u4_Nm"]]
    drive[["u1_Nm", "u4_Nm"]] = 0.8 * drive[["u4_Nm", "u1_Nm"]].to_numpy()
    other = excite.simulate(str(true_machine), drive, seed=2)
    plain, mapped = (excite.identify(m, other) for m in ("va12_straight", str(tmp_path / "diagnosis" / "machine.toml")))
    assert (plain.status, mapped.status) == ("doubtful", "valid")
    at = mapped.names.index("lengthwise_map@front_roll")
    assert mapped.value[at] > 5 * mapped.std[at]
    mass = excite.load("va12_straight").nominal[0]
    assert abs(mapped.value[0] / mass - 1) < min(0.03, abs(plain.value[0] / mass - 1))
