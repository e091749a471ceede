"""What a simulation gets wrong, why, and what mending it gains.

A log is smoothed with the machine's model. Where the innovations hold more than noise, every effect of the catalogue is
scored (`evidence`), the best are fitted with amount and shapes as parameters, and the one that the log likes best is
added to the model; then again, until nothing is left or nothing in the catalogue helps. Names that the log likes as
well are given together. What no name explains is said to be unexplained. Where the model without effects can be fitted
to much coarser sensors only, the first effect is found with these and the fit sharpened with it; where not even that,
effects are scored along the file's parameters and fitted from the logs' beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite import evidence, smoothing
from excite.anomaly import anomalies
from excite.log import Log
from excite.newton import NotConverged
from excite.sidebyside import Together, in_turn
from excite.stages import (
    SMALL,
    Stage,
    as_measured,
    begun,
    exact_if_near,
    fitted,
    forced,
    freed,
    refits,
    refitted,
    sharpened,
)
from model import placing
from model.file import Quantity
from model.machine import EffectEntry, Filter
from model.prediction import Model

# Of twice the log-likelihood that an effect must gain; logs without any stayed below 16. For all candidates of va12
# together chi-squared gives 0.8 % of logs of a minute above it, 1 % of longer ones, whatever their number of shapes.
LEVEL = 22.0
WORTH = 15.0  # a first-order gain below which a candidate isn't fitted
HOPE = 0.4, 0.15  # share of the best first-order gain below which a candidate isn't fitted: weak misfit, strong misfit
TRIED = 5  # candidates that are fitted
LIKE = 0.7  # share of a name's best first-order gain from which another variant of it is fitted as well
PAIR = 2  # candidates that are fitted in any case, side by side
OVER = 2.5  # by which what a candidate gains may exceed its first-order gain
MOST = 4  # effects that are looked for
CLOSE = 10.0  # a rival that is worse by less than this is a tie
# Of what is explained already, that a further effect must gain, as nature is never exactly the formula: by the fits'
# gains, and by how many deviations the amounts are from none; the more where parameters absorb most of an effect, as
# they absorb none of its formula's error; for what acts at some time only; where forces hide how good the formula is.
SHAPE = 0.005, 0.002
ABSORBED, TIMED, HIDDEN = 0.1, 0.1, 0.25
ALIKE = 0.03  # of an amount: what two formulas of one effect differ by; those of results/diagnosis do by 1 to 6 %
FORMULA = 0.5  # of an amount, times the root of the share of a gain that its formula leaves to others
BESIDE = 250.0  # a gain that by the latter no effect can be denied
CLOSER = 1.0, 0.35  # way to the grid's next points within which the best candidates are tried again, in turn
LEAST = 0.05, 0.15  # of the excess misfit that an effect must explain to be worth a place: weak misfit, strong misfit
SHARE = 0.7  # of the excess misfit that names must explain, or it is unexplained
FURTHER = 0.8  # the same for names after the first: what nature has beside its formula looks like many a cause
FORCED = 0.02  # of what is gained with disturbing forces, by which a rival is a tie: they take up part of a difference
ODD = 50.0  # misfit that every line of what is odd beside names stands for, at least
NEAR = 0.3  # of what the best name leaves unexplained, by which a rival may be worse and still is a tie

TINY = 1e-12  # what a machine file can't hold is nothing

Advance = Callable[[float, str], None]


@dataclass(frozen=True)
class Finding:
    """A named cause. gain: of twice the log-likelihood; p_value: that of no effect at all, for all that were tried;
    rivals: what it is tied with, as the logs have it."""

    effect: str
    where: str
    rivals: tuple[EffectEntry, ...]
    p_value: float
    amount: float
    amount_std: float
    unit: str
    shapes: Mapping[str, tuple[float, float, str]]
    gain: float

    @property
    def name(self) -> str:
        return f"{self.effect}@{self.where}"

    @property
    def tied_with(self) -> tuple[str, ...]:
        return tuple(f"{e.name}@{e.where}" for e in self.rivals)

    @property
    def entry(self) -> EffectEntry:
        """As a machine file has it."""
        return _identified(self.effect, self.where, self.amount, {n: value for n, (value, _, _) in self.shapes.items()})


@dataclass(frozen=True)
class Diagnosis:
    """verdict: clean, named, tied or unexplained. `before`, `after`: the model without and with what was found.

    share: of the excess misfit that the names explain. located: lines that say where what is unexplained sits. stages:
    the model with the first finding, the first two, and so on. nearest: where nothing is named, the effect that
    explains most, and the share that it does.
    """

    verdict: str
    findings: tuple[Finding, ...]
    before: Stage
    after: Stage
    share: float
    located: tuple[str, ...]
    stages: tuple[Stage, ...]
    nearest: tuple[str, float] | None = None


def diagnose(
    model: Model, logs: Sequence[Log], filter: Filter, advance: Advance | None = None, together: Together = in_turn
) -> Diagnosis:
    """What these logs show that the model doesn't know. together: how what is independent is computed; the answer is
    the same. Raises NotConverged where the machine file's parameters give no motion at all, NotIdentifiable where a
    torque is missing."""
    tell = advance or (lambda share, what: None)
    tell(0.0, "fitting the model")
    before = fitted(model.machine, logs, filter)
    chosen, left = list[Choice](), 0.0
    if before.prepared.coarse > 1:
        tell(0.15, "fitting effects with coarse sensors")
        sharp = _sharp(before, together)
        before, chosen = sharp or (forced(before), chosen)
    if not (before.settled or chosen):
        tell(0.15, "fitting effects from the beginning")
        before, chosen = _unfollowed(before, together)
    stage = chosen[-1].stage if chosen else before
    while stage.settled and len(chosen) < MOST:
        turn = len(chosen)
        tell(0.15 + 0.2 * turn, "scoring effects")
        scores = _scores(stage, together)
        choice = _choose(stage, scores, chosen, together, tell, 0.2 + 0.2 * turn)
        if choice is not None and before.settled and _outgrows(choice, chosen):
            chosen = []
            break
        if choice is None or _makes_good(choice, chosen):
            left = max(0.0, scores[0].gain - LEVEL) if scores else 0.0
            break
        chosen.append(choice)
        stage = choice.stage
    chosen, odd, nearest = weighed(before, chosen)
    if len(chosen) > 1:
        tell(0.9, "judging each given the others")
        chosen, odd, nearest = weighed(before, needed(before, reviewed(before, chosen, together)))
    stage = chosen[-1].stage if chosen else before
    answer = _verdict(before, stage, chosen, odd, left)
    return answer if answer.findings else replace(answer, nearest=nearest)


def weighed(before: Stage, chosen: Sequence[Choice]) -> tuple[list[Choice], tuple[str, ...], tuple[str, float] | None]:
    """Effects without the last ones that are no names: one that leaves most of the misfit where it was is none, unless
    with what came after it nothing is left, or with the disturbing forces that it was judged with. Also what is odd
    beside those that stay, and the last one that doesn't, with the share that it explains."""
    kept, nearest = list(chosen), None
    while True:
        stage = kept[-1].stage if kept else before
        odd = _odd(stage)
        if not kept or (stage.exact and not odd):
            break
        enough = SHARE if len(kept) == 1 else FURTHER
        explained = _share(kept[-1].gain, stage, odd)
        if explained >= enough:
            break
        loose = kept[-1].loose
        if loose is not None and _share(kept[-1].gain, loose, odd_loose := _odd(loose)) >= enough:
            # Exact dynamics make a large misfit of a formula that is nearly right; it was judged with forces.
            kept[-1], odd = replace(kept[-1], stage=loose), odd_loose
            break
        nearest = kept.pop().name, explained
    return kept, odd, nearest


