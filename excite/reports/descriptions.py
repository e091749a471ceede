"""Results in words and tables: one description of each kind of summary, shown by the terminal and by report.html."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats

from excite import trajectories
from excite.identification import SIGNIFICANT_BIAS
from excite.smoothing import MAX_IDENTIFIABLE_STD
from excite.text import (
    count,
    first_lines,
    format_number,
    format_p_value,
    format_percent,
    format_rounded,
    format_uncertain,
)
from excite.trajectories import TOLERANCE

Summary = Mapping[str, Any]

WORD = re.compile(
    r"a|no|[a-z]{3,},?"
)  # a word that a sentence may begin with in a capital letter; a name stays as it is
NUMBER = re.compile(r"[<≤]?\s*[-+−]?\d")
MISFIT_OF_REPEATS = 2.0  # error over repeatability, from which something remains; chosen
MAX_CELLS = 200  # cells of a study in a table; chosen
MAX_CONDITION = 1e15  # condition number that is infinite but for rounding
FALSE_ALARM = 0.01  # probability of a verdict against intervals that hold; chosen
MOVED_LEVEL = 1e-3  # p-value below which more than a payload changed between two estimates; chosen
SHOWN_VIOLATION = 5e-6  # of a limit's range: smaller ones round to 0.000 %


@dataclass(frozen=True)
class Table:
    """A table of text cells.

    marked: rows (indices) that are set off. optional: columns (indices) that a narrow terminal leaves out. grey: not
    to be relied on.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    marked: tuple[int, ...] = ()
    optional: tuple[int, ...] = ()
    grey: bool = False

    @property
    def text_columns(self) -> tuple[int, ...]:
        """Columns of words, aligned left; columns of numbers are aligned right."""
        return tuple(
            k for k in range(len(self.columns)) if k == 0 or not any(NUMBER.match(row[k]) for row in self.rows)
        )

    def __post_init__(self) -> None:
        for k, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(f"table {self.caption!r}: row {k} has {len(row)} cells, not {len(self.columns)}")


@dataclass(frozen=True)
class Description:
    """A result for people.

    title: what it is. headline: the answer in a sentence. remarks: what else the reader must know, a sentence each.
    status: `valid`, `doubtful` or `invalid`. verdict: what to think of it and do, the last sentence, "" for none.
    """

    title: str
    headline: str
    tables: tuple[Table, ...] = ()
    remarks: tuple[str, ...] = ()
    status: str = "valid"
    verdict: str = ""

    @property
    def closing(self) -> tuple[str, ...]:
        """The remarks and the verdict."""
        return (*self.remarks, f"Verdict: {self.verdict}") if self.verdict else self.remarks


def describe(kind: str, summary: Summary) -> Description:
    """Describe a summary. Raises KeyError for an unknown kind."""
    return DESCRIPTIONS[kind](summary)


def with_sentences(kind: str, summary: Summary) -> dict[str, Any]:
    """Return a summary with its `headline`, and its `verdict` where it has none: sentences for people."""
    told = describe(kind, summary)
    return {**({"verdict": told.verdict} if told.verdict else {}), **summary, "headline": told.headline}


def as_sentence(text: str) -> str:
    """Begin a remark with a capital letter, unless it begins with a name, and end it with a full stop."""
    first = text.partition(" ")[0]
    text = text[:1].upper() + text[1:] if WORD.fullmatch(first) else text
    return text if text.endswith((".", "!", "?", ":")) else f"{text}."


def describe_outside_law(share: float | None) -> tuple[str, ...]:
    """Return a remark on the share of samples that lie outside the linear soil law, none if there are no such."""
    if not share:
        return ()
    return (
        f"In {format_percent(100 * share)} of the samples a contact slips more than its slip_limit, up to which the"
        " linear soil law holds: real ground gives less force there than the model says.",
    )


def describe_violations(violations: Mapping[str, float]) -> str:
    """Name the limits that are exceeded by more than the tolerance, the worst first, "" if there is none."""
    over = sorted(((v, n) for n, v in violations.items() if v > TOLERANCE), reverse=True)
    shown = ", ".join(f"{n} by {format_percent(100 * v)}" for v, n in over[:MAX_NAMES])
    rest = f" and {len(over) - MAX_NAMES} more" if len(over) > MAX_NAMES else ""
    return f"{shown}{rest} of the range" if over else ""


def describe_drive_faults(s: Summary) -> tuple[str, ...]:
    """Return a line on the limits that a simulated drive breaks, and one on its samples outside the soil law."""
    over = describe_violations(s["violations"])
    return (*((f"limits broken: {over}",) if over else ()), *describe_outside_law(s["share_outside_law"]))


