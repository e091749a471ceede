"""Effects on a machine: where each of the catalogue may sit, and entries of a machine file made into placed effects."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence

import casadi as ca

from excite.errors import MachineError
from excite.model.effects import sizes
from excite.model.effects.catalogue import CATALOGUE
from excite.model.effects.effect import DEFAULT_DURATION, Effect, PlacedEffect, Site
from excite.model.machine import Body, EffectEntry, Machine, Quantity, Sensor

SUSPICIOUS_RATIO = 50.0  # times what an effect usually is, from which its amount is doubtful
MIN_TYPICAL_FRICTION = 1e-5  # N m: a usual friction below which there is none to compare with


def allowed_places(machine: Machine, effect: Effect) -> dict[str, tuple[tuple[int, ...], str | None]]:
    """Where an effect may sit on a machine: name of the place -> bodies, sensor."""
    driven = list(machine.actuated)
    rubbing = [b for b in machine.body if b.friction is not None and b.coordinates[0] in machine.coordinates]
    pulling = [b for b in driven if b.contact is not None]
    together = machine.contacts if effect.soil else pulling
    each = {"joints": rubbing, "drives": driven, "contacts": machine.contacts, "driven_contacts": pulling}
    if machine.planar:
        each["articulation"] = [b for b in driven if b.contact is None]
    sensors = [s for s in machine.sensors("full") if not (effect.angular and s.is_rate)]
    root = machine.body[0].index
    found: dict[str, tuple[tuple[int, ...], str | None]] = {}
    for place in effect.places:
        if place in each:
            found |= {b.where: ((b.index,), _angle_sensor(sensors, b)) for b in each[place]}
        elif place == "drive" and len(together) > 1:
            found["drive"] = tuple(b.index for b in together), None
        elif place == "wheels":
            found |= {s.place or s.name: ((s.body,), s.name) for s in sensors if s.kind == "wheel"}
        elif place in ("yaw_rate", "lateral_speed"):
            found |= {s.place or place: ((s.body,), s.name) for s in sensors if s.kind == place}
        elif place == "machine" and machine.planar and (effect.gravity or payload_body(machine) is not None):
            found["machine"] = (root,), None
    if effect.soil or effect.push:
        found = {w: at for w, at in found.items() if all(machine.find(k).contact for k in at[0])}
    if effect.angular:
        found = {w: at for w, at in found.items() if at[1] is not None}
    return found


def _angle_sensor(sensors: Sequence[Sensor], body: Body) -> str | None:
    return next((s.name for s in sensors if s.kind == "angle" and s.body == body.index), None)


def payload_body(machine: Machine) -> int | None:
    """The body whose load may move: the last chassis of those that turn, as a moment that never turns shows nowhere."""
    chassis = [b for b in machine.body if b.inertia is not None and not b.inertia.axisymmetric and b.contact is None]
    turning = [b.index for b in chassis if _turns_freely(machine, b)]
    return turning[-1] if turning else None


def _turns_freely(machine: Machine, body: Body) -> bool:
    """Whether a free joint turns a body: its own, or one that carries it."""
    own = {"planar": body.coordinates[2:], "revolute": body.coordinates}.get(body.joint, ())
    if set(own) & set(machine.coordinates):
        return True
    return not isinstance(body.antecedent, str) and _turns_freely(machine, machine.find(body.antecedent))


def payload_change(machine: Machine, change: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    """What an `inertia` hook changes, by standard parameter of the body whose load may move."""
    return {f"{name}{payload_body(machine)}": value for name, value in change.items()}


def parse_effect(text: str, machine: Machine, duration: float) -> EffectEntry:
    """`NAME[@WHERE]=AMOUNT` as an entry of a machine file, shapes at their defaults for a log of duration [s].

    Raises MachineError.
    """
    name, _, amount = text.partition("=")
    name, _, where = name.partition("@")
    try:
        value = Quantity(value=float(amount), source="assumed")
    except ValueError:
        raise MachineError(f"effect {text}: must be NAME[@WHERE]=AMOUNT with a number behind the =") from None
    if not name or not name.replace("_", "").isalnum() or (where and not where.replace("_", "").isalnum()):
        raise MachineError(f"effect {text}: must be NAME[@WHERE]=AMOUNT")
    entry = EffectEntry.model_construct(name=name, where=where or None, amount=value, std=None, shape={})
    found = place_effect(machine, entry, duration)
    if found.effect.resisting and float(value) < 0:
        raise MachineError(f"effect {text}: must not be negative, what resists doesn't push")
    shapes = {s: Quantity(value=found.values[s], source="assumed") for s in found.shapes}
    return EffectEntry(name=name, where=found.where, amount=value, shape=shapes)


def with_effects(machine: Machine, *entries: EffectEntry) -> Machine:
    """The machine with these effects beside those that it has."""
    return machine.model_copy(update={"effect": (*machine.effect, *entries)})


def without_effect(machine: Machine, name: str) -> Machine:
    """The machine without the effect of this name (effect@place)."""
    rest = tuple(e for e in machine.effect if e.label != name)
    return machine.model_copy(update={"effect": rest})


def shapes_possible(machine: Machine, effect: PlacedEffect) -> bool:
    """Whether an effect's shapes are such as there are at its place."""
    site = Site.of(machine, effect.bodies)
    ranges = {n: [x * s.size(site) for x in s.within] for n, s in effect.shapes.items() if s.within is not None}
    return all(low <= effect.values[n] <= high for n, (low, high) in ranges.items())


