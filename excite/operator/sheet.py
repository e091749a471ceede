"""The driver's sheet (PDF, two pages A4): path and phases, warnings, sensors to set up, attainable accuracy."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from excite import reports
from excite.model import Model
from excite.model.machine import Machine, Sensor, noise_of, si_per_number
from excite.operator import ground
from excite.operator.ground import DriveQuality, TouchedGround, Trace
from excite.reports import COLOURS
from excite.simulation import Motion
from excite.text import format_number

A4 = (8.27, 11.69)
LEFT, RIGHT = 0.08, 0.95
GAP = 0.02  # between columns, as a share of the page's width
MAX_COARSER = 1.5  # scale of a map of the whole lane over one of the touched ground; chosen


@dataclass(frozen=True)
class Sheet:
    """Content of a driver's sheet.

    motions: the trace as driven by several people; the first path is drawn. room: the ground they touch.
    scores: attainable accuracy by way of driving. verdict: what a person keeps of the design, in a sentence.
    """

    title: str
    model: Model
    trace: Trace
    motions: tuple[Motion, ...]
    room: TouchedGround
    lane: tuple[float, float]
    warnings: tuple[str, ...]
    scores: tuple[tuple[str, DriveQuality], ...]
    verdict: str


def save_sheet(sheet: Sheet, path: Path) -> None:
    """Write the PDF without a date: the same drive gives the same bytes."""
    with PdfPages(path, metadata={"CreationDate": None, "Title": f"Driver's sheet: {sheet.title}"}) as pdf:
        for page in (_first(sheet), _second(sheet)):
            pdf.savefig(page)


def drive_facts(sheet: Sheet) -> list[tuple[str, str]]:
    """Return name and value of the drive's main numbers."""
    trace = sheet.trace
    top = float(np.abs(trace.speed).max())
    length = float(np.abs(trace.at(np.arange(0, trace.duration, 0.01))[0]).sum() * 0.01)
    rows = [
        ("time", f"{ground.format_clock(trace.duration)} min"),
        ("phases", str(len(trace))),
        ("direction changes", str(len(ground.reversal_times(trace)))),
        ("distance", f"{length:.0f} m"),
        ("top speed", f"{top:.1f} m/s, {3.6 * top:.1f} km/h"),
    ]
    tops = np.abs(trace.degrees).max(axis=0)
    rows += [(f"{lever.name} up to", f"{top:.0f}°") for lever, top in zip(trace.levers, tops, strict=True)]
    rows.append(("free ground", "{:.0f} x {:.0f} m".format(*sheet.room.free)))
    if np.isfinite(sheet.lane).all():
        rows.append(("lane", f"{sheet.lane[0]:g} x {sheet.lane[1]:g} m"))
    return rows


def _first(sheet: Sheet) -> Figure:
    figure = Figure(figsize=A4)
    _head(figure, sheet, 1)
    rows = drive_facts(sheet)
    _facts(figure, rows)
    lane = figure.add_axes((LEFT, 0.57, RIGHT - LEFT, 0.3))
    _lane(lane, sheet)
    trace = sheet.trace
    for k, part in enumerate(textwrap.wrap(ground.start_words(sheet.model, sheet.motions[0], trace, sheet.lane), 108)):
        figure.text(LEFT, 0.521 - 0.0128 * k, part, fontsize=8.5, weight="bold")
    space = 0.43 / (1 + len(trace.levers))
    bottom = figure.add_axes((LEFT, 0.48 - (space - 0.025), RIGHT - LEFT, space - 0.025))
    _trace(bottom, sheet, "speed [m/s]", ("forward", "backward"), trace.speed, ground.BAND_SPEED, 1.0)
    _numbers(bottom, trace)
    for k, (lever, degrees) in enumerate(zip(trace.levers, trace.degrees.T, strict=True), 1):
        bottom.tick_params(labelbottom=False)
        place = (LEFT, 0.48 - (k + 1) * space + 0.025, RIGHT - LEFT, space - 0.025)
        bottom = figure.add_axes(place, sharex=bottom)
        ends = ("left", "right")
        _trace(bottom, sheet, f"{lever.name} [°]", ends, degrees, np.rad2deg(ground.BAND_ANGLE), 5.0)
        bottom.yaxis.set_major_formatter(lambda degrees, _: f"{abs(degrees):g}")  # the side is said in words
    bottom.set_xlabel("time [s]; the grey band is the tolerance", fontsize=8)
    return figure


