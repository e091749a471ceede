"""How visible a hidden cause is, measured apart from any diagnosis: what the bare roller cannot explain in the log."""

from __future__ import annotations

from dataclasses import astuple, fields
from functools import lru_cache

import casadi as ca
import numpy as np
from support import plant
from support.blind import Blind
from support.plant import Machine

VISIBLE = 50.0  # chi-squared left without the cause: twice what a search over some seventy names has to ask for
_FREE = [k for k, f in enumerate(fields(Machine)) if f.name not in plant.GEOMETRY]
_PRIOR = 0.3  # of each parameter, relative: machines are known that well beforehand


@lru_cache(maxsize=1)
def _slopes() -> ca.Function:
    system = plant.bare()
    x, u, p = ca.SX.sym("x", 14), ca.SX.sym("u", 3), ca.SX.sym("p", len(fields(Machine)))
    rate = system.rate(x, 0, u, p, ca.SX(0, 1))
    columns = [*plant.ENCODERS, "yaw_rate_rad_s", "vy_m_s"]
    read = dict(zip(system.columns, system.read(x, 0, u, p), strict=True))
    y = ca.vertcat(*[read[c] for c in columns])
    scale = ca.DM(astuple(Machine()))[_FREE]
    C = ca.jacobian(rate, p)[:, _FREE] @ ca.diag(scale)
    return ca.Function("slopes", [x, u, p], [ca.jacobian(rate, x), ca.jacobian(rate, u), C, y, ca.jacobian(y, x)])


def visibility(seen: Blind) -> float:
    """The chi-squared [-] that the roller without anything hidden cannot explain in the log, whatever its parameters.

    Along the true motion the bare roller's equations leave a defect in each sample, and the noise-free readings differ
    from what its sensors would read. A Kalman filter of the linearised bare roller (14 states, 27 parameters with a
    prior of 30 % each, the torque's noise as disturbance) takes both; its normalised innovations add up to the least
    misfit over all parameters and true torques. Zero when nothing is hidden; what a perfect name would gain otherwise.
    A fault in what the sensors write (lost counts, a stuck bit) is taken as the log shows it.
    """
    machine, motion = seen.machine, seen.motion
    ideal = plant.ideal(seen.system, machine, motion)
    if seen.system.written:
        for change in seen.system.written:
            change(motion.t, ideal, np.random.default_rng([seen.case.seed, 14]))
    columns = [*plant.ENCODERS, *(("yaw_rate_rad_s", "vy_m_s") if seen.case.kit == "full" else ())]
    n, m, h = len(motion.t), len(columns), 1 / plant.RATE
    data = np.column_stack([ideal[c] for c in columns])
    torque = np.column_stack([ideal[c] for c in ("u1_Nm", "u2_Nm", "u4_Nm")])
    torque = torque - (machine.u01, machine.u02, machine.u04)
    p0 = np.array(astuple(machine))
    step = np.array([2 * np.pi / c for c in plant.ENCODERS.values()])
    travel = np.abs(np.diff(data[:, :5], axis=0, prepend=data[:1, :5])) / step
    variance = np.empty((n, m))
    variance[:, :5] = step**2 / 12 / np.clip(travel, 0.01, 1)  # no count, no news
    variance[:, 5:] = [plant.NOISE[c] ** 2 for c in columns[5:]]

    states = motion.x[:, :14]
    A, B, C, H_y, H = (
        np.asarray(v.full()).reshape(v.shape[0], n, -1).transpose(1, 0, 2)
        for v in _slopes().map(n)(states.T, torque.T, np.tile(p0[:, None], n))
    )
    F, D = _over_a_sample(A, np.concatenate([B, C], axis=2), h)
    offset = [_FREE.index(k) for k, f in enumerate(fields(Machine)) if f.name in ("u01", "u02", "u04")]
    scale = np.array(astuple(Machine()))[_FREE]
    D[:, :, 3 + np.array(offset)] = -D[:, :, :3] * scale[offset]  # what is read less its offset drives the roller
    noise = np.array([plant.NOISE[c] for c in ("u1_Nm", "u2_Nm", "u4_Nm")])

    ahead = _ahead(states, torque, machine)
    defect = states[1:] - ahead
    wrong = data - H_y[:, :m, 0]

    k_p = len(_FREE)
    z = np.zeros(14 + k_p)
    P = np.diag([1e-8] * 14 + [_PRIOR**2] * k_p)
    T, Hm = np.eye(14 + k_p), np.zeros((m, 14 + k_p))
    misfit = 0.0
    for k in range(n):
        Hm[:, :14] = H[k][:m]
        innovation = wrong[k] - Hm @ z
        PH = P @ Hm.T
        S = Hm @ PH
        S[np.diag_indices(m)] += variance[k]
        gain = np.linalg.solve(S, np.column_stack([innovation, PH.T]))
        misfit += float(innovation @ gain[:, 0])
        z = z + PH @ gain[:, 0]
        P = P - PH @ gain[:, 1:]
        if k == n - 1:
            break
        T[:14, :14], T[:14, 14:] = F[k], D[k][:, 3:]
        z = T @ z
        z[:14] -= defect[k]
        P = T @ ((P + P.T) / 2) @ T.T
        P[:14, :14] += (D[k][:, :3] * noise**2) @ D[k][:, :3].T
    if not np.isfinite(misfit):
        raise RuntimeError(f"{seen.case.key}: the filter that measures visibility diverged")
    return misfit


def _ahead(states: np.ndarray, torque: np.ndarray, machine: Machine) -> np.ndarray:
    """Where the bare roller would be one sample after each state but the last, (N - 1, 14)."""
    plain, p = plant.bare(), np.array(astuple(machine))
    x, left, right, end, out = np.zeros(14), np.zeros(3), np.zeros(3), np.zeros(14), np.empty_like(states[1:])
    buffer, advance = plain.fine.buffer()
    for k, array in enumerate((x, np.zeros(1), left, right, p, np.zeros(1))):
        buffer.set_arg(k, array.data)
    buffer.set_res(0, end.data)
    for k in range(len(out)):
        x[:], left[:], right[:] = states[k], torque[k], torque[k + 1]
        advance()
        out[k] = end
    return out


def _over_a_sample(A: np.ndarray, B: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """x' = A x + B u over h with u held, (N, n, n) and (N, n, k): the trapezium rule on h / 16, doubled four times."""
    n, eye, d = A.shape[1], np.eye(A.shape[1]), h / 16
    both = np.linalg.solve(eye - d / 2 * A, np.concatenate([eye + d / 2 * A, d * B], axis=2))
    F, D = both[:, :, :n], both[:, :, n:]
    for _ in range(4):
        D = D + F @ D
        F = F @ F
    return F, D
