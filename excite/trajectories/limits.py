"""What the machine and the lane allow: every limit is a named expression between two bounds.

One plain function per kind of limit, in the table KINDS; each yields the limits of its kind that the machine file and
the problem state, or has bounds of its own. Their scale comes from their bounds: an excess is a fraction of the range,
high - low. A design, its check, comparisons and reports take every limit of the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion

# What counts as at rest at the ends (contract, R60): speeds [m/s], rates [rad/s] and positions [rad, m].
REST_SPEED, REST_RATE, REST_POSITION = 0.02, 0.01, 0.01
TOLERANCE = 1e-3  # of a limit's range: what the fresh simulation may exceed
TRAVEL, REVERSALS = "travel", "reversals"
TURNS = 361  # headings at which a drive is tried on the lane


@dataclass(frozen=True)
class Limit:
    """low <= expression(q, nu, u, du) <= high, one number per sample; low may be -inf.

    q, nu (n_q,) coordinates and velocities, u, du (n_u,) torques [N m] and their rates [N m/s]. kind: its key in KINDS.
    """

    name: str
    expression: ca.Function
    low: float
    high: float
    unit: str
    kind: str

    @property
    def range(self) -> float:
        """high - low; of a limit that has no lower bound, high."""
        return self.high - self.low if np.isfinite(self.low) else abs(self.high)

    @property
    def centre(self) -> float:
        """The middle of the range."""
        return self.high - self.range / 2


@dataclass(frozen=True)
class Symbols:
    """One sample: q, nu (n_q,), u, du (n_u,)."""

    q: ca.SX
    nu: ca.SX
    u: ca.SX
    du: ca.SX


Bounded = tuple[str, ca.SX, float, float, str]


@dataclass(frozen=True)
class Kind:
    """bounds(model, problem, symbols): the limits of a kind; `stated`: the places of a machine file that state them."""

    bounds: Callable[[Model, Problem, Symbols], Iterator[Bounded]]
    stated: tuple[str, ...] = ()


def _torque(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """What a motor or cylinder delivers, `torque` of a joint."""
    for k, body in enumerate(model.machine.actuated):
        if body.limit.torque is not None:
            high = float(body.limit.torque)
            yield f"torque {model.inputs[k]}", s.u[k], -high, high, "N m" if body.joint == "revolute" else "N"


def _torque_rate(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """How fast that changes, `torque_rate` of a joint."""
    for k, body in enumerate(model.machine.actuated):
        if body.limit.torque_rate is not None:
            high = float(body.limit.torque_rate)
            yield f"torque rate {model.inputs[k]}", s.du[k], -high, high, "N m/s" if body.joint == "revolute" else "N/s"


def _position(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """A joint's angle or stroke from its zero, `position` of a joint."""
    for body in model.machine.body:
        if body.limit.position is not None and body.coordinates[0] in model.coordinates:
            high = float(body.limit.position)
            k = model.coordinates.index(body.coordinates[0])
            yield f"position {body.where}", s.q[k], -high, high, "rad" if body.joint == "revolute" else "m"


