"""Gain of an extended model on data that it was not fitted on.

Stretches of the logs are withheld: their readings are hidden, parameters and states are fitted to the rest, and the
exact dynamics predict the hidden readings. For likelihoods the parameters are those of the rest. Both models face the
same stretches. Intervals come from a bootstrap over stretches (Hesterberg, The American Statistician 69, 2015: expanded
percentile interval). The effect was selected on the whole logs; its magnitude for this test was not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite import identification, smoothing
from excite.diagnosis import selection
from excite.diagnosis.fits import RESUMED, ExtendedFit
from excite.logs import filtered_regression
from excite.model import build
from excite.model.machine import Machine
from excite.smoothing import Fit, Measurements, NotConvergedError, StateSpace, Trajectory, integrate, predict_readings

STRETCH_S = 2.0  # length of a withheld stretch [s]; chosen
WANTED_STRETCHES = 20  # number of stretches; chosen
MAX_TURNS = 3  # fits to a short log, each without other stretches; chosen
PERIOD_S = MAX_TURNS * STRETCH_S  # distance from stretch to stretch [s], so that the turns withhold every part once
BOOTSTRAP_DRAWS = 2000  # chosen


OF_STRETCHES = "squares", "counts", "turn", "log_likelihood"  # fields with a row for each stretch


@dataclass(frozen=True)
class HoldOutErrors:
    """Prediction errors of a model on withheld stretches.

    sensors (m): names and units. squares (stretches, m) [SI squared]: sums of squared errors. counts (stretches, m):
    number of readings. signal_variance (m,): mean variance of a signal within a stretch. noise_variance (m,): variance
    of a reading. turn (stretches,): stretches of one turn are hidden at once. log_likelihood (stretches,): of the
    readings of a stretch given all before them, with the parameters of the rest; NaN if it was not asked for, or if
    unknown forces stand beside the model.
    """

    sensors: tuple[tuple[str, str], ...]
    squares: np.ndarray
    counts: np.ndarray
    signal_variance: np.ndarray
    noise_variance: np.ndarray
    turn: np.ndarray
    log_likelihood: np.ndarray

    def of(self, turns: np.ndarray) -> HoldOutErrors:
        """Keep the stretches of some turns only."""
        own = np.isin(self.turn, turns)
        return replace(self, **{x: getattr(self, x)[own] for x in OF_STRETCHES})

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


def hold_out_errors(stage: ExtendedFit, every_turn: bool = False, likelihood: bool = False) -> HoldOutErrors | None:
    """Predict withheld stretches of a fit's logs with its model.

    every_turn: withhold every part of the logs once, not WANTED_STRETCHES only. likelihood: find `log_likelihood`, too.
    Return None if no fit to the rest is found or the logs are too short.
    """
    data, fit = stage.data, stage.fit
    held = data.held | fit.unidentifiable
    rate = float(stage.machine.sampling_hz)
    lengths = [len(r.used) for r in data.measurements]
    per_turn = sum(len(_stretches(n, rate)) for n in lengths)
    if per_turn == 0:
        return None
    turns = MAX_TURNS if every_turn else min(-(-WANTED_STRETCHES // per_turn), MAX_TURNS)
    parts = []
    for turn in range(turns):
        stretches = [_stretches(n, rate, turn / turns) for n in lengths]
        part = _errors_of_turn(stage, held, stretches, turn, likelihood) if any(stretches) else None
        if part is not None:
            parts.append(part)
    if not parts:
        return None
    whole = {x: np.concatenate([getattr(p, x) for p in parts]) for x in OF_STRETCHES}
    motion, noise = (np.mean([getattr(p, x) for p in parts], axis=0) for x in ("signal_variance", "noise_variance"))
    return HoldOutErrors(parts[0].sensors, signal_variance=motion, noise_variance=noise, **whole)


def hold_out_torques(stage: ExtendedFit) -> HoldOutErrors | None:
    """Predict the torques [N m or N] of withheld stretches by least squares on the other ones.

    What a user of a machine without slips asks of a model, as positions drift in open loop. Every part of the logs is
    withheld once. Return None for a machine with slips, or with an effect that least squares cannot find.
    """
    if stage.model.slips:
        return None
    machine, n_u = selection.fitted_machine(stage), len(stage.model.inputs)
    model = build(machine)
    if any(e.name in model.nonlinear or e.effect.sensor_only for e in model.effects):
        return None
    rows = list(model.actuated)
    filtered = (filtered_regression(model, log, machine.filter) for log in stage.data.logs)
    blocks = [(W[rows], Y[rows]) for W, Y in filtered]
    columns = [model.base.names.index(e.name) for e in model.effects if e.name in model.base.names]
    if any(not any(W[:, :, k].any() for W, _ in blocks) for k in columns):
        return None  # a delay or a lag is in no row
    rate = float(machine.sampling_hz) / machine.filter.decimation
    whole = identification.fit_rows(model, blocks)
    level = np.sqrt(sum(((Y - W @ whole) ** 2).sum(axis=1) for W, Y in blocks) / sum(Y.shape[1] for _, Y in blocks))
    weighted = [(W / level[:, None, None], Y / level[:, None]) for W, Y in blocks]
    squares, counts, motion, turns = [], [], [], []
    for turn in range(MAX_TURNS):
        stretches = [_stretches(Y.shape[1], rate, turn / MAX_TURNS) for _, Y in blocks]
        seen = []
        for (W, Y), own in zip(weighted, stretches, strict=True):
            used = np.ones(Y.shape[1], bool)
            for a, b in own:
                used[a:b] = False
            seen.append((W[:, used], Y[:, used]))
        X = identification.fit_rows(model, seen)
        for (W, Y), own in zip(blocks, stretches, strict=True):
            for a, b in own:
                squares.append(((Y[:, a:b] - W[:, a:b] @ X) ** 2).sum(axis=1))
                counts.append(np.full(n_u, b - a))
                motion.append((Y[:, a:b] ** 2).mean(axis=1))
                turns.append(turn)
    if not squares:
        return None
    names = torque_names(machine)
    likelihood = np.full(len(squares), np.nan)
    return HoldOutErrors(
        names, np.array(squares), np.array(counts), np.mean(motion, axis=0), level**2, np.array(turns), likelihood
    )


def torque_names(machine: Machine) -> tuple[tuple[str, str], ...]:
    """Return name and unit of the torque sensor of every actuated joint."""
    return tuple(
        next((s.name, machine.si_unit(s)) for s in machine.sensor if s.kind == "torque" and s.body == b.index)
        for b in machine.actuated
    )


def _errors_of_turn(
    stage: ExtendedFit, held: np.ndarray, stretches: Sequence[Sequence[tuple[int, int]]], turn: int, likelihood: bool
) -> HoldOutErrors | None:
    """Hide some stretches of each log at once, and predict them; None if no fit to the rest is found."""
    data, fit = stage.data, stage.fit
    space, masked = data.space, []
    for r, own in zip(stage.measurements, stretches, strict=True):
        used = r.used.copy()
        for a, b in own:
            used[a:b] = 0.0
        masked.append(replace(r, used=used))
    rest = smoothing.fit_logs(
        space, masked, fit.trajectories, fit.X, data.starts, held, settings=RESUMED, unknown=fit.unknown
    )
    if rest.step > smoothing.ACCEPTABLE_STEP:
        return None
    squares, counts, motion, noise = [], [], [], []
    for r, p, own in zip(stage.measurements, rest.trajectories, stretches, strict=True):
        if not stage.exact:
            p = _by_model_alone(space, r, p, rest.X, own)
        u = space.delivered_torques(r.torque, rest.X)[0] + p.sampled_torque_error
        h, _, weight, *_ = predict_readings(space, r, p, u, rest.X)
        if not np.isfinite(h).all():
            return None
        noise.append(r.used.sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300))
        for a, b in own:
            valid = r.used[a:b] > 0
            error = np.where(valid, r.reading[a:b] - h[a:b], 0.0)
            squares.append((error**2).sum(axis=0))
            counts.append(valid.sum(axis=0))
            motion.append(h[a:b].var(axis=0))
    sensors = tuple((s.name, space.model.machine.si_unit(s)) for s in space.sensors)
    told = likelihood and stage.exact  # unknown forces fit what the model does not predict
    return HoldOutErrors(
        sensors,
        np.array(squares),
        np.array(counts),
        np.mean(motion, axis=0),
        np.mean(noise, axis=0),
        np.full(len(squares), turn),
        _likelihood_of_stretches(stage, rest, stretches) if told else np.full(len(squares), np.nan),
    )


def _by_model_alone(
    space: StateSpace, r: Measurements, p: Trajectory, X: np.ndarray, stretches: Sequence[tuple[int, int]]
) -> Trajectory:
    """Return a trajectory that, within the stretches, follows the model from their first states, without any errors."""
    inputs = space.inputs(space.delivered_torques(r.torque, X)[0], p.ground_inputs)
    state, error = p.state.copy(), p.torque_error.copy()
    first = np.array([a for a, _ in stretches], int)
    # `integrate` takes consecutive states: each stretch counts twice, and what leads from one to the next is left out.
    for k in range(max((b - a for a, b in stretches), default=1) - 1):
        here, left, right = (np.repeat(x[first + j], 2, axis=0) for x, j in ((state, k), (inputs, k), (inputs, k + 1)))
        state[first + k + 1] = integrate(space, here, left[:-1], right[:-1], X).end[::2]
        error[first + k] = 0.0
    return replace(p, state=state, torque_error=error)


def _likelihood_of_stretches(
    stage: ExtendedFit, rest: Fit, stretches: Sequence[Sequence[tuple[int, int]]]
) -> np.ndarray:
    """Return the log-likelihood (stretches,) with the parameters of a fit, NaN where not found.

    Every reading counts given those before it, by the innovations of a filter along all readings. Friction that builds
    up over a small angle is linearised where the whole logs lead, as the rest alone leads too far off.
    """
    along: Sequence[smoothing.Trajectory] = rest.trajectories
    if any(e.unsticking for e in stage.model.effects):
        along = [replace(p, offset=r.offset) for p, r in zip(stage.fit.trajectories, along, strict=True)]
    try:
        linear = replace(stage, fit=replace(rest, trajectories=tuple(along))).relinearised.linear
    except NotConvergedError:
        return np.full(sum(len(own) for own in stretches), np.nan)
    found = []
    for x, own in zip(linear, stretches, strict=True):
        variance = np.ones_like(x.residual)
        for step in x.filter:
            variance[step.samples] = step.variance
        each = -0.5 * (x.innovations**2 + np.log(variance))
        found += [float(np.nansum(each[a:b])) for a, b in own]
    return np.array(found)


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


@dataclass(frozen=True)
class PredictiveGain:
    """Gain in log-likelihood of withheld data, with the lower end of its 95 % interval."""

    total: float
    low: float


def predictive_gain(
    before: HoldOutErrors | None, after: HoldOutErrors | None, dispersion: float | None
) -> PredictiveGain | None:
    """Compare the predictive log-likelihoods of two models on the stretches that both predict; None if there are none.

    dispersion: of a model that explains the logs, its mean squared innovation. A sum of log-likelihood ratios with mean
    m has the variance 2 m then (Gaussian innovations), however unevenly the stretches show an effect. Without it, the
    variance is that from stretch to stretch.
    """
    if before is None or after is None:
        return None
    common = np.intersect1d(before.turn, after.turn)
    each = after.of(common).log_likelihood - before.of(common).log_likelihood
    each = each[np.isfinite(each)]
    n = len(each)
    if n < 2:
        return None
    total = float(each.sum())
    if dispersion is not None:
        std, quantile = dispersion * np.sqrt(2 * abs(total)), float(scipy.stats.norm.ppf(0.975))
    else:
        std, quantile = np.sqrt(n) * float(each.std(ddof=1)), float(scipy.stats.t.ppf(0.975, n - 1))
    return PredictiveGain(total, total - quantile * std)


def _stretches(samples: int, rate: float, shift: float = 0.0) -> Sequence[tuple[int, int]]:
    """Return first sample and end of the withheld stretches, shifted by a share of the period; none at a log's ends."""
    length, period = round(STRETCH_S * rate), round(PERIOD_S * rate)
    first = (period - length) // 2 + round(shift * period)
    return [(a, a + length) for a in range(first, samples - length - (period - length) // 4, period)]
