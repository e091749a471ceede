"""The view of an arm's motion: places against the textbook, one page without a network."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from excite import reports
from excite.model import build
from excite.model.machine import load_machine
from excite.reports import html
from excite.simulation import Motion, motion_along

ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"


@pytest.fixture(scope="module")
def motion() -> Motion:
    t = np.arange(101) / 50
    q = np.column_stack([np.sin(t), 0.5 * np.cos(2 * t)])
    return motion_along(build(load_machine(str(ARM))), t, q, 0 * q, 0 * q)


def test_links_without_shapes_are_sticks_from_joint_to_joint(motion: Motion) -> None:
    scene = reports.motion_scene(build(load_machine(str(ARM))), motion)
    t, ends = np.array(scene["t"]), np.array(scene["ends"]).reshape(len(scene["t"]), -1, 6)
    assert t[[0, -1]] == pytest.approx([0, 2])
    elbow = 0.4 * np.column_stack([np.cos(np.sin(t)), np.sin(np.sin(t))])
    assert ends[:, 0, 3:5] == pytest.approx(elbow, abs=1e-3)
    assert ends[:, 1, :2] == pytest.approx(elbow, abs=1e-3)
    assert scene["names"] == ["upper_arm", "forearm"]
    assert not scene["shaped"]
    assert np.array(scene["q"])[:, 0] == pytest.approx(np.degrees(np.sin(t)), abs=1e-2)


def test_shapes_stand_where_the_arm_is() -> None:
    model = build(load_machine("ur10"))
    q = np.array([[0, -np.pi / 2, 0, 0, 0, 0], [np.pi / 2, -np.pi / 2, 0, 0, 0, 0]])
    scene = reports.motion_scene(model, motion_along(model, np.arange(2.0), q, 0 * q, 0 * q))
    ends = np.array(scene["ends"]).reshape(2, -1, 6)
    assert ends[0, -1, 2] > 1.2, "stretched upwards"
    x, y, z = ends[0, :, :3].T
    assert ends[1, :, 0] == pytest.approx(np.where(np.array(scene["names"]) == "ground", x, -y), abs=1e-3)
    assert ends[1, :, 2] == pytest.approx(z, abs=1e-3)
    assert len(scene["gaps"][0]) == len(scene["pairs"]) > 10


def test_page_is_one_file_that_needs_no_network(motion: Motion, tmp_path: Path) -> None:
    scene = reports.motion_scene(build(load_machine(str(ARM))), motion)
    scene["title"] = "an <arm> </script>"
    html_file = reports.write_motion_page(scene, tmp_path)
    text = html_file.read_text()
    assert "default-src 'none'" in text
    assert not re.search(r'(?:src|href)="(?!data:)', text)
    (data,) = re.findall(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)
    assert json.loads(data) == scene
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert str(html.script_source(script)) in text, "the policy allows this script alone"
