"""Any drive judged as a design is: the same figures, limits broken by known amounts, drives that show nothing."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

import excite as program
from excite.errors import LogError
from excite.logs import is_profile, profile_of, read_drive
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.simulation import Motion, simulate
from excite.trajectories import check_limits, describe_excess, excesses_in_units, prediction_contrasts, score
from excite.trajectories.multistart import no_drive_yet
from excite.workflows import DesignRequest, read_rivals, read_study
from excite.workflows.design_request import contrasts

RESULTS = Path(__file__).parents[2] / "results"


def pulses(seconds: float, *tops: float) -> np.ndarray:
    """Torques (N, n_u) at 100 Hz of two smooth pulses forward and back, so that the machine comes to rest."""
    share = np.arange(round(100 * seconds) + 1) / (100 * seconds)
    return np.outer(np.sin(2 * np.pi * share) ** 3, tops)


def table_of(model: Model, torque: np.ndarray, every: int = 1) -> pd.DataFrame:
    columns = {f"{name}_Nm": x for name, x in zip(model.inputs, torque.T, strict=True)}
    return pd.DataFrame({"t_s": np.arange(len(torque)) / 100, **columns})[::every]


@pytest.mark.parametrize("name", [pytest.param("R60", marks=pytest.mark.slow), "S40"])
def test_a_design_scores_as_its_summary_says(excite: Excite, tmp_path: Path, name: str) -> None:
    design = RESULTS / name / "design"
    said = json.loads((design / "summary.json").read_text())
    code, stdout, _ = excite("score", said["machine"], design / "profile.csv", "--json", "--out", tmp_path / "s")
    assert code == 0
    found = json.loads(stdout)
    for key in ("cond_phi", "cond_w"):
        assert found[key] == pytest.approx(said[key], rel=1e-6), key
    for key in ("worst_percent", "median_percent", "sigma_percent"):  # of the bound, by derivatives near these then
        assert found[key] == pytest.approx(said[key], rel=1e-2), key
    assert found["max_violation"] == pytest.approx(said["max_violation"], abs=1e-9)
    assert found["share_outside_law"] == 0
    assert json.loads((tmp_path / "s" / "summary.json").read_text()) == found


def test_a_score_can_be_verified(excite: Excite, tmp_path: Path) -> None:
    profile = RESULTS / "S40" / "design" / "profile.csv"
    assert excite("score", "va12_straight", profile, "--out", tmp_path / "s")[0] == 0
    code, stdout, _ = excite(
        "verify", tmp_path / "s", "--runs", 2, "--method", "ols", "--json", "--out", tmp_path / "v"
    )
    assert code == 0
    assert json.loads(stdout)["problem"] == "S40"


def test_a_broken_limit_is_measured_in_its_range(excite: Excite, straight: Model, tmp_path: Path) -> None:
    torque = pulses(40, 0, 0)
    torque[1000:1400] = np.interp(np.arange(400), [0, 100, 300, 399], [0, 6000, 6000, 0])[:, None]
    table_of(straight, torque).to_csv(tmp_path / "p.csv", index=False)
    found = program.score("va12_straight", tmp_path / "p.csv")
    assert found.violations["torque u1"] == pytest.approx(0.1)  # (6000 - 5000) / 10000
    assert found.violations["torque rate u1"] == 0
    assert found.violations["duration"] == 0
    top = 0.65 * np.abs(found.motion.nu[:, 1]).max()
    assert found.violations["rim speed front_roll"] == pytest.approx(max(0.0, top - 2) / 4)
    assert found.max_violation == max(found.violations.values())
    code, stdout, _ = excite("score", "va12_straight", tmp_path / "p.csv", "--out", tmp_path / "s")
    assert code == 0
    assert "limits broken:" in stdout.splitlines()[1]
    asked = ("simulate", "va12_straight", tmp_path / "p.csv", "--out", tmp_path / "log.csv")
    _, stdout, _ = excite(*asked)
    assert re.match(r"limits broken: x0 still moves at [\d.]+ m/s at the end; theta", stdout.splitlines()[1])
    told = json.loads(excite(*asked, "--json")[1])["violations"]
    assert told == pytest.approx({name: v for name, v in found.violations.items() if name != "duration"})


def test_a_drive_that_is_too_short_breaks_the_duration(straight: Model) -> None:
    problem = straight.machine.problems["S40"]
    found = score(straight, problem, pulses(10, 1500, 1500))
    assert found.violations["duration"] == pytest.approx(0.75)
    assert np.isfinite(found.cond_phi)


def test_a_drive_of_another_length_is_said_so_and_judged_by_its_own_on_request(excite: Excite, tmp_path: Path) -> None:
    rig = str(Path(__file__).parents[1] / "support" / "rig.toml")
    table_of(build(load_machine(rig)), pulses(4, 60)).rename(columns={"u1_Nm": "u1_N"}).to_csv(tmp_path / "p.csv")
    asked = ("score", rig, tmp_path / "p.csv", "--out", tmp_path / "s")
    _, stdout, _ = excite(*asked)
    assert "it lasts 4 s, and the problem asks for 10 s" in stdout.splitlines()[1]
    assert "`--duration 4` judges it" in stdout
    _, stdout, _ = excite(*asked, "--duration", 4)
    assert "it lasts" not in stdout
    code, _, err = excite(*asked, "--duration", 0.1)
    assert (code, "--duration: must be between" in err) == (2, True)


def test_rest_is_missed_by_a_speed_at_either_end(straight: Model) -> None:
    problem = straight.machine.problems["S40"]
    motion = simulate(straight, pulses(10, 1500, 1500)[:300])
    over = check_limits(straight, problem, motion)
    v, w = (f"{motion.nu[-1, k]:.3g}" for k in (0, 1))
    said = excesses_in_units(straight, problem, motion, over)
    assert said["rest x0'"] == f"x0 still moves at {v} m/s at the end"
    assert said["rest theta1'"] == f"theta1 still moves at {w} rad/s at the end"
    backward = replace(motion, nu=motion.nu[::-1], q=motion.q[::-1])
    assert excesses_in_units(straight, problem, backward, over)["rest x0'"] == f"x0 moves at {v} m/s at the start"
    assert describe_excess(straight, "torque u1", 0.1) == "torque u1 is exceeded by 10.00 % of its range"
    assert no_drive_yet(straight, over).endswith((f"{v} m/s at the end", f"{w} rad/s at the end"))


def test_the_folder_of_a_drive_is_taken_as_the_drive(
    excite: Excite, straight: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("campaign") / "drive-1"
    folder.mkdir(parents=True)
    table_of(straight, pulses(3, 1500, 1500)).to_csv(folder / "profile.csv", index=False)
    file = read_drive(folder / "profile.csv", straight)
    np.testing.assert_array_equal(read_drive(folder, straight).torque, file.torque)
    assert is_profile(folder, straight)
    usual, own = read_rivals(["chirp", str(folder)], straight, straight.machine.problems["S40"])
    assert (usual, list(own)) == (("chirp",), ["drive-1"])
    assert contrasts(straight, DesignRequest("prediction", of=folder)) is not None
    assert excite("score", "va12_straight", folder, "--out", "s")[0] == 0
    assert excite("simulate", "va12_straight", folder, "--out", "log.csv")[0] == 0
    Path("study.toml").write_text(
        'name = "s"\nruns = 1\n[[grid]]\nmachine = "va12_straight"\nprofile = "campaign/drive-1"\n'
    )
    assert read_study("study.toml").fingerprint

    def refusal(*arguments: object) -> str:
        code, _, err = excite(*arguments)
        assert code == 2
        assert err.count("\n") == 1
        return err

    assert "is what the log is made from" in refusal(
        "simulate", "va12_straight", folder, "--out", folder / "profile.csv"
    )
    for asked in (("score", "va12_straight", "campaign"), ("verify", "campaign"), ("drive", "campaign")):
        assert f"has no profile.csv, but folders with one: give one of them, such as {folder}" in refusal(*asked)
    assert "`excite score MACHINE profile.csv` makes one of any drive" in refusal("verify", folder / "profile.csv")
    assert "is the folder of a drive, no log" in refusal("identify", "va12_straight", folder)


def test_torques_of_a_rig_along_a_drive_can_be_what_is_predicted() -> None:
    """Contrasts are the columns of the regressor at the samples, in reference values over the torque's rms."""
    rig = build(load_machine(str(Path(__file__).parents[1] / "support" / "rig.toml")))
    motion = simulate(rig, pulses(2, 60))
    found = prediction_contrasts(rig, motion)
    at = np.unique(np.linspace(0, len(motion.t) - 1, 51).round().astype(int))[1:]
    W = rig.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T)[at, 0] * np.append(rig.nominal[:3], 0)
    np.testing.assert_allclose(found, W.T / np.sqrt(np.mean(motion.u**2)))


