"""One effect chosen for a model: candidates are scored, the likeliest fitted, and those that the logs like about as
well kept as rivals of the best.

Where no model follows the logs, the first, or two of which neither does alone, are chosen with coarse sensors
(`sharp`), or the first from the logs' beginning (`unfollowed`); where nothing explains them, from their beginning too,
however little it promises (`unlikely`).
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
    FAR,
    FOLLOWED,
    SMALL,
    Stage,
    exact_if_near,
    freed,
    refits,
    refitted,
    refitted_and_freed,
    sharpened,
)
from excite.diagnosis.parallel import Together
from excite.diagnosis.residual_tests import shakes
from excite.diagnosis.screening import begun
from excite.logs import Log
from excite.model import effects
from excite.model.effects import Effect, PlacedEffect
from excite.model.machine import EffectEntry, Quantity
from excite.smoothing import NotConvergedError

# Of twice the log-likelihood that an effect must gain; logs without any stayed below 16. Chi-squared gives 2.1 % of
# logs of a minute above what `threshold` makes of it, 2.7 % of longer ones, at most: summed over the 371 and 441
# candidates of va12 as if these had nothing in common, with all their shapes.
LEVEL = 22.0
CHANCE = 0.05  # p-value above which no effect has a name: those with many shapes must gain more than LEVEL
WORTH = 15.0  # a first-order gain below which a candidate isn't fitted
HOPE = 0.4, 0.15  # share of the best first-order gain below which a candidate isn't fitted: weak misfit, strong misfit
TRIED = 5  # candidates that are fitted, beside further variants of the likeliest names
LIKE = 0.7  # share of a name's best first-order gain from which another variant of it is fitted as well
PLAIN = 0.5  # the same for the variant without unusual shapes, which the others may mimic before a fit
ANEW = 12  # effects that begin anew where nothing was found
# Candidates that are fitted before any is compared with another, or with forces so large that they take up part of any
# cause.
PAIR = 2
BEHIND = 0.5  # share of what must be gained, or was already, that candidates must have come to after a few passes
OVER = 2.5  # by which what a candidate gains may exceed its first-order gain
CLOSE = 10.0  # a rival that is worse by less than this is a tie
# Of what is explained already, that a further effect must gain, as nature is never exactly the formula: by the fits'
# gains, and by how many deviations the amounts are from none; the more where parameters absorb most of an effect, as
# they absorb none of its formula's error; for what acts at some time only; where forces hide how good the formula is;
# beside what a map of the ground tells, as of a gain two maps of one ground leave each other up to 1.3 %.
SHAPE = 0.005, 0.002
ABSORBED, TIMED, HIDDEN, MAPPED = 0.1, 0.1, 0.25, 0.02
MUCH = 0.1  # misfit beside noise, over what noise makes, of which one further effect takes away all only as a cause
ALIKE = 0.03  # of an amount: what two formulas of one effect differ by; those of results/diagnosis do by 1 to 6 %
BESIDE = 250.0  # a gain that by the latter no effect can be denied, nor counted as a rival
CLOSER = 1.0, 0.35  # way to the grid's next points within which the best candidates are tried again, in turn
INSTANT = 0.5  # [s] about which instants are known before a fit, which finds them from near only
LEAST = 0.05, 0.15  # of the excess misfit that an effect must explain to be worth a place: weak misfit, strong misfit
# The same of the first effect beside exact dynamics or large forces, as the largest of three explains so much, and of a
# further one where the model isn't near the logs yet: what takes less leads to no name, one patch after another.
MAIN = 0.3
SHARE = 0.7  # of the excess misfit beside coarse sensors, from which a fit with sharp ones is worth disturbing forces
FORCED = 0.02  # of what is gained with disturbing forces, by which a rival is a tie: they take up part of a difference
NEAR = 0.3  # of what the best name leaves unexplained, by which a rival may be worse and still is a tie
NONE = 0.3  # deviations above zero, below which a fit ends where the logs would like an amount best below zero
TINY = 1e-12  # what a machine file can't hold is nothing
Advance = Callable[[float, str], None]  # told the share that is done and what is done next
_Try = tuple[score_test.Score, Stage]


@dataclass(frozen=True)
class Choice:
    """An effect that was added, the model with it, and the rivals that the log likes about as well.

    gain: of twice the log-likelihood (Wald's statistic where no model without it could be fitted), which what is left
    of the misfit makes `spread` times less sure. left: the share of the effect that parameters don't absorb. loose: the
    model with it and the disturbing forces that it was judged with, where it needs none. beside: what it gains given
    the others, where that was measured.
    """

    name: str
    stage: Stage
    gain: float
    spread: float
    tried: int
    rivals: tuple[EffectEntry, ...]
    left: float
    loose: Stage | None = None
    beside: float | None = None


def wald(name: str, stage: Stage) -> float:
    """By how many deviations an effect's amount and the shapes that are none by default are from none together in a
    fit, squared (Wald's statistic): one may stand for the other. 0 of what was held, as nothing shows it."""
    shapes, names, fit = stage.placed(name).effect.shapes, stage.model.base.names, stage.fit
    told = [name, *(f"{name}.{s}" for s, shape in shapes.items() if shape.signed and not shape.circular)]
    at = [k for k in (names.index(n) for n in told if n in names) if not fit.unidentifiable[k]]
    away = fit.X[at] / fit.std[at]
    return float(away @ np.linalg.solve(fit.covariance[np.ix_(at, at)] / np.outer(fit.std[at], fit.std[at]), away))


def freedom(name: str, stage: Stage) -> int:
    """How many parameters an effect has in a model: its amount and the shapes that are fitted."""
    return sum(n == name or n.startswith(f"{name}.") for n in stage.model.base.names)


def threshold(name: str, stage: Stage, tried: int) -> float:
    """What an effect must gain of twice the log-likelihood to be one, of so many candidates that were tried."""
    return max(LEVEL, float(scipy.stats.chi2.isf(CHANCE / tried, freedom(name, stage))))


def _sureness(stage: Stage) -> float:
    """Wald's statistic of all the amounts in a model together."""
    return sum(wald(e.name, stage) for e in stage.model.effects if not e.effect.inverse)


def scored(stage: Stage, together: Together) -> tuple[score_test.Score, ...]:
    """What every effect that a model does not have promises, best first. None that is as well a harmonic of what it
    has: of a ripple of one contact, say, when all turn at about the same speed."""
    if not stage.scores:
        stage.scores.append(_scored(stage, together))
    return stage.scores[0]


def _scored(stage: Stage, together: Together) -> tuple[score_test.Score, ...]:
    known = [e.name for e in stage.model.effects]
    sensors = [s.name for s in stage.prepared.c.sensors]
    found = score_test.candidates(stage.machine, sensors, _duration(stage.prepared.logs))
    wanted = [x for x in found if x.name not in known or _has_harmonics(x.placed.effect)]
    scores = _scanned(stage, score_test.renumbered(wanted), together)
    harmonic: dict[str, float] = {}
    for s in scores:
        if s.candidate.name in known:
            harmonic.setdefault(s.candidate.placed.effect.name, s.gain + CLOSE)
    new = (s for s in scores if s.candidate.name not in known)
    return tuple(s for s in new if s.gain > harmonic.get(s.candidate.placed.effect.name, -np.inf))


def _has_harmonics(effect: Effect) -> bool:
    shapes = effect.shapes.values()
    return any(s.circular for s in shapes) and any(s.whole and len(s.grid) > 1 for s in shapes)


def _scanned(stage: Stage, found: Sequence[score_test.Candidate], together: Together) -> tuple[score_test.Score, ...]:
    return score_test.scan(stage.ways, stage.fit, found, together)


def _duration(logs: Sequence[Log]) -> float:
    return max(float(log.t[-1] - log.t[0]) for log in logs)


def _entry(score: score_test.Score) -> EffectEntry:
    """A candidate as an entry of the machine file: where a fit begins."""
    e, values = score.candidate.placed, dict(score.values)
    amount = values.pop("A")
    if len(e.effect.grid) > 1:
        # Not proportional to the amount: no further from the grid's value than the signature holds.
        step = float(np.clip(amount / e.values["A"], 0.3, 2.0))
        amount = e.values["A"] / step if e.effect.inverse else e.values["A"] * step
    return identified(e.effect.name, e.where, amount, {n: round(v, 12) for n, v in values.items() if n in e.shapes})


def entry_of(stage: Stage, name: str) -> EffectEntry:
    """An effect with amount and shapes as a stage's fit has them."""
    placed = stage.placed(name)
    values = _values(stage, placed)
    amount = values.pop("A")
    amount = max(amount, 2 * TINY) if placed.effect.positive else amount  # zero is none that a machine may have
    return identified(placed.effect.name, placed.where, amount, values)


def _values(stage: Stage, placed: PlacedEffect) -> dict[str, float]:
    """Amount and shapes of an effect as a stage's fit has them."""
    fitted = dict(zip(stage.model.base.names, stage.fit.X, strict=True))
    return {key: float(fitted.get(p, placed.values[key])) for p, (key, _) in placed.parameters.items()}


def identified(effect: str, where: str, amount: float, shapes: Mapping[str, float]) -> EffectEntry:
    def told(value: float) -> Quantity:
        return Quantity(value=value if abs(value) > TINY else 0.0, source="identified")

    return EffectEntry(
        name=effect, where=where, amount=told(amount), shape={name: told(x) for name, x in shapes.items()}
    )


def _shortlist(stage: Stage, scores: Sequence[score_test.Score], chosen: Sequence[Choice]) -> list[score_test.Score]:
    """The best candidate of each name, best first, as far as worth a fit; another variant where it scores alike. TRIED
    in all, beside further variants of the likeliest PAIR of names."""
    best: dict[tuple[str, ...], score_test.Score] = {}
    most: dict[str, float] = {}
    hope = max(WORTH, HOPE[stage.rough] * scores[0].gain) if scores else 0.0
    for s in scores:
        whole = _much(stage) and OVER * s.gain >= stage.excess
        least = _least(stage, chosen, s.candidate, 0.0) / OVER if stage.settled and not whole else 0.0
        worth = s.gain >= max(least, hope) and s.values["A"] != 0
        like = LIKE if len(s.candidate.variant) > 1 else PLAIN
        if worth and s.gain >= like * most.setdefault(s.candidate.name, s.gain):
            best.setdefault(s.candidate.variant, s)
    likely = list(best.values())
    first = _names(likely)[:PAIR]
    return [*likely[:TRIED], *(s for s in likely[TRIED:] if s.candidate.name in first)]


def _likely(
    stage: Stage, scores: Sequence[score_test.Score], chosen: Sequence[Choice], together: Together
) -> list[score_test.Score]:
    """What is worth a fit, with shapes between the grid's points."""
    likely, duration = _shortlist(stage, scores, chosen), _duration(stage.prepared.logs)
    for reach in (*CLOSER, *_reaches(duration)) if likely else ():
        about = [s for s in likely if reach in CLOSER or s.candidate.placed.effect.timed]
        nearby = score_test.finer(about, stage.machine, duration, reach)
        if len(nearby) > len(about):
            likely = _shortlist(
                stage, sorted([*likely, *_scanned(stage, nearby, together)], key=lambda s: -s.gain), chosen
            )
    return likely


def _reaches(duration: float) -> list[float]:
    """Further reaches for what acts at some time in a log of duration [s], until instants are known."""
    found = [CLOSER[-1]]
    while found[-1] * duration / 12 > INSTANT:  # of a grid as wide as a quarter of the log, thirds are tried
        found.append(found[-1] * CLOSER[-1])
    return found[1:]


def choose(
    stage: Stage,
    scores: Sequence[score_test.Score],
    chosen: Sequence[Choice],
    together: Together,
    tell: Advance,
    done: float,
) -> Choice | None:
    """The effect that the logs like best beside those that were chosen; None if none is worth it."""
    likely = _likely(stage, scores, chosen, together)
    if not likely:
        return None

    def told(k: int) -> None:
        tell(done + 0.03 * min(k, TRIED), f"fitting {likely[k].candidate.name}")

    ceiling = np.inf
    if _hides(stage):
        ceiling = stage.fit.cost - BEHIND * min(_least(stage, chosen, s.candidate, 0.0) for s in likely)
    tries, refused = _tries(stage, likely, together, told, ceiling)
    if stage.exact and _lost(likely, tries, refused):
        # Exact dynamics find no way to the likeliest cause: all are judged with disturbing forces instead.
        known = chosen[-1].loose if chosen else None
        if known is not None and known.machine is stage.machine and known.fit.process_noise == SMALL:
            stage = known
        else:
            try:
                stage = refitted(stage.machine, stage, SMALL)
            except NotConvergedError:
                return None
        found = score_test.renumbered([s.candidate for s in likely])
        likely = _shortlist(stage, _scanned(stage, found, together), chosen)
        if not likely:
            return None
        tries, _ = _tries(stage, likely, together, lambda k: None)
    if not tries:
        return None
    score, best = tries[0]
    gain = stage.fit.cost - best.fit.cost
    level = threshold(score.candidate.name, best, len(scores))
    whole = _completes(best, stage)
    if gain < max(level * best.spread, 0.0 if whole else _least(stage, chosen, score.candidate, 0.0)):
        return None
    hidden = not whole and gain < _least(stage, chosen, score.candidate)
    if hidden and not best.near:
        return None
    choice = _chosen(tries, gain, len(scores), together)
    if not hidden:
        return choice
    return replace(choice, loose=None) if choice.stage.exact and choice.stage.near else None


def _chosen(tries: Sequence[_Try], gain: float, tried: int, together: Together) -> Choice:
    """The best of tries without disturbing forces where that can be, and what is close to it as its rivals: those as
    well that only with such forces are known to be as good. With a machine that can be where one of them has one."""
    spread, forced = tries[0][1].spread, {s.candidate.name: stage for s, stage in tries if not stage.exact}
    close = _close(tries, gain)
    exact, unknown = _without_forces(close, together)
    lowest = tries[0][1].fit.cost
    if forced and exact and not exact[0][1].near:
        # Forces hid that it doesn't explain the logs. One that explained a little less under them may do.
        left = [x for x in tries if x[0].candidate.name not in {s.candidate.name for s, _ in close}]
        others, _ = _without_forces([x for x in left if x[1].fit.cost - lowest <= (1 - LIKE) * gain], together)
        exact = sorted([*exact, *others], key=lambda x: x[1].fit.cost)
    judged = [*_close(exact, gain, SHAPE[0] if forced else SHAPE[1]), *unknown] if exact else close
    if judged[0][1].vain:
        judged = [x for x in judged if x[1].exact and x[1].near and not x[1].impossible] or judged
    score, best = judged[0]
    rivals = tuple(entry_of(other, s.candidate.name) for s, other in judged[1:])
    loose = forced.get(score.candidate.name) if best.exact else None
    behind = next(x.fit.cost for s, x in tries if s.candidate.name == score.candidate.name) - lowest
    gain -= min(behind, (1 - LIKE) * gain)  # what is close may be further behind where much is left
    return Choice(score.candidate.name, best, gain, spread, tried, rivals, score.left, loose)


def sharp(stage: Stage, together: Together) -> tuple[Stage, list[Choice]] | None:
    """Where the model follows the logs with coarse sensors only: the effect with which it follows them with sensors as
    they are, and the stage without. Coarse sensors leave of a misfit what shows its cause, and are followed by what is
    nearly right. Two effects where none does by itself. No effect where the model does without after all, None where
    nothing comes near."""
    begun_without = sharpened([stage], 0.0, together)
    scores, least = scored(stage, together), LEAST[1] * stage.excess
    plain = next(begun_without)
    if plain is not None and plain.near:
        return plain, []
    likely = _likely(stage, scores, (), together)
    tries, _ = _tries(stage, likely, together, lambda k: None, stage.fit.cost - BEHIND * least)
    if not tries:
        return None
    _, best = tries[0]
    gain = stage.fit.cost - best.fit.cost
    if gain < max(LEVEL * best.spread, least):
        return None
    alike = [x for x in tries if stage.fit.cost - x[1].fit.cost >= LIKE * gain]
    follow: list[_Try] = []
    for disturbed in (0.0, identification.PROCESS_NOISE_LEVELS[0]) if gain >= SHARE * (gain + best.excess) else (0.0,):
        sharp = zip(alike, sharpened([x for _, x in alike], disturbed, together), strict=True)
        found = [(score, x) for (score, _), x in sharp if x is not None and x.follows]
        found = [(score, x) for score, x in found if not _vanished(score.candidate.name, x)]
        follow = follow or found
        if near := _one_each([x for x in found if x[1].near]):
            follow = near
            break
    if not follow:
        both = _both(stage, tries[0], len(scores), together)
        return (stage, both) if both else None
    follow = _one_each(follow)
    score, best = follow[0]
    sure = _sure_beside(score.candidate.name, best, gain, stage, plain)
    if sure < LEVEL * best.spread:
        return None
    return stage, [_chosen(follow, sure, len(scores), together)]


def _sure_beside(name: str, best: Stage, gain: float, coarse: Stage, plain: Stage | None) -> float:
    """What an effect gains with sharp sensors, of which coarse ones say gain: Wald's statistic is of the same kind, and
    smaller where that is large. Far from no effect it says too much, and further effects are measured by it. Coarse
    sensors say too little: without the effect the misfit is what a plain fit has, or as large for sharp ones, as far as
    a fit is waited for."""
    times = coarse.prepared.coarse
    without = (
        min(times**2 * gain, FAR * best.noise - best.fit.cost) if plain is None else plain.fit.cost - best.fit.cost
    )
    return min(wald(name, best), max(times * gain, without))


def _both(stage: Stage, first: _Try, tried: int, together: Together) -> list[Choice]:
    """Two effects with which the model comes near coarse sensors, as it does with none, and exact dynamics near sharp
    ones; the first is the best alone and takes a good part of what is left without. None where there aren't two."""
    score, beside = first
    if stage.fit.cost - beside.fit.cost < MAIN * stage.excess:
        return []
    scores, most = scored(beside, together), FOLLOWED * beside.noise
    likely = _likely(beside, scores, (), together)
    if not likely:
        return []
    tries, _ = _tries(beside, likely, together, lambda k: None, most)
    tries = [x for x in tries if x[1].fit.cost <= most]
    every = zip(tries, sharpened([x for _, x in tries], 0.0, together), strict=True)
    found = [(s, coarse, x) for (s, coarse), x in every if x is not None and x.near]
    found = [x for x in found if not any(_vanished(e.candidate.name, x[2]) for e in (score, x[0]))]
    if not found:
        return []
    second, coarse, best = min(found, key=lambda x: x[2].fit.cost)
    sure = (
        _sure_beside(score.candidate.name, best, stage.fit.cost - beside.fit.cost, stage, None),
        _sure_beside(second.candidate.name, best, beside.fit.cost - coarse.fit.cost, stage, None),
    )
    if min(sure) < LEVEL * best.spread:
        return []
    return [
        Choice(score.candidate.name, beside, sure[0], best.spread, tried, (), score.left),
        _chosen(_one_each([(s, x) for s, _, x in found]), sure[1], len(scores), together),
    ]


def unfollowed(stage: Stage, together: Together) -> tuple[Stage, list[Choice], frozenset[str]]:
    """Where no fit was found: the effect with which the model can follow the logs, with as small disturbing forces as
    there is one. With it there may be a fit without it after all, which then is what it is compared with, and may be as
    good: the model began too far off. The stage as it was and no effect where nothing helps, and the names that were
    tried then."""
    scores = scored(stage, together)
    likely = _likely(stage, scores, (), together)
    forces = 0.0, identification.PROCESS_NOISE_LEVELS[0], identification.PROCESS_NOISE_LEVELS[-1]
    found = _followed(stage, likely, forces, len(scores), together)
    return (*found, frozenset()) if found else (stage, [], frozenset(s.candidate.name for s in likely))


def unlikely(scanned: Stage, stage: Stage, tried: Container[str], together: Together) -> tuple[Stage, list[Choice]]:
    """Where nothing was found that explains the logs: far from any fit an effect promises little of what it explains,
    or something else does. So those that promise anything in a stage, scanned, begin anew with exact dynamics, which
    follow the logs with the right one only; but those that were tried so. As `unfollowed` has it."""
    scores = scored(scanned, together)
    best = {s.candidate.name: s for s in reversed(scores) if s.gain > 0 and s.values["A"] != 0}
    most = sorted(best.values(), key=lambda s: -s.gain)[:ANEW]
    most = [s for s in most if s.candidate.name not in tried]
    return _followed(stage, most, (0.0,), len(scores), together) or (stage, [])


def _followed(
    stage: Stage, likely: Sequence[score_test.Score], forces: Sequence[float], tried: int, together: Together
) -> tuple[Stage, list[Choice]] | None:
    """The effect with which a model can follow the logs from the beginning, with the first forces that do. Where exact
    dynamics were fitted without any, one that takes less than MAIN of what they leave isn't waited for."""
    machines = [effects.with_effects(stage.machine, _entry(s)) for s in likely]
    worth = stage.fit.cost - MAIN * stage.excess if stage.settled and stage.exact else np.inf
    for disturbed in forces if likely else ():
        few = disturbed > identification.PROCESS_NOISE_LEVELS[0]
        names = _names(likely)[: PAIR if few else None]
        begin = [(s, m) for s, m in zip(likely, machines, strict=True) if s.candidate.name in names]
        enough = partial(_settles, [s.candidate.name for s, _ in begin])
        found = begun([m for _, m in begin], stage, disturbed, together, worth, enough)
        follow = [(s, x) for (s, _), x in zip(begin, found, strict=True) if x is not None and x.follows]
        follow = [(s, x) for s, x in follow if _is_any(s.candidate.name, x)]
        if not follow:
            continue
        tries = _one_each([x for x in follow if x[1].near] or follow)
        score, best = tries[0]
        comparable = stage.settled and stage.fit.process_noise == best.fit.process_noise
        without, best = refitted_and_freed(stage.machine, best, together)
        tries = [(score, best), *(x for x in tries[1:] if x[1].fit.process_noise == best.fit.process_noise)]
        if without is not None:
            stage = stage if comparable and stage.fit.cost < without.fit.cost else without
        # Wald's statistic is of the same kind, and smaller where much is gained.
        alike = without is not None or comparable
        gain = stage.fit.cost - best.fit.cost if alike else wald(score.candidate.name, best)
        if gain < LEVEL * best.spread:
            return exact_if_near(stage), []
        return stage, [_chosen(tries, gain, tried, together)]
    return None


def _settles(names: Sequence[str], k: int, stage: Stage) -> bool:
    """Whether one of several effects, begun anew, is a cause: beside it only what brings the model as near is any."""
    return stage.near and stage.exact and _is_any(names[k], stage)


def _least(stage: Stage, chosen: Sequence[Choice], candidate: score_test.Candidate, hidden: float = HIDDEN) -> float:
    """What an effect must gain to be worth a place beside those that were chosen. hidden: of what they gained, where
    forces hide how good their formulas are; none where exact dynamics come near the logs with it."""
    part = max(SHAPE[0], TIMED * candidate.placed.effect.timed, hidden * (not stage.exact))
    mapped = {e.name for e in stage.model.effects if e.uses_map}
    own = (max(min(ALIKE**2 / x.left, ABSORBED), MAPPED * (x.name in mapped)) for x in chosen)
    shape = sum(max(part, share) * x.gain for share, x in zip(own, chosen, strict=True))
    main = not stage.near if chosen else _hides(stage)
    explained = MAIN if main else LEAST[stage.rough]
    return max(explained * stage.excess, shape, min(SHAPE[1] * _sureness(stage), BESIDE))


def _hides(stage: Stage) -> bool:
    """Whether large disturbing forces leave much: these go far with any model, and with many an effect further."""
    return stage.fit.process_noise >= identification.PROCESS_NOISE_LEVELS[0] and not stage.near


def _completes(found: Stage, before: Stage) -> bool:
    """Whether exact dynamics leave nothing with a further effect and much without: what is wrong with the others'
    formulas no other effect would take away as a whole."""
    return _much(before) and found.exact and found.excess == 0


def _much(stage: Stage) -> bool:
    """Whether exact dynamics leave much beside noise."""
    return stage.exact and stage.excess > MUCH * stage.noise


def _tries(
    stage: Stage,
    likely: Sequence[score_test.Score],
    together: Together,
    tell: Callable[[int], None],
    ceiling: float = np.inf,
) -> tuple[list[_Try], set[str]]:
    """The candidates whose fits were found, as the model without them was fitted: the likeliest two first, the others
    as long as they don't stay far behind what these gain. Those that promise far less than the best come last, and only
    where they may still come near what was gained. What a fit led to zero wasn't found. And the names that were fitted
    and are none: they are not felt. ceiling: cost that no fit may stay above."""
    tries, refused = list[_Try](), set[str]()
    near = max(PAIR, sum(OVER * s.gain >= likely[0].gain for s in likely))
    for at, batch in ((0, likely[:PAIR]), (PAIR, likely[PAIR:near]), (near, likely[near:])):
        gained = max((stage.fit.cost - found.fit.cost for _, found in tries), default=0.0)
        if not batch or (at >= near and gained > OVER * batch[0].gain):
            continue
        wishes = [(effects.with_effects(stage.machine, _entry(s)), stage, stage.fit.process_noise) for s in batch]
        tell(at)
        most = min(ceiling, stage.fit.cost - BEHIND * gained if tries else np.inf)
        for k, (score, found) in enumerate(zip(batch, refits(wishes, together, most), strict=True)):
            tell(min(at + k + 1, len(likely) - 1))
            if found is None or _vanished(score.candidate.name, found):
                continue
            if _felt(score.candidate.name, found):
                tries.append((score, found))
            else:
                refused.add(score.candidate.name)
        others = likely[at + len(batch) :]
        if stage.exact and _lost(likely, tries, refused) and likely[0].candidate.name not in _names(others):
            break
    return _one_each(tries), refused


def _names(scores: Sequence[score_test.Score]) -> list[str]:
    """Of candidates, each once."""
    return list(dict.fromkeys(s.candidate.name for s in scores))


def _lost(likely: Sequence[score_test.Score], tries: Sequence[_Try], refused: Container[str]) -> bool:
    """Whether no way was found to the likeliest cause."""
    name = likely[0].candidate.name
    return name not in refused and all(s.candidate.name != name for s, _ in tries)


def _felt(name: str, stage: Stage) -> bool:
    """Whether an effect's shapes are such as there are, and the torque sensor shakes, in one of the logs, while it acts
    if that shakes it; also where none of them can tell."""
    placed = stage.placed(name)
    fitted = replace(placed, values={**placed.values, **_values(stage, placed)})
    if not effects.shapes_possible(stage.machine, fitted):
        return False
    if fitted.effect.shaking is None:
        return True
    of = (s for s in stage.machine.sensors("full") if s.kind == "torque" and s.body == fitted.bodies[0])
    sensor, rate = next(of, None), float(stage.machine.sampling_hz)
    if sensor is None:
        return True
    told = [shakes(x.values[sensor.name], fitted.shaking(x.t), rate) for x in stage.prepared.logs]
    return any(told) or all(x is None for x in told)


def _vanished(name: str, stage: Stage) -> bool:
    """Whether a fit led an effect that makes sense above zero only to zero: that was no way to what it promised."""
    effect, fit, k = stage.placed(name).effect, stage.fit, stage.model.base.names.index(name)
    return effect.positive and not effect.inverse and not fit.unidentifiable[k] and bool(fit.X[k] < NONE * fit.std[k])


def _is_any(name: str, stage: Stage) -> bool:
    """Whether an effect in a fit is one at all."""
    return not _vanished(name, stage) and _felt(name, stage)


def _one_each(tries: Sequence[_Try]) -> list[_Try]:
    """The best variant of each name, best first: with as small disturbing forces as can be."""
    best: dict[str, _Try] = {}
    for x in sorted(tries, key=lambda x: (x[1].fit.process_noise, x[1].fit.cost)):
        best.setdefault(x[0].candidate.name, x)
    return list(best.values())


def _close(tries: Sequence[_Try], gain: float, share: float | None = None) -> list[_Try]:
    """The best of sorted tries and those that the logs like about as well: no difference counts that is a matter of the
    formula, of an effect that gains so much or is so sure. share: of the gain that is, the more where forces had to
    help."""
    score, best = tries[0]
    share = share or (SHAPE[1] if best.exact else FORCED)
    near = max(CLOSE * best.spread, NEAR * best.excess, share * gain)
    if best.exact and not score.candidate.placed.effect.inverse:
        # What forces let it gain is less than what it gains without them.
        near = max(near, min(SHAPE[1] * wald(score.candidate.name, best), BESIDE))
    return [x for x in tries if x[1].fit.cost - best.fit.cost < near]


def _without_forces(tries: Sequence[_Try], together: Together) -> tuple[list[_Try], list[_Try]]:
    """Those that need no disturbing forces any more, best first, and as they are those for which no such fit is found;
    what forces leave far off is neither."""
    good = [x for x in tries if x[1].exact or x[1].near]
    without = freed([s for _, s in good if not s.exact], together)
    found = [(x, x[1] if x[1].exact else next(without)) for x in good]
    found = [(x, None if s is None or _vanished(x[0].candidate.name, s) else s) for x, s in found]
    exact = [(score, stage) for (score, _), stage in found if stage is not None]
    return sorted(exact, key=lambda x: x[1].fit.cost), [x for x, stage in found if stage is None]
