"""Velocities and equations of motion of a tree of rigid bodies (modified Denavit-Hartenberg).

Recursive Newton-Euler in the form of Khalil and Dombre ("Modeling, Identification and Control of Robots", ch. 9):
every force is linear in the standard inertial parameters (m, first moments, inertia about the frame's origin), so
the same expression serves simulation, design and regressor.

A planar root is written in its own axes: its velocities are (V_x, V_y, theta'), its accelerations their time
derivatives, and its three rows are the forces along its axes and the moment about its origin. The pose on the plane
then appears only through the direction of gravity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from excite.model.machine import Body, Machine
from excite.model.mechanics.angles import fixed_angle

# standard inertial parameters of a body
INERTIAL = ("M", "MX", "MY", "MZ", "XX", "XY", "XZ", "YY", "YZ", "ZZ")
Z = ca.DM([0, 0, 1])  # axis of every joint in its own frame
NONE_LONGER: Mapping[int, ca.SX] = {}


@dataclass(frozen=True)
class Frame:
    """Pose and motion of a body's frame.

    rotation (3, 3), position (3,) [m]: from the body's axes to the root's, at the root's origin.
    omega [rad/s], velocity [m/s], domega [rad/s2], acceleration minus gravity [m/s2]: (3,) in the body's own axes.
    """

    rotation: ca.SX
    position: ca.SX
    omega: ca.SX
    velocity: ca.SX
    domega: ca.SX
    acceleration: ca.SX


def _snap_to_integer(value: float) -> float:
    """Round cos(pi/2) to 0, which keeps the symbolic graph free of terms of 6e-17."""
    return round(value) if abs(value - round(value)) < 1e-15 else value


def _rot_x(angle: float) -> ca.SX:
    """Return the rotation (3, 3) about x by an angle [rad] of the geometry."""
    c, s = _snap_to_integer(math.cos(angle)), _snap_to_integer(math.sin(angle))
    return ca.sparsify(ca.SX([[1, 0, 0], [0, c, -s], [0, s, c]]))


def rot_z(angle: ca.SX | float) -> ca.SX:
    """Return the rotation (3, 3) about z by an angle [rad], a symbol or one of the geometry."""
    number = isinstance(angle, float)
    c = ca.SX(_snap_to_integer(math.cos(angle))) if number else ca.cos(angle)
    s = ca.SX(_snap_to_integer(math.sin(angle))) if number else ca.sin(angle)
    R = ca.SX.eye(3)
    R[0, 0], R[0, 1], R[1, 0], R[1, 1] = c, -s, s, c
    return ca.sparsify(R)


def link_length(body: Body) -> float:
    """Return the fixed distance [m] of a joint from the one before it: d along x, and r along z unless it slides."""
    return math.hypot(float(body.d), 0.0 if body.joint == "prismatic" else float(body.r))


def joint_transform(body: Body, q: dict[str, ca.SX], longer: ca.SX | float = 0.0) -> tuple[ca.SX, ca.SX]:
    """Return rotation (3, 3) and position (3,) [m] of a body's frame in its antecedent's; q: coordinates by name.

    longer [m]: added to the link's length, along it.
    """
    c = body.coordinates[0] if body.coordinates else ""
    theta = q[c] if body.joint == "revolute" else fixed_angle(body.theta)
    r = q[c] if body.joint == "prismatic" else float(body.r)
    Rz, Rx, Rt = rot_z(fixed_angle(body.gamma)), _rot_x(fixed_angle(body.alpha)), rot_z(theta)
    along = ca.vertcat(float(body.d), 0, 0) + Rx @ (Z * r)
    if link_length(body) > 0 and not (isinstance(longer, float) and longer == 0):
        fixed = 0.0 if body.joint == "prismatic" else float(body.r)
        along += (ca.vertcat(float(body.d), 0, 0) + Rx @ (Z * fixed)) * (longer / link_length(body))
    return Rz @ Rx @ Rt, Rz @ along + Z * float(body.b)


def body_motions(
    machine: Machine,
    q: dict[str, ca.SX],
    dq: dict[str, ca.SX],
    ddq: dict[str, ca.SX],
    gravity: ca.SX,
    longer: Mapping[int, ca.SX] = NONE_LONGER,
) -> dict[int, Frame]:
    """Compute the motion of every body by forward recursion.

    q, dq, ddq by coordinate name [rad, m and per s, s2]; those of a planar root are velocities and accelerations in
    its own axes. gravity (3,) [m/s2] in the root's axes. longer [m]: what bodies' links are longer than in the file.
    """
    frames: dict[int, Frame] = {}
    for body in machine.body:
        R, P = joint_transform(body, q, longer.get(body.index, 0.0))
        zero = ca.SX(3, 1)
        if body.antecedent == "ground":
            above = Frame(ca.SX.eye(3), zero, zero, zero, zero, -gravity)
        else:
            above = frames[body.antecedent]
        if body.joint == "planar":
            x, y, t = body.coordinates
            spin = dq[t]
            frames[body.index] = Frame(
                ca.SX.eye(3),
                zero,
                Z * spin,
                ca.vertcat(dq[x], dq[y], 0),
                Z * ddq[t],
                ca.vertcat(ddq[x] - spin * dq[y], ddq[y] + spin * dq[x], 0) - gravity,
            )
            continue
        omega, domega = R.T @ above.omega, R.T @ above.domega
        velocity = R.T @ (above.velocity + ca.cross(above.omega, P))
        lever = ca.cross(above.domega, P) + ca.cross(above.omega, ca.cross(above.omega, P))
        acceleration = R.T @ (above.acceleration + lever)
        if body.joint == "revolute":
            c = body.coordinates[0]
            domega = domega + Z * ddq[c] + ca.cross(omega, Z * dq[c])
            omega = omega + Z * dq[c]
        elif body.joint == "prismatic":
            c = body.coordinates[0]
            velocity = velocity + Z * dq[c]
            acceleration = acceleration + Z * ddq[c] + 2 * ca.cross(omega, Z * dq[c])
        frames[body.index] = Frame(
            above.rotation @ R, above.position + above.rotation @ P, omega, velocity, domega, acceleration
        )
    return frames


def generalised_forces(
    machine: Machine,
    q: dict[str, ca.SX],
    frames: dict[int, Frame],
    inertial: dict[int, ca.SX],
    longer: Mapping[int, ca.SX] = NONE_LONGER,
) -> dict[str, ca.SX]:
    """Compute the generalised force [N or N m] of every coordinate by backward recursion.

    inertial: (10,) parameters of each body in the order of INERTIAL, about its own frame. longer: as in
    `body_motions`, which made the frames.
    """
    force: dict[int, ca.SX] = {}
    moment: dict[int, ca.SX] = {}
    for body in machine.body:
        f = frames[body.index]
        m, mx, my, mz, xx, xy, xz, yy, yz, zz = ca.vertsplit(inertial[body.index])
        ms = ca.vertcat(mx, my, mz)
        J = ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))
        force[body.index] = m * f.acceleration + ca.cross(f.domega, ms) + ca.cross(f.omega, ca.cross(f.omega, ms))
        moment[body.index] = J @ f.domega + ca.cross(f.omega, J @ f.omega) + ca.cross(ms, f.acceleration)
    rows: dict[str, ca.SX] = {}
    for body in reversed(machine.body):
        F, N = force[body.index], moment[body.index]
        if body.joint == "planar":
            x, y, t = body.coordinates
            rows[x], rows[y], rows[t] = F[0], F[1], N[2]
            continue
        if body.joint == "revolute":
            rows[body.coordinates[0]] = N[2]
        elif body.joint == "prismatic":
            rows[body.coordinates[0]] = F[2]
        if body.antecedent != "ground":
            R, P = joint_transform(body, q, longer.get(body.index, 0.0))
            force[body.antecedent] += R @ F
            moment[body.antecedent] += R @ N + ca.cross(P, R @ F)
    return rows


def body_poses(machine: Machine, q: Mapping[str, float]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return rotation (3, 3) and position (3,) [m] of every body in the root's axes, by index.

    q: coordinates by name [rad, m], zero by default; those of a planar root change nothing.
    """
    every = [c for b in machine.body for c in b.coordinates]
    still = dict.fromkeys(every, ca.SX(0))
    at = still | {c: ca.SX(x) for c, x in q.items()}
    for b in machine.body:
        if b.moves_with is not None:
            at[b.coordinates[0]] = machine.ratio(b) * at[machine.coordinate(b)] + machine.offset(b)
    frames = body_motions(machine, at, still, still, ca.SX(3, 1))
    return {k: (ca.DM(f.rotation).full(), ca.DM(f.position).full()[:, 0]) for k, f in frames.items()}


