"""Torque from the pressures on both sides of a hydraulic motor, or of the cylinders at a joint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import model_validator

from excite.model.machine.records import FileRecord, Number, Positive, Quantity, Source


class Pin(FileRecord):
    """A point [m] in the plane, seen from a joint's axis, in the axes that both of its bodies have at angle zero."""

    value: tuple[Number, Number]
    source: Source
    note: str = ""


class Cylinder(FileRecord):
    """A hydraulic cylinder that turns a joint: `area` [m2] of the piston, `rod_area` [m2] what the rod leaves of it.

    `piston`: the column with the pressure on the piston side, the rod side has the other one. Where it acts: `lever`
    [m], how its length grows with the angle, constant; or `anchor` on the antecedent and `pin` on the body, of which
    the lever at every angle follows.
    """

    area: Positive
    rod_area: Positive
    piston: Literal["column", "return_column"] = "column"
    lever: Quantity | None = None
    anchor: Pin | None = None
    pin: Pin | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Cylinder:
        if (self.lever is None) == (self.anchor is None) or (self.anchor is None) != (self.pin is None):
            raise ValueError("lever: give it, or both anchor and pin")
        if self.lever is not None and self.lever.value == 0:
            raise ValueError("lever: must not be 0")
        return self


def lever_arm(cylinder: Cylinder, angle: np.ndarray) -> np.ndarray:
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


def torque_per_pressure(
    displacement: Quantity | None, cylinders: Sequence[Cylinder], angle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Torque [N m] of one pascal in `column` and of one in `return_column` at joint angles (N,) [rad].

    Of a motor displacement / (2 pi), and the same the other way. A cylinder pushes with its piston side and pulls with
    its rod side: F = area p - rod_area p_rod, and turns by F dL/dangle (virtual work).
    """
    if displacement is not None:
        one = np.full(len(angle), float(displacement) / (2 * np.pi))
        return one, -one
    sides = {"column": np.zeros(len(angle)), "return_column": np.zeros(len(angle))}
    for c in cylinders:
        arm = lever_arm(c, angle)
        other = "return_column" if c.piston == "column" else "column"
        sides[c.piston] += float(c.area) * arm
        sides[other] -= float(c.rod_area) * arm
    return sides["column"], sides["return_column"]
