"""How true and how sure: simulate a drive with the sensors' flaws, identify, many times over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from joblib import Parallel, delayed

from excite import logs, simulation
from excite.errors import NoEstimateError
from excite.identification import methods
from excite.model import Model, build_cached
from excite.simulation import Motion

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Verification:
    """N runs of one drive: value, std (runs, n) estimates and their own standard deviations, interval (runs, 2, n) the
    ends of their 95 % intervals; true (n,).

    A run whose identification failed has NaN; `failures` says why, by run.
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
        """(n,) what errors are relative to: the true value, the scale where that is zero."""
        return np.where(self.true != 0, self.true, self.scale)

    @property
    def error_percent(self) -> np.ndarray:
        """(runs, n) error of every run: 100 (value / true - 1), so that minus means too small in size."""
        return 100 * (self.value - self.true) / self.reference

    @property
    def std_percent(self) -> np.ndarray:
        """(runs, n) standard deviation that each run predicts."""
        return 100 * self.std / np.abs(self.reference)

    @property
    def covered(self) -> np.ndarray:
        """(runs, n) 1 where the 95 % interval holds the truth, 0 where not, NaN where there is no estimate."""
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
    """Measures a motion of the true `model` with new sensor noise in every run and identifies from that log alone.

    `start`: the model that identification knows (a machine file with other nominal values), the true one by default.
    Runs are the same whatever the number of jobs. Raises ValueError for bad arguments.
    """
    if runs < 1:
        raise ValueError(f"runs: must be at least 1 (got {runs})")
    seeds = np.random.SeedSequence(seed).generate_state(runs)
    true, known = model.machine.model_dump_json(), (start or model).machine.model_dump_json()
    work = Parallel(n_jobs=jobs, return_as="generator_unordered")(
        delayed(_run)(k, true, known, motion, method, kit, int(s)) for k, s in enumerate(seeds)
    )
    n = len(model.base.names)
    value, std, interval = (np.full((runs, *shape), np.nan) for shape in ((n,), (n,), (2, n)))
    failures: dict[int, str] = {}
    for done, (k, found, reason) in enumerate(work, 1):
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
    k: int, true: str, known: str, motion: Motion, method: str, kit: str, seed: int
) -> tuple[int, Found | None, str]:
    model, assumed = build_cached(true), build_cached(known)
    table = simulation.measure(model, motion, kit=kit, seed=seed)
    measured = logs.from_table(table, assumed.machine, methods.needed_sensors(assumed, method))
    try:
        estimate = methods.identify(assumed, [measured], method)
    except NoEstimateError as err:
        return k, None, str(err)
    return k, (estimate.value, estimate.std, estimate.interval95), ""


def summarise_runs(v: Verification) -> dict[str, dict[str, float | str]]:
    """Per parameter: unit, true, mean, bias, spread, predicted spread [%] and coverage of the 95 % interval [0..1]."""
    table: dict[str, dict[str, float | str]] = {}
    for k, name in enumerate(v.names):
        error = v.error_percent[:, k][np.isfinite(v.value[:, k])]
        some, many = len(error) > 0, len(error) > 1
        table[name] = {
            "unit": v.units[k],
            "true": float(v.true[k]),
            "mean": float(np.nanmean(v.value[:, k])) if some else np.nan,
            "bias_percent": float(error.mean()) if some else np.nan,
            "bias_std_percent": float(error.std(ddof=1) / np.sqrt(len(error))) if many else np.nan,
            "std_percent": float(error.std(ddof=1)) if many else np.nan,
            "predicted_std_percent": float(np.nanmean(v.std_percent[:, k])) if some else np.nan,
            "rms_percent": float(np.sqrt(np.mean(error**2))) if some else np.nan,
            "coverage95": float(np.nanmean(v.covered[:, k])) if some else np.nan,
        }
    return table


def biased_parameters(table: dict[str, dict[str, float | str]]) -> list[str]:
    """Parameters of a `summary` whose mean error is more than one predicted standard deviation, and beyond chance."""
    return [
        name
        for name, row in table.items()
        if abs(float(row["bias_percent"]))
        > max(float(row["predicted_std_percent"]), 4 * float(row["bias_std_percent"]))
    ]
