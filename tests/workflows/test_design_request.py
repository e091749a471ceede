"""What is asked of a design on the command line, and what is said of the answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import Excite
from support.drives import designed

from excite.errors import DesignFolderError
from excite.logs import profile as profiles
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.simulation import Motion, sensors
from excite.smoothing import cramer_rao
from excite.trajectories import CompositeObjective, Design, compose_objective, saved_design
from excite.workflows import DesignRequest, design_request
from excite.workflows.design_request import POOR_PERCENT, DesignResult, advice


def test_advice_names_what_to_do() -> None:
    assert advice(DesignRequest(), "Kx1", POOR_PERCENT) is None
    text = advice(DesignRequest(), "Kx1", 3 * POOR_PERCENT)
    assert text is not None
    assert "cond(Phi) says nothing of accuracy here: Kx1 can't be found better than 15 %" in text
    assert "170 %" in str(advice(DesignRequest(), "Kx1", 171.0))
    assert "--objective accuracy" in text
    assert "--sigma-max" in text
    for brief in (DesignRequest("accuracy"), DesignRequest("cond", sigma_max=20.0)):
        said = advice(brief, "Kx1", 3 * POOR_PERCENT)
        assert said is not None
        assert "cond(Phi) says nothing" not in said


@pytest.mark.slow
def test_a_design_says_score_and_accuracy(excite: Excite, tmp_path: Path) -> None:
    out = tmp_path / "d"
    code, shown, err = excite(
        "design", "va12_straight", "--duration", 12, "--starts", 1, "--seed", 3, "--out", out, "--json"
    )
    assert code == 0, err
    summary = json.loads(shown)
    found = saved_design.read_design(out)
    spread = 100 * np.sqrt(np.diag(cramer_rao(found.model, found.motion))) / np.abs(found.model.nominal)
    assert list(summary["sigma_percent"].values()) == pytest.approx(spread.tolist(), rel=1e-6)
    assert summary["worst_percent"] == pytest.approx(spread.max(), rel=1e-6)
    assert summary["median_percent"] == pytest.approx(np.median(spread), rel=1e-6)
    assert summary["hides_poor_accuracy"] == (spread.max() > POOR_PERCENT)
    assert (summary["advice"] is not None) == (spread.max() > POOR_PERCENT)


@pytest.mark.slow
def test_a_design_says_how_far_above_the_bound_it_is(excite: Excite, tmp_path: Path) -> None:
    """For a rig with one joint, in summary and report."""
    rig = Path(__file__).parents[1] / "support" / "rig.toml"
    code, shown, err = excite(
        "design", rig, "--starts", 1, "--json", "--objective", "worst", "--out", tmp_path / "worst"
    )
    assert code == 0, err
    summary = json.loads(shown)
    bound = summary["bound"]
    assert bound["attained_percent"] == pytest.approx(summary["worst_percent"])
    assert 0 < bound["gap_percent"] < 5
    assert bound["gap_percent"] == pytest.approx(100 * (bound["attained_percent"] / bound["certified_percent"] - 1))
    assert "No drive of this problem identifies the worst parameter better than" in (
        tmp_path / "worst" / "report.html"
    ).read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_default_is_as_accurate_as_its_best_random_start(excite: Excite, tmp_path: Path) -> None:
    """The other end is beside it, in summary and report."""
    out = tmp_path / "d"
    code, shown, err = excite("design", "va12_straight", "--duration", 12, "--starts", 2, "--out", out, "--json")
    assert code == 0, err
    summary = json.loads(shown)
    assert summary["worst_percent"] <= 1.001 * summary["random_start_percent"]
    other = summary["most_accurate"]
    assert other["cond_phi"] >= summary["lowest_cond"]["cond_phi"] * 0.999
    assert "The other end" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_condition_number_then_accuracy(excite: Excite, tmp_path: Path) -> None:
    """The lowest cond(Phi) first, then the most accurate drive near it; `--cond-slack 0` stops after the first.

    A random start that is still more accurate raises cond(Phi) as far as its accuracy needs.
    """
    options = "va12_straight", "--duration", 12, "--starts", 1, "--seed", 3, "--json"
    told = {}
    for slack in (0, 12):
        code, shown, err = excite("design", *options, "--cond-slack", slack, "--out", tmp_path / str(slack))
        assert code == 0, err
        told[slack] = json.loads(shown)
    lowest = told[12]["lowest_cond"]
    assert "lowest_cond" not in told[0]
    assert lowest["cond_phi"] == pytest.approx(told[0]["cond_phi"], rel=1e-9)
    assert lowest["worst_percent"] == pytest.approx(told[0]["worst_percent"], rel=1e-9)
    near = told[12]["cond_phi"] <= 1.12 * lowest["cond_phi"] * 1.001
    assert near or told[12]["worst_percent"] <= 1.001 * told[12]["random_start_percent"]
    assert told[12]["worst_percent"] < 0.7 * lowest["worst_percent"]
    assert told[12]["max_violation"] <= 1e-3


@pytest.mark.slow
def test_after_a_log_the_next_drive_is_for_the_estimated_machine(
    excite: Excite, straight: Model, straight_motion: Motion, tmp_path: Path
) -> None:
    path, out = tmp_path / "log.csv", tmp_path / "d"
    sensors.measure(straight, straight_motion, seed=5).to_csv(path, index=False)
    code, shown, err = excite(
        "design", "va12_straight", "--after", path, "--duration", 12, "--starts", 1, "--out", out, "--json"
    )
    assert code == 0, err
    summary = json.loads(shown)
    assert summary["after"] == [str(path)]
    found = saved_design.read_design(out)
    assert list(summary["nominal"].values()) == pytest.approx(found.model.nominal.tolist())
    assert not np.array_equal(found.model.nominal, straight.nominal)
    profile, _, _ = profiles.read_profile(out / "profile.csv", found.model)
    assert np.abs(found.motion.nu[-1]).max() < 0.04  # at rest for the machine that the log told of
    assert len(profile) == 1201
    # both drives together: never worse than the one that was there
    before = 100 * np.sqrt(np.diag(cramer_rao(straight, straight_motion))) / np.abs(straight.nominal)
    assert summary["worst_percent"] < 1.1 * before.max()
    code, _, err = excite("verify", out, "--runs", 1)
    assert code == 2
    assert "without --after" in err


@pytest.mark.slow
def test_what_sits_in_a_sensor_is_no_part_of_a_design_that_is_read_back(excite: Excite, tmp_path: Path) -> None:
    """A machine file with a wheel of another radius, a design after a log: its summary tells the radius nothing."""
    own, path, out = tmp_path / "own.toml", tmp_path / "log.csv", tmp_path / "d"
    own.write_text(
        'extends = "va12_straight"\n[[effect]]\nname = "measuring_wheel_radius"\nwhere = "measuring_wheel_left"\n'
        'amount = { value = 0.001, source = "identified" }\n'
    )
    model = build(load_machine(own))
    sensors.measure(model, designed("S40", model), seed=5).to_csv(path, index=False)
    code, _, err = excite("design", own, "--after", path, "--duration", 12, "--starts", 1, "--out", out)
    assert code == 0, err
    assert "measuring_wheel_radius@measuring_wheel_left" in saved_design.read_design(out).model.base.names
    text = json.loads((out / "summary.json").read_text())
    (out / "summary.json").write_text(json.dumps(text | {"duration_s": None}))
    with pytest.raises(DesignFolderError, match="damaged, design again"):
        saved_design.read_design(out)


def test_sensors_of_unknown_noise_are_named(excite: Excite, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    number = 'source = "assumed"'
    problem = (
        f'extends = "emps"\n[problems.P]\n{number}\nduration_s = {{ value = 10, {number} }}\n'
        f"knot_s = {{ value = 0.1, {number} }}\nlane_m = [1, 1]\nlane_points = []\n"
    )
    path.write_text(problem, encoding="utf-8")
    code, _, err = excite("design", path, "--problem", "P", "--out", tmp_path / "d")
    assert code == 2
    assert "sensor q1: give noise or counts_per_turn" in err
    assert not (tmp_path / "d").exists()


def test_an_accuracy_must_be_positive(excite: Excite) -> None:
    code, _, err = excite("design", "va12_straight", "--sigma-max", 0)
    assert code == 2
    assert "--sigma-max: must be > 0 %" in err


def drive(cond: float, worst: float, **more: Any) -> Design:
    """A design whose drive is its name for `ends`: cond(Phi) and the worst parameter [%]."""
    return Design("cond", (cond, worst), None, cond, cond, 99.0, {}, 0.0, (cond,), True, **more)  # type: ignore[arg-type]


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch, straight: Model) -> Callable[..., tuple[DesignResult, list[Any]]]:
    """The second step of a design, from the searches' answers by what they are bounded by; and the searches made."""
    monkeypatch.setattr(design_request._NearSearch, "worst", lambda self, made: made[1])

    def make(answers: dict[str, Design], **more: Any) -> tuple[DesignResult, list[Any]]:
        made = []

        def search(model: Model, problem: Any, aim: CompositeObjective, *args: Any) -> Design:
            made.append((aim.name, aim.sigma_max, args[4]))
            return answers[aim.name]

        monkeypatch.setattr(design_request, "design_drive", search)
        lowest = drive(20.0, 8.0, random=((200.0, 3.0),), **more)
        near = design_request._NearSearch(straight, None, DesignRequest(), None, None, None, lowest.stopped)  # type: ignore[arg-type]
        return design_request._make_accurate(near, compose_objective(straight, "cond"), lowest), made

    return make


