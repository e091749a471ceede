"""Slips and forces between a contact, roll or wheel, and the soil: linear and exponential law.

Slips divide by v_n = sqrt((R_c w)^2 + v_eps^2). The paper's (17) divides by R_c w: that changes sign in reverse, where
the soil would push instead of resist, and is singular at rest. With v_n driving backward mirrors driving forward.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

from excite.model.machine import Contact

# Gauss-Legendre points on 0..1, for the exponential law on either side of the point without longitudinal slip.
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
    """Saturation of the forces of a contact.

    slip: K / xi_s, at which the shear displacement is K at the rear of the patch.
    bend: 0 for the exponential law (18), 1 for a hyperbola of the same initial slope (after Kondner, J. Soil Mech. 89,
        1963, for samples of soil), or any value above -2; the force's limit is (2 + bend) slip K.
    by_strip: 1 if every strip of the width saturates by its own slip, 0 if all do by that of the middle.
    linear_moment: 1 if the moment T_z stays linear.
    """

    slip: ca.SX
    bend: ca.SX | float = 0.0
    by_strip: ca.SX | float = 1.0
    linear_moment: ca.SX | float = 0.0

    def share(self, gx: ca.SX | float, gy: ca.SX) -> ca.SX:
        """Return the force at slips gx, gy as a share of the linear law's."""
        return mobilised_share(ca.sqrt(gx**2 + gy**2 + 1e-12) / self.slip, self.bend)


@dataclass(frozen=True)
class Slip:
    """Slips at the middle of the contact, longitudinal and lateral [-], and v_n [m/s]."""

    gx: ca.SX
    gy: ca.SX
    vn: ca.SX


def rim_speed(contact: Contact, spin: ca.SX, extra_radius: ca.SX | float = 0.0) -> ca.SX:
    """Return the speed of the rim at the ground [m/s].

    spin [rad/s]; extra_radius [m]: distance from axle to ground, minus the radius.
    """
    return (float(contact.radius) + extra_radius) * spin


def slip(contact: Contact, Vx: ca.SX, Vy: ca.SX, spin: ca.SX, extra_radius: ca.SX | float = 0.0) -> Slip:
    """Return the slips of a contact whose centre moves at Vx, Vy [m/s] in its chassis' axes; see `rim_speed`."""
    at_ground = rim_speed(contact, spin, extra_radius)
    vn = ca.sqrt(at_ground**2 + float(contact.v_eps) ** 2)
    return Slip((Vx - at_ground) / vn, Vy / vn, vn)


def longitudinal_slip(s: Slip, yaw_rate: ca.SX | float, y: ca.SX | float) -> ca.SX:
    """Return g_x at y [m] to the left of the contact's middle (17); yaw_rate [rad/s]: of its chassis."""
    return s.gx - y * yaw_rate / s.vn


def slips_across(contact: Contact, s: Slip, yaw_rate: ca.SX) -> dict[str, ca.SX]:
    """Return (g_x, g_y) at the places of a contact that slip most, by place: its right and left edge.

    |g|^2 is a convex function of y, so the middle never slips more than both edges. A contact without width, or whose
    chassis cannot turn, slips alike all over: its place is the middle.
    """
    edge = float(contact.width) / 2
    at = {"": 0.0} if edge == 0 or yaw_rate.is_zero() else {"right": -edge, "left": edge}
    return {place: ca.vertcat(longitudinal_slip(s, yaw_rate, y), s.gy) for place, y in at.items()}


def wrench(
    contact: Contact,
    s: Slip,
    yaw_rate: ca.SX,
    Kx: ca.SX,
    Ky: ca.SX,
    saturation: Saturation | None = None,
    lateral: Saturation | None = None,
) -> Wrench:
    """Return forces and moment of the soil on a contact.

    yaw_rate [rad/s]: of its chassis; Kx, Ky [N] < 0. Linear (24, 25), or with `saturation` the exponential law (18)
    integrated over the patch. lateral: saturation of the lateral force alone, as a factor on Ky.
    """
    if lateral is not None:
        Ky = Ky * lateral.share(0.0, s.gy)
    linear_Tz = Kx * (float(contact.width) ** 2 / 12) * (-yaw_rate) / s.vn
    if saturation is None:
        return Wrench(Kx * s.gx, Ky * s.gy, linear_Tz)
    Sx, Sy, Tz = ca.SX(0), ca.SX(0), ca.SX(0)
    for y, dy in _width_points(contact, s, saturation.by_strip * yaw_rate):
        gx = longitudinal_slip(s, yaw_rate, y)
        share = saturation.share(longitudinal_slip(s, saturation.by_strip * yaw_rate, y), s.gy) * dy
        Sx += Kx * gx * share
        Sy += Ky * s.gy * share
        Tz += Kx * gx * y * share
    return Wrench(Sx, Sy, (1 - saturation.linear_moment) * Tz + saturation.linear_moment * linear_Tz)


def _width_points(contact: Contact, s: Slip, yaw_rate: ca.SX) -> Iterator[tuple[ca.SX, ca.SX]]:
    """Yield points y [m] across the contact and their shares of its width, which add up to 1.

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
    """Return the exponential law's force over the linear one's at x = |g| xi_s / K: 2 (x - 1 + e^-x) / x^2.

    It is the mean over the patch of (1 - exp(-j/K)), j = |g| xi, over that of j/K (18). Below x = 0.05, where the
    closed form cancels, the series 1 - x/3 + x^2/12 - x^3/60 + x^4/360 replaces it. bend: share of the hyperbola
    1 / (1 + x/3).
    """
    series = 1 - x / 3 + x**2 / 12 - x**3 / 60 + x**4 / 360
    safe = ca.fmax(x, 0.05)
    exponential = ca.if_else(x < 0.05, series, 2 * (safe - 1 + ca.exp(-safe)) / safe**2)
    return exponential + bend * (1 / (1 + x / 3) - exponential)


@dataclass(frozen=True)
class SoilConstants:
    """Constants of a soil and a patch of contact under uniform pressure.

    cohesion c [Pa], friction_angle phi [rad], shear_modulus K [m] (18); length xi_s and width [m] of the patch;
    load [N]. Raises ValueError for a value that no soil has.
    """

    cohesion: float
    friction_angle: float
    shear_modulus: float
    length: float
    width: float
    load: float

    def __post_init__(self) -> None:
        for name in ("shear_modulus", "length", "width", "load"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: must be > 0 (got {getattr(self, name):g})")
        if not self.cohesion >= 0:
            raise ValueError(f"cohesion: must be >= 0 (got {self.cohesion:g})")
        if not 0 <= self.friction_angle < np.pi / 2:
            raise ValueError(f"friction_angle: must be from 0 to below pi / 2 (got {self.friction_angle:g})")

    @property
    def strength(self) -> float:
        """Largest force [N] of the patch (18): A c + load tan(phi), A its area."""
        return self.length * self.width * self.cohesion + self.load * float(np.tan(self.friction_angle))

    @property
    def saturation_slip(self) -> float:
        """K / xi_s [-]: the slip at which the shear displacement is K at the rear of the patch."""
        return self.shear_modulus / self.length

    @property
    def stiffness(self) -> float:
        """Kx = Ky [N] < 0, the law's slope at zero slip (24, 25): -(A c + load tan(phi)) xi_s / (2 K).

        The shear stress (c + sigma tan(phi)) |g| xi / K, linear along the patch, integrated over it (18, 20). The law
        has no direction, so both are equal.
        """
        return -self.strength / (2 * self.saturation_slip)
