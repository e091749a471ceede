"""The course of a search over time, as a small drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence

from markupsafe import Markup

from excite.text import format_number

WIDTH, HEIGHT, EDGE = 360, 70, 6  # of the drawing [px]; chosen


def draw_course(found: Sequence[tuple[float, float]], now: float) -> str:
    """Return the best score so far over time as SVG, logarithmic, lower is better; "" until a second one is found.

    found: time [s] and score of each improvement. now [s]: end of the axis.
    """
    seen = [(t, math.log(score)) for t, score in found if math.isfinite(score) and score > 0]
    if len(seen) < 2:
        return ""
    first, low, high = seen[0][0], min(y for _, y in seen), max(y for _, y in seen)
    across = (WIDTH - 2 * EDGE) / max(now - first, 1e-9)
    up = (HEIGHT - 2 * EDGE) / max(high - low, 1e-9)
    points, before = [], seen[0][1]
    for t, y in (*seen, (now, seen[-1][1])):
        points += [f"{EDGE + (t - first) * across:.1f},{EDGE + (high - at) * up:.1f}" for at in (before, y)]
        before = y
    begun, now_best = (format_number(math.exp(y), 4) for y in (seen[0][1], seen[-1][1]))
    words = f"Best score so far: {begun} at {first:.0f} s, {now_best} now"
    drawing = Markup(
        '<svg viewBox="0 0 {} {}" width="{}" height="{}" role="img" aria-label="{}"><title>{}</title>'
        '<polyline points="{}" fill="none" stroke="currentColor" stroke-width="2"/></svg>'
    )
    return str(drawing.format(WIDTH, HEIGHT, WIDTH, HEIGHT, words, words, " ".join(points)))
