"""Distances between the links of an arm and of what stands around it, as limits of its motions.

Shapes are capsules: all points within a radius of a segment. Two shapes keep a margin while the distance D of their
segments is at least R, the sum of radii and margin; the limit is 2 - D/R <= 1, linear in the distance. Shapes of two
bodies make one limit, that of the nearest pair. Pairs that touch in nearly every pose are left out: they are neighbours
at a joint. Without shapes the origins of the joints and the tool stay above the floor.

Source: Ericson, "Real-Time Collision Detection", 2005, section 5.1.9 (closest points of segments).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.model import Model
from excite.model.machine import Machine
from excite.model.mechanics import body_motions

POSES = 2000  # random poses in which pairs are looked at; finds one in a thousand with 86 % probability
ALWAYS = 0.9  # share of poses in which a pair touches that is left out; MoveIt's setup assistant takes 0.95
ROUNDING_M = 1e-4  # distance below which the distance of two segments is rounded, so that it has a slope where they cut
PARALLEL = 1e-6  # sin^2 of the angle of two segments below which they count as parallel
HALVINGS = 12  # of a segment, in the search of its point next to a box: 0.4 % of its length
GROUND, FLOOR = "ground", "floor"


@dataclass(frozen=True)
class Piece:
    """A shape by its owner's name: ends (1 or 2) of its segment in the axes of the ground, radius [m]."""

    owner: str
    ends: tuple[ca.SX, ...]
    radius: float


@dataclass(frozen=True)
class Pair:
    """Two things with the distance [m] of their segments or surfaces, and the least one that keeps the margin."""

    names: tuple[str, str]
    distance: ca.SX
    least: float

    @property
    def nearness(self) -> ca.SX:
        """1 at the margin, 2 where segments cut."""
        return 2 - self.distance / self.least


def has_shapes(machine: Machine) -> bool:
    """Return True if some body has a shape, so that collisions can be looked at."""
    return any(body.shape for body in machine.body)


def clearance_limits(model: Model, q: ca.SX) -> Iterator[tuple[str, ca.SX, float, float, str]]:
    """Yield the limits on the distances of each two things at coordinates q (n_q,)."""
    every = pairs(model, q)
    kept = kept_pairs(model)
    together: dict[tuple[str, str], list[ca.SX]] = {}
    for k in kept:
        together.setdefault(every[k].names, []).append(every[k].nearness)
    for (one, other), values in together.items():
        nearest = values[0]
        for value in values[1:]:
            nearest = ca.fmax(nearest, value)
        yield f"clearance {one} {other}", nearest, -np.inf, 1.0, "-"


def pairs_left_out(model: Model) -> tuple[tuple[str, str], ...]:
    """Return the names of bodies that touch in nearly every pose, whose distance is therefore no limit."""
    q = ca.SX.sym("q", len(model.coordinates))
    every = pairs(model, q)
    kept = {every[k].names for k in kept_pairs(model)}
    return tuple(dict.fromkeys(p.names for p in every if p.names not in kept and _moves(p, q)))


def pairs(model: Model, q: ca.SX) -> list[Pair]:
    """Return all pairs of shapes of different bodies, and of shapes with floor, planes and boxes, but those `apart`."""
    machine, world = model.machine, model.machine.world
    margin = float(world.margin)
    pieces = _pieces(machine, model.true_coordinates(q, model.nominal))
    found = []
    for k, a in enumerate(pieces if has_shapes(machine) else ()):
        for b in pieces[k + 1 :]:
            if a.owner != b.owner:
                found.append(Pair((a.owner, b.owner), segment_distance(a.ends, b.ends), a.radius + b.radius + margin))
    planes = [(p.name, np.array(p.normal), float(p.distance)) for p in world.plane]
    if world.floor != "none":
        planes.append((FLOOR, np.array([0.0, 0.0, 1.0]), float(world.floor)))
    for a in (p for p in pieces if p.owner != GROUND):
        for name, normal, distance in planes:
            along = [ca.dot(ca.DM(normal / np.linalg.norm(normal)), end) - distance for end in a.ends]
            found.append(Pair((a.owner, name), along[0] if len(along) == 1 else ca.fmin(*along), a.radius + margin))
        for box in world.box:
            found.append(
                Pair(
                    (a.owner, box.name), box_distance(a.ends, np.array(box.low), np.array(box.high)), a.radius + margin
                )
            )
    apart = {frozenset(p) for p in world.apart}
    return [p for p in found if frozenset(p.names) not in apart]


def placed_shapes(model: Model, q: ca.SX) -> list[Piece]:
    """Return the shapes on ground and bodies at coordinates q (n_q,), without shapes the joints' origins as points."""
    return _pieces(model.machine, model.true_coordinates(q, model.nominal))


def _pieces(machine: Machine, q: ca.SX) -> list[Piece]:
    """Return the shapes on ground and bodies; without shapes, origins of joints and the tool as points."""
    frames = body_frames(machine, q)
    if not has_shapes(machine):
        points = [Piece(body.name, (frames[body.index][1],), 0.0) for body in machine.body if body.coordinates]
        if machine.tool is not None:
            points.append(Piece("tool", (tool_point(machine, q),), 0.0))
        return points
    pieces = [
        Piece(GROUND, tuple(ca.SX(np.array(end)) for end in shape.ends), float(shape.radius))
        for shape in machine.world.shape
    ]
    for body in machine.body:
        R, P = frames[body.index]
        for shape in body.shape:
            ends = tuple(P + R @ ca.SX(np.array(end)) for end in shape.ends)
            pieces.append(Piece(body.name, ends, float(shape.radius)))
    return pieces


