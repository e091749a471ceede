"""The catalogue of effects that real machines have beyond the plain model, each declared once.

A declaration gives the places of an effect, magnitude and shapes with units, and hooks: its action on one sample.
Simulation, regressor, smoothing, diagnosis, documentation and tests follow from it, so adding an effect means adding
one entry to a group of `joint_effects`, `ground_effects` or `file_effects`. A shape has a default for simulation and a
grid of trial values for diagnosis.
"""

from __future__ import annotations

from excite.model.effects import file_effects, ground_effects, joint_effects
from excite.model.effects.effect import Effect


def _by_name(*effects: Effect) -> dict[str, Effect]:
    """Return effects by name. Raises ValueError for a name given twice."""
    found: dict[str, Effect] = {}
    for e in effects:
        if e.name in found:
            raise ValueError(f"{e.name}: two effects have this name")
        found[e.name] = e
    return found


CATALOGUE = _by_name(
    *joint_effects.FRICTION,
    *joint_effects.DRIVES,
    *joint_effects.PERIODIC,
    *ground_effects.SOIL,
    *ground_effects.TABLES,
    *ground_effects.FORCES,
    *joint_effects.ARTICULATION,
    *file_effects.MACHINE_FILE,
    *file_effects.SENSORS,
)
