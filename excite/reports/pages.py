"""What each command's `report.html` says: the answer in a sentence, figure, table, how it was made."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from excite import output, trajectories
from excite.identification import SIGNIFICANT_BIAS
from excite.logs import guess_machine, inspect, read_table, table_of
from excite.model.machine import load_machine
from excite.reports import figures
from excite.reports.html import Picture, Table, report_page
from excite.text import first_lines, format_number, format_p_value, format_percent
from excite.trajectories import TOLERANCE

REPORT = "report.html"
Summary = Mapping[str, Any]

CAPTIONS = {
    "design.png": "The drive: torques in per cent of their limits, speeds [m/s], steered joints [rad] and slips [-]"
    " over time, dotted lines the limits; how much of each limit it uses, in per cent; where the machine steers, its"
    " path on the lane from above, dots the start.",
    "sigma.png": "What accuracy the drive makes attainable: one standard deviation (Cramer-Rao bound, all sensors"
    " together) of every parameter in per cent of its nominal value, on a logarithmic axis.",
    "verify.png": "Left, every simulated run's error of every parameter in per cent of the true value: dots are runs,"
    " diamonds their mean, grey bars the 95 % interval that the estimator itself predicts. Right, in how many runs the"
    " interval holds the truth; 95 % is what it claims.",
    "log.png": "Every channel that the machine file knows, in SI units, over time; dashed lines mark gaps.",
    "signals.png": "Left, how much of each signal's error is systematic, the rest being noise. Right, the error on"
    " stretches that were withheld from the fit, in the signal's unit and in per cent of the error without what was"
    " found.",
    "compare.png": "Drives side by side: condition number of Phi, and attainable standard deviation of the worst"
    " parameter [%]; hatched drives break a limit that their label names.",
}
LOGGED = {
    "misfit": "What the model lacks in {}: the torque (and force, where only such let the model follow the log) that is"
    " missing on average, against what the machine does. Flat at zero is right; grey is what noise alone leaves.",
    "when": "Left, when and in which signal the model is off in {}; right, at which speed and steering angle (or"
    " torque). The error of one step ahead in units of noise: 1 is noise alone.",
}
FIT = (
    "Measured and predicted drive torques, and what is left between them, over time, for {}. Each torque is predicted"
    " from the motion that the log shows, by filtered derivatives: the noise of the sensors, of slips above all, comes"
    " on top of what the parameters leave. So more may be left here than the first sentence says, which is of the"
    " method's own prediction."
)
ESTIMATE = (  # what is told of a parameter: heading, key, digits
    ("value", "value", 6),
    ("std", "std", 3),
    ("std %", "std_percent", 3),
    ("95 % from", "low95", 6),
    ("to", "high95", 6),
)


def write(place: Path, kind: str, summary: Summary) -> None:
    """report.html of a command's folder, from its summary and the figures that are there. KeyError: unknown kind."""
    title, answer, remarks, shown = KINDS[kind](summary)
    pictures = [Picture(path, _caption(path.name, summary)) for path in sorted(place.glob("*.png"))]
    order = list(CAPTIONS)
    pictures.sort(key=lambda p: order.index(p.path.name) if p.path.name in order else len(order))
    text = report_page(title, answer, pictures, shown, how(summary), remarks)
    (place / REPORT).write_text(text, encoding="utf-8")


def write_report(place: Path, kind: str, summary: Summary) -> None:
    """Report and summary of a command's folder, once its figures are there."""
    write(place, kind, summary)
    output.write_summary(place, summary)


def how(summary: Summary) -> dict[str, str]:
    """How a result was made: command, machine, settings, seed, versions."""
    rows = {"command": shlex.join(["excite", *sys.argv[1:]])}
    names = ("machine", "problem", "objective", "method", "kit", "runs", "samples", "starts", "design", "duration_s")
    for key in (*names, "budget_s", "seed", "wall_s"):
        value = summary.get(key)
        if value is not None:
            name, unit = (key[:-2], " s") if key.endswith("_s") else (key, "")
            rows[{"wall": "computed in"}.get(name, name)] = f"{format_number(value, 4)}{unit}"
    if summary.get("logs"):
        rows["logs"] = ", ".join(summary["logs"])
    rows["versions"] = ", ".join(f"{name} {version}" for name, version in summary["versions"].items())
    return rows


