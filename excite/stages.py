"""A machine's model fitted to logs, and fitted again with other effects.

Exact dynamics come first; where these find no estimate, disturbing forces as small as the logs let them be; where these
don't bring the model near, sensors that are taken to be coarser than they are. Fits that have nothing to do with each
other are computed side by side: what is sent back from there is fits alone, as charts and effects know their code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import Any

import numpy as np

from excite import evidence, hidden, newton, smoothing
from excite.innovations import innovation_sizes
from excite.linearise import Chart, chart
from excite.log import Log
from excite.newton import Fit, NotConverged
from excite.record import Point, Record, carried, common_sensors, first_point, origins, record
from excite.sidebyside import Together, ahead, in_turn
from model.effect import Placed
from model.machine import Filter, Machine
from model.prediction import Model, build, signs

NEARER = 100.0  # of a cost, by which what was not found comes nearer to logs that are near already
FOLLOWED = 2.5  # misfit over readings up to which exact dynamics follow logs where nothing else does
FAR = 10.0  # misfit over readings, a few passes after the beginning, from which no fit comes near
SLACK = 0.02  # of the readings, by which the misfit of a right model scatters and noise levels are off
SURELY, WRONG = 3.0, 0.5  # deviations, and a share of its usual size, by which a parameter's sign is wrong
PASSES = 14  # of a fit that goes on from another
SHORTEST = 30.0  # [s] that the beginning of a log has at least
# Passes after which an effect that leaves as much as the model without it, but for a share, is known to do nothing.
BRIEF, SAME = 2, 0.1
ONSETS = 0.25, 0.33, 0.4, 0.5  # shares of logs that are taken for their beginning, in turn
TELLING = 0.15  # of what exact dynamics leave, that is as much as a beginning must hold of it
LENIENT = 0.5  # of what a fit must take, that it must take of what is left of the beginning
COARSE = 10.0, 30.0  # times their noise that sensors are taken to have where nothing follows the logs, in turn
LESS = 0.1, 0.3  # disturbing forces that are tried next where a model needs any, as shares of those it was fitted with
SMALL = LESS[0] * smoothing.DISTURBED[0]  # the smallest that are tried


@dataclass(frozen=True)
class Prepared:
    """Logs made ready for a model: chart, records, first guesses, parameters that they don't show."""

    c: Chart
    logs: tuple[Log, ...]
    records: tuple[Record, ...]
    starts: tuple[Point, ...]
    held: np.ndarray

    @property
    def coarse(self) -> float:
        """How many times as noisy as they are sensors are taken to be."""
        return self.records[0].coarse

    @property
    def readings(self) -> float:
        """How many readings the logs have: what twice the negative log-likelihood of a right model is about."""
        return float(sum(r.used.sum() for r in self.records))

    @property
    def noise(self) -> float:
        """The misfit that noise makes of a right model."""
        return self.readings / self.coarse**2


