"""What each equation of a machine predicts, its parameters, and its regressor.

Rows are the equations of motion written as the paper identifies them: an actuated row predicts the measured torque
(dynamics + friction - contact + offset u0), any other row predicts zero. The regressor is the exact Jacobian of that
prediction; nothing in the project spells the physics a second time. Effects of the machine file (`effects`) are part of
the prediction, and their amounts are parameters like the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from excite.errors import MachineError
from excite.model import mechanics
from excite.model.effects import GroundMap, PlacedEffect, Site, place_effect
from excite.model.equations import Equations, contact_lines, equations, kinematics
from excite.model.machine import Machine
from excite.model.mechanics import independent_columns


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

    @cached_property
    def expand(self) -> np.ndarray:
        """(n_standard, n_base): standard parameters with the same motions as the base parameters X (the rest zero)."""
        matrix = np.zeros((len(self.standard), len(self.names)))
        matrix[list(self.independent), range(len(self.names))] = 1.0
        return matrix

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
        inertia = {n: (v, _inertial_unit(n)) for n, v in mechanics.standard_inertia(body).items()}
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


def required_signs(machine: Machine) -> dict[str, float]:
    """The sign that standard parameters must have, of those that have one by themselves: joints only brake and the soil
    only resists."""
    found: dict[str, float] = {}
    for body in machine.body:
        if body.friction is not None:
            found |= dict.fromkeys((f"Fv{body.index}", f"Fs{body.index}"), 1.0)
        if body.contact is not None:
            found |= dict.fromkeys((f"Kx{body.index}", f"Ky{body.index}"), -1.0)
    return found


def _inertial_unit(name: str) -> str:
    letters = name.rstrip("0123456789")
    return {1: "kg", 2: "kg m" if letters[0] == "M" else "kg m2"}[len(letters)]


@dataclass(frozen=True, eq=False)
class Model:
    """A machine's equations as CasADi functions; build it with `build`.

    Samples: q (n_q,) coordinates [rad, m] with the pose on the ground; nu (n_q,) velocities and a (n_q,) their time
    derivatives, those of a planar root in its own axes; u (n_u,) torques that the motors deliver [N m]. Functions
    take (n_q, N) batches as they are. `nominal`, `scale`: (n_base,), of the base parameters X, behind which come the
    amounts of the machine's effects. With effects, functions of a sample take two more arguments, `beside`: u, and
    what the effects remember, z (n_z,), whose rates are `flow` (q, nu, u, z, X) and which starts as `fresh`. The last
    ones of z, `mapped`, have no rate: a map of the ground tells them, at every sample anew (`ground`, axles: q -> where
    contacts are).

    read: (q, nu, wheels, u, z, X) -> exact readings of the sensors that `readable` names. channels: (t, X) -> gain,
    offset, delay (n_u,) of the torque sensors.
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
    balance: ca.Function
    flow: ca.Function
    read: ca.Function
    channels: ca.Function
    readable: tuple[str, ...]
    memory: tuple[str, ...]
    mapped: tuple[str, ...]
    axles: ca.Function
    effects: tuple[PlacedEffect, ...]
    flaws: bool
    shapes: bool

    @property
    def plain(self) -> bool:
        """Whether the machine file names no effect."""
        return not self.effects

    @property
    def fresh(self) -> np.ndarray:
        """What effects remember at rest, before a log begins (n_z,)."""
        return np.zeros(len(self.memory))

    @cached_property
    def positive(self) -> np.ndarray:
        """Which parameters make sense above zero only (n_base,): some effects' amounts, shapes that aren't signed."""
        above = {e.name for e in self.effects if e.effect.positive}
        above |= {f"{e.name}.{s}" for e in self.effects for s, shape in e.effect.shapes.items() if not shape.signed}
        return np.array([name in above for name in self.base.names])

    def ground(self) -> Callable[[np.ndarray], np.ndarray]:
        """A map of ground on which no contact has been yet: what it tells (n_contacts MOST,) when the machine has come
        to coordinates (n_q,), called for one sample of a motion after the other."""
        contacts = [b.contact for b in self.machine.contacts if b.contact is not None]
        ground = GroundMap([float(c.width) for c in contacts])
        q, axles = np.zeros(len(self.coordinates)), np.zeros((len(contacts), 4))
        told = self.axles.buffer()
        told[0].set_arg(0, q.data)
        told[0].set_res(0, axles.data)

        def come(to: np.ndarray) -> np.ndarray:
            q[:] = to
            told[1]()  # not by itself: its buffer must not be gone
            return ground.come(axles)

        return come

    @property
    def lasting(self) -> int:
        """How many of z have a rate: those before what is `mapped`."""
        return len(self.memory) - len(self.mapped)

    @property
    def remembered(self) -> np.ndarray:
        """How well `fresh` is known at the start of a log, of what is `lasting`."""
        own = [m.spread for e in self.effects for _, m in e.memory.values()]
        return np.array([1e-6] * ("time" in self.memory) + own)

    @cached_property
    def rows(self) -> tuple[str, ...]:
        """Names of the equations: one per coordinate."""
        return self.coordinates

    @cached_property
    def actuated(self) -> tuple[int, ...]:
        """Indices of the actuated coordinates, one per input."""
        return tuple(self.coordinates.index(b.coordinates[0]) for b in self.machine.actuated)

    @property
    def expand(self) -> np.ndarray:
        """(n_standard, n_base): standard parameters with the same motions as the base parameters X (the rest zero)."""
        return self.base.expand

    @cached_property
    def offsets(self) -> np.ndarray:
        """(n_u, n_base): takes the offsets u0 of the torque channels [N m, N] out of the base parameters X."""
        return self.expand[[self.base.standard.index(f"u{b.index}0") for b in self.machine.actuated]]

    @cached_property
    def regressor(self) -> ca.Function:
        """(q, nu, a) -> W (n_rows, n_base): the exact Jacobian of the prediction, so that Y = W X.

        With a batch of N samples the result is (n_rows, n_base N), sample after sample.
        """
        q, nu, a = self.symbols()
        beside = self.beside()
        W = self.standard_regressor(q, nu, a, ca.DM(self.expand @ self.nominal), *beside)
        names = ["q", "nu", "a", "u", "z"][: 3 + len(beside)]
        return ca.Function(
            "regressor", [q, nu, a, *beside], [ca.mtimes(W, ca.sparsify(ca.DM(self.expand)))], names, ["W"]
        )

    @cached_property
    def acceleration(self) -> ca.Function:
        """(q, nu, u, z, X) -> a, without z for a plain model: forward dynamics, mass matrix solved by LDL'."""
        q, nu, _ = self.symbols()
        u, X = ca.SX.sym("u", len(self.inputs)), ca.SX.sym("X", len(self.base.names))
        z = () if self.plain else (ca.SX.sym("z", len(self.memory)),)
        names = ["q", "nu", "u", *["z" for _ in z], "X"]
        return ca.Function("acceleration", [q, nu, u, *z, X], [self.accelerate(q, nu, u, X, *z)], names, ["a"])

    @cached_property
    def felt(self) -> tuple[str, ...]:
        """Coordinates that the equations depend on, found by numbers: a balanced wheel's angle drops out only as
        cos^2 + sin^2 = 1, which no look at the expressions tells.
        """
        q, nu, a = self.symbols()
        p = ca.DM(self.expand @ self.nominal)
        beside = self.beside()
        slope = ca.Function("slope", [q, nu, a, *beside], [ca.jacobian(self.predict(q, nu, a, p, *beside), q)])
        rng = np.random.default_rng(0)
        change = np.zeros(len(self.coordinates))
        for _ in range(5):
            outside = [rng.uniform(0.1, 1, x.numel()) for x in beside]
            at = slope(*rng.uniform(-1, 1, (3, len(self.coordinates))), *outside).full()
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

    def accelerate(self, q: ca.SX, nu: ca.SX, u: ca.SX, X: ca.SX | ca.DM, z: ca.SX | None = None) -> ca.SX:
        """Forward dynamics as an expression; with numbers for X the graph is smaller and faster."""
        M, bias = self.equations(q, nu, X, u, z)
        drive = ca.SX(len(self.coordinates), 1)
        for k, row in enumerate(self.actuated):
            drive[row] = u[k]
        D, L, order = ca.ldl(M)
        return ca.ldl_solve(drive - bias, D, L, order)

    def equations(
        self, q: ca.SX, nu: ca.SX, X: ca.SX | ca.DM, u: ca.SX | None = None, z: ca.SX | None = None
    ) -> tuple[ca.SX, ca.SX]:
        """Mass matrix (n_q, n_q) and bias (n_q,): M a + bias = the torques u that the sensors feel, flaws aside.

        Of effects that answer to torques or remember, u and z are zero where not given.
        """
        p = ca.mtimes(ca.sparsify(ca.DM(self.expand)), X)
        a = ca.SX.sym("a", len(self.coordinates))
        none = (ca.SX.zeros(len(self.inputs)), ca.SX.zeros(len(self.memory)))
        beside = () if self.plain else (none[0] if u is None else u, none[1] if z is None else z)
        return ca.jacobian(self.balance(q, nu, a, p, *beside), a), self.balance(q, nu, 0, p, *beside)

    def beside(self) -> tuple[ca.SX, ...]:
        """Symbols of what functions of a sample take beside q, nu and a: u and z with effects, nothing without."""
        return () if self.plain else (ca.SX.sym("u", len(self.inputs)), ca.SX.sym("z", len(self.memory)))

    def of(self, machine: Machine) -> Model:
        """The same kind of model of a changed machine. Raises MachineError."""
        return build(machine, self.flaws, self.shapes)

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        n = len(self.coordinates)
        return ca.SX.sym("q", n), ca.SX.sym("nu", n), ca.SX.sym("a", n)

    def stacked(self, q: np.ndarray, nu: np.ndarray, a: np.ndarray, *beside: np.ndarray) -> np.ndarray:
        """The regressor of N samples (n_q, N) as (N, n_rows, n_base); with effects also u (n_u, N), z (n_z, N)."""
        n = q.shape[1]
        W: np.ndarray = self.regressor(q, nu, a, *beside).full()
        return W.reshape(W.shape[0], n, len(self.base.names)).transpose(1, 0, 2)

    def base_values(self, standard: Mapping[str, float] | None = None) -> np.ndarray:
        """Base parameter values (n_base,) of standard values by name, the nominal ones where not given."""
        nominal = {n: v for n, (v, _) in standard_parameters(self.machine).items()}
        values = nominal | dict(standard or {})
        X: np.ndarray = self.base.matrix @ np.array([values[n] for n in self.base.standard])
        return X


