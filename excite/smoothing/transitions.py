"""Transitions of a state space from sample to sample, with their exact derivatives.

Every interval is integrated by Radau IIA of order 5 (Hairer and Wanner, "Solving Ordinary Differential Equations II",
IV.8). The method is L-stable, as a stiff contact at standstill demands, and its derivatives follow from the slopes at
its stages by the implicit function theorem: they are those of the integration itself, so a step that they predict to
lower a cost does lower it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from excite.smoothing.linearisation import BATCH_SIZE, StateSpace

_ROOT = np.sqrt(6.0)
STAGE_TIMES = np.array([(4 - _ROOT) / 10, (4 + _ROOT) / 10, 1.0])
RUNGE_KUTTA = np.array(
    [
        [(88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225],
        [(296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225],
        [(16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9],
    ]
)
_INVERSE = np.linalg.inv(RUNGE_KUTTA)
_VALUES, _VECTORS = np.linalg.eig(_INVERSE)
_REAL = int(np.argmin(np.abs(_VALUES.imag)))
_COMPLEX = int(np.argmax(_VALUES.imag))
_LEFT = np.linalg.inv(_VECTORS)
# Weights of the stages in the error estimate, (8.19) of the book over the real eigenvalue.
_ERROR_WEIGHTS = np.array([-(13 + 7 * _ROOT) / 3, (-13 + 7 * _ROOT) / 3, -1 / 3])

# Estimated error of a speed over one interval [rad/s, m/s], and of an effect's memory relative to its size. The
# estimate is that of a method of order 3, far above the error itself, and the torque noise of one sample does more;
# chosen.
STEP_TOLERANCE = 1e-4
NEWTON_TOLERANCE = 1e-9  # last correction of a stage, in the same measure: its error is below a tenth of that
NEWTON_STEPS = 10  # chosen; an interval that needs more is halved
MAX_SPLITS = 6  # halvings of an interval; chosen
# Mean steps for an interval, in logs longer than BATCH_SIZE. Guesses that lead to a fit take fewer; a motion that takes
# more has diverged.
MAX_MEAN_STEPS = 8


@dataclass(frozen=True)
class Transitions:
    """K intervals as they were integrated: S steps in the order of time.

    end (K, n): state at the end of each interval, not finite if it cannot be integrated or if too many need too many
    steps. interval (S,): to which a step belongs. start (S,) [s]: of a step in its interval. length (S,) [s]. stages
    (S, 3, n), inputs (S, 3, n_in): at the times STAGE_TIMES of each step.
    """

    end: np.ndarray
    interval: np.ndarray
    start: np.ndarray
    length: np.ndarray
    stages: np.ndarray
    inputs: np.ndarray

    def between(self, first: int, last: int) -> Transitions:
        """Return the intervals first to last - 1."""
        a, b = np.searchsorted(self.interval, [first, last])
        own = slice(a, b)
        return Transitions(
            self.end[first:last],
            self.interval[own] - first,
            self.start[own],
            self.length[own],
            self.stages[own],
            self.inputs[own],
        )


@dataclass(frozen=True)
class TransitionJacobians:
    """Derivatives of the state at the end of each of K intervals.

    A (K, n, n): by the state at its start. B (K, n, n_u): by a torque constant in it. X (K, n, n_base): by base
    parameters at fixed delivered torque. F (K, n, n_forced): by a constant force on each forced row. rising (K, n,
    n_u): by a torque that rises from zero at the start to one at the end.
    """

    A: np.ndarray
    B: np.ndarray
    X: np.ndarray
    F: np.ndarray
    rising: np.ndarray


def integrate(space: StateSpace, s: np.ndarray, left: np.ndarray, right: np.ndarray, X: np.ndarray) -> Transitions:
    """Integrate over the K intervals between states s (K + 1, n), each from the state at its start.

    left, right (K, n_in): inputs at both ends of each interval, linear between. The states at the ends of the intervals
    serve as guesses only.
    """
    h, K = 1 / float(space.model.machine.sampling_hz), len(left)
    work = _Integration(space, X, right - left, left, MAX_MEAN_STEPS * max(K, BATCH_SIZE))
    with np.errstate(all="ignore"):
        end = np.concatenate(
            [
                work.run(
                    np.arange(a, min(a + BATCH_SIZE, K)), s[a : min(a + BATCH_SIZE, K)], s[a + 1 : a + 1 + BATCH_SIZE]
                )
                for a in range(0, K, BATCH_SIZE)
            ]
        )
    interval, time, length, stages, inputs = (np.concatenate(parts) for parts in zip(*work.steps, strict=True))
    order = np.lexsort((time, interval))
    return Transitions(end, interval[order], h * time[order], h * length[order], stages[order], inputs[order])


class _Integration:
    """Steps of Radau IIA over intervals, halved where they are inaccurate."""

    def __init__(self, space: StateSpace, X: np.ndarray, rise: np.ndarray, left: np.ndarray, budget: int) -> None:
        self.space, self.X, self.rise, self.left, self.budget = space, X, rise, left, budget
        self.sample = 1 / float(space.model.machine.sampling_hz)
        self.scale = np.fmax(space.initial_std, 1.0)  # an effect's memory may be a torque, thousands of N m
        self.steps: list[tuple[np.ndarray, ...]] = []

    def run(
        self,
        interval: np.ndarray,
        y: np.ndarray,
        guess: np.ndarray | None,
        at: float = 0.0,
        share: float = 1.0,
        splits: int = MAX_SPLITS,
    ) -> np.ndarray:
        """Integrate from states y (K, n) over a share of each interval from `at` on; return the states at its end."""
        if len(y) > self.budget:
            return np.full_like(y, np.nan)
        self.budget -= len(y)
        time = at + share * STAGE_TIMES
        inputs = self.left[interval][:, None] + time[:, None] * self.rise[interval][:, None]
        first = self.left[interval] + at * self.rise[interval]
        stages, solved, accurate = self._step(y, guess, first, inputs, share * self.sample)
        end = stages[:, 2].copy()
        if splits:
            bad = np.flatnonzero(~accurate & np.isfinite(y).all(axis=1))
            good = np.flatnonzero(accurate)
        else:
            bad, good = np.empty(0, int), np.arange(len(y))
            end[~solved] = np.nan
        self.steps.append(
            (interval[good], np.full(len(good), at), np.full(len(good), share), stages[good], inputs[good])
        )
        if len(bad):
            half = share / 2
            middle = self.run(interval[bad], y[bad], None, at, half, splits - 1)
            end[bad] = self.run(interval[bad], middle, None, at + half, half, splits - 1)
        return end

    def _step(
        self, y: np.ndarray, guess: np.ndarray | None, first: np.ndarray, inputs: np.ndarray, h: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Make one step over h [s] from states y (K, n).

        Returns its stages (K, 3, n), where their equations are solved (K,), and where the step is accurate (K,).
        """
        space, c, K = self.space, self.space.core, len(y)
        rise = np.zeros((K, 3, space.n)) if guess is None else STAGE_TIMES[:, None] * (guess - y)[:, None]
        J = space.slopes(y + rise[:, 1], inputs[:, 1], self.X)[0]
        finite = np.isfinite(J).all(axis=(1, 2))
        J = np.where(finite[:, None, None], J, 0.0)
        eye = np.eye(c)
        real = np.linalg.inv(_VALUES[_REAL].real / h * eye - J)
        both = np.linalg.inv(_VALUES[_COMPLEX] / h * eye - J)
        left, size = np.arange(K), self.scale
        last = np.full(K, np.inf)
        rates = np.zeros((K, 3, space.n))
        for _ in range(NEWTON_STEPS):
            stage = y[left, None] + rise[left]
            found = space.rates(stage.reshape(-1, space.n), inputs[left].reshape(3 * len(left), -1), self.X)[0]
            rates[left] = found.reshape(-1, 3, space.n)
            misfit = rates[left][:, :, :c] - _INVERSE @ rise[left][:, :, :c] / h
            one = _LEFT[_REAL].real @ misfit
            pair = _LEFT[_COMPLEX] @ misfit
            step = _VECTORS[:, _REAL].real[:, None] * (real[left] @ one[:, :, None])[:, None, :, 0]
            step += 2 * (_VECTORS[:, _COMPLEX][:, None] * (both[left] @ pair[:, :, None])[:, None, :, 0]).real
            rise[left, :, :c] += step
            length = np.abs(step / size[:c]).max(axis=(1, 2))
            last[left] = length
            left = left[(length >= NEWTON_TOLERANCE) & np.isfinite(length)]
            if len(left) == 0:
                break
        rise[:, :, c:] = h * (RUNGE_KUTTA @ rates[:, :, c:])
        start = space.rates(y, first, self.X)[0][:, :c, 0]
        error = real @ (start + (_ERROR_WEIGHTS @ rise[:, :, :c]) / h)[:, :, None]
        # A second time, so that what is off and dies out within the step does not count (8.20).
        error = (_VALUES[_REAL].real / h * (real @ error))[:, :, 0]
        solved = finite & (last < STEP_TOLERANCE)
        accurate = solved & (last < NEWTON_TOLERANCE)
        accurate &= np.abs(error / size[:c]).max(axis=1, initial=0.0) < STEP_TOLERANCE
        rise[~finite] = np.nan
        return y[:, None] + rise, solved, accurate


