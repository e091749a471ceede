"""Monte Carlo verification: simulate a motion with sensor noise and identify, many times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

from excite import simulation
from excite.errors import NoEstimateError
from excite.identification import methods
from excite.identification.estimate import Estimate
from excite.logs import prepare
from excite.model import Model, build_cached
from excite.simulation import Motion

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Verification:
    """Estimates of all runs.

    value, std (runs, n) [SI]: estimates and their standard deviations. interval (runs, 2, n): ends of the 95 %
    intervals.
    true, scale (n,): true parameters and their scales. failures: reason by run; a failed run has NaN.
    """

    method: str
    kit: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    true: np.ndarray
    scale: np.ndarray
    value: np.ndarray
    std: np.ndarray
    interval: np.ndarray
    failures: dict[int, str]

    @property
    def reference(self) -> np.ndarray:
        """Size (n,) that errors are relative to: the true value, or the scale if that is zero."""
        return np.where(self.true != 0, self.true, self.scale)

    @property
    def error_percent(self) -> np.ndarray:
        """Error (runs, n) of every run, 100 (value / true - 1): negative means too small in size."""
        return 100 * (self.value - self.true) / self.reference

    @property
    def std_percent(self) -> np.ndarray:
        """Standard deviation (runs, n) that each run predicts [%]."""
        return 100 * self.std / np.abs(self.reference)

    @property
    def covered(self) -> np.ndarray:
        """Coverage (runs, n): 1 if the 95 % interval contains the true value, 0 if not, NaN without an estimate."""
        low, high = self.interval.transpose(1, 0, 2)
        inside = (low <= self.true) & (self.true <= high)
        return np.where(np.isfinite(low), inside.astype(float), np.nan)


def verify(
    model: Model,
    motion: Motion,
    method: str,
    kit: str = "full",
    runs: int = 20,
    seed: int = 0,
    start: Model | None = None,
    jobs: int = -1,
    progress: Progress | None = None,
) -> Verification:
    """Measure a motion of the true model with new sensor noise in every run, and identify from that log alone.

    start: model that identification assumes (other nominal values), by default the true one.
    jobs: number of processes; the result does not depend on it.
    progress: called with the number of finished runs and of all runs.

    Raises ValueError for bad arguments.
    """
    if runs < 1:
        raise ValueError(f"runs: must be at least 1 (got {runs})")
    seeds = np.random.SeedSequence(seed).generate_state(runs)
    true, assumed = model.machine.model_dump_json(), (start or model).machine.model_dump_json()
    results = Parallel(n_jobs=jobs, return_as="generator_unordered")(
        delayed(_run)(k, true, assumed, motion, method, kit, int(s)) for k, s in enumerate(seeds)
    )
    n = len(model.base.names)
    value, std, interval = (np.full((runs, *shape), np.nan) for shape in ((n,), (n,), (2, n)))
    failures: dict[int, str] = {}
    for done, (k, found, reason) in enumerate(results, 1):
        if found is None:
            failures[k] = reason
        else:
            value[k], std[k], interval[k] = found
        if progress is not None:
            progress(done, runs)
    return Verification(
        method,
        kit,
        model.base.names,
        model.base.units,
        model.nominal,
        model.scale,
        value,
        std,
        interval,
        dict(sorted(failures.items())),
    )


Found = tuple[np.ndarray, np.ndarray, np.ndarray]


def _run(
    k: int, true_json: str, assumed_json: str, motion: Motion, method: str, kit: str, seed: int
) -> tuple[int, Found | None, str]:
    table = simulation.measure(build_cached(true_json), motion, kit=kit, seed=seed)
    try:
        estimate = identify_table(build_cached(assumed_json), table, method)
    except NoEstimateError as err:
        return k, None, str(err)
    return k, (estimate.value, estimate.std, estimate.noise_interval95), ""


def identify_table(model: Model, table: pd.DataFrame, method: str) -> Estimate:
    """Identify from a simulated log as from a recorded one.

    Raises LogError, and NoEstimateError also for an invalid estimate.
    """
    ready = prepare(model, [table], methods.needed_sensors(model, method))
    estimate = methods.identify(ready.model, ready.logs, method)
    if estimate.status == "invalid":
        raise NoEstimateError(f"no estimate: {estimate.doubt}, and some values are those of no machine")
    return estimate


def summarise_runs(verification: Verification) -> dict[str, dict[str, float | str]]:
    """Summarise each parameter: unit, true value, mean, bias, dispersion, predicted dispersion [%], coverage [0..1]."""
    table: dict[str, dict[str, float | str]] = {}
    for k, name in enumerate(verification.names):
        error = verification.error_percent[:, k][np.isfinite(verification.value[:, k])]
        any_run, several = len(error) > 0, len(error) > 1
        table[name] = {
            "unit": verification.units[k],
            "true": float(verification.true[k]),
            "mean": float(np.nanmean(verification.value[:, k])) if any_run else np.nan,
            "bias_percent": float(error.mean()) if any_run else np.nan,
            "bias_std_percent": float(error.std(ddof=1) / np.sqrt(len(error))) if several else np.nan,
            "std_percent": float(error.std(ddof=1)) if several else np.nan,
            "predicted_std_percent": float(np.nanmean(verification.std_percent[:, k])) if any_run else np.nan,
            "rms_percent": float(np.sqrt(np.mean(error**2))) if any_run else np.nan,
            "coverage95": float(np.nanmean(verification.covered[:, k])) if any_run else np.nan,
        }
    return table


def biased_parameters(table: dict[str, dict[str, float | str]]) -> list[str]:
    """Name the parameters of a summary whose bias is significant and exceeds one predicted standard deviation."""
    return [
        name
        for name, row in table.items()
        if abs(float(row["bias_percent"]))
        > max(float(row["predicted_std_percent"]), 4 * float(row["bias_std_percent"]))
    ]
