"""Torque from the pressures on both sides of a hydraulic motor, or of the cylinders at a joint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import model_validator

from excite.model.machine.records import FileRecord, Number, Positive, Quantity, Source


class Pin(FileRecord):
    """A point [m] in the plane relative to a joint's axis, in the axes that both bodies share at angle zero."""

    value: tuple[Number, Number]
    source: Source
    note: str = ""


class Cylinder(FileRecord):
    """A hydraulic cylinder that turns a joint.

    `area` [m2]: of the piston; `rod_area` [m2]: of the piston without the rod. `piston`: the column with the pressure
    of the piston side, the rod side has the other one. `lever` [m]: a constant lever arm, or `anchor` on the antecedent
    and `pin` on the body, which give the lever arm at every angle.
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
        if float(self.rod_area) > float(self.area):
            raise ValueError("rod_area: the piston without the rod can't be larger than the piston, area")
        return self


def lever_arm(cylinder: Cylinder, angle: np.ndarray) -> np.ndarray:
    """Return a cylinder's signed lever arm dL/dangle (N,) [m/rad] at joint angles (N,) [rad].

    With pins L = |p(angle) - a|, a on the antecedent, p on the body and turned with it, both relative to the joint's
    axis, so dL/dangle = (a x p) / L.
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
    """Return torque per pressure [N m/Pa] of `column` and of `return_column`, (N,) each, at joint angles (N,) [rad].

    A motor has displacement / (2 pi) and its negative. A cylinder has F = area p - rod_area p_rod and the torque
    F dL/dangle (virtual work).
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
