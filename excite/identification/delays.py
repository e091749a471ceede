"""Delay of each torque channel against the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from excite import simulation
from excite.errors import LogError, SimulationError
from excite.identification.linear_methods import sandwich_covariance, solve_blocks, whiten_block
from excite.identification.noise_propagation import filtered_noise, whitening_matrices
from excite.identification.validation import simulate_open_loop
from excite.logs import Log, decimate, derivative, from_table, lowpass, regression, samples
from excite.model import Model
from excite.model.machine import Filter

SIGNIFICANT_DELAY = 4.0  # standard deviations that make a delay worth a remark


PRECISE_STD = 2e-3  # s: a deviation from which noise of slips hides a part of a delay


@dataclass(frozen=True)
class Delay:
    """How late a torque channel is, with its standard deviation [s]."""

    name: str
    value: float
    std: float

    @property
    def significant(self) -> bool:
        return abs(self.value) > SIGNIFICANT_DELAY * self.std

    def beside(self, usual: Delay) -> Delay:
        """What is more than a usual one."""
        return Delay(self.name, self.value - usual.value, float(np.hypot(self.std, usual.std)))


def estimate_delays(model: Model, log: Log, filter: Filter | None = None) -> tuple[Delay, ...]:
    """How late each torque channel is against the motion.

    u_measured(t) = u(t - delay) + u0: to first order a column -du/dt beside the regressor. Rows are made white for the
    sensors' noise at the machine file's values, so that noisy slips don't pass for a delay; deviations account for
    autocorrelation.
    """
    filter = filter or model.machine.filter
    rate = float(model.machine.sampling_hz)
    s = samples(model, log, filter)
    W, Y = regression(model, s, filter)
    keep = slice(filter.drop[0], len(log) - filter.drop[1])
    rows = list(model.actuated)
    slopes = np.zeros((*W.shape[:2], len(rows)))
    for k, row in enumerate(rows):
        slope = derivative(lowpass(s.Y[row], rate, filter), rate)[None, keep]
        slopes[row, :, k] = -decimate(slope, filter.decimation)[0]
    L = whitening_matrices(model, s, model.nominal, filtered_noise(model, log, filter), filter)
    block = [whiten_block((np.concatenate([W, slopes], axis=2), Y), L)]
    solution = solve_blocks(block)
    covariance = solution.spread(sandwich_covariance(block, solution))
    n = W.shape[2]
    names = [_torque_name(model, row) for row in rows]
    return tuple(
        Delay(name, float(solution.x[n + k]), float(np.sqrt(covariance[n + k, n + k])))
        for k, name in enumerate(names)
        if n + k in solution.kept
    )


def _torque_name(model: Model, row: int) -> str:
    body = next(b for b in model.machine.actuated if b.coordinates[0] == model.coordinates[row])
    return next(s.name for s in model.machine.sensor if s.kind == "torque" and s.body == body.index)


def describe_late_channels(
    model: Model, log: Log, filter: Filter | None = None, X: np.ndarray | None = None
) -> tuple[str, ...]:
    """A remark for every torque channel that is late or early beyond doubt.

    Where rows are mostly noise, what is left of it in them passes for a delay: so the same is asked of the machine X
    (n_base,) driven by the log's torques with every channel in time, and that is taken off. Nothing is said of such
    rows without X: the machine file's soil may be another one.
    """
    found = [d for d in estimate_delays(model, log, filter) if d.significant]
    if X is not None and found:
        try:
            usual = {d.name: d for d in estimate_delays(model, _simulate_without_delay(model, log, filter, X), filter)}
            found = [d.beside(usual[d.name]) if d.name in usual else d for d in found]
        except (SimulationError, LogError):
            X = None  # nothing to take off
    said = []
    for d in found:
        precise = d.std < PRECISE_STD
        if not d.significant or not (precise or X is not None):
            continue
        which = f"{'late' if d.value > 0 else 'early'} against the motion"
        much = f"{abs(d.value) * 1e3:.1f} ms (+-{d.std * 1e3:.1g})"
        line = (
            f"{d.name} is {much} {which}: shift the channel, or run `excite diagnose`"
            if precise
            else f"{d.name} is {which}, by {much} as far as noise tells: `excite diagnose` says by how much"
        )
        said.append(f"{log.source}: {line}")
    return tuple(said)


def _simulate_without_delay(model: Model, log: Log, filter: Filter | None, X: np.ndarray) -> Log:
    """What a log's sensors would read of a drive by its torques if no channel were late."""
    motion = simulate_open_loop(model, log, X, filter)
    made = from_table(simulation.measure(model, motion, X), model.machine)
    return Log(log.source, made.t, {n: made.values[n] for n in log.values if n in made.values})
