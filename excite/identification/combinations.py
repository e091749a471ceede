"""Parameters that a log shows only together with others: the combinations that it does show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from excite.text import format_number, format_uncertain

ZERO_SHARE = 1e-6  # size of a column, relative to the largest one, without effect; chosen
MEMBER_SHARE = 0.05  # of a dropped column that a member explains at least; chosen
MAX_MEMBERS = 4  # that are named; chosen
INDEPENDENT_SHARE = 0.3  # of a column that the others leave, from which it is shown by itself, though poorly; chosen


def describe_combinations(
    R: np.ndarray,
    scale: np.ndarray,
    names: Sequence[str],
    units: Sequence[str],
    x: np.ndarray,
    covariance: np.ndarray,
    k: int,
    others: Sequence[int],
) -> str:
    """Say why a log does not show parameter k by itself: which members' sums with it the log does show.

    R (rows, n): regressor or its triangle. scale (n,): sizes of the parameters. x (n,), covariance (n, n): values, NaN
    in the covariance of those that are held. others: parameters that may stand for k.
    """
    columns = R * scale
    size = np.linalg.norm(columns, axis=0)
    if size[k] <= ZERO_SHARE * size.max():
        return "nothing in this log depends on it"
    kept = [int(j) for j in others if size[j] > ZERO_SHARE * size.max()]
    known = np.nan_to_num(covariance)
    share, *_ = np.linalg.lstsq(columns[:, kept] / size[kept], columns[:, k] / size[k], rcond=1e-9)
    left = float(np.linalg.norm(columns[:, k] / size[k] - (columns[:, kept] / size[kept]) @ share))
    members = [i for i in np.argsort(-np.abs(share)) if abs(share[i]) > MEMBER_SHARE]
    if left > INDEPENDENT_SHARE or not members:
        return "hardly identifiable from this log: only the machine file's value is known"
    parts = []
    for i in members[:MAX_MEMBERS]:
        j = kept[i]
        factor = float(share[i] * size[k] / size[j] * scale[j] / scale[k])
        sign = "+" if factor > 0 else "-"
        size_text = format_number(abs(factor), 3)
        times = "" if size_text == "1" else f"{size_text} "
        value = x[j] + factor * x[k]
        std = np.sqrt(max(known[j, j] + 2 * factor * known[j, k] + factor**2 * known[k, k], 0.0))
        parts.append(f"{names[j]} {sign} {times}{names[k]} = {format_uncertain(value, std, units[j])}")
    more = f" and {len(members) - MAX_MEMBERS} more" if len(members) > MAX_MEMBERS else ""
    return f"this log shows it only together with others: {'; '.join(parts)}{more}"
