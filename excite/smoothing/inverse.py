"""Most likely parameters of a machine whose joints are all driven, with motions and discrepancies integrated out.

The negative log-likelihood of motions and parameters is a nonlinear least-squares problem: readings of encoders,
torques along the motion, the prior of smooth motions, and priors of parameters and discrepancies. Gauss-Newton with
Levenberg's damping eliminates the motions of each log; no step that raises the cost is taken. Sizes (motion, noise,
tails, discrepancies) maximise the marginal likelihood by MacKay's fixed point, and the slope of the motions' log
determinant makes the parameters those of the marginal likelihood, which alone is unbiased.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.model import Model
from excite.smoothing.block_tridiagonal import (
    Factor,
    assemble,
    assemble_columns,
    factorise,
    forward,
)
from excite.smoothing.discrepancy import Basis
from excite.smoothing.inverse_chain import CHUNK, Chain, TorqueModel
from excite.smoothing.log_fit import prior_terms
from excite.smoothing.motion_readings import predicted, prior_terms_of_motion, reading_terms, start_cost
from excite.smoothing.splines import ORDER, roughness


@dataclass(frozen=True)
class NoiseSizes:
    """Sizes that the data set: intensity (n,) of motions; noise (n,) and tails (n,) of torques; level by sensor.

    lively: of each log (K, n), the local intensity relative to `intensity`.
    """

    intensity: np.ndarray
    noise: np.ndarray
    tails: np.ndarray
    level: dict[str, float]
    lively: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Point:
    """Motions and parameters: coefficients (K + 5, w) of each log, X (n_base,), shift (n,) [s], curve (n_nodes,)."""

    coefficients: tuple[np.ndarray, ...]
    X: np.ndarray
    shift: np.ndarray
    curve: np.ndarray


@dataclass(frozen=True)
class Design:
    """Columns of a log that stay as they are in a pass.

    delay (N, n): change of each torque by a shift of a second. nodes: by channel (N, n_channel) the weights of the
    discrepancy's nodes. unresolved (N, n): variance of torques beside noise [N2 m2].
    """

    delay: np.ndarray
    nodes: tuple[np.ndarray, ...]
    unresolved: np.ndarray


@dataclass(frozen=True, eq=False)
class Problem:
    """Logs of one machine on knots, and how their parameters are sought.

    prior, held: information (n_base,) about the machine file's values, scaled.
    shift_std [s]: of the alignment. least_noise (n,) [N m]: of torques. least_intensity (n,): of motions.
    """

    torque: TorqueModel
    chains: tuple[Chain, ...]
    prior: np.ndarray
    shift_std: float
    least_noise: np.ndarray
    least_intensity: np.ndarray

    @property
    def model(self) -> Model:
        return self.torque.model

    @property
    def channels(self) -> int:
        return self.torque.channels


@dataclass(frozen=True)
class Linear:
    """One log linearised: the factor of its motion's information, L^-1 of the columns and of the slope (blocks, m, c).

    The columns are those of all parameters (X / scale, shifts / shift_std, nodes); the last column is the slope.
    """

    factor: Factor
    half: np.ndarray


@dataclass(frozen=True)
class Reduced:
    """Information (c, c) and slope (c,) of the data about all parameters, motions eliminated, and fixed."""

    linear: tuple[Linear, ...]
    information: np.ndarray
    slope: np.ndarray
    fixed_information: np.ndarray
    fixed_slope: np.ndarray


# ------------------------------------------------------------------------------------------------ residuals


def torque_parts(
    problem: Problem, chain: Chain, design: Design, basis: Basis | None, point: Point, n: int
) -> np.ndarray:
    """Return the residuals (N, n) of torque in a log's rows at a point."""
    coefficients = point.coefficients[n]
    motion = chain.motion(coefficients)
    found = chain.torque - problem.torque.prediction(chain, motion, point.X)
    return found - extra_torque(chain, design, basis, point)


