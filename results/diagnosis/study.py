"""Diagnose blind logs of a second roller that shares no code with the program, and score the answers.

python results/diagnosis/study.py [--per-cause 6] [--nothing 200] [--per-surprise 2] [--pairs 12] [--jobs 2]
[--out FOLDER] writes summary.json, cases.csv, confusion.png and README.md from held-out cases. `--seen` runs the
cases that the diagnosis was developed on instead. Each case is stored in results/.diagnosis/ when done, so an
interrupted study resumes; cases of other versions of the program are not reused. `--jobs 0` reports the stored cases.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
KEPT = ROOT / "results" / ".diagnosis"
sys.path.insert(0, str(ROOT / "tests"))

import joblib
import numpy as np
import pandas as pd
import scipy.stats
from matplotlib.figure import Figure
from support import studies
from support.blind import Case, ask, blind, case, score
from support.causes import CAUSES
from support.rounds import file_hash, program_version, store
from support.surprises import SURPRISES
from support.visibility import VISIBLE, visibility

from excite.output import new_file
from excite.reports import COLOURS, legend_below

Row = dict[str, Any]
# First case number of each kind that is held out; lower ones were used in development.
FRESH = {
    "nothing": 3030,
    "cause": 41,
    "surprise": 20,
    "pair": 106,
}
GOOD = ("right", "tied")  # a tie that holds the cause counts as right
SAID = {  # outcomes in the figure, with what they are called there
    "right": "right (surprises: unexplained)",
    "place": "right effect, wrong place",
    "another name": "another name",
    "unexplained": "unexplained",
    "clean": "clean",
}
ROLLER = [
    ROOT / "tests" / "support" / n for n in ("plant.py", "causes.py", "surprises.py", "blind.py", "visibility.py")
]


def cases(wanted: Mapping[str, int], first: Mapping[str, int]) -> list[Case]:
    """List the wanted number of cases of each kind (causes and surprises: of each name), from number `first` on.

    Kinds and names alternate, so an interrupted study has cases of each.
    """
    names = {"nothing": [""], "cause": list(CAUSES), "surprise": list(SURPRISES), "pair": [""]}
    every = [
        (k / count, case(kind, name, first[kind] + k))
        for kind, count in wanted.items()
        for name in names[kind]
        for k in range(count)
    ]
    return [c for _, c in sorted(every, key=lambda both: both[0])]


def simulate_case(one: Case) -> tuple[pd.DataFrame, float]:
    """Simulate the log of a case and its visibility (chi-squared), or read the stored ones."""
    kept = KEPT / f"driven-{file_hash(ROLLER)}"
    kept.mkdir(parents=True, exist_ok=True)
    log, file = kept / f"{one.key}.parquet", kept / f"{one.key}.json"
    if not file.exists():
        drive = blind(one)
        with new_file(log) as part:
            drive.log.to_parquet(part)
        store(file, {"visibility": visibility(drive)})  # written last: a log without it is simulated again
    return pd.read_parquet(log), float(json.loads(file.read_text())["visibility"])


def run_case(one: Case, kept: Path) -> None:
    """Simulate, diagnose and score a case, and store the row."""
    file = kept / f"{one.key}.json"
    if file.exists():
        return
    log, seen = simulate_case(one)
    row: Row = {
        "key": one.key,
        "program": kept.name,
        "kind": one.kind,
        "hidden": [h.label for h in one.hidden],
        "amount": [h.amount for h in one.hidden],
        "manoeuvre": one.manoeuvre,
        "duration_s": one.duration,
        "kit": one.kit,
        "visibility": seen,
    }
    begin = time.perf_counter()
    try:
        said = ask(log)
        row |= {"error": None, "verdict": said["verdict"], "findings": said["findings"], **asdict(score(one, said))}
        kept_too = ("error_before_percent", "error_after_percent", "share_explained", "nearest", "located")
        row |= {k: said[k] for k in kept_too}
    except RuntimeError as err:
        row |= {"error": str(err), "verdict": None, "findings": [], "outcome": "failed", "named": "failed"}
    row["wall_s"] = time.perf_counter() - begin
    store(file, row)


# ------------------------------------------------------------------------------------------------------ figures
def rate(rows: Sequence[Row], is_so: Callable[[Row], bool]) -> dict[str, Any]:
    """Count rows that meet a condition: rate with 95 % Wilson interval."""
    k, n = sum(map(is_so, rows)), len(rows)
    if n == 0:
        return {"count": 0, "of": 0, "rate": None, "ci95": None}
    interval = scipy.stats.binomtest(k, n).proportion_ci(method="wilson")
    return {"count": k, "of": n, "rate": k / n, "ci95": [float(interval.low), float(interval.high)]}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Compute all rates, and the outcomes by cause."""
    of = {kind: [r for r in rows if r["kind"] == kind] for kind in ("nothing", "cause", "surprise", "pair")}
    seen = [r for r in of["cause"] if r["visibility"] >= VISIBLE]
    unseen = [r for r in of["cause"] if r["visibility"] < VISIBLE]
    strange = [r for r in of["surprise"] if r["visibility"] >= VISIBLE]
    named = [r for r in of["cause"] if r.get("amount_in") is not None]

    def outcome_rates(group: Sequence[Row]) -> dict[str, Any]:
        return {
            "named_or_tied": rate(group, lambda r: r["outcome"] in GOOD),
            "named_alone": rate(group, lambda r: r["outcome"] == "right"),
            "wrong": rate(group, lambda r: r["outcome"] in ("wrong", "place")),
            "with_wrong_ones_besides": rate(group, lambda r: r["outcome"] == "more"),
            "unexplained": rate(group, lambda r: r["outcome"] == "unexplained"),
            "nothing_found": rate(group, lambda r: r["outcome"] == "clean"),
            "failed": rate(group, lambda r: r["outcome"] == "failed"),
        }

    walls = [r["wall_s"] for r in rows]
    return {
        "study": "diagnosis",
        "program": dict(Counter(r["program"] for r in rows)),
        "cases": len(rows),
        "visible_chi2": VISIBLE,
        "false_alarms": rate(of["nothing"], lambda r: r["outcome"] != "clean"),
        "visible_causes": outcome_rates(seen),
        "hardly_visible_causes": outcome_rates(unseen),
        "by_kit": {k: outcome_rates([r for r in seen if r["kit"] == k]) for k in ("full", "paper")},
        "by_manoeuvre": {
            m: outcome_rates([r for r in seen if r["manoeuvre"] == m]) for m in sorted({r["manoeuvre"] for r in rows})
        },
        "visible_surprises_unexplained": rate(strange, lambda r: r["outcome"] == "unexplained"),
        "visible_surprises_named": rate(strange, lambda r: r["outcome"] == "wrong"),
        "pairs": {o: rate(of["pair"], lambda r, o=o: r["outcome"] == o) for o in ("right", "part", "more", "wrong")},
        "amount_within_interval": rate(named, lambda r: bool(r["amount_in"])),
        "amount_error_median": float(np.median([abs(r["amount_error"]) for r in named])) if named else None,
        "gain_positive": rate(named, lambda r: (r["gain"] or 0) > 0),
        "gain_surely_positive": rate(named, lambda r: bool(r["gain_sure"])),
        "wall_s": {"median": float(np.median(walls)), "p95": float(np.quantile(walls, 0.95)), "max": max(walls)},
        "causes": {
            name: Counter(r["outcome"] for r in seen if r["hidden"][0].startswith(f"{name}@")) for name in CAUSES
        },
        "surprises": {name: Counter(r["named"] for r in strange if r["hidden"] == [name]) for name in SURPRISES},
    }


