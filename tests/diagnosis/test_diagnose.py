"""`excite diagnose` as people and scripts use it: what it says and leaves behind, what its machine file is good for."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from support.commands import Excite
from support.drives import designed, gentle, held_straight
from support.logs import calm, logged, make_log, slope

from excite import diagnosis as package, smoothing
from excite.diagnosis import (
    RivalPair,
    diagnosis,
    findings,
    fits,
    hold_out,
    magnitude_interval,
    residual_tests,
    residuals,
    run_forked,
    selection,
)
from excite.diagnosis.parallel import run_in_turn
from excite.identification import needed_sensors
from excite.logs import log, prepare, profile
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.model.machine import EffectEntry, Quantity, machine
from excite.reports import diagnosis_figures
from excite.simulation import Motion, sensors, simulate
from excite.smoothing import ACCEPTABLE_STEP, Fit, Settings
from excite.workflows import diagnose_workflow


@pytest.mark.slow
def test_a_log_too_short_to_hide_stretches_has_no_gain(
    straight: Model, straight_motion: Motion, tmp_path: Path, excite: Excite
) -> None:
    """Stretches are hidden from a fit where there are five seconds or more."""
    whole = logged(straight, straight_motion, tmp_path / "whole.csv", 7)
    pd.read_csv(whole).iloc[:461].to_csv(tmp_path / "short.csv", index=False)
    code, stdout, stderr = excite(
        "diagnose", "va12_straight", tmp_path / "short.csv", "--out", tmp_path / "d", "--json"
    )
    assert (code, stderr) == (0, "")
    said = json.loads(stdout)
    assert (said["verdict"], said["error_before_percent"], said["gain_percent"]) == ("clean", None, None)


def test_short_logs_are_hidden_in_turn(straight: Model, straight_motion: Motion) -> None:
    """Forty seconds in six stretches and then in those beside them, so that noise is a small part of a gain."""
    one = make_log(straight, straight_motion, seed=3)
    found = hold_out.hold_out_errors(fits.fit_machine(straight.machine, [one], straight.machine.filter))
    assert found is not None
    assert len(found.squares) >= 3 * 6 - 1
    assert found.counts.sum() == pytest.approx(len(found.squares) * 200 * len(found.sensors), rel=0.05)


def test_a_gain_is_of_the_stretches_that_both_models_foretell() -> None:
    """One of the turns in which a short log is hidden may leave no fit."""

    def errs(by: float, *turns: int) -> hold_out.HoldOutErrors:
        ones, count = np.ones((len(turns), 1)), len(turns)
        each = (np.array(turns) + 1) ** 2
        return hold_out.HoldOutErrors(
            (("u1", "N m"),),
            by * ones * each[:, None],
            np.ones((count, 1), int),
            np.ones(1),
            np.ones(1),
            np.array(turns),
            np.zeros((count, 1)),
        )

    made = hold_out.hold_out_gain(errs(4.0, 0, 0, 1), errs(1.0, 1, 2, 2))
    assert made is not None
    assert (made.before, made.percent) == (pytest.approx(400.0), pytest.approx(50.0))
    assert hold_out.hold_out_gain(errs(4.0, 0), errs(1.0, 1)) is None
    assert hold_out.hold_out_gain(None, errs(1.0, 1)) is None


def test_one_stretch_tells_no_interval() -> None:
    def errs(by: float) -> hold_out.HoldOutErrors:
        return hold_out.HoldOutErrors(
            (("u1", "N m"),), np.array([[by]]), np.array([[1]]), np.ones(1), np.ones(1), np.zeros(1), np.zeros((1, 1))
        )

    made = hold_out.hold_out_gain(errs(4.0), errs(1.0))
    assert made is not None
    assert (made.percent, made.interval) == (pytest.approx(50.0), None)


@pytest.mark.slow
def test_a_slope_from_log_to_extended_machine(
    sloping: Path, straight: Model, straight_motion: Motion, tmp_path: Path, excite: Excite
) -> None:
    """Found, named, its amount within its interval, most of the error gone on stretches not fitted on; and the machine
    file that comes out predicts a drive which the shipped machine does not."""
    out = tmp_path / "d"
    code, stdout, stderr = excite("diagnose", "va12_straight", sloping, "--out", out, "--json")
    assert (code, stderr) == (0, "")
    said = json.loads(stdout)
    assert said == json.loads((out / "summary.json").read_text())
    assert said["verdict"] == "named"
    assert said["separating_run"] is None
    (found,) = said["findings"]
    assert (found["effect"], found["where"], found["unit"], found["tied_with"]) == (
        "ground_slope",
        "machine",
        "rad",
        [],
    )
    assert abs(found["amount"] - 0.01) < 3 * found["amount_std"]
    assert found["p_value"] < 1e-6
    assert found["gain_ci95"][0] > 50
    assert said["error_after_percent"] < 0.3 * said["error_before_percent"]
    assert said["signals"]["thetal"]["systematic_before_percent"] > 50
    assert said["signals"]["thetal"]["systematic_after_percent"] == 0
    assert {"misfit.png", "signals.png", "when.png", "report.html", "machine.toml"} < {p.name for p in out.iterdir()}

    extended = prediction.build(machine.load_machine(out / "machine.toml"))
    assert extended.effects[0].values["A"] == pytest.approx(0.01, rel=0.01)
    again = simulate(prediction.build(placing.with_effects(straight.machine, slope(straight))), straight_motion.u)
    right, wrong = (simulate(m, straight_motion.u) for m in (extended, straight))
    assert np.abs(right.q - again.q).max() < 0.05 * np.abs(wrong.q - again.q).max()


@pytest.mark.slow
def test_a_second_cause_with_which_exact_dynamics_follow_is_no_flaw_of_the_first(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forces hide how good a first cause's formula is, so that what gains a sixth of it may be its flaw; but not where
    exact dynamics follow the log with both."""
    slope = placing.parse_effect("ground_slope=0.002", straight.machine, 30.0)
    both = prediction.build(placing.with_effects(straight.machine, slope))
    motion = simulate(both, gentle(straight, 30.0).u)
    one = make_log(both, motion, seed=3, known=straight)
    stage = fits.fit_with_process_noise(fits.fit_machine(straight.machine, [one], straight.machine.filter), run_in_turn)
    assert stage.fit.process_noise > 0
    scores = selection.score_effects(stage, run_in_turn)
    first = selection.Choice("torque_gain@rear_roll", stage, 6 * scores[0].likelihood_ratio, 1.0, 200, (), 1.0)
    found = selection.choose_effect(stage, scores, [first], run_in_turn, lambda share, what: None, 0.0)
    assert found is not None
    assert (found.name, found.stage.exact, found.stage.is_close) == ("ground_slope@machine", True, True)
    monkeypatch.setattr("excite.diagnosis.selection.drop_process_noise", lambda found, together: (None for _ in found))
    monkeypatch.setattr(selection, "fit_all_from_start", lambda wishes, *given: iter([None] * len(wishes)))
    assert selection.choose_effect(stage, scores, [first], run_in_turn, lambda share, what: None, 0.0) is None


def test_a_phase_that_was_found_the_other_way_round_is_turned(sloping: Path, straight: Model) -> None:
    """A fit that began with a slope downhill keeps it so, its amount negative; people are given a positive one."""
    one = log.read_log(sloping, straight.machine)
    uphill = slope(straight)
    turned = {"direction": Quantity(value=np.pi, source="assumed")}
    downhill = uphill.model_copy(
        update={"amount": Quantity(value=-0.008, source="assumed"), "shape": turned},
    )
    stage = fits.fit_machine(placing.with_effects(straight.machine, downhill), [one], straight.machine.filter)
    assert dict(zip(stage.model.base.names, stage.fit.X, strict=True))["ground_slope@machine"] < 0
    choice = selection.Choice("ground_slope@machine", stage, 1e4, 1.0, 200, (), 0.5)
    (found,) = diagnosis.conclude(stage, stage, [choice], (), 0.0).findings
    assert found.magnitude == pytest.approx(0.01, rel=0.02)
    assert found.shapes["direction"][0] == pytest.approx(0, abs=0.2)