def reviewed(before: Stage, chosen: Sequence[Choice], together: Together = in_turn) -> list[Choice]:
    """Each of several effects again, given all that came after it as well, so that their order doesn't count: one that
    the others make good for is dropped, one that another name suits better gets that name, rivals are those beside the
    others. What came first stays where nothing better was found."""
    queue, found = list(chosen), chosen[-1].stage
    for first in chosen[:-1]:
        rest, whole = queue[1:], queue[-1].stage
        try:
            stage = _without(first.name, whole)
        except NotConverged:
            queue = [*rest, replace(first, stage=whole, loose=None)]  # nothing fits without it
            continue
        choice = _choose(stage, _scores(stage, together), rest, together, lambda share, what: None, 0.0)
        queue = [*rest, choice] if choice is not None else [*rest[:-1], replace(rest[-1], stage=stage, loose=None)]
    whole, judged = queue[-1].stage, {x.name: x for x in queue}
    same = judged.keys() == {x.name for x in chosen}
    worse = whole.fit.cost - found.fit.cost > LEVEL * found.spread
    if same or worse or whole.fit.disturbed > found.fit.disturbed:
        judged = judged if same else {x.name: x for x in chosen}
        return [replace(x, rivals=_others(judged[x.name], judged)) for x in chosen]
    # The one that came last comes last again.
    again = _one_by_one(before, (*queue[1:], queue[0]), whole)
    return [replace(x, rivals=_others(x, judged)) for x in again] if again else list(chosen)


