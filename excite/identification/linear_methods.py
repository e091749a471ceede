"""Linear methods on the filtered rows of logs: ordinary, weighted and total least squares."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from excite.errors import NotIdentifiableError
from excite.identification.estimate import NOTHING_MOVES_MESSAGE, Estimate, add_notes, held_note
from excite.identification.identifiability import rest_projection
from excite.identification.least_squares import (
    Solution,
    Triangle,
    lag_one_correlation,
    merge,
    reduce,
    scores_covariance,
    solve,
)
from excite.identification.noise_propagation import (
    MIN_ROW_NOISE,
    filtered_noise,
    row_errors,
    row_levels,
    second_moments,
    whitening_matrices,
)
from excite.logs import Log, filtered_regression, samples
from excite.model import Model
from excite.model.machine import Filter

Block = tuple[np.ndarray, np.ndarray]  # W (n_rows, n, n_base) and Y (n_rows, n) of one log

MAX_REWEIGHTINGS = 30  # of the iteration for weights; chosen
SETTLED_WEIGHTS = 1e-4  # relative change of the weights that ends it; chosen
NOTABLE_STD_RATIO = 1.2  # ratio of robust to textbook standard deviations that is reported; chosen


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
    return add_notes(
        estimate, *_autocorrelation_note(blocks, solution, estimate, sandwich_covariance(blocks, solution))
    )


def wls(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by weighted least squares, each equation weighted by its residual level, iterated.

    No level is below the sensor noise propagated at the machine file's values: a row without torque fits best with
    parameters near zero and would gain all the weight. Standard deviations account for autocorrelation and for noise
    that varies along the log. Biased like `ols` if the regressor is noisy, but less if noisy rows have less weight.
    """
    blocks = filtered_blocks(model, logs, filter)
    lowest = row_levels([row_errors(model, log, filter, 1) for log in logs], model.nominal)
    lowest = np.maximum(lowest, MIN_ROW_NOISE * rms_torque(blocks))  # logs without noise have no residual
    count = sum(Y.shape[1] for _, Y in blocks)
    level, weighted = lowest, scale_rows(blocks, lowest)
    for _ in range(MAX_REWEIGHTINGS):
        solution = solve_blocks(weighted, model.scale)
        energy = sum((residual(b, solution.x) ** 2).sum(axis=1) for b in blocks)
        before, level = level, np.maximum(np.sqrt(energy / count), lowest)
        if np.abs(level / before - 1).max() < SETTLED_WEIGHTS:
            break
        weighted = scale_rows(blocks, level)
    covariance = sandwich_covariance(weighted, solution)
    degrees = effective_degrees(solution, covariance)
    x = restore_tied_parameters(model, blocks, solution, solution.x)
    return build_estimate(model, blocks, solution, "wls", x, covariance, degrees, ())