def test_a_drive_without_excitation_shows_nothing(excite: Excite, straight: Model, tmp_path: Path) -> None:
    table_of(straight, pulses(40, 0, 0)).to_csv(tmp_path / "p.csv", index=False)
    code, stdout, _ = excite("score", "va12_straight", tmp_path / "p.csv", "--out", tmp_path / "s")
    assert code == 0
    assert "do not show" in stdout.splitlines()[1]
    assert "every limit is kept" in stdout.splitlines()[1]
    assert "Condition number of Phi infinite" in stdout
    found = json.loads((tmp_path / "s" / "summary.json").read_text())
    assert found["cond_phi"] is None
    assert found["sigma_percent"]["M"] > 100


def test_rows_at_another_rate_are_knots(straight: Model, tmp_path: Path) -> None:
    """Torques are linear between the rows, whatever their distance."""
    knots = pulses(40, 2000, 1500)[::20]
    torque = np.column_stack([np.interp(np.arange(4001) / 20, np.arange(201), x) for x in knots.T])
    table_of(straight, torque).to_csv(tmp_path / "fine.csv", index=False)
    table_of(straight, torque, every=20).to_csv(tmp_path / "knots.csv", index=False)
    fine, coarse = (program.score("va12_straight", tmp_path / f"{name}.csv") for name in ("fine", "knots"))
    np.testing.assert_allclose(coarse.motion.u, fine.motion.u, atol=1e-9)
    assert coarse.cond_phi == pytest.approx(fine.cond_phi, rel=1e-9)