def _meaning_column(s: Summary) -> tuple[str, ...]:
    """Heading of the column that explains parameters, if the summary does."""
    return ("what it is",) if s.get("meanings") else ()


def _meaning(s: Summary, name: str) -> tuple[str, ...]:
    return (s["meanings"].get(name, "-"),) if s.get("meanings") else ()


def _meaning_index(s: Summary) -> tuple[int, ...]:
    return (1,) if s.get("meanings") else ()


# ------------------------------------------------------------------------------------------------ design and drive


def describe_design(s: Summary) -> Description:
    """Describe a design: attainable accuracy, limits, condition numbers, advice."""
    sigma = s["sigma_percent"]
    worst = max(sigma, key=lambda n: sigma[n])
    kept = s["max_violation"] <= TOLERANCE
    limits = (
        "every limit is kept" if kept else f"limits are exceeded by {100 * s['max_violation']:.2f} % of their range"
    )
    driven = "Driven by a steady person" if s.get("driver") else "Driven as designed"
    headline = (
        f"{driven}, these {s['duration_s']:g} s identify every parameter to {format_percent(sigma[worst])} or better"
        f" (one standard deviation, Cramer-Rao bound; worst {worst}, median"
        f" {format_percent(np.median(list(sigma.values())))}); {limits}."
    )
    remarks = [
        f"Condition number of Phi {format_number(s['cond_phi'], 4)}, of W {format_number(s['cond_w'], 4)}; best start"
        f" {format_number(s['cond_phi_start'], 4)}."
    ]
    lowest = s.get("lowest_cond")
    if lowest:
        remarks.append(
            f"The lowest cond(Phi) found is {format_number(lowest['cond_phi'], 4)}, with {lowest['worst_parameter']}"
            f" to {format_percent(lowest['worst_percent'])}; this drive is the most accurate one within"
            f" {s['cond_slack_percent']:g} % of it (`--cond-slack 0` gives the other)."
        )
    if s.get("prediction"):
        p = s["prediction"]
        remarks.append(
            f"Along {p['of']} the signals are predicted with a standard deviation of"
            f" {format_percent(p['mean_percent'])} of each signal's own size in the root mean square,"
            f" {format_percent(p['max_percent'])} at most."
        )
    remarks += describe_outside_law(s.get("share_outside_law"))
    if not s["complete"]:
        remarks.append("Cut short: this is the best drive so far, more time may find a better one.")
    if s.get("advice"):
        remarks.append(s["advice"])
    tables = [_sigma_table(s)]
    if s.get("driver"):
        by_hand_remarks, by_hand_tables = _describe_by_hand(s)
        remarks = [*by_hand_remarks, *remarks]
        tables = [*by_hand_tables, *tables]
    elif s.get("trajectory"):
        if s.get("assumed_noise"):
            remarks.append(
                f"Accuracies rest on assumed noise of {', '.join(s['assumed_noise'])}, of which the machine file says"
                " nothing: torques 0.5 % of their limit, encoders 65536 counts per turn."
            )
        kept = " Limits are kept between the samples, too." if s["max_violation"] == 0 else ""
        remarks.append(
            "The arm follows the joint positions in profile.csv; the torques there are those that this takes." + kept
        )
    else:
        remarks.append(
            "A person at the levers drives something else: `excite drive` makes phases of this drive and says what they"
            " keep of it, `excite design --driver` designs for people from the start."
        )
    if s.get("violations"):
        tables += _violations_table(s)
    return Description(
        f"Test drive for {s['machine']}, problem {s['problem']}", headline, tuple(tables), tuple(remarks)
    )


