"""Capsules around the collision geometry of a URDF, for the shapes of a machine file.

Boxes, cylinders, spheres and meshes of a link become points; a few capsules hold all of them. A link is cut across its
longest direction as long as that saves volume, so that an elbow is not filled up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from excite import output
from excite.errors import UsageError
from excite.workflows.urdf import read_robot

MAX_CAPSULES = 4  # of a link, which bounds the pairs whose distance is a limit
WORTH_A_CUT = 0.15  # share of the volume that each further capsule saves at least
CUTS = 9  # places across a link at which a cut is tried
POINT_SPACING_M = 0.03  # between points on a surface, so that a cut leaves no triangle between two capsules
ROUND_DIGITS = 4  # of lengths [m] in the file


@dataclass(frozen=True)
class Capsule:
    """All points within `radius` [m] of the segment between two ends (2, 3) [m]."""

    ends: np.ndarray
    radius: float

    @property
    def volume(self) -> float:
        """Volume [m3]."""
        length = float(np.linalg.norm(self.ends[1] - self.ends[0]))
        return np.pi * self.radius**2 * (length + 4 / 3 * self.radius)


def capsules_around(triangles: np.ndarray) -> list[Capsule]:
    """Return up to MAX_CAPSULES capsules that hold all triangles (N, 3, 3) [m], sides POINT_SPACING_M at most."""
    parts = [(triangles, fit_capsule(triangles.reshape(-1, 3)))]
    while len(parts) < MAX_CAPSULES:
        best: tuple[float, int, list[tuple[np.ndarray, Capsule]]] | None = None
        for k, (part, whole) in enumerate(parts):
            for cuts in range(1, min(2, MAX_CAPSULES - len(parts)) + 1):
                pieces = [(s, fit_capsule(s.reshape(-1, 3))) for s in _best_cut(part, cuts)]
                saved = whole.volume - sum(c.volume for _, c in pieces)
                if pieces and saved > cuts * WORTH_A_CUT * whole.volume and (best is None or saved > best[0]):
                    best = saved, k, pieces
        if best is None:
            break
        parts[best[1] : best[1] + 1] = best[2]
    return [c for _, c in parts]


def _best_cut(triangles: np.ndarray, cuts: int) -> list[np.ndarray]:
    """Return the parts of least volume, cut across one of the two longest directions; none if that can't be done."""
    middles = triangles.mean(axis=1)
    _, _, directions = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)
    best, found = np.inf, list[np.ndarray]()
    for direction in directions[:2]:
        along = middles @ direction
        slices = np.searchsorted(np.linspace(along.min(), along.max(), CUTS + 2)[1:-1], along)
        corners = [_corners(triangles[slices == k].reshape(-1, 3)) for k in range(CUTS + 1)]
        for places in combinations(range(1, CUTS + 1), cuts):
            ends = [0, *places, CUTS + 1]
            sides = [np.concatenate(corners[a:b]) for a, b in pairwise(ends)]
            if min(len(s) for s in sides) < 4:
                continue
            volume = sum(_along_axis(s).volume for s in sides)
            if volume < best:
                part = np.searchsorted(places, slices, side="right")
                best, found = volume, [triangles[part == k] for k in range(cuts + 1)]
    return found


