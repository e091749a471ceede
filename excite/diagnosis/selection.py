"""Find the effects that explain logs: forward by evidence, then backward and by exchange with refits.

Candidates compete beside unknown forces (`evidence`). Those chosen become part of the model, which is fitted again, and
so on until none gains. Then each effect is removed in turn, and exchanged for its likeliest rivals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite.diagnosis import evidence, score_test
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.evidence import Chosen
from excite.diagnosis.fits import IMPOSSIBLE_SIGN_STDS, ExtendedFit, refit, refit_all
from excite.diagnosis.parallel import CallRunner
from excite.diagnosis.residual_tests import is_shaking
from excite.diagnosis.score_test import Candidate
from excite.model import effects
from excite.model.effects import Effect, PlacedEffect
from excite.model.machine import EffectEntry, Machine, Quantity
from excite.smoothing import NotConvergedError

# Significance. Logs without any effect stay below a likelihood ratio of 16. By chi-squared and Bonferroni, at most
# 2.1 % of logs of a minute exceed the required ratio (371 candidates of va12 with all shapes), 2.7 % of longer (441).
MIN_LIKELIHOOD_RATIO = 22.0  # calibrated on logs without effects
MAX_P_VALUE = 0.05  # of an effect, which for many shapes requires more than MIN_LIKELIHOOD_RATIO; chosen
MAX_EFFECTS = 8  # number of effects beside presliding; chosen
MAX_TURNS = 8  # of choosing and fitting again; chosen
FORMULA_ERROR = 0.03  # relative difference of two formulas of one effect: 1 to 6 % in results/diagnosis
MAX_FORMULA_RATIO = 250.0  # largest likelihood ratio that the error of a formula makes; chosen
# What another effect in the place of one may lose of its gain to first order, to be fitted there, the larger of both.
RIVAL_LOSS = 20.0  # twice a logarithm of odds; chosen
RIVAL_LOSS_SHARE = 0.05  # of the gain; chosen
MAX_RIVALS = 3  # that are fitted in the place of an effect; chosen
REFINEMENT_REACHES = 1.0, 0.35  # shares of the way to the next trial values, refined in turn; chosen
TIME_TRIAL_SHARE = 12  # duration over the distance of refined trial instants: a grid of quarters, in thirds
INSTANT_ACCURACY_S = 0.5  # [s] to which instants are refined, as fits find them only from nearby; chosen
TRANSITION = "friction_transition"  # has no meaning where friction near rest is free
PRESLIDING = "presliding"  # what friction near rest is if it is not free
MIN_MAGNITUDE_STDS = 0.3  # standard deviations from zero below which a positive magnitude fell to zero; chosen
MAX_SIGNATURE_STEP = 2.0  # factor on a trial magnitude up to which its signature holds; chosen
MIN_SIGNATURE_STEP = 0.3  # the same downwards; chosen
SMALLEST_VALUE = 1e-12  # magnitude or shape in a machine file below which it is zero; rounding
ProgressCallback = Callable[[float, str], None]  # called with the share done and the next step


@dataclass(frozen=True)
class Choice:
    """An effect of the final model.

    likelihood_ratio: over the model without it. without: that model, fitted; None if no exact dynamics follow the logs
    then, and Wald's statistic is the ratio. rivals: that explain the logs about as well in its place.
    """

    name: str
    likelihood_ratio: float
    without: ExtendedFit | None
    rivals: tuple[EffectEntry, ...] = ()


@dataclass(frozen=True)
class Search:
    """End of a search: the model with its effects, their choices, and the gain of unknown forces beside them.

    n_candidates: number that were tried. dropped: names that were chosen and given up again, with the reason.
    """

    stage: ExtendedFit
    choices: tuple[Choice, ...]
    left: float
    n_candidates: int
    dropped: Mapping[str, str]


def search(before: ExtendedFit, runner: CallRunner, report: ProgressCallback, deadline: Deadline) -> Search:
    """Add effects to a model until none gains, and drop those that the others replace."""
    stage, dropped, found = before, dict[str, str](), Chosen((), (), (), 0.0, ())
    if before.data.sticks:
        report(0.1, "fitting friction near rest")
        stage = _with_presliding(before, runner)
    n_candidates, every, without, idle = 1, None, dict[str, ExtendedFit | None](), set[str]()
    for turn in range(MAX_TURNS):
        report(0.1 + 0.1 * turn, "scoring effects")
        every = stage.form(_every_candidate(stage), runner)
        further = candidates_of(stage, every.candidates)
        form = replace(every, candidates=tuple(x for x in further if x.name not in dropped))
        n_candidates = max(n_candidates, len({x.name for x in form.candidates}))
        found = evidence.choose(form, {e.name for e in stage.model.effects})
        n = MAX_EFFECTS - len(added(before, stage))
        chosen = replace(found, candidates=found.candidates[:n], factors=found.factors[:n], gains=found.gains[:n])
        if deadline.is_over():
            break
        if chosen.candidates:
            report(0.15 + 0.1 * turn, "fitting effects")
            better = _extended(before, stage, form, chosen, idle, dropped, runner)
        elif not stage.exact:
            better = _followed_exactly(stage, form, runner)
        else:
            report(0.2 + 0.1 * turn, "testing each effect given the others")
            stage.release()
            without = _fits_without(before, stage, runner)
            better = _without_needless(stage, without, dropped)
        stage.release()
        if better is None:
            break
        stage, without, every = better, {}, None
    report(0.85, "comparing rivals")
    stage, choices = _judged(before, stage, without, every, runner, deadline)
    return Search(stage, choices, found.left, n_candidates, dropped)


def _extended(
    before: ExtendedFit,
    stage: ExtendedFit,
    form: evidence.Form,
    chosen: Chosen,
    idle: set[str],
    dropped: dict[str, str],
    runner: CallRunner,
) -> ExtendedFit | None:
    """Return the fit with chosen effects, as far as it needs them; None if there is none."""
    others = _alternatives(form, chosen)
    machine = effects.with_effects(stage.machine, *entries(refined(stage, chosen, runner)))
    stage.release()
    try:
        return _without_idle(before, _with_best_shapes(refit(machine, stage), others, runner), idle, dropped)
    except NotConvergedError:
        return None


def _followed_exactly(stage: ExtendedFit, form: evidence.Form, runner: CallRunner) -> ExtendedFit | None:
    """Return the best exact fit with one of the likeliest effects, where unknown forces hide which one it is.

    None if exact dynamics follow the logs with none of them.
    """
    likely = evidence.likeliest(form, {e.name for e in stage.model.effects}, MAX_RIVALS)
    machines = [effects.with_effects(stage.machine, *entries(x)) for x in likely]
    names = [x.candidates[0].name for x in likely]
    found = [
        x
        for name, x in zip(names, refit_all(machines, stage, runner), strict=True)
        if x is not None and not _is_idle(name, x) and is_plausible(name, x) and not x.impossible
    ]
    return min(found, key=lambda x: x.deviance, default=None)


def give_up(
    before: ExtendedFit, stage: ExtendedFit, reasons: Mapping[str, str], runner: CallRunner, deadline: Deadline
) -> Search:
    """Return where a search ends without some effects, given up for a reason each."""
    try:
        stage = refit(_without(stage, list(reasons)), stage)
    except NotConvergedError:
        stage = before
    every = stage.form(_every_candidate(stage), runner)
    left = evidence.posterior(every.reduced(), ()).gain
    n_candidates = len({x.name for x in candidates_of(stage, every.candidates)})
    stage, choices = _judged(before, stage, _fits_without(before, stage, runner), every, runner, deadline)
    return Search(stage, choices, left, n_candidates, dict(reasons))


def _alternatives(form: evidence.Form, found: Chosen) -> list[EffectEntry]:
    """Return chosen effects with other trial shapes that to first order gain about as much."""
    form, alternatives = form.reduced(), list[EffectEntry]()
    logs = np.log(np.array(found.sizes))
    for k, x in enumerate(found.candidates):
        rest = [*found.candidates[:k], *found.candidates[k + 1 :]]
        gains = evidence.first_gains(form, rest, logs)
        own = [(float(gain), y) for gain, y in zip(gains, form.candidates, strict=True) if y.name == x.name]
        if x.placed.effect.opposes_motion:  # a fit would stay at the impossible sign
            own = [(gain, y) for gain, y in own if evidence.factor_of(form, y, logs, rest)[0] > 0]
        best = max((gain for gain, _ in own), default=0.0)
        near = [y for gain, y in own if gain > best - RIVAL_LOSS and y is not x]
        alternatives += [_start_entry(y, evidence.factor_of(form, y, logs, rest)) for y in near]
    return alternatives


def _with_best_shapes(stage: ExtendedFit, others: Sequence[EffectEntry], runner: CallRunner) -> ExtendedFit:
    """Return the best fit with each effect in turn at other values of the shapes that a fit does not find."""
    tried: dict[tuple[str, ...], Machine] = {}
    for entry in others if stage.exact else ():
        name = entry.label
        if name not in {e.name for e in stage.model.effects}:
            continue
        placed = stage.placed(name)
        fixed = [n for n in placed.shapes if f"{name}.{n}" not in stage.model.base.names]
        values = {n: float(entry.shape[n].value) for n in fixed if n in entry.shape}
        if any(abs(x - placed.values[n]) > 1e-9 for n, x in values.items()):
            key = (name, *(f"{n}={x:g}" for n, x in values.items()))
            tried.setdefault(key, effects.with_effects(_without(stage, [name]), entry))
    found = [x for x in refit_all(list(tried.values())[:MAX_RIVALS], stage, runner) if x is not None]
    return min([stage, *found], key=lambda x: x.deviance)


def candidates_of(stage: ExtendedFit, every: Sequence[Candidate] | None = None) -> list[Candidate]:
    """List every effect that a model lacks, with trial values; and further harmonics of those that it has."""
    known = {e.name for e in stage.model.effects}
    found = [x for x in every or _every_candidate(stage) if x.name not in known or _has_harmonics(x.placed.effect)]
    if not stage.data.sticks:
        return found
    known_near_rest = {e.where for e in stage.model.effects if e.unsticking}
    return [
        x
        for x in found
        if x.placed.effect.name != TRANSITION and not (x.placed.unsticking and x.placed.where in known_near_rest)
    ]


def _every_candidate(stage: ExtendedFit) -> list[Candidate]:
    """List every effect with trial values, the same for every stage of a search."""
    sensors = [s.name for s in stage.data.space.sensors]
    return score_test.candidates(stage.machine, sensors, stage.duration)


def _has_harmonics(effect: Effect) -> bool:
    shapes = effect.shapes.values()
    return any(s.circular for s in shapes) and any(s.whole and len(s.grid) > 1 for s in shapes)


@dataclass(frozen=True)
class Scored:
    """A machine with the duration [s] of its longest log, and a function that returns the form of some candidates."""

    machine: Machine
    duration: float
    form: Callable[[Sequence[Candidate], CallRunner], evidence.Form]


def refined(stage: ExtendedFit | Scored, found: Chosen, runner: CallRunner) -> Chosen:
    """Refine magnitudes, shapes and instants of chosen candidates between their trial values."""
    duration = stage.duration
    reaches, timed = [*REFINEMENT_REACHES], list[float]()
    while [*reaches, *timed][-1] * duration / TIME_TRIAL_SHARE > INSTANT_ACCURACY_S:
        timed.append([*reaches, *timed][-1] * REFINEMENT_REACHES[-1])
    for reach in (*reaches, *timed):
        lists = []
        for x in found.candidates:
            wanted = reach in reaches or x.placed.effect.timed
            nearby = score_test.refine_candidates([x], stage.machine, duration, reach) if wanted else []
            lists.append([x, *nearby])
        if all(len(own) <= 2 for own in lists):
            continue
        found = _best_nearby(stage, lists, runner)
    return found


def _best_nearby(stage: ExtendedFit | Scored, lists: Sequence[Sequence[Candidate]], runner: CallRunner) -> Chosen:
    """Return the best of each list of candidates, the first of each to begin with, beside those of the others."""
    form = stage.form([x for own in lists for x in own], runner).reduced()
    every, at = list(form.candidates), 0
    places = []
    for own in lists:
        places.append(range(at, at + len(own)))
        at += len(own)
    chosen = [every[place[0]] for place in places]
    now = evidence.posterior(form, chosen)
    for k, place in enumerate(places):
        others = [x for j, x in enumerate(chosen) if j != k]
        gains = evidence.first_gains(form, others, now.logs)
        best = max(place, key=lambda j: float(gains[j]))
        if gains[best] > -np.inf:
            chosen[k] = every[best]
    now = evidence.posterior(form, chosen, now.logs, evidence.COMPARING_PASSES)
    return Chosen(tuple(chosen), tuple(now.factors(form, chosen)), (), now.gain, tuple(np.exp(now.logs)))


def entries(found: Chosen) -> list[EffectEntry]:
    """Return chosen candidates as entries of the machine file, from which a fit starts."""
    return [_start_entry(x, factor) for x, factor in zip(found.candidates, found.factors, strict=True)]


def _start_entry(x: Candidate, factor: np.ndarray) -> EffectEntry:
    e, values = x.placed, dict(x.placed.values)
    magnitude = values.pop("A")
    if len(factor) == 2:
        circular = next(n for n, s in e.effect.shapes.items() if s.circular)
        values[circular] = float(np.arctan2(factor[1], factor[0]))
        step = float(np.hypot(*factor))
    else:
        step = float(factor[0])
    if len(e.effect.grid) > 1:
        # The signature is not proportional to the magnitude: stay where it holds.
        step = float(np.clip(step, MIN_SIGNATURE_STEP, MAX_SIGNATURE_STEP))
        magnitude = magnitude / step if e.effect.inverse else magnitude * step
    else:
        magnitude = float(np.clip(magnitude * step, -e.effect.largest, e.effect.largest))
    shapes = {n: round(v, 12) for n, v in values.items() if n in e.shapes}
    return identified_entry(e.effect.name, e.where, magnitude, shapes)


def fitted_entry(stage: ExtendedFit, name: str) -> EffectEntry:
    """Return an effect as an entry of the machine file, with magnitude and shapes of a fit."""
    placed = stage.fitted(name)
    values = dict(placed.values)
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


def identified_entry(effect: str, where: str, magnitude: float, shapes: Mapping[str, float]) -> EffectEntry:
    """Return an effect with identified magnitude and shapes as an entry of the machine file."""

    def quantity(value: float) -> Quantity:
        return Quantity(value=value if abs(value) > SMALLEST_VALUE else 0.0, source="identified")

    return EffectEntry(
        name=effect, where=where, amount=quantity(magnitude), shape={name: quantity(x) for name, x in shapes.items()}
    )


def added(before: ExtendedFit, stage: ExtendedFit) -> list[str]:
    """Return the names of the effects that a model has beyond another."""
    known = {e.name for e in before.model.effects}
    return [e.name for e in stage.model.effects if e.name not in known]


def degrees_of_freedom(name: str, stage: ExtendedFit) -> int:
    """Return the number of an effect's fitted parameters: magnitude and shapes."""
    return len(stage.parameters_of(name))


