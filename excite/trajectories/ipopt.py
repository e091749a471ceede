"""The program of one stage given to Ipopt: a second solver, for trust and for comparison.

Transcription, scaling, limits and margins are those of `interior_point`. The entries of the information matrices are
variables of their own, tied to the sums over the nodes by equations, so that the Hessian stays sparse apart from one
small block. All derivatives are exact. Limits of the lane are hard here.

Source: Waechter and Biegler, Mathematical Programming 106, 2006; CasADi's interface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from excite.trajectories import composite_objective
from excite.trajectories.collocation import NO_BOUND, Transcription
from excite.trajectories.interior_point import BarrierLevel, Subproblem

CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")  # statuses of Ipopt that are an optimum
STOPPED = "User_Requested_Stop"  # status after `should_stop`
OPTIONS: dict[str, Any] = {
    "print_time": False,
    "show_eval_warnings": False,  # a singular information matrix only shortens the step
    "no_nlp_grad": True,  # all derivatives are given
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.nlp_scaling_method": "none",  # variables, limits and equations are scaled to about one
    "ipopt.mu_strategy": "adaptive",
    "ipopt.max_iter": 500,  # of one solve; chosen
    "ipopt.tol": 1e-6,  # chosen
    "ipopt.acceptable_tol": 1e-5,  # chosen
    "ipopt.constr_viol_tol": 1e-8,  # chosen
    "ipopt.bound_relax_factor": 0.0,
}

WARM: dict[str, Any] = {  # from the optimum and multipliers of another sharpness
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_strategy": "monotone",
    "ipopt.mu_init": 1e-5,  # chosen
    "ipopt.warm_start_bound_push": 1e-8,
    "ipopt.warm_start_bound_frac": 1e-8,
    "ipopt.warm_start_slack_bound_push": 1e-8,
    "ipopt.warm_start_slack_bound_frac": 1e-8,
    "ipopt.warm_start_mult_bound_push": 1e-8,
}


@dataclass(frozen=True)
class Optimum:
    """The last iterate: start (n_z,), states Z (K, J, n_z), torques U (K + 1, n_u), scaled.

    value: objective. status: as Ipopt names it. iterations: of Ipopt, in all levels.
    """

    start: np.ndarray
    Z: np.ndarray
    U: np.ndarray
    value: float
    status: str
    iterations: int

    @property
    def converged(self) -> bool:
        return self.status in CONVERGED


class _Pattern:
    """Sum triplets at fixed places into the non-zeros of a CasADi matrix."""

    def __init__(self, shape: tuple[int, int], rows: np.ndarray, columns: np.ndarray) -> None:
        keys, self._place = np.unique(columns.astype(np.int64) * shape[0] + rows, return_inverse=True)
        self.size = len(keys)
        at_columns, at_rows = np.divmod(keys, shape[0])
        starts = np.searchsorted(at_columns, np.arange(shape[1] + 1))
        self.sparsity = ca.Sparsity(*shape, starts.tolist(), at_rows.tolist())

    def gather(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self._place, weights=values, minlength=self.size)


class _Evaluation(ca.Callback):  # type: ignore[misc]
    """A numeric function of vectors for CasADi, whose non-zeros are passed as NumPy arrays."""

    def __init__(
        self,
        name: str,
        inputs: Sequence[tuple[str, int]],
        outputs: Sequence[tuple[str, ca.Sparsity]],
        compute: Callable[..., Sequence[np.ndarray | float]],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._compute = inputs, outputs, compute
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._inputs[i][1], 1) if self._inputs[i][1] else ca.Sparsity(0, 0)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._outputs[i][1]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arg: Sequence[memoryview], res: Sequence[memoryview]) -> int:
        given = [np.frombuffer(a, float) if n else np.zeros(0) for a, (_, n) in zip(arg, self._inputs, strict=True)]
        for out, found in zip(res, self._compute(*given), strict=True):
            if out is not None:
                np.frombuffer(out, float)[:] = found
        return 0


class _Watch(ca.Callback):  # type: ignore[misc]
    """Ask `should_stop` after every iteration of Ipopt, and count them."""

    def __init__(self, n_x: int, n_g: int, should_stop: Callable[[], bool]) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": n_x, "f": 1, "g": n_g, "lam_x": n_x, "lam_g": n_g, "lam_p": 0}
        self._should_stop = should_stop
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return ca.nlpsol_out(i)

    def get_name_out(self, i: int) -> str:
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        return [int(self._should_stop())]


class Program:
    """One stage as a sparse nonlinear program in x = (start, Z, U, information entries), all of about one.

    Equations g: residuals of motion, limits at the nodes, limits on torques, information.
    """

    def __init__(self, tr: Transcription, task: Subproblem, start: np.ndarray, Z: np.ndarray, U: np.ndarray) -> None:
        if task.objective is None:
            raise ValueError("Ipopt needs an objective")
        self.tr, self.task, self.objective = tr, task, task.objective
        K, J, n_z, n_u, n_a = tr.intervals, tr.nodes, tr.n_z, tr.n_u, tr.n_a
        n_g, n_c = len(tr.limit_names), len(tr.torque_limit_names)
        _, _, entries = tr.values(tr.samples(start, Z, U), tr.map_values)
        total = tr.weight @ entries
        size = np.sqrt(np.maximum(tr.matrices(total)[:, range(tr.matrix_size), range(tr.matrix_size)], 1e-12))
        self.entry_size = (size[:, tr.rows] * size[:, tr.columns]).ravel()
        self.first = np.concatenate([start, Z.ravel(), U.ravel(), total / self.entry_size])
        self._ends = np.cumsum([n_z, K * J * n_z, (K + 1) * n_u, n_a])
        self.n_x = int(self._ends[-1])
        self.sizes = (K * J * n_z, K * J * n_g, K * n_c, n_a)
        self.n_g = sum(self.sizes)
        self.sharpness = 1.0

        # Variables of every interval, in order: left state, node states, left and right torque
        states = np.arange(n_z + K * J * n_z).reshape(-1, n_z)
        torques = self._ends[1] + np.arange((K + 1) * n_u).reshape(-1, n_u)
        k = np.arange(K)
        at = np.concatenate(
            [states[k * J], states[1:].reshape(K, J * n_z), torques[:-1], torques[1:]], axis=1
        )  # (K, n_y)
        n_y = at.shape[1]
        entries_at = self._ends[2] + np.arange(n_a)
        begins = np.cumsum([0, *self.sizes])

        def block(first: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
            """Rows and columns of dense blocks (K, rows, n_y), whose rows follow one another."""
            r = first + np.arange(K * rows).reshape(K, rows, 1)
            return np.broadcast_to(r, (K, rows, n_y)).ravel(), np.broadcast_to(at[:, None], (K, rows, n_y)).ravel()

        shared = begins[3] + np.broadcast_to(np.arange(n_a)[None, :, None], (K, n_a, n_y))
        parts = [
            block(int(begins[0]), J * n_z),
            block(int(begins[1]), J * n_g),
            block(int(begins[2]), n_c),
            (shared.ravel(), np.broadcast_to(at[:, None], (K, n_a, n_y)).ravel()),
            (begins[3] + np.arange(n_a), entries_at),
        ]
        self._jacobian = _Pattern((self.n_g, self.n_x), *(np.concatenate(x) for x in zip(*parts, strict=True)))
        self._upper = np.triu_indices(n_y)
        self._entry_upper = np.triu_indices(n_a)
        self._hessian = _Pattern(
            (self.n_x, self.n_x),
            np.concatenate([at[:, self._upper[0]].ravel(), entries_at[self._entry_upper[0]]]),
            np.concatenate([at[:, self._upper[1]].ravel(), entries_at[self._entry_upper[1]]]),
        )
        self._torque_rows = np.concatenate([np.zeros((n_c, n_z * (J + 1))), tr.torque_rows], axis=1)

    @property
    def jacobian_sparsity(self) -> ca.Sparsity:
        return self._jacobian.sparsity

    @property
    def hessian_sparsity(self) -> ca.Sparsity:
        return self._hessian.sparsity

    # -------------------------------------------------------------------------------------------- bounds

    def bounds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the bounds of x and g: (lower x, upper x, lower g, upper g)."""
        tr, task = self.tr, self.task
        low, high = np.full(self.n_x, -np.inf), np.full(self.n_x, np.inf)
        fixed = np.setdiff1d(np.arange(tr.n_z), tr.free_states)
        last = np.arange(self._ends[2] - tr.n_u, self._ends[2])
        first = np.arange(self._ends[1], self._ends[1] + tr.n_u)
        for held in (fixed, first, last):
            low[held] = high[held] = self.first[held]
        resting = self._ends[1] - tr.n_z + tr.rest_states
        low[resting], high[resting] = -tr.rest_band, tr.rest_band
        least = np.broadcast_to(tr.lower_bound, task.margin.shape)
        lower = np.where(least > -NO_BOUND, least + task.margin + task.below, -np.inf)
        upper = 1 - task.margin - task.above
        still, tied = np.zeros(self.sizes[0]), np.zeros(self.sizes[3])
        reach, middle = 1 - task.torque_margin, tr.torque_centre
        return (
            low,
            high,
            np.concatenate([still, lower.ravel(), (-reach - middle).ravel(), tied]),
            np.concatenate([still, upper.ravel(), (reach - middle).ravel(), tied]),
        )

    # -------------------------------------------------------------------------------------------- functions

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return start (n_z,), Z (K, J, n_z), U (K + 1, n_u) and the entries (n_a,) of the information."""
        tr = self.tr
        start, Z, U, entries = np.split(x, self._ends[:-1])
        shape = (tr.intervals, tr.nodes, tr.n_z)
        return start, Z.reshape(shape), U.reshape(-1, tr.n_u), entries * self.entry_size

    def value(self, x: np.ndarray) -> float:
        """Return the objective, NaN where the information is singular: Ipopt then takes a shorter step."""
        found = composite_objective.score_matrices(self.objective, self.tr.matrices(self.split(x)[3]), self.sharpness)
        return found if np.isfinite(found) else float("nan")

    def equations(self, x: np.ndarray) -> np.ndarray:
        tr = self.tr
        start, Z, U, _ = self.split(x)
        c, g, a = tr.values(tr.samples(start, Z, U), tr.map_values)
        torque = np.concatenate([U[:-1], U[1:]], axis=1) @ tr.torque_rows.T
        tied = (tr.weight @ a) / self.entry_size - x[self._ends[2] :]
        return np.concatenate([c.ravel(), g.ravel(), torque.ravel(), tied])

    def gradient(self, x: np.ndarray) -> np.ndarray:
        tr, found = self.tr, np.zeros(self.n_x)
        _, slope, _ = composite_objective.exact_derivatives(
            self.objective, tr.matrices(self.split(x)[3]), tr.rows, tr.columns, self.sharpness
        )
        found[self._ends[2] :] = slope * self.entry_size
        return found

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the non-zeros of the Jacobian of the equations."""
        tr = self.tr
        start, Z, U, _ = self.split(x)
        K, J = tr.intervals, tr.nodes
        *_, cs, gs, derivatives = tr.first_derivatives(tr.samples(start, Z, U), tr.map_values)
        motion, limits = tr.interval_slopes(cs), tr.interval_slopes(gs)
        counted = tr.entry_slopes(derivatives, np.diag(1 / self.entry_size)) * tr.weight[:, None, None]
        information = np.matmul(
            counted.reshape(K, J * tr.n_s, -1).transpose(0, 2, 1), tr.sample_map.reshape(J * tr.n_s, -1)
        )
        torque = np.broadcast_to(self._torque_rows, (K, *self._torque_rows.shape))
        return self._jacobian.gather(
            np.concatenate([x.ravel() for x in (motion, limits, torque, information, -np.ones(tr.n_a))])
        )

    def hessian(self, x: np.ndarray, factor: float, multipliers: np.ndarray) -> np.ndarray:
        """Return the non-zeros of the Lagrangian's Hessian on and above its diagonal."""
        tr = self.tr
        start, Z, U, entries = self.split(x)
        K, J, N = tr.intervals, tr.nodes, tr.intervals * tr.nodes
        motion, limits, _, tied = np.split(multipliers, np.cumsum(self.sizes)[:-1])
        by_node = [motion.reshape(N, -1), limits.reshape(N, -1), tr.weight[:, None] * (tied / self.entry_size)]
        (H,) = tr.lagrangian_hessian(tr.samples(start, Z, U), tr.map_values, np.concatenate(by_node, axis=1))
        L = tr.sample_map
        curved = np.matmul(H.reshape(K, J, tr.n_s, tr.n_s), L[None]).reshape(K, J * tr.n_s, -1)
        blocks = np.matmul(L.reshape(J * tr.n_s, -1).T, curved)
        _, _, of_entries = composite_objective.exact_derivatives(
            self.objective, tr.matrices(entries), tr.rows, tr.columns, self.sharpness
        )
        of_entries = factor * self.entry_size[:, None] * of_entries * self.entry_size
        return self._hessian.gather(np.concatenate([blocks[:, *self._upper].ravel(), of_entries[self._entry_upper]]))

    def solver(self, should_stop: Callable[[], bool], options: dict[str, Any]) -> tuple[ca.Function, list[Any]]:
        """Return the solver as a CasADi function, and what must live as long as it."""
        x, p, m = ("x", self.n_x), ("p", 0), ("lam_g", self.n_g)
        f, g = ("f", ca.Sparsity.dense(1, 1)), ("g", ca.Sparsity.dense(self.n_g, 1))
        program = _Evaluation("nlp", [x, p], [f, g], lambda x, p: (self.value(x), self.equations(x)))
        grad_f = _Evaluation(
            "nlp_grad_f",
            [x, p],
            [f, ("grad_f_x", ca.Sparsity.dense(self.n_x, 1))],
            lambda x, p: (self.value(x), self.gradient(x)),
        )
        jac_g = _Evaluation(
            "nlp_jac_g",
            [x, p],
            [g, ("jac_g_x", self.jacobian_sparsity)],
            lambda x, p: (self.equations(x), self.jacobian(x)),
        )
        hess_lag = _Evaluation(
            "nlp_hess_l",
            [x, p, ("lam_f", 1), m],
            [("triu_hess_gamma_x_x", self.hessian_sparsity)],
            lambda x, p, factor, multipliers: (self.hessian(x, float(factor[0]), multipliers),),
        )
        watch = _Watch(self.n_x, self.n_g, should_stop)
        every = (
            OPTIONS | options | {"grad_f": grad_f, "jac_g": jac_g, "hess_lag": hess_lag, "iteration_callback": watch}
        )
        return ca.nlpsol("ipopt", "ipopt", program, every), [program, grad_f, jac_g, hess_lag, watch]


