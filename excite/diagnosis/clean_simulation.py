"""Misfit that a fit leaves, beside what clean logs of the fitted machine leave.

The fitted machine is simulated along the log, read by sensors like the log's, and fitted again: a parametric bootstrap
(Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 6). The cost of such a fit is what noise, counts
and the sampling leave, several per cent less or more than one for each reading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from excite import identification
from excite.diagnosis.fits import RESUMED, ExtendedFit
from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.residuals import concentrations, residuals_of_logs
from excite.errors import SimulationError
from excite.logs import Log
from excite.simulation import Motion
from excite.smoothing import ACCEPTABLE_STEP, Fit, StateSpace, Trajectory, fit_logs, prepare_logs
from excite.text import format_number

RUNS = 2  # simulated logs, which runs of two processes give in the time of one; chosen
MIN_STDS = 4.0  # standard deviations beyond clean logs from which a misfit is significant; chosen


@dataclass(frozen=True)
class Remainder:
    """Misfit beyond noise that a fit leaves.

    chi2: sum of squared innovations beyond that of clean logs, 0 if it is not significant. std: its standard deviation.
    signal: the one with the largest part. share: of the misfit in this signal, 0 to 1. ratio: root mean square of this
    signal's innovations over those of clean logs. where: times or states of the machine that hold most of it.
    """

    chi2: float
    std: float
    signal: str = ""
    share: float = 0.0
    ratio: float = 1.0
    where: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Describe a significant misfit."""
        places = f" ({'; '.join(self.where)})" if self.where else ""
        return (
            f"{format_number(100 * self.share, 2)} % of it in {self.signal}, whose residuals are"
            f" {format_number(self.ratio, 3)} times noise{places}"
        )


def can_be_simulated(stage: ExtendedFit) -> bool:
    """Tell if a fit is one of exact dynamics, of which clean logs can be simulated: without friction that sticks."""
    return stage.exact and not stage.data.sticks


def measure_remainder(stage: ExtendedFit, runner: CallRunner = run_in_turn, seed: int = 0) -> Remainder | None:
    """Compare the misfit of a fit with that of clean logs of the fitted machine.

    Return None where it cannot be told: unknown forces absorb a misfit, friction sticks, or
    the fitted machine cannot be simulated.
    """
    if not can_be_simulated(stage):
        return None
    calls = [partial(_clean_squares, stage, seed + k) for k in range(RUNS)]
    found = [squares for squares in runner(calls) if squares is not None]
    if not found:
        return None
    own, counts = _sum_squares(stage.fit)
    clean = np.mean([squares / np.maximum(n, 1) for squares, n in found], axis=0) * counts
    left, total = own - stage.heavy_excess - clean, float(counts.sum())
    std = float(np.sqrt(2 * total * (1 + 1 / len(found))))
    chi2 = float(left.sum())
    if chi2 < MIN_STDS * std:
        return Remainder(0.0, std)
    j = int(left.argmax())
    name = stage.data.space.sensors[j].name
    return Remainder(
        chi2,
        std,
        name,
        float(left[j] / np.maximum(left, 0).sum()),
        float(np.sqrt(own[j] / max(clean[j], 1e-300))),
        tuple(dict.fromkeys(line for r in residuals_of_logs(stage) for line in concentrations(r, r.innovations[:, j]))),
    )


def simulate_clean(stage: ExtendedFit, seed: int) -> tuple[list[Log], list[Motion]]:
    """Simulate logs of the fitted machine along the logs of a fit, and their motions. Raises SimulationError."""
    model, X, filter = stage.model, stage.fit.X, stage.machine.filter
    rng = np.random.default_rng(seed)
    motions = [identification.simulate_along_log(model, log, X, filter) for log in stage.data.logs]
    read = [
        identification.measured_again(model, log, motion, X, rng)
        for log, motion in zip(stage.data.logs, motions, strict=True)
    ]
    half = {s.name: 0.5 * s.resolution for s in stage.machine.sensors("full") if s.resolution is not None}
    # whole counts, whose edges a log shows
    return [replace(x, values={n: v + half.get(n, 0.0) for n, v in x.values.items()}) for x in read], motions


def _clean_squares(stage: ExtendedFit, seed: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Fit simulated logs from their true motions; return sums of squared innovations (m,) and numbers of readings."""
    space, X = stage.data.space, stage.fit.X
    try:
        logs, motions = simulate_clean(stage, seed)
        measurements, starts = prepare_logs(space, logs, stage.machine.filter)
        true = [_true_trajectory(space, motion, start) for motion, start in zip(motions, starts, strict=True)]
    except SimulationError:
        return None
    # Such a step changes the cost by about one.
    settings = replace(RESUMED, tolerance=ACCEPTABLE_STEP)
    fit = fit_logs(space, measurements, true, X, starts, stage.data.held, settings=settings)
    return _sum_squares(fit) if fit.step <= ACCEPTABLE_STEP else None


def _true_trajectory(space: StateSpace, motion: Motion, start: Trajectory) -> Trajectory:
    """Return a simulated motion as the trajectory of its log, with the encoders' counts where `start` has them."""
    state, ground = space.from_motion(motion)
    return replace(start, state=state, ground_inputs=ground)


def _sum_squares(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of squares (m,) and numbers (m,) of the innovations of all logs."""
    each = np.concatenate([x.innovations for x in fit.linear])
    return np.nansum(each**2, axis=0), np.isfinite(each).sum(axis=0).astype(float)
