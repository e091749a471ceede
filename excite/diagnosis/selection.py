"""Choose one further effect for a model, with the rivals that explain the logs about as well.

Candidates are scored to first order, the likeliest are fitted, and the best fit is chosen. If no model tracks the logs,
the first effect, or a pair, is chosen with inflated sensor noise (`choose_with_inflated_noise`) or by fits from initial
trajectories (`choose_from_start`). If nothing explains the logs, candidates with low scores are fitted too
(`choose_unlikely`).

Likelihood ratio means 2 delta log L, the decrease of the cost.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.stats

from excite import identification
from excite.diagnosis import score_test
from excite.diagnosis.fits import (
    LOST_COST_RATIO,
    MIN_PROCESS_NOISE,
    TRACKING_COST_RATIO,
    ExtendedFit,
    drop_process_noise,
    exact_if_close,
    refit,
    refit_all,
    refit_and_drop_noise,
    resume_with_true_sensor_noise,
)
from excite.diagnosis.parallel import CallRunner
from excite.diagnosis.residual_tests import is_shaking
from excite.diagnosis.screening import fit_screened
from excite.logs import Log
from excite.model import effects
from excite.model.effects import Effect, PlacedEffect
from excite.model.machine import EffectEntry, Quantity
from excite.smoothing import NotConvergedError

# Of twice the log-likelihood that an effect must gain; logs without any stayed below 16. Chi-squared gives 2.1 % of
# logs of a minute above what `threshold` makes of it, 2.7 % of longer ones, at most: summed over the 371 and 441
# candidates of va12 as if these had nothing in common, with all their shapes.
MIN_LIKELIHOOD_RATIO = 22.0
MAX_P_VALUE = 0.05  # p-value above which no effect has a name: those with many shapes must gain more than LEVEL
MIN_SCORE = 15.0  # a first-order gain below which a candidate isn't fitted
MIN_SCORE_SHARE = (
    0.4,
    0.15,
)  # share of the best first-order gain below which a candidate isn't fitted: weak misfit, strong misfit
MAX_CANDIDATES = 5  # candidates that are fitted, beside further variants of the likeliest names
VARIANT_SCORE_SHARE = 0.7  # share of a name's best first-order gain from which another variant of it is fitted as well
PLAIN_VARIANT_SCORE_SHARE = (
    0.5  # the same for the variant without unusual shapes, which the others may mimic before a fit
)
MAX_RESTARTS = 12  # effects that begin anew where nothing was found
# Candidates that are fitted before any is compared with another, or with forces so large that they take up part of any
# cause.
FIRST_BATCH = 2
CANDIDATE_PROGRESS_SHARE = (
    0.5  # share of what must be gained, or was already, that candidates must have come to after a few passes
)
MAX_RATIO_OVER_SCORE = 2.5  # by which what a candidate gains may exceed its first-order gain
TIE_LIKELIHOOD_RATIO = 10.0  # a rival that is worse by less than this is a tie
# Of what is explained already, that a further effect must gain, as nature is never exactly the formula: by the fits'
# gains, and by how many deviations the amounts are from none; the more where parameters absorb most of an effect, as
# they absorb none of its formula's error; for what acts at some time only; where forces hide how good the formula is;
# beside what a map of the ground tells, as of a gain two maps of one ground leave each other up to 1.3 %.
SHAPE = 0.005, 0.002
MAX_ABSORBED_FORMULA_SHARE, MIN_GAIN_SHARE_TIMED, MIN_GAIN_SHARE_WITH_NOISE, MIN_GAIN_SHARE_MAPPED = (
    0.1,
    0.1,
    0.25,
    0.02,
)
LARGE_EXCESS_RATIO = (
    0.1  # misfit beside noise, over what noise makes, of which one further effect takes away all only as a cause
)
FORMULA_MAGNITUDE_ERROR = (
    0.03  # of an amount: what two formulas of one effect differ by; those of results/diagnosis do by 1 to 6 %
)
MAX_FORMULA_RATIO = 250.0  # a gain that by the latter no effect can be denied, nor counted as a rival
REFINEMENT_REACHES = (
    1.0,
    0.35,
)  # way to the grid's next points within which the best candidates are tried again, in turn
INSTANT_ACCURACY_S = 0.5  # [s] about which instants are known before a fit, which finds them from near only
MIN_EXCESS_SHARE = (
    0.05,
    0.15,
)  # of the excess misfit that an effect must explain to be worth a place: weak misfit, strong misfit
# The same of the first effect beside exact dynamics or large forces, as the largest of three explains so much, and of a
# further one where the model isn't near the logs yet: what takes less leads to no name, one patch after another.
MIN_EXCESS_SHARE_OF_FIRST = 0.3
MIN_SHARE_FOR_PROCESS_NOISE = (
    0.7  # of the excess misfit beside coarse sensors, from which a fit with sharp ones is worth disturbing forces
)
TIE_GAIN_SHARE_WITH_NOISE = (
    0.02  # of what is gained with disturbing forces, by which a rival is a tie: they take up part of a difference
)
TIE_EXCESS_SHARE = 0.3  # of what the best name leaves unexplained, by which a rival may be worse and still is a tie
MIN_MAGNITUDE_STDS = (
    0.3  # deviations above zero, below which a fit ends where the logs would like an amount best below zero
)
SMALLEST_VALUE = 1e-12  # what a machine file can't hold is nothing
ProgressCallback = Callable[[float, str], None]  # told the share that is done and what is done next
_Trial = tuple[score_test.Score, ExtendedFit]


@dataclass(frozen=True)
class Choice:
    """An effect that was added, the model with it, and its rivals.

    likelihood_ratio: over the model without it (Wald's statistic if that could not be fitted). dispersion: factor by
        which the remaining misfit reduces its significance. n_candidates: number of candidates that were scored.
    unabsorbed_share: share of the effect that parameters do not absorb.
    process_noise_fit: the fit with process noise by which it was judged, if `stage` needs none.
    conditional_ratio: likelihood ratio given all other effects, if it was computed.
    """

    name: str
    stage: ExtendedFit
    likelihood_ratio: float
    dispersion: float
    n_candidates: int
    rivals: tuple[EffectEntry, ...]
    unabsorbed_share: float
    process_noise_fit: ExtendedFit | None = None
    conditional_ratio: float | None = None


def wald_statistic(name: str, stage: ExtendedFit) -> float:
    """Return Wald's statistic of an effect: squared distance of its magnitude from zero, in standard deviations.

    Signed shapes count together with the magnitude, as one may stand for the other. It is 0 for unidentifiable
    parameters.
    """
    shapes, names, fit = stage.placed(name).effect.shapes, stage.model.base.names, stage.fit
    told = [name, *(f"{name}.{s}" for s, shape in shapes.items() if shape.signed and not shape.circular)]
    at = [k for k in (names.index(n) for n in told if n in names) if not fit.unidentifiable[k]]
    away = fit.X[at] / fit.std[at]
    return float(away @ np.linalg.solve(fit.covariance[np.ix_(at, at)] / np.outer(fit.std[at], fit.std[at]), away))


def degrees_of_freedom(name: str, stage: ExtendedFit) -> int:
    """Return the number of an effect's fitted parameters: magnitude and shapes."""
    return sum(n == name or n.startswith(f"{name}.") for n in stage.model.base.names)


def required_likelihood_ratio(name: str, stage: ExtendedFit, tried: int) -> float:
    """Return the likelihood ratio from which an effect is significant, given the number of candidates (Bonferroni)."""
    return max(MIN_LIKELIHOOD_RATIO, float(scipy.stats.chi2.isf(MAX_P_VALUE / tried, degrees_of_freedom(name, stage))))


def _total_wald_statistic(stage: ExtendedFit) -> float:
    """Return the sum of Wald's statistics of a model's effects."""
    return sum(wald_statistic(e.name, stage) for e in stage.model.effects if not e.effect.inverse)


def score_effects(stage: ExtendedFit, runner: CallRunner) -> tuple[score_test.Score, ...]:
    """Score every effect that a model lacks, best first, once for each fit.

    An effect that is as well a harmonic of one in the model is left out, such as a ripple of another wheel that turns
    equally fast.
    """
    if not stage.scores:
        stage.scores.append(_score_new_effects(stage, runner))
    return stage.scores[0]


def _score_new_effects(stage: ExtendedFit, runner: CallRunner) -> tuple[score_test.Score, ...]:
    known = [e.name for e in stage.model.effects]
    sensors = [s.name for s in stage.data.space.sensors]
    found = score_test.candidates(stage.machine, sensors, _duration(stage.data.logs))
    wanted = [x for x in found if x.name not in known or _has_harmonics(x.placed.effect)]
    scores = _score_along(stage, score_test.renumber_columns(wanted), runner)
    harmonic: dict[str, float] = {}
    for s in scores:
        if s.candidate.name in known:
            harmonic.setdefault(s.candidate.placed.effect.name, s.likelihood_ratio + TIE_LIKELIHOOD_RATIO)
    new = (s for s in scores if s.candidate.name not in known)
    return tuple(s for s in new if s.likelihood_ratio > harmonic.get(s.candidate.placed.effect.name, -np.inf))


def _has_harmonics(effect: Effect) -> bool:
    shapes = effect.shapes.values()
    return any(s.circular for s in shapes) and any(s.whole and len(s.grid) > 1 for s in shapes)


def _score_along(
    stage: ExtendedFit, found: Sequence[score_test.Candidate], runner: CallRunner
) -> tuple[score_test.Score, ...]:
    return score_test.score_candidates(stage.fitted_logs, stage.fit, found, runner)


def _duration(logs: Sequence[Log]) -> float:
    return max(float(log.t[-1] - log.t[0]) for log in logs)


def _start_entry(score: score_test.Score) -> EffectEntry:
    """Return a candidate as an entry of the machine file, from which a fit starts."""
    e, values = score.candidate.placed, dict(score.values)
    amount = values.pop("A")
    if len(e.effect.grid) > 1:
        # Not proportional to the amount: no further from the grid's value than the signature holds.
        step = float(np.clip(amount / e.values["A"], 0.3, 2.0))
        amount = e.values["A"] / step if e.effect.inverse else e.values["A"] * step
    return identified_entry(
        e.effect.name, e.where, amount, {n: round(v, 12) for n, v in values.items() if n in e.shapes}
    )


def fitted_entry(stage: ExtendedFit, name: str) -> EffectEntry:
    """Return an effect as an entry of the machine file, with magnitude and shapes of a fit."""
    placed = stage.placed(name)
    values = _fitted_values(stage, placed)
    amount = values.pop("A")
    amount = (
        max(amount, 2 * SMALLEST_VALUE) if placed.effect.positive else amount
    )  # zero is none that a machine may have
    return identified_entry(placed.effect.name, placed.where, amount, values)


def _fitted_values(stage: ExtendedFit, placed: PlacedEffect) -> dict[str, float]:
    """Return magnitude and shapes of an effect in a fit."""
    fitted = dict(zip(stage.model.base.names, stage.fit.X, strict=True))
    return {key: float(fitted.get(p, placed.values[key])) for p, (key, _) in placed.parameters.items()}


def identified_entry(effect: str, where: str, amount: float, shapes: Mapping[str, float]) -> EffectEntry:
    """Return an effect with identified magnitude and shapes as an entry of the machine file."""

    def told(value: float) -> Quantity:
        return Quantity(value=value if abs(value) > SMALLEST_VALUE else 0.0, source="identified")

    return EffectEntry(
        name=effect, where=where, amount=told(amount), shape={name: told(x) for name, x in shapes.items()}
    )


def _shortlist(
    stage: ExtendedFit, scores: Sequence[score_test.Score], chosen: Sequence[Choice]
) -> list[score_test.Score]:
    """Return the best candidate of each variant, best first, as far as it is worth a fit.

    There are MAX_CANDIDATES, and further variants of the likeliest FIRST_BATCH names.
    """
    best: dict[tuple[str, ...], score_test.Score] = {}
    most: dict[str, float] = {}
    hope = max(MIN_SCORE, MIN_SCORE_SHARE[stage.first_order_is_rough] * scores[0].likelihood_ratio) if scores else 0.0
    for s in scores:
        whole = _has_large_excess(stage) and MAX_RATIO_OVER_SCORE * s.likelihood_ratio >= stage.excess_cost
        least = (
            _required_gain(stage, chosen, s.candidate, 0.0) / MAX_RATIO_OVER_SCORE
            if stage.estimated and not whole
            else 0.0
        )
        worth = s.likelihood_ratio >= max(least, hope) and s.values["A"] != 0
        like = VARIANT_SCORE_SHARE if len(s.candidate.variant) > 1 else PLAIN_VARIANT_SCORE_SHARE
        if worth and s.likelihood_ratio >= like * most.setdefault(s.candidate.name, s.likelihood_ratio):
            best.setdefault(s.candidate.variant, s)
    shortlist = list(best.values())
    first = _unique_names(shortlist)[:FIRST_BATCH]
    return [*shortlist[:MAX_CANDIDATES], *(s for s in shortlist[MAX_CANDIDATES:] if s.candidate.name in first)]


def _refined_shortlist(
    stage: ExtendedFit, scores: Sequence[score_test.Score], chosen: Sequence[Choice], runner: CallRunner
) -> list[score_test.Score]:
    """Return the candidates that are worth a fit, refined between trial values."""
    shortlist, duration = _shortlist(stage, scores, chosen), _duration(stage.data.logs)
    for reach in (*REFINEMENT_REACHES, *_reaches_in_time(duration)) if shortlist else ():
        about = [s for s in shortlist if reach in REFINEMENT_REACHES or s.candidate.placed.effect.timed]
        nearby = score_test.refine_candidates(about, stage.machine, duration, reach)
        if len(nearby) > len(about):
            shortlist = _shortlist(
                stage,
                sorted([*shortlist, *_score_along(stage, nearby, runner)], key=lambda s: -s.likelihood_ratio),
                chosen,
            )
    return shortlist


def _reaches_in_time(duration: float) -> list[float]:
    """Return further reaches of refinement until instants are known, for a log of a duration [s]."""
    found = [REFINEMENT_REACHES[-1]]
    while found[-1] * duration / 12 > INSTANT_ACCURACY_S:  # of a grid as wide as a quarter of the log, thirds are tried
        found.append(found[-1] * REFINEMENT_REACHES[-1])
    return found[1:]


def choose_effect(
    stage: ExtendedFit,
    scores: Sequence[score_test.Score],
    chosen: Sequence[Choice],
    runner: CallRunner,
    report: ProgressCallback,
    done: float,
) -> Choice | None:
    """Choose the effect that explains most beside those chosen; None if none is worth a place."""
    shortlist = _refined_shortlist(stage, scores, chosen, runner)
    if not shortlist:
        return None

    def told(k: int) -> None:
        report(done + 0.03 * min(k, MAX_CANDIDATES), f"fitting {shortlist[k].candidate.name}")

    ceiling = np.inf
    if _noise_hides_misfit(stage):
        ceiling = stage.fit.cost - CANDIDATE_PROGRESS_SHARE * min(
            _required_gain(stage, chosen, s.candidate, 0.0) for s in shortlist
        )
    trials, refused = _fit_candidates(stage, shortlist, runner, told, ceiling)
    if stage.exact and _likeliest_not_found(shortlist, trials, refused):
        # Exact dynamics find no way to the likeliest cause: all are judged with disturbing forces instead.
        known = chosen[-1].process_noise_fit if chosen else None
        if known is not None and known.machine is stage.machine and known.fit.process_noise == MIN_PROCESS_NOISE:
            stage = known
        else:
            try:
                stage = refit(stage.machine, stage, MIN_PROCESS_NOISE)
            except NotConvergedError:
                return None
        found = score_test.renumber_columns([s.candidate for s in shortlist])
        shortlist = _shortlist(stage, _score_along(stage, found, runner), chosen)
        if not shortlist:
            return None
        trials, _ = _fit_candidates(stage, shortlist, runner, lambda k: None)
    if not trials:
        return None
    score, best = trials[0]
    gain = stage.fit.cost - best.fit.cost
    level = required_likelihood_ratio(score.candidate.name, best, len(scores))
    whole = _explains_rest(best, stage)
    if gain < max(level * best.dispersion, 0.0 if whole else _required_gain(stage, chosen, score.candidate, 0.0)):
        return None
    hidden = not whole and gain < _required_gain(stage, chosen, score.candidate)
    if hidden and not best.is_close:
        return None
    choice = _make_choice(trials, gain, len(scores), runner)
    if not hidden:
        return choice
    return replace(choice, process_noise_fit=None) if choice.stage.exact and choice.stage.is_close else None


def _make_choice(trials: Sequence[_Trial], gain: float, tried: int, runner: CallRunner) -> Choice:
    """Choose the best trial, without process noise if possible, and its ties as rivals.

    Trials that tie only with process noise are rivals, too. A trial that makes parameters impossible gives way to one
    that does not.
    """
    dispersion, forced = trials[0][1].dispersion, {s.candidate.name: stage for s, stage in trials if not stage.exact}
    close = _tied_trials(trials, gain)
    exact, unknown = _trials_without_noise(close, runner)
    lowest = trials[0][1].fit.cost
    if forced and exact and not exact[0][1].is_close:
        # Forces hid that it doesn't explain the logs. One that explained a little less under them may do.
        left = [x for x in trials if x[0].candidate.name not in {s.candidate.name for s, _ in close}]
        others, _ = _trials_without_noise(
            [x for x in left if x[1].fit.cost - lowest <= (1 - VARIANT_SCORE_SHARE) * gain], runner
        )
        exact = sorted([*exact, *others], key=lambda x: x[1].fit.cost)
    judged = [*_tied_trials(exact, gain, SHAPE[0] if forced else SHAPE[1]), *unknown] if exact else close
    if judged[0][1].is_dead_end:
        judged = [x for x in judged if x[1].exact and x[1].is_close and not x[1].impossible] or judged
    score, best = judged[0]
    rivals = tuple(fitted_entry(other, s.candidate.name) for s, other in judged[1:])
    process_noise_fit = forced.get(score.candidate.name) if best.exact else None
    behind = next(x.fit.cost for s, x in trials if s.candidate.name == score.candidate.name) - lowest
    gain -= min(behind, (1 - VARIANT_SCORE_SHARE) * gain)  # what is close may be further behind where much is left
    return Choice(
        score.candidate.name, best, gain, dispersion, tried, rivals, score.unabsorbed_share, process_noise_fit
    )


def choose_with_inflated_noise(stage: ExtendedFit, runner: CallRunner) -> tuple[ExtendedFit, list[Choice]] | None:
    """Choose the first effect with inflated sensor noise, if the model tracks the logs only then.

    Inflated noise leaves the misfit that shows the cause, and nearly right models track the logs. The effect must let
    the model track the logs with the true noise; a pair is tried if none does. Return the fit without the effect, and
    the
    choices: none if the model needs no effect after all. Return None if nothing tracks the logs.
    """
    begun_without = resume_with_true_sensor_noise([stage], 0.0, runner)
    scores, least = score_effects(stage, runner), MIN_EXCESS_SHARE[1] * stage.excess_cost
    plain = next(begun_without)
    if plain is not None and plain.is_close:
        return plain, []
    shortlist = _refined_shortlist(stage, scores, (), runner)
    trials, _ = _fit_candidates(
        stage, shortlist, runner, lambda k: None, stage.fit.cost - CANDIDATE_PROGRESS_SHARE * least
    )
    if not trials:
        return None
    _, best = trials[0]
    gain = stage.fit.cost - best.fit.cost
    if gain < max(MIN_LIKELIHOOD_RATIO * best.dispersion, least):
        return None
    alike = [x for x in trials if stage.fit.cost - x[1].fit.cost >= VARIANT_SCORE_SHARE * gain]
    follow: list[_Trial] = []
    for process_noise in (
        (0.0, identification.PROCESS_NOISE_LEVELS[0])
        if gain >= MIN_SHARE_FOR_PROCESS_NOISE * (gain + best.excess_cost)
        else (0.0,)
    ):
        sharp = zip(alike, resume_with_true_sensor_noise([x for _, x in alike], process_noise, runner), strict=True)
        found = [(score, x) for (score, _), x in sharp if x is not None and x.tracks_logs]
        found = [(score, x) for score, x in found if not _fell_to_zero(score.candidate.name, x)]
        follow = follow or found
        if near := _best_variants([x for x in found if x[1].is_close]):
            follow = near
            break
    if not follow:
        both = _choose_pair(stage, trials[0], len(scores), runner)
        return (stage, both) if both else None
    follow = _best_variants(follow)
    score, best = follow[0]
    sure = _ratio_with_true_noise(score.candidate.name, best, gain, stage, plain)
    if sure < MIN_LIKELIHOOD_RATIO * best.dispersion:
        return None
    return stage, [_make_choice(follow, sure, len(scores), runner)]


def _ratio_with_true_noise(
    name: str, best: ExtendedFit, gain: float, coarse: ExtendedFit, plain: ExtendedFit | None
) -> float:
    """Estimate the likelihood ratio with the true sensor noise, from the one with inflated noise.

    Wald's statistic bounds it, but is too large far from zero. The inflated fit says too little: without the effect,
    the cost would be that of the plain fit, or if there is none, larger by the inflation, as far as a fit is not given
    up.
    """
    times = coarse.data.noise_inflation
    without = (
        min(times**2 * gain, LOST_COST_RATIO * best.expected_cost - best.fit.cost)
        if plain is None
        else plain.fit.cost - best.fit.cost
    )
    return min(wald_statistic(name, best), max(times * gain, without))


def _choose_pair(stage: ExtendedFit, first: _Trial, tried: int, runner: CallRunner) -> list[Choice]:
    """Choose two effects that together let exact dynamics come close to the logs; empty if there are none.

    The first is the best with inflated noise, and must explain a good part of the excess.
    """
    score, beside = first
    if stage.fit.cost - beside.fit.cost < MIN_EXCESS_SHARE_OF_FIRST * stage.excess_cost:
        return []
    scores, most = score_effects(beside, runner), TRACKING_COST_RATIO * beside.expected_cost
    shortlist = _refined_shortlist(beside, scores, (), runner)
    if not shortlist:
        return []
    trials, _ = _fit_candidates(beside, shortlist, runner, lambda k: None, most)
    trials = [x for x in trials if x[1].fit.cost <= most]
    every = zip(trials, resume_with_true_sensor_noise([x for _, x in trials], 0.0, runner), strict=True)
    found = [(s, coarse, x) for (s, coarse), x in every if x is not None and x.is_close]
    found = [x for x in found if not any(_fell_to_zero(e.candidate.name, x[2]) for e in (score, x[0]))]
    if not found:
        return []
    second, coarse, best = min(found, key=lambda x: x[2].fit.cost)
    sure = (
        _ratio_with_true_noise(score.candidate.name, best, stage.fit.cost - beside.fit.cost, stage, None),
        _ratio_with_true_noise(second.candidate.name, best, beside.fit.cost - coarse.fit.cost, stage, None),
    )
    if min(sure) < MIN_LIKELIHOOD_RATIO * best.dispersion:
        return []
    return [
        Choice(score.candidate.name, beside, sure[0], best.dispersion, tried, (), score.unabsorbed_share),
        _make_choice(_best_variants([(s, x) for s, _, x in found]), sure[1], len(scores), runner),
    ]


def choose_from_start(stage: ExtendedFit, runner: CallRunner) -> tuple[ExtendedFit, list[Choice], frozenset[str]]:
    """Choose the first effect by fits from initial trajectories, if no model without effects was found.

    With the effect there may be a fit without it after all, since the start was too far off; it is then compared with
    that. Return the fit without the effect, the choices, and if there are none, the names that were tried.
    """
    scores = score_effects(stage, runner)
    shortlist = _refined_shortlist(stage, scores, (), runner)
    noise_levels = 0.0, identification.PROCESS_NOISE_LEVELS[0], identification.PROCESS_NOISE_LEVELS[-1]
    found = _choose_screened(stage, shortlist, noise_levels, len(scores), runner)
    return (*found, frozenset()) if found else (stage, [], frozenset(s.candidate.name for s in shortlist))


def choose_unlikely(
    scanned: ExtendedFit, stage: ExtendedFit, tried: Container[str], runner: CallRunner
) -> tuple[ExtendedFit, list[Choice]]:
    """Choose an effect by fits with exact dynamics from initial trajectories, whatever its score, if nothing explains
    the logs.

    Far from any fit the scores say little, and exact dynamics track the logs with the right effect only. scanned: the
    fit that gives the scores. tried: names that were tried already. Return the fit without the effect, and the choices.
    """
    scores = score_effects(scanned, runner)
    best = {s.candidate.name: s for s in reversed(scores) if s.likelihood_ratio > 0 and s.values["A"] != 0}
    most = sorted(best.values(), key=lambda s: -s.likelihood_ratio)[:MAX_RESTARTS]
    most = [s for s in most if s.candidate.name not in tried]
    return _choose_screened(stage, most, (0.0,), len(scores), runner) or (stage, [])


def _choose_screened(
    stage: ExtendedFit,
    shortlist: Sequence[score_test.Score],
    noise_levels: Sequence[float],
    tried: int,
    runner: CallRunner,
) -> tuple[ExtendedFit, list[Choice]] | None:
    """Choose an effect by fits from initial trajectories, with the first level of process noise that gives one.

    If exact dynamics were fitted without an effect, it must explain MIN_EXCESS_SHARE_OF_FIRST.
    """
    machines = [effects.with_effects(stage.machine, _start_entry(s)) for s in shortlist]
    worth = (
        stage.fit.cost - MIN_EXCESS_SHARE_OF_FIRST * stage.excess_cost if stage.estimated and stage.exact else np.inf
    )
    for process_noise in noise_levels if shortlist else ():
        few = process_noise > identification.PROCESS_NOISE_LEVELS[0]
        names = _unique_names(shortlist)[: FIRST_BATCH if few else None]
        begin = [(s, m) for s, m in zip(shortlist, machines, strict=True) if s.candidate.name in names]
        enough = partial(_is_close_and_effective, [s.candidate.name for s, _ in begin])
        found = fit_screened([m for _, m in begin], stage, process_noise, runner, worth, enough)
        follow = [(s, x) for (s, _), x in zip(begin, found, strict=True) if x is not None and x.tracks_logs]
        follow = [(s, x) for s, x in follow if _is_effective(s.candidate.name, x)]
        if not follow:
            continue
        trials = _best_variants([x for x in follow if x[1].is_close] or follow)
        score, best = trials[0]
        comparable = stage.estimated and stage.fit.process_noise == best.fit.process_noise
        without, best = refit_and_drop_noise(stage.machine, best, runner)
        trials = [(score, best), *(x for x in trials[1:] if x[1].fit.process_noise == best.fit.process_noise)]
        if without is not None:
            stage = stage if comparable and stage.fit.cost < without.fit.cost else without
        # Wald's statistic is of the same kind, and smaller where much is gained.
        alike = without is not None or comparable
        gain = stage.fit.cost - best.fit.cost if alike else wald_statistic(score.candidate.name, best)
        if gain < MIN_LIKELIHOOD_RATIO * best.dispersion:
            return exact_if_close(stage), []
        return stage, [_make_choice(trials, gain, tried, runner)]
    return None


def _is_close_and_effective(names: Sequence[str], k: int, stage: ExtendedFit) -> bool:
    """Tell if the fit of effect k is close and exact: beside it only close fits count."""
    return stage.is_close and stage.exact and _is_effective(names[k], stage)


def _required_gain(
    stage: ExtendedFit,
    chosen: Sequence[Choice],
    candidate: score_test.Candidate,
    hidden: float = MIN_GAIN_SHARE_WITH_NOISE,
) -> float:
    """Return the likelihood ratio that makes an effect worth a place beside those chosen.

    share_with_noise: share of their gains that is required if process noise hides errors of their formulas.
    """
    part = max(SHAPE[0], MIN_GAIN_SHARE_TIMED * candidate.placed.effect.timed, hidden * (not stage.exact))
    mapped = {e.name for e in stage.model.effects if e.uses_map}
    own = (
        max(
            min(FORMULA_MAGNITUDE_ERROR**2 / x.unabsorbed_share, MAX_ABSORBED_FORMULA_SHARE),
            MIN_GAIN_SHARE_MAPPED * (x.name in mapped),
        )
        for x in chosen
    )
    shape = sum(max(part, share) * x.likelihood_ratio for share, x in zip(own, chosen, strict=True))
    main = not stage.is_close if chosen else _noise_hides_misfit(stage)
    explained = MIN_EXCESS_SHARE_OF_FIRST if main else MIN_EXCESS_SHARE[stage.first_order_is_rough]
    return max(explained * stage.excess_cost, shape, min(SHAPE[1] * _total_wald_statistic(stage), MAX_FORMULA_RATIO))


def _noise_hides_misfit(stage: ExtendedFit) -> bool:
    """Tell if large process noise leaves a misfit: with it many wrong models come far."""
    return stage.fit.process_noise >= identification.PROCESS_NOISE_LEVELS[0] and not stage.is_close


def _explains_rest(found: ExtendedFit, before: ExtendedFit) -> bool:
    """Tell if exact dynamics leave nothing with an effect and much without: no error of another formula is removed
    entirely.
    """
    return _has_large_excess(before) and found.exact and found.excess_cost == 0


def _has_large_excess(stage: ExtendedFit) -> bool:
    """Tell if exact dynamics leave a large misfit."""
    return stage.exact and stage.excess_cost > LARGE_EXCESS_RATIO * stage.expected_cost


def _fit_candidates(
    stage: ExtendedFit,
    shortlist: Sequence[score_test.Score],
    runner: CallRunner,
    report: Callable[[int], None],
    ceiling: float = np.inf,
) -> tuple[list[_Trial], set[str]]:
    """Fit candidates with the model's process noise, and return the best variant of each name and the implausible
    names.

    The likeliest FIRST_BATCH are fitted first, the others as long as they do not stay far behind. Those with much lower
    scores come last, and only if they may still come near. A magnitude that falls to zero counts as no fit.
    cost_limit: cost above which every fit is given up.
    """
    trials, refused = list[_Trial](), set[str]()
    near = max(
        FIRST_BATCH, sum(MAX_RATIO_OVER_SCORE * s.likelihood_ratio >= shortlist[0].likelihood_ratio for s in shortlist)
    )
    for at, batch in (
        (0, shortlist[:FIRST_BATCH]),
        (FIRST_BATCH, shortlist[FIRST_BATCH:near]),
        (near, shortlist[near:]),
    ):
        gained = max((stage.fit.cost - found.fit.cost for _, found in trials), default=0.0)
        if not batch or (at >= near and gained > MAX_RATIO_OVER_SCORE * batch[0].likelihood_ratio):
            continue
        wishes = [(effects.with_effects(stage.machine, _start_entry(s)), stage, stage.fit.process_noise) for s in batch]
        report(at)
        most = min(ceiling, stage.fit.cost - CANDIDATE_PROGRESS_SHARE * gained if trials else np.inf)
        for k, (score, found) in enumerate(zip(batch, refit_all(wishes, runner, most), strict=True)):
            report(min(at + k + 1, len(shortlist) - 1))
            if found is None or _fell_to_zero(score.candidate.name, found):
                continue
            if _is_plausible(score.candidate.name, found):
                trials.append((score, found))
            else:
                refused.add(score.candidate.name)
        others = shortlist[at + len(batch) :]
        if (
            stage.exact
            and _likeliest_not_found(shortlist, trials, refused)
            and shortlist[0].candidate.name not in _unique_names(others)
        ):
            break
    return _best_variants(trials), refused


def _unique_names(scores: Sequence[score_test.Score]) -> list[str]:
    """Return the names of candidates, each once."""
    return list(dict.fromkeys(s.candidate.name for s in scores))


def _likeliest_not_found(
    shortlist: Sequence[score_test.Score], trials: Sequence[_Trial], refused: Container[str]
) -> bool:
    """Tell if no fit of the likeliest candidate was found."""
    name = shortlist[0].candidate.name
    return name not in refused and all(s.candidate.name != name for s, _ in trials)


def _is_plausible(name: str, stage: ExtendedFit) -> bool:
    """Tell if an effect's fitted shapes are possible, and if it shakes a torque sensor, that one log shows it or none
    can.
    """
    placed = stage.placed(name)
    fitted = replace(placed, values={**placed.values, **_fitted_values(stage, placed)})
    if not effects.shapes_possible(stage.machine, fitted):
        return False
    if fitted.effect.shaking is None:
        return True
    of = (s for s in stage.machine.sensors("full") if s.kind == "torque" and s.body == fitted.bodies[0])
    sensor, rate = next(of, None), float(stage.machine.sampling_hz)
    if sensor is None:
        return True
    told = [is_shaking(x.values[sensor.name], fitted.shaking(x.t), rate) for x in stage.data.logs]
    return any(told) or all(x is None for x in told)


def _fell_to_zero(name: str, stage: ExtendedFit) -> bool:
    """Tell if a fit led an effect that must be positive to zero."""
    effect, fit, k = stage.placed(name).effect, stage.fit, stage.model.base.names.index(name)
    return (
        effect.positive
        and not effect.inverse
        and not fit.unidentifiable[k]
        and bool(fit.X[k] < MIN_MAGNITUDE_STDS * fit.std[k])
    )


def _is_effective(name: str, stage: ExtendedFit) -> bool:
    """Tell if an effect in a fit is present and plausible."""
    return not _fell_to_zero(name, stage) and _is_plausible(name, stage)


def _best_variants(trials: Sequence[_Trial]) -> list[_Trial]:
    """Return the best variant of each name, best first: least process noise, then least cost."""
    best: dict[str, _Trial] = {}
    for x in sorted(trials, key=lambda x: (x[1].fit.process_noise, x[1].fit.cost)):
        best.setdefault(x[0].candidate.name, x)
    return list(best.values())


def _tied_trials(trials: Sequence[_Trial], gain: float, share: float | None = None) -> list[_Trial]:
    """Return the best of sorted trials, and those that explain the logs about as well.

    Differences that errors of the best effect's formula may cause do not count. share: share of the gain that such
    errors take.
    """
    score, best = trials[0]
    share = share or (SHAPE[1] if best.exact else TIE_GAIN_SHARE_WITH_NOISE)
    near = max(TIE_LIKELIHOOD_RATIO * best.dispersion, TIE_EXCESS_SHARE * best.excess_cost, share * gain)
    if best.exact and not score.candidate.placed.effect.inverse:
        # What forces let it gain is less than what it gains without them.
        near = max(near, min(SHAPE[1] * wald_statistic(score.candidate.name, best), MAX_FORMULA_RATIO))
    return [x for x in trials if x[1].fit.cost - best.fit.cost < near]


def _trials_without_noise(trials: Sequence[_Trial], runner: CallRunner) -> tuple[list[_Trial], list[_Trial]]:
    """Refit trials without process noise: those with an exact fit, best first, and those without one.

    Trials that are far from the logs with process noise are neither.
    """
    good = [x for x in trials if x[1].exact or x[1].is_close]
    without = drop_process_noise([s for _, s in good if not s.exact], runner)
    found = [(x, x[1] if x[1].exact else next(without)) for x in good]
    found = [(x, None if s is None or _fell_to_zero(x[0].candidate.name, s) else s) for x, s in found]
    exact = [(score, stage) for (score, _), stage in found if stage is not None]
    return sorted(exact, key=lambda x: x[1].fit.cost), [x for x, stage in found if stage is None]