def differentiate(
    space: StateSpace, steps: Transitions, X: np.ndarray, force: bool = False, rising: bool = False
) -> TransitionJacobians:
    """Compute the derivatives of K transitions at base parameters X (n_base,).

    force, rising: fill F, and the derivatives by rising torques, as well. Those of an interval that could not be
    integrated are nan.
    """
    A, direct, sizes = _step_jacobians(space, steps, X, force, rising)
    for own, before in _following(steps.interval):
        direct[own] += A[own] @ direct[before]
        A[own] = A[own] @ A[before]
    last = np.searchsorted(steps.interval, np.arange(len(steps.end)), side="right") - 1
    missing = ~np.isin(np.arange(len(steps.end)), steps.interval)
    A, direct = A[last], direct[last]
    A[missing], direct[missing] = np.nan, np.nan
    B, by_X, F, R = np.split(direct, np.cumsum(sizes)[:-1], axis=2)
    return TransitionJacobians(A, B, by_X, F, R)


def _following(interval: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the second steps of intervals with the steps before them, then the third steps, and so on."""
    begin = np.searchsorted(interval, interval)
    rank = np.arange(len(interval)) - begin
    for k in range(1, int(rank.max(initial=0)) + 1):
        own = np.flatnonzero(rank == k)
        yield own, own - 1


def _step_jacobians(
    space: StateSpace, steps: Transitions, X: np.ndarray, force: bool, rising: bool
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Return the derivatives of S steps by their first states (S, n, n) and by inputs, parameters, forces and rising
    inputs side by side, with the number of columns of each."""
    S, n, c = len(steps.interval), space.n, space.core
    local = space.jacobians(steps.stages.reshape(3 * S, n), steps.inputs.reshape(3 * S, -1), X)
    J, B, JX, JF, R = (e.reshape(S, 3, *e.shape[1:]) for e in local)
    h = steps.length[:, None, None]
    weights = RUNGE_KUTTA[:, None, :, None]
    whole = np.eye(3 * c) - h * (weights * J.transpose(0, 2, 1, 3)[:, None]).reshape(S, 3 * c, 3 * c)
    ends = np.zeros((S, n, 3, c))
    ends[:, range(c), 2, range(c)] = 1.0
    ends[:, c:] = h[..., None] * (RUNGE_KUTTA[2][:, None, None] * R).transpose(0, 2, 1, 3)
    by_stage = np.linalg.solve(whole.transpose(0, 2, 1), ends.reshape(S, n, 3 * c).transpose(0, 2, 1))
    by_stage = by_stage.transpose(0, 2, 1).reshape(S, n, 3, c)
    A = np.zeros((S, n, n))
    A[:, :, :c] = by_stage.sum(axis=2)
    A[:, range(c, n), range(c, n)] += 1.0
    time = (steps.start[:, None] + STAGE_TIMES * steps.length[:, None]) * float(space.model.machine.sampling_hz)
    parts = [B, JX, *([JF] if force else []), *([B * time[:, :, None, None]] if rising else [])]
    by_rate = h[..., None] * np.einsum("snic,ij->snjc", by_stage, RUNGE_KUTTA)
    direct = by_rate.reshape(S, n, 3 * c) @ np.concatenate(parts, axis=3).reshape(S, 3 * c, -1)
    n_e, n_f = B.shape[3], JF.shape[3]
    return A, direct, (n_e, JX.shape[3], n_f if force else 0, n_e if rising else 0)
