"""Figures of a diagnosis: missing torques, innovations and errors by signal, before and after the findings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from excite import diagnosis
from excite.diagnosis import Diagnosis, LogResiduals, TorqueDiagnosis
from excite.model import signal_descriptions
from excite.reports.charts import EXPLORE, Explorable
from excite.reports.figure_files import layout_height, layout_width, wrap_title
from excite.reports.figures import (
    COLOURS,
    TITLE_SIZE,
    is_narrow,
    legend_below,
    legend_columns,
    new_figure,
    save,
    set_title,
    wrap_label,
)
from excite.reports.torque_figures import curves_by_file, torque_figures_by_file
from excite.text import format_number

BEFORE, AFTER = COLOURS[1], COLOURS[0]
MAX_ROWS = 3  # torques and forces in a figure; chosen
MAX_COLUMNS = 4  # panels side by side; chosen
# Sizes are given in inches: measuring all labels would take as long as drawing them.
PANEL = 2.9, 1.8  # width and height with labels
MIN_PANEL_IN = 2.2  # width of a panel; chosen
TITLE_LINE_IN = 0.2  # of a title or legend
INSET = 0.62, 0.42, 0.1, 0.14  # room for labels: left, below, right, above
HEAD = 0.28  # above the panels of one torque or force
EDGE = 0.35  # for the title, and for the legend
SIGNAL_LETTERS, SIGNAL_LETTERS_NARROW = 40, 26  # of a signal's name in a line; chosen
MAP_IN = 1.6  # height of a map below a course over time; chosen
MISSING_LETTERS = 36  # of the label of a missing torque in a line; chosen
MAP_INTERVALS = 3  # between ticks of speed, at most; chosen
PLAIN_POWERS = -3, 5  # powers of ten that axes write without an exponent; chosen
CLEAR_STRENGTH = 4.0  # strength of a dependence from which its panel gets a thick frame; chosen
MAX_CLEAR, MIN_CLEAR = 4, 2  # dependences drawn large: that are clear, if none is; chosen
MAX_INNOVATION = 30.0  # mean square of innovations at which the colours end; chosen


def figure_calls(place: Path, d: Diagnosis | TorqueDiagnosis, title: str) -> list[Callable[[], dict[str, Explorable]]]:
    """Return independent calls that draw the figures of a diagnosis into its folder, and return what charts show.

    clearest.png, misfit.png and when.png of each log, misfit.png alone of one by regression; curves.png where there
    are curves.
    """
    if isinstance(d, TorqueDiagnosis):
        return [partial(_save, draw, place / file) for file, draw in figures_by_file(d, title).items()]
    curves = [partial(_save, draw, place / file) for file, draw in curves_by_file(d, title).items()]
    return [*(partial(_draw, place, d, title, kinds) for kinds in TOGETHER), *curves]


def figures_by_file(d: Diagnosis | TorqueDiagnosis, title: str) -> dict[str, Callable[[], Figure]]:
    """Return for each file that `figure_calls` writes what draws it alone."""
    if isinstance(d, TorqueDiagnosis):
        return torque_figures_by_file(d, title)
    n = len(d.before.data.logs)
    own = {_file(kind, k, n): partial(_one, d, title, kind, k) for kind in KINDS for k in range(n)}
    return own | curves_by_file(d, title)


def _save(draw: Callable[[], Figure], file: Path) -> dict[str, Explorable]:
    return {file.name: save(draw(), file)}


def _file(kind: str, k: int, n: int) -> str:
    return f"{kind}-{k + 1}.png" if n > 1 else f"{kind}.png"


def _one(d: Diagnosis, title: str, kind: str, k: int) -> Figure:
    return next(islice(_figures(d, title, (kind,)), k, None))[1]


def _draw(place: Path, d: Diagnosis, title: str, kinds: Sequence[str]) -> dict[str, Explorable]:
    """Draw some of the figures of every log."""
    return {file: save(one, place / file) for file, one in _figures(d, title, kinds)}


def _figures(d: Diagnosis, title: str, kinds: Sequence[str]) -> Iterator[tuple[str, Figure]]:
    """Yield some of the figures for every log, each with its file."""
    before, after = d.before, d.after
    without = diagnosis.residuals_of_logs(before)
    beside = diagnosis.residuals_of_logs(after) if d.extended else [None] * len(without)
    draws: dict[str, Callable[..., Figure]] = {
        **KINDS,
        "when": partial(when_figure, words=signal_descriptions(before.machine)),
    }
    for k, (old, new) in enumerate(zip(without, beside, strict=True)):
        for kind in kinds:
            yield _file(kind, k, len(without)), draws[kind](old, new, f"{title}: {Path(old.source).name}")


Evidence = dict[str, dict[str, float]]  # strength of the dependence of each torque or force on each quantity


def _evidence(before: LogResiduals) -> Evidence:
    return {
        row: {q: diagnosis.dependence_strength(before, row, q) for q in before.quantities} for row in before.missing
    }


def clearest_figure(before: LogResiduals, after: LogResiduals | None, title: str) -> Figure:
    """Plot the clearest dependences of missing torques and forces on the state of the machine, large."""
    evidence = _evidence(before)
    pairs = sorted(((row, q) for row in evidence for q in evidence[row]), key=lambda p: -evidence[p[0]][p[1]])
    clear = [p for p in pairs if evidence[p[0]][p[1]] > CLEAR_STRENGTH][:MAX_CLEAR] or pairs[:MIN_CLEAR]
    columns = 1 if is_narrow(5.2 * min(len(clear), 2)) else min(len(clear), 2)
    lines = -(-len(clear) // columns)
    figure = new_figure(5.2 * columns, (2.6 if is_narrow(5.2 * columns) else 3.3) * lines + 0.8)
    set_title(figure, title)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax, (row, quantity) in zip(axes, clear, strict=False):
        _against(ax, before, after, row, quantity)
        ax.set_gid(EXPLORE)
        ax.set_ylabel(wrap_label(f"missing {row} [{before.missing[row][1]}]", MISSING_LETTERS), fontsize=9)
        ax.xaxis.label.set_fontsize(9)
        ax.tick_params(which="both", labelsize=8)
    for ax in axes[len(clear) :]:
        ax.set_axis_off()
    legend_below(figure, *_key(before, after, [row for row, _ in clear]))
    return figure


def misfit_figure(before: LogResiduals, after: LogResiduals | None, title: str) -> Figure:
    """Plot the largest missing torques and forces against the state of the machine, and their spectra.

    A thick frame marks the quantity on which a torque depends most clearly. In print it has the torques that fit on a
    page.
    """
    evidence = _evidence(before)
    rows = sorted(evidence, key=lambda row: -max(evidence[row].values()))[:MAX_ROWS]
    width = layout_width(MAX_COLUMNS * PANEL[0])
    columns = max(1, min(MAX_COLUMNS, int(width / MIN_PANEL_IN)))
    panels = max(sum(row in v for _, v in before.quantities.values()) for row in rows) + 1
    lines = -(-panels // columns)
    figure = Figure(figsize=(width, 1.0))
    head = EDGE + TITLE_LINE_IN * wrap_title(figure, title, TITLE_SIZE).count("\n")
    key = _key(before, after, rows)
    side_by_side = legend_columns(key[1], width)
    foot = EDGE + TITLE_LINE_IN * (-(-len(key[1]) // side_by_side) - 1)
    room = layout_height(np.inf) - head - foot
    panel = width / columns, min(PANEL[1], (room - HEAD) / lines)
    block = HEAD + lines * panel[1]
    rows = rows[: int(min(len(rows), room / block))]
    height = len(rows) * block + head + foot
    figure.set_figheight(height)
    set_title(figure, title, y=1 - head / 2 / height, va="center")
    left, below, right, above = INSET
    share = (panel[0] - left - right) / width, (panel[1] - below - above) / height
    for k, row in enumerate(rows):
        top = height - head - k * block - HEAD
        words = f"missing {row} [{before.missing[row][1]}]"
        figure.text(0.01, (top + HEAD / 2) / height, wrap_title(figure, words, 9.5), fontsize=9.5, va="center")
        own = [q for q, (_, values) in before.quantities.items() if row in values]
        clearest = max(own, key=lambda q: evidence[row][q])
        for n, name in enumerate([*own, None]):
            down, across = divmod(n, columns)
            x, y = across * panel[0] + left, top - (down + 1) * panel[1] + below
            ax = figure.add_axes((x / width, y / height, *share))
            if name is None:
                _spectrum(ax, before, after, row)
            else:
                _against(ax, before, after, row, name)
            if name == clearest and evidence[row][name] > CLEAR_STRENGTH:
                for spine in ax.spines.values():
                    spine.set_linewidth(2.2)
            ax.tick_params(which="both", labelsize=8)
    figure.legend(*key, loc="lower center", ncols=side_by_side, fontsize=8, frameon=False)
    return figure


def _key(before: LogResiduals, after: LogResiduals | None, rows: Sequence[str]) -> tuple[list[Artist], list[str]]:
    """Return handles and labels of a legend."""
    words = "without what was found" if after is not None else "missing (mean)"
    key: dict[str, Artist] = {words: Line2D([], [], color=BEFORE)}
    if after is not None:
        key["with it"] = Line2D([], [], color=AFTER, linestyle="--")
    if any(np.isfinite(before.missing[row][2]) for row in rows):
        key["what noise alone leaves"] = Patch(color="0.8")
    return list(key.values()), list(key)


def _against(ax: Axes, before: LogResiduals, after: LogResiduals | None, row: str, column: str) -> None:
    y, _, sigma = before.missing[row]
    x = before.quantities[column][1][row]
    centre, mean, band = diagnosis.bin_means(x, y, sigma if np.isfinite(sigma) else 0.0)
    if np.isfinite(sigma):
        ax.fill_between(centre, -band, band, color="0.8", linewidth=0)
    ax.axhline(0, color="black", linewidth=0.6)
    ax.plot(
        centre,
        mean,
        color=BEFORE,
        linewidth=1.4,
        marker="." if len(centre) < 8 else None,
        label="without" if after is not None else "missing",
    )
    if after is not None and row in after.missing:
        at = after.quantities[column][1].get(row)
        if at is not None:
            centre, mean, _ = diagnosis.bin_means(at, after.missing[row][0], 0.0)
            ax.plot(centre, mean, color=AFTER, linewidth=1.4, linestyle="--", label="with the findings")
    ax.locator_params("x", nbins=MAP_INTERVALS, steps=(1, 2, 5, 10))
    ax.ticklabel_format(scilimits=PLAIN_POWERS, useOffset=False)
    for axis in (ax.xaxis, ax.yaxis):
        axis.get_offset_text().set_fontsize(8)
    ax.set_xlabel(f"{column.replace('_', ' ')} [{before.quantities[column][0]}]", fontsize=8, labelpad=1)
    ax.grid(alpha=0.3)


def _spectrum(ax: Axes, before: LogResiduals, after: LogResiduals | None, row: str) -> None:
    f, size = diagnosis.amplitude_spectrum(before, before.missing[row][0])
    ax.loglog(f, size, color=BEFORE, linewidth=1.0)
    if after is not None and row in after.missing:
        f, size = diagnosis.amplitude_spectrum(after, after.missing[row][0])
        ax.loglog(f, size, color=AFTER, linewidth=1.0, linestyle="--")
    ax.set_xlabel(f"frequency [Hz], up: {before.missing[row][1]}/√Hz", fontsize=8, labelpad=1)
    ax.grid(alpha=0.3)


def when_figure(
    before: LogResiduals, after: LogResiduals | None, title: str, words: Mapping[str, str] | None = None
) -> Figure:
    """Plot innovations over time by signal (1 is noise), and over speed and steering angle or torque."""
    shown = [(before, "without what was found" if after is not None else "")]
    if after is not None:
        shown.append((after, "with it"))
    m, narrow = len(before.sensors), is_narrow(12)
    letters = SIGNAL_LETTERS_NARROW if narrow else SIGNAL_LETTERS
    signals = [wrap_label((words or {}).get(n, n), letters) for n in before.sensors]
    block = max(m * (0.08 + 0.15 * max(1 + one.count("\n") for one in signals)), 1.6) + 0.6
    if narrow:
        height = (block + MAP_IN) * len(shown) + 0.8
        figure = new_figure(12, height)
        every: Any = figure.subplots(2 * len(shown), 1, height_ratios=(block, MAP_IN) * len(shown))
        axes = every.reshape(len(shown), 2)
    else:
        figure = new_figure(12, block * len(shown) + 0.6)
        axes = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(2.2, 1), sharex="col")
    set_title(figure, title)
    norm = LogNorm(1 / 3, MAX_INNOVATION)
    picture = None
    for k, (course, kind) in enumerate(shown):
        t, size = diagnosis.innovation_levels_over_time(course)
        ax = axes[k, 0]
        step = diagnosis.BLOCK_S / 2
        picture = ax.pcolormesh(
            np.append(t - step, t[-1] + step), np.arange(m + 1), size, norm=norm, cmap="inferno_r", rasterized=True
        )
        ax.set_yticks(np.arange(m) + 0.5, signals, fontsize=8)
        ax.invert_yaxis()
        heading = f"when, in which signal {f'({kind})' if kind else ''}"
        ax.set_title(wrap_label(heading, 38 if narrow else 60), fontsize=9, loc="left")
        _map(axes[k, 1], course, norm)
        for each in axes[k]:
            each.tick_params(labelsize=8)
    axes[-1, 0].set_xlabel("time [s]", fontsize=9)
    assert picture is not None
    ticks = {0.5: "0.5", 1: "1 = noise", 2: "2", 5: "5", 10: "10", 20: "20"}
    where: dict[str, Any] = {"location": "bottom", "aspect": 30, "pad": 0.01} if narrow else {"location": "right"}
    bar = figure.colorbar(picture, ax=axes.ravel() if narrow else axes[:, 1], **where)
    bar.set_ticks(list(ticks), labels=list(ticks.values()), fontsize=8)
    bar.set_label(wrap_label("mean square error one step ahead, over that of noise alone [-]", 30), fontsize=9)
    return figure


def _map(ax: Axes, course: LogResiduals, norm: LogNorm) -> None:
    """Plot innovations over speed and steering angle, or torque if nothing steers."""
    names = list(course.quantities)
    up = next((n for n in names if n.endswith(" angle")), None)
    up = up or next(n for n in names if n in ("torque", "force"))
    (x_unit, xs), (y_unit, ys) = course.quantities["speed"], course.quantities[up]
    x, y = next(iter(xs.values())), next(iter(ys.values()))
    z = course.innovations**2
    finite = np.isfinite(z)
    bins = [_edges(x), _edges(y)]
    total = np.histogram2d(x, y, bins, weights=np.where(finite, z, 0.0).sum(axis=1))[0]
    count = np.histogram2d(x, y, bins, weights=finite.sum(axis=1).astype(float))[0]
    mean = np.where(count >= diagnosis.MIN_BIN_SAMPLES, total / np.maximum(count, 1), np.nan)
    ax.set_gid(EXPLORE)
    ax.pcolormesh(*bins, mean.T, norm=norm, cmap="inferno_r", rasterized=True)
    ax.set_title("where, over all signals", fontsize=9, loc="left")
    ax.locator_params("x", nbins=MAP_INTERVALS)
    ax.set_xlabel(f"speed [{x_unit}]", fontsize=9)
    ax.set_ylabel(f"{up.replace('_', ' ')} [{y_unit}]", fontsize=9)


KINDS = {"clearest": clearest_figure, "misfit": misfit_figure, "when": when_figure}  # figures of each log
TOGETHER = (("clearest", "misfit"), ("when",))  # kinds that are drawn from the same fits


def _edges(x: np.ndarray) -> np.ndarray:
    """Return the edges of bins that hold all but the outermost values."""
    low, high = (float(v) for v in np.quantile(x, (0.002, 0.998)))
    return np.arange(17) / 16 * (max(high - low, 1e-9)) + low


def signals_figure(
    signals: Mapping[str, Mapping[str, Any]], found: bool, title: str, words: Mapping[str, str] | None = None
) -> Figure:
    """Plot the systematic share of each signal's error, and errors on withheld stretches, before and after.

    found: whether there are findings; without them only the errors before are plotted. words: what signals are called.
    """
    names, narrow = list(signals), is_narrow(11)
    letters = SIGNAL_LETTERS_NARROW if narrow else SIGNAL_LETTERS
    called = [wrap_label((words or {}).get(n, n), letters) for n in names]
    block = 0.2 * len(names) + 0.2 * sum(1 + one.count("\n") for one in called)
    figure = new_figure(11, 2 * block + 2.8 if narrow else block + 1.9)
    set_title(figure, title)
    left, right = figure.subplots(2, 1) if narrow else figure.subplots(1, 2, sharey=True)
    places = np.arange(len(names))[::-1].astype(float)
    kinds = (("before", BEFORE, 0.2, ""), ("after", AFTER, -0.2, "//")) if found else (("before", BEFORE, 0.0, ""),)
    for kind, colour, shift, hatch in kinds:
        label = {"before": "without what was found" if found else "the model", "after": "with it"}[kind]
        share = [signals[n][f"systematic_{kind}_percent"] for n in names]
        height = 0.36 if found else 0.6
        left.barh(places + shift, share, height=height, color=colour, hatch=hatch, edgecolor="white", label=label)
        rms = np.array([signals[n][f"rms_{kind}"] or np.nan for n in names], float)
        base = np.array([signals[n]["rms_before"] or np.nan for n in names], float)
        ratio = 100 * rms / base
        right.barh(places + shift, ratio, height=height, color=colour, hatch=hatch, edgecolor="white")
        for y, value, n in zip(places + shift, rms, names, strict=True):
            if np.isfinite(value):
                right.annotate(
                    f"{format_number(value, 3)} {signals[n]['unit']}",
                    (0, y),
                    xytext=(4, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=8,
                    bbox={"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
                )
    for ax in (left, right) if narrow else (left,):
        ax.set_yticks(places, called, fontsize=8)
    left.set_xlim(0, 100)
    left.set_xticks((0, 25, 50, 75, 100))
    left.set_xlabel("systematic share of the error one step ahead [%]", fontsize=8 if narrow else 9)
    right.set_xlabel("error on withheld stretches [% of that without]", fontsize=8 if narrow else 9)
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
        legend_below(figure, *left.get_legend_handles_labels())
    return figure
