"""Joint motions of arms: derivatives against differences, torques against the textbook, limits between samples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from excite import reports, simulation, trajectories, workflows
from excite.errors import MachineError, UsageError
from excite.model import Model, build
from excite.model.machine import Body, Problem, load_machine
from excite.trajectories import JointMotion, MotionProgram, joint_motion, joint_search, multistart
from excite.workflows import DesignRequest, choose_problem, design_from, prepare_design

ARM = Path(__file__).parents[1] / "support" / "two_joints.toml"


def basis_of(arm: Model, problem: Problem, kind: str) -> joint_motion.Basis:
    return joint_motion.BASES[kind](problem, *joint_search.end_poses(arm, problem))


def differences(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, d: np.ndarray) -> np.ndarray:
    h = 1e-6
    return np.asarray(f(x + h * d) - f(x - h * d)) / (2 * h)


# ------------------------------------------------------------------------------------------------ motion


@pytest.mark.parametrize("kind", joint_motion.BASES)
def test_motion_leads_from_pose_to_pose_at_rest(arm: Model, problem: Problem, kind: str) -> None:
    basis = basis_of(arm, problem, kind)
    motion = JointMotion(basis, np.random.default_rng(0).normal(size=(2, basis.count)))
    ends = np.array([0.0, 4.0])
    assert motion.at(ends) == pytest.approx(np.array([[-1.2, 0.0], [-0.4, 0.5]]), abs=1e-9)
    for order in (1, 2):
        assert motion.at(ends, order) == pytest.approx(0, abs=1e-8)
    t = np.linspace(0.1, 3.9, 20)
    for order in (0, 1, 2):
        slope = (motion.at(t + 1e-5, order) - motion.at(t - 1e-5, order)) / 2e-5
        assert motion.at(t, order + 1) == pytest.approx(slope, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("kind", joint_motion.BASES)
def test_without_rest_ends_are_free(arm: Model, problem: Problem, kind: str) -> None:
    basis = basis_of(arm, problem.model_copy(update={"rest": False}), kind)
    motion = JointMotion(basis, np.random.default_rng(0).normal(size=(2, basis.count)))
    assert np.abs(motion.at(np.array([0.0, 4.0]), 1)).min() > 1e-3


def test_torques_are_those_of_the_textbook(arm: Model) -> None:
    """Lagrange's equations of two links in a vertical plane, written out by hand."""
    rng = np.random.default_rng(1)
    q, w, a = rng.normal(size=(3, 2, 50))
    m1, x1, y1, I1, m2, x2, y2, I2, length, g = 3, 0.2, 0.03, 0.06, 2, 0.15, -0.02, 0.025, 0.4, 9.81
    c, s = np.cos(q[1]), np.sin(q[1])
    own = I2 + m2 * (x2**2 + y2**2)
    along, across = m2 * length * (x2 * c - y2 * s), m2 * length * (x2 * s + y2 * c)
    M11 = I1 + m1 * (x1**2 + y1**2) + own + m2 * length**2 + 2 * along
    both = q[0] + q[1]
    fall2 = m2 * g * (x2 * np.cos(both) - y2 * np.sin(both))
    fall1 = m1 * g * (x1 * np.cos(q[0]) - y1 * np.sin(q[0])) + m2 * g * length * np.cos(q[0]) + fall2
    u1 = M11 * a[0] + (own + along) * a[1] - across * (2 * w[0] * w[1] + w[1] ** 2) + fall1
    u2 = (own + along) * a[0] + own * a[1] + across * w[0] ** 2 + fall2
    u1 += 1.5 * w[0] + 2 * np.tanh(w[0] / 0.02)
    u2 += 0.8 * w[1] + 1 * np.tanh(w[1] / 0.02)
    found = simulation.motion_along(arm, np.arange(50.0), q.T, w.T, a.T).u
    assert found == pytest.approx(np.stack([u1, u2], axis=1), rel=1e-9, abs=1e-9)


def test_limits_are_judged_between_samples(arm: Model, problem: Problem) -> None:
    """A top speed between two samples: the samples keep the limit, the motion does not."""
    rows = arm.machine.sampling_hz.model_copy(update={"value": 5.0})
    arm = arm.for_machine(arm.machine.model_copy(update={"sampling_hz": rows}))
    basis = basis_of(arm, problem, "fourier")
    motion = JointMotion(basis, 0.05 * np.random.default_rng(3).normal(size=(2, basis.count)))
    speed = np.abs(motion.sample(arm).nu[:, 0]).max()
    top = np.abs(motion.at(np.linspace(0, 4, 400001), 1)[:, 0]).max()
    assert top > 1.002 * speed
    bodies = list(arm.machine.body)
    rate = bodies[0].limit.rate.model_copy(update={"value": float((speed + top) / 2)})
    bodies[0] = bodies[0].model_copy(update={"limit": bodies[0].limit.model_copy(update={"rate": rate})})
    slow = arm.for_machine(arm.machine.model_copy(update={"body": tuple(bodies)}))
    assert trajectories.check_limits(slow, problem, motion.sample(slow))["rate upper_arm"] == 0
    expected = (top - (speed + top) / 2) / (speed + top)
    assert trajectories.between_samples(slow, problem, motion)["rate upper_arm"] == pytest.approx(expected, rel=0.02)


