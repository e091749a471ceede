"""Logs as people's programs write them: the same numbers, whatever the separator, the comma and the container."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from excite import log, sensors, tables
from excite.log import LogError
from excite.simulate import Motion
from model.prediction import Model

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
    read = tables.read(write(tmp_path))
    read.columns = [str(c).replace("wide_name", "wide name") for c in read.columns]
    assert set(read.columns) == set(TABLE.columns)
    for name in TABLE:
        assert read[name].to_numpy(dtype=float) == pytest.approx(TABLE[name].to_numpy(), rel=1e-12, abs=1e-300)


def test_thousands_are_no_decimals(tmp_path: Path) -> None:
    """With commas between the columns a comma is no decimal: 1,5 would be two cells, and says so."""
    (tmp_path / "log.csv").write_text("t_s,u1_Nm\n0,00,1,5\n0,01,1,6\n")
    with pytest.raises(LogError, match="more cells than the header"):
        tables.read(tmp_path / "log.csv")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("log.csv", b"", "empty"),
        ("log.csv", b"# only a comment\n", "no header"),
        ("log.csv", b"a;b;a\n1;2;3\n", "column a is there twice"),
        ("log.csv", b"a,b\n", "no rows"),
        ("log.csv", b"PK\x03\x04\x00\x00\xff\x00\x00", "not a text file"),
        ("log.parquet", b"hello", "not a Parquet file"),
        ("log.mat", b"hello", "not a MATLAB file"),
        ("log.xlsx", b"hello", "unknown kind of file '.xlsx', allowed: .csv"),
    ],
)
def test_what_is_no_table_is_one_clear_line(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError) as err:
        tables.read(tmp_path / name)
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
    read = tables.read(tmp_path / "log.mf4")
    assert len(read) == len(table)
    assert read["oil temperature"].iloc[1000] == pytest.approx(20.1)
    from_mdf = log.read(tmp_path / "log.mf4", va12.machine)
    for name, values in log.check(table, va12.machine).values.items():
        assert from_mdf.values[name] == pytest.approx(values)
    (tmp_path / "broken.mf4").write_bytes(b"hello")
    with pytest.raises(LogError, match="not an MDF file"):
        tables.read(tmp_path / "broken.mf4")