def confusion(rows: Sequence[Row]) -> Figure:
    """Plot what is said of each hidden effect of the visible cases, with the other names that are given.

    A tie that holds the true effect counts as right; a surprise, which has no name, is right as unexplained.
    """
    said: dict[str, list[tuple[str, str]]] = {name: [] for name in ("nothing", *CAUSES, *SURPRISES)}
    for r in rows:
        if r["kind"] == "pair" or (r["kind"] != "nothing" and r["visibility"] < VISIBLE):
            continue
        hidden = r["hidden"][0].split("@")[0] if r["hidden"] else "nothing"
        good = {"nothing": ("clean",), "cause": GOOD, "surprise": ("unexplained",)}[r["kind"]]
        outcome = "right" if r["outcome"] in good else r["outcome"] if r["outcome"] in SAID else "another name"
        said[hidden].append((outcome, r["named"].split("@")[0] if outcome == "another name" else ""))
    hidden_effects = [name for name, own in said.items() if own]
    figure = Figure(figsize=(11, 6.6), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True)
    for ax, part in zip(axes, np.array_split(hidden_effects, 2), strict=True):
        places, left = np.arange(len(part))[::-1], np.zeros(len(part))
        for k, (kind, word) in enumerate(SAID.items()):
            share = np.array([100 * np.mean([one[0] == kind for one in said[n]]) for n in part])
            style = {"color": COLOURS[k], "hatch": ("", "//", "..", "xx", "--")[k], "edgecolor": "white"}
            ax.barh(places, share, left=left, height=0.7, label=word, **style)
            left += share
        for y, name in zip(places, part, strict=True):
            others = "".join(f", {n}" for n in sorted({n for _, n in said[name] if n}))
            ax.annotate(f"{len(said[name])}{others}", (102, y), va="center", fontsize=8)
        ax.set_yticks(places, [name.replace("_", " ") for name in part], fontsize=8)
        ax.set(xlim=(0, 118), ylim=(-0.7, len(part) - 0.3), xticks=(0, 25, 50, 75, 100))
        ax.set_xlabel("said of the effect [% of its cases]; their number")
        ax.tick_params(labelsize=8)
    legend_below(figure, *axes[0].get_legend_handles_labels())
    return figure


