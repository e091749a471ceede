"""Readings at uneven times moved onto an even grid, noise and encoder edges as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # scipy.signal is loaded when it is used

ON_GRID = 0.02  # of a step: readings this close to a grid's time are kept as they are; chosen
WINDOW = 7  # grid points of the local cubic along which readings are moved; passes a fifth of the grid's rate
ORDER = 3
LONGEST_EDGE_STEPS = 2.5  # usual steps within which an edge was passed at a moment that is known well enough; chosen


@dataclass(frozen=True)
class Resampled:
    """Columns (m, c) on even steps, which rows (m,) no reading stands behind, as they are interpolated, and whether any
    reading was moved."""

    values: np.ndarray
    filled: np.ndarray
    moved: bool


def on_grid(t: np.ndarray, values: np.ndarray, start: float, step: float, rows: int) -> Resampled:
    """Bring readings (n, c) at times t (n,) [s], which don't go back, onto `rows` even steps from start.

    Readings at a grid's time (within ON_GRID of a step) are kept as they are. Any other is moved from its own time to
    the nearest of the grid along a smooth curve through its neighbours (Savitzky and Golay, Anal. Chem. 36 (1964)
    1627: a cubic over WINDOW points): noise and counts stay what they are, white and as large, where straight lines
    between readings would make them smaller and correlated. Several readings near one time are averaged. Where there
    is none, the value is interpolated linearly, and `filled`.
    """
    place = (t - start) / step
    near = np.rint(np.clip(place, -1.0, float(rows))).astype(int)  # rows at times beyond the grid are left out
    off = (place - near) * step
    inside = (near >= 0) & (near < rows)
    exact = bool((np.abs(off[inside]) <= ON_GRID * step).all())
    count = np.bincount(near[inside], minlength=rows)
    filled = count == 0
    moved = not exact or count.max(initial=0) > 1
    if not moved:
        result = np.empty((rows, values.shape[1]))
        result[near[inside]] = values[inside]
    else:
        result = _moved(t, values, start + step * np.arange(rows), near, off, inside, count)
    if filled.any():
        holes, there = np.flatnonzero(filled), np.flatnonzero(~filled)
        for column in result.T:
            column[holes] = np.interp(holes, there, column[there])
    return Resampled(result, filled, moved)


def _moved(
    t: np.ndarray,
    values: np.ndarray,
    grid: np.ndarray,
    near: np.ndarray,
    off: np.ndarray,
    inside: np.ndarray,
    count: np.ndarray,
) -> np.ndarray:
    """Readings (n, c), `off` [s] after grid points `near` (n,), moved there and averaged; anything where there is
    none."""
    step = float(grid[1] - grid[0]) if len(grid) > 1 else 1.0
    result = np.empty((len(grid), values.shape[1]))
    at, by = near[inside], off[inside]
    some = np.maximum(count, 1)
    for k, x in enumerate(values.T):
        line = np.interp(grid, t, x)
        slope, bend = (
            scipy.signal.savgol_filter(line, WINDOW, ORDER, deriv, step, mode="interp")
            if len(grid) >= WINDOW
            else np.zeros(len(grid))
            for deriv in (1, 2)
        )
        back = x[inside] - by * (slope[at] + by / 2 * bend[at])
        result[:, k] = np.bincount(at, back, minlength=len(grid)) / some
    return result


def edges(t: np.ndarray, angle: np.ndarray, count: float, start: float, step: float, rows: int) -> np.ndarray:
    """Edges that an encoder passed, on `rows` even steps from start: (rows,), NaN where it passed none.

    t (n,) [s], angle (n,) as counted in whole counts of size `count`. Where the angle changes from one row to the next,
    it passed an edge at some moment between them, or the last of several right before the second. The edge is moved to
    where it would be if it had been passed half a step before the grid's time, so that even rows and uneven ones are
    read alike.
    """
    n = np.rint(angle / count)
    change = np.diff(n)
    dt = np.diff(t)
    k = np.flatnonzero((change != 0) & (dt > 0) & (dt < LONGEST_EDGE_STEPS * np.median(dt)))
    result = np.full(rows, np.nan)
    at = np.rint((t[k + 1] - start) / step).astype(int)
    k, at = k[(at >= 0) & (at < rows)], at[(at >= 0) & (at < rows)]
    if not len(k) or rows < WINDOW:
        return result
    grid = start + step * np.arange(rows)
    line = np.interp(grid, t, angle)
    rate = scipy.signal.savgol_filter(line, WINDOW, ORDER, 1, step, mode="interp")[at]
    past = (np.clip(rate * dt[k], -count, count) - np.clip(rate * step, -count, count)) / 2
    result[at] = (n[k + 1] + (change[k] < 0)) * count + past + rate * (grid[at] - t[k + 1])
    return result
