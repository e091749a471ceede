"""Attack the diagnosis with logs that it was not made for, and score the answers against keys written beforehand.

python results/attacks/study.py [--per-attack 1] [--first 0] [--jobs 1] [--only KIND ...] [--out FOLDER] runs the cases
from number `--first` on: numbers that were never run are fresh logs. Writes summary.json and README.md. Each case is
stored in results/.attacks/ when done, so an interrupted study resumes; cases of other versions of the program or the
attacks are not reused. `--jobs 0` reports the stored cases.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
KEPT = ROOT / "results" / ".attacks"
sys.path.insert(0, str(ROOT / "tests"))

import joblib
from support import studies
from support.attacks import ATTACKS, KINDS, OUTCOMES, Attack, attack, key_of, score, simulate
from support.blind import ask
from support.rounds import program_version, store
from support.visibility import VISIBLE, visibility

Row = dict[str, Any]
SUPPORT = [
    ROOT / "tests" / "support" / f"{name}.py"
    for name in ("attacks", "plant", "causes", "surprises", "sticking", "blind", "visibility")
]


def cases(per_attack: int, first: int, kinds: Sequence[str]) -> list[Attack]:
    """List the cases; kinds take turns in proportion to their number, so an interrupted study has some of each."""
    ordered: list[tuple[float, Attack]] = []
    for kind in kinds:
        names = [name for name, its in ATTACKS.items() if its == kind]
        every = [attack(name, number) for number in range(first, first + per_attack) for name in names]
        ordered += [((k + 0.5) / len(every), one) for k, one in enumerate(every)]
    return [one for _, one in sorted(ordered, key=lambda both: both[0])]


def run_case(one: Attack, kept: Path) -> Row:
    """Simulate, diagnose and score a case, and store the row. Returns a stored row as it is."""
    file = kept / f"{one.label}.json"
    if file.is_file():
        stored: Row = json.loads(file.read_text())
        return stored
    key = key_of(one)
    row: Row = {"attack": one.label, "kind": one.kind, "machine": one.machine, "size": one.size, "key": key.text()}
    begin = time.perf_counter()
    try:
        seen = simulate(one)
        row |= {"hidden": list(seen.hidden), "visibility": visibility(seen.drive) if seen.drive else None}
        if seen.drive:
            row |= {"manoeuvre": seen.drive.case.manoeuvre, "kit": seen.drive.case.kit}
        begin = time.perf_counter()
        said = ask(seen.log, one.machine)
        row |= {"verdict": said["verdict"], "findings": said["findings"], "answer": said.get("answer")}
        row |= {"first": first_name(said), "score": score(key, said), "error": None}
    except RuntimeError as err:
        row |= {"verdict": "failed", "findings": [], "first": "-", "score": "failed", "error": str(err)}
    row["wall_s"] = time.perf_counter() - begin
    store(file, row)
    return row


def first_name(said: dict[str, Any]) -> str:
    """Return the first finding with its kind and the size of its tie, or a dash."""
    if not said["findings"]:
        return "-"
    f = said["findings"][0]
    more = f", tied with {len(f['tied_with'])}" if f["tied_with"] else ""
    return f"{f['effect']}@{f['where']}{more}{' (correction)' if f['kind'] == 'correction' else ''}"


# ------------------------------------------------------------------------------------------------------ figures
def summary(rows: Sequence[Row], planned: int, program: str) -> dict[str, Any]:
    """Count the scores, over all and by kind; list the wrong and failed answers, then all cases."""

    def counts(group: Sequence[Row]) -> dict[str, int]:
        told = Counter(r["score"] for r in group)
        return {"cases": len(group), **{name: told[name] for name in OUTCOMES}}

    visible = [r for r in rows if r.get("visibility") is None or r["visibility"] >= VISIBLE]
    shown = ("attack", "kind", "size", "visibility", "hidden", "key", "verdict", "first", "score", "error", "wall_s")
    table = [{k: r.get(k) for k in shown} | {"named": labels(r)} for r in rows]
    return {
        "study": "attacks",
        "program": program,
        "planned": planned,
        "all": counts(rows),
        "by_kind": {kind: counts([r for r in rows if r["kind"] == kind]) for kind in KINDS},
        "visible_chi2": VISIBLE,
        "visible_or_rig": counts(visible),
        "wrong": [r["attack"] for r in rows if r["score"] == "wrong"],
        "failed": [r["attack"] for r in rows if r["score"] == "failed"],
        "cases": table,
    }


def labels(row: Row) -> list[str]:
    return [
        " or ".join([f"{f['effect']}@{f['where']}", *f["tied_with"]]) + (" (correction)" * (f["kind"] == "correction"))
        for f in row["findings"]
    ]


def readme(s: dict[str, Any], command: str) -> str:
    """Write the page from the summary."""
    total = s["all"]
    kinds = "\n".join(
        f"| {kind} | {c['cases']} | {' | '.join(str(c[name]) for name in OUTCOMES)} |"
        for kind, c in {**s["by_kind"], "all": total}.items()
        if c["cases"]
    )
    order = {name: k for k, name in enumerate(KINDS)}
    rows = sorted(s["cases"], key=lambda r: (order[r["kind"]], r["attack"]))
    table = "\n".join(
        f"| {r['kind']} | {r['attack']} | {r['size']:.2f} | "
        f"{'-' if r['visibility'] is None else format(r['visibility'], '.0f')} | "
        f"{r['verdict']} | {r['first']} | {r['score']} |"
        for r in rows
    )
    bad = [r for r in rows if r["score"] in ("wrong", "failed")]
    wrong = "\n".join(
        f"- **{r['attack']}** (size {r['size']:.2f}). Hidden: {', '.join(r['hidden'] or ['-'])}. Key: {r['key']}. "
        f"Said: {r['verdict']}; {'; '.join(r['named']) or (r['error'] or 'nothing named').splitlines()[-1].strip()}."
        for r in bad
    )
    part = f" These are {total['cases']} of {s['planned']} planned cases." if total["cases"] < s["planned"] else ""
    return f"""# Attacks on the diagnosis

