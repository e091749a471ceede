"""A force or torque that no effect explains, as a smooth function of one signal: a cubic spline, written as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.interpolate

from excite.model.effects import MAP_NODES
from excite.model.machine import EffectEntry, Quantity
from excite.text import format_number, format_percent, format_uncertain

KNOTS = (MAP_NODES + 1) // 2  # of a curve: every second node of its table
FUNCTIONS = KNOTS + 2  # cubic B-splines of a curve
CURVE_POINTS = 41  # of a curve


@dataclass(frozen=True)
class Curve:
    """A smooth function of one signal that a model lacks.

    row: name and unit of the torque sensor, or name of the joint or contact. signal: name and unit. at (M,) [signal's
    unit]. value, std (M,) [row's unit]: of a diagnosis by regression, without what parameters explain as well. percent:
    by how much the error of that torque on withheld stretches is smaller, with its 95 % interval; of soil, the error of
    all signals with all curves. entry: the curve as a table in the machine file, with its relative standard deviation.
    lacks: what the model lacks. together: number of curves that have this gain together, 1 for a torque's own.
    """

    row: tuple[str, str]
    signal: tuple[str, str]
    at: np.ndarray
    value: np.ndarray
    std: np.ndarray
    percent: float
    interval: tuple[float, float]
    entry: EffectEntry
    lacks: str = "a torque"
    together: int = 1

    def __str__(self) -> str:
        low, high = int(np.argmin(self.value)), int(np.argmax(self.value))
        (row, unit), (signal, of) = self.row, self.signal
        ends = " to ".join(
            f"{format_uncertain(self.value[k], self.std[k], unit)} at {format_number(self.at[k], 3)} {of}"
            for k in sorted((low, high))
        )
        with_it = "this curve its" if self.together == 1 else f"all {self.together} curves the"
        return (
            f"{row} lacks {self.lacks} that depends on {signal}: {ends}; with {with_it} error on withheld stretches is"
            f" {format_percent(self.percent)} smaller (95 %: {format_number(self.interval[0], 2)} to"
            f" {format_percent(self.interval[1])})"
        )


def spline_knots(along: Sequence[np.ndarray]) -> np.ndarray:
    """Return quantiles (KNOTS,) of a signal along all logs."""
    return np.asarray(np.quantile(np.concatenate(list(along)), np.linspace(0, 1, KNOTS)))


def spline_basis(values: np.ndarray, along: Sequence[np.ndarray]) -> np.ndarray:
    """Evaluate cubic B-splines (n, FUNCTIONS) with knots at quantiles of a signal along all logs."""
    inner = spline_knots(along)
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    inside = np.clip(values, inner[0], inner[-1])
    return np.asarray(scipy.interpolate.BSpline.design_matrix(inside, knots, 3).toarray())


def table_nodes(along: Sequence[np.ndarray]) -> np.ndarray:
    """Return the nodes (MAP_NODES,) of a table of a curve: its knots, and midway between them."""
    knots = spline_knots(along)
    x = np.unique(np.concatenate([knots, (knots[1:] + knots[:-1]) / 2]))
    while len(x) < MAP_NODES:  # knots coincide where the signal rests
        widest = int(np.argmax(np.diff(x)))
        x = np.insert(x, widest + 1, x[widest : widest + 2].mean())
    return x


def curve_points(along: Sequence[np.ndarray]) -> np.ndarray:
    """Return the points (CURVE_POINTS,) at which a curve is drawn: all of its signal but the extremes."""
    low, high = (float(x) for x in np.quantile(np.concatenate(list(along)), [0.01, 0.99]))
    return np.linspace(low, high, CURVE_POINTS)


def relative_std(value: np.ndarray, std: np.ndarray) -> Quantity:
    """Return the standard deviation of a curve's amount, 1, from those of its values."""
    return Quantity(value=float(np.sqrt(np.mean(std**2) / np.mean(value**2))), source="identified")
