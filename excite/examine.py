"""A log before it is believed: spikes, drop-outs, late channels; and which filter its spectra call for."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite import sensors
from excite.crosscheck import replayed
from excite.doubts import doubts
from excite.log import Log, LogError, check
from excite.noise import spread, whitener
from excite.processing import decimate, derivative, lowpass, regression, samples
from excite.regression import sandwich, solved, whitened
from excite.simulate import SimulationError
from model.machine import Filter, Sensor
from model.prediction import Model

SPIKE = 10.0  # robust deviations from the neighbours that make an outlier
STEPS = 8.0  # counts, likewise
MANY = 0.005  # share of a channel's samples that may be repaired
HELD = 8  # equal readings in a row that make a drop-out
DEAD = 100  # the same for a channel that ends so
JUMP = 3.0  # times as far, at the end of such a stretch, as the encoder moves in a sample elsewhere
LATE = 4.0  # standard deviations that make a delay worth a remark
NOISY = 2e-3  # s: a deviation from which noise of slips hides a part of a delay
FLOOR = 4.0  # times the noise floor where a spectrum counts as sunk
NEEDED = ("angle", "torque", "wheel")  # kinds of sensor that no method does without
ROOM = 0.8  # of the Nyquist frequency after decimation is passed (see `decimate`)


@dataclass(frozen=True)
class Examination:
    """A log repaired, and what was found: notes; spikes {sensor: rows}; drop-outs {sensor: [(first, last) row]}; and
    what else is doubtful about it, a line each."""

    log: Log
    notes: tuple[str, ...]
    spikes: dict[str, tuple[int, ...]]
    dropouts: dict[str, tuple[tuple[int, int], ...]]
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Delay:
    """How late a torque channel is, with its standard deviation [s]."""

    name: str
    value: float
    std: float

    @property
    def significant(self) -> bool:
        return abs(self.value) > LATE * self.std

    def beside(self, usual: Delay) -> Delay:
        """What is more than a usual one."""
        return Delay(self.name, self.value - usual.value, float(np.hypot(self.std, usual.std)))


def examine(model: Model, log: Log) -> Examination:
    """Spikes of a single sample are replaced by the mean of their neighbours, with a note; drop-outs are noted.

    Raises LogError where a channel has more spikes than repair can answer for, or a drop-out in which the machine moves
    on: cut the log there.
    """
    values = dict(log.values)
    notes: list[str] = []
    spikes: dict[str, tuple[int, ...]] = {}
    dropouts: dict[str, tuple[tuple[int, int], ...]] = {}
    for sensor in model.machine.sensors("full"):
        if sensor.name not in values:
            continue
        rows = find_spikes(sensor, values[sensor.name])
        if len(rows) > max(3, MANY * len(log)):
            raise LogError(
                f"{log.source}: column {sensor.column}: {len(rows)} spikes of a single sample, the first in row"
                f" {rows[0] + 1}; too many to repair, check the channel"
            )
        if len(rows):
            x = values[sensor.name].copy()
            size = float(np.abs(x[rows] - (x[rows - 1] + x[rows + 1]) / 2).max())
            x[rows] = (x[rows - 1] + x[rows + 1]) / 2
            values[sensor.name] = x
            spikes[sensor.name] = tuple(int(r) for r in rows)
            shown = ", ".join(str(r + 1) for r in rows[:5]) + (", ..." if len(rows) > 5 else "")
            notes.append(
                f"{log.source}: column {sensor.column}: {len(rows)} spike{'s' if len(rows) > 1 else ''} of up to"
                f" {size:.3g} {model.machine.si(sensor)} replaced by the mean of the neighbours (row {shown})"
            )
        held = find_dropouts(sensor, values[sensor.name])
        if held:
            dropouts[sensor.name] = held
            first, last = held[0]
            text = (
                f"{log.source}: column {sensor.column}: {len(held)} drop-out{'s' if len(held) > 1 else ''}, the reading"
                f" stands still from row {first + 1} to {last + 1} ({log.t[first]:.2f} s to {log.t[last]:.2f} s)"
            )
            if sensor.resolution is not None or last - first > 100 * HELD:
                rest = (
                    "cut the log there" if last == len(log) - 1 else "give the stretches before and after as two logs"
                )
                raise LogError(f"{text}; {rest}")
            notes.append(f"{text}: what is in between counts as measured")
    doubtful = tuple(f"{log.source}: {line}" for line in doubts(model.machine, values))
    return Examination(Log(log.source, log.t, values), tuple(notes), spikes, dropouts, doubtful)


def find_spikes(sensor: Sensor, x: np.ndarray) -> np.ndarray:
    """Rows of a signal (N,) whose reading is far from both neighbours while these agree with each other."""
    if len(x) < 5:
        return np.zeros(0, int)
    bend = np.zeros(len(x))
    bend[1:-1] = x[1:-1] - (x[:-2] + x[2:]) / 2
    alive = np.ones(len(x), bool)  # a channel that died tells nothing of its noise
    for a, b in _held(x) if sensor.resolution is None else ():
        alive[a : b + 1] = False
    noisy = np.abs(bend[1:-1][alive[1:-1]])
    scale = 1.4826 * float(np.median(noisy)) if len(noisy) else 0.0
    least = SPIKE * scale + STEPS * (sensor.resolution or 0.0) + 1e-9 * float(np.abs(x).max())
    k = np.flatnonzero(np.abs(bend) > least)
    k = k[(k > 1) & (k < len(x) - 2)]
    # A step or a corner bends at two rows; a spike bends half as much, the other way, on both its sides, and no
    # further away, as a fast vibration would.
    alone = [
        i
        for i in k
        if max(abs(bend[i - 1] + bend[i] / 2), abs(bend[i + 1] + bend[i] / 2)) < 0.3 * abs(bend[i])
        and max(abs(bend[i - 2]), abs(bend[i + 2])) < 0.3 * abs(bend[i])
    ]
    return np.array(alone, int)


def moves(model: Model, log: Log) -> bool:
    """Whether any angle goes further than a count or two; taken for granted where one isn't counted."""
    turning = [s for s in model.machine.sensors("full") if s.kind in ("angle", "wheel") and s.name in log.values]
    return any(s.resolution is None or np.ptp(log.values[s.name]) > 2.5 * s.resolution for s in turning)


