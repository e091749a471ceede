"""A drive as numbers: piecewise linear torques, states at collocation points, and all their derivatives.

Radau IIA collocation (degree 3) on every interval between two torque knots: stiffly accurate, made for the contact's
1500 1/s near standstill. Physics, limits and information are CasADi expressions of one sample, mapped over all nodes;
their exact first and second derivatives come out as plain arrays. Every variable is scaled to O(1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from excite.errors import CollocationError
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion
from excite.trajectories.limits import (
    REST_POSITION,
    Limit,
    Symbols,
    machine_limits,
    of_lane,
    rest_tolerances,
    resting,
    symbols,
)

DEGREE = 3
STILL = 0.25  # of the tolerance for rest at the end is used
SETTLED = 1e-7  # residual of the equations of motion, scaled
FAR = 1e3  # stands for no bound, in half ranges


def _view(array: Any) -> memoryview:
    return memoryview(array)


class Mapped:
    """A CasADi function of one sample, evaluated over N samples: arrays (N, n) in, (N, rows...) out."""

    def __init__(self, function: ca.Function, samples: int, shapes: Sequence[tuple[int, ...]]) -> None:
        self._function = function.map(samples)
        self._buffer, self._run = self._function.buffer()
        self._results = [np.zeros((samples, *shape)) for shape in shapes]
        for k, result in enumerate(self._results):
            self._buffer.set_res(k, _view(result))

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        held = [np.ascontiguousarray(a, float) for a in arguments]
        for k, a in enumerate(held):
            if a.size:  # memory that isn't there may seem to lie in CasADi's own
                self._buffer.set_arg(k, _view(a))
        self._run()
        return [r.copy() for r in self._results]


@dataclass(frozen=True)
class Transcription:
    """The nonlinear program's data. K intervals, J nodes in each, states z (n_z,), torques u (n_u,).

    A node's sample is s = (z, dz/dt, u), all scaled; `spread` (J, n_s, n_z + J n_z + 2 n_u) makes it from an interval's
    left state, node states, left and right torque. over (K J, n_over): what a map of the ground tells at the nodes,
    which is taken as known. Functions of a sample and of that: residual (n_z,) of the equations of motion,
    limits (n_g,) scaled to -1..1, entries (n_a,) of the information matrices on and above their diagonals, one matrix
    after the other; `weight` (K J,) sums them as if over every sample of a motion.
    """

    intervals: int
    nodes: int
    knot: float
    state_names: tuple[str, ...]
    state_scale: np.ndarray
    torque_scale: np.ndarray
    derivative: np.ndarray
    place: np.ndarray
    weight: np.ndarray
    limit_names: tuple[str, ...]
    floor: np.ndarray
    control_names: tuple[str, ...]
    control: np.ndarray
    control_centre: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    size: int
    blocks: int
    at_rest: np.ndarray
    band: np.ndarray
    loose: np.ndarray
    spread: np.ndarray
    over: np.ndarray
    values: Mapped = field(repr=False)
    first: Mapped = field(repr=False)
    second: Mapped = field(repr=False)
    step: Mapped = field(repr=False)

    @property
    def n_z(self) -> int:
        return len(self.state_names)

    @property
    def n_u(self) -> int:
        return len(self.torque_scale)

    @property
    def n_s(self) -> int:
        return 2 * self.n_z + self.n_u

    def samples(self, start: np.ndarray, Z: np.ndarray, U: np.ndarray) -> np.ndarray:
        """(K J, n_s): what every node sees of states Z (K, J, n_z), torques U (K + 1, n_u) and the start (n_z,)."""
        left = np.concatenate([start[None], Z[:-1, -1]])[:, None]
        along = np.concatenate([left, Z], axis=1)
        rate = np.einsum("ji,kin->kjn", self.derivative, along)
        u = U[:-1, None] * (1 - self.place)[:, None] + U[1:, None] * self.place[:, None]
        return np.concatenate([Z, rate, u], axis=2).reshape(-1, self.n_s)

    @property
    def n_a(self) -> int:
        return len(self.rows) * self.blocks

    def matrices(self, entries: np.ndarray) -> np.ndarray:
        """The information matrices (n_blocks, n, n) of their entries (n_a,)."""
        A = np.zeros((self.blocks, self.size, self.size))
        each = entries.reshape(self.blocks, -1)
        A[:, self.rows, self.columns] = each
        A[:, self.columns, self.rows] = each
        return A


def _spread(place: np.ndarray, derivative: np.ndarray, n_z: int, n_u: int) -> np.ndarray:
    """(J, n_s, n_z + J n_z + 2 n_u): samples of the nodes from (left state, node states, left and right torque)."""
    J = len(place)
    L = np.zeros((J, 2 * n_z + n_u, n_z + J * n_z + 2 * n_u))
    for j in range(J):
        L[j, :n_z, n_z * (j + 1) : n_z * (j + 2)] = np.eye(n_z)
        L[j, n_z : 2 * n_z, : n_z * (J + 1)] = np.kron(derivative[j], np.eye(n_z))
        L[j, 2 * n_z :, n_z * (J + 1) :] = np.kron([1 - place[j], place[j]], np.eye(n_u))
    return L


def settle(tr: Transcription, start: np.ndarray, U: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Node states (K, J, n_z) that the torques U (K + 1, n_u) lead to: Newton's method interval by interval.

    Raises UnsettledError where it fails from the guess and from rest on the left state.
    """
    Z = np.empty_like(guess)
    left = start
    for k in range(tr.intervals):
        u, over = U[k : k + 2].ravel(), tr.over[k * tr.nodes : (k + 1) * tr.nodes]
        x, size = _follow(tr, left, guess[k].ravel(), u, over)
        if size > SETTLED:
            x, size = _follow(tr, left, np.tile(left, tr.nodes), u, over)
        if size > SETTLED:
            raise CollocationError(f"no motion follows these torques in interval {k} (residual {size:.1e})")
        Z[k] = x.reshape(tr.nodes, tr.n_z)
        left = Z[k, -1]
    return Z


