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

from excite import simulation, trajectories
from excite.identification import Estimate, Prediction, SignalComparison, Verification
from excite.logs import Inspection
from excite.model import Model, signal_descriptions
from excite.model.machine import Problem
from excite.reports.charts import EXPLORE, Explorable, explorable
from excite.reports.figure_files import wrap_title, write_figure
from excite.simulation import Motion
from excite.text import count, format_number
from excite.trajectories import DESIGNED, ComparisonRow, SensorValue

# Okabe-Ito colours, distinct for the colour-blind; line styles are distinct in black and white.
RECORDED = "0.6"  # grey of readings as recorded
ONE_COLUMN = 6  # channels of a log that are drawn below each other; more are drawn in two columns
MIN_SHADE = 0.004  # of a log's duration, that is shaded at least
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
LINEAR_UP_TO = 5.0  # errors [%] up to which their axis is linear; chosen
UNIT_OF_COLUMN = re.compile(r"_(Nm|N|(rad|m)(_s)?)$")  # at the end of a profile's columns
TITLE_SIZE = 11  # pt; chosen
LETTER = 0.58  # width of a letter as a share of its size, on average
LEGEND_WIDTH, LEGEND_HANDLE = 470.0, 38.0  # pt: of a legend above a plot, and of an entry without its letters; chosen
LINE_INCHES = 0.165  # of a limit's name; chosen
LABEL_LETTERS = 22  # of an axis label in a line; chosen
LIMIT_LETTERS = 32  # of a limit's name in a line; chosen
TICKED_DECADES = 3  # of a logarithmic axis, up to which it has ticks between powers of ten; chosen


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


def set_title(figure: Figure, text: str) -> None:
    """Write a title above a figure, in as many lines as its width asks for."""
    figure.suptitle(escape_dollar(wrap_title(figure, text, TITLE_SIZE)), fontsize=TITLE_SIZE)


def wrap_label(text: str, letters: int = LABEL_LETTERS) -> str:
    """Return the label of an axis in lines of so many letters."""
    return escape_dollar("\n".join(textwrap.wrap(text, letters)))


def _style(k: int) -> dict[str, Any]:
    """Return colour and dashes of the k-th of several lines."""
    return {"color": COLOURS[k % len(COLOURS)], "linestyle": STYLES[k % len(STYLES)]}


def _lines(ax: Axes, t: np.ndarray, curves: Mapping[str, np.ndarray], label: str, legend: bool = True) -> None:
    for k, (name, values) in enumerate(curves.items()):
        ax.plot(t, values, **_style(k), linewidth=1.2, label=name)
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)
    if legend:
        names = ax.get_legend_handles_labels()[1]
        longest = max((len(name) for name in names), default=0)
        ax.legend(
            loc="lower right",
            bbox_to_anchor=(1, 0.98),
            fontsize=8,
            ncols=min(len(names), max(1, int(LEGEND_WIDTH / (LETTER * 8 * longest + LEGEND_HANDLE)))) or 1,
            frameon=False,
            borderpad=0,
        )


def _bound(ax: Axes, low: float, high: float) -> None:
    for y in (low, high):
        ax.axhline(y, color="black", linewidth=0.8, linestyle=(0, (2, 3)))


