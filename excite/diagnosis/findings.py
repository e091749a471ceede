"""The summary of a diagnosis, for people and programs, and the extended machine file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import tomli_w

from excite import identification, interrupt
from excite.diagnosis import hold_out, residuals, selection, separating_run, soil_curves, torque_regression
from excite.diagnosis.acceptance import reason_against
from excite.diagnosis.clean_simulation import Remainder, measure_remainder
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.diagnosis import Diagnosis, Finding, anomaly_lines, conclude, diagnose
from excite.diagnosis.fits import ExtendedFit
from excite.diagnosis.hold_out import HoldOutErrors, HoldOutGain
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.residuals import InnovationLevel
from excite.diagnosis.selection import ProgressCallback
from excite.diagnosis.torque_regression import TorqueDiagnosis
from excite.errors import NoEstimateError
from excite.identification import Agreement
from excite.logs import Log
from excite.model import Model
from excite.model.machine import EffectEntry, Filter, Machine, shipped_machines
from excite.text import format_number, format_rounded, format_uncertain

MACHINE_FILE_DIGITS = 8  # significant digits of magnitudes in a machine file; chosen
FIRST_ANOMALY_LINES = 3  # lines about anomalies that precede all others; chosen
MIN_NEAREST_SHARE = 0.05  # share of the misfit above which the nearest effect is mentioned; chosen
MAX_FOLLOWED_JOINTS = 3  # driven joints of a machine without slips whose motion is followed in open loop; chosen
DIAGNOSE_SHARE = 0.8  # of the progress; gains take the rest; chosen
FULL_EXPLANATION_SHARE = 0.99  # share of the misfit below which the answer gives it; chosen


@dataclass(frozen=True)
class Assessment:
    """A diagnosis with what its findings gain.

    total_gain, gains: hold-out gain of all findings, and of each; None if no model could be fitted to the rest of the
    logs. before, after: size of each signal's innovations without and with the findings. located: where the misfit is.
    separating_run: the run that would separate tied causes. cut_short: what ended the search, "" if it ended by itself.
    differences: between logs of which each alone is explained, None if there are none; no effect is sought then.
    remainder: misfit beyond that of clean logs of the fitted machine, None where it cannot be told.
    """

    diagnosis: Diagnosis | TorqueDiagnosis
    total_gain: HoldOutGain | None
    gains: tuple[HoldOutGain | None, ...]
    before: Mapping[str, InnovationLevel]
    after: Mapping[str, InnovationLevel]
    located: tuple[str, ...]
    separating_run: str | None
    cut_short: str = ""
    differences: Agreement | None = None
    remainder: Remainder | None = None


def assess(
    d: Diagnosis,
    progress: ProgressCallback | None = None,
    runner: CallRunner = run_in_turn,
    deadline: Deadline | None = None,
) -> Assessment:
    """Measure hold-out gains, keep the findings that pay for their names, and locate the misfit.

    The gain of a finding is that over the model with all others. One that predicts withheld data no better is given up.
    """
    report, deadline = progress or (lambda share, what: None), deadline or Deadline()
    last = d.after if d.findings else d.before
    stages = list({id(x): x for x in (d.before, last, *d.without) if x is not None}.values())
    likelihood = any(f.kind == "cause" for f in d.findings)  # only these are judged by it
    torques = [hold_out.hold_out_torques(x) for x in stages]
    by_torques = None not in torques  # what people see; names are judged by the motion
    errors = torques if by_torques and not likelihood else _hold_out(stages, likelihood, runner, report)
    reasons = _reasons_against(d, stages, errors)
    if any(reasons) and errors is not torques:  # withhold every part before a name is given up
        reasons = _reasons_against(d, stages, _hold_out(stages, likelihood, runner, report, True))
    given_up = {f.name: reason for f, reason in zip(d.findings, reasons, strict=True) if reason}
    if given_up:
        found = selection.give_up(d.before, d.after, given_up, runner, deadline)
        return assess(conclude(d.before, found, runner), progress, runner, deadline)
    told = dict(zip(map(id, stages), torques if by_torques else errors, strict=True))
    gains = tuple(hold_out.hold_out_gain(told.get(id(x)), told[id(last)]) for x in d.without)
    total_gain = hold_out.hold_out_gain(told[id(d.before)], told[id(last)])
    unnamed = d.verdict == "unexplained" and not d.findings and bool(last.machine.contacts)
    if unnamed and not by_torques and not deadline.is_over():
        report(0.95, "drawing what is left")
        if (curves := soil_curves.find_soil_curves(last, told[id(last)], runner)) is not None:
            d = replace(d, after=curves.stage, curves=curves.curves, located=anomaly_lines(curves.stage))
            total_gain = curves.gain
    before = residuals.mean_innovation_levels(residuals.residuals_of_logs(d.before.alone))
    after = residuals.mean_innovation_levels(residuals.residuals_of_logs(d.after.alone)) if d.extended else before
    located = d.located
    if d.verdict == "unexplained":  # replace lines of suspect sensors by located misfits
        other_lines = [line for line in d.located if line not in d.after.suspect_sensors]
        located = (
            *map(str, d.curves),
            *other_lines[:FIRST_ANOMALY_LINES],
            *residuals.locate_misfit(d.after.alone),
            *other_lines[FIRST_ANOMALY_LINES:],
        )
    differs = d.verdict == "named" and not d.findings  # several logs, of which each alone is explained
    unsure = d.verdict == "clean" or not deadline.is_over()
    remainder = measure_remainder(d.after, runner) if unsure and not differs else None
    if remainder is not None and remainder.chi2 > 0:
        if d.findings:
            d = _with_remainder(d, remainder.chi2)
        elif d.verdict == "clean":
            d = replace(d, verdict="unexplained", share=0.0)
            located = (f"{format_number(remainder.chi2, 3)} of chi-squared beyond noise, {remainder}",)
    return Assessment(
        d,
        total_gain,
        gains,
        before,
        after,
        tuple(dict.fromkeys(located)),
        separating_run.recommend_run(d),
        remainder=remainder,
    )


def _with_remainder(d: Diagnosis, chi2: float) -> Diagnosis:
    """Count the shares that findings explain against the misfit that they leave."""
    gained = sum(f.likelihood_ratio for f in d.findings) * d.after.dispersion
    factor = min(1.0, gained / (gained + chi2) / max(sum(f.share for f in d.findings), 1e-12))
    return replace(d, share=factor * d.share, findings=tuple(replace(f, share=factor * f.share) for f in d.findings))


def _hold_out(
    stages: Sequence[ExtendedFit],
    likelihood: bool,
    runner: CallRunner,
    report: ProgressCallback,
    every_turn: bool = False,
) -> list[HoldOutErrors | None]:
    """Predict withheld stretches with each model, side by side."""
    done = list[HoldOutErrors | None]()
    report(0.0, "measuring the gain")
    for errors in runner([partial(hold_out.hold_out_errors, s, every_turn, likelihood) for s in stages]):
        done.append(errors)
        report(len(done) / (len(stages) + 1), "measuring the gain")
    return done


def _reasons_against(d: Diagnosis, stages: Sequence[ExtendedFit], errors: Sequence[HoldOutErrors | None]) -> list[str]:
    """Say of each finding why it is not given, "" if it is. errors: of the stages on withheld stretches."""
    by_stage = dict(zip(map(id, stages), errors, strict=True))
    pairs = [(by_stage.get(id(x)), by_stage[id(d.after)]) for x in d.without]
    return [reason_against(f, d.after, *pair) for f, pair in zip(d.findings, pairs, strict=True)]


def explain(
    model: Model,
    logs: Sequence[Log],
    filter: Filter,
    progress: ProgressCallback | None = None,
    runner: CallRunner = run_in_turn,
    budget_s: float | None = None,
) -> Assessment:
    """Diagnose logs by joint smoothing, or by regression on the torques where all joints are driven and rigid.

    Where these torques are explained, joint smoothing says what shows near rest alone, if exact dynamics follow that.
    Several logs are compared first: if each alone is explained and they differ in parameters, that is the answer.
    budget_s [s]: after it, and after a first Ctrl-C, nothing new is begun, and the best answer so far is given. Raises
    NoEstimateError.
    """
    differences = _find_differences(model, logs, filter)
    if differences is not None:
        return _of_differences(differences, model, logs, filter, progress, runner)
    with interrupt.note_first_interrupt() as asked:
        deadline = Deadline(budget_s, lambda: asked.stop)
        found = _explain(model, logs, filter, progress, runner, deadline)
    if not deadline.reached:
        return found
    by = "Ctrl-C" if asked.stop else f"its budget of {format_number(budget_s or 0.0, 3)} s"
    return replace(found, cut_short=by)


def _of_differences(
    differences: Agreement,
    model: Model,
    logs: Sequence[Log],
    filter: Filter,
    progress: ProgressCallback | None,
    runner: CallRunner,
) -> Assessment:
    """Give differences between logs as the answer, beside the model without any effect."""
    verdict, now = "named" if differences.explained else "unexplained", Deadline(0.0)
    if torque_regression.by_torques(model):
        torques, errors = torque_regression.diagnose_torques(model, logs, filter, progress, now)
        torques = replace(torques, verdict=verdict, findings=(), after=torques.before, located=())
        return replace(assess_torques(torques, errors[:1]), differences=differences)
    found = diagnose(model, logs, filter, progress, runner, now)
    plain = replace(found, verdict=verdict, findings=(), without=(), after=found.before, nearest=None, located=())
    return replace(assess(plain, progress, runner), located=(), differences=differences)


def _find_differences(model: Model, logs: Sequence[Log], filter: Filter) -> Agreement | None:
    """Return what differs between several logs of which each alone is explained down to noise; None if nothing."""
    if model.effects:
        return None
    if torque_regression.by_torques(model):
        groups = identification.group_by_file(logs)
        alone = [torque_regression.estimate_if_explained(model, own, filter) for own in groups.values()]
        every = [x for x in alone if x is not None]
        agreement = identification.compare_logs(tuple(groups), every) if len(every) == len(groups) else None
        return None if agreement is None or agreement.agree else agreement
    agreement, estimates, _ = identification.compare_sources(model, logs, "joint", filter)
    if agreement is None or agreement.agree or any(e.status != "valid" for e in estimates):
        return None
    return agreement


def _explain(
    model: Model,
    logs: Sequence[Log],
    filter: Filter,
    progress: ProgressCallback | None,
    runner: CallRunner,
    deadline: Deadline,
) -> Assessment:
    """Diagnose as `explain` does."""
    report = progress or (lambda share, what: None)
    torques: Assessment | None = None
    if torque_regression.by_torques(model):
        torques = assess_torques(*torque_regression.diagnose_torques(model, logs, filter, report, deadline))
        followed = len(model.actuated) <= MAX_FOLLOWED_JOINTS
        if torques.diagnosis.verdict != "clean" or not followed or deadline.is_over():
            return torques
    left = 1 - DIAGNOSE_SHARE
    try:
        found = diagnose(
            model, logs, filter, lambda share, what: report(DIAGNOSE_SHARE * share, what), runner, deadline
        )
        every = assess(found, lambda share, what: report(DIAGNOSE_SHARE + left * share, what), runner, deadline)
    except NoEstimateError:
        if torques is None:
            raise
        return torques
    d = every.diagnosis
    told = d.verdict in ("named", "tied") or (d.verdict == "unexplained" and d.exact[0] and not deadline.reached)
    return every if torques is None or told else torques


def assess_torques(d: TorqueDiagnosis, errors: Sequence[HoldOutErrors]) -> Assessment:
    """Give a diagnosis by regression its gains, and each torque's error beside its noise."""
    rows = list(d.after.model.actuated)
    before, after = (
        {
            name: InnovationLevel(float(ratio**2), float(ratio**2))
            for (name, _), ratio in zip(errors[0].sensors, fit.level[rows] / fit.lowest[rows], strict=True)
        }
        for fit in (d.before, d.after)
    )
    gains = tuple(hold_out.hold_out_gain(a, b) for a, b in pairwise(errors))
    return Assessment(d, hold_out.hold_out_gain(errors[0], errors[-1]), gains, before, after, d.located, None)


