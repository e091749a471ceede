"""Does it hold on other data? Predicted torques and simulated signals against what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from excite.identification.estimate import Estimate
from excite.logs import Log, lowpass, samples
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import Motion, delivered_torques, exact_readings, simulate

FAR_RATIO = 4.0  # times as large or as small as in the machine file
FAR_STDS = 3.0  # deviations from it
MAX_NAMED = 4  # parameters that are named


@dataclass(frozen=True)
class SignalComparison:
    """Measured beside predicted, (m, N) each, of m signals [units]; t (N,) [s].

    percent (m,): 100 |measured - predicted| / |measured|; rms (m,) of the difference, in the signal's unit.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        return self.measured - self.predicted

    @property
    def percent(self) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100 * np.linalg.norm(self.residual, axis=1) / np.linalg.norm(self.measured, axis=1)

    @property
    def rms(self) -> np.ndarray:
        return np.sqrt(np.mean(self.residual**2, axis=1))


def compare_torques(model: Model, log: Log, estimate: Estimate, filter: Filter | None = None) -> SignalComparison:
    """Torques of a log that the parameters predict from its motion, both low-passed alike; a parameter that is unknown
    counts as zero. Slips measured with noise make this test noisy: `motions` is the sharper one."""
    filter = filter or model.machine.filter
    rate = float(model.machine.sampling_hz)
    s = samples(model, log, filter)
    p = model.expand @ np.nan_to_num(estimate.value)
    rows = list(model.actuated)
    predicted = model.predict(s.q, s.nu, s.a, p, *s.beside).full()[rows]
    units = tuple(_torque_unit(model, k) for k in rows)
    keep = slice(filter.drop[0], len(log) - filter.drop[1])
    measured, predicted = lowpass(s.Y[rows], rate, filter), lowpass(predicted, rate, filter)
    return SignalComparison(model.inputs, units, log.t[keep], measured[:, keep], predicted[:, keep])


def _torque_unit(model: Model, row: int) -> str:
    return "N m" if model.coordinates[row].startswith("theta") else "N"


def far_from_nominal(model: Model, estimate: Estimate) -> tuple[str, ...]:
    """What is said of parameters that have another sign than the machine file's or another size by FAR, offsets aside:
    of most of them a machine file is not so wrong."""
    file = model.nominal
    free = np.abs(model.offsets).sum(axis=0) > 0
    effects = {name for e in model.effects for name in e.parameters}
    own = np.array([name not in effects for name in model.base.names])
    told = np.isfinite(estimate.value) & own & ~free & (file != 0)
    sure = np.abs(estimate.value - file) > FAR_STDS * estimate.std
    ratio = np.divide(estimate.value, file, out=np.ones_like(file), where=told)
    found = [k for k in np.flatnonzero(told & sure) if not 1 / FAR_RATIO < ratio[k] < FAR_RATIO]
    if not found:
        return ()
    order = sorted(found, key=lambda k: -abs(np.log(max(ratio[k], 1e-12))))[:MAX_NAMED]
    listed = ", ".join(f"{estimate.names[k]} {estimate.value[k]:.4g} ({file[k]:.4g})" for k in order)
    more = f" and {len(found) - len(order)} more" if len(found) > len(order) else ""
    return (
        f"{estimate.method}: far from the machine file's values (in brackets): {listed}{more}; check columns, units and"
        " signs, and compare another --method",
    )


def simulate_open_loop(model: Model, log: Log, X: np.ndarray, filter: Filter | None = None) -> Motion:
    """What the torques behind a log's readings make of a machine X (n_base,) from the log's first state on, open loop.
    Raises SimulationError where the parameters are no machine."""
    s = samples(model, log, filter or model.machine.filter)
    channels = [x.full() for x in model.channels(log.t[None], X)]
    torque = delivered_torques(log.t, s.Y[list(model.actuated)].T, channels)
    return simulate(model, torque, X, s.q[:, 0], s.nu[:, 0])


def compare_motions(model: Model, log: Log, estimate: Estimate, filter: Filter | None = None) -> SignalComparison:
    """Direct simulation: the torques behind a log's readings drive the machine, from the log's first state, open loop.

    Every signal but the torques; angles count from their first reading. Errors of torques and parameters add up along
    the log, as they do in the machine's use. Raises ValueError where a parameter is unknown, SimulationError where the
    parameters are no machine.
    """
    unknown = [n for n, v in zip(estimate.names, estimate.value, strict=True) if not np.isfinite(v)]
    if unknown:
        raise ValueError(f"a simulation needs every parameter, unknown: {', '.join(unknown)}")
    X = estimate.value
    motion = simulate_open_loop(model, log, X, filter)
    exact = exact_readings(model, motion, X)
    chosen = [x for x in model.machine.sensors("full") if x.name in log.values and x.kind not in ("torque", "x", "y")]
    turned = {x.name: x.kind in ("angle", "wheel") and not x.is_rate for x in chosen}

    def counted(name: str, v: np.ndarray) -> np.ndarray:
        return v - v[0] if turned[name] else v

    return SignalComparison(
        tuple(x.name for x in chosen),
        tuple(model.machine.si_unit(x) for x in chosen),
        log.t,
        np.array([counted(x.name, log.values[x.name]) for x in chosen]),
        np.array([counted(x.name, exact[x.name]) for x in chosen]),
    )