def _one_by_one(before: Stage, chosen: Sequence[Choice], whole: Stage) -> list[Choice]:
    """Effects that a model has, put into the one without them one after the other; gains are over those that stand
    before. None of them where the logs can't be fitted on the way."""
    if before.prepared.coarse > 1:
        return _one_from_another(chosen, whole)
    made = [before]
    try:
        for x in chosen:
            machine = placing.extended(made[-1].machine, _fitted(whole, x.name))
            made.append(refitted(machine, made[-1], before.fit.disturbed))
        made[-1] = made[-1] if whole.fit.disturbed == before.fit.disturbed else whole
    except NotConverged:
        return []
    found = []
    for x, old, new in zip(chosen, made, made[1:], strict=False):
        alike = old.settled and old.fit.disturbed == new.fit.disturbed
        gain = old.fit.cost - new.fit.cost if alike else x.gain
        found.append(replace(x, stage=new, gain=max(gain, x.gain), loose=None))
    return found


def _one_from_another(chosen: Sequence[Choice], whole: Stage) -> list[Choice]:
    """The same from the model with all of them, where the one without any follows coarse sensors only."""
    made = [whole]
    try:
        for x in reversed(chosen[1:]):
            made.append(_without(x.name, made[-1]))
    except NotConverged:
        return []
    return [replace(x, stage=stage, loose=None) for x, stage in zip(chosen, reversed(made), strict=True)]


def needed(before: Stage, chosen: Sequence[Choice]) -> list[Choice]:
    """Several effects without those that were needed on the way only: in the last fit their amount is hardly known to
    be any, and without it the fit is as good. Disturbing forces hide what else a right name explains."""
    kept, whole = list(chosen), chosen[-1].stage
    for x in chosen:
        if len(kept) == 1 or _surely(x.name, whole):
            continue
        try:
            without = _without(x.name, whole)
        except NotConverged:
            continue
        if without.fit.disturbed <= whole.fit.disturbed and without.fit.cost - whole.fit.cost < LEVEL:
            kept, whole = [y for y in kept if y.name != x.name], without
    if len(kept) == len(chosen):
        return kept
    return _one_by_one(before, kept, whole) or [replace(x, stage=whole, loose=None) for x in kept]


def _surely(name: str, stage: Stage) -> bool:
    """Whether an effect's amount is surely any in a fit; one that is nothing at infinity is taken for sure."""
    return stage.placed(name).effect.inverse or _wald(name, stage) > LEVEL


def _wald(name: str, stage: Stage) -> float:
    """By how many deviations an effect's amount is from none in a fit, squared (Wald's statistic); 0 of one that was
    held, as nothing shows it."""
    k, fit = stage.model.base.names.index(name), stage.fit
    return 0.0 if fit.unseen[k] else float((fit.X[k] / fit.std[k]) ** 2)


def _sureness(stage: Stage) -> float:
    """Wald's statistic of all the amounts in a model together."""
    return sum(_wald(e.name, stage) for e in stage.model.effects if not e.effect.inverse)


