"""What an estimate is worth: its status, and values that no machine has."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from excite.errors import NotConsistentError
from excite.identification.estimate import Estimate, add_notes
from excite.identification.fit_tests import describe_failures
from excite.identification.torque_constant import torque_constant
from excite.logs import Log, samples, stretches
from excite.model import Model, required_signs
from excite.model.machine import Filter
from excite.text import format_number, format_p_value

CLEAR_STDS = 3.0  # standard deviations beyond the possible that no noise explains; chosen
MOVED_STDS = 2.0  # shift to the nearest possible machine that makes an inertial value impossible; chosen
TRIED_POSTURES = 200  # of the logs, in which the mass matrix must be positive definite; chosen
MIN_TESTED_SHARE = 1e-6  # of a known value's variance that the logs must leave for a test of it, above rounding; chosen
CONTRADICTION_LEVEL = 1e-3  # of that test; chosen
INERTIAL_INITIALS = "MXYZI"  # of the names of inertial parameters
NEVER_NEGATIVE = ("M", "XX", "YY", "ZZ")  # standard inertial parameters that no body has below zero
MIN_NOMINAL_SHARE = 1e-3  # of the largest nominal value in a unit, below which one is nearly zero; chosen
# Factor between two units, number of values that must be off by it, relative deviation from it, and what to ask. Chance
# alone leaves a value of a roughly written machine file at one of the small factors, hardly two of them; chosen.
UNIT_FACTORS = (
    (1000.0, 1, 0.1, "is a column in mm, or in kN, where the machine file says otherwise? check the sensors' units"),
    (180 / math.pi, 2, 0.1, "is an angle in degrees where the machine file says radians, or the reverse?"),
    (30 / math.pi, 2, 0.03, "is a speed in rpm where the machine file says rad/s, or the reverse?"),
)
BEYOND_CHANCE = 100.0  # factor at which no two values are by chance, however small they are; chosen
LEAST_GEAR = 2.0  # ratio from whose square on values off by it are no chance; chosen
SQUARE_TOLERANCE = 0.2  # relative deviation of values from the square of a gear ratio; chosen
STANDS = 0.01  # share of a joint's largest speed below which it stands; chosen
STANDS_S = 0.2  # [s] that it stands at the end of its travel, at least; chosen
NEAR_END = 0.005  # share of a joint's travel within which its end is; chosen
SLOWLY = 0.1  # of a joint's largest speed, at which its friction is taken; chosen
PUSH = 2.0  # times its friction, beyond which a torque moves a joint unless a stop holds it; chosen
LEAST_PUSH = 0.1  # of its largest torque, which such a torque is at least; chosen
CAUSES = "the sign of a torque or angle column, a unit, or a radius in the machine file"


def assess(model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter) -> Estimate:
    """Give an estimate its status, and mark values that no machine has.

    Status: `valid`; `doubtful` if the 95 % intervals do not hold, `doubt` says why; `invalid` if some value has a sign
    that no machine has, beyond its standard deviation and by the size that the machine file gives: then there is no
    estimate. Values that are impossible only together, by as much, leave it doubtful.
    """
    possible, clear = _signs_hold(model, estimate)
    together = ""
    stop = "; ".join(_stops(model, logs, estimate, filter))
    definite = _is_positive_definite(model, logs, estimate, filter)
    notes = [_note(estimate, int(k), bool(stop)) for k in np.flatnonzero(~possible)]
    if not definite:
        moved = np.isin(estimate.names, [n for n in model.base.names if n[0] in INERTIAL_INITIALS])
        consistent = _nearest(model, estimate)
        if consistent is None:
            together = "no possible machine is near these values: the model lacks something"
        else:
            with np.errstate(invalid="ignore"):
                shift = np.abs(consistent - estimate.value)
                moved &= shift > MOVED_STDS * estimate.std_total
            far = shift > np.maximum(CLEAR_STDS * estimate.understated * estimate.std_total, model.scale)
            if far[moved].any():
                together = (
                    "the mass matrix is not positive definite, by more than noise explains: the model lacks something"
                )
        possible &= ~moved
        notes.append("with these values the mass matrix is not positive definite: no machine has them together")
    first = (
        estimate.doubt
        or together
        or _contradiction(model, estimate)
        or "; ".join(dict.fromkeys(d for one in logs for d in one.doubts))
        or _unit_suspicion(model, estimate)
    )
    doubt = "; ".join(text for text in (stop, first, describe_failures(estimate.tests)) if text)
    if clear and not doubt:
        doubt = f"values that no machine has: check {CAUSES}"
    status = "invalid" if clear else "doubtful" if doubt else "valid"
    estimate = replace(estimate, doubt=doubt, status=status, possible=possible, prior_std=model.known.std)
    return add_notes(estimate, *notes)


def _stops(model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter) -> list[str]:
    """Say of each joint that stands at the end of its travel under more torque than its friction and load take.

    By the machine file's values and by the estimate: either may be wrong, one by the machine, one by the stop.
    """
    if not model.fully_driven or not model.plain:
        return []
    found = []
    for log in logs:
        s = samples(model, log, filter)
        for body in model.machine.actuated:
            k = model.coordinates.index(model.machine.coordinate(body))
            x, v = s.q[k], np.abs(s.nu[k])
            for end, outward in ((x.max(), 1.0), (x.min(), -1.0)):
                stands = np.flatnonzero((np.abs(x - end) < NEAR_END * np.ptp(x)) & (v < STANDS * v.max()))
                if len(stands) * float(np.diff(log.t).min()) < STANDS_S:
                    continue
                q = s.q[:, stands]
                slow = np.zeros_like(q)
                slow[k] = outward * SLOWLY * v.max()
                load, turning = (model.stacked_regressor(q, nu, 0 * q)[:, k] for nu in (0 * q, slow))
                either = (model.nominal, estimate.value_or(model.nominal))
                friction = max(float(np.abs((turning - load) @ X).max()) for X in either)
                push = np.zeros(len(x))
                push[stands] = np.min([outward * (s.Y[k, stands] - load @ X) for X in either], axis=0)
                held = push > max(PUSH * friction, LEAST_PUSH * float(np.abs(s.Y[k]).max()))
                runs = [(a, b) for a, b in stretches(held) if log.t[b] - log.t[a] > STANDS_S]
                if runs:
                    a, b = runs[0]
                    unit, force = ("rad", "N m") if body.joint == "revolute" else ("m", "N")
                    found.append(
                        f"{body.where} stands at {format_number(end, 3)} {unit}, where its travel ends, from"
                        f" {log.t[a]:.2f} to {log.t[b]:.2f} s, under {format_number(push[a : b + 1].mean(), 2)}"
                        f" {force} more than its load takes: did it run into a stop? the model has none; leave these"
                        " rows out"
                    )
    return found


def _contradiction(model: Model, estimate: Estimate) -> str:
    """Say which quantity that the machine file calls known the logs contradict most, "" if none.

    The misfit of the known values has the covariance I - A C A' after the logs, with C the covariance of the estimate
    (chi-squared test).
    """
    if (constant := torque_constant(model, estimate)) is not None and constant.p_value < CONTRADICTION_LEVEL:
        return (
            f"what the machine file calls known ({', '.join(constant.known)}) disagrees on the torque constant (p-value"
            f" {format_p_value(constant.p_value)}): check these values"
        )
    known = model.known
    if not known or not np.isfinite(estimate.value[np.any(known.rows != 0, axis=0)]).all():
        return ""
    A = np.where(np.isfinite(estimate.value), known.rows, 0.0)
    misfit = known.values - A @ np.nan_to_num(estimate.value)
    left = np.eye(len(misfit)) - A @ np.nan_to_num(estimate.covariance) @ A.T
    share, axes = np.linalg.eigh((left + left.T) / 2)
    tested = share > MIN_TESTED_SHARE
    if not tested.any():
        return ""
    square = (axes[:, tested].T @ misfit) ** 2 / share[tested]
    p_value = float(scipy.stats.chi2.sf(square.sum(), tested.sum()))
    if p_value >= CONTRADICTION_LEVEL:
        return ""
    worst = known.quantities[int(np.argmax(np.abs(known.pull @ misfit)))]
    return (
        f"the log contradicts what the machine file calls known, above all {worst} (p-value {format_p_value(p_value)}):"
        " check that value, or the sensors and lengths that it depends on"
    )


def _unit_suspicion(model: Model, estimate: Estimate) -> str:
    """Say which values are off the machine file's by the factor between two units, "" if none is.

    Values that the file gives as zero, or nearly so among those in the same unit, and offsets say nothing of units;
    those too small for the motion to show only of a factor beyond chance.
    """
    nominal, names = np.abs(model.nominal), np.array(model.base.names)
    units = np.array(model.base.units)
    largest = np.array([nominal[units == unit].max() for unit in units])
    comparable = np.isfinite(estimate.value) & (nominal > MIN_NOMINAL_SHARE * largest)
    comparable &= np.abs(model.offsets).sum(axis=0) == 0
    comparable &= ~np.isin(names, [n for e in model.effects for n in e.parameters])
    clear = comparable & (np.abs(estimate.value - model.nominal) > CLEAR_STDS * estimate.std_total)
    ratio = np.divide(estimate.value, model.nominal, out=np.ones_like(nominal), where=clear)
    turns = any(b.joint == "revolute" for b in model.machine.body)
    ratios = {abs(float(s.gear_ratio)) for s in model.machine.sensor if s.gear_ratio is not None}
    squares = [
        (max(n, 1 / n) ** 2, 2, SQUARE_TOLERANCE, f"that is the square of the gear_ratio {n:g}: is it upside down?")
        for n in sorted(ratios)
        if not 1 / LEAST_GEAR < n < LEAST_GEAR
    ]
    for factor, least, tolerance, question in (*squares, *(UNIT_FACTORS if turns else UNIT_FACTORS[:1])):
        for one in (factor, 1 / factor):
            sizeable = (nominal >= model.scale) | (factor > BEYOND_CHANCE and least > 1)
            off = names[clear & sizeable & (np.abs(ratio / one - 1) < tolerance)]
            if len(off) >= least:
                times = f"{format_number(factor, 3)} times {'above' if one > 1 else 'below'}"
                verb = "is" if len(off) == 1 else "are"
                return f"{', '.join(off.tolist())} {verb} about {times} the machine file's value: {question}"
    return ""


def add_consistent(model: Model, estimate: Estimate) -> Estimate:
    """Add the values of the nearest possible machine to an estimate with impossible ones, if there is one."""
    if estimate.possible is None or estimate.possible.all() or not model.plain:
        return estimate
    return replace(estimate, consistent=_nearest(model, estimate))


def _signs_hold(model: Model, estimate: Estimate) -> tuple[np.ndarray, bool]:
    """Tell which values (n,) have a sign that a machine may have, and if any clearly has not."""
    signs = required_signs(model.machine)
    possible, clear = np.ones(len(estimate.names), bool), False
    for k in range(min(len(estimate.names), len(model.base.matrix))):
        row = model.base.matrix[k]
        members = [(model.base.standard[j], float(row[j])) for j in np.flatnonzero(np.abs(row) > 1e-12)]
        wanted = {_sign(name, signs) * np.sign(share) for name, share in members}
        if len(wanted) != 1 or 0 in wanted or not np.isfinite(estimate.value[k]):
            continue
        beyond = -float(wanted.pop()) * estimate.value[k]
        if beyond > 0:
            possible[k] = False
            clear |= bool(beyond > max(CLEAR_STDS * estimate.understated * estimate.std_total[k], model.scale[k]))
    return possible, clear


def _sign(name: str, signs: dict[str, float]) -> float:
    """Sign that a standard parameter has on every machine; 0 if either is possible."""
    if name in signs:
        return signs[name]
    return 1.0 if name.rstrip("0123456789") in NEVER_NEGATIVE else 0.0


def _is_positive_definite(model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter) -> bool:
    """Tell if the mass matrix is positive definite along the logs; unidentifiable values are the machine file's."""
    if not model.plain:
        return True
    X = estimate.value_or(model.nominal)
    for log in logs:
        q = samples(model, log, filter).q
        at = np.linspace(0, q.shape[1] - 1, min(TRIED_POSTURES, q.shape[1])).astype(int)
        if not (model.pivots(q[:, at], X).full() > 0).all():
            return False
    return True


def _nearest(model: Model, estimate: Estimate) -> np.ndarray | None:
    """Values (n,) of the nearest possible machine, None if there is none."""
    from excite.identification.consistency import nearest_possible  # cvxpy takes a second to load

    try:
        return nearest_possible(model, replace(estimate, notes=())).value
    except (NotConsistentError, np.linalg.LinAlgError):
        return None


def _note(estimate: Estimate, k: int, stopped: bool = False) -> str:
    """Say of an impossible value what usually causes it. stopped: a joint ran into a stop."""
    value, std, unit = estimate.value[k], estimate.std[k], estimate.units[k]
    text = f"{estimate.names[k]} = {format_number(value, 4)} {unit}: no machine has such a value"
    if stopped:
        return f"{text}; the stop that a joint ran into may cause it"
    if abs(value) > CLEAR_STDS * std:
        return f"{text}; usual causes are {CAUSES}"
    return (
        f"{text}; with +- {format_number(std, 2)} {unit} a possible one is within its uncertainty: the log excites it"
        " poorly"
    )
