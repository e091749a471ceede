"""What a simulation gets wrong, why, and what mending it gains.

A log is smoothed with the machine's model. Where the innovations hold more than noise, every effect of the catalogue is
scored (`evidence`), the best are fitted with amount and shapes as parameters, and the one that the log likes best is
added to the model; then again, until nothing is left or nothing in the catalogue helps. Names that the log likes as
well are given together. What no name explains, or only four together, is said to be unexplained. Where the model
without effects can be fitted to much coarser sensors only, the first effect, or two that only together do, are found
with these and the fit sharpened with them; where not even that, effects are scored along the file's parameters and
fitted from the logs' beginning; so are those that promise less where nothing explains the logs.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite.diagnosis import hold_out as gains, magnitude_interval, selection
from excite.diagnosis.fits import SMALL, Stage, as_measured, fitted, forced, refitted
from excite.diagnosis.parallel import Together, in_turn
from excite.diagnosis.residual_tests import anomalies
from excite.diagnosis.score_test import Score
from excite.diagnosis.selection import Advance, Choice
from excite.logs import Log
from excite.model import Model, effects
from excite.model.machine import EffectEntry, Filter
from excite.smoothing import NotConvergedError

MOST = 4  # effects that are looked for; so many kinds, none of which explains MOSTLY, patch up what has no name
MOSTLY = 0.7  # of the misfit
FORMULA = 0.5  # of an amount, times the root of the share of a gain that its formula leaves to others
# Of an amount: what another formula of the same effect makes of it. ALIKE is what it does in the middle; nine in ten of
# the amounts in results/diagnosis are within intervals that allow for so much.
OTHERWISE = 0.05
# Of the excess misfit that names must explain, or it is unexplained: what nature has beside its formula looks like many
# a cause. Right names of results/diagnosis explain 0.85 and more, a slope that liquid in a tank was taken for 0.83.
ENOUGH = 0.85
FAINT = 0.1  # of what another effect promises beside a name, that the name must gain where it needs disturbing forces
ODD = 50.0  # misfit that every line of what is odd beside names stands for, at least


@dataclass(frozen=True)
class Finding:
    """A named cause. gain: of twice the log-likelihood; p_value: that of no effect at all beside the others, for all
    that were tried; rivals: what it is tied with, as the logs have it."""

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
        return tuple(e.label for e in self.rivals)

    @property
    def entry(self) -> EffectEntry:
        """As a machine file has it."""
        return selection.identified(
            self.effect, self.where, self.amount, {n: value for n, (value, _, _) in self.shapes.items()}
        )


@dataclass(frozen=True)
class Nearest:
    """An effect that explains a share of the misfit and is no name, and the parameters that with it would have a value
    that no machine has, a line each."""

    name: str
    share: float
    impossible: tuple[str, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """verdict: clean, named, tied or unexplained. `before`, `after`: the model without and with what was found.

    share: of the excess misfit that the names explain. located: lines that say where what is unexplained sits. stages:
    the model with the first finding, the first two, and so on. nearest: where nothing is named, the effect that
    explains most.
    """

    verdict: str
    findings: tuple[Finding, ...]
    before: Stage
    after: Stage
    share: float
    located: tuple[str, ...]
    stages: tuple[Stage, ...]
    nearest: Nearest | None = None


def diagnose(
    model: Model, logs: Sequence[Log], filter: Filter, advance: Advance | None = None, together: Together = in_turn
) -> Diagnosis:
    """What these logs show that the model doesn't know. together: how what is independent is computed; the answer is
    the same. Raises NotConverged where the machine file's parameters give no motion at all, NotIdentifiable where a
    torque is missing."""
    tell = advance or (lambda share, what: None)
    tell(0.0, "fitting the model")
    first = before = fitted(model.machine, logs, filter, together)
    chosen = list[Choice]()
    if before.prepared.coarse > 1:
        tell(0.15, "fitting effects with coarse sensors")
        sharp = selection.sharp(before, together)
        before, chosen = sharp or (forced(before, together), chosen)
    tried: Container[str] = ()
    if not (before.settled or chosen):
        tell(0.15, "fitting effects from the beginning")
        before, chosen, tried = selection.unfollowed(before, together)
    chosen, left = extended(before, chosen, together, tell)
    chosen, odd, nearest = weighed(before, chosen, left)
    if not (chosen or (before.exact and before.near)):  # a fit with coarse sensors has forces, too
        tell(0.85, "fitting less likely effects from the beginning")
        old = before if before.prepared.coarse == 1 else forced(before, together)
        before, anew = selection.unlikely(first, old, tried if old is first else (), together)
        if anew or before is not old:
            anew, left = extended(before, anew, together, lambda share, what: tell(max(share, 0.85), what))
            nearest = None if before is not old else nearest
        chosen, odd, closer = weighed(before, anew, left)
        nearest = closer or nearest
    if len(chosen) > 1:
        tell(0.9, "judging each given the others")
        chosen, odd, nearest = weighed(before, needed(before, reviewed(before, chosen, together)), left)
    if (largest := _patched(chosen, odd)) is not None:
        chosen, odd, nearest = [], _odd(before), largest
    stage = chosen[-1].stage if chosen else before
    return concluded(before, stage, chosen, odd, left, nearest, together)


def extended(before: Stage, first: Sequence[Choice], together: Together, tell: Advance) -> tuple[list[Choice], float]:
    """Effects one after the other, after those that were chosen first, until nothing is left that has a name; and what
    a further one would gain that was not worth one."""
    chosen, stage, left = list(first), first[-1].stage if first else before, 0.0
    while stage.settled and len(chosen) < MOST and not stage.vain:
        turn = len(chosen)
        tell(0.15 + 0.2 * turn, "scoring effects")
        scores = selection.scored(stage, together)
        hopeless = _hopeless(before, chosen, scores)
        choice = None if hopeless else selection.choose(stage, scores, chosen, together, tell, 0.2 + 0.2 * turn)
        if choice is not None and before.settled and _outgrows(choice, chosen):
            return [], 0.0
        if choice is None or _makes_good(choice, chosen):
            left = max(0.0, scores[0].gain - selection.LEVEL) if scores else 0.0
            break
        chosen.append(choice)
        stage = choice.stage
    return chosen, left


def _hopeless(before: Stage, chosen: Sequence[Choice], scores: Sequence[Score]) -> bool:
    """Whether effects leave more than all that may still come beside them would explain, and the last of them has no
    name as it is: then nothing gives it one."""
    if not (chosen and chosen[-1].stage.exact):
        return False
    stage = chosen[-1].stage
    gained = sum(x.gain for x in chosen)
    most = (MOST - len(chosen)) * selection.OVER * max((s.gain for s in scores), default=0.0)
    too_little = gained + min(most, stage.excess) < ENOUGH * (gained + stage.excess)
    return too_little and len(weighed(before, chosen)[0]) < len(chosen)


def weighed(
    before: Stage, chosen: Sequence[Choice], left: float = 0.0
) -> tuple[list[Choice], tuple[str, ...], Nearest | None]:
    """Effects without the last ones that are no names: one that leaves most of the misfit where it was is none, unless
    with what came after it nothing is left, or with the disturbing forces that it was judged with, which may have left
    nothing without it as well: it must not be faint beside what another one would gain, left; nor is one with which no
    machine is possible. Also what is odd beside those that stay, and the last one that doesn't."""
    kept, nearest = list(chosen), None
    while True:
        stage = kept[-1].stage if kept else before
        odd = _odd(stage)
        impossible = stage.impossible if kept and stage.settled else ()
        if not kept or (stage.exact and not odd and not impossible):
            break
        explained = _share(kept[-1].gain, stage, odd)
        if explained >= ENOUGH and not impossible:
            break
        loose = kept[-1].loose
        faint = kept[-1].gain < FAINT * left
        if (
            loose is not None
            and not (impossible or faint)
            and _share(kept[-1].gain, loose, odd_loose := _odd(loose)) >= ENOUGH
        ):
            # Exact dynamics make a large misfit of a formula that is nearly right; it was judged with forces.
            kept[-1], odd = replace(kept[-1], stage=loose), odd_loose
            break
        nearest = Nearest(kept.pop().name, explained, impossible)
    return kept, odd, nearest


