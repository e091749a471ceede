"""Choose one further effect for a model, with the rivals that explain the logs about as well.

Candidates are scored to first order, the likeliest are fitted, and the best fit is chosen. If no model tracks the logs,
the first effect, or a pair, is chosen with inflated sensor noise (`choose_with_inflated_noise`) or by fits from initial
trajectories (`choose_from_start`).

Likelihood ratio means 2 delta log L, the decrease of the deviance.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite.diagnosis import score_test
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.fits import (
    IMPOSSIBLE_SIGN_STDS,
    LOST_COST_RATIO,
    MIN_PROCESS_NOISE,
    TRACKING_COST_RATIO,
    ExtendedFit,
    RefitRequest,
    drop_process_noise,
    fit_all_from_start,
    refit,
    refit_all,
    resume_with_true_sensor_noise,
)
from excite.diagnosis.parallel import CallRunner
from excite.diagnosis.residual_tests import is_shaking
from excite.logs import Log
from excite.model import effects
from excite.model.effects import Effect, PlacedEffect
from excite.model.machine import EffectEntry, Machine, Quantity
from excite.smoothing import PROCESS_NOISE_LEVELS, NotConvergedError

# Significance. Logs without any effect stay below a likelihood ratio of 16. By chi-squared and Bonferroni, at most
# 2.1 % of logs of a minute exceed the required ratio (371 candidates of va12 with all shapes), 2.7 % of longer (441).
MIN_LIKELIHOOD_RATIO = 22.0  # calibrated on logs without effects
MAX_P_VALUE = 0.05  # of an effect, which for many shapes requires more than MIN_LIKELIHOOD_RATIO; chosen

# Candidates that are fitted. Pairs of numbers hold for exact dynamics close to the logs, and otherwise.
MIN_SCORE = 15.0  # first-order likelihood ratio; chosen
MIN_SCORE_SHARE = 0.4, 0.15  # share of the best score; chosen
MAX_CANDIDATES = 5  # number of candidates, beside further variants of the likeliest names; chosen
VARIANT_SCORE_SHARE = 0.7  # share of the best score of its name at which a variant is fitted, too; chosen
PLAIN_VARIANT_SCORE_SHARE = 0.5  # the same for the variant without signed shapes, which others may mimic; chosen
RESTART_SCORE_SHARE = 0.9  # share of the best score from which a candidate without a fit is fitted anew; chosen
CANDIDATE_PROGRESS_SHARE = 0.5  # share of the required gain that is asked of the first passes of a fit; chosen
FIRST_BATCH = 2  # candidates that are fitted before others are compared with them; chosen
MAX_RATIO_OVER_SCORE = 2.5  # largest likelihood ratio of a fit over the candidate's score; chosen
REFINEMENT_REACHES = 1.0, 0.35  # shares of the way to the next trial values, refined in turn; chosen
TIME_TRIAL_SHARE = 12  # duration over the distance of refined trial instants: a grid of quarters, in thirds
INSTANT_ACCURACY_S = 0.5  # [s] to which instants are refined, as fits find them only from nearby; chosen

# Effects that are worth a place: share of the excess cost that they must explain.
MIN_EXCESS_SHARE = 0.05, 0.15  # for exact dynamics close to the logs, and otherwise; chosen
MIN_EXCESS_SHARE_OF_FIRST = 0.3  # of the first effect, or far from the logs: the largest of three; chosen
MIN_EXPLAINED_SHARE = 0.85  # of the excess misfit, for a name; right causes in results/diagnosis explain 0.85 or more
LARGE_EXCESS_RATIO = 0.01  # excess over expected cost that no error of a formula removes entirely; chosen

# Nature is never exactly the formula: what is left of an effect may be another effect's gain.
FORMULA_ERROR = 0.03  # relative difference of two formulas of one effect: 1 to 6 % in results/diagnosis
MAX_FORMULA_RATIO = 250.0  # largest likelihood ratio that the error of a formula makes; chosen
MAX_FORMULA_SHARE = 0.1  # largest share of an effect's gain that the error of its formula takes; chosen
MIN_GAIN_SHARE_WITH_NOISE = 0.25  # share to exceed where process noise hides how good the formulas are; chosen

# Ties: by how much a rival may be worse.
TIE_LIKELIHOOD_RATIO = 10.0  # likelihood ratio; chosen
TIE_EXCESS_SHARE = 0.3  # share of the excess cost that the best effect leaves; chosen
TIE_GAIN_SHARE_WITH_NOISE = 0.02  # share of the gain with process noise, which absorbs differences; chosen

TRANSITION = "friction_transition"  # has no meaning where friction near rest is free
PRESLIDING = "presliding"  # what friction near rest is if it is not free
MIN_MAGNITUDE_STDS = 0.3  # standard deviations from zero below which a positive magnitude fell to zero; chosen
MAX_SIGNATURE_STEP = 2.0  # factor on a trial magnitude up to which its signature holds; chosen
MIN_SIGNATURE_STEP = 0.3  # the same downwards; chosen
SMALLEST_VALUE = 1e-12  # magnitude or shape in a machine file below which it is zero; rounding
ProgressCallback = Callable[[float, str], None]  # called with the share done and the next step
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
    parameters = [name, *(f"{name}.{s}" for s, shape in shapes.items() if shape.signed and not shape.circular)]
    at = [k for k in (names.index(n) for n in parameters if n in names) if not fit.unidentifiable[k]]
    distance = fit.X[at] / fit.std[at]
    return float(
        distance @ np.linalg.solve(fit.covariance[np.ix_(at, at)] / np.outer(fit.std[at], fit.std[at]), distance)
    )


def degrees_of_freedom(name: str, stage: ExtendedFit) -> int:
    """Return the number of an effect's fitted parameters: magnitude and shapes."""
    return sum(n == name or n.startswith(f"{name}.") for n in stage.model.base.names)


