"""What an extended model gains on data that it wasn't fitted on.

Stretches of the logs are withheld: their readings are hidden, parameters and states are fitted to the rest, and the
exact dynamics predict what the sensors read in them. The same stretches for the model before and after, so that the
difference is the model's; intervals from stretches drawn anew, with percentiles as much further out as few stretches
ask for (Hesterberg, The American Statistician 69, 2015: expanded percentile interval). Which effect it is was chosen
on the whole log; its amount for this was not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite import smoothing
from excite.diagnosis.fits import Stage
from excite.smoothing import Fit, NotConvergedError, predict_readings

HIDDEN, PERIOD = 2.0, 6.0  # [s] withheld of every so many
ENOUGH, TURNS = 20, 3  # stretches that are wanted, and how often a short log is hidden in turn for them, at most
LOOSER = 0.1, 1.0, 4.0  # disturbing forces that are tried where a wrong model finds no fit to what isn't withheld
DRAWS = 2000


@dataclass(frozen=True)
class Withheld:
    """Errors of a model on withheld stretches: mean squares (stretches, m) [SI squared] and how many readings (same).

    sensors (m): names and units; motion (m,): mean square of what each signal does in a stretch; noise (m,): variance
    of a reading; turn (stretches,): which of them were hidden at once.
    """

    sensors: tuple[tuple[str, str], ...]
    squares: np.ndarray
    counts: np.ndarray
    motion: np.ndarray
    noise: np.ndarray
    turn: np.ndarray

    def of(self, turns: np.ndarray) -> Withheld:
        """The stretches of some turns only."""
        own = np.isin(self.turn, turns)
        return replace(self, squares=self.squares[own], counts=self.counts[own], turn=self.turn[own])

    def percent(self, draw: np.ndarray | None = None) -> float:
        """The error in per cent of the motion, all signals in units of their noise, so that what is measured badly
        doesn't hide the rest; of some stretches where drawn."""
        at = slice(None) if draw is None else draw
        error = self.squares[at].sum(axis=0) / np.maximum(self.counts[at].sum(axis=0), 1)
        told = (self.counts[at].sum(axis=0) > 0) & (self.motion > 0) & (self.noise > 0)
        if not told.any():
            return float("nan")
        return float(
            100 * np.sqrt(np.sum(error[told] / self.noise[told]) / np.sum(self.motion[told] / self.noise[told]))
        )

    def rms(self) -> dict[str, tuple[float, str]]:
        """Root mean square error of every signal, with its unit."""
        size = np.sqrt(self.squares.sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1))
        return {name: (float(x), unit) for (name, unit), x in zip(self.sensors, size, strict=True)}


@dataclass(frozen=True)
class Gain:
    """Error before and after [%], the gain in per cent of the error before, and its 95 % interval, if there is one."""

    before: float
    after: float
    percent: float
    interval: tuple[float, float] | None
    signals: Mapping[str, tuple[float, float, str]]


