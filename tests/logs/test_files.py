"""Log files that the formats' own libraries wrote, at one rate and at several: every reader gives what was logged."""

from __future__ import annotations

import datetime
import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from support.log_files import (
    ANGLE,
    T_TORQUE,
    TORQUE,
    T,
    small_table,
    write_bag1,
    write_bag2,
    write_can,
    write_mcap,
    write_mdf,
)

from excite.errors import LogError
from excite.logs import tables
from excite.logs.files import text

MULTI_RATE: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "ROS 1": (write_bag1, "/joint_states/position[0]", "/motor/torque/data"),
    "ROS 2": (write_bag2, "/joint_states/position[0]", "/motor/torque/data"),
    "MCAP": (write_mcap, "/joint_states/position[0]", "/motor/torque/data"),
    "BLF": (lambda p: write_can(p, ".blf"), "Encoder.Angle", "Motor.Torque"),
    "ASC": (lambda p: write_can(p, ".asc"), "Encoder.Angle", "Motor.Torque"),
    "MDF 4": (write_mdf, "Angle", "Torque"),
    "MDF 3": (lambda p: write_mdf(p, "3.30", ".mdf"), "Angle", "Torque"),
}


@pytest.mark.parametrize("kind", MULTI_RATE)
def test_channels_keep_their_own_times(kind: str, tmp_path: Path) -> None:
    write, angle, torque = MULTI_RATE[kind]
    table = tables.read_table(write(tmp_path), [angle, torque])
    t = table["timestamps"].to_numpy()
    assert (np.diff(t) > 0).all()
    for name, at, values, step in ((angle, T, ANGLE, 1e-6), (torque, T_TORQUE, TORQUE, 1e-2)):
        there = table[name].notna().to_numpy()
        assert t[there] == pytest.approx(at, abs=2e-6)
        assert table[name].to_numpy()[there] == pytest.approx(values, abs=0.51 * step)
    assert len(table) == len(T) + len(T_TORQUE)


@pytest.mark.parametrize("kind", ["BLF", "ASC", "MDF 4", "MDF 3"])
def test_units_of_channels_are_kept(kind: str, tmp_path: Path) -> None:
    write, angle, torque = MULTI_RATE[kind]
    units = tables.read_table(write(tmp_path)).attrs["units"]
    assert (units[angle], units[torque]) == ("rad", "N m")


def test_integers_at_a_rate_of_their_own_are_not_stretched(tmp_path: Path) -> None:
    counts = tables.read_table(write_mdf(tmp_path))["Counts"]
    assert counts.dropna().tolist() == list(range(50))


@pytest.mark.parametrize("kind", ["ROS 1", "ROS 2", "MCAP"])
def test_joints_may_be_named(kind: str, tmp_path: Path) -> None:
    """As the message names them, in any case, without the first stroke."""
    table = tables.read_table(MULTI_RATE[kind][0](tmp_path))
    named = tables.with_names(table, ["/joint_states/position[knee]", "Joint_States/position[0]"])
    assert named["/joint_states/position[knee]"].dropna().to_numpy() == pytest.approx(2 * ANGLE)
    assert named["Joint_States/position[0]"].dropna().to_numpy() == pytest.approx(ANGLE)


@pytest.mark.parametrize("kind", ["ROS 1", "ROS 2"])
def test_stamps_of_headers_may_be_the_time(kind: str, tmp_path: Path) -> None:
    path = MULTI_RATE[kind][0](tmp_path)
    table = tables.read_table(path)
    stamps = table["/joint_states/header/stamp"].dropna().to_numpy()
    assert stamps == pytest.approx(T - 0.002, abs=1e-9)
    by_stamp = tables.read_table(path, ["header.stamp", "/joint_states/position[0]"])
    assert by_stamp["header.stamp"].to_numpy() == pytest.approx(T - 0.002, abs=1e-9)


def test_an_mcap_that_breaks_off_is_read_up_to_there(tmp_path: Path) -> None:
    path = write_mcap(tmp_path, compressed=False)
    path.write_bytes(path.read_bytes()[:9000])
    table = tables.read_table(path)
    assert 20 < len(table) < 200
    assert "breaks off" in table.attrs["notes"][0]


def test_a_can_log_without_dbc_says_so(tmp_path: Path) -> None:
    path = write_can(tmp_path, ".asc")
    (tmp_path / "log.dbc").rename(tmp_path / "machine.dbc")
    assert "Motor.Torque" in tables.read_table(path)  # of another stem, in the same folder
    (tmp_path / "machine.dbc").unlink()
    with pytest.raises(LogError, match=r"needs the DBC file .* beside the log as log\.dbc"):
        tables.read_table(path)


