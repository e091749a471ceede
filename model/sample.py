"""Symbols of one sample of a machine's motion, and its effects as they act on that sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from excite.model import effects, mechanics
from excite.model.effects import ContactMotion, PlacedEffect, SampleView, Values
from excite.model.machine import Body, Machine, Sensor


@dataclass(frozen=True)
class SymbolicSample:
    """Symbols of one sample, and the motion of every body in it.

    q, nu, a, u, p, wheels: coordinates, velocities, accelerations, torques, standard parameters, measuring wheels.
    at, rate, accel: coordinates and their rates by name, zero for locked ones. by_name: standard parameters.
    read: coordinates as the encoders read them: `at` is less by the zeros that are sought.
    frames: motion of each body; gravity (3,) in the root's axes; heading of the root [rad].
    sign: sgn of each joint's rate in its dry friction, by index of the body.
    """

    machine: Machine
    q: ca.SX
    nu: ca.SX
    a: ca.SX
    u: ca.SX
    p: ca.SX
    wheels: ca.SX
    at: dict[str, ca.SX]
    read: dict[str, ca.SX]
    rate: dict[str, ca.SX]
    accel: dict[str, ca.SX]
    by_name: dict[str, ca.SX]
    frames: dict[int, mechanics.Frame]
    gravity: ca.SX
    heading: ca.SX
    sign: dict[int, ca.SX]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free coordinates."""
        return self.machine.coordinates

    def row(self, body: Body) -> int:
        """Return the equation of a body's joint."""
        return self.names.index(self.machine.coordinate(body))

    @cached_property
    def by_inertia(self) -> ca.SX:
        """Jacobian (n_q, 10 n_bodies) of the generalised forces to the inertial parameters of all bodies."""
        every = {b.index: ca.SX.sym(f"inertia{b.index}", 10) for b in self.machine.body}
        return ca.jacobian(self.reduced_forces(self.frames, every), ca.vertcat(*every.values()))

    def reduced_forces(
        self,
        frames: dict[int, mechanics.Frame],
        inertia: dict[int, ca.SX],
        longer: Mapping[int, ca.SX] = mechanics.NONE_LONGER,
    ) -> ca.SX:
        """Return the generalised forces (n_q,) of the free coordinates q: S^T f of all joints' f, whose angles are S q.

        inertia: (10,) parameters of each body. longer [m]: see `mechanics.body_motions`.
        """
        rows = mechanics.generalised_forces(self.machine, self.at, frames, inertia, longer)
        for body in self.machine.body:
            if body.moves_with is not None:
                rows[self.machine.coordinate(body)] += self.machine.ratio(body) * rows[body.coordinates[0]]
        return ca.vertcat(*[rows[c] for c in self.names])


@dataclass(frozen=True)
class ActiveEffect:
    """An effect in one sample: the view that its hooks get, and values of magnitude and shapes."""

    placed: PlacedEffect
    view: SampleView
    values: Values

    def reading_error(self, exact: ca.SX, sensor: Sensor) -> ca.SX:
        """Return the error of a sensor's reading, zero if the effect does not sit in it."""
        hook, own = self.placed.effect.reading, self.placed.sensors
        if hook is None or sensor.name not in own:
            return ca.SX(0)
        radius = 1.0 if sensor.radius is None else float(sensor.radius)
        right = len(own) > 1 and float(sensor.lateral or 0) < 0
        view = replace(self.view, wheel_radius=radius, outwards=-1.0 if right else 1.0)
        return hook(view, exact, sensor.body, self.values)


def symbolic_sample(
    machine: Machine, standard: tuple[str, ...], sign: Mapping[int, ca.SX] | None = None
) -> SymbolicSample:
    """Make the symbols of one sample; standard: names of the standard parameters.

    sign: sgn of joints' rates by index of the body; smoothed over the rate of the machine file where it is not given.
    """
    names = machine.coordinates
    n = len(names)
    q, nu, a = ca.SX.sym("q", n), ca.SX.sym("nu", n), ca.SX.sym("a", n)
    p = ca.SX.sym("p", len(standard))
    full = {c: ca.SX(0) for b in machine.body for c in b.coordinates}
    by_name = dict(zip(standard, ca.vertsplit(p), strict=True))
    read = full | dict(zip(names, ca.vertsplit(q), strict=True))
    at = dict(read)
    for name, sensor in machine.sought_zeros.items():
        at[machine.coordinate(machine.find(sensor.body))] -= by_name.get(name, 0)
    rate = full | dict(zip(names, ca.vertsplit(nu), strict=True))
    accel = full | dict(zip(names, ca.vertsplit(a), strict=True))
    for moving in (at, read, rate, accel):
        for b in machine.body:
            if b.moves_with is not None:
                moving[b.coordinates[0]] = machine.ratio(b) * moving[machine.coordinate(b)]
                if moving is at or moving is read:
                    moving[b.coordinates[0]] += machine.offset(b)
    heading = at[machine.body[0].coordinates[2]] if machine.planar else ca.SX(0)
    gravity = mechanics.rot_z(-heading) @ ca.DM(machine.gravity)
    smoothed = {
        b.index: ca.tanh(rate[b.coordinates[0]] / float(b.friction.smoothing))
        for b in machine.body
        if b.friction is not None
    }
    smoothed |= dict(sign or {})
    for b in machine.body:  # joints that move together turn and stick together
        if b.moves_with is not None and b.friction is not None:
            smoothed[b.index] = np.sign(machine.ratio(b)) * smoothed[b.moves_with.joint]
    return SymbolicSample(
        machine,
        q,
        nu,
        a,
        ca.SX.sym("u", len(machine.actuated)),
        p,
        ca.SX.sym("wheels", sum(s.kind == "wheel" for s in machine.sensor)),
        at,
        read,
        rate,
        accel,
        by_name,
        mechanics.body_motions(machine, at, rate, accel, gravity),
        gravity,
        heading,
        smoothed,
    )


