"""Parameters that a log doesn't show: why, and the drive that would."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from excite.identification.estimate import Estimate, add_notes
from excite.identification.least_squares import exchange_columns
from excite.logs import BLOCK, Log, Samples, samples, unmeasured
from excite.model import Model
from excite.model.machine import Filter
from excite.model.mechanics import independent_columns

MAX_SAMPLES = 400  # of the logs, that stand for them
STILL_SPEED = 0.01  # of a coordinate's speed at other times [rad/s, m/s]
STILL_COUNTS = 2  # of an encoder within which a joint stands still
ZERO_COLUMN = 1e-6  # of the largest column of a regressor
TRIAL_STD = 0.5  # speeds and accelerations of a manoeuvre that is tried out [SI]
SUFFICIENT_SHARE = 0.3  # of what the best manoeuvre shows: the simplest with this much is advised
POOR_RELATIVE_STD = 0.5  # standard deviation relative to the parameter's size that is no answer


@dataclass(frozen=True)
class TrialManoeuvre:
    """What a driver could do besides: text, the coordinates that it moves, and how (move, accelerate, reverse)."""

    text: str
    coordinates: tuple[int, ...]
    how: str


def add_advice(model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter) -> Estimate:
    """The estimate with advice: reasons of unidentifiable parameters name the drive that would reveal them, and so does
    a note for those whose deviation is no better than a guess."""
    size = np.maximum(np.abs(np.nan_to_num(estimate.value)), model.scale)
    poor = [
        n
        for n, s, x in zip(estimate.names, estimate.std, size, strict=True)
        if np.isfinite(s) and s > POOR_RELATIVE_STD * x
    ]
    if not estimate.unidentifiable and not poor:
        return estimate
    s = [samples(model, log, filter) for log in logs]
    told = advise_manoeuvres(model, s, [*estimate.unidentifiable, *poor])
    reasons = {n: f"{reason}; {told[n]}" for n, reason in estimate.unidentifiable.items()}
    notes = tuple(f"{n}: this log hardly shows it (deviation > {100 * POOR_RELATIVE_STD:g} %); {told[n]}" for n in poor)
    return add_notes(replace(estimate, unidentifiable=reasons), *notes)


def parameters_at_rest(model: Model, logs: Sequence[Log], filter: Filter, slow: bool) -> np.ndarray:
    """Parameters (n_base,) that logs don't show, or not apart from those left, because something on the machine stands
    still in all of them: see `at_rest`."""
    return np.diag(rest_projection(model, logs, filter, slow)) == 0


def rest_projection(
    model: Model, logs: Sequence[Log], filter: Filter, slow: bool = False, motions: Sequence[Samples] | None = None
) -> np.ndarray:
    """What a regressor W is multiplied by, (n_base, n_base), so that what stands still in all logs does so exactly.

    Along the logs as they are the noise of a joint at rest would pass for motion. A column that says nothing then is
    zero, one that is a combination of others (see `exchanged`) is that combination, all others are their own. A joint
    stands still if its encoder counts no further than COUNTS; if one does, so does the root if it moves slower than
    STILL on average over a second; with `slow` whatever is that slow. `motions`: of the logs, if they are known better.
    The identity for a machine with effects and where nothing stands still.
    """
    whole = np.eye(len(model.base.names))
    if not model.plain:
        return whole
    machine, at = model.machine, model.coordinates.index
    joints = [
        at(machine.find(s.body).coordinates[0])
        for s in machine.sensors("full")
        if s.kind == "angle"
        and s.resolution is not None
        and all(s.name in log.values and np.ptp(log.values[s.name]) <= STILL_COUNTS * s.resolution for log in logs)
    ]
    if not joints and not slow:
        return whole
    seen = motions or [_with_unmeasured(model, log, samples(model, log, filter)) for log in logs]
    root = [at(c) for c in machine.body[0].coordinates if c in model.coordinates] if machine.planar else []
    still = np.max([_speeds(model, s) for s in seen], axis=0) < STILL_SPEED
    still &= slow | np.isin(np.arange(len(still)), root)
    still[joints] = True
    if not still.any():
        return whole
    R = np.zeros((0, len(whole)))
    for s in seen:
        q = np.where(still[:, None], s.q.mean(axis=1, keepdims=True), s.q)
        nu, a = np.where(still[:, None], 0.0, s.nu), np.where(still[:, None], 0.0, s.a)
        for k in range(0, q.shape[1], BLOCK):
            own = slice(k, k + BLOCK)
            rows = _rows(model, q[:, own], nu[:, own], a[:, own])
            R = np.asarray(np.linalg.qr(np.concatenate([R, rows]), mode="r"))
    return _exact_combinations(R * model.scale) * model.scale[:, None] / model.scale


def _with_unmeasured(model: Model, log: Log, s: Samples) -> Samples:
    """Samples in which a speed that nothing measures is any speed at all, so that nothing is left out on its account:
    unless nothing else moves either, or it is sideways and the machine doesn't turn."""
    moves = _speeds(model, s) >= STILL_SPEED
    rows = [k for k in unmeasured(model, log) if moves.any()]
    if model.machine.planar:
        _, across, turn = model.machine.body[0].coordinates
        turns = turn in model.coordinates and moves[model.coordinates.index(turn)]
        rows = [k for k in rows if model.coordinates[k] != across or turns]
    nu, a = s.nu.copy(), s.a.copy()
    nu[rows], a[rows] = 1 + np.random.default_rng(0).standard_normal((2, len(rows), nu.shape[1]))
    return replace(s, nu=nu, a=a)


