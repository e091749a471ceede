"""Effects on a machine: the places each may have, and checked effects from entries of a machine file."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence

import casadi as ca

from excite.errors import MachineError
from excite.model import mechanics
from excite.model.effects import sizes
from excite.model.effects.catalogue import CATALOGUE
from excite.model.effects.effect import DEFAULT_DURATION, Effect, PlacedEffect, Site
from excite.model.machine import Body, EffectEntry, Machine, Quantity, Sensor
from excite.text import format_number

Place = tuple[tuple[int, ...], tuple[str, ...]]  # indices of bodies, names of sensors

SUSPICIOUS_RATIO = 50.0  # multiple of the typical magnitude that suggests a wrong unit; chosen
MIN_TYPICAL_FRICTION = 1e-5  # N m, friction below this is no reference for others; chosen


def allowed_places(machine: Machine, effect: Effect) -> dict[str, Place]:
    """Return the places where a machine may have an effect: name -> (indices of bodies, names of sensors)."""
    sensors = [s for s in machine.sensors("full") if not (effect.angle_only and s.is_rate)]
    each, whole = _bodies_of_places(machine), _single_places(machine, effect, sensors)
    found: dict[str, Place] = {}
    for place in effect.places:
        found |= {b.where: ((b.index,), _angle_sensor(sensors, b)) for b in each.get(place, ())}
        found |= whole.get(place, {})
    if effect.soil or effect.push:
        found = {w: at for w, at in found.items() if all(machine.find(k).contact for k in at[0])}
    if effect.angle_only:
        found = {w: at for w, at in found.items() if at[1]}
    if any(shape.circular for shape in effect.shapes.values()):  # a phase has no meaning at a sliding joint
        found = {w: at for w, at in found.items() if w == "machine" or not is_straight(machine, at[0])}
    return found


def _bodies_of_places(machine: Machine) -> dict[str, Sequence[Body]]:
    """Return the bodies by kinds of place at which each may have an effect of its own."""
    driven = machine.actuated
    return {
        "joints": machine.rubbing,
        "drives": driven,
        "contacts": machine.contacts,
        "driven_contacts": [b for b in driven if b.contact is not None],
        "articulation": [b for b in driven if b.contact is None],
        "free_drives": () if machine.contacts else driven,
        "links": () if machine.contacts else [b for b in machine.body if _has_link(b)],
    }


def _single_places(machine: Machine, effect: Effect, sensors: Sequence[Sensor]) -> dict[str, dict[str, Place]]:
    """Return the places that are several bodies, sensors, or the machine as a whole, by kind of place."""
    pulling = [b for b in machine.actuated if b.contact is not None]
    together = tuple(b.index for b in (machine.contacts if effect.soil else pulling))
    contacts = tuple(b.index for b in machine.contacts)
    wheels = [s for s in sensors if s.kind == "wheel"]
    found: dict[str, dict[str, Place]] = {
        kind: {s.place or kind: ((s.body,), (s.name,)) for s in sensors if s.kind == kind}
        for kind in ("yaw_rate", "lateral_speed")
    }
    found["wheels"] = {s.place or s.name: ((s.body,), (s.name,)) for s in wheels}
    if len(wheels) > 1:
        found["wheel_pair"] = {"measuring_wheels": ((wheels[0].body,), tuple(s.name for s in wheels))}
    if len(together) > 1:
        found["drive"] = {"drive": (together, ())}
    if len(contacts) > 1:
        found["contact_group"] = {"contacts": (contacts, ())}
    if _has_place(machine, effect):
        found["machine"] = {"machine": ((machine.body[0].index,), ())}
    return found


def _has_link(body: Body) -> bool:
    """Tell if a joint is away from the one before it."""
    moves = body.joint in ("revolute", "prismatic") and body.antecedent != "ground"
    return moves and mechanics.link_length(body) > 0


def _has_place(machine: Machine, effect: Effect) -> bool:
    """Tell if an effect on the machine as a whole has a place on it."""
    if machine.planar:
        return effect.gravity is not None or payload_body(machine) is not None
    turns = any(b.joint == "revolute" for b in machine.body)  # along a slide, gravity is an offset
    return effect.gravity is not None and any(machine.gravity) and not machine.contacts and turns


def _angle_sensor(sensors: Sequence[Sensor], body: Body) -> tuple[str, ...]:
    """Return the name of the sensor that measures a body's angle, () for none."""
    return tuple(s.name for s in sensors if s.kind == "angle" and s.body == body.index)[:1]


def payload_body(machine: Machine) -> int | None:
    """Return the body whose payload may move: the last chassis that turns, as others do not show a first moment."""
    chassis = [b for b in machine.body if b.inertia is not None and not b.inertia.axisymmetric and b.contact is None]
    turning = [b.index for b in chassis if _turns_freely(machine, b)]
    return turning[-1] if turning else None


def _turns_freely(machine: Machine, body: Body) -> bool:
    """True if a free joint turns the body: its own, or one below it in the tree."""
    own = {"planar": body.coordinates[2:], "revolute": body.coordinates}.get(body.joint, ())
    if set(own) & set(machine.coordinates):
        return True
    return not isinstance(body.antecedent, str) and _turns_freely(machine, machine.find(body.antecedent))


