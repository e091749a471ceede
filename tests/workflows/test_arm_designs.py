"""Designs of arms: a second step, earlier logs, effects, campaigns, several machines, payloads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from excite import identification, simulation, trajectories, workflows
from excite.errors import MachineError, UsageError
from excite.model import Model, build
from excite.model.machine import Problem
from excite.simulation import Motion, motion_along
from excite.trajectories import joint_motion, joint_search
from excite.workflows import CampaignRequest, DesignRequest, design_from
from excite.workflows.campaign_workflow import campaign_from, check_campaign
from excite.workflows.payload_design import loaded_machines, payload_contrasts, payload_design, payload_summary

ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"
QUICK = DesignRequest(starts=1, trajectory="fourier")


@pytest.fixture(scope="module")
def guess(arm: Model, problem: Problem) -> Motion:
    """Return a random motion within the limits."""
    aim = trajectories.compose_objective(arm, "cond")
    basis = joint_motion.motion_basis(arm, problem, "fourier", *joint_search.end_poses(arm, problem))
    program = joint_motion.MotionProgram(arm, problem, aim, basis)
    x = joint_search.best_guess(program, joint_search.free_poses(arm, problem), 0, lambda: False)
    return joint_motion.JointMotion(basis, program.coefficients(x)).sample(arm)


def test_known_motion_is_continued_under_a_ceiling_of_cond(arm: Model, problem: Problem, guess: Motion) -> None:
    most = trajectories.cond_phi(arm, guess)
    aim = trajectories.compose_objective(arm, "worst", cond_max=most)
    (state,) = joint_search.search(arm, problem, aim, "fourier", guess, lambda: False)
    assert state.begun_from.q == pytest.approx(guess.q, abs=1e-9), "a motion of this basis is its own fit"
    assert state.best.excess == 0
    found = joint_search.score_joint_motion(arm, problem, aim, "fourier", state.best.coefficients)
    before = trajectories.score_motions(aim, [(arm, guess)])
    assert found.score < before.score - 0.5, "the deviation of the worst parameter falls by a quarter at least"
    assert "cond-max" in found.violations


@pytest.mark.slow
def test_second_step_buys_accuracy_for_cond(arm: Model, problem: Problem) -> None:
    found = design_from(arm, problem, QUICK)
    first, second = found.first, found.design
    assert first is not None
    assert first.cond_phi < second.cond_phi <= 1.12 * first.cond_phi * (1 + 1e-6)
    worst = [trajectories.sigma_percent(found.aim, arm, d.motion).max() for d in (first, second)]
    assert worst[1] < 0.95 * worst[0]
    assert second.max_violation <= 1e-6


def log_along(arm: Model, motion: Motion, effects: tuple[str, ...] = (), noise: bool = True) -> pd.DataFrame:
    true = workflows.with_effects(arm, effects, len(motion.t))
    followed = simulation.play_back(true, motion.u, motion.q[0], motion.nu[0], (motion.q, motion.nu))
    return simulation.measure(true, followed, seed=1, noise=noise)


def test_effects_act_on_an_arm_under_its_controller(arm: Model, guess: Motion) -> None:
    """Torques of the log less those of the plain model along its motion are the drag that was added."""
    true = workflows.with_effects(arm, ("quadratic_drag@forearm=0.7",), len(guess.t))
    moved = simulation.play_back(true, guess.u, guess.q[0], guess.nu[0], (guess.q, guess.nu))
    plain = motion_along(arm, moved.t, moved.q, moved.nu, moved.a).u
    speed = moved.nu[:, 1]
    assert np.abs(speed).max() > 0.5
    assert moved.u[:, 1] - plain[:, 1] == pytest.approx(0.7 * speed * np.abs(speed), abs=1e-3)
    assert moved.u[:, 0] == pytest.approx(plain[:, 0], abs=1e-6)
    assert np.abs(moved.q - guess.q).max() < 0.1


def test_next_motion_counts_what_an_earlier_log_told(
    arm: Model, problem: Problem, guess: Motion, tmp_path: Path
) -> None:
    log_along(arm, guess).to_csv(tmp_path / "log.csv", index=False)
    model, information = workflows.design_request.with_earlier_logs(arm, [tmp_path / "log.csv"])
    assert information is not None
    assert np.linalg.eigvalsh(information * np.outer(arm.scale, arm.scale)).min() > 0
    assert model.nominal == pytest.approx(arm.nominal, rel=0.3, abs=0.3)
    one, two = (trajectories.compose_objective(model, "accuracy", prior=p) for p in (None, information))
    alone, after = (trajectories.sigma_percent(aim, model, guess) for aim in (one, two))
    assert (after < alone).all()


@pytest.mark.slow
def test_campaign_of_an_arm_adds_up_its_drives(arm: Model, problem: Problem) -> None:
    request = check_campaign(CampaignRequest(1.2, {}, 2, None, replace(QUICK, objective="cond")), arm, problem)
    found = campaign_from(arm, problem, request).campaign
    assert len(found.drives) == 2
    by = np.outer(arm.scale, arm.scale)
    total = sum(np.linalg.inv(trajectories.motion_bound(arm, d.motion) / by) for d in found.drives)
    together = 100 * np.sqrt(np.diag(np.linalg.inv(total)).max())
    assert found.percent == pytest.approx(together, rel=0.01)
    assert found.percent < min(found.alone_percent)
    assert found.drives[0].trajectory == "fourier"


# ------------------------------------------------------------------------------------------------ other machines


def heavier(arm: Model, problem: Problem) -> tuple[Model, Model]:
    return arm, replace(arm, nominal=1.3 * arm.nominal)


def test_other_machines_keep_their_torque_limits(arm: Model, problem: Problem, guess: Motion) -> None:
    """A torque limit between what the arm and a heavier one take: only the heavier one exceeds it."""
    both = heavier(arm, problem)
    each = [np.abs(motion_along(m, guess.t, guess.q, guess.nu, guess.a).u[:, 0]).max() for m in both]
    body = arm.machine.body[0]
    torque = body.limit.torque.model_copy(update={"value": float(np.mean(each))})
    tight = body.model_copy(update={"limit": body.limit.model_copy(update={"torque": torque})})
    machine = arm.machine.model_copy(update={"body": (tight, *arm.machine.body[1:])})
    model = replace(arm, machine=machine)
    other = replace(both[1], machine=machine)
    basis = joint_motion.motion_basis(model, problem, "fourier", *joint_search.end_poses(model, problem))
    motion = joint_motion.JointMotion(basis, joint_search.fit_coefficients(basis, guess.t, guess.q))
    assert joint_motion.all_violations(model, problem, motion)["torque u1"] == 0
    over = joint_motion.all_violations(model, problem, motion, (other,))["torque u1"]
    assert over == pytest.approx((each[1] - np.mean(each)) / (2 * np.mean(each)), rel=0.05)
    aim = replace(trajectories.compose_objective(model, "cond"), machines=(model, other))
    program = joint_motion.MotionProgram(model, problem, aim, basis)
    x = program.unknowns(motion.coefficients)
    assert program.slack(x).min() < 0
    d = np.random.default_rng(0).normal(size=program.size)
    moved = (program.slack(x + 1e-6 * d) - program.slack(x - 1e-6 * d)) / 2e-6
    assert program.slack_jacobian(x) @ d == pytest.approx(moved, abs=1e-4 * np.abs(moved).max())


# ------------------------------------------------------------------------------------------------ payload


def test_payload_changes_base_parameters_as_a_heavier_hand_does(arm: Model) -> None:
    """A cube at the origin of the forearm's frame, welded to it in the machine file."""
    body = arm.machine.body[-1]
    own = body.inertia
    mass, edge = 0.5, 0.1
    total = float(own.mass) + mass
    com = np.array(own.com.value) * float(own.mass) / total
    shift = own.com.value[0] ** 2 + own.com.value[1] ** 2
    about = float(own.ZZ) + float(own.mass) * shift + mass * edge**2 / 6 - total * (com[0] ** 2 + com[1] ** 2)
    welded = own.model_copy(
        update={
            "mass": own.mass.model_copy(update={"value": float(total)}),
            "com": own.com.model_copy(update={"value": tuple(com.tolist())}),
            "ZZ": own.ZZ.model_copy(update={"value": float(about)}),
        }
    )
    bodies = (*arm.machine.body[:-1], body.model_copy(update={"inertia": welded}))
    loaded = build(arm.machine.model_copy(update={"body": bodies}))
    assert loaded_machines(arm, mass)[1].nominal == pytest.approx(loaded.nominal, abs=1e-12)


