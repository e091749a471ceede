"""Where and when a fitted model misses what was measured: missing torques and forces, innovations, what is noise.

Along a smoothed log the model is told which torque, and with disturbing forces which force, would have been needed for
the machine to move as it did. Against time, speed, angle, torque, slip, distance and frequency that says what is
missing; the innovations say in which signal and when, and how much of each signal's error noise alone would make.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite import identification
from excite.diagnosis.fits import ExtendedFit, refit_all, with_true_sensor_noise
from excite.diagnosis.parallel import run_in_turn
from excite.smoothing import LinearisedLog, advance, differentiate, state_scale

BLOCK_S = 0.25  # [s] over which slow errors are means
N_BINS = 24  # of a quantity
MIN_BIN_SAMPLES = 20  # samples in a bin that is shown
MIN_RANGE_SHARE = 0.02  # of a log: what is shorter is told by when it was
CONCENTRATION = 0.6, 0.3  # so much of the misfit in at most so much of the samples is a place
MIN_PEAK_RATIO = 15.0  # of a periodogram over its mean; noise stays below 11
MAX_NOISE_MEAN_SQUARE = (
    1.6  # mean square of innovations from which a signal has something beside noise: null logs stay below
)


@dataclass(frozen=True)
class LogResiduals:
    """One log along a fit of N samples; all [SI].

    missing: torque of each driven joint, and with disturbing forces each force, by label: (N,), unit, standard
    deviation that noise gives a sample (NaN where unknown). quantities: what the machine does, by label: unit, and the
    values (N,) for each of the missing ones. linear: the log about the fit.
    """

    source: str
    t: np.ndarray
    missing: Mapping[str, tuple[np.ndarray, str, float]]
    quantities: Mapping[str, tuple[str, Mapping[str, np.ndarray]]]
    sensors: tuple[str, ...]
    linear: LinearisedLog

    @property
    def innovations(self) -> np.ndarray:
        """Of the sensors (N, m), over their deviation, NaN where a sensor tells nothing."""
        return self.linear.innovations

    @property
    def rate(self) -> float:
        return float(1 / (self.t[1] - self.t[0]))

    @property
    def block(self) -> int:
        return max(1, round(BLOCK_S * self.rate))


@dataclass(frozen=True)
class InnovationLevel:
    """How large a signal's innovations are: mean squares of all and of slow ones (means over BLOCK_S), 1 for noise."""

    mean_square: float
    slow_mean_square: float

    @property
    def systematic_percent(self) -> float:
        """The share of the (slow) error that noise doesn't make; 0 where chance may make it as large."""
        worst = max(self.mean_square, self.slow_mean_square)
        if not np.isfinite(worst):
            return float("nan")
        return 100 * (1 - 1 / worst) if worst > MAX_NOISE_MEAN_SQUARE else 0.0


def refit_with_process_noise(stage: ExtendedFit) -> ExtendedFit:
    """The same model with disturbing forces of some size; as it is where those find no fit."""
    least, known = identification.PROCESS_NOISE_LEVELS[0], stage
    while known.fit.process_noise < least or known.data.noise_inflation > 1:
        if known.process_noise_fit is None:
            (found,) = refit_all([(stage.machine, stage, least)], run_in_turn)
            return found or stage
        known = known.process_noise_fit
    return known


def residuals_of_logs(stage: ExtendedFit) -> tuple[LogResiduals, ...]:
    """What each log of a stage shows."""
    stage = with_true_sensor_noise(stage)
    return tuple(_residuals_of_log(stage, k) for k in range(len(stage.data.logs)))


def _residuals_of_log(stage: ExtendedFit, k: int) -> LogResiduals:
    c, fit, model = stage.data.space, stage.fit, stage.model
    log, r, p = stage.data.logs[k], stage.data.measurements[k], fit.trajectories[k]
    N = len(p.state)
    rate = float(stage.machine.sampling_hz)
    t = np.arange(N) / rate
    w = p.sampled_torque_error
    u = c.delivered_torques(r.torque, fit.X)[0] + w
    q, nu, _ = c.unpack(p.state)
    missing: dict[str, tuple[np.ndarray, str, float]] = {}
    own: dict[str, int | None] = {}
    for j, (name, body) in enumerate(zip(model.inputs, stage.machine.actuated, strict=True)):
        label = f"{'torque' if body.joint == 'revolute' else 'force'} {name}, {body.where.replace('_', ' ')}"
        missing[label] = w[:, j], "N m" if body.joint == "revolute" else "N", float(r.noise.torque[j])
        own[label] = body.index
    if not stage.exact:
        for label, force, unit, index in _process_forces(stage, p.state, c.inputs(u, p.ground_inputs)):
            before = missing.get(label)
            # Where forces act on a driven joint they are its missing torque as well.
            missing[label] = (before[0] + force, unit, float("nan")) if before else (force, unit, float("nan"))
            own.setdefault(label, index)
    return LogResiduals(
        log.source,
        t,
        missing,
        _quantities(stage, q, nu, u, own),
        tuple(s.name for s in c.sensors),
        fit.linear[k],
    )


