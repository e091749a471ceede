"""Dry friction at a joint beyond Fs tanh(w / w_s): how it turns with the speed, and what it is near standstill."""

from __future__ import annotations

from math import pi

import casadi as ca

from excite.model.effects import sizes
from excite.model.effects.effect import SampleView, Site, Values

MIN_BRISTLE_SHARE = 0.1  # of what bristles hold at rest, that they hold at any speed: what a fit passes by may be less


def _stribeck_decay(s: SampleView, k: int, p: Values) -> ca.SX:
    """Stribeck friction's share of what it is at standstill."""
    return ca.exp(-(((s.w[k] ** 2 + (0.1 * s.smooth[k]) ** 2) / p["decay"] ** 2) ** (p["power"] / 2)))


def stribeck(s: SampleView, k: int, p: Values) -> ca.SX:
    bent = (s.coulomb[k] + p["A"]) * s.z["bent"] - s.coulomb[k] * s.sign(k)
    return -(1 - p["bristles"]) * p["A"] * s.sign(k) * _stribeck_decay(s, k, p) - p["bristles"] * bent


def bristle_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """How fast bristles bend: from 0 towards what they hold of Fs + A, the most; sliding steadily that is the share
    (Fs + A exp(-(w/decay)^power)) / (Fs + A) of it, with the sign of the speed."""
    w, most = s.w[k], s.coulomb[k] + p["A"]
    held = (s.coulomb[k] + p["A"] * _stribeck_decay(s, k, p)) * most / (most**2 + 1e-6)
    sliding = ca.sqrt(w**2 + (0.001 * s.smooth[k]) ** 2) / ca.fmax(held, MIN_BRISTLE_SHARE)
    return (w - sliding * s.z["bent"]) / p["presliding"]


def bristle_trials(site: Site) -> list[dict[str, float]]:
    """Bristles: the power is held between the two of the plain form; free, they would take up much that is none."""
    smooth = sizes.friction_smoothing(site)
    return [
        {"decay": x * smooth, "power": 1.5, "bristles": 1.0, "presliding": far * smooth}
        for x in (4.0, 12.0, 36.0)
        for far in (0.05, 0.2)
    ]


def transition(s: SampleView, k: int, p: Values) -> ca.SX:
    x = s.w[k] / s.smooth[k] * ca.exp(p["A"])
    slowly = ca.atan(x * pi / 2) * 2 / pi
    return s.coulomb[k] * (s.sign(k) - (1 - p["slow"]) * ca.tanh(x) - p["slow"] * slowly)
