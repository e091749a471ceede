"""Hand-overs and rehearsals in words."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from excite.reports.description import Description, Summary, Table
from excite.text import format_number
from excite.trajectories import JointCourse, Rehearsal

STEPS = 8  # stretches of time in which the course of the tool is told


def rehearsal_words(found: Rehearsal) -> list[str]:
    """Return what a motion does, a sentence each: joints, then the tool in stretches of time, then near passes."""
    end = float(found.t[-1])
    low, high = found.tool.min(axis=0), found.tool.max(axis=0)
    box = ", ".join(f"{axis} {a:.2f} to {b:.2f} m" for axis, a, b in zip("xyz", low, high, strict=True))
    words = [
        f"In {format_number(end, 4)} s the tool's point moves within {box} (axes of the base); its highest speed is"
        f" {found.tool_speed.value:.2f} m/s at {found.tool_speed.at:.1f} s."
    ]
    words += [_joint_words(joint) for joint in found.joints]
    words += [
        f"{found.t[a]:.1f} to {found.t[b]:.1f} s: the tool goes {_way(found.tool[a], found.tool[b])}."
        for a, b in pairwise(np.linspace(0, len(found.t) - 1, STEPS + 1).astype(int))
    ]
    for near in found.near:
        gap = near.distance
        words.append(f"{near.names[0]} and {near.names[1]} come within {1000 * gap.value:.0f} mm at {gap.at:.1f} s.")
    return words


def _joint_words(joint: JointCourse) -> str:
    turns = joint.kind == "revolute"

    def said(x: float) -> str:
        return f"{math.degrees(x):.0f} deg" if turns else f"{x:.3f} m"

    return (
        f"{joint.name} starts at {said(joint.start)}, moves between {said(joint.low.value)} (at {joint.low.at:.1f} s)"
        f" and {said(joint.high.value)} (at {joint.high.at:.1f} s), {said(joint.fastest.value)}/s at most"
        f" (at {joint.fastest.at:.1f} s)."
    )


def _way(start: np.ndarray, end: np.ndarray) -> str:
    """Say where the tool goes: by how much along each axis that counts, and where it is then."""
    words = {0: ("forward (+x)", "back (-x)"), 1: ("left (+y)", "right (-y)"), 2: ("up", "down")}
    moved = end - start
    parts = [
        f"{abs(moved[k]):.2f} m {words[k][0 if moved[k] > 0 else 1]}"
        for k in np.argsort(-np.abs(moved))
        if abs(moved[k]) > 0.3 * np.abs(moved).max() and abs(moved[k]) >= 0.01
    ]
    where = f"({', '.join(f'{x:.2f}' for x in end)}) m"
    return f"{', '.join(parts)}, to {where}" if parts else f"nowhere far, it ends at {where}"


def describe_handover(s: Summary) -> Description:
    """Describe a hand-over: the first word on safety, files, what will move where."""
    seen = "" if s["collisions_looked_at"] else "Collisions were not looked at (the machine file has no shapes). "
    slow = "" if s["slower"] == 1 else f", {s['slower']:g} times as slow as designed"
    headline = (
        f"{seen}The motion takes {format_number(s['duration_s'], 4)} s{slow}; stand clear, and run it slowly first"
        " (`--slower 10`)."
    )
    start = ", ".join(
        f"{c} {math.degrees(x):.1f} deg" if c.startswith("theta") else f"{c} {x:.3f} m" for c, x in s["start"].items()
    )
    remarks = [f"Bring the arm to the start first: {start}.", *s["words"]]
    table = Table("Files.", ("file", "what it is"), tuple(s["files"].items()))
    return Description(f"Hand-over of {s['design']} for {s['machine']}", headline, (table,), tuple(remarks))
