"""Blind logs: that they are what they say, and that the diagnosis names what was hidden in them.

The logs come from a second roller that shares no code with the program (`plant`, `causes`, `surprises`).
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support import plant
from support.blind import Blind, Case, Hidden, ask, blind, case, score
from support.causes import CAUSES
from support.surprises import SURPRISES
from support.visibility import VISIBLE, visibility

from excite.identification import identify
from excite.logs import log as logs
from excite.model import Model

ROOT = Path(__file__).parents[2]


def slalom(*hidden: Hidden, kind: str = "cause", kit: str = "full", seed: int = 5, duration: float = 60) -> Case:
    return Case(kind, 0, seed, "slalom", duration, kit, hidden)


# ------------------------------------------------------------------------------------------------------ the logs
def test_a_case_gives_the_same_log_again_and_another_number_another() -> None:
    first, again = (replace(case("cause", "roll_unbalance", 1), duration=8.0) for _ in range(2))
    assert first == again
    assert blind(first).log.equals(blind(again).log)
    assert case("cause", "roll_unbalance", 2).seed != first.seed


def test_the_published_cases_are_drawn_again() -> None:
    """A cause that is put before others would make other cases of theirs, here and in every test with a number."""
    published = pd.read_csv(ROOT / "results" / "diagnosis" / "cases.csv", dtype={"hidden": str, "amount": str})
    assert len(published) > 200
    for row in published.itertuples():
        name = "" if row.kind in ("nothing", "pair") else row.key.split("-")[1]
        one = case(row.kind, name, int(row.key.rpartition("-")[2]))
        assert (one.manoeuvre, one.duration, one.kit) == (row.manoeuvre, row.duration_s, row.kit), row.key
        if one.hidden:
            assert " ".join(h.label for h in one.hidden) == row.hidden, row.key
            assert " ".join(str(h.amount) for h in one.hidden) == row.amount, row.key


def test_cases_cover_places_kits_manoeuvres_and_amounts() -> None:
    many = [case("cause", name, k) for name in CAUSES for k in range(20)]
    for name, cause in CAUSES.items():
        hidden = [c.hidden[0] for c in many if c.hidden[0].name == name]
        assert {h.place for h in hidden} == set(cause.places)
        assert ({np.sign(h.amount) for h in hidden} == {-1, 1}) == cause.signed
        for h in hidden:
            low, high = sorted(cause.between(h.place))
            assert low * 0.999 <= abs(h.amount) <= high * 1.001
    assert {c.manoeuvre for c in many} == set(plant.MANOEUVRES)
    assert {c.kit for c in many} == set(plant.KITS)
    assert len({c.seed for c in many}) == len(many)


# ------------------------------------------------------------------------------------------------- how visible
def test_nothing_hidden_leaves_nothing_and_a_parameter_is_no_cause() -> None:
    seen = blind(slalom(kind="nothing", duration=20))
    assert visibility(seen) < 1e-6
    other = replace(seen.machine, Fv1=seen.machine.Fv1 * 1.1, m2=seen.machine.m2 * 1.05, Ky4=seen.machine.Ky4 * 0.95)
    moved = plant.drive(plant.bare(), other, plant.plan("slalom", 20, 5), 5)
    wrong_machine = Blind(seen.case, seen.machine, plant.bare(), moved, seen.log)
    assert visibility(wrong_machine) < 5  # the prior, and what is not linear


def test_visibility_grows_with_the_square_of_the_amount() -> None:
    chi2 = [
        visibility(blind(slalom(Hidden("encoder_eccentricity", "rear_roll", A), duration=20))) for A in (1e-3, 2e-3)
    ]
    assert chi2[0] > VISIBLE
    assert chi2[1] / chi2[0] == pytest.approx(4, rel=0.02)


def test_paper_sees_less_than_full() -> None:
    hidden = Hidden("lateral_saturation", "front_roll", 0.1)
    full, paper = (visibility(blind(slalom(hidden, kit=kit, duration=20))) for kit in ("full", "paper"))
    assert full > paper


# -------------------------------------------------------------------------------------------- nothing is hidden
def errors(one: Case, model: Model) -> np.ndarray:
    """Errors of the parameters identified from a log without anything hidden, in their standard deviations."""
    seen = blind(one)
    estimate = identify(model, [logs.from_table(seen.log, model.machine)], "joint")
    true = plant.base(seen.machine)
    return np.array([(v - true[n]) / s for n, v, s in zip(estimate.names, estimate.value, estimate.std, strict=True)])


def test_the_program_identifies_the_second_roller(va12: Model) -> None:
    """Two programs, two integrators, two sensors: where they differed, one log would be many deviations off."""
    z = errors(slalom(kind="nothing", seed=8), va12)
    assert np.isfinite(z).all()
    assert np.abs(z).max() < 4
    assert np.sqrt(np.mean(z**2)) < 1.6


# -------------------------------------------------------------------------------------------------- the judging
def said(
    verdict: str, *names: str, tied: tuple[str, ...] = (), amount: float = 1.0, std: float = 0.1
) -> dict[str, Any]:
    findings = [
        {
            "effect": name.split("@")[0],
            "where": name.split("@")[1],
            "tied_with": list(tied),
            "amount": amount,
            "amount_std": 0.1,
            "gain_percent": 12.0,
            "gain_ci95": [8.0, 16.0],
        }
        for name in names
    ]
    return {"verdict": verdict, "findings": findings}


TRUE = "torque_ripple@rear_roll"


@pytest.mark.parametrize(
    ("kind", "summary", "outcome"),
    [
        ("nothing", said("clean"), "clean"),
        ("nothing", said("unexplained"), "wrong"),
        ("nothing", said("named", TRUE), "wrong"),
        ("cause", said("clean"), "clean"),
        ("cause", said("unexplained"), "unexplained"),
        ("cause", said("named", TRUE), "right"),
        ("cause", said("tied", "roll_unbalance@rear_roll", tied=(TRUE,)), "tied"),
        ("cause", said("tied", TRUE, tied=("roll_unbalance@rear_roll",)), "tied"),
        ("cause", said("named", "torque_ripple@front_roll"), "place"),
        ("cause", said("named", "ground_slope@machine"), "wrong"),
        ("cause", said("named", TRUE, "ground_slope@machine"), "more"),
        ("surprise", said("unexplained"), "unexplained"),
        ("surprise", said("unexplained", TRUE), "wrong"),
        ("surprise", said("clean"), "clean"),
        ("pair", said("named", TRUE, "ground_slope@machine"), "right"),
        ("pair", said("named", "ground_slope@machine"), "part"),
        ("pair", said("named", TRUE, "pump_coupling@drive"), "more"),
        ("pair", said("named", "pump_coupling@drive"), "wrong"),
    ],
)
def test_judgement(kind: str, summary: dict[str, Any], outcome: str) -> None:
    true, slope = Hidden("torque_ripple", "rear_roll", 1.1), Hidden("ground_slope", "machine", 0.01)
    hidden = {"nothing": (), "cause": (true,), "surprise": (Hidden("sloshing", "", 1.0),), "pair": (true, slope)}
    assert score(slalom(*hidden[kind], kind=kind), summary).outcome == outcome


def test_amounts_and_gains_are_judged_by_their_intervals() -> None:
    one = slalom(Hidden("torque_ripple", "rear_roll", 1.1))
    assert score(one, said("named", TRUE)).amount_in
    far = score(one, said("named", TRUE, amount=0.7))
    assert not far.amount_in
    assert far.amount_error == pytest.approx(-0.4 / 1.1)
    assert far.gain_sure
    assert score(one, said("clean")).amount_in is None


# ------------------------------------------------------------------------------------------------ the diagnosis
HALF = 30.0  # [s] of driving is enough for what is strong


def named(hidden: Hidden) -> None:
    one = slalom(hidden, duration=HALF)
    judged = score(one, ask(blind(one).log))
    assert judged.outcome == "right", judged
    assert abs(judged.amount_error or 0) < 0.1
    assert judged.gain is not None
    assert judged.gain > 0


@pytest.mark.slow
def test_a_heavy_side_of_a_roll_is_named_with_its_amount_and_gain() -> None:
    named(Hidden("roll_unbalance", "front_roll", 60.0))


PLAIN = {  # of each cause the first minute of driving in which it is ten times as large as what is just visible
    "stribeck_friction": 1,
    "load_dependent_friction": 0,
    "asymmetric_coulomb": 1,
    "asymmetric_viscous": 1,
    "quadratic_drag": 2,
    "friction_warm_up": 4,
    "actuator_lag": 1,
    "channel_delay": 2,
    "torque_gain": 0,
    "torque_offset_drift": 1,
    "torque_deadband": 0,
    "roll_unbalance": 0,
    "encoder_eccentricity": 0,
    "torque_ripple": 0,
    "shear_saturation": 1,
    "lateral_saturation": 0,
    "drive_brake_asymmetry": 0,
    "compaction_per_pass": 2,
    "slip_relaxation": 0,
    "rolling_resistance": 0,
    "ground_slope": 0,
    "measuring_wheel_radius": 0,
    "articulation_backlash": 0,
    "articulation_compliance": 1,
    "articulation_stop_spring": 0,
    "vibration_on": 0,
    "payload_shift": 1,
    "relief_valve": 0,
    "friction_transition": 0,
    "roll_out_of_round": 0,
    "brake_drag": 0,
}


def test_the_study_takes_cases_that_no_test_knows() -> None:
    spec = importlib.util.spec_from_file_location("study", ROOT / "results" / "diagnosis" / "study.py")
    assert spec is not None
    assert spec.loader is not None
    study = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(study)
    assert max(PLAIN.values()) < study.FRESH["cause"]
    assert study.FRESH["surprise"] > 4
    assert study.FRESH["pair"] > 20


@pytest.mark.slow
def test_a_plain_cause_is_named() -> None:
    """The study in results/diagnosis has all, of any size."""
    seen = blind(case("cause", "payload_shift", PLAIN["payload_shift"]))
    assert visibility(seen) > 10 * VISIBLE
    assert score(seen.case, ask(seen.log)).outcome in ("right", "tied")


@pytest.mark.slow
def test_what_is_so_strong_that_nothing_follows_the_log_is_named() -> None:
    """Without the cause no model fits this log at all."""
    one = case("cause", "ground_slope", 3)
    said = ask(blind(one).log)
    judged = score(one, said)
    assert judged.outcome in ("right", "tied"), said["answer"]
    assert judged.gain is not None
    assert judged.gain > 25, said["answer"]  # per cent
    assert judged.gain_sure, said["answer"]


@pytest.mark.slow
@pytest.mark.xfail(
    reason="beside unknown forces a turning moment gains more than the vibration, which alone is no fit", run=False
)
def test_of_two_that_nothing_follows_the_stronger_is_named() -> None:
    """A roll's vibration beside a gain a hundredth as plain: only very coarse sensors follow the log without a name."""
    one = case("pair", "", 20)
    assert score(one, ask(blind(one).log)).outcome in ("right", "part")


@pytest.mark.slow
def test_a_surprise_gets_no_name() -> None:
    """A weak bit is such that a name nearly explains it, but for what stands out beside it.

    The study in results/diagnosis has all.
    """
    assert "stuck_bit" in SURPRISES
    one = case("surprise", "stuck_bit", 2)
    assert score(one, ask(blind(one).log)).outcome in ("unexplained", "clean")


@pytest.mark.slow
def test_the_study_runs_with_several_at_a_time(tmp_path: Path) -> None:
    """A case is driven, diagnosed, judged and told of."""
    study = ROOT / "results" / "diagnosis" / "study.py"
    asked = "--seen --nothing 2 --per-cause 0 --per-surprise 0 --pairs 0 --jobs 2".split()
    done = subprocess.run([sys.executable, study, *asked, "--out", tmp_path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    cases = pd.read_csv(tmp_path / "cases.csv")
    assert list(cases.outcome) == ["clean", "clean"]
    assert (tmp_path / "README.md").is_file()
