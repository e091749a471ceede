"""Result folders are whole or not there at all."""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from excite import output
from excite.errors import DiskError, FolderError
from excite.workflows import design_request


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with output.new_folder(out) as place:
        (place / "x").write_text("1")
        assert not out.exists()
    assert [p.name for p in out.iterdir()] == ["x"]
    assert [p.name for p in out.parent.iterdir()] == ["b"]


def test_what_fails_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), output.new_folder(tmp_path / "a" / "b") as place:
        (place / "no" / "x").write_text("1")
    assert list(tmp_path.iterdir()) == []


def test_what_fails_keeps_the_old_one(tmp_path: Path) -> None:
    out = tmp_path / "o"
    with output.new_folder(out) as place:
        (place / output.SUMMARY).write_text("old")
    with pytest.raises(ZeroDivisionError), output.new_folder(out):
        _ = 1 / 0
    assert (out / output.SUMMARY).read_text() == "old"
    with output.new_folder(out) as place:
        (place / output.SUMMARY).write_text("new")
    assert (out / output.SUMMARY).read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["o"]


def test_a_file_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "a" / "log.csv"
    with pytest.raises(ZeroDivisionError), output.new_file(out):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []
    with output.new_file(out) as path:
        path.write_text("1")
    assert out.read_text() == "1"
    assert [p.name for p in out.parent.iterdir()] == ["log.csv"]


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(FolderError):
            output.check_out_folder(out)


@pytest.mark.parametrize(
    ("summary", "told"),
    [
        ({"objective": "cond", "duration_s": 40.0, "seed": 0}, r" \(objective cond, duration 40 s, seed 0\)"),
        ({"design": {"seed": 3}, "verify": {"seed": 4}}, r" \(seed 3\)"),
        ({"design": "d", "method": "ols", "runs": 20}, r" \(method ols, runs 20\)"),
        ({}, ""),
        ([], ""),
        (None, ""),
    ],
)
def test_a_former_result_is_told(tmp_path: Path, summary: object, told: str) -> None:
    assert output.describe_result(tmp_path) is None
    (tmp_path / output.SUMMARY).write_text("{" if summary is None else json.dumps(summary))
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d" + told, output.describe_result(tmp_path) or "")


def test_a_summary_says_how_it_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the command line, another command that is given, or its own entries; at the commit of the program."""

    def written(summary: dict[str, Any], *command: str) -> dict[str, Any]:
        output.write_summary(tmp_path, summary, *command)
        found: dict[str, Any] = json.loads((tmp_path / "summary.json").read_text())
        return found

    monkeypatch.setattr(sys, "argv", ["/usr/bin/excite", "design", "my machine.toml"])
    assert written({"a": 1}) == {"a": 1, "command": "excite design 'my machine.toml'", "commit": output.commit()}
    assert written({}, "in Python")["command"] == "in Python"
    assert written({"command": "x", "commit": "y"}) == {"command": "x", "commit": "y"}
    assert re.fullmatch(r"[0-9a-f]{7,}(-dirty)?", written({})["commit"] or "0000000")

    silent = subprocess.TimeoutExpired("git", 10), subprocess.CalledProcessError(1, "git"), FileNotFoundError("git")
    for error in silent:
        monkeypatch.setattr(subprocess, "run", Mock(side_effect=error))
        assert written({})["commit"] is None


def test_json_is_strict() -> None:
    text = output.to_json({"a": np.float64("nan"), "b": np.array([1, np.inf]), "c": {1: np.int64(3)}, "d": "x"})
    assert json.loads(text, parse_constant=lambda name: pytest.fail(name)) == {
        "a": None,
        "b": [1.0, None],
        "c": {"1": 3},
        "d": "x",
    }


def test_a_folder_of_the_program_s_own_files_is_written_anew(tmp_path: Path) -> None:
    for name in (output.SUMMARY, "tolerances.csv", "covariance.csv", "machine.json", "budget.png", "report.html"):
        (tmp_path / name).write_text("{}")
    (tmp_path / design_request.OTHER_END).mkdir()
    output.check_out_folder(tmp_path)


@pytest.mark.parametrize("foreign", ["mydata.csv", "thesis.txt", "drive.toml"])
def test_a_folder_with_anything_else_in_it_is_left_alone(tmp_path: Path, foreign: str) -> None:
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / output.SUMMARY).write_text("{}")
    (tmp_path / "o" / foreign).write_text("precious")
    with pytest.raises(FolderError, match=foreign):
        output.check_out_folder(tmp_path / "o")


def test_what_is_read_is_not_written_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with output.new_folder(tmp_path / "o") as place:
        (place / output.SUMMARY).write_text("{}")
    for given in (tmp_path / "o", tmp_path / "o" / "log.csv"):
        with pytest.raises(FolderError, match="contains the input"):
            output.check_out_folder(tmp_path / "o", [given])
    monkeypatch.chdir(tmp_path / "o")
    with pytest.raises(FolderError, match="the current folder"):
        output.check_out_folder(Path())


@pytest.mark.parametrize("new", [output.new_folder, output.new_file], ids=["folder", "file"])
def test_a_full_disk_is_one_line(new: Any, tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    with pytest.raises(DiskError, match=r"made: could not be written: No space left on device"), new(tmp_path / "made"):
        full.write_text("x")
    assert list(tmp_path.iterdir()) == []


def test_too_large_a_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DiskError, match=r"made: could not be written: File too large"):
        _write_with_a_limit(tmp_path / "made")
    assert list(tmp_path.iterdir()) == []


def _write_with_a_limit(out: Path) -> None:
    """Write a file beyond a limit of the size of files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with output.new_file(out) as part:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
        try:
            part.write_bytes(bytes(200_000))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("target", ["out", "nowhere"])
def test_a_link_that_leads_nowhere_is_no_folder(target: str, tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(target)
    with pytest.raises(FolderError, match="out: is a file"):
        output.check_out_folder(tmp_path / "out")
