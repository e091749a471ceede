"""Score of any trajectory, judged as a design is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, play_back, share_outside_law
from excite.trajectories import objective
from excite.trajectories.composite_objective import compose_objective, sigma_percent
from excite.trajectories.lane import simulate_on_lane
from excite.trajectories.limits import DURATION_LIMIT, check_limits


@dataclass(frozen=True)
class Score:
    """How well a drive shows a machine's parameters, and which limits it breaks.

    motion: the drive's fresh simulation. cond_phi, cond_w: condition numbers over every sample of it.
    sigma_percent: attainable relative standard deviation [%] by parameter (Cramer-Rao bound, kit `full`).
    violations: excess by limit, as a fraction of its range, 0 where kept; of the duration as a fraction of the
    problem's. share_outside_law: of the samples in which a contact slips more than its linear law allows.
    """

    motion: Motion
    cond_phi: float
    cond_w: float
    sigma_percent: dict[str, float]
    violations: dict[str, float]
    share_outside_law: float

    @property
    def max_violation(self) -> float:
        """Largest excess over a limit, as a fraction of its range."""
        return max(self.violations.values(), default=0.0)

    @property
    def worst_parameter(self) -> str:
        """Parameter of the largest attainable standard deviation."""
        return max(self.sigma_percent, key=lambda n: self.sigma_percent[n])

    @property
    def worst_percent(self) -> float:
        """Largest attainable standard deviation [%]."""
        return self.sigma_percent[self.worst_parameter]

    @property
    def median_percent(self) -> float:
        """Median attainable standard deviation [%]."""
        return float(np.median(list(self.sigma_percent.values())))


def score(
    model: Model,
    problem: Problem,
    torque: np.ndarray,
    q0: np.ndarray | None = None,
    nu0: np.ndarray | None = None,
    planned: tuple[np.ndarray, np.ndarray] | None = None,
) -> Score:
    """Simulate torques (N, n_u) [N m] at the machine's sampling rate afresh, and judge the motion as a design.

    q0, nu0 (n_q,): state at the start, at rest by default. Without q0 the drive is placed on the lane as a design is.
    planned: q, nu (N, n_q) that the drive expects, which an arm follows (`simulation.play_back`).

    Raises SimulationError, and ValueError for a sensor without noise or counts.
    """
    if q0 is None and not (planned is not None and model.follows_positions):
        motion = simulate_on_lane(model, problem, torque, nu0)
    else:
        motion = play_back(model, torque, q0, nu0, planned)
    return score_motion(model, problem, motion)


def score_motion(model: Model, problem: Problem, motion: Motion) -> Score:
    """Judge a simulated motion as a design. Raises ValueError for a sensor without noise or counts."""
    wanted, sample = float(problem.duration_s), 1 / float(model.machine.sampling_hz)
    off = abs(float(motion.t[-1] - motion.t[0]) - wanted)
    sigma = sigma_percent(compose_objective(model, "cond"), model, motion)
    return Score(
        motion,
        objective.cond_phi(model, motion),
        objective.cond_w(model, motion),
        dict(zip(model.base.names, sigma.tolist(), strict=True)),
        {**check_limits(model, problem, motion), DURATION_LIMIT: 0.0 if off < sample else off / wanted},
        share_outside_law(model, motion),
    )
