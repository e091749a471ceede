"""Noise of sensors in SI units: a file gives it in the unit of the sensor's column, or in a `noise_unit`."""

from __future__ import annotations

import numpy as np

from excite.model.machine import hydraulics, units
from excite.model.machine.machine import Machine
from excite.model.machine.sensor import IN_SI, Sensor


def si_per_number(machine: Machine, sensor: Sensor) -> float:
    """Return the size of the SI reading per number in a sensor's column; of cylinders in the middle of their range."""
    if not sensor.cylinders:
        return abs(sensor.gain)
    low, high = machine.find(sensor.body).limit.position_range or (0.0, 0.0)
    middle = np.array([(low + high) / 2])
    both = hydraulics.torque_per_pressure(sensor.displacement, sensor.cylinders, middle)
    return abs(sensor.gain) * max(float(np.abs(side).max()) for side in both)


def noise_of(machine: Machine, sensor: Sensor) -> float:
    """Return the standard deviation [SI] of a sample that the file gives a sensor, 0 without one."""
    if sensor.noise is None:
        return 0.0
    unit = sensor.noise_unit or (IN_SI if machine.noise_unit == IN_SI else sensor.unit)
    if unit == IN_SI:
        return float(sensor.noise)
    if unit == sensor.unit:
        return float(sensor.noise) * si_per_number(machine, sensor)
    quantity, one = units.UNITS[unit]
    if sensor.factor is None and quantity == units.UNITS[sensor.unit][0]:
        return float(sensor.noise) * one / units.UNITS[sensor.unit][1] * si_per_number(machine, sensor)
    return float(sensor.noise) * one
