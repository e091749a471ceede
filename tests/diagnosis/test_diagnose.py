"""`excite diagnose` as people and scripts use it: what it says and leaves behind, what its machine file is good for."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from support.commands import Excite
from support.drives import gentle, held_straight
from support.logs import calm, logged, make_log, slope

from excite import diagnosis as package
from excite.diagnosis import (
    RivalPair,
    diagnosis,
    evidence,
    findings,
    fits,
    hold_out,
    magnitude_interval,
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
            np.zeros(count),
        )

    made = hold_out.hold_out_gain(errs(4.0, 0, 0, 1), errs(1.0, 1, 2, 2))
    assert made is not None
    assert (made.before, made.percent) == (pytest.approx(400.0), pytest.approx(50.0))
    assert hold_out.hold_out_gain(errs(4.0, 0), errs(1.0, 1)) is None
    assert hold_out.hold_out_gain(None, errs(1.0, 1)) is None


def test_one_stretch_tells_no_interval() -> None:
    def errs(by: float) -> hold_out.HoldOutErrors:
        return hold_out.HoldOutErrors(
            (("u1", "N m"),), np.array([[by]]), np.array([[1]]), np.ones(1), np.ones(1), np.zeros(1), np.zeros(1)
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


def concluded(
    before: fits.ExtendedFit, after: fits.ExtendedFit, *names: str, gain: float = 1000.0, n_candidates: int = 100
) -> diagnosis.Diagnosis:
    """Conclude a search that ended with these effects, each of such a gain, and nothing left."""
    choices = tuple(selection.Choice(name, gain, None) for name in names)
    return diagnosis.conclude(before, selection.Search(after, choices, 0.0, n_candidates, {}))


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
    (found,) = concluded(stage, stage, "ground_slope@machine", gain=1e4).findings
    assert found.magnitude == pytest.approx(0.01, rel=0.02)
    assert found.shapes["direction"][0] == pytest.approx(0, abs=0.2)


def test_bad_input_is_refused_before_the_work(sloping: Path, tmp_path: Path, excite: Excite) -> None:
    for arguments, words in (
        (("va12_straight", tmp_path / "none.csv"), "none.csv"),
        (("va12", sloping), "no column"),
        (("va12_straight", sloping, sloping), "given twice"),
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
    assert wrong.cost - right.cost > selection.CLEARLY_BETTER


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
def test_a_drive_that_hardly_shows_the_machine_still_shows_a_cause(straight: Model) -> None:
    """Masses are known to a half here: a fit goes where no motion is."""
    hidden = placing.parse_effect("stribeck_friction@front_roll=150", straight.machine, 40.0)
    truth = prediction.build(placing.with_effects(straight.machine, hidden))
    table = sensors.measure(truth, simulate(truth, held_straight()), seed=6)
    (found,) = diagnosis.diagnose(straight, [log.from_table(table, straight.machine)], straight.machine.filter).findings
    assert found.name == "stribeck_friction@front_roll"
    assert abs(found.magnitude - 150) < 3 * found.magnitude_std


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

    # One whose amount comes out as nothing goes, and the others stay, however sure its amount seems to be.
    for wrong in ("asymmetric_coulomb@rear_roll=60", "shear_saturation@rear_roll=6"):
        extended = placing.with_effects(found.after.machine, placing.parse_effect(wrong, straight.machine, 40.0))
        dropped: dict[str, str] = {}
        more = selection._without_idle(found.before, fits.refit(extended, found.after), set(), dropped)
        without = selection._fits_without(found.before, more, run_in_turn)
        needless = selection._needless(more, without)
        assert [n for n in selection.added(found.before, more) if n != needless] == selection.added(
            found.before, found.after
        )
    assert selection._needless(found.after, selection._fits_without(found.before, found.after, run_in_turn)) is None


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
        (found,) = concluded(stage, stage, name, gain=level, n_candidates=2000).findings
        assert found.p_value <= selection.MAX_P_VALUE * 1.000001


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
        after = fits.refit(packed(amount, each), before)
        k = after.model.base.names.index(name)
        assert each == 50.0 or 0.06 - after.fit.X[k] > 3 * after.fit.std[k]
        (found,) = concluded(before, after, name).findings
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
    stage: Any = SimpleNamespace(model=straight, fit=fit)
    rows = findings.parameter_table(diagnosis.Diagnosis("clean", (), stage, stage, 0.0, ()))
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
@pytest.mark.parametrize("findings", [(), ("a finding",)])
def test_every_log_is_drawn(findings: tuple[str, ...], straight: Model, tmp_path: Path) -> None:
    logs = [make_log(straight, gentle(straight, 6.0), seed=k) for k in (3, 4)]
    stage = fits.fit_machine(straight.machine, logs, straight.machine.filter)
    d: Any = SimpleNamespace(before=stage, after=stage, findings=findings, curves=(), extended=bool(findings))
    for draw in diagnosis_figures.figure_calls(tmp_path, d, "a roller"):
        draw()
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
    after = fits.refit(placing.with_effects(straight.machine, entry), before)
    names = after.model.base.names

    def said(name: str, value: float) -> diagnosis.Diagnosis:
        X = after.fit.X.copy()
        X[names.index("rolling_resistance@rear_roll")] = 400.0
        X[names.index(name)] = value
        stage = replace(after, fit=replace(after.fit, X=X, covariance=np.diag((0.01 * X) ** 2)))
        return concluded(before, stage, "rolling_resistance@rear_roll")

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
        assert selection.is_plausible("vibration_on@rear_roll", stage) == felt


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
    assert selection.is_plausible("roll_out_of_round@rear_roll", stage) == so


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


def test_the_likelihood_of_withheld_stretches_is_found_where_it_is_asked_for(straight: Model) -> None:
    """One for each stretch."""
    stage = calm(straight)
    plain, found = (hold_out.hold_out_errors(stage, likelihood=asked) for asked in (False, True))
    assert plain is not None
    assert found is not None
    assert np.isnan(plain.log_likelihood).all()
    assert found.log_likelihood.shape == (len(found.squares),)
    assert np.isfinite(found.log_likelihood).all()


def test_stretches_are_withheld_only_for_what_is_asked(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a cause nobody asks for a likelihood; where torques tell the error, nobody for that of the motion."""
    stage, asked, true = calm(straight), list[bool](), hold_out.hold_out_errors
    d = concluded(stage, stage)

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