def payload_change(machine: Machine, change: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    """Name the changes of an `inertia` hook by standard parameter of the payload's body."""
    return {f"{name}{payload_body(machine)}": value for name, value in change.items()}


def parse_effect(text: str, machine: Machine, duration: float) -> EffectEntry:
    """Parse `NAME[@WHERE]=AMOUNT` into an entry of a machine file, with default shapes for a log of duration [s].

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
    if found.effect.opposes_motion and float(value) < 0:
        raise MachineError(f"effect {text}: must not be negative, a resistance does not push")
    shapes = {s: Quantity(value=found.values[s], source="assumed") for s in found.shapes}
    return EffectEntry(name=name, where=found.where, amount=value, shape=shapes)


def with_effects(machine: Machine, *entries: EffectEntry) -> Machine:
    """Return the machine with further effects."""
    return machine.model_copy(update={"effect": (*machine.effect, *entries)})


def without_effect(machine: Machine, name: str) -> Machine:
    """Return the machine without one effect; name: effect@place."""
    rest = tuple(e for e in machine.effect if e.label != name)
    return machine.model_copy(update={"effect": rest})


def is_straight(machine: Machine, bodies: Sequence[int]) -> bool:
    """Tell if an effect on these bodies acts on a sliding joint."""
    return machine.find(bodies[0]).joint == "prismatic"


def shapes_possible(machine: Machine, effect: PlacedEffect) -> bool:
    """True if all shapes are in their ranges (`Shape.within`)."""
    site = Site.of(machine, effect.bodies)
    ranges = {n: [x * s.size(site) for x in s.within] for n, s in effect.shapes.items() if s.within is not None}
    return all(low <= effect.values[n] <= high for n, (low, high) in ranges.items())


def size_warning(machine: Machine, effect: PlacedEffect) -> str | None:
    """Return a warning if an effect is far larger than typical at its place, else None."""
    typical, magnitude = effect.effect.typical_magnitude(Site.of(machine, effect.bodies)), effect.values["A"]
    large, small = (typical, abs(magnitude)) if effect.effect.inverse else (abs(magnitude), typical)
    unit = effect.unit
    if large < SUSPICIOUS_RATIO * small or (typical < MIN_TYPICAL_FRICTION and unit.startswith("N")):
        return None
    much = f"{magnitude:g} {unit}".removesuffix(" -")
    return f"{effect.name}: {much}, usual are about {format_number(typical, 1)}: in another unit?"


def place_effect(machine: Machine, entry: EffectEntry, duration: float = DEFAULT_DURATION) -> PlacedEffect:
    """Check an entry of a machine file and return its effect.

    duration [s]: length of the log; defaults of some shapes are shares of it.
    Raises MachineError for an unknown name, place or shape, or a value out of range.
    """
    effect = _known_effect(machine, entry.name)
    allowed = allowed_places(machine, effect)
    where = entry.where or (next(iter(allowed)) if len(allowed) == 1 else "")
    if where not in allowed:
        options = ", ".join(allowed) or "none on this machine"
        raise MachineError(f"{machine.name}: effect {entry.name}: where must be one of {options} (got {where or '-'})")
    for name in entry.shape:
        if name not in effect.shapes:
            options = ", ".join(effect.shapes) or "none"
            raise MachineError(f"{machine.name}: effect {entry.name}: no shape {name}, allowed: {options}")
    is_error = not isinstance(entry.amount.known, bool)  # of the file, about zero
    if effect.positive and not float(entry.amount) > 0 and not is_error:
        raise MachineError(f"{machine.name}: effect {entry.name}: amount must be > 0 (got {float(entry.amount):g})")
    bodies, sensors = allowed[where]
    if effect.sensor_only and not sensors:
        raise MachineError(f"{machine.name}: effect {entry.name}: {where} has no sensor that it could sit in")
    site = Site.of(machine, bodies, duration)
    values = {"A": float(entry.amount)} | _shape_values(machine, effect, entry, site)
    made = PlacedEffect(effect, where, bodies, sensors, values, is_straight(machine, bodies))
    for name, shape in made.shapes.items():
        # Identified shapes are positive already; an instant may be the start of the log.
        stated = name in entry.shape and entry.shape[name].source != "identified"
        least = 0 in shape.grid or shape.size is sizes.duration
        if stated and not (shape.signed or shape.only) and (values[name] < 0 or (values[name] == 0 and not least)):
            raise MachineError(f"{machine.name}: effect {entry.name}: shape {name} must be > 0 (got {values[name]:g})")
    return made


def _known_effect(machine: Machine, name: str) -> Effect:
    """Return the effect of this name. Raises MachineError with names like it."""
    if name in CATALOGUE:
        return CATALOGUE[name]
    parts = {part for part in name.split("_") if len(part) > 2}
    like = difflib.get_close_matches(name, CATALOGUE, n=3)
    like = like or [n for n in CATALOGUE if parts & set(n.split("_"))]
    hint = f", is {' or '.join(like)} meant?" if like else ":"
    raise MachineError(f"{machine.name}: effect {name}: unknown{hint} `excite docs` lists all")


def _shape_values(machine: Machine, effect: Effect, entry: EffectEntry, site: Site) -> dict[str, float]:
    """Return the shapes of an entry, by default those of the effect. Raises MachineError for one that can't be."""
    values = {}
    for name, shape in effect.shapes.items():
        given = entry.shape.get(name)
        values[name] = float(given) if given is not None else shape.default * shape.size(site)
        if shape.only and values[name] not in shape.only:
            options = ", ".join(f"{x:g}" for x in shape.only)
            raise MachineError(
                f"{machine.name}: effect {entry.name}: shape {name} must be one of {options} (got {values[name]:g})"
            )
    return values
