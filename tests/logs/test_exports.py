"""Exports of measuring programs (LabVIEW, TwinCAT Scope, candump, TDMS, ULog): the numbers are what was logged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.log_files import (
    ANGLE,
    T_TORQUE,
    TORQUE,
    T,
    U,
    write_can,
    write_candump,
    write_lvm,
    write_scope,
    write_tdms,
    write_ulog,
)

from excite.errors import LogError
from excite.logs import FORMATS, read_table
from excite.logs.files.layout import known_unit


@pytest.mark.parametrize("name", ["log.lvm", "log.txt"])
@pytest.mark.parametrize("x", ["One", "Multi", "No"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"comma": ","},
        {"comma": ",", "comma_said": False},
        {"separator": "Semicolon", "comma": ","},
        {"separator": "Comma"},
        {"separator": "Comma", "comma_said": False},
        {"segments": 3},
    ],
    ids=["tabs", "decimal comma", "comma unsaid", "semicolons", "commas", "point unsaid", "segments"],
)
def test_labview_measurement_files(name: str, x: str, options: dict[str, object], tmp_path: Path) -> None:
    table = read_table(write_lvm(tmp_path / name, x, **options))  # type: ignore[arg-type]
    clock = table["X_Value" if "X_Value" in table else "timestamps"].to_numpy()
    assert clock == pytest.approx(T, abs=1e-6)
    assert table["Angle"].to_numpy() == pytest.approx(ANGLE, abs=1e-8)
    assert table["Torque"].to_numpy() == pytest.approx(U, abs=1e-8)
    assert table.attrs["units"] == {"Angle": "rad", "Torque": "N m"}


def test_labview_files_without_x_may_leave_its_name_blank_and_write_units_in_words(tmp_path: Path) -> None:
    file = write_lvm(tmp_path / "log.lvm", "No")
    text = file.read_text().replace("X_Value\tAngle", "\tAngle").replace("\trad\tN m", "\tRadians\tVolts")
    file.write_text(text)
    table = read_table(file)
    assert table["timestamps"].to_numpy() == pytest.approx(T, abs=1e-6)
    assert table["Torque"].to_numpy() == pytest.approx(U, abs=1e-8)
    assert [known_unit(u) for u in table.attrs["units"].values()] == ["rad", "V"]


def test_labview_comments_are_no_numbers(tmp_path: Path) -> None:
    table = read_table(write_lvm(tmp_path / "log.lvm", "One", comments=True))
    assert table["Torque"].to_numpy() == pytest.approx(U, abs=1e-8)


@pytest.mark.parametrize("suffix", [".csv", ".txt"])
@pytest.mark.parametrize(
    "options", [{}, {"separator": ";", "comma": ","}, {"separator": ","}, {"comma": ","}, {"filetime": True}]
)
def test_twincat_scope(suffix: str, options: dict[str, object], tmp_path: Path) -> None:
    table = read_table(write_scope(tmp_path / f"log{suffix}", **options))  # type: ignore[arg-type]
    for name, at, values in (("Axis.Pos", T, ANGLE), ("Axis.Torque", T_TORQUE, TORQUE)):
        there = table[name].notna().to_numpy()
        assert table["timestamps"].to_numpy()[there] == pytest.approx(at, abs=2e-3 if "filetime" in options else 1e-9)
        assert table[name].to_numpy()[there] == pytest.approx(values, rel=1e-8)
    assert table.attrs["units"] == {"Axis.Pos": "rad", "Axis.Torque": "Nm"}


def test_what_the_scope_adds_is_said(tmp_path: Path) -> None:
    assert "offset of Axis.Torque 2" in read_table(write_scope(tmp_path / "log.csv", offset=2)).attrs["notes"][0]


@pytest.mark.parametrize("head", ["", "recorded on the rig\n(1.5) can0 10"], ids=["", "torn"])
@pytest.mark.parametrize("style", ["-l", "FD", "-t a", "-t a -x", "-t A", "-t d", "-t a -i", "-t a -S"])
def test_candump(style: str, head: str, tmp_path: Path) -> None:
    """Times absolute, with dates, or since the frame before (-t d); bytes in hex, as bits (-i) or reversed (-S)."""
    write_can(tmp_path, ".asc")  # with its DBC
    table = read_table(write_candump(tmp_path / "log.log", style, head), ["Encoder.Angle", "Motor.Torque"])
    for name, at, values, step in (("Encoder.Angle", T, ANGLE, 1e-6), ("Motor.Torque", T_TORQUE, TORQUE, 1e-2)):
        there = table[name].notna().to_numpy()
        assert table["timestamps"].to_numpy()[there] == pytest.approx(at, abs=2e-6)
        assert table[name].to_numpy()[there] == pytest.approx(values, abs=0.51 * step)


def test_candump_without_times_says_how_to_record_them(tmp_path: Path) -> None:
    write_can(tmp_path, ".asc")
    (tmp_path / "log.log").write_text("  can0  100   [8]  00 00 00 00 00 00 00 00\n")
    with pytest.raises(LogError, match="without times: record with `candump -l`"):
        read_table(tmp_path / "log.log")


def test_frames_with_fewer_bytes_than_they_say_are_left_out(tmp_path: Path) -> None:
    write_can(tmp_path, ".asc")
    path = write_candump(tmp_path / "log.log", "-t a")
    path.write_text(path.read_text().replace("[8]  00 00 00 00 01", "[8]  00 00 00 01", 1))
    table = read_table(path, ["Encoder.Angle"])
    assert len(table) == len(T) - 1
    assert "1 line is no frame" in table.attrs["notes"][0]


def test_a_log_of_text_may_end_in_log(tmp_path: Path) -> None:
    (tmp_path / "rig.log").write_text("t_s,u\n" + "".join(f"{k / 100},{k}\n" for k in range(20)))
    assert read_table(tmp_path / "rig.log")["u"].tolist() == list(range(20))


@pytest.mark.parametrize("write", [write_tdms, write_ulog], ids=["tdms", "ulog"])
def test_channels_at_times_of_their_own(write: Callable[[Path], Path], tmp_path: Path) -> None:
    table = read_table(write(tmp_path))
    for name, at, values in (("rig/angle", T, ANGLE), ("motor/torque", T_TORQUE, TORQUE)):
        there = table[name].notna().to_numpy()
        assert table["timestamps"].to_numpy()[there] == pytest.approx(at, abs=2e-6)
        assert table[name].to_numpy()[there] == pytest.approx(values, rel=1e-6, abs=1e-7)


def test_tdms_channels_beside_a_channel_of_times(tmp_path: Path) -> None:
    table = read_table(write_tdms(tmp_path, waveforms=False))
    assert table["rig/time"].to_numpy() == pytest.approx(T)
    assert table["rig/angle"].to_numpy() == pytest.approx(ANGLE)


def test_a_second_instance_of_a_topic_has_a_name_of_its_own(tmp_path: Path) -> None:
    table = read_table(write_ulog(tmp_path, instances=2), ["rig/angle", "rig.1/angle"])
    assert "motor/torque" not in table
    assert table["rig.1/angle"].dropna().to_numpy() == pytest.approx(ANGLE, abs=1e-7)


def test_a_repeated_header_is_left_out(tmp_path: Path) -> None:
    rows = [f"{k / 100},{k}\n" for k in range(40)]
    (tmp_path / "log.csv").write_text("t_s,u\ns,N\n" + "".join(rows[:20]) + "t_s,u\ns,N\n" + "".join(rows[20:]))
    table = read_table(tmp_path / "log.csv")
    assert table["u"].tolist() == list(range(40))
    assert "the header comes again 1 times" in table.attrs["notes"][0]


@pytest.mark.parametrize("suffix", [".csv", ".xlsx"])
def test_columns_of_one_name_are_named_by_position(suffix: str, tmp_path: Path) -> None:
    table = pd.DataFrame(np.outer(np.arange(30), [1, 10, 100]), columns=["t", "u", "u"])
    path = tmp_path / f"log{suffix}"
    table.to_csv(path, index=False) if suffix == ".csv" else table.to_excel(path, index=False)
    read = read_table(path)
    assert read["u"].tolist() == (10 * np.arange(30)).tolist()
    assert read["u.1"].tolist() == (100 * np.arange(30)).tolist()
    assert "column u is there 2 times; by position: u, u.1" in " ".join(read.attrs["notes"])


@pytest.mark.parametrize("form", ['"[{a}, {b}]"', "[{a} {b}]", '"({a}, {b})"', '"array([{a}, {b}])"', "{{{a};{b}}}"])
def test_a_vector_in_a_cell_becomes_columns(form: str, tmp_path: Path) -> None:
    rows = [f"{t}," + form.format(a=a, b=2 * a) + "\n" for t, a in zip(T, ANGLE, strict=True)]
    (tmp_path / "log.csv").write_text("t_s,q\n" + "".join(rows))
    table = read_table(tmp_path / "log.csv")
    assert table["q[0]"].to_numpy() == pytest.approx(ANGLE)
    assert table["q[1]"].to_numpy() == pytest.approx(2 * ANGLE)


@pytest.mark.parametrize("form", ["[{a} {b}]", "[{a}; {b}]", "({a}, {b})", "{{{a};{b}}}"])
@pytest.mark.parametrize("clock", ["0,01", "1"])
def test_a_vector_in_a_cell_may_have_decimal_commas(clock: str, form: str, tmp_path: Path) -> None:
    if clock == "1" and " " not in form.replace("; ", "").replace(", ", ""):
        pytest.skip("[1,2;3,4] is a matrix where nothing else has a decimal comma")
    step = float(clock.replace(",", "."))
    rows = [f"{k * step:g}\t" + form.format(a=f"{a:.6f}", b=f"{-2 * a:.6f}") + "\n" for k, a in enumerate(ANGLE)]
    (tmp_path / "log.txt").write_text("t\tq\n" + "".join(rows).replace(".", ","))
    table = read_table(tmp_path / "log.txt")
    assert list(table.columns) == ["t", "q[0]", "q[1]"]
    assert table["q[0]"].to_numpy() == pytest.approx(ANGLE, abs=1e-6)
    assert table["q[1]"].to_numpy() == pytest.approx(-2 * ANGLE, abs=1e-6)


@pytest.mark.parametrize("cell", ["[1,2,3]", "[1, 2, 3]", "[1;2;3]", "[1 2 3]"])
def test_whole_numbers_in_a_cell_are_parted_at_commas(cell: str, tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text("t\tq\n" + "".join(f"{k / 100:g}\t{cell}\n".replace(".", ",") for k in range(30)))
    assert read_table(tmp_path / "log.txt").iloc[5, 1:].tolist() == [1, 2, 3]


def test_every_format_has_a_reader_and_an_ending_of_its_own() -> None:
    from excite.logs.files import reader_of

    suffixes = [suffix for form in FORMATS for suffix in form.suffixes]
    assert len(set(suffixes)) == len(suffixes)
    assert all(callable(reader_of(suffix)) for suffix in suffixes)
