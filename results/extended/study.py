"""Measure how much an identified effect improves the parameters and the next drive.

python results/extended/study.py [--runs 20] [--jobs 2] [--out FOLDER] writes summary.json, figure.png and README.md.
Finished effects are stored in results/.extended, so an interrupted study resumes. The true roller has an effect
that its machine file lacks. One log of the drive R60_accuracy is diagnosed, and a drive is designed for the resulting
machine file. The true machine drives both drives many times, and the logs are identified with the old and the new file.
Of a tie the new file has the first effect.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import sys
import textwrap
from functools import partial
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

import joblib
import numpy as np
from matplotlib.figure import Figure
from support import studies

from excite import output, smoothing
from excite.diagnosis import diagnosis, run_forked
from excite.errors import InfeasibleError, NoEstimateError, SimulationError
from excite.identification import methods, monte_carlo
from excite.logs import Log, log, profile, repair
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.model.machine import Machine, machine
from excite.reports import COLOURS, save
from excite.simulation import Motion, sensors, simulate
from excite.text import format_number
from excite.trajectories import composite_objective, limits, multistart, objective

DRIVE = HERE.parent / "R60_accuracy" / "design" / "profile.csv"
HIDDEN = (
    "torque_deadband@rear_roll=80",
    "rolling_resistance@front_roll=100",
    "load_dependent_friction@front_roll=0.1",
    "shear_saturation@rear_roll=0.1",
    "asymmetric_coulomb@front_roll=100",
)
TOLERANCE = 1e-3  # share of a limit's range that still counts as kept; from the contract
WAYS = {  # label: machine file, drive
    "old file, old drive": ("old", "old"),
    "new file, old drive": ("new", "old"),
    "new file, new drive": ("new", "new"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--kept", type=Path, default=HERE.parent / ".extended", help="folder of finished effects")
    options = studies.parse(parser, __file__)
    options.kept.mkdir(exist_ok=True)
    rows = []
    for hidden in HIDDEN:
        path = options.kept / f"{hidden}-{options.runs}.json"
        if not path.is_file():
            with output.new_file(path) as place:
                place.write_text(output.to_json(study_effect(hidden, options.runs, options.jobs)), encoding="utf-8")
        rows.append(json.loads(path.read_text(encoding="utf-8")))
        print(f"{hidden}: done", flush=True)
    save(figure(rows), options.out / "figure.png")
    summary = studies.origin(__file__, 0) | {"runs": options.runs, "rows": rows}
    with output.new_file(options.out / "summary.json") as place:
        place.write_text(output.to_json(summary), encoding="utf-8")
    with output.new_file(options.out / "README.md") as place:
        place.write_text(readme(rows, options.runs), encoding="utf-8")


def study_effect(hidden: str, runs: int, jobs: int) -> dict[str, Any]:
    """Diagnose one log with a hidden effect, then compare old and new machine file on the old and the new drive."""
    old = machine.load_machine("va12")
    true = prediction.build(placing.with_effects(old, placing.parse_effect(hidden, old, 60.0)))
    torque, start, _ = profile.read_profile(DRIVE, true)
    motions = {"old": simulate(true, torque, q0=start)}
    found = diagnosed(old, measured(prediction.build(old), true, motions["old"], 1000))
    row: dict[str, Any] = {"hidden": hidden, "verdict": found.verdict, "found": [], "ways": {}}
    for f in found.findings:
        magnitude = {"amount": f.magnitude, "std": f.magnitude_std, "unit": f.unit, "tied_with": f.tied_with}
        row["found"].append({"name": f.name, **magnitude})
    files = {"old": prediction.build(old)}
    if found.findings and found.verdict != "unexplained":
        files["new"] = prediction.build(placing.with_effects(old, *(f.entry for f in found.findings)))
        problem = old.problems["R60"]
        planned = prediction.build(files["new"].machine, fit_sensor_effects=False)
        try:
            made = multistart.design(
                planned, problem, composite_objective.compose_objective(planned, "accuracy"), starts=2, seed=0
            )
            row["cond_phi"] = made.cond_phi
            motions["new"] = simulate(true, made.manoeuvre.sample(float(old.sampling_hz)), q0=made.motion.q[0])
        except (InfeasibleError, SimulationError) as failed:
            row["failed"] = str(failed)
        row["violation"] = {n: motion_limits(limits.check_limits(true, problem, m)) for n, m in motions.items()}
    for way, (file, driven) in WAYS.items():
        if file in files and driven in motions:
            row["ways"][way] = run_statistics(files[file], true, motions[driven], runs, jobs)
    return row


def motion_limits(excess: dict[str, float]) -> dict[str, float]:
    """Select the excesses of limits on the motion; lane and rest at the ends are left out."""
    return {n: x for n, x in excess.items() if not limits.is_free_limit(n)}


def diagnosed(old: Machine, one: Log) -> diagnosis.Diagnosis:
    model = prediction.build(old)
    return diagnosis.diagnose(model, [repair.examine(model, one).log], old.filter, runner=run_forked)


def measured(known: Model, true: Model, motion: Motion, seed: int) -> Log:
    """Simulate a log of the true machine's motion and read it with the columns of a known machine."""
    table = sensors.measure(true, motion, kit="full", seed=seed)
    return log.from_table(table, known.machine, methods.needed_sensors(known, "joint"))


