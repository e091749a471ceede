"""Charts of a report to zoom into: what a figure's axes over time show, drawn by Bokeh without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.colors import LogNorm, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

EXPLORE = "explore"  # gid of axes that are no plot over time and become a chart all the same
MAX_VALUES = 100_000  # 32-bit numbers in the curves of a page, half a megabyte of text; chosen
MIN_POINTS = 400  # of a curve, however many there are; chosen
ROOM = 45  # px of a chart for legend and axis; chosen
PX_PER_INCH = 90  # of the figure's axes; chosen
MIN_HEIGHT = 110  # px of a chart without its labels; chosen
DASHES = {"-": "solid", "--": "dashed", "-.": "dashdot", ":": "dotted"}


@dataclass(frozen=True)
class Curve:
    """A curve of a panel; label: "" for none. marker: of points without a line between them."""

    label: str
    x: np.ndarray
    y: np.ndarray
    colour: str
    dash: str
    marker: bool


@dataclass(frozen=True)
class Image:
    """Values (rows, columns) on a grid, coloured by `palette` from low to high."""

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    palette: tuple[str, ...]
    low: float
    high: float
    logarithmic: bool


@dataclass(frozen=True)
class Panel:
    """The content of one axes of a figure. outlines: of shaded bands, each with colour and opacity."""

    x_label: str
    y_label: str
    title: str
    height: int
    curves: tuple[Curve, ...]
    outlines: tuple[tuple[np.ndarray, str, float], ...] = ()
    levels: tuple[float, ...] = ()
    image: Image | None = None
    x_limits: tuple[float, float] = (0.0, 1.0)
    y_limits: tuple[float, float] = (0.0, 1.0)
    x_ticks: Mapping[float, str] = field(default_factory=dict)
    y_ticks: Mapping[float, str] = field(default_factory=dict)

    @property
    def empty(self) -> bool:
        return not self.curves and not self.outlines and self.image is None

    @property
    def over_time(self) -> bool:
        return self.x_label.startswith("time")


@dataclass(frozen=True)
class Explorable:
    """The part of a figure that a chart shows; whole: whether that is all of it, but for colour bars."""

    panels: tuple[Panel, ...]
    whole: bool


def explorable(figure: Figure) -> Explorable:
    """Return what the axes of a figure show that are over time (their label says so) or have the gid EXPLORE.

    Axes that are hidden or hold no curve, band or image give no panel.
    """
    axes = [ax for ax in figure.axes if ax.get_visible()]
    panels = {ax: _panel(ax) for ax in axes if ax.get_gid() == EXPLORE or _over_time(ax)}
    shown = {ax: panel for ax, panel in panels.items() if not panel.empty}
    left = [ax for ax in axes if ax not in shown and ax.get_label() != "<colorbar>"]
    return Explorable(tuple(shown.values()), not left)


def _x_label(ax: Axes) -> str:
    siblings = ax.get_shared_x_axes().get_siblings(ax)
    return next((text for one in siblings if (text := one.get_xlabel())), "")


def _over_time(ax: Axes) -> bool:
    return _x_label(ax).startswith("time") and ax.get_yscale() == "linear"


def _panel(ax: Axes) -> Panel:
    curves: list[Curve] = []
    levels: list[float] = []
    for line in ax.lines:
        x, y = (np.asarray(v, float) for v in line.get_data())
        if line.get_transform() != ax.transData:
            if line.get_transform() == ax.get_yaxis_transform(which="grid"):
                levels.append(float(y[0]))
        elif len(x):
            curves.append(_curve(line, x, y))
    outlines: list[tuple[np.ndarray, str, float]] = []
    image = None
    for shape in ax.collections:
        if isinstance(shape, QuadMesh):
            image = _image(shape)
        elif isinstance(shape, PolyCollection):
            red, green, blue, opacity = np.asarray(shape.get_facecolor())[0]
            colour = to_hex((red, green, blue))
            outlines += [(np.asarray(path.vertices), colour, float(opacity)) for path in shape.get_paths()]
    whole = ax.get_figure(root=True)
    assert whole is not None
    height = ax.get_position().height * whole.get_figheight() * PX_PER_INCH
    x_label, y_label = (text.replace(r"\$", "$").replace("\n", " ") for text in (_x_label(ax), ax.get_ylabel()))
    return Panel(
        x_label,
        y_label,
        ax.get_title("left"),
        max(int(height), MIN_HEIGHT),
        tuple(curves),
        tuple(outlines),
        tuple(levels),
        image,
        ax.get_xlim(),
        ax.get_ylim(),
        _named(ax.xaxis),
        _named(ax.yaxis),
    )


def _named(axis: Any) -> dict[float, str]:
    """Return the ticks of an axis that have names of their own."""
    from matplotlib.ticker import FixedFormatter, FuncFormatter

    if not isinstance(axis.get_major_formatter(), FixedFormatter | FuncFormatter):
        return {}
    return {float(x): label.get_text() for x, label in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)}


def _curve(line: Line2D, x: np.ndarray, y: np.ndarray) -> Curve:
    label, style = str(line.get_label()), line.get_linestyle()
    dash = DASHES.get(str(style), "dashed")
    return Curve("" if label.startswith("_") else label, x, y, to_hex(line.get_color()), dash, str(style) == "None")


def _image(mesh: QuadMesh) -> Image:
    corners = np.asarray(mesh.get_coordinates())
    palette = tuple(to_hex(c) for c in mesh.get_cmap()(np.linspace(0, 1, 128)))
    values: np.ndarray = np.ma.filled(np.ma.asarray(mesh.get_array(), float), np.nan)
    low, high = (float(v) for v in mesh.get_clim() if v is not None)
    return Image(corners[0, :, 0], corners[:, 0, 1], values, palette, low, high, isinstance(mesh.norm, LogNorm))


def thin_out(curves: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Return the indices of at most about `most` samples of several curves (n,), with all their peaks.

    Of each of equally long stretches the lowest and the highest sample of every curve stay, and both ends.
    """
    n = len(curves[0])
    if n <= most:
        return np.arange(n)
    kept = [0, n - 1]
    for part in np.array_split(np.arange(n), max(most // (2 * len(curves)), 1)):
        for y in curves:
            known = part[np.isfinite(y[part])]
            if len(known):
                kept += [known[np.argmin(y[known])], known[np.argmax(y[known])]]
            kept += [k for k in part[:1] if len(known) < len(part)]  # a gap stays one
    return np.unique(kept)


def documents(figures: Mapping[str, Sequence[Panel]]) -> dict[str, str]:
    """Return for each figure that has panels its chart: a Bokeh document as JSON, safe within a script element.

    Panels over time are linked. Curves are thinned out to MAX_VALUES on a page.
    """
    figures = {name: panels for name, panels in figures.items() if panels}
    points = sum(len(c.x) for panels in figures.values() for p in panels for c in p.curves)
    share = min(1.0, MAX_VALUES / max(2 * points, 1))
    return {name: _document(panels, share).replace("<", "\\u003c") for name, panels in figures.items()}


def library() -> str:
    """Return the script that draws charts."""
    from bokeh.resources import Resources

    return "\n".join(Resources(mode="inline", components=["bokeh"]).js_raw)


def _document(panels: Sequence[Panel], share: float) -> str:
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot
    from bokeh.models import CrosshairTool, DataRange1d, Span

    time, across = DataRange1d(range_padding=0), Span(dimension="height", line_dash="dotted", line_color="#444444")
    rows = []
    for k, panel in enumerate(panels):
        plot = _plot(panel, share)
        if panel.over_time:
            plot.x_range = time
            plot.add_tools(CrosshairTool(overlay=across, dimensions="height"))
            if any(other.over_time for other in panels[k + 1 :]):
                plot.xaxis.axis_label = None
        rows.append([plot])
    grid = gridplot(rows, sizing_mode="stretch_width", merge_tools=True, toolbar_options={"logo": None})
    return json.dumps(json_item(grid))


def _plot(panel: Panel, share: float) -> Any:
    """Return a panel as a plot with its tools."""
    from bokeh.models import BoxZoomTool, Legend, PanTool, Range1d, ResetTool, SaveTool, Span, WheelZoomTool
    from bokeh.plotting import figure

    zoom = BoxZoomTool()
    plot = figure(
        height=panel.height + ROOM,
        tools=[zoom, PanTool(), WheelZoomTool(), ResetTool(), SaveTool()],
        active_drag=zoom,
        active_scroll=None,
        x_axis_label=panel.x_label,
        y_axis_label=panel.y_label,
        title=panel.title or None,
        min_border_left=90,
    )
    for axis, ticks in ((plot.xaxis, panel.x_ticks), (plot.yaxis, panel.y_ticks)):
        if ticks:
            axis.ticker = list(ticks)
            axis.major_label_overrides = dict(ticks)
    if panel.image is not None:
        _draw_image(plot, panel, panel.image)
        plot.x_range, plot.y_range = (Range1d(*limits) for limits in (panel.x_limits, panel.y_limits))
        if panel.x_ticks:
            plot.xaxis.major_label_orientation = "vertical"
    for outline, colour, opacity in panel.outlines:
        plot.patch(*outline.astype(np.float32).T, fill_color=colour, fill_alpha=opacity, line_color=None)
    for level in panel.levels:
        plot.add_layout(Span(location=level, dimension="width", line_color="black", line_dash="dotted"))
    legend = []
    for together in _by_x(panel.curves):
        legend += _draw_curves(plot, panel, together, share)
    if len(legend) > 1:
        style = {"orientation": "horizontal", "click_policy": "hide", "border_line_color": None, "padding": 0}
        plot.add_layout(Legend(items=legend, label_text_font_size="9pt", **style), "above")
    return plot


def _by_x(curves: Sequence[Curve]) -> list[list[Curve]]:
    """Return the curves in groups of the same x, which share a table of values."""
    groups: list[list[Curve]] = []
    for one in curves:
        same = (g for g in groups if g[0].marker == one.marker and np.array_equal(g[0].x, one.x))
        group = next(same, None)
        groups.append([one]) if group is None else group.append(one)
    return groups


def _draw_curves(plot: Any, panel: Panel, curves: Sequence[Curve], share: float) -> list[tuple[str, list[Any]]]:
    """Draw curves of the same x with their values under the pointer; return what a legend says of them."""
    from bokeh.models import ColumnDataSource, HoverTool

    kept = thin_out([c.y for c in curves], max(int(share * len(curves[0].x)), MIN_POINTS))
    data = {"x": curves[0].x[kept].astype(np.float32)}
    data |= {f"y{k}": c.y[kept].astype(np.float32) for k, c in enumerate(curves)}
    source, legend, drawn = ColumnDataSource(data), [], []
    for k, c in enumerate(curves):
        if c.marker:
            drawn.append(plot.scatter("x", f"y{k}", source=source, color=c.colour, size=3))
        else:
            drawn.append(plot.line("x", f"y{k}", source=source, color=c.colour, line_dash=c.dash, line_width=1.5))
        if c.label:
            legend.append((c.label, [drawn[-1]]))
    unit = panel.y_label.partition("[")[2].partition("]")[0]
    shown = "" if unit == "-" else unit
    x_name, x_unit = panel.x_label.rstrip("]").partition(" [")[::2]
    tips = [(x_name, f"@x{{%.5g}} {x_unit}")]
    tips += [(c.label or panel.y_label.partition(" [")[0], f"@y{k}{{%.5g}} {shown}") for k, c in enumerate(curves)]
    formats = {f"@{column}": "printf" for column in data}
    plot.add_tools(HoverTool(renderers=drawn[:1], tooltips=tips, formatters=formats, mode="vline"))
    return legend


def _draw_image(plot: Any, panel: Panel, image: Image) -> None:
    from bokeh.models import ColorBar, HoverTool, LinearColorMapper, LogColorMapper

    mapper = (LogColorMapper if image.logarithmic else LinearColorMapper)(
        palette=list(image.palette), low=image.low, high=image.high, nan_color="#dddddd"
    )
    x, y = image.x, image.y
    centres = np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2)
    widths = np.meshgrid(np.diff(x), np.diff(y))
    columns = dict(zip("xywh", (*centres, *widths), strict=True)) | {"value": image.values}
    data = {name: np.asarray(v, np.float32).ravel() for name, v in columns.items()}
    plot.add_layout(ColorBar(color_mapper=mapper, width=12), "right")
    rows, columns_named = list(panel.y_ticks.values()), list(panel.x_ticks.values())
    tips = [("value", "@value{0.00}")]
    if len(rows) == len(y) - 1:
        data["row"], tips = np.repeat(rows, len(x) - 1), [("", "@row"), *tips]
    if len(columns_named) == len(x) - 1:
        data["column"], tips = np.tile(columns_named, len(y) - 1), [*tips[:-1], ("", "@column"), tips[-1]]
    else:
        tips = [(panel.x_label, "@x{0.00}"), *tips]
    glyph = plot.rect(
        "x", "y", "w", "h", source=data, line_color=None, fill_color={"field": "value", "transform": mapper}
    )
    plot.add_tools(HoverTool(renderers=[glyph], tooltips=tips))