def required_likelihood_ratio(name: str, stage: ExtendedFit, n_candidates: int) -> float:
    """Return the likelihood ratio from which an effect is significant, given the number of candidates (Bonferroni)."""
    return max(
        MIN_LIKELIHOOD_RATIO, float(scipy.stats.chi2.isf(MAX_P_VALUE / n_candidates, degrees_of_freedom(name, stage)))
    )


def _without(stage: ExtendedFit, names: Sequence[str]) -> Machine:
    machine = fitted_machine(stage)
    for name in names:
        machine = effects.without_effect(machine, name)
    return machine


def _without_idle(before: ExtendedFit, stage: ExtendedFit, idle: set[str], dropped: dict[str, str]) -> ExtendedFit:
    """Return a fit without effects whose magnitudes are about zero or that no machine has. Raises NotConvergedError.

    One that is idle for the second time is dropped for good.
    """
    while names := [n for n in added(before, stage) if _is_idle(n, stage) or not is_plausible(n, stage)]:
        shorter = refit(_without(stage, names), stage)
        if _needed(names, stage, shorter):
            return stage
        dropped.update({n: "its size is impossible" for n in names if not is_plausible(n, stage)})
        dropped.update({n: "its size is about zero" for n in names if n in idle and n not in dropped})
        idle.update(names)
        stage = shorter
    return stage


