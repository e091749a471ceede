"""Identify a roller on which two to six moderate effects act at once, and count intervals that hold.

    python benchmarks/several_at_once.py --worlds 10                  va12, two logs of a minute each
    python benchmarks/several_at_once.py --machine va12_straight --worlds 20
    python benchmarks/several_at_once.py --diagnose                   names of the effects, and parameters after mending

Wanted: at least 85 % of the true values inside their 95 % intervals, none beyond 6 deviations, M within 5 %. By the
diagnosis: at least half of the effects named, none wrongly, M within 2 %, 90 % inside.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import os
import sys
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np
from joblib import Parallel, delayed

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from support.several import DRIVES, draw, drives_of, judge, judge_names, names_of


def main() -> None:
    """Run the bench."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machine", choices=DRIVES, default="va12")
    parser.add_argument("--worlds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0, help="of the first world")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--diagnose", action="store_true", help="diagnose instead of identifying, on all cores")
    given = parser.parse_args()
    drives, names = drives_of(given.machine), names_of(given.machine)
    seeds = range(given.seed, given.seed + given.worlds)
    if given.diagnose:
        for seed in seeds:
            _show_names(given.machine, drives, draw(seed, names), seed)
        return
    found = Parallel(n_jobs=given.jobs)(delayed(judge)(given.machine, drives, draw(s, names), s) for s in seeds)
    for seed, one in zip(seeds, found, strict=True):
        z = one.z_total[np.isfinite(one.z_total)]
        sys.stdout.write(
            f"{seed}: {one.status}, M {one.mass_error_percent:+.2f} %, inside {np.mean(np.abs(z) < 1.96):.0%}, largest"
            f" {np.abs(z).max():.1f}; {', '.join(one.effects)}\n"
        )
    for what, z in (("noise and discrepancy", [o.z for o in found]), ("total", [o.z_total for o in found])):
        every = np.concatenate(z)
        every = every[np.isfinite(every)]
        sys.stdout.write(
            f"{what}: {np.mean(np.abs(every) < 1.96):.1%} of {len(every)} inside, rms {np.sqrt(np.mean(every**2)):.2f}"
            f" deviations, {np.sum(np.abs(every) > 6)} beyond 6\n"
        )
    mass = np.abs([o.mass_error_percent for o in found])
    sys.stdout.write(f"M: {np.max(mass):.2f} % off at most, within 5 % in {np.mean(mass < 5):.0%}\n")


def _show_names(machine: str, drives: list[str], effects: tuple[str, ...], seed: int) -> None:
    """Diagnose one world and say what was named."""
    one = judge_names(machine, drives, effects, seed)
    z = one.z[np.isfinite(one.z)]
    elsewhere, wrong = (", ".join(x) or "none" for x in (one.elsewhere, one.wrong))
    sys.stdout.write(
        f"{seed}: {one.verdict}, {len(one.right)} of {len(effects)} named, elsewhere {elsewhere}, wrong {wrong}; M"
        f" {one.mass_error_percent:+.2f} %, inside {np.mean(np.abs(z) < 1.96):.0%}, largest {np.abs(z).max():.1f};"
        f" {one.wall_s:.0f} s; {', '.join(effects)}\n"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
