"""Compute a lower bound on cond(Phi) of R60 (`bound.py`), from the states of the designed drives.

python results/bound_R60/study.py [--rounds 80] [--minutes 45] [--out FOLDER] writes summary.json, certificate.json and
bound.png. Drives are designed as well for longer times and without the limits that the bound does not use.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import dataclasses
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

import numpy as np
from bound import Bound, bound
from matplotlib.figure import Figure
from support import studies

from excite import output
from excite.logs import profile
from excite.model import Model, prediction
from excite.model.machine.machine import load_machine
from excite.reports import COLOURS, save
from excite.simulation import Motion, simulate
from excite.trajectories import Manoeuvre, objective, place_on_lane
from excite.workflows import DesignRequest
from excite.workflows.design_request import design_from
from excite.workflows.study_plan import scale_limits

DESIGNS = HERE.parent / "R60" / "design", HERE.parent / "R60_accuracy" / "design"
RELAXED = (
    (60.0, False),
    (60.0, True),
    (300.0, False),
    (300.0, True),
)  # duration [s]; without lane, 10 x torque rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=80, help="largest number of rounds of column generation")
    parser.add_argument("--minutes", type=float, default=45, help="no new round begins after this time")
    parser.add_argument("--degree", type=int, default=2, help="degree of the polynomials")
    parser.add_argument("--polished", type=int, default=12, help="states refined by local search in each round")
    options = studies.parse(parser, __file__)
    model = prediction.build(load_machine("va12"))
    motions = drives(model)
    path: list[Bound] = []
    begin = time.monotonic()

    def record_round(found: Bound) -> bool:
        path.append(found)
        spent = (time.monotonic() - begin) / 60
        print(
            f"round {found.rounds}, {spent:.1f} min: {found.certified:.2f} <= optimum <= {found.mixture:.2f}",
            flush=True,
        )
        return spent > options.minutes

    found = bound(
        model,
        model.machine.problems["R60"],
        motions,
        options.degree,
        options.rounds,
        polished=options.polished,
        progress=record_round,
    )
    best = min(objective.cond_phi(model, m) for m in motions)
    summary = {
        **studies.origin(__file__, 0),
        "machine": "va12",
        "problem": "R60",
        "designed_cond_phi": best,
        **{f.name: getattr(found, f.name) for f in dataclasses.fields(found) if f.name != "certificate"},
        "gap_percent": 100 * (best / found.certified - 1) if found.certified > 0 else None,
        "wall_s": time.monotonic() - begin,
        "relaxed": [relaxed(*x) for x in RELAXED],
        "certified_by_round": [f.certified for f in path],
        "mixture_by_round": [f.mixture for f in path],
    }
    save(figure(path, found, best), options.out / "bound.png")
    certificate = found.certificate
    assert certificate is not None
    matrices = {k: getattr(certificate, k) for k in ("U", "V", "m", "a", "b")}
    with output.new_file(options.out / "certificate.json") as place:
        place.write_text(json.dumps(matrices, default=lambda x: np.asarray(x).tolist()) + "\n", encoding="utf-8")
    with output.new_file(options.out / "summary.json") as place:
        place.write_text(output.to_json(summary), encoding="utf-8")


def relaxed(seconds: float, free: bool) -> dict[str, Any]:
    """Design a drive of a duration [s]; free: without the lane and with ten times the torque rates."""
    machine = load_machine("va12")
    problem = machine.problems["R60"].lasting(seconds)
    if free:
        machine = scale_limits(machine, {"torque_rate": 10.0})
        problem = problem.model_copy(update={"lane_m": None, "lane_points": ()})
    found = design_from(prediction.build(machine), problem, DesignRequest(cond_slack=0.0))
    print(f"{seconds:g} s{', no lane, ten times the torque rates' * free}: {found.design.cond_phi:.2f}", flush=True)
    return {"duration_s": seconds, "free": free, "cond_phi": found.design.cond_phi}


def drives(model: Model) -> list[Motion]:
    """Simulate the designs of R60 and R60_accuracy, and the best drive of a long search (drive.csv)."""
    rate = float(model.machine.sampling_hz)
    knots = np.loadtxt(HERE / "drive.csv", delimiter=",", skiprows=1)
    torque = Manoeuvre(knots[:, 0], knots[:, 1:]).sample(rate)
    start = place_on_lane(model, model.machine.problems["R60"], simulate(model, torque))
    found = [simulate(model, torque, q0=start)]
    for place in DESIGNS:
        torque, q0, nu0 = profile.read_profile(place / "profile.csv", model)
        found.append(simulate(model, torque, q0=q0, nu0=nu0))
    return found


def figure(path: list[Bound], found: Bound, best: float) -> Figure:
    """Plot mixture and certified bound of every round against the best drive."""
    fig = Figure(figsize=(8, 4.5), layout="constrained")
    ax = fig.subplots()
    rounds = [f.rounds for f in path]
    ax.plot(rounds, [f.mixture for f in path], color=COLOURS[0], label="best mixture of the states found")
    ax.plot(rounds, [f.certified for f in path], "--", color=COLOURS[1], label="certified so far")
    ax.plot(
        rounds[-1], found.certified, "D", color=COLOURS[1], markeredgecolor="black", label="after a thorough search"
    )
    ax.axhline(best, color="black", linestyle=":", label=f"best drive known, {best:.2f}")
    ax.set_xlabel("round of column generation")
    ax.set_ylabel("cond(Phi)")
    ax.set_ylim(0, 2 * best)
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9)
    return fig


if __name__ == "__main__":
    main()
