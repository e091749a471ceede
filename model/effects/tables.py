"""Torques of joints and forces of the soil as tables of one signal: what no other effect explains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from excite.errors import MachineError
from excite.model.effects import sizes
from excite.model.effects.effect import PlacedEffect, SampleView, Shape, Site, Soil, Values, unit_size
from excite.model.machine import Machine

MAP_NODES = 11  # rows of the table; chosen
SIGNALS = ("angle", "speed", "torque")  # in the order of the shape `signal`
CHANGES = ("force", "stiffness")  # by the shape `changes`
# By `signal`, with units.
SOIL_SIGNALS = {"lengthwise slip": "-", "lateral slip": "-", "slip": "-", "speed": "m/s", "rolled distance": "m"}
SLIP_ROUNDING = 1e-4  # below which the resultant slip is round
NO_CAUSE = "; a diagnosis fits it to what no other effect explains, and never names it as a cause"
SOURCE = "piecewise linear basis: Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., 5.2"
_NODES = tuple(np.linspace(-1, 1, MAP_NODES))


def torque_map_shapes() -> dict[str, Shape]:
    """Declare signal, nodes and torques of a joint's table; a bump of 5 % of its dry friction by default."""
    return {
        "signal": _choice(SIGNALS),
        "of": _constant("-", -1.0, meaning="number of the body whose signal it is; -1: of the joint itself"),
        **_rows("N m", sizes.coulomb(0.05), "rad, rad/s, N m; sliding: m, m/s, N", "torque"),
    }


def soil_map_shapes() -> dict[str, Shape]:
    """Declare what a contact's table changes, its signal, nodes and values; a bump of 5 % by default."""
    return {
        "changes": _choice(CHANGES),
        "signal": _choice(tuple(SOIL_SIGNALS), 0.0),
        **_rows("-", sizes.constant(0.05), ", ".join(SOIL_SIGNALS.values()), "force [N] or share of the stiffness"),
    }


def _choice(names: Sequence[str], default: float = 1.0) -> Shape:
    listed = ", ".join(f"{k}: {name}" for k, name in enumerate(names))
    return _constant("-", default, meaning=listed, only=tuple(float(k) for k in range(len(names))))


def _rows(unit: str, size: Callable[[Site], float], units: str, value: str) -> dict[str, Shape]:
    """Declare nodes x1, ... in `units` and values f1, ... of a table; a bump of a size by default."""
    nodes = {f"x{k + 1}": _constant("-", x) for k, x in enumerate(_NODES)}
    nodes["x1"] = _constant("-", _NODES[0], meaning=f"x1 to x{MAP_NODES}: the signal [{units}]")
    values = {f"f{k + 1}": _constant(unit, (1 - x**2) ** 2, size=size) for k, x in enumerate(_NODES)}
    meaning = f"f1 to f{MAP_NODES}: the {value} there, linear between, constant beyond"
    values["f1"] = _constant(unit, 0.0, meaning=meaning, size=size)
    return {**nodes, **values}


def _constant(
    unit: str,
    default: float,
    meaning: str = "",
    only: tuple[float, ...] = (),
    size: Callable[[Site], float] = unit_size,
) -> Shape:
    return Shape(unit, default, (default,), size, whole=True, meaning=meaning, only=only, either_sign=True)


def torque_table(signal: str, of: int, x: Sequence[float], f: Sequence[float]) -> dict[str, float]:
    """Return the shapes of a table: torques f (MAP_NODES,) at x (MAP_NODES,) of a body's signal."""
    return {"signal": float(SIGNALS.index(signal)), "of": float(of)} | _numbered(x, f)


def soil_table(signal: str, x: Sequence[float], f: Sequence[float], changes: str) -> dict[str, float]:
    """Return the shapes of a table: f (MAP_NODES,) at x (MAP_NODES,) of a contact's signal. changes: see CHANGES."""
    head = {"changes": float(CHANGES.index(changes)), "signal": float(list(SOIL_SIGNALS).index(signal))}
    return head | _numbered(x, f)


def _numbered(x: Sequence[float], f: Sequence[float]) -> dict[str, float]:
    return {f"{key}{k + 1}": float(v) for key, row in (("x", x), ("f", f)) for k, v in enumerate(row)}


def resist_by_table(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque of a table on joint k. Raises MachineError for nodes out of order or an unknown body."""
    signals: Sequence[Mapping[int, ca.SX]] = (s.q, s.w, s.u)
    own, of = signals[int(p["signal"])], int(p["of"])
    if (k if of < 0 else of) not in own:
        allowed = ", ".join(str(n) for n in own)
        raise MachineError(f"effect torque_map: of must be the number of a joint, one of {allowed}, or -1 (got {of})")
    return -p["A"] * _interpolated("torque_map", own[k if of < 0 else of], p)


def soil_by_table(effect: str, axis: str, stiffness: str) -> Callable[[SampleView, int, Values, Soil], Soil]:
    """Return the hook of a table that adds to the force along or across (axis) a contact, or changes Kx or Ky.

    The hook raises MachineError for nodes out of order.
    """

    def changed(s: SampleView, k: int, p: Values, soil: Soil) -> Soil:
        r = s.contacts[k]
        slip = ca.sqrt(r.slip.gx**2 + r.slip.gy**2 + SLIP_ROUNDING**2)
        signals = (r.slip.gx, r.slip.gy, slip, r.Vx, float(r.contact.radius) * s.q[k])
        value = p["A"] * _interpolated(effect, signals[int(p["signal"])], p)
        if CHANGES[int(p["changes"])] == "force":
            along, across = soil.added
            return replace(soil, added=(along + value, across) if axis == "along" else (along, across + value))
        return replace(soil, **{stiffness: getattr(soil, stiffness) * (1 + value)})

    return changed


def _interpolated(effect: str, at: ca.SX, p: Values) -> ca.SX:
    """Return a table's value at a signal. Raises MachineError for nodes out of order."""
    x, f = ([float(p[f"{key}{n + 1}"]) for n in range(MAP_NODES)] for key in "xf")
    if not (np.diff(x) > 0).all():
        raise MachineError(f"effect {effect}: x1 to x{MAP_NODES} must increase (got {', '.join(f'{v:g}' for v in x)})")
    value = ca.SX(f[0])
    for n in range(MAP_NODES - 1):
        value += (f[n + 1] - f[n]) / (x[n + 1] - x[n]) * (ca.fmin(ca.fmax(at, x[n]), x[n + 1]) - x[n])
    return value


def table_angles(machine: Machine, placed: PlacedEffect) -> list[float]:
    """Return angles or positions [rad, m] between the nodes of an effect's table, none for an effect without one."""
    if "x1" not in placed.values:
        return []
    x = np.array([placed.values[f"x{n + 1}"] for n in range(MAP_NODES)])
    contact = machine.find(placed.bodies[0]).contact
    scale = float(contact.radius) if contact is not None and placed.effect.soil is not None else 1.0
    middles: list[float] = ((x[1:] + x[:-1]) / (2 * scale)).tolist()
    return middles
