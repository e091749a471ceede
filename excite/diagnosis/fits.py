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

from excite import identification, smoothing
from excite.diagnosis import score_test
from excite.diagnosis.parallel import Together, ahead, in_turn
from excite.logs import Log
from excite.model import Model, build, required_signs
from excite.model.effects import PlacedEffect
from excite.model.machine import Filter, Machine
from excite.smoothing import (
    Fit,
    Measurements,
    NotConvergedError,
    StateSpace,
    Trajectory,
    build_state_space,
    common_sensors,
    encoders_with_offset,
    initial_trajectory,
    innovation_statistics,
    prepare_measurements,
    transfer_trajectory,
)

NEARER = 100.0  # of a cost, by which what was not found comes nearer to logs that are near already
FOLLOWED = 2.5  # misfit over readings up to which exact dynamics follow logs where nothing else does
FAR = 10.0  # misfit over readings, a few passes after the beginning, from which no fit comes near
SLACK = 0.02  # of the readings, by which the misfit of a right model scatters and noise levels are off
SURELY, WRONG = 3.0, 0.5  # deviations, and a share of its usual size, by which a parameter's sign is wrong
PASSES = 14  # of a fit that goes on from another
COARSE = 10.0, 30.0  # times their noise that sensors are taken to have where nothing follows the logs, in turn
LESS = 0.1, 0.3  # disturbing forces that are tried next where a model needs any, as shares of those it was fitted with
SMALL = LESS[0] * identification.PROCESS_NOISE_LEVELS[0]  # the smallest that are tried


@dataclass(frozen=True)
class Prepared:
    """Logs made ready for a model: chart, records, first guesses, parameters that they don't show."""

    c: StateSpace
    logs: tuple[Log, ...]
    records: tuple[Measurements, ...]
    starts: tuple[Trajectory, ...]
    held: np.ndarray

    @property
    def coarse(self) -> float:
        """How many times as noisy as they are sensors are taken to be."""
        return self.records[0].noise_inflation

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

    def placed(self, name: str) -> PlacedEffect:
        """An effect that the model has."""
        return next(e for e in self.model.effects if e.name == name)

    @property
    def exact(self) -> bool:
        return self.fit.process_noise == 0

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
        return self.fit.cost <= smoothing.CLOSE_FIT_COST_RATIO * self.noise

    @cached_property
    def ways(self) -> tuple[score_test.Way, ...]:
        """The fitted logs, along which candidates are scored."""
        return score_test.ways(self.prepared.c, self.prepared.records, self.fit)

    @cached_property
    def scores(self) -> list[tuple[score_test.Score, ...]]:
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
        sizes = np.concatenate([innovation_statistics(linear) for linear in self.fit.linear])
        told = sizes[:, 2] > 0
        return float(np.sqrt(max(1.0, sizes[told, 1].mean()))) if told.any() else 1.0

    @cached_property
    def impossible(self) -> tuple[str, ...]:
        """Parameters that surely have a sign that no machine has, friction that drives or soil that pulls, a line each.
        What makes them so is no cause, however much it explains."""
        fit, base = self.fit, self.model.base
        of = required_signs(self.machine) | {e.name: 1.0 for e in self.model.effects if e.effect.opposes_motion}
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
        return identification.find_suspect_sensors(self.prepared.c, self.prepared.logs, self.fit)


Fits = tuple[Fit, Fit | None]  # of a stage and of the one with larger disturbing forces that it came from, if it did


def staged(machine: Machine, prepared: Prepared, fit: Fit, loose: Fit | None = None) -> Stage:
    """A stage from fits: its own, and that with larger disturbing forces that it came from, if it did."""
    came_from = None if loose is None else staged(machine, prepared, loose)
    return Stage(machine, prepared, fit, prepared.coarse == 1, came_from)


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
        partial(with_forces, machine, prepared, identification.PROCESS_NOISE_LEVELS[0]),
        *(partial(from_first, noisy(prepared, times), identification.PROCESS_NOISE_LEVELS[0]) for times in COARSE),
    ]
    ways = together(calls)
    with closing(ways):
        exact = next(ways)
        if exact is not None:
            return staged(machine, prepared, *exact)
        disturbed = next(ways)
        stage = None if disturbed is None else staged(machine, prepared, *disturbed)
        if stage is None or not stage.near:
            for times, fit in zip(COARSE, ways, strict=True):
                if fit is not None:
                    return Stage(machine, noisy(prepared, times), fit, False, stage)
    if stage is not None and stage.near:
        return exact_if_near(stage)
    return (
        _forced(machine, prepared, identification.PROCESS_NOISE_LEVELS[1:], together)
        if stage is None
        else _with_least(stage, together)
    )


