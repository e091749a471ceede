"""Torques over time: the manoeuvre that a design is, starting guesses, and the usual drives to compare with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from excite.model import Model
from excite.model.machine import Problem


@dataclass(frozen=True)
class Manoeuvre:
    """Torques [N m] linear between knots: times (K,) [s], torque (K, n_u)."""

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
        """Torques (N, n_u) at times (N,) [s], held at the ends."""
        return np.column_stack([np.interp(t, self.times, u) for u in self.torque.T])

    def sample(self, rate: float) -> np.ndarray:
        """Torques (N, n_u) at `rate` [Hz] from the first knot to the last, both included."""
        return self.at(self.times[0] + np.arange(round(self.duration * rate) + 1) / rate)


def knots(problem: Problem, coarse: int = 1) -> np.ndarray:
    """Knot times (K,) [s] of a problem, at least its knot spacing apart, or `coarse` times that; five knots or more."""
    duration, spacing = float(problem.duration_s), float(problem.knot_s)
    count = max(4, int(duration / spacing + 1e-9))
    return np.linspace(0.0, duration, max(4, round(count / coarse)) + 1)


def _bounds(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Torque (n_u,) and torque rate (n_u,) that the drives allow, infinite where the machine file gives none."""
    limits = [b.limit for b in model.machine.actuated]
    torque = np.array([float(x.torque) if x.torque is not None else np.inf for x in limits])
    rate = np.array([float(x.torque_rate) if x.torque_rate is not None else np.inf for x in limits])
    return torque, rate


def _within(model: Model, times: np.ndarray, wish: np.ndarray) -> Manoeuvre:
    """The wish (K, n_u) brought inside torque and torque rate limits, from zero to zero."""
    torque, rate = _bounds(model)
    fade = np.clip(np.minimum(times - times[0], times[-1] - times) / 0.5, 0, 1)[:, None]
    u = np.clip(wish * fade, -torque, torque)
    fastest = np.abs(np.diff(u, axis=0) / np.diff(times)[:, None]).max(axis=0)
    return Manoeuvre(times, u / np.maximum(1.0, fastest / rate))


def _amplitude(model: Model) -> np.ndarray:
    torque, _ = _bounds(model)
    return np.where(np.isfinite(torque), torque, np.abs(model.scale).max())


def multisine(model: Model, problem: Problem, seed: int, top: float = 1.0) -> Manoeuvre:
    """Random multisine: 12 sines per input between 0.05 Hz and `top` [Hz], random phases and amplitudes."""
    rng = np.random.default_rng(seed)
    t = knots(problem)
    frequency = np.exp(rng.uniform(np.log(0.05), np.log(top), (12, len(model.inputs))))
    phase = rng.uniform(0, 2 * np.pi, frequency.shape)
    size = rng.uniform(0, 1, frequency.shape)
    wish = (size * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(axis=1)
    return _within(model, t, wish / np.abs(wish).max(axis=0) * _amplitude(model))


def steps(model: Model, problem: Problem, seed: int) -> Manoeuvre:
    """Pseudo-random steps: every input jumps to a random level every 0.6 to 3 s."""
    rng = np.random.default_rng(seed)
    t = knots(problem)
    wish = np.empty((len(t), len(model.inputs)))
    for k in range(wish.shape[1]):
        edges = np.cumsum(rng.uniform(0.6, 3.0, int(t[-1] / 0.6) + 1))
        levels = rng.uniform(-1, 1, len(edges) + 1)
        wish[:, k] = levels[np.searchsorted(edges, t)]
    smooth = np.vstack([wish[:1], (wish[:-2] + 2 * wish[1:-1] + wish[2:]) / 4, wish[-1:]])
    return _within(model, t, smooth * _amplitude(model))


def chirp(model: Model, problem: Problem, seed: int) -> Manoeuvre:
    """A sine on every input that sweeps from 0.05 to 1 Hz, at different phases."""
    rng = np.random.default_rng(seed)
    t = knots(problem)
    low, high = 0.05, 1.0
    swept = low * t[-1] / np.log(high / low) * ((high / low) ** (t / t[-1]) - 1)
    phase = rng.uniform(0, 2 * np.pi, len(model.inputs))
    return _within(model, t, np.sin(2 * np.pi * swept[:, None] + phase) * _amplitude(model))


def scaled(manoeuvre: Manoeuvre, factor: float | np.ndarray) -> Manoeuvre:
    """The same manoeuvre with torques times a factor, one for all or one per input."""
    return Manoeuvre(manoeuvre.times, manoeuvre.torque * factor)
