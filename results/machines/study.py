"""Design and verify a drive for each of the other machines, with random multisines for comparison.

python results/machines/study.py [NAME...] writes a folder for each machine beside this file: drive.json (designed drive
at its knots), verify.json (100 simulated runs), quiet.json (50 runs with a tenth of the noise, to tell whether narrow
intervals come from large noise), multisines.json (10), README.md and figure.png. Existing files are not repeated, so an
interrupted study resumes; --as-is writes the pages with the multisines there are. A machine is its file in
model/machines and a line of STUDIES.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import json
import os
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from scipy.stats import binom

from excite import output, smoothing
from excite.identification import recommend_method, summarise_runs, verify
from excite.model import Model, prediction
from excite.model.machine import Problem, machine
from excite.reports import COLOURS, format_sum, legend_above, new_figure, save, set_title
from excite.reports.top_view import draw_machine
from excite.simulation import Motion, simulate
from excite.text import format_number
from excite.trajectories import Manoeuvre, baselines, excitation, multistart, objective

HERE = Path(__file__).parent
SECONDS = 20.0  # duration of every drive [s]; chosen
BUDGET = 240.0  # time for its design [s]; idle cores need less than 60
RUNS = 100  # simulated runs of the designed drive
QUIET = 50  # runs with less noise
RANDOM = 10  # random multisines
QUIET_NOISE = 0.1  # share of the noise in the quiet runs; chosen
SIGNIFICANCE = 0.01  # chance of calling correct intervals too narrow, over all parameters; chosen

# Remarks on each machine for its page.
STUDIES = {
    "single_drum": "Two driven wheels share one axle behind the drum. MY0R holds the difference between the two; their"
    " Ky are separable only because the rim speeds differ in a turn.",
    "tandem": "No articulation; two steering joints at the ends of one frame. The yokes are balanced about their"
    " pivots, so only the moment of inertia of yoke and drum about the pivot is identifiable (ZZ1R, ZZ3R).",
    "double_loader": "A chain of two vertical joints: the articulation, and the pivot of the rear axle behind it. A"
    " joint feels everything behind it as one body, so mass and moments are grouped forward through both.",
    "pendulum_loader": "The pendulum joint is in the table, about the longitudinal axis, and locked at zero by"
    ' `locked = ["theta3"]`. Its friction and offset (Fv3, Fs3, u30) and the rear frame\'s moments of inertia about'
    " horizontal axes are not identifiable on the plane; the other parameters are those of a loader without it.",
    "skid_robot": "No steering joint, four narrow wheels (contacts of width 0): it turns by different speeds of its"
    " sides. The wheels' masses are grouped into M, MX0R, MY0R and ZZ0R.",
    "three_wheel": "Its steered front roll is undriven: the row of its joint states zero torque, and there is no"
    " offset u40.",
}


def main(names: list[str], as_is: bool) -> None:
    for name in names:
        (HERE / name).mkdir(exist_ok=True)
        model = prediction.build(machine.load_machine(name))
        problem = short(model)
        drive = read_or_make(HERE / name / "drive.json", lambda m=model, p=problem: designed(m, p))
        drawn = Manoeuvre(np.array(drive["times_s"]), np.array(drive["torque"]))
        motion = driven(model, drawn, np.array(drive["start"]))
        runs = read_or_make(HERE / name / "verify.json", lambda m=model, x=motion: verified(m, x, RUNS))
        calm = read_or_make(HERE / name / "quiet.json", lambda m=model, x=motion: verified(quiet(m), x, QUIET))
        path = HERE / name / "multisines.json"
        others = read(path) if path.is_file() else []
        while len(others) < (0 if as_is else RANDOM):
            others.append(multisine(model, problem, len(others)))
            write(path, others)
        save(figure(model, drive, runs, others), HERE / name / "figure.png")
        (HERE / name / "README.md").write_text(page(name, model, drive, runs, calm, others), encoding="utf-8")
        print(f"{name}: written", flush=True)


def read_or_make(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Read a file; make it first if it does not exist."""
    if not path.is_file():
        write(path, make())
        print(f"{path.parent.name}: {path.stem}", flush=True)
    return read(path)


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def write(path: Path, made: Any) -> None:
    with output.new_file(path) as place:
        place.write_text(output.to_json(made), encoding="utf-8")


def short(model: Model) -> Problem:
    problem = model.machine.problems[model.machine.problem or ""]
    return problem.model_copy(update={"duration_s": problem.duration_s.model_copy(update={"value": SECONDS})})


def driven(model: Model, drive: Manoeuvre, start: np.ndarray) -> Motion:
    return simulate(model, drive.sample(float(model.machine.sampling_hz)), q0=start)


# ------------------------------------------------------------------------------------------------ the work


