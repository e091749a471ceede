"""Rigid bodies against pinocchio, which knows nothing of this code: other algorithms, other frames, other axes."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
import sympy as sp
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

from excite.model import Model, build, standard_parameters
from excite.model.machine import Body, Machine, load_machine
from excite.model.mechanics import round_angle

STATES = 1000
TOLERANCE = 1e-9


# ------------------------------------------------------------------------------------------ machines at random
def quantity(value: float) -> dict[str, Any]:
    return {"value": float(value), "source": "assumed"}


def random_inertia(rng: np.random.Generator) -> dict[str, Any]:
    """A solid body somewhere: full inertia tensor about the centre of mass, from point masses, so it can exist."""
    mass = rng.uniform(0.5, 5.0)
    points = rng.normal(0.0, 0.4, (8, 3))
    points -= points.mean(axis=0)
    J = mass / 8 * sum(np.dot(r, r) * np.eye(3) - np.outer(r, r) for r in points)
    axes = {"XX": (0, 0), "XY": (0, 1), "XZ": (0, 2), "YY": (1, 1), "YZ": (1, 2), "ZZ": (2, 2)}
    com = {"value": rng.normal(0.0, 0.5, 3).tolist(), "source": "assumed"}
    return {"mass": quantity(mass), "com": com} | {k: quantity(J[ij]) for k, ij in axes.items()}


def random_tree(seed: int, joints: str, parents: tuple[int, ...]) -> Machine:
    """joints: one letter per body, l planar, r revolute, p prismatic, f fixed; parents: index of each one's carrier.

    Every entry of the table that the joint's coordinate doesn't replace is nonzero, and gravity points anywhere.
    """
    rng = np.random.default_rng(seed)
    kinds = {"l": "planar", "r": "revolute", "p": "prismatic", "f": "fixed"}
    replaced = {"l": {"gamma", "b", "alpha", "d", "theta", "r"}, "r": {"theta"}, "p": {"r"}, "f": set()}
    bodies: list[dict[str, Any]] = []
    for k, (letter, parent) in enumerate(zip(joints, parents, strict=True)):
        row: dict[str, Any] = {
            "index": k,
            "name": f"body{k}",
            "antecedent": "ground" if k == 0 else parent,
            "joint": kinds[letter],
            "inertia": random_inertia(rng),
        }
        # Rounded as the model rounds them, so that pinocchio has the same geometry.
        angles = {c: quantity(round_angle(rng.uniform(-math.pi, math.pi))) for c in ("gamma", "alpha", "theta")}
        lengths = {c: quantity(rng.uniform(-1.0, 1.0)) for c in ("b", "d", "r")}
        row |= {c: v for c, v in (angles | lengths).items() if c not in replaced[letter]}
        if letter in "rp":
            friction = {c: quantity(1.0) for c in ("Fv", "Fs", "u0", "smoothing")}
            row |= {"actuated": True, "friction": friction}
        bodies.append(row)
    return Machine.model_validate(
        {
            "name": f"tree{seed}",
            "title": "random tree",
            "sampling_hz": quantity(100),
            "gravity": rng.normal(0.0, 6.0, 3).tolist(),
            "body": bodies,
            "sensor": [],
            "filter": {"source": "assumed", "cutoff_hz": quantity(5)},
        }
    )


MACHINES = {
    "va12": load_machine("va12"),
    "arm": random_tree(1, "rprfrpr", (-1, 0, 1, 1, 3, 2, 4)),
    "gantry": random_tree(2, "pfrrprf", (-1, 0, 1, 1, 2, 3, 4)),
    "vehicle": random_tree(3, "lrprfrr", (-1, 0, 0, 1, 2, 4, 4)),
}


@pytest.fixture(scope="module", params=list(MACHINES))
def case(request: pytest.FixtureRequest) -> Case:
    return Case(MACHINES[request.param])


# ------------------------------------------------------------------------------------- the same in pinocchio
def rotation(axis: str, angle: float) -> pin.SE3:
    return pin.SE3(pin.rpy.rpyToMatrix(angle if axis == "x" else 0.0, 0.0, angle if axis == "z" else 0.0), np.zeros(3))


def translation(*vector: float) -> pin.SE3:
    return pin.SE3(np.eye(3), np.array(vector))


def placement(body: Body) -> pin.SE3:
    """The row of the table with its coordinate at zero: theta and r are about and along one axis, so they commute."""
    theta = 0.0 if body.joint == "revolute" else float(body.theta)
    r = 0.0 if body.joint == "prismatic" else float(body.r)
    before = rotation("z", float(body.gamma)) * translation(0, 0, float(body.b))
    twist = rotation("x", float(body.alpha)) * translation(float(body.d), 0, 0)
    return before * twist * rotation("z", theta) * translation(0, 0, r)


def inertia(body: Body) -> pin.Inertia:
    i = body.inertia
    assert i is not None
    yy = i.XX if i.axisymmetric else i.YY
    J = [[i.XX, i.XY, i.XZ], [i.XY, yy, i.YZ], [i.XZ, i.YZ, i.ZZ]]
    return pin.Inertia(float(i.mass), np.array(i.com.value), np.array(J, dtype=float))


class Case:
    """A machine without contact and friction, and the same tree in pinocchio. A planar root is PX, PY, RZ there."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.model: Model = build(machine)
        self.pin = pin.Model()
        self.pin.gravity.linear = np.array(machine.gravity)
        self.order: dict[str, int] = {}
        self.frames: dict[int, int] = {}
        self._add(machine.body[0], 0, pin.SE3.Identity())
        self.data = self.pin.createData()
        self.columns = [self.order[c] for c in machine.coordinates]
        other = ("Fv", "Fs", "Kx", "Ky", "u")
        self.p = np.array(
            [0.0 if name.startswith(other) else v for name, (v, _) in standard_parameters(machine).items()]
        )
        q, nu, a = self.model.symbols()
        row = self.model.predict(q, nu, a, ca.DM(self.p))
        self.M = ca.Function("M", [q], [ca.jacobian(row, a)])
        self.bias = ca.Function("bias", [q, nu], [self.model.predict(q, nu, 0, ca.DM(self.p))])

    def _add(self, body: Body, joint: int, offset: pin.SE3) -> None:
        """Depth first, as pinocchio's algorithms want their joints."""
        offset = offset * placement(body)
        kinds = {
            "planar": (pin.JointModelPX, pin.JointModelPY, pin.JointModelRZ),
            "revolute": (pin.JointModelRZ,),
            "prismatic": (pin.JointModelPZ,),
            "fixed": (),
        }[body.joint]
        for name, kind in zip(body.coordinates, kinds, strict=True):
            joint = self.pin.addJoint(joint, kind(), offset, name)
            self.order[name] = self.pin.joints[joint].idx_v
            offset = pin.SE3.Identity()
        if body.inertia is not None:
            self.pin.appendBodyToJoint(joint, inertia(body), offset)
        self.frames[body.index] = self.pin.addFrame(pin.Frame(body.name, joint, offset, pin.FrameType.OP_FRAME))
        for child in self.machine.body:
            if child.antecedent == body.index:
                self._add(child, joint, offset)

    def turn(self, q: np.ndarray) -> np.ndarray:
        """(n, n) from velocities in the chassis' axes to pinocchio's, rows in pinocchio's order."""
        T = np.eye(len(q))
        if self.machine.planar:
            c, s = math.cos(q[2]), math.sin(q[2])
            T[:2, :2] = [[c, -s], [s, c]]
        return T[np.argsort(self.columns)]

    def turn_rate(self, q: np.ndarray, nu: np.ndarray) -> np.ndarray:
        """(n,) what d/dt of that adds to the acceleration: omega x V."""
        rate = np.zeros(len(q))
        if self.machine.planar:
            rate[:2] = [-nu[2] * nu[1], nu[2] * nu[0]]
        return self.turn(q) @ rate

    def pose(self, q: np.ndarray) -> np.ndarray:
        return q[np.argsort(self.columns)]

    def reference(self, q: np.ndarray, nu: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass matrix, bias and inverse dynamics by pinocchio, in the model's rows."""
        T, at = self.turn(q), self.pose(q)
        half = np.triu(pin.crba(self.pin, self.data, at))
        M = T.T @ (half + np.triu(half, 1).T) @ T
        drift = self.turn_rate(q, nu)
        bias = T.T @ pin.rnea(self.pin, self.data, at, T @ nu, drift)
        return M, bias, T.T @ pin.rnea(self.pin, self.data, at, T @ nu, T @ a + drift)

    def energy(self, q: np.ndarray, nu: np.ndarray) -> float:
        at = self.pose(q)
        kinetic = pin.computeKineticEnergy(self.pin, self.data, at, self.turn(q) @ nu)
        return float(kinetic + pin.computePotentialEnergy(self.pin, self.data, at))

    def states(self, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q (n_q, n) anywhere, velocities and accelerations of order one."""
        rng = np.random.default_rng(seed)
        size = (len(self.machine.coordinates), n)
        return rng.uniform(-math.pi, math.pi, size), rng.normal(size=size), rng.normal(size=size)


def relative(got: np.ndarray, want: np.ndarray) -> float:
    return float(np.linalg.norm(got - want) / np.linalg.norm(want))


# ------------------------------------------------------------------------------------------------- dynamics
def worst_errors(case: Case, n: int, seed: int = 0) -> dict[str, float]:
    """The worst relative error of any state."""
    worst = {"mass matrix": 0.0, "bias": 0.0, "inverse dynamics": 0.0, "forward dynamics": 0.0}
    q, nu, a = case.states(n, seed)
    Y = case.model.predict(q, nu, a, case.p).full()
    bias = case.bias(q, nu).full()
    for k in range(n):
        M, want_bias, want = case.reference(q[:, k], nu[:, k], a[:, k])
        got_M = case.M(q[:, k]).full()
        errors = {
            "mass matrix": relative(got_M, M),
            "bias": relative(bias[:, k], want_bias),
            "inverse dynamics": relative(Y[:, k], want),
            "forward dynamics": relative(np.linalg.solve(got_M, want - bias[:, k]), a[:, k]),
        }
        worst = {name: max(worst[name], error) for name, error in errors.items()}
    return worst


def test_dynamics_are_pinocchios(case: Case) -> None:
    worst = worst_errors(case, STATES)
    print(case.machine.name, {name: f"{error:.1e}" for name, error in worst.items()})
    assert max(worst.values()) <= TOLERANCE, worst


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    planar=st.booleans(),
    joints=st.lists(st.sampled_from("rrpf"), min_size=1, max_size=5),
    data=st.data(),
)
def test_any_tree_has_pinocchios_dynamics(seed: int, planar: bool, joints: list[str], data: st.DataObject) -> None:
    letters = ("l" if planar else "r") + "".join(joints)
    parents = (-1, *(data.draw(st.integers(0, k)) for k in range(len(joints))))
    if planar and set(joints) == {"f"}:
        letters += "r"
        parents += (0,)
    worst = worst_errors(Case(random_tree(seed, letters, parents)), 5, seed)
    assert max(worst.values()) <= TOLERANCE, worst


def test_base_parameters_move_like_the_bodies(case: Case) -> None:
    """Mass matrix and bias from the grouped parameters alone, against pinocchio with each body's own."""
    rigid = dict(zip(standard_parameters(case.machine), case.p, strict=True))
    q, nu, _ = case.model.symbols()
    f = ca.Function("f", [q, nu], case.model.equations(q, nu, ca.DM(case.model.base_values(rigid))))
    at, rate, accel = case.states(50, seed=1)
    for k in range(50):
        M, bias = (x.full() for x in f(at[:, k], rate[:, k]))
        want_M, want_bias, _ = case.reference(at[:, k], rate[:, k], accel[:, k])
        assert relative(M, want_M) <= TOLERANCE
        assert relative(bias[:, 0], want_bias) <= TOLERANCE


def test_mass_matrix_is_symmetric_and_positive(case: Case) -> None:
    for q in case.states(50)[0].T:
        M = case.M(q).full()
        assert np.allclose(M, M.T, rtol=0, atol=1e-12 * np.abs(M).max())
        assert np.linalg.eigvalsh(M).min() > 0


def test_bodies_are_where_pinocchio_has_them(case: Case) -> None:
    """Ground position of every body's origin, its speed and turn rate in its own axes, and q' of the pose."""
    q, nu, _ = case.states(50, seed=2)
    for at, rate in zip(q.T, nu.T, strict=True):
        dq, _, _, places, speeds, turns = (x.full() for x in case.model.kinematics(at, rate))
        pose, velocity = case.pose(at), case.turn(at) @ rate
        pin.forwardKinematics(case.pin, case.data, pose, velocity)
        pin.updateFramePlacements(case.pin, case.data)
        assert np.allclose(dq[:, 0], velocity[case.columns], atol=1e-12)
        for k, body in enumerate(case.machine.body):
            frame = case.frames[body.index]
            v = pin.getFrameVelocity(case.pin, case.data, frame, pin.LOCAL)
            assert np.allclose(places[:, k], case.data.oMf[frame].translation, atol=1e-11)
            assert np.allclose(speeds[:, k], v.linear, atol=1e-11)
            assert np.allclose(turns[:, k], v.angular, atol=1e-11)


def test_energy_is_conserved_without_friction_and_contact(case: Case) -> None:
    """The model moves the machine, pinocchio counts the energy."""
    n = len(case.machine.coordinates)
    q, nu, a = case.model.symbols()
    M = ca.jacobian(case.model.predict(q, nu, a, ca.DM(case.p)), a)
    accelerate = ca.solve(M, -case.model.predict(q, nu, 0, ca.DM(case.p)))
    f = ca.Function("f", [ca.vertcat(q, nu)], [ca.vertcat(case.model.kinematics(q, nu)[0], accelerate)])
    rng = np.random.default_rng(5)
    start = rng.normal(0.0, 1.0, 2 * n)
    run = solve_ivp(lambda t, y: f(y).full()[:, 0], (0.0, 2.0), start, method="DOP853", rtol=1e-11, atol=1e-12)
    assert run.success
    energy = np.array([case.energy(y[:n], y[n:]) for y in run.y.T])
    kinetic = np.array([0.5 * y[n:] @ case.M(y[:n]).full() @ y[n:] for y in run.y.T])
    assert np.ptp(run.y[:n], axis=1).min() > 0.01, "every coordinate moves"
    assert np.ptp(energy) <= 1e-8 * kinetic.max()


# -------------------------------------------------------------------------------------------- straight line
def to_sympy(f: ca.Function, inputs: list[list[sp.Expr]]) -> list[sp.Expr]:
    """Run a CasADi function's own instructions on SymPy expressions: no sampling, no parsing of text.

    Constants are decimals of a machine file or their products: exact fractions with a small denominator.
    """
    two = {ca.OP_ADD: sp.Add, ca.OP_MUL: sp.Mul, ca.OP_SUB: lambda x, y: x - y, ca.OP_DIV: lambda x, y: x / y}
    one = {
        ca.OP_NEG: lambda x: -x,
        ca.OP_SQ: lambda x: x**2,
        ca.OP_TWICE: lambda x: 2 * x,
        ca.OP_SQRT: sp.sqrt,
        ca.OP_TANH: sp.tanh,
        ca.OP_INV: lambda x: 1 / x,
        ca.OP_ASSIGN: lambda x: x,
        ca.OP_COS: sp.cos,
        ca.OP_SIN: sp.sin,
    }
    work: dict[int, sp.Expr] = {}
    out: dict[int, sp.Expr] = {}
    for k in range(f.n_instructions()):
        op, source, target = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_CONST:
            work[target[0]] = sp.Rational(f.instruction_constant(k)).limit_denominator(10**6)
        elif op == ca.OP_INPUT:
            work[target[0]] = inputs[source[0]][source[1]]
        elif op == ca.OP_OUTPUT:
            out[target[1]] = work[source[0]]
        elif op in two:
            work[target[0]] = two[op](work[source[0]], work[source[1]])
        else:
            work[target[0]] = one[op](work[source[0]])
    return [out.get(k, sp.Integer(0)) for k in range(f.nnz_out(0))]


def straight_line() -> tuple[list[sp.Expr], list[list[sp.Expr]]]:
    """(26) by Lagrange: a machine of mass M that slides along x, two rolls that spin; soil and friction by power.

    Returns the three rows and the symbols (q, nu, a, X) that stand in them, X in the contract's order.
    """
    t = sp.Symbol("t", real=True)
    x, th1, th4 = (sp.Function(n)(t) for n in ("x", "th1", "th4"))
    names = "M ZZ1 Fv1 Fs1 Kx1 u10 ZZ4 Fv4 Fs4 Kx4 u40"
    M, ZZ1, Fv1, Fs1, Kx1, u10, ZZ4, Fv4, Fs4, Kx4, u40 = X = sp.symbols(names, real=True)
    Rc, v_eps, w_s = sp.Rational("0.65"), sp.Rational("0.05"), sp.Rational("0.02")
    v, w1, w4 = (sp.diff(c, t) for c in (x, th1, th4))
    kinetic = (M * v**2 + ZZ1 * w1**2 + ZZ4 * w4**2) / 2
    g1, g4 = ((v - Rc * w) / sp.sqrt((Rc * w) ** 2 + v_eps**2) for w in (w1, w4))
    soil = {x: Kx1 * g1 + Kx4 * g4, th1: -Rc * Kx1 * g1, th4: -Rc * Kx4 * g4}
    joint = {
        x: sp.Integer(0),
        th1: Fv1 * w1 + Fs1 * sp.tanh(w1 / w_s) + u10,
        th4: Fv4 * w4 + Fs4 * sp.tanh(w4 / w_s) + u40,
    }
    rows = [
        sp.diff(sp.diff(kinetic, sp.diff(c, t)), t) - sp.diff(kinetic, c) - soil[c] + joint[c] for c in (x, th1, th4)
    ]
    q, nu, a = (list(sp.symbols(n, real=True)) for n in ("q_x q_1 q_4", "v w_1 w_4", "a_x a_1 a_4"))
    for order, symbols in ((2, a), (1, nu), (0, q)):
        now = {sp.diff(c, t, order) if order else c: s for c, s in zip((x, th1, th4), symbols, strict=True)}
        rows = [row.subs(now) for row in rows]
    return rows, [q, nu, a, list(X)]


def test_the_straight_line_is_equation_26() -> None:
    """The model's prediction, as an expression, is (26) as an expression."""
    model = build(load_machine("va12_straight"))
    rows, symbols = straight_line()
    assert list(model.base.names) == [str(s) for s in symbols[3]]
    q, nu, a = model.symbols()
    X = ca.SX.sym("X", len(model.base.names))
    predict = ca.Function("predict", [q, nu, a, X], [ca.densify(model.predict(q, nu, a, model.expand @ X))])
    for got, want in zip(to_sympy(predict, symbols), rows, strict=True):
        assert sp.simplify(got - want) == 0


def test_the_straight_lines_regressor_is_the_derivative_of_equation_26() -> None:
    """Column by column, as expressions."""
    model = build(load_machine("va12_straight"))
    rows, symbols = straight_line()
    q, nu, a = model.symbols()
    W = ca.Function("W", [q, nu, a], [ca.densify(model.regressor(q, nu, a))])
    got = sp.Matrix(11, 3, to_sympy(W, symbols[:3])).T
    want = sp.Matrix(rows).jacobian(symbols[3])
    assert (got - want).applyfunc(sp.simplify) == sp.zeros(3, 11)


def test_held_coordinates_are_a_constraint_not_another_machine() -> None:
    """The straight line's rows are the free machine's rows x0, theta1, theta4 where y0, theta0, theta2 stay zero."""
    free, held = build(load_machine("va12")), build(load_machine("va12_straight"))
    keep = [free.coordinates.index(c) for c in held.coordinates]
    p = np.array([v for v, _ in standard_parameters(held.machine).values()])
    rng = np.random.default_rng(8)
    q, nu, a = (np.zeros((6, 40)) for _ in range(3))
    for z in (q, nu, a):
        z[keep] = rng.normal(size=(3, 40))
    want = free.predict(q, nu, a, p).full()
    assert np.abs(want[[1, 2, 4]]).max() > 1, "the free machine would yaw: its centre of mass is off the axis"
    assert np.allclose(held.predict(q[keep], nu[keep], a[keep], p).full(), want[keep], rtol=1e-12, atol=1e-9)
