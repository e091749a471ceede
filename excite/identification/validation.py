"""Validation on other data: predicted torques and simulated signals against measured ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from excite.identification.estimate import Estimate
from excite.logs import Log, lowpass, samples
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import Motion, delivered_torques, exact_readings, simulate

FAR_RATIO = 4.0  # ratio to the machine file's value, or its inverse, that is reported; chosen
FAR_STDS = 3.0  # distance from it that is significant [standard deviations]; chosen
MAX_NAMED = 4  # parameters in the note; chosen


@dataclass(frozen=True)
class SignalComparison:
    """Measured and predicted values (m, N) of m signals in their units, over t (N,) [s]."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Measured minus predicted (m, N)."""
        return self.measured - self.predicted

    @property
    def percent(self) -> np.ndarray:
        """100 |measured - predicted| / |measured| (m,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100 * np.linalg.norm(self.residual, axis=1) / np.linalg.norm(self.measured, axis=1)

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the residual (m,), in the signal's unit."""
        return np.sqrt(np.mean(self.residual**2, axis=1))


def compare_torques(model: Model, log: Log, estimate: Estimate, filter: Filter | None = None) -> SignalComparison:
    """Predict the torques of a log from its motion and compare them, both low-passed.

    Unidentifiable parameters count as zero. Noisy slips make this test less sensitive than `compare_motions`.
    """
    filter = filter or model.machine.filter
    rate = float(model.machine.sampling_hz)
    motion = samples(model, log, filter)
    p = model.expand @ np.nan_to_num(estimate.value)
    rows = list(model.actuated)
    predicted = model.predict(motion.q, motion.nu, motion.a, p, *motion.beside).full()[rows]
    units = tuple(_torque_unit(model, k) for k in rows)
    keep = slice(filter.drop[0], len(log) - filter.drop[1])
    measured, predicted = lowpass(motion.Y[rows], rate, filter), lowpass(predicted, rate, filter)
    return SignalComparison(model.inputs, units, log.t[keep], measured[:, keep], predicted[:, keep])


def _torque_unit(model: Model, row: int) -> str:
    return "N m" if model.coordinates[row].startswith("theta") else "N"


def far_from_nominal(model: Model, estimate: Estimate) -> tuple[str, ...]:
    """Describe parameters that differ significantly from the machine file's values in sign, or in size by FAR_RATIO.

    Offsets are left out.
    """
    nominal = model.nominal
    is_offset = np.abs(model.offsets).sum(axis=0) > 0
    effects = {name for e in model.effects for name in e.parameters}
    from_file = np.array([name not in effects for name in model.base.names])
    comparable = np.isfinite(estimate.value) & from_file & ~is_offset & (nominal != 0)
    significant = np.abs(estimate.value - nominal) > FAR_STDS * estimate.std
    ratio = np.divide(estimate.value, nominal, out=np.ones_like(nominal), where=comparable)
    far = [k for k in np.flatnonzero(comparable & significant) if not 1 / FAR_RATIO < ratio[k] < FAR_RATIO]
    if not far:
        return ()
    worst = sorted(far, key=lambda k: -abs(np.log(max(ratio[k], 1e-12))))[:MAX_NAMED]
    listed = ", ".join(f"{estimate.names[k]} {estimate.value[k]:.4g} ({nominal[k]:.4g})" for k in worst)
    rest = f" and {len(far) - len(worst)} more" if len(far) > len(worst) else ""
    return (
        f"{estimate.method}: far from the machine file's values (in brackets): {listed}{rest}; check columns, units and"
        " signs, and compare another --method",
    )


def simulate_open_loop(model: Model, log: Log, X: np.ndarray, filter: Filter | None = None) -> Motion:
    """Simulate the machine X (n_base,) under the log's torques from the log's first state. Raises SimulationError."""
    initial = samples(model, log, filter or model.machine.filter)
    channels = [x.full() for x in model.channels(log.t[None], X)]
    torque = delivered_torques(log.t, initial.Y[list(model.actuated)].T, channels)
    return simulate(model, torque, X, initial.q[:, 0], initial.nu[:, 0])


def compare_motions(model: Model, log: Log, estimate: Estimate, filter: Filter | None = None) -> SignalComparison:
    """Simulate the log's torques in open loop from its first state, and compare every signal except torques.

    Angles count from their first reading. Errors of torques and parameters accumulate, as in use. Raises ValueError if
    a parameter is unknown, SimulationError if the parameters are no machine.
    """
    unknown = [n for n, v in zip(estimate.names, estimate.value, strict=True) if not np.isfinite(v)]
    if unknown:
        raise ValueError(f"a simulation needs every parameter, unknown: {', '.join(unknown)}")
    X = estimate.value
    motion = simulate_open_loop(model, log, X, filter)
    exact = exact_readings(model, motion, X)
    sensors = [x for x in model.machine.sensors("full") if x.name in log.values and x.kind not in ("torque", "x", "y")]
    is_angle = {x.name: x.kind in ("angle", "wheel") and not x.is_rate for x in sensors}

    def counted(name: str, v: np.ndarray) -> np.ndarray:
        return v - v[0] if is_angle[name] else v

    return SignalComparison(
        tuple(x.name for x in sensors),
        tuple(model.machine.si_unit(x) for x in sensors),
        log.t,
        np.array([counted(x.name, log.values[x.name]) for x in sensors]),
        np.array([counted(x.name, exact[x.name]) for x in sensors]),
    )
