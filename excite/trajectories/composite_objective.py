"""What a design is after: terms of objectives put together, on the information that there will be after the drive.

An aim is a weighted sum of terms. A term is an objective of J = D (A + prior) D: A the information of the drive, rows
of the regressor weighted by their noise; prior what is known already (the inverse covariance of an earlier estimate);
D the units that parameters count in. All of it is in the model's scale, so that the numbers have no unit. One term is
the plain objective. A prior on each makes it sequential, one term for every machine that it could be makes it robust,
and a term that only counts above a ceiling keeps an accuracy.

Objectives of relative variances are judged by the Cramer-Rao bound of all sensors together (`smoothing.cramer_rao`).
The weighted regressor is its smooth surrogate; `calibrated` makes the two agree, parameter by parameter, at a drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite import smoothing
from excite.model import Model
from excite.simulation import Motion, effect_inputs
from excite.trajectories import objective as objectives
from excite.trajectories.objective import EXACT, OBJECTIVES, Local, percent, relative

# A ceiling is a smooth hinge: PRICE for what is above it, per unit of the logarithm of a variance, from WIDTH on.
PRICE, WIDTH = 30.0, 0.01
SIGMA_MAX = "sigma-max"


@dataclass(frozen=True)
class Term:
    """weight * objective(D (A + prior) D); D = diag(columns), columns (n_base,), prior (n_base, n_base), in the scale.

    block: the row of `Aim.rows` that weights the regressor. ceiling: where given, only what is above it counts.
    """

    objective: str
    columns: np.ndarray
    block: int
    weight: float = 1.0
    prior: np.ndarray | None = None
    ceiling: float | None = None

    @property
    def of_variances(self) -> bool:
        return OBJECTIVES[self.objective].of == "variances"


@dataclass(frozen=True)
class Aim:
    """Terms, with the weights (n_blocks, n_rows) of the regressor's rows [1/SI] they look at; scale (n_base,) [SI].

    sigma_max [%]: what the Cramer-Rao bound of the worst parameter may be. prior (n_base, n_base) in the scale.
    machines: that the drive is for, each with a term in that order; none where it is for the nominal one alone.
    """

    name: str
    terms: tuple[Term, ...]
    rows: np.ndarray
    scale: np.ndarray
    sigma_max: float | None = None
    prior: np.ndarray | None = None
    machines: tuple[Model, ...] = ()


def aim(
    model: Model,
    objective: str,
    sigma_max: float | None = None,
    prior: np.ndarray | None = None,
    machines: Sequence[Model] = (),
) -> Aim:
    """An objective by name, put together with what else is asked for.

    sigma_max [%]: a ceiling on the worst parameter's relative standard deviation. prior (n_base, n_base): information
    that is there already [1/SI^2]. machines: the scenarios, whose scores are averaged; the model alone by default.
    Raises KeyError for an unknown objective and ValueError for a bad prior or ceiling.
    """
    if objective not in OBJECTIVES:
        raise KeyError(f"no objective {objective}, allowed: {', '.join(OBJECTIVES)}")
    if sigma_max is not None and not sigma_max > 0:
        raise ValueError(f"sigma_max: must be > 0 % (got {sigma_max:g})")
    n = len(model.scale)
    if prior is not None and (prior.shape != (n, n) or not np.isfinite(prior).all()):
        raise ValueError(f"prior: needs finite numbers of shape ({n}, {n}), got {prior.shape}")
    noise = objectives.row_noise(model)
    # rows that count alike have one noise, so that a prior weighs as much as it tells
    rows = np.stack([np.full(len(noise), 1 / np.sqrt(np.mean(noise**2))), 1 / noise])
    chosen = OBJECTIVES[objective]
    every = tuple(machines) or (model,)
    known = None if prior is None else prior * model.scale * model.scale[:, None]
    terms = [
        Term(
            objective,
            (m.scale if chosen.of == "eigenvalues" else relative(m)) / model.scale,
            int(chosen.weighted),
            1 / len(every),
            known,
        )
        for m in every
    ]
    if sigma_max is not None:
        ceiling = 2 * float(np.log(sigma_max / 100))
        terms += [Term("worst", relative(m) / model.scale, 1, PRICE / len(every), known, ceiling) for m in every]
    used = sorted({t.block for t in terms})
    terms = [replace(t, block=used.index(t.block)) for t in terms]
    return Aim(objective, tuple(terms), rows[used], model.scale, sigma_max, known, tuple(machines))


# ------------------------------------------------------------------------------------------------ for the program


def value(aim: Aim, A: Sequence[np.ndarray] | np.ndarray, sharp: float = EXACT) -> float:
    """The aim of information matrices (n_base, n_base), one for each of `aim.rows`; inf where one is singular."""
    total = 0.0
    for term in aim.terms:
        x = objectives.value(term.objective, _seen(term, A[term.block]), sharp)
        if not np.isfinite(x):
            return float("inf")
        total += term.weight * (x if term.ceiling is None else _hinge(x - term.ceiling)[0])
    return total


def local(aim: Aim, A: Sequence[np.ndarray] | np.ndarray, rows: np.ndarray, columns: np.ndarray, sharp: float) -> Local:
    """Value, slope and convex curvature by the entries A_b[rows, columns] of all information matrices in turn."""
    n_a = len(rows)
    total, slope = 0.0, np.zeros(len(A) * n_a)
    factors: list[np.ndarray] = []
    for term in aim.terms:
        near = objectives.local(term.objective, _seen(term, A[term.block]), rows, columns, sharp)
        own = slice(term.block * n_a, (term.block + 1) * n_a)
        by = term.columns[rows] * term.columns[columns]
        x, push, bend = near.value, 1.0, 0.0
        if term.ceiling is not None:
            x, push, bend = _hinge(x - term.ceiling)
        total += term.weight * x
        slope[own] += term.weight * push * by * near.slope
        columns_of = [np.sqrt(term.weight * push) * by[:, None] * near.factor]
        if bend > 0:
            columns_of.append(np.sqrt(term.weight * bend) * (by * near.slope)[:, None])
        factor = np.zeros((len(slope), sum(f.shape[1] for f in columns_of)))
        factor[own] = np.hstack(columns_of)
        factors.append(factor)
    factor = np.hstack(factors)
    if factor.shape[1] > len(slope):
        factor = objectives.factored(factor @ factor.T)
    return Local(total, slope, factor)


def _seen(term: Term, A: np.ndarray) -> np.ndarray:
    """J = D (A + prior) D."""
    J = A if term.prior is None else A + term.prior
    return np.asarray(J * term.columns * term.columns[:, None])


def _hinge(x: float) -> tuple[float, float, float]:
    """A smooth max(x, 0), its slope and its curvature."""
    z = x / WIDTH
    share = 1 / (1 + np.exp(-np.clip(z, -500, 500)))
    return WIDTH * float(np.logaddexp(0, z)), float(share), float(share * (1 - share)) / WIDTH


# ------------------------------------------------------------------------------------------------ of a motion


def information(aim: Aim, model: Model, motion: Motion) -> list[np.ndarray]:
    """The matrices (n_base, n_base) of a motion in the scale, every sample counted, one for each of `aim.rows`."""
    W = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T, *effect_inputs(model, motion))
    found: list[np.ndarray] = []
    for weights in aim.rows:
        # by QR: squaring W would cost half of the digits
        R = np.asarray(np.linalg.qr((W * weights[:, None] * aim.scale).reshape(-1, W.shape[2]), mode="r"))
        found.append(R.T @ R)
    return found


def covariance(aim: Aim, model: Model, motion: Motion) -> np.ndarray:
    """(n_base, n_base) the Cramer-Rao bound [SI^2] after the drive, with what is known before."""
    C = smoothing.cramer_rao(model, motion, "full")
    if aim.prior is None:
        return C
    by = np.outer(aim.scale, aim.scale)
    return np.asarray(np.linalg.inv(np.linalg.inv(C / by) + aim.prior) * by)


def sigma_percent(aim: Aim, model: Model, motion: Motion) -> np.ndarray:
    """(n_base,) attainable relative standard deviations [%] after the drive."""
    return percent(model, covariance(aim, model, motion))


@dataclass(frozen=True)
class Judged:
    """What a drive is worth: the aim's score (lower is better), and the worst parameter's deviation [%] where asked."""

    score: float
    worst_percent: float


def judge(aim: Aim, motions: Sequence[tuple[Model, Motion]]) -> Judged:
    """The score over the machines that a drive is for, each with its own motion, and the worst deviation [%] of all.

    Objectives of variances are judged by the Cramer-Rao bound; without those and without a `sigma_max` the deviation is
    not looked at, and 0.
    """
    primary = [t for t in aim.terms if t.ceiling is None]
    total, worst = 0.0, 0.0
    for term, (model, motion) in zip(primary, motions, strict=True):
        spread = sigma_percent(aim, model, motion) if term.of_variances or aim.sigma_max is not None else None
        if spread is not None:
            worst = max(worst, float(spread.max()))
        if term.of_variances:
            assert spread is not None
            total += term.weight * objectives.of_values(term.objective, (spread / 100) ** 2)
        else:
            A = information(replace(aim, rows=aim.rows[[term.block]]), model, motion)[0]
            total += term.weight * objectives.value(term.objective, _seen(term, A))
    return Judged(total, worst)


def optimism(aim: Aim, model: Model, motion: Motion) -> np.ndarray | None:
    """(n_base,) the Cramer-Rao bound's variances over the surrogate's along a motion of the nominal machine.

    None where the aim has no objective of variances.
    """
    for term in aim.terms:
        if term.of_variances:
            A = information(replace(aim, rows=aim.rows[[term.block]]), model, motion)[0]
            J = _seen(term, A)
            thought = np.diag(np.linalg.inv(J)) * term.columns**2
            return np.asarray(np.diag(covariance(aim, model, motion)) / aim.scale**2 / thought)
    return None


def calibrated(aim: Aim, optimism: np.ndarray) -> Aim:
    """The aim with surrogates of variances that much larger: they give the bound where the optimism is that of."""
    terms = tuple(replace(t, columns=t.columns / np.sqrt(optimism)) if t.of_variances else t for t in aim.terms)
    return replace(aim, terms=terms)


def lowered(aim: Aim, share: float) -> Aim:
    """The aim with its ceilings lower by this share of the deviation."""
    down = 2 * float(np.log1p(share))
    return replace(
        aim, terms=tuple(t if t.ceiling is None else replace(t, ceiling=t.ceiling - down) for t in aim.terms)
    )
