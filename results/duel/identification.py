"""Identify a rig whose truth is known, by this program and by the usual output-error fit written with SciPy.

Simulated logs of a mass on a slide (tests/support/rig.toml: M 95.1 kg, Fv 203.5 N s/m, Fc 20.4 N, offset -3.16 N),
10 s, with noise on the force (1 N) and the position. The output-error fit simulates the position from the measured
force in stretches of 5 s, whose initial states are free, and fits it by `scipy.optimize.least_squares`.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

import excite
from excite.errors import ExciteError

RIG = Path(__file__).parents[2] / "tests" / "support" / "rig.toml"
NAMES = ("M", "Fv", "Fc", "offset")
TRUTH = np.array([95.1, 203.5, 20.4, -3.16])
SMOOTHING = 0.001  # m/s, of sgn in the rig's friction
STRETCH = 500  # samples; 5 s
SUBSTEPS = 10  # of RK4 per sample
START = 1.3  # first guess over the truth
METHODS = ("joint", "oe", "ols")  # of this program
Z95 = 1.96


def drive(seconds: float = 10.0, rate: float = 100.0) -> np.ndarray:
    """Return the forces (N, 1) [N] of the drive: three sines."""
    t = np.arange(round(seconds * rate) + 1) / rate
    fade = np.clip(t / 0.5, 0, 1)
    u = 70 * np.sin(2 * np.pi * 0.7 * t) + 40 * np.sin(2 * np.pi * 1.3 * t + 1) + 25 * np.sin(2 * np.pi * 2.9 * t)
    return (fade * u)[:, None]


def positions(P: np.ndarray, u: np.ndarray, begins: np.ndarray, length: int, step: float) -> np.ndarray:
    """Return the positions (variants, stretches, length) under forces u (N,), by RK4.

    P (variants, 4 + 2 stretches): M, Fv, Fs, u0, initial positions and speeds.
    """
    M, Fv, Fs, u0 = (P[:, k, None] for k in range(4))
    q, v = (P[:, 4:].reshape(len(P), 2, -1)[:, k].copy() for k in range(2))
    found = np.empty((len(P), len(begins), length))
    found[:, :, 0] = q
    h = step / SUBSTEPS

    def a(force: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.asarray((force - u0 - Fv * v - Fs * np.tanh(v / SMOOTHING)) / M)

    for k in range(length - 1):
        left, right = u[begins + k], u[begins + k + 1]
        for s in range(SUBSTEPS):
            f0, f1, f2 = (left + (right - left) * (s + c) / SUBSTEPS for c in (0, 0.5, 1))
            a1 = a(f0, v)
            a2 = a(f1, v + h / 2 * a1)
            a3 = a(f1, v + h / 2 * a2)
            a4 = a(f2, v + h * a3)
            q = q + h * v + h**2 / 6 * (a1 + a2 + a3)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        found[:, :, k + 1] = q
    return found


def output_error(table: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return estimate and standard deviation (4,) of the output-error fit with SciPy."""
    t, q, u = (table[c].to_numpy() for c in ("t_s", "q_m", "u_N"))
    step = float(np.median(np.diff(t)))
    begins = np.arange(0, len(t) - STRETCH, STRETCH)
    length = STRETCH + 1
    seen = np.stack([q[b : b + length] for b in begins])
    speed = np.array([(q[b + 2] - q[b]) / (2 * step) for b in begins])
    first = np.concatenate([START * TRUTH, q[begins], speed])
    scale = np.concatenate([np.abs(TRUTH), np.full(len(begins), 0.01), np.full(len(begins), 0.1)])

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.asarray((positions((x * scale)[None], u, begins, length, step)[0] - seen).ravel() * 1e4)

    def jacobian(x: np.ndarray) -> np.ndarray:
        P = np.concatenate([x[None], x + 1e-6 * np.eye(len(x))]) * scale
        found = positions(P, u, begins, length, step).reshape(len(P), -1)
        return np.asarray((found[1:] - found[0]).T / 1e-6 * 1e4)

    done = least_squares(residuals, first / scale, jac=jacobian, max_nfev=60)
    variance = 2 * done.cost / (len(done.fun) - len(done.x))
    covariance = np.linalg.inv(done.jac.T @ done.jac) * variance
    return (done.x * scale)[:4], np.sqrt(np.diag(covariance))[:4] * scale[:4]


def contend(runs: int, seed: int) -> list[dict[str, Any]]:
    """Return of each contender the RMSE [%] of every parameter, coverage of the 95 % intervals and time per log."""
    tables = [excite.simulate(str(RIG), drive(), seed=seed + k) for k in range(runs)]
    rows = []
    for name in (*METHODS, "SciPy output error"):
        values, inside, failed, begin = [], [], 0, time.process_time()
        for table in tables:
            if name in METHODS:
                try:
                    found = excite.identify(str(RIG), table, method=name)
                except ExciteError:
                    failed += 1
                    continue
                order = [found.names.index(n) for n in NAMES]
                value, (low, high) = found.value[order], found.interval95[:, order]
            else:
                value, std = output_error(table)
                low, high = value - Z95 * std, value + Z95 * std
            values.append(value)
            inside.append((low <= TRUTH) & (high >= TRUTH))
        off = (np.array(values) / TRUTH - 1) * 100
        rows.append(
            {
                "name": f"excite, {name}" if name in METHODS else name,
                "rmse_percent": dict(zip(NAMES, np.sqrt(np.mean(off**2, axis=0)).tolist(), strict=True)),
                "coverage95": float(np.mean(inside)),
                "failed": failed,
                "processor_s_per_log": (time.process_time() - begin) / runs,
            }
        )
    return rows