def forced(stage: Stage, together: Together) -> Stage:
    """In place of a fit with coarse sensors one with disturbing forces, no matter how much the smaller ones leave.
    Where large ones find none, or leave the model FAR off, one with the file's parameters: what these leave shows where
    to look. Raises NotConverged where those don't either."""
    if stage.loose is not None:
        return _with_least(stage.loose, together)
    return _forced(stage.machine, noisy(stage.prepared, 1.0), identification.PROCESS_NOISE_LEVELS[1:], together)


def _forced(machine: Machine, prepared: Prepared, forces: Sequence[float], together: Together) -> Stage:
    calls: list[Callable[[], Any]] = [
        *(partial(_worthy, prepared, d, FAR * prepared.readings) for d in forces),
        partial(_as_filed, prepared),
    ]
    with closing(together(calls)) as ways:
        fit = next((fit for fit in islice(ways, len(forces)) if fit is not None), None)
        if fit is None:
            return Stage(machine, prepared, next(ways), settled=False)
    stage = staged(machine, prepared, fit)
    return exact_if_near(staged(machine, prepared, *_lessened(stage, together))) if stage.near else stage


def _as_filed(prepared: Prepared) -> Fit:
    """A fit with the file's parameters and small disturbing forces."""
    asis = replace(prepared, held=np.ones_like(prepared.held))
    try:
        fit = iterated(asis, prepared.starts, prepared.c.model.nominal, identification.PROCESS_NOISE_LEVELS[0])
    except NotConvergedError as failed:
        if failed.fit is None:
            raise
        fit = failed.fit
    unknown = np.full_like(fit.covariance, np.nan)
    known = smoothing.prior_information(prepared.c.model, prepared.held, fit.X)
    return light(replace(fit, unidentifiable=prepared.held, prior=known, covariance=unknown))


def noisy(prepared: Prepared, coarse: float) -> Prepared:
    """The same logs with sensors so coarse."""
    return replace(prepared, records=tuple(replace(r, noise_inflation=coarse) for r in prepared.records))


def as_measured(stage: Stage) -> Stage:
    """A stage's motion and parameters against the sensors as noisy as they are."""
    if stage.prepared.coarse == 1:
        return stage
    prepared, fit = noisy(stage.prepared, 1.0), stage.fit
    linear = smoothing.linearise_logs(
        prepared.c, prepared.records, fit.trajectories, prepared.starts, fit.X, fit.process_noise
    )
    if linear is None:
        return stage
    cost = sum(float(x.Z[0, 0]) for x in linear)
    return replace(stage, prepared=prepared, fit=light(replace(fit, linear=tuple(linear), cost=cost)), bare=())


def sharpened(found: Sequence[Stage], disturbed: float, together: Together) -> Iterator[Stage | None]:
    """Stages with coarse sensors gone on with, with sensors as they are and so large disturbing forces, side by side
    and set out upon at once; None where no fit comes anywhere near."""
    prepared = [noisy(x.prepared, 1.0) for x in found]
    calls = [partial(_resumable, p, x, disturbed, FAR * p.readings) for p, x in zip(prepared, found, strict=True)]
    every = zip(prepared, found, ahead(calls, together), strict=True)
    return (None if fit is None else staged(x.machine, p, fit) for p, x, fit in every)


def from_first(
    prepared: Prepared, disturbed: float, most: float = np.inf, worth: float = np.inf, patient: bool = False
) -> Fit | None:
    """A fit from first guesses; None where none is found or it is given up, as it still costs more than `most`, or
    more than it is worth and no less than before. To the patient one that is as good as found is none."""
    p = prepared
    try:
        return light(iterated(p, p.starts, p.c.model.nominal, disturbed, most=most, patient=patient, worth=worth))
    except NotConvergedError as failed:
        return None if failed.acceptable_fit is None or patient else light(failed.acceptable_fit)


def _strictly(prepared: Prepared) -> Fits | None:
    """A fit from first guesses by exact dynamics; None where it is given up, as it stays FAR off."""
    fit = from_first(prepared, 0.0, FAR * prepared.readings, patient=True)
    return None if fit is None else (fit, None)


