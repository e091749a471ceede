"""Sizes of what a model lacks, by marginal likelihood.

A linearised fit is a quadratic form in base parameters and coefficients. With these integrated out, the likelihood of
the sizes is that of a linear Gaussian model. The logarithms of the sizes, over their typical values, scatter about a
common level with SIZE_SCATTER: where something is lacking, so may others be that the logs tell less of. Source: MacKay,
"Bayesian interpolation", Neural Computation 4, 1992.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from excite.smoothing.innovations import expected_squares, whiten
from excite.smoothing.linearisation import StateSpace
from excite.smoothing.log_fit import Fit, fit_logs, linearise_with, log_determinant
from excite.smoothing.measurements import Measurements, Trajectory
from excite.smoothing.solver import Settings, inverse
from excite.smoothing.unknown_forces import UnknownForces, catalogue

SIZE_SCATTER = 1.0  # standard deviation of the logarithm of a size about the common level: a factor of e
CLEAN_LIKELIHOOD_RATIO = 8.0  # twice the log-likelihood that the common level must gain: one false alarm in 400 logs
LEVELS = np.linspace(-7.0, 1.0, 17)  # logarithms of the common level that are tried; sizes stay within them
STARTS = (-4.0, -2.0, 0.0)  # of the logarithms of all sizes
PASSES = 60  # of the fixed point
SETTLED = 0.02  # step of all logarithms that ends it

FIRST_FORCE_STD = 300.0  # [N, N m] of white forces in the first round, larger than what most logs need
SLOWEST_SHRINKING = 0.4  # of a size from round to round, as shapes along a trajectory that still moves mislead
FIRST_DAMPING = 1e4  # information of a parameter known to 1 % of its scale: sizes come first, then the parameters
FORCES = ("lengthwise", "lateral", "turning")  # of a contact that are white, too
# Rounds: sizes and shapes are renewed after each. Sizes settle while parameters hardly move, else these take the place
# of what a size that is still too small leaves out. Largest step that ends a round [standard deviations], and damping.
SETTLING_ROUNDS = (Settings(3, FIRST_DAMPING, 1.0, tolerance=0.3),) * 5
ROUNDS = (
    *SETTLING_ROUNDS,
    Settings(12, tolerance=0.2),
    Settings(8, 0.25, tolerance=0.1),
    Settings(8, 0.25, tolerance=0.05),
)


@dataclass(frozen=True)
class FitBeside:
    """A fit with unknown forces, and the measurements with the noise of torques that it leaves."""

    fit: Fit
    measurements: tuple[Measurements, ...]


def fit_unknown_forces(
    space: StateSpace,
    measurements: Sequence[Measurements],
    starts: Sequence[Trajectory],
    held: np.ndarray,
    rounds: Sequence[Settings] = ROUNDS,
    named: bool = False,
    first: tuple[np.ndarray, Sequence[Trajectory]] | None = None,
    before: FitBeside | None = None,
) -> FitBeside:
    """Fit logs with what the model lacks, its sizes found.

    rounds: settings of each. named: only shapes that effects of the catalogue have, which takes a quarter of the time
    and follows the logs as well. first: parameters (n_base,) and trajectories to begin with. before: a fit of a similar
    model to the same logs, whose sizes are good ones to begin with.
    """
    model, n_u = space.model, len(space.model.inputs)
    white = np.array([FIRST_FORCE_STD * (kind in FORCES) for _, kind in space.forces])
    X, trajectories = (model.nominal, tuple(starts)) if first is None else (first[0], tuple(first[1]))
    size, inflation, logs, pull = None, np.ones(n_u), tuple(measurements), None
    known = dict[str, float]()
    if before is not None:
        known = dict(zip((g.name for g in before.fit.unknown.groups), before.fit.unknown.size, strict=True))
        white = before.fit.unknown.lacking[0].force_std
        inflation = np.square(before.measurements[0].noise.torque / measurements[0].noise.torque)
        logs = _with_torque_noise(measurements, inflation)
    fit: Fit | None = None
    for k, settings in enumerate(rounds):
        unknown = catalogue(space, list(zip(logs, trajectories, strict=True)), X, white, True if named else None)
        if size is None:
            trajectories = _without_coefficients(trajectories, unknown)
            size = np.array([known.get(g.name, x) for g, x in zip(unknown.groups, unknown.size, strict=True)])
        unknown = replace(unknown, size=size)
        latest = fit_logs(space, logs, trajectories, X, starts, held, settings=settings, unknown=unknown, pull=pull)
        lost = not (latest.linear and latest.cost > 0) or any(t.force_error is None for t in latest.trajectories)
        fit = latest if fit is None or not lost else fit
        if lost:
            break
        if k + 1 >= len(SETTLING_ROUNDS) and settings is not rounds[-1]:
            pull = log_determinant(space, logs, starts, fit)
        X, trajectories, found = fit.X, fit.trajectories, find_sizes(fit).size
        size = np.maximum(found, SLOWEST_SHRINKING * unknown.size)
        ratio = white_noise_ratios(fit)
        inflation = np.maximum(inflation * ratio[:n_u], 1.0)
        logs = _with_torque_noise(measurements, inflation)
        white = white.copy()
        white[white > 0] *= np.clip(np.minimum(ratio[n_u:], np.sqrt(ratio[n_u:])), 0.1, 10.0)
    assert fit is not None
    spread = clustered_inflation(fit, float(model.machine.sampling_hz)) if fit.linear else np.ones(len(fit.X))
    return FitBeside(replace(fit, covariance=fit.covariance * np.outer(spread, spread)), logs)


def _with_torque_noise(logs: Sequence[Measurements], inflation: np.ndarray) -> tuple[Measurements, ...]:
    """Return logs with the variance of torques inflated (n_u,)."""
    noises = (replace(data.noise, torque=data.noise.torque * np.sqrt(inflation)) for data in logs)
    return tuple(replace(data, noise=noise) for data, noise in zip(logs, noises, strict=True))


AVERAGED_SCATTER = 1.5  # of the logarithm of a size about the level of all; chosen, wider than where sizes are sought


def average_over_sizes(space: StateSpace, fit: Fit) -> Fit:
    """Return the fit with parameters and covariance averaged over what sizes may be, not for the most likely ones.

    Where logs tell little of a size, a most likely one is too small as often as too large, and values that depend on
    it are surer than they should be. Each group's size is averaged over its posterior about the fit's quadratic form,
    the others fixed (law of total variance); what that adds is summed over the groups, and nothing is taken away.
    Constant errors cannot be told from the parameters; their variance is the mean square before any log. Parameters
    move as far as they may; the trajectories stay.
    """
    n, unknown, model = len(fit.X), fit.unknown, space.model
    every = inverse(fit.information)
    mean = every @ fit.right_side
    level = np.log(unknown.size).mean()
    square = scipy.special.softmax(-(((LEVELS - level) / AVERAGED_SCATTER) ** 2) / 2) @ np.exp(2 * LEVELS)
    moved, more = np.zeros(n), np.zeros((n, n))
    for group, size in zip(unknown.groups, unknown.size, strict=True):
        own = n + group.every
        precision = np.linalg.inv(every[np.ix_(own, own)])
        by_own = every[:n, own] @ precision
        told = _positive_part(precision - size**-2 * np.eye(len(own)))
        weights, means, covariances = list[float](), list[np.ndarray](), list[np.ndarray]()
        for log in LEVELS:
            information = told + np.exp(-2 * log) * np.eye(len(own))
            covariances.append(np.linalg.inv(information))
            means.append(covariances[-1] @ precision @ mean[own])
            gained = means[-1] @ information @ means[-1] - np.linalg.slogdet(information)[1]
            weights.append(gained / 2 - len(own) * log - ((log - level) / AVERAGED_SCATTER) ** 2 / 2)
        weight = scipy.special.softmax(weights)
        average = weight @ np.array(means)
        off = np.array(means) - average
        covariance = np.einsum("k,kij->ij", weight, covariances) + (weight[:, None] * off).T @ off
        moved += by_own @ (average - mean[own])
        more += by_own @ _positive_part(covariance - every[np.ix_(own, own)]) @ by_own.T
    spread = fit.std / np.sqrt(np.diag(every)[:n])
    shares = (fit.X + share * model.scale * moved for share in (1.0, 0.5, 0.25))
    allowed = (X for X in shares if (X[model.positive] > 0).all() and not (space.soil @ X > 0).any())
    constant = np.diag(square * unknown.constant_errors**2)
    return replace(fit, X=next(allowed, fit.X), covariance=(every[:n, :n] + more) * np.outer(spread, spread) + constant)


def _positive_part(A: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix (n, n) without its negative eigenvalues."""
    values, vectors = np.linalg.eigh((A + A.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


CLUSTER_S = 2.0  # [s] of a log within which errors may be correlated: a manoeuvre


def clustered_inflation(fit: Fit, rate: float) -> np.ndarray:
    """Return factors (n_base,), at least 1, on standard deviations for errors that are correlated within CLUSTER_S.

    A jackknife: the linearised fit is solved again without each stretch, as scores alone say too little where many
    coefficients follow a stretch closely (Bell and McCaffrey, Survey Methodology 28 (2002) 169, without the factor for
    few clusters). A tenth of what one stretch alone tells stays, or only the prior would.
    """
    covariance, size = inverse(fit.information), int(CLUSTER_S * rate)
    square, n = np.zeros(len(fit.X)), len(fit.X)
    for log, own in zip(fit.linear, fit.indices, strict=True):
        values, vectors = np.linalg.eigh(covariance[np.ix_(own, own)])
        root, E = vectors * np.sqrt(np.maximum(values, 0.0)), whiten(log).E
        for begin in range(0, len(E), size):
            rows = E[begin : begin + size].reshape(-1, E.shape[2]).astype(float)
            seen = rows[:, 1:] @ root
            share, along = np.linalg.eigh(seen.T @ seen)  # that the stretch has of what is known in each direction
            moved = along @ (along.T @ (seen.T @ rows[:, 0]) / (1 - np.minimum(share, 0.9)))
            square += (root[:n] @ moved) ** 2
    return np.sqrt(np.maximum(square / np.diag(covariance)[:n], 1.0))


def lacks_forces(
    space: StateSpace, measurements: Sequence[Measurements], starts: Sequence[Trajectory], held: np.ndarray, exact: Fit
) -> bool:
    """Tell if the marginal likelihood grows with any size of what the model lacks, about a fit of exact dynamics."""
    if exact.cost < CLEAN_LIKELIHOOD_RATIO:  # of noiseless logs, of which more cannot be gained
        return False
    none = np.zeros(len(space.forces))
    unknown = catalogue(space, list(zip(measurements, exact.trajectories, strict=True)), exact.X, none)
    along = _without_coefficients(exact.trajectories, unknown)
    fit = linearise_with(space, measurements, along, exact.X, starts, held | exact.unidentifiable, unknown)
    if fit is None:
        return False
    own, groups = _integrate_out_parameters(fit), len(unknown.groups)
    return max(own.posterior(np.full(groups, level))[2] for level in LEVELS) >= CLEAN_LIKELIHOOD_RATIO


def _without_coefficients(trajectories: Sequence[Trajectory], unknown: UnknownForces) -> tuple[Trajectory, ...]:
    """Set all coefficients of what is lacking along some trajectories to zero."""
    logs = zip(trajectories, unknown.lacking, strict=True)
    return tuple(replace(t, lacking=np.zeros(own.count), force_error=None) for t, own in logs)


@dataclass(frozen=True)
class _Coefficients:
    """Information (n, n) and right side (n,) of the coefficients without their prior, all else integrated out."""

    information: np.ndarray
    right_side: np.ndarray
    group: np.ndarray

    def posterior(self, logs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return mean and variance (n,), over the sizes, and twice the log-likelihood gained, for sizes exp(logs)."""
        size = np.exp(logs)[self.group]
        values, vectors = np.linalg.eigh(size[:, None] * self.information * size)
        total = np.maximum(values, 0.0) + 1.0
        pull = vectors.T @ (size * self.right_side)
        mean = vectors @ (pull / total)
        return mean, vectors**2 @ (1 / total), float(np.sum(pull**2 / total) - np.log(total).sum())


def find_sizes(fit: Fit) -> UnknownForces:
    """Return what a fit lacks with its most likely sizes and common level, from the best of several starts."""
    unknown, own = fit.unknown, _integrate_out_parameters(fit)
    groups = len(unknown.groups)
    best, most = np.zeros(groups), -np.inf
    for start in STARTS:
        logs = np.full(groups, start)
        for _ in range(PASSES):
            mean, variance, _ = own.posterior(logs)
            step = sizes_step(mean, variance, own.group, logs, 2 / SIZE_SCATTER**2)
            before, logs = logs, np.clip(logs + step, LEVELS[0], LEVELS[-1])
            if np.abs(logs - before).max() < SETTLED:
                break
        likelihood = own.posterior(logs)[2] - float(np.sum((logs - logs.mean()) ** 2)) / SIZE_SCATTER**2
        if likelihood > most:
            best, most = logs, likelihood
    return replace(unknown, size=np.exp(best))


def sizes_step(
    mean: np.ndarray, variance: np.ndarray, group: np.ndarray, logs: np.ndarray, tightness: float
) -> np.ndarray:
    """Return MacKay's step of the logarithms of sizes (groups,) to more likely ones.

    mean, variance (n,): of the coefficients, over their sizes. group (n,): of each. tightness: pull of the logarithms
    towards their mean.
    """
    square = np.bincount(group, mean**2, len(logs))
    determined = np.bincount(group, 1 - variance, len(logs))
    slope = square - determined - tightness * (logs - logs.mean())
    return np.asarray(np.clip(slope / (2 * determined + square + tightness), -0.7, 0.7))


def _integrate_out_parameters(fit: Fit) -> _Coefficients:
    """Return the coefficients' quadratic form with base parameters and offsets integrated out."""
    n, count, group = len(fit.X), fit.unknown.count, np.zeros(fit.unknown.count, int)
    for k, own in enumerate(fit.unknown.groups):
        group[own.every] = k
    inner = np.arange(n, n + count)
    outer = np.delete(np.arange(len(fit.information)), inner)
    cross = fit.information[np.ix_(outer, inner)]
    solved = np.linalg.solve(fit.information[np.ix_(outer, outer)], np.column_stack([cross, fit.right_side[outer]]))
    information = fit.information[np.ix_(inner, inner)] - np.diag(fit.unknown.precision) - cross.T @ solved[:, :-1]
    return _Coefficients(_positive_part(information), fit.right_side[inner] - cross.T @ solved[:, -1], group)


def white_noise_ratios(fit: Fit) -> np.ndarray:
    """Return the mean square of each white error, torques then forces with a size, over what a right model leaves."""
    found, expected = np.zeros((2, len(fit.linear[0].acting)))
    for log, trajectory in zip(fit.linear, fit.trajectories, strict=True):
        error = np.concatenate([trajectory.torque_error, trajectory.force_error], axis=1)[:, log.acting] / log.noise
        found += np.sum(error**2, axis=0)
        expected += expected_squares(log)
    return np.asarray(found / np.maximum(expected, np.finfo(float).tiny))