def test_bad_input_is_refused_before_the_work(sloping: Path, tmp_path: Path, excite: Excite) -> None:
    for arguments, words in (
        (("va12_straight", tmp_path / "none.csv"), "none.csv"),
        (("va12", sloping), "no column"),
        (("va12_straight", sloping, sloping), "given twice"),
        (("va12_straight", sloping, "--filter", "best"), "--filter"),
    ):
        code, stdout, stderr = excite("diagnose", *arguments, "--out", tmp_path / "d")
        assert (code, stdout) == (2, "")
        assert words in stderr
        assert stderr.count("\n") == 1
        assert not (tmp_path / "d").exists()


def test_a_machine_that_stands_shows_no_cause(straight: Model, tmp_path: Path, excite: Excite) -> None:
    """Neither clean nor anything else."""
    N = 2001
    rest = sensors.measure(straight, simulate(straight, np.zeros((N, 2))), seed=1)
    rest.to_csv(tmp_path / "rest.csv", index=False)
    code, _, err = excite("diagnose", "va12_straight", tmp_path / "rest.csv", "--out", tmp_path / "a")
    assert code == 1
    assert "rest.csv: nothing moves, which shows no cause; give a log of a drive as well" in err
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_a_drive_is_designed_for_what_is_tied(straight: Model, tmp_path: Path) -> None:
    """From its log both amounts can be told, each beside the other whatever its shape; a sensor's flaw is passed over,
    and without a problem to design for there is none."""
    short = straight.machine.problems["S40"].model_copy(
        update={"duration_s": straight.machine.problems["S40"].duration_s.model_copy(update={"value": 12.0})}
    )
    machine = straight.machine.model_copy(update={"problems": {"S40": short}, "problem": "S40"})
    told = ("torque_deadband@rear_roll=80", "asymmetric_coulomb@rear_roll=60", "encoder_eccentricity@rear_roll=0.01")
    deadband, coulomb, eccentric = (placing.parse_effect(text, machine, 12.0) for text in told)
    pairs = [RivalPair(machine, (deadband, eccentric)), RivalPair(machine, (deadband, coulomb))]
    assert diagnose_workflow.separating_drive(tmp_path, machine, pairs[:1], True) is None
    nowhere = machine.model_copy(update={"problem": None})
    assert diagnose_workflow.separating_drive(tmp_path, nowhere, pairs, True) is None
    assert not list(tmp_path.iterdir())

    said = diagnose_workflow.separating_drive(tmp_path, machine, pairs, False)
    assert said == {"between": list(told[:2]), "folder": None}
    said = diagnose_workflow.separating_drive(tmp_path, machine, pairs, True)
    assert said is not None
    assert said["between"] == list(told[:2])
    drawn = json.loads((tmp_path / said["folder"] / "summary.json").read_text())
    assert drawn["objective"] == "discrimination"
    assert drawn["max_violation"] < 1e-3
    assert said["sigma_percent"] == max(drawn["sigma_percent"][t.partition("=")[0]] for t in told[:2]) < 20

    # Driven with the one, the log prefers it to the other by what the design promises.
    torque, q0, nu0 = profile.read_profile(tmp_path / said["folder"] / "profile.csv", straight)
    both = [prediction.build(placing.with_effects(machine, e)) for e in (deadband, coulomb)]
    motion = simulate(both[0], torque, q0=q0, nu0=nu0)
    one = log.from_table(sensors.measure(both[0], motion, seed=2), machine)
    right, wrong = (fits.fit_machine(m.machine, [one], machine.filter).fit for m in both)
    assert wrong.cost - right.cost > selection.TIE_LIKELIHOOD_RATIO


@pytest.mark.slow
def test_a_clean_log_gets_no_name_and_no_machine(
    straight: Model, straight_motion: Motion, tmp_path: Path, excite: Excite
) -> None:
    log = logged(straight, straight_motion, tmp_path / "clean.csv", 6)
    code, stdout, _ = excite("diagnose", "va12_straight", log, "--out", tmp_path / "d")
    said = json.loads((tmp_path / "d" / "summary.json").read_text())
    assert (code, said["verdict"], said["findings"], said["machine_file"]) == (0, "clean", [], None)
    assert all(row["systematic_before_percent"] == 0 for row in said["signals"].values())
    assert not (tmp_path / "d" / "machine.toml").exists()
    assert "noise" in stdout


@pytest.mark.slow
def test_which_roll_resists_a_straight_drive_cannot_tell(
    straight: Model, straight_motion: Motion, tmp_path: Path, excite: Excite
) -> None:
    """Ahead both push the same body: a tie by physics, which only turns break. Wrong radii slip, which pushes, too."""
    log = logged(straight, straight_motion, tmp_path / "log.csv", 5, "rolling_resistance@front_roll=400")
    code, stdout, _ = excite("diagnose", "va12_straight", log, "--out", tmp_path / "d", "--json")
    said = json.loads(stdout)
    (found,) = said["findings"]
    names = {f"{found['effect']}@{found['where']}", *found["tied_with"]}
    assert (code, said["verdict"]) == (0, "tied")
    assert names >= {"rolling_resistance@front_roll", "rolling_resistance@rear_roll"}
    assert said["separating_run"].endswith("tight turns to both sides")


@pytest.mark.slow
def test_what_is_found_stands_beside_what_the_file_has(
    straight: Model, straight_motion: Motion, tmp_path: Path, excite: Excite
) -> None:
    """A machine file of one's own comes back whole, with its own effect and the new one, and every command takes it."""
    own = tmp_path / "own.toml"
    own.write_text(
        'extends = "va12_straight"\n[[effect]]\nname = "roll_unbalance"\nwhere = "front_roll"\n'
        'amount = { value = 150, source = "measured" }\nshape = { phase = { value = 0, source = "measured" } }\n'
    )
    has = prediction.build(machine.load_machine(own))
    log = logged(has, straight_motion, tmp_path / "log.csv", 9, "rolling_resistance@rear_roll=400")
    code, stdout, _ = excite("diagnose", own, log, "--out", tmp_path / "d", "--json")
    assert code == 0
    assert [f["effect"] for f in json.loads(stdout)["findings"]] == ["rolling_resistance"]
    text = (tmp_path / "d" / "machine.toml").read_text()
    assert "extends" not in text
    new = machine.load_machine(tmp_path / "d" / "machine.toml")
    assert [e.name for e in new.effect] == ["roll_unbalance", "rolling_resistance"]
    assert new.body == has.machine.body
    code, stdout, _ = excite("identify", tmp_path / "d" / "machine.toml", log, "--out", tmp_path / "i", "--json")
    assert code == 0
    rows: dict[str, Any] = json.loads(stdout)["parameters"]
    for name, true in (("M", 11000.0), ("roll_unbalance@front_roll", 150.0)):
        assert abs(rows[name]["value"] - true) < 4 * rows[name]["std"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 6, 10])
def test_a_drive_that_hardly_shows_the_machine_still_shows_a_cause(seed: int, straight: Model) -> None:
    """Masses are known to a half here: a fit goes where no motion is (6), or stops short of the cause (1, 10)."""
    hidden = placing.parse_effect("stribeck_friction@front_roll=150", straight.machine, 40.0)
    truth = prediction.build(placing.with_effects(straight.machine, hidden))
    table = sensors.measure(truth, simulate(truth, held_straight()), seed=seed)
    (found,) = diagnosis.diagnose(straight, [log.from_table(table, straight.machine)], straight.machine.filter).findings
    assert found.name == "stribeck_friction@front_roll"
    assert abs(found.magnitude - 150) < 3 * found.magnitude_std