def required_likelihood_ratio(name: str, stage: ExtendedFit, n_candidates: int) -> float:
    """Return the likelihood ratio from which an effect is significant, given the number of candidates (Bonferroni)."""
    return max(
        MIN_LIKELIHOOD_RATIO, float(scipy.stats.chi2.isf(MAX_P_VALUE / n_candidates, degrees_of_freedom(name, stage)))
    )


def _formula_ratio(wald: float) -> float:
    """Return the likelihood ratio that an error of formulas may cause, of effects with a sum of Wald's statistics."""
    return min(FORMULA_ERROR**2 * wald, MAX_FORMULA_RATIO)


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
    if stage.data.sticks:
        known_near_rest = {e.where for e in stage.model.effects if e.unsticking}
        found = [
            x
            for x in found
            if x.placed.effect.name != TRANSITION and not (x.placed.unsticking and x.placed.where in known_near_rest)
        ]
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
    magnitude = values.pop("A")
    if len(e.effect.grid) > 1:
        # The signature is not proportional to the magnitude: stay where it holds.
        step = float(np.clip(magnitude / e.values["A"], MIN_SIGNATURE_STEP, MAX_SIGNATURE_STEP))
        magnitude = e.values["A"] / step if e.effect.inverse else e.values["A"] * step
    return identified_entry(
        e.effect.name, e.where, magnitude, {n: round(v, 12) for n, v in values.items() if n in e.shapes}
    )


def _requests(stage: ExtendedFit, scores: Sequence[score_test.Score], process_noise: float) -> list[RefitRequest]:
    """Return requests to fit a model with each of several candidates."""
    machines = (effects.with_effects(stage.machine, _start_entry(s)) for s in scores)
    return [(machine, stage, process_noise) for machine in machines]


def fitted_entry(stage: ExtendedFit, name: str) -> EffectEntry:
    """Return an effect as an entry of the machine file, with magnitude and shapes of a fit."""
    placed = stage.placed(name)
    values = _fitted_values(stage, placed)
    magnitude = values.pop("A")
    if placed.effect.positive:  # a machine file must not have zero here
        magnitude = max(magnitude, 2 * SMALLEST_VALUE)
    return identified_entry(placed.effect.name, placed.where, magnitude, values)


