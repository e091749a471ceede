"""Prediction of torques along a log, and of a motion along a profile, with 95 % bands.

Along a log the motion is measured, and inverse dynamics gives the torques. A profile gives torques, and the simulation
gives the motion. Its band is propagated to first order: along each independent direction of the covariance the machine
is simulated one standard deviation to both sides. That takes two simulations a parameter and has no sampling error;
the width of a band from 50 random machines would be off by 10 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import SimulationError
from excite.identification.estimate import Estimate
from excite.identification.validation import covariance_root, validate_torques
from excite.logs import Log, PlannedDrive, derivative, motion_columns, remember, torque_column
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import play_back

NORMAL95 = 1.959964  # half width of a 95 % interval in standard deviations of normal noise


@dataclass(frozen=True)
class Prediction:
    """Predicted signals (m, N) with 95 % bands, over the time driven t (N,) [s] from the start.

    names: columns of a profile, such as u1_Nm; units.
    value (m, N): prediction. Torques along a log are low-passed, those of a profile are what the motors deliver.
    parameters, noise (m, N): half widths of 95 % intervals of the true signal by the parameters' uncertainty and by the
        sensors' noise; the band is both together.
    free: names of positions that no force depends on, so that errors of speed add up in them.
    measured, reading_band (m, N): of a log, else None: low-passed readings, and half the width of the 95 % band about
        the prediction in which they lie if the model is right.
    worst: of signals off by more than noise and parameters explain, the worst second: name, times [s], ratio.
    assumed: parameters that were not identified, taken from the machine file; their errors are in no band.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    value: np.ndarray
    parameters: np.ndarray
    noise: np.ndarray
    free: tuple[str, ...] = ()
    measured: np.ndarray | None = None
    reading_band: np.ndarray | None = None
    worst: tuple[tuple[str, float, float, float], ...] = ()
    assumed: tuple[str, ...] = ()

    @property
    def band(self) -> np.ndarray:
        """Half width (m, N) of the 95 % band of the true signals."""
        return np.hypot(self.parameters, self.noise)

    @property
    def outside(self) -> np.ndarray | None:
        """Mask (m, N) of readings outside of their 95 % band; None without a log."""
        if self.measured is None or self.reading_band is None:
            return None
        return np.abs(self.measured - self.value) > self.reading_band

    @property
    def table(self) -> pd.DataFrame:
        """Table of t_s, and of each signal the prediction, the ends of its band, and the reading if there is one."""
        columns = {"t_s": self.t}
        for k, name in enumerate(self.names):
            columns[name] = self.value[k]
            columns[f"{name}_low95"] = self.value[k] - self.band[k]
            columns[f"{name}_high95"] = self.value[k] + self.band[k]
            if self.measured is not None:
                columns[f"{name}_measured"] = self.measured[k]
        return pd.DataFrame(columns)


def predict_torques(model: Model, logs: Sequence[Log], estimate: Estimate, filter: Filter | None = None) -> Prediction:
    """Predict the torque of every drive along one log, or the stretches of one, and compare it with the readings."""
    estimate, assumed = _complete(model, estimate)
    names = tuple(torque_column(model, name) for name in model.inputs)
    begin, parts = 0.0, list[Prediction]()
    for log in logs:
        c = validate_torques(model, log, estimate, filter, prediction_noise=True)
        assert c.parameters is not None
        assert c.noise is not None
        assert c.prediction_noise is not None
        known = estimate.quantile95 * c.parameters
        worst = [(names[c.names.index(name)], begin + a, begin + b, ratio) for name, a, b, ratio in c.outside()]
        parts.append(
            Prediction(
                names,
                c.units,
                begin + c.t,
                c.predicted,
                known,
                NORMAL95 * c.prediction_noise,
                measured=c.measured,
                reading_band=np.hypot(known, NORMAL95 * c.noise),
                worst=tuple(worst),
                assumed=assumed,
            )
        )
        begin += float(log.t[-1] - log.t[0]) + 1 / float(model.machine.sampling_hz)
    return _joined(parts)


