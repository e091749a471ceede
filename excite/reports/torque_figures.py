"""Figures of a diagnosis of torques: their errors; and, of any diagnosis, curves of what its model lacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from excite.diagnosis import Curve, Diagnosis, TorqueDiagnosis
from excite.reports.figure_files import layout_width
from excite.reports.figures import COLOURS, is_narrow, legend_below, letters_along, new_figure, set_title, wrap_label

BEFORE, AFTER = COLOURS[1], COLOURS[0]
MAX_TORQUES = 4  # with the largest errors, in the figure; chosen
BINS = 40  # of time or speed in a panel; chosen
MAX_COLUMNS, MIN_CURVE_IN = 3, 3.0  # curves side by side, and the width of one [in]; chosen


def torque_figures_by_file(d: TorqueDiagnosis, title: str) -> dict[str, Callable[[], Figure]]:
    """Return what draws misfit.png and, where there are curves, curves.png."""
    return {"misfit.png": partial(misfit_of_torques, d, title), **curves_by_file(d, title)}


def curves_by_file(d: Diagnosis | TorqueDiagnosis, title: str) -> dict[str, Callable[[], Figure]]:
    """Return what draws curves.png, if there are curves."""
    return {"curves.png": partial(curves_figure, d.curves, title)} if d.curves else {}


def misfit_of_torques(d: TorqueDiagnosis, title: str) -> Figure:
    """Plot the error of each torque over time, and against the speed of its joint, without and with the findings."""
    model, before, after = d.after.model, d.before, d.after
    names = d.torques
    rows = list(model.actuated)
    order = sorted(range(len(rows)), key=lambda k: -before.level[rows[k]] / before.lowest[rows[k]])[:MAX_TORQUES]
    narrow = is_narrow(10.0)
    figure = new_figure(10.0, 0.9 + (3.4 if narrow else 2.0) * len(order))
    letters = letters_along((float(figure.get_figheight()) - 0.9) / len(order) / (2 if narrow else 1) - 0.4, 22)
    grid: Any = figure.subplots(len(order) * (2 if narrow else 1), 1 if narrow else 2, squeeze=False)
    axes = grid.reshape(len(order), 2)
    for (over_time, over_speed), k in zip(axes, order, strict=True):
        name, unit = names[k]
        row, body = rows[k], model.machine.actuated[k]
        turns = body.joint == "revolute"
        for fit, colour, label in ((before, BEFORE, "without findings"), (after, AFTER, "with findings")):
            if fit is after and not d.findings:
                continue
            start = 0.0
            for log, r in enumerate(fit.rows):
                t = r.t[r.at]
                at, size = _means(t, fit.residual[log][row] ** 2, r.used[row])
                over_time.plot(start + at, np.sqrt(size), color=colour, label=label if log == 0 else None)
                start += t[-1]
            speed = np.concatenate([r.nu[r.at, row] for r in fit.rows])
            error = np.concatenate([e[row] for e in fit.residual])
            used = np.concatenate([r.used[row] for r in fit.rows])
            at, mean = _means(speed, error, used)
            over_speed.plot(at, mean, ".-", color=colour, label=label)
        over_time.axhline(after.lowest[row], color="0.5", linestyle="--", label="sensors' noise")
        over_speed.axhline(0.0, color="0.5", linewidth=0.8)
        over_time.set_ylabel(wrap_label(f"rms error of {name} [{unit}]", letters))
        over_time.set_ylim(bottom=0.0)
        over_speed.set_ylabel(wrap_label(f"mean error of {name} [{unit}]", letters))
        signal = f"speed of {body.where.replace('_', ' ')} [{'rad/s' if turns else 'm/s'}]"
        over_speed.set_xlabel(wrap_label(signal, 44), fontsize=9)
    axes[-1, 0].set_xlabel("time [s]" if len(d.sources) == 1 else "time, one log after the other [s]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    legend_below(figure, handles, labels)
    set_title(figure, f"{title}: errors of the torques along the measured motion")
    for ax in figure.axes:
        ax.tick_params(labelsize=8)
        ax.yaxis.label.set_fontsize(8)
    return figure


def _means(x: np.ndarray, y: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of y in bins with equally many samples x."""
    x, y = x[used], y[used]
    if not len(x):
        return x, y
    order = np.argsort(x, kind="stable")
    parts = [part for part in np.array_split(order, min(BINS, len(order))) if len(part)]
    return np.array([x[p].mean() for p in parts]), np.array([y[p].mean() for p in parts])


def curves_figure(curves: Sequence[Curve], title: str) -> Figure:
    """Plot what each joint or contact lacks as a function of one signal, with its 95 % band."""
    columns = min(MAX_COLUMNS, len(curves))
    own = max(3.6 * columns + 0.4, 6.4)
    columns = min(columns, max(1, int(layout_width(own) / MIN_CURVE_IN)))
    lines = -(-len(curves) // columns)
    figure = new_figure(own, 2.6 * lines + 0.9)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for axis, curve in zip(axes, curves, strict=False):
        _draw_curve(axis, curve)
    for axis in axes[len(curves) :]:
        axis.set_axis_off()
    set_title(figure, f"{title}: what the model lacks, mean and 95 % band")
    return figure


def _draw_curve(axis: Axes, curve: Curve) -> None:
    (row, unit), (signal, of) = curve.row, curve.signal
    axis.fill_between(
        curve.at, curve.value - 1.96 * curve.std, curve.value + 1.96 * curve.std, color=AFTER, alpha=0.25, linewidth=0
    )
    axis.plot(curve.at, curve.value, color=AFTER)
    axis.axhline(0.0, color="0.5", linewidth=0.8)
    axis.set_xlabel(
        wrap_label(f"{signal.removeprefix('the ').removeprefix('its ').replace('_', ' ')} [{of}]", 34), fontsize=9
    )
    missing = "missing" if curve.lacks == "a torque" else curve.lacks.removeprefix("a ").replace("its ", "")
    axis.set_ylabel(wrap_label(f"{missing} in {row} [{unit}]", 28), fontsize=9)
    axis.tick_params(labelsize=8)
