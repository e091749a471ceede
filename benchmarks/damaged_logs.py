"""Damage clean simulated logs at random and count estimates that are called valid though their intervals do not hold.

    python benchmarks/damaged_logs.py --clean 20 --damaged 60           all machines, their recommended methods
    python benchmarks/damaged_logs.py --only rig --method joint --jobs 2 --out found.jsonl

A valid estimate with a true value beyond 4 total standard deviations is wrong. Of clean logs, at least 97 % must be
valid, with 93 to 97 % of the true values inside the intervals by noise (a simulated log has no error of the machine
file, so that the total intervals hold it more often).
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import sys
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from joblib import Parallel, delayed

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.damaged_logs import MACHINES, one_log, summary


def main() -> None:
    """Run the bench."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clean", type=int, default=10, help="clean logs of each machine")
    parser.add_argument("--damaged", type=int, default=20, help="damaged logs of each machine")
    parser.add_argument("--only", choices=MACHINES, action="append")
    parser.add_argument("--method")
    parser.add_argument("--seed", type=int, default=0, help="of the first log")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="write a line of JSON for each log")
    given = parser.parse_args()
    todo = [
        (name, given.method, given.seed + k, clean)
        for name in given.only or MACHINES
        for count, clean in ((given.clean, True), (given.damaged, False))
        for k in range(count)
    ]
    rows = Parallel(n_jobs=given.jobs)(delayed(one_log)(*x) for x in todo)
    if given.out:
        given.out.write_text("".join(json.dumps(r) + "\n" for r in rows), encoding="utf-8")
    sys.stdout.write("\n".join(summary(rows)) + "\n")


if __name__ == "__main__":
    main()
