"""The equations of motion of one sample in standard parameters: rigid bodies, friction, soil and effects.

The machine file becomes one balance, the torques that the motors must deliver for a motion. Effects add to it by the
hooks of their declarations. The contribution of a single effect is its signature, which diagnosis searches for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from excite.errors import MachineError
from excite.model import effects, mechanics
from excite.model.effects import ContactMotion, PlacedEffect, Soil
from excite.model.machine import Body, Machine, Sensor
from excite.model.sample import (
    ActiveEffect,
    SymbolicSample,
    active_effect,
    active_effects,
    common_view,
    contact_motion,
    friction_torque,
    names_from_map,
    symbolic_sample,
    with_shared_contacts,
)
from excite.text import format_number

SPEED_ROUNDING = 1e-3  # speed below which the size of a speed is rounded off, for its derivative [m/s]; chosen


@dataclass(frozen=True)
class Equations:
    """Functions of one sample in standard parameters p; their meaning is that of the `Model` built from them."""

    sample: SymbolicSample
    inputs: tuple[str, ...]
    slips: Mapping[str, ca.SX]
    predict: ca.Function
    standard_regressor: ca.Function
    balance: ca.Function
    flow: ca.Function
    read: ca.Function
    channels: ca.Function
    reading_names: tuple[str, ...]
    memory: tuple[str, ...]
    map_inputs: tuple[str, ...]
    nonlinear: tuple[str, ...]


@dataclass(frozen=True)
class SignatureFunctions:
    """Signatures of C effects: the contribution of each one alone.

    force: (q, nu, a, u, t, z, exact readings, p) -> generalised forces (n_q, C).
    reading: the same arguments -> changes of the readings (n_readings, C).
    flow: (q, nu, u, t, z, p) -> dz, the rates of all their memory states.
    n_map_inputs: number of inputs from a map of the ground, the last ones of z.
    """

    force: ca.Function
    reading: ca.Function
    flow: ca.Function
    n_map_inputs: int


def signed_balance(machine: Machine, standard: tuple[str, ...], placed: Sequence[PlacedEffect]) -> ca.Function:
    """Build the balance (q, nu, a, p, u, z, sign) with sgn of the joints' rates as an argument.

    sign (n_rubbing,): in the order of `Machine.rubbing`. A machine without effects takes no u and z.
    """
    sign = ca.SX.sym("sign", len(machine.rubbing))
    given = dict(zip([b.index for b in machine.rubbing], ca.vertsplit(sign), strict=True))
    s = symbolic_sample(machine, standard, given)
    _, _, z, acting = active_effects(s, placed)
    beside = [s.u, z] if placed else []
    return ca.Function("signed_balance", [s.q, s.nu, s.a, s.p, *beside, sign], [_balance(s, acting)[0]])


def force_directions(machine: Machine, standard: tuple[str, ...]) -> tuple[tuple[tuple[int, str], ...], ca.Function]:
    """Return names of forces that each contact may have, and the function (q, p) of their generalised unit forces.

    The forces are (n_q, n_forces) [N, N m], p the standard parameters. A name is the contact's body and one of:
    "lengthwise", on chassis and rim; "lateral"; "turning", the moment about the vertical axis; "resistance", lengthwise
    at the axle alone. They follow from virtual power as the soil's do.
    """
    s = symbolic_sample(machine, standard)
    found: dict[tuple[int, str], ca.SX] = {}
    for body in machine.contacts:
        assert body.contact is not None
        lever, radius = contact_motion(s, body)[1], float(body.contact.radius)
        units = {
            "lengthwise": (1, 0, -radius, 0),
            "lateral": (0, 1, 0, 0),
            "turning": (0, 0, 0, 1),
            "resistance": (1, 0, 0, 0),
        }
        forces = {kind: lever.T @ ca.DM(unit) for kind, unit in units.items()}
        found |= {(body.index, kind): force for kind, force in forces.items() if force.nnz()}
    forces = ca.densify(ca.horzcat(ca.SX(len(s.names), 0), *found.values()))
    return tuple(found), ca.Function("forces", [s.q, s.p], [forces], ["q", "p"], ["forces"])


def equations(machine: Machine, standard: tuple[str, ...], placed: Sequence[PlacedEffect]) -> Equations:
    """Build the functions of a machine with effects.

    Raises MachineError for a contact whose axis does not fit the force law.
    """
    for body in machine.contacts:
        _check_axis(machine, body)
    s = symbolic_sample(machine, standard)
    memory, map_inputs, z, acting = active_effects(s, placed)
    balance, slips = _balance(s, acting)
    time = ca.SX.sym("t")
    gain, offset, delay = _channels(s, acting, time)
    now = z[memory.index("time")] if "time" in memory else ca.SX(0)
    read, reading_names = _readings(s, acting)
    predict = ca.sparsify(ca.DM(machine.row_matrix)) @ balance
    for k, body in enumerate(machine.actuated):
        row = s.row(body)
        predict[row] = ca.substitute(gain[k], time, now) * predict[row] + ca.substitute(offset[k], time, now)
    rates = [ca.SX(1)] if "time" in memory else []
    for e in acting:
        rates += _memory_rates(e)
    rates += [ca.SX(0)] * len(map_inputs)
    beside = [s.u, z] if placed else []
    labels = ["q", "nu", "a", "p", "u", "z"][: 4 + len(beside)]
    sample = [s.q, s.nu, s.a, s.p, *beside]
    curved = ca.which_depends(predict, s.p, 2, False)
    return Equations(
        s,
        tuple(f"u{b.index}" for b in machine.actuated),
        slips,
        ca.Function("predict", sample, [predict], labels, ["Y"]),
        ca.Function("standard_regressor", sample, [ca.jacobian(predict, s.p)], labels, ["W"]),
        ca.Function("balance", sample, [balance], labels, ["Y"]),
        ca.Function("flow", [s.q, s.nu, s.u, z, s.p], [ca.vertcat(*rates, ca.SX(0, 1))]),
        ca.Function("read", [s.q, s.nu, s.wheels, s.u, z, s.p], [read]),
        ca.Function("channels", [time, s.p], [gain, offset, delay]),
        reading_names,
        memory,
        map_inputs,
        tuple(name for name, bent in zip(standard, curved, strict=True) if bent),
    )


def _check_axis(machine: Machine, body: Body) -> None:
    """Raise MachineError unless the contact turns about y of an upright carrier, as the force law assumes."""
    assert not isinstance(body.antecedent, str)
    own, _ = mechanics.joint_transform(body, {c: ca.SX(0) for c in body.coordinates})
    axis = ca.DM(own[:, 2]).full()[:, 0]
    upright = mechanics.body_poses(machine, {})[body.antecedent][0][2, 2]
    if abs(axis[1] - 1) > 1e-9 or abs(upright - 1) > 1e-9:
        raise MachineError(
            f"{machine.name}: body {body.name}: contact: must turn about y of an upright chassis, so that motion"
            f' forward map_inputs forward (alpha = "-pi/2", gamma 0); its axis there is ({format_number(axis[0], 2)},'
            f" {format_number(axis[1], 2)}, {format_number(axis[2], 2)})"
        )


def signatures(machine: Machine, standard: tuple[str, ...], placed: Sequence[PlacedEffect]) -> SignatureFunctions:
    """Build the signatures of these effects on a machine; standard: names of its standard parameters."""
    s = symbolic_sample(machine, standard)
    inertia = {b.index: mechanics.inertial_vector(b, s.by_name) for b in machine.body}
    time = ca.SX.sym("t")
    exact = ca.SX.sym("exact", sum(x.kind != "torque" for x in machine.sensors("full")))
    force, reading, rates = [], [], list[ca.SX]()
    states: list[ca.SX] = []
    view = common_view(s, time)
    map_inputs = [ca.SX.sym(name) for name in names_from_map(machine, placed)]
    motions = {b.index: contact_motion(s, b) for b in machine.contacts}
    for e in placed:
        z = {m: ca.SX.sym(m) for m in e.memory}
        (own,) = with_shared_contacts([active_effect(s, view, e, z, map_inputs)])
        added = _effect_force(s, own, inertia)
        if e.effect.extra_radius is not None or e.effect.soil is not None:
            for k in e.bodies:
                body, motion, (plain, lever) = machine.find(k), own.view.contacts[k], motions[k]
                added += _contact_force(body, _changed_soil(s, [own], body, motion), lever, motion)
                added -= _contact_force(body, _plain_soil(s, body, plain), lever, plain)
        force.append(added)
        read = ca.SX.zeros(exact.numel())
        if e.effect.reading is not None:
            sensors = [x for x in machine.sensors("full") if x.kind != "torque"]
            for at, sensor in enumerate(sensors):
                read[at] = own.reading_error(exact[at], sensor)
        reading.append(read)
        states += z.values()
        rates += _memory_rates(own)
    held = ca.vertcat(*states, *map_inputs, ca.SX(0, 1))
    arguments = [s.q, s.nu, s.a, s.u, time, held, exact, s.p]
    return SignatureFunctions(
        ca.Function("force", arguments, [ca.horzcat(*force)]),
        ca.Function("reading", arguments, [ca.horzcat(*reading)]),
        ca.Function(
            "flow", [s.q, s.nu, s.u, time, held, s.p], [ca.vertcat(*rates, *[ca.SX(0)] * len(map_inputs), ca.SX(0, 1))]
        ),
        len(map_inputs),
    )


def _memory_rates(e: ActiveEffect) -> list[ca.SX]:
    """Return the rates of an effect's memory states."""
    return [own.rate(e.view, k, e.values) for k, own in e.placed.memory.values()]


