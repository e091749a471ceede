"""Studies: thousands of runs on one machine or a cluster, and nothing lost.

Drives are designed first; then runs are spread over the workers in batches. Workers only compute. This process alone
writes: rows to a store (`store`) that survives any end, drives as whole folders. When all are there, the results appear
as one folder: `runs.parquet` (a row a run, with all that is needed to repeat it), `summary.json`, figure, report, the
drives and the machines' files. A study that is given again goes on where it was.
"""

from __future__ import annotations

import errno
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from excite import logs, output
from excite.errors import FolderError, RowStoreError, StudyError, WorkerError
from excite.model import build_cached, effects
from excite.model.machine import Machine, shipped_machines
from excite.workflows import executors, requests, row_store, study_results, study_runs as cells
from excite.workflows.executors import Pool
from excite.workflows.row_store import Store
from excite.workflows.study_plan import Cell, Drive, Plan
from excite.workflows.study_runs import DEFECT, FAILED, Designed, Driven, Order, Work

__all__ = ["EngineError", "StoreError", "StudyError", "place_of", "run_study"]

BATCH = 0.5  # s of work in a batch: a store's transaction costs a hundredth of that
LARGEST = 256  # runs in a batch
DRIVES = "drives"
Progress = Callable[[int, int, str], None]


