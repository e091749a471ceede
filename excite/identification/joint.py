"""Joint smoothing: states, true torques and parameters of logs estimated together (errors in variables).

Maximum likelihood: the dynamics hold exactly between samples, delivered torques are linear between samples and differ
from the measured ones by white noise and an offset, and every sensor has its own noise. `excite.smoothing` finds the
maximum and its uncertainty. Source: Bryson and Ho, "Applied Optimal Control", ch. 13 (smoothing as a two-point
boundary value problem).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from excite.errors import NotIdentifiableError
from excite.identification import identifiability
from excite.identification.combinations import describe_combinations
from excite.identification.estimate import NOTHING_MOVES_MESSAGE, Estimate, held_note
from excite.identification.near_rest import friction_near_rest, sticking
from excite.logs import Log, decimate, derivative
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import outside_law
from excite.smoothing import (
    MAX_IDENTIFIABLE_STD,
    Fit,
    Measurements,
    NotConvergedError,
    StateSpace,
    Trajectory,
    build_state_space,
    common_sensors,
    describe_noise,
    fit_logs,
    innovation_statistics,
    prepare_logs,
    quantify_uncertainty,
    smoothed_motion,
)
from excite.text import format_number

# Largest step of an estimate whose iteration ran out of passes [standard deviations]; chosen.
ACCEPTED_STEP = 0.1
# Levels of process noise, tried in turn until the innovations are as expected; chosen.
PROCESS_NOISE_LEVELS = (1.0, 4.0, 16.0)
# Mean square of a sensor's normalised innovations that the model does not explain. Logs without a cause stay below 1.6.
SUSPECT_MEAN_SQUARE = 2.5
UNEXPLAINED_DOUBT = (
    "the model does not explain this log: the values allow for process noise, and may be off by much more than their"
    " intervals if the cause is a sensor or a torque channel; run `excite diagnose`"
)
STICKING_RATIO = 2.0  # mean square of torque errors near rest over that in motion, above which friction sticks; chosen
MIN_STICKING_SAMPLES = 30  # near rest, to tell whether friction sticks; chosen
BIASED_NOTE = (
    "parameters that this log excites poorly may be off by one standard deviation more than their interval says, as"
    " only a biased estimate was found: record a drive with more motion"
)


def joint(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate the base parameters by joint smoothing of all logs, from the machine file's values.

    Encoders that beat with the clock keep their weight, which keeps the estimate unbiased; the standard deviations
    account for the beats. If no unbiased fit is found, a slightly biased one is returned with a note. If the
    innovations show that the model does not explain a log, or exact dynamics give no fit, friction may stick (see
    `_fit_sticking`); if that does not explain it either, the model gets as much process noise as needed, and a note.

    Raises NotConvergedError if that fails too, NotIdentifiableError if a torque is missing.
    """
    space = build_state_space(model, common_sensors(model, logs))
    measurements, starts = prepare_logs(space, logs, filter, unbiased=True)
    weighted = [replace(data, unbiased=False) for data in measurements]
    notes = describe_noise(space, measurements)
    held = identifiability.parameters_at_rest(model, logs, filter, slow=False)

    def ways() -> Iterator[tuple[np.ndarray, bool]]:
        yield held, False
        held_if_slow = held | identifiability.parameters_at_rest(model, logs, filter, slow=True)
        differs = (held_if_slow & ~held).any()
        if differs:
            yield held_if_slow, False
        # With process noise the iteration converges from further away.
        yield held, True
        if differs:
            yield held_if_slow, True

    stuck: Estimate | None = None
    failure: NotConvergedError | None = None
    noisy_fit: Fit | None = None
    suspect_fit: tuple[tuple[bool, float], Fit, np.ndarray, list[str]] | None = None
    for held_now, with_noise in ways():
        try:
            if with_noise:
                noisy_fit = fit_with_process_noise(space, logs, weighted, starts, model.nominal, starts, held_now)
            trajectories, X = (starts, model.nominal) if noisy_fit is None else (noisy_fit.trajectories, noisy_fit.X)
            fit, bias_notes = _fit_exact(space, measurements, weighted, trajectories, X, starts, held_now)
        except NotConvergedError as failed:
            if failure is None and (stuck := _fit_sticking(model, logs, filter, held_now)):
                return stuck
            failure = failure or failed
            continue
        suspects = find_suspect_sensors(space, logs, fit)
        sticks = bool(suspects) or shows_sticking(model, logs, filter, fit)
        if sticks and failure is None and (stuck := _fit_sticking(model, logs, filter, held_now)):
            return stuck
        if not suspects:
            if bias_notes:
                return _build_estimate(space, measurements, fit, filter, (*notes, *bias_notes))
            fit, one_sided, flat_notes = quantify_uncertainty(space, measurements, starts, fit)
            return _build_estimate(space, measurements, fit, filter, (*notes, *flat_notes), one_sided)
        rank = bool(bias_notes), fit.cost  # only costs of the same measurements are comparable
        if suspect_fit is None or rank < suspect_fit[0]:
            suspect_fit = rank, fit, held_now, suspects
        if held_now is held:
            break  # no parameter was held, so the model is the cause
    reason = str(failure)
    if suspect_fit is not None:
        _, fit, held_now, suspects = suspect_fit
        reason = "; ".join(suspects)
        try:
            noisy_fit = fit_with_process_noise(space, logs, weighted, fit.trajectories, fit.X, starts, held_now)
        except NotConvergedError as failed:
            failure = failed
    if noisy_fit is None:
        assert failure is not None
        raise failure
    estimate = _build_estimate(space, measurements, noisy_fit, filter, (*notes, reason))
    return replace(estimate, doubt=UNEXPLAINED_DOUBT)


