"""Motors: a known load gives an unknown torque constant, voltages with back-EMF, rotors that couple two joints."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

from excite.errors import MachineError
from excite.identification import identify, torque_constant
from excite.logs import read_log
from excite.model import Model, build
from excite.model.machine import Machine, load_machine

G = 9.81


def q(value: float, more: str = "") -> str:
    return f'{{ value = {value!r}, source = "measured"{more} }}'


def servo(place: Path, unit: str, sensor: str = "", known: str = ", known = true", mass: float = 1.168) -> Path:
    """A servo with a weight on a horn in a vertical plane: x of the ground points down."""
    file = place / "servo.toml"
    file.write_text(f"""
name = "servo"
title = "servo"
sampling_hz = {q(200)}
gravity = [9.81, 0, 0]
[[body]]
index = 1
name = "horn"
antecedent = "ground"
joint = "revolute"
actuated = true
[body.inertia]
mass = {q(mass, known)}
com = {{ value = [0.15, 0, 0], source = "measured"{known} }}
ZZ = {q(0.002)}
[body.friction]
Fv = {q(0.05)}
Fs = {q(0.02)}
u0 = {q(0.0)}
smoothing = {q(0.01)}
[[sensor]]
name = "q1"
kind = "angle"
body = 1
column = "rad"
unit = "rad"
noise = {q(1e-4)}
[[sensor]]
name = "u1"
kind = "torque"
body = 1
column = "drive"
unit = "{unit}"
{sensor}
[filter]
source = "assumed"
cutoff_hz = {q(10)}
decimation = 2
drop = [20, 20]
""")
    return file


def swing(torque_per_unit: float, back_emf: float = 0.0, noise: float = 0.01) -> pd.DataFrame:
    """Log of the servo, worked out by hand: J q" + (Fv + back-EMF) q' + Fs sgn q' + m g l sin q = k drive."""
    t = np.arange(0, 20, 0.005)
    w = 2 * np.pi * np.array([0.31, 0.67])[:, None]
    angle = (np.array([[0.9], [0.35]]) * np.sin(w * t)).sum(axis=0)
    rate = (np.array([[0.9], [0.35]]) * w * np.cos(w * t)).sum(axis=0)
    accel = -(np.array([[0.9], [0.35]]) * w**2 * np.sin(w * t)).sum(axis=0)
    J = 0.002 + 1.168 * 0.15**2
    torque = J * accel + (0.05 + back_emf) * rate + 0.02 * np.tanh(rate / 0.01) + 1.168 * G * 0.15 * np.sin(angle)
    rng = np.random.default_rng(5)
    read = torque / torque_per_unit
    read = read + noise * np.std(read) * rng.normal(size=len(t))
    return pd.DataFrame({"t_s": t, "rad": angle + 1e-4 * rng.normal(size=len(t)), "drive": read})


@pytest.mark.parametrize(
    ("unit", "scale", "gear"), [("V", 1.0, 1.0), ("A", 1.0, 20.0), ("mV", 1e3, 1.0), ("%", 100, 1)]
)
def test_a_known_load_gives_the_torque_constant(unit: str, scale: float, gear: float, tmp_path: Path) -> None:
    """0.465 N m per volt, ampere or whole duty cycle at the motor, behind whatever gear."""
    geared = f"gear_ratio = {q(gear)}" if gear != 1 else ""
    model = build(load_machine(servo(tmp_path, unit, geared)))
    log = tmp_path / "log.csv"
    frame = swing(0.465 * gear)
    frame.assign(drive=frame.drive * scale).to_csv(log, index=False)
    estimate = identify(model, [read_log(log, model.machine)], "inverse")
    found = torque_constant(model, estimate)
    assert found is not None
    assert found.unit == {"V": "N m/V", "mV": "N m/V", "A": "N m/A", "%": "N m"}[unit]
    assert found.value == pytest.approx(0.465, rel=0.01)
    assert found.interval95[0] < 0.465 < found.interval95[1]
    assert 0 < found.std < 0.01 * found.value
    assert any("mass" in name for name in found.known)
    friction = estimate.value[model.base.names.index("Fv1")] * found.value
    assert friction == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("constant", [1000.0, 0.001])
def test_an_estimate_has_no_preferred_size_of_the_torque_constant(constant: float, tmp_path: Path) -> None:
    model = build(load_machine(servo(tmp_path, "V")))
    swing(constant).to_csv(tmp_path / "log.csv", index=False)
    estimate = identify(model, [read_log(tmp_path / "log.csv", model.machine)], "inverse")
    assert estimate.status == "valid", estimate.doubt
    found = torque_constant(model, estimate)
    assert found is not None
    assert found.value == pytest.approx(constant, rel=0.01)