def _speeds(model: Model, s: Samples) -> np.ndarray:
    """Largest speed of each coordinate (n_q,) on average over a second."""
    second = round(float(model.machine.sampling_hz))
    return np.asarray(np.abs(scipy.ndimage.uniform_filter1d(s.nu, second, axis=1)).max(axis=1))


def _exact_combinations(R: np.ndarray) -> np.ndarray:
    """T (n, n) with R T = R to within NOTHING, by which a column of R that others make up is made of them."""
    size = np.linalg.norm(R, axis=0)
    nothing = ZERO_COLUMN * size.max()
    kept = np.array(exchange_columns(R, *independent_columns(R, nothing)), int)  # also where there is none
    made = np.setdiff1d(np.flatnonzero(size > nothing), kept)
    T = np.zeros((R.shape[1], R.shape[1]))
    T[kept, kept] = 1.0
    T[np.ix_(kept, made)] = np.linalg.lstsq(R[:, kept], R[:, made], rcond=None)[0]
    return T


def advise_manoeuvres(model: Model, logs: Sequence[Samples], names: Sequence[str]) -> dict[str, str]:
    """For each of these base parameters the simplest manoeuvre that would show it apart from all others."""
    rng = np.random.default_rng(0)
    q, nu, a = (np.concatenate([getattr(s, part) for s in logs], axis=1) for part in ("q", "nu", "a"))
    chosen = rng.choice(q.shape[1], min(MAX_SAMPLES, q.shape[1]), replace=False)
    q, nu, a = q[:, chosen], nu[:, chosen], a[:, chosen]
    beside = [np.concatenate(parts, axis=1)[:, chosen] for parts in zip(*(s.beside for s in logs), strict=True)]
    # Noise of a coordinate at rest would pass for motion.
    still = np.abs(nu).max(axis=1) < STILL_SPEED
    nu, a = np.where(still[:, None], 0.0, nu), np.where(still[:, None], 0.0, a)
    here = _rows(model, q, nu, a, *beside)
    options = list_manoeuvres(model, still)
    tried = [np.concatenate([here, _rows(model, *_add_manoeuvre(m, q, nu, a, rng), *beside)]) for m in options]
    level = np.maximum(np.sqrt(np.mean([(t**2).mean(axis=0) for t in tried], axis=0)), 1e-300)
    found: dict[str, str] = {}
    for name in names:
        k = model.base.names.index(name)
        shown = np.array([_independent_size(t / level, k) for t in tried])
        more = shown - _independent_size(here / level, k)  # a log that begins at rest shows a little as it is
        if not more.max(initial=0.0) > 1e-6:
            found[name] = "no drive that was tried shows it apart from the others"
            continue
        best = options[int(np.argmax(more >= SUFFICIENT_SHARE * more.max()))]
        rest = [c for k, c in enumerate(model.coordinates) if still[k] and k in best.coordinates]
        why = f"{', '.join(rest)} never move{'s' if len(rest) == 1 else ''} in this log: " if rest else ""
        found[name] = why + best.text
    return found


