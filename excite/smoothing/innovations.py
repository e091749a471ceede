"""Innovations: what each reading of a log says that nothing before it did.

A Kalman filter along the smoother's last linearisation. Where the model and its noise are right, the normalised
innovations are white with variance one; and a signature that goes through the same filter is what an effect would add
to them. The joined parts of the chain say what is known where each part begins, so all parts are filtered side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from excite.smoothing import parallel_smoother
from excite.smoothing.linearisation import BATCH

SLOW = 25  # readings whose mean counts as slow


@dataclass(frozen=True)
class Step:
    """A filter's step j in all P parts that are as long: samples `at` (P,), which parts `going` (P,), the transition
    behind them A (P, n, n), the gain (P, n, m), what makes the innovations white (P, m, m), and their variance before
    that (P, m)."""

    at: np.ndarray
    going: np.ndarray
    A: np.ndarray
    gain: np.ndarray
    white: np.ndarray
    variance: np.ndarray
    used: np.ndarray


@dataclass(frozen=True)
class Linear:
    """One log linearised about a point: its chain in scaled states, and what it reduces to.

    Z: twice the negative log-likelihood is [1 p]' Z [1 p] for steps p of parameters and offsets, scaled. gain
    (N - 1, n, n_u): what a torque error of one standard deviation does to the scaled state. stages: by part of the
    log. H (N, m, n), weight, residual (N, m): the readings; direct (N, m, n_f + n_o): how they move with flaws of
    sensors and offsets. noise (n_u,): standard deviation of the delivered torques' errors [N m]. beats (N, m): how many
    times larger than their weights say the readings' variance is.
    """

    solved: parallel_smoother.Solved
    Z: np.ndarray
    gain: np.ndarray
    stages: tuple[parallel_smoother.Stages, ...]
    H: np.ndarray
    weight: np.ndarray
    residual: np.ndarray
    direct: np.ndarray
    noise: np.ndarray
    beats: np.ndarray

    @cached_property
    def innovations(self) -> np.ndarray:
        """Of every reading (N, m), normalised; NaN where unused."""
        return innovations(self)

    @cached_property
    def filter(self) -> list[Step]:
        """The Kalman filter's steps along the log."""
        return steps(self)


def innovations(linear: Linear) -> np.ndarray:
    """Each reading less its prediction from all before it, over its standard deviation (N, m); NaN where unused."""
    z = np.full(linear.residual.shape, np.nan)
    x = _before(linear)
    drift = np.concatenate([stages.b[:, :, :1] for stages in linear.stages])
    for step in linear.filter:
        e = linear.residual[step.at, :, None] - linear.H[step.at] @ x[step.going, :, None]
        z[step.at] = np.where(step.used, e[:, :, 0] / np.sqrt(step.variance), np.nan)
        x[step.going] = (step.A @ (x[step.going, :, None] + step.gain @ e) + drift[step.at])[:, :, 0]
    return z


