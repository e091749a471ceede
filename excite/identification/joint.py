"""Joint smoothing: states, true torques and parameters of a log estimated together (errors in variables).

Maximum likelihood of everything at once: the machine's dynamics hold exactly between samples, the delivered torques are
linear between samples and differ from the measured ones by white noise and an offset, and every sensor has a noise of
its own. The answer is found by `newton`, how sure it is by `deviations`; with no measurement at all, along a motion
alone, the covariance is the Cramer-Rao bound. Source: Bryson and Ho, "Applied Optimal Control", ch. 13 (smoothing as a
two-point problem).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from excite.errors import NotIdentifiableError
from excite.identification import identifiability
from excite.identification.estimate import NOTHING_MOVES_MESSAGE, Estimate, held_note
from excite.logs import Log, decimate, derivative
from excite.model import Model
from excite.model.machine import Filter
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
    initial_trajectory,
    innovation_statistics,
    prepare_measurements,
    quantify_uncertainty,
    smoothed_motion,
)

ACCEPTED_STEP = 0.1  # a step, in standard deviations, at which a fit that runs out of passes is an estimate
# Disturbing forces where the model is not trusted, larger until the innovations are what they should be.
PROCESS_NOISE_LEVELS = (1.0, 4.0, 16.0)
SUSPECT_MEAN_SQUARE = (
    2.5  # mean square of innovations, all or slow ones, that the model can't explain; null logs stay below 1.6
)
UNEXPLAINED_NOTE = (
    "the log shows something that the model doesn't know, so the intervals do not hold: these values allow for"
    " disturbing forces, and may be off by more than their intervals, much more where the cause is no such force (a"
    " sensor, a torque channel); run `excite diagnose`"
)
BIASED_NOTE = (
    "what this log shows poorly may be off by a deviation more than its interval says, as no estimate without that bias"
    " was found: a drive that moves more tells more"
)


def joint(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Base parameters by joint smoothing of all logs, from the machine file's values.

    Encoders that beat with the clock weigh as others do, which keeps the estimate unbiased; its deviations count the
    beats (`deviations`). A log that tells too little for that has an estimate that is drawn in, with a note.
    Where the innovations say that the machine does something that the model doesn't know, or the exact dynamics find
    no estimate, the answer is that of a model with white disturbing forces, as large as it takes, with a note. Raises
    NotConverged where that fails too, NotIdentifiable where a torque is missing.
    """
    space = build_state_space(model, common_sensors(model, logs))
    measurements = [prepare_measurements(space, log, unbiased=True) for log in logs]
    steady = [replace(data, unbiased=False) for data in measurements]
    starts = [initial_trajectory(space, data, log, filter) for data, log in zip(measurements, logs, strict=True)]
    notes = describe_noise(space, measurements)
    held = identifiability.parameters_at_rest(model, logs, filter, slow=False)

    def ways() -> Iterator[tuple[np.ndarray, bool]]:
        yield held, False
        still = held | identifiability.parameters_at_rest(model, logs, filter, slow=True)
        less = (still & ~held).any()
        if less:
            yield still, False
        # The model with disturbing forces finds its way from further off.
        yield held, True
        if less:
            yield still, True

    trouble: NotConvergedError | None = None
    loose: Fit | None = None
    doubted: tuple[tuple[bool, float], Fit, np.ndarray, list[str]] | None = None
    for free, further in ways():
        try:
            if further:
                loose = fit_with_process_noise(space, logs, steady, starts, model.nominal, starts, free)
            trajectories, X = (starts, model.nominal) if loose is None else (loose.trajectories, loose.X)
            fit, drawn = _fit_exact(space, measurements, steady, trajectories, X, starts, free)
        except NotConvergedError as failed:
            trouble = trouble or failed
            continue
        found = find_suspect_sensors(space, logs, fit)
        if not found:
            if drawn:
                return _build_estimate(space, measurements, fit, filter, (*notes, *drawn))
            fit, sides, flat = quantify_uncertainty(space, measurements, starts, fit)
            return _build_estimate(space, measurements, fit, filter, (*notes, *flat), sides)
        rank = bool(drawn), fit.cost  # costs of one kind of records can be compared
        if doubted is None or rank < doubted[0]:
            doubted = rank, fit, free, found
        if free is held:
            break  # nothing was held back: it is the machine, not the way to it
    said = str(trouble)
    if doubted is not None:
        _, fit, free, found = doubted
        said = "; ".join(found)
        try:
            loose = fit_with_process_noise(space, logs, steady, fit.trajectories, fit.X, starts, free)
        except NotConvergedError as failed:
            trouble = failed
    if loose is None:
        assert trouble is not None
        raise trouble
    return _build_estimate(space, measurements, loose, filter, (*notes, said, UNEXPLAINED_NOTE))


