"""Diagnose from logs what a model gets wrong.

Forward selection: the model is fitted to the logs; where it follows them only with free friction near rest, that is
replaced by presliding at each joint that shows it. Every effect that the model lacks is scored (`score_test`), the
likeliest are fitted, and the best is added to the model (`selection`). This is repeated until the innovations are noise
or no effect helps. Effects that explain the logs about as well are tied. A misfit that no effect explains is
unexplained.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite.diagnosis import hold_out as gains, magnitude_interval, selection
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.fits import (
    MIN_PROCESS_NOISE,
    ExtendedFit,
    fit_machine,
    fit_machine_that_sticks,
    fit_with_process_noise,
    refit,
    with_true_sensor_noise,
)
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.residual_tests import find_anomalies
from excite.diagnosis.score_test import Score
from excite.diagnosis.selection import MIN_EXPLAINED_SHARE, Choice, ProgressCallback
from excite.logs import Log
from excite.model import Model, effects
from excite.model.machine import EffectEntry, Filter
from excite.smoothing import NotConvergedError

MAX_EFFECTS = 4  # number of effects beside presliding; chosen
MIN_COST_PER_ANOMALY = 50.0  # cost that an anomaly counts at least; chosen
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
    excess misfit that they explain. located: lines that describe what is unexplained. stages: fits with the first
    finding, the first two, and so on. nearest: the effect that explains most, if nothing is named. dropped: effects
    that explain too little to be causes, as corrections, with the fits with them.
    """

    verdict: str
    findings: tuple[Finding, ...]
    before: ExtendedFit
    after: ExtendedFit
    share: float
    located: tuple[str, ...]
    stages: tuple[ExtendedFit, ...]
    nearest: NearestEffect | None = None
    dropped: tuple[tuple[Finding, ExtendedFit], ...] = ()

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
        """Base parameters; without a standard deviation before if no model without the findings followed the logs."""
        before, after = (np.where(f.fit.unidentifiable, np.nan, f.fit.std) for f in (self.before, self.after))
        known = before if self.before.estimated else np.full_like(before, np.nan)
        found = dict(zip(self.after.model.base.names, zip(self.after.fit.X, after, strict=True), strict=True))
        base, X = self.before.model.base, self.before.fit.X
        return [
            ParameterChange(name, unit, float(value), float(std), *map(float, found[name]))
            for name, unit, value, std in zip(base.names, base.units, X, known, strict=True)
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
    before = fit_machine_that_sticks(fit_machine(model.machine, logs, filter, runner), logs, filter, runner)
    chosen = list[Choice]()
    if before.data.noise_inflation > 1:
        report(0.15, "fitting effects with inflated sensor noise")
        sharp = selection.choose_with_inflated_noise(before, runner)
        before, chosen = sharp or (fit_with_process_noise(before, runner), chosen)
    if before.data.sticks:
        report(0.15, "fitting friction near rest")
        chosen = selection.choose_presliding(before, runner, deadline)
    if not (before.estimated or chosen or deadline.is_over()):
        report(0.15, "fitting effects from initial trajectories")
        before, chosen = selection.choose_from_start(before, runner)
    chosen, next_ratio = extend_model(before, chosen, runner, report, deadline)
    added = chosen
    chosen, anomalies, nearest = drop_weak_effects(before, chosen)
    if not chosen and before.data.noise_inflation > 1:  # what is left is judged with the sensors' own noise
        report(0.85, "fitting the model with the sensors' own noise")
        before = fit_with_process_noise(before, runner)
        anomalies = anomaly_lines(before)
    if len(chosen) > 1 and not deadline.is_over():
        report(0.9, "testing each effect given the others")
        chosen, anomalies, nearest = drop_weak_effects(
            before, drop_unneeded(before, review_effects(before, chosen, runner))
        )
    stage = chosen[-1].stage if chosen else before
    found = conclude(before, stage, chosen, anomalies, next_ratio, nearest, runner)
    return found if found.findings else replace(found, dropped=_corrections(before, added, runner))


def _corrections(
    before: ExtendedFit, added: Sequence[Choice], runner: CallRunner
) -> tuple[tuple[Finding, ExtendedFit], ...]:
    """Return effects that were added but explain too little to be causes, each with the fit with it, as corrections.

    The list ends before an effect that makes a parameter impossible.
    """
    found = list[tuple[Finding, ExtendedFit]]()
    for k, x in enumerate(added):
        if not (before.estimated and x.stage.estimated) or x.stage.impossible:
            break
        found.append((_make_finding(x, x.stage, 0.0, k == 0, runner), x.stage))
    total = sum(x.likelihood_ratio for x in added[: len(found)])
    total += found[-1][1].excess_cost if found else 0.0
    return tuple(
        (replace(f, share=x.likelihood_ratio / total, kind="correction"), stage)
        for (f, stage), x in zip(found, added, strict=False)
    )


def extend_model(
    before: ExtendedFit,
    first: Sequence[Choice],
    runner: CallRunner,
    report: ProgressCallback,
    deadline: Deadline | None = None,
) -> tuple[list[Choice], float]:
    """Add effects one after the other until none is worth a place.

    first: effects that were chosen already. Return all choices, and the excess of the next score over
    MIN_LIKELIHOOD_RATIO, which was not enough.
    """
    chosen, stage, next_ratio = list(first), first[-1].stage if first else before, 0.0
    while stage.estimated and _n_beside_presliding(chosen) < MAX_EFFECTS and not stage.is_dead_end:
        turn = len(chosen)
        report(0.15 + 0.2 * turn, "scoring effects")
        scores = selection.score_effects(stage, runner)
        if deadline is not None and deadline.is_over():
            next_ratio = max(0.0, scores[0].likelihood_ratio - selection.MIN_LIKELIHOOD_RATIO) if scores else 0.0
            break
        hopeless = _cannot_explain(before, chosen, scores)
        choice = None if hopeless else selection.choose_effect(stage, scores, chosen, runner, report, 0.2 + 0.2 * turn)
        if choice is not None and before.estimated and _exceeds_earlier(choice, chosen):
            return [], 0.0
        if choice is None or _replaces_earlier(choice, chosen):
            next_ratio = max(0.0, scores[0].likelihood_ratio - selection.MIN_LIKELIHOOD_RATIO) if scores else 0.0
            break
        chosen.append(choice)
        stage = choice.stage
    return chosen, next_ratio


def _n_beside_presliding(chosen: Sequence[Choice]) -> int:
    """Return the number of effects beside presliding, of which a machine may have one at every joint."""
    return sum(not x.name.startswith(f"{selection.PRESLIDING}@") for x in chosen)


def _cannot_explain(before: ExtendedFit, chosen: Sequence[Choice], scores: Sequence[Score]) -> bool:
    """Tell if no further effects could explain enough, and the last one chosen does not hold by itself."""
    if not (chosen and chosen[-1].stage.exact):
        return False
    stage = chosen[-1].stage
    gained = sum(x.likelihood_ratio for x in chosen)
    most = (
        (MAX_EFFECTS - _n_beside_presliding(chosen))
        * selection.MAX_RATIO_OVER_SCORE
        * max((s.likelihood_ratio for s in scores), default=0.0)
    )
    too_little = gained + min(most, stage.excess_cost) < MIN_EXPLAINED_SHARE * (gained + stage.excess_cost)
    return too_little and len(drop_weak_effects(before, chosen)[0]) < len(chosen)


def drop_weak_effects(
    before: ExtendedFit, chosen: Sequence[Choice]
) -> tuple[list[Choice], tuple[str, ...], NearestEffect | None]:
    """Drop the last effects as long as they do not explain the misfit or make a parameter impossible.

    An effect holds if nothing is left with it, or if it explains MIN_EXPLAINED_SHARE; also with the process noise by
    which it was judged. Return the effects kept, lines about anomalies beside them, and the last effect dropped.
    """
    kept, nearest = list(chosen), None
    while True:
        stage = kept[-1].stage if kept else before
        anomalies = anomaly_lines(stage)
        impossible = stage.impossible if kept and stage.estimated else ()
        if not kept or (stage.exact and not anomalies and not impossible):
            break
        explained = _explained_share(kept[-1].likelihood_ratio, stage, anomalies)
        if explained >= MIN_EXPLAINED_SHARE and not impossible:
            break
        process_noise_fit = kept[-1].process_noise_fit
        if (
            process_noise_fit is not None
            and not impossible
            and _explained_share(
                kept[-1].likelihood_ratio, process_noise_fit, anomalies_with_noise := anomaly_lines(process_noise_fit)
            )
            >= MIN_EXPLAINED_SHARE
        ):
            # A nearly right formula leaves a large misfit of exact dynamics; the effect was judged with process noise.
            kept[-1], anomalies = replace(kept[-1], stage=process_noise_fit), anomalies_with_noise
            break
        nearest = NearestEffect(kept.pop().name, explained, impossible)
    return kept, anomalies, nearest


def review_effects(before: ExtendedFit, chosen: Sequence[Choice], runner: CallRunner = run_in_turn) -> list[Choice]:
    """Choose each of several effects again given all others, so that their order does not count.

    An effect that the others replace is dropped; one that another explains better is replaced; rivals are found anew.
    The first result stands unless the new one is better.
    """
    queue, found = list(chosen), chosen[-1].stage
    for first in chosen[:-1]:
        rest, whole = queue[1:], queue[-1].stage
        if whole.data.sticks and whole.placed(first.name).unsticking:
            queue = [*rest, replace(first, stage=whole, process_noise_fit=None)]  # chosen before all others
            continue
        try:
            stage = _refit_without(first.name, whole)
        except NotConvergedError:
            queue = [*rest, replace(first, stage=whole, process_noise_fit=None)]  # there is no fit without it
            continue
        choice = selection.choose_effect(
            stage, selection.score_effects(stage, runner), rest, runner, lambda share, what: None, 0.0
        )
        queue = (
            [*rest, choice]
            if choice is not None
            else [*rest[:-1], replace(rest[-1], stage=stage, process_noise_fit=None)]
        )
    whole, judged = queue[-1].stage, {x.name: x for x in queue}
    same = judged.keys() == {x.name for x in chosen}
    worse = whole.deviance - found.deviance > selection.MIN_LIKELIHOOD_RATIO * found.dispersion
    if same or worse or whole.fit.process_noise > found.fit.process_noise:
        judged = judged if same else {x.name: x for x in chosen}
        return [replace(x, rivals=_remaining_rivals(judged[x.name], judged)) for x in chosen]
    # Restore the order: each was moved to the end once, the last one not.
    again = _refit_one_by_one(before, (*queue[1:], queue[0]), whole)
    return [replace(x, rivals=_remaining_rivals(x, judged)) for x in again] if again else list(chosen)


def _refit_one_by_one(before: ExtendedFit, chosen: Sequence[Choice], whole: ExtendedFit) -> list[Choice]:
    """Add a model's effects one after the other, each with its gain over those before it; empty if a fit fails."""
    if before.data.noise_inflation > 1:
        return _refit_backwards(chosen, whole)
    made = [before]
    try:
        for x in chosen:
            machine = effects.with_effects(made[-1].machine, selection.fitted_entry(whole, x.name))
            made.append(refit(machine, made[-1], before.fit.process_noise))
        made[-1] = made[-1] if whole.fit.process_noise == before.fit.process_noise else whole
    except NotConvergedError:
        return []
    found = []
    for x, old, new in zip(chosen, made, made[1:], strict=False):
        alike = old.estimated and old.fit.process_noise == new.fit.process_noise
        gain = old.deviance - new.deviance if alike else x.likelihood_ratio
        found.append(replace(x, stage=new, likelihood_ratio=max(gain, x.likelihood_ratio), process_noise_fit=None))
    return found


def _refit_backwards(chosen: Sequence[Choice], whole: ExtendedFit) -> list[Choice]:
    """Remove a model's effects one after the other, if it has no fit without any; empty if a fit fails."""
    made = [whole]
    try:
        for x in reversed(chosen[1:]):
            made.append(_refit_without(x.name, made[-1]))
    except NotConvergedError:
        return []
    return [replace(x, stage=stage, process_noise_fit=None) for x, stage in zip(chosen, reversed(made), strict=True)]


def drop_unneeded(before: ExtendedFit, chosen: Sequence[Choice]) -> list[Choice]:
    """Drop effects that are insignificant beside the others.

    Such an effect is kept only if the fit without it is significantly worse and predicts withheld stretches worse:
    otherwise its shapes follow the noise.
    """
    kept, whole = list(chosen), chosen[-1].stage
    for x in chosen:
        # The standard deviation of a magnitude that vanishes at infinity says little.
        doubtful = whole.exact and whole.placed(x.name).effect.inverse
        if len(kept) == 1 or (_is_significant(x.name, whole) and not doubtful):
            continue
        beside = np.inf  # there is no fit without it
        with suppress(NotConvergedError):
            without = _refit_without(x.name, whole)
            if without.fit.process_noise <= whole.fit.process_noise:
                beside = without.deviance - whole.deviance
        proven = whole.placed(x.name).effect.inverse or np.isinf(beside)
        if beside < selection.required_likelihood_ratio(x.name, whole, x.n_candidates) or not (
            proven or _predicts_better(without, whole)
        ):
            kept, whole = [y for y in kept if y.name != x.name], without
        else:
            kept = [replace(y, conditional_ratio=beside) if y.name == x.name else y for y in kept]
    if len(kept) == len(chosen):
        return kept
    return _refit_one_by_one(before, kept, whole) or [replace(x, stage=whole, process_noise_fit=None) for x in kept]


def _predicts_better(without: ExtendedFit, whole: ExtendedFit) -> bool:
    """Tell if a model with an effect predicts withheld stretches better than without, or if none can be withheld."""
    found = gains.hold_out_gain(gains.hold_out_errors(without), gains.hold_out_errors(whole))
    return found is None or found.percent > 0


def _is_significant(name: str, stage: ExtendedFit) -> bool:
    """Tell if an effect's magnitude is significant; one that vanishes at infinity counts as significant."""
    return stage.placed(name).effect.inverse or selection.wald_statistic(name, stage) > selection.MIN_LIKELIHOOD_RATIO


def _replaces_earlier(choice: Choice, chosen: Sequence[Choice]) -> bool:
    """Tell if a choice makes an earlier effect insignificant that explained more.

    It is then part of another explanation, which takes several effects for what one explains.
    """
    return any(
        choice.likelihood_ratio < x.likelihood_ratio and not _is_significant(x.name, choice.stage) for x in chosen
    )


def _exceeds_earlier(choice: Choice, chosen: Sequence[Choice]) -> bool:
    """Tell if a choice gains more, with process noise, than all before it: the noise hid how little these explain."""
    return bool(chosen) and not choice.stage.exact and choice.likelihood_ratio > sum(x.likelihood_ratio for x in chosen)


def _remaining_rivals(choice: Choice, found: Container[str]) -> tuple[EffectEntry, ...]:
    """Return the rivals of an effect that are not found beside it."""
    return tuple(e for e in choice.rivals if e.label not in found)


def _refit_without(name: str, stage: ExtendedFit) -> ExtendedFit:
    """Refit a model without one of its effects. Raises NotConvergedError."""
    machine = effects.without_effect(stage.machine, name)
    try:
        return refit(machine, stage, stage.fit.process_noise)
    except NotConvergedError:
        return refit(machine, stage, max(stage.fit.process_noise, MIN_PROCESS_NOISE))


def anomaly_lines(stage: ExtendedFit) -> tuple[str, ...]:
    """Describe what is left beside noise, a line each, the most striking first."""
    stage = with_true_sensor_noise(stage)
    logs = stage.data.logs
    found = [
        (f"{log.source}: {a}" if len(logs) > 1 else str(a), a.size)
        for k, log in enumerate(logs)
        for a in find_anomalies(stage.machine, stage.data.space.sensors, log, stage.fit, k)
    ]
    return tuple(dict.fromkeys([*stage.suspect_sensors, *(line for line, _ in sorted(found, key=lambda x: -x[1]))]))


def _explained_share(gained: float, stage: ExtendedFit, anomalies: Sequence[str]) -> float:
    """Return the share of the misfit that effects explain by their gain."""
    total = gained + _unexplained_cost(stage, anomalies)
    return gained / total if total > 0 else 0.0


def _unexplained_cost(stage: ExtendedFit, anomalies: Sequence[str]) -> float:
    """Return the misfit that is left, at least MIN_COST_PER_ANOMALY for each anomaly."""
    return max(stage.excess_cost, MIN_COST_PER_ANOMALY * len(anomalies))


def conclude(
    before: ExtendedFit,
    after: ExtendedFit,
    chosen: Sequence[Choice],
    anomalies: tuple[str, ...],
    next_ratio: float,
    nearest: NearestEffect | None = None,
    runner: CallRunner = run_in_turn,
) -> Diagnosis:
    """Reach the verdict.

    Effects that are named must explain most of the misfit, and the rest must be noise or is described. next_ratio: gain
    of a further effect that was not worth a name.
    """
    share = 1.0
    if anomalies or not after.exact:
        share = _explained_share(sum(x.likelihood_ratio for x in chosen), after, anomalies)
        next_ratio = max(next_ratio, _unexplained_cost(after, anomalies))
    findings = tuple(_make_finding(x, after, next_ratio, len(chosen) == 1, runner) for x in chosen)
    gained = sum(x.likelihood_ratio for x in chosen)
    findings = tuple(
        replace(f, share=share * x.likelihood_ratio / gained) for f, x in zip(findings, chosen, strict=True)
    )
    nearest = None if findings else nearest
    verdict = "clean"
    if findings:
        verdict = "tied" if any(f.tied_with for f in findings) else "named"
    if (
        not after.estimated
        or (anomalies and (share < MIN_EXPLAINED_SHARE or not findings))
        or (not after.exact and not findings)
    ):
        verdict = "unexplained"
    if nearest is not None:
        verdict, share = "unexplained", 0.0
    if verdict == "unexplained":
        findings = tuple(replace(f, kind="correction") for f in findings)
    stages = tuple(x.stage for x in chosen)
    return Diagnosis(verdict, findings, before, after, share, anomalies, stages, nearest)


def opposite_phase(phase: float) -> float:
    """Return the phase [rad] half a turn on, from -pi to pi, which stands for a negative magnitude."""
    return float(np.angle(-np.exp(1j * phase)))


def _conditional_ratio(choice: Choice, after: ExtendedFit) -> float:
    """Return the likelihood ratio of an effect given all others, as computed or by Wald's statistic.

    It is infinite for an effect that vanishes at infinity.
    """
    if choice.conditional_ratio is not None:
        return choice.conditional_ratio / choice.dispersion
    if after.placed(choice.name).effect.inverse:
        return np.inf
    return selection.wald_statistic(choice.name, after) / choice.dispersion


def _make_finding(
    choice: Choice, after: ExtendedFit, next_ratio: float, alone: bool, runner: CallRunner = run_in_turn
) -> Finding:
    """Report a choice with magnitude and shapes of the last fit.

    The standard deviation of the magnitude includes the error of the formula, by what a further effect would gain and
    by FORMULA_STD_SHARE, and shapes that the logs hardly determine.
    """
    placed = after.placed(choice.name)
    std = after.fit.std * after.std_inflation
    values = dict(zip(after.model.base.names, zip(after.fit.X, std, strict=True), strict=True))
    amount, sure = values[placed.name]
    at_shapes = after.std_inflation * std_given_shapes(placed.name, after.model, after.fit.covariance)
    formula = FORMULA_STD_FACTOR * amount * np.sqrt(next_ratio / max(choice.likelihood_ratio, next_ratio, 1.0))
    at_shapes = float(np.linalg.norm([at_shapes, FORMULA_STD_SHARE * amount, formula]))
    sure = float(
        np.linalg.norm(
            [
                sure,
                FORMULA_STD_SHARE * amount,
                formula,
                magnitude_interval.std_over_weak_shapes(placed, after, runner),
            ]
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
    gain = choice.likelihood_ratio / choice.dispersion
    told = (
        gain if alone else min(gain, _conditional_ratio(choice, after))
    )  # the gain of one of several is that on the way to them
    p = min(
        1.0, choice.n_candidates * float(scipy.stats.chi2.sf(told, selection.degrees_of_freedom(choice.name, after)))
    )
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
