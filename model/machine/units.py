"""Units of log columns: the quantity of each and its SI value, by definition."""

from __future__ import annotations

import math

TURN = 2 * math.pi  # rad
BAR = 1e5  # Pa
INCH = 0.0254  # m
POUND_FORCE = 4.4482216152605  # N

# unit -> (quantity, SI value of one unit)
UNITS: dict[str, tuple[str, float]] = {
    "rad": ("angle", 1.0),
    "mrad": ("angle", 1e-3),
    "deg": ("angle", TURN / 360),
    "°": ("angle", TURN / 360),
    "turn": ("angle", TURN),
    "rev": ("angle", TURN),
    "rad/s": ("angular rate", 1.0),
    "deg/s": ("angular rate", TURN / 360),
    "°/s": ("angular rate", TURN / 360),
    "rpm": ("angular rate", TURN / 60),
    "1/min": ("angular rate", TURN / 60),
    "Hz": ("angular rate", TURN),
    "m": ("length", 1.0),
    "cm": ("length", 1e-2),
    "mm": ("length", 1e-3),
    "km": ("length", 1e3),
    "in": ("length", INCH),
    "ft": ("length", 12 * INCH),
    "m/s": ("speed", 1.0),
    "mm/s": ("speed", 1e-3),
    "km/h": ("speed", 1 / 3.6),
    "mph": ("speed", 1609.344 / 3600),
    "N m": ("torque", 1.0),
    "Nm": ("torque", 1.0),
    "kN m": ("torque", 1e3),
    "kNm": ("torque", 1e3),
    "lbf ft": ("torque", POUND_FORCE * 12 * INCH),
    "N": ("force", 1.0),
    "kN": ("force", 1e3),
    "lbf": ("force", POUND_FORCE),
    "A": ("current", 1.0),
    "mA": ("current", 1e-3),
    "V": ("voltage", 1.0),
    "mV": ("voltage", 1e-3),
    "%": ("duty", 1e-2),
    "Pa": ("pressure", 1.0),
    "kPa": ("pressure", 1e3),
    "MPa": ("pressure", 1e6),
    "bar": ("pressure", BAR),
    "psi": ("pressure", POUND_FORCE / INCH**2),
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
    "us": ("time", 1e-6),
    "ns": ("time", 1e-9),
    "min": ("time", 60.0),
    "day": ("time", 86400.0),
}

# kind of sensor -> quantities its column may hold; the rate of an angle is a reading of its own
QUANTITIES_BY_KIND: dict[str, tuple[str, ...]] = {
    "angle": ("angle", "length", "angular rate", "speed"),
    "wheel": ("angle", "angular rate"),
    "torque": ("torque", "force", "current", "voltage", "duty"),
    "yaw_rate": ("angular rate",),
    "lateral_speed": ("speed",),
    "forward_speed": ("speed",),
    "ground_speed": ("speed",),
    "x": ("length",),
    "y": ("length",),
}
RATES = ("angular rate", "speed")
# what a motor is driven by: its torque is a constant times that; its SI unit
DRIVEN_BY = {"current": "A", "voltage": "V", "duty": "1"}


# unit of a parameter divided by a torque constant [N m/A], or by a force constant [N/A] of sliding joints
PER_TORQUE_CONSTANT = {
    "N m": "A",
    "N m s": "A s",
    "N m/rad": "A/rad",
    "kg": "A s2/m2",
    "kg m": "A s2/m",
    "kg m2": "A s2",
}
PER_FORCE_CONSTANT = {
    "N": "A",
    "N s/m": "A s/m",
    "N/m": "A/m",
    "kg": "A s2/m",
    "kg m": "A s2",
    "kg m2": "A m s2",
}


def units_of(quantities: tuple[str, ...]) -> str:
    """List the units of some quantities for a message."""
    return ", ".join(unit for unit, (quantity, _) in UNITS.items() if quantity in quantities)
