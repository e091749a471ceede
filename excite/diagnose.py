"""What a simulation gets wrong, why, and what mending it gains.

A log is smoothed with the machine's model. Where the innovations hold more than noise, every effect of the catalogue is
scored (`evidence`), the best are fitted with amount and shapes as parameters, and the one that the log likes best is
added to the model; then again, until nothing is left or nothing in the catalogue helps. Names that the log likes as
well are given together. What no name explains is said to be unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite import evidence, hidden, smoothing
from excite.anomaly import anomalies
from excite.linearise import Chart, chart
from excite.log import Log
from excite.record import Point, Record, carried, common_sensors, first_point, origins, record
from excite.smoothing import Fit, NotConverged
from model import effects
from model.machine import EffectEntry, Filter, Machine, Quantity
from model.prediction import Model, build

LEVEL = 22.0  # of twice the log-likelihood that an effect must gain; logs without any stayed below 16
WORTH = 15.0  # a first-order gain below which a candidate isn't fitted
HOPE = 0.4, 0.15  # share of the best first-order gain below which a candidate isn't fitted: weak misfit, strong misfit
STRONG = 1.3  # misfit over readings from which first-order gains are rough
PASSES = 14  # of a candidate's fit
NEARLY = 1.0  # step, in standard deviations, at which a fit that runs out of passes is as good as found
TRIED = 5  # candidates that are fitted, of different names
ROUGHLY = 2  # the same where not even the model without them was fitted
MOST = 4  # effects that are looked for
CLOSE = 10.0  # a rival that is worse by less than this is a tie
SLACK = 0.02  # of the readings, by which the misfit of a right model scatters and noise levels are off
SHAPE = 0.005  # of what is explained already, that a further effect must gain: nature is never exactly the formula
CLOSER = 1.0, 0.35  # way to the grid's next points within which the best candidates are tried again, in turn
LEAST = 0.05  # of the excess misfit that an effect must explain to be worth a place
SHARE = 0.6  # of the excess misfit that names must explain, or it is unexplained
NEAR = 0.3  # of what the best name leaves unexplained, by which a rival may be worse and still is a tie

Advance = Callable[[float, str], None]


@dataclass(frozen=True)
class Prepared:
    """Logs made ready for a model: chart, records, first guesses, parameters that they don't show."""

    c: Chart
    logs: tuple[Log, ...]
    records: tuple[Record, ...]
    starts: tuple[Point, ...]
    held: np.ndarray

    @property
    def readings(self) -> float:
        """How many readings the logs have: what twice the negative log-likelihood of a right model is about."""
        return float(sum(r.used.sum() for r in self.records))


@dataclass(frozen=True)
class Stage:
    """A model with the effects found so far, fitted. `exact`: without disturbing forces. Not `settled`: no fit was
    found that the log agrees to, this is how far it came."""

    machine: Machine
    prepared: Prepared
    fit: Fit
    settled: bool = True

    @property
    def model(self) -> Model:
        return self.prepared.c.model

    @property
    def exact(self) -> bool:
        return self.fit.disturbed == 0

    @property
    def excess(self) -> float:
        """How much more misfit there is than noise may make."""
        return max(0.0, self.fit.cost - (1 + SLACK) * self.prepared.readings)

    @property
    def suspects(self) -> list[str]:
        return smoothing.suspects(self.prepared.c, self.prepared.logs, self.fit)


@dataclass(frozen=True)
class Finding:
    """A named cause. gain: of twice the log-likelihood; p_value: that of no effect at all, for all that were tried."""

    effect: str
    where: str
    tied_with: tuple[str, ...]
    p_value: float
    amount: float
    amount_std: float
    unit: str
    shapes: Mapping[str, tuple[float, float, str]]
    gain: float

    @property
    def name(self) -> str:
        return f"{self.effect}@{self.where}"


@dataclass(frozen=True)
class Diagnosis:
    """verdict: clean, named, tied or unexplained. `before`, `after`: the model without and with what was found.

    share: of the excess misfit that the names explain. scores: the first scan's, best first. located: lines that say
    where what is unexplained sits. stages: the model with the first finding, the first two, and so on.
    """

    verdict: str
    findings: tuple[Finding, ...]
    before: Stage
    after: Stage
    share: float
    scores: tuple[evidence.Score, ...]
    located: tuple[str, ...]
    stages: tuple[Stage, ...]


