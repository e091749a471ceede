"""Uncertainty budget: what the tolerances of the machine file do to an estimate.

Each tolerance is a further parameter that the file knows to be zero within its standard deviation (mixed estimation,
Theil and Goldberger, 1961): the log narrows it where it can, and it widens the intervals where it can't. That is to
first order, by the signatures of the tolerances in the white residuals of an estimate: S T S', with S the shift of the
estimate per tolerance and T what the log leaves of them (GUM, JCGM 100). The values stay those of an exact machine file
unless the log contradicts it. Where only the tolerances together with the parameters explain a log, `joint` estimates
them all. For least squares tolerances are only considered, in full (Schmidt, 1966).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from excite.identification.estimate import Estimate
from excite.identification.fit_tests import gram
from excite.identification.tolerances import Tolerance
from excite.identification.white_residuals import WhiteResiduals
from excite.model import Model

UNSEEN = 1e-4  # share of a signature that parameters do not absorb, below which it is rounding in single precision
CONTRADICTION_LEVEL = 0.01  # p-value of an exact machine file below which its errors correct an estimate; chosen
NOISE_SHARE = 0.5  # of a parameter's signature beside the others' from which it is called unidentifiable; chosen
ROUNDING = 1e-9  # information about each parameter over its scale that keeps one invertible that nothing shows; chosen


@dataclass(frozen=True)
class ToleranceErrors:
    """Errors of the machine file that an estimate found: value and standard deviation (K,), over the tolerances."""

    value: np.ndarray
    std: np.ndarray


def split(wide: Estimate, n: int, every: Sequence[Tolerance]) -> tuple[Estimate, ToleranceErrors]:
    """Split an estimate with tolerances behind its n parameters into the parameters and the errors of the file."""
    size = np.array([x.std for x in every])
    shifts = np.nan_to_num(wide.covariance)[:n, n:] / size
    covariance = wide.covariance[:n, :n] - shifts @ shifts.T
    with np.errstate(invalid="ignore"):
        by_noise = np.sqrt(np.diag(covariance)) / wide.std[:n]
    found = replace(
        wide,
        names=wide.names[:n],
        units=wide.units[:n],
        value=wide.value[:n],
        covariance=covariance,
        one_sided_std=None if wide.one_sided_std is None else wide.one_sided_std[:, :n] * by_noise,
        unidentifiable={k: v for k, v in wide.unidentifiable.items() if k in wide.names[:n]},
        tolerated={x.source: shifts[:, k] for k, x in enumerate(every)},
    )
    return found, ToleranceErrors(wide.value[n:] / size, wide.std[n:] / size)


def consider(model: Model, estimate: Estimate, white: Sequence[WhiteResiduals], every: Sequence[Tolerance]) -> Estimate:
    """Add tolerances to an estimate that no log can narrow, as their signature is a measured signal itself.

    model: with all tolerances, whose parameters the signatures of `white` are of; `every` are the last ones of them.
    """
    n, K = len(estimate.names), len(every)
    if not K:
        return estimate
    G, own = _products(model, white, len(model.base.names) - K, np.zeros(0, bool))
    shifts = -np.linalg.solve(G[1:own, 1:own], G[1:own, own:])[:n] * model.scale[:n, None]
    return replace(estimate, tolerated={**estimate.tolerated, **_by_source(every, shifts)})


def correct(
    model: Model, estimate: Estimate, white: Sequence[WhiteResiduals], every: Sequence[Tolerance], narrow: bool
) -> tuple[Estimate, ToleranceErrors]:
    """Add tolerances to an estimate for an exact machine file, and find the errors of the file that the logs show.

    If the logs contradict the file, the estimate is corrected by these errors, to first order; if not, it stays, and
    its intervals contain what the errors may be. narrow: whether logs narrow the tolerances; else they count in full.

    model: with all tolerances, whose parameters the signatures of `white` are of.
    """
    n, K = len(estimate.names), len(every)
    G, own = _products(model, white, n, ~np.isfinite(estimate.value))
    solved = np.linalg.solve(G[1:own, 1:own], np.column_stack([G[1:own, own:], G[1:own, 0]]))
    J = G[own:, own:] - np.eye(K) - G[own:, 1:own] @ solved[:, :K]
    g = G[own:, 0] - G[own:, 1:own] @ solved[:, K]
    # Residuals beyond noise count less, as in a quasi-likelihood.
    dispersion = max(
        1.0, float(np.sum([(w.z**2).sum() for w in white]) / max(np.sum([w.used.sum() for w in white]), 1))
    )
    size = np.sqrt(np.maximum(np.diag(G)[own:], 1e-300))
    open_ = np.array([not x.considered for x in every], float)
    share, axes = np.linalg.eigh((J + J.T) / 2 / np.outer(size, size) * np.outer(open_, open_))
    seen = share > UNSEEN
    pull = axes[:, seen].T @ (g * open_ / size)
    square = float(np.sum(pull**2 / share[seen])) / dispersion
    J = np.outer(size, size) * ((axes[:, seen] * share[seen]) @ axes[:, seen].T) / dispersion
    g = size * (axes[:, seen] @ pull) / dispersion
    posterior = np.linalg.inv(J + np.eye(K))
    found = -posterior @ g
    S = -solved[:, :K] * model.scale[:n, None]
    errors = ToleranceErrors(found, np.sqrt(np.diag(posterior)))
    if not narrow:
        return replace(estimate, tolerated=_by_source(every, S)), errors
    contradicted = scipy.stats.chi2.sf(square, max(int(seen.sum()), 1)) < CONTRADICTION_LEVEL
    left = posterior if contradicted else posterior + np.outer(found, found)
    value, vectors = np.linalg.eigh((left + left.T) / 2)
    shifts = S @ ((vectors * np.sqrt(np.maximum(value, 0.0))) @ vectors.T)
    corrected = estimate.value + S @ found if contradicted else estimate.value
    return replace(estimate, value=corrected, tolerated=_by_source(every, shifts)), errors


def leave_out_noise(estimate: Estimate, white: Sequence[WhiteResiduals]) -> Estimate:
    """Call parameters unidentifiable whose signature is mostly noise: least squares makes them too small, or zero.

    A plateau of constant speed shows no mass, however precisely noisy accelerations seem to tell it.
    """
    n = len(estimate.names)
    columns = np.concatenate([one.parameters[:, :, :n].reshape(-1, n) for one in white]).astype(float)
    known = np.flatnonzero(np.isfinite(estimate.value))
    if not len(known):
        return estimate
    inside = np.linalg.pinv(columns[:, known].T @ columns[:, known], rcond=ROUNDING, hermitian=True)
    noise = sum(np.diag(one.noise_in_columns)[known] for one in white)
    weak = known[noise * np.diag(inside) > NOISE_SHARE]
    if not len(weak):
        return estimate
    value, covariance = estimate.value.copy(), estimate.covariance.copy()
    value[weak] = np.nan
    covariance[weak], covariance[:, weak] = np.nan, np.nan
    reason = "what would show it in this log is mostly noise: record a drive that excites it"
    return replace(
        estimate,
        value=value,
        covariance=covariance,
        unidentifiable={**estimate.unidentifiable, **{estimate.names[k]: reason for k in weak}},
    )


def _by_source(every: Sequence[Tolerance], shifts: np.ndarray) -> dict[str, np.ndarray]:
    return {x.source: shifts[:, k] for k, x in enumerate(every)}


def _products(model: Model, white: Sequence[WhiteResiduals], n: int, held: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the products of residuals and the signatures of parameters, with what is known, and where column n is.

    held (n,): parameters that stay at their values.
    """
    prior = model.known.information(model.scale) + ROUNDING * np.eye(len(model.base.names))
    prior[range(len(held)), range(len(held))] += np.where(held, 1 / ROUNDING, 0.0)
    G = gram(white, prior)
    first = len(G) - len(prior)
    keep = np.r_[0, first : len(G)]
    return G[np.ix_(keep, keep)], 1 + n
