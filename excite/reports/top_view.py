"""Drawing of a machine from above: bodies, joints, contacts, centres of mass, measuring wheels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from excite.model import mechanics
from excite.model.machine import Body, Machine
from excite.reports.figure_files import layout_width
from excite.reports.figures import COLOURS, is_narrow, new_figure, set_title, wrap_label

POINT_WIDTH = 0.25  # drawn width of a point contact over its radius; chosen
NAME_LETTERS = 16  # of a contact's name in a line; chosen
NEAR_JOINTS = 0.3  # of a machine's length, between joints whose names are written below each other; chosen
FRAME, GHOST = "0.55", "0.6"


def top_view_figure(machine: Machine) -> Figure:
    """Draw the machine in its rest position, and in grey with every steered joint at its stop.

    Raises ValueError for a machine that does not move on the plane.
    """
    if not machine.planar:
        raise ValueError(f"{machine.name}: does not move on the plane, so there is nothing to see from above")
    fig = new_figure(9, layout_width(9) * (0.8 if is_narrow(9) else 2 / 3))
    ax = fig.subplots()
    set_title(fig, machine.title)
    draw_machine(ax, machine)
    return fig


def draw_machine(ax: Axes, machine: Machine) -> None:
    """Draw a machine, forward to the right [m]. Dots are centres of mass, green outlines measuring wheels."""
    at_stop = {b.coordinates[0]: b.limit.reach for b in steered_joints(machine) if b.limit.reach is not None}
    if at_stop:
        _contacts(ax, machine, at_stop, ghost=True)
    poses = mechanics.body_poses(machine, {})
    for b in machine.body:
        x, y = poses[b.index][1][:2]
        if not isinstance(b.antecedent, str):
            x0, y0 = poses[b.antecedent][1][:2]
            ax.plot([x0, x], [y0, y], color=FRAME, linewidth=3, solid_capstyle="round", zorder=2)
    _contacts(ax, machine, {}, ghost=False)
    _joints(ax, machine, poses)
    _masses(ax, machine, poses)
    for shape in _wheels(machine):
        ax.add_patch(Polygon(shape, closed=True, facecolor="none", edgecolor=COLOURS[2], zorder=4))
    ax.set_aspect("equal", adjustable="datalim")
    lines = max((wrap_label(b.where.replace("_", " "), NAME_LETTERS).count("\n") for b in machine.contacts), default=0)
    (left, low), (right, high) = ax.dataLim.get_points()
    names = (0.12 + 0.2 * lines) * (high - low)  # room for them
    ax.update_datalim([(left, low - names), (right, high + names)])
    ax.margins(0.05)
    ax.autoscale_view()
    ax.set_xlabel("x, forward [m]")
    ax.set_ylabel("y, left [m]")
    ax.grid(alpha=0.3)


def steered_joints(machine: Machine) -> list[Body]:
    """Return the driven joints that turn about the vertical."""
    poses = mechanics.body_poses(machine, {})
    driven = [b for b in machine.actuated if b.contact is None and b.joint == "revolute"]
    return [b for b in driven if abs(poses[b.index][0][2, 2]) > 0.9]


def footprints(machine: Machine, q: Mapping[str, float]) -> list[np.ndarray]:
    """Return the corners (4, 2) [m] of every contact on the ground at coordinates q, the root's included.

    A contact is drawn as long as it is high; a point contact is POINT_WIDTH wide.
    """
    poses = mechanics.body_poses(machine, q)
    x, y, heading = (q.get(c, 0.0) for c in machine.body[0].coordinates)
    c, s = np.cos(heading), np.sin(heading)
    shapes = []
    for b in machine.contacts:
        assert b.contact is not None
        assert not isinstance(b.antecedent, str)
        radius = float(b.contact.radius)
        own = _footprint(
            poses[b.antecedent][0], poses[b.index][1], radius, float(b.contact.width) or POINT_WIDTH * radius, 0.0
        )
        shapes.append(own @ np.array([[c, s], [-s, c]]) + [x, y])
    return shapes


def _wheels(machine: Machine) -> list[np.ndarray]:
    """Return the corners (4, 2) [m] of every measuring wheel, with all joints at zero."""
    poses = mechanics.body_poses(machine, {})
    shapes = []
    for s in machine.sensor:
        if s.kind == "wheel":
            assert s.radius is not None
            assert s.lateral is not None
            shapes.append(_footprint(*poses[s.body], float(s.radius), 0.2 * float(s.radius), float(s.lateral)))
    return shapes


def _contacts(ax: Axes, machine: Machine, q: Mapping[str, float], ghost: bool) -> None:
    """Draw contacts as rectangles with names; as ghosts only those that moved."""
    poses, still, wheels = mechanics.body_poses(machine, q), footprints(machine, {}), _wheels(machine)
    for b, shape, before in zip(machine.contacts, footprints(machine, q), still, strict=True):
        place = poses[b.index][1]
        if ghost and np.allclose(shape, before):
            continue
        if ghost:
            ax.add_patch(Polygon(shape, closed=True, facecolor="none", edgecolor=GHOST, linestyle="--", zorder=4))
            continue
        driven = b.actuated or b.driven_with or b.moves_with
        ax.add_patch(
            Polygon(shape, closed=True, facecolor="white" if driven else "0.9", edgecolor="black", alpha=0.9, zorder=3)
        )
        left = place[1] > -1e-6
        outline = np.concatenate([shape, *(w for w in wheels if w[:, 0].min() < place[0] < w[:, 0].max())])
        ax.annotate(
            wrap_label(b.where.replace("_", " ") + ("" if driven else " (not driven)"), NAME_LETTERS),
            (place[0], outline[:, 1].max() if left else outline[:, 1].min()),
            xytext=(0, 2 if left else -2),
            textcoords="offset points",
            ha="center",
            va="bottom" if left else "top",
            fontsize=8,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
            zorder=7,
        )


def _footprint(turned: np.ndarray, place: np.ndarray, radius: float, width: float, lateral: float) -> np.ndarray:
    """Return the corners (4, 2) [m] of a wheel at `place`, shifted left by `lateral`, in the frame `turned`."""
    corners = np.array([[x * radius, lateral + y * width / 2, 0] for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))])
    return np.asarray((corners @ turned.T + place)[:, :2])


def _joints(ax: Axes, machine: Machine, poses: Mapping[int, tuple[np.ndarray, np.ndarray]]) -> None:
    taken: list[np.ndarray] = []
    length = float(np.ptp([place[0] for _, place in poses.values()]))
    for b in machine.body:
        if b.contact is not None or b.joint in ("planar", "fixed"):
            continue
        place = poses[b.index][1][:2]
        held = b.coordinates[0] in machine.locked
        ax.plot(*place, "s" if held else "o", markersize=8, color="white", markeredgecolor=COLOURS[1], zorder=6)
        words = b.where.replace("_", " ") + (
            " (held)" if held else "" if b.actuated or b.driven_with or b.moves_with else " (free)"
        )
        row = sum(np.allclose(place, other, atol=NEAR_JOINTS * length) for other in taken)
        taken.append(place)
        ax.annotate(
            words,
            (float(place[0]), float(place[1])),
            xytext=(0, -10 - 9 * row),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=8,
            color=COLOURS[1],
            zorder=7,
        )


def _masses(ax: Axes, machine: Machine, poses: Mapping[int, tuple[np.ndarray, np.ndarray]]) -> None:
    """Mark the centres of mass; larger marks are heavier bodies."""
    bodies = [b for b in machine.body if b.inertia is not None]
    most = max(float(b.inertia.mass) for b in bodies if b.inertia is not None) if bodies else 1.0
    for b in bodies:
        assert b.inertia is not None
        turned, place = poses[b.index]
        x, y, _ = place + turned @ np.array(b.inertia.com.value)
        size = 4 + 8 * float(np.sqrt(float(b.inertia.mass) / most))
        ax.plot(x, y, "o", markersize=size, color=COLOURS[0], alpha=0.35, zorder=5)
        ax.plot(x, y, "+", markersize=size, color=COLOURS[0], zorder=5)