@dataclass(frozen=True)
class Stage:
    """A model with the effects found so far, fitted. `exact`: without disturbing forces. Not `settled`: no fit was
    found, parameters are the file's or, with coarse sensors, those of sensors noisier than they are. loose: the same
    model with the larger disturbing forces that this fit came from, if it did; beside a fit with coarse sensors the one
    with disturbing forces that leave much, if there is one. bare: the fit without its disturbing forces, or that there
    is none, if that is known."""

    machine: Machine
    prepared: Prepared
    fit: Fit
    settled: bool = True
    loose: Stage | None = None
    bare: tuple[Fit | None, ...] = ()

    @property
    def model(self) -> Model:
        return self.prepared.c.model

    def placed(self, name: str) -> Placed:
        """An effect that the model has."""
        return next(e for e in self.model.effects if e.name == name)

    @property
    def exact(self) -> bool:
        return self.fit.disturbed == 0

    @property
    def noise(self) -> float:
        return self.prepared.noise

    @property
    def excess(self) -> float:
        """How much more misfit there is than noise may make."""
        return max(0.0, self.fit.cost - (1 + SLACK) * self.noise)

    @property
    def near(self) -> bool:
        """Whether the misfit is not far from what noise makes."""
        return self.fit.cost <= newton.STRONG * self.noise

    @cached_property
    def ways(self) -> tuple[evidence.Way, ...]:
        """The fitted logs, along which candidates are scored."""
        return evidence.ways(self.prepared.c, self.prepared.records, self.fit)

    @cached_property
    def scores(self) -> list[tuple[evidence.Score, ...]]:
        """What candidates score along this fit: empty until `choosing.scored` puts it here."""
        return []

    @property
    def follows(self) -> bool:
        """Whether exact dynamics follow the logs, by far better than where nothing does: a formula that is nearly right
        leaves much where an effect is large."""
        return self.near or (self.exact and self.fit.cost <= FOLLOWED * self.noise)

    @property
    def spread(self) -> float:
        """How many times less sure gains are than without what is left of the misfit."""
        return max(1.0, self.fit.cost / self.noise)

    @property
    def rough(self) -> bool:
        """Whether first-order gains are."""
        return not self.exact or not self.near

    @property
    def doubt(self) -> float:
        """How much larger deviations are than the fit has them, for what it leaves unexplained: slow innovations."""
        sizes = np.concatenate([innovation_sizes(linear) for linear in self.fit.linear])
        told = sizes[:, 2] > 0
        return float(np.sqrt(max(1.0, sizes[told, 1].mean()))) if told.any() else 1.0

    @cached_property
    def impossible(self) -> tuple[str, ...]:
        """Parameters that surely have a sign that no machine has, friction that drives or soil that pulls, a line each.
        What makes them so is no cause, however much it explains."""
        fit, base = self.fit, self.model.base
        of = signs(self.machine) | {e.name: 1.0 for e in self.model.effects if e.effect.resisting}
        sure = np.maximum(SURELY * self.doubt * fit.std, WRONG * self.model.scale)
        found: list[str] = []
        for k, (name, unit) in enumerate(zip(base.names, base.units, strict=True)):
            # What stands for one standard parameter alone has its sign, whatever the machine file calls it.
            alone = np.count_nonzero(base.matrix[k]) == 1
            sign = of.get(base.standard[base.independent[k]], 0.0) if alone else 0.0
            if sign * fit.X[k] < -sure[k]:
                found.append(f"{name} = {fit.X[k]:.4g} {unit}")
        return tuple(found)

    @property
    def vain(self) -> bool:
        """Whether effects leave nothing but noise, and no machine is possible with them: there is nothing by which
        others could tell better."""
        return bool(self.model.effects) and self.exact and self.excess == 0 and bool(self.impossible)

    @property
    def suspects(self) -> list[str]:
        return smoothing.suspects(self.prepared.c, self.prepared.logs, self.fit)


Fits = tuple[Fit, Fit | None]  # of a stage and of the one with larger disturbing forces that it came from, if it did


def _stage(machine: Machine, prepared: Prepared, fits: Fits) -> Stage:
    fit, loose = fits
    return Stage(machine, prepared, fit, loose=None if loose is None else Stage(machine, prepared, loose))


def fitted(machine: Machine, logs: Sequence[Log], filter: Filter, together: Together = in_turn) -> Stage:
    """A machine's model fitted to logs, with shapes of effects free.

    Where exact dynamics find no estimate, or none that is less than FAR off after a few passes, nor one near the logs
    from that with disturbing forces, with such forces as small as the log lets them be: the less they may take up, the
    plainer the cause. Where these leave the model far off, with sensors taken for much noisier than they are, which
    most models follow; otherwise as `forced` has it.
    Each way is set out upon before it is known to be needed, where there are processes for it. Raises NotConverged.
    """
    prepared = _prepared(machine, logs, filter)
    calls: list[Callable[[], Any]] = [
        partial(_strictly, prepared),
        partial(_disturbed, machine, prepared, smoothing.DISTURBED[0]),
        *(partial(_from_first, _noisy(prepared, times), smoothing.DISTURBED[0]) for times in COARSE),
    ]
    ways = together(calls)
    with closing(ways):
        exact = next(ways)
        if exact is not None:
            return _stage(machine, prepared, exact)
        disturbed = next(ways)
        stage = None if disturbed is None else _stage(machine, prepared, disturbed)
        if stage is None or not stage.near:
            for times, fit in zip(COARSE, ways, strict=True):
                if fit is not None:
                    return Stage(machine, _noisy(prepared, times), fit, False, stage)
    if stage is not None and stage.near:
        return exact_if_near(stage)
    return (
        _forced(machine, prepared, smoothing.DISTURBED[1:], together) if stage is None else _with_least(stage, together)
    )


