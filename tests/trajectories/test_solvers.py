"""Two solvers of one program: exact derivatives, the same optimum, and plain words where there is none."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import scipy.sparse as sp

import excite
from excite.errors import SolverError, UsageError
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import simulate
from excite.trajectories import TOLERANCE, check_limits, collocation, compose_objective, interior_point, ipopt
from excite.trajectories.composite_objective import exact_derivatives, score_matrices
from excite.trajectories.continuation import LIMIT_MARGIN, STAGES, run_stages, start_from_multisine
from excite.trajectories.excitation import knot_times, multisine

RIG = Path(__file__).parents[1] / "support" / "rig.toml"


@pytest.fixture(scope="module")
def rig() -> Model:
    return excite.load(RIG)


def shorter(model: Model, seconds: float) -> Problem:
    problem = model.machine.problems["T10"]
    return problem.model_copy(update={"duration_s": problem.duration_s.model_copy(update={"value": seconds})})


def slopes(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float) -> np.ndarray:
    """Derivatives of a function by central differences, a column for each variable."""
    return np.stack([(f(x + h) - f(x - h)) / (2 * step) for h in step * np.eye(len(x))], axis=-1)


@pytest.mark.parametrize("name", ["cond", "D", "A", "E", "worst", "accuracy"])
@pytest.mark.parametrize("sigma_max", [None, 1.38])
def test_derivatives_of_every_objective(rig: Model, name: str, sigma_max: float | None) -> None:
    """Slope and curvature, the concave part as well, in the entries of the information; 1.38 % is just exceeded."""
    aim = compose_objective(rig, name, sigma_max)
    n = len(rig.scale)
    rows, columns = np.triu_indices(n)
    R = np.random.default_rng(1).normal(size=(2 * n, n))
    A = np.stack([R.T @ R * 1e4] * len(aim.row_weights))

    def matrices(x: np.ndarray) -> np.ndarray:
        full = np.zeros_like(A)
        full[:, rows, columns] = full[:, columns, rows] = x.reshape(len(A), -1)
        return full

    x = A[:, rows, columns].ravel()
    value, slope, hessian = exact_derivatives(aim, A, rows, columns, 6.0)
    assert value == pytest.approx(score_matrices(aim, A, 6.0), rel=1e-12)
    by_value = slopes(lambda x: np.array(score_matrices(aim, matrices(x), 6.0)), x, 0.1)
    by_slope = slopes(lambda x: exact_derivatives(aim, matrices(x), rows, columns, 6.0)[1], x, 0.1)
    np.testing.assert_allclose(slope, by_value, atol=1e-6 * np.abs(slope).max())
    np.testing.assert_allclose(hessian, by_slope, atol=1e-5 * np.abs(hessian).max())
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(hessian).max())


def program(model: Model, problem: Problem, name: str) -> tuple[ipopt.Program, Any]:
    """The program of a short drive, and what `ipopt.minimise` takes for it."""
    drive, aim, times = multisine(model, problem, 2), compose_objective(model, name), knot_times(problem)
    motion = simulate(model, drive.sample(100.0))
    sizes = dict.fromkeys((*model.coordinates, *(f"{c}'" for c in model.coordinates)), 0.1)
    tr = collocation.transcribe(model, problem, sizes, len(times) - 1, motion, weights=aim.row_weights)
    U, start = drive.torque / tr.torque_scale, np.zeros(tr.n_z)
    Z = collocation.solve_states(tr, start, U, np.zeros((tr.intervals, tr.nodes, tr.n_z)))
    K, J, n_g, n_c = tr.intervals, tr.nodes, len(tr.limit_names), len(tr.torque_limit_names)
    margins = np.full((K, J, n_g), LIMIT_MARGIN), np.full((K, n_c), 1e-4)
    task = interior_point.Subproblem(aim, *margins, np.zeros(n_g, bool))
    return ipopt.Program(tr, task, start, Z, U), (tr, task, start, Z, U)


def test_derivatives_of_the_program(rig: Model) -> None:
    p, _ = program(rig, shorter(rig, 1.0), "cond")
    p.sharpness = 5.0
    rng = np.random.default_rng(0)
    x, multipliers = p.first + 1e-3 * rng.normal(size=p.n_x), rng.normal(size=p.n_g)

    def matrix(values: np.ndarray, sparsity: Any) -> np.ndarray:
        return np.asarray(sp.csc_matrix((values, sparsity.row(), sparsity.colind()), sparsity.shape).todense())

    J = matrix(p.jacobian(x), p.jacobian_sparsity)
    upper = matrix(p.hessian(x, 1.3, multipliers), p.hessian_sparsity)
    H = upper + np.triu(upper, 1).T

    def lagrangian_slope(x: np.ndarray) -> np.ndarray:
        return 1.3 * p.gradient(x) + matrix(p.jacobian(x), p.jacobian_sparsity).T @ multipliers

    np.testing.assert_allclose(p.gradient(x), slopes(lambda x: np.array(p.value(x)), x, 1e-6), atol=1e-6)
    np.testing.assert_allclose(J, slopes(p.equations, x, 1e-6), atol=1e-7 * np.abs(J).max())
    np.testing.assert_allclose(H, slopes(lagrangian_slope, x, 1e-6), atol=1e-6 * np.abs(H).max())


@pytest.mark.slow
def test_both_solvers_find_the_same_optimum(rig: Model) -> None:
    """Two programs, two codes: lowest condition numbers within 0.1 %, limits kept in a fresh simulation of either."""
    make = partial(excite.design, rig, starts=1, cond_slack=0)
    own, other = make(), make(solver="ipopt")
    assert (own.solver, other.solver) == ("own", "ipopt")
    assert min(own.iterations, other.iterations) > 20
    assert other.cond_phi == pytest.approx(own.cond_phi, rel=1e-3)
    assert other.cond_phi < 0.7 * other.cond_phi_start
    assert not np.array_equal(other.manoeuvre.torque, own.manoeuvre.torque)
    assert other.max_violation <= TOLERANCE
    motion = simulate(rig, other.manoeuvre.sample(100.0), q0=other.motion.q[0])
    assert max(check_limits(rig, rig.machine.problems["T10"], motion).values()) <= TOLERANCE


def test_ipopt_finds_nothing_better_beside_the_own_optimum(rig: Model) -> None:
    """D has one optimum near a drive: Ipopt from the own solver's drive ends where it began."""
    problem = shorter(rig, 4.0)
    aim = compose_objective(rig, "D")
    begun = start_from_multisine(rig, problem, aim, 0, 5)
    own = run_stages(rig, problem, aim, begun, STAGES, lambda: False)
    again = run_stages(rig, problem, aim, replace(own, solver="ipopt"), STAGES[-1:], lambda: False)
    assert again.failure is None
    assert again.iterations > own.iterations
    assert again.latest.score == pytest.approx(own.latest.score, rel=1e-3)