@pytest.mark.slow
def test_a_stop_tells_by_which_law_its_rubber_hardens(va12: Model) -> None:
    """What it is at first touch is seen nowhere alone: by the wrong law it would come out twice as stiff."""
    shapes = {"stop": 0.15, "hardening": 1.0, "power": 1.0}
    hidden = selection.identified_entry("articulation_stop_spring", "articulation", 10000.0, shapes)
    truth = prediction.build(placing.with_effects(va12.machine, hidden))
    table = sensors.measure(truth, designed("R60_accuracy", truth), kit="full", seed=5)
    (found,) = diagnosis.diagnose(va12, [log.from_table(table, va12.machine)], va12.machine.filter).findings
    assert found.name == hidden.label
    assert abs(found.magnitude - 10000) < 3 * found.magnitude_std < 6000
    for name, value in shapes.items():
        assert abs(found.shapes[name][0] - value) < 4 * found.shapes[name][1], name


@pytest.mark.slow
def test_the_order_in_which_several_are_found_does_not_count(straight: Model, straight_motion: Motion) -> None:
    """Two at once; found the other way round they stay, and a wrong name that came before or between them goes. Side by
    side or in turn, the numbers are the same."""
    true = [
        placing.parse_effect(text, straight.machine, 40.0)
        for text in ("ground_slope=0.004", "torque_deadband@rear_roll=60")
    ]
    both = prediction.build(placing.with_effects(straight.machine, *true))
    motion = simulate(both, straight_motion.u)
    one = make_log(both, motion, seed=4, known=straight)
    found, same = (
        diagnosis.diagnose(straight, [one], straight.machine.filter, runner=t) for t in (run_forked, run_in_turn)
    )
    assert found.findings == same.findings
    np.testing.assert_array_equal(found.after.fit.X, same.after.fit.X)
    names = [e.label for e in true]
    assert (found.verdict, sorted(f.name for f in found.findings)) == ("named", sorted(names))
    for f, e in zip(sorted(found.findings, key=lambda f: f.name), true, strict=True):
        assert abs(f.magnitude - float(e.amount)) < 4 * f.magnitude_std

    wrong = placing.parse_effect("asymmetric_coulomb@rear_roll=60", straight.machine, 40.0)
    more = fits.refit(placing.with_effects(found.after.machine, wrong), found.after, 0.0)
    name = wrong.label
    for order, stage in (
        (names[::-1], found.after),
        ([name, *names], more),
        ([names[0], name, names[1]], more),
    ):
        chosen = [selection.Choice(n, stage, 1000.0, 1.0, 100, (), 1.0) for n in order]
        again = diagnosis.review_effects(found.before, chosen)
        assert [x.name for x in again] == [n for n in order if n in names]
        assert again[-1].stage.fit.cost == pytest.approx(found.after.fit.cost, abs=0.1)
    # One whose amount comes out as nothing goes, and the others stand as if it had never been there. What was gained on
    # the way makes it no surer.
    chosen = [selection.Choice(n, more, 1000.0, 1.0, 100, (), 1.0) for n in (name, *names)]
    p_values = [f.p_value for f in diagnosis.conclude(found.before, more, chosen, (), 0.0).findings]
    assert p_values[0] > 0.05
    assert max(p_values[1:]) < 1e-100
    left = diagnosis.drop_unneeded(found.before, chosen)
    assert [x.name for x in left] == names
    assert [e.name for e in left[0].stage.machine.effect] == [names[0].split("@")[0]]
    assert [x.name for x in diagnosis.drop_unneeded(found.before, left)] == names
    # Nor does one stay whose amount says that it is nothing, however sure that amount seems to be.
    faint = placing.parse_effect("shear_saturation@rear_roll=6", straight.machine, 40.0)
    more = fits.refit(placing.with_effects(found.after.machine, faint), found.after, 0.0)
    name = faint.label
    chosen = [selection.Choice(n, more, 1000.0, 1.0, 100, (), 1.0) for n in (name, *names)]
    assert [x.name for x in diagnosis.drop_unneeded(found.before, chosen)] == names


def test_what_gets_a_name_is_no_chance(straight: Model, straight_motion: Motion) -> None:
    """The more shapes an effect has, the more it must gain; with just that much its p-value is at most CHANCE."""
    told = ("torque_gain@rear_roll=0.1", "stribeck_friction@rear_roll=150", "vibration_on@rear_roll=0.2")
    entries = [placing.parse_effect(text, straight.machine, 40.0) for text in told]
    has = prediction.build(placing.with_effects(straight.machine, *entries))
    motion = simulate(has, straight_motion.u, q0=straight_motion.q[0], nu0=straight_motion.nu[0])
    stage = fits.fit_machine(has.machine, [make_log(has, motion, seed=3)], has.machine.filter)
    names = [e.name for e in stage.model.effects]
    assert [selection.degrees_of_freedom(n, stage) for n in names] == [1, 2, 3]
    levels = [selection.required_likelihood_ratio(n, stage, 2000) for n in names]
    assert levels[0] == selection.MIN_LIKELIHOOD_RATIO <= levels[1] < levels[2]
    for name, level in zip(names, levels, strict=True):
        chosen = [selection.Choice(name, stage, level, 1.0, 2000, (), 1.0)]
        assert diagnosis.conclude(stage, stage, chosen, (), 0.0).findings[0].p_value <= selection.MAX_P_VALUE * 1.000001


@pytest.mark.slow
def test_an_amount_is_as_unsure_as_shapes_that_a_log_hardly_tells(straight: Model) -> None:
    """Of a soil that one way of three metres has hardly packed: how much of it is to come nothing tells, while about a
    short way that a pass takes its deviation says that all of it has."""
    name = "compaction_per_pass@drive"

    def packed(amount: float, each: float) -> machine.Machine:
        entry = placing.parse_effect(f"compaction_per_pass={amount}", straight.machine, 15.0)
        values = {**entry.shape, "pass": told(each), "counted": told(2.0)}
        return placing.with_effects(straight.machine, entry.model_copy(update={"shape": values}))

    def told(value: float) -> Quantity:
        return Quantity(value=value, source="assumed")

    hidden, t = prediction.build(packed(0.06, 60.0)), np.arange(0, 15.01, 0.01)
    slow = np.minimum(1, np.minimum(t, 15 - t) / 2)
    push = (2500 * np.sin(2 * np.pi * t / 7.5) + 600 * np.sin(2.6 * t)) * slow
    motion = simulate(hidden, np.column_stack([push, 0.8 * push]))
    assert 2 < np.ptp(motion.q[:, 0]) < 4
    one = make_log(hidden, motion, seed=3, known=straight)
    before = fits.fit_machine(straight.machine, [one], straight.machine.filter)
    for amount, each in ((0.05, 3.0), (0.05, 15.0), (0.05, 50.0)):
        after = fits.refit(packed(amount, each), before, 0.0)
        k = after.model.base.names.index(name)
        assert each == 50.0 or 0.06 - after.fit.X[k] > 3 * after.fit.std[k]
        chosen = [selection.Choice(name, after, 1000.0, 1.0, 100, (), 1.0)]
        (found,) = diagnosis.conclude(before, after, chosen, (), 0.0).findings
        assert 0.06 - found.magnitude < 2.5 * found.magnitude_std
        assert found.magnitude_std < found.magnitude
    # Nor does it where the shape is held, as nothing shows it at all; a shape that is told needs no other fit.
    shape = after.model.base.names.index(f"{name}.pass")
    held = replace(after.fit, unidentifiable=np.arange(len(after.fit.X)) == shape)
    sure = after.fit.covariance.copy()
    sure[shape] = sure[:, shape] = 0.0
    for fit, more in ((replace(held, covariance=sure), True), (replace(after.fit, covariance=sure), False)):
        assert (
            magnitude_interval.std_over_weak_shapes(after.placed(name), replace(after, fit=fit), run_in_turn) > 0
        ) == more


