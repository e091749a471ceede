"""Gain of an extended model on data that it was not fitted on.

Stretches of the logs are withheld: their readings are hidden, parameters and states are fitted to the rest, and the
exact dynamics predict the hidden readings. Both models face the same stretches. Intervals come from a bootstrap over
stretches (Hesterberg, The American Statistician 69, 2015: expanded percentile interval). The effect was selected on the
whole logs; its magnitude for this test was not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite import smoothing
from excite.diagnosis.fits import ExtendedFit
from excite.smoothing import Fit, NotConvergedError, predict_readings

STRETCH_S = 2.0  # length of a withheld stretch [s]; chosen
PERIOD_S = 6.0  # distance from stretch to stretch [s]; chosen
WANTED_STRETCHES = 20  # number of stretches; chosen
MAX_TURNS = 3  # fits to a short log, each without other stretches; chosen
FALLBACK_PROCESS_NOISE = 0.1, 1.0, 4.0  # levels for a wrong model that finds no fit to the rest, tried in turn; chosen
BOOTSTRAP_DRAWS = 2000  # chosen


@dataclass(frozen=True)
class HoldOutErrors:
    """Prediction errors of a model on withheld stretches.

    sensors (m): names and units. squares (stretches, m) [SI squared]: sums of squared errors. counts (stretches, m):
    number of readings. signal_variance (m,): mean variance of a signal within a stretch. noise_variance (m,): variance
    of a reading. turn (stretches,): stretches of one turn are hidden at once.
    """

    sensors: tuple[tuple[str, str], ...]
    squares: np.ndarray
    counts: np.ndarray
    signal_variance: np.ndarray
    noise_variance: np.ndarray
    turn: np.ndarray

    def of(self, turns: np.ndarray) -> HoldOutErrors:
        """Keep the stretches of some turns only."""
        own = np.isin(self.turn, turns)
        return replace(self, squares=self.squares[own], counts=self.counts[own], turn=self.turn[own])

    def percent(self, draw: np.ndarray | None = None) -> float:
        """Return the error in per cent of the signals, each weighted by its noise.

        draw: numbers of the stretches that count, all by default.
        """
        at = slice(None) if draw is None else draw
        error = self.squares[at].sum(axis=0) / np.maximum(self.counts[at].sum(axis=0), 1)
        valid = (self.counts[at].sum(axis=0) > 0) & (self.signal_variance > 0) & (self.noise_variance > 0)
        if not valid.any():
            return float("nan")
        return float(
            100
            * np.sqrt(
                np.sum(error[valid] / self.noise_variance[valid])
                / np.sum(self.signal_variance[valid] / self.noise_variance[valid])
            )
        )

    def rms(self) -> dict[str, tuple[float, str]]:
        """Return the root mean square error of every signal, with its unit."""
        size = np.sqrt(self.squares.sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1))
        return {name: (float(x), unit) for (name, unit), x in zip(self.sensors, size, strict=True)}


@dataclass(frozen=True)
class HoldOutGain:
    """Hold-out errors before and after [%], gain [% of the error before], and its 95 % interval if there is one.

    signals: root mean square error before and after, and unit, by signal.
    """

    before: float
    after: float
    percent: float
    interval: tuple[float, float] | None
    signals: Mapping[str, tuple[float, float, str]]


def hold_out_errors(stage: ExtendedFit) -> HoldOutErrors | None:
    """Predict withheld stretches of a fit's logs with its model.

    The machine file's parameters are used if none were estimated. Return None if no fit to the rest is found or the
    logs are too short.
    """
    data, fit = stage.data, stage.fit
    held = data.held | fit.unidentifiable if stage.estimated or data.noise_inflation > 1 else np.ones_like(data.held)
    rate = float(stage.machine.sampling_hz)
    lengths = [len(r.used) for r in data.measurements]
    per_turn = sum(len(_stretches(n, rate)) for n in lengths)
    if per_turn == 0:
        return None
    turns = min(-(-WANTED_STRETCHES // per_turn), MAX_TURNS)
    parts = []
    for turn in range(turns):
        stretches = [_stretches(n, rate, turn / turns) for n in lengths]
        part = _errors_of_turn(stage, held, stretches, turn) if any(stretches) else None
        if part is not None:
            parts.append(part)
    if not parts:
        return None
    squares, counts, turn_of = (np.concatenate([getattr(p, x) for p in parts]) for x in ("squares", "counts", "turn"))
    motion, noise = (np.mean([getattr(p, x) for p in parts], axis=0) for x in ("signal_variance", "noise_variance"))
    return HoldOutErrors(parts[0].sensors, squares, counts, motion, noise, turn_of)


def _errors_of_turn(
    stage: ExtendedFit, held: np.ndarray, stretches: Sequence[Sequence[tuple[int, int]]], turn: int
) -> HoldOutErrors | None:
    """Hide some stretches of each log at once, and predict them; None if no fit to the rest is found."""
    data, fit = stage.data, stage.fit
    space, masked = data.space, []
    for r, own in zip(data.measurements, stretches, strict=True):
        used = r.used.copy()
        for a, b in own:
            used[a:b] = 0.0
        masked.append(replace(r, used=used))
    rest: Fit | None = None
    for process_noise in (fit.process_noise, *(x for x in FALLBACK_PROCESS_NOISE if x > fit.process_noise)):
        try:
            rest = smoothing.fit_logs(
                space,
                masked,
                fit.trajectories,
                fit.X,
                data.starts,
                process_noise,
                held,
                smoothing.RESUMED_DAMPING,
                # A prediction needs no accurate covariance.
                sufficient_step=smoothing.ACCEPTABLE_STEP if process_noise > 0 else smoothing.SUFFICIENT_STEP,
                patient=False,
            )
        except NotConvergedError as failed:
            rest = failed.acceptable_fit
        if rest is not None:
            break
    if rest is None:
        return None
    squares, counts, motion, noise = [], [], [], []
    for r, p, own in zip(data.measurements, rest.trajectories, stretches, strict=True):
        u = space.delivered_torques(r.torque, rest.X)[0] + p.sampled_torque_error
        h, _, weight, *_ = predict_readings(space, r, p, u, rest.X)
        noise.append(r.used.sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300))
        for a, b in own:
            valid = r.used[a:b] > 0
            error = np.where(valid, r.reading[a:b] - h[a:b], 0.0)
            squares.append((error**2).sum(axis=0))
            counts.append(valid.sum(axis=0))
            motion.append(h[a:b].var(axis=0))
    sensors = tuple((s.name, space.model.machine.si_unit(s)) for s in space.sensors)
    turn_of = np.full(len(squares), turn)
    return HoldOutErrors(
        sensors, np.array(squares), np.array(counts), np.mean(motion, axis=0), np.mean(noise, axis=0), turn_of
    )


def hold_out_gain(before: HoldOutErrors | None, after: HoldOutErrors | None, seed: int = 0) -> HoldOutGain | None:
    """Compare two models on the stretches that both predict; None if there are none. One stretch gives no interval."""
    if before is None or after is None:
        return None
    common = np.intersect1d(before.turn, after.turn)
    if len(common) == 0:
        return None
    before, after = before.of(common), after.of(common)
    n = len(before.squares)
    old, new = before.percent(), after.percent()
    interval = None
    if n > 1:
        draws = np.random.default_rng(seed).integers(0, n, (BOOTSTRAP_DRAWS, n))
        gains = [100 * (1 - after.percent(draw) / before.percent(draw)) for draw in draws]
        tail_percent = 100 * scipy.stats.norm.cdf(-np.sqrt(n / (n - 1)) * scipy.stats.t.ppf(0.975, n - 1))
        interval = (float(np.nanpercentile(gains, tail_percent)), float(np.nanpercentile(gains, 100 - tail_percent)))
    rms_before, rms_after = before.rms(), after.rms()
    return HoldOutGain(
        old,
        new,
        100 * (1 - new / old),
        interval,
        {name: (rms_before[name][0], rms_after[name][0], rms_before[name][1]) for name in rms_before},
    )


def _stretches(samples: int, rate: float, shift: float = 0.0) -> Sequence[tuple[int, int]]:
    """Return first sample and end of the withheld stretches, shifted by a share of the period; none at a log's ends."""
    length, period = round(STRETCH_S * rate), round(PERIOD_S * rate)
    first = (period - length) // 2 + round(shift * period)
    return [(a, a + length) for a in range(first, samples - length - (period - length) // 4, period)]
