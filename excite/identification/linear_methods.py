"""Linear methods: ordinary, weighted and total least squares on the filtered rows of logs."""

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

MAX_REWEIGHTINGS = 30  # of an iteration for weights, at most
SETTLED_WEIGHTS = 1e-4  # relative change of weights that ends it
NOTABLE_STD_RATIO = 1.2  # deviations too small by this factor are worth a remark


def ols(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """The paper's method: filtered positions, central differences, parallel filtering of Y and W, least squares by QR.

    Standard deviations (33): sigma^2 = |Y - W X|^2 / (r - c), covariance sigma^2 (W'W)^-1. Biased where the regressor
    itself is measured with noise, as slips are, and the deviations then are too small. A note says how much too small
    the autocorrelation of the residuals alone makes them.
    """
    blocks = filtered_blocks(model, logs, filter)
    solution = solve_blocks(blocks, model.scale)
    estimate = estimate_with_white_noise(model, blocks, solution, "ols")
    return add_notes(
        estimate, *_autocorrelation_note(blocks, solution, estimate, sandwich_covariance(blocks, solution))
    )


def wls(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Every equation weighted by its own residual level, iterated until the levels settle.

    No level is taken below what the sensors' noise makes of the machine file's values: a row without torque fits best
    with parameters near zero, and would else gain all the weight. Deviations account for autocorrelation and for noise
    that varies along the log (kernel estimate of the scores). Biased like ols where the regressor is measured with
    noise, though less where noisy rows then count less.
    """
    blocks = filtered_blocks(model, logs, filter)
    least = row_levels([row_errors(model, log, filter, 1) for log in logs], model.nominal)
    least = np.maximum(least, MIN_ROW_NOISE * rms_torque(blocks))  # exact logs have no residual to weigh by
    count = sum(Y.shape[1] for _, Y in blocks)
    level, own = least, scale_rows(blocks, least)
    for _ in range(MAX_REWEIGHTINGS):
        solution = solve_blocks(own, model.scale)
        energy = sum((residual(b, solution.x) ** 2).sum(axis=1) for b in blocks)
        before, level = level, np.maximum(np.sqrt(energy / count), least)
        if np.abs(level / before - 1).max() < SETTLED_WEIGHTS:
            break
        own = scale_rows(blocks, level)
    covariance = sandwich_covariance(own, solution)
    degrees = effective_degrees(solution, covariance)
    x = restore_tied_parameters(model, blocks, solution, solution.x)
    return build_estimate(model, blocks, solution, "wls", x, covariance, degrees, ())


def tls(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Errors in variables: total least squares with the noise of every column, as far as the sensors explain it.

    Rows are first made white (see `whitener`) at the machine file's values. The noise covariance C of [W Y], summed
    over all rows, comes from measuring the filtered log again with the sensors' own noise and counts. With the smallest
    l in [W Y]'[W Y] v = l C v the estimate solves (W'W - l C_WW) X = W'Y - l C_WY: consistent whatever the size of the
    noise, if C has the right shape (Van Huffel and Vandewalle, "The total least squares problem", 1991, ch. 10).
    Columns are scaled by the triangle of [W Y]. Raises NotIdentifiable where nothing has noise.
    """
    blocks = filtered_blocks(model, logs, filter)
    first = solve_blocks(blocks, model.scale)
    turned = [
        whitening_matrices(
            model, samples(model, log, filter), model.nominal, filtered_noise(model, log, filter), filter
        )
        for log in logs
    ]
    own = [whiten_block(b, L) for b, L in zip(blocks, turned, strict=True)]
    errors = [
        [np.einsum("nij,jnp->inp", L, E) for E in row_errors(model, log, filter)]
        for log, L in zip(logs, turned, strict=True)
    ]
    kept = list(first.kept)
    use = [*kept, len(model.base.names)]
    C = second_moments(errors)[np.ix_(use, use)]
    R = np.asarray(np.linalg.qr(reduce_blocks(own).R[:, use], mode="r"))
    half = scipy.linalg.solve_triangular(R, C, trans="T")
    relative = scipy.linalg.solve_triangular(R, half.T, trans="T")
    mu, v = np.linalg.eigh((relative + relative.T) / 2)
    if not mu[-1] > 0:
        raise NotIdentifiableError("tls: no signal of this log has noise or counts, so nothing says what noise is like")
    direction = scipy.linalg.solve_triangular(R, v[:, -1])
    x = np.zeros(len(model.base.names))
    x[kept] = -direction[:-1] / direction[-1]
    level = 1 / float(mu[-1])
    bread = np.linalg.inv(R[:, :-1].T @ R[:, :-1] - level * C[:-1, :-1])
    covariance = bread @ total_scores_covariance(own, x, kept) @ bread
    note = f"tls: misfit {np.sqrt(level):.2f} times what the sensors' noise and counts explain"
    x = restore_tied_parameters(model, blocks, first, x)
    return build_estimate(
        model,
        blocks,
        first,
        "tls",
        x,
        covariance,
        effective_degrees(solve_blocks(own, model.scale), covariance),
        (note,),
    )


# ------------------------------------------------------------------------------------------------ the core


def filtered_blocks(model: Model, logs: Sequence[Log], filter: Filter) -> list[Block]:
    """Filtered rows of every log; what stands still in all of them does so exactly."""
    rest = rest_projection(model, logs, filter)
    return project_blocks([filtered_regression(model, log, filter) for log in logs], rest)


def project_blocks(blocks: Sequence[Block], rest: np.ndarray) -> list[Block]:
    """Rows of a machine some of which stands still, by `at_rest` (n_base, n_base)."""
    return [(W @ rest, Y) for W, Y in blocks] if (np.diag(rest) == 0).any() else list(blocks)


def restore_tied_parameters(model: Model, blocks: Sequence[Block], solution: Solution, x: np.ndarray) -> np.ndarray:
    """x (n_base,) with parameters that move together with others at the machine file's values instead of zero, and the
    others such that all rows stay explained as they are: written to the machine file, they say the same of the log."""
    tied, kept = solution.tied, list(solution.kept)
    if not tied:
        return x
    R = reduce_blocks(blocks).R[:, :-1] * model.scale
    found = x.copy()
    found[tied] = model.nominal[tied]
    along = np.linalg.lstsq(R[:, kept], R[:, tied] @ (found[tied] / model.scale[tied]), rcond=None)[0]
    found[kept] -= along * model.scale[kept]
    return found


def least_squares(model: Model, W: np.ndarray, Y: np.ndarray, method: str) -> Estimate:
    """QR least squares of W (n_rows, n, n_base) X = Y (n_rows, n), columns in dependence named and left out."""
    blocks = [(W, Y)]
    return estimate_with_white_noise(model, blocks, solve_blocks(blocks, model.scale), method)


def solve_blocks(blocks: Sequence[Block], scale: np.ndarray | None = None) -> Solution:
    """Least squares of all rows of all logs, the parameters being of size `scale` (n_base,). Raises NotIdentifiable."""
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
    """[W Y] of all rows of all logs, reduced block by block."""
    return merge(reduce(w, y) for W, Y in blocks for w, y in zip(W, Y, strict=True))


def scale_rows(blocks: Sequence[Block], level: np.ndarray) -> list[Block]:
    """Rows over their levels (n_rows,)."""
    return [(W / level[:, None, None], Y / level[:, None]) for W, Y in blocks]


def whiten_block(block: Block, L: np.ndarray) -> Block:
    """Rows of each sample turned by L (n, n_rows, n_rows)."""
    W, Y = block
    return np.einsum("nij,jnp->inp", L, W), np.einsum("nij,jn->in", L, Y)


def rms_torque(blocks: Sequence[Block]) -> float:
    """Root mean square of Y."""
    return float(np.sqrt(sum(float((Y**2).sum()) for _, Y in blocks) / sum(Y.size for _, Y in blocks)))


def residual(block: Block, x: np.ndarray) -> np.ndarray:
    """Y - W x, (n_rows, n)."""
    W, Y = block
    return np.asarray(Y - W @ x)


def total_scores_covariance(
    blocks: Sequence[Block], x: np.ndarray, kept: Sequence[int], by: Sequence[np.ndarray] = ()
) -> np.ndarray:
    """Covariance (k, k) of Z'(Y - W x) over all logs; `by` gives Z (n_rows, n, n_base) of each, else it is W."""
    rows = sum(Y.size for _, Y in blocks)
    Z = by or [W for W, _ in blocks]
    S = sum(scores_covariance(z[:, :, list(kept)], residual(b, x)) for z, b in zip(Z, blocks, strict=True))
    return np.asarray(S * (rows / (rows - len(kept))))


def sandwich_covariance(blocks: Sequence[Block], solution: Solution) -> np.ndarray:
    """Covariance (k, k) of a least-squares estimate, whatever the noise's colour and level along the log."""
    inverse = solution.inverse
    return inverse @ total_scores_covariance(blocks, solution.x, solution.kept) @ inverse


def effective_degrees(solution: Solution, covariance: np.ndarray) -> int:
    """Degrees of freedom that autocorrelation leaves: rows over the inflation of the variance, less parameters."""
    white = solution.residual_norm**2 / solution.degrees * np.diag(solution.inverse)
    inflation = max(1.0, float(np.median(np.diag(covariance) / white)))
    return max(3, int(solution.rows / inflation) - len(solution.kept))


# ------------------------------------------------------------------------------------------------ the answer


def estimate_with_white_noise(model: Model, blocks: Sequence[Block], solution: Solution, method: str) -> Estimate:
    """The estimate with deviations by (33), which hold for white noise on Y alone."""
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
    """An Estimate from x (n_base,) and the covariance (k, k) of the kept parameters; blocks as filtered, unweighted."""
    names, kept = model.base.names, list(solution.kept)
    floor = np.array([float(model.machine.scale.get(s, 0.0)) for s in names])
    scale = np.maximum(np.abs(x), floor)[kept]
    R = reduce_blocks(blocks).R[:, kept]
    value = np.full(len(names), np.nan)
    value[kept] = x[kept]
    e = np.concatenate([residual(b, x) for b in blocks], axis=1)
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
        solution.spread(covariance),
        float(np.linalg.cond(R)),
        float(np.linalg.cond(R * scale)),
        100 * float(np.sqrt(np.mean(e**2))) / rms_torque(blocks),
        e,
        degrees,
        reasons,
        notes,
    )


def _autocorrelation_note(
    blocks: Sequence[Block], solution: Solution, estimate: Estimate, honest: np.ndarray
) -> tuple[str, ...]:
    """What autocorrelated residuals do to deviations by (33), as a note."""
    kept = list(solution.kept)
    ratio = np.sqrt(np.diag(honest)) / estimate.std[kept]
    if not ratio.max() > NOTABLE_STD_RATIO:
        return ()
    first = max((float(np.abs(lag_one_correlation(residual(b, solution.x))).max()) for b in blocks), default=0.0)
    worst = int(np.argmax(ratio))
    return (
        f"ols: residuals are autocorrelated (lag 1: {first:.2f}), deviations by (33) are too small by a"
        f" factor of {np.median(ratio):.1f} in the middle, {ratio[worst]:.1f} for {estimate.names[kept[worst]]}",
    )
