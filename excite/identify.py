"""Estimates with uncertainty: from logs to parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.signal
import scipy.stats

from excite.log import Log
from model.machine import Filter, Sensor
from model.prediction import Model

DEPENDENT = 1e-10  # a column this close to a combination of the others carries nothing [relative]


class NotIdentifiable(RuntimeError):
    """The log says nothing of any parameter, or less rows than parameters are left."""


@dataclass(frozen=True)
class Estimate:
    """Base parameters of a log, by method.

    value, std (n,) [SI] by `names`; an unidentifiable parameter has NaN in both and its reason in `unidentifiable`.
    covariance (n, n). cond_w, cond_phi: condition numbers of W and W diag(value). residual (rows, N): filtered,
    decimated. degrees: of freedom of the residual.
    """

    method: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray
    cond_w: float
    cond_phi: float
    relative_error_percent: float
    residual: np.ndarray
    degrees: int
    unidentifiable: Mapping[str, str]
    notes: tuple[str, ...]

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    @property
    def std_percent(self) -> np.ndarray:
        """Relative standard deviation [%]; infinite for a value of zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100 * self.std / np.abs(self.value)

    @property
    def quantile95(self) -> float:
        """Half width of the 95 % interval in standard deviations."""
        return float(scipy.stats.t.ppf(0.975, max(self.degrees, 1)))


@dataclass(frozen=True)
class Samples:
    """A log as the regressor needs it: q, nu, a (n_q, N) and Y (n_rows, N), all at the log's rate."""

    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    Y: np.ndarray


def identify(model: Model, logs: Sequence[Log], method: str = "ols", filter: Filter | None = None) -> Estimate:
    """Base parameters from one log or several. Raises ValueError for an unknown method, NotIdentifiable."""
    if method not in METHODS:
        raise ValueError(f"method: {method} is unknown, allowed: {', '.join(METHODS)}")
    if not logs:
        raise ValueError("identify: no log given")
    return METHODS[method](model, logs, filter or model.machine.filter)


def needed_sensors(model: Model, method: str) -> tuple[str, ...]:
    """Names of the sensors without which a method can't work on this machine."""
    needs = []
    for sensor in model.machine.sensors("full"):
        if sensor.kind in ("angle", "torque", "wheel", "lateral_speed"):
            needs.append(sensor.name)
    return tuple(needs)