def withheld(stage: Stage) -> Withheld | None:
    """How well a fitted model predicts stretches that are hidden from it, or the machine file's where none could be
    fitted, not even to coarse sensors; None where no fit to the rest is found or logs are too short to hide any."""
    prepared, fit = stage.prepared, stage.fit
    held = prepared.held | fit.unidentifiable if stage.settled or prepared.coarse > 1 else np.ones_like(prepared.held)
    rate = float(stage.machine.sampling_hz)
    lengths = [len(r.used) for r in prepared.records]
    once = sum(len(_stretches(n, rate)) for n in lengths)
    if once == 0:
        return None  # too short to hide anything
    turns = min(-(-ENOUGH // once), TURNS)
    parts = []
    for turn in range(turns):
        stretches = [_stretches(n, rate, turn / turns) for n in lengths]
        part = _hidden(stage, held, stretches, turn) if any(stretches) else None
        if part is not None:
            parts.append(part)
    if not parts:
        return None
    squares, counts, each = (np.concatenate([getattr(p, x) for p in parts]) for x in ("squares", "counts", "turn"))
    motion, noise = (np.mean([getattr(p, x) for p in parts], axis=0) for x in ("motion", "noise"))
    return Withheld(parts[0].sensors, squares, counts, motion, noise, each)


def _hidden(
    stage: Stage, held: np.ndarray, stretches: Sequence[Sequence[tuple[int, int]]], turn: int
) -> Withheld | None:
    """The same of some stretches of each log, hidden at once."""
    prepared, fit = stage.prepared, stage.fit
    c, masked = prepared.c, []
    for r, own in zip(prepared.records, stretches, strict=True):
        used = r.used.copy()
        for a, b in own:
            used[a:b] = 0.0
        masked.append(replace(r, used=used))
    rest: Fit | None = None
    for disturbed in (fit.process_noise, *(x for x in LOOSER if x > fit.process_noise)):
        try:
            rest = smoothing.fit_logs(
                c,
                masked,
                fit.trajectories,
                fit.X,
                prepared.starts,
                disturbed,
                held,
                smoothing.RESUMED_DAMPING,
                # What it predicts is asked for, not its deviations.
                sufficient_step=smoothing.ACCEPTABLE_STEP if disturbed > 0 else smoothing.SUFFICIENT_STEP,
                patient=False,
            )
        except NotConvergedError as failed:
            rest = failed.acceptable_fit
        if rest is not None:
            break
    if rest is None:
        return None
    squares, counts, motion, noise = [], [], [], []
    for r, p, own in zip(prepared.records, rest.trajectories, stretches, strict=True):
        u = c.delivered_torques(r.torque, rest.X)[0] + p.sampled_torque_error
        h, _, weight, *_ = predict_readings(c, r, p, u, rest.X)
        noise.append(r.used.sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300))
        for a, b in own:
            told = r.used[a:b] > 0
            error = np.where(told, r.reading[a:b] - h[a:b], 0.0)
            squares.append((error**2).sum(axis=0))
            counts.append(told.sum(axis=0))
            motion.append(h[a:b].var(axis=0))
    sensors = tuple((s.name, c.model.machine.si_unit(s)) for s in c.sensors)
    each = np.full(len(squares), turn)
    return Withheld(sensors, np.array(squares), np.array(counts), np.mean(motion, axis=0), np.mean(noise, axis=0), each)


def gain(before: Withheld | None, after: Withheld | None, seed: int = 0) -> Gain | None:
    """What a model gains on the same stretches, with an interval; none where there is but one stretch. None where the
    two have no stretch in common."""
    if before is None or after is None:
        return None
    both = np.intersect1d(before.turn, after.turn)
    if len(both) == 0:
        return None
    before, after = before.of(both), after.of(both)
    n = len(before.squares)
    old, new = before.percent(), after.percent()
    interval = None
    if n > 1:
        drawn = np.random.default_rng(seed).integers(0, n, (DRAWS, n))
        gains = [100 * (1 - after.percent(draw) / before.percent(draw)) for draw in drawn]
        out = 100 * scipy.stats.norm.cdf(-np.sqrt(n / (n - 1)) * scipy.stats.t.ppf(0.975, n - 1))
        interval = (float(np.nanpercentile(gains, out)), float(np.nanpercentile(gains, 100 - out)))
    was, now = before.rms(), after.rms()
    return Gain(
        old,
        new,
        100 * (1 - new / old),
        interval,
        {name: (was[name][0], now[name][0], was[name][1]) for name in was},
    )


def _stretches(samples: int, rate: float, shift: float = 0.0) -> Sequence[tuple[int, int]]:
    """First and last sample of the withheld stretches, none at the ends, later by a share of the period."""
    length, period = round(HIDDEN * rate), round(PERIOD * rate)
    first = (period - length) // 2 + round(shift * period)
    return [(a, a + length) for a in range(first, samples - length - (period - length) // 4, period)]
