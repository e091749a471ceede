"""Parameters that a log does not identify: the reason, and the manoeuvre that would identify them."""

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

MAX_SAMPLES = 400  # samples that represent the logs; chosen
STILL_SPEED = 0.01  # mean speed over a second below which a coordinate is at rest [rad/s, m/s]; chosen
STILL_COUNTS = 2  # range of an encoder within which a joint is at rest [counts]; chosen
ZERO_COLUMN = 1e-6  # size of a zero column relative to the largest one; chosen
TRIAL_STD = 0.5  # standard deviation of positions, speeds and accelerations of a trial manoeuvre [SI]; chosen
SUFFICIENT_SHARE = 0.3  # share of the best manoeuvre's gain from which a simpler one is advised; chosen
POOR_RELATIVE_STD = 0.5  # standard deviation over a parameter's size, from which it is poorly identified; chosen


@dataclass(frozen=True)
class TrialManoeuvre:
    """A manoeuvre to advise: text, the coordinates that it moves, and action (move, accelerate, reverse)."""

    text: str
    coordinates: tuple[int, ...]
    action: str


def add_advice(model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter) -> Estimate:
    """Add to unidentifiable and to poorly identified parameters the manoeuvre that would identify them."""
    size = np.maximum(np.abs(np.nan_to_num(estimate.value)), model.scale)
    poor = [
        n
        for n, motions, x in zip(estimate.names, estimate.std, size, strict=True)
        if np.isfinite(motions) and motions > POOR_RELATIVE_STD * x
    ]
    if not estimate.unidentifiable and not poor:
        return estimate
    motions = [samples(model, log, filter) for log in logs]
    advised = advise_manoeuvres(model, motions, [*estimate.unidentifiable, *poor])
    reasons = {n: f"{reason}; {advised[n]}" for n, reason in estimate.unidentifiable.items()}
    together: dict[str, list[str]] = {}
    for n in poor:
        together.setdefault(advised[n], []).append(n)
    notes = tuple(
        f"{', '.join(names)}: poorly identified from this log (standard deviation > {100 * POOR_RELATIVE_STD:g} %);"
        f" {advice}"
        for advice, names in together.items()
    )
    return add_notes(replace(estimate, unidentifiable=reasons), *notes)


def parameters_at_rest(model: Model, logs: Sequence[Log], filter: Filter, slow: bool) -> np.ndarray:
    """Find the parameters (n_base,) that logs do not identify because part of the machine is at rest."""
    return (np.diag(rest_projection(model, logs, filter, slow)) == 0) & np.isnan(model.known.std)


def rest_projection(model: Model, logs: Sequence[Log], filter: Filter, slow: bool = False) -> np.ndarray:
    """Build the matrix (n_base, n_base) that maps a regressor to that of a machine with parts exactly at rest.

    With the measured motion, the noise of a joint at rest would count as motion. A column without effect becomes zero,
    a column dependent on others becomes their combination (see `exchange_columns`), and the rest are unchanged.

    A joint is at rest if its encoder moves within STILL_COUNTS. If one is, the root is at rest below STILL_SPEED on
    average over a second.
    slow: every coordinate below STILL_SPEED is at rest.

    Returns the identity for a machine with effects, and if nothing is at rest.
    """
    identity = np.eye(len(model.base.names))
    if not model.plain:
        return identity
    machine, coordinate_index = model.machine, model.coordinates.index
    joints = [
        coordinate_index(machine.coordinate(machine.find(s.body)))
        for s in machine.sensors("full")
        if s.kind == "angle"
        and s.resolution is not None
        and all(s.name in log.values and np.ptp(log.values[s.name]) <= STILL_COUNTS * s.resolution for log in logs)
    ]
    if not joints and not slow:
        return identity
    samples_of_logs = [_with_unmeasured(model, log, samples(model, log, filter)) for log in logs]
    root = (
        [coordinate_index(c) for c in machine.body[0].coordinates if c in model.coordinates] if machine.planar else []
    )
    at_rest = np.max([_speeds(model, s) for s in samples_of_logs], axis=0) < STILL_SPEED
    at_rest &= slow | np.isin(np.arange(len(at_rest)), root)
    at_rest[joints] = True
    if not at_rest.any():
        return identity
    R = np.zeros((0, len(identity)))
    for s in samples_of_logs:
        q = np.where(at_rest[:, None], s.q.mean(axis=1, keepdims=True), s.q)
        nu, a = np.where(at_rest[:, None], 0.0, s.nu), np.where(at_rest[:, None], 0.0, s.a)
        for k in range(0, q.shape[1], BLOCK):
            block = slice(k, k + BLOCK)
            rows = _rows(model, q[:, block], nu[:, block], a[:, block])
            R = np.asarray(np.linalg.qr(np.concatenate([R, rows]), mode="r"))
    return _exact_combinations(R * model.scale) * model.scale[:, None] / model.scale


