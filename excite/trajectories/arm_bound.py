"""Cramer-Rao bound of an arm's motion, in inverse form.

Dry friction stops an arm's light joints within microseconds, too fast for the forward form (`smoothing.cramer_rao`),
which integrates from sample to sample. A fully driven machine needs no integration: torques follow from the motion. The
coordinates q of all samples are unknown beside the base parameters X,

    u_k = f(q_k, (q_k+1 - q_k-1) / 2h, (q_k+1 - 2 q_k + q_k-1) / h^2, X) + noise,    readings_k = S q_k + noise,

and q is eliminated from the information matrix (Schur complement, banded). Nothing is assumed of how smooth q is.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import scipy.linalg

from excite.model import Model
from excite.model.machine import noise_of
from excite.simulation import Motion, inverse_dynamics
from excite.smoothing import PRIOR_STD

LEAST_SHARE = 1e-3  # of a count that a joint at rest is taken to move per sample, so that its place stays known


def arm_bound(model: Model, motion: Motion, noise_factors: Mapping[str, float] | None = None) -> np.ndarray:
    """Compute the covariance (n_base, n_base) [SI] that torque sensors and encoders allow along an arm's motion.

    An encoder gives one reading per count, with the error of rounding. The weak prior on parameters, what the machine
    file calls known, and noise_factors are as in `smoothing.cramer_rao`. Raises ValueError for a sensor without noise
    or counts.
    """
    factors = noise_factors or {}
    n, N, h = len(model.coordinates), len(motion.t), 1 / float(model.machine.sampling_hz)
    torque, place = _information(model, motion, factors)
    q, nu, a = model.symbols()
    u = inverse_dynamics(model)(q, nu, a, model.nominal)
    parts = ca.Function("parts", [q, nu, a], [ca.densify(ca.jacobian(u, ca.vertcat(q, nu, a)))], {"cse": True})
    slopes = parts(motion.q.T, motion.nu.T, motion.a.T).full().reshape(n, N, 3, n).transpose(1, 2, 0, 3)
    K, C, M = slopes[:, 0], slopes[:, 1], slopes[:, 2]
    near = np.stack([M / h**2 - C / (2 * h), K - 2 * M / h**2, M / h**2 + C / (2 * h)], axis=1)[1:-1]
    B = np.linalg.inv(model.machine.input_matrix)
    W = (B @ model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T))[1:-1] * model.scale
    weighted = torque[:, None] * W
    H = np.zeros((N, 5, n, n))  # blocks of the coordinates' information, by their distance - 2 ... 2
    H[:, 2] = place
    cross = np.zeros((N, n, W.shape[2]))
    for i in range(3):
        rows = slice(i, N - 2 + i)
        cross[rows] += near[:, i].transpose(0, 2, 1) @ weighted
        for j in range(3):
            H[rows, 2 + j - i] += near[:, i].transpose(0, 2, 1) @ (torque[:, None] * near[:, j])
    flat = cross.reshape(N * n, -1)
    information = np.einsum("kri,krj->ij", W, weighted) - flat.T @ scipy.linalg.solveh_banded(_banded(H), flat)
    information += model.known.information(model.scale) + np.eye(len(information)) / PRIOR_STD**2
    return np.asarray(np.linalg.inv((information + information.T) / 2) * np.outer(model.scale, model.scale))


def _information(model: Model, motion: Motion, factors: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return information of a torque reading (n_u,), and of readings of coordinates (N, n_q, n_q), per sample."""
    machine = model.machine
    n, N = len(model.coordinates), len(motion.t)
    torque, place = np.zeros(len(model.inputs)), np.zeros((N, n, n))
    drives = [b.index for b in machine.actuated]
    for s in machine.sensors("full"):
        factor = factors.get(s.name, 1.0)
        if s.kind not in ("torque", "angle") or s.body is None or factor == np.inf:
            continue
        if not s.has_noise_figure:
            raise ValueError(f"{machine.name}: sensor {s.name}: give noise or counts_per_turn in the machine file")
        if s.kind == "torque":
            torque[drives.index(s.body)] = (noise_of(machine, s) * factor) ** -2
            continue
        slope = machine.joint_values(machine.find(s.body), np.eye(n))
        if s.resolution is None:
            each = np.full(N, (noise_of(machine, s) * factor) ** -2)
        else:
            count = s.resolution * factor
            moved = np.abs(np.gradient(motion.q, axis=0) @ slope) / count
            each = 12 / count**2 * np.clip(moved, LEAST_SHARE, 1.0)
        place += each[:, None, None] * np.outer(slope, slope)
    return torque, place


def _banded(H: np.ndarray) -> np.ndarray:
    """Return the upper form of `scipy.linalg.solveh_banded` of a symmetric block band H (N, 5, n, n)."""
    N, _, n, _ = H.shape
    rows = np.zeros((N, n, 5 * n))
    rows[:] = H.transpose(0, 2, 1, 3).reshape(N, n, 5 * n)
    width = 3 * n - 1
    found = np.zeros((width + 1, N * n))
    for i in range(n):
        for d in range(width + 1):  # entry (r, r + d) with r = k n + i
            column = 2 * n + i + d
            if column < 5 * n:
                at = np.arange(N) * n + i + d
                inside = at < N * n
                found[width - d, at[inside]] = rows[inside, i, column]
    return found