def with_forces(machine: Machine, prepared: Prepared, disturbed: float, worth: float = np.inf) -> Fits | None:
    """A fit from first guesses with disturbing forces, and from there with smaller ones where it is near; None of one
    that costs more than it is worth."""
    fit = _worthy(prepared, disturbed, worth)
    if fit is None:
        return None
    stage = staged(machine, prepared, fit)
    return _lessened(stage) if stage.near else (fit, None)


def _worthy(prepared: Prepared, disturbed: float, worth: float) -> Fit | None:
    """A fit from first guesses with disturbing forces, None of one that costs more than it is worth."""
    fit = from_first(prepared, disturbed, worth=worth)
    return None if fit is None or fit.cost > worth else fit


def _with_least(stage: Stage, together: Together) -> Stage:
    """A stage gone on with with the smallest disturbing forces that it takes, without any where that is near."""
    if stage.loose is not None:
        return exact_if_near(stage)
    return exact_if_near(staged(stage.machine, stage.prepared, *_lessened(stage, together)))


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
    smaller = [d for d in (less * stage.fit.process_noise for less in LESS) if d >= SMALL]
    with closing(together([partial(_resumable, stage.prepared, stage, forces) for forces in smaller])) as fits:
        return next((replace(stage, fit=fit, bare=()) for fit in fits if fit is not None), None)


def refitted(machine: Machine, of: Stage, disturbed: float) -> Stage:
    """The model of a machine with other effects fitted to the logs of a stage, from its fit, with so large disturbing
    forces. Raises NotConverged."""
    prepared = prepared_for(machine, of)
    return staged(machine, prepared, resume(prepared, of, disturbed))


Wish = tuple[Machine, Stage, float]  # what `refitted` is called with


def refits(
    wishes: Sequence[Wish],
    together: Together,
    most: float = np.inf,
    held: Sequence[str] = (),
) -> Iterator[Stage | None]:
    """Several refitted, side by side; None where no fit is found or it is given up, as it still costs more than `most`
    after a few passes. held: of each a parameter that stays at the machine file's value, if any are."""
    prepared = [prepared_for(machine, of) for machine, of, _ in wishes]
    if held:
        prepared = [_holding(p, name) for p, name in zip(prepared, held, strict=True)]
    calls = [
        partial(_resumable, p, of, disturbed, most) for p, (_, of, disturbed) in zip(prepared, wishes, strict=True)
    ]
    every = zip(prepared, wishes, together(calls), strict=True)
    return (None if fit is None else staged(machine, p, fit) for p, (machine, _, _), fit in every)


def refitted_and_freed(machine: Machine, of: Stage, together: Together) -> tuple[Stage | None, Stage]:
    """The model of a machine with other effects fitted from the fit of a stage, None where no fit is found, and beside
    it the stage itself without its disturbing forces, if it has any and is near, as it will be asked for."""
    prepared, frees = prepared_for(machine, of), of.near and not of.exact
    calls = [partial(_resumable, prepared, of, of.fit.process_noise), *([partial(_exact, of)] if frees else [])]
    fit, *bare = together(calls)
    other = None if fit is None else staged(machine, prepared, fit)
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
        fit = resume(stage.prepared, stage, 0.0, most)
    except NotConvergedError:
        return None
    return fit if fit.cost < most else None


def _resumable(prepared: Prepared, of: Stage, disturbed: float, most: float = np.inf) -> Fit | None:
    try:
        return resume(prepared, of, disturbed, most)
    except NotConvergedError:
        return None


def resume(prepared: Prepared, of: Stage, disturbed: float, most: float = np.inf) -> Fit:
    """The fit of a stage gone on with, for logs made ready for another model. Raises NotConverged."""
    c, untold = prepared.c, _untold(prepared, of, disturbed)
    old = dict(zip(of.model.base.names, of.fit.X, strict=True))
    X = np.array([old.get(n, x) for n, x in zip(c.model.base.names, c.model.nominal, strict=True)])
    X = np.where(prepared.held, c.model.nominal, X)
    points = [
        transfer_trajectory(c, r, p, of.prepared.c, X)
        for r, p in zip(prepared.records, of.fit.trajectories, strict=True)
    ]
    try:
        fit = _nearly(prepared, points, X, disturbed, most, untold)
    except NotConvergedError as failed:
        found = failed.fit
        if found is None:
            raise
        if disturbed > 0:
            # It came near the logs as the stage that it began from did not with such forces: what began or ended at an
            # instant may keep it from settling, and exact dynamics tell later what it is worth.
            alike = of.fit.process_noise >= disturbed and of.prepared.coarse == prepared.coarse
            if alike and not of.near and found.cost <= min(smoothing.CLOSE_FIT_COST_RATIO * prepared.noise, most):
                return light(found)
            raise
        # By exact dynamics it came near the logs as the stage that it began from did not, or nearer by far: what does
        # that is right, from however far it came, and is gone on with.
        alike = of.near and of.prepared.coarse == prepared.coarse
        near = of.fit.cost - NEARER if alike else smoothing.CLOSE_FIT_COST_RATIO * prepared.noise
        if found.cost > min(near, most):
            raise
        fit = _nearly(prepared, found.trajectories, found.X, disturbed, most, untold)
    return light(fit)


