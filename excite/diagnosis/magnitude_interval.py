"""Uncertainty of an effect's magnitude through shapes that the logs hardly determine.

The covariance of a fit holds near its optimum only. If the soil was hardly compacted, for example, the logs do not say
how much of the compaction is still to come: at a short compaction distance the magnitude looks falsely certain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from excite.diagnosis import selection
from excite.diagnosis.fits import ExtendedFit, refit_all
from excite.diagnosis.parallel import CallRunner
from excite.model import effects
from excite.model.effects import PlacedEffect, Site
from excite.model.machine import Machine, Quantity

WEAK_SHAPE_RATIO = 0.5  # standard deviation over that of the prior from which a shape is weakly determined; chosen
ACCEPTED_COST_STDS = 2.0  # standard deviations that a refit may be worse; chosen: a 95 % interval


def std_over_weak_shapes(placed: PlacedEffect, after: ExtendedFit, runner: CallRunner) -> float:
    """Return the standard deviation of a magnitude over weakly determined shapes.

    Each such shape is held at both ends of its usual range, and half-way there, and the model is refitted. The largest
    change of the magnitude among refits that cost about as much counts.
    """
    fit, names = after.fit, after.model.base.names
    prior_std = after.model.scale / np.sqrt(fit.prior)  # standard deviations without any log
    determined = ~fit.unidentifiable & (fit.std < WEAK_SHAPE_RATIO * prior_std)
    entry = selection.fitted_entry(after, placed.name)
    own = [placed.name, *(f"{placed.name}.{s}" for s in placed.shapes)]
    machines: list[Machine] = []
    held: list[str] = []
    for s in placed.shapes:
        if (name := f"{placed.name}.{s}") not in names or determined[k := names.index(name)]:
            continue
        for end in _usual_range(placed, s, after.machine):
            for x in ((fit.X[k] + end) / 2, end) if end != fit.X[k] else ():
                value = Quantity(value=float(x), source="assumed")
                other = entry.model_copy(update={"shape": {**entry.shape, s: value}})
                machines.append(effects.with_effects(effects.without_effect(after.machine, placed.name), other))
                held.append(name)
    data_cost_limit = _cost_of_data(after, own) + ACCEPTED_COST_STDS**2 * after.dispersion
    found = [
        x for x in refit_all(machines, after, runner, held) if x is not None and _cost_of_data(x, own) < data_cost_limit
    ]
    magnitudes = [x.fit.X[x.model.base.names.index(placed.name)] for x in found]
    return max((abs(float(a - fit.X[names.index(placed.name)])) / ACCEPTED_COST_STDS for a in magnitudes), default=0.0)


def _usual_range(placed: PlacedEffect, name: str, machine: Machine) -> tuple[float, ...]:
    """Return the ends of a shape's usual range, from its trial values; nothing for signed shapes and for times."""
    shape, site = placed.effect.shapes[name], Site.of(machine, placed.bodies)
    if shape.signed or shape.size is effects.duration:
        return ()
    size = shape.size(site)
    values = [x * size for x in (*shape.grid, *(shape.within or ()))]
    values += [b[name] for b in placed.extra_trials(site) if name in b]
    return min(values), max(values)


def _cost_of_data(stage: ExtendedFit, names: Sequence[str]) -> float:
    """Return the cost of a fit without the prior of the given parameters."""
    fit, model = stage.fit, stage.model
    own = np.isin(model.base.names, names)
    return fit.cost - float(fit.prior[own] @ ((fit.X - model.nominal) / model.scale)[own] ** 2)