def describe_campaign(s: Summary) -> Description:
    """Describe drives designed together: the target, what is attained, each drive, what else was tried."""
    n, target = len(s["drives"]), format_percent(s["target_percent"])
    what = {
        "worst": f"every parameter is known to {format_percent(s['attained_percent'], 3)} or better",
        "discrimination": f"every effect is identified to {format_percent(s['attained_percent'], 3)} or better",
    }.get(s["objective"], f"{s['objective']} is {format_percent(s['attained_percent'], 3)}")
    length = f"{count(n, 'drive')} of {format_number(s['duration_s'], 4)} s"
    if any(s["targets"][name] for name in s["targets"] if name):
        asked = ", ".join(f"{k or 'all others'} {format_percent(v)}" for k, v in s["targets"].items())
        what = (
            f"all targets ({asked}) are met"
            if s["reached"]
            else (
                "the standard deviation is up to"
                f" {format_number(s['attained_percent'] / s['target_percent'], 3)} times a target ({asked})"
            )
        )
    limit = f"{count(s['most_drives'], 'drive')} of {s['longest_s']:g} s"
    if s["within_s"] is not None:
        limit += f" and {s['within_s']:g} s in all"
    if s["reached"]:
        headline = f"After {length}, {format_number(s['total_s'] / 60, 2)} min of driving, {what} (target {target})."
    else:
        headline = (
            f"Not reachable within {limit}, as far as this search finds: the best is {length}, after which {what}"
            f" (target {target})."
        )
    headline = f"{headline[:-1]}; one standard deviation, Cramer-Rao bound."
    remarks = []
    if not s["complete"]:
        remarks.append("Cut short: this is the best so far, more time may find fewer or shorter drives.")
    missed = [t for t in s["trials"] if t["drives"] == n and t["duration_s"] < s["duration_s"]]
    if s["reached"] and missed:
        near = max(missed, key=lambda t: t["duration_s"])
        got = "keep no limits" if near["percent"] is None else f"attained {format_percent(near['percent'], 3)}"
        remarks.append(f"The longest shorter ones tried, {near['duration_s']:g} s each, {got}.")
    if s["max_violation"] > TOLERANCE:
        remarks.append(f"Limits are exceeded by {100 * s['max_violation']:.2f} % of their range.")
    remarks.append(
        "Each folder is a design, which `excite drive` and `excite verify` take; `excite identify` takes the logs of"
        " all drives together."
    )
    shown = tuple(
        (d["folder"], format_number(d["duration_s"], 4), format_number(d["alone_percent"], 3)) for d in s["drives"]
    )
    tried = tuple(
        (
            str(t["drives"]),
            format_number(t["duration_s"], 4),
            "-" if t["percent"] is None else format_number(t["percent"], 3),
        )
        for t in s["trials"]
    )
    tables = (
        Table("Drives, and what each attains alone.", ("folder", "s", "%"), shown),
        Table("What was tried, and what it attains together.", ("drives", "s each", "%"), tried),
        _sigma_table(s),
    )
    return Description(f"Campaign for {s['machine']}, problem {s['problem']}", headline, tables, tuple(remarks))


def describe_score(s: Summary) -> Description:
    """Describe a drive that is judged as a design: attainable accuracy, limits, condition numbers."""
    sigma = s["sigma_percent"]
    hidden = [n for n, v in sigma.items() if v > 100 * MAX_IDENTIFIABLE_STD]
    shown = f"identify every parameter to {format_percent(s['worst_percent'])} or better"
    if hidden:
        shown = f"do not show {len(hidden)} of {count(len(sigma), 'parameter')} ({_join_some(hidden)})"
    over = describe_violations(s["violations"])
    limits = f"limits broken: {over}" if over else "every limit is kept"
    headline = (
        f"These {s['duration_s']:g} s {shown} (one standard deviation, Cramer-Rao bound; worst {s['worst_parameter']},"
        f" median {format_percent(s['median_percent'])}); {limits}."
    )
    remarks = (
        f"Condition number of Phi {_condition(s['cond_phi'])}, of W {_condition(s['cond_w'])}.",
        *describe_outside_law(s["share_outside_law"]),
    )
    tables = (*_sensors_table(s), _sigma_table(s), *_violations_table(s))
    return Description(f"Score of {s['profile']} on {s['machine']}, problem {s['problem']}", headline, tables, remarks)


def _sensors_table(s: Summary) -> tuple[Table, ...]:
    """Return the table of what each sensor buys, none if it was not asked for."""
    if not s.get("sensors"):
        return ()
    rows = tuple(
        (
            v["sensor"] or "all as they are",
            v["change"] if v["sensor"] else "",
            format_number(v["worst_percent"], 3),
            v["worst_parameter"],
            format_number(v["median_percent"], 3),
            f"{v['error_ratio']:.2f}",
        )
        for v in s["sensors"]
    )
    caption = (
        f"What each sensor of kit {s['kit']} buys along this drive: attainable standard deviations after each change,"
        " and the geometric mean of their ratios; sensors that identification needs can't be left out."
    )
    return (Table(caption, ("sensor", "change", "worst %", "which", "median %", "all"), rows),)


def _condition(value: float | None) -> str:
    return "infinite" if value is None or value > MAX_CONDITION else f"{format_number(value, 4)}"


def _sigma_table(s: Summary) -> Table:
    ordered = sorted(s["sigma_percent"].items(), key=lambda x: -x[1])
    rows = tuple((name, *_meaning(s, name), format_number(value, 3)) for name, value in ordered)
    caption = "Attainable standard deviation of each parameter, the worst first."
    return Table(caption, ("parameter", *_meaning_column(s), "%"), rows, optional=_meaning_index(s))


