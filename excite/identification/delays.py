"""Delay of each torque channel relative to the motion."""

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
from excite.text import format_number

SIGNIFICANT_DELAY = 4.0  # smallest delay that is reported [standard deviations]; chosen
PRECISE_STD = 2e-3  # larger standard deviations mean that slip noise hides part of a delay [s]; chosen


@dataclass(frozen=True)
class Delay:
    """Delay of a torque channel with its standard deviation [s]."""

    name: str
    value: float
    std: float

    @property
    def significant(self) -> bool:
        return abs(self.value) > SIGNIFICANT_DELAY * self.std

    def minus(self, usual: Delay) -> Delay:
        """The delay beyond another one."""
        return Delay(self.name, self.value - usual.value, float(np.hypot(self.std, usual.std)))


def estimate_delays(model: Model, log: Log, filter: Filter | None = None) -> tuple[Delay, ...]:
    """Estimate the delay of each torque channel relative to the motion.

    u_measured(t) = u(t - delay) + u0: to first order, a column -du/dt beside the regressor. Rows are whitened for the
    sensor noise at the machine file's values, so that noisy slips are not taken for a delay. Standard deviations
    account for autocorrelation.
    """
    filter = filter or model.machine.filter
    rate = float(model.machine.sampling_hz)
    motion = samples(model, log, filter)
    if not motion.Y.any():
        return ()  # a log without drive
    W, Y = regression(model, motion, filter)
    keep = slice(filter.drop[0], len(log) - filter.drop[1])
    rows = list(model.actuated)
    slopes = np.zeros((*W.shape[:2], len(rows)))
    for k, row in enumerate(rows):
        slope = derivative(lowpass(motion.Y[row], rate, filter), rate)[None, keep]
        slopes[row, :, k] = -decimate(slope, filter.decimation)[0]
    L = whitening_matrices(model, motion, model.nominal, filtered_noise(model, log, filter), filter)
    block = [whiten_block((np.concatenate([W, slopes], axis=2), Y), L)]
    solution = solve_blocks(block)
    covariance = solution.expand(sandwich_covariance(model, block, solution))
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
    """Describe every torque channel that is significantly late or early, one line each.

    Noise in the rows may look like a delay. So the delay found for the machine X (n_base,), simulated without delays
    under the log's torques, is subtracted. Without X, noisy rows are not reported, as the soil may differ from the
    machine file's.
    """
    found = [d for d in estimate_delays(model, log, filter) if d.significant]
    if X is not None and found:
        try:
            simulated = {
                d.name: d for d in estimate_delays(model, _simulate_without_delay(model, log, filter, X), filter)
            }
            found = [d.minus(simulated[d.name]) if d.name in simulated else d for d in found]
        except (SimulationError, LogError):
            X = None  # no simulated delay to subtract
    lines = []
    for d in found:
        precise = d.std < PRECISE_STD
        if not d.significant or not (precise or X is not None):
            continue
        direction = f"{'late' if d.value > 0 else 'early'} against the motion"
        magnitude = f"{abs(d.value) * 1e3:.1f} ms (+-{format_number(d.std * 1e3, 1)} ms)"
        line = (
            f"{d.name} is {magnitude} {direction}: shift the channel, or run `excite diagnose`"
            if precise
            else f"{d.name} is {direction}, by {magnitude} as far as noise tells: `excite diagnose` says by how much"
        )
        lines.append(f"{log.source}: {line}")
    return tuple(lines)


def _simulate_without_delay(model: Model, log: Log, filter: Filter | None, X: np.ndarray) -> Log:
    """Simulate the sensors' readings of a log under its torques, with no channel late."""
    motion = simulate_open_loop(model, log, X, filter)
    made = from_table(simulation.measure(model, motion, X), model.machine)
    return Log(log.source, made.t, {n: made.values[n] for n in log.values if n in made.values})
