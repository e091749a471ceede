"""Measure time and memory of a design against duration, knot interval and number of parameters.

python results/cost/study.py [--seconds 20 40 60 120] [--out FOLDER] writes summary.json, table.md and cost.png.
Each case is one start with all stages, in a process of its own. Times include the profiler.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import cProfile
import json
import os
import pstats
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
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
from excite.reports import COLOURS, save
from excite.reports.figures import STYLES
from excite.trajectories import collocation, composite_objective, continuation, interior_point

PARTS = {  # function: its part of the time; none of them calls another
    collocation.transcribe: "derivatives built",
    interior_point._linearise: "derivatives evaluated",
    interior_point._descent_step: "Newton step",
    collocation.solve_states: "states settled",
    interior_point._evaluate: "line search",
    continuation.evaluate_drive: "fresh simulation",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, nargs="*", default=[20, 40, 60, 120])
    parser.add_argument("--case", nargs=3, default=None, help="machine, seconds, knot: one case, printed as JSON")
    options = studies.parse(parser, __file__)
    if options.case is not None:
        print(json.dumps(case(options.case[0], float(options.case[1]), float(options.case[2]))))
        return
    wanted = [(m, t, 0.2) for m in ("va12_straight", "va12") for t in options.seconds]
    wanted += [("va12", t, 0.4) for t in options.seconds]
    rows = []
    for name, seconds, knot in wanted:
        command = [sys.executable, __file__, "--case", name, str(seconds), str(knot), "--out", str(options.out)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(
            f"{name}, {seconds:g} s, knots {knot:g} s: {rows[-1]['wall_s']:.0f} s, {rows[-1]['memory_MB']:.0f} MB",
            flush=True,
        )
    (options.out / "table.md").write_text(table(rows))
    save(figure(rows), options.out / "cost.png")
    cores = {"load_average": os.getloadavg()[0], "cores": os.cpu_count()}
    summary = studies.origin(__file__, 0) | cores | {"cases": rows}
    with output.new_file(options.out / "summary.json") as place:
        place.write_text(output.to_json(summary), encoding="utf-8")


def case(name: str, seconds: float, knot: float) -> dict[str, object]:
    """Run one start of a design: wall and CPU time [s], peak memory [MB], share of the time by part."""
    model = prediction.build(machine.load_machine(name))
    before = model.machine.problems[model.machine.problem or ""]
    problem = before.model_copy(
        update={
            "duration_s": before.duration_s.model_copy(update={"value": seconds}),
            "knot_s": before.knot_s.model_copy(update={"value": knot}),
        }
    )
    aim = composite_objective.compose_objective(model, "cond")
    profile = cProfile.Profile(time.process_time)
    wall, cpu = time.perf_counter(), time.process_time()
    profile.enable()
    start = continuation.start_from_multisine(model, problem, aim, 0, 1)
    track = continuation.run_stages(model, problem, aim, start, continuation.STAGES, lambda: False)
    track = continuation.repair(model, problem, aim, track, lambda: False)
    profile.disable()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    spent = dict.fromkeys(PARTS.values(), 0.0)
    parts = {(f.__code__.co_filename, f.__code__.co_name): part for f, part in PARTS.items()}
    for (file, _, function), (_, _, _, cumulative, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        part = parts.get((file, function))
        if part is not None:
            spent[part] += cumulative
    return {
        "machine": name,
        "parameters": len(model.scale),
        "duration_s": seconds,
        "knot_s": knot,
        "wall_s": wall,
        "cpu_s": cpu,
        "memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "cond_phi": float(np.exp(track.best.score / 2)),
        "feasible": track.best.feasible,
        "share": {k: v / cpu for k, v in spent.items()} | {"other": 1 - sum(spent.values()) / cpu},
    }


def table(rows: Sequence[dict]) -> str:
    parts = list(rows[0]["share"])
    lines = ["| parameters | drive [s] | knots [s] | processor [s] | memory [MB] | " + " | ".join(parts) + " |"]
    lines.append("|" + "---|" * (5 + len(parts)))
    for r in rows:
        share = " | ".join(f"{100 * r['share'][p]:.0f} %" for p in parts)
        lines.append(
            f"| {r['parameters']} | {r['duration_s']:g} | {r['knot_s']:g} | {r['cpu_s']:.0f} | {r['memory_MB']:.0f} |"
            f" {share} |"
        )
    return "\n".join(lines) + "\n"


def figure(rows: Sequence[dict]) -> Figure:
    fig = Figure(figsize=(11.5, 4), layout="constrained")
    axes = fig.subplots(1, 3, width_ratios=(1, 1, 1.2))
    kinds = sorted({(r["parameters"], r["knot_s"]) for r in rows})
    for k, kind in enumerate(kinds):
        own = [r for r in rows if (r["parameters"], r["knot_s"]) == kind]
        for ax, key in zip(axes, ("cpu_s", "memory_MB"), strict=False):
            ax.plot(
                [r["duration_s"] for r in own],
                [r[key] for r in own],
                "o",
                linestyle=STYLES[k],
                color=COLOURS[k],
                label=f"{kind[0]} parameters, knots {kind[1]:g} s",
            )
    for ax, label in zip(axes, ("processor time of a start [s]", "peak memory [MB]"), strict=False):
        ax.set_xlabel("drive [s]")
        ax.set_ylabel(label)
        ax.set_ylim(0)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    left = np.zeros(len(kinds))
    longest = [
        max((r for r in rows if (r["parameters"], r["knot_s"]) == k), key=lambda r: r["duration_s"]) for k in kinds
    ]
    for i, part in enumerate(rows[0]["share"]):
        x = np.array([100 * r["share"][part] for r in longest])
        axes[2].barh(
            range(len(kinds)), x, left=left, label=part, color=[*COLOURS, "0.8"][i], edgecolor="black", height=0.5
        )
        left += x
    axes[2].set_yticks(range(len(kinds)), [f"{p},\n{k:g} s" for p, k in kinds])
    axes[2].set_xlabel("share of the time [%]")
    axes[2].legend(fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return fig


if __name__ == "__main__":
    main()