@pytest.mark.parametrize("above", [0, 3])
def test_excel(above: int, tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed (extra xlsx)")
    with pd.ExcelWriter(tmp_path / "log.xlsx") as book:
        pd.DataFrame({"notes": ["a rig", "of May"]}).to_excel(book, sheet_name="notes", index=False)
        small_table().to_excel(book, sheet_name="log", startrow=above, index=False)
    if above:
        book = openpyxl.load_workbook(tmp_path / "log.xlsx")
        book["log"]["A1"] = "Logger 3"
        book.save(tmp_path / "log.xlsx")
    read = tables.read_table(tmp_path / "log.xlsx")
    pd.testing.assert_frame_equal(read, small_table(), rtol=1e-15)  # openpyxl writes 16 digits
    assert read.attrs["notes"] == ["read from sheet log"]


def test_excel_dates_and_clocks_are_times(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed (extra xlsx)")
    start = datetime.datetime(2026, 11, 22, 10)
    dates = [start + datetime.timedelta(milliseconds=10 * k) for k in range(50)]
    book = openpyxl.Workbook()
    for row in [("when", "clock", "u"), *((d, d.time(), k) for k, d in enumerate(dates))]:
        book.active.append(row)
    book.save(tmp_path / "log.xlsx")
    read = tables.read_table(tmp_path / "log.xlsx")
    for name in ("when", "clock"):
        assert (read[name] - read[name].iloc[0]).dt.total_seconds().to_numpy() == pytest.approx(T[:50], abs=1e-6)


def test_matlab_structs_and_matrices(tmp_path: Path) -> None:
    struct = {"t": T, "theta1": ANGLE, "q": np.column_stack([ANGLE, 2 * ANGLE]), "gains": [1.0, 2, 3]}
    scipy.io.savemat(tmp_path / "log.mat", {"log": struct, "note": "text"})
    read = tables.read_table(tmp_path / "log.mat")
    assert read["log.t"].tolist() == T.tolist()
    assert read["log.q(:,2)"].tolist() == (2 * ANGLE).tolist()
    assert "log.gains" in read.attrs["notes"][0]


def test_matlab_time_series_keep_their_times(tmp_path: Path) -> None:
    scipy.io.savemat(
        tmp_path / "log.mat",
        {"theta1": {"Time": T, "Data": ANGLE}, "u1": {"Time": T_TORQUE, "Data": TORQUE}, "gear": [1.0, 2, 3]},
    )
    read = tables.with_names(tables.read_table(tmp_path / "log.mat", ["theta1", "u1"]), ["theta1", "u1"])
    assert read["theta1"].dropna().tolist() == ANGLE.tolist()
    assert read["timestamps"][read["u1"].notna()].tolist() == T_TORQUE.tolist()


def test_matlab_wanted_variables_say_which_length(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "log.mat", {"t": T, "u": ANGLE, "a": TORQUE, "b": TORQUE, "c": TORQUE})
    assert set(tables.read_table(tmp_path / "log.mat")) == {"a", "b", "c"}
    assert set(tables.read_table(tmp_path / "log.mat", ["t", "u"])) == {"t", "u"}


def test_matlab_v73_and_hdf5(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (extra hdf5)")
    with h5py.File(tmp_path / "log.mat", "w", userblock_size=512) as file:
        for name, values in (("t_s", T), ("log/theta1", ANGLE)):
            made = file.create_dataset(name, data=values[None, :], compression="gzip")
            made.attrs["MATLAB_class"] = np.bytes_(b"double")
        word = file.create_dataset("note", data=np.arange(200, dtype=np.uint16)[:, None])
        word.attrs["MATLAB_class"] = np.bytes_(b"char")
        file["log"].attrs["MATLAB_class"] = np.bytes_(b"struct")
        file["log/itself"] = file["log"]
    read = tables.read_table(tmp_path / "log.mat")
    assert set(read) == {"t_s", "log.theta1"}
    assert read["log.theta1"].tolist() == ANGLE.tolist()
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["arm/t"] = T
        file["arm/q"] = np.array(list(zip(ANGLE, T, strict=True)), dtype=[("q1", "f8"), ("q2", "f4")])
    assert set(tables.read_table(tmp_path / "log.h5")) == {"arm/t", "arm/q/q1", "arm/q/q2"}


def test_parquet_index_nested_and_categorical(tmp_path: Path) -> None:
    frame = small_table().assign(
        mode=pd.Categorical(["on", "off"] * 100),
        gear=pd.Categorical([1, 2] * 100),
        imu=[{"gyro": {"z": a}, "ok": True} for a in ANGLE],
        q=[[a, 2 * a] for a in ANGLE],
        count=pd.array([None, *range(199)], dtype="Int64"),
    )
    frame.set_index("t_s").to_parquet(tmp_path / "log.parquet")
    read = tables.read_table(tmp_path / "log.parquet")
    assert read["t_s"].tolist() == T.tolist()
    assert read["imu.gyro.z"].tolist() == ANGLE.tolist()
    assert read["q[1]"].tolist() == (2 * ANGLE).tolist()
    assert read["gear"].tolist() == [1, 2] * 100
    assert read["count"].dtype == float
    assert np.isnan(read["count"].iloc[0])


TEXTS: dict[str, tuple[str, str]] = {
    "savetxt": ("# t_s u1 u2\n0.0 1.5 2\n0.1 2.5 3\n", "comment"),
    "savetxt with commas": ("# rig 3\n# t_s,u1,u2\n0.0,1.5,2\n0.1,2.5,3\n", "comment"),
    "blanks": ("  t_s   u1  u2\n 0.0  1.5   2\n 0.1  2.5   3\n", ""),
    "blanks and decimal commas": ("t_s u1 u2\n0,0 1,5 2\n0,1 2,5 3\n", ""),
    "metadata": ("Logger 3\nRows,2\nDate,2024-05-03,10:00\n\nt_s,u1,u2\ns,N,N\n0.0,1.5,2\n0.1,2.5,3\n", ""),
    "metadata as wide": ("Rig,3,A\nRate,100,Hz\nt_s,u1,u2\n0.0,1.5,2\n0.1,2.5,3\n", ""),
    "three lines of header": ("t_s,u1,u2\nTime,Force left,Force right\ns,N,N\n0.0,1.5,2\n0.1,2.5,3\n", ""),
    "zeros at the end": ("t_s,u1,u2\n0.0,1.5,2\n0.1,2.5,3\n" + 100 * "\0", "zero bytes after line 3"),
    "cut row": ("t_s,u1,u2\n0.0,1.5,2\n0.1,2.5,3\n0.2,3.", "line 4 is cut short"),
    "cut number": ("t_s,u1,u2\n0.0,1.5,2\n0.1,2.5,3\n0.2,3.5,-", "line 4 is cut short"),
}


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("packed", [False, True])
def test_text_with_other_things_around_the_table(name: str, packed: bool, tmp_path: Path) -> None:
    text, note = TEXTS[name]
    path = tmp_path / ("log.csv.gz" if packed else "log.csv")
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    read = tables.read_table(path)
    assert {n: read[n].tolist() for n in read} == {"t_s": [0.0, 0.1], "u1": [1.5, 2.5], "u2": [2, 3]}
    assert note in " ".join(read.attrs["notes"])


def test_a_date_and_a_clock_between_blanks_are_one(tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text("when u1\n2024-05-03 10:00:00.00 1.5\n2024-05-03 10:00:00.01 2.5\n")
    read = tables.read_table(tmp_path / "log.txt")
    assert read["when"].tolist() == ["2024-05-03T10:00:00.00", "2024-05-03T10:00:00.01"]


def test_a_blank_cell_between_blanks_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text("t_s u1 u2\n0.0 1.5 2\n0.1     3\n0.2 3.5 4\n")
    with pytest.raises(LogError, match="row 2: has 2 cells of 3"):
        tables.read_table(tmp_path / "log.txt")


def test_names_may_differ_in_case_blanks_and_units(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("Time [s], Theta1_RAD ,u1 (N m)\n0,1,2\n1,2,3\n")
    read = tables.with_names(tables.read_table(tmp_path / "log.csv"), ["time", "theta1_rad", "u1"])
    assert list(read) == ["time", "theta1_rad", "u1"]


def test_a_gzip_that_breaks_off_is_read_up_to_there(tmp_path: Path) -> None:
    raw = gzip.compress(small_table().to_csv(index=False).encode())
    (tmp_path / "log.csv.gz").write_bytes(raw[: len(raw) // 2])
    read = tables.read_table(tmp_path / "log.csv.gz")
    assert 50 < len(read) < 150
    assert "breaks off" in read.attrs["notes"][0]


def test_files_that_claim_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (extra hdf5)")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file.create_dataset("t", shape=(10**12,), dtype="f8", chunks=(1000,))  # nothing stored
    with pytest.raises(LogError, match="far more than the file can hold"):
        tables.read_table(tmp_path / "log.h5")
    monkeypatch.setattr(text, "UNASKED_BYTES", 10_000)
    (tmp_path / "log.csv.gz").write_bytes(gzip.compress(b"a,b\n" + 100_000 * b"0,0\n"))
    with pytest.raises(LogError, match="unpacks to more than"):
        tables.read_table(tmp_path / "log.csv.gz")
