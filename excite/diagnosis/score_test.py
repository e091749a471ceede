"""Signatures of effects that a model lacks, in the joint smoother (score tests: Rao, 1948).

Along a fitted log every effect, at every place and for each of its trial shapes, has a signature: the forces, torques
and readings that it alone would add. Signatures pass through the smoother's linearised equations as columns beside the
parameters. What parameters, states and torque noise can absorb is projected out, and the rest is tested against the
innovations. Sensor noise in slips and speeds, which gives least-squares residuals a false structure, is accounted for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product

import casadi as ca
import numpy as np

from excite import smoothing
from excite.logs import implicit, passes
from excite.model import SignatureFunctions, effects, signatures
from excite.model.effects import CATALOGUE, Effect, PlacedEffect, Site
from excite.model.machine import Machine
from excite.simulation import delivered_torque
from excite.smoothing import (
    BATCH_SIZE,
    BatchedFunction,
    Lacking,
    LinearisedLog,
    Measurements,
    StateSpace,
    Trajectory,
    WhitenedInnovations,
    differentiate,
    integrate,
    smoothed_motion,
    whiten,
    whiten_signatures,
)

NEARBY_MAGNITUDES = 0.6, 0.8, 1.0, 1.3, 1.7  # factors on a magnitude that does not scale its signature; chosen
REFINEMENT_POINTS = -2, -1, 0, 1, 2  # thirds of the way to the trial values before and after; chosen
UNBOUNDED_SIGNATURE = 1e9  # in units of a state's or reading's scale, from which a signature has no bounds; chosen
MIN_SIGNATURE = 1e-6  # squared norm of a whitened signature below which the logs do not show it; chosen
MIN_PHASE_SHARE = 1e-9  # squared norm of a sine over its cosine's, or the reverse, below which it is left out; chosen


@dataclass(frozen=True)
class Candidate:
    """An effect at a place with trial values of magnitude and shapes.

    columns: numbers of its signatures, one, or two for sine and cosine of a phase.
    """

    placed: PlacedEffect
    columns: tuple[int, ...]

    @property
    def name(self) -> str:
        return self.placed.name

    @property
    def variant(self) -> tuple[str, ...]:
        """Name and the shapes that are zero by default but not here: another way for the same cause to act.

        Each value of an integer shape is a variant of its own.
        """
        effect, own = self.placed.effect, self.placed.values
        unusual = _active_signed_shapes(effect, own)
        return (self.name, *(f"{n}={own[n]:g}" if effect.shapes[n].whole else n for n in unusual))


def _active_signed_shapes(effect: Effect, values: Mapping[str, float]) -> list[str]:
    return [n for n, s in effect.shapes.items() if s.signed and not s.circular and values[n]]


def candidates(machine: Machine, sensors: Sequence[str], duration: float) -> list[Candidate]:
    """List every effect at every place with its trial values, for a log of a duration [s] with these sensors."""
    found: list[Candidate] = []
    columns = 0
    for effect in CATALOGUE.values():
        for where, (bodies, sitting) in effects.allowed_places(machine, effect).items():
            if effect.reading is not None and not set(sitting) & set(sensors):
                continue
            site = Site.of(machine, bodies, duration)
            for values, width in _trial_values(effect, site):
                placed = PlacedEffect(effect, where, bodies, sitting, values, effects.is_straight(machine, bodies))
                found.append(Candidate(placed, tuple(range(columns, columns + width))))
                columns += width
    return found


def _trial_values(effect: Effect, site: Site) -> list[tuple[dict[str, float], int]]:
    """Return trial magnitudes and shapes of an effect, each with its number of columns."""
    names = [n for n, s in effect.shapes.items() if not s.circular]
    sizes = [effect.shapes[n].size(site) for n in names]
    grids = [[g * size for g in effect.shapes[n].grid] for n, size in zip(names, sizes, strict=True)]
    circular = next((n for n, s in effect.shapes.items() if s.circular), None)
    tried = []
    for share in effect.grid:
        for shapes in product(*grids):
            values = {"A": share * effect.typical_magnitude(site), **dict(zip(names, shapes, strict=True))}
            tried.append((values | ({circular: 0.0} if circular else {}), 2 if circular else 1))
    tried += [({"A": effect.typical_magnitude(site), **shapes}, 1) for shapes in effect.extra_trials(site)]
    return [x for x in tried if _interval_fits(x[0], site.duration)]


def _interval_fits(values: Mapping[str, float], duration: float) -> bool:
    """Tell if an effect between two instants begins before it ends, within a log of a duration [s]."""
    if "begin" not in values:
        return True
    end = values["end"] if "end" in values else values["begin"] + values["length"]
    return values["begin"] < end <= duration


def refine_candidates(
    near: Sequence[Candidate], machine: Machine, duration: float, reach: float = 1.0
) -> list[Candidate]:
    """List candidates near others, with magnitudes and shapes between the trial values.

    reach: how far, as a share of the way to the next trial values.
    """
    found: list[Candidate] = []
    columns = 0
    for x in near:
        placed = x.placed
        site = Site.of(machine, placed.bodies, duration)
        for values in _nearby_values(placed, site, reach):
            width = len(x.columns)
            own = replace(placed, values=values)
            found.append(Candidate(own, tuple(range(columns, columns + width))))
            columns += width
    return found


def _nearby_values(placed: PlacedEffect, site: Site, reach: float) -> list[dict[str, float]]:
    """Return values near a candidate's, up to two thirds of the way to the next trial values.

    Extra trials form a grid of their own, or points along which several shapes vary together.
    """
    effect, own = placed.effect, placed.values
    families: list[list[dict[str, float]]] = []
    if len(effect.grid) > 1:
        families.append([{"A": own["A"] * f**reach} for f in NEARBY_MAGNITUDES])
    unusual = _active_signed_shapes(effect, own)
    same_variant = [b for b in placed.extra_trials(site) if unusual and _active_signed_shapes(effect, b) == unusual]
    same_variant = [b for b in same_variant if all(b[n] * own[n] > 0 for n in unusual)]
    if same_variant:
        tried = {n: {b[n] for b in same_variant} for n, s in effect.shapes.items() if not s.whole}
        varying = [n for n, values in tried.items() if len(values) > 1]
        if {tuple(b[n] for n in varying) for b in same_variant} == set(product(*(tried[n] for n in varying))):
            families += [_interpolate_points(own, [{n: x} for x in tried[n]], reach) for n in varying]
        else:
            families += [_interpolate_points(own, [{n: b[n] for n in varying} for b in same_variant], reach)]
    for name, shape in effect.shapes.items() if not same_variant else ():
        if len(shape.grid) > 1 and not (shape.circular or shape.whole or name in unusual):
            families.append(_interpolate_points(own, [{name: g * shape.size(site)} for g in shape.grid], reach))
    every = [{name: x for part in parts for name, x in part.items()} for parts in product(*families)]
    free = {"A", *unusual}
    every = [{**own, **values} for values in every if all(x >= 0 for n, x in values.items() if n not in free)]
    return [x for x in every if _interval_fits(x, site.duration)]


def _interpolate_points(
    own: Mapping[str, float], points: Sequence[Mapping[str, float]], reach: float
) -> list[dict[str, float]]:
    """Return values on the way from a candidate's to the trial points before and after the nearest one."""
    names = list(points[0])
    line = np.array(sorted([p[n] for n in names] for p in points))
    here = np.array([own[n] for n in names])
    k = int(np.argmin(np.abs(line - here).sum(axis=1)))
    step = line[k] - line[k - 1] if k else line[1] - line[0]
    below, above = line[k] - step, line[k + 1] if k + 1 < len(line) else line[k] + step
    if len(names) == 1:
        below = np.maximum(below, 0.0)
    shares = np.array(REFINEMENT_POINTS) / 3 * reach
    return [
        dict(zip(names, map(float, here + x * (here - below if x < 0 else above - here)), strict=True)) for x in shares
    ]