def _violations_table(s: Summary) -> tuple[Table, ...]:
    """Return the table of the limits that are exceeded, none if every limit is kept."""
    over = tuple((name, f"{100 * value:.3f}") for name, value in s["violations"].items() if value >= SHOWN_VIOLATION)
    return (Table("Limits that are exceeded, in per cent of their range.", ("limit", "%"), over),) if over else ()


WAYS_OF_DRIVING = {
    "played_back": "torques played back: the design without a driver",
    "smoothed": "people, on phases that only follow these torques",
    "by_hand": "people, on this drive",
}


def _ground_remarks(d: Summary) -> list[str]:
    """Describe the ground that people touch, beside the lane where there is one."""
    if "room_m" not in d:  # designs of earlier versions
        return []
    said = "People touch {:.1f} m x {:.1f} m of ground".format(*d["room_m"])
    if "lane_m" not in d:
        return [f"{said}."]
    over, lane = max(d["beyond_lane_m"]), "the lane of {:g} m x {:g} m".format(*d["lane_m"])
    return [f"{said}, up to {over:.1f} m beyond {lane}." if over > 0.05 else f"{said}, all of it on {lane}."]


def _describe_by_hand(s: Summary) -> tuple[list[str], list[Table]]:
    """Describe what people keep of a design that was made for them: remarks and tables."""
    d = s["driver"]
    free, hand = d["played_back"], d["by_hand"]
    over = ", ".join(f"{name} by {format_percent(100 * value)}" for name, value in d["limits_broken"].items())
    value = trajectories.describe_value(s["objective"], hand["score"])
    people = count(d["people"], "simulated person", "simulated people")
    remarks = [
        f"In people's hands these {count(len(d['phases']), 'phase')} give {value}, torques played back"
        f" {format_number(free['score'], 4)}; the worst parameter is identified to"
        f" {format_percent(hand['worst_percent'])} ({hand['worst_parameter']}) instead of"
        f" {format_percent(free['worst_percent'])}, the median one to {format_percent(hand['median_percent'])} instead"
        f" of {format_percent(free['median_percent'])}.",
        f"In the hands of {people} these limits are exceeded: {over} of their range."
        if over
        else f"In the hands of {people} every limit is kept.",
        *_ground_remarks(d),
        "The accuracy of single parameters is of a steady person; `excite drive` makes the driver's sheet and page of"
        " this drive.",
    ]
    keys = ("score", "cond_phi", "worst_percent", "median_percent")
    rows = tuple(
        (words, *(format_number(d[way][k], 4) for k in keys), d[way]["worst_parameter"])
        for way, words in WAYS_OF_DRIVING.items()
    )
    names = ("driven by", "objective", "cond(Phi)", "worst std %", "median std %", "worst parameter")
    phases = tuple((f"{r['start_s']:g}", f"{r['end_s'] - r['start_s']:g}", r["do"]) for r in d["phases"])
    return remarks, [
        Table(f"What people keep, objective {s['objective']} (lower is better).", names, rows, (2,)),
        Table(f"The drive, phases of {d['phase_min_s']:g} s or more.", ("from s", "for s", "what to do"), phases),
    ]


def describe_drive(s: Summary) -> Description:
    """Describe a drive for a person: what it keeps of the design, its phases, what to mind."""

    def clock(seconds: float) -> str:
        return f"{int(seconds // 60)}:{seconds % 60:04.1f}"

    phases = tuple((clock(phase["start_s"]), phase["do"]) for phase in s["phases"])
    table = Table("The phases, each from its time (min:s).", ("at", "what to do"), phases)
    return Description(f"Drive for a person on {s['machine']}", s["verdict"], (table,), tuple(s["warnings"]))