def find_dropouts(sensor: Sensor, x: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Stretches (first, last row) in which a noisy channel reads the same, or an encoder that turned fast before and
    after doesn't count, or jumps after it, or stands from one row to the next until the log ends."""
    long = _held(x)
    if sensor.resolution is None:
        changes = np.diff(x) != 0.0
        if np.count_nonzero(changes) > 0.9 * len(changes):  # a channel without noise may well stand still
            return tuple(long)
        # One with noise may be dead by the end; zero is what many say at rest.
        return tuple(
            (a, b)
            for a, b in long
            if b == len(x) - 1 and b - a > DEAD and x[b] and changes[:a][-DEAD:].sum() > 0.9 * DEAD
        )
    found, fastest = [], float(np.quantile(np.abs(np.diff(x)), 0.999)) if long else 0.0
    for a, b in long:
        if b == len(x) - 1 and b - a > DEAD and a > 0:
            # What rolls comes to rest by degrees.
            speeds = np.diff(x[: a + 1])
            usual = float(np.abs(np.diff(speeds)).max()) if len(speeds) > DEAD else np.inf
            if abs(speeds[-1]) > JUMP * (usual + sensor.resolution):
                found.append((a, b))
        before, after = x[max(a - HELD, 0) : a + 1], x[b : b + HELD + 1]
        if min(len(before), len(after)) <= HELD:
            continue
        speed = min(abs(before[-1] - before[0]), abs(after[-1] - after[0])) / HELD
        jump = abs(x[b + 1] - x[a])
        caught_up = speed > 3 * sensor.resolution and jump > 0.5 * speed * (b - a)
        if caught_up or jump > JUMP * (fastest + sensor.resolution):
            found.append((a, b))
    return tuple(found)


def _held(x: np.ndarray) -> list[tuple[int, int]]:
    """Stretches (first, last row) in which a signal (N,) reads the same HELD times and more."""
    same = np.flatnonzero(np.diff(np.concatenate([[1.0], np.diff(x) != 0.0, [1.0]])) != 0)
    runs = [(int(a), int(b)) for a, b in itertools.pairwise(same) if a + 1 < len(x) and x[a + 1] == x[a]]
    return [(a, b) for a, b in runs if b - a >= HELD]


def delays(model: Model, log: Log, filter: Filter | None = None) -> tuple[Delay, ...]:
    """How late each torque channel is against the motion.

    u_measured(t) = u(t - delay) + u0: to first order a column -du/dt beside the regressor. Rows are made white for the
    sensors' noise at the machine file's values, so that noisy slips don't pass for a delay; deviations account for
    autocorrelation.
    """
    filter = filter or model.machine.filter
    rate = float(model.machine.sampling_hz)
    s = samples(model, log, filter)
    W, Y = regression(model, s, filter)
    keep = slice(filter.drop[0], len(log) - filter.drop[1])
    rows = list(model.actuated)
    slopes = np.zeros((*W.shape[:2], len(rows)))
    for k, row in enumerate(rows):
        slope = derivative(lowpass(s.Y[row], rate, filter), rate)[None, keep]
        slopes[row, :, k] = -decimate(slope, filter.decimation)[0]
    L = whitener(model, s, model.nominal, spread(model, log, filter), filter)
    block = [whitened((np.concatenate([W, slopes], axis=2), Y), L)]
    solution = solved(block)
    covariance = solution.spread(sandwich(block, solution))
    n = W.shape[2]
    names = [_torque_name(model, row) for row in rows]
    return tuple(
        Delay(name, float(solution.x[n + k]), float(np.sqrt(covariance[n + k, n + k])))
        for k, name in enumerate(names)
        if n + k in solution.kept
    )


def _torque_name(model: Model, row: int) -> str:
    body = next(b for b in model.machine.actuated if b.coordinates[0] == model.coordinates[row])
    return next(s.name for s in model.machine.sensor if s.kind == "torque" and s.body == body.index)


def late_channels(model: Model, log: Log, filter: Filter | None = None, X: np.ndarray | None = None) -> tuple[str, ...]:
    """A remark for every torque channel that is late or early beyond doubt.

    Where rows are mostly noise, what is left of it in them passes for a delay: so the same is asked of the machine X
    (n_base,) driven by the log's torques with every channel in time, and that is taken off. Nothing is said of such
    rows without X: the machine file's soil may be another one.
    """
    found = [d for d in delays(model, log, filter) if d.significant]
    if X is not None and found:
        try:
            usual = {d.name: d for d in delays(model, _in_time(model, log, filter, X), filter)}
            found = [d.beside(usual[d.name]) if d.name in usual else d for d in found]
        except (SimulationError, LogError):
            X = None  # nothing to take off
    said = []
    for d in found:
        precise = d.std < NOISY
        if not d.significant or not (precise or X is not None):
            continue
        which = f"{'late' if d.value > 0 else 'early'} against the motion"
        much = f"{abs(d.value) * 1e3:.1f} ms (+-{d.std * 1e3:.1g})"
        line = (
            f"{d.name} is {much} {which}: shift the channel, or run `excite diagnose`"
            if precise
            else f"{d.name} is {which}, by {much} as far as noise tells: `excite diagnose` says by how much"
        )
        said.append(f"{log.source}: {line}")
    return tuple(said)


def _in_time(model: Model, log: Log, filter: Filter | None, X: np.ndarray) -> Log:
    """What a log's sensors would read of a drive by its torques if no channel were late."""
    motion = replayed(model, log, X, filter)
    made = check(sensors.measure(model, motion, X), model.machine)
    return Log(log.source, made.t, {n: made.values[n] for n in log.values if n in made.values})


# ------------------------------------------------------------------------------------------------ filters


def sinks(x: np.ndarray, rate: float) -> float:
    """Frequency [Hz] above which a signal (N,) is nothing but its white noise floor: from Welch's spectrum."""
    length = min(len(x), max(256, int(8 * rate)))
    f, p = scipy.signal.welch(scipy.signal.detrend(x), rate, nperseg=length)
    floor = float(np.median(p[f > 0.6 * f[-1]]))
    smooth = np.convolve(np.pad(p, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    above = np.flatnonzero(smooth[1:] > FLOOR * floor) + 1
    # The first gap ends it: a line at some high frequency is no reason to let noise in below it.
    gaps = np.flatnonzero(np.diff(above) > max(3, len(f) // 100))
    last = above[gaps[0]] if len(gaps) else (above[-1] if len(above) else 1)
    return float(f[last])


def choose(model: Model, logs: Sequence[Log]) -> tuple[Filter, str]:
    """Cut-off and decimation by the logs' spectra, with the reason in a sentence.

    Motion is kept up to where the liveliest angle or speed sinks into the floor of its own sensor; beyond, derivatives
    amplify noise alone. Rows are kept as dense as the pass band needs. Order and dropped ends stay the machine file's.
    """
    machine = model.machine
    rate = float(machine.sampling_hz)
    found: dict[str, float] = {}
    for sensor in machine.sensors("full"):
        if sensor.kind in ("torque", "x", "y"):
            continue
        own = [sinks(log.values[sensor.name], rate) for log in logs if sensor.name in log.values]
        if own:
            found[sensor.name] = max(own)
    liveliest = max(found, key=lambda name: found[name])
    cutoff = float(np.clip(found[liveliest], 0.5, rate / 5))
    factor = max(1, int(ROOM * rate / (2 * cutoff)))
    quantity = machine.filter.cutoff_hz.model_copy(
        update={"value": cutoff, "source": "measured", "note": f"{liveliest} sinks into its noise floor there"}
    )
    listed = ", ".join(f"{name} {f:.2g}" for name, f in found.items())
    reason = (
        f"filter: cut-off {cutoff:.2g} Hz, where {liveliest}, the liveliest signal, sinks into its sensor's noise floor"
        f" (Hz: {listed}); one row in {factor} kept, which passes {ROOM * rate / 2 / factor:.2g} Hz"
    )
    return machine.filter.model_copy(update={"cutoff_hz": quantity, "decimation": factor}), reason


def stated(model: Model, logs: Sequence[Log]) -> tuple[Filter, str]:
    """The machine file's own, for which there is nothing to say."""
    return model.machine.filter, ""


# How a filter is chosen, by what `--filter` calls it: the filter and the reason in a sentence.
FILTERS: dict[str, Callable[[Model, Sequence[Log]], tuple[Filter, str]]] = {"machine": stated, "auto": choose}
