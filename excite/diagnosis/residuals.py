"""Residuals of a fitted model: missing torques and forces, and innovations, by signal, time and state of the machine.

A smoothed log gives the torque errors, and beside unknown forces these, that the model needs to move as the machine
did. Plotted against time, speed, angle, torque, slip, distance and frequency they show what is missing. The innovations
show in which signal and when, and how much of each signal's error is noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite.diagnosis.fits import ExtendedFit
from excite.diagnosis.residual_tests import MIN_SYSTEMATIC_MEAN_SQUARE, TONE_MARGIN
from excite.diagnosis.spectrum import strongest_line
from excite.smoothing import SLOPES, LinearisedLog
from excite.text import format_number

BLOCK_S = 0.25  # length of a block [s] whose mean is the slow error; chosen
N_BINS = 24  # bins of a quantity; chosen
MIN_BIN_SAMPLES = 20  # samples in a bin that is shown; chosen
OUTER_QUANTILES = 0.002, 0.998  # quantiles of a quantity between which bins lie; chosen
MIN_RANGE_SHARE = 0.02  # share of a log below which a range is given by its time alone; chosen
CONCENTRATED_EXCESS = 0.6  # share of the excess in a range that is reported; chosen
CONCENTRATED_SAMPLES = 0.3  # largest share of the samples in such a range; chosen
MAX_CONCENTRATIONS = 2  # ranges that are reported for a signal; chosen
MIN_PEAK_HZ = 2.0  # frequency [Hz] below which the motion itself has peaks; chosen
SPECTRUM_SEGMENT_S = 10.24  # length of the segments of a spectrum [s]; chosen: 1024 samples at 100 Hz


@dataclass(frozen=True)
class LogResiduals:
    """Residuals of one log along a fit, N samples, all [SI].

    missing: by label, missing torque of each driven joint, and each unknown force: values (N,),
        unit, and the standard deviation of a sample from noise (NaN if unknown).
    quantities: by label, what the machine does: unit, and values (N,) for each row of `missing`.
    linear: the log, linearised about the fit.
    """

    source: str
    t: np.ndarray
    missing: Mapping[str, tuple[np.ndarray, str, float]]
    quantities: Mapping[str, tuple[str, Mapping[str, np.ndarray]]]
    sensors: tuple[str, ...]
    linear: LinearisedLog

    @property
    def innovations(self) -> np.ndarray:
        """Innovations of the sensors (N, m) over their standard deviations; NaN where there is no reading."""
        return self.linear.innovations

    @property
    def rate(self) -> float:
        return float(1 / (self.t[1] - self.t[0]))

    @property
    def block(self) -> int:
        return max(1, round(BLOCK_S * self.rate))


@dataclass(frozen=True)
class InnovationLevel:
    """Size of a signal's innovations, 1 for noise.

    mean_square: of all innovations. slow_mean_square: of their means over BLOCK_S, normalised.
    """

    mean_square: float
    slow_mean_square: float

    @property
    def systematic_percent(self) -> float:
        """Share of the (slow) error that is not noise [%]; 0 if chance can explain it."""
        worst = max(self.mean_square, self.slow_mean_square)
        if not np.isfinite(worst):
            return float("nan")
        return 100 * (1 - 1 / worst) if worst > MIN_SYSTEMATIC_MEAN_SQUARE else 0.0


def residuals_of_logs(stage: ExtendedFit) -> tuple[LogResiduals, ...]:
    """Return the residuals of each log of a fit."""
    return tuple(_residuals_of_log(stage, k) for k in range(len(stage.data.logs)))


def _residuals_of_log(stage: ExtendedFit, k: int) -> LogResiduals:
    space, fit, model = stage.data.space, stage.fit, stage.model
    log, r, p = stage.data.logs[k], stage.data.measurements[k], fit.trajectories[k]
    N = len(p.state)
    rate = float(stage.machine.sampling_hz)
    t = np.arange(N) / rate
    w = p.sampled_torque_error
    u = space.delivered_torques(r.torque, fit.X)[0] + w
    q, nu, _ = space.unpack(p.state)
    missing: dict[str, tuple[np.ndarray, str, float]] = {}
    body_of: dict[str, int | None] = {}
    for j, (name, body) in enumerate(zip(model.inputs, stage.machine.actuated, strict=True)):
        label = f"{'torque' if body.joint == 'revolute' else 'force'} {name}, {body.where.replace('_', ' ')}"
        missing[label] = w[:, j], "N m" if body.joint == "revolute" else "N", float(r.noise.torque[j])
        body_of[label] = body.index
    if not stage.exact:
        for label, force, unit, index in _unknown_forces(stage, k, w.shape[1]):
            before = missing.get(label)
            # An unknown torque of a driven joint adds to its torque error.
            missing[label] = (before[0] + force, unit, float("nan")) if before else (force, unit, float("nan"))
            body_of.setdefault(label, index)
    return LogResiduals(
        log.source,
        t,
        missing,
        _quantities(stage, q, nu, u, body_of),
        tuple(s.name for s in space.sensors),
        fit.linear[k],
    )


def _unknown_forces(stage: ExtendedFit, k: int, n_u: int) -> list[tuple[str, np.ndarray, str, int | None]]:
    """Return what is fitted beside the model along log k: label, values (N,), unit, and the body or None."""
    space, model, p = stage.data.space, stage.model, stage.fit.trajectories[k]
    features = space.features(p.state)[0][:, :, 0]
    forces = stage.fit.unknown.lacking[k].added_inputs(p.lacking, features, space.n_inputs)
    first = space.n_inputs - len(space.forces)
    if p.force_error is not None:
        forces[:, first:] += np.concatenate([p.force_error, p.force_error[-1:]])
    found: list[tuple[str, np.ndarray, str, int | None]] = []
    for j, (name, body) in enumerate(zip(model.inputs, stage.machine.actuated, strict=True)):
        turns = body.joint == "revolute"
        label = f"{'torque' if turns else 'force'} {name}, {body.where.replace('_', ' ')}"
        found.append((label, forces[:, j], "N m" if turns else "N", body.index))
    bodies = {b.index: b for b in stage.machine.body}
    for j, (index, kind) in enumerate(space.forces):
        if kind in SLOPES:
            found.append((f"slope {kind}", forces[:, first + j], "m/s2", None))
        else:
            label = f"{kind} {'moment' if kind == 'turning' else 'force'}, {bodies[index].where.replace('_', ' ')}"
            found.append((label, forces[:, first + j], "N m" if kind == "turning" else "N", index))
    return [x for x in found if x[1].any()]


def _quantities(
    stage: ExtendedFit, q: np.ndarray, nu: np.ndarray, u: np.ndarray, body_of: Mapping[str, int | None]
) -> dict[str, tuple[str, dict[str, np.ndarray]]]:
    """Return the state of the machine at each sample, as it concerns each missing torque or force.

    A torque of a joint is related to that joint; a force on the whole machine to the mean over the contacts.
    """
    model, machine = stage.model, stage.machine
    column = model.coordinates.index
    rate = float(machine.sampling_hz)
    t = np.arange(len(q)) / rate
    bodies = {b.index: b for b in machine.body if b.joint != "planar" and set(b.coordinates) & set(model.coordinates)}
    driven = [b.index for b in machine.actuated]
    planar = machine.planar and machine.body[0].coordinates[0] in model.coordinates
    speed = nu[:, column(machine.body[0].coordinates[0])] if planar else None
    slips: dict[str, np.ndarray] = {}
    if model.slips:
        at = model.true_coordinates(q, stage.fit.X)
        slips = dict(zip(model.slips, model.kinematics(at.T, nu.T)[1].full(), strict=True))
    steered = [b for b in machine.actuated if b.contact is None]
    found: dict[str, tuple[str, dict[str, np.ndarray]]] = {"time": ("s", dict.fromkeys(body_of, t))}

    def add(name: str, unit: str, values: Mapping[str, np.ndarray | None]) -> None:
        known = {k: v for k, v in values.items() if v is not None}
        if known:
            found[name] = unit, known

    rates = {k: nu[:, column(bodies[i].coordinates[0])] if i is not None else None for k, i in body_of.items()}
    angles = {k: q[:, column(bodies[i].coordinates[0])] if i is not None else None for k, i in body_of.items()}
    if speed is not None:
        add("speed", "m/s", dict.fromkeys(body_of, speed))
        distance = np.cumsum(np.abs(speed)) / rate
        add("distance", "m", dict.fromkeys(body_of, distance))
        rolling = {i for i, b in bodies.items() if b.contact is not None}
        add(
            "rotation",
            "rad",
            {k: np.mod(x, 2 * np.pi) if x is not None and body_of[k] in rolling else None for k, x in angles.items()},
        )
        for body in steered:
            add(f"{body.where} angle", "rad", dict.fromkeys(body_of, q[:, column(body.coordinates[0])]))
    else:
        turns = all(b.joint == "revolute" for b in bodies.values())
        add("speed", "rad/s" if turns else "m/s", rates)
        add("position", "rad" if turns else "m", angles)
    torque: dict[int | None, np.ndarray] = dict(zip(driven, u.T, strict=True))
    # A force on the whole machine is related to the torque of the first joint.
    torque[None] = torque[driven[0]]
    unit = "N m" if all(bodies[i].joint == "revolute" for i in driven) else "N"
    add("torque" if unit == "N m" else "force", unit, {k: torque.get(i) for k, i in body_of.items()})
    if slips:
        mean = np.mean([x for name, x in slips.items() if name.startswith("gx")], axis=0)
        add("slip", "-", {k: mean if i is None else slips.get(f"gx{i}") for k, i in body_of.items()})
    return found


def bin_means(
    x: np.ndarray, y: np.ndarray, sigma: float, bins: int = N_BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average y (N,) in bins of equal width of x (N,).

    Return centres, means, and two standard deviations of a mean if y is white noise of standard deviation sigma.
    """
    low, high = np.quantile(x, OUTER_QUANTILES)
    edges = np.linspace(low, high, bins + 1)
    indices = np.clip(np.digitize(x, edges) - 1, 0, bins - 1)
    count = np.bincount(indices, minlength=bins).astype(float)
    some = count >= MIN_BIN_SAMPLES
    safe = np.maximum(count, 1)
    centre = np.bincount(indices, x, bins) / safe
    mean = np.bincount(indices, y, bins) / safe
    return centre[some], mean[some], 2 * sigma / np.sqrt(count[some])


