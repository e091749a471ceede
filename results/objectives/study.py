"""Rank design criteria by how well they predict true errors of identification, over some twenty drives of R60.

python results/objectives/study.py [--runs 12] [--jobs 2] [--out FOLDER] writes summary.json and objectives.png. Drives
in `drives/` and runs in `runs/` are not repeated. A drive that two objectives end at counts once.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

import numpy as np
import scipy.stats
from matplotlib.figure import Figure
from support import studies

from excite import output
from excite.identification import verify
from excite.logs import profile
from excite.model import Model, prediction
from excite.model.machine import Problem, machine
from excite.reports import COLOURS, save
from excite.simulation import Motion, simulate
from excite.smoothing import cramer_rao
from excite.trajectories import Manoeuvre, baselines, composite_objective, design, objective
from excite.trajectories.excitation import knot_times

RANDOM = {"multisine": 5, "slow multisine": 3, "random steps": 3, "chirp": 2, "hand-made": 1}
DESIGNED = ("D", "A", "E", "worst", "weighted-cond")
STORED = {"cond": HERE.parent / "R60" / "design", "accuracy": HERE.parent / "R60_accuracy" / "design"}
DRAWS = 2000  # bootstrap draws; chosen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=12, help="simulated and identified logs of every drive")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--few", type=int, default=None, help="number of drives, for a trial")
    options = studies.parse(parser, __file__)
    for name in ("drives", "runs"):
        (options.out / name).mkdir(exist_ok=True)
    model = prediction.build(machine.load_machine("va12"))
    problem = model.machine.problems["R60"]
    rows: list[dict[str, Any]] = []
    for name, make in list(drives(model, problem).items())[: options.few]:
        motion = simulate_drive(model, options.out, name, make)
        values = {c: f(model, motion) for c, f in CRITERIA.items()}
        error = errors(model, motion, options.out, name, options.runs, options.jobs)
        rows.append({"drive": name, "criteria": values, "rms_percent": dict(zip(model.base.names, error, strict=True))})
        print(f"{name}: cond(Phi) {values['cond(Phi)']:.0f}, worst {max(error):.2f} %", flush=True)
    other = [r for k, r in enumerate(rows) if all(r["criteria"] != s["criteria"] for s in rows[:k])]
    worst = np.array([max(r["rms_percent"].values()) for r in other])
    median = np.array([np.median(list(r["rms_percent"].values())) for r in other])
    ranks = {
        c: {
            "worst": rank(np.array([r["criteria"][c] for r in other]), worst),
            "median": rank(np.array([r["criteria"][c] for r in other]), median),
        }
        for c in CRITERIA
    }
    found = {"machine": "va12", "problem": "R60", "runs": options.runs, "rank_correlation": ranks, "drives": rows}
    save(figure(other, worst, ranks), options.out / "objectives.png")
    with output.new_file(options.out / "summary.json") as place:
        place.write_text(output.to_json(studies.origin(__file__, 0) | found), encoding="utf-8")


# ------------------------------------------------------------------------------------------------ criteria


def _of(name: str) -> Callable[[Model, Motion], float]:
    def score(model: Model, motion: Motion) -> float:
        P = objective.phi(model, motion, name)
        return objective.reported_value(name, objective.score_matrix(name, P.T @ P))

    return score


def torque_noise(model: Model, motion: Motion) -> float:
    """Worst relative standard deviation [%] if torques alone were noisy, from the rows that have a torque."""
    W = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T)
    noise = objective.row_noise(model)
    W = np.concatenate([W[:, row] / noise[row] for row in range(W.shape[1]) if row in model.actuated]) * model.scale
    # Rows without a torque hold exactly: weight 1000.
    still = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T)
    exact = [row for row in range(still.shape[1]) if row not in model.actuated]
    held = np.concatenate([1e3 * still[:, row] / noise[row] for row in exact]) * model.scale
    C = np.linalg.inv(W.T @ W + held.T @ held)
    return float(100 * np.sqrt((np.diag(C) * model.scale**2 / model.nominal**2).max()))


def bound(model: Model, motion: Motion) -> float:
    """Worst relative standard deviation [%] of the Cramer-Rao bound."""
    return float(objective.relative_std_percent(model, cramer_rao(model, motion)).max())


CRITERIA: dict[str, Callable[[Model, Motion], float]] = {
    "cond(Phi)": objective.cond_phi,
    "cond(W)": objective.cond_w,
    "weighted cond": _of("weighted-cond"),
    "D": _of("D"),
    "A": _of("A"),
    "E": _of("E"),
    "worst (weighted regressor)": _of("worst"),
    "torque noise alone": torque_noise,
    "Cramer-Rao": bound,
}


# ------------------------------------------------------------------------------------------------ drives


Make = Callable[[], Manoeuvre]


def drives(model: Model, problem: Problem) -> dict[str, Make]:
    """Map each drive's name to the function that makes it."""
    found: dict[str, Make] = {}
    for kind, count in RANDOM.items():
        for k in range(count):
            found[f"{kind} {k + 1}"] = lambda kind=kind, k=k: make_baseline(model, problem, kind, k)  # type: ignore[misc]
    for name, place in STORED.items():
        found[f"designed for {name}"] = lambda place=place: read_design(model, problem, place)  # type: ignore[misc]
    for name in DESIGNED:
        found[f"designed for {name}"] = lambda name=name: make_design(model, problem, name)  # type: ignore[misc]
    return found


