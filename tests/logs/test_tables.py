"""Logs as people's programs write them: the same numbers, whatever the separator, the comma and the container."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from excite.errors import LogError
from excite.logs import log, tables
from excite.logs.times import seconds
from excite.model import Model
from excite.simulation import Motion, sensors

T = np.arange(150) / 100
TABLE = pd.DataFrame({"t_s": T, "u1_Nm": 100 * np.sin(T), "theta1_rad": -T, "wide name": T * 1e-5})


def _csv(**options: object) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        TABLE.to_csv(path / "log.csv", index=False, **options)  # type: ignore[call-overload]
        return path / "log.csv"

    return write


def _text(change: Callable[[str], str], encoding: str = "utf-8", **options: object) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        text = TABLE.to_csv(index=False, **options)  # type: ignore[call-overload]
        (path / "log.txt").write_bytes(change(text).encode(encoding))
        return path / "log.txt"

    return write


def _parquet(path: Path) -> Path:
    TABLE.to_parquet(path / "log.parquet", index=False)
    return path / "log.parquet"


def _mat(path: Path) -> Path:
    columns = {n: TABLE[n].to_numpy() for n in TABLE if n != "wide name"}
    scipy.io.savemat(path / "log.mat", columns | {"wide_name": TABLE["wide name"].to_numpy(), "note": "a text"})
    return path / "log.mat"


def _units_below(text: str) -> str:
    head, _, rest = text.partition("\n")
    return f"{head}\n[s];[N m];[rad];[-]\n{rest}"


@pytest.mark.parametrize(
    "write",
    [
        _csv(),
        _csv(sep=";"),
        _csv(sep=";", decimal=","),
        _csv(sep="\t"),
        _csv(sep="\t", decimal=","),
        _csv(sep="|"),
        _csv(quoting=1),
        _csv(lineterminator="\r\n", sep=";", decimal=","),
        _text(lambda s: "# logger 3\n% of May\n\n" + s),
        _text(lambda s: "sep=;\n" + s, sep=";"),
        _text(_units_below, sep=";", decimal=","),
        _text(lambda s: s.replace("\n", ";\n"), sep=";"),
        _text(lambda s: s, encoding="utf-8-sig"),
        _text(lambda s: s, encoding="utf-16"),
        _text(lambda s: "# Maßstab\n" + s, encoding="cp1252"),
        _text(lambda s: s.replace(",", ", ")),
        _parquet,
        _mat,
    ],
)
def test_the_same_numbers_from_every_file(write: Callable[[Path], Path], tmp_path: Path) -> None:
    read = tables.read_table(write(tmp_path))
    read.columns = [str(c).replace("wide_name", "wide name") for c in read.columns]
    assert set(read.columns) == set(TABLE.columns)
    for name in TABLE:
        assert read[name].to_numpy(dtype=float) == pytest.approx(TABLE[name].to_numpy(), rel=1e-12, abs=1e-300)


def _read(folder: Path, text: str) -> pd.DataFrame:
    (folder / "log.csv").write_text(text)
    return tables.read_table(folder / "log.csv")


@pytest.mark.parametrize("rows", ["0,00,1,5\n0,01,1,6\n", "0,1\n0,01,1,6\n"])
def test_thousands_are_no_decimals(rows: str, tmp_path: Path) -> None:
    """With commas between the columns a comma is no decimal: 1,5 would be two cells, and says so."""
    with pytest.raises(LogError, match=r"line \d has more cells than the header .* decimal commas, and commas between"):
        _read(tmp_path, "t_s,u1_Nm\n" + rows)


@pytest.mark.parametrize(
    ("cell", "below"),
    [("-1.005", "-1.238"), ('"-1.005"', "-1.238"), ("0.5", "-1,238"), ("1.", "-1,238"), ("1.5e3", "-1,238")],
)
def test_a_point_among_decimal_commas_is_never_guessed(cell: str, below: str, tmp_path: Path) -> None:
    """-1.005 may be about -1 or about -1000."""
    with pytest.raises(
        LogError, match=r"row 2, column u1_Nm: .* has a point, other cells a decimal comma \('-?\d+,\d+'\)"
    ):
        log.numbers(_read(tmp_path, f"t_s;u1_Nm;theta1_rad\n0;-999;1,5\n1;{cell};2,5\n2;{below};-21,85\n"), "u1_Nm", "")


def test_a_point_in_a_column_that_nobody_uses_is_no_harm(tmp_path: Path) -> None:
    """A version, a label; nor is a comma in a file with points, nor a point behind a zero."""
    table = _read(tmp_path, "t_s;u1_Nm;version\n0,00;-999;1.234\n0,01;-21,85;1.234\n")
    assert log.numbers(table, "u1_Nm", "").tolist() == [-999, -21.85]
    table = _read(tmp_path, "t_s;u1_Nm;note\n0.00;-999.5;3,5\n0.01;-21.85;stop\n")
    assert log.numbers(table, "u1_Nm", "").tolist() == [-999.5, -21.85]
    table = _read(tmp_path, "t_s;u1_Nm;u4_Nm\n0.010;-999,5;1,5\n0.020;-21,85;1,5\n")
    assert log.numbers(table, "t_s", "").tolist() == [0.01, 0.02]


def test_a_column_with_points_throughout_has_decimal_points(tmp_path: Path) -> None:
    """A position, say, that another device writes: where one number is no group of thousands none is."""
    table = _read(tmp_path, "t_s;u1_Nm;lat\n0,00;-21,85;48.137\n0,01;-22,5;48.1371\n")
    assert table["lat"].tolist() == [48.137, 48.1371]
    assert table["u1_Nm"].tolist() == [-21.85, -22.5]


def test_points_between_thousands_are_read_where_nothing_else_is_meant(tmp_path: Path) -> None:
    read = _read(tmp_path, "t_s;u1_Nm;u4_Nm\n0,00;-999;1.238.500\n0,01;-1.005,25;1,5\n0,02;12.345.678,9;7\n")
    assert read["u1_Nm"].tolist() == [-999, -1005.25, 12345678.9]
    assert read["u4_Nm"].tolist() == [1238500, 1.5, 7]
    assert _read(tmp_path, "t_s;u1_Nm\n0;1.238,5\n")["u1_Nm"].tolist() == [1238.5]  # the only comma


def test_decimal_commas_begin_anywhere_and_spoil_no_other_cell(tmp_path: Path) -> None:
    """The first comma far below; an error in a column leaves the rest of it numbers."""
    rows = [f"{k};{k};0" for k in range(40)] + ["40;-21,85;error", "41;-21,86;0,5"]
    read = _read(tmp_path, "t_s;theta1_rad;u1_Nm\n" + "\n".join(rows))
    assert read["theta1_rad"].tolist() == [*range(40), -21.85, -21.86]
    u1 = pd.to_numeric(read["u1_Nm"], errors="coerce")
    assert (u1.isna().sum(), u1.iloc[41]) == (1, 0.5)


@pytest.mark.parametrize("form", ["%d.%m.%Y %H:%M:%S,%f", "%d.%m.%y %H:%M:%S.%f"])
def test_dates_with_points_have_the_day_first(form: str, va12: Model, tmp_path: Path) -> None:
    """Over midnight, the second day's too: 06.03. is no 3rd of June."""
    when = pd.date_range("2024-03-05 23:59:59.5", periods=100, freq="10ms")
    cells = [w.strftime(form)[:-4] for w in when]
    cells[50] = cells[50][:-3]  # a full second without its zeros
    read = _read(tmp_path, "t_s;u1_Nm\n" + "".join(f"{cell};0\n" for cell in cells))
    t = seconds(read, va12.machine, "log")
    assert t == pytest.approx(np.arange(100) / 100, abs=1e-6)