def test_a_drive_is_placed_on_the_lane_unless_it_says_where(va12: Model, va12_motion: Motion, tmp_path: Path) -> None:
    table = profile_of(va12, va12_motion)
    table["x0_m"] += 30
    table.to_csv(tmp_path / "told.csv", index=False)
    table.iloc[:, :4].to_csv(tmp_path / "free.csv", index=False)
    told, free = (program.score("va12", tmp_path / f"{name}.csv") for name in ("told", "free"))
    assert told.motion.q[0, 0] == 30
    assert told.violations["lane x front_chassis"] > 0.1
    lanes = [name for name in free.violations if name.startswith("lane")]
    assert sum(free.violations[n] for n in lanes) < sum(told.violations[n] for n in lanes)
    assert free.cond_phi == pytest.approx(told.cond_phi, rel=1e-6)


BAD = {
    "motion alone": (lambda t: t.drop(columns=["u1_Nm", "u4_Nm"]), "has a motion (x0_m) but no torques"),
    "a torque is missing": (lambda t: t.drop(columns=["u4_Nm"]), "no column u4_Nm"),
    "another machine's": (lambda t: t.rename(columns={"u1_Nm": "u2_Nm"}), "no column u1_Nm"),
    "a word": (lambda t: t.astype(object).replace({0.0: "x"}), "is 'x', not a finite number"),
    "milliseconds": (lambda t: t.assign(t_s=1000 * t.t_s), "is the time in seconds?"),
    "microseconds too few": (lambda t: t.assign(t_s=1e-6 * t.t_s), "is the time in seconds?"),
    "time goes back": (lambda t: t.assign(t_s=-t.t_s), "time goes back"),
    "a gap": (lambda t: t.drop(index=range(10, 60)), "a gap of 0.51 s"),
    "one row": (lambda t: t[:1], "only 1 row"),
    "kilonewtons": (lambda t: t.assign(u1_Nm=1e6 * t.u1_Nm), "is the unit right?"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_profile_is_refused_in_one_line(
    excite: Excite, straight: Model, straight_motion: Motion, tmp_path: Path, case: str
) -> None:
    spoil, message = BAD[case]
    spoil(profile_of(straight, straight_motion)).to_csv(tmp_path / "p.csv", index=False)
    code, stdout, stderr = excite("score", "va12_straight", tmp_path / "p.csv", "--out", tmp_path / "s")
    assert (code, stdout) == (2, "")
    assert stderr.count("\n") == 1
    assert message in stderr
    assert not (tmp_path / "s").exists()
    with pytest.raises(LogError):
        read_drive(tmp_path / "p.csv", straight)


def test_wrong_names_are_refused(excite: Excite, tmp_path: Path) -> None:
    profile = RESULTS / "S40" / "design" / "profile.csv"
    for asked in (
        ("score", "va12_straight", profile, "--problem", "R61"),
        ("score", "va12_straight", tmp_path / "none.csv"),
        ("compare", "va12_straight", "--against", "none.csv"),
        ("compare", "va12_straight", "--against", "sines"),
    ):
        code, _, stderr = excite(*asked, "--out", tmp_path / "s")
        assert code == 2, asked
        assert stderr.count("\n") == 1


@pytest.mark.slow
def test_a_drive_of_ones_own_is_a_row_of_the_comparison(straight: Model, tmp_path: Path, excite: Excite) -> None:
    table_of(straight, pulses(40, 2000, 1800)).to_csv(tmp_path / "my.csv", index=False)
    own = program.score("va12_straight", tmp_path / "my.csv")
    asked = ("compare", "va12_straight", "--against", tmp_path / "my.csv", "--budget", 20)
    code, stdout, _ = excite(*asked, "--out", tmp_path / "c")
    assert code == 0
    assert "my.csv has" in stdout.splitlines()[1]
    designed, mine = json.loads((tmp_path / "c" / "summary.json").read_text())["designs"]
    assert (designed["name"], mine["name"]) == ("designed", "my.csv")
    assert mine["cond_phi"] == pytest.approx(own.cond_phi, rel=1e-9)
    assert mine["worst_std_percent"] == pytest.approx(own.worst_percent, rel=1e-9)
    assert mine["max_violation"] == pytest.approx(own.max_violation)
    assert mine["breaks"] == max(own.violations, key=lambda n: own.violations[n])
    again = program.score("va12_straight", tmp_path / "c" / designed["knots"])
    assert designed["cond_phi"] == pytest.approx(again.cond_phi, rel=1e-4)
