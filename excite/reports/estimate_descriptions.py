"""Verifications, estimates, predictions and contact laws in words and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.stats

from excite.identification import SIGNIFICANT_BIAS
from excite.reports.description import (
    Description,
    Summary,
    Table,
    describe_outside_law,
    format_sum,
    join_some,
    meaning,
    meaning_column,
    meaning_index,
)
from excite.smoothing import MAX_IDENTIFIABLE_STD
from excite.text import count, format_number, format_percent, format_rounded, format_uncertain

MISFIT_OF_REPEATS = 2.0  # error over repeatability, from which something remains; chosen
FALSE_ALARM = 0.01  # probability of a verdict against intervals that hold; chosen
MOVED_LEVEL = 1e-3  # p-value below which more than a payload changed between two estimates; chosen


def describe_verify(s: Summary) -> Description:
    """Describe a verification: errors against the truth, coverage of the intervals, biased parameters."""
    title, rows = f"Verification of a drive for {s['machine']}", s["parameters"]
    errors = {n: float(r["rms_percent"]) for n, r in rows.items() if np.isfinite(r["rms_percent"])}
    if not errors:
        return Description(title, f"No parameter was identified in {count(s['runs'], 'simulated test day')}.")
    worst = max(errors, key=lambda n: errors[n])
    cover = 100 * float(np.mean([rows[n]["coverage95"] for n in errors]))
    median = float(np.median(list(errors.values())))
    headline = (
        f"In {count(s['runs'], 'simulated test day')} the parameters came out within {format_percent(median)} of the"
        f" truth (median; worst {worst}, {format_percent(errors[worst])}), and the 95 % intervals held it in"
        f" {cover:.0f} % of cases."
    )
    remarks = [f"Biased, the intervals do not hold: {', '.join(s['biased'])}."] if s["biased"] else []
    remarks += describe_outside_law(s.get("share_outside_law"))
    if s["failed"]:
        remarks.append(f"{count(s['failed'], 'run')} gave no estimate.")
    table = tuple(
        (
            n,
            *meaning(s, n),
            r["unit"],
            format_number(r["true"], 6),
            format_number(r["mean"], 6),
            *(format_number(r[k], 3) for k in ("bias_percent", "std_percent", "predicted_std_percent")),
            format_number(100 * r["coverage95"], 3),
        )
        for n, r in rows.items()
    )
    names = ("parameter", *meaning_column(s), "unit", "true", "mean", "bias %", "std %", "predicted std %")
    marked = tuple(k for k, n in enumerate(rows) if n in s["biased"])
    caption = "True and estimated parameters; biased ones are set off."
    if s.get("method"):
        caption = f"True and estimated parameters, method {s['method']}, kit {s['kit']}; biased ones are set off."
    tables = (Table(caption, (*names, "coverage %"), table, marked, meaning_index(s)),)
    return Description(title, headline, tables, tuple(remarks), verdict=_judge_drive(s, errors[worst]))


def _judge_drive(s: Summary, worst_percent: float) -> str:
    """Say in a sentence whether intervals hold and what the drive shows."""
    runs = s["runs"] - s["failed"]
    narrow = [n for n, r in s["parameters"].items() if n not in s["biased"] and _misses_too_often(r, s)]
    wrong = [*s["biased"], *narrow]
    shown = f"the drive shows every parameter to {format_percent(worst_percent)} or better"
    if worst_percent > 100 * MAX_IDENTIFIABLE_STD:
        shown = f"the drive does not show every parameter (errors up to {format_percent(worst_percent)})"
    if wrong:
        return f"{shown}, but the 95 % intervals of {join_some(wrong)} do not hold."
    tell = f"as far as {count(runs, 'test day tells', 'test days tell')}"
    return f"{shown}, and the 95 % intervals hold, {tell}."


def _misses_too_often(row: Mapping[str, Any], s: Summary) -> bool:
    """Tell if an interval holds the truth less often than chance leaves to one of 95 %, all parameters together."""
    runs = s["runs"] - s["failed"]
    if not runs or not np.isfinite(row["coverage95"]):
        return False
    held = round(runs * row["coverage95"])
    return bool(scipy.stats.binom.cdf(held, runs, 0.95) < FALSE_ALARM / len(s["parameters"]))


ESTIMATE_COLUMNS = (  # of a parameter: heading, key
    ("value", "value"),
    ("std", "std"),
    ("std %", "std_percent"),
    ("std total", "std_total"),
    ("95 % from", "low95"),
    ("to", "high95"),
)


def _estimate_cell(row: Mapping[str, Any], key: str) -> str:
    """Format a number of a parameter: one in its unit to the decimals of its standard deviation, or in per cent."""
    return format_number(row.get(key), 2) if key.endswith("percent") else format_rounded(row.get(key), row["std"])


def _total_percent(row: Mapping[str, Any]) -> float:
    """Return the standard deviation of a parameter with the tolerances, in per cent of its value."""
    return abs(row["std_percent"]) * (row.get("std_total") or row["std"]) / row["std"] if row["std"] else 0.0


def describe_identify(s: Summary) -> Description:
    """Describe an estimate: accuracy, prediction error, bias of the method, parameters that are not identifiable."""
    rows = s["parameters"]
    known = {n: _total_percent(r) for n, r in rows.items() if r["std_percent"] is not None}
    known = {n: v for n, v in known.items() if np.isfinite(v)}
    tolerated = any(r.get("std_total") not in (None, r["std"]) for r in rows.values())
    with_tolerances = ", tolerances included" if tolerated else ""
    worst = max(known, key=lambda n: known[n], default="")
    every = len(known) + len(s["unidentifiable"])
    what = count(every, "parameter is", "parameters are")
    what = f"{len(known)} of {what}" if s["unidentifiable"] else what
    logs = "one log" if len(s["logs"]) == 1 else f"{len(s['logs'])} logs"
    error = _prediction_error(s)
    accuracy = (
        f" {format_percent(float(np.median(list(known.values()))))} (median, one standard deviation{with_tolerances};"
        f" worst {worst}, {format_percent(known[worst])})"
        if known
        else " no known accuracy"
    )
    headline = f"From {logs}, {what} identified to{accuracy}; {error}."
    if s["status"] == "doubtful":
        headline = (
            f"From {logs}, {what} estimated, but their 95 % intervals do not hold: {s['doubt']} (stated:{accuracy};"
            f" {error})."
        )
    off = {n: abs(r["bias"] / (r["value"] - r["bias"])) for n, r in rows.items() if n in known and _is_biased(r)}
    impossible = [n for n, r in rows.items() if not r["possible"]]
    if impossible and s["status"] == "valid":
        have = "has a value" if len(impossible) == 1 else "have values"
        headline = f"{headline[:-1]}; {join_some(impossible)} {have} that no machine has."
    if s["status"] == "invalid":
        reason = f", and {join_some(impossible)} would have values that no machine has" if impossible else ""
        headline = f"No estimate from {logs} ({error}){reason}: {s['doubt']}."
    wrong: tuple[str, ...] = ()
    if off and s["status"] != "invalid":
        most = max(off, key=lambda n: off[n])
        wrong = (
            f"On simulated logs like this {s['method']} is wrong by up to {format_percent(100 * off[most])} ({most}),"
            f" in {count(len(off), 'parameter')} by more than it says.",
        )
    remarks = [
        *wrong,
        *_describe_reasons(s["reasons"]),
        *dict.fromkeys(s["notes"]),
        *describe_outside_law(s.get("share_outside_law")),
    ]
    for check in s["validation"]:
        remarks.append(_describe_validation(check))
    biased = any("bias" in r for r in rows.values())
    prior = any("prior_std" in r for r in rows.values())
    table = tuple(
        (
            n,
            *meaning(s, n),
            r["unit"],
            *(_estimate_cell(r, k) for _, k in ESTIMATE_COLUMNS),
            *((format_number(r.get("prior_std"), 2),) if prior else ()),
            *((format_rounded(r.get("bias"), r["std"], 3),) if biased else ()),
            *(("" if r["possible"] else "no", format_rounded(r.get("consistent"), r["std"])) if impossible else ()),
        )
        for n, r in rows.items()
    )
    names = (
        "parameter",
        *meaning_column(s),
        "unit",
        *(heading for heading, _ in ESTIMATE_COLUMNS),
        *(("std known before",) if prior else ()),
        *(("bias of the method",) if biased else ()),
        *(("possible", "nearest possible machine") if impossible else ()),
    )
    conds = f"cond(W) {format_number(s['cond_w'], 4)}, cond(Phi) {format_number(s['cond_phi'], 4)}"
    caption = f"Parameters with one standard deviation and 95 % interval, method {s['method']}; {conds}."
    if s["status"] == "invalid":
        caption = (
            f"No estimate: where the fit by {s['method']} ended, to find the cause. {conds[0].upper()}{conds[1:]}."
        )
    marked = tuple(k for k, r in enumerate(rows.values()) if not r["possible"])
    by_joint = s.get("error_by_joint", {})
    tables = (
        Table(caption, names, table, marked, meaning_index(s), grey=s["status"] != "valid"),
        *((_fit_table(s["fit"]),) if s.get("fit") else ()),
        *((_budget_table(s),) if any(len(x) > 1 for x in s.get("budget", {}).values()) else ()),
        *((_joint_errors_table(by_joint),) if len(by_joint) > 1 and not s.get("fit") else ()),
        *((_payload_table(s["payload"]),) if "payload" in s else ()),
    )
    verdict = _judge_estimate(s, max(known.values(), default=None), impossible)
    if "torque_constant" in s and s["status"] != "invalid":
        remarks = [_describe_constant(s["torque_constant"]), *remarks]
    return Description(f"Parameters of {s['machine']}", headline, tables, tuple(remarks), s["status"], verdict)


def _describe_reasons(reasons: Mapping[str, str]) -> list[str]:
    """Say why parameters can't be identified, a remark for all of one reason."""
    together: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        together.setdefault(reason, []).append(name)
    return [f"{', '.join(names)} can't be identified: {reason}." for reason, names in together.items()]


