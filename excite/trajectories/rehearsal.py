"""What a planned motion does, for whoever stands beside the arm: ranges of joints, course of the tool, near passes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import make_interp_spline

from excite.model import Model
from excite.simulation import Motion, motion_along
from excite.trajectories.clearance import has_shapes, kept_pairs, pairs, tool_point
from excite.trajectories.joint_motion import SPLINE_DEGREE

NEAREST = 3  # pairs of things that are named, the nearest ones


@dataclass(frozen=True)
class PlannedMotion:
    """A motion between its samples q (N, n_q) at times t (N,) [s]: `spline` with its derivatives."""

    model: Model
    t: np.ndarray
    spline: Any

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.t[-1])

    def at(self, rate: float, slower: float = 1.0) -> Motion:
        """Return the motion with its torques at a rate [1/s], `slower` times as slow."""
        count = max(1, round(self.duration * slower * rate))
        t = np.arange(count + 1) / rate
        on = np.minimum(t / slower, self.duration)
        q, nu, a = (np.asarray(self.spline(on, k)) / slower**k for k in range(3))
        return motion_along(self.model, t, q, nu, a)


def planned_motion(model: Model, t: np.ndarray, q: np.ndarray) -> PlannedMotion:
    """Return the motion through samples q (N, n_q) at t (N,) [s]."""
    return PlannedMotion(model, t, make_interp_spline(t, q, k=SPLINE_DEGREE))


@dataclass(frozen=True)
class Extreme:
    """A value and the time [s] at which it is reached."""

    value: float
    at: float


@dataclass(frozen=True)
class JointCourse:
    """A joint's start, lowest and highest position [rad, m], and its highest speed."""

    name: str
    kind: str
    start: float
    low: Extreme
    high: Extreme
    fastest: Extreme


@dataclass(frozen=True)
class NearPass:
    """Two things by name, and the least distance [m] of their shapes."""

    names: tuple[str, str]
    distance: Extreme


@dataclass(frozen=True)
class Rehearsal:
    """What a motion does. tool (N, 3) [m] at times t (N,) [s]; near: nearest first, empty without shapes."""

    t: np.ndarray
    joints: tuple[JointCourse, ...]
    tool: np.ndarray
    tool_speed: Extreme
    near: tuple[NearPass, ...]


def rehearse(model: Model, motion: Motion) -> Rehearsal:
    """Return what a motion does, judged at its samples."""
    q = ca.SX.sym("q", len(model.coordinates))
    t = motion.t
    place = ca.Function("tool", [q], [tool_point(model.machine, model.true_coordinates(q, model.nominal))])
    tool = place(motion.q.T).full().T
    speed = np.linalg.norm(np.gradient(tool, t, axis=0), axis=1)
    joints = []
    for body in model.machine.body:
        if model.machine.is_free(body) and body.moves_with is None:
            x, v = (model.machine.joint_values(body, values.T) for values in (motion.q, motion.nu))
            low, high = (_extreme(t, x, int(i)) for i in (x.argmin(), x.argmax()))
            fastest = _extreme(t, np.abs(v), int(np.abs(v).argmax()))
            joints.append(JointCourse(body.where, body.joint, float(x[0]), low, high, fastest))
    return Rehearsal(t, tuple(joints), tool, _extreme(t, speed, int(speed.argmax())), _near_passes(model, motion))


def _near_passes(model: Model, motion: Motion) -> tuple[NearPass, ...]:
    """Return the NEAREST pairs of shapes with their distance [m], none without shapes."""
    names, gaps = clearances(model, motion.q)
    nearest = [_extreme(motion.t, gap, int(gap.argmin())) for gap in gaps]
    ordered = sorted(zip(names, nearest, strict=True), key=lambda x: x[1].value)
    return tuple(NearPass(pair, gap) for pair, gap in ordered[:NEAREST])


def clearances(model: Model, q: np.ndarray) -> tuple[tuple[tuple[str, str], ...], np.ndarray]:
    """Return the names of each two things that may touch, and distances (k, N) [m] of their shapes at q (N, n_q).

    None without shapes.
    """
    x = ca.SX.sym("q", len(model.coordinates))
    every = pairs(model, x)
    kept = [every[k] for k in kept_pairs(model)] if has_shapes(model.machine) else []
    margin = float(model.machine.world.margin)
    together: dict[tuple[str, str], ca.SX] = {}
    for p in kept:
        gap = p.distance - (p.least - margin)
        together[p.names] = ca.fmin(together[p.names], gap) if p.names in together else gap
    if not together:
        return (), np.zeros((0, len(q)))
    values = ca.Function("gaps", [x], [ca.vertcat(*together.values())], {"cse": True})(q.T).full()
    return tuple(together), np.asarray(values)


def _extreme(t: np.ndarray, values: np.ndarray, k: int) -> Extreme:
    return Extreme(float(values[k]), float(t[k]))