def diagnose(model: Model, logs: Sequence[Log], filter: Filter, advance: Advance | None = None) -> Diagnosis:
    """What these logs show that the model doesn't know. Raises NotConverged where not even disturbing forces let the
    model follow a log, NotIdentifiable where a torque is missing."""
    tell = advance or (lambda share, what: None)
    tell(0.0, "fitting the model")
    before = fitted(model.machine, logs, filter)
    stage, chosen, first = before, list[_Choice](), tuple[evidence.Score, ...]()
    for turn in range(MOST):
        tell(0.15 + 0.2 * turn, "scoring effects")
        known = [e.name for e in stage.model.effects]
        found = evidence.candidates(model.machine, [s.name for s in stage.prepared.c.sensors], _duration(logs), known)
        scores = evidence.scan(stage.prepared.c, stage.prepared.records, stage.fit, found).scores
        first = first or scores
        explained = sum(x.gain for x in chosen)
        choice = _choose(stage, scores, logs, filter, explained, tell, 0.2 + 0.2 * turn)
        if choice is None:
            break
        chosen.append(choice)
        stage = choice.stage
    tell(0.95, "weighing")
    # A name that leaves most of the misfit where it was is none, unless with what came after it nothing is left.
    odd = _odd(stage)
    while chosen and (odd or not stage.exact) and chosen[-1].gain < SHARE * (chosen[-1].gain + stage.excess):
        chosen.pop()
        stage = chosen[-1].stage if chosen else before
        odd = _odd(stage)
    return _verdict(before, stage, chosen, first, odd)


def _odd(stage: Stage) -> tuple[str, ...]:
    """What is left beside noise, a line each: innovations that are too large, and what stands out in them."""
    found = [
        a
        for k, log in enumerate(stage.prepared.logs)
        for a in anomalies(stage.machine, stage.prepared.c.sensors, log, stage.fit, k)
    ]
    return tuple(dict.fromkeys([*stage.suspects, *map(str, found)]))


@dataclass(frozen=True)
class _Choice:
    """An effect that was added, the model with it, and the rivals that the log likes about as well. gain: of twice the
    log-likelihood, which what is left of the misfit makes `spread` times less sure."""

    name: str
    stage: Stage
    gain: float
    spread: float
    tried: int
    rivals: tuple[str, ...]


def fitted(
    machine: Machine, logs: Sequence[Log], filter: Filter, of: Stage | None = None, loose: bool = False
) -> Stage:
    """A machine's model fitted to logs, with shapes of effects free; from the fit `of` other effects where given.

    With disturbing forces where exact dynamics find no estimate, or `loose`. Raises NotConverged.
    """
    prepared = _prepared(machine, logs, filter, of)
    c, X, points, damping = prepared.c, prepared.c.model.nominal, prepared.starts, smoothing.DAMPING[0]
    passes = smoothing.PASSES
    if of is not None:
        old = dict(zip(of.model.base.names, of.fit.X, strict=True))
        X = np.array([old.get(n, x) for n, x in zip(c.model.base.names, X, strict=True)])
        points = tuple(carried(c, r, p, of.prepared.c, X) for r, p in zip(prepared.records, of.fit.points, strict=True))
        damping, passes = smoothing.RESUMED, PASSES

    def solve(disturbed: float) -> Fit:
        try:
            return smoothing.iterate(
                c, prepared.records, points, X, prepared.starts, disturbed, prepared.held, damping, passes
            )
        except NotConverged as failed:
            if failed.fit is None or failed.step > NEARLY:
                raise
            return failed.fit

    if not loose:
        try:
            return Stage(machine, prepared, solve(0.0))
        except NotConverged:
            if of is not None and of.exact:
                raise
    stood: Fit | None = None
    # A candidate is tried as its model was fitted, a model with more and more disturbing forces.
    levels = smoothing.DISTURBED if of is None or of.exact else (of.fit.disturbed,)
    for disturbed in levels:
        try:
            return Stage(machine, prepared, solve(disturbed))
        except NotConverged as failed:
            stood, trouble = failed.fit or stood, failed
    if stood is None or of is not None:
        raise trouble
    return Stage(machine, prepared, stood, settled=False)


def _prepared(machine: Machine, logs: Sequence[Log], filter: Filter, of: Stage | None) -> Prepared:
    model = build(machine, shapes=True)
    c = chart(model, common_sensors(model, logs))
    if of is None:
        records = tuple(record(c, log) for log in logs)
        starts = tuple(first_point(c, r, log, filter) for r, log in zip(records, logs, strict=True))
        return Prepared(c, tuple(logs), records, starts, hidden.unmoved(model, logs, filter, slow=False))
    records = tuple(replace(r, origin=origins(c, r.counts)) for r in of.prepared.records)
    starts = tuple(
        carried(c, r, p, of.prepared.c, model.nominal) for r, p in zip(records, of.prepared.starts, strict=True)
    )
    held = dict(zip(of.model.base.names, of.prepared.held, strict=True))
    return Prepared(c, tuple(logs), records, starts, np.array([held.get(n, False) for n in model.base.names]))


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
    shapes = {n: Quantity(value=round(v, 12), source="identified") for n, v in values.items()}
    return EffectEntry(
        name=e.effect.name, where=e.where, amount=Quantity(value=amount, source="identified"), shape=shapes
    )