def _corners(points: np.ndarray) -> np.ndarray:
    """Return the points (N, 3) on the convex hull, all of them if they lie in a plane."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return points


def _along_axis(points: np.ndarray) -> Capsule:
    """Return the smallest capsule along one of the principal axes of points (N, 3)."""
    corners = _corners(points)  # the middle of a slice has many points, its ends few: axes are those of the corners
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    _, _, directions = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)
    return min((_capsule_on(corners, d, centre) for d in directions), key=lambda c: c.volume)


def fit_capsule(points: np.ndarray) -> Capsule:
    """Return the smallest capsule around points (N, 3) [m], by a search from the best of the principal axes."""
    corners = _corners(points)
    first = _along_axis(points)
    centre, axis = first.ends.mean(axis=0), first.ends[1] - first.ends[0]
    if np.linalg.norm(axis) < 1e-9:
        axis = np.array([0.0, 0.0, 1.0])
    axis = axis / np.linalg.norm(axis)
    across = np.linalg.svd(axis[None, :])[2][1:]

    def made(x: np.ndarray) -> Capsule:
        direction = axis + x[:2] @ across
        return _capsule_on(corners, direction / np.linalg.norm(direction), centre + x[2:4] @ across, abs(x[4]))

    size = first.radius
    start = np.vstack([np.zeros(5), np.diag([0.2, 0.2, 0.2 * size, 0.2 * size, 0.1 * size])])
    options: dict[str, Any] = {"initial_simplex": start, "maxiter": 600, "xatol": 1e-5, "fatol": 1e-9}
    found = minimize(lambda x: float(made(x).volume), np.zeros(5), method="Nelder-Mead", options=options)  # type: ignore[call-overload]
    return min(first, made(found.x), key=lambda c: c.volume)


def _capsule_on(points: np.ndarray, direction: np.ndarray, through: np.ndarray, wider: float = 0.0) -> Capsule:
    """Return the shortest capsule around points on a line, with the least radius and `wider` [m] more."""
    along = (points - through) @ direction
    square = np.maximum(((points - through) ** 2).sum(axis=1) - along**2, 0.0)
    radius = float(np.sqrt(square.max())) + wider
    reach = np.sqrt(np.maximum(radius**2 - square, 0.0))
    low, high = float((along + reach).min()), float((along - reach).max())
    if low > high:
        low = high = (low + high) / 2
    return Capsule(np.stack([through + low * direction, through + high * direction]), radius)


def add_shapes(path: Path, tables: dict[str, Any]) -> str | None:
    """Add shapes to the tables of a machine file from a URDF's collision geometry; return why there are none, or None.

    Raises MachineError as `read_robot` does.
    """
    robot = read_robot(path)
    tree = ElementTree.parse(path).getroot()
    links = {str(link.get("name")): link for link in tree.findall("link")}
    found: dict[int, list[np.ndarray]] = {}
    try:
        for name, at in _base_links(tree):
            found.setdefault(-1, []).extend(_surfaces(path, links[name], at))
        for k, attached in enumerate(robot.attached):
            for link, at in attached:
                found.setdefault(k, []).extend(_surfaces(path, links[link], at))
    except (OSError, ValueError, ImportError) as err:
        return f"shapes are left out: {' '.join(str(err).split())}"
    if not any(found.get(k) for k in range(len(robot.joints))):
        return "shapes are left out: the URDF has no collision geometry"
    for k, surfaces in found.items():
        if surfaces:
            shapes = [_shape_table(c) for c in capsules_around(np.concatenate(surfaces))]
            if k < 0:
                tables["world"] = {"shape": shapes}
            else:
                tables["body"][k]["shape"] = shapes
    return None


def things_around(path: Path, at: Sequence[float], unit: float = 1.0) -> dict[str, list[dict[str, Any]]]:
    """Return the [world] tables, `box` and `shape`, that hold what a mesh file shows of a robot's surroundings.

    at (3,) [m]: where the origin of the mesh is in the ground's frame. unit [m]: that of its lengths. Each connected
    part becomes a box along the axes, or capsules where they take less room. Raises UsageError for a file that is no
    mesh.
    """
    try:
        import trimesh

        mesh = trimesh.load(path, force="mesh")
        parts = mesh.split(only_watertight=False)
    except (OSError, ValueError, ImportError, AttributeError, NotImplementedError) as err:
        raise UsageError(f"{path}: cannot be read as a mesh: {' '.join(str(err).split())}") from None
    found: dict[str, list[dict[str, Any]]] = {"box": [], "shape": []}
    for part in parts:
        vertices = np.asarray(part.vertices) * unit + np.asarray(at, float)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        fine, faces = trimesh.remesh.subdivide_to_size(vertices, part.faces, POINT_SPACING_M, max_iter=20)
        capsules = capsules_around(np.asarray(fine)[faces])
        if np.prod(high - low) <= sum(c.volume for c in capsules):
            step = 10.0**-ROUND_DIGITS
            number = "" if not found["box"] else str(len(found["box"]) + 1)
            corners = [np.floor(low / step) * step, np.ceil(high / step) * step + step * (low == high)]
            lowest, highest = (np.round(x, ROUND_DIGITS).tolist() for x in corners)
            found["box"].append({"name": f"{_table_name(path)}{number}", "low": lowest, "high": highest})
        else:
            found["shape"] += [_shape_table(c) for c in capsules]
    if not parts:
        raise UsageError(f"{path}: holds no triangles")
    return found


def _table_name(path: Path) -> str:
    """Return a file's name as a name in a machine file."""
    name = "".join(c if c.isalnum() and c.isascii() else "_" for c in path.stem.lower())
    return name if name[:1].isalpha() else f"mesh_{name}"


def _shape_table(capsule: Capsule) -> dict[str, Any]:
    """Return the table of a shape, rounded so that it holds the capsule."""
    ends = [[round(float(x), ROUND_DIGITS) + 0.0 for x in end] for end in capsule.ends]
    step = 10.0**-ROUND_DIGITS
    radius = math.ceil((capsule.radius + step) / step) * step
    return {
        "radius": {"value": round(radius, ROUND_DIGITS), "source": "published"},
        "ends": ends[:1] if ends[0] == ends[1] else ends,
    }


def _base_links(tree: ElementTree.Element) -> list[tuple[str, np.ndarray]]:
    """Return the names of the links that stand still, with their placement (4, 4) in the root link's frame."""
    joints = tree.findall("joint")
    children = {_name(joint, "child") for joint in joints}
    waiting = [(str(link.get("name")), np.eye(4)) for link in tree.findall("link") if link.get("name") not in children]
    found = []
    while waiting:
        link, at = waiting.pop()
        found.append((link, at))
        waiting += [
            (_name(joint, "child"), at @ _origin(joint))
            for joint in joints
            if joint.get("type") == "fixed" and _name(joint, "parent") == link
        ]
    return found


