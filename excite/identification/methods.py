"""Table of identification methods, and the way from logs to an estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from excite.errors import MachineError, NoEstimateError, NotIdentifiableError
from excite.identification import bias
from excite.identification.assessment import estimate_in_full
from excite.identification.bias import Estimator
from excite.identification.encoder_errors import correct_angles, is_encoder_error
from excite.identification.estimate import Estimate, add_notes, held_note
from excite.identification.identifiability import add_advice
from excite.identification.inverse_estimate import inverse
from excite.identification.joint import UnexplainedError, joint, joint_beside_forces, joint_exactly
from excite.identification.linear_methods import filtered_blocks, ols
from excite.identification.status import assess
from excite.logs import Log, doubts_in_errors, examine, is_needed, planar_speed_sensors, samples, unmeasured
from excite.model import Model, with_given_zeros
from excite.model.machine import Filter
from excite.simulation import outside_law
from excite.text import format_number

RATIOS_NOTE = (
    "no torque constant is given, so every value is divided by that constant, the torque or force per {} before the"
    " gear, the same for all drives; give torque_constant to get SI values"
)


@dataclass(frozen=True)
class Method:
    """An identification method: a function(model, logs, filter) that returns an Estimate.

    exact: the same if the model alone explains the logs, for methods that know that; otherwise: where it doesn't.
    effects: which it estimates beside the base parameters: none, those linear in the equations of motion, or any.
    simulates: finds an unmeasured speed from the dynamics. reads: kinds of sensor that it uses beside those of
        `LINEAR_KINDS`. biased: noisy slips bias it, so `excite identify` estimates
        its bias.
    """

    find: Estimator
    exact: Estimator | None = None
    otherwise: Estimator | None = None
    effects: Literal["none", "linear", "any"] = "none"
    simulates: bool = False
    reads: tuple[str, ...] = ()
    biased: bool = False


def identify(
    model: Model,
    logs: Sequence[Log],
    method: str = "ols",
    filter: Filter | None = None,
    explained: bool | None = None,
) -> Estimate:
    """Estimate the base parameters from one log or several.

    Single spikes are repaired with a note (see `examine`), doubts about a log are noted, and an unidentifiable
    parameter comes with the manoeuvre that would identify it. explained: True to give no estimate where the method
    knows that the model alone does not explain the logs, False if that is known to be so.

    Raises ValueError for an unknown method, MachineError for sensors or effects the method does not support,
    NotIdentifiableError, LogError for a log that cannot be repaired, and UnexplainedError.
    """
    if method not in METHODS:
        raise ValueError(f"method: {method} is unknown, allowed: {', '.join(METHODS)}")
    if not logs:
        raise ValueError("identify: no log given")
    require_sensors(model, method)
    _require_method_for_effects(model, method)
    examined = [examine(model.machine, log) for log in logs]
    repaired, filter = [e.log for e in examined], filter or model.machine.filter
    repaired = corrected_logs(model, repaired, method, filter)
    if not any(v.any() for log in repaired for v in log.values.values()):
        raise NotIdentifiableError(f"{repaired[0].source}: every signal is zero: is the log empty of measurements?")
    angles = [s for s in model.machine.sensors("full") if s.kind == "angle"]
    changes = (np.ptp(log.values[s.name]) > 0 for log in repaired for s in angles if s.name in log.values)
    if all(s.resolution is None for s in angles) and not any(changes):  # counts may stand still, readings never do
        raise NotIdentifiableError(f"{repaired[0].source}: no angle ever changes: is its sensor connected?")
    doubts = [line for e in examined for line in e.doubts]
    torques = [s.name for s in model.machine.sensors("full") if s.kind == "torque"]
    with doubts_in_errors(doubts):
        if not (
            model.known.values.any() or any(log.values[n].any() for log in repaired for n in torques if n in log.values)
        ):
            raise NotIdentifiableError(
                f"{repaired[0].source}: every torque is zero all along: are their sensors connected? Without a drive"
                " logs tell ratios only: call one value of the machine file known, other than zero, to get all others"
            )
        if model.machine.in_ratios:
            model = _as_large_as_logged(model, repaired, filter)
        try:
            chosen = METHODS[method]
            otherwise = _refuse if explained and chosen.exact else chosen.otherwise or chosen.find
            exact = _refuse if explained is False and chosen.exact else chosen.exact
            estimate = estimate_in_full(otherwise, exact, model, repaired, filter)
            estimate = add_advice(model, repaired, estimate, filter)
        except np.linalg.LinAlgError:
            raise NotIdentifiableError(
                f"{repaired[0].source}: the equations of {method} are singular along this log: check the sign and unit"
                " of every column, and that the machine moves"
            ) from None
    if METHODS[method].effects == "linear":
        estimate = _with_known_encoder_errors(model, estimate)
    if starts := _unknown_starts(model):
        estimate = add_notes(estimate, starts) if estimate.doubt else replace(estimate, doubt=starts)
    estimate = assess(model, repaired, estimate, filter)
    if estimate.share_outside_law is None:
        estimate = replace(estimate, share_outside_law=_share_outside_law(model, repaired, filter, estimate))
    ratios = (RATIOS_NOTE.format(model.machine.torque_unit),) if model.machine.in_ratios else ()
    if ratios and not model.calibration:
        ratios = (f"{ratios[0]}, or call a load known (mass and com) to get that constant",)
    unused = unused_sensors(model, method, repaired)
    said = [f"{method} does not use {', '.join(unused)}"] if unused else []
    return add_notes(estimate, *ratios, *said, *(note for e in examined for note in e.notes), *doubts)


def _as_large_as_logged(model: Model, logs: Sequence[Log], filter: Filter) -> Model:
    """Divide the machine file's values [SI] by the constant that makes their torques as large as those of the logs."""
    rows = filtered_blocks(model, logs, filter)
    logged, predicted = (
        np.linalg.norm(np.hstack(x)) for x in ([Y for _, Y in rows], [W @ model.nominal for W, _ in rows])
    )
    factor = logged / predicted if logged and predicted else 1.0
    return replace(model, nominal=factor * model.nominal, scale=factor * model.scale)


