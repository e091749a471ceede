"""Rotors, springs, tilted bases, shifted encoders and currents, in logs made by pinocchio and the formulas here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pinocchio as pin
import pytest
from test_tree import Case, quantity, random_tree

import excite
from excite.identification import payload_parameters
from excite.model import build
from excite.model.machine import Machine, load_machine

ROTOR, STIFFNESS, REST = (0.8, 1.7), 25.0, 0.4
CONSTANT, RATIO, ZERO = 0.12, 100.0, 0.35
JOINT = {"Fv": 1.0, "Fs": 1.0, "u0": 1.0, "smoothing": 0.3}


def arm(with_constant: bool = True) -> Machine:
    """Two skew joints on a base that is tilted anyhow, with rotors, a balancer at the first, and motor currents."""
    raw = random_tree(7, "rr", (-1, 0)).model_dump(mode="json", exclude_none=True)
    for body, rotor in zip(raw["body"], ROTOR, strict=True):
        body["friction"] = {name: quantity(value) for name, value in JOINT.items()}
        body["drive"] = {"rotor_inertia": quantity(rotor)}
        k = body["index"]
        current: dict[str, Any] = {"name": f"i{k}", "kind": "torque", "body": k, "column": f"i{k}_mA", "unit": "mA"}
        current["gear_ratio"] = quantity(RATIO)
        if with_constant:
            current["torque_constant"] = quantity(CONSTANT)
        angle = {"name": f"q{k}", "kind": "angle", "body": k, "column": f"q{k}_deg", "unit": "deg"}
        raw["sensor"] += [angle, current]
    raw["body"][0]["spring"] = {"stiffness": quantity(STIFFNESS), "rest": quantity(REST)}
    raw["filter"] |= {"cutoff_hz": quantity(10), "drop": [100, 100]}  # the log begins and ends in motion
    raw["sensor"][2]["zero"] = quantity(ZERO)
    return Machine.model_validate(raw)


def log_of(case: Case) -> pd.DataFrame:
    """Return 40 s of slow sines; currents behind pinocchio's torques, rotors, spring and friction."""
    t = np.arange(4000) / 100
    w = 2 * np.pi * np.array([[0.11, 0.31, 0.67], [0.13, 0.37, 0.71]])
    phase = w[:, :, None] * t + np.arange(3)[:, None]
    amplitude = np.array([0.9, 0.6, 0.4])[None, :, None]
    q = (amplitude * np.sin(phase)).sum(axis=1)
    nu = (amplitude * w[:, :, None] * np.cos(phase)).sum(axis=1)
    a = -(amplitude * w[:, :, None] ** 2 * np.sin(phase)).sum(axis=1)
    torque = np.array([case.reference(q[:, k], nu[:, k], a[:, k])[2] for k in range(len(t))]).T
    torque += np.array(ROTOR)[:, None] * a
    torque[0] += STIFFNESS * (q[0] - REST)
    torque += JOINT["Fv"] * nu + JOINT["Fs"] * np.tanh(nu / JOINT["smoothing"]) + JOINT["u0"]
    degrees, milliamperes = np.rad2deg(q + np.array([[0.0], [ZERO]])), 1000 * torque / (CONSTANT * RATIO)
    columns = {"t_s": t} | {f"q{k}_deg": degrees[k] for k in range(2)} | {f"i{k}_mA": milliamperes[k] for k in range(2)}
    return pd.DataFrame(columns)


@pytest.fixture(scope="module")
def log() -> pd.DataFrame:
    return log_of(Case(random_tree(7, "rr", (-1, 0))))


def test_rotor_spring_and_current_are_identified_on_a_tilted_base(log: pd.DataFrame) -> None:
    model = build(arm())
    estimate = excite.identify(model, log, method="inverse")
    found = dict(zip(estimate.names, estimate.value, strict=True))
    true = dict(zip(model.base.names, model.nominal, strict=True))
    assert {"Ia1", "Ks0"} <= set(found), "seen by itself: the second joint's rotor, the spring"
    assert "Ia0" in model.base.grouping("ZZ0R"), "the first joint's rotor is its axis' inertia"
    assert model.base.grouping("Ts0R") == {"Ts0": 1.0, "u00": -1.0}
    size = np.maximum(np.abs(model.nominal), 1.0)
    off = {n: abs(found[n] - true[n]) / s for n, s in zip(true, size, strict=True)}
    assert max(off.values()) < 0.004, off
    assert max(e["percent"] for e in estimate.summary["error_by_joint"].values()) < 0.1