def build(machine: Machine, flaws: bool = True, shapes: bool = False) -> Model:
    """The equations of a machine, with its base parameters found numerically.

    The amounts of its effects are parameters behind the base parameters; without `flaws` those that no equation of
    motion shows, since they sit in a sensor, are constants; with `shapes` the shapes of effects are parameters as well.
    Raises MachineError if no parameter is left, or for an effect that the machine can't have.
    """
    table = standard_parameters(machine)
    _check_names(machine, tuple(table))
    placed = tuple(place_effect(machine, entry) for entry in machine.effect)
    twice = sorted({e.name for e in placed if [f.name for f in placed].count(e.name) > 1})
    if twice:
        raise MachineError(f"{machine.name}: effect: given twice at one place: {', '.join(twice)}")
    found = equations(machine, tuple(table), ())
    values = np.array([v for v, _ in table.values()])
    units = {s: unit for s, (_, unit) in table.items()}
    base = base_parameters(machine, found.standard_regressor, values, units)
    nominal = base.matrix @ values
    scale = np.array(
        [float(machine.scale[s]) if s in machine.scale else abs(x) for s, x in zip(base.names, nominal, strict=True)]
    )
    for s, x in zip(base.names, scale, strict=True):
        if x == 0:
            raise MachineError(
                f"{machine.name}: scale.{s}: the nominal value is 0, give a scale > 0 in the machine file"
            )
    if placed:
        amounts = _effect_parameters(machine, placed, shapes)
        if not flaws:
            shown = _visible_parameters(equations(machine, (*table, *amounts), placed))
            amounts = {name: amount for name, amount in amounts.items() if name in shown}
        base = _append_parameters(base, amounts)
        nominal = np.concatenate([nominal, [v for v, _, _ in amounts.values()]])
        scale = np.concatenate([scale, [size for _, _, size in amounts.values()]])
        found = equations(machine, base.standard, placed)
    return Model(
        machine,
        machine.coordinates,
        found.inputs,
        tuple(found.slips),
        base,
        nominal,
        scale,
        found.predict,
        found.standard_regressor,
        kinematics(found.sample, found.slips),
        found.nonlinear,
        found.balance,
        _as_base_function(found.flow, base),
        _as_base_function(_with_rate_readings(machine, found), base),
        _as_base_function(found.channels, base),
        found.readable,
        found.memory,
        found.mapped,
        contact_lines(found.sample),
        placed,
        flaws,
        shapes,
    )