**Result.** {total["wrong"]} of {total["cases"]} attacks were answered wrongly. {total["right"]} answers were right,
{total["partly"]} partly right, {total["honest"]} honest (no cause named), {total["failed"]} ended with an error.

`{command}`
rebuilds this page; program version {s["program"]}. All cases are in [summary.json](summary.json).{part}

- **Attacks** (`tests/support/attacks.py`): physics that the catalogue lacks, each with its source; true machines that
  differ from the machine file; listed causes of unequal size together; poor data; rigs that stick; and, with
  `--only surprise`, the surprises of the blind test. The engine was not tuned on them.
- **Logs** come from the second roller (60 s) or from a rig with set-valued friction (25 s). Size is drawn from the
  seed, up to 1 (strong). Combinations and poor data draw the magnitudes of their causes apart from it.
- **Keys** are written before the diagnosis is asked. *Right*: every hidden thing that has a name is named, alone or in
  a tie, and nothing else. *Partly*: some of them, or a name of the same physics with another law. *Honest*: no cause is
  named. *Wrong*: a cause is named that is not there; with nothing hidden, anything but `clean`.
- **chi2**: what the roller without the attack cannot explain (`tests/support/visibility.py`); below
  {s["visible_chi2"]:g} nothing can be found. It does not see a wrong clock rate and does not apply to rigs.

| kind | cases | {" | ".join(OUTCOMES)} |
|---|---|{"---|" * len(OUTCOMES)}
{kinds}

## Wrong and failed answers

{wrong or "None."}

## All answers

| kind | attack | size | chi2 | verdict | first name | score |
|---|---|---|---|---|---|---|
{table}
"""


def report(rows: Sequence[Row], planned: int, program: str, out: Path, command: str, first: int) -> None:
    s = studies.origin(__file__, first) | summary(rows, planned, program)
    (out / "summary.json").write_text(json.dumps(s, indent=1, default=float) + "\n")
    (out / "README.md").write_text(readme(s, command))


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--per-attack", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of each attack's first case")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), help="kinds of attacks to run")
    given = studies.parse(parser, __file__, argv)
    program = program_version(SUPPORT)
    kept = KEPT / program
    kept.mkdir(parents=True, exist_ok=True)
    wanted = cases(given.per_attack, given.first, given.only)
    store(kept / f"keys-{given.first}-{given.per_attack}.json", {one.label: key_of(one).text() for one in wanted})
    if given.jobs:
        run = joblib.Parallel(n_jobs=given.jobs, return_as="generator_unordered")
        begin = time.perf_counter()
        for k, row in enumerate(run(joblib.delayed(run_case)(one, kept) for one in wanted), 1):
            took = (time.perf_counter() - begin) / 60
            print(
                f"{k}/{len(wanted)} {took:5.1f} min  {row['attack']:24s} {row['verdict']:12s} {row['score']:8s} "
                f"{row['first']} ({row['wall_s']:.0f} s)",
                flush=True,
            )
    files = [kept / f"{one.label}.json" for one in wanted]
    rows = [json.loads(file.read_text()) for file in files if file.is_file()]
    options = f"--per-attack {given.per_attack} --first {given.first} --out results/attacks"
    if set(given.only) != set(KINDS):
        options += f" --only {' '.join(given.only)}"
    report(rows, len(wanted), program, given.out, f"python results/attacks/study.py {options}", given.first)
    print(f"{given.out / 'summary.json'}: {summary(rows, len(wanted), program)['all']}")


if __name__ == "__main__":
    main()
