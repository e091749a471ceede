"""Several publishers of the same joint: their values are read if they agree, and refused if they contradict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from excite.errors import LogError
from excite.logs import read_table
from excite.logs.log import cells_of

RNG = np.random.default_rng(0)
Q = "/joint_states/position[0]"


def bag(path: Path, second: Any, marked: str = "", rate: int = 1, stamped: float | None = None) -> Path:
    """Write messages of two publishers. marked: how they differ. stamped [s]: of the second's values, its delay."""
    mcap = pytest.importorskip("mcap.writer", reason="mcap is not installed (extra ros)")
    said = [(0.01 * k, 0, float(np.sin(0.03 * k))) for k in range(400)]
    said += [(0.01 * k * rate + 0.005, 1, float(second(0.01 * k * rate))) for k in range(400 // rate)]
    with (path / "log.mcap").open("wb") as file:
        writer = mcap.Writer(file)
        writer.start()
        schema = writer.register_schema("Any", "jsonschema", b"{}")
        channels = [writer.register_channel("/joint_states", "json", schema) for _ in "ab"]
        for t, who, q in sorted(said):
            at = 10**18 + round(1e9 * t)
            message: dict[str, Any] = {"name": ["hip"], "position": [q], "header": {"frame_id": ""}}
            if marked == "frame":
                message["header"]["frame_id"] = ("arm", "gui")[who]
            if marked == "names" and who:
                message |= {"name": ["hip", "knee"], "position": [q, 1.0]}
            if stamped is not None:
                stamp = at - round(1e9 * stamped * who)
                message["header"]["stamp"] = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
            writer.add_message(channels[who * (marked == "channel")], at, json.dumps(message).encode(), at)
        writer.finish()
    return path / "log.mcap"


@pytest.mark.parametrize("marked", ["", "frame", "names", "channel"])
@pytest.mark.parametrize("rate", [1, 2, 3])
@pytest.mark.parametrize("second", [lambda t: 0.0, lambda t: np.sin(3 * (t - 0.03))], ids=["stale", "late"])
def test_publishers_that_contradict_are_refused(second: Any, rate: int, marked: str, tmp_path: Path) -> None:
    if second(0.0) and rate > (2 if marked else 1):
        pytest.skip("late by no more than the time between two of its messages")
    table = read_table(bag(tmp_path, second, marked, rate))
    with pytest.raises(LogError, match="several publishers") as said:
        cells_of(table, Q, "log")
    for told in {"frame": ("arm", "gui"), "names": ("hip knee",), "channel": ("channel 1", "channel 2")}.get(
        marked, ()
    ):
        assert told in str(said.value)


@pytest.mark.parametrize("marked", ["", "frame", "names", "channel"])
@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.3])
@pytest.mark.parametrize("rate", [1, 4])
def test_publishers_that_agree_are_read(rate: int, noise: float, marked: str, tmp_path: Path) -> None:
    def second(t: float) -> float:
        return float(np.sin(3 * (t + 0.005)) + noise * RNG.standard_normal())

    assert len(cells_of(read_table(bag(tmp_path, second, marked, rate)), Q, "log")) == 400 + 400 // rate


def test_late_messages_are_read_by_their_stamps(tmp_path: Path) -> None:
    path = bag(tmp_path, lambda t: np.sin(3 * (t - 0.03)), "channel", stamped=0.035)
    with pytest.raises(LogError, match=r"header\.stamp"):
        cells_of(read_table(path), Q, "log")
    table = read_table(path, [Q, "header.stamp"])
    assert table[Q].to_numpy() == pytest.approx(np.sin(3 * table["header.stamp"]), abs=0.02)
