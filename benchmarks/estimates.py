"""Identify many logs, real and simulated, by the default method, and tell how each search for the estimate ended.

    python benchmarks/estimates.py                     every log that is there (shared cases and data beside the tree)
    python benchmarks/estimates.py --only emps --jobs 2

Of each log: status of the estimate, and of each fit within it how it ended, its passes, and those in which an accepted
merit rose, which must be none.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from joblib import Parallel, delayed

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from support.damaged_logs import one_table
from support.several import DRIVES, draw, drives_of, names_of, simulated

import excite
from excite.errors import ExciteError
from excite.logs.log import table_of
from excite.model import Model, build
from excite.model.machine import Machine
from excite.smoothing import inverse_fit, solver
from excite.workflows import machine_from_urdf

SHARED = ROOT.parent / "shared"
CASES, DATA = SHARED / "cases", SHARED / "data"
ROUNDING = 1e-10  # of a merit
Source = Callable[[], tuple[Any, Any]]  # machine and logs


def _double_pendulum(folder: Path) -> Model:
    """Return the model of the robot's description with the columns of its logs."""
    machine, _ = machine_from_urdf(folder / "acrobot.urdf", "double_pendulum")
    for sensor in machine["sensor"]:
        sensor["column"] = f"{'pos' if sensor['kind'] == 'angle' else 'tau'}_meas{sensor['body']}"
    machine |= {"sampling_hz": {"value": 500.0, "source": "definition"}, "time_column": "time"}
    return build(Machine.model_validate(machine))


def real_logs() -> dict[str, Source]:
    """Logs of real machines, and cases made after such."""
    found: dict[str, Source] = {}

    def add(name: str, machine: str | Path, *logs: str) -> None:
        paths = [DATA / log for log in logs]
        if all(p.is_file() for p in paths):
            found[name] = lambda: (machine, paths)

    add("emps", "emps", "emps/DATA_EMPS.mat")
    add("rack", "rack", "rack_and_pinion/force_2kHz.csv", "rack_and_pinion/speed_1500Hz.csv")
    add("pendulum", "pendulum", "dfki_pendulum/data_measured.csv")
    add("panda", "panda", "franka_panda/exciting_trajectory_1.csv")
    add("light_ev", ROOT / "docs" / "examples" / "light_ev.toml", "light_ev/drive.csv")
    for log in ("20_02_12-50sec_12harm", "20_02_19_14harm50sec", "20_02_19_15harm50sec"):
        add(f"ur10e {log[6:8]}.{log[3:5]} {log[9:16]}", "ur10e", f"ur10e/{log}.csv")
    for log in (143339, 143601, 143747):
        path = DATA / "double_pendulum" / f"{log}.csv"
        if path.is_file():
            found[f"double pendulum {log}"] = lambda path=path: (_double_pendulum(path.parent), [path])
    if "emps" in found:
        for half in (0, 1):
            found[f"emps, half {half + 1}"] = lambda half=half: ("emps", [_half_of_emps(half)])
    for case, machine, logs in (
        ("G01_valid_over_misfit", "rig.toml", ("rig.csv", "abs_0.3.csv", "shift_-0.05.csv")),
        ("G03_clean_but_biased", "rig.toml", ("rig.csv",)),
        ("G03_clean_but_biased", "two_joints.toml", ("two4.csv",)),
        ("G04_moving_at_edges", "pend_drop.toml", ("pend_moving_edges.csv",)),
        ("G06_plateaus", "rig.toml", ("cv_plateaus.csv",)),
        ("G17_late_torque", "va12_straight", ("both_30ms.csv.gz", "front_30ms.csv.gz")),
        ("D1_sticking_rig", "emps", ("d_clean_100.mat", "d_strib_102.mat")),
        ("C1_speed_only_rig", "rpm.toml", ("rpm.csv",)),
    ):
        folder = CASES / case
        for log in logs:
            if (folder / log).is_file():
                own = folder / machine if machine.endswith(".toml") else machine
                found[f"{case[:3].strip('_')} {log}"] = lambda own=own, path=folder / log: (own, [path])
    return found


