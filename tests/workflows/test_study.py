"""Studies: what a file spans, the same table whatever computes it, and nothing lost or done twice by any end."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

from excite.errors import FolderError, InfeasibleError, MachineError, RowStoreError, WorkerError
from excite.identification import monte_carlo as verification
from excite.logs import profile
from excite.model import Model, build
from excite.model.effects import placing
from excite.model.machine import Problem, machine as machines
from excite.reports import describe
from excite.reports.pages import write_report
from excite.simulation import Motion, simulate
from excite.trajectories import saved_design
from excite.workflows import row_store, study_plan, study_runner, study_runs, study_workers
from excite.workflows.study_plan import StudyPlan

ROOT = Path(__file__).parents[2]
TINY = """
name = "tiny"
runs = {runs}
steps = ["verify"]
[grid]
machine = "va12_straight"
profile = "drive.csv"
method = "ols"
effects = [[], "rolling_resistance@front_roll=300"]
"""


def wave(seconds: float, rate: float = 100.0) -> np.ndarray:
    """Torques (N, 2) [N m] that move the straight-line machine."""
    t = np.arange(round(seconds * rate) + 1) / rate
    return np.column_stack([1500 * np.sin(2 * np.pi * t / seconds * 2), 1200 * np.sin(2 * np.pi * t / seconds * 3)])


@pytest.fixture(scope="module")
def short(straight: Model) -> Motion:
    return simulate(straight, wave(2.5))


@pytest.fixture
def tiny(tmp_path: Path, straight: Model, short: Motion) -> Callable[..., StudyPlan]:
    """A study of two cells on a drive of 2.5 s."""
    profile.profile_of(straight, short).to_csv(tmp_path / "drive.csv", index=False)

    def make(runs: int = 3, text: str = TINY) -> StudyPlan:
        (tmp_path / "tiny.toml").write_text(text.replace("{runs}", str(runs)))
        return study_plan.read_study(tmp_path / "tiny.toml")

    return make


# ------------------------------------------------------------------------------------------------ what is asked


def spans(text: str) -> study_plan.Study:
    import tomllib

    return study_plan.Study.model_validate(tomllib.loads('name = "s"\n' + text))


def test_a_grid_is_every_combination() -> None:
    asked = spans(
        'runs = 5\n[grid]\nmachine = ["va12", "va12_straight"]\nobjective = ["cond", "D", "accuracy"]\n'
        'duration_s = [20, 30]\neffects = [[], ["ground_slope=0.001"], ["a=1", "b=2"]]\n'
    )
    cells = list(asked.cells())
    assert len(cells) == 2 * 3 * 2 * 3
    assert len(set(cells)) == len(cells)
    assert len(asked) == 5 * len(cells)
    assert {c.drive.duration_s for c in cells} == {20.0, 30.0}


def test_several_grids_add_up() -> None:
    asked = spans('[[grid]]\nmachine = "va12"\n[[grid]]\nmachine = "emps"\nkit = ["paper", "full"]\n')
    assert [c.drive.machine for c in asked.cells()] == ["va12", "emps", "emps"]


def test_a_sample_draws_evenly_and_again_the_same() -> None:
    text = (
        '[sample]\ncount = 400\nmachine = ["va12", "va12_straight"]\nduration_s = { low = 20, high = 60 }\n'
        'limits = { rim_speed = { low = 0.1, high = 10, log = true } }\neffects = ["ground_slope=0.001..0.005"]\n'
    )
    kept = json.loads(spans(text).model_dump_json(warnings="error"))["sample"][0]
    assert kept["duration_s"] == [{"low": 20, "high": 60, "log": False}]
    cells = list(spans(text).cells())
    assert cells == list(spans(text).cells())
    assert cells != list(spans(text.replace("count = 400", "count = 400\nsample_seed = 1")).cells())
    durations = np.array([c.drive.duration_s for c in cells], float)
    assert durations.min() >= 20
    assert durations.max() <= 60
    assert abs(durations.mean() - 40) < 3 * 40 / np.sqrt(12 * 400)
    factors = np.log10([dict(c.drive.limits)["rim_speed"] for c in cells])
    assert abs(factors.mean()) < 3 * 2 / np.sqrt(12 * 400)
    amounts = np.array([float(c.effects[0].partition("=")[2]) for c in cells])
    assert 0.001 <= amounts.min() < 0.0012
    assert 0.0048 < amounts.max() <= 0.005
    assert 150 < sum(c.drive.machine == "va12" for c in cells) < 250


GRID = '[grid]\nmachine = "va12_straight"\n'
SAMPLE = '[sample]\nmachine = "va12_straight"\ncount = 1\n'
SLOPING = """
extends = "va12_straight"
name = "sloping"
[[effect]]
name = "ground_slope"
amount = { value = 0.005, source = "assumed" }
"""
ECCENTRIC = (
    SLOPING.replace("sloping", "sloping_eccentric")
    + """