def fitted_machine(stage: ExtendedFit) -> Machine:
    """Return the machine with magnitudes and shapes of its effects as fitted."""
    machine = stage.machine
    for e in stage.model.effects:
        machine = effects.with_effects(effects.without_effect(machine, e.name), fitted_entry(stage, e.name))
    return machine


def _fitted_values(stage: ExtendedFit, placed: PlacedEffect) -> dict[str, float]:
    """Return magnitude and shapes of an effect in a fit."""
    fitted = dict(zip(stage.model.base.names, stage.fit.X, strict=True))
    return {key: float(fitted.get(p, placed.values[key])) for p, (key, _) in placed.parameters.items()}


def identified_entry(effect: str, where: str, magnitude: float, shapes: Mapping[str, float]) -> EffectEntry:
    """Return an effect with identified magnitude and shapes as an entry of the machine file."""

    def quantity(value: float) -> Quantity:
        return Quantity(value=value if abs(value) > SMALLEST_VALUE else 0.0, source="identified")

    return EffectEntry(
        name=effect, where=where, amount=quantity(magnitude), shape={name: quantity(x) for name, x in shapes.items()}
    )


def _shortlist(
    stage: ExtendedFit, scores: Sequence[score_test.Score], chosen: Sequence[Choice]
) -> list[score_test.Score]:
    """Return the best candidate of each variant, best first, as far as it is worth a fit.

    There are MAX_CANDIDATES, and further variants of the likeliest FIRST_BATCH names.
    """
    best: dict[tuple[str, ...], score_test.Score] = {}
    best_of_name: dict[str, float] = {}
    min_score = (
        max(MIN_SCORE, MIN_SCORE_SHARE[stage.first_order_is_rough] * scores[0].likelihood_ratio) if scores else 0.0
    )
    for s in scores:
        explains_all = _has_large_excess(stage) and MAX_RATIO_OVER_SCORE * s.likelihood_ratio >= stage.excess_cost
        required = (
            _required_gain(stage, chosen, s.candidate, 0.0) / MAX_RATIO_OVER_SCORE
            if stage.estimated and not explains_all
            else 0.0
        )
        is_worth_a_fit = s.likelihood_ratio >= max(required, min_score) and s.values["A"] != 0
        share = VARIANT_SCORE_SHARE if len(s.candidate.variant) > 1 else PLAIN_VARIANT_SCORE_SHARE
        if is_worth_a_fit and s.likelihood_ratio >= share * best_of_name.setdefault(
            s.candidate.name, s.likelihood_ratio
        ):
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
        refinable = [s for s in shortlist if reach in REFINEMENT_REACHES or s.candidate.placed.effect.timed]
        nearby = score_test.refine_candidates(refinable, stage.machine, duration, reach)
        if len(nearby) > len(refinable):
            shortlist = _shortlist(
                stage,
                sorted([*shortlist, *_score_along(stage, nearby, runner)], key=lambda s: -s.likelihood_ratio),
                chosen,
            )
    return shortlist


def _reaches_in_time(duration: float) -> list[float]:
    """Return further reaches of refinement until instants are known, for a log of a duration [s]."""
    found = [REFINEMENT_REACHES[-1]]
    while found[-1] * duration / TIME_TRIAL_SHARE > INSTANT_ACCURACY_S:
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

    def report_fit(k: int) -> None:
        report(done + 0.03 * min(k, MAX_CANDIDATES), f"fitting {shortlist[k].candidate.name}")

    cost_limit = np.inf
    if _noise_hides_misfit(stage):
        cost_limit = stage.fit.cost - CANDIDATE_PROGRESS_SHARE * min(
            _required_gain(stage, chosen, s.candidate, 0.0) for s in shortlist
        )
    trials, implausible = _fit_candidates(stage, shortlist, runner, report_fit, cost_limit)
    if stage.exact and _likeliest_not_found(shortlist, trials, implausible):
        # Exact dynamics give no fit of the likeliest cause: judge all with process noise.
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
    gain = stage.deviance - best.deviance
    level = required_likelihood_ratio(score.candidate.name, best, len(scores))
    explains_all = _explains_rest(best, stage)
    if gain < max(
        level * best.dispersion, 0.0 if explains_all else _required_gain(stage, chosen, score.candidate, 0.0)
    ):
        return None
    is_weak = not explains_all and gain < _required_gain(stage, chosen, score.candidate)
    if is_weak and not best.is_close:
        return None
    choice = _make_choice(trials, gain, len(scores), runner)
    if not is_weak:
        return choice
    return replace(choice, process_noise_fit=None) if choice.stage.exact and choice.stage.is_close else None


