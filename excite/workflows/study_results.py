"""The results of a study: one table with a row a run, what it comes to cell by cell, and a figure of that."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib.figure import Figure

from excite import identification, reports
from excite.identification import Verification
from excite.model import build_cached
from excite.reports import COLOURS, Picture, Table, report_page
from excite.text import format_number, format_percent
from excite.workflows import study_runs
from excite.workflows.study_plan import Cell, StudyPlan
from excite.workflows.study_runs import DEFECT, DONE, Row

TABLE, FIGURE = "runs.parquet", "study.png"
ROW_GROUP = 2000  # rows that are in memory at a time
REPEAT = f"{TABLE} has a row a run; what its column `command` says repeats the run, from within this folder"
NAMED = 30  # cells that a figure or report names one by one

COLUMNS = {
    "run": pa.int64(),
    "cell": pa.int32(),
    "repeat": pa.int32(),
    "machine": pa.string(),
    "machine_sha256": pa.string(),
    "problem": pa.string(),
    "objective": pa.string(),
    "duration_s": pa.float64(),
    "limits": pa.string(),
    "starts": pa.int32(),
    "design_seed": pa.int64(),
    "profile": pa.string(),
    "drive": pa.string(),
    "drive_cond_phi": pa.float64(),
    "drive_worst_percent": pa.float64(),
    "kit": pa.string(),
    "effects": pa.string(),
    "method": pa.string(),
    "seed": pa.int64(),
    "status": pa.string(),
    "reason": pa.string(),
    "log_sha256": pa.string(),
    "relative_error_percent": pa.float64(),
    "verdict": pa.string(),
    "findings": pa.string(),
    "error_before_percent": pa.float64(),
    "error_after_percent": pa.float64(),
    "versions": pa.string(),
    "command": pa.string(),
}


@dataclass(frozen=True)
class CellResult:
    """A cell and what came of its runs: how many ended how, why those failed; per parameter what `verify.summary`
    says (empty without estimates); verdicts of its diagnoses."""

    number: int
    cell: Cell
    method: str
    cond_phi: float | None
    statuses: Mapping[str, int]
    reasons: Mapping[str, int]
    parameters: Mapping[str, Mapping[str, float | str]]
    biased: Sequence[str]
    verdicts: Mapping[str, int]

    @property
    def rms(self) -> dict[str, float]:
        """Root-mean-square error of every parameter that some run found [%]."""
        found = {n: float(p["rms_percent"]) for n, p in self.parameters.items()}
        return {n: error for n, error in found.items() if np.isfinite(error)}

    @property
    def coverage(self) -> float:
        """How often a 95 % interval holds the truth, over all parameters."""
        return float(np.mean([float(self.parameters[n]["coverage95"]) for n in self.rms])) if self.rms else np.nan


def write_table(
    wanted: StudyPlan,
    rows: Iterator[tuple[int, Row]],
    track: Callable[[int], Any],
    files: Mapping[str, str],
    versions: Mapping[str, str],
    place: Path,
) -> list[CellResult]:
    """Writes `runs.parquet` from rows in the order of their runs, a group at a time; what each cell comes to.

    track(k): drive k, None where there is none; files: each machine's name or file for the commands.
    """
    names = list(dict.fromkeys(n for names in wanted.parameters.values() for n in names))
    estimates = {f"{kind}.{n}": pa.float64() for kind in (*study_runs.ESTIMATE_COLUMNS, "true") for n in names}
    if not set(wanted.study.steps) & {"identify", "verify"}:
        estimates = {}
    schema = pa.schema(COLUMNS | estimates, metadata={"study": wanted.study.name, "program": study_runs.program_hash()})
    shas = {n: sha256(m.model_dump_json().encode()).hexdigest() for n, m in wanted.machines.items()}
    made = json.dumps({**versions, "program": study_runs.program_hash()})
    seen: list[CellResult] = []
    held: list[Row] = []
    with pq.ParquetWriter(place / TABLE, schema, compression="zstd") as writer:
        for c, group in groupby(rows, key=lambda both: both[0] // wanted.study.runs):
            cell, known = wanted.cells[c], track(wanted.number[wanted.cells[c].drive])
            about = _cell_columns(wanted, c, known, files) | {
                "machine_sha256": shas[cell.drive.machine],
                "versions": made,
            }
            seeds, found = wanted.seeds(cell), []
            for number, row in group:
                seed = int(seeds[number % wanted.study.runs])
                held.append(_table_row(wanted, number, cell, about, row, seed))
                found.append(row)
                if len(held) >= ROW_GROUP:
                    writer.write_table(pa.Table.from_pylist(held, schema))
                    held = []
            seen.append(_cell_result(wanted, c, cell, known, found))
        if held:
            writer.write_table(pa.Table.from_pylist(held, schema))
    return seen


def _cell_columns(wanted: StudyPlan, c: int, track: Any, files: Mapping[str, str]) -> Row:
    cell, drive = wanted.cells[c], wanted.cells[c].drive
    name = f"{wanted.number[drive] + 1:04d}"
    summary = track.summary if track is not None else {}
    method = wanted.method(cell)
    machine = files[drive.machine]
    simulate = ["excite", "simulate", machine, f"drives/{name}/profile.csv", "--kit", cell.kit]
    for text in cell.effects:
        simulate += ["--effect", text]
    then = ["excite", "identify", machine, "log.csv", "--method", method]
    if "diagnose" in wanted.study.steps and not set(wanted.study.steps) & {"identify", "verify"}:
        then = ["excite", "diagnose", machine, "log.csv"]
    return {
        "cell": c,
        "machine": machine,
        "problem": summary.get("problem", drive.problem),
        "objective": drive.objective if drive.profile is None else None,
        "duration_s": track.duration_s if track is not None else drive.duration_s,
        "limits": json.dumps(dict(drive.limits)),
        "starts": drive.starts if drive.profile is None else None,
        "design_seed": drive.seed if drive.profile is None else None,
        "profile": drive.profile,
        "drive": f"drives/{name}" if track is not None else None,
        "drive_cond_phi": summary.get("cond_phi"),
        "drive_worst_percent": summary.get("worst_percent"),
        "kit": cell.kit,
        "effects": " ".join(cell.effects),
        "method": method,
        "command": f"{shlex.join(simulate)} --seed SEED --out log.csv && {shlex.join(then)}",
    }


def _table_row(wanted: StudyPlan, number: int, cell: Cell, about: Row, row: Row, seed: int) -> Row:
    line = about | {"run": number, "repeat": number % wanted.study.runs, "seed": seed}
    line["command"] = about["command"].replace("SEED", str(seed))
    line |= {k: v for k, v in row.items() if k in COLUMNS}
    if "findings" in row:
        line["findings"] = json.dumps(row["findings"])
    names = wanted.parameters[cell.drive.machine]
    for kind in study_runs.ESTIMATE_COLUMNS:
        line |= {f"{kind}.{n}": x for n, x in zip(names, row.get(kind, ()), strict=False)}
    model = build_cached(wanted.machines[cell.drive.machine].model_dump_json())
    return line | {f"true.{n}": float(x) for n, x in zip(names, model.nominal, strict=True)}


def _cell_result(wanted: StudyPlan, c: int, cell: Cell, track: Any, rows: Sequence[Row]) -> CellResult:
    model = build_cached(wanted.machines[cell.drive.machine].model_dump_json())
    table: dict[str, dict[str, float | str]] = {}
    if any("value" in row for row in rows):
        nothing = [None] * len(model.base.names)
        value, std, *ends = (np.array([row.get(k, nothing) for row in rows], float) for k in study_runs.ESTIMATE_COLUMNS)
        v = Verification(
            *(wanted.method(cell), cell.kit, model.base.names, model.base.units, model.nominal, model.scale),
            *(value, std, np.stack(ends, axis=1), {}),
        )
        table = identification.summarise_runs(v)
    reasons = Counter(row["reason"] for row in rows if row.get("reason"))
    return CellResult(
        c,
        cell,
        wanted.method(cell),
        track.summary.get("cond_phi") if track is not None else None,
        Counter(row["status"] for row in rows),
        dict(reasons.most_common(3)),
        table,
        identification.biased_parameters(table),
        Counter(row["verdict"] for row in rows if row.get("verdict")),
    )


def cell_labels(seen: Sequence[CellResult]) -> list[str]:
    """A name for each cell: what tells it from the others."""
    parts = [_cell_axes(s) for s in seen]
    varied = [k for k in parts[0] if len({p[k] for p in parts}) > 1] if parts else []
    return [", ".join(p[k] for k in varied if p[k]) or "the one cell" for p in parts]


def _cell_axes(s: CellResult) -> dict[str, str]:
    d = s.cell.drive
    return {
        "machine": d.machine,
        "problem": d.problem or "",
        "objective": d.objective,
        "duration": "" if d.duration_s is None else f"{d.duration_s:g} s",
        "limits": " ".join(f"{n} x {f:g}" for n, f in d.limits),
        "starts": f"{d.starts} starts",
        "design_seed": f"design {d.seed}",
        "profile": d.profile or "",
        "kit": s.cell.kit,
        "method": s.method,
        "effects": " ".join(s.cell.effects) or "no effect",
        "seed": f"seed {s.cell.seed}",
    }


def summarise_cells(seen: Sequence[CellResult]) -> dict[str, Any]:
    """Counts over all, and a line for every cell."""
    total: Counter[str] = Counter()
    for s in seen:
        total.update(s.statuses)
    return {
        "done": total[DONE],
        "failed": total[study_runs.FAILED],
        "defects": total[DEFECT],
        "cells": [_cell_summary(s, name) for s, name in zip(seen, cell_labels(seen), strict=True)],
    }


def _cell_summary(s: CellResult, name: str) -> dict[str, Any]:
    said: dict[str, Any] = {"cell": name, "cond_phi": s.cond_phi, **{k: s.statuses.get(k, 0) for k in study_runs.STATUSES}}
    if s.reasons:
        said["reasons"] = dict(s.reasons)
    if s.rms:
        worst = max(s.rms, key=lambda n: s.rms[n])
        said |= {
            "worst_parameter": worst,
            "worst_rms_percent": s.rms[worst],
            "median_rms_percent": float(np.median(list(s.rms.values()))),
            "coverage95": s.coverage,
            "biased": list(s.biased),
        }
    if s.verdicts:
        said["verdicts"] = dict(s.verdicts)
    return said


def study_figure(seen: Sequence[CellResult], title: str) -> Figure:
    """Cell by cell: errors of the parameters and how often intervals hold, verdicts, or else the drives' scores."""
    names, n = cell_labels(seen), len(seen)
    shown = Figure(figsize=(11.5, 1.6 + 0.3 * min(n, NAMED) + (2.5 if n > NAMED else 0)), layout="constrained")
    shown.suptitle(reports.plain(title))
    y = np.arange(n)
    if any(s.rms for s in seen):
        left, right = shown.subplots(1, 2, sharey=True, width_ratios=(2, 1))
        for k, s in enumerate(seen):
            if s.rms:
                left.plot(list(s.rms.values()), [k] * len(s.rms), "o", color=COLOURS[0], markersize=3, alpha=0.5)
                left.plot(np.median(list(s.rms.values())), k, "D", color=COLOURS[1], markersize=5)
                right.plot(100 * s.coverage, k, "D", color=COLOURS[1], markersize=5)
        left.set_xscale("log")
        left.set_xlabel("error of each parameter, rms over the runs [%]; diamond: median parameter")
        right.axvline(95, color="black", linewidth=0.8, linestyle=(0, (2, 3)))
        right.set_xlim(-3, 103)
        right.set_xlabel("95 % intervals that hold [%]")
        axes = [left, right]
    elif any(s.verdicts for s in seen):
        only = shown.subplots()
        kinds, base = ("clean", "named", "tied", "unexplained"), np.zeros(n)
        for k, kind in enumerate(kinds):
            share = np.array([100 * s.verdicts.get(kind, 0) / max(1, sum(s.statuses.values())) for s in seen])
            hatch = ("", "//", "..", "xx")[k]
            only.barh(y, share, left=base, color=COLOURS[k], hatch=hatch, edgecolor="white", label=kind)
            base += share
        only.set_xlabel("verdicts [% of the runs]")
        only.legend(ncols=4, fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1, 1))
        axes = [only]
    else:
        only = shown.subplots()
        score = [np.nan if s.cond_phi is None else s.cond_phi for s in seen]
        only.barh(y, score, color=COLOURS[0], height=0.6)
        only.set_xlabel("cond(Phi) of the drive")
        axes = [only]
    for ax in axes:
        ax.grid(alpha=0.3)
    if n <= NAMED:
        axes[0].set_yticks(y, [reports.plain(name) for name in names], fontsize=8)
    else:
        axes[0].set_ylabel("cell")
    axes[0].invert_yaxis()
    return shown


