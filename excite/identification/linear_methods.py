"""Ordinary least squares on the filtered rows of logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from excite.errors import NotIdentifiableError
from excite.identification.combinations import describe_combinations
from excite.identification.estimate import NOTHING_MOVES_MESSAGE, Estimate, held_note
from excite.identification.identifiability import rest_projection
from excite.identification.inverse_estimate import recommend_method
from excite.identification.least_squares import (
    Solution,
    Triangle,
    cluster_scores,
    lag_one_correlation,
    merge,
    reduce,
    scores_covariance,
    solve,
)
from excite.logs import Log, filtered_regression
from excite.model import Model
from excite.model.machine import Filter
from excite.text import count

NOTABLE_STD_RATIO = 1.2  # ratio of robust to textbook standard deviations that is reported; chosen

Block = tuple[np.ndarray, np.ndarray]  # W (n_rows, n, n_base) and Y (n_rows, n) of one log


def ols(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by ordinary least squares, the paper's method.

    Positions are filtered, differentiated by central differences, Y and W filtered alike and solved by QR. Standard
    deviations by (33): sigma^2 = |Y - W X|^2 / (r - c), covariance sigma^2 (W'W)^-1. The estimate is biased and the
    standard deviations are too small if the regressor itself is noisy, as slips are. A note says by how much
    autocorrelation of the residuals alone makes them too small.
    """
    blocks = filtered_blocks(model, logs, filter)
    solution = solve_blocks(blocks, model.scale)
    estimate = estimate_with_white_noise(model, blocks, solution, "ols")
    robust = sandwich_covariance(model, blocks, solution)
    doubt, factor = _autocorrelation_doubt(model, blocks, solution, robust)
    return replace(estimate, doubt=doubt, understated=factor)


# ------------------------------------------------------------------------------------------------ equations


def filtered_blocks(model: Model, logs: Sequence[Log], filter: Filter) -> list[Block]:
    """Filter the rows of every log; parts at rest in all logs are exactly at rest."""
    blocks = [filtered_regression(model, log, filter) for log in logs]
    projection = rest_projection(model, logs, filter)
    return [(W @ projection, Y) for W, Y in blocks] if (np.diag(projection) == 0).any() else blocks


def restore_tied_parameters(model: Model, blocks: Sequence[Block], solution: Solution, x: np.ndarray) -> np.ndarray:
    """Set dependent parameters to the machine file's values instead of zero, and adapt the others x (n_base,).

    All rows stay explained as they are, so the values written to a machine file predict the same log.
    """
    tied, kept = solution.tied, list(solution.kept)
    if not tied:
        return x
    R = reduce_blocks(blocks).R[:, :-1] * model.scale
    found = x.copy()
    found[tied] = model.nominal[tied]
    response = np.linalg.lstsq(R[:, kept], R[:, tied] @ (found[tied] / model.scale[tied]), rcond=None)[0]
    found[kept] -= response * model.scale[kept]
    return found


def least_squares(model: Model, W: np.ndarray, Y: np.ndarray, method: str) -> Estimate:
    """Solve W (n_rows, n, n_base) X = Y (n_rows, n) by QR; dependent columns are named and left out."""
    blocks = [(W, Y)]
    return estimate_with_white_noise(model, blocks, solve_blocks(blocks, model.scale), method)


def fit_rows(model: Model, blocks: Sequence[Block], solution: Solution | None = None) -> np.ndarray:
    """Solve least squares on rows; return X (n_base,), the machine file's values where the rows do not show them.

    solution: of these rows, if it is known. Raises NotIdentifiableError.
    """
    solution = solution or solve_blocks(blocks, model.scale)
    x = restore_tied_parameters(model, blocks, solution, solution.x)
    shown = [*solution.kept, *solution.tied]
    found = model.nominal.copy()
    found[shown] = x[shown]
    return found


