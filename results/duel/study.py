"""Compare with what others use: the excitation of an arm, and the identification of a rig (see `identification`).

python results/duel/study.py [--seconds 60] [--runs 20] [--seed 0] [--out FOLDER] writes summary.json, table.md and
duel.png, by default into results/.duel: the published ones stay as they are. Needs the extra `duel`; a contender whose
package is missing is left out with a line that says so.

Excitation: SLSQP with finite differences, CMA-ES, and Opti with Ipopt. All get the same task: machine file, limits,
regressor, poses at both ends, start (the best of 200 random Fourier series), and the same processor time on one core.
All are judged alike: cond(Phi) and cond(W) on the samples of the machine file, and the largest excess over each limit
at twenty points per sample.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import casadi as ca
import identification
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import minimize

from excite import trajectories, workflows
from excite.reports import COLOURS, new_figure, save
from excite.simulation import inverse_dynamics
from excite.text import format_number
from excite.trajectories import JointMotion, MotionProgram, joint_motion, joint_search
from excite.trajectories.limits import end_poses, stack_limits

HERE = Path(__file__).parent
PENALTY = 100.0  # of CMA-ES, on the sum of excesses; chosen
CMA_STEP = 0.1  # first standard deviation of CMA-ES [rad]; chosen


class OutOfTimeError(Exception):
    """The processor time is spent."""


class Task:
    """The common task: program functions of the coefficients x (n_x,), and the judge of a result."""

    def __init__(self, machine: str, seconds: float, seed: int) -> None:
        self.model = workflows.build_model(machine, fit_sensor_effects=False)
        _, self.problem = workflows.choose_problem(self.model.machine, None, None)
        self.objective = trajectories.compose_objective(self.model, "cond")
        self.poses = end_poses(self.model, self.problem)
        self.smooth = joint_motion.with_smooth_friction(self.model)
        basis = joint_motion.BASES["fourier"](self.problem, *self.poses)
        self.program = MotionProgram(self.smooth, self.problem, self.objective, basis)
        self.start = joint_search.best_guess(
            self.program, joint_search.free_poses(self.model, self.problem), seed, lambda: False
        )
        self.seed = seed
        self.begin = time.process_time()
        self.seconds = seconds

    def spent(self) -> bool:
        return time.process_time() - self.begin > self.seconds

    def log_cond(self, x: np.ndarray) -> float:
        """Return log cond(Phi) of the program's samples."""
        e = np.linalg.eigvalsh(self.program.matrices(x)[0])
        return 0.5 * float(np.log(e[-1] / max(e[0], 1e-30)))

    def slack(self, x: np.ndarray) -> np.ndarray:
        """Return what is left of each limit (n_g,), negative where it is exceeded, as shares of half its range."""
        return np.asarray(1 - np.abs(self.program.limit_values(x)).max(axis=0))

    def judge(self, basis: str, x: np.ndarray) -> dict[str, Any]:
        """Return the figures that all contenders are judged by."""
        made = JointMotion(joint_motion.BASES[basis](self.problem, *self.poses), x.reshape(self.program.n_q, -1))
        motion = made.sample(self.model)
        over = joint_motion.all_violations(self.model, self.problem, made)
        worst = max(over, key=lambda n: over[n])
        return {
            "cond_phi": trajectories.cond_phi(self.model, motion),
            "cond_w": trajectories.cond_w(self.model, motion),
            "max_violation": over[worst],
            "worst_limit": worst if over[worst] > 0 else None,
        }


def own(task: Task, trajectory: str) -> tuple[str, np.ndarray]:
    *_, found = joint_search.search(task.model, task.problem, task.objective, trajectory, task.seed, task.spent)
    best = joint_search.keep_as_followed(task.model, task.problem, task.objective, found.best)
    return best.basis, best.coefficients


def slsqp(task: Task) -> tuple[str, np.ndarray]:
    """SLSQP of SciPy with finite differences, one inequality for each limit's largest value."""
    latest = [task.start]

    def timed(f: Callable[[np.ndarray], Any]) -> Any:
        def call(x: np.ndarray) -> Any:
            if task.spent():
                raise OutOfTimeError
            return f(x)

        return call

    def keep(x: np.ndarray) -> None:
        latest[0] = np.array(x)

    settings: dict[str, Any] = {
        "method": "SLSQP",
        "constraints": {"type": "ineq", "fun": timed(task.slack)},
        "callback": keep,
        "options": {"maxiter": 10000, "ftol": 1e-6},
    }
    try:
        done = minimize(timed(task.log_cond), task.start, **settings)
        return "fourier", done.x
    except OutOfTimeError:
        return "fourier", latest[0]