def body_frames(machine: Machine, q: ca.SX) -> dict[int, tuple[ca.SX, ca.SX]]:
    """Return rotation (3, 3) and position (3,) [m] of every body in the axes of the ground, of coordinates q (n_q,)."""
    names = [c for body in machine.body for c in body.coordinates]
    still = dict.fromkeys(names, ca.SX(0))
    at = still | {b.coordinates[0]: machine.joint_values(b, q) for b in machine.body if machine.is_free(b)}
    frames = body_motions(machine, at, still, still, ca.SX(3, 1))
    return {k: (f.rotation, f.position) for k, f in frames.items()}


def tool_point(machine: Machine, q: ca.SX) -> ca.SX:
    """Return the place (3,) [m] of the tool's point, by default the last body's origin, in the axes of the ground."""
    body = machine.body[-1].index if machine.tool is None else machine.tool.body
    R, P = body_frames(machine, q)[body]
    return P if machine.tool is None else P + R @ ca.SX(np.array(machine.tool.point))


def segment_distance(one: tuple[ca.SX, ...], other: tuple[ca.SX, ...]) -> ca.SX:
    """Return the distance [m] of two segments, each of one or two ends (3,)."""
    p, d = one[0], one[-1] - one[0]
    r, e = other[0], other[-1] - other[0]
    if len(one) == 1 and len(other) == 1:
        return _length(p - r)
    if len(one) == 1:
        return _length(p - r - e * _clipped(ca.dot(e, p - r) / ca.sumsqr(e)))
    if len(other) == 1:
        return _length(p - r + d * _clipped(-ca.dot(d, p - r) / ca.sumsqr(d)))
    w = p - r
    a, b, c = ca.sumsqr(d), ca.dot(d, e), ca.sumsqr(e)
    s = _clipped((b * ca.dot(e, w) - c * ca.dot(d, w)) / (a * c - b * b + PARALLEL * a * c))
    t = _clipped((b * s + ca.dot(e, w)) / c)
    s = _clipped((b * t - ca.dot(d, w)) / a)
    return _length(w + d * s - e * t)


def box_distance(ends: tuple[ca.SX, ...], low: np.ndarray, high: np.ndarray) -> ca.SX:
    """Return the distance [m] of a segment from a box, negative inside of it.

    The distance of a point is convex along a segment: bisection by its slope finds the nearest point.
    """
    centre, half = ca.SX((low + high) / 2), ca.SX((high - low) / 2)
    x = ca.SX.sym("x", 3)
    beyond = ca.fabs(x - centre) - half
    inside = ca.fmin(ca.mmax(beyond), 0)
    point = ca.Function("point", [x], [_length(ca.fmax(beyond, 0)) - ROUNDING_M + inside])
    if len(ends) == 1:
        return point(ends[0])
    along = ends[1] - ends[0]
    slope = ca.Function("slope", [x], [ca.gradient(point(x), x)])
    s = ca.SX(0.5)
    for k in range(HALVINGS):
        s = s - 0.25 * 0.5**k * ca.sign(ca.dot(slope(ends[0] + s * along), along))
    return ca.fmin(point(ends[0] + s * along), ca.fmin(point(ends[0]), point(ends[1])))


def _length(v: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(v) + ROUNDING_M**2)


def _clipped(share: ca.SX) -> ca.SX:
    return ca.fmin(ca.fmax(share, 0), 1)


def _moves(pair: Pair, q: ca.SX) -> bool:
    return any(ca.which_depends(pair.distance, q, 1, False))


@lru_cache(maxsize=8)
def kept_pairs(model: Model) -> tuple[int, ...]:
    """Return the numbers of the pairs whose distance changes, and that don't touch in nearly every pose."""
    q = ca.SX.sym("q", len(model.coordinates))
    every = pairs(model, q)
    if not every:
        return ()
    near = ca.Function("near", [q], [ca.vertcat(*[p.nearness for p in every])], {"cse": True})
    touching = (near(random_poses(model, POSES).T).full() > 1).mean(axis=1)
    return tuple(k for k, p in enumerate(every) if touching[k] <= ALWAYS and _moves(p, q))


def random_poses(model: Model, count: int, seed: int = 0) -> np.ndarray:
    """Return random coordinates (count, n_q) within the ranges of the joints, a turn where there is none."""
    low, high = drive_ranges(model)
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


def drive_ranges(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest coordinates (n_q,) [rad, m] of a drive; half a turn either way without a limit."""
    low, high = (np.full(len(model.coordinates), end) for end in (-np.inf, np.inf))
    for body in model.machine.body:
        ends = body.limit.drive_range
        if ends is not None and model.machine.is_free(body):
            k = model.coordinates.index(model.machine.coordinate(body))
            a, b = sorted(x / model.machine.ratio(body) for x in ends)
            low[k], high[k] = max(low[k], a), min(high[k], b)
    return np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)
