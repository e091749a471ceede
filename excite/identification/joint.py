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
from excite.identification.estimate import UNMOVED, Estimate, held_note
from excite.logs import Log, decimate, derivative
from excite.model import Model
from excite.model.machine import Filter
from excite.smoothing import (
    UNSEEN,
    Chart,
    Fit,
    NotConverged,
    Point,
    Record,
    chart,
    common_sensors,
    first_point,
    innovation_sizes,
    iterate,
    noise_notes,
    record,
    smoothed,
    sure,
)

TOLERABLE = 0.1  # a step, in standard deviations, at which a fit that runs out of passes is an estimate
# Disturbing forces where the model is not trusted, larger until the innovations are what they should be.
DISTURBED = (1.0, 4.0, 16.0)
SUSPECT = 2.5  # mean square of innovations, all or slow ones, that the model can't explain; null logs stay below 1.6
DOUBT = (
    "the log shows something that the model doesn't know, so the intervals do not hold: these values allow for"
    " disturbing forces, and may be off by more than their intervals, much more where the cause is no such force (a"
    " sensor, a torque channel); run `excite diagnose`"
)
DRAWN = (
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
    c = chart(model, common_sensors(model, logs))
    records = [record(c, log, unbiased=True) for log in logs]
    steady = [replace(r, unbiased=False) for r in records]
    starts = [first_point(c, r, log, filter) for r, log in zip(records, logs, strict=True)]
    notes = noise_notes(c, records)
    held = identifiability.unmoved(model, logs, filter, slow=False)

    def ways() -> Iterator[tuple[np.ndarray, bool]]:
        yield held, False
        still = held | identifiability.unmoved(model, logs, filter, slow=True)
        less = (still & ~held).any()
        if less:
            yield still, False
        # The model with disturbing forces finds its way from further off.
        yield held, True
        if less:
            yield still, True

    trouble: NotConverged | None = None
    loose: Fit | None = None
    doubted: tuple[tuple[bool, float], Fit, np.ndarray, list[str]] | None = None
    for free, further in ways():
        try:
            if further:
                loose = loosely(c, logs, steady, starts, model.nominal, starts, free)
            points, X = (starts, model.nominal) if loose is None else (loose.points, loose.X)
            fit, drawn = _exact(c, records, steady, points, X, starts, free)
        except NotConverged as failed:
            trouble = trouble or failed
            continue
        found = suspects(c, logs, fit)
        if not found:
            if drawn:
                return _estimate(c, records, fit, filter, (*notes, *drawn))
            fit, sides, flat = sure(c, records, starts, fit)
            return _estimate(c, records, fit, filter, (*notes, *flat), sides)
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
            loose = loosely(c, logs, steady, fit.points, fit.X, starts, free)
        except NotConverged as failed:
            trouble = failed
    if loose is None:
        assert trouble is not None
        raise trouble
    return _estimate(c, records, loose, filter, (*notes, said, DOUBT))


def _exact(
    c: Chart,
    records: Sequence[Record],
    steady: Sequence[Record],
    points: Sequence[Point],
    X: np.ndarray,
    starts: Sequence[Point],
    held: np.ndarray,
) -> tuple[Fit, tuple[str, ...]]:
    """The fit with exact dynamics, unbiased where the log determines it, and what to say of it. Raises NotConverged."""
    trouble: NotConverged | None = None
    for own, said in ((records, ()), (steady, (DRAWN,))):
        try:
            return iterate(c, own, points, X, starts, 0.0, held), said
        except NotConverged as failed:
            if failed.fit is not None and failed.step < TOLERABLE:
                return failed.fit, said
            trouble = trouble or failed
    assert trouble is not None
    raise trouble


def loosely(
    c: Chart,
    logs: Sequence[Log],
    records: Sequence[Record],
    points: Sequence[Point],
    X: np.ndarray,
    starts: Sequence[Point],
    held: np.ndarray,
) -> Fit:
    """The fit with disturbing forces as large as the innovations ask for. Raises NotConverged."""
    trouble: NotConverged | None = None
    fit: Fit | None = None
    for times in DISTURBED:
        try:
            fit = iterate(c, records, points, X, starts, times, held)
        except NotConverged as failed:
            trouble = failed
            continue
        if not suspects(c, logs, fit):
            return fit
        points, X = fit.points, fit.X
    if fit is None:
        assert trouble is not None
        raise trouble
    return fit


def _estimate(
    c: Chart,
    records: Sequence[Record],
    fit: Fit,
    filter: Filter,
    notes: tuple[str, ...],
    sides: np.ndarray | None = None,
) -> Estimate:
    """The answer as `identify` gives it: regressor along the smoothed states, residual of the torques."""
    model = c.model
    weak = fit.unseen | (fit.std > UNSEEN * np.maximum(np.abs(fit.X), model.scale))
    if weak.all():
        raise NotIdentifiableError(UNMOVED)
    if fit.unseen.any():
        held = [n for n, yes in zip(model.base.names, fit.unseen, strict=True) if yes]
        notes = (*notes, held_note(held))
    reasons = {
        name: "this log hardly moves with it: what is known of it is the machine file's value"
        for name, yes in zip(model.base.names, weak, strict=True)
        if yes
    }
    W, Y, errors = [], [], []
    for r, p in zip(records, fit.points, strict=True):
        q, nu, z, u, a = smoothed(c, r, p, fit.X)
        beside = () if model.plain else (u.T, z.T)
        forced = fit.disturbed > 0 and model.plain
        if forced:  # what the forces do is not the model's
            a = derivative(nu.T, float(model.machine.sampling_hz)).T
        rows = model.stacked(q.T, nu.T, a.T, *beside)
        W.append(rows.reshape(-1, len(fit.X)))
        measured, error = np.zeros((2, len(model.rows), len(u)))
        measured[list(model.actuated)], error[list(model.actuated)] = r.torque.T, -p.errors.T
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
        int(sum(r.used.sum() for r in records)) - len(fit.X),
        reasons,
        notes,
        sides=None if sides is None else np.where(weak, np.nan, sides),
    )


def suspects(c: Chart, logs: Sequence[Log], fit: Fit) -> list[str]:
    """Sensors whose innovations are not what the model and their noise say, each as a line for the report."""
    texts = []
    for log, linear in zip(logs, fit.linear, strict=True):
        for sensor, (size, slow, blocks) in zip(c.sensors, innovation_sizes(linear), strict=True):
            if max(size, slow) > max(SUSPECT, 1 + 6 * np.sqrt(2 / max(blocks, 1.0))):
                texts.append(
                    f"{log.source}: {sensor.name}: innovations are {np.sqrt(size):.2f} times, slow ones"
                    f" {np.sqrt(slow):.2f} times what noise gives"
                )
    return texts