def test_units_below_the_header_are_kept(tmp_path: Path) -> None:
    read = _read(tmp_path, "t_s;n1;theta2_rad;x\n[ms];1/min;(deg);\n0;1;2;3\n")
    assert read.attrs["units"] == {"t_s": "ms", "n1": "1/min", "theta2_rad": "deg"}
    assert len(read) == 1
    assert _read(tmp_path, "t_s;n1\n# a note\n0;1\n").attrs["units"] == {}
    assert len(_read(tmp_path, "t_s;n1\n\nms;rpm\n0;1\n")) == 1  # after an empty line


def test_columns_may_be_counted(tmp_path: Path) -> None:
    """A table without names, as programs write it; and names that begin as numbers do."""
    assert list(_read(tmp_path, "0,1,2\n0.5,0.5,0.5\n")) == ["0", "1", "2"]
    assert list(_read(tmp_path, "1_theta,2_theta\n0.5,0.5\n")) == ["1_theta", "2_theta"]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("log.csv", b"", "empty"),
        ("log.csv", b"# only a comment\n", "no header"),
        ("log.csv", b"a,b\n", "no rows"),
        ("log.csv", b"0.0,0.0,1.5\n0.01,2,3\n", "line 1 holds numbers, there is no header"),
        ("log.csv", b"2024-05-03 10:00:00;-1,5\n2024-05-03 10:00:01;-2\n", "line 1 holds numbers, there is no header"),
        ("log.csv", b"x" * 200_000, "not a table: line 1 has a cell of more than"),
        ("log.csv", b"x" * 2_000 + b",b\n1,2\n", "not a table: line 1 should be the header, it has a name of 2000"),
        ("log.csv", b"a,b\n" + b"x" * 200_000, "not a table: line 2 has a cell of more than"),
        ("log.csv", b"# May\na;b\ns;m\n1;2\n1;2;3;4\n", "line 5 has more cells than the header has names (4, not 2)"),
        (
            "log.csv",
            b"a,b\n1,2\n# stop, go, stop\n",
            "line 3 has more cells than the header has names (3, not 2); it is",
        ),
        ("log.csv", b"PK\x03\x04\x00\x00\xff\x00\x00", "not a text file"),
        ("log.parquet", b"hello", "not a Parquet file"),
        ("log.mat", b"hello", "not a MATLAB file"),
        ("log.xls", b"hello", "unknown kind of file '.xls', allowed: .csv"),
        ("log.xlsx", b"hello", "not an Excel file"),
    ],
)
def test_what_is_no_table_is_one_clear_line(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError) as err:
        tables.read_table(tmp_path / name)
    assert words in str(err.value)
    assert str(tmp_path / name) in str(err.value)
    assert "\n" not in str(err.value)