def renumber_columns(found: Sequence[Candidate]) -> list[Candidate]:
    """Number the columns of candidates from different lists consecutively."""
    ends = np.cumsum([len(x.columns) for x in found])
    return [replace(x, columns=tuple(range(end - len(x.columns), end))) for x, end in zip(found, ends, strict=True)]


@dataclass(frozen=True, eq=False)
class FittedLog:
    """One fitted log, as needed to score candidates.

    origins: number of unknown encoder offsets. q, nu, a (N, n_q): motion and accelerations. u (N, n_u): delivered
    torques. t (N,) [s]. exact (N, n_readings): readings without noise. standard: standard parameters. slopes: see
    `_input_sensitivities`. white: whitened innovations. over (N, n_over): values of the map of the ground. by_input
    (N - 1, n, n_e): as `slopes`, by half of each input at both ends.
    """

    space: StateSpace
    linear: LinearisedLog
    n_offsets: int
    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    u: np.ndarray
    t: np.ndarray
    exact: np.ndarray
    standard: np.ndarray
    slopes: np.ndarray
    white: WhitenedInnovations
    over: np.ndarray
    trajectory: Trajectory
    by_input: np.ndarray


def fitted_logs(space: StateSpace, measurements: Sequence[Measurements], fit: smoothing.Fit) -> tuple[FittedLog, ...]:
    """Prepare every log of a fit for scoring."""
    return tuple(
        _fitted_log(space, r, p, linear, fit.X)
        for r, p, linear in zip(measurements, fit.trajectories, fit.linear, strict=True)
    )


