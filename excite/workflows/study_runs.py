"""One run of a study: simulate a drive, measure a log, identify or diagnose from it. Pure functions for any worker."""

from __future__ import annotations

import hashlib
import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from excite import identification, interrupt, simulation
from excite.errors import InfeasibleError, LogError, MachineError, NoEstimateError, SimulationError
from excite.logs import Log, examine, prepare, profile_of
from excite.model import Model, build, build_cached
from excite.model.machine import Machine, Problem
from excite.simulation import Motion, play_back
from excite.workflows import design_request
from excite.workflows.design_request import DesignRequest

DONE, FAILED, DEFECT = STATUSES = ("done", "failed", "defect")
Row = dict[str, Any]
ESTIMATE_COLUMNS = ("value", "std", "low95", "high95")  # of every parameter
_CASADI_LOCK = threading.Lock()  # CasADi's functions are not safe in the threads of a cluster's worker


@dataclass(frozen=True)
class TorqueInput:
    """Torques (N, n_u) [N m] as bytes of float64, and the state q0, nu0 (n_q,) at their start.

    planned: positions and speeds (2, N, n_q) that an arm follows, as bytes of float64, empty for torques alone.
    """

    torque: bytes
    inputs: int
    q0: tuple[float, ...]
    nu0: tuple[float, ...]
    planned: bytes = b""


@dataclass(frozen=True)
class RunInputs:
    """Inputs that all runs of a cell share.

    known: the machine that identification knows (JSON).
    true: the machine that is simulated, with its effects (JSON).
    """

    known: str
    true: str
    drive: TorqueInput
    steps: tuple[str, ...]
    kit: str
    method: str


@dataclass(frozen=True)
class Run:
    """A run by its number in the study, and the seed of its sensor noise."""

    inputs: RunInputs
    number: int
    seed: int


@dataclass(frozen=True)
class RunOutcome:
    """Row of a run, the time [s] it took, and `program_hash` of the worker that computed it."""

    row: Row
    seconds: float
    program: str


@lru_cache(maxsize=4)
def _motion(machine: str, drive: TorqueInput) -> Motion:
    torque = np.frombuffer(drive.torque).reshape(-1, drive.inputs)
    planned = None
    if drive.planned:
        q, nu = np.frombuffer(drive.planned).reshape(2, len(torque), -1)
        planned = q, nu
    return play_back(build_cached(machine), torque, np.array(drive.q0), np.array(drive.nu0), planned)


def run_once(run: Run) -> RunOutcome:
    """Compute one run; its row has a status, the reason if it failed, and the results of its steps.

    Status `failed`: no estimate, no motion, or a log or machine that can't be used. Status `defect`: any other error,
    which does not end the study. Raises KeyboardInterrupt on Ctrl-C.
    """
    with _CASADI_LOCK:
        begin = time.perf_counter()
        row = interrupt.call_interruptible(_run_with_status, run)
        return RunOutcome(row, time.perf_counter() - begin, program_hash())


def _run_with_status(run: Run) -> Row:
    try:
        return {"status": DONE} | _run_steps(run.inputs, run.seed)
    except (NoEstimateError, SimulationError, LogError, MachineError) as err:
        return {"status": FAILED, "reason": _one_line(err)}
    except Exception as err:
        return {"status": DEFECT, "reason": f"{type(err).__name__}: {_one_line(err)}"}


def _one_line(err: Exception) -> str:
    return " ".join(str(err).split())[:500]


def _run_steps(inputs: RunInputs, seed: int) -> Row:
    known, steps = build_cached(inputs.known), set(inputs.steps)
    row: Row = {}
    if not steps & {"simulate", "identify", "verify", "diagnose"}:
        return row
    table = simulation.measure(build_cached(inputs.true), _motion(inputs.true, inputs.drive), kit=inputs.kit, seed=seed)
    row["log_sha256"] = hashlib.sha256(table.to_numpy(float).tobytes()).hexdigest()[:16]
    if steps & {"identify", "verify"}:
        estimate = identification.identify_table(known, table, inputs.method)
        arrays = (estimate.value, estimate.std, *estimate.noise_interval95)
        row |= {name: _json_value(array.tolist()) for name, array in zip(ESTIMATE_COLUMNS, arrays, strict=True)}
        row["relative_error_percent"] = _json_value(estimate.relative_error_percent)
    if "diagnose" in steps:
        ready = prepare(known, [table], identification.needed_sensors(known, "joint"))
        row |= _diagnose(ready.model, ready.logs)
    return row


