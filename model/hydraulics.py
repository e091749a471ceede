"""Torque from the pressures on both sides of a hydraulic motor, or of the cylinders at a joint."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from model.machine import Cylinder, Sensor


def lever(cylinder: Cylinder, angle: np.ndarray) -> np.ndarray:
    """How a cylinder's length grows with the joint's angle (N,) [m/rad]: its lever arm, signed.

    Of pins: L = |p(angle) - a|, a on the antecedent, p on the body and turned with it, both seen from the joint's axis,
    dL/dangle = (a x p) / L.
    """
    if cylinder.lever is not None:
        return np.full(len(angle), float(cylinder.lever))
    assert cylinder.anchor is not None
    assert cylinder.pin is not None
    (ax, ay), (bx, by) = cylinder.anchor.value, cylinder.pin.value
    px, py = bx * np.cos(angle) - by * np.sin(angle), bx * np.sin(angle) + by * np.cos(angle)
    return np.asarray((ax * py - ay * px) / np.hypot(px - ax, py - ay))


def arms(sensor: Sensor, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torque [N m] of one pascal in `column` and of one in `return_column` at joint angles (N,) [rad].

    Of a motor displacement / (2 pi), and the same the other way. A cylinder pushes with its piston side and pulls with
    its rod side: F = area p - rod_area p_rod, and turns by F dL/dangle (virtual work).
    """
    if sensor.displacement is not None:
        one = np.full(len(angle), float(sensor.displacement) / (2 * np.pi))
        return one, -one
    sides = {"column": np.zeros(len(angle)), "return_column": np.zeros(len(angle))}
    for c in sensor.cylinders:
        arm = lever(c, angle)
        other = "return_column" if c.piston == "column" else "column"
        sides[c.piston] += float(c.area) * arm
        sides[other] -= float(c.rod_area) * arm
    return sides["column"], sides["return_column"]
