"""Do the intervals hold? Simulate, identify by joint smoothing from values that are off, hundreds of times.

python results/coverage/study.py [--jobs 2] goes on where runs.jsonl ends, then rebuilds summary.json and README.md
beside this file; `--runs 10` is a trial of ten runs of each set, `--jobs 0` reports what there is.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import multiprocessing
import os
import time
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np
import pandas as pd
import scipy.signal

from excite.errors import NoEstimateError
from excite.identification import identify
from excite.identification.joint import BIASED_NOTE, UNEXPLAINED_NOTE
from excite.logs import log
from excite.model import Model, build
from excite.model.machine import Machine, machine as machines
from excite.operator import ground
from excite.simulation import Driver, Motion, sensors, simulate
from excite.simulation.scenarios import vary_machine
from excite.smoothing import cramer_rao
from excite.trajectories import percent
from excite.trajectories.objective import relative

HERE = Path(__file__).parent
RUNS = HERE / "runs.jsonl"
OFF = 0.2  # of bodies, friction and contacts in the machine file that identification starts from
FAR = 0.5  # likewise, every one at an end of the range
SLOPE, RADIUS = 0.002, 0.001  # what the model doesn't know
HYDRAULICS = 3.0  # Hz: faster than this the drive's torque doesn't follow the driver model's control loop
MEAN, LEAST = (93.0, 97.0), 88.0  # coverage asked for, mean and least of the parameters [%]


@dataclass(frozen=True)
class Set:
    """Runs of one kind: the drive, the sensors, how far off the start is, what nature adds."""

    ground: str
    kit: str
    runs: int
    start: str = "off"
    nature: str = "model"
    asked: tuple[float, float] | None = None  # worst, median true error [%]

    @property
    def name(self) -> str:
        extra = [s for s in (self.start, self.nature) if s not in ("off", "model")]
        return ", ".join([self.drive, self.kit, *extra])


SETS = (
    Set("human", "full", 400, asked=(2.0, 0.4)),
    Set("human", "paper", 400, asked=(2.0, 0.4)),
    Set("R60_accuracy", "full", 60, asked=(1.2, 0.25)),
    Set("R60", "full", 60, asked=(10.0, 1.6)),
    Set("human", "full", 50, start="far"),
    Set("R60_accuracy", "paper", 50, start="far"),
    Set("human", "full", 20, nature="slope"),
    Set("human", "paper", 20, nature="slope"),
    Set("human", "full", 20, nature="wheel"),
    Set("human", "paper", 20, nature="wheel"),
)


@lru_cache(maxsize=1)
def nominal() -> Model:
    return build(machines.load_machine("va12"))


@lru_cache(maxsize=8)
def natural(nature: str) -> Model:
    """The machine that is driven: the model's own, on a slope, or with a left measuring wheel that is too large."""
    machine: Machine = nominal().machine
    if nature == "slope":
        machine = machine.model_copy(update={"gravity": (9.81 * SLOPE, 0.0, -9.81)})
    if nature == "wheel":
        left = next(s for s in machine.sensor if s.kind == "wheel")
        assert left.radius is not None
        radius = left.radius.model_copy(update={"value": float(left.radius) * (1 + RADIUS)})
        larger = left.model_copy(update={"radius": radius})
        machine = machine.model_copy(update={"sensor": tuple(larger if s is left else s for s in machine.sensor)})
    return build(machine)


@lru_cache(maxsize=4)
def designed(name: str) -> np.ndarray:
    """Torques (N, 3) of a study's design."""
    table = pd.read_csv(HERE.parent / name / "design" / "profile.csv")
    return table[["u1_Nm", "u2_Nm", "u4_Nm"]].to_numpy()


@lru_cache(maxsize=1)
def trace() -> ground.Trace:
    """The phases that a person is given: R60_accuracy in pieces of two seconds and more."""
    return ground.phases(nominal(), simulate(nominal(), designed("R60_accuracy")))


def moved(name: str, nature: str, seed: int) -> Motion:
    """A drive of this name: a design's torques played back, or the phases followed by hand."""
    model = natural(nature)
    if name != "human":
        return simulate(model, designed(name))
    by_hand = ground.driven(model, trace(), Driver(), seed)
    low = scipy.signal.butter(2, HYDRAULICS / (float(model.machine.sampling_hz) / 2))
    return simulate(model, scipy.signal.filtfilt(*low, by_hand.u, axis=0))


