"""Log files of every format, written by the formats' own libraries."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from support.drives import drive

from excite.model import prediction
from excite.model.machine import load_machine
from excite.simulation import sensors, simulate

T = np.arange(200) / 100
ANGLE = np.sin(3 * T)
TORQUE = 40 * np.cos(3 * T[::4])  # every fourth sample, 1 ms later
T_TORQUE = T[::4] + 0.001
U = 40 * np.cos(3 * T)
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


def write_candump(path: Path, style: str = "-l", head: str = "") -> Path:
    """Frames as candump writes them: its log file, frames of CAN FD, or what it shows with times, below a head."""
    cantools = pytest.importorskip("cantools", reason="cantools is not installed (extra can)")
    base = cantools.database.load_string(DBC, "dbc")
    frames = [(t, 256, base.encode_message(256, {"Angle": a, "Mode": 1})) for t, a in zip(T, ANGLE, strict=True)]
    frames += [(t, 512, base.encode_message(512, {"Torque": u})) for t, u in zip(T_TORQUE, TORQUE, strict=True)]
    frames += [(0.5, 0x7FF, b"unknown")]
    lines, before = [], 0.0
    for t, name, data in sorted(frames):
        between = "##1" if style == "FD" else "#"
        day = pd.Timestamp("2026-03-04 23:59:59") + pd.Timedelta(seconds=t)
        at = {"A": f"{day:%Y-%m-%d %H:%M:%S.%f}", "d": f"{t - before:010.6f}"}.get(style[3:4], f"{1e9 + t:.6f}")
        before = t
        cells = [f"{byte:08b}" if style.endswith("-i") else f"{byte:02X}" for byte in data]
        shown = "`".join(reversed(cells)) if style.endswith("-S") else " ".join(cells)
        where = "RX - -  " if style.endswith("-x") else ""
        dumped = f"{name:03X}{between}{data.hex().upper()}"
        line = f" can0  {where}{name:03X}   [{len(data)}]  {shown}" if style.startswith("-t") else f"can0 {dumped}"
        lines.append(f"({at}) {line}")
    path.write_text(
        "\n".join([head, *lines, *([] if style.startswith("-t") else [f"({1e9 + 2:.6f}) can0 100#R"])]) + "\n"
    )
    return path


def write_lvm(
    path: Path,
    x: str,
    comma: str = ".",
    separator: str = "Tab",
    segments: int = 1,
    comments: bool = False,
    comma_said: bool = True,
) -> Path:
    """A LabVIEW measurement file: x, its X_Columns; in so many segments, with a heading each if there are several."""
    s = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}[separator]
    lines = ["LabVIEW Measurement", f"Writer_Version{s}2", f"Separator{s}{separator}"]
    lines += [f"Decimal_Separator{s}{comma}"] if comma_said else []
    lines += [f"Multi_Headings{s}{'Yes' if segments > 1 else 'No'}", f"X_Columns{s}{x}", "***End_of_Header***", ""]
    for part in np.array_split(np.arange(len(T)), segments):
        late = T[part[0]]
        lines += [f"Channels{s}2", f"Samples{s}{len(part)}{s}{len(part)}", s.join(["Date", *["2026/03/04"] * 2])]
        lines += [s.join(["Time", *[f"10:11:{12 + late:.7f}"] * 2]), s.join(["Y_Unit_Label", "rad", "N m"])]
        lines += [s.join(["X_Dimension", "Time", "Time"]), s.join(["X0", "0.0E+0", "0.0E+0"])]
        lines += [s.join(["Delta_X", "0.010000", "0.010000"]), s.join(["***End_of_Header***", "", ""])]
        head = {"One": ["X_Value", "Angle", "Torque"], "Multi": ["X_Value", "Angle", "X_Value", "Torque"]}
        lines += [s.join([*head.get(x, ["X_Value", "Angle", "Torque"]), "Comment"])]
        for k in part:
            t, a, u = f"{T[k] - late:.6f}", f"{ANGLE[k]:.9f}", f"{U[k]:.9f}"
            cells = {"One": [t, a, u], "Multi": [t, a, t, u], "No": ["", a, u]}[x]
            lines.append(s.join(cells).replace(".", comma) + (f"{s}operator, tab" if comments and k == part[0] else ""))
        lines.append("")
    path.write_text("\r\n".join(lines))
    return path


def write_scope(path: Path, separator: str = "\t", comma: str = ".", filetime: bool = False, offset: int = 0) -> Path:
    """An export of TwinCAT Scope: the angle every 10 ms, the torque every 40 ms and 1 ms later."""
    s = separator
    lines = ["Name" + s + "Scope Project", f"Starttime of export{s}133500000000000000{s}2026-03-04 10:11:12.000", ""]
    block = [("Name", "Axis.Pos", "Axis.Torque"), ("SymbolComment", "", ""), ("Data-Type", "REAL64", "REAL64")]
    block += [("SampleTime[ms]", "10", "10"), ("SymbolBased", "True", "True"), ("Unit", "rad", "Nm")]
    block += [("Offset", "0", str(offset))]
    lines += [s.join((key, a, key, b)) for key, a, b in block]
    lines.append("")
    for k in range(len(T)):
        ms = [133500000000000000 + 1e7 * t if filetime else 1e3 * t for t in (T[k], T_TORQUE[min(k, 49)])]
        at = [f"{m:.0f}" if filetime else f"{m:g}" for m in ms]
        pair = (at[1], f"{TORQUE[k]:.9g}") if k < len(TORQUE) else ("", "")
        lines.append(s.join((at[0], f"{ANGLE[k]:.9g}", *pair)).replace(".", comma))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_tdms(path: Path, waveforms: bool = True) -> Path:
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed (extra tdms)")
    start = np.datetime64("2026-03-04T10:11:12", "us")

    def wave(first: float, step: float) -> dict[str, object]:
        return {"wf_start_time": start, "wf_start_offset": first, "wf_increment": step, "unit_string": "rad"}

    channels = [
        nptdms.ChannelObject("rig", "angle", ANGLE, wave(0.0, 0.01) if waveforms else {}),
        nptdms.ChannelObject("motor", "torque", TORQUE, wave(0.001, 0.04) if waveforms else {}),
    ]
    channels += [] if waveforms else [nptdms.ChannelObject("rig", "time", T)]
    with nptdms.TdmsWriter(path / "log.tdms") as file:
        file.write_segment(channels)
    return path / "log.tdms"


def write_ulog(path: Path, instances: int = 1) -> Path:
    pytest.importorskip("pyulog", reason="pyulog is not installed (extra ulog)")

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    raw = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 5_000_000)
    raw += message(b"B", bytes(40))
    raw += message(b"F", b"rig:uint64_t timestamp;float angle;") + message(
        b"F", b"motor:uint64_t timestamp;double torque;"
    )
    raw += b"".join(message(b"A", struct.pack("<BH", k, k) + b"rig") for k in range(instances))
    raw += message(b"A", struct.pack("<BH", 0, 9) + b"motor")
    data = [
        (t, struct.pack("<HQf", k, 5_000_000 + round(1e6 * t), a))
        for k in range(instances)
        for t, a in zip(T, ANGLE, strict=True)
    ]
    data += [(t, struct.pack("<HQd", 9, 5_000_000 + round(1e6 * t), u)) for t, u in zip(T_TORQUE, TORQUE, strict=True)]
    raw += b"".join(message(b"D", body) for _, body in sorted(data))
    (path / "log.ulg").write_bytes(raw)
    return path / "log.ulg"


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


def small_table() -> pd.DataFrame:
    return pd.DataFrame({"t_s": T, "theta1_rad": ANGLE, "u1_Nm": 40 * ANGLE})


def a_file_of_each_format(folder: Path) -> dict[str, Path]:
    """A file of each format, small, by the format's name."""

    made: dict[str, Path] = {}
    for name, write in {
        "ROS 1": write_bag1,
        "MCAP": write_mcap,
        "MCAP unpacked": lambda p: write_mcap(p, compressed=False),
        "BLF": lambda p: write_can(p, ".blf"),
        "ASC": lambda p: write_can(p, ".asc"),
        "LabVIEW": lambda p: write_lvm(p / "log.lvm", "Multi", segments=2),
        "TwinCAT Scope": lambda p: write_scope(p / "log.csv"),
        "TDMS": write_tdms,
        "TDMS without waveforms": lambda p: write_tdms(p, waveforms=False),
        "ULog": write_ulog,
        "MDF 4": write_mdf,
        "MDF 3": lambda p: write_mdf(p, "3.30", ".mdf"),
    }.items():
        (folder / name).mkdir()
        made[name] = write(folder / name)
    (folder / "candump").mkdir()
    write_can(folder / "candump", ".asc")
    made["candump"] = write_candump(folder / "candump" / "log.log")
    made["DBC"] = made["ASC"].with_suffix(".dbc")
    (folder / "ROS 2").mkdir()
    bag = write_bag2(folder / "ROS 2")
    made |= {"ROS 2": next(bag.glob("*.db3")), "metadata": bag / "metadata.yaml"}
    for name, suffix in TABLES.items():
        made[name] = write_table(small_table(), folder / f"{name.replace(' ', '')}{suffix}")
    return made | _files_with_more_in_them(folder)


