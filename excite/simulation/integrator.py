"""Motion from torques: the machine's equations integrated with the torques that the motors deliver.

The contact is stiff near standstill (about 1500 1/s) and mild at speed. A Rosenbrock method (RODAS, order 4(3), Hairer
and Wanner, "Solving Ordinary Differential Equations II", IV.7) takes a whole sample in one step with the exact
Jacobian and splits it where its error estimate asks for that: at reversals, where friction and slip turn sharply.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.errors import SimulationError
from excite.model import Model
from excite.simulation.rosenbrock import A_ROWS, C_ROWS, GAMMA, STAGE_TIMES, TIME_DERIVATIVE_WEIGHTS, lu, lu_solve

TOLERANCE = 3e-7  # of one step, relative to each state's typical size
MIN_STATE_SCALE = 0.1
MIN_STEP_SHARE = 1e-7  # share of a sample below which a step is not split further


@dataclass(frozen=True)
class Motion:
    """A motion at the samples t (N,) [s].

    q (N, n_q) coordinates [rad, m], nu (N, n_q) velocities and a (N, n_q) their derivatives (a planar root's in its
    own axes), u (N, n_u) delivered torques [N m], wheels (N, n_wheels) angles of the measuring wheels [rad]; memory
    (N, n_z): what effects remember.
    """

    t: np.ndarray
    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    u: np.ndarray
    wheels: np.ndarray
    memory: np.ndarray


def effect_inputs(model: Model, motion: Motion) -> tuple[np.ndarray, ...]:
    """What the model's functions of a sample take beside q, nu and a of a motion: nothing, or with effects u and z."""
    return () if model.plain else (motion.u.T, motion.memory.T)


def simulate(
    model: Model,
    torque: np.ndarray,
    X: np.ndarray | None = None,
    q0: np.ndarray | None = None,
    nu0: np.ndarray | None = None,
) -> Motion:
    """The motion under torques (N, n_u) [N m] at the machine's sampling rate, linear between samples.

    X (n_base,) base parameters, the nominal ones by default; q0, nu0 (n_q,) the start, at rest at zero by default.
    Relative error below 1e-6 over 60 s. Raises SimulationError where the motion leaves the finite numbers or the mass
    matrix is not positive definite, and ValueError for torques of the wrong shape.
    """
    torque = np.ascontiguousarray(torque, float)
    n_u = len(model.inputs)
    if torque.ndim != 2 or torque.shape[1] != n_u or len(torque) < 2:
        raise ValueError(f"torque: needs shape (N >= 2, {n_u}) for {', '.join(model.inputs)}, got {torque.shape}")
    if not np.isfinite(torque).all():
        raise ValueError(f"torque: not a finite number in row {int(np.argmin(np.isfinite(torque).all(axis=1)))}")
    return respond(model, len(torque), lambda k, state: torque[k], X, q0, nu0)


def respond(
    model: Model,
    samples: int,
    torque: Callable[[int, np.ndarray], np.ndarray],
    X: np.ndarray | None = None,
    q0: np.ndarray | None = None,
    nu0: np.ndarray | None = None,
) -> Motion:
    """The motion under torques that answer to it: torque(k, state) gives (n_u,) [N m] at sample k.

    For sample 0 and k >= 1 the state is that of samples 0 and k - 1: q, nu, angles of the measuring wheels. Arguments
    and errors otherwise as in `simulate`.
    """
    parameters = np.ascontiguousarray(model.nominal if X is None else X, float)
    n_u, n_q = len(model.inputs), len(model.coordinates)
    rate = float(model.machine.sampling_hz)
    step, n_w = _step_function(model)
    state = np.zeros(2 * n_q + n_w + len(model.memory))
    state[:n_q] = 0.0 if q0 is None else q0
    state[n_q : 2 * n_q] = 0.0 if nu0 is None else nu0
    state[2 * n_q + n_w :] = model.fresh
    driven = np.empty((samples, n_u))
    history = _integrate(step, state, driven, torque, parameters, 1.0 / rate, _map_updater(model))
    finite = np.isfinite(history).all(axis=1)  # an error estimate of many states overlooks one that is no number
    if not finite.all():
        raise SimulationError(
            f"the motion is no number any more at t = {int(np.argmin(finite)) / rate:g} s: check the machine file's"
            " values, those of its effects as well"
        )
    q, nu, wheels, memory = np.split(history, [n_q, 2 * n_q, 2 * n_q + n_w], axis=1)
    # an L-stable step damps even what must blow up, so a mass matrix that isn't one has to be looked for
    solid = (model.pivots(q.T, parameters).full() > 0).all(axis=0)
    if not solid.all():
        raise SimulationError(
            f"the mass matrix is not positive definite at t = {int(np.argmin(solid)) / rate:g} s: masses and inertias"
            " must be physically possible, check the parameters"
        )
    beside = () if model.plain else (memory.T,)
    a = model.acceleration(q.T, nu.T, driven.T, *beside, parameters).full().T
    return Motion(np.arange(samples) / rate, q, nu, a, driven, wheels, memory)


