"""Tests of a fitted log for jumps, bursts, drifts, tones, stuck counts and missing bits.

Null hypothesis: innovations are white with variance one and without outliers, all along the log. Each test looks for
one departure, over the whole log and in windows. Its threshold allows for all windows, frequencies and signals tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.signal
import scipy.stats

from excite.diagnosis.spectrum import FALSE_ALARM_PROBABILITY, strongest_line
from excite.logs import Log, white_noise
from excite.model.machine import Machine, Sensor
from excite.smoothing import Fit, normal_scores

MIN_READINGS = 50  # readings of a signal that are tested; chosen
OUTLIER_MARGIN = 1.6  # factor on the threshold of outliers, as encoder edges have no normal errors; chosen

WINDOWS_S = 0.5, 2.0  # lengths of windows [s]; chosen
MIN_WINDOWS = 3  # windows in a log that are tested; chosen
MIN_WINDOW_READINGS = 10  # readings in a window that counts; chosen
MIN_SYSTEMATIC_MEAN_SQUARE = 1.6  # mean square of innovations that are no noise, however significant; chosen
BURST_MARGIN = 1.3  # factor on the threshold of the normalised sum of squares; chosen
DRIFT_MARGIN = 1.2  # factor on the threshold of the normalised sum; chosen

TONE_MARGIN = 1.3  # factor on the threshold of tones in innovations; chosen
TORQUE_TONE_BAND = 0.2, 0.48  # above an actuator's bandwidth, shares of the sampling rate; chosen
TORQUE_TONE_MARGIN = 2.0  # factor on the threshold of tones in a torque channel; chosen

MIN_STUCK_COUNTS = 3.0  # counts before and after a sample without any that make it stuck; chosen
MIN_STUCK_SAMPLES = 3  # stuck samples in a log that are reported; chosen

SHAKING_HZ = 10.0  # frequency [Hz] above which actuated torques contain little; chosen
MIN_SHAKING_SAMPLES = 50  # samples with and without the effect that are compared; chosen
SHAKING_STDS = 3.0  # standard deviations from which the difference is significant; chosen

# Medians of squares of standard normal noise.
MEDIAN_SQUARE = 0.4549  # median of chi-squared with one degree of freedom
MEDIAN_SQUARE_SCATTER = 2.33  # relative standard deviation of the median of N squares, times sqrt(N); asymptotic
LOG_MEDIAN_SQUARE_SCATTER = 3.0  # the same of its logarithm, for third differences of white noise; by simulation

# A stuck bit of a converter leaves holes between bands of values, all of one width.
MIN_HOLE_RATIO = 20.0  # gap between sorted values over the usual gap there that makes a hole; chosen
HOLE_NEIGHBOURS = 40  # gaps whose median is the usual gap; chosen
MIN_HOLES = 4  # number of holes; chosen
MIN_REGULAR_SHARE = 0.8  # share of the holes that must follow each other at twice the width; chosen
HOLE_SPACING_TOLERANCE = 0.1  # relative error of that spacing; chosen
EDGE_GAPS = 5  # gaps on either side of a hole that show how sharp its edges are; chosen
EDGE_REFERENCE_GAPS = 201  # gaps whose median they are compared with; chosen
MAX_EDGE_RATIO = 2.0  # largest ratio of the two at a sharp edge; chosen


@dataclass(frozen=True)
class Anomaly:
    """A departure from noise in one signal.

    kind: jump, burst, drift, tone, stuck or bands. begin, end [s]. frequency [Hz] of a tone. size: the statistic over
    its threshold.
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


def find_anomalies(machine: Machine, sensors: tuple[Sensor, ...], log: Log, fit: Fit, number: int = 0) -> list[Anomaly]:
    """Find departures from noise in a fitted log, the most striking first. number: index of the log in the fit."""
    z = fit.linear[number].innovations
    t, rate = log.t, float(machine.sampling_hz)
    found: list[Anomaly] = []
    for j, sensor in enumerate(sensors):
        found += _innovation_anomalies(sensor.name, t, z[:, j], rate, sensor.resolution is not None)
        if sensor.resolution is not None:
            found += _stuck_counts(sensor, t, log.values[sensor.name])
    for sensor in machine.sensors("full"):
        if sensor.kind == "torque" and sensor.name in log.values:
            found += _torque_anomalies(sensor.name, t, log.values[sensor.name], rate)
        if sensor.resolution is None and sensor.name in log.values:
            found += _value_bands(sensor.name, t, log.values[sensor.name])
    return sorted(found, key=lambda a: -a.size)


