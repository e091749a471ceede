"""How sure joint smoothing's parameters are, where the inverse of the information at the answer doesn't tell.

It doesn't in two ways. An encoder's errors are no noise: they follow from the motion but for where its count begins,
and beat with the clock (`counted`). And where a drive shows a direction of the parameters poorly, the likelihood is no
parabola as wide as it is deep: an estimate that is off looks surer than it is to one side, so the likelihood itself is
followed to either side (`followed`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from excite.smoothing.gauss_newton import Fit, NotConverged, in_si, linearised, moved, newton_step, places
from excite.smoothing.innovations import Linear
from excite.smoothing.linearisation import Chart
from excite.smoothing.measurements import Point, Record, readings

PHASES = 64  # places between two edges at which an encoder's count may begin, to average over
COLUMNS = 8  # parameters whose trajectories are held at a time
WIDE = 0.03  # relative standard deviation from which a direction is followed
FOLLOWED = 2.0  # standard deviations to either side
LOPSIDED = 0.5, 4.0  # least and most that a side may be, in deviations at the answer
FLAT = (
    "the likelihood of {} is nearly flat to one side, so the intervals of these are as wide as it was followed, not as"
    " wide as they should be: a drive that shows them better tells more"
)
HARDLY = 0.1  # deviations above zero
MOST = 0.5  # of the largest part in a combination of parameters, from which one is told as part of it


def sure(
    c: Chart, records: Sequence[Record], starts: Sequence[Point], fit: Fit
) -> tuple[Fit, np.ndarray, tuple[str, ...]]:
    """A fit with exact dynamics and its true covariance, as far as that can be known; standard deviations below and
    above (2, n_base) [SI]; and what to say of them."""
    linear = linearised(c, records, fit.points, starts, fit.X, fit.disturbed)
    fit = fit if linear is None else replace(fit, linear=tuple(linear))  # the last step was one from elsewhere
    n = len(fit.X)
    free = np.zeros(n, bool)
    covariance, (step, *_), _, cost = newton_step(c, records, fit.linear, fit.points, fit.X, fit.prior, 0.0, free)
    ended = at_end(c, fit, covariance, step)
    beside = covariance
    if ended.any():
        beside, _, _, cost = newton_step(c, records, fit.linear, fit.points, fit.X, fit.prior, 0.0, ended)
    added = np.zeros_like(covariance)
    for r, p, found, place in zip(records, fit.points, fit.linear, places(c, records), strict=True):
        own, white = counted(c, r, p, fit.X, found)
        added[np.ix_(place, place)] += own - white
    true = covariance + covariance @ added @ covariance
    way = widest(c, fit, beside)
    below, above = followed(c, records, starts, replace(fit, cost=cost), beside, way, ended)
    along, true = in_deviations(true, way)[:n] * c.model.scale, in_si(c, true)
    more = np.array([below**2, above**2]) - 1
    sides = np.diag(true) + np.where(along > 0, more[:, None], more[::-1, None]) * along**2
    widened = true + (((below + above) / 2) ** 2 - 1) * np.outer(along, along)
    notes: tuple[str, ...] = ()
    if max(below, above) >= LOPSIDED[1]:
        part = np.abs(along) / np.maximum(np.abs(fit.X), c.model.scale)
        told = [name for name, x in zip(c.model.base.names, part, strict=True) if x > MOST * part.max()]
        notes = (FLAT.format(", ".join(told)),)
    return replace(fit, covariance=widened), np.sqrt(sides), notes


def counted(c: Chart, r: Record, p: Point, X: np.ndarray, found: Linear) -> tuple[np.ndarray, np.ndarray]:
    """What encoders' errors make the slope of a log's cost, as second moments (n_p + n_o, n_p + n_o), scaled: their own
    along the smoothed motion, averaged over where the count may begin, and white noise of their size.

    The difference goes through the estimate as it was weighed: covariance + covariance @ (own - white) @ covariance
    (the sandwich of White, Econometrica 48 (1980) 817). A motion that is played back meets the same errors each time
    but for where the count begins, so they do more harm than white ones on one drive and less on another.
    """
    sample = 1 / float(c.model.machine.sampling_hz)
    u = c.delivered(r.torque, X)[0] + p.errors
    weight = readings(c, replace(r, used=np.ones_like(r.used)), p, u, X)[2]
    angle, _, rate, *_ = c.readings(p.s, c.inputs(u, p.over), X)
    encoders = np.flatnonzero(r.counts)
    step = r.noise.sensor[encoders]
    by = _slopes(found, c.flawed, encoders)
    own, white = np.zeros((2, by.shape[2], by.shape[2]))
    phases = (np.arange(PHASES)[:, None] + 0.5) / PHASES
    for k, j in enumerate(encoders):
        travel = np.clip(rate[:, j, 0] * sample / step[k], -1, 1)
        at = angle[:, j, 0] / step[k] - phases
        count = np.floor(at)
        change = np.diff(count, axis=1, prepend=count[:, :1])
        error = np.where(change != 0, count + (change < 0) - at + travel / 2, 0.0) * step[k]
        slope = (error * weight[:, j]) @ by[:, k]
        own += slope.T @ slope / PHASES
        size = r.used[:, j] * (weight[:, j] * step[k] * travel) ** 2 / 12
        white += by[:, k].T @ (by[:, k] * size[:, None])
    return own, white


def _slopes(found: Linear, flawed: tuple[int, ...], sensors: np.ndarray) -> np.ndarray:
    """How the readings of some sensors move with parameters and offsets (N, k, n_p + n_o), with the most likely states
    that go with these. Single precision."""
    N, _, n_o = found.direct.shape
    n_o -= len(flawed)
    count = found.solved.Z.shape[0] - 1
    by = np.empty((N, len(sensors), count), np.float32)
    H = found.H[:, sensors]
    for k in range(0, count, COLUMNS):
        by[:, :, k : k + COLUMNS] = H @ found.solved.slopes(slice(k, k + COLUMNS))
    told = [*flawed, *range(count - n_o, count)]
    by[:, :, told] += found.direct[:, sensors]
    return by


def at_end(c: Chart, fit: Fit, covariance: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Parameters (n_base,) that make sense above zero only and which the logs would like best below: a step leads there
    from hardly above. The likelihood beside them is that with these where they are."""
    n, value = len(fit.X), fit.X / c.model.scale
    hardly = value < HARDLY * np.sqrt(np.diag(covariance)[:n])
    return np.asarray(c.model.positive & ~fit.unseen & hardly & (value + step[:n] < 0))


