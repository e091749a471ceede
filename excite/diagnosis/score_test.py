"""Evidence of effects that a model doesn't have: score tests in the joint smoother.

Along a fitted log every effect of the catalogue, at every place and on its grid of shapes, has a signature: the forces,
torques and readings that it alone would add. Signatures go through the smoother's linearised chain as columns beside
the parameters; what the parameters, the states and the torque noise can absorb is projected out, and what is left is
tested against the innovations. Sensor noise in slips and speeds, which fills least-squares residuals with false
structure, is accounted for. The test is Rao's score test (Rao, 1948) of each effect's amount at zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import casadi as ca
import numpy as np

from excite import smoothing
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.logs import implicit, passes
from excite.model import SignatureFunctions as MadeSignatures, effects, signatures
from excite.model.effects import CATALOGUE, Effect, PlacedEffect, Site
from excite.model.machine import Machine
from excite.simulation import delivered_torque
from excite.smoothing import (
    BATCH_SIZE,
    BatchedFunction,
    LinearisedLog,
    Measurements,
    StateSpace,
    Trajectory,
    WhitenedInnovations,
    differentiate,
    smoothed_motion,
    whiten,
    whiten_signatures,
)

NEARBY_MAGNITUDES = 0.6, 0.8, 1.0, 1.3, 1.7  # amounts that are tried about the grid's, where they aren't a factor
MIN_COLUMNS_TO_SPLIT = 100  # columns that aren't worth a second process
UNBOUNDED_SIGNATURE = 1e9  # of a state's or a reading's scale: what is remembered of a far-off motion has no bounds
MIN_UNABSORBED_SHARE = 1e-5  # share of a signature that is left, below which it is but single precision's error


@dataclass(frozen=True)
class Candidate:
    """An effect at a place with shapes of the grid; `columns`: one, or the sine and the cosine of a phase."""

    placed: PlacedEffect
    columns: tuple[int, ...]

    @property
    def name(self) -> str:
        return self.placed.name

    @property
    def variant(self) -> tuple[str, ...]:
        """The name, and which shapes it has that are nothing by default: another way for the same cause to act, and one
        more for every value of a whole one."""
        effect, own = self.placed.effect, self.placed.values
        unusual = _active_signed_shapes(effect, own)
        return (self.name, *(f"{n}={own[n]:g}" if effect.shapes[n].whole else n for n in unusual))


def _active_signed_shapes(effect: Effect, values: Mapping[str, float]) -> list[str]:
    return [n for n, s in effect.shapes.items() if s.signed and not s.circular and values[n]]


@dataclass(frozen=True)
class Score:
    """A candidate's evidence: `gain` is how much twice the log-likelihood would rise with it, to first order.

    values: amount and shapes that it would get. left: the share of the signature that parameters don't absorb.
    """

    candidate: Candidate
    likelihood_ratio: float
    values: Mapping[str, float]
    unabsorbed_share: float


def candidates(machine: Machine, sensors: Sequence[str], duration: float) -> list[Candidate]:
    """Every effect at every place on its grid, for a log of duration [s] with these sensors."""
    found: list[Candidate] = []
    columns = 0
    for effect in CATALOGUE.values():
        for where, (bodies, sensor) in effects.allowed_places(machine, effect).items():
            if effect.reading is not None and sensor not in sensors:
                continue
            site = Site.of(machine, bodies, duration)
            for values, width in _trial_values(effect, site):
                placed = PlacedEffect(effect, where, bodies, sensor, values)
                found.append(Candidate(placed, tuple(range(columns, columns + width))))
                columns += width
    return found


def _trial_values(effect: Effect, site: Site) -> list[tuple[dict[str, float], int]]:
    """Amounts and shapes that are tried, each with its number of columns."""
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
    """Whether what acts between two instants begins before it ends, in a log of duration [s]; also anything else."""
    if "begin" not in values:
        return True
    end = values["end"] if "end" in values else values["begin"] + values["length"]
    return values["begin"] < end <= duration


def refine_candidates(
    scores: Sequence[Score], machine: Machine, duration: float, reach: float = 1.0
) -> list[Candidate]:
    """Candidates about the best ones so far, with shapes and amounts between their grid's points; reach: in shares of
    the way to the next points."""
    found: list[Candidate] = []
    columns = 0
    for score in scores:
        placed = score.candidate.placed
        site = Site.of(machine, placed.bodies, duration)
        for values in _nearby_values(placed, site, reach):
            width = len(score.candidate.columns)
            own = PlacedEffect(placed.effect, placed.where, placed.bodies, placed.sensor, values)
            found.append(Candidate(own, tuple(range(columns, columns + width))))
            columns += width
    return found


def _nearby_values(placed: PlacedEffect, site: Site, reach: float) -> list[dict[str, float]]:
    """Values near those of a candidate: shapes up to two thirds of the way to the next points that are tried. What is
    tried beside the grid is a grid of its own, or points on a line of shapes that go together."""
    effect, own = placed.effect, placed.values
    families: list[list[dict[str, float]]] = []
    if len(effect.grid) > 1:
        families.append([{"A": own["A"] * f**reach} for f in NEARBY_MAGNITUDES])
    unusual = _active_signed_shapes(effect, own)
    alike = [b for b in placed.extra_trials(site) if unusual and _active_signed_shapes(effect, b) == unusual]
    alike = [b for b in alike if all(b[n] * own[n] > 0 for n in unusual)]
    if alike:
        tried = {n: {b[n] for b in alike} for n, s in effect.shapes.items() if not s.whole}
        varying = [n for n, values in tried.items() if len(values) > 1]
        if {tuple(b[n] for n in varying) for b in alike} == set(product(*(tried[n] for n in varying))):
            families += [_interpolate_points(own, [{n: x} for x in tried[n]], reach) for n in varying]
        else:
            families += [_interpolate_points(own, [{n: b[n] for n in varying} for b in alike], reach)]
    for name, shape in effect.shapes.items() if not alike else ():
        if len(shape.grid) > 1 and not (shape.circular or shape.whole or name in unusual):
            families.append(_interpolate_points(own, [{name: g * shape.size(site)} for g in shape.grid], reach))
    every = [{name: x for part in parts for name, x in part.items()} for parts in product(*families)]
    free = {"A", *unusual}
    every = [{**own, **values} for values in every if all(x >= 0 for n, x in values.items() if n not in free)]
    return [x for x in every if _interval_fits(x, site.duration)]


def _interpolate_points(
    own: Mapping[str, float], points: Sequence[Mapping[str, float]], reach: float
) -> list[dict[str, float]]:
    """Values on the way from those of a candidate to the points before and behind the one that is nearest."""
    names = list(points[0])
    line = np.array(sorted([p[n] for n in names] for p in points))
    here = np.array([own[n] for n in names])
    k = int(np.argmin(np.abs(line - here).sum(axis=1)))
    step = line[k] - line[k - 1] if k else line[1] - line[0]
    below, above = line[k] - step, line[k + 1] if k + 1 < len(line) else line[k] + step
    if len(names) == 1:
        below = np.maximum(below, 0.0)
    shares = np.array([-2, -1, 0, 1, 2]) / 3 * reach
    return [
        dict(zip(names, map(float, here + x * (here - below if x < 0 else above - here)), strict=True)) for x in shares
    ]


def renumber_columns(found: Sequence[Candidate]) -> list[Candidate]:
    """Candidates of other lists as one."""
    ends = np.cumsum([len(x.columns) for x in found])
    return [replace(x, columns=tuple(range(end - len(x.columns), end))) for x, end in zip(found, ends, strict=True)]


@dataclass(frozen=True, eq=False)
class FittedLog:
    """One fitted log, as every candidate finds it: the motion q, nu, accelerations a (N, n_q), delivered torques u
    (N, n_u) at times t (N,) [s], exact readings (N, readable), the standard parameters, `slopes` as `_slopes` has them,
    the whitened innovations, and what a map of the ground tells, over (N, n_over). origins: how many offsets of counts
    the log has."""

    chart: StateSpace
    linear: LinearisedLog
    origins: int
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


def fitted_logs(c: StateSpace, records: Sequence[Measurements], fit: smoothing.Fit) -> tuple[FittedLog, ...]:
    """Of every log."""
    return tuple(
        _fitted_log(c, r, p, linear, fit.X) for r, p, linear in zip(records, fit.trajectories, fit.linear, strict=True)
    )


def _fitted_log(c: StateSpace, r: Measurements, p: Trajectory, linear: LinearisedLog, X: np.ndarray) -> FittedLog:
    model = c.model
    q, nu, z, u, a = smoothed_motion(c, r, p, X)
    t = np.arange(len(u)) / float(model.machine.sampling_hz)
    wheels = np.zeros((len(u), sum(s.kind == "wheel" for s in model.machine.sensor)))
    n_q = q.shape[1]
    for k, at in enumerate(c.index):
        if 2 * n_q <= at < 2 * n_q + wheels.shape[1]:
            wheels[:, at - 2 * n_q] = p.state[:, k]
    exact = model.read(q.T, nu.T, wheels.T, u.T, z.T, X).full().T
    slopes, white = _input_sensitivities(c, p, u, X), whiten(linear, c.reading_parameters)
    over = p.ground_inputs if model.map_inputs else passes(model, q, nu, 1 / float(model.machine.sampling_hz))
    return FittedLog(c, linear, len(r.offset_sensors), q, nu, a, u, t, exact, model.expand @ X, slopes, white, over)


class SignatureColumns:
    """The signatures of candidates along one fitted log."""

    def __init__(self, fitted_log: FittedLog, found: Sequence[Candidate]) -> None:
        c, model = fitted_log.chart, fitted_log.chart.model
        self.fitted_log, self.columns = fitted_log, sum(len(x.columns) for x in found)
        every: list[PlacedEffect] = []
        for x in found:
            circular = [n for n, s in x.placed.effect.shapes.items() if s.circular]
            for turn in range(len(x.columns)):
                shift = dict.fromkeys(circular, turn * np.pi / 2)
                values = {**x.placed.values, **shift}
                every.append(PlacedEffect(x.placed.effect, x.placed.where, x.placed.bodies, x.placed.sensor, values))
        standard = tuple(n for n in model.base.standard if "@" not in n)
        made = signatures(model.machine, standard, every)
        self.force, self.reading = BatchedFunction(made.force, (7,)), BatchedFunction(made.reading, (7,))
        self.rows = [model.reading_names.index(s.name) for s in c.sensors]
        self.p = fitted_log.standard[: len(standard)]
        memory = integrate_memory(
            made, fitted_log.q, fitted_log.nu, fitted_log.u, fitted_log.t, self.p, fitted_log.over
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
            self.torque[:, :, at] = _torque_channel_error(c, every[k], fitted_log.u, fitted_log.t)
        self.bounded = np.ones(self.columns, bool)

    def products(self) -> np.ndarray:
        """Of the whitened innovations of data, parameters and offsets and of all signatures, each with each. Nothing of
        one that has no bounds: what it would remember along a motion that is far off may come apart."""
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
        """What signatures do to the scaled state behind each of K samples (K, n, C), and to readings (K, m, C), none
        of those that had no bounds so far."""
        c, K = self.fitted_log.chart, at.stop - at.start
        to = slice(at.start, at.stop + 1)  # to the end of the last interval
        held = tuple(x[to] for x in self.samples)
        push = np.zeros((K, c.n, self.columns), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            acting = _order_forces(c, self.force(*held, self.p)[0])
            acting[:, : self.torque.shape[1], self.misread] += self.torque[to]
            moved = self.fitted_log.slopes[at] @ (acting[:-1] + acting[1:])
            push[: len(moved)] = moved
            reading = self.reading(*held, self.p)[0][:K, self.rows].astype(np.float32)
        for part in (push, reading):
            self.bounded &= np.abs(part).max(axis=(0, 1)) < UNBOUNDED_SIGNATURE
        push[:, :, ~self.bounded] = reading[:, :, ~self.bounded] = 0
        return push, reading


def _unactuated_rows(c: StateSpace) -> list[int]:
    """Which of the rows that disturbing forces act on have no actuator."""
    return [k for k, row in enumerate(c.forced_rows) if row not in c.model.actuated]


def _input_sensitivities(c: StateSpace, p: Trajectory, u: np.ndarray, X: np.ndarray) -> np.ndarray:
    """What half a torque and half a force on each row without an actuator, at both ends of each interval, do to the
    scaled state behind it (N - 1, n, n_u + n_free)."""
    N, scale, free, inputs = len(p.state), smoothing.state_scale(c), _unactuated_rows(c), c.inputs(u, p.ground_inputs)
    found = np.empty((N - 1, c.n, u.shape[1] + len(free)), np.float32)
    for at in range(0, N - 1, BATCH_SIZE):
        until = min(at + BATCH_SIZE, N - 1)
        by = differentiate(c, p.state[at : until + 1], inputs[at:until], inputs[at + 1 : until + 1], X, force=True)
        found[at:until] = np.concatenate([by.B, by.F[:, :, free]], axis=2) / (2 * scale[:, None])
    return found


def _order_forces(c: StateSpace, force: np.ndarray) -> np.ndarray:
    """Of forces (K, n_q, C) those on rows with an actuator, then those on rows without, in the order of `_slopes`."""
    rows = [*c.model.actuated, *(c.forced_rows[k] for k in _unactuated_rows(c))]
    return force[:, rows].astype(np.float32)


def _torque_channel_error(c: StateSpace, e: PlacedEffect, u: np.ndarray, t: np.ndarray) -> np.ndarray:
    """How much more torque would be delivered (N, n_u) where a channel reads as the effect has it.

    From smoothed torques u: measured ones would answer to their own noise.
    """
    gain, offset, delay = e.channel(t)
    more = np.zeros_like(u)
    for k, body in enumerate(c.model.machine.actuated):
        if body.index in e.bodies:
            more[:, k] = delivered_torque(t, u[:, k], gain, offset, delay) - u[:, k]
    return more


def integrate_memory(
    made: MadeSignatures,
    q: np.ndarray,
    nu: np.ndarray,
    u: np.ndarray,
    t: np.ndarray,
    p: np.ndarray,
    over: np.ndarray,
) -> np.ndarray:
    """What effects with these signatures remember (N, n_z) along a motion, from rest; and, if any looks at it, what a
    map of the ground tells there, over (N, n_over)."""
    n_q, n_u, n_z = q.shape[1], u.shape[1], made.flow.size1_in(4)
    at, z = ca.SX.sym("at", 2 * n_q + n_u + 1), ca.SX.sym("z", n_z)
    rate = made.flow(at[:n_q], at[n_q : 2 * n_q], at[2 * n_q : -1], at[-1], z, ca.DM(p))
    flow = ca.Function("flow", [z, at], [rate])
    along = np.hstack([q, nu, u, t[:, None]])
    return implicit(flow, np.zeros(n_z), along, float(t[1] - t[0]), over[:, : made.n_map_inputs])


def score_candidates(
    along: Sequence[FittedLog], fit: smoothing.Fit, found: Sequence[Candidate], runner: CallRunner = run_in_turn
) -> tuple[Score, ...]:
    """The score of every candidate along fitted logs, best first. together: how its parts are computed."""
    ends = np.cumsum([len(x.columns) for x in found])
    middle = int(np.searchsorted(ends, ends[-1] / 2)) if len(found) and ends[-1] > MIN_COLUMNS_TO_SPLIT else 0
    parts = [part for part in (found[:middle], found[middle:]) if part]
    told = runner([partial(_score_values, along, fit, renumber_columns(part)) for part in parts])
    every = zip(found, (x for part in told for x in part), strict=True)
    scores = [Score(x, *seen) for x, seen in every if seen is not None]
    return tuple(sorted(scores, key=lambda s: -s.likelihood_ratio))


ScoreValues = tuple[float, dict[str, float], float]  # of a score all but the candidate


def _score_values(
    along: Sequence[FittedLog], fit: smoothing.Fit, found: Sequence[Candidate]
) -> list[ScoreValues | None]:
    """What logs tell of candidates, each beside the parameters alone."""
    total, n = sum(len(x.columns) for x in found), len(fit.X)
    model, prior = along[0].chart.model, fit.prior
    Z = np.zeros((1 + n + total, 1 + n + total))
    for fitted_log in along:
        form = SignatureColumns(fitted_log, found).products()
        # Offsets of counts belong to one log: integrate them out.
        o, keep = slice(1 + n, 1 + n + fitted_log.origins), np.r_[0 : 1 + n, 1 + n + fitted_log.origins : len(form)]
        inner = form[o, o] + np.eye(fitted_log.origins)
        Z += form[np.ix_(keep, keep)] - form[keep, o] @ np.linalg.solve(inner, form[o, keep])
    own, p = slice(1 + n, None), slice(1, 1 + n)
    base, cross = Z[p, p] + np.diag(prior), Z[p, own]
    g_base = Z[p, 0] + prior * (fit.X - model.nominal) / model.scale
    solved = np.linalg.solve(base, np.column_stack([cross, g_base]))
    S = Z[own, own] - cross.T @ solved[:, :-1]
    g = Z[own, 0] - cross.T @ solved[:, -1]
    return [_score(x, S, g, Z[own, own]) for x in found]


def _score(x: Candidate, S: np.ndarray, g: np.ndarray, own: np.ndarray) -> ScoreValues | None:
    """The evidence of one candidate; None where the parameters absorb all of it or nothing shows it."""
    size = np.diag(own)[list(x.columns)]
    if not (np.isfinite(size).all() and size.max() >= 1e-6):
        return None
    # A sine or a cosine that does nothing here, as a slope across a straight lane, stays out.
    shown = size > 1e-9 * size.max()
    at = [k for k, told in zip(x.columns, shown, strict=True) if told]
    left = float(np.min(np.diag(S)[at] / np.diag(own)[at]))
    if not left > MIN_UNABSORBED_SHARE:
        return None
    step = np.zeros(len(shown))
    step[shown] = -np.linalg.solve(S[np.ix_(at, at)] + 1e-9 * np.diag(np.diag(own)[at]), g[at])
    values, effect = dict(x.placed.values), x.placed.effect
    if len(shown) == 2:
        circular = next(n for n, s in effect.shapes.items() if s.circular)
        values[circular] = float(np.arctan2(step[1], step[0]))
        values["A"] *= float(np.hypot(*step))
    else:
        values["A"] *= float(step[0])
    # Where negative amounts are on the grid, a step back from a positive one says that these are meant.
    forward = effect.positive or min(effect.grid) < 0
    if forward and step[0] <= 0 and len(shown) == 1:
        return 0.0, values, left
    return float(-step[shown] @ g[at]), values, left
