"""Hooks of contacts on the soil beyond the linear law: relaxation, compaction, saturation, resistance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca

from excite.model import mechanics
from excite.model.effects import ground_map
from excite.model.effects.effect import ContactMotion, Memory, SampleView, Soil, Values

SLIP_SMOOTHING = 0.005  # slip over which driving turns into braking; chosen
SPEED_SMOOTHING = 0.02  # m/s, speed over which rolling resistance turns; chosen


def relaxed(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Let the slips of the forces lag the geometric ones over the distance A, that of the moment by a share."""
    slip = mechanics.Slip(s.z["gx"], s.z["gy"], soil.slip.vn)
    return replace(soil, slip=slip, yaw=(1 - p["moment"]) * soil.yaw + p["moment"] * s.z["turn"] * soil.slip.vn)


def relaxation(slip: Callable[[ContactMotion], ca.SX], name: str) -> Memory:
    """Return the memory state of a slip that lags over the distance A."""

    def rate(s: SampleView, k: int, p: Values) -> ca.SX:
        r = s.contacts[k]
        return (slip(r) - s.z[name]) * r.slip.vn / p["A"]

    return Memory(rate, 0.05)


def braking(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Raise Kx by the share A while the contact brakes: it travels further than its rim turns."""
    r = s.contacts[k]
    excess = (ca.sqrt(r.Vx**2 + 1e-6) - ca.sqrt(r.rim**2 + 1e-6)) / soil.slip.vn
    return replace(soil, Kx=soil.Kx * (1 + p["A"] * (1 + ca.tanh(excess / SLIP_SMOOTHING)) / 2))


def scaled(soil: Soil, factor: ca.SX) -> Soil:
    """Multiply both stiffnesses by a factor."""
    return replace(soil, Kx=soil.Kx * factor, Ky=soil.Ky * factor)


def _form_weights(form: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return weights of the forms 0, 1, 2: one for the form given, zero for the others."""
    return (1 - form) * (2 - form) / 2, form * (2 - form), form * (form - 1) / 2


def compacted(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Raise stiffness with compaction, counted by distance, reversals or mapped passes."""
    by_distance, by_reversals, by_map = _form_weights(p["counted"])
    distance = by_distance * s.z["distance"] + by_reversals * ground_map.PASS_LENGTH * s.z["reversals"]
    grown = 1 - ca.exp(-distance / p["pass"]) + by_map * ground_map.pass_effect(s.passes[k], p["pass"])
    return scaled(soil, 1 + p["A"] * grown)


def saturated(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Let the forces saturate with slip."""
    by_strip, _, linear_moment = _form_weights(p["across"])
    return replace(soil, saturation=mechanics.Saturation(p["A"], p["bend"], by_strip, linear_moment))


def saturated_laterally(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Let the lateral force alone saturate with lateral slip."""
    return replace(soil, lateral=mechanics.Saturation(p["A"], p["bend"]))


def resistance(s: SampleView, k: int, p: Values) -> tuple[ca.SX, ca.SX]:
    """Return forces along and across the contact [N] against its motion along its chassis."""
    r = s.contacts[k]
    return -p["A"] * (1 + p["rise"] * r.Vx**2) * ca.tanh(r.Vx / p["soft"]), ca.SX(0)


def ahead(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Let a contact lie A ahead of its place: the lateral slip is that there, and the force acts there."""
    slip = replace(soil.slip, gy=soil.slip.gy + p["A"] * s.contacts[k].yaw / soil.slip.vn)
    return replace(soil, slip=slip, ahead=p["A"])


def turned(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Turn a contact by the small angle A against its chassis, slips and forces."""
    along = s.contacts[k].Vx / soil.slip.vn
    slip = replace(soil.slip, gx=soil.slip.gx + p["A"] * soil.slip.gy, gy=soil.slip.gy - p["A"] * along)
    return replace(soil, slip=slip, turned=p["A"])