def _make_choice(trials: Sequence[_Trial], gain: float, n_candidates: int, runner: CallRunner) -> Choice:
    """Choose the best trial, without process noise if possible, and its ties as rivals.

    Trials that tie only with process noise are rivals, too. A trial that makes parameters impossible gives way to one
    that does not, and is no rival of it.
    """
    dispersion = trials[0][1].dispersion
    with_noise = {s.candidate.name: stage for s, stage in trials if not stage.exact}
    ties, lowest = _tied_trials(trials, gain), min(x.deviance for _, x in trials)
    names = {s.candidate.name for s, _ in ties}
    # Process noise hides how well effects explain the logs: all are compared without it.
    exact, unknown = _trials_without_noise(trials if with_noise else ties, runner)
    unknown = [x for x in unknown if x[0].candidate.name in names]
    if not any(s.candidate.name in names for s, _ in exact):
        exact = []  # none of the best trials has an exact fit: compare all with process noise
    judged = [*_tied_trials(exact, gain), *unknown] if exact else ties
    judged = _without_needless_magnitudes(judged)
    if judged[0][1].is_dead_end:
        judged = [x for x in judged if x[1].exact and x[1].is_close and not x[1].impossible] or judged
    score, best = judged[0]
    tied = [x for x in judged[1:] if best.impossible or not x[1].impossible]
    rivals = tuple(fitted_entry(other, s.candidate.name) for s, other in tied)
    process_noise_fit = with_noise.get(score.candidate.name) if best.exact else None
    behind = next(x.deviance for s, x in trials if s.candidate.name == score.candidate.name) - lowest
    gain -= min(behind, (1 - VARIANT_SCORE_SHARE) * gain)  # a tie may be further behind if much is left
    return Choice(
        score.candidate.name, best, gain, dispersion, n_candidates, rivals, score.unabsorbed_share, process_noise_fit
    )


def choose_presliding(stage: ExtendedFit, runner: CallRunner, deadline: Deadline | None = None) -> list[Choice]:
    """Choose the joints whose friction near rest builds up over an angle, where it was taken for free.

    It comes before other effects: they are sought in what is left where friction near rest is known. deadline: no
    further joint is begun after it.
    """
    chosen, scores = list[Choice](), score_effects(stage, runner)
    wanted = {s.candidate.name: s for s in reversed(scores) if s.candidate.placed.effect.name == PRESLIDING}
    entries = {name: _start_entry(s) for name, s in wanted.items()}
    while entries and not (deadline is not None and deadline.is_over()):
        requests = [(effects.with_effects(stage.machine, entry), stage, 0.0) for entry in entries.values()]
        fits = zip(entries, refit_all(requests, runner), strict=True)
        found = {n: x for n, x in fits if x is not None and x.is_close and not x.impossible and _is_effective(n, x)}
        name = min(found, key=lambda name: found[name].deviance, default="")
        if not name:
            break
        best = found[name]
        gain = stage.deviance - best.deviance
        if gain < required_likelihood_ratio(name, best, len(scores)):
            break
        chosen.append(Choice(name, best, gain, best.dispersion, len(scores), (), unabsorbed_share=1.0))
        entries |= {n: entries[n].model_copy(update={"amount": fitted_entry(x, n).amount}) for n, x in found.items()}
        del entries[name]
        stage = best
    return chosen


