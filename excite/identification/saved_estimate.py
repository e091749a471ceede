"""Write an estimate for later use beside the summary of a result folder, and read it back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd

from excite import output
from excite.errors import EstimateFolderError, MachineError
from excite.identification.estimate import Discrepancy, Estimate
from excite.model import Model, build
from excite.model.machine import Machine

COVARIANCE = "covariance.csv"
TOLERANCES = "tolerances.csv"
MACHINE = "machine.json"
MOST_SKEW = 1e-3  # difference of two correlations that are one; rounding makes less, also of a poor estimate; chosen
AGAIN = "identify again with `excite identify MACHINE LOG`"


@dataclass(frozen=True)
class SavedEstimate:
    """A folder that `excite identify` wrote: its summary, the machine's model, the estimate (without residual)."""

    summary: dict[str, Any]
    model: Model
    estimate: Estimate


def write_estimate(place: Path, model: Model, estimate: Estimate) -> None:
    """Write the machine, and the covariance [SI] with a row and a column a parameter, into a result folder.

    Tolerances have a row each: the shift [SI] of every parameter by one standard deviation of it. Values and status are
    in the folder's summary. A parameter that was not identified has blank cells.
    """
    (place / MACHINE).write_text(model.machine.model_dump_json(indent=1) + "\n", encoding="utf-8")
    names = list(estimate.names)
    symmetric = (estimate.covariance + estimate.covariance.T) / 2
    pd.DataFrame(symmetric, names, names).to_csv(place / COVARIANCE, index_label="parameter")
    shifts = np.array(list(estimate.tolerated.values())).reshape(-1, len(names))
    pd.DataFrame(shifts, list(estimate.tolerated), names).to_csv(place / TOLERANCES, index_label="source")


def read_estimate(folder: Path) -> SavedEstimate:
    """Read the folder of an estimate. Raises EstimateFolderError: what is missing or damaged, what to do."""
    path = folder / output.SUMMARY
    if not path.is_file():
        raise EstimateFolderError(
            f"{folder}: not an estimate (no {output.SUMMARY} in it), give a folder of `excite identify`"
        )
    try:
        summary = output.read_json(path)
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
        estimate = _estimate(summary, folder / COVARIANCE)
        if (folder / TOLERANCES).is_file():
            shifts = pd.read_csv(folder / TOLERANCES, index_col="source")
            by_source = dict(zip(shifts.index, shifts[list(estimate.names)].to_numpy(float), strict=True))
            variances = np.square([x[np.isfinite(estimate.value)] for x in by_source.values()])
            if not np.isfinite(variances).all():
                raise ValueError("shifts that are no numbers")
            estimate = replace(estimate, tolerated=by_source)
    except EstimateFolderError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):
        raise EstimateFolderError(
            f"{folder}: {output.SUMMARY}, {COVARIANCE} or {TOLERANCES} is damaged, {AGAIN}"
        ) from None
    if estimate.names != model.base.names:
        raise EstimateFolderError(f"{folder}: {MACHINE} has other parameters than {output.SUMMARY}, {AGAIN}")
    return SavedEstimate(summary, model, estimate)


def _covariance(path: Path, names: tuple[str, ...], known: np.ndarray) -> np.ndarray:
    """Read the covariance (n, n) of parameters of which some are known (n,). Raises EstimateFolderError, ValueError."""

    def refuse(what: str) -> NoReturn:
        raise EstimateFolderError(f"{path}: {what}; undo what was changed in it, or {AGAIN}")

    table = pd.read_csv(path, index_col="parameter")
    if not tuple(table.columns) == tuple(table.index) == names:
        refuse(f"has other parameters than {output.SUMMARY}, or another order of them")
    spread = table.to_numpy(float)
    for j, k in np.argwhere(np.isfinite(spread) != np.outer(known, known)):
        refuse(f"{names[j]}, {names[k]}: must {'' if known[j] and known[k] else 'not '}have a number")
    variance = np.where(known, np.diag(spread), 1.0)
    for k in np.flatnonzero(variance < 0):
        refuse(f"{names[k]}: its variance is below zero")
    std = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = np.nan_to_num(spread) / np.outer(std, std)
    for j, k in np.argwhere(np.abs(correlation - correlation.T) > MOST_SKEW):
        refuse(f"{names[j]}, {names[k]}: is not the number of {names[k]}, {names[j]}")
    if np.linalg.eigvalsh((correlation + correlation.T) / 2).min(initial=0.0) < -MOST_SKEW:
        refuse("a sum of parameters has a variance below zero")
    return (spread + spread.T) / 2


def _estimate(summary: dict[str, Any], covariance: Path) -> Estimate:
    """Build the estimate of a summary. Raises EstimateFolderError, or what damaged values raise."""
    rows = summary["parameters"]
    names = tuple(rows)
    value = np.array([r["value"] for r in rows.values()], float)
    return Estimate(
        str(summary["method"]),
        names,
        tuple(str(r["unit"]) for r in rows.values()),
        value,
        _covariance(covariance, names, np.isfinite(value)),
        float(summary["cond_w"]),
        float(summary["cond_phi"]),
        float(summary["relative_error_percent"] or np.nan),
        np.empty((0, 0)),
        int(summary["degrees"]),
        dict(summary["reasons"]),
        tuple(summary["notes"]),
        doubt=str(summary["doubt"]),
        discrepancy=tuple(
            Discrepancy(
                signal.removesuffix(f" [{own['unit']}]"),
                str(d["kind"]),
                float(d["rms"]),
                str(own["unit"]),
                float(d["scale"]),
            )
            for signal, own in summary.get("discrepancy", {}).items()
            for d in own["parts"]
        ),
        status=str(summary["status"]),
    )