def _fit_exact(
    space: StateSpace,
    measurements: Sequence[Measurements],
    steady: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    starts: Sequence[Trajectory],
    held: np.ndarray,
) -> tuple[Fit, tuple[str, ...]]:
    """The fit with exact dynamics, unbiased where the log determines it, and what to say of it. Raises NotConverged."""
    trouble: NotConvergedError | None = None
    for own, said in ((measurements, ()), (steady, (BIASED_NOTE,))):
        try:
            return fit_logs(space, own, trajectories, X, starts, 0.0, held), said
        except NotConvergedError as failed:
            if failed.fit is not None and failed.step < ACCEPTED_STEP:
                return failed.fit, said
            trouble = trouble or failed
    assert trouble is not None
    raise trouble


def fit_with_process_noise(
    space: StateSpace,
    logs: Sequence[Log],
    measurements: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    starts: Sequence[Trajectory],
    held: np.ndarray,
) -> Fit:
    """The fit with disturbing forces as large as the innovations ask for. Raises NotConverged."""
    trouble: NotConvergedError | None = None
    fit: Fit | None = None
    for times in PROCESS_NOISE_LEVELS:
        try:
            fit = fit_logs(space, measurements, trajectories, X, starts, times, held)
        except NotConvergedError as failed:
            trouble = failed
            continue
        if not find_suspect_sensors(space, logs, fit):
            return fit
        trajectories, X = fit.trajectories, fit.X
    if fit is None:
        assert trouble is not None
        raise trouble
    return fit


def _build_estimate(
    space: StateSpace,
    measurements: Sequence[Measurements],
    fit: Fit,
    filter: Filter,
    notes: tuple[str, ...],
    sides: np.ndarray | None = None,
) -> Estimate:
    """The answer as `identify` gives it: regressor along the smoothed states, residual of the torques."""
    model = space.model
    weak = fit.unidentifiable | (fit.std > MAX_IDENTIFIABLE_STD * np.maximum(np.abs(fit.X), model.scale))
    if weak.all():
        raise NotIdentifiableError(NOTHING_MOVES_MESSAGE)
    if fit.unidentifiable.any():
        held = [n for n, yes in zip(model.base.names, fit.unidentifiable, strict=True) if yes]
        notes = (*notes, held_note(held))
    reasons = {
        name: "this log hardly moves with it: what is known of it is the machine file's value"
        for name, yes in zip(model.base.names, weak, strict=True)
        if yes
    }
    W, Y, errors = [], [], []
    for data, trajectory in zip(measurements, fit.trajectories, strict=True):
        q, nu, z, u, a = smoothed_motion(space, data, trajectory, fit.X)
        beside = () if model.plain else (u.T, z.T)
        forced = fit.process_noise > 0 and model.plain
        if forced:  # what the forces do is not the model's
            a = derivative(nu.T, float(model.machine.sampling_hz)).T
        rows = model.stacked_regressor(q.T, nu.T, a.T, *beside)
        W.append(rows.reshape(-1, len(fit.X)))
        measured, error = np.zeros((2, len(model.rows), len(u)))
        measured[list(model.actuated)], error[list(model.actuated)] = data.torque.T, -trajectory.sampled_torque_error.T
        if forced:
            error = measured - (rows @ fit.X).T
        Y.append(decimate(measured, filter.decimation))
        errors.append(decimate(error, filter.decimation))
    # In blocks that fit the cache: ten times faster than all rows at once.
    R = np.linalg.qr(np.concatenate([np.linalg.qr(w, mode="r") for rows in W for w in np.array_split(rows, 40)]), "r")
    residual = np.concatenate(errors, axis=1)
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
        100 * float(np.linalg.norm(residual) / np.linalg.norm(np.concatenate(Y, axis=1))),
        residual,
        int(sum(data.used.sum() for data in measurements)) - len(fit.X),
        reasons,
        notes,
        sides=None if sides is None else np.where(weak, np.nan, sides),
    )


def find_suspect_sensors(space: StateSpace, logs: Sequence[Log], fit: Fit) -> list[str]:
    """Sensors whose innovations are not what the model and their noise say, each as a line for the report."""
    texts = []
    for log, linear in zip(logs, fit.linear, strict=True):
        for sensor, (size, slow, blocks) in zip(space.sensors, innovation_statistics(linear), strict=True):
            if max(size, slow) > max(SUSPECT_MEAN_SQUARE, 1 + 6 * np.sqrt(2 / max(blocks, 1.0))):
                texts.append(
                    f"{log.source}: {sensor.name}: innovations are {np.sqrt(size):.2f} times, slow ones"
                    f" {np.sqrt(slow):.2f} times what noise gives"
                )
    return texts