def _integrate(
    step: ca.Function,
    state: np.ndarray,
    driven: np.ndarray,
    torque: Callable[[int, np.ndarray], np.ndarray],
    parameters: np.ndarray,
    sample: float,
    look: Callable[[np.ndarray], None],
) -> np.ndarray:
    look(state)
    start, end, error = state.copy(), np.zeros_like(state), np.zeros(1)
    left, slope, length = np.zeros(driven.shape[1]), np.zeros(driven.shape[1]), np.zeros(1)
    buffer, advance = step.buffer()
    for k, array in enumerate((start, left, slope, length, parameters)):
        buffer.set_arg(k, array.data)
    buffer.set_res(0, end.data)
    buffer.set_res(1, error.data)
    history = np.empty((len(driven), len(state)))
    history[0] = state
    driven[0] = torque(0, state)
    share = 1.0
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
            if e <= 1.0:
                done += share
                start[:] = end
            elif share < MIN_STEP_SHARE or not (np.isfinite(e) or share > 1e-3):
                raise SimulationError(
                    f"the motion diverges at t = {(k + done) * sample:.3f} s,"
                    f" state {np.array2string(start, precision=3)}:"
                    " check the torques and that the masses and inertias are positive"
                )
            share *= min(4.0, max(0.1, 0.9 * (e + 1e-12) ** -0.25)) if np.isfinite(e) else 0.1
        look(start)
        history[k + 1] = start
        share = max(share, 1e-3)
    return history


def _map_updater(model: Model) -> Callable[[np.ndarray], None]:
    """Puts into a state what a map of the ground tells there, and the contacts onto the map."""
    if not model.mapped:
        return lambda state: None
    ground, n_q = model.ground(), len(model.coordinates)

    def look(state: np.ndarray) -> None:
        state[len(state) - len(model.mapped) :] = ground(state[:n_q])

    return look


@lru_cache(maxsize=8)
def _step_function(model: Model) -> tuple[ca.Function, int]:
    """One step (state, u, du/dt, h, X) -> state after h, its error over the tolerance.

    Rosenbrock for the speeds, what effects remember, and the coordinates that the forces depend on. The others (pose,
    angles of contacts and measuring wheels) are integrals of these, by the Hermite quadrature
    h/2 (f0 + f1) + h^2/12 (f0' - f1').
    """
    n_q, n_u = len(model.coordinates), len(model.inputs)
    q, nu, _ = model.symbols()
    u, X, z = ca.SX.sym("u", n_u), ca.SX.sym("X", len(model.base.names)), ca.SX.sym("z", len(model.memory))
    dq, _, wheels, *_ = model.kinematics(q, nu)
    n_w = wheels.numel()
    state = ca.vertcat(q, nu, ca.SX.sym("w", n_w), z)
    a = model.accelerate(q, nu, u, X, z)
    rhs = ca.vertcat(dq, a, wheels, model.flow(q, nu, u, z, X))
    core = [k for k, c in enumerate(model.coordinates) if c in model.felt] + list(range(n_q, 2 * n_q))
    core += range(2 * n_q + n_w, state.numel() - len(model.mapped))
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

    # The heading must be at its end before the position that turns with it: the order of the table does that
    # when taken backwards, since (x, y) come before theta.
    second = ca.Function("second", [state, u, X], [ca.jtimes(rhs[rest], state, rhs)], {"cse": True})
    first = ca.Function("first", [state], [rhs[rest]], {"cse": True})
    f0, d0 = first(y), second(y, left, X)
    for k in reversed(range(len(rest))):
        f1, d1 = first(end)[k], second(end, left + slope * h, X)[k]
        end[rest[k]] = y[rest[k]] + h / 2 * (f0[k] + f1) + h**2 / 12 * (d0[k] - d1)
    return ca.Function("step", [y, left, slope, h, X], [end, error], {"cse": True}), n_w