@lru_cache(maxsize=8)
def build_cached(machine: str) -> Model:
    """The model of a machine as JSON, built once in a process: CasADi functions are cheaper to build than to send."""
    return build(Machine.model_validate_json(machine))


def _visible_parameters(found: Equations) -> set[str]:
    """Standard parameters that the prediction depends on."""
    columns = found.standard_regressor.sparsity_out(0).get_triplet()[1]
    return {list(found.sample.by_name)[k] for k in set(columns)}


def _effect_parameters(
    machine: Machine, placed: Sequence[PlacedEffect], shapes: bool
) -> dict[str, tuple[float, str, float]]:
    """Value, unit and typical size of every shape and amount that is a parameter, by name: amounts last."""
    found: dict[str, tuple[float, str, float]] = {}
    for e in placed:
        site = Site.of(machine, e.bodies)
        for name, (key, unit) in e.parameters.items():
            if key == "A":
                size = abs(e.effect.amount(site))
            elif shapes and not e.effect.shapes[key].whole:
                shape = e.effect.shapes[key]
                size = 1.0 if shape.signed else max(abs(shape.default * shape.size(site)), abs(e.values[key])) / 4
            else:
                continue
            found[name] = e.values[key], unit, max(size, abs(e.values[key]) if key == "A" else 0.0)
    amounts = {e.name: found.pop(e.name) for e in placed}
    return found | amounts


