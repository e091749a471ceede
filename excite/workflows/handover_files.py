"""A joint motion in the languages of robot controllers: ROS 2 JointTrajectory, URScript, KRL, RAPID, CSV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import UsageError
from excite.logs import torque_column
from excite.model import Model
from excite.simulation import Motion

APPROACH_RAD_S, APPROACH_RAD_S2 = 0.2, 0.3  # of the slow move to the start, a tenth of a usual arm's top speed
APPROACH_PERCENT = 5  # of the axes' top speed, the same for controllers that take a share
POINT_RATE = 10.0  # points a second of the lists for KUKA and ABB, whose controllers interpolate between them
SERVO_LOOKAHEAD_S, SERVO_GAIN = 0.1, 300  # defaults of servoj, Universal Robots Script Manual
SIX = 6  # axes of the arms that URScript, KRL's E6AXIS and RAPID's jointtarget are for


def motion_table(model: Model, motion: Motion) -> pd.DataFrame:
    """Return times, positions, velocities, accelerations and torques of a motion, with units in the columns' names."""
    columns = {"t_s": motion.t}
    for k, c in enumerate(model.coordinates):
        unit = "rad" if c.startswith("theta") else "m"
        columns[f"{c}_{unit}"] = motion.q[:, k]
        columns[f"d{c}_{unit}_s"] = motion.nu[:, k]
        columns[f"dd{c}_{unit}_s2"] = motion.a[:, k]
    columns |= {torque_column(model, name): motion.u[:, k] for k, name in enumerate(model.inputs)}
    return pd.DataFrame(columns)


def joint_trajectory(motion: Motion, joints: Sequence[str]) -> str:
    """Return trajectory_msgs/JointTrajectory as YAML, as `ros2 topic pub` and `ros2 action send_goal` take it."""
    lines = ["joint_names: [" + ", ".join(f'"{name}"' for name in joints) + "]", "points:"]
    for k, t in enumerate(motion.t):
        seconds, rest = divmod(round(t * 1e9), 10**9)
        lines.append(f"- positions: {_listed(motion.q[k])}")
        lines.append(f"  velocities: {_listed(motion.nu[k])}")
        lines.append(f"  accelerations: {_listed(motion.a[k])}")
        lines.append(f"  effort: {_listed(motion.u[k])}")
        lines.append(f"  time_from_start: {{sec: {seconds}, nanosec: {rest}}}")
    return "\n".join(lines) + "\n"


def write_bag(motion: Motion, joints: Sequence[str], place: Path, topic: str) -> None:
    """Write a bag of ROS 2 with the motion as one JointTrajectory. Raises UsageError without rosbags."""
    try:
        from rosbags.rosbag2 import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UsageError("--bag needs the extra `ros`: pip install 'excite[ros]'") from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    time, duration = kinds["builtin_interfaces/msg/Time"], kinds["builtin_interfaces/msg/Duration"]
    point, kind = kinds["trajectory_msgs/msg/JointTrajectoryPoint"], "trajectory_msgs/msg/JointTrajectory"
    points = [
        point(*(np.ascontiguousarray(x[k]) for x in (motion.q, motion.nu, motion.a, motion.u)), _stamp(duration, t))
        for k, t in enumerate(motion.t)
    ]
    message = kinds[kind](kinds["std_msgs/msg/Header"](time(0, 0), ""), list(joints), points)
    with Writer(place, version=8) as bag:
        connection = bag.add_connection(topic, kind, typestore=store)
        bag.write(connection, 0, store.serialize_cdr(message, kind))


def _stamp(kind: type, t: float) -> object:
    seconds, rest = divmod(round(t * 1e9), 10**9)
    return kind(seconds, rest)


def urscript(name: str, motion: Motion) -> str:
    """Return a program in URScript: a slow move to the start, then servoj at the motion's rate."""
    step = float(motion.t[1] - motion.t[0])
    lines = [
        f"def {_identifier(name)}():",
        f"  movej({_listed(motion.q[0])}, a={APPROACH_RAD_S2}, v={APPROACH_RAD_S})",
        "  sleep(1.0)",
    ]
    lines += [f"  servoj({_listed(q)}, 0, 0, {step:.9g}, {SERVO_LOOKAHEAD_S}, {SERVO_GAIN})" for q in motion.q[1:]]
    return "\n".join([*lines, "  stopj(2.0)", "end", f"{_identifier(name)}()", ""])


def kuka_points(name: str, motion: Motion) -> str:
    """Return a KRL program: a slow move to the start, then the points of a spline block, each with its time.

    `TIME_BLOCK` gives the parts of the block their share of its duration. Angles are in degrees.
    """
    parts = len(motion.t) - 1
    lines = [
        f"DEF {_identifier(name)}()",
        f"  $VEL_AXIS[1]={APPROACH_PERCENT}",
        *(f"  $VEL_AXIS[{k}]={APPROACH_PERCENT}" for k in range(2, SIX + 1)),
        f"  PTP {_axes(motion.q[0])}",
        *(f"  $VEL_AXIS[{k}]=100" for k in range(1, SIX + 1)),
        "  PTP_SPLINE",
        "    TIME_BLOCK START",
    ]
    for q in motion.q[1:]:
        lines += [f"    SPTP {_axes(q)}", f"    TIME_BLOCK PART = {100 / parts:.9g}"]
    return "\n".join([*lines, f"    TIME_BLOCK END = {motion.t[-1]:.9g}", "  ENDSPLINE", "END", ""])


def abb_points(name: str, motion: Motion) -> str:
    """Return a RAPID module: a slow move to the start, then MoveAbsJ with the time of each part. Angles in degrees."""
    step = float(motion.t[1] - motion.t[0])
    lines = [f"MODULE {_identifier(name)}", "  PROC main()", f"    MoveAbsJ {_target(motion.q[0])}, v50, fine, tool0;"]
    lines += [f"    MoveAbsJ {_target(q)}, v1000 \\T:={step:.9g}, z10, tool0;" for q in motion.q[1:-1]]
    last = f"    MoveAbsJ {_target(motion.q[-1])}, v1000 \\T:={step:.9g}, fine, tool0;"
    return "\n".join([*lines, last, "  ENDPROC", "ENDMODULE", ""])


def _listed(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{x + 0.0:.9f}" for x in values) + "]"


def _axes(q: np.ndarray) -> str:
    return "{" + ", ".join(f"A{k} {x + 0.0:.6f}" for k, x in enumerate(np.degrees(q), 1)) + "}"


def _target(q: np.ndarray) -> str:
    angles = ",".join(f"{x + 0.0:.6f}" for x in np.degrees(q))
    return f"[[{angles}],[9E9,9E9,9E9,9E9,9E9,9E9]]"


def _identifier(name: str) -> str:
    return "excite_" + "".join(c if c.isalnum() else "_" for c in name)