def test_the_drive_near_the_lowest_cond_is_taken_if_no_random_start_is_more_accurate(ends: Any) -> None:
    found, made = ends({"worst": drive(22.0, 2.0), "accuracy": drive(90.0, 0.9)})
    assert (found.design.cond_phi, found.first.cond_phi, found.accurate.cond_phi) == (22.0, 20.0, 90.0)
    assert [name for name, _, _ in made] == ["worst", "accuracy"]


def test_cond_grows_as_far_as_it_takes_to_beat_the_best_random_start(ends: Any) -> None:
    """From the drive for accuracy, which is as accurate already: so there is an answer."""
    found, made = ends({"worst": drive(22.0, 4.0), "accuracy": drive(90.0, 0.9), "cond": drive(35.0, 2.9)})
    assert found.design.cond_phi == 35.0
    assert made[-1] == ("cond", 3.0, [(22.0, 4.0), (90.0, 0.9)])


@pytest.mark.parametrize("first", [True, False])
def test_no_search_begins_after_ctrl_c(ends: Any, first: bool) -> None:
    found, made = ends({"worst": drive(22.0, 4.0, stopped=True)}, stopped=first)
    assert [name for name, _, _ in made] == ([] if first else ["worst"])
    assert found.design.cond_phi == (20.0 if first else 22.0)
    assert not found.design.complete