def _rate(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """A joint's speed, `rate` of a joint."""
    for body in model.machine.body:
        if body.limit.rate is not None and body.coordinates[0] in model.coordinates:
            high = float(body.limit.rate)
            k = model.coordinates.index(body.coordinates[0])
            yield f"rate {body.where}", s.nu[k], -high, high, "rad/s" if body.joint == "revolute" else "m/s"


def _rim_speed(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """Radius times spin of a roll or wheel, `rim_speed` of its joint."""
    for body in model.machine.contacts:
        if body.limit.rim_speed is not None and body.contact is not None:
            high = float(body.limit.rim_speed)
            k = model.coordinates.index(body.coordinates[0])
            yield f"rim speed {body.where}", float(body.contact.radius) * s.nu[k], -high, high, "m/s"


def _slip(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """Both slips of a contact, `slip_limit`: beyond it the soil law is no longer linear."""
    slips = model.kinematics(s.q, s.nu)[1]
    bodies = {str(b.index): b for b in model.machine.contacts}
    for k, name in enumerate(model.slips):
        body = bodies[name[2:]]
        if body.contact is not None and body.contact.slip_limit is not None:
            high = float(body.contact.slip_limit)
            yield f"slip {name[:2]} {body.where}", slips[k], -high, high, "-"


def _power(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """The hydraulics' power, sum of |u_i q_i'|, `power_limit` of the machine.

    |x| as sqrt(x^2 + e^2), e = 1/1000 of the limit: never less, and at the limit no more.
    """
    if model.machine.power_limit is not None:
        high = float(model.machine.power_limit)
        parts = [ca.sqrt((s.u[k] * s.nu[row]) ** 2 + (1e-3 * high) ** 2) for k, row in enumerate(model.actuated)]
        yield "power", sum(parts, ca.SX(0)), -np.inf, high, "W"


def _lane(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """Points of the machine that stay inside the lane's length and width, `lane_m` of the problem."""
    if not model.machine.planar:
        return
    places = model.kinematics(s.q, s.nu)[3]
    bodies = [b.index for b in model.machine.body]
    for index in problem.lane_points:
        point = places[:, bodies.index(index)]
        for axis, letter in enumerate("xy"):
            if any(ca.which_depends(point[axis], s.q, 1, False)):
                high = problem.lane_m[axis] / 2
                yield f"lane {letter} {model.machine.find(index).where}", point[axis], -high, high, "m"


def _polygon(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """The same points inside a convex area, `lane_polygon_m` of the problem.

    Every edge: the distance across the area, from the corner that is farthest to the edge itself.
    """
    if not model.machine.planar:
        return
    places = model.kinematics(s.q, s.nu)[3]
    bodies = [b.index for b in model.machine.body]
    for k, (outward, low, high) in enumerate(edges(problem.lane_polygon_m), 1):
        for index in problem.lane_points:
            point = places[:, bodies.index(index)]
            across = outward[0] * point[0] + outward[1] * point[1]
            yield f"lane edge {k} {model.machine.find(index).where}", across, low, high, "m"


def _travel(model: Model, problem: Problem, s: Symbols) -> Iterator[Bounded]:
    """The forward speed of a problem that counts reversals; the program narrows it to one direction at a time."""
    if problem.reversals is not None and model.machine.planar:
        fast = [float(b.limit.rim_speed) for b in model.machine.contacts if b.limit.rim_speed is not None]
        high = 1.2 * max(fast, default=10.0)  # slip included
        yield TRAVEL, s.nu[0], -high, high, "m/s"


def edges(corners: Sequence[tuple[float, float]]) -> list[tuple[np.ndarray, float, float]]:
    """Outward normal (2,), and distance of the farthest corner and of the edge along it [m], of a convex area."""
    P = np.array(corners, float).reshape(-1, 2)
    found = []
    for a, b in zip(P, np.roll(P, -1, axis=0), strict=True):
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        if normal @ (P.mean(axis=0) - a) > 0:
            normal = -normal
        found.append((normal, float((P @ normal).min()), float(a @ normal)))
    return found


KINDS: dict[str, Kind] = {
    "torque": Kind(_torque, ("body.limit.torque",)),
    "torque_rate": Kind(_torque_rate, ("body.limit.torque_rate",)),
    "position": Kind(_position, ("body.limit.position",)),
    "rate": Kind(_rate, ("body.limit.rate",)),
    "rim_speed": Kind(_rim_speed, ("body.limit.rim_speed",)),
    "slip": Kind(_slip, ("body.contact.slip_limit",)),
    "power": Kind(_power, ("power_limit",)),
    "lane": Kind(_lane, ("problems.lane_m", "problems.lane_polygon_m")),
    "polygon": Kind(_polygon),
    "travel": Kind(_travel),
}


def symbols(model: Model) -> Symbols:
    n_q, n_u = len(model.coordinates), len(model.inputs)
    return Symbols(ca.SX.sym("q", n_q), ca.SX.sym("nu", n_q), ca.SX.sym("u", n_u), ca.SX.sym("du", n_u))


def machine_limits(model: Model, problem: Problem) -> tuple[Limit, ...]:
    """Every limit that the machine and the problem state, in the order of KINDS."""
    s = symbols(model)
    sample, names = [s.q, s.nu, s.u, s.du], ["q", "nu", "u", "du"]
    return tuple(
        Limit(name, ca.Function("limit", sample, [e], names, ["g"]), low, high, unit, kind)
        for kind, stated in KINDS.items()
        for name, e, low, high, unit in stated.bounds(model, problem, s)
    )


def stacked(model: Model, every: Sequence[Limit]) -> ca.Function:
    """(q, nu, u, du) -> the values of several limits, one under the other."""
    s = symbols(model)
    sample = [s.q, s.nu, s.u, s.du]
    return ca.Function("limits", sample, [ca.vertcat(*[g.expression(*sample) for g in every])])


def of_lane(name: str) -> bool:
    """Whether a limit of that name depends on where the machine stands on the ground: its name begins with `lane`."""
    return name.startswith("lane")


def of_rest(name: str) -> bool:
    """Whether a limit of that name is about rest at both ends."""
    return name.startswith("rest")


def free(name: str) -> bool:
    """Whether a limit of that name leaves the motion between free: the lane, on which a drive can still be placed, and
    rest at its ends."""
    return of_lane(name) or of_rest(name)


def kept_between(excess: Mapping[str, float]) -> bool:
    """Whether every limit but the free ones is kept, by name the excess that `check` finds."""
    return all(v == 0 for name, v in excess.items() if not free(name))


def lane_excess(excess: Mapping[str, float]) -> float:
    """The largest excess over any limit of the lane, 0 where there is none."""
    return max((v for name, v in excess.items() if of_lane(name)), default=0.0)


def resting(model: Model) -> tuple[int, ...]:
    """Coordinates that are zero at both ends: those with a position limit or whose value the forces depend on."""
    limited = {
        body.coordinates[0]
        for body in model.machine.body
        if body.coordinates and (body.limit.position is not None or body.coordinates[0] in model.active_coordinates)
    }
    return tuple(k for k, c in enumerate(model.coordinates) if c in limited)


def rest_tolerances(model: Model) -> np.ndarray:
    """(n_q,) what counts as standing still: 0.02 m/s (of a contact, at its rim), 0.01 rad/s."""
    tolerance = np.empty(len(model.coordinates))
    for body in model.machine.body:
        for c in body.coordinates:
            if c not in model.coordinates:
                continue
            k = model.coordinates.index(c)
            straight = body.joint == "prismatic" or (body.joint == "planar" and not c.startswith("theta"))
            tolerance[k] = REST_SPEED if straight else REST_RATE
            if body.contact is not None:
                tolerance[k] = REST_SPEED / float(body.contact.radius)
    return tolerance


def check_limits(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """By name, the largest excess of every limit over the motion's samples, as a fraction of the limit's range.

    0 where it is kept. Rest at the ends counts as a limit whose range is its tolerance.
    """
    every = machine_limits(model, problem)
    du = np.diff(motion.u, axis=0) / np.diff(motion.t)[:, None]
    du = np.vstack([du, du[-1:]])
    values = stacked(model, every)(motion.q.T, motion.nu.T, motion.u.T, du.T).full()
    excess = {
        g.name: max(0.0, float(v.max() - g.high), float(g.low - v.min())) / g.range
        for g, v in zip(every, values, strict=True)
    }
    for whole in WHOLE.values():
        excess |= whole(model, problem, motion)
    return excess


def _rest(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """At both ends the machine stands still and what steers is centred, `rest` of the problem."""
    if not problem.rest:
        return {}
    tolerance = rest_tolerances(model)
    still = {
        f"rest {c}'": max(0.0, float(np.abs(motion.nu[[0, -1], k]).max() / tolerance[k]) - 1)
        for k, c in enumerate(model.coordinates)
    }
    centred = {
        f"rest {model.coordinates[k]}": max(0.0, float(np.abs(motion.q[[0, -1], k]).max() / REST_POSITION) - 1)
        for k in resting(model)
    }
    return still | centred


def _reversals(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """At most so many changes of the direction of travel, `reversals` of the problem."""
    if problem.reversals is None or not model.machine.planar:
        return {}
    return {REVERSALS: max(0.0, (reversals(motion) - problem.reversals) / max(1, problem.reversals))}


def reversals(motion: Motion) -> int:
    """How often a machine changes its direction of travel; what counts as at rest is no direction."""
    going = np.sign(motion.nu[np.abs(motion.nu[:, 0]) > REST_SPEED, 0])
    return int((np.diff(going) != 0).sum())


# Limits on a motion as a whole: excess by name, of the model, the problem and the motion.
WHOLE: dict[str, Callable[[Model, Problem, Motion], dict[str, float]]] = {"rest": _rest, "reversals": _reversals}


def directions(motion: Motion, most: int) -> np.ndarray:
    """(N,) +-1: the direction of travel at every sample, with at most so many reversals, that fits a motion best.

    Best: the least distance is driven the other way. By dynamic programming over the runs of one direction.
    """
    v = motion.nu[:, 0]
    cuts = np.concatenate([[0], np.flatnonzero(np.diff(np.sign(v)) != 0) + 1, [len(v)]])
    driven = np.add.reduceat(v, cuts[:-1])
    gain = np.full((len(driven), most + 1, 2), -np.inf)
    came = np.zeros((len(driven), most + 1, 2), int)  # direction of the run before
    signs = np.array([1.0, -1.0])
    gain[0, 0] = signs * driven[0]
    for k in range(1, len(driven)):
        for r in range(most + 1):
            for d in range(2):
                stay = gain[k - 1, r, d]
                turn = gain[k - 1, r - 1, 1 - d] if r else -np.inf
                came[k, r, d] = d if stay >= turn else 1 - d
                gain[k, r, d] = max(stay, turn) + signs[d] * driven[k]
    r, d = (int(i) for i in np.unravel_index(int(np.argmax(gain[-1])), gain[-1].shape))
    found = np.empty(len(v))
    for k in range(len(driven) - 1, -1, -1):
        found[cuts[k] : cuts[k + 1]] = signs[d]
        before = int(came[k, r, d])
        r, d = (r - 1 if before != d else r), before
    return found


def placed(model: Model, problem: Problem, motion: Motion) -> np.ndarray:
    """Start coordinates (n_q,) that put the drive into the lane area as well as turning and shifting it can."""
    start = motion.q[0].copy()
    if not model.machine.planar or not problem.lane_points:
        return start
    axes = {c: model.coordinates.index(c) for c in model.machine.body[0].coordinates if c in model.coordinates}
    x, y, heading = model.machine.body[0].coordinates
    places = model.kinematics(motion.q.T, motion.nu.T)[3].full().reshape(3, len(motion.t), -1)
    bodies = [b.index for b in model.machine.body]
    path = places[:2][:, :, [bodies.index(i) for i in problem.lane_points]].reshape(2, -1)
    fit = _fit_polygon if problem.lane_polygon_m else _fit_box
    best, chosen = np.inf, (0.0, np.zeros(2))
    whole = 2 * np.pi if problem.lane_polygon_m else np.pi  # a box is the same upside down
    for turn in np.linspace(0, whole, TURNS)[:-1] if heading in axes else (0.0,):
        c, s = np.cos(turn), np.sin(turn)
        used, shift = fit(problem, np.array([[c, -s], [s, c]]) @ path)
        if used < best - 1e-9:
            best, chosen = used, (float(turn), shift)
    turn, shift = chosen
    at = np.array([start[axes[c]] if c in axes else 0.0 for c in (x, y)])
    c, s = np.cos(turn), np.sin(turn)
    moved = np.array([[c, -s], [s, c]]) @ at + shift
    for k, name in enumerate((x, y)):
        if name in axes:
            start[axes[name]] = moved[k]
    if heading in axes:
        start[axes[heading]] += turn
    return start


def _fit_box(problem: Problem, path: np.ndarray) -> tuple[float, np.ndarray]:
    """The share of the lane's length or width that a path (2, K) needs, and the shift that centres it."""
    low, high = path.min(axis=1), path.max(axis=1)
    return float(((high - low) / np.array(problem.lane_m)).max()), -(low + high) / 2


def _fit_polygon(problem: Problem, path: np.ndarray) -> tuple[float, np.ndarray]:
    """The same for the edges of box and polygon: the shift that leaves the largest excess least, a linear program."""
    length, width = problem.lane_m
    box = [(length / 2, width / 2), (-length / 2, width / 2), (-length / 2, -width / 2), (length / 2, -width / 2)]
    sides = edges(box) + edges(problem.lane_polygon_m)
    rows = [[*outward / (high - low), -1.0] for outward, low, high in sides]
    most = [(high - float((outward @ path).max())) / (high - low) for outward, low, high in sides]
    found = scipy.optimize.linprog([0, 0, 1], A_ub=rows, b_ub=most, bounds=[(None, None)] * 3)
    shift = np.asarray(found.x)
    return float(shift[2]), shift[:2]