def test_a_stopped_solve_returns_where_it_is(rig: Model) -> None:
    _, given = program(rig, shorter(rig, 2.0), "D")
    asked: list[int] = []
    levels = (interior_point.BarrierLevel(1.0, 1e-3, 0.0, 1), interior_point.BarrierLevel(2.0, 1e-3, 0.0, 1))
    found = ipopt.minimise(*given, levels, lambda: bool(asked.append(1) or len(asked) > 4))
    assert found.status == ipopt.STOPPED
    assert not found.converged
    assert len(asked) == 5


def test_without_an_optimum_there_is_no_design(rig: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ipopt may take 5 iterations only, and says so instead of giving the drive that it has by then."""

    def here(calls: Iterable[Any]) -> Iterator[Any]:
        return (f(*args, **kwargs) for f, args, kwargs in calls)

    monkeypatch.setattr(joblib, "Parallel", lambda **_: here)
    monkeypatch.setitem(ipopt.OPTIONS, "ipopt.max_iter", 5)
    with pytest.raises(SolverError, match=r"no optimum .* Maximum_Iterations_Exceeded after 5 iterations;") as e:
        excite.design(rig, starts=1, solver="ipopt")
    assert e.value.exit_code == 1
    assert "\n" not in str(e.value)


def test_an_unknown_solver_names_the_known_ones() -> None:
    with pytest.raises(UsageError, match="solver: newton is unknown, allowed: own, ipopt"):
        excite.design(RIG, solver="newton")


@pytest.mark.slow
def test_an_interrupted_solve_leaves_no_half_written_folder(tmp_path: Path) -> None:
    out = tmp_path / "design"
    command = [sys.executable, "-m", "excite", "design", "va12", "--solver", "ipopt", "--starts", "1"]
    with subprocess.Popen([*command, "--out", out], stderr=subprocess.PIPE, text=True) as run:
        time.sleep(6)  # in the first stage, no drive within the limits yet
        run.send_signal(signal.SIGINT)
        _, said = run.communicate(timeout=120)
    assert run.returncode == 130, said
    assert "nothing was written" in said
    assert list(tmp_path.iterdir()) == []