def _with_unmeasured(model: Model, log: Log, motion: Samples) -> Samples:
    """Replace speeds that no sensor measures by random ones, so that no parameter is dropped for them.

    They stay as they are if nothing else moves, and a lateral speed does if the machine does not turn.
    """
    moves = _speeds(model, motion) >= STILL_SPEED
    rows = [k for k in unmeasured(model, log) if moves.any()]
    if model.machine.planar:
        _, across, turn = model.machine.body[0].coordinates
        turns = turn in model.coordinates and moves[model.coordinates.index(turn)]
        rows = [k for k in rows if model.coordinates[k] != across or turns]
    nu, a = motion.nu.copy(), motion.a.copy()
    nu[rows], a[rows] = 1 + np.random.default_rng(0).standard_normal((2, len(rows), nu.shape[1]))
    return replace(motion, nu=nu, a=a)


def _speeds(model: Model, s: Samples) -> np.ndarray:
    """Largest speed of each coordinate (n_q,), averaged over a second."""
    second = round(float(model.machine.sampling_hz))
    return np.asarray(np.abs(scipy.ndimage.uniform_filter1d(s.nu, second, axis=1)).max(axis=1))


def _exact_combinations(R: np.ndarray) -> np.ndarray:
    """T (n, n) with R T = R to within ZERO_COLUMN; dependent columns are exact combinations of the others."""
    size = np.linalg.norm(R, axis=0)
    zero = ZERO_COLUMN * size.max()
    kept = np.array(exchange_columns(R, *independent_columns(R, zero)), int)  # an integer array even if empty
    combined = np.setdiff1d(np.flatnonzero(size > zero), kept)
    T = np.zeros((R.shape[1], R.shape[1]))
    T[kept, kept] = 1.0
    T[np.ix_(kept, combined)] = np.linalg.lstsq(R[:, kept], R[:, combined], rcond=None)[0]
    return T


def advise_manoeuvres(model: Model, logs: Sequence[Samples], names: Sequence[str]) -> dict[str, str]:
    """Find, for each named base parameter, the simplest manoeuvre that identifies it apart from all others."""
    rng = np.random.default_rng(0)
    q, nu, a = (np.concatenate([getattr(s, part) for s in logs], axis=1) for part in ("q", "nu", "a"))
    rows = rng.choice(q.shape[1], min(MAX_SAMPLES, q.shape[1]), replace=False)
    q, nu, a = q[:, rows], nu[:, rows], a[:, rows]
    beside = [np.concatenate(parts, axis=1)[:, rows] for parts in zip(*(s.beside for s in logs), strict=True)]
    # The noise of a coordinate at rest would count as motion.
    at_rest = np.abs(nu).max(axis=1) < STILL_SPEED
    nu, a = np.where(at_rest[:, None], 0.0, nu), np.where(at_rest[:, None], 0.0, a)
    regressor = _rows(model, q, nu, a, *beside)
    options = list_manoeuvres(model, at_rest)
    extended = [np.concatenate([regressor, _rows(model, *_add_manoeuvre(m, q, nu, a, rng), *beside)]) for m in options]
    level = np.maximum(np.sqrt(np.mean([(t**2).mean(axis=0) for t in extended], axis=0)), 1e-300)
    advised: dict[str, str] = {}
    for name in names:
        k = model.base.names.index(name)
        sizes = np.array([_independent_size(t / level, k) for t in extended])
        gains = sizes - _independent_size(regressor / level, k)  # beyond what the log shows by itself
        if not gains.max(initial=0.0) > 1e-6:
            advised[name] = "no manoeuvre that was tried tells this apart from the other parameters"
            continue
        best = options[int(np.argmax(gains >= SUFFICIENT_SHARE * gains.max()))]
        resting = [c for k, c in enumerate(model.coordinates) if at_rest[k] and k in best.coordinates]
        reason = f"{', '.join(resting)} never move{'s' if len(resting) == 1 else ''} in this log: " if resting else ""
        advised[name] = reason + best.text
    return advised