def dependence_strength(log_residuals: LogResiduals, row: str, quantity: str) -> float:
    """Return Fisher's F of a missing torque over bins of a quantity, from means over BLOCK_S.

    It is about 1 without a dependence, and 0 if the quantity does not concern this row.
    """
    values = log_residuals.quantities[quantity][1]
    if row not in values:
        return 0.0
    block = log_residuals.block
    n = len(log_residuals.t) // block
    # The mean of an angle that wraps is no angle: take the middle sample of a block.
    x = values[row][: n * block].reshape(n, block)[:, block // 2]
    y = log_residuals.missing[row][0][: n * block].reshape(n, block).mean(axis=1)
    edges = np.unique(np.quantile(x, np.linspace(0, 1, N_BINS // 2 + 1)))
    if len(edges) < 3:
        return 0.0
    indices = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(indices, minlength=len(edges) - 1), 1)
    mean = np.bincount(indices, y, len(edges) - 1) / count
    within = float(np.sum((y - mean[indices]) ** 2)) / max(n - len(mean), 1)
    between = float(np.sum(count * (mean - y.mean()) ** 2)) / (len(mean) - 1)
    return between / within if within > 0 else 0.0


def amplitude_spectrum(log_residuals: LogResiduals, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [Hz] and amplitude density [unit/sqrt(Hz)] of a series of the log."""
    f, power = scipy.signal.welch(
        y, log_residuals.rate, nperseg=min(len(y), round(SPECTRUM_SEGMENT_S * log_residuals.rate))
    )
    return f[1:], np.sqrt(power[1:])


def innovation_levels(log_residuals: LogResiduals) -> dict[str, InnovationLevel]:
    """Return the size of every sensor's innovations; NaN if there are too few."""
    found = {}
    for name, column in zip(log_residuals.sensors, log_residuals.innovations.T, strict=True):
        own = column[np.isfinite(column)]
        if len(own) < 4 * MIN_BIN_SAMPLES:
            found[name] = InnovationLevel(float("nan"), float("nan"))
            continue
        block = max(2, round(len(own) * log_residuals.block / len(column)))
        sums = own[: len(own) // block * block].reshape(-1, block).sum(axis=1)
        found[name] = InnovationLevel(float(np.mean(own**2)), float(np.mean(sums**2) / block))
    return found


def innovation_levels_over_time(log_residuals: LogResiduals) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,) [s] and mean squares of innovations (m, n) in blocks of BLOCK_S; NaN without readings."""
    block = log_residuals.block
    n = len(log_residuals.t) // block
    square = (log_residuals.innovations[: n * block] ** 2).reshape(n, block, -1)
    valid = np.isfinite(square).sum(axis=1)
    mean = np.nansum(square, axis=1) / np.where(valid > 0, valid, np.nan)
    return log_residuals.t[: n * block : block] + BLOCK_S / 2, mean.T


def locate_misfit(stage: ExtendedFit) -> tuple[str, ...]:
    """Describe where a misfit is, a line each: signals, times, frequencies, states of the machine.

    There are no lines if innovations are noise.
    """
    lines: list[str] = []
    for log_residuals in residuals_of_logs(stage):
        for name, size in innovation_levels(log_residuals).items():
            if not max(size.mean_square, size.slow_mean_square) > MIN_SYSTEMATIC_MEAN_SQUARE:
                continue
            z = log_residuals.innovations[:, log_residuals.sensors.index(name)]
            parts = [
                f"innovations {np.sqrt(size.mean_square):.2f} times,"
                f" slow ones {np.sqrt(size.slow_mean_square):.2f} times what noise gives",
                *concentrations(log_residuals, z),
            ]
            peak = _spectral_peak(log_residuals, z)
            if peak is not None:
                parts.append(f"a peak at {format_number(peak, 3)} Hz")
            lines.append(
                (f"{log_residuals.source}: " if len(stage.data.logs) > 1 else "") + f"{name}: {'; '.join(parts)}"
            )
        for label, (y, unit, _) in log_residuals.missing.items():
            peak = _spectral_peak(log_residuals, y)
            if peak is not None:
                size_y = float(np.std(y))
                lines.append(
                    f"{label}: {format_number(size_y, 3)} {unit} missing (rms), with a peak at"
                    f" {format_number(peak, 3)} Hz"
                )
    return tuple(lines)


def concentrations(log_residuals: LogResiduals, z: np.ndarray) -> list[str]:
    """Describe up to two ranges of quantities that hold most of the excess of innovations z (N,) in few samples."""
    block = log_residuals.block
    n = len(z) // block
    square = z[: n * block].reshape(n, block) ** 2
    valid = np.isfinite(square)
    excess = np.nansum(square, axis=1) - valid.sum(axis=1)
    slow = (
        np.nansum(np.where(valid, z[: n * block].reshape(n, block), 0.0), axis=1) ** 2
        / np.maximum(valid.sum(axis=1), 1)
        - 1
    )
    excess = np.maximum(excess, 0) + np.maximum(slow, 0)
    valid_blocks = valid.any(axis=1)
    excess = np.where(valid_blocks, excess, 0.0)
    if not excess.sum() > 0:
        return []
    found: list[tuple[float, str]] = []
    for name, (unit, values) in log_residuals.quantities.items():
        if name == "distance":
            continue  # equivalent to time
        for label, series in _distinct_series(values).items():
            low, high, share, sample_share = _densest_range(series[: n * block].reshape(n, block).mean(axis=1), excess)
            if sample_share < MIN_RANGE_SHARE and name != "time":
                continue
            if share >= CONCENTRATED_EXCESS and sample_share <= CONCENTRATED_SAMPLES:
                where = f"{name}{label} from {format_number(low, 3)} to {format_number(high, 3)} {unit}".removesuffix(
                    " -"
                )
                found.append(
                    (
                        share / sample_share,
                        f"{100 * share:.0f} % of it at {where}, {format_number(100 * sample_share, 2)} % of the log",
                    )
                )
    found.sort(reverse=True)
    return [text for _, text in found[:MAX_CONCENTRATIONS]]


def _distinct_series(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the different series of a quantity by a suffix of its name: none if all rows share one series."""
    first, *others = values.values()
    if all(x is first for x in others):
        return {"": first}
    # The label "torque u1, front roll" gives "of front roll"; labels of forces on the machine have no comma.
    return {f" of {row.partition(', ')[2]}": x for row, x in values.items() if ", " in row}


def _densest_range(x: np.ndarray, excess: np.ndarray) -> tuple[float, float, float, float]:
    """Return the shortest range of x with CONCENTRATED_EXCESS: low, high, share of the excess, share of blocks."""
    order = np.argsort(x, kind="stable")
    total = np.concatenate([[0.0], np.cumsum(excess[order])])
    goal = CONCENTRATED_EXCESS * total[-1]
    ends = np.searchsorted(total, total[:-1] + goal)
    length = np.where(ends < len(total), ends - np.arange(len(ends)), len(x) + 1)
    k = int(np.argmin(length))
    end = min(int(ends[k]), len(x))
    return (
        float(x[order[k]]),
        float(x[order[end - 1]]),
        float((total[end] - total[k]) / total[-1]),
        (end - k) / len(x),
    )


def _spectral_peak(log_residuals: LogResiduals, z: np.ndarray) -> float | None:
    """Return the frequency [Hz] of a spectral line above MIN_PEAK_HZ; None if there is none."""
    valid = np.isfinite(z)
    if valid.mean() < 0.5:
        return None
    z = scipy.signal.detrend(np.where(valid, z, 0.0))
    line = strongest_line(z, log_residuals.rate, MIN_PEAK_HZ, np.inf, TONE_MARGIN, "hann")
    return None if line is None else line[0]


def mean_innovation_levels(logs: Sequence[LogResiduals]) -> dict[str, InnovationLevel]:
    """Average the size of every sensor's innovations over logs."""
    every = [innovation_levels(log) for log in logs]

    def mean(values: list[float]) -> float:
        valid = [v for v in values if np.isfinite(v)]
        return float(np.mean(valid)) if valid else float("nan")

    return {
        n: InnovationLevel(mean([e[n].mean_square for e in every]), mean([e[n].slow_mean_square for e in every]))
        for n in every[0]
    }
