"""What each equation of a machine predicts, its parameters, and its regressor.

Rows are the equations of motion written as the paper identifies them: an actuated row predicts the measured torque
(dynamics + friction - contact + offset u0), any other row predicts zero. The regressor is the exact Jacobian of that
prediction; nothing in the project spells the physics a second time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from model import contact, tree
from model.machine import Body, Machine, MachineError


@dataclass(frozen=True)
class BaseParameters:
    """The identifiable combinations of the standard parameters (Gautier, 1991).

    `matrix` (n_base, n_standard): base values = matrix @ standard values. `independent`: the standard column that
    stands for each base parameter. `invisible`: standard parameters that no motion shows.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    independent: tuple[int, ...]
    matrix: np.ndarray
    invisible: tuple[str, ...]
    standard: tuple[str, ...]

    def grouping(self, name: str) -> dict[str, float]:
        """The standard parameters that make up a base parameter, with their coefficients."""
        row = self.matrix[self.names.index(name)]
        return {s: float(c) for s, c in zip(self.standard, row, strict=True) if c != 0}


def standard_parameters(machine: Machine) -> dict[str, tuple[float, str]]:
    """Nominal value [SI] and unit of every standard parameter, chassis first, then joint by joint.

    The order decides which column of a dependent set stands for it, and it is the order of every table.
    """
    chassis: dict[str, tuple[float, str]] = {}
    joints: dict[str, tuple[float, str]] = {}
    for body in machine.body:
        k = body.index
        inertia = {n: (v, _inertial_unit(n)) for n, v in tree.standard_inertia(body).items()}
        if body.inertia is not None and body.inertia.axisymmetric:
            joints |= inertia
        else:
            chassis |= inertia
        if body.friction is not None:
            turn = body.joint == "revolute"
            joints[f"Fv{k}"] = (float(body.friction.Fv), "N m s" if turn else "N s/m")
            joints[f"Fs{k}"] = (float(body.friction.Fs), "N m" if turn else "N")
        if body.contact is not None:
            joints[f"Kx{k}"] = (float(body.contact.Kx), "N")
            joints[f"Ky{k}"] = (float(body.contact.Ky), "N")
        if body.friction is not None:
            joints[f"u{k}0"] = (float(body.friction.u0), "N m" if body.joint == "revolute" else "N")
    return chassis | joints


def _inertial_unit(name: str) -> str:
    letters = name.rstrip("0123456789")
    return {1: "kg", 2: "kg m" if letters[0] == "M" else "kg m2"}[len(letters)]


