"""Diagnose from logs what a model gets wrong.

The model is fitted to the logs, effects that it lacks are sought (`selection`), and the answer is judged by what the
fit with them leaves. Effects that explain the logs about as well are tied. A misfit that no effect explains is
unexplained; effects that take a part of it are corrections.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite.diagnosis import magnitude_interval, selection
from excite.diagnosis.curves import Curve
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.fits import ExtendedFit, fit_machine, fit_machine_that_sticks
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.residual_tests import find_anomalies
from excite.diagnosis.selection import Choice, ProgressCallback, Search
from excite.logs import Log
from excite.model import Model
from excite.model.machine import EffectEntry, Filter

MIN_COST_PER_ANOMALY = 50.0  # cost that an anomaly counts at least; chosen
MIN_EXPLAINED_SHARE = 0.85  # of the misfit, for a name; right causes in results/diagnosis explain 0.85 or more
MIN_UNKNOWN_GAIN = 8.0  # of unknown forces beside a model, from which it lacks something: one false alarm in 400 logs
FORMULA_STD_FACTOR = 0.5  # of a magnitude, times the root of the share of its gain left to other effects; chosen
FORMULA_STD_SHARE = 0.05  # of a magnitude, for other formulas; calibrated: covers nine in ten in results/diagnosis


@dataclass(frozen=True)
class Finding:
    """A named cause.

    rivals: effects that the cause is tied with, as fitted. p_value: of no effect at all given the others, corrected for
    the number of candidates. shapes: value, standard deviation, unit. likelihood_ratio: 2 delta log L over the
    dispersion. share: of the excess misfit that it explains. kind: cause if the findings explain the logs, correction
    if something else remains. std_at_shapes: standard deviation of the magnitude if the shapes are those found, which
    tells if there is such an effect at all. file_value: what the machine file has instead, for an error of the file.
    """

    effect: str
    where: str
    rivals: tuple[EffectEntry, ...]
    p_value: float
    magnitude: float
    magnitude_std: float
    unit: str
    shapes: Mapping[str, tuple[float, float, str]]
    likelihood_ratio: float
    share: float = 1.0
    kind: str = "cause"
    std_at_shapes: float = 0.0
    file_value: float | None = None

    @property
    def name(self) -> str:
        return f"{self.effect}@{self.where}"

    @property
    def tied_with(self) -> tuple[str, ...]:
        return tuple(e.label for e in self.rivals)

    @property
    def entry(self) -> EffectEntry:
        """The cause as an entry of the machine file."""
        return selection.identified_entry(
            self.effect, self.where, self.magnitude, {n: value for n, (value, _, _) in self.shapes.items()}
        )


@dataclass(frozen=True)
class NearestEffect:
    """An effect that explains a share of the misfit but is not named.

    impossible: parameters that it makes impossible. reason: why else it is not named.
    """

    name: str
    share: float
    impossible: tuple[str, ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class ParameterChange:
    """A base parameter [unit] and its standard deviation without and with the findings.

    A deviation is nan where the logs cannot tell the parameter and it stays at the machine file's value.
    """

    name: str
    unit: str
    before: float
    std_before: float
    after: float
    std_after: float


@dataclass(frozen=True)
class Diagnosis:
    """Verdict and findings of a diagnosis.

    verdict: clean, named, tied or unexplained. before, after: fits without and with the findings. share: share of the
    excess misfit that they explain. located: lines that describe what is unexplained. without: for each finding the fit
    without it but with all others, None if no exact dynamics follow the logs then. nearest: the effect that explains
    most, if nothing is named. curves: smooth functions of one signal, in `after` as well, that predict what no effect
    explains.
    """

    verdict: str
    findings: tuple[Finding, ...]
    before: ExtendedFit
    after: ExtendedFit
    share: float
    located: tuple[str, ...]
    without: tuple[ExtendedFit | None, ...] = ()
    nearest: NearestEffect | None = None
    curves: tuple[Curve, ...] = ()

    @property
    def extended(self) -> bool:
        """Tell if the model `after` has more than that `before`."""
        return bool(self.findings or self.curves)

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the logs."""
        return tuple(log.source for log in self.before.data.logs)

    @property
    def exact(self) -> tuple[bool, bool]:
        """Tell if the logs are followed with exact dynamics, without and with the findings."""
        return self.before.exact, self.after.exact

    @property
    def parameters(self) -> list[ParameterChange]:
        """Base parameters without and with the findings."""
        before, after = (np.where(f.fit.unidentifiable, np.nan, f.fit.std) for f in (self.before, self.after))
        found = dict(zip(self.after.model.base.names, zip(self.after.fit.X, after, strict=True), strict=True))
        base, X = self.before.model.base, self.before.fit.X
        return [
            ParameterChange(name, unit, float(value), float(std), *map(float, found[name]))
            for name, unit, value, std in zip(base.names, base.units, X, before, strict=True)
        ]

    @property
    def sticks(self) -> bool:
        """Tell if the logs are followed only with friction that sticks near rest."""
        return self.before.data.sticks


def diagnose(
    model: Model,
    logs: Sequence[Log],
    filter: Filter,
    progress: ProgressCallback | None = None,
    runner: CallRunner = run_in_turn,
    deadline: Deadline | None = None,
) -> Diagnosis:
    """Diagnose what these logs show that the model lacks.

    runner: runs independent calls; the answer does not depend on it. deadline: once the model is fitted, no further
    effect is begun after it. Raises NotConvergedError if the machine file's parameters give no motion,
    NotIdentifiableError if a torque is missing.
    """
    report, deadline = progress or (lambda share, what: None), deadline or Deadline()
    report(0.0, "fitting the model")
    before = fit_machine_that_sticks(fit_machine(model.machine, logs, filter), logs, filter)
    return conclude(before, selection.search(before, runner, report, deadline), runner)