def _rotor_acceleration(s: SymbolicSample, body: Body) -> ca.SX:
    """Return the acceleration of a joint's rotor as seen at the joint, with that of a joint which turns it as well."""
    also = s.machine.turned_with(body)
    own = s.accel[body.coordinates[0]]
    return own if also is None else own + also[1] * s.accel[also[0].coordinates[0]]


def _joint_torque(s: SymbolicSample, body: Body) -> ca.SX:
    """Return Ia q" + Kb w + Fv w + Fs sgn w [N m] of a joint: rotor, back-EMF and friction."""
    k, torque = body.index, ca.SX(0)
    if body.drive is not None:
        torque += s.by_name[f"Ia{k}"] * _rotor_acceleration(s, body)
    if f"Kb{k}" in s.by_name:
        torque += s.by_name[f"Kb{k}"] * s.rate[body.coordinates[0]]
    if body.friction is not None:
        torque += friction_torque(s, body)
    return torque


def _spring_torque(s: SymbolicSample, body: Body) -> ca.SX:
    """Return Ks q - Ts + Ds q' [N m] that stretches the spring of a joint, q from its other end."""
    assert body.spring is not None
    c, k, bent = body.coordinates[0], body.index, [s.at[body.coordinates[0]], s.rate[body.coordinates[0]]]
    if body.spring.joint is not None:
        other = s.machine.find(body.spring.joint).coordinates[0]
        bent = [s.at[c] - s.at[other], s.rate[c] - s.rate[other]]
    return s.by_name[f"Ks{k}"] * bent[0] - s.by_name[f"Ts{k}"] + s.by_name.get(f"Ds{k}", 0) * bent[1]