def forced(stage: Stage, together: Together) -> Stage:
    """In place of a fit with coarse sensors one with disturbing forces, no matter how much the smaller ones leave.
    Where large ones find none, or leave the model FAR off, one with the file's parameters: what these leave shows where
    to look. Raises NotConverged where those don't either."""
    if stage.loose is not None:
        return _with_least(stage.loose, together)
    return _forced(stage.machine, _noisy(stage.prepared, 1.0), smoothing.DISTURBED[1:], together)


def _forced(machine: Machine, prepared: Prepared, forces: Sequence[float], together: Together) -> Stage:
    calls: list[Callable[[], Any]] = [
        *(partial(_worthy, prepared, d, FAR * prepared.readings) for d in forces),
        partial(_as_filed, prepared),
    ]
    with closing(together(calls)) as ways:
        fit = next((fit for fit in islice(ways, len(forces)) if fit is not None), None)
        if fit is None:
            return Stage(machine, prepared, next(ways), settled=False)
    stage = Stage(machine, prepared, fit)
    return exact_if_near(_stage(machine, prepared, _lessened(stage, together))) if stage.near else stage


def _as_filed(prepared: Prepared) -> Fit:
    """A fit with the file's parameters and small disturbing forces."""
    asis = replace(prepared, held=np.ones_like(prepared.held))
    try:
        fit = _iterated(asis, prepared.starts, prepared.c.model.nominal, smoothing.DISTURBED[0])
    except NotConverged as failed:
        if failed.fit is None:
            raise
        fit = failed.fit
    unknown = np.full_like(fit.covariance, np.nan)
    known = newton.prior(prepared.c.model, prepared.held, fit.X)
    return light(replace(fit, unseen=prepared.held, prior=known, covariance=unknown))


def _noisy(prepared: Prepared, coarse: float) -> Prepared:
    """The same logs with sensors so coarse."""
    return replace(prepared, records=tuple(replace(r, coarse=coarse) for r in prepared.records))


def as_measured(stage: Stage) -> Stage:
    """A stage's motion and parameters against the sensors as noisy as they are."""
    if stage.prepared.coarse == 1:
        return stage
    prepared, fit = _noisy(stage.prepared, 1.0), stage.fit
    linear = newton.linearised(prepared.c, prepared.records, fit.points, prepared.starts, fit.X, fit.disturbed)
    if linear is None:
        return stage
    cost = sum(float(x.Z[0, 0]) for x in linear)
    return replace(stage, prepared=prepared, fit=light(replace(fit, linear=tuple(linear), cost=cost)), bare=())


def sharpened(found: Sequence[Stage], disturbed: float, together: Together) -> Iterator[Stage | None]:
    """Stages with coarse sensors gone on with, with sensors as they are and so large disturbing forces, side by side
    and set out upon at once; None where no fit comes anywhere near."""
    prepared = [_noisy(x.prepared, 1.0) for x in found]
    calls = [partial(_resumable, p, x, disturbed, FAR * p.readings) for p, x in zip(prepared, found, strict=True)]
    every = zip(prepared, found, ahead(calls, together), strict=True)
    return (None if fit is None else Stage(x.machine, p, fit) for p, x, fit in every)


def begun(
    machines: Sequence[Machine],
    of: Stage,
    disturbed: float,
    together: Together,
    worth: float = np.inf,
    enough: Callable[[int, Stage], bool] = lambda k, stage: False,
) -> Iterator[Stage | None]:
    """Machines with other effects, each fitted to the logs of a stage from the beginning, with so large disturbing
    forces or smaller ones, side by side; None where no fit is found. With forces none either where so large ones don't
    bring it near, or its beginning tells that they won't. By exact dynamics none where it costs more than it is worth,
    or its beginning tells that it will, or is FAR off already; where they leave much, with small disturbing forces
    after all, if they bring it near or it doesn't follow. enough: whether a stage, of the machine of that number, is
    one beside which those that come after it are of use only where they come near as well: none of these whose
    beginning tells that it won't."""
    onsets, near, at = [_onset(of, disturbed, worth)], _where_near(of), 0
    while at < len(machines):
        calls = [partial(_begun, m, of, tuple(onsets), disturbed, worth) for m in machines[at:]]
        with closing(together(calls)) as ways:
            for fits in ways:
                machine, at = machines[at], at + 1
                stage = _stage(machine, _anew(machine, of), fits) if fits else None
                yield stage
                if near is not None and len(onsets) == 1 and stage is not None and enough(at - 1, stage):
                    onsets.append(replace(near, whole=True))
                    break