def test_known_values_that_disagree_on_the_constant_leave_it_doubtful(tmp_path: Path) -> None:
    file = servo(tmp_path, "V")
    file.write_text(file.read_text().replace(f"ZZ = {q(0.002)}", f"ZZ = {q(0.02, ', known = true')}"))
    model = build(load_machine(file))
    swing(0.465).to_csv(tmp_path / "log.csv", index=False)
    estimate = identify(model, [read_log(tmp_path / "log.csv", model.machine)], "inverse")
    assert estimate.status == "doubtful"
    assert "disagrees on the torque constant" in estimate.doubt
    assert not any("call a load known" in note for note in estimate.notes)


def test_nothing_known_gives_no_constant(tmp_path: Path) -> None:
    model = build(load_machine(servo(tmp_path, "V", known="")))
    log = tmp_path / "log.csv"
    swing(0.465).to_csv(log, index=False)
    assert torque_constant(model, identify(model, [read_log(log, model.machine)], "inverse")) is None


def test_the_command_says_the_constant(tmp_path: Path, excite: Excite) -> None:
    log = tmp_path / "log.csv"
    swing(0.465).to_csv(log, index=False)
    code, said, err = excite("identify", servo(tmp_path, "V"), log, "--out", tmp_path / "out")
    assert code == 0, err
    assert "Torque constant of the motors: 0.46" in " ".join(said.split())


def test_a_motor_driven_by_a_voltage_brakes_itself(tmp_path: Path) -> None:
    """Torque constant 0.02 N m/A, gear 30, 1.5 ohm: 0.4 N m/V and a damping of 0.24 N m s."""
    keys = f"torque_constant = {q(0.02)}\nresistance = {q(1.5)}\ngear_ratio = {q(30.0)}"
    model = build(load_machine(servo(tmp_path, "V", keys, known="")))
    log = tmp_path / "log.csv"
    swing(0.4, back_emf=0.24).to_csv(log, index=False)
    found = dict(zip(model.base.names, identify(model, [read_log(log, model.machine)], "inverse").value, strict=True))
    assert model.base.grouping("Fv1R") == {"Fv1": 1.0, "Kb1": 1.0}
    assert found["Fv1R"] == pytest.approx(0.05 + 0.24, rel=0.03)
    assert found["MX1"] == pytest.approx(1.168 * 0.15, rel=0.01)
    assert model.nominal[model.base.names.index("Fv1R")] == pytest.approx(0.29)


@pytest.mark.parametrize(
    ("unit", "keys", "said"),
    [
        ("V", "torque_constant = {}", "needs its resistance"),
        ("%", "torque_constant = {}", "leave it out"),
        ("A", "resistance = {}", "driven by a voltage"),
        ("N m", "gear_ratio = {}", "current, voltage or duty cycle"),
    ],
)
def test_halves_of_a_motor_are_refused(unit: str, keys: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(MachineError, match=said):
        load_machine(servo(tmp_path, unit, keys.format(q(0.1))))


def wrist(ratio: float) -> Model:
    """Two joints; the rotor of the second turns with the first one as well."""
    two = load_machine(Path(__file__).parents[1] / "support" / "two_joints.toml").model_dump(mode="json")
    rotor = {"value": 0.3, "source": "measured"}
    turns = {"joint": 1, "ratio": {"value": ratio, "source": "measured"}}
    two["body"][1]["drive"] = {"rotor_inertia": rotor} | ({"turns_with": turns} if ratio else {})
    return build(Machine.model_validate(two))


@pytest.mark.parametrize("ratio", [1.0, -0.4])
def test_a_rotor_that_turns_with_another_joint_couples_both(ratio: float) -> None:
    """Lagrange by hand: T has 1/2 Ia (q2' + ratio q1')^2 more, and the motor's torque does work on that angle."""
    coupled, plain = wrist(ratio), wrist(0.0)
    at, rate = np.array([0.3, -0.8]), np.array([0.7, -1.1])
    X, Y = ca.DM(coupled.nominal), ca.DM(plain.nominal)
    M, _ = (np.array(ca.DM(x)) for x in coupled.equations(ca.SX(ca.DM(at)), ca.SX(ca.DM(rate)), X))
    M0, _ = (np.array(ca.DM(x)) for x in plain.equations(ca.SX(ca.DM(at)), ca.SX(ca.DM(rate)), Y))
    S, S0 = np.array([[ratio, 1.0]]), np.array([[0.0, 1.0]])
    assert pytest.approx(M0 - 0.3 * S0.T @ S0 + 0.3 * S.T @ S, abs=1e-12) == M
    assert coupled.machine.input_matrix == pytest.approx(np.array([[1.0, ratio], [0.0, 1.0]]))
    u = np.array([4.0, -2.0])
    a = np.array(coupled.acceleration(at, rate, u, coupled.nominal))[:, 0]
    torque = np.array(coupled.predict(at, rate, a, coupled.expand @ coupled.nominal))[:, 0]
    offset = np.array([coupled.nominal[coupled.base.names.index(f"u{k}0")] for k in (1, 2)])
    assert torque - offset == pytest.approx(u, abs=1e-9)