def _caption(name: str, summary: Summary) -> str:
    if name in CAPTIONS:
        return CAPTIONS[name]
    kind, _, number = name.removesuffix(".png").partition("-")
    k = int(number or 1) - 1
    if kind == "validation":
        return FIT.format(f"{summary['validation'][k]['log']}, which the parameters were not fitted on")
    if kind in LOGGED:
        return LOGGED[kind].format(summary["logs"][k])
    return FIT.format(summary["logs"][k]) if kind == "fit" else name


def check_log(place: Path, path: Path, machine: str | None, versions: Mapping[str, str]) -> dict[str, Any]:
    """What is in a log, with its picture and report in a folder. Raises LogError where it can't be read at all."""
    table = read_table(path)
    loaded = load_machine(machine) if machine is not None else guess_machine(table)
    if loaded is not None:
        table = table_of(path, loaded)
    found = inspect(table, loaded, str(path))
    summary: dict[str, Any] = {
        "log": str(path),
        "machine": found.machine,
        "usable": found.usable and found.machine is not None,
        "rows": found.rows,
        "duration_s": found.duration_s if np.isfinite(found.duration_s) else None,
        "rate_hz": found.rate_hz if np.isfinite(found.rate_hz) else None,
        "faults": list(found.faults),
        "doubts": list(found.doubts),
        "remarks": list(found.remarks),
        "columns": [asdict(c) for c in found.columns],
        "versions": dict(versions),
    }
    if found.signals:
        figures.save(figures.log_figure(found.signals, found.gaps, str(path)), place / "log.png")
    write_report(place, "log", summary)
    return summary


Said = tuple[str, str, Sequence[str], Sequence[Table]]


def _meaning(s: Summary) -> tuple[str, ...]:
    """The column that says what parameters are, where a summary does."""
    return ("what it is",) if s.get("meanings") else ()


def _meant(s: Summary, name: str) -> tuple[str, ...]:
    return (s["meanings"].get(name, "-"),) if s.get("meanings") else ()


def _design(s: Summary) -> Said:
    sigma = s["sigma_percent"]
    worst = max(sigma, key=lambda n: sigma[n])
    kept = s["max_violation"] <= TOLERANCE
    limits = (
        "every limit is kept" if kept else f"limits are exceeded by {100 * s['max_violation']:.2f} % of their range"
    )
    driven = "Followed by a steady person" if s.get("driver") else "Driven as designed"
    answer = (
        f"{driven}, these {s['duration_s']:g} s can tell every parameter to {format_percent(sigma[worst])} or better"
        f" (one standard deviation; worst {worst}, median {format_percent(np.median(list(sigma.values())))}); {limits}."
    )
    remarks = [
        f"Condition number of Phi {s['cond_phi']:.4g}, of W {s['cond_w']:.4g}; best start {s['cond_phi_start']:.4g}."
    ]
    if not s["complete"]:
        remarks.append("Cut short: the best drive so far, more time may find a better one.")
    if s.get("advice"):
        remarks.append(s["advice"])
    ordered = sorted(sigma.items(), key=lambda x: -x[1])
    rows = tuple((name, *_meant(s, name), format_number(value, 3)) for name, value in ordered)
    names = ("parameter", *_meaning(s), "%")
    tables = [Table("Attainable standard deviation of each parameter, the worst first.", names, rows)]
    if s.get("driver"):
        said, more = _by_hand(s)
        remarks = [*said, *remarks]
        tables = [*more, *tables]
    else:
        remarks.append(
            "A person at the levers drives something else: `excite drive` makes phases of it and says what is kept,"
            " `excite design --driver` designs for people in the first place."
        )
    if s.get("violations"):
        over = tuple((name, f"{100 * value:.3f}") for name, value in s["violations"].items() if value >= 5e-6)
        if over:
            tables.append(Table("Limits that are exceeded, in per cent of their range.", ("limit", "%"), over))
    return f"Test drive for {s['machine']}, problem {s['problem']}", answer, remarks, tables


WAYS = {
    "played_back": "torques played back: the design without a driver",
    "smoothed": "people, on phases that only follow these torques",
    "by_hand": "people, on this drive",
}