def _describe_constant(c: Mapping[str, Any]) -> str:
    """Say what the torque constant is, and from which known quantities."""
    return (
        f"Torque constant of the motors: {format_uncertain(c['value'], c['std'], c['unit'])} (95 %:"
        f" {format_number(c['low95'], 4)} to {format_number(c['high95'], 4)}), from {', '.join(c['known'])}; multiply a"
        " value by it to get it in SI units."
    )


def _prediction_error(s: Summary) -> str:
    """Say how far torques that are predicted from the measured motion are off those that were measured."""
    fit = [r for r in s.get("fit", {}).values() if r["measured_rms"]]
    if fit:
        worst = max(fit, key=lambda r: r["rms"] / r["measured_rms"])
        text = (
            "torques predicted from the measured motion are off by"
            f" {format_percent(100 * worst['rms'] / worst['measured_rms'])} of their rms at most"
        )
        if worst["expected_rms"]:
            ratio = format_number(worst["rms"] / worst["expected_rms"], 2)
            text += f" ({ratio} times what noise and the parameters' uncertainty explain)"
        return text
    share = s["relative_error_percent"]
    if share is None or not np.isfinite(share):
        return "the prediction error is unknown, as no torque was measured"
    return f"the prediction error is {format_percent(share)} of what was measured"


