"""Figures of drives: what they do, how accurate they are, and how they compare."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from scipy.signal import find_peaks

from excite import simulation, trajectories
from excite.model import Model
from excite.model.machine import Problem
from excite.reports.figure_files import layout_width
from excite.reports.figures import (
    COLOURS,
    ROW_IN,
    draw_lines,
    is_narrow,
    legend_above,
    legend_below,
    line_style,
    new_figure,
    row_blocks,
    set_title,
    wrap_label,
    write_value,
)
from excite.simulation import Motion
from excite.text import count, format_number
from excite.trajectories import DESIGNED, ComparisonRow, SensorValue

ATTAINABLE = "attainable standard deviation\n[% of the nominal value]"  # label of an axis
PANEL_IN, PANEL_NARROW_IN, PATH_IN, MIN_DESIGN_IN = 2.3, 1.6, 2.6, 7.5  # heights of panels, and of the figure; chosen
LEAST_SHARE, LEAST_SHARE_WITH_PATH = 0.8, 0.87  # of the height of a narrow figure, that its texts need; chosen
AXIS_IN, BARS_EDGE_IN = 0.9, 0.9  # room for the labels of an axis, and above and below bars; chosen
LINE_INCHES = 0.165  # of a limit's name; chosen
LIMIT_LETTERS = 32  # of a limit's name in a line; chosen
NAME_LETTERS, NAME_LETTERS_NARROW = 44, 24  # of a drive's name in a line; chosen
LABEL_ROOM = 2.5  # factor on a logarithmic axis that leaves room for the value beside a point; chosen
MAX_DECADE_TICKS = 7  # of a logarithmic axis; chosen
MIN_SWING_PERCENT = 4.0  # of a torque's limit that is seen as a swing; chosen
PATH_FLATNESS = 0.3  # least ratio of height to width, or of width to height, of the ground in sight; chosen
EXCERPT_SWINGS = 6  # in an excerpt; chosen
EXCERPTS_IN_DRIVE = 12  # excerpts of such swings in a drive, from which it needs one; chosen


def design_figure(model: Model, problem: Problem, motion: Motion, title: str) -> Figure:
    """Plot a drive: torques, speeds, joint angles and slips over time, the path, and the used share of each limit.

    Torques that swing too fast to be seen have an excerpt below them.
    """
    panels = _time_panels(model, motion)
    use = limit_use(model, problem, motion)
    limits = ["\n".join(textwrap.wrap(n.replace("_", " "), LIMIT_LETTERS)) for n in use]
    bars_in = LINE_INCHES * len(limits) * max(n.count("\n") + 1 for n in limits) + BARS_EDGE_IN
    lane = model.machine.planar and f"y{model.machine.body[0].index}" in model.coordinates
    width, narrow = layout_width(11.5), is_narrow(11.5)
    panels_in = (PANEL_NARROW_IN if narrow else PANEL_IN) * len(panels) + 0.6
    path_in = PATH_IN if lane else 0.0
    height = panels_in + bars_in + path_in if narrow else max(panels_in, bars_in + path_in, MIN_DESIGN_IN)
    figure = new_figure(11.5, height, (LEAST_SHARE_WITH_PATH if lane else LEAST_SHARE) * height if narrow else 0.0)
    if narrow:
        ratios = (panels_in, bars_in + path_in)
        parts: Any = figure.subfigures(2, 1, height_ratios=ratios)
    else:
        parts = figure.subfigures(1, 2, width_ratios=(1.7, 1))
    left, right = parts
    axes = left.subplots(len(panels), 1, squeeze=False)[:, 0]
    set_title(figure, title)
    room = width - AXIS_IN if narrow else width * 1.7 / 2.7 - AXIS_IN
    _draw_panels(axes, panels, room)
    if lane:
        path, bars = right.subplots(2, 1, height_ratios=(path_in, bars_in))
        _path(path, model, problem, motion, width - AXIS_IN if narrow else width / 2.7 - AXIS_IN)
    else:
        bars = right.subplots(1, 1)
    bars.barh(range(len(use)), [100 * x for x in use.values()][::-1], color=COLOURS[0], height=0.6)
    bars.axvline(100, color="black", linewidth=0.8, linestyle=(0, (2, 3)))
    bars.set_xlim(0, 115)
    bars.set_ylim(-0.7, len(use) - 0.3)
    bars.set_xlabel("most used\n[% of the limit]")
    bars.set_yticks(range(len(use)), limits[::-1])
    bars.tick_params(axis="y", labelsize=8)
    return figure


@dataclass(frozen=True)
class TimePanel:
    """Curves over time with a label, the limits that are drawn as dotted lines, and the axis's range; None: fitted."""

    label: str
    t: np.ndarray
    curves: Mapping[str, np.ndarray]
    bounds: tuple[float, ...] = ()
    reach: tuple[float, float] | None = None
    excerpt: bool = False


