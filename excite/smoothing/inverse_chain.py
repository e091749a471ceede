"""What a log says of a machine whose joints are all driven: torques along a smooth motion, and its encoders.

A reading of torque is the model's torque along the motion, the channel's discrepancy and noise. Rows of an interval are
averaged to a few slots, in which the model itself is averaged alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from excite.logs import Log
from excite.model import Model
from excite.model.machine import Sensor
from excite.smoothing.block_tridiagonal import Windows, windows
from excite.smoothing.linearisation import BatchedFunction
from excite.smoothing.motion_readings import Readings, Sight, StartPrior, look, start_prior
from excite.smoothing.splines import ORDER, WHITE, Knots, motion_basis, place, sampled_basis

SLOTS = 4  # averages of torque in an interval of the knots; the noise between them tells the rows' noise
CHUNK = 4000  # rows of torque that are linearised at once, for the memory's sake


@dataclass(frozen=True)
class Chain:
    """A log on its knots.

    prior (n,): the knots by joint, with the derivative that is white.
    sights, starts: by joint. t (N,): times of the rows; interval (N,), basis (N, 3, 6). torque (N, n) [N m]; used (N,
    n): 1 for rows in which a channel was read. beside: further arguments (N, k) of the model, for its effects.
    slot (S,): place interval * slots + number of each slot that has rows; first (S,): its first row.
    moved (n,): rows by which each channel has been moved ahead, as it is late.
    """

    knots: Knots
    prior: tuple[Knots, ...]
    sights: tuple[tuple[Sight, ...], ...]
    starts: tuple[StartPrior, ...]
    t: np.ndarray
    interval: np.ndarray
    basis: np.ndarray
    torque: np.ndarray
    used: np.ndarray
    beside: tuple[np.ndarray, ...]
    slots: int
    slot: np.ndarray
    first: np.ndarray
    moved: np.ndarray

    @cached_property
    def count(self) -> np.ndarray:
        """Number of readings (S, n) of each channel in the slots."""
        return np.asarray(np.add.reduceat(self.used, self.first, axis=0))

    def average(self, rows: np.ndarray) -> np.ndarray:
        """Average rows (N, n, ...) of the channels over the readings of each slot (S, n, ...)."""
        shape = (..., *(None for _ in rows.shape[2:]))
        if len(self.first) == len(rows):
            return rows * (self.used > 0)[shape]
        return np.add.reduceat(rows * self.used[shape], self.first, axis=0) / np.maximum(self.count, 1)[shape]

    def average_channel(self, rows: np.ndarray, channel: int) -> np.ndarray:
        """Average rows (N, k) over the readings of one channel in each slot (S, k)."""
        used = self.used[:, channel, None]
        if len(self.first) == len(rows):
            return rows * (used > 0)
        return np.add.reduceat(rows * used, self.first, axis=0) / np.maximum(self.count[:, channel, None], 1)

    def near(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the coefficients (K, 6, w) that act in each interval."""
        return np.asarray(coefficients[np.arange(self.knots.count)[:, None] + np.arange(ORDER)])

    def motion(self, coefficients: np.ndarray) -> np.ndarray:
        """Return q, q', q'' (N, 3, n) of the rows."""
        near = coefficients[self.interval[:, None] + np.arange(ORDER)]
        return np.asarray(np.matmul(self.basis, near[:, :, : self.torque.shape[1]]))

    def windows(self, width: int) -> Windows:
        """Return the windows of a chain with `width` unknowns per knot."""
        return windows(self.knots.count, ORDER, width)


