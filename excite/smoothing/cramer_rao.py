"""Cramer-Rao bound of a motion: the best accuracy that its sensors allow.

The bound is the covariance of joint smoothing along an exactly known motion, without any measurement.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from excite.errors import SimulationError
from excite.model import Model
from excite.model.machine import Machine, Sensor, noise_of
from excite.simulation import Motion, measured_torques
from excite.smoothing import forward
from excite.smoothing.linearisation import StateSpace, build_state_space
from excite.smoothing.log_fit import PRIOR_STD, covariance_in_si
from excite.smoothing.measurements import (
    LEAST_GROUND_SPEED,
    Measurements,
    SensorNoise,
    Trajectory,
    encoders_with_offset,
    torque_sensor,
    with_mean_edge_rates,
)
from excite.smoothing.unknown_forces import no_unknown_forces


def cramer_rao(
    model: Model,
    motion: Motion,
    kit: str = "full",
    X: np.ndarray | None = None,
    noise_factors: Mapping[str, float] | None = None,
) -> np.ndarray:
    """Compute the covariance (n_base, n_base) [SI] that the sensors of a kit allow along a motion.

    All noise counts as Gaussian, with the machine file's standard deviations. An encoder gives one reading per count,
    and its edges are off by a tenth of a count at least; a slow sensor gives the share of its `rate_hz`. A weak prior
    (300 % of each scale) keeps the standard deviation of a parameter finite that the motion does not excite. What the
    machine file calls known adds to the measurements.

    X (n_base,): true parameters, the nominal ones by default. noise_factors: factors on the noise of sensors, or on the
    count of encoders, by name; inf leaves a sensor out, which torque sensors can't be.

    Raises ValueError for a sensor without noise or counts.
    """
    X = model.nominal if X is None else np.asarray(X, float)
    factors = noise_factors or {}
    sensors = [s for s in model.machine.sensors(kit) if factors.get(s.name, 1) < np.inf]
    for s in sensors:
        if not s.has_noise_figure:
            raise ValueError(
                f"{model.machine.name}: sensor {s.name}: give noise or counts_per_turn in the machine file"
            )
    space = build_state_space(model, tuple(s.name for s in model.machine.sensors("full") if s in sensors))
    state, over = space.from_motion(motion)
    counts = np.array([s.resolution is not None for s in space.sensors])
    torques = [torque_sensor(model, b.index) for b in model.machine.actuated]
    noise = SensorNoise(
        np.array([noise_of(model.machine, s) * factors.get(s.name, 1) for s in torques]),
        np.array([_noise(model.machine, s) * factors.get(s.name, 1) for s in space.sensors]),
    )
    none = np.zeros((len(state), len(space.sensors)))
    torque, offsets = measured_torques(model, motion.t, motion.u, X), encoders_with_offset(space, counts)
    data = Measurements(torque, none, none, counts, offsets, noise, turned=False)
    trajectory = Trajectory(state, np.zeros_like(motion.u[1:]), np.zeros(len(data.offset_sensors)), over)
    data = with_mean_edge_rates(space, data, trajectory, motion.u, X)
    data = replace(data, used=data.used * _shares_read(space, state, noise, X))
    along = forward.evaluate(space, data, trajectory, state[0], X, no_unknown_forces(space, 1).lacking[0], exact=True)
    if along is None:
        raise SimulationError("the motion cannot be integrated from sample to sample: it leaves the model's range")
    linear = forward.linearise(space, along, state[0], X)
    information = linear.Z[1:, 1:].copy()
    information[: len(X), : len(X)] += model.known.information(model.scale)
    information[np.diag_indices(len(information))] += np.concatenate(
        [np.full(len(X), PRIOR_STD**-2), np.ones(len(data.offset_sensors))]
    )
    return covariance_in_si(space, np.linalg.inv(information))


def _noise(machine: Machine, sensor: Sensor) -> float:
    """Return the standard deviation of a sensor [SI], for an encoder its count."""
    return sensor.resolution or float(np.hypot(noise_of(machine, sensor), sensor.least_noise))


def _shares_read(space: StateSpace, state: np.ndarray, noise: SensorNoise, X: np.ndarray) -> np.ndarray:
    """Return the share (N, m) of each sample that slow sensors read and smoothing uses."""
    rate = float(space.model.machine.sampling_hz)
    share = np.ones((len(state), len(space.sensors)))
    for j, s in enumerate(space.sensors):
        if s.rate_hz is not None:
            share[:, j] = min(float(s.rate_hz) / rate, 1.0)
        if s.kind == "ground_speed":
            inputs = np.zeros((len(state), len(space.model.inputs) + len(space.model.map_inputs)))
            share[:, j] *= space.readings(state, inputs, X)[0][:, j, 0] > LEAST_GROUND_SPEED * noise.sensor[j]
    return share
