"""Shapes from the collision geometry of a URDF hold it, by pinocchio's own placement of the same geometry."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support.commands import Excite

from excite.cli import machine_template
from excite.model import build
from excite.model.machine import load_machine
from excite.model.mechanics import body_poses
from excite.trajectories import machine_limits
from excite.workflows import choose_problem
from excite.workflows.collision_shapes import capsules_around
from excite.workflows.urdf import read_robot

ARM = Path(__file__).parents[1] / "support" / "arm.urdf"
SHAPES = {  # collision geometry by link
    "base_link": '<geometry><box size="0.2 0.2 0.1"/></geometry>',
    "Upper-Arm": '<origin xyz="0.2 0 0.1" rpy="0 1.57 0"/><geometry><cylinder radius="0.05" length="0.4"/></geometry>',
    "hand": '<origin xyz="0 0.1 0" rpy="0.4 0 0"/><geometry><box size="0.1 0.3 0.05"/></geometry>',
}


def inside(points: np.ndarray, shapes: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """Depth [m] of points in the union of capsules, negative outside."""
    depths = []
    for ends, radius in shapes:
        along = ends[-1] - ends[0]
        share = np.clip((points - ends[0]) @ along / max(float(along @ along), 1e-12), 0, 1)
        depths.append(radius - np.linalg.norm(points - ends[0] - share[:, None] * along, axis=1))
    return np.max(depths, axis=0)


def test_few_capsules_hold_an_elbow_without_filling_it() -> None:
    """Two tubes at a right angle: one capsule around both has eight times the volume."""
    import trimesh

    tubes = [
        trimesh.creation.cylinder(0.05, segment=((0, 0, 0), (0.5, 0, 0))),
        trimesh.creation.cylinder(0.05, segment=((0.5, 0, 0), (0.5, 0, 0.5))),
    ]
    triangles = [
        np.asarray(v)[f] for v, f in (trimesh.remesh.subdivide_to_size(t.vertices, t.faces, 0.03) for t in tubes)
    ]
    found = capsules_around(np.concatenate(triangles))
    assert len(found) == 2
    shapes = [(c.ends, c.radius) for c in found]
    assert inside(np.concatenate(triangles).reshape(-1, 3), shapes).min() > -1e-6
    assert sum(c.volume for c in found) < 2.5 * sum(t.volume for t in tubes)


def test_shapes_of_a_urdf_hold_its_collision_geometry_in_every_pose(tmp_path: Path) -> None:
    text = ARM.read_text()
    robot = text.replace("<link", "\n<link")
    links = [link for link in SHAPES if f'<link name="{link}"' in robot]
    for link in links:
        start = robot.index(f'<link name="{link}"')
        end = robot.index(">", start)
        closed = robot[end - 1] == "/"
        body = f"<collision>{SHAPES[link]}</collision>"
        robot = robot[: end - closed] + ">" + body + ("</link>" if closed else "") + robot[end + 1 :]
    assert links
    urdf, file = tmp_path / "arm.urdf", tmp_path / "arm.toml"
    urdf.write_text(robot)
    machine_template.start("arm", file, origin=str(urdf))
    machine = load_machine(file)
    twin = pin.buildModelFromUrdf(str(urdf))
    geometry = pin.buildGeomFromUrdf(twin, str(urdf), pin.GeometryType.COLLISION)
    data, placed = twin.createData(), geometry.createData()
    rng = np.random.default_rng(0)
    joints = [s.column.rsplit("_", 1)[0] for s in machine.sensor if s.kind == "angle"]
    for _ in range(5):
        step, q = np.zeros(twin.nv), {}
        for name, body in zip(joints, machine.body, strict=True):
            q[body.coordinates[0]] = step[twin.joints[twin.getJointId(name)].idx_v] = rng.uniform(-1, 1)
        pin.updateGeometryPlacements(twin, data, geometry, placed, pin.integrate(twin, pin.neutral(twin), step))
        poses = body_poses(machine, q)
        shapes = [(np.array(s.ends), float(s.radius)) for s in machine.world.shape]
        for body in machine.body:
            R, P = poses[body.index]
            shapes += [(np.array(s.ends) @ R.T + P, float(s.radius)) for s in body.shape]
        for one, at in zip(geometry.geometryObjects, placed.oMg, strict=True):
            half = getattr(one.geometry, "halfSide", None)
            size = half if half is not None else np.array([one.geometry.radius] * 2 + [one.geometry.halfLength])
            corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * size
            if half is None:
                corners[:, :2] /= np.sqrt(2)
            assert inside(corners @ at.rotation.T + at.translation, shapes).min() > -1e-4
    model = build(machine)
    assert any(g.kind == "clearance" for g in machine_limits(model, choose_problem(machine, None, None)[1]))


def test_a_mesh_that_is_missing_is_said_in_the_file(tmp_path: Path) -> None:
    text = ARM.read_text()
    link = "Upper-Arm"
    start = text.index(">", text.index(f'<link name="{link}"')) + 1
    mesh = '<collision><geometry><mesh filename="package://robots/nothing.stl"/></geometry></collision>'
    urdf, file = tmp_path / "arm.urdf", tmp_path / "arm.toml"
    urdf.write_text(text[:start] + mesh + text[start:])
    machine_template.start("arm", file, origin=str(urdf))
    assert "the collision mesh package://robots/nothing.stl is not there" in file.read_text()
    assert not any(b.shape for b in load_machine(file).body)


def with_collision(geometry: str, folder: Path) -> tuple[Path, Path]:
    """URDF of the arm with a collision geometry of its upper arm, and the place of its machine file."""
    text = ARM.read_text()
    start = text.index(">", text.index('<link name="Upper-Arm"')) + 1
    urdf = folder / "arm.urdf"
    urdf.write_text(f"{text[:start]}<collision><geometry>{geometry}</geometry></collision>{text[start:]}")
    return urdf, folder / "arm.toml"


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
def test_plain_geometry_needs_no_mesh_library(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points all over the true surface lie in the capsules, to the digits of the file."""
    monkeypatch.setitem(sys.modules, "trimesh", None)
    rng = np.random.default_rng(0)
    n = rng.normal(size=(4000, 3))
    round_, z = n / np.linalg.norm(n, axis=1, keepdims=True), rng.uniform(-0.2, 0.2, (4000, 1))
    if kind == "box":
        tag, surface = '<box size="0.1 0.3 0.05"/>', np.clip(n, -1, 1) * [0.05, 0.15, 0.025]
    elif kind == "cylinder":
        tag = '<cylinder radius="0.07" length="0.4"/>'
        surface = np.hstack([0.07 * n[:, :2] / np.linalg.norm(n[:, :2], axis=1, keepdims=True), z])
    else:
        tag, surface = '<sphere radius="0.12"/>', 0.12 * round_
    urdf, file = with_collision(tag, tmp_path)
    machine_template.start("arm", file, origin=str(urdf))
    (shapes,) = (b.shape for b in load_machine(file).body if b.shape)
    joint = next(f for f in read_robot(urdf).attached if any(link == "Upper-Arm" for link, _ in f))
    at = next(placed for link, placed in joint if link == "Upper-Arm")
    depth = inside(surface @ at[:3, :3].T + at[:3, 3], [(np.array(s.ends), float(s.radius)) for s in shapes])
    assert depth.min() > -1e-4
    assert sum(float(s.radius) for s in shapes) < {"box": 0.5, "cylinder": 0.3, "sphere": 0.13}[kind]


