"""Limits of the machine and the lane: every limit is a named expression between two bounds.

LIMITS holds one pure function per kind. Each yields the limits of its kind that the machine file and the problem state.
MOTION_LIMITS holds limits on a whole motion. An excess is a fraction of the limit's range, high - low.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, motion_along
from excite.text import format_number
from excite.trajectories.clearance import clearance_limits, drive_ranges, tool_point

REST_SPEED = 0.02  # m/s, speed that counts as rest at the ends; problem R60
REST_RATE = 0.01  # rad/s, the same for rates of rotation; problem R60
REST_POSITION = 0.01  # rad or m, position that counts as centred at the ends; problem R60
TOLERANCE = 1e-3  # share of a limit's range that the fresh simulation may exceed; problem R60
TRAVEL_LIMIT = "travel"
REVERSALS_LIMIT = "reversals"
DURATION_LIMIT = "duration"
TOP_SPEED_FACTOR = 1.2  # top speed over rim speed, with slip; chosen
DEFAULT_TOP_SPEED = 10.0  # m/s, without a limit on rim speed; chosen
SLIP_ROUNDING = 0.05  # of the slip limit: what it shows without slip, as a share of the limit; chosen
POWER_SMOOTHING = 1e-3  # of the power limit: rounding of |u q'|; chosen
LIGHTEN = "raise torque under [body.limit], or check masses, centres of mass and gravity in the machine file"
TOOL_ROUNDING = 0.05  # of the limit on the tool's speed: what it shows at rest, as a share of the limit


@dataclass(frozen=True)
class Limit:
    """low <= expression(q, nu, u, du) <= high at every sample; low may be -inf.

    q, nu (n_q,): coordinates and velocities. u, du (n_u,): torques [N m] and their rates [N m/s]. kind: key in LIMITS.
    """

    name: str
    expression: ca.Function
    low: float
    high: float
    unit: str
    kind: str

    @property
    def range(self) -> float:
        """high - low, or |high| without a lower bound."""
        return self.high - self.low if np.isfinite(self.low) else abs(self.high)

    @property
    def centre(self) -> float:
        """Middle of the range."""
        return self.high - self.range / 2


@dataclass(frozen=True)
class SampleSymbols:
    """CasADi symbols of one sample: q, nu (n_q,), u, du (n_u,)."""

    q: ca.SX
    nu: ca.SX
    u: ca.SX
    du: ca.SX


BoundedExpression = tuple[str, ca.SX, float, float, str]


@dataclass(frozen=True)
class LimitKind:
    """bounds(model, problem, symbols) yields the limits of a kind; stated: where a machine file states them."""

    bounds: Callable[[Model, Problem, SampleSymbols], Iterator[BoundedExpression]]
    stated: tuple[str, ...] = ()


def _torque(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Torque or force of a motor or cylinder, `torque` of a joint."""
    for k, body in enumerate(model.machine.actuated):
        if body.limit.torque is not None:
            high = float(body.limit.torque)
            yield f"torque {model.inputs[k]}", s.u[k], -high, high, "N m" if body.joint == "revolute" else "N"