def readme(s: dict[str, Any], planned: int, options: Sequence[str]) -> str:
    """Write the README from the summary, the number of planned cases and the options."""

    def line(what: str, r: dict[str, Any], aim: str = "") -> str:
        if not r["of"]:
            return f"| {what} | - | 0 | | {aim} |"
        low, high = (100 * x for x in r["ci95"])
        return f"| {what} | {100 * r['rate']:.1f} % | {r['count']} of {r['of']} | {low:.1f} to {high:.1f} % | {aim} |"

    v = s["visible_causes"]
    rows = [
        line("false alarms: nothing hidden, something found", s["false_alarms"], "at most 5 %"),
        line("visible cause named, alone or in a tie", v["named_or_tied"], "at least 90 %"),
        line("- named alone", v["named_alone"]),
        line("visible cause: wrong name or place", v["wrong"], "at most 2 %"),
        line("visible cause: right name plus wrong ones", v["with_wrong_ones_besides"]),
        line("visible cause: unexplained", v["unexplained"]),
        line("visible cause: nothing found", v["nothing_found"]),
        line("visible surprise: left unexplained", s["visible_surprises_unexplained"]),
        line("visible surprise: given a name", s["visible_surprises_named"]),
        line("two causes: both named, no other", s["pairs"]["right"]),
        line("two causes: one named, none wrong", s["pairs"]["part"]),
        line("named causes: true magnitude in the 95 % interval", s["amount_within_interval"], "95 %"),
        line("named causes: positive gain on held-out data", s["gain_positive"]),
        line("- 95 % interval of the gain above zero", s["gain_surely_positive"]),
    ]
    table = "\n".join(rows)
    causes = "\n".join(
        f"| {name} | {sum(c.values())} | {', '.join(f'{k} {n}' for k, n in sorted(c.items())) or '-'} |"
        for name, c in s["causes"].items()
    )
    surprises = "\n".join(
        f"| {name} | {sum(c.values())} | {', '.join(f'{k} {n}' for k, n in sorted(c.items())) or '-'} |"
        for name, c in s["surprises"].items()
    )
    walls = s["wall_s"]
    part = f" These are {s['cases']} of {planned} planned cases." if s["cases"] < planned else ""
    command = " ".join(["python results/diagnosis/study.py", *options])
    programs = " and ".join(f"{name} ({count} cases)" for name, count in s["program"].items())
    programs += ", merged" if len(s["program"]) > 1 else ""
    named, alarms = s["visible_causes"]["named_or_tied"], s["false_alarms"]
    return f"""# Blind test of the diagnosis

**Result.** {named["count"]} of {named["of"]} visible causes were named, alone or in a tie that holds the true one.
{alarms["count"]} of {alarms["of"]} clean logs gave a false alarm.

`{command}`
rebuilds this page; program version {programs}, see `version` in study.py. All rates are in
[summary.json](summary.json), all cases in [cases.csv](cases.csv).{part}

- **Held-out cases.** The diagnosis was developed on lower case numbers (`--seen` runs those). Each round uses new ones.
- **Second roller** (`tests/support/plant.py`). It shares no code with the program: Lagrange's equations in ground
  coordinates by automatic differentiation, Runge-Kutta steps of 0.5 ms, a driver model with delay, slow hand and
  hydraulics, encoder counts and noise.
- **Variation.** Bodies, soil and friction differ by up to 20 % from the nominal machine; five manoeuvres of 60 or
  120 s; kits `full` and `paper`.
- **Causes** (`tests/support/causes.py`) follow their physics, not the catalogue's formulas: two masses with a dead zone
  for backlash, shear integrated over the patch, an oil volume behind a valve, passes counted on another map of the
  lane.
- **Surprises** (`tests/support/surprises.py`) are in no catalogue. The right answer is `unexplained`.
- **Visible**: a fit of the roller without the cause (27 parameters and true torques) leaves a chi-squared of at least
  {s["visible_chi2"]:g} in the noise-free signals, in units of sensor noise (`tests/support/visibility.py`, a
  linearised Kalman filter of the second roller). A visible cause may still be indistinguishable from others.

| {s["cases"]} cases | rate | count | 95 % interval | target |
|---|---|---|---|---|
{table}

Time of a diagnosis, start of the program included, two cases in parallel: {walls["median"]:.1f} s (median),
{walls["p95"]:.1f} s (95 %), {walls["max"]:.1f} s (longest).

![hidden against named](confusion.png)

| hidden cause | visible cases | outcomes |
|---|---|---|
{causes}

| surprise | visible cases | verdict |
|---|---|---|
{surprises}
"""


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--per-cause", type=int, default=6)
    parser.add_argument("--nothing", type=int, default=200)
    parser.add_argument("--per-surprise", type=int, default=2)
    parser.add_argument("--pairs", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument(
        "--seen", action="store_true", help="run the cases that the diagnosis was developed on (from number 0)"
    )
    parser.add_argument("--drive", action="store_true", help="simulate the logs only")
    parser.add_argument("--only", default="", help="run cases whose key begins with this, and print them")
    given = studies.parse(parser, __file__, argv)
    kept = KEPT / program_version(ROLLER)
    kept.mkdir(parents=True, exist_ok=True)
    many = {"nothing": given.nothing, "cause": given.per_cause, "surprise": given.per_surprise, "pair": given.pairs}
    every = cases(many, dict.fromkeys(FRESH, 0) if given.seen else FRESH)
    wanted = [c for c in every if c.key.startswith(given.only)]
    if given.drive:
        joblib.Parallel(n_jobs=given.jobs or 1, verbose=5)(joblib.delayed(simulate_case)(c) for c in wanted)
        return
    if given.jobs:
        joblib.Parallel(n_jobs=given.jobs, verbose=5)(joblib.delayed(run_case)(c, kept) for c in wanted)
    files = [kept / f"{c.key}.json" for c in wanted]
    rows = [{"program": kept.name} | json.loads(file.read_text()) for file in files if file.is_file()]
    if given.only:
        shown = ("key", "visibility", "amount", "manoeuvre", "duration_s", "kit", "outcome", "named", "error", "wall_s")
        print(pd.DataFrame(rows).reindex(columns=shown).to_string(index=False))
        return
    s = studies.origin(__file__, 0) | summary(rows)
    flat = pd.DataFrame(rows).drop(columns=["findings", "located"], errors="ignore")
    for column in ("hidden", "amount"):
        flat[column] = [" ".join(map(str, values)) for values in flat[column]]
    flat.to_csv(given.out / "cases.csv", index=False, float_format="%.6g")
    confusion(rows).savefig(given.out / "confusion.png", dpi=110, metadata={"Software": None})
    (given.out / "summary.json").write_text(json.dumps(s, indent=1) + "\n")
    names = ("nothing", "per_cause", "per_surprise", "pairs")
    options = [*(f"--{name.replace('_', '-')} {getattr(given, name)}" for name in names), f"--out {given.out}"]
    (given.out / "README.md").write_text(readme(s, len(wanted), [*options, *(["--seen"] if given.seen else [])]))


if __name__ == "__main__":
    main()
