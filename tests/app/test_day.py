"""What the window reads from a folder of results, what each step needs, and the lines that messages are about."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite
from support.drives import drive
from support.logs import logged

from excite.app.course import draw_course
from excite.app.day import Day
from excite.app.job import Job
from excite.app.key_lines import find_line
from excite.app.live_view import draw_text
from excite.logs import SUFFIXES
from excite.model import Model
from excite.simulation import simulate


@pytest.fixture(scope="module")
def log(straight: Model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    motion = simulate(straight, drive(straight, 8, 1, {"u1": 1500, "u4": 1500}))
    return logged(straight, motion, tmp_path_factory.mktemp("log") / "log.csv", 3)


def lacking(day: Day, step: str) -> list[str]:
    return [need.text for need in day.needs(step) if not need.met]


@pytest.mark.slow
def test_failed_log_blocks_identification_until_it_is_mended_and_doubts_until_accepted_in_words(
    log: Path, tmp_path: Path, excite: Excite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    good, path = pd.read_csv(log), tmp_path / "day.csv"
    torn = good.astype({"u1_Nm": object})
    torn.loc[400, "u1_Nm"] = "x"
    torn.to_csv(path, index=False)
    day = Day(Path("results"))
    assert lacking(day, "identify") == ["a machine: choose one in step Machine"]
    day.choose("va12_straight")
    assert lacking(day, "identify") == ["a log that passes its check: step Log"]
    day.logs = ["day.csv"]
    assert lacking(day, "identify") == ["day.csv checked: step Log"]

    code, _, _ = excite(*day.command("log", "day.csv"))
    assert code == 1
    assert "mend it first" in lacking(day, "identify")[0]
    assert "row 401, column u1_Nm" in lacking(day, "identify")[0]
    assert not day.ready("identify")
    assert not day.ready("diagnose")
    day.accepted = {"words": "it is fine", "doubts": day.doubts()}
    assert not day.ready("identify"), "words don't mend a log that no method can read"

    step = 2 * np.pi / 1024  # mended, but one encoder is coarser than the machine file says
    good.assign(theta1_rad=np.floor(good.theta1_rad / step) * step).to_csv(path, index=False)
    assert lacking(day, "identify") == ["day.csv checked again: day.csv has changed since"]
    code, _, _ = excite(*day.command("log", "day.csv"))
    assert code == 0
    assert day.doubts()
    assert not day.ready("identify")
    assert "--accept" not in day.command("identify")
    words = "The front encoder was changed today."
    day.accepted = {"words": words, "doubts": day.doubts()}
    assert day.ready("identify")
    day.save()

    again = Day(Path("results"))
    assert (again.machine, again.logs, again.accepted_words()) == ("va12_straight", ["day.csv"], words)
    again.accepted["doubts"] = ["another doubt"]
    assert not again.ready("identify"), "words accept the doubts that were seen, no others"

    day.forms["identify"]["method"] = "ols"
    excite(*day.command("identify"))
    summary = json.loads(Path("results/identify-va12_straight/summary.json").read_text())
    assert summary["accepted"] == words
    assert words in Path("results/identify-va12_straight/report.html").read_text()
    assert Day(Path("results")).result_of("identify") is not None


def test_day_is_read_from_what_the_commands_wrote(
    log: Path, tmp_path: Path, excite: Excite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(log, "log.csv")
    Path("mine.toml").write_text('extends = "va12_straight"\nname = "mine"\n')
    code, _, _ = excite("log", "check", "log.csv", "--machine", "mine.toml", "--out", "results/checked")
    assert code == 0
    day = Day(Path("results"))
    assert (day.machine, day.logs) == ("mine.toml", ["log.csv"])
    states = {step: day.state(step) for step in ("machine", "design", "drive", "log", "identify")}
    assert states == {"machine": "ready", "design": "waiting", "drive": "waiting", "log": "done", "identify": "ready"}
    summary = Path("results/checked/summary.json")
    clean = summary.read_text()
    summary.write_text(json.dumps(json.loads(clean) | {"doubts": ["the front encoder is coarse"]}))
    assert Day(Path("results")).state("log") == "doubtful"
    summary.write_text(clean)
    later = time.time() + 60
    os.utime("mine.toml", (later, later))
    assert day.state("log") == "to do again"
    assert lacking(day, "identify") == ["log.csv checked again: mine.toml has changed since"]
    Path("mine.toml").write_text('extends = "va12_straight"\nname = \n')
    assert "mine.toml" in lacking(day, "design")[0]
    assert not day.ready("log")


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("starts", None, ["Starting guesses: a number is needed"]),
        ("starts", 2.5, ["Starting guesses: must be a whole number (got 2.5)"]),
        ("duration", -5, ["Length of the drive [s]: must be 1 or more (got -5)"]),
        ("duration", None, []),
        ("starts", 3.0, []),
    ],
)
def test_a_wrong_number_is_said_and_never_replaced(tmp_path: Path, key: str, value: object, said: list[str]) -> None:
    day = Day(tmp_path)
    day.forms["design"][key] = value
    assert day.wrong_numbers("design") == said
    assert day.forms["design"][key] == value


def test_the_course_of_a_search_falls_and_ends_now() -> None:
    assert draw_course([], 5) == draw_course([(1, 40.0)], 5) == draw_course([(0, float("inf")), (1, 40.0)], 5) == ""
    drawn = draw_course([(0, float("inf")), (1, 100.0), (3, 10.0), (5, 1.0)], 9)
    points = re.findall(r"([\d.]+),([\d.]+)", drawn.partition("points=")[2])
    x, y = np.array(points, float).T
    assert np.all(np.diff(x) >= 0)
    assert (x[0], x[-1]) == (6, 354)
    assert np.unique(y) == pytest.approx([6, 35, 64])  # of equal ratios equal steps, the lowest score at the bottom
    assert "100 at 1 s, 1 now" in drawn


def test_a_text_is_drawn_from_above_while_it_is_right(tmp_path: Path) -> None:
    """What is wrong names the file itself, and no draft stays."""
    path = tmp_path / "mine.toml"
    drawing, fault = draw_text('extends = "va12"\nname = "mine"\n', path)
    assert drawing.startswith("data:image/png;base64,iVBOR")
    assert fault == ""
    wide = 'extends = "va12"\nname = "mine"\n[body.front_roll.contact]\nwidth = { value = 3, source = "measured" }\n'
    assert draw_text(wide, path)[0] not in ("", drawing)
    drawing, fault = draw_text(wide.replace("width", "widt"), path)
    assert drawing == ""
    assert fault.startswith("mine.toml: body[1].contact.widt: no such key here")
    assert draw_text('extends = "ur10"\nname = "mine"\n', path) == ("", "")
    assert list(tmp_path.iterdir()) == []


TEXT = """\
extends = "va12"
name = "mine"