def _facts(figure: Figure, rows: Sequence[tuple[str, str]]) -> None:
    """Write facts side by side: values above their names, smaller if the page is too narrow for them."""
    texts = [
        (figure.text(LEFT, 0.908, value, fontsize=9, weight="bold"), figure.text(LEFT, 0.895, name, fontsize=7))
        for name, value in rows
    ]
    widths = np.array([max(text.get_window_extent().width for text in both) for both in texts]) / figure.bbox.width
    smaller = min(1.0, (RIGHT - LEFT - GAP * (len(rows) - 1)) / widths.sum())
    between = (RIGHT - LEFT - smaller * widths.sum()) / max(len(rows) - 1, 1)
    starts = LEFT + np.concatenate([[0.0], np.cumsum(smaller * widths + between)[:-1]])
    for x, both in zip(starts, texts, strict=True):
        for text in both:
            text.set_x(x)
            text.set_fontsize(smaller * text.get_fontsize())


def _head(figure: Figure, sheet: Sheet, page: int) -> None:
    figure.text(LEFT, 0.955, "Driver's sheet", fontsize=18, weight="bold")
    figure.text(LEFT, 0.937, sheet.title, fontsize=9.5)
    figure.text(RIGHT, 0.955, f"{page} / 2", fontsize=9, ha="right")


