"""Sensitivities of predicted signals to the parameters: a drive must show these to predict another one."""

from __future__ import annotations

import numpy as np

from excite.errors import SimulationError
from excite.model import Model
from excite.simulation import Motion, effect_inputs, simulate
from excite.trajectories.objective import reference_values

DIFFERENCE_STEP = 1e-3  # of each parameter, relative to its reference value; chosen
SIGNAL_SAMPLES = 50  # samples of each signal that count; chosen


def prediction_contrasts(model: Model, motion: Motion) -> np.ndarray:
    """Return contrasts (n_base, m): changes of predicted signals by relative errors of the parameters.

    motion: of the nominal machine along the drive to predict. With contacts that slip, the signals are the velocities
    under the same torques, from the same start, in open loop; without, the torques that the motion needs. Each is
    divided by its root mean square along the drive, so that the square root of a variance G' C G is a share of that.

    Raises SimulationError if a machine next to the nominal one can't be simulated, or if nothing moves.
    """
    by = reference_values(model)
    if model.slips:
        change = _open_loop_changes(model, motion, by)
        signals = motion.nu.T
    else:
        W = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T, *effect_inputs(model, motion))
        change = W[:, list(model.actuated)].swapaxes(0, 1) * np.where(_acts(model), by, 0.0)
        signals = motion.u.T
    size = np.sqrt(np.mean(signals**2, axis=1))
    kept = size > 1e-6 * size.max()
    if not kept.any():
        raise SimulationError("the drive to predict stands still: nothing is there to predict")
    chosen = np.unique(np.linspace(0, change.shape[1] - 1, SIGNAL_SAMPLES + 1).round().astype(int))[1:]
    rows = (change[kept][:, chosen] / size[kept, None, None]).reshape(-1, len(by))
    return np.asarray(rows[np.abs(rows).max(axis=1) > 0].T)


def _acts(model: Model) -> np.ndarray:
    """Return for each parameter (n_base,) whether it acts on the machine: an offset belongs to its torque sensor."""
    return ~np.any(model.offsets != 0, axis=0)


def _open_loop_changes(model: Model, motion: Motion, by: np.ndarray) -> np.ndarray:
    """Return changes of the velocities (n_q, N, n_base) per relative error, by central differences of simulations."""
    found = np.zeros((motion.nu.shape[1], len(motion.t), len(by)))
    for k in np.flatnonzero(_acts(model)):
        step = np.zeros(len(by))
        step[k] = DIFFERENCE_STEP * by[k]
        ends = [simulate(model, motion.u, model.nominal + s * step, motion.q[0], motion.nu[0]).nu.T for s in (1, -1)]
        found[:, :, k] = (ends[0] - ends[1]) / (2 * DIFFERENCE_STEP)
    return found
