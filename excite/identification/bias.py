"""Bias of a method on given logs, from simulated logs of the identified machine (parametric bootstrap).

Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 6 and 10.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from excite.errors import NotIdentifiableError, SimulationError
from excite.identification.estimate import Estimate, add_notes
from excite.identification.noise_propagation import measure_again
from excite.logs import Log, lowpass, samples
from excite.model import Model
from excite.model.machine import Filter
from excite.simulation import Motion, delivered_torques, exact_readings, respond
from excite.text import format_percent

RUNS = 8  # simulated logs; chosen
HOLD_TIME = 1.0  # time constant of the pull towards the log's joint speeds [s]; chosen
SIGNIFICANT_BIAS = 3.0  # smallest bias that is significant [standard deviations of the mean]; chosen
NOTABLE_BIAS = 0.5  # smallest bias that is reported [standard deviations of the parameter]; chosen

Estimator = Callable[[Model, Sequence[Log], Filter], Estimate]


def add_bias(
    model: Model,
    logs: Sequence[Log],
    estimate: Estimate,
    method: Estimator,
    filter: Filter,
    around: np.ndarray | None = None,
    runs: int = RUNS,
    seed: int = 0,
) -> Estimate:
    """Return the estimate with `bias` and `bias_std` (n_base,) [SI], and a note on significant biases.

    The identified machine is simulated under the log's torques, with its joints pulled gently towards the log's speeds.
    Sensors add white noise as found in the log, and counts as in the machine file. The method is applied to each
    simulated log. If the machine cannot be simulated, a note says so.

    around (n_base,): parameters of the simulated machine, by default the estimate's own. The bias there stands for the
        bias at the true parameters, so those of a consistent method are better than an estimate that is far off.
    runs: number of simulated logs.
    """
    from excite.errors import NotConsistentError
    from excite.identification.consistency import nearest_possible

    try:
        X = estimate.value if around is None else around
        X = np.where(np.isfinite(X), X, model.nominal)
        if not _is_possible(model, X):
            X = nearest_possible(
                model, replace(estimate, value=X, covariance=_covariance_with_defaults(model, estimate))
            ).value
        motions = [simulate_along_log(model, log, X, filter) for log in logs]
    except (SimulationError, NotConsistentError) as err:
        return add_notes(
            estimate, f"{estimate.method}: bias unknown, as the identified machine cannot be simulated ({err})"
        )
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(runs):
        simulated = [measured_again(model, log, motion, X, rng) for log, motion in zip(logs, motions, strict=True)]
        try:
            errors.append(method(model, simulated, filter).value - X)
        except NotIdentifiableError:
            continue
    if len(errors) < 2:
        return add_notes(
            estimate,
            f"{estimate.method}: bias unknown, as the method fails on simulated logs of the identified machine",
        )
    bias = np.mean(errors, axis=0)
    std = np.std(errors, axis=0, ddof=1) / np.sqrt(len(errors))
    return add_notes(
        replace(estimate, bias=bias, bias_std=std), _describe_bias(model, estimate, bias, std, len(errors))
    )


def _describe_bias(model: Model, estimate: Estimate, bias: np.ndarray, std: np.ndarray, runs: int) -> str:
    size = np.maximum(np.abs(np.nan_to_num(estimate.value)), model.scale)
    with np.errstate(invalid="ignore"):
        notable = (np.abs(bias) > SIGNIFICANT_BIAS * std) & (np.abs(bias) > NOTABLE_BIAS * estimate.std)
    if not notable.any():
        return f"{estimate.method}: no bias found on {runs} simulated logs of the identified machine"
    order = [k for k in np.argsort(-np.abs(bias) / size) if notable[k]]
    listed = ", ".join(
        f"{estimate.names[k]} {'+' if bias[k] > 0 else ''}{format_percent(100 * bias[k] / size[k])}"
        f" +- {format_percent(float(100 * std[k] / size[k]), 1)}"
        for k in order
    )
    return (
        f"{estimate.method}: biased on {runs} simulated logs of the identified machine: {listed}; its intervals do not"
        " hold for these"
    )


def _is_possible(model: Model, X: np.ndarray) -> bool:
    from excite.identification.consistency import is_possible

    return is_possible(model, X)


def _covariance_with_defaults(model: Model, estimate: Estimate) -> np.ndarray:
    """The covariance with the parameter's scale as standard deviation where it is unknown."""
    covariance = estimate.covariance.copy()
    unknown = np.isnan(np.diag(covariance))
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = model.scale[unknown] ** 2
    return covariance


def simulate_along_log(model: Model, log: Log, X: np.ndarray, filter: Filter) -> Motion:
    """Simulate the machine X (n_base,) under the log's low-passed torques, pulled towards its joint speeds.

    The pull keeps small torque errors from accumulating. Raises SimulationError.
    """
    s = samples(model, log, filter)
    rows, n_q = list(model.actuated), len(model.coordinates)
    read = lowpass(s.Y[rows], float(model.machine.sampling_hz), filter).T
    torque = delivered_torques(log.t, read, [x.full() for x in model.channels(log.t[None], X)])
    speed = s.nu[rows].T
    inertia = np.diag(model.mass_matrix(s.q[:, 0], X).full())[rows]  # of each joint's own acceleration
    gain = np.abs(inertia) / HOLD_TIME

    def driven(k: int, state: np.ndarray) -> np.ndarray:
        return torque[k] + gain * (speed[max(k - 1, 0)] - state[n_q:][rows])

    return respond(model, len(log), driven, X, s.q[:, 0], s.nu[:, 0])


def measured_again(model: Model, log: Log, motion: Motion, X: np.ndarray, rng: np.random.Generator) -> Log:
    """Simulate the log that the log's own sensors would record of a motion."""
    exact = exact_readings(model, motion, X)
    values = {
        s.name: measure_again(s, exact[s.name], log.white_noise(s.name), rng)
        for s in model.machine.sensors("full")
        if s.name in log.values
    }
    return Log(log.source, log.t, values)