def run_statistics(known: Model, true: Model, motion: Motion, runs: int, jobs: int) -> dict[str, Any]:
    """Identify many runs of one motion: error [%], coverage and attainable accuracy of each parameter in the file."""
    work = (joblib.delayed(partial(identify_run, known.machine, true.machine, motion))(k) for k in range(runs))
    answers = [x for x in joblib.Parallel(n_jobs=jobs)(work) if x is not None]
    found: dict[str, Any] = {"runs": runs, "failed": runs - len(answers), "parameters": {}}
    if not answers:
        return found
    names = tuple(n for n in known.base.names if n in true.base.names)
    at = [known.base.names.index(n) for n in names]
    there = [true.base.names.index(n) for n in names]
    value, std, interval = (np.array([a[k] for a in answers])[..., at] for k in range(3))
    units = tuple(true.base.units[k] for k in there)
    truth, scale = true.nominal[there], true.scale[there]
    of = monte_carlo.Verification("joint", "full", names, units, truth, scale, value, std, interval, {})
    bound = objective.relative_std_percent(true, smoothing.cramer_rao(true, motion))[there]
    for (name, row), least in zip(monte_carlo.summarise_runs(of).items(), bound, strict=True):
        statistics = {key: row[key] for key in ("bias_percent", "rms_percent", "coverage95")}
        found["parameters"][name] = {**statistics, "attainable_percent": float(least)}
    return found


def identify_run(known: Machine, true: Machine, motion: Motion, seed: int) -> tuple[np.ndarray, ...] | None:
    model = prediction.build(known)
    try:
        estimate = methods.identify(model, [measured(model, prediction.build(true), motion, seed)], "joint")
    except NoEstimateError:
        return None
    return estimate.value, estimate.std, estimate.interval95


# ------------------------------------------------------------------------------------------------ figure and page


def own(way: dict[str, Any], key: str) -> np.ndarray:
    """Values of a key for the parameters that the machine has without the effect."""
    return np.array([p[key] for n, p in way["parameters"].items() if "@" not in n], float)


def figure(rows: list[dict[str, Any]]) -> Figure:
    """Plot the errors of every parameter by effect, for each file and drive."""
    fig = Figure(figsize=(10, 4.2), layout="constrained")
    ax = fig.subplots()
    labelled: set[str] = set()
    for k, row in enumerate(rows):
        for j, (way, colour) in enumerate(zip(WAYS, ("0.45", COLOURS[1], COLOURS[0]), strict=True)):
            if way not in row["ways"] or not row["ways"][way]["parameters"]:
                continue
            e = own(row["ways"][way], "rms_percent")
            x = k + 0.25 * (j - 1)
            ax.plot(
                np.full(len(e), x),
                e,
                "o",
                color=colour,
                markersize=4,
                alpha=0.6,
                label=None if way in labelled else way,
            )
            labelled.add(way)
            ax.plot([x - 0.09, x + 0.09], [np.nanmedian(e)] * 2, color=colour, linewidth=2.5)
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_xticks(range(len(rows)), [r["hidden"].replace("@", "\n") for r in rows], fontsize=8)
    ax.set_ylabel("true error of a parameter, rms over runs [%]")
    ax.grid(axis="y", alpha=0.3)
    ax.legend(fontsize=8)
    return fig