def choose_with_inflated_noise(stage: ExtendedFit, runner: CallRunner) -> tuple[ExtendedFit, list[Choice]] | None:
    """Choose the first effect with inflated sensor noise, if the model tracks the logs only then.

    Inflated noise leaves the misfit that shows the cause, and nearly right models track the logs. The effect must let
    the model track the logs with the true noise; a pair is tried if none does. Return the fit without the effect, and
    the choices: none if the model needs no effect after all. Return None if nothing tracks the logs.
    """
    begun_without = resume_with_true_sensor_noise([stage], 0.0, runner)
    scores, required = score_effects(stage, runner), MIN_EXCESS_SHARE[1] * stage.excess_cost
    plain = next(begun_without)
    if plain is not None and plain.is_close:
        return plain, []
    shortlist = _refined_shortlist(stage, scores, (), runner)
    trials, _ = _fit_candidates(
        stage, shortlist, runner, lambda k: None, stage.fit.cost - CANDIDATE_PROGRESS_SHARE * required
    )
    if not trials:
        return None
    _, best = trials[0]
    gain = stage.deviance - best.deviance
    if gain < max(MIN_LIKELIHOOD_RATIO * best.dispersion, required):
        return None
    is_comparable = [x for x in trials if stage.deviance - x[1].deviance >= VARIANT_SCORE_SHARE * gain]
    tracking: list[_Trial] = []
    explains_most = gain >= MIN_EXPLAINED_SHARE * (gain + best.excess_cost)
    for process_noise in (0.0, PROCESS_NOISE_LEVELS[0])[: 1 + explains_most]:
        sharp = zip(
            is_comparable,
            resume_with_true_sensor_noise([x for _, x in is_comparable], process_noise, runner),
            strict=True,
        )
        found = [(score, x) for (score, _), x in sharp if x is not None and x.tracks_logs]
        found = [(score, x) for score, x in found if not _fell_to_zero(score.candidate.name, x)]
        tracking = tracking or found
        if near := _best_variants([x for x in found if x[1].is_close]):
            tracking = near
            break
    if not tracking:
        both = _choose_pair(stage, trials[0], len(scores), runner)
        return (stage, both) if both else None
    tracking = _best_variants(tracking)
    score, best = tracking[0]
    ratio = _ratio_with_true_noise(score.candidate.name, best, gain, stage, plain)
    if ratio < MIN_LIKELIHOOD_RATIO * best.dispersion:
        return None
    return stage, [_make_choice(tracking, ratio, len(scores), runner)]


def _ratio_with_true_noise(
    name: str, best: ExtendedFit, gain: float, inflated: ExtendedFit, plain: ExtendedFit | None
) -> float:
    """Estimate the likelihood ratio with the true sensor noise, from the one with inflated noise.

    Wald's statistic bounds it, but is too large far from zero. The inflated fit says too little: without the effect,
    the cost would be that of the plain fit, or if there is none, larger by the inflation, as far as a fit is not given
    up.
    """
    inflation = inflated.data.noise_inflation
    without = (
        min(inflation**2 * gain, LOST_COST_RATIO * best.expected_cost - best.fit.cost)
        if plain is None
        else plain.deviance - best.deviance
    )
    return min(wald_statistic(name, best), max(inflation * gain, without))


def _choose_pair(stage: ExtendedFit, first: _Trial, n_candidates: int, runner: CallRunner) -> list[Choice]:
    """Choose two effects that together let exact dynamics come close to the logs; empty if there are none.

    The first is the best with inflated noise, and must explain a good part of the excess.
    """
    score, first_fit = first
    if stage.deviance - first_fit.deviance < MIN_EXCESS_SHARE_OF_FIRST * stage.excess_cost:
        return []
    scores, cost_limit = score_effects(first_fit, runner), TRACKING_COST_RATIO * first_fit.expected_cost
    shortlist = _refined_shortlist(first_fit, scores, (), runner)
    if not shortlist:
        return []
    trials, _ = _fit_candidates(first_fit, shortlist, runner, lambda k: None, cost_limit)
    trials = [x for x in trials if x[1].fit.cost <= cost_limit]
    every = zip(trials, resume_with_true_sensor_noise([x for _, x in trials], 0.0, runner), strict=True)
    found = [(s, inflated, x) for (s, inflated), x in every if x is not None and x.is_close]
    found = [x for x in found if not any(_fell_to_zero(e.candidate.name, x[2]) for e in (score, x[0]))]
    if not found:
        return []
    second, inflated, best = min(found, key=lambda x: x[2].deviance)
    ratio = (
        _ratio_with_true_noise(score.candidate.name, best, stage.deviance - first_fit.deviance, stage, None),
        _ratio_with_true_noise(second.candidate.name, best, first_fit.deviance - inflated.deviance, stage, None),
    )
    if min(ratio) < MIN_LIKELIHOOD_RATIO * best.dispersion:
        return []
    return [
        Choice(score.candidate.name, first_fit, ratio[0], best.dispersion, n_candidates, (), score.unabsorbed_share),
        _make_choice(_best_variants([(s, x) for s, _, x in found]), ratio[1], len(scores), runner),
    ]


