"""Logs that many tests share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from support.drives import gentle

from excite.diagnosis import fits
from excite.logs import Log, from_table
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.model.machine import EffectEntry
from excite.simulation import Motion, measure, sensors, simulate


def make_log(model: Model, motion: Motion, *args: Any, known: Model | None = None, **how: Any) -> Log:
    """The log of a motion of a machine as its sensors write it, checked by the machine that is known (itself).

    args, how: further arguments of `excite.simulation.measure`: seed, kit, noise.
    """
    return from_table(measure(model, motion, *args, **how), (known or model).machine)


def logged(model: Model, motion: Motion, path: Path, seed: int, *texts: str) -> Path:
    """The log of a motion's torques on a machine with effects, as the sensors write it."""
    entries = [placing.parse_effect(text, model.machine, float(motion.t[-1])) for text in texts]
    extended = prediction.build(placing.with_effects(model.machine, *entries)) if entries else model
    driven = simulate(extended, motion.u, q0=motion.q[0], nu0=motion.nu[0])
    sensors.measure(extended, driven, seed=seed).to_csv(path, index=False)
    return path


def calm(model: Model) -> fits.ExtendedFit:
    """The model fitted to a log of that without anything hidden."""
    one = make_log(model, gentle(model, 12.0), seed=3)
    return fits.fit_machine(model.machine, [one], model.machine.filter)


def slope(straight: Model) -> EffectEntry:
    """What `sloping` has hidden."""
    return placing.parse_effect("ground_slope=0.01", straight.machine, 40.0)
