"""Estimate of earlier logs as the prior of the next design (sequential design).

The estimate by joint smoothing replaces the nominal values, and its inverse covariance is information to which a design
adds its own. Source: Fedorov, "Theory of Optimal Experiments", 1972, ch. 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import NotIdentifiableError
from excite.identification.estimate import Estimate
from excite.identification.methods import identify
from excite.logs import Log
from excite.model import Model, build, nothing_known, required_signs

POSE_COUNT = 181  # poses at which the mass matrix is checked; chosen
STEP_SHARES = np.linspace(1, 0, 21)  # of the way from the nominal values to the estimate; chosen


@dataclass(frozen=True)
class PriorKnowledge:
    """Model with the estimate of earlier logs as nominal values, and its information (n_base, n_base) [1/SI^2].

    share: part of the way from the machine file's values to the estimate; below 1 if the estimate itself is not a
    possible machine.
    """

    model: Model
    information: np.ndarray
    estimate: Estimate
    share: float


def prior_from_logs(model: Model, logs: Sequence[Log]) -> PriorKnowledge:
    """Build the prior from logs; unidentifiable parameters keep the machine file's value and get no information.

    Effects that only sensors show are estimated beside, also where they are no parameters of the model.

    Raises NotIdentifiableError if the logs give no possible machine, and what `identify` raises.
    """
    estimate = identify(model if model.fit_sensor_effects else build(model.machine), logs, "joint")
    if estimate.status == "invalid":
        raise NotIdentifiableError(f"the logs give no estimate: {estimate.doubt}")
    return prior_from_estimate(model, estimate)


def prior_from_estimate(model: Model, estimate: Estimate) -> PriorKnowledge:
    """Build the prior from an estimate of the model's parameters, among others.

    Raises NotIdentifiableError if it gives no possible machine.
    """
    own = [estimate.names.index(n) for n in model.base.names]
    value, covariance = estimate.value[own], estimate.covariance[np.ix_(own, own)]
    identified = np.isfinite(value)
    information = np.zeros((len(identified), len(identified)))
    block = np.ix_(identified, identified)
    scales = np.outer(model.scale[identified], model.scale[identified])
    information[block] = np.linalg.inv(covariance[block] / scales) / scales
    X = np.where(identified, value, model.nominal)
    for share in STEP_SHARES:
        nominal = model.nominal + float(share) * (X - model.nominal)
        if _is_possible(model, nominal):
            smallest = [float(model.machine.scale.get(n, 0.0)) for n in model.base.names]
            scale = np.where(np.array(smallest) > 0, smallest, np.abs(nominal))
            scale = np.where(scale > 0, scale, model.scale)
            # The information includes what the machine file calls known.
            changed = replace(model, nominal=nominal, scale=scale, known=nothing_known(len(nominal)))
            return PriorKnowledge(changed, information, estimate, float(share))
    raise NotIdentifiableError("the machine file's own values have no positive definite mass matrix")


def _is_possible(model: Model, X: np.ndarray) -> bool:
    """True if the mass matrix is positive definite in the joints' range, and friction and contacts dissipate."""
    q = np.zeros((len(model.coordinates), POSE_COUNT))
    for body in model.machine.body:
        for c in body.coordinates:
            if c in model.active_coordinates:
                low, high = body.limit.position_range or (-np.pi, np.pi)
                q[model.coordinates.index(c)] = np.linspace(low, high, POSE_COUNT)
    if not (model.pivots(q, X).full() > 0).all():
        return False
    signs = required_signs(model.machine)
    sign = np.array([signs.get(model.base.standard[k], 0.0) for k in model.base.independent])
    return bool((X * sign >= 0)[model.nominal != 0].all())  # a nominal zero may be estimated slightly below
