"""Take rigs and robots with public logs through a test day: a drive designed, verified, and what their logs say.

python results/machines/measured.py [NAME...] writes a folder for each machine beside this file: design.json,
verify.json, verify.png, identify.json and README.md. Each step is the command that the page names. Files that exist are
kept: to make a machine anew, delete its folder. The logs are in ../shared/data and are not part of the project; where
they are missing, nothing is identified.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from excite import output
from excite.model.machine import machine
from excite.text import format_number, format_percent, format_uncertain
from excite.workflows import requests

HERE = Path(__file__).parent
DATA = HERE.parents[1] / ".." / "shared" / "data"
BUDGET_S = 60  # for a design
RUNS = 30  # simulated test days


@dataclass(frozen=True)
class Machine:
    """A machine's logs, and what is known of it from elsewhere.

    validated: logs that are predicted, not fitted. method: of identification, the recommended one if not given.
    """

    logs: tuple[str, ...]
    remark: str
    validated: tuple[str, ...] = ()
    method: str | None = None


MACHINES = {
    "emps": Machine(
        ("emps/DATA_EMPS.mat",),
        "Its authors publish M 95.11, Fv 203.5, Fs 20.39 and an offset of -3.165, with a relative error of 4.08 %;"
        " [emps](../../emps) has more. No limits of the drive are published, so nothing is designed.",
    ),
    "panda": Machine(
        ("franka_panda/exciting_trajectory_1.csv",),
        "Its authors publish 43 inertial base parameters and half the height of a sigmoid as friction by joint: 0.273,"
        " 0.436, 0.320, 0.640, 0.420, 0.152, 0.282 N m.",
        method="inverse+consistent",
    ),
    "pendulum": Machine(
        ("dfki_pendulum/data_measured.csv",),
        "Its authors describe 0.147 kg m2. The torque in their log comes from the motor's current behind a gear, and"
        " half of it is not explained by a pendulum.",
    ),
    "rack": Machine(
        ("rack_and_pinion/force_2kHz.csv", "rack_and_pinion/speed_1500Hz.csv"),
        "Two loggers with a clock each. Its author publishes M 25.3 kg. No limits of the drive are published, so"
        " nothing is designed.",
    ),
    "ur10": Machine(
        (), "No log of one is public; [duel](../../duel) compares its design with those of other programs."
    ),
    "ur10e": Machine(
        ("ur10e/20_02_19_14harm50sec.csv",),
        "Motor currents. An independent fit without rotor inertia errs on another log by 10.2, 3.8, 3.5, 9.2, 25.0 and"
        " 51.2 % by joint.",
        ("ur10e/20_02_19_15harm50sec.csv",),
        "inverse+consistent",
    ),
}


def excite(*words: object) -> dict[str, Any]:
    """Run a command and return its summary."""
    command = [sys.executable, "-m", "excite", *map(str, words), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with exit code {done.returncode}")
    return json.loads(done.stdout)


def make(name: str, place: Path, work: Path) -> dict[str, dict[str, Any]]:
    """Run what has not been run, and return the summaries by step; a step that can't be run has none."""
    one, steps = MACHINES[name], {}

    def step(kind: str, *words: object) -> None:
        path = place / f"{kind}.json"
        if not path.is_file():
            summary = excite(kind, *words, "--out", work / kind)
            if kind == "identify":
                summary["logs"] = [*one.logs, *one.validated]
            for validation, log in zip(summary.get("validation") or [], one.validated, strict=False):
                validation["log"] = log
            said = {k: v for k, v in summary.items() if k not in ("notes", "design")}
            with output.new_file(path) as fresh:
                fresh.write_text(output.to_json(said), encoding="utf-8")
            print(f"{name}: {kind}", flush=True)

    described = machine.load_machine(name)
    if described.problems or requests.arm_problems(described):
        if not (place / "verify.json").is_file():
            (place / "design.json").unlink(missing_ok=True)
        step("design", name, "--budget", BUDGET_S)
        step("verify", work / "design", "--runs", RUNS)
        if (work / "verify" / "verify.png").is_file():
            shutil.copy(work / "verify" / "verify.png", place / "verify.png")
    if one.logs and all((DATA / log).is_file() for log in one.logs + one.validated):
        validate = [word for log in one.validated for word in ("--validate", DATA / log)]
        method = ["--method", one.method] if one.method else []
        step("identify", name, *(DATA / log for log in one.logs), *validate, *method)
    for kind in ("design", "verify", "identify"):
        path = place / f"{kind}.json"
        if path.is_file():
            steps[kind] = json.loads(path.read_text(encoding="utf-8"))
    return steps


