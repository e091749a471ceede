"""Checks of what a machine's bodies, sensors, problems and surroundings say of each other.

Each raises ValueError with the key of the machine file and what is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from excite.model.machine import hydraulics
from excite.model.machine.body import Body, Coupling
from excite.model.machine.problem import Problem
from excite.model.machine.sensor import Sensor
from excite.model.machine.surroundings import Tool, World
from excite.text import did_you_mean


def check_tree(bodies: Sequence[Body]) -> None:
    """Check indices, names and antecedents of the bodies."""
    planar = bodies[0].joint == "planar"
    seen: set[int] = set()
    names: set[str] = set()
    for k, body in enumerate(bodies):
        if body.index in seen:
            raise ValueError(f"body[{k}].index: {body.index} is given twice, every body needs its own")
        if k == 0 and body.antecedent != "ground":
            raise ValueError(f'body[0].antecedent: the first body must stand on "ground" (got {body.antecedent})')
        grounded = body.antecedent == "ground" and not planar and body.joint != "planar"
        if k > 0 and body.antecedent not in seen and not grounded:
            known = ", ".join(map(str, sorted(seen)))
            raise ValueError(f"body[{k}].antecedent: {body.antecedent} is not a body above it, allowed: {known}")
        if names & {body.name, body.where}:
            raise ValueError(f"body[{k}].name: {body.where} is given twice, every body and place needs its own")
        if body.contact and (body.antecedent == "ground" or not planar):
            raise ValueError(f"body[{k}].contact: needs a chassis on a planar root to carry it")
        seen.add(body.index)
        names |= {body.name, body.where}


def check_couplings(bodies: Sequence[Body], locked: Sequence[str]) -> None:
    """Check that coupled joints name others that exist, lead and, for a common torque, are driven."""
    known = {b.index: b for b in bodies}
    for k, body in enumerate(bodies):
        _check_rotor(k, body, known)
        if body.moves_with is not None:
            _check_leader(f"body[{k}].moves_with", body, body.moves_with, known)
            _check_common_motion(k, body, known[body.moves_with.joint], locked)
        if body.driven_with is not None:
            _check_leader(f"body[{k}].driven_with", body, body.driven_with, known)
            _check_common_torque(k, body, body.driven_with, known)


def _check_rotor(k: int, body: Body, known: Mapping[int, Body]) -> None:
    """Check the joint that turns the rotor of body k as well."""
    turns_with = None if body.drive is None else body.drive.turns_with
    if turns_with is None:
        return
    other, where = known.get(turns_with.joint), f"body[{k}].drive.turns_with"
    if other is None or other.joint != "revolute" or other is body or not body.actuated:
        raise ValueError(f"{where}: needs another revolute joint, and a drive at this one (actuated)")
    if other.drive is not None and other.drive.turns_with is not None:
        raise ValueError(f"{where}.joint: the rotor of joint {other.index} turns with another one itself")
    if turns_with.offset.value:
        raise ValueError(f"{where}.offset: is for moves_with, a rotor has none")


def _check_leader(key: str, body: Body, coupling: Coupling, known: Mapping[int, Body]) -> None:
    """Check that the joint that a body is coupled to is another one that moves."""
    other = known.get(coupling.joint)
    if other is None or other.joint not in ("revolute", "prismatic") or other is body:
        joints = [b.index for b in known.values() if b.joint in ("revolute", "prismatic") and b is not body]
        raise ValueError(f"{key}.joint: no other joint {coupling.joint}, allowed: {joints}")


def _check_common_motion(k: int, body: Body, other: Body, locked: Sequence[str]) -> None:
    """Check the joint that takes body k along."""
    where = f"body[{k}].moves_with.joint"
    if other.moves_with is not None:
        raise ValueError(
            f"{where}: joint {other.index} moves with joint {other.moves_with.joint} itself: give that one"
        )
    if body.friction is not None and other.friction is None:
        raise ValueError(f"{where}: joint {other.index} needs friction of its own, as its speed decides")
    for one in (body, other):
        if one.coordinates[0] in locked:
            raise ValueError(f"locked: {one.coordinates[0]} is coupled by moves_with, take one of both out")


def _check_common_torque(k: int, body: Body, coupling: Coupling, known: Mapping[int, Body]) -> None:
    """Check the joint whose drive also drives body k."""
    other = known[coupling.joint]
    if coupling.offset.value:
        raise ValueError(f"body[{k}].driven_with.offset: is for moves_with, a torque has none")
    if not other.actuated:
        raise ValueError(
            f"body[{k}].driven_with.joint: joint {other.index} isn't actuated: give the drive that both share"
        )
    if body.moves_with is not None and known[body.moves_with.joint].actuated:
        raise ValueError(f"body[{k}].driven_with: it moves with a driven joint; give that one the torque")


def check_springs(bodies: Sequence[Body], locked: Sequence[str]) -> None:
    """Check that springs between joints join two that move on their own."""
    moving = [b for b in bodies if b.joint in ("revolute", "prismatic") and b.moves_with is None]
    for k, body in enumerate(bodies):
        if body.spring is None or body.spring.joint is None:
            continue
        allowed = {b.index: b for b in moving if b is not body and b.coordinates[0] not in locked}
        if body.spring.joint not in allowed:
            raise ValueError(
                f"body[{k}].spring.joint: no other free joint {body.spring.joint}, allowed: {list(allowed)}"
            )
        if body.joint != allowed[body.spring.joint].joint:
            raise ValueError(f"body[{k}].spring.joint: joins a joint that turns with one that slides")
        if body not in moving or body.coordinates[0] in locked:
            raise ValueError(f"body[{k}].spring.joint: joint {body.index} doesn't move on its own")


def check_locked(bodies: Sequence[Body], locked: Sequence[str]) -> None:
    """Check that locked coordinates exist, and that none carries a contact or leaves the heading free."""
    every = [c for b in bodies for c in b.coordinates]
    for c in locked:
        if c not in every:
            raise ValueError(f"locked: no coordinate {c}, allowed: {', '.join(every)}{did_you_mean(c, every)}")
    if bodies[0].joint == "planar":
        x, y, heading = bodies[0].coordinates
        if {x, y} & set(locked) and heading not in locked:
            raise ValueError(f"locked: {x} and {y} can only be held where {heading} is held too")
    for body in bodies:
        if body.contact and body.coordinates[0] in locked:
            raise ValueError(f"locked: {body.coordinates[0]} has a contact that must turn, take that out first")


def check_surroundings(bodies: Sequence[Body], world: World, tool: Tool | None) -> None:
    """Check the bodies that tool and surroundings name."""
    if tool is not None and tool.body not in {b.index for b in bodies}:
        raise ValueError(f"tool.body: no body {tool.body}, allowed: {[b.index for b in bodies]}")
    things = [*(p.name for p in world.plane), *(b.name for b in world.box)]
    every = ["ground", "floor", *(b.name for b in bodies), *things]
    for name in things:
        if every.count(name) > 1:
            raise ValueError(f"world: the name {name} is used twice")
    for k, pair in enumerate(world.apart):
        for name in pair:
            if name not in every:
                hint = did_you_mean(name, every)
                raise ValueError(f"world.apart[{k}]: nothing is called {name}, allowed: {', '.join(every)}{hint}")


def check_sensors(
    sensors: Sequence[Sensor], bodies: Sequence[Body], locked: Sequence[str], time_column: str, torque_unit: str | None
) -> None:
    """Check bodies, names and columns of the sensors.

    torque_unit: SI unit that torques are known in instead of N m or N, None if they are known in these.
    """
    known = {b.index: b for b in bodies}
    names: set[str] = set()
    columns: set[str] = {time_column}
    measured: set[tuple[str, int]] = set()
    for k, sensor in enumerate(sensors):
        _check_measured_body(k, sensor, bodies, known)
        if sensor.name in names:
            raise ValueError(f"sensor[{k}].name: {sensor.name} is used twice")
        for column in sensor.columns:
            if column in columns:
                raise ValueError(f"sensor[{k}].column: {column} is used twice")
            columns.add(column)
        other = not sensor.is_bare or sensor.driven_by != torque_unit
        if torque_unit is not None and sensor.kind == "torque" and other:
            raise ValueError(
                f"sensor[{k}].unit: either every torque is a current (or every one a voltage or a duty cycle) of"
                " motors whose common torque_constant is unknown, or none: joints share parameters, which can't be"
                " in two units"
            )
        own = [s for s in sensors if s.body == sensor.body]
        if sensor.cylinders:
            _check_cylinders(f"sensor[{k}].cylinders", sensor, known[sensor.body], own, locked)
        if sensor.zero_is_sought:
            _check_sought_zero(f"sensor[{k}].zero", known[sensor.body], own)
        twin = (sensor.kind, sensor.body)
        if sensor.kind in ("angle", "torque") and twin in measured:
            raise ValueError(f"sensor[{k}].kind: joint {sensor.body} has two sensors of kind {sensor.kind}, keep one")
        measured.add(twin)
        names.add(sensor.name)
    free = [b for b in bodies if b.actuated and b.coordinates[0] not in locked]
    if torque_unit is not None and len({b.joint for b in free}) > 1:
        raise ValueError("sensor.torque_constant: revolute and prismatic joints can't share an unknown one, give it")


def _check_measured_body(k: int, sensor: Sensor, bodies: Sequence[Body], known: Mapping[int, Body]) -> None:
    """Check that sensor k is on a body that has what it measures."""
    key, index = f"sensor[{k}].body", sensor.body
    if index not in known:
        raise ValueError(f"{key}: no body {index}, allowed: {sorted(known)}")
    jointed = [b.index for b in bodies if b.joint in ("revolute", "prismatic")]
    if sensor.kind == "angle" and index not in jointed:
        raise ValueError(f"{key}: body {index} has no joint to measure, allowed: {jointed}")
    leader = known[index].moves_with
    if sensor.kind == "angle" and leader is not None and leader.offset.value:
        raise ValueError(f"{key}: joint {index} moves with another one by an offset: measure that one")
    driven = [b.index for b in bodies if b.actuated]
    if sensor.kind == "torque" and index not in driven:
        raise ValueError(
            f"{key}: joint {index} isn't actuated, allowed: {driven}; a common torque is that of the joint it is driven"
            " with"
        )
    if sensor.kind not in ("angle", "torque") and bodies[0].joint != "planar":
        raise ValueError(f"sensor[{k}].kind: {sensor.kind} needs a planar root, allowed here: angle, torque")
    if sensor.kind not in ("angle", "torque") and index != bodies[0].index:
        raise ValueError(
            f"{key}: {sensor.kind} is measured on the first chassis alone, body {bodies[0].index} (got {index}); leave"
            " the sensor out, or begin the table with that chassis"
        )


def _check_sought_zero(key: str, body: Body, sensors: Sequence[Sensor]) -> None:
    """Check that a zero is sought of the encoder that gives a joint's coordinate. sensors: those of the joint."""
    if body.moves_with is not None:
        raise ValueError(
            f"{key}: joint {body.index} moves with joint {body.moves_with.joint}: seek that one's zero alone"
        )
    if any(c.anchor is not None for s in sensors for c in s.cylinders):
        raise ValueError(f"{key}: can't be sought, the lever of the cylinders at joint {body.index} depends on it")