[[effect]]
name = "encoder_eccentricity"
where = "front_roll"
amount = { value = 0.001, source = "assumed" }
"""
)
WRONG = {
    "no file": (None, "can't be read"),
    "not TOML": ("= 3", "not a TOML file"),
    "nothing to do": ("", "grid: is missing"),
    "misspelt": (GRID + 'metod = "ols"', "grid[0].metod: no such key here, allowed: machine, problem"),
    "machine unknown": (GRID.replace("va12_straight", "va13"), "va13: no such machine, allowed: "),
    "machine missing": ("[grid]\nkit = 'full'", "grid[0].machine: is missing"),
    "kit unknown": (GRID + 'kit = "best"', "grid[0].kit[0]: must be 'paper' or 'full' (got 'best')"),
    "method unknown": (GRID + 'method = "magic"', "method: magic is unknown, allowed: inverse, ols"),
    "method without its sensors": (
        '[grid]\nmachine = "va12"\nmethod = "ols"\nkit = "paper"',
        "method: ols needs vy_m_s, which kit paper does not measure",
    ),
    "objective unknown": (GRID + 'objective = "best"', "objective: best is unknown, allowed: cond"),
    "problem unknown": (GRID + 'problem = "S41"', "problem: S41 is unknown, allowed: R60, S40"),
    "effect unknown": (GRID + 'effects = "magic=1"', "effect magic: unknown: `excite docs`"),
    "effect without amount": (GRID + 'effects = "ground_slope"', "must be NAME[@WHERE]=AMOUNT"),
    "effect twice": (GRID + 'effects = [["ground_slope=0.1", "ground_slope=0.2"]]', "an effect is given twice"),
    "effect twice, at the one place that it has": (
        GRID + 'effects = [["ground_slope=0.01", "ground_slope@machine=0.02"]]',
        "an effect is given twice, ground_slope@machine",
    ),
    "effect that the machine has": (
        '[grid]\nmachine = "sloping.toml"\neffects = "ground_slope=0.01"',
        "effects: ground_slope=0.01: sloping has ground_slope@machine already, in its machine file",
    ),
    "nothing to tell apart": (
        GRID + 'objective = ["cond", "discrimination"]',
        "objective: discrimination: needs two effects to tell apart, va12_straight has none",
    ),
    "one effect to tell apart": (
        '[grid]\nmachine = "sloping.toml"\nobjective = "discrimination"',
        "needs two effects to tell apart, sloping has 1 that a drive shows; give its machine file two ([[effect]])",
    ),
    "two effects to tell apart, one in a sensor": (
        '[grid]\nmachine = "sloping_eccentric.toml"\nobjective = "discrimination"',
        "needs two effects to tell apart, sloping_eccentric has 1 that a drive shows",
    ),
    "duration too short": (GRID + "duration_s = 0.1", "duration_s: must be between 0.8 and 3600 s (got 0.1)"),
    "duration not a number": (GRID + 'duration_s = "long"', "grid[0].duration_s[0]: must be a number"),
    "limit unknown": (GRID + "limits = { charm = 2 }", "grid[0].limits[0].charm: no such limit of a machine file, "),
    "limit in per cent": (GRID + "limits = { rim_speed = 50 }", "above 0 and at most 10 (got 50); 0.5 is half of it"),
    "limit that it hasn't": ('[grid]\nmachine = "emps"\nlimits = { slip = 2 }', "limits: emps has no limit slip"),
    "limit not positive": (GRID + "limits = { torque = 0 }", "limits: torque: must be a factor"),
    "range upside down": (
        SAMPLE + "duration_s = { low = 9, high = 3 }",
        "wrong.toml: sample[0].duration_s[0].high: must be above low (got 9 to 3)\n",
    ),
    "range without an end": (SAMPLE + "limits = { slip = { low = 1 } }", "sample[0].limits[0].slip.high: is missing\n"),
    "neither number nor range": (SAMPLE + 'duration_s = "long"', "sample[0].duration_s[0]: must be a number, or a"),
    "limit unknown in a sample": (SAMPLE + "limits = { charm = 2 }", "sample[0].limits[0].charm: no such limit"),
    "no profile": (GRID + "profile = []", "grid[0].profile: must have at least 1 (got 0)"),
    "no method": (SAMPLE + "method = []", "sample[0].method: must have at least 1 (got 0)"),
    "no problem": (GRID + "problem = []", "grid[0].problem: must have at least 1 (got 0)"),
    "no duration": (GRID + "duration_s = []", "grid[0].duration_s: must have at least 1 (got 0)"),
    "no duration to draw from": (SAMPLE + "duration_s = []", "sample[0].duration_s: must have at least 1 (got 0)"),
    "method twice": (
        GRID + 'method = ["ols", "joint", "ols"]',
        "grid[0].method: a value is given twice, leave one of them out (got ols)",
    ),
    "duration twice": (GRID + "duration_s = [30, 30.0]", "duration_s: a value is given twice, leave one of them out"),
    "limits twice": (
        GRID + "limits = [{ slip = 2, torque = 0.5 }, { torque = 0.5, slip = 2 }]",
        "grid[0].limits: a value is given twice, leave one of them out (got {torque = 0.5, slip = 2})",
    ),
    "effects twice": (GRID + 'effects = [[], "a=1", ["a=1"]]', "leave one of them out (got [a=1])"),
    "no runs": ("runs = 0\n" + GRID, "runs: must be greater than or equal to 1 (got 0)"),
    "too many": (GRID.replace("grid", "sample") + "count = 1000000", "1000000 cells, at most 100000 are allowed"),
    "far too many": ("runs = 1000000\n" + GRID + "kit = ['full', 'paper']", "2000000 runs in all"),
    "profile and objective": (GRID + "profile = 'p.csv'\nobjective = 'D'", "profile: is driven as it is, leave out"),
    "profile not there": (GRID + "profile = 'p.csv'", "p.csv: no such file"),
    "name that leads away": (GRID, "name: must match pattern"),
    "seed negative": (GRID + "seed = -1", "grid[0].seed[0]: must be greater than or equal to 0 (got -1)"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_study_is_one_clear_line(name: str, tmp_path: Path, excite: Excite) -> None:
    text, words = WRONG[name]
    path = tmp_path / "wrong.toml"
    if text is not None:
        title = "../../away" if name == "name that leads away" else "wrong"
        path.write_text(f'name = "{title}"\n{text}\n')
    files = {"sloping.toml": SLOPING, "sloping_eccentric.toml": ECCENTRIC}
    for file, content in files.items():
        (tmp_path / file).write_text(content)
    code, stdout, stderr = excite("study", path, "--out", tmp_path / "out")
    assert (code, stdout) == (2, ""), stderr
    assert stderr.count("\n") == 1
    assert str(path) in stderr
    assert words in stderr
    assert {p.name for p in tmp_path.iterdir()} <= {"wrong.toml", *files}


def test_what_a_sample_draws_from_may_weigh_twice() -> None:
    cells = list(spans(SAMPLE.replace("1\n", "300\n") + 'kit = ["full", "full", "paper"]').cells())
    assert 160 < sum(c.kit == "full" for c in cells) < 240


def test_limits_are_multiplied() -> None:
    from excite.model.machine import machine

    one = machine.load_machine("va12")
    half = study_plan.scale_limits(one, {"rim_speed": 0.5, "slip": 2.0, "power": 0.1, "lane": 3.0})
    for before, after in zip(one.contacts, half.contacts, strict=True):
        assert before.contact is not None
        assert after.contact is not None
        assert float(after.limit.rim_speed or 0) == pytest.approx(0.5 * float(before.limit.rim_speed or 0))
        assert float(after.contact.slip_limit or 0) == pytest.approx(2 * float(before.contact.slip_limit or 0))
        assert after.limit.torque == before.limit.torque
    assert float(half.power_limit or 0) == pytest.approx(0.1 * float(one.power_limit or 0))
    assert half.problems["R60"].lane_m == tuple(3 * x for x in one.problems["R60"].lane_m)


# ------------------------------------------------------------------------------------------------ what comes out


def test_runs_are_those_of_verify(
    tiny: Callable[..., StudyPlan], tmp_path: Path, straight: Model, short: Motion
) -> None:
    """The same seeds, logs and estimates as `excite verify`, and the same sums."""
    summary = study_runner.run_study(tiny(4), tmp_path / "out", jobs=1)
    table = pd.read_parquet(tmp_path / "out" / "runs.parquet")
    direct = verification.verify(straight, short, "ols", "full", runs=4, seed=0, jobs=1)
    first = table[table["cell"] == 0]
    assert len(table) == 8
    for k, name in enumerate(straight.base.names):
        assert np.array_equal(first[f"value.{name}"], direct.value[:, k])
        assert np.array_equal(first[f"std.{name}"], direct.std[:, k])
        assert (first[f"true.{name}"] == direct.true[k]).all()
    rms = {n: p["rms_percent"] for n, p in verification.summarise_runs(direct).items()}
    assert summary["cells"][0]["worst_rms_percent"] == max(rms.values())
    other = table[table["cell"] == 1]
    assert (other["log_sha256"] != first["log_sha256"].to_numpy()).all()  # 300 N more to push: another log


RANKED = (
    ("cond, 40 s", "u20", 171.0),
    ("cond, 20 s", "Ky1", 0.81),
    ("accuracy, 20 s", "Fs1", 3.0),
    ("accuracy, 40 s", "Fs1", float("nan")),  # all of its runs failed
)


def test_the_page_says_which_cell_is_best_and_what_made_it(tmp_path: Path) -> None:
    row = {"done": 5, "failed": 0, "defect": 0, "median_rms_percent": 0.5, "coverage95": 0.95}
    cells = [row | {"cell": c, "worst_parameter": n, "worst_rms_percent": x} for c, n, x in RANKED]
    said = {"done": 20, "failed": 0, "runs": 20, "defects": 0, "steps": ["verify"], "compute_s": 1.0}
    said |= {"cells": cells, "program": "0123456789abcdef", "versions": {"excite": "0"}}
    (tmp_path / "study.png").touch()
    write_report(tmp_path, "study", said)
    text = (tmp_path / "report.html").read_text()
    assert "cond, 20 s (Ky1 0.81 % rms) is the best of 3 cells, cond, 40 s (u20 170 % rms) the worst." in text
    assert "0123456789abcdef" in text
    assert "the command in its column <code>command</code>, given in this folder, repeats it" in text
    assert "the best" not in describe("study", said | {"cells": cells[:1]}).headline
    sloped = [one | {"effects": ["ground_slope=0.01"] if k == 0 else []} for k, one in enumerate(cells)]
    assert (
        "cond, 20 s (Ky1 0.81 % rms) is the best of 2 cells without effects, accuracy, 20 s (Fs1 3 % rms)"
        in describe("study", said | {"cells": sloped}).headline
    )


@pytest.mark.slow
def test_each_row_tells_how_to_repeat_it(
    tiny: Callable[..., StudyPlan], tmp_path: Path, excite: Excite, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a machine file of its own and what it extends: the command of a row gives the row's numbers again."""
    machine = tmp_path / "roller.toml"
    machine.write_text('extends = "base.toml"\nname = "roller"\n')
    (tmp_path / "base.toml").write_text('extends = "va12_straight"\nname = "base"\n')
    study_runner.run_study(tiny(2, TINY.replace("va12_straight", "roller.toml")), tmp_path / "out", jobs=1)
    machine.unlink()
    monkeypatch.chdir(tmp_path / "out")
    row = pd.read_parquet("runs.parquet").iloc[3]
    first, _, second = row["command"].partition(" && ")
    import shlex

    code, _, stderr = excite(*shlex.split(first)[1:])
    assert (code, stderr) == (0, "")
    code, stdout, _ = excite(*shlex.split(second)[1:], "--out", tmp_path / "i", "--json")
    assert code == 0
    for name, found in json.loads(stdout)["parameters"].items():
        assert found["value"] == pytest.approx(row[f"value.{name}"], rel=1e-9)