def is_shaking(u: np.ndarray, active: np.ndarray, rate: float) -> bool | None:
    """Tell if a torque channel u (N,) at a sampling rate [Hz] is louder above SHAKING_HZ while an effect acts.

    active (N,): one where the effect acts, zero where it does not. Return None if the log cannot tell.
    """
    inside, outside = active > 0.9, active < 0.1
    if min(int(inside.sum()), int(outside.sum())) < MIN_SHAKING_SAMPLES or rate < 4 * SHAKING_HZ:
        return None
    high = scipy.signal.sosfiltfilt(scipy.signal.butter(4, SHAKING_HZ, "high", fs=rate, output="sos"), u) ** 2
    independent = 1 - 2 * SHAKING_HZ / rate  # share of the samples that count as independent
    # Medians, since steps of an actuated torque are loud and rare.
    scatter = MEDIAN_SQUARE_SCATTER * np.sqrt((1 / inside.sum() + 1 / outside.sum()) / independent)
    return bool(np.median(high[inside]) > (1 + SHAKING_STDS * scatter) * np.median(high[outside]))


def _innovation_anomalies(name: str, t: np.ndarray, z: np.ndarray, rate: float, counts: bool) -> Iterator[Anomaly]:
    valid = np.isfinite(z)
    count = int(valid.sum())
    if count < MIN_READINGS:
        return
    own = np.zeros(len(z))
    own[valid] = z[valid] if counts else normal_scores(z[valid])
    limit = OUTLIER_MARGIN * float(scipy.stats.norm.isf(FALSE_ALARM_PROBABILITY / count / 2))
    k = int(np.argmax(np.abs(own)))
    if abs(own[k]) > limit:
        yield Anomaly(name, "jump", t[k], t[k], None, abs(own[k]) / limit)
    square_variance = max(float(np.mean(own[valid] ** 4)) / float(np.mean(own[valid] ** 2)) ** 2 - 1, 1.0)
    for width in WINDOWS_S:
        yield from _window_anomalies(name, t, own, valid, round(width * rate), square_variance)
    if not counts:
        yield from _tone(name, own, rate, (0.0, np.inf), TONE_MARGIN)


def _window_anomalies(
    name: str, t: np.ndarray, z: np.ndarray, valid: np.ndarray, width: int, square_variance: float
) -> Iterator[Anomaly]:
    """Find a burst, by a window's sum of squares, and a drift, by its sum.

    square_variance: variance of the squared innovations.
    """
    n = len(z) // width
    if n < MIN_WINDOWS:
        return
    squares, sums, counts = (x[: n * width].reshape(n, width).sum(axis=1) for x in (z**2, z, valid.astype(float)))
    enough = counts >= MIN_WINDOW_READINGS
    if not enough.any():
        return
    limit = float(scipy.stats.norm.isf(FALSE_ALARM_PROBABILITY / n))
    level = np.median(squares[enough] / counts[enough])
    burst_statistic = np.where(
        enough, (squares / np.maximum(counts, 1) / max(level, 1.0) - 1) * np.sqrt(counts / square_variance), 0.0
    )
    k = int(np.argmax(burst_statistic))
    # The sum of squares over a narrow window is skewed: use chi-squared.
    freedom = 2 * max(float(counts[k]), 1.0) / square_variance
    chi2_limit = (float(scipy.stats.chi2.isf(FALSE_ALARM_PROBABILITY / n, freedom)) / freedom - 1) * np.sqrt(
        freedom / 2
    )
    systematic = squares[k] > MIN_SYSTEMATIC_MEAN_SQUARE * counts[k]
    if systematic and burst_statistic[k] > max(limit * BURST_MARGIN, chi2_limit):
        yield Anomaly(name, "burst", t[k * width], t[(k + 1) * width - 1], None, burst_statistic[k] / limit)
    drift_statistic = np.where(enough, np.abs(sums) / np.sqrt(np.maximum(counts, 1)), 0.0)
    k = int(np.argmax(drift_statistic))
    if drift_statistic[k] > limit * DRIFT_MARGIN:
        yield Anomaly(name, "drift", t[k * width], t[(k + 1) * width - 1], None, drift_statistic[k] / limit)


