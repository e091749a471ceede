"""Torques along the measured motion of a log, and what each effect would add to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from excite import identification
from excite.diagnosis.score_test import integrate_memory
from excite.logs import BLOCK, Log, decimate, kept_samples, samples
from excite.model import Model, signatures
from excite.model.effects import PlacedEffect
from excite.model.machine import Filter
from excite.simulation import measured_torque

STRETCHES = 20  # parts of each log from which variances and predictions are taken; chosen
BATCH = 64  # columns evaluated at a time


@dataclass(frozen=True, eq=False)
class TorqueRows:
    """Filtered, decimated rows of one log, and the motion that effects see.

    W (n_rows, n, n_base), Y (n_rows, n) [N m or N]; used (n_rows, n): rows that are not of joints near rest. at (n,):
    their samples. q, nu, a (N, n_q), t (N,) [s]: at the log's rate, with what effects of the model depend on, `beside`.
    """

    log: Log
    W: np.ndarray
    Y: np.ndarray
    used: np.ndarray
    at: np.ndarray
    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    t: np.ndarray
    beside: tuple[np.ndarray, ...]

    @property
    def stretch(self) -> np.ndarray:
        """Number (n,) of the stretch that a row belongs to."""
        n = self.Y.shape[1]
        return np.minimum(np.arange(n) * STRETCHES // n, STRETCHES - 1)


def torque_rows(model: Model, logs: Sequence[Log], filter: Filter) -> list[TorqueRows]:
    """Filter the rows of every log; raises NotIdentifiableError."""
    blocks = identification.filtered_blocks(model, logs, filter)
    moving = [identification.moving_rows(model, log, filter) for log in logs]
    rate, found = float(model.machine.sampling_hz), list[TorqueRows]()
    for log, (W, Y), used in zip(logs, blocks, moving, strict=True):
        s = samples(model, log, filter)
        last = s.q.shape[1] - filter.drop[1]
        at = kept_samples(filter.drop[0], last, filter.decimation)
        found.append(TorqueRows(log, W, Y, used, at, s.q.T, s.nu.T, s.a.T, np.arange(len(log)) / rate, s.beside))
    return found


def effect_columns(
    model: Model,
    rows: Sequence[TorqueRows],
    torques: Sequence[np.ndarray],
    placed: Sequence[PlacedEffect],
    X: np.ndarray,
    filter: Filter,
) -> list[np.ndarray]:
    """Return what each effect adds to the measured torques, (n_rows, n, C) for each log.

    torques (N, n_u): of each log, that effects see; not measured ones, which would explain themselves. X (n_base,):
    parameters without effects.
    """
    standard = tuple(n for n in model.base.standard if "@" not in n)
    p = (model.expand @ X)[[model.base.standard.index(n) for n in standard]]
    bare = model.machine.model_copy(update={"effect": ()})
    parts: list[list[np.ndarray]] = [[] for _ in rows]
    for first in range(0, len(placed), BATCH):
        batch = placed[first : first + BATCH]
        functions = signatures(bare, standard, batch)
        for r, u, own in zip(rows, torques, parts, strict=True):
            z = integrate_memory(functions, r.q, r.nu, u, r.t, p, np.zeros((len(r.t), functions.n_map_inputs)))
            sample = (r.q.T, r.nu.T, r.a.T, u.T, r.t[None], z.T, _readings(model, r), ca.DM(p))
            force = functions.force(*sample).full().reshape(r.q.shape[1], len(r.t), len(batch))
            first_row, last = filter.drop[0], len(r.t) - filter.drop[1]
            for c, e in enumerate(batch):
                if e.effect.channel is not None:
                    force[:, :, c] -= _reading_error(model, e, r.t, u)
            columns = -decimate(force[:, first_row:last], filter.decimation)
            if any(e.effect.reading is not None for e in batch):
                errors = functions.reading(*sample).full().reshape(-1, len(r.t), len(batch))
                for c, e in enumerate(batch):
                    if e.effect.reading is not None:
                        columns[:, :, c] += _torque_of_angle_error(model, r, errors[:, :, c], X, filter)
            own.append(columns)
    return [np.concatenate(own, axis=2) for own in parts]


def _readings(model: Model, r: TorqueRows) -> np.ndarray:
    """Return what the sensors read that are not of torque (n_sensors, N), zero for one that the log lacks."""
    read = [r.log.values.get(name, np.zeros(len(r.t))) for name in model.reading_names]
    return np.array(read).reshape(len(read), len(r.t))


def _torque_of_angle_error(model: Model, r: TorqueRows, error: np.ndarray, X: np.ndarray, filter: Filter) -> np.ndarray:
    """Return the torques [N m, N] that the true motion needs more (n_rows, n) than the measured one, to first order.

    error (n_sensors, N): of the sensors that are not of torque. It is filtered as the readings are.
    """
    off_by = dict(zip(model.reading_names, error, strict=True))
    values = {name: off_by.get(name, np.zeros(len(r.t))) for name in r.log.values}  # none in torques
    off = samples(model, Log("", r.t, values), filter)
    first, last = filter.drop[0], len(r.t) - filter.drop[1]
    moved = [decimate(x[:, first:last], filter.decimation) for x in (off.q, off.nu, off.a)]
    motion, p = (r.q[r.at].T, r.nu[r.at].T, r.a[r.at].T), model.expand @ X
    beside = [x[:, r.at] for x in r.beside]
    less, more = (
        model.predict(*(x + sign * d for x, d in zip(motion, moved, strict=True)), p, *beside).full()
        for sign in (-1, 1)
    )
    return np.asarray((less - more) / 2)


def needed_torques(model: Model, r: TorqueRows, X: np.ndarray) -> np.ndarray:
    """Return the torques (N, n_u) [N m or N] that a motion needs, without the offsets of their sensors."""
    found = []
    for first in range(0, len(r.t), BLOCK):
        at = slice(first, first + BLOCK)
        beside = [x[:, at] for x in r.beside]
        torque = model.predict(r.q[at].T, r.nu[at].T, r.a[at].T, model.expand @ X, *beside).full()
        found.append(torque[list(model.actuated)].T)
    return np.concatenate(found) - model.offsets @ X


def _reading_error(model: Model, e: PlacedEffect, t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return what a torque channel adds to the torques (n_q, N) that it reads.

    t (N,) [s]; u (N, n_u): torques.
    """
    channel = e.channel(t)
    more = np.zeros((len(model.coordinates), len(t)))
    for k, (row, body) in enumerate(zip(model.actuated, model.machine.actuated, strict=True)):
        if body.index in e.bodies:
            more[row] = measured_torque(t, u[:, k], *channel) - u[:, k]
    return more
