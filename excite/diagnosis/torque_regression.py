"""Diagnose a machine whose joints are all driven from their torques, along the measured motion.

These torques are linear in the parameters, and stay so with effects of the catalogue as further columns. What the model
leaves lasts a while, so rows are whitened as a course and white noise (`torque_fit`). Effects compete by their evidence
beside curves of speed, position and time that mean nothing (`torque_search`), as they do in joint smoothing. One is
kept only if it predicts stretches that it was not fitted to. An effect that a curve explains as well is a correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.stats

from excite import identification
from excite.diagnosis.curves import Curve
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.diagnosis import FORMULA_STD_SHARE, MIN_EXPLAINED_SHARE, Finding, NearestEffect, ParameterChange
from excite.diagnosis.hold_out import HoldOutErrors, torque_names
from excite.diagnosis.selection import ProgressCallback
from excite.diagnosis.torque_curves import find_curves
from excite.diagnosis.torque_fit import Term, TorqueFit
from excite.diagnosis.torque_rows import TorqueRows, torque_rows
from excite.diagnosis.torque_search import Search, scaled_magnitude
from excite.errors import NotIdentifiableError
from excite.identification import Estimate, Solution
from excite.logs import Log
from excite.model import Model
from excite.model.machine import Filter
from excite.text import format_number

MIN_ROWS = 60  # in motion, of a joint; chosen
NOISE_RATIO = 1.3  # size of what is left, over the sensors' noise, up to which nothing is; chosen
MIN_LEVEL = 1e-6  # smallest noise of a row, of the torques' size; chosen


@dataclass(frozen=True)
class TorqueDiagnosis:
    """Verdict and findings of a regression on the torques; fields that it shares with `Diagnosis` mean the same.

    solution: of the parameters alone. curves: smooth functions of one signal that predict what no effect explains.
    rejected: effects that were tried, each with the reason why it is not given.
    """

    verdict: str
    findings: tuple[Finding, ...]
    before: TorqueFit
    after: TorqueFit
    share: float
    located: tuple[str, ...]
    curves: tuple[Curve, ...]
    solution: Solution
    filter: Filter
    rejected: tuple[str, ...] = ()
    nearest: NearestEffect | None = None

    @property
    def extended(self) -> bool:
        return bool(self.findings)

    @property
    def sources(self) -> tuple[str, ...]:
        return tuple(r.log.source for r in self.after.rows)

    @property
    def torques(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of every torque sensor."""
        return torque_names(self.after.model.machine)

    @property
    def exact(self) -> tuple[bool, bool]:
        return _explains(self.before), _explains(self.after)

    @property
    def parameters(self) -> list[ParameterChange]:
        model, shown = self.before.model, []
        blocks = [(r.W * r.used[:, :, None], r.Y * r.used) for r in self.before.rows]
        for f in (self.before, self.after):
            value, std = model.nominal.copy(), np.full(len(model.nominal), np.nan)
            n = len(f.kept)
            value[f.kept], std[f.kept] = f.x[:n], np.sqrt(np.diag(f.covariance)[:n])
            shown.append((identification.restore_tied_parameters(model, blocks, self.solution, value), std))
        (old, old_std), (new, new_std) = shown
        return [
            ParameterChange(*row)
            for row in zip(model.base.names, model.base.units, old, old_std, new, new_std, strict=True)
        ]


def by_torques(model: Model) -> bool:
    """Tell if all joints are driven and rigid, so that torques along the measured motion tell what a model lacks.

    Torques must be linear in the effects that the model has.
    """
    linear = not any(e.name in model.nonlinear or e.effect.sensor_only for e in model.effects)
    return model.fully_driven and linear and not model.known


def _explains(fit: TorqueFit) -> bool:
    """Tell if a fit leaves no more than the sensors' noise."""
    rows = list(fit.model.actuated)
    return bool((fit.level[rows] <= NOISE_RATIO * fit.lowest[rows]).all())


def diagnose_torques(
    model: Model,
    logs: Sequence[Log],
    filter: Filter,
    report: ProgressCallback | None = None,
    deadline: Deadline | None = None,
) -> tuple[TorqueDiagnosis, list[HoldOutErrors]]:
    """Diagnose the torques of a machine whose joints are all driven (`by_torques`).

    Return the errors on withheld stretches without findings, with the first, the first two, ... as well. Raises
    NotIdentifiableError.
    """
    report, deadline = report or (lambda share, what: None), deadline or Deadline()
    report(0.05, "fitting the torques")
    before, solution = _fit_without_effects(model, logs, filter)
    search = _search(before, filter, solution)
    reasons = dict[str, str]()
    after = search.extend(before, reasons, report, deadline)
    if not _is_named(before, after):  # what a curve explains better may still take a part of it, as a correction
        after = search.extend(after, reasons, report, deadline, curves=False)
    after = _largest_first(before, after)
    between = [before.with_terms(after.terms[:k]) for k in range(1, len(after.terms))]
    stages = [before, *between, after] if after.terms else [before]
    withheld = [stage.hold_out(before)[1] for stage in stages]
    explained, named, total = _explains(after), _is_named(before, after), _excess(before)
    shares = [(_excess(a) - _excess(b)) / total if total > 0 else 1.0 for a, b in pairwise(stages)]
    kind = "cause" if named else "correction"
    findings = [_finding(search, after, *each, kind) for each in zip(after.terms, shares, strict=True)]
    verdict = "unexplained"
    if named:
        tied = any(f.rivals for f in findings)
        verdict = "clean" if not findings else "tied" if tied else "named"
    curves = [] if explained or deadline.is_over() else find_curves(after, search.torques, report)
    located = [] if explained else [*_what_is_left(after), *map(str, curves)]
    share = 1.0 if explained else sum(shares)
    tried = [f"{name}: {why}" for name, why in reasons.items() if name not in {t.name for t in after.terms}]
    found = TorqueDiagnosis(
        verdict, tuple(findings), before, after, share, tuple(located), tuple(curves), solution, filter, tuple(tried)
    )
    return found, withheld