def page(name: str, steps: dict[str, dict[str, Any]]) -> str:
    lines = [
        f"# {machine.load_machine(name).title}",
        "",
        f"`model/machines/{name}.toml`. {MACHINES[name].remark}",
        "",
        f"Rebuilt by `python results/machines/measured.py {name}`, after this folder is deleted.",
        "",
        *design_lines(name, steps),
        *identify_lines(name, steps),
    ]
    filled = [textwrap.fill(x, 120, subsequent_indent="  " if x[:2] == "- " else "") for x in lines]
    if "identify" in steps:
        filled += ["", *parameter_rows(steps["identify"])]
    if "verify" in steps:
        filled += ["", "![Errors of the simulated test days beside the predicted intervals](verify.png)"]
    return "\n".join(filled) + "\n"


def design_lines(name: str, steps: dict[str, dict[str, Any]]) -> list[str]:
    if "design" not in steps:
        return []
    d, v = steps["design"], steps["verify"]
    error = np.median([r["rms_percent"] for r in v["parameters"].values()])
    held = 100 * np.mean([r["coverage95"] for r in v["parameters"].values()])
    cut = "" if d["complete"] else ", stopped by its budget"
    return [
        f"- **Drive**: `excite design {name} --budget {BUDGET_S}`, {format_number(d['duration_s'])} s long: cond(Phi)"
        f" {format_number(d['cond_phi'], 3)} from {format_number(d['cond_phi_start'], 3)} at the start{cut}; limits"
        f" exceeded by at most {100 * d['max_violation']:.2f} % of their range. Attainable standard deviation:"
        f" {format_percent(d['median_percent'])} in the median, {format_percent(d['worst_percent'])} for"
        f" {d['worst_parameter']}.",
        f"- **Verification**: {v['runs']} simulated test days, method `{v['method']}`, {v['failed']} failed: errors of"
        f" {format_percent(error)} in the median; the 95 % intervals hold the truth in {held:.0f} % of cases.",
    ]


def identify_lines(name: str, steps: dict[str, dict[str, Any]]) -> list[str]:
    if "identify" not in steps:
        return []
    s = steps["identify"]
    one = MACHINES[name]
    asked = [*one.logs, *(f"--validate {log}" for log in one.validated)]
    asked += [f"--method {one.method}"] if one.method else []
    by_joint = ", ".join(f"{format_percent(e['percent'], 3)} ({joint})" for joint, e in s["error_by_joint"].items())
    lines = [
        f"- **Its log**: `excite identify {name} {' '.join(asked)}`: status `{s['status']}`"
        + (f" ({s['doubt']})" if s["doubt"] else "")
        + f". What the prediction misses: {by_joint} of the torque measured."
    ]
    for v in s["validation"]:
        missed = ", ".join(f"{format_percent(e, 3)} ({u})" for u, e in v["torque_error_percent"].items())
        lines.append(f"- **On {v['log']}, which was not fitted**: {missed}.")
    impossible = [n for n, p in s["parameters"].items() if not p["possible"]]
    lines.append(f"- Values that no machine has: {', '.join(impossible) if impossible else 'none'}.")
    return lines


def parameter_rows(s: dict[str, Any]) -> list[str]:
    rows = ["| parameter | what it is | estimate +- standard deviation |", "|---|---|---|"]
    for n, p in s["parameters"].items():
        value = format_uncertain(p["value"], p["std"], p["unit"])
        rows.append(f"| {n} | {s['meanings'].get(n, '')} | {value} |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="*", choices=[*MACHINES, []], help="machines; all if none is given")
    parser.add_argument("--out", type=Path, default=HERE, metavar="FOLDER", help="where the folders go")
    args = parser.parse_args()
    for name in args.name or MACHINES:
        place = args.out / name
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as work:
            steps = make(name, place, Path(work))
        (place / "README.md").write_text(page(name, steps), encoding="utf-8")
        print(f"{name}: written", flush=True)


if __name__ == "__main__":
    main()
