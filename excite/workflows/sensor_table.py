"""Sensors of a machine file as a table: noise in the column's unit and in SI, resolution, reading at the limit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from excite.model.machine import UNITS, Machine, Sensor, noise_of, si_per_number
from excite.text import format_number

CURRENT = (0.02, 2000.0)  # [A] of motors at the limit of torque; chosen
PRESSURE = (20e5, 1000e5)  # [Pa] at the limit of torque; chosen
FINEST = 1e-6  # noise over the reading at the limit: a converter of 20 bits, below which no sensor is; chosen
LEAST_NOISE = {"pressure": 100.0, "current": 1e-6}  # [Pa, A] of any sensor; chosen
MOST_TURNING = 0.2  # [rad, rad/s] of noise of a sensor without a limit; chosen
MOST_NOISE = 0.5  # of the reading at the limit; chosen


def sensor_rows(machine: Machine) -> list[dict[str, Any]]:
    """Return a row for each sensor: column, unit, rate [Hz], noise, its SI value, resolution, reading at the limit.

    None where the file gives none.
    """
    return [
        {
            "name": s.name,
            "columns": list(s.columns),
            "unit": s.unit,
            "rate_hz": float(s.rate_hz or machine.sampling_hz),
            "noise": (noise_of(machine, s) / si_per_number(machine, s)) or None,
            "noise_si": noise_of(machine, s) or None,
            "si_unit": machine.si_unit(s),
            "resolution": _resolution(machine, s),
            "at_limit": reading_at_limit(machine, s),
        }
        for s in machine.sensors("full")
    ]


def _resolution(machine: Machine, s: Sensor) -> float | None:
    """Return the smallest step of a reading in the unit of its column."""
    step = s.resolution if s.step is None else float(s.step)
    return None if step is None else step / si_per_number(machine, s)


def reading_at_limit(machine: Machine, s: Sensor) -> float | None:
    """Return what a column reads at the limit of what its sensor measures, in the unit of the column."""
    body = machine.find(s.body)
    limit, rate = body.limit, None
    if s.kind == "angle" and s.is_rate:
        rate = float(limit.rate) if limit.rate is not None else None
        if limit.rim_speed is not None and body.contact is not None:
            rate = float(limit.rim_speed) / float(body.contact.radius)
    torque = None if limit.torque is None or machine.in_ratios else float(limit.torque)
    top = {"torque": torque, "angle": rate if s.is_rate else limit.reach}.get(s.kind)
    return None if top is None else top / si_per_number(machine, s)


def doubt_sensors(machine: Machine) -> Iterator[str]:
    """Find noise that no such sensor has, gear ratios that are upside down, and currents or pressures beyond usual."""
    for s in machine.sensors("full"):
        top = reading_at_limit(machine, s)
        ratio = abs(float(s.gear_ratio)) if s.gear_ratio is not None else 1.0
        kind = UNITS.get(s.unit, ("", 1.0))[0] if s.factor is None else ""
        yield from _doubt_noise(machine, s, top, kind)
        amperes = top * UNITS[s.unit][1] if top is not None and kind == "current" else None
        takes = f"limit.torque takes {format_number(amperes, 3)} A" if amperes is not None else ""
        if ratio < 1:
            turns = f"1 / {ratio:g} = {format_number(1 / ratio, 3)} turns of the motor per turn of the joint"
            what = takes or "the motor turns slower than its joint"
            yield f"sensor {s.name}: gear_ratio: {ratio:g}: {what}: upside down? ({turns})"
        elif amperes is not None and not CURRENT[0] <= amperes <= CURRENT[1]:
            key = "torque_constant" if s.gear_ratio is None else "gear_ratio"
            yield (
                f"sensor {s.name}: {key}: {takes}, usual are {CURRENT[0]:g} to {CURRENT[1]:g}: upside down, or another"
                " unit?"
            )
        elif s.cylinders and kind == "pressure" and top is not None:
            bar = top * UNITS[s.unit][1]
            if not PRESSURE[0] <= bar <= PRESSURE[1]:
                yield (
                    f"sensor {s.name}: cylinders: limit.torque takes {format_number(bar / 1e5, 3)} bar, usual are"
                    f" {PRESSURE[0] / 1e5:g} to {PRESSURE[1] / 1e5:g}: area, lever or limit in another unit?"
                )


def _doubt_noise(machine: Machine, s: Sensor, top: float | None, kind: str) -> Iterator[str]:
    """Compare a noise with the reading at the limit."""
    noise = noise_of(machine, s) / si_per_number(machine, s)
    if not noise:
        return
    least = LEAST_NOISE.get(kind, 0.0) / UNITS.get(s.unit, ("", 1.0))[1]
    said = f"sensor {s.name}: noise: {format_number(noise, 3)} {s.unit}"
    if top is not None and math.isfinite(top) and noise > MOST_NOISE * top:
        yield f"{said} beside {format_number(top, 3)} {s.unit} at the limit: in another unit?"
    elif top is None and machine.si_unit(s).startswith("rad") and noise_of(machine, s) > MOST_TURNING:
        yield f"{said}, usual are {MOST_TURNING:g} {machine.si_unit(s)} at most: in degrees?"
    elif noise < max(FINEST * (top or 0.0), least):
        yield f"{said}: no such sensor has so little: in another unit?"