def _makes_good(choice: Choice, chosen: Sequence[Choice]) -> bool:
    """Whether a choice takes the place of an effect that explains more: then it is but a piece of another explanation,
    which needs several names for what one explains."""
    return any(choice.gain < x.gain and not _surely(x.name, choice.stage) for x in chosen)


def _outgrows(choice: Choice, chosen: Sequence[Choice]) -> bool:
    """Whether a choice gains more, under disturbing forces, than all that came before it: then these forces hide how
    little the first ones explain, and one after the other would get a name. None has one then."""
    return bool(chosen) and not choice.stage.exact and choice.gain > sum(x.gain for x in chosen)


def _others(choice: Choice, found: Container[str]) -> tuple[EffectEntry, ...]:
    """The rivals of an effect that aren't found beside it."""
    return tuple(e for e in choice.rivals if f"{e.name}@{e.where}" not in found)


def _without(name: str, stage: Stage) -> Stage:
    """A stage's model without one of its effects, fitted. Raises NotConverged."""
    rest = tuple(e for e in stage.machine.effect if f"{e.name}@{e.where}" != name)
    machine = stage.machine.model_copy(update={"effect": rest})
    try:
        return refitted(machine, stage, stage.fit.disturbed)
    except NotConverged:
        return refitted(machine, stage, max(stage.fit.disturbed, SMALL))


def _scores(stage: Stage, together: Together) -> tuple[evidence.Score, ...]:
    """What every effect that a model does not have promises, best first."""
    known = [e.name for e in stage.model.effects]
    sensors = [s.name for s in stage.prepared.c.sensors]
    return _scanned(stage, evidence.candidates(stage.machine, sensors, _duration(stage.prepared.logs), known), together)


def _scanned(stage: Stage, found: Sequence[evidence.Candidate], together: Together) -> tuple[evidence.Score, ...]:
    return evidence.scan(stage.prepared.c, stage.prepared.records, stage.fit, found, together)


def _odd(stage: Stage) -> tuple[str, ...]:
    """What is left beside noise, a line each: innovations that are too large, and what stands out in them."""
    stage = as_measured(stage)
    found = [
        a
        for k, log in enumerate(stage.prepared.logs)
        for a in anomalies(stage.machine, stage.prepared.c.sensors, log, stage.fit, k)
    ]
    return tuple(dict.fromkeys([*stage.suspects, *map(str, found)]))


@dataclass(frozen=True)
class Choice:
    """An effect that was added, the model with it, and the rivals that the log likes about as well.

    gain: of twice the log-likelihood (Wald's statistic where no model without it could be fitted), which what is left
    of the misfit makes `spread` times less sure. left: the share of the effect that parameters don't absorb. loose: the
    model with it and the disturbing forces that it was judged with, where it needs none.
    """

    name: str
    stage: Stage
    gain: float
    spread: float
    tried: int
    rivals: tuple[EffectEntry, ...]
    left: float
    loose: Stage | None = None


def _share(gained: float, stage: Stage, odd: Sequence[str]) -> float:
    """Of the misfit, how much effects explain that gained so much, by what is left of it in a stage and what is odd."""
    left = max(stage.excess, ODD * len(odd))
    return gained / (gained + left) if gained + left > 0 else 0.0


def _duration(logs: Sequence[Log]) -> float:
    return max(float(log.t[-1] - log.t[0]) for log in logs)


def _entry(score: evidence.Score) -> EffectEntry:
    """A candidate as an entry of the machine file: where a fit begins."""
    e, values = score.candidate.placed, dict(score.values)
    amount = values.pop("A")
    if len(e.effect.grid) > 1:
        # Not proportional to the amount: no further from the grid's value than the signature holds.
        step = float(np.clip(amount / e.values["A"], 0.3, 2.0))
        amount = e.values["A"] / step if e.effect.inverse else e.values["A"] * step
    return _identified(e.effect.name, e.where, amount, {n: round(v, 12) for n, v in values.items()})