def widest(c: Chart, fit: Fit, covariance: np.ndarray) -> np.ndarray:
    """The combination of parameters (n_p + offsets,) whose relative deviation is largest, zero where that is small."""
    n = len(fit.X)
    value = np.abs(fit.X) / c.model.scale
    size = np.maximum(value, 1.0)
    reach = np.where(c.model.positive, value, size)
    # One that may as well be nothing can't be followed there.
    free = ~fit.unseen & (np.sqrt(np.diag(covariance)[:n]) < reach / FOLLOWED)
    relative = np.where(np.outer(free, free), covariance[:n, :n] / np.outer(size, size), 0.0)
    variances, directions = np.linalg.eigh(relative)
    way = np.zeros(len(covariance))
    if variances[-1] > WIDE**2:
        way[:n] = directions[:, -1] / size
    return way


def in_deviations(covariance: np.ndarray, way: np.ndarray) -> np.ndarray:
    """How all parameters go when a combination of them is off by one standard deviation; zero where there is none."""
    return np.asarray(covariance @ way / np.sqrt(max(way @ covariance @ way, np.finfo(float).tiny)))


def followed(
    c: Chart,
    records: Sequence[Record],
    starts: Sequence[Point],
    fit: Fit,
    covariance: np.ndarray,
    way: np.ndarray,
    ended: np.ndarray,
) -> tuple[float, float]:
    """How many times as wide as at the answer the likelihood of a combination of parameters is below and above it, all
    else as likely as it can be (profile likelihood; Venzon and Moolgavkar, Applied Statistics 37 (1988) 87).

    What one linearisation at either side says, which the next ones change by a few hundredths. ended (n_base,):
    parameters that stay where they are. 1 and 1 where there is nothing to follow or the motion can't be followed.
    """
    if not way.any():
        return 1.0, 1.0
    n = len(fit.X)
    step = in_deviations(covariance, way)
    widths = []
    for far in (-FOLLOWED, FOLLOWED):
        X = fit.X + far * step[:n] * c.model.scale
        if not (X[c.model.positive] > 0).all():
            return 1.0, 1.0
        points = [
            moved(c, r, p, found, far * step[place])
            for r, p, found, place in zip(records, fit.points, fit.linear, places(c, records), strict=True)
        ]
        linear = linearised(c, records, points, starts, X, fit.disturbed)
        if linear is None:
            return 1.0, 1.0
        try:
            there, steps, _, cost = newton_step(c, records, linear, points, X, fit.prior, 0.0, ended)
        except (NotConverged, np.linalg.LinAlgError):
            return 1.0, 1.0
        if not np.isfinite(cost):
            return 1.0, 1.0
        back = way[:n] @ steps[0][:n]  # by which the most likely point of all lies elsewhere
        risen = cost + back**2 / (way @ there @ way) - fit.cost
        widths.append(float(np.clip(FOLLOWED / np.sqrt(max(risen, 1e-9)), *LOPSIDED)))
    return widths[0], widths[1]