def make_baseline(model: Model, problem: Problem, kind: str, seed: int) -> Manoeuvre:
    return baselines.bring_within_limits(
        model, problem, baselines.BASELINES[kind].make(model, problem, seed, 0.0)
    ).manoeuvre


def read_design(model: Model, problem: Problem, place: Path) -> Manoeuvre:
    torque, _, _ = profile.read_profile(place / "profile.csv", model)
    times = knot_times(problem)
    return Manoeuvre(times, torque[np.rint(times * float(model.machine.sampling_hz)).astype(int)])


def make_design(model: Model, problem: Problem, name: str) -> Manoeuvre:
    warm = [read_design(model, problem, place) for place in STORED.values()]
    return design(model, problem, composite_objective.compose_objective(model, name), starts=0, warm=warm).manoeuvre


def simulate_drive(model: Model, out: Path, name: str, make: Make) -> Motion:
    path = out / "drives" / f"{name.replace(' ', '-')}.csv"
    if not path.is_file():
        m = make()
        with output.new_file(path) as place:
            rows = np.column_stack([m.times, m.torque])
            np.savetxt(place, rows, "%.12g", ",", header="t_s,u1_Nm,u2_Nm,u4_Nm", comments="")
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    return simulate(model, Manoeuvre(rows[:, 0], rows[:, 1:]).sample(float(model.machine.sampling_hz)))


def errors(model: Model, motion: Motion, out: Path, name: str, runs: int, jobs: int) -> list[float]:
    """Root mean square error [%] of every parameter over the runs."""
    path = out / "runs" / f"{name.replace(' ', '-')}-{runs}.json"
    if not path.is_file():
        v = verify(model, motion, "joint", "full", runs, seed=1, jobs=jobs)
        with output.new_file(path) as place:
            place.write_text(json.dumps(np.sqrt(np.nanmean(v.error_percent**2, axis=0)).tolist()))
    return [float(x) for x in json.loads(path.read_text())]


# ------------------------------------------------------------------------------------------------ ranks


def rank(criterion: np.ndarray, error: np.ndarray) -> dict[str, float]:
    """Spearman's rank correlation with a 95 % bootstrap interval over the drives."""
    rng = np.random.default_rng(0)
    n = len(error)
    draws = []
    for _ in range(DRAWS):
        k = rng.integers(n, size=n)
        if len(np.unique(k)) > 2:
            draws.append(float(scipy.stats.spearmanr(criterion[k], error[k]).statistic))
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    return {"rho": float(scipy.stats.spearmanr(criterion, error).statistic), "low": float(low), "high": float(high)}


def figure(rows: Sequence[Mapping], worst: np.ndarray, ranks: Mapping[str, Mapping]) -> Figure:
    """Plot rank correlations (left), and cond(Phi) and the bound against the true error (right)."""
    fig = Figure(figsize=(11.5, 4.6), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(1.2, 1))
    names = list(ranks)[::-1]
    for k, which in enumerate(("worst", "median")):
        for y, name in enumerate(names):
            r = ranks[name][which]
            left.plot([r["low"], r["high"]], [y + 0.15 * (1 - 2 * k)] * 2, color=COLOURS[k])
            left.plot(
                r["rho"],
                y + 0.15 * (1 - 2 * k),
                "o^"[k],
                color=COLOURS[k],
                label=f"{which} parameter" if y == 0 else None,
            )
    left.set_yticks(range(len(names)), names)
    left.axvline(0, color="black", linewidth=0.8)
    left.set_xlim(-1.05, 1.05)
    left.set_xlabel("rank correlation with the true error (95 %)")
    left.grid(axis="x", alpha=0.3)
    left.legend(fontsize=8, loc="lower left")
    for k, name in enumerate(("cond(Phi)", "Cramer-Rao")):
        right.plot([r["criteria"][name] for r in rows], worst, "o^"[k], color=COLOURS[k], label=name)
    right.plot([0.5, 20], [0.5, 20], ":", color="black", linewidth=0.8)
    right.set_xscale("log")
    right.set_yscale("log")
    right.set_xlabel("criterion (cond; bound of the worst parameter [%])")
    right.set_ylabel("worst parameter: true rms error [%]")
    right.grid(alpha=0.3)
    right.legend(fontsize=8)
    return fig


if __name__ == "__main__":
    main()
