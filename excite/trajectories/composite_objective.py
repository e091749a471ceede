"""Objective of one design: a weighted sum of terms from OBJECTIVES, on the information after the drive.

A term scores J = D (A + prior) D in the model's scale, without units. A is the information of the drive with rows
weighted by their noise, `prior` the information from earlier logs, D the reference values of the parameters. A prior
makes a design sequential, one term per possible machine makes it robust, and a ceiling bounds the inaccuracy.

Objectives of variances are reported by the Cramer-Rao bound of all sensors (`smoothing.cramer_rao`). The weighted
regressor is a smooth surrogate of it; `calibrate_surrogates` makes both agree at one drive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite import smoothing
from excite.model import Model
from excite.simulation import Motion, effect_inputs
from excite.trajectories import objective as objectives
from excite.trajectories.arm_bound import arm_bound
from excite.trajectories.objective import (
    EXACT_SHARPNESS,
    OBJECTIVES,
    LocalModel,
    reference_values,
    relative_std_percent,
)

CEILING_PRICE = 30.0  # price of a log variance above a ceiling, per unit; chosen
CEILING_WIDTH = 0.01  # log variance over which that hinge is rounded; chosen
SIGMA_MAX = "sigma-max"  # name of the ceiling among the violations of a drive
COND_MAX = "cond-max"  # the same of a largest condition number


@dataclass(frozen=True)
class Term:
    """weight * objective(D (A + prior) D) with D = diag(column_scale), in the model's scale.

    column_scale (n_base,). block: row of `CompositeObjective.row_weights`. prior (n_base, n_base). ceiling: if given,
    only the excess over it counts. contrasts (n_base, m): of relative errors, each parameter by default.
    """

    objective: str
    column_scale: np.ndarray
    block: int
    weight: float = 1.0
    prior: np.ndarray | None = None
    ceiling: float | None = None
    contrasts: np.ndarray | None = None

    @property
    def of_variances(self) -> bool:
        return OBJECTIVES[self.objective].of == "variances"


@dataclass(frozen=True)
class CompositeObjective:
    """Terms and the data they share.

    row_weights (n_blocks, n_rows) [1/SI]: factors of the regressor's rows. scale (n_base,) [SI]. sigma_max [%]: bound
    on the Cramer-Rao standard deviation of the least accurate parameter. prior (n_base, n_base), in the scale.
    machines: machines that the drive is for, the nominal one first; empty for that alone. Each has a term of its own,
    or the nominal one has the only term and the others just keep their limits. cond_max: bound on cond(Phi).
    """

    name: str
    terms: tuple[Term, ...]
    row_weights: np.ndarray
    scale: np.ndarray
    sigma_max: float | None = None
    prior: np.ndarray | None = None
    machines: tuple[Model, ...] = ()
    cond_max: float | None = None

    def judged(self, model: Model) -> tuple[Model, ...]:
        """Return the machines whose motions are scored, one per term that is no ceiling."""
        scored = sum(t.ceiling is None for t in self.terms)
        return (self.machines or (model,))[:scored]


def compose_objective(
    model: Model,
    objective: str,
    sigma_max: float | None = None,
    prior: np.ndarray | None = None,
    machines: Sequence[Model] = (),
    cond_max: float | None = None,
    contrasts: np.ndarray | None = None,
) -> CompositeObjective:
    """Build the objective of a design from a name and the requirements beside it.

    objective: a name in OBJECTIVES.
    sigma_max [%]: bound on the largest relative standard deviation.
    prior (n_base, n_base) [1/SI^2]: information from earlier logs. What the machine file calls known adds to it, but
        not in a condition number, which is of the regressor.
    machines: possible machines, whose scores are averaged; the model alone by default.
    cond_max: bound on cond(Phi).
    contrasts (n_base, m): combinations of relative parameter errors whose variances count in an objective of variances.
        By default every parameter, and the magnitude of every effect in `discrimination`; a prediction needs those of
        `prediction_contrasts`.

    Raises KeyError for an unknown objective and ValueError for a bad prior or sigma_max, or a lack of contrasts.
    """
    if objective not in OBJECTIVES:
        raise KeyError(f"no objective {objective}, allowed: {', '.join(OBJECTIVES)}")
    if sigma_max is not None and not sigma_max > 0:
        raise ValueError(f"sigma_max: must be > 0 % (got {sigma_max:g})")
    n = len(model.scale)
    if prior is not None and (prior.shape != (n, n) or not np.isfinite(prior).all()):
        raise ValueError(f"prior: needs finite numbers of shape ({n}, {n}), got {prior.shape}")
    noise = objectives.row_noise(model)
    # Row 0: one noise for all rows, in units in which a prior adds up. Row 1: each row by its own noise.
    rows = np.stack([np.full(len(noise), 1 / np.sqrt(np.mean(noise**2))), 1 / noise])
    chosen = OBJECTIVES[objective]
    if contrasts is None and chosen.contrasts != "parameters":
        contrasts = rival_contrasts(model) if chosen.contrasts == "rivals" else np.empty((n, 0))
        if not contrasts.size:
            raise ValueError(f"objective {objective}: nothing to judge by, give contrasts")
    every = tuple(machines) or (model,)
    known = None if prior is None else prior * model.scale * model.scale[:, None]
    total = _with_known(model, known)
    own = known if chosen.shown_as == "cond" else total
    terms = [
        Term(
            objective,
            (m.scale if chosen.of == "eigenvalues" else reference_values(m)) / model.scale,
            int(chosen.weighted),
            1 / len(every),
            own,
            contrasts=contrasts if chosen.of == "variances" else None,
        )
        for m in every
    ]
    if sigma_max is not None:
        ceiling = 2 * float(np.log(sigma_max / 100))
        terms += [
            Term("worst", reference_values(m) / model.scale, 1, CEILING_PRICE / len(every), total, ceiling)
            for m in every
        ]
    if cond_max is not None:
        ceiling = 2 * float(np.log(cond_max))
        terms += [Term("cond", m.scale / model.scale, 0, CEILING_PRICE / len(every), known, ceiling) for m in every]
    used = sorted({t.block for t in terms})
    terms = [replace(t, block=used.index(t.block)) for t in terms]
    return CompositeObjective(
        objective, tuple(terms), rows[used], model.scale, sigma_max, known, tuple(machines), cond_max
    )


def rival_contrasts(model: Model, names: Sequence[str] | None = None) -> np.ndarray:
    """Return unit contrasts (n_base, m) of parameters by name: by default the magnitudes of all effects shown."""
    names = [e.name for e in model.effects if e.name in model.base.names] if names is None else names
    return np.eye(len(model.scale))[:, [model.base.names.index(n) for n in names]]


def _with_known(model: Model, prior: np.ndarray | None) -> np.ndarray | None:
    """Add what the machine file calls known to a prior (n_base, n_base), scaled; None if there is neither."""
    if not model.known:
        return prior
    information = model.known.information(model.scale)
    return information if prior is None else prior + information


# ------------------------------------------------------------------------------------------------ of matrices


def score_matrices(
    objective: CompositeObjective, A: Sequence[np.ndarray] | np.ndarray, sharpness: float = EXACT_SHARPNESS
) -> float:
    """Score information matrices (n_base, n_base), one per row of `row_weights`; inf if one is singular."""
    total = 0.0
    for term in objective.terms:
        x = objectives.score_matrix(term.objective, _accumulated(term, A[term.block]), sharpness, term.contrasts)
        if not np.isfinite(x):
            return float("inf")
        total += term.weight * (x if term.ceiling is None else _smooth_hinge(x - term.ceiling)[0])
    return total


def local_model(
    objective: CompositeObjective,
    A: Sequence[np.ndarray] | np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    sharpness: float,
) -> LocalModel:
    """Expand the objective in the entries A_b[rows, columns] of all information matrices, block after block."""
    n_a = len(rows)
    total, slope = 0.0, np.zeros(len(A) * n_a)
    factors: list[np.ndarray] = []
    for term in objective.terms:
        J = _accumulated(term, A[term.block])
        near = objectives.local_model(term.objective, J, rows, columns, sharpness, term.contrasts)
        own = slice(term.block * n_a, (term.block + 1) * n_a)
        by = term.column_scale[rows] * term.column_scale[columns]
        x, push, bend = near.value, 1.0, 0.0
        if term.ceiling is not None:
            x, push, bend = _smooth_hinge(x - term.ceiling)
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
        factor = objectives.factor_positive_part(factor @ factor.T)
    return LocalModel(total, slope, factor)


def exact_derivatives(
    objective: CompositeObjective,
    A: Sequence[np.ndarray] | np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    sharpness: float,
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return value, slope (n,) and Hessian (n, n) in the entries A_b[rows, columns] of all information matrices."""
    n_a = len(rows)
    total, slope, hessian = 0.0, np.zeros(len(A) * n_a), np.zeros((len(A) * n_a, len(A) * n_a))
    for term in objective.terms:
        J = _accumulated(term, A[term.block])
        x, g, H = objectives.exact_derivatives(term.objective, J, rows, columns, sharpness, term.contrasts)
        own = slice(term.block * n_a, (term.block + 1) * n_a)
        by = term.column_scale[rows] * term.column_scale[columns]
        g, H = by * g, by[:, None] * H * by
        push, bend = 1.0, 0.0
        if term.ceiling is not None:
            x, push, bend = _smooth_hinge(x - term.ceiling)
        total += term.weight * x
        slope[own] += term.weight * push * g
        hessian[own, own] += term.weight * (push * H + bend * np.outer(g, g))
    return total, slope, hessian