# ------------------------------------------------------------------------------------------------ program


@pytest.mark.parametrize("kind", joint_motion.BASES)
@pytest.mark.parametrize("objective", ["cond", "accuracy", "D"])
def test_derivatives_are_exact(arm: Model, problem: Problem, kind: str, objective: str) -> None:
    aim = trajectories.compose_objective(arm, objective, sigma_max=5.0)
    program = MotionProgram(joint_motion.with_smooth_friction(arm), problem, aim, basis_of(arm, problem, kind))
    rng = np.random.default_rng(2)
    x, d = 0.1 * rng.normal(size=program.size), rng.normal(size=program.size)
    value, gradient = program.value_and_gradient(x)
    assert value == pytest.approx(program.value(x))
    assert gradient @ d == pytest.approx(differences(lambda x: np.array(program.value(x)), x, d), rel=1e-5)
    moved = program.slack_jacobian(x) @ d
    assert moved == pytest.approx(differences(program.slack, x, d), abs=1e-5 * np.abs(moved).max())


def test_bounds_are_lowered_beside_what_the_program_does_not_see(arm: Model, problem: Problem) -> None:
    """One point between two samples exceeds a rate by 2 % of its range, though the program sees half the limit."""
    aim = trajectories.compose_objective(arm, "cond")
    program = MotionProgram(joint_motion.with_smooth_friction(arm), problem, aim, basis_of(arm, problem, "free"))
    x = 0.02 * np.random.default_rng(3).normal(size=program.size)
    free, values = program.slack(x), program.limit_values(x)
    k = next(k for k, g in enumerate(program.limits) if g.kind == "rate")
    t = np.linspace(0, 4.0, 8001)
    excess = {g.name: np.zeros(len(t)) for g in program.limits}
    at = int(np.argmin(np.abs(t - 1.01)))
    place = 1.01 / 4.0 * (len(values) - 1)
    beside = int(np.floor(place)), int(np.ceil(place))
    side = int(values[beside[0], k] < 0)
    excess[program.limits[k].name][at] = -0.02 if side else 0.02
    program.widen_margins(x, t, excess)
    changed = np.argwhere(program.margins != joint_motion.FIRST_MARGIN)
    assert [tuple(c) for c in changed] == [(side, n, k) for n in beside]
    slack, row = program.slack(x), side * program.n_g + k
    assert slack[row] == pytest.approx(-1.2 * 0.04 - joint_motion.FIRST_MARGIN)
    assert np.delete(slack, row) == pytest.approx(np.delete(free, row))
    d = np.random.default_rng(4).normal(size=program.size)
    x = x + 1e-3 * d  # both samples beside the point are equally far from their bounds at x
    moved = program.slack_jacobian(x) @ d
    assert moved == pytest.approx(differences(program.slack, x, d), abs=1e-5 * np.abs(moved).max())