def _follow(
    tr: Transcription, left: np.ndarray, x: np.ndarray, u: np.ndarray, over: np.ndarray
) -> tuple[np.ndarray, float]:
    """Node states (J n_z,) of one interval and the largest residual, by Newton's method with step halving."""
    n_z, J = tr.n_z, tr.nodes
    L, inner = tr.spread, tr.spread[:, :, n_z : n_z * (J + 1)]
    known = L @ np.concatenate([left, np.zeros(J * n_z), u])
    c, slope = tr.step(known + inner @ x, over)
    size = float(np.abs(c).max())
    for _ in range(25):
        if size < 1e-9:
            break
        dx = np.linalg.solve(np.matmul(slope, inner).reshape(J * n_z, -1), -c.ravel())
        share = 1.0
        for _ in range(8):
            c, slope = tr.step(known + inner @ (x + share * dx), over)
            trial = float(np.abs(c).max())
            if trial < size:
                break
            share *= 0.5
        x, size = x + share * dx, trial
        if not np.isfinite(size):
            return x, np.inf
    return x, size


def radau(elements: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes (J,) in 0..1, differentiation matrix (J, J + 1) on (left end, nodes) and weights (J,), J = 3 elements."""
    tau = np.array([0.0, *ca.collocation_points(DEGREE, "radau")])
    polynomials = [
        np.poly1d(np.poly(np.delete(tau, i)) / np.prod(tau[i] - np.delete(tau, i))) for i in range(DEGREE + 1)
    ]
    D = np.array([[p.deriv()(x) for p in polynomials] for x in tau[1:]])
    V = np.vander(tau[1:], increasing=True).T
    b = np.linalg.solve(V, 1 / np.arange(1, DEGREE + 1))
    J = DEGREE * elements
    derivative = np.zeros((J, J + 1))
    for e in range(elements):
        derivative[e * DEGREE : (e + 1) * DEGREE, e * DEGREE : (e + 1) * DEGREE + 1] = D * elements
    place = np.concatenate([(e + tau[1:]) / elements for e in range(elements)])
    return place, derivative, np.tile(b / elements, elements)


def transcribe(
    model: Model,
    problem: Problem,
    state_size: Mapping[str, float],
    intervals: int,
    motion: Motion,
    elements: int = 1,
    with_pose: bool = False,
    rest: float = 1.0,
    weights: np.ndarray | None = None,
) -> Transcription:
    """The nonlinear program of a problem on `intervals` equal intervals, each of `elements` collocation elements.

    state_size: the typical size of every coordinate and velocity (named c and c') and of what effects remember. motion:
    one nearby, from which what a map of the ground tells is taken. The pose is a state only where `with_pose`: nothing
    but the lane depends on it. weights (n_blocks, n_rows): of the regressor's rows [1/SI], one information matrix for
    each; all 1 by default, none for a program without an aim.
    """
    every = machine_limits(model, problem)
    s = symbols(model)
    moved = _depends(every, s, ca.vertcat(s.q, s.nu))
    deferred = set() if with_pose else {g.name for g in every if of_lane(g.name)}
    staged = [g for g in every if g.name in moved and g.name not in deferred]
    steered = [g for g in every if g.name not in moved and g.name not in deferred]
    pose = model.machine.body[0].coordinates if with_pose else ()
    needed = {*pose, *model.active_coordinates, *(model.coordinates[k] for k in resting(model))}
    used = [c for c in model.coordinates if c in needed]
    names = (*used, *[c + "'" for c in model.coordinates], *model.memory[: model.n_dynamic_memory])
    z_size = np.array([state_size[c] for c in names])
    u_size = np.array([float(b.limit.torque) if b.limit.torque is not None else 1.0 for b in model.machine.actuated])
    knot = float(problem.duration_s) / intervals
    place, derivative, weight = radau(elements)

    n_z, n_q, n_u = len(names), len(model.coordinates), len(u_size)
    sample = ca.SX.sym("s", 2 * n_z + n_u)
    z = sample[:n_z] * ca.DM(z_size)
    rate = sample[n_z : 2 * n_z] * ca.DM(z_size) / knot
    u = sample[2 * n_z :] * ca.DM(u_size)
    q = ca.SX(n_q, 1)
    for k, c in enumerate(used):
        q[model.coordinates.index(c)] = z[k]
    memory = len(used) + n_q
    nu, a = (ca.vertcat(*ca.vertsplit(x)[len(used) : memory]) for x in (z, rate))
    kept, kept_rate = (ca.vertcat(*ca.vertsplit(x)[memory:], ca.SX(0, 1)) for x in (z, rate))
    over = ca.SX.sym("over", len(model.map_inputs))
    beside = () if model.plain else (u, ca.vertcat(kept, over))
    p = model.expand @ model.nominal
    drive = ca.SX(n_q, 1)
    for k, row in enumerate(model.actuated):
        drive[row] = u[k]
    dq = model.kinematics(q, nu)[0]
    turns = [(rate[k] - dq[model.coordinates.index(c)]) * knot / z_size[k] for k, c in enumerate(used)]
    flow = model.flow(q, nu, u, ca.vertcat(kept, over), model.nominal)[: len(names) - memory]
    going = (kept_rate - flow) * knot / ca.DM(z_size[memory:])
    balance = (model.balance(q, nu, a, p, *beside) - drive) / float(u_size.max())
    residual = ca.vertcat(*turns, balance, going)
    g = ca.vertcat(*[(g.expression(q, nu, u, 0) - g.centre) * (2 / g.range) for g in staged], ca.SX(0, 1))
    W = model.regressor(q, nu, a, *beside)
    Phi = ca.mtimes(W, ca.diag(ca.DM(model.scale)))
    blocks = np.ones((1, n_q)) if weights is None else weights
    every_A = [ca.triu(ca.mtimes(P.T, P)) for P in (ca.mtimes(ca.diag(ca.DM(w)), Phi) for w in blocks)]
    rows, columns = (np.array(x) for x in ca.triu(ca.mtimes(Phi.T, Phi)).sparsity().get_triplet())
    entries = ca.vertcat(*[x for A in every_A for x in A.nonzeros()], ca.SX(0, 1))

    n_s, n_g, n_a = 2 * n_z + n_u, g.numel(), entries.numel()
    multipliers = ca.SX.sym("m", n_z + n_g + n_a)
    lagrangian = ca.dot(multipliers, ca.vertcat(residual, g, entries))
    H, _ = ca.hessian(lagrangian, sample)
    N = intervals * len(place)
    samples = float(problem.duration_s) * float(model.machine.sampling_hz)
    options = {"cse": True}
    values = ca.Function("values", [sample, over], [residual, g, entries], options)
    slopes = [ca.densify(ca.jacobian(x, sample).T) for x in (residual, g, entries)]
    first = ca.Function("first", [sample, over], [residual, g, entries, *slopes], options)
    second = ca.Function("second", [sample, over, multipliers], [ca.densify(H)], options)

    nodes = ((np.arange(intervals)[:, None] + place) * knot).ravel()
    told = motion.memory[:, model.n_dynamic_memory :]
    control, centre = _control(steered, s, u_size, knot)
    resting_states = [names.index(model.coordinates[k]) for k in resting(model)] + [
        names.index(c + "'") for c in model.coordinates
    ]
    still = np.concatenate([np.full(len(resting(model)), REST_POSITION), rest_tolerances(model)])
    at_rest = np.array(resting_states if problem.rest else [], int)
    band = (rest * STILL * still / z_size[resting_states])[: len(at_rest)]
    return Transcription(
        intervals,
        len(place),
        knot,
        names,
        z_size,
        u_size,
        derivative,
        place,
        np.tile(weight, intervals) / intervals * samples,
        tuple(x.name for x in staged),
        np.array([-1.0 if np.isfinite(x.low) else -FAR for x in staged]),
        tuple(x.name for x in steered),
        control,
        centre,
        rows,
        columns,
        len(model.scale),
        len(blocks),
        at_rest,
        band,
        np.array([k for k, c in enumerate(names) if c in pose and k not in resting_states], int),
        _spread(place, derivative, n_z, n_u),
        np.array([np.interp(nodes, motion.t, x) for x in told.T]).T.reshape(N, -1),
        Mapped(values, N, [(n_z,), (n_g,), (n_a,)]),
        Mapped(first, N, [(n_z,), (n_g,), (n_a,), (n_z, n_s), (n_g, n_s), (n_a, n_s)]),
        Mapped(second, N, [(n_s, n_s)]),
        Mapped(ca.Function("step", [sample, over], [residual, slopes[0]], options), len(place), [(n_z,), (n_z, n_s)]),
    )


def _depends(every: Sequence[Limit], s: Symbols, on: ca.SX) -> set[str]:
    """Names of the limits whose expression depends on any of these symbols."""
    return {g.name for g in every if any(ca.which_depends(g.expression(s.q, s.nu, s.u, s.du), on, 1, True))}


def _control(steered: Sequence[Limit], s: Symbols, u_size: np.ndarray, knot: float) -> tuple[np.ndarray, np.ndarray]:
    """Limits on torques alone as rows (n_c, 2 n_u) on the scaled torques of both ends, scaled to -1..1."""
    n_u = len(u_size)
    rows, centres = [], []
    for g in steered:
        e = g.expression(s.q, s.nu, s.u, s.du)
        slope = ca.Function("slope", [s.u, s.du], [ca.jacobian(e, s.u), ca.jacobian(e, s.du)])
        by_u, by_du = (x.full().ravel() for x in slope(0, 0))
        rows.append(np.concatenate([-by_du / knot, by_u + by_du / knot]) * np.tile(u_size, 2) * 2 / g.range)
        centres.append(-2 * g.centre / g.range)
    return np.array(rows).reshape(-1, 2 * n_u), np.array(centres)
