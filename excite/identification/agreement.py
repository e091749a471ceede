"""Whether one set of parameters explains several logs, and which parameters changed between them.

The estimates of the single logs are compared with the one that all share, by their covariances (Wald's test). If they
differ, the parameters that must differ are found one by one: the one that takes away most of the difference first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from excite.errors import NoEstimateError
from excite.identification.estimate import Estimate
from excite.identification.joint import UnexplainedError
from excite.identification.methods import identify
from excite.logs import Log
from excite.model import Model
from excite.model.machine import Filter
from excite.text import format_number, format_p_value, format_uncertain

SIGNIFICANCE = 1e-3  # p-value below which logs disagree; chosen
NOTABLE = 0.05  # p-value below which the differences between logs widen the intervals; chosen
MAX_CHANGED = 4  # parameters that are named; more have no single cause; chosen


@dataclass(frozen=True)
class ChangedParameter:
    """A parameter that differs between logs: its value and standard deviation [SI] in each, others being common."""

    name: str
    unit: str
    value: np.ndarray
    std: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """Comparison of logs. p_value: of a difference like theirs if nothing changed. changed: what differs.

    explained: the logs agree apart from what changed. ratio: of the differences to what the covariances say, at least 1
        (R. T. Birge, Phys. Rev. 40, 1932): the intervals of logs that agree only roughly are so much wider.
    """

    logs: tuple[str, ...]
    p_value: float
    changed: tuple[ChangedParameter, ...]
    explained: bool
    ratio: float = 1.0

    @property
    def agree(self) -> bool:
        """Tell if one set of parameters explains all logs."""
        return self.p_value >= SIGNIFICANCE


def compare_sources(
    model: Model, logs: Sequence[Log], method: str, filter: Filter
) -> tuple[Agreement | None, list[Estimate], bool | None]:
    """Identify each file of logs by itself and compare the estimates.

    Return no comparison and no estimates for one file, if one of them gives no estimate, or if the method knows that
    the model alone does not explain one: what it lacks may differ as well. The last is False then, as the model does
    not explain all logs either, and None if that is open.
    """
    groups = group_by_file(logs)
    if len(groups) < 2:
        return None, [], None
    try:
        estimates = [identify(model, group, method, filter, explained=True) for group in groups.values()]
    except UnexplainedError:
        return None, [], False
    except NoEstimateError:
        return None, [], None
    return compare_logs(tuple(groups), estimates), estimates, None


def group_by_file(logs: Sequence[Log]) -> dict[str, list[Log]]:
    """Return the logs of each file, which gaps may have cut."""
    groups: dict[str, list[Log]] = {}
    for one in logs:
        groups.setdefault(one.source.partition(" from row ")[0], []).append(one)
    return groups


def compare_logs(names: Sequence[str], estimates: Sequence[Estimate]) -> Agreement | None:
    """Compare estimates of single logs; None if the comparison would mislead.

    That is if intervals do not hold by the method itself, or if the logs leave different parameters unidentified: the
    others depend on the values at which these are held. None as well if no parameter is identified in all logs.
    """
    held = {frozenset(e.unidentifiable) for e in estimates}
    if len(held) > 1 or any(e.understated > 1 for e in estimates):
        return None
    known = np.all([np.isfinite(e.value) & np.isfinite(e.std) & (e.std > 0) for e in estimates], axis=0)
    at = np.flatnonzero(known)
    if not len(at) or len(estimates) < 2:
        return None
    scale = np.max([e.std for e in estimates], axis=0)[at]
    values = np.array([e.value[at] / scale for e in estimates])
    information = [_inverse(e.covariance[np.ix_(at, at)] / np.outer(scale, scale)) for e in estimates]
    changed: list[int] = []
    first = p = _p_value(values, information, changed)
    while p < SIGNIFICANCE and len(changed) < min(MAX_CHANGED, len(at)):
        rest = [k for k in range(len(at)) if k not in changed]
        changed.append(min(rest, key=lambda k: _misfit(values, information, [*changed, k])[0]))
        p = _p_value(values, information, changed)
    found = []
    if changed:
        _, x, covariance = _misfit(values, information, changed)
        std = np.sqrt(np.diag(covariance))
        n = len(at)
        for place, k in enumerate(changed):
            columns = [k if log == 0 else n + (log - 1) * len(changed) + place for log in range(len(estimates))]
            name, unit = estimates[0].names[at[k]], estimates[0].units[at[k]]
            found.append(ChangedParameter(name, unit, x[columns] * scale[k], std[columns] * scale[k]))
    freedom = (len(estimates) - 1) * len(at)
    ratio = float(np.sqrt(max(1.0, _misfit(values, information, [])[0] / freedom))) if first < NOTABLE else 1.0
    return Agreement(tuple(names), first, tuple(found), p >= SIGNIFICANCE, ratio)


def _inverse(covariance: np.ndarray) -> np.ndarray:
    """Inverse of a covariance, without directions that rounding alone determines."""
    variance, v = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((v / np.maximum(variance, 1e-12 * variance.max())) @ v.T)


def _p_value(values: np.ndarray, information: Sequence[np.ndarray], changed: Sequence[int]) -> float:
    logs, n = values.shape
    freedom = (logs - 1) * (n - len(changed))
    return float(scipy.stats.chi2.sf(_misfit(values, information, changed)[0], freedom)) if freedom else 1.0


def _misfit(
    values: np.ndarray, information: Sequence[np.ndarray], changed: Sequence[int]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit common parameters, and own values of changed ones in each log, to estimates values (logs, n).

    Returns the misfit, the solution (n values of the first log, then the changed ones of each other log) and its
    covariance.
    """
    logs, n = values.shape
    count = n + (logs - 1) * len(changed)
    H, g, design = np.zeros((count, count)), np.zeros(count), []
    for log in range(logs):
        D = np.zeros((n, count))
        D[:, :n] = np.eye(n)
        for place, k in enumerate(changed if log else ()):
            D[k, :] = 0.0
            D[k, n + (log - 1) * len(changed) + place] = 1.0
        design.append(D)
        H += D.T @ information[log] @ D
        g += D.T @ information[log] @ values[log]
    covariance = _inverse(H)
    x = covariance @ g
    left = [v - D @ x for v, D in zip(values, design, strict=True)]
    return float(sum(e @ P @ e for e, P in zip(left, information, strict=True))), x, covariance