def _lane(ax: Axes, sheet: Sheet) -> None:
    """Draw the lane from above: touched ground, path of the first contact, start, changes of direction, end."""
    motion, model = sheet.motions[0], sheet.model
    edges = ground.contact_edges(model, motion)
    for right, left in edges:
        step = max(1, len(right) // 400)
        for k in range(0, len(right) - step, step):
            quad = [right[k], right[k + step], left[k + step], left[k]]
            ax.add_patch(Polygon(quad, closed=True, facecolor="0.88", edgecolor="none", zorder=1))
    centre = edges[0].mean(axis=0)
    v = sheet.trace.at(motion.t)[0]
    forward = v >= 0
    for ahead, colour, style, name in ((True, COLOURS[0], "-", "forward"), (False, COLOURS[1], "--", "backward")):
        if (v > 0 if ahead else v < 0).any():
            part = np.where((forward == ahead)[:, None], centre, np.nan)
            ax.plot(*part.T, color=colour, linestyle=style, linewidth=1.8, label=name, zorder=3)
    start = dict(zip(model.coordinates, model.true_coordinates(motion.q[0], model.nominal), strict=True))
    for outline in reports.footprints(model.machine, start):  # the machine at the start
        ax.add_patch(Polygon(outline, closed=True, facecolor="white", edgecolor="black", zorder=4))
    ax.plot(*edges.mean(axis=1)[:, 0].T, color="black", linewidth=1.5, zorder=4)
    marks = [("o", "START", centre[0]), ("s", "END", centre[-1])]
    for k, t in enumerate(ground.reversal_times(sheet.trace)):
        at = centre[min(round(t * float(model.machine.sampling_hz)), len(centre) - 1)]
        marks.append(("D", ground.reversal_letter(k), at))
    for t in np.arange(3.0, sheet.trace.duration, 6.0):  # direction of travel
        k = min(round(t * float(model.machine.sampling_hz)), len(centre) - 11)
        step = centre[k + 10] - centre[k]
        if np.hypot(*step) > 0.05:
            tip = centre[k] + step / np.hypot(*step) * 0.4
            ax.annotate("", tip, centre[k], arrowprops={"arrowstyle": "-|>", "color": "black"}, zorder=5)
    scale = _view(ax, sheet)
    half, view = np.array(sheet.lane) / 2, np.array([ax.get_xlim(), ax.get_ylim()])
    if not (np.abs(view) < half[:, None]).all():  # an edge of the lane is in the picture
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * half
        lane = f"lane {sheet.lane[0]:g} x {sheet.lane[1]:g} m"
        ax.plot(*corners.T, color="black", linestyle=":", linewidth=1.2, label=lane)
    if len(marks) > 2:
        ax.plot(
            [], [], "D", color="white", markeredgecolor="black", markersize=5, label="change of direction A, B, ..."
        )
    ax.plot([], [], color="0.8", linewidth=6, label="ground that is touched")
    metre = 36 / scale  # the axis is 2 scale metres an inch
    prints = [_box(outline * metre) for outline in reports.footprints(model.machine, start)]
    prints += _tape(ax, sheet, centre[0], metre)
    _mark(ax, marks, metre, [*prints, *((x, y, 2.0, 2.0) for x, y in centre[::25] * metre)])
    ax.set_xlabel("along the lane, from its middle [m] →", fontsize=8, labelpad=1)
    ax.set_ylabel("left of its middle [m] →", fontsize=8)
    ax.tick_params(labelsize=7)
    ax.grid(alpha=0.25)
    ax.legend(fontsize=7, ncols=5, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False, borderpad=0)


def _tape(ax: Axes, sheet: Sheet, start: np.ndarray, metre: float) -> list[tuple[float, float, float, float]]:
    """Draw the distances [m] of the start from the near end and the right side of the lane.

    metre: points per metre. Return the boxes (centre x, centre y, width, height) [points] of their words.
    """
    if not set(sheet.model.machine.body[0].coordinates) <= set(sheet.model.coordinates):
        return []
    boxes = []
    edges = ax.get_xlim()[0], ax.get_ylim()[0]
    for k, (edge, name) in enumerate(zip(edges, ("near end", "right side"), strict=True)):
        side = -sheet.lane[k] / 2
        end = start.copy()
        end[k] = max(side, edge)  # at the picture's edge where the lane goes on beyond it
        tip, tail = (end[0], end[1]), (start[0], start[1])
        ax.annotate("", tip, tail, arrowprops={"arrowstyle": "->", "linestyle": ":", "linewidth": 1.0}, zorder=2)
        text, shift = f"{start[k] - side:.1f} m to the {name}", ((3.0, -9.0), (4.0, 5.0))[k]
        ax.annotate(text, tip, xytext=shift, textcoords="offset points", fontsize=7, zorder=7)
        width = 3.7 * len(text)
        boxes.append((end[0] * metre + shift[0] + width / 2, end[1] * metre + shift[1] + 3.0, width, 8.0))
    return boxes


def _view(ax: Axes, sheet: Sheet) -> float:
    """Set equal axes over the touched ground, or the whole lane if not much larger; return half the metres per inch."""
    size = np.array([ax.get_position().width, ax.get_position().height]) * A4
    touched = np.array([sheet.room.corner, np.add(sheet.room.corner, (sheet.room.length, sheet.room.width))])
    touched += [[-0.7 * ground.FREE_MARGIN_M], [0.7 * ground.FREE_MARGIN_M]]
    half = np.array(sheet.lane) / 2 + 0.5
    both = np.array([np.minimum(touched[0], -half), np.maximum(touched[1], half)])
    near, far = (float((np.ptp(box, axis=0) / 2 / size).max()) for box in (touched, both))
    box, scale = (both, far) if far <= MAX_COARSER * near else (touched, near)
    low, high = box.mean(axis=0) - scale * size, box.mean(axis=0) + scale * size
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    return scale


def _box(points: np.ndarray) -> tuple[float, float, float, float]:
    """Return the box (centre x, centre y, width, height) around points (n, 2)."""
    return (*points.min(axis=0) / 2 + points.max(axis=0) / 2, *np.ptp(points, axis=0))


def _merged(
    marks: Sequence[tuple[str, str, np.ndarray]], metre: float, near: float = 7.0
) -> list[tuple[str, str, np.ndarray]]:
    """Merge marks of one kind that are less than `near` points apart into one with all their names."""
    made: list[tuple[str, str, np.ndarray]] = []
    for marker, text, at in marks:
        for k, (other, names, there) in enumerate(made):
            if other == marker and np.hypot(*(at - there)) * metre < near:
                made[k] = (marker, f"{names}, {text}", there)
                break
        else:
            made.append((marker, text, at))
    return made


def _mark(
    ax: Axes,
    marks: Sequence[tuple[str, str, np.ndarray]],
    metre: float,
    drawn: Sequence[tuple[float, float, float, float]] = (),
) -> None:
    """Draw markers with names, each name where it hides least.

    marks: (marker, name, place). metre: points per metre. drawn: boxes (centre x, centre y, width, height) [points]
    that names should not hide.
    """
    marks, turns = _merged(marks, metre), np.deg2rad(np.arange(45, 405, 30))
    taken: list[tuple[float, float, float, float]] = [*drawn, *((*(at * metre), 7.0, 7.0) for _, _, at in marks)]
    for marker, text, at in marks:
        filled = "white" if marker == "D" else "black"
        ax.plot(*at, marker, color=filled, markeredgecolor="black", markersize=6, zorder=6)
        width, height = 6.5 * len(text), 8.0
        around = [
            (far * np.cos(turn) + np.cos(turn) * width / 2, far * np.sin(turn) + np.sin(turn) * height / 2)
            for far in (9.0, 16.0, 25.0, 36.0)
            for turn in turns
        ]
        boxes = [(at[0] * metre + x, at[1] * metre + y, width, height) for x, y in around]
        hidden = [sum(_overlap(box, other) for other in taken) for box in boxes]
        k = int(np.argmin(hidden))  # the first of equals is the nearest
        taken.append(boxes[k])
        line = {"arrowstyle": "-", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3} if k >= len(turns) else None
        ax.annotate(
            text,
            (at[0], at[1]),
            xytext=around[k],
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            weight="bold",
            arrowprops=line,
            zorder=7,
        )


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Return the common area of two boxes (centre x, centre y, width, height)."""
    wide, high = (max(0.0, (one[k + 2] + other[k + 2]) / 2 - abs(one[k] - other[k])) for k in (0, 1))
    return wide * high


def _trace(
    ax: Axes, sheet: Sheet, label: str, ends: tuple[str, str], value: np.ndarray, band: float, least: float
) -> None:
    """Draw a channel of the trace in its tolerance band. ends: words for up and down."""
    trace = sheet.trace
    t = np.arange(0, trace.duration + 0.005, 0.05)
    low, high = ground.tolerance_band(t, np.interp(t, trace.times, value), band)
    ax.fill_between(t, low, high, color="0.85", linewidth=0)
    ax.plot(trace.times, value, color="black", linewidth=1.8)
    for k in range(len(trace)):
        if k % 2:
            ax.axvspan(trace.times[k], trace.times[k + 1], color=COLOURS[4], alpha=0.13, linewidth=0)
        ax.axvline(trace.times[k], color="0.5", linewidth=0.5)
    ax.axhline(0, color="black", linewidth=0.6)
    top = 1.25 * max(least, float(np.abs(value).max()))
    ax.set_ylim(-top, top)
    ax.set_xlim(0, trace.duration)
    ax.set_ylabel(label, fontsize=8)
    for word, y, side in zip(ends, (0.97, 0.03), ("top", "bottom"), strict=True):
        edge = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1}
        ax.text(0.994, y, word, transform=ax.transAxes, fontsize=8, weight="bold", ha="right", va=side, bbox=edge)
    ax.tick_params(labelsize=7)
    ax.grid(axis="y", alpha=0.3)


def _numbers(ax: Axes, trace: Trace) -> None:
    """Write the phases' numbers above the trace."""
    for k in range(len(trace)):
        middle = (trace.times[k] + trace.times[k + 1]) / 2
        ax.annotate(
            str(k + 1),
            (middle, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2),
            textcoords="offset points",
            ha="center",
            fontsize=7,
            weight="bold",
        )


def _second(sheet: Sheet) -> Figure:
    figure = Figure(figsize=A4)
    _head(figure, sheet, 2)
    trace = sheet.trace
    y = _title(figure, 0.91, "What to drive")
    space = min(0.0165, 0.40 / max(len(trace), 1))
    size = min(9.0, 8.5 * space / 0.0145)
    several = len(trace.levers) > 1
    then = [lever.name for lever in trace.levers] if several else ["speed", *("angle" for _ in trace.levers)]
    rows = [("no.", "at", "do", *(f"then {name}" for name in then))]
    for k in range(len(trace)):
        turned = [ground.angle_words(degrees) for degrees in trace.degrees[k + 1]]
        speed = f"{trace.speed[k + 1]:+.1f} m/s".replace("+0.0", "0").replace("-", "\N{MINUS SIGN}")
        do = ground.phase_parts(trace, k, letters=True)[0] if several else ground.phase_words(trace, k, letters=True)
        rows.append((str(k + 1), ground.format_clock(trace.times[k]), do, *(() if several else (speed,)), *turned))
    y = _table(figure, y, rows, space, size)
    y = _title(figure, y - 0.008, "Mind")
    y = _list(figure, y, sheet.warnings)
    y = _title(figure, y - 0.008, "Set up")
    y = _list(figure, y, set_up_lines(sheet.model.machine))
    y = _title(figure, y - 0.008, "What this drive gives in a person's hands")
    y = _list(figure, y, [sheet.verdict, *(_score_line(name, score) for name, score in sheet.scores)])
    return figure


def _table(figure: Figure, y: float, rows: Sequence[Sequence[str]], space: float, size: float) -> float:
    """Draw rows of texts, titles first; return the height below. Letters shrink if the table is wider than the page."""
    texts = [
        [
            figure.text(LEFT, y - k * space, text, fontsize=size if k else 7, color="black" if k else "0.25")
            for text in row
        ]
        for k, row in enumerate(rows)
    ]
    for row in texts[1:]:
        row[1].set_fontweight("bold")
    widths = np.array([[text.get_window_extent().width for text in row] for row in texts]).max(axis=0)
    widths /= figure.bbox.width
    room = RIGHT - LEFT - GAP * (len(widths) - 1)
    smaller = min(1.0, room / widths.sum())
    widths *= smaller
    widths[2] += max(0.0, room - widths.sum())
    starts = LEFT + np.cumsum([0.0, *widths[:-1] + GAP])
    for row in texts:
        for x, text in zip(starts, row, strict=True):
            text.set_x(x)
            text.set_fontsize(smaller * text.get_fontsize())
    return y - len(rows) * space


def _score_line(name: str, score: DriveQuality) -> str:
    return (
        f"{name}: attainable error {format_number(score.median_percent, 2)} % (median parameter),"
        f" {format_number(score.worst_percent, 2)} % (worst, {score.worst})"
    )


def _title(figure: Figure, y: float, text: str) -> float:
    figure.text(LEFT, y, text, fontsize=11, weight="bold")
    return y - 0.018


def _list(figure: Figure, y: float, lines: Sequence[str]) -> float:
    for line in lines:
        for k, part in enumerate(textwrap.wrap(line, 122)):
            figure.text(LEFT, y, ("•  " if k == 0 else "    ") + part, fontsize=7.8)
            y -= 0.0128
    return y


def set_up_lines(machine: Machine) -> list[str]:
    """Return a line for each sensor to mount and check before the drive."""
    rate = float(machine.sampling_hz)
    lines = [f"Log all columns at {rate:g} Hz, from 5 s before the drive to 5 s after it, the machine at rest."]
    return lines + [sensor_line(machine, s) for s in machine.sensors("full")]


def _noise_words(machine: Machine, sensor: Sensor) -> str:
    """Return the noise of a sensor in the unit of its column."""
    return f"{format_number(noise_of(machine, sensor) / si_per_number(machine, sensor), 3)} {sensor.unit}"


def sensor_line(machine: Machine, sensor: Sensor) -> str:
    """Describe a sensor: column, quantity, place, size, resolution and noise."""
    body = machine.find(sensor.body)
    where = (sensor.place or body.where).replace("_", " ")
    what = {
        "angle": f"angle of the {where}, counted on over turns",
        "wheel": f"angle of the {where}",
        "torque": f"torque at the {where}",
        "forward_speed": f"forward speed of the {where}",
        "ground_speed": f"speed over ground of the {where}",
        "yaw_rate": f"yaw rate of the {where}",
        "lateral_speed": f"lateral speed of the {where}",
        "x": f"position along x of the {where}",
        "y": f"position along y of the {where}",
    }[sensor.kind]
    if sensor.is_rate:
        what = f"rate of the {where}"
    if sensor.cylinders:
        what = f"torque at the {where}, by the pressures of its cylinders, the other in {sensor.return_column}"
    elif sensor.displacement is not None:
        what = f"torque at the {where}, by the motor's pressures, the other in {sensor.return_column}"
    extra = []
    if sensor.radius is not None and sensor.lateral is not None:
        side = "left" if float(sensor.lateral) > 0 else "right"
        extra.append(f"radius {float(sensor.radius):g} m, {abs(float(sensor.lateral)):g} m to the {side}: measure both")
    if sensor.counts_per_turn is not None:
        extra.append(f"{float(sensor.counts_per_turn):g} counts per turn")
    if sensor.noise is not None:
        extra.append(f"noise below {_noise_words(machine, sensor)}")
    kit = "" if "paper" in sensor.kits else "; optional"
    return f"{sensor.column} [{sensor.unit}]: {what}" + (f"; {', '.join(extra)}" if extra else "") + kit
