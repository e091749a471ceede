"""Angles of a robot's geometry, as files round them."""

from __future__ import annotations

import math

from excite.model.machine import Quantity

ROUNDED_ANGLE = 1e-4  # [rad] by which a multiple of pi/4 may be off in a file: 3.1416 for pi, 1.5708 for pi/2


def round_angle(angle: float) -> float:
    """Return an angle [rad] of a geometry, a multiple of pi/4 if it is one to within the digits that files give.

    Such rounding would otherwise make parameters that no motion shows appear to be identifiable.
    """
    nearest = round(angle / (math.pi / 4)) * (math.pi / 4) + 0.0
    return nearest if abs(angle - nearest) < ROUNDED_ANGLE else angle


def fixed_angle(angle: Quantity) -> float:
    """Return an angle [rad] of a machine file, rounded unless its tolerance is 0: such an angle is exact."""
    return angle.value if angle.tolerance == 0 else round_angle(angle.value)