def run(s: Set, seed: int) -> dict[str, object]:
    """One simulation and identification: value, std, interval, notes or failure, and seconds of identification."""
    rng = np.random.default_rng([seed, 1999])
    start = build(vary_machine(nominal().machine, FAR if s.start == "far" else OFF, rng, corner=s.start == "far"))
    table = sensors.measure(natural(s.nature), moved(s.drive, s.nature, seed), kit=s.kit, seed=seed)
    measured = log.from_table(table, start.machine)
    row: dict[str, object] = {"set": s.name, "seed": seed}
    began = time.process_time()
    try:
        e = identify(start, [measured], "joint")
    except NoEstimateError as failure:
        return row | {"failure": str(failure), "seconds": time.process_time() - began}
    seconds = time.process_time() - began
    return row | {
        "value": [float(f"{x:.9g}") for x in e.value],
        "std": [float(f"{x:.6g}") for x in e.std],
        "interval": [[float(f"{x:.9g}") for x in end] for end in e.interval95],
        "doubt": UNEXPLAINED_NOTE in e.notes,
        "drawn": BIASED_NOTE in e.notes,
        "seconds": seconds,
    }


def _run(job: tuple[Set, int]) -> dict[str, object]:
    return run(*job)


def done() -> list[dict[str, object]]:
    """Runs so far; a line that was cut off counts as not run."""
    if not RUNS.exists():
        return []
    rows = []
    for line in RUNS.read_text().splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if "value" not in row or "interval" in row:  # earlier versions told less
            rows.append(row)
    return rows


def bound(s: Set) -> np.ndarray:
    """Cramer-Rao bound (n,) [%] along the first drive of a set."""
    motion = moved(s.drive, "model", 0)
    return percent(nominal(), cramer_rao(nominal(), motion, s.kit))