def _fitted(stage: Stage, name: str) -> EffectEntry:
    """An effect with amount and shapes as a stage's fit has them."""
    placed = stage.placed(name)
    fitted = dict(zip(stage.model.base.names, stage.fit.X, strict=True))
    values = {key: float(fitted.get(p, placed.values[key])) for p, (key, _) in placed.parameters.items()}
    return _identified(placed.effect.name, placed.where, values.pop("A"), values)


def _identified(effect: str, where: str, amount: float, shapes: Mapping[str, float]) -> EffectEntry:
    def told(value: float) -> Quantity:
        return Quantity(value=value if abs(value) > TINY else 0.0, source="identified")

    return EffectEntry(
        name=effect, where=where, amount=told(amount), shape={name: told(x) for name, x in shapes.items()}
    )


def _shortlist(stage: Stage, scores: Sequence[evidence.Score], chosen: Sequence[Choice]) -> list[evidence.Score]:
    """The best candidate of each name, best first, as far as worth a fit; another variant where it scores alike."""
    best: dict[tuple[str, ...], evidence.Score] = {}
    most: dict[str, float] = {}
    hope = max(WORTH, HOPE[stage.rough] * scores[0].gain) if scores else 0.0
    for s in scores:
        least = _least(stage, chosen, s.candidate) / OVER if stage.settled else 0.0
        worth = s.gain >= max(least, hope) and s.values["A"] != 0
        if worth and s.gain >= LIKE * most.setdefault(s.candidate.name, s.gain):
            best.setdefault(s.candidate.variant, s)
    return list(best.values())[:TRIED]


_Try = tuple[evidence.Score, Stage]


def _likely(
    stage: Stage, scores: Sequence[evidence.Score], chosen: Sequence[Choice], together: Together
) -> list[evidence.Score]:
    """What is worth a fit, with shapes between the grid's points."""
    likely = _shortlist(stage, scores, chosen)
    for reach in CLOSER if likely else ():
        nearby = evidence.finer(likely, stage.machine, _duration(stage.prepared.logs), reach)
        if len(nearby) > len(likely):
            likely = _shortlist(
                stage, sorted([*likely, *_scanned(stage, nearby, together)], key=lambda s: -s.gain), chosen
            )
    return likely


def _choose(
    stage: Stage,
    scores: Sequence[evidence.Score],
    chosen: Sequence[Choice],
    together: Together,
    tell: Advance,
    done: float,
) -> Choice | None:
    """The effect that the logs like best beside those that were chosen; None if none is worth it."""
    likely = _likely(stage, scores, chosen, together)
    if not likely:
        return None
    tries = _tries(stage, likely, together, lambda k: tell(done + 0.03 * k, f"fitting {likely[k].candidate.name}"))
    if stage.exact and likely[0].candidate.name not in {s.candidate.name for s, _ in tries}:
        # Exact dynamics find no way to the likeliest cause: all are judged with disturbing forces instead.
        try:
            stage = refitted(stage.machine, stage, SMALL)
        except NotConverged:
            return None
        found = evidence.renumbered([s.candidate for s in likely])
        likely = _shortlist(stage, _scanned(stage, found, together), chosen)
        if not likely:
            return None
        tries = _tries(stage, likely, together, lambda k: None)
    if not tries:
        return None
    score, best = tries[0]
    gain = stage.fit.cost - best.fit.cost
    if gain < max(LEVEL * best.spread, _least(stage, chosen, score.candidate)):
        return None
    return _chosen(_close(tries, gain), gain, len(scores), together)


def _chosen(tries: Sequence[_Try], gain: float, tried: int, together: Together) -> Choice:
    """The best of close tries without disturbing forces where that can be, and the rest as its rivals: those as well
    that only with such forces are known to be as good."""
    spread = tries[0][1].spread
    judged = {s.candidate.name: stage for s, stage in tries if not stage.exact}
    exact, unknown = _without_forces(tries, together)
    tries = [*_close(exact, gain, SHAPE[0] if judged else SHAPE[1]), *unknown] if exact else tries
    score, best = tries[0]
    rivals = tuple(_fitted(other, s.candidate.name) for s, other in tries[1:])
    loose = judged.get(score.candidate.name) if best.exact else None
    return Choice(score.candidate.name, best, gain, spread, tried, rivals, score.left, loose)