def choose_from_start(stage: ExtendedFit, runner: CallRunner) -> tuple[ExtendedFit, list[Choice]]:
    """Choose the first effect by exact fits from initial trajectories, if no model without effects was found.

    With the effect there may be a fit without it after all, since the start was too far off; it is then compared with
    that. Return the fit without the effect, and the choice, if any.
    """
    scores = score_effects(stage, runner)
    shortlist = _refined_shortlist(stage, scores, (), runner)
    found = zip(shortlist, fit_all_from_start(_requests(stage, shortlist, 0.0), runner), strict=True)
    trials = [(s, x) for s, x in found if x is not None and x.is_close and _is_effective(s.candidate.name, x)]
    if not trials:
        return stage, []
    trials = _best_variants(trials)
    score, best = trials[0]
    with suppress(NotConvergedError):
        stage = refit(stage.machine, best, 0.0)
    gain = stage.deviance - best.deviance if stage.estimated else wald_statistic(score.candidate.name, best)
    if gain < MIN_LIKELIHOOD_RATIO * best.dispersion:
        return stage, []
    return stage, [_make_choice(trials, gain, len(scores), runner)]


def _required_gain(
    stage: ExtendedFit,
    chosen: Sequence[Choice],
    candidate: score_test.Candidate,
    share_with_noise: float = MIN_GAIN_SHARE_WITH_NOISE,
) -> float:
    """Return the likelihood ratio that makes an effect worth a place beside those chosen.

    share_with_noise: share of their gains that is required if process noise hides errors of their formulas.
    """
    # An effect that acts at some time only follows the error of a formula best.
    least = max(MAX_FORMULA_SHARE * candidate.placed.effect.timed, share_with_noise * (not stage.exact))
    shares = [max(least, min(FORMULA_ERROR**2 / x.unabsorbed_share, MAX_FORMULA_SHARE)) for x in chosen]
    formulas = sum(share * x.likelihood_ratio for share, x in zip(shares, chosen, strict=True))
    rough = ((x.likelihood_ratio, effects.CATALOGUE[x.name.split("@")[0]].formula_error) for x in chosen)
    formulas = max(formulas, sum(min(error**2 * ratio, MAX_FORMULA_RATIO) for ratio, error in rough))
    main = not stage.is_close if chosen else _noise_hides_misfit(stage)
    explained = MIN_EXCESS_SHARE_OF_FIRST if main else MIN_EXCESS_SHARE[stage.first_order_is_rough]
    wald = sum(wald_statistic(e.name, stage) for e in stage.model.effects if not e.effect.inverse)
    return max(explained * stage.excess_cost, formulas, _formula_ratio(wald))


def _noise_hides_misfit(stage: ExtendedFit) -> bool:
    """Tell if large process noise leaves a misfit: with it many wrong models come far."""
    return stage.fit.process_noise >= PROCESS_NOISE_LEVELS[0] and not stage.is_close


