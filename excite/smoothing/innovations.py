"""Innovations of a log: each reading minus its prediction from all readings before it.

A Kalman filter runs along the smoother's last linearisation. With the right model and noise, the normalised
innovations are white with variance one. A signature filtered the same way is what an effect would add to them.
The combined elements of the chain give the state at the start of each part, so all parts are filtered in parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from excite.smoothing import parallel_smoother
from excite.smoothing.linearisation import BATCH_SIZE

SLOW_BLOCK = 25  # readings in a block whose sum shows slow errors; chosen


@dataclass(frozen=True)
class FilterStep:
    """Step j of the Kalman filter in all P parts that are long enough.

    samples, parts (P,): indices of samples and parts. A (P, n, n): transition to the next sample. gain (P, n, m).
    whitening (P, m, m): matrix that makes the innovations white. variance (P, m): of the innovations. used (P, m).
    """

    samples: np.ndarray
    parts: np.ndarray
    A: np.ndarray
    gain: np.ndarray
    whitening: np.ndarray
    variance: np.ndarray
    used: np.ndarray


@dataclass(frozen=True)
class LinearisedLog:
    """One log linearised about a trajectory, in scaled states; `Z` has its states integrated out.

    chain: combined elements of the smoother, the prior of the first state before them.
    drive (N, n, c): what data and each scaled step of parameters, unknown forces and offsets add to the state after a
    sample, zero after the last. start (n,): mean of the first state.
    gain (N - 1, n, n_e): effect of one standard deviation of each white error on the scaled state.
    elements: elements of the chain, part by part.
    H (N, m, n), weight, residual (N, m): slopes, 1 / variance and residual of the readings.
    direct (N, m, n_f + n_o): slopes of the readings by the parameters they depend on directly, and by offsets.
    noise (N - 1, n_e): standard deviation of the white errors: delivered torques [N m], then forces.
    beat_inflation (N, m): variance of the readings relative to 1 / weight where encoder errors beat.
    direct_columns: columns of `drive` that `direct` belongs to.
    acting (n_e,): places of the white errors in `gain` and `noise` among all torques and forces.
    closing (N - 1, n, n): what defects are multiplied by in the chain (`forward.close`), None if by one.
    """

    chain: parallel_smoother.SmoothedChain
    drive: np.ndarray
    start: np.ndarray
    gain: np.ndarray
    elements: tuple[parallel_smoother.Elements, ...]
    H: np.ndarray
    weight: np.ndarray
    residual: np.ndarray
    direct: np.ndarray
    noise: np.ndarray
    beat_inflation: np.ndarray
    acting: np.ndarray
    direct_columns: np.ndarray
    closing: np.ndarray | None = None

    @cached_property
    def Z(self) -> np.ndarray:
        """Matrix (c, c): for steps p, twice the negative log-likelihood is [1 p]' Z [1 p], states integrated out."""
        return information(self)

    def states(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the most likely states and slopes (N, n) for a step p (c - 1,), see `SmoothedChain.states`."""
        found = self._states_for(np.concatenate([[1.0], p])[:, None])
        return found[0][:, :, 0], found[1][:, :, 0]

    def state_slopes(self, of: slice) -> np.ndarray:
        """Return the derivatives of the most likely states by some of p (N, n, w)."""
        return self._states_for(np.eye(self.drive.shape[2])[:, 1:][:, of])[0]

    def _states_for(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the most likely states and slopes (N, n, w) for weights (c, w) of the data and p."""
        first = self.start[:, None] * weights[:1]
        reading = self.residual[:, :, None] * weights[:1] - self.direct @ weights[self.direct_columns]
        pull = self.H.transpose(0, 2, 1) @ (self.weight[:, :, None] * reading)
        none = np.zeros_like(first)[None]
        return self.chain.states(np.concatenate([first[None], self.drive @ weights]), np.concatenate([none, pull]))

    @cached_property
    def innovations(self) -> np.ndarray:
        """Normalised innovations of every reading (N, m); NaN if unused."""
        return innovations(self)

    @cached_property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariances of the states from all readings before (N, n, n), and of the multipliers after the transitions.

        A multiplier (N - 1 in all) scatters with J (I + P J)^-1, where J is the information about the state after the
        transition from all readings there and later, and a smoothed white error is gain' times it.
        """
        P, J = self.chain.moments()
        return P, parallel_smoother.shrink(J[1:], P[1:])

    @cached_property
    def filter(self) -> list[FilterStep]:
        """Steps of the Kalman filter along the log."""
        return filter_steps(self)


def innovations(linear: LinearisedLog) -> np.ndarray:
    """Compute the innovations (N, m), each over its standard deviation; NaN where a reading is unused."""
    normalised = np.full(linear.residual.shape, np.nan)
    white = np.concatenate([E for E, _, _ in _whitened(linear, 1)])
    for step in linear.filter:
        innovation = np.linalg.solve(step.whitening, white[step.samples, :, :1])[:, :, 0]
        normalised[step.samples] = np.where(step.used, innovation / np.sqrt(step.variance), np.nan)
    return normalised


def information(linear: LinearisedLog) -> np.ndarray:
    """Compute Z (c, c) of a log with all states integrated out: products of the white innovations of its columns."""
    count = linear.drive.shape[2]
    Z = np.zeros((count, count))
    for E, _, _ in _whitened(linear, count):
        flat = E.reshape(-1, count)
        Z += flat.T @ flat
    return Z


def log_variance(linear: LinearisedLog) -> float:
    """Return the logarithm of the determinant of the covariance of all innovations of a log [SI]."""
    diagonals = [(step.whitening, step.used) for step in linear.filter]
    return -2 * sum(float(np.log(np.diagonal(w, axis1=1, axis2=2)[used]).sum()) for w, used in diagonals)


def expected_squares(linear: LinearisedLog) -> np.ndarray:
    """Return the sum over a log of the expected square of each smoothed white error (n_e,), of unit variance."""
    return np.asarray(np.sum(linear.gain * (linear.moments[1] @ linear.gain), axis=(0, 1)))


def innovation_statistics(linear: LinearisedLog) -> np.ndarray:
    """Compute, for each sensor, the statistics (m, 3) that test whether model and noise explain a log.

    Columns: mean square of the normalised innovations; mean square of their sums over blocks of SLOW_BLOCK readings,
    over its expectation; number of blocks. Both mean squares are 1 if model and noise are right.
    """
    normalised, expected = linear.innovations, np.ones(linear.residual.shape)
    for step in linear.filter if (linear.beat_inflation != 1).any() else ():
        added = (linear.beat_inflation[step.samples] - 1) / np.where(step.used, linear.weight[step.samples], np.inf)
        expected[step.samples] += added / step.variance
    statistics = np.zeros((normalised.shape[1], 3))
    for j, column in enumerate(normalised.T):
        used = np.flatnonzero(np.isfinite(column))
        blocks = used[: len(used) // SLOW_BLOCK * SLOW_BLOCK].reshape(-1, SLOW_BLOCK)
        if blocks.size:
            slow = column[blocks].sum(axis=1) ** 2 / expected[blocks, j].sum(axis=1)
            statistics[j] = np.mean(column[used] ** 2), np.mean(slow), len(slow)
    return statistics


@dataclass(frozen=True)
class WhitenedInnovations:
    """White innovations of a log, of variance one, as columns of a linear regression.

    E (N, m, 1 + n_p + n_o): columns of the data, the parameters and the offsets.
    start_response (N, m, n): response of a part's innovations to the state at its start.
    transitions (parts, n, n): response of the state at a part's end to the state at its start.
    """

    E: np.ndarray
    start_response: np.ndarray
    transitions: np.ndarray


def _batches(linear: LinearisedLog) -> Iterator[tuple[slice, slice]]:
    """Yield batches of about BATCH_SIZE samples: the slice of parts and the slice of samples."""
    ends = np.cumsum([len(elements) for elements in linear.elements])
    first = begin = 0
    while first < len(ends):
        last = max(first + 1, int(np.searchsorted(ends, begin + BATCH_SIZE, "right")))
        yield slice(first, last), slice(begin, int(ends[last - 1]))
        first, begin = last, int(ends[last - 1])


def whiten(linear: LinearisedLog) -> WhitenedInnovations:
    """Filter data, parameters and offsets to white innovations, in single precision.

    The products of the columns are the information about parameter steps with all states integrated out.
    """
    found = list(_whitened(linear, linear.drive.shape[2]))
    E, start_response = (np.concatenate([own[k].astype(np.float32) for own in found]) for k in (0, 1))
    return WhitenedInnovations(E, start_response, np.concatenate([own[2] for own in found]))


def _whitened(linear: LinearisedLog, count: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield E, start_response, transitions of `WhitenedInnovations` batch by batch, for the first columns."""
    m, n = linear.H.shape[1:]
    begin = np.zeros((n, count))
    begin[:, 0] = linear.start
    seen = linear.direct_columns < count
    for parts, samples in _batches(linear):
        K = samples.stop - samples.start
        reading, push = np.zeros((K, m, count + n)), np.zeros((K, n, count + n))
        reading[:, :, 0] = -linear.residual[samples]
        reading[:, :, linear.direct_columns[seen]] = linear.direct[samples][:, :, seen]
        push[:, :, :count] = linear.drive[samples, :, :count]
        x = np.zeros((parts.stop - parts.start, n, count + n))
        x[:, :, count:] = np.eye(n)
        filtered = _filter_columns(linear, parts, samples.start, x, push, reading)
        E, start_response, transitions = filtered[:, :, :count], filtered[:, :, count:], x[:, :, count:]
        begin = _join_parts(linear, parts, E, start_response, transitions, x[:, :, :count], begin)
        yield E, start_response, transitions


def whiten_signatures(
    linear: LinearisedLog, whitened: WhitenedInnovations, signatures: Callable[[slice], tuple[np.ndarray, np.ndarray]]
) -> Iterator[tuple[slice, np.ndarray]]:
    """Filter the signatures of C effects to white innovations; yield slices of samples and innovations (K, m, C).

    signatures: function of a slice of K samples. It returns the change of the scaled state after each sample (K, n, C),
    zero after the last one, and the change of the readings (K, m, C).
    """
    begin = np.zeros((linear.H.shape[2], 1))
    for parts, samples in _batches(linear):
        push, reading = signatures(samples)
        x = np.zeros((parts.stop - parts.start, *push.shape[1:]))
        E = _filter_columns(linear, parts, samples.start, x, push, reading)
        begin = _join_parts(linear, parts, E, whitened.start_response[samples], whitened.transitions[parts], x, begin)
        yield samples, E


def _filter_columns(
    linear: LinearisedLog, parts: slice, first: int, x: np.ndarray, push: np.ndarray, reading: np.ndarray
) -> np.ndarray:
    """Filter k columns; return their white innovations (K, m, k).

    x (parts, n, k): states at the start of each part, overwritten by those at its end. push (K, n, k), reading (K, m,
    k): inputs to states and readings. first: first sample of the parts.
    """
    E = np.empty_like(reading)
    for step in linear.filter:
        own = slice(*np.searchsorted(step.parts, (parts.start, parts.stop)))
        if own.start == own.stop:
            break  # every part of this batch has ended
        samples, running = step.samples[own] - first, step.parts[own] - parts.start
        innovation = -(reading[samples] + linear.H[step.samples[own]] @ x[running])
        E[samples] = (step.whitening[own] * step.used[own, :, None]) @ innovation
        x[running] = step.A[own] @ (x[running] + step.gain[own] @ innovation) + push[samples]
    return E


def _join_parts(
    linear: LinearisedLog,
    parts: slice,
    E: np.ndarray,
    start_response: np.ndarray,
    transitions: np.ndarray,
    ends: np.ndarray,
    begin: np.ndarray,
) -> np.ndarray:
    """Add to the innovations E (K, m, k) that each part starts where the one before ends; return the final state (n,
    k).

    ends (parts, n, k): final states of the parts if they start at zero. begin (n, k): state at the start of the first.
    start_response (K, m, n), transitions (parts, n, n): see WhitenedInnovations.
    """
    first = 0
    for k, elements in enumerate(linear.elements[parts]):
        own = slice(first, first + len(elements))
        E[own] += start_response[own] @ begin.astype(E.dtype)
        begin = ends[k] + transitions[k] @ begin
        first += len(elements)
    return begin


def _predict_part_starts(linear: LinearisedLog) -> np.ndarray:
    """Return the covariance (parts, n, n) of the state at the start of each part, from all readings before."""
    parts, n = linear.chain.parts, linear.H.shape[2]
    P = np.empty((len(linear.elements), n, n))
    P[0] = parts[0].total.C[0]
    for k, part in enumerate(parts[1:-1]):
        A, C, J = part.total.A[0], part.total.C[0], part.total.J[0]
        P[k + 1] = A @ np.linalg.solve(np.eye(n) + P[k] @ J, P[k]) @ A.T + C
    return P


def filter_steps(linear: LinearisedLog) -> list[FilterStep]:
    """Compute the gains of the Kalman filter, step by step in all parts in parallel."""
    starts = np.cumsum([0, *(len(s) for s in linear.elements)])
    P = _predict_part_starts(linear)
    largest_weight = linear.weight.max(axis=0)
    steps = []
    for j in range(max(len(s) for s in linear.elements)):
        running = np.array([i for i, s in enumerate(linear.elements) if j < len(s)])
        samples = starts[running] + j
        h, weight = linear.H[samples], linear.weight[samples]
        cross = P[running] @ h.transpose(0, 2, 1)
        # An unused reading is one with a huge variance.
        variance = 1 / np.maximum(weight, 1e-9 * np.where(largest_weight > 0, largest_weight, 1.0))
        S = h @ cross
        S = (S + S.transpose(0, 2, 1)) / 2
        S[:, range(h.shape[1]), range(h.shape[1])] += variance
        whitening = np.linalg.inv(np.linalg.cholesky(S))
        seen = cross @ whitening.transpose(0, 2, 1)
        gain = seen @ whitening
        A, C = (np.stack([getattr(linear.elements[i], f)[j] for i in running]) for f in ("A", "C"))
        P[running] = A @ (P[running] - seen @ seen.transpose(0, 2, 1)) @ A.transpose(0, 2, 1) + C
        steps.append(
            FilterStep(samples, running, A, gain, whitening, np.diagonal(S, axis1=1, axis2=2).copy(), weight > 0)
        )
    return steps
