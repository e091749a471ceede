"""A contact, roll or wheel, and the ground: slips, forces, the linear law and the exponential one.

Slips divide by v_n = sqrt((R_c w)^2 + v_eps^2). The paper's (17) divides by R_c w: that changes sign in reverse, where
the soil would push instead of resist, and is singular at rest. With v_n driving backward mirrors driving forward.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

from excite.model.machine import Contact

# Gauss-Legendre points on 0..1, for the exponential law on either side of the point where nothing slips.
_GAUSS, _WEIGHTS = (v / 2 for v in np.polynomial.legendre.leggauss(6))
_POINTS = _GAUSS + 0.5


@dataclass(frozen=True)
class Wrench:
    """Forces [N] along and across the contact at its centre, and moment T_z [N m]: the soil turns it by -T_z."""

    Sx: ca.SX
    Sy: ca.SX
    Tz: ca.SX


@dataclass(frozen=True)
class Saturation:
    """How forces fall behind the linear law. slip: K / xi_s, at which the shear displacement is K at the patch's rear.

    bend: 0 as the exponential law (18) has it, 1 with the force along a hyperbola that begins alike (after Kondner, J.
    Soil Mech. 89, 1963, who has it for a sample of soil); it must be above -2, the force's limit is (2 + bend) slip K.
    Simpler readings of (18): with `strips` 0 all of the contact's width saturates as its middle does, with `untouched`
    1 the moment does not.
    """

    slip: ca.SX
    bend: ca.SX | float = 0.0
    strips: ca.SX | float = 1.0
    untouched: ca.SX | float = 0.0

    def share(self, gx: ca.SX | float, gy: ca.SX) -> ca.SX:
        """Of the linear law's force, at slips gx, gy."""
        return mobilised_share(ca.sqrt(gx**2 + gy**2 + 1e-12) / self.slip, self.bend)


@dataclass(frozen=True)
class Slip:
    """Slips at the middle of the contact, longitudinal and lateral [-], and v_n [m/s]."""

    gx: ca.SX
    gy: ca.SX
    vn: ca.SX


def rim_speed(contact: Contact, spin: ca.SX, further: ca.SX | float = 0.0) -> ca.SX:
    """Speed of the rim at the ground [m/s], of a contact that spins at `spin` [rad/s]; further [m]: by how much the
    ground is further from its axle than its radius."""
    return (float(contact.radius) + further) * spin


def slip(contact: Contact, Vx: ca.SX, Vy: ca.SX, spin: ca.SX, further: ca.SX | float = 0.0) -> Slip:
    """Slips of a contact whose centre moves at Vx, Vy [m/s] in its chassis' axes, its rim as `rim` has it."""
    at_ground = rim_speed(contact, spin, further)
    vn = ca.sqrt(at_ground**2 + float(contact.v_eps) ** 2)
    return Slip((Vx - at_ground) / vn, Vy / vn, vn)


def wrench(
    contact: Contact,
    s: Slip,
    yaw_rate: ca.SX,
    Kx: ca.SX,
    Ky: ca.SX,
    saturation: Saturation | None = None,
    lateral: Saturation | None = None,
) -> Wrench:
    """What the soil does to a contact; yaw_rate [rad/s] of its chassis; Kx, Ky [N] < 0.

    Linear (24, 25), or with `saturation` the exponential law (18) integrated over the patch. `lateral`: the same for
    the lateral force alone, as a factor on it.
    """
    if lateral is not None:
        Ky = Ky * lateral.share(0.0, s.gy)
    turning = Kx * (float(contact.width) ** 2 / 12) * (-yaw_rate) / s.vn
    if saturation is None:
        return Wrench(Kx * s.gx, Ky * s.gy, turning)
    Sx, Sy, Tz = ca.SX(0), ca.SX(0), ca.SX(0)
    for y, dy in _width_points(contact, s, saturation.strips * yaw_rate):
        gx = s.gx - y * yaw_rate / s.vn
        share = saturation.share(s.gx - saturation.strips * y * yaw_rate / s.vn, s.gy) * dy
        Sx += Kx * gx * share
        Sy += Ky * s.gy * share
        Tz += Kx * gx * y * share
    return Wrench(Sx, Sy, (1 - saturation.untouched) * Tz + saturation.untouched * turning)


def _width_points(contact: Contact, s: Slip, yaw_rate: ca.SX) -> Iterator[tuple[ca.SX, ca.SX]]:
    """Points y [m] across the contact and their shares of its width (they add up to 1).

    |g| has a kink where g_x(y) = 0, when the contact turns on the spot: the points meet there, denser towards it
    (y - y0 = h p^2). Relative error of the force below 1e-5 for |g| <= 0.15, K / xi_s >= 0.15; 5e-5 for 0.05.
    """
    edge = float(contact.width) / 2
    turn = edge * yaw_rate / s.vn
    still = ca.fmin(1, ca.fmax(-1, s.gx * turn / (turn**2 + 1e-12)))
    for end in (-1, 1):
        h = end - still
        for point, weight in zip(_POINTS, _WEIGHTS, strict=True):
            yield edge * (still + h * point**2), ca.fabs(h) * point * weight


def mobilised_share(x: ca.SX, bend: ca.SX | float = 0.0) -> ca.SX:
    """Force of the exponential law over that of its linear limit, for x = |g| xi_s / K: 2 (x - 1 + e^-x) / x^2.

    The mean over the patch of (1 - exp(-j/K)), j = |g| xi, against j/K (18). Below x = 0.05 the series
    1 - x/3 + x^2/12 - x^3/60 + x^4/360 replaces it, where the closed form cancels. `bend`: the share of the hyperbola
    1 / (1 + x/3) in its place.
    """
    series = 1 - x / 3 + x**2 / 12 - x**3 / 60 + x**4 / 360
    safe = ca.fmax(x, 0.05)
    exponential = ca.if_else(x < 0.05, series, 2 * (safe - 1 + ca.exp(-safe)) / safe**2)
    return exponential + bend * (1 / (1 + x / 3) - exponential)
