"""Uncertainty of joint smoothing beyond the inverse of the information.

Two corrections: an encoder's errors follow from the motion and the start of its count, and are not white
(`encoder_error_moments`). And for a poorly excited direction the likelihood is not parabolic, so its profile is
computed on both sides (`profile_widths`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from excite.smoothing.innovations import LinearisedLog
from excite.smoothing.linearisation import StateSpace
from excite.smoothing.log_fit import (
    Fit,
    NotConvergedError,
    apply_step,
    covariance_in_si,
    linearise_logs,
    newton_step,
)
from excite.smoothing.measurements import Measurements, Trajectory, predict_readings

PHASE_COUNT = 64  # starts of an encoder's count, between two edges, over which errors are averaged; chosen
COLUMNS_AT_A_TIME = 8  # parameters whose state sensitivities are in memory at a time; chosen
MIN_PROFILED_STD = 0.03  # relative standard deviation above which the profile is computed; chosen
PROFILE_DISTANCE = 2.0  # of the two profile points [standard deviations], near the ends of a 95 % interval
MIN_SIDE = 0.5  # bounds of a one-sided standard deviation, relative to the symmetric one; chosen
MAX_SIDE = 4.0
FLAT_NOTE = (
    "the likelihood of {} is nearly flat on one side, so their intervals are lower bounds: record a drive that excites"
    " these parameters more"
)
NEAR_ZERO_STDS = 0.1  # distance above zero of a parameter that may be at its bound [standard deviations]; chosen
NAMED_SHARE = 0.5  # of the largest share in a combination, from which a parameter is named; chosen


def quantify_uncertainty(
    space: StateSpace, measurements: Sequence[Measurements], starts: Sequence[Trajectory], fit: Fit
) -> tuple[Fit, np.ndarray, tuple[str, ...]]:
    """Return a fit with its corrected covariance, one-sided standard deviations (2, n_base) [SI], and notes.

    fit: with exact dynamics. The one-sided standard deviations are those below and above the estimate.
    """
    linear = linearise_logs(space, measurements, fit.trajectories, starts, fit.X)
    fit = fit if linear is None else replace(fit, linear=tuple(linear))  # so far it was linearised one step before
    n = len(fit.X)
    none_fixed = np.zeros(n, bool)
    covariance, (step, *_), cost = newton_step(
        space, measurements, fit.linear, fit.trajectories, fit.X, fit.prior, none_fixed
    )
    at_bounds = at_bound(space, fit, covariance, step)
    conditional = covariance
    if at_bounds.any():
        conditional, _, cost = newton_step(
            space, measurements, fit.linear, fit.trajectories, fit.X, fit.prior, at_bounds
        )
    excess = np.zeros_like(covariance)
    for data, trajectory, log, columns in zip(measurements, fit.trajectories, fit.linear, fit.indices, strict=True):
        encoder, white = encoder_error_moments(space, data, trajectory, fit.X, log)
        excess[np.ix_(columns, columns)] += encoder - white
    sandwich = covariance + covariance @ excess @ covariance
    direction = least_certain_direction(space, fit, conditional)
    below, above = profile_widths(
        space, measurements, starts, replace(fit, cost=cost), conditional, direction, at_bounds
    )
    sigma_step, sandwich = (
        one_sigma_step(sandwich, direction)[:n] * space.model.scale,
        covariance_in_si(space, sandwich),
    )
    widening = np.array([below**2, above**2]) - 1
    one_sided = np.diag(sandwich) + np.where(sigma_step > 0, widening[:, None], widening[::-1, None]) * sigma_step**2
    widened = sandwich + (((below + above) / 2) ** 2 - 1) * np.outer(sigma_step, sigma_step)
    notes: tuple[str, ...] = ()
    if max(below, above) >= MAX_SIDE:
        share = np.abs(sigma_step) / np.maximum(np.abs(fit.X), space.model.scale)
        named = [name for name, x in zip(space.model.base.names, share, strict=True) if x > NAMED_SHARE * share.max()]
        notes = (FLAT_NOTE.format(", ".join(named)),)
    return replace(fit, covariance=widened), np.sqrt(one_sided), notes


def encoder_error_moments(
    space: StateSpace, data: Measurements, trajectory: Trajectory, X: np.ndarray, linear: LinearisedLog
) -> tuple[np.ndarray, np.ndarray]:
    """Second moments (n_p + n_o, n_p + n_o), scaled, that encoder errors give the slope of a log's cost.

    Returns the moments of the actual errors along the smoothed motion, averaged over the start of the count, and those
    of white noise of the same size. The estimate's covariance is covariance + covariance @ (actual - white) @
    covariance (sandwich of White, Econometrica 48 (1980) 817). A repeated motion repeats these errors, so they affect
    an estimate more than white noise on one drive and less on another.
    """
    sample = 1 / float(space.model.machine.sampling_hz)
    u = space.delivered_torques(data.torque, X)[0] + trajectory.sampled_torque_error
    weight = predict_readings(space, replace(data, used=np.ones_like(data.used)), trajectory, u, X)[2]
    angle, _, rate, *_ = space.readings(trajectory.state, space.inputs(u, trajectory.ground_inputs), X)
    encoders = np.flatnonzero(data.read_at_edges)
    count_size = data.noise.sensor[encoders]
    sensitivities = _reading_sensitivities(linear, space.reading_parameters, encoders)
    encoder, white = np.zeros((2, sensitivities.shape[2], sensitivities.shape[2]))
    phases = (np.arange(PHASE_COUNT)[:, None] + 0.5) / PHASE_COUNT
    for k, j in enumerate(encoders):
        travel = np.clip(rate[:, j, 0] * sample / count_size[k], -1, 1)
        phase = angle[:, j, 0] / count_size[k] - phases
        count = np.floor(phase)
        change = np.diff(count, axis=1, prepend=count[:, :1])
        error = np.where(change != 0, count + (change < 0) - phase + travel / 2, 0.0) * count_size[k]
        slope = (error * weight[:, j]) @ sensitivities[:, k]
        encoder += slope.T @ slope / PHASE_COUNT
        variance = data.used[:, j] * (weight[:, j] * count_size[k] * travel) ** 2 / 12
        white += sensitivities[:, k].T @ (sensitivities[:, k] * variance[:, None])
    return encoder, white


def _reading_sensitivities(
    linear: LinearisedLog, reading_parameters: tuple[int, ...], sensors: np.ndarray
) -> np.ndarray:
    """Slopes of some sensors' readings by parameters and offsets (N, k, n_p + n_o), along the most likely states.

    Single precision.
    """
    N, _, n_o = linear.direct.shape
    n_o -= len(reading_parameters)
    count = linear.drive.shape[2] - 1
    sensitivities = np.empty((N, len(sensors), count), np.float32)
    H = linear.H[:, sensors]
    for k in range(0, count, COLUMNS_AT_A_TIME):
        sensitivities[:, :, k : k + COLUMNS_AT_A_TIME] = H @ linear.state_slopes(slice(k, k + COLUMNS_AT_A_TIME))
    direct_columns = [*reading_parameters, *range(count - n_o, count)]
    sensitivities[:, :, direct_columns] += linear.direct[:, sensors]
    return sensitivities


def at_bound(space: StateSpace, fit: Fit, covariance: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Find positive parameters (n_base,) near zero whose likelihood is highest below zero.

    The likelihood of the other parameters is then computed with these fixed.
    """
    n, relative = len(fit.X), fit.X / space.model.scale
    near_zero = relative < NEAR_ZERO_STDS * np.sqrt(np.diag(covariance)[:n])
    return np.asarray(space.model.positive & ~fit.unidentifiable & near_zero & (relative + step[:n] < 0))


