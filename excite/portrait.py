"""Figures of a diagnosis: what the model misses against all that the machine does, before and after."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from excite import misfit
from excite.figures import COLOURS, plain, save
from excite.findings import Account
from excite.misfit import Course
from excite.sidebyside import Together, in_turn

BEFORE, AFTER = COLOURS[1], COLOURS[0]
SHOWN, WIDE = 3, 4  # torques and forces in a figure, panels side by side
CLEAR = 4.0  # strength from which a quantity is pointed out
HIGHEST = 30.0  # mean square of innovations at which the colours end


def write(
    place: Path, a: Account, signals: Mapping[str, Mapping[str, Any]], title: str, together: Together = in_turn
) -> None:
    """The figures of a diagnosis into its folder: misfit.png and when.png for each log, signals.png for all."""
    several = len(a.before) > 1
    found = bool(a.diagnosis.stages)
    drawn: dict[str, Callable[[], Figure]] = {}
    for k, before in enumerate(a.before):
        name, words = f"-{k + 1}" if several else "", f"{title}: {Path(before.source).name}"
        shown = [side[k] for side in a.missing]
        drawn[f"misfit{name}.png"] = partial(misfit_figure, shown[0], shown[1] if found else None, words)
        drawn[f"when{name}.png"] = partial(when_figure, before, a.after[k] if found else None, words)
    drawn["signals.png"] = partial(signals_figure, a, signals, title)
    for _ in together([partial(_drawn, figure, place / name) for name, figure in drawn.items()]):
        pass


def _drawn(figure: Callable[[], Figure], path: Path) -> None:
    save(figure(), path)


def misfit_figure(before: Course, after: Course | None, title: str) -> Figure:
    """What is missing most, at most SHOWN torques and forces, against everything that the machine does, and its
    spectrum. A thick frame: against this it shows most clearly."""
    evidence = {row: {q: misfit.strength(before, row, q) for q in before.quantities} for row in before.missing}
    rows = sorted(evidence, key=lambda row: -max(evidence[row].values()))[:SHOWN]
    panels = max(sum(row in v for _, v in before.quantities.values()) for row in rows) + 1
    lines = -(-panels // WIDE)
    figure = Figure(figsize=(11.5, (1.75 * lines + 0.35) * len(rows) + 0.7), layout="constrained")
    figure.suptitle(plain(title), fontsize=11)
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for part, row in zip(parts, rows, strict=True):
        unit = before.missing[row][1]
        part.suptitle(f"missing {row} [{unit}]", fontsize=9.5, x=0.01, ha="left")
        axes = part.subplots(lines, WIDE).ravel()
        own = [q for q, (_, values) in before.quantities.items() if row in values]
        clearest = max(own, key=lambda q: evidence[row][q])
        for ax, name in zip(axes, own, strict=False):
            _against(ax, before, after, row, name)
            ax.set_xlabel(f"{name.replace('_', ' ')} [{before.quantities[name][0]}]", fontsize=8, labelpad=1)
            if name == clearest and evidence[row][name] > CLEAR:
                for spine in ax.spines.values():
                    spine.set_linewidth(2.2)
        _spectrum(axes[len(own)], before, after, row)
        for ax in axes[: len(own) + 1]:
            ax.tick_params(labelsize=7)
        for ax in axes[len(own) + 1 :]:
            ax.axis("off")
    first = figure.add_axes((0, 0, 0.001, 0.001))
    first.axis("off")
    first.plot([], [], color=BEFORE, label="without what was found" if after is not None else "missing (mean)")
    if after is not None:
        first.plot([], [], color=AFTER, linestyle="--", label="with it")
    if any(np.isfinite(before.missing[row][2]) for row in rows):
        first.fill_between([], [], [], color="0.8", label="what noise alone leaves")
    figure.legend(*first.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def _against(ax: Axes, before: Course, after: Course | None, row: str, column: str) -> None:
    y, _, sigma = before.missing[row]
    x = before.quantities[column][1][row]
    centre, mean, band = misfit.binned(x, y, sigma if np.isfinite(sigma) else 0.0)
    if np.isfinite(sigma):
        ax.fill_between(centre, -band, band, color="0.8", linewidth=0)
    ax.axhline(0, color="black", linewidth=0.6)
    ax.plot(centre, mean, color=BEFORE, linewidth=1.4, marker="." if len(centre) < 8 else None)
    if after is not None and row in after.missing:
        at = after.quantities[column][1].get(row)
        if at is not None:
            centre, mean, _ = misfit.binned(at, after.missing[row][0], 0.0)
            ax.plot(centre, mean, color=AFTER, linewidth=1.4, linestyle="--")
    ax.grid(alpha=0.3)


def _spectrum(ax: Axes, before: Course, after: Course | None, row: str) -> None:
    f, size = misfit.spectrum(before, before.missing[row][0])
    ax.loglog(f, size, color=BEFORE, linewidth=1.0)
    if after is not None and row in after.missing:
        f, size = misfit.spectrum(after, after.missing[row][0])
        ax.loglog(f, size, color=AFTER, linewidth=1.0, linestyle="--")
    ax.set_xlabel(f"frequency [Hz], up: {before.missing[row][1]}/√Hz", fontsize=8, labelpad=1)
    ax.grid(alpha=0.3)


def when_figure(before: Course, after: Course | None, title: str) -> Figure:
    """When and in which signal: innovations over time, 1 is noise; and where in speed and steering or torque."""
    shown = [(before, "without what was found" if after is not None else "")]
    if after is not None:
        shown.append((after, "with it"))
    m = len(before.sensors)
    figure = Figure(figsize=(12, (0.34 * m + 1.7) * len(shown) + 0.6), layout="constrained")
    figure.suptitle(plain(title), fontsize=11)
    axes = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(2.2, 1), sharex="col")
    norm = LogNorm(1 / 3, HIGHEST)
    picture = None
    for k, (course, words) in enumerate(shown):
        t, size = misfit.over_time(course)
        ax = axes[k, 0]
        step = misfit.BLOCK_S / 2
        picture = ax.pcolormesh(
            np.append(t - step, t[-1] + step), np.arange(m + 1), size, norm=norm, cmap="inferno_r", rasterized=True
        )
        ax.set_yticks(np.arange(m) + 0.5, course.sensors, fontsize=9)
        ax.invert_yaxis()
        ax.set_title(f"when, in which signal {f'({words})' if words else ''}", fontsize=9, loc="left")
        _map(axes[k, 1], course, norm)
    axes[-1, 0].set_xlabel("time [s]")
    assert picture is not None
    bar = figure.colorbar(picture, ax=axes[:, 1], ticks=[0.5, 1, 2, 5, 10, 20])
    bar.ax.set_yticklabels(["0.5", "1: noise", "2", "5", "10", "20"])
    bar.set_label("mean square error of one step ahead,\nin units of noise", fontsize=9)
    return figure


def _map(ax: Axes, course: Course, norm: LogNorm) -> None:
    """Where in the state space: speed across, steering angle (or torque where nothing steers) up."""
    names = list(course.quantities)
    up = next((n for n in names if n.endswith(" angle")), None)
    up = up or next(n for n in names if n in ("torque", "force"))
    (x_unit, xs), (y_unit, ys) = course.quantities["speed"], course.quantities[up]
    x, y = next(iter(xs.values())), next(iter(ys.values()))
    z = course.innovations**2
    told = np.isfinite(z)
    bins = [_edges(x), _edges(y)]
    total = np.histogram2d(x, y, bins, weights=np.where(told, z, 0.0).sum(axis=1))[0]
    count = np.histogram2d(x, y, bins, weights=told.sum(axis=1).astype(float))[0]
    mean = np.where(count >= misfit.FEWEST, total / np.maximum(count, 1), np.nan)
    ax.pcolormesh(*bins, mean.T, norm=norm, cmap="inferno_r", rasterized=True)
    ax.set_title("where, over all signals", fontsize=9, loc="left")
    ax.set_xlabel(f"speed [{x_unit}]")
    ax.set_ylabel(f"{up.replace('_', ' ')} [{y_unit}]", fontsize=9)


def _edges(x: np.ndarray) -> np.ndarray:
    """Edges of bins that hold all but the outermost values."""
    low, high = (float(v) for v in np.quantile(x, (0.002, 0.998)))
    return np.arange(17) / 16 * (max(high - low, 1e-9)) + low


def signals_figure(a: Account, signals: Mapping[str, Mapping[str, Any]], title: str) -> Figure:
    """Signal by signal: how much of the error is systematic, and errors on withheld stretches, before and after."""
    names = list(signals)
    found = bool(a.diagnosis.stages)
    figure = Figure(figsize=(11, 0.5 * len(names) + 1.9), layout="constrained")
    figure.suptitle(plain(title), fontsize=11)
    left, right = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(names))[::-1].astype(float)
    kinds = (("before", BEFORE, 0.2, ""), ("after", AFTER, -0.2, "//")) if found else (("before", BEFORE, 0.0, ""),)
    for kind, colour, shift, hatch in kinds:
        words = {"before": "without what was found" if found else "the model", "after": "with it"}[kind]
        share = [signals[n][f"systematic_{kind}_percent"] for n in names]
        height = 0.36 if found else 0.6
        left.barh(places + shift, share, height=height, color=colour, hatch=hatch, edgecolor="white", label=words)
        rms = np.array([signals[n][f"rms_{kind}"] or np.nan for n in names], float)
        base = np.array([signals[n]["rms_before"] or np.nan for n in names], float)
        ratio = 100 * rms / base
        right.barh(places + shift, ratio, height=height, color=colour, hatch=hatch, edgecolor="white")
        for y, value, n in zip(places + shift, rms, names, strict=True):
            if np.isfinite(value):
                right.annotate(
                    f"{value:.3g} {signals[n]['unit']}",
                    (0, y),
                    xytext=(4, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=8,
                    bbox={"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
                )
    left.set_yticks(places, names)
    left.set_xlim(0, 100)
    left.set_xlabel("systematic share of the error one step ahead [%]")
    right.set_xlabel("error on withheld stretches [% of that without]")
    if not any(np.isfinite(row["rms_before"] or np.nan) for row in signals.values()):
        right.set_axis_off()
        none = (
            "no error on withheld stretches:\nno fit to the rest of the log was found,\nor it is too short to hide any"
        )
        right.text(0.5, 0.5, none, transform=right.transAxes, ha="center", va="center", fontsize=9)
    for ax in (left, right):
        ax.grid(axis="x", alpha=0.3)
        ax.set_axisbelow(True)
    if found:
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure
