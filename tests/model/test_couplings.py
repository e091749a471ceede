"""Joints that share an angle or a torque obey the equations of the same machine with every joint by itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.coupled import chained_robot, one_pump, quantity, with_changes

from excite.errors import MachineError
from excite.model import Model, build
from excite.model.machine import Machine, load_machine
from excite.simulation import simulate
from excite.trajectories import machine_limits


@pytest.mark.parametrize("ratio", [1.0, -0.8])
def test_chained_wheels_obey_lagrange_multipliers(ratio: float) -> None:
    """M a + bias = B u + A' lambda of the machine with four wheels of their own, A the constraints of both chains."""
    free, chained = build(load_machine("skid_robot")), build(Machine.model_validate(chained_robot(ratio)))
    assert (chained.coordinates, chained.inputs) == (("x0", "y0", "theta0", "theta1", "theta2"), ("u1", "u2"))
    S = np.vstack([np.eye(5), [0, 0, 0, ratio, 0], [0, 0, 0, 0, ratio]])  # angles of all joints by those that are left
    A = np.array([[0, 0, 0, ratio, 0, -1, 0], [0, 0, 0, 0, ratio, 0, -1]])
    rng = np.random.default_rng(0)
    q, u = rng.normal(size=5), np.array([6.0, -3.0])
    nu = np.array([0.7, 0.05, 0.4, 4.6, 4.0])  # so fast that every friction has its full size
    a0 = np.zeros(7)

    def balance(a: np.ndarray) -> np.ndarray:
        return np.asarray(free.balance(S @ q, S @ nu, a, free.expand @ free.nominal).full()[:, 0])

    M = np.column_stack([balance(e) - balance(a0) for e in np.eye(7)])
    system = np.block([[M, -A.T], [A, np.zeros((2, 2))]])
    drive = np.array([0, 0, 0, *u, 0, 0])
    expected = np.linalg.solve(system, np.concatenate([drive - balance(a0), [0, 0]]))[:5]
    found = chained.acceleration(q, nu, u, chained.nominal).full()[:, 0]
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


def pump_model() -> tuple[Model, np.ndarray]:
    """The roller with one pump for both rolls, and torques (N, 2) [N m] of pump and articulation."""
    t = np.arange(0, 6, 0.01)
    return build(Machine.model_validate(one_pump(1.1))), np.column_stack(
        [1500 * np.sin(1.1 * t), 4000 * np.sin(0.7 * t)]
    )


def test_one_pump_turns_two_rolls_by_a_common_torque(va12: Model) -> None:
    model, u = pump_model()
    assert model.inputs == ("u1", "u2")
    together = simulate(model, u)
    alone = simulate(va12, np.column_stack([u, 1.1 * u[:, 0]]))
    assert together.q == pytest.approx(alone.q, rel=1e-6, abs=1e-7)
    W = model.stacked_regressor(together.q.T, together.nu.T, together.a.T)
    rows = W @ model.nominal
    told = np.zeros_like(rows)
    told[:, list(model.actuated)] = u + model.offsets @ model.nominal  # the row of the other roll has no torque left
    assert rows == pytest.approx(told, abs=1e-6)


def test_limits_are_those_of_all_that_moves() -> None:
    model, _ = pump_model()
    limit = {g.name: g for g in machine_limits(model, model.machine.problems["R60"])}
    assert limit["torque u1"].high == pytest.approx(5000 / 1.1)
    nu, u = np.array([0.5, 0, 0, 1.0, 0.2, 1.5]), np.array([1000.0, -500.0])
    power = float(limit["power"].expression(np.zeros(6), nu, u, np.zeros(2)))
    assert power == pytest.approx(1000 * (1.0 + 1.1 * 1.5) + 500 * 0.2, rel=1e-3)
    robot = build(Machine.model_validate(chained_robot(2.0)))
    rim = {g.name: g for g in machine_limits(robot, robot.machine.problems["R20"])}["rim speed rear_left"]
    assert float(rim.expression(np.zeros(5), np.array([0, 0, 0, 3.0, 0]), np.zeros(2), 0)) == pytest.approx(0.98754)


def test_dry_friction_of_chained_wheels_adds_up() -> None:
    robot = build(Machine.model_validate(chained_robot(1.0)))
    u = np.zeros((400, 2))
    own = [float(b.friction.Fs) for b in robot.machine.body if b.friction is not None]
    u[:, 0], u[:, 1] = 0.97 * (own[0] + own[2]), 0.97 * (own[1] + own[3])
    assert not simulate(robot, u, friction="set-valued").nu.any()
    assert simulate(robot, u * 1.1, friction="set-valued").nu[-1, 3:].min() > 0.01


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "itself": ({"rear_left": {"moves_with": {"joint": 3}}}, "no other joint 3"),
    "none": ({"rear_left": {"moves_with": {"joint": 9}}}, "no other joint 9"),
    "driven": ({"rear_left": {"actuated": True, "moves_with": {"joint": 1}}}, "leave out actuated"),
    "zero": ({"rear_left": {"moves_with": {"joint": 1, "ratio": quantity(0)}}}, "must not be 0"),
    "chain": ({"rear_right": {"moves_with": {"joint": 3}}}, "moves with joint 1 itself"),
    "idle": ({"rear_left": {"driven_with": {"joint": 4}, "moves_with": None}}, "isn't actuated"),
    "both": ({"rear_left": {"driven_with": {"joint": 1}}}, "moves with a driven joint"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_coupling_is_named(case: str, tmp_path: Any) -> None:
    changes, says = WRONG[case]
    machine = with_changes(chained_robot(1.0), changes)
    with pytest.raises((MachineError, ValueError), match=says):
        Machine.model_validate(machine)
