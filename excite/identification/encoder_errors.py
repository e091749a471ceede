"""Readings of angles without the errors that a machine file's effects say their sensors have."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from excite.logs import Log, samples
from excite.model import Model
from excite.model.effects import PlacedEffect
from excite.model.machine import Filter

CORRECTIONS = 5  # turns after which an error of a tenth is corrected to 1e-6; chosen


def is_encoder_error(model: Model, e: PlacedEffect) -> bool:
    """Tell if an effect is an error of angle sensors alone."""
    kinds = {s.name: s.kind for s in model.machine.sensors("full")}
    return e.effect.sensor_only and bool(e.sensors) and all(kinds[name] == "angle" for name in e.sensors)


def correct_angles(model: Model, log: Log, filter: Filter) -> Log:
    """Subtract the errors of angle sensors, with the magnitudes of the machine file, along the filtered motion.

    An error is that at the true motion, found from the misread one in CORRECTIONS turns.
    """
    wrong = {name for e in model.effects if is_encoder_error(model, e) for name in e.sensors} & log.values.keys()
    corrected = log
    for _ in range(CORRECTIONS if wrong else 0):
        errors = _angle_errors(model, corrected, filter, wrong)
        corrected = replace(log, values={n: x - errors.get(n, 0.0) for n, x in log.values.items()})
    return corrected


def _angle_errors(model: Model, log: Log, filter: Filter, wrong: Collection[str]) -> dict[str, np.ndarray]:
    """Return the errors (N,) [rad, m or per s] of some angle sensors, by name, along the filtered motion of a log."""
    machine, motion = model.machine, samples(model, log, filter)
    u, z = motion.beside
    wheels = np.zeros((sum(s.kind == "wheel" for s in machine.sensor), len(log)))
    read = model.read(motion.q, motion.nu, wheels, u, z, model.nominal).full()
    errors = {}
    for sensor in machine.sensors("full"):
        if sensor.name in wrong:
            body = machine.find(sensor.body)
            exact = (motion.nu if sensor.is_rate else motion.q)[model.coordinates.index(machine.coordinate(body))]
            errors[sensor.name] = read[model.reading_names.index(sensor.name)] - machine.ratio(body) * exact
    return errors