def summarise(a: Assessment) -> dict[str, Any]:
    """Return the summary of `excite diagnose`, ready for JSON."""
    d = a.diagnosis
    return {
        "verdict": d.verdict,
        "answer": answer_text(a),
        "findings": [_finding_row(f, g) for f, g in zip(d.findings, a.gains, strict=True)],
        "differences": None if a.differences is None else identification.summarise_agreement(a.differences),
        "error_before_percent": a.total_gain.before if a.total_gain else None,
        "error_after_percent": a.total_gain.after if a.total_gain else None,
        "gain_percent": a.total_gain.percent if a.total_gain and d.extended else None,
        "gain_ci95": _interval_list(a.total_gain) if d.extended else None,
        "signals": signal_table(a),
        "separating_run": a.separating_run,
        "share_explained": d.share,
        "remainder": _remainder_row(a.remainder),
        "located": list(a.located),
        "nearest": {"effect": d.nearest.name, "share": d.nearest.share, "impossible": list(d.nearest.impossible)}
        if d.nearest
        else None,
        "parameters": parameter_table(d),
        "exact": dict(zip(("before", "after"), d.exact, strict=True)),
    }


def _finding_row(f: Finding, g: HoldOutGain | None) -> dict[str, Any]:
    return {
        "effect": f.effect,
        "where": f.where,
        "kind": f.kind,
        "share_percent": 100 * f.share,
        "tied_with": list(f.tied_with),
        "p_value": f.p_value,
        "amount": f.magnitude,
        "amount_std": f.magnitude_std,
        "unit": f.unit,
        "file_value": f.file_value,
        "shapes": {n: {"value": value, "std": std, "unit": unit} for n, (value, std, unit) in f.shapes.items()},
        "chi2_gain": f.likelihood_ratio,
        "gain_percent": g.percent if g else None,
        "gain_ci95": _interval_list(g),
    }


