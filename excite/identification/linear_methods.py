"""Linear methods on the filtered rows of logs: ordinary, weighted and total least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from excite.errors import NotIdentifiableError
from excite.identification.combinations import describe_combinations
from excite.identification.estimate import NOTHING_MOVES_MESSAGE, Estimate, held_note
from excite.identification.identifiability import rest_projection
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
from excite.identification.near_rest import Block as Block, leave_out, moving_rows
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
from excite.text import count, format_number

MAX_REWEIGHTINGS = 30  # of the iteration for weights; chosen
SETTLED_WEIGHTS = 1e-4  # relative change of the weights that ends it; chosen
MAX_REST_SHIFT = 2.0  # standard deviations by which rows near rest may move an estimate; chosen
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
    robust = sandwich_covariance(model, blocks, solution)
    doubt, factor = _autocorrelation_doubt(blocks, solution, model.base.names, robust)
    return replace(estimate, doubt=doubt, understated=factor)


def wls(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by weighted least squares, each equation weighted by its residual level, iterated.

    No level is below the sensor noise propagated at the machine file's values: a row without torque fits best with
    parameters near zero and would gain all the weight. Rows of joints near rest are left out if they contradict others.
    Standard deviations account for autocorrelation and for noise that varies along the log. Biased like `ols` if the
    regressor is noisy, but less if noisy rows have less weight.
    """
    every = filtered_blocks(model, logs, filter)
    in_motion = rows_to_trust(model, logs, filter, every)
    moving, notes = rows_in_motion(model, every, in_motion)
    blocks = leave_out(every, moving)
    lowest = row_levels([row_errors(model, log, filter, 1) for log in logs], model.nominal, in_motion)
    lowest = np.maximum(lowest, MIN_ROW_NOISE * rms_torque(blocks))  # logs without noise have no residual
    count = np.maximum(sum(_used(b).sum(axis=1) for b in blocks), 1)
    level, weighted = lowest, scale_rows(blocks, lowest)
    for _ in range(MAX_REWEIGHTINGS):
        solution = solve_blocks(weighted, model.scale)
        energy = sum((residual(b, solution.x) ** 2).sum(axis=1) for b in blocks)
        before, level = level, np.maximum(np.sqrt(energy / count), lowest)
        if np.abs(level / before - 1).max() < SETTLED_WEIGHTS:
            break
        weighted = scale_rows(blocks, level)
    covariance = sandwich_covariance(model, weighted, solution)
    degrees = effective_degrees(solution, covariance)
    x = restore_tied_parameters(model, blocks, solution, solution.x)
    return build_estimate(model, every, solution, "wls", x, covariance, degrees, notes)


