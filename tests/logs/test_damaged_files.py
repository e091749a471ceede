"""Damaged log files of every format, each read in a process that may have 4 GB and 20 s: a table, or one line."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from support import damage, log_files

from excite.errors import LogError
from excite.logs import tables

WANTED = (
    "t_s",
    "theta1_rad",
    "u1_Nm",
    "/joint_states/position[0]",
    "/motor/torque/data",
    "Encoder.Angle",
    "Angle",
    "X_Value",
)
SIZES = [pytest.param(1, id="few"), pytest.param(6, id="many", marks=pytest.mark.slow)]  # files of each format


@pytest.fixture(scope="module")
def child() -> Iterator[damage.Child]:
    for library in ("rosbags", "mcap", "can", "cantools", "asammdf", "openpyxl", "h5py", "nptdms", "pyulog"):
        pytest.importorskip(library, reason=f"{library} is not installed")
    made = damage.Child()
    yield made
    made.end()


@pytest.mark.slow
@pytest.mark.parametrize("each", SIZES)
def test_damaged_files_give_a_table_or_one_line(each: int, child: damage.Child, tmp_path: Path) -> None:
    seeds = log_files.a_file_of_each_format(tmp_path)
    for name, k, answer in damage.answers(child, seeds, each * len(seeds), each, wanted=WANTED):
        assert answer.good, (name, k, answer)


@pytest.mark.slow
@pytest.mark.parametrize("each", SIZES)
def test_damaged_logs_are_refused_or_prepared_without_nan(each: int, child: damage.Child, tmp_path: Path) -> None:
    seeds = log_files.logs_of("va12", tmp_path)
    for name, k, answer in damage.answers(child, seeds, each * len(seeds), each, "va12"):
        assert answer.good, (name, k, answer)


def test_packed_blocks_of_mdf_are_as_long_as_they_say(tmp_path: Path) -> None:
    """Where they aren't, asammdf reads behind their ends: a crash, or numbers that nobody logged."""
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed (extra mdf)")
    with asammdf.MDF(log_files.write_mdf(tmp_path)) as mdf:
        path = Path(mdf.save(tmp_path / "packed.mf4", overwrite=True, compression=2))
    raw = path.read_bytes()
    at = raw.index(b"##DZ") + 32  # bytes of the block unpacked
    size = int.from_bytes(raw[at : at + 8], "little")
    assert size == len(log_files.T) * 16
    for wrong, what in ((size + 1, "not as long as it says"), (1 << 32, "far more than the file can hold")):
        path.write_bytes(raw[:at] + wrong.to_bytes(8, "little") + raw[at + 8 :])
        with pytest.raises(LogError, match=what):
            tables.read_table(path)


def test_a_line_of_very_many_cells_is_no_header(child: damage.Child, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t,u," + "ab," * 1_000_000)
    answer = child.read(tmp_path / "log.csv")
    assert answer.kind == "refused"
    assert "cells, more than 10000" in answer.what


def test_a_row_with_a_huge_number_is_refused(child: damage.Child, tmp_path: Path) -> None:
    """openpyxl gives blank rows up to it."""
    path = log_files.write_table(log_files.small_table(), tmp_path / "log.xlsx")
    path.write_bytes(damage.in_zip(path.read_bytes(), lambda xml: xml.replace(b'r="150"', b'r="999999999"')))
    answer = child.read(path)
    assert answer.kind == "refused"
    assert "claims more than 1048576 rows" in answer.what


@pytest.mark.parametrize(
    ("last", "named", "filled", "rows", "what"),
    [
        ("XFD", False, True, 20_000, ""),  # the last column of a sheet holds numbers that have no name
        ("XFD", True, True, 100, "row 1 has more than 10000 columns"),
        ("NTP", True, False, 20_000, "claims 2001 rows of 10000 columns, more numbers than its bytes hold"),
    ],
)
def test_far_cells_of_a_sheet_cost_no_more_than_near_ones(
    last: str, named: bool, filled: bool, rows: int, what: str, child: damage.Child, tmp_path: Path
) -> None:
    path, text = tmp_path / "log.xlsx", '<c r="{}" t="str"><v>{}</v></c>'
    log_files.write_table(log_files.small_table(), path)
    header = [text.format(f"{name}1", name) for name in ("A", "B", *([last] if named else []))]
    lines = [f'<row r="1">{"".join(header)}</row>']
    for r in range(2, rows + 2):
        lines.append(f'<row r="{r}"><c r="A{r}"><v>{r}</v></c><c r="B{r}"><v>1</v></c>')
        lines[-1] += f'<c r="{last}{r}"><v>3</v></c></row>' if filled or r < 10 else "</row>"
    body = f"<sheetData>{''.join(lines)}</sheetData>".encode()
    path.write_bytes(damage.in_zip(path.read_bytes(), lambda xml: re.sub(b"<sheetData>.*</sheetData>", body, xml)))
    answer = child.read(path)
    assert answer.kind == ("refused" if what else "table")
    assert what in answer.what


def test_styles_and_sheets_of_a_workbook_cost_little(child: damage.Child, tmp_path: Path) -> None:
    """openpyxl takes a minute for 20 MB of styles, and reads a sheet as often as the workbook names it."""
    path = log_files.write_table(log_files.small_table(), tmp_path / "log.xlsx")
    raw = path.read_bytes()
    parts = zipfile.ZipFile(path).namelist()
    styles = partial(re.sub, b"</cellXfs>", b"<xf/>" * 500_000 + b"</cellXfs>")

    def named(times: int, xml: bytes) -> bytes:
        return re.sub(b"<sheet [^>]*/>", lambda m: m[0] * times, xml)

    rows = b"".join(b"<row><c><v>%d</v></c></row>" % (k * k) for k in range(20_000))
    cells = partial(re.sub, b"</sheetData>", rows + b"</sheetData>")
    long = damage.in_zip(raw, cells)
    alike = damage.in_zip(raw, lambda xml: xml.replace(b"</sheetData>", b"<row/>" * 400_000 + b"</sheetData>"))
    cases = (
        (raw, "styles", styles),
        (alike, "workbook", bytes),
        (raw, "workbook", partial(named, 501)),
        (long, "workbook", partial(named, 60)),
    )
    for book, part, change in cases:
        path.write_bytes(damage.in_zip(book, change, parts.index(f"xl/{part}.xml")))
        answer = child.read(path, ["no such column"])
        assert answer.kind == ("table" if book is long else "refused")
        assert answer.seconds < 10
        assert "more than 500 sheets" in answer.what or book is long


def test_a_container_that_unpacks_to_very_much_is_refused(child: damage.Child, tmp_path: Path) -> None:
    path = log_files.write_can(tmp_path, ".blf")
    path.write_bytes(damage.in_blf(path.read_bytes(), lambda data: data + bytes(200_000_000)))
    answer = child.read(path)
    assert answer.kind == "refused"
    assert "a container unpacks to" in answer.what