def _remainder_row(r: Remainder | None) -> dict[str, Any] | None:
    """Tabulate the misfit that is left: sum of squared innovations beyond noise, its place and its size."""
    if r is None:
        return None
    return {
        "chi2": r.chi2,
        "chi2_std": r.std,
        "signal": r.signal or None,
        "signal_share_percent": 100 * r.share,
        "times_noise": r.ratio,
        "where": list(r.where),
    }


def _interval_list(g: HoldOutGain | None) -> list[float] | None:
    return list(g.interval) if g and g.interval else None


def signal_table(a: Assessment) -> dict[str, dict[str, Any]]:
    """Tabulate hold-out errors [unit] and the systematic share of the innovations [%] by signal, before and after."""
    rows: dict[str, dict[str, Any]] = {}
    shown = a.total_gain.signals if a.total_gain else {}
    for name in dict.fromkeys([*a.before, *shown]):
        rms_before, rms_after, unit = shown.get(name, (np.nan, np.nan, ""))
        rows[name] = {
            "unit": unit,
            "rms_before": rms_before,
            "rms_after": rms_after,
            "systematic_before_percent": a.before[name].systematic_percent if name in a.before else np.nan,
            "systematic_after_percent": a.after[name].systematic_percent if name in a.after else np.nan,
        }
    return rows