def kept(s: Summary) -> str:
    """What people keep of a design for torques, in a sentence."""
    d = s["driver"]
    free, hand = d["played_back"], d["by_hand"]
    return (
        f"In people's hands these {len(d['phases'])} phases give {trajectories.titled(s['objective'], hand['score'])},"
        f" torques played back {free['score']:.4g}; the worst parameter can be told to"
        f" {format_percent(hand['worst_percent'])}"
        f" ({hand['worst_parameter']}) instead of {format_percent(free['worst_percent'])}, the median one to"
        f" {format_percent(hand['median_percent'])} instead of {format_percent(free['median_percent'])}"
    )


def _by_hand(s: Summary) -> tuple[list[str], list[Table]]:
    d = s["driver"]
    over = ", ".join(f"{name} by {format_percent(100 * value)}" for name, value in d["limits_broken"].items())
    remarks = [
        f"{kept(s)}.",
        f"In the hands of {d['people']} simulated people these limits are exceeded: {over} of their range."
        if over
        else f"In the hands of {d['people']} simulated people every limit is kept.",
        "The numbers below are of a steady person; `excite drive` makes the driver's sheet and page of this drive.",
    ]
    keys = ("score", "cond_phi", "worst_percent", "median_percent")
    rows = tuple((WAYS[w], *(format_number(d[w][k], 4) for k in keys), d[w]["worst_parameter"]) for w in WAYS)
    names = ("driven by", "objective", "cond(Phi)", "worst std %", "median std %", "worst parameter")
    phases = tuple((f"{r['start_s']:g}", f"{r['end_s'] - r['start_s']:g}", r["do"]) for r in d["phases"])
    return remarks, [
        Table(f"What people keep, objective {s['objective']} (lower is better).", names, rows, (2,)),
        Table(f"The drive, phases of {d['phase_min_s']:g} s or more.", ("from s", "for s", "what to do"), phases),
    ]


def _verify(s: Summary) -> Said:
    rows = s["parameters"]
    errors = {n: float(r["rms_percent"]) for n, r in rows.items() if np.isfinite(r["rms_percent"])}
    if not errors:
        none = f"In none of {s['runs']} simulated test days a parameter was found."
        return f"Verification of a drive for {s['machine']}", none, [], []
    worst = max(errors, key=lambda n: errors[n])
    cover = 100 * float(np.mean([rows[n]["coverage95"] for n in errors]))
    median = float(np.median(list(errors.values())))
    answer = (
        f"In {s['runs']} simulated test days the parameters came out within {format_percent(median)} of the truth"
        " (median;"
        f" worst {worst}, {format_percent(errors[worst])}), and the 95 % intervals held it in {cover:.0f} % of cases."
    )
    remarks = [f"Biased, the intervals do not hold: {', '.join(s['biased'])}."] if s["biased"] else []
    if s["failed"]:
        remarks.append(f"{s['failed']} runs gave no estimate.")
    table = tuple(
        (
            n,
            *_meant(s, n),
            r["unit"],
            format_number(r["true"], 6),
            format_number(r["mean"], 6),
            *(format_number(r[k], 3) for k in ("bias_percent", "std_percent", "predicted_std_percent")),
            format_number(100 * r["coverage95"], 3),
        )
        for n, r in rows.items()
    )
    names = ("parameter", *_meaning(s), "unit", "true", "mean", "bias %", "spread %", "predicted %", "coverage %")
    marked = tuple(k for k, n in enumerate(rows) if n in s["biased"])
    caption = "True and estimated parameters; biased ones are set off."
    return f"Verification of a drive for {s['machine']}", answer, remarks, [Table(caption, names, table, marked)]


