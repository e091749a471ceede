"""Results in Python: printed as their command prints them, with units, saved as the files of the command."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import markupsafe
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from support.commands import Excite
from support.drives import drive

import excite as ex
from excite import calls, trajectories, workflows
from excite.errors import FolderError, UsageError
from excite.model import Model
from excite.reports import Shown, ShownDesign, describe
from excite.simulation import Motion
from excite.workflows.design_request import DesignResult

NOT_COMPARED = ("versions", "wall_s", "command")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("results")


@pytest.fixture(scope="module")
def results(straight: Model, place: Path) -> dict[str, Shown]:
    """A result of each function, made from files where it takes files; the log is place/log.csv."""
    torque = drive(straight, 10, 1, {"u1": 1200, "u4": 1200})
    ex.simulate(straight, torque, seed=1).to_csv(place / "log.csv", index=False)
    scored = ex.score(straight, torque)
    scored.save(place / "driven")
    log = ex.read_log(straight, place / "log.csv")
    estimate = ex.identify(straight, place / "log.csv", "ols")
    return {
        "log": log,
        "score": ex.score("va12_straight", place / "driven" / "profile.csv"),
        "identify": estimate,
        "predict": ex.predict(straight, estimate, place / "log.csv"),
        "verify": ex.verify(straight, place / "driven", runs=2, method="ols"),
    }


@pytest.fixture(scope="module")
def designed(straight: Model, straight_motion: Motion) -> ShownDesign:
    """A drive put together as a design is, without a search."""
    problem = straight.machine.problems["S40"]
    t = trajectories.excitation.knot_times(problem)
    torque = np.column_stack([np.interp(t, straight_motion.t, u) for u in straight_motion.u.T])
    motion, violations = straight_motion, trajectories.check_limits(straight, problem, straight_motion)
    plain = trajectories.Design(
        "cond", trajectories.Manoeuvre(t, torque), motion, 99.0, 999.0, 150.0, dict(violations), 0.0, (99.0,), True
    )
    found = DesignResult(straight, trajectories.compose_objective(straight, "cond"), plain)
    request = workflows.DesignRequest("cond", starts=1)
    return ShownDesign.of(plain, lambda: workflows.design_account(found, "S40", problem, request, 1.0))


KINDS = "log score identify predict verify".split()


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_prints_and_draws_itself(results: dict[str, Shown], kind: str) -> None:
    one = results[kind]
    text, page = repr(one), one._repr_html_()
    assert str(one) == text
    assert page is not None
    assert "array(" not in text
    assert len(text.splitlines()) < 60
    for table in one.description.tables:
        for cell in (*table.columns, *(c for row in table.rows for c in row)):
            assert cell in text
            assert f">{cell}<" in page.replace("&#39;", "'")
    assert isinstance(one.plot(), Figure)
    with pytest.raises(UsageError, match="nonsense is unknown, allowed: "):
        one.plot("nonsense")


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_as_a_table_have_units(results: dict[str, Shown], kind: str) -> None:
    table = results[kind].to_frame()
    assert isinstance(table, pd.DataFrame)
    units = table.attrs["units"]
    assert set(units) <= {*map(str, table.columns), *map(str, table.index)}
    if kind in ("log", "predict"):
        assert set(units) == set(table.columns)
        assert (units["t_s"], units["u1_Nm"]) == ("s", "N m")
    if kind in ("identify", "verify"):
        assert set(table.index) <= set(units)
        assert (units["M"], units["std_percent"]) == ("kg", "%")


def test_the_table_of_a_log_is_a_log(straight: Model, results: dict[str, Shown]) -> None:
    again = ex.identify(straight, results["log"].to_frame(), "ols")
    assert again.value == pytest.approx(results["identify"].value)  # type: ignore[attr-defined]


def test_a_parameter_is_taken_by_its_name(results: dict[str, Shown]) -> None:
    estimate: Any = results["identify"]
    assert estimate["M"]["value"] == estimate.value[estimate.names.index("M")]
    with pytest.raises(UsageError, match="estimate: mass is unknown, allowed: M, "):
        estimate["mass"]


def test_a_model_prints_its_parameters(straight: Model) -> None:
    head, names, *rows = str(straight).splitlines()
    assert head == straight.machine.title
    assert names.split()[:3] == ["parameter", "value", "unit"]
    assert [row.split()[0] for row in rows] == list(straight.base.names)
    assert len(repr(straight)) < 120


def test_the_table_of_a_drive_is_a_drive(straight: Model, designed: ShownDesign) -> None:
    by_table = ex.simulate(straight, designed.to_frame(), seed=1)
    pd.testing.assert_frame_equal(by_table, ex.simulate(straight, designed.motion, seed=1), rtol=1e-5, atol=1e-5)


COMMANDS: dict[str, Callable[[Path], tuple[object, ...]]] = {
    "log": lambda p: ("log", "check", p / "log.csv", "--machine", "va12_straight"),
    "score": lambda p: ("score", "va12_straight", p / "driven" / "profile.csv"),
    "identify": lambda p: ("identify", "va12_straight", p / "log.csv", "--method", "ols"),
    "verify": lambda p: ("verify", p / "driven", "--runs", 2, "--method", "ols"),
}


CALLS = {
    "log": 'excite.read_log("va12_straight", "{}/log.csv")',
    "score": 'excite.score("va12_straight", "{}/driven/profile.csv")',
    "identify": 'excite.identify("va12_straight", "{}/log.csv", method="ols")',
    "verify": 'excite.verify("va12_straight", "{}/driven", runs=2, method="ols")',
}


@pytest.mark.parametrize("kind", COMMANDS)
def test_a_saved_result_is_the_folder_of_the_command(
    results: dict[str, Shown], place: Path, excite: Excite, tmp_path: Path, kind: str
) -> None:
    out = results[kind].save(tmp_path / "by_python")
    code, shown, said = excite(*COMMANDS[kind](place), "--out", tmp_path / "by_command")
    assert code == 0, said
    own, others = ({f.name: f for f in (tmp_path / n).iterdir()} for n in ("by_python", "by_command"))
    assert out == tmp_path / "by_python"
    assert set(own) == set(others)
    first, second = (json.loads(n["summary.json"].read_text()) for n in (own, others))
    assert {k: v for k, v in first.items() if k not in NOT_COMPARED and k != "problem"} == {
        k: v for k, v in second.items() if k not in NOT_COMPARED and k != "problem"
    }
    printed = [line.strip() for line in repr(results[kind]).splitlines()]
    assert printed == [line.strip() for line in shown.splitlines()][: len(printed)]
    assert first["command"] == CALLS[kind].format(place)
    assert f"<code>{markupsafe.escape(first['command'])}</code>" in own["report.html"].read_text()
    for name in set(own) - {"summary.json", "report.html"}:
        assert own[name].read_bytes() == others[name].read_bytes(), name


def test_errors_name_arguments_and_commands_keep_their_options(straight: Model) -> None:
    with pytest.raises(UsageError, match=r"^duration: must be between .* \(got -5\)$"):
        ex.score(straight, np.zeros((10, 2)), duration=-5)
    with pytest.raises(UsageError, match=r"^objective prediction: needs of=PROFILE.csv, the drive to predict$"):
        ex.design(straight, objective="prediction")
    assert (
        calls.name_arguments("--sigma-max 5: see `excite design --help`") == "sigma_max 5: see `excite design --help`"
    )


def test_a_call_is_recorded_as_it_is_typed(straight: Model) -> None:
    """Arguments without a text stand by their names, defaults are left out."""
    table, own = pd.DataFrame(), replace(straight, machine=straight.machine.model_copy(update={"name": "mine"}))
    told = calls.format_call(ex.simulate, (own, table), {"effects": ["ground_slope=0.01"], "seed": 0, "noise": False})
    assert told == 'excite.simulate(machine, drive, noise=False, effects=["ground_slope=0.01"])'
    assert calls.format_call(ex.campaign, ("emps", {"M": 0.5}), {}) == 'excite.campaign("emps", {"M": 0.5})'


def test_joints_and_accuracy_of_a_drive_are_tables(designed: ShownDesign) -> None:
    joints, sigma = designed.joints, designed.sigma
    assert list(joints["front_roll"]) == ["torque", "angle", "speed"]
    assert joints["front_roll"]["torque"].to_numpy() == pytest.approx(designed.motion.u[:, 0])
    turned = np.gradient(joints["rear_roll"]["angle"], joints.index)
    assert joints["rear_roll"]["speed"].to_numpy()[5:-5] == pytest.approx(turned[5:-5], abs=0.02)
    assert joints.attrs["units"]["front_roll", "torque"] == "N m"
    assert dict(sigma["std_percent"]) == designed.summary["sigma_percent"]


def test_a_design_shows_and_saves_itself(designed: ShownDesign, tmp_path: Path) -> None:
    assert "ZZ1" in repr(designed)
    assert "identify every parameter to" in repr(designed)
    table = designed.to_frame()
    assert [*table.attrs["units"].values()] == "s,N m,N m,m,rad,rad,m/s,rad/s,rad/s".split(",")
    assert list(table.attrs["units"]) == list(table.columns)
    assert isinstance(designed.plot("sigma"), Figure)
    designed.save(tmp_path / "d")
    made = trajectories.read_design(tmp_path / "d")
    assert made.motion.u == pytest.approx(designed.motion.u)
    with pytest.raises(FolderError, match="is a file"):
        designed.save(tmp_path / "d" / "profile.csv")


def test_a_changed_result_is_its_values_only(results: dict[str, Shown]) -> None:
    """It has no account, as that of the old one would be false."""
    changed = replace(results["identify"], value=np.zeros(11))  # type: ignore[type-var]
    assert repr(changed).startswith("ShownEstimate(method='ols'")
    assert changed._repr_html_() is None
    with pytest.raises(UsageError, match="changed or made by hand"):
        changed.save("nowhere")


def test_a_result_passes_between_processes(results: dict[str, Shown]) -> None:
    for one in results.values():
        assert repr(pickle.loads(pickle.dumps(one))) == repr(one)


def test_an_invalid_estimate_prints_no_numbers(results: dict[str, Shown]) -> None:
    account = results["identify"].account
    wrong = account.summary | {"status": "invalid", "doubt": "nothing fits", "notes": []}
    shown = type(results["identify"]).of(results["identify"], lambda: replace(account, summary=wrong))
    assert repr(shown).splitlines()[1].startswith("No estimate from one log")
    assert "ZZ1" not in repr(shown)
    assert "ZZ1" not in (shown._repr_html_() or "")


def test_the_account_is_made_when_asked_for_and_once(results: dict[str, Shown]) -> None:
    seen = SimpleNamespace(n=0)

    def account() -> object:
        seen.n += 1
        return results["identify"].account

    one = type(results["identify"]).of(results["identify"], account)  # type: ignore[arg-type]
    assert seen.n == 0
    assert repr(one) == repr(one)
    assert seen.n == 1


def test_importing_is_lazy() -> None:
    heavy = ("numpy", "pandas", "casadi", "matplotlib", "rich")
    code = f"import sys, excite; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({}, "doubtful, values may be off by more than their intervals say; `excite diagnose` looks for the cause."),
        ({"status": "valid"}, "valid, the 95 % intervals hold; every parameter is known to "),
        ({"status": "valid", "unidentifiable": ["Q"]}, "valid except for Q;"),
        ({"status": "invalid"}, "there is no estimate"),
    ],
)
def test_an_estimate_ends_with_a_verdict(results: dict[str, Shown], change: dict[str, object], verdict: str) -> None:
    one = results["identify"]
    if not change:
        assert repr(one).splitlines()[-1].startswith(f"Verdict: {verdict}")
        assert "Verdict: " in (one._repr_html_() or "")
    possible = {n: r | {"possible": True} for n, r in one.summary["parameters"].items()}
    assert describe("identify", one.summary | {"parameters": possible} | change).verdict.startswith(verdict)


def test_a_verification_ends_with_a_verdict(results: dict[str, Shown]) -> None:
    """Intervals that miss too often for chance are named; those of a biased parameter too."""
    summary = results["verify"].summary | {"runs": 50, "failed": 0, "biased": []}
    held = {n: r | {"coverage95": 0.94, "rms_percent": 3.0} for n, r in summary["parameters"].items()}
    fine = describe("verify", summary | {"parameters": held})
    assert fine.verdict.startswith("the drive shows every parameter to 3 % or better, and the 95 % intervals hold")
    missed = held | {"M": held["M"] | {"coverage95": 0.7}}
    wrong = describe("verify", summary | {"parameters": missed, "biased": ["Fs1"]})
    assert wrong.verdict.endswith("but the 95 % intervals of Fs1, M do not hold.")
    assert "test day tells." in describe("verify", summary | {"parameters": held, "runs": 1}).verdict