def _needed(names: Sequence[str], stage: ExtendedFit, without: ExtendedFit) -> bool:
    """Tell if a fit needs effects although their magnitudes, given shapes that it hardly knows, may be zero."""
    if not stage.exact or not all(is_plausible(n, stage) for n in names):
        return False
    return not without.exact or without.deviance - stage.deviance > MIN_LIKELIHOOD_RATIO * stage.dispersion


def _fits_without(before: ExtendedFit, stage: ExtendedFit, runner: CallRunner) -> dict[str, ExtendedFit | None]:
    """Return the fit without each effect but with all others; None where exact dynamics do not follow the logs."""
    names = added(before, stage) if stage.exact else []
    found = refit_all([_without(stage, [n]) for n in names], stage, runner)
    return {name: None if x is None else slim(x) for name, x in zip(names, found, strict=True)}


def _needless(stage: ExtendedFit, without: Mapping[str, ExtendedFit | None]) -> str | None:
    """Return an effect that gains too little beside the others for a place, the least first; None if there is none.

    What effects at the same place leave by errors of their formulas is no gain of another.
    """
    ratios = {n: stage.wald(n) if x is None else x.deviance - stage.deviance for n, x in without.items()}
    for name in sorted(ratios, key=lambda n: ratios[n]):
        place = name.partition("@")[2]
        formulas = sum(formula_ratio(r) for n, r in ratios.items() if n != name and n.partition("@")[2] == place)
        if without[name] is not None and ratios[name] < max(
            MIN_LIKELIHOOD_RATIO * stage.dispersion, min(formulas, MAX_FORMULA_RATIO)
        ):
            return name
    return None


