"""Lower bounds on the standard deviations after any drive of a machine with one joint, from mixtures of its states.

A drive that begins and ends at rest in one place, without torque, distributes its samples over states s = (position,
velocity, torque, torque rate) within the limits, with E[d phi / dt] = 0 for every function phi of position, velocity
and torque (occupation measures; Lasserre et al., 2008). Its information matrix is N times a mixture of the A(s).

The objectives are convex in the information matrix: with v = g' M^-1 g, log v = max_y 2 log |g' y| - log y' M y. They
fall by log c for c times the information. A subgradient -G_j at any M_j, of value f_j, therefore bounds every other M:
f(M) >= f_j - log <G_j, M>. With weights l_j >= 0, sum l_j = 1, and multipliers m

    f >= -log (N e),   e = max_s <sum_j l_j exp(-f_j) G_j, A(s)> - m' d phi / dt (s).

The best l and m follow from a linear program over the states found so far, which are extended by the largest violations
(column generation), as are the matrices M_j by the program's mixtures (Kelley's cutting planes).

Certificate: l, m, and e. phi are polynomials in position, velocity and torque, some of them times |velocity|. What is
numerical is e: the maximum over a grid of states, refined locally, in three variables; the torque rate enters linearly,
so its ends suffice. An estimate only is `mixture`: a mixture of states need not be a drive.

Limits count as exact; designs may exceed them by 0.1 %. Knots, duration and other limits are not used, so a drive may
be unable to attain the bound. Information is that of torque noise with the motion known exactly. Sensors that measure
the motion with noise give less, so the bound holds for the Cramer-Rao bound as well. Parameters are nominal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np
import scipy.optimize

from excite.model import Model
from excite.model.machine import Problem
from excite.trajectories import objective as objectives

Cut = Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]]

GRID_POINTS = 17  # of the search grid along position and torque; chosen
SPEED_POINTS = 12  # of the grid along the velocity, linear and logarithmic, either way; chosen
SMALLEST_SPEED = 1e-6  # of the grid, as a share of the limit; chosen
FIRST_STATES = 1200  # random states in the first linear program; chosen
ADDED_STATES = 300  # states added in a round; chosen
REFINED_STATES = 60  # states that are refined locally; chosen
REFINEMENTS = 12  # rounds of local refinement, each with half the radius of the one before; chosen
TRIES = 20  # random states around each in a round of refinement; chosen
KEPT_STATES = 3000  # states kept from round to round; chosen
STEPS = (0.1, 0.5, 0.95)  # from the best mixture towards the linear program's, where cuts are made; chosen
MOST_CONFIRMED = 5  # certificates that are searched thoroughly; chosen
ZERO_DRIFT = 1e-7  # drift that counts as zero, as a share of the largest; chosen
LARGEST_MULTIPLIER = 1e3  # of a drift of size one, in units of e; keeps multipliers from jumping; chosen


@dataclass(frozen=True)
class AccuracyBound:
    """Lower bound on a relative standard deviation after a drive.

    certified_percent: the bound [%]. mixture_percent: what the best mixture of states found attains [%], an upper bound
    on the relaxation's optimum. rounds: of column generation. degree: of the polynomials.
    """

    of: str
    certified_percent: float
    mixture_percent: float
    rounds: int
    degree: int

    def gap_percent(self, percent: float) -> float:
        """Return by how much a drive's value [%] lies above the bound, in per cent of the bound."""
        return 100 * (percent / self.certified_percent - 1)


def bound_refusal(model: Model, problem: Problem) -> str | None:
    """Say why there is no bound for a problem, None if there is one."""
    name = model.machine.name
    if len(model.coordinates) != 1 or len(model.inputs) != 1 or model.effects:
        return f"{name}: the bound on accuracy is for machines with one driven joint and no effects"
    if model.known:
        return f"{name}: the bound on accuracy does not count parameters that are known"
    if not problem.rest or any(problem.end_pose.get(c, x) != x for c, x in problem.start_pose.items()):
        return f"{name}: the bound on accuracy is for drives that begin and end at rest in one place"
    if None in _own_limits(model):
        return f"{name}: the bound on accuracy needs limits of position, rate, torque and torque_rate"
    return None


