"""Fits of parameters and effects to torques: weighted least squares, and the same with whitened residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import scipy.linalg
import scipy.ndimage
import scipy.signal

from excite.diagnosis.hold_out import HoldOutErrors, torque_names
from excite.diagnosis.torque_rows import STRETCHES, TorqueRows
from excite.model import Model
from excite.model.effects import PlacedEffect

BESIDE_REST = 2  # rows to both sides of a rest that do not count as innovations; chosen
LONGEST_COURSE = 0.25  # of the rows, the longest correlation of a course; chosen
COURSE_TIMES, WHITE_SHARES = 12, np.geomspace(1e-3, 1.0, 8)  # that are tried; of the variance, what is white
LEVEL_PASSES = 4  # of the iteration for the rows' levels; chosen
FOLDS = 5  # parts that are withheld in turn; chosen


@dataclass(frozen=True, eq=False)
class Term:
    """An effect, or a smooth curve, as columns of the regression.

    columns: torques (n_rows, n, width) for each log; for an effect one, and a coefficient of 1 stands for the magnitude
    of `placed`. slopes: of the column by relative changes of the shapes `free`, (n_rows, n, m). by_magnitude: slope of
    the column by a relative change of a magnitude that it is not proportional to, (n_rows, n, 1).
    """

    placed: PlacedEffect | None
    columns: list[np.ndarray]
    slopes: list[np.ndarray]
    free: tuple[str, ...] = ()
    by_magnitude: list[np.ndarray] | None = None

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def effect(self) -> PlacedEffect:
        assert self.placed is not None
        return self.placed

    @property
    def width(self) -> int:
        return self.columns[0].shape[2]


@dataclass(frozen=True)
class Whitening:
    """Turns residuals of a torque into white noise of variance 1, whatever rows are left out.

    They are a course, a stationary process of first order, and white noise. stay: correlation of the course from row to
    row. share: of the variance, what is white. size: standard deviation of both together.
    """

    stay: float
    share: float
    size: float

    def __call__(self, values: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Return the innovations (n, ...) of values (n, ...), zero where rows are not used or near a rest."""
        variance, gain = course_gains(used, np.array([self.stay]), np.array([self.share]))
        flat = values.reshape(len(values), -1)
        found = innovations(flat, used, self.stay, variance[:, 0], gain[:, 0]) / self.size
        return (found * settled(used)[:, None]).reshape(values.shape)

    def simulate(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Return n rows of a course and white noise of this size."""
        drive = np.sqrt((1 - self.share) * np.append(1.0, np.full(n - 1, 1 - self.stay**2))) * rng.standard_normal(n)
        course = scipy.signal.lfilter([1.0], [1.0, -self.stay], drive)
        return np.asarray(self.size * (course + np.sqrt(self.share) * rng.standard_normal(n)))


def settled(used: np.ndarray) -> np.ndarray:
    """Find the rows (n,) that are used, as are their BESIDE_REST neighbours: a low-pass spreads what a rest hides."""
    return np.asarray(scipy.ndimage.minimum_filter1d(used, 2 * BESIDE_REST + 1))


def course_gains(used: np.ndarray, stay: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the variances of innovations and the gains (n, P) of a Kalman filter of a course beside white noise.

    used (n,): rows that count. stay, share (P,): see `Whitening`; the variance of both together is 1.
    """
    return _course_gains(used.tobytes(), tuple(stay), tuple(share))


@lru_cache(maxsize=128)
def _course_gains(rows: bytes, stays: tuple[float, ...], shares: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    used, stay, share = np.frombuffer(rows, bool), np.array(stays), np.array(shares)
    total, gain = np.ones((len(used), len(stay))), np.zeros((len(used), len(stay)))
    variance, drive = 1 - share, (1 - share) * (1 - stay**2)
    for k, there in enumerate(used):
        if there:
            total[k] = variance + share
            gain[k] = variance / total[k]
            variance = (1 - gain[k]) * variance
        variance = stay**2 * variance + drive
    return total, gain


def innovations(
    values: np.ndarray, used: np.ndarray, stay: float, variance: np.ndarray, gain: np.ndarray
) -> np.ndarray:
    """Return standardised innovations (n, C) of columns (n, C), zero where rows are not used."""
    known = np.where(used[:, None], values, 0.0)
    band = np.ones((2, len(values)))
    band[1, :-1] = -stay * (1 - gain[1:])
    mean = scipy.linalg.solve_banded((1, 0), band, stay * gain[:, None] * known, check_finite=False)
    before = np.concatenate([np.zeros((1, known.shape[1])), mean[:-1]])
    return np.asarray((known - before) * used[:, None] / np.sqrt(variance)[:, None])


def find_whitening(pairs: Sequence[tuple[np.ndarray, np.ndarray]], least: float) -> Whitening:
    """Return the most likely whitening of residuals (n,), of which rows are used (n,), of some logs.

    least: size of innovations at least.
    """
    longest = max(LONGEST_COURSE * max(len(e) for e, _ in pairs), 2.0)
    times = np.geomspace(1.0, longest, COURSE_TIMES)
    stay, share = (x.ravel() for x in np.meshgrid(np.exp(-1 / times), WHITE_SHARES))
    count, cost = 0, np.zeros((2, len(stay)))
    for e, used in pairs:
        counts, (variance, gain) = settled(used), course_gains(used, stay, share)
        count += int(counts.sum())
        for k, own in enumerate(stay):
            cost[0, k] += (innovations(e[:, None], used, own, variance[:, k], gain[:, k])[counts] ** 2).sum()
        cost[1] += np.log(variance[counts]).sum(axis=0)
    best = int(np.argmin(count * np.log(np.maximum(cost[0], 1e-300)) + cost[1]))
    size = float(np.sqrt(cost[0, best] / max(count, 1)))
    return Whitening(float(stay[best]), float(share[best]), max(size, least))


class TorqueFit:
    """Parameters and effects fitted to rows: weighted least squares, and the same with whitened residuals.

    kept: numbers of the base parameters that the rows show. lowest (n_rows,): noise of the rows [N m or N]. level
    (n_rows,): root mean square of what the fit leaves, at least that noise.
    """

    def __init__(
        self, model: Model, rows: Sequence[TorqueRows], kept: Sequence[int], lowest: np.ndarray, terms: Sequence[Term]
    ) -> None:
        self.model, self.rows, self.kept, self.lowest, self.terms = model, rows, list(kept), lowest, tuple(terms)
        self.design = [
            np.concatenate([r.W[:, :, self.kept], *(t.columns[k] for t in terms)], axis=2) for k, r in enumerate(rows)
        ]
        self.level = np.maximum(self._level([r.Y for r in rows]), lowest)
        each = [self._triangle_of_row(k) for k in range(len(lowest))]
        for _ in range(LEVEL_PASSES):
            self.x = solve(np.concatenate([R / level for R, level in zip(each, self.level, strict=True)]))
            self.residual = [r.Y - A @ self.x for r, A in zip(rows, self.design, strict=True)]
            self.level = np.maximum(self._level(self.residual), lowest)
        self.whitening = self._whitening()
        self._predicted: dict[TorqueFit, tuple[np.ndarray, HoldOutErrors]] = {}

    def without(self, term: Term) -> TorqueFit:
        return self.with_terms([t for t in self.terms if t is not term])

    def with_terms(self, terms: Sequence[Term]) -> TorqueFit:
        return TorqueFit(self.model, self.rows, self.kept, self.lowest, terms)

    def _triangle_of_row(self, k: int) -> np.ndarray:
        """Triangle of [design, torque] of one row in motion."""
        own = [
            np.column_stack([A[k][r.used[k]], r.Y[k][r.used[k]]]) for A, r in zip(self.design, self.rows, strict=True)
        ]
        return triangle(np.concatenate(own))

    def _level(self, errors: Sequence[np.ndarray]) -> np.ndarray:
        """Root mean square (n_rows,) of the rows in motion."""
        square = sum((e**2 * r.used).sum(axis=1) for e, r in zip(errors, self.rows, strict=True))
        return np.sqrt(square / np.maximum(sum(r.used.sum(axis=1) for r in self.rows), 1))

    def _whitening(self) -> list[Whitening]:
        """Find the whitening of each row's residuals."""
        found = []
        for k, lowest in enumerate(self.lowest):
            pairs = [(e[k], r.used[k]) for e, r in zip(self.residual, self.rows, strict=True)]
            found.append(find_whitening(pairs, max(1e-3 * float(lowest), 1e-12)))
        return found

    def _weight(self, values: np.ndarray, r: TorqueRows) -> np.ndarray:
        """Rows in motion over their level, (n, ...) from (n_rows, n, ...)."""
        each = values / self.level.reshape(-1, *[1] * (values.ndim - 1))
        return np.concatenate([v[used] for v, used in zip(each, r.used, strict=True)])

    def _whiten(self, values: np.ndarray, r: TorqueRows) -> np.ndarray:
        """Innovations of rows in motion, (n, ...) from (n_rows, n, ...)."""
        return np.concatenate([f(v, used)[used] for v, used, f in zip(values, r.used, self.whitening, strict=True)])

    def simulated(self, rng: np.random.Generator) -> TorqueFit:
        """Return the fit to clean torques: those of this fit with new noise of the kind that it leaves."""
        rows = []
        for r, A in zip(self.rows, self.design, strict=True):
            noise = np.array([w.simulate(r.Y.shape[1], rng) for w in self.whitening])
            rows.append(replace(r, Y=A @ self.x + noise))
        return TorqueFit(self.model, rows, self.kept, self.lowest, self.terms)

    @cached_property
    def stretches(self) -> np.ndarray:
        """Number (N,) of the stretch of every row that counts, all logs after each other."""
        return np.concatenate(
            [np.concatenate([r.stretch[used] for used in r.used]) + k * STRETCHES for k, r in enumerate(self.rows)]
        )

    def whiten_all(self, values: Sequence[np.ndarray]) -> np.ndarray:
        """Innovations (N, ...) of values (n_rows, n, ...) of each log."""
        return np.concatenate([self._whiten(v, r) for v, r in zip(values, self.rows, strict=True)])

    def weight_all(self, values: Sequence[np.ndarray]) -> np.ndarray:
        """Weighted rows (N, ...) of values (n_rows, n, ...) of each log."""
        return np.concatenate([self._weight(v, r) for v, r in zip(values, self.rows, strict=True)])

    @cached_property
    def _whitened_parameters(self) -> np.ndarray:
        """Whitened columns (N, k) of the parameters."""
        return self.whiten_all([r.W[:, :, self.kept] for r in self.rows])

    @cached_property
    def whitened_torques(self) -> np.ndarray:
        return self.whiten_all([r.Y for r in self.rows])

    def _whitened_design(self, like: TorqueFit) -> np.ndarray:
        """Columns (N, k) of this fit, whitened like another one."""
        beside = [like.whiten_all(t.columns) for t in self.terms]
        return np.concatenate([like._whitened_parameters, *beside], axis=1)

    @cached_property
    def whitened_x(self) -> np.ndarray:
        """Coefficients (k,) of whitened rows."""
        return solve(triangle(np.column_stack([self.whitened_design, self.whitened_torques])))

    @cached_property
    def innovations(self) -> np.ndarray:
        """Whitened residuals (N,)."""
        return self.whitened_torques - self.whitened_design @ self.whitened_x

    @cached_property
    def basis(self) -> np.ndarray:
        """Orthonormal basis (N, k) of the whitened columns."""
        return np.linalg.qr(normalise(self.whitened_design))[0]

    @cached_property
    def whitened_design(self) -> np.ndarray:
        """Whitened columns (N, k) of parameters and terms."""
        return self._whitened_design(self)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (k + m, k + m) of x and of the shapes by the scatter from stretch to stretch."""
        slopes = []
        for k, r in enumerate(self.rows):
            own = [t.columns[k] if t.by_magnitude is None else t.by_magnitude[k] for t in self.terms]
            shapes = [t.slopes[k] * self.x[self.columns_of(t)][0] for t in self.terms]
            slopes.append(np.concatenate([r.W[:, :, self.kept], *own, *shapes], axis=2))
        A, e, stretch = self.weight_all(slopes), self.weight_all(self.residual), self.stretches
        size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        A = A / size
        bread = np.linalg.pinv(A.T @ A, hermitian=True)
        scores = np.array([A[stretch == c].T @ e[stretch == c] for c in np.unique(stretch)])
        meat = scores.T @ scores * len(scores) / max(len(scores) - 1, 1)
        white = bread * float(e @ e) / max(len(e) - len(bread), 1)
        robust = bread @ meat @ bread
        grow = np.sqrt(np.maximum(np.diag(robust) / np.maximum(np.diag(white), 1e-300), 1.0))
        scale = np.outer(size, size)
        return np.divide(white * np.outer(grow, grow), scale, out=np.full_like(scale, np.inf), where=scale > 0)

    def columns_of(self, term: Term) -> slice:
        """Columns of a term in the design."""
        k = self.terms.index(term)
        first = len(self.kept) + sum(t.width for t in self.terms[:k])
        return slice(first, first + term.width)

    def coefficient(self, term: Term) -> tuple[float, float]:
        """Coefficient of an effect and its standard deviation, which includes how far the whitened fit is off."""
        k = self.columns_of(term).start
        return float(self.x[k]), float(np.hypot(np.sqrt(self.covariance[k, k]), self.x[k] - self.whitened_x[k]))

    def shape_stds(self, term: Term) -> dict[str, float]:
        """Standard deviations of a term's free shapes, relative to their values; inf for one that shows nowhere."""
        k = self.terms.index(term)
        first = self.design[0].shape[2] + sum(len(t.free) for t in self.terms[:k])
        return {n: float(np.sqrt(self.covariance[first + i, first + i])) for i, n in enumerate(term.free)}

    def hold_out(self, like: TorqueFit) -> tuple[np.ndarray, HoldOutErrors]:
        """Predict every fifth stretch from the others.

        like: whitens the rows. Return the log-likelihood (stretches,) of the innovations, and the torque errors.
        """
        if like not in self._predicted:
            self._predicted[like] = self._hold_out(like)
        return self._predicted[like]

    def _hold_out(self, like: TorqueFit) -> tuple[np.ndarray, HoldOutErrors]:
        A = np.column_stack([self._whitened_design(like), like.whitened_torques])
        V = np.column_stack([self.weight_all(self.design), self.weight_all([r.Y for r in self.rows])])
        group = self.stretches
        parts = [[triangle(M[group % FOLDS == turn]) for turn in range(FOLDS)] for M in (A, V)]
        names = np.unique(group)
        likelihood = np.zeros(len(names))
        n_rows = len(self.level)
        squares, counts, motion = (np.zeros((len(names), n_rows)) for _ in range(3))
        for turn in range(FOLDS):
            x, w = (solve(np.concatenate([R for k, R in enumerate(own) if k != turn])) for own in parts)
            for c, name in enumerate(names):
                if name % FOLDS != turn:
                    continue
                own = group == name
                likelihood[c] = -0.5 * float(((A[own, -1] - A[own, :-1] @ x) ** 2).sum())
                k = int(name) // STRETCHES
                r, inside = self.rows[k], self.rows[k].stretch == name % STRETCHES
                error = (r.Y - self.design[k] @ w) * r.used
                squares[c] = (error[:, inside] ** 2).sum(axis=1)
                counts[c] = r.used[:, inside].sum(axis=1)
                motion[c] = ((r.Y * r.used)[:, inside] ** 2).sum(axis=1) / np.maximum(counts[c], 1)
        rows = list(self.model.actuated)
        shown = HoldOutErrors(
            torque_names(self.model.machine),
            squares[:, rows],
            counts[:, rows],
            (motion * counts)[:, rows].sum(axis=0) / np.maximum(counts[:, rows].sum(axis=0), 1),
            self.level[rows] ** 2,
            np.zeros(len(names), int),
            np.full((len(names), 1), np.nan),
        )
        return likelihood, shown


def triangle(rows: np.ndarray) -> np.ndarray:
    """Reduce rows (N, k) to a triangle with the same products of columns."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def solve(rows: np.ndarray) -> np.ndarray:
    """Solve least squares (k,) from rows or a triangle of [A, b], with columns of any size."""
    A = rows[:, :-1]
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(A / size, rows[:, -1], rcond=1e-10)[0] / size)


def normalise(A: np.ndarray) -> np.ndarray:
    return np.asarray(A / np.maximum(np.linalg.norm(A, axis=0), 1e-300))