def _time_panels(model: Model, motion: Motion) -> list[TimePanel]:
    """Return the panels of a drive over time: torques, an excerpt if they swing fast, speeds, angles, slips."""
    machine, t = model.machine, motion.t
    # Torques in per cent of their limits, so that one panel shows joints of all sizes.
    named = {b.where.replace("_", " "): k for k, b in enumerate(machine.actuated)}
    tops = [float(b.limit.torque or np.abs(motion.u[:, k]).max() or 1.0) for k, b in enumerate(machine.actuated)]
    unit = "N m" if all(b.joint == "revolute" for b in machine.actuated) else "N"
    curves = {f"{n} ({tops[k]:g} {unit})": 100 * motion.u[:, k] / tops[k] for n, k in named.items()}
    panels = [TimePanel("torque [% of limit]", t, curves, (-100.0, 100.0), (-115.0, 115.0))]
    part = _fast_part(t, list(curves.values()))
    if part is not None:
        panels.append(TimePanel("torque, excerpt\n[%]", t[part], {n: y[part] for n, y in curves.items()}, excerpt=True))
    speeds: dict[str, np.ndarray] = {}
    if machine.planar:
        speeds["forward speed"] = motion.nu[:, 0]
    for b in machine.contacts:
        assert b.contact is not None
        rim = float(b.contact.radius) * machine.joint_values(b, motion.nu.T)
        speeds[f"rim of {b.name.replace('_', ' ')}"] = rim
    if not speeds:
        called = {b.coordinates[0]: b.where.replace("_", " ") for b in machine.actuated}
        speeds = {called.get(c, c): motion.nu[:, k] for k, c in enumerate(model.coordinates)}
    rates = {"m/s"} if machine.planar else {"rad/s" if b.joint == "revolute" else "m/s" for b in machine.actuated}
    rims = [float(b.limit.rim_speed) for b in machine.contacts if b.limit.rim_speed is not None]
    fastest = (-max(rims), max(rims)) if rims else ()
    panels.append(TimePanel(f"speed [{' or '.join(sorted(rates))}]", t, speeds, fastest))
    moving = [b for b in machine.actuated if b.limit.position_range is not None]
    if moving:
        angles = {b.where.replace("_", " "): motion.q[:, model.coordinates.index(b.coordinates[0])] for b in moving}
        lows, highs = zip(*(b.limit.position_range for b in moving if b.limit.position_range is not None), strict=True)
        label = "angle [rad]" if all(b.joint == "revolute" for b in moving) else "position\n[rad or m]"
        panels.append(TimePanel(label, t, angles, (min(lows), max(highs))))
    slips: dict[str, np.ndarray] = {}
    for (index, _), x in zip(
        model.edges, simulation.resultant_slips(model, motion.q, motion.nu, model.nominal).T, strict=True
    ):
        name = machine.find(index).where.replace("_", " ")
        slips[name] = np.maximum(slips.get(name, x), x)
    if slips:
        allowed = [float(b.contact.slip_limit) for b in machine.contacts if b.contact and b.contact.slip_limit]
        panels.append(TimePanel("largest slip [-]", t, slips, (max(allowed),) if allowed else ()))
    return panels


def _fast_part(t: np.ndarray, curves: Sequence[np.ndarray]) -> slice | None:
    """Return the part of a drive in which curves [%] swing too fast to be seen, and most; None without one."""
    found: list[tuple[float, slice]] = []
    for y in curves:
        peaks, of = find_peaks(y, prominence=MIN_SWING_PERCENT)
        for k, (first, last) in enumerate(zip(peaks, peaks[EXCERPT_SWINGS:], strict=False)):
            if t[last] - t[first] < (t[-1] - t[0]) / EXCERPTS_IN_DRIVE:
                size = float(of["prominences"][k : k + EXCERPT_SWINGS + 1].sum())
                found.append((size, slice(int(first), int(last) + 1)))
    return max(found, key=lambda one: one[0], default=(0.0, None))[1]


