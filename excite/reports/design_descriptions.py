"""Designs, drives, scores and comparisons in words and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from excite import trajectories
from excite.reports.description import (
    Description,
    Summary,
    Table,
    describe_outside_law,
    describe_violations,
    join_some,
    meaning,
    meaning_column,
    meaning_index,
)
from excite.reports.payload_descriptions import payload_remarks, payload_tables
from excite.smoothing import MAX_IDENTIFIABLE_STD
from excite.text import count, format_number, format_percent
from excite.trajectories import TOLERANCE

MAX_CONDITION = 1e15  # condition number that is infinite but for rounding
KEPT_TO = format_percent(100 * TOLERANCE)  # of a limit's range
SHOWN_VIOLATION = 5e-6  # of a limit's range: smaller ones round to 0.000 %


def describe_design(s: Summary) -> Description:
    """Describe a design: attainable accuracy, limits, condition numbers, advice."""
    sigma = s["sigma_percent"]
    worst = max(sigma, key=lambda n: sigma[n])
    over = describe_violations(s.get("violations", {}), s.get("excesses")) or format_percent(100 * s["max_violation"])
    limits = f"limits broken: {over}" if s["max_violation"] > TOLERANCE else _kept(s["max_violation"])
    word = "motion" if s.get("trajectory") else "drive"
    driven = "Followed as designed" if s.get("trajectory") else "Driven as designed"
    driven = "Driven by a steady person" if s.get("driver") else driven
    headline = (
        f"{driven}, these {s['duration_s']:g} s identify every parameter to {format_percent(sigma[worst])} or better"
        f" (one standard deviation, Cramer-Rao bound; worst {worst}, median"
        f" {format_percent(np.median(list(sigma.values())))}); {limits}."
    )
    headline = _unseen_collisions(s) + headline
    remarks = [
        f"Condition number of Phi {format_number(s['cond_phi'], 4)}, of W {format_number(s['cond_w'], 4)}; best start"
        f" {format_number(s['cond_phi_start'], 4)}."
    ]
    other = s.get("most_accurate")
    if other:
        remarks.append(
            f"The other end, `--objective accuracy` from this {word}: {other['worst_parameter']} to"
            f" {format_percent(other['worst_percent'])} or better at cond(Phi) {format_number(other['cond_phi'], 4)};"
            f" the folder {other.get('folder', 'of that command')} has it to drive."
        )
    elif s["objective"] == "cond":
        remarks.append("The other end, the drive of `--objective accuracy`, was not looked for.")
    if s.get("bound"):
        b = s["bound"]
        what = "the worst parameter" if b["of"] == "worst" else "worst and mean parameter (geometric mean)"
        remarks.append(
            f"No {word} of this problem identifies {what} better than {format_percent(b['certified_percent'], 3)}"
            f" (numerical bound): this {word} attains {format_percent(b['attained_percent'], 3)},"
            f" {format_percent(b['gap_percent'])} above it."
        )
    if s.get("prediction"):
        p = s["prediction"]
        remarks.append(
            f"Along {p['of']} the signals are predicted with a standard deviation of"
            f" {format_percent(p['mean_percent'])} of each signal's own size in the root mean square,"
            f" {format_percent(p['max_percent'])} at most."
        )
    remarks += _describe_given_zeros(s)
    remarks += describe_outside_law(s.get("share_outside_law"))
    if not s["complete"]:
        remarks.append(f"Cut short: this is the best {word} so far, more time may find a better one.")
    if s.get("advice"):
        remarks.append(s["advice"])
    remarks = [*payload_remarks(s), *remarks]
    tables = [*payload_tables(s), *_ends_table(s), _sigma_table(s)]
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
        remarks.append(
            "The arm follows the joint positions in profile.csv; the torques there are what the motion takes."
            + _describe_kept_limits(s)
        )
        remarks += _describe_clearance(s)
    else:
        remarks.append(
            "A person at the levers drives something else: `excite drive` makes phases of this drive and says what they"
            " keep of it, `excite design --driver` designs for people from the start."
        )
    if s.get("violations"):
        tables += _violations_table(s)
    return Description(
        f"Test {word} for {s['machine']}, problem {s['problem']}", headline, tuple(tables), tuple(remarks)
    )


def _ends_table(s: Summary) -> list[Table]:
    """Table of the drives between lowest cond(Phi) and highest accuracy, to choose from; none without others."""
    word = "motion" if s.get("trajectory") else "drive"
    near = f", the most accurate within {format_percent(s['cond_slack_percent'], 3)}" if s.get("lowest_cond") else ""
    ends = {"lowest cond(Phi), --cond-slack 0": s.get("lowest_cond"), f"this {word}{near}": s}
    ends["for accuracy, --objective accuracy"] = s.get("most_accurate")
    rows = tuple(
        (
            name,
            format_number(end["cond_phi"], 4),
            end["worst_parameter"],
            format_number(end["worst_percent"], 3),
            format_number(end["median_percent"], 3),
        )
        for name, end in ends.items()
        if end
    )
    if len(rows) < 2:
        return []
    caption = f"{word.capitalize()}s to choose from: a low cond(Phi), or small errors; standard deviations in per cent."
    return [Table(caption, (word, "cond(Phi)", "worst parameter", "worst [%]", "median [%]"), rows)]


def _unseen_collisions(s: Summary) -> str:
    """Say in the first words that collisions were not looked at, "" where they were or for other machines."""
    seen = s.get("collisions")
    if seen is None or seen["looked_at"]:
        return ""
    floor = seen["floor_m"]
    kept = "" if floor is None else f", only joints and tool are kept above z = {floor:g} m"
    return f"Collisions were not looked at: the machine file has no shapes{kept}. "


def _describe_clearance(s: Summary) -> list[str]:
    """Say where a joint motion starts, what keeps its distance, and which pairs do not count."""
    if "start" not in s:
        return []
    place = ", ".join(
        f"{c} {math.degrees(x):.1f} deg" if c.startswith("theta") else f"{c} {x:.3f} m" for c, x in s["start"].items()
    )
    said = [f"It starts at {place}; `excite handover` writes it for a controller and says what will move where."]
    seen = s["collisions"]
    if seen["looked_at"]:
        below = "" if seen["floor_m"] is None else f", and from the floor at z = {seen['floor_m']:g} m"
        pairs = join_some([" and ".join(pair) for pair in seen["left_out"]])
        out = f"; pairs that touch in nearly every pose do not count: {pairs}" if seen["left_out"] else ""
        said.append(f"Shapes stay {1000 * seen['margin_m']:g} mm apart{below}{out}.")
    return said


def describe_campaign(s: Summary) -> Description:
    """Describe drives designed together: the target, what is attained, each drive, what else was tried."""
    n, target = len(s["drives"]), format_percent(s["target_percent"])
    what = {
        "worst": f"every parameter{' of the payload' * ('payload' in s)} is known to"
        f" {format_percent(s['attained_percent'], 3)} or better",
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
    remarks = payload_remarks(s)
    if not s["complete"]:
        remarks.append("Cut short: this is the best so far, more time may find fewer or shorter drives.")
    missed = [t for t in s["trials"] if t["drives"] == n and t["duration_s"] < s["duration_s"]]
    if s["reached"] and missed:
        near = max(missed, key=lambda t: t["duration_s"])
        got = "keep no limits" if near["percent"] is None else f"attained {format_percent(near['percent'], 3)}"
        remarks.append(f"The longest shorter ones tried, {near['duration_s']:g} s each, {got}.")
    if s["max_violation"] > TOLERANCE:
        remarks.append(f"Limits are exceeded by {100 * s['max_violation']:.2f} % of their range.")
    remarks += _describe_given_zeros(s)
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
        *payload_tables(s),
        _sigma_table(s),
    )
    return Description(f"Campaign for {s['machine']}, problem {s['problem']}", headline, tables, tuple(remarks))


def _describe_kept_limits(s: Summary) -> str:
    """Say what holds of the limits of a joint motion between samples and under a position controller."""
    kept = " Limits are kept between the samples, too." if s["max_violation"] == 0 else ""
    followed = s.get("followed")
    if followed is None:
        return kept
    if any(x is None or not math.isfinite(x) for x in followed.values()):
        return f"{kept} In simulation a position controller cannot follow the motion."
    if over := describe_violations(followed, tolerance=SHOWN_VIOLATION):
        return f"{kept} As a position controller follows the motion, it exceeds {over}."
    return f"{kept} They are kept where a position controller follows the motion as well." if kept else ""


def _describe_given_zeros(s: Summary) -> list[str]:
    """Say which encoder zeros that are sought a drive is judged without, if any."""
    if not s.get("given_zeros"):
        return []
    return [
        f"No torque shows the encoder zeros {', '.join(s['given_zeros'])} apart from other parameters: drives are"
        " judged with those of the machine file."
    ]


def describe_score(s: Summary) -> Description:
    """Describe a drive that is judged as a design: attainable accuracy, limits, condition numbers."""
    sigma = s["sigma_percent"]
    hidden = [n for n, v in sigma.items() if v > 100 * MAX_IDENTIFIABLE_STD]
    shown = f"identify every parameter to {format_percent(s['worst_percent'])} or better"
    if hidden:
        most = format_percent(100 * MAX_IDENTIFIABLE_STD)
        few = f"{len(hidden)} of {count(len(sigma), 'parameter')} ({join_some(hidden)})"
        shown = f"do not show {few}, whose error stays above {most}"
    over = describe_violations(s["violations"], s.get("excesses"))
    lasts = trajectories.DURATION_LIMIT in s.get("excesses", {})
    limits = f"limits broken: {over}" if over else _kept(max(s["violations"].values(), default=0.0))
    worst = f"worst {s['worst_parameter']}"
    if hidden:
        worst += f" {format_percent(s['worst_percent'])}"
    headline = (
        f"These {s['duration_s']:g} s {shown} (one standard deviation, Cramer-Rao bound; {worst},"
        f" median {format_percent(s['median_percent'])}); {limits}."
    )
    remarks = (
        f"Condition number of Phi {_condition(s['cond_phi'])}, of W {_condition(s['cond_w'])}.",
        *_describe_given_zeros(s),
        *describe_outside_law(s["share_outside_law"]),
        *((f"`--duration {s['duration_s']:g}` judges it as a drive of its own length.",) if lasts else ()),
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
    rows = tuple((name, *meaning(s, name), format_number(value, 3)) for name, value in ordered)
    caption = "Attainable standard deviation of each parameter, the worst first."
    return Table(caption, ("parameter", *meaning_column(s), "%"), rows, optional=meaning_index(s))


def _violations_table(s: Summary) -> tuple[Table, ...]:
    """Return the table of the limits that are exceeded, none if every limit is kept."""
    said = s.get("excesses", {})
    over = tuple(
        (name, said.get(name) or f"{100 * value:.3f} % of its range")
        for name, value in s["violations"].items()
        if value >= SHOWN_VIOLATION
    )
    within = "" if describe_violations(s["violations"]) else f", within the tolerance of {KEPT_TO}"
    return (Table(f"Limits that are exceeded{within}.", ("limit", "by"), over),) if over else ()


def _kept(excess: float) -> str:
    """Say that limits are kept, and how far where the largest excess over one [share of its range] is shown."""
    return "every limit is kept" + (f" to {KEPT_TO} of its range" if excess >= SHOWN_VIOLATION else "")


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
    return Description(
        f"Drives compared for {s['machine']}, problem {s['problem']}",
        headline,
        (table,),
        (*remarks, *_describe_given_zeros(s)),
    )


def _equal_score(d: Mapping[str, Any]) -> str:
    if d.get("own"):
        return "-"
    return f"not in {d['wall_s']:.0f}" if d["equal_score_s"] is None else f"{d['equal_score_s']:.0f}"


def _broken_limit(d: Mapping[str, Any]) -> str:
    if d["breaks"] is None:
        return "-"
    return d.get("excess") or f"{d['breaks']} by {format_percent(100 * d['max_violation'])}"
