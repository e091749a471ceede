"""Encoder zeros that are sought: hidden ones are found with honest intervals, and those that no log shows are named."""

from __future__ import annotations

import copy
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support.drives import drive

from excite.identification import Estimate, identify, needed_sensors
from excite.logs import prepare
from excite.model import Model, build, hidden_zeros, with_given_zeros
from excite.model.machine import Machine, Quantity, load_machine
from excite.simulation import (
    Motion,
    follow_positions,
    measure,
    motion_along,
    outside_law,
    resultant_slips,
    simulate,
)
from excite.trajectories import check_limits

ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"
HIDDEN = np.array([0.02, -0.02])
SEEDS = range(4)


def arm(zero: Any = "sought", known_com: bool = True, mass: float = 1.0, **changes: Any) -> Model:
    """Two links whose centres of mass lie on their axes, or lie anywhere; mass: factor on the file's."""
    table: Any = copy.deepcopy(tomllib.loads(ARM.read_text()))
    table["sampling_hz"]["value"] = 150  # at 50 Hz friction turns within one sample, which no linear smoother follows
    for body in table["body"]:
        com = body["inertia"]["com"]
        if known_com:
            com |= {"value": [com["value"][0], 0, 0], "known": True}
        body["inertia"]["mass"]["value"] *= mass
    for sensor in table["sensor"]:
        if sensor["kind"] == "angle" and zero is not None:
            sensor["zero"] = zero
    return build(Machine.model_validate(table | changes))


def pendulum(zero: Any = "sought", mass: float = 1.0) -> Model:
    machine = load_machine("pendulum")
    (body,) = machine.body
    assert body.inertia is not None
    inertia = body.inertia.model_dump()
    inertia["mass"]["value"] *= mass
    inertia["com"]["known"] = True
    table = machine.model_dump() | {"sampling_hz": {"value": 100, "source": "definition"}}
    table["body"] = [body.model_dump() | {"inertia": inertia}]
    noise = {"angle": {"value": 1e-4, "source": "assumed"}, "torque": {"value": 0.02, "source": "assumed"}}
    table["sensor"] = [s.model_dump() | {"noise": noise[s.kind]} for s in machine.sensor]
    if zero is not None:
        table["sensor"][0]["zero"] = zero
    return build(Machine.model_validate(table))


def truth_of(model: Model) -> np.ndarray:
    X = model.nominal.copy()
    X[model.zeros] = HIDDEN[: len(model.zeros)]
    return X


def log_of(model: Model, seed: int) -> pd.DataFrame:
    """A log of 20 s of slow sums of sines, by a machine whose encoders read HIDDEN too much."""
    rng, n = np.random.default_rng(seed), len(model.coordinates)
    t = np.arange(0, 20, 1 / float(model.machine.sampling_hz))
    q, v, a = np.zeros((3, len(t), n))
    for k in range(1, 6):
        w, size, phase = 0.65 * k, 0.6, rng.uniform(0, 2 * np.pi, n)
        q += size * np.sin(w * t[:, None] + phase)
        v += size * w * np.cos(w * t[:, None] + phase)
        a -= size * w**2 * np.sin(w * t[:, None] + phase)
    X = truth_of(model)
    motion = follow_positions(model, motion_along(model, t, q, v, a).u, q, v, X)
    return measure(model, motion, X, seed=seed)


def estimate_by(method: str, model: Model, log: pd.DataFrame) -> Estimate:
    ready = prepare(model, [log], needed_sensors(model, method))
    return identify(ready.model, ready.logs, method)


@pytest.mark.parametrize("zero", [0.02, -0.3])
def test_forces_act_at_the_reading_less_the_zero(zero: float) -> None:
    model = arm()
    q, nu, a = np.random.default_rng(0).uniform(-1, 1, (3, 2, 20))
    X = model.nominal.copy()
    expected = model.predict(q - zero, nu, a, model.expand @ X).full()
    X[model.zeros] = zero
    assert model.predict(q, nu, a, model.expand @ X).full() == pytest.approx(expected)
    read = model.read(q, nu, np.zeros((0, 20)), np.zeros((2, 20)), np.zeros((0, 20)), X).full()
    assert read == pytest.approx(q)


@pytest.mark.parametrize("machine", [pendulum, arm])
def test_hidden_zeros_are_found(machine: Any) -> None:
    """From bodies 30 % too heavy; without the zero the centre of mass is off by many deviations, or the fit doubted."""
    truth, guess = machine(), machine(mass=1.3)
    z = []
    for seed in SEEDS:
        log = log_of(truth, seed)
        found = estimate_by("joint", guess, log)
        assert found.status == "valid"
        at = guess.zeros
        z.append((found.value[at] - truth_of(truth)[at]) / found.std[at])
        assert (found.std[at] < 0.005).all()
        others = np.delete((found.value - truth_of(truth)) / found.std, at)
        assert np.abs(others).max() < 4.5
    assert np.abs(z).max() < 3.5
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.7
    without = estimate_by("joint", machine(zero=None, mass=1.3), log)
    assert without.status == "doubtful" or without.relative_error_percent > 1.2 * found.relative_error_percent