def test_a_payload_is_the_difference_of_two_estimates(log: pd.DataFrame) -> None:
    """Mass, moments and inertia of a body that pinocchio welds to the last one, in groups that the arm shows."""
    case = Case(random_tree(7, "rr", (-1, 0)))
    inertia = pin.Inertia(2.0, np.array([0.3, -0.2, 0.1]), np.diag([0.05, 0.08, 0.06]))
    case.pin.appendBodyToJoint(2, inertia, case.pin.frames[case.frames[1]].placement)
    case.data = case.pin.createData()
    model = build(arm())
    unloaded = excite.identify(model, log, method="inverse")
    loaded = excite.identify(model, log_of(case), method="inverse", unloaded=unloaded)
    found = payload_parameters(model, loaded, unloaded)
    J = inertia.inertia - inertia.mass * pin.skew(inertia.lever) @ pin.skew(inertia.lever)
    moments = inertia.mass * inertia.lever
    true = dict(zip(("M", "MX", "MY", "MZ"), (inertia.mass, *moments), strict=True))
    true |= {f"{a}{b}": J["XYZ".index(a), "XYZ".index(b)] for a, b in ("XX", "XY", "XZ", "YY", "YZ", "ZZ")}
    expected = [sum(share * true[n] for n, share in group.items()) for group in found.groups]
    assert {"MX", "MY", "ZZ"} <= set(found.names)
    assert found.value == pytest.approx(expected, abs=0.01)
    shown = loaded.summary["payload"]
    assert [r["value"] for r in shown["parameters"].values()] == pytest.approx(found.value)
    assert "Payload in the frame of body1" in str(loaded)


def test_currents_without_a_constant_give_ratios_and_say_so(log: pd.DataFrame) -> None:
    model = build(arm(with_constant=False))
    estimate = excite.identify(model, log, method="inverse")
    row = estimate.summary["parameters"]["Ks0"]
    assert row["unit"] == "A/rad"
    assert row["value"] == pytest.approx(STIFFNESS / CONSTANT, rel=0.01)
    assert estimate.summary["parameters"]["Ia1"]["unit"] == "A s2"
    assert estimate.summary["error_by_joint"]["body0"]["unit"] == "A"
    assert any("divided by that constant" in note for note in estimate.notes)


def test_simulated_logs_have_shifted_angles_and_currents() -> None:
    model = build(arm())
    log = excite.simulate(model, np.zeros((50, 2)), noise=False)
    assert log["q1_deg"][0] == pytest.approx(np.rad2deg(ZERO))
    assert log["i1_mA"][0] == pytest.approx(1000 * JOINT["u0"] / (CONSTANT * RATIO))


def test_half_known_constants_are_refused() -> None:
    raw = arm().model_dump(mode="json", exclude_none=True)
    del raw["sensor"][1]["torque_constant"]
    with pytest.raises(ValueError, match="either every torque is a current"):
        Machine.model_validate(raw)


@pytest.mark.parametrize(
    ("name", "rotors", "inertial"), [("ur10e", False, 36), ("ur10e", True, 40), ("panda", False, 43)]
)
def test_published_numbers_of_base_parameters(name: str, rotors: bool, inertial: int) -> None:
    """UR10e: 40 with rotor inertia, 36 without (Mamedov); Panda: 43 (Gaz et al., RA-L 2019)."""
    raw = load_machine(name).model_dump(mode="json", exclude_none=True)
    for body in raw["body"]:
        body.pop("drive", None)
        if rotors:
            body["drive"] = {"rotor_inertia": quantity(0.5)}
    machine = Machine.model_validate(raw)
    model = build(machine)
    joint = [n for n in model.base.names if n.startswith(("Fv", "Fs", "u"))]
    assert len(model.base.names) - len(joint) == inertial
