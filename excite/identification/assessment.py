"""The way from a method's estimate to one with its uncertainty budget and the tests of what it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import scipy

from excite.errors import NoEstimateError
from excite.identification import budget
from excite.identification.bias import Estimator
from excite.identification.budget import ToleranceErrors
from excite.identification.estimate import Estimate
from excite.identification.fit_tests import find_fit_tests, torque_courses
from excite.identification.joint import UnexplainedError
from excite.identification.tolerances import Tolerance, tolerances, with_channel_errors, with_tolerances
from excite.identification.white_residuals import WhiteResiduals, row_residuals, white_residuals, with_channels
from excite.logs import Log
from excite.model import Model
from excite.model.machine import Filter
from excite.smoothing import NotConvergedError, torque_sensor
from excite.text import format_number

LEAST_VALUES = 3  # of parameters that can testify for a wrong gain; chosen
REST_LEVEL = 0.01  # p-value of the difference from the machine file that a wrong gain must leave; chosen
MOST_JOINTS = 3  # of a machine without contacts whose states are smoothed for tests; a larger arm takes too long
CHANNEL_EFFECTS = ("channel_delay", "torque_gain")  # tolerances that rows of the driven joints show


def estimate_in_full(
    find: Estimator, exact: Estimator | None, model: Model, logs: Sequence[Log], filter: Filter
) -> Estimate:
    """Estimate with the tolerances of the machine file in the intervals, and test what is left.

    exact: the estimate if the model alone explains the logs, for a method that knows any effect: where it raises
    NoEstimateError, tolerances are tried as further parameters of it. find: the method, if exact is None or if no exact
    fit explains the logs, of a small machine with these parameters as well. Raises NoEstimateError, as the method does.
    """
    small = bool(model.slips) or (exact is not None and len(model.coordinates) <= MOST_JOINTS)
    every = [x for x in tolerances(model.machine) if small or x.effect in CHANNEL_EFFECTS]
    narrowed = [x for x in every if not x.considered]
    n, wide, estimate, explained = len(model.base.names), None, None, False
    errors = ToleranceErrors(np.zeros(0), np.zeros(0))
    full = with_tolerances(model, every) if small else with_channel_errors(model, every)
    X = full.nominal.copy()
    if exact is None:
        estimate = find(model, logs, filter)
    else:
        try:
            estimate = exact(model, logs, filter)
            explained = True
        except NoEstimateError as failed:
            if small and narrowed:
                with suppress(NoEstimateError):
                    wide = exact(with_tolerances(model, narrowed), logs, filter)
            if wide is None:
                if not isinstance(failed, UnexplainedError):
                    raise
                if small and narrowed:
                    wide = find(with_tolerances(model, narrowed), logs, filter)
                else:
                    estimate = find(model, logs, filter)
    if wide is not None:
        estimate, errors = budget.split(wide, n, narrowed)
        X[: len(wide.value)] = wide.value_or(X[: len(wide.value)])
    else:
        assert estimate is not None
        X[:n] = estimate.value_or(X[:n])
    if estimate.alignments:  # the method has them as its own parameters
        every = [x for x in every if x.effect != "channel_delay"]
        full = with_channel_errors(model, every)
    courses, labels = torque_courses(model)
    try:
        if small:
            near = estimate.smoothed or [None] * len(logs)
            at = replace(full, nominal=X)
            white = [white_residuals(at, log, filter, courses, one) for log, one in zip(logs, near, strict=True)]
        else:
            white = _beyond_torques(model, logs, filter, estimate, X[:n], every)
    except NotConvergedError:
        reason = "no motion of the machine with these parameters follows the log"
        without = "the tolerances of the machine file are not in the intervals"
        return replace(estimate, doubt=f"{estimate.doubt or reason}; {without}", smoothed=())
    if wide is not None:
        estimate = budget.consider(full, estimate, white, [x for x in every if x.considered])
    elif every:
        estimate, errors = budget.correct(full, estimate, white, every, explained)
    if not small:
        estimate = budget.leave_out_noise(estimate, white)
    shown = zip(narrowed if wide is not None else every, errors.value, errors.std, strict=True)
    tolerated = [(x.source, v, s, _describe(x, v, s)) for x, v, s in shown]
    tolerated += [*_scaled(model, estimate, every), *_alignments(model, estimate)]
    names = [torque_sensor(model, b.index).name for b in model.machine.actuated]
    torque = np.sqrt(np.mean(np.concatenate([[log.values[s] for s in names] for log in logs], axis=1) ** 2, axis=1))
    tests = find_fit_tests(full, white, labels, tolerated, estimate.std_total, torque)
    return replace(estimate, tests=tests, smoothed=())


def _beyond_torques(
    model: Model, logs: Sequence[Log], filter: Filter, estimate: Estimate, X: np.ndarray, every: Sequence[Tolerance]
) -> list[WhiteResiduals]:
    """Whiten what a method without tolerances leaves; errors of torque channels stand behind the parameters."""
    drives, begin, white = {b.where: k for k, b in enumerate(model.machine.actuated)}, 0, []
    channels = [(drives[x.where], x.effect, x.std) for x in every]
    at = replace(model, nominal=X)
    for log in logs:
        own = slice(begin, begin + len(log))
        begin = own.stop
        courses, innovations = torque_courses(model)[0], estimate.innovations
        if estimate.lacking is not None and len(model.coordinates) <= MOST_JOINTS:
            gains = [(drive, std) for drive, _, std in channels]
            white.append(with_channels(at, log, filter, courses, gains, estimate.lacking[:, own]))
            continue
        innovations = None if innovations is None else innovations[:, own]
        white.append(row_residuals(model, log, X, filter, courses, channels, innovations))
    return white


def _scaled(model: Model, estimate: Estimate, every: Sequence[Tolerance]) -> list[tuple[str, float, float, str]]:
    """Find gains that the machine file's values testify against: the logs alone never show them.

    A gain is found where the estimates differ from the file's values as one wrong gain makes them differ, all at once,
    and agree with them but for that. Sensor offsets are left out, as they change. Returns source, error and its
    standard deviation, over the tolerance, and a line.
    """
    own = np.isfinite(estimate.value) & (np.abs(model.offsets).sum(axis=0) == 0)
    if own.sum() < LEAST_VALUES:
        return []
    d, found = (estimate.value - model.nominal)[own], []
    for x in every:
        if not x.considered or x.source not in estimate.tolerated:
            continue
        s = estimate.tolerated[x.source][own]
        P = estimate.total_covariance[np.ix_(own, own)] - np.outer(s, s)
        size = np.sqrt(np.diag(P))
        if not (size > 0).all():
            continue
        inverse = np.linalg.pinv(P / np.outer(size, size), rcond=1e-10, hermitian=True)
        a, b = s / size, d / size
        information = float(a @ inverse @ a)
        amount = float(a @ inverse @ b) / information
        rest = b - amount * a
        if scipy.stats.chi2.sf(rest @ inverse @ rest, len(d) - 1) < REST_LEVEL:
            continue
        std = 1 / np.sqrt(1 + information)
        text = f"the values are the machine file's if the {x.source} is {abs(100 * amount * x.std):.1f} % off"
        # As the mean of an error that has the tolerance for its prior.
        found.append((x.source, amount * (1 - std**2), std, text))
    return found


def _alignments(model: Model, estimate: Estimate) -> list[tuple[str, float, float, str]]:
    """List the shifts in time that a method found by itself, over their tolerances."""
    found = []
    torques = [s for s in model.machine.sensor if s.kind == "torque"]
    sensors = {b.where: s.name for b in model.machine.body for s in torques if s.body == b.index}
    for x in tolerances(model.machine):
        name = next((s for s in estimate.alignments if x.effect == "channel_delay" and sensors.get(x.where) == s), "")
        if name:
            value, std = (v / x.std for v in estimate.alignments[name])
            found.append((x.source, value, std, _describe(x, value, std)))
    return found


def _describe(one: Tolerance, value: float, std: float) -> str:
    """Say by how much a quantity of the machine file is off; value, std: over its tolerance."""
    factor, unit = {"s": (1e3, "ms"), "m": (1e3, "mm"), "rad": (1e3, "mrad"), "-": (1e2, "%")}[one.unit]
    size = one.std * factor
    return (
        f"{one.source} is off by {format_number(value * size, 2)} +- {format_number(std * size, 1)} {unit}, where"
        f" {format_number(size, 2)} {unit} is its tolerance"
    )