def matrix_gradient(objective: CompositeObjective, A: np.ndarray, sharpness: float) -> tuple[float, np.ndarray]:
    """Return the objective and its gradient (n_blocks, n, n) in the information matrices A (n_blocks, n, n).

    Raises LinAlgError for a singular matrix.
    """
    total, gradient = 0.0, np.zeros_like(A)
    for term in objective.terms:
        J = _accumulated(term, A[term.block])
        x, G = objectives.matrix_gradient(term.objective, J, sharpness, term.contrasts)
        push = 1.0
        if term.ceiling is not None:
            x, push, _ = _smooth_hinge(x - term.ceiling)
        total += term.weight * x
        gradient[term.block] += term.weight * push * G * np.outer(term.column_scale, term.column_scale)
    return total, gradient


def _accumulated(term: Term, A: np.ndarray) -> np.ndarray:
    """Return J = D (A + prior) D."""
    J = A if term.prior is None else A + term.prior
    return np.asarray(J * term.column_scale * term.column_scale[:, None])


def _smooth_hinge(x: float) -> tuple[float, float, float]:
    """Return a smooth max(x, 0), its slope and its curvature."""
    z = x / CEILING_WIDTH
    share = 1 / (1 + np.exp(-np.clip(z, -500, 500)))
    return CEILING_WIDTH * float(np.logaddexp(0, z)), float(share), float(share * (1 - share)) / CEILING_WIDTH