def _torque_rate(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Rate of that torque or force, `torque_rate` of a joint."""
    for k, body in enumerate(model.machine.actuated):
        if body.limit.torque_rate is not None:
            high = float(body.limit.torque_rate)
            yield f"torque rate {model.inputs[k]}", s.du[k], -high, high, "N m/s" if body.joint == "revolute" else "N/s"


def _position(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """A joint's angle or stroke, `position` of a joint, or `position_low` and `position_high`."""
    for body in model.machine.body:
        if body.limit.drive_range is not None and model.machine.is_free(body):
            low, high = body.limit.drive_range
            angle = model.machine.joint_positions(body, s.q)
            yield f"position {body.where}", angle, low, high, "rad" if body.joint == "revolute" else "m"


def _rate(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """A joint's speed, `rate` of a joint."""
    for body in model.machine.body:
        if body.limit.rate is not None and model.machine.is_free(body):
            high, rate = float(body.limit.rate), model.machine.joint_values(body, s.nu)
            yield f"rate {body.where}", rate, -high, high, "rad/s" if body.joint == "revolute" else "m/s"


def _rim_speed(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Radius times spin of a roll or wheel, `rim_speed` of its joint."""
    for body in model.machine.contacts:
        if body.limit.rim_speed is not None and body.contact is not None:
            high = float(body.limit.rim_speed)
            rim = float(body.contact.radius) * model.machine.joint_values(body, s.nu)
            yield f"rim speed {body.where}", rim, -high, high, "m/s"


def _slip(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Resultant slip at both edges of a contact, `slip_limit`: the range in which the soil law is linear.

    |g| is replaced by sqrt((1 - r^2) |g|^2 + r^2 limit^2), r = SLIP_ROUNDING: smooth at rest, exact at the limit.
    """
    slips = model.edge_slips(model.true_coordinates(s.q, model.nominal), s.nu)
    for k, (index, edge) in enumerate(model.edges):
        body = model.machine.find(index)
        if body.contact is not None and body.contact.slip_limit is not None:
            high = float(body.contact.slip_limit)
            square = (1 - SLIP_ROUNDING**2) * ca.sumsqr(slips[:, k]) + (SLIP_ROUNDING * high) ** 2
            yield f"slip {body.where} {edge}".rstrip(), ca.sqrt(square), -np.inf, high, "-"


def _power(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Hydraulic power, sum of |u_i q_i'|, `power_limit` of the machine.

    |x| is replaced by sqrt(x^2 + e^2) with e = limit / 1000, which is never smaller.
    """
    if model.machine.power_limit is not None:
        high = float(model.machine.power_limit)
        rounding = (POWER_SMOOTHING * high) ** 2
        speeds = ca.vertsplit(ca.sparsify(ca.DM(model.machine.input_matrix.T)) @ s.nu)
        parts = [ca.sqrt((s.u[k] * speed) ** 2 + rounding) for k, speed in enumerate(speeds)]
        yield "power", sum(parts, ca.SX(0)), -np.inf, high, "W"


def _lane(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Points of the machine that stay inside the lane's length and width, `lane_m` of the problem."""
    if not model.machine.planar:
        return
    places = model.kinematics(model.true_coordinates(s.q, model.nominal), s.nu)[3]
    bodies = [b.index for b in model.machine.body]
    for index in problem.lane_points:
        point = places[:, bodies.index(index)]
        for axis, letter in enumerate("xy"):
            if any(ca.which_depends(point[axis], s.q, 1, False)):
                high = problem.lane[axis] / 2
                yield f"lane {letter} {model.machine.find(index).where}", point[axis], -high, high, "m"


def _polygon(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Points of the machine that stay inside a convex area, `lane_polygon_m` of the problem.

    One limit per edge: the distance along its normal, from the farthest corner to the edge.
    """
    if not model.machine.planar:
        return
    places = model.kinematics(model.true_coordinates(s.q, model.nominal), s.nu)[3]
    bodies = [b.index for b in model.machine.body]
    for k, (outward, low, high) in enumerate(polygon_edges(problem.lane_polygon_m), 1):
        for index in problem.lane_points:
            point = places[:, bodies.index(index)]
            across = outward[0] * point[0] + outward[1] * point[1]
            yield f"lane edge {k} {model.machine.find(index).where}", across, low, high, "m"


def _travel(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """The forward speed of a problem that counts reversals; the program restricts it to one direction at a time."""
    if problem.reversals is not None and model.machine.planar:
        fast = [float(b.limit.rim_speed) for b in model.machine.contacts if b.limit.rim_speed is not None]
        high = TOP_SPEED_FACTOR * max(fast, default=DEFAULT_TOP_SPEED)
        yield TRAVEL_LIMIT, s.nu[0], -high, high, "m/s"


def _clearance(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Distances of an arm's links from each other, the floor and what stands around, `shape` of bodies and `world`."""
    if model.follows_positions:
        yield from clearance_limits(model, s.q)


def _tool(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    """Place and speed of the tool's point, `tool` of the machine.

    |v| is replaced as the slip is: smooth at rest, exact at the limit.
    """
    tool = model.machine.tool
    if tool is None:
        return
    place = tool_point(model.machine, model.true_coordinates(s.q, model.nominal))
    if tool.low is not None and tool.high is not None:
        for axis, letter in enumerate("xyz"):
            yield f"tool {letter}", place[axis], tool.low[axis], tool.high[axis], "m"
    if tool.speed is not None:
        high = float(tool.speed)
        square = (1 - TOOL_ROUNDING**2) * ca.sumsqr(ca.jtimes(place, s.q, s.nu)) + (TOOL_ROUNDING * high) ** 2
        yield "tool speed", ca.sqrt(square), -np.inf, high, "m/s"


def polygon_edges(corners: Sequence[tuple[float, float]]) -> list[tuple[np.ndarray, float, float]]:
    """Return the edges of a convex area as (outward normal (2,), low, high).

    low, high [m]: distances of the farthest corner and of the edge along the normal.
    """
    P = np.array(corners, float).reshape(-1, 2)
    found = []
    for a, b in zip(P, np.roll(P, -1, axis=0), strict=True):
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        if normal @ (P.mean(axis=0) - a) > 0:
            normal = -normal
        found.append((normal, float((P @ normal).min()), float(a @ normal)))
    return found


LIMITS: dict[str, LimitKind] = {
    "torque": LimitKind(_torque, ("body.limit.torque",)),
    "torque_rate": LimitKind(_torque_rate, ("body.limit.torque_rate",)),
    "position": LimitKind(
        _position,
        (
            "body.limit.position",
            "body.limit.position_low",
            "body.limit.position_high",
            "body.limit.position_margin",
        ),
    ),
    "rate": LimitKind(_rate, ("body.limit.rate",)),
    "rim_speed": LimitKind(_rim_speed, ("body.limit.rim_speed",)),
    "slip": LimitKind(_slip, ("body.contact.slip_limit",)),
    "power": LimitKind(_power, ("power_limit",)),
    "lane": LimitKind(_lane, ("problems.lane_m", "problems.lane_polygon_m")),
    "polygon": LimitKind(_polygon),
    "travel": LimitKind(_travel),
    "clearance": LimitKind(_clearance, ("body.shape", "world")),
    "tool": LimitKind(_tool, ("tool.low", "tool.high", "tool.speed")),
}


def sample_symbols(model: Model) -> SampleSymbols:
    """Create the CasADi symbols of one sample."""
    n_q, n_u = len(model.coordinates), len(model.inputs)
    return SampleSymbols(ca.SX.sym("q", n_q), ca.SX.sym("nu", n_q), ca.SX.sym("u", n_u), ca.SX.sym("du", n_u))


def machine_limits(model: Model, problem: Problem) -> tuple[Limit, ...]:
    """Return every limit that the machine and the problem state, in the order of LIMITS."""
    return _stated(model, problem, tuple(LIMITS.items()))


@lru_cache(maxsize=8)
def _stated(model: Model, problem: Problem, kinds: tuple[tuple[str, LimitKind], ...]) -> tuple[Limit, ...]:
    s = sample_symbols(model)
    sample, names = [s.q, s.nu, s.u, s.du], ["q", "nu", "u", "du"]
    return tuple(
        Limit(name, ca.Function("limit", sample, [e], names, ["g"]), low, high, unit, kind)
        for kind, stated in kinds
        for name, e, low, high, unit in stated.bounds(model, problem, s)
    )


def planned_limits(model: Model) -> tuple[Limit, ...]:
    """Return the limits on acceleration and jerk of a planned motion, of joints that state them.

    Their expressions are functions of (a, jerk), each (n_q,). A simulated motion has none: friction that turns makes
    its acceleration jump.
    """
    n_q = len(model.coordinates)
    a, jerk = ca.SX.sym("a", n_q), ca.SX.sym("jerk", n_q)
    found = []
    for name, x, unit in (("acceleration", a, "s2"), ("jerk", jerk, "s3")):
        for body in model.machine.body:
            most = getattr(body.limit, name)
            if most is not None and model.machine.is_free(body):
                value = ca.Function("limit", [a, jerk], [model.machine.joint_values(body, x)])
                of = f"{'rad' if body.joint == 'revolute' else 'm'}/{unit}"
                found.append(Limit(f"{name} {body.where}", value, -float(most), float(most), of, name))
    return tuple(found)


def stack_planned(model: Model, limits: Sequence[Limit]) -> ca.Function:
    """Return the function (a, jerk) -> values (n_limits,) of `planned_limits`."""
    n_q = len(model.coordinates)
    a, jerk = ca.SX.sym("a", n_q), ca.SX.sym("jerk", n_q)
    return ca.Function("planned", [a, jerk], [ca.vertcat(ca.SX(0, 1), *[g.expression(a, jerk) for g in limits])])


def stack_limits(model: Model, limits: Sequence[Limit]) -> ca.Function:
    """Return the function (q, nu, u, du) -> values (n_limits,)."""
    return _stacked(model, tuple(limits))


@lru_cache(maxsize=16)
def _stacked(model: Model, limits: tuple[Limit, ...]) -> ca.Function:
    s = sample_symbols(model)
    sample = [s.q, s.nu, s.u, s.du]
    return ca.Function("limits", sample, [ca.vertcat(*[g.expression(*sample) for g in limits])], {"cse": True})


def is_lane_limit(name: str) -> bool:
    """Return True for limits that depend on the position on the ground: names that begin with `lane`."""
    return name.startswith("lane")


def is_rest_limit(name: str) -> bool:
    """Return True for limits on rest at both ends: names that begin with `rest`."""
    return name.startswith("rest")


def is_free_limit(name: str) -> bool:
    """Return True for limits of lane and rest, which shifting the drive or small end torques can still meet."""
    return is_lane_limit(name) or is_rest_limit(name)


def keeps_motion_limits(excess: Mapping[str, float]) -> bool:
    """Return True if every limit but lane and rest is kept; excess as from `check_limits`."""
    return all(v == 0 for name, v in excess.items() if not is_free_limit(name))


def lane_excess(excess: Mapping[str, float]) -> float:
    """Return the largest excess over a limit of the lane, 0 without one."""
    return max((v for name, v in excess.items() if is_lane_limit(name)), default=0.0)


def resting_coordinates(model: Model) -> tuple[int, ...]:
    """Return the coordinates with a pose at both ends: those with a position limit or that forces depend on."""
    limited = {
        model.machine.coordinate(body)
        for body in model.machine.body
        if body.coordinates and (body.limit.reach is not None or body.coordinates[0] in model.active_coordinates)
    }
    return tuple(k for k, c in enumerate(model.coordinates) if c in limited)


def end_poses(model: Model, problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates (n_q,) at the start and at the end, as `Problem` says."""
    low, high = drive_ranges(model)
    start = np.where((low < 0) & (high > 0), 0.0, (low + high) / 2)
    for c, place in problem.start_pose.items():
        start[model.coordinates.index(c)] = place
    end = start.copy()
    for c, place in problem.end_pose.items():
        end[model.coordinates.index(c)] = place
    return start, end


def chosen_poses(model: Model, problem: Problem) -> tuple[int, ...]:
    """Return the coordinates of an arm whose pose at start and end the search chooses: those that have none given."""
    given = {*problem.start_pose, *problem.end_pose}
    return tuple(k for k, c in enumerate(model.coordinates) if model.follows_positions and c not in given)


def rest_tolerances(model: Model) -> np.ndarray:
    """Return the speeds (n_q,) that count as rest: 0.02 m/s (at the rim of a contact), 0.01 rad/s."""
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
    """Return the largest excess over every limit by name, as a fraction of its range; 0 where it is kept.

    Rest at the ends is a limit whose range is its tolerance.
    """
    limits = machine_limits(model, problem)
    du = np.diff(motion.u, axis=0) / np.diff(motion.t)[:, None]
    du = np.vstack([du, du[-1:]])
    values = stack_limits(model, limits)(motion.q.T, motion.nu.T, motion.u.T, du.T).full()
    excess = {
        g.name: max(0.0, float(v.max() - g.high), float(g.low - v.min())) / g.range
        for g, v in zip(limits, values, strict=True)
    }
    for whole in MOTION_LIMITS.values():
        excess |= whole(model, problem, motion)
    return excess


def _rest(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """At both ends the machine stands still in the poses of the problem, `rest`."""
    if not problem.rest:
        return {}
    tolerance = rest_tolerances(model)
    still = {
        f"rest {c}'": max(0.0, float(np.abs(motion.nu[[0, -1], k]).max() / tolerance[k]) - 1)
        for k, c in enumerate(model.coordinates)
    }
    away = np.abs(motion.q[[0, -1]] - end_poses(model, problem)).max(axis=0) / REST_POSITION - 1
    given = [k for k in resting_coordinates(model) if k not in chosen_poses(model, problem)]
    return still | {f"rest {model.coordinates[k]}": max(0.0, float(away[k])) for k in given}


def describe_excess(model: Model, name: str, excess: float, end: str = "the end") -> str:
    """Say by how much a drive exceeds a limit; of rest, how fast it moves at an end or how far it is off its pose."""
    for k, c in enumerate(model.coordinates):
        unit = "rad" if c.startswith("theta") else "m"
        if name == f"rest {c}'":
            speed = format_number((1 + excess) * rest_tolerances(model)[k], 3)
            return f"{c} {'still moves' if end == 'the end' else 'moves'} at {speed} {unit}/s at {end}"
        if name == f"rest {c}":
            return f"{c} is {format_number((1 + excess) * REST_POSITION, 3)} {unit} off its pose at {end}"
    return f"{name} is exceeded by {100 * excess:.2f} % of its range"


def excesses_in_units(
    model: Model, problem: Problem, motion: Motion, violations: Mapping[str, float]
) -> dict[str, str]:
    """Say in units what a share of a range does not: rest at the ends, the duration; by limit, those not kept."""
    found = {}
    for name, excess in violations.items():
        if excess > TOLERANCE and is_rest_limit(name):
            k = model.coordinates.index(name.removeprefix("rest ").removesuffix("'"))
            moving = name.endswith("'")
            off = np.abs(motion.nu[[0, -1]] if moving else motion.q[[0, -1]] - end_poses(model, problem))[:, k]
            found[name] = describe_excess(model, name, excess, "the start" if off[0] > off[1] else "the end")
        elif excess > TOLERANCE and name == DURATION_LIMIT:
            lasts, wanted = float(motion.t[-1] - motion.t[0]), float(problem.duration_s)
            found[name] = f"it lasts {lasts:g} s, and the problem asks for {wanted:g} s"
    return found


def describe_overload(model: Model, poses: np.ndarray) -> str:
    """Say which joint's load at rest exceeds its torque limit most, and in which of some poses (k, n_q).

    Returns "" where every drive holds every pose, and for a machine that is not fully driven.
    """
    if not model.fully_driven:
        return ""
    still = np.zeros_like(poses)
    load = np.abs(motion_along(model, np.arange(float(len(poses))), poses, still, still).u)
    bodies = model.machine.actuated
    limit = np.array([np.inf if b.limit.torque is None else float(b.limit.torque) for b in bodies])
    at, k = np.unravel_index(int(np.argmax(load / limit)), load.shape)
    if load[at, k] <= limit[k]:
        return ""
    pose = ", ".join(
        f"{c} {format_number(x, 3)} {'rad' if c.startswith('theta') else 'm'}"
        for c, x in zip(model.coordinates, poses[at], strict=True)
    )
    unit = "N m" if bodies[k].joint == "revolute" else "N"
    loaded = "gravity and springs load" if any(b.spring is not None for b in model.machine.body) else "gravity loads"
    return (
        f"{loaded} {bodies[k].where} with {format_number(load[at, k], 3)} {unit}"
        f" {f'at {pose}' if model.active_coordinates else 'in every pose'}, more than its torque limit of"
        f" {limit[k]:g} {unit}"
    )


def _reversals(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Number of changes of the direction of travel, `reversals` of the problem."""
    if problem.reversals is None or not model.machine.planar:
        return {}
    return {REVERSALS_LIMIT: max(0.0, (count_reversals(motion) - problem.reversals) / max(1, problem.reversals))}


def count_reversals(motion: Motion) -> int:
    """Count the changes of the direction of travel; speeds that count as rest have no direction."""
    going = np.sign(motion.nu[np.abs(motion.nu[:, 0]) > REST_SPEED, 0])
    return int((np.diff(going) != 0).sum())


# Limits on a whole motion: function(model, problem, motion) returns the excess by name.
MOTION_LIMITS: dict[str, Callable[[Model, Problem, Motion], dict[str, float]]] = {
    "rest": _rest,
    "reversals": _reversals,
}


def travel_directions(motion: Motion, most: int) -> np.ndarray:
    """Return the direction of travel (N,), +-1, with at most `most` reversals, that fits a motion best.

    The fit minimises the distance driven against it, by dynamic programming over stretches of one direction.
    """
    v = motion.nu[:, 0]
    cuts = np.concatenate([[0], np.flatnonzero(np.diff(np.sign(v)) != 0) + 1, [len(v)]])
    driven = np.add.reduceat(v, cuts[:-1])
    gain = np.full((len(driven), most + 1, 2), -np.inf)
    came = np.zeros((len(driven), most + 1, 2), int)  # direction of the stretch before
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