def innovation_sizes(linear: Linear) -> np.ndarray:
    """Mean square of the normalised innovations of every sensor, and of their sums over blocks in deviations, both
    1 where model and noise are right; and the number of blocks: (m, 3)."""
    z, allowed = linear.innovations, np.ones(linear.residual.shape)
    for step in linear.filter if (linear.beats != 1).any() else ():
        beats = (linear.beats[step.at] - 1) / np.where(step.used, linear.weight[step.at], np.inf)
        allowed[step.at] += beats / step.variance
    sizes = np.zeros((z.shape[1], 3))
    for j, column in enumerate(z.T):
        told = np.flatnonzero(np.isfinite(column))
        blocks = told[: len(told) // SLOW * SLOW].reshape(-1, SLOW)
        if blocks.size:
            slow = column[blocks].sum(axis=1) ** 2 / allowed[blocks, j].sum(axis=1)
            sizes[j] = np.mean(column[told] ** 2), np.mean(slow), len(slow)
    return sizes


@dataclass(frozen=True)
class White:
    """Innovations of one log, white and of variance one: E (N, m, 1 + n_p + n_o) of data, parameters and offsets. And
    what an error of the state where a part begins does to its innovations, reach (N, m, n), and to the state where it
    ends, through (parts, n, n)."""

    E: np.ndarray
    reach: np.ndarray
    through: np.ndarray


def _stretches(linear: Linear) -> Iterator[tuple[slice, slice]]:
    """The log in stretches of some BATCH samples: which parts each is, and which samples."""
    ends = np.cumsum([len(stages) for stages in linear.stages])
    first = begin = 0
    while first < len(ends):
        last = max(first + 1, int(np.searchsorted(ends, begin + BATCH, "right")))
        yield slice(first, last), slice(begin, int(ends[last - 1]))
        first, begin = last, int(ends[last - 1])


def whitened(linear: Linear, flawed: tuple[int, ...]) -> White:
    """Where data = sum of columns times steps, the columns' products are the information about the steps, all states
    integrated out. flawed: parameters that readings depend on directly. Single precision."""
    (N, m, n), own = linear.H.shape, linear.solved.Z.shape[0]
    told = np.concatenate([1 + np.array(flawed, int), np.arange(own - linear.direct.shape[2] + len(flawed), own)])
    E, reach = np.empty((N, m, own), np.float32), np.empty((N, m, n), np.float32)
    begin, through = linear.solved.parts[0].whole.b[0], list[np.ndarray]()
    for parts, samples in _stretches(linear):
        stages = linear.stages[parts]
        K = samples.stop - samples.start
        reading, push = np.zeros((K, m, own + n)), np.zeros((K, n, own + n))
        reading[:, :, 0] = -linear.residual[samples]
        reading[:, :, told] = linear.direct[samples]
        push[:, :, :own] = np.concatenate([x.b for x in stages])
        x = np.zeros((len(stages), n, own + n))
        x[:, :, own:] = np.eye(n)
        both = _filtered(linear, parts, samples.start, x, push, reading)
        E[samples], reach[samples] = both[:, :, :own], both[:, :, own:]
        through.append(x[:, :, own:])
        begin = _joined(linear, parts, E[samples], reach[samples], through[-1], x[:, :, :own], begin)
    return White(E, reach, np.concatenate(through))


def whitened_signatures(
    linear: Linear, white: White, along: Callable[[slice], tuple[np.ndarray, np.ndarray]]
) -> Iterator[tuple[slice, np.ndarray]]:
    """Likewise of signatures, stretch by stretch: of which K samples, and the white innovations (K, m, C). along: of K
    samples what signatures do to the scaled state behind each, push (K, n, C), nothing behind the last of the log, and
    to readings (K, m, C)."""
    begin = np.zeros((linear.H.shape[2], 1))
    for parts, samples in _stretches(linear):
        push, reading = along(samples)
        x = np.zeros((parts.stop - parts.start, *push.shape[1:]))
        E = _filtered(linear, parts, samples.start, x, push, reading)
        begin = _joined(linear, parts, E, white.reach[samples], white.through[parts], x, begin)
        yield samples, E


def _filtered(
    linear: Linear, parts: slice, first: int, x: np.ndarray, push: np.ndarray, reading: np.ndarray
) -> np.ndarray:
    """Whitened innovations (K, m, k) of columns x (parts, n, k) of the states where parts begin, which are led to where
    these end; push (K, n, k) and reading (K, m, k): what the columns add to states and readings on the way. first: the
    sample with which the parts begin."""
    E = np.empty(reading.shape, np.float32)
    for step in linear.filter:
        own = slice(*np.searchsorted(step.going, (parts.start, parts.stop)))
        if own.start == own.stop:
            break  # all of them have ended
        at, going = step.at[own] - first, step.going[own] - parts.start
        e = -(reading[at] + linear.H[step.at[own]] @ x[going])
        E[at] = (step.white[own] * step.used[own, :, None]) @ e
        x[going] = step.A[own] @ (x[going] + step.gain[own] @ e) + push[at]
    return E


def _joined(
    linear: Linear,
    parts: slice,
    E: np.ndarray,
    reach: np.ndarray,
    through: np.ndarray,
    ends: np.ndarray,
    begin: np.ndarray,
) -> np.ndarray:
    """Adds to innovations E (K, m, k) that each part really begins where the one before ends, the first with begin
    (n, k); and where the last one ends (n, k). ends (parts, n, k): where parts that begin with nothing end; reach
    (K, m, n), through (parts, n, n): as White has them."""
    at = 0
    for k, stages in enumerate(linear.stages[parts]):
        own = slice(at, at + len(stages))
        E[own] += reach[own] @ begin.astype(np.float32)
        begin = ends[k] + through[k] @ begin
        at += len(stages)
    return begin


def _before(linear: Linear) -> np.ndarray:
    """What is expected of the state where each part begins (parts, n)."""
    return _known(linear)[0]


def _known(linear: Linear) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the state where each part begins, from all before it."""
    parts, n = linear.solved.parts, linear.H.shape[2]
    x, P = np.empty((len(linear.stages), n)), np.empty((len(linear.stages), n, n))
    x[0], P[0] = parts[0].whole.b[0, :, 0], parts[0].whole.C[0]
    for k, part in enumerate(parts[1:-1]):
        w = part.whole
        seen = np.linalg.inv(np.eye(n) + P[k] @ w.J[0])
        x[k + 1] = w.A[0] @ (seen @ (x[k] + P[k] @ w.eta[0, :, 0])) + w.b[0, :, 0]
        P[k + 1] = w.A[0] @ seen @ P[k] @ w.A[0].T + w.C[0]
    return x, P


def steps(linear: Linear) -> list[Step]:
    """The filter's gains, which don't depend on data, step by step in all parts."""
    starts = np.cumsum([0, *(len(s) for s in linear.stages)])
    P = _known(linear)[1]
    most = linear.weight.max(axis=0)
    found = []
    for j in range(max(len(s) for s in linear.stages)):
        going = np.array([i for i, s in enumerate(linear.stages) if j < len(s)])
        at = starts[going] + j
        h, weight = linear.H[at], linear.weight[at]
        PH = P[going] @ h.transpose(0, 2, 1)
        # A reading that isn't used counts as one with a huge variance.
        variance = 1 / np.maximum(weight, 1e-9 * np.where(most > 0, most, 1.0))
        S = h @ PH
        S = (S + S.transpose(0, 2, 1)) / 2
        S[:, range(h.shape[1]), range(h.shape[1])] += variance
        K = np.linalg.solve(S, PH.transpose(0, 2, 1)).transpose(0, 2, 1)
        A, C = (np.stack([getattr(linear.stages[i], f)[j] for i in going]) for f in ("A", "C"))
        left = P[going] - K @ PH.transpose(0, 2, 1)
        P[going] = A @ ((left + left.transpose(0, 2, 1)) / 2) @ A.transpose(0, 2, 1) + C
        white = np.linalg.inv(np.linalg.cholesky(S))
        found.append(Step(at, going, A, K, white, np.diagonal(S, axis1=1, axis2=2).copy(), weight > 0))
    return found
