"""Bound the accuracy of every drive of a test rig with one joint, and compare designs with it.

python results/bound_rig/study.py [--degree 4] [--out FOLDER] writes summary.json and bound.png.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import os
import sys
import time
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

import numpy as np
from matplotlib.figure import Figure
from support import studies

from excite import output
from excite.model import prediction
from excite.model.machine import machine
from excite.reports import COLOURS, legend_below, new_figure, save
from excite.trajectories import bound_accuracy, compose_objective, design, sigma_percent

RIG = HERE.parents[1] / "tests" / "support" / "rig.toml"
OBJECTIVES = ("accuracy", "worst", "A", "D")
MIDDLE = ("Fv", "Fc")  # parameters whose mean bounds the median, see README.md
Values = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--degree", type=int, default=4, help="degree of the polynomials")
    parser.add_argument("--starts", type=int, default=6, help="starts of each design")
    options = studies.parse(parser, __file__)
    model = prediction.build(machine.load_machine(str(RIG)))
    problem = model.machine.problems["T10"]
    bounds: Values = {}
    mixtures: Values = {}
    begin = time.monotonic()
    for name, of, parameters in (
        ("accuracy", "accuracy", None),
        ("worst", "worst", None),
        ("mean", "mean", None),
        ("median", "mean", MIDDLE),
    ):
        found = bound_accuracy(model, problem, of, parameters, options.degree)
        bounds[name], mixtures[name] = found.certified_percent, found.mixture_percent
        print(name, found, flush=True)
    # If another parameter than the offset is the least accurate, the median is at least half of the offset's.
    bounds["median"] = min(bounds["median"], bounds["worst"] / 2)
    seconds = time.monotonic() - begin
    designs: dict[str, Values] = {}
    for name in OBJECTIVES:
        aim = compose_objective(model, name)
        sigma = sigma_percent(aim, model, design(model, problem, aim, options.starts, 0).motion)
        designs[name] = {
            "accuracy": float(np.sqrt(sigma.max() * sigma.mean())),
            "worst": float(sigma.max()),
            "mean": float(sigma.mean()),
            "median": float(np.median(sigma)),
            **{f"sigma {n}": float(s) for n, s in zip(model.base.names, sigma, strict=True)},
        }
        print(name, designs[name], flush=True)
    summary = {
        **studies.origin(__file__, 0),
        "degree": options.degree,
        "starts": options.starts,
        "bounds_percent": bounds,
        "mixtures_percent": mixtures,
        "bounds_wall_s": seconds,
        "load_average": os.getloadavg()[0],
        "designs": designs,
        "gaps_percent": {k: 100 * (min(d[k] for d in designs.values()) / b - 1) for k, b in bounds.items()},
    }
    save(figure(bounds, designs), options.out / "bound.png")
    with output.new_file(options.out / "summary.json") as place:
        place.write_text(output.to_json(summary), encoding="utf-8")


def figure(bounds: Values, designs: dict[str, Values]) -> Figure:
    """Plot designs over the bounds, for each way to judge them."""
    fig = new_figure(7.5, 4.0)
    ax = fig.subplots()
    width = 0.8 / len(designs)
    for k, (name, values) in enumerate(designs.items()):
        above = [100 * (values[of] / bound - 1) for of, bound in bounds.items()]
        at = np.arange(len(bounds)) + (k - (len(designs) - 1) / 2) * width
        ax.plot(at, above, "osD^"[k % 4], color=COLOURS[k], label=f"design for {name}")
        for x, y in zip(at, above, strict=True):
            ax.annotate(f"{y:.1f}", (x, y), xytext=(0, 6), textcoords="offset points", ha="center", fontsize=8)
    words = {"accuracy": "worst and mean\n(geometric mean)", "worst": "worst", "mean": "mean", "median": "median"}
    labels = [f"{words[of]}\nbound {bound:.4f} %" for of, bound in bounds.items()]
    ax.set_xticks(range(len(bounds)), labels, fontsize=8)
    for edge in np.arange(len(bounds) - 1) + 0.5:
        ax.axvline(edge, color="0.8", linewidth=0.8)
    ax.set_yscale("log")
    ax.set_ylim(0.1, 600)
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_ylabel("standard deviation above the bound [%]", fontsize=9)
    ax.grid(axis="y", alpha=0.3)
    legend_below(fig, *ax.get_legend_handles_labels())
    return fig


if __name__ == "__main__":
    main()
