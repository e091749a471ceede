"""Identified arms as URDF, MJCF and FMI 3: pinocchio, MuJoCo and FMPy need the same torques as the equations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import casadi as ca
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from support.commands import Excite

from excite.errors import MachineError
from excite.model import Model, build, standard_parameters
from excite.model.machine import Drive, Quantity, Spring, load_machine
from excite.workflows import fmi_model, model_files

ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"
SAMPLES = 20
FRICTION = ("Fs", "u")  # initials of what no engine takes as a smooth torque


def one(value: float) -> Quantity:
    return Quantity(value=value, source="definition")


def torques(model: Model, p: dict[str, float], x: np.ndarray) -> np.ndarray:
    """Torques (N, n_q) of the equations of motion at q, nu, a (3, N, n_q)."""
    q, nu, a = model.symbols()
    u = ca.Function(
        "u", [q, nu, a], [model.predict(q, nu, a, ca.DM([p[n] for n in standard_parameters(model.machine)]))]
    )
    return np.asarray(u(*(v.T for v in x)).full().T)


def changed(model: Model) -> dict[str, float]:
    """Standard parameters of heavier bodies, without dry friction and offsets."""
    rng = np.random.default_rng(0)
    nominal = {n: v for n, (v, _) in standard_parameters(model.machine).items()}
    heavier = {k.index: rng.uniform(1, 1.3) for k in model.machine.body}
    inertial = {n: v * heavier[int(n.lstrip("MXYZ"))] for n, v in nominal.items() if n[0] in "MXYZ"}
    return nominal | inertial | {n: 0.0 for n in nominal if n.startswith(FRICTION)}


@pytest.mark.parametrize("name", ["panda", "ur10", str(ARM)])
def test_pinocchio_needs_the_same_torques(name: str, tmp_path: Path) -> None:
    model = build(load_machine(name))
    p = changed(model)
    text, _ = model_files.urdf_model(model.machine, p)
    (tmp_path / "arm.urdf").write_text(text)
    twin = pin.buildModelFromUrdf(str(tmp_path / "arm.urdf"))
    twin.gravity.linear = np.array(model.machine.gravity)
    data = twin.createData()
    n_q = len(model.coordinates)
    x = np.random.default_rng(1).uniform(-2, 2, (3, SAMPLES, n_q))
    viscous = np.array([p[f"Fv{b.index}"] for b in model.machine.body])
    expected = torques(model, p, x)
    found = np.array([pin.rnea(twin, data, *states) for states in zip(*x, strict=True)]) + viscous * x[1]
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
    assert twin.damping == pytest.approx(viscous)
    assert twin.upperPositionLimit[0] == pytest.approx(model.machine.body[0].limit.position_range[1])
    geometry = pin.buildGeomFromUrdf(twin, str(tmp_path / "arm.urdf"), pin.GeometryType.COLLISION)
    shapes = [s for b in model.machine.body for s in b.shape] + list(model.machine.world.shape)
    assert len(geometry.geometryObjects) == sum(3 if len(s.ends) == 2 else 1 for s in shapes)


@pytest.mark.parametrize("name", ["panda", "ur10", str(ARM)])
def test_mujoco_needs_the_same_torques(name: str) -> None:
    """Rotors and a spring to the ground are in the file as well."""
    machine = load_machine(name)
    extra = {
        "drive": Drive(rotor_inertia=one(0.7)),
        "spring": Spring(stiffness=one(9), rest=one(0.3), damping=one(0.4)),
    }
    bodies = (machine.body[0].model_copy(update=extra), *machine.body[1:])
    model = build(machine.model_copy(update={"body": bodies}))
    p = changed(model)
    text, _ = model_files.mjcf_model(model.machine, p)
    twin = mujoco.MjModel.from_xml_string(text)
    twin.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(twin)
    x = np.random.default_rng(2).uniform(-2, 2, (3, SAMPLES, len(model.coordinates)))
    found = []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(*x, strict=True):
        mujoco.mj_inverse(twin, data)
        found.append(data.qfrc_inverse.copy())
    expected = torques(model, p, x)
    assert np.abs(np.array(found) - expected).max() < 1e-6 * np.abs(expected).max()
    assert twin.dof_armature[0] == pytest.approx(0.7)
    rubbing = p | {f"Fs{machine.body[0].index}": 1.5}
    assert mujoco.MjModel.from_xml_string(model_files.mjcf_model(machine, rubbing)[0]).dof_frictionloss[0] == 1.5


def test_fmpy_needs_the_same_torques(tmp_path: Path) -> None:
    """Accelerations of the FMU at random states and torques, put into the equations, need these torques."""
    from ctypes import c_double

    import fmpy
    from fmpy.fmi3 import FMU3Model
    from fmpy.validation import validate_fmu

    model = build(load_machine(str(ARM)))
    p = {n: v for n, (v, _) in standard_parameters(model.machine).items()}
    content, _ = fmi_model.fmi_model(model.machine, p)
    (tmp_path / "arm.fmu").write_bytes(content)
    assert not validate_fmu(str(tmp_path / "arm.fmu"))
    told = fmpy.read_model_description(str(tmp_path / "arm.fmu"))
    references = {v.name: v.valueReference for v in told.modelVariables}
    unpacked = fmpy.extract(str(tmp_path / "arm.fmu"), str(tmp_path / "fmu"))
    fmu = FMU3Model(
        guid=told.guid,
        unzipDirectory=unpacked,
        modelIdentifier=told.modelExchange.modelIdentifier,
        instanceName="arm",
    )
    fmu.instantiate()
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    rng = np.random.default_rng(3)
    offset = np.array([p["u10"], p["u20"]])
    for _ in range(SAMPLES):
        x, u, dx = rng.uniform(-1.5, 1.5, 4), rng.uniform(-20, 20, 2), (c_double * 4)()
        fmu.setFloat64([references["u1"], references["u2"]], u.tolist())
        fmu.setContinuousStates((c_double * 4)(*x), 4)
        fmu.getContinuousStateDerivatives(dx, 4)
        assert list(dx)[:2] == pytest.approx(x[2:])
        needed = torques(model, p, np.array([x[:2], x[2:], list(dx)[2:]])[:, None])[0] - offset
        assert np.abs(needed - u).max() < 1e-6 * np.abs(u).max()
    fmu.terminate()
    fmu.freeInstance()
    held = fmpy.simulate_fmu(str(tmp_path / "arm.fmu"), stop_time=0.5, output=["theta1", "dtheta1"])
    assert held["theta1"][-1] < -0.2  # the arm falls


@pytest.mark.parametrize("write", [model_files.urdf_model, model_files.mjcf_model])
def test_what_is_no_robot_is_refused(write: Callable[..., object]) -> None:
    with pytest.raises(MachineError, match="can't be written as a robot model"):
        write(load_machine("va12"), {})


def test_a_folder_without_estimate_is_one_clear_line(tmp_path: Path, excite: Excite) -> None:
    code, _, stderr = excite("machine", "model", tmp_path, "--out", tmp_path / "arm.doc")
    assert code == 2
    assert ".doc" in stderr
