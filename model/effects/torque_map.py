"""A torque as a table of one signal: what no other effect explains, as diagnosis found it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from excite.errors import MachineError
from excite.model.effects import sizes
from excite.model.effects.effect import SampleView, Shape, Values, unit_size

MAP_NODES = 11  # rows of the table; chosen
SIGNALS = ("angle", "speed", "torque")  # in the order of the shape `signal`
_NODES = tuple(np.linspace(-1, 1, MAP_NODES))


def map_shapes() -> dict[str, Shape]:
    """Declare signal, nodes and torques of the table; a bump of 5 % of the joint's dry friction by default."""
    listed = ", ".join(f"{k}: {name}" for k, name in enumerate(SIGNALS))
    nodes = {f"x{k + 1}": _constant("-", x) for k, x in enumerate(_NODES)}
    nodes["x1"] = _constant("-", _NODES[0], meaning="x1 to x11: the signal [rad, rad/s, N m; sliding: m, m/s, N]")
    torques = {f"f{k + 1}": _constant("N m", (1 - x**2) ** 2) for k, x in enumerate(_NODES)}
    torques["f1"] = _constant("N m", 0.0, meaning="f1 to f11: the torque there, linear between, constant beyond")
    return {
        "signal": _constant("-", 1.0, meaning=listed, only=tuple(float(k) for k in range(len(SIGNALS)))),
        "of": _constant("-", -1.0, meaning="number of the body whose signal it is; -1: of the joint itself"),
        **nodes,
        **torques,
    }


def _constant(unit: str, default: float, meaning: str = "", only: tuple[float, ...] = ()) -> Shape:
    size = sizes.coulomb(0.05) if unit == "N m" else unit_size
    return Shape(unit, default, (default,), size, whole=True, meaning=meaning, only=only, either_sign=True)


def table_shapes(signal: str, of: int, x: Sequence[float], f: Sequence[float]) -> dict[str, float]:
    """Return the shapes of a table: torques f (MAP_NODES,) at x (MAP_NODES,) of a body's signal."""
    head = {"signal": float(SIGNALS.index(signal)), "of": float(of)}
    return head | {f"{key}{k + 1}": float(v) for key, row in (("x", x), ("f", f)) for k, v in enumerate(row)}


def resist_by_table(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque of a table on joint k. Raises MachineError for nodes out of order or an unknown body."""
    x, f = ([float(p[f"{key}{n + 1}"]) for n in range(MAP_NODES)] for key in "xf")
    if not (np.diff(x) > 0).all():
        raise MachineError(
            f"effect torque_map: x1 to x{MAP_NODES} must increase (got {', '.join(f'{v:g}' for v in x)})"
        )
    signals: Sequence[Mapping[int, ca.SX]] = (s.q, s.w, s.u)
    own, of = signals[int(p["signal"])], int(p["of"])
    if (k if of < 0 else of) not in own:
        allowed = ", ".join(str(n) for n in own)
        raise MachineError(f"effect torque_map: of must be the number of a joint, one of {allowed}, or -1 (got {of})")
    at, torque = own[k if of < 0 else of], ca.SX(f[0])
    for n in range(MAP_NODES - 1):
        torque += (f[n + 1] - f[n]) / (x[n + 1] - x[n]) * (ca.fmin(ca.fmax(at, x[n]), x[n + 1]) - x[n])
    return -p["A"] * torque