def list_manoeuvres(model: Model, at_rest: np.ndarray) -> list[TrialManoeuvre]:
    """List possible manoeuvres, simple ones first: driving, steering, moving each joint, moving everything."""
    machine, at = model.machine, model.coordinates.index
    spins = [at(b.coordinates[0]) for b in machine.contacts if b.coordinates[0] in model.coordinates]
    joints = [b for b in machine.actuated if b.contact is None]
    along = [at(c) for c in machine.body[0].coordinates[:1] if machine.planar and c in model.coordinates]
    across = [at(c) for c in machine.body[0].coordinates[1:] if machine.planar and c in model.coordinates]
    drive = tuple(along + spins)
    manoeuvres: list[TrialManoeuvre] = []
    if drive:
        if at_rest[list(drive)].all():
            manoeuvres.append(TrialManoeuvre("drive forward and backward with changing speed", drive, "move"))
        else:
            manoeuvres.append(TrialManoeuvre("drive with changing speed", drive, "accelerate"))
            manoeuvres.append(TrialManoeuvre("drive both forward and backward", drive, "reverse"))
    for body in joints:
        where = body.where.replace("_", " ")
        coordinates = (at(body.coordinates[0]), *across)
        if machine.planar:
            manoeuvres.append(TrialManoeuvre(f"steer (move the {where}) while driving", (*coordinates, *drive), "move"))
        elif at_rest[coordinates[0]]:
            manoeuvres.append(TrialManoeuvre(f"move the {where} both ways with changing speed", coordinates, "move"))
        else:
            manoeuvres.append(TrialManoeuvre(f"move the {where} with changing speed", coordinates, "accelerate"))
            manoeuvres.append(TrialManoeuvre(f"move the {where} both ways", coordinates, "reverse"))
    if drive and across and not joints:
        manoeuvres.append(TrialManoeuvre("turn (drive its sides at different speeds)", (*across, *drive), "move"))
    driven = [b.where.replace("_", " ") for b in machine.actuated if b.contact is not None]
    if len(driven) > 1:
        against = " against ".join(driven) if len(driven) == 2 else f"{', '.join(driven)} against each other"
        manoeuvres.append(TrialManoeuvre(f"drive {against}", drive, "move"))
    manoeuvres.append(TrialManoeuvre("move everything at once", tuple(range(len(at_rest))), "move"))
    return manoeuvres


def _add_manoeuvre(
    manoeuvre: TrialManoeuvre, q: np.ndarray, nu: np.ndarray, a: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples with a manoeuvre added."""
    q, nu, a = q.copy(), nu.copy(), a.copy()
    for k in manoeuvre.coordinates:
        if manoeuvre.action == "reverse":
            nu[k] = -nu[k]
            continue
        a[k] = TRIAL_STD * rng.standard_normal(a.shape[1])
        if manoeuvre.action == "move":
            nu[k] = TRIAL_STD * rng.standard_normal(a.shape[1])
            q[k] = TRIAL_STD * rng.standard_normal(a.shape[1])
    return q, nu, a


def _rows(model: Model, *sample: np.ndarray) -> np.ndarray:
    return model.stacked_regressor(*sample).reshape(-1, len(model.base.names))


def _independent_size(W: np.ndarray, k: int) -> float:
    """Norm of the part of column k that is independent of the others, over the root of the number of rows."""
    others = np.delete(W, k, axis=1)
    size = np.linalg.norm(others, axis=0)
    others = others[:, size > 0] / size[size > 0]
    residual = W[:, k] - others @ np.linalg.lstsq(others, W[:, k], rcond=1e-12)[0] if others.size else W[:, k]
    return float(np.linalg.norm(residual) / np.sqrt(len(W)))