def shows_sticking(model: Model, logs: Sequence[Log], filter: Filter, fit: Fit) -> bool:
    """Tell if torque errors of joints near rest are larger than those in motion."""
    near, moving = list[float](), list[float]()
    for log, trajectory, linear in zip(logs, fit.trajectories, fit.linear, strict=True):
        slow = friction_near_rest(model, log, filter) > 0
        square = (trajectory.torque_error / linear.noise) ** 2
        near += square[slow].tolist()
        moving += square[~slow].tolist()
    if min(len(near), len(moving)) < MIN_STICKING_SAMPLES:
        return False
    return float(np.mean(near)) > STICKING_RATIO * float(np.mean(moving))


def _fit_sticking(model: Model, logs: Sequence[Log], filter: Filter, held: np.ndarray) -> Estimate | None:
    """Fit with friction of either sign near rest; None if the logs have no rest or are not explained by it."""
    rests = sticking(model, logs, filter)
    if rests is None:
        return None
    soft, extra = rests
    space = build_state_space(soft, common_sensors(soft, logs))
    measurements, starts = prepare_logs(space, logs, filter, unbiased=True, extra_torque_noise=extra)
    weighted = [replace(data, unbiased=False) for data in measurements]
    try:
        fit, bias_notes = _fit_exact(space, measurements, weighted, starts, model.nominal, starts, held)
        if find_suspect_sensors(space, logs, fit):
            return None
        fit, one_sided, flat_notes = quantify_uncertainty(space, measurements, starts, fit)
    except NotConvergedError:
        return None
    share = float(np.mean([np.mean(x > 0) for x in extra]))
    note = (
        f"friction sticks in this log: in the {format_number(100 * share, 2)} % of it in which a joint is near rest,"
        " the friction may have any value up to Fs"
    )
    notes = (*describe_noise(space, measurements), *bias_notes, *flat_notes, note)
    return _build_estimate(space, measurements, fit, filter, notes, one_sided)


def _fit_exact(
    space: StateSpace,
    measurements: Sequence[Measurements],
    weighted: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    starts: Sequence[Trajectory],
    held: np.ndarray,
) -> tuple[Fit, tuple[str, ...]]:
    """Fit with exact dynamics, unbiased if possible; return the fit and its notes. Raises NotConvergedError."""
    failure: NotConvergedError | None = None
    for chosen, notes in ((measurements, ()), (weighted, (BIASED_NOTE,))):
        try:
            return fit_logs(space, chosen, trajectories, X, starts, 0.0, held), notes
        except NotConvergedError as failed:
            if failed.fit is not None and failed.step < ACCEPTED_STEP:
                return failed.fit, notes
            failure = failure or failed
    assert failure is not None
    raise failure


def fit_with_process_noise(
    space: StateSpace,
    logs: Sequence[Log],
    measurements: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    starts: Sequence[Trajectory],
    held: np.ndarray,
) -> Fit:
    """Fit with the lowest level of process noise that explains the innovations. Raises NotConvergedError."""
    failure: NotConvergedError | None = None
    fit: Fit | None = None
    for level in PROCESS_NOISE_LEVELS:
        try:
            fit = fit_logs(space, measurements, trajectories, X, starts, level, held)
        except NotConvergedError as failed:
            failure = failed
            continue
        if not find_suspect_sensors(space, logs, fit):
            return fit
        trajectories, X = fit.trajectories, fit.X
    if fit is None:
        assert failure is not None
        raise failure
    return fit