def design_figure(model: Model, problem: Problem, motion: Motion, title: str) -> Figure:
    """Plot a drive: torques, speeds, joint angles and slips over time, the path, and the used share of each limit."""
    machine, t = model.machine, motion.t
    moving = [b for b in machine.actuated if b.limit.position_range is not None]
    slips: dict[str, np.ndarray] = {}
    for (index, _), x in zip(
        model.edges, simulation.resultant_slips(model, motion.q, motion.nu, model.nominal).T, strict=True
    ):
        name = machine.find(index).where.replace("_", " ")
        slips[name] = np.maximum(slips.get(name, x), x)
    panels = 2 + bool(moving) + bool(slips)
    use = limit_use(model, problem, motion)
    limits = ["\n".join(textwrap.wrap(n.replace("_", " "), LIMIT_LETTERS)) for n in use]
    lines = len(limits) * max(n.count("\n") + 1 for n in limits)
    figure = Figure(figsize=(11.5, max(2.3 * max(panels, 3) + 0.6, LINE_INCHES * lines + 4.0)), layout="constrained")
    halves = figure.subfigures(1, 2, width_ratios=(1.7, 1))
    assert isinstance(halves, np.ndarray)
    left, right = halves
    axes = left.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    set_title(figure, title)

    # Torques in per cent of their limits, so that one panel shows joints of all sizes.
    named = {b.where.replace("_", " "): k for k, b in enumerate(machine.actuated)}
    tops = [float(b.limit.torque or np.abs(motion.u[:, k]).max() or 1.0) for k, b in enumerate(machine.actuated)]
    unit = "N m" if all(b.joint == "revolute" for b in machine.actuated) else "N"
    curves = {f"{n} ({tops[k]:g} {unit})": 100 * motion.u[:, k] / tops[k] for n, k in named.items()}
    _lines(axes[0], t, curves, "torque [% of limit]")
    _bound(axes[0], -100, 100)
    axes[0].set_ylim(-115, 115)

    speeds: dict[str, np.ndarray] = {}
    if machine.planar:
        speeds["forward speed"] = motion.nu[:, 0]
    for b in machine.contacts:
        assert b.contact is not None
        rim = float(b.contact.radius) * machine.joint_values(b, motion.nu.T)
        speeds[f"rim of {b.name.replace('_', ' ')}"] = rim
    if not speeds:
        speeds = {c: motion.nu[:, k] for k, c in enumerate(model.coordinates)}
    _lines(axes[1], t, speeds, "speed [m/s]" if machine.planar else "speed [m/s or rad/s]")
    rims = [float(b.limit.rim_speed) for b in machine.contacts if b.limit.rim_speed is not None]
    if rims:
        _bound(axes[1], -max(rims), max(rims))
    row = 2
    if moving:
        angles = {b.where.replace("_", " "): motion.q[:, model.coordinates.index(b.coordinates[0])] for b in moving}
        _lines(axes[row], t, angles, "angle [rad]")
        lows, highs = zip(*(b.limit.position_range for b in moving if b.limit.position_range is not None), strict=True)
        _bound(axes[row], min(lows), max(highs))
        row += 1
    if slips:
        _lines(axes[row], t, slips, "largest slip [-]")
        allowed = [float(b.contact.slip_limit) for b in machine.contacts if b.contact and b.contact.slip_limit]
        if allowed:
            axes[row].axhline(max(allowed), color="black", linewidth=0.8, linestyle=(0, (2, 3)))
    axes[-1].set_xlabel("time [s]")

    lane = machine.planar and f"y{machine.body[0].index}" in model.coordinates
    if lane:
        path, bars = right.subplots(2, 1, height_ratios=(1, 1.5))
        _path(path, model, problem, motion)
    else:
        bars = right.subplots(1, 1)
    bars.barh(range(len(use)), [100 * x for x in use.values()][::-1], color=COLOURS[0], height=0.6)
    bars.axvline(100, color="black", linewidth=0.8, linestyle=(0, (2, 3)))
    bars.set_xlim(0, 115)
    bars.set_xlabel("most used\n[% of the limit]")
    bars.set_yticks(range(len(use)), limits[::-1])
    bars.tick_params(axis="y", labelsize=7)
    return figure


def _path(ax: Axes, model: Model, problem: Problem, motion: Motion) -> None:
    q = model.true_coordinates(motion.q, model.nominal)
    places = model.kinematics(q.T, motion.nu.T)[3].full().reshape(3, len(motion.t), len(model.machine.body))
    for k, i in enumerate(problem.lane_points):
        body = model.machine.find(i)
        x, y, _ = places[:, :, model.machine.body.index(body)]
        ax.plot(x, y, **_style(k), linewidth=1.2, label=body.name.replace("_", " "))
        ax.plot(x[0], y[0], "o", color=_style(k)["color"], markersize=5)
    length, width = problem.lane
    ax.plot(
        *np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]).T * [[length / 2], [width / 2]], "k:", linewidth=0.8
    )
    ax.set_aspect("equal")
    ax.set_xlabel("x on the lane [m]")
    ax.set_ylabel("y [m]")
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1.0), ncols=2, fontsize=8, frameon=False, borderaxespad=0.2)
    ax.grid(alpha=0.3)