def anomaly_lines(stage: ExtendedFit) -> tuple[str, ...]:
    """Describe what is left beside noise, a line each, the most striking first."""
    logs = stage.data.logs
    found = [
        (f"{log.source}: {a}" if len(logs) > 1 else str(a), a.size)
        for k, log in enumerate(logs)
        for a in find_anomalies(stage.machine, stage.data.space.sensors, log, stage.fit, k)
    ]
    return tuple(dict.fromkeys([*stage.suspect_sensors, *(line for line, _ in sorted(found, key=lambda x: -x[1]))]))


def _misfit(stage: ExtendedFit, unknown_gain: float, anomalies: Sequence[str]) -> float:
    """Return the misfit that a fit leaves: cost beyond noise, or what unknown forces gain, if that is more."""
    lacking = unknown_gain if unknown_gain >= MIN_UNKNOWN_GAIN else 0.0
    return max(stage.excess_cost, lacking, MIN_COST_PER_ANOMALY * len(anomalies))


def conclude(before: ExtendedFit, found: Search, runner: CallRunner = run_in_turn) -> Diagnosis:
    """Reach the verdict.

    Effects that are named must explain most of the misfit, and the rest must be noise or is described.
    """
    after, choices = found.stage, found.choices
    anomalies = anomaly_lines(after)
    left = _misfit(after, found.left, anomalies)
    gained = sum(x.likelihood_ratio for x in choices)
    share = gained / (gained + left) if gained else 1.0
    findings = tuple(_make_finding(x, after, left, found.n_candidates, runner) for x in choices)
    findings = tuple(
        replace(f, share=share * x.likelihood_ratio / gained) for f, x in zip(findings, choices, strict=True)
    )
    if choices and after.impossible:  # no cause makes a machine impossible, however much it explains
        impossible = NearestEffect(choices[-1].name, share, after.impossible)
        return Diagnosis("unexplained", (), before, before, 0.0, anomaly_lines(before), (), impossible)
    explains = after.exact and share >= MIN_EXPLAINED_SHARE
    nearest: NearestEffect | None = None
    if choices:
        verdict = "unexplained" if not explains else "tied" if any(f.tied_with for f in findings) else "named"
    else:
        verdict = "clean" if after.exact and not left else "unexplained"
        if verdict == "unexplained" and found.dropped:
            name, reason = next(reversed(list(found.dropped.items())))
            nearest = NearestEffect(name, 0.0, (), reason)
        share = 1.0 if verdict == "clean" else 0.0
    if verdict == "unexplained":
        findings = tuple(replace(f, kind="correction") for f in findings)
    without = tuple(x.without for x in choices) if len(choices) > 1 else (before,) * len(choices)
    return Diagnosis(verdict, findings, before, after, share, anomalies, without, nearest)


def opposite_phase(phase: float) -> float:
    """Return the phase [rad] half a turn on, from -pi to pi, which stands for a negative magnitude."""
    return float(np.angle(-np.exp(1j * phase)))


def _make_finding(
    choice: Choice, after: ExtendedFit, left: float, n_candidates: int, runner: CallRunner = run_in_turn
) -> Finding:
    """Report a choice with magnitude and shapes of the last fit.

    The standard deviation of the magnitude includes the error of the formula, by the misfit that is left and by
    FORMULA_STD_SHARE, and shapes that the logs hardly determine.
    """
    placed = after.placed(choice.name)
    std = after.fit.std * after.std_inflation
    values = dict(zip(after.model.base.names, zip(after.fit.X, std, strict=True), strict=True))
    amount, sure = values[placed.name]
    at_shapes = after.std_inflation * std_given_shapes(placed.name, after.model, after.fit.covariance)
    formula = FORMULA_STD_FACTOR * amount * np.sqrt(left / max(choice.likelihood_ratio, left, 1.0))
    at_shapes = float(np.linalg.norm([at_shapes, FORMULA_STD_SHARE * amount, formula]))
    sure = float(
        np.linalg.norm(
            [sure, FORMULA_STD_SHARE * amount, formula, magnitude_interval.std_over_weak_shapes(placed, after, runner)]
        )
    )
    shapes = {
        s: (*values.get(f"{placed.name}.{s}", (placed.values[s], 0.0)), placed.shape_unit(s)) for s in placed.shapes
    }
    if amount < 0 and (circular := [s for s, shape in placed.shapes.items() if shape.circular]):
        # A negative magnitude is a positive one half a turn on.
        amount = -amount
        for s in circular:
            shapes[s] = (opposite_phase(shapes[s][0]), *shapes[s][1:])
    gain = choice.likelihood_ratio / after.dispersion
    p = min(1.0, n_candidates * float(scipy.stats.chi2.sf(gain, selection.degrees_of_freedom(choice.name, after))))
    return Finding(
        placed.effect.name,
        placed.where,
        choice.rivals,
        p,
        float(amount),
        float(sure),
        placed.unit,
        shapes,
        gain,
        std_at_shapes=at_shapes,
        file_value=placed.file_value(after.machine),
    )


def std_given_shapes(name: str, model: Model, covariance: np.ndarray) -> float:
    """Return the standard deviation of an effect's magnitude given its shapes, from a covariance (n_base, n_base)."""
    names = model.base.names
    own = [names.index(name), *(k for k, n in enumerate(names) if n.startswith(f"{name}."))]
    block = covariance[np.ix_(own, own)]
    size = np.sqrt(np.diag(block))
    if not (np.isfinite(size).all() and (size > 0).all()):
        return float(size[0])
    return float(size[0] / np.sqrt(np.linalg.inv(block / np.outer(size, size))[0, 0]))