def _balance(s: SymbolicSample, acting: Sequence[ActiveEffect]) -> tuple[ca.SX, dict[str, ca.SX]]:
    """Return generalised forces (n_q,) that the motors must deliver, and slips by name."""
    machine = s.machine
    inertia = {b.index: mechanics.inertial_vector(b, s.by_name) for b in machine.body}
    force = s.reduced_forces(s.frames, inertia)
    for body in machine.body:
        if body.joint in ("revolute", "prismatic") and machine.is_free(body):
            force[s.row(body)] += machine.ratio(body) * _joint_torque(s, body)
            if also := machine.turned_with(body):
                on_other = also[1] * s.by_name[f"Ia{body.index}"] * _rotor_acceleration(s, body)
                force[s.row(also[0])] += machine.ratio(also[0]) * on_other
            if body.spring is not None:
                stretch = _spring_torque(s, body)
                force[s.row(body)] += machine.ratio(body) * stretch
                if body.spring.joint is not None:
                    force[s.row(machine.find(body.spring.joint))] -= stretch
    for e in acting:
        force -= _effect_force(s, e, inertia)
    slips: dict[str, ca.SX] = {}
    for body in machine.contacts:
        plain, lever = contact_motion(s, body)
        motion = acting[0].view.contacts[body.index] if acting else plain
        slips |= {f"gx{body.index}": plain.slip.gx, f"gy{body.index}": plain.slip.gy}
        force -= _contact_force(body, _changed_soil(s, acting, body, motion), lever, motion)
    if machine.planar and machine.body[0].coordinates[1] in machine.locked:
        slips = {g: x for g, x in slips.items() if not g.startswith("gy")}
    return force, slips


