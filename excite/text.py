"""Numbers and lists formatted for sentences and tables."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from numbers import Integral, Real

STD_DIGITS = 2  # significant digits of a standard deviation; chosen
MAX_DIGITS = 8  # of a value with a tiny standard deviation; chosen
MAX_LINES = 8  # lines printed of a longer list; chosen


def first_lines(lines: Sequence[str]) -> list[str]:
    """Return the first of many lines, and where to find the rest."""
    if len(lines) <= MAX_LINES + 1:
        return list(lines)
    return [*lines[:MAX_LINES], f"and {len(lines) - MAX_LINES} more, in summary.json under `located`"]


def format_number(value: object, digits: int = 4) -> str:
    """Format a number to some significant digits, a missing one as a dash; below a million without exponent."""
    if value is None or value != value:
        return "-"
    if not isinstance(value, Real) or isinstance(value, Integral):
        return str(value)
    text = f"{float(value):.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(float(value)) < 1e6 else text


def format_rounded(value: float | None, std: float | None, digits: int = 6) -> str:
    """Format a value to the decimals that its standard deviation gives it; to some digits without such a deviation."""
    if value is None or std is None or not (math.isfinite(value) and math.isfinite(std) and std > 0):
        return format_number(value, digits)
    decimals = STD_DIGITS - 1 - math.floor(math.log10(float(f"{std:.{STD_DIGITS}g}")))
    value = round(float(value), decimals) + 0.0  # no negative zero
    size = math.floor(math.log10(max(abs(value), std)))
    if size < -4 or size >= 6:
        return f"{value:.{min(max(size + decimals, STD_DIGITS - 1), MAX_DIGITS)}e}"
    return f"{value:.{min(max(decimals, 0), MAX_DIGITS)}f}"


def format_uncertain(value: float, std: float, unit: str = "") -> str:
    """Format a value with its standard deviation and unit, such as "0.0200 +- 0.0010 rad"; "-" is no unit."""
    tail = "" if unit in ("", "-") else f" {unit}"
    if not (math.isfinite(std) and std > 0):
        return f"{format_number(value)}{tail}"
    return f"{format_rounded(value, std)} +- {format_rounded(std, std)}{tail}"


def closest(name: object, allowed: Iterable[str]) -> str | None:
    """Return the allowed name that is most like a wrong one, None if none is."""
    return next(iter(difflib.get_close_matches(str(name), list(allowed), n=1)), None)


def did_you_mean(name: object, allowed: Iterable[str]) -> str:
    """Return " (did you mean X?)" for the allowed name that is most like a wrong one, "" if none is."""
    like = closest(name, allowed)
    return f" (did you mean {like}?)" if like else ""


def count(n: int, one: str, many: str = "") -> str:
    """Count things: "1 row", "3 rows"; many: a plural that is not one with an s."""
    return f"{n} {one if n == 1 else many or f'{one}s'}"


def format_percent(value: float, digits: int = 2) -> str:
    """Format a percentage for a sentence."""
    return f"{format_number(float(value), digits)} %"


def format_p_value(p: float) -> str:
    """Format a p-value, "< 1e-12" below that."""
    return "< 1e-12" if p < 1e-12 else format_number(p, 2)
