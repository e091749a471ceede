"""Inverse form of maximum likelihood, for machines whose joints are all driven and rigid.

The motion of each joint is a smooth process that encoders read at their own times; the torque read is the model's along
it, a discrepancy whose size the data set, and noise. Parameters maximise the marginal likelihood, motions and
discrepancies integrated out. `excite.smoothing` holds the numerical method.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from excite.errors import MachineError, NotIdentifiableError
from excite.identification.combinations import describe_combinations
from excite.identification.estimate import NOTHING_MOVES_MESSAGE, Discrepancy, Estimate, held_note
from excite.logs import Log, decimate, samples
from excite.model import Model
from excite.model.machine import Filter, noise_of
from excite.smoothing import InverseFit, InverseSettings, fit_inverse, root_mean_square, torque_sensors
from excite.text import format_number

SUFFICIENT_STEP = 0.2  # last step of a search that has not converged [standard deviations], up to which intervals hold
NOTABLE_SHARE = 0.02  # of a channel's rms torque, from which a discrepancy is worth a note
BLOCKS = 40  # in which rows are reduced, for the cache's sake


def recommend_method(model: Model) -> str:
    """Recommend the form of maximum likelihood that fits a machine.

    The inverse form takes any smooth motion of the joints, so each one must be driven and rigid, and the equations
    linear in the effects.
    """
    return "inverse" if model.fully_driven and model.plain else "joint"


def inverse(model: Model, logs: Sequence[Log], filter: Filter, settings: InverseSettings | None = None) -> Estimate:
    """Estimate the base parameters of a fully driven machine by the marginal likelihood of motions and torques.

    filter: only for machines with effects, whose memory is computed along the filtered motion, and for the size of
    the reported residual. Raises MachineError for other machines, NotIdentifiableError if nothing moves.
    """
    if not model.fully_driven:
        raise MachineError(
            f"{model.machine.name}: method inverse needs a drive on every joint and no contact: use joint"
        )
    _require_finite(model, logs)
    beside = [_beside(model, log, filter) for log in logs]
    fit = fit_inverse(model, logs, settings, beside)
    if fit.held.all() or not np.isfinite(fit.covariance).all():
        raise NotIdentifiableError(NOTHING_MOVES_MESSAGE)
    return _build_estimate(model, logs, filter, fit, beside)


def _require_finite(model: Model, logs: Sequence[Log]) -> None:
    """Raise NotIdentifiableError if a sensor's column is not finite."""
    for log in logs:
        for sensor in model.machine.sensors("full"):
            if sensor.name in log.values and not np.isfinite(log.values[sensor.name]).all():
                raise NotIdentifiableError(f"{log.source}: column {sensor.column} is not finite: repair it")


def _beside(model: Model, log: Log, filter: Filter) -> tuple[np.ndarray, ...]:
    """Return what effects depend on besides the motion: delivered torques (N, n_u) and memory (N, n_z)."""
    return tuple(x.T for x in samples(model, log, filter).beside)