def describe_compare(s: Summary) -> Description:
    """Describe a comparison of the designed drive with usual ones."""
    ratio, own = s["ratio_equal_time"], [d for d in s["designs"] if d.get("own")]
    kept = [d for d in s["designs"] if d["breaks"] is None]
    best = min(kept, key=lambda d: d["cond_phi"]) if kept else None
    if own and len(own) == len(s["designs"]) - 1:
        designed = s["designs"][0]
        headline = f"The designed drive has cond(Phi) {format_number(designed['cond_phi'], 4)}; " + "; ".join(
            f"{d['name']} has {_condition(d['cond_phi'])}"
            + ("" if d["breaks"] is None else f" and breaks {_broken_limit(d)}")
            for d in own
        )
    elif ratio is None or not np.isfinite(ratio):
        headline = "No usual drive found in the same time keeps every limit; the designed one does."
    else:
        word = "lower" if ratio > 1 else "higher"
        headline = (
            f"In the same time the designed drive reaches a condition number {format_number(max(ratio, 1 / ratio), 2)}"
            f" times {word} than the best usual one."
        )
    remarks = (
        (f"Lowest among those that keep every limit: {best['name']}, cond(Phi) {format_number(best['cond_phi'], 4)}.",)
        if best
        else ()
    )
    rows = tuple(
        (
            d["name"],
            *(format_number(d[k], 4) for k in ("cond_phi", "cond_w", "worst_std_percent", "median_std_percent")),
            f"{d['kept']}/{d['samples']}",
            _broken_limit(d),
            "-" if d.get("own") else f"{d['wall_s']:.1f}",
            _equal_score(d),
        )
        for d in s["designs"]
    )
    names = ("drive", "cond(Phi)", "cond(W)", "worst std %", "median std %", "kept", "limit broken", "time s")
    caption = (
        "Drives on the same problem, limits and time; the designed one is set off. Kept: drives that keep every limit,"
        " of those drawn. As good in: time until a drive of this kind had the designed drive's cond(Phi)."
    )
    ours = tuple(k for k, d in enumerate(s["designs"]) if d["name"].startswith("designed"))
    table = Table(caption, (*names, "as good in s"), rows, ours, (2, 7, 8))
    return Description(f"Drives compared for {s['machine']}, problem {s['problem']}", headline, (table,), remarks)


def _equal_score(d: Mapping[str, Any]) -> str:
    if d.get("own"):
        return "-"
    return f"not in {d['wall_s']:.0f}" if d["equal_score_s"] is None else f"{d['equal_score_s']:.0f}"


def _broken_limit(d: Mapping[str, Any]) -> str:
    return "-" if d["breaks"] is None else f"{d['breaks']} by {format_percent(100 * d['max_violation'])}"


# ------------------------------------------------------------------------------------------------ parameters


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
            *_meaning(s, n),
            r["unit"],
            format_number(r["true"], 6),
            format_number(r["mean"], 6),
            *(format_number(r[k], 3) for k in ("bias_percent", "std_percent", "predicted_std_percent")),
            format_number(100 * r["coverage95"], 3),
        )
        for n, r in rows.items()
    )
    names = ("parameter", *_meaning_column(s), "unit", "true", "mean", "bias %", "std %", "predicted std %")
    marked = tuple(k for k, n in enumerate(rows) if n in s["biased"])
    caption = "True and estimated parameters; biased ones are set off."
    if s.get("method"):
        caption = f"True and estimated parameters, method {s['method']}, kit {s['kit']}; biased ones are set off."
    tables = (Table(caption, (*names, "coverage %"), table, marked, _meaning_index(s)),)
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
        return f"{shown}, but the 95 % intervals of {_join_some(wrong)} do not hold."
    tell = f"as far as {count(runs, 'test day tells', 'test days tell')}"
    return f"{shown}, and the 95 % intervals hold, {tell}."


def _misses_too_often(row: Mapping[str, Any], s: Summary) -> bool:
    """Tell if an interval holds the truth less often than chance leaves to one of 95 %, all parameters together."""
    runs = s["runs"] - s["failed"]
    if not runs or not np.isfinite(row["coverage95"]):
        return False
    held = round(runs * row["coverage95"])
    return bool(scipy.stats.binom.cdf(held, runs, 0.95) < FALSE_ALARM / len(s["parameters"]))


MAX_NAMES = 4  # parameters that a headline names
ESTIMATE_COLUMNS = (  # of a parameter: heading, key
    ("value", "value"),
    ("std", "std"),
    ("std %", "std_percent"),
    ("95 % from", "low95"),
    ("to", "high95"),
)


def _estimate_cell(row: Mapping[str, Any], key: str) -> str:
    """Format a number of a parameter: one in its unit to the decimals of its standard deviation, or in per cent."""
    return format_number(row[key], 2) if key.endswith("percent") else format_rounded(row[key], row["std"])


