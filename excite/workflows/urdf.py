"""Robots in the Unified Robot Description Format: a machine file from one, and one with identified inertias.

A joint's frame has z along its axis and x along the common normal from the axis before (modified Denavit-Hartenberg,
Khalil and Kleinfinger, 1986); its coordinate is that of the joint in the URDF. Links behind fixed joints are part of
the link that carries them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from excite import identification
from excite.errors import MachineError
from excite.identification import Estimate
from excite.model import Model, build, standard_parameters
from excite.model.machine import Machine, error_line
from excite.model.mechanics import round_angle
from excite.workflows import urdf_file
from excite.workflows.urdf_file import Joint, Urdf

PARALLEL = 1e-4  # sine of the angle below which two axes count as parallel: the digits that files give
RESIDUE = 1e-9  # [m], and of the size of an inertia, below which a number is an error of rounding
DIGITS = 12  # significant ones of numbers in the file
NEAR_ZERO = 0.1  # of the typical size with its unit, below which a parameter gets that size as scale; chosen
SAME_ROW = 1e-6  # rad, m, by which lengths and angles of a machine may differ from the URDF's; chosen
ASSUMED_FRICTION = 1.0  # N m, N m s and so on, of a joint without; assumed
FRICTION_SHARE = 0.1  # of the joint's largest torque, at most, that is assumed as friction
SAMPLING_HZ, CUTOFF_HZ, DECIMATION, SMOOTHING = 100, 5, 5, 0.01  # of the machine file to start from; assumed
SIZES = {"kg": 1.0, "kg m": 0.1, "kg m2": 0.01}  # at least, of parameters near zero; assumed
MOST_JOINTS = 30  # of a robot that becomes a machine: the equations of more take minutes


@dataclass(frozen=True)
class JointFrame:
    """A moving joint of a URDF.

    antecedent: index of the moving joint before it, None for the ground. row: its modified Denavit-Hartenberg
    parameters. placement (4, 4): of the child link's frame in the joint's frame.
    """

    joint: Joint
    antecedent: int | None
    row: dict[str, float]
    placement: np.ndarray


@dataclass(frozen=True)
class Robot:
    """Moving joints of a URDF, and the links rigidly attached to each with their placement (4, 4) in its frame."""

    urdf: Urdf
    joints: tuple[JointFrame, ...]
    attached: tuple[tuple[tuple[str, np.ndarray], ...], ...]

    @property
    def leaders(self) -> tuple[int | None, ...]:
        """Index of the joint that each one mimics, None for one that moves on its own."""
        names = [frame.joint.name for frame in self.joints]
        return tuple(None if f.joint.mimic is None else names.index(f.joint.mimic.joint) for f in self.joints)

    def massless(self, k: int) -> bool:
        """True if no link behind joint k has a mass."""
        return not any(given.mass for link, _ in self.attached[k] if (given := self.urdf.links[link]) is not None)


def read_robot(path: Path) -> Robot:
    """Read the moving joints of a URDF in the order of their tree.

    Raises MachineError for a file that is no URDF, has no moving joint, or a joint of another type.
    """
    urdf = urdf_file.read(path)
    joints: list[JointFrame] = []
    attached: list[list[tuple[str, np.ndarray]]] = []
    place: dict[str, tuple[int | None, np.ndarray]] = {urdf.base: (None, np.eye(4))}
    for joint in urdf.joints:
        carrier, placement = place[joint.parent]
        at = placement @ joint.placement
        if joint.kind == "fixed":
            if carrier is not None:
                attached[carrier].append((joint.child, at))
            place[joint.child] = carrier, at
            continue
        free = carrier is not None and joints[carrier].joint.kind == "revolute" and joints[carrier].joint.mimic is None
        row, frame = _common_normal(at[:3, :3] @ joint.axis, at[:3, 3], free)
        own = np.linalg.inv(frame) @ at
        place[joint.child] = len(joints), own
        joints.append(JointFrame(joint, carrier, row, own))
        attached.append([(joint.child, own)])
    if not joints:
        raise MachineError(f"{path}: no joint moves, so there is nothing to identify")
    if len(joints) > MOST_JOINTS:
        raise MachineError(
            f"{path}: has {len(joints)} moving joints, at most {MOST_JOINTS} can be identified at once: fix those that"
            ' stand still (type="fixed")'
        )
    return Robot(urdf, tuple(joints), tuple(tuple(a) for a in attached))


def _common_normal(axis: np.ndarray, point: np.ndarray, free: bool) -> tuple[dict[str, float], np.ndarray]:
    """Return the row (gamma, b, alpha, d) and the frame (4, 4) of a joint's axis through a point, in the frame before.

    The frame lies where the common normal with the z axis of the frame before meets the axis. free: the joint before
    turns freely, so gamma adds to its angle, may be any and is not rounded.
    """
    z = np.array([0.0, 0.0, 1.0])
    normal = np.cross(z, axis)
    sine = float(np.linalg.norm(normal))
    if sine < PARALLEL:
        b, d = float(point[2]), math.hypot(point[0], point[1])
        gamma = math.atan2(point[1], point[0]) if d > RESIDUE else 0.0
        alpha = 0.0 if axis[2] > 0 else math.pi
    else:
        x = normal / sine
        d = float(point @ x)
        # b z + d x = point + s axis
        b = float(np.linalg.lstsq(np.column_stack([z, -axis]), point - d * x, rcond=None)[0][0])
        gamma, alpha = math.atan2(x[1], x[0]), math.atan2(sine, float(axis[2]))
    rounded = round_angle(gamma)
    gamma_taken = gamma if free and abs(gamma - rounded) > RESIDUE else rounded
    b_taken, d_taken = (0.0 if abs(value) < RESIDUE else value for value in (b, d))
    row = {"gamma": gamma_taken, "b": b_taken, "alpha": round_angle(alpha), "d": d_taken}
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("ZX", [gamma_taken, row["alpha"]]).as_matrix()
    frame[:3, 3] = d * math.cos(gamma), d * math.sin(gamma), b  # on the axis, whatever was rounded
    return row, frame


def _whole_inertia(robot: Robot, k: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass (3,) and inertia (3, 3) about it of the links behind joint k, zeros without one."""
    parts = []
    for link, at in robot.attached[k]:
        if (given := robot.urdf.links[link]) is not None:
            place = at @ given.placement
            R = place[:3, :3]
            parts.append((given.mass, place[:3, 3], R @ given.inertia @ R.T))
    if not parts:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    mass = sum(m for m, _, _ in parts)
    centre = sum((m * c for m, c, _ in parts), np.zeros(3)) / (mass or 1.0)
    J = np.zeros((3, 3))
    for m, c, own in parts:
        r = c - centre
        J += own + m * (float(r @ r) * np.eye(3) - np.outer(r, r))
    return mass, centre, J


