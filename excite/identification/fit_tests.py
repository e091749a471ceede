"""Tests of what an estimate leaves in its logs: one table for all methods.

Null hypothesis: estimate, model and noise are right, and the tolerances of the machine file hold. The residuals are
then white (`white_residuals`), and as large as those of noise simulated along the same motion. Every statistic is a sum
of squares, so its ratio to the simulated ones has Snedecor's F distribution; a largest value of several has its own
p-value times their number.
All tests together raise a false alarm with probability FALSE_ALARM (Bonferroni).
A torque error that is small and hardly moves any value is contained in the intervals, and no doubt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from excite.identification.estimate import FitTest
from excite.identification.white_residuals import SIMULATIONS, Courses, WhiteResiduals
from excite.model import Model
from excite.smoothing import normal_scores, torque_sensor
from excite.text import format_number

FALSE_ALARM = 1e-3  # probability that any test of a right estimate fails, were the machine linear; chosen
CONTAINED_SHIFT = 0.5  # [total standard deviations] by which what is left may move a value that stays valid; chosen
CONTAINED_SHARE = 0.05  # of a drive's torque (rms) that may be left then; chosen
BLOCK_S = 0.25  # length of the blocks whose sums show slow errors [s]; chosen
WINDOW_S = 0.5  # length of the windows in which bursts are sought [s]; chosen
READINGS_PER_DEGREE = 4.56  # of a noise level by differences (`white_noise`): its deviation is 1.51 / sqrt(readings)
UNSEEN_RATIO = 0.3  # of residuals over noise below which nothing in them is seen beside the noise; chosen
LAGS = 20  # of the portmanteau test; chosen
KNOTS = 5  # of a curve of speed, torque, acceleration or angle; chosen
TURNS = 2  # highest harmonic of a curve of an angle that turns around; chosen
WAVES = 6  # cosines of a curve of time; chosen
MANY = 50  # degrees of freedom whose scatter eight simulations show; chosen
LEAST_SHOWN = 1e-3  # share of a tolerance that the logs must show for a test of it; chosen
VISIBLE = 1e-4  # share of a torque error's signature beyond which it is more than rounding in single precision
FAMILIES = ("speed", "direction", "angle", "torque", "acceleration", "time")


def torque_courses(model: Model) -> tuple[Courses, tuple[tuple[int, str], ...]]:
    """Return the torque errors that are tested, and the drive and family of each column.

    Each is a curve of one quantity at one drive, times the torque's unit.
    """
    labels = tuple(
        (k, family) for k in range(len(model.inputs)) for family in FAMILIES for _ in range(_columns(model, k, family))
    )
    rows = list(model.actuated)

    def courses(q: np.ndarray, nu: np.ndarray, a: np.ndarray, u: np.ndarray) -> np.ndarray:
        made = np.zeros((len(q), u.shape[1], len(labels)))
        for k, row in enumerate(rows):
            quantities = {"speed": nu[:, row], "angle": q[:, row], "torque": u[:, k], "acceleration": a[:, row]}
            parts = [_curve(model, k, family, nu[:, row], quantities.get(family)) for family in FAMILIES]
            own = [c for c, (drive, _) in enumerate(labels) if drive == k]
            made[:, k, own] = np.concatenate(parts, axis=1)
        return made

    return courses, labels


def _turns(model: Model, drive: int) -> bool:
    return model.coordinates[model.actuated[drive]].startswith("theta") and bool(model.slips)


def _columns(model: Model, drive: int, family: str) -> int:
    if family == "angle" and _turns(model, drive):
        return 2 * TURNS
    return {"speed": 2 * KNOTS, "direction": 3, "time": WAVES}.get(family, KNOTS)


def _curve(model: Model, drive: int, family: str, speed: np.ndarray, x: np.ndarray | None) -> np.ndarray:
    """Return the basis (N, c) of a family's curves."""
    if family == "time":
        phase = (np.arange(len(speed)) + 0.5) / len(speed) * np.pi
        return np.cos(np.outer(phase, np.arange(1, WAVES + 1)))
    size = np.sqrt(np.mean(speed**2)) or 1.0
    sign = np.tanh(speed / (0.05 * size))
    if family == "direction":
        return np.stack([sign, np.abs(speed) / size, sign * np.abs(speed) / size], axis=1)
    assert x is not None
    if family == "speed":
        forward = _hats(np.abs(x))
        return np.concatenate([forward * (x > 0)[:, None], forward * (x < 0)[:, None]], axis=1)
    if family == "angle" and _turns(model, drive):
        return np.concatenate([f(np.outer(x, np.arange(1, TURNS + 1))) for f in (np.cos, np.sin)], axis=1)
    return _hats(x)


def _hats(x: np.ndarray) -> np.ndarray:
    """Piecewise linear functions (N, KNOTS) of x (N,), between quantiles of it."""
    knots = np.quantile(x, np.linspace(0, 1, KNOTS))
    knots += np.arange(KNOTS) * 1e-9 * (np.ptp(x) or 1.0)
    return np.stack([np.interp(x, knots, unit) for unit in np.eye(KNOTS)], axis=1)