def solve_blocks(blocks: Sequence[Block], scale: np.ndarray | None = None) -> Solution:
    """Solve least squares on all rows of all logs, with parameters of size `scale` (n_base,).

    Raises NotIdentifiableError.
    """
    n_base = blocks[0][0].shape[2]
    for W, Y in blocks:
        if not (np.isfinite(W).all() and np.isfinite(Y).all()):
            raise NotIdentifiableError("the filtered log is not finite: is a value in it far out of range?")
    rows = sum(Y.size for _, Y in blocks)
    if not any((Y != 0).any() for _, Y in blocks):
        raise NotIdentifiableError(
            "every torque is zero all along: are their sensors connected? A log without drive needs joint, and a value"
            " of the machine file that is known"
        )
    if rows <= n_base:
        raise NotIdentifiableError(
            f"{count(rows, 'filtered row')} for {count(n_base, 'parameter')}: the log is too short"
        )
    solution = solve(reduce_blocks(blocks), scale=scale)
    if not solution.kept:
        raise NotIdentifiableError(NOTHING_MOVES_MESSAGE)
    return solution


def reduce_blocks(blocks: Sequence[Block]) -> Triangle:
    """Reduce [W Y] of all rows of all logs, block by block."""
    return merge(reduce(w, y) for W, Y in blocks for w, y in zip(W, Y, strict=True))


def whiten_block(block: Block, L: np.ndarray) -> Block:
    """Multiply the rows of each sample by L (n, n_rows, n_rows)."""
    W, Y = block
    return np.einsum("nij,jnp->inp", L, W), np.einsum("nij,jn->in", L, Y)


def rms_torque(blocks: Sequence[Block]) -> float:
    """Root mean square of Y."""
    return float(np.sqrt(sum(float((Y**2).sum()) for _, Y in blocks) / sum(Y.size for _, Y in blocks)))


def residual(block: Block, x: np.ndarray) -> np.ndarray:
    """Compute Y - W x, (n_rows, n)."""
    W, Y = block
    return np.asarray(Y - W @ x)


def sandwich_covariance(model: Model, blocks: Sequence[Block], solution: Solution) -> np.ndarray:
    """Covariance (k, k) of a least-squares estimate for residuals of any autocorrelation and varying level.

    Residuals are noise that is correlated over a few samples (`scores_covariance`), and structure that the model lacks,
    which lasts longer (`cluster_scores`): each parameter has the larger of the two standard deviations. With slips the
    noise of the regressor prevails, whose scores have no mean of zero within a stretch, so the second is left out.
    """
    bread, kept = solution.inverse, list(solution.kept)
    rows = sum(Y.size for _, Y in blocks)
    pairs = [(W[:, :, kept], residual((W, Y), solution.x)) for W, Y in blocks]
    kinds = (scores_covariance,) if model.slips else (scores_covariance, cluster_scores)
    short, *long = (bread @ sum(scores(w, e) for w, e in pairs) @ bread.T for scores in kinds)
    variance = np.diag(short)
    ratio = np.ones(len(variance))
    for other in long:
        ratio = np.sqrt(np.maximum(np.diag(other) / np.where(variance > 0, variance, np.inf), 1.0))
    return np.asarray(short * np.outer(ratio, ratio) * (rows / (rows - len(kept))))


# ------------------------------------------------------------------------------------------------ estimates


def estimate_with_white_noise(model: Model, blocks: Sequence[Block], solution: Solution, method: str) -> Estimate:
    """Build the estimate with standard deviations by (33), which hold for white noise on Y only."""
    covariance = solution.residual_norm**2 / solution.degrees * solution.inverse
    x = restore_tied_parameters(model, blocks, solution, solution.x)
    return build_estimate(model, blocks, solution, method, x, covariance, solution.degrees, ())