def cma_es(task: Task) -> tuple[str, np.ndarray]:
    """CMA-ES with a penalty on the sum of excesses; the best point that keeps the limits at the program's samples."""
    import cma

    best = [np.inf, task.start]
    search = cma.CMAEvolutionStrategy(task.start, CMA_STEP, {"seed": task.seed + 1, "verbose": -9})
    while not task.spent() and not search.stop():
        points = search.ask()
        values = []
        for x in points:
            value, over = task.log_cond(x), float(np.maximum(-task.slack(x), 0).sum())
            if over == 0 and value < best[0]:
                best[:] = [value, np.array(x)]
            values.append(value + PENALTY * over)
        search.tell(points, values)
    return "fourier", np.asarray(best[1])


def opti(task: Task) -> tuple[str, np.ndarray]:
    """CasADi's Opti with Ipopt, limited-memory Hessian, log tr A + log tr A^-1 as a smooth stand-in for cond."""
    model, program = task.smooth, task.program
    n_q, n_c, n_b = program.n_q, program.n_c, program.n_b
    q, nu, a = model.symbols()
    jerk = ca.SX.sym("j", n_q)
    W = ca.densify(model.regressor(q, nu, a)) @ ca.diag(ca.DM(task.objective.scale))
    information = ca.Function("information", [ca.vertcat(q, nu, a)], [W.T @ W])
    u = inverse_dynamics(model)(q, nu, a, model.nominal)
    du = ca.jtimes(u, ca.vertcat(q, nu, a), ca.vertcat(nu, a, jerk))
    values = stack_limits(model, program.limits)(q, nu, u, du)
    half = np.array([g.range / 2 if np.isfinite(g.low) else g.range for g in program.limits])
    centre = np.array([g.centre if np.isfinite(g.low) else 0.0 for g in program.limits])
    limits = ca.Function("limits", [ca.vertcat(q, nu, a, jerk)], [(values - centre) / half])

    def states(path: np.ndarray, B: np.ndarray, C: ca.MX) -> ca.MX:
        """Return q and its derivatives (orders n_q, N)."""
        return ca.vertcat(*[ca.DM(path[:, k].T) + C.T @ ca.DM(B[:, k].T) for k in range(path.shape[1])])

    problem = ca.Opti()
    C = problem.variable(n_c, n_q)  # column j: coefficients of joint j
    z = states(*program.samples, C)
    y = states(*program.limit_samples, C)
    A = information.map(z.shape[1])(z) @ ca.repmat(ca.DM.eye(n_b), z.shape[1], 1)
    inverse = ca.solve(A, ca.MX(ca.DM.eye(n_b)), "qr")
    problem.minimize(ca.log(ca.trace(A)) + ca.log(ca.trace(inverse)))
    g = limits.map(y.shape[1])(y)
    problem.subject_to(problem.bounded(-1 + joint_motion.FIRST_MARGIN, ca.vec(g), 1 - joint_motion.FIRST_MARGIN))
    first = task.start.reshape(n_q, n_c).T
    problem.set_initial(C, first)
    latest: list[Any] = [first]

    def watch(_: int) -> None:
        latest[0] = problem.debug.value(C)

    problem.callback(watch)
    options: dict[str, Any] = {
        "hessian_approximation": "limited-memory",
        "print_level": 0,
        "max_iter": 3000,
        "sb": "yes",
    }
    options["max_cpu_time"] = max(1.0, task.seconds - (time.process_time() - task.begin))
    problem.solver("ipopt", {"print_time": False}, options)
    try:
        found = problem.solve().value(C)
    except RuntimeError:  # out of time
        found = latest[0]
    return "fourier", np.asarray(found).reshape(n_c, n_q).T.ravel()


CONTENDERS: dict[str, tuple[Callable[[Task], tuple[str, np.ndarray]], str | None]] = {  # and the package that it needs
    "excite, Fourier series": (lambda task: own(task, "fourier"), None),
    "excite, free": (lambda task: own(task, "free"), None),
    "SLSQP, finite differences": (slsqp, None),
    "CMA-ES": (cma_es, "cma"),
    "Opti and Ipopt": (opti, None),
}


def contend(machine: str, seconds: float, seed: int, name: str) -> dict[str, Any]:
    """Let one contender solve the task and judge its result."""
    solve, package = CONTENDERS[name]
    if package is not None and find_spec(package) is None:
        return {"name": name, "missing": package}
    task = Task(machine, seconds, seed)
    start = task.judge("fourier", task.start)
    task.begin, wall = time.process_time(), time.perf_counter()
    basis, x = solve(task)
    spent = time.process_time() - task.begin
    return {
        "name": name,
        **task.judge(basis, x),
        "processor_s": spent,
        "wall_s": time.perf_counter() - wall,
        "start_cond_phi": start["cond_phi"],
        "coefficients": int(np.size(x)),
    }