def _effect_force(s: SymbolicSample, e: ActiveEffect, inertia: Mapping[int, ca.SX]) -> ca.SX:
    """Return the generalised force (n_q,) of an effect: torques, forces at contacts, gravity, inertia; not the soil."""
    effect, machine = e.placed.effect, s.machine
    force = ca.SX.zeros(len(s.names))
    for k in e.placed.bodies:
        body = machine.find(k)
        if effect.torque is not None:
            force[s.row(body)] += machine.ratio(body) * effect.torque(e.view, k, e.values)
        if effect.push is not None:
            lever = contact_motion(s, body)[1]
            force += lever[:2, :].T @ ca.vertcat(*effect.push(e.view, k, e.values))
    if effect.gravity is not None:
        pull = mechanics.rot_z(-s.heading) @ (_level_axes(machine) @ ca.vertcat(*effect.gravity(e.view, e.values)))
        still = {c: ca.SX(0) for c in s.at}
        frames = mechanics.body_motions(machine, s.at, still, still, pull)
        force -= s.reduced_forces(frames, dict(inertia))
    if effect.link is not None:
        longer = {k: effect.link(e.values) for k in e.placed.bodies}
        frames = mechanics.body_motions(machine, s.at, s.rate, s.accel, s.gravity, longer)
        force += s.reduced_forces(s.frames, dict(inertia)) - s.reduced_forces(frames, dict(inertia), longer)
    if effect.inertia is not None:
        changes = effect.inertia(e.view, e.values)
        by_parameter = effects.payload_change(machine, changes)
        none = {n: ca.SX(0) for n in s.by_name}
        change = ca.vertcat(*[mechanics.inertial_vector(b, {**none, **by_parameter}) for b in machine.body])
        force -= s.by_inertia @ change
        if effect.recoil is not None:
            force += e.values[effect.recoil] * _recoil_force(s, e, changes)
    return force


def _level_axes(machine: Machine) -> ca.DM:
    """Return two level axes (3, 2) of the ground: x and y of a machine on a plane, else those across gravity.

    The first one is x of the ground as far as that is level, y where x is upright.
    """
    if machine.planar or not any(machine.gravity):
        return ca.DM([[1, 0], [0, 1], [0, 0]])
    down = np.array(machine.gravity) / np.linalg.norm(machine.gravity)
    first = np.eye(3)[int(abs(down[0]) > abs(down[1]) and abs(down[0]) > abs(down[2]))]
    first = first - down * (down @ first)
    first /= np.linalg.norm(first)
    return ca.DM(np.column_stack([first, np.cross(first, down)]))