def _without_needless(
    stage: ExtendedFit, without: Mapping[str, ExtendedFit | None], dropped: dict[str, str]
) -> ExtendedFit | None:
    """Return the fit without an effect that gains too little beside the others; None if each has its place."""
    needless = _needless(stage, without)
    if needless is None:
        return None
    dropped[needless] = "the other effects replace it"
    return refit(_without(stage, [needless]), stage)


def slim(stage: ExtendedFit) -> ExtendedFit:
    """Return a fit without its linearised logs, which take most of the memory; its deviance is kept."""
    slimmed = replace(stage, fit=replace(stage.fit, linear=()))
    slimmed.__dict__["deviance"] = stage.deviance
    return slimmed


def _judged(
    before: ExtendedFit,
    stage: ExtendedFit,
    without: Mapping[str, ExtendedFit | None],
    every: evidence.Form | None,
    runner: CallRunner,
    deadline: Deadline,
) -> tuple[ExtendedFit, tuple[Choice, ...]]:
    """Exchange each effect for a rival that explains the logs better, and return those that explain them as well.

    every: form of all candidates about the stage, if there is one.
    """
    names = added(before, stage)
    if not stage.exact or deadline.is_over() or not names:
        return stage, tuple(Choice(n, stage.wald(n), None) for n in names)
    form = every or stage.form(_every_candidate(stage), runner)
    tried = [(name, entry) for name in names for entry in _likely_rivals(form, stage, name, runner)]
    stage.release()
    machines = [effects.with_effects(_without(stage, [name]), entry) for name, entry in tried]
    rivals: dict[str, list[tuple[float, EffectEntry]]] = {name: [] for name in names}  # with their information
    most = stage.fit.cost + 2 * (stage.data.noise_cost - stage.data.n_readings) + MAX_FORMULA_RATIO
    for (name, entry), x in zip(tried, refit_all(machines, stage, runner, most=most), strict=True):
        if x is None or _fell_to_zero(entry.label, x) or not is_plausible(entry.label, x) or x.impossible:
            continue
        told = information(x, entry.label)
        rivals[name].append((told, fitted_entry(x, entry.label)))
        if told < information(stage, name) - CLEARLY_BETTER:
            return _judged(before, x, _fits_without(before, x, runner), None, runner, deadline)
    choices = []
    for name in names:
        fit = without.get(name)
        ratio = stage.wald(name) if fit is None else fit.deviance - stage.deviance
        margin = 2 * np.log(evidence.CREDIBLE_ODDS) * stage.dispersion + formula_ratio(ratio)
        tied = tuple(entry for told, entry in rivals[name] if told - information(stage, name) < margin)
        choices.append(Choice(name, ratio, fit, tied))
    return stage, tuple(choices)