def _fit_table(fit: Mapping[str, Any]) -> Table:
    """Table of the fit of each torque, and of the correlations of its residual."""
    rows = tuple(
        (
            name,
            _percent(r["fit_percent"]),
            _percent(r.get("noise_percent")),
            format_number(r["rms"], 3),
            r["unit"],
            *(_correlation(r, key) for key in ("auto", "cross")),
        )
        for name, r in fit.items()
    )
    bounds = [r["bound"] for r in fit.values() if "bound" in r]
    bound = f" White noise keeps 95 % of its correlations within +- {format_number(max(bounds), 2)}." if bounds else ""
    caption = (
        "Torques predicted from the measured motion, low-passed (not smoothed): fit, 100 % without an error; the fit"
        " that the sensors' noise alone would leave; and how the residual is correlated with itself and with the"
        f" predicted torque.{bound}"
    )
    names = ("torque", "fit [%]", "noise alone [%]", "rms error", "unit", "autocorrelation", "cross-correlation")
    return Table(caption, names, rows)


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _correlation(r: Mapping[str, Any], key: str) -> str:
    """Give the largest correlation, and the share of lags beyond the bound."""
    return f"{r[key]:.2f} ({r[f'{key}_outside']:.0f} % of lags beyond)" if key in r else ""


def _budget_table(s: Summary) -> Table:
    """Table of what makes each parameter's variance: noise, and the tolerances that matter most."""
    rows = tuple(
        (
            name,
            format_number(100 * shares["noise"], 2),
            join_some([f"{source} {format_percent(100 * x)}" for source, x in shares.items() if source != "noise"][:3]),
        )
        for name, shares in s["budget"].items()
    )
    caption = (
        "What makes the variance of each interval: noise with what the model lacks, and the tolerances of the machine"
        " file that matter most. What takes a large share is worth measuring."
    )
    return Table(caption, ("parameter", "noise %", "tolerances"), rows, grey=s["status"] != "valid")