def find_fit_tests(
    model: Model,
    white: Sequence[WhiteResiduals],
    labels: Sequence[tuple[int, str]],
    tolerated: Sequence[tuple[str, float, float, str]],
    std: np.ndarray,
    torque: np.ndarray,
) -> tuple[FitTest, ...]:
    """Test what an estimate leaves in its logs; the model has the tolerances as parameters.

    std (n_base,) [SI]: total standard deviations of the estimate. torque (n_u,) [N m]: rms of each drive's readings.
    labels: see `torque_courses`. tolerated: source, value and standard deviation of each tolerance's error, over the
    tolerance, and what it is in words.
    """
    found = [test for one in white for test in _noise_tests(one)]
    found += _course_tests(model, white, labels, std, torque)
    found += [_tolerance_test(*one) for one in tolerated]
    level = FALSE_ALARM / max(len(found), 1)
    return tuple(replace(t, level=level) for t in found)


def describe_failures(tests: Sequence[FitTest], most: int = 3) -> str:
    """Say what is left in which signal, the most significant first, "" if no test fails."""
    failed = sorted((t for t in tests if t.fails), key=lambda t: t.p_value)
    shown = list(dict.fromkeys(t.text for t in failed))
    more = f"; and {len(shown) - most} more" if len(shown) > most else ""
    return "; ".join(shown[:most]) + more


def _p_value(square: float, degrees: float, simulated: np.ndarray, level_degrees: float = np.inf) -> float:
    """Return the p-value of a sum of squares with so many degrees of freedom.

    simulated (B,): the same of noise. level_degrees: degrees of freedom from which the noise's level is known.
    """
    mean = float(np.mean(simulated))
    if degrees <= 0 or not mean > 0:
        return 1.0
    # Encoder counts that beat with the clock scatter more than their number says.
    degrees = min(degrees, 2 * mean**2 / max(float(np.var(simulated, ddof=1)), 1e-300)) if degrees > MANY else degrees
    return float(scipy.stats.f.sf(square / mean, degrees, min(degrees * len(simulated), level_degrees)))


