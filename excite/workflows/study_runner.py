"""Carry out a study of thousands of runs on one machine or a cluster, and resume it after any interruption.

Drives are designed first, then the runs go to the workers (`study_workers`). Only this process writes: rows to a store
(`row_store`) that survives a kill, drives as whole folders. When every run is stored, the results appear as one folder:
`runs.parquet` (one row per run, with its command), `summary.json`, figure, report, the drives and the machine files.
"""

from __future__ import annotations

import errno
import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from excite import logs, output
from excite.errors import FolderError, RowStoreError, WorkerError
from excite.model import build_cached, effects
from excite.model.machine import Machine, shipped_machines
from excite.workflows import requests, row_store, study_results, study_runs, study_workers
from excite.workflows.row_store import RowStore
from excite.workflows.study_plan import Cell, DriveSpec, StudyPlan
from excite.workflows.study_runs import DEFECT, FAILED, DesignJob, DesignOutcome, Run, RunInputs, TorqueInput

DRIVES = "drives"
Progress = Callable[[int, int, str], None]  # done, total, what is being done


def run_study(
    plan: StudyPlan,
    out: Path,
    jobs: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Carry out a study, or resume it, and write its folder; return its summary.

    jobs: processes, all cores by default. cluster: address of a Dask scheduler instead of processes. The table has the
    same bytes for any of them. progress(done, total, what) is called as drives and runs are done.

    Raises FolderError for a folder that can't be used, WorkerError if the workers are lost, RowStoreError if the disk
    fails. After these and KeyboardInterrupt the rows are kept, and the same call resumes.
    """
    report = progress or (lambda done, total, what: None)
    fingerprint = hashlib.sha256(
        f"{plan.fingerprint} {study_runs.program_hash()} {requests.package_versions()}".encode()
    ).hexdigest()
    folder = working_folder(out)
    before = _finished_summary(out, fingerprint)
    if before is not None:
        shutil.rmtree(folder, ignore_errors=True)
        return before
    output.check_out_folder(out, _inputs(plan))
    try:
        (folder / DRIVES).mkdir(parents=True, exist_ok=True)
        with row_store.open_store(folder / "runs.sqlite", fingerprint) as store:
            output.remove_partial_folders(out)
            _design_drives(plan, folder / DRIVES, store, cluster, report)
            _compute_runs(plan, folder / DRIVES, store, jobs, cluster, report)
            report(plan.total, plan.total, "writing")
            with output.new_folder(out) as partial:
                summary = _write_folder(plan, folder / DRIVES, store, partial, fingerprint)
    except OSError as err:
        if err.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG):
            raise
        raise RowStoreError(
            f"{err.filename or out}: can't be written: {err.strerror}; the rows so far are safe, correct this and"
            " repeat the command"
        ) from None
    shutil.rmtree(folder, ignore_errors=True)
    return summary


def working_folder(out: Path) -> Path:
    """Return the hidden folder beside `out` that holds a study until it is complete."""
    return out.absolute().parent / f".{out.name}.study"


def _inputs(plan: StudyPlan) -> list[Path]:
    own = [plan.base / n for n in plan.machines if n not in shipped_machines()]
    return own + [plan.base / d.profile for d in plan.drives if d.profile is not None]


def _finished_summary(out: Path, fingerprint: str) -> dict[str, Any] | None:
    """Return the summary of a folder that holds this study complete. Raises FolderError for another study's folder."""
    path = out / output.SUMMARY
    if not path.is_file():
        return None
    try:
        found = output.read_json(path)
    except (OSError, ValueError):
        return None
    if not isinstance(found, dict) or "fingerprint" not in found:
        return None
    if found["fingerprint"] != fingerprint:
        raise FolderError(f"{out}: holds another study, or one of another version; choose another --out or delete it")
    return dict(found)


# ------------------------------------------------------------------------------------------------ drives


def _drive_name(number: int) -> str:
    return f"{number + 1:04d}"


def _design_drives(plan: StudyPlan, folder: Path, store: RowStore, cluster: str | None, progress: Progress) -> None:
    """Make the missing drives, each as a whole folder."""
    known = store.failures()
    missing = [k for k in range(len(plan.drives)) if k not in known and not (folder / _drive_name(k)).is_dir()]
    done = len(plan.drives) - len(missing)
    job_list = []
    for k in missing:
        drive = plan.drives[k]
        if drive.profile is not None:
            with output.new_folder(folder / _drive_name(k)) as partial:
                (partial / "profile.csv").write_bytes(logs.drive_file(plan.base / drive.profile).read_bytes())
            done += 1
        else:
            job_list.append(_design_job(plan, k, drive))
    if not job_list:
        return
    progress(done, len(plan.drives), "designing")
    for job, made in _run_design_jobs(job_list, cluster):
        if made.failure is not None:
            store.add_failure(job.number, made.failure)
        else:
            with output.new_folder(folder / _drive_name(job.number)) as partial:
                (partial / "profile.csv").write_text(made.profile, encoding="utf-8")
                (partial / "machine.json").write_text(job.machine + "\n", encoding="utf-8")
                output.write_summary(partial, made.summary | {"versions": requests.package_versions()})
        done += 1
        progress(done, len(plan.drives), "designing")


def _design_job(plan: StudyPlan, number: int, drive: DriveSpec) -> DesignJob:
    machine = plan.design_machine(drive)
    name, problem = requests.choose_problem(machine, drive.problem, drive.duration_s)
    text = machine.model_dump_json(indent=1)
    return DesignJob(number, text, name, problem, drive.objective, drive.starts, drive.seed, plan.study.budget_s)


def _run_design_jobs(job_list: list[DesignJob], cluster: str | None) -> Iterator[tuple[DesignJob, DesignOutcome]]:
    """Design drives: here one after the other, as a design takes every core; on a cluster in parallel."""
    if cluster is None:
        for job in job_list:
            yield job, study_runs.design_drive(job)
        return
    for job, made in study_workers.compute(study_runs.design_drive, job_list, cluster=cluster):
        yield job, made or DesignOutcome("", {}, f"{DEFECT}: the search killed its worker")


@dataclass(frozen=True)
class StoredDrive:
    """A drive on disk: torques, duration [s], and the design's summary (empty for a profile)."""

    torque: TorqueInput
    duration_s: float
    summary: dict[str, Any]


def _stored_drive(plan: StudyPlan, folder: Path, number: int) -> StoredDrive:
    drive = plan.drives[number]
    model = build_cached(plan.machines[drive.machine].model_dump_json())
    planned = logs.read_drive(folder / _drive_name(number) / "profile.csv", model)
    torque, expected = planned.torque, planned.planned
    stored = TorqueInput(
        np.ascontiguousarray(torque, float).tobytes(),
        torque.shape[1],
        tuple(planned.q0),
        tuple(planned.nu0),
        b"" if expected is None else np.array(expected, float).tobytes(),
    )
    path = folder / _drive_name(number) / output.SUMMARY
    summary = output.read_json(path) if path.is_file() else {}
    return StoredDrive(stored, (len(torque) - 1) / float(model.machine.sampling_hz), summary)


# ------------------------------------------------------------------------------------------------ runs


def _compute_runs(
    plan: StudyPlan, folder: Path, store: RowStore, jobs: int | None, cluster: str | None, progress: Progress
) -> None:
    """Compute and store the missing runs."""
    there, failed = store.numbers(), store.failures()
    done, total = len(there), plan.total
    progress(done, total, "running")
    missing = _missing_runs(plan, folder, there, failed)
    with closing(study_workers.compute(study_runs.run_once, missing, jobs, cluster)) as outcomes:
        for run, outcome in outcomes:
            if outcome is None:
                store.add(run.number, {"status": DEFECT, "reason": "killed the worker that computed it"})
            elif outcome.program != study_runs.program_hash():
                raise WorkerError("a worker has another version of the program: install the same everywhere")
            else:
                store.add(run.number, outcome.row, outcome.seconds)
            done += 1
            progress(done, total, "running")
    for c, cell in enumerate(plan.cells):
        reason = failed.get(plan.number[cell.drive])
        if reason is not None:
            status = DEFECT if reason.startswith(DEFECT) else FAILED
            for number in _missing_numbers(plan, c, there):
                store.add(number, {"status": status, "reason": f"no drive: {reason}"})
    progress(total, total, "running")


def _missing_numbers(plan: StudyPlan, c: int, there: set[int]) -> list[int]:
    """Return the numbers of the runs of cell c that are not stored."""
    return [n for n in range(c * plan.study.runs, (c + 1) * plan.study.runs) if n not in there]


def _missing_runs(plan: StudyPlan, folder: Path, there: set[int], failed: dict[int, str]) -> Iterator[Run]:
    """Yield the runs that are not stored, cell by cell, except those without a drive."""
    stored = lru_cache(maxsize=4)(lambda k: _stored_drive(plan, folder, k))
    for c, cell in enumerate(plan.cells):
        drive, numbers = plan.number[cell.drive], _missing_numbers(plan, c, there)
        if drive not in failed and numbers:
            inputs, seeds = _run_inputs(plan, cell, stored(drive)), plan.seeds(cell)
            yield from (Run(inputs, n, int(seeds[n % plan.study.runs])) for n in numbers)


def _run_inputs(plan: StudyPlan, cell: Cell, drive: StoredDrive) -> RunInputs:
    machine = plan.machines[cell.drive.machine]
    true: Machine = machine
    if cell.effects:
        entries = [effects.parse_effect(text, machine, drive.duration_s) for text in cell.effects]
        true = effects.with_effects(machine, *entries)
    known = machine.model_dump_json()
    return RunInputs(known, true.model_dump_json(), drive.torque, plan.study.steps, cell.kit, plan.method(cell))


# ------------------------------------------------------------------------------------------------ results


def _write_folder(plan: StudyPlan, drives: Path, store: RowStore, partial: Path, fingerprint: str) -> dict[str, Any]:
    """Write the folder of a complete study; return its summary."""
    counted = len(store.numbers())
    if counted != plan.total:
        raise RuntimeError(f"{counted} of {plan.total} runs are there: a defect of the program")
    shutil.copytree(drives, partial / DRIVES, ignore=shutil.ignore_patterns(".*"))
    own: dict[str, str] = {}
    for name, texts in plan.texts.items():
        own[name] = name
        if texts:
            sha = hashlib.sha256("".join(texts.values()).encode()).hexdigest()[:8]
            (partial / "machines" / sha).mkdir(parents=True, exist_ok=True)
            for file, text in texts.items():
                (partial / "machines" / sha / file).write_text(text, encoding="utf-8")
            own[name] = f"machines/{sha}/{next(iter(texts))}"
    stored = lru_cache(maxsize=8)(lambda k: _stored_drive(plan, drives, k))
    failed = store.failures()
    results = study_results.write_table(
        plan, store.rows(), lambda k: None if k in failed else stored(k), own, requests.package_versions(), partial
    )
    (partial / "study.json").write_text(plan.study.model_dump_json(indent=1) + "\n", encoding="utf-8")
    summary = {
        "study": plan.study.name,
        "title": plan.study.title,
        "steps": list(plan.study.steps),
        "runs": plan.total,
        **study_results.summarise_cells(results),
        "failed_drives": {_drive_name(k): reason for k, reason in failed.items()},
        "compute_s": store.seconds,
        "fingerprint": fingerprint,
        "program": study_runs.program_hash(),
        "versions": requests.package_versions(),
    }
    study_results.write_report(plan, results, summary, partial)
    return summary
