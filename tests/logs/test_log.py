"""Broken logs: each one clear line that says what, where and what to do; exit 2; nothing left behind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from support.commands import Excite

from excite.logs import log, prepare, profile
from excite.model import Model
from excite.simulation import Motion, sensors

Break = Callable[[pd.DataFrame, Path], Path]


def table_as(change: Callable[[pd.DataFrame], pd.DataFrame]) -> Break:
    def broken(table: pd.DataFrame, folder: Path) -> Path:
        path = folder / "log.csv"
        change(table).to_csv(path, index=False)
        return path

    return broken


def text_as(change: Callable[[str], str | bytes], name: str = "log.csv") -> Break:
    def broken(table: pd.DataFrame, folder: Path) -> Path:
        path = folder / name
        changed = change(table.to_csv(index=False))
        path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
        return path

    return broken


def cell(row: int, column: str, value: object) -> Break:
    def put(table: pd.DataFrame) -> pd.DataFrame:
        table = table.astype({column: object})
        table.loc[row - 1, column] = value
        return table

    return table_as(put)


def shifted(row: int, by: float) -> Break:
    def shift(table: pd.DataFrame) -> pd.DataFrame:
        table.loc[row - 1 :, "t_s"] += by
        return table

    return table_as(shift)


def mat(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Break:
    def broken(table: pd.DataFrame, folder: Path) -> Path:
        path = folder / "log.mat"
        scipy.io.savemat(path, change({c: table[c].to_numpy()[:, None] for c in table}))
        return path

    return broken


def parquet(table: pd.DataFrame, folder: Path) -> Path:
    path = folder / "log.parquet"
    table.to_parquet(path)
    path.write_bytes(path.read_bytes()[:-40])
    return path


BROKEN: dict[str, tuple[Break, list[str]]] = {
    "not there": (lambda t, f: f / "no.csv", ["no such file"]),
    "a folder": (lambda t, f: f, ["is a folder"]),
    "empty file": (text_as(lambda s: ""), ["is empty"]),
    "only blank lines": (text_as(lambda s: "\n\n\n"), ["is empty"]),
    "header alone": (text_as(lambda s: s.splitlines()[0] + "\n"), ["no rows"]),
    "binary": (text_as(lambda s: bytes(range(128, 256)) * 40), ["not a text file"]),
    "unknown ending": (text_as(lambda s: s, "log.xyz"), [".xyz", "allowed: .csv, .txt, ", ".parquet, .mat, "]),
    "too many cells in a line": (
        text_as(lambda s: s.replace("\n", "\n1,2,3,4,5,6,7,8,9,10,11,12,13,14\n", 6)),
        ["not a table"],
    ),
    "column missing": (table_as(lambda t: t.drop(columns="u1_Nm")), ["u1_Nm", "torque of front roll", "the file has"]),
    "no time": (table_as(lambda t: t.drop(columns="t_s")), ["t_s", "time"]),
    "column twice": (
        text_as(lambda s: s.replace("theta4_rad", "theta1_rad", 1)),
        ["no column theta4_rad", "column theta1_rad is there 2 times"],
    ),
    "text in a cell": (cell(58, "u4_Nm", "error"), ["row 58", "u4_Nm", "'error'"]),
    "infinite": (cell(59, "thetal_rad", np.inf), ["row 59", "thetal_rad", "inf"]),
    "decimal commas": (cell(60, "u1_Nm", "12,5"), ["row 60", "u1_Nm", "12,5"]),
    "time in milliseconds": (
        table_as(lambda t: t.assign(t_s=t["t_s"] * 1000)),
        ["0.1 Hz", "100 Hz", 'time_unit = "ms"'],
    ),
    "too short": (table_as(lambda t: t.head(50)), ["only 50 rows"]),
    "degrees": (table_as(lambda t: t.assign(theta2_rad=np.rad2deg(t["theta2_rad"]))), ["theta2_rad", "degrees"]),
    "angle not unwrapped": (
        table_as(lambda t: t.assign(theta1_rad=(t["theta1_rad"] + 3) % (2 * np.pi))),
        ["theta1_rad", "jumps", "unwrap"],
    ),
    "torque in mN m": (table_as(lambda t: t.assign(u1_Nm=1000 * t["u1_Nm"])), ["u1_Nm", "unit"]),
    "another machine's log": (
        table_as(lambda t: t.drop(columns=["theta2_rad", "u2_Nm", "yaw_rate_rad_s", "vy_m_s"])),
        ["theta2_rad", "looks like a log of va12_straight"],
    ),
    "mat of something else": (mat(lambda d: {"note": np.array(["hello"])}), ["no columns of numbers"]),
    "mat with unequal columns": (mat(lambda d: {**d, "u1_Nm": d["u1_Nm"][:-5]}), ["another length", "u1_Nm"]),
    "mat that is none": (text_as(lambda s: s, "log.mat"), ["not a MATLAB file"]),
    "complex": (mat(lambda d: {**d, "u1_Nm": d["u1_Nm"] + 1j}), ["u1_Nm"]),
    "damaged parquet": (parquet, ["not a Parquet file"]),
}


MENDED: dict[str, tuple[Break, str]] = {
    "empty cell": (cell(57, "u4_Nm", np.nan), "1 empty cell, interpolated"),
    "time goes back": (shifted(3000, -0.5), "time begins anew in row 3000: read as 2 logs in one file"),
    "time stands still": (shifted(100, -0.01), "1 row shares its time with the row before"),
    "gap": (shifted(2000, 0.35), "1 gap: used are 2 of 2 stretches between"),
}


@pytest.fixture(scope="module")
def table(va12: Model, va12_motion: Motion) -> pd.DataFrame:
    return sensors.measure(va12, va12_motion)


@pytest.mark.parametrize("name", BROKEN)
def test_broken_log_is_one_clear_line(name: str, table: pd.DataFrame, tmp_path: Path, excite: Excite) -> None:
    make, words = BROKEN[name]
    (tmp_path / "in").mkdir()
    path = make(table.copy(), tmp_path / "in")
    out = tmp_path / "deep" / "out"
    code, stdout, stderr = excite("identify", "va12", path, "--method", "ols", "--out", out)
    assert code == 2
    assert stdout == ""
    assert stderr.count("\n") == 1
    assert len(stderr) < 600
    assert str(path) in stderr
    for word in words:
        assert word in stderr
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".mat"])
def test_every_format_carries_the_same_log(ending: str, va12: Model, table: pd.DataFrame, tmp_path: Path) -> None:
    path = tmp_path / f"log{ending}"
    if ending == ".csv":
        table.to_csv(path, index=False)
    elif ending == ".parquet":
        table.to_parquet(path)
    else:
        scipy.io.savemat(path, {c: table[c].to_numpy()[:, None] for c in table})
    read = log.read_log(path, va12.machine)
    for sensor in va12.machine.sensors("full"):
        assert np.allclose(read.values[sensor.name], table[sensor.column], rtol=1e-15, atol=0)


def test_columns_have_the_names_of_the_machine_file(va12: Model, table: pd.DataFrame) -> None:
    renamed = tuple(
        s.model_copy(update={"column": "Druckmoment vorn"}) if s.name == "u1" else s for s in va12.machine.sensor
    )
    machine = va12.machine.model_copy(update={"sensor": renamed})
    read = log.from_table(table.rename(columns={"u1_Nm": "Druckmoment vorn"}), machine, ["u1"])
    assert np.array_equal(read.values["u1"], table["u1_Nm"])


def test_profile_goes_round(va12: Model, va12_motion: Motion, tmp_path: Path) -> None:
    path = tmp_path / "profile.csv"
    profile.profile_of(va12, va12_motion).to_csv(path, index=False)
    torque, q0, nu0 = profile.read_profile(path, va12)
    assert np.array_equal(torque, va12_motion.u)
    assert np.array_equal(q0, va12_motion.q[0])
    assert np.array_equal(nu0, va12_motion.nu[0])


def test_profile_has_the_contracts_columns(
    va12: Model, va12_motion: Motion, straight: Model, straight_motion: Motion
) -> None:
    assert (
        list(profile.profile_of(va12, va12_motion))
        == (
            "t_s u1_Nm u2_Nm u4_Nm x0_m y0_m theta0_rad theta1_rad theta2_rad theta4_rad v_m_s vy_m_s dtheta0_rad_s"
            " dtheta1_rad_s dtheta2_rad_s dtheta4_rad_s"
        ).split()
    )
    assert list(profile.profile_of(straight, straight_motion)) == (
        "t_s u1_Nm u4_Nm x0_m theta1_rad theta4_rad v_m_s dtheta1_rad_s dtheta4_rad_s".split()
    )


@pytest.mark.parametrize("name", MENDED)
def test_what_can_be_mended_is_read_with_a_note(name: str, table: pd.DataFrame, tmp_path: Path, va12: Model) -> None:
    make, words = MENDED[name]
    ready = prepare(va12, [make(table.copy(), tmp_path)])
    assert any(words in note for note in ready.notes), ready.notes
    assert all(np.isfinite(values).all() for one in ready.logs for values in one.values.values())