def _sharp(stage: Stage, together: Together) -> tuple[Stage, list[Choice]] | None:
    """Where the model follows the logs with coarse sensors only: the effect with which it follows them with sensors as
    they are, and the stage without. Coarse sensors leave of a misfit what shows its cause, and are followed by what is
    nearly right. No effect where the model does without after all, None where nothing comes near."""
    plain = next(sharpened([stage], 0.0, together))
    if plain is not None and plain.near:
        return plain, []
    scores = _scores(stage, together)
    tries = _tries(stage, _likely(stage, scores, (), together), together, lambda k: None)
    if not tries:
        return None
    _, best = tries[0]
    gain = stage.fit.cost - best.fit.cost
    if gain < max(LEVEL * best.spread, LEAST[1] * stage.excess):
        return None
    alike = [x for x in tries if stage.fit.cost - x[1].fit.cost >= LIKE * gain]
    for disturbed in (0.0, smoothing.DISTURBED[0]) if gain >= SHARE * (gain + best.excess) else (0.0,):
        sharp = zip(alike, sharpened([x for _, x in alike], disturbed, together), strict=True)
        near = _one_each([(score, x) for (score, _), x in sharp if x is not None and x.near])
        if near:
            score, best = near[0]
            sure = _wald(score.candidate.name, best)  # of the same kind as a gain, and smaller where that is large
            if sure < LEVEL * best.spread:
                return None
            # Far from no effect Wald's statistic says too much, and further effects are measured by it.
            sure = min(sure, stage.prepared.coarse * gain)
            return stage, [_chosen(_close(near, sure), sure, len(scores), together)]
    return None


def _unfollowed(stage: Stage, together: Together) -> tuple[Stage, list[Choice]]:
    """Where no fit was found: the effect with which the model can follow the logs, with as small disturbing forces as
    there is one. With it there may be a fit without it after all, which then is what it is compared with, and may be as
    good: the model began too far off. The stage as it was and no effect where nothing helps."""
    scores = _scores(stage, together)
    likely = _likely(stage, scores, (), together)
    machines = [placing.extended(stage.machine, _entry(s)) for s in likely]
    for disturbed in (0.0, smoothing.DISTURBED[0], smoothing.DISTURBED[-1]) if likely else ():
        found = begun(machines, stage, disturbed, together)
        near = [(s, x) for s, x in zip(likely, found, strict=True) if x is not None and x.near]
        if not near:
            continue
        tries = _one_each(near)
        score, best = tries[0]
        tries = [x for x in tries if x[1].fit.disturbed == best.fit.disturbed]
        try:
            stage = refitted(stage.machine, best, best.fit.disturbed)
            gain = stage.fit.cost - best.fit.cost
        except NotConverged:
            gain = _wald(score.candidate.name, best)  # of the same kind, and smaller where much is gained
        if gain < LEVEL * best.spread:
            return exact_if_near(stage), []
        return stage, [_chosen(_close(tries, gain), gain, len(scores), together)]
    return stage, []


def _least(stage: Stage, chosen: Sequence[Choice], candidate: evidence.Candidate) -> float:
    """What an effect must gain to be worth a place beside those that were chosen."""
    part = max(SHAPE[0], TIMED * candidate.placed.effect.timed, HIDDEN * (not stage.exact))
    shape = sum(max(part, min(ALIKE**2 / x.left, ABSORBED)) * x.gain for x in chosen)
    return max(LEAST[stage.rough] * stage.excess, shape, min(SHAPE[1] * _sureness(stage), BESIDE))


def _tries(
    stage: Stage, likely: Sequence[evidence.Score], together: Together, tell: Callable[[int], None]
) -> list[_Try]:
    """The candidates whose fits were found, as the model without them was fitted. Those that promise far less than the
    best come last, and only where they may still come near what was gained."""
    tries: list[_Try] = []
    near = max(PAIR, sum(OVER * s.gain >= likely[0].gain for s in likely))
    for at, batch in ((0, likely[:near]), (near, likely[near:])):
        gained = max((stage.fit.cost - found.fit.cost for _, found in tries), default=0.0)
        if not batch or gained > OVER * batch[0].gain:
            break
        wishes = [(placing.extended(stage.machine, _entry(s)), stage, stage.fit.disturbed) for s in batch]
        tell(at)
        for k, (score, found) in enumerate(zip(batch, refits(wishes, together), strict=True)):
            tell(min(at + k + 1, len(likely) - 1))
            if found is not None:
                tries.append((score, found))
    return _one_each(tries)


