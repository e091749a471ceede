"""Numbers and lists as people read them, in sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence

LINES = 8  # of what is left of a misfit, that are told at once


def some(lines: Sequence[str]) -> list[str]:
    """The first of many lines, and where the rest is."""
    if len(lines) <= LINES + 1:
        return list(lines)
    return [*lines[:LINES], f"and {len(lines) - LINES} more, in summary.json under `located`"]


def rounded(value: object, digits: int = 4) -> str:
    """A number to so many digits, a dash where there is none; 170, not 1.7e+02, where it is below a million."""
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    if not isinstance(value, float):
        return str(value)
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def percent(value: float, digits: int = 2) -> str:
    """A number of per cent as it stands in a sentence."""
    return f"{rounded(float(value), digits)} %"


def likely(p: float) -> str:
    """A p-value, as small as it may be told."""
    return "< 1e-12" if p < 1e-12 else rounded(p, 2)
