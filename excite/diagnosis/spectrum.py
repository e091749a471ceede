"""Spectral lines: a periodogram over its surroundings."""

from __future__ import annotations

import numpy as np
import scipy

NEIGHBOURS = 201  # ordinates of the periodogram whose median is the level about a peak; chosen
FALSE_ALARM_PROBABILITY = 1e-4  # of each test in one log; chosen
LOWEST = 1e-300  # level that divides nothing by zero


def strongest_line(
    x: np.ndarray, rate: float, low: float, high: float, margin: float, window: str = "boxcar"
) -> tuple[float, float] | None:
    """Find the strongest spectral line of a signal (N,) between two frequencies [Hz]; None if it is noise.

    The level at a frequency is the median of NEIGHBOURS ordinates, which are exponential for white noise (Fisher,
    1929). margin: factor on the threshold, for spectra not quite flat. Return the frequency [Hz] and the size over the
    threshold.
    """
    f, power = (a[2:] for a in scipy.signal.periodogram(x, rate, window=window))  # without mean and slowest motion
    level = scipy.ndimage.median_filter(power, NEIGHBOURS, mode="reflect") / np.log(2)
    ratio = np.where((f >= low) & (f <= high) & (level > 0), power / np.maximum(level, LOWEST), 0.0)
    limit = float(np.log(len(f) / FALSE_ALARM_PROBABILITY)) * margin
    k = int(np.argmax(ratio))
    return (float(f[k]), float(ratio[k]) / limit) if ratio[k] > limit else None