def test_a_parameter_that_the_logs_cannot_tell_has_no_deviation(straight: Model) -> None:
    """Its deviation in the fit is that of what holds it at the machine file's value, and says nothing about it."""
    n = len(straight.base.names)
    fit = SimpleNamespace(X=straight.nominal, std=np.full(n, 0.1), unidentifiable=np.arange(n) == 1)
    stage: Any = SimpleNamespace(model=straight, fit=fit, estimated=True)
    rows = findings.parameter_table(diagnosis.Diagnosis("clean", (), stage, stage, 0.0, (), (stage,)))
    untold, *told = rows.pop(straight.base.names[1]), *rows.values()
    assert np.isnan([untold["std_before"], untold["std_after"]]).all()
    assert untold["moved"] is None
    assert all(row["std_before"] == row["std_after"] == 0.1 for row in told)


def test_a_figure_says_that_nothing_could_be_withheld() -> None:
    """In place of an axis without bars."""
    for rms, shown in ((1e-3, True), (np.nan, False), (None, False)):
        row = {"unit": "rad", "rms_before": rms, "rms_after": rms, "systematic_before_percent": 40.0}
        right = diagnosis_figures.signals_figure({"theta1": row}, False, "a roller").axes[1]
        assert right.axison == shown
        assert any("no fit to the rest" in text.get_text() for text in right.texts) != shown


