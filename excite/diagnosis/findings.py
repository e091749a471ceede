"""The summary of a diagnosis, for people and programs, and the extended machine file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import tomli_w

from excite.diagnosis import hold_out, residuals, separating_run
from excite.diagnosis.diagnosis import Diagnosis, Finding
from excite.diagnosis.fits import with_true_sensor_noise
from excite.diagnosis.hold_out import HoldOutErrors, HoldOutGain
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.residuals import InnovationLevel
from excite.diagnosis.selection import ProgressCallback
from excite.model.machine import EffectEntry, Machine, shipped_machines

MACHINE_FILE_DIGITS = 8  # significant digits of magnitudes in a machine file; chosen
FIRST_ANOMALY_LINES = 3  # lines about anomalies that precede all others; chosen
MIN_NEAREST_SHARE = 0.05  # share of the misfit above which the nearest effect is mentioned; chosen
FULL_EXPLANATION_SHARE = 0.9  # share of the misfit below which the answer gives it; chosen


@dataclass(frozen=True)
class Assessment:
    """A diagnosis with what its findings gain.

    total_gain, gains: hold-out gain of all findings, and of each; None if no model could be fitted to the rest of the
    logs. before, after: size of each signal's innovations without and with the findings. located: where the misfit is.
    separating_run: the run that would separate tied causes.
    """

    diagnosis: Diagnosis
    total_gain: HoldOutGain | None
    gains: tuple[HoldOutGain | None, ...]
    before: Mapping[str, InnovationLevel]
    after: Mapping[str, InnovationLevel]
    located: tuple[str, ...]
    separating_run: str | None


def assess(
    d: Diagnosis,
    progress: ProgressCallback | None = None,
    runner: CallRunner = run_in_turn,
    extra_calls: Sequence[Callable[[], None]] = (),
) -> Assessment:
    """Measure hold-out gains and locate the misfit.

    The gain of a finding is that over the model with the findings before it. extra_calls: calls that are run side by
    side with the measurement.
    """
    report = progress or (lambda share, what: None)
    stages = [d.before, *d.stages]
    calls: list[Callable[[], HoldOutErrors | None]] = [
        *extra_calls,
        *(partial(hold_out.hold_out_errors, s) for s in stages),
    ]
    done = list[HoldOutErrors | None]()
    report(0.0, "measuring the gain")
    for errors in runner(calls):
        done.append(errors)
        report(len(done) / (len(calls) + 1), "measuring the gain")
    held = done[len(extra_calls) :]
    gains = tuple(hold_out.hold_out_gain(a, b) for a, b in pairwise(held))
    total_gain = hold_out.hold_out_gain(held[0], held[-1])
    before = residuals.mean_innovation_levels(residuals.residuals_of_logs(d.before))
    after = residuals.mean_innovation_levels(residuals.residuals_of_logs(d.after)) if d.stages else before
    located = d.located
    if d.verdict == "unexplained":  # replace lines of suspect sensors by located misfits
        measured = with_true_sensor_noise(d.after)
        other_lines = [line for line in d.located if line not in measured.suspect_sensors]
        located = (
            *other_lines[:FIRST_ANOMALY_LINES],
            *residuals.locate_misfit(measured),
            *other_lines[FIRST_ANOMALY_LINES:],
        )
    return Assessment(
        d, total_gain, gains, before, after, tuple(dict.fromkeys(located)), separating_run.recommend_run(d)
    )


def summarise(a: Assessment) -> dict[str, Any]:
    """Return the summary of `excite diagnose`, ready for JSON."""
    d = a.diagnosis
    return {
        "verdict": d.verdict,
        "answer": answer_text(a),
        "findings": [_finding_row(f, g) for f, g in zip(d.findings, a.gains, strict=True)],
        "error_before_percent": a.total_gain.before if a.total_gain else None,
        "error_after_percent": a.total_gain.after if a.total_gain else None,
        "gain_percent": a.total_gain.percent if a.total_gain and d.findings else None,
        "gain_ci95": _interval_list(a.total_gain) if d.findings else None,
        "signals": signal_table(a),
        "separating_run": a.separating_run,
        "share_explained": d.share,
        "located": list(a.located),
        "nearest": {
            "effect": d.nearest.name,
            "share": d.nearest.share,
            "impossible": list(d.nearest.impossible),
        }
        if d.nearest
        else None,
        "parameters": parameter_table(d),
        "exact": {"before": d.before.exact, "after": d.after.exact},
    }


def _finding_row(f: Finding, g: HoldOutGain | None) -> dict[str, Any]:
    return {
        "effect": f.effect,
        "where": f.where,
        "tied_with": list(f.tied_with),
        "p_value": f.p_value,
        "amount": f.magnitude,
        "amount_std": f.magnitude_std,
        "unit": f.unit,
        "shapes": {n: {"value": value, "std": std, "unit": unit} for n, (value, std, unit) in f.shapes.items()},
        "chi2_gain": f.likelihood_ratio,
        "gain_percent": g.percent if g else None,
        "gain_ci95": _interval_list(g),
    }


def _interval_list(g: HoldOutGain | None) -> list[float] | None:
    return list(g.interval) if g and g.interval else None


def signal_table(a: Assessment) -> dict[str, dict[str, Any]]:
    """Tabulate hold-out errors [unit] and the systematic share of the innovations [%] by signal, before and after."""
    rows: dict[str, dict[str, Any]] = {}
    for name in a.before:
        rms_before, rms_after, unit = (
            a.total_gain.signals[name] if a.total_gain and name in a.total_gain.signals else (np.nan, np.nan, "")
        )
        rows[name] = {
            "unit": unit,
            "rms_before": rms_before,
            "rms_after": rms_after,
            "systematic_before_percent": a.before[name].systematic_percent,
            "systematic_after_percent": a.after[name].systematic_percent,
        }
    return rows


def parameter_table(d: Diagnosis) -> dict[str, dict[str, Any]]:
    """Tabulate base parameters and standard deviations before and after; `moved` is in standard deviations before.

    There is no standard deviation before if no model without the findings followed the logs.
    """
    after = dict(zip(d.after.model.base.names, zip(d.after.fit.X, d.after.fit.std, strict=True), strict=True))
    rows = {}
    model = d.before.model
    for name, unit, value, std in zip(
        model.base.names, model.base.units, d.before.fit.X, d.before.fit.std, strict=True
    ):
        new, new_std = after[name]
        std = std if d.before.estimated else float("nan")
        rows[name] = {
            "unit": unit,
            "before": value,
            "std_before": std,
            "after": new,
            "std_after": new_std,
            "moved": (new - value) / std if std > 0 else None,
        }
    return rows


def describe_place(effect: str, where: str) -> str:
    """Return an effect at its place in words."""
    return f"{effect.replace('_', ' ')} ({where.replace('_', ' ')})"


def format_magnitude(row: Mapping[str, Any]) -> str:
    """Format a magnitude with its standard deviation, to its significant digits."""
    value, std = float(row["amount"]), float(row["amount_std"])
    unit = "" if row["unit"] == "-" else f" {row['unit']}"
    if not (np.isfinite(std) and std > 0):
        return f"{value:.4g}{unit}"
    digits = int(np.clip(np.floor(np.log10(max(abs(value), std))) - np.floor(np.log10(std)) + 2, 2, 8))
    return f"{value:.{digits}g} ± {std:.2g}{unit}"


def answer_text(a: Assessment) -> str:
    """Return the diagnosis in a sentence or two."""
    d = a.diagnosis
    logs = "The log shows" if len(d.before.data.logs) == 1 else "The logs show"
    if d.verdict == "clean":
        return f"{logs} nothing that the model lacks: the residuals are noise."
    rows = [_finding_row(f, g) for f, g in zip(d.findings, a.gains, strict=True)]
    named = ", and ".join(
        " or ".join(describe_place(*x.split("@")) for x in (f"{r['effect']}@{r['where']}", *r["tied_with"]))
        for r in rows
    )
    if d.verdict == "unexplained":
        text = f"{logs} a misfit that no known effect explains"
        if rows:
            more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
            first = describe_place(rows[0]["effect"], rows[0]["where"])
            text += (
                f"; {first}{more} would account for {100 * d.share:.0f} % of it, too little to be named as the cause"
            )
        elif d.nearest and (d.nearest.share >= MIN_NEAREST_SHARE or d.nearest.impossible):
            nearest = describe_place(*d.nearest.name.split("@"))
            text += f"; the nearest effect, {nearest}, explains {100 * d.nearest.share:.0f} % of it"
            if d.nearest.impossible:
                values = ", ".join(d.nearest.impossible)
                text += f", but then {values}, which no machine has (check the machine's dimensions)"
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
    if d.share < FULL_EXPLANATION_SHARE:
        remark = f" That is {100 * d.share:.0f} % of the misfit; the rest is unexplained.{remark}"
    if d.verdict == "tied":
        return f"{logs} {named}: the data cannot tell which.{remark}"
    return f"{logs} {named}: {'; '.join(format_magnitude(r) for r in rows)}.{remark}"


def _describe_change(percent: float, interval: tuple[float, float] | None) -> str:
    if interval is None:
        return f"{abs(percent):.2g} % {'smaller' if percent >= 0 else 'larger'}"
    low, high = interval
    if percent >= 0:
        return f"{percent:.2g} % smaller (95 %: {low:.2g} to {high:.2g} %)"
    return f"{-percent:.2g} % larger (95 %: {-high:.2g} to {-low:.2g} %)"


# ------------------------------------------------------------------------------------------------ machine file


def machine_file(name: str, machine: Machine, d: Diagnosis) -> str | None:
    """Return the machine with the findings as a TOML file; None if nothing is named.

    For a shipped machine the file holds only what is new; for a machine file it holds everything. Base parameters
    combine several parameters of the file and are left out.
    """
    if not d.findings or d.verdict == "unexplained":
        return None
    found = [_effect_table(f) for f in d.findings]
    entries = [*map(_entry_table, machine.effect), *map(_entry_table, found)]
    if name in shipped_machines():
        content: dict[str, Any] = {"extends": name}
    else:
        content = machine.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        content.pop("effect", None)
    logs = ", ".join(x.source for x in d.before.data.logs)
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
