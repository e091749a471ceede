"""How unsure an effect's amount is for shapes that the logs hardly tell, where its deviation in a fit doesn't say.

Of soil that was hardly packed, say, nothing tells how much of it is to come: where a fit ends at a short way that a
pass takes, its amount looks as sure as if all had.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from excite.diagnosis import selection
from excite.diagnosis.fits import Stage, refits
from excite.diagnosis.parallel import Together
from excite.model import effects
from excite.model.effects import PlacedEffect, Site
from excite.model.machine import Machine, Quantity

HARDLY = 0.5  # deviation of a shape, as a share of that without any log, from which logs hardly tell it
APART = 2.0  # deviations by which another shape may be worse that logs like about as well


def unsure(placed: PlacedEffect, after: Stage, together: Together) -> float:
    """How unsure an effect's amount is for shapes that the logs hardly tell: by how much it is another one with such a
    shape at either end of its usual range, or halfway there, where the logs like that about as well. The deviation of
    a fit holds for shapes nearby only."""
    fit, names = after.fit, after.model.base.names
    known = after.model.scale / np.sqrt(fit.prior)  # without any log
    told = ~fit.unidentifiable & (fit.std < HARDLY * known)
    entry, own = selection.entry_of(after, placed.name), [placed.name, *(f"{placed.name}.{s}" for s in placed.shapes)]
    wishes: list[tuple[Machine, Stage, float]] = []
    held: list[str] = []
    for s in placed.shapes:
        if (name := f"{placed.name}.{s}") not in names or told[k := names.index(name)]:
            continue
        for end in _usual(placed, s, after.machine):
            for x in ((fit.X[k] + end) / 2, end) if end != fit.X[k] else ():
                value = Quantity(value=float(x), source="assumed")
                other = entry.model_copy(update={"shape": {**entry.shape, s: value}})
                machine = effects.with_effects(effects.without_effect(after.machine, placed.name), other)
                wishes.append((machine, after, fit.process_noise))
                held.append(name)
    most = fit.cost + APART**2 * after.spread
    liked = _cost_of_data(after, own) + APART**2 * after.spread
    found = [x for x in refits(wishes, together, most, held) if x is not None and _cost_of_data(x, own) < liked]
    every = [x.fit.X[x.model.base.names.index(placed.name)] for x in found]
    return max((abs(float(a - fit.X[names.index(placed.name)])) / APART for a in every), default=0.0)


def _usual(placed: PlacedEffect, name: str, machine: Machine) -> tuple[float, ...]:
    """The ends of the range that a shape is usually in: of all that is tried in this form, and of what there is. None
    of an instant, which a log tells or not."""
    shape, site = placed.effect.shapes[name], Site.of(machine, placed.bodies)
    if shape.signed or shape.size is effects.duration:
        return ()
    size = shape.size(site)
    every = [x * size for x in (*shape.grid, *(shape.within or ()))]
    every += [b[name] for b in placed.extra_trials(site) if name in b]
    return min(every), max(every)


def _cost_of_data(stage: Stage, names: Sequence[str]) -> float:
    """What a fit costs without what was known before of these parameters."""
    fit, model = stage.fit, stage.model
    own = np.isin(model.base.names, names)
    return fit.cost - float(fit.prior[own] @ ((fit.X - model.nominal) / model.scale)[own] ** 2)
