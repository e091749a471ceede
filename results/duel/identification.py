"""Identify a rig whose truth is known, by this program and by what others use.

Simulated logs of a mass on a slide (tests/support/rig.toml: M 95.1 kg, Fv 203.5 N s/m, Fc 20.4 N, offset -3.16 N),
10 s, with noise on the force (1 N) and the position. The others fit the position that a simulation under the measured
force gives (output error), in stretches of 5 s:

- SciPy: `least_squares`, initial states free, exact derivatives, intervals from the residuals.
- pyPESTO: the same simulation and least squares, intervals by profiles of the likelihood.
- mujoco.sysid: the rig in MJCF with `frictionloss`, the toolbox's optimiser and intervals; a stretch begins with the
  measured position and speed.

Fits of others begin 30 % above the truth, those of this program at the machine file's values. A contender whose package
is missing is left out.
"""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
from scipy.optimize import least_squares

import excite
from excite.errors import ExciteError

RIG = Path(__file__).parents[2] / "tests" / "support" / "rig.toml"
NAMES = ("M", "Fv", "Fc", "offset")
TRUTH = np.array([95.1, 203.5, 20.4, -3.16])
SMOOTHING = 0.001  # m/s, of sgn in the rig's friction
STRETCH = 500  # samples; 5 s
SUBSTEPS = 10  # of RK4 per sample
START = 1.3  # first guess over the truth
RANGE = 2.0  # bounds of mujoco.sysid and pyPESTO, which need some: the first guess divided and multiplied by it
STATE_SIZE = (0.01, 0.1)  # scale of the initial states [m, m/s]
PROFILE_STEP = 0.5  # first step of profiles, in standard deviations
MUJOCO_STEP = 0.001  # s
Z95 = 1.96

MJCF = f"""
<mujoco>
  <option timestep="{MUJOCO_STEP}" integrator="implicitfast"><flag contact="disable" gravity="disable"/></option>
  <worldbody>
    <body name="carriage">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="slide" type="slide" axis="1 0 0" solreffriction="{2 * MUJOCO_STEP} 1"/>
    </body>
  </worldbody>
  <actuator><general name="motor" joint="slide" gainprm="1" biastype="affine"/></actuator>
  <sensor><jointpos name="q" joint="slide"/></sensor>
</mujoco>"""

Interval = tuple[np.ndarray, np.ndarray, np.ndarray]  # estimate, lower and upper end (4,)


def drive(seconds: float = 10.0, rate: float = 100.0) -> np.ndarray:
    """Return the forces (N, 1) [N] of the drive: three sines."""
    t = np.arange(round(seconds * rate) + 1) / rate
    fade = np.clip(t / 0.5, 0, 1)
    u = 70 * np.sin(2 * np.pi * 0.7 * t) + 40 * np.sin(2 * np.pi * 1.3 * t + 1) + 25 * np.sin(2 * np.pi * 2.9 * t)
    return (fade * u)[:, None]


