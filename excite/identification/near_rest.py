"""Rows of a regression in which a joint is at or near rest.

A joint with dry friction sticks: its friction then takes any value between -Fs and Fs, whatever the regressor says, and
the sign of a slow speed is that of noise. Such rows are left out, as far as the low-pass before the decimation spreads
them (M. Gautier, "Dynamic identification of robots with power model", ICRA 1997, sorts them out likewise).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from excite.logs import Log, kept_samples, samples
from excite.model import Model
from excite.model.machine import Filter

SLOW_SHARE = 0.01  # of a joint's fast speed (its 99 % quantile), below which it is near rest; chosen
SATURATION = 3.0  # tanh(3) = 0.995: how far friction has its full size where a joint is no longer near rest
EDGE = 2  # samples to both sides of a joint near rest that count as near rest, too; chosen
REACH = 3  # kept rows to both sides that the decimation's low-pass spreads a row over; chosen


def moving_rows(model: Model, log: Log, filter: Filter) -> np.ndarray:
    """Find the rows (n_rows, n) of a filtered log that are not those of a joint near rest."""
    motion = samples(model, log, filter)
    slow = slow_samples(model, motion.nu)
    last = slow.shape[1] - filter.drop[1]
    kept = kept_samples(filter.drop[0], last, filter.decimation)
    reach = 2 * REACH * filter.decimation + 1 if filter.decimation > 1 else 1
    return np.asarray(~scipy.ndimage.maximum_filter1d(slow, reach, axis=1)[:, kept])


def slow_samples(model: Model, nu: np.ndarray) -> np.ndarray:
    """Find the samples (n_q, N) at which a joint with dry friction is near rest, from velocities nu (n_q, N)."""
    slow = np.zeros(nu.shape, bool)
    for body in model.machine.body:
        if body.friction is None or body.coordinates[0] not in model.coordinates:
            continue
        k = model.coordinates.index(body.coordinates[0])
        speed = np.abs(nu[k])
        slow[k] = speed < SLOW_SHARE * np.quantile(speed, 0.99)
    return slow


def with_soft_friction(model: Model, logs: Sequence[Log], filter: Filter) -> Model:
    """Widen the change of the friction's sign to speeds near rest, where the model is none of friction that sticks."""
    fast = np.max([np.quantile(np.abs(samples(model, log, filter).nu), 0.99, axis=1) for log in logs], axis=0)
    bodies = []
    for body in model.machine.body:
        width = 0.0
        if body.friction is not None and body.coordinates[0] in model.coordinates:
            width = SLOW_SHARE * float(fast[model.coordinates.index(body.coordinates[0])]) / SATURATION
        if body.friction is not None and width > float(body.friction.smoothing):
            smoothing = body.friction.smoothing.model_copy(update={"value": width})
            body = body.model_copy(update={"friction": body.friction.model_copy(update={"smoothing": smoothing})})
        bodies.append(body)
    return model.for_machine(model.machine.model_copy(update={"body": tuple(bodies)}))


def friction_near_rest(model: Model, log: Log, filter: Filter) -> np.ndarray:
    """Standard deviation (N - 1, n_u) [N m] of the friction of joints near rest: Fs, which may have either sign."""
    slow = slow_samples(model, samples(model, log, filter).nu)
    slow = scipy.ndimage.maximum_filter1d(slow, 2 * EDGE + 1, axis=1)
    size = np.zeros((slow.shape[1] - 1, len(model.inputs)))
    for k, (row, body) in enumerate(zip(model.actuated, model.machine.actuated, strict=True)):
        if body.friction is not None:
            size[:, k] = float(body.friction.Fs) * (slow[row, 1:] | slow[row, :-1])
    return size


def sticking(model: Model, logs: Sequence[Log], filter: Filter) -> tuple[Model, list[np.ndarray]] | None:
    """Return what joints need that stick, |U| < Fs, and so have any friction in between; None without such rests.

    The model with soft friction near rest, and the size of free friction there, `friction_near_rest` of each log.
    """
    size = [friction_near_rest(model, log, filter) for log in logs]
    return (with_soft_friction(model, logs, filter), size) if any(x.any() for x in size) else None
