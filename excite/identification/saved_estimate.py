"""Write an estimate for later use beside the summary of a result folder, and read it back."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite import output
from excite.errors import EstimateFolderError, MachineError
from excite.identification.estimate import Estimate
from excite.model import Model, build
from excite.model.machine import Machine

COVARIANCE = "covariance.csv"
MACHINE = "machine.json"
AGAIN = "identify again with `excite identify MACHINE LOG`"


@dataclass(frozen=True)
class SavedEstimate:
    """A folder that `excite identify` wrote: its summary, the machine's model, the estimate (without residual)."""

    summary: dict[str, Any]
    model: Model
    estimate: Estimate


def write_estimate(place: Path, model: Model, estimate: Estimate) -> None:
    """Write the machine, and the covariance [SI] with a row and a column a parameter, into a result folder.

    Values and status are in the folder's summary. A parameter that was not identified has blank cells.
    """
    (place / MACHINE).write_text(model.machine.model_dump_json(indent=1) + "\n", encoding="utf-8")
    names = list(estimate.names)
    pd.DataFrame(estimate.covariance, names, names).to_csv(place / COVARIANCE, index_label="parameter")


def read_estimate(folder: Path) -> SavedEstimate:
    """Read the folder of an estimate. Raises EstimateFolderError: what is missing or damaged, what to do."""
    path = folder / output.SUMMARY
    if not path.is_file():
        raise EstimateFolderError(
            f"{folder}: not an estimate (no {output.SUMMARY} in it), give a folder of `excite identify`"
        )
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise EstimateFolderError(f"{path}: damaged or not readable, {AGAIN}") from None
    if not isinstance(summary, dict) or not {"status", "parameters", "cond_phi"} <= set(summary):
        raise EstimateFolderError(f"{folder}: not an estimate, give a folder of `excite identify`")
    if "degrees" not in summary or not (folder / COVARIANCE).is_file():
        raise EstimateFolderError(f"{folder}: holds no covariance, as an earlier version wrote it; {AGAIN}")
    try:
        model = build(Machine.model_validate_json((folder / MACHINE).read_bytes()))
    except (OSError, ValueError, MachineError):
        raise EstimateFolderError(f"{folder / MACHINE}: missing or damaged, {AGAIN}") from None
    try:
        estimate = _estimate(summary, pd.read_csv(folder / COVARIANCE, index_col="parameter"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise EstimateFolderError(f"{folder}: {output.SUMMARY} or {COVARIANCE} is damaged, {AGAIN}") from None
    if estimate.names != model.base.names:
        raise EstimateFolderError(f"{folder}: {MACHINE} has other parameters than {output.SUMMARY}, {AGAIN}")
    return SavedEstimate(summary, model, estimate)


def _estimate(summary: dict[str, Any], covariance: pd.DataFrame) -> Estimate:
    """Build the estimate of a summary. Raises ValueError, KeyError, TypeError, AttributeError for a damaged one."""
    rows = summary["parameters"]
    names = tuple(rows)
    if tuple(covariance.columns) != names or tuple(covariance.index) != names:
        raise ValueError("names differ")
    spread = covariance.to_numpy(float)
    if np.isinf(spread).any() or not np.allclose(spread, spread.T, equal_nan=True):
        raise ValueError("no covariance")
    return Estimate(
        str(summary["method"]),
        names,
        tuple(str(r["unit"]) for r in rows.values()),
        np.array([r["value"] for r in rows.values()], float),
        spread,
        float(summary["cond_w"]),
        float(summary["cond_phi"]),
        float(summary["relative_error_percent"] or np.nan),
        np.empty((0, 0)),
        int(summary["degrees"]),
        dict(summary["reasons"]),
        tuple(summary["notes"]),
        doubt=str(summary["doubt"]),
        status=str(summary["status"]),
    )