def test_what_can_not_be_had_is_said_and_does_not_end_the_study(
    tiny: Callable[..., StudyPlan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from excite.errors import NotIdentifiableError

    plain = study_runs.simulation.measure

    def moody(*given: Any, seed: int, **more: Any) -> pd.DataFrame:
        if seed == int(np.random.SeedSequence(0).generate_state(4)[1]):
            raise NotIdentifiableError("nothing\nmoves")
        if seed == int(np.random.SeedSequence(0).generate_state(4)[2]):
            raise TypeError("a slip of ours")
        if seed == int(np.random.SeedSequence(0).generate_state(4)[3]):
            raise MachineError("no such machine")
        return plain(*given, seed=seed, **more)

    monkeypatch.setattr(study_runs.simulation, "measure", moody)
    summary = study_runner.run_study(tiny(4), tmp_path / "out", jobs=1)
    table = pd.read_parquet(tmp_path / "out" / "runs.parquet")
    assert list(table["status"])[:4] == ["done", "failed", "defect", "failed"]
    assert list(table["reason"])[1:4] == ["nothing moves", "TypeError: a slip of ours", "no such machine"]
    assert table.loc[1, "value.M"] != table.loc[1, "value.M"]  # none, not a number that looks like one
    assert (summary["done"], summary["failed"], summary["defects"]) == (2, 4, 2)


@pytest.mark.slow
def test_designs_are_made_once_and_can_be_verified(
    tmp_path: Path, excite: Excite, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, asked = study_runs.design_request.design_from, []

    def answer(model: Model, problem: Problem, *rest: Any) -> Any:
        asked.append(problem.lane_m[0])
        if problem.lane_m[0] < 30:
            raise InfeasibleError("no drive found that keeps every limit", "lane", 1.0)
        return plain(model, problem, *rest)

    monkeypatch.setattr(study_runs.design_request, "design_from", answer)
    path = tmp_path / "d.toml"
    path.write_text(
        'name = "d"\nruns = 2\nsteps = ["verify"]\n[grid]\nmachine = "va12_straight"\nduration_s = 8\nstarts = 1\n'
        'method = "ols"\nkit = ["full", "paper"]\nlimits = [{}, { lane = 0.1 }]\n'
    )
    summary = study_runner.run_study(study_plan.read_study(path), tmp_path / "out", jobs=1)
    table = pd.read_parquet(tmp_path / "out" / "runs.parquet")
    assert len(table) == 8
    assert sorted(p.name for p in (tmp_path / "out" / "drives").iterdir()) == ["0001"]
    assert list(summary["failed_drives"]) == ["0002"]
    assert asked == [60, 6]
    assert (table["status"] == "failed").sum() == 4
    assert table[table["status"] == "failed"]["reason"].str.startswith("no drive: ").all()
    design = saved_design.read_design(tmp_path / "out" / "drives" / "0001")
    assert design.motion.t[-1] == pytest.approx(8)
    assert float(table["drive_cond_phi"].iloc[0]) == design.summary["cond_phi"]
    code, _, _ = excite(
        "verify", tmp_path / "out" / "drives" / "0001", "--runs", 1, "--method", "ols", "--out", tmp_path / "v"
    )
    assert code == 0


def test_a_drive_is_designed_for_what_drives_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `excite design` does it: what sits in a sensor is no parameter, where cond(Phi) would be infinite."""
    roller = machines.load_machine("va12")
    machine = placing.with_effects(roller, placing.parse_effect("yaw_rate_bias=0.01", roller, 60.0))
    asked: list[Model] = []

    def answer(model: Model, *_: Any) -> Any:
        asked.append(model)
        raise refused

    monkeypatch.setattr(study_runs.design_request, "design_from", answer)
    order = study_runs.DesignJob(0, machine.model_dump_json(), "R60", machine.problems["R60"], "cond", 1, 0)
    refused: Exception = MachineError("sensor vy: give noise")
    assert study_runs.design_drive(order).failure == "sensor vy: give noise"
    assert asked[0].base.names == build(roller).base.names
    refused = np.linalg.LinAlgError("Singular matrix")
    assert study_runs.design_drive(order).failure == "some parameter moves nothing in problem R60, so no drive shows it"
    twice = machine.model_copy(update={"effect": machine.effect * 2})
    order = replace(order, machine=twice.model_dump_json())
    assert "given twice at one place: yaw_rate_bias@yaw_rate" in (study_runs.design_drive(order).failure or "")


# ------------------------------------------------------------------------------------------------ interrupted


@pytest.mark.slow
def test_the_table_does_not_depend_on_the_workers(tiny: Callable[..., StudyPlan], tmp_path: Path) -> None:
    for jobs in (1, 2):
        study_runner.run_study(tiny(3), tmp_path / f"out{jobs}", jobs=jobs)
    for name in ("runs.parquet", "study.png", "study.json"):
        assert (tmp_path / "out1" / name).read_bytes() == (tmp_path / "out2" / name).read_bytes()


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds of the runs that are computed in this process."""
    seen: list[int] = []
    plain = study_runs.run_once

    def run(one: study_runs.Run) -> study_runs.RunOutcome:
        seen.append(one.seed)
        return plain(one)

    monkeypatch.setattr(study_runs, "run_once", run)
    return seen


def test_it_goes_on_where_it_was(
    tiny: Callable[..., StudyPlan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study_runner.run_study(tiny(5), tmp_path / "whole", jobs=1)
    seen = counted(monkeypatch)

    kept = 0

    def stop(done: int, total: int, what: str) -> None:
        nonlocal kept
        kept = done
        if done >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study_runner.run_study(tiny(5), tmp_path / "out", jobs=1, progress=stop)
    assert not (tmp_path / "out").exists()
    assert kept < 10
    before = len(seen)
    study_runner.run_study(tiny(5), tmp_path / "out", jobs=1)
    assert len(seen) - before == 10 - kept
    assert (tmp_path / "out" / "runs.parquet").read_bytes() == (tmp_path / "whole" / "runs.parquet").read_bytes()
    assert not study_runner.working_folder(tmp_path / "out").exists()
    study_runner.run_study(tiny(5), tmp_path / "out", jobs=1)  # done: nothing is computed
    assert len(seen) - before == 10 - kept


def test_another_study_is_not_mixed_in(tiny: Callable[..., StudyPlan], tmp_path: Path) -> None:
    def stop(done: int, total: int, what: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study_runner.run_study(tiny(5), tmp_path / "out", jobs=1, progress=stop)
    with pytest.raises(FolderError, match="another study file"):
        study_runner.run_study(tiny(6), tmp_path / "out", jobs=1)
    study_runner.run_study(tiny(5), tmp_path / "out", jobs=1)
    with pytest.raises(FolderError, match="holds another study"):
        study_runner.run_study(tiny(6), tmp_path / "out", jobs=1)


def test_two_can_not_work_on_one_study(tmp_path: Path) -> None:
    with (
        row_store.open_store(tmp_path / "s", "f"),
        pytest.raises(FolderError, match="another process works on this study"),
        row_store.open_store(tmp_path / "s", "f"),
    ):
        pass


def test_rows_are_kept_once_and_whole(tmp_path: Path) -> None:
    with row_store.open_store(tmp_path / "s", "f") as kept:
        kept.add(3, {"a": 1.5})
        kept.add(1, {"a": None})
        with pytest.raises(sqlite3.IntegrityError, match="UNIQUE"):
            kept.add(3, {})
        with pytest.raises(ValueError, match="not JSON compliant"):
            kept.add(5, {"a": float("nan")})
    with row_store.open_store(tmp_path / "s", "f") as kept:
        assert list(kept.rows()) == [(1, {"a": None}), (3, {"a": 1.5})]


def test_a_damaged_store_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "s").write_bytes(b"SQLite format 3\0" + bytes(range(256)) * 20)
    with pytest.raises(FolderError, match="damaged"), row_store.open_store(tmp_path / "s", "f"):
        pass


def test_a_full_disk_loses_nothing(tmp_path: Path) -> None:
    with row_store.open_store(tmp_path / "s", "f") as kept:
        for k in range(10):
            kept.add(k, {"a": k})
        kept.commit()
        kept._db.execute(f"PRAGMA max_page_count = {kept._db.execute('PRAGMA page_count').fetchone()[0] + 2}")

        def fill() -> None:
            for k in range(10, 200):
                kept.add(k, {"text": "x" * 500})

        with pytest.raises(RowStoreError, match=r"full.*repeat the command"):
            fill()
    with row_store.open_store(tmp_path / "s", "f") as kept:
        there = kept.numbers()
        assert there == set(range(max(10, len(there))))  # whole rows, none left out
        for k in set(range(200)) - there:
            kept.add(k, {})


def test_a_store_that_cannot_begin_says_what_to_do(tmp_path: Path) -> None:
    code = f"""
import resource
from pathlib import Path
from excite.errors import RowStoreError
from excite.workflows import row_store
resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))
try:
    with row_store.open_store(Path({str(tmp_path / "s")!r}), "f"):
        pass
except RowStoreError as err:
    print(err)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "is the disk full" in said
    assert "repeat the command" in said


@pytest.mark.slow
def test_a_worker_that_dies_costs_nothing_and_a_deadly_piece_is_found(tmp_path: Path) -> None:
    def dies(number: int) -> int:
        """Piece 3 always kills its worker, piece 1 the first one, piece 9 the first two."""
        died = len(list(tmp_path.iterdir()))
        if number == 3 or (number == 1 and died < 1) or (number == 9 and died < 3):
            if number != 3:
                (tmp_path / str(died)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    results = dict(study_workers.compute(dies, range(8), jobs=2))
    chance = dict(study_workers.compute(dies, [9], jobs=2))
    assert results == {k: None if k == 3 else k for k in range(8)}
    assert chance == {9: 9}, "workers that were killed twice from outside are not the fault of what they had alone"


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_are_taken_as_they_are_needed(jobs: int) -> None:
    taken: list[int] = []

    def tasks() -> Iterator[int]:
        for k in range(2000):
            taken.append(k)
            yield k

    results = study_workers.compute(abs, tasks(), jobs)
    for _ in range(10):
        next(results)
    results.close()
    assert len(taken) < 100 * jobs


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_goes_wrong_in_a_task_or_in_taking_one_is_raised(jobs: int) -> None:
    def tasks() -> Iterator[int]:
        yield from range(20)
        raise FolderError("no drive is left")

    with pytest.raises(FolderError, match="no drive is left"):
        list(study_workers.compute(abs, tasks(), jobs))
    with pytest.raises(TypeError, match="bad operand"):
        list(study_workers.compute(abs, iter("ab"), jobs))  # type: ignore[arg-type]


def test_no_cluster_is_said_in_a_line(tiny: Callable[..., StudyPlan], tmp_path: Path, excite: Excite) -> None:
    pytest.importorskip("distributed")
    tiny(2)
    code, _, stderr = excite("study", tmp_path / "tiny.toml", "--cluster", "nonsense://x", "--out", tmp_path / "out")
    assert code == 1
    assert "--cluster nonsense://x: no scheduler" in stderr
    assert stderr.strip().splitlines()[-1].startswith("excite: ")


def test_a_worker_loads_what_it_needs_alone() -> None:
    """SciPy's signal processing and statistics take half a second to load: only where something is filtered."""
    heavy = "('scipy.signal', 'scipy.stats', 'matplotlib')"
    code = f"import sys, excite.workflows.study_runs; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ------------------------------------------------------------------------------------------------ really killed


@pytest.fixture(scope="module")
def snapshot(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment with a copy of the program, so that an edit under way doesn't change it while a study runs."""
    place = tmp_path_factory.mktemp("program")
    for name in ("excite", "model"):
        shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
    return os.environ | {"PYTHONPATH": str(place), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


@pytest.fixture
def attentive() -> Iterator[None]:
    """Ctrl-C is heard, also where the tests run in the background of a shell that has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("attentive")
@pytest.mark.parametrize("lost_as", [None, TypeError("'NoneType' object is not iterable")])
def test_ctrl_c_that_casadi_loses_ends_a_run_all_the_same(
    tiny: Callable[..., StudyPlan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost_as: Exception | None
) -> None:
    """A KeyboardInterrupt within CasADi's calls comes out as another error, or not at all: never a row of the table."""
    plain = study_runs.simulation.measure

    def lost(*given: Any, **more: Any) -> pd.DataFrame:
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        if lost_as is not None:
            raise lost_as
        return plain(*given, **more)

    wanted = tiny(2)
    with monkeypatch.context() as patched:
        patched.setattr(study_runs.simulation, "measure", lost)
        with pytest.raises(KeyboardInterrupt):
            study_runner.run_study(wanted, tmp_path / "out", jobs=1)
    assert kept_rows(tmp_path / "out") == 0
    study_runner.run_study(wanted, tmp_path / "out", jobs=1)
    assert set(pd.read_parquet(tmp_path / "out" / "runs.parquet")["status"]) == {"done"}


NURSERY = '''
"""Forks drivers of a study and kills each at a random time; says what was computed and what was kept."""
import json, os, random, signal, sqlite3, sys, time
from pathlib import Path
from excite.workflows import study_plan, study_runner, study_runs

file, out, seed, kills = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
rng = random.Random(seed)
plain = study_runs.run_once

def logged(run):
    outcome = plain(run)
    handle = os.open("computed", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(handle, f"{run.number}\\n".encode())
    os.close(handle)
    return outcome

study_runs.run_once = logged

def kept():
    try:
        with sqlite3.connect(study_runner.working_folder(out) / "runs.sqlite") as db:
            return [n for (n,) in db.execute("SELECT number FROM runs")]
    except sqlite3.Error:
        return []

wanted = study_plan.read_study(file)
whole, trials, finished = 0.0, [], 0
for name in ("warm", "measure"):  # models are built once, here
    begin = time.perf_counter()
    study_runner.run_study(wanted, Path(name), jobs=1)
    whole = time.perf_counter() - begin
os.unlink("computed")
count = 0
while count < kills:
    pid = os.fork()
    if pid == 0:
        try:
            study_runner.run_study(wanted, out, jobs=1)
            os._exit(0)
        except BaseException as err:
            print(repr(err), file=sys.stderr)
            os._exit(3)
    begin, delay = time.perf_counter(), rng.uniform(0, 0.3 * whole)
    while time.perf_counter() - begin < delay and not out.exists():
        time.sleep(0.002)
    if out.exists():  # faster than before: the machine has less to do
        whole = min(whole, 2 * (time.perf_counter() - begin))
    sent = rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGINT])
    os.kill(pid, sent)
    _, status = os.waitpid(pid, 0)
    killed = os.WIFSIGNALED(status) or os.waitstatus_to_exitcode(status) == 3
    count += killed
    computed = Path("computed").read_text().split() if Path("computed").exists() else []
    trials.append({"killed": killed, "sent": int(sent), "kept": kept(), "computed": [int(n) for n in computed],
                   "there": out.exists()})
    if Path("computed").exists():
        os.unlink("computed")
    if out.exists():  # whole: begin another one
        finished += 1
        out.rename(f"finished{finished}")
    told = {"trials": trials, "whole": whole, "finished": finished}
    Path("told.json").write_text(json.dumps(told))
while not out.exists():
    study_runner.run_study(wanted, out, jobs=1)
'''


@pytest.mark.slow
def test_killed_at_random_times_it_loses_nothing(
    tiny: Callable[..., StudyPlan], tmp_path: Path, snapshot: dict[str, str]
) -> None:
    """Kills (-9, Ctrl-C) of the driver: what was kept stays, is not computed again, and the table is the same."""
    tiny(10)
    (tmp_path / "nursery.py").write_text(NURSERY)
    command = [sys.executable, "nursery.py", "tiny.toml", "out", "7", "25"]
    subprocess.run(command, cwd=tmp_path, env=snapshot, check=True, timeout=3000)
    told = json.loads((tmp_path / "told.json").read_text())
    before: set[int] = set()
    lost = 0
    for trial in told["trials"]:
        now = set(trial["kept"])
        if not trial["there"]:
            assert before <= now, "a row that was kept is gone"
        assert len(trial["computed"]) == len(set(trial["computed"]))
        assert not before & set(trial["computed"]), "a row that was kept was computed again"
        if not trial["there"]:
            lost += len(set(trial["computed"]) - now)
        before = set() if trial["there"] else now
    kills = sum(t["killed"] for t in told["trials"])
    print(f"\n{kills} kills, {told['finished'] + 1} studies finished, {lost} runs of batches under way computed again")
    assert kills >= 20
    reference = (tmp_path / "measure" / "runs.parquet").read_bytes()
    done = [tmp_path / "out", *tmp_path.glob("finished*")]
    assert {(p / "runs.parquet").read_bytes() for p in done} == {reference}
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")], "something is left behind"


def kept_rows(out: Path) -> int:
    try:
        db = sqlite3.connect(f"file:{study_runner.working_folder(out) / 'runs.sqlite'}?mode=ro&immutable=1", uri=True)
        return int(db.execute("SELECT count(*) FROM runs").fetchone()[0])
    except sqlite3.Error:
        return 0


@pytest.mark.slow
def test_a_full_file_system_is_said_and_the_study_goes_on_after(
    tiny: Callable[..., StudyPlan], tmp_path: Path, snapshot: dict[str, str]
) -> None:
    """A real file system of 160 kB: exit 1 with a line that says so; with room again the same command goes on."""
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=160k", "none", str(small)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("needs the right to mount a small file system")
    try:
        tiny(90)
        command = [sys.executable, "-m", "excite", "study", "tiny.toml", "--jobs", "1", "--out", "small/out"]
        full = subprocess.run(command, cwd=tmp_path, env=snapshot, capture_output=True, text=True, timeout=600)
        assert full.returncode == 1, full.stderr
        last = full.stderr.strip().splitlines()[-1]
        assert last.startswith("excite: ")
        assert "repeat the command" in last
        assert "Traceback" not in full.stderr
        assert not (small / "out").exists()
        kept = kept_rows(small / "out")
        subprocess.run(["mount", "-o", "remount,size=20m", str(small)], check=True)
        again = subprocess.run(command, cwd=tmp_path, env=snapshot, capture_output=True, text=True, timeout=600)
        assert again.returncode == 0, again.stderr
        assert f"running: {kept} of 180" in again.stderr
        assert len(pd.read_parquet(small / "out" / "runs.parquet")) == 180
    finally:
        subprocess.run(["umount", "--lazy", str(small)], check=True)


SAME = ("runs.parquet", "study.json", "study.png")  # the report and the summary say how long it took as well


RUNS = 60


class Command:
    """`excite study` on a study of RUNS runs, as a process of its own."""

    def __init__(self, file: Path, out: Path, env: dict[str, str], *options: str) -> None:
        self.out = out
        command = [sys.executable, "-m", "excite", "study", str(file), *options, "--out", str(out)]
        self.run = subprocess.Popen(command, cwd=file.parent, env=env, stderr=subprocess.PIPE, text=True)

    def midway(self, rows: int) -> int:
        """Waits until so many rows are kept; how many there are then.

        The store is locked, so this looks past its lock and may see a batch that is being written: it is kept for sure
        once another one follows."""
        begin = time.monotonic()
        kept, seen = 0, kept_rows(self.out)
        while kept < rows:
            assert self.run.poll() is None, f"ended with {seen} rows, too early to be disturbed"
            assert time.monotonic() - begin < 300
            time.sleep(0.02)
            if (now := kept_rows(self.out)) > seen:
                kept, seen = seen, now
        assert kept < RUNS
        return kept

    def said(self, code: int = 0) -> str:
        """Waits for its end; what it wrote to stderr."""
        _, stderr = self.run.communicate(timeout=600)
        assert self.run.returncode == code, stderr
        assert "Traceback" not in stderr
        return stderr

    def same_as(self, other: Command) -> None:
        """Every run ended alike, then to the last byte."""
        ends = [pd.read_parquet(one.out / "runs.parquet")[["run", "status", "reason"]] for one in (self, other)]
        pd.testing.assert_frame_equal(*ends)
        for name in SAME:
            assert (self.out / name).read_bytes() == (other.out / name).read_bytes(), f"{name} differs"


@pytest.fixture(scope="module")
def whole(
    tmp_path_factory: pytest.TempPathFactory, straight: Model, short: Motion, snapshot: dict[str, str]
) -> Command:
    """The study as one process computes it, undisturbed."""
    place = tmp_path_factory.mktemp("whole")
    profile.profile_of(straight, short).to_csv(place / "drive.csv", index=False)
    (place / "tiny.toml").write_text(TINY.replace("{runs}", str(RUNS // 2)))
    command = Command(place / "tiny.toml", place / "out", snapshot, "--jobs", "1")
    command.said()
    return command


@pytest.fixture
def carried(whole: Command, tmp_path: Path, snapshot: dict[str, str]) -> Iterator[Callable[..., Command]]:
    """Starts the command on the same study."""
    running: list[Command] = []

    def start(*options: str) -> Command:
        running.append(Command(whole.out.parent / "tiny.toml", tmp_path / "out", snapshot, *options))
        return running[-1]

    yield start
    for one in running:
        one.run.kill()
        one.run.wait()


def workers_of(driver: int) -> list[int]:
    """The processes that compute for a driver, the oldest first."""
    children = Path(f"/proc/{driver}/task/{driver}/children").read_text().split()
    return [int(p) for p in children if b"LokyProcess" in Path(f"/proc/{p}/cmdline").read_bytes()]


@pytest.mark.slow
def test_killed_workers_of_this_computer_cost_nothing(whole: Command, carried: Callable[..., Command]) -> None:
    """A worker is killed (-9) under way, later another one."""
    struck = carried("--jobs", "2")
    kept = struck.midway(RUNS // 10)
    os.kill(workers_of(struck.run.pid)[0], signal.SIGKILL)
    struck.midway(kept + RUNS // 10)
    os.kill(workers_of(struck.run.pid)[0], signal.SIGKILL)
    struck.said()
    struck.same_as(whole)


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_done(whole: Command, carried: Callable[..., Command]) -> None:
    """Interrupt of the driver and its workers, as a terminal sends it; then the same command goes on."""
    first = carried("--jobs", "2")
    kept = first.midway(RUNS // 10)
    for process in (*workers_of(first.run.pid), first.run.pid):
        os.kill(process, signal.SIGINT)
    said = first.said(130)
    assert "the same command resumes" in said
    assert "Warning" not in said
    second = carried("--jobs", "2")
    found = re.search(rf"running: (\d+) of {RUNS}", second.said())
    assert found
    assert kept <= int(found[1]) < RUNS
    second.same_as(whole)


class Dask:
    """A real Dask scheduler and its workers, each a process of its own."""

    def __init__(self, place: Path, env: dict[str, str]) -> None:
        self.place, self.env = place, env
        self.started: list[subprocess.Popen[bytes]] = []
        self.scheduler()

    def _start(self, what: str, *args: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *args, "--no-dashboard"]
        quiet = subprocess.DEVNULL
        self.started.append(subprocess.Popen(command, cwd=self.place, env=self.env, stdout=quiet, stderr=quiet))
        return self.started[-1]

    def scheduler(self) -> subprocess.Popen[bytes]:
        file = self.place / "scheduler.json"
        file.unlink(missing_ok=True)
        started = self._start("scheduler", "--port", "0", "--scheduler-file", file.name, "--host", "127.0.0.1")
        begin = time.monotonic()
        # the file is there before it is written
        while not (file.exists() and file.read_text().endswith("}")) and time.monotonic() - begin < 60:
            time.sleep(0.1)
        self.address = str(json.loads(file.read_text())["address"])
        return started

    def worker(self) -> subprocess.Popen[bytes]:
        return self._start("worker", self.address, "--nthreads", "1", "--no-nanny")

    def close(self) -> None:
        for process in self.started:
            process.kill()
            process.wait()


@pytest.fixture
def dask(tmp_path: Path, snapshot: dict[str, str]) -> Iterator[Dask]:
    pytest.importorskip("distributed")
    (tmp_path / "dask").mkdir()
    cluster = Dask(tmp_path / "dask", snapshot)
    yield cluster
    cluster.close()


@pytest.mark.slow
def test_killed_workers_of_a_cluster_cost_nothing(whole: Command, carried: Callable[..., Command], dask: Dask) -> None:
    """Both workers are killed (-9) under way, one after the other, and a third one comes."""
    workers = [dask.worker() for _ in range(2)]
    struck = carried("--cluster", dask.address)
    kept = struck.midway(RUNS // 10)
    workers[0].kill()
    struck.midway(kept + RUNS // 10)
    dask.worker()
    workers[1].kill()
    struck.said()
    struck.same_as(whole)


@pytest.mark.slow
def test_a_killed_scheduler_is_said_and_the_study_goes_on(
    whole: Command, carried: Callable[..., Command], dask: Dask
) -> None:
    """Exit 1 with a line; the same command goes on with another cluster, and again after it is killed (-9) itself."""
    dask.worker()
    first = carried("--cluster", dask.address)
    first.midway(RUNS // 10)
    dask.close()
    last = first.said(1).strip().splitlines()[-1]
    assert last.startswith("excite: ")
    assert "repeat the command" in last
    kept = kept_rows(first.out)
    assert RUNS // 10 <= kept < RUNS
    dask.scheduler()
    dask.worker()
    second = carried("--cluster", dask.address)
    more = second.midway(kept + RUNS // 10)
    second.run.kill()
    assert f"running: {kept} of {RUNS}" in second.said(-signal.SIGKILL)
    third = carried("--cluster", dask.address)
    found = re.search(rf"running: (\d+) of {RUNS}", third.said())
    assert found
    assert more <= int(found[1]) < RUNS
    third.same_as(whole)


@pytest.mark.slow
def test_a_scheduler_that_is_gone_is_said_whatever_is_asked(dask: Dask) -> None:
    """While the client still tries to reach it, and after it gave up."""
    dask.worker()
    for wait in (0, 5):
        results = study_workers.compute(abs, itertools.count(), cluster=dask.address)
        number, value = next(results)  # whichever is ready first
        assert value == number
        dask.close()
        time.sleep(wait)
        with pytest.raises(WorkerError, match="repeat the command"):
            for _ in results:
                pass
        dask.scheduler()
        dask.worker()


@pytest.mark.slow
def test_a_deadly_task_is_found_on_a_cluster(dask: Dask, tmp_path: Path) -> None:
    def dies(number: int) -> int:
        if number == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    for _ in range(10):
        dask.worker()
    results = dict(study_workers.compute(dies, range(20), cluster=dask.address))
    assert results == {k: None if k == 7 else k for k in range(20)}