def corrected_logs(model: Model, logs: Sequence[Log], method: str, filter: Filter) -> list[Log]:
    """Return the logs as a method takes them: without the encoder errors of the machine file, unless it knows these."""
    return [correct_angles(model, log, filter) for log in logs] if METHODS[method].effects == "linear" else list(logs)


def _with_known_encoder_errors(model: Model, estimate: Estimate) -> Estimate:
    """Say of encoders' errors that they are the machine file's."""
    own = (n for e in model.effects if is_encoder_error(model, e) for n in e.parameters)
    names = set(own) & estimate.unidentifiable.keys()
    reason = (
        f"{estimate.method} takes the machine file's value, by which the readings are corrected; joint estimates it"
    )
    return replace(estimate, unidentifiable={**estimate.unidentifiable, **dict.fromkeys(names, reason)})


def _unknown_starts(model: Model) -> str:
    """Say which joints are measured as a speed only while the equations depend on their position, "" if none."""
    machine = model.machine
    angles = [s for s in machine.sensors("full") if s.kind == "angle"]
    placed = {machine.coordinate(machine.find(s.body)) for s in angles if not s.is_rate}
    rates = {machine.coordinate(machine.find(s.body)): s for s in angles if s.is_rate}
    lines = []
    for coordinate, sensor in rates.items():
        if coordinate in placed or coordinate not in model.active_coordinates:
            continue
        body = machine.find(sensor.body)
        where, what = body.where.replace("_", " "), "angle" if body.joint == "revolute" else "position"
        lines.append(
            f"the start {what} of joint {body.index} ({where}) is unknown and taken as 0: column {sensor.column} is a"
            f" speed, and the equations depend on the {what}; measure it, or be sure that logs begin at 0"
        )
    return "; ".join(lines)


def _share_outside_law(model: Model, logs: Sequence[Log], filter: Filter, estimate: Estimate) -> float | None:
    """Return the share of filtered samples outside the linear soil law at the estimated encoder zeros.

    None if a speed is not measured.
    """
    if any(unmeasured(model, log) for log in logs):
        return None
    outside = []
    for log in logs:  # one at a time, for the memory's sake
        motion = samples(model, log, filter)
        outside.append(outside_law(model, motion.q.T, motion.nu.T, estimate.value_or(model.nominal)))
    return float(np.concatenate(outside).mean())


