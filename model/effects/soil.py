"""Contacts and soil beyond the linear law: how slip arises, what the soil has gone through, what resists."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca

from excite.model import mechanics
from excite.model.effects import ground_map
from excite.model.effects.effect import ContactMotion, Memory, SampleView, Soil, Values

SLIP_SMOOTHING = 0.005  # slip over which driving turns into braking
SPEED_SMOOTHING = 0.02  # [m/s] over which rolling resistance turns


def relaxed(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """The forces' slips lag the geometric ones over the distance A, the moment's by a share of it."""
    slip = mechanics.Slip(s.z["gx"], s.z["gy"], soil.slip.vn)
    return replace(soil, slip=slip, yaw=(1 - p["moment"]) * soil.yaw + p["moment"] * s.z["turn"] * soil.slip.vn)


def relaxation(slip: Callable[[ContactMotion], ca.SX], name: str) -> Memory:
    """What remembers a slip that lags so."""

    def rate(s: SampleView, k: int, p: Values) -> ca.SX:
        r = s.rolling[k]
        return (slip(r) - s.z[name]) * r.slip.vn / p["A"]

    return Memory(rate, 0.05)


def braking(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Stiffer along the contact by the share A where it goes further than its rim turns."""
    r = s.rolling[k]
    excess = (ca.sqrt(r.Vx**2 + 1e-6) - ca.sqrt(r.rim**2 + 1e-6)) / soil.slip.vn
    return replace(soil, Kx=soil.Kx * (1 + p["A"] * (1 + ca.tanh(excess / SLIP_SMOOTHING)) / 2))


def scaled(soil: Soil, factor: ca.SX) -> Soil:
    """Stiffer by a factor in all directions."""
    return replace(soil, Kx=soil.Kx * factor, Ky=soil.Ky * factor)


def _form_weights(form: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Weights of three forms 0, 1, 2 that a shape chooses from: one for that form, none for the others."""
    return (1 - form) * (2 - form) / 2, form * (2 - form), form * (form - 1) / 2


def compacted(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Stiffer with what went over it: way, reversals or passes."""
    driven, reversed_, passed = _form_weights(p["counted"])
    way = driven * s.z["distance"] + reversed_ * ground_map.PASS_LENGTH * s.z["reversals"]
    grown = 1 - ca.exp(-way / p["pass"]) + passed * ground_map.pass_effect(s.over[k], p["pass"])
    return scaled(soil, 1 + p["A"] * grown)


def saturated(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """Forces fall behind the linear law with the slip."""
    strips, _, untouched = _form_weights(p["across"])
    return replace(soil, saturation=mechanics.Saturation(p["A"], p["bend"], strips, untouched))


def saturated_laterally(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
    """The lateral force alone falls behind the linear law with the lateral slip."""
    return replace(soil, lateral=mechanics.Saturation(p["A"], p["bend"]))


def resistance(s: SampleView, k: int, p: Values) -> tuple[ca.SX, ca.SX]:
    """Forces along and across the contact [N] against its motion along its chassis."""
    r = s.rolling[k]
    return -p["A"] * (1 + p["rise"] * r.Vx**2) * ca.tanh(r.Vx / p["soft"]), ca.SX(0)
