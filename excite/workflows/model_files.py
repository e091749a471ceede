"""An arm with its identified parameters as URDF and MJCF, written from the machine file alone.

Frames are those of the machine file, z along each joint's axis. Both formats take a tree of joints that move on their
own; what has no place in them is noted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from excite.errors import MachineError
from excite.model.machine import Body, Machine
from excite.model.mechanics import body_poses

UPRIGHT = 1e-9  # cosine of a pitch below which roll and yaw turn about one axis
NO_LIMIT = 1e3  # rad, N m, rad/s, m, N, m/s: of a joint without a limit, in a format that wants a number


def check_tree(machine: Machine) -> None:
    """Raise MachineError for a machine that is no tree of joints that move on their own, on a fixed base."""
    odd = [b.where for b in machine.body if b.moves_with or b.driven_with or b.contact or b.joint == "planar"]
    if odd or machine.locked or machine.in_ratios:
        why = f"{odd[0]} is coupled, or on the ground" if odd else "coordinates are locked, or values are in ratios"
        raise MachineError(f"{machine.name}: can't be written as a robot model: {why}")


def about_centre(p: Mapping[str, float], k: int) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Return mass [kg], centre (3,) [m] and inertia (3, 3) [kg m2] about it of body k, None if it has no mass."""
    if not p.get(f"M{k}", 0.0) > 0:
        return None
    first = np.array([p.get(f"M{axis}{k}", 0.0) for axis in "XYZ"])
    J = np.array([[p.get(f"{min(a, b)}{max(a, b)}{k}", 0.0) for b in "XYZ"] for a in "XYZ"])
    mass = p[f"M{k}"]
    centre = first / mass
    return mass, centre, J - mass * (float(centre @ centre) * np.eye(3) - np.outer(centre, centre))


