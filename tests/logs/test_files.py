"""Log files that the formats' own libraries wrote, at one rate and at several: every reader gives what was logged."""

from __future__ import annotations

import datetime
import gzip
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from excite.errors import LogError
from excite.logs import files, tables

T = np.arange(200) / 100
ANGLE = np.sin(3 * T)
TORQUE = 40 * np.cos(3 * T[::4])  # every fourth sample, 1 ms later
T_TORQUE = T[::4] + 0.001
NANOSECONDS = 1_795_341_600_000_000_000
DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Encoder: 8 ECU
 SG_ Angle : 0|32@1- (0.000001,0) [-10|10] "rad" ECU
 SG_ Mode : 32|8@1+ (1,0) [0|255] "" ECU
BO_ 512 Motor: 8 ECU
 SG_ Torque : 7|16@0- (0.01,0) [-300|300] "N m" ECU
VAL_ 256 Mode 0 "off" 1 "on" ;
"""


def write_bag1(path: Path) -> Path:
    rosbags = pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed (extra ros)")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbags.Writer(path / "log.bag") as bag:
        _ros(bag, store, lambda m, name: store.serialize_ros1(m, name), ros1=True)
    return path / "log.bag"


def write_bag2(path: Path) -> Path:
    rosbags = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed (extra ros)")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with rosbags.Writer(path / "bag", version=8) as bag:
        _ros(bag, store, lambda m, name: bytes(store.serialize_cdr(m, name)), ros1=False)
    return path / "bag"


def _ros(bag, store, raw, ros1: bool) -> None:  # type: ignore[no-untyped-def]
    kinds = store.types
    joint, effort = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64"
    joints, efforts = (bag.add_connection(topic, kind, typestore=store) for topic, kind in TOPICS.items())
    said = [(t, joints, a) for t, a in zip(T, ANGLE, strict=True)]
    said += [(t, efforts, u) for t, u in zip(T_TORQUE, TORQUE, strict=True)]
    for t, connection, value in sorted(said, key=lambda one: one[0]):
        at = NANOSECONDS + round(1e9 * t)
        if connection is joints:
            stamp = kinds["builtin_interfaces/msg/Time"](
                sec=(at - 2_000_000) // 10**9, nanosec=(at - 2_000_000) % 10**9
            )
            head = {"seq": 0} if ros1 else {}
            header = kinds["std_msgs/msg/Header"](**head, stamp=stamp, frame_id="arm")
            message = kinds[joint](header, ["hip", "knee"], np.array([value, 2 * value]), np.array([]), np.array([]))
            bag.write(connection, at, raw(message, joint))
        else:
            bag.write(connection, at, raw(kinds[effort](value), effort))


TOPICS = {"/joint_states": "sensor_msgs/msg/JointState", "/motor/torque": "std_msgs/msg/Float64"}


def write_mcap(path: Path, compressed: bool = True) -> Path:
    mcap = pytest.importorskip("mcap.writer", reason="mcap is not installed (extra ros)")
    with (path / "log.mcap").open("wb") as file:
        kind = mcap.CompressionType.LZ4 if compressed else mcap.CompressionType.NONE
        writer = mcap.Writer(file, chunk_size=2000, compression=kind)
        writer.start()
        schema = writer.register_schema("Any", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/joint_states", "/motor/torque")]
        for t, a in zip(T, ANGLE, strict=True):
            at = NANOSECONDS + round(1e9 * t)
            data = json.dumps({"name": ["hip", "knee"], "position": [a, 2 * a]}).encode()
            writer.add_message(channels[0], at, data, at)
        for t, u in zip(T_TORQUE, TORQUE, strict=True):
            at = NANOSECONDS + round(1e9 * t)
            writer.add_message(channels[1], at, json.dumps({"data": u}).encode(), at)
        writer.finish()
    return path / "log.mcap"


def write_can(path: Path, suffix: str) -> Path:
    can = pytest.importorskip("can", reason="python-can is not installed (extra can)")
    cantools = pytest.importorskip("cantools", reason="cantools is not installed (extra can)")
    (path / "log.dbc").write_text(DBC)
    base = cantools.database.load_string(DBC, "dbc")
    frames = [(t, 256, base.encode_message(256, {"Angle": a, "Mode": 1})) for t, a in zip(T, ANGLE, strict=True)]
    frames += [(t, 512, base.encode_message(512, {"Torque": u})) for t, u in zip(T_TORQUE, TORQUE, strict=True)]
    frames += [(0.5, 700, b"unknown")]
    with can.Logger(str(path / f"log{suffix}")) as log:
        for t, name, data in sorted(frames):
            log(can.Message(timestamp=1e6 + t, arbitration_id=name, data=data, is_extended_id=False, channel=0))
    return path / f"log{suffix}"


def write_mdf(path: Path, version: str = "4.10", suffix: str = ".mf4") -> Path:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed (extra mdf)")
    with asammdf.MDF(version=version) as mdf:
        mdf.append([asammdf.Signal(ANGLE, 1000 + T, name="Angle", unit="rad")])
        counts = np.arange(50, dtype=np.uint16)
        mdf.append(
            [
                asammdf.Signal(TORQUE, 1000 + T_TORQUE, name="Torque", unit="N m"),
                asammdf.Signal(counts, 1000 + T_TORQUE, name="Counts"),
            ]
        )
        mdf.save(path / f"log{suffix}", overwrite=True)
    return path / f"log{suffix}"


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


def _frame() -> pd.DataFrame:
    return pd.DataFrame({"t_s": T, "theta1_rad": ANGLE, "u1_Nm": 40 * ANGLE})


@pytest.mark.parametrize("above", [0, 3])
def test_excel(above: int, tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed (extra xlsx)")
    with pd.ExcelWriter(tmp_path / "log.xlsx") as book:
        pd.DataFrame({"notes": ["a rig", "of May"]}).to_excel(book, sheet_name="notes", index=False)
        _frame().to_excel(book, sheet_name="log", startrow=above, index=False)
    if above:
        book = openpyxl.load_workbook(tmp_path / "log.xlsx")
        book["log"]["A1"] = "Logger 3"
        book.save(tmp_path / "log.xlsx")
    read = tables.read_table(tmp_path / "log.xlsx")
    pd.testing.assert_frame_equal(read, _frame(), rtol=1e-15)  # openpyxl writes 16 digits
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
    frame = _frame().assign(
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
    raw = gzip.compress(_frame().to_csv(index=False).encode())
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
    monkeypatch.setattr(files.text, "MOST_BYTES", 10_000)
    (tmp_path / "log.csv.gz").write_bytes(gzip.compress(b"a,b\n" + 100_000 * b"0,0\n"))
    with pytest.raises(LogError, match="unpacks to more than"):
        tables.read_table(tmp_path / "log.csv.gz")


def _seeds(folder: Path) -> list[Path]:
    """A file of each format, small."""
    made = []
    for name, write in {
        "bag1": write_bag1,
        "mcap": write_mcap,
        "blf": lambda p: write_can(p, ".blf"),
        "asc": lambda p: write_can(p, ".asc"),
        "mdf4": write_mdf,
        "mdf3": lambda p: write_mdf(p, "3.30", ".mdf"),
    }.items():
        (folder / name).mkdir()
        made.append(write(folder / name))
    (folder / "bag2").mkdir()
    made.append(next(write_bag2(folder / "bag2").glob("*.db3")))
    _frame().to_csv(folder / "log.csv", index=False)
    _frame().to_csv(folder / "log.tsv", index=False, sep="\t", decimal=",")
    np.savetxt(folder / "log.txt", _frame().to_numpy(), header="t_s theta1_rad u1_Nm")
    (folder / "log.csv.gz").write_bytes(gzip.compress(_frame().to_csv().encode()))
    _frame().to_parquet(folder / "log.parquet")
    _frame().to_excel(folder / "log.xlsx", index=False)
    scipy.io.savemat(folder / "log.mat", {"log": {"t": T, "q": ANGLE}}, do_compression=True)
    scipy.io.savemat(folder / "plain.mat", {"t": T, "q": ANGLE})
    import h5py

    with h5py.File(folder / "log.h5", "w") as file:
        file.create_dataset("log/q", data=ANGLE, chunks=(50,), compression="gzip")
        file["t"] = T
    return [*made, *(p for p in sorted(folder.iterdir()) if p.is_file())]


def _mutated(raw: bytes, rng: np.random.Generator) -> bytes:
    """A file with bytes changed, cut, repeated, moved, or numbers made huge."""
    data = bytearray(raw)
    for _ in range(int(rng.integers(1, 6))):
        n = len(data)
        if n < 16:
            break
        at = int(rng.integers(n)) if rng.random() < 0.5 else int(rng.integers(min(n, 600)))
        size = int(2 ** rng.uniform(0, 9))
        match int(rng.integers(8)):
            case 0 | 1:
                data[at] = int(rng.integers(256))
            case 2:
                data[at : at + size] = rng.bytes(size)
            case 3:
                del data[at : at + size]
            case 4:
                data[at:at] = data[at : at + size]
            case 5:
                del data[at + 1 :]
            case 6:
                huge = [
                    b"\xff" * 8,
                    b"\x7f\xff\xff\xff",
                    b"\xff\xff\xff\x7f",
                    b"\0" * 8,
                    b"9" * 12,
                    b"\0\0\0\0\1\0\0\0",
                ]
                put = huge[int(rng.integers(len(huge)))]
                data[at : at + len(put)] = put
            case _:
                data[at : at + size] = bytes(size)
    return bytes(data)


FUZZED = int(os.environ.get("EXCITE_FUZZED_FILES", "300"))  # mutated files of all formats together
SLOWEST = 20.0  # s for a file of 10 kB: anything longer hangs


def test_damaged_files_are_refused_in_one_line(tmp_path: Path) -> None:
    for library in ("rosbags", "mcap", "can", "cantools", "asammdf", "openpyxl", "h5py"):
        pytest.importorskip(library, reason=f"{library} is not installed")
    seeds = [(path, path.read_bytes()) for path in _seeds(tmp_path)]
    rng = np.random.default_rng(int(os.environ.get("EXCITE_FUZZ_SEED", "0")))
    for k in range(FUZZED):
        path, raw = seeds[k % len(seeds)]
        path.write_bytes(_mutated(raw, rng))
        begin = time.monotonic()
        try:
            table = tables.read_table(path)
        except LogError as err:
            table, line = pd.DataFrame(), str(err)
        else:
            line = str(path)
        assert isinstance(table, pd.DataFrame)
        assert "\n" not in line
        assert path.name in line or path.parent.name in line
        assert time.monotonic() - begin < SLOWEST, path.suffix
        path.write_bytes(raw)
