"""Readings of angles without the errors that a machine file's effects say their sensors have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from excite.logs import Log, samples
from excite.model import Model
from excite.model.effects import PlacedEffect
from excite.model.machine import Filter


def is_encoder_error(model: Model, e: PlacedEffect) -> bool:
    """Tell if an effect is an error of angle sensors alone."""
    kinds = {s.name: s.kind for s in model.machine.sensors("full")}
    return e.effect.sensor_only and bool(e.sensors) and all(kinds[name] == "angle" for name in e.sensors)


def correct_angles(model: Model, log: Log, filter: Filter) -> Log:
    """Subtract the errors of angle sensors, with the magnitudes of the machine file, along the filtered motion."""
    wrong = {name for e in model.effects if is_encoder_error(model, e) for name in e.sensors} & log.values.keys()
    if not wrong:
        return log
    machine, motion = model.machine, samples(model, log, filter)
    u, z = motion.beside
    wheels = np.zeros((sum(s.kind == "wheel" for s in machine.sensor), len(log)))
    read = model.read(motion.q, motion.nu, wheels, u, z, model.nominal).full()
    values = dict(log.values)
    for sensor in machine.sensors("full"):
        if sensor.name in wrong:
            body = machine.find(sensor.body)
            exact = (motion.nu if sensor.is_rate else motion.q)[model.coordinates.index(machine.coordinate(body))]
            error = read[model.reading_names.index(sensor.name)] - machine.ratio(body) * exact
            values[sensor.name] = log.values[sensor.name] - error
    return replace(log, values=values)
