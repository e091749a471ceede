"""Forward simulation: the machine's equations integrated under the torques that the motors deliver.

The contact is stiff near standstill (about 1500 1/s). A Rosenbrock method (RODAS, order 4(3), Hairer and Wanner,
"Solving Ordinary Differential Equations II", IV.7) takes a whole sample in one step with the exact Jacobian, and splits
it where its error estimate asks for it: at reversals, where friction and slip turn sharply. Dry friction is smoothed
or set-valued (`dry_friction`): then steps end where a joint sticks, breaks away or reverses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.errors import SimulationError
from excite.model import Model
from excite.simulation.dry_friction import DryFriction
from excite.simulation.rosenbrock import A_ROWS, C_ROWS, GAMMA, STAGE_TIMES, TIME_DERIVATIVE_WEIGHTS, lu, lu_solve

FRICTION_LAWS = ("smoothed", "set-valued")
TOLERANCE = 3e-7  # error of one step relative to each state's size; chosen for 1e-6 over 60 s
MIN_STATE_SCALE = 0.1  # added to a state's size in the error estimate [SI]; chosen
MIN_STEP_SHARE = 1e-7  # share of a sample below which a step is not split further; chosen


@dataclass(frozen=True)
class Motion:
    """A motion at the times t (N,) [s].

    q (N, n_q) [rad, m]: coordinates; nu, a (N, n_q): velocities and their derivatives, a planar root's in its own axes.
    u (N, n_u) [N m]: delivered torques; wheels (N, n_wheels) [rad]: angles of the measuring wheels.
    memory (N, n_z): memory states of effects.
    """

    t: np.ndarray
    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    u: np.ndarray
    wheels: np.ndarray
    memory: np.ndarray


def effect_inputs(model: Model, motion: Motion) -> tuple[np.ndarray, ...]:
    """Return the further arguments (u, z) of the model's functions along a motion, () for a plain model."""
    return () if model.plain else (motion.u.T, motion.memory.T)


def simulate(
    model: Model,
    torque: np.ndarray,
    X: np.ndarray | None = None,
    q0: np.ndarray | None = None,
    nu0: np.ndarray | None = None,
    friction: str = "smoothed",
) -> Motion:
    """Simulate the motion under torques (N, n_u) [N m] at the machine's sampling rate, linear between samples.

    X (n_base,): base parameters, nominal by default; q0, nu0 (n_q,): the start, at rest at zero by default.
    friction: a name of FRICTION_LAWS. "smoothed": Fs tanh(w / smoothing), as designs and identification assume.
    "set-valued": Fs sgn(w), and up to Fs at rest, so that joints stick; w is then exactly zero.
    Relative error below 1e-6 over 60 s.
    Raises SimulationError for a motion that diverges, a mass matrix that is not positive definite or dry friction that
    is negative; MachineError for an effect whose friction can't stick; ValueError for torques of the wrong shape or an
    unknown friction.
    """
    torque = np.ascontiguousarray(torque, float)
    n_u = len(model.inputs)
    if torque.ndim != 2 or torque.shape[1] != n_u or len(torque) < 2:
        raise ValueError(f"torque: needs shape (N >= 2, {n_u}) for {', '.join(model.inputs)}, got {torque.shape}")
    if not np.isfinite(torque).all():
        raise ValueError(f"torque: not a finite number in row {int(np.argmin(np.isfinite(torque).all(axis=1)))}")
    return respond(model, len(torque), lambda k, state: torque[k], X, q0, nu0, friction)


