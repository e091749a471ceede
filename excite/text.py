"""Numbers and lists as people read them, in sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence

MAX_LINES = 8  # of what is left of a misfit, that are told at once


def first_lines(lines: Sequence[str]) -> list[str]:
    """The first of many lines, and where the rest is."""
    if len(lines) <= MAX_LINES + 1:
        return list(lines)
    return [*lines[:MAX_LINES], f"and {len(lines) - MAX_LINES} more, in summary.json under `located`"]


def format_number(value: object, digits: int = 4) -> str:
    """A number to so many digits, a dash where there is none; 170, not 1.7e+02, where it is below a million."""
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    if not isinstance(value, float):
        return str(value)
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def format_percent(value: float, digits: int = 2) -> str:
    """A number of per cent as it stands in a sentence."""
    return f"{format_number(float(value), digits)} %"


def format_p_value(p: float) -> str:
    """A p-value, as small as it may be told."""
    return "< 1e-12" if p < 1e-12 else format_number(p, 2)