def describe_agreement(agreement: Agreement) -> str:
    """Say whether logs agree on the parameters, and what changed."""
    if agreement.agree and agreement.ratio > 1:
        return (
            f"the {len(agreement.logs)} logs differ by {format_number(agreement.ratio, 2)} times what their intervals"
            f" say (p = {format_number(agreement.p_value, 2)}): the intervals of all together are so much wider"
        )
    if agreement.agree:
        return (
            f"one set of parameters explains the {len(agreement.logs)} logs (p = {format_number(agreement.p_value, 2)})"
        )
    p = format_p_value(agreement.p_value)
    p = p if p.startswith("<") else f"= {p}"
    text = f"the logs do not agree on the parameters (p {p})"
    if not agreement.explained:
        return f"{text}, and more than {len(agreement.changed)} of them would have to differ: identify each by itself"
    return f"{text}; what changed: {describe_changes(agreement)}. Estimated together these are averages"


def describe_changes(agreement: Agreement) -> str:
    """List the parameters that changed, with the value in each log."""
    return "; ".join(
        f"{c.name}: "
        + ", ".join(
            f"{format_uncertain(v, s, c.unit)} in {n}" for n, v, s in zip(agreement.logs, c.value, c.std, strict=True)
        )
        for c in agreement.changed
    )


def summarise_agreement(agreement: Agreement) -> dict[str, Any]:
    """Return a comparison of logs, ready for JSON."""
    return {
        "agree": agreement.agree,
        "p_value": agreement.p_value,
        "explained": agreement.explained,
        "ratio": agreement.ratio,
        "changed": {
            c.name: {"unit": c.unit, "value": c.value.tolist(), "std": c.std.tolist()} for c in agreement.changed
        },
    }
