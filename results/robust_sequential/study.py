"""Nominal, robust and sequential design on machines that nobody knows exactly, driven by people.

python results/robust_sequential/study.py [--machines 100] [--sequential 100] [--identified 6] [--jobs 2] rebuilds
summary.json and figure.png beside this file. Every machine is written to `runs/` as it is done; a study that was
stopped goes on from there.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import joblib
import numpy as np
from matplotlib.figure import Figure

from excite import aim as aims
from excite import folder, identify, log, scenario, sensors, sequential
from excite.design import design
from excite.driver import follow
from excite.limit import check
from excite.manoeuvre import Manoeuvre
from excite.report import COLOURS, save
from excite.simulate import Motion, SimulationError, simulate
from excite.smoothing import cramer_rao
from model import machine, prediction
from model.machine import Problem
from model.prediction import Model

HERE = Path(__file__).parent
SECONDS = 30.0  # of each of two drives
SPREAD, SCENARIOS = 0.2, 5
KINDS = ("nominal", "robust", "sequential")
FREE = ("lane", "rest")  # what people see to themselves


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument(
        "--sequential", type=int, default=100, help="of these, how many get a second drive of their own"
    )
    parser.add_argument(
        "--identified", type=int, default=6, help="of these, how many logs are identified, not just bounded"
    )
    parser.add_argument("--objective", default="accuracy")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--runs", type=Path, default=HERE / "runs", help="folder of what is done already")
    options = parser.parse_args()
    options.runs.mkdir(exist_ok=True)
    designs = designed(options.objective, options.runs)
    work = (
        joblib.delayed(one)(options.runs, k, designs, options.objective, k < options.sequential, k < options.identified)
        for k in range(options.machines)
    )
    rows = []
    for row in joblib.Parallel(n_jobs=options.jobs, return_as="generator_unordered")(work):
        rows.append(row)
        print(f"machine {row['machine']}: {len(rows)} of {options.machines} done", flush=True)
    rows.sort(key=lambda r: r["machine"])
    summary = {
        "objective": options.objective,
        "drives_s": [SECONDS, SECONDS],
        "spread": SPREAD,
        "scenarios": SCENARIOS,
        "machines": options.machines,
        "table": table(rows),
        "rows": rows,
    }
    save(figure(rows), HERE / "figure.png")
    with folder.writing_file(HERE / "summary.json") as place:
        place.write_text(folder.dump(summary), encoding="utf-8")
    for kind, line in summary["table"].items():
        print(kind, json.dumps(folder._plain(line)))


def short(model: Model) -> Problem:
    problem = model.machine.problems["R60"]
    return problem.model_copy(update={"duration_s": problem.duration_s.model_copy(update={"value": SECONDS})})


def roller() -> Model:
    return prediction.build(machine.load("va12"))


def designed(objective: str, runs: Path) -> dict[str, Manoeuvre]:
    """The nominal and the robust drive, from `runs` where they are there."""
    model, found = roller(), {}
    for kind in ("nominal", "robust"):
        path = runs / f"{kind}-{objective}.json"
        if not path.is_file():
            others = scenario.scenarios(model, SCENARIOS, SPREAD) if kind == "robust" else ()
            warm = [found["nominal"]] if kind == "robust" else []
            d = design(model, short(model), aims.aim(model, objective, machines=others), starts=2, seed=0, warm=warm)
            with folder.writing_file(path) as place:
                place.write_text(json.dumps({"t": d.manoeuvre.times.tolist(), "u": d.manoeuvre.torque.tolist()}))
            print(f"{kind}: cond(Phi) {d.cond_phi:.1f}", flush=True)
        stored = json.loads(path.read_text())
        found[kind] = Manoeuvre(np.array(stored["t"]), np.array(stored["u"]))
    return found


def one(
    runs: Path, number: int, designs: dict[str, Manoeuvre], objective: str, third: bool, identified: bool
) -> dict[str, object]:
    """One machine: two drives of every kind, what they tell at best, and what is identified from them."""
    path = runs / f"{objective}-{number:03d}-{int(third)}{int(identified)}.json"
    if path.is_file():
        return dict(json.loads(path.read_text()))
    nominal = roller()
    true = prediction.build(scenario.varied(nominal.machine, SPREAD, np.random.default_rng([number, 7])))
    row: dict[str, object] = {"machine": number}
    first: Motion | None = None
    for kind in KINDS[: 3 if third else 2]:
        try:
            if kind == "sequential":
                assert first is not None
                drive = second(nominal, true, first, designs["nominal"], objective, number)
                motions = [first, driven(nominal, true, drive[1], drive[0], 2 * number + 1)]
            else:
                motions = [driven(nominal, true, designs[kind], nominal, 2 * number + i) for i in range(2)]
        except (SimulationError, identify.NoEstimate, ValueError) as err:
            row[kind] = {"failed": str(err)}
            continue
        if kind == "nominal":
            first = motions[0]
        row[kind] = told(true, motions)
        if identified:
            row[kind] |= {"error_percent": errors(nominal, true, motions, number)}  # type: ignore[operator]
    with folder.writing_file(path) as place:
        place.write_text(folder.dump(row), encoding="utf-8")
    return row


def driven(nominal: Model, true: Model, drive: Manoeuvre, planned: Model, seed: int) -> Motion:
    """What the true machine does under a driver who follows the speed and articulation that were planned."""
    plan = simulate(planned, drive.sample(float(nominal.machine.sampling_hz)))
    return follow(true, plan.nu[:, 0], plan.q[:, [4]], seed=seed)


def second(
    nominal: Model, true: Model, first: Motion, start: Manoeuvre, objective: str, number: int
) -> tuple[Model, Manoeuvre]:
    """The machine as the first log tells it, and the drive for what that leaves."""
    known = sequential.known(nominal, [measured(nominal, true, first, 1000 + number)])
    aim = aims.aim(known.model, objective, prior=known.information)
    turned = Manoeuvre(start.times, start.torque * [1, -1, 1])
    found = design(known.model, short(nominal), aim, starts=0, warm=[start, turned])
    return known.model, found.manoeuvre


def measured(nominal: Model, true: Model, motion: Motion, seed: int) -> log.Log:
    table = sensors.measure(true, motion, seed=seed)
    return log.check(table, nominal.machine, identify.needed_sensors(nominal, "joint"))


def told(true: Model, motions: Sequence[Motion]) -> dict[str, object]:
    """Condition number of both drives together, Cramer-Rao bound, and the limit most exceeded, of the true machine."""
    W = np.concatenate([true.stacked(m.q.T, m.nu.T, m.a.T).reshape(-1, len(true.scale)) for m in motions])
    by = np.outer(true.scale, true.scale)
    information = sum(np.linalg.inv(cramer_rao(true, m) / by) for m in motions)
    spread = 100 * np.sqrt(np.diag(np.linalg.inv(information) * by)) / np.abs(true.nominal)
    broken = [(v, n) for m in motions for n, v in check(true, short(true), m).items() if not n.startswith(FREE)]
    return {
        "limit": max(broken)[1],
        "excess": max(broken)[0],
        "cond_phi": float(np.linalg.cond(np.linalg.qr(W * true.scale, mode="r"))),
        "sigma_percent": spread.tolist(),
    }


def errors(nominal: Model, true: Model, motions: Sequence[Motion], number: int) -> list[float]:
    """Errors [%] of what both logs together give."""
    logs = [measured(nominal, true, m, 1000 * (i + 1) + number) for i, m in enumerate(motions)]
    found = identify.identify(nominal, logs, "joint")
    return (100 * (found.value - true.nominal) / np.abs(true.nominal)).tolist()


def table(rows: Sequence[dict[str, object]]) -> dict[str, dict[str, object]]:
    """Median and 90th percentile over the machines of cond, worst and median parameter."""
    out: dict[str, dict[str, object]] = {}
    for kind in KINDS:
        got = [r[kind] for r in rows if kind in r and "failed" not in r[kind]]  # type: ignore[operator]
        if not got:
            continue
        sigma = np.array([g["sigma_percent"] for g in got])
        out[kind] = {"machines": len(got), "failed": sum(kind in r for r in rows) - len(got)}
        for name, x in (
            ("cond_phi", np.array([g["cond_phi"] for g in got])),
            ("worst_percent", sigma.max(axis=1)),
            ("median_percent", np.median(sigma, axis=1)),
            ("excess", np.array([g["excess"] for g in got])),
        ):
            out[kind][name] = {"median": float(np.median(x)), "p90": float(np.percentile(x, 90)), "max": float(x.max())}
        e = [g["error_percent"] for g in got if "error_percent" in g]
        if e:
            ratio = np.array(e, float) / np.array([g["sigma_percent"] for g in got if "error_percent" in g])
            out[kind]["identified"] = {"machines": len(e), "rms_error_over_bound": float(np.sqrt(np.nanmean(ratio**2)))}
    paired = [r for r in rows if all(k in r and "failed" not in r[k] for k in KINDS)]  # type: ignore[operator]
    for kind in KINDS[1:]:
        pairs = (
            paired
            if kind == "sequential"
            else [
                r
                for r in rows
                if all("failed" not in r[k] for k in KINDS[:2])  # type: ignore[operator]
            ]
        )
        if pairs:
            gain = [max(r[kind]["sigma_percent"]) / max(r["nominal"]["sigma_percent"]) for r in pairs]  # type: ignore[index]
            out[kind]["worst_over_nominal"] = {
                "median": float(np.median(gain)),
                "better": float(np.mean(np.array(gain) < 1)),
            }
    return out


def figure(rows: Sequence[dict[str, object]]) -> Figure:
    """Every machine: cond, worst and median parameter, by kind of design."""
    fig = Figure(figsize=(11, 4), layout="constrained")
    axes = fig.subplots(1, 3)
    labels = ("cond(Phi), true", "worst parameter: bound [%]", "median parameter: bound [%]")
    for i, (ax, label) in enumerate(zip(axes, labels, strict=True)):
        for k, kind in enumerate(KINDS):
            got = [r[kind] for r in rows if kind in r and "failed" not in r[kind]]  # type: ignore[operator]
            if not got:
                continue
            x = np.array([g["cond_phi"] if i == 0 else (max if i == 1 else np.median)(g["sigma_percent"]) for g in got])
            place = k + 0.25 * np.linspace(-1, 1, len(x))
            ax.plot(place, np.sort(x), "o^s"[k], color=COLOURS[k], markersize=3)
            ax.hlines(np.median(x), k - 0.35, k + 0.35, color="black")
        ax.set_xticks(range(len(KINDS)), KINDS)
        ax.set_yscale("log")
        ax.set_ylabel(label)
        ax.grid(axis="y", alpha=0.3)
    return fig


if __name__ == "__main__":
    main()
