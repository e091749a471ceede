"""Figure of contact laws fitted to a single-wheel test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from excite.identification import SlipFit, SlipLaw
from excite.logs import SlipTable
from excite.reports.figures import COLOURS, STYLES, is_narrow, legend_below, new_figure, set_title, wrap_label
from excite.text import format_number

MAX_BARS = 10  # laws whose errors are drawn; chosen
ANGLES_DIFFER = np.radians(2)  # chosen
LAW_LETTERS = 22  # of a law's name in a line; chosen
MARKERS = "osDv^<>"
GREYS = ("black", "0.35", "0.6")


def slip_figure(fit: SlipFit, soil: SlipLaw | None, title: str) -> Figure:
    """Plot forces against slip, measured and by the supported laws, and errors on settings left out.

    soil: a law from soil constants, drawn beside them.
    """
    roles = list(fit.table.forces)
    shown = list(dict.fromkeys((*fit.supported[:3], next((x for x in fit.laws if not x.parts), fit.laws[-1]))))
    own = 6.5 + 4.0 * len(roles)
    if is_narrow(own):
        figure = new_figure(own, 2.8 * len(roles) + 4.8)
        axes: Any = figure.subplots(len(roles) + 1, 1, height_ratios=(*[2.8] * len(roles), 4.2))
    else:
        figure = new_figure(own, 5.6)
        axes = figure.subplots(1, len(roles) + 1, width_ratios=(*[1.3] * len(roles), 1.0))
    set_title(figure, title)
    for column, (ax, role) in enumerate(zip(axes, roles, strict=False)):
        _curves(ax, fit.table, column, role, shown, soil)
    _bars(axes[-1], fit, soil)
    key = [(handle, name) for ax in axes[[0, -1]] for handle, name in zip(*ax.get_legend_handles_labels(), strict=True)]
    legend_below(figure, [handle for handle, _ in key], [name for _, name in key])
    return figure


def _curves(ax: Axes, table: SlipTable, column: int, role: str, laws: Sequence[SlipLaw], soil: SlipLaw | None) -> None:
    """Draw one force against slip, with a mark for each slip angle and a line for each law."""
    angle = np.round(table.angle / ANGLES_DIFFER) * ANGLES_DIFFER
    angles = np.unique(angle)
    for k, at in enumerate(angles):
        own = angle == at
        label = f"measured{f', {np.degrees(table.angle[own].mean()):.0f} deg' if len(angles) > 1 else ''}"
        marker, grey = MARKERS[k % len(MARKERS)], GREYS[k % len(GREYS)]
        ax.plot(table.slip[own], table.forces[role][own], marker, color=grey, markersize=4, label=label)
    for k, law in enumerate((*laws, *([soil] if soil else []))):
        for i, at in enumerate(angles):
            along = _along(table, angle == at)
            forces = law.forces(along)
            if column < forces.shape[1]:
                (line,) = ax.plot(along.slip, forces[:, column], linewidth=1.3, label=None if i else law.name)
                line.set(color=COLOURS[k % len(COLOURS)], linestyle=STYLES[k % len(STYLES)])
    reach = np.concatenate([table.forces[role], [0.0]])
    margin = 0.25 * float(np.ptp(reach)) or 1.0
    ax.set_ylim(reach.min() - margin, reach.max() + margin)
    ax.set_xlabel(f"slip per {'rim speed' if table.per == 'rim' else 'larger speed'}, + driving [-]")
    ax.set_ylabel(f"{'side force' if role == 'side' else role} [N]")
    ax.grid(alpha=0.3)


def _along(table: SlipTable, at: np.ndarray) -> SlipTable:
    """Return a fine grid over the slips of some rows, at their mean slip angle, speed and load."""
    Vx, Vy = float(table.Vx[at].mean()), float(table.Vy[at].mean())
    ratio = table.rim[at] / np.maximum(np.abs(table.Vx[at]), 1e-12)
    even_braking, even_driving = np.linspace(ratio.min(), 1, 200), 1 / np.linspace(1, 1 / max(ratio.max(), 1.0), 200)
    rims = np.unique(np.clip(np.concatenate([even_braking, even_driving]), ratio.min(), ratio.max()))
    same = np.ones(len(rims))
    return replace(
        table,
        Vx=Vx * same,
        Vy=Vy * same,
        rim=rims * abs(Vx),
        load=None if table.load is None else float(np.mean(table.load)) * same,
        forces=dict.fromkeys(table.forces, 0 * same),
        level=np.zeros(len(rims), int),
    )


def _bars(ax: Axes, fit: SlipFit, soil: SlipLaw | None) -> None:
    """Draw the error on settings left out of each law, and the repeatability."""
    kept = list(dict.fromkeys((*fit.supported, *fit.laws)))[: MAX_BARS - 1]
    linear = next((law for law in fit.laws if not law.parts), None)
    laws = sorted({id(x): x for x in (*kept, *filter(None, (linear, soil)))}.values(), key=lambda x: -x.rms_left_out)
    colours = [COLOURS[2] if x in fit.supported else "0.6" if x is soil else COLOURS[0] for x in laws]
    places = np.arange(len(laws))
    ax.barh(places, [x.rms_left_out for x in laws], color=colours, height=0.6)
    for y, law in zip(places, laws, strict=True):
        at = law.rms_left_out, y
        ax.annotate(format_number(at[0], 3), at, xytext=(3, 0), textcoords="offset points", va="center", fontsize=8)
    ax.set_yticks(places, [wrap_label(x.name, LAW_LETTERS) for x in laws], fontsize=8)
    known = [r for r in fit.repeatability.values() if r is not None]
    if known:
        ax.axvline(max(known), color="black", linestyle="--", linewidth=0.9, label="repeatability")
    ax.set_xlabel("error on settings left out\n[N, rms], green: supported")
    ax.set_xlim(0, 1.3 * max(x.rms_left_out for x in laws))
    ax.grid(axis="x", alpha=0.3)