def _patched(chosen: Sequence[Choice], odd: Sequence[str]) -> Nearest | None:
    """The effect that gains most of so many kinds that they only patch up what has no name; None where they don't."""
    if len({x.name.split("@")[0] for x in chosen}) < MOST:
        return None
    most, gained = max(chosen, key=lambda x: x.gain), sum(x.gain for x in chosen)
    share = _share(gained, chosen[-1].stage, odd) * most.gain / gained
    return Nearest(most.name, share) if share < MOSTLY else None


def reviewed(before: Stage, chosen: Sequence[Choice], together: Together = in_turn) -> list[Choice]:
    """Each of several effects again, given all that came after it as well, so that their order doesn't count: one that
    the others make good for is dropped, one that another name suits better gets that name, rivals are those beside the
    others. What came first stays where nothing better was found."""
    queue, found = list(chosen), chosen[-1].stage
    for first in chosen[:-1]:
        rest, whole = queue[1:], queue[-1].stage
        try:
            stage = _without(first.name, whole)
        except NotConvergedError:
            queue = [*rest, replace(first, stage=whole, loose=None)]  # nothing fits without it
            continue
        choice = selection.choose(
            stage, selection.scored(stage, together), rest, together, lambda share, what: None, 0.0
        )
        queue = [*rest, choice] if choice is not None else [*rest[:-1], replace(rest[-1], stage=stage, loose=None)]
    whole, judged = queue[-1].stage, {x.name: x for x in queue}
    same = judged.keys() == {x.name for x in chosen}
    worse = whole.fit.cost - found.fit.cost > selection.LEVEL * found.spread
    if same or worse or whole.fit.process_noise > found.fit.process_noise:
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
            machine = effects.with_effects(made[-1].machine, selection.entry_of(whole, x.name))
            made.append(refitted(machine, made[-1], before.fit.process_noise))
        made[-1] = made[-1] if whole.fit.process_noise == before.fit.process_noise else whole
    except NotConvergedError:
        return []
    found = []
    for x, old, new in zip(chosen, made, made[1:], strict=False):
        alike = old.settled and old.fit.process_noise == new.fit.process_noise
        gain = old.fit.cost - new.fit.cost if alike else x.gain
        found.append(replace(x, stage=new, gain=max(gain, x.gain), loose=None))
    return found


