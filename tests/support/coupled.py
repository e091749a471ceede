"""Machines whose joints share angles or torques, and sensors of speed over ground, as tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from excite.model.machine import load_machine

Table = dict[str, Any]


def quantity(value: float) -> Table:
    """Return a quantity of a machine file."""
    return {"value": value, "source": "assumed"}


def table_of(name: str) -> Table:
    """Return a shipped machine as a table."""
    return load_machine(name).model_dump(mode="json", exclude_none=True)


def with_changes(machine: Table, changes: Mapping[str, Table]) -> Table:
    """Change keys of the bodies with these names; None takes a key out."""
    bodies = [{**b, **changes.get(b["name"], {})} for b in machine["body"]]
    return machine | {"body": [{k: v for k, v in b.items() if v is not None} for b in bodies]}


def without_sensors(machine: Table, *kinds: str, of: tuple[int, ...] = ()) -> Table:
    """Leave out sensors of some kinds, of all bodies or of these."""
    return machine | {
        "sensor": [s for s in machine["sensor"] if s["kind"] not in kinds or (of and s["body"] not in of)]
    }


def chained_robot(ratio: float) -> Table:
    """The skid-steered robot with one motor for the two chained wheels of each side."""
    link = {side: {"joint": k, "ratio": quantity(ratio)} for side, k in (("left", 1), ("right", 2))}
    machine = with_changes(
        table_of("skid_robot"), {f"rear_{s}": {"actuated": False, "moves_with": x} for s, x in link.items()}
    )
    return without_sensors(machine, "angle", "torque", of=(3, 4))


def one_pump(ratio: float) -> Table:
    """The roller with one pump for both rolls, the rear one's motor larger by a ratio."""
    shared = {"actuated": False, "driven_with": {"joint": 1, "ratio": quantity(ratio)}}
    return without_sensors(with_changes(table_of("va12"), {"rear_roll": shared}), "torque", of=(4,))


def fifth_wheel() -> list[Table]:
    """A fifth wheel beside the axis of the first chassis that reads km/h in steps of 0.02 km/h."""
    return [
        {
            "name": "fifth",
            "kind": "forward_speed",
            "body": 0,
            "column": "v_kmh",
            "unit": "km/h",
            "lateral": quantity(0.8),
            "noise": quantity(0.01),
            "step": quantity(0.02 / 3.6),
        }
    ]


def gnss(rate_hz: float = 10.0, noise: float = 0.02) -> list[Table]:
    """Speed over ground and position of an antenna, at `rate_hz` readings per second; noise [m/s] of the speed."""
    at = {"ahead": quantity(-0.1), "lateral": quantity(0.05), "rate_hz": quantity(rate_hz), "body": 0}
    speed = {"name": "sog", "kind": "ground_speed", "column": "sog", "unit": "m/s", "noise": quantity(noise), **at}
    place = [
        {"name": k, "kind": k, "column": f"{k}_m", "unit": "m", "noise": quantity(0.015), **at} for k in ("x", "y")
    ]
    return [speed, *place]
