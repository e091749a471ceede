"""`excite predict`: from an estimate and a log or profile to predicted signals with 95 % bands."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite import identification, reports
from excite.errors import NoEstimateError, UsageError
from excite.identification import Estimate, Prediction
from excite.logs import Log, PlannedDrive, examine, is_profile, prepare, read_drive
from excite.model import Model
from excite.reports import Account
from excite.workflows import requests
from excite.workflows.progress import Bar, no_bar

Target = str | Path | pd.DataFrame | Log | PlannedDrive


@dataclass(frozen=True)
class PredictResult:
    """A prediction, with notes on the log that it is along. along: `log` or `profile`."""

    prediction: Prediction
    along: str
    notes: tuple[str, ...] = ()


def predict_from(model: Model, estimate: Estimate, target: Target) -> PredictResult:
    """Predict the torques along a log, or the motion along a profile; the columns decide which of them a table is.

    Raises NoEstimateError for an invalid estimate, UsageError for one of another machine, LogError for an unusable
    target, SimulationError if the estimate is no machine that can be simulated.
    """
    if estimate.names != model.base.names:
        raise UsageError(
            f"the estimate has the parameters {', '.join(estimate.names)}, {model.machine.name} has"
            f" {', '.join(model.base.names)}: give the machine that it was identified for"
        )
    if estimate.status == "invalid":
        raise NoEstimateError(f"nothing is predicted, as the estimate is invalid: {estimate.doubt}")
    if isinstance(target, PlannedDrive):
        return PredictResult(identification.predict_motion(model, target, estimate), "profile")
    if not isinstance(target, Log) and is_profile(target, model):
        return PredictResult(identification.predict_motion(model, read_drive(target, model), estimate), "profile")
    ready = prepare(model, [target], identification.needed_sensors(model, "joint"))
    examined = [examine(ready.model.machine, one) for one in ready.logs]
    notes = (*ready.notes, *(line for e in examined for line in (*e.notes, *e.doubts)))
    found = identification.predict_torques(ready.model, [e.log for e in examined], estimate)
    return PredictResult(found, "log", notes)


def predict(place: Path, result: Path, target: Path, bar: Bar = no_bar) -> dict[str, Any]:
    """Predict signals along a log or profile from the folder of an estimate, into a folder; return the summary.

    Raises EstimateFolderError, and what `predict_from` raises.
    """
    saved = identification.read_estimate(result)
    with bar("predicting"):
        found = predict_from(saved.model, saved.estimate, target)
    return predict_account(saved.model, saved.estimate, found, str(result), str(target)).write(place)


def predict_account(model: Model, estimate: Estimate, found: PredictResult, result: str, target: str) -> Account:
    """Give an account of a prediction. result, target: what the estimate and the log or drive are called."""
    p = found.prediction
    summary = {
        "machine": model.machine.name,
        "estimate": result,
        "target": target,
        "along": found.along,
        "status": estimate.status,
        "doubt": estimate.doubt,
        "method": estimate.method,
        "duration_s": float(p.t[-1]),
        "signals": _signals(p),
        "outside": [
            {"signal": name, "from_s": begin, "to_s": end, "ratio": ratio} for name, begin, end, ratio in p.worst
        ],
        "assumed": list(p.assumed),
        "notes": list(found.notes),
        "versions": requests.package_versions(),
    }
    title = f"{model.machine.title}: {target}"
    return Account(
        "predict",
        summary,
        {"prediction.png": partial(reports.prediction_figure, p, title)},
        partial(_frame, p),
        (partial(_write_table, p),),
    )


def _write_table(p: Prediction, place: Path) -> None:
    """Write the table of a prediction into a folder."""
    p.table.to_csv(place / "prediction.csv", index=False)


def _frame(p: Prediction) -> pd.DataFrame:
    """Return the table of a prediction, with the unit of each column."""
    table = p.table
    of = dict(zip(p.names, p.units, strict=True))
    table.attrs["units"] = {"t_s": "s"} | {
        f"{name}{end}": unit
        for name, unit in of.items()
        for end in ("", "_low95", "_high95", "_measured")
        if f"{name}{end}" in table
    }
    return table


def _signals(p: Prediction) -> dict[str, dict[str, Any]]:
    """Summarise each signal: root mean squares of its value and of half its 95 % band, the band at the end."""
    rows: dict[str, dict[str, Any]] = {}
    for k, name in enumerate(p.names):
        rows[name] = {
            "unit": p.units[k],
            "rms": _rms(p.value[k]),
            "rms_band": _rms(p.band[k]),
            "rms_parameters": _rms(p.parameters[k]),
            "rms_noise": _rms(p.noise[k]),
            "at_end": float(p.band[k, -1]),
            "free": name in p.free,
        }
        if p.outside is not None:
            rows[name]["share_outside"] = float(p.outside[k].mean())
    return rows


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))
