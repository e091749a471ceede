"""Search for the drive of any machine: torques over time, of an arm the motion of its joints."""

from __future__ import annotations

from collections.abc import Sequence

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion
from excite.trajectories.composite_objective import CompositeObjective
from excite.trajectories.excitation import Manoeuvre
from excite.trajectories.joint_search import design_joint_motion
from excite.trajectories.multistart import Design, Report, design

DEFAULT_TRAJECTORY = "free"  # of an arm


def design_drive(
    model: Model,
    problem: Problem,
    objective: CompositeObjective,
    starts: int = 2,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Report | None = None,
    warm: Sequence[Manoeuvre | Motion] = (),
    solver: str = "own",
    trajectory: str | None = None,
) -> Design:
    """Design the drive of any machine: the best of several random starts and of drives that are known.

    warm: drives to go on from (`Design.drive`). solver: of torques. trajectory: of an arm, a name in TRAJECTORIES;
    None for the default one. Other arguments and errors as in `multistart.design` and `design_joint_motion`.
    """
    if model.follows_positions:
        motions = [w for w in warm if isinstance(w, Motion)]
        chosen = trajectory or DEFAULT_TRAJECTORY
        return design_joint_motion(model, problem, objective, starts, seed, budget_s, progress, chosen, motions)
    torques = [w for w in warm if isinstance(w, Manoeuvre)]
    return design(model, problem, objective, starts, seed, budget_s, progress, torques, solver)
