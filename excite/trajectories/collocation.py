"""Direct collocation of a drive: piecewise linear torques and states at collocation points, with exact derivatives.

Every torque interval has Radau IIA nodes of degree 3, which are stiffly accurate: contacts are as fast as 1500 1/s near
standstill. Physics, limits and information are CasADi expressions of one sample, mapped over all nodes. Variables are
scaled to about one.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from excite.errors import CollocationError
from excite.model import Model
from excite.model.machine import Machine, Problem
from excite.simulation import Motion
from excite.trajectories.limits import (
    REST_POSITION,
    Limit,
    SampleSymbols,
    is_lane_limit,
    machine_limits,
    rest_tolerances,
    resting_coordinates,
    sample_symbols,
)

DEGREE = 3  # of the state polynomials: Radau IIA of order 5
REST_SHARE = 0.25  # share of the tolerance for rest that the program uses, as the simulation differs; chosen
MAX_RESIDUAL = 1e-7  # accepted residual of the equations of motion, scaled; chosen
SMALL_RESIDUAL = 1e-9  # residual, scaled, at which Newton's method ends; chosen
MAX_JOINT_STEPS = 12  # of Newton's method in all intervals at once; chosen
SLOW = 0.1  # ratio of successive residuals above which the slope is computed anew; chosen
NO_BOUND = 1e3  # half ranges, in place of an infinite bound; chosen


def _view(array: Any) -> memoryview:
    return memoryview(array)


class MappedFunction:
    """CasADi function of one sample, evaluated over N samples: arrays (N, n) to (N, rows...)."""

    def __init__(self, function: ca.Function, samples: int, shapes: Sequence[tuple[int, ...]]) -> None:
        self._function = function.map(samples)
        self._buffer, self._run = self._function.buffer()
        self._results = [np.zeros((samples, *shape)) for shape in shapes]
        for k, result in enumerate(self._results):
            self._buffer.set_res(k, _view(result))

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        held = [np.ascontiguousarray(a, float) for a in arguments]
        for k, a in enumerate(held):
            if a.size:  # CasADi may mistake an empty array for its own memory
                self._buffer.set_arg(k, _view(a))
        self._run()
        return [r.copy() for r in self._results]


@dataclass(frozen=True)
class Transcription:
    """Data of the nonlinear program: K intervals with J nodes each, states z (n_z,), torques u (n_u,).

    The sample of a node is s = (z, dz/dt, u), scaled.

    interval_s [s]; state_scale (n_z,), torque_scale (n_u,): units of the scaled variables.
    derivative (J, J + 1), node_position (J,) in 0..1, weight (K J,): the collocation scheme. `weight` sums over nodes
        as over the samples of a motion.
    lower_bound (n_g,): of the scaled limits. torque_rows (n_c, 2 n_u), torque_centre (n_c,): limits on torques alone.
    rows, columns: non-zero entries of an information matrix on and above its diagonal; `blocks` matrices.
    rest_states, rest_band: states that are zero at the end, and their tolerance. free_states: states free at the start.
    sample_map (J, n_s, n_z + J n_z + 2 n_u): samples from an interval's left state, node states, left and right torque.
    map_values (K J, n_over): values of a map of the ground at the nodes, taken as known.
    entry_of, entry_by (n_d,): entry and component of s of each derivative of the entries that can be non-zero, by
        component.
    values: (s, map values) to the residual (n_z,) of the equations of motion, limits (n_g,) scaled to -1..1 and entries
        (n_a,) of the information matrices. first_derivatives, lagrangian_hessian: their derivatives, of the entries
        the n_d non-zero ones.
    residual: (s, map values) to the residual alone; residual_slope: with its slope (n_z, n_s); interval_slope: the
        same for the samples of one interval.
    """

    intervals: int
    nodes: int
    interval_s: float
    state_names: tuple[str, ...]
    state_scale: np.ndarray
    torque_scale: np.ndarray
    derivative: np.ndarray
    node_position: np.ndarray
    weight: np.ndarray
    limit_names: tuple[str, ...]
    lower_bound: np.ndarray
    torque_limit_names: tuple[str, ...]
    torque_rows: np.ndarray
    torque_centre: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    matrix_size: int
    blocks: int
    rest_states: np.ndarray
    rest_band: np.ndarray
    free_states: np.ndarray
    sample_map: np.ndarray
    map_values: np.ndarray
    entry_of: np.ndarray
    entry_by: np.ndarray
    values: MappedFunction = field(repr=False)
    first_derivatives: MappedFunction = field(repr=False)
    lagrangian_hessian: MappedFunction = field(repr=False)
    residual: MappedFunction = field(repr=False)
    residual_slope: MappedFunction = field(repr=False)
    interval_slope: MappedFunction = field(repr=False)

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
        """Return the samples (K J, n_s) of all nodes.

        start (n_z,); Z (K, J, n_z): node states; U (K + 1, n_u): torques.
        """
        left = np.concatenate([start[None], Z[:-1, -1]])[:, None]
        along = np.concatenate([left, Z], axis=1)
        rate = np.einsum("ji,kin->kjn", self.derivative, along)
        u = U[:-1, None] * (1 - self.node_position)[:, None] + U[1:, None] * self.node_position[:, None]
        return np.concatenate([Z, rate, u], axis=2).reshape(-1, self.n_s)

    @property
    def n_a(self) -> int:
        return len(self.rows) * self.blocks

    def matrices(self, entries: np.ndarray) -> np.ndarray:
        """Return the information matrices (n_blocks, n, n) from their entries (n_a,)."""
        A = np.zeros((self.blocks, self.matrix_size, self.matrix_size))
        each = entries.reshape(self.blocks, -1)
        A[:, self.rows, self.columns] = each
        A[:, self.columns, self.rows] = each
        return A

    def interval_slopes(self, slopes: np.ndarray) -> np.ndarray:
        """Return slopes (K, J m, n_z + J n_z + 2 n_u) by what `sample_map` takes.

        slopes (K J, m, n_s): by the node samples.
        """
        K, J = self.intervals, self.nodes
        each = np.matmul(slopes.reshape(K, J, -1, self.n_s), self.sample_map)
        return each.reshape(K, -1, self.sample_map.shape[2])

    def entry_slopes(self, derivatives: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return the slopes (K J, n_s, m) of by' a, a (n_a,) the entries at a node.

        derivatives (K J, n_d): of the entries. by (n_a, m).
        """
        slopes = np.zeros((len(derivatives), self.n_s, by.shape[1]))
        ends = np.searchsorted(self.entry_by, np.arange(self.n_s + 1))
        for k, (first, last) in enumerate(itertools.pairwise(ends)):
            slopes[:, k] = derivatives[:, first:last] @ by[self.entry_of[first:last]]
        return slopes


