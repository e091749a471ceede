"""The next drive after a first log: what is known becomes the nominal machine and counts as information already there.

The estimate of the logs (joint smoothing) replaces the nominal values, its inverse covariance is the information that a
design adds its own to (Fedorov, "Theory of Optimal Experiments", 1972, ch. 4: sequential design at the estimate).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import NotIdentifiableError
from excite.identification.estimate import Estimate
from excite.identification.methods import identify
from excite.logs import Log
from excite.model import Model, required_signs

POSE_COUNT = 181  # at which the mass matrix is looked at
STEP_SHARES = np.linspace(1, 0, 21)


@dataclass(frozen=True)
class PriorKnowledge:
    """What logs tell: the model with its estimate as nominal, and its information (n_base, n_base) [1/SI^2].

    share: how much of the way from the machine file's values to the estimate the new nominal went; below 1 where the
    estimate itself has no positive definite mass matrix.
    """

    model: Model
    information: np.ndarray
    estimate: Estimate
    share: float


def prior_from_logs(model: Model, logs: Sequence[Log]) -> PriorKnowledge:
    """What logs tell of a machine. Parameters that they hardly show keep the machine file's value, and no information.

    Raises NotIdentifiable where the logs give no machine that is physically possible, and what `identify` raises.
    """
    return prior_from_estimate(model, identify(model, logs, "joint"))


def prior_from_estimate(model: Model, estimate: Estimate) -> PriorKnowledge:
    """The same of an estimate that is there already."""
    seen = np.isfinite(estimate.value)
    information = np.zeros((len(seen), len(seen)))
    at = np.ix_(seen, seen)
    by = np.outer(model.scale[seen], model.scale[seen])
    information[at] = np.linalg.inv(estimate.covariance[at] / by) / by
    X = np.where(seen, estimate.value, model.nominal)
    for share in STEP_SHARES:
        nominal = model.nominal + float(share) * (X - model.nominal)
        if _is_possible(model, nominal):
            floor = [float(model.machine.scale.get(n, 0.0)) for n in model.base.names]
            scale = np.where(np.array(floor) > 0, floor, np.abs(nominal))
            scale = np.where(scale > 0, scale, model.scale)
            return PriorKnowledge(replace(model, nominal=nominal, scale=scale), information, estimate, float(share))
    raise NotIdentifiableError("the machine file's own values have no positive definite mass matrix")


def _is_possible(model: Model, X: np.ndarray) -> bool:
    """Whether the mass matrix is positive definite all over the joints' range, and friction and contacts resist."""
    q = np.zeros((len(model.coordinates), POSE_COUNT))
    for body in model.machine.body:
        for c in body.coordinates:
            if c in model.active_coordinates:
                wide = float(body.limit.position) if body.limit.position is not None else np.pi
                q[model.coordinates.index(c)] = np.linspace(-wide, wide, POSE_COUNT)
    if not (model.pivots(q, X).full() > 0).all():
        return False
    of = required_signs(model.machine)
    sign = np.array([of.get(model.base.standard[k], 0.0) for k in model.base.independent])
    return bool((X * sign >= 0)[model.nominal != 0].all())  # of none an estimate may be a little less