def _tone(name: str, x: np.ndarray, rate: float, band: tuple[float, float], margin: float) -> Iterator[Anomaly]:
    """Find a spectral line in a band (shares of the rate).

    margin: factor on the threshold, for spectra not quite flat.
    """
    line = strongest_line(x, rate, band[0] * rate, band[1] * rate, margin)
    if line is not None:
        yield Anomaly(name, "tone", 0.0, len(x) / rate, *line)


def _stuck_counts(sensor: Sensor, t: np.ndarray, value: np.ndarray) -> Iterator[Anomaly]:
    """Find counts that stand still for a sample between samples with several counts."""
    step = np.abs(np.diff(value)) / float(sensor.resolution or 1)
    still = step < 0.5
    around = np.minimum(step[:-2], step[2:])
    bad = np.flatnonzero(still[1:-1] & (around > MIN_STUCK_COUNTS))
    if len(bad) >= MIN_STUCK_SAMPLES:
        yield Anomaly(sensor.name, "stuck", t[bad[0] + 2], t[bad[-1] + 2], None, len(bad) / MIN_STUCK_SAMPLES)


def _value_bands(name: str, t: np.ndarray, value: np.ndarray) -> Iterator[Anomaly]:
    """Find values of a channel that occur only in every other band of one width: a bit of the converter is stuck."""
    x = np.sort(value)
    gap = np.diff(x)
    usual = scipy.ndimage.median_filter(gap, HOLE_NEIGHBOURS, mode="nearest") / np.log(2)
    holes = np.flatnonzero((usual > 0) & (gap > MIN_HOLE_RATIO * usual))
    if len(holes) < MIN_HOLES:
        return
    width = float(np.median(gap[holes]))
    place = (x[holes] + gap[holes] / 2) / (2 * width)
    # The width is too large by the usual gap, and so is the spacing from hole to hole.
    spacing = np.diff(place)
    spacing /= np.maximum(np.round(spacing), 1.0)
    period = float(np.median(spacing))
    regular = (np.abs(spacing - period) < HOLE_SPACING_TOLERANCE) & (
        np.abs(gap[holes][1:] / width - 1) < 2 * HOLE_SPACING_TOLERANCE
    )
    # A stuck bit cuts values off where they are dense; noise about the levels of a stepped torque fades.
    neighbours = np.add.outer(holes, [*range(-EDGE_GAPS, 0), *range(1, EDGE_GAPS + 1)])
    around = scipy.ndimage.median_filter(gap, EDGE_REFERENCE_GAPS, mode="nearest")[holes] / np.log(2)
    edges = gap[np.clip(neighbours, 0, len(gap) - 1)].mean(axis=1) / np.maximum(around, np.finfo(float).tiny)
    is_sharp, is_regular = (
        np.median(edges) <= MAX_EDGE_RATIO,
        regular.sum() >= max(MIN_HOLES - 1, MIN_REGULAR_SHARE * len(regular)),
    )
    if is_sharp and is_regular and abs(period - 1) < HOLE_SPACING_TOLERANCE:
        yield Anomaly(name, "bands", t[0], t[-1], None, len(holes) / MIN_HOLES)


def _torque_anomalies(name: str, t: np.ndarray, u: np.ndarray, rate: float) -> Iterator[Anomaly]:
    """Find tones above an actuator's bandwidth and windows of louder noise in a torque channel."""
    yield from _tone(name, u, rate, TORQUE_TONE_BAND, TORQUE_TONE_MARGIN)
    noise = white_noise(u)
    third_difference = np.diff(u, 3) / (np.sqrt(20) * max(noise, 1e-12))
    width = round(WINDOWS_S[1] * rate)
    n = len(third_difference) // width
    if n < MIN_WINDOWS:
        return
    level = np.median(third_difference[: n * width].reshape(n, width) ** 2, axis=1) / MEDIAN_SQUARE
    # The logarithm of a window's median square is about normal.
    limit = float(
        np.exp(scipy.stats.norm.isf(FALSE_ALARM_PROBABILITY / n) * LOG_MEDIAN_SQUARE_SCATTER / np.sqrt(width))
    )
    k = int(np.argmax(level))
    if level[k] > limit and level[k] > MIN_SYSTEMATIC_MEAN_SQUARE:
        yield Anomaly(name, "burst", t[k * width], t[(k + 1) * width - 1], None, level[k] / limit)