def _compare(s: Summary) -> Said:
    ratio = s["ratio_equal_time"]
    kept = [d for d in s["designs"] if d["breaks"] is None]
    best = min(kept, key=lambda d: d["cond_phi"]) if kept else None
    if ratio is None or not np.isfinite(ratio):
        answer = "No usual drive found in the same time keeps every limit; the designed one does."
    else:
        word = "lower" if ratio > 1 else "higher"
        answer = (
            f"In the same time the designed drive reaches a condition number {max(ratio, 1 / ratio):.2g} times {word}"
            " than the best usual one."
        )
    remarks = (
        [f"Lowest among those that keep every limit: {best['name']}, cond(Phi) {best['cond_phi']:.4g}."] if best else []
    )
    rows = tuple(
        (
            d["name"],
            *(format_number(d[k], 4) for k in ("cond_phi", "cond_w", "worst_std_percent", "median_std_percent")),
            f"{d['kept']}/{d['samples']}",
            "-" if d["breaks"] is None else f"{d['breaks']} by {format_percent(100 * d['max_violation'])}",
            f"{d['wall_s']:.1f}",
        )
        for d in s["designs"]
    )
    names = ("drive", "cond(Phi)", "cond(W)", "worst std %", "median std %", "kept", "limit broken", "time s")
    caption = "Drives on the same problem, limits and time; the designed one is set off."
    ours = tuple(k for k, d in enumerate(s["designs"]) if d["name"].startswith("designed"))
    return (
        f"Drives compared for {s['machine']}, problem {s['problem']}",
        answer,
        remarks,
        [Table(caption, names, rows, ours)],
    )


def _identify(s: Summary) -> Said:
    rows = s["parameters"]
    known = {n: abs(r["std_percent"]) for n, r in rows.items() if r["std_percent"] is not None}
    known = {n: v for n, v in known.items() if np.isfinite(v)}
    worst = max(known, key=lambda n: known[n])
    count = (
        f"{len(known)} parameters"
        if not s["unidentifiable"]
        else f"{len(known)} of {len(known) + len(s['unidentifiable'])} parameters"
    )
    logs = "one log" if len(s["logs"]) == 1 else f"{len(s['logs'])} logs"
    median, rest = float(np.median(list(known.values()))), float(s["relative_error_percent"])
    answer = (
        f"From {logs}, {count} are found to {format_percent(median)} (median, one standard deviation; worst {worst},"
        f" {format_percent(known[worst])}); the prediction leaves {format_percent(rest)} of what was measured."
    )
    off = {n: abs(r["bias"] / (r["value"] - r["bias"])) for n, r in rows.items() if n in known and _is_biased(r)}
    if off:
        most = max(off, key=lambda n: off[n])
        answer = (
            f"From {logs}, {s['method']} finds {count}, {len(off)} of them wrong by more than it says: on simulated"
            f" logs like this by up to {format_percent(100 * off[most])} ({most}); the prediction leaves"
            f" {format_percent(rest)} of"
            " what was measured."
        )
    remarks = [f"{name} can't be identified: {reason}." for name, reason in s["reasons"].items()] + list(s["notes"])
    for check in s["validation"]:
        errors = ", ".join(f"{n} {v:.1f} %" for n, v in check["torque_error_percent"].items())
        remarks.append(f"On {check['log']}, which it was not fitted on, torques are off by: {errors}.")
    biased = any("bias" in r for r in rows.values())
    table = tuple(
        (
            n,
            *_meant(s, n),
            r["unit"],
            *(format_number(r[k], d) for _, k, d in ESTIMATE),
            *((format_number(r.get("bias"), 3),) if biased else ()),
        )
        for n, r in rows.items()
    )
    names = (
        "parameter",
        *_meaning(s),
        "unit",
        *(heading for heading, *_ in ESTIMATE),
        *(("bias of the method",) if biased else ()),
    )
    conds = f"cond(W) {s['cond_w']:.4g}, cond(Phi) {s['cond_phi']:.4g}"
    caption = f"Parameters with one standard deviation and 95 % interval, method {s['method']}; {conds}."
    return f"Parameters of {s['machine']}", answer, remarks, [Table(caption, names, table)]


def _is_biased(row: Mapping[str, Any]) -> bool:
    """Whether the method's bias of a parameter is known to be more than its deviation."""
    bias, std = row.get("bias"), row.get("bias_std")
    return bias is not None and std is not None and abs(bias) > max(row["std"], SIGNIFICANT_BIAS * std)


