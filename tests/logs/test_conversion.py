"""`excite log convert`, logs whose channels come from loggers of their own, and the picture of a check."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite
from support.files import SHARED

from excite import identify
from excite.errors import LogError
from excite.logs import prepare
from excite.model import Model, build
from excite.simulation import Motion, measure

RACK = SHARED / "rack_and_pinion"
PENDULUM = SHARED / "dfki_pendulum" / "data_measured.csv"


@pytest.fixture(scope="module")
def table(va12: Model, va12_motion: Motion) -> pd.DataFrame:
    return measure(va12, va12_motion, seed=2)


@pytest.mark.slow
def test_a_converted_log_gives_the_same_estimate(
    straight: Model, straight_motion: Motion, tmp_path: Path, excite: Excite
) -> None:
    log = tmp_path / "log.csv"
    measure(straight, straight_motion, seed=2).to_csv(log, index=False)
    before = identify(straight, log, "ols")
    for out in (tmp_path / "used.csv", tmp_path / "used.parquet"):
        code, stdout, _ = excite("log", "convert", log, "--machine", "va12_straight", "--out", out, "--json")
        assert code == 0
        (file,) = json.loads(stdout)["files"]
        assert (file["path"], file["rows"], file["rate_hz"], file["duration_s"]) == (str(out), 4001, 100, 40)
        assert identify(straight, out, "ols").value == pytest.approx(before.value, rel=1e-6)


def test_uneven_rows_are_written_even_and_repaired(table: pd.DataFrame, tmp_path: Path, excite: Excite) -> None:
    rng = np.random.default_rng(0)
    bad = table.assign(t_s=table["t_s"] + rng.uniform(-2e-3, 2e-3, len(table)))
    bad.loc[1000, "u1_Nm"] += 4000
    bad = bad.drop(index=range(3000, 3200))
    bad.to_csv(tmp_path / "log.csv", index=False)
    code, stdout, _ = excite(
        "log", "convert", tmp_path / "log.csv", "--machine", "va12", "--out", tmp_path / "a.csv", "--si"
    )
    assert code == 0
    first, second = (pd.read_csv(tmp_path / f"a-{k}.csv") for k in (1, 2))
    for one in (first, second):
        assert np.diff(one["t_s"]) == pytest.approx(0.01, rel=1e-6)
        assert one.notna().to_numpy().all()
    assert first["u1 [N m]"].max() < 1.01 * table["u1_Nm"].max()
    assert "spike" in stdout
    assert "interpolated at their own times" in " ".join(stdout.split())


def test_nothing_is_written_over_its_source(table: pd.DataFrame, tmp_path: Path, excite: Excite) -> None:
    table.to_csv(tmp_path / "log.csv", index=False)
    before = (tmp_path / "log.csv").read_bytes()
    for name, words in (("log.csv", "is what the log is made from"), ("log.xls", "allowed: .csv, .parquet")):
        code, _, stderr = excite("log", "convert", tmp_path / "log.csv", "--machine", "va12", "--out", tmp_path / name)
        assert (code, stderr.count("\n")) == (2, 1)
        assert words in stderr
    assert (tmp_path / "log.csv").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["log.csv"]


def test_two_loggers_are_put_together_by_their_clocks(va12: Model, table: pd.DataFrame) -> None:
    """One file for torques, one for the rest, with other rates and a later start."""
    torques = [c for c in table.columns if c.startswith("u")]
    slow = table.loc[150::2, ["t_s", *torques]]
    rest = table.drop(columns=torques)
    ready = prepare(va12, [rest, slow])
    (one,) = ready.logs
    assert any("put together by their times" in line for line in ready.notes)
    at = table["t_s"].to_numpy()[150:]
    want = np.interp(one.t + at[0], table["t_s"], table["u1_Nm"])
    assert np.sqrt(np.mean((one.values["u1"] - want) ** 2)) < 60  # its noise is 40 N m


@pytest.mark.skipif(not RACK.is_dir(), reason="needs the measurements in ../shared/data/rack_and_pinion")
def test_a_load_cell_and_a_drive_with_a_clock_each() -> None:
    """The mass is 25.28 kg by an independent fit of the same two files."""
    found = identify("rack", [RACK / "force_2kHz.csv", RACK / "speed_1500Hz.csv"])
    assert abs(found.value[0] - 25.28) < 2 * found.std_total[0] < 0.1 * 25.28


@pytest.mark.skipif(not PENDULUM.is_file(), reason="needs the measurements in ../shared/data/dfki_pendulum")
def test_a_pendulum_is_as_its_builders_describe_it_and_little_else_is_known() -> None:
    """0.546 kg at 0.5 m and a rod of 0.13 kg: 0.306 kg m and 0.147 kg m2; friction and offset stay uncertain."""
    found = identify("pendulum", PENDULUM)
    told = dict(zip(found.names, zip(found.value, found.std_total, strict=True), strict=True))
    first, inertia = 0.546 * 0.5 + 0.13 * 0.25, 0.546 * 0.25 + 0.13 * 0.25 / 3
    for name, true in (("MX1", first), ("ZZ1", inertia)):
        value, std = told[name]
        assert abs(value - true) < 2.5 * std < 0.4 * true
    assert any("poorly identified" in note or "held at the machine file's value" in note for note in found.notes)


def test_two_loggers_need_no_sensor_of_a_locked_joint(straight: Model, straight_motion: Motion) -> None:
    table = measure(straight, straight_motion, seed=2)
    torques = ["u1_Nm", "u4_Nm"]
    ready = prepare(straight, [table.drop(columns=torques), table[["t_s", *torques]]], ("theta1", "theta4", "u1", "u4"))
    (one,) = ready.logs
    assert {"theta1", "u1"} <= one.values.keys()


def test_a_clock_that_is_not_there_is_named(straight: Model, straight_motion: Motion) -> None:
    """A simulated log has the clocks of all loggers, so one without is of another machine file."""
    own = tuple(
        s.model_copy(update={"time_column": "t_drive", "time_offset": 0.5}) if s.name == "u1" else s
        for s in straight.machine.sensor
    )
    model = build(straight.machine.model_copy(update={"sensor": own}))
    table = measure(model, straight_motion, seed=2)
    (one,) = prepare(model, [table]).logs
    assert len(one) == len(table)
    with pytest.raises(LogError, match="no column t_drive, which the machine file names as time_column of sensor u1 "):
        prepare(model, [table.drop(columns="t_drive")])
