"""Spectral lines: a periodogram over its surroundings."""

from __future__ import annotations

import numpy as np
import scipy

LOWEST = 1e-300  # level that divides nothing by zero


def line_ratios(x: np.ndarray, rate: float, window: str, neighbours: int, skip: int = 0) -> tuple[np.ndarray, ...]:
    """Return frequencies (n,) [Hz], the periodogram over its level there, and that level, of a signal (N,).

    The level is the median of `neighbours` ordinates, which are exponential for white noise (Fisher, 1929). skip:
    ordinates at the lowest frequencies that are left out.
    """
    f, power = scipy.signal.periodogram(x, rate, window=window)
    f, power = f[skip:], power[skip:]
    level = scipy.ndimage.median_filter(power, neighbours, mode="reflect") / np.log(2)
    return f, power / np.maximum(level, LOWEST), level
