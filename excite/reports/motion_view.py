"""View of an arm's motion in three dimensions, turned by hand and scrubbed in time: one page without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from excite import trajectories
from excite.model import Model
from excite.reports.html import templates
from excite.simulation import Motion

MOTION_PAGE = "motion.html"
FRAMES_HZ = 25.0  # rate of the poses in a page, which are drawn with straight lines between them
STICK_SHARE = 0.02  # of the arm's reach: radius of a link that has no shape


def motion_scene(model: Model, motion: Motion) -> dict[str, Any]:
    """Return what a page draws of an arm's motion: capsules (ends over time [m]), surroundings, near passes, tool.

    Links without shapes are sticks between the joints' origins.
    """
    rate = float(model.machine.sampling_hz)
    every = max(1, round(rate / FRAMES_HZ))
    at = np.unique([*range(0, len(motion.t), every), len(motion.t) - 1])
    q = motion.q[at]
    x = ca.SX.sym("q", len(model.coordinates))
    machine, world = model.machine, model.machine.world
    pieces = trajectories.placed_shapes(model, x)
    shaped = trajectories.has_shapes(machine)
    points = [end for piece in pieces for end in (piece.ends[0], piece.ends[-1])]
    owners, radius = [piece.owner for piece in pieces], [piece.radius for piece in pieces]
    if not shaped:
        points, owners = _sticks(model, x)
        radius = [STICK_SHARE * _reach(model)] * len(owners)
    places = ca.Function("places", [x], [ca.vertcat(*points)], {"cse": True})(q.T).full().T
    tool = ca.Function("tool", [x], [trajectories.tool_point(machine, model.true_coordinates(x, model.nominal))])
    names, gaps = trajectories.clearances(model, motion.q[at])
    return {
        "title": f"{machine.title}: the motion over {motion.t[-1]:g} s",
        "t": _rounded(motion.t[at]),
        "names": owners,
        "radius": _rounded(np.array(radius)),
        "ends": _rounded(places, 4),
        "tool": _rounded(tool(q.T).full().T, 4),
        "joints": [b.where for b in machine.body if machine.is_free(b) and b.moves_with is None],
        "q": _rounded(_positions(model, q)),
        "turns": [b.joint == "revolute" for b in machine.body if machine.is_free(b) and b.moves_with is None],
        "pairs": [" and ".join(pair) for pair in names],
        "gaps": _rounded(gaps.T, 4),
        "floor": None if world.floor == "none" else float(world.floor),
        "boxes": [{"name": box.name, "low": list(box.low), "high": list(box.high)} for box in world.box],
        "shaped": shaped,
    }


def _sticks(model: Model, x: ca.SX) -> tuple[list[ca.SX], list[str]]:
    """Return both ends of links without shapes, [m] at coordinates x (n_q,), and their bodies' names.

    From joint to joint, from the last joint to its body's centre of mass.
    """
    machine = model.machine
    frames = trajectories.body_frames(machine, model.true_coordinates(x, model.nominal))
    ends: list[ca.SX] = []
    owners = []
    carrying = {b.antecedent for b in machine.body}
    for body in machine.body:
        R, P = frames[body.index]
        if not isinstance(body.antecedent, str):
            ends += [frames[body.antecedent][1], P]
            owners.append(machine.find(body.antecedent).name)
        if body.index not in carrying and body.inertia is not None:
            ends += [P, P + R @ ca.SX(np.array(body.inertia.com.value))]
            owners.append(body.name)
    return ends, owners


def _reach(model: Model) -> float:
    """Return the sum of the distances [m] from joint to joint."""
    return sum(float(np.hypot(float(b.d), float(b.r))) for b in model.machine.body) or 1.0


def _positions(model: Model, q: np.ndarray) -> np.ndarray:
    """Return the positions (N, n) of the joints [deg, mm]."""
    machine = model.machine
    found = []
    for body in machine.body:
        if machine.is_free(body) and body.moves_with is None:
            x = np.asarray(machine.joint_positions(body, q.T), float)
            found.append(np.degrees(x) if body.joint == "revolute" else 1e3 * x)
    return np.column_stack(found)


def _rounded(values: np.ndarray, digits: int = 3) -> list[Any]:
    return list(np.round(values, digits).tolist())


def motion_script() -> str:
    """Return the script that draws scenes on a page, in elements of class `motion` before their data."""
    return Path(__file__).parents[1].joinpath("templates", "motion.js").read_text(encoding="utf-8")


def scene_data(scene: Mapping[str, Any]) -> str:
    """Return a scene as JSON that may stand in a script element."""
    return json.dumps(scene, separators=(",", ":"), ensure_ascii=True).replace("<", "\\u003c")


def write_motion_page(scene: Mapping[str, Any], place: Path) -> Path:
    """Write a scene as a page of its own, MOTION_PAGE, into a folder; return the file."""
    text = (
        templates()
        .get_template("motion.html")
        .render(title=scene["title"], scene=scene_data(scene), scripts=[motion_script()])
    )
    (place / MOTION_PAGE).write_text(text, encoding="utf-8")
    return place / MOTION_PAGE