def designed(model: Model, problem: Problem) -> dict[str, Any]:
    """Design the drive of lowest cond(Phi), as `excite design NAME --duration 20 --starts 1 --budget 240` finds it."""
    found = multistart.design(model, problem, starts=1, seed=0, budget_s=BUDGET)
    return {
        "times_s": found.manoeuvre.times,
        "torque": found.manoeuvre.torque,
        "start": found.motion.q[0],
        "cond_phi": found.cond_phi,
        "cond_phi_start": found.cond_phi_start,
        "max_violation": found.max_violation,
        "complete": found.complete,
        "budget_s": BUDGET,
        "sigma_percent": dict(zip(model.base.names, sigma(model, found.motion), strict=True)),
    }


def quiet(model: Model) -> Model:
    """Build the machine with less sensor noise and finer encoders."""
    finer = []
    for s in model.machine.sensor:
        update = {}
        if s.noise is not None:
            update["noise"] = s.noise.model_copy(update={"value": QUIET_NOISE * float(s.noise)})
        if s.counts_per_turn is not None:
            update["counts_per_turn"] = s.counts_per_turn.model_copy(
                update={"value": float(s.counts_per_turn) / QUIET_NOISE}
            )
        finer.append(s.model_copy(update=update))
    return prediction.build(model.machine.model_copy(update={"sensor": tuple(finer)}))


def verified(model: Model, motion: Motion, runs: int) -> dict[str, Any]:
    method = recommend_method(model)
    found = verify(model, motion, method, "full", runs, seed=0, jobs=1)
    return {
        "method": method,
        "failures": found.failures,
        "parameters": summarise_runs(found),
        "error_percent": dict(zip(found.names, found.error_percent.T, strict=True)),
    }


def multisine(model: Model, problem: Problem, seed: int) -> dict[str, Any]:
    """Bring a random multisine inside the limits, as `excite compare` does, and score it."""
    found = baselines.bring_within_limits(model, problem, excitation.multisine(model, problem, seed))
    error = sigma(model, driven(model, found.manoeuvre, found.start))
    return {
        "cond_phi": objective.reported_value("cond", found.score),
        "worst_std_percent": float(error.max()),
        "median_std_percent": float(np.median(error)),
        "kept": found.feasible,
        "excess": found.excess,
    }


def sigma(model: Model, motion: Motion) -> np.ndarray:
    """Cramer-Rao bound (n_base,), standard deviation [%] of the nominal value."""
    return objective.relative_std_percent(model, smoothing.cramer_rao(model, motion))


# ------------------------------------------------------------------------------------------------ the page