@dataclass(frozen=True, eq=False)
class Model:
    """A machine's equations as CasADi functions; build it with `build`.

    Samples: q (n_q,) coordinates [rad, m] with the pose on the ground; nu (n_q,) velocities and a (n_q,) their time
    derivatives, those of a planar root in its own axes; u (n_u,) torques that the motors deliver [N m]. Functions
    take (n_q, N) batches as they are. `nominal`, `scale`: (n_base,), of the base parameters X.
    """

    machine: Machine
    coordinates: tuple[str, ...]
    inputs: tuple[str, ...]
    slips: tuple[str, ...]
    base: BaseParameters
    nominal: np.ndarray
    scale: np.ndarray
    predict: ca.Function
    standard_regressor: ca.Function
    kinematics: ca.Function
    nonlinear: tuple[str, ...]

    @cached_property
    def rows(self) -> tuple[str, ...]:
        """Names of the equations: one per coordinate."""
        return self.coordinates

    @cached_property
    def actuated(self) -> tuple[int, ...]:
        """Indices of the actuated coordinates, one per input."""
        return tuple(self.coordinates.index(b.coordinates[0]) for b in self.machine.actuated)

    @cached_property
    def expand(self) -> np.ndarray:
        """(n_standard, n_base): standard parameters with the same motions as the base parameters X (the rest zero)."""
        matrix = np.zeros((len(self.base.standard), len(self.base.names)))
        matrix[list(self.base.independent), range(len(self.base.names))] = 1.0
        return matrix

    @cached_property
    def regressor(self) -> ca.Function:
        """(q, nu, a) -> W (n_rows, n_base): the exact Jacobian of the prediction, so that Y = W X.

        With a batch of N samples the result is (n_rows, n_base N), sample after sample.
        """
        q, nu, a = self.symbols()
        W = self.standard_regressor(q, nu, a, ca.DM(self.expand @ self.nominal))
        return ca.Function(
            "regressor", [q, nu, a], [ca.mtimes(W, ca.sparsify(ca.DM(self.expand)))], ["q", "nu", "a"], ["W"]
        )

    @cached_property
    def acceleration(self) -> ca.Function:
        """(q, nu, u, X) -> a: forward dynamics, mass matrix solved by LDL'."""
        q, nu, _ = self.symbols()
        u, X = ca.SX.sym("u", len(self.inputs)), ca.SX.sym("X", len(self.base.names))
        return ca.Function("acceleration", [q, nu, u, X], [self.accelerate(q, nu, u, X)], ["q", "nu", "u", "X"], ["a"])

    @cached_property
    def felt(self) -> tuple[str, ...]:
        """Coordinates that the equations depend on, found by numbers: a balanced roll's angle drops out only as
        cos^2 + sin^2 = 1, which no look at the expressions tells.
        """
        q, nu, a = self.symbols()
        p = ca.DM(self.expand @ self.nominal)
        slope = ca.Function("slope", [q, nu, a], [ca.jacobian(self.predict(q, nu, a, p), q)])
        rng = np.random.default_rng(0)
        change = np.zeros(len(self.coordinates))
        for _ in range(5):
            at = slope(*rng.uniform(-1, 1, (3, len(self.coordinates)))).full()
            change = np.maximum(change, np.abs(at).max(axis=0))
        floor = 1e-9 * float(np.abs(self.nominal).max())
        return tuple(c for c, size in zip(self.coordinates, change, strict=True) if size > floor)

    @cached_property
    def pivots(self) -> ca.Function:
        """(q, X) -> (n_q,) pivots of the mass matrix: all > 0 exactly where it is positive definite."""
        q, nu, _ = self.symbols()
        X = ca.SX.sym("X", len(self.base.names))
        D, _, _ = ca.ldl(self.equations(q, nu, X)[0])
        return ca.Function("pivots", [q, X], [D], ["q", "X"], ["D"])

    def accelerate(self, q: ca.SX, nu: ca.SX, u: ca.SX, X: ca.SX | ca.DM) -> ca.SX:
        """Forward dynamics as an expression; with numbers for X the graph is smaller and faster."""
        M, bias = self.equations(q, nu, X)
        drive = ca.SX(len(self.coordinates), 1)
        for k, row in enumerate(self.actuated):
            drive[row] = u[k]
        D, L, order = ca.ldl(M)
        return ca.ldl_solve(drive - bias, D, L, order)

    def equations(self, q: ca.SX, nu: ca.SX, X: ca.SX | ca.DM) -> tuple[ca.SX, ca.SX]:
        """Mass matrix (n_q, n_q) and bias (n_q,) without the offsets u0: M a + bias = delivered torques."""
        p = ca.mtimes(ca.sparsify(ca.DM(self.expand)), X)
        for body in self.machine.actuated:
            p[self.base.standard.index(f"u{body.index}0")] = 0
        a = ca.SX.sym("a", len(self.coordinates))
        return ca.jacobian(self.predict(q, nu, a, p), a), self.predict(q, nu, 0, p)

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        n = len(self.coordinates)
        return ca.SX.sym("q", n), ca.SX.sym("nu", n), ca.SX.sym("a", n)

    def stacked(self, q: np.ndarray, nu: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The regressor of N samples (n_q, N) as (N, n_rows, n_base)."""
        n = q.shape[1]
        W: np.ndarray = self.regressor(q, nu, a).full()
        return W.reshape(W.shape[0], n, len(self.base.names)).transpose(1, 0, 2)

    def base_values(self, standard: Mapping[str, float] | None = None) -> np.ndarray:
        """Base parameter values (n_base,) of standard values by name, the nominal ones where not given."""
        nominal = {n: v for n, (v, _) in standard_parameters(self.machine).items()}
        values = nominal | dict(standard or {})
        X: np.ndarray = self.base.matrix @ np.array([values[n] for n in self.base.standard])
        return X


def build(machine: Machine) -> Model:
    """The equations of a machine, with its base parameters found numerically. Raises MachineError if none is left."""
    names = machine.coordinates
    n = len(names)
    q, nu, a = ca.SX.sym("q", n), ca.SX.sym("nu", n), ca.SX.sym("a", n)
    table = standard_parameters(machine)
    _check_names(machine, tuple(table))
    p = ca.SX.sym("p", len(table))
    by_name = dict(zip(table, ca.vertsplit(p), strict=True))
    full = {c: ca.SX(0) for b in machine.body for c in b.coordinates}
    at = full | dict(zip(names, ca.vertsplit(q), strict=True))
    rate = full | dict(zip(names, ca.vertsplit(nu), strict=True))
    accel = full | dict(zip(names, ca.vertsplit(a), strict=True))

    heading = at[machine.body[0].coordinates[2]] if machine.planar else ca.SX(0)
    gravity = tree.rot_z(-heading) @ ca.DM(machine.gravity)
    frames = tree.motion(machine, at, rate, accel, gravity)
    rows = tree.generalised_forces(
        machine, at, frames, {b.index: tree.inertial_vector(b, by_name) for b in machine.body}
    )
    force = ca.vertcat(*[rows[c] for c in names])
    inputs: list[str] = []
    for body in machine.body:
        if body.friction is None or body.coordinates[0] not in names:
            continue
        row, w = names.index(body.coordinates[0]), rate[body.coordinates[0]]
        k = body.index
        force[row] += by_name[f"Fv{k}"] * w + by_name[f"Fs{k}"] * ca.tanh(w / float(body.friction.smoothing))
        if body.actuated:
            force[row] += by_name[f"u{k}0"]
            inputs.append(f"u{k}")
    slips: dict[str, ca.SX] = {}
    for body in machine.contacts:
        push, slip = _contact(machine, body, frames, nu, by_name)
        force -= push
        slips |= {f"gx{body.index}": slip.gx, f"gy{body.index}": slip.gy}
    if machine.planar and machine.body[0].coordinates[1] in machine.locked:
        slips = {s: e for s, e in slips.items() if not s.startswith("gy")}
    predict = ca.Function("predict", [q, nu, a, p], [force], ["q", "nu", "a", "p"], ["Y"])
    W = ca.Function("standard_regressor", [q, nu, a, p], [ca.jacobian(force, p)], ["q", "nu", "a", "p"], ["W"])
    curved = ca.which_depends(force, p, 2, False)
    nominal_p = np.array([v for v, _ in table.values()])
    base = base_parameters(machine, W, nominal_p, {s: unit for s, (_, unit) in table.items()})
    nominal = base.matrix @ nominal_p
    scale = np.array(
        [float(machine.scale[s]) if s in machine.scale else abs(x) for s, x in zip(base.names, nominal, strict=True)]
    )
    for s, x in zip(base.names, scale, strict=True):
        if x == 0:
            raise MachineError(
                f"{machine.name}: scale.{s}: the nominal value is 0, give a scale > 0 in the machine file"
            )
    return Model(
        machine,
        names,
        tuple(inputs),
        tuple(slips),
        base,
        nominal,
        scale,
        predict,
        W,
        _kinematics(machine, q, nu, at, rate, frames, slips, heading),
        tuple(s for s, bent in zip(table, curved, strict=True) if bent),
    )


def _check_names(machine: Machine, standard: tuple[str, ...]) -> None:
    """Names that the file gives to parameters or scales must exist, or a misspelt one would change nothing."""
    for name in machine.parameter_names:
        if name not in standard:
            raise MachineError(
                f"{machine.name}: parameter_names.{name}: no such parameter, allowed: {', '.join(standard)}"
            )
    groups = {s + "R" for s in standard} | set(machine.parameter_names.values())
    for name in machine.scale:
        if name not in standard and name not in groups:
            raise MachineError(
                f"{machine.name}: scale.{name}: no such parameter, allowed: {', '.join(standard)}, with R for a group"
            )


def _contact(
    machine: Machine, body: Body, frames: dict[int, tree.Frame], nu: ca.SX, p: dict[str, ca.SX]
) -> tuple[ca.SX, contact.Slip]:
    """Generalised contact force (n_q,) of a roll (11) and its slips, by virtual power."""
    assert body.contact is not None
    assert not isinstance(body.antecedent, str)
    carrier, roll = frames[body.antecedent], frames[body.index]
    R, _ = tree.place(body, {c: ca.SX(0) for c in body.coordinates})
    turn = carrier.rotation.T @ roll.rotation
    centre = turn @ roll.velocity
    axle = R[:, 2]
    spin = (axle.T @ turn) @ roll.omega
    yaw = carrier.omega[2]
    s = contact.slip(body.contact, centre[0], centre[1], spin)
    Kx, Ky = p[f"Kx{body.index}"], p[f"Ky{body.index}"]
    saturation = None
    if body.contact.law == "exponential":
        assert body.contact.saturation_slip is not None
        saturation = ca.SX(float(body.contact.saturation_slip))
    w = contact.wrench(body.contact, s, yaw, Kx, Ky, saturation)
    velocities = ca.vertcat(centre[0], centre[1], spin, yaw)
    wrench = ca.vertcat(w.Sx, w.Sy, -float(body.contact.radius) * w.Sx, -w.Tz)
    return ca.jacobian(velocities, nu).T @ wrench, s


def _kinematics(
    machine: Machine,
    q: ca.SX,
    nu: ca.SX,
    at: dict[str, ca.SX],
    rate: dict[str, ca.SX],
    frames: dict[int, tree.Frame],
    slips: dict[str, ca.SX],
    heading: ca.SX,
) -> ca.Function:
    """(q, nu) -> dq, slips, wheel rates, lateral and longitudinal speed of each body's origin, its ground position."""
    dq = nu
    if machine.planar:
        x, y, _ = machine.body[0].coordinates
        turned = dict(
            zip((x, y), ca.vertsplit((tree.rot_z(heading) @ ca.vertcat(rate[x], rate[y], 0))[:2]), strict=True)
        )
        dq = ca.vertcat(*[turned.get(c, rate[c]) for c in machine.coordinates])
    wheels = []
    for s in machine.sensor:
        if s.kind == "wheel":
            f = frames[s.body]
            assert s.radius is not None
            assert s.lateral is not None
            wheels.append((f.velocity[0] - float(s.lateral) * f.omega[2]) / float(s.radius))
    R = tree.rot_z(heading)
    root = ca.vertcat(*[at[c] for c in machine.body[0].coordinates[:2]], 0) if machine.planar else ca.SX(3, 1)
    places = ca.horzcat(*[root + R @ frames[b.index].position for b in machine.body])
    speeds = ca.horzcat(*[frames[b.index].velocity for b in machine.body])
    turns = ca.horzcat(*[frames[b.index].omega for b in machine.body])
    return ca.Function(
        "kinematics",
        [q, nu],
        [dq, ca.vertcat(*slips.values()), ca.vertcat(*wheels), places, speeds, turns],
        ["q", "nu"],
        ["dq", "slips", "wheels", "places", "speeds", "turns"],
    )


def base_parameters(machine: Machine, W: ca.Function, p: np.ndarray, units: dict[str, str]) -> BaseParameters:
    """Base parameters by QR of the standard regressor over random motions (Gautier, 1991).

    A column that depends on columns before it is grouped into them; coefficients are cleaned of rounding.
    Raises MachineError when no parameter can be seen.
    """
    standard = tuple(units)
    n = len(machine.coordinates)
    rng = np.random.default_rng(0)
    samples = max(60, 4 * len(standard))
    q, nu, a = (rng.uniform(-1, 1, (n, samples)) for _ in range(3))
    flat = W(q, nu, a, p).full().reshape(n, samples, len(standard))
    A = flat.transpose(1, 0, 2).reshape(-1, len(standard))
    size = np.linalg.norm(A, axis=0)
    floor = 1e-12 * size.max()
    independent: list[int] = []
    invisible: list[str] = []
    matrix = np.zeros((len(standard), len(standard)))
    Q = np.zeros((A.shape[0], 0))
    for j in range(len(standard)):
        if size[j] <= floor:
            invisible.append(standard[j])
            continue
        rest = A[:, j] - Q @ (Q.T @ A[:, j])
        rest -= Q @ (Q.T @ rest)
        if np.linalg.norm(rest) > 1e-9 * size[j]:
            matrix[j, j] = 1.0
            independent.append(j)
            Q = np.column_stack([Q, rest / np.linalg.norm(rest)])
            continue
        coefficients = np.linalg.lstsq(A[:, independent], A[:, j], rcond=None)[0]
        coefficients = np.where(np.abs(coefficients) < 1e-9, 0.0, np.round(coefficients, 12))
        matrix[independent, j] = coefficients
    if not independent:
        raise MachineError(
            f"{machine.name}: no parameter can be seen in any motion, check the table and what is locked"
        )
    chosen = matrix[independent]
    names = tuple(
        machine.parameter_names.get(standard[j], standard[j] + ("R" if np.count_nonzero(row) > 1 else ""))
        for j, row in zip(independent, chosen, strict=True)
    )
    twice = sorted({s for s in names if names.count(s) > 1})
    if twice:
        raise MachineError(
            f"{machine.name}: parameter_names: two base parameters get the same name: {', '.join(twice)}"
        )
    return BaseParameters(
        names, tuple(units[standard[j]] for j in independent), tuple(independent), chosen, tuple(invisible), standard
    )