def _fitted_log(space: StateSpace, r: Measurements, p: Trajectory, linear: LinearisedLog, X: np.ndarray) -> FittedLog:
    model = space.model
    q, nu, z, u, a = smoothed_motion(space, r, p, X)
    t = np.arange(len(u)) / float(model.machine.sampling_hz)
    wheels = np.zeros((len(u), sum(s.kind == "wheel" for s in model.machine.sensor)))
    n_q = q.shape[1]
    for k, at in enumerate(space.index):
        if 2 * n_q <= at < 2 * n_q + wheels.shape[1]:
            wheels[:, at - 2 * n_q] = p.state[:, k]
    exact = model.read(q.T, nu.T, wheels.T, u.T, z.T, X).full().T
    slopes, by_input = _input_sensitivities(space, p, u, X)
    white = whiten(linear)
    at = model.true_coordinates(q, X)
    over = p.ground_inputs if model.map_inputs else passes(model, at, nu, 1 / float(model.machine.sampling_hz))
    standard = model.expand @ X
    return FittedLog(
        space, linear, len(r.offset_sensors), q, nu, a, u, t, exact, standard, slopes, white, over, p, by_input
    )


def beside(fitted_log: FittedLog, lacking: Lacking) -> FittedLog:
    """Return a fitted log with a further column of its whitened innovations for each coefficient of what is lacking."""
    if not lacking.count:
        return fitted_log
    space, linear, white = fitted_log.space, fitted_log.linear, fitted_log.white
    features = space.features(fitted_log.trajectory.state)[0][:, :, 0]
    place = list(space.input_columns).index
    shapes = [(t.columns, place(t.at), t.values(features).astype(np.float32)) for t in lacking.inputs]

    def along(at: slice) -> tuple[np.ndarray, np.ndarray]:
        K = at.stop - at.start
        push = np.zeros((K, space.n, lacking.count), np.float32)
        for columns, j, shape in shapes:
            both = shape[at.start : at.stop + 1]
            ends = both[:-1] + both[1:]
            push[: len(ends), :, columns] += fitted_log.by_input[at][:, :, j, None] * ends[:, None]
        return push, np.zeros((K, linear.H.shape[1], lacking.count), np.float32)

    more = np.concatenate([E for _, E in whiten_signatures(linear, white, along)])
    return replace(fitted_log, white=replace(white, E=np.concatenate([white.E, more], axis=2)))