def _from_first(
    prepared: Prepared, disturbed: float, most: float = np.inf, worth: float = np.inf, patient: bool = False
) -> Fit | None:
    """A fit from first guesses; None where none is found or it is given up, as it still costs more than `most`, or
    more than it is worth and no less than before. To the patient one that is as good as found is none."""
    p = prepared
    try:
        return light(_iterated(p, p.starts, p.c.model.nominal, disturbed, most=most, patient=patient, worth=worth))
    except NotConverged as failed:
        return None if failed.nearly is None or patient else light(failed.nearly)


def _strictly(prepared: Prepared) -> Fits | None:
    """A fit from first guesses by exact dynamics; None where it is given up, as it stays FAR off."""
    fit = _from_first(prepared, 0.0, FAR * prepared.readings, patient=True)
    return None if fit is None else (fit, None)


def _disturbed(machine: Machine, prepared: Prepared, disturbed: float, worth: float = np.inf) -> Fits | None:
    """A fit from first guesses with disturbing forces, and from there with smaller ones where it is near; None of one
    that costs more than it is worth."""
    fit = _worthy(prepared, disturbed, worth)
    if fit is None:
        return None
    stage = Stage(machine, prepared, fit)
    return _lessened(stage) if stage.near else (fit, None)


def _worthy(prepared: Prepared, disturbed: float, worth: float) -> Fit | None:
    """A fit from first guesses with disturbing forces, None of one that costs more than it is worth."""
    fit = _from_first(prepared, disturbed, worth=worth)
    return None if fit is None or fit.cost > worth else fit


def _with_least(stage: Stage, together: Together) -> Stage:
    """A stage gone on with with the smallest disturbing forces that it takes, without any where that is near."""
    if stage.loose is not None:
        return exact_if_near(stage)
    return exact_if_near(_stage(stage.machine, stage.prepared, _lessened(stage, together)))


def _lessened(first: Stage, together: Together = in_turn) -> Fits:
    """A fit with smaller disturbing forces, and smaller ones yet as long as these let the model come near the logs:
    large ones hide what else there is. And the one that it came from."""
    stage = _with_less(first, together)
    if stage is None:
        return first.fit, None
    while (smaller := _with_less(stage, together)) is not None and smaller.near:
        stage = smaller
    return stage.fit, first.fit


def _with_less(stage: Stage, together: Together) -> Stage | None:
    """The fit of a stage gone on with with smaller disturbing forces, None where there is none."""
    smaller = [d for d in (less * stage.fit.disturbed for less in LESS) if d >= SMALL]
    with closing(together([partial(_resumable, stage.prepared, stage, forces) for forces in smaller])) as fits:
        return next((replace(stage, fit=fit, bare=()) for fit in fits if fit is not None), None)


@dataclass(frozen=True)
class Onset:
    """How many samples of each log are its beginning, and the most that a fit may cost there, from which it isn't worth
    the whole; with `or_found` unless it is as good as found there. whole: not after a few passes, but as far as it
    comes. without: what the model that has no further effect costs there after BRIEF passes, if that is known."""

    samples: tuple[int, ...]
    most: float
    or_found: bool = False
    whole: bool = False
    without: float = np.inf


def _beginnings(prepared: Prepared) -> list[tuple[int, ...]]:
    """How many samples of each log such beginnings have, SHORTEST at least, the shortest first; none that is more than
    half of them all."""
    rate, lengths = float(prepared.c.model.machine.sampling_hz), [len(r.used) for r in prepared.records]
    every = (tuple(min(n, max(round(SHORTEST * rate), int(share * n))) for n in lengths) for share in ONSETS)
    return [samples for samples in dict.fromkeys(every) if 2 * sum(samples) <= sum(lengths)]


def _until(prepared: Prepared, samples: Sequence[int]) -> Prepared:
    """The first samples of each log only."""
    records = tuple(r.until(n) for r, n in zip(prepared.records, samples, strict=True))
    return replace(prepared, records=records, starts=tuple(map(Point.until, prepared.starts, samples)))


