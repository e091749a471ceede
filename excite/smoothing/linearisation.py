"""State space of a machine and its sensors: transition from sample to sample, and its derivatives.

All samples of a log are evaluated in batches. Transitions use the simulator's own step. Their derivatives weigh
residuals only and need three digits: one step of Radau IIA of order 3 solves the variational equation (Hairer and
Wanner, "Solving Ordinary Differential Equations II", IV.5). The method is L-stable, as a stiff contact at standstill
demands, and exact in the steady state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import casadi as ca
import numpy as np
import scipy.special

from excite.model import Model
from excite.model.machine import Sensor
from excite.simulation import (
    A_ROWS,
    C_ROWS,
    GAMMA,
    STAGE_TIMES,
    TIME_DERIVATIVE_WEIGHTS,
    Motion,
    delivered_torques,
    lu,
    lu_solve,
)

# Error of a speed over one interval [rad/s, m/s], and of an effect's memory relative to its size. The torque noise of
# one sample does far more; chosen.
STEP_TOLERANCE = 1e-5
POSE_STD = (1e3, 1e3, 10.0)  # of a pose at the start of a log, of which nothing is known [m, m, rad]; chosen
BATCH_SIZE = 1000  # samples whose intermediate results stay in the processor's cache; measured
MIN_BLOCK_SAMPLES = 80  # from this many samples on, the evaluation by numpy is faster; measured
CASADI_SAMPLES = 20  # in one call of CasADi for fewer samples; measured
REVERSAL_STEPS = 4  # steps in an interval in which friction changes sign; chosen
ABRUPT_REVERSAL_STEPS = 16  # steps in an interval in which it does so abruptly; chosen
REVERSAL_CHANGE = 0.3  # change of speed over the friction's smoothing speed that asks for finer steps; chosen
REVERSAL_RANGE = 4.0  # distance from zero speed, over the smoothing speed, within which friction varies; from tanh
ABRUPT_CHANGE = 1.5  # the same ratio, from which a reversal is abrupt; chosen
MAX_SPLITS = 6  # halvings of an interval; chosen
# Mean steps for an interval, in logs longer than BATCH_SIZE. Guesses that lead to a fit take up to 8; a motion that
# takes more has diverged.
MAX_MEAN_STEPS = 12


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
    core: number of leading states on which forces depend (coordinates, velocities, memory of effects). Measured angles
        that are integrals of these follow.
    index (n,): places of the states in the simulator's state (q, nu, wheels, z) of size full_size.
    angle_state: for each sensor the state that its encoder reads, -1 for other sensors.
    torque_offsets (n_u, n_base): selects the torque offsets u0 from X.
    forced_rows: rows on which process noise acts, the unactuated ones, or all if there are none.
    forced_inertia: nominal inertia of these rows [kg, kg m2].
    reading_parameters: parameters that readings depend on directly.
    initial_std (n,): standard deviation of states whose start is known, NaN for the others.
    readings_use_torque: whether readings depend on the torque at the same sample.
    jacobians, readings, rosenbrock_step, pivots, channels: batched functions of (state, inputs, X). Inputs from a map
        of the ground are no states and stand beside the torques (`inputs`).
    """

    model: Model
    sensors: tuple[Sensor, ...]
    core: int
    index: np.ndarray
    full_size: int
    angle_state: tuple[int, ...]
    torque_offsets: np.ndarray
    forced_rows: tuple[int, ...]
    forced_inertia: np.ndarray
    reading_parameters: tuple[int, ...]
    initial_std: np.ndarray
    readings_use_torque: bool
    jacobians: BatchedFunction
    readings: BatchedFunction
    rosenbrock_step: BatchedFunction
    pivots: BatchedFunction
    channels: BatchedFunction

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.index)

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

    def inputs(self, torque: np.ndarray, ground: np.ndarray) -> np.ndarray:
        """Join torques (N, n_u) and inputs from a map of the ground (N, n_ground)."""
        return np.concatenate([torque, ground], axis=1) if self.model.map_inputs else torque

    def delivered_torques(
        self, torque: np.ndarray, X: np.ndarray, torque_error: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the delivered torques (N, n_u) [N m] from measured ones, and their slopes by X (N, n_u, n_base).

        torque_error (N, n_u) [N m]: known errors of the torques. Slopes by a gain or a delay use the corrected
        torques, as slopes from noisy ones would follow the noise and bias the estimate.
        """
        if not any(e.effect.channel for e in self.model.effects):
            return torque - X @ self.torque_offsets.T, np.broadcast_to(
                -self.torque_offsets, (len(torque), *self.torque_offsets.shape)
            )
        step = 1 / float(self.model.machine.sampling_hz)
        t = np.arange(len(torque)) * step
        *channels, by_gain, by_offset, by_delay = self.channels(t[:, None], X)
        gain, offset, delay = (e[:, :, 0] for e in channels)
        u = delivered_torques(t, torque, (gain.T, offset.T, delay.T))
        corrected = u + torque_error
        rise = np.gradient(gain * corrected + offset, step, axis=0)
        slope = (rise[:, :, None] * by_delay - by_offset - corrected[:, :, None] * by_gain) / gain[:, :, None]
        return u, slope

    def delivered_noise(self, noise: np.ndarray, X: np.ndarray) -> np.ndarray:
        """Convert the noise of the torque sensors (n_u,) to noise of the delivered torques [N m]."""
        if not any(e.effect.channel for e in self.model.effects):
            return noise
        gain: np.ndarray = self.model.channels(0.0, X)[0].full()[:, 0]
        return noise / np.abs(gain)


@dataclass(frozen=True)
class TransitionJacobians:
    """Derivatives of the state at the end of each of K intervals.

    A (K, n, n): by the state at its start. B (K, n, n_u): by a torque constant in it. X (K, n, n_base): by base
    parameters at fixed delivered torque. F (K, n, n_forced): by a constant force on each forced row.
    """

    A: np.ndarray
    B: np.ndarray
    X: np.ndarray
    F: np.ndarray


@lru_cache(maxsize=16)
def build_state_space(model: Model, names: tuple[str, ...]) -> StateSpace:
    """Build the state space of a model and the sensors with these names.

    Torque sensors are left out. The pose on the ground is a state if a sensor reads it.
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
    load = model.joint_torques(u)
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
    inputs = ca.vertcat(u, ground)

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
        substitute_state(core_jacobian(u)),
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
    error_scale = np.fmax(initial_std, 1.0)  # an effect's memory may be a torque, thousands of N m
    input_slopes = ca.horzcat(jacobians[1], substitute_state(core_jacobian(full[last:])))
    step = _rosenbrock_step(
        state,
        inputs,
        X,
        len(core),
        substitute_state(rates[index]),
        jacobians[0],
        input_slopes,
        jacobians[4],
        error_scale,
    )
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
    t = ca.SX.sym("t")
    channels = model.channels(t, X)
    mass = ca.Function("mass", [q, u, z, X], [ca.diag(M)])(0, 0, 0, model.nominal).full()[:, 0]
    return StateSpace(
        model,
        sensors,
        len(core),
        np.array(index),
        full.numel(),
        tuple(angle),
        model.offsets,
        forced_rows,
        mass[list(forced_rows)],
        reading_parameters,
        initial_std,
        bool(ca.depends_on(reading, u)),
        BatchedFunction(jacobian_function, (2,)),
        BatchedFunction(readings, (2,)),
        BatchedFunction(step, (3, 4)),
        BatchedFunction(ca.Function("pivots", [state, X], [substitute_state(ca.vec(factors[0]))]), (1,)),
        BatchedFunction(ca.Function("channels", [t, X], [*channels, *[ca.jacobian(e, X) for e in channels]]), (1,)),
    )


def _rosenbrock_step(
    state: ca.SX,
    u: ca.SX,
    X: ca.SX,
    core: int,
    rates: ca.SX,
    J: ca.SX,
    B: ca.SX,
    R: ca.SX,
    error_scale: np.ndarray,
) -> ca.Function:
    """Build (state, u, du/dt, h, X) -> state after h and its error over error_scale (n,): the simulator's Rosenbrock
    method.

    Angles that nothing depends on stand below the core's block in the Jacobian and need no solve.
    """
    n = state.numel()
    rate = ca.Function("rate", [state, u, X], [rates], {"cse": True})
    y, left, slope, h = ca.SX.sym("y", n), ca.SX.sym("l", u.numel()), ca.SX.sym("s", u.numel()), ca.SX.sym("h")
    Jy, By, Ry = ca.Function("jacobian", [state, u, X], [J, B, R], {"cse": True})(y, left, X)
    lower, upper = lu(ca.SX.eye(core) / (GAMMA * h) - Jy)
    dt = ca.vertcat(By @ slope, ca.SX.zeros(n - core, 1))
    stages: list[ca.SX] = []
    for time, gain, weights, c in zip(STAGE_TIMES, TIME_DERIVATIVE_WEIGHTS, A_ROWS, C_ROWS, strict=True):
        at = y + sum((w * U for w, U in zip(weights, stages, strict=True)), ca.SX(n, 1))
        right_hand_side = rate(at, left + slope * (time * h), X) + gain * h * dt
        right_hand_side += sum((w * U for w, U in zip(c, stages, strict=True)), ca.SX(n, 1)) / h
        inner = lu_solve(lower, upper, right_hand_side[:core, 0])
        stages.append(ca.vertcat(inner, GAMMA * h * (Ry @ inner + right_hand_side[core:, 0])))
    error = ca.norm_inf(stages[-1] / error_scale)
    return ca.Function("step", [y, left, slope, h, X], [at + stages[-1], error], {"cse": True})


def advance(space: StateSpace, s: np.ndarray, left: np.ndarray, right: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Integrate K states s (K, n) over one sample, with inputs linear from left to right (K, n_u + n_ground).

    The result is not finite if an interval cannot be integrated, or if too many intervals need too many steps.
    """
    sample = 1 / float(space.model.machine.sampling_hz)
    with np.errstate(all="ignore"):
        return _integrate(
            space, s, left, (right - left) / sample, sample, X, MAX_SPLITS, MAX_MEAN_STEPS * max(len(s), BATCH_SIZE)
        )[0]


def _integrate(
    space: StateSpace,
    start: np.ndarray,
    u: np.ndarray,
    rate: np.ndarray,
    h: float,
    X: np.ndarray,
    splits: int,
    step_budget: int,
) -> tuple[np.ndarray, int]:
    """Make one step over h, and halve the intervals whose error is too large.

    Returns the final states and what remains of step_budget. States are not finite once the budget is spent.
    """
    if len(start) > step_budget:
        return np.full_like(start, np.nan), 0
    step_budget -= len(start)
    end, error = space.rosenbrock_step(start, u, rate, np.array([h]), X)
    end = end[:, :, 0]
    inaccurate = np.flatnonzero(~(error[:, 0, 0] < STEP_TOLERANCE))
    if len(inaccurate) and splits:
        middle, step_budget = _integrate(
            space, start[inaccurate], u[inaccurate], rate[inaccurate], h / 2, X, splits - 1, step_budget
        )
        end[inaccurate], step_budget = _integrate(
            space,
            middle,
            u[inaccurate] + rate[inaccurate] * (h / 2),
            rate[inaccurate],
            h / 2,
            X,
            splits - 1,
            step_budget,
        )
    return end, step_budget


def differentiate(
    space: StateSpace, s: np.ndarray, left: np.ndarray, right: np.ndarray, X: np.ndarray, force: bool = False
) -> TransitionJacobians:
    """Compute the derivatives of the K transitions between states s (K + 1, n), to about 1 %.

    left, right (K, n_u + n_ground): inputs at the start and the end of the intervals. force: fill F as well. Slopes are
    taken in the middle of an interval. Where a joint reverses, friction turns within a sample and affects everything
    before it, so these intervals are divided into fine steps along the straight line between their ends.
    """
    h = 1 / float(space.model.machine.sampling_hz)
    slopes = _radau_step(space, space.jacobians((s[:-1] + s[1:]) / 2, (left + right) / 2, X), h, force)
    steps = _count_reversal_steps(space, s)
    for fine in (REVERSAL_STEPS, ABRUPT_REVERSAL_STEPS):
        turning = np.flatnonzero(steps == fine)
        if len(turning) == 0:
            continue
        share = ((np.arange(fine) + 0.5) / fine)[:, None]
        path = s[turning, None] + share * (s[turning + 1] - s[turning])[:, None]
        inputs = left[turning, None] + share * (right[turning] - left[turning])[:, None]
        local = space.jacobians(path.reshape(-1, space.n), inputs.reshape(-1, left.shape[1]), X)
        fine_jacobians = _radau_step(space, local, h / fine, force)
        A, B, BX, F = (
            e.reshape(len(turning), fine, *e.shape[1:])
            for e in (fine_jacobians.A, fine_jacobians.B, fine_jacobians.X, fine_jacobians.F)
        )
        for total_jacobian, parts in ((slopes.B, B), (slopes.X, BX), (slopes.F, F)):
            total = parts[:, 0]
            for k in range(1, fine):
                total = A[:, k] @ total + parts[:, k]
            total_jacobian[turning] = total
        through = A[:, 0]
        for k in range(1, fine):
            through = A[:, k] @ through
        slopes.A[turning] = through
    return slopes


def _count_reversal_steps(space: StateSpace, s: np.ndarray) -> np.ndarray:
    """Number of fine steps (K,) for each interval between states s (K + 1, n); 0 if no friction turns in it."""
    model = space.model
    steps = np.zeros(len(s) - 1, int)
    first = space.core - len(model.coordinates) - len(model.initial_memory_std)
    for body in model.machine.body:
        if body.friction is None or body.coordinates[0] not in model.coordinates:
            continue
        w = s[:, first + model.coordinates.index(body.coordinates[0])] / float(body.friction.smoothing)
        nearest = np.where(w[:-1] * w[1:] <= 0, 0.0, np.minimum(np.abs(w[:-1]), np.abs(w[1:])))
        change = np.abs(np.diff(w))
        body_steps = np.where(
            change > ABRUPT_CHANGE, ABRUPT_REVERSAL_STEPS, np.where(change > REVERSAL_CHANGE, REVERSAL_STEPS, 0)
        )
        steps = np.maximum(steps, np.where(nearest < REVERSAL_RANGE, body_steps, 0))
    return steps


def _radau_step(space: StateSpace, local: list[np.ndarray], h: float, force: bool) -> TransitionJacobians:
    """Make one step of Radau IIA over each of K intervals of length h, with constant slopes."""
    J, B, JX, JF, R = local
    n, c, n_u, n_p = space.n, space.core, B.shape[2], JX.shape[2]
    direct = h * np.concatenate([B, JX, JF] if force else [B, JX], axis=2)
    eye, increment, J = np.eye(c), h * np.concatenate([J, R], axis=1), h * J
    # The inverse gives the interval's mean response to the start and to the inputs, which leads to the end.
    inverse = np.linalg.inv(eye - J * (2 / 3) + J @ J / 6)
    A = np.zeros((len(J), n, n))
    A[:, :, :c] = increment @ (inverse @ (eye - J / 6))
    A[:, range(n), range(n)] += 1.0
    through = increment @ (inverse @ (eye / 2 - J / 6))
    through[:, range(c), range(c)] += 1.0
    response = through @ direct
    return TransitionJacobians(A, response[:, :, :n_u], response[:, :, n_u : n_u + n_p], response[:, :, n_u + n_p :])
