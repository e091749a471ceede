"""`excite identify`: logs in, a folder with parameters, figures and a report out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from excite import identification, reports
from excite.errors import SimulationError
from excite.identification import FILTERS, Estimate, late_channels
from excite.logs import Log, examine, read_stretches
from excite.model import Model, parameter_descriptions
from excite.model.machine import Filter
from excite.workflows import requests
from excite.workflows.progress import Bar, silent


@dataclass(frozen=True)
class Identified:
    """An estimate with every remark, the logs as they were identified from, and the filter that was used."""

    estimate: Estimate
    logs: list[Log]
    filter: Filter


def identify_from(model: Model, logs: Sequence[Log], method: str, filtering: str = "machine") -> Identified:
    """Estimate the parameters from checked logs, with the bias of the method and remarks on values and late channels.

    filtering: a name of `FILTERS`. Raises NoEstimate, LogError.
    """
    chosen, reason = FILTERS[filtering](model, logs)
    estimate = identification.identify(model, logs, method, chosen)
    used = [examine(model, one).log for one in logs]
    if model.slips and identification.METHODS[method].biased:
        estimate = identification.with_bias(model, used, estimate, chosen)
    found = estimate.value if estimate.method == "joint" and np.isfinite(estimate.value).all() else None
    late = [remark for one in used for remark in late_channels(model, one, chosen, found)]
    first = (reason,) if reason else ()
    notes = (*first, *estimate.notes, *identification.far_from_nominal(model, estimate), *late)
    return Identified(replace(estimate, notes=notes), used, chosen)


def identify(
    place: Path,
    model: Model,
    logs: Sequence[Path],
    method: str | None,
    filtering: str,
    validate: Sequence[Path],
    bar: Bar = silent,
) -> dict[str, Any]:
    """Parameters from logs. filtering: a name of `examine.FILTERS`; validate: logs that the result is to predict."""
    method = requests.choose_method(method, model)
    needs = identification.needed_sensors(model, method)
    read, cut = read_stretches(logs, model.machine, needs)
    others, torn = read_stretches(validate, model.machine, needs, "validated on")
    seen = [examine(model, one) for one in others]
    fresh, said = [e.log for e in seen], [*torn, *(line for e in seen for line in (*e.notes, *e.doubts))]
    with bar("identifying"):
        found = identify_from(model, read, method, filtering)
    read, estimate, chosen = found.logs, found.estimate, found.filter
    summary = {
        "machine": model.machine.name,
        "logs": [one.source for one in read],
        "method": estimate.method,
        "parameters": _parameters(estimate),
        "meanings": parameter_descriptions(model),
        "cond_w": estimate.cond_w,
        "cond_phi": estimate.cond_phi,
        "relative_error_percent": estimate.relative_error_percent,
        "unidentifiable": list(estimate.unidentifiable),
        "reasons": dict(estimate.unidentifiable),
        "notes": [*cut, *estimate.notes, *said],
        "validation": [_check(model, one, estimate, chosen) for one in fresh],
        "versions": requests.versions(),
    }
    for kind, several in (("fit", read), ("validation", fresh)):
        for k, one in enumerate(several):
            title = f"{model.machine.title}: {one.source}"
            figure = reports.comparison_figure(model, identification.torques(model, one, estimate, chosen), title)
            reports.save(figure, place / (f"{kind}-{k + 1}.png" if len(several) > 1 else f"{kind}.png"))
    reports.write_report(place, "identify", summary)
    return summary


def _parameters(estimate: Estimate) -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    low, high = estimate.interval95
    for k, (name, unit) in enumerate(zip(estimate.names, estimate.units, strict=True)):
        rows[name] = {
            "unit": unit,
            "value": estimate.value[k],
            "std": estimate.std[k],
            "std_percent": estimate.std_percent[k],
            "low95": low[k],
            "high95": high[k],
        }
        if estimate.bias is not None and estimate.bias_std is not None:
            rows[name] |= {"bias": estimate.bias[k], "bias_std": estimate.bias_std[k]}
    return rows


def _check(model: Model, one: Log, estimate: Estimate, chosen: Filter) -> dict[str, Any]:
    """How well an estimate predicts a log that it was not fitted on: torques, and signals by direct simulation."""
    torques = identification.torques(model, one, estimate, chosen)
    shown: dict[str, Any] = {
        "log": one.source,
        "torque_error_percent": dict(zip(torques.names, torques.percent, strict=True)),
    }
    try:
        signals = identification.motions(model, one, estimate, chosen)
    except (ValueError, SimulationError) as err:
        return shown | {"simulation": f"not possible: {err}"}
    return shown | {
        "simulation_rms": {
            n: {"rms": r, "unit": u} for n, r, u in zip(signals.names, signals.rms, signals.units, strict=True)
        }
    }