def _draw_panels(axes: Sequence[Axes], panels: Sequence[TimePanel], room: float) -> None:
    """Draw panels below each other; all but excerpts share the axis of time. room [in]: of a legend."""
    shared = [ax for ax, one in zip(axes, panels, strict=True) if not one.excerpt]
    for ax, one in zip(axes, panels, strict=True):
        draw_lines(ax, one.t, one.curves, one.label, None if one.excerpt else room)
        for y in one.bounds:
            ax.axhline(y, color="black", linewidth=0.8, linestyle=(0, (2, 3)))
        if one.reach is not None:
            ax.set_ylim(*one.reach)
        if one.excerpt:
            ax.margins(x=0)
        elif ax is not shared[0]:
            ax.sharex(shared[0])
            ax.tick_params(labelbottom=ax is shared[-1])
        elif panels[1].excerpt:
            ax.axvspan(panels[1].t[0], panels[1].t[-1], color="0.85", zorder=0)
        else:
            ax.tick_params(labelbottom=False)
    shared[-1].set_xlabel("time [s]")


def _path(ax: Axes, model: Model, problem: Problem, motion: Motion, room: float) -> None:
    """Draw the path on the ground that it uses, with the lane where that is in sight. room [in]: of the legend."""
    q = model.true_coordinates(motion.q, model.nominal)
    places = model.kinematics(q.T, motion.nu.T)[3].full().reshape(3, len(motion.t), len(model.machine.body))
    for k, i in enumerate(problem.lane_points):
        body = model.machine.find(i)
        x, y, _ = places[:, :, model.machine.body.index(body)]
        ax.plot(x, y, **line_style(k), linewidth=1.2, label=body.name.replace("_", " "))
        ax.plot(x[0], y[0], "o", color=line_style(k)["color"], markersize=5)
    ends = np.concatenate([line.get_xydata() for line in ax.lines])
    middle, reach = (ends.max(axis=0) + ends.min(axis=0)) / 2, np.ptp(ends, axis=0) / 2
    reach = np.maximum(1.1 * reach, PATH_FLATNESS * reach.max())
    ax.set(xlim=middle[0] + [-reach[0], reach[0]], ylim=middle[1] + [-reach[1], reach[1]], aspect="equal")
    length, width = problem.lane
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    lane = corners.T * [[length / 2], [width / 2]]
    ax.plot(*lane, "k:", linewidth=0.8)
    ax.set_xlabel("x on the lane [m]")
    ax.set_ylabel("y [m]")
    legend_above(ax, room)
    ax.grid(alpha=0.3)


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


def sigma_figure(sigma: Mapping[str, float], title: str) -> Figure:
    """Plot the attainable standard deviation [%] of every parameter (Cramer-Rao bound)."""
    parts = row_blocks(len(sigma), is_narrow(7.5))
    rows = max(len(part) for part in parts)
    figure = new_figure(7.5 if len(parts) == 1 else 11.0, 1.2 + ROW_IN * rows)
    axes = figure.subplots(1, len(parts), squeeze=False, sharex=True)[0]
    set_title(figure, title)
    names, values = list(sigma), np.array(list(sigma.values()))
    low, high = 10.0 ** np.floor(np.log10(values.min())), 10.0 ** np.ceil(np.log10(values.max()) + 1e-9)
    for ax, part in zip(axes, parts, strict=True):
        places = np.arange(len(part))[::-1] + rows - len(part)
        ax.plot(values[part], places, "o", color=COLOURS[0], markersize=5)
        for y, value in zip(places, values[part], strict=True):
            write_value(ax, format_number(value, 2), value, y)
        ax.set_yticks(places, [names[k] for k in part], fontsize=8)
        _logarithmic(ax, low, LABEL_ROOM * high)
        ax.set_ylim(-0.7, rows - 0.3)
        ax.grid(axis="y", alpha=0.5, linestyle=":")
        ax.set_xlabel(ATTAINABLE, fontsize=9)
    return figure


def _logarithmic(ax: Axes, low: float, high: float) -> None:
    """Scale the x axis of points logarithmically, with plain numbers at so many ticks as have room."""
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    ax.xaxis.set_major_locator(LogLocator(numticks=MAX_DECADE_TICKS))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter("")
    ax.tick_params(axis="x", labelsize=8)
    ax.grid(axis="x", alpha=0.3)


