"""Does the diagnosis name what was hidden? Blind logs of a second roller that shares no code with the program.

python results/diagnosis/study.py [--per-cause 6] [--nothing 200] [--per-surprise 2] [--pairs 12] [--jobs 2]
rebuilds summary.json, cases.csv, confusion.png and README.md beside this file, of cases that nobody had looked at while
the diagnosis was written; `--seen` goes through those instead that it was mended by. Each case is kept in
results/.diagnosis/ as soon as it is done, so an interrupted study goes on where it stopped; cases of other versions of
the program are not used again. `--jobs 0` reports what there is.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import hashlib
import json
import os
import subprocess
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
from support.blind import Case, ask, blind, case, score
from support.causes import CAUSES
from support.surprises import SURPRISES
from support.visibility import VISIBLE, visibility

from excite.output import new_file

Row = dict[str, Any]
FRESH = {"nothing": 3030, "cause": 41, "surprise": 20, "pair": 106}  # numbers below were looked at when mending
GOOD = ("right", "tied")  # a tie that holds the cause sends nobody to repair the wrong thing
LOADED = """import sys, excite.diagnosis.findings, excite.logs.repair
print(*(m.__file__ for n, m in sys.modules.items() if n.partition(".")[0] == "excite" and m.__file__), sep="\\n")"""
ROLLER = [
    ROOT / "tests" / "support" / n for n in ("plant.py", "causes.py", "surprises.py", "blind.py", "visibility.py")
]


def _digits(files: Sequence[Path]) -> str:
    seen = hashlib.sha1()
    for file in dict.fromkeys(files):
        seen.update(file.read_bytes())
    return seen.hexdigest()[:8]


def version() -> str:
    """Eight digits that change when the program, as far as a diagnosis loads it, or the second roller does."""
    done = subprocess.run([sys.executable, "-c", LOADED], cwd=ROOT, capture_output=True, text=True, check=True)
    files = sorted([*map(Path, done.stdout.splitlines()), *(ROOT / "model").rglob("*.toml")])
    return _digits([*files, *ROLLER])


def cases(wanted: Mapping[str, int], first: Mapping[str, int]) -> list[Case]:
    """So many of every kind (causes and surprises: of every name) from the first number on, in an order in which a
    study that is cut short has seen some of everything."""
    names = {"nothing": [""], "cause": list(CAUSES), "surprise": list(SURPRISES), "pair": [""]}
    every = [
        (k / count, case(kind, name, first[kind] + k))
        for kind, count in wanted.items()
        for name in names[kind]
        for k in range(count)
    ]
    return [c for _, c in sorted(every, key=lambda both: both[0])]


def _kept(file: Path, row: Row) -> None:
    with new_file(file) as part:
        part.write_text(json.dumps(row, default=float))


def driven(one: Case) -> tuple[pd.DataFrame, float]:
    """The log of a case and how visible its cause is: kept too, as the program has no part in it."""
    kept = KEPT / f"driven-{_digits(ROLLER)}"
    kept.mkdir(parents=True, exist_ok=True)
    log, file = kept / f"{one.key}.parquet", kept / f"{one.key}.json"
    if not file.exists():
        drive = blind(one)
        with new_file(log) as part:
            drive.log.to_parquet(part)
        _kept(file, {"visibility": visibility(drive)})  # last: a log without it is driven again
    return pd.read_parquet(log), float(json.loads(file.read_text())["visibility"])


def judged(one: Case, kept: Path) -> None:
    """Drives a case, has it diagnosed, judges it and keeps the row."""
    file = kept / f"{one.key}.json"
    if file.exists():
        return
    log, seen = driven(one)
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
    _kept(file, row)


# ------------------------------------------------------------------------------------------------------ figures
def rate(rows: Sequence[Row], is_so: Callable[[Row], bool]) -> dict[str, Any]:
    """How often, with the 95 % interval of Wilson."""
    k, n = sum(map(is_so, rows)), len(rows)
    if n == 0:
        return {"count": 0, "of": 0, "rate": None, "ci95": None}
    interval = scipy.stats.binomtest(k, n).proportion_ci(method="wilson")
    return {"count": k, "of": n, "rate": k / n, "ci95": [float(interval.low), float(interval.high)]}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """All rates, and the table by cause."""
    of = {kind: [r for r in rows if r["kind"] == kind] for kind in ("nothing", "cause", "surprise", "pair")}
    seen = [r for r in of["cause"] if r["visibility"] >= VISIBLE]
    unseen = [r for r in of["cause"] if r["visibility"] < VISIBLE]
    strange = [r for r in of["surprise"] if r["visibility"] >= VISIBLE]
    named = [r for r in of["cause"] if r.get("amount_in") is not None]

    def told(group: Sequence[Row]) -> dict[str, Any]:
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
        "visible_causes": told(seen),
        "hardly_visible_causes": told(unseen),
        "by_kit": {k: told([r for r in seen if r["kit"] == k]) for k in ("full", "paper")},
        "by_manoeuvre": {
            m: told([r for r in seen if r["manoeuvre"] == m]) for m in sorted({r["manoeuvre"] for r in rows})
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
    """Hidden against named, visible cases only; a tie that holds the truth counts for the truth."""
    across = [*CAUSES, "other names", "wrong place", "unexplained", "clean", "failed"]
    down = ["nothing", *CAUSES, *SURPRISES]
    table = np.zeros((len(down), len(across)), int)
    for r in rows:
        if r["kind"] == "pair" or (r["kind"] != "nothing" and r["visibility"] < VISIBLE):
            continue
        hidden = r["hidden"][0].split("@")[0] if r["hidden"] else "nothing"
        said = hidden if r["outcome"] in GOOD and r["kind"] == "cause" else r["named"].split("@")[0]
        said = "wrong place" if r["outcome"] == "place" else said
        table[down.index(hidden), across.index(said if said in across else "other names")] += 1
    figure = Figure(figsize=(13, 15), layout="constrained")
    ax = figure.subplots()
    share = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1.4, aspect="auto")
    for i, j in zip(*np.nonzero(table), strict=True):
        ax.text(j, i, str(table[i, j]), ha="center", va="center", fontsize=8)
    ax.set_xticks(range(len(across)), across, rotation=90, fontsize=8)
    ax.set_yticks(range(len(down)), down, fontsize=8)
    ax.hlines([0.5, len(CAUSES) + 0.5], -0.5, len(across) - 0.5, color="0.4", linewidth=0.8)
    ax.vlines(len(CAUSES) - 0.5, -0.5, len(down) - 0.5, color="0.4", linewidth=0.8)
    ax.set_xlabel("named")
    ax.set_ylabel(f"hidden (chi-squared at least {VISIBLE:g})")
    return figure


def told(s: dict[str, Any], planned: int, options: Sequence[str]) -> str:
    """The README: what was done with these options and what came out, of so many cases planned."""

    def line(what: str, r: dict[str, Any], aim: str = "") -> str:
        if not r["of"]:
            return f"| {what} | - | 0 | | {aim} |"
        low, high = (100 * x for x in r["ci95"])
        return f"| {what} | {100 * r['rate']:.1f} % | {r['count']} of {r['of']} | {low:.1f} to {high:.1f} % | {aim} |"

    v = s["visible_causes"]
    rows = [
        line("nothing hidden, something found (false alarms)", s["false_alarms"], "at most 5 %"),
        line("visible cause named, alone or in a tie that holds it", v["named_or_tied"], "at least 90 %"),
        line("- named alone", v["named_alone"]),
        line("visible cause: wrong name or place", v["wrong"], "at most 2 %"),
        line("visible cause: right name and wrong ones besides", v["with_wrong_ones_besides"]),
        line("visible cause: unexplained", v["unexplained"]),
        line("visible cause: nothing found", v["nothing_found"]),
        line("visible surprise: left unexplained", s["visible_surprises_unexplained"]),
        line("visible surprise: given a name", s["visible_surprises_named"]),
        line("two causes: both named, no other", s["pairs"]["right"]),
        line("two causes: one named, nothing wrong", s["pairs"]["part"]),
        line("named causes: true amount within the 95 % interval", s["amount_within_interval"], "95 %"),
        line("named causes: gain on data not fitted on above zero", s["gain_positive"]),
        line("- surely (interval above zero)", s["gain_surely_positive"]),
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
    part = f" These are {s['cases']} of {planned} cases, as far as the time went." if s["cases"] < planned else ""
    command = " ".join(["python results/diagnosis/study.py", *options])
    programs = " and ".join(f"{name} ({count} cases)" for name, count in s["program"].items())
    programs += ", put together by hand" if len(s["program"]) > 1 else ""
    return f"""# Does the diagnosis name what was hidden?

