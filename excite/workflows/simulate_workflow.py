"""`excite simulate`: a profile and effects in, the log that the sensors would write out."""

from __future__ import annotations

from collections.abc import Sequence

from excite.model import Model, build, effects


def with_effects(model: Model, texts: Sequence[str], samples: int) -> Model:
    """The model with effects more, NAME[@WHERE]=MAGNITUDE each, for a drive of so many samples. Raises MachineError."""
    if not texts:
        return model
    seconds = (samples - 1) / float(model.machine.sampling_hz)
    entries = [effects.parse_effect(text, model.machine, seconds) for text in texts]
    return build(effects.with_effects(model.machine, *entries))


def doubtful_effects(model: Model, extended: Model) -> list[str]:
    """A line for each effect that an extended model has more than a model, if its magnitude is doubtful."""
    added = extended.machine.effect[len(model.machine.effect) :]
    placed = (effects.place_effect(model.machine, entry) for entry in added)
    return [line for e in placed if (line := effects.size_warning(model.machine, e)) is not None]
