"""Fit of predicted torques in per cent, and correlations of what they leave."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from excite.identification import SignalComparison
from excite.model.machine import Filter

LAGS = 25  # of the correlations, as in the usual plot of residuals; chosen
BOUND = 1.96  # standard deviations in which 95 % of normal values are


def describe_residuals(compared: Sequence[SignalComparison], filter: Filter) -> dict[str, dict[str, Any]]:
    """Return for each torque its fit and the correlations of its residual over all logs.

    rms, expected_rms, measured_rms: of the residual, of what noise and the parameters' uncertainty make of it, and
    of the measured torque. fit_percent: 100 (1 - |y - y_predicted| / |y - mean y|). noise_percent: fit that noise
    of the sensors alone leaves, None if unknown. auto, cross: largest correlation of the residual with itself at
    another time, and with the predicted torque, over lags up to LAGS, one sample every half period of the cut-off;
    bound: that 95 % of the correlations of white noise keep. auto_outside, cross_outside: share of lags beyond it
    [%].
    """
    found: dict[str, dict[str, Any]] = {}
    for k, (name, unit) in enumerate(zip(compared[0].names, compared[0].units, strict=True)):
        pairs = [(c.residual[k], c.predicted[k] - c.predicted[k].mean()) for c in compared]
        spread = sum(float(np.sum((c.measured[k] - c.measured[k].mean()) ** 2)) for c in compared)
        error = sum(float(np.sum(e**2)) for e, _ in pairs)
        noise = [c.noise[k] for c in compared if c.noise is not None]
        expected = [c.expected[k] for c in compared if c.expected is not None]
        found[name] = {
            "unit": unit,
            "rms": np.sqrt(error / sum(len(e) for e, _ in pairs)),
            "expected_rms": float(np.sqrt(np.mean(np.concatenate(expected) ** 2))) if expected else None,
            "measured_rms": np.sqrt(np.mean(np.concatenate([c.measured[k] for c in compared]) ** 2)),
            "fit_percent": _fit(error, spread),
            "noise_percent": _fit(sum(float(np.sum(n**2)) for n in noise), spread) if noise else None,
            **_correlations(pairs, [_step(c, filter) for c in compared]),
        }
    return found


def _fit(error: float, spread: float) -> float | None:
    return 100 * (1 - np.sqrt(error / spread)) if spread > 0 else None


def _step(c: SignalComparison, filter: Filter) -> int:
    """Return the samples between two that the low-pass filter leaves independent."""
    return max(1, round(1 / (2 * float(filter.cutoff_hz) * float(c.t[1] - c.t[0]))))


def _correlations(pairs: Sequence[tuple[np.ndarray, np.ndarray]], steps: Sequence[int]) -> dict[str, Any]:
    """Return the largest auto- and cross-correlation, the bound, and the shares of lags beyond it."""
    thinned = [(e[::step] - e[::step].mean(), y[::step]) for (e, y), step in zip(pairs, steps, strict=True)]
    samples = sum(len(e) for e, _ in thinned)
    lags = min(LAGS, min(len(e) for e, _ in thinned) // 4)
    if lags < 1:
        return {}
    bound = BOUND / np.sqrt(samples)
    powers = [sum(float(v[k] @ v[k]) for v in thinned) for k in (0, 1)]
    shown: dict[str, Any] = {"bound": bound, "lags": lags}
    for key, other, delays in (("auto", 0, range(1, lags + 1)), ("cross", 1, range(-lags, lags + 1))):
        size = np.sqrt(powers[0] * powers[other])
        r = np.array([sum(_product(v[0], v[other], lag) for v in thinned) for lag in delays])
        r = r / size if size > 0 else 0 * r
        shown[key] = float(r[np.argmax(np.abs(r))])
        shown[f"{key}_outside"] = 100 * float(np.mean(np.abs(r) > bound))
    return shown


def _product(e: np.ndarray, y: np.ndarray, lag: int) -> float:
    """Return the sum of products of e with y, which is read `lag` samples earlier."""
    return float(e[lag:] @ y[: len(y) - lag]) if lag >= 0 else float(e[:lag] @ y[-lag:])