def _plain_numbers(axis: Axis) -> None:
    """Label decades of a logarithmic axis, and twice and five times as much, with plain numbers."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(LogLocator(subs=(2, 5)))
    axis.set_minor_formatter(lambda x, place: format_number(x, 2))


def sensors_figure(values: Sequence[SensorValue], title: str) -> Figure:
    """Plot the accuracy of the worst and the median parameter [%] after each change of the sensors."""
    now, *changes = values
    names = [wrap_label(f"{v.sensor}, {v.change}", 28 if is_narrow(8) else 44) for v in changes][::-1]
    figure = new_figure(8, 1.9 + sum(0.08 + LINE_INCHES * (1 + name.count("\n")) for name in names))
    ax = figure.subplots()
    set_title(figure, title)
    of = {"worst": ("worst_percent", "o"), "median": ("median_percent", "s")}
    for k, (label, (key, mark)) in enumerate(of.items()):
        ax.axvline(getattr(now, key), color=COLOURS[k], linewidth=1, label=f"{label} without a change")
        ax.plot([getattr(v, key) for v in changes][::-1], names, mark, color=COLOURS[k], label=f"{label} parameter")
    ax.set_xscale("log")
    _plain_numbers(ax.xaxis)
    ax.tick_params(axis="both", which="both", labelsize=8)
    ax.set_xlabel(ATTAINABLE, fontsize=8)
    ax.grid(axis="x", which="both", alpha=0.3)
    legend_below(figure, *ax.get_legend_handles_labels())
    return figure


def campaign_figure(summary: Mapping[str, Any], title: str) -> Figure:
    """Plot what drives designed together attain [%] over the time of driving [min], from a campaign's summary."""
    figure = new_figure(7.5, 4.8)
    ax = figure.subplots()
    set_title(figure, title)
    draw_campaign(ax, summary)
    legend_below(figure, *ax.get_legend_handles_labels())
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
        ax.plot(minutes, [percent for _, percent in own], marker="o", markersize=4, **line_style(k), label=label)
    ax.axhline(target, color="k", linestyle=":", linewidth=1, label="target")
    ax.plot(summary["total_s"] / 60, summary["attained_percent"], "kD", fillstyle="none", markersize=9, label="answer")
    ax.set_xscale("log")
    ax.set_yscale("log")
    _plain_numbers(ax.xaxis)
    _plain_numbers(ax.yaxis)
    ax.tick_params(which="minor", labelsize=8)
    ax.set_xlabel("driving [min]")
    ax.set_ylabel(f"{'worst parameter' if summary['objective'] == 'worst' else summary['objective']} [%]")
    ax.grid(alpha=0.3, which="both")


def compare_figure(rows: Sequence[ComparisonRow], title: str) -> Figure:
    """Plot cond(Phi) and the attainable accuracy of the worst parameter of several drives, lowest cond(Phi) on top.

    Drives that break a limit, which their label names, have hollow points.
    """
    rows = sorted(rows, key=lambda r: r.cond_phi, reverse=True)
    narrow = is_narrow(10.5)
    letters = NAME_LETTERS_NARROW if narrow else NAME_LETTERS
    names = [wrap_label(r.name if r.breaks is None else f"{r.name} (breaks {r.breaks})", letters) for r in rows]
    height = sum(0.16 + 0.14 * (1 + name.count("\n")) for name in names)
    figure = new_figure(10.5, 1.3 + (2 * height + 0.8 if narrow else height))
    axes = figure.subplots(2, 1) if narrow else figure.subplots(1, 2, sharey=True)
    set_title(figure, title)
    values = ([r.cond_phi for r in rows], [r.worst_std_percent for r in rows])
    labels = ("cond(Phi)", "worst parameter: attainable\nstandard deviation [%]")
    for ax, x, label in zip(axes, values, labels, strict=True):
        finite = [value for value in x if np.isfinite(value)] or [1.0]
        for y, (r, value) in enumerate(zip(rows, x, strict=True)):
            colour, at = COLOURS[1 if r.name == DESIGNED else 0], min(value, 2 * max(finite))
            mark = "D" if r.name == DESIGNED else "o"
            ax.plot(at, y, mark, color=colour, fillstyle="full" if r.breaks is None else "none", markersize=6)
            write_value(ax, format_number(value, 3), at, y)
        _logarithmic(ax, min(finite) / 2, 2 * LABEL_ROOM * max(finite))
        ax.set_ylim(-0.6, len(rows) - 0.4)
        ax.set_xlabel(label)
        ax.grid(axis="y", alpha=0.5, linestyle=":")
    for ax in axes[: 2 if narrow else 1]:
        ax.set_yticks(range(len(rows)), names, fontsize=8)
        for tick, r in zip(ax.get_yticklabels(), rows, strict=True):  # bold, as colour is lost in black and white
            tick.set_fontweight("bold" if r.name == DESIGNED else "normal")
    return figure
