"""Arms under position control: torques of a motion by inverse dynamics, and the motion under a stiff controller.

Torques alone do not keep an arm under gravity on its path: an error grows like that of a pendulum upside down. Where a
program plays back the motion of such a machine, its joints follow the planned positions: each drive delivers the
planned torque and a correction M(q) (w^2 (q_plan - q) + 2 w (nu_plan - nu)), w = BANDWIDTH, read and corrected once per
sample.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from excite.model import Model
from excite.simulation.integrator import Motion, respond, simulate

BANDWIDTH = 12.0  # rad/s, of the controller's position error; stable with the delay of a sample at 100 Hz; chosen
MAX_BANDWIDTH_SHARE = 0.2  # of the sampling rate [1/s], for slower logs; chosen


@lru_cache(maxsize=8)
def inverse_dynamics(model: Model) -> ca.Function:
    """Return the function (q, nu, a, X) -> torques (n_u,) [N m] that the motors deliver, of a fully driven machine.

    Raises ValueError for other machines and those with effects.
    """
    if not (model.fully_driven and model.plain):
        raise ValueError(f"{model.machine.name}: torques follow from a motion only if every joint is driven")
    q, nu, a = model.symbols()
    X = ca.SX.sym("X", len(model.base.names))
    force = model.balance(q, nu, a, ca.mtimes(ca.sparsify(ca.DM(model.expand)), X))
    u = ca.mtimes(ca.sparsify(ca.DM(np.linalg.inv(model.machine.input_matrix))), force)
    return ca.Function("inverse_dynamics", [q, nu, a, X], [u], ["q", "nu", "a", "X"], ["u"])


def motion_along(model: Model, t: np.ndarray, q: np.ndarray, nu: np.ndarray, a: np.ndarray) -> Motion:
    """Return the motion of a fully driven machine along q, nu, a (N, n_q) with the torques that it takes."""
    u = inverse_dynamics(model)(q.T, nu.T, a.T, model.nominal).full().T
    return Motion(t, q, nu, a, u, np.zeros((len(t), 0)), np.zeros((len(t), len(model.memory))))


def follow_positions(
    model: Model,
    torque: np.ndarray,
    q: np.ndarray,
    nu: np.ndarray,
    X: np.ndarray | None = None,
    friction: str = "smoothed",
) -> Motion:
    """Simulate a fully driven machine that follows q, nu (N, n_q) under position control, torques (N, n_u) planned.

    X (n_base,): base parameters of the machine, nominal by default; the controller uses nominal ones. friction: as in
    `simulate`. Raises SimulationError as `simulate` does.
    """
    n_q = len(model.coordinates)
    w = min(BANDWIDTH, MAX_BANDWIDTH_SHARE * float(model.machine.sampling_hz))
    M = model.mass_matrix(q.T, model.nominal).full().reshape(n_q, len(q), n_q).transpose(1, 0, 2)
    stiff = np.linalg.inv(model.machine.input_matrix) @ M

    def drives(k: int, state: np.ndarray) -> np.ndarray:
        at = max(k - 1, 0)  # the state is that of the previous sample
        off = w**2 * (q[at] - state[:n_q]) + 2 * w * (nu[at] - state[n_q : 2 * n_q])
        return np.asarray(torque[k] + stiff[at] @ off)

    return respond(model, len(torque), drives, X, q[0], nu[0], friction)


def play_back(
    model: Model,
    torque: np.ndarray,
    q0: np.ndarray | None = None,
    nu0: np.ndarray | None = None,
    planned: tuple[np.ndarray, np.ndarray] | None = None,
    X: np.ndarray | None = None,
    friction: str = "smoothed",
) -> Motion:
    """Simulate a drive as its machine plays it back: an arm follows the planned positions, others the torques.

    planned: q, nu (N, n_q) that the drive expects, None for torques alone. Other arguments as in `simulate`. Raises
    SimulationError.
    """
    if planned is not None and model.follows_positions:
        return follow_positions(model, torque, *planned, X, friction)
    return simulate(model, torque, X, q0, nu0, friction)
