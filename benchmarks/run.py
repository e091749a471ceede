"""How long the parts of the program take, as ratios that can be kept over time.

    python benchmarks/run.py                  measures all, compares with what is kept, adds a line to history.jsonl
    python benchmarks/run.py --only joint     one of them;  --profile: where its time goes
    python benchmarks/run.py --check 1.5      ends with 1 where a ratio is more than 1.5 times the median kept
    python benchmarks/run.py --scaling        what a study costs per run at 10, 100, 1000 and 10 000 runs, in one
                                              process and in two, and its memory

A ratio is CPU time over that of a fixed reference computation, measured in turn on the same machine: it depends little
on what else the machine does and on how fast it is.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import cProfile
import hashlib
import json
import os
import platform
import pstats
import resource
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
from joblib.externals.loky import get_reusable_executor

from excite.diagnosis import diagnosis
from excite.identification import methods
from excite.logs import log, profile
from excite.model import Model, prediction
from excite.model.machine import machine
from excite.simulation import Motion, sensors, simulate
from excite.workflows import design_request, requests, study_plan, study_runner, study_runs

HERE = Path(__file__).parent
HISTORY = HERE / "history.jsonl"
ROUNDS = 3  # of the reference and a part
SHORT = 0.3  # s that a part is repeated for in a round
STUDY = """
name = "overhead"
runs = {runs}
steps = "simulate"
[grid]
machine = "va12_straight"
profile = "drive.csv"
"""


def cpu() -> float:
    """CPU time [s] of this process and of those that it waited for."""
    own, children = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def reference() -> None:
    """Much what the program does: small linear algebra, Python, and memory that is moved about."""
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
def straight() -> Model:
    return prediction.build(machine.load_machine("va12_straight"))


@lru_cache
def drive(seconds: float) -> Motion:
    t = np.arange(round(seconds * 100) + 1) / 100
    slow = np.minimum(1, np.minimum(t, seconds - t) / 2)
    torque = np.column_stack([1500 * np.sin(0.7 * t) * slow, 1200 * np.sin(1.1 * t) * slow])
    return simulate(straight(), torque)


@lru_cache
def measured(seconds: float) -> log.Log:
    return log.from_table(sensors.measure(straight(), drive(seconds), seed=1), straight().machine)


def started(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "excite", *words], check=True, capture_output=True)


def worker() -> None:
    """What a process of a study or a design loads before it computes."""
    subprocess.run([sys.executable, "-c", "import excite.cell"], check=True)


def simulated() -> None:
    """A short command that computes: 2.5 s of driving, a log of 250 rows."""
    with tempfile.TemporaryDirectory() as folder:
        profile.profile_of(straight(), drive(2.5)).to_csv(f"{folder}/drive.csv", index=False)
        started("simulate", "va12_straight", f"{folder}/drive.csv", "--out", f"{folder}/log.csv")


def designed() -> None:
    _, problem = requests.choose_problem(straight().machine, None, 8.0)
    design_request.design_from(straight(), problem, design_request.DesignRequest("cond", starts=1))
    get_reusable_executor().shutdown(wait=True)  # CPU time of a process counts when it has ended


def diagnosed() -> None:
    diagnosis.diagnose(straight(), [measured(20.0)], straight().machine.filter)


def studied(runs: int, jobs: int = 1) -> None:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        profile.profile_of(straight(), drive(2.5)).to_csv(place / "drive.csv", index=False)
        (place / "study.toml").write_text(STUDY.format(runs=runs))
        study_runner.run_study(study_plan.read_study(place / "study.toml"), place / "out", jobs=jobs)


def bare(runs: int) -> None:
    """The runs of `studied` without a study around them."""
    for seed in range(runs):
        table = sensors.measure(straight(), drive(2.5), seed=seed)
        hashlib.sha256(table.to_numpy(float).tobytes()).hexdigest()


PARTS: dict[str, Callable[[], object]] = {
    "start-up: --help": lambda: started("--help"),
    "start-up: machines": lambda: started("machines", "--json"),
    "start-up: a worker": worker,
    "start-up: simulate": simulated,
    "model of va12": lambda: prediction.build(machine.load_machine("va12")),
    "simulation, 40 s": lambda: simulate(straight(), drive(40.0).u),
    "sensors, 40 s": lambda: sensors.measure(straight(), drive(40.0), seed=1),
    "identification ols, 40 s": lambda: methods.identify(straight(), [measured(40.0)], "ols"),
    "identification joint, 40 s": lambda: methods.identify(straight(), [measured(40.0)], "joint"),
    "diagnosis, 20 s": diagnosed,
    "design, 8 s, one start": designed,
    "study of 200 runs": lambda: studied(200),
    "the same 200 runs bare": lambda: bare(200),
}


def timed(work: Callable[[], object]) -> float:
    begin = cpu()
    work()
    return cpu() - begin


def paired(work: Callable[[], object]) -> tuple[float, float]:
    """The least CPU time [s] of a piece of work and of the reference, measured in turn: everything disturbs in one
    direction, and a machine that is slow for a while is so for both."""
    own: list[float] = []
    base: list[float] = []
    for _ in range(ROUNDS):
        base.append(timed(reference))
        begin = len(own)
        while len(own) == begin or sum(own[begin:]) < SHORT:
            own.append(timed(work))
    return min(own), min(base)


def measure(only: str | None) -> dict[str, dict[str, float]]:
    """Part -> CPU seconds and ratio to the reference."""
    rows: dict[str, dict[str, float]] = {}
    straight(), drive(40.0), drive(20.0), drive(2.5), measured(40.0), measured(20.0)
    for name, work in PARTS.items():
        if only is not None and only not in name:
            continue
        own, base = paired(work)
        rows[name] = {"cpu_s": round(own, 5), "ratio": round(own / base, 4)}
        print(f"{name:32} {own:8.3f} s CPU {own / base:8.2f} of the reference", flush=True)
    return rows


def kept() -> list[dict[str, dict[str, float]]]:
    if not HISTORY.is_file():
        return []
    return [json.loads(line)["parts"] for line in HISTORY.read_text().splitlines()]


def commit() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


def compared(rows: dict[str, dict[str, float]], limit: float | None) -> int:
    """Shows each ratio beside the median of those kept; how many are above `limit` times that."""
    before, worse = kept(), 0
    for name, row in rows.items():
        old = [h[name]["ratio"] for h in before if name in h]
        if not old:
            continue
        change = row["ratio"] / statistics.median(old)
        bad = limit is not None and change > limit
        worse += bad
        print(f"{name:32} {change:6.2f} times the median of {len(old)} kept{'  TOO SLOW' if bad else ''}")
    return worse


def scaling(sizes: list[int]) -> None:
    """Cost of studies of growing size, each in a process of its own; the same runs without a study first."""
    print(
        "| runs | processes | wall [s] | wall per run [ms] | CPU per run [ms] | speed-up | driver [MB] | worker [MB]"
        " | table [kB] |\n|---|---|---|---|---|---|---|---|---|"
    )
    for runs in sizes:
        alone = 0.0
        for jobs in (0, 1, 2):
            code = f"import run; run.one({runs}, {jobs}, {alone})"
            done = subprocess.run([sys.executable, "-c", code], cwd=HERE, check=True, stdout=subprocess.PIPE, text=True)
            print(done.stdout, end="", flush=True)
            if jobs == 1:
                alone = float(done.stdout.split("|")[3])


def most(pid: int | str = "self") -> float:
    """The most memory [MB] that a process had: not ru_maxrss, which a child takes over from the one that started it."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:  # it has ended
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def one(runs: int, jobs: int, alone: float) -> None:
    """A line of the scaling table. jobs 0: the runs without a study; alone: wall time [s] in one process."""
    straight(), drive(2.5)
    bare(1)
    with tempfile.TemporaryDirectory() as folder:
        place, workers, looked, size = Path(folder), 0.0, 0.0, "-"
        profile.profile_of(straight(), drive(2.5)).to_csv(place / "drive.csv", index=False)
        (place / "study.toml").write_text(STUDY.format(runs=runs))

        def look(*_: object) -> None:
            nonlocal workers, looked
            if time.perf_counter() - looked > 0.2:
                children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
                workers, looked = max([workers, *map(most, children)]), time.perf_counter()

        begin, spent = time.perf_counter(), cpu()
        if jobs:
            study_runner.run_study(study_plan.read_study(place / "study.toml"), place / "out", jobs=jobs, progress=look)
            size = f"{(place / 'out' / 'runs.parquet').stat().st_size / 1e3:.0f}"
        else:
            bare(runs)
        wall, busy = time.perf_counter() - begin, cpu() - spent
    faster = f"{alone / wall:.2f}" if jobs > 1 else "-"
    print(
        f"| {runs} | {jobs or 'no study'} | {wall:.2f} | {1e3 * wall / runs:.2f} | {1e3 * busy / runs:.2f} | {faster}"
        f" | {most():.0f} | {f'{workers:.0f}' if workers else '-'} | {size} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="parts whose name has this in it")
    parser.add_argument("--profile", action="store_true", help="where the time goes")
    parser.add_argument("--check", type=float, metavar="FACTOR", help="fail above so many times the median kept")
    parser.add_argument("--dry", action="store_true", help="keep nothing")
    parser.add_argument("--scaling", type=int, nargs="*", metavar="RUNS", help="sizes of studies [10 100 1000 10000]")
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
    worse = compared(rows, asked.check)
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