def _diagnose(model: Model, logs: Sequence[Log]) -> Row:
    """Diagnose logs; return the keys of the summary that go into the table of runs."""
    from excite import diagnosis

    repaired = [examine(model.machine, one).log for one in logs]
    summary = diagnosis.summarise(diagnosis.explain(model, repaired, model.machine.filter))
    keys = ("effect", "where", "tied_with", "p_value", "amount", "amount_std", "unit", "gain_percent", "gain_ci95")
    return {
        "verdict": summary["verdict"],
        "findings": [{k: _json_value(one.get(k)) for k in keys} for one in summary["findings"]],
        "error_before_percent": _json_value(summary["error_before_percent"]),
        "error_after_percent": _json_value(summary["error_after_percent"]),
    }


def _json_value(value: Any) -> Any:
    """Return a value for JSON; a number that is not finite becomes None."""
    if isinstance(value, list | tuple):
        return [_json_value(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


@dataclass(frozen=True)
class DesignJob:
    """A design to be computed: drive `number`, for a machine (JSON) and its problem `name`."""

    number: int
    machine: str
    name: str
    problem: Problem
    objective: str
    starts: int
    seed: int
    budget_s: float | None = None


@dataclass(frozen=True)
class DesignOutcome:
    """Profile (CSV) and summary of a design, or the reason of its failure."""

    profile: str
    summary: dict[str, Any]
    failure: str | None = None


def design_drive(job: DesignJob) -> DesignOutcome:
    """Design a drive of a study. Raises KeyboardInterrupt if the search was cut short."""
    return interrupt.call_interruptible(_design_drive, job)


def _design_drive(job: DesignJob) -> DesignOutcome:
    request = DesignRequest(job.objective, starts=job.starts, seed=job.seed, budget_s=job.budget_s, other_end=False)
    try:
        model = build(
            Machine.model_validate_json(job.machine), fit_sensor_effects=False
        )  # no drive shows what sits in a sensor
        result = design_request.design_from(model, job.problem, request)
    except (InfeasibleError, SimulationError, NoEstimateError, MachineError) as err:
        return DesignOutcome("", {}, _one_line(err))
    except np.linalg.LinAlgError:
        return DesignOutcome("", {}, design_request.singular_message(job.name))
    except Exception as err:
        return DesignOutcome("", {}, f"{DEFECT}: {type(err).__name__}: {_one_line(err)}")
    if not result.design.complete and job.budget_s is None:
        raise KeyboardInterrupt
    if result.assumed_noise:  # runs of a study are simulated with the machine file's noise
        return DesignOutcome("", {}, f"the machine file gives no noise of {', '.join(result.assumed_noise)}: add it")
    summary = {
        "machine": model.machine.name,
        "problem": job.name,
        "duration_s": float(job.problem.duration_s),
        **design_request.summarise_result(request, result),
    }
    return DesignOutcome(profile_of(result.model, result.design.motion).to_csv(index=False), summary)


@lru_cache(maxsize=1)
def program_hash() -> str:
    """Return 16 digits that change with the program's files: one table never mixes rows of two programs."""
    seen = hashlib.sha256()
    package = Path(__file__).parents[1]
    for part in (package, package / "model"):  # the second is a link in a checkout, which rglob doesn't follow
        for file in sorted([*part.rglob("*.py"), *part.rglob("*.toml")]):
            seen.update(str(file.relative_to(part)).encode() + file.read_bytes())
    return seen.hexdigest()[:16]
