"""Figures of designs, verifications, comparisons and logs: labelled with units, readable in black and white."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from excite.identification import Estimate, Prediction, SignalComparison, Verification
from excite.logs import Inspection
from excite.model import Model, signal_descriptions
from excite.reports.charts import EXPLORE, Explorable, explorable
from excite.reports.figure_files import POINTS_PER_INCH, layout_height, layout_width, wrap_title, write_figure

# Okabe-Ito colours, distinct for the colour-blind; line styles are distinct in black and white.
RECORDED = "0.6"  # grey of readings as recorded
ONE_COLUMN = 6  # channels of a log that are drawn below each other; more are drawn in two columns
MIN_SHADE = 0.004  # of a log's duration, that is shaded at least
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
LINEAR_UP_TO = 5.0  # errors [%] up to which their axis is linear; chosen
UNIT = re.compile(r"\[[^\]]*\]")  # at the end of a label
NO_BREAK = "\N{NO-BREAK SPACE}"
UNIT_OF_COLUMN = re.compile(r"_(Nm|N|(rad|m)(_s)?)$")  # at the end of a profile's columns
TITLE_SIZE = 11  # pt; chosen
MIN_LETTERS = 8  # of a label in a line; chosen
LETTER = 0.58  # width of a letter as a share of its size, on average
LEGEND_HANDLE = 38.0  # pt, of an entry of a legend without its letters; chosen
NARROW_IN = 7.0  # width of a figure below which its plots are above each other; chosen
ROW_IN, MAX_ROWS = 0.22, 36  # height of a row of a table of points, and rows of a block; chosen
LABEL_LETTERS = 22  # of an axis label in a line; chosen
TICKED_IN = 2.4  # width of a figure for each decade of errors from which it has ticks between powers of ten; chosen
ROOMY_ROWS = 24  # of a table of errors, up to which rows are far apart; chosen
MAX_MATRIX_IN, COLOUR_BAR_IN, CELL_IN = 12.0, 1.1, 0.13  # of a matrix: width, its colour bar, smallest cell; chosen
ONE_COLUMN_OF_SIGNALS = 3  # with their residuals, that are drawn below each other; chosen
CHANNEL_LETTERS = 20  # of a channel's label in a line; chosen


def save(figure: Figure, path: Path) -> Explorable:
    """Write a figure (.png) and its other formats as `writing_figures` states, and return what of it a chart shows.

    Files have no date: the same data give the same bytes.
    """
    shown = explorable(figure)
    write_figure(figure, path)
    return shown


def escape_dollar(text: str) -> str:
    """Escape dollar signs, which would begin a formula."""
    return text.replace("$", r"\$")


def set_title(figure: Figure, text: str, **place: Any) -> None:
    """Write a title above a figure, in as many lines as its width asks for."""
    figure.suptitle(escape_dollar(wrap_title(figure, text, TITLE_SIZE)), fontsize=TITLE_SIZE, **place)


class LabelWrapper(textwrap.TextWrapper):
    """Breaks lines at spaces and after the parts of paths and names, but not within a unit."""

    wordsep_simple_re = re.compile(r"([ \n]+|(?<=[/_]))")


def wrap_label(text: str, letters: int = LABEL_LETTERS) -> str:
    """Return the label of an axis in lines of so many letters."""
    whole = UNIT.sub(lambda unit: unit[0].replace(" ", NO_BREAK), text)
    return escape_dollar("\n".join(LabelWrapper(letters, break_on_hyphens=False).wrap(whole)))


def line_style(k: int) -> dict[str, Any]:
    """Return colour and dashes of the k-th of several lines."""
    return {"color": COLOURS[k % len(COLOURS)], "linestyle": STYLES[k % len(STYLES)]}


def new_figure(width: float, height: float, least: float = 0.0) -> Figure:
    """Return an empty figure [in], as wide and high as `layout_width` and `layout_height` say. least: for its texts."""
    return Figure(figsize=(layout_width(width), layout_height(height, least)), layout="constrained")


def letters_along(inches: float, most: int) -> int:
    """Return how many letters of the smallest size an axis of this length has room for, `most` at most."""
    return max(MIN_LETTERS, min(most, int(inches * POINTS_PER_INCH / (LETTER * 8))))


def is_narrow(width: float) -> bool:
    """Say whether a figure of this width [in] on the screen is to be laid out for a column of a paper."""
    return layout_width(width) < NARROW_IN


def draw_lines(ax: Axes, t: np.ndarray, curves: Mapping[str, np.ndarray], label: str, room: float | None) -> None:
    """Draw curves over time; room [in]: of a legend above them, None without one."""
    for k, (name, values) in enumerate(curves.items()):
        ax.plot(t, values, **line_style(k), linewidth=1.2, label=name)
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)
    if room is not None:
        legend_above(ax, room)


def legend_columns(names: Sequence[str], room: float) -> int:
    """Return how many entries of a legend are side by side in a width [in]."""
    longest = max((len(name) for name in names), default=0)
    return max(1, min(len(names), int(room * POINTS_PER_INCH / (LETTER * 8 * longest + LEGEND_HANDLE))))


def legend_above(ax: Axes, room: float) -> None:
    """Write the legend of a plot above it. room [in]: its width."""
    handles, names = ax.get_legend_handles_labels()
    place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 0.98), "borderpad": 0}
    ax.legend(handles, names, fontsize=8, ncols=legend_columns(names, room), frameon=False, **place)


def legend_below(figure: Figure, handles: Sequence[Any], names: Sequence[str]) -> None:
    """Write the legend of a figure below its plots."""
    columns = legend_columns(names, float(figure.get_figwidth()))
    figure.legend(handles, names, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)


def row_blocks(rows: int, narrow: bool) -> list[np.ndarray]:
    """Return the rows of a long table in one block or, where there is the width, in two side by side."""
    return [part for part in np.array_split(np.arange(rows), 1 if narrow or rows <= MAX_ROWS else 2) if len(part)]


def write_value(ax: Axes, text: str, x: float, y: float) -> None:
    """Write a value beside its point."""
    ax.annotate(text, (x, y), xytext=(6, 0), textcoords="offset points", va="center", fontsize=8)


def verify_figure(v: Verification, title: str) -> Figure:
    """Plot every run's error of every parameter with the predicted 95 % interval, and the intervals' coverage."""
    parts = row_blocks(len(v.names), is_narrow(10))
    rows = max(len(part) for part in parts)
    figure = new_figure(10 if len(parts) == 1 else 15, 1.7 + rows * (0.3 if rows <= ROOMY_ROWS else ROW_IN))
    axes = figure.subplots(1, 2 * len(parts), width_ratios=(3, 1) * len(parts))
    set_title(figure, title)
    e = v.error_percent
    # The error lies within these ends exactly if the interval around the value holds the truth.
    ends = 100 * np.nanmean((v.value[:, None] - v.interval) / v.reference, axis=0)
    reach = float(max(np.nanmax(np.abs(x), initial=0.0) for x in (e, ends)))
    for k, part in enumerate(parts):
        errors, cover = axes[2 * k : 2 * k + 2]
        places = np.arange(len(part))[::-1] + rows - len(part)
        for i, y in zip(part, places, strict=True):
            errors.plot(ends[:, i], [y, y], color="0.75", linewidth=8, solid_capstyle="butt", zorder=1)
            errors.plot(e[:, i], y + np.linspace(-0.25, 0.25, len(e)), ".", color=COLOURS[0], markersize=3, zorder=2)
            errors.plot(np.nanmean(e[:, i]), y, "D", color=COLOURS[1], markeredgecolor="black", markersize=5, zorder=3)
        errors.axvline(0, color="black", linewidth=0.8)
        _error_axis(errors, reach, float(figure.get_figwidth()) / len(parts))
        errors.set_yticks(places, [v.names[i] for i in part], fontsize=8)
        errors.grid(axis="x", alpha=0.3)
        cover.barh(places, 100 * np.nanmean(v.covered[:, part], axis=0), color=COLOURS[2], height=0.6)
        cover.axvline(95, color="black", linewidth=0.8, linestyle="--")
        cover.set_xlim(0, 100)
        cover.set_xticks((0, 100) if is_narrow(10) else (0, 50, 100))
        cover.set_yticks([])
        cover.tick_params(labelsize=8)
        cover.set_xlabel(wrap_label("truth within the 95 % interval [% of runs]", 15), fontsize=8)
        for ax in (errors, cover):
            ax.set_ylim(-0.7, rows - 0.3)
    key = {
        "95 % interval as predicted": Line2D([], [], color="0.75", linewidth=8),
        "one run": Line2D([], [], marker=".", linestyle="", color=COLOURS[0]),
        "mean of the runs": Line2D([], [], marker="D", linestyle="", color=COLOURS[1], markeredgecolor="black"),
    }
    legend_below(figure, list(key.values()), list(key))
    return figure


def _error_axis(ax: Axes, reach: float, width: float) -> None:
    """Scale an axis of errors [%] up to `reach`: linear for small errors, logarithmic beyond 1 % otherwise.

    width [in]: of the part of the figure in which it is.
    """
    label, top = "error [% of the true value]", reach or 1.0
    if reach >= LINEAR_UP_TO:
        decades = int(np.log10(reach)) + 1
        heads = (1, 2, 5) if decades * TICKED_IN <= width else (1,)
        ticks = [float(f"{head}e{k}") for k in range(decades + 1) for head in heads]
        top = next(tick for tick in ticks if tick >= reach)
        few = -(-decades // max(1, int(width / TICKED_IN * len((1, 2, 5)))))  # decades from tick to tick
        ticks = [tick for tick in ticks if tick <= top][:: few if heads == (1,) else 1]
        ax.set_xscale("symlog", linthresh=1.0, linscale=0.6)
        ax.set_xticks([-tick for tick in ticks[::-1]] + [0.0, *ticks])
        ax.set_xticks([], minor=True)
        label += ", logarithmic beyond 1 %"
    ax.tick_params(axis="x", labelsize=8)
    ax.set_xlim(-1.1 * top, 1.1 * top)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlabel(wrap_label(label, int(7 * width)), fontsize=9)


def correlation_figure(estimate: Estimate, title: str) -> Figure:
    """Plot the correlation of the errors of every two identified parameters.

    Where there are more than have room with letters that can be read, it shows those that are correlated most.
    """
    known = np.flatnonzero(estimate.std > 0)
    correlation = estimate.covariance[np.ix_(known, known)] / np.outer(estimate.std[known], estimate.std[known])
    own = min(3.0 + 0.24 * len(known), MAX_MATRIX_IN)
    longest = max((len(name) for name in estimate.names), default=0)
    names_in = LETTER * 8 * longest / POINTS_PER_INCH
    side = layout_width(own) - names_in - COLOUR_BAR_IN
    shown = np.arange(len(known))
    if len(known) > (room := max(2, int(side / CELL_IN))):
        strongest = np.abs(correlation - np.eye(len(known))).max(axis=0)
        shown = np.sort(np.argsort(-strongest, kind="stable")[:room])
        title += f" - the {room} of {len(known)} that are correlated most"
    n, names = len(shown), [estimate.names[known[k]] for k in shown]
    figure = new_figure(own, side + names_in + 0.8)
    set_title(figure, title)
    ax = figure.subplots()
    ax.set_gid(EXPLORE)
    edges, colours = np.arange(n + 1), correlation[np.ix_(shown, shown)]
    mesh = ax.pcolormesh(edges, edges, colours, cmap="RdBu", vmin=-1, vmax=1, edgecolor="white", linewidth=0.3)
    ax.set_xticks(edges[:-1] + 0.5, names, rotation=90, fontsize=8)
    ax.set_yticks(edges[:-1] + 0.5, names, fontsize=8)
    ax.invert_yaxis()
    ax.set_aspect("equal")
    bar = figure.colorbar(mesh, ax=ax, shrink=0.8)
    bar.set_label("correlation of the errors [-]", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def budget_figure(estimate: Estimate, title: str) -> Figure:
    """Plot for each parameter which share of its variance is by noise and which by each tolerance."""
    budget = estimate.budget
    largest: dict[str, float] = {}
    for shares in budget.values():
        for source, share in shares.items():
            largest[source] = max(largest.get(source, 0.0), share)
    shown = sorted((s for s in largest if s != "noise"), key=lambda s: -largest[s])[: len(COLOURS) - 1]
    figure = new_figure(7.5, 1.8 + (0.3 if len(budget) <= ROOMY_ROWS else ROW_IN) * len(budget))
    set_title(figure, title)
    ax = figure.subplots()
    places, left = np.arange(len(budget))[::-1], np.zeros(len(budget))
    for source, colour in zip(("noise", *shown), ("0.7", *COLOURS), strict=False):
        width = np.array([100 * shares.get(source, 0.0) for shares in budget.values()])
        ax.barh(places, width, left=left, height=0.7, color=colour, label=source)
        left += width
    ax.barh(places, np.maximum(100 - left, 0), left=left, height=0.7, color="0.9", label="other tolerances")
    ax.set_yticks(places, list(budget))
    ax.set_xlim(0, 100)
    ax.set_xlabel("share of the variance [%]")
    ax.tick_params(axis="y", labelsize=8)
    legend_below(figure, *ax.get_legend_handles_labels())
    return figure


def prior_figure(estimate: Estimate, nominal: np.ndarray, title: str) -> Figure:
    """Plot the 95 % intervals of parameters before the log, by what the machine file calls known, and after it.

    nominal (n,) [SI]: the machine file's values. Raises ValueError for an estimate without a prior.
    """
    if estimate.prior_std is None:
        raise ValueError("the estimate has no prior")
    known = np.flatnonzero(np.isfinite(estimate.prior_std) & (estimate.prior_std > 0) & np.isfinite(estimate.std))
    before = estimate.prior_std[known]
    moved, after = (estimate.value[known] - nominal[known]) / before, estimate.std[known] / before
    parts = row_blocks(len(known), is_narrow(7.5))
    rows = max(len(part) for part in parts)
    figure = new_figure(7.5 if len(parts) == 1 else 11, 1.6 + ROW_IN * rows)
    set_title(figure, title)
    axes = figure.subplots(1, len(parts), squeeze=False, sharex=True)[0]
    reach = 1.15 * max(1.96, float(np.max(np.abs(moved) + 1.96 * after)))
    for ax, part in zip(axes, parts, strict=True):
        places = np.arange(len(part))[::-1] + rows - len(part)
        ax.axvspan(-1.96, 1.96, color="0.88", label="known before")
        ax.axvline(0, color="black", linewidth=0.8)
        bars: Any = {"fmt": "D", "color": COLOURS[0], "markersize": 4, "label": "with the log"}
        ax.errorbar(moved[part], places, xerr=1.96 * after[part], **bars)
        ax.set_xlim(-reach, reach)
        ax.set_ylim(-0.7, rows - 0.3)
        ax.set_yticks(places, [estimate.names[known[k]] for k in part], fontsize=8)
        ax.grid(axis="x", alpha=0.3)
        ax.set_xlabel("95 % intervals about the machine file's value\n[standard deviations known before]", fontsize=8)
    legend_below(figure, *axes[0].get_legend_handles_labels())
    return figure


def comparison_figure(model: Model, c: SignalComparison, title: str) -> Figure:
    """Plot measured and predicted signals, with the residual below each."""
    n = len(c.names)
    columns = 2 if n > ONE_COLUMN_OF_SIGNALS and not is_narrow(12) else 1
    rows = -(-n // columns)
    own = 10.0 if columns == 1 else 12.0
    figure = new_figure(own, 1.0 + rows * (2.2 if is_narrow(own) else 3.0))
    set_title(figure, title)
    axes = figure.subplots(2 * rows, columns, sharex=True, squeeze=False, height_ratios=(2, 1) * rows)
    room = float(figure.get_figwidth()) / columns - 1.0
    words = signal_descriptions(model.machine)
    for name, b in zip(model.inputs, model.machine.actuated, strict=True):
        words[name] = f"{'torque' if b.joint == 'revolute' else 'force'}, {b.where.replace('_', ' ')}"
    letters = letters_along(0.6 * (float(figure.get_figheight()) - 1.0) / rows - 0.2, LABEL_LETTERS)
    for k, (name, unit) in enumerate(zip(c.names, c.units, strict=True)):
        above, below = axes[2 * (k % rows) : 2 * (k % rows) + 2, k // rows]
        label = wrap_label(words.get(name, name), letters)
        key = room if k % rows == 0 else None  # once in a column
        draw_lines(above, c.t, {"measured": c.measured[k], "predicted": c.predicted[k]}, f"{label}\n[{unit}]", key)
        below.axhline(0, color="black", linewidth=0.6)
        if c.expected is not None:
            band = 1.96 * c.expected[k]
            below.fill_between(c.t, -band, band, color="0.8", linewidth=0, label="95 % if the model is right")
        draw_lines(below, c.t, {"residual": c.residual[k]}, f"residual\n[{unit}]", None if c.expected is None else key)
        below.tick_params(labelbottom=k % rows == rows - 1 or k == n - 1)
    for ax in axes.T.ravel()[2 * n :]:
        ax.set_visible(False)
    for k in (rows - 1, n - 1):
        axes.T.ravel()[2 * k + 1].set_xlabel("time [s]")
    _small_ticks(figure)
    return figure


def _small_ticks(figure: Figure) -> None:
    """Write the numbers of all axes as small as the smallest letters of a figure."""
    for ax in figure.axes:
        ax.tick_params(which="both", labelsize=8)
        ax.yaxis.label.set_fontsize(8)


def prediction_figure(p: Prediction, title: str) -> Figure:
    """Plot each predicted signal with its 95 % band, and the band alone below, about the residual along a log.

    Torques take the whole width but in narrow figures; a motion has a column of speeds and one of positions.
    """
    forces = [k for k, unit in enumerate(p.units) if unit in ("N m", "N")]
    motion = [k for k in range(len(p.names)) if k not in forces]
    own = 12.0 if motion else 10.0
    narrow, half = is_narrow(own), len(motion) // 2
    several = 2 if narrow and len(p.names) > ONE_COLUMN_OF_SIGNALS else 1
    rows = [forces[k : k + several] for k in range(0, len(forces), several)]
    rows += [[motion[k], motion[half + k]] for k in range(half)]
    figure = new_figure(own, 0.8 + (2.2 if narrow else 3.0) * len(rows))
    letters = letters_along(0.6 * (float(figure.get_figheight()) - 0.8) / len(rows) - 0.2, LABEL_LETTERS)
    set_title(figure, title)
    grid = figure.add_gridspec(2 * len(rows), 2, height_ratios=(2, 1) * len(rows))
    for i, row in enumerate(rows):
        for j, k in enumerate(row):
            column = j if len(row) > 1 or several > 1 else slice(None)
            above = figure.add_subplot(grid[2 * i, column], sharex=figure.axes[0] if figure.axes else None)
            below = figure.add_subplot(grid[2 * i + 1, column], sharex=above)
            above.tick_params(labelbottom=False)
            _predicted(above, below, p, k, letters, float(figure.get_figwidth()) / len(row) - 1.0 if i == 0 else None)
            if i == len(rows) - 1:
                below.set_xlabel("time [s]")
    _small_ticks(figure)
    return figure


def _predicted(above: Axes, below: Axes, p: Prediction, k: int, letters: int, room: float | None) -> None:
    """Plot the k-th signal of a prediction with its band above; below the band alone, or the residual in it.

    letters: of a label in a line. room [in]: of a legend; None without one.
    """
    unit, added = p.units[k], " (adds up)" if p.names[k] in p.free else ""
    above.fill_between(p.t, p.value[k] - p.band[k], p.value[k] + p.band[k], color=COLOURS[4], alpha=0.5, linewidth=0)
    curves = {"predicted": p.value[k]}
    if p.measured is not None:
        curves = {"measured": p.measured[k], **curves}
    label = wrap_label(f"{UNIT_OF_COLUMN.sub('', p.names[k])} [{unit}]{added}", letters)
    draw_lines(above, p.t, curves, label, room if len(curves) > 1 else None)
    below.grid(alpha=0.3)
    below.axhline(0, color="black", linewidth=0.6)
    if p.measured is None or p.reading_band is None or p.outside is None:
        below.fill_between(p.t, -p.band[k], p.band[k], color=COLOURS[4], alpha=0.5, linewidth=0)
        below.set_ylabel(f"95 % band\n[{unit}]")
        return
    residual, outside = p.measured[k] - p.value[k], p.outside[k]
    below.fill_between(p.t, -p.reading_band[k], p.reading_band[k], color="0.8", linewidth=0, label="95 % of readings")
    below.fill_between(p.t, -p.band[k], p.band[k], color=COLOURS[4], alpha=0.5, linewidth=0, label="95 % band of truth")
    below.plot(p.t, residual, color=COLOURS[0], linewidth=1.0, label="measured - predicted")
    below.plot(p.t[outside], residual[outside], ".", color=COLOURS[1], markersize=3, label="outside")
    below.set_ylabel(f"residual\n[{unit}]")
    if room is not None:
        legend_above(below, room)


def log_figure(found: Inspection, title: str) -> Figure:
    """Plot a log channel by channel over time, as recorded and as used: one unit an axis, findings and gaps shaded."""
    sensors = {s.name: " - ".join(s.columns) for machine, _, _ in found.used[:1] for s in machine.sensors("full")}
    bad = [(sensors.get(sensor, sensor), span) for sensor, span in found.bad]
    used = {
        name: [(first + one.t, one.values[s]) for _, one, first in found.used if s in one.values]
        for s, name in sensors.items()
    }
    count = max(len(found.signals), 1)
    columns = 1 if count <= ONE_COLUMN or is_narrow(15.5) else 2
    rows = -(-count // columns)
    figure = new_figure(5.5 + 5 * columns, 1.3 + 1.3 * rows)
    letters = letters_along((float(figure.get_figheight()) - 1.3) / rows - 0.1, CHANNEL_LETTERS)
    set_title(figure, title)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    for ax, (name, (t, values, unit)) in zip(axes, found.signals.items(), strict=False):
        ax.plot(t, values, ".", color=RECORDED, markersize=2.5, rasterized=True)
        for at, x in used.get(name, []):
            ax.plot(at, x, color=COLOURS[0], linewidth=0.9)
        for channel, (first, last) in bad:
            if channel == name:
                width = max(last - first, MIN_SHADE * max(float(np.ptp(t)), 1e-9))
                middle = (first + last) / 2
                ax.axvspan(middle - width / 2, middle + width / 2, color=COLOURS[1], alpha=0.35, linewidth=0)
        for gap in found.gaps:
            ax.axvline(gap, color="black", linewidth=0.8, linestyle="--")
        ax.set_ylabel(wrap_label(f"{name} [{unit}]", letters), fontsize=8)
        ax.tick_params(labelsize=8)
        ax.grid(alpha=0.3)
    for ax in axes[count:]:
        ax.set_visible(False)
    for k in (rows - 1, count - 1):
        axes[k].tick_params(labelbottom=True)
        axes[k].set_xlabel("time [s]", fontsize=9)
    handles = {
        Line2D([], [], color=RECORDED, marker=".", linestyle="", label="as recorded"): True,
        Line2D([], [], color=COLOURS[0], label="as used"): bool(found.used),
        Patch(color=COLOURS[1], alpha=0.35, label="something is wrong here"): bool(found.bad),
        Line2D([], [], color="black", linestyle="--", linewidth=0.8, label="gap"): bool(found.gaps),
    }
    key = [h for h, there in handles.items() if there]
    legend_below(figure, key, [str(h.get_label()) for h in key])
    return figure