def _process_forces(stage: ExtendedFit, s: np.ndarray, u: np.ndarray) -> list[tuple[str, np.ndarray, str, int | None]]:
    """The smoothed disturbing forces along states s under inputs u: label, values (N,), unit, driven body or None."""
    c, X, model = stage.data.space, stage.fit.X, stage.model
    defect = (s[1:] - advance(c, s[:-1], u[:-1], u[1:], X)) / state_scale(c)
    F = differentiate(c, s, u[:-1], u[1:], X, force=True).F / state_scale(c)[:, None]
    square = F.transpose(0, 2, 1) @ F
    square += 1e-12 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(F.shape[2])
    force = np.linalg.solve(square, F.transpose(0, 2, 1) @ np.nan_to_num(defect)[:, :, None])[:, :, 0]
    force = np.concatenate([force, force[-1:]])
    names = {0: ("force ahead", "N"), 1: ("force to the left", "N"), 2: ("yaw moment", "N m")}
    root = stage.machine.body[0].coordinates
    found: list[tuple[str, np.ndarray, str, int | None]] = []
    for j, row in enumerate(c.forced_rows):
        coordinate = model.coordinates[row]
        if stage.machine.planar and coordinate in root:
            label, unit = names[root.index(coordinate)]
            found.append((label, force[:, j], unit, None))
            continue
        body = next(b for b in stage.machine.body if coordinate in b.coordinates)
        turns = body.joint == "revolute"
        at = model.actuated.index(row) if row in model.actuated else None
        name = f" {model.inputs[at]}" if at is not None else ""
        label = f"{'torque' if turns else 'force'}{name}, {body.where.replace('_', ' ')}"
        found.append((label, force[:, j], "N m" if turns else "N", body.index))
    return found


def _quantities(
    stage: ExtendedFit, q: np.ndarray, nu: np.ndarray, u: np.ndarray, own: Mapping[str, int | None]
) -> dict[str, tuple[str, dict[str, np.ndarray]]]:
    """What the machine does at each sample, as each missing torque or force sees it: one that belongs to a joint sees
    that joint's, one that belongs to none what the contacts do on average."""
    model, machine = stage.model, stage.machine
    at = model.coordinates.index
    rate = float(machine.sampling_hz)
    t = np.arange(len(q)) / rate
    bodies = {b.index: b for b in machine.body if b.joint != "planar" and set(b.coordinates) & set(model.coordinates)}
    driven = [b.index for b in machine.actuated]
    planar = machine.planar and machine.body[0].coordinates[0] in model.coordinates
    speed = nu[:, at(machine.body[0].coordinates[0])] if planar else None
    slips = dict(zip(model.slips, model.kinematics(q.T, nu.T)[1].full(), strict=True)) if model.slips else {}
    steered = [b for b in machine.actuated if b.contact is None]
    found: dict[str, tuple[str, dict[str, np.ndarray]]] = {"time": ("s", dict.fromkeys(own, t))}

    def each(name: str, unit: str, values: Mapping[str, np.ndarray | None]) -> None:
        known = {k: v for k, v in values.items() if v is not None}
        if known:
            found[name] = unit, known

    rates = {k: nu[:, at(bodies[i].coordinates[0])] if i is not None else None for k, i in own.items()}
    angles = {k: q[:, at(bodies[i].coordinates[0])] if i is not None else None for k, i in own.items()}
    if speed is not None:
        each("speed", "m/s", dict.fromkeys(own, speed))
        distance = np.cumsum(np.abs(speed)) / rate
        each("distance", "m", dict.fromkeys(own, distance))
        rolling = {i for i, b in bodies.items() if b.contact is not None}
        each(
            "rotation",
            "rad",
            {k: np.mod(x, 2 * np.pi) if x is not None and own[k] in rolling else None for k, x in angles.items()},
        )
        for body in steered:
            each(f"{body.where} angle", "rad", dict.fromkeys(own, q[:, at(body.coordinates[0])]))
    else:
        turns = all(b.joint == "revolute" for b in bodies.values())
        each("speed", "rad/s" if turns else "m/s", rates)
        each("position", "rad" if turns else "m", angles)
    torque: dict[int | None, np.ndarray] = dict(zip(driven, u.T, strict=True))
    # A force that belongs to no joint is shown against the torque of the first.
    torque[None] = torque[driven[0]]
    unit = "N m" if all(bodies[i].joint == "revolute" for i in driven) else "N"
    each("torque" if unit == "N m" else "force", unit, {k: torque.get(i) for k, i in own.items()})
    if slips:
        mean = np.mean([x for name, x in slips.items() if name.startswith("gx")], axis=0)
        each("slip", "-", {k: mean if i is None else slips.get(f"gx{i}") for k, i in own.items()})
    return found


