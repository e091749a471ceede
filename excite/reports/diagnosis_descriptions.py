"""Diagnoses and studies in words and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from excite.reports.description import Description, Summary, Table, join_some
from excite.text import (
    count,
    first_lines,
    format_number,
    format_p_value,
    format_percent,
    format_rounded,
    format_uncertain,
)

MAX_CELLS = 200  # cells of a study in a table; chosen


def describe_diagnose(s: Summary) -> Description:
    """Describe a diagnosis: the answer, the findings, errors signal by signal, what to drive next."""
    remarks = [_describe_finding(f) for f in s["findings"]]
    if s["separating_run"]:
        remarks.append(f"To separate the tied causes, drive: {s['separating_run']}.")
    if s["separating_drive"]:
        remarks.append(_describe_separating_drive(s["separating_drive"]))
    remarks += [f"Still unexplained: {line}." for line in first_lines(s["located"])]
    if s["machine_file"]:
        remarks.append(
            f"{s['machine_file']} in the folder of this result is the machine with the findings in it: `excite"
            " design`, `verify`, `simulate` and `identify` take it."
        )
    remarks += s["notes"]
    tables = []
    if s["findings"]:
        tables.append(_table_of_findings(s["findings"]))
    rows = tuple(
        (
            n,
            r["unit"],
            *(format_number(r[k], 3) for k in ("rms_before", "rms_after")),
            *(format_number(r[f"systematic_{k}_percent"], 2) for k in ("before", "after")),
        )
        for n, r in s["signals"].items()
    )
    heads = ("signal", "unit", "error before", "error after", "systematic before %", "systematic after %")
    caption = (
        "Signal by signal: root mean square error on stretches that were withheld from the fit (it includes the"
        " sensor's noise), and the share of the one-step-ahead error that noise does not explain."
    )
    tables.append(Table(caption, heads, rows))
    if s["findings"]:
        moved = tuple(
            (
                n,
                r["unit"],
                *(format_rounded(r[k], r[f"std_{k}"]) for k in ("before", "after")),
                *(format_rounded(r[k], r[k], 2) for k in ("std_before", "std_after")),
                format_number(r["moved"], 2),
            )
            for n, r in s["parameters"].items()
        )
        titles = ("parameter", "unit", "before", "after", "std before", "std after", "moved by std")
        caption = "The parameters before and after: the bias that the findings took away."
        tables.append(Table(caption, titles, moved, optional=(4, 5)))
    return Description(f"Diagnosis of {s['machine']}", s["answer"], tuple(tables), tuple(remarks))


def _describe_finding(f: Mapping[str, Any]) -> str:
    """Say of a finding in a sentence how much it is, what it explains and what it gains."""
    name = f"{f['effect'].replace('_', ' ').capitalize()}, {f['where'].replace('_', ' ')}"
    text = f"{name}: {format_uncertain(f['amount'], f['amount_std'], f['unit'])}, a {f['kind']} that takes"
    text += f" {format_percent(f['share_percent'], 3)} of what noise does not explain"
    if f["gain_ci95"] is not None:
        low, high = (format_number(x, 2) for x in f["gain_ci95"])
        gain = f"{format_percent(f['gain_percent'])} (95 %: {low} to {high} %)"
        text += f", and the error on data not fitted falls by {gain}"
    return f"{text}; it can't be told from {join_some(f['tied_with'])}." if f["tied_with"] else f"{text}."


def _table_of_findings(findings: Sequence[Mapping[str, Any]]) -> Table:
    rows = tuple(
        (
            f"{f['effect']}@{f['where']}",
            format_rounded(f["amount"], f["amount_std"], 5),
            format_rounded(f["amount_std"], f["amount_std"], 2),
            f["unit"],
            "; ".join(f"{n} {format_number(x['value'], 4)} {x['unit']}" for n, x in f["shapes"].items()) or "-",
            format_p_value(f["p_value"]),
            format_number(f["gain_percent"], 3),
            "-" if f["gain_ci95"] is None else " to ".join(format_number(x, 3) for x in f["gain_ci95"]),
            ", ".join(f["tied_with"]) or "-",
        )
        for f in findings
    )
    names = ("effect", "magnitude", "std", "unit", "shape", "p-value", "gain %", "95 % interval", "tied with")
    caption = (
        "Findings, in the order in which they were found. p-value: of no such effect, corrected for all the causes that"
        " were tried. Gain: by how much the error falls on stretches that were not fitted."
    )
    return Table(caption, names, rows, optional=(4,))


def _describe_separating_drive(drive: Mapping[str, Any]) -> str:
    """Describe the drive that was, or could be, designed to separate two tied causes."""
    first, second = (x.partition("=")[0] for x in drive["between"])
    if "failed" in drive:
        return f"No drive was designed to separate {first} from {second}: {drive['failed']}."
    if drive["folder"] is None:
        return f"A drive can be designed to separate {first} from {second}: `excite diagnose` with `--next` does."
    return (
        f"The folder {drive['folder']}/ holds a drive designed to separate {first} from {second} (`profile.csv`;"
        f" `excite drive` makes a sheet of it): its log gives the magnitude of each within"
        f" {format_percent(drive['sigma_percent'])}." + ("" if drive["complete"] else " Its search was stopped early.")
    )


def describe_study(s: Summary) -> Description:
    """Describe a study: how its runs ended, the best and the worst cell, all cells as a table."""
    headline = f"{s['done']} of {count(s['runs'], 'run')} gave a result, {s['failed']} could not give one"
    headline += f", {s['defects']} showed a defect of the program." if s["defects"] else "."
    alike: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}  # cells with other effects err for other reasons
    for r in s["cells"]:
        if np.isfinite(r.get("worst_rms_percent") or np.nan):
            alike.setdefault(tuple(r.get("effects", ())), []).append(r)
    effects, ranked = max(alike.items(), key=lambda one: len(one[1]), default=((), []))
    if len(ranked) > 1:
        best, worst = (pick(ranked, key=lambda r: r["worst_rms_percent"]) for pick in (min, max))
        among = f"{len(ranked)} cells"
        if len(alike) > 1:
            among += f" with {' and '.join(effects)}" if effects else " without effects"
        headline += f" By the error of its worst parameter, {_cell_error(best)} is the best of {among},"
        headline += f" {_cell_error(worst)} the worst."
    remarks = [
        "runs.parquet has one row per run; the command in its column `command`, given in this folder, repeats it"
    ]
    if s["defects"]:
        remarks.append("The column `reason` of runs.parquet names each defect of the program.")
    rows = tuple(
        (
            row["cell"],
            str(row["done"]),
            str(row["failed"] + row["defect"]),
            row.get("worst_parameter", "-"),
            format_number(row.get("worst_rms_percent"), 3),
            format_number(row.get("median_rms_percent"), 3),
            format_number(100 * row["coverage95"] if row.get("coverage95") is not None else None, 3),
            ", ".join(f"{k} {v}" for k, v in row.get("verdicts", {}).items()) or "-",
        )
        for row in s["cells"][:MAX_CELLS]
    )
    columns = ("cell", "done", "failed", "worst parameter", "rms %", "median rms %", "coverage %", "verdicts")
    caption = "Results of each cell. rms: error of the worst parameter over the runs; coverage: of the 95 % intervals."
    if len(s["cells"]) > MAX_CELLS:
        caption += f" {len(s['cells']) - MAX_CELLS} cells more are in summary.json."
    title = s.get("title") or s.get("study", "")
    return Description(f"Study {title}", headline, (Table(caption, columns, rows),), tuple(remarks))


def _cell_error(row: Mapping[str, Any]) -> str:
    return f"{row['cell']} ({row['worst_parameter']} {format_percent(row['worst_rms_percent'])} rms)"