def _noise_tests(one: WhiteResiduals) -> list[FitTest]:
    """Test each sensor's residuals of a log for size, slow errors, autocorrelation, a tone, bursts and outliers."""
    found = []
    step = float(np.median(np.diff(one.t)))
    for j, name in enumerate(one.names):
        used = np.flatnonzero(one.used[:, j])
        if len(used) < 4 * LAGS:
            continue
        z = one.z[used, j].astype(float)
        z = z if one.counted[j] else normal_scores(z)
        noise = one.noise[used, j].astype(float)

        level_degrees = np.inf if one.counted[j] else len(z) / READINGS_PER_DEGREE
        every = np.column_stack([z, noise])
        square = (every**2).sum(axis=0)
        ratio = np.sqrt(square[0] / np.mean(square[1:]))

        def add(what: str, statistic: tuple[np.ndarray, float], text: str, count: int = 1) -> None:
            squares, degrees = statistic
            p = min(1.0, count * _p_value(float(squares[0]), degrees, squares[1:], level_degrees))  # noqa: B023
            found.append(FitTest(name, what, p, f"{name}: {text}", contained=ratio < UNSEEN_RATIO))  # noqa: B023

        add("size", (square, len(z)), f"residuals are {ratio:.2f} times what noise gives")
        blocks = max(len(z) // max(round(BLOCK_S / step), 5), 1)
        sums = np.array([part.sum(axis=0) / np.sqrt(len(part)) for part in np.array_split(every, blocks)])
        add("slow", ((sums**2).sum(axis=0), blocks), "residuals have slow errors that noise doesn't have")
        lags = np.arange(1, LAGS + 1)
        rho = np.array([(every[lag:] * every[:-lag]).sum(axis=0) for lag in lags]) / square
        apart = rho - rho[:, 1:].mean(axis=1, keepdims=True)
        apart[:, 1:] *= np.sqrt(SIMULATIONS / (SIMULATIONS - 1))
        apart[:, 0] *= np.sqrt(SIMULATIONS / (SIMULATIONS + 1))
        portmanteau = (apart**2 / (len(z) - lags)[:, None]).sum(axis=0) * len(z) ** 2
        if not one.counted[j]:
            add("correlation", (portmanteau, LAGS), "residuals are autocorrelated")
        spectrum = np.abs(np.fft.rfft(every, axis=0))[1:-1] ** 2 * 2 / len(z)
        line, expected = _strongest(spectrum)
        frequency = (line + 1) / (len(z) * step) * len(z) / len(one.t)
        add(
            "tone",
            (np.concatenate([[spectrum[line, 0]], expected]), 2),
            f"residuals have a tone at {format_number(frequency, 2)} Hz",
            len(spectrum),
        )
        windows = max(len(z) // max(round(WINDOW_S / step), 5), 1)
        energy = np.array([(part**2).sum(axis=0) for part in np.array_split(every, windows)])
        worst = int(np.argmax(energy[:, 0]))
        at = one.t[used[min(worst * len(z) // windows, len(z) - 1)]]
        add(
            "burst",
            (np.concatenate([[energy[worst, 0]], energy[:, 1:].mean(axis=0)]), len(z) / windows),
            f"residuals are more than noise from {at:.1f} s on",
            windows,
        )
        largest = int(np.argmax(np.abs(z)))
        # Encoder counts have larger largest errors than normal noise of their size.
        usual = scipy.stats.norm.isf(0.25 / noise.size)
        level = max(np.sqrt(max(square[0], np.mean(square[1:])) / len(z)), float(np.abs(noise).max()) / usual)
        p = min(1.0, len(z) * 2 * float(scipy.stats.norm.sf(abs(z[largest]) / level)))
        found.append(FitTest(name, "outlier", p, f"{name}: an outlier at {one.t[used[largest]]:.2f} s"))
    return found


def _strongest(spectrum: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the line that stands out most from noise, and what each simulated noise has about it (B,)."""
    smooth = scipy.ndimage.uniform_filter1d(spectrum[:, 1:], min(15, len(spectrum)), axis=0, mode="nearest")
    line = int(np.argmax(spectrum[:, 0] / smooth.mean(axis=1)))
    return line, smooth[line]


def gram(white: Sequence[WhiteResiduals], prior: np.ndarray) -> np.ndarray:
    """Return the products (1 + B + C + n, ...) of residuals, simulated noise, courses and parameters over all logs.

    Encoder offsets are eliminated, each with a standard deviation of one count. prior (n, n): added to the parameters.
    """
    total: np.ndarray | None = None
    for one in white:
        parts = [one.z[:, :, None], one.noise, one.courses, one.parameters]
        columns = np.concatenate(parts, axis=2).reshape(one.z.size, -1).astype(float)
        offsets = one.offsets.reshape(one.z.size, -1).astype(float)
        cross = offsets.T @ columns
        inner = offsets.T @ offsets + np.eye(offsets.shape[1])
        own = columns.T @ columns - cross.T @ np.linalg.solve(inner, cross)
        total = own if total is None else total + own
    assert total is not None
    n = len(prior)
    total[-n:, -n:] += prior
    return total


def _course_tests(
    model: Model,
    white: Sequence[WhiteResiduals],
    labels: Sequence[tuple[int, str]],
    std: np.ndarray,
    torque: np.ndarray,
) -> list[FitTest]:
    """Test whether torque errors follow a quantity, beyond what parameters and tolerances explain (score tests)."""
    n, C = white[0].parameters.shape[2], len(labels)
    prior = model.known.information(model.scale) + 1e-9 * np.eye(n)
    G = gram(white, prior)
    B = len(G) - 1 - C - n
    data, own, p = slice(0, 1 + B), slice(1 + B, 1 + B + C), slice(1 + B + C, None)
    solved = np.linalg.solve(G[p, p], np.concatenate([G[p, data], G[p, own]], axis=1))
    score = G[own, data] - G[own, p] @ solved[:, : 1 + B]
    information = G[own, own] - G[own, p] @ solved[:, 1 + B :]
    size = np.sqrt(np.maximum(np.diag(G)[own], 1e-300))
    error = np.concatenate([one.torque_error for one in white])
    found = []
    for drive, name in enumerate(model.inputs):
        for family in FAMILIES:
            at = np.array([k for k, label in enumerate(labels) if label == (drive, family)])
            unit = size[at]
            value, axes = np.linalg.eigh(information[np.ix_(at, at)] / np.outer(unit, unit))
            seen = value > VISIBLE
            if not seen.any():
                continue
            shares = axes[:, seen].T @ (score[at] / unit[:, None])
            squares = (shares**2 / value[seen, None]).sum(axis=0)
            amount = -(axes[:, seen] @ (shares[:, 0] / value[seen])) / unit
            rms = float(np.sqrt(np.mean((error[:, at] @ amount) ** 2)))
            of = float(np.sqrt(np.mean([one.misfit[drive] ** 2 for one in white])))
            unit_text = model.machine.si_unit(torque_sensor(model, model.machine.actuated[drive].index))
            text = (
                f"{name}: residuals follow the {family}, {format_number(rms, 2)} {unit_text}"
                f" of {format_number(max(of, rms), 2)}"
            )
            p_value = _p_value(float(squares[0]), int(seen.sum()), squares[1:])
            moved = np.abs(solved[: len(std), 1 + B + at] @ amount) * model.scale[: len(std)]
            with np.errstate(invalid="ignore"):
                shift = float(np.nanmax(moved / std, initial=0.0))
            contained = shift < CONTAINED_SHIFT and rms < CONTAINED_SHARE * torque[drive]
            found.append(FitTest(name, family, p_value, text, contained=contained))
    return found


def _tolerance_test(source: str, value: float, std: float, text: str) -> FitTest:
    """Test whether an error of the machine file that the logs show is within its tolerance."""
    shown = 1 - std**2 if np.isfinite(value) else 0.0  # share of the tolerance's variance that the logs take away
    beyond = abs(value) / np.sqrt(shown) if shown > LEAST_SHOWN else 0.0
    return FitTest(source, "tolerance", float(2 * scipy.stats.norm.sf(beyond)), text)
