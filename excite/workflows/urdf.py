"""Robots in the Unified Robot Description Format: a machine file from one, and one with identified inertias.

A joint's frame has z along its axis and x along the common normal from the axis before (modified Denavit-Hartenberg,
Khalil and Kleinfinger, 1986); its coordinate is that of the joint in the URDF. Links behind fixed joints are part of
the link that carries them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from excite import identification
from excite.errors import MachineError
from excite.identification import Estimate
from excite.model import Model, build, standard_parameters
from excite.model.machine import Machine

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
PARALLEL = 1e-9  # sine of the angle and distance [m] below which two axes count as parallel, or meet
ROUND_DIGITS = 12  # of numbers in the file; below them are errors of rounding
NEAR_ZERO = 0.1  # of the typical size with its unit, below which a parameter gets that size as scale; chosen
SAME_ROW = 1e-6  # rad, m, by which lengths and angles of a machine may differ from the URDF's; chosen
ASSUMED_INERTIA = 0.01  # kg m2, of a link without inertia; assumed
SAMPLING_HZ, CUTOFF_HZ, DECIMATION, SMOOTHING = 100, 5, 5, 0.01  # of the machine file to start from; assumed
SIZES = {"kg": 1.0, "kg m": 0.1, "kg m2": 0.01}  # at least, of parameters near zero; assumed


@dataclass(frozen=True)
class JointFrame:
    """A moving joint of a URDF.

    name, kind; link: of the child. antecedent: index of the moving joint before it, None for the ground.
    row: its modified Denavit-Hartenberg parameters. placement (4, 4): of the child link's frame in the joint's frame.
    """

    name: str
    kind: str
    link: str
    antecedent: int | None
    row: dict[str, float]
    placement: np.ndarray
    joint: Any


@dataclass(frozen=True)
class Robot:
    """Moving joints of a URDF, and the links rigidly attached to each with their placement (4, 4) in its frame."""

    name: str
    joints: tuple[JointFrame, ...]
    attached: tuple[tuple[tuple[Any, np.ndarray], ...], ...]
    mimics: tuple[str, ...]


def read_urdf(path: Path) -> Robot:
    """Read the joints of a URDF in the order of their tree.

    Raises MachineError for a file that is no URDF, has no moving joint, or a joint of another type.
    """
    try:
        import yourdfpy
        from lxml import etree
    except ImportError:
        raise MachineError(f"{path}: URDF needs the extra `urdf`: pip install 'excite[urdf]'") from None
    try:
        root = etree.parse(str(path)).getroot().tag
    except (OSError, etree.XMLSyntaxError) as err:
        raise MachineError(f"{path}: can't be read as URDF: {' '.join(str(err).split())}") from None
    if root != "robot":
        raise MachineError(f"{path}: no URDF: its root is <{root}>, not <robot>; xacro must be expanded first")
    try:
        urdf = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
    except Exception as err:  # whatever the parser of URDF raises
        raise MachineError(f"{path}: can't be read as URDF: {' '.join(str(err).split())}") from None
    robot = urdf.robot
    children = {j.child for j in robot.joints}
    roots = [link for link in robot.links if link.name not in children]
    if len(roots) != 1:
        raise MachineError(f"{path}: has {len(roots)} links without a joint above them, a robot has one, its base")
    links = {link.name: link for link in robot.links}
    joints: list[JointFrame] = []
    attached: list[list[tuple[Any, np.ndarray]]] = []
    waiting: list[tuple[str, int | None, np.ndarray]] = [(roots[0].name, None, np.eye(4))]
    while waiting:
        link, carrier, placement = waiting.pop(0)
        for joint in (j for j in robot.joints if j.parent == link):
            at = placement @ (np.eye(4) if joint.origin is None else joint.origin)
            if joint.type == "fixed":
                if carrier is not None:
                    attached[carrier].append((links[joint.child], at))
                waiting.append((joint.child, carrier, at))
                continue
            if joint.type not in MOVING:
                raise MachineError(
                    f"{path}: joint {joint.name}: type {joint.type} has no place in a machine file, allowed: fixed,"
                    f" {', '.join(MOVING)}"
                )
            axis = np.array([1.0, 0.0, 0.0]) if joint.axis is None else np.asarray(joint.axis, float)
            row, frame = _common_normal(at[:3, :3] @ axis / np.linalg.norm(axis), at[:3, 3])
            own = np.linalg.inv(frame) @ at
            index = len(joints)
            joints.append(JointFrame(joint.name, MOVING[joint.type], joint.child, carrier, row, own, joint))
            attached.append([(links[joint.child], own)])
            waiting.append((joint.child, index, own))
    if not joints:
        raise MachineError(f"{path}: no joint moves, so there is nothing to identify")
    mimics = tuple(j.name for j in joints if j.joint.mimic is not None)
    return Robot(robot.name or path.stem, tuple(joints), tuple(tuple(a) for a in attached), mimics)


def _common_normal(axis: np.ndarray, point: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    """Return the row (gamma, b, alpha, d) and the frame (4, 4) of a joint's axis through a point, in the frame before.

    The frame lies where the common normal with the z axis of the frame before meets the axis.
    """
    z = np.array([0.0, 0.0, 1.0])
    normal = np.cross(z, axis)
    sine = float(np.linalg.norm(normal))
    if sine < PARALLEL:
        b, foot = float(point[2]), point
        across = point - b * z
        d = float(np.linalg.norm(across))
        x = across / d if d > PARALLEL else np.array([1.0, 0.0, 0.0])
    else:
        x = normal / sine
        d = float(point @ x)
        # b z + d x = point + s axis
        b, s = np.linalg.lstsq(np.column_stack([z, -axis]), point - d * x, rcond=None)[0]
        foot = point + s * axis
    alpha = math.atan2(float(np.cross(z, axis) @ x), float(axis[2]))
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = np.column_stack([x, np.cross(axis, x), axis]), foot
    return {"gamma": math.atan2(x[1], x[0]), "b": float(b), "alpha": alpha, "d": d}, frame


def _whole_inertia(links: Sequence[tuple[Any, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Return mass, centre of mass (3,) and inertia (3, 3) about it of links together, None if none has a mass."""
    parts = []
    for link, at in links:
        given = link.inertial
        if given is None or not given.mass:
            continue
        place = at @ (np.eye(4) if given.origin is None else given.origin)
        R = place[:3, :3]
        J = np.zeros((3, 3)) if given.inertia is None else np.asarray(given.inertia, float)
        parts.append((float(given.mass), place[:3, 3], R @ J @ R.T))
    if not parts:
        return None
    mass = sum(m for m, _, _ in parts)
    centre = np.asarray(sum(m * c for m, c, _ in parts)) / mass
    J = np.zeros((3, 3))
    for m, c, own in parts:
        r = c - centre
        J += own + m * (float(r @ r) * np.eye(3) - np.outer(r, r))
    return mass, centre, J