def test_a_solve_that_cannot_keep_the_limits_ends_where_it_came_nearest(
    arm: Model, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search passes three motions of growing size, the last one by far outside."""
    aim = trajectories.compose_objective(arm, "cond")
    program = MotionProgram(joint_motion.with_smooth_friction(arm), problem, aim, basis_of(arm, problem, "free"))
    direction = np.random.default_rng(5).normal(size=program.size)
    passed = [size * direction for size in (0.5, 0.2, 2.0)]
    program.margins[:] = 1.2  # on both sides: no motion keeps them

    def pass_by(*_: object, callback: Callable[[np.ndarray], None], **__: object) -> None:
        for x in passed:
            callback(x)

    monkeypatch.setattr(joint_motion, "minimize", pass_by)
    found = program.solve(passed[0], lambda: False, 25)
    assert found.x == pytest.approx(passed[1])
    assert found.last == pytest.approx(passed[2])


@pytest.mark.parametrize(("kind", "most"), [("fourier", 26.0), ("free", 25.0)])
def test_design_of_two_joints_reaches_a_figure(arm: Model, problem: Problem, kind: str, most: float) -> None:
    """Measured 25.4 and 23.6; the best of 200 random series has 64."""
    aim = trajectories.compose_objective(arm, "cond")
    *_, state = joint_search.search(arm, problem, aim, kind, 0, lambda: False)
    assert np.exp(state.best.score / 2) < most
    assert state.best.excess == 0
    assert state.complete


def test_stopping_gives_the_best_so_far(arm: Model, problem: Problem) -> None:
    asked = [0]

    def stop() -> bool:
        asked[0] += 1
        return asked[0] > joint_search.GUESSES + 20  # the guess asks after each of its tries

    aim = trajectories.compose_objective(arm, "cond")
    (state,) = joint_search.search(arm, problem, aim, "free", 0, stop)
    assert not state.complete
    assert np.exp(state.best.score / 2) < 0.9 * state.start_cond_phi
    assert state.best.excess <= trajectories.TOLERANCE


# ------------------------------------------------------------------------------------------------ around it


def test_arm_follows_its_design_under_position_control(arm: Model, problem: Problem) -> None:
    basis = basis_of(arm, problem, "fourier")
    motion = JointMotion(basis, 0.1 * np.random.default_rng(4).normal(size=(2, basis.count))).sample(arm)
    held = simulation.follow_positions(arm, motion.u, motion.q, motion.nu)
    assert np.abs(held.q - motion.q).max() < 0.01
    heavier = arm.nominal * 1.1
    held = simulation.follow_positions(arm, motion.u, motion.q, motion.nu, heavier)
    alone = simulation.simulate(arm, motion.u, heavier, motion.q[0], motion.nu[0])
    assert np.abs(held.q - motion.q).max() < 0.1
    assert np.abs(alone.q - motion.q).max() > 0.5


@pytest.mark.xfail(reason="on some processors the search ends at a followed position that is 3 % beyond its limit")
def test_design_keeps_its_limits_where_a_controller_follows_it(arm: Model, problem: Problem) -> None:
    """A slow controller overshoots: a design for the planned motion alone exceeds a position by 2.6 %."""
    rows = arm.machine.sampling_hz.model_copy(update={"value": 20.0})
    slow = arm.for_machine(arm.machine.model_copy(update={"sampling_hz": rows}))
    request = DesignRequest(starts=1, trajectory="fourier")
    found = design_from(slow, problem, request)
    motion = found.design.motion
    driven = simulation.follow_positions(slow, motion.u, motion.q, motion.nu)
    over = trajectories.check_limits(slow, problem, driven)
    assert found.design.followed == {n: x for n, x in over.items() if not n.startswith("rest")}
    assert max(found.design.followed.values()) <= 1e-6
    assert found.design.cond_phi < 1.1 * 25.29  # that of the planned motion alone
    summary = workflows.design_account(found, "A4", problem, request, 0.0).summary
    kept = "They are kept where a position controller follows the motion as well."
    assert kept in str(reports.describe("design", summary).remarks)
    summary["followed"] = {"rate forearm": 0.0024}
    assert "it exceeds rate forearm by 0.24 % of the range" in str(reports.describe("design", summary).remarks)


def test_design_folder_is_played_back_by_positions(arm: Model, tmp_path: Path) -> None:
    place = tmp_path / "design"
    place.mkdir()
    request = DesignRequest(starts=1, trajectory="fourier")
    summary = workflows.design(place, str(ARM), None, None, request)
    assert summary["trajectory"] == "fourier"
    assert summary["max_violation"] == 0
    back = trajectories.read_design(place)
    assert trajectories.cond_phi(back.model, back.motion) == pytest.approx(summary["cond_phi"], rel=0.05)
    judged = trajectories.score_motion(back.model, back.problem, back.motion)
    assert judged.max_violation < 0.01


def test_only_arms_have_joint_motions(arm: Model) -> None:
    model, _, problem = prepare_design("va12_straight", None, None, DesignRequest())
    with pytest.raises(MachineError, match="leave out --trajectory"):
        design_from(model, problem, DesignRequest(trajectory="fourier"))
    problem = choose_problem(arm.machine, None, None)[1]
    with pytest.raises(UsageError, match="--driver: not for two_joints"):
        design_from(arm, problem, DesignRequest(driver=True))


def test_arm_without_problem_and_noise_figures_is_designed(arm: Model) -> None:
    """Duration and poses are the usual ones, noise is assumed and named."""
    silent = tuple(s.model_copy(update={"noise": None, "counts_per_turn": None}) for s in arm.machine.sensor)
    machine = arm.machine.model_copy(update={"sensor": silent, "problems": {}, "problem": None})
    model, name, problem = prepare_design(build(machine), None, 4.0, DesignRequest())
    assert (name, float(problem.duration_s)) == ("A8", 4.0)
    found = design_from(model, problem, DesignRequest(starts=1, trajectory="fourier", budget_s=5.0))
    assert found.assumed_noise == ("q1", "u1", "q2", "u2")
    assert found.model.machine.sensor[1].noise.value == pytest.approx(0.005 * 40)


def test_design_takes_zeros_that_no_torque_shows_from_the_file(arm: Model, problem: Problem) -> None:
    """The zero of the upper arm shows and counts; that of the forearm is a turn of its own centre of mass."""
    sought = tuple(s.model_copy(update={"zero": "sought"}) if s.kind == "angle" else s for s in arm.machine.sensor)
    both = arm.for_machine(arm.machine.model_copy(update={"sensor": sought}))
    found = design_from(both, problem, DesignRequest("accuracy", starts=1, budget_s=5))
    assert found.given_zeros == ("q20",)
    assert found.model.base.names == (*arm.base.names, "q10")
    assert found.design.cond_phi < 1e4


# ------------------------------------------------------------------------------------------------ weight

RIG = ARM.with_name("rig.toml")
OVERLOADED = {
    "slide": (RIG, 'value = "pi/2"', "value = 0", "carriage with 933 N in every pose, .* limit of 150 N; raise torque"),
    "given pose": (
        ARM,
        "value = 40,",
        "value = 8,",
        r"upper_arm with 16 N m at theta1 -0\.4 rad, theta2 0\.5 rad, .* 8",
    ),
    "chosen pose": (
        ARM,
        "value = 40,",
        "value = 1e-3,",
        r"none of 1000 random poses .* even in the best .* upper_arm with [\d.]+ N m at theta1 [-\d.]+ rad",
    ),
}


@pytest.mark.parametrize("case", OVERLOADED)
def test_a_weight_beyond_the_drives_is_named(case: str, tmp_path: Path) -> None:
    file, before, after, words = OVERLOADED[case]
    text = file.read_text().replace(before, after, 1)
    if case == "chosen pose":
        text = text.replace("start_pose", "# start_pose").replace("end_pose", "# end_pose")
    (tmp_path / "weak.toml").write_text(text)
    request = DesignRequest(starts=1, budget_s=1)
    model, _, problem = prepare_design(str(tmp_path / "weak.toml"), None, None, request)
    with pytest.raises(MachineError, match=words):
        design_from(model, problem, request)


def test_a_search_that_exceeds_a_torque_limit_says_what_gravity_takes(arm: Model) -> None:
    aim = trajectories.compose_objective(arm, "cond")
    enough = multistart.infeasible_error(arm, aim, {"torque u1": 0.1}, complete=False)
    assert "give more time" in str(enough)
    weak = build(load_machine(str(ARM)).model_copy(update={"body": tuple(_weaker(b) for b in arm.machine.body)}))
    said = str(multistart.infeasible_error(weak, aim, {"torque u1": 0.1}, complete=False))
    assert "gravity loads upper_arm with" in said
    assert "more than its torque limit of 4 N m" in said
    assert "more time" not in said


def test_a_drive_without_rest_begins_with_room_where_zero_ends_a_range(tmp_path: Path) -> None:
    """At zero, with the upper arm level, the torque limit of 14 N m doesn't hold the arm of 16.7 N m, and needn't."""
    text = ARM.read_text().replace("value = 40,", "value = 14,", 1)
    text = text.replace("position = { value = 2,", "position_high = { value = 1.45,", 1)
    text = text.replace("[body.limit]", '[body.limit]\nposition_low = { value = 0, source = "definition" }', 1)
    text = text.replace("start_pose", "rest = false\nperiodic = true\n# start_pose").replace("end_pose", "# end_pose")
    (tmp_path / "onesided.toml").write_text(text)
    model, _, problem = prepare_design(str(tmp_path / "onesided.toml"), None, None, DesignRequest())
    assert joint_search.end_poses(model, problem)[0][0] == pytest.approx(1.45 / 2)
    assert len(joint_search.free_poses(model, problem)) > 10


def test_guesses_move_joints_that_start_at_the_end_of_their_range(arm: Model, problem: Problem) -> None:
    """However little room is left there: without any motion there is no condition number to begin with."""
    ends = dict(zip(arm.coordinates, joint_search.drive_ranges(arm)[1], strict=True))
    at_ends = problem.model_copy(update={"start_pose": ends, "end_pose": ends})
    aim = trajectories.compose_objective(arm, "cond")
    basis = joint_motion.motion_basis(arm, at_ends, "fourier", *joint_search.end_poses(arm, at_ends))
    program = joint_motion.MotionProgram(arm, at_ends, aim, basis)
    x = joint_search.best_guess(program, joint_search.end_poses(arm, at_ends)[:1], 0, lambda: False)
    motion = joint_motion.JointMotion(basis, program.coefficients(x)).sample(arm)
    assert (np.ptp(motion.q, axis=0) > 1e-3).all()


def _weaker(body: Body) -> Body:
    torque = body.limit.torque
    assert torque is not None
    return body.model_copy(
        update={"limit": body.limit.model_copy(update={"torque": torque.model_copy(update={"value": 4.0})})}
    )
