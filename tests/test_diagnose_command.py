"""`excite diagnose` as people and scripts use it: what it says and leaves behind, what its machine file is good for."""

from __future__ import annotations

import json
import multiprocessing
import pickle
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import Excite, designed

from excite import (
    amounts,
    checkup,
    choosing,
    diagnose,
    findings,
    gain,
    log,
    misfit,
    newton,
    portrait,
    profiles,
    sensors,
    stages,
)
from excite.separate import Rivals
from excite.sidebyside import forked, in_turn
from excite.simulate import Motion, simulate
from model import machine, placing, prediction
from model.file import Quantity
from model.machine import EffectEntry
from model.prediction import Model


def logged(model: Model, motion: Motion, path: Path, seed: int, *texts: str) -> Path:
    """The log of a motion's torques on a machine with effects, as the sensors write it."""
    entries = [placing.parse(text, model.machine, float(motion.t[-1])) for text in texts]
    extended = prediction.build(placing.extended(model.machine, *entries)) if entries else model
    driven = simulate(extended, motion.u, q0=motion.q[0], nu0=motion.nu[0])
    sensors.measure(extended, driven, seed=seed).to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("diagnose")


@pytest.fixture(scope="module")
def sloping(straight: Model, straight_motion: Motion, place: Path) -> Path:
    return logged(straight, straight_motion, place / "sloping.csv", 7, "ground_slope=0.01")


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
    one = log.check(sensors.measure(straight, straight_motion, seed=3), straight.machine)
    found = gain.withheld(stages.fitted(straight.machine, [one], straight.machine.filter))
    assert found is not None
    assert len(found.squares) >= 3 * 6 - 1
    assert found.counts.sum() == pytest.approx(len(found.squares) * 200 * len(found.sensors), rel=0.05)


def test_a_gain_is_of_the_stretches_that_both_models_foretell() -> None:
    """One of the turns in which a short log is hidden may leave no fit."""

    def errs(by: float, *turns: int) -> gain.Withheld:
        ones, count = np.ones((len(turns), 1)), len(turns)
        each = (np.array(turns) + 1) ** 2
        return gain.Withheld(
            (("u1", "N m"),),
            by * ones * each[:, None],
            np.ones((count, 1), int),
            np.ones(1),
            np.ones(1),
            np.array(turns),
        )

    made = gain.gain(errs(4.0, 0, 0, 1), errs(1.0, 1, 2, 2))
    assert made is not None
    assert (made.before, made.percent) == (pytest.approx(400.0), pytest.approx(50.0))
    assert gain.gain(errs(4.0, 0), errs(1.0, 1)) is None
    assert gain.gain(None, errs(1.0, 1)) is None


def test_one_stretch_tells_no_interval() -> None:
    def errs(by: float) -> gain.Withheld:
        return gain.Withheld((("u1", "N m"),), np.array([[by]]), np.array([[1]]), np.ones(1), np.ones(1), np.zeros(1))

    made = gain.gain(errs(4.0), errs(1.0))
    assert made is not None
    assert (made.percent, made.interval) == (pytest.approx(50.0), None)


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

    extended = prediction.build(machine.load(out / "machine.toml"))
    assert extended.effects[0].values["A"] == pytest.approx(0.01, rel=0.01)
    again = simulate(prediction.build(placing.extended(straight.machine, _slope(straight))), straight_motion.u)
    right, wrong = (simulate(m, straight_motion.u) for m in (extended, straight))
    assert np.abs(right.q - again.q).max() < 0.05 * np.abs(wrong.q - again.q).max()


