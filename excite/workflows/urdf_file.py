"""Read a file in the Unified Robot Description Format (URDF): links, joints and how they hang together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NoReturn
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from excite.errors import MachineError
from excite.model.mechanics import round_angle
from excite.text import did_you_mean

Kind = Literal["revolute", "prismatic", "fixed"]
MOVING: dict[str, Kind] = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
MAX_BYTES = 20_000_000  # of a file; the largest public ones have 0.3 MB
MAX_NUMBER = 1e9  # in SI units, of any number but a limit
LONGEST_WORD = 120  # characters of a name or value in a message
NO_LIMIT = 1e6  # [rad, m, N m and so on] from which a limit stands for none, as in files that can't say infinity


@dataclass(frozen=True)
class Inertial:
    """Mass [kg], placement (4, 4) of the frame of the inertia (3, 3) [kg m2] about the centre of mass."""

    mass: float
    placement: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Mimic:
    """Position of a joint: multiplier x that of `joint` + offset [rad, m]."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF: kind "revolute", "prismatic" or "fixed"; placement (4, 4) in the parent link; axis (3,).

    low, high [rad, m]; effort [N m, N]; velocity [rad/s, m/s]; damping, friction: None if not given, or no limit.
    """

    name: str
    kind: Kind
    parent: str
    child: str
    placement: np.ndarray
    axis: np.ndarray
    low: float | None
    high: float | None
    effort: float | None
    velocity: float | None
    damping: float | None
    friction: float | None
    mimic: Mimic | None


@dataclass(frozen=True)
class Urdf:
    """A robot: inertia of its links by name (None without one), joints from the base outwards, notes on what was read.

    base: name of the link that stands on the ground.
    """

    name: str
    links: dict[str, Inertial | None]
    joints: tuple[Joint, ...]
    base: str
    notes: tuple[str, ...]


class _Reader:
    """Reads elements of one file; every error names the file, the element and what is wrong with it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []

    def refuse(self, what: str) -> NoReturn:
        words = (w if len(w) <= LONGEST_WORD else f"{w[:LONGEST_WORD]}..." for w in what.split())
        raise MachineError(f"{self.path}: {' '.join(words)}")

    def number(self, where: str, key: str, text: str, most: float = MAX_NUMBER) -> float:
        try:
            value = float(text)
        except ValueError:
            self.refuse(f"{where}: {key}: must be a number (got {text[:40]!r})")
        if math.isnan(value) or abs(value) > most:
            self.refuse(f"{where}: {key}: must be a finite number, {most:g} at most (got {value:g})")
        return value

    def vector(self, where: str, key: str, text: str) -> np.ndarray:
        parts = text.split()
        if len(parts) != 3:
            self.refuse(f"{where}: {key}: must be three numbers (got {text[:60]!r})")
        return np.array([self.number(where, key, p) for p in parts])

    def placement(self, where: str, element: ElementTree.Element) -> np.ndarray:
        """Return the placement (4, 4) of the <origin> in an element, none for the identity."""
        at = np.eye(4)
        origin = element.find("origin")
        if origin is None:
            return at
        at[:3, 3] = self.vector(where, "origin xyz", origin.get("xyz", "0 0 0"))
        given = self.vector(where, "origin rpy", origin.get("rpy", "0 0 0"))
        angles = np.array([round_angle(x) for x in given])
        if np.abs(angles - given).max() > 1e-7:  # as in the tenth digit of pi: nothing to speak of
            self.notes.append(f"{where}: rpy {' '.join(f'{x:.10g}' for x in given)} is taken for multiples of pi/4")
        at[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        at[:3, :3][np.abs(at[:3, :3]) < 1e-15] = 0.0
        return at

    def inertial(self, where: str, link: ElementTree.Element) -> Inertial | None:
        given = link.find("inertial")
        mass = given.find("mass") if given is not None else None
        if given is None or mass is None:
            return None
        m = self.number(where, "mass", mass.get("value", ""))
        if m < 0:
            self.refuse(f"{where}: mass: must be 0 or above (got {m:g})")
        tensor = np.zeros((3, 3))
        inertia = given.find("inertia")
        if m and inertia is None:
            self.notes.append(f"{where}: has a mass but no inertia in the URDF, so it is a point mass here")
        for i, a in enumerate("xyz"):
            for j, b in enumerate("xyz"[i:], start=i):
                text = inertia.get(f"i{a}{b}", "0") if inertia is not None else "0"
                tensor[i, j] = tensor[j, i] = self.number(where, f"inertia i{a}{b}", text)
        if (np.diag(tensor) < 0).any():
            self.refuse(f"{where}: inertia: ixx, iyy and izz must be 0 or above")
        return Inertial(m, self.placement(f"{where}: inertial", given), tensor)

    def joint(self, element: ElementTree.Element) -> Joint:
        name = element.get("name", "")
        where = f"joint {name}"
        said = element.get("type", "")
        if said != "fixed" and said not in MOVING:
            still = " (if the base does not move while it is measured)" if said in ("floating", "planar") else ""
            allowed = f"fixed{still}, {', '.join(MOVING)}"
            self.refuse(f"{where}: type {said or '(none)'} has no place in a machine file, allowed: {allowed}")
        ends = [element.find(end) for end in ("parent", "child")]
        parent, child = ("" if end is None else end.get("link", "") for end in ends)
        if not parent or not child:
            self.refuse(f"{where}: needs <parent link=.../> and <child link=.../>")
        axis = element.find("axis")
        along = self.vector(where, "axis", "1 0 0" if axis is None else axis.get("xyz", "1 0 0"))
        size = float(np.linalg.norm(along))
        if said != "fixed" and size < 1e-6:
            self.refuse(f"{where}: axis: must have a direction (got {along})")
        numbers: dict[str, float | None] = {}
        for tag, keys in (("limit", ("lower", "upper", "effort", "velocity")), ("dynamics", ("damping", "friction"))):
            found = element.find(tag)
            for key in keys:
                text = None if found is None else found.get(key, "0" if key in ("lower", "upper") else None)
                value = None if text is None else self.number(where, f"{tag} {key}", text, math.inf)
                numbers[key] = value if value is None or abs(value) < NO_LIMIT else None
        for key in ("effort", "velocity", "damping", "friction"):
            if (numbers[key] or 0.0) < 0:
                self.refuse(f"{where}: {key}: must be 0 or above (got {numbers[key]:g})")
        low, high = numbers["lower"] or 0.0, numbers["upper"] or 0.0
        ranged = said in ("revolute", "prismatic") and None not in (numbers["lower"], numbers["upper"])
        if ranged and low >= high:
            ranged = False
            self.notes.append(f"{where}: lower {low:g} is not below upper {high:g}: the joint has no limits here")
        mimic = element.find("mimic")
        follows = None
        if mimic is not None and said != "fixed":
            factor = self.number(where, "mimic multiplier", mimic.get("multiplier", "1"))
            shift = self.number(where, "mimic offset", mimic.get("offset", "0"))
            follows = Mimic(mimic.get("joint", ""), factor, shift)
        at, direction = self.placement(where, element), along / (size or 1.0)
        span: tuple[float | None, float | None] = (low, high) if ranged else (None, None)
        given = (numbers["effort"] or None, numbers["velocity"] or None, numbers["damping"], numbers["friction"])
        return Joint(name, MOVING.get(said, "fixed"), parent, child, at, direction, *span, *given, follows)


def parse(path: Path) -> ElementTree.Element:
    """Return the root of a URDF, comments included. Raises MachineError for a file that is none."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MachineError(f"{path}: is larger than {MAX_BYTES / 1e6:g} MB: no URDF")
        if not path.is_file():
            raise MachineError(f"{path}: can't be read as URDF: is no file")
        builder = ElementTree.TreeBuilder(insert_comments=True)
        root = ElementTree.parse(path, ElementTree.XMLParser(target=builder)).getroot()
    except OSError as err:
        raise MachineError(f"{path}: can't be read as URDF: {err.strerror}") from None
    except (ElementTree.ParseError, ValueError, LookupError) as err:  # an encoding that is unknown, too
        raise MachineError(f"{path}: can't be read as URDF: {' '.join(str(err).split())}") from None
    if root.tag != "robot":
        said = str(root.tag)[:40]
        raise MachineError(f"{path}: no URDF: its root is <{said}>, not <robot>; xacro must be expanded first")
    return root


def read(path: Path) -> Urdf:
    """Read a URDF. A link `world` may be named as a parent without being declared. Raises MachineError."""
    root = parse(path)
    reader = _Reader(path)
    links: dict[str, Inertial | None] = {}
    for element in root.findall("link"):
        name = element.get("name", "")
        if not name or name in links:
            reader.refuse(f"link {name or '(no name)'}: " + ("is given twice" if name else "needs a name"))
        links[name] = reader.inertial(f"link {name}", element)
    joints = [reader.joint(element) for element in root.findall("joint")]
    names = [j.name for j in joints]
    for joint in joints:
        if not joint.name or names.count(joint.name) > 1:
            reader.refuse(f"joint {joint.name or '(no name)'}: " + ("is given twice" if joint.name else "needs a name"))
        if joint.parent == "world":
            links.setdefault("world", None)
        for end in (joint.parent, joint.child):
            if end not in links:
                reader.refuse(f"joint {joint.name}: no link {end}{did_you_mean(end, links)}")
    joints = list(_with_resolved_mimics(reader, joints))
    base = _base(reader, links, joints)
    return Urdf(root.get("name") or path.stem, links, _outwards(reader, base, joints), base, tuple(reader.notes))


def _base(reader: _Reader, links: dict[str, Inertial | None], joints: Sequence[Joint]) -> str:
    """Return the one link without a joint above it."""
    if not links:
        reader.refuse("has no links; a xacro file must be expanded first")
    children = [j.child for j in joints]
    for joint in joints:
        if children.count(joint.child) > 1:
            reader.refuse(
                f"link {joint.child}: has two joints above it, a tree has one: closed loops have no place here"
            )
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        several = f"links {', '.join(roots)} have no joint above them; a robot has one such link, fix the others to it"
        reader.refuse(several if roots else "every link has a joint above it: the joints form a loop")
    return roots[0]


def _outwards(reader: _Reader, base: str, joints: Sequence[Joint]) -> tuple[Joint, ...]:
    """Return the joints from the base outwards, those of one link in the order of the file."""
    below: dict[str, list[Joint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    order: list[Joint] = []
    waiting = [base]
    while waiting:
        found = below.get(waiting.pop(0), [])
        order += found
        waiting += [j.child for j in found]
    if len(order) < len(joints):
        lost = next(j for j in joints if j not in order)
        reader.refuse(f"joint {lost.name}: is in a loop of joints that the base does not carry")
    return tuple(order)


def _with_resolved_mimics(reader: _Reader, joints: Sequence[Joint]) -> Iterator[Joint]:
    """Yield the joints, each that mimics with a leader that moves on its own; a multiplier of 0 makes it fixed."""
    by_name = {j.name: j for j in joints}
    moving = [j.name for j in joints if j.kind != "fixed"]
    for joint in joints:
        factor, shift, leader, seen = 1.0, 0.0, joint, {joint.name}
        while leader.mimic is not None and factor:
            said = leader.mimic
            if said.joint not in moving:
                unknown = f"no moving joint {said.joint or '(none)'}{did_you_mean(said.joint, moving)}"
                fixed = f"joint {said.joint} is fixed, name one that moves"
                reader.refuse(f"joint {leader.name}: mimic: {fixed if said.joint in by_name else unknown}")
            if said.joint in seen:
                reader.refuse(f"joint {joint.name}: mimics itself through {said.joint}")
            seen.add(said.joint)
            factor, shift, leader = factor * said.multiplier, shift + factor * said.offset, by_name[said.joint]
        if joint.mimic is None:
            yield joint
        elif factor:
            yield replace(joint, mimic=Mimic(leader.name, factor, shift))
        else:
            at = joint.placement.copy()
            if joint.kind == "revolute":
                at[:3, :3] = at[:3, :3] @ Rotation.from_rotvec(shift * joint.axis).as_matrix()
            else:
                at[:3, 3] += at[:3, :3] @ joint.axis * shift
            yield replace(joint, kind="fixed", placement=at, mimic=None)