def require_sensors(model: Model, method: str = "joint") -> None:
    """Raise MachineError if a method cannot determine the motion and torques from the machine file's sensors."""
    machine = model.machine
    present = {
        (s.kind, machine.coordinate(machine.find(s.body))) for s in machine.sensor if s.kind in ("angle", "torque")
    }
    for body in machine.actuated:
        for kind in ("angle", "torque"):
            if (kind, machine.coordinate(body)) not in present:
                raise MachineError(
                    f"{machine.name}: sensor: none of kind {kind} on joint {body.index} ({body.where}): identification"
                    " needs one"
                )
    for body, other in machine.joined_by_springs:
        for end in (body, other):
            if ("angle", machine.coordinate(end)) not in present:
                raise MachineError(
                    f"{machine.name}: sensor: none of kind angle on joint {end.index} ({end.where}): the spring of"
                    f" {body.where} bends between two encoders"
                )
    if not machine.planar:
        return
    sensors = machine.sensors("full")
    found = planar_speed_sensors(model, [s.name for s in sensors])
    known = dict(zip(found.coordinates, found.determined, strict=True))
    x, y, turn = machine.body[0].coordinates
    kinds = {s.kind for s in sensors} & set(METHODS[method].reads)
    if "ground_speed" in kinds or {"x", "y"} <= kinds or ("x" in kinds and y not in model.coordinates):
        known[x] = True
    if {"x", "y"} <= kinds and x in model.coordinates:
        known[turn] = True
    if not all(known.values()):
        wheels, others, yaw = "a measuring wheel", "or another speed over ground", ""
        if turn in known:
            wheels, yaw = "two measuring wheels apart", " and the yaw rate"
            others = "or one speed over ground and a gyro (yaw_rate)"
        gnss = "" if "ground_speed" in METHODS[method].reads else f"; {method} does not use GNSS, joint does"
        raise MachineError(
            f"{machine.name}: sensor: {wheels} (kind wheel), {others}, must measure the speed over ground{yaw}{gnss}"
        )


def _require_method_for_effects(model: Model, method: str) -> None:
    """Raise MachineError if a method cannot estimate the machine's effects; errors of encoders are corrected."""
    supported = METHODS[method].effects
    if model.plain or supported == "any":
        return
    usable = (n for n, m in METHODS.items() if m.effects != "none" and (m.find is not inverse or model.fully_driven))
    machine, others = model.machine.name, " or ".join(usable)
    if supported == "none":
        raise MachineError(f"{machine}: effect: method {method} doesn't know effects, use {others}")
    for e in model.effects:
        if e.name in model.nonlinear or (e.effect.sensor_only and not is_encoder_error(model, e)):
            raise MachineError(
                f"{machine}: effect {e.name}: least squares cannot find it, as the equations of motion are not linear"
                " in its magnitude: use joint"
            )


def add_bias(
    model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter | None = None, runs: int = bias.RUNS
) -> Estimate:
    """Add the bias of the method on these logs, from simulated ones (see `bias.add_bias`).

    The simulated machine is that of joint smoothing, if this finds one. Least squares may be so far off that its own
    machine does not show the bias.
    """
    if not model.plain:
        return add_notes(
            estimate,
            "the method's bias on these logs is unknown: simulated logs exist only for machines without effects",
        )
    filter = filter or model.machine.filter
    around: np.ndarray | None = None
    if METHODS[estimate.method].biased:
        with suppress(NoEstimateError):
            around = joint(model, logs, filter).value
    return bias.add_bias(model, logs, estimate, METHODS[estimate.method].find, filter, around, runs)


def needed_sensors(model: Model, method: str) -> tuple[str, ...]:
    """Return the names of the sensors that a method needs on this machine."""
    speed = () if METHODS[method].simulates else ("lateral_speed",)
    sensors = model.machine.sensors("full")
    planar = planar_speed_sensors(model, [s.name for s in sensors]).sensors if model.machine.planar else ()
    return tuple(s.name for s in sensors if is_needed(s, model.machine) or s.kind in speed or s in planar)


def unused_sensors(model: Model, method: str, logs: Sequence[Log]) -> tuple[str, ...]:
    """Return the names of the sensors in the logs that a method does not use."""
    chosen = METHODS[method.partition(" ")[0]]
    there = [s for s in model.machine.sensors("full") if any(s.name in log.values for log in logs)]
    planar = planar_speed_sensors(model, [s.name for s in there]).sensors if model.machine.planar else ()
    return tuple(s.name for s in there if s.kind not in (*LINEAR_KINDS, *chosen.reads) and s not in planar)