def test_promised_payload_is_that_of_identify(arm: Model, guess: Motion) -> None:
    each = [
        trajectories.motion_bound(m, motion_along(m, guess.t, guess.q, guess.nu, guess.a))
        for m in loaded_machines(arm, 0.5)
    ]
    loaded, unloaded = (
        SimpleNamespace(names=arm.base.names, value=arm.nominal, covariance=C, std=np.sqrt(np.diag(C))) for C in each
    )
    found = identification.payload_parameters(arm, loaded, unloaded)
    promised = payload_summary(arm, 0.5, [guess])
    assert [n + ("R" if len(g) > 1 else "") for n, g in zip(promised["std"], found.groups, strict=True)] == list(
        found.names
    )
    assert list(promised["std"].values()) == pytest.approx(found.std.tolist(), rel=1e-6)


def test_payload_contrasts_cannot_promise_more_than_least_squares(arm: Model, guess: Motion) -> None:
    C = trajectories.motion_bound(arm, guess)
    by = trajectories.reference_values(arm)
    variances = trajectories.contrast_variances(C / np.outer(by, by), payload_contrasts(arm, 0.5))
    best = payload_design(arm, 0.5)
    least = np.sqrt(np.diag(best.covariance(2 * C))) / best.size
    assert (np.sqrt(variances) > 0.999 * least).all()
    assert (np.sqrt(variances) < 3 * least).all()


def test_options_that_do_not_go_with_a_payload_are_refused(arm: Model, problem: Problem) -> None:
    with pytest.raises(UsageError, match=r"--payload: needs an --objective of accuracy: .* \(got D\)"):
        design_from(arm, problem, replace(QUICK, payload_kg=1.0, objective="D"))
    with pytest.raises(UsageError, match="--payload: does not go with --robust"):
        design_from(arm, problem, replace(QUICK, payload_kg=1.0, robust=True))
    model, _, straight = workflows.prepare_design("va12_straight", None, None, DesignRequest())
    with pytest.raises(MachineError, match="--payload is for arms"):
        design_from(model, straight, DesignRequest(payload_kg=1.0))
