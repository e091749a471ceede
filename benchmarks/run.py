"""Measure the time of the program's parts as ratios that are comparable over time and machines.

    python benchmarks/run.py                  measure all parts, compare with history.jsonl, add a line to it
    python benchmarks/run.py --only joint     measure one part;  --profile: profile it
    python benchmarks/run.py --check 1.5      exit with 1 if a ratio exceeds 1.5 times the stored median
    python benchmarks/run.py --scaling        cost of a study per run at 10, 100, 1000 and 10 000 runs, in one process
                                              and in two, and its memory

A ratio is the CPU time of a part over that of a fixed reference computation, measured alternately on the same machine.
It depends little on the load and the speed of the machine.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import atexit
import cProfile
import hashlib
import json
import os
import platform
import pstats
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np
import pandas as pd
from joblib.externals.loky import get_reusable_executor

from excite.diagnosis import diagnosis
from excite.identification import methods
from excite.logs import log, preparation, profile
from excite.model import Model, prediction
from excite.model.machine import machine
from excite.simulation import Motion, sensors, simulate
from excite.workflows import design_request, requests, study_plan, study_runner, study_runs

HERE = Path(__file__).parent
HISTORY = HERE / "history.jsonl"
ROUNDS = 3  # rounds of reference and part; the minimum counts; chosen
ROUND_DURATION = 0.3  # s: a part is repeated for this long in a round; chosen
HOUR = Path(tempfile.mkdtemp(prefix="excite-benchmark-"))  # a folder of long logs
atexit.register(shutil.rmtree, HOUR)
STUDY = """
name = "overhead"
runs = {runs}
steps = "simulate"
[grid]
machine = "va12_straight"
profile = "drive.csv"
"""


def cpu_time() -> float:
    """CPU time [s] of this process and of the finished child processes."""
    own, children = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def reference() -> None:
    """Run a fixed mix of small linear algebra, Python loops and memory traffic, as in the program."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((40, 40))
    for _ in range(300):
        np.linalg.svd(A)
    total = 0.0
    for k in range(300_000):
        total += k % 7 * 0.5
    x = rng.standard_normal(400_000)
    for _ in range(10):
        np.cumsum(np.sort(x))


@lru_cache
def straight_model() -> Model:
    return prediction.build(machine.load_machine("va12_straight"))


@lru_cache
def drive(seconds: float) -> Motion:
    t = np.arange(round(seconds * 100) + 1) / 100
    slow = np.minimum(1, np.minimum(t, seconds - t) / 2)
    torque = np.column_stack([1500 * np.sin(0.7 * t) * slow, 1200 * np.sin(1.1 * t) * slow])
    return simulate(straight_model(), torque)


@lru_cache
def measured_log(seconds: float) -> log.Log:
    return log.from_table(sensors.measure(straight_model(), drive(seconds), seed=1), straight_model().machine)


@lru_cache
def steered_model() -> Model:
    return prediction.build(machine.load_machine("va12"))


@lru_cache
def hour_file(suffix: str) -> Path:
    """A file of an hour: 360 000 rows, times that jitter by 1 ms, 22 columns of which the machine uses half."""
    t = np.arange(4001) / 100
    slow = np.minimum(1, np.minimum(t, 40 - t) / 2)
    torque = np.column_stack([1200 * np.sin(0.7 * t), 4500 * np.sin(0.9 * t), 1200 * np.sin(1.1 * t)]) * slow[:, None]
    short = sensors.measure(steered_model(), simulate(steered_model(), torque), seed=2)
    rng, k = np.random.default_rng(0), np.arange(360_000)
    table = short.iloc[4000 - np.abs(k % 8000 - 4000)].reset_index(drop=True)  # forth and back
    times = k / 100 + rng.uniform(-1e-3, 1e-3, len(k))
    table[steered_model().machine.time_column] = np.round(times - times[0], 6)
    spare = {f"spare{n}": np.round(rng.standard_normal(len(k)), 5) for n in range(22 - table.shape[1])}
    path = HOUR / f"hour{suffix}"
    table = table.assign(**spare)
    if suffix == ".csv":
        table.to_csv(path, index=False)
    else:
        table.to_parquet(path)
    return path


def run_command(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "excite", *words], check=True, capture_output=True)


def import_worker() -> None:
    """Import what a worker process of a study loads before it computes."""
    subprocess.run([sys.executable, "-c", "import excite.workflows.study_runs"], check=True)