def judged(s: Set, rows: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """What a set's runs say: coverage, errors, failures, time."""
    good = [r for r in rows if "value" in r]
    value, std = (np.array([r[k] for r in good], float).reshape(len(good), -1) for k in ("value", "std"))
    low, high = np.array([r["interval"] for r in good], float).reshape(len(good), 2, -1).transpose(1, 0, 2)
    error = value - nominal().nominal
    # A parameter that a log doesn't show has no value, and counts in none of these.
    warnings.simplefilter("ignore", RuntimeWarning)
    known = np.where(np.isfinite(error), 1.0, np.nan)
    inside = 100 * np.nanmean(known * ((low <= nominal().nominal) & (nominal().nominal <= high)), axis=0)
    rms = 100 * np.sqrt(np.nanmean(error**2, axis=0)) / relative(nominal())
    least = bound(s)
    ratio = np.sqrt(np.nanmean((error / std) ** 2, axis=0))
    seconds = np.array([r["seconds"] for r in rows], float)
    names = nominal().base.names
    return {
        **asdict(s),
        "name": s.name,
        "runs": len(rows),
        "failures": sum("failure" in r for r in rows),
        "doubts": sum(bool(r.get("doubt")) for r in rows),
        "coverage_mean": np.nanmean(inside),
        "coverage_least": np.nanmin(inside),
        "coverage_least_of": names[int(np.nanargmin(inside))],
        "rms_over_sigma": float(np.sqrt(np.nanmean(ratio**2))),
        "error_worst_percent": np.nanmax(rms),
        "error_worst_of": names[int(np.nanargmax(rms))],
        "error_median_percent": float(np.nanmedian(rms)),
        "bound_worst_percent": least.max(),
        "bound_median_percent": float(np.median(least)),
        "seconds_median": float(np.median(seconds)),
        "seconds_worst": seconds.max(),
        "parameters": {
            n: {
                "coverage": inside[k],
                "rms_over_sigma": ratio[k],
                "rms_percent": rms[k],
                "bias_percent": 100 * float(np.nanmean(error[:, k])) / relative(nominal())[k],
                "bound_percent": least[k],
            }
            for k, n in enumerate(names)
        },
    }


TEXT = """
# Do the intervals of joint smoothing hold?

`python results/coverage/study.py --jobs 2` goes on where it was stopped (`runs.jsonl` beside it, not kept in the
repository) and rebuilds this page and `summary.json`. Every run drives the nominal `va12` in simulation, measures it
with the sensors' counts and noise and identifies with `--method joint`, starting from a machine file whose masses,
inertias, centres of mass, frictions, offsets and contacts are each off by up to 20 % (**far**: each at 0.5 or 1.5 times
its value). **human**: the phases of the drive sheet of R60_accuracy (two seconds and longer) followed by the driver
model, another hand every time; what its control loop does to the torque faster than 3 Hz is filtered out.
**R60_accuracy**, **R60**: the designs' torques played back. **slope**: the ground falls by 0.2 % in one direction;
**wheel**: the left measuring wheel is 0.1 % larger than the file says: both must be doubted, no other run may be; what
they give then allows for disturbing forces, and its intervals are said not to hold.
Asked for: coverage of the 95 % intervals 93-97 % on average and 88 % for every parameter; rms error 0.9-1.15 predicted
deviations; at most 2 % of logs without an estimate, 10 % from far off; worst and median true error 1.2 and 0.25 %
(R60_accuracy), 2.0 and 0.4 % (human), 10 and 1.6 % (R60). Of 60 runs one parameter's coverage is known to 6 % only
(two deviations). True error is the rms over runs relative to the true value; the bound is Cramer and Rao's along the
first drive. Seconds are of one core's own time on a machine that other work kept busy.
"""
EDGES = """
## One-way drives: why Fs and u0 are stated too wide

On S40, which goes one way, only starting and stopping tell dry friction from the torque offset, and only the moments
of single encoder edges show it. An edge's deviation has a floor, 0.1 counts: what a good encoder's divisions are off.
Simulated encoders have perfect edges, so that there Fs and u0 err less than is stated, by about 1.3 times
([1999](../1999)). That is the price of not believing in perfect ones.
"""


def report(sets: Sequence[dict[str, object]]) -> str:
    return TEXT.lstrip() + "\n" + tables(sets) + EDGES


def tables(sets: Sequence[dict[str, object]]) -> str:
    head = ("set", "runs", "no estimate", "says doubtful", "coverage, mean", "least", "rms error / sigma")
    head += ("true error, worst", "median", "bound, worst / median", "s per log, median (worst)")
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for r in sets:
        lines.append(
            "| {name} | {runs} | {failures} | {doubts} | {coverage_mean:.1f} % | {coverage_least:.1f} %"
            " ({coverage_least_of}) | {rms_over_sigma:.2f} | {error_worst_percent:.2f} % ({error_worst_of}) |"
            " {error_median_percent:.2f} % | {bound_worst_percent:.2f} / {bound_median_percent:.2f} % |"
            " {seconds_median:.2f} ({seconds_worst:.1f}) |".format(**r)
        )
    for r in (r for r in sets if r["start"] == "off" and r["nature"] == "model"):
        lines += ["", f"**{r['name']}**, {r['runs']} runs", ""]
        lines += ["| parameter | coverage | rms error / sigma | rms error % | bias % | bound % |", "|---" * 6 + "|"]
        parameters: Mapping[str, Mapping[str, float]] = r["parameters"]  # type: ignore[assignment]
        lines += [
            "| {n} | {coverage:.1f} % | {rms_over_sigma:.2f} | {rms_percent:.3f} | {bias_percent:.3f} |"
            " {bound_percent:.3f} |".format(n=n, **p)
            for n, p in parameters.items()
        ]
    return "\n".join(lines) + "\n"


def _plain(x: object) -> object:
    """Numbers of five digits: files that can be compared."""
    if isinstance(x, dict):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, float | np.floating):
        return float(f"{x:.5g}")
    return x


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2, help="processes side by side; 0: report what there is")
    parser.add_argument("--runs", type=int, help="of each set, for a trial")
    options = parser.parse_args()
    sets = [replace(s, runs=min(s.runs, options.runs or s.runs)) for s in SETS]
    have = {(r["set"], r["seed"]) for r in done()}
    todo = [(s, seed) for s in sets for seed in range(s.runs) if (s.name, seed) not in have]
    # Sets grow together: whatever there is when it is stopped says something of each.
    todo.sort(key=lambda x: x[1] / x[0].runs)
    if options.jobs:
        # Forked workers keep the models that this file has built. One that is killed ends the study: it can go on.
        fork = multiprocessing.get_context("fork")
        with ProcessPoolExecutor(options.jobs, mp_context=fork) as pool, RUNS.open("a") as out:
            try:
                for row in as_completed([pool.submit(_run, job) for job in todo]):
                    out.write(json.dumps(row.result()) + "\n")
                    out.flush()
            finally:
                pool.shutdown(cancel_futures=True)
    rows = {s: [r for r in done() if r["set"] == s.name and int(str(r["seed"])) < s.runs] for s in sets}
    found = [judged(s, own) for s, own in rows.items() if any("value" in r for r in own)]
    if not found:
        raise SystemExit(f"{RUNS} holds no run: the report stays as it is")
    (HERE / "summary.json").write_text(json.dumps(_plain({"off": OFF, "sets": found}), indent=1) + "\n")
    (HERE / "README.md").write_text(report(found))


if __name__ == "__main__":
    main()