def describe_identify(s: Summary) -> Description:
    """Describe an estimate: accuracy, prediction error, bias of the method, parameters that are not identifiable."""
    rows = s["parameters"]
    known = {n: abs(r["std_percent"]) for n, r in rows.items() if r["std_percent"] is not None}
    known = {n: v for n, v in known.items() if np.isfinite(v)}
    worst = max(known, key=lambda n: known[n], default="")
    every = len(known) + len(s["unidentifiable"])
    what = count(every, "parameter is", "parameters are")
    what = f"{len(known)} of {what}" if s["unidentifiable"] else what
    logs = "one log" if len(s["logs"]) == 1 else f"{len(s['logs'])} logs"
    share = s["relative_error_percent"]
    known_error = share is not None and np.isfinite(share)
    error = f"{format_percent(share)} of what was measured" if known_error else "unknown, as no torque was measured"
    accuracy = (
        f" {format_percent(float(np.median(list(known.values()))))} (median, one standard deviation; worst {worst},"
        f" {format_percent(known[worst])})"
        if known
        else " no known accuracy"
    )
    headline = f"From {logs}, {what} identified to{accuracy}; the prediction error is {error}."
    if s["status"] == "doubtful":
        headline = (
            f"From {logs}, {what} estimated, but their 95 % intervals do not hold: {s['doubt']} (stated:{accuracy};"
            f" prediction error {error})."
        )
    off = {n: abs(r["bias"] / (r["value"] - r["bias"])) for n, r in rows.items() if n in known and _is_biased(r)}
    impossible = [n for n, r in rows.items() if not r["possible"]]
    if impossible and s["status"] == "valid":
        have = "has a value" if len(impossible) == 1 else "have values"
        headline = f"{headline[:-1]}; {_join_some(impossible)} {have} that no machine has."
    if s["status"] == "invalid":
        reason = f", and {_join_some(impossible)} would have values that no machine has" if impossible else ""
        headline = f"No estimate from {logs} (prediction error {error}){reason}: {s['doubt']}."
    wrong: tuple[str, ...] = ()
    if off and s["status"] != "invalid":
        most = max(off, key=lambda n: off[n])
        wrong = (
            f"On simulated logs like this {s['method']} is wrong by up to {format_percent(100 * off[most])} ({most}),"
            f" in {count(len(off), 'parameter')} by more than it says.",
        )
    remarks = [
        *wrong,
        *(f"{name} can't be identified: {reason}." for name, reason in s["reasons"].items()),
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
            *_meaning(s, n),
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
        *_meaning_column(s),
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
        Table(caption, names, table, marked, _meaning_index(s), grey=s["status"] != "valid"),
        *((_joint_errors_table(by_joint),) if len(by_joint) > 1 else ()),
        *((_payload_table(s["payload"]),) if "payload" in s else ()),
    )
    verdict = _judge_estimate(s, max(known.values(), default=None), impossible)
    return Description(f"Parameters of {s['machine']}", headline, tables, tuple(remarks), s["status"], verdict)


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
        return f"valid except for {_join_some(lacking)}; a drive that shows more of the machine may give them."
    if worst_percent is None:
        return "valid, of unknown accuracy."
    return f"valid, the 95 % intervals hold; every parameter is known to {format_percent(worst_percent)} or better."


def _describe_validation(check: Mapping[str, Any]) -> str:
    """Compare a log's prediction error with what noise and the parameters' uncertainty make of it."""
    errors = ", ".join(
        f"{n} {v:.1f} % (noise alone {check['noise_percent'][n]:.1f} %, parameters"
        f" {check['parameters_percent'][n]:.1f} %)"
        for n, v in check["torque_error_percent"].items()
    )
    text = f"On {check['log']}, which was not fitted, the torque errors are {errors}"
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


def _join_some(names: Sequence[str]) -> str:
    """Join the first names, and count the others."""
    shown = ", ".join(names[:MAX_NAMES])
    return shown if len(names) <= MAX_NAMES else f"{shown} and {len(names) - MAX_NAMES} more"


def _is_biased(row: Mapping[str, Any]) -> bool:
    """Return whether the method's bias of a parameter is significant and larger than its standard deviation."""
    bias, std = row.get("bias"), row.get("bias_std")
    return bias is not None and std is not None and abs(bias) > max(row["std"], SIGNIFICANT_BIAS * std)


# ------------------------------------------------------------------------------------------------ checks


def describe_log(s: Summary) -> Description:
    """Describe a log: whether it is usable, its columns, its faults."""
    faults, name = s["faults"], s["log"]
    span = count(s["rows"], "row") + (
        f", {format_number(s['duration_s'], 4)} s at {format_number(s['rate_hz'], 4)} Hz" if s["rate_hz"] else ""
    )
    if s["machine"] is None:
        headline = f"{name} is a table of {span}; no machine was named that it could be checked against."
    elif faults:
        headline = f"{_count_things(len(faults))} wrong with {name} as a log of {s['machine']} ({span})."
    else:
        headline = f"{name} is a usable log of {s['machine']}: {span}."
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
    tables = (Table("Columns as the file has them.", names, rows),)
    return Description(f"Check of {name}", headline, tables, _check_remarks(s))


MACHINE_COLUMNS = ("parameter", "what it is", "stands for", "value", "unit", "random drives: std %")