def extra_torque(chain: Chain, design: Design, basis: Basis | None, point: Point) -> np.ndarray:
    """Return the torque (N, n) beside the model's: alignment and discrepancy."""
    found = design.delay * (point.shift - chain.moved * float(chain.t[1] - chain.t[0]))
    if basis is not None:
        for j, (start, count) in enumerate(zip(basis.start, basis.count, strict=True)):
            found[:, j] += design.nodes[j] @ point.curve[start : start + count]
    return found


def robust_weights(z: np.ndarray, tails: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cost, weight and share of curvature (S, n) of standardised residuals z (S, n) by tails (n,)."""
    normal = ~np.isfinite(tails)
    nu = np.where(normal, 1e9, tails)
    weight = np.where(normal, 1.0, (nu + 1) / (nu + z**2))
    cost = np.where(normal, z**2, (nu + 1) * np.log1p(z**2 / nu))
    return cost, weight, np.broadcast_to(np.where(normal, 1.0, (nu + 1) / (nu + 3)), z.shape)


def cost_of(
    problem: Problem,
    designs: Sequence[Design],
    basis: Basis | None,
    sizes: NoiseSizes,
    pull: np.ndarray,
    point: Point,
    z: np.ndarray,
) -> float:
    """Return twice the negative log-likelihood at a point up to a constant, with the slope `pull` (n_base,) added."""
    total = 0.0
    for n, (chain, design) in enumerate(zip(problem.chains, designs, strict=True)):
        residual = chain.average(torque_parts(problem, chain, design, basis, point, n))
        standard = residual * np.sqrt(chain.count / (sizes.noise**2 + chain.average(design.unresolved)))
        total += float((robust_weights(standard, sizes.tails)[0] * (chain.count > 0)).sum())
        coefficients = point.coefficients[n]
        for j in range(problem.channels):
            own = coefficients[: chain.knots.size, j]
            total += float(
                (
                    roughness(chain.prior[j], chain.near(own[:, None])[:, :, 0])[0]
                    / (sizes.intensity[j] * sizes.lively[n][:, j])
                ).sum()
            )
            total += start_cost(chain.prior[j], chain.starts[j], own)
            for s in chain.sights[j]:
                total += float((((s.value - predicted(s, own)) / (sizes.level[s.readings.sensor] * s.std)) ** 2).sum())
    total += prior_terms(problem.model, problem.prior, point.X)[2]
    total += float(((point.shift / problem.shift_std) ** 2).sum()) + float(z @ z)
    return total + 2 * float(pull @ ((point.X - problem.model.nominal) / problem.model.scale))


# ------------------------------------------------------------------------------------------------ linearisation


def reduce_problem(
    problem: Problem,
    designs: Sequence[Design],
    basis: Basis | None,
    sizes: NoiseSizes,
    point: Point,
    damping: float = 0.0,
) -> Reduced | None:
    """Linearise all logs at a point and eliminate their motions; None if a motion's information is not positive."""
    c = len(point.X) + problem.channels + len(point.curve)
    fixed, slope = np.zeros((c, c)), np.zeros(c)
    linear: list[Linear] = []
    for n, (chain, design) in enumerate(zip(problem.chains, designs, strict=True)):
        width = point.coefficients[n].shape[1]
        w = chain.windows(width)
        local, columns = _motion_terms(problem, chain, sizes, sizes.lively[n], point.coefficients[n], c)
        _add_torques(problem, chain, design, basis, sizes, point, n, local, columns, fixed, slope)
        if damping:
            at = np.arange(local.shape[1])
            local[:, at, at] *= 1 + damping
        factor = factorise(assemble(w, local))
        if factor is None:
            return None
        linear.append(Linear(factor, forward(factor, columns.reshape(w.blocks, w.block_size, c + 1))))
    information, reduced = fixed.copy(), slope.copy()
    for one in linear:
        flat = one.half.reshape(-1, c + 1)
        Z = flat.T @ flat
        information -= Z[:c, :c]
        reduced -= Z[:c, c]
    spectrum, axes = np.linalg.eigh((information + information.T) / 2)  # differences leave rounding errors
    information = (axes * np.maximum(spectrum, 0.0)) @ axes.T
    return Reduced(tuple(linear), (information + information.T) / 2, reduced, (fixed + fixed.T) / 2, slope)


def _motion_terms(
    problem: Problem, chain: Chain, sizes: NoiseSizes, lively: np.ndarray, coefficients: np.ndarray, c: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return information (K, 6 w, 6 w) and columns (blocks per_block, w, c + 1) of a motion without its torques."""
    K, width, n = chain.knots.count, coefficients.shape[1], problem.channels
    local = np.zeros((K, ORDER, width, ORDER, width))
    pull = np.zeros((K, ORDER, width))
    for j in range(n):
        own = coefficients[: chain.knots.size, j]
        information, slope = prior_terms_of_motion(
            chain.prior[j], chain.starts[j], sizes.intensity[j] * lively[:, j], own
        )
        for s in chain.sights[j]:
            more, steeper, _ = reading_terms(chain.knots, s, sizes.level[s.readings.sensor], own)
            information, slope = information + more, slope + steeper
        local[:, :, j, :, j] += information
        pull[:, :, j] += slope
    w = chain.windows(width)
    columns = np.zeros((w.blocks * w.per_block, width, c + 1))
    assemble_columns(w, pull.reshape(K, ORDER * width, 1), 0, columns[:, :, c:])
    return local.reshape(K, ORDER * width, ORDER * width), columns


def chunks(chain: Chain) -> list[tuple[int, int, int, int]]:
    """Split a log at intervals: first and last interval, first and last row of each part."""
    count = max(1, round(CHUNK * chain.knots.count / len(chain.t)))
    edges = [*range(0, chain.knots.count, count), chain.knots.count]
    rows = np.searchsorted(chain.interval, edges)
    return [
        (a, b, int(r), int(s)) for a, b, r, s in zip(edges[:-1], edges[1:], rows[:-1], rows[1:], strict=True) if s > r
    ]


def rows_of(design: Design, first: int, last: int) -> Design:
    """Return the columns of some rows."""
    return Design(design.delay[first:last], tuple(x[first:last] for x in design.nodes), design.unresolved[first:last])


def part_of(chain: Chain, first: int, last: int, row: int, end: int) -> Chain:
    """Return the rows and slots of intervals first .. last only, numbered from zero; encoders stay as they are."""
    slots = (chain.slot >= first * chain.slots) & (chain.slot < last * chain.slots)
    return replace(
        chain,
        t=chain.t[row:end],
        interval=chain.interval[row:end],
        basis=chain.basis[row:end],
        torque=chain.torque[row:end],
        used=chain.used[row:end],
        beside=tuple(x[row:end] for x in chain.beside),
        slot=chain.slot[slots] - first * chain.slots,
        first=chain.first[slots] - row,
    )


@dataclass(frozen=True)
class SlotTerms:
    """Slots of some intervals: residual (S, n), slopes by unknowns (S, n, 6 w) and parameters (S, n, n_base + n).

    nodes: weights (S, n_channel) of the discrepancy by channel. weight (S, n): of the squares; curvature: in the
    information. variance (S, n): of a row's torque.
    """

    residual: np.ndarray
    by_motion: np.ndarray
    by_parameters: np.ndarray
    nodes: tuple[np.ndarray, ...]
    weight: np.ndarray
    curvature: np.ndarray
    variance: np.ndarray


def slot_terms(
    problem: Problem,
    part: Chain,
    design: Design,
    basis: Basis | None,
    sizes: NoiseSizes,
    point: Point,
    n: int,
) -> SlotTerms:
    """Linearise the slots of a part of log n; design: of its rows."""
    channels, width = problem.channels, point.coefficients[n].shape[1]
    motion = part.motion(point.coefficients[n])
    y, by_state, W = problem.torque.linear(motion.reshape(len(motion), -1), *part.beside, point.X)
    residual = part.torque - y[:, :, 0] - extra_torque(part, design, basis, point)
    by_state = by_state.reshape(len(motion), channels, 3, channels)
    by_motion = np.zeros((len(motion), channels, ORDER, width))
    by_motion[..., :channels] = np.einsum("rdi,rjdm->rjim", part.basis, by_state, optimize=True)
    delay = np.zeros((len(motion), channels, channels))
    at = np.arange(channels)
    delay[:, at, at] = design.delay * problem.shift_std
    parameters = np.concatenate([W * problem.model.scale, delay], axis=2)
    residual = part.average(residual)
    count = part.count
    variance = sizes.noise**2 + part.average(design.unresolved)
    _, robust, bend = robust_weights(residual * np.sqrt(count / variance), sizes.tails)
    weight = count / variance * robust
    nodes = tuple(part.average_channel(x, j) for j, x in enumerate(design.nodes))
    return SlotTerms(
        residual,
        part.average(by_motion).reshape(-1, channels, ORDER * width),
        part.average(parameters),
        nodes,
        weight,
        weight * bend,
        variance,
    )


def _add_torques(
    problem: Problem,
    chain: Chain,
    design: Design,
    basis: Basis | None,
    sizes: NoiseSizes,
    point: Point,
    n: int,
    local: np.ndarray,
    columns: np.ndarray,
    fixed: np.ndarray,
    slope: np.ndarray,
) -> None:
    """Add the torques of log n to the information of its motion, to the columns and to that of the parameters."""
    p = len(point.X) + problem.channels
    c = len(slope)
    w = chain.windows(point.coefficients[n].shape[1])
    for first, last, row, end in chunks(chain):
        part = part_of(chain, first, last, row, end)
        own = rows_of(design, row, end)
        s = slot_terms(problem, part, own, basis, sizes, point, n)
        K = last - first

        def padded(x: np.ndarray, part: Chain = part, K: int = K) -> np.ndarray:
            found = np.zeros((K * part.slots, *x.shape[1:]))
            found[part.slot] = x
            return found.reshape(K, part.slots * x.shape[1], *x.shape[2:])

        J, T = padded(s.by_motion), padded(s.by_parameters)
        heavy = padded(s.curvature)[:, :, None]
        force = padded(s.weight * s.residual)[:, :, None]
        JT = (J * heavy).transpose(0, 2, 1)
        local[first:last] += JT @ J
        assemble_columns(w, JT @ T, first, columns[:, :, :p])
        assemble_columns(w, J.transpose(0, 2, 1) @ force, first, columns[:, :, c:])
        flat, flat_heavy = T.reshape(-1, p), heavy.reshape(-1)
        fixed[:p, :p] += (flat * flat_heavy[:, None]).T @ flat
        slope[:p] += flat.T @ force.reshape(-1)
        if basis is None:
            continue
        for j, (start, count) in enumerate(zip(basis.start, basis.count, strict=True)):
            cols = slice(p + int(start), p + int(start) + count)
            D = s.nodes[j]
            weighted = D * s.curvature[:, j : j + 1]
            grid = np.zeros((K * part.slots, count))
            grid[part.slot] = weighted
            Jj = J.reshape(K, part.slots, problem.channels, -1)[:, :, j]
            assemble_columns(w, Jj.transpose(0, 2, 1) @ grid.reshape(K, part.slots, count), first, columns[:, :, cols])
            cross = s.by_parameters[:, j].T @ weighted
            fixed[:p, cols] += cross
            fixed[cols, :p] += cross.T
            fixed[cols, cols] += D.T @ weighted
            slope[cols] += D.T @ (s.weight * s.residual)[:, j]