@dataclass(frozen=True)
class _Acting:
    """Effects, each by itself, on a machine without any; key: what tells them from others."""

    key: str
    machine: Machine = field(compare=False)
    standard: tuple[str, ...] = field(compare=False)
    placed: Sequence[PlacedEffect] = field(compare=False)


@lru_cache(maxsize=8)
def _functions(acting: _Acting) -> tuple[SignatureFunctions, BatchedFunction, BatchedFunction]:
    """Build signatures, and the same of forces and of readings for many samples; stages of a search share them."""
    found = signatures(acting.machine, acting.standard, acting.placed)
    return found, BatchedFunction(found.force, (7,)), BatchedFunction(found.reading, (7,))


class SignatureColumns:
    """Signatures of candidates along one fitted log."""

    def __init__(self, fitted_log: FittedLog, found: Sequence[Candidate]) -> None:
        space, model = fitted_log.space, fitted_log.space.model
        self.fitted_log, self.columns = fitted_log, sum(len(x.columns) for x in found)
        every: list[PlacedEffect] = []
        for x in found:
            circular = [n for n, s in x.placed.effect.shapes.items() if s.circular]
            for turn in range(len(x.columns)):
                shift = dict.fromkeys(circular, turn * np.pi / 2)
                values = {**x.placed.values, **shift}
                every.append(replace(x.placed, values=values))
        standard = tuple(n for n in model.base.standard if "@" not in n)
        bare = model.machine.model_copy(update={"effect": ()})
        key = repr((bare.model_dump(), standard, [(e.name, e.sensors, sorted(e.values.items())) for e in every]))
        functions, self.force, self.reading = _functions(_Acting(key, bare, standard, every))
        self.rows = [model.reading_names.index(s.name) for s in space.sensors]
        self.p = fitted_log.standard[: len(standard)]
        memory = integrate_memory(
            functions, fitted_log.q, fitted_log.nu, fitted_log.u, fitted_log.t, self.p, fitted_log.over
        )
        self.samples = (
            fitted_log.q,
            fitted_log.nu,
            fitted_log.a,
            fitted_log.u,
            fitted_log.t[:, None],
            memory,
            fitted_log.exact,
        )
        self.misread = [k for k, e in enumerate(every) if e.effect.channel is not None]
        self.torque = np.zeros((*fitted_log.u.shape, len(self.misread)), np.float32)
        for at, k in enumerate(self.misread):
            self.torque[:, :, at] = _torque_channel_error(space, every[k], fitted_log.u, fitted_log.t)
        self.bounded = np.ones(self.columns, bool)

    def products(self) -> np.ndarray:
        """Return the Gram matrix of the whitened innovations, parameters, offsets and signatures.

        Signatures that grow without bounds, as memory along a motion far off may, count as zero.
        """
        fitted_log = self.fitted_log
        own = fitted_log.white.E.shape[2]
        form = np.zeros((own + self.columns, own + self.columns))
        for at, E in whiten_signatures(fitted_log.linear, fitted_log.white, self._along):
            both = np.concatenate([fitted_log.white.E[at], E], axis=2).reshape(-1, len(form))
            form += both.T @ both
        unbounded = own + np.flatnonzero(~self.bounded)
        form[unbounded] = form[:, unbounded] = 0
        return form

    def _along(self, at: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return what signatures add to scaled states after each of K samples (K, n, C) and to readings (K, m, C)."""
        space, K = self.fitted_log.space, at.stop - at.start
        to = slice(at.start, at.stop + 1)  # to the end of the last interval
        held = tuple(x[to] for x in self.samples)
        push = np.zeros((K, space.n, self.columns), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            acting = _order_forces(space, self.force(*held, self.p)[0])
            acting[:, : self.torque.shape[1], self.misread] += self.torque[to]
            moved = self.fitted_log.slopes[at] @ (acting[:-1] + acting[1:])
            push[: len(moved)] = moved
            reading = self.reading(*held, self.p)[0][:K, self.rows].astype(np.float32)
        for part in (push, reading):
            self.bounded &= np.abs(part).max(axis=(0, 1)) < UNBOUNDED_SIGNATURE
        push[:, :, ~self.bounded] = reading[:, :, ~self.bounded] = 0
        return push, reading


def _unactuated_rows(space: StateSpace) -> list[int]:
    """Return the rows on which forces of effects act and that have no actuator."""
    return [k for k, row in enumerate(space.forced_rows) if row not in space.model.actuated]


def _input_sensitivities(
    space: StateSpace, p: Trajectory, u: np.ndarray, X: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the effect of half a torque or force at both ends of each interval on the state after it, scaled.

    Shapes (N - 1, n, n_u + n_free): torques, then forces on rows without an actuator; (N - 1, n, n_e): all inputs.
    """
    N, scale, free, inputs = (
        len(p.state),
        smoothing.state_scale(space),
        _unactuated_rows(space),
        space.inputs(u, p.ground_inputs),
    )
    found = np.empty((N - 1, space.n, u.shape[1] + len(free)), np.float32)
    every = np.empty((N - 1, space.n, len(space.input_columns)), np.float32)
    for at in range(0, N - 1, BATCH_SIZE):
        until = min(at + BATCH_SIZE, N - 1)
        steps = integrate(space, p.state[at : until + 1], inputs[at:until], inputs[at + 1 : until + 1], X)
        by = differentiate(space, steps, X, force=True)
        found[at:until] = np.concatenate([by.B[:, :, : u.shape[1]], by.F[:, :, free]], axis=2) / (2 * scale[:, None])
        every[at:until] = by.B / (2 * scale[:, None])
    return found, every


def _order_forces(space: StateSpace, force: np.ndarray) -> np.ndarray:
    """Order forces (K, n_q, C) as in `_input_sensitivities`: torques of the drives, then what else acts."""
    rows = [*space.model.actuated, *(space.forced_rows[k] for k in _unactuated_rows(space))]
    return (space.model.machine.row_matrix @ force)[:, rows].astype(np.float32)


def _torque_channel_error(space: StateSpace, e: PlacedEffect, u: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the additional torque (N, n_u) [N m] if a torque channel reads as the effect says.

    Smoothed torques u (N, n_u) are used: measured ones would respond to their own noise.
    """
    gain, offset, delay = e.channel(t)
    more = np.zeros_like(u)
    for k, body in enumerate(space.model.machine.actuated):
        if body.index in e.bodies:
            more[:, k] = delivered_torque(t, u[:, k], gain, offset, delay) - u[:, k]
    return more


def integrate_memory(
    functions: SignatureFunctions,
    q: np.ndarray,
    nu: np.ndarray,
    u: np.ndarray,
    t: np.ndarray,
    p: np.ndarray,
    over: np.ndarray,
) -> np.ndarray:
    """Integrate the memory (N, n_z) of effects along a motion, from rest.

    over (N, n_over): values of the map of the ground there, if an effect uses it.
    """
    n_q, n_u, n_z = q.shape[1], u.shape[1], functions.flow.size1_in(4)
    at, z = ca.SX.sym("at", 2 * n_q + n_u + 1), ca.SX.sym("z", n_z)
    rate = functions.flow(at[:n_q], at[n_q : 2 * n_q], at[2 * n_q : -1], at[-1], z, ca.DM(p))
    flow = ca.Function("flow", [z, at], [rate])
    along = np.hstack([q, nu, u, t[:, None]])
    return implicit(flow, np.zeros(n_z), along, float(t[1] - t[0]), over[:, : functions.n_map_inputs])
