"""Measure how much driving a stated accuracy of the worst parameter takes, on the full model and the straight line.

python results/campaign/study.py [--targets 2 1 0.5] [--budget 900] [--out FOLDER] writes summary.json and campaign.png.
Campaigns that summary.json already has for the same options are not repeated.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

from matplotlib.figure import Figure
from support import studies

from excite import output, trajectories
from excite.model import Model, prediction
from excite.model.machine import Problem, machine
from excite.reports import COLOURS, save

MACHINES = ("va12_straight", "va12")
MOST_DRIVES = 4
STARTS = 2
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--targets", type=float, nargs="*", default=[2.0, 1.0, 0.5], help="worst parameter [%%]")
    parser.add_argument("--budget", type=float, default=900.0, help="longest search of one campaign [s]")
    parser.add_argument("--seed", type=int, default=0)
    options = studies.parse(parser, __file__)
    place = options.out / "summary.json"
    origin = studies.origin(__file__, options.seed)
    asked = {"starts": STARTS, "most_drives": MOST_DRIVES, "seed": options.seed, "budget_s": options.budget}
    known = json.loads(place.read_text()) if place.is_file() else {}
    rows: list[Row] = known["campaigns"] if all(known.get(k) == v for k, v in asked.items()) else []
    for name in MACHINES:
        model = prediction.build(machine.load_machine(name))
        problem = model.machine.problems[model.machine.problem or ""]
        for target in sorted(options.targets, reverse=True):
            if any(r["machine"] == name and r["target_percent"] == target for r in rows):
                continue
            rows.append(campaign(model, problem, target, options.seed, options.budget))
            print(describe(rows[-1]), flush=True)
            summary = {
                **origin,
                **asked,
                "load_average": os.getloadavg()[0],
                "campaigns": rows,
            }
            with output.new_file(place) as fresh:
                fresh.write_text(output.to_json(summary), encoding="utf-8")
    save(figure(rows), options.out / "campaign.png")


def campaign(model: Model, problem: Problem, target: float, seed: int, budget_s: float) -> Row:
    """Search the fewest and shortest drives that attain a target [%] together; return what they take."""
    begin = time.monotonic()
    found = trajectories.design_campaign(
        model, problem, target, MOST_DRIVES, None, "worst", None, None, STARTS, seed, budget_s
    )
    sigma = found.sigma_percent
    return {
        "machine": model.machine.name,
        "problem": model.machine.problem,
        "parameters": len(model.base.names),
        "target_percent": target,
        "reached": found.reached,
        "worst_percent": found.percent,
        "worst_parameter": max(sigma, key=lambda n: sigma[n]),
        "drives": len(found.drives),
        "duration_s": found.duration_s,
        "total_s": found.total_s,
        "alone_percent": list(found.alone_percent),
        "cond_phi": [d.cond_phi for d in found.drives],
        "max_violation": max(d.max_violation for d in found.drives),
        "trials": [vars(t) for t in found.trials],
        "complete": found.complete,
        "wall_s": time.monotonic() - begin,
    }


def describe(row: Row) -> str:
    """Say in a line what a campaign attains."""
    return (
        f"{row['machine']}, target {row['target_percent']:g} %: {row['drives']} x {row['duration_s']:g} s attain"
        f" {row['worst_percent']:.3f} % ({row['worst_parameter']}), {row['wall_s']:.0f} s"
    )


def figure(rows: list[Row]) -> Figure:
    """Plot the worst parameter's standard deviation against the total time of driving, trials and answers."""
    fig = Figure(figsize=(7.5, 4.8), layout="constrained")
    ax = fig.subplots()
    for k, name in enumerate(dict.fromkeys(r["machine"] for r in rows)):
        own = [r for r in rows if r["machine"] == name]
        trials = {(t["drives"], t["duration_s"], t["percent"]) for r in own for t in r["trials"]}
        tried = [(n * s, p) for n, s, p in trials if p is not None]
        ax.plot(*zip(*tried, strict=True), ".", color=COLOURS[k], alpha=0.45, label=f"{name}: tried")
        answers = sorted(((r["total_s"], r["worst_percent"], r) for r in own if r["reached"]), key=lambda a: a[0])
        ax.plot(
            [a[0] for a in answers],
            [a[1] for a in answers],
            "so"[k] + ["-", "--"][k],
            color=COLOURS[k],
            label=f"{name}: shortest found",
        )
        for r in own:
            text, place = f"{r['drives']} × {r['duration_s']:.0f} s", (r["total_s"], r["worst_percent"])
            if not r["reached"]:
                text += ", cut short"
                ax.plot(*place, "so"[k], color=COLOURS[k], fillstyle="none", markersize=8)
            shift = ((-8, -12), (6, 6))[k]
            ax.annotate(
                text,
                place,
                xytext=shift,
                textcoords="offset points",
                fontsize=8,
                ha=("right", "left")[k],
                color=COLOURS[k],
            )
    for target in {r["target_percent"] for r in rows}:
        ax.axhline(target, color="k", linestyle=":", linewidth=0.8)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(10, 400)
    ax.set_xticks([10, 20, 30, 60, 120, 240])
    ax.set_yticks([0.3, 0.5, 1, 2, 5])
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    ax.set_xlabel("total time of driving [s]")
    ax.set_ylabel("standard deviation of the worst parameter [%]")
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8)
    return fig


if __name__ == "__main__":
    main()
