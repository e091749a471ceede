"""What a fitted log holds beside noise that need not be an effect of the catalogue: jumps, bursts, tones, stuck counts.

Right innovations are white, of variance one and without outliers, all along the log. Each test looks for one way not to
be, over the whole log and in windows; its threshold allows for all windows, frequencies and signals that are tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.signal
import scipy.stats

from excite.logs import Log, white_noise
from excite.model.machine import Machine, Sensor
from excite.smoothing import Fit

ALARM = 1e-4  # chance of a false alarm of each test in a log
WINDOWS = 0.5, 2.0  # [s]
LOUDER = 1.6  # mean square of innovations in a window that counts, however sure
STUCK = 3.0  # counts that an encoder should have made while it stood still
SHAKING = 10.0  # [Hz]: above that a torque that is driven has little
FEW = 50  # samples by which shaking is told
SURE = 3.0  # deviations
SCATTER = 3.0  # of the logarithm of a median square of third differences, over the root of their number
# Values that never occur between such as do, as a converter with a stuck bit leaves them out: holes HOLE times wider
# than the distance of values about them, MANY of them at least, every other band of one width.
HOLE, ABOUT, MANY, EVERY = 20.0, 40, 4, 0.1
# Values at either edge of a hole whose distances are averaged, those that they are compared with, and how much larger
# they may be.
EDGE, WIDELY, SHARP = 5, 201, 2.0
TAIL = 1.6  # by which outliers of encoders may exceed those of normal noise: an edge's error is not normal


@dataclass(frozen=True)
class Anomaly:
    """Something beside noise: its signal, kind (jump, burst, drift, tone, stuck, bands), span of time [s], frequency
    [Hz].

    size: the statistic over its threshold.
    """

    signal: str
    kind: str
    begin: float
    end: float
    frequency: float | None
    size: float

    def __str__(self) -> str:
        what = {
            "jump": f"a jump at {self.begin:.2f} s",
            "burst": f"more than noise between {self.begin:.1f} s and {self.end:.1f} s",
            "drift": f"a slow error between {self.begin:.1f} s and {self.end:.1f} s",
            "tone": f"a tone at {self.frequency or 0:.2f} Hz",
            "stuck": f"counts that stand still while the machine moves, first at {self.begin:.2f} s",
            "bands": "values in bands of one width with nothing between them: a bit of its converter never changes",
        }[self.kind]
        return f"{self.signal}: {what}"


def anomalies(machine: Machine, sensors: tuple[Sensor, ...], log: Log, fit: Fit, number: int = 0) -> list[Anomaly]:
    """What a fitted log holds beside noise, the most striking first. number: which of the fit's logs it is."""
    z = fit.linear[number].innovations
    t, rate = log.t, float(machine.sampling_hz)
    found: list[Anomaly] = []
    for j, sensor in enumerate(sensors):
        found += _in_innovations(sensor.name, t, z[:, j], rate, sensor.resolution is not None)
        if sensor.resolution is not None:
            found += _stuck(sensor, t, log.values[sensor.name])
    for sensor in machine.sensors("full"):
        if sensor.kind == "torque" and sensor.name in log.values:
            found += _in_torque(sensor.name, t, log.values[sensor.name], rate)
        if sensor.resolution is None and sensor.name in log.values:
            found += _bands(sensor.name, t, log.values[sensor.name])
    return sorted(found, key=lambda a: -a.size)


def shakes(u: np.ndarray, there: np.ndarray, rate: float) -> bool | None:
    """Whether a torque channel u (N,), sampled at a rate [Hz], is surely louder above SHAKING where `there` (N,) is one
    than where it is none; None where that can't be told."""
    inside, outside = there > 0.9, there < 0.1
    if min(int(inside.sum()), int(outside.sum())) < FEW or rate < 4 * SHAKING:
        return None
    high = scipy.signal.sosfiltfilt(scipy.signal.butter(4, SHAKING, "high", fs=rate, output="sos"), u) ** 2
    independent = 1 - 2 * SHAKING / rate  # share of the samples
    # Medians: the steps of a drive are loud and rare. That of squares of normal noise scatters by 2.33 / sqrt(N).
    spread = 2.33 * np.sqrt((1 / inside.sum() + 1 / outside.sum()) / independent)
    return bool(np.median(high[inside]) > (1 + SURE * spread) * np.median(high[outside]))


def _in_innovations(name: str, t: np.ndarray, z: np.ndarray, rate: float, counts: bool) -> Iterator[Anomaly]:
    told = np.isfinite(z)
    count = int(told.sum())
    if count < 50:
        return
    own = np.where(told, z, 0.0)
    limit = TAIL * float(scipy.stats.norm.isf(ALARM / count / 2))
    k = int(np.argmax(np.abs(own)))
    if abs(own[k]) > limit:
        yield Anomaly(name, "jump", t[k], t[k], None, abs(own[k]) / limit)
    heavy = max(float(np.mean(own[told] ** 4)) / float(np.mean(own[told] ** 2)) ** 2 - 1, 1.0)
    for width in WINDOWS:
        yield from _in_windows(name, t, own, told, round(width * rate), heavy)
    if not counts:
        yield from _tone(name, own, rate, (0.0, 0.5), 1.3)