def test_where_nothing_promises_anything_effects_begin_anew(
    sloping: Path, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Far from any fit first-order gains say little. The right cause is found by what it makes of exact dynamics."""
    for way in ("choose", "sharp"):
        monkeypatch.setattr(f"excite.choosing.{way}", lambda *asked: None)
    monkeypatch.setattr("excite.choosing.unfollowed", lambda stage, together: (stage, [], frozenset()))
    one = log.read(sloping, straight.machine)
    found = diagnose.diagnose(straight, [one], straight.machine.filter)
    assert [f.name for f in found.findings] == ["ground_slope@machine"]
    assert found.findings[0].amount == pytest.approx(0.01, rel=0.02)
    monkeypatch.setattr("excite.choosing.unlikely", lambda scanned, stage, tried, together: (stage, []))
    assert diagnose.diagnose(straight, [one], straight.machine.filter).verdict == "unexplained"


def test_a_second_cause_with_which_exact_dynamics_follow_is_no_flaw_of_the_first(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forces hide how good a first cause's formula is, so that what gains a sixth of it may be its flaw; but not where
    exact dynamics follow the log with both."""
    slope = placing.parse("ground_slope=0.002", straight.machine, 30.0)
    both = prediction.build(placing.extended(straight.machine, slope))
    motion = simulate(both, gentle(straight, 30.0).u)
    one = log.check(sensors.measure(both, motion, seed=3), straight.machine)
    stage = stages.forced(stages.fitted(straight.machine, [one], straight.machine.filter), in_turn)
    assert stage.fit.disturbed > 0
    scores = choosing.scored(stage, in_turn)
    first = choosing.Choice("torque_gain@rear_roll", stage, 6 * scores[0].gain, 1.0, 200, (), 1.0)
    found = choosing.choose(stage, scores, [first], in_turn, lambda share, what: None, 0.0)
    assert found is not None
    assert (found.name, found.stage.exact, found.stage.near) == ("ground_slope@machine", True, True)
    monkeypatch.setattr("excite.choosing.freed", lambda found, together: (None for _ in found))
    assert choosing.choose(stage, scores, [first], in_turn, lambda share, what: None, 0.0) is None


@pytest.mark.parametrize(
    ("names", "verdict"),
    [
        (("torque_gain@rear_roll", "torque_ripple@rear_roll", "stribeck_friction@rear_roll"), "named"),
        (("torque_gain@rear_roll", *(f"friction_transition@{x}" for x in ("front_roll", "rear_roll", "x"))), "named"),
        (("ground_slope@machine", "torque_ripple@rear_roll", "stribeck_friction@rear_roll", "torque_gain@x"), "named"),
        (
            ("torque_gain@rear_roll", "torque_ripple@rear_roll", "stribeck_friction@rear_roll", "ground_slope@machine"),
            "unexplained",
        ),
    ],
)
def test_many_names_are_none(
    names: tuple[str, ...], verdict: str, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What takes four kinds of causes, none of which explains most, is something that isn't known."""
    stage = calm(straight)
    gains = {"ground_slope@machine": 1000.0} if verdict == "named" else {}
    chosen = [choosing.Choice(n, stage, gains.get(n, 100.0 + k), 1.0, 200, (), 1.0) for k, n in enumerate(names)]
    kept = {"fitted": stage, "extended": (chosen, 0.0), "reviewed": chosen, "needed": chosen}
    for name, answer in (*kept.items(), ("weighed", (chosen, (), None))):
        monkeypatch.setattr(f"excite.diagnose.{name}", lambda *asked, answer=answer: answer)
    monkeypatch.setattr("excite.diagnose._finding", lambda *asked, **more: SimpleNamespace(tied_with=()))
    found = diagnose.diagnose(straight, stage.prepared.logs, straight.machine.filter)
    assert (found.verdict, len(found.findings)) == (verdict, len(names) if verdict == "named" else 0)
    if verdict == "unexplained":
        assert found.after is stage
        assert found.nearest is not None
        assert found.nearest.name == names[-1]
        assert found.nearest.share == pytest.approx(103 / 406)


def test_a_phase_that_was_found_the_other_way_round_is_turned(sloping: Path, straight: Model) -> None:
    """A fit that began with a slope downhill keeps it so, its amount negative; people are given a positive one."""
    one = log.read(sloping, straight.machine)
    uphill = _slope(straight)
    turned = {"direction": Quantity(value=np.pi, source="assumed")}
    downhill = uphill.model_copy(
        update={"amount": Quantity(value=-0.008, source="assumed"), "shape": turned},
    )
    stage = stages.fitted(placing.extended(straight.machine, downhill), [one], straight.machine.filter)
    assert dict(zip(stage.model.base.names, stage.fit.X, strict=True))["ground_slope@machine"] < 0
    choice = choosing.Choice("ground_slope@machine", stage, 1e4, 1.0, 200, (), 0.5)
    found = diagnose._finding(choice, stage, 0.0, alone=True)
    assert found.amount == pytest.approx(0.01, rel=0.02)
    assert found.shapes["direction"][0] == pytest.approx(0, abs=0.2)


def test_what_promises_nothing_at_all_is_not_tried(
    emps: Model, emps_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A candidate whose best amount has the wrong sign can't even be put into a machine file."""
    one = log.read(emps_data, emps.machine)
    stage = stages.fitted(emps.machine, [one], emps.machine.filter)
    scores = choosing.scored(stage, in_turn)
    late = next(s for s in scores if s.candidate.placed.effect.name == "channel_delay")
    scores = (replace(late, gain=0.0, values={**late.values, "A": -0.01}),)
    monkeypatch.setattr("excite.choosing.scored", lambda stage, together: scores)
    assert not choosing.unlikely(stage, stages.forced(stage, in_turn), (), in_turn)[1]
    # Nor is what was begun already.
    begun = list[str]()

    def begin(machines: Sequence[machine.Machine], *asked: object) -> list[None]:
        begun.extend(e.name for m in machines for e in m.effect)
        return [None for _ in machines]

    scores = (replace(late, gain=100.0, values={**late.values, "A": 0.01}),)
    monkeypatch.setattr("excite.choosing.begun", begin)
    for tried, expected in (((late.candidate.name,), []), ((), ["channel_delay"])):
        assert choosing.unlikely(stage, stage, tried, in_turn) == (stage, [])
        assert begun == expected


def _slope(straight: Model) -> EffectEntry:
    return placing.parse("ground_slope=0.01", straight.machine, 40.0)


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


def test_a_drive_is_designed_for_what_is_tied(straight: Model, tmp_path: Path) -> None:
    """From its log both amounts can be told, each beside the other whatever its shape; a sensor's flaw is passed over,
    and without a problem to design for there is none."""
    short = straight.machine.problems["S40"].model_copy(
        update={"duration_s": straight.machine.problems["S40"].duration_s.model_copy(update={"value": 12.0})}
    )
    machine = straight.machine.model_copy(update={"problems": {"S40": short}, "problem": "S40"})
    told = ("torque_deadband@rear_roll=80", "asymmetric_coulomb@rear_roll=60", "encoder_eccentricity@rear_roll=0.01")
    deadband, coulomb, eccentric = (placing.parse(text, machine, 12.0) for text in told)
    pairs = [Rivals(machine, (deadband, eccentric)), Rivals(machine, (deadband, coulomb))]
    assert checkup.separating(tmp_path, machine, pairs[:1], True) is None
    nowhere = machine.model_copy(update={"problem": None})
    assert checkup.separating(tmp_path, nowhere, pairs, True) is None
    assert not list(tmp_path.iterdir())

    said = checkup.separating(tmp_path, machine, pairs, False)
    assert said == {"between": list(told[:2]), "folder": None}
    said = checkup.separating(tmp_path, machine, pairs, True)
    assert said is not None
    assert said["between"] == list(told[:2])
    drawn = json.loads((tmp_path / said["folder"] / "summary.json").read_text())
    assert drawn["objective"] == "discrimination"
    assert drawn["max_violation"] < 1e-3
    assert said["sigma_percent"] == max(drawn["sigma_percent"][t.partition("=")[0]] for t in told[:2]) < 20

    # Driven with the one, the log prefers it to the other by what the design promises.
    torque, q0, nu0 = profiles.read(tmp_path / said["folder"] / "profile.csv", straight)
    both = [prediction.build(placing.extended(machine, e)) for e in (deadband, coulomb)]
    motion = simulate(both[0], torque, q0=q0, nu0=nu0)
    one = log.check(sensors.measure(both[0], motion, seed=2), machine)
    right, wrong = (stages.fitted(m.machine, [one], machine.filter).fit for m in both)
    assert wrong.cost - right.cost > choosing.CLOSE


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
    """Ahead both push the same body: a tie by physics, which only turns break."""
    log = logged(straight, straight_motion, tmp_path / "log.csv", 5, "rolling_resistance@front_roll=400")
    code, stdout, _ = excite("diagnose", "va12_straight", log, "--out", tmp_path / "d", "--json")
    said = json.loads(stdout)
    (found,) = said["findings"]
    names = {f"{found['effect']}@{found['where']}", *found["tied_with"]}
    assert (code, said["verdict"]) == (0, "tied")
    assert names == {"rolling_resistance@front_roll", "rolling_resistance@rear_roll"}
    assert said["separating_run"] == "tight turns to both sides"


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
    has = prediction.build(machine.load(own))
    log = logged(has, straight_motion, tmp_path / "log.csv", 9, "rolling_resistance@rear_roll=400")
    code, stdout, _ = excite("diagnose", own, log, "--out", tmp_path / "d", "--json")
    assert code == 0
    assert [f["effect"] for f in json.loads(stdout)["findings"]] == ["rolling_resistance"]
    text = (tmp_path / "d" / "machine.toml").read_text()
    assert "extends" not in text
    new = machine.load(tmp_path / "d" / "machine.toml")
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
    """Along S40 masses are known to a half: a fit goes where no motion is (6), or stops short of the cause (1, 10)."""
    hidden = placing.parse("stribeck_friction@front_roll=150", straight.machine, 40.0)
    truth = prediction.build(placing.extended(straight.machine, hidden))
    table = sensors.measure(truth, designed("S40", truth), seed=seed)
    (found,) = diagnose.diagnose(straight, [log.check(table, straight.machine)], straight.machine.filter).findings
    assert found.name == "stribeck_friction@front_roll"
    assert abs(found.amount - 150) < 3 * found.amount_std


@pytest.mark.slow
def test_the_order_in_which_several_are_found_does_not_count(straight: Model, straight_motion: Motion) -> None:
    """Two at once; found the other way round they stay, and a wrong name that came before or between them goes. Side by
    side or in turn, the numbers are the same."""
    true = [
        placing.parse(text, straight.machine, 40.0) for text in ("ground_slope=0.004", "torque_deadband@rear_roll=60")
    ]
    both = prediction.build(placing.extended(straight.machine, *true))
    motion = simulate(both, straight_motion.u)
    one = log.check(sensors.measure(both, motion, seed=4), straight.machine)
    found, same = (diagnose.diagnose(straight, [one], straight.machine.filter, together=t) for t in (forked, in_turn))
    assert found.findings == same.findings
    np.testing.assert_array_equal(found.after.fit.X, same.after.fit.X)
    names = [e.label for e in true]
    assert (found.verdict, sorted(f.name for f in found.findings)) == ("named", sorted(names))
    for f, e in zip(sorted(found.findings, key=lambda f: f.name), true, strict=True):
        assert abs(f.amount - float(e.amount)) < 4 * f.amount_std

    wrong = placing.parse("asymmetric_coulomb@rear_roll=60", straight.machine, 40.0)
    more = stages.refitted(placing.extended(found.after.machine, wrong), found.after, 0.0)
    name = wrong.label
    for order, stage in (
        (names[::-1], found.after),
        ([name, *names], more),
        ([names[0], name, names[1]], more),
    ):
        chosen = [choosing.Choice(n, stage, 1000.0, 1.0, 100, (), 1.0) for n in order]
        again = diagnose.reviewed(found.before, chosen)
        assert [x.name for x in again] == [n for n in order if n in names]
        assert again[-1].stage.fit.cost == pytest.approx(found.after.fit.cost, abs=0.1)
    # One whose amount comes out as nothing goes, and the others stand as if it had never been there. What was gained on
    # the way makes it no surer.
    chosen = [choosing.Choice(n, more, 1000.0, 1.0, 100, (), 1.0) for n in (name, *names)]
    p_values = [f.p_value for f in diagnose.concluded(found.before, more, chosen, (), 0.0).findings]
    assert p_values[0] > 0.05
    assert max(p_values[1:]) < 1e-100
    left = diagnose.needed(found.before, chosen)
    assert [x.name for x in left] == names
    assert [e.name for e in left[0].stage.machine.effect] == [names[0].split("@")[0]]
    assert [x.name for x in diagnose.needed(found.before, left)] == names
    # Nor does one stay whose amount says that it is nothing, however sure that amount seems to be.
    faint = placing.parse("shear_saturation@rear_roll=6", straight.machine, 40.0)
    more = stages.refitted(placing.extended(found.after.machine, faint), found.after, 0.0)
    name = faint.label
    chosen = [choosing.Choice(n, more, 1000.0, 1.0, 100, (), 1.0) for n in (name, *names)]
    assert [x.name for x in diagnose.needed(found.before, chosen)] == names


def test_what_gets_a_name_is_no_chance(straight: Model, straight_motion: Motion) -> None:
    """The more shapes an effect has, the more it must gain; with just that much its p-value is at most CHANCE."""
    told = ("torque_gain@rear_roll=0.1", "stribeck_friction@rear_roll=150", "vibration_on@rear_roll=0.2")
    entries = [placing.parse(text, straight.machine, 40.0) for text in told]
    has = prediction.build(placing.extended(straight.machine, *entries))
    motion = simulate(has, straight_motion.u, q0=straight_motion.q[0], nu0=straight_motion.nu[0])
    stage = stages.fitted(
        has.machine, [log.check(sensors.measure(has, motion, seed=3), has.machine)], has.machine.filter
    )
    names = [e.name for e in stage.model.effects]
    assert [choosing.freedom(n, stage) for n in names] == [1, 2, 3]
    levels = [choosing.threshold(n, stage, 2000) for n in names]
    assert levels[0] == choosing.LEVEL <= levels[1] < levels[2]
    for name, level in zip(names, levels, strict=True):
        chosen = [choosing.Choice(name, stage, level, 1.0, 2000, (), 1.0)]
        assert diagnose.concluded(stage, stage, chosen, (), 0.0).findings[0].p_value <= choosing.CHANCE * 1.000001


def test_an_amount_is_as_unsure_as_shapes_that_a_log_hardly_tells(straight: Model) -> None:
    """Of a soil that one way of three metres has hardly packed: how much of it is to come nothing tells, while about a
    short way that a pass takes its deviation says that all of it has."""
    name = "compaction_per_pass@drive"

    def packed(amount: float, each: float) -> machine.Machine:
        entry = placing.parse(f"compaction_per_pass={amount}", straight.machine, 15.0)
        values = {**entry.shape, "pass": told(each), "counted": told(2.0)}
        return placing.extended(straight.machine, entry.model_copy(update={"shape": values}))

    def told(value: float) -> Quantity:
        return Quantity(value=value, source="assumed")

    hidden, t = prediction.build(packed(0.06, 60.0)), np.arange(0, 15.01, 0.01)
    slow = np.minimum(1, np.minimum(t, 15 - t) / 2)
    push = (2500 * np.sin(2 * np.pi * t / 7.5) + 600 * np.sin(2.6 * t)) * slow
    motion = simulate(hidden, np.column_stack([push, 0.8 * push]))
    assert 2 < np.ptp(motion.q[:, 0]) < 4
    one = log.check(sensors.measure(hidden, motion, seed=3), straight.machine)
    before = stages.fitted(straight.machine, [one], straight.machine.filter)
    for amount, each in ((0.05, 3.0), (0.05, 15.0), (0.05, 50.0)):
        after = stages.refitted(packed(amount, each), before, 0.0)
        k = after.model.base.names.index(name)
        assert each == 50.0 or 0.06 - after.fit.X[k] > 3 * after.fit.std[k]
        chosen = [choosing.Choice(name, after, 1000.0, 1.0, 100, (), 1.0)]
        (found,) = diagnose.concluded(before, after, chosen, (), 0.0).findings
        assert 0.06 - found.amount < 2.5 * found.amount_std
        assert found.amount_std < found.amount
    # Nor does it where the shape is held, as nothing shows it at all; a shape that is told needs no other fit.
    shape = after.model.base.names.index(f"{name}.pass")
    held = replace(after.fit, unseen=np.arange(len(after.fit.X)) == shape)
    sure = after.fit.covariance.copy()
    sure[shape] = sure[:, shape] = 0.0
    for fit, more in ((replace(held, covariance=sure), True), (replace(after.fit, covariance=sure), False)):
        assert (amounts.unsure(after.placed(name), replace(after, fit=fit), in_turn) > 0) == more


def test_a_figure_says_that_nothing_could_be_withheld() -> None:
    """In place of an axis without bars."""
    account: Any = SimpleNamespace(diagnosis=SimpleNamespace(stages=()))
    for rms, shown in ((1e-3, True), (np.nan, False), (None, False)):
        row = {"unit": "rad", "rms_before": rms, "rms_after": rms, "systematic_before_percent": 40.0}
        right = portrait.signals_figure(account, {"theta1": row}, "a roller").axes[1]
        assert right.axison == shown
        assert any("no fit to the rest" in text.get_text() for text in right.texts) != shown


def test_the_usual_range_of_a_shape(va12: Model) -> None:
    """Of all that is tried in its form, and of what there is; an instant has none."""

    def usual(text: str, shape: str, **values: float) -> tuple[float, ...]:
        entry = placing.parse(text, va12.machine, 40.0)
        own = {**entry.shape, **{n: Quantity(value=x, source="assumed") for n, x in values.items()}}
        (placed,) = prediction.build(placing.extended(va12.machine, entry.model_copy(update={"shape": own}))).effects
        return amounts._usual(placed, shape, va12.machine)

    assert usual("compaction_per_pass=0.3", "pass") == (5.0, 50.0)
    assert usual("slip_relaxation@front_roll=0.05", "moment") == (0.0, 1.0)
    assert usual("pump_coupling@drive=0.1", "lag", hose=1.0) == (0.03, 0.3)
    assert usual("vibration_on@front_roll=0.3", "begin") == ()
    assert usual("shear_saturation@front_roll=0.3", "bend") == ()
    low, high = usual("roll_out_of_round@front_roll=0.002", "load")
    assert 0 < low < high


def test_what_no_machine_has_is_no_name(straight: Model, straight_motion: Motion) -> None:
    """Friction that drives, by whatever name the file calls it, or a resistance that pushes: unexplained, with what
    comes nearest and why it is none; as plain as it may be otherwise, and with nothing left that is odd."""
    entry = placing.parse("rolling_resistance@rear_roll=400", straight.machine, 40.0)
    one = log.check(sensors.measure(straight, straight_motion, seed=3), straight.machine)
    before = stages.fitted(straight.machine, [one], straight.machine.filter)
    after = stages.refitted(placing.extended(straight.machine, entry), before, 0.0)
    names = after.model.base.names

    def said(name: str, value: float) -> diagnose.Diagnosis:
        X = after.fit.X.copy()
        X[names.index("rolling_resistance@rear_roll")] = 400.0
        X[names.index(name)] = value
        stage = replace(after, fit=replace(after.fit, X=X, covariance=np.diag((0.01 * X) ** 2)))
        chosen = [choosing.Choice("rolling_resistance@rear_roll", stage, 1000.0, 1.0, 100, (), 1.0)]
        kept, odd, nearest = diagnose.weighed(before, chosen)
        return diagnose.concluded(before, kept[-1].stage if kept else before, kept, odd, 0.0, nearest)

    assert said("Fs4", 150.0).verdict == "named"
    for name, value in (("Fs4", -150.0), ("Fv1", -90.0), ("Kx4", 1e5), ("rolling_resistance@rear_roll", -400.0)):
        d = said(name, value)
        assert (d.verdict, d.findings, d.share) == ("unexplained", (), 0.0)
        assert d.nearest is not None
        assert (d.nearest.name, len(d.nearest.impossible)) == ("rolling_resistance@rear_roll", 1)
        assert d.nearest.impossible[0].startswith(f"{name} = -" if value < 0 else f"{name} = 1e+05")
        assert "which no machine has" in findings.answer(findings.account(d))


@pytest.mark.parametrize(("left", "kept"), [(0.0, True), (900.0, True), (1100.0, False)])
def test_a_name_that_is_faint_beside_another_is_none_under_forces(
    left: float, kept: bool, straight: Model, straight_motion: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forces may leave nothing without any name: one that explains little by exact dynamics must gain with them what
    compares with another's promise."""
    entry = placing.parse("rolling_resistance@rear_roll=400", straight.machine, 40.0)
    one = log.check(sensors.measure(straight, straight_motion, seed=3), straight.machine)
    before = stages.fitted(straight.machine, [one], straight.machine.filter)
    loose = stages.refitted(placing.extended(straight.machine, entry), before, 0.0)
    far = replace(loose, fit=replace(loose.fit, cost=3 * loose.noise))
    chosen = [choosing.Choice("rolling_resistance@rear_roll", far, 100.0, 1.0, 100, (), 1.0, loose)]
    monkeypatch.setattr(diagnose, "_odd", lambda stage: ("theta1: a slow error",) if stage is far else ())
    names, _, nearest = diagnose.weighed(before, chosen, left)
    assert (bool(names), nearest is None) == (kept, kept)


def test_a_vibration_shakes_a_sensor_in_one_log_at_least(straight: Model) -> None:
    """A log too short to tell says nothing either way."""
    entry = placing.parse("vibration_on@rear_roll=0.3", straight.machine, 20.0)
    told = {"begin": 5.0, "length": 6.0, "shake": 80.0, "frequency": 27.0}
    entry = entry.model_copy(update={"shape": {n: Quantity(value=v, source="assumed") for n, v in told.items()}})
    shaken = prediction.build(placing.extended(straight.machine, entry))
    quiet, loud = (log.check(sensors.measure(m, gentle(m, 20.0), seed=3), straight.machine) for m in (straight, shaken))
    short = log.check(sensors.measure(straight, gentle(straight, 4.0), seed=4), straight.machine)
    for logs, felt in (
        ([loud], True),
        ([quiet], False),
        ([short], True),
        ([short, quiet], False),
        ([quiet, loud], True),
    ):
        stage = stages.fitted(shaken.machine, logs, straight.machine.filter)
        assert choosing._felt("vibration_on@rear_roll", stage) == felt


@pytest.mark.parametrize(("load", "so"), [(50e3, True), (2e3, False), (400e3, False)])
def test_a_roll_out_of_round_carries_a_share_of_the_machine(load: float, so: bool, straight: Model) -> None:
    """An eccentric encoder has no load at all, an unbalanced roll no eccentricity: both would fit otherwise."""
    entry = placing.parse("roll_out_of_round@rear_roll=0.002", straight.machine, 12.0)
    entry = entry.model_copy(update={"shape": {"load": Quantity(value=load, source="assumed")}})
    known = placing.extended(straight.machine, entry)
    one = log.check(sensors.measure(prediction.build(known), gentle(straight, 12.0), seed=3), straight.machine)
    stage = stages.fitted(known, [one], straight.machine.filter)
    names = stage.model.base.names
    assert "roll_out_of_round@rear_roll.load" in names
    assert choosing._felt("roll_out_of_round@rear_roll", stage) == so


def test_what_a_process_found_can_be_sent_back(straight: Model, straight_motion: Motion) -> None:
    """An answer that can't be sent would be computed again in silence."""

    def sent(calls: Sequence[Callable[[], Any]]) -> Generator[Any, None, None]:
        return (pickle.loads(pickle.dumps(call())) for call in calls)

    one = log.check(sensors.measure(straight, straight_motion, seed=3), straight.machine)
    stage = stages.fitted(straight.machine, [one], straight.machine.filter)
    slope = placing.extended(straight.machine, placing.parse("ground_slope=0.001", straight.machine, 10.0))
    for disturbed in (0.0, 1.0):
        (found,) = stages.begun([slope], stage, disturbed, sent)
        assert found is not None
        assert found.fit.disturbed < max(disturbed, 0.01)
        assert (found.loose is None) == found.exact
    (found,) = stages.refits([(slope, stage, 0.0)], sent)
    assert found is not None


def test_a_cause_without_which_nothing_is_left_and_no_machine_possible_stays_alone(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is nothing by which a further effect could tell that it makes the machine possible again."""
    stage = calm(prediction.build(placing.extended(straight.machine, _slope(straight))))
    choice = choosing.Choice("ground_slope@machine", stage, 1e4, 1.0, 1, (), 1.0)
    asked = list[stages.Stage]()

    def scored(of: stages.Stage, *given: Any) -> tuple[()]:
        asked.append(of)
        return ()

    monkeypatch.setattr(choosing, "scored", scored)
    for lines, left, goes_on in ((("M = -1",), 0.0, False), ((), 0.0, True), (("M = -1",), 1e4, True)):
        asked.clear()
        monkeypatch.setattr(diagnose, "_impossible", lambda of, lines=lines: lines)
        more = replace(choice, stage=replace(stage, fit=replace(stage.fit, cost=stage.fit.cost + left)))
        found, _ = diagnose.extended(stage, [more], in_turn, lambda share, what: None)
        assert found == [more]
        assert bool(asked) == goes_on


@pytest.mark.parametrize(("found", "asked"), [((True, True), 3), ((False, True), 2)])
def test_where_no_way_to_the_likeliest_cause_is_found_no_others_are_tried(
    found: Sequence[bool], asked: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By exact dynamics: all are judged with disturbing forces then."""
    stage = calm(straight)
    likely = choosing.scored(stage, in_turn)
    likely = list({s.candidate.name: s for s in likely if s.values["A"] != 0}.values())[:3]
    assert len(likely) == 3
    wished = list[str]()

    def refits(wishes: Sequence[stages.Wish], *given: Any) -> list[stages.Stage | None]:
        told = [*found[len(wished) :], True]
        wished.extend(machine.effect[-1].label for machine, _, _ in wishes)
        return [stage if yes else None for yes, _ in zip(told, wishes, strict=False)]

    monkeypatch.setattr(choosing, "refits", refits)
    monkeypatch.setattr(choosing, "_felt", lambda name, of: True)
    choosing._tries(stage, likely, in_turn, lambda k: None)
    assert len(wished) == asked


def test_coarse_sensors_are_no_measure_of_how_near_sharp_ones_come(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit that goes on from one with coarse sensors, and comes near the logs, is gone on with; from one with sensors
    as they are it must come nearer by far than that."""
    stage = calm(straight)
    calls = list[float]()

    def nearly(*given: Any) -> newton.Fit:
        calls.append(given[3])
        if len(calls) == 1:
            raise newton.NotConverged("no fit", replace(stage.fit, cost=1.1 * stage.noise), 5.0)
        return stage.fit

    monkeypatch.setattr(stages, "_nearly", nearly)
    coarse = replace(stage, prepared=stages._noisy(stage.prepared, 10.0))
    coarse = replace(coarse, fit=replace(stage.fit, cost=coarse.noise))
    assert coarse.near
    assert stages._resume(stage.prepared, coarse, 0.0).cost == stage.fit.cost
    assert calls == [0.0, 0.0]
    calls.clear()
    with pytest.raises(newton.NotConverged):
        stages._resume(stage.prepared, stage, 0.0)


def test_ways_that_are_not_needed_are_given_up(straight: Model) -> None:
    """Of the ways to a fit the first one is enough for a clean log, whatever has been begun beside it."""
    one = log.check(sensors.measure(straight, gentle(straight, 12.0), seed=3), straight.machine)
    carried: list[int] = []

    def counted(calls: Sequence[Callable[[], Any]]) -> Generator[Any, None, None]:
        for k, call in enumerate(calls):
            carried.append(k)
            yield call()

    others = multiprocessing.active_children()
    there = stages.fitted(straight.machine, [one], straight.machine.filter, forked)
    assert set(multiprocessing.active_children()) <= set(others)
    here = stages.fitted(straight.machine, [one], straight.machine.filter, counted)
    assert carried == [0]
    np.testing.assert_array_equal(there.fit.X, here.fit.X)


def test_a_fit_whose_steps_cease_to_shrink_ends(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Near an answer as one that is as good as found, far from any without; whoever is patient goes on for longer."""
    stage = calm(straight)
    p, true = stage.prepared, newton.newton_step
    steps: list[float] = []

    def scripted(*args: Any) -> Any:
        covariance, move, _, cost = true(*args)
        return covariance, move, steps.pop(0), cost

    monkeypatch.setattr(newton, "newton_step", scripted)
    for end, spent, found in ((0.3, 7, True), (30.0, 8, False)):
        for patient, passes in ((True, 14), (False, spent)):
            steps[:] = [500.0, 90.0, 80.0, 40.0, *[end] * 10]
            with pytest.raises(newton.NotConverged) as failed:
                newton.iterate(
                    p.c, p.records, stage.fit.points, stage.fit.X, p.starts, 0.0, p.held, passes=14, patient=patient
                )
            hopeless = newton.HOPELESS[0] + 1 if patient and not found else passes
            assert 14 - len(steps) == hopeless
            assert (failed.value.nearly is not None) == found


def test_a_fit_is_found_where_its_steps_are_small_enough(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """With disturbing forces, whose deviations are no promise, sooner than without, unless that is asked for."""
    stage = calm(straight)
    p, true = stage.prepared, newton.newton_step
    steps: list[float] = []

    def scripted(*args: Any) -> Any:
        covariance, move, _, cost = true(*args)
        return covariance, move, steps.pop(0), cost

    monkeypatch.setattr(newton, "newton_step", scripted)
    for disturbed, enough, spent in ((0.0, None, 5), (0.1, None, 4), (0.0, newton.ENOUGH, 4), (0.1, newton.NEARLY, 3)):
        steps[:] = [5.0, 1.5, 0.5, 0.15, 1e-4, 1e-4]
        newton.iterate(
            p.c, p.records, stage.fit.points, stage.fit.X, p.starts, disturbed, p.held, passes=6, enough=enough
        )
        assert 6 - len(steps) == spent


def test_a_fit_that_is_not_worth_more_passes_is_given_up(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as its cost doesn't fall in two passes, from the fourth on; not while it falls, nor where it costs no
    more."""
    stage = calm(straight)
    p, true = stage.prepared, newton.newton_step
    seen: list[Any] = []

    def scripted(c: Any, records: Any, linear: Any, *asked: Any) -> Any:
        covariance, move, *_ = true(c, records, linear, *asked)
        if not any(linear is x for x in seen):  # one pass is computed twice
            seen.append(linear)
        return covariance, move, 50.0, costs[min(len(seen), len(costs)) - 1]

    monkeypatch.setattr(newton, "newton_step", scripted)
    monkeypatch.setattr(newton, "LOST", (8, np.inf, 1.0))
    for costs, spent in (
        ([900.0, 900.0], 4),
        ([900.0, 800.0, 700.0, 600.0, 550.0, 549.0, 548.0], 7),
        ([900.0, 400.0, 300.0, 450.0], 8),
        ([900.0, 400.0, 300.0, 600.0], 4),
    ):
        seen.clear()
        with pytest.raises(newton.NotConverged) as failed:
            newton.iterate(p.c, p.records, stage.fit.points, stage.fit.X, p.starts, 0.0, p.held, passes=8, worth=500.0)
        assert len(seen) == spent
        assert failed.value.fit is not None
        assert failed.value.fit.cost == costs[-1]


@pytest.mark.parametrize(
    ("steps", "spent"),
    [
        ([400.0, 300.0, 200.0, 100.0, 190.0], 5),  # hardly less than two passes before
        ([400.0, 300.0, 200.0, 100.0, 170.0, 91.0], 6),
        ([400.0, 300.0, 200.0, 100.0, 170.0, 80.0, 29.0, 29.0], 8),  # large no more
        ([400.0, 300.0, 200.0, 100.0, 170.0, 80.0, 140.0, 70.0], 8),
    ],
)
def test_steps_that_stay_large_end_a_fit(
    steps: list[float], spent: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = calm(straight)
    p, true = stage.prepared, newton.newton_step
    seen: list[Any] = []

    def scripted(c: Any, records: Any, linear: Any, *asked: Any) -> Any:
        covariance, move, *_ = true(c, records, linear, *asked)
        if not any(linear is x for x in seen):
            seen.append(linear)
        return covariance, move, steps[min(len(seen), len(steps)) - 1], 500.0

    monkeypatch.setattr(newton, "newton_step", scripted)
    monkeypatch.setattr(newton, "HOPELESS", (8, 10.0))
    with pytest.raises(newton.NotConverged):
        newton.iterate(p.c, p.records, stage.fit.points, stage.fit.X, p.starts, 0.0, p.held, passes=8)
    assert len(seen) == spent


def test_what_takes_too_little_of_a_beginning_is_not_fitted_to_the_whole(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exact dynamics follow the log without its cause and leave much: of what begins anew only what takes a good part
    of that from the first quarter, beside what the model without it comes to there, is fitted to all of it."""
    stuck = prediction.build(
        placing.extended(straight.machine, placing.parse("torque_deadband@rear_roll=150", straight.machine, 40.0))
    )
    one = log.check(sensors.measure(stuck, simulate(stuck, gentle(straight, 40.0).u), seed=3), straight.machine)
    stage = stages.fitted(straight.machine, [one], straight.machine.filter)
    assert stage.exact
    assert stage.excess > 1000
    lengths, _ = fits(monkeypatch)
    monkeypatch.setattr(stages, "SHORTEST", 5.0)
    worth, whole = stage.fit.cost - 0.3 * stage.excess, len(one)
    for effect, found in (("torque_deadband@rear_roll=100", True), ("torque_offset_drift@front_roll=0.1", False)):
        lengths.clear()
        machine = placing.extended(straight.machine, placing.parse(effect, straight.machine, 40.0))
        (made,) = stages.begun([machine], stage, 0.0, in_turn, worth)
        assert (made is not None) == found
        assert lengths[:2] == [whole // 4] * 2  # without it, and with it
        assert (max(lengths) == whole) == found


def test_what_is_held_is_where_it_is_held_a_pass_later(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """However far it went until the log was known not to show it, and however much it makes sense above zero only; how
    far it is from there is no step, but nothing is found, not even nearly, before it is there."""
    stage = calm(straight)
    p, true, scale = stage.prepared, newton.newton_step, stage.model.scale
    nominal = stage.model.nominal
    sure = stage.fit.std / np.maximum(np.abs(stage.fit.X), scale)
    worst = int(np.argmax(np.where(p.held, 0.0, sure)))
    seen: list[tuple[float, float]] = []
    steps: list[float] = []

    def blind(c: Any, records: Any, linear: Any, points: Any, X: np.ndarray, prior: np.ndarray, damping: float) -> Any:
        covariance, move, step, cost = true(c, records, linear, points, X, prior, damping)
        if prior[worst] < newton.HELD**-2:
            covariance[worst, worst] = 1e6
        seen.append((X[worst], step))
        return covariance, move, steps.pop(0) if steps else step, cost

    monkeypatch.setattr(newton, "newton_step", blind)
    monkeypatch.setattr(newton, "LARGEST_STEP", 0.01)
    monkeypatch.setitem(vars(p.c.model), "positive", np.arange(len(scale)) == worst)
    X = stage.fit.X + 30 * scale * (np.arange(len(scale)) == worst)
    for told, disturbed in (([], 0.0), ([50.0, 50.0, 50.0, 50.0, 0.005], 0.0), ([50.0, 50.0, 50.0, 50.0, 0.1], 0.1)):
        seen.clear()
        steps[:] = [*told, *[50.0 for _ in told]]
        with pytest.raises(newton.NotConverged) as failed:  # the others only creep
            newton.iterate(p.c, p.records, stage.fit.points, X, p.starts, disturbed, p.held, 0.0, passes=7)
        assert abs(seen[newton.SETTLED][0] - nominal[worst]) > 20 * scale[worst]
        # The pass in which it is held is computed twice.
        assert seen[newton.SETTLED + 2][0] == pytest.approx(nominal[worst], abs=newton.AWAY * scale[worst])
        assert max(step for _, step in seen[newton.SETTLED + 1 :]) < 1e4
        assert failed.value.fit is not None
        assert failed.value.fit.unseen[worst]
        assert failed.value.nearly is None or not told


def test_a_step_that_was_cut_short_goes_further_when_it_is_told_again(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit is found from a torque offset forty times its scale off, which without that is given up on the way."""
    stage = calm(straight)
    p, k = stage.prepared, stage.model.base.names.index("u10")
    start = stage.fit.X - 40 * stage.model.scale * (np.arange(len(stage.fit.X)) == k)
    asked = p.c, p.records, stage.fit.points, start, p.starts, 0.0, p.held, 0.0
    monkeypatch.setattr(newton, "LARGEST_STEP", 0.1)
    found = newton.iterate(*asked)
    assert (np.abs(found.X - stage.fit.X) < stage.fit.std).all()
    monkeypatch.setattr(newton, "FURTHER", 1.0)
    with pytest.raises(newton.NotConverged):
        newton.iterate(*asked)


def test_the_whole_log_is_fitted_where_its_beginning_can_be(
    sloping: Path, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cause that leaves a quarter of a log far off leaves all of it so. A log that is hardly longer is fitted at
    once, and so is one that is followed without any cause: then none is waited for that costs more than it is worth."""
    one = log.read(sloping, straight.machine)
    stage = stages.fitted(straight.machine, [one], straight.machine.filter)
    lengths, forces = fits(monkeypatch)
    right = placing.extended(straight.machine, _slope(straight))
    wrong = placing.extended(straight.machine, placing.parse("brake_drag@rear_roll=50", straight.machine, 40.0))
    (good,) = stages.begun([right], stage, 0.0, in_turn)
    assert good is not None
    cost, whole = good.fit.cost, len(one)
    for onset, worth, first, follows in (
        (5.0, np.inf, whole // 4, True),
        (15.0, np.inf, 1500, True),
        (30.0, np.inf, whole, True),
        (5.0, cost + 1, whole, True),
        (5.0, cost - 1, whole, False),
    ):
        monkeypatch.setattr(stages, "SHORTEST", onset)
        for machines, found in ((right, follows), (wrong, False)):
            lengths.clear()
            (made,) = stages.begun([machines], stage, 0.0, in_turn, worth)
            assert (made is not None and made.near) == found
            assert lengths[0] == first
            assert (max(lengths) == whole) == (found or first == whole)
    # What forces don't bring near isn't either, nor is the whole log fitted where they don't bring its beginning near.
    for onset, first in ((5.0, whole // 4), (30.0, whole)):
        monkeypatch.setattr(stages, "SHORTEST", onset)
        for machines, found in ((right, True), (wrong, False)):
            lengths.clear()
            forces.clear()
            (made,) = stages.begun([machines], stage, 1.0, in_turn)
            assert (made is not None) == found
            assert lengths[0] == first
            assert (max(lengths) == whole) == (found or first == whole)
            assert forces[0] == 1.0


def test_beside_a_cause_only_that_is_fitted_whose_beginning_tells_that_it_comes_as_near(
    sloping: Path, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stays off is of no use any more; a rival that comes near as well is still found. Where what came near is no
    cause all others are fitted."""
    one = log.read(sloping, straight.machine)
    stage = stages.fitted(straight.machine, [one], straight.machine.filter)
    lengths, _ = fits(monkeypatch)
    monkeypatch.setattr(stages, "SHORTEST", 5.0)
    monkeypatch.setattr(stages, "FAR", np.inf)
    right = placing.extended(straight.machine, _slope(straight))
    wrong = placing.extended(straight.machine, placing.parse("torque_gain@front_roll=0.1", straight.machine, 40.0))
    for machines, near, enough, tried in (
        ([wrong], [False], True, True),
        ([right, wrong], [True, False], True, False),
        ([right, wrong], [True, False], False, True),
        ([wrong, right], [False, True], True, True),
        ([right, wrong, right], [True, False, True], True, False),
    ):
        lengths.clear()
        found: list[bool] = []
        whole = [0]
        for made in stages.begun(machines, stage, 0.0, in_turn, np.inf, lambda k, x, so=enough: so and x.near):
            found.append(made is not None and made.near)
            whole.append(lengths.count(len(one)))
        assert found == near
        at = machines.index(wrong)
        assert (whole[at + 1] > whole[at]) == tried
    running = {x.pid for x in multiprocessing.active_children()}  # of other tests
    ways = stages.begun([right, wrong, right], stage, 0.0, forked, np.inf, lambda k, x: x.near)
    assert [x is not None for x in ways] == [True, False, True]
    assert {x.pid for x in multiprocessing.active_children()} <= running
    for felt in (True, False):
        monkeypatch.setattr(choosing, "_felt", lambda name, x, felt=felt: felt and name == "b")
        (made,) = stages.begun([right], stage, 0.0, in_turn)
        assert made is not None
        assert choosing._settles(["a", "b"], 1, made) == felt
        assert not choosing._settles(["a", "b"], 0, made)
        assert not choosing._settles(["a", "b"], 1, replace(made, fit=replace(made.fit, disturbed=0.1)))


@pytest.mark.parametrize(
    ("forces", "asked", "coarse", "settled", "held"),
    [
        (0.0, 0.0, 1.0, True, True),
        (0.1, 0.1, 1.0, True, True),
        (0.1, 1.0, 1.0, True, True),
        (1.0, 0.1, 1.0, True, False),  # smaller forces may show it
        (0.1, 0.0, 1.0, True, False),
        (1.0, 1.0, 10.0, True, False),  # and so may finer sensors
        (0.0, 0.0, 1.0, False, False),
    ],
)
def test_a_fit_goes_on_without_what_was_not_seen(
    forces: float, asked: float, coarse: float, settled: bool, held: bool, straight: Model
) -> None:
    stage = calm(straight)
    names, unseen = stage.model.base.names, stage.fit.unseen.copy()
    unseen[names.index("u10")] = True
    of = replace(stage, settled=settled, fit=replace(stage.fit, unseen=unseen, disturbed=forces))
    of = replace(of, prepared=stages._noisy(of.prepared, coarse))
    more = stages._noisy(stages._resumed(placing.extended(straight.machine, _slope(straight)), stage), 1.0)
    told = stages._untold(more, of, asked)
    assert [n for n, yes in zip(more.c.model.base.names, told, strict=True) if yes] == (["u10"] if held else [])


def test_what_was_not_seen_is_judged_again(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the log shows after all is let go: before a fit is found, however soon that is. What it doesn't show never
    leaves the file's value."""
    stage = calm(straight)
    p, names = stage.prepared, stage.model.base.names
    k = names.index("u10")
    assert not stage.fit.unseen[k]
    untold = np.arange(len(names)) == k
    start = np.where(untold, stage.model.nominal, stage.fit.X)
    true, passes = newton.linearise, list[float]()

    def noted(c: Any, r: Any, point: Any, first: Any, X: np.ndarray, *asked: Any) -> Any:
        passes.append(float(X[k]))
        return true(c, r, point, first, X, *asked)

    monkeypatch.setattr(newton, "linearise", noted)
    asked = p.c, p.records, stage.fit.points, start, p.starts, 0.0, p.held, newton.RESUMED
    found = newton.iterate(*asked, untold=untold)
    assert not found.unseen[k]
    assert abs(found.X[k] - stage.fit.X[k]) < 0.1 * stage.fit.std[k]
    passes.clear()
    monkeypatch.setattr(newton, "UNSEEN", 0.5 * float(stage.fit.std[k] / max(abs(start[k]), stage.model.scale[k])))
    held = newton.iterate(*asked, untold=untold)
    assert held.unseen[k]
    assert passes == pytest.approx([stage.model.nominal[k]] * len(passes), abs=newton.AWAY * stage.model.scale[k])


@pytest.mark.parametrize(
    ("disturbed", "cost", "found", "expected"),
    [
        (0.0, 9.9, False, True),
        (0.0, 10.1, False, False),
        (0.0, 10.1, True, True),
        (1.0, 2.19, False, True),
        (1.0, 2.21, False, False),
        (1.0, 2.21, True, False),
        (1.0, None, False, True),
    ],
)
def test_what_the_beginning_of_a_log_may_cost(
    disturbed: float, cost: float | None, found: bool, expected: bool, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By exact dynamics ten times its noise, unless a fit is found; with forces no more beside its noise than the whole
    log may: three tenths of what is four times as much. What can't be integrated may set out."""
    stage = calm(straight)
    quarter = len(stage.prepared.logs[0]) // 4
    monkeypatch.setattr(stages, "SHORTEST", quarter / 100)
    asked = iterated(stage, monkeypatch, lambda samples: cost, found)
    onset = stages._onset(stage, disturbed, np.inf)
    assert onset is not None
    # Exact dynamics were asked first where they are far off, and both what they do after a few passes.
    assert (onset.samples, asked[0], asked[-1]) == ((quarter,), quarter, quarter)
    assert (len(asked) == 1) == (disturbed > 0)
    assert stages._sets_out(stage.prepared, replace(onset, without=np.inf), disturbed) == expected


@pytest.mark.parametrize(("cost", "before", "passes"), [(9.0, 9.9, 1), (9.0, 10.1, 2), (2.0, 1.0, 2)])
def test_what_a_few_passes_show_to_do_nothing_goes_no_further(
    cost: float, before: float, passes: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is, nine tenths and more of what the model leaves without it, and more than there may be; what is less than
    that is given all passes."""
    stage = calm(straight)
    quarter = len(stage.prepared.logs[0]) // 4
    monkeypatch.setattr(stages, "SHORTEST", quarter / 100)
    told = [before]
    asked = iterated(stage, monkeypatch, lambda samples: told[-1], False)
    onset = stages._onset(stage, 1.0, np.inf)
    assert onset is not None
    assert onset.without == pytest.approx(before * quarter)
    asked.clear()
    told.append(cost)
    assert stages._sets_out(stage.prepared, onset, 1.0) == (cost < 2.2)
    assert asked == [quarter] * passes


def test_a_beginning_tells_where_the_model_as_it_is_stays_far_off(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shortest such one: what stays off it too is no cause. A quarter, where none is up to a half."""
    stage = calm(straight)
    n = len(stage.prepared.logs[0])
    monkeypatch.setattr(stages, "SHORTEST", n / 400)
    for late, share in ((0.0, 0.25), (0.3, 0.33), (0.45, 0.5), (0.9, 0.25)):
        with monkeypatch.context() as patch:
            iterated(stage, patch, lambda samples, late=late: 20.0 if samples > late * n else 5.0, False)
            onset = stages._onset(stage, 0.0, np.inf)
        assert onset is not None
        assert onset.samples == (int(share * n),)


def iterated(
    stage: stages.Stage, monkeypatch: pytest.MonkeyPatch, cost: Callable[[int], float | None], found: bool
) -> list[int]:
    """In place of fits: what each costs, times its noise, by how many samples it has, and whether it is found. How many
    samples were asked for, one after the other."""
    asked = list[int]()
    monkeypatch.setattr(stages.Prepared, "readings", property(lambda p: float(len(p.records[0].used))))

    def fit_of(prepared: stages.Prepared, *given: Any, **more: Any) -> newton.Fit:
        asked.append(len(prepared.records[0].used))
        told = cost(asked[-1])
        fit = None if told is None else replace(stage.fit, cost=told * prepared.readings)
        if found and fit is not None:
            return fit
        raise newton.NotConverged("no fit", fit, 50.0)

    monkeypatch.setattr(stages, "_iterated", fit_of)
    return asked


def test_smaller_forces_are_tried_where_the_model_is_near(
    sloping: Path, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They leave more. Where large ones leave it far off, the file's parameters show where to look."""
    one = log.read(sloping, straight.machine)
    far = stages.fitted(straight.machine, [one], straight.machine.filter)
    assert (far.prepared.coarse, far.settled) == (10.0, False)
    far = replace(far, loose=None)
    for name in ("_lessened", "freed"):
        true = getattr(stages, name)
        monkeypatch.setattr(stages, name, lambda *asked, name=name, true=true: (tried.append(name), true(*asked))[1])
    # So far off every fit is near, then none, then none is worth anything.
    for strong, most, expected, settled in (
        (1e3, 1e3, ["_lessened", "freed"], True),
        (0.1, 1e3, [], True),
        (0.1, 0.5, [], False),
    ):
        tried = list[str]()
        monkeypatch.setattr(stages, "STRONG", strong)
        monkeypatch.setattr(stages, "FAR", most)
        told = stages.forced(far, in_turn)
        assert (tried, told.settled) == (expected, settled)
    np.testing.assert_allclose(told.fit.X, straight.nominal, rtol=1e-3)


def test_stretches_are_withheld_from_fits_that_are_near_enough(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What they predict is asked for, not how sure they are."""
    stage, true, asked = calm(straight), newton.iterate, list[tuple[float, float]]()

    def noted(*given: Any, **more: Any) -> newton.Fit:
        asked.append((given[5], more["enough"]))
        return true(*given, **more)

    monkeypatch.setattr(newton, "iterate", noted)
    for disturbed in (0.0, 0.1):
        assert gain.withheld(replace(stage, fit=replace(stage.fit, disturbed=disturbed))) is not None
    assert set(asked) == {(0.0, newton.ENOUGH), (0.1, newton.NEARLY)}


def test_candidates_are_scored_once_along_a_fit(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Along another one anew, however alike."""
    stage, scans = calm(straight), list[newton.Fit]()
    true = choosing.evidence.scan

    def noted(along: Any, fit: newton.Fit, *asked: Any) -> Any:
        scans.append(fit)
        return true(along, fit, *asked)

    monkeypatch.setattr(choosing.evidence, "scan", noted)
    first = choosing.scored(stage, in_turn)
    assert choosing.scored(stage, in_turn) is first
    other = replace(stage, fit=replace(stage.fit, cost=2 * stage.fit.cost))
    assert [s.gain for s in choosing.scored(other, in_turn)] == [s.gain for s in first]
    assert scans == [stage.fit, other.fit]


def test_what_begins_anew_beside_exact_dynamics_must_take_a_good_part_of_the_misfit(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where none could be fitted, or forces had to help, anything that lets the model follow the log will do."""
    stage, asked = calm(straight), list[float]()

    def begin(machines: Any, of: Any, disturbed: float, together: Any, worth: float, enough: Any) -> list[None]:
        asked.append(worth)
        return [None for _ in machines]

    monkeypatch.setattr("excite.choosing.begun", begin)
    far = replace(stage, fit=replace(stage.fit, cost=2 * stage.noise))
    for of in (far, replace(far, settled=False), replace(far, fit=replace(far.fit, disturbed=0.1))):
        assert choosing.unlikely(of, of, (), in_turn) == (of, [])
    assert asked == [pytest.approx(2 * stage.noise - 0.3 * 0.98 * stage.noise), np.inf, np.inf]


def test_a_fit_that_fails_stands_where_it_was_as_good_as_found(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise where it was last. Steps that swing between what costs alike end a fit under disturbing forces as well:
    none by exact dynamics, none whose costs rise or still fall."""
    stage = calm(straight)
    p, true = stage.prepared, newton.newton_step
    seen: list[np.ndarray] = []
    far = [500.0, 90.0, 80.0]

    def failed(sizes: list[float], costs: list[float], disturbed: float) -> newton.NotConverged:
        steps = iter(zip(sizes, costs, strict=True))
        seen.clear()

        def scripted(*args: Any) -> Any:
            covariance, move, *_ = true(*args)
            seen.append(args[4])
            return covariance, move, *next(steps)

        monkeypatch.setattr(newton, "newton_step", scripted)
        points, X = stage.fit.points, stage.fit.X * 1.01
        with pytest.raises(newton.NotConverged) as raised:
            newton.iterate(p.c, p.records, points, X, p.starts, disturbed, p.held, passes=10, patient=False)
        return raised.value

    end = failed([*far, 4.0, 0.6, 0.8, 5.0, 4.0, 6.0, 20.0], [1000.0] * 10, 0.0)
    assert end.nearly is not None
    assert (end.step, end.nearly.X.tolist()) == (0.6, seen[4].tolist())
    for costs, disturbed, swung in (
        ([1000.0, 1010.0] * 5, 0.1, True),
        ([1000.0, 1010.0] * 5, 0.0, False),
        ([1000.0 * 2**k for k in range(10)], 0.1, False),
        ([1000.0 / 1.2**k for k in range(10)], 0.1, False),
    ):
        end = failed([*far, *[5.0] * 7], costs, disturbed)
        assert (end.nearly, end.step) == (None, 5.0)
        assert end.fit is not None
        assert end.fit.X.tolist() == seen[-1].tolist()
        assert (end.swinging is end.fit) == swung


def test_a_fit_that_came_near_the_log_is_gone_on_with(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """By exact dynamics: with disturbing forces every fit comes near, unless they are none larger than those with which
    a stage didn't. Far from the log it is given up, behind what was found already as well, and where a stage was near
    before."""
    stage = calm(straight)
    true, steps, times = newton.newton_step, list[float](), [1.0]

    def scripted(*args: Any) -> Any:
        covariance, move, _, cost = true(*args)
        return covariance, move, steps.pop(0), times[0] * cost

    monkeypatch.setattr(newton, "newton_step", scripted)
    lost = [500.0, 90.0, 80.0, 40.0, *[30.0] * 4]
    off = replace(stage, fit=replace(stage.fit, cost=2 * stage.noise))
    loose = replace(off, fit=replace(off.fit, disturbed=0.1))
    for of, disturbed, far, most, found in (
        (off, 0.0, 1.0, np.inf, True),
        (off, 0.0, 2.0, np.inf, False),
        (off, 0.1, 1.0, np.inf, False),
        (loose, 0.1, 1.0, np.inf, True),
        (loose, 0.1, 2.0, np.inf, False),
        (loose, 0.1, 1.0, stage.fit.cost / 2, False),
        (loose, 0.2, 1.0, np.inf, False),
        (replace(loose, fit=replace(loose.fit, cost=stage.noise)), 0.1, 1.0, np.inf, False),
        (off, 0.0, 1.0, stage.fit.cost / 2, False),
        (stage, 0.0, 1.0, np.inf, False),
    ):
        steps[:], times[0] = [*lost, 1.0, 0.01, 1e-4, 1e-6], far
        (tried,) = stages.refits([(stage.machine, of, disturbed)], in_turn, most)
        assert (tried is not None) == found
        if tried is None:
            assert len(steps) >= 4
        else:
            assert tried.fit.cost == pytest.approx(stage.fit.cost, abs=20 if disturbed else 1)


@pytest.mark.parametrize(("excess", "chosen"), [((0.0, 0.0), 0), ((4.0, 0.1), 1), ((4.0, 3.9), 1), ((4.0, 6.0), 0)])
def test_forces_hide_which_of_two_is_right(
    straight: Model, monkeypatch: pytest.MonkeyPatch, excess: tuple[float, float], chosen: int
) -> None:
    """Where the better one explains little without them, the other is tried without them too."""
    stage = calm(straight)
    best, other = ("ground_slope=0.009", "rolling_resistance@rear_roll=200")
    scores = {s.candidate.name: s for s in choosing.scored(stage, in_turn)}
    noise, tries = stage.noise, []
    for text, cost in ((best, noise), (other, noise + 600.0)):
        extended = placing.extended(straight.machine, placing.parse(text, straight.machine, 40.0))
        found = stages.refitted(extended, stage, 1.0)
        fit = replace(found.fit, cost=cost)
        tries.append((scores[found.model.effects[0].name], replace(found, fit=fit)))

    def freed(found: Sequence[Any], together: Any) -> Any:
        names = [s.candidate.name for s, _ in tries]
        for x in found:
            cost = noise * (1 + excess[names.index(x.model.effects[0].name)])
            yield replace(x, fit=replace(x.fit, cost=cost, disturbed=0.0))

    monkeypatch.setattr(choosing, "freed", freed)
    choice = choosing._chosen(tries, 3000.0, 100, in_turn)
    assert choice.name == tries[chosen][0].candidate.name
    assert choice.stage.exact
    assert choice.gain == pytest.approx(3000.0 - 600.0 * chosen)
    assert bool(choice.rivals) == (excess == (4.0, 3.9))


def test_a_harmonic_is_no_ripple_elsewhere(straight: Model, straight_motion: Motion) -> None:
    """Straight on, all rolls turn alike: what is twice an order of a known ripple is one of the same machine's."""

    def ripple(amount: float, order: float) -> EffectEntry:
        entry = placing.parse(f"torque_ripple@rear_roll={amount}", straight.machine, 40.0)
        return entry.model_copy(update={"shape": {**entry.shape, "order": Quantity(value=order, source="assumed")}})

    hiding = prediction.build(placing.extended(straight.machine, ripple(40, 14)))
    one = log.check(sensors.measure(hiding, simulate(hiding, straight_motion.u), seed=3), straight.machine)
    found = []
    for known in (straight.machine, placing.extended(straight.machine, ripple(40, 7))):
        stage = stages.fitted(known, [one], straight.machine.filter)
        found.append({s.candidate.name: s.gain for s in reversed(choosing.scored(stage, in_turn))})
    bare, rippled = found
    assert bare["torque_ripple@front_roll"] > 100
    assert "torque_ripple@front_roll" not in rippled
    assert "torque_ripple@rear_roll" not in rippled
    assert rippled.keys() >= bare.keys() - {"torque_ripple@front_roll", "torque_ripple@rear_roll"}


@pytest.mark.parametrize(
    ("forces", "near", "gained", "mapped", "least"),
    [
        (1.0, True, 0.0, False, 0.15 * 1e4),
        (0.1, False, 0.0, False, 0.15 * 1e4),
        (0.0, True, 0.0, False, 0.05 * 1e4),
        (0.0, False, 0.0, False, 0.15 * 1e4),
        (1.0, False, 0.0, False, 0.3 * 1e4),
        (1.0, False, 1e3, False, 0.3 * 1e4),
        (1.0, True, 1e3, False, 0.15 * 1e4),
        (0.0, False, 1e3, False, 0.3 * 1e4),
        (0.0, True, 1e3, False, 0.05 * 1e4),
        (0.0, True, 1e6, False, 0.005 * 1e6),
        (0.0, True, 1e6, True, 0.02 * 1e6),
    ],
)
def test_what_an_effect_must_gain_to_be_worth_a_place(
    forces: float, near: bool, gained: float, mapped: bool, least: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an excess of 1e4: a part; where large forces leave much the first must explain what the largest of three does,
    and where the model isn't near the log yet a further one as much. Of what another gained: what its formula is off
    by, the more where that looks at a map of the ground."""
    monkeypatch.setattr(choosing, "_sureness", lambda stage: 0.0)
    known = SimpleNamespace(name="a@b", mapped=mapped)
    stage: Any = SimpleNamespace(
        model=SimpleNamespace(effects=[known]),
        fit=SimpleNamespace(disturbed=forces),
        exact=forces == 0,
        near=near,
        rough=forces > 0 or not near,
        excess=1e4,
    )
    chosen: Any = [SimpleNamespace(name=known.name, gain=gained, left=1.0)] if gained else []
    candidate: Any = SimpleNamespace(placed=SimpleNamespace(effect=SimpleNamespace(timed=False)))
    assert choosing._least(stage, chosen, candidate, 0.0) == pytest.approx(least)


def test_who_gains_too_little_with_coarse_sensors_is_given_up(
    straight: Model, sloping: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first candidate on; the right one isn't."""
    stage = stages.fitted(straight.machine, [log.read(sloping, straight.machine)], straight.machine.filter)
    true, bars = choosing.refits, list[float]()

    def noted(wishes: Any, together: Any, most: float) -> Any:
        bars.append(most)
        return true(wishes, together, most)

    monkeypatch.setattr(choosing, "refits", noted)
    found = choosing.sharp(stage, in_turn)
    assert found is not None
    assert [x.name for x in found[1]] == ["ground_slope@machine"]
    assert bars[0] == stage.fit.cost - choosing.BEHIND * choosing.LEAST[1] * stage.excess
    assert stage.prepared.coarse > 1


def test_who_stays_behind_is_given_up(straight: Model, sloping: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where forces leave much a candidate is fitted as long as it comes to half of what it must gain, and where those
    that were fitted first gained that, the others as long as they come to half of what these did."""
    iterate = newton.iterate
    bars: list[tuple[str, float]] = []

    def noted(c: Any, *args: Any, **more: Any) -> newton.Fit:
        if len(args) > 9 and c.model.effects:
            bars.append((c.model.effects[0].name, args[9]))
        return iterate(c, *args, **more)

    monkeypatch.setattr(newton, "iterate", noted)
    stage = stages.fitted(straight.machine, [log.read(sloping, straight.machine)], straight.machine.filter)
    likely = choosing.scored(stage, in_turn)
    for pair, over in ((2, choosing.OVER), (1, 1e3)):
        monkeypatch.setattr(choosing, "PAIR", pair)
        monkeypatch.setattr(choosing, "OVER", over)
        bars.clear()
        choice = choosing.choose(stage, likely, (), in_turn, lambda share, what: None, 0.0)
        assert choice is not None
        assert choice.name == "ground_slope@machine"
        assert not stage.exact
        assert not stage.near
        first = stage.fit.cost - choosing.BEHIND * choosing.MAIN * stage.excess
        assert bars[0] == (choice.name, first)
        bar = next(bar for name, bar in bars if name != choice.name)
        assert bar == pytest.approx(first if pair > 1 else stage.fit.cost - choosing.BEHIND * choice.gain)
    texts = ("ground_slope=0.009", "roll_unbalance@rear_roll=500")
    machines = [placing.extended(straight.machine, placing.parse(t, straight.machine, 40.0)) for t in texts]
    for most, found in ((np.inf, [True, True]), (bar, [True, False])):
        tried = stages.refits([(m, stage, stage.fit.disturbed) for m in machines], in_turn, most)
        assert [x is not None for x in tried] == found


def gentle(model: Model, seconds: float) -> Motion:
    """Little torque for a short time."""
    t = np.arange(0, seconds + 0.01, 0.01)
    slow = np.minimum(1, np.minimum(t, seconds - t) / 2)
    return simulate(model, np.column_stack([1500 * np.sin(1.7 * t) * slow, 1200 * np.sin(2.6 * t) * slow]))


def calm(model: Model) -> stages.Stage:
    """The model fitted to a log of that without anything hidden."""
    one = log.check(sensors.measure(model, gentle(model, 12.0), seed=3), model.machine)
    return stages.fitted(model.machine, [one], model.machine.filter)


def fits(monkeypatch: pytest.MonkeyPatch) -> tuple[list[int], list[float]]:
    """Of every fit from now on: how many samples of the first log it is made to, and with which disturbing forces."""
    iterate, lengths, forces = newton.iterate, list[int](), list[float]()

    def noted(c: Any, records: Any, *asked: Any) -> newton.Fit:
        lengths.append(len(records[0].used))
        forces.append(asked[3])
        return iterate(c, records, *asked)

    monkeypatch.setattr(newton, "iterate", noted)
    return lengths, forces


def unfit(monkeypatch: pytest.MonkeyPatch, refused: Callable[[Any, int], bool], coarse: float = 1.0) -> None:
    """Some fits to sensors as they are, or up to so coarse, find nothing: told are chart and number of passes."""
    iterate = newton.iterate

    def found(c: Any, records: Any, *args: Any, **more: Any) -> newton.Fit:
        if records[0].coarse <= coarse and refused(c, args[6] if len(args) > 6 else 0):
            raise newton.NotConverged("no fit")
        return iterate(c, records, *args, **more)

    monkeypatch.setattr(newton, "iterate", found)


@pytest.mark.parametrize(("refused", "followed"), [(1, stages.COARSE[0]), (stages.COARSE[0], stages.COARSE[1])])
def test_what_is_followed_with_coarse_sensors_only_is_named(
    refused: float, followed: float, sloping: Path, straight: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No model without the slope can be fitted to sensors as they are, or to some that are much coarser."""
    unfit(monkeypatch, lambda c, passes: not c.model.effects, refused)
    d = diagnose.diagnose(straight, [log.read(sloping, straight.machine)], straight.machine.filter)
    assert d.verdict == "named"
    assert [f.name for f in d.findings] == ["ground_slope@machine"]
    assert abs(d.findings[0].amount - 0.01) < 2 * d.findings[0].amount_std < 0.001
    assert (d.before.prepared.coarse, d.before.settled) == (followed, False)
    assert (d.after.prepared.coarse, d.after.settled, d.after.exact) == (1, True, True)
    told = findings.account(d)
    assert told.whole is not None
    assert told.whole.interval[0] > 50
    assert told.located == ()
    assert all(np.isnan(row["std_before"]) and row["moved"] is None for row in findings.parameters(d).values())
    monkeypatch.setattr(checkup, "diagnose", lambda *args: d)
    said, _ = checkup.write(tmp_path, "va12_straight", straight, [sloping], "machine", lambda *a: None)
    assert any(f"fitted to sensors taken for {followed:g} times as noisy" in note for note in said["notes"])
    # Innovations are held against the sensors' true noise, not that of coarse ones.
    assert max(size.slow for size in misfit.mean_sizes(told.before).values()) > 20
    assert max(size.slow for size in misfit.mean_sizes(told.after).values()) < 3


def test_a_value_that_is_nothing_can_be_written() -> None:
    """A fit may end a hair beside zero, which no machine file holds."""
    shapes = {"begin": (-1e-15, 0.1, "s"), "length": (5.0, 0.1, "s")}
    found = diagnose.Finding("vibration_on", "rear_roll", (), 1e-9, 0.1, 0.01, "-", shapes, 100.0)
    assert [float(found.entry.shape[name]) for name in shapes] == [0.0, 5.0]


def test_a_model_that_coarse_sensors_lead_to_needs_no_effect(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is wrong but the first guess, from which no fit to sensors as they are is found."""
    one = log.check(sensors.measure(straight, gentle(straight, 20.0), seed=3), straight.machine)
    unfit(monkeypatch, lambda c, passes: passes == newton.PASSES)
    d = diagnose.diagnose(straight, [one], straight.machine.filter)
    assert (d.verdict, d.findings, d.before.prepared.coarse, d.before.exact) == ("clean", (), 1, True)


def test_coarse_sensors_blur_no_estimate(straight: Model) -> None:
    """A right model has the misfit that noise makes, and parameters are where sharp sensors have them."""
    one = log.check(sensors.measure(straight, gentle(straight, 20.0), seed=3), straight.machine)
    sharp = stages.fitted(straight.machine, [one], straight.machine.filter)
    coarse = replace(sharp.prepared, records=tuple(replace(r, coarse=stages.COARSE[0]) for r in sharp.prepared.records))
    blurred = stages.refitted(straight.machine, replace(sharp, prepared=coarse), 0.0)
    assert not blurred.settled
    assert 0.5 < blurred.fit.cost / blurred.noise < 2
    assert np.abs((blurred.fit.X - sharp.fit.X) / blurred.fit.std).max() < 0.7
    (again,) = stages.sharpened([blurred], 0.0, in_turn)
    assert again is not None
    np.testing.assert_allclose(again.fit.X, sharp.fit.X, atol=0.02 * sharp.fit.std.max(), rtol=1e-3)
    assert stages.as_measured(blurred).fit.cost == pytest.approx(sharp.fit.cost, rel=0.2)


def unneeded(model: Model, *texts: str) -> tuple[stages.Stage, list[choosing.Choice]]:
    """A clean log's stage, and effects chosen for it all the same, all in one fit."""
    clean = calm(model)
    entries = [placing.parse(text, model.machine, 12.0) for text in texts]
    both = stages.refitted(placing.extended(model.machine, *entries), clean, 0.0)
    return clean, [choosing.Choice(e.name, both, 1000.0, 1.0, 100, (), 1.0) for e in both.model.effects]


def test_an_amount_that_nothing_shows_is_not_sure(straight: Model) -> None:
    """It is held where it began and its deviation says nothing; the effect goes all the same, before one that is."""
    clean, chosen = unneeded(straight, "compaction_per_pass=0.3", "stribeck_friction@rear_roll=9")
    both, names = chosen[0].stage, [x.name for x in chosen]
    assert [bool(both.fit.unseen[both.model.base.names.index(n)]) for n in names] == [True, False]
    assert [x.name for x in diagnose.needed(clean, chosen)] == names[1:]


@pytest.mark.parametrize("percent", [-0.5, 0.5])
def test_what_foretells_nothing_is_no_name(percent: float, straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect whose amount is hardly known must pay on stretches hidden from the fit, however good that is."""
    clean, chosen = unneeded(straight, "ground_slope=0.001", "rolling_resistance@rear_roll=9")
    names = [x.name for x in chosen]
    monkeypatch.setattr(choosing, "threshold", lambda *_: -np.inf)
    seen: list[int] = []

    def measured(before: gain.Withheld, after: gain.Withheld) -> SimpleNamespace:
        seen.append(len(before.squares))
        assert before.squares.shape == after.squares.shape
        return SimpleNamespace(percent=percent)

    monkeypatch.setattr(diagnose.gains, "gain", measured)
    left = [x.name for x in diagnose.needed(clean, chosen)]
    assert left == (names if percent > 0 else names[1:])
    assert min(seen) > 0


@pytest.mark.parametrize(("share", "seed"), [(0.03, 3), (0.03, 4), (0.2, 3), (0.4, 3), (3.0, 3), (30.0, 4)])
def test_a_file_that_is_far_off_is_no_cause(straight: Model, share: float, seed: int) -> None:
    """A clean log, the file's contacts at so large a share of the true ones."""
    one = log.check(sensors.measure(straight, gentle(straight, 20.0), seed=seed), straight.machine)
    bodies = []
    for b in straight.machine.body:
        if b.contact is not None:
            Kx = b.contact.Kx.model_copy(update={"value": share * float(b.contact.Kx)})
            b = b.model_copy(update={"contact": b.contact.model_copy(update={"Kx": Kx})})
        bodies.append(b)
    far = prediction.build(straight.machine.model_copy(update={"body": tuple(bodies)}))
    found = diagnose.diagnose(far, [one], straight.machine.filter)
    assert not found.findings
    assert found.verdict == "clean"
