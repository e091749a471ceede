"""Distances, planned rates and tool limits of arms, against a collision library, dense samples and differences."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from excite import trajectories
from excite.errors import MachineError
from excite.model import Model, build
from excite.model.machine import Box, Machine, Problem, Quantity, Shape, Tool, load_machine
from excite.trajectories import JointMotion, clearance, joint_motion, joint_search
from excite.workflows import DesignRequest, choose_problem, design_from

MACHINES = Path(__file__).parents[2] / "model" / "machines"
ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"
HZ = 1000


def quantity(value: float) -> Quantity:
    return Quantity(value=value, source="definition")


def capsule(radius: float, *ends: tuple[float, float, float]) -> Shape:
    return Shape(radius=quantity(radius), ends=ends)


def with_tables(model: Model, bodies: dict[int, dict[str, Any]], **tables: Any) -> Model:
    """Return a model whose machine has other shapes or limits of bodies, by index, and other tables."""
    changed = []
    for body in model.machine.body:
        new = dict(bodies.get(body.index, {}))
        limit = body.limit.model_copy(update={k: quantity(v) for k, v in new.pop("limit", {}).items()})
        changed.append(body.model_copy(update={"limit": limit, **new}))
    return model.for_machine(model.machine.model_copy(update={"body": tuple(changed), **tables}))


def coal_distance(one: np.ndarray, r1: float, other: np.ndarray, r2: float) -> float:
    """Distance of two capsules, ends (2, 3) each."""
    coal = pytest.importorskip("coal")
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    placed = [
        (coal.Capsule(r, float(np.linalg.norm(e[1] - e[0]))), _along(coal, e)) for e, r in ((one, r1), (other, r2))
    ]
    return float(coal.distance(*placed[0], *placed[1], request, result))


def _along(coal: Any, ends: np.ndarray) -> Any:
    z = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    x = np.linalg.svd(z[None])[2][1]
    return coal.Transform3s(np.column_stack([x, np.cross(z, x), z]), ends.mean(axis=0))


# ------------------------------------------------------------------------------------------------ distances


def test_distance_of_capsules_is_that_of_a_collision_library() -> None:
    rng = np.random.default_rng(0)
    symbols = [ca.SX.sym(n, 3) for n in "abcd"]
    distance = ca.Function("d", symbols, [clearance.segment_distance(tuple(symbols[:2]), tuple(symbols[2:]))])
    for k in range(60):
        one, other = rng.normal(size=(2, 2, 3))
        if k % 4 == 0:  # parallel, as links of an arm often are
            other[1] = other[0] + rng.uniform(-2, 2) * (one[1] - one[0])
        found = float(distance(one[0], one[1], other[0], other[1]))
        s = np.linspace(0, 1, 201)
        a, b = (e[0] + s[:, None] * (e[1] - e[0]) for e in (one, other))
        brute = float(np.sqrt(((a[:, None] - b[None]) ** 2).sum(axis=2)).min())
        assert found == pytest.approx(brute, abs=0.03)
        if brute > 0.3:
            assert found - 0.2 == pytest.approx(coal_distance(one, 0.1, other, 0.1), abs=1e-4)


def test_distance_of_a_capsule_from_a_box_is_that_of_its_nearest_point() -> None:
    rng = np.random.default_rng(1)
    low, high = np.array([-0.3, -0.5, 0.1]), np.array([0.4, 0.2, 0.9])
    a, b = ca.SX.sym("a", 3), ca.SX.sym("b", 3)
    distance = ca.Function("d", [a, b], [clearance.box_distance((a, b), low, high)])
    for _ in range(100):
        ends = rng.uniform(-1.5, 1.5, (2, 3))
        points = ends[0] + np.linspace(0, 1, 2001)[:, None] * (ends[1] - ends[0])
        outside = np.linalg.norm(points - np.clip(points, low, high), axis=1).min()
        found = float(distance(*ends))
        assert found == pytest.approx(outside, abs=2e-3) if outside > 0 else found < 2e-3


def test_slope_of_a_distance_is_that_of_differences() -> None:
    model = build(load_machine("ur10"))
    q = ca.SX.sym("q", 6)
    values = ca.vertcat(*[g[1] for g in clearance.clearance_limits(model, q)])
    near = ca.Function("near", [q], [values, ca.jacobian(values, q)])
    rng = np.random.default_rng(2)
    off = []
    for pose in clearance.random_poses(model, 20):
        d = rng.normal(size=6)
        slope = np.array(near(pose)[1] @ d).ravel()
        differences = np.array(near(pose + 1e-6 * d)[0] - near(pose - 1e-6 * d)[0]).ravel() / 2e-6
        off.append(np.abs(slope - differences))
    assert np.median(off) < 1e-6  # all but the few where another point of a link becomes the nearest
    assert (np.array(off) < 1e-4).mean() > 0.98


# ------------------------------------------------------------------------------------------------ designs


def test_a_design_touches_nothing_at_a_kilohertz(arm: Model, problem: Problem) -> None:
    """A box and a table stand where the free motion goes; places of links by another recursion, distances by points."""
    shapes = {
        1: {"shape": (capsule(0.05, (0.05, 0, 0), (0.35, 0, 0)),)},
        2: {"shape": (capsule(0.04, (0.12, 0, 0), (0.5, 0, 0)), capsule(0.06, (0.5, 0, 0)))},
    }
    box = Box(name="cabinet", low=(0.5, -0.1, -0.5), high=(1.5, 0.6, 0.5))
    world = arm.machine.world.model_copy(update={"box": (box,), "floor": "none"})
    guarded = with_tables(arm, shapes, world=world)
    free = with_tables(arm, shapes, world=arm.machine.world.model_copy(update={"floor": "none"}))
    low, high = np.array(box.low), np.array(box.high)

    def least_gap(model: Model) -> float:
        aim = trajectories.compose_objective(model, "cond")
        start = problem.model_copy(update={"start_pose": {"theta1": -1.2}, "end_pose": {"theta1": -1.0, "theta2": 0.5}})
        *_, state = joint_search.search(model, start, aim, "fourier", 0, lambda: False)
        assert state.best.excess == 0
        basis = joint_motion.motion_basis(model, start, "fourier", *joint_search.end_poses(model, start))
        motion = JointMotion(basis, state.best.coefficients)
        gaps = []
        q = motion.at(np.arange(0, 4 * HZ) / HZ)
        upper, both = q[:, 0], q.sum(axis=1)
        elbow = 0.4 * np.stack([np.cos(upper), np.sin(upper), 0 * upper], axis=1)
        along = np.stack([np.cos(both), np.sin(both), 0 * both], axis=1)
        for start, end, radius in ((0.125, 0.875, 0.05), (0.12 / 0.4, 0.5 / 0.4, 0.04), (0.5 / 0.4, 0.5 / 0.4, 0.06)):
            for share in np.linspace(start, end, 40):
                points = share * elbow if radius == 0.05 else elbow + 0.4 * share * along
                away = np.linalg.norm(points - np.clip(points, low, high), axis=1)
                gaps.append(away.min() - radius)
        return float(min(gaps))

    assert least_gap(free) < -0.02
    assert least_gap(guarded) > 0.015  # of the margin of 20 mm, less the distance between the points


def test_planned_rates_and_tool_are_kept_at_a_kilohertz(arm: Model, problem: Problem) -> None:
    limits = {"acceleration": 9.0, "jerk": 150.0, "position_margin": 0.1}
    tool = Tool(body=2, point=(0.4, 0, 0), low=(-0.9, -0.9, -1.0), high=(0.78, 0.3, 1.0), speed=quantity(1.0))
    held = with_tables(arm, {1: {"limit": limits}, 2: {"limit": limits}}, tool=tool)
    found = design_from(held, problem, DesignRequest(starts=1, trajectory="fourier", seed=1)).design
    assert found.max_violation == 0
    planned = trajectories.planned_motion(held, found.motion.t, found.motion.q)
    motion = planned.at(HZ)
    assert np.abs(motion.a).max() <= 9.0 + 1e-3
    inner = slice(5, -5)
    assert np.abs(np.diff(motion.nu, 2, axis=0)[inner] * HZ**2).max() <= 150.0 * 1.01
    q = motion.q[:, 0], motion.q.sum(axis=1)
    place = np.stack([0.4 * np.cos(q[0]) + 0.4 * np.cos(q[1]), 0.4 * np.sin(q[0]) + 0.4 * np.sin(q[1])], axis=1)
    assert np.linalg.norm(np.diff(place, axis=0), axis=1).max() * HZ <= 1.0 + 1e-4
    assert place.max(axis=0) == pytest.approx(np.minimum(place.max(axis=0), [0.78, 0.3]), abs=1e-6)
    assert motion.q[:, 1].min() >= -0.4 - 1e-6


def test_without_shapes_the_first_words_say_so_and_the_arm_stays_above_its_mounting() -> None:
    model = build(load_machine("ur10"))
    bare = with_tables(
        model, {b.index: {"shape": ()} for b in model.machine.body}, tool=Tool(body=6, point=(0, 0, 0.1))
    )
    _, problem = choose_problem(bare.machine, None, None)
    names = [g.name for g in trajectories.machine_limits(bare, problem) if g.kind == "clearance"]
    assert "clearance tool floor" in names
    assert all(n.endswith("floor") for n in names)
    summary = {"looked_at": False, "floor_m": 0.0, "margin_m": 0.02, "left_out": []}
    from excite.reports import design_descriptions

    first = design_descriptions._unseen_collisions({"collisions": summary})
    assert first.startswith("Collisions were not looked at")


def test_a_start_pose_that_touches_is_refused(arm: Model, problem: Problem) -> None:
    box = Box(name="cabinet", low=(0.1, -1, -1), high=(1, 1, 1))
    world = arm.machine.world.model_copy(update={"box": (box,)})
    blocked = with_tables(arm, {2: {"shape": (capsule(0.05, (0, 0, 0)),)}}, world=world)
    with pytest.raises(MachineError, match="start or end pose exceeds a limit at rest, first of all clearance forearm"):
        design_from(blocked, problem, DesignRequest(starts=1))


@pytest.mark.parametrize("kind", joint_motion.BASES)
def test_poses_that_are_not_given_are_chosen(arm: Model, problem: Problem, kind: str) -> None:
    anywhere = problem.model_copy(update={"start_pose": {"theta2": 0.3}, "end_pose": {}})
    basis = joint_motion.motion_basis(arm, anywhere, kind, *joint_search.end_poses(arm, anywhere))
    assert basis.free[0].all()
    assert not basis.free[1, -1]
    coefficients = np.random.default_rng(0).normal(size=(2, basis.count)) * basis.free
    ends = JointMotion(basis, coefficients).at(np.array([0.0, 4.0]))
    assert ends == pytest.approx(np.array([[coefficients[0, -1], 0.3]] * 2))


@pytest.mark.parametrize("kind", joint_motion.BASES)
def test_a_periodic_drive_ends_as_it_starts(arm: Model, problem: Problem, kind: str) -> None:
    again = problem.model_copy(update={"rest": False, "periodic": True, "end_pose": {}})
    basis = joint_motion.motion_basis(arm, again, kind, *joint_search.end_poses(arm, again))
    motion = JointMotion(basis, np.random.default_rng(0).normal(size=(2, basis.count)))
    for order in range(4):
        start, end = motion.at(np.array([0.0, 4.0]), order)
        assert start == pytest.approx(end, abs=1e-6)
        assert np.abs(start).max() > 1e-3


def test_world_and_tool_are_checked() -> None:
    tables = load_machine("ur10").model_dump()
    for change, message in (
        ({"tool": {"body": 9}}, "tool.body: no body 9"),
        ({"tool": {"body": 6, "low": (0, 0, 0)}}, "high: is missing"),
        ({"world": {"apart": [("elbow", "flor")]}}, "nothing is called flor.*did you mean floor"),
        ({"world": {"box": [{"name": "a", "low": (0, 0, 0), "high": (1, 0, 1)}]}}, "must be below high"),
        ({"world": {"floor": "nowhere"}}, 'must be "none" or a table'),
    ):
        with pytest.raises(ValueError, match=message):
            type(load_machine("ur10")).model_validate({**tables, **change})


# ------------------------------------------------------------------------------------------------ shipped arms


def capsule_gaps(file: Path, q: np.ndarray) -> dict[tuple[str, str], np.ndarray]:
    """Gap (N,) [m] of any two capsules of different bodies and of the floor along poses q (N, n), from the file alone.

    Points every 5 mm of one capsule's axis, their exact distance from the other's; places of links by the table.
    """
    tables = tomllib.loads(file.read_text())
    angles = {"pi": np.pi, "pi/2": np.pi / 2, "-pi/2": -np.pi / 2}

    def number(x: dict[str, Any]) -> float:
        return float(angles.get(x["value"], x["value"]))

    def pieces(owner: str, shapes: list[Any], R: np.ndarray, P: np.ndarray) -> list[Any]:
        ends = [np.array(s["ends"], float) @ R.transpose(0, 2, 1) + P[:, None] for s in shapes]
        return [(f"{owner} {k}", e, number(s["radius"])) for k, (e, s) in enumerate(zip(ends, shapes, strict=True))]

    R, P = np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 3))
    placed = pieces("ground", tables["world"]["shape"], R, P)
    for body, angle in zip(tables["body"], q.T, strict=True):
        a, turn = number(body["alpha"]), angle + number(body.get("theta", {"value": 0}))
        tilt = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        P = P + R @ (np.array([number(body["d"]), 0, 0]) + tilt @ [0, 0, number(body["r"])])
        c, s, o = np.cos(turn), np.sin(turn), 0 * turn
        R = R @ tilt @ np.stack([c, -s, o, s, c, o, o, o, o + 1], axis=1).reshape(-1, 3, 3)
        placed += pieces(body["name"], body["shape"], R, P)
    gaps: dict[tuple[str, str], np.ndarray] = {}
    for k, (one, ends, radius) in enumerate(placed):
        length = np.linalg.norm(ends[0, -1] - ends[0, 0])
        points = ends[:, :1] + np.linspace(0, 1, 2 + int(length / 0.005))[:, None] * (ends[:, -1:] - ends[:, :1])
        gaps[one, "floor"] = points[..., 2].min(axis=1) - radius
        for other, far, other_radius in placed[k + 1 :]:
            if one.split()[0] != other.split()[0]:
                along = far[:, -1:] - far[:, :1]
                share = ((points - far[:, :1]) * along).sum(axis=2) / np.maximum((along**2).sum(axis=2), 1e-12)
                away = points - far[:, :1] - np.clip(share, 0, 1)[..., None] * along
                gaps[one, other] = np.linalg.norm(away, axis=2).min(axis=1) - radius - other_radius
    return gaps


def least_gap(machine: Machine, q: np.ndarray) -> tuple[float, tuple[str, str]]:
    """Least gap [m] along poses q, of pairs that move and keep the margin in a tenth of random poses; and whose."""
    ends = np.array([b.limit.drive_range or (-np.pi, np.pi) for b in machine.body])
    anywhere = np.random.default_rng(9).uniform(ends[:, 0], ends[:, 1], (3000, len(ends)))
    file = MACHINES / f"{machine.name}.toml"
    usual = capsule_gaps(file, anywhere)
    counted = [p for p, g in usual.items() if np.ptp(g) > 1e-9 and (g < 0.02).mean() < 0.9]
    gaps = capsule_gaps(file, q)
    return min((float(gaps[p].min()), p) for p in counted)


def test_the_checker_sees_an_arm_that_folds_or_dips() -> None:
    machine = load_machine("ur10")
    assert least_gap(machine, np.array([[0, -1.0, 3.13, 0, 0, 0]]))[1][0].split()[0] == "shoulder"
    gap, pair = least_gap(machine, np.array([[0, 1.5, 0, 0, 0, 0]]))
    assert gap < -0.9
    assert pair[1] == "floor"
    assert least_gap(machine, np.array([[0, -np.pi / 2, 0, 0, 0, 0]]))[0] > 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [("ur10", 0), ("panda", 0)])
def test_shipped_arms_touch_nothing_at_a_kilohertz(name: str, seed: int) -> None:
    model = build(load_machine(name))
    _, problem = choose_problem(model.machine, None, None)
    request = DesignRequest(starts=1, seed=seed, trajectory="fourier", cond_slack=0.0)
    found = design_from(model, problem, request).design
    assert found.max_violation <= joint_search.ROUNDING
    assert found.cond_phi < {"ur10": 6.5, "panda": np.inf}[name]  # results/duel has what other solvers reach
    motion = trajectories.planned_motion(model, found.motion.t, found.motion.q).at(HZ)
    gap, pair = least_gap(model.machine, motion.q)
    assert gap > 0.0195, pair
