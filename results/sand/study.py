"""Fit slip laws of the effects' catalogue to measurements of a wheel on sand.

python results/sand/study.py [DATA.csv] rebuilds summary.json and sand.png beside this file, from the single-wheel
measurements of Carnegie Mellon University (../shared/data/cmu_single_wheel), straight driving only (slip angle 0).

Each row of the data is the mean of a steady stretch. Traction follows from `excite.model.mechanics.contact` with the
catalogue's effects. Parameters are fitted by least squares; errors are those on slip levels left out.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.optimize import least_squares

from excite.model.effects import CATALOGUE, DEFAULT_DURATION, ContactMotion, SampleView, Site, Soil
from excite.model.machine import Contact, Quantity, load_machine
from excite.model.mechanics import contact
from excite.reports import COLOURS, save
from excite.reports.figures import STYLES

HERE = Path(__file__).parent
DATA = HERE.parents[2] / "shared" / "data" / "cmu_single_wheel" / "smooth_wheel.csv"
NAMES = ("shear_saturation", "drive_brake_asymmetry", "rolling_resistance")
LARGEST_SATURATION_SLIP = 30.0  # K / xi_s [-]; above it saturation has no effect on these data
RADIUS = 0.058  # m; the authors
WIDTH = 0.050  # m; the authors


def quantity(value: float) -> Quantity:
    return Quantity(value=value, source="published")


WHEEL = Contact(
    radius=quantity(RADIUS),
    width=quantity(WIDTH),
    Kx=quantity(-1.0),
    Ky=quantity(-1.0),
    v_eps=quantity(1e-6),
)
ROLLER = load_machine("va12")
USUAL = Site(ROLLER, ROLLER.contacts[0], DEFAULT_DURATION)  # default shapes of effects, as in any other machine


def force(names: Sequence[str]) -> tuple[ca.Function, list[str], np.ndarray]:
    """Build traction [N] from (V_x, rim speed, parameters) with some effects; also names and first values."""
    V, rim = ca.SX.sym("V"), ca.SX.sym("rim")
    labels, first = ["Kx"], [-30.0]
    rolling = ContactMotion(WHEEL, V, ca.SX(0), rim / RADIUS, ca.SX(0))
    p = ca.SX.sym("p", 1 + len(names))
    # The authors divide slip by the larger speed, as the data include a locked wheel with zero rim speed.
    larger = ca.fmax(V, rim)
    soil = Soil(contact.Slip((V - rim) / larger, ca.SX(0), larger), ca.SX(0), p[0], ca.SX(-1))
    none: dict[int, ca.SX] = {}
    scene = SampleView(none, none, none, none, none, {}, none, {}, {1: rolling}, none, none, ca.SX(0))
    pushed = ca.SX(0)
    for k, name in enumerate(names):
        effect = CATALOGUE[name]
        shapes = {s: ca.SX(x.default * x.size(USUAL)) for s, x in effect.shapes.items()}
        values = {"A": p[k + 1], **shapes}
        labels.append(name)
        first.append({"shear_saturation": 0.3, "drive_brake_asymmetry": 1.0, "rolling_resistance": 1.0}[name])
        if effect.soil is not None:
            soil = effect.soil(scene, 1, values, soil)
        if effect.push is not None:
            pushed += effect.push(scene, 1, values)[0]
    return ca.Function("force", [V, rim, p], [soil.wrench(WHEEL).Sx + pushed]), labels, np.array(first)


def fit_law(
    names: Sequence[str], table: pd.DataFrame
) -> tuple[np.ndarray, np.ndarray, list[str], Callable[[np.ndarray, np.ndarray], np.ndarray]]:
    """Fit a law: parameters, standard deviations (residuals clustered by level), names, and the fitted function."""
    law, labels, first = force(names)
    V, rim, F = (table[c].to_numpy() for c in ("V", "rim", "F"))

    def error(x: np.ndarray) -> np.ndarray:
        return np.asarray(law(V[None], rim[None], np.repeat(x[:, None], len(V), 1)).full()[0]) - F

    low = [-np.inf, *(1e-3 if CATALOGUE[n].positive else -np.inf for n in names)]
    high = [np.inf, *(LARGEST_SATURATION_SLIP if CATALOGUE[n].inverse else np.inf for n in names)]
    best = min(
        (least_squares(error, first * s, bounds=(low, high), x_scale=np.abs(first)) for s in (0.3, 1.0, 3.0)),
        key=lambda r: r.cost,
    )
    x, J, e = best.x, best.jac, best.fun
    # Residuals of one slip level are correlated (error of the law): sandwich estimator by level.
    bread = np.linalg.pinv(J.T @ J)
    meat = sum(
        np.outer(J[at].T @ e[at], J[at].T @ e[at]) for at in (table["level"] == k for k in table["level"].unique())
    )
    levels = table["level"].nunique()
    covariance = bread @ meat @ bread * levels / max(levels - len(x), 1)
    std = np.sqrt(np.maximum(np.diag(covariance), 0))
    std[x > 0.98 * np.array(high)] = np.nan
    return x, std, labels, lambda v, r: np.asarray(law(v[None], r[None], np.repeat(x[:, None], len(v), 1)).full()[0])


def left_out_errors(names: Sequence[str], table: pd.DataFrame) -> pd.Series:
    """Predict each slip level from a fit to the other levels: errors of the mean force [N]."""
    errors = {}
    for level in sorted(table["level"].unique()):
        own = table["level"] == level
        law = fit_law(names, table[~own])[3]
        errors[level] = float(np.mean(law(table["V"][own].to_numpy(), table["rim"][own].to_numpy()) - table["F"][own]))
    return pd.Series(errors)


def main(path: Path) -> None:
    raw = pd.read_csv(path)
    raw = raw[raw["beta_deg"] == 0]
    named = {"V": raw["avg_Vx_mm_s"] / 1e3, "rim": raw["avg_Vry_mm_s"] / 1e3, "F": -raw["avg_Fy_N"]}
    table = pd.DataFrame({**named, "level": raw["Vry_cmd_mm_s"]}).reset_index(drop=True)
    repeat = float(np.sqrt(table.groupby("level")["F"].var().mean()))
    mean = table.groupby("level").mean()
    tried = [c for n in range(len(NAMES) + 1) for c in combinations(NAMES, n)]
    rows: list[dict[str, Any]] = []
    for names in tried:
        x, std, labels, law = fit_law(names, table)
        inside = law(table["V"].to_numpy(), table["rim"].to_numpy()) - table["F"].to_numpy()
        outside = left_out_errors(names, table)
        inner = outside.iloc[1:-1]
        rows.append(
            {
                "effects": list(names),
                "parameters": {
                    n: {"value": v, "std": s if np.isfinite(s) else None}
                    for n, v, s in zip(labels, x, std, strict=True)
                },
                "rms_fitted_N": float(np.sqrt(np.mean(inside**2))),
                "rms_left_out_N": float(np.sqrt(np.mean(outside**2))),
                "rms_left_out_inner_N": float(np.sqrt(np.mean(inner**2))),
                "left_out_N": {f"{k:g}": v for k, v in outside.items()},
            }
        )
    summary = {
        "data": "CMU single wheel on sand, smooth wheel, slip angle 0",
        "rows": len(table),
        "levels": int(table["level"].nunique()),
        "repeatability_N": repeat,
        "models": rows,
    }
    (HERE / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    save(figure(table, mean, rows), HERE / "sand.png")
    for row in rows:
        print(
            f"{' + '.join(row['effects']) or 'linear law':62s} fitted {row['rms_fitted_N']:5.2f} N,"
            f" left out {row['rms_left_out_N']:5.2f} N, inner {row['rms_left_out_inner_N']:5.2f} N,"
            f" { ({k: (round(v['value'], 3), v['std'] and round(v['std'], 3)) for k, v in row['parameters'].items()}) }"
        )
    print(f"repeatability {repeat:.2f} N")


def figure(table: pd.DataFrame, mean: pd.DataFrame, rows: list[dict[str, Any]]) -> Figure:
    """Plot traction against slip, measured and by each law, and errors on levels left out."""
    fig = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(1.4, 1))
    fig.suptitle("Wheel on sand: traction against slip, measured and by laws of the catalogue", fontsize=11)
    slip = (table["rim"] - table["V"]) / np.maximum(table["rim"], table["V"])
    left.plot(slip, table["F"], "k.", markersize=5, label="measured (three days)")
    shown = [r for r in rows if len(r["effects"]) < 2]
    V = np.full(400, 0.01)
    rim = np.concatenate([np.linspace(3e-4, 0.01, 200), np.linspace(0.01, 0.1, 200)])
    s = (rim - V) / np.maximum(rim, V)
    for k, row in enumerate(shown):
        law = fit_law(row["effects"], table)[3]
        left.plot(s, law(V, rim), color=COLOURS[k % 6], linestyle=STYLES[k % 6], linewidth=1.3, label=_words(row))
    left.set_xlabel("slip, + driving, - braking [-]")
    left.set_ylabel("traction [N]")
    left.set_ylim(-60, 25)
    left.grid(alpha=0.3)
    left.legend(fontsize=7.5)
    order = sorted(rows, key=lambda r: -r["rms_left_out_N"])
    places = np.arange(len(order))
    right.barh(places, [r["rms_left_out_N"] for r in order], color=COLOURS[0], height=0.6)
    for y, r in zip(places, order, strict=True):
        at = r["rms_left_out_N"], y
        right.annotate(f"{at[0]:.2g}", at, xytext=(3, 0), textcoords="offset points", va="center", fontsize=8)
    repeat = float(np.sqrt(table.groupby("level")["F"].var().mean()))
    right.axvline(repeat, color="black", linestyle="--", linewidth=0.9)
    right.annotate("repeatability", (repeat, len(order) - 0.55), xytext=(3, 0), textcoords="offset points", fontsize=8)
    right.set_yticks(places, [_words(r) for r in order], fontsize=8)
    right.set_xlabel("error on slip levels left out [N, rms]")
    right.grid(axis="x", alpha=0.3)
    return fig


def _words(row: dict[str, Any]) -> str:
    return "\n+ ".join(n.replace("_", " ") for n in row["effects"]) or "linear law"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DATA)