def _name(joint: ElementTree.Element, key: str) -> str:
    end = joint.find(key)
    return "" if end is None else str(end.get("link"))


def _origin(element: ElementTree.Element) -> np.ndarray:
    """Return the placement (4, 4) of an element with an <origin>."""
    placement, origin = np.eye(4), element.find("origin")
    if origin is not None:
        xyz, rpy = ([float(x) for x in origin.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
        placement[:3, :3], placement[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return placement


def _surfaces(path: Path, link: ElementTree.Element, at: np.ndarray) -> list[np.ndarray]:
    """Return the triangles (N, 3, 3) of a link's collision geometry. Raises OSError, ValueError, ImportError."""
    found = []
    for element in link.findall("collision"):
        geometry = element.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        if shape is None:
            continue
        try:
            triangles = _mesh_triangles(path, shape) if shape.tag == "mesh" else _plain_triangles(shape)
        except ValueError as err:
            raise ValueError(f"link {link.get('name')}, collision geometry {shape.tag}: {err}") from None
        placed = at @ _origin(element)
        found.append(triangles @ placed[:3, :3].T + placed[:3, 3])
    return found


def _mesh_triangles(path: Path, shape: ElementTree.Element) -> np.ndarray:
    """Return the triangles (N, 3, 3) [m] of a mesh file. Raises OSError, ValueError, ImportError without trimesh."""
    name = str(shape.get("filename"))
    file = _mesh_file(path, name)
    try:
        import trimesh
    except ImportError:
        raise ImportError(f"the mesh {name} is read with trimesh: pip install 'excite[urdf]'") from None
    mesh = trimesh.load(file, force="mesh")
    mesh.apply_scale([float(x) for x in shape.get("scale", "1 1 1").split()])
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, POINT_SPACING_M, max_iter=20)
    return np.asarray(np.asarray(vertices)[faces])


def _plain_triangles(shape: ElementTree.Element) -> np.ndarray:
    """Return triangles (N, 3, 3) [m] around a box, cylinder or sphere. Raises ValueError."""
    if shape.tag == "box":
        size = [_length(x) for x in shape.get("size", "").split()]
        if len(size) != 3:
            raise ValueError(f"size must be three lengths (got {shape.get('size')!r})")
        half = np.array(size) / 2
        sides = []
        for axis, sign in product(range(3), (-1, 1)):
            corners = half[[(axis + 1) % 3, (axis + 2) % 3]]
            u, v = (np.linspace(-h, h, 2 + int(2 * h / POINT_SPACING_M)) for h in corners)
            points = np.stack([np.full((len(u), len(v)), sign * half[axis]), *np.meshgrid(u, v, indexing="ij")], -1)
            sides.append(_grid_triangles(np.roll(points, axis, axis=-1)))
        return np.concatenate(sides)
    if shape.tag not in ("cylinder", "sphere"):
        raise ValueError("is unknown, known are box, cylinder, sphere and mesh")
    radius = _length(shape.get("radius", ""))
    parts = max(16, 1 + int(2 * np.pi * radius / POINT_SPACING_M))
    turn = np.linspace(0, 2 * np.pi, parts + 1)
    if shape.tag == "sphere":
        tilt = np.linspace(0, np.pi, parts // 2 + 1)
        outline = np.stack([np.sin(tilt), np.cos(tilt)]) * radius / np.cos(np.pi / parts) ** 2
    else:
        half_length = _length(shape.get("length", "")) / 2
        across = np.linspace(0, radius, 2 + int(radius / POINT_SPACING_M)) / np.cos(np.pi / parts)
        along = np.linspace(half_length, -half_length, 2 + int(2 * half_length / POINT_SPACING_M))
        ends = np.full_like(across, half_length)
        r = np.concatenate([across, np.full_like(along, across[-1]), across[::-1]])
        outline = np.stack([r, np.concatenate([ends, along, -ends])])
    r, z = outline[:, :, None]
    return _grid_triangles(np.stack(np.broadcast_arrays(r * np.cos(turn), r * np.sin(turn), z), axis=-1))


def _grid_triangles(points: np.ndarray) -> np.ndarray:
    """Return the triangles (2 (M - 1) (N - 1), 3, 3) of a grid of points (M, N, 3)."""
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[:-1, 1:], points[1:, 1:]
    return np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in ((a, b, d), (a, d, c))])


def _length(text: str) -> float:
    """Return a positive length [m]. Raises ValueError."""
    value = float(text)
    if not 0 < value < math.inf:
        raise ValueError(f"a length must be > 0 (got {text})")
    return value


def _mesh_file(path: Path, name: str) -> Path:
    """Return the file of a mesh: beside the URDF, or of a package in a folder above it. Raises FileNotFoundError."""
    plain = Path(name.removeprefix("file://"))
    if name.startswith("package://"):
        inner = Path(name.removeprefix("package://"))
        tails = [inner, Path(*inner.parts[1:])]
        places = [folder / tail for folder in output.real(path).parents for tail in tails]
    else:
        places = [output.real(path).parent / plain]
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(f"the collision mesh {name} is not there")