def _explains_rest(found: ExtendedFit, before: ExtendedFit) -> bool:
    """Tell if exact dynamics leave nothing with an effect and much without.

    No effect removes the error of another one's formula entirely.
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
    cost_limit: float = np.inf,
) -> tuple[list[_Trial], set[str]]:
    """Fit candidates with the model's process noise.

    The likeliest FIRST_BATCH are fitted first, the others as long as they do not stay far behind. Those with much lower
    scores come last, and only if they may still come near. A magnitude that falls to zero counts as no fit.
    cost_limit: cost above which every fit is given up.

    Return the best variant of each name, and the names that were fitted but are implausible.
    """
    trials, implausible = list[_Trial](), set[str]()
    n_promising = max(
        FIRST_BATCH, sum(MAX_RATIO_OVER_SCORE * s.likelihood_ratio >= shortlist[0].likelihood_ratio for s in shortlist)
    )
    for at, batch in (
        (0, shortlist[:FIRST_BATCH]),
        (FIRST_BATCH, shortlist[FIRST_BATCH:n_promising]),
        (n_promising, shortlist[n_promising:]),
    ):
        gained = max((stage.deviance - found.deviance for _, found in trials), default=0.0)
        if not batch or (at >= n_promising and gained > MAX_RATIO_OVER_SCORE * batch[0].likelihood_ratio):
            continue
        requests = _requests(stage, batch, stage.fit.process_noise)
        report(at)
        batch_limit = cost_limit
        if trials and not stage.data.sticks:  # costs are not comparable where only some models free friction near rest
            batch_limit = min(cost_limit, stage.fit.cost - CANDIDATE_PROGRESS_SHARE * gained)
        for k, (score, found) in enumerate(zip(batch, refit_all(requests, runner, batch_limit), strict=True)):
            report(min(at + k + 1, len(shortlist) - 1))
            if found is None or _fell_to_zero(score.candidate.name, found):
                continue
            if _is_plausible(score.candidate.name, found):
                trials.append((score, found))
            else:
                implausible.add(score.candidate.name)
        others = shortlist[at + len(batch) :]
        if (
            stage.exact
            and _likeliest_not_found(shortlist, trials, implausible)
            and shortlist[0].candidate.name not in _unique_names(others)
        ):
            break
    known = {s.candidate.name for s, _ in trials} | implausible
    likely = [s for s in shortlist if s.likelihood_ratio >= RESTART_SCORE_SHARE * shortlist[0].likelihood_ratio]
    trials += _fit_anew(stage, [s for s in likely if s.candidate.name not in known], runner, cost_limit)
    return _best_variants(trials), implausible


def _fit_anew(
    stage: ExtendedFit, missing: Sequence[score_test.Score], runner: CallRunner, cost_limit: float
) -> list[_Trial]:
    """Fit the best variant of each likely candidate from initial trajectories, as none was found from the fit before.

    A cause that found no fit would lose to a rival that did.
    """
    first = list({s.candidate.name: s for s in reversed(missing)}.values())
    requests = _requests(stage, first, stage.fit.process_noise)
    found = zip(first, fit_all_from_start(requests, runner, cost_limit), strict=True)
    return [(s, x) for s, x in found if x is not None and _is_effective(s.candidate.name, x)]


def _unique_names(scores: Sequence[score_test.Score]) -> list[str]:
    """Return the names of candidates, each once."""
    return list(dict.fromkeys(s.candidate.name for s in scores))


def _likeliest_not_found(
    shortlist: Sequence[score_test.Score], trials: Sequence[_Trial], implausible: Container[str]
) -> bool:
    """Tell if no fit of the likeliest candidate was found."""
    name = shortlist[0].candidate.name
    return name not in implausible and all(s.candidate.name != name for s, _ in trials)


def _is_plausible(name: str, stage: ExtendedFit) -> bool:
    """Tell if an effect's fitted magnitude and shapes are possible.

    If it shakes a torque sensor, one of the logs must show that, or none can.
    """
    placed = stage.placed(name)
    fitted = replace(placed, values={**placed.values, **_fitted_values(stage, placed)})
    k = stage.model.base.names.index(name)
    beyond = abs(float(stage.fit.X[k])) - fitted.effect.largest
    if not effects.shapes_possible(stage.machine, fitted) or beyond > IMPOSSIBLE_SIGN_STDS * stage.fit.std[k]:
        return False
    if stage.data.sticks and placed.effect.name == PRESLIDING and _sticks(placed, fitted.values["A"], stage):
        return False
    if fitted.effect.shaking is None:
        return True
    sensors = (s for s in stage.machine.sensors("full") if s.kind == "torque" and s.body == fitted.bodies[0])
    sensor, rate = next(sensors, None), float(stage.machine.sampling_hz)
    if sensor is None:
        return True
    shaking = [is_shaking(x.values[sensor.name], fitted.shaking(x.t), rate) for x in stage.data.logs]
    return any(shaking) or all(x is None for x in shaking)


def _sticks(placed: PlacedEffect, angle: float, stage: ExtendedFit) -> bool:
    """Tell if friction builds up within a sample even at the rate over which it turns: the joint just sticks."""
    friction = next(b.friction for b in stage.machine.body if b.index == placed.bodies[0])
    assert friction is not None
    return angle < float(friction.smoothing) / float(stage.machine.sampling_hz)


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
    """Return the best variant of each name, best first: least process noise, then least information."""
    best: dict[str, _Trial] = {}
    for x in sorted(trials, key=lambda x: (x[1].fit.process_noise, _information(x))):
        best.setdefault(x[0].candidate.name, x)
    return list(best.values())


def _information(trial: _Trial) -> float:
    """Return the deviance with a price for each parameter of an effect: the information of G. Schwarz (1978)."""
    score, stage = trial
    price = np.log(stage.data.n_readings) / stage.data.noise_inflation**2
    return stage.deviance + price * degrees_of_freedom(score.candidate.name, stage)


def _tied_trials(trials: Sequence[_Trial], gain: float) -> list[_Trial]:
    """Return the best of sorted trials, and those that explain the logs about as well.

    Differences that an error of the best effect's formula may cause do not count, nor do those of chance.
    """
    score, best = trials[0]
    share = FORMULA_ERROR**2 if best.exact else TIE_GAIN_SHARE_WITH_NOISE
    margin = max(TIE_LIKELIHOOD_RATIO * best.dispersion, TIE_EXCESS_SHARE * best.excess_cost, share * gain)
    if best.exact and not score.candidate.placed.effect.inverse:  # with process noise it gains less than without
        margin = max(margin, _formula_ratio(wald_statistic(score.candidate.name, best)))
    lowest = _information(trials[0])

    def ties(trial: _Trial) -> bool:
        rough = max(x.candidate.placed.effect.formula_error for x in (score, trial[0]))
        return _information(trial) - lowest < max(margin, rough**2 * gain)

    return [x for x in trials if ties(x)]


def _without_needless_magnitudes(trials: Sequence[_Trial]) -> list[_Trial]:
    """Return trials without those that gain no more over the effect that they come to at zero than chance does.

    Friction by bristles that bend is presliding where no Stribeck friction adds to it.
    """
    deviances = {(s.candidate.name, stage.fit.process_noise): stage.deviance for s, stage in trials}
    least = MIN_LIKELIHOOD_RATIO * trials[0][1].dispersion

    def is_needless(trial: _Trial) -> bool:
        simpler, stage = trial[0].candidate.placed.simpler, trial[1]
        return (
            simpler is not None and deviances.get((simpler, stage.fit.process_noise), np.inf) - stage.deviance < least
        )

    return [x for x in trials if not is_needless(x)]


def _trials_without_noise(trials: Sequence[_Trial], runner: CallRunner) -> tuple[list[_Trial], list[_Trial]]:
    """Refit trials without process noise: those with an exact fit, best first, and those without one.

    Trials that are far from the logs with process noise are neither.
    """
    good = [x for x in trials if x[1].exact or x[1].is_close]
    without = drop_process_noise([s for _, s in good if not s.exact], runner)
    found = [(x, x[1] if x[1].exact else next(without)) for x in good]
    requests = [(stage.machine, stage, 0.0) for (_, stage), exact in found if exact is None]
    anew = fit_all_from_start(requests, runner)
    found = [(x, next(anew) if exact is None else exact) for x, exact in found]
    found = [(x, None if s is None or _fell_to_zero(x[0].candidate.name, s) else s) for x, s in found]
    exact = [(score, stage) for (score, _), stage in found if stage is not None]
    return sorted(exact, key=_information), [x for x, stage in found if stage is None]
