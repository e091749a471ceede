"""Hand-over of a joint motion: each file is read by an interpreter of its language and gives the motion back."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.commands import Excite

from excite import trajectories
from excite.logs import profile_of
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.trajectories import PlannedMotion
from excite.workflows import handover_files as files

DURATION, RATE = 4.0, 100.0
JOINTS = [f"joint_{k}" for k in range(1, 7)]


def course(t: np.ndarray, order: int) -> np.ndarray:
    """A motion of six joints from rest to rest, cubes of sines, and its derivatives."""
    w = np.pi * np.arange(1, 7) / DURATION
    x = np.outer(t, w)
    s, c = np.sin(x), np.cos(x)
    start = np.array([0.0, -1.5, 1.0, -0.5, 0.3, 0.0])
    if order == 0:
        return start + 0.2 * s**3
    return 0.6 * w * s**2 * c if order == 1 else 0.6 * w**2 * (2 * s * c**2 - s**3)


@pytest.fixture(scope="module")
def ur10() -> Model:
    return build(load_machine("ur10"))


@pytest.fixture(scope="module")
def planned(ur10: Model) -> PlannedMotion:
    t = np.arange(round(DURATION * RATE) + 1) / RATE
    return trajectories.planned_motion(ur10, t, course(t, 0))


@pytest.mark.parametrize(("rate", "slower"), [(500.0, 1.0), (125.0, 10.0)])
def test_motion_is_given_back_at_any_rate(planned: PlannedMotion, rate: float, slower: float) -> None:
    motion = planned.at(rate, slower)
    t = np.arange(round(DURATION * slower * rate) + 1) / rate
    assert motion.t == pytest.approx(t)
    assert motion.q == pytest.approx(course(t / slower, 0), abs=1e-6)
    assert motion.nu == pytest.approx(course(t / slower, 1) / slower, abs=1e-4)
    assert motion.a == pytest.approx(course(t / slower, 2) / slower**2, abs=3e-2)
    table = files.motion_table(planned.model, motion)
    assert table.shape == (len(t), 1 + 4 * 6)
    still = trajectories.planned_motion(planned.model, np.arange(50.0), np.tile(motion.q[0], (50, 1))).at(1.0)
    assert table[[f"u{k}_Nm" for k in range(1, 7)]].iloc[0].to_numpy() == pytest.approx(still.u[0], abs=1e-2)


def test_trajectory_is_what_ros_reads(planned: PlannedMotion, tmp_path: Path) -> None:
    import rosbags.rosbag2 as bags
    from rosbags.typesys import Stores, get_typestore

    motion = planned.at(20.0)
    read = yaml.safe_load(files.joint_trajectory(motion, JOINTS))
    assert read["joint_names"] == JOINTS
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in read["points"]]
    assert times == pytest.approx(motion.t.tolist())
    for key, values in (("positions", motion.q), ("velocities", motion.nu), ("accelerations", motion.a)):
        assert np.array([p[key] for p in read["points"]]) == pytest.approx(values, abs=1e-8)
    files.write_bag(motion, JOINTS, tmp_path / "bag", "/go")
    with bags.Reader(tmp_path / "bag") as bag:
        ((connection, _, raw),) = bag.messages()
        message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(raw, connection.msgtype)
    assert list(message.joint_names) == JOINTS
    assert np.array([p.positions for p in message.points]) == pytest.approx(motion.q)
    assert message.points[-1].time_from_start.sec == 4


def run_urscript(text: str) -> list[tuple[float, list[float]]]:
    """Run a program of one function; return times and poses of the robot. Fails on anything but known calls."""
    lines = [line for line in text.splitlines() if line]
    name = re.fullmatch(r"def (\w+)\(\):", lines[0])
    assert name is not None
    assert lines[-2:] == ["end", f"{name[1]}()"]
    now, poses = 0.0, list[tuple[float, list[float]]]()

    def movej(q: list[float], a: float = 1.4, v: float = 1.05) -> None:
        poses.append((now, q))

    def servoj(q: list[float], a: float, v: float, t: float, lookahead_time: float, gain: float) -> None:
        nonlocal now
        assert 0.03 <= lookahead_time <= 0.2
        assert 100 <= gain <= 2000
        now += t
        poses.append((now, q))

    calls: dict[str, Callable[..., None]] = {
        "movej": movej,
        "servoj": servoj,
        "sleep": lambda seconds: None,
        "stopj": lambda a: None,
    }
    for line in lines[1:-2]:
        assert line.startswith("  ")
        eval(line.strip(), {"__builtins__": {}}, calls)
    return poses


def test_urscript_drives_the_motion(planned: PlannedMotion) -> None:
    motion = planned.at(125.0)
    poses = run_urscript(files.urscript("ur10", motion))
    assert [t for t, _ in poses] == pytest.approx(motion.t.tolist(), abs=1e-6)
    assert np.array([q for _, q in poses]) == pytest.approx(motion.q, abs=1e-8)


def test_lists_for_kuka_and_abb_hold_points_and_times(planned: PlannedMotion) -> None:
    motion = planned.at(10.0)
    krl = files.kuka_points("ur10", motion)
    axes = [[float(x) for x in re.findall(r"A\d (-?[\d.]+)", line)] for line in krl.splitlines() if "PTP {" in line]
    assert np.radians(axes) == pytest.approx(motion.q, abs=1e-7)
    assert sum(float(x) for x in re.findall(r"PART = ([\d.]+)", krl)) == pytest.approx(100)
    assert float(re.findall(r"END = ([\d.]+)", krl)[0]) == DURATION
    rapid = files.abb_points("ur10", motion)
    moves = re.findall(r"MoveAbsJ \[\[([-\d.,]+)\],\[9E9", rapid)
    assert np.radians([[float(x) for x in one.split(",")] for one in moves]) == pytest.approx(motion.q, abs=1e-7)
    assert sum(float(x) for x in re.findall(r"T:=([\d.]+)", rapid)) == pytest.approx(DURATION)


def test_rehearsal_says_what_moves_where(ur10: Model, planned: PlannedMotion, tmp_path: Path, excite: Excite) -> None:
    design = tmp_path / "design"
    design.mkdir()
    motion = planned.at(RATE)
    profile_of(ur10, motion).to_csv(design / "profile.csv", index=False)
    (design / "machine.json").write_text(ur10.machine.model_dump_json(), encoding="utf-8")
    (design / "summary.json").write_text(json.dumps({"machine": "ur10", "duration_s": DURATION, "problem": "A8"}))
    out = tmp_path / "out"
    code, stdout, stderr = excite("handover", design, "--slower", 2, "--joints", ",".join(JOINTS), "--out", out)
    assert code == 0, stderr
    assert "2 times as slow" in stdout
    words = (out / "rehearsal.md").read_text(encoding="utf-8")
    found = trajectories.rehearse(ur10, planned.at(1000.0, 2.0))
    elbow = found.joints[2]
    assert f"elbow starts at {np.degrees(1.0):.0f} deg" in words
    assert elbow.high.value == pytest.approx(1.2, abs=1e-3)
    speed = np.abs(course(np.linspace(0, DURATION, 8001), 1)[:, 2]).max() / 2
    assert elbow.fastest.value == pytest.approx(speed, rel=1e-3)
    assert found.near[0].distance.value > 0
    for name in (
        "motion.csv",
        "motion.yaml",
        "motion.script",
        "motion.src",
        "motion.mod",
        "report.html",
        "summary.json",
    ):
        assert (out / name).is_file()
    code, _, stderr = excite("handover", design, "--joints", "a,b", "--out", out)
    assert code == 2
    assert "6 names are needed" in stderr
    code, _, stderr = excite("handover", design, "--slower", 0.5, "--out", out)
    assert code == 2
    assert "--slower: must be 1 or more" in stderr