def _search(fit: TorqueFit, filter: Filter, solution: Solution) -> Search:
    """Return a search for effects along the rows of a fit. solution: of the parameters alone."""
    blocks = [(r.W, r.Y) for r in fit.rows]
    return Search(fit.model, fit.rows, filter, identification.fit_rows(fit.model, blocks, solution))


def _is_named(before: TorqueFit, after: TorqueFit) -> bool:
    """Tell if effects explain the torques, or a single one nearly all of the misfit: several would be a patchwork."""
    total = _excess(before)
    most = len(after.terms) == 1 and total - _excess(after) >= MIN_EXPLAINED_SHARE * total
    return _explains(after) or most


def _fit_without_effects(model: Model, logs: Sequence[Log], filter: Filter) -> tuple[TorqueFit, Solution]:
    """Fit the parameters to torques. Raises NotIdentifiableError."""
    rows = torque_rows(model, logs, filter)
    _require_rows(model, rows)
    errors = [identification.row_errors(model, x, filter, 1) for x in logs]
    lowest = identification.row_levels(errors, model.nominal, [r.used for r in rows])
    lowest = np.maximum(lowest, MIN_LEVEL * np.sqrt(np.mean(np.concatenate([r.Y**2 for r in rows], axis=1))))
    solution = identification.solve_blocks([(r.W, r.Y) for r in rows], model.scale)
    return TorqueFit(model, rows, solution.kept, lowest, []), solution


def estimate_if_explained(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate | None:
    """Return the estimate from torques, None if it leaves more than the sensors' noise.

    Raises NotIdentifiableError.
    """
    fit = _fit_without_effects(model, logs, filter)[0]
    if not _explains(fit):
        return None
    base, n = model.base, len(model.nominal)
    size = np.linalg.norm(fit.whitened_design, axis=0)
    value, covariance = np.full(n, np.nan), np.full((n, n), np.nan)
    A = fit.whitened_design / size
    value[fit.kept] = fit.whitened_x
    covariance[np.ix_(fit.kept, fit.kept)] = np.linalg.inv(A.T @ A) / np.outer(size, size)
    tied = {name: "" for k, name in enumerate(base.names) if k not in fit.kept}
    errors = np.concatenate(fit.residual, axis=1)
    return Estimate("wls", base.names, base.units, value, covariance, np.nan, np.nan, np.nan, errors, len(A), tied, ())


def _require_rows(model: Model, rows: Sequence[TorqueRows]) -> None:
    """Raise NotIdentifiableError if a joint hardly moves along all logs."""
    for k, body in zip(model.actuated, model.machine.actuated, strict=True):
        count = sum(int(r.used[k].sum()) for r in rows)
        if count < MIN_ROWS:
            raise NotIdentifiableError(
                f"{rows[0].log.source}: {count} filtered rows with {body.where} in motion are too few to explain its"
                f" torque (at least {MIN_ROWS}): record a longer log, or reduce the filter's decimation"
            )


def _largest_first(before: TorqueFit, after: TorqueFit) -> TorqueFit:
    """Order the effects by what each takes alone."""
    if len(after.terms) < 2:
        return after
    return after.with_terms(sorted(after.terms, key=lambda term: _excess(before.with_terms([term]))))


def _excess(fit: TorqueFit) -> float:
    """Sum of squares of the torques' errors beyond the noise, in units of the noise."""
    rows = list(fit.model.actuated)
    return float(np.maximum((fit.level[rows] / fit.lowest[rows]) ** 2 - 1, 0).sum())


def names_in_clean_torques(d: TorqueDiagnosis, seed: int) -> list[str]:
    """Return the names of effects that a search adds to clean simulated torques of the machine as diagnosed."""
    clean = d.after.simulated(np.random.default_rng(seed))
    found = _search(clean, d.filter, d.solution).extend(clean, {}, lambda share, what: None, Deadline())
    known = {t.name for t in d.after.terms}
    return [t.name for t in found.terms if t.name not in known]


def _finding(search: Search, fit: TorqueFit, term: Term, share: float, kind: str) -> Finding:
    """Report an effect with its rivals."""
    placed = term.effect
    c, std = fit.coefficient(term)
    relative = fit.shape_stds(term)
    magnitude = scaled_magnitude(placed, c)
    size = float(np.hypot(magnitude * std / c, FORMULA_STD_SHARE * magnitude))
    shapes = {
        n: (placed.values[n], abs(placed.values[n]) * relative.get(n, 0.0), placed.shape_unit(n)) for n in placed.shapes
    }
    certainty = (c / std) ** 2
    return Finding(
        placed.effect.name,
        placed.where,
        search.rivals(fit, term),
        float(min(1.0, len(search.names) * scipy.stats.chi2.sf(certainty, 1 + len(relative)))),
        float(magnitude),
        size,
        placed.unit,
        shapes,
        certainty,
        share,
        kind,
        size,
        placed.file_value(search.model.machine),
    )


def _what_is_left(fit: TorqueFit) -> list[str]:
    """Say of each torque what is left beside noise, the largest first."""
    rows = list(fit.model.actuated)
    ratio = fit.level[rows] / fit.lowest[rows]
    names = torque_names(fit.model.machine)
    return [
        f"{names[k][0]}: {format_number(fit.level[rows[k]], 3)} {names[k][1]} are left, {format_number(ratio[k], 2)}"
        " times its noise"
        for k in np.argsort(-ratio)
        if ratio[k] > NOISE_RATIO
    ]
