"""Torque profiles over time: the result of a design, starting points, and random drives to compare with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from excite.model import Model
from excite.model.machine import Problem

LOW_FREQUENCY = 0.05  # Hz, lowest of multisine and chirp: one period in 20 s; chosen
CHIRP_TOP = 1.0  # Hz, last of the chirp; chosen
SINES = 12  # per input of a multisine; chosen
FADE = 0.5  # s, fade from and to zero torque; chosen
STEP_LENGTH = (0.6, 3.0)  # s, shortest and longest random step; chosen


@dataclass(frozen=True)
class Manoeuvre:
    """Torques [N m], linear between knots: times (K,) [s], torque (K, n_u)."""

    times: np.ndarray
    torque: np.ndarray

    def __post_init__(self) -> None:
        times, torque = np.asarray(self.times), np.asarray(self.torque)
        if times.ndim != 1 or torque.ndim != 2 or len(times) != len(torque) or len(times) < 2:
            raise ValueError(
                f"a manoeuvre needs times (K >= 2,) and torque (K, n_u), got {times.shape}, {torque.shape}"
            )
        if not (np.diff(times) > 0).all():
            raise ValueError("a manoeuvre's knot times must increase")

    @property
    def duration(self) -> float:
        return float(self.times[-1] - self.times[0])

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the torques (N, n_u) at times (N,) [s], constant beyond the ends."""
        return np.column_stack([np.interp(t, self.times, u) for u in self.torque.T])

    def sample(self, rate: float) -> np.ndarray:
        """Return the torques (N, n_u) at `rate` [Hz] from the first knot to the last, both included."""
        return self.at(self.times[0] + np.arange(round(self.duration * rate) + 1) / rate)


def knot_times(problem: Problem, coarse: int = 1) -> np.ndarray:
    """Return the knot times (K,) [s] of a problem, `coarse` times its knot spacing apart, K >= 5."""
    duration, spacing = float(problem.duration_s), float(problem.knot_s)
    count = max(4, int(duration / spacing + 1e-9))
    return np.linspace(0.0, duration, max(4, round(count / coarse)) + 1)


def _torque_limits(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits on torque (n_u,) and torque rate (n_u,), infinite if the machine file states none."""
    limits = [b.limit for b in model.machine.actuated]
    torque = np.array([float(x.torque) if x.torque is not None else np.inf for x in limits])
    rate = np.array([float(x.torque_rate) if x.torque_rate is not None else np.inf for x in limits])
    return torque, rate


def _fit_torque_limits(model: Model, times: np.ndarray, target: np.ndarray) -> Manoeuvre:
    """Bring torques (K, n_u) inside the limits on torque and torque rate, from zero to zero."""
    torque, rate = _torque_limits(model)
    fade = np.clip(np.minimum(times - times[0], times[-1] - times) / FADE, 0, 1)[:, None]
    u = np.clip(target * fade, -torque, torque)
    fastest = np.abs(np.diff(u, axis=0) / np.diff(times)[:, None]).max(axis=0)
    return Manoeuvre(times, u / np.maximum(1.0, fastest / rate))


def _amplitude(model: Model) -> np.ndarray:
    torque, _ = _torque_limits(model)
    return np.where(np.isfinite(torque), torque, np.abs(model.scale).max())


def multisine(model: Model, problem: Problem, seed: int, top: float = 1.0) -> Manoeuvre:
    """Make a random multisine: 12 sines per input from 0.05 Hz to `top` [Hz], random phases and amplitudes."""
    rng = np.random.default_rng(seed)
    t = knot_times(problem)
    frequency = np.exp(rng.uniform(np.log(LOW_FREQUENCY), np.log(top), (SINES, len(model.inputs))))
    phase = rng.uniform(0, 2 * np.pi, frequency.shape)
    size = rng.uniform(0, 1, frequency.shape)
    target = (size * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(axis=1)
    return _fit_torque_limits(model, t, target / np.abs(target).max(axis=0) * _amplitude(model))


def steps(model: Model, problem: Problem, seed: int) -> Manoeuvre:
    """Make pseudo-random steps: every input jumps to a random level every 0.6 to 3 s."""
    rng = np.random.default_rng(seed)
    t = knot_times(problem)
    target = np.empty((len(t), len(model.inputs)))
    for k in range(target.shape[1]):
        edges = np.cumsum(rng.uniform(*STEP_LENGTH, int(t[-1] / STEP_LENGTH[0]) + 1))
        levels = rng.uniform(-1, 1, len(edges) + 1)
        target[:, k] = levels[np.searchsorted(edges, t)]
    smooth = np.vstack([target[:1], (target[:-2] + 2 * target[1:-1] + target[2:]) / 4, target[-1:]])
    return _fit_torque_limits(model, t, smooth * _amplitude(model))


def chirp(model: Model, problem: Problem, seed: int) -> Manoeuvre:
    """Make a sine sweep from 0.05 to 1 Hz on every input, at random phases."""
    rng = np.random.default_rng(seed)
    t = knot_times(problem)
    low, high = LOW_FREQUENCY, CHIRP_TOP
    swept = low * t[-1] / np.log(high / low) * ((high / low) ** (t / t[-1]) - 1)
    phase = rng.uniform(0, 2 * np.pi, len(model.inputs))
    return _fit_torque_limits(model, t, np.sin(2 * np.pi * swept[:, None] + phase) * _amplitude(model))


def scale_torques(manoeuvre: Manoeuvre, factor: float | np.ndarray) -> Manoeuvre:
    """Multiply the torques by one factor, or by one per input (n_u,)."""
    return Manoeuvre(manoeuvre.times, manoeuvre.torque * factor)