[body.front_roll.contact]
Kx = { value = 100000, source = "measured" }

[[sensor]]
name = "u9"

[problems.S40]
lane_m = [80.0, -20.0]

[[body]]
index = 0
name = "frame"
[body.inertia]
mass = { value = -3, sourc = "assumed" }
"""


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ("front_roll: contact.Kx: 10 N per slip, 0.01 times its load", 5),
        ("problems.S40.lane_m: must be > 0, length and width (got -20)", 11),
        ("body[0].inertia.mass.sourc: no such key here", 17),
        ("frame: inertia: has a negative principal moment", 16),
        ("sensor[0].column: is missing", 7),
        ("Invalid value (at line 9, column 3)", 9),
        ("line 8: sensor u9: has no column", 8),
        ("the mass matrix is not positive definite", None),
    ],
)
def test_message_finds_its_line(message: str, line: int | None) -> None:
    assert find_line(TEXT, message) == line


def test_result_of_other_logs_is_not_shown(log: Path, tmp_path: Path) -> None:
    day = Day(tmp_path / "results")
    day.choose("va12_straight")
    other = tmp_path / "results" / "identify-x"
    other.mkdir(parents=True)
    named = {"machine": "va12_straight", "method": "joint", "logs": ["other.csv from row 12"], "status": "valid"}
    shown = {"parameters": {}, "unidentifiable": [], "reasons": {}, "notes": [], "validation": []}
    numbers = {"relative_error_percent": None, "cond_w": 2.0, "cond_phi": 2.0}
    (other / "summary.json").write_text(json.dumps(named | shown | numbers))
    day.logs = [str(log)]
    assert day.result_of("identify") is None
    day.logs = ["other.csv"]
    assert day.result_of("identify") is not None
    assert np.isfinite(day.result_of("identify").time)  # type: ignore[union-attr]


def test_logs_of_one_stem_have_a_check_each(tmp_path: Path) -> None:
    day = Day(tmp_path)
    day.machine = "va12"
    places = {day.command("log", str(tmp_path / name))[-1] for name in ("day.csv", "day.mat")}
    assert len(places) == 2


def test_logs_of_one_name_have_a_check_each(log: Path, tmp_path: Path, excite: Excite) -> None:
    day, logs = Day(tmp_path), [tmp_path / "monday" / "log.csv", tmp_path / "tuesday" / "log.csv"]
    day.machine = "va12_straight"
    for path in (*logs, logs[0]):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(log.read_bytes())
        excite(*day.command("log", str(path)))
    assert all(day.check_of(str(path)) for path in logs)
    assert len(day.results("log")) == 2


def test_the_window_lists_a_log_of_every_format_that_is_read(tmp_path: Path) -> None:
    every = sorted(str(tmp_path / f"log{ending}") for ending in SUFFIXES)
    for path in every:
        Path(path).write_text("")
    for other in ("profile.csv", "rig.toml", "sheet.pdf"):
        (tmp_path / other).write_text("")
    assert Day(tmp_path).known_logs() == every


def test_the_time_left_is_that_of_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Job, "elapsed_s", 12.0)
    job = object.__new__(Job)
    for arguments, said in (
        (("design", "va12"), ""),
        (("design", "va12", "--budget", "60"), ", 48 s left to search"),
        (("design", "va12", "--budget", "10"), ", about to end"),
    ):
        job.arguments = arguments
        assert job.time_left == said


def test_both_ends_of_a_design_are_there_to_choose(tmp_path: Path) -> None:
    day = Day(tmp_path / "results")
    day.choose("va12_straight")
    summary = {"machine": "va12_straight", "problem": "S40", "objective": "cond", "duration_s": 40.0, "complete": True}
    summary |= {"cond_w": 9.0, "cond_phi_start": 99.0, "max_violation": 0.0, "worst_parameter": "M", "advice": None}
    for place, worst, cond in (("design", 2.6, 19.38), ("design/accurate", 0.87, 89.6)):
        folder = tmp_path / "results" / place
        folder.mkdir(parents=True)
        own = {"cond_phi": cond, "worst_percent": worst, "sigma_percent": {"M": worst}, "median_percent": worst}
        (folder / "summary.json").write_text(json.dumps(summary | own))
    names = sorted(day.design_names().values())
    assert names == [
        "design/accurate: worst 0.87 % at cond(Phi) 89.6",
        "design: worst 2.6 % at cond(Phi) 19.38",
    ]
    day.forms["drive"]["design"] = str(tmp_path / "results" / "design" / "accurate")
    chosen = day.result_of("design")
    assert chosen is not None
    assert chosen.summary["cond_phi"] == 89.6