`{command}`
makes this page, of program {programs} (`version` in study.py); [summary.json](summary.json) has every rate,
[cases.csv](cases.csv) every case.{part} Nobody had looked at any of them while the diagnosis was written: their numbers
begin where those end that it was mended by, which `--seen` runs instead, so that every round has others.

A second roller (`tests/plant.py`) shares no code with the program: Lagrange's equations in ground coordinates by
automatic differentiation, half-millisecond Runge-Kutta steps, a person with delay, slow hand and hydraulics at the
levers, counting encoders and noise. Bodies, soil and friction of each machine differ by up to 20 % from the nominal
one; five manoeuvres of 60 or 120 s; kits `full` and `paper`. The effects (`tests/causes.py`) are written from their
physics and not in the catalogue's formulas: two masses with a dead zone for backlash, shear integrated over the patch,
a volume of oil behind a valve; passes are counted on a map of the lane, as the catalogue does since, on another one.
Surprises (`tests/surprises.py`) are in no catalogue.

**Visible** means: the roller without the cause, its 27 parameters and true torques fitted, keeps a chi-squared of at
least {s["visible_chi2"]:g} in the noise-free signals, in units of the sensors' noise (`tests/visibility.py`, a
linearised Kalman filter of the second roller; no part of the diagnosis). That says that something is seen, not that it
can be told from everything else.