def least_certain_direction(space: StateSpace, fit: Fit, covariance: np.ndarray) -> np.ndarray:
    """Return the combination of parameters (n_p + offsets,) with the largest relative standard deviation, zero if
    small."""
    n = len(fit.X)
    value = np.abs(fit.X) / space.model.scale
    size = np.maximum(value, 1.0)
    span = np.where(space.model.positive, value, size)
    # A positive parameter that may be zero cannot be profiled.
    free = ~fit.unidentifiable & (np.sqrt(np.diag(covariance)[:n]) < span / PROFILE_DISTANCE)
    relative = np.where(np.outer(free, free), covariance[:n, :n] / np.outer(size, size), 0.0)
    variances, directions = np.linalg.eigh(relative)
    direction = np.zeros(len(covariance))
    if variances[-1] > MIN_PROFILED_STD**2:
        direction[:n] = directions[:, -1] / size
    return direction


def one_sigma_step(covariance: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the step of all parameters that moves a combination of them by one standard deviation; zero if it is
    zero."""
    return np.asarray(covariance @ direction / np.sqrt(max(direction @ covariance @ direction, np.finfo(float).tiny)))


def profile_widths(
    space: StateSpace,
    measurements: Sequence[Measurements],
    starts: Sequence[Trajectory],
    fit: Fit,
    covariance: np.ndarray,
    direction: np.ndarray,
    at_bounds: np.ndarray,
) -> tuple[float, float]:
    """Widths of the profile likelihood of a combination of parameters below and above, in standard deviations at the
    fit.

    One linearisation on each side gives the widths to a few hundredths. at_bounds (n_base,): parameters that stay
    fixed. Returns 1 and 1 for a zero direction, or if the motion cannot be computed there. Source: Venzon and
    Moolgavkar, Applied Statistics 37 (1988) 87.
    """
    if not direction.any():
        return 1.0, 1.0
    n = len(fit.X)
    step = one_sigma_step(covariance, direction)
    widths = []
    for distance in (-PROFILE_DISTANCE, PROFILE_DISTANCE):
        X = fit.X + distance * step[:n] * space.model.scale
        if not (X[space.model.positive] > 0).all():
            return 1.0, 1.0
        trajectories = [
            apply_step(space, data, trajectory, log, distance * step[columns], X)
            for data, trajectory, log, columns in zip(
                measurements, fit.trajectories, fit.linear, fit.indices, strict=True
            )
        ]
        linear = linearise_logs(space, measurements, trajectories, starts, X)
        if linear is None:
            return 1.0, 1.0
        try:
            conditional, steps, cost = newton_step(space, measurements, linear, trajectories, X, fit.prior, at_bounds)
        except (NotConvergedError, np.linalg.LinAlgError):
            return 1.0, 1.0
        if not np.isfinite(cost):
            return 1.0, 1.0
        overshoot = direction[:n] @ steps[0][:n]  # distance of the most likely point from this one
        rise = cost + overshoot**2 / (direction @ conditional @ direction) - fit.cost
        widths.append(float(np.clip(PROFILE_DISTANCE / np.sqrt(max(rise, 1e-9)), MIN_SIDE, MAX_SIDE)))
    return widths[0], widths[1]
