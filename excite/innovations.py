"""Innovations: what each reading of a log says that nothing before it did.

A Kalman filter along the smoother's last linearisation. Where the model and its noise are right, the normalised
innovations are white with variance one; and a signature that goes through the same filter is what an effect would add
to them. The joined parts of the chain say what is known where each part begins, so all parts are filtered side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from excite import chain

SLOW = 25  # readings whose mean counts as slow


@dataclass(frozen=True)
class Step:
    """A filter's step j in all parts that are as long: samples `at`, which parts `going`, gain K, whitening root."""

    at: np.ndarray
    going: np.ndarray
    gain: np.ndarray
    root: np.ndarray
    used: np.ndarray

    @property
    def variance(self) -> np.ndarray:
        """Of the innovations before whitening (K, m)."""
        return np.diagonal(self.root @ self.root.transpose(0, 2, 1), axis1=1, axis2=2)


@dataclass(frozen=True)
class Linear:
    """One log linearised about a point: its chain in scaled states, and what it reduces to.

    Z: twice the negative log-likelihood is [1 p]' Z [1 p] for steps p of parameters and offsets, scaled. gain
    (N - 1, n, n_u): what a torque error of one standard deviation does to the scaled state. stages: by part of the
    log. H (N, m, n), weight, residual (N, m): the readings; direct (N, m, n_f + n_o): how they move with flaws of
    sensors and offsets. noise (n_u,): standard deviation of the delivered torques' errors [N m]. beats (N, m): how many
    times larger than their weights say the readings' variance is.
    """

    solved: chain.Solved
    Z: np.ndarray
    gain: np.ndarray
    stages: tuple[chain.Stages, ...]
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
    for step in linear.filter:
        e = linear.residual[step.at, :, None] - linear.H[step.at] @ x[step.going, :, None]
        z[step.at] = np.where(step.used, e[:, :, 0] / np.sqrt(step.variance), np.nan)
        A, b = _leading(linear, step)
        x[step.going] = (A @ (x[step.going, :, None] + step.gain @ e))[:, :, 0] + b[:, :, 0]
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


def whitened(linear: Linear, flawed: tuple[int, ...], push: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Innovations of data, parameters, offsets and signatures, white and of variance one: (N m, 1 + n_p + n_o + C).

    push (N - 1, n, C): what signatures do to the scaled state behind each sample; reading (N, m, C): to readings.
    flawed: parameters that readings depend on directly. Where data = sum of columns times steps, the columns' products
    are the information about the steps, all states integrated out. Single precision.
    """
    N, m, n = linear.H.shape
    own = linear.solved.Z.shape[0]
    n_f = len(flawed)
    columns = own + push.shape[2]
    E = np.zeros((N, m, columns), np.float32)
    reach = np.zeros((N, m, n), np.float32)  # what an error of the state where the part begins does
    parts = len(linear.stages)
    x = np.zeros((parts, n, columns + n))
    x[:, :, columns:] = np.eye(n)
    told = np.concatenate([1 + np.array(flawed, int), np.arange(own - linear.direct.shape[2] + n_f, own)])
    for step in linear.filter:
        y = np.zeros((len(step.going), m, columns + n))
        y[:, :, 0] = linear.residual[step.at]
        y[:, :, told] = -linear.direct[step.at]
        y[:, :, own:columns] = -reading[step.at]
        e = y - linear.H[step.at] @ x[step.going]
        white = np.linalg.solve(step.root, e) * step.used[:, :, None]
        E[step.at], reach[step.at] = white[:, :, :columns], white[:, :, columns:]
        A, b = _leading(linear, step)
        x[step.going] = A @ (x[step.going] + step.gain @ e)
        x[step.going, :, :own] += b
        last = step.at[-1] == N - 1
        inner = step.going[:-1] if last else step.going
        x[inner, :, own:columns] += push[step.at[: len(inner)]]
    # Where each part really begins follows from the part before.
    begin = np.zeros((n, columns))
    begin[:, :own] = linear.solved.parts[0].whole.b[0]
    at = 0
    for k, stages in enumerate(linear.stages):
        stretch = slice(at, at + len(stages))
        E[stretch] += (reach[stretch].reshape(-1, n) @ begin.astype(np.float32)).reshape(-1, m, columns)
        begin = x[k, :, :columns] + x[k, :, columns:] @ begin
        at += len(stages)
    return E.reshape(-1, columns)


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
        found.append(Step(at, going, K, np.linalg.cholesky(S), weight > 0))
    return found


def _leading(linear: Linear, step: Step) -> tuple[np.ndarray, np.ndarray]:
    """Transition and drift (n, 1 + n_p + n_o) behind a step, of the parts that go on."""
    starts = np.cumsum([0, *(len(s) for s in linear.stages)])
    j = int(step.at[0] - starts[step.going[0]])
    return (
        np.stack([linear.stages[i].A[j] for i in step.going]),
        np.stack([linear.stages[i].b[j] for i in step.going]),
    )
