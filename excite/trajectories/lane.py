"""Where a drive lies on the ground: turned and shifted into its lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, simulate
from excite.trajectories.limits import polygon_edges

HEADINGS = 361  # headings tried on the lane, half a degree apart in a box; chosen


def place_on_lane(model: Model, problem: Problem, motion: Motion) -> np.ndarray:
    """Return start coordinates (n_q,) that turn and shift the drive into the lane as well as possible."""
    if not model.machine.planar or not problem.lane_points:
        return motion.q[0].copy()
    path = _lane_path(model, problem, motion)
    fit = _fit_polygon if problem.lane_polygon_m else _fit_box
    best, chosen = np.inf, (0.0, np.zeros(2))
    whole = 2 * np.pi if problem.lane_polygon_m else np.pi  # a box is symmetric under half a turn
    for turn in np.linspace(0, whole, HEADINGS)[:-1] if model.heading is not None else (0.0,):
        excess, shift = fit(problem, _turned(path, turn))
        if excess < best - 1e-9:
            best, chosen = excess, (float(turn), shift)
    return _moved_start(model, motion, *chosen)


def place_along_lane(model: Model, problem: Problem, motions: Sequence[Motion]) -> np.ndarray | None:
    """Return start coordinates (n_q,) that point along the lane and from which every motion stays in the lane.

    motions: drives with a common start. None if they leave the lane from every such start, if the machine does not
    turn on the plane, and if forces depend on the place.
    """
    first, frame = motions[0], model.machine.body[0].coordinates
    if not model.machine.planar or not problem.lane_points or not set(frame) <= set(model.coordinates):
        return None
    if set(frame) & set(model.active_coordinates):
        return None
    path = np.hstack([_lane_path(model, problem, m) for m in motions])
    fit = _fit_polygon if problem.lane_polygon_m else _fit_box
    heading = float(first.q[0, model.coordinates.index(frame[2])])
    for goal in (0.0, np.pi):
        excess, shift = fit(problem, _turned(path, goal - heading))
        if excess <= 0:
            return _moved_start(model, first, goal - heading, shift)
    return None


def move_motion(model: Model, motion: Motion, start: np.ndarray) -> Motion:
    """Turn and shift a motion over the ground, to begin at the place and heading of `start` (n_q,)."""
    names = model.machine.body[0].coordinates
    x, y, head = (model.coordinates.index(c) if c in model.coordinates else None for c in names)
    q = motion.q.copy()
    turn = 0.0 if head is None else float(start[head] - q[0, head])
    flat = np.array([q[:, k] if k is not None else np.zeros(len(q)) for k in (x, y)])
    flat = _turned(flat - flat[:, :1], turn)
    for k, values in zip((x, y), flat, strict=True):
        if k is not None:
            q[:, k] = values + start[k]
    if head is not None:
        q[:, head] += turn
    return replace(motion, q=q)


def _lane_path(model: Model, problem: Problem, motion: Motion) -> np.ndarray:
    """Return the ground track (2, K) [m] of all points that the lane limits."""
    q = model.true_coordinates(motion.q, model.nominal)
    places = model.kinematics(q.T, motion.nu.T)[3].full().reshape(3, len(motion.t), -1)
    bodies = [b.index for b in model.machine.body]
    return np.asarray(places[:2][:, :, [bodies.index(i) for i in problem.lane_points]].reshape(2, -1))


def _turned(path: np.ndarray, turn: float) -> np.ndarray:
    """Turn points (2, K) about the origin by an angle [rad]."""
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(np.array([[c, -s], [s, c]]) @ path)


def _moved_start(model: Model, motion: Motion, turn: float, shift: np.ndarray) -> np.ndarray:
    """Return the start coordinates (n_q,) of a motion turned about the origin [rad], then shifted (2,) [m]."""
    start = motion.q[0].copy()
    axes = {c: model.coordinates.index(c) for c in model.machine.body[0].coordinates if c in model.coordinates}
    x, y, heading = model.machine.body[0].coordinates
    at = np.array([[start[axes[c]] if c in axes else 0.0] for c in (x, y)])
    moved = _turned(at, turn)[:, 0] + shift
    for k, name in enumerate((x, y)):
        if name in axes:
            start[axes[name]] = moved[k]
    if heading in axes:
        start[axes[heading]] += turn
    return start


def simulate_on_lane(model: Model, problem: Problem, torque: np.ndarray, nu0: np.ndarray | None = None) -> Motion:
    """Simulate torques (N, n_u) [N m] from where the drive lies on the lane as well as possible.

    nu0 (n_q,): velocities at the start, rest by default. Raises SimulationError.
    """
    motion = simulate(model, torque, nu0=nu0)
    start = place_on_lane(model, problem, motion)
    return motion if np.array_equal(start, motion.q[0]) else simulate(model, torque, q0=start, nu0=nu0)


def _fit_box(problem: Problem, path: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the share of the lane that a path (2, K) needs beyond it, and the shift (2,) [m] that centres it."""
    low, high = path.min(axis=1), path.max(axis=1)
    return float(((high - low) / np.array(problem.lane)).max()) - 1, -(low + high) / 2


def _fit_polygon(problem: Problem, path: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the largest excess over box and polygon and the shift (2,) [m] that minimises it (linear program)."""
    x, y = problem.lane[0] / 2, problem.lane[1] / 2
    box = [(x, y), (-x, y), (-x, -y), (x, -y)] if problem.lane_m else []
    sides = polygon_edges(box) + polygon_edges(problem.lane_polygon_m)
    rows = [[*outward / (high - low), -1.0] for outward, low, high in sides]
    most = [(high - float((outward @ path).max())) / (high - low) for outward, low, high in sides]
    found = scipy.optimize.linprog([0, 0, 1], A_ub=rows, b_ub=most, bounds=[(None, None)] * 3)
    shift = np.asarray(found.x)
    return float(shift[2]), shift[:2]