def machine_from_urdf(path: Path, name: str) -> dict[str, Any]:
    """Return the tables of a machine file for a robot: geometry, inertia, limits and friction of the URDF.

    What it does not give is assumed and says so. Raises MachineError.
    """
    robot = read_urdf(path)
    names = body_names(robot)
    machine: dict[str, Any] = {
        "name": name,
        "title": robot.name,
        "reference": f"from {path.name}",
        "sampling_hz": _assumed(SAMPLING_HZ),
        "gravity": [0.0, 0.0, -9.81],
    }
    if robot.mimics:
        machine["locked"] = [
            f"{'theta' if j.kind == 'revolute' else 'q'}{k + 1}"
            for k, j in enumerate(robot.joints)
            if j.name in robot.mimics
        ]
    machine["body"] = [_body(robot, k, names[k]) for k in range(len(robot.joints))]
    machine["sensor"] = []
    for k, j in enumerate(robot.joints):
        turns = j.kind == "revolute"
        common = {"body": k + 1}
        angle = {"name": f"q{k + 1}", "kind": "angle", "column": f"{j.name}_{'rad' if turns else 'm'}"}
        torque = {"name": f"u{k + 1}", "kind": "torque", "column": f"{j.name}_{'Nm' if turns else 'N'}"}
        machine["sensor"].append(angle | common | {"unit": "rad" if turns else "m"})
        machine["sensor"].append(torque | common | {"unit": "N m" if turns else "N"})
    cutoff = {"source": "assumed", "cutoff_hz": _assumed(CUTOFF_HZ), "decimation": DECIMATION}
    machine["filter"] = cutoff
    machine["scale"] = _scales(machine)
    return machine


def body_names(robot: Robot) -> list[str]:
    """Return a name for the body behind each joint that a machine file allows: the link's, in small letters."""
    found: list[str] = []
    for k, joint in enumerate(robot.joints):
        plain = re.sub(r"[^a-z0-9_]+", "_", joint.link.lower()).strip("_")
        plain = plain if plain[:1].isalpha() else f"link_{plain}".rstrip("_")
        found.append(plain if plain not in found else f"{plain}_{k + 1}")
    return found