def sigma_figure(sigma: Mapping[str, float], title: str) -> Figure:
    """Plot the attainable standard deviation [%] of every parameter (Cramer-Rao bound)."""
    n = len(sigma)
    figure = Figure(figsize=(7.5, 1.2 + 0.27 * n), layout="constrained")
    ax = figure.subplots()
    set_title(figure, title)
    names = list(sigma)[::-1]
    values = np.array([sigma[s] for s in names])
    low, high = 10.0 ** np.floor(np.log10(values.min())), 10.0 ** np.ceil(np.log10(values.max()) + 1e-9)
    ax.hlines(names, low, values, color="0.75", linewidth=5)
    ax.plot(values, names, "o", color=COLOURS[0])
    for y, value in enumerate(values):
        ax.annotate(
            f"{format_number(value, 2)}", (value, y), xytext=(7, 0), textcoords="offset points", va="center", fontsize=8
        )
    ax.set_xscale("log")
    ax.set_xlim(low, 1.3 * high)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter("")
    ax.set_xlabel("attainable standard deviation [% of the nominal value]")
    ax.grid(axis="x", alpha=0.3)
    return figure


def sensors_figure(values: Sequence[SensorValue], title: str) -> Figure:
    """Plot the accuracy of the worst and the median parameter [%] after each change of the sensors."""
    now, *changes = values
    figure = Figure(figsize=(8, 1.4 + 0.27 * len(changes)), layout="constrained")
    ax = figure.subplots()
    set_title(figure, title)
    names = [f"{v.sensor}, {v.change}" for v in changes][::-1]
    of = {"worst": ("worst_percent", "o"), "median": ("median_percent", "s")}
    for k, (label, (key, mark)) in enumerate(of.items()):
        ax.axvline(getattr(now, key), color=COLOURS[k], linewidth=1)
        ax.plot([getattr(v, key) for v in changes][::-1], names, mark, color=COLOURS[k], label=f"{label} parameter")
    ax.set_xscale("log")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(lambda x, place: format_number(x, 2))
    ax.tick_params(axis="x", which="minor", labelsize=7)
    ax.set_xlabel("attainable standard deviation [% of the nominal value]")
    ax.grid(axis="x", which="both", alpha=0.3)
    ax.legend(fontsize=8)
    return figure


def campaign_figure(summary: Mapping[str, Any], title: str) -> Figure:
    """Plot what drives designed together attain [%] over the time of driving [min], from a campaign's summary."""
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    ax = figure.subplots()
    set_title(figure, title)
    draw_campaign(ax, summary)
    return figure


def draw_campaign(ax: Axes, summary: Mapping[str, Any]) -> None:
    """Draw the trials of a campaign, its target and its answer."""
    trials = [t for t in summary["trials"] if t["percent"] is not None and np.isfinite(t["percent"])]
    first, target = trials[0], summary["target_percent"]
    most = max(t["drives"] * t["duration_s"] for t in trials)
    repeats = max(first["duration_s"] * max(1.0, first["percent"] / target) ** 2, most)
    t = np.geomspace(first["duration_s"], 1.05 * repeats, 50)
    ax.plot(t / 60, first["percent"] * np.sqrt(first["duration_s"] / t), color="0.65", label="first drive repeated")
    for k, drives in enumerate(sorted({t["drives"] for t in trials})):
        own = sorted((t["duration_s"], t["percent"]) for t in trials if t["drives"] == drives)
        minutes = [drives * seconds / 60 for seconds, _ in own]
        label = count(drives, "drive")
        ax.plot(minutes, [percent for _, percent in own], marker="o", markersize=4, **_style(k), label=label)
    ax.axhline(target, color="k", linestyle=":", linewidth=1)
    ax.plot(summary["total_s"] / 60, summary["attained_percent"], "kD", fillstyle="none", markersize=9, label="answer")
    ax.set_xscale("log")
    ax.set_yscale("log")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(lambda x, place: format_number(x, 2))
    ax.tick_params(which="minor", labelsize=7)
    ax.set_xlabel("driving [min]")
    ax.set_ylabel(f"{'worst parameter' if summary['objective'] == 'worst' else summary['objective']} [%]")
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8)