def _joint_errors_table(by_joint: Mapping[str, Any]) -> Table:
    rows = tuple(
        (name.replace("_", " "), format_percent(e["percent"]), format_number(e["rms"], 3), e["unit"])
        for name, e in by_joint.items()
    )
    caption = "Prediction error by joint, in per cent of the torque (rms) that was measured there."
    return Table(caption, ("joint", "error", "rms", "unit"), rows)


def _payload_table(payload: Mapping[str, Any]) -> Table:
    """Table of a payload's parameters in the frame of its body, with its centre of mass."""
    rows = [
        (n, format_sum(r["grouping"]), r["unit"], format_rounded(r["value"], r["std"]), format_number(r["std"], 2))
        for n, r in payload["parameters"].items()
    ]
    for axis, x, std in zip("xyz", payload.get("centre_m", ()), payload.get("centre_std_m", ()), strict=False):
        rows.append((axis, "centre of mass", "m", format_rounded(x, std), format_number(std, 2)))
    moved = np.isfinite(payload["p_value"] or np.nan) and payload["p_value"] < MOVED_LEVEL
    doubt = " Other parameters changed as well between the two estimates, so these are no payload's." if moved else ""
    caption = f"Payload in the frame of {payload['body']}, from the difference to the estimate without it.{doubt}"
    return Table(caption, ("parameter", "is", "unit", "value", "std"), tuple(rows), grey=bool(moved))


def _judge_estimate(s: Summary, worst_percent: float | None, impossible: Sequence[str]) -> str:
    """Say in a sentence what an estimate can be used for."""
    if s["status"] == "invalid":
        return "there is no estimate, use none of its values; `excite diagnose` looks for the cause."
    if s["status"] == "doubtful":
        return "doubtful, values may be off by more than their intervals say; `excite diagnose` looks for the cause."
    if lacking := [*impossible, *s["unidentifiable"]]:
        return f"valid except for {join_some(lacking)}; a drive that shows more of the machine may give them."
    if worst_percent is None:
        return "valid, of unknown accuracy."
    lacks = ", ".join(f"{format_number(d['rms'], 2)} {d['unit']} in {n}" for n, d in s.get("discrepancy", {}).items())
    although = f" although the model lacks {lacks}" if lacks else ""
    accuracy = format_percent(worst_percent)
    return f"valid, the 95 % intervals hold{although}; every parameter is known to {accuracy} or better."


def validated_log(check: Mapping[str, Any]) -> str:
    """Name a log for validation, and say if it was fitted itself."""
    return f"{check['log']}, which was {'fitted itself and validates nothing' if check.get('fitted') else 'not fitted'}"