class OutputError:
    """Positions of a log simulated in stretches, and their derivatives by x = (M, Fv, Fc, u0, states at each start).

    first, size (n_x,): first guess, and scale of x. seen (n_stretches, STRETCH): measured positions [m].
    """

    def __init__(self, table: pd.DataFrame) -> None:
        t, q, u = (table[c].to_numpy() for c in ("t_s", "q_m", "u_N"))
        step = float(np.median(np.diff(t)))
        begins = np.arange(0, len(t) - STRETCH, STRETCH)
        self.forces = [np.array([u[b : b + STRETCH], u[b + 1 : b + STRETCH + 1]]) for b in begins]
        self.seen = np.stack([q[b + 1 : b + STRETCH + 1] for b in begins])
        speed = np.gradient(q, t)
        states = [(q[b], speed[b]) for b in begins]
        self.first = np.concatenate([START * TRUTH, *states])
        self.size = np.concatenate([np.abs(TRUTH), *[STATE_SIZE] * len(begins)])
        sample = one_sample(step)
        self.path = sample[0].mapaccum(STRETCH)
        self.slopes_along = sample[1].mapaccum(STRETCH)

    def errors(self, x: np.ndarray) -> np.ndarray:
        """Return simulated less measured positions [m]."""
        return np.concatenate([self._path(x, k)[:, 0] for k in range(len(self.seen))]) - self.seen.ravel()

    def _path(self, x: np.ndarray, k: int) -> np.ndarray:
        """Return position and speed (STRETCH, 2) along a stretch."""
        return np.asarray(self.path(x[4 + 2 * k : 6 + 2 * k], self.forces[k], self._repeated(x)).full().T)

    def _repeated(self, x: np.ndarray) -> ca.DM:
        return ca.repmat(ca.DM(x[:4]), 1, STRETCH)

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives of `errors` by x / size."""
        found = np.zeros((*self.seen.shape, len(x)))
        for k, u in enumerate(self.forces):
            at = slice(4 + 2 * k, 6 + 2 * k)
            first = np.hstack([np.zeros((2, 4)), np.eye(2)])
            along = np.vstack([x[at], self._path(x, k)[:-1]]).T
            steps = self.slopes_along(first, along, u, self._repeated(x)).full()[0].reshape(STRETCH, 6)
            found[k][:, [0, 1, 2, 3, at.start, at.start + 1]] = steps
        return found.reshape(-1, len(x)) * self.size


def one_sample(step: float) -> tuple[ca.Function, ca.Function]:
    """Build RK4 over one sample, and its derivatives.

    Position and speed (2,), force at both ends (2,), parameters (4,) -> position and speed at the end. Derivatives by
    parameters and start (2, 6), then the same arguments -> derivatives at the end.
    """
    p, x, u, S = ca.SX.sym("p", 4), ca.SX.sym("x", 2), ca.SX.sym("u", 2), ca.SX.sym("S", 2, 6)
    M, Fv, Fs, u0 = ca.vertsplit(p)
    h, y = step / SUBSTEPS, x

    def rate(share: float, y: ca.SX) -> ca.SX:
        force = u[0] + (u[1] - u[0]) * share / SUBSTEPS - u0
        return ca.vertcat(y[1], (force - Fv * y[1] - Fs * ca.tanh(y[1] / SMOOTHING)) / M)

    for s in range(SUBSTEPS):
        k1 = rate(s, y)
        k2 = rate(s + 0.5, y + h / 2 * k1)
        k3 = rate(s + 0.5, y + h / 2 * k2)
        k4 = rate(s + 1, y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    through = ca.jacobian(y, x) @ S + ca.horzcat(ca.jacobian(y, p), ca.SX(2, 2))
    return (
        ca.Function("sample", [x, u, p], [y], {"cse": True}),
        ca.Function("slopes", [S, x, u, p], [through], {"cse": True}),
    )


def scipy_output_error(table: pd.DataFrame) -> Interval:
    """Fit with SciPy, intervals from the residuals."""
    fit = OutputError(table)
    done = least_squares(
        lambda x: fit.errors(x * fit.size) * 1e4,
        fit.first / fit.size,
        jac=lambda x: fit.slopes(x * fit.size) * 1e4,
        max_nfev=60,
    )
    variance = 2 * done.cost / (len(done.fun) - len(done.x))
    std = np.sqrt(np.diag(np.linalg.inv(done.jac.T @ done.jac)) * variance)
    x, half = (done.x * fit.size)[:4], (Z95 * std * fit.size)[:4]
    return x, x - half, x + half


def pypesto_profiles(table: pd.DataFrame) -> Interval:
    """Fit by pyPESTO's trust-region least squares, then profile each parameter with the noise that the fit leaves."""
    import pypesto
    from pypesto import optimize, profile

    logging.getLogger("pypesto").setLevel(logging.ERROR)
    fit = OutputError(table)
    search = optimize.ScipyOptimizer("ls_trf", options={"max_nfev": 200})
    margin = np.concatenate([(RANGE - 1) * np.abs(fit.first[:4]), 0 * fit.first[4:]]) + fit.size

    def pose(guess: np.ndarray, unit: np.ndarray, noise: float) -> pypesto.Problem:
        """Return the problem in x / unit, its residuals over the noise."""

        def residuals(z: np.ndarray) -> np.ndarray:
            return fit.errors(z * unit) / noise

        def slopes(z: np.ndarray) -> np.ndarray:
            return fit.slopes(z * unit) * (unit / fit.size / noise)

        objective = pypesto.Objective(
            fun=lambda z: 0.5 * float(np.sum(residuals(z) ** 2)),
            grad=lambda z: residuals(z) @ slopes(z),
            res=residuals,
            sres=slopes,
        )
        low, high = (fit.first - margin) / unit, (fit.first + margin) / unit
        return pypesto.Problem(objective, lb=low, ub=high, x_guesses=[guess / unit])

    def solve(problem: pypesto.Problem) -> pypesto.Result:
        return optimize.minimize(problem, optimizer=search, n_starts=1, progress_bar=False)

    best = solve(pose(fit.first, fit.size, 1e-4)).optimize_result[0].x * fit.size
    error, slope = fit.errors(best), fit.slopes(best)
    noise = float(np.sqrt(error @ error / (len(error) - len(best))))
    std = noise * np.sqrt(np.diag(np.linalg.inv(slope.T @ slope))) * fit.size
    problem = pose(best, std, noise)
    options = profile.ProfileOptions(
        default_step_size_absolute=PROFILE_STEP,
        min_step_size_absolute=PROFILE_STEP / 10,
        max_step_size_absolute=2 * PROFILE_STEP,
        default_step_size_relative=0,
        step_size_precheck_mode="off",
    )
    result = profile.parameter_profile(
        problem, solve(problem), search, profile_index=np.arange(4), profile_options=options, progress_bar=False
    )
    ratio = profile.chi2_quantile_to_ratio(0.95)
    found = result.profile_result.list[0][:4]
    ends = [
        profile.calculate_approximate_ci(p.x_path[k], np.exp(p.fval_path.min() - p.fval_path), ratio)
        for k, p in enumerate(found)
    ]
    low, high = np.array(ends).T * std[:4]
    return result.optimize_result[0].x[:4] * std[:4], low, high