def run_study(
    wanted: Plan,
    out: Path,
    jobs: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Carries a study out, or on, and writes its folder; returns its summary.

    jobs: processes, all cores by default; cluster: address of a Dask scheduler instead. The same study gives the same
    table, byte by byte, whatever they are. progress(done, total, what) is called as things are done.

    Raises FolderError for a place that can't be used, EngineError and StoreError where workers or disk give up: what
    is done is kept, and the same call goes on. KeyboardInterrupt likewise.
    """
    tell = progress or (lambda done, total, what: None)
    finger = hashlib.sha256(f"{wanted.fingerprint} {cells.program()} {requests.versions()}".encode()).hexdigest()
    place = place_of(out)
    before = _finished(out, finger)
    if before is not None:
        shutil.rmtree(place, ignore_errors=True)
        return before
    output.check_out_folder(out, _inputs(wanted))
    try:
        (place / DRIVES).mkdir(parents=True, exist_ok=True)
        with row_store.opened(place / "runs.sqlite", finger) as kept:
            output.remove_partial_folders(out)
            _design(wanted, place / DRIVES, kept, cluster, tell)
            _run(wanted, place / DRIVES, kept, jobs, cluster, tell)
            tell(wanted.total, wanted.total, "writing")
            with output.new_folder(out) as partial:
                summary = _write(wanted, place / DRIVES, kept, partial, finger)
    except OSError as err:
        if err.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG):
            raise
        raise RowStoreError(
            f"{err.filename or out}: can't be written: {err.strerror}; what was kept is safe, mend that and repeat the"
            " command"
        ) from None
    shutil.rmtree(place, ignore_errors=True)
    return summary


def place_of(out: Path) -> Path:
    """The hidden folder beside `out` in which a study is kept while it is under way."""
    return out.absolute().parent / f".{out.name}.study"


def _inputs(wanted: Plan) -> list[Path]:
    own = [wanted.base / n for n in wanted.machines if n not in shipped_machines()]
    return own + [wanted.base / d.profile for d in wanted.drives if d.profile is not None]


def _finished(out: Path, finger: str) -> dict[str, Any] | None:
    """The summary of a folder that holds this study whole. Raises FolderError where it holds another one."""
    path = out / output.SUMMARY
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(found, dict) or "fingerprint" not in found:
        return None
    if found["fingerprint"] != finger:
        raise FolderError(f"{out}: holds another study, or one of another version; choose another --out or delete it")
    return dict(found)


# ------------------------------------------------------------------------------------------------ drives


def _name(number: int) -> str:
    return f"{number + 1:04d}"


def _design(wanted: Plan, place: Path, kept: Store, cluster: str | None, tell: Progress) -> None:
    """Makes the drives that aren't there yet, each a whole folder."""
    known = kept.failures()
    missing = [k for k in range(len(wanted.drives)) if k not in known and not (place / _name(k)).is_dir()]
    done = len(wanted.drives) - len(missing)
    orders = []
    for k in missing:
        drive = wanted.drives[k]
        if drive.profile is not None:
            with output.new_folder(place / _name(k)) as partial:
                (partial / "profile.csv").write_bytes((wanted.base / drive.profile).read_bytes())
            done += 1
        else:
            orders.append(_order(wanted, k, drive))
    if not orders:
        return
    tell(done, len(wanted.drives), "designing")
    for order, made in _made(orders, cluster):
        if made.failure is not None:
            kept.fail(order.number, made.failure)
        else:
            with output.new_folder(place / _name(order.number)) as partial:
                (partial / "profile.csv").write_text(made.profile, encoding="utf-8")
                (partial / "machine.json").write_text(order.machine + "\n", encoding="utf-8")
                output.write_summary(partial, made.summary | {"versions": requests.versions()})
        done += 1
        tell(done, len(wanted.drives), "designing")


def _order(wanted: Plan, number: int, drive: Drive) -> Order:
    machine = wanted.designed(drive)
    name, problem = requests.choose_problem(machine, drive.problem, drive.duration_s)
    text = machine.model_dump_json(indent=1)
    return Order(number, text, name, problem, drive.objective, drive.starts, drive.seed)


def _made(orders: list[Order], cluster: str | None) -> Iterator[tuple[Order, Designed]]:
    """On this machine one after the other, as a design itself takes every core; on a cluster side by side."""
    if cluster is None:
        for order in orders:
            yield order, cells.designed(order)
        return
    with executors.pool(cluster=cluster) as workers:
        for result in executors.spread(cells.designed, orders, workers):
            yield result.piece, result.value or Designed("", {}, f"{DEFECT}: the search killed its worker")


@dataclass(frozen=True)
class Track:
    """A drive that is there: what is driven, for how long [s], and the design's summary (empty for a profile)."""

    driven: Driven
    duration_s: float
    summary: dict[str, Any]


def _track(wanted: Plan, place: Path, number: int) -> Track:
    drive = wanted.drives[number]
    model = build_cached(wanted.machines[drive.machine].model_dump_json())
    torque, q0, nu0 = logs.read_profile(place / _name(number) / "profile.csv", model)
    driven = Driven(np.ascontiguousarray(torque, float).tobytes(), torque.shape[1], tuple(q0), tuple(nu0))
    path = place / _name(number) / output.SUMMARY
    summary = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return Track(driven, (len(torque) - 1) / float(model.machine.sampling_hz), summary)


# ------------------------------------------------------------------------------------------------ runs


@dataclass
class _Pace:
    """How many runs make a batch: from how long they take."""

    size: int = 1

    def learn(self, runs: int, seconds: float) -> None:
        if seconds > 0:
            self.size = int(min(LARGEST, max(1, BATCH * runs / seconds)))


def _run(wanted: Plan, place: Path, kept: Store, jobs: int | None, cluster: str | None, tell: Progress) -> None:
    """Computes the runs that aren't kept yet."""
    there = kept.numbers()
    done, total = len(there), wanted.total
    tell(done, total, "running")
    if done == total:
        return
    pace = _Pace()
    with executors.pool(jobs, cluster) as workers:
        for result in executors.spread(cells.carry, _works(wanted, place, kept, there, pace), workers, _split):
            rows = _rows(result.piece, result.value, workers)
            kept.keep(rows, result.seconds)
            pace.learn(len(rows), result.seconds)
            done += len(rows)
            tell(done, total, "running")
    # those without a drive
    for number, reason in kept.failures().items():
        for c, cell in enumerate(wanted.cells):
            if wanted.number[cell.drive] == number:
                numbers = range(c * wanted.study.runs, (c + 1) * wanted.study.runs)
                status = DEFECT if reason.startswith(DEFECT) else FAILED
                kept.keep((n, {"status": status, "reason": f"no drive: {reason}"}) for n in numbers if n not in there)
    tell(total, total, "running")


def _rows(work: Work, value: tuple[str, list[tuple[int, cells.Row]]] | None, workers: Pool) -> list[Any]:
    if value is None:
        return [(n, {"status": DEFECT, "reason": "killed the worker that computed it"}) for n, _ in work.runs]
    program, rows = value
    if workers.foreign and program != cells.program():
        raise WorkerError("a worker of the cluster has another version of the program: install the same everywhere")
    return rows


def _split(work: Work) -> list[Work]:
    return [replace(work, runs=(one,)) for one in work.runs]


def _works(wanted: Plan, place: Path, kept: Store, there: set[int], pace: _Pace) -> Iterator[Work]:
    """The runs that are missing, as batches of one cell each, made as they are asked for."""
    failed, runs = kept.failures(), wanted.study.runs
    track = lru_cache(maxsize=4)(lambda k: _track(wanted, place, k))
    for c, cell in enumerate(wanted.cells):
        number = wanted.number[cell.drive]
        missing = [r for r in range(runs) if c * runs + r not in there]
        if number in failed or not missing:
            continue
        whole, seeds = _work(wanted, cell, track(number)), wanted.seeds(cell)
        while missing:
            now, missing = missing[: pace.size], missing[pace.size :]
            yield replace(whole, runs=tuple((c * runs + r, int(seeds[r])) for r in now))


def _work(wanted: Plan, cell: Cell, track: Track) -> Work:
    machine = wanted.machines[cell.drive.machine]
    true: Machine = machine
    if cell.effects:
        entries = [effects.parse_effect(text, machine, track.duration_s) for text in cell.effects]
        true = effects.with_effects(machine, *entries)
    known = machine.model_dump_json()
    return Work(known, true.model_dump_json(), track.driven, wanted.study.steps, cell.kit, wanted.method(cell), ())


# ------------------------------------------------------------------------------------------------ results


def _write(wanted: Plan, drives: Path, kept: Store, partial: Path, finger: str) -> dict[str, Any]:
    """The folder of a study that is complete; returns its summary."""
    counted = len(kept.numbers())
    if counted != wanted.total:
        raise RuntimeError(f"{counted} of {wanted.total} runs are there: a defect of the program")
    shutil.copytree(drives, partial / DRIVES, ignore=shutil.ignore_patterns(".*"))
    own: dict[str, str] = {}
    for name, texts in wanted.texts.items():
        own[name] = name
        if texts:
            sha = hashlib.sha256("".join(texts.values()).encode()).hexdigest()[:8]
            (partial / "machines" / sha).mkdir(parents=True, exist_ok=True)
            for file, text in texts.items():
                (partial / "machines" / sha / file).write_text(text, encoding="utf-8")
            own[name] = f"machines/{sha}/{next(iter(texts))}"
    tracks = lru_cache(maxsize=8)(lambda k: _track(wanted, drives, k))
    failed = kept.failures()
    seen = study_results.write_table(
        wanted, kept.rows(), lambda k: None if k in failed else tracks(k), own, requests.versions(), partial
    )
    (partial / "study.json").write_text(wanted.study.model_dump_json(indent=1) + "\n", encoding="utf-8")
    summary = {
        "study": wanted.study.name,
        "title": wanted.study.title,
        "steps": list(wanted.study.steps),
        "runs": wanted.total,
        **study_results.summary(seen),
        "failed_drives": {_name(k): reason for k, reason in failed.items()},
        "compute_s": kept.seconds,
        "fingerprint": finger,
        "program": cells.program(),
        "versions": requests.versions(),
    }
    study_results.draw(wanted, seen, summary, partial)
    output.write_summary(partial, summary)
    return summary
