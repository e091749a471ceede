"""`excite handover`: a designed joint motion as files for the arm's controller, and a rehearsal in words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from excite import logs, reports, trajectories
from excite.errors import UsageError
from excite.model import Model
from excite.simulation import Motion
from excite.trajectories import PlannedMotion
from excite.workflows import handover_files as files, requests

RATE_HZ = 125.0  # of the files by default: the servo rate of a UR10; 500 Hz of a UR10e
REHEARSAL_HZ = 1000.0  # rate at which ranges, speeds and distances are judged
BAG_TOPIC = "/joint_trajectory_controller/joint_trajectory"  # of ros2_control's controller by its usual name


def read_planned(design_dir: Path) -> PlannedMotion:
    """Read the joint motion of a design folder. Raises DesignFolderError, LogError, UsageError for torques alone."""
    model = trajectories.read_design_model(design_dir)
    drive = logs.read_drive(design_dir / "profile.csv", model)
    if not model.follows_positions or drive.planned is None:
        raise UsageError(
            f"{design_dir}: is a drive of torques, no joint motion of an arm; a controller plays its profile.csv"
        )
    q = drive.planned[0]
    return trajectories.planned_motion(model, np.arange(len(q)) / float(model.machine.sampling_hz), q)


def hand_over(
    place: Path, design_dir: Path, rate: float | None, slower: float, joints: str | None, bag: bool
) -> dict[str, Any]:
    """Write a design's motion for robot controllers into a folder; return the summary.

    rate [1/s]: None for RATE_HZ. slower: factor by which the motion is slower. joints: names for ROS, with commas
    between; None for those of the machine file. Raises UsageError, DesignFolderError, LogError.
    """
    rate = RATE_HZ if rate is None else rate
    requests.require_positive("--rate", rate, "1/s")
    if not slower >= 1:
        raise UsageError(f"--slower: must be 1 or more, 10 for a tenth of the speed (got {slower:g})")
    planned = read_planned(design_dir)
    model = planned.model
    names = joint_names(model, joints)
    motion = planned.at(rate, slower)
    found = trajectories.rehearse(model, planned.at(REHEARSAL_HZ, slower))
    written = write_motion(place, model, motion, planned.at(files.POINT_RATE / slower, slower), names)
    if bag:
        files.write_bag(motion, names, place / "bag", BAG_TOPIC)
        written["bag"] = "ROS 2 bag with the trajectory as one message"
    words = reports.rehearsal_words(found)
    written["rehearsal.md"] = "what will move where, in words"
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "design": str(design_dir),
        "duration_s": float(motion.t[-1]),
        "rate_hz": rate,
        "slower": slower,
        "joints": names,
        "start": dict(zip(model.coordinates, motion.q[0].tolist(), strict=True)),
        "collisions_looked_at": trajectories.has_shapes(model.machine),
        "words": words,
        "versions": requests.package_versions(),
        "files": written,
    }
    told = [words[0], "", *(f"- {line}" for line in words[1:]), ""]
    (place / "rehearsal.md").write_text("\n".join(["# Rehearsal", "", *told]), encoding="utf-8")
    written["motion.html"] = "the motion to look at, in a browser"
    reports.write_report(place, "handover", summary, None, {}, reports.motion_scene(model, motion))
    return summary


def joint_names(model: Model, given: str | None) -> list[str]:
    """Return the names of the joints, in the order of the coordinates. Raises UsageError for another number of them."""
    own = [b.where for b in model.machine.body if model.machine.is_free(b) and b.moves_with is None]
    if given is None:
        return own
    names = [name.strip() for name in given.split(",")]
    if len(names) != len(own) or not all(names):
        raise UsageError(f"--joints: {len(own)} names are needed, for {', '.join(own)} (got {given})")
    return names


def write_motion(place: Path, model: Model, motion: Motion, points: Motion, names: list[str]) -> dict[str, str]:
    """Write a motion in every language that fits the arm; return what each file is, by name."""
    files.motion_table(model, motion).to_csv(place / "motion.csv", index=False, float_format="%.12g")
    (place / "motion.yaml").write_text(files.joint_trajectory(motion, names), encoding="utf-8")
    written = {
        "motion.csv": "positions, velocities, accelerations and torques over time",
        "motion.yaml": "trajectory_msgs/JointTrajectory of ROS 2",
    }
    turning = [b for b in model.machine.body if model.machine.is_free(b)]
    if len(turning) == files.SIX and all(b.joint == "revolute" for b in turning):
        name = model.machine.name
        for file, text, what in (
            ("motion.script", files.urscript(name, motion), "URScript: slow move to the start, then servoj"),
            ("motion.src", files.kuka_points(name, points), "KRL: slow move to the start, then a timed spline block"),
            ("motion.mod", files.abb_points(name, points), "RAPID: slow move to the start, then timed MoveAbsJ"),
        ):
            (place / file).write_text(text, encoding="utf-8")
            written[file] = what
    return written