def figure(model: Model, drive: dict[str, Any], runs: dict[str, Any], others: list[dict[str, Any]]) -> Figure:
    """Plot the machine from above, errors against the predicted intervals, and the drive among random ones."""
    n = len(model.base.names)
    fig = new_figure(11.5, max(7.0, 1.2 + 0.2 * n))
    axes = fig.subplot_mosaic([["above", "errors"], ["among", "errors"]])
    above, errors, among = (axes[name] for name in ("above", "errors", "among"))
    set_title(fig, model.machine.title)
    draw_machine(above, model.machine)
    _errors(errors, runs)
    for good, face, label in ((True, COLOURS[0], "random multisine"), (False, "none", "the same, violates a limit")):
        some = [r for r in others if r["kept"] == good]
        if some:
            x, y = ([r[k] for r in some] for k in ("cond_phi", "worst_std_percent"))
            among.scatter(x, y, s=28, facecolors=face, edgecolors=COLOURS[0], label=label)
    worst = max(drive["sigma_percent"].values())
    among.scatter([drive["cond_phi"]], [worst], s=70, marker="D", color=COLOURS[1], edgecolors="k", label="designed")
    among.set_xscale("log")
    among.set_yscale("log")
    for axis in (among.xaxis, among.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter("{x:g}")
    among.set_xlabel("cond(Phi)")
    among.set_ylabel("worst parameter: attainable\nstandard deviation [%]", fontsize=9)
    among.grid(alpha=0.3, which="both")
    among.tick_params(labelsize=8)
    legend_above(among, 4.5)
    return fig


def _errors(ax: Axes, runs: dict[str, Any]) -> None:
    names = list(runs["parameters"])
    for y, name in enumerate(reversed(names)):
        half = 1.96 * runs["parameters"][name]["predicted_std_percent"]
        ax.plot([-half, half], [y, y], color="0.75", linewidth=6, solid_capstyle="butt", zorder=1)
        e = np.array([x for x in runs["error_percent"][name] if x is not None], float)
        ax.plot(e, y + np.linspace(-0.25, 0.25, len(e)), ".", color=COLOURS[0], markersize=2.5, zorder=2)
    ax.axvline(0, color="black", linewidth=0.8)
    ax.set_xscale("symlog", linthresh=1.0)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_yticks(range(len(names)), names[::-1], fontsize=8)
    ax.set_xlabel("error of one run [%]; grey: predicted 95 % interval")
    ax.grid(axis="x", alpha=0.3)


def narrow(runs: dict[str, Any], count: int) -> dict[str, float]:
    """Find parameters whose coverage is significantly below 95 %, with their coverage [%]."""
    least = binom.ppf(SIGNIFICANCE / len(runs["parameters"]), count, 0.95)
    cover = {n: r["coverage95"] for n, r in runs["parameters"].items()}
    return {n: 100 * c for n, c in cover.items() if round(c * count) < least}


def page(
    name: str,
    model: Model,
    drive: dict[str, Any],
    runs: dict[str, Any],
    calm: dict[str, Any],
    others: list[dict[str, Any]],
) -> str:
    rows, base = runs["parameters"], model.base
    sizes = drive["sigma_percent"]
    inside = np.mean([r["coverage95"] for r in rows.values()])
    good = [r for r in others if r["kept"]]
    conds = sorted(r["cond_phi"] for r in good)
    best = f"{conds[0]:.3g} (best) and {np.median(conds):.3g} (median)" if conds else "-"
    errors = sorted(r["worst_std_percent"] for r in good)
    worst = max(sizes, key=lambda n: sizes[n])
    hurt = max(rows, key=lambda n: rows[n]["rms_percent"])
    median = float(np.median([r["rms_percent"] for r in rows.values()]))
    lines = [
        f"# {model.machine.title}",
        "",
        f"`model/machines/{name}.toml`. {STUDIES[name]}",
        "",
        f"Rebuilt by `python results/machines/study.py {name}`.",
        "",
        "![The machine from above; errors of the runs; the designed drive among random ones](figure.png)",
        "",
        f"- **Drive**: {SECONDS:g} s, designed for cond(Phi) within {drive['budget_s']:g} s"
        + ("" if drive["complete"] else " (stopped by the budget)")
        + f": {drive['cond_phi']:.3g}, starting guess {drive['cond_phi_start']:.3g}; every limit kept within"
        f" {100 * drive['max_violation']:.2g} % of its range. Attainable standard deviation: worst {worst}"
        f" {sizes[worst]:.2g} %, median {np.median(list(sizes.values())):.2g} %.",
        f"- **Verification**: {RUNS} simulated runs with noise and quantisation, method `{runs['method']}`,"
        f" {len(runs['failures'])} failed. True error: worst {hurt} {rows[hurt]['rms_percent']:.2g} %, median"
        f" {median:.2g} %; coverage of the 95 % intervals {100 * inside:.0f} %.",
        f"- **Random multisines**: {len(good)} of {len(others)}"
        + (f" (of {RANDOM} that the study makes)" if len(others) < RANDOM else "")
        + " could be brought inside the limits; cond(Phi)"
        f" {best}"
        + (f", {conds[0] / drive['cond_phi']:.2g} times the designed one at best" if conds else "")
        + (f"; worst parameter attainable to {errors[0]:.2g} % at best." if errors else "."),
    ]
    if few := narrow(runs, RUNS):
        worse, mean = narrow(calm, QUIET), np.mean([r["coverage95"] for r in calm["parameters"].values()])
        named = ", ".join(f"{n} ({percent:.0f} %)" for n, percent in few.items())
        lines.append(
            f"- **Intervals too narrow** (coverage significantly below 95 %): {named}. With a tenth of the noise"
            f" ({QUIET} runs) "
            + (
                f"these are {', '.join(worse)}."
                if worse
                else f"there are none ({100 * mean:.0f} % on average): standard deviations are right to first"
                " order, but this drive excites these parameters so little that the errors leave the linear range."
                " `--objective accuracy` designs a drive that excites them."
            )
        )
    if worst_better := [r for r in good if r["worst_std_percent"] < sizes[worst]]:
        lines.append(
            f"- A low cond(Phi) is not a small error: {len(worst_better)} of the multisines identify the worst"
            " parameter better. `--objective accuracy` designs for accuracy."
        )
    lines = [textwrap.fill(line, 120, subsequent_indent="  " if line[:1] in "- " else "") for line in lines]
    lines += ["", "| base parameter | grouping | true value | attainable [%] | true error of runs [%] | coverage |"]
    lines += ["|---|---|---|---|---|---|"]
    for n, row in rows.items():
        value = f"{format_number(row['true'])} {row['unit']}"
        parts = format_sum(base.grouping(n))
        lines.append(
            f"| {n} | {parts} | {value} | {sizes[n]:.2g} | {row['rms_percent']:.2g} | {100 * row['coverage95']:.0f} % |"
        )
    lines += ["", textwrap.fill(f"Not identifiable by any motion on the plane: {', '.join(base.invisible)}.", 120)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    asked = [n for n in sys.argv[1:] if n != "--as-is"]
    unknown = sorted(set(asked) - set(STUDIES))
    if unknown:
        sys.exit(f"no study of {', '.join(unknown)}, allowed: {', '.join(STUDIES)}")
    main(asked or list(STUDIES), "--as-is" in sys.argv)