def _build_estimate(
    model: Model, logs: Sequence[Log], filter: Filter, fit: InverseFit, beside: Sequence[tuple[np.ndarray, ...]]
) -> Estimate:
    """Convert a fit to an Estimate."""
    names, units, X = model.base.names, model.base.units, fit.X
    triangles, measured, errors = [], [], []
    sensors = torque_sensors(model)
    for log, motion, residual, extra, more in zip(logs, fit.motion, fit.residual, fit.extra, beside, strict=True):
        rows = model.stacked_regressor(*(x.T for x in motion.transpose(1, 0, 2)), *(x.T for x in more))
        triangles += [np.linalg.qr(w, mode="r") for w in np.array_split(rows.reshape(-1, len(X)), BLOCKS)]
        measured.append(decimate(np.stack([log.values[s.name] for s in sensors]), filter.decimation))
        errors.append(decimate((residual + extra).T, filter.decimation))
    R = np.asarray(np.linalg.qr(np.concatenate(triangles), mode="r"))
    free = np.flatnonzero(~fit.held).tolist()
    reasons = {
        name: describe_combinations(R, model.scale, names, units, X, fit.covariance, k, [j for j in free if j != k])
        for k, name in enumerate(names)
        if fit.held[k]
    }
    held = fit.held & np.isnan(model.known.std)
    covariance = fit.covariance.copy()
    covariance[held], covariance[:, held] = np.nan, np.nan
    notes = tuple(_notes(model, logs, fit))
    if held.any():
        notes = (held_note([n for n, yes in zip(names, held, strict=True) if yes]), *notes)
    residual, size = np.concatenate(errors, axis=1), float(np.linalg.norm(np.concatenate(measured, axis=1)))
    smallest = np.array([float(model.machine.scale.get(n, 0.0)) for n in names])
    rows = sum(log.read_in(s.name).sum() for log in logs for s in sensors)
    return Estimate(
        "inverse",
        names,
        units,
        np.where(held, np.nan, X),
        covariance,
        float(np.linalg.cond(R[:, free])),
        float(np.linalg.cond((R * np.maximum(np.abs(X), smallest))[:, free])),
        100 * float(np.linalg.norm(residual)) / size if size else np.nan,
        residual,
        max(int(rows) - len(free), 1),
        {n: r for n, r in reasons.items() if held[names.index(n)]},
        notes,
        doubt=_doubt(fit),
        discrepancy=_discrepancies(model, fit),
        innovations=np.concatenate([(r / s).T for r, s in zip(fit.residual, fit.std, strict=True)], axis=1),
        lacking=np.concatenate([x.T for x in fit.extra], axis=1),
        alignments={s.name: (float(x), float(d)) for s, x, d in zip(sensors, fit.shift, fit.shift_std, strict=True)},
    )


def _doubt(fit: InverseFit) -> str:
    """Say why the search is not at the maximum of the likelihood, "" if it is."""
    if fit.status == "converged" or fit.last_step < SUFFICIENT_STEP:
        return ""
    return (
        f"the search for the most likely parameters {fit.status}: its last step is {format_number(fit.last_step, 2)}"
        " standard deviations; check the log with `excite log check`, or start from better values in the machine file"
    )


def _discrepancies(model: Model, fit: InverseFit) -> tuple[Discrepancy, ...]:
    """List the forces that the model lacks, by channel and kind, with the rms that they have along the logs."""
    sensors = torque_sensors(model)
    found: dict[tuple[str, str], Discrepancy] = {}
    for component, _, rms in fit.components:
        sensor = sensors[component.channel]
        key = sensor.name, component.kind
        other = found[key].rms if key in found else 0.0
        found[key] = Discrepancy(
            sensor.name, component.kind, float(np.hypot(rms, other)), model.machine.si_unit(sensor), component.scale
        )
    return tuple(found.values())


def _notes(model: Model, logs: Sequence[Log], fit: InverseFit) -> list[str]:
    """Say what noise was found, and which forces the model lacks."""
    levels = []
    rms = {s.name: root_mean_square(logs, s) for s in torque_sensors(model)}
    for sensor, level, tails in zip(torque_sensors(model), fit.sizes.noise, fit.sizes.tails, strict=True):
        sheet = (
            f"data sheet {format_number(noise_of(model.machine, sensor), 3)}"
            if sensor.noise is not None
            else "no data sheet"
        )
        heavy = f", heavy tails (Student's t, {tails:g} degrees)" if np.isfinite(tails) else ""
        levels.append(f"{sensor.name} {format_number(float(level), 3)} ({sheet}){heavy}")
    notes = [f"noise per sample found in the log, SI: {', '.join(levels)}"]
    for d in _discrepancies(model, fit):
        if d.rms > NOTABLE_SHARE * rms[d.signal]:
            notes.append(
                f"{d.signal}: {format_number(d.rms, 2)} {d.unit} rms that the model does not explain, {d.kind}"
            )
    return notes