| {s["cases"]} cases | rate | count | 95 % interval | aim |
|---|---|---|---|---|
{table}

A diagnosis took {walls["median"]:.1f} s (median), {walls["p95"]:.1f} s (95 %), {walls["max"]:.1f} s (longest),
the start of the program included, with another case at work beside it (`--jobs`).

![hidden against named](confusion.png)

| hidden cause | visible cases | outcomes |
|---|---|---|
{causes}

| surprise | visible cases | said |
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
    parser.add_argument("--seen", action="store_true", help="cases from number 0, by which the diagnosis was mended")
    parser.add_argument("--drive", action="store_true", help="drive the second roller only, nothing is diagnosed yet")
    parser.add_argument("--only", default="", help="cases whose key begins like this, nothing else is written")
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args(argv)
    kept = KEPT / version()
    kept.mkdir(parents=True, exist_ok=True)
    many = {"nothing": given.nothing, "cause": given.per_cause, "surprise": given.per_surprise, "pair": given.pairs}
    every = cases(many, dict.fromkeys(FRESH, 0) if given.seen else FRESH)
    wanted = [c for c in every if c.key.startswith(given.only)]
    if given.drive:
        joblib.Parallel(n_jobs=given.jobs or 1, verbose=5)(joblib.delayed(driven)(c) for c in wanted)
        return
    if given.jobs:
        joblib.Parallel(n_jobs=given.jobs, verbose=5)(joblib.delayed(judged)(c, kept) for c in wanted)
    files = [kept / f"{c.key}.json" for c in wanted]
    rows = [{"program": kept.name} | json.loads(file.read_text()) for file in files if file.is_file()]
    if given.only:
        shown = ("key", "visibility", "amount", "manoeuvre", "duration_s", "kit", "outcome", "named", "error", "wall_s")
        print(pd.DataFrame(rows).reindex(columns=shown).to_string(index=False))
        return
    s = summary(rows)
    given.out.mkdir(parents=True, exist_ok=True)
    flat = pd.DataFrame(rows).drop(columns=["findings", "located"], errors="ignore")
    for column in ("hidden", "amount"):
        flat[column] = [" ".join(map(str, values)) for values in flat[column]]
    flat.to_csv(given.out / "cases.csv", index=False, float_format="%.6g")
    confusion(rows).savefig(given.out / "confusion.png", dpi=110, metadata={"Software": None})
    (given.out / "summary.json").write_text(json.dumps(s, indent=1) + "\n")
    names = ("nothing", "per_cause", "per_surprise", "pairs")
    options = [f"--{name.replace('_', '-')} {getattr(given, name)}" for name in names]
    (given.out / "README.md").write_text(told(s, len(wanted), [*options, *(["--seen"] if given.seen else [])]))


if __name__ == "__main__":
    main()
