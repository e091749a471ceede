"""Slips along a motion: how much of it lies beyond the range in which the soil law is linear."""

from __future__ import annotations

import numpy as np

from excite.model import Model
from excite.simulation.integrator import Motion

BATCH = 8192  # samples evaluated at a time


def resultant_slips(model: Model, q: np.ndarray, nu: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return the resultant slips |g| (N, n_edges) [-] at the model's `edges`; q, nu (N, n_q).

    X (n_base,): base parameters, of which the encoder zeros matter.
    """
    slips = model.edge_slips(model.true_coordinates(q, X).T, nu.T).full().reshape(2, len(q), len(model.edges))
    return np.asarray(np.hypot(*slips))


def outside_law(model: Model, q: np.ndarray, nu: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return the samples (N,), bool, in which a contact slips more than its linear law allows.

    Arguments are those of `resultant_slips`.
    What counts is the resultant slip at both edges against `slip_limit`. Contacts of another law, or without a limit,
    do not count.
    """
    contacts = [model.machine.find(index).contact for index, _ in model.edges]
    limits = [
        float(c.slip_limit) if c is not None and c.slip_limit is not None and c.law == "linear" else np.inf
        for c in contacts
    ]
    return np.concatenate(
        [
            (resultant_slips(model, q[k : k + BATCH], nu[k : k + BATCH], X) > np.array(limits)).any(axis=1)
            for k in range(0, len(q), BATCH)
        ]
    )


def share_outside_law(model: Model, motion: Motion) -> float:
    """Return the share of a nominal motion's samples that lie outside the linear soil law (see `outside_law`)."""
    return float(outside_law(model, motion.q, motion.nu, model.nominal).mean())