def tls(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by total least squares with the noise covariance of every column (errors in variables).

    Rows are whitened at the machine file's values (see `whitening_matrices`). The noise covariance C of [W Y], summed
    over rows, comes from simulated readings of the filtered log. With the smallest l in [W Y]'[W Y] v = l C v, the
    estimate solves (W'W - l C_WW) X = W'Y - l C_WY. It is consistent for any size of the noise if C has the right shape
    (Van Huffel and Vandewalle, "The total least squares problem", 1991, ch. 10). Raises NotIdentifiableError if no
    signal has noise, or if the noise hides every parameter.
    """
    every = filtered_blocks(model, logs, filter)
    moving, notes = rows_in_motion(model, every, rows_to_trust(model, logs, filter, every))
    blocks = leave_out(every, moving)
    first = solve_blocks(blocks, model.scale)
    whitening = [
        whitening_matrices(
            model, samples(model, log, filter), model.nominal, filtered_noise(model, log, filter), filter
        )
        for log in logs
    ]
    whitened = [whiten_block(b, L) for b, L in zip(blocks, whitening, strict=True)]
    errors = [
        [np.einsum("nij,jnp->inp", L, E * _used(b)[:, :, None]) for E in row_errors(model, log, filter)]
        for log, L, b in zip(logs, whitening, blocks, strict=True)
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
    covariance = robust_covariance(model, bread, whitened, x, kept)
    if (np.sqrt(np.diag(covariance)) > np.abs(x[kept])).all():
        raise NotIdentifiableError(
            "tls: noise in the regressor hides every parameter, as slips from encoders do: use another method"
        )
    note = f"tls: misfit {np.sqrt(level):.2f} times what the sensors' noise and counts explain"
    x = restore_tied_parameters(model, blocks, first, x)
    return build_estimate(
        model,
        every,
        first,
        "tls",
        x,
        covariance,
        effective_degrees(solve_blocks(whitened, model.scale), covariance),
        (*notes, note),
    )


# ------------------------------------------------------------------------------------------------ equations


def filtered_blocks(model: Model, logs: Sequence[Log], filter: Filter) -> list[Block]:
    """Filter the rows of every log; parts at rest in all logs are exactly at rest."""
    projection = rest_projection(model, logs, filter)
    return project_blocks([filtered_regression(model, log, filter) for log in logs], projection)


def rows_to_trust(model: Model, logs: Sequence[Log], filter: Filter, blocks: Sequence[Block]) -> list[np.ndarray]:
    """Find the rows (n_rows, n) of each log that are not of joints near rest.

    Machines with slips keep all rows: a selection by noisy slips would bias the estimate.
    """
    if model.slips:
        return [np.ones(Y.shape, bool) for _, Y in blocks]
    return [moving_rows(model, log, filter) for log in logs]


def rows_in_motion(
    model: Model, blocks: Sequence[Block], moving: list[np.ndarray]
) -> tuple[list[np.ndarray], tuple[str, ...]]:
    """Find the rows (n_rows, n) of each log to use, with a note.

    moving: see `rows_to_trust`. Rows of joints near rest are left out if they move an estimate by more than noise
    explains (test of J. A. Hausman, Econometrica 46, 1978), and every parameter is identified without them.
    """
    every = [np.ones(Y.shape, bool) for _, Y in blocks]
    share = 1 - float(np.mean(np.concatenate(moving, axis=1)))
    if not share:
        return every, ()
    whole = solve_blocks(blocks, model.scale)
    count = sum(Y.shape[1] for _, Y in blocks)
    level = np.sqrt(sum((residual(b, whole.x) ** 2).sum(axis=1) for b in blocks) / count)
    weighted = scale_rows(blocks, np.where(level > 0, level, 1.0))
    rest = leave_out(weighted, moving)
    with_rest, without = (solve(reduce_blocks(b), scale=model.scale) for b in (weighted, rest))
    kept = list(without.kept)
    if kept != list(with_rest.kept):
        return every, ()
    shift = (with_rest.x - without.x)[kept] / np.sqrt(np.diag(sandwich_covariance(model, rest, without)))
    if not np.abs(shift).max(initial=0.0) > MAX_REST_SHIFT:
        return every, ()
    worst = int(np.argmax(np.abs(shift)))
    note = (
        f"friction sticks in this log: {format_number(100 * share, 2)} % of the rows are of joints near rest and are"
        f" left out; they would move {model.base.names[kept[worst]]} by {abs(shift[worst]):.0f} standard deviations"
    )
    return moving, (note,)


def _used(block: Block) -> np.ndarray:
    """Find the rows (n_rows, n) that are not left out."""
    W, Y = block
    return np.asarray(W.any(axis=2) | (Y != 0))


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


def robust_covariance(
    model: Model,
    bread: np.ndarray,
    blocks: Sequence[Block],
    x: np.ndarray,
    kept: Sequence[int],
    instruments: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Covariance (k, k) of the estimate bread Z'(Y - W x) for residuals of any autocorrelation and varying level.

    bread (k, k). instruments: Z (n_rows, n, n_base) of each log, by default W. Residuals are noise that is correlated
    over a few samples (`scores_covariance`), and structure that the model lacks, which lasts longer (`cluster_scores`):
    each parameter has the larger of the two standard deviations. With slips the noise of the regressor prevails, whose
    scores have no mean of zero within a stretch, so the second is left out.
    """
    rows = sum(Y.size for _, Y in blocks)
    Z = [z[:, :, list(kept)] for z in instruments or [W for W, _ in blocks]]
    errors = [residual(b, x) for b in blocks]
    kinds = (scores_covariance,) if model.slips else (scores_covariance, cluster_scores)
    sums = [sum(scores(z, e) for z, e in zip(Z, errors, strict=True)) for scores in kinds]
    short, *long = (bread @ S @ bread.T for S in sums)
    variance = np.diag(short)
    ratio = np.ones(len(variance))
    for other in long:
        ratio = np.sqrt(np.maximum(np.diag(other) / np.where(variance > 0, variance, np.inf), 1.0))
    return np.asarray(short * np.outer(ratio, ratio) * (rows / (rows - len(kept))))


def sandwich_covariance(model: Model, blocks: Sequence[Block], solution: Solution) -> np.ndarray:
    """Robust covariance (k, k) of a least-squares estimate."""
    return robust_covariance(model, solution.inverse, blocks, solution.x, solution.kept)


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
    blocks: Sequence[Block], solution: Solution, names: Sequence[str], robust: np.ndarray
) -> tuple[str, float]:
    """Say by which factor standard deviations by (33) are too small for autocorrelated residuals, "" and 1 if not."""
    kept = list(solution.kept)
    white = solution.residual_norm**2 / solution.degrees * np.diag(solution.inverse)
    ratio = np.sqrt(np.diag(robust) / white)
    if not ratio.max() > NOTABLE_STD_RATIO:
        return "", 1.0
    correlation = max((float(np.abs(lag_one_correlation(residual(b, solution.x))).max()) for b in blocks), default=0.0)
    worst = int(np.argmax(ratio))
    doubt = (
        f"residuals are autocorrelated (lag 1: {correlation:.2f}), so standard deviations by (33) are too small by a"
        f" factor of up to {ratio[worst]:.1f} ({names[kept[worst]]}): --method wls states what holds"
    )
    return doubt, float(ratio[worst])