def parameter_table(d: Diagnosis | TorqueDiagnosis) -> dict[str, dict[str, Any]]:
    """Tabulate base parameters before and after; `moved` is in standard deviations before."""
    return {
        p.name: {
            "unit": p.unit,
            "before": p.before,
            "std_before": p.std_before,
            "after": p.after,
            "std_after": p.std_after,
            "moved": (p.after - p.before) / p.std_before if p.std_before > 0 else None,
        }
        for p in d.parameters
    }


def describe_place(effect: str, where: str) -> str:
    """Return an effect at its place in words."""
    return f"{effect.replace('_', ' ')} ({where.replace('_', ' ')})"


def format_magnitude(row: Mapping[str, Any]) -> str:
    """Format a magnitude with its standard deviation, to its significant digits, and the value that it corrects."""
    amount, std, file_value = float(row["amount"]), float(row["amount_std"]), row["file_value"]
    text = format_uncertain(amount, std, row["unit"])
    if file_value is None:
        return text
    return f"{text} ({format_rounded(file_value + amount, std)}, by the machine file {file_value:g} {row['unit']})"


def answer_text(a: Assessment) -> str:
    """Return the diagnosis in a sentence or two."""
    d = a.diagnosis
    logs = "The log shows" if len(d.sources) == 1 else "The logs show"
    if a.differences is not None:
        each = "Each log alone shows nothing that the model lacks, but the logs differ"
        if not a.differences.explained:
            return f"{each} in more than {len(a.differences.changed)} parameters: diagnose each by itself."
        return f"{each}. {identification.describe_changes(a.differences)}."
    if d.verdict == "clean" and a.cut_short:
        return f"{logs} no misfit that stands out of noise, but the search for effects was ended by {a.cut_short}."
    if d.verdict == "clean":
        return f"{logs} nothing that the model lacks: the residuals are noise."
    rows = [_finding_row(f, g) for f, g in zip(d.findings, a.gains, strict=True)]
    named = ", and ".join(
        " or ".join(describe_place(*x.split("@")) for x in (f"{r['effect']}@{r['where']}", *r["tied_with"]))
        for r in rows
    )
    if d.verdict == "unexplained":
        text = f"{logs} a misfit that no known effect explains"
        if a.cut_short and not rows:
            return f"{logs} a misfit; the search for its cause was ended by {a.cut_short} before it found one."
        if rows:
            taken = ", ".join(
                f"{_with_rivals(r)} of {format_magnitude(r)} takes {format_share(r['share_percent'] / 100)}"
                for r in rows
            )
            text += f"; as a correction, {taken} of it"
            if a.total_gain:
                change = _describe_change(a.total_gain.percent, a.total_gain.interval)
                text += f", and the error on withheld stretches is {change}"
        elif d.nearest and (d.nearest.share >= MIN_NEAREST_SHARE or d.nearest.impossible):
            nearest = describe_place(*d.nearest.name.split("@"))
            text += f"; the nearest effect, {nearest}, explains {100 * d.nearest.share:.0f} % of it"
            if d.nearest.impossible:
                values = ", ".join(d.nearest.impossible)
                text += f", but then {values}, which no machine has (check the machine's dimensions)"
            if d.nearest.reason:
                text += f", but {d.nearest.reason}"
        if isinstance(d, Diagnosis) and d.curves:
            lacking = ", and ".join(f"{c.row[0]} lacks {c.lacks} that depends on {c.signal[0]}" for c in d.curves)
            change = _describe_change(d.curves[0].percent, d.curves[0].interval)
            text += f"; {lacking}, and with that the error on withheld stretches is {change}"
        return text + "."
    remark = ""
    if a.total_gain:
        reductions = [
            (1 - rms_after / rms_before, n)
            for n, (rms_before, rms_after, _) in a.total_gain.signals.items()
            if rms_before > 0
        ]
        largest = max(reductions)
        change = _describe_change(a.total_gain.percent, a.total_gain.interval)
        remark = (
            f" On withheld stretches the error of the model with it is {change}; most in {largest[1]}, by"
            f" {100 * largest[0]:.0f} %."
        )
    if a.remainder is not None and a.remainder.chi2 > 0:
        remark = f" That is {format_share(d.share)} of the misfit; the rest is unexplained, {a.remainder}.{remark}"
    elif d.share < FULL_EXPLANATION_SHARE:
        remark = f" That is {format_share(d.share)} of the misfit; the rest is unexplained.{remark}"
    elif a.located:
        left = a.located[0].removeprefix(f"{d.sources[0]}: ") if len(d.sources) == 1 else a.located[0]
        remark = f" Not all is explained: {left}.{remark}"
    if d.verdict == "tied":
        return f"{logs} {named}: the data cannot tell which.{remark}"
    return f"{logs} {named}: {'; '.join(format_magnitude(r) for r in rows)}.{remark}"