def table(rows: list[dict[str, Any]]) -> str:
    lines = ["| contender | cond(Phi) | cond(W) | largest excess | processor time |", "|---|---|---|---|---|"]
    for r in rows:
        if "missing" in r:
            lines.append(f"| {r['name']} | package {r['missing']} is missing | | | |")
            continue
        over = (
            "none" if not r["worst_limit"] else f"{format_number(100 * r['max_violation'], 2)} % ({r['worst_limit']})"
        )
        lines.append(f"| {r['name']} | {r['cond_phi']:.2f} | {r['cond_w']:.1f} | {over} | {r['processor_s']:.0f} s |")
    return "\n".join(lines) + "\n"


def rig_table(rows: list[dict[str, Any]]) -> str:
    names = identification.NAMES
    lines = [
        f"| contender | RMSE of {', '.join(names)} [%] | 95 % intervals that hold | logs | failed | time per log |"
    ]
    lines.append("|---|---|---|---|---|---|")
    for r in rows:
        if "missing" in r:
            lines.append(f"| {r['name']} | package {r['missing']} is missing | | | | |")
            continue
        errors = ", ".join(f"{r['rmse_percent'][n]:.3f}" for n in names)
        held, seconds = f"{100 * r['coverage95']:.0f} %", f"{r['processor_s_per_log']:.1f} s"
        lines.append(f"| {r['name']} | {errors} | {held} | {r['runs']} | {r['failed']} | {seconds} |")
    return "\n".join(lines) + "\n"


def contender_versions() -> dict[str, str]:
    """Return the versions of the contenders' packages that are installed."""
    needed = [package for _, package in (*CONTENDERS.values(), *identification.CONTENDERS.values()) if package]
    return {package: version(package) for package in needed if find_spec(package) is not None}


def figure(rows: list[dict[str, Any]]) -> Figure:
    """Plot the condition numbers that the contenders reach, and by how much they exceed a limit."""
    shown = [r for r in rows if "missing" not in r][::-1]
    fig = new_figure(8, 3)
    ax = fig.subplots()
    over = [
        f"\nlimit exceeded by {format_number(100 * r['max_violation'], 2)} %" * bool(r["worst_limit"]) for r in shown
    ]
    ax.barh(range(len(shown)), [r["cond_phi"] for r in shown], color=["0.6" if o else COLOURS[0] for o in over])
    for k, r in enumerate(shown):
        ax.annotate(f" {r['cond_phi']:.2f}", (r["cond_phi"], k), va="center", fontsize=9)
    ax.set_yticks(range(len(shown)), [r["name"] + o for r, o in zip(shown, over, strict=True)], fontsize=9)
    ax.set_xlabel("cond(Phi) of the drive, lower is better")
    ax.set_xlim(0, 1.15 * max(r["cond_phi"] for r in shown))
    ax.spines[["top", "right"]].set_visible(False)
    return fig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machine", default="ur10")
    parser.add_argument("--seconds", type=float, default=60.0, help="processor time of each contender")
    parser.add_argument("--runs", type=int, default=20, help="logs of the rig to identify from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=list(CONTENDERS))
    parser.add_argument("--out", type=Path, default=HERE.parent / ".duel", help="folder that is written")
    parser.add_argument("--case", default=None, help="one contender, printed as JSON")
    options = parser.parse_args()
    if options.case is not None:
        print(json.dumps(contend(options.machine, options.seconds, options.seed, options.case)))
        return
    rows = []
    for name in options.only:
        own_options = ["--machine", options.machine, "--seconds", str(options.seconds), "--seed", str(options.seed)]
        command = [sys.executable, __file__, *own_options, "--case", name]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            raise SystemExit(f"{name} failed:\n{done.stderr}")
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(table(rows[-1:]).splitlines()[-1], flush=True)
    tables = identification.simulate_logs(options.runs, options.seed)
    rig = []
    for name in identification.CONTENDERS:
        rig.append(identification.contend(name, tables))
        print(rig_table(rig[-1:]).splitlines()[-1], flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    summary = {
        "command": "python results/duel/study.py --out results/duel",
        "machine": options.machine,
        "processor_s": options.seconds,
        "seed": options.seed,
        "excitation": rows,
        "identification": {"runs": options.runs, "contenders": rig},
        "versions": {**workflows.package_versions(), **contender_versions()},
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    (options.out / "table.md").write_text(table(rows) + "\n" + rig_table(rig), encoding="utf-8")
    save(figure(rows), options.out / "duel.png")


if __name__ == "__main__":
    main()