def respond(
    model: Model,
    samples: int,
    torque: Callable[[int, np.ndarray], np.ndarray],
    X: np.ndarray | None = None,
    q0: np.ndarray | None = None,
    nu0: np.ndarray | None = None,
    friction: str = "smoothed",
) -> Motion:
    """Simulate the motion under feedback: torque(k, state) gives the torques (n_u,) [N m] at sample k.

    The state (q, nu, angles of the measuring wheels) is that of sample k - 1, for k = 0 the initial one. Other
    arguments and errors are those of `simulate`.
    """
    if friction not in FRICTION_LAWS:
        raise ValueError(f"friction: {friction} is unknown, allowed: {', '.join(FRICTION_LAWS)}")
    parameters = np.ascontiguousarray(model.nominal if X is None else X, float)
    n_u, n_q = len(model.inputs), len(model.coordinates)
    rate = float(model.machine.sampling_hz)
    sticking = DryFriction(model, parameters) if friction == "set-valued" and model.rubbing else None
    step, n_w = _step_function(model, sticking is not None)
    state = np.zeros(2 * n_q + n_w + len(model.memory))
    state[:n_q] = 0.0 if q0 is None else q0
    state[n_q : 2 * n_q] = 0.0 if nu0 is None else nu0
    state[2 * n_q + n_w :] = model.initial_memory
    driven = np.empty((samples, n_u))
    history = _integrate(step, state, driven, torque, parameters, 1.0 / rate, _map_updater(model, parameters), sticking)
    finite = np.isfinite(history).all(axis=1)  # the maximum norm of the error can miss a NaN
    if not finite.all():
        raise SimulationError(
            f"the motion is not finite at t = {int(np.argmin(finite)) / rate:g} s: check the values in the"
            " machine file, those of effects as well"
        )
    q, nu, wheels, memory = np.split(history, [n_q, 2 * n_q, 2 * n_q + n_w], axis=1)
    # an L-stable step damps even an unstable motion, so an impossible mass matrix needs a check of its own
    solid = (model.pivots(q.T, parameters).full() > 0).all(axis=0)
    if not solid.all():
        raise SimulationError(
            f"the mass matrix is not positive definite at t = {int(np.argmin(solid)) / rate:g} s: masses and inertias"
            " must be physically possible, check the parameters"
        )
    beside = () if model.plain else (memory.T,)
    if sticking is None:
        a = model.acceleration(q.T, nu.T, driven.T, *beside, parameters).full().T
    else:
        a = sticking.accelerations(history, driven)
    return Motion(np.arange(samples) / rate, q, nu, a, driven, wheels, memory)


def _integrate(
    step: ca.Function,
    state: np.ndarray,
    driven: np.ndarray,
    torque: Callable[[int, np.ndarray], np.ndarray],
    parameters: np.ndarray,
    sample: float,
    look: Callable[[np.ndarray], None],
    sticking: DryFriction | None,
) -> np.ndarray:
    """Integrate with step control and return the states (N, n); fills `driven` (N, n_u) with the torques.

    look: updates the map inputs in a state, once per sample. sticking: ends steps at the events of dry friction.
    """
    look(state)
    start, end, error = state.copy(), np.zeros_like(state), np.zeros(1)
    left, slope, length = np.zeros(driven.shape[1]), np.zeros(driven.shape[1]), np.zeros(1)
    buffer, advance = step.buffer()
    for k, array in enumerate((start, left, slope, length, parameters if sticking is None else sticking.parameters)):
        buffer.set_arg(k, array.data)
    buffer.set_res(0, end.data)
    buffer.set_res(1, error.data)
    history = np.empty((len(driven), len(state)))
    history[0] = state
    driven[0] = torque(0, state)
    if sticking is not None:
        sticking.begin(start, driven[0])
    share = 1.0

    def attempt(seconds: float) -> np.ndarray:
        length[0] = seconds
        advance()
        return left + slope * seconds

    for k in range(len(driven) - 1):
        driven[k + 1] = torque(k + 1, history[k])
        left[:] = driven[k]
        slope[:] = (driven[k + 1] - driven[k]) / sample
        done = 0.0
        while done < 1.0:
            share = min(share, 1.0 - done)
            if 1.0 - done - share < 1e-9:
                share = 1.0 - done
            if done > 0.0:
                left[:] = driven[k] + slope * (sample * done)
            length[0] = share * sample
            advance()
            e = float(error[0])
            tried = share
            if e <= 1.0:
                if sticking is not None:
                    share *= sticking.end_step(attempt, start, end, left + slope * length[0], float(length[0]))
                done += share
                start[:] = end
            elif share < MIN_STEP_SHARE or not (np.isfinite(e) or share > 1e-3):
                raise SimulationError(
                    f"the motion diverges at t = {(k + done) * sample:.3f} s,"
                    f" state {np.array2string(start, precision=3)}:"
                    " check the torques and that the masses and inertias are positive"
                )
            share = tried * min(4.0, max(0.1, 0.9 * (e + 1e-12) ** -0.25)) if np.isfinite(e) else 0.1
        look(start)
        if sticking is not None:
            sticking.end_sample()
        history[k + 1] = start
        share = max(share, 1e-3)
    return history