def _one_from_another(chosen: Sequence[Choice], whole: Stage) -> list[Choice]:
    """The same from the model with all of them, where the one without any follows coarse sensors only."""
    made = [whole]
    try:
        for x in reversed(chosen[1:]):
            made.append(_without(x.name, made[-1]))
    except NotConvergedError:
        return []
    return [replace(x, stage=stage, loose=None) for x, stage in zip(chosen, reversed(made), strict=True)]


def needed(before: Stage, chosen: Sequence[Choice]) -> list[Choice]:
    """Several effects without those that were needed on the way only: in the last fit their amount is hardly known to
    be any, and without it the fit is as good, or foretells as much of what it hasn't seen: then it is shapes that
    follow the noise. Disturbing forces hide what else a right name explains."""
    kept, whole = list(chosen), chosen[-1].stage
    for x in chosen:
        # Of one that is nothing at infinity the amount's deviation says little.
        doubtful = whole.exact and whole.placed(x.name).effect.inverse
        if len(kept) == 1 or (_surely(x.name, whole) and not doubtful):
            continue
        beside = np.inf  # nothing fits without it
        with suppress(NotConvergedError):
            without = _without(x.name, whole)
            if without.fit.process_noise <= whole.fit.process_noise:
                beside = without.fit.cost - whole.fit.cost
        proven = whole.placed(x.name).effect.inverse or np.isinf(beside)
        if beside < selection.threshold(x.name, whole, x.tried) or not (proven or _foretells(without, whole)):
            kept, whole = [y for y in kept if y.name != x.name], without
        else:
            kept = [replace(y, beside=beside) if y.name == x.name else y for y in kept]
    if len(kept) == len(chosen):
        return kept
    return _one_by_one(before, kept, whole) or [replace(x, stage=whole, loose=None) for x in kept]


def _foretells(without: Stage, whole: Stage) -> bool:
    """Whether a stage errs less than one without an effect on stretches that were hidden from both, if any can be."""
    found = gains.gain(gains.withheld(without), gains.withheld(whole))
    return found is None or found.percent > 0


def _surely(name: str, stage: Stage) -> bool:
    """Whether an effect is surely any in a fit; one that is nothing at infinity is taken for sure."""
    return stage.placed(name).effect.inverse or selection.wald(name, stage) > selection.LEVEL


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
    return tuple(e for e in choice.rivals if e.label not in found)


def _without(name: str, stage: Stage) -> Stage:
    """A stage's model without one of its effects, fitted. Raises NotConverged."""
    machine = effects.without_effect(stage.machine, name)
    try:
        return refitted(machine, stage, stage.fit.process_noise)
    except NotConvergedError:
        return refitted(machine, stage, max(stage.fit.process_noise, SMALL))