def _onset(of: Stage, disturbed: float, worth: float) -> Onset | None:
    """The beginning of the logs that tells, in a fraction of the time, which fits with such disturbing forces come to
    nothing; worth: the most that one may cost. None where no half of the logs tells."""
    if disturbed > 0:
        onset = _where_near(of)
    elif np.isinf(worth):
        onset = _where_far(of)
    else:
        onset = _where_gained(of, worth) if of.settled and of.exact else None
    if onset is None:
        return None
    cost, _ = _began(_until(_noisy(of.prepared, 1.0), onset.samples), disturbed, np.inf, BRIEF)
    return replace(onset, without=cost or np.inf)


def _where_near(of: Stage) -> Onset | None:
    """The shortest beginning: what leaves more there, beside noise, than the whole may leave and still be near, isn't
    near the whole."""
    samples = next(iter(_beginnings(of.prepared)), None)
    if samples is None:
        return None
    return Onset(samples, _until(of.prepared, samples).readings + (newton.STRONG - 1) * of.prepared.readings)


def _where_far(of: Stage) -> Onset | None:
    """The shortest beginning that exact dynamics of a stage's own model stay FAR off: what does as well doesn't follow
    the logs either. The shortest where none is."""
    onsets = [Onset(x, FAR * _until(of.prepared, x).readings, True) for x in _beginnings(of.prepared)]
    sharp = _noisy(of.prepared, 1.0)
    return next((x for x in onsets if not _sets_out(sharp, x, 0.0)), onsets[0] if onsets else None)


def _where_gained(of: Stage, worth: float) -> Onset | None:
    """The shortest beginning that holds a good part of what a stage's exact dynamics leave beside noise: there a fit
    must take as fair a part of what its own model comes to as of the whole."""
    part = LENIENT * (of.fit.cost - worth) / max(of.excess, 1e-9)
    missed = [np.square(way.white.E[:, :, 0]).sum(axis=1, dtype=float) for way in of.ways]
    for samples in _beginnings(of.prepared):
        begin = _until(of.prepared, samples)
        cost = sum(float(x[:n].sum()) for x, n in zip(missed, samples, strict=True))
        if cost - (1 + SLACK) * begin.noise >= TELLING * of.excess:
            cost = _began(begin, 0.0, np.inf)[0] or cost  # after as few passes as others have
            return Onset(samples, cost - part * max(0.0, cost - (1 + SLACK) * begin.noise))
    return None


def _sets_out(prepared: Prepared, onset: Onset | None, disturbed: float) -> bool:
    """Whether a fit may come to what it is worth, as far as the beginning of the logs tells, if any does."""
    if onset is None:
        return True
    begin = _until(prepared, onset.samples)
    brief = max(onset.most, (1 - SAME) * onset.without)
    if not np.isinf(brief) and _began(begin, disturbed, np.inf, BRIEF)[0] > brief:
        return False
    if onset.whole:
        cost, found = _began(begin, disturbed, np.inf, newton.PASSES)
    else:
        cost, found = _began(begin, disturbed, onset.most)
    return cost <= onset.most or (found and onset.or_found)


def _began(begin: Prepared, disturbed: float, most: float, passes: int = newton.SETTLED + 1) -> tuple[float, bool]:
    """What a fit to the beginning of logs costs after a few passes, nothing where there is none, and whether it is as
    good as found then. most: what it is given up above."""
    X = begin.c.model.nominal
    try:
        return _iterated(begin, begin.starts, X, disturbed, passes=passes, most=most).cost, True
    except NotConverged as failed:
        return (0.0 if failed.fit is None else failed.fit.cost), failed.nearly is not None


def _begun(machine: Machine, of: Stage, onsets: Sequence[Onset | None], disturbed: float, worth: float) -> Fits | None:
    """A fit from first guesses, as `begun` has it; None of one that doesn't set out."""
    prepared = _anew(machine, of)
    if not all(_sets_out(prepared, onset, disturbed) for onset in onsets):
        return None
    if disturbed > 0:
        return _disturbed(machine, prepared, disturbed, newton.STRONG * prepared.noise)
    return _plain(machine, prepared, worth)


def _plain(machine: Machine, prepared: Prepared, worth: float) -> Fits | None:
    """A fit from first guesses by exact dynamics, or by small disturbing forces from there where much is left; None of
    one that costs more than it is worth."""
    fit = _from_first(prepared, 0.0, FAR * prepared.readings, worth)
    if fit is None or fit.cost > worth:
        return None
    stage = Stage(machine, prepared, fit)
    if stage.near:
        return fit, None
    try:
        loose = _resume(prepared, stage, SMALL)
    except NotConverged:
        return fit, None
    return (fit if stage.follows and not replace(stage, fit=loose).near else loose), None