def _untold(prepared: Prepared, of: Stage, disturbed: float) -> np.ndarray:
    """Parameters (n_base,) that the logs don't show in the fit of a stage, where neither smaller disturbing forces nor
    finer sensors may show them now. Most often they don't with other effects either: left free they would first lead
    each of these fits astray."""
    names = prepared.c.model.base.names
    if of.fit.process_noise > disturbed or of.prepared.coarse != prepared.coarse or not of.settled:
        return np.zeros(len(names), bool)
    unseen = {n for n, yes in zip(of.model.base.names, of.fit.unidentifiable, strict=True) if yes}
    return np.array([n in unseen for n in names])


def _nearly(
    prepared: Prepared, points: Sequence[Trajectory], X: np.ndarray, disturbed: float, most: float, untold: np.ndarray
) -> Fit:
    """A fit that goes on from another, as far as it came if that is as good as found. Raises NotConverged."""
    try:
        return iterated(prepared, points, X, disturbed, smoothing.RESUMED_DAMPING, PASSES, most, untold=untold)
    except NotConvergedError as failed:
        found = failed.acceptable_fit or failed.oscillating_fit
        if found is None:
            raise
        return found


def iterated(
    prepared: Prepared,
    points: Sequence[Trajectory],
    X: np.ndarray,
    disturbed: float,
    damping: float = smoothing.INITIAL_DAMPING,
    passes: int = smoothing.MAX_PASSES,
    most: float = np.inf,
    patient: bool = False,
    worth: float = np.inf,
    untold: np.ndarray | None = None,
) -> Fit:
    """A fit from points and X. With large disturbing forces it is found as soon as it nearly is: gains are larger
    by far than what another pass would change. With the smallest, whose gains may be small, and by exact dynamics it
    leaves undone what is less than an amount is ever known to, the patient one nothing. Raises NotConverged."""
    p, enough = (
        prepared,
        smoothing.ACCEPTABLE_STEP if disturbed > SMALL else 0.0 if patient else smoothing.SUFFICIENT_STEP,
    )
    return smoothing.fit_logs(
        p.c, p.records, points, X, p.starts, disturbed, p.held, damping, passes, enough, most, patient, worth, untold
    )


def light(fit: Fit) -> Fit:
    """A fit without what only its own iteration needs."""
    return replace(fit, linear=tuple(replace(x, chain=x.chain.without_levels) for x in fit.linear))


def _charted(machine: Machine, logs: Sequence[Log]) -> StateSpace:
    model = build(machine, fit_shapes=True)
    return build_state_space(model, common_sensors(model, logs))


def _prepared(machine: Machine, logs: Sequence[Log], filter: Filter) -> Prepared:
    c = _charted(machine, logs)
    records = tuple(prepare_measurements(c, log) for log in logs)
    starts = tuple(initial_trajectory(c, r, log, filter) for r, log in zip(records, logs, strict=True))
    return Prepared(
        c, tuple(logs), records, starts, identification.parameters_at_rest(c.model, logs, filter, slow=False)
    )


def prepared_for(machine: Machine, of: Stage) -> Prepared:
    """The logs of a stage made ready for a machine with other effects."""
    before = of.prepared
    if machine is of.machine:
        return before
    c = _charted(machine, before.logs)
    model = c.model
    records = tuple(replace(r, offset_sensors=encoders_with_offset(c, r.read_at_edges)) for r in before.records)
    starts = tuple(
        transfer_trajectory(c, r, p, before.c, model.nominal) for r, p in zip(records, before.starts, strict=True)
    )
    held = dict(zip(of.model.base.names, before.held, strict=True))
    return Prepared(c, before.logs, records, starts, np.array([held.get(n, False) for n in model.base.names]))
