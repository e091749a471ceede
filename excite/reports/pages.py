"""Reports of results: `report.html` of a command's folder, with description, figures and how it was made."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from excite import output
from excite.reports import charts
from excite.reports.charts import Explorable
from excite.reports.description import Summary
from excite.reports.descriptions import describe
from excite.reports.estimate_descriptions import validated_log
from excite.reports.html import Picture, report_page
from excite.reports.motion_view import motion_script, scene_data, write_motion_page
from excite.text import format_number

REPORT = "report.html"

CAPTIONS = {
    "design.png": "The drive: torques in per cent of their limits, speeds, angles and, of a machine on contacts, the"
    " larger slip of both edges of each over time, dotted lines the limits; the most used share of each limit, in per"
    " cent; of a machine that steers, its path from above, dots the start. Torques that swing fast have an excerpt.",
    "campaign.png": "What drives of each number and duration attain together, over the time of driving; the line is the"
    " target, the diamond the answer; grey, the first drive repeated, whose errors fall with the square root of time.",
    "sigma.png": "Attainable accuracy of the drive: one standard deviation (Cramer-Rao bound, all sensors together) of"
    " every parameter in per cent of its nominal value, on a logarithmic axis.",
    "sensors.png": "What each sensor buys along this drive: the attainable standard deviation of the worst and the"
    " median parameter after each change, the best first; the lines are without a change.",
    "verify.png": "Left, the error of every parameter in every simulated run, in per cent of the true value: dots are"
    " runs, diamonds their mean, grey bars the 95 % interval that the method itself predicts. Right, the share of runs"
    " in which the interval holds the truth; it claims 95 %.",
    "correlation.png": "Correlation of the errors of every two parameters: near 1 or -1 the log shows their"
    " difference or sum far better than each of them.",
    "prior.png": "What the machine file calls known and what the log adds: grey, the 95 % interval before the log,"
    " diamonds and bars the estimate and its 95 % interval, all in standard deviations known before.",
    "budget.png": "What makes the variance of each parameter: noise with what the model lacks, and the tolerances of"
    " the machine file. What takes a large share is worth measuring.",
    "curves.png": "What the model lacks in each joint or contact as a function of one signal: mean, and its 95 % band."
    " Flat is right.",
    "log.png": "Every channel that the machine file knows, in SI units, over time: as recorded, and as it is used after"
    " repair and resampling.",
    "signals.png": "Left, the share of each signal's error that is systematic, the rest being noise. Right, the error"
    " on stretches that were withheld from the fit, in the signal's unit and in per cent of the error without the"
    " findings.",
    "prediction.png": "Predicted signals over time, each with the 95 % band of the true signal shaded. Below each the"
    " band alone; along a log the residual in it, and in grey where 95 % of the readings are if the model is right.",
    "compare.png": "Drives side by side: condition number of Phi, and attainable standard deviation of the worst"
    " parameter [%]; hollow points break a limit that their label names.",
    "slip.png": "Forces against slip: measured, one mark a row, and by the laws that the data support, beside the"
    " linear one. Right, the error of each law on settings left out of its fit, and the standard deviation of repeats.",
    "machine.png": "The machine from above: dots its centres of mass, green its measuring wheels, dashed with every"
    " steered joint at its stop.",
    "study.png": "Cell by cell: each parameter's error, root mean square over the cell's runs [%], and the share of 95"
    " % intervals that hold; or the verdicts of diagnosis; or the drives' condition numbers.",
}
ARM_CAPTIONS = {  # of motions that a position controller follows
    "design.png": "The motion: torques in per cent of their limits, speeds and angles of the joints over time, dotted"
    " lines the limits; the most used share of each limit, in per cent. Torques that swing fast have an excerpt.",
    "sigma.png": "Attainable accuracy of the motion: one standard deviation (Cramer-Rao bound, all sensors together) of"
    " every parameter in per cent of its nominal value, on a logarithmic axis.",
}
ZOOM = " On the screen: drag to zoom, point to read values, the arrows go back; names hide curves."
FOLDED = {  # figures that a reader opens, by what they are called
    "misfit": "what each torque lacks against everything",
    "correlation": "correlation of the parameters' errors",
}
CAPTIONS_BY_LOG = {
    "clearest": "What the model lacks most clearly in {}: mean torque or force against the state of the machine on"
    " which it depends. Flat at zero is right; grey is what noise alone leaves.",
    "misfit": "The mean torque (and force, if torques alone can't make the model follow the log) that the model lacks"
    " in {}, against the state of the machine. Flat at zero is right; grey is what noise alone leaves.",
    "when": "Left, when and in which signal the model is off in {}; right, at which speed and steering angle (or"
    " torque). The error one step ahead in units of noise: 1 is noise alone.",
}
FIT_CAPTION = (
    "Measured and predicted drive torques, and their residual, over time, for {}. Each torque is predicted from the"
    " motion that the log shows, by filtered derivatives: the sensors' noise adds to the error of the parameters, and"
    " grey is what both explain."
)


def write_report(
    place: Path,
    kind: str,
    summary: Summary,
    command: str | None = None,
    explorable: Mapping[str, Explorable] | None = None,
    scene: Mapping[str, Any] | None = None,
) -> None:
    """Write report.html of a folder from its summary and figures, and summary.json. Raises KeyError for another kind.

    command: how it was made, the command line by default. explorable: what of each figure a chart shows.
    scene: an arm's motion to look at (`motion_scene`), also written as a page of its own.
    """
    description = describe(kind, summary)
    text = report_page(
        description.title,
        description.headline,
        folder_pictures(place, summary, explorable),
        description.tables,
        provenance(summary, command),
        description.remarks,
        description.status,
        description.verdict,
        "" if scene is None else scene_data(scene),
        motion_script(),
    )
    if scene is not None:
        write_motion_page(scene, place)
    (place / REPORT).write_text(text, encoding="utf-8")
    output.write_summary(place, summary, command)


def folder_pictures(place: Path, summary: Summary, explorable: Mapping[str, Explorable] | None = None) -> list[Picture]:
    """Return the figures of a result folder with their captions, in the order of the report; explorable as there."""
    shown = dict(explorable or {})
    made = charts.documents({name: one.panels for name, one in shown.items()})
    pictures = [
        Picture(
            path,
            _caption(path.name, summary) + (ZOOM if path.name in made and shown[path.name].whole else ""),
            made.get(path.name, ""),
            path.name in made and shown[path.name].whole,
            FOLDED.get(path.name.removesuffix(".png").partition("-")[0], ""),
        )
        for path in sorted(place.glob("*.png"))
    ]
    order = list(CAPTIONS)
    return sorted(
        pictures, key=lambda p: (bool(p.folded), order.index(p.path.name) if p.path.name in order else len(order))
    )


def provenance(summary: Summary, command: str | None = None) -> dict[str, str]:
    """Return how a result was made: command, machine, settings, seed, time, versions."""
    rows = {"command": command or output.command_line()}
    names = ("machine", "problem", "objective", "method", "kit", "runs", "samples", "starts", "design", "estimate")
    for key in (*names, "target", "duration_s", "budget_s", "seed", "wall_s"):
        value = summary.get(key)
        if value is not None:
            name, unit = (key[:-2], " s") if key.endswith("_s") else (key, "")
            rows[{"wall": "computed in"}.get(name, name)] = f"{format_number(value, 4)}{unit}"
    if summary.get("logs"):
        rows["logs"] = ", ".join(summary["logs"])
    if summary.get("steps"):
        rows["steps"] = ", ".join(summary["steps"])
    if "compute_s" in summary:
        rows["computed in"] = f"{summary['compute_s']:.0f} s of the workers' time"
    rows["versions"] = ", ".join(f"{name} {version}" for name, version in summary["versions"].items())
    if summary.get("program"):
        rows["program"] = f"{summary['program']} (hash of the program's files)"
    return rows


def _caption(name: str, summary: Summary) -> str:
    if summary.get("trajectory") and name in ARM_CAPTIONS:
        return ARM_CAPTIONS[name]
    if name in CAPTIONS:
        return CAPTIONS[name]
    kind, _, number = name.removesuffix(".png").partition("-")
    k = int(number or 1) - 1
    if kind == "validation":
        return FIT_CAPTION.format(validated_log(summary["validation"][k]))
    if kind in CAPTIONS_BY_LOG:
        return CAPTIONS_BY_LOG[kind].format(summary["logs"][k])
    return FIT_CAPTION.format(summary["logs"][k]) if kind == "fit" else name