def _odd(stage: Stage) -> tuple[str, ...]:
    """What is left beside noise, a line each: innovations that are too large, and what stands out in them, the most
    striking first."""
    stage = as_measured(stage)
    logs = stage.prepared.logs
    found = [
        (f"{log.source}: {a}" if len(logs) > 1 else str(a), a.size)
        for k, log in enumerate(logs)
        for a in anomalies(stage.machine, stage.prepared.c.sensors, log, stage.fit, k)
    ]
    return tuple(dict.fromkeys([*stage.suspects, *(line for line, _ in sorted(found, key=lambda x: -x[1]))]))


def _share(gained: float, stage: Stage, odd: Sequence[str]) -> float:
    """Of the misfit, how much effects explain that gained so much, by what is left of it in a stage and what is odd."""
    left = _rest(stage, odd)
    return gained / (gained + left) if gained + left > 0 else 0.0


def _rest(stage: Stage, odd: Sequence[str]) -> float:
    """The misfit that is left in a stage."""
    return max(stage.excess, ODD * len(odd))


def concluded(
    before: Stage,
    after: Stage,
    chosen: Sequence[Choice],
    odd: tuple[str, ...],
    left: float,
    nearest: Nearest | None = None,
    together: Together = in_turn,
) -> Diagnosis:
    """The verdict: what is named must explain most of the misfit, and what is left must be noise or be shown; where
    something explains it and is no name, it is unexplained. left: what a further effect would gain that was not worth a
    name."""
    share = 1.0
    if odd or not after.exact:
        share = _share(sum(x.gain for x in chosen), after, odd)
        left = max(left, _rest(after, odd))
    findings = tuple(_finding(x, after, left, len(chosen) == 1, together) for x in chosen)
    nearest = None if findings else nearest
    verdict = "clean"
    if findings:
        verdict = "tied" if any(f.tied_with for f in findings) else "named"
    if not after.settled or (odd and (share < ENOUGH or not findings)) or (not after.exact and not findings):
        verdict = "unexplained"
    if nearest is not None:
        verdict, share = "unexplained", 0.0
    stages = tuple(x.stage for x in chosen)
    return Diagnosis(verdict, findings, before, after, share, odd, stages, nearest)


def opposite(phase: float) -> float:
    """The phase [rad] half a turn on, from -pi to pi: an effect with it is the same as one with the amount negative."""
    return float(np.angle(-np.exp(1j * phase)))


def _beside(choice: Choice, after: Stage) -> float:
    """What an effect gains given all the others of the last fit: as it was measured, or Wald's statistic, which needs
    no fit without it. No less than any gain for one that is nothing at infinity."""
    if choice.beside is not None:
        return choice.beside / choice.spread
    if after.placed(choice.name).effect.inverse:
        return np.inf
    return selection.wald(choice.name, after) / choice.spread


def _finding(choice: Choice, after: Stage, left: float, alone: bool, together: Together = in_turn) -> Finding:
    """A choice with amount and shapes as the last fit has them. The amount is as unsure as what is left says of the
    formula: where that is a part of what the effect gains, about half its root is a part of the amount; as shapes that
    the logs hardly tell; and never surer than another formula of the same effect would leave it."""
    placed = after.placed(choice.name)
    std = after.fit.std * after.doubt
    values = dict(zip(after.model.base.names, zip(after.fit.X, std, strict=True), strict=True))
    amount, sure = values[placed.name]
    formula = FORMULA * amount * np.sqrt(left / max(choice.gain, left, 1.0))
    sure = float(
        np.linalg.norm([sure, OTHERWISE * amount, formula, magnitude_interval.unsure(placed, after, together)])
    )
    shapes = {
        s: (*values.get(f"{placed.name}.{s}", (placed.values[s], 0.0)), shape.unit)
        for s, shape in placed.shapes.items()
    }
    if amount < 0 and (circular := [s for s, shape in placed.shapes.items() if shape.circular]):
        # The same half a turn on.
        amount = -amount
        for s in circular:
            shapes[s] = (opposite(shapes[s][0]), *shapes[s][1:])
    gain = choice.gain / choice.spread
    told = gain if alone else min(gain, _beside(choice, after))  # the gain of one of several is that on the way to them
    p = min(1.0, choice.tried * float(scipy.stats.chi2.sf(told, selection.freedom(choice.name, after))))
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
