"""Designs hold when they are simulated afresh, reach the published score, and say which limit can't be met."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import joblib
import numpy as np
import pytest
from joblib.externals.loky.process_executor import TerminatedWorkerError
from matplotlib.path import Path as MplPath

from excite.errors import InfeasibleError
from excite.model import Model, prediction
from excite.model.machine import Problem, Quantity, machine
from excite.simulation import Motion, simulate
from excite.trajectories import (
    TOLERANCE,
    BestSoFar,
    Design,
    Manoeuvre,
    check_limits,
    collocation,
    compose_objective,
    continuation,
    design,
    interior_point,
    machine_limits,
    multisine,
    objective,
    place_on_lane,
    scale_torques,
)
from excite.trajectories.collocation import widen_transitions
from excite.trajectories.continuation import STAGES, repair, run_stages, start_from_multisine
from excite.trajectories.excitation import chirp, steps
from excite.trajectories.limits import count_reversals, travel_directions


def shorter(model: Model, seconds: float, **other: object) -> Problem:
    problem = model.machine.problems[model.machine.problem or ""]
    duration = problem.duration_s.model_copy(update={"value": seconds})
    return problem.model_copy(update={"duration_s": duration, **other})


SEEN: list[tuple[int, int, BestSoFar]] = []  # progress of the design below


@pytest.fixture(scope="module")
def quick(straight: Model) -> Design:
    return design(straight, shorter(straight, 12.0), starts=1, seed=3, progress=lambda *at: SEEN.append(at))


def fresh_check(model: Model, problem: Problem, d: Design) -> None:
    """The limits and the score again, by hand: classical RK4 at 0.25 ms from the profile's torques alone."""
    u = d.manoeuvre.sample(100.0)
    n = len(model.coordinates)
    steps, h = 40, 0.01 / 40
    f = model.acceleration
    q, nu = d.motion.q[0].copy(), np.zeros(n)
    free = {c: k for k, c in enumerate(model.coordinates)}

    def rate(nu: np.ndarray, u: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return model.kinematics(q, nu)[0].full().ravel(), f(q, nu, u, model.nominal).full().ravel()

    worst = np.zeros(n)
    for k in range(300):
        for i in range(steps):
            a, b, c = (u[k] + (u[k + 1] - u[k]) * (i + s) / steps for s in (0, 0.5, 1))
            k1 = rate(nu, a, q)
            k2 = rate(nu + h / 2 * k1[1], b, q + h / 2 * k1[0])
            k3 = rate(nu + h / 2 * k2[1], b, q + h / 2 * k2[0])
            k4 = rate(nu + h * k3[1], c, q + h * k3[0])
            q = q + h / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
            nu = nu + h / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
        worst = np.maximum(worst, np.abs(nu - d.motion.nu[k + 1]))
    assert worst.max() < 1e-5
    for body in model.machine.contacts:
        spin = d.motion.nu[:, free[body.coordinates[0]]]
        assert np.abs(float(body.contact.radius) * spin).max() <= 2.0 * (1 + 2e-3)  # type: ignore[union-attr]
    for k, body in enumerate(model.machine.actuated):
        assert np.abs(u[:, k]).max() <= float(body.limit.torque) * (1 + 2e-3)  # type: ignore[arg-type]
        assert np.abs(np.diff(u[:, k])).max() * 100 <= float(body.limit.torque_rate) * (1 + 2e-3)  # type: ignore[arg-type]
    power = sum(np.abs(u[:, k] * d.motion.nu[:, row]) for k, row in enumerate(model.actuated))
    assert power.max() <= 20000 * 1.001
    assert np.abs(u[[0, -1]]).max() == 0
    assert np.abs(d.motion.nu[-1]).max() < 0.03
    W = model.stacked_regressor(d.motion.q.T, d.motion.nu.T, d.motion.a.T).reshape(-1, len(model.scale))
    assert d.cond_phi == pytest.approx(np.linalg.cond(W * model.scale), rel=1e-9)
    assert d.cond_w == pytest.approx(np.linalg.cond(W), rel=1e-6)


@pytest.mark.slow
def test_the_answer_holds_when_simulated_by_another_integrator(straight: Model, quick: Design) -> None:
    fresh_check(straight, shorter(straight, 12.0), quick)
    assert quick.max_violation <= TOLERANCE
    assert quick.cond_phi < 0.7 * quick.cond_phi_start
    assert quick.complete


def test_progress_shows_every_stage_and_the_best_so_far(quick: Design) -> None:
    done, total, best = zip(*SEEN, strict=True)
    assert len(done) >= 5
    assert set(total) == {6}
    assert list(done) == sorted(done)
    assert done[-1] == 6
    assert list(best) == sorted(best, reverse=True)
    assert best[-1] == pytest.approx(quick.cond_phi, rel=1e-6)
    told = [one.doing for one in best]
    assert all(text.startswith("start 1 of 1, stage ") for text in told)
    assert all(
        ("no drive within all limits yet: " in text) == np.isinf(one) for text, one in zip(told, best, strict=True)
    )


def test_same_seed_same_design(straight: Model, quick: Design) -> None:
    again = design(straight, shorter(straight, 12.0), starts=1, seed=3)
    assert np.array_equal(again.manoeuvre.torque, quick.manoeuvre.torque)
    assert again.cond_phi == quick.cond_phi


@pytest.mark.slow
def test_s40_reaches_the_target(straight: Model) -> None:
    problem = straight.machine.problems["S40"]
    d = design(straight, problem, starts=1, seed=1)
    assert d.cond_phi <= 23.5
    assert d.scores == (pytest.approx(d.cond_phi, rel=1e-4),)
    assert d.max_violation <= TOLERANCE
    fresh_check(straight, problem, d)


@pytest.mark.slow
def test_r60_reaches_the_target(va12: Model) -> None:
    problem = va12.machine.problems["R60"]
    d = design(va12, problem, starts=1, seed=0)
    assert d.cond_phi <= 19.0
    assert d.max_violation <= TOLERANCE
    fresh_check(va12, problem, d)


def test_another_machine_needs_no_other_code() -> None:
    """One prismatic joint, no contact, no lane; its friction is a sharp sign function."""
    model = prediction.build(machine.load_machine("emps"))
    number = partial(Quantity, source="assumed")
    problem = Problem(
        duration_s=number(value=10.0), knot_s=number(value=0.1), lane_m=(1, 1), lane_points=(), source="assumed"
    )
    d = design(model, problem, starts=1)
    assert d.max_violation <= TOLERANCE
    assert d.cond_phi < 5


@pytest.mark.parametrize("name", ["D", "A", "E"])
def test_other_objectives(straight: Model, quick: Design, name: str) -> None:
    problem = shorter(straight, 12.0)
    d = design(straight, problem, objective=name, starts=1, seed=3)
    P, Q = objective.phi(straight, d.motion), objective.phi(straight, quick.motion)
    assert objective.score_matrix(name, P.T @ P) < objective.score_matrix(name, Q.T @ Q)
    assert d.max_violation <= TOLERANCE


def test_an_unknown_objective_is_refused(straight: Model) -> None:
    with pytest.raises(KeyError, match="allowed: cond"):
        design(straight, shorter(straight, 12.0), objective="best")


@pytest.mark.slow
def test_an_infeasible_problem_names_the_limit(straight: Model) -> None:
    """The roll centres are 3.2 m apart: no drive fits a lane of 2 m."""
    with pytest.raises(InfeasibleError, match="lane x") as caught:
        design(straight, shorter(straight, 12.0, lane_m=(2.0, 20.0)), starts=1)
    assert caught.value.limit.startswith("lane x")
    assert caught.value.excess >= 0.3


def test_a_short_lane_is_kept(straight: Model) -> None:
    problem = shorter(straight, 12.0, lane_m=(8.0, 20.0))
    d = design(straight, problem, starts=1, seed=1)
    assert d.max_violation <= TOLERANCE


def test_without_a_budget_left_nothing_is_made_up(straight: Model) -> None:
    with pytest.raises(InfeasibleError, match="give more time"):
        design(straight, straight.machine.problems["S40"], starts=1, budget_s=0.0)


def test_what_the_fresh_simulation_exceeds_is_repaired(straight: Model) -> None:
    """The first stage ends far from rest, with transitions ten times wider than the machine's."""
    problem = shorter(straight, 12.0)
    cond = compose_objective(straight, "cond")
    track = run_stages(
        straight, problem, cond, start_from_multisine(straight, problem, cond, 0, 1), STAGES[:1], lambda: False
    )
    assert not track.latest.feasible
    assert repair(straight, problem, cond, track, lambda: False).best.feasible


def test_a_limit_exceeded_after_a_repair_is_moved_in(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """An excess of 1 % before the repairs is left to finer elements; one of the first repair makes a margin of 2 %."""
    problem = shorter(straight, 12.0)
    cond = compose_objective(straight, "cond")
    start = start_from_multisine(straight, problem, cond, 0, 1)
    track = run_stages(straight, problem, cond, start, STAGES[:2], lambda: False)
    exceeded = [{"torque rate u4": 0.01}] * 2  # before the repairs and after the first one
    evaluate, solve = continuation.evaluate_drive, continuation.SOLVERS["own"]
    margins: list[float] = []

    def judge(*given: Any) -> tuple[continuation.ScoredDrive, Motion]:
        found, motion = evaluate(*given)
        return replace(found, violations=exceeded.pop() if exceeded else {}), motion

    def watch(program: continuation.StageProgram, stop: Callable[[], bool]) -> continuation.StageSolution:
        margins.append(float(program.task.torque_margin[0, program.tr.torque_limit_names.index("torque rate u4")]))
        return solve(program, stop)

    off = replace(track.latest, violations=exceeded.pop())
    monkeypatch.setattr(continuation, "evaluate_drive", judge)
    monkeypatch.setitem(continuation.SOLVERS, "own", watch)
    assert repair(straight, problem, cond, replace(track, latest=off, best=off), lambda: False).latest.feasible
    assert margins == pytest.approx([1e-4, 1e-4 + 2 * 0.02])  # half ranges


@pytest.mark.slow
def test_ctrl_c_keeps_the_best_so_far() -> None:
    """A first interrupt once there is a drive within the limits: it ends with a drive, and says it isn't complete."""
    code = (
        "import os, signal, threading\n"
        "from excite.trajectories import design\n"
        "from excite.model import build\n"
        "from excite.model.machine import load_machine\n"
        "if __name__ == '__main__':\n"
        "    model = build(load_machine('va12_straight'))\n"
        "    def seen(done, total, best):\n"
        "        if best < 1e9:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "    d = design(model, model.machine.problems['S40'], starts=6, progress=seen)\n"
        "    print(d.complete, d.max_violation <= 1e-3, d.cond_phi < 60)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert run.stdout.split() == ["False", "True", "True"], run.stderr[-2000:]


def test_limits_are_named_and_scaled(va12: Model) -> None:
    every = machine_limits(va12, va12.machine.problems["R60"])
    names = [g.name for g in every]
    assert len(set(names)) == len(names) == 19
    assert {"torque u2", "torque rate u4", "position articulation", "rate articulation", "power"} <= set(names)
    assert {"slip rear_roll left", "slip front_roll right", "rim speed front_roll", "lane y rear_roll"} <= set(names)


def test_check_measures_the_excess(straight: Model) -> None:
    problem = straight.machine.problems["S40"]
    u = np.zeros((401, 2))
    u[50:350] = 6000.0
    excess = check_limits(straight, problem, simulate(straight, u))
    assert excess["torque u1"] == pytest.approx(0.1)
    assert excess["torque rate u1"] == pytest.approx((600000 - 10000) / 20000)
    assert excess["rest x0'"] > 1


def test_placed_fits_a_diagonal_path_into_the_lane(va12: Model) -> None:
    problem = va12.machine.problems["R60"]
    u = np.zeros((1501, 3))
    u[20:900, [0, 2]] = 600.0
    q0 = np.array([30.0, -12.0, 0.8, 0, 0, 0])
    motion = simulate(va12, u, q0=q0)
    assert max(v for k, v in check_limits(va12, problem, motion).items() if k.startswith("lane")) > 0.1
    again = simulate(va12, u, q0=place_on_lane(va12, problem, motion))
    assert max(v for k, v in check_limits(va12, problem, again).items() if k.startswith("lane")) == 0


@pytest.mark.parametrize("make", [multisine, steps, chirp])
def test_baselines_keep_torque_and_rate(va12: Model, make: Callable[[Model, Problem, int], Manoeuvre]) -> None:
    problem = va12.machine.problems["R60"]
    drive = make(va12, problem, 5)
    assert np.array_equal(drive.torque, make(va12, problem, 5).torque)
    assert (np.abs(drive.torque).max(axis=0) <= [5000, 15000, 5000]).all()
    rate = np.abs(np.diff(drive.torque, axis=0)).max(axis=0) / 0.2
    assert (rate <= np.array([10000, 40000, 10000]) * (1 + 1e-12)).all()
    assert not drive.torque[[0, -1]].any()
    assert drive.sample(100).shape == (6001, 3)


def test_a_manoeuvre_is_refused_when_its_times_dont_increase() -> None:
    with pytest.raises(ValueError, match="increase"):
        Manoeuvre(np.array([0.0, 1.0, 1.0]), np.zeros((3, 1)))


def test_newton_step_is_the_dense_one() -> None:
    """The Riccati recursion with its border solves the same equations as one dense matrix, and knows its inertia."""
    rng = np.random.default_rng(1)
    K, n_z, n_u, n_a = 7, 3, 2, 6
    n_y, n_r = n_z + n_u, n_z + 2 * n_u
    Q = rng.normal(size=(K, n_r, n_r))
    Q = Q + Q.transpose(0, 2, 1)
    h = rng.normal(size=(K, n_r))
    A = np.zeros((K, n_y, n_r))
    A[:, :n_z] = 0.4 * rng.normal(size=(K, n_z, n_r))
    A[:, range(n_z, n_y), range(n_y, n_r)] = 1
    border, F = rng.normal(size=(K, n_r, n_a)), rng.normal(size=(n_a, 4))
    last = np.diag(rng.uniform(1, 2, n_y)), rng.normal(size=n_y)
    loose = np.array([1])
    n = 1 + (K - 1) * n_u
    state, D = np.zeros((n_y, n)), np.zeros((K, n_r, n))
    state[loose[0], 0] = 1
    for k in range(K):
        D[k, :n_y] = state
        if k < K - 1:
            D[k, n_y:, 1 + k * n_u : 1 + (k + 1) * n_u] = np.eye(n_u)
        state = A[k] @ D[k]
    J = np.einsum("kra,krn->an", border, D)
    H = np.einsum("krn,krs,ksm->nm", D, Q, D) + J.T @ F @ F.T @ J + state.T @ last[0] @ state
    g = np.einsum("krn,kr->n", D, h) + state.T @ last[1]
    seen = set()
    for regular in (0.0, 3.0, 30.0):
        dense = H + max(regular, 1e-8) * np.eye(n)
        dense[1:, 1:] += (regular - max(regular, 1e-8)) * np.eye(n - 1)
        positive = bool((np.linalg.eigvalsh(dense) > 0).all())
        seen.add(positive)
        step = interior_point.solve_newton_system(Q, h, A, border @ F, last, loose, regular)
        assert (step is not None) == positive
        if step is not None:
            expected = np.einsum("krn,n->kr", D, -np.linalg.solve(dense, g))
            assert np.abs(step - expected).max() < 1e-9 * max(1, np.abs(expected).max())
    assert seen == {True, False}


def test_settled_states_follow_the_accurate_simulation(va12: Model) -> None:
    problem = shorter(va12, 6.0)
    drive = multisine(va12, problem, 2)
    motion = simulate(va12, drive.torque[:1] * 0 + drive.sample(100) * 0.3)
    sizes = dict.fromkeys(va12.coordinates, 1.0) | {c + "'": 1.0 for c in va12.coordinates}
    tr = collocation.transcribe(va12, problem, sizes, 30, motion, elements=4)
    at = (np.arange(30)[:, None] + tr.node_position) * tr.interval_s
    start, U = np.zeros(tr.n_z), 0.3 * drive.torque / tr.torque_scale
    Z = collocation.solve_states(tr, start, U, np.zeros((30, 12, tr.n_z)))
    near = Z + 0.01 * np.random.default_rng(0).normal(size=Z.shape)
    assert np.abs(collocation.solve_states(tr, start, U, near) - Z).max() < 1e-7
    far = Z + 1e3 * np.random.default_rng(0).normal(size=Z.shape)
    assert np.abs(collocation.solve_states(tr, start, U, far) - Z).max() < 1e-7
    for k, name in enumerate(tr.state_names):
        if name.endswith("'"):
            true = motion.nu[:, va12.coordinates.index(name[:-1])]
            assert np.abs(Z[:, -1, k] - np.interp(at[:, -1], motion.t, true)).max() < 2e-3


def test_softening_changes_nothing_but_standstill(va12: Model) -> None:
    softer = widen_transitions(va12, 10, 3)
    assert np.array_equal(softer.nominal, va12.nominal)
    q, u = np.zeros(6), np.array([500.0, 2000.0, 300.0])
    nu = np.array([1.0, 0.0, 0.0, 1.55, 0.3, 1.55])
    fast = [m.acceleration(q, nu, u, m.nominal).full() for m in (va12, softer)]
    assert np.abs(fast[0] - fast[1]).max() < 0.05 * np.abs(fast[0]).max()


def test_objective_slope_and_curvature() -> None:
    rng = np.random.default_rng(0)
    B = rng.normal(size=(9, 5))
    A = B.T @ B
    rows, columns = np.triu_indices(5)
    for name in objective.OBJECTIVES:
        here = objective.local_model(name, A, rows, columns, 6.0)
        d = rng.normal(size=len(rows)) * 1e-4
        step = np.zeros((5, 5))
        step[rows, columns] = d
        step = step + step.T - np.diag(np.diag(step))
        up, down = (objective.score_matrix(name, A + s * step, 6.0) for s in (1, -1))
        assert (up - down) / 2 == pytest.approx(here.slope @ d, rel=1e-5)
        assert ((here.factor.T @ d) ** 2).sum() >= 0.99 * (up + down - 2 * here.value)
    assert objective.score_matrix("cond", A) == pytest.approx(2 * np.log(np.linalg.cond(B)), rel=1e-5)


@pytest.mark.parametrize("shape", ["triangle", "leaning"])
def test_a_polygon_is_kept(straight: Model, shape: str) -> None:
    """Corners of a convex area, in either order; the straight line has to lie along its long side."""
    corners = {"triangle": ((0, 0), (14, 0), (0, 9)), "leaning": ((0, 0), (3, 9), (6, 9), (3, 0))}[shape]
    problem = shorter(straight, 12.0, lane_polygon_m=corners)
    drive = scale_torques(multisine(straight, problem, 3), 0.2)
    motion = simulate(straight, drive.sample(100.0))
    excess = {k: v for k, v in check_limits(straight, problem, motion).items() if k.startswith("lane edge")}
    x, y = motion.q[:, 0], np.zeros(len(motion.t))
    area = MplPath(np.array(corners, float))
    outside = [not area.contains_points(np.column_stack([x + s, y]), radius=1e-9).all() for s in (0.0, -3.2)]
    assert any(outside) == (max(excess.values()) > 0)


def test_placed_fits_a_path_into_a_polygon(va12: Model) -> None:
    problem = va12.machine.problems["R60"].model_copy(update={"lane_polygon_m": ((-9, -9), (20, -9), (-9, 9))})
    u = np.zeros((1501, 3))
    u[20:900, [0, 2]] = 450.0
    motion = simulate(va12, u, q0=np.array([5.0, 5.0, 2.0, 0, 0, 0]))
    assert max(v for k, v in check_limits(va12, problem, motion).items() if k.startswith("lane")) > 0.1
    again = simulate(va12, u, q0=place_on_lane(va12, problem, motion))
    assert max(v for k, v in check_limits(va12, problem, again).items() if k.startswith("lane")) == 0


def test_directions_fit_a_motion_best(straight: Model) -> None:
    t = np.arange(1201) / 100
    still = simulate(straight, np.zeros((1201, 2)))
    speed = np.sin(t) + 0.3 * np.sin(5 * t)
    motion = replace(still, nu=np.column_stack([speed, speed, speed]))
    for most in (0, 1, 2, 3):
        found = travel_directions(motion, most)
        assert set(np.unique(found)) <= {-1.0, 1.0}
        turns = int((np.diff(found) != 0).sum())
        assert turns <= most
        rng = np.random.default_rng(most)
        for _ in range(300):  # no other pattern does better
            cuts = np.sort(rng.integers(0, 1201, most))
            other = np.sign(rng.uniform(-1, 1)) * (-1.0) ** np.searchsorted(cuts, np.arange(1201), side="right")
            assert other @ speed <= found @ speed + 1e-9


def test_reversals_are_counted_where_it_moves(straight: Model) -> None:
    t = np.arange(1001) / 100
    still = simulate(straight, np.zeros((1001, 2)))
    wave = np.where(t < 5, 0.5 * np.sin(t), 0.01 * np.sin(20 * t))
    motion = replace(still, nu=np.column_stack([wave] * 3))
    assert count_reversals(motion) == 1
    over = check_limits(straight, shorter(straight, 10.0, reversals=0), motion)
    assert over["reversals"] == 1
    assert "reversals" not in check_limits(straight, shorter(straight, 10.0), motion)


@pytest.mark.parametrize("most", [0, 1])
def test_few_reversals_are_kept(straight: Model, most: int) -> None:
    problem = shorter(straight, 12.0, reversals=most)
    d = design(straight, problem, starts=1, seed=3)
    assert count_reversals(d.motion) <= most
    assert d.max_violation <= TOLERANCE
    assert d.violations["reversals"] == 0


def test_a_drive_to_start_from_is_not_made_worse(straight: Model, quick: Design) -> None:
    problem = shorter(straight, 12.0)
    again = design(straight, problem, starts=0, warm=[quick.manoeuvre])
    assert again.cond_phi <= quick.cond_phi * (1 + 1e-9)
    assert again.max_violation <= TOLERANCE
    with pytest.raises(ValueError, match="at least 1"):
        design(straight, problem, starts=0)


def test_workers_that_an_interruption_kills_are_no_error(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """They die of it until they listen to it themselves; dying of anything else is one."""
    pressed = True

    def dying(calls: Iterable[Any]) -> Iterator[Any]:
        if pressed:
            signal.raise_signal(signal.SIGINT)
        raise TerminatedWorkerError
        yield calls

    monkeypatch.setattr(joblib, "Parallel", lambda **_: dying)
    problem = straight.machine.problems["S40"]
    with pytest.raises(KeyboardInterrupt):
        design(straight, problem)
    pressed = False
    with pytest.raises(TerminatedWorkerError):
        design(straight, problem)