def _files_with_more_in_them(folder: Path) -> dict[str, Path]:
    """Files of the formats' rarer parts: packed blocks, text, dates, structs, lists, blank cells."""
    import asammdf
    import h5py
    import scipy.sparse
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    made = {
        "Parquet plain": folder / "plain.parquet",
        "Parquet nested": folder / "nested.parquet",
        "Excel mixed": folder / "mixed.xlsx",
        "MATLAB packed": folder / "struct.mat",
        "MATLAB mixed": folder / "mixed.mat",
        "MATLAB 4": folder / "old.mat",
        "HDF5 packed": folder / "chunks.h5",
        "HDF5 mixed": folder / "mixed.h5",
        "MDF 4 packed": folder / "packed.mf4",
        "ROS 1 packed": folder / "packed.bag",
        "text mixed": folder / "mixed.csv",
    }
    small_table().to_parquet(made["Parquet plain"], compression=None, index=False)
    dates = pd.date_range("2026-11-22", periods=len(T), freq="10ms")
    mixed = small_table().assign(when=dates, word="on", flag=T > 1, gap=np.where(T < 1, T, np.nan))
    mixed.assign(clock=dates.time).to_excel(made["Excel mixed"], index=False, startrow=2)
    lists = mixed.assign(
        imu=[{"gyro": {"z": a}, "ok": True} for a in ANGLE],
        q=[[a, 2 * a] for a in ANGLE],
        mode=pd.Categorical(["on", "off"] * 100),
        count=pd.array([None, *range(199)], dtype="Int64"),
    )
    lists.set_index("t_s").to_parquet(made["Parquet nested"], compression="gzip")
    mixed.to_csv(made["text mixed"], index=False, sep=";", decimal=",", date_format="%d.%m.%Y %H:%M:%S.%f")
    scipy.io.savemat(made["MATLAB packed"], {"log": {"t": T, "q": ANGLE}, "u": TORQUE}, do_compression=True)
    cell = np.array([{"Time": T, "Data": ANGLE}, "word"], dtype=object)
    parts = {"z": T * 1j, "sparse": scipy.sparse.csc_matrix(np.diag(T[:20])), "flag": T > 1, "n": np.arange(200)}
    structs = np.array([(T, "left"), (ANGLE, "right")], dtype=[("values", object), ("label", object)])
    scipy.io.savemat(made["MATLAB mixed"], parts | {"cell": cell, "signals": structs, "q": np.outer(T, [1.0, 2])})
    scipy.io.savemat(made["MATLAB 4"], {"t": T, "q": ANGLE}, format="4")
    with h5py.File(made["HDF5 packed"], "w") as file:
        file.create_dataset("log/q", data=ANGLE, chunks=(50,), compression="gzip")
        file["t"] = T
    with h5py.File(made["HDF5 mixed"], "w", libver="latest") as file:
        file["arm/q"] = np.array(list(zip(ANGLE, T, strict=True)), dtype=[("q1", "f8"), ("q2", ">f4")])
        file["arm/word"] = np.array(["on"] * 200, dtype=h5py.string_dtype())
        file["arm/t"] = h5py.SoftLink("/t")
        file.create_dataset("t", data=T, chunks=(64,), maxshape=(None,), shuffle=True, fletcher32=True)
        file["t"].attrs["unit"] = "s"
    with asammdf.MDF(write_mdf(folder)) as mdf:
        mdf.save(made["MDF 4 packed"], overwrite=True, compression=2)
    store = get_typestore(Stores.ROS1_NOETIC)
    packed = Writer1(made["ROS 1 packed"])
    packed.set_compression(Writer1.CompressionFormat.BZ2)
    with packed as bag:
        _ros(bag, store, lambda m, name: store.serialize_ros1(m, name), ros1=True)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(folder / "mcap", version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        _ros(bag, store, lambda m, name: bytes(store.serialize_cdr(m, name)), ros1=False)
    return made | {"ROS 2 MCAP": next((folder / "mcap").glob("*.mcap"))}


TABLES = {
    "CSV": ".csv",
    "TSV": ".tsv",
    "TXT": ".txt",
    "gzip": ".csv.gz",
    "Parquet": ".parquet",
    "Excel": ".xlsx",
    "MATLAB": ".mat",
    "HDF5": ".h5",
    "MATLAB 7.3": ".mat",
}


def write_table(table: pd.DataFrame, path: Path) -> Path:
    """Write a table of numbers in the format of a file's name."""
    columns = {name: table[name].to_numpy() for name in table}
    if path.name.endswith(".gz"):
        path.write_bytes(gzip.compress(table.to_csv(index=False).encode(), mtime=0))
    elif path.suffix == ".csv":
        table.to_csv(path, index=False)
    elif path.suffix == ".tsv":
        table.to_csv(path, index=False, sep="\t", decimal=",")
    elif path.suffix == ".txt":
        np.savetxt(path, table.to_numpy(), header=" ".join(table))
    elif path.suffix == ".parquet":
        table.to_parquet(path)
    elif path.suffix == ".xlsx":
        table.to_excel(path, index=False)
    elif path.suffix == ".mat" and "7.3" not in path.name:
        scipy.io.savemat(path, columns)
    else:
        import h5py

        with h5py.File(path, "w", userblock_size=512 if path.suffix == ".mat" else 0) as file:
            for name, values in columns.items():
                file[name] = values[None, :] if path.suffix == ".mat" else values
                if path.suffix == ".mat":
                    file[name].attrs["MATLAB_class"] = np.bytes_(b"double")
    return path


def logs_of(machine: str, folder: Path, seconds: float = 20.0) -> dict[str, Path]:
    """A log of a machine in every format of tables, by the format's name."""
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed (extra mdf)")
    model = prediction.build(load_machine(machine))
    torque = drive(model, seconds, 0, dict.fromkeys(model.inputs, 1200.0))
    table = sensors.measure(model, simulate(model, torque), seed=2)
    made = {name: write_table(table, folder / f"{name.replace(' ', '')}{suffix}") for name, suffix in TABLES.items()}
    time = model.machine.time_column
    with asammdf.MDF(version="4.10") as mdf:
        t = table[time].to_numpy()
        mdf.append([asammdf.Signal(table[n].to_numpy(), t, name=n) for n in table if n != time])
        mdf.save(folder / "MDF4.mf4", overwrite=True)
    return made | {"MDF 4": folder / "MDF4.mf4"}
