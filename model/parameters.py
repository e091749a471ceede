"""Standard parameters of a machine: nominal values, units and required signs, and encoder zeros that are sought."""

from __future__ import annotations

import re

from excite.model import mechanics
from excite.model.machine import PER_FORCE_CONSTANT, PER_TORQUE_CONSTANT, Machine

ZERO_SIZES = (0.02, 0.002)  # rad, m; of an encoder's zero that is sought; chosen


def standard_parameters(machine: Machine) -> dict[str, tuple[float, str]]:
    """Return nominal value [SI] and unit of every standard parameter: bodies, joints, encoder zeros that are sought.

    The order decides which column of a dependent set stands for it, and it is the order of every table.
    """
    return linear_parameters(machine) | {n: (value, unit) for n, (value, unit, _) in encoder_zeros(machine).items()}


def linear_parameters(machine: Machine) -> dict[str, tuple[float, str]]:
    """Return nominal value [SI] and unit of the standard parameters that the prediction is linear in."""
    chassis: dict[str, tuple[float, str]] = {}
    joints: dict[str, tuple[float, str]] = {}
    for body in machine.body:
        k = body.index
        inertia = {n: (v, _inertial_unit(n)) for n, v in mechanics.standard_inertia(body).items()}
        if body.inertia is not None and body.inertia.axisymmetric:
            joints |= inertia
        else:
            chassis |= inertia
        turn = body.joint == "revolute"
        if body.drive is not None:
            joints[f"Ia{k}"] = (float(body.drive.rotor_inertia), "kg m2" if turn else "kg")
        if body.friction is not None:
            joints[f"Fv{k}"] = (float(body.friction.Fv), "N m s" if turn else "N s/m")
            joints[f"Fs{k}"] = (float(body.friction.Fs), "N m" if turn else "N")
        back_emf = sum(s.back_emf_damping for s in machine.sensor if s.kind == "torque" and s.body == k)
        if back_emf:
            joints[f"Kb{k}"] = (back_emf, "N m s" if turn else "N s/m")
        if body.spring is not None:
            stiffness = float(body.spring.stiffness)
            joints[f"Ks{k}"] = (stiffness, "N m/rad" if turn else "N/m")
            joints[f"Ts{k}"] = (stiffness * float(body.spring.rest), "N m" if turn else "N")
            if body.spring.damping is not None:
                joints[f"Ds{k}"] = (float(body.spring.damping), "N m s" if turn else "N s/m")
        if body.contact is not None:
            joints[f"Kx{k}"] = (float(body.contact.Kx), "N")
            joints[f"Ky{k}"] = (float(body.contact.Ky), "N")
        if body.friction is not None:
            joints[f"u{k}0"] = (float(body.friction.u0), "N m" if turn else "N")
    every = chassis | joints
    return _in_ratios(machine, every) if machine.in_ratios else every


def _in_ratios(machine: Machine, every: dict[str, tuple[float, str]]) -> dict[str, tuple[float, str]]:
    """Return parameters in the units that they have divided by an unknown torque constant."""
    turns = machine.actuated[0].joint == "revolute"
    per_constant = PER_TORQUE_CONSTANT if turns else PER_FORCE_CONSTANT
    own = machine.torque_unit or "A"
    found = {}
    for name, (value, unit) in every.items():
        per_ampere = per_constant.get(unit, f"{unit} A/({'N m' if turns else 'N'})")
        found[name] = value, re.sub(r"\bA\b", own, per_ampere)
    return found


def encoder_zeros(machine: Machine) -> dict[str, tuple[float, str, float]]:
    """Return nominal value, unit and size of every encoder zero that is sought, beyond what its file subtracts.

    The readings are the coordinates; forces act at coordinate - zero.
    """
    straight = {n: machine.find(s.body).joint == "prismatic" for n, s in machine.sought_zeros.items()}
    return {n: (0.0, "m" if slides else "rad", ZERO_SIZES[slides]) for n, slides in straight.items()}


def required_signs(machine: Machine) -> dict[str, float]:
    """Return the physically required sign by standard parameter: contact stiffness -1, joint parameters +1."""
    found: dict[str, float] = {}
    for body in machine.body:
        if body.friction is not None:
            found |= dict.fromkeys((f"Fv{body.index}", f"Fs{body.index}"), 1.0)
        if body.drive is not None:
            found[f"Ia{body.index}"] = 1.0
        if any(s.back_emf_damping for s in machine.sensor if s.body == body.index):
            found[f"Kb{body.index}"] = 1.0
        if body.spring is not None:
            found[f"Ks{body.index}"] = 1.0
            if body.spring.damping is not None:
                found[f"Ds{body.index}"] = 1.0
        if body.contact is not None:
            found |= dict.fromkeys((f"Kx{body.index}", f"Ky{body.index}"), -1.0)
    return found


def _inertial_unit(name: str) -> str:
    letters = name.rstrip("0123456789")
    return {1: "kg", 2: "kg m" if letters[0] == "M" else "kg m2"}[len(letters)]
