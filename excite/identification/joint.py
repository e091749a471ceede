"""Joint smoothing: states, true torques and parameters of logs estimated together (errors in variables).

Maximum likelihood: the dynamics hold exactly between samples, delivered torques are linear between samples and differ
from the measured ones by white noise and an offset, and every sensor has its own noise. `excite.smoothing` finds the
maximum and its uncertainty. Source: Bryson and Ho, "Applied Optimal Control", ch. 13 (smoothing as a two-point
boundary value problem).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from excite.errors import NotIdentifiableError
from excite.identification import identifiability
from excite.identification.combinations import describe_combinations
from excite.identification.estimate import NOTHING_MOVES_MESSAGE, Discrepancy, Estimate, held_note
from excite.identification.near_rest import friction_near_rest, sticking
from excite.logs import Log, decimate, derivative
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import outside_law
from excite.smoothing import (
    ACCEPTABLE_STEP,
    MAX_IDENTIFIABLE_STD,
    Fit,
    Measurements,
    NotConvergedError,
    Settings,
    StateSpace,
    Trajectory,
    average_over_sizes,
    build_state_space,
    common_sensors,
    describe_missing,
    describe_noise,
    fit_logs,
    fit_unknown_forces,
    innovation_statistics,
    lacks_forces,
    prepare_logs,
    quantify_uncertainty,
    smoothed_motion,
)
from excite.text import format_number

LOST_COST_RATIO = 3.0  # cost over the number of readings above which exact dynamics are not followed any further
# Mean square of a sensor's normalised innovations that the model does not explain. Logs without a cause stay below 1.6.
SUSPECT_MEAN_SQUARE = 2.5
UNEXPLAINED_DOUBT = (
    "the model does not explain this log: the values allow for forces that it lacks, and may be off by more than their"
    " intervals if the cause is a sensor or a torque channel; run `excite diagnose`"
)
CLOSE_STEP = 0.5  # [standard deviations] next step of a fit that is close enough to the most likely values; chosen
STICKING_RATIO = 2.0  # mean square of torque errors near rest over that in motion, above which friction sticks; chosen
MIN_STICKING_SAMPLES = 30  # near rest, to tell whether friction sticks; chosen


class UnexplainedError(NotConvergedError):
    """The model alone does not explain the logs."""


def joint(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate the base parameters by joint smoothing of all logs, from the machine file's values.

    Encoders that beat with the clock keep their weight, which keeps the estimate unbiased; the standard deviations
    account for the beats. If the model does not explain the logs (see `joint_exactly`), forces that it lacks are
    estimated beside the parameters (see `joint_beside_forces`).

    Raises NotConvergedError if there is no motion to begin with, NotIdentifiableError if a torque is missing.
    """
    try:
        return joint_exactly(model, logs, filter)
    except UnexplainedError:
        return joint_beside_forces(model, logs, filter)


