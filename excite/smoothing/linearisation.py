"""A machine along a trajectory: where each sample leads, how that moves with state, torques and parameters.

All samples of a log in batched calls. Where a sample leads is integrated by `simulate`'s own step; how it moves needs
three digits only (it weighs residuals, it doesn't make them), so the variational equation is solved by one step of
Radau IIA of order 3 (Hairer and Wanner, "Solving Ordinary Differential Equations II", IV.5): L-stable, as the stiff
contact at standstill demands, and exact in the steady state.
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
    delivered_torques,
    lu,
    lu_solve,
)

# Of a speed over an interval [rad/s, m/s], and of what an effect remembers in its size: what a sample's torque noise
# does is far more.
ACCURACY = 1e-5
BATCH = 1000  # samples at a time: their intermediate results stay in the processor's cache
MANY, FEW = 80, 20  # from how many samples on a block pays; samples in one call of CasADi otherwise
FINE, FINEST = 4, 16  # steps for an interval in which friction turns, and where it turns all at once
ABRUPT = 1.5  # of the speed that friction takes to turn: a change within an interval from which it does so at once
SPLITS = 6  # an interval is halved at most this often
# Steps for each interval on average, in logs longer than BATCH: guesses that lead to a fit take up to 8, a motion that
# takes more has come apart.
MOST = 12


class Batch:
    """A CasADi function on N samples at once; inputs named in `shared` are the same for all of them.

    Called with (N, size) arrays, or (size,) where shared; gives (N, rows, columns) arrays. Many samples are taken one
    instruction at a time, each for a whole block by numpy, which is five to ten times faster than CasADi's own loop
    over samples; what is left over goes to CasADi.
    """

    def __init__(self, function: ca.Function, shared: Sequence[int] = ()) -> None:
        outputs = [ca.densify(e) for e in function.call(function.sx_in())]
        self.function = ca.Function(function.name(), function.sx_in(), outputs, {"cse": True})
        self.shared = tuple(shared)
        self.shapes = [self.function.size_out(k) for k in range(self.function.n_out())]
        self.few = self.function.map(function.name(), "serial", FEW, list(self.shared), [])
        self.block: _Block | None = None

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        N = next(len(a) for k, a in enumerate(arguments) if k not in self.shared)
        results = [np.empty((N, columns, rows)) for rows, columns in self.shapes]
        held = [np.ascontiguousarray(a, float) for a in arguments]
        done = 0
        while done < N:
            if N - done < MANY:
                count = min(FEW, N - done)
                self._few(held, results, done, count)
            else:
                self.block = self.block or _Block(self.function, self.shared)
                count = min(BATCH, N - done)
                self.block(held, results, done, count)
            done += count
        return [r.transpose(0, 2, 1) for r in results]

    def _few(self, held: list[np.ndarray], results: list[np.ndarray], at: int, count: int) -> None:
        """Samples at .. at + count by the function mapped to FEW samples; the last one fills up what is missing."""
        buffer, evaluate = self.few.buffer()
        keep = []
        for k, a in enumerate(held):
            if k not in self.shared:
                a = a[at : at + count]
                if count < FEW:
                    a = np.concatenate([a, np.repeat(a[-1:], FEW - count, axis=0)])
            keep.append(a)
            buffer.set_arg(k, _memory(a))
        whole = [r[at : at + count] if count == FEW else np.empty((FEW, *r.shape[1:])) for r in results]
        for k, r in enumerate(whole):
            if r.size:
                buffer.set_res(k, _memory(r))
        evaluate()
        if count < FEW:
            for r, w in zip(results, whole, strict=True):
                r[at : at + count] = w[:count]


class _Block:
    """A CasADi function's own list of instructions, each on BATCH samples; its registers are rows of samples.

    Inputs and constants are read where they are, and an output is computed where it belongs: to copy a row takes as
    long as to multiply two.
    """

    def __init__(self, function: ca.Function, shared: tuple[int, ...]) -> None:
        registers = np.zeros((function.sz_w(), BATCH))
        each = [() if k in shared else (BATCH,) for k in range(function.n_in())]
        self.inputs = [np.zeros((function.nnz_in(k), *size)) for k, size in enumerate(each)]
        self.outputs = [np.zeros((function.nnz_out(k), BATCH)) for k in range(function.n_out())]
        self.shared = shared
        self.calls: list[tuple[Callable[..., object], tuple[np.ndarray, ...]]] = []
        kept, there = _kept(function), [list(rows) for rows in self.outputs]
        at: dict[int, np.ndarray] = {}  # where the value of each of CasADi's registers is now
        constant: set[int] = set()  # those that hold one
        for k in range(function.n_instructions()):
            code, into, of = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
            if code != ca.OP_OUTPUT:
                (constant.add if code == ca.OP_CONST else constant.discard)(into[0])
            if code == ca.OP_INPUT:
                at[into[0]] = self.inputs[of[0]][of[1], ...]
            elif code == ca.OP_CONST:
                at[into[0]] = np.array(function.instruction_constant(k))
            elif code == ca.OP_OUTPUT:
                row = there[into[0]][into[1]]
                if of[0] in constant:
                    row[:] = at[of[0]]
                elif at[of[0]] is not row:
                    self.calls.append((np.positive, (at[of[0]], row)))
            else:
                call = np.add if code == ca.OP_TWICE else _OPERATIONS[code]
                given = tuple(at[i] for i in (of[:1] * 2 if code == ca.OP_TWICE else of[: call.nin]))
                output = kept.get(k)
                at[into[0]] = registers[into[0]] if output is None else there[output[0]][output[1]]
                if call in (np.maximum, np.minimum):  # numpy wants their output by its name
                    self.calls.append((partial(call, *given, out=at[into[0]]), ()))
                else:
                    self.calls.append((call, (*given, at[into[0]])))

    def __call__(self, held: list[np.ndarray], results: list[np.ndarray], at: int, count: int) -> None:
        for k, (a, own) in enumerate(zip(held, self.inputs, strict=True)):
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


def _kept(function: ca.Function) -> dict[int, tuple[int, int]]:
    """Instructions whose result is an output, by their numbers: which, and where in it; the first that takes it."""
    last: dict[int, int] = {}  # the instruction that wrote a register last
    found: dict[int, tuple[int, int]] = {}
    for k in range(function.n_instructions()):
        into = function.instruction_output(k)
        if function.instruction_id(k) == ca.OP_OUTPUT:
            found.setdefault(last[function.instruction_input(k)[0]], (into[0], into[1]))
        else:
            last[into[0]] = k
    return found


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


def _memory(a: np.ndarray) -> memoryview:
    return a.reshape(-1).data


@dataclass(frozen=True, eq=False)
class Chart:
    """The states of a machine that a set of sensors and its forces depend on.

    State s (n,): first the `core`, the coordinates that forces depend on, the velocities and what effects remember,
    then measured angles that are integrals of these. `index` (n,): their places in simulate's state (q, nu, wheels, z),
    whose size is `full`. `sensors`: those with a reading h(s), in order; `angle`: the state that each encoder reads, -1
    for another sensor. `offsets` (n_u, n_base) takes the torque offsets u0 out of X. `flawed`: parameters that readings
    depend on directly. `known` (n,): states whose start is known, and how well; NaN for the others. What a map of the
    ground tells is no state: it comes in beside the torques (`inputs`). `leaning`: whether
    readings depend on torques at once. `pushed`: rows on which disturbing forces may act, the unactuated ones, or all
    where there are none; `inertia`: theirs, nominal [kg, kg m2].
    """

    model: Model
    sensors: tuple[Sensor, ...]
    core: int
    index: np.ndarray
    full: int
    angle: tuple[int, ...]
    offsets: np.ndarray
    pushed: tuple[int, ...]
    inertia: np.ndarray
    flawed: tuple[int, ...]
    known: np.ndarray
    leaning: bool
    slopes: Batch
    readings: Batch
    step: Batch
    pivots: Batch
    channels: Batch

    @property
    def n(self) -> int:
        return len(self.index)

    def parts(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates, velocities (N, n_q) and memory (N, n_z) of states (N, n); what nothing depends on is zero, and
        what a map of the ground tells."""
        n_q, n_z = len(self.model.coordinates), len(self.model.memory)
        full = np.zeros((len(s), self.full))
        full[:, self.index] = s
        return full[:, :n_q], full[:, n_q : 2 * n_q], full[:, self.full - n_z :]

    def charted(self, full: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of simulate's states (N, full) those of the chart (N, n), and what a map of the ground tells (N, n_over)."""
        return full[:, self.index], full[:, self.full - len(self.model.mapped) :]

    def inputs(self, torque: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Torques (N, n_u) and what a map of the ground tells, over (N, n_over), as functions of a sample take them."""
        return np.concatenate([torque, over], axis=1) if self.model.mapped else torque

    def delivered(
        self, torque: np.ndarray, X: np.ndarray, errors: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Torques (N, n_u) [N m] behind measured ones, and how they move with X (N, n_u, n_base).

        errors (N, n_u) [N m]: what is known of the torques' own. How a gain or a delay moves them is a matter of the
        true torques: taken from noisy ones it follows the noise, and the amount is biased.
        """
        if not any(e.effect.channel for e in self.model.effects):
            return torque - X @ self.offsets.T, np.broadcast_to(-self.offsets, (len(torque), *self.offsets.shape))
        step = 1 / float(self.model.machine.sampling_hz)
        t = np.arange(len(torque)) * step
        *channels, by_gain, by_offset, by_delay = self.channels(t[:, None], X)
        gain, offset, delay = (e[:, :, 0] for e in channels)
        u = delivered_torques(t, torque, (gain.T, offset.T, delay.T))
        true = u + errors
        rise = np.gradient(gain * true + offset, step, axis=0)
        slope = (rise[:, :, None] * by_delay - by_offset - true[:, :, None] * by_gain) / gain[:, :, None]
        return u, slope

    def felt(self, noise: np.ndarray, X: np.ndarray) -> np.ndarray:
        """What noise of the torque sensors (n_u,) is as noise of the delivered torques."""
        if not any(e.effect.channel for e in self.model.effects):
            return noise
        gain: np.ndarray = self.model.channels(0.0, X)[0].full()[:, 0]
        return noise / np.abs(gain)


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the end of each of K intervals: by its start A (K, n, n), by a torque that is constant in it
    B (K, n, n_u), by base parameters at fixed delivered torque X (K, n, n_base), by a constant force on each pushed
    row F (K, n, n_pushed)."""

    A: np.ndarray
    B: np.ndarray
    X: np.ndarray
    F: np.ndarray


@lru_cache(maxsize=16)
def chart(model: Model, names: tuple[str, ...]) -> Chart:
    """The chart of a model and the sensors of these names; torques and positions on the ground are not states."""
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
    pushed = tuple(k for k in range(n_q) if k not in model.actuated) or tuple(range(n_q))
    load = ca.SX(n_q, 1)
    for k, row in enumerate(model.actuated):
        load[row] += u[k]
    factors = ca.ldl(M)
    a = ca.ldl_solve(load - bias, *factors)
    flow = model.flow(q, nu, u, z, X)
    rates = ca.vertcat(dq, a, wheel_rates, flow)
    core = [k for k, c in enumerate(model.coordinates) if c in model.felt] + list(range(n_q, 2 * n_q))
    over = ca.SX.sym("over", len(model.mapped))
    last = full.numel() - len(model.mapped)
    core += range(full.numel() - len(model.memory), last)

    sensors = tuple(s for s in machine.sensors("full") if s.name in names and s.kind not in ("torque", "x", "y"))
    index, angle = list(core), []
    for s in sensors:
        if s.kind in ("angle", "wheel") and not s.is_rate:
            at = (
                model.coordinates.index(machine.find(s.body).coordinates[0])
                if s.kind == "angle"
                else 2 * n_q + wheel_names.index(s.name)
            )
            if at not in index:
                index.append(at)
            angle.append(index.index(at))
        else:
            angle.append(-1)
    state = ca.SX.sym("s", len(index))
    where = ca.SX.zeros(full.numel(), 1)
    for k, at in enumerate(index):
        where[at] = state[k]
    where[last:] = over
    inputs = ca.vertcat(u, over)

    def along(e: ca.SX) -> ca.SX:
        """An expression of the full state, in terms of the chart's."""
        return ca.substitute([e], [full], [where])[0]

    def moved(x: ca.SX) -> ca.SX:
        """How the rates of the core move with x: of the velocities by the balance M da = -d(M a + bias)/dx."""
        held = ca.SX.sym("a", n_q)
        balance = ca.jacobian(M @ held + bias - load, x)
        da = -ca.ldl_solve(ca.substitute([balance], [held], [a])[0], *factors)
        return ca.vertcat(ca.jacobian(dq, x), da, ca.jacobian(wheel_rates, x), ca.jacobian(flow, x))[core, :]

    push = ca.SX.eye(n_q)[:, list(pushed)]
    local = [
        along(moved(full[core])),
        along(moved(u)),
        along(moved(X)),
        along(
            ca.vertcat(
                ca.SX(n_q, len(pushed)),
                ca.ldl_solve(push, *factors),
                ca.SX(full.numel() - 2 * n_q, len(pushed)),
            )[core, :]
        ),
        along(ca.jacobian(rates[index[len(core) :]], full[core])),
    ]
    speed = ca.vertcat(*[rates[index[k]] if k >= 0 else ca.SX(0) for k in angle])
    every = model.read(q, nu, wheels, u, z, X)
    seen = ca.vertcat(*[every[model.readable.index(s.name)] for s in sensors])
    flawed = tuple(k for k in range(X.numel()) if ca.depends_on(seen, X[k]))
    slopes = ca.Function("slopes", [state, inputs, X], local)
    known = np.full(len(index), np.nan)
    known[len(core) - len(model.remembered) : len(core)] = model.remembered
    size = np.fmax(known, 1.0)  # what effects remember may be torques, thousands of N m
    driven = ca.horzcat(local[1], along(moved(full[last:])))
    step = _step(state, inputs, X, len(core), along(rates[index]), local[0], driven, local[4], size)
    readings = ca.Function(
        "readings",
        [state, inputs, X],
        [
            along(seen),
            along(ca.jacobian(seen, full[index])),
            along(speed),
            along(ca.jacobian(speed, full[index])),
            *([along(ca.jacobian(seen, X)[:, list(flawed)])] if flawed else []),
        ],
    )
    t = ca.SX.sym("t")
    channels = model.channels(t, X)
    mass = ca.Function("mass", [q, u, z, X], [ca.diag(M)])(0, 0, 0, model.nominal).full()[:, 0]
    return Chart(
        model,
        sensors,
        len(core),
        np.array(index),
        full.numel(),
        tuple(angle),
        model.offsets,
        pushed,
        mass[list(pushed)],
        flawed,
        known,
        bool(ca.depends_on(seen, u)),
        Batch(slopes, (2,)),
        Batch(readings, (2,)),
        Batch(step, (3, 4)),
        Batch(ca.Function("pivots", [state, X], [along(ca.vec(factors[0]))]), (1,)),
        Batch(ca.Function("channels", [t, X], [*channels, *[ca.jacobian(e, X) for e in channels]]), (1,)),
    )


def _step(
    state: ca.SX,
    u: ca.SX,
    X: ca.SX,
    core: int,
    rates: ca.SX,
    J: ca.SX,
    B: ca.SX,
    R: ca.SX,
    size: np.ndarray,
) -> ca.Function:
    """(state, u, du/dt, h, X) -> state after h, its error in each state's `size` (n,): simulate's Rosenbrock method, on
    a chart's states.

    The angles that nothing depends on take part in the method as they are: below the core's block in the Jacobian.
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
        known = rate(at, left + slope * (time * h), X) + gain * h * dt
        known += sum((w * U for w, U in zip(c, stages, strict=True)), ca.SX(n, 1)) / h
        inner = lu_solve(lower, upper, known[:core])
        stages.append(ca.vertcat(inner, GAMMA * h * (Ry @ inner + known[core:])))
    error = ca.norm_inf(stages[-1] / size)
    return ca.Function("step", [y, left, slope, h, X], [at + stages[-1], error], {"cse": True})


def advance(chart: Chart, s: np.ndarray, left: np.ndarray, right: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Where K states s (K, n) lead in one sample (K, n) under inputs from left to right (K, n_u + n_over).

    Not finite where an interval can't be integrated, or where so many take so many steps that it isn't worth it.
    """
    sample = 1 / float(chart.model.machine.sampling_hz)
    with np.errstate(all="ignore"):
        return _intervals(chart, s, left, (right - left) / sample, sample, X, SPLITS, MOST * max(len(s), BATCH))[0]


def _intervals(
    chart: Chart, start: np.ndarray, u: np.ndarray, rate: np.ndarray, h: float, X: np.ndarray, splits: int, most: int
) -> tuple[np.ndarray, int]:
    """One step over h; intervals with too large an error in two halves. most: steps that may be made. Also how many
    are left then; not finite where none are."""
    if len(start) > most:
        return np.full_like(start, np.nan), 0
    most -= len(start)
    end, error = chart.step(start, u, rate, np.array([h]), X)
    end = end[:, :, 0]
    bad = np.flatnonzero(~(error[:, 0, 0] < ACCURACY))
    if len(bad) and splits:
        middle, most = _intervals(chart, start[bad], u[bad], rate[bad], h / 2, X, splits - 1, most)
        end[bad], most = _intervals(chart, middle, u[bad] + rate[bad] * (h / 2), rate[bad], h / 2, X, splits - 1, most)
    return end, most


def differentiate(
    chart: Chart, s: np.ndarray, left: np.ndarray, right: np.ndarray, X: np.ndarray, force: bool = False
) -> Slopes:
    """How the ends of the K intervals between states s (K + 1, n) move, to about 1 %, under inputs from left to right
    (K, n_u + n_over).

    Slopes are those of an interval's middle.
    F is filled with `force` only. Where a joint reverses, its friction turns within a sample and leaves a mark on
    everything that came before: these intervals are taken in fine steps along the straight line between their ends.
    """
    h = 1 / float(chart.model.machine.sampling_hz)
    slopes = _radau(chart, chart.slopes((s[:-1] + s[1:]) / 2, (left + right) / 2, X), h, force)
    steps = _reversals(chart, s)
    for fine in (FINE, FINEST):
        turning = np.flatnonzero(steps == fine)
        if len(turning) == 0:
            continue
        share = ((np.arange(fine) + 0.5) / fine)[:, None]
        path = s[turning, None] + share * (s[turning + 1] - s[turning])[:, None]
        push = left[turning, None] + share * (right[turning] - left[turning])[:, None]
        local = chart.slopes(path.reshape(-1, chart.n), push.reshape(-1, left.shape[1]), X)
        by = _radau(chart, local, h / fine, force)
        A, B, BX, F = (e.reshape(len(turning), fine, *e.shape[1:]) for e in (by.A, by.B, by.X, by.F))
        for part, own in ((slopes.B, B), (slopes.X, BX), (slopes.F, F)):
            total = own[:, 0]
            for k in range(1, fine):
                total = A[:, k] @ total + own[:, k]
            part[turning] = total
        through = A[:, 0]
        for k in range(1, fine):
            through = A[:, k] @ through
        slopes.A[turning] = through
    return slopes


def _reversals(chart: Chart, s: np.ndarray) -> np.ndarray:
    """In how many fine steps each of the intervals between states s (K + 1, n) is taken (K,): 0 where friction doesn't
    turn in it."""
    model = chart.model
    found = np.zeros(len(s) - 1, int)
    first = chart.core - len(model.coordinates) - len(model.remembered)
    for body in model.machine.body:
        if body.friction is None or body.coordinates[0] not in model.coordinates:
            continue
        w = s[:, first + model.coordinates.index(body.coordinates[0])] / float(body.friction.smoothing)
        nearest = np.where(w[:-1] * w[1:] <= 0, 0.0, np.minimum(np.abs(w[:-1]), np.abs(w[1:])))
        change = np.abs(np.diff(w))
        steps = np.where(change > ABRUPT, FINEST, np.where(change > 0.3, FINE, 0))
        found = np.maximum(found, np.where(nearest < 4, steps, 0))
    return found


def _radau(chart: Chart, local: list[np.ndarray], h: float, force: bool) -> Slopes:
    """One step of Radau IIA over each of K intervals of length h, with slopes that don't change in it."""
    J, B, JX, JF, R = local
    n, c, n_u, n_p = chart.n, chart.core, B.shape[2], JX.shape[2]
    direct = h * np.concatenate([B, JX, JF] if force else [B, JX], axis=2)
    eye, across, J = np.eye(c), h * np.concatenate([J, R], axis=1), h * J
    # The inverse gives the mean over the interval, of the start and of what acts directly, and that leads to the end.
    inverse = np.linalg.inv(eye - J * (2 / 3) + J @ J / 6)
    A = np.zeros((len(J), n, n))
    A[:, :, :c] = across @ (inverse @ (eye - J / 6))
    A[:, range(n), range(n)] += 1.0
    through = across @ (inverse @ (eye / 2 - J / 6))
    through[:, range(c), range(c)] += 1.0
    moved = through @ direct
    return Slopes(A, moved[:, :, :n_u], moved[:, :, n_u : n_u + n_p], moved[:, :, n_u + n_p :])
