"""A rig with exact dry friction: one mass that sticks until the force exceeds the friction, simulated by events."""

from __future__ import annotations

import numpy as np
import pandas as pd

TRUTH = {"M": 95.1089, "Fv": 203.5034, "Fc": 20.3935, "offset": -3.1648}
GAIN = 35.1507  # force per volt of the drive [N/V]
RATE = 1000  # [Hz]
SUBSTEPS = 10  # of a sample, in which the force is constant


def sticking_log(
    seed: int, seconds: float = 25.0, force_noise: float = 0.2, position_noise: float = 5e-8
) -> pd.DataFrame:
    """A log of the machine `emps` (columns t, qm, vir) under its own position controller.

    The force is linear between samples and held over a tenth of one, so motion between events is known in closed form.
    """
    rng = np.random.default_rng(seed)
    M, Fv, Fc, offset = TRUTH.values()
    n, dt = round(seconds * RATE) + 1, 1 / RATE
    t = np.arange(n) * dt
    reference = _reference(t, rng)
    speed = np.gradient(reference, dt)
    x, v = reference[0], 0.0
    position, force = np.empty(n), np.empty(n)
    position[0], force[0] = x, 0.0
    for k in range(1, n):
        wanted = 1.6e5 * (reference[k - 1] - x) + 6e3 * (speed[k - 1] - v)
        force[k] = float(np.clip(wanted, -150.0, 150.0))
        for part in (np.arange(SUBSTEPS) + 0.5) / SUBSTEPS:
            u = force[k - 1] + part * (force[k] - force[k - 1])
            x, v = advance(x, v, u - offset, dt / SUBSTEPS, M, Fv, Fc)
        position[k] = x
    measured = force + force_noise * rng.standard_normal(n)
    return pd.DataFrame({"t": t, "qm": position + position_noise * rng.standard_normal(n), "vir": measured / GAIN})


def _reference(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A smooth motion with a few reversals and changes of speed."""
    f, a, p = 0.1 + 0.1 * np.arange(8), 0.04 / (1 + np.arange(8)), rng.uniform(0, 2 * np.pi, 8)
    x = sum(ai * np.sin(2 * np.pi * fi * t + pi) for fi, ai, pi in zip(f, a, p, strict=True))
    fade = np.clip(t / 1.0, 0, 1) * np.clip((t[-1] - t) / 1.0, 0, 1)
    return np.asarray(x * fade * fade * (3 - 2 * fade))


def advance(x: float, v: float, u: float, dt: float, M: float, Fv: float, Fc: float) -> tuple[float, float]:
    """Return position and speed after a time under a constant force u, with friction that is exactly set-valued."""
    left = dt
    while left > 0:
        if v == 0.0:
            if abs(u) <= Fc:
                return x, 0.0
            sign = np.sign(u)
        else:
            sign = np.sign(v)
        end = (u - sign * Fc) / Fv  # speed that is approached
        tau = M / Fv
        stop = tau * np.log((v - end) / -end) if v != 0.0 and sign * end < 0 else np.inf
        h = min(left, stop)
        decay = np.exp(-h / tau)
        x += end * h + (v - end) * tau * (1 - decay)
        v = 0.0 if h == stop else end + (v - end) * decay
        left -= h
    return x, v