def _recoil_force(s: SymbolicSample, e: ActiveEffect, change: Mapping[str, ca.SX]) -> ca.SX:
    """Return the generalised force (n_q,) of a load that slides along a body's x axis, from its MX(t) and ZZ(t).

    -MX'' along x, the Coriolis force -2 omega MX' across, the moment -omega ZZ' about the body's origin.
    """
    body = effects.payload_body(s.machine)
    assert body is not None
    frame = s.frames[body]
    lever = ca.jacobian(ca.vertcat(frame.velocity[:2], frame.omega[2]), s.nu)
    MX, ZZ = (ca.jacobian(change[name], e.view.time) for name in ("MX", "ZZ"))
    yaw = frame.omega[2]
    return lever.T @ ca.vertcat(-ca.jacobian(MX, e.view.time), -2 * yaw * MX, -yaw * ZZ)


def _plain_soil(s: SymbolicSample, body: Body, motion: ContactMotion) -> Soil:
    """Return the soil under a contact from the machine file."""
    contact = motion.contact
    saturation = None
    if contact.law == "exponential":
        assert contact.saturation_slip is not None
        saturation = mechanics.Saturation(ca.SX(float(contact.saturation_slip)))
    Kx, Ky = s.by_name[f"Kx{body.index}"], s.by_name[f"Ky{body.index}"]
    return Soil(motion.slip, motion.yaw, Kx, Ky, saturation)


def _changed_soil(s: SymbolicSample, acting: Sequence[ActiveEffect], body: Body, motion: ContactMotion) -> Soil:
    """Return the soil under a contact, changed by the effects one after another."""
    soil = _plain_soil(s, body, motion)
    for e in acting:
        if e.placed.effect.soil is not None and body.index in e.placed.bodies:
            soil = e.placed.effect.soil(e.view, body.index, e.values, soil)
    return soil


def _contact_force(body: Body, soil: Soil, lever: ca.SX, motion: ContactMotion) -> ca.SX:
    """Return the generalised force (n_q,) of a contact by virtual power (11)."""
    assert body.contact is not None
    w = soil.wrench(body.contact)
    Sx, Sy = w.Sx - soil.turned * w.Sy, w.Sy + soil.turned * w.Sx
    moment = -(float(body.contact.radius) + motion.extra_radius) * w.Sx
    return lever.T @ ca.vertcat(Sx, Sy, moment, soil.ahead * Sy - w.Tz)


