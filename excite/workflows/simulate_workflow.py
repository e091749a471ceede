"""`excite simulate`: effects of a simulated machine, from their text on the command line."""

from __future__ import annotations

from collections.abc import Sequence

from excite.model import Model, build, effects


def with_effects(model: Model, texts: Sequence[str], samples: int) -> Model:
    """Add effects to a model, NAME[@WHERE]=MAGNITUDE each, for a drive of some samples. Raises MachineError."""
    if not texts:
        return model
    seconds = (samples - 1) / float(model.machine.sampling_hz)
    entries = [effects.parse_effect(text, model.machine, seconds) for text in texts]
    return build(effects.with_effects(model.machine, *entries))


def doubtful_effects(model: Model, extended: Model) -> list[str]:
    """Return a line for each effect that only the extended model has and whose magnitude is doubtful."""
    added = extended.machine.effect[len(model.machine.effect) :]
    placed = (effects.place_effect(model.machine, entry) for entry in added)
    return [line for e in placed if (line := effects.size_warning(model.machine, e)) is not None]