def _map_updater(model: Model, X: np.ndarray) -> Callable[[np.ndarray], None]:
    """Return a function that enters the contacts on a map of the ground and updates the map inputs in a state."""
    if not model.map_inputs:
        return lambda state: None
    ground, n_q = model.new_ground_map(), len(model.coordinates)

    def look(state: np.ndarray) -> None:
        state[len(state) - len(model.map_inputs) :] = ground(model.true_coordinates(state[:n_q], X))

    return look


@lru_cache(maxsize=8)
def _step_function(model: Model, set_valued: bool) -> tuple[ca.Function, int]:
    """Build one step (state, u, du/dt, h, X) -> state after h, error over tolerance; and count the measuring wheels.

    set_valued: behind X come `sign` and `slips` of `Model.accelerate`, which hold for the step.

    The Rosenbrock method takes the speeds, the memory states and the coordinates that forces depend on. The others
    (pose, angles of contacts and measuring wheels) are integrals of these, by the Hermite quadrature
    h/2 (f0 + f1) + h^2/12 (f0' - f1').
    """
    n_q, n_u = len(model.coordinates), len(model.inputs)
    q, nu, _ = model.symbols()
    u, z = ca.SX.sym("u", n_u), ca.SX.sym("z", len(model.memory))
    base, modes = ca.SX.sym("X", len(model.base.names)), ca.SX.sym("modes", 2 * len(model.rubbing) * set_valued)
    X = ca.vertcat(base, modes)
    dq, _, wheels, *_ = model.kinematics(q, nu)
    n_w = wheels.numel()
    state = ca.vertcat(q, nu, ca.SX.sym("w", n_w), z)
    a = model.accelerate(q, nu, u, base, z, *(ca.vertsplit(modes, len(model.rubbing)) if set_valued else ()))
    rhs = ca.vertcat(dq, a, wheels, model.flow(q, nu, u, z, base))
    core = [k for k, c in enumerate(model.coordinates) if c in model.active_coordinates] + list(range(n_q, 2 * n_q))
    core += range(2 * n_q + n_w, state.numel() - len(model.map_inputs))
    rest = [k for k in range(2 * n_q + n_w) if k not in core]
    rate = ca.Function("rate", [state, u, X], [rhs[core]], {"cse": True})
    jacobian = ca.Function(
        "jacobian", [state, u, X], [ca.jacobian(rhs[core], state[core]), ca.jacobian(rhs[core], u)], {"cse": True}
    )

    y, left, slope, h = ca.SX.sym("y", state.numel()), ca.SX.sym("l", n_u), ca.SX.sym("s", n_u), ca.SX.sym("h")
    J, Ju = jacobian(y, left, X)
    lower, upper = lu(ca.SX.eye(len(core)) / (GAMMA * h) - J)
    dt = Ju @ slope
    none = ca.SX(len(core), 1)
    stages: list[ca.SX] = []
    at = y[core]
    for time, gain, weights, c in zip(STAGE_TIMES, TIME_DERIVATIVE_WEIGHTS, A_ROWS, C_ROWS, strict=True):
        at = y[core] + sum((w * U for w, U in zip(weights, stages, strict=True)), none)
        whole = ca.SX(y)
        whole[core] = at
        known = rate(whole, left + slope * (time * h), X) + gain * h * dt
        known += sum((w * U for w, U in zip(c, stages, strict=True)), none) / h
        stages.append(lu_solve(lower, upper, known))
    end = ca.SX(y)
    end[core] = at + stages[-1]
    error = ca.norm_inf(stages[-1] / (MIN_STATE_SCALE + ca.fabs(y[core]))) / TOLERANCE

    # Backwards, since the position depends on the heading at the end, and (x, y) come before theta in the table.
    second = ca.Function("second", [state, u, X], [ca.jtimes(rhs[rest], state, rhs)], {"cse": True})
    first = ca.Function("first", [state], [rhs[rest]], {"cse": True})
    f0, d0 = first(y), second(y, left, X)
    for k in reversed(range(len(rest))):
        f1, d1 = first(end)[k], second(end, left + slope * h, X)[k]
        end[rest[k]] = y[rest[k]] + h / 2 * (f0[k] + f1) + h**2 / 12 * (d0[k] - d1)
    return ca.Function("step", [y, left, slope, h, X], [end, error], {"cse": True}), n_w