def size_warning(machine: Machine, effect: PlacedEffect) -> str | None:
    """What is said of an effect that is far larger than such effects are at its place."""
    usual, amount = effect.effect.amount(Site.of(machine, effect.bodies)), effect.values["A"]
    large, small = (usual, abs(amount)) if effect.effect.inverse else (abs(amount), usual)
    unit = effect.effect.unit
    if large < SUSPICIOUS_RATIO * small or (usual < MIN_TYPICAL_FRICTION and unit.startswith("N m")):
        return None
    much = f"{amount:g} {unit}".removesuffix(" -")
    return f"{effect.name}: {much}, usual are about {usual:.1g}: in another unit?"


def place_effect(machine: Machine, entry: EffectEntry, duration: float = DEFAULT_DURATION) -> PlacedEffect:
    """An effect of a machine file, checked. Raises MachineError for an unknown name, place or shape.

    duration [s]: of the log, which the defaults of some shapes are shares of.
    """
    effect = CATALOGUE.get(entry.name)
    if effect is None:
        parts = {part for part in entry.name.split("_") if len(part) > 2}
        like = difflib.get_close_matches(entry.name, CATALOGUE, n=3)
        like = like or [n for n in CATALOGUE if parts & set(n.split("_"))]
        hint = f", is {' or '.join(like)} meant?" if like else ":"
        raise MachineError(f"{machine.name}: effect {entry.name}: unknown{hint} `excite docs` tells of all")
    allowed = allowed_places(machine, effect)
    where = entry.where or (next(iter(allowed)) if len(allowed) == 1 else "")
    if where not in allowed:
        options = ", ".join(allowed) or "none on this machine"
        raise MachineError(f"{machine.name}: effect {entry.name}: where must be one of {options} (got {where or '-'})")
    for name in entry.shape:
        if name not in effect.shapes:
            options = ", ".join(effect.shapes) or "none"
            raise MachineError(f"{machine.name}: effect {entry.name}: no shape {name}, allowed: {options}")
    if effect.positive and not float(entry.amount) > 0:
        raise MachineError(f"{machine.name}: effect {entry.name}: amount must be > 0 (got {float(entry.amount):g})")
    bodies, sensor = allowed[where]
    if effect.sensed and sensor is None:
        raise MachineError(f"{machine.name}: effect {entry.name}: {where} has no sensor that it could sit in")
    site = Site.of(machine, bodies, duration)
    values = {"A": float(entry.amount)}
    for name, shape in effect.shapes.items():
        given = entry.shape.get(name)
        values[name] = float(given) if given is not None else shape.default * shape.size(site)
        if shape.only and values[name] not in shape.only:
            options = ", ".join(f"{x:g}" for x in shape.only)
            raise MachineError(
                f"{machine.name}: effect {entry.name}: shape {name} must be one of {options} (got {values[name]:g})"
            )
    made = PlacedEffect(effect, where, bodies, sensor, values)
    for name, shape in made.shapes.items():
        stated = (
            name in entry.shape and entry.shape[name].source != "identified"
        )  # a fit's are above zero by themselves
        least = 0 in shape.grid or shape.size is sizes.duration  # an instant may be the log's beginning
        if stated and not (shape.signed or shape.only) and (values[name] < 0 or (values[name] == 0 and not least)):
            raise MachineError(f"{machine.name}: effect {entry.name}: shape {name} must be > 0 (got {values[name]:g})")
    return made