def format_share(share: float) -> str:
    """Format a share (0 to 1) in per cent, above 99 % rounded down: never as all of it if something is left."""
    percent = 100 * share
    return f"{math.floor(100 * percent) / 100:g} %" if percent > 99 else f"{format_number(percent, 2)} %"


def _with_rivals(row: Mapping[str, Any]) -> str:
    """Return a finding with those that it cannot be told from, in words."""
    also = " or ".join(describe_place(*x.split("@")) for x in row["tied_with"])
    return describe_place(row["effect"], row["where"]) + (f" (or {also})" if also else "")


def _describe_change(percent: float, interval: tuple[float, float] | None) -> str:
    if interval is None:
        return f"{format_number(abs(percent), 2)} % {'smaller' if percent >= 0 else 'larger'}"
    low, high = interval
    if percent >= 0:
        return f"{format_number(percent, 2)} % smaller (95 %: {format_number(low, 2)} to {format_number(high, 2)} %)"
    return f"{format_number(-percent, 2)} % larger (95 %: {format_number(-high, 2)} to {format_number(-low, 2)} %)"


# ------------------------------------------------------------------------------------------------ machine file


def machine_file(name: str, machine: Machine, d: Diagnosis | TorqueDiagnosis) -> str | None:
    """Return the machine with the findings, and with the curves as tables, as a TOML file; None if there are none.

    For a shipped machine the file holds only what is new; for a machine file it holds everything. Base parameters
    combine several parameters of the file and are left out.
    """
    curves = [c.entry for c in d.curves]
    if not (d.findings or curves):
        return None
    found = map(_effect_table, d.findings)
    entries = [*map(_entry_table, machine.effect), *map(_entry_table, found), *map(_entry_table, curves)]
    if name in shipped_machines():
        content: dict[str, Any] = {"extends": name}
    else:
        content = machine.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        content.pop("effect", None)
    logs = ", ".join(d.sources)
    head = [
        f"# {machine.title}, with what `excite diagnose` found in {logs}.",
        *(f"# {f.name} could as well be {' or '.join(f.tied_with)}." for f in d.findings if f.tied_with),
        "# The other parameters are unchanged: logs identify combinations of masses and inertias, not each of them.",
        "# `excite identify` with this file gives these combinations.",
    ]
    return "\n".join(head) + "\n\n" + tomli_w.dumps({**content, "effect": entries})


def _effect_table(f: Finding) -> dict[str, Any]:
    return {
        "name": f.effect,
        "where": f.where,
        "amount": {"value": _rounded(f.magnitude), "source": "identified"},
        "std": {"value": _rounded(f.magnitude_std), "source": "identified"},
        "shape": {
            n: {"value": _rounded(value), "source": "identified", "note": f"± {std:.2g} {unit}".rstrip(" -")}
            for n, (value, std, unit) in f.shapes.items()
        },
    }


def _entry_table(entry: EffectEntry | Mapping[str, Any]) -> dict[str, Any]:
    """Return an effect as a table of a machine file."""
    if isinstance(entry, EffectEntry):
        return entry.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    return {key: value for key, value in entry.items() if value != {}}


def _rounded(value: float) -> float:
    """Round a number to the digits of a machine file."""
    return float(f"{value:.{MACHINE_FILE_DIGITS}g}")
