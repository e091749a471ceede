"""Estimates with uncertainty: from logs to parameters."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from excite.errors import MachineError, NoEstimateError, NotIdentifiableError
from excite.identification import bias
from excite.identification.bias import Estimator
from excite.identification.estimate import Estimate, add_notes
from excite.identification.identifiability import add_advice
from excite.identification.instrumental_variables import iv
from excite.identification.joint import joint
from excite.identification.linear_methods import filtered_blocks, ols, tls, wls
from excite.identification.output_error import oe
from excite.logs import NEEDED, Log, doubts_in_errors, examine
from excite.model import Model
from excite.model.machine import Filter


@dataclass(frozen=True)
class Method:
    """A way to estimate: a function(model, logs, filter).

    `effects`: which it can estimate with the base parameters: none, those in whose amounts the equations of motion are
    linear, or any. `simulates`: it finds a speed that nothing measures from the dynamics. `biased`: by slips that are
    measured with noise, so that `excite identify` looks for how much.
    """

    find: Estimator
    effects: Literal["none", "linear", "any"] = "none"
    simulates: bool = False
    biased: bool = False


def identify(model: Model, logs: Sequence[Log], method: str = "ols", filter: Filter | None = None) -> Estimate:
    """Base parameters from one log or several; single spikes are repaired, with a note (see `examine`), what
    is doubtful about a log is said, and a parameter that the logs don't show comes with the drive that would (see
    `hidden`).

    Raises ValueError for an unknown method, NotIdentifiable, LogError for a log that can't be repaired.
    """
    if method not in METHODS:
        raise ValueError(f"method: {method} is unknown, allowed: {', '.join(METHODS)}")
    if not logs:
        raise ValueError("identify: no log given")
    require_sensors(model)
    _require_method_for_effects(model, method)
    examined = [examine(model, log) for log in logs]
    mended, filter = [e.log for e in examined], filter or model.machine.filter
    if not any(v.any() for log in mended for v in log.values.values()):
        raise NotIdentifiableError(f"{mended[0].source}: every signal is zero: is the log empty of measurements?")
    doubtful = [line for e in examined for line in e.doubts]
    with doubts_in_errors(doubtful):
        try:
            estimate = add_advice(model, mended, METHODS[method].find(model, mended, filter), filter)
        except np.linalg.LinAlgError:
            raise NotIdentifiableError(
                f"{mended[0].source}: the equations of {method} are singular along this log: check the sign and unit of"
                " every column, and that the machine moves"
            ) from None
    return add_notes(estimate, *(note for e in examined for note in e.notes), *doubtful)


def require_sensors(model: Model) -> None:
    """Refuses a machine file whose sensors can't say what its equations need. Raises MachineError."""
    machine = model.machine
    have = {(s.kind, s.body) for s in machine.sensor}
    for body in machine.actuated:
        for kind in ("angle", "torque"):
            if (kind, body.index) not in have:
                raise MachineError(
                    f"{machine.name}: sensor: none of kind {kind} on joint {body.index} ({body.where}): identification"
                    " needs one"
                )
    if not machine.planar:
        return
    wheels = [s for s in machine.sensors("full") if s.kind == "wheel"]
    turns = machine.body[0].coordinates[2] in model.coordinates
    apart = len({float(s.lateral or 0) for s in wheels})
    if not wheels or (turns and apart < 2):
        raise MachineError(
            f"{machine.name}: sensor: {'two measuring wheels apart' if turns else 'a measuring wheel'} (kind wheel)"
            " must tell the speed over ground" + (" and the yaw rate" if turns else "")
        )


def _require_method_for_effects(model: Model, method: str) -> None:
    """Refuses a method that can't estimate a machine's effects. Raises MachineError."""
    able = METHODS[method].effects
    if model.plain or able == "any":
        return
    machine, others = model.machine.name, " or ".join(name for name, m in METHODS.items() if m.effects != "none")
    if able == "none":
        raise MachineError(f"{machine}: effect: method {method} doesn't know effects, use {others}")
    for e in model.effects:
        if e.name in model.nonlinear or e.effect.sensor_only:
            raise MachineError(
                f"{machine}: effect {e.name}: no least squares finds it, since the equations of motion are not linear"
                " in its amount: use joint"
            )


def add_bias(
    model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter | None = None, runs: int = bias.RUNS
) -> Estimate:
    """The estimate with its method's bias on these logs, from simulated ones (see `bootstrap`).

    Of the machine that joint smoothing finds, or instrumental variables, where they find one: least squares can be so
    far off that its own machine says nothing of its bias.
    """
    if not model.plain:
        return add_notes(estimate, "the method's bias on these logs was not looked for: the machine has effects")
    filter = filter or model.machine.filter
    around: np.ndarray | None = None
    if METHODS[estimate.method].biased:
        for find in (METHODS["joint"].find, iv):
            with suppress(NoEstimateError):
                around = find(model, logs, filter).value
                break
    return bias.add_bias(model, logs, estimate, METHODS[estimate.method].find, filter, around, runs)


def recommend_method(model: Model) -> str:
    """The method that a machine calls for: joint smoothing where slips, which are measured with noise, make the
    regressor, and for a machine with effects; least squares where a joint's own motion makes it.
    """
    return "joint" if model.slips or not model.plain else "ols"


def needed_sensors(model: Model, method: str) -> tuple[str, ...]:
    """Names of the sensors without which a method can't work on this machine."""
    speed = () if METHODS[method].simulates else ("lateral_speed",)
    kinds = (*NEEDED, *speed)
    return tuple(s.name for s in model.machine.sensors("full") if s.kind in kinds)


def restrict_to_possible(plain: Estimator) -> Estimator:
    """A linear method held to physically possible machines."""

    def method(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
        """The same, held to physically possible machines: the nearest one, by a convex program."""
        from excite.identification.consistency import constrained_estimate  # cvxpy takes a second to load

        return constrained_estimate(model, plain(model, logs, filter), filtered_blocks(model, logs, filter))

    return method


LINEAR_METHODS: dict[str, Method] = {
    "ols": Method(ols, effects="linear", biased=True),
    "wls": Method(wls, biased=True),
    "iv": Method(iv, simulates=True),
    "tls": Method(tls),
}
METHODS: dict[str, Method] = {
    **LINEAR_METHODS,
    "oe": Method(oe, simulates=True),
    "joint": Method(joint, effects="any", simulates=True),
    **{
        f"{name}+consistent": replace(m, find=restrict_to_possible(m.find), effects="none")
        for name, m in LINEAR_METHODS.items()
    },
}
