"""The model of a machine: prediction, base parameters and regressor.

Rows are the equations of motion in the paper's form: an actuated row predicts the measured torque (dynamics + friction
- contact + offset u0), any other row predicts zero; that of a joint with a share of another's torque is first freed of
it (`Machine.row_matrix`). The regressor is the exact Jacobian of that prediction, so the
physics is written once. Effects of the machine file are part of the prediction; their magnitudes are parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from excite.errors import MachineError
from excite.model.base_parameters import BaseParameters, append_parameters, base_parameters
from excite.model.effects import GroundMap, PlacedEffect, Site, place_effect, table_angles
from excite.model.equations import (
    Equations,
    contact_lines,
    edge_slips,
    equations,
    force_directions,
    kinematics,
    signed_balance,
)
from excite.model.known_values import KnownValues, known_values, nothing_known
from excite.model.machine import Body, Machine, Quantity
from excite.model.parameters import encoder_zeros, linear_parameters, standard_parameters
from excite.text import format_number

SCALE_SAMPLES = 400  # random samples from which the default scale is taken; chosen
USUAL_SPEED = 1.0  # rad/s or m/s, of a joint without a limit; chosen
USUAL_FREQUENCY = 3.0  # rad/s, acceleration over speed: half a turn a second; chosen
HIDDEN_SHARE = 1e-6  # of a column beyond the others, over its size, from which motions show it; chosen
MIN_SHOWN_SHARE = 1e-3  # share of the torques (rms) from which a value shows; chosen


@dataclass(frozen=True, eq=False)
class Model:
    """A machine's equations as CasADi functions; build it with `build`.

    A sample is q (n_q,) coordinates [rad, m], the pose on the ground; nu (n_q,) velocities and a (n_q,) their time
    derivatives, those of a planar root in its own axes; u (n_u,) torques delivered by the motors [N m]; z (n_z,) memory
    states of the effects. Functions also take batches (n_q, N). Without effects (`plain`) they take no u and z.

    nominal, scale (n_base,): of the base parameters X; magnitudes of effects come last.
    predict: (q, nu, a, p, u, z) -> Y (n_q,), p the standard parameters; standard_regressor: its Jacobian to p.
    balance: as predict, but the torques delivered, without gain, offset and delay of the torque sensors.
    kinematics: (q, nu) -> dq, slips, wheel rates, and per body position, velocity and angular velocity. Like all
        geometry, these hold at true coordinates: `true_coordinates` takes the encoder zeros off q.
    edge_slips: (q, nu) -> slips g_x, g_y (2, n_places) at `edges`: body and edge "left" or "right" of each contact, or
        "" for a contact that slips alike all over. The resultant is largest there.
    nonlinear: standard parameters in which the prediction is not linear.
    flow: (q, nu, u, z, X) -> dz. It is zero for the last ones of z, `map_inputs`, which `new_ground_map` gives at every
        sample; contact_lines: q -> ground position and width vector of the contacts.
    read: (q, nu, wheels, u, z, X) -> exact readings of the sensors `reading_names`.
    channels: (t, X) -> gain, offset, delay (n_u,) of the torque sensors.
    fit_sensor_effects, fit_shapes: the arguments of `build`.
    known: what the machine file calls known of the base parameters. calibration: the same in SI units of a machine
        whose values are divided by an unknown torque constant (`in_ratios`), which it gives; nothing is `known` then.
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
    edges: tuple[tuple[int, str], ...]
    edge_slips: ca.Function
    nonlinear: tuple[str, ...]
    balance: ca.Function
    flow: ca.Function
    read: ca.Function
    channels: ca.Function
    reading_names: tuple[str, ...]
    memory: tuple[str, ...]
    map_inputs: tuple[str, ...]
    contact_lines: ca.Function
    effects: tuple[PlacedEffect, ...]
    fit_sensor_effects: bool
    fit_shapes: bool
    known: KnownValues
    calibration: KnownValues

    def __repr__(self) -> str:
        return f"<{self.machine.title}: {len(self.base.names)} base parameters, print it for a table>"

    def __str__(self) -> str:
        """Table of the base parameters: name, value of the machine file, unit, and what each stands for."""
        named = zip(self.base.names, self.nominal, self.base.units, strict=True)
        rows = [("parameter", "value", "unit", "stands for")]
        for name, value, unit in named:
            parts = " ".join(f"{factor:+.4g} {part}" for part, factor in self.base.grouping(name).items())
            rows.append((name, format_number(float(value), 4), unit, parts))
        widths = [max(len(row[k]) for row in rows) for k in range(3)]
        lines = [f"{a:<{widths[0]}}  {b:>{widths[1]}}  {c:<{widths[2]}}  {d}" for a, b, c, d in rows]
        return "\n".join([self.machine.title, *lines])

    @property
    def plain(self) -> bool:
        """True if the machine file has no effects."""
        return not self.effects

    @property
    def initial_memory(self) -> np.ndarray:
        """Memory states of the effects at rest, before a log begins (n_z,)."""
        return np.zeros(len(self.memory))

    @cached_property
    def zeros(self) -> np.ndarray:
        """Indices of the encoder zeros that are sought among the base parameters."""
        return np.array([self.base.names.index(name) for name in self.machine.sought_zeros], int)

    def true_coordinates(self, q: np.ndarray, X: np.ndarray) -> np.ndarray:
        """Return coordinates (..., n_q) [rad, m] less the encoder zeros that are sought, as X (n_base,) has them.

        q (..., n_q): coordinates as the encoders read them, or symbols of them.
        """
        return q - self._zero_places @ X if len(self.zeros) else q

    @cached_property
    def _zero_places(self) -> np.ndarray:
        """Matrix (n_q, n_base) that selects the encoder zero of each coordinate."""
        places = np.zeros((len(self.coordinates), len(self.base.names)))
        for k, sensor in zip(self.zeros, self.machine.sought_zeros.values(), strict=True):
            places[self.coordinates.index(self.machine.coordinate(self.machine.find(sensor.body))), k] = 1
        return places

    @cached_property
    def positive(self) -> np.ndarray:
        """Mask (n_base,) of parameters that must be above zero: some magnitudes, and unsigned shapes.

        An amount known to a standard deviation is an error of the file, of either sign.
        """
        errors = {e.label for e in self.machine.effect if not isinstance(e.amount.known, bool)}
        above = {e.name for e in self.effects if e.effect.positive} - errors
        above |= {f"{e.name}.{s}" for e in self.effects for s, shape in e.effect.shapes.items() if not shape.signed}
        return np.array([name in above for name in self.base.names])

    def new_ground_map(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that enters contacts on a new map of the ground, one sample of a motion after another.

        It takes true coordinates (n_q,) and returns the map's inputs (n_contacts MAX_PASSES,).
        """
        contacts = [b.contact for b in self.machine.contacts if b.contact is not None]
        ground = GroundMap([float(c.width) for c in contacts])
        q, lines = np.zeros(len(self.coordinates)), np.zeros((len(contacts), 4))
        buffered = self.contact_lines.buffer()
        buffered[0].set_arg(0, q.data)
        buffered[0].set_res(0, lines.data)

        def enter(to: np.ndarray) -> np.ndarray:
            q[:] = to
            buffered[1]()  # through the pair: the buffer must outlive the call
            return ground.update(lines)

        return enter

    @property
    def n_dynamic_memory(self) -> int:
        """Number of memory states that have a rate: those before `map_inputs`."""
        return len(self.memory) - len(self.map_inputs)

    @property
    def initial_memory_std(self) -> np.ndarray:
        """Standard deviation of `initial_memory` at the start of a log (n_dynamic_memory,)."""
        own = [m.initial_std for e in self.effects for _, m in e.memory.values()]
        return np.array([1e-6] * ("time" in self.memory) + own)

    @property
    def fully_driven(self) -> bool:
        """True if each joint is driven and none touches the ground: any smooth motion of the joints is possible."""
        return len(self.actuated) == len(self.coordinates) and not self.machine.contacts

    @cached_property
    def follows_positions(self) -> bool:
        """True for an arm: fully driven, with forces that depend on positions.

        Torques alone do not keep such a machine on its path. Its drives are motions that position controllers follow.
        """
        return self.fully_driven and bool(self.active_coordinates)

    @cached_property
    def actuated(self) -> tuple[int, ...]:
        """Indices of the actuated coordinates, one per input."""
        return tuple(self.coordinates.index(self.machine.coordinate(b)) for b in self.machine.actuated)

    @cached_property
    def rubbing(self) -> tuple[int, ...]:
        """Indices of the coordinates whose joints have dry friction, in the order of `Machine.rubbing`."""
        return tuple(self.coordinates.index(b.coordinates[0]) for b in self.machine.rubbing)

    @cached_property
    def signed_balance(self) -> ca.Function:
        """(q, nu, a, p, u, z, sign) -> Y (n_q,): `balance` with sgn (n_rubbing,) of the joints' rates given."""
        return signed_balance(self.machine, self.base.standard, self.effects)

    @cached_property
    def force_directions(self) -> tuple[tuple[tuple[int, str], ...], ca.Function]:
        """Names (body, kind) of forces that the soil may add to its law, and (q, p) -> unit forces (n_q, n_forces)."""
        return force_directions(self.machine, self.base.standard)

    @property
    def expand(self) -> np.ndarray:
        """The base parameters' `expand` (n_standard, n_base)."""
        return self.base.expand

    @cached_property
    def offsets(self) -> np.ndarray:
        """Matrix (n_u, n_base) that selects the torque offsets u0 [N m, N] from the base parameters X."""
        return self.expand[[self.base.standard.index(f"u{b.index}0") for b in self.machine.actuated]]

    @cached_property
    def regressor(self) -> ca.Function:
        """(q, nu, a) -> W (n_rows, n_base), the exact Jacobian of the prediction: Y = W X.

        With effects u and z are further arguments. A batch of N samples gives (n_rows, n_base N), sample after sample.
        """
        q, nu, a = self.symbols()
        beside = self.effect_symbols()
        W = self.standard_regressor(q, nu, a, ca.DM(self.expand @ self.nominal), *beside)
        names = ["q", "nu", "a", "u", "z"][: 3 + len(beside)]
        return ca.Function(
            "regressor", [q, nu, a, *beside], [ca.mtimes(W, ca.sparsify(ca.DM(self.expand)))], names, ["W"]
        )

    @cached_property
    def acceleration(self) -> ca.Function:
        """(q, nu, u, z, X) -> a: forward dynamics, the mass matrix solved by LDL'. A plain model takes no z."""
        q, nu, _ = self.symbols()
        u, X = ca.SX.sym("u", len(self.inputs)), ca.SX.sym("X", len(self.base.names))
        z = () if self.plain else (ca.SX.sym("z", len(self.memory)),)
        names = ["q", "nu", "u", *["z" for _ in z], "X"]
        return ca.Function("acceleration", [q, nu, u, *z, X], [self.accelerate(q, nu, u, X, *z)], names, ["a"])

    @cached_property
    def active_coordinates(self) -> tuple[str, ...]:
        """Coordinates that the equations depend on, found numerically.

        The expressions do not show it: a balanced wheel's angle drops out only because cos^2 + sin^2 = 1.
        """
        q, nu, a = self.symbols()
        own = {name for e in self.effects for name in e.parameters}
        absent = np.array([n in own for n in self.base.names]) & (self.nominal == 0)  # an effect that may yet be there
        p = ca.DM(self.expand @ np.where(absent, self.scale, self.nominal))
        beside = self.effect_symbols()
        slope = ca.Function("slope", [q, nu, a, *beside], [ca.jacobian(self.predict(q, nu, a, p, *beside), q)])
        rng = np.random.default_rng(0)
        change = np.zeros(len(self.coordinates))
        tables = [x for e in self.effects for x in table_angles(self.machine, e)]  # flat beyond their nodes
        for shift in (*[0.0] * 5, *tables):
            outside = [rng.uniform(0.1, 1, x.numel()) for x in beside]
            q_here, nu_here, a_here = rng.uniform(-1, 1, (3, len(self.coordinates)))
            at = slope(shift or q_here, nu_here, a_here, *outside).full()
            change = np.maximum(change, np.abs(at).max(axis=0))
        floor = 1e-9 * float(np.abs(self.nominal).max())
        return tuple(c for c, size in zip(self.coordinates, change, strict=True) if size > floor)

    @cached_property
    def mass_matrix(self) -> ca.Function:
        """(q, X) -> mass matrix (n_q, n_q)."""
        q, nu, _ = self.symbols()
        X = ca.SX.sym("X", len(self.base.names))
        return ca.Function("mass_matrix", [q, X], [self.equations(q, nu, X)[0]], ["q", "X"], ["M"])

    @cached_property
    def pivots(self) -> ca.Function:
        """(q, X) -> pivots of the mass matrix (n_q,), all > 0 exactly if it is positive definite."""
        q, nu, _ = self.symbols()
        X = ca.SX.sym("X", len(self.base.names))
        D, _, _ = ca.ldl(self.equations(q, nu, X)[0])
        return ca.Function("pivots", [q, X], [D], ["q", "X"], ["D"])

    def accelerate(
        self,
        q: ca.SX,
        nu: ca.SX,
        u: ca.SX,
        X: ca.SX | ca.DM,
        z: ca.SX | None = None,
        sign: ca.SX | None = None,
        slips: ca.SX | None = None,
    ) -> ca.SX:
        """Return the acceleration as an expression; numbers for X make the graph smaller and faster.

        sign (n_rubbing,): as in `equations`. slips (n_rubbing,): 0 for joints held at rest, 1 for all others.
        """
        M, bias = self.equations(q, nu, X, u, z, sign)
        force = self.joint_torques(u) - bias
        if slips is not None:
            free = ca.SX.ones(len(self.coordinates))
            for k, row in enumerate(self.rubbing):
                free[row] = slips[k]
            M, force = M * (free @ free.T) + ca.diag(1 - free), force * free
        D, L, order = ca.ldl(M)
        return ca.ldl_solve(force, D, L, order)

    def joint_torques(self, u: ca.SX) -> ca.SX:
        """Return the torques (n_q,) on the coordinates from those of the drives u (n_u,) [N m]."""
        return ca.sparsify(ca.DM(self.machine.input_matrix)) @ u

    def equations(
        self,
        q: ca.SX,
        nu: ca.SX,
        X: ca.SX | ca.DM,
        u: ca.SX | None = None,
        z: ca.SX | None = None,
        sign: ca.SX | None = None,
    ) -> tuple[ca.SX, ca.SX]:
        """Return mass matrix (n_q, n_q) and bias (n_q,): M a + bias = `joint_torques` of the delivered [N m].

        u and z matter to effects only; they are zero by default. sign (n_rubbing,): sgn of the joints' rates in dry
        friction, smoothed by default.
        """
        p = ca.mtimes(ca.sparsify(ca.DM(self.expand)), X)
        a = ca.SX.sym("a", len(self.coordinates))
        none = (ca.SX.zeros(len(self.inputs)), ca.SX.zeros(len(self.memory)))
        beside = () if self.plain else (none[0] if u is None else u, none[1] if z is None else z)
        balance = self.balance
        if sign is not None:
            balance, beside = self.signed_balance, (*beside, sign)
        return ca.jacobian(balance(q, nu, a, p, *beside), a), balance(q, nu, 0, p, *beside)

    def effect_symbols(self) -> tuple[ca.SX, ...]:
        """Return symbols of the further arguments (u, z) of a model with effects, () of a plain one."""
        return () if self.plain else (ca.SX.sym("u", len(self.inputs)), ca.SX.sym("z", len(self.memory)))

    @property
    def heading(self) -> int | None:
        """Place of the chassis' heading among the coordinates, None if it is none of them."""
        root = self.machine.body[0].coordinates
        return self.coordinates.index(root[2]) if self.machine.planar and root[2] in self.coordinates else None

    def for_machine(self, machine: Machine) -> Model:
        """Build the model of a changed machine with the same options. Raises MachineError."""
        return build(machine, self.fit_sensor_effects, self.fit_shapes)

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return symbols of coordinates, velocities and accelerations, (n_q,) each."""
        n = len(self.coordinates)
        return ca.SX.sym("q", n), ca.SX.sym("nu", n), ca.SX.sym("a", n)

    def stacked_regressor(self, q: np.ndarray, nu: np.ndarray, a: np.ndarray, *beside: np.ndarray) -> np.ndarray:
        """Return the regressor (N, n_rows, n_base) of N samples: q, nu, a (n_q, N); with effects also u, z."""
        n = q.shape[1]
        W: np.ndarray = self.regressor(q, nu, a, *beside).full()
        return W.reshape(W.shape[0], n, len(self.base.names)).transpose(1, 0, 2)

    def base_values(self, standard: Mapping[str, float] | None = None) -> np.ndarray:
        """Return base parameter values (n_base,) from standard values by name, nominal by default."""
        nominal = {n: v for n, (v, _) in standard_parameters(self.machine).items()}
        values = nominal | dict(standard or {})
        X: np.ndarray = self.base.matrix @ np.array([values[n] for n in self.base.standard])
        return X


def build(machine: Machine, fit_sensor_effects: bool = True, fit_shapes: bool = False) -> Model:
    """Build the model of a machine, its base parameters found numerically.

    Magnitudes of the machine's effects are parameters behind the base parameters.
    fit_sensor_effects: False makes constants of magnitudes that only sensors show, no equation of motion.
    fit_shapes: shapes of effects are parameters, too.
    Raises MachineError if no parameter is left, or for an effect that the machine can't have.
    """
    table = linear_parameters(machine)
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
    stated = np.array([float(machine.scale[s]) if s in machine.scale else np.nan for s in base.names])
    scale = np.where(np.isnan(stated), _default_scale(machine, found, base, nominal, ~np.isnan(stated)), stated)
    known = known_values(machine, base.names, base.matrix, base.standard, nominal, scale)
    calibration = nothing_known(len(base.names))
    if machine.in_ratios:
        known, calibration = calibration, known
    plain, zeros = found, encoder_zeros(machine)
    if placed or zeros:
        magnitudes = _effect_parameters(machine, placed, fit_shapes)
        if not fit_sensor_effects:
            shown = _visible_parameters(equations(machine, (*table, *zeros, *magnitudes), placed))
            magnitudes = {name: row for name, row in magnitudes.items() if name in shown}
        added = zeros | magnitudes
        base = append_parameters(base, added)
        known = known.extended(len(added)).with_zeros(machine, base.names).with_amounts(machine, base.names)
        calibration = calibration.extended(len(added))
        nominal = np.concatenate([nominal, [v for v, _, _ in added.values()]])
        sizes = {e.label: float(e.amount.known) for e in machine.effect if not isinstance(e.amount.known, bool)}
        sizes = {n: sizes.get(n, float(machine.scale.get(n, size))) for n, (_, _, size) in added.items()}
        scale = np.concatenate([scale, list(sizes.values())])
        found = equations(machine, base.standard, placed)
    motion = kinematics(plain.sample, plain.slips)
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
        motion,
        *edge_slips(plain.sample),
        found.nonlinear,
        found.balance,
        _as_base_function(found.flow, base),
        _as_base_function(_with_rate_readings(machine, found, motion), base),
        _as_base_function(found.channels, base),
        found.reading_names,
        found.memory,
        found.map_inputs,
        contact_lines(plain.sample),
        placed,
        fit_sensor_effects,
        fit_shapes,
        known,
        calibration,
    )


def _default_scale(
    machine: Machine, found: Equations, base: BaseParameters, nominal: np.ndarray, stated: np.ndarray
) -> np.ndarray:
    """Return the scale (n_base,) of parameters without a stated one: |nominal|, if motions show that value.

    Otherwise a relative error would mean nothing, and the scale is what moves the torques as much as the median
    parameter does: median(|nominal| column) / column, in root mean squares of the columns of W over random motions
    within the limits. It is then that of all parameters, unless contacts dominate random motions: then of nominal
    zeros. stated (n_base,): parameters that do not matter here.
    """
    n, rng = len(machine.coordinates), np.random.default_rng(0)
    owner = {c: b for b in machine.body for c in b.coordinates}
    low, high, speed = np.array([_usual_range(owner[c]) for c in machine.coordinates]).T
    q = rng.uniform(low, high, (SCALE_SAMPLES, n)).T
    nu = rng.uniform(-speed, speed, (SCALE_SAMPLES, n)).T
    a = USUAL_FREQUENCY * rng.uniform(-speed, speed, (SCALE_SAMPLES, n)).T
    W = found.standard_regressor(q, nu, a, base.expand @ nominal).full()
    W = W.reshape(n, SCALE_SAMPLES, -1).transpose(1, 0, 2).reshape(n * SCALE_SAMPLES, -1) @ base.expand
    columns = np.sqrt(np.mean(W**2, axis=0))
    share = np.abs(nominal) * columns
    typical = (float(np.median(share[share > 0])) if share.any() else 1.0) / columns
    if machine.contacts:
        return np.where(nominal == 0, typical, np.abs(nominal))
    shown = share > MIN_SHOWN_SHARE * np.sqrt(np.mean((W @ nominal) ** 2))
    return np.abs(nominal) if (shown | stated).all() else typical


def _usual_range(body: Body) -> tuple[float, float, float]:
    """Return lowest and highest position and the top speed of a body's coordinates, usual ones without a limit."""
    speed = body.limit.rate or USUAL_SPEED
    if body.limit.rim_speed is not None and body.contact is not None:
        speed = float(body.limit.rim_speed) / float(body.contact.radius)
    return *(body.limit.position_range or (-1.0, 1.0)), float(speed)


def with_least_smoothing(model: Model, least: Mapping[int, float]) -> Model:
    """Return the model with dry friction of each joint that turns over `least` [rad/s, m/s] at the fastest.

    least: by the index of the joint's body.
    """
    bodies = tuple(
        b
        if b.friction is None or float(b.friction.smoothing) >= least.get(b.index, 0.0)
        else b.model_copy(
            update={
                "friction": b.friction.model_copy(
                    update={"smoothing": Quantity(value=least[b.index], source="definition")}
                )
            }
        )
        for b in model.machine.body
    )
    if bodies == model.machine.body:
        return model
    smooth = build(model.machine.model_copy(update={"body": bodies}), model.fit_sensor_effects, model.fit_shapes)
    return replace(smooth, nominal=model.nominal, scale=model.scale, known=model.known)


@lru_cache(maxsize=8)
def build_cached(machine: str) -> Model:
    """Build the model of a machine given as JSON, once per process: building costs less than sending functions."""
    return build(Machine.model_validate_json(machine))


def _visible_parameters(found: Equations) -> set[str]:
    """Return the standard parameters that the prediction depends on."""
    columns = found.standard_regressor.sparsity_out(0).get_triplet()[1]
    return {list(found.sample.by_name)[k] for k in set(columns)}


def _effect_parameters(
    machine: Machine, placed: Sequence[PlacedEffect], fit_shapes: bool
) -> dict[str, tuple[float, str, float]]:
    """Return value, unit and typical size of every shape and magnitude that is a parameter; magnitudes last."""
    found: dict[str, tuple[float, str, float]] = {}
    for e in placed:
        site = Site.of(machine, e.bodies)
        for name, (key, unit) in e.parameters.items():
            if key == "A":
                size = abs(e.effect.typical_magnitude(site))
            elif fit_shapes and not e.effect.shapes[key].whole:
                shape = e.effect.shapes[key]
                size = 1.0 if shape.signed else max(abs(shape.default * shape.size(site)), abs(e.values[key])) / 4
            else:
                continue
            found[name] = e.values[key], unit, max(size, abs(e.values[key]) if key == "A" else 0.0)
    magnitudes = {e.name: found.pop(e.name) for e in placed}
    return found | magnitudes


def hidden_zeros(model: Model, by_known: bool = True) -> dict[str, tuple[str, ...]]:
    """Find the encoder zeros that are sought though no motion shows them, at the nominal values.

    by_known: what the machine file calls known counts, too. Returns by name the parameters that show only together with
    it, none for a zero that changes no torque.
    """
    if not len(model.zeros):
        return {}
    rng, names, n = np.random.default_rng(0), model.base.names, len(model.coordinates)
    beside = [rng.uniform(-1, 1, (x.numel(), SCALE_SAMPLES)) for x in model.effect_symbols()]
    W = model.stacked_regressor(*rng.uniform(-1, 1, (3, n, SCALE_SAMPLES)), *beside).reshape(-1, len(names))
    moves = np.linalg.norm(W * model.scale, axis=0)
    every = np.concatenate([W, model.known.rows]) * model.scale if by_known else W * model.scale
    size = np.linalg.norm(every, axis=0)
    found: dict[str, tuple[str, ...]] = {}
    for k in model.zeros:
        if moves[k] <= HIDDEN_SHARE * moves.max():
            found[names[k]] = ()
            continue
        others = [j for j in np.flatnonzero(size > HIDDEN_SHARE * moves.max()) if j != k]
        A, column = every[:, others] / size[others], every[:, k] / size[k]
        share = np.linalg.lstsq(A, column, rcond=1e-12)[0]
        if np.linalg.norm(column - A @ share) < HIDDEN_SHARE:
            found[names[k]] = tuple(names[j] for j, x in zip(others, share, strict=True) if abs(x) > HIDDEN_SHARE)
    return found


def with_given_zeros(model: Model, names: Collection[str]) -> Model:
    """Return the model with encoder zeros that are no longer sought, but those of the machine file."""
    given = {s.name for name, s in model.machine.sought_zeros.items() if name in names}
    scale = {name: x for name, x in model.machine.scale.items() if name not in names}
    sensors = tuple(
        s.model_copy(update={"zero": Quantity(value=s.shift, source="definition")}) if s.name in given else s
        for s in model.machine.sensor
    )
    return model.for_machine(model.machine.model_copy(update={"sensor": sensors, "scale": scale})) if given else model


def _with_rate_readings(machine: Machine, found: Equations, motion: ca.Function) -> ca.Function:
    """Return the readings; a rate sensor reads the time derivative of its angle and of the angle's error."""
    rates = {s.name for s in machine.sensor if s.is_rate}
    if not rates & set(found.reading_names):
        return found.read
    q, nu, wheels, u, z, p = found.read.sx_in()
    reading = found.read(q, nu, wheels, u, z, p)
    dq, _, rolled, *_ = motion(q, nu)
    for k, name in enumerate(found.reading_names):
        if name in rates:
            reading[k] = ca.jtimes(reading[k], ca.vertcat(q, wheels), ca.vertcat(dq, rolled))
    return ca.Function("read", [q, nu, wheels, u, z, p], [reading])


def _as_base_function(function: ca.Function, base: BaseParameters) -> ca.Function:
    """Turn a function of standard parameters (its last argument) into one of base parameters."""
    arguments = function.sx_in()[:-1]
    X = ca.SX.sym("X", len(base.names))
    results = function.call([*arguments, ca.mtimes(ca.sparsify(ca.DM(base.expand)), X)])
    return ca.Function(function.name(), [*arguments, X], results)


def _check_names(machine: Machine, standard: tuple[str, ...]) -> None:
    """Raise MachineError for names of parameters or scales that don't exist: a misspelt one would change nothing."""
    for name in machine.parameter_names:
        if name not in standard:
            raise MachineError(
                f"{machine.name}: parameter_names.{name}: no such parameter, allowed: {', '.join(standard)}"
            )
    groups = {s + "R" for s in standard} | set(machine.parameter_names.values())
    for name in machine.scale:
        if name not in standard and name not in groups and name not in machine.sought_zeros:
            raise MachineError(
                f"{machine.name}: scale.{name}: no such parameter, allowed: {', '.join(standard)}, with R for a group"
            )