def run_simulation() -> None:
    """Run a short simulation by command: 2.5 s of driving, a log of 250 rows."""
    with tempfile.TemporaryDirectory() as folder:
        profile.profile_of(straight_model(), drive(2.5)).to_csv(f"{folder}/drive.csv", index=False)
        run_command("simulate", "va12_straight", f"{folder}/drive.csv", "--out", f"{folder}/log.csv")


def run_design() -> None:
    _, problem = requests.choose_problem(straight_model().machine, None, 8.0)
    design_request.design_from(straight_model(), problem, design_request.DesignRequest("cond", starts=1))
    get_reusable_executor().shutdown(wait=True)  # CPU time of a child counts after it has ended


def run_diagnosis() -> None:
    diagnosis.diagnose(straight_model(), [measured_log(20.0)], straight_model().machine.filter)


def run_study(runs: int, jobs: int = 1) -> None:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        profile.profile_of(straight_model(), drive(2.5)).to_csv(place / "drive.csv", index=False)
        (place / "study.toml").write_text(STUDY.format(runs=runs))
        study_runner.run_study(study_plan.read_study(place / "study.toml"), place / "out", jobs=jobs)


def run_without_study(runs: int) -> None:
    """Simulate and hash the runs of `run_study` without a study around them."""
    for seed in range(runs):
        table = sensors.measure(straight_model(), drive(2.5), seed=seed)
        hashlib.sha256(table.to_numpy(float).tobytes()).hexdigest()


PARTS: dict[str, Callable[[], object]] = {
    "start-up: --help": lambda: run_command("--help"),
    "start-up: machines": lambda: run_command("machines", "--json"),
    "start-up: a worker": import_worker,
    "start-up: simulate": run_simulation,
    "model of va12": lambda: prediction.build(machine.load_machine("va12")),
    "simulation, 40 s": lambda: simulate(straight_model(), drive(40.0).u),
    "sensors, 40 s": lambda: sensors.measure(straight_model(), drive(40.0), seed=1),
    "identification ols, 40 s": lambda: methods.identify(straight_model(), [measured_log(40.0)], "ols"),
    "identification joint, 40 s": lambda: methods.identify(straight_model(), [measured_log(40.0)], "joint"),
    "diagnosis, 20 s": run_diagnosis,
    "design, 8 s, one start": run_design,
    "log of an hour, CSV": lambda: preparation.prepare(steered_model(), [hour_file(".csv")]),
    "the same by pandas alone": lambda: pd.read_csv(hour_file(".csv")),
    "log of an hour, Parquet": lambda: preparation.prepare(steered_model(), [hour_file(".parquet")]),
    "study of 200 runs": lambda: run_study(200),
    "the same 200 runs bare": lambda: run_without_study(200),
}


def cpu_time_of(work: Callable[[], object]) -> float:
    begin = cpu_time()
    work()
    return cpu_time() - begin


def measure_with_reference(work: Callable[[], object]) -> tuple[float, float]:
    """Least CPU time [s] of a function and of the reference, measured alternately.

    Disturbances only add time, and a slow phase of the machine affects both.
    """
    own: list[float] = []
    base: list[float] = []
    for _ in range(ROUNDS):
        base.append(cpu_time_of(reference))
        begin = len(own)
        while len(own) == begin or sum(own[begin:]) < ROUND_DURATION:
            own.append(cpu_time_of(work))
    return min(own), min(base)


def measure(only: str | None) -> dict[str, dict[str, float]]:
    """Measure parts: CPU time [s] and ratio to the reference, by name."""
    rows: dict[str, dict[str, float]] = {}
    straight_model(), drive(40.0), drive(20.0), drive(2.5), measured_log(40.0), measured_log(20.0)
    for name, work in PARTS.items():
        if only is not None and only not in name:
            continue
        own, base = measure_with_reference(work)
        rows[name] = {"cpu_s": round(own, 5), "ratio": round(own / base, 4)}
        print(f"{name:32} {own:8.3f} s CPU {own / base:8.2f} of the reference", flush=True)
    return rows


def stored_history() -> list[dict[str, dict[str, float]]]:
    if not HISTORY.is_file():
        return []
    return [json.loads(line)["parts"] for line in HISTORY.read_text().splitlines()]


def commit() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