def _body(robot: Robot, k: int, name: str) -> dict[str, Any]:
    """Return the table of the body behind joint k."""
    frame = robot.joints[k]
    given = frame.joint
    body: dict[str, Any] = {
        "index": k + 1,
        "name": name,
        "antecedent": "ground" if frame.antecedent is None else frame.antecedent + 1,
        "joint": frame.kind,
        "actuated": True,
    }
    body |= {key: _given(value) for key, value in frame.row.items()}
    whole = _whole_inertia(robot.attached[k])
    said = "published"
    if whole is None:
        whole, said = (1.0, np.full(3, 0.05), ASSUMED_INERTIA * np.eye(3)), "assumed"
    mass, centre, J = whole
    axes = {"XX": (0, 0), "XY": (0, 1), "XZ": (0, 2), "YY": (1, 1), "YZ": (1, 2), "ZZ": (2, 2)}
    body["inertia"] = {
        "mass": {"value": mass, "source": said},
        "com": {"value": [_rounded(x) for x in centre], "source": said},
        **{key: {"value": _rounded(J[ij]), "source": said} for key, ij in axes.items()},
    }
    dynamics = given.dynamics
    damping, friction = (getattr(dynamics, key, None) for key in ("damping", "friction"))
    body["friction"] = {
        "Fv": _given(damping) if damping else _assumed(1.0),
        "Fs": _given(friction) if friction else _assumed(1.0),
        "u0": _assumed(0.0),
        "smoothing": _assumed(SMOOTHING),
    }
    limit = given.limit
    if limit is not None:
        body["limit"] = {
            key: _given(value) for key, value in (("torque", limit.effort), ("rate", limit.velocity)) if value
        }
        low, high = limit.lower or 0.0, limit.upper or 0.0
        if given.type != "continuous" and low < high:
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
    theirs. The bodies are the possible ones nearest to the machine file with the identified base parameters, see
    `possible_standard`. Raises MachineError for another robot's URDF, NotConsistentError.
    """
    robot = read_urdf(path)
    from lxml import etree

    machine = model.machine
    if machine.in_ratios:
        raise MachineError(
            f"{machine.name}: its values are divided by an unknown torque constant, URDF needs SI values"
        )
    _check_same(path, robot, machine)
    p = identification.possible_standard(model, estimate)
    tree = etree.parse(str(path))
    links = {link.get("name"): link for link in tree.getroot().findall("link")}
    joints = {joint.get("name"): joint for joint in tree.getroot().findall("joint")}
    for k, (frame, attached) in enumerate(zip(robot.joints, robot.attached, strict=True), start=1):
        for link, _ in attached:
            for old in links[link.name].findall("inertial"):
                links[link.name].remove(old)
        mass, centre, J = _about_centre(p, k)
        R, t = frame.placement[:3, :3], frame.placement[:3, 3]
        centre, J = R.T @ (centre - t), R.T @ J @ R
        inertial = etree.SubElement(links[frame.link], "inertial")
        etree.SubElement(inertial, "origin", xyz=" ".join(f"{x:.12g}" for x in centre), rpy="0 0 0")
        etree.SubElement(inertial, "mass", value=f"{mass:.12g}")
        axes = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        etree.SubElement(inertial, "inertia", **{key: f"{J[ij]:.12g}" for key, ij in axes.items()})
        joint = joints[frame.name]
        dynamics = joint.find("dynamics")
        dynamics = etree.SubElement(joint, "dynamics") if dynamics is None else dynamics
        dynamics.set("damping", f"{p[f'Fv{k}']:.12g}")
        dynamics.set("friction", f"{p[f'Fs{k}']:.12g}")
    etree.indent(tree)
    lost = [(b.where, what) for b in machine.body for what in ("drive", "spring") if getattr(b, what) is not None]
    said = {"drive": "rotor inertia", "spring": "spring"}
    notes = [f"{where}: a URDF has no place for its {said[what]}, which is left out" for where, what in lost]
    return etree.tostring(tree, encoding="unicode", pretty_print=True), notes


def _check_same(path: Path, robot: Robot, machine: Machine) -> None:
    """Raise MachineError unless the machine's joints are those of the URDF."""
    same = len(machine.body) == len(robot.joints)
    for body, name, frame in zip(machine.body, body_names(robot), robot.joints, strict=False):
        same &= body.name == name and body.joint == frame.kind and body.inertia is not None
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


def _rounded(value: float) -> float:
    return round(float(value), ROUND_DIGITS) + 0.0


def _given(value: float) -> dict[str, Any]:
    return {"value": _rounded(value), "source": "published"}


def _assumed(value: float) -> dict[str, Any]:
    return {"value": value, "source": "assumed"}
