"""Fits begun anew: machines with other effects fitted to logs from first guesses.

Most come to nothing. The first part of each log tells so in a fraction of the time, and only those that set out on it
are fitted to the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from excite import smoothing
from excite.diagnosis.fits import (
    FAR,
    SLACK,
    SMALL,
    Fits,
    Prepared,
    Stage,
    from_first,
    iterated,
    noisy,
    prepared_for,
    resume,
    staged,
    with_forces,
)
from excite.diagnosis.parallel import Together
from excite.model.machine import Machine
from excite.smoothing import NotConvergedError, Trajectory

SHORTEST = 30.0  # [s] that the beginning of a log has at least
# Passes after which an effect that leaves as much as the model without it, but for a share, is known to do nothing.
BRIEF, SAME = 2, 0.1
ONSETS = 0.25, 0.33, 0.4, 0.5  # shares of logs that are taken for their beginning, in turn
TELLING = 0.15  # of what exact dynamics leave, that is as much as a beginning must hold of it
LENIENT = 0.5  # of what a fit must take, that it must take of what is left of the beginning


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


def begun(
    machines: Sequence[Machine],
    of: Stage,
    disturbed: float,
    together: Together,
    worth: float = np.inf,
    enough: Callable[[int, Stage], bool] = lambda k, stage: False,
) -> Iterator[Stage | None]:
    """Machines with other effects, each fitted to the logs of a stage from first guesses, with so large disturbing
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
                stage = staged(machine, _anew(machine, of), *fits) if fits else None
                yield stage
                if near is not None and len(onsets) == 1 and stage is not None and enough(at - 1, stage):
                    onsets.append(replace(near, whole=True))
                    break


def _beginnings(prepared: Prepared) -> list[tuple[int, ...]]:
    """How many samples of each log such beginnings have, SHORTEST at least, the shortest first; none that is more than
    half of them all."""
    rate, lengths = float(prepared.c.model.machine.sampling_hz), [len(r.used) for r in prepared.records]
    every = (tuple(min(n, max(round(SHORTEST * rate), int(share * n))) for n in lengths) for share in ONSETS)
    return [samples for samples in dict.fromkeys(every) if 2 * sum(samples) <= sum(lengths)]


def _until(prepared: Prepared, samples: Sequence[int]) -> Prepared:
    """The first samples of each log only."""
    records = tuple(r.until(n) for r, n in zip(prepared.records, samples, strict=True))
    return replace(prepared, records=records, starts=tuple(map(Trajectory.until, prepared.starts, samples)))


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
    cost, _ = _began(_until(noisy(of.prepared, 1.0), onset.samples), disturbed, np.inf, BRIEF)
    return replace(onset, without=cost or np.inf)


def _where_near(of: Stage) -> Onset | None:
    """The shortest beginning: what leaves more there, beside noise, than the whole may leave and still be near, isn't
    near the whole."""
    samples = next(iter(_beginnings(of.prepared)), None)
    if samples is None:
        return None
    return Onset(
        samples, _until(of.prepared, samples).readings + (smoothing.CLOSE_FIT_COST_RATIO - 1) * of.prepared.readings
    )


def _where_far(of: Stage) -> Onset | None:
    """The shortest beginning that exact dynamics of a stage's own model stay FAR off: what does as well doesn't follow
    the logs either. The shortest where none is."""
    onsets = [Onset(x, FAR * _until(of.prepared, x).readings, True) for x in _beginnings(of.prepared)]
    sharp = noisy(of.prepared, 1.0)
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
        cost, found = _began(begin, disturbed, np.inf, smoothing.MAX_PASSES)
    else:
        cost, found = _began(begin, disturbed, onset.most)
    return cost <= onset.most or (found and onset.or_found)


def _began(
    begin: Prepared, disturbed: float, most: float, passes: int = smoothing.SETTLING_PASSES + 1
) -> tuple[float, bool]:
    """What a fit to the beginning of logs costs after a few passes, nothing where there is none, and whether it is as
    good as found then. most: what it is given up above."""
    X = begin.c.model.nominal
    try:
        return iterated(begin, begin.starts, X, disturbed, passes=passes, most=most).cost, True
    except NotConvergedError as failed:
        return (0.0 if failed.fit is None else failed.fit.cost), failed.acceptable_fit is not None


def _begun(machine: Machine, of: Stage, onsets: Sequence[Onset | None], disturbed: float, worth: float) -> Fits | None:
    """A fit from first guesses, as `begun` has it; None of one that doesn't set out."""
    prepared = _anew(machine, of)
    if not all(_sets_out(prepared, onset, disturbed) for onset in onsets):
        return None
    if disturbed > 0:
        return with_forces(machine, prepared, disturbed, smoothing.CLOSE_FIT_COST_RATIO * prepared.noise)
    return _plain(machine, prepared, worth)


def _plain(machine: Machine, prepared: Prepared, worth: float) -> Fits | None:
    """A fit from first guesses by exact dynamics, or by small disturbing forces from there where much is left; None of
    one that costs more than it is worth."""
    fit = from_first(prepared, 0.0, FAR * prepared.readings, worth)
    if fit is None or fit.cost > worth:
        return None
    stage = staged(machine, prepared, fit)
    if stage.near:
        return fit, None
    try:
        loose = resume(prepared, stage, SMALL)
    except NotConvergedError:
        return fit, None
    return (fit if stage.follows and not replace(stage, fit=loose).near else loose), None


def _anew(machine: Machine, of: Stage) -> Prepared:
    """The logs of a stage made ready for a machine with other effects, with sensors as noisy as they are."""
    return noisy(prepared_for(machine, of), 1.0)