def roller(**slip_limits: float) -> Model:
    """The roller whose articulation has an encoder zero that is sought; slip limits by name of the roll."""
    machine = load_machine("va12")
    sensors = tuple(s.model_copy(update={"zero": "sought"}) if s.name == "theta2" else s for s in machine.sensor)
    limits = {n: {"slip_limit": Quantity(value=x, source="definition")} for n, x in slip_limits.items()}
    bodies = tuple(
        b.model_copy(update={"contact": b.contact.model_copy(update=limits[b.name])})
        if b.contact is not None and b.name in limits
        else b
        for b in machine.body
    )
    return build(machine.model_copy(update={"sensor": sensors, "body": bodies}))


def test_slips_places_and_wheels_are_those_of_the_true_angles(va12: Model) -> None:
    model, rng = roller(), np.random.default_rng(0)
    X = truth_of(model)
    q, nu = rng.uniform(-0.5, 0.5, (2, 40, 6))
    read = q.copy()
    read[:, va12.coordinates.index("theta2")] += HIDDEN[0]
    assert model.true_coordinates(read, X) == pytest.approx(q)
    slips = resultant_slips(va12, q, nu, va12.nominal)
    assert resultant_slips(model, read, nu, X) == pytest.approx(slips)
    assert np.abs(resultant_slips(model, read, nu, model.nominal) - slips).max() > 0.01

    def motion(q: np.ndarray) -> Motion:
        t, none = np.arange(40) * 0.01, np.zeros((40, 3))
        return Motion(t, q, nu, np.zeros_like(nu), none, none[:, :2], none[:, :0])

    problem, known = model.machine.problems["R60"], replace(model, nominal=X)
    by_reading = {name for name in check_limits(va12, problem, motion(q)) if "theta2" in name or "position" in name}
    expected = {n: x for n, x in check_limits(va12, problem, motion(q)).items() if n not in by_reading}
    found = {n: x for n, x in check_limits(known, problem, motion(read)).items() if n not in by_reading}
    assert found == pytest.approx(expected)
    assert any(n.startswith("slip") and x > 0 for n, x in found.items())
    assert any(n.startswith("lane") for n in found)
    # Measuring wheels are on the first chassis, before every joint: no zero changes their rates.
    wheels = (model.kinematics(angles.T, nu.T)[2].full() for angles in (q, read))
    np.testing.assert_array_equal(*wheels)


def test_a_fit_takes_slips_at_the_zero_that_it_finds() -> None:
    """The rear roll's slips stay below its limit, though not those that the read angle of the articulation gives."""
    guess = roller()
    X = truth_of(guess)
    X[guess.zeros] = 0.05
    motion = simulate(guess, drive(guess, 15, 1, {"u1": 2500, "u4": 2500, "u2": 6000}), X)
    slips = resultant_slips(guess, motion.q, motion.nu, X)[:, [place == 4 for place, _ in guess.edges]]
    model = roller(front_roll=1e3, rear_roll=float(slips.max()))
    true, read = (outside_law(model, motion.q, motion.nu, x).mean() for x in (X, model.nominal))
    assert true == 0 < 0.05 < read
    found = estimate_by("joint", model, measure(model, motion, X, seed=1))
    assert found.share_outside_law == pytest.approx(true, abs=abs(read - true) / 3)


@pytest.mark.slow
def test_a_roller_shows_the_zero_of_its_articulation() -> None:
    model = roller()
    X = truth_of(model)
    motion = simulate(model, drive(model, 40, 1, {"u1": 2500, "u4": 2500, "u2": 6000}), X)
    found = estimate_by("joint", model, measure(model, motion, X, seed=1))
    assert found.status == "valid"
    assert found.std[-1] < 0.001
    assert abs(found.value[-1] - HIDDEN[0]) < 3.5 * found.std[-1]


@pytest.mark.parametrize("method", ["ols", "ols+consistent", "inverse"])
def test_other_methods_find_zeros(method: str) -> None:
    truth, guess = arm(), arm(mass=1.3)
    found = estimate_by(method, guess, log_of(truth, 1))
    assert found.value[guess.zeros] == pytest.approx(HIDDEN, abs=0.005)


