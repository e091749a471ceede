"""Descriptions of a model's parameters in words."""

from __future__ import annotations

from excite.model.machine import Body, Machine
from excite.model.prediction import Model

MOMENTS = {"MX": "first moment x", "MY": "first moment y", "MZ": "first moment z"}
INERTIA = {"XX": "about x", "YY": "about y", "ZZ": "about the axis", "XY": "xy", "XZ": "xz", "YZ": "yz"}
ACTING = {
    "Ia": "rotor inertia",
    "Kb": "damping by back-EMF",
    "Ks": "stiffness of the spring",
    "Ts": "spring torque at zero",
    "Ds": "damping of the spring",
    "Fv": "viscous friction",
    "Fs": "dry friction",
    "Kx": "lengthwise force per slip",
    "Ky": "sideways force per slip",
}


def parameter_descriptions(model: Model) -> dict[str, str]:
    """Describe every base parameter, by name: "viscous friction, JOINT".

    One that groups several standard parameters is called regrouped; `model.base.grouping` gives its sum.
    """
    words = {name: text for body in model.machine.body for name, text in _body_descriptions(body).items()}
    masses = {f"M{b.index}" for b in model.machine.body if b.inertia is not None}
    found: dict[str, str] = {}
    for name, k in zip(model.base.names, model.base.independent, strict=True):
        parts = model.base.grouping(name)
        own = words.get(model.base.standard[k]) or _effect_description(name)
        if len(masses) > 1 and parts == dict.fromkeys(masses, 1.0):
            own = "mass, whole machine"
        elif len(parts) > 1:
            own = f"regrouped {own}"
        found[name] = own
    return found


KINDS = {"yaw_rate": "yaw rate", "lateral_speed": "lateral speed", "x": "x", "y": "y"}  # of sensors of the chassis


def signal_descriptions(machine: Machine) -> dict[str, str]:
    """Describe every sensor by name: "angle, JOINT"; every sensor has words of its own."""
    words: dict[str, str] = {}
    for sensor in machine.sensors("full"):
        body = machine.find(sensor.body)
        kind = "force" if sensor.kind == "torque" and body.joint == "prismatic" else sensor.kind
        if sensor.kind in KINDS:
            words[sensor.name] = KINDS[sensor.kind]
        else:
            place = sensor.place or (sensor.name if sensor.kind == "wheel" else body.where)
            what = "angle" if kind == "wheel" else "position" if (kind, body.joint) == ("angle", "prismatic") else kind
            words[sensor.name] = f"{what}, {place.replace('_', ' ')}"
    clashing = [name for name, text in words.items() if list(words.values()).count(text) > 1]
    return words | {name: f"{words[name]} ({name})" for name in clashing}


def _body_descriptions(body: Body) -> dict[str, str]:
    """Describe a body's standard parameters: inertia by the body's name, forces by the joint's or contact's."""
    k, own, place = body.index, body.name.replace("_", " "), body.where.replace("_", " ")
    table = {f"M{k}": f"mass, {own}"}
    table |= {f"{letters}{k}": f"{what}, {own}" for letters, what in MOMENTS.items()}
    turned = INERTIA | ({"ZZ": "about the vertical"} if body.joint == "planar" else {})
    table |= {f"{letters}{k}": f"inertia {about}, {own}" for letters, about in turned.items()}
    table |= {f"{letters}{k}": f"{what}, {place}" for letters, what in ACTING.items()}
    table[f"q{k}0"] = f"encoder zero, {place}"
    return table | {f"u{k}0": f"{'force' if body.joint == 'prismatic' else 'torque'} offset, {place}"}


def _effect_description(name: str) -> str:
    """Describe an effect's magnitude or shape, NAME@WHERE[.SHAPE]."""
    effect, _, place = name.replace("_", " ").partition("@")
    place, _, shape = place.partition(".")
    return f"{shape} of {effect}, {place}" if shape else f"{effect}, {place}"