def build_estimate(
    model: Model,
    blocks: Sequence[Block],
    solution: Solution,
    method: str,
    x: np.ndarray,
    covariance: np.ndarray,
    degrees: int,
    notes: tuple[str, ...],
) -> Estimate:
    """Build an Estimate from x (n_base,) and the covariance (k, k) of the kept parameters.

    blocks: filtered rows without weights.
    """
    names = model.base.names
    rows = every = reduce_blocks(blocks).R[:, :-1]
    if model.known:
        solution, x, covariance = combine_with_known(model, rows, solution, x, covariance)
        every = np.concatenate([rows, model.known.rows * np.abs(rows).max() / np.abs(model.known.rows).max()])
    kept = list(solution.kept)
    floor = np.array([float(model.machine.scale.get(s, 0.0)) for s in names])
    scale = np.maximum(np.abs(x), floor)[kept]
    R = rows[:, kept]
    value = np.full(len(names), np.nan)
    value[kept] = x[kept]
    residuals = np.concatenate([residual(b, x) for b in blocks], axis=1)
    full = solution.expand(covariance)
    reasons = {
        names[k]: "nothing in this log depends on it"
        if partner is None
        else describe_combinations(every, model.scale, names, model.base.units, x, full, k, kept)
        for k, partner in solution.dependent.items()
    }
    if solution.tied:
        notes = (*notes, held_note([names[k] for k in solution.tied]))
    return Estimate(
        method,
        names,
        model.base.units,
        value,
        full,
        float(np.linalg.cond(R)),
        float(np.linalg.cond(R * scale)),
        100 * float(np.sqrt(np.mean(residuals**2))) / rms_torque(blocks),
        residuals,
        degrees,
        reasons,
        notes,
    )


def combine_with_known(
    model: Model, R: np.ndarray, solution: Solution, x: np.ndarray, covariance: np.ndarray
) -> tuple[Solution, np.ndarray, np.ndarray]:
    """Combine an estimate with what the machine file calls known; return solution, x and covariance of both together.

    R (rows, n_base): the log's rows or their triangle; solution, x (n_base,), covariance (k, k): of the log alone. The
    log shows x_kept + F x_tied with that covariance, the known values are further observations, and generalised least
    squares solves both. What neither shows is left out as before.
    """
    kept, tied, n = list(solution.kept), solution.tied, len(x)
    shown = np.zeros((len(kept), n))
    shown[range(len(kept)), kept] = 1.0
    if tied:
        size = np.linalg.norm(R, axis=0)
        shares = np.linalg.lstsq(R[:, kept] / size[kept], R[:, tied] / size[tied], rcond=None)[0]
        shown[:, tied] = shares * size[tied] / size[kept][:, None]
    std = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(std, std))
    whitened = scipy.linalg.solve_triangular(root, np.column_stack([shown, shown @ x]) / std[:, None], lower=True)
    known = np.column_stack([model.known.rows, model.known.values])
    both = np.concatenate([whitened, known])
    together = solve(reduce(both[:, :-1], both[:, -1]), scale=model.scale)
    found, free, held = model.nominal.copy(), list(together.kept), list(together.dependent)
    found[free] = np.linalg.lstsq(both[:, free], both[:, -1] - both[:, held] @ found[held], rcond=None)[0]
    return replace(together, rows=solution.rows), found, together.inverse


def _autocorrelation_doubt(
    model: Model, blocks: Sequence[Block], solution: Solution, robust: np.ndarray
) -> tuple[str, float]:
    """Say by which factor standard deviations by (33) are too small for autocorrelated residuals, "" and 1 if not."""
    kept = list(solution.kept)
    white = solution.residual_norm**2 / solution.degrees * np.diag(solution.inverse)
    ratio = np.sqrt(np.diag(robust) / white)
    if not ratio.max() > NOTABLE_STD_RATIO:
        return "", 1.0
    correlation = max((float(np.abs(lag_one_correlation(residual(b, solution.x))).max()) for b in blocks), default=0.0)
    worst = int(np.argmax(ratio))
    name, better = model.base.names[kept[worst]], recommend_method(model)
    doubt = (
        f"residuals are autocorrelated (lag 1: {correlation:.2f}), so standard deviations by (33) are too small by a"
        f" factor of up to {ratio[worst]:.1f} ({name}): --method {better} states what holds"
    )
    return doubt, float(ratio[worst])