def refitted(machine: Machine, of: Stage, disturbed: float) -> Stage:
    """The model of a machine with other effects fitted to the logs of a stage, from its fit, with so large disturbing
    forces. Raises NotConverged."""
    prepared = _resumed(machine, of)
    return Stage(machine, prepared, _resume(prepared, of, disturbed), prepared.coarse == 1)


Wish = tuple[Machine, Stage, float]  # what `refitted` is called with


def refits(
    wishes: Sequence[Wish],
    together: Together,
    most: float = np.inf,
    held: Sequence[str] = (),
) -> Iterator[Stage | None]:
    """Several refitted, side by side; None where no fit is found or it is given up, as it still costs more than `most`
    after a few passes. held: of each a parameter that stays at the machine file's value, if any are."""
    prepared = [_resumed(machine, of) for machine, of, _ in wishes]
    if held:
        prepared = [_holding(p, name) for p, name in zip(prepared, held, strict=True)]
    calls = [
        partial(_resumable, p, of, disturbed, most) for p, (_, of, disturbed) in zip(prepared, wishes, strict=True)
    ]
    every = zip(prepared, wishes, together(calls), strict=True)
    return (None if fit is None else Stage(machine, p, fit, p.coarse == 1) for p, (machine, _, _), fit in every)


def refitted_and_freed(machine: Machine, of: Stage, together: Together) -> tuple[Stage | None, Stage]:
    """The model of a machine with other effects fitted from the fit of a stage, None where no fit is found, and beside
    it the stage itself without its disturbing forces, if it has any and is near, as it will be asked for."""
    prepared, frees = _resumed(machine, of), of.near and not of.exact
    calls = [partial(_resumable, prepared, of, of.fit.disturbed), *([partial(_exact, of)] if frees else [])]
    fit, *bare = together(calls)
    other = None if fit is None else Stage(machine, prepared, fit, prepared.coarse == 1)
    return other, replace(of, bare=tuple(bare)) if frees else of


def _holding(prepared: Prepared, name: str) -> Prepared:
    return replace(prepared, held=prepared.held | (np.array(prepared.c.model.base.names) == name))


def freed(found: Sequence[Stage], together: Together) -> Iterator[Stage | None]:
    """Stages without their disturbing forces, side by side; None where exact dynamics are far from the logs: they make
    a large misfit of a formula that is nearly right."""
    for stage, fit in zip(found, together([partial(_exact, x) for x in found]), strict=True):
        yield None if fit is None else replace(stage, fit=fit, bare=())


def exact_if_near(stage: Stage) -> Stage:
    """A stage without its disturbing forces where exact dynamics come near the logs, otherwise as it is."""
    without = None if stage.exact or not stage.near else next(freed([stage], in_turn))
    return without if without is not None and without.near else stage


def _exact(stage: Stage) -> Fit | None:
    if stage.bare:
        return stage.bare[0]
    most = FAR * stage.prepared.readings
    try:
        fit = _resume(stage.prepared, stage, 0.0, most)
    except NotConverged:
        return None
    return fit if fit.cost < most else None


def _resumable(prepared: Prepared, of: Stage, disturbed: float, most: float = np.inf) -> Fit | None:
    try:
        return _resume(prepared, of, disturbed, most)
    except NotConverged:
        return None


def _resume(prepared: Prepared, of: Stage, disturbed: float, most: float = np.inf) -> Fit:
    """The fit of a stage gone on with, for logs made ready for another model. Raises NotConverged."""
    c, untold = prepared.c, _untold(prepared, of, disturbed)
    old = dict(zip(of.model.base.names, of.fit.X, strict=True))
    X = np.array([old.get(n, x) for n, x in zip(c.model.base.names, c.model.nominal, strict=True)])
    X = np.where(prepared.held, c.model.nominal, X)
    points = [carried(c, r, p, of.prepared.c, X) for r, p in zip(prepared.records, of.fit.points, strict=True)]
    try:
        fit = _nearly(prepared, points, X, disturbed, most, untold)
    except NotConverged as failed:
        found = failed.fit
        if found is None:
            raise
        if disturbed > 0:
            # It came near the logs as the stage that it began from did not with such forces: what began or ended at an
            # instant may keep it from settling, and exact dynamics tell later what it is worth.
            alike = of.fit.disturbed >= disturbed and of.prepared.coarse == prepared.coarse
            if alike and not of.near and found.cost <= min(newton.STRONG * prepared.noise, most):
                return light(found)
            raise
        # By exact dynamics it came near the logs as the stage that it began from did not, or nearer by far: what does
        # that is right, from however far it came, and is gone on with.
        alike = of.near and of.prepared.coarse == prepared.coarse
        near = of.fit.cost - NEARER if alike else newton.STRONG * prepared.noise
        if found.cost > min(near, most):
            raise
        fit = _nearly(prepared, found.points, found.X, disturbed, most, untold)
    return light(fit)