def ols(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """The paper's method: filtered positions, central differences, parallel filtering of Y and W, least squares by QR.

    Standard deviations (33): sigma^2 = |Y - W X|^2 / (r - c), covariance sigma^2 (W'W)^-1. Biased where the regressor
    itself is measured with noise, as slips are, and the deviations then are too small.
    """
    blocks = [filtered_regression(model, log, filter) for log in logs]
    W = np.concatenate([w for w, _ in blocks], axis=1)
    Y = np.concatenate([y for _, y in blocks], axis=1)
    return least_squares(model, W, Y, "ols")


def filtered_regression(model: Model, log: Log, filter: Filter) -> tuple[np.ndarray, np.ndarray]:
    """W (n_rows, n, n_base) and Y (n_rows, n) of a log: prediction's regressor, filtered in parallel and decimated."""
    s = samples(model, log, filter)
    W = model.stacked(s.q, s.nu, s.a).transpose(1, 0, 2)
    first, last = filter.drop
    keep = slice(first, W.shape[1] - last)
    W, Y = W[:, keep], s.Y[:, keep]
    return decimate(W, filter.decimation), decimate(Y, filter.decimation)


def samples(model: Model, log: Log, filter: Filter) -> Samples:
    """Coordinates, velocities and accelerations of a log: zero-phase Butterworth of what is measured, then central
    differences. V_x and yaw rate come from the measuring wheels (32), V_y from its sensor.
    """
    machine = model.machine
    rate = float(machine.sampling_hz)
    n_q, N = len(model.coordinates), len(log)
    q, nu = np.zeros((n_q, N)), np.zeros((n_q, N))
    smooth = {
        s.name: lowpass(log.values[s.name], rate, filter) for s in machine.sensors("full") if s.name in log.values
    }
    wheels: list[tuple[Sensor, np.ndarray]] = []
    for sensor in machine.sensors("full"):
        if sensor.name not in smooth:
            continue
        if sensor.kind == "angle":
            k = model.coordinates.index(machine.find(sensor.body).coordinates[0])
            q[k], nu[k] = smooth[sensor.name], derivative(smooth[sensor.name], rate)
        elif sensor.kind == "wheel":
            wheels.append((sensor, derivative(smooth[sensor.name], rate)))
        elif sensor.kind == "lateral_speed":
            nu[model.coordinates.index(machine.body[0].coordinates[1])] = smooth[sensor.name]
    if wheels:
        _planar_speed(model, wheels, nu)
    a = np.array([derivative(v, rate) for v in nu])
    Y = np.zeros((n_q, N))
    for sensor in machine.sensors("full"):
        if sensor.kind == "torque":
            Y[model.coordinates.index(machine.find(sensor.body).coordinates[0])] = log.values[sensor.name]
    return Samples(q, nu, a, Y)


def _planar_speed(model: Model, wheels: list[tuple[Sensor, np.ndarray]], nu: np.ndarray) -> None:
    """V_x and yaw rate of the root from its measuring wheels: R rate = V_x - lateral yaw (32), by least squares."""
    x, _, turn = model.machine.body[0].coordinates
    rows = [k for k in (x, turn) if k in model.coordinates]
    A = np.array([[1.0, -float(s.lateral or 0)][: len(rows)] for s, _ in wheels])
    speeds = np.array([float(s.radius or 0) * rate for s, rate in wheels])
    found = np.linalg.lstsq(A, speeds, rcond=None)[0]
    for name, value in zip(rows, found, strict=True):
        nu[model.coordinates.index(name)] = value


def lowpass(x: np.ndarray, rate: float, filter: Filter) -> np.ndarray:
    """Zero-phase low-pass Butterworth (forward and backward), the ends continued by 3 x order reflected samples."""
    b, a = scipy.signal.butter(filter.order, float(filter.cutoff_hz) / (rate / 2))
    return np.asarray(scipy.signal.filtfilt(b, a, x, padlen=3 * filter.order))


def derivative(x: np.ndarray, rate: float) -> np.ndarray:
    """Central difference; one-sided at the two ends."""
    return np.gradient(x, 1 / rate)


def decimate(x: np.ndarray, factor: int) -> np.ndarray:
    """Every column (axis 1) through one zero-phase low-pass (Chebyshev I, order 8), then every factor-th row.

    The rows kept end with the last one.
    """
    if factor == 1:
        return x
    b, a = scipy.signal.cheby1(8, 0.05, 0.8 / factor)
    smooth = np.asarray(scipy.signal.filtfilt(b, a, x, axis=1, padlen=24))
    return smooth[:, (x.shape[1] - 1) % factor :: factor]


def least_squares(model: Model, W: np.ndarray, Y: np.ndarray, method: str) -> Estimate:
    """QR least squares of W (n_rows, n, n_base) X = Y (n_rows, n), columns in dependence named and left out."""
    n_base = W.shape[2]
    flat, y = W.reshape(-1, n_base), Y.reshape(-1)
    if not (np.isfinite(flat).all() and np.isfinite(y).all()):
        raise NotIdentifiable("the filtered log is not finite: is a value in it far out of range?")
    if len(y) <= n_base:
        raise NotIdentifiable(f"{len(y)} filtered rows for {n_base} parameters: the log is too short")
    keep, reasons = _independent(flat, model.base.names)
    if not keep:
        raise NotIdentifiable("the log says nothing of any parameter: does the machine move in it?")
    Q, R = np.linalg.qr(flat[:, keep])
    x = scipy.linalg.solve_triangular(R, Q.T @ y)
    residual = y - flat[:, keep] @ x
    degrees = len(y) - len(keep)
    inverse = scipy.linalg.solve_triangular(R, np.eye(len(keep)))
    covariance = np.full((n_base, n_base), np.nan)
    covariance[np.ix_(keep, keep)] = float(residual @ residual) / degrees * (inverse @ inverse.T)
    value = np.full(n_base, np.nan)
    value[keep] = x
    floor = np.array([float(model.machine.scale.get(s, 0.0)) for s in model.base.names])
    scale = np.maximum(np.abs(x), floor[keep])
    return Estimate(
        method,
        model.base.names,
        model.base.units,
        value,
        covariance,
        float(np.linalg.cond(R)),
        float(np.linalg.cond(R * scale)),
        100 * float(np.linalg.norm(residual) / np.linalg.norm(y)),
        residual.reshape(Y.shape),
        degrees,
        reasons,
        (),
    )


def _independent(W: np.ndarray, names: Sequence[str]) -> tuple[list[int], dict[str, str]]:
    """Columns that are no combination of those before them; the others with the reason."""
    size = np.linalg.norm(W, axis=0)
    scaled = W / np.where(size > 0, size, 1.0)
    keep: list[int] = []
    reasons: dict[str, str] = {}
    Q = np.zeros((len(W), 0))
    for k, name in enumerate(names):
        if size[k] == 0:
            reasons[name] = "nothing in this log depends on it"
            continue
        rest = scaled[:, k] - Q @ (Q.T @ scaled[:, k])
        rest -= Q @ (Q.T @ rest)
        if np.linalg.norm(rest) < DEPENDENT:
            partner = names[keep[int(np.argmax(np.abs(scaled[:, keep].T @ scaled[:, k])))]]
            reasons[name] = f"moves together with {partner} and others in this log"
            continue
        keep.append(k)
        Q = np.column_stack([Q, rest / np.linalg.norm(rest)])
    return keep, reasons


def torques(model: Model, log: Log, estimate: Estimate, filter: Filter | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Measured and predicted torque (n_u, N) of a log, both low-passed alike; unknown parameters count as zero."""
    filter = filter or model.machine.filter
    s = samples(model, log, filter)
    predicted = np.einsum("nrp,p->rn", model.stacked(s.q, s.nu, s.a), np.nan_to_num(estimate.value))
    rows, rate = list(model.actuated), float(model.machine.sampling_hz)
    return lowpass(s.Y[rows], rate, filter), lowpass(predicted[rows], rate, filter)


def noted(estimate: Estimate, *notes: str) -> Estimate:
    """The estimate with remarks for the report added."""
    return replace(estimate, notes=estimate.notes + notes)


def joint(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """The recommended method, joint smoothing; in a room of its own, which builds on this one."""
    from excite import smoothing

    return smoothing.joint(model, logs, filter)


Method = Callable[[Model, Sequence[Log], Filter], Estimate]
METHODS: dict[str, Method] = {"ols": ols, "joint": joint}
RECOMMENDED = "ols"