def test_mdf_channels_at_the_fastest_ones_times(va12: Model, va12_motion: Motion, tmp_path: Path) -> None:
    """A bus log: groups at their own rates, time from the clock of the day; it reads as the same log."""
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed (extra mdf)")
    table = sensors.measure(va12, va12_motion, noise=False)
    t = 1000.0 + table["t_s"].to_numpy()
    with asammdf.MDF(version="4.10") as mdf:
        names = [c for c in table if c != "t_s"]
        mdf.append([asammdf.Signal(table[c].to_numpy(), t, name=c) for c in names])
        mdf.append([asammdf.Signal(20 + 0.1 * np.arange(7), t[::1000], name="oil temperature", unit="°C")])
        mdf.save(tmp_path / "log.mf4")
    read = tables.read_table(tmp_path / "log.mf4")
    assert len(read) == len(table)
    assert read["oil temperature"].iloc[1000] == pytest.approx(20.1)
    from_mdf = log.read_log(tmp_path / "log.mf4", va12.machine)
    for name, values in log.from_table(table, va12.machine).values.items():
        assert from_mdf.values[name] == pytest.approx(values)
    (tmp_path / "broken.mf4").write_bytes(b"hello")
    with pytest.raises(LogError, match="not an MDF file"):
        tables.read_table(tmp_path / "broken.mf4")