def _one_each(tries: Sequence[_Try]) -> list[_Try]:
    """The best variant of each name, best first: with as small disturbing forces as can be."""
    best: dict[str, _Try] = {}
    for x in sorted(tries, key=lambda x: (x[1].fit.disturbed, x[1].fit.cost)):
        best.setdefault(x[0].candidate.name, x)
    return list(best.values())


def _close(tries: Sequence[_Try], gain: float, share: float | None = None) -> list[_Try]:
    """The best of sorted tries and those that the logs like about as well: no difference counts that is a matter of the
    formula, of an effect that gains so much. share: of the gain that is, the more where forces had to help."""
    best = tries[0][1]
    share = share or (SHAPE[1] if best.exact else FORCED)
    near = max(CLOSE * best.spread, NEAR * best.excess, share * gain)
    return [x for x in tries if x[1].fit.cost - best.fit.cost < near]


def _without_forces(tries: Sequence[_Try], together: Together) -> tuple[list[_Try], list[_Try]]:
    """Those that need no disturbing forces any more, best first, and as they are those for which no such fit is found;
    what forces leave far off is neither."""
    good = [x for x in tries if x[1].exact or x[1].near]
    without = freed([s for _, s in good if not s.exact], together)
    found = [(x, x[1] if x[1].exact else next(without)) for x in good]
    exact = [(score, stage) for (score, _), stage in found if stage is not None]
    return sorted(exact, key=lambda x: x[1].fit.cost), [x for x, stage in found if stage is None]


def _verdict(
    before: Stage,
    after: Stage,
    chosen: Sequence[Choice],
    odd: tuple[str, ...],
    left: float,
) -> Diagnosis:
    """The verdict: what is named must explain most of the misfit, and what is left must be noise or be shown. left:
    what a further effect would gain that was not worth a name."""
    findings = tuple(_finding(x, after, left) for x in chosen)
    share = 1.0
    if odd or not after.exact:
        share = _share(sum(x.gain for x in chosen), after, odd)
    verdict = "clean"
    if findings:
        verdict = "tied" if any(f.tied_with for f in findings) else "named"
    if not after.settled or (odd and (share < SHARE or not findings)) or (not after.exact and not findings):
        verdict = "unexplained"
    return Diagnosis(verdict, findings, before, after, share, odd, tuple(x.stage for x in chosen))


def _finding(choice: Choice, after: Stage, left: float) -> Finding:
    """A choice with amount and shapes as the last fit has them. The amount is as unsure as what is left says of the
    formula: where that is a part of what the effect gains, about half its root is a part of the amount; and never surer
    than another formula of the same effect would leave it."""
    placed = after.placed(choice.name)
    std = after.fit.std * after.doubt
    values = dict(zip(after.model.base.names, zip(after.fit.X, std, strict=True), strict=True))
    amount, sure = values[placed.name]
    sure = float(np.linalg.norm([sure, ALIKE * amount, FORMULA * amount * np.sqrt(left / max(choice.gain, left, 1.0))]))
    shapes = {
        s: (*values.get(f"{placed.name}.{s}", (placed.values[s], 0.0)), shape.unit)
        for s, shape in placed.effect.shapes.items()
    }
    added = sum(n == placed.name or n.startswith(placed.name + ".") for n in after.model.base.names)
    gain = choice.gain / choice.spread
    p = min(1.0, choice.tried * float(scipy.stats.chi2.sf(gain, added)))
    return Finding(
        placed.effect.name,
        placed.where,
        choice.rivals,
        p,
        float(amount),
        float(sure),
        placed.effect.unit,
        shapes,
        gain,
    )