def standard_inertia(body: Body) -> dict[str, float]:
    """Return the free standard parameters of a body by name, from mass, centre of mass and inertia.

    First moments and inertia are about the body's frame (parallel axes); an axisymmetric body has M, XX (= YY), ZZ.
    """
    if body.inertia is None:
        return {}
    i, k = body.inertia, body.index
    m = float(i.mass)
    if i.axisymmetric:
        return {f"M{k}": m, f"XX{k}": float(i.XX), f"ZZ{k}": float(i.ZZ)}
    x, y, z = i.com.value
    return {
        f"M{k}": m,
        f"MX{k}": m * x,
        f"MY{k}": m * y,
        f"MZ{k}": m * z,
        f"XX{k}": float(i.XX) + m * (y * y + z * z),
        f"XY{k}": float(i.XY) - m * x * y,
        f"XZ{k}": float(i.XZ) - m * x * z,
        f"YY{k}": float(i.YY) + m * (x * x + z * z),
        f"YZ{k}": float(i.YZ) - m * y * z,
        f"ZZ{k}": float(i.ZZ) + m * (x * x + y * y),
    }


def inertial_vector(body: Body, p: dict[str, ca.SX]) -> ca.SX:
    """Return the body's ten parameters in the order of INERTIAL, zero for those it does not have."""
    if body.inertia is None:
        return ca.SX.zeros(10)
    k = body.index
    if body.inertia.axisymmetric:
        p = {**p, f"YY{k}": p[f"XX{k}"]}
    return ca.vertcat(*[p.get(f"{name}{k}", ca.SX.zeros(1)) for name in INERTIAL])