def _append_parameters(base: BaseParameters, amounts: Mapping[str, tuple[float, str, float]]) -> BaseParameters:
    """Base parameters with amounts behind them, each standing for itself."""
    n, k, m = len(base.names), len(base.standard), len(amounts)
    matrix = np.zeros((n + m, k + m))
    matrix[:n, :k], matrix[n:, k:] = base.matrix, np.eye(m)
    return BaseParameters(
        base.names + tuple(amounts),
        base.units + tuple(unit for _, unit, _ in amounts.values()),
        base.independent + tuple(range(k, k + m)),
        matrix,
        base.invisible,
        base.standard + tuple(amounts),
    )


def _with_rate_readings(machine: Machine, found: Equations) -> ca.Function:
    """What sensors read; of those of a rate, how their angle and what is wrong with it change along the motion."""
    rates = {s.name for s in machine.sensor if s.is_rate}
    if not rates & set(found.readable):
        return found.read
    q, nu, wheels, u, z, p = found.read.sx_in()
    reading = found.read(q, nu, wheels, u, z, p)
    dq, _, rolled, *_ = kinematics(found.sample, found.slips)(q, nu)
    for k, name in enumerate(found.readable):
        if name in rates:
            reading[k] = ca.jtimes(reading[k], ca.vertcat(q, wheels), ca.vertcat(dq, rolled))
    return ca.Function("read", [q, nu, wheels, u, z, p], [reading])


def _as_base_function(function: ca.Function, base: BaseParameters) -> ca.Function:
    """A function whose last argument is standard parameters, of base parameters instead."""
    arguments = function.sx_in()[:-1]
    X = ca.SX.sym("X", len(base.names))
    results = function.call([*arguments, ca.mtimes(ca.sparsify(ca.DM(base.expand)), X)])
    return ca.Function(function.name(), [*arguments, X], results)


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
    visible = np.flatnonzero(size > 1e-12 * size.max())
    kept, left = (visible[k] for k in independent_columns(A[:, visible] / size[visible], 1e-9))
    matrix = np.zeros((len(standard), len(standard)))
    matrix[kept, kept] = 1.0
    for j in left:
        before = kept[kept < j]
        coefficients = np.linalg.lstsq(A[:, before], A[:, j], rcond=None)[0]
        matrix[before, j] = np.where(np.abs(coefficients) < 1e-9, 0.0, np.round(coefficients, 12))
    if not len(kept):
        raise MachineError(
            f"{machine.name}: no parameter can be seen in any motion, check the table and what is locked"
        )
    chosen = matrix[kept]
    names = tuple(
        machine.parameter_names.get(standard[j], standard[j] + ("R" if np.count_nonzero(row) > 1 else ""))
        for j, row in zip(kept, chosen, strict=True)
    )
    twice = sorted({s for s in names if names.count(s) > 1})
    if twice:
        raise MachineError(
            f"{machine.name}: parameter_names: two base parameters get the same name: {', '.join(twice)}"
        )
    return BaseParameters(
        names,
        tuple(units[standard[j]] for j in kept),
        tuple(kept.tolist()),
        chosen,
        tuple(name for j, name in enumerate(standard) if j not in visible),
        standard,
    )