def placements(machine: Machine) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return rotation (3, 3) and position (3,) [m] of each body in the body that carries it, joints at zero."""
    poses = body_poses(machine, {})
    found = {}
    for body in machine.body:
        R, P = poses[body.index]
        if body.antecedent == "ground":
            found[body.index] = R, P
        else:
            R0, P0 = poses[body.antecedent]
            found[body.index] = R0.T @ R, R0.T @ (P - P0)
    return found


def notes(machine: Machine, lost: Mapping[str, str]) -> list[str]:
    """Return a line for each table of a body in `lost` (key, what it holds) that has no place in a format."""
    said = [f"{b.where}: {what} is left out" for b in machine.body for key, what in lost.items() if getattr(b, key)]
    if any(b.friction is not None and float(b.friction.u0) for b in machine.body):
        said.append("offsets of torque sensors (u0) are left out")
    return said


def urdf_model(machine: Machine, p: Mapping[str, float]) -> tuple[str, list[str]]:
    """Return the text of a URDF with standard parameters p [SI], and notes. Raises MachineError."""
    check_tree(machine)
    root = ElementTree.Element("robot", name=machine.name)
    base = ElementTree.SubElement(root, "link", name="ground")
    for shape in machine.world.shape:
        _urdf_capsule(base, np.array(shape.ends), float(shape.radius))
    names = {b.index: b.name for b in machine.body}
    for body in machine.body:
        R, P = placements(machine)[body.index]
        link = ElementTree.SubElement(root, "link", name=body.name)
        whole = about_centre(p, body.index)
        if whole is not None:
            mass, centre, J = whole
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "origin", xyz=_words(centre), rpy="0 0 0")
            ElementTree.SubElement(inertial, "mass", value=_word(mass))
            axes = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
            ElementTree.SubElement(inertial, "inertia", {key: _word(J[ij]) for key, ij in axes.items()})
        for shape in body.shape:
            _urdf_capsule(link, np.array(shape.ends), float(shape.radius))
        kind = {"revolute": "revolute", "prismatic": "prismatic"}.get(body.joint, "fixed")
        joint = ElementTree.SubElement(root, "joint", name=f"{body.name}_joint", type=kind)
        carrier = "ground" if body.antecedent == "ground" else names[body.antecedent]
        ElementTree.SubElement(joint, "parent", link=carrier)
        ElementTree.SubElement(joint, "child", link=body.name)
        ElementTree.SubElement(joint, "origin", xyz=_words(P), rpy=_words(roll_pitch_yaw(R)))
        if kind != "fixed":
            ElementTree.SubElement(joint, "axis", xyz="0 0 1")
            low, high = body.limit.position_range or (-NO_LIMIT, NO_LIMIT)
            most = {"effort": body.limit.torque, "velocity": body.limit.rate}
            ends = {"lower": _word(low), "upper": _word(high)}
            ends |= {key: _word(NO_LIMIT if x is None else float(x)) for key, x in most.items()}
            ElementTree.SubElement(joint, "limit", ends)
            rubs = {"damping": p.get(f"Fv{body.index}", 0.0), "friction": p.get(f"Fs{body.index}", 0.0)}
            ElementTree.SubElement(joint, "dynamics", {key: _word(x) for key, x in rubs.items()})
    lost = notes(machine, {"drive": "inertia of the rotor", "spring": "spring"})
    return _text(root), lost


def _urdf_capsule(link: ElementTree.Element, ends: np.ndarray, radius: float) -> None:
    """Add a capsule as two spheres and a cylinder."""
    for end in ends:
        _urdf_shape(link, end, np.zeros(3), "sphere", {"radius": _word(radius)})
    if len(ends) == 2:
        along = ends[1] - ends[0]
        turn, _ = Rotation.align_vectors([along], [[0, 0, 1]])
        size = {"radius": _word(radius), "length": _word(float(np.linalg.norm(along)))}
        _urdf_shape(link, ends.mean(axis=0), roll_pitch_yaw(turn.as_matrix()), "cylinder", size)


def _urdf_shape(link: ElementTree.Element, place: np.ndarray, rpy: np.ndarray, kind: str, size: dict[str, str]) -> None:
    collision = ElementTree.SubElement(link, "collision")
    ElementTree.SubElement(collision, "origin", xyz=_words(place), rpy=_words(rpy))
    ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), kind, size)


def mjcf_model(machine: Machine, p: Mapping[str, float]) -> tuple[str, list[str]]:
    """Return the text of an MJCF model with standard parameters p [SI], and notes. Raises MachineError.

    damping, frictionloss and armature of the joints are viscous friction, dry friction and inertia of the rotor; a
    spring to the ground is stiffness and springref. Shapes are geoms that touch nothing.
    """
    check_tree(machine)
    root = ElementTree.Element("mujoco", model=machine.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ElementTree.SubElement(root, "option", gravity=_words(np.array(machine.gravity)))
    world = ElementTree.SubElement(root, "worldbody")
    for shape in machine.world.shape:
        _mjcf_capsule(world, np.array(shape.ends), float(shape.radius))
    elements: dict[int, ElementTree.Element] = {}
    actuators = ElementTree.Element("actuator")
    at = placements(machine)
    for body in machine.body:
        R, P = at[body.index]
        above = world if body.antecedent == "ground" else elements[body.antecedent]
        x, y, z, w = Rotation.from_matrix(R).as_quat()
        element = ElementTree.SubElement(
            above, "body", name=body.name, pos=_words(P), quat=_words(np.array([w, x, y, z]))
        )
        elements[body.index] = element
        whole = about_centre(p, body.index)
        if whole is not None:
            mass, centre, J = whole
            six = _words(np.array([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]))
            ElementTree.SubElement(element, "inertial", pos=_words(centre), mass=_word(mass), fullinertia=six)
        if body.coordinates:
            ElementTree.SubElement(element, "joint", _mjcf_joint(body, p))
        if body.actuated:
            ElementTree.SubElement(actuators, "motor", name=f"{body.name}_motor", joint=f"{body.name}_joint")
        for shape in body.shape:
            _mjcf_capsule(element, np.array(shape.ends), float(shape.radius))
    root.append(actuators)
    joined = [f"{b.where}: spring to another joint is left out" for b, _ in machine.joined_by_springs]
    return _text(root), [*joined, *notes(machine, {})]


def _mjcf_joint(body: Body, p: Mapping[str, float]) -> dict[str, str]:
    """Return the attributes of a joint: type, range, friction, rotor and spring."""
    k = body.index
    kind = "hinge" if body.joint == "revolute" else "slide"
    found = {"name": f"{body.name}_joint", "type": kind, "axis": "0 0 1"}
    if body.limit.position_range is not None:
        found["range"] = _words(np.array(body.limit.position_range))
    damping = p.get(f"Fv{k}", 0.0)
    if body.spring is not None and body.spring.joint is None:
        damping += p.get(f"Ds{k}", 0.0)
        stiffness = p[f"Ks{k}"]
        found |= {"stiffness": _word(stiffness), "springref": _word(p[f"Ts{k}"] / stiffness if stiffness else 0.0)}
    values = {"damping": damping, "frictionloss": p.get(f"Fs{k}", 0.0), "armature": p.get(f"Ia{k}", 0.0)}
    return found | {key: _word(x) for key, x in values.items() if x}


def _mjcf_capsule(element: ElementTree.Element, ends: np.ndarray, radius: float) -> None:
    """Add a shape that touches nothing."""
    off = {"contype": "0", "conaffinity": "0", "mass": "0"}
    if len(ends) == 2:
        ElementTree.SubElement(
            element, "geom", {"type": "capsule", "fromto": _words(ends.ravel()), "size": _word(radius), **off}
        )
    else:
        ElementTree.SubElement(
            element, "geom", {"type": "sphere", "pos": _words(ends[0]), "size": _word(radius), **off}
        )


def roll_pitch_yaw(R: np.ndarray) -> np.ndarray:
    """Return the angles (3,) [rad] about the fixed axes x, y, z of a rotation (3, 3); yaw 0 where only a sum shows."""
    across = math.hypot(R[0, 0], R[1, 0])
    pitch = math.atan2(-R[2, 0], across)
    if across > UPRIGHT:
        return np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])
    sign = math.copysign(1.0, pitch)
    return np.array([math.atan2(sign * R[0, 1], sign * R[0, 2]), pitch, 0.0])


def _word(x: float) -> str:
    return f"{float(x) + 0.0:.15g}"


def _words(x: np.ndarray) -> str:
    return " ".join(_word(v) for v in x)


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