def _shortlist(stage: Stage, scores: Sequence[evidence.Score]) -> list[evidence.Score]:
    """The best candidate of each name, best first, as far as worth a fit."""
    rough = not stage.exact or stage.fit.cost > STRONG * stage.prepared.readings
    best: dict[str, evidence.Score] = {}
    for s in scores:
        if s.gain >= max(WORTH, HOPE[rough] * scores[0].gain) and s.values["A"] != 0:
            best.setdefault(s.candidate.name, s)
    return list(best.values())[: TRIED if stage.settled else ROUGHLY]


def _choose(
    stage: Stage,
    scores: Sequence[evidence.Score],
    logs: Sequence[Log],
    filter: Filter,
    explained: float,
    tell: Advance,
    done: float,
) -> _Choice | None:
    """The effect that the logs like best beside those that are in the model; None if none is worth it. explained: how
    much those in the model have gained."""
    likely = _shortlist(stage, scores)
    if not likely:
        return None
    for reach in CLOSER:
        nearby = evidence.finer(likely, stage.machine, _duration(logs), reach)
        if len(nearby) > len(likely):
            closer = evidence.scan(stage.prepared.c, stage.prepared.records, stage.fit, nearby).scores
            likely = _shortlist(stage, sorted([*likely, *closer], key=lambda s: -s.gain))
    tries = _tries(stage, likely, logs, filter, lambda k: tell(done + 0.03 * k, f"fitting {likely[k].candidate.name}"))
    if stage.exact and likely[0].candidate.name not in {s.candidate.name for s, _ in tries}:
        # Exact dynamics find no way to the likeliest cause: all are judged with disturbing forces instead.
        try:
            stage = fitted(stage.machine, logs, filter, stage, loose=True)
            tries = _tries(stage, likely, logs, filter, lambda k: None)
        except NotConverged:
            return None
    if any(t.exact for _, t in tries):
        tries = [(s, t) for s, t in tries if t.exact]
    if not tries:
        return None
    tries.sort(key=lambda x: x[1].fit.cost)
    score, best = tries[0]
    gain = stage.fit.cost - best.fit.cost if stage.exact == best.exact else score.gain
    spread = max(1.0, best.fit.cost / best.prepared.readings)
    if gain / spread < LEVEL or gain < max(LEAST * stage.excess, SHAPE * explained):
        return None
    near = max(CLOSE * spread, NEAR * best.excess)
    rivals = tuple(s.candidate.name for s, t in tries[1:] if t.fit.cost - best.fit.cost < near)
    names = len({s.candidate.name for s in scores})
    return _Choice(score.candidate.name, best, gain, spread, names, rivals)


def _tries(
    stage: Stage, likely: Sequence[evidence.Score], logs: Sequence[Log], filter: Filter, tell: Callable[[int], None]
) -> list[tuple[evidence.Score, Stage]]:
    """The candidates whose fits were found."""
    tries: list[tuple[evidence.Score, Stage]] = []
    for k, score in enumerate(likely):
        tell(k)
        machine = effects.extended(stage.machine, _entry(score))
        try:
            tries.append((score, fitted(machine, logs, filter, stage)))
        except NotConverged:
            continue
    return tries


def _verdict(
    before: Stage, after: Stage, chosen: Sequence[_Choice], scores: Sequence[evidence.Score], odd: tuple[str, ...]
) -> Diagnosis:
    """The verdict: what is named must explain most of the misfit, and what is left must be noise or be shown."""
    findings = tuple(_finding(x, after) for x in chosen)
    share = 1.0
    if odd or not after.exact:
        gained = sum(x.gain for x in chosen)
        share = gained / (gained + after.excess) if gained + after.excess > 0 else 0.0
    verdict = "clean"
    if findings:
        verdict = "tied" if any(f.tied_with for f in findings) else "named"
    if not after.settled or (odd and (share < SHARE or not findings)) or (not after.exact and not findings):
        verdict = "unexplained"
    return Diagnosis(verdict, findings, before, after, share, tuple(scores), odd, tuple(x.stage for x in chosen))


def _finding(choice: _Choice, after: Stage) -> Finding:
    """A choice with amount and shapes as the last fit has them."""
    placed = next(e for e in after.model.effects if e.name == choice.name)
    values = dict(zip(after.model.base.names, zip(after.fit.X, after.fit.std, strict=True), strict=True))
    amount, std = values[placed.name]
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
        float(std),
        placed.effect.unit,
        shapes,
        gain,
    )