def draw(wanted: StudyPlan, seen: Sequence[CellResult], said: Mapping[str, Any], place: Path) -> None:
    """Figure and report of a study's folder."""
    title = wanted.study.title or wanted.study.name
    reports.save(study_figure(seen, f"{title}: {said['runs']} runs"), place / FIGURE)
    (place / reports.REPORT).write_text(page(title, said, place / FIGURE), encoding="utf-8")


def page(title: str, said: Mapping[str, Any], picture: Path) -> str:
    """The study's report: counts, figure, the cells as a table."""
    columns = ("cell", "done", "failed", "worst parameter", "rms %", "median rms %", "coverage %", "verdicts")
    lines = [
        (
            row["cell"],
            str(row["done"]),
            str(row["failed"] + row["defect"]),
            row.get("worst_parameter", "-"),
            format_number(row.get("worst_rms_percent"), 3),
            format_number(row.get("median_rms_percent"), 3),
            format_number(100 * row["coverage95"] if "coverage95" in row else None, 3),
            ", ".join(f"{k} {v}" for k, v in row.get("verdicts", {}).items()) or "-",
        )
        for row in said["cells"][:200]
    ]
    answer = f"{said['done']} of {said['runs']} runs gave a result, {said['failed']} could not give one"
    answer += f", {said['defects']} showed a defect of the program." if said["defects"] else "."
    told = [r for r in said["cells"] if np.isfinite(r.get("worst_rms_percent") or np.nan)]
    if len(told) > 1:
        best, worst = (pick(told, key=lambda r: r["worst_rms_percent"]) for pick in (min, max))
        answer += f" By the error of its worst parameter, {_erring(best)} is the best of {len(told)} cells,"
        answer += f" {_erring(worst)} the worst."
    how = {
        "command": reports.how({"versions": said["versions"]})["command"],
        "steps": ", ".join(said["steps"]),
        "computed in": f"{said['compute_s']:.0f} s of the workers' time",
        "versions": ", ".join(f"{n} {v}" for n, v in said["versions"].items()),
        "program": f"{said['program']} (changes when the program does)",
    }
    caption = "Cell by cell: each parameter's error, root mean square over the cell's runs [%], and how often the 95 %"
    caption += " intervals hold; or the verdicts of diagnosis; or the drives' condition numbers."
    table = Table("What each cell comes to.", columns, tuple(lines))
    return report_page(title, answer, [Picture(picture, caption)], [table], how, [REPEAT])


def _erring(row: Mapping[str, Any]) -> str:
    return f"{row['cell']} ({row['worst_parameter']} {format_percent(row['worst_rms_percent'])} rms)"
