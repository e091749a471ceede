"""Results of a study: the table of runs, a summary and a figure cell by cell, the report."""

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
from excite.reports import COLOURS
from excite.text import count
from excite.workflows import study_runs
from excite.workflows.study_plan import Cell, StudyPlan
from excite.workflows.study_runs import DEFECT, DONE, Row

TABLE, FIGURE = "runs.parquet", "study.png"
ROW_GROUP = 2000  # rows in memory at a time; chosen
MIN_SWEPT = 3  # values of a number from which a study has it on an axis; chosen
CELL_LETTERS, CELL_LETTERS_NARROW = 60, 30  # of a cell's name in a line; chosen
MAX_NAMED = 30  # cells that the figure names one by one; chosen

COLUMNS = {  # of the table of runs, beside the estimates
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
    """Results of the runs of a cell.

    statuses: number of runs by status. reasons: the most frequent reasons of failure, with their number.
    parameters: as `summarise_runs` gives them, empty without estimates. verdicts: of diagnoses, with their number.
    """

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
        """Root-mean-square error [%] of every parameter that some run identified."""
        found = {n: float(p["rms_percent"]) for n, p in self.parameters.items()}
        return {n: error for n, error in found.items() if np.isfinite(error)}

    @property
    def coverage(self) -> float:
        """Share of 95 % intervals that hold the truth, mean of all parameters."""
        return float(np.mean([float(self.parameters[n]["coverage95"]) for n in self.rms])) if self.rms else np.nan


def write_table(
    plan: StudyPlan,
    rows: Iterator[tuple[int, Row]],
    stored_drive: Callable[[int], Any],
    files: Mapping[str, str],
    versions: Mapping[str, str],
    place: Path,
) -> list[CellResult]:
    """Write `runs.parquet` from numbered rows in order; return the results of each cell.

    stored_drive(k): drive k, None if its design failed. files: each machine's name or file for the commands.
    """
    names = list(dict.fromkeys(n for names in plan.parameters.values() for n in names))
    estimates = {f"{kind}.{n}": pa.float64() for kind in (*study_runs.ESTIMATE_COLUMNS, "true") for n in names}
    if not set(plan.study.steps) & {"identify", "verify"}:
        estimates = {}
    schema = pa.schema(COLUMNS | estimates, metadata={"study": plan.study.name, "program": study_runs.program_hash()})
    hashes = {n: sha256(m.model_dump_json().encode()).hexdigest() for n, m in plan.machines.items()}
    version_text = json.dumps({**versions, "program": study_runs.program_hash()})
    results: list[CellResult] = []
    held: list[Row] = []
    with pq.ParquetWriter(place / TABLE, schema, compression="zstd") as writer:
        for c, group in groupby(rows, key=lambda both: both[0] // plan.study.runs):
            cell, known = plan.cells[c], stored_drive(plan.number[plan.cells[c].drive])
            columns = _cell_columns(plan, c, known, files) | {
                "machine_sha256": hashes[cell.drive.machine],
                "versions": version_text,
            }
            seeds, found = plan.seeds(cell), []
            for number, row in group:
                seed = int(seeds[number % plan.study.runs])
                held.append(_table_row(plan, number, cell, columns, row, seed))
                found.append(row)
                if len(held) >= ROW_GROUP:
                    writer.write_table(pa.Table.from_pylist(held, schema))
                    held = []
            results.append(_cell_result(plan, c, cell, known, found))
        if held:
            writer.write_table(pa.Table.from_pylist(held, schema))
    return results


def _cell_columns(plan: StudyPlan, c: int, stored: Any, files: Mapping[str, str]) -> Row:
    cell, drive = plan.cells[c], plan.cells[c].drive
    name = f"{plan.number[drive] + 1:04d}"
    summary = stored.summary if stored is not None else {}
    method = plan.method(cell)
    machine = files[drive.machine]
    simulate = ["excite", "simulate", machine, f"drives/{name}/profile.csv", "--kit", cell.kit]
    for text in cell.effects:
        simulate += ["--effect", text]
    then = ["excite", "identify", machine, "log.csv", "--method", method]
    if "diagnose" in plan.study.steps and not set(plan.study.steps) & {"identify", "verify"}:
        then = ["excite", "diagnose", machine, "log.csv"]
    return {
        "cell": c,
        "machine": machine,
        "problem": summary.get("problem", drive.problem),
        "objective": drive.objective if drive.profile is None else None,
        "duration_s": stored.duration_s if stored is not None else drive.duration_s,
        "limits": json.dumps(dict(drive.limits)),
        "starts": drive.starts if drive.profile is None else None,
        "design_seed": drive.seed if drive.profile is None else None,
        "profile": drive.profile,
        "drive": f"drives/{name}" if stored is not None else None,
        "drive_cond_phi": summary.get("cond_phi"),
        "drive_worst_percent": summary.get("worst_percent"),
        "kit": cell.kit,
        "effects": " ".join(cell.effects),
        "method": method,
        "command": f"{shlex.join(simulate)} --seed SEED --out log.csv && {shlex.join(then)}",
    }


def _table_row(plan: StudyPlan, number: int, cell: Cell, columns: Row, row: Row, seed: int) -> Row:
    line = columns | {"run": number, "repeat": number % plan.study.runs, "seed": seed}
    line["command"] = columns["command"].replace("SEED", str(seed))
    line |= {k: v for k, v in row.items() if k in COLUMNS}
    if "findings" in row:
        line["findings"] = json.dumps(row["findings"])
    names = plan.parameters[cell.drive.machine]
    for kind in study_runs.ESTIMATE_COLUMNS:
        line |= {f"{kind}.{n}": x for n, x in zip(names, row.get(kind, ()), strict=False)}
    model = build_cached(plan.machines[cell.drive.machine].model_dump_json())
    return line | {f"true.{n}": float(x) for n, x in zip(names, model.nominal, strict=True)}


def _cell_result(plan: StudyPlan, c: int, cell: Cell, stored: Any, rows: Sequence[Row]) -> CellResult:
    model = build_cached(plan.machines[cell.drive.machine].model_dump_json())
    table: dict[str, dict[str, float | str]] = {}
    if any("value" in row for row in rows):
        nothing = [None] * len(model.base.names)
        value, std, *ends = (
            np.array([row.get(k, nothing) for row in rows], float) for k in study_runs.ESTIMATE_COLUMNS
        )
        v = Verification(
            *(plan.method(cell), cell.kit, model.base.names, model.base.units, model.nominal, model.scale),
            *(value, std, np.stack(ends, axis=1), {}),
        )
        table = identification.summarise_runs(v)
    reasons = Counter(row["reason"] for row in rows if row.get("reason"))
    return CellResult(
        c,
        cell,
        plan.method(cell),
        stored.summary.get("cond_phi") if stored is not None else None,
        Counter(row["status"] for row in rows),
        dict(reasons.most_common(3)),
        table,
        identification.biased_parameters(table),
        Counter(row["verdict"] for row in rows if row.get("verdict")),
    )


def cell_labels(results: Sequence[CellResult]) -> list[str]:
    """Name each cell by the values in which it differs from others."""
    parts = [_cell_axes(s) for s in results]
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
        "starts": count(d.starts, "start"),
        "design_seed": f"design {d.seed}",
        "profile": d.profile or "",
        "kit": s.cell.kit,
        "method": s.method,
        "effects": " ".join(s.cell.effects) or "no effect",
        "seed": f"seed {s.cell.seed}",
    }


def summarise_cells(results: Sequence[CellResult]) -> dict[str, Any]:
    """Summarise a study: number of runs by status, and each cell."""
    total: Counter[str] = Counter()
    for s in results:
        total.update(s.statuses)
    return {
        "done": total[DONE],
        "failed": total[study_runs.FAILED],
        "defects": total[DEFECT],
        "cells": [_cell_summary(s, name) for s, name in zip(results, cell_labels(results), strict=True)],
    }


def _cell_summary(s: CellResult, name: str) -> dict[str, Any]:
    summary: dict[str, Any] = {
        "cell": name,
        "cond_phi": s.cond_phi,
        "effects": list(s.cell.effects),
        **{k: s.statuses.get(k, 0) for k in study_runs.STATUSES},
    }
    if s.reasons:
        summary["reasons"] = dict(s.reasons)
    if s.rms:
        worst = max(s.rms, key=lambda n: s.rms[n])
        summary |= {
            "worst_parameter": worst,
            "worst_rms_percent": s.rms[worst],
            "median_rms_percent": float(np.median(list(s.rms.values()))),
            "coverage95": s.coverage,
            "biased": list(s.biased),
        }
    if s.verdicts:
        summary["verdicts"] = dict(s.verdicts)
    return summary


def study_figure(results: Sequence[CellResult], title: str) -> Figure:
    """Plot cell by cell: errors and coverage of the parameters, or verdicts, or else the drives' condition numbers."""
    swept = swept_quantity(results)
    if swept is not None and all(s.rms for s in results):
        return _swept_figure(results, *swept, title)
    n, narrow = len(results), reports.is_narrow(11.5)
    names = [reports.wrap_label(name, CELL_LETTERS_NARROW if narrow else CELL_LETTERS) for name in cell_labels(results)]
    rows = sum(0.16 + 0.14 * (1 + name.count("\n")) for name in names) if n <= MAX_NAMED else 0.3 * MAX_NAMED + 2.5
    both = narrow and any(s.rms for s in results)
    fig = reports.new_figure(11.5, 1.6 + (2 * rows + 0.6 if both else rows))
    reports.set_title(fig, title)
    y = np.arange(n)
    if any(s.rms for s in results):
        left, right = fig.subplots(2, 1) if narrow else fig.subplots(1, 2, sharey=True, width_ratios=(2, 1))
        for k, s in enumerate(results):
            if s.rms:
                left.plot(list(s.rms.values()), [k] * len(s.rms), "o", color=COLOURS[0], markersize=3, alpha=0.5)
                left.plot(np.median(list(s.rms.values())), k, "D", color=COLOURS[1], markersize=5)
                right.plot(100 * s.coverage, k, "D", color=COLOURS[1], markersize=5)
        left.set_xscale("log")
        label = "error of each parameter, rms over the runs [%]; diamond: median"
        left.set_xlabel(reports.wrap_label(label, 34 if narrow else 44))
        left.xaxis.set_major_formatter("{x:g}")
        right.axvline(95, color="black", linewidth=0.8, linestyle=(0, (2, 3)))
        right.set_xlim(-3, 103)
        right.set_xlabel("95 % intervals that hold [%]")
        axes = [left, right]
    elif any(s.verdicts for s in results):
        only = fig.subplots()
        kinds, base = ("clean", "named", "tied", "unexplained"), np.zeros(n)
        for k, kind in enumerate(kinds):
            share = np.array([100 * s.verdicts.get(kind, 0) / max(1, sum(s.statuses.values())) for s in results])
            hatch = ("", "//", "..", "xx")[k]
            only.barh(y, share, left=base, color=COLOURS[k], hatch=hatch, edgecolor="white", label=kind, height=0.6)
            base += share
        only.set_xlabel("verdicts [% of the runs]")
        reports.legend_below(fig, *only.get_legend_handles_labels())
        axes = [only]
    else:
        only = fig.subplots()
        score = [np.nan if s.cond_phi is None else s.cond_phi for s in results]
        only.barh(y, score, color=COLOURS[0], height=0.6)
        only.set_xlabel("cond(Phi) of the drive")
        axes = [only]
    for ax in axes if both else axes[:1]:
        if n <= MAX_NAMED:
            ax.set_yticks(y, names, fontsize=8)
        else:
            ax.set_ylabel("cell")
        ax.set_ylim(n - 0.4, -0.6)
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.tick_params(labelsize=8)
    return fig


def swept_quantity(results: Sequence[CellResult]) -> tuple[str, list[float]] | None:
    """Return the one number in which the cells differ, with its unit, and each cell's value; None if it is not one."""
    parts = [_cell_axes(s) for s in results]
    varied = [k for k in parts[0] if len({p[k] for p in parts}) > 1] if parts else []
    drives = [s.cell.drive for s in results]
    numbers: dict[str, tuple[str, list[float]]] = {
        "duration": ("duration of the drive [s]", [float(d.duration_s or np.nan) for d in drives]),
        "starts": ("random starts of the design [-]", [float(d.starts) for d in drives]),
    }
    if all(len(d.limits) == 1 for d in drives) and len({d.limits[0][0] for d in drives}) == 1:
        numbers["limits"] = (f"factor of {drives[0].limits[0][0]} [-]", [d.limits[0][1] for d in drives])
    if len(varied) != 1 or varied[0] not in numbers:
        return None
    label, values = numbers[varied[0]]
    return (label, values) if len(values) >= MIN_SWEPT and np.isfinite(values).all() else None


def _swept_figure(results: Sequence[CellResult], label: str, values: Sequence[float], title: str) -> Figure:
    """Plot errors of the parameters and coverage over the one number that a study varies."""
    narrow = reports.is_narrow(11.5)
    fig = reports.new_figure(11.5, 6.4 if narrow else 4.4)
    reports.set_title(fig, title)
    errors, cover = fig.subplots(2, 1) if narrow else fig.subplots(1, 2, width_ratios=(2, 1))
    order = np.argsort(values)
    x, cells = np.array(values)[order], [results[k] for k in order]
    for at, s in zip(x, cells, strict=True):
        errors.plot([at] * len(s.rms), list(s.rms.values()), "o", color=COLOURS[0], markersize=3, alpha=0.5)
    median = [float(np.median(list(s.rms.values()))) for s in cells]
    errors.plot(x, median, "D-", color=COLOURS[1], markersize=5, label="median parameter")
    errors.plot(x, [max(s.rms.values()) for s in cells], "s--", color=COLOURS[2], markersize=5, label="worst parameter")
    errors.set_yscale("log")
    errors.yaxis.set_major_formatter("{x:g}")
    errors.set_ylabel("error, rms over the runs [%]", fontsize=9)
    cover.plot(x, [100 * s.coverage for s in cells], "D-", color=COLOURS[1], markersize=5)
    cover.axhline(95, color="black", linewidth=0.8, linestyle=(0, (2, 3)))
    cover.set_ylim(0, 103)
    cover.set_ylabel("95 % intervals that hold [%]", fontsize=9)
    for ax in (errors, cover):
        ax.set_xlabel(label, fontsize=9)
        ax.tick_params(which="both", labelsize=8)
        ax.grid(alpha=0.3)
    reports.legend_below(fig, *errors.get_legend_handles_labels())
    return fig


def write_report(plan: StudyPlan, results: Sequence[CellResult], summary: Mapping[str, Any], place: Path) -> None:
    """Write figure, report and summary of a study into its folder."""
    title = plan.study.title or plan.study.name
    reports.save(study_figure(results, f"{title}: {count(summary['runs'], 'run')}"), place / FIGURE)
    reports.write_report(place, "study", summary)