def _describe_validation(check: Mapping[str, Any]) -> str:
    """Compare a log's prediction error with what noise and the parameters' uncertainty make of it."""
    errors = ", ".join(
        f"{n} {v:.1f} % (noise alone {check['noise_percent'][n]:.1f} %, parameters"
        f" {check['parameters_percent'][n]:.1f} %)"
        for n, v in check["torque_error_percent"].items()
    )
    text = f"On {validated_log(check)}, the torque errors are {errors}"
    if not check["outside"]:
        return f"{text}: the rest is within noise and the parameters' uncertainty."
    return f"{text}: more than these explain in {_worst_seconds(check['outside'])}."


def _worst_seconds(outside: Sequence[Mapping[str, Any]]) -> str:
    """List signals that leave their band, each with the second in which it does most."""
    return ", ".join(
        f"{x['signal']} (most from {x['from_s']:.1f} to {x['to_s']:.1f} s, {x['ratio']:.1f} times)" for x in outside
    )


def describe_predict(s: Summary) -> Description:
    """Describe a prediction: width of the bands, where a log leaves them, what an open-loop motion is worth."""
    rows = s["signals"]
    judged = {n: r for n, r in rows.items() if not r["free"]}
    share = {n: 100 * r["rms_band"] / r["rms"] for n, r in judged.items() if r["rms"] > 0}
    worst = max(share, key=lambda n: share[n], default=None)
    within = (
        "to be zero"
        if worst is None
        else f"to +- {format_percent(float(np.median(list(share.values()))))} (half the 95 % band, of the signal's rms;"
        f" median, worst {worst}, {format_percent(share[worst])})"
    )
    if s["along"] == "log":
        headline = f"Along {s['target']} the drive torques are predicted {within}; {_describe_outside(s)}."
        basis = (
            "A log shows the motion, so the torques follow from it by inverse dynamics, low-passed as the readings are."
            " The band is that of the true torque if the model is right: the parameters' uncertainty, and the sensors'"
            " noise in the motion. A reading adds the noise of its own sensor."
        )
    else:
        planned = any(r["unit"] in FORCES for r in rows.values())
        what = "the motion, and the torques that the planned motion needs, are" if planned else "the motion is"
        headline = f"Under the torques of {s['target']} {what} predicted {within}."
        basis = (
            "A profile gives the torques, so the motion is simulated in open loop. The band is that of the parameters'"
            " uncertainty, to first order, if the model is right."
        )
    remarks = [basis]
    free = {n: r for n, r in rows.items() if r["free"]}
    if free:
        ends = ", ".join(f"{n} +- {format_number(r['at_end'], 2)} {r['unit']}" for n, r in free.items())
        remarks.append(
            f"No force depends on these positions, so errors of speed add up in them: at the end {ends}. They are no"
            " fair measure of a model, speeds are."
        )
    if s["assumed"]:
        remarks.append(
            "Not identified, so taken from the machine file, with an error that is in no band:"
            f" {', '.join(s['assumed'])}."
        )
    if s["status"] == "doubtful":
        headline = f"The 95 % bands do not hold, as the estimate is doubtful: {s['doubt']}. {headline}"
    log = s["along"] == "log"
    table = tuple(
        (
            n,
            r["unit"],
            *(format_number(r[k], 3) for k in ("rms", "rms_band")),
            *((format_number(r["rms_parameters"], 3), format_number(r["rms_noise"], 3)) if log else ()),
            format_number(r["at_end"], 3),
            *((format_number(100 * r["share_outside"], 2),) if log else ()),
        )
        for n, r in rows.items()
    )
    columns = (
        *("signal", "unit", "rms", "95 % band +-"),
        *(("by parameters", "by noise") if log else ()),
        "band at the end +-",
        *(("readings outside %",) if log else ()),
    )
    caption = "Predicted signals: root mean square over time of each, and of half its 95 % band."
    if free:
        caption += " Positions in which errors add up are set off."
    marked = tuple(k for k, r in enumerate(rows.values()) if r["free"])
    tables = (Table(caption, columns, table, marked, grey=s["status"] != "valid"),)
    return Description(f"Prediction for {s['machine']}", headline, tables, (*remarks, *s["notes"]), s["status"])