def describe_machine(s: Summary) -> Description:
    """Describe a check of a machine file: faults, doubts, and the parameters with their attainable accuracy."""
    name, faults, doubts = s["machine"] or s["file"], s["faults"], s["doubts"]
    if faults:
        headline = f"{_count_things(len(faults))} wrong with {name}."
    else:
        doubtful = f"{_count_things(len(doubts)).lower()} doubtful" if doubts else "nothing is doubtful"
        shown = count(len(s["parameters"]), "parameter is", "parameters are")
        headline = f"{name} can be used: {shown} identifiable, {doubtful}."
    rows = tuple(
        (
            *(n, r["what"], format_sum(r["stands_for"]), format_number(r["value"]), r["unit"]),
            format_number(r["random_drive_percent"], 2),
        )
        for n, r in s["parameters"].items()
    )
    caption = (
        "Base parameters, the standard parameters that each stands for, and the standard deviation that the best of"
        " some random drives leaves."
    )
    tables = (Table(caption, MACHINE_COLUMNS, rows, optional=(1, 2)),) if rows else ()
    return Description(f"The machine file {s['file']}", headline, tables, _check_remarks(s))


def format_sum(parts: Mapping[str, float]) -> str:
    """Write the sum that a base parameter stands for: "MX0 + 1.45 M3"."""
    text = ""
    for name, c in parts.items():
        text += ("-" if not text else " - ") if c < 0 else " + " if text else ""
        text += name if abs(abs(c) - 1) < 1e-9 else f"{format_number(abs(c), 4)} {name}"
    return text


def _count_things(n: int) -> str:
    return "One thing is" if n == 1 else f"{n} things are"


def _check_remarks(s: Summary) -> tuple[str, ...]:
    """Return the faults, doubts and remarks of a check."""
    return (*(f"Wrong: {x}" for x in s["faults"]), *(f"Doubtful: {x}" for x in s["doubts"]), *s["remarks"])


# ------------------------------------------------------------------------------------------------ contact laws


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


# ------------------------------------------------------------------------------------------------ diagnosis


def describe_diagnose(s: Summary) -> Description:
    """Describe a diagnosis: the answer, the findings, errors signal by signal, what to drive next."""
    remarks = [_describe_finding(f) for f in s["findings"]]
    if s["separating_run"]:
        remarks.append(f"To separate the tied causes, drive: {s['separating_run']}.")
    if s["separating_drive"]:
        remarks.append(_describe_separating_drive(s["separating_drive"]))
    remarks += [f"Still unexplained: {line}." for line in first_lines(s["located"])]
    if s["machine_file"]:
        remarks.append(
            f"{s['machine_file']} in the folder of this result is the machine with the findings in it: `excite"
            " design`, `verify`, `simulate` and `identify` take it."
        )
    remarks += s["notes"]
    tables = []
    if s["findings"]:
        tables.append(_table_of_findings(s["findings"]))
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
        "Signal by signal: root mean square error on stretches that were withheld from the fit (it includes the"
        " sensor's noise), and the share of the one-step-ahead error that noise does not explain."
    )
    tables.append(Table(caption, heads, rows))
    if s["findings"]:
        moved = tuple(
            (
                n,
                r["unit"],
                *(format_rounded(r[k], r[f"std_{k}"]) for k in ("before", "after")),
                *(format_rounded(r[k], r[k], 2) for k in ("std_before", "std_after")),
                format_number(r["moved"], 2),
            )
            for n, r in s["parameters"].items()
        )
        titles = ("parameter", "unit", "before", "after", "std before", "std after", "moved by std")
        caption = "The parameters before and after: the bias that the findings took away."
        tables.append(Table(caption, titles, moved, optional=(4, 5)))
    return Description(f"Diagnosis of {s['machine']}", s["answer"], tuple(tables), tuple(remarks))


def _describe_finding(f: Mapping[str, Any]) -> str:
    """Say of a finding in a sentence how much it is, what it explains and what it gains."""
    name = f"{f['effect'].replace('_', ' ').capitalize()}, {f['where'].replace('_', ' ')}"
    text = f"{name}: {format_uncertain(f['amount'], f['amount_std'], f['unit'])}, a {f['kind']} that takes"
    text += f" {format_percent(f['share_percent'], 3)} of what noise does not explain"
    if f["gain_ci95"] is not None:
        low, high = (format_number(x, 2) for x in f["gain_ci95"])
        gain = f"{format_percent(f['gain_percent'])} (95 %: {low} to {high} %)"
        text += f", and the error on data not fitted falls by {gain}"
    return f"{text}; it can't be told from {_join_some(f['tied_with'])}." if f["tied_with"] else f"{text}."


