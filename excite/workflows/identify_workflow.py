"""`excite identify`: from logs to parameters with uncertainty, figures and a report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from excite import identification, reports
from excite.errors import LogError, NoEstimateError, NotIdentifiableError, SimulationError
from excite.identification import Agreement, Estimate, SignalComparison, describe_late_channels
from excite.logs import Log, Prepared, examine, moves, prepare
from excite.model import Model, parameter_descriptions
from excite.model.machine import Filter
from excite.reports import Account
from excite.workflows import requests
from excite.workflows.machine_check import require_no_fault
from excite.workflows.progress import Bar, no_bar
from excite.workflows.residuals import describe_residuals


@dataclass(frozen=True)
class IdentifyResult:
    """An estimate with its notes and the repaired logs it is from. agreement: of several logs, None for one."""

    estimate: Estimate
    logs: list[Log]
    agreement: Agreement | None = None


def identify_from(model: Model, logs: Sequence[Log], method: str) -> IdentifyResult:
    """Estimate parameters from checked logs, with notes on values and late channels, and the bias of what is no noise.

    Raises NoEstimateError, LogError.
    """
    chosen = model.machine.filter
    agreement, _, explained = identification.compare_sources(model, logs, method, chosen)
    try:
        estimate = identification.identify(model, logs, method, chosen, explained)
    except NoEstimateError as err:
        if agreement is None or agreement.agree:
            raise
        raise NotIdentifiableError(f"{identification.describe_agreement(agreement)}; together: {err}") from None
    if agreement is not None and not agreement.agree and estimate.status == "valid":
        estimate = replace(estimate, status="doubtful", doubt="the logs do not agree on the parameters")
    if agreement is not None:
        estimate = identification.widen(estimate, agreement.ratio)
    used = [examine(model.machine, one).log for one in logs]
    if model.slips and identification.METHODS[method].biased and estimate.status != "invalid":
        estimate = identification.add_bias(model, used, estimate, chosen)
        if estimate.bias is not None and (np.abs(np.nan_to_num(estimate.bias)) > estimate.std).any():
            doubt = estimate.doubt or f"on simulated logs like this {method} is off by more than its intervals say"
            estimate = replace(
                estimate, doubt=doubt, status="doubtful" if estimate.status == "valid" else estimate.status
            )
    found = estimate.value if estimate.method == "joint" and np.isfinite(estimate.value).all() else None
    late = [remark for one in used for remark in describe_late_channels(model, one, chosen, found)]
    if estimate.tests:
        late = []  # the alignment is one of the tests
    elif late and estimate.status == "valid":
        estimate = replace(estimate, status="doubtful", doubt=late[0])
    notes = (*estimate.notes, *identification.far_from_nominal(model, estimate), *late)
    estimate = identification.add_consistent(model, replace(estimate, notes=notes))
    used = identification.corrected_logs(model, used, method, chosen)
    return IdentifyResult(estimate, used, agreement)


def identify(
    place: Path,
    machine: str,
    logs: Sequence[Path],
    method: str | None = None,
    validate: Sequence[Path] = (),
    bar: Bar = no_bar,
    unloaded: Path | None = None,
    accepted: str | None = None,
) -> dict[str, Any]:
    """Estimate parameters from logs into a folder; return the summary.

    machine: a shipped name or a path. method: None for the recommended one.
    validate: logs that are not fitted, only predicted. unloaded: folder of an estimate of the machine without the
    payload that it carries in the logs. accepted: why doubts about the logs may stand.
    Raises LogError, NoEstimateError, UsageError, EstimateFolderError, MachineError for a machine that `check` refuses.
    """
    as_in_file = model = requests.build_model(machine)
    require_no_fault(model, machine)
    before = None if unloaded is None else identification.read_estimate(unloaded).estimate
    method = requests.choose_method(method, model)
    needs = identification.needed_sensors(model, method)
    ready = prepare(model, logs, needs)
    model = ready.model
    others = (
        prepare(model, validate, needs, "validated on", rate=float(model.machine.sampling_hz)) if validate else None
    )
    examined = [examine(model.machine, one) for one in others.logs] if others else []
    unfitted = [e.log for e in examined]
    for one in unfitted:
        if not moves(model.machine, one):
            raise LogError(f"{one.source}: nothing moves in it, so it validates nothing: give a log of motion")
    more_notes = [*(others.notes if others else ()), *(line for e in examined for line in (*e.notes, *e.doubts))]
    with bar("identifying"):
        found = identify_from(model, ready.logs, method)
    unfitted = identification.corrected_logs(model, unfitted, method, model.machine.filter)
    return identify_account(as_in_file, ready, found, unfitted, more_notes, before, accepted).write(place)


def identify_account(
    as_in_file: Model,
    ready: Prepared,
    found: IdentifyResult,
    unfitted: Sequence[Log] = (),
    more_notes: Sequence[str] = (),
    unloaded: Estimate | None = None,
    accepted: str | None = None,
) -> Account:
    """Give an account of an estimate, predicting logs that were not fitted.

    as_in_file: the model before it had the rate of the logs. more_notes: on the logs that were not fitted.
    unloaded: estimate without the payload. accepted: why doubts about the logs may stand.
    """
    model, read, estimate, chosen = ready.model, found.logs, found.estimate, ready.model.machine.filter
    compared = [identification.compare_torques(model, one, estimate, chosen) for one in read]
    said = [] if found.agreement is None else [identification.describe_agreement(found.agreement)]
    checks = [_check(model, one, read, estimate, chosen) for one in unfitted]
    missed = dict.fromkeys(x["signal"] for c in checks if not c["fitted"] for x in c["outside"])
    if missed and estimate.status == "valid":
        doubt = f"the bands miss the data withheld: {', '.join(missed)}"
        estimate = replace(estimate, status="doubtful", doubt=doubt)
    parameters = _parameters(estimate)
    summary = {
        "machine": model.machine.name,
        "logs": [one.source for one in read],
        "status": estimate.status,
        "doubt": estimate.doubt,
        "method": estimate.method,
        "parameters": parameters,
        "budget": estimate.budget,
        "discrepancy": _discrepancy(estimate),
        "tests": [
            {"signal": t.signal, "test": t.what, "p_value": t.p_value, "fails": t.fails, "says": t.text}
            for t in estimate.tests
        ],
        "meanings": parameter_descriptions(model),
        "cond_w": estimate.cond_w,
        "cond_phi": estimate.cond_phi,
        "relative_error_percent": estimate.relative_error_percent,
        "fit": describe_residuals(compared, chosen),
        "error_by_joint": _error_by_joint(model, read, estimate, chosen),
        "degrees": estimate.degrees,
        "share_outside_law": estimate.share_outside_law,
        "unused_sensors": list(identification.unused_sensors(model, estimate.method, read)),
        "unidentifiable": list(estimate.unidentifiable),
        "reasons": dict(estimate.unidentifiable),
        "notes": list(
            dict.fromkeys(
                [*said, *requests.acceptance_notes(accepted), *ready.notes, *estimate.notes, *more_notes],
            )
        ),
        "accepted": accepted,
        "agreement": None if found.agreement is None else identification.summarise_agreement(found.agreement),
        "validation": checks,
        "versions": requests.package_versions(),
    }
    if (constant := identification.torque_constant(model, estimate)) is not None:
        summary["torque_constant"] = {
            "value": constant.value,
            "std": constant.std,
            "low95": constant.interval95[0],
            "high95": constant.interval95[1],
            "unit": constant.unit,
            "known": list(constant.known),
            "p_value": constant.p_value,
        }
    if unloaded is not None:
        summary["payload"] = _payload(identification.payload_parameters(model, estimate, unloaded))
    figures = _figures(model, found, estimate, compared, unfitted, as_in_file.nominal)
    return Account(
        "identify",
        reports.with_sentences("identify", summary),
        figures,
        partial(reports.rows_frame, parameters, "parameter"),
        (partial(identification.write_estimate, model=as_in_file, estimate=estimate),),
    )


def _figures(
    model: Model,
    found: IdentifyResult,
    estimate: Estimate,
    compared: Sequence[SignalComparison],
    unfitted: Sequence[Log],
    nominal: np.ndarray,
) -> dict[str, Callable[[], Figure]]:
    """Return what draws each figure, by file name. nominal (n,): values of the machine file."""
    every: tuple[tuple[str, list[Callable[[], Figure]]], ...] = (
        ("fit", [partial(_fit_figure, model, *both) for both in zip(found.logs, compared, strict=True)]),
        ("validation", [partial(_validation_figure, model, one, estimate, model.machine.filter) for one in unfitted]),
    )
    figures = {
        f"{kind}-{k + 1}.png" if len(several) > 1 else f"{kind}.png": draw
        for kind, several in every
        for k, draw in enumerate(several)
    }
    title = f"{model.machine.title}, {estimate.method}"
    if estimate.status != "invalid" and np.isfinite(estimate.std).any():
        figures["correlation.png"] = partial(reports.correlation_figure, estimate, title)
        if estimate.tolerated:
            figures["budget.png"] = partial(reports.budget_figure, estimate, title)
        if estimate.prior_std is not None and (np.isfinite(estimate.prior_std) & (estimate.prior_std > 0)).any():
            figures["prior.png"] = partial(reports.prior_figure, estimate, nominal, title)
    return figures


def _validation_figure(model: Model, one: Log, estimate: Estimate, filter: Filter) -> Figure:
    return _fit_figure(model, one, identification.compare_torques(model, one, estimate, filter))


def _fit_figure(model: Model, one: Log, compared: SignalComparison) -> Figure:
    return reports.comparison_figure(model, compared, f"{model.machine.title}: {one.source}")


def _discrepancy(estimate: Estimate) -> dict[str, Any]:
    """Return by signal, or place and unit if it has several, what the model lacks there and the intervals contain."""
    found: dict[str, Any] = {}
    units = {d.signal: {x.unit for x in estimate.discrepancy if x.signal == d.signal} for d in estimate.discrepancy}
    for d in estimate.discrepancy:
        name = d.signal if len(units[d.signal]) == 1 else f"{d.signal} [{d.unit}]"
        own = found.setdefault(name, {"rms": 0.0, "unit": d.unit, "parts": []})
        own["rms"] = float(np.hypot(own["rms"], d.rms))
        own["parts"].append({"kind": d.kind, "rms": d.rms, "scale": d.scale})
    return found


def _error_by_joint(model: Model, read: Sequence[Log], estimate: Estimate, chosen: Filter) -> dict[str, Any]:
    errors = identification.torque_errors(model, read, estimate, chosen)
    each = zip(errors.names, errors.rms, errors.percent, errors.units, strict=True)
    return {name: {"percent": percent, "rms": rms, "unit": unit} for name, rms, percent, unit in each}


def _payload(payload: identification.Payload) -> dict[str, Any]:
    each = zip(payload.names, payload.units, payload.value, payload.std, payload.groups, strict=True)
    shown = {n: {"unit": unit, "value": v, "std": std, "grouping": group} for n, unit, v, std, group in each}
    found: dict[str, Any] = {"body": payload.body, "parameters": shown, "p_value": payload.p_value}
    if payload.centre is not None and payload.centre_std is not None:
        found |= {"centre_m": payload.centre.tolist(), "centre_std_m": payload.centre_std.tolist()}
    return found


def _parameters(estimate: Estimate) -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    low, high = estimate.interval95
    for k, (name, unit) in enumerate(zip(estimate.names, estimate.units, strict=True)):
        rows[name] = {
            "unit": unit,
            "value": estimate.value[k],
            "std": estimate.std[k],
            "std_percent": estimate.std_percent[k],
            "std_total": estimate.std_total[k],
            "low95": low[k],
            "high95": high[k],
            "possible": estimate.possible is None or bool(estimate.possible[k]),
        }
        if estimate.prior_std is not None and np.isfinite(estimate.prior_std[k]):
            rows[name]["prior_std"] = estimate.prior_std[k]
        if estimate.consistent is not None:
            rows[name]["consistent"] = estimate.consistent[k]
        if estimate.bias is not None and estimate.bias_std is not None:
            rows[name] |= {"bias": estimate.bias[k], "bias_std": estimate.bias_std[k]}
    return rows


def _is_same(one: Log, other: Log) -> bool:
    """Tell if two logs have the same readings."""
    return one.values.keys() == other.values.keys() and all(
        np.array_equal(x, other.values[name]) for name, x in one.values.items()
    )


def _check(model: Model, one: Log, read: Sequence[Log], estimate: Estimate, chosen: Filter) -> dict[str, Any]:
    """Predict a log for validation: errors of torques, and of signals by direct simulation. read: logs fitted."""
    torques = identification.validate_torques(model, one, estimate, chosen)
    shown: dict[str, Any] = {
        "log": one.source,
        "fitted": any(_is_same(one, other) for other in read),
        "torque_error_percent": dict(zip(torques.names, torques.percent, strict=True)),
        "outside": [
            {"signal": name, "from_s": begin, "to_s": end, "ratio": ratio}
            for name, begin, end, ratio in torques.outside()
        ],
    }
    for key, deviation in (("noise_percent", torques.noise), ("parameters_percent", torques.parameters)):
        if deviation is not None:
            shown[key] = dict(zip(torques.names, torques.share_percent(deviation), strict=True))
    try:
        signals = identification.compare_motions(model, one, estimate, chosen)
    except (ValueError, SimulationError) as err:
        return shown | {"simulation": f"not possible: {err}"}
    return shown | {
        "simulation_rms": {
            n: {"rms": r, "unit": u} for n, r, u in zip(signals.names, signals.rms, signals.units, strict=True)
        }
    }