def compare_with_history(rows: dict[str, dict[str, float]], limit: float | None) -> int:
    """Print each ratio relative to the stored median; return how many exceed `limit` times the median."""
    before, worse = stored_history(), 0
    for name, row in rows.items():
        old = [h[name]["ratio"] for h in before if name in h]
        if not old:
            continue
        change = row["ratio"] / statistics.median(old)
        bad = limit is not None and change > limit
        worse += bad
        print(f"{name:32} {change:6.2f} times the median of {len(old)} stored{'  TOO SLOW' if bad else ''}")
    return worse


def scaling(sizes: list[int]) -> None:
    """Print the cost of studies of growing size, each in its own process, first without a study."""
    print(
        "| runs | processes | wall [s] | wall per run [ms] | CPU per run [ms] | speed-up | driver [MB] | worker [MB]"
        " | table [kB] |\n|---|---|---|---|---|---|---|---|---|"
    )
    for runs in sizes:
        alone = 0.0
        for jobs in (0, 1, 2):
            code = f"import run; run.print_scaling_row({runs}, {jobs}, {alone})"
            done = subprocess.run([sys.executable, "-c", code], cwd=HERE, check=True, stdout=subprocess.PIPE, text=True)
            print(done.stdout, end="", flush=True)
            if jobs == 1:
                alone = float(done.stdout.split("|")[3])


def peak_memory(pid: int | str = "self") -> float:
    """Peak memory [MB] of a process. ru_maxrss would not do: a child inherits it from its parent."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:  # the process has ended
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def print_scaling_row(runs: int, jobs: int, alone: float) -> None:
    """Print a row of the scaling table. jobs 0: runs without a study; alone: wall time [s] in one process."""
    straight_model(), drive(2.5)
    run_without_study(1)
    with tempfile.TemporaryDirectory() as folder:
        place, workers, looked, size = Path(folder), 0.0, 0.0, "-"
        profile.profile_of(straight_model(), drive(2.5)).to_csv(place / "drive.csv", index=False)
        (place / "study.toml").write_text(STUDY.format(runs=runs))

        def watch_workers(*_: object) -> None:
            nonlocal workers, looked
            if time.perf_counter() - looked > 0.2:
                children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
                workers, looked = max([workers, *map(peak_memory, children)]), time.perf_counter()

        begin, spent = time.perf_counter(), cpu_time()
        if jobs:
            study_runner.run_study(
                study_plan.read_study(place / "study.toml"), place / "out", jobs=jobs, progress=watch_workers
            )
            size = f"{(place / 'out' / 'runs.parquet').stat().st_size / 1e3:.0f}"
        else:
            run_without_study(runs)
        wall, busy = time.perf_counter() - begin, cpu_time() - spent
    faster = f"{alone / wall:.2f}" if jobs > 1 else "-"
    print(
        f"| {runs} | {jobs or 'no study'} | {wall:.2f} | {1e3 * wall / runs:.2f} | {1e3 * busy / runs:.2f} | {faster}"
        f" | {peak_memory():.0f} | {f'{workers:.0f}' if workers else '-'} | {size} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="parts whose name contains this")
    parser.add_argument("--profile", action="store_true", help="profile the parts")
    parser.add_argument(
        "--check",
        type=float,
        metavar="FACTOR",
        help="exit with 1 if a ratio exceeds this factor times the stored median",
    )
    parser.add_argument("--dry", action="store_true", help="do not add a line to history.jsonl")
    parser.add_argument("--scaling", type=int, nargs="*", metavar="RUNS", help="numbers of runs [10 100 1000 10000]")
    asked = parser.parse_args()
    if asked.scaling is not None:
        scaling(asked.scaling or [10, 100, 1000, 10_000])
        return
    if asked.profile:
        for name, work in PARTS.items():
            if asked.only is None or asked.only in name:
                work()
                profiler = cProfile.Profile()
                profiler.runcall(work)
                print(f"== {name}")
                pstats.Stats(profiler).sort_stats("tottime").print_stats(12)
        return
    rows = measure(asked.only)
    worse = compare_with_history(rows, asked.check)
    if not asked.dry and asked.only is None:
        about = {
            "commit": commit(),
            "python": platform.python_version(),
            "program": study_runs.program_hash(),
            "parts": rows,
        }
        with HISTORY.open("a", encoding="utf-8") as file:
            file.write(json.dumps(about) + "\n")
    sys.exit(1 if worse else 0)


if __name__ == "__main__":
    main()
