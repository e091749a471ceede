"""Trace the front between condition number and accuracy on R60: lowest cond(Phi) for a bound on the worst parameter.

python results/front_R60/study.py [--sigma-max 1 1.5 2 3 5] [--out FOLDER] writes summary.json, front.png and the
designs' knots (`drives/`), from the designs of the studies R60 and R60_accuracy. Designs in `drives/` are not repeated.
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
from excite.errors import InfeasibleError
from excite.logs import profile
from excite.model import Model, prediction
from excite.model.machine import Problem, machine
from excite.reports import COLOURS, save
from excite.trajectories import Manoeuvre, composite_objective, design, objective
from excite.trajectories.continuation import evaluate_drive
from excite.trajectories.excitation import knot_times

ENDS = {"cond": HERE.parent / "R60" / "design", "accuracy": HERE.parent / "R60_accuracy" / "design"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--sigma-max",
        type=float,
        nargs="*",
        default=[1.0, 1.5, 2.0, 3.0, 5.0],
        help="bounds on the worst parameter's standard deviation [%%]",
    )
    options = studies.parse(parser, __file__)
    (options.out / "drives").mkdir(exist_ok=True)
    model = prediction.build(machine.load_machine("va12"))
    problem = model.machine.problems["R60"]
    ends = {name: read_design(model, problem, place) for name, place in ENDS.items()}
    points = [score_design(model, problem, name, None, drive, 0.0) for name, drive in ends.items()]
    before = ends["accuracy"]
    for level in sorted(options.sigma_max):
        path, wall = options.out / "drives" / f"{level:g}.csv", 0.0
        if not path.is_file():
            begin = time.monotonic()
            try:
                found = design(
                    model,
                    problem,
                    composite_objective.compose_objective(model, "cond", level),
                    0,
                    warm=[before, ends["cond"]],
                )
            except InfeasibleError as err:
                print(err, flush=True)
                continue
            wall = time.monotonic() - begin
            rows = np.column_stack([found.manoeuvre.times, found.manoeuvre.torque])
            with output.new_file(path) as place:
                np.savetxt(place, rows, "%.12g", ",", header="t_s,u1_Nm,u2_Nm,u4_Nm", comments="")
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        before = Manoeuvre(rows[:, 0], rows[:, 1:])
        points.append(score_design(model, problem, "cond", level, before, wall))
        print(points[-1], flush=True)
    points.sort(key=lambda p: float(p["worst_percent"]))
    summary = studies.origin(__file__, 0) | {"machine": "va12", "problem": "R60", "designs": points}
    save(figure(points), options.out / "front.png")
    with output.new_file(options.out / "summary.json") as place:
        place.write_text(output.to_json(summary), encoding="utf-8")


def read_design(model: Model, problem: Problem, place: Path) -> Manoeuvre:
    """Read the torques at the knots from a design folder."""
    torque, _, _ = profile.read_profile(place / "profile.csv", model)
    times = knot_times(problem)
    return Manoeuvre(times, torque[np.rint(times * float(model.machine.sampling_hz)).astype(int)])


def score_design(
    model: Model, problem: Problem, name: str, level: float | None, drive: Manoeuvre, wall_s: float
) -> dict[str, object]:
    """Simulate and score one design afresh."""
    aim = composite_objective.compose_objective(model, "cond", level)
    found, motion = evaluate_drive(model, problem, aim, drive)
    sigma = composite_objective.sigma_percent(aim, model, motion)
    return {
        "objective": name,
        "sigma_max": level,
        "cond_phi": objective.cond_phi(model, motion),
        "worst_percent": float(sigma.max()),
        "worst_parameter": model.base.names[int(sigma.argmax())],
        "median_percent": float(np.median(sigma)),
        "max_violation": found.excess,
        "wall_s": wall_s,
    }


def figure(points: list[dict[str, object]]) -> Figure:
    """Plot cond(Phi) against the worst and the median parameter."""
    fig = Figure(figsize=(7.5, 4.8), layout="constrained")
    ax = fig.subplots()
    for k, (key, label) in enumerate((("worst_percent", "worst parameter"), ("median_percent", "median parameter"))):
        x = np.array([p[key] for p in points], float)
        y = np.array([p["cond_phi"] for p in points], float)
        ax.plot(x, y, "o^"[k] + ("-" if k == 0 else "--"), color=COLOURS[k], label=label)
    for p in points:
        text = p["objective"] if p["sigma_max"] is None else f"at most {p['sigma_max']:g} %"
        ax.annotate(
            str(text), (p["worst_percent"], p["cond_phi"]), xytext=(5, 5), textcoords="offset points", fontsize=8
        )
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("attainable standard deviation [%]")
    ax.set_ylabel("cond(Phi)")
    ax.set_xlim(None, 1.5 * max(float(p["worst_percent"]) for p in points))
    ax.set_xticks([0.2, 0.5, 1, 2, 5, 10])
    ax.set_yticks([20, 30, 50, 100, 200])
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    ax.grid(alpha=0.3, which="both")
    ax.legend()
    return fig


if __name__ == "__main__":
    main()