def _half_of_emps(half: int) -> Any:
    table = table_of(DATA / "emps" / "DATA_EMPS.mat", excite.load("emps").machine)
    count = len(table) // 2
    return table.iloc[half * count : (half + 1) * count].reset_index(drop=True)


def simulated_logs() -> dict[str, Source]:
    """Clean logs of rollers, worlds with several effects, and damaged logs of rigs."""
    found: dict[str, Source] = {}
    for machine, drives in DRIVES.items():
        for name, drive in zip(drives, drives_of(machine), strict=True):
            found[f"{machine} {name}, clean"] = lambda m=machine, d=drive: (m, simulated(m, [d], (), 1))
    for machine, seeds in (("va12_straight", range(4)), ("va12", range(2))):
        for seed in seeds:
            found[f"{machine}, several effects {seed}"] = lambda m=machine, s=seed: (
                m,
                simulated(m, drives_of(m), draw(s, names_of(m)), s),
            )
    for machine in ("rig", "two_joints"):
        for seed in range(5):
            found[f"{machine}, damaged {seed}"] = lambda m=machine, s=seed: _damaged_log(m, s)
    return found


def _damaged_log(name: str, seed: int) -> tuple[Any, Any]:
    model, table, _ = one_table(name, seed, clean=False)
    return model, [table]


def identify(name: str, source: Source) -> dict[str, Any]:
    """Identify one log by the default method; return how the fits within ended."""
    ends, rises, passes = Counter[str](), 0, 0
    minimise, conclude = solver.minimise, inverse_fit.conclude

    def count(status: str, history: Sequence[tuple[float, float]]) -> None:
        nonlocal rises, passes
        ends[status] += 1
        passes += len(history)
        rises += sum(after - before > ROUNDING * abs(before) for before, after in history)

    def watched(*given: Any) -> Any:
        found = minimise(*given)
        count(found.status, found.history)
        return found

    def concluded(state: Any, held: Any, status: str, costs: Any, step: float) -> Any:
        count(status, costs)
        return conclude(state, held, status, costs, step)

    machine, logs = source()
    begin, cpu = time.monotonic(), time.process_time()
    solver.minimise, inverse_fit.conclude = watched, concluded
    try:
        found = excite.identify(machine, logs)
        said = {"method": found.method, "status": found.status, "doubt": found.doubt}
    except ExciteError as err:
        said = {"method": "", "status": "refused", "doubt": str(err)}
    finally:
        solver.minimise, inverse_fit.conclude = minimise, conclude
    spent = {"s": time.monotonic() - begin, "cpu_s": time.process_time() - cpu}
    return {"log": name, **said, "ends": dict(ends), "passes": passes, "rises": rises, **spent}


def main() -> None:
    """Run the bench."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="logs with this in their names")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="write a line of JSON for each log")
    given = parser.parse_args()
    sources = {n: s for n, s in {**real_logs(), **simulated_logs()}.items() if given.only in n}
    rows = []
    for row in Parallel(n_jobs=given.jobs, return_as="generator")(delayed(identify)(*x) for x in sources.items()):
        rows.append(row)
        ends = ", ".join(f"{n} {end}" for end, n in row["ends"].items())
        sys.stdout.write(
            f"{row['log']}: {row['method']} {row['status']}, {row['s']:.0f} s ({row['cpu_s']:.0f} s of CPU); fits:"
            f" {ends or 'none'}; {row['passes']} passes, {row['rises']} rising; {row['doubt'][:100]}\n"
        )
        sys.stdout.flush()
    if given.out:
        given.out.write_text("".join(json.dumps(r) + "\n" for r in rows), encoding="utf-8")
    count = sum(row["passes"] for row in rows)
    sys.stdout.write(f"{len(rows)} logs, {count} accepted passes, {sum(row['rises'] for row in rows)} of them rising\n")


if __name__ == "__main__":
    main()