def _sample_map(node_position: np.ndarray, derivative: np.ndarray, n_z: int, n_u: int) -> np.ndarray:
    """Build the map (J, n_s, n_z + J n_z + 2 n_u) to node samples; see `Transcription`."""
    J = len(node_position)
    L = np.zeros((J, 2 * n_z + n_u, n_z + J * n_z + 2 * n_u))
    for j in range(J):
        L[j, :n_z, n_z * (j + 1) : n_z * (j + 2)] = np.eye(n_z)
        L[j, n_z : 2 * n_z, : n_z * (J + 1)] = np.kron(derivative[j], np.eye(n_z))
        L[j, 2 * n_z :, n_z * (J + 1) :] = np.kron([1 - node_position[j], node_position[j]], np.eye(n_u))
    return L


def solve_states(tr: Transcription, start: np.ndarray, U: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Solve the equations of motion for the node states (K, J, n_z) under torques U (K + 1, n_u).

    First in all intervals at once. A guess that is too far from a motion for that is solved interval by interval.
    Raises CollocationError if Newton's method fails both from the guess and from a constant state.
    """
    together = _solve_together(tr, start, U, guess)
    if together is not None:
        return together
    Z = np.empty_like(guess)
    left = start
    for k in range(tr.intervals):
        u, map_values = U[k : k + 2].ravel(), tr.map_values[k * tr.nodes : (k + 1) * tr.nodes]
        x, size = _solve_interval(tr, left, guess[k].ravel(), u, map_values)
        if size > MAX_RESIDUAL:
            x, size = _solve_interval(tr, left, np.tile(left, tr.nodes), u, map_values)
        if size > MAX_RESIDUAL:
            raise CollocationError(f"no motion follows these torques in interval {k} (residual {size:.1e})")
        Z[k] = x.reshape(tr.nodes, tr.n_z)
        left = Z[k, -1]
    return Z


def _solve_together(tr: Transcription, start: np.ndarray, U: np.ndarray, Z: np.ndarray) -> np.ndarray | None:
    """Solve all intervals by Newton's method with an old slope as long as it serves; None if the residual grows."""
    K, n = tr.intervals, tr.nodes * tr.n_z
    steps: tuple[np.ndarray, np.ndarray] | None = None
    before = np.inf
    for _ in range(MAX_JOINT_STEPS):
        s = tr.samples(start, Z, U)
        (c,) = tr.residual(s, tr.map_values)
        size = float(np.abs(c).max(initial=0.0))
        if size < SMALL_RESIDUAL:
            return Z
        if not size < before:
            return None
        if steps is None or size > SLOW * before:
            try:
                steps = _interval_steps(tr, s)
            except np.linalg.LinAlgError:
                return None
        inverse, onward = steps
        dZ = -np.matmul(inverse, c.reshape(K, n, 1))[:, :, 0]
        d = np.zeros(tr.n_z)
        for k in range(K):
            dZ[k] += onward[k] @ d
            d = dZ[k, -tr.n_z :]
        Z, before = Z + dZ.reshape(Z.shape), size
    return None


def _interval_steps(tr: Transcription, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse slopes (K, J n_z, J n_z) of the residuals in an interval's node states.

    And the steps (K, J n_z, n_z) of the node states per step of the left state.
    """
    n_z = tr.n_z
    _, slope = tr.residual_slope(s, tr.map_values)
    slope = tr.interval_slopes(slope)
    inverse = np.linalg.inv(slope[:, :, n_z : (tr.nodes + 1) * n_z])
    return inverse, -np.matmul(inverse, slope[:, :, :n_z])


def _solve_interval(
    tr: Transcription, left: np.ndarray, x: np.ndarray, u: np.ndarray, map_values: np.ndarray
) -> tuple[np.ndarray, float]:
    """Solve one interval by Newton's method with step halving: node states (J n_z,), largest residual."""
    n_z, J = tr.n_z, tr.nodes
    L, inner = tr.sample_map, tr.sample_map[:, :, n_z : n_z * (J + 1)]
    known = L @ np.concatenate([left, np.zeros(J * n_z), u])
    c, slope = tr.interval_slope(known + inner @ x, map_values)
    size = float(np.abs(c).max())
    for _ in range(25):
        if size < SMALL_RESIDUAL:
            break
        dx = np.linalg.solve(np.matmul(slope, inner).reshape(J * n_z, -1), -c.ravel())
        share = 1.0
        for _ in range(8):
            c, slope = tr.interval_slope(known + inner @ (x + share * dx), map_values)
            trial = float(np.abs(c).max())
            if trial < size:
                break
            share *= 0.5
        x, size = x + share * dx, trial
        if not np.isfinite(size):
            return x, np.inf
    return x, size


def radau_scheme(elements: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the Radau IIA scheme of `elements` elements on 0..1, J = 3 elements.

    Nodes (J,), differentiation matrix (J, J + 1) on (left end, nodes), quadrature weights (J,).
    """
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
    node_position = np.concatenate([(e + tau[1:]) / elements for e in range(elements)])
    return node_position, derivative, np.tile(b / elements, elements)


def transcribe(
    model: Model,
    problem: Problem,
    state_size: Mapping[str, float],
    intervals: int,
    motion: Motion,
    elements: int = 1,
    with_pose: bool = False,
    rest_factor: float = 1.0,
    weights: np.ndarray | None = None,
) -> Transcription:
    """Build the nonlinear program of a problem.

    state_size: typical size by name, of coordinates c, velocities c' and memory states of effects.
    intervals: number of equal intervals, each of `elements` collocation elements.
    motion: a nearby motion, from which values of a map of the ground are taken.
    with_pose: make the pose a state; only limits of the lane depend on it.
    rest_factor: factor on the tolerance of rest at the end.
    weights (n_blocks, n_rows) [1/SI]: factors of the regressor's rows, one information matrix each; ones by default.
    """
    every = machine_limits(model, problem)
    s = sample_symbols(model)
    moved = _limits_depending_on(every, s, ca.vertcat(s.q, s.nu))
    deferred = set() if with_pose else {g.name for g in every if is_lane_limit(g.name)}
    staged = [g for g in every if g.name in moved - deferred]
    steered = [g for g in every if g.name not in moved | deferred]
    pose = model.machine.body[0].coordinates if with_pose else ()
    resting = [model.coordinates[k] for k in resting_coordinates(model)]
    used = [c for c in model.coordinates if c in {*pose, *model.active_coordinates, *resting}]
    names = (*used, *[c + "'" for c in model.coordinates], *model.memory[: model.n_dynamic_memory])
    z_size = np.array([state_size[c] for c in names])
    u_size = np.array([float(b.limit.torque) if b.limit.torque is not None else 1.0 for b in model.machine.actuated])
    interval_s = float(problem.duration_s) / intervals
    node_position, derivative, weight = radau_scheme(elements)
    blocks = np.ones((1, len(model.coordinates))) if weights is None else weights
    one = _sample_functions(model, used, z_size, u_size, interval_s, staged, blocks)

    n_z, n_g, n_a = (one.values.numel_out(k) for k in range(3))
    n_s, N = one.values.numel_in(0), intervals * len(node_position)
    samples = float(problem.duration_s) * float(model.machine.sampling_hz)
    nodes = ((np.arange(intervals)[:, None] + node_position) * interval_s).ravel()
    told = motion.memory[:, model.n_dynamic_memory :]
    torque_rows, torque_centre = _torque_limit_rows(steered, s, u_size, interval_s)
    resting_states = [names.index(c) for c in (*resting, *(c + "'" for c in model.coordinates))]
    still = np.concatenate([np.full(len(resting), REST_POSITION), rest_tolerances(model)])
    rest_states = np.array(resting_states if problem.rest else [], int)
    rest_band = (rest_factor * REST_SHARE * still / z_size[resting_states])[: len(rest_states)]
    return Transcription(
        intervals,
        len(node_position),
        interval_s,
        names,
        z_size,
        u_size,
        derivative,
        node_position,
        np.tile(weight, intervals) / intervals * samples,
        tuple(x.name for x in staged),
        np.array([-1.0 if np.isfinite(x.low) else -NO_BOUND for x in staged]),
        tuple(x.name for x in steered),
        torque_rows,
        torque_centre,
        one.rows,
        one.columns,
        len(model.scale),
        len(blocks),
        rest_states,
        rest_band,
        np.array([k for k, c in enumerate(names) if c in pose and k not in resting_states], int),
        _sample_map(node_position, derivative, n_z, len(u_size)),
        np.array([np.interp(nodes, motion.t, x) for x in told.T]).T.reshape(N, -1),
        one.entry_of,
        one.entry_by,
        MappedFunction(one.values, N, [(n_z,), (n_g,), (n_a,)]),
        MappedFunction(one.first, N, [(n_z,), (n_g,), (n_a,), (n_z, n_s), (n_g, n_s), (len(one.entry_of),)]),
        MappedFunction(one.second, N, [(n_s, n_s)]),
        MappedFunction(one.residual, N, [(n_z,)]),
        MappedFunction(one.step, N, [(n_z,), (n_z, n_s)]),
        MappedFunction(one.step, len(node_position), [(n_z,), (n_z, n_s)]),
    )


@dataclass(frozen=True)
class _SampleFunctions:
    """Functions of a node's sample s and of values from a map of the ground.

    values: residual of the equations of motion, limits and entries of information matrices, scaled; first: these and
    their slopes; second: Hessian of the Lagrangian, given multipliers as well; residual: alone; step: with its slope.
    rows, columns: places of the entries in their matrix. entry_of, entry_by: non-zeros of the entries' slope.
    """

    values: ca.Function
    first: ca.Function
    second: ca.Function
    residual: ca.Function
    step: ca.Function
    rows: np.ndarray
    columns: np.ndarray
    entry_of: np.ndarray
    entry_by: np.ndarray


def _sample_functions(
    model: Model,
    used: Sequence[str],
    z_size: np.ndarray,
    u_size: np.ndarray,
    interval_s: float,
    limits: Sequence[Limit],
    blocks: np.ndarray,
) -> _SampleFunctions:
    """Build the functions of a node's sample from coordinates that are used, sizes of states and torques, and limits.

    blocks (n_blocks, n_rows) [1/SI]: factors of the regressor's rows, one information matrix each.
    """
    n_z, n_q, n_u = len(z_size), len(model.coordinates), len(u_size)
    sample = ca.SX.sym("s", 2 * n_z + n_u)
    z = sample[:n_z] * ca.DM(z_size)
    rate = sample[n_z : 2 * n_z] * ca.DM(z_size) / interval_s
    u = sample[2 * n_z :] * ca.DM(u_size)
    q = ca.SX(n_q, 1)
    for k, c in enumerate(used):
        q[model.coordinates.index(c)] = z[k]
    memory = len(used) + n_q
    nu, a = (ca.vertcat(*ca.vertsplit(x)[len(used) : memory]) for x in (z, rate))
    kept, kept_rate = (ca.vertcat(*ca.vertsplit(x)[memory:], ca.SX(0, 1)) for x in (z, rate))
    map_values = ca.SX.sym("over", len(model.map_inputs))
    beside = () if model.plain else (u, ca.vertcat(kept, map_values))
    p = model.expand @ model.nominal
    dq = model.kinematics(q, nu)[0]
    turns = [(rate[k] - dq[model.coordinates.index(c)]) * interval_s / z_size[k] for k, c in enumerate(used)]
    flow = model.flow(q, nu, u, ca.vertcat(kept, map_values), model.nominal)[: n_z - memory]
    going = (kept_rate - flow) * interval_s / ca.DM(z_size[memory:])
    balance = (model.balance(q, nu, a, p, *beside) - model.joint_torques(u)) / float(u_size.max())
    residual = ca.vertcat(*turns, balance, going)
    g = ca.vertcat(*[(g.expression(q, nu, u, 0) - g.centre) * (2 / g.range) for g in limits], ca.SX(0, 1))
    Phi = ca.mtimes(model.regressor(q, nu, a, *beside), ca.diag(ca.DM(model.scale)))
    every_A = [ca.triu(ca.mtimes(P.T, P)) for P in (ca.mtimes(ca.diag(ca.DM(w)), Phi) for w in blocks)]
    rows, columns = (np.array(x) for x in ca.triu(ca.mtimes(Phi.T, Phi)).sparsity().get_triplet())
    entries = ca.vertcat(*[x for A in every_A for x in A.nonzeros()], ca.SX(0, 1))

    multipliers = ca.SX.sym("m", n_z + g.numel() + entries.numel())
    H, _ = ca.hessian(ca.dot(multipliers, ca.vertcat(residual, g, entries)), sample)
    slopes = [ca.densify(ca.jacobian(x, sample).T) for x in (residual, g)]
    entry_slope = ca.jacobian(entries, sample)
    entry_of, entry_by = (np.array(x, int) for x in entry_slope.sparsity().get_triplet())
    nonzeros = ca.vertcat(*entry_slope.nonzeros(), ca.SX(0, 1))
    given, options = [sample, map_values], {"cse": True}
    return _SampleFunctions(
        ca.Function("values", given, [residual, g, entries], options),
        ca.Function("first", given, [residual, g, entries, *slopes, nonzeros], options),
        ca.Function("second", [*given, multipliers], [ca.densify(H)], options),
        ca.Function("residual", given, [residual], options),
        ca.Function("step", given, [residual, slopes[0]], options),
        rows,
        columns,
        entry_of,
        entry_by,
    )


def _limits_depending_on(every: Sequence[Limit], s: SampleSymbols, on: ca.SX) -> set[str]:
    """Return the names of the limits whose expression depends on any of these symbols."""
    return {g.name for g in every if any(ca.which_depends(g.expression(s.q, s.nu, s.u, s.du), on, 1, True))}


def _torque_limit_rows(
    steered: Sequence[Limit], s: SampleSymbols, u_size: np.ndarray, interval_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return limits on torques alone as rows (n_c, 2 n_u) on the scaled end torques, scaled to -1..1."""
    n_u = len(u_size)
    rows, centres = [], []
    for g in steered:
        e = g.expression(s.q, s.nu, s.u, s.du)
        slope = ca.Function("slope", [s.u, s.du], [ca.jacobian(e, s.u), ca.jacobian(e, s.du)])
        by_u, by_du = (x.full().ravel() for x in slope(0, 0))
        rows.append(np.concatenate([-by_du / interval_s, by_u + by_du / interval_s]) * np.tile(u_size, 2) * 2 / g.range)
        centres.append(-2 * g.centre / g.range)
    return np.array(rows).reshape(-1, 2 * n_u), np.array(centres)


def rest_band_factor(friction: float) -> float:
    """Return the factor on the tolerance of rest for wider friction transitions.

    Near standstill, softened friction only damps, and the speed that remains at the end grows with the transition's
    width.
    """
    return 2 * friction if friction > 1 else 1.0


def widen_transitions(model: Model, friction: float, slip: float) -> Model:
    """Return the model with wider transitions of friction and slip at standstill."""
    if friction == 1 and slip == 1:
        return model
    bodies = []
    for body in model.machine.body:
        changed: dict[str, object] = {}
        if body.friction is not None:
            wider = body.friction.smoothing.model_copy(update={"value": friction * float(body.friction.smoothing)})
            changed["friction"] = body.friction.model_copy(update={"smoothing": wider})
        if body.contact is not None:
            wider = body.contact.v_eps.model_copy(update={"value": slip * float(body.contact.v_eps)})
            changed["contact"] = body.contact.model_copy(update={"v_eps": wider})
        bodies.append(body.model_copy(update=changed))
    machine: Machine = model.machine.model_copy(update={"body": tuple(bodies)})
    return replace(model.for_machine(machine), nominal=model.nominal, scale=model.scale)