FORCES = ("N m", "N")


def _describe_outside(s: Summary) -> str:
    """Say where the readings of a log leave the prediction."""
    share = 100 * float(np.mean([r["share_outside"] for r in s["signals"].values()]))
    text = f"{format_percent(share)} of the readings are outside their 95 % band (5 % if the model is right)"
    if not s["outside"]:
        return text
    worst = _worst_seconds(s["outside"])
    return f"{text}. The model lacks something in {worst}: the band does not hold there, `excite diagnose` finds causes"


def _is_biased(row: Mapping[str, Any]) -> bool:
    """Return whether the method's bias of a parameter is significant and larger than its standard deviation."""
    bias, std = row.get("bias"), row.get("bias_std")
    return bias is not None and std is not None and abs(bias) > max(row["std"], SIGNIFICANT_BIAS * std)


def describe_slip(s: Summary) -> Description:
    """Describe contact laws fitted to a single-wheel test: the laws supported, their errors, the contact."""
    soil = s["soil"]
    remarks = []
    if soil is not None:
        remarks.append(
            f"The soil's constants give Kx = Ky = {format_number(soil['Kx_N'], 4)} N and the saturation slip K / xi_s ="
            f" {format_number(soil['saturation_slip'], 3)}: (18), linear while |g| stays well below it (20)."
        )
    if s["table"] is None:
        return Description(
            "The contact of a soil", "contact.toml holds the contact for a machine file.", (), tuple(remarks)
        )
    supported, laws = s["supported"], s["laws"]
    first = next(r for r in laws if r["law"] == supported[0])
    known = [x for x in s["repeatability_N"].values() if x is not None]
    if len(supported) == 1:
        headline = f"The data support one law: {supported[0]}."
    else:
        headline = f"These data can't tell {len(supported)} laws apart: {'; '.join(supported)}."
    headline += (
        f" {'It' if len(supported) == 1 else 'The first'} errs by {format_number(first['rms_left_out_N'], 3)} N on"
        " settings left out of the fit"
    )
    headline += f"; repeats differ by {format_number(max(known), 2)} N." if known else "; nothing was repeated."
    if s["best"] not in supported:
        best = next(r for r in laws if r["law"] == s["best"])
        remarks.append(
            f"{s['best']} errs less, by {format_number(best['rms_left_out_N'], 3)} N, but adds to a law that these data"
            f" do not rule out (chance {format_number(first['chance'], 2)} against it; 0.5 is as good)."
        )
    if known and first["rms_left_out_N"] > MISFIT_OF_REPEATS * max(known):
        remarks.append(
            f"Repeats do not explain the error of {supported[0]}: something remains that it does not describe."
        )
    if s["per"] == "larger":
        remarks.append(
            "Slips are divided by the larger speed. Machine files divide by the rim speed, which is the same for a"
            " driving wheel only: with --per rim the law holds for braking in a machine file, too."
        )
    rows = tuple(
        (
            r["law"],
            ", ".join(
                f"{n.replace('_', ' ')} {format_uncertain(p['value'], p['std'] or 0.0, p['unit'])}"
                + ("" if p["std"] or r["chance"] is None else " (at its bound)")
                for n, p in r["parameters"].items()
            ),
            format_number(r["rms_fitted_N"], 3),
            format_number(r["rms_left_out_N"], 3) if r["chance"] is not None else "-",
            format_number(r["chance"], 2),
        )
        for r in laws
    )
    marked = tuple(k for k, r in enumerate(laws) if r["supported"])
    caption = (
        f"Laws by their error on settings left out ({s['settings']} settings, {s['rows']} rows); chance: of predicting"
        " a new setting better than the first, 0.5 is as well, below 0.05 a law is ruled out."
    )
    columns = ("law", "parameters", "error fitted [N]", "left out [N]", "chance")
    table = Table(caption, columns, rows, marked, optional=(1,))
    return Description(f"Contact laws of {s['table']}", headline, (table,), (*remarks, *s["notes"]))
