"""Tolerances of a machine: what no log can show to be exact, each as an effect of the catalogue with its size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.model import Model, build_cached
from excite.model.effects import CATALOGUE, allowed_places, with_effects
from excite.model.machine import EffectEntry, Machine, Quantity


@dataclass(frozen=True)
class Tolerance:
    """A quantity of the machine file and the standard deviation [SI] to which it is known.

    source: what it is in a budget. effect, where: the effect of the catalogue that an error of it is.
    """

    source: str
    effect: str
    where: str
    std: float
    unit: str

    @property
    def considered(self) -> bool:
        """Tell if no log narrows it: the signature of a gain is the signal itself, with its noise."""
        return self.effect in ("torque_gain", "encoder_scale")

    @property
    def label(self) -> str:
        """Name of the parameter that an error of it is."""
        return f"{self.effect}@{self.where}"


def tolerances(machine: Machine) -> tuple[Tolerance, ...]:
    """List the tolerances of a machine, those of the file or the default ones; sizes of zero are left out."""
    general = machine.tolerance
    found = list[Tolerance]()

    def add(kind: str, effect: str, std: dict[str, float]) -> None:
        unit = CATALOGUE[effect].unit
        for where in allowed_places(machine, CATALOGUE[effect]):
            if std.get(where):
                place = "" if where == "machine" else f" of {where.replace('_', ' ')}"
                found.append(Tolerance(f"{kind}{place}", effect, where, std[where], unit))

    joints = {b.where: b for b in machine.body}
    torques = {b.where: s for b in machine.body for s in machine.sensor if s.kind == "torque" and s.body == b.index}
    alignment = general.alignment if general.alignment is not None else 0.5 / float(machine.sampling_hz)
    add("alignment", "channel_delay", {w: _or(s.time_tolerance, alignment) for w, s in torques.items()})
    add("torque gain", "torque_gain", {w: _or(s.gain_tolerance, general.gain) for w, s in torques.items()})
    scales = {
        b.where: _or(s.gain_tolerance, general.gain)
        for b in machine.body
        for s in machine.sensor
        if s.kind == "angle" and s.body == b.index and s.resolution is None
    }
    add("gain of the position", "encoder_scale", scales if not machine.planar else {})
    contacts = {w: b.contact for w, b in joints.items() if b.contact is not None}
    radii = {w: c.radius.tolerance_or(general.radius * float(c.radius)) for w, c in contacts.items()}
    add("radius", "contact_radius", radii)
    wheels = {s.place or s.name: s for s in machine.sensor if s.kind == "wheel"}
    measured = {w: s.radius for w, s in wheels.items() if s.radius is not None}
    relative = {w: r.tolerance_or(general.radius * float(r)) / float(r) for w, r in measured.items()}
    add("radius", "measuring_wheel_radius", relative)
    turns = machine.planar and machine.body[0].coordinates[2] not in machine.locked
    lateral = {w: s.lateral.tolerance_or(general.length) for w, s in wheels.items() if turns and s.lateral is not None}
    add("position", "measuring_wheel_position", lateral)
    lengths = {w: b.d.tolerance_or(general.length) for w, b in joints.items()}
    add("length", "link_length", lengths)
    add("position", "contact_position", {w: lengths[w] for w in contacts if turns})
    gyros = {s.place or s.kind: _or(s.gain_tolerance, general.gain) for s in machine.sensor if s.kind == "yaw_rate"}
    add("gyro gain", "yaw_rate_gain", gyros)
    aside = {s.place or s.kind: general.level for s in machine.sensor if s.kind == "lateral_speed"}
    add("alignment", "lateral_speed_misalignment", aside)
    add("level", "ground_slope", {"machine": general.level})
    there = {e.label for e in machine.effect}
    return tuple(sorted((x for x in found if x.label not in there), key=lambda x: x.considered))


def _or(stated: float | None, default: float) -> float:
    return default if stated is None else stated


def with_tolerances(model: Model, every: Sequence[Tolerance]) -> Model:
    """Return the model in which the error of each tolerance is a parameter, known to be zero within the tolerance."""
    if not every:
        return model
    entries = [_entry(x) for x in every]
    wide = build_cached(with_effects(model.machine, *entries).model_dump_json())
    n = len(model.base.names)
    own = model.machine.model_copy(update={"effect": tuple(entries)})
    return replace(
        wide,
        nominal=np.concatenate([model.nominal, wide.nominal[n:]]),
        scale=np.concatenate([model.scale, wide.scale[n:]]),
        known=model.known.extended(len(every)).with_amounts(own, wide.base.names),
    )


def with_channel_errors(model: Model, every: Sequence[Tolerance]) -> Model:
    """Return the model with names, sizes and prior of errors of torque channels, which no equation of motion has.

    A large machine takes long to build anew; its equations stay those without tolerances.
    """
    entries = [_entry(x) for x in every]
    names = (*model.base.names, *(x.label for x in every))
    own = model.machine.model_copy(update={"effect": tuple(entries)})
    return replace(
        model,
        base=replace(model.base, names=names),
        nominal=np.concatenate([model.nominal, np.zeros(len(every))]),
        scale=np.concatenate([model.scale, [x.std for x in every]]),
        known=model.known.extended(len(every)).with_amounts(own, names),
    )


def _entry(one: Tolerance) -> EffectEntry:
    amount = Quantity(value=0.0, source="definition", known=one.std)
    return EffectEntry(name=one.effect, where=one.where, amount=amount, shape={})