def machine_from_urdf(path: Path, name: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the tables of a machine file for a robot, and notes on what was read otherwise than it is written.

    Geometry, inertia, limits and friction are those of the URDF; what it does not give is assumed and says so. A joint
    that mimics another moves with it. Raises MachineError.
    """
    robot = read_robot(path)
    names = body_names(robot)
    notes = list(robot.urdf.notes)
    machine: dict[str, Any] = {
        "name": name,
        "title": robot.urdf.name,
        "reference": f"from {path.name}",
        "sampling_hz": _assumed(SAMPLING_HZ),
        "gravity": [0.0, 0.0, -9.81],
        "body": [_body(robot, k, names[k]) for k in range(len(robot.joints))],
        "sensor": [],
    }
    for k, (frame, leader) in enumerate(zip(robot.joints, robot.leaders, strict=True)):
        joint, turns = frame.joint, frame.joint.kind == "revolute"
        if robot.massless(k):
            notes.append(f"link {joint.child}: has no mass in the URDF, so it has none here: mass 0")
        if leader is not None and joint.mimic is not None:
            notes.append(
                f"joint {joint.name}: moves with {joint.mimic.joint}: multiplier {joint.mimic.multiplier:g}, offset"
                f" {joint.mimic.offset:g}; it has no sensors of its own"
            )
            continue
        common = {"body": k + 1}
        angle = {"name": f"q{k + 1}", "kind": "angle", "column": f"{joint.name}_{'rad' if turns else 'm'}"}
        torque = {"name": f"u{k + 1}", "kind": "torque", "column": f"{joint.name}_{'Nm' if turns else 'N'}"}
        machine["sensor"].append(angle | common | {"unit": "rad" if turns else "m"})
        machine["sensor"].append(torque | common | {"unit": "N m" if turns else "N"})
    cutoff = {"source": "assumed", "cutoff_hz": _assumed(CUTOFF_HZ), "decimation": DECIMATION}
    machine["filter"] = cutoff
    try:
        machine["scale"] = _scales(machine)
    except ValidationError as err:
        raise MachineError(f"{error_line(path, err, Machine)}: as the URDF gives it") from None
    return machine, tuple(notes)


def body_names(robot: Robot) -> list[str]:
    """Return a name for the body behind each joint that a machine file allows: the link's, in small letters."""
    found: list[str] = []
    for k, frame in enumerate(robot.joints):
        plain = re.sub(r"[^a-z0-9_]+", "_", frame.joint.child.lower()).strip("_")
        plain = plain if plain[:1].isalpha() else f"link_{plain}".rstrip("_")
        while plain in found:
            plain = f"{plain}_{k + 1}"
        found.append(plain)
    return found


def _body(robot: Robot, k: int, name: str) -> dict[str, Any]:
    """Return the table of the body behind joint k."""
    frame, leader = robot.joints[k], robot.leaders[k]
    joint = frame.joint
    body: dict[str, Any] = {
        "index": k + 1,
        "name": name,
        "antecedent": "ground" if frame.antecedent is None else frame.antecedent + 1,
        "joint": joint.kind,
    }
    if leader is None or joint.mimic is None:
        body["actuated"] = True
    else:
        ratio = {"joint": leader + 1, "ratio": _given(joint.mimic.multiplier)}
        body["moves_with"] = ratio | ({"offset": _given(joint.mimic.offset)} if joint.mimic.offset else {})
    body |= {key: _given(value) for key, value in frame.row.items()}
    body["gamma"] |= {"tolerance": 0.0} if round_angle(frame.row["gamma"]) != frame.row["gamma"] else {}
    mass, centre, J = _whole_inertia(robot, k)
    said = {"note": "the URDF gives no mass"} if robot.massless(k) else {}
    axes = {"XX": (0, 0), "XY": (0, 1), "XZ": (0, 2), "YY": (1, 1), "YZ": (1, 2), "ZZ": (2, 2)}
    size = float(np.trace(J)) + mass * float(centre @ centre)
    body["inertia"] = {
        "mass": _given(mass) | said,
        "com": {"value": [_rounded(x, RESIDUE) for x in centre], "source": "published"},
        **{key: _given(_rounded(J[ij], RESIDUE * size)) for key, ij in axes.items()},
    }
    if leader is None or joint.damping or joint.friction:
        usual = min(ASSUMED_FRICTION, FRICTION_SHARE * (joint.effort or math.inf))
        body["friction"] = {
            "Fv": _given(joint.damping) if joint.damping else _assumed(usual),
            "Fs": _given(joint.friction) if joint.friction else _assumed(usual),
            "u0": _assumed(0.0),
            "smoothing": _assumed(SMOOTHING),
        }
    limits = {"torque": None if leader is not None else joint.effort, "rate": joint.velocity}
    body["limit"] = {key: _given(value) for key, value in limits.items() if value}
    if joint.low is not None and joint.high is not None:
        low, high = joint.low, joint.high
        ends = {"position": high} if low == -high else {"position_low": low, "position_high": high}
        body["limit"] |= {key: _given(value) for key, value in ends.items()}
    return body


def _scales(machine: dict[str, Any]) -> dict[str, Any]:
    """Return a size for each base parameter near zero in the URDF: a typical one of those with its unit."""
    record = Machine.model_validate(machine)
    every = {n + end: _assumed(1.0) for n in standard_parameters(record) for end in ("", "R")}
    model = build(Machine.model_validate(machine | {"scale": every}))
    sizes = np.abs(model.nominal)
    found = {}
    for name, unit, size in zip(model.base.names, model.base.units, sizes, strict=True):
        alike = np.array([s for u, s in zip(model.base.units, sizes, strict=True) if u == unit and s > 0])
        typical = max(float(np.median(alike)) if len(alike) else 0.0, SIZES.get(unit, 1.0))
        if size < NEAR_ZERO * typical:
            found[name] = _assumed(float(np.format_float_positional(typical, precision=2, fractional=False)))
    return found


def urdf_with_estimate(path: Path, model: Model, estimate: Estimate) -> tuple[str, list[str]]:
    """Return the text of a URDF with identified inertia and friction, and notes on what has no place in it.

    model: of the machine file from this URDF. Each moving link gets the inertia of all links attached to it, which lose
    theirs. The bodies are those of `possible_standard`; a note says how far off they are if no possible ones have the
    identified base parameters. Raises MachineError for another robot's URDF, NotConsistentError.
    """
    robot = read_robot(path)
    machine = model.machine
    if machine.in_ratios:
        raise MachineError(
            f"{machine.name}: its values are divided by an unknown torque constant, URDF needs SI values"
        )
    _check_same(path, robot, machine)
    p, far = identification.possible_standard(model, estimate)
    root = urdf_file.parse(path)
    links = {link.get("name"): link for link in root.findall("link")}
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for k, (frame, attached) in enumerate(zip(robot.joints, robot.attached, strict=True), start=1):
        for link, _ in attached:
            for old in links[link].findall("inertial"):
                links[link].remove(old)
        mass, centre, J = _about_centre(p, k)
        R, t = frame.placement[:3, :3], frame.placement[:3, 3]
        centre, J = R.T @ (centre - t), R.T @ J @ R
        inertial = ElementTree.SubElement(links[frame.joint.child], "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=" ".join(f"{x:.15g}" for x in centre), rpy="0 0 0")
        ElementTree.SubElement(inertial, "mass", value=f"{mass:.15g}")
        axes = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ElementTree.SubElement(inertial, "inertia", {key: f"{J[ij]:.15g}" for key, ij in axes.items()})
        if f"Fv{k}" in p:
            joint = joints[frame.joint.name]
            dynamics = joint.find("dynamics")
            dynamics = ElementTree.SubElement(joint, "dynamics") if dynamics is None else dynamics
            dynamics.set("damping", f"{p[f'Fv{k}']:.12g}")
            dynamics.set("friction", f"{p[f'Fs{k}']:.12g}")
    ElementTree.indent(root)
    lost = [(b.where, what) for b in machine.body for what in ("drive", "spring") if getattr(b, what) is not None]
    said = {"drive": "rotor inertia", "spring": "spring"}
    notes = [f"{where}: a URDF has no place for its {said[what]}, which is left out" for where, what in lost]
    if far is not None:
        notes.append(far)
    return ElementTree.tostring(root, encoding="unicode") + "\n", notes


def _check_same(path: Path, robot: Robot, machine: Machine) -> None:
    """Raise MachineError unless the machine's joints are those of the URDF."""
    same = len(machine.body) == len(robot.joints)
    for body, name, frame in zip(machine.body, body_names(robot), robot.joints, strict=False):
        same &= body.name == name and body.joint == frame.joint.kind and body.inertia is not None
        same &= all(abs(float(getattr(body, key)) - value) < SAME_ROW for key, value in frame.row.items())
    if not same:
        raise MachineError(
            f"{path}: has other joints than machine {machine.name}: give the URDF that `excite machine new --from` read"
        )


def _about_centre(p: Mapping[str, float], k: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass (3,) and inertia (3, 3) about it of body k, in its frame."""
    M = p[f"M{k}"]
    c = np.array([p[f"M{axis}{k}"] for axis in "XYZ"]) / M
    J = np.array([[p[f"{min(a, b)}{max(a, b)}{k}"] for b in "XYZ"] for a in "XYZ"])
    return M, c, J - M * (float(c @ c) * np.eye(3) - np.outer(c, c))


def _rounded(value: float, residue: float = 1e-12) -> float:
    """Round a number to DIGITS, to zero below a residue; the least that a machine file takes is 1e-12."""
    return 0.0 if abs(value) < max(residue, 1e-12) else float(f"{value:.{DIGITS}g}")


def _given(value: float) -> dict[str, Any]:
    return {"value": _rounded(value), "source": "published"}


def _assumed(value: float) -> dict[str, Any]:
    return {"value": value, "source": "assumed"}