def _check_cylinders(key: str, sensor: Sensor, body: Body, sensors: Sequence[Sensor], locked: Sequence[str]) -> None:
    """Check that each pressure turns the joint the same way along its range, and that its angle is measured."""
    if body.joint != "revolute":
        raise ValueError(f"{key}: turn a revolute joint, joint {body.index} is {body.joint}")
    pinned = any(c.anchor is not None for c in sensor.cylinders)
    angles = [s for s in sensors if s.kind == "angle" and not s.is_rate]
    if pinned and not angles and body.coordinates[0] not in locked:
        raise ValueError(f"{key}: the lever depends on the angle of joint {body.index}, which no sensor measures")
    low, high = body.limit.position_range or (-0.5, 0.5)
    for arm in hydraulics.torque_per_pressure(sensor.displacement, sensor.cylinders, np.linspace(low, high, 41)):
        if not (arm > 0).all() and not (arm < 0).all():
            within = f"{high:g} rad" if low == -high else f"{low:g} to {high:g} rad"
            raise ValueError(f"{key}: a pressure has no lever at some angle within {within}, check the pins")


def check_problem(name: str, problem: Problem, bodies: Sequence[Body], coordinates: Sequence[str]) -> None:
    """Check the lane of a machine on the plane, and the joints and ranges of poses. coordinates: the free ones."""
    indices = [b.index for b in bodies]
    for i in problem.lane_points:
        if i not in indices:
            raise ValueError(f"problems.{name}.lane_points: no body {i}, allowed: {sorted(indices)}")
    if bodies[0].joint == "planar" and problem.lane_m is None:
        raise ValueError(f"problems.{name}.lane_m: is missing, a machine on the plane needs length and width")
    jointed = {b.coordinates[0]: b for b in bodies if b.joint in ("revolute", "prismatic")}
    free = [c for c in coordinates if c in jointed]
    for key in ("start_pose", "end_pose"):
        for c, place in getattr(problem, key).items():
            if c not in free:
                raise ValueError(f"problems.{name}.{key}: no joint coordinate {c}, allowed: {', '.join(free)}")
            low, high = jointed[c].limit.position_range or (-math.inf, math.inf)
            if not low <= place <= high:
                raise ValueError(
                    f"problems.{name}.{key}.{c}: must be within the joint's range, {low:g} to {high:g} (got {place:g})"
                )
