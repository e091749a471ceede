"""Typical sizes at a site [SI], of which magnitudes and shapes of effects are shares.

A size is a function of the site, or makes one (`constant`, `share_of`, `coulomb`, `viscous`, `weight`).
"""

from __future__ import annotations

from collections.abc import Callable

from excite.model.effects.effect import Site
from excite.model.machine import Body, Machine

GRAVITY = 9.81  # m/s2


def constant(value: float) -> Callable[[Site], float]:
    """Make a size that is the same at every site."""
    return lambda site: value


def share_of(size: Callable[[Site], float], share: float) -> Callable[[Site], float]:
    """Make a size that is a share of another."""
    return lambda site: share * size(site)


def duration(site: Site) -> float:
    """Length of the log [s]."""
    return site.duration


def friction_smoothing(site: Site) -> float:
    """Rate over which a joint's friction turns [rad/s]."""
    return float(site.body.friction.smoothing) if site.body.friction is not None else 1.0


def presliding(site: Site) -> float:
    """Angle [rad] within which bristles bend: 0.2 s at the rate over which friction turns (chosen)."""
    return 0.2 * friction_smoothing(site)


def stick_slip_rate(site: Site) -> float:
    """Rate [rad/s] near standstill: 0.7 % of that at which viscous friction equals Fs (chosen), at least the smoothing.

    Speeds over which friction falls are some per cent of those of work, however sharply the machine file lets it turn.
    """
    friction = site.body.friction
    if friction is None or not (friction.Fv and friction.Fs):
        return friction_smoothing(site)
    return max(friction_smoothing(site), 0.007 * float(friction.Fs) / float(friction.Fv))


def angle_limit(site: Site) -> float:
    """A joint's position limit [rad], 0.6 if it has none (chosen)."""
    return site.body.limit.reach or 0.6


def large_torque(machine: Machine, body: Body) -> float:
    """Return a large torque [N m] at a joint: its limit, the machine's largest limit, or 30 Fs (chosen)."""
    if body.limit.torque is not None:
        return float(body.limit.torque)
    stated = [float(b.limit.torque) for b in machine.body if b.limit.torque is not None]
    rubbing = [30 * float(b.friction.Fs) for b in machine.body if b.friction is not None]
    return max(stated or rubbing, default=0.0) or 1.0


def torque(site: Site) -> float:
    """A large torque at the site [N m]."""
    return large_torque(site.machine, site.body)


def compliance(site: Site) -> float:
    """Compliance [rad/(N m)] that winds up by 0.006 rad under a large torque (chosen)."""
    return 0.002 / torque(site) * 3


def coulomb(share: float) -> Callable[[Site], float]:
    """Make a share of dry friction Fs [N m]."""
    return lambda site: share * max(float(site.body.friction.Fs), 1e-6) if site.body.friction is not None else share


def viscous(share: float, power: float = 0.0) -> Callable[[Site], float]:
    """Make a share of Fv / rate^power; rate is that of 1 m/s at a contact's rim, or half a joint's rate limit."""

    def size(site: Site) -> float:
        body = site.body
        assert body.friction is not None
        rate = 1.0
        if body.contact is not None:
            rate = 1.0 / float(body.contact.radius)
        elif body.limit.rate is not None:
            rate = float(body.limit.rate) / 2
        return share * max(float(body.friction.Fv), 1e-6) / rate**power

    return size


def _machine_mass(machine: Machine) -> float:
    """Sum the masses of all bodies [kg]."""
    return sum(float(b.inertia.mass) for b in machine.body if b.inertia is not None)


def weight(share: float) -> Callable[[Site], float]:
    """Make a share of the machine's weight [N]."""
    return lambda site: share * GRAVITY * _machine_mass(site.machine)


def load_rate(site: Site) -> float:
    """Rate of mass [kg/s]: 0.1 % of the machine's mass a second (chosen)."""
    return 0.001 * _machine_mass(site.machine)


def load_moment(site: Site) -> float:
    """First moment [kg m] of 5 % of the machine's mass at 1 m (chosen)."""
    return 0.05 * _machine_mass(site.machine)