def list_manoeuvres(model: Model, still: np.ndarray) -> list[TrialManoeuvre]:
    """What can be done with a machine, simple things first: driving, steering, moving each joint, all of it."""
    machine, at = model.machine, model.coordinates.index
    spins = [at(b.coordinates[0]) for b in machine.contacts if b.coordinates[0] in model.coordinates]
    joints = [b for b in machine.actuated if b.contact is None]
    along = [at(c) for c in machine.body[0].coordinates[:1] if machine.planar and c in model.coordinates]
    across = [at(c) for c in machine.body[0].coordinates[1:] if machine.planar and c in model.coordinates]
    drive = tuple(along + spins)
    found: list[TrialManoeuvre] = []
    if drive:
        if still[list(drive)].all():
            found.append(TrialManoeuvre("drive forward and backward with changing speed", drive, "move"))
        else:
            found.append(TrialManoeuvre("drive with changing speed", drive, "accelerate"))
            found.append(TrialManoeuvre("drive both forward and backward", drive, "reverse"))
    for body in joints:
        where = body.where.replace("_", " ")
        own = (at(body.coordinates[0]), *across)
        if machine.planar:
            found.append(TrialManoeuvre(f"steer (move the {where}) while driving", (*own, *drive), "move"))
        elif still[own[0]]:
            found.append(TrialManoeuvre(f"move the {where} both ways with changing speed", own, "move"))
        else:
            found.append(TrialManoeuvre(f"move the {where} with changing speed", own, "accelerate"))
            found.append(TrialManoeuvre(f"move the {where} both ways", own, "reverse"))
    if drive and across and not joints:
        found.append(TrialManoeuvre("turn (drive its sides at different speeds)", (*across, *drive), "move"))
    driven = [b.where.replace("_", " ") for b in machine.actuated if b.contact is not None]
    if len(driven) > 1:
        against = " against ".join(driven) if len(driven) == 2 else f"{', '.join(driven)} against each other"
        found.append(TrialManoeuvre(f"drive {against}", drive, "move"))
    found.append(TrialManoeuvre("move everything at once", tuple(range(len(still))), "move"))
    return found


def _add_manoeuvre(
    m: TrialManoeuvre, q: np.ndarray, nu: np.ndarray, a: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The samples with a manoeuvre added."""
    q, nu, a = q.copy(), nu.copy(), a.copy()
    for k in m.coordinates:
        if m.how == "reverse":
            nu[k] = -nu[k]
            continue
        a[k] = TRIAL_STD * rng.standard_normal(a.shape[1])
        if m.how == "move":
            nu[k] = TRIAL_STD * rng.standard_normal(a.shape[1])
            q[k] = TRIAL_STD * rng.standard_normal(a.shape[1])
    return q, nu, a


def _rows(model: Model, *sample: np.ndarray) -> np.ndarray:
    return model.stacked_regressor(*sample).reshape(-1, len(model.base.names))


def _independent_size(W: np.ndarray, k: int) -> float:
    """Length of column k that no combination of the others makes, over the root of the rows."""
    others = np.delete(W, k, axis=1)
    size = np.linalg.norm(others, axis=0)
    others = others[:, size > 0] / size[size > 0]
    rest = W[:, k] - others @ np.linalg.lstsq(others, W[:, k], rcond=1e-12)[0] if others.size else W[:, k]
    return float(np.linalg.norm(rest) / np.sqrt(len(W)))
