"""The bound on accuracy lies below every drive, near the best one, and refuses what it does not cover."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from excite.model import Model, build
from excite.model.machine import Problem, load_machine
from excite.simulation import Motion, simulate
from excite.trajectories import bound_accuracy, bound_refusal, composite_objective, multisine, objective
from excite.trajectories.accuracy_bound import CUTS, AccuracyBound, _JointStates
from excite.trajectories.baselines import scale_into_limits

RIG = Path(__file__).parents[1] / "support" / "rig.toml"


@lru_cache
def rig() -> tuple[Model, Problem]:
    model = build(load_machine(str(RIG)))
    return model, model.machine.problems["T10"]


@lru_cache
def worst() -> AccuracyBound:
    return bound_accuracy(*rig(), "worst", degree=1, rounds=12)


def drive(seed: int) -> Motion:
    model, problem = rig()
    return simulate(model, scale_into_limits(model, problem, multisine(model, problem, seed)).sample(100.0))


@pytest.mark.parametrize("of", CUTS)
def test_cuts_lie_below_the_objective_and_touch_it(of: str) -> None:
    """f(M) >= f(M0) - log <G, M> everywhere, equal at M0; `worst` and `accuracy` are the objectives of these names."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(200, 4, 6))
    matrices = root @ root.transpose(0, 2, 1)
    contrasts = np.diag([1.0, 3.0, 0.5, 2.0])
    f, G = CUTS[of](matrices[0], contrasts)
    assert np.sum(G * matrices[0]) == pytest.approx(1)
    for M in matrices:
        assert CUTS[of](M, contrasts)[0] >= f - np.log(np.sum(G * M)) - 1e-9
        if of != "mean":
            assert CUTS[of](M, contrasts)[0] == pytest.approx(
                objective.score_matrix(of, M, contrasts=contrasts), abs=1e-5
            )


def test_no_drive_is_more_accurate_than_the_bound() -> None:
    """The worst parameter of the rig is its offset, which any drive even both ways shows as well as possible."""
    model, _ = rig()
    found = worst()
    assert found.certified_percent > 0.98 * found.mixture_percent
    assert found.certified_percent == pytest.approx(1.0, rel=0.03)  # 1 N of noise, 3.16 N, 1001 samples
    aim = composite_objective.compose_objective(model, "worst")
    attained = [composite_objective.sigma_percent(aim, model, drive(k)).max() for k in range(3)]
    assert min(attained) > found.certified_percent
    assert found.gap_percent(1.1 * found.certified_percent) == pytest.approx(10)


def test_functions_of_the_state_do_not_drift_along_a_drive() -> None:
    """The mean of d phi / dt over a drive is what phi changes by: the states of the program are those of the drive."""
    model, problem = rig()
    states = _JointStates(model, problem, 3)
    motion = drive(0)
    rate = np.gradient(motion.u[:, 0], motion.t)
    z = np.array([motion.q[:, 0], motion.nu[:, 0], motion.u[:, 0], rate]) / states.size[:, None]
    _, drift = states.columns(z)
    plain, bent = (np.prod(z[:3, None] ** powers.T[:, :, None], axis=0) for powers in (states.plain, states.bent))
    phi = np.vstack([plain, np.abs(z[1]) * bent])
    change = np.trapezoid(drift.T, motion.t, axis=1)
    assert change == pytest.approx(phi[:, -1] - phi[:, 0], abs=0.02 * np.abs(drift).max())


def test_what_the_bound_does_not_cover_is_refused(straight: Model, emps: Model) -> None:
    with pytest.raises(ValueError, match="one driven joint"):
        bound_accuracy(straight, straight.machine.problems["S40"])
    _, problem = rig()
    assert "limits of position, rate, torque and torque_rate" in (bound_refusal(emps, problem) or "")
    model, _ = rig()
    assert bound_refusal(model, problem) is None
    assert "at rest" in (bound_refusal(model, problem.model_copy(update={"rest": False})) or "")


def test_the_same_seed_gives_the_same_bound() -> None:
    assert bound_accuracy(*rig(), "mean", degree=1, rounds=1) == bound_accuracy(*rig(), "mean", degree=1, rounds=1)
