"""A file with a gap: two logs, and the answer of both; a file in pieces is refused as before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite
from support.drives import designed

from excite.errors import LogError
from excite.identification import identify
from excite.logs import gaps, inspection
from excite.model import Model
from excite.simulation import sensors, simulate


@pytest.fixture(scope="module")
def table(straight: Model) -> pd.DataFrame:
    t = np.arange(4001) / 100
    rise = np.clip(np.minimum(t, t[-1] - t) / 2, 0, 1)
    torque = 2500 * np.sin(2 * np.pi * t / 9) + 1200 * np.sin(2 * np.pi * t / 3.7)
    motion = simulate(straight, np.column_stack([torque, torque]) * rise[:, None])
    return sensors.measure(straight, motion, kit="paper", seed=1)


def test_a_gap_makes_two_logs(straight: Model, table: pd.DataFrame) -> None:
    """Also while the machine moves: what was not seen is not made up."""
    whole, none = gaps.split(table, straight.machine)
    holed = table.drop(index=range(1700, 1853)).reset_index(drop=True)
    logs, notes = gaps.split(holed, straight.machine, source="holed.csv")
    assert (len(whole), none) == (1, [])
    assert [len(one) for one in logs] == [1700, 4001 - 1853]
    assert notes == ["holed.csv: a gap (1.54 s before row 1701): identified from the 2 stretches between"]
    full, both = identify(straight, whole, "joint"), identify(straight, logs, "joint")
    assert np.sqrt(np.mean(((both.value - straight.nominal) / both.std) ** 2)) < 1.6
    assert (both.std > 0.95 * full.std).all()  # counts of two stretches begin anew: a little more or less harm
    assert (both.std < 1.6 * full.std).all()


@pytest.mark.parametrize(
    "drop",
    [range(100, 200), range(3700, 3800), [k for k in range(500, 3500) if k % 100 < 20]],
    ids=["near the start", "near the end", "everywhere"],
)
def test_gaps_beside_which_too_little_is_left(straight: Model, table: pd.DataFrame, drop: list[int]) -> None:
    with pytest.raises(LogError, match="gap of"):
        gaps.split(table.drop(index=list(drop)).reset_index(drop=True), straight.machine)


@pytest.mark.parametrize("lost", [20, 300, 900])
def test_a_gap_is_a_gap_wherever_it_is(straight: Model, lost: int) -> None:
    """What a joint does while nothing is seen is neither too fast for it nor a speed."""
    table = sensors.measure(straight, designed("S40", straight), seed=1)
    for first in range(600, 2500, 50):
        holed = table.drop(index=range(first, first + lost)).reset_index(drop=True)
        logs, _ = gaps.split(holed, straight.machine)
        assert [len(one) for one in logs] == [first, len(table) - first - lost]
        (fault,) = inspection.inspect(holed, straight.machine).faults
        assert "a gap of" in fault


def test_identify_reports_the_cut(excite: Excite, table: pd.DataFrame, tmp_path: Path) -> None:
    table.drop(index=range(1700, 1853)).to_csv(tmp_path / "holed.csv", index=False)
    code, stdout, _ = excite("identify", "va12_straight", tmp_path / "holed.csv", "--out", tmp_path / "a", "--json")
    summary = json.loads(stdout)
    assert code == 0
    assert [source.partition(" ")[2] for source in summary["logs"]] == ["from row 1", "from row 1701"]
    assert any("a gap (1.54 s before row 1701)" in note for note in summary["notes"])


def test_a_gap_in_a_log_to_validate_with(excite: Excite, table: pd.DataFrame, tmp_path: Path) -> None:
    """The stretches beside it are predicted, each as a log of its own."""
    table.to_csv(tmp_path / "whole.csv", index=False)
    table.drop(index=range(1700, 1853)).to_csv(tmp_path / "holed.csv", index=False)
    told = ("identify", "va12_straight", tmp_path / "whole.csv", "--validate", tmp_path / "holed.csv")
    code, stdout, _ = excite(*told, "--out", tmp_path / "a", "--json")
    summary = json.loads(stdout)
    assert code == 0
    assert len(summary["logs"]) == 1
    assert [v["log"].partition("holed.csv ")[2] for v in summary["validation"]] == ["from row 1", "from row 1701"]
    for v in summary["validation"]:
        assert max(v["torque_error_percent"].values()) < 20
    assert sum("validated on the 2 stretches between" in note for note in summary["notes"]) == 1