def _in_windows(
    name: str, t: np.ndarray, z: np.ndarray, told: np.ndarray, width: int, heavy: float
) -> Iterator[Anomaly]:
    """A burst and a drift, where the sum of squares or the sum over a window is too large. heavy: variance of z^2."""
    n = len(z) // width
    if n < 3:
        return
    squares, sums, counts = (x[: n * width].reshape(n, width).sum(axis=1) for x in (z**2, z, told.astype(float)))
    enough = counts >= 10
    if not enough.any():
        return
    limit = float(scipy.stats.norm.isf(ALARM / n))
    level = np.median(squares[enough] / counts[enough])
    loud = np.where(enough, (squares / np.maximum(counts, 1) / max(level, 1.0) - 1) * np.sqrt(counts / heavy), 0.0)
    k = int(np.argmax(loud))
    # A sum of squares is no normal variable: of narrow windows more are large.
    free = 2 * max(float(counts[k]), 1.0) / heavy
    skewed = (float(scipy.stats.chi2.isf(ALARM / n, free)) / free - 1) * np.sqrt(free / 2)
    if loud[k] > max(limit * 1.3, skewed) and squares[k] > LOUDER * counts[k]:
        yield Anomaly(name, "burst", t[k * width], t[(k + 1) * width - 1], None, loud[k] / limit)
    slow = np.where(enough, np.abs(sums) / np.sqrt(np.maximum(counts, 1)), 0.0)
    k = int(np.argmax(slow))
    if slow[k] > limit * 1.2:
        yield Anomaly(name, "drift", t[k * width], t[(k + 1) * width - 1], None, slow[k] / limit)


def _tone(name: str, x: np.ndarray, rate: float, band: tuple[float, float], margin: float) -> Iterator[Anomaly]:
    """A peak of the periodogram over its surroundings, in a band (shares of the rate): of white noise it is exponential
    (Fisher, 1929). margin: on the threshold, for a spectrum that isn't quite flat."""
    f, power = scipy.signal.periodogram(x, rate, detrend="constant")
    f, power = f[2:], power[2:]
    around = scipy.ndimage.median_filter(power, 201, mode="reflect") / np.log(2)
    keep = (f >= band[0] * rate) & (f <= band[1] * rate)
    over = np.where(keep, power / np.maximum(around, 1e-30), 0.0)
    limit = float(np.log(len(f) / ALARM)) * margin
    k = int(np.argmax(over))
    if over[k] > limit:
        yield Anomaly(name, "tone", 0.0, len(x) / rate, float(f[k]), over[k] / limit)


def _stuck(sensor: Sensor, t: np.ndarray, value: np.ndarray) -> Iterator[Anomaly]:
    """Counts that stand still for a sample between samples in which several were made."""
    step = np.abs(np.diff(value)) / float(sensor.resolution or 1)
    still = step < 0.5
    around = np.minimum(step[:-2], step[2:])
    bad = np.flatnonzero(still[1:-1] & (around > STUCK))
    if len(bad) >= 3:
        yield Anomaly(sensor.name, "stuck", t[bad[0] + 2], t[bad[-1] + 2], None, len(bad) / 3)


def _bands(name: str, t: np.ndarray, value: np.ndarray) -> Iterator[Anomaly]:
    """Values of a channel that come in every other band of one width alone."""
    x = np.sort(value)
    gap = np.diff(x)
    usual = scipy.ndimage.median_filter(gap, ABOUT, mode="nearest") / np.log(2)
    at = np.flatnonzero((usual > 0) & (gap > HOLE * usual))
    if len(at) < MANY:
        return
    width = float(np.median(gap[at]))
    place = (x[at] + gap[at] / 2) / (2 * width)
    # The width is a little too large, by the distance of values: so is what is found of the way from hole to hole.
    apart = np.diff(place)
    apart /= np.maximum(np.round(apart), 1.0)
    period = float(np.median(apart))
    regular = (np.abs(apart - period) < EVERY) & (np.abs(gap[at][1:] / width - 1) < 2 * EVERY)
    # A bit cuts values off where they are as dense as elsewhere; noise about levels that a drive steps to fades.
    beside = np.add.outer(at, [*range(-EDGE, 0), *range(1, EDGE + 1)])
    around = scipy.ndimage.median_filter(gap, WIDELY, mode="nearest")[at] / np.log(2)
    edges = gap[np.clip(beside, 0, len(gap) - 1)].mean(axis=1) / around
    sharp, often = np.median(edges) <= SHARP, regular.sum() >= max(MANY - 1, 0.8 * len(regular))
    if sharp and often and abs(period - 1) < EVERY:
        yield Anomaly(name, "bands", t[0], t[-1], None, len(at) / MANY)


def _in_torque(name: str, t: np.ndarray, u: np.ndarray, rate: float) -> Iterator[Anomaly]:
    """Tones above what a drive can do, and windows of louder noise, in a torque channel itself."""
    yield from _tone(name, u, rate, (0.2, 0.48), 2.0)
    noise = white_noise(u)
    rough = np.diff(u, 3) / (np.sqrt(20) * max(noise, 1e-12))
    width = round(WINDOWS[1] * rate)
    n = len(rough) // width
    if n < 3:
        return
    level = np.median(rough[: n * width].reshape(n, width) ** 2, axis=1) / 0.4549
    # The third difference of white noise is coloured. The logarithm of its median square over a window is about normal,
    # and scatters by SCATTER / sqrt(width): found by simulation.
    limit = float(np.exp(scipy.stats.norm.isf(ALARM / n) * SCATTER / np.sqrt(width)))
    k = int(np.argmax(level))
    if level[k] > limit and level[k] > LOUDER:
        yield Anomaly(name, "burst", t[k * width], t[(k + 1) * width - 1], None, level[k] / limit)