def joint_exactly(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate by joint smoothing if the model alone explains the logs.

    It does if no sensor's innovations are larger than noise and the marginal likelihood says that no force is lacking.
    If not, friction may stick (see `_fit_sticking`). Raises UnexplainedError if neither explains the logs.
    """
    space, measurements, starts, held = _prepare(model, logs, filter)
    fit = fit_logs(space, measurements, starts, model.nominal, starts, held, settings=_limited(measurements))
    close = fit.step <= CLOSE_STEP and not find_suspect_sensors(space, logs, fit)
    sticks = fit.status != "converged" or shows_sticking(model, logs, filter, fit)  # as far as one can tell
    if sticks and (stuck := _fit_sticking(model, logs, filter, held)):
        return stuck
    if not close or lacks_forces(space, measurements, starts, held, fit):
        raise UnexplainedError("the model alone does not explain the log")
    fit, one_sided, flat_notes = quantify_uncertainty(space, measurements, starts, fit)
    notes = (*describe_noise(space, measurements), *flat_notes)
    return _build_estimate(space, measurements, fit, filter, notes, one_sided)


def joint_beside_forces(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Estimate beside forces that the model lacks (`excite.smoothing.fit_unknown_forces`); a note tells their size.

    The estimate is doubtful; the next step of a fit that does not settle is in the doubt. Raises NotConvergedError.
    """
    space, measurements, starts, held = _prepare(model, logs, filter)
    notes = describe_noise(space, measurements)
    around = fit_unknown_forces(space, measurements, starts, held)
    found = around.fit if around.fit.linear else around.fit.required()
    missing = describe_missing(space, found.unknown, found.trajectories)
    if missing:
        parts = [f"{m.name.replace('_', ' ')} {format_number(m.rms, 2)} {m.unit}" for m in missing]
        notes = (*notes, f"what the model does not explain, rms along the logs: {'; '.join(parts)}")
    found = average_over_sizes(space, found)
    estimate = _build_estimate(space, around.measurements, found, filter, notes)
    stalled = (
        f"; no better values were found, yet the next step is {format_number(found.step, 2)} standard deviations long"
    )
    doubt = UNEXPLAINED_DOUBT + (stalled if found.step > ACCEPTABLE_STEP else "")
    discrepancy = tuple(Discrepancy(m.place, m.follows, m.rms, m.unit, m.scale) for m in missing)
    return replace(estimate, doubt=doubt, discrepancy=discrepancy)


def _limited(measurements: Sequence[Measurements]) -> Settings:
    """Return settings of a fit that is given up where it cannot explain the logs."""
    return Settings(cost_limit=LOST_COST_RATIO * sum(float(data.used.sum()) for data in measurements))


def _prepare(
    model: Model, logs: Sequence[Log], filter: Filter
) -> tuple[StateSpace, Sequence[Measurements], Sequence[Trajectory], np.ndarray]:
    """Return the state space, measurements, first trajectories, and parameters (n_base,) of what is at rest."""
    space = build_state_space(model, common_sensors(model, logs), bool(model.machine.contacts))
    measurements, starts = prepare_logs(space, logs, filter, unbiased=True)
    return space, measurements, starts, identifiability.parameters_at_rest(model, logs, filter, slow=False)


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
    fit = fit_logs(space, measurements, starts, model.nominal, starts, held, settings=_limited(measurements))
    if fit.step > CLOSE_STEP or find_suspect_sensors(space, logs, fit):
        return None
    fit, one_sided, flat_notes = quantify_uncertainty(space, measurements, starts, fit)
    share = float(np.mean([np.mean(x > 0) for x in extra]))
    note = (
        f"friction sticks in this log: in the {format_number(100 * share, 2)} % of it in which a joint is near rest,"
        " the friction may have any value up to Fs"
    )
    notes = (*describe_noise(space, measurements), *flat_notes, note)
    return _build_estimate(space, measurements, fit, filter, notes, one_sided)


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
        beside_forces = fit.unknown.count > 0
        if beside_forces:  # the model alone does not make these accelerations
            a = derivative(nu.T, float(model.machine.sampling_hz)).T
        rows = model.stacked_regressor(q.T, nu.T, a.T, *effect_inputs)
        W.append(rows.reshape(-1, len(fit.X)))
        measured, error = np.zeros((2, len(model.coordinates), len(u)))
        measured[list(model.actuated)], error[list(model.actuated)] = data.torque.T, -trajectory.sampled_torque_error.T
        if beside_forces and model.plain:
            error = measured - model.predict(q.T, nu.T, a.T, model.expand @ fit.X).full()
        Y.append(decimate(measured, filter.decimation))
        errors.append(decimate(error, filter.decimation))
    # Blocks that fit the cache are ten times faster than all rows at once.
    triangles = [np.linalg.qr(w, mode="r") for rows in W for w in np.array_split(rows, 40)]
    R: np.ndarray = np.asarray(np.linalg.qr(np.concatenate(triangles), mode="r"))
    own = [k for k, n in enumerate(model.base.names) if f"effect.{n}" not in model.known.quantities]  # no tolerances
    size_of_own = np.maximum(np.abs(fit.X), [float(model.machine.scale.get(n, 0.0)) for n in model.base.names])[own]
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
        float(np.linalg.cond(R[:, own])),
        float(np.linalg.cond(R[:, own] * size_of_own)),
        100 * float(np.linalg.norm(residual)) / size if size else np.nan,
        residual,
        int(sum(data.used.sum() for data in measurements)) - len(fit.X),
        reasons,
        notes,
        one_sided_std=None if one_sided is None else np.where(weak, np.nan, one_sided),
        share_outside_law=float(np.concatenate(outside).mean()),
        smoothed=() if fit.unknown.count else tuple((space, one) for one in fit.trajectories),
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