def _refuse(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Raise UnexplainedError, in the place of an estimate that cannot be, or that is not wanted."""
    raise UnexplainedError("the model alone does not explain the log")


def restrict_to_possible(plain: Estimator) -> Estimator:
    """Restrict a linear method to physically possible machines."""

    def method(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
        """The linear method restricted to physically possible machines: the nearest one, by a convex program."""
        from excite.identification.consistency import constrained_estimate  # cvxpy takes a second to load

        estimate = plain(model, logs, filter)
        at = replace(model, nominal=estimate.value_or(model.nominal)) if len(model.zeros) else model
        return constrained_estimate(model, estimate, filtered_blocks(at, logs, filter))

    return method


def relinearise(plain: Estimator) -> Estimator:
    """Repeat a linear method along the regressor of its own estimate, for encoder zeros that are sought.

    The torques are linear in all other parameters, and in a zero only near the values at which they are linearised
    (Gauss-Newton). A zero that the logs show less well than its size, the first time, would run away: it is held at the
    machine file's value. Raises NotIdentifiableError if the values don't settle.
    """

    def method(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
        """The linear method, linearised at its own estimate."""
        estimate = plain(model, logs, filter)
        free = [k for k in model.zeros if np.isnan(model.known.std[k])]
        poor = {model.base.names[k]: estimate.std[k] for k in free if estimate.std[k] > model.scale[k]}
        if poor:
            rest = with_given_zeros(model, poor)
            kept = [model.base.names.index(n) for n in rest.base.names]
            found = method(replace(rest, nominal=model.nominal[kept]), logs, filter)
            return _with_held_zeros(model, found, poor)
        for _ in range(MAX_LINEARISATIONS if len(model.zeros) else 0):
            at = estimate.value_or(model.nominal)
            estimate = plain(replace(model, nominal=at), logs, filter)
            step = np.abs(estimate.value - at) / estimate.std
            if not np.nanmax(step, initial=0.0) > SETTLED_STEP:
                return estimate
        if len(model.zeros):
            raise NotIdentifiableError(
                f"{estimate.method}: the encoder zeros that are sought don't settle: give their values in the machine"
                " file, or use joint"
            )
        return estimate

    return method


def _with_held_zeros(model: Model, found: Estimate, poor: Mapping[str, float]) -> Estimate:
    """Return an estimate for all parameters of a model from one without some encoder zeros.

    poor: standard deviation of these zeros by name.
    """
    n, at = len(model.base.names), [model.base.names.index(name) for name in found.names]
    value, covariance = np.full(n, np.nan), np.full((n, n), np.nan)
    value[at], covariance[np.ix_(at, at)] = found.value, found.covariance
    units = dict(zip(model.base.names, model.base.units, strict=True))
    reasons = {
        name: f"hardly identifiable from this log: known to {format_number(std, 2)} {units[name]} only, which"
        " is no help to find an encoder's zero"
        for name, std in poor.items()
    }
    return replace(
        found,
        names=model.base.names,
        units=model.base.units,
        value=value,
        covariance=covariance,
        unidentifiable={**found.unidentifiable, **reasons},
        notes=(*found.notes, held_note(list(poor))),
    )


MAX_LINEARISATIONS = 20  # of a linear method for encoder zeros; chosen
SETTLED_STEP = 0.01  # standard deviations; chosen
LINEAR_KINDS = ("angle", "torque", "wheel", "forward_speed", "lateral_speed")  # of sensors that every method uses
LINEAR_METHODS: dict[str, Method] = {
    "inverse": Method(inverse, effects="linear"),
    "ols": Method(relinearise(ols), effects="linear", biased=True),
}
METHODS: dict[str, Method] = {
    **LINEAR_METHODS,
    "joint": Method(
        joint,
        joint_exactly,
        joint_beside_forces,
        effects="any",
        simulates=True,
        reads=("yaw_rate", "ground_speed", "x", "y"),
    ),
    **{
        f"{name}+consistent": replace(m, find=restrict_to_possible(m.find), effects="none")
        for name, m in LINEAR_METHODS.items()
    },
}