CLEARLY_BETTER = 10.0  # likelihood ratio by which a rival must be better to take an effect's place; chosen


def formula_ratio(ratio: float) -> float:
    """Return the likelihood ratio that an error of an effect's formula may cause."""
    return float(min(FORMULA_ERROR**2 * ratio, MAX_FORMULA_RATIO))


def information(stage: ExtendedFit, name: str) -> float:
    """Return the deviance with a price for each parameter of an effect: the information of G. Schwarz (1978)."""
    return stage.deviance + float(np.log(stage.data.n_readings)) * degrees_of_freedom(name, stage)


def _likely_rivals(every: evidence.Form, stage: ExtendedFit, name: str, runner: CallRunner) -> list[EffectEntry]:
    """Return the candidates that to first order gain about as much as an effect in its place, best first."""
    form, gains = _in_place_of(every, stage, name)
    known = {e.name for e in stage.model.effects}
    possible = {x.name for x in candidates_of(stage, form.candidates)} - known
    best = evidence.best_of_each(form, gains, lambda x: x.name, 0.0)
    found = [x for x in (form.candidates[k] for k in best) if x.name in possible][:MAX_RIVALS]
    if not found:
        return []
    form, gains = _in_place_of(stage.form([*found, Candidate(stage.fitted(name), (0,))], runner), stage, name)
    least = max(gains[-1] - max(RIVAL_LOSS, RIVAL_LOSS_SHARE * gains[-1]), 0.0)
    rivals = [x for x, gain in zip(form.candidates[:-1], gains[:-1], strict=True) if gain > least]
    return [_start_entry(x, evidence.factor_of(form, x, form.nothing)) for x in rivals]


