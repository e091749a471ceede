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
from excite.logs import inspection, prepare
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
    ready = prepare(straight, [table])
    whole, none = ready.logs, ready.notes
    holed = table.drop(index=range(1700, 1853)).reset_index(drop=True)
    ready = prepare(straight, [holed])
    logs, notes = ready.logs, ready.notes
    assert (len(whole), none) == (1, [])
    assert [len(one) for one in logs] == [1700, 4001 - 1853]
    assert notes == ["log: 1 gap: used are 2 of 2 stretches between, 38.46 of 40 s"]
    full, both = identify(straight, whole, "joint"), identify(straight, logs, "joint")
    assert np.sqrt(np.mean(((both.value - straight.nominal) / both.std) ** 2)) < 1.6
    assert (both.std > 0.95 * full.std).all()  # counts of two stretches begin anew: a little more or less harm
    assert (both.std < 1.6 * full.std).all()


@pytest.mark.parametrize(
    "drop",
    [range(100, 200), range(3900, 3950), [k for k in range(4001) if k % 100 < 20]],
    ids=["near the start", "near the end", "everywhere"],
)
def test_gaps_beside_which_too_little_is_left(straight: Model, table: pd.DataFrame, drop: list[int]) -> None:
    holed = table.drop(index=list(drop)).reset_index(drop=True)
    if len(drop) > 100:
        with pytest.raises(LogError, match="no stretch between gaps lasts 2 s"):
            prepare(straight, [holed])
        return
    ready = prepare(straight, [holed])
    assert len(ready.logs) == 1
    assert any("used are 1 of 2 stretches" in note for note in ready.notes)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [20, 300, 900])
def test_a_gap_is_a_gap_wherever_it_is(straight: Model, lost: int) -> None:
    """What a joint does while nothing is seen is neither too fast for it nor a speed."""
    table = sensors.measure(straight, designed("S40", straight), seed=1)
    for first in range(600, 2500, 50):
        holed = table.drop(index=range(first, first + lost)).reset_index(drop=True)
        logs = prepare(straight, [holed]).logs
        assert [len(one) for one in logs] == [first, len(table) - first - lost]
        found = inspection.inspect(holed, straight.machine)
        assert found.faults == ()
        assert any("1 gap: used are 2 of 2" in line for line in found.remarks)


def test_identify_reports_the_cut(excite: Excite, table: pd.DataFrame, tmp_path: Path) -> None:
    table.drop(index=range(1700, 1853)).to_csv(tmp_path / "holed.csv", index=False)
    code, stdout, _ = excite("identify", "va12_straight", tmp_path / "holed.csv", "--out", tmp_path / "a", "--json")
    summary = json.loads(stdout)
    assert code == 0
    assert [source.partition(" ")[2] for source in summary["logs"]] == ["from row 1", "from row 1701"]
    assert any("1 gap: used are 2 of 2 stretches" in note for note in summary["notes"])


@pytest.mark.slow
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
    assert sum("used are 2 of 2 stretches between" in note and "validated on" in note for note in summary["notes"]) == 1