def _build_estimate(
    space: StateSpace,
    measurements: Sequence[Measurements],
    fit: Fit,
    filter: Filter,
    notes: tuple[str, ...],
    one_sided: np.ndarray | None = None,
) -> Estimate:
    """Convert a fit to an Estimate: regressor along the smoothed states, torque residual."""
    model = space.model
    weak = fit.unidentifiable | (fit.std > MAX_IDENTIFIABLE_STD * np.maximum(np.abs(fit.X), model.scale))
    if weak.all():
        raise NotIdentifiableError(NOTHING_MOVES_MESSAGE)
    if fit.unidentifiable.any():
        held = [n for n, yes in zip(model.base.names, fit.unidentifiable, strict=True) if yes]
        notes = (*notes, held_note(held))
    W, Y, errors, outside = [], [], [], []
    for data, trajectory in zip(measurements, fit.trajectories, strict=True):
        q, nu, z, u, a = smoothed_motion(space, data, trajectory, fit.X)
        outside.append(outside_law(model, q, nu, fit.X))
        effect_inputs = () if model.plain else (u.T, z.T)
        plain_with_noise = fit.process_noise > 0 and model.plain
        if plain_with_noise:  # accelerations by process noise are not the model's
            a = derivative(nu.T, float(model.machine.sampling_hz)).T
        rows = model.stacked_regressor(q.T, nu.T, a.T, *effect_inputs)
        W.append(rows.reshape(-1, len(fit.X)))
        measured, error = np.zeros((2, len(model.rows), len(u)))
        measured[list(model.actuated)], error[list(model.actuated)] = data.torque.T, -trajectory.sampled_torque_error.T
        if plain_with_noise:
            error = measured - model.predict(q.T, nu.T, a.T, model.expand @ fit.X).full()
        Y.append(decimate(measured, filter.decimation))
        errors.append(decimate(error, filter.decimation))
    # Blocks that fit the cache are ten times faster than all rows at once.
    triangles = [np.linalg.qr(w, mode="r") for rows in W for w in np.array_split(rows, 40)]
    R: np.ndarray = np.asarray(np.linalg.qr(np.concatenate(triangles), mode="r"))
    names, units, free = model.base.names, model.base.units, np.flatnonzero(~fit.unidentifiable).tolist()
    reasons = {
        name: describe_combinations(R, model.scale, names, units, fit.X, fit.covariance, k, [j for j in free if j != k])
        for k, name in enumerate(names)
        if weak[k]
    }
    residual, size = np.concatenate(errors, axis=1), float(np.linalg.norm(np.concatenate(Y, axis=1)))
    covariance = fit.covariance.copy()
    covariance[weak], covariance[:, weak] = np.nan, np.nan
    return Estimate(
        "joint",
        model.base.names,
        model.base.units,
        np.where(weak, np.nan, fit.X),
        covariance,
        float(np.linalg.cond(R)),
        float(
            np.linalg.cond(
                R * np.maximum(np.abs(fit.X), [float(model.machine.scale.get(n, 0.0)) for n in model.base.names])
            )
        ),
        100 * float(np.linalg.norm(residual)) / size if size else np.nan,
        residual,
        int(sum(data.used.sum() for data in measurements)) - len(fit.X),
        reasons,
        notes,
        one_sided_std=None if one_sided is None else np.where(weak, np.nan, one_sided),
        share_outside_law=float(np.concatenate(outside).mean()),
    )


def find_suspect_sensors(space: StateSpace, logs: Sequence[Log], fit: Fit) -> list[str]:
    """List the sensors whose innovations the model and noise do not explain, one line each."""
    texts = []
    for log, linear in zip(logs, fit.linear, strict=True):
        for sensor, (size, slow, blocks) in zip(space.sensors, innovation_statistics(linear), strict=True):
            if max(size, slow) > max(SUSPECT_MEAN_SQUARE, 1 + 6 * np.sqrt(2 / max(blocks, 1.0))):
                texts.append(
                    f"{log.source}: {sensor.name}: innovations are {np.sqrt(size):.2f} times, slow ones"
                    f" {np.sqrt(slow):.2f} times what noise gives"
                )
    return texts
