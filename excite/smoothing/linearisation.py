"""State space of a machine and its sensors: rates of its states and readings, with their derivatives.

All samples of a log are evaluated in batches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import casadi as ca
import numpy as np
import scipy.special

from excite.model import Model
from excite.model.machine import Sensor
from excite.simulation import Motion, delivered_torques, smooth_part

POSE_STD = (1e3, 1e3, 10.0)  # of a pose at the start of a log, of which nothing is known [m, m, rad]; chosen
BATCH_SIZE = 1000  # samples whose intermediate results stay in the processor's cache; measured
MIN_BLOCK_SAMPLES = 80  # from this many samples on, the evaluation by numpy is faster; measured
CASADI_SAMPLES = 20  # in one call of CasADi for fewer samples; measured


class BatchedFunction:
    """A CasADi function evaluated on N samples at once.

    Arguments are (N, size) arrays, or (size,) for the inputs with index in `shared`; results are (N, rows, columns).
    Large batches run instruction by instruction on blocks of samples in numpy, five to ten times faster than CasADi's
    own loop over samples. The rest goes to CasADi.
    """

    def __init__(self, function: ca.Function, shared: Sequence[int] = ()) -> None:
        outputs = [ca.densify(e) for e in function.call(function.sx_in())]
        self.function = ca.Function(function.name(), function.sx_in(), outputs, {"cse": True})
        self.shared = tuple(shared)
        self.shapes = [self.function.size_out(k) for k in range(self.function.n_out())]
        self.few = self.function.map(function.name(), "serial", CASADI_SAMPLES, list(self.shared), [])
        self.block: _BlockEvaluator | None = None

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        N = next(len(a) for k, a in enumerate(arguments) if k not in self.shared)
        results = [np.empty((N, columns, rows)) for rows, columns in self.shapes]
        inputs = [np.ascontiguousarray(a, float) for a in arguments]
        done = 0
        while done < N:
            if N - done < MIN_BLOCK_SAMPLES:
                count = min(CASADI_SAMPLES, N - done)
                self._evaluate_few(inputs, results, done, count)
            else:
                self.block = self.block or _BlockEvaluator(self.function, self.shared)
                count = min(BATCH_SIZE, N - done)
                self.block(inputs, results, done, count)
            done += count
        return [r.transpose(0, 2, 1) for r in results]

    def _evaluate_few(self, inputs: list[np.ndarray], results: list[np.ndarray], at: int, count: int) -> None:
        """Evaluate samples at .. at + count in one call of CasADi, padded with the last sample."""
        buffer, evaluate = self.few.buffer()
        keep = []
        for k, a in enumerate(inputs):
            if k not in self.shared:
                a = a[at : at + count]
                if count < CASADI_SAMPLES:
                    a = np.concatenate([a, np.repeat(a[-1:], CASADI_SAMPLES - count, axis=0)])
            keep.append(a)
            buffer.set_arg(k, _as_memoryview(a))
        whole = [
            r[at : at + count] if count == CASADI_SAMPLES else np.empty((CASADI_SAMPLES, *r.shape[1:])) for r in results
        ]
        for k, r in enumerate(whole):
            if r.size:
                buffer.set_res(k, _as_memoryview(r))
        evaluate()
        if count < CASADI_SAMPLES:
            for r, w in zip(results, whole, strict=True):
                r[at : at + count] = w[:count]


class _BlockEvaluator:
    """Instructions of a CasADi function, each run on BATCH_SIZE samples; a register is a row of samples.

    Inputs and constants are read in place and outputs are computed in place, as copying a row costs half as much as
    multiplying two.
    """

    def __init__(self, function: ca.Function, shared: tuple[int, ...]) -> None:
        registers = np.zeros((function.sz_w(), BATCH_SIZE))
        sample_shapes = [() if k in shared else (BATCH_SIZE,) for k in range(function.n_in())]
        self.inputs = [np.zeros((function.nnz_in(k), *size)) for k, size in enumerate(sample_shapes)]
        self.outputs = [np.zeros((function.nnz_out(k), BATCH_SIZE)) for k in range(function.n_out())]
        self.shared = shared
        self.calls: list[tuple[Callable[..., object], tuple[np.ndarray, ...]]] = []
        direct_outputs, output_rows = _output_instructions(function), [list(rows) for rows in self.outputs]
        location: dict[int, np.ndarray] = {}  # array that holds the value of each of CasADi's registers
        constant: set[int] = set()  # registers that hold a constant
        for k in range(function.n_instructions()):
            code, target, source = (
                function.instruction_id(k),
                function.instruction_output(k),
                function.instruction_input(k),
            )
            if code != ca.OP_OUTPUT:
                (constant.add if code == ca.OP_CONST else constant.discard)(target[0])
            if code == ca.OP_INPUT:
                location[target[0]] = self.inputs[source[0]][source[1], ...]
            elif code == ca.OP_CONST:
                location[target[0]] = np.array(function.instruction_constant(k))
            elif code == ca.OP_OUTPUT:
                row = output_rows[target[0]][target[1]]
                if source[0] in constant:
                    row[:] = location[source[0]]
                elif location[source[0]] is not row:
                    self.calls.append((np.positive, (location[source[0]], row)))
            else:
                call = np.add if code == ca.OP_TWICE else _OPERATIONS[code]
                given = tuple(location[i] for i in (source[:1] * 2 if code == ca.OP_TWICE else source[: call.nin]))
                output = direct_outputs.get(k)
                location[target[0]] = registers[target[0]] if output is None else output_rows[output[0]][output[1]]
                if call in (np.maximum, np.minimum):  # numpy takes their output by keyword only
                    self.calls.append((partial(call, *given, out=location[target[0]]), ()))
                else:
                    self.calls.append((call, (*given, location[target[0]])))

    def __call__(self, inputs: list[np.ndarray], results: list[np.ndarray], at: int, count: int) -> None:
        for k, (a, own) in enumerate(zip(inputs, self.inputs, strict=True)):
            if k in self.shared:
                own[:] = a
            else:
                own[:, :count] = a[at : at + count].T
                own[:, count:] = own[:, count - 1 : count]
        with np.errstate(all="ignore"):
            for call, rows in self.calls:
                call(*rows)
        for r, of in zip(results, self.outputs, strict=True):
            r[at : at + count] = of[:, :count].T.reshape(count, *r.shape[1:])


def _output_instructions(function: ca.Function) -> dict[int, tuple[int, int]]:
    """Map instructions whose result is an output to the (index, element) of the first such output."""
    last: dict[int, int] = {}  # instruction that wrote each register last
    outputs: dict[int, tuple[int, int]] = {}
    for k in range(function.n_instructions()):
        target = function.instruction_output(k)
        if function.instruction_id(k) == ca.OP_OUTPUT:
            outputs.setdefault(last[function.instruction_input(k)[0]], (target[0], target[1]))
        else:
            last[target[0]] = k
    return outputs


_OPERATIONS: dict[int, np.ufunc] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_INV: np.reciprocal,
    ca.OP_SQ: np.square,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_EXP: np.exp,
    ca.OP_EXPM1: np.expm1,
    ca.OP_LOG: np.log,
    ca.OP_LOG1P: np.log1p,
    ca.OP_ERF: scipy.special.erf,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_FABS: np.abs,
    ca.OP_SIGN: np.sign,
    ca.OP_FMOD: np.fmod,
    ca.OP_HYPOT: np.hypot,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_FMAX: np.maximum,
    ca.OP_FMIN: np.minimum,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_NOT: np.logical_not,
    ca.OP_IF_ELSE_ZERO: np.multiply,
}


def _as_memoryview(a: np.ndarray) -> memoryview:
    return a.reshape(-1).data


@dataclass(frozen=True, eq=False)
class StateSpace:
    """States of a machine that its forces and a set of sensors depend on, with their dynamics and readings.

    sensors: those with a reading h(s), in order.
    forces: inputs beside the torques (see `unknown_inputs`).
    core: number of leading states on which forces depend (coordinates, velocities, memory of effects). Measured angles
        that are integrals of these follow.
    index (n,): places of the states in the simulator's state (q, nu, wheels, z) of size full_size.
    angle_state: for each sensor the state that its encoder reads, -1 for other sensors.
    torque_offsets (n_u, n_base): selects the torque offsets u0 from X.
    forced_rows: rows without an actuator, or all if there are none, on which forces of effects act.
    reading_parameters: parameters that readings depend on directly.
    initial_std (n,): standard deviation of states whose start is known, NaN for the others.
    readings_use_torque: whether readings depend on the torque at the same sample.
    jacobians, readings, rates, slopes: batched functions of (state, inputs, X). pivots: of (state, X). channels: of
        (time, X). features: of the state, what a force that the model lacks may follow, with its slopes. Inputs from a
        map of the ground are no states and stand beside the torques (`inputs`).
    """

    model: Model
    sensors: tuple[Sensor, ...]
    forces: tuple[tuple[int, str], ...]
    core: int
    index: np.ndarray
    full_size: int
    angle_state: tuple[int, ...]
    torque_offsets: np.ndarray
    forced_rows: tuple[int, ...]
    reading_parameters: tuple[int, ...]
    initial_std: np.ndarray
    readings_use_torque: bool
    jacobians: BatchedFunction
    readings: BatchedFunction
    rates: BatchedFunction
    slopes: BatchedFunction
    pivots: BatchedFunction
    channels: BatchedFunction
    features: BatchedFunction

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.index)

    @cached_property
    def soil(self) -> np.ndarray:
        """Matrix (n_stiffness, n_base) that gives the stiffnesses Kx, Ky of the contacts, which are below zero."""
        base, bodies = self.model.base, [b.index for b in self.model.machine.contacts]
        names = [f"K{axis}{k}" for k in bodies for axis in "xy" if f"K{axis}{k}" in base.standard]
        return self.model.expand[[base.standard.index(n) for n in names]].reshape(-1, len(base.names))

    @property
    def n_inputs(self) -> int:
        """Number of inputs: torques, those from a map of the ground, forces."""
        return len(self.model.inputs) + len(self.model.map_inputs) + len(self.forces)

    @property
    def input_columns(self) -> np.ndarray:
        """Indices of torques and forces among the inputs."""
        return np.delete(np.arange(self.n_inputs), slice(len(self.model.inputs), self.n_inputs - len(self.forces)))

    def unpack(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split states (N, n) into coordinates, velocities (N, n_q) and memory (N, n_z).

        Coordinates that nothing depends on are zero, and so are inputs from a map of the ground.
        """
        n_q, n_z = len(self.model.coordinates), len(self.model.memory)
        full = np.zeros((len(s), self.full_size))
        full[:, self.index] = s
        return full[:, :n_q], full[:, n_q : 2 * n_q], full[:, self.full_size - n_z :]

    def from_full_state(self, full: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the simulator's states (N, full_size) into states (N, n) and inputs from a map of the ground (N,
        n_ground)."""
        return full[:, self.index], full[:, self.full_size - len(self.model.map_inputs) :]

    def from_motion(self, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Return the states (N, n) and inputs from a map of the ground (N, n_ground) of a simulated motion."""
        return self.from_full_state(np.hstack([motion.q, motion.nu, motion.wheels, motion.memory]))

    def inputs(self, torque: np.ndarray, ground: np.ndarray, force: np.ndarray | None = None) -> np.ndarray:
        """Join torques (N, n_u), inputs from a map of the ground (N, n_ground) and forces (N, n_forces), 0 if None."""
        if force is None:
            force = np.zeros((len(torque), len(self.forces)))
        return np.concatenate([torque, ground, force], axis=1) if self.model.map_inputs or self.forces else torque

    def delivered_torques(
        self, torque: np.ndarray, X: np.ndarray, torque_error: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the delivered torques (N, n_u) [N m] from measured ones, and the slopes by X of their means over each
        interval (N - 1, n_u, n_base).

        torque_error (N - 1, n_u) [N m]: known errors of the torques in each interval. Slopes by a gain or a delay use
        the corrected torques, as slopes from noisy ones would follow the noise and bias the estimate.
        """
        if not any(e.effect.channel for e in self.model.effects):
            slope = np.broadcast_to(-self.torque_offsets, (len(torque) - 1, *self.torque_offsets.shape))
            return torque - X @ self.torque_offsets.T, slope
        step = 1 / float(self.model.machine.sampling_hz)
        t = np.arange(len(torque)) * step
        *channels, by_gain, by_offset, by_delay = self.channels(t[:, None], X)
        gain, offset, delay = (e[:, :, 0] for e in channels)
        u = delivered_torques(t, torque, (gain.T, offset.T, delay.T))
        error = np.zeros((len(t) - 1, u.shape[1])) if torque_error is None else torque_error
        corrected = u + np.concatenate([error, error[-1:]])
        rise = np.gradient(smooth_part(gain * corrected + offset), step, axis=0)
        behind = rise[:, :, None] * by_delay - by_offset - u[:, :, None] * by_gain
        behind = (behind[:-1] + behind[1:]) / 2 - error[:, :, None] * by_gain[:-1]
        return u, behind / gain[:-1, :, None]

    def delivered_noise(self, noise: np.ndarray, X: np.ndarray) -> np.ndarray:
        """Convert the noise of the torque sensors (n_u,) to noise of the delivered torques [N m]."""
        if not any(e.effect.channel for e in self.model.effects):
            return noise
        gain: np.ndarray = self.model.channels(0.0, X)[0].full()[:, 0]
        return noise / np.abs(gain)


@lru_cache(maxsize=16)
def build_state_space(model: Model, names: tuple[str, ...], forces: bool = False) -> StateSpace:
    """Build the state space of a model and the sensors with these names.

    Torque sensors are left out. The pose on the ground is a state if a sensor reads it. forces: whether the forces that
    the soil may add to its law, and a slope of the ground, are inputs.
    """
    machine = model.machine
    n_q, n_u = len(model.coordinates), len(model.inputs)
    q, nu, _ = model.symbols()
    u, X = ca.SX.sym("u", n_u), ca.SX.sym("X", len(model.base.names))
    z = ca.SX.sym("z", len(model.memory))
    dq, _, wheel_rates, *_ = model.kinematics(q, nu)
    wheel_names = [s.name for s in machine.sensor if s.kind == "wheel"]
    wheels = ca.SX.sym("w", len(wheel_names))
    full = ca.vertcat(q, nu, wheels, z)

    M, bias = model.equations(q, nu, X, u, z)
    forced_rows = tuple(k for k in range(n_q) if k not in model.actuated) or tuple(range(n_q))
    added = unknown_inputs(model) if forces else ()
    extra = ca.SX.sym("f", len(added))
    load = model.joint_torques(u)
    if added:
        load += _unknown_load(model, q, M, X, added) @ extra
    factors = ca.ldl(M)
    a = ca.ldl_solve(load - bias, *factors)
    flow = model.flow(q, nu, u, z, X)
    rates = ca.vertcat(dq, a, wheel_rates, flow)
    sensors = tuple(s for s in machine.sensors("full") if s.name in names and s.kind != "torque")
    pose = machine.body[0].coordinates if any(s.kind in ("x", "y") for s in sensors) else ()
    active = {*model.active_coordinates, *pose[2:]}
    core = [k for k, c in enumerate(model.coordinates) if c in active] + list(range(n_q, 2 * n_q))
    ground = ca.SX.sym("over", len(model.map_inputs))
    last = full.numel() - len(model.map_inputs)
    core += range(full.numel() - len(model.memory), last)

    index, angle, ratios = list(core), list[int](), list[float]()
    for s in sensors:
        ratios.append(machine.ratio(machine.find(s.body)))
        if s.kind in ("angle", "wheel") and not s.is_rate:
            at = (
                model.coordinates.index(machine.coordinate(machine.find(s.body)))
                if s.kind == "angle"
                else 2 * n_q + wheel_names.index(s.name)
            )
            if at not in index:
                index.append(at)
            angle.append(index.index(at))
        else:
            angle.append(-1)
    index += [at for at, c in enumerate(model.coordinates) if c in pose and at not in index]
    state = ca.SX.sym("s", len(index))
    full_values = ca.SX.zeros(full.numel(), 1)
    for k, at in enumerate(index):
        full_values[at] = state[k]
    full_values[last:] = ground
    inputs = ca.vertcat(u, ground, extra)

    def substitute_state(e: ca.SX) -> ca.SX:
        """Write an expression of the full state in the states of this state space."""
        return ca.substitute([e], [full], [full_values])[0]

    def core_jacobian(x: ca.SX) -> ca.SX:
        """Derivatives of the core's rates by x, for velocities from the balance M da = -d(M a + bias)/dx."""
        held = ca.SX.sym("a", n_q)
        balance = ca.jacobian(M @ held + bias - load, x)
        da = -ca.ldl_solve(ca.substitute([balance], [held], [a])[0], *factors)
        return ca.vertcat(ca.jacobian(dq, x), da, ca.jacobian(wheel_rates, x), ca.jacobian(flow, x))[core, :]

    unit_force = ca.SX.eye(n_q)[:, list(forced_rows)]
    jacobians = [
        substitute_state(core_jacobian(full[core])),
        substitute_state(core_jacobian(ca.vertcat(u, extra))),
        substitute_state(core_jacobian(X)),
        substitute_state(
            ca.vertcat(
                ca.SX(n_q, len(forced_rows)),
                ca.ldl_solve(unit_force, *factors),
                ca.SX(full.numel() - 2 * n_q, len(forced_rows)),
            )[core, :]
        ),
        substitute_state(ca.jacobian(rates[index[len(core) :]], full[core])),
    ]
    speed = ca.vertcat(*[c * rates[index[k]] if k >= 0 else ca.SX(0) for k, c in zip(angle, ratios, strict=True)])
    all_readings = model.read(q, nu, wheels, u, z, X)
    reading = ca.vertcat(*[all_readings[model.reading_names.index(s.name)] for s in sensors])
    reading_parameters = tuple(k for k in range(X.numel()) if ca.depends_on(reading, X[k]))
    jacobian_function = ca.Function("slopes", [state, inputs, X], jacobians)
    initial_std = np.full(len(index), np.nan)
    initial_std[len(core) - len(model.initial_memory_std) : len(core)] = model.initial_memory_std
    for c, std in zip(pose, POSE_STD, strict=False):
        if c in model.coordinates:
            initial_std[index.index(model.coordinates.index(c))] = std
    rate_function = ca.Function("rates", [state, inputs, X], [substitute_state(rates[index])])
    slope_function = ca.Function("core_slopes", [state, inputs, X], [jacobians[0]])
    readings = ca.Function(
        "readings",
        [state, inputs, X],
        [
            substitute_state(reading),
            substitute_state(ca.jacobian(reading, full[index])),
            substitute_state(speed),
            substitute_state(ca.jacobian(speed, full[index])),
            *([substitute_state(ca.jacobian(reading, X)[:, list(reading_parameters)])] if reading_parameters else []),
        ],
    )
    seen = substitute_state(_features(model, q, nu))
    t = ca.SX.sym("t")
    channels = model.channels(t, X)
    return StateSpace(
        model,
        sensors,
        added,
        len(core),
        np.array(index),
        full.numel(),
        tuple(angle),
        model.offsets,
        forced_rows,
        reading_parameters,
        initial_std,
        bool(ca.depends_on(reading, u)),
        BatchedFunction(jacobian_function, (2,)),
        BatchedFunction(readings, (2,)),
        BatchedFunction(rate_function, (2,)),
        BatchedFunction(slope_function, (2,)),
        BatchedFunction(ca.Function("pivots", [state, X], [substitute_state(ca.vec(factors[0]))]), (1,)),
        BatchedFunction(ca.Function("channels", [t, X], [*channels, *[ca.jacobian(e, X) for e in channels]]), (1,)),
        BatchedFunction(ca.Function("features", [state], [seen, ca.jacobian(seen, state[: len(core)])])),
    )


def feature_names(model: Model) -> tuple[tuple[str, int], ...]:
    """Name what forces that the model lacks may depend on: "rate" of each driven joint; "gx", "gy", "turn" of contacts.

    With the index of the body. "turn" is the slip at the edge of a contact that its yaw rate makes.
    """
    machine = model.machine
    rates = [("rate", b.index) for b in machine.actuated]
    return (*rates, *((kind, b.index) for b in machine.contacts for kind in ("gx", "gy", "turn")))


def _features(model: Model, q: ca.SX, nu: ca.SX) -> ca.SX:
    """Return the features (n_features,) of `feature_names`; zero where the machine has none of it."""
    q = model.true_coordinates(q, model.nominal)
    slips = model.kinematics(q, nu)[1]
    places = model.edge_slips(q, nu)
    found = {
        ("rate", b.index): nu[model.coordinates.index(model.machine.coordinate(b))] for b in model.machine.actuated
    }
    for b in model.machine.contacts:
        for kind in ("gx", "gy"):
            name = f"{kind}{b.index}"
            found[kind, b.index] = slips[model.slips.index(name)] if name in model.slips else ca.SX(0)
        sides = [model.edges.index((b.index, side)) for side in ("left", "right") if (b.index, side) in model.edges]
        found["turn", b.index] = (places[0, sides[1]] - places[0, sides[0]]) / 2 if len(sides) == 2 else ca.SX(0)
    return ca.vertcat(*[found[n] for n in feature_names(model)], ca.SX(0, 1))


SLOPES = ("slope_x", "slope_y")  # gravity along the root's axes, per unit of its weight [m/s2]


def unknown_inputs(model: Model) -> tuple[tuple[int, str], ...]:
    """Name the forces that act beside the torques: those of each contact, and gravity along the root's axes on a slope.

    A name is a body and a kind of force; of a contact those that move the machine.
    """
    if not model.machine.contacts:
        return ()
    names, directions = model.force_directions
    moves = (
        np.abs(directions(np.linspace(0.1, 0.5, len(model.coordinates)), model.expand @ model.nominal).full()).max(
            axis=0
        )
        > 0
    )
    root = model.machine.body[0]
    slopes = [(root.index, s) for s, c in zip(SLOPES, root.coordinates, strict=False) if c in model.coordinates]
    return (*(n for n, there in zip(names, moves, strict=True) if there), *slopes)


def _unknown_load(model: Model, q: ca.SX, M: ca.SX, X: ca.SX, added: tuple[tuple[int, str], ...]) -> ca.SX:
    """Return the generalised forces (n_q, n_forces) of unit inputs of `unknown_inputs`; M (n_q, n_q): mass matrix."""
    names, directions = model.force_directions
    forces = directions(q, ca.sparsify(ca.DM(model.expand)) @ X)
    columns = []
    for name in added:
        if name[1] in SLOPES:
            columns.append(M[:, model.coordinates.index(model.machine.body[0].coordinates[SLOPES.index(name[1])])])
        else:
            columns.append(forces[:, names.index(name)])
    return ca.horzcat(*columns)