@pytest.mark.parametrize("method", ["ols", "joint"])
def test_axis_along_gravity_says_that_no_log_shows_its_zero(method: str) -> None:
    model = arm(gravity=[0.0, 0.0, -9.81])
    found = estimate_by(method, model, log_of(model, 1))
    assert list(found.unidentifiable) == ["q10"]
    assert "nothing in this log depends on it" in found.unidentifiable["q10"]
    k = model.base.names.index("q20")  # the coupling of both joints shows it, as the centre of mass is known
    assert abs(found.value[k] - HIDDEN[1]) < 3.5 * found.std[k]
    assert hidden_zeros(model) == {"q10": ()}


@pytest.mark.parametrize("method", ["ols", "joint"])
def test_last_joint_shows_its_zero_only_together_with_the_centre_of_mass(method: str) -> None:
    model = arm(known_com=False)
    found = estimate_by(method, model, log_of(model, 1))
    assert list(found.unidentifiable) == ["q20"]
    assert "MY2 -" in found.unidentifiable["q20"]
    assert hidden_zeros(model) == {"q20": ("MX2", "MY2")}
    assert with_given_zeros(model, ["q20"]).base.names == model.base.names[:-1]


def test_what_is_known_of_a_zero_counts() -> None:
    """A zero known to 0.01 rad that the log does not show keeps its deviation."""
    model = arm({"value": 0.3, "source": "measured", "known": 0.01}, known_com=False)
    log = log_of(model, 1)
    assert log["q1_rad"].mean() == pytest.approx(log_of(arm(known_com=False), 1)["q1_rad"].mean() + 0.3)
    found = estimate_by("ols", model, log)
    assert not found.unidentifiable
    k = model.base.names.index("q20")
    assert found.std[k] == pytest.approx(0.01, rel=1e-3)
    assert abs(found.value[k]) < 1e-6
    exact = arm({"value": 0.3, "source": "measured", "known": True})
    assert not len(exact.zeros)


@pytest.mark.parametrize(
    ("sensor", "zero", "message"),
    [
        (0, "unknown", 'must be "sought" or a table'),
        (0, 0.02, 'must be "sought" or a table'),
        (0, {"value": 0.0, "source": "measured", "known": -1}, "a standard deviation > 0"),
        (1, "sought", "is for the position of a joint"),
    ],
)
def test_impossible_zeros_are_refused(sensor: int, zero: Any, message: str) -> None:
    table: Any = tomllib.loads(ARM.read_text())
    table["sensor"][sensor]["zero"] = zero
    with pytest.raises(ValueError, match=message):
        Machine.model_validate(table)


def test_a_joint_that_moves_with_another_has_no_zero_of_its_own() -> None:
    table: Any = tomllib.loads(ARM.read_text())
    del table["body"][1]["actuated"]
    table["body"][1]["moves_with"] = {"joint": 1}
    table["sensor"] = [
        s | ({"zero": "sought"} if s["name"] == "q2" else {}) for s in table["sensor"] if s["name"] != "u2"
    ]
    with pytest.raises(ValueError, match="moves with joint 1: seek that one's zero alone"):
        Machine.model_validate(table)


def test_a_zero_that_a_log_hardly_shows_is_held() -> None:
    """In a louder log the first estimate of q10 is known to more than its size of 0.02 rad: it would run away."""
    model = arm(known_com=False)
    log, rng = log_of(model, 1), np.random.default_rng(0)
    loud = log.assign(**{c: log[c] + 1.5 * rng.standard_normal(len(log)) for c in ("tau1_Nm", "tau2_Nm")})
    found = estimate_by("ols", model, loud)
    assert set(found.unidentifiable) == {"q10", "q20"}
    assert "hardly identifiable from this log: known to 0.0" in found.unidentifiable["q10"]
    assert found.names == model.base.names
    assert np.isnan(found.value[model.zeros]).all()
    assert np.isfinite(np.delete(found.value, model.zeros)).all()
    assert any("held at the machine file's value: q10" in note for note in found.notes)


def test_a_light_arm_shows_its_zeros_as_a_heavy_one_does() -> None:
    """Values that are known exactly are large beside small torques, but say nothing of what motions show."""
    assert hidden_zeros(arm()) == {}
    assert hidden_zeros(arm(mass=1e-3)) == {}
    assert set(hidden_zeros(arm(known_com=False))) == set(hidden_zeros(arm(known_com=False, mass=1e-3))) == {"q20"}


def test_the_scale_of_a_zero_goes_with_it() -> None:
    model = arm(known_com=False, scale={"q20": {"value": 0.05, "source": "definition"}})
    assert "q20" in model.base.names
    assert "q20" not in with_given_zeros(model, ["q20"]).base.names