@pytest.mark.slow
def test_a_harmonic_is_no_ripple_elsewhere(straight: Model, straight_motion: Motion) -> None:
    """Straight on, all rolls turn alike: what is twice an order of a known ripple is one of the same machine's."""

    def ripple(amount: float, order: float) -> EffectEntry:
        entry = placing.parse_effect(f"torque_ripple@rear_roll={amount}", straight.machine, 40.0)
        return entry.model_copy(update={"shape": {**entry.shape, "order": Quantity(value=order, source="assumed")}})

    hiding = prediction.build(placing.with_effects(straight.machine, ripple(40, 14)))
    one = make_log(hiding, simulate(hiding, straight_motion.u), seed=3, known=straight)
    named = []
    for known in (straight.machine, placing.with_effects(straight.machine, ripple(40, 7))):
        stage = fits.fit_machine(known, [one], straight.machine.filter)
        named.append({x.name for x in evidence.choose(stage.form(selection.candidates_of(stage))).candidates})
    bare, rippled = named
    assert bare & {"torque_ripple@front_roll", "torque_ripple@rear_roll"}
    assert "torque_ripple@front_roll" not in rippled


def test_a_value_that_is_nothing_can_be_written() -> None:
    """A fit may end a hair beside zero, which no machine file holds."""
    shapes = {"begin": (-1e-15, 0.1, "s"), "length": (5.0, 0.1, "s")}
    found = diagnosis.Finding("vibration_on", "rear_roll", (), 1e-9, 0.1, 0.01, "-", shapes, 100.0)
    assert [float(found.entry.shape[name]) for name in shapes] == [0.0, 5.0]


def test_what_a_clean_log_does_not_show_goes(straight: Model) -> None:
    """An amount that nothing shows is held where it began, and its deviation says nothing; one that must be positive
    falls to zero; others come out as nothing clear."""
    clean = calm(straight)
    for text, seen in (
        ("compaction_per_pass=0.3", False),
        ("torque_deadband@front_roll=20", True),
        ("ground_slope=0.001", True),
    ):
        entry = placing.parse_effect(text, straight.machine, 12.0)
        more = fits.refit(placing.with_effects(straight.machine, entry), clean)
        assert (more.wald(entry.label) > 0) == seen
        assert selection.added(clean, selection._without_idle(clean, more, set(), {})) == []


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
        assert replace(stage, fit=told).wald(name) == pytest.approx(expected)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "seed"), [(0.03, 3), (0.4, 3), (30.0, 4)])
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
        found, diagnosis=replace(found.diagnosis, verdict="unexplained", findings=(), without=()), gains=()
    )
    assert "the search for its cause was ended by Ctrl-C before it found one" in findings.answer_text(nothing)
