"""Robots from URDF files, against pinocchio's own reading of the same file."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from support.commands import Excite

from excite.cli import machine_template
from excite.identification import Estimate
from excite.model import Model, build, standard_parameters
from excite.model.machine import load_machine
from excite.workflows import urdf_with_estimate

ARM = Path(__file__).parents[1] / "support" / "arm.urdf"
JOINTS = ("shoulder", "elbow", "parallel", "rail")  # of ARM, in the order of its tree
RIGID = ("M", "X", "Y", "Z")  # initials of inertial parameters


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("urdf") / "arm.toml"
    machine_template.start("arm", file, origin=str(ARM))
    return file


def pinocchio(file: Path) -> tuple[pin.Model, list[int]]:
    model = pin.buildModelFromUrdf(str(file))
    return model, [model.joints[model.getJointId(n)].id for n in JOINTS]


def test_a_urdf_moves_as_pinocchio_reads_it(arm_file: Path) -> None:
    """Mass matrix and bias at random states: skew, crossing and parallel axes, a slide, a branch, fixed links."""
    machine = load_machine(arm_file)
    model = build(machine)
    p = np.array([v if n.startswith(RIGID) else 0.0 for n, (v, _) in standard_parameters(machine).items()])
    q, nu, a = model.symbols()
    row = model.predict(q, nu, a, ca.DM(p))
    dynamics = ca.Function("f", [q, nu, a], [ca.jacobian(row, a), model.predict(q, nu, 0, ca.DM(p))])
    twin, ids = pinocchio(ARM)
    data, rng = twin.createData(), np.random.default_rng(0)
    rows = [twin.joints[k].idx_v for k in ids]
    for _ in range(50):
        at, rate = rng.uniform(-2, 2, (2, len(JOINTS)))
        there, speed = pin.neutral(twin), np.zeros(twin.nv)
        speed[rows] = rate
        step = np.zeros(twin.nv)
        step[rows] = at
        there = pin.integrate(twin, there, step)
        half = np.triu(pin.crba(twin, data, there))
        M = (half + np.triu(half, 1).T)[np.ix_(rows, rows)]
        bias = pin.rnea(twin, data, there, speed, np.zeros(twin.nv))[rows]
        got_M, got_bias = (x.full() for x in dynamics(at, rate, np.zeros(len(JOINTS))))
        assert got_M == pytest.approx(M, rel=1e-9, abs=1e-10)
        assert got_bias[:, 0] == pytest.approx(bias, rel=1e-9, abs=1e-9)


def test_an_estimate_moves_alike_in_the_urdf_that_is_written(arm_file: Path, tmp_path: Path) -> None:
    """Pinocchio reads the written file: same motion equations as the identified base parameters, possible bodies."""
    model = build(load_machine(arm_file))
    rng = np.random.default_rng(3)
    heavier = {n: v * rng.uniform(1.0, 1.3) if n[0] in "MF" else v for n, (v, _) in table_of(model).items()}
    X = model.base_values(heavier)
    n = len(X)
    known = Estimate(
        "inverse",
        model.base.names,
        model.base.units,
        X,
        np.diag((0.01 * model.scale) ** 2),
        1,
        1,
        0,
        np.zeros((n, 1)),
        9,
        {},
        (),
    )
    text, _ = urdf_with_estimate(ARM, model, known)
    written = tmp_path / "identified.urdf"
    written.write_text(text)
    q, nu, a = model.symbols()
    M = ca.Function("M", [q], [ca.jacobian(model.predict(q, nu, a, ca.DM(model.expand @ X)), a)])
    twin, ids = pinocchio(written)
    data, rows = twin.createData(), [twin.joints[k].idx_v for k in ids]
    assert all(np.linalg.eigvalsh(i.toPseudoInertia().toMatrix()).min() > 0 for i in list(twin.inertias)[1:])
    for _ in range(10):
        at = rng.uniform(-2, 2, len(JOINTS))
        step = np.zeros(twin.nv)
        step[rows] = at
        half = np.triu(pin.crba(twin, data, pin.integrate(twin, pin.neutral(twin), step)))
        assert (half + np.triu(half, 1).T)[np.ix_(rows, rows)] == pytest.approx(M(at).full(), rel=1e-4, abs=1e-4)
    body = load_machine(arm_file).body[0]
    assert twin.damping[rows[0]] == pytest.approx(heavier[f"Fv{body.index}"], rel=1e-6)


def table_of(model: Model) -> dict[str, tuple[float, str]]:
    return standard_parameters(model.machine)


def test_limits_and_friction_are_the_urdfs(arm_file: Path) -> None:
    shoulder, elbow, *_ = load_machine(arm_file).body
    assert (shoulder.name, float(shoulder.limit.torque), float(shoulder.limit.rate)) == ("upper_arm", 120, 2.5)
    assert (float(shoulder.friction.Fv), float(shoulder.friction.Fs)) == (1.4, 0.7)
    assert shoulder.limit.position_range == (-1.2, 2.1)
    assert elbow.limit.position_range is None
    assert elbow.friction.Fv.source == "assumed"


def test_a_file_that_is_no_robot_is_refused_in_a_line(excite: Excite, tmp_path: Path) -> None:
    file = tmp_path / "bad.urdf"
    file.write_text(ARM.read_text().replace('type="prismatic"', 'type="planar"'))
    code, _, stderr = excite("machine", "new", "arm", "--from", file, "--out", tmp_path / "arm.toml")
    assert code == 2
    assert "joint rail: type planar" in stderr