@pytest.mark.parametrize(
    ("geometry", "said"),
    [
        (
            '<mesh filename="arm.stl"/>',
            r"the mesh arm.stl is read with trimesh: pip install 'excite\[urdf\]'",
        ),
        ('<box size="0.1 0.3"/>', "link Upper-Arm, collision geometry box: size must be three lengths"),
        ('<sphere radius="-1"/>', "link Upper-Arm, collision geometry sphere: a length must be > 0"),
        ("<cone/>", "link Upper-Arm, collision geometry cone: is unknown, known are box, cylinder, sphere and mesh"),
    ],
)
def test_geometry_that_cannot_be_read_is_named(
    geometry: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    (tmp_path / "arm.stl").write_text("solid")
    urdf, file = with_collision(geometry, tmp_path)
    machine_template.start("arm", file, origin=str(urdf))
    assert re.search(said, file.read_text())
    assert not any(b.shape for b in load_machine(file).body)


def test_meshes_around_an_arm_become_boxes_and_capsules_that_hold_them(tmp_path: Path, excite: Excite) -> None:
    """A table in millimetres and a slanted pipe beside it, shifted; the lines printed are those of a machine file."""
    import trimesh

    slab = trimesh.creation.box((800, 600, 40))
    pipe = trimesh.creation.cylinder(30, segment=((900, 0, 0), (1300, 300, 900)))
    trimesh.util.concatenate([slab, pipe]).export(tmp_path / "cell.stl")
    code, text, said = excite("machine", "around", tmp_path / "cell.stl", "--unit", "0.001", "--at", "0.5,0,-0.1")
    assert code == 0, said
    world = tomllib.loads(text)["world"]
    assert [box["name"] for box in world["box"]] == ["cell"]
    assert world["box"][0]["low"] == pytest.approx([0.1, -0.3, -0.12], abs=2e-4)
    assert world["box"][0]["high"] == pytest.approx([0.9, 0.3, -0.08], abs=2e-4)
    shapes = [(np.array(s["ends"], float), s["radius"]["value"]) for s in world["shape"]]
    assert inside(pipe.vertices * 1e-3 + [0.5, 0, -0.1], shapes).min() > 0
    assert sum(radius for _, radius in shapes) < 0.15, "no more room than the pipe needs"
    plain = ARM.with_name("two_joints.toml").read_text()
    (tmp_path / "arm.toml").write_text(f"{plain}\n{text}")
    assert load_machine(str(tmp_path / "arm.toml")).world.box[0].name == "cell"
    (tmp_path / "no.stl").write_text("nothing")
    code, _, said = excite("machine", "around", tmp_path / "no.stl")
    assert (code, "no.stl: " in said) == (2, True)
