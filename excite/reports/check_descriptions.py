"""Checks of logs and machine files in words and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from excite.reports.description import Description, Summary, Table, format_sum
from excite.text import count, format_number


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
    tables = (*tables, *_sensor_table(s.get("sensors", ())))
    return Description(f"The machine file {s['file']}", headline, tables, _check_remarks(s))


def _sensor_table(sensors: Sequence[Mapping[str, Any]]) -> tuple[Table, ...]:
    """Return the table of a machine's sensors, none without sensors."""
    rows = tuple(
        (
            " - ".join(r["columns"]),
            r["unit"],
            format_number(r["rate_hz"], 4),
            *(format_number(r[key], 3) for key in ("noise", "noise_si")),
            r["si_unit"],
            *(format_number(r[key], 3) for key in ("resolution", "at_limit")),
        )
        for r in sensors
    )
    caption = "Sensors: noise, resolution and reading at the limit in the unit of the column; noise also in SI."
    names = ("column", "unit", "rate [Hz]", "noise", "noise in SI", "SI unit", "resolution", "at the limit")
    return (Table(caption, names, rows),) if rows else ()


def _count_things(n: int) -> str:
    return "One thing is" if n == 1 else f"{n} things are"


def _check_remarks(s: Summary) -> tuple[str, ...]:
    """Return the faults, doubts and remarks of a check."""
    return (*(f"Wrong: {x}" for x in s["faults"]), *(f"Doubtful: {x}" for x in s["doubts"]), *s["remarks"])