def predict_motion(model: Model, drive: PlannedDrive, estimate: Estimate) -> Prediction:
    """Predict the motion under the torques of a profile, in open loop from its first state; an arm follows positions.

    If the machine has no slips and the profile holds a motion, the torques that this motion needs come first.
    Raises SimulationError if the estimate is no machine, or its uncertainty is so large that none nearby is.
    """
    estimate, assumed = _complete(model, estimate)
    planned = None if model.slips or drive.q is None or drive.nu is None else (drive.q, drive.nu)
    forces = model.inputs if planned else ()

    def signals(X: np.ndarray) -> np.ndarray:
        motion = play_back(model, drive.torque, drive.q0, drive.nu0, drive.planned, X)
        needed = [_delivered_torques(model, *planned, drive.torque, X)] if planned else []
        return np.concatenate([*needed, motion.nu.T, motion.q.T])

    # A torque offset belongs to the sensor: it changes neither the torque delivered nor the motion.
    moves = ~np.any(model.offsets != 0, axis=0)
    value, std = _propagate(signals, estimate.value, np.where(np.outer(moves, moves), estimate.covariance, 0.0))
    columns = motion_columns(model)
    turns = [c.startswith("theta") for c in model.coordinates]
    return Prediction(
        (
            *(torque_column(model, name) for name in forces),
            *(rate for _, rate in columns),
            *(place for place, _ in columns),
        ),
        (
            *(("N m" if torque_column(model, name).endswith("Nm") else "N") for name in forces),
            *("rad/s" if turn else "m/s" for turn in turns),
            *("rad" if turn else "m" for turn in turns),
        ),
        np.arange(len(drive.torque)) / float(model.machine.sampling_hz),
        value,
        estimate.quantile95 * std,
        np.zeros_like(value),
        tuple(
            place for c, (place, _) in zip(model.coordinates, columns, strict=True) if c not in model.active_coordinates
        ),
        assumed=assumed,
    )


def _complete(model: Model, estimate: Estimate) -> tuple[Estimate, tuple[str, ...]]:
    """Fill in the machine file's values of unidentified parameters, without uncertainty, and name these parameters."""
    known = np.isfinite(estimate.value)
    covariance = np.where(np.outer(known, known), np.nan_to_num(estimate.total_covariance), 0.0)
    assumed = tuple(n for n, k in zip(estimate.names, known, strict=True) if not k)
    return replace(estimate, value=estimate.value_or(model.nominal), covariance=covariance, tolerated={}), assumed


def _propagate(
    signals: Callable[[np.ndarray], np.ndarray], X: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return signals(X) (m, N) and their standard deviations, by one standard deviation of X in each direction.

    Where one side is no machine the other one counts alone. Raises SimulationError if both are none.
    """
    value = signals(X)
    variance = np.zeros_like(value)
    for step in covariance_root(covariance).T:
        if not step.any():
            continue
        sides, failure = list[np.ndarray](), SimulationError("")
        for sign in (1.0, -1.0):
            try:
                sides.append(sign * (signals(X + sign * step) - value))
            except SimulationError as err:
                failure = err
        if not sides:
            raise SimulationError(
                f"one standard deviation from the estimate no machine can be simulated ({failure}): a log that"
                " identifies the parameters better is needed"
            )
        variance += np.mean(sides, axis=0) ** 2
    return value, np.sqrt(variance)


def _delivered_torques(model: Model, q: np.ndarray, nu: np.ndarray, u: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Torques (n_u, N) [N m] that a motion q, nu (N, n_q) needs; effects see the profile's torques u (N, n_u)."""
    beside = () if model.plain else (u.T, remember(model, q, nu, u, X).T)
    a = np.array([derivative(v, float(model.machine.sampling_hz)) for v in nu.T])
    return np.asarray(model.balance(q.T, nu.T, a, model.expand @ X, *beside).full()[list(model.actuated)])


def _joined(parts: Sequence[Prediction]) -> Prediction:
    """Join predictions of stretches that follow each other."""
    arrays: dict[str, Any] = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts], axis=-1)
        for f in fields(Prediction)
        if isinstance(getattr(parts[0], f.name), np.ndarray)
    }
    return replace(parts[0], **arrays, worst=tuple(w for p in parts for w in p.worst))