def minimise(
    tr: Transcription,
    task: Subproblem,
    start: np.ndarray,
    Z: np.ndarray,
    U: np.ndarray,
    levels: Sequence[BarrierLevel],
    should_stop: Callable[[], bool] = lambda: False,
) -> Optimum:
    """Minimise a subproblem from start (n_z,), states Z (K, J, n_z) and torques U (K + 1, n_u) by Ipopt.

    levels: of each the sharpness counts, one solve each, from the optimum of the level before.
    should_stop() is asked after every iteration. A level without an optimum ends the solve; `status` tells.
    """
    program = Program(tr, task, start, Z, U)
    low, high, lower, upper = program.bounds()
    x, given, options = program.first, dict[str, Any](), dict[str, Any]()
    iterations, value, status = 0, float("nan"), ""
    for level in levels:
        program.sharpness = level.sharpness
        solve, _alive = program.solver(should_stop, options)
        found = solve(x0=x, lbx=low, ubx=high, lbg=lower, ubg=upper, **given)
        status, steps = solve.stats()["return_status"], solve.stats()["iter_count"]
        x, value, iterations = found["x"].full().ravel(), float(found["f"]), iterations + steps
        if status not in CONVERGED:
            break
        given, options = {"lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}, WARM
    start, Z, U, _ = program.split(x)
    return Optimum(start, Z, U, value, status, iterations)