def mujoco_sysid(table: pd.DataFrame) -> Interval:
    """Fit with `mujoco.sysid.optimize` and its intervals."""
    import mujoco
    from mujoco import sysid

    t, q, u = (table[c].to_numpy() for c in ("t_s", "q_m", "u_N"))
    spec = mujoco.MjSpec.from_string(MJCF)

    def offset(spec: Any, value: float) -> None:
        spec.actuator("motor").biasprm[0] = -value

    setters = {
        "M": lambda spec, v: setattr(spec.body("carriage"), "mass", v),
        "Fv": lambda spec, v: spec.joint("slide").damping.__setitem__(0, v),
        "Fc": lambda spec, v: setattr(spec.joint("slide"), "frictionloss", v),
        "offset": offset,
    }
    parameters = sysid.ParameterDict()
    for name, value in zip(NAMES, START * TRUTH, strict=True):
        low, high = sorted((value / RANGE, value * RANGE))
        modify = lambda spec, p, to=setters[name]: to(spec, float(p.value[0]))  # noqa: E731
        parameters.add(sysid.Parameter(name, value, min_value=low, max_value=high, modifier=modify))
    model = spec.compile()
    speed = np.gradient(q, t)
    names, states, forces, seen = [], [], [], []
    for b in range(0, len(t) - STRETCH, STRETCH):
        part = slice(b, b + STRETCH + 1)
        names.append(f"from {b}")
        states.append(sysid.create_initial_state(model, q[b : b + 1], speed[b : b + 1], np.zeros(0)))
        forces.append(sysid.TimeSeries(t[part] - t[b], u[part, None]))
        seen.append(sysid.TimeSeries.from_names(t[part] - t[b], q[part, None], model))
    log = sysid.ModelSequences("rig", spec, names, states, forces, seen)
    residuals = sysid.build_residual_fn(models_sequences=[log], n_threads=1)
    best, done = sysid.optimize(parameters, residuals, verbose=False, output=io.StringIO())
    left = [r.ravel() for r in residuals(done.x, best)[0]]
    half = sysid.calculate_intervals(left, done.jac)[1]
    return done.x, done.x - half, done.x + half


def own(method: str) -> Callable[[pd.DataFrame], Interval]:
    """Return the contender of this program: a method of `excite.identify`."""

    def fit(table: pd.DataFrame) -> Interval:
        found = excite.identify(str(RIG), table, method=method)
        order = [found.names.index(n) for n in NAMES]
        low, high = found.interval95[:, order]
        return found.value[order], low, high

    return fit


CONTENDERS: dict[str, tuple[Callable[[pd.DataFrame], Interval], str | None]] = {  # and the package that it needs
    **{f"excite, {method}": (own(method), None) for method in ("joint", "ols")},
    "SciPy output error": (scipy_output_error, None),
    "pyPESTO": (pypesto_profiles, "pypesto"),
    "mujoco.sysid": (mujoco_sysid, "mujoco"),
}


MOST_LOGS = {"pyPESTO": 5}  # of slow contenders


def simulate_logs(runs: int, seed: int) -> list[pd.DataFrame]:
    return [excite.simulate(str(RIG), drive(), seed=seed + k) for k in range(runs)]


def contend(name: str, logs: list[pd.DataFrame]) -> dict[str, Any]:
    """Return a contender's RMSE [%] of every parameter, coverage of the 95 % intervals and time per log.

    A contender whose package is missing gets the package's name only.
    """
    fit, package = CONTENDERS[name]
    logs = logs[: MOST_LOGS.get(name)]
    if package is not None and find_spec(package) is None:
        return {"name": name, "missing": package}
    found, begin = [], time.process_time()
    for log in logs:
        try:
            found.append(fit(log))
        except ExciteError:
            continue
    spent = time.process_time() - begin
    value, low, high = (np.array(v) for v in zip(*found, strict=True))
    off = (value / TRUTH - 1) * 100
    return {
        "name": name,
        "rmse_percent": dict(zip(NAMES, np.sqrt(np.mean(off**2, axis=0)).tolist(), strict=True)),
        "coverage95": float(np.mean((low <= TRUTH) & (high >= TRUTH))),
        "runs": len(logs),
        "failed": len(logs) - len(found),
        "processor_s_per_log": spent / len(logs),
    }