def _own_limits(model: Model) -> list[float | None]:
    """Return the limits of position, velocity, torque and torque rate of the first driven joint."""
    own = model.machine.actuated[0].limit
    return [None if x is None else float(x) for x in (own.position, own.rate, own.torque, own.torque_rate)]


def worst(M: np.ndarray, contrasts: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the log of the largest variance and its negative subgradient (n, n) in the information M (n, n)."""
    Y = np.linalg.solve(M, contrasts)
    v = (contrasts * Y).sum(axis=0)
    k = int(np.argmax(v))
    return float(np.log(v[k])), np.outer(Y[:, k], Y[:, k]) / v[k]


def mean(M: np.ndarray, contrasts: np.ndarray) -> tuple[float, np.ndarray]:
    """Return twice the log of the mean standard deviation and its negative gradient (n, n)."""
    Y = np.linalg.solve(M, contrasts)
    sigma = np.sqrt((contrasts * Y).sum(axis=0))
    return 2 * float(np.log(sigma.mean())), (Y / sigma) @ Y.T / sigma.sum()


def accuracy(M: np.ndarray, contrasts: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the mean of `worst` and `mean`, which is the objective `accuracy`, and its negative subgradient."""
    (f, G), (h, H) = worst(M, contrasts), mean(M, contrasts)
    return (f + h) / 2, (G + H) / 2


CUTS: dict[str, Cut] = {"worst": worst, "mean": mean, "accuracy": accuracy}


def bound_accuracy(
    model: Model,
    problem: Problem,
    of: str = "worst",
    parameters: tuple[str, ...] | None = None,
    degree: int = 3,
    rounds: int = 30,
    gap: float = 0.002,
    seed: int = 0,
) -> AccuracyBound:
    """Compute a lower bound on the standard deviations of parameters after any drive of a problem.

    of: worst, mean, or accuracy, the geometric mean of both. parameters: those that count, all by default.
    degree: of the polynomials. rounds, gap: the search ends after `rounds`, or when bound and mixture differ by less
    than the share `gap`.

    Raises KeyError for another `of`, ValueError for what `bound_refusal` refuses, RuntimeError if a linear program
    fails.
    """
    cut = CUTS[of]
    states = _JointStates(model, problem, degree)
    names = model.base.names if parameters is None else parameters
    contrasts = np.diag(model.scale / objectives.reference_values(model))
    contrasts = contrasts[:, [model.base.names.index(n) for n in names]]
    samples = round(float(problem.duration_s) * float(model.machine.sampling_hz)) + 1
    rng = np.random.default_rng(seed)
    grid = states.grid()
    Z = np.hstack([states.random(FIRST_STATES, rng), grid[:, rng.integers(0, grid.shape[1], FIRST_STATES // 2)]])
    M = _mixture(states.columns(Z)[0], np.full(Z.shape[1], 1 / Z.shape[1]))
    cuts: list[tuple[float, np.ndarray]] = [cut(M, contrasts)]
    attained, still = np.inf, False
    proofs: list[tuple[float, _LinearProgram]] = []
    for _ in range(rounds):
        rows, drift = states.columns(Z)
        program = _LinearProgram(rows, drift, cuts)
        everywhere = states.refine(program.violation, np.hstack([grid, states.random(8 * FIRST_STATES, rng)]), rng)
        over = program.violation(*states.columns(everywhere))
        proofs.append((max(program.e, float(over.max())), program))
        now = _mixture(rows, program.weights)
        steps = [(x, *cut(x, contrasts)) for x in ((1 - share) * M + share * now for share in STEPS)]
        cuts += [(f, G) for _, f, G in steps]  # valid whatever the drift of the mixture
        if program.remaining_drift < ZERO_DRIFT:
            if not still:
                M, still = now, True
            for x in (*(x for x, _, _ in steps), now) if attained < np.inf else (now,):
                f = cut(x, contrasts)[0]
                M, attained = (x, f) if f < attained else (M, attained)
        if attained + np.log(min(e for e, _ in proofs)) < 2 * np.log1p(gap):
            break
        kept = np.argsort(-np.where(program.weights > 1e-9, np.inf, program.violation(rows, drift)))[:KEPT_STATES]
        added = rng.permutation(np.flatnonzero(over > program.e))[:ADDED_STATES]
        worst_of_all = np.argsort(-over)[: ADDED_STATES // 4]
        Z = np.hstack([Z[:, kept], everywhere[:, worst_of_all], everywhere[:, added]])
    best = -float(np.log(_confirm(states, proofs, rng)))
    value = 100 / np.sqrt(samples)
    return AccuracyBound(of, float(value * np.exp(best / 2)), float(value * np.exp(attained / 2)), len(proofs), degree)


def _confirm(states: _JointStates, proofs: list[tuple[float, _LinearProgram]], rng: np.random.Generator) -> float:
    """Search thoroughly against the best certificates; return the least e.

    The apparently best certificate is the one most likely to have an overlooked violation.
    """
    grid, least = states.grid(2), np.inf
    for e, program in sorted(proofs, key=lambda proof: proof[0])[:MOST_CONFIRMED]:
        if e >= least:
            break
        tried = states.refine(program.violation, np.hstack([grid, states.random(40 * FIRST_STATES, rng)]), rng)
        least = min(least, max(e, float(program.violation(*states.columns(tried)).max())))
    return least


def _mixture(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mean information (n, n) of rows (n_k, n) with weights (n_k,)."""
    return np.asarray((rows.T * weights) @ rows)


class _LinearProgram:
    """The best mixture of states for all cuts, and the certificate that its dual gives.

    e: value. weights (n_k,): of the states. remaining_drift: largest of the mixture, 0 if it may be one of a drive.
    """

    def __init__(self, rows: np.ndarray, drift: np.ndarray, cuts: list[tuple[float, np.ndarray]]) -> None:
        self.G = np.array([np.exp(-f) * G for f, G in cuts])
        gains = np.einsum("jab,ka,kb->jk", self.G, rows, rows)
        unit = float(gains.mean())
        self.size = np.maximum(np.abs(drift).max(axis=0), 1e-12)
        n, n_phi = len(rows), drift.shape[1]
        # Variables: weights, remaining drift up and down, value of the worst cut.
        cost = np.concatenate([np.zeros(n), np.full(2 * n_phi, LARGEST_MULTIPLIER), [-1.0]])
        above = np.hstack([-gains / unit, np.zeros((len(cuts), 2 * n_phi)), np.ones((len(cuts), 1))])
        still = np.hstack([(drift / self.size).T, np.eye(n_phi), -np.eye(n_phi), np.zeros((n_phi, 1))])
        equal = np.vstack([still, np.concatenate([np.ones(n), np.zeros(2 * n_phi + 1)])])
        found = scipy.optimize.linprog(
            cost,
            A_ub=above,
            b_ub=np.zeros(len(cuts)),
            A_eq=equal,
            b_eq=np.append(np.zeros(n_phi), 1.0),
            bounds=[(0, None)] * (n + 2 * n_phi) + [(None, None)],
            method="highs",
        )
        if found.x is None:
            raise RuntimeError(f"the linear program over {n} states failed: {found.message}; take a lower degree")
        self.weights = np.maximum(found.x[:n], 0) / np.maximum(found.x[:n], 0).sum()
        self.remaining_drift = float(found.x[n:-1].max(initial=0.0))
        share = np.maximum(-found.ineqlin.marginals, 0)
        share = share / share.sum()
        self.combined = np.tensordot(share, self.G, 1)
        self.m = found.eqlin.marginals[:-1] / self.size * unit
        self.e = float(self.violation(rows, drift).max())

    def violation(self, rows: np.ndarray, drift: np.ndarray) -> np.ndarray:
        """Return <G, A> - m' d phi / dt (n_k,) of states."""
        gain = np.einsum("ka,ab,kb->k", rows, self.combined, rows)
        # HiGHS gives sensitivities of the cost: the sign that makes the weighted states equally good
        return np.asarray(gain + drift @ self.m)


class _JointStates:
    """States z (4, n_k) of the only joint: position, velocity, torque, torque rate, scaled to +-1 by their limits."""

    def __init__(self, model: Model, problem: Problem, degree: int) -> None:
        refused = bound_refusal(model, problem)
        if refused is not None:
            raise ValueError(refused)
        self.size = np.array([x for x in _own_limits(model) if x is not None])
        q, nu, u = ca.SX.sym("q"), ca.SX.sym("v"), ca.SX.sym("u")
        a = model.accelerate(q, nu, u, ca.DM(model.nominal))
        W = model.regressor(q, nu, a) @ ca.diag(ca.DM(model.scale)) / float(objectives.row_noise(model)[0])
        self.sample = ca.Function("sample", [q, nu, u], [W.T, a])
        powers = [p for p in product(range(degree + 1), repeat=3) if 0 < sum(p) <= degree]
        self.plain = np.array(powers)
        self.bent = np.array([p for p in product(range(degree), repeat=3) if sum(p) < degree])

    def columns(self, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows (n_k, n) of the weighted regressor and drifts d phi / dt (n_k, n_phi) of states."""
        q, v, u = self.size[:3, None] * Z[:3]
        rows, a = (x.full() for x in self.sample(q[None], v[None], u[None]))
        flow = np.array([v, a[0], self.size[3] * Z[3]]) / self.size[:3, None]
        powers = np.vstack([self.plain, self.bent])
        table = Z[:3, None] ** np.arange(powers.max() + 1)[:, None]  # (3, degree + 1, n_k)
        factors = [table[k, powers[:, k]] for k in range(3)]
        slopes = [powers[:, k, None] * table[k, np.maximum(powers[:, k] - 1, 0)] for k in range(3)]
        others = [factors[1] * factors[2], factors[0] * factors[2], factors[0] * factors[1]]
        drift = sum((flow[k] * slopes[k] * others[k] for k in range(3)), np.zeros((len(powers), Z.shape[1])))
        bent = slice(len(self.plain), None)
        whole = np.prod(factors, axis=0)
        drift[bent] = np.abs(Z[1]) * drift[bent] + np.sign(Z[1]) * flow[1] * whole[bent]
        return rows.T, drift.T

    def grid(self, finer: int = 1) -> np.ndarray:
        """Return states on a grid, dense around standstill, at both ends of the torque rate."""
        even, n = np.linspace(-1, 1, finer * (GRID_POINTS - 1) + 1), finer * SPEED_POINTS
        speed = np.concatenate([np.linspace(0, 1, n + 1)[1:], np.geomspace(SMALLEST_SPEED, 0.5, n)])
        every = np.meshgrid(even, np.concatenate([-speed, speed]), even, [-1.0, 1.0], indexing="ij")
        return np.array([x.ravel() for x in every])

    def random(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return random states: each value on its limit in a quarter of them, slow ones in a quarter."""
        Z = rng.uniform(-1, 1, (4, count))
        Z = np.where(rng.random(Z.shape) < 0.25, np.sign(Z), Z)
        Z[1] *= np.where(rng.random(count) < 0.25, 10 ** rng.uniform(-6, 0, count), 1.0)
        Z[3] = np.sign(Z[3])
        return Z

    def refine(
        self,
        value: Callable[[np.ndarray, np.ndarray], np.ndarray],
        Z: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Return states with the largest values, each moved to the best of random states around it, again and again."""
        found = value(*self.columns(Z))
        order = np.argsort(-found)[: ADDED_STATES * 4]
        Z, found = Z[:, order], found[order]
        top, best = Z[:, :REFINED_STATES].copy(), found[:REFINED_STATES].copy()
        for k in range(REFINEMENTS):
            radius = 0.1 * 0.5**k
            near = np.repeat(top, TRIES, axis=1)
            near[:3] += radius * rng.normal(size=near[:3].shape)
            near[1] = np.where(rng.random(near.shape[1]) < 0.5, near[1], np.repeat(top[1], TRIES) * (1 + radius))
            near = np.clip(near, -1, 1)
            values = value(*self.columns(near)).reshape(-1, TRIES)
            winner = values.argmax(axis=1)
            better = values.max(axis=1) > best
            rows = near.reshape(4, -1, TRIES)[:, np.arange(len(best)), winner]
            top, best = np.where(better, rows, top), np.where(better, values.max(axis=1), best)
        return np.hstack([top, Z])