def _table_of_findings(findings: Sequence[Mapping[str, Any]]) -> Table:
    rows = tuple(
        (
            f"{f['effect']}@{f['where']}",
            format_rounded(f["amount"], f["amount_std"], 5),
            format_rounded(f["amount_std"], f["amount_std"], 2),
            f["unit"],
            "; ".join(f"{n} {format_number(x['value'], 4)} {x['unit']}" for n, x in f["shapes"].items()) or "-",
            format_p_value(f["p_value"]),
            format_number(f["gain_percent"], 3),
            "-" if f["gain_ci95"] is None else " to ".join(format_number(x, 3) for x in f["gain_ci95"]),
            ", ".join(f["tied_with"]) or "-",
        )
        for f in findings
    )
    names = ("effect", "magnitude", "std", "unit", "shape", "p-value", "gain %", "95 % interval", "tied with")
    caption = (
        "Findings, in the order in which they were found. p-value: of no such effect, corrected for all the causes that"
        " were tried. Gain: by how much the error falls on stretches that were not fitted."
    )
    return Table(caption, names, rows, optional=(4,))


def _describe_separating_drive(drive: Mapping[str, Any]) -> str:
    """Describe the drive that was, or could be, designed to separate two tied causes."""
    first, second = (x.partition("=")[0] for x in drive["between"])
    if "failed" in drive:
        return f"No drive was designed to separate {first} from {second}: {drive['failed']}."
    if drive["folder"] is None:
        return f"A drive can be designed to separate {first} from {second}: `excite diagnose` with `--next` does."
    return (
        f"The folder {drive['folder']}/ holds a drive designed to separate {first} from {second} (`profile.csv`;"
        f" `excite drive` makes a sheet of it): its log gives the magnitude of each within"
        f" {format_percent(drive['sigma_percent'])}." + ("" if drive["complete"] else " Its search was stopped early.")
    )


# ------------------------------------------------------------------------------------------------ studies


def describe_study(s: Summary) -> Description:
    """Describe a study: how its runs ended, the best and the worst cell, all cells as a table."""
    headline = f"{s['done']} of {count(s['runs'], 'run')} gave a result, {s['failed']} could not give one"
    headline += f", {s['defects']} showed a defect of the program." if s["defects"] else "."
    alike: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}  # cells with other effects err for other reasons
    for r in s["cells"]:
        if np.isfinite(r.get("worst_rms_percent") or np.nan):
            alike.setdefault(tuple(r.get("effects", ())), []).append(r)
    effects, ranked = max(alike.items(), key=lambda one: len(one[1]), default=((), []))
    if len(ranked) > 1:
        best, worst = (pick(ranked, key=lambda r: r["worst_rms_percent"]) for pick in (min, max))
        among = f"{len(ranked)} cells"
        if len(alike) > 1:
            among += f" with {' and '.join(effects)}" if effects else " without effects"
        headline += f" By the error of its worst parameter, {_cell_error(best)} is the best of {among},"
        headline += f" {_cell_error(worst)} the worst."
    remarks = [
        "runs.parquet has one row per run; the command in its column `command`, given in this folder, repeats it"
    ]
    if s["defects"]:
        remarks.append("The column `reason` of runs.parquet names each defect of the program.")
    rows = tuple(
        (
            row["cell"],
            str(row["done"]),
            str(row["failed"] + row["defect"]),
            row.get("worst_parameter", "-"),
            format_number(row.get("worst_rms_percent"), 3),
            format_number(row.get("median_rms_percent"), 3),
            format_number(100 * row["coverage95"] if row.get("coverage95") is not None else None, 3),
            ", ".join(f"{k} {v}" for k, v in row.get("verdicts", {}).items()) or "-",
        )
        for row in s["cells"][:MAX_CELLS]
    )
    columns = ("cell", "done", "failed", "worst parameter", "rms %", "median rms %", "coverage %", "verdicts")
    caption = "Results of each cell. rms: error of the worst parameter over the runs; coverage: of the 95 % intervals."
    if len(s["cells"]) > MAX_CELLS:
        caption += f" {len(s['cells']) - MAX_CELLS} cells more are in summary.json."
    title = s.get("title") or s.get("study", "")
    return Description(f"Study {title}", headline, (Table(caption, columns, rows),), tuple(remarks))


def _cell_error(row: Mapping[str, Any]) -> str:
    return f"{row['cell']} ({row['worst_parameter']} {format_percent(row['worst_rms_percent'])} rms)"


DESCRIPTIONS: dict[str, Callable[[Summary], Description]] = {
    "design": describe_design,
    "campaign": describe_campaign,
    "drive": describe_drive,
    "score": describe_score,
    "compare": describe_compare,
    "verify": describe_verify,
    "identify": describe_identify,
    "predict": describe_predict,
    "log": describe_log,
    "machine": describe_machine,
    "diagnose": describe_diagnose,
    "slip": describe_slip,
    "study": describe_study,
}