def limit_use(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Return the largest used share of each limit; 1 is the limit itself."""
    du = np.gradient(motion.u, motion.t, axis=0)
    use: dict[str, float] = {}
    for bound in trajectories.machine_limits(model, problem):
        values = bound.expression(motion.q.T, motion.nu.T, motion.u.T, du.T).full()
        if np.isfinite(bound.low):
            use[bound.name] = float(np.abs(values - bound.centre).max() / (bound.range / 2))
        else:
            use[bound.name] = float(values.max() / bound.high)
    return use


def verify_figure(v: Verification, title: str) -> Figure:
    """Plot every run's error of every parameter with the predicted 95 % interval, and the intervals' coverage."""
    n = len(v.names)
    figure = Figure(figsize=(10, 1.6 + 0.34 * n), layout="constrained")
    errors, cover = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    set_title(figure, title)
    places = np.arange(n)[::-1]
    e = v.error_percent
    # The error lies within these ends exactly if the interval around the value holds the truth.
    ends = 100 * np.nanmean((v.value[:, None] - v.interval) / v.reference, axis=0)
    for k, y in enumerate(places):
        errors.plot(ends[:, k], [y, y], color="0.75", linewidth=9, solid_capstyle="butt", zorder=1)
        errors.plot(e[:, k], y + np.linspace(-0.25, 0.25, len(e)), ".", color=COLOURS[0], markersize=3, zorder=2)
        errors.plot(np.nanmean(e[:, k]), y, "D", color=COLOURS[1], markeredgecolor="black", markersize=6, zorder=3)
    errors.axvline(0, color="black", linewidth=0.8)
    _error_axis(errors, float(max(np.nanmax(np.abs(x), initial=0.0) for x in (e, ends))))
    errors.set_yticks(places, v.names)
    errors.grid(axis="x", alpha=0.3)
    errors.plot([], [], color="0.75", linewidth=9, label="95 % interval as predicted")
    errors.plot([], [], ".", color=COLOURS[0], label="one run")
    errors.plot([], [], "D", color=COLOURS[1], markeredgecolor="black", label="mean of the runs")
    errors.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8, frameon=False)
    cover.barh(places, 100 * np.nanmean(v.covered, axis=0), color=COLOURS[2], height=0.6)
    cover.axvline(95, color="black", linewidth=0.8, linestyle="--")
    cover.set_xlim(0, 100)
    cover.set_xlabel("truth within the\n95 % interval [% of runs]")
    return figure


def _error_axis(ax: Axes, reach: float) -> None:
    """Scale an axis of errors [%] up to `reach`: linear for small errors, logarithmic beyond 1 % otherwise."""
    label, top = "error [% of the true value]", reach or 1.0
    if reach >= LINEAR_UP_TO:
        heads = (1, 2, 5) if reach < 10**TICKED_DECADES else (1,)
        ticks = [float(f"{head}e{k}") for k in range(int(np.log10(reach)) + 2) for head in heads]
        top = next(tick for tick in ticks if tick >= reach)
        ticks = [tick for tick in ticks if tick <= top]
        ax.set_xscale("symlog", linthresh=1.0, linscale=0.6)
        ax.set_xticks([-tick for tick in ticks[::-1]] + [0.0, *ticks])
        ax.tick_params(axis="x", labelsize=7)
        label += ", logarithmic beyond 1 %"
    ax.set_xlim(-1.1 * top, 1.1 * top)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlabel(label)


def correlation_figure(estimate: Estimate, title: str) -> Figure:
    """Plot the correlation of the errors of every two identified parameters."""
    known = np.flatnonzero(estimate.std > 0)
    names = [estimate.names[k] for k in known]
    correlation = estimate.covariance[np.ix_(known, known)] / np.outer(estimate.std[known], estimate.std[known])
    n = len(names)
    size = 2.2 + 0.24 * n
    figure = Figure(figsize=(size + 0.8, size), layout="constrained")
    set_title(figure, title)
    ax = figure.subplots()
    ax.set_gid(EXPLORE)
    edges = np.arange(n + 1)
    mesh = ax.pcolormesh(edges, edges, correlation, cmap="RdBu", vmin=-1, vmax=1, edgecolor="white", linewidth=0.3)
    ax.set_xticks(edges[:-1] + 0.5, names, rotation=90, fontsize=8)
    ax.set_yticks(edges[:-1] + 0.5, names, fontsize=8)
    ax.invert_yaxis()
    ax.set_aspect("equal")
    figure.colorbar(mesh, ax=ax, shrink=0.8, label="correlation of the errors [-]")
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
    figure = Figure(figsize=(7.5, 1.6 + 0.3 * len(known)), layout="constrained")
    set_title(figure, title)
    ax = figure.subplots()
    places = np.arange(len(known))[::-1]
    ax.barh(places, 2 * 1.96, left=-1.96, height=0.6, color="0.85", label="known before")
    reach = 1.15 * max(1.96, float(np.max(np.abs(moved) + 1.96 * after)))
    ax.set_xlim(-reach, reach)
    ax.errorbar(moved, places, xerr=1.96 * after, fmt="D", color=COLOURS[0], markersize=4, label="with the log")
    ax.axvline(0, color="black", linewidth=0.8)
    ax.set_yticks(places, [estimate.names[k] for k in known])
    ax.set_xlabel("95 % intervals about the machine file's value\n[standard deviations known before]")
    ax.grid(axis="x", alpha=0.3)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def comparison_figure(model: Model, c: SignalComparison, title: str) -> Figure:
    """Plot measured and predicted signals, with the residual below each."""
    n = len(c.names)
    figure = Figure(figsize=(10, 0.8 + 3.0 * n), layout="constrained")
    set_title(figure, title)
    axes = figure.subplots(2 * n, 1, sharex=True, squeeze=False, height_ratios=(2, 1) * n)[:, 0]
    words = signal_descriptions(model.machine)
    for name, b in zip(model.inputs, model.machine.actuated, strict=True):
        words[name] = f"{'torque' if b.joint == 'revolute' else 'force'}, {b.where.replace('_', ' ')}"
    for k, (name, unit) in enumerate(zip(c.names, c.units, strict=True)):
        label = wrap_label(words.get(name, name))
        _lines(axes[2 * k], c.t, {"measured": c.measured[k], "predicted": c.predicted[k]}, f"{label}\n[{unit}]")
        if c.expected is not None:
            band = 1.96 * c.expected[k]
            axes[2 * k + 1].fill_between(c.t, -band, band, color="0.8", linewidth=0, label="95 % if the model is right")
        _lines(axes[2 * k + 1], c.t, {"residual": c.residual[k]}, f"residual\n[{unit}]", legend=c.expected is not None)
    axes[-1].set_xlabel("time [s]")
    return figure


def prediction_figure(p: Prediction, title: str) -> Figure:
    """Plot each predicted signal with its 95 % band, and the band alone below, about the residual along a log.

    Torques take the whole width; a motion has a column of speeds and one of positions.
    """
    forces = [k for k, unit in enumerate(p.units) if unit in ("N m", "N")]
    motion = [k for k in range(len(p.names)) if k not in forces]
    half = len(motion) // 2
    rows = [[k] for k in forces] + [[motion[k], motion[half + k]] for k in range(half)]
    figure = Figure(figsize=(12 if motion else 10, 0.8 + 3.0 * len(rows)), layout="constrained")
    set_title(figure, title)
    grid = figure.add_gridspec(2 * len(rows), 2, height_ratios=(2, 1) * len(rows))
    for i, row in enumerate(rows):
        for j, k in enumerate(row):
            column = slice(None) if len(row) == 1 else j
            above = figure.add_subplot(grid[2 * i, column], sharex=figure.axes[0] if figure.axes else None)
            below = figure.add_subplot(grid[2 * i + 1, column], sharex=above)
            above.tick_params(labelbottom=False)
            _predicted(above, below, p, k)
            if i == len(rows) - 1:
                below.set_xlabel("time [s]")
    return figure


def _predicted(above: Axes, below: Axes, p: Prediction, k: int) -> None:
    """Plot the k-th signal of a prediction with its band above; below the band alone, or the residual in it."""
    unit, added = p.units[k], " (adds up)" if p.names[k] in p.free else ""
    above.fill_between(p.t, p.value[k] - p.band[k], p.value[k] + p.band[k], color=COLOURS[4], alpha=0.5, linewidth=0)
    curves = {"predicted": p.value[k]}
    if p.measured is not None:
        curves = {"measured": p.measured[k], **curves}
    _lines(above, p.t, curves, f"{UNIT_OF_COLUMN.sub('', p.names[k])} [{unit}]{added}", legend=len(curves) > 1)
    below.grid(alpha=0.3)
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
    below.legend(loc="lower right", bbox_to_anchor=(1, 0.98), fontsize=8, ncols=4, frameon=False, borderpad=0)


def compare_figure(rows: Sequence[ComparisonRow], title: str) -> Figure:
    """Plot cond(Phi) and the attainable accuracy of the worst parameter of several drives, lowest cond(Phi) on top.

    A hatched drive breaks the limit that its label names.
    """
    rows = sorted(rows, key=lambda r: r.cond_phi, reverse=True)
    figure = Figure(figsize=(10.5, 1.5 + 0.36 * len(rows)), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    set_title(figure, title)
    values = ([r.cond_phi for r in rows], [r.worst_std_percent for r in rows])
    places = np.arange(len(rows))
    for ax, x, label in zip(
        axes, values, ("cond(Phi)", "worst parameter: attainable\nstandard deviation [%]"), strict=True
    ):
        finite = [value for value in x if np.isfinite(value)] or [1.0]
        for y, (r, value) in enumerate(zip(rows, x, strict=True)):
            ours, hatch = r.name == DESIGNED, "" if r.breaks is None else "///"
            width = min(value, 2 * max(finite))
            ax.barh(y, width, height=0.65, color=COLOURS[1 if ours else 0], edgecolor="black", hatch=hatch)
            ax.annotate(
                f"{format_number(value, 3)}",
                (width, y),
                xytext=(4, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
            )
        ax.set_xscale("log")
        ax.set_xlim(min(finite) / 2, max(finite) * 2)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
        ax.set_xlabel(label)
        ax.grid(axis="x", alpha=0.3)
        ax.set_axisbelow(True)
    names = [r.name if r.breaks is None else f"{r.name}\n(breaks {r.breaks})" for r in rows]
    axes[0].set_yticks(places, names, fontsize=9)
    for label, r in zip(axes[0].get_yticklabels(), rows, strict=True):  # bold, as colour is lost in black and white
        label.set_fontweight("bold" if r.name == DESIGNED else "normal")
    return figure


def log_figure(found: Inspection, title: str) -> Figure:
    """Plot a log channel by channel over time, as recorded and as used: one unit an axis, findings and gaps shaded."""
    sensors = {s.name: " - ".join(s.columns) for machine, _, _ in found.used[:1] for s in machine.sensors("full")}
    bad = [(sensors.get(sensor, sensor), span) for sensor, span in found.bad]
    used = {
        name: [(first + one.t, one.values[s]) for _, one, first in found.used if s in one.values]
        for s, name in sensors.items()
    }
    count = max(len(found.signals), 1)
    columns = 1 if count <= ONE_COLUMN else 2
    rows = -(-count // columns)
    figure = Figure(figsize=(5.5 + 5 * columns, 1.1 + 1.3 * rows), layout="constrained")
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
        ax.set_ylabel(f"{name}\n[{unit}]", fontsize=8)
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
    figure.legend(handles=[h for h, there in handles.items() if there], loc="outside lower center", ncols=4)
    return figure