# ------------------------------------------------------------------------------------------------ of a motion


def information_matrices(objective: CompositeObjective, model: Model, motion: Motion) -> list[np.ndarray]:
    """Return a motion's information matrices (n_base, n_base) in the scale, one per row of `row_weights`."""
    W = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T, *effect_inputs(model, motion))
    found: list[np.ndarray] = []
    for weights in objective.row_weights:
        # QR, since W' W would lose half of the digits
        R = np.asarray(np.linalg.qr((W * weights[:, None] * objective.scale).reshape(-1, W.shape[2]), mode="r"))
        found.append(R.T @ R)
    return found


def _term_information(objective: CompositeObjective, term: Term, model: Model, motion: Motion) -> np.ndarray:
    return information_matrices(replace(objective, row_weights=objective.row_weights[[term.block]]), model, motion)[0]


def motion_bound(model: Model, motion: Motion, noise_factors: Mapping[str, float] | None = None) -> np.ndarray:
    """Return the Cramer-Rao bound (n_base, n_base) [SI^2] of all sensors along a motion alone.

    noise_factors, errors: as of `smoothing.cramer_rao`.
    """
    if model.follows_positions and model.plain:
        return arm_bound(model, motion, noise_factors)
    return smoothing.cramer_rao(model, motion, "full", noise_factors=noise_factors)


