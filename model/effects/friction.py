"""Hooks of dry friction beyond Fs tanh(w / w_s): its transition at reversals, Stribeck friction, bristles."""

from __future__ import annotations

from math import pi

import casadi as ca

from excite.model.effects import sizes
from excite.model.effects.effect import SampleView, Site, Values

MIN_BRISTLE_SHARE = 0.1  # least friction of sliding bristles, share of that at rest; chosen, guards fits


def _stribeck_decay(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return Stribeck friction as a share of its value at standstill."""
    return ca.exp(-(((s.w[k] ** 2 + (0.1 * s.friction_smoothing[k]) ** 2) / p["decay"] ** 2) ** (p["power"] / 2)))


def stribeck(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque of Stribeck friction (declared as `stribeck_friction`)."""
    bent = (s.coulomb[k] + p["A"]) * s.z["bent"] - s.coulomb[k] * s.sign(k)
    return -(1 - p["bristles"]) * p["A"] * s.sign(k) * _stribeck_decay(s, k, p) - p["bristles"] * bent


def presliding(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque by which friction of bristles that bend differs from Fs tanh(w / w_s)."""
    return s.coulomb[k] * (s.sign(k) - s.z["bent"] - p["damping"] * presliding_rate(s, k, p))


def presliding_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the rate of the bristles' deflection, in shares of the one at which they hold Fs. Source: Dahl 1968."""
    return _bend(s, k, 1.0, p["A"])


def _bend(s: SampleView, k: int, held: ca.SX | float, angle: ca.SX) -> ca.SX:
    """Return the rate of bristles that bend within an angle [rad] and hold a share of their friction in sliding."""
    w = s.w[k]
    sliding = ca.sqrt(w**2 + (0.001 * s.friction_smoothing[k]) ** 2) / held
    return (w - sliding * s.z["bent"]) / angle


def bristle_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the rate of the bristles' deflection, in shares of the one at which they hold Fs + A.

    In steady sliding they hold the share (Fs + A exp(-(w/decay)^power)) / (Fs + A), with the sign of the speed.
    Source: LuGre without damping (Canudas de Wit et al., IEEE TAC 40, 1995).
    """
    most = s.coulomb[k] + p["A"]
    held = (s.coulomb[k] + p["A"] * _stribeck_decay(s, k, p)) * most / (most**2 + 1e-6)
    return _bend(s, k, ca.fmax(held, MIN_BRISTLE_SHARE), p["presliding"])


def bristle_trials(site: Site) -> list[dict[str, float]]:
    """Return trials with bristles; a fixed power of 1.5 keeps them from explaining other causes."""
    smooth, rate = sizes.friction_smoothing(site), sizes.stick_slip_rate(site)
    return [
        {"decay": x * rate, "power": 1.5, "bristles": 1.0, "presliding": far * smooth}
        for x in (4.0, 12.0, 36.0)
        for far in (0.05, 0.2)
    ]


def transition(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque by which friction turns faster or slower than Fs tanh(w / w_s)."""
    x = s.w[k] / s.friction_smoothing[k] * ca.exp(p["A"])
    slowly = ca.atan(x * pi / 2) * 2 / pi
    return s.coulomb[k] * (s.sign(k) - (1 - p["slow"]) * ca.tanh(x) - p["slow"] * slowly)
