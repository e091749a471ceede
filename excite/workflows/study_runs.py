"""What one run of a study does: a drive in simulation, its log, what is found in the log. Pure, for any worker."""

from __future__ import annotations

import hashlib
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from excite import identification, interrupt, simulation
from excite.errors import InfeasibleError, LogError, MachineError, NoEstimateError, SimulationError
from excite.logs import Log, examine, from_table, profile_of
from excite.model import Model, build, build_cached
from excite.model.machine import Machine, Problem
from excite.simulation import Motion, simulate
from excite.workflows import design_request
from excite.workflows.design_request import Brief

DONE, FAILED, DEFECT = STATUSES = ("done", "failed", "defect")
Row = dict[str, Any]
ESTIMATES = ("value", "std", "low95", "high95")  # told of every parameter
_ALONE = threading.Lock()  # CasADi's functions are not made for the threads of a cluster's worker


@dataclass(frozen=True)
class Driven:
    """Torques (N, n_u) [N m] as bytes of float64, and the state q0, nu0 (n_q,) that they start from."""

    torque: bytes
    inputs: int
    q0: tuple[float, ...]
    nu0: tuple[float, ...]


@dataclass(frozen=True)
class Work:
    """Some runs of one cell. known: the machine that identification knows; true: the one that drives, with its effects
    (both as JSON); runs: number and seed of each."""

    known: str
    true: str
    driven: Driven
    steps: tuple[str, ...]
    kit: str
    method: str
    runs: tuple[tuple[int, int], ...]


@lru_cache(maxsize=4)
def _motion(machine: str, driven: Driven) -> Motion:
    torque = np.frombuffer(driven.torque).reshape(-1, driven.inputs)
    return simulate(build_cached(machine), torque, q0=np.array(driven.q0), nu0=np.array(driven.nu0))


def carry(work: Work) -> tuple[str, list[tuple[int, Row]]]:
    """The runs of a piece of work, in order: this worker's `program`; number and row of each (see `run`)."""
    with _ALONE:
        return program(), [(number, run(work, seed)) for number, seed in work.runs]


def run(work: Work, seed: int) -> Row:
    """One run: status, reason where it failed, and what its steps found.

    A failure of the method (no estimate, no motion, a log or a machine that can't be used) is `failed`; any other error
    is a defect of the program, which is told as such and doesn't end the study. Raises KeyboardInterrupt for one that
    came meanwhile, in whatever guise.
    """
    return interrupt.call_interruptible(_judged, work, seed)


def _judged(work: Work, seed: int) -> Row:
    try:
        return {"status": DONE} | _run(work, seed)
    except (NoEstimateError, SimulationError, LogError, MachineError) as err:
        return {"status": FAILED, "reason": _said(err)}
    except Exception as err:
        return {"status": DEFECT, "reason": f"{type(err).__name__}: {_said(err)}"}


def _said(err: Exception) -> str:
    return " ".join(str(err).split())[:500]


def _run(work: Work, seed: int) -> Row:
    known, steps = build_cached(work.known), set(work.steps)
    row: Row = {}
    if not steps & {"simulate", "identify", "verify", "diagnose"}:
        return row
    table = simulation.measure(build_cached(work.true), _motion(work.true, work.driven), kit=work.kit, seed=seed)
    row["log_sha256"] = hashlib.sha256(table.to_numpy(float).tobytes()).hexdigest()[:16]
    if steps & {"identify", "verify"}:
        measured = from_table(table, known.machine, identification.needed_sensors(known, work.method))
        estimate = identification.identify(known, [measured], work.method)
        told = (estimate.value, estimate.std, *estimate.interval95)
        row |= {name: _plain(numbers.tolist()) for name, numbers in zip(ESTIMATES, told, strict=True)}
        row["relative_error_percent"] = _plain(estimate.relative_error_percent)
    if "diagnose" in steps:
        needs = identification.needed_sensors(known, "joint")
        row |= _diagnosed(known, [from_table(table, known.machine, needs)])
    return row


def _diagnosed(model: Model, logs: Sequence[Log]) -> Row:
    """The keys of `excite diagnose` that go into a table."""
    from excite import diagnosis
    from excite.diagnosis import diagnose

    mended = [examine(model, one).log for one in logs]
    said = diagnosis.summarise(diagnosis.account(diagnose(model, mended, model.machine.filter)))
    told = ("effect", "where", "tied_with", "p_value", "amount", "amount_std", "unit", "gain_percent", "gain_ci95")
    return {
        "verdict": said["verdict"],
        "findings": [{k: _plain(one.get(k)) for k in told} for one in said["findings"]],
        "error_before_percent": _plain(said["error_before_percent"]),
        "error_after_percent": _plain(said["error_after_percent"]),
    }


def _plain(value: Any) -> Any:
    """As JSON has it: a number that is not finite is none at all."""
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


@dataclass(frozen=True)
class Order:
    """A design that is wanted: of drive `number`, for a machine (JSON) and its problem."""

    number: int
    machine: str
    name: str
    problem: Problem
    objective: str
    starts: int
    seed: int


@dataclass(frozen=True)
class Designed:
    """What came of it: the profile (CSV) and the summary, or why there is none."""

    profile: str
    summary: dict[str, Any]
    failure: str | None = None


def designed(order: Order) -> Designed:
    """A study's drive. Raises KeyboardInterrupt where it was cut short."""
    return interrupt.call_interruptible(_designed, order)


def _designed(order: Order) -> Designed:
    asked = Brief(order.objective, starts=order.starts, seed=order.seed)
    try:
        model = build(
            Machine.model_validate_json(order.machine), fit_sensor_effects=False
        )  # no drive shows what sits in a sensor
        answer = design_request.answer(model, order.problem, asked)
    except (InfeasibleError, SimulationError, NoEstimateError, MachineError) as err:
        return Designed("", {}, _said(err))
    except np.linalg.LinAlgError:
        return Designed("", {}, design_request.unmoved(order.name))
    except Exception as err:
        return Designed("", {}, f"{DEFECT}: {type(err).__name__}: {_said(err)}")
    if not answer.design.complete:
        raise KeyboardInterrupt
    summary = {
        "machine": model.machine.name,
        "problem": order.name,
        "duration_s": float(order.problem.duration_s),
        **design_request.summary(asked, answer),
    }
    return Designed(profile_of(answer.model, answer.design.motion).to_csv(index=False), summary)


@lru_cache(maxsize=1)
def program() -> str:
    """Sixteen digits that change when the program does: rows of two programs are not put into one table."""
    seen = hashlib.sha256()
    package = Path(__file__).parents[1]
    for part in (package, package / "model"):  # the second is a link in a checkout, which rglob doesn't follow
        for file in sorted([*part.rglob("*.py"), *part.rglob("*.toml")]):
            seen.update(str(file.relative_to(part)).encode() + file.read_bytes())
    return seen.hexdigest()[:16]
