"""The Cramer-Rao bound of a motion: the best accuracy that its sensors allow.

The covariance of joint smoothing along a motion that is known exactly, with no measurement at all.
"""

from __future__ import annotations

import numpy as np

from excite.model import Model
from excite.simulation import Motion, measured_torques
from excite.smoothing.gauss_newton import PRIOR, in_si, linearise_fit
from excite.smoothing.linearisation import chart
from excite.smoothing.measurements import Noise, Point, Record, expected, origins, torque_sensor


def cramer_rao(model: Model, motion: Motion, kit: str = "full", X: np.ndarray | None = None) -> np.ndarray:
    """The covariance (n_base, n_base) that a kit's sensors make attainable along a motion: the Cramer-Rao bound of a
    model of them in which every noise is normal.

    The machine file's noise; an encoder tells something as often as it counts, and its edges are off by a tenth of a
    count at least (a perfect encoder on a slow machine tells more than that). A weak prior (300 % of each scale) stays
    in, so that a parameter which the drive doesn't show has a large deviation and not an infinite one.
    Raises ValueError where a sensor has neither noise nor counts.
    """
    X = model.nominal if X is None else np.asarray(X, float)
    sensors = [s for s in model.machine.sensors(kit) if s.kind not in ("x", "y")]
    for s in sensors:
        if not s.graded:
            raise ValueError(
                f"{model.machine.name}: sensor {s.name}: give noise or counts_per_turn in the machine file"
            )
    c = chart(model, tuple(s.name for s in model.machine.sensors("full") if s in sensors))
    full = np.hstack([motion.q, motion.nu, motion.wheels, motion.memory])
    state, over = c.charted(full)
    counts = np.array([s.resolution is not None for s in c.sensors])
    noise = Noise(
        np.array([float(torque_sensor(model, b.index).noise or 0) for b in model.machine.actuated]),
        np.array([s.resolution or float(s.noise or 0) for s in c.sensors]),
    )
    none = np.zeros((len(state), len(c.sensors)))
    r = Record(measured_torques(model, motion.t, motion.u, X), none, none, counts, origins(c, counts), noise)
    p = Point(state, np.zeros_like(motion.u[1:]), np.zeros(len(r.origin)), over)
    linear = linearise_fit(c, expected(c, r, p, motion.u, X), p, state[0], X, 0.0, exact=True)
    assert linear is not None
    information = linear.Z[1:, 1:].copy()
    information[np.diag_indices(len(information))] += np.concatenate(
        [np.full(len(X), PRIOR**-2), np.ones(len(r.origin))]
    )
    return in_si(c, np.linalg.inv(information))
