"""Numbers and lists formatted for sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence

MAX_LINES = 8  # lines printed of a longer list; chosen


def first_lines(lines: Sequence[str]) -> list[str]:
    """Return the first of many lines, and where to find the rest."""
    if len(lines) <= MAX_LINES + 1:
        return list(lines)
    return [*lines[:MAX_LINES], f"and {len(lines) - MAX_LINES} more, in summary.json under `located`"]


def format_number(value: object, digits: int = 4) -> str:
    """Format a number to some significant digits, a missing one as a dash; below a million without exponent."""
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    if not isinstance(value, float):
        return str(value)
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def format_percent(value: float, digits: int = 2) -> str:
    """Format a percentage for a sentence."""
    return f"{format_number(float(value), digits)} %"


def format_p_value(p: float) -> str:
    """Format a p-value, "< 1e-12" below that."""
    return "< 1e-12" if p < 1e-12 else format_number(p, 2)