def readme(rows: list[dict[str, Any]], runs: int) -> str:
    lines = [
        "# Gain from a diagnosed effect: parameters and the next drive",
        "",
        "**Result.** Error of the worst parameter, by effect:",
        "",
        *(f"- {way}: {_worst(rows, way)}" for way in WAYS),
        "",
        "With the old file, identification can also fail altogether.",
        "",
        "`python results/extended/study.py --out results/extended` rebuilds this page; [summary.json](summary.json)",
        "has every parameter.",
        "",
        "- **Old file, old drive**: `va12` and the drive [R60_accuracy](../R60_accuracy).",
        "- **New file**: the machine file that `excite diagnose` makes from one log. **New drive**: `accuracy` on R60,",
        "  designed for the new file.",
        f"- The true machine drives each {runs} times with new sensor noise. Joint smoothing identifies.",
        "- Errors: rms over runs in per cent of the true value, for the 22 parameters that the machine has without the",
        "  effect. All other values in both files are true.",
        "",
        "| hidden effect | diagnosed | file, drive | median error | worst | coverage | error of the magnitude |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        said = row["verdict"]
        if row["verdict"] in ("named", "tied"):
            said = ", ".join(
                f"{' or '.join([f['name'], *f['tied_with']])}: "
                f"{format_number(f['amount'], 3)} ± {format_number(f['std'], 2)}"
                + (f" {f['unit']}" if f["unit"] != "-" else "")
                for f in row["found"]
            )
        said += f" (no new drive: {row['failed']})" if "failed" in row else ""
        for k, (way, answer) in enumerate(row["ways"].items()):
            head = [row["hidden"], said] if k == 0 else ["", ""]
            lines.append("| " + " | ".join([*head, way, *_cells(answer)]) + " |")
    lines += [
        "",
        "![Errors of every parameter with the old and the new file, on the old and the new drive](figure.png)",
    ]
    lines += ["", *_limits(rows)]
    return "\n".join(lines) + "\n"


def _worst(rows: list[dict[str, Any]], way: str) -> str:
    """Smallest and largest error of the worst parameter over the effects [%]."""
    worst = [np.nanmax(own(r["ways"][way], "rms_percent")) for r in rows if r["ways"].get(way, {}).get("parameters")]
    return f"{percent(min(worst))} to {percent(max(worst))}" if worst else "-"


def percent(x: float) -> str:
    return f"{x:.2g} %" if x < 100 else f"{x:.0f} %"


def _cells(way: dict[str, Any]) -> list[str]:
    if not way["parameters"]:
        return [f"none: all {way['runs']} failed", "", "", ""]
    error, cover = own(way, "rms_percent"), own(way, "coverage95")
    failed = f" ({way['failed']} failed)" if way["failed"] else ""
    names = [n for n in way["parameters"] if "@" not in n]
    amounts = [
        percent(p["rms_percent"])
        for n, p in way["parameters"].items()
        if "@" in n and "." not in n and p["rms_percent"] is not None
    ]
    return [
        f"{percent(np.nanmedian(error))}{failed}",
        f"{percent(np.nanmax(error))} ({names[int(np.nanargmax(error))]})",
        f"{100 * np.nanmean(cover):.0f} %",
        ", ".join(amounts),
    ]


def _limits(rows: list[dict[str, Any]]) -> list[str]:
    """List the largest violation of a limit by each drive on the true machine."""
    lines = []
    for row in rows:
        said = []
        for n, excess in row.get("violation", {}).items():
            name, most = max(excess.items(), key=lambda x: x[1])
            kept = f"exceeds the limit of {name} by {percent(100 * most)} of its range"
            said.append(f"the {n} drive " + (kept if most > TOLERANCE else "keeps every limit"))
        if said:
            text = f"- {row['hidden']}: {', '.join(said)}."
            lines.append(textwrap.fill(text, 120, subsequent_indent="  "))
    return ["Limits on the true machine:", "", *lines] if lines else []


if __name__ == "__main__":
    main()
