"""Estimates with uncertainty: from logs to parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from excite import bootstrap
from excite.estimate import Estimate, NoEstimate, NotIdentifiable, noted
from excite.examine import examine
from excite.hidden import explained
from excite.instruments import iv
from excite.log import Log
from excite.outputerror import oe
from excite.processing import Samples, decimate, filtered_regression, samples
from excite.regression import least_squares, ols, tls, wls
from model.machine import Filter, MachineError
from model.prediction import Model

__all__ = [
    "METHODS",
    "Estimate",
    "Method",
    "NoEstimate",
    "NotIdentifiable",
    "Samples",
    "decimate",
    "filtered_regression",
    "identify",
    "least_squares",
    "needed_sensors",
    "noted",
    "recommended",
    "samples",
    "with_bias",
]

Method = Callable[[Model, Sequence[Log], Filter], Estimate]


def identify(model: Model, logs: Sequence[Log], method: str = "ols", filter: Filter | None = None) -> Estimate:
    """Base parameters from one log or several; single spikes are repaired, with a note (see `examine`), and
    a parameter that the logs don't show comes with the drive that would (see `hidden`).

    Raises ValueError for an unknown method, NotIdentifiable, LogError for a log that can't be repaired.
    """
    if method not in METHODS:
        raise ValueError(f"method: {method} is unknown, allowed: {', '.join(METHODS)}")
    if not logs:
        raise ValueError("identify: no log given")
    measurable(model)
    _linear(model, method)
    examined = [examine(model, log) for log in logs]
    mended, filter = [e.log for e in examined], filter or model.machine.filter
    if not any(v.any() for log in mended for v in log.values.values()):
        raise NotIdentifiable(f"{mended[0].source}: every signal is zero: is the log empty of measurements?")
    try:
        estimate = explained(model, mended, METHODS[method](model, mended, filter), filter)
    except np.linalg.LinAlgError:
        raise NotIdentifiable(
            f"{mended[0].source}: the equations of {method} are singular along this log: check the sign and unit of"
            " every column, and that the machine moves"
        ) from None
    return noted(estimate, *(note for e in examined for note in e.notes))


def measurable(model: Model) -> None:
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


def _linear(model: Model, method: str) -> None:
    """Refuses a method that can't estimate a machine's effects. Raises MachineError."""
    if model.plain or method == "joint":
        return
    machine = model.machine.name
    if method != "ols":
        raise MachineError(f"{machine}: effect: method {method} doesn't know effects, use joint, or ols")
    for e in model.effects:
        if e.name in model.nonlinear or e.effect.sensed:
            raise MachineError(
                f"{machine}: effect {e.name}: no least squares finds it, since the equations of motion are not linear"
                " in its amount: use joint"
            )


def with_bias(
    model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter | None = None, runs: int = bootstrap.RUNS
) -> Estimate:
    """The estimate with its method's bias on these logs, from simulated ones (see `bootstrap`).

    Of the machine that instrumental variables find, where they find one: least squares can be so far off that its own
    machine says nothing of its bias.
    """
    if not model.plain:
        return noted(estimate, "the method's bias on these logs was not looked for: the machine has effects")
    filter = filter or model.machine.filter
    around: np.ndarray | None = None
    if estimate.method.partition("+")[0] in ("ols", "wls"):
        with suppress(NotIdentifiable):
            around = iv(model, logs, filter).value
    return bootstrap.with_bias(model, logs, estimate, METHODS[estimate.method], filter, around, runs)


def recommended(model: Model) -> str:
    """The method that a machine calls for: joint smoothing where slips, which are measured with noise, make the
    regressor, and for a machine with effects; least squares where a joint's own motion makes it.
    """
    return "joint" if model.slips or not model.plain else "ols"


def needed_sensors(model: Model, method: str) -> tuple[str, ...]:
    """Names of the sensors without which a method can't work on this machine."""
    kinds = (
        ("angle", "torque", "wheel")
        if method.partition("+")[0] in SIMULATING
        else ("angle", "torque", "wheel", "lateral_speed")
    )
    return tuple(s.name for s in model.machine.sensors("full") if s.kind in kinds)


def joint(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """The recommended method, joint smoothing; in a room of its own, which builds on this one."""
    from excite import smoothing

    return smoothing.joint(model, logs, filter)


def possible(plain: Method) -> Method:
    """A linear method held to physically possible machines; the convex program is in a room of its own."""

    def method(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
        from excite.consistent import constrained  # cvxpy takes a second to load

        blocks = [filtered_regression(model, log, filter) for log in logs]
        return constrained(model, plain(model, logs, filter), blocks)

    return method


LINEAR: dict[str, Method] = {"ols": ols, "wls": wls, "iv": iv, "tls": tls}
METHODS: dict[str, Method] = {
    **LINEAR,
    "oe": oe,
    "joint": joint,
    **{f"{name}+consistent": possible(plain) for name, plain in LINEAR.items()},
}
SIMULATING = ("iv", "oe", "joint")  # find a speed that nothing measures from the dynamics