@dataclass(frozen=True, eq=False)
class TorqueModel:
    """Functions of the model for many samples: see `model.predict`."""

    model: Model

    @property
    def channels(self) -> int:
        """Number of torque channels, that of the joints."""
        return len(self.model.coordinates)

    def _symbols(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        q, nu, a = self.model.symbols()
        X = ca.SX.sym("X", len(self.model.base.names))
        return [ca.vertcat(q, nu, a), *self.model.effect_symbols()], X, ca.mtimes(self._expand, X)

    @property
    def _expand(self) -> ca.DM:
        return ca.sparsify(ca.DM(self.model.expand))

    def _parts(self, motion: ca.SX) -> list[ca.SX]:
        n = self.channels
        return [motion[:n], motion[n : 2 * n], motion[2 * n :]]

    @cached_property
    def torque(self) -> BatchedFunction:
        """(motion, u, z, X) -> torques that the channels should read."""
        (motion, *beside), X, p = self._symbols()
        y = self.model.predict(*self._parts(motion), p, *beside)
        return BatchedFunction(ca.Function("torque", [motion, *beside, X], [y]), (1 + len(beside),))

    @cached_property
    def linear(self) -> BatchedFunction:
        """(motion, u, z, X) -> torques, their slopes by the motion (n, 3 n) and by the parameters (n, n_base)."""
        (motion, *beside), X, p = self._symbols()
        y = self.model.predict(*self._parts(motion), p, *beside)
        W = ca.mtimes(self.model.standard_regressor(*self._parts(motion), p, *beside), self._expand)
        outputs = [y, ca.jacobian(y, motion), W]
        return BatchedFunction(ca.Function("linear", [motion, *beside, X], outputs), (1 + len(beside),))

    @cached_property
    def contraction(self) -> BatchedFunction:
        """(motion, u, z, X, V) -> sum over channels k of the slope of their regressor along V (3 n, n)[:, k]."""
        (motion, *beside), X, p = self._symbols()
        W = ca.mtimes(self.model.standard_regressor(*self._parts(motion), p, *beside), self._expand)
        n = self.channels
        v = ca.SX.sym("v", 3 * n * n)
        V = ca.reshape(v, 3 * n, n)
        total = sum(ca.jtimes(W[k, :].T, motion, V[:, k]) for k in range(n))
        return BatchedFunction(ca.Function("contraction", [motion, *beside, X, v], [total]), (1 + len(beside),))

    def prediction(self, chain: Chain, motion: np.ndarray, X: np.ndarray) -> np.ndarray:
        """Return the torques (N, n) of the model along a motion (N, 3, n) of a chain's rows."""
        return self.torque(motion.reshape(len(motion), -1), *chain.beside, X)[0][:, :, 0]


def build_chain(
    model: Model,
    log: Log,
    readings: Sequence[Sequence[Readings]],
    knots: Knots,
    white: Sequence[int],
    beside: tuple[np.ndarray, ...] = (),
) -> Chain:
    """Put a log and its readings, by joint, on knots; white (n,): order of the derivative that is white noise."""
    sensors = torque_sensors(model)
    torque = np.column_stack([log.values[s.name] for s in sensors])
    used = np.column_stack([log.read_in(s.name) for s in sensors]).astype(float)
    interval, share = place(knots, log.t)
    first_row = np.searchsorted(interval, np.arange(knots.count))
    order = np.arange(len(log)) - first_row[interval]
    most = int(order.max()) + 1
    slots = min(most, SLOTS)
    number = order * slots // most
    slot = interval * slots + number
    first = np.flatnonzero(np.diff(slot, prepend=-1))
    prior = tuple(replace(knots, white=w) for w in white)
    curved = min(white) > min(WHITE)  # an acceleration whose slope is white noise has no curvature
    return Chain(
        knots,
        prior,
        tuple(look(knots, own) for own in readings),
        tuple(start_prior(own, k) for own, k in zip(readings, prior, strict=True)),
        log.t,
        interval,
        sampled_basis(knots, share, float(log.t[1] - log.t[0])) if curved else motion_basis(knots, share),
        torque,
        used,
        beside,
        slots,
        slot[first],
        first,
        np.zeros(torque.shape[1], int),
    )


def torque_sensors(model: Model) -> list[Sensor]:
    """Return the torque sensor of each coordinate."""
    find = model.machine.find
    found = {find(s.body).coordinates[0]: s for s in model.machine.sensors("full") if s.kind == "torque"}
    return [found[c] for c in model.coordinates]