def _in_place_of(form: evidence.Form, stage: ExtendedFit, name: str) -> tuple[evidence.Form, np.ndarray]:
    """Return the form without an effect of the model, and the gain of each candidate then."""
    at, own = stage.parameters_of(name), stage.model.base.names.index(name)
    value = np.array([-stage.fit.X[k] / stage.model.scale[k] if k == own else 0.0 for k in at])
    form = form.without(at, value).reduced()
    return form, evidence.first_gains(form, (), form.nothing)


def _with_presliding(stage: ExtendedFit, runner: CallRunner) -> ExtendedFit:
    """Return a fit with presliding at each joint where it describes friction near rest better than free friction."""
    while True:
        wanted = [x for x in candidates_of(stage) if x.placed.effect.name == PRESLIDING]
        if not wanted:
            return stage
        form = stage.form(wanted, runner).reduced()
        gains = evidence.first_gains(form, (), form.nothing)
        best = [form.candidates[k] for k in evidence.best_of_each(form, gains, lambda x: x.name)]
        machines = [effects.with_effects(stage.machine, _start_entry(x, np.ones(len(x.columns)))) for x in best]
        tried = [
            (stage.deviance - x.deviance - required_likelihood_ratio(name, x, len(best)), x)
            for name, x in zip([y.name for y in best], refit_all(machines, stage, runner), strict=True)
            if x is not None and not _fell_to_zero(name, x) and is_plausible(name, x)
        ]
        excess, found = max(tried, key=lambda x: x[0], default=(0.0, stage))
        if excess <= 0:
            return stage
        stage = found


def is_plausible(name: str, stage: ExtendedFit) -> bool:
    """Tell if an effect's fitted magnitude and shapes are possible.

    If it shakes a torque sensor, one of the logs must show that, or none can.
    """
    placed, fitted = stage.placed(name), stage.fitted(name)
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


def _is_idle(name: str, stage: ExtendedFit) -> bool:
    """Tell if a fit led an effect to zero, or next to it."""
    idle = stage.wald(name) < MIN_LIKELIHOOD_RATIO * stage.dispersion and not stage.placed(name).effect.inverse
    return _fell_to_zero(name, stage) or (stage.exact and idle)


def _fell_to_zero(name: str, stage: ExtendedFit) -> bool:
    """Tell if a fit led an effect that must be positive to zero."""
    effect, fit, k = stage.placed(name).effect, stage.fit, stage.model.base.names.index(name)
    return (
        effect.positive
        and not effect.inverse
        and not fit.unidentifiable[k]
        and bool(fit.X[k] < MIN_MAGNITUDE_STDS * fit.std[k])
    )
