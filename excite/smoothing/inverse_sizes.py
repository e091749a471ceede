"""Sizes of noise and motion from the moments of what is left, and how far residuals are from white."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from excite.smoothing.block_tridiagonal import gather, inverse_blocks
from excite.smoothing.discrepancy import Basis
from excite.smoothing.inverse import (
    Design,
    NoiseSizes,
    Point,
    Problem,
    Reduced,
    SlotTerms,
    chunks,
    part_of,
    rows_of,
    slot_terms,
)
from excite.smoothing.inverse_chain import Chain
from excite.smoothing.motion_readings import predicted, reading_freedom
from excite.smoothing.splines import ORDER, penalty, roughness
from excite.smoothing.tails import heaviness

CORRELATED = 0.25  # mean correlation over five slots from which residuals are not white; smoothed noise has up to 0.2
BLOCK_COUNTS = (20, 60)  # blocks of a log whose scores are summed: what lasts a twentieth of it counts in full
MOTION_TAILS = 2.0  # degrees of freedom of Student's t of the white derivative: reversals and steps are rare and large


@dataclass
class _Moments:
    """Sums over all logs from which sizes follow, by joint or channel (n,) and by sensor."""

    roughness: np.ndarray
    rough_free: np.ndarray
    square: np.ndarray
    number: np.ndarray
    spent: np.ndarray
    pull: np.ndarray
    level_square: dict[str, float]
    level_free: dict[str, float]
    standard: list[list[np.ndarray]]
    expected: list[list[np.ndarray]]


def update_sizes(
    problem: Problem,
    designs: Sequence[Design],
    basis: Basis | None,
    sizes: NoiseSizes,
    point: Point,
    reduced: Reduced,
    freedom: float,
    first: bool,
) -> tuple[NoiseSizes, np.ndarray]:
    """Return sizes by MacKay's fixed point, and the slope of the motions' log determinant by X / scale (n_base,).

    freedom: degrees of freedom that the parameters spend. first: of the first passes, in which tails are normal.
    """
    n, names = problem.channels, sizes.level
    zero = np.zeros(n)
    found = _Moments(
        zero,
        zero.copy(),
        zero.copy(),
        zero.copy(),
        zero.copy(),
        np.zeros(len(point.X)),
        dict.fromkeys(names, 0.0),
        dict.fromkeys(names, 0.0),
        [[] for _ in range(n)],
        [[] for _ in range(n)],
    )
    for m, (chain, design, one) in enumerate(zip(problem.chains, designs, reduced.linear, strict=True)):
        width = point.coefficients[m].shape[1]
        covariance = gather(chain.windows(width), inverse_blocks(one.factor))
        _add_motion(found, problem, chain, sizes, point.coefficients[m], covariance)
        _add_slots(found, problem, chain, design, basis, sizes, point, m, covariance, first)
    left = np.maximum(found.number - found.spent - freedom / n, 0.05 * found.number)
    noise = np.maximum(np.sqrt(found.square / np.maximum(left, 1e-300)), problem.least_noise)
    change = np.clip(found.roughness / np.maximum(found.rough_free, 1e-3) / sizes.intensity, 0.1, 10.0)
    intensity = np.maximum(sizes.intensity * change, problem.least_intensity)
    tails = sizes.tails if first else np.array([heaviness(np.concatenate(own))[0] for own in found.standard])
    lively = tuple(
        np.column_stack([(MOTION_TAILS + own[m]) / (MOTION_TAILS + 1) for own in found.expected])
        for m in range(len(problem.chains))
    )
    level = dict(names)
    for s in (s for own in problem.chains[0].sights for s in own if s.readings.edge is None):
        name, old = s.readings.sensor, names[s.readings.sensor]
        value = np.sqrt(found.level_square[name] / max(found.level_free[name], 1e-3 * len(s.readings.t)))
        level[name] = float(max(old * np.clip(value / old, 0.5, 2.0), s.readings.least / float(s.readings.std[0])))
    return NoiseSizes(intensity, noise, tails, level, lively), found.pull * problem.model.scale


def _add_motion(
    found: _Moments, problem: Problem, chain: Chain, sizes: NoiseSizes, coefficients: np.ndarray, covariance: np.ndarray
) -> None:
    """Add the roughness and the misfits of encoders, with what their estimation spends."""
    n, width = problem.channels, coefficients.shape[1]
    grid = covariance.reshape(chain.knots.count, ORDER, width, ORDER, width)
    log = len(found.expected[0])
    for j in range(n):
        own, knots = coefficients[: chain.knots.size, j], chain.prior[j]
        joint = np.ascontiguousarray(grid[:, :, j, :, j])
        square = roughness(knots, chain.near(own[:, None])[:, :, 0])[0]
        hidden = np.einsum("kij,ij->k", joint, penalty(knots))
        lively = sizes.lively[log][:, j]
        found.roughness[j] += float((square / lively).sum())
        found.rough_free[j] += knots.size - knots.white - float((hidden / lively).sum()) / sizes.intensity[j]
        found.expected[j].append((square + hidden) / sizes.intensity[j])
        for s in chain.sights[j]:
            name = s.readings.sensor
            found.level_square[name] += float((((s.value - predicted(s, own)) / s.std) ** 2).sum())
            found.level_free[name] += len(s.value) - reading_freedom(s, sizes.level[name], joint)


def _add_slots(
    found: _Moments,
    problem: Problem,
    chain: Chain,
    design: Design,
    basis: Basis | None,
    sizes: NoiseSizes,
    point: Point,
    m: int,
    covariance: np.ndarray,
    first_passes: bool,
) -> None:
    """Add the misfits of torques, with what the motion spends of them, and the log determinant's slope."""
    for first, last, row, end in chunks(chain):
        part = part_of(chain, first, last, row, end)
        s = slot_terms(problem, part, rows_of(design, row, end), basis, sizes, point, m)
        cross = covariance[first + part.slot // part.slots] @ s.by_motion.transpose(0, 2, 1)
        there = part.count > 0
        share = (sizes.noise**2 / s.variance) ** 2  # noise is judged where little else is; that may not be there
        found.square += (share * s.weight * s.residual**2 * s.variance).sum(axis=0)
        found.number += (share * there).sum(axis=0)
        found.spent += (share * np.einsum("sji,sij->sj", s.by_motion, cross) * s.curvature).sum(axis=0)
        z = s.residual * np.sqrt(part.count / s.variance)
        for j, own in enumerate(found.standard):
            own.append(z[there[:, j] & (share[:, j] >= min(0.5, float(np.median(share[:, j])))), j])
        if not first_passes:
            found.pull += _determinant_slope(problem, part, s, cross, point, m)


def _determinant_slope(
    problem: Problem, part: Chain, s: SlotTerms, cross: np.ndarray, point: Point, m: int
) -> np.ndarray:
    """Half the slope of the log determinant of a motion's information by the parameters (n_base,) [1/SI]."""
    n, width = problem.channels, point.coefficients[m].shape[1]
    along = cross.reshape(len(cross), ORDER, width, n)[:, :, :n] * s.curvature[:, None, None, :]
    slot_of_row = np.repeat(np.arange(len(part.first)), np.diff([*part.first, len(part.t)]))
    by_row = along[slot_of_row] * (part.used / np.maximum(part.count[slot_of_row], 1))[:, None, None, :]
    V = np.einsum("rdi,rimj->rdmj", part.basis, by_row, optimize=True).reshape(len(part.t), 3 * n, n)
    motion = part.motion(point.coefficients[m]).reshape(len(part.t), -1)
    flat = V.transpose(0, 2, 1).reshape(len(part.t), -1)
    return problem.torque.contraction(motion, *part.beside, point.X, flat)[0][:, :, 0].sum(axis=0)


def correlation_factor(
    problem: Problem, designs: Sequence[Design], basis: Basis | None, sizes: NoiseSizes, point: Point, gain: np.ndarray
) -> np.ndarray:
    """Return the factor (k,) on standard deviations for residuals that are correlated over time, 1 if they are white.

    gain (k, c): of the parameters on the slopes of all columns. Scores are summed over blocks (clustered).
    """
    p = len(point.X) + problem.channels
    white, blocks = np.zeros(len(gain)), np.zeros((len(BLOCK_COUNTS), len(gain)))
    z: list[np.ndarray] = []
    for m, (chain, design) in enumerate(zip(problem.chains, designs, strict=True)):
        scores = []
        for first, last, row, end in chunks(chain):
            part = part_of(chain, first, last, row, end)
            s = slot_terms(problem, part, rows_of(design, row, end), basis, sizes, point, m)
            force = s.weight * s.residual
            score = np.einsum("sjp,sj->sp", s.by_parameters, force) @ gain[:, :p].T
            if basis is not None:
                for j, (start, count) in enumerate(zip(basis.start, basis.count, strict=True)):
                    columns = slice(p + int(start), p + int(start) + count)
                    score += (s.nodes[j] * force[:, j : j + 1]) @ gain[:, columns].T
            scores.append(score)
            z.append(np.clip(s.residual * np.sqrt(part.count / s.variance), -4, 4))
        psi = np.concatenate(scores)
        white += (psi**2).sum(axis=0)
        for k, count in enumerate(BLOCK_COUNTS):
            blocks[k] += sum(x.sum(axis=0) ** 2 for x in np.array_split(psi, min(count, len(psi))))
    every = np.concatenate(z)
    lagged = sum((every[lag:] * every[:-lag]).sum(axis=0) for lag in range(1, 6))
    if not (lagged / (5 * (every**2).sum(axis=0))).max() > CORRELATED:
        return np.ones(len(gain))
    return np.sqrt(np.maximum(blocks.max(axis=0) / np.maximum(white, 1e-300), 1.0))