def covariance_bound(objective: CompositeObjective, model: Model, motion: Motion) -> np.ndarray:
    """Return the Cramer-Rao bound (n_base, n_base) [SI^2] after the drive, with the prior information."""
    C = motion_bound(model, motion)
    if objective.prior is None:
        return C
    by = np.outer(objective.scale, objective.scale)
    return np.asarray(np.linalg.inv(np.linalg.inv(C / by) + objective.prior) * by)


def sigma_percent(objective: CompositeObjective, model: Model, motion: Motion) -> np.ndarray:
    """Return the attainable relative standard deviations (n_base,) [%] after the drive."""
    return relative_std_percent(model, covariance_bound(objective, model, motion))


@dataclass(frozen=True)
class DriveScore:
    """Score of a drive, lower is better, and the largest relative standard deviation [%], 0 if not computed."""

    score: float
    worst_percent: float


def score_motions(objective: CompositeObjective, motions: Sequence[tuple[Model, Motion]]) -> DriveScore:
    """Score a drive over the machines that it is for, given the motion of each.

    The Cramer-Rao bound is computed for objectives of variances or if `sigma_max` is set.
    """
    primary = [t for t in objective.terms if t.ceiling is None]
    total, worst = 0.0, 0.0
    for term, (model, motion) in zip(primary, motions, strict=True):
        C = None
        if term.of_variances or objective.sigma_max is not None:
            reference = reference_values(model)
            C = covariance_bound(objective, model, motion) / np.outer(reference, reference)
            worst = max(worst, 100 * float(np.sqrt(np.diag(C).max())))
        if term.of_variances:
            assert C is not None
            variances = objectives.contrast_variances(C, term.contrasts)
            total += term.weight * objectives.score_values(term.objective, variances)
        else:
            A = _term_information(objective, term, model, motion)
            total += term.weight * objectives.score_matrix(term.objective, _accumulated(term, A))
    return DriveScore(total, worst)


def surrogate_ratio(objective: CompositeObjective, model: Model, motion: Motion) -> np.ndarray | None:
    """Return the Cramer-Rao variances over the surrogate's (n_base,) along a motion of the nominal machine.

    None if no term is an objective of variances.
    """
    for term in objective.terms:
        if term.of_variances:
            A = _term_information(objective, term, model, motion)
            J = _accumulated(term, A)
            thought = np.diag(np.linalg.inv(J)) * term.column_scale**2
            return np.asarray(np.diag(covariance_bound(objective, model, motion)) / objective.scale**2 / thought)
    return None


def calibrate_surrogates(objective: CompositeObjective, optimism: np.ndarray) -> CompositeObjective:
    """Scale the surrogates of variances by this ratio (n_base,), so that they match the Cramer-Rao bound."""
    terms = tuple(
        replace(t, column_scale=t.column_scale / np.sqrt(optimism)) if t.of_variances else t for t in objective.terms
    )
    return replace(objective, terms=terms)


def lower_ceilings(objective: CompositeObjective, share: float) -> CompositeObjective:
    """Lower every ceiling by this share of the standard deviation."""
    down = 2 * float(np.log1p(share))
    return replace(
        objective,
        terms=tuple(t if t.ceiling is None else replace(t, ceiling=t.ceiling - down) for t in objective.terms),
    )