def tls(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by total least squares with the noise covariance of every column (errors in variables).

    Rows are whitened at the machine file's values (see `whitening_matrices`). The noise covariance C of [W Y], summed
    over rows, comes from simulated readings of the filtered log. With the smallest l in [W Y]'[W Y] v = l C v, the
    estimate solves (W'W - l C_WW) X = W'Y - l C_WY. It is consistent for any size of the noise if C has the right shape
    (Van Huffel and Vandewalle, "The total least squares problem", 1991, ch. 10). Raises NotIdentifiableError if no
    signal has noise.
    """
    blocks = filtered_blocks(model, logs, filter)
    first = solve_blocks(blocks, model.scale)
    whitening = [
        whitening_matrices(
            model, samples(model, log, filter), model.nominal, filtered_noise(model, log, filter), filter
        )
        for log in logs
    ]
    whitened = [whiten_block(b, L) for b, L in zip(blocks, whitening, strict=True)]
    errors = [
        [np.einsum("nij,jnp->inp", L, E) for E in row_errors(model, log, filter)]
        for log, L in zip(logs, whitening, strict=True)
    ]
    kept = list(first.kept)
    use = [*kept, len(model.base.names)]
    C = second_moments(errors)[np.ix_(use, use)]
    R = np.asarray(np.linalg.qr(reduce_blocks(whitened).R[:, use], mode="r"))
    half = scipy.linalg.solve_triangular(R, C, trans="T")
    relative = scipy.linalg.solve_triangular(R, half.T, trans="T")
    mu, v = np.linalg.eigh((relative + relative.T) / 2)
    if not mu[-1] > 0:
        raise NotIdentifiableError(
            "tls: no signal of this log has noise or counts, so the noise is unknown: use another method"
        )
    direction = scipy.linalg.solve_triangular(R, v[:, -1])
    x = np.zeros(len(model.base.names))
    x[kept] = -direction[:-1] / direction[-1]
    level = 1 / float(mu[-1])
    bread = np.linalg.inv(R[:, :-1].T @ R[:, :-1] - level * C[:-1, :-1])
    covariance = bread @ total_scores_covariance(whitened, x, kept) @ bread
    note = f"tls: misfit {np.sqrt(level):.2f} times what the sensors' noise and counts explain"
    x = restore_tied_parameters(model, blocks, first, x)
    return build_estimate(
        model,
        blocks,
        first,
        "tls",
        x,
        covariance,
        effective_degrees(solve_blocks(whitened, model.scale), covariance),
        (note,),
    )


# ------------------------------------------------------------------------------------------------ equations


def filtered_blocks(model: Model, logs: Sequence[Log], filter: Filter) -> list[Block]:
    """Filter the rows of every log; parts at rest in all logs are exactly at rest."""
    projection = rest_projection(model, logs, filter)
    return project_blocks([filtered_regression(model, log, filter) for log in logs], projection)


def project_blocks(blocks: Sequence[Block], projection: np.ndarray) -> list[Block]:
    """Apply a `rest_projection` (n_base, n_base) to the regressors."""
    return [(W @ projection, Y) for W, Y in blocks] if (np.diag(projection) == 0).any() else list(blocks)


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
        raise NotIdentifiableError("every torque is zero all along: are their sensors connected?")
    if rows <= n_base:
        raise NotIdentifiableError(f"{rows} filtered rows for {n_base} parameters: the log is too short")
    solution = solve(reduce_blocks(blocks), scale=scale)
    if not solution.kept:
        raise NotIdentifiableError(NOTHING_MOVES_MESSAGE)
    return solution


def reduce_blocks(blocks: Sequence[Block]) -> Triangle:
    """Reduce [W Y] of all rows of all logs, block by block."""
    return merge(reduce(w, y) for W, Y in blocks for w, y in zip(W, Y, strict=True))


def scale_rows(blocks: Sequence[Block], level: np.ndarray) -> list[Block]:
    """Divide rows by their levels (n_rows,)."""
    return [(W / level[:, None, None], Y / level[:, None]) for W, Y in blocks]


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


def total_scores_covariance(
    blocks: Sequence[Block], x: np.ndarray, kept: Sequence[int], instruments: Sequence[np.ndarray] = ()
) -> np.ndarray:
    """Covariance (k, k) of Z'(Y - W x) summed over all logs, with instruments Z (n_rows, n, n_base), by default W."""
    rows = sum(Y.size for _, Y in blocks)
    Z = instruments or [W for W, _ in blocks]
    S = sum(scores_covariance(z[:, :, list(kept)], residual(b, x)) for z, b in zip(Z, blocks, strict=True))
    return np.asarray(S * (rows / (rows - len(kept))))


def sandwich_covariance(blocks: Sequence[Block], solution: Solution) -> np.ndarray:
    """Covariance (k, k) of a least-squares estimate for noise of any autocorrelation and varying level."""
    inverse = solution.inverse
    return inverse @ total_scores_covariance(blocks, solution.x, solution.kept) @ inverse


def effective_degrees(solution: Solution, covariance: np.ndarray) -> int:
    """Degrees of freedom left by autocorrelation: rows over the variance inflation, minus parameters."""
    white = solution.residual_norm**2 / solution.degrees * np.diag(solution.inverse)
    inflation = max(1.0, float(np.median(np.diag(covariance) / white)))
    return max(3, int(solution.rows / inflation) - len(solution.kept))


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
    names, kept = model.base.names, list(solution.kept)
    floor = np.array([float(model.machine.scale.get(s, 0.0)) for s in names])
    scale = np.maximum(np.abs(x), floor)[kept]
    R = reduce_blocks(blocks).R[:, kept]
    value = np.full(len(names), np.nan)
    value[kept] = x[kept]
    residuals = np.concatenate([residual(b, x) for b in blocks], axis=1)
    reasons = {
        names[k]: "nothing in this log depends on it"
        if partner is None
        else f"moves together with {names[partner]} and others in this log"
        for k, partner in solution.dependent.items()
    }
    if solution.tied:
        notes = (*notes, held_note([names[k] for k in solution.tied]))
    return Estimate(
        method,
        names,
        model.base.units,
        value,
        solution.expand(covariance),
        float(np.linalg.cond(R)),
        float(np.linalg.cond(R * scale)),
        100 * float(np.sqrt(np.mean(residuals**2))) / rms_torque(blocks),
        residuals,
        degrees,
        reasons,
        notes,
    )


def _autocorrelation_note(
    blocks: Sequence[Block], solution: Solution, estimate: Estimate, robust: np.ndarray
) -> tuple[str, ...]:
    """Note on the error of standard deviations by (33) if residuals are autocorrelated."""
    kept = list(solution.kept)
    ratio = np.sqrt(np.diag(robust)) / estimate.std[kept]
    if not ratio.max() > NOTABLE_STD_RATIO:
        return ()
    correlation = max((float(np.abs(lag_one_correlation(residual(b, solution.x))).max()) for b in blocks), default=0.0)
    worst = int(np.argmax(ratio))
    return (
        f"ols: residuals are autocorrelated (lag 1: {correlation:.2f}), deviations by (33) are too small by a"
        f" factor of {np.median(ratio):.1f} in the middle, {ratio[worst]:.1f} for {estimate.names[kept[worst]]}",
    )