def _untold(prepared: Prepared, of: Stage, disturbed: float) -> np.ndarray:
    """Parameters (n_base,) that the logs don't show in the fit of a stage, where neither smaller disturbing forces nor
    finer sensors may show them now. Most often they don't with other effects either: left free they would first lead
    each of these fits astray."""
    names = prepared.c.model.base.names
    if of.fit.disturbed > disturbed or of.prepared.coarse != prepared.coarse or not of.settled:
        return np.zeros(len(names), bool)
    unseen = {n for n, yes in zip(of.model.base.names, of.fit.unseen, strict=True) if yes}
    return np.array([n in unseen for n in names])


def _nearly(
    prepared: Prepared, points: Sequence[Point], X: np.ndarray, disturbed: float, most: float, untold: np.ndarray
) -> Fit:
    """A fit that goes on from another, as far as it came if that is as good as found. Raises NotConverged."""
    try:
        return _iterated(prepared, points, X, disturbed, newton.RESUMED, PASSES, most, untold=untold)
    except NotConverged as failed:
        found = failed.nearly or failed.swinging
        if found is None:
            raise
        return found


def _iterated(
    prepared: Prepared,
    points: Sequence[Point],
    X: np.ndarray,
    disturbed: float,
    damping: float = newton.DAMPING[0],
    passes: int = newton.PASSES,
    most: float = np.inf,
    patient: bool = False,
    worth: float = np.inf,
    untold: np.ndarray | None = None,
) -> Fit:
    """A fit from points and X. With large disturbing forces it is found as soon as it nearly is: gains are larger
    by far than what another pass would change. With the smallest, whose gains may be small, and by exact dynamics it
    leaves undone what is less than an amount is ever known to, the patient one nothing. Raises NotConverged."""
    p, enough = prepared, newton.NEARLY if disturbed > SMALL else 0.0 if patient else newton.ENOUGH
    return newton.iterate(
        p.c, p.records, points, X, p.starts, disturbed, p.held, damping, passes, enough, most, patient, worth, untold
    )


def light(fit: Fit) -> Fit:
    """A fit without what only its own iteration needs."""
    return replace(fit, linear=tuple(replace(x, solved=x.solved.closed) for x in fit.linear))


def _charted(machine: Machine, logs: Sequence[Log]) -> Chart:
    model = build(machine, shapes=True)
    return chart(model, common_sensors(model, logs))


def _prepared(machine: Machine, logs: Sequence[Log], filter: Filter) -> Prepared:
    c = _charted(machine, logs)
    records = tuple(record(c, log) for log in logs)
    starts = tuple(first_point(c, r, log, filter) for r, log in zip(records, logs, strict=True))
    return Prepared(c, tuple(logs), records, starts, hidden.unmoved(c.model, logs, filter, slow=False))


def _resumed(machine: Machine, of: Stage) -> Prepared:
    """The logs of a stage made ready for a machine with other effects."""
    before = of.prepared
    if machine is of.machine:
        return before
    c = _charted(machine, before.logs)
    model = c.model
    records = tuple(replace(r, origin=origins(c, r.counts)) for r in before.records)
    starts = tuple(carried(c, r, p, before.c, model.nominal) for r, p in zip(records, before.starts, strict=True))
    held = dict(zip(of.model.base.names, before.held, strict=True))
    return Prepared(c, before.logs, records, starts, np.array([held.get(n, False) for n in model.base.names]))


def _anew(machine: Machine, of: Stage) -> Prepared:
    """The logs of a stage made ready for a machine with other effects, with sensors as noisy as they are."""
    return _noisy(_resumed(machine, of), 1.0)