@pytest.mark.slow
def test_every_log_is_drawn(straight: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces that only the one model needs are shown for the other too."""
    logs = [make_log(straight, gentle(straight, 6.0), seed=k) for k in (3, 4)]
    without = fits.fit_machine(straight.machine, logs, straight.machine.filter)
    beside = replace(without, fit=replace(without.fit, process_noise=1.0))
    loosened = list[fits.ExtendedFit]()
    monkeypatch.setattr(package, "refit_with_process_noise", lambda stage: (loosened.append(stage), beside)[1])
    for after, asked in ((without, []), (beside, [without, beside])):
        loosened.clear()
        d: Any = SimpleNamespace(before=without, after=after, stages=(after,))
        for draw in diagnosis_figures.figure_calls(tmp_path, d, "a roller"):
            draw()
        assert all(a is b for a, b in zip(loosened, asked, strict=True))
        drawn = {p.name for p in tmp_path.iterdir()}
        assert drawn == {f"{kind}-{k}.png" for kind in ("clearest", "misfit", "when") for k in (1, 2)}


@pytest.mark.parametrize("size", [3e-8, 4e-4, 1.0, 3e5])
def test_panels_keep_apart_whatever_their_numbers(size: float) -> None:
    rng, t = np.random.default_rng(0), np.arange(6001) / 100
    quantities = {n: ("m/s", {"torque u1": size * rng.standard_normal(len(t))}) for n in "abcde"}
    missing = {"torque u1": (size * rng.standard_normal(len(t)), "N m", size)}
    course = residuals.LogResiduals("log.csv", t, missing, quantities, (), cast(Any, None))
    figure = diagnosis_figures.misfit_figure(course, course, "a roller")
    FigureCanvasAgg(figure).draw()
    axes = figure.axes
    taken = [ax.get_tightbbox().padded(-1) for ax in axes] + [text.get_window_extent() for text in figure.texts]
    taken += [legend.get_window_extent() for legend in figure.legends]
    assert len(axes) == 6
    for k, box in enumerate(taken):
        assert figure.bbox.fully_containsx(box.x0)
        assert figure.bbox.fully_containsx(box.x1)
        assert not any(box.overlaps(other) for other in taken[:k])


def test_the_usual_range_of_a_shape(va12: Model) -> None:
    """Of all that is tried in its form, and of what there is; an instant has none."""

    def usual(text: str, shape: str, **values: float) -> tuple[float, ...]:
        entry = placing.parse_effect(text, va12.machine, 40.0)
        own = {**entry.shape, **{n: Quantity(value=x, source="assumed") for n, x in values.items()}}
        (placed,) = prediction.build(
            placing.with_effects(va12.machine, entry.model_copy(update={"shape": own}))
        ).effects
        return magnitude_interval._usual_range(placed, shape, va12.machine)

    assert usual("compaction_per_pass=0.3", "pass") == (5.0, 50.0)
    assert usual("slip_relaxation@front_roll=0.05", "moment") == (0.0, 1.0)
    assert usual("pump_coupling@drive=0.1", "lag", hose=1.0) == (0.03, 0.3)
    assert usual("vibration_on@front_roll=0.3", "begin") == ()
    assert usual("shear_saturation@front_roll=0.3", "bend") == ()
    low, high = usual("roll_out_of_round@front_roll=0.002", "load")
    assert 0 < low < high


@pytest.mark.slow
def test_what_no_machine_has_is_no_name(straight: Model, straight_motion: Motion) -> None:
    """Friction that drives, by whatever name the file calls it, or a resistance that pushes: unexplained, with what
    comes nearest and why it is none; as plain as it may be otherwise, and with nothing left that is odd."""
    entry = placing.parse_effect("rolling_resistance@rear_roll=400", straight.machine, 40.0)
    one = make_log(straight, straight_motion, seed=3)
    before = fits.fit_machine(straight.machine, [one], straight.machine.filter)
    after = fits.refit(placing.with_effects(straight.machine, entry), before, 0.0)
    names = after.model.base.names

    def said(name: str, value: float) -> diagnosis.Diagnosis:
        X = after.fit.X.copy()
        X[names.index("rolling_resistance@rear_roll")] = 400.0
        X[names.index(name)] = value
        stage = replace(after, fit=replace(after.fit, X=X, covariance=np.diag((0.01 * X) ** 2)))
        chosen = [selection.Choice("rolling_resistance@rear_roll", stage, 1000.0, 1.0, 100, (), 1.0)]
        kept, odd, nearest = diagnosis.drop_weak_effects(before, chosen)
        return diagnosis.conclude(before, kept[-1].stage if kept else before, kept, odd, 0.0, nearest)

    assert said("Fs4", 150.0).verdict == "named"
    for name, value in (("Fs4", -150.0), ("Fv1", -90.0), ("Kx4", 1e5), ("rolling_resistance@rear_roll", -400.0)):
        d = said(name, value)
        assert (d.verdict, d.findings, d.share) == ("unexplained", (), 0.0)
        assert d.nearest is not None
        assert (d.nearest.name, len(d.nearest.impossible)) == ("rolling_resistance@rear_roll", 1)
        assert d.nearest.impossible[0].startswith(f"{name} = -" if value < 0 else f"{name} = 100000 N")
        assert "which no machine has" in findings.answer_text(findings.assess(d))


@pytest.mark.slow
def test_a_vibration_shakes_a_sensor_in_one_log_at_least(straight: Model) -> None:
    """A log too short to tell says nothing either way."""
    entry = placing.parse_effect("vibration_on@rear_roll=0.3", straight.machine, 20.0)
    told = {"begin": 5.0, "length": 6.0, "shake": 80.0, "frequency": 27.0}
    entry = entry.model_copy(update={"shape": {n: Quantity(value=v, source="assumed") for n, v in told.items()}})
    shaken = prediction.build(placing.with_effects(straight.machine, entry))
    quiet, loud = (make_log(m, gentle(m, 20.0), seed=3, known=straight) for m in (straight, shaken))
    short = make_log(straight, gentle(straight, 4.0), seed=4)
    for logs, felt in (
        ([loud], True),
        ([quiet], False),
        ([short], True),
        ([short, quiet], False),
        ([quiet, loud], True),
    ):
        stage = fits.fit_machine(shaken.machine, logs, straight.machine.filter)
        assert selection._is_plausible("vibration_on@rear_roll", stage) == felt


@pytest.mark.parametrize(("load", "so"), [(50e3, True), (2e3, False), (400e3, False)])
def test_a_roll_out_of_round_carries_a_share_of_the_machine(load: float, so: bool, straight: Model) -> None:
    """An eccentric encoder has no load at all, an unbalanced roll no eccentricity: both would fit otherwise."""
    entry = placing.parse_effect("roll_out_of_round@rear_roll=0.002", straight.machine, 12.0)
    entry = entry.model_copy(update={"shape": {"load": Quantity(value=load, source="assumed")}})
    known = placing.with_effects(straight.machine, entry)
    one = make_log(prediction.build(known), gentle(straight, 12.0), seed=3, known=straight)
    stage = fits.fit_machine(known, [one], straight.machine.filter)
    names = stage.model.base.names
    assert "roll_out_of_round@rear_roll.load" in names
    assert selection._is_plausible("roll_out_of_round@rear_roll", stage) == so


def test_a_cause_without_which_nothing_is_left_and_no_machine_possible_stays_alone(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is nothing by which a further effect could tell that it makes the machine possible again."""
    stage = calm(prediction.build(placing.with_effects(straight.machine, slope(straight))))
    choice = selection.Choice("ground_slope@machine", stage, 1e4, 1.0, 1, (), 1.0)
    asked = list[fits.ExtendedFit]()

    def scored(of: fits.ExtendedFit, *given: Any) -> tuple[()]:
        asked.append(of)
        return ()

    monkeypatch.setattr(selection, "score_effects", scored)
    for lines, left, goes_on in ((("M = -1",), 0.0, False), ((), 0.0, True), (("M = -1",), 1e4, True)):
        asked.clear()
        monkeypatch.setattr(fits.ExtendedFit, "impossible", lines)
        more = replace(choice, stage=replace(stage, fit=replace(stage.fit, cost=stage.fit.cost + left)))
        found, _ = diagnosis.extend_model(stage, [more], run_in_turn, lambda share, what: None)
        assert found == [more]
        assert bool(asked) == goes_on


@pytest.mark.parametrize(
    ("left", "promised", "forces", "named", "goes_on"),
    [
        (0.1, 10.0, 0.0, "", True),
        (0.9, 10.0, 0.0, "", False),
        (0.9, 1200.0, 0.0, "", True),
        (0.9, 10.0, 0.1, "", True),
        (0.9, 10.0, 0.0, "nothing odd", True),
        (0.9, 10.0, 0.0, "with forces", True),
    ],
)
def test_nothing_is_looked_for_beside_names_where_no_more_could_explain_the_misfit(
    left: float,
    promised: float,
    forces: float,
    named: str,
    goes_on: bool,
    straight: Model,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Names that explain 0.85 of it between them are needed, and only so many are looked for; what forces hide could be
    anything, and what has a name already keeps it."""
    stage = calm(prediction.build(placing.with_effects(straight.machine, slope(straight))))
    excess = left / (1 - left) * 1000.0  # after a gain of 1000
    far = replace(
        stage,
        fit=replace(stage.fit, cost=(1 + fits.COST_TOLERANCE) * stage.expected_cost + excess, process_noise=forces),
    )
    score = next(s for s in selection.score_effects(stage, run_in_turn) if s.values["A"] != 0)
    forced = (
        replace(stage, fit=replace(stage.fit, process_noise=fits.MIN_PROCESS_NOISE)) if named == "with forces" else None
    )
    choice = selection.Choice("ground_slope@machine", far, 1000.0, 1.0, 1, (), 1.0, forced)
    odd = [] if named == "nothing odd" else [residual_tests.Anomaly("theta1", "jump", 5.0, 5.0, None, 2.0)]
    monkeypatch.setattr(diagnosis, "find_anomalies", lambda *given: odd)
    asked = list[int]()
    monkeypatch.setattr(selection, "score_effects", lambda *given: (replace(score, likelihood_ratio=promised),))
    monkeypatch.setattr(selection, "choose_effect", lambda *given: asked.append(1))
    found, _ = diagnosis.extend_model(stage, [choice], run_in_turn, lambda share, what: None)
    assert found == [choice]
    assert bool(asked) == goes_on


def test_further_variants_of_the_likeliest_names_are_tried(straight: Model) -> None:
    """Beside so many candidates in all: a formula may be right in one form only, which scores last."""
    stage = calm(straight)
    best: dict[str, Any] = {}
    for score in selection.score_effects(stage, run_in_turn):
        if score.values["A"] != 0 and len(score.candidate.variant) > 1:
            best.setdefault(score.candidate.name, score)
    names = list(best)[: selection.MAX_CANDIDATES]
    assert len(names) == selection.MAX_CANDIDATES

    def variant(name: str, form: str, gain: float) -> Any:
        placed = best[name].candidate.placed
        return replace(
            best[name], likelihood_ratio=gain, candidate=SimpleNamespace(name=name, variant=(name, form), placed=placed)
        )

    firsts = [variant(name, "first", 1000.0 - k) for k, name in enumerate(names)]
    others = [variant(name, "other", 900.0 - k) for k, name in enumerate(names)]
    told = selection._shortlist(stage, [*firsts, *others], ())
    assert told == [*firsts, *others[: selection.FIRST_BATCH]]


@pytest.mark.parametrize(
    ("impossible", "forces", "left", "chosen"),
    [(0, 0.0, 0.0, 0), (1, 0.0, 0.0, 1), (1, 0.0, 1e4, 0), (2, 0.0, 0.0, 0), (1, fits.MIN_PROCESS_NOISE, 0.0, 0)],
)
def test_a_machine_that_can_be_is_preferred(
    impossible: int, forces: float, left: float, chosen: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of effects that explain all that a log shows about as well, the price of their parameters counted; where more is
    left, more may come. Not one with which no machine can be either, and that explains less, nor one that only forces
    let explain as much."""
    stage = calm(straight)
    scores = {s.candidate.name: s for s in selection.score_effects(stage, run_in_turn)}
    tries = []
    for k, text in enumerate(("ground_slope=0.009", "rolling_resistance@rear_roll=200")):
        extended = placing.with_effects(straight.machine, placing.parse_effect(text, straight.machine, 40.0))
        found = fits.refit(extended, stage, 0.0)
        price = np.log(stage.data.n_readings) * selection.degrees_of_freedom(found.model.effects[0].name, found)
        cost = (1 + fits.COST_TOLERANCE) * stage.expected_cost - 1 + left + 3 * k - price
        fit = replace(found.fit, cost=cost, process_noise=forces * k)
        tries.append((scores[found.model.effects[0].name], replace(found, fit=fit)))
    names = [s.candidate.name for s, _ in tries[:impossible]]
    lines = property(lambda of: ("Fv1 = -1",) if of.model.effects[0].name in names else ())
    monkeypatch.setattr(fits.ExtendedFit, "impossible", lines)
    monkeypatch.setattr(selection, "drop_process_noise", lambda found, together: (None for _ in found))
    monkeypatch.setattr(selection, "fit_all_from_start", lambda wishes, *given: iter([None] * len(wishes)))
    choice = selection._make_choice(tries, 1000.0, 100, run_in_turn)
    assert choice.name == tries[chosen][0].candidate.name
    assert [e.label for e in choice.rivals] == ([] if chosen else [tries[1][0].candidate.name])


def test_where_exact_dynamics_find_no_way_a_known_fit_with_forces_is_gone_on_with(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one that the last name was judged with, if it was with such forces."""
    sloped = placing.with_effects(straight.machine, slope(straight))
    stage = calm(prediction.build(sloped))
    small, large = (replace(stage, fit=replace(stage.fit, process_noise=d)) for d in (fits.MIN_PROCESS_NOISE, 1.0))
    made, judged = list[float](), list[Fit]()

    def refitted(machine: Any, of: fits.ExtendedFit, disturbed: float) -> fits.ExtendedFit:
        made.append(disturbed)
        return replace(of, fit=replace(of.fit, process_noise=disturbed))

    def scanned(along: Any, fit: Fit, *given: Any) -> tuple[()]:
        judged.append(fit)
        return ()

    best = next(s for s in selection.score_effects(stage, run_in_turn) if s.values["A"] != 0)
    scores = [replace(best, likelihood_ratio=1000.0)]
    monkeypatch.setattr(selection, "refit_all", lambda wishes, *given: [None for _ in wishes])
    monkeypatch.setattr(selection, "fit_all_from_start", lambda wishes, *given: iter([None for _ in wishes]))
    monkeypatch.setattr(selection, "refit", refitted)
    monkeypatch.setattr(selection.score_test, "score_candidates", scanned)
    for loose, again in ((small, False), (large, True), (None, True)):
        made.clear()
        judged.clear()
        before = selection.Choice("ground_slope@machine", stage, 1000.0, 1.0, 1, (), 1.0, loose)
        assert selection.choose_effect(stage, scores, [before], run_in_turn, lambda share, what: None, 0.0) is None
        assert made == ([fits.MIN_PROCESS_NOISE] if again else [])
        assert [x.process_noise for x in judged if x is not stage.fit] == [fits.MIN_PROCESS_NOISE]
        assert again or judged[-1] is small.fit


@pytest.mark.parametrize(("found", "asked"), [((True, True), 3), ((False, True), 2)])
def test_where_no_way_to_the_likeliest_cause_is_found_no_others_are_tried(
    found: Sequence[bool], asked: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By exact dynamics: all are judged with disturbing forces then."""
    stage = calm(straight)
    scores = promising(stage, "ground_slope@machine", "torque_gain@front_roll", "torque_gain@rear_roll")
    wished, true = list[str](), fits.refit_all

    def refits(wishes: Sequence[fits.RefitRequest], *given: Any) -> list[fits.ExtendedFit | None]:
        told = [*found[len(wished) :], True]
        wished.extend(machine.effect[-1].label for machine, _, _ in wishes)
        return [x if yes else None for yes, x in zip(told, true(wishes, *given), strict=False)]

    monkeypatch.setattr(selection, "refit_all", refits)
    assert selection.choose_effect(stage, scores, (), run_in_turn, lambda share, what: None, 0.0) is None
    assert wished == [s.candidate.name for s in scores[:asked]]


@pytest.mark.parametrize(("name", "zero"), [("torque_deadband@front_roll", True), ("ground_slope@machine", False)])
def test_what_a_fit_leads_to_zero_is_no_way_to_a_cause(
    name: str, zero: bool, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a fit counts as not found: candidates are judged with process noise, and keep it."""
    stage, loosened = calm(straight), list[float]()
    scores = promising(stage, name)

    def refitted(machine: Any, of: fits.ExtendedFit, disturbed: float) -> fits.ExtendedFit:
        loosened.append(disturbed)
        return fits.refit(machine, of, disturbed)

    monkeypatch.setattr(selection, "refit", refitted)
    assert selection.choose_effect(stage, scores, (), run_in_turn, lambda share, what: None, 0.0) is None
    assert loosened == ([fits.MIN_PROCESS_NOISE] if zero else [])
    text = "torque_deadband@front_roll=20" if zero else "ground_slope=0.001"
    extended = placing.with_effects(straight.machine, placing.parse_effect(text, straight.machine, 12.0))
    loose = fits.refit(extended, stage, 1.0)
    exact, unknown = selection._trials_without_noise([(scores[0], loose)], run_in_turn)
    assert (len(exact), len(unknown)) == ((0, 1) if zero else (1, 0))


def promising(stage: fits.ExtendedFit, *names: str) -> list[Any]:
    """Return the scores of candidates along a fit, raised so that each is worth a fit, the first most."""
    best = {s.candidate.name: s for s in reversed(selection.score_effects(stage, run_in_turn)) if s.values["A"] != 0}
    return [replace(best[name], likelihood_ratio=1000.0 - k) for k, name in enumerate(names)]


@pytest.mark.parametrize("gain", [15.0, 40.0])
def test_an_amount_that_gains_nothing_clear_names_nothing(gain: float) -> None:
    """Friction by bristles is presliding unless Stribeck friction adds to it, whichever of the two fits better."""

    def trial(name: str, simpler: str | None, cost: float, process_noise: float = 0.0) -> Any:
        candidate = SimpleNamespace(name=name, placed=SimpleNamespace(simpler=simpler))
        fit = SimpleNamespace(cost=cost, process_noise=process_noise)
        return SimpleNamespace(candidate=candidate), SimpleNamespace(fit=fit, deviance=cost, dispersion=1.0)

    bristles = trial("stribeck_friction@load", "presliding@load", 100.0)
    bends = trial("presliding@load", None, 100.0 + gain)
    kept = selection._without_needless_magnitudes([bristles, bends])
    assert kept == ([bends] if gain < selection.MIN_LIKELIHOOD_RATIO else [bristles, bends])
    with_noise = trial("presliding@load", None, 60.0, 1.0)  # whose cost is lower for that alone
    assert selection._without_needless_magnitudes([bristles, with_noise]) == [bristles, with_noise]


def test_an_amount_at_zero_can_be_written(straight: Model) -> None:
    """As a machine may have it: zero of what makes sense above it only is refused."""
    machine = placing.with_effects(
        straight.machine, placing.parse_effect("torque_deadband@front_roll=20", straight.machine, 10.0)
    )
    stage = calm(prediction.build(machine))
    k = stage.model.base.names.index("torque_deadband@front_roll")
    X = np.where(np.arange(len(stage.fit.X)) == k, 1e-15, stage.fit.X)
    entry = selection.fitted_entry(replace(stage, fit=replace(stage.fit, X=X)), "torque_deadband@front_roll")
    assert placing.with_effects(straight.machine, entry).effect


def test_stretches_are_withheld_from_fits_that_are_near_enough(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What they predict is asked for, not how sure they are."""
    stage, true, asked = calm(straight), smoothing.fit_logs, list[tuple[float, float]]()

    def noted(*given: Any) -> Fit:
        asked.append((given[6], given[7].tolerance))
        return true(*given)

    monkeypatch.setattr(smoothing, "fit_logs", noted)
    for disturbed in (0.0, 0.1):
        assert hold_out.hold_out_errors(replace(stage, fit=replace(stage.fit, process_noise=disturbed))) is not None
    assert set(asked) == {(0.0, fits.SUFFICIENT_STEP), (0.1, ACCEPTABLE_STEP)}


def test_the_likelihood_of_withheld_stretches_is_found_up_to_the_level_that_suits_best(straight: Model) -> None:
    stage = calm(straight)
    assert np.isnan(hold_out.hold_out_errors(stage).log_likelihood).all()  # only where it is asked for
    noisy = replace(stage, fit=replace(stage.fit, process_noise=0.1))
    total = hold_out.hold_out_errors(noisy, likelihood=True).log_likelihood.sum(axis=0)
    known = total[np.isfinite(total)]
    assert len(known) < len(total)
    assert np.argmax(known) == max(len(known) - 2, 0)


def test_stretches_are_withheld_only_for_what_is_asked(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a cause nobody asks for a likelihood; where torques tell the error, nobody for that of the motion."""
    stage, asked, true = calm(straight), list[bool](), hold_out.hold_out_errors
    d = diagnosis.conclude(stage, stage, [], (), 0.0)

    def noted(stage: fits.ExtendedFit, every_turn: bool, likelihood: bool) -> hold_out.HoldOutErrors | None:
        asked.append(likelihood)
        return true(stage, every_turn, likelihood)

    monkeypatch.setattr(hold_out, "hold_out_errors", noted)
    first = findings.assess(d).total_gain
    assert asked == [False]
    known = true(stage)
    monkeypatch.setattr(hold_out, "hold_out_torques", lambda stage: known)
    assert findings.assess(d).total_gain == first
    assert asked == [False]


def test_candidates_are_scored_once_along_a_fit(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Along another one anew, however alike."""
    stage, scans = calm(straight), list[Fit]()
    true = selection.score_test.score_candidates

    def noted(along: Any, fit: Fit, *asked: Any) -> Any:
        scans.append(fit)
        return true(along, fit, *asked)

    monkeypatch.setattr(selection.score_test, "score_candidates", noted)
    first = selection.score_effects(stage, run_in_turn)
    assert selection.score_effects(stage, run_in_turn) is first
    other = replace(stage, fit=replace(stage.fit, cost=2 * stage.fit.cost))
    assert [s.likelihood_ratio for s in selection.score_effects(other, run_in_turn)] == [
        s.likelihood_ratio for s in first
    ]
    assert scans == [stage.fit, other.fit]


@pytest.mark.parametrize(("excess", "chosen"), [((0.0, 0.0), 0), ((4.0, 0.1), 1), ((4.0, 3.9), 1), ((4.0, 6.0), 0)])
def test_forces_hide_which_of_two_is_right(
    straight: Model, monkeypatch: pytest.MonkeyPatch, excess: tuple[float, float], chosen: int
) -> None:
    """Those that come near each other with forces are compared without them, where both may explain all."""
    stage = calm(straight)
    best, other = ("ground_slope=0.009", "rolling_resistance@rear_roll=200")
    scores = {s.candidate.name: s for s in selection.score_effects(stage, run_in_turn)}
    noise, tries = stage.expected_cost, []
    for text, cost in ((best, noise), (other, noise + 600.0)):
        extended = placing.with_effects(straight.machine, placing.parse_effect(text, straight.machine, 40.0))
        found = fits.refit(extended, stage, 1.0)
        fit = replace(found.fit, cost=cost)
        tries.append((scores[found.model.effects[0].name], replace(found, fit=fit)))

    def freed(found: Sequence[Any], together: Any) -> Any:
        names = [s.candidate.name for s, _ in tries]
        for x in found:
            cost = noise * (1 + excess[names.index(x.model.effects[0].name)])
            yield replace(x, fit=replace(x.fit, cost=cost, process_noise=0.0))

    monkeypatch.setattr(selection, "drop_process_noise", freed)
    choice = selection._make_choice(tries, 3000.0, 100, run_in_turn)
    assert choice.name == tries[chosen][0].candidate.name
    assert choice.stage.exact
    assert choice.likelihood_ratio == pytest.approx(3000.0 - 600.0 * chosen)
    assert bool(choice.rivals) == (excess in ((0.0, 0.0), (4.0, 3.9)))


@pytest.mark.slow
def test_a_harmonic_is_no_ripple_elsewhere(straight: Model, straight_motion: Motion) -> None:
    """Straight on, all rolls turn alike: what is twice an order of a known ripple is one of the same machine's."""

    def ripple(amount: float, order: float) -> EffectEntry:
        entry = placing.parse_effect(f"torque_ripple@rear_roll={amount}", straight.machine, 40.0)
        return entry.model_copy(update={"shape": {**entry.shape, "order": Quantity(value=order, source="assumed")}})

    hiding = prediction.build(placing.with_effects(straight.machine, ripple(40, 14)))
    one = make_log(hiding, simulate(hiding, straight_motion.u), seed=3, known=straight)
    found = []
    for known in (straight.machine, placing.with_effects(straight.machine, ripple(40, 7))):
        stage = fits.fit_machine(known, [one], straight.machine.filter)
        found.append(
            {s.candidate.name: s.likelihood_ratio for s in reversed(selection.score_effects(stage, run_in_turn))}
        )
    bare, rippled = found
    assert bare["torque_ripple@front_roll"] > 100
    assert "torque_ripple@front_roll" not in rippled
    assert "torque_ripple@rear_roll" not in rippled
    assert rippled.keys() >= bare.keys() - {"torque_ripple@front_roll", "torque_ripple@rear_roll"}


@pytest.mark.parametrize(
    ("forces", "near", "gained", "unabsorbed", "timed", "least"),
    [
        (1.0, True, 0.0, 1.0, False, 0.15 * 1e4),
        (0.1, False, 0.0, 1.0, False, 0.15 * 1e4),
        (0.0, True, 0.0, 1.0, False, 0.05 * 1e4),
        (0.0, False, 0.0, 1.0, False, 0.15 * 1e4),
        (1.0, False, 0.0, 1.0, False, 0.3 * 1e4),
        (1.0, False, 1e3, 1.0, False, 0.3 * 1e4),
        (1.0, True, 1e3, 1.0, False, 0.15 * 1e4),
        (0.0, False, 1e3, 1.0, False, 0.3 * 1e4),
        (0.0, True, 1e3, 1.0, False, 0.05 * 1e4),
        (0.0, True, 1e6, 1.0, False, 0.03**2 * 1e6),
        (0.0, True, 1e6, 0.1, False, 0.03**2 * 1e7),
        (0.0, True, 1e6, 1e-6, False, 0.1 * 1e6),
        (0.0, True, 1e6, 1.0, True, 0.1 * 1e6),
    ],
)
def test_what_an_effect_must_gain_to_be_worth_a_place(
    forces: float, near: bool, gained: float, unabsorbed: float, timed: bool, least: float
) -> None:
    """Of an excess of 1e4: a part; where large forces leave much the first must explain what the largest of three does,
    and where the model isn't near the log yet a further one as much. Of what another gained: what its formula is off
    by, the more where parameters absorb the effect but not its error."""
    stage: Any = SimpleNamespace(
        model=SimpleNamespace(effects=[]),  # no Wald's statistic
        fit=SimpleNamespace(process_noise=forces),
        exact=forces == 0,
        is_close=near,
        first_order_is_rough=forces > 0 or not near,
        excess_cost=1e4,
    )
    known = SimpleNamespace(name="torque_gain@rear_roll", likelihood_ratio=gained, unabsorbed_share=unabsorbed)
    chosen: Any = [known] if gained else []
    candidate: Any = SimpleNamespace(placed=SimpleNamespace(effect=SimpleNamespace(timed=timed)))
    assert selection._required_gain(stage, chosen, candidate, 0.0) == pytest.approx(least)


@pytest.mark.parametrize(("gained", "least"), [(3000.0, 0.15**2 * 3000), (1e5, 250.0)])
def test_beside_a_rough_formula_an_effect_must_gain_more_than_its_error(gained: float, least: float) -> None:
    stage: Any = SimpleNamespace(
        model=SimpleNamespace(effects=[]),
        fit=SimpleNamespace(process_noise=0.0),
        exact=True,
        is_close=True,
        first_order_is_rough=False,
        excess_cost=0.0,
    )
    chosen: Any = [SimpleNamespace(name="presliding@carriage", likelihood_ratio=gained, unabsorbed_share=1.0)]
    candidate: Any = SimpleNamespace(placed=SimpleNamespace(effect=SimpleNamespace(timed=False)))
    assert selection._required_gain(stage, chosen, candidate, 0.0) == pytest.approx(least)


def unfit(monkeypatch: pytest.MonkeyPatch, refused: Callable[[Any, int], bool], coarse: float = 1.0) -> None:
    """Some fits to sensors as they are, or up to so coarse, find nothing: told are chart and number of passes."""
    iterate = smoothing.fit_logs

    def found(c: Any, records: Any, *args: Any) -> Fit:
        fit, settings = iterate(c, records, *args), args[5] if len(args) > 5 else Settings()
        if records[0].noise_inflation <= coarse and refused(c, settings.passes):
            return replace(fit, status="stalled", step=np.inf, cost=np.inf)
        return fit

    monkeypatch.setattr(smoothing, "fit_logs", found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("refused", "followed"),
    [(1, fits.SENSOR_NOISE_INFLATIONS[0]), (fits.SENSOR_NOISE_INFLATIONS[0], fits.SENSOR_NOISE_INFLATIONS[1])],
)
def test_what_is_followed_with_coarse_sensors_only_is_named(
    refused: float, followed: float, sloping: Path, straight: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No model without the slope can be fitted to sensors as they are, or to some that are much coarser."""
    unfit(monkeypatch, lambda c, passes: not c.model.effects, refused)
    d = diagnosis.diagnose(straight, [log.read_log(sloping, straight.machine)], straight.machine.filter)
    assert d.verdict == "named"
    assert [f.name for f in d.findings] == ["ground_slope@machine"]
    assert abs(d.findings[0].magnitude - 0.01) < 2 * d.findings[0].magnitude_std < 0.001
    assert (d.before.data.noise_inflation, d.before.estimated) == (followed, False)
    assert (d.after.data.noise_inflation, d.after.estimated, d.after.exact) == (1, True, True)
    told = findings.assess(d)
    assert told.total_gain is not None
    assert told.total_gain.interval[0] > 50
    assert told.located == ()
    assert all(np.isnan(row["std_before"]) and row["moved"] is None for row in findings.parameter_table(d).values())
    monkeypatch.setattr(package, "diagnose", lambda *args: d)
    said = diagnose_workflow.diagnose(tmp_path, "va12_straight", [sloping])
    assert any(f"fitted to sensors taken for {followed:g} times as noisy" in note for note in said["notes"])
    # Innovations are held against the sensors' true noise, not that of coarse ones.
    assert max(size.slow_mean_square for size in told.before.values()) > 20
    assert max(size.slow_mean_square for size in told.after.values()) < 3


def test_a_value_that_is_nothing_can_be_written() -> None:
    """A fit may end a hair beside zero, which no machine file holds."""
    shapes = {"begin": (-1e-15, 0.1, "s"), "length": (5.0, 0.1, "s")}
    found = diagnosis.Finding("vibration_on", "rear_roll", (), 1e-9, 0.1, 0.01, "-", shapes, 100.0)
    assert [float(found.entry.shape[name]) for name in shapes] == [0.0, 5.0]


def test_a_model_that_coarse_sensors_lead_to_needs_no_effect(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is wrong but the first guess, from which no fit to sensors as they are is found."""
    one = make_log(straight, gentle(straight, 20.0), seed=3)
    unfit(monkeypatch, lambda c, passes: passes == fits.MAX_PASSES)
    d = diagnosis.diagnose(straight, [one], straight.machine.filter)
    assert (d.verdict, d.findings, d.before.data.noise_inflation, d.before.exact) == ("clean", (), 1, True)


def test_coarse_sensors_blur_no_estimate(straight: Model) -> None:
    """A right model has the misfit that noise makes, and parameters are where sharp sensors have them."""
    one = make_log(straight, gentle(straight, 20.0), seed=3)
    sharp = fits.fit_machine(straight.machine, [one], straight.machine.filter)
    coarse = replace(
        sharp.data,
        measurements=tuple(
            replace(r, noise_inflation=fits.SENSOR_NOISE_INFLATIONS[0]) for r in sharp.data.measurements
        ),
    )
    blurred = fits.refit(straight.machine, replace(sharp, data=coarse), 0.0)
    assert not blurred.estimated
    assert 0.5 < blurred.fit.cost / blurred.expected_cost < 2
    seen = ~blurred.fit.unidentifiable
    assert seen.sum() >= len(seen) - 1
    assert np.abs((blurred.fit.X - sharp.fit.X) / blurred.fit.std)[seen].max() < 0.7
    (again,) = fits.resume_with_true_sensor_noise([blurred], 0.0, run_in_turn)
    assert again is not None
    np.testing.assert_allclose(again.fit.X, sharp.fit.X, atol=0.02 * sharp.fit.std.max(), rtol=1e-3)
    assert fits.with_true_sensor_noise(blurred).fit.cost == pytest.approx(sharp.fit.cost, rel=0.2)


def unneeded(model: Model, *texts: str) -> tuple[fits.ExtendedFit, list[selection.Choice]]:
    """A clean log's stage, and effects chosen for it all the same, all in one fit."""
    clean = calm(model)
    entries = [placing.parse_effect(text, model.machine, 12.0) for text in texts]
    both = fits.refit(placing.with_effects(model.machine, *entries), clean, 0.0)
    return clean, [selection.Choice(e.name, both, 1000.0, 1.0, 100, (), 1.0) for e in both.model.effects]


def test_an_amount_that_nothing_shows_is_not_sure(straight: Model) -> None:
    """It is held where it began and its deviation says nothing; the effect goes all the same, before one that is."""
    clean, chosen = unneeded(straight, "compaction_per_pass=0.3", "stribeck_friction@rear_roll=9")
    both, names = chosen[0].stage, [x.name for x in chosen]
    assert [bool(both.fit.unidentifiable[both.model.base.names.index(n)]) for n in names] == [True, False]
    assert [x.name for x in diagnosis.drop_unneeded(clean, chosen)] == names[1:]


def test_an_amount_and_its_shapes_are_sure_together(straight: Model) -> None:
    """Where each may stand for the other, neither is sure by itself."""
    name = "encoder_eccentricity@front_roll"
    entry = placing.parse_effect(f"{name}=0.01", straight.machine, 12.0)
    stage = calm(prediction.build(placing.with_effects(straight.machine, entry), fit_shapes=True))
    fit, names = stage.fit, stage.model.base.names
    at = [names.index(n) for n in (name, f"{name}.cos2", f"{name}.sin2")]
    X, covariance = fit.X.copy(), np.diag(fit.std**2)
    unit = np.array([[1.0, -0.95, 0.0], [-0.95, 1.0, 0.0], [0.0, 0.0, 1.0]])
    X[at], covariance[np.ix_(at, at)] = (
        np.array([2.0, 2.0, 1.0]) * fit.std[at],
        unit * np.outer(fit.std[at], fit.std[at]),
    )
    for unseen, expected in (([], 8 / 0.05 + 1), (at[1:], 4.0), (at, 0.0)):
        told = replace(fit, X=X, covariance=covariance, unidentifiable=np.isin(np.arange(len(X)), unseen))
        assert selection.wald_statistic(name, replace(stage, fit=told)) == pytest.approx(expected)


@pytest.mark.parametrize("percent", [-0.5, 0.5])
def test_what_foretells_nothing_is_no_name(percent: float, straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect whose amount is hardly known must pay on stretches hidden from the fit, however good that is."""
    clean, chosen = unneeded(straight, "ground_slope=0.001", "rolling_resistance@rear_roll=9")
    names = [x.name for x in chosen]
    monkeypatch.setattr(selection, "required_likelihood_ratio", lambda *_: -np.inf)
    seen: list[int] = []

    def measured(before: hold_out.HoldOutErrors, after: hold_out.HoldOutErrors) -> SimpleNamespace:
        seen.append(len(before.squares))
        assert before.squares.shape == after.squares.shape
        return SimpleNamespace(percent=percent)

    monkeypatch.setattr(diagnosis.gains, "hold_out_gain", measured)
    left = [x.name for x in diagnosis.drop_unneeded(clean, chosen)]
    assert left == (names if percent > 0 else names[1:])
    assert min(seen) > 0


@pytest.mark.slow
@pytest.mark.parametrize(("share", "seed"), [(0.03, 3), (0.03, 4), (0.2, 3), (0.4, 3), (3.0, 3), (30.0, 4)])
def test_a_file_that_is_far_off_is_no_cause(straight: Model, share: float, seed: int) -> None:
    """A clean log, the file's contacts at so large a share of the true ones."""
    one = make_log(straight, gentle(straight, 20.0), seed=seed)
    bodies = []
    for b in straight.machine.body:
        if b.contact is not None:
            Kx = b.contact.Kx.model_copy(update={"value": share * float(b.contact.Kx)})
            b = b.model_copy(update={"contact": b.contact.model_copy(update={"Kx": Kx})})
        bodies.append(b)
    far = prediction.build(straight.machine.model_copy(update={"body": tuple(bodies)}))
    found = diagnosis.diagnose(far, [one], straight.machine.filter)
    assert not found.findings
    assert found.verdict == "clean"


@pytest.mark.slow
def test_ctrl_c_ends_the_search_and_keeps_the_answer_so_far(sloping: Path, straight: Model) -> None:
    ready = prepare(straight, [sloping], needed_sensors(straight, "joint"))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def press(share: float, what: str) -> None:
        if what == "fitting the model":
            os.kill(os.getpid(), signal.SIGINT)

    try:
        found = package.explain(straight, ready.logs, straight.machine.filter, press)
    finally:
        signal.signal(signal.SIGINT, before)
    assert found.cut_short == "Ctrl-C"
    nothing = replace(
        found, diagnosis=replace(found.diagnosis, verdict="unexplained", findings=(), stages=()), gains=()
    )
    assert "the search for its cause was ended by Ctrl-C before it found one" in findings.answer_text(nothing)