def names_from_map(machine: Machine, placed: Sequence[PlacedEffect]) -> tuple[str, ...]:
    """Name the inputs from a map of the ground, () if no effect uses it."""
    if not any(e.uses_map for e in placed):
        return ()
    return tuple(f"over{b.index}.{n + 1}" for b in machine.contacts for n in range(effects.MAX_PASSES))


def active_effects(
    s: SymbolicSample, placed: Sequence[PlacedEffect]
) -> tuple[tuple[str, ...], tuple[str, ...], ca.SX, list[ActiveEffect]]:
    """Return names of memory states (those from the map last), names from the map, symbols z, and active effects."""
    map_names = names_from_map(s.machine, placed)
    memory = ["time"] if any(e.effect.timed for e in placed) else []
    memory += [f"{e.name}.{m}" for e in placed for m in e.memory]
    memory += map_names
    z = ca.SX.sym("z", len(memory))
    known = dict(zip(memory, ca.vertsplit(z), strict=True))
    view = common_view(s, known.get("time", ca.SX(0)))
    map_inputs = [known[name] for name in map_names]
    acting = [active_effect(s, view, e, {m: known[f"{e.name}.{m}"] for m in e.memory}, map_inputs) for e in placed]
    return tuple(memory), map_names, z, with_shared_contacts(acting)


def with_shared_contacts(acting: list[ActiveEffect]) -> list[ActiveEffect]:
    """Show all effects the contacts as changed by those with an `extra_radius`."""
    extra_radius: dict[int, ca.SX] = {}
    for e in acting:
        if e.placed.effect.extra_radius is not None:
            for k in e.placed.bodies:
                extra_radius[k] = extra_radius.get(k, ca.SX(0)) + e.placed.effect.extra_radius(e.view, k, e.values)
    if not extra_radius:
        return acting
    contacts = {k: replace(r, extra_radius=extra_radius.get(k, 0.0)) for k, r in acting[0].view.contacts.items()}
    return [replace(e, view=replace(e.view, contacts=contacts)) for e in acting]


def common_view(s: SymbolicSample, time: ca.SX) -> SampleView:
    """Return the view of a sample that effects have in common."""
    turning = [b for b in s.machine.body if b.coordinates and b.joint != "planar"]
    rubbing = [b for b in turning if b.friction is not None]
    return SampleView(
        {b.index: s.at[b.coordinates[0]] for b in turning},
        {b.index: s.rate[b.coordinates[0]] for b in turning},
        {
            b.index: torque * (1.0 if b.driven_with is None else float(b.driven_with.ratio))
            for driven, torque in zip(s.machine.actuated, ca.vertsplit(s.u), strict=True)
            for b in s.machine.drives(driven)
        },
        {b.index: friction_torque(s, b) for b in rubbing},
        {b.index: s.by_name[f"Fs{b.index}"] for b in rubbing},
        {b.index: float(b.friction.smoothing) for b in rubbing if b.friction is not None},
        s.sign,
        {b.index: effects.large_torque(s.machine, b) for d in s.machine.actuated for b in s.machine.drives(d)},
        {b.index: contact_motion(s, b)[0] for b in s.machine.contacts},
        {b.index: s.frames[b.index].velocity[0] for b in s.machine.body},
        {b.index: s.frames[b.index].omega[2] for b in s.machine.body},
        time,
    )


def active_effect(
    s: SymbolicSample, view: SampleView, e: PlacedEffect, z: dict[str, ca.SX], map_inputs: Sequence[ca.SX]
) -> ActiveEffect:
    """Return an effect with its memory states z and, if it uses the map, the inputs from it."""
    values = {key: ca.SX(x) for key, x in e.values.items()}
    values |= {key: s.by_name[name] for name, (key, _) in e.parameters.items() if name in s.by_name}
    passes = {b.index: ca.SX.zeros(effects.MAX_PASSES) for b in s.machine.contacts}
    if e.uses_map:
        n = effects.MAX_PASSES
        passes = {k: ca.vertcat(*map_inputs[n * i : n * (i + 1)]) for i, k in enumerate(passes)}
    own = replace(view, z=dict.fromkeys(e.memories, ca.SX(0)) | z, passes=passes)
    return ActiveEffect(e, own, values)


def friction_torque(s: SymbolicSample, body: Body) -> ca.SX:
    """Return Fv w + Fs sgn w [N m] of a joint."""
    w, k = s.rate[body.coordinates[0]], body.index
    return s.by_name[f"Fv{k}"] * w + s.by_name[f"Fs{k}"] * s.sign[k]


def contact_motion(s: SymbolicSample, body: Body) -> tuple[ContactMotion, ca.SX]:
    """Return a contact's motion, and the Jacobian (4, n_q) of (Vx, Vy, spin, yaw) to the velocities."""
    assert body.contact is not None
    assert not isinstance(body.antecedent, str)
    carrier, own = s.frames[body.antecedent], s.frames[body.index]
    R, _ = mechanics.joint_transform(body, {c: ca.SX(0) for c in body.coordinates})
    turn = carrier.rotation.T @ own.rotation
    centre = turn @ own.velocity
    spin = (R[:, 2].T @ turn) @ own.omega
    yaw = carrier.omega[2]
    lever = ca.jacobian(ca.vertcat(centre[0], centre[1], spin, yaw), s.nu)
    return ContactMotion(body.contact, centre[0], centre[1], spin, yaw), lever
