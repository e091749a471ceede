"""Describe what drives with and without a payload show of it."""

from __future__ import annotations

from excite.reports.description import Summary, Table
from excite.text import count, format_number, format_percent

WORDS = {"M": "mass", "MX": "first moment x", "MY": "first moment y", "MZ": "first moment z"}


def payload_remarks(s: Summary) -> list[str]:
    """Say how a payload is measured, and how accurately; nothing for other designs."""
    p = s.get("payload")
    if not p:
        return []
    std = p["std_percent"]
    worst = max(std, key=lambda n: std[n])
    drives = count(len(s["drives"]), "drive") if "drives" in s else "the drive"
    return [
        f"For a payload of {p['mass_kg']:g} kg on {p['body']}: take {drives} without it and with it, and identify the"
        " second logs with `--unloaded` of the first estimate. The difference shows every parameter of the payload to"
        f" {format_percent(std[worst])} of its usual size or better (worst {worst}). Limits are kept with the payload,"
        " too."
    ]


def payload_tables(s: Summary) -> list[Table]:
    """Return the table of a payload's attainable accuracy; none for other designs."""
    p = s.get("payload")
    if not p:
        return []
    rows = tuple(
        (n, WORDS.get(n, "inertia"), format_number(p["std"][n], 3), format_number(x, 3))
        for n, x in sorted(p["std_percent"].items(), key=lambda item: -item[1])
    )
    caption = (
        f"Attainable standard deviation of the payload's parameters in the frame of {p['body']} [SI], and in per cent"
        " of what a payload of this mass has, the worst first."
    )
    return [Table(caption, ("parameter", "what it is", "std", "%"), rows)]