def _log(s: Summary) -> Said:
    faults, name = s["faults"], s["log"]
    span = f"{s['rows']} rows" + (f", {s['duration_s']:.4g} s at {s['rate_hz']:.4g} Hz" if s["rate_hz"] else "")
    if s["machine"] is None:
        answer = f"{name} is a table of {span}; no machine was named that it could be checked against."
    elif faults:
        count = "One thing is" if len(faults) == 1 else f"{len(faults)} things are"
        answer = f"{count} wrong with {name} as a log of {s['machine']} ({span})."
    else:
        answer = f"{name} is a usable log of {s['machine']}: {span}."
    rows = tuple(
        (
            c["name"],
            c["what"] or "-",
            c["unit"] or "-",
            format_number(c["low"], 5),
            format_number(c["high"], 5),
            str(c["bad"]),
        )
        for c in s["columns"]
    )
    names = ("column", "what it is", "unit", "lowest", "highest", "bad cells")
    remarks = [*faults, *(f"Doubtful: {x}" for x in s["doubts"]), *s["remarks"]]
    return f"The log {name}", answer, remarks, [Table("Columns as the file has them.", names, rows)]


def _designed(drive: Mapping[str, Any]) -> str:
    """The drive that was, or could be, designed to tell two causes apart."""
    first, second = (x.partition("=")[0] for x in drive["between"])
    if "failed" in drive:
        return f"No drive was designed to tell {first} from {second}: {drive['failed']}."
    if drive["folder"] is None:
        return f"A drive can be designed to tell {first} from {second}: `excite diagnose` with `--next` does."
    return (
        f"{drive['folder']}/ beside this page is a drive designed to tell {first} from {second} (`profile.csv`; `excite"
        f" drive` makes a sheet of it): from its log the amount of each can be found within"
        f" {format_percent(drive['sigma_percent'])} beside the other."
        + ("" if drive["complete"] else " Its search was stopped early.")
    )


def _diagnose(s: Summary) -> Said:
    remarks = []
    if s["separating_run"]:
        remarks.append(f"To tell apart what is tied, drive: {s['separating_run']}.")
    if s["separating_drive"]:
        remarks.append(_designed(s["separating_drive"]))
    remarks += [f"What is left: {line}." for line in first_lines(s["located"])]
    if s["machine_file"]:
        remarks.append(
            f"{s['machine_file']} beside this page is the machine with what was found: `excite design`, `verify`,"
            " `simulate` and `identify` take it."
        )
    remarks += s["notes"]
    tables = []
    if s["findings"]:
        found = tuple(
            (
                f"{f['effect']}@{f['where']}",
                format_number(f["amount"], 5),
                format_number(f["amount_std"], 2),
                f["unit"],
                "; ".join(f"{n} {format_number(x['value'], 4)} {x['unit']}" for n, x in f["shapes"].items()) or "-",
                format_p_value(f["p_value"]),
                format_number(f["gain_percent"], 3),
                "-" if f["gain_ci95"] is None else " to ".join(format_number(x, 3) for x in f["gain_ci95"]),
                ", ".join(f["tied_with"]) or "-",
            )
            for f in s["findings"]
        )
        columns = ("effect", "amount", "std", "unit", "shape", "p-value", "gain %", "95 % of it", "as well could be")
        caption = (
            "What was found, in the order in which it was. p-value: of no effect at all beside the others, for all"
            " causes that were tried. Gain: how much less the model errs on stretches that were not fitted on."
        )
        tables.append(Table(caption, columns, found))
    rows = tuple(
        (
            n,
            r["unit"],
            *(format_number(r[k], 3) for k in ("rms_before", "rms_after")),
            *(format_number(r[f"systematic_{k}_percent"], 2) for k in ("before", "after")),
        )
        for n, r in s["signals"].items()
    )
    heads = ("signal", "unit", "error before", "error after", "systematic before %", "systematic after %")
    caption = (
        "Signal by signal: root mean square error on stretches that were withheld from the fit (the sensor's own noise"
        " is in it), and the share of the error one step ahead that noise doesn't make."
    )
    tables.append(Table(caption, heads, rows))
    if s["findings"]:
        moved = tuple(
            (
                n,
                r["unit"],
                *(format_number(r[k], 6) for k in ("before", "after")),
                *(format_number(r[k], 2) for k in ("std_before", "std_after", "moved")),
            )
            for n, r in s["parameters"].items()
        )
        titles = ("parameter", "unit", "before", "after", "std before", "std after", "moved by std")
        tables.append(Table("What the finding does to the parameters: the bias that it took away.", titles, moved))
    return f"Diagnosis of {s['machine']}", s["answer"], remarks, tables


KINDS = {
    "design": _design,
    "verify": _verify,
    "compare": _compare,
    "identify": _identify,
    "log": _log,
    "diagnose": _diagnose,
}