def _channels(s: SymbolicSample, acting: Sequence[ActiveEffect], time: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return gain, offset [N m] and delay [s] of the torque sensors, (n_u,) each."""
    gain, offset, delay = [], [], []
    for body in s.machine.actuated:
        g, o, d = ca.SX(1), s.by_name[f"u{body.index}0"], ca.SX(0)
        for e in acting:
            if e.placed.effect.channel is not None and body.index in e.placed.bodies:
                own = e.placed.effect.channel(time, e.values)
                g, o, d = g * own.gain, o + own.offset, d + own.delay
        gain.append(g)
        offset.append(o)
        delay.append(d)
    return ca.vertcat(*gain), ca.vertcat(*offset), ca.vertcat(*delay)


def _readings(s: SymbolicSample, acting: Sequence[ActiveEffect]) -> tuple[ca.SX, tuple[str, ...]]:
    """Return readings and names of all sensors but those of torque."""
    machine, root = s.machine, s.machine.body[0]
    wheels = [x.name for x in machine.sensor if x.kind == "wheel"]
    readings: dict[str, ca.SX] = {}
    for sensor in machine.sensors("full"):
        body = machine.find(sensor.body)
        if sensor.kind == "torque":
            continue
        if sensor.kind == "angle":
            value = s.read[body.coordinates[0]]
        elif sensor.kind == "wheel":
            value = s.wheels[wheels.index(sensor.name)]
        elif sensor.kind == "yaw_rate":
            value = s.rate[root.coordinates[2]]
        else:
            value = _reading_at_place(s, sensor)
        exact = value
        for e in acting:
            value = value + e.reading_error(exact, sensor)
        readings[sensor.name] = value
    return ca.vertcat(*readings.values(), ca.SX(0, 1)), tuple(readings)


def _reading_at_place(s: SymbolicSample, sensor: Sensor) -> ca.SX:
    """Return the exact reading of a speed or position at a sensor's place on the root."""
    frame, (ahead, lateral) = s.frames[sensor.body], sensor.mounted_at
    along, across = frame.velocity[0] - lateral * frame.omega[2], frame.velocity[1] + ahead * frame.omega[2]
    if sensor.kind == "forward_speed":
        return along
    if sensor.kind == "lateral_speed":
        return across
    if sensor.kind == "ground_speed":
        return ca.sqrt(along**2 + across**2 + SPEED_ROUNDING**2) - SPEED_ROUNDING
    axis = "xy".index(sensor.kind)
    return (
        s.at[s.machine.body[0].coordinates[axis]] + (mechanics.rot_z(s.heading) @ ca.vertcat(ahead, lateral, 0))[axis]
    )


def contact_lines(s: SymbolicSample) -> ca.Function:
    """Build q -> (4, n_contacts) [m]: ground position x, y of each contact's middle, vector from right to left end."""
    machine, R = s.machine, mechanics.rot_z(s.heading)
    root = ca.vertcat(*[s.at[c] for c in machine.body[0].coordinates[:2]], 0) if machine.planar else ca.SX(3, 1)
    found = []
    for body in machine.contacts:
        assert body.contact is not None
        frame = s.frames[body.index]
        across = float(body.contact.width) * frame.rotation[:, 2]
        found.append(ca.vertcat((root + R @ frame.position)[:2], (R @ across)[:2]))
    return ca.Function("axles", [s.q], [ca.densify(ca.horzcat(*found, ca.SX(4, 0)))], ["q"], ["axles"])


def edge_slips(s: SymbolicSample) -> tuple[tuple[tuple[int, str], ...], ca.Function]:
    """Return places (body, edge) of the contacts, and the function (q, nu) -> slips g_x, g_y there (2, n_places)."""
    found: dict[tuple[int, str], ca.SX] = {}
    for body in s.machine.contacts:
        motion = contact_motion(s, body)[0]
        across = mechanics.slips_across(motion.contact, motion.slip, motion.yaw)
        found |= {(body.index, place): g for place, g in across.items()}
    slips = ca.densify(ca.horzcat(*found.values(), ca.SX(2, 0)))
    return tuple(found), ca.Function("edge_slips", [s.q, s.nu], [slips], ["q", "nu"], ["slips"])


def kinematics(s: SymbolicSample, slips: Mapping[str, ca.SX]) -> ca.Function:
    """Build (q, nu) -> dq, slips, wheel rates; position on the ground, velocity and angular velocity of each body."""
    machine, at, rate, frames, nu = s.machine, s.at, s.rate, s.frames, s.nu
    dq = nu
    if machine.planar:
        x, y, _ = machine.body[0].coordinates
        turned = dict(
            zip((x, y), ca.vertsplit((mechanics.rot_z(s.heading) @ ca.vertcat(rate[x], rate[y], 0))[:2]), strict=True)
        )
        dq = ca.vertcat(*[turned.get(c, rate[c]) for c in machine.coordinates])
    wheels = []
    for sensor in machine.sensor:
        if sensor.kind == "wheel":
            f = frames[sensor.body]
            assert sensor.radius is not None
            assert sensor.lateral is not None
            wheels.append((f.velocity[0] - float(sensor.lateral) * f.omega[2]) / float(sensor.radius))
    R = mechanics.rot_z(s.heading)
    root = ca.vertcat(*[at[c] for c in machine.body[0].coordinates[:2]], 0) if machine.planar else ca.SX(3, 1)
    places = ca.horzcat(*[root + R @ frames[b.index].position for b in machine.body])
    speeds = ca.horzcat(*[frames[b.index].velocity for b in machine.body])
    turns = ca.horzcat(*[frames[b.index].omega for b in machine.body])
    return ca.Function(
        "kinematics",
        [s.q, nu],
        [dq, ca.vertcat(*slips.values()), ca.vertcat(*wheels), places, speeds, turns],
        ["q", "nu"],
        ["dq", "slips", "wheels", "places", "speeds", "turns"],
    )