def bin_means(
    x: np.ndarray, y: np.ndarray, sigma: float, bins: int = N_BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means of y in bins of x with as many samples in each as can be: centres, means, twice their deviation where y is
    white noise of deviation sigma."""
    low, high = np.quantile(x, (0.002, 0.998))
    edges = np.linspace(low, high, bins + 1)
    at = np.clip(np.digitize(x, edges) - 1, 0, bins - 1)
    count = np.bincount(at, minlength=bins).astype(float)
    some = count >= MIN_BIN_SAMPLES
    safe = np.maximum(count, 1)
    centre = np.bincount(at, x, bins) / safe
    mean = np.bincount(at, y, bins) / safe
    return centre[some], mean[some], 2 * sigma / np.sqrt(count[some])


def dependence_strength(course: LogResiduals, row: str, quantity: str) -> float:
    """How clearly a quantity orders what is missing: variance between its bins over that within them (Fisher's F), of
    means over BLOCK_S; about 1 where it doesn't, 0 where it has nothing to do with it."""
    values = course.quantities[quantity][1]
    if row not in values:
        return 0.0
    b = course.block
    n = len(course.t) // b
    # Of an angle a mean over a block is no angle: its sample in the middle stands for it.
    x = values[row][: n * b].reshape(n, b)[:, b // 2]
    y = course.missing[row][0][: n * b].reshape(n, b).mean(axis=1)
    edges = np.unique(np.quantile(x, np.linspace(0, 1, N_BINS // 2 + 1)))
    if len(edges) < 3:
        return 0.0
    at = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(at, minlength=len(edges) - 1), 1)
    mean = np.bincount(at, y, len(edges) - 1) / count
    within = float(np.sum((y - mean[at]) ** 2)) / max(n - len(mean), 1)
    between = float(np.sum(count * (mean - y.mean()) ** 2)) / (len(mean) - 1)
    return between / within if within > 0 else 0.0


def amplitude_spectrum(course: LogResiduals, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [Hz] and amplitude density [unit/sqrt(Hz)] of a series of the course."""
    f, power = scipy.signal.welch(y, course.rate, nperseg=min(len(y), round(10.24 * course.rate)))
    return f[1:], np.sqrt(power[1:])


def innovation_levels(course: LogResiduals) -> dict[str, InnovationLevel]:
    """Innovations of every sensor; NaN where it tells too little."""
    found = {}
    for name, column in zip(course.sensors, course.innovations.T, strict=True):
        own = column[np.isfinite(column)]
        if len(own) < 4 * MIN_BIN_SAMPLES:
            found[name] = InnovationLevel(float("nan"), float("nan"))
            continue
        block = max(2, round(len(own) * course.block / len(column)))
        sums = own[: len(own) // block * block].reshape(-1, block).sum(axis=1)
        found[name] = InnovationLevel(float(np.mean(own**2)), float(np.mean(sums**2) / block))
    return found


def innovation_levels_over_time(course: LogResiduals) -> tuple[np.ndarray, np.ndarray]:
    """Mean square of innovations in blocks of BLOCK_S: times [s] (n,), (m, n), NaN where a sensor tells nothing."""
    b = course.block
    n = len(course.t) // b
    square = (course.innovations[: n * b] ** 2).reshape(n, b, -1)
    valid = np.isfinite(square).sum(axis=1)
    mean = np.nansum(square, axis=1) / np.where(valid > 0, valid, np.nan)
    return course.t[: n * b : b] + BLOCK_S / 2, mean.T


def locate_misfit(stage: ExtendedFit) -> tuple[str, ...]:
    """Lines that say where a misfit sits: in which signals, when, at what frequency, in which part of what the machine
    does. Empty where innovations are noise."""
    lines: list[str] = []
    for course in residuals_of_logs(stage):
        for name, size in innovation_levels(course).items():
            if not max(size.mean_square, size.slow_mean_square) > MAX_NOISE_MEAN_SQUARE:
                continue
            z = course.innovations[:, course.sensors.index(name)]
            parts = [
                f"innovations {np.sqrt(size.mean_square):.2f} times,"
                f" slow ones {np.sqrt(size.slow_mean_square):.2f} times what noise gives",
                *_concentrations(course, z),
            ]
            peak = _spectral_peak(course, z)
            if peak is not None:
                parts.append(f"a peak at {peak:.3g} Hz")
            lines.append((f"{course.source}: " if len(stage.data.logs) > 1 else "") + f"{name}: {'; '.join(parts)}")
        for label, (y, unit, _) in course.missing.items():
            peak = _spectral_peak(course, y)
            if peak is not None:
                size_y = float(np.std(y))
                lines.append(f"{label}: {size_y:.3g} {unit} missing (rms), with a peak at {peak:.3g} Hz")
    return tuple(lines)


def _concentrations(course: LogResiduals, z: np.ndarray) -> list[str]:
    """Ranges of quantities that hold most of the excess of innovations z (N,) in few of the samples."""
    b = course.block
    n = len(z) // b
    square = z[: n * b].reshape(n, b) ** 2
    valid = np.isfinite(square)
    excess = np.nansum(square, axis=1) - valid.sum(axis=1)
    slow = np.nansum(np.where(valid, z[: n * b].reshape(n, b), 0.0), axis=1) ** 2 / np.maximum(valid.sum(axis=1), 1) - 1
    excess = np.maximum(excess, 0) + np.maximum(slow, 0)
    told_blocks = valid.any(axis=1)
    excess = np.where(told_blocks, excess, 0.0)
    if not excess.sum() > 0:
        return []
    found: list[tuple[float, str]] = []
    for name, (unit, values) in course.quantities.items():
        if name == "distance":
            continue  # says what time says
        for label, series in _distinct_series(values).items():
            low, high, share, of = _densest_range(series[: n * b].reshape(n, b).mean(axis=1), excess)
            if of < MIN_RANGE_SHARE and name != "time":
                continue
            if share >= CONCENTRATION[0] and of <= CONCENTRATION[1]:
                where = f"{name}{label} from {low:.3g} to {high:.3g} {unit}".removesuffix(" -")
                found.append((share / of, f"{100 * share:.0f} % of it at {where}, {100 * of:.2g} % of the log"))
    found.sort(reverse=True)
    return [text for _, text in found[:2]]


def _distinct_series(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The different courses that a quantity has, by what to add to its name: nothing where there is one for all, else
    the joint or contact that it is of."""
    first, *others = values.values()
    if all(x is first for x in others):
        return {"": first}
    # "torque u1, front roll" is of the front roll; a force that belongs to no joint has no course of its own.
    return {f" of {row.partition(', ')[2]}": x for row, x in values.items() if ", " in row}


def _densest_range(x: np.ndarray, excess: np.ndarray) -> tuple[float, float, float, float]:
    """The shortest run of blocks in order of x that holds CONCENTRATED of the excess: range, share, share of blocks."""
    order = np.argsort(x, kind="stable")
    total = np.concatenate([[0.0], np.cumsum(excess[order])])
    goal = CONCENTRATION[0] * total[-1]
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


def _spectral_peak(course: LogResiduals, z: np.ndarray) -> float | None:
    """The frequency [Hz] of a line that stands out of the spectrum about it, above what moves with the drive (2 Hz)."""
    valid = np.isfinite(z)
    if valid.mean() < 0.5:
        return None
    z = scipy.signal.detrend(np.where(valid, z, 0.0))
    f, power = scipy.signal.periodogram(z, course.rate, window="hann")
    level = scipy.ndimage.median_filter(power, 101, mode="reflect") / np.log(2)
    high = (f > 2.0) & (level > 0)
    if not high.any():
        return None
    ratio = np.where(high, power / np.maximum(level, 1e-300), 0.0)
    k = int(np.argmax(ratio))
    return float(f[k]) if ratio[k] > MIN_PEAK_RATIO + np.log(len(f)) else None


def mean_innovation_levels(all_courses: Sequence[LogResiduals]) -> dict[str, InnovationLevel]:
    """Innovations of every sensor over several logs."""
    every = [innovation_levels(c) for c in all_courses]

    def mean(values: list[float]) -> float:
        valid = [v for v in values if np.isfinite(v)]
        return float(np.mean(valid)) if valid else float("nan")

    return {
        n: InnovationLevel(mean([e[n].mean_square for e in every]), mean([e[n].slow_mean_square for e in every]))
        for n in every[0]
    }
