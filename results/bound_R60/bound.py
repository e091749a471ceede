"""Lower bound on cond(Phi) of every drive, from mixtures of pointwise feasible states.

A drive within the limits distributes its samples over states that each keep the limits and the equations of motion. Its
information matrix is a mixture of the matrices A(s) of such states, and E[d phi / dt] = 0 for every function phi of the
state if it returns to its start (occupation measures; Lasserre et al., 2008). Relaxing to all such mixtures, with phi
the polynomials up to a degree, gives a semidefinite program:

    min t   with   I <= sum_k w_k A_k <= t I,   sum_k w_k d phi_j / dt (s_k) = 0,   w >= 0,   cond >= sqrt(t).

The dual is a certificate: U, V >= 0 with tr V = 1 and multipliers m such that <U - V, A(s)> <= m' d phi / dt (s) in
every state s prove t >= tr U. Column generation starts from the states of a drive and adds the largest violations. If
<U - V, A> - m' d phi / dt <= e <a (U + V) + b I, A> everywhere, the certificate (1 - e a) U, (1 + e a) V + e b I holds
exactly, so that t >= tr U (1 - e a) / (1 + e a + e b n). Violations e use a = 1 / (2 tr U), b = 1 / tr sum_k w_k A_k;
the term with b keeps the measure positive at states in which <U + V, A> vanishes.

Assumptions: the search for violations is local (samples of drives, random states around them, an interior-point search
from the worst), so e is the largest violation found and the bound is numerical, not a proof. Parameters are nominal.
Lane, torque rates, duration and knots are not used, so the relaxation may lie well below any drive. Samples of a motion
meet E[d phi / dt] = 0 up to O(sample / duration) and the tolerances of rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion
from excite.trajectories import limits

FIRST_STRIDE = 40  # samples between the first states of a drive; chosen
WORST_SAMPLES = 100  # samples of the drives with the largest violation, searched around in every round; chosen
LAST_STRIDE = 100  # samples between the states of a drive that the last search starts from; chosen
LIMIT_TOLERANCE = 1e-6  # of a limit's range: accepted excess of a state; chosen
SEARCH_RADIUS = (3e-3, 0.5)  # half ranges, standard deviation of random states, log-uniform between; chosen
THOROUGH_FACTOR = 3  # effort of a thorough search over a normal one; chosen
KEPT_SLACK = 0.5  # violation below zero down to which states are kept; chosen
MAX_STATES = 500  # states kept from round to round; chosen
# Price of remaining drift, in t; chosen. It lets the first mixtures drift and bounds the multipliers, so that they do
# not jump between rounds (stabilised column generation, du Merle et al., 1999). A certificate with bounded multipliers
# is valid, and a mixture counts once its drift is zero.
DRIFT_PRICE = 300.0
ZERO_DRIFT = 1e-5  # drift that counts as zero, as a share of the largest; chosen


@dataclass(frozen=True)
class Certificate:
    """U, V (n, n), multipliers m (n_phi,): <U - V, A> <= m' d phi / dt. a, b: the measure of violations."""

    U: np.ndarray
    V: np.ndarray
    m: np.ndarray
    a: float
    b: float

    @property
    def gauge(self) -> np.ndarray:
        return np.asarray(self.a * (self.U + self.V) + self.b * np.eye(len(self.U)))

    def proven_bound(self, e: float) -> float:
        """Return the t that is proven if no state violates the certificate by more than e."""
        return float(np.trace(self.U)) * max(0.0, 1 - e * self.a) / (1 + e * (self.a + self.b * len(self.U)))


@dataclass(frozen=True)
class Bound:
    """Lower bound on cond(Phi).

    mixture: cond of the best mixture of the states found, an upper bound on the relaxation's optimum. certified: the
    bound, from the best certificate and its largest violation found, `violation`. states: in the last mixture. rounds:
    of column generation. degree: of the polynomials.
    """

    mixture: float
    certified: float
    violation: float
    states: int
    rounds: int
    degree: int
    certificate: Certificate | None = field(default=None, compare=False, repr=False)


Progress = Callable[[Bound], bool | None]


@dataclass(frozen=True)
class _StateSpace:
    """Pointwise feasible states z (n_z,), scaled to about one: positions that forces depend on, speeds, torques.

    sample: z to Phi' (n, n_rows), d phi / dt (n_phi,) and limits (n_g,) between low and high. polish: the local search.
    """

    core: tuple[int, ...]
    size: np.ndarray
    n: int
    torques: int
    sample: ca.Function
    low: np.ndarray
    high: np.ndarray
    polish: ca.Function

    def columns(self, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate states (n_z, n_k).

        Returns Phi (n_k, n_rows, n), d phi / dt (n_k, n_phi) and True where the limits hold (n_k,).
        """
        if not Z.shape[1]:  # CasADi would treat it as a scalar
            n, rows = self.sample.size_out(0)
            return np.zeros((0, rows, n)), np.zeros((0, self.sample.size1_out(1))), np.zeros(0, bool)
        phi, drift, g = (x.full() for x in self.sample(Z))
        inside = ((g >= self.low[:, None] - LIMIT_TOLERANCE) & (g <= self.high[:, None] + LIMIT_TOLERANCE)).all(axis=0)
        Phi = phi.reshape(self.n, Z.shape[1], -1).transpose(1, 2, 0)
        return Phi, drift.T.reshape(Z.shape[1], -1), inside & np.isfinite(Phi).all(axis=(1, 2))


def bound(
    model: Model,
    problem: Problem,
    motions: Sequence[Motion],
    degree: int = 2,
    rounds: int = 60,
    population: int = 20_000,
    polished: int = 12,
    seed: int = 0,
    gap: float = 0.02,
    progress: Progress | None = None,
) -> Bound:
    """Compute a lower bound on cond(Phi) of every drive of a problem.

    motions: drives within the limits, to start from.
    degree: of the polynomials phi; 0 allows any mixture of states.
    rounds, gap: the search ends after `rounds`, or when the bound is within `gap` of the mixture in a thorough search.
    population, polished: states tried per round, and those of them improved locally.
    progress(bound so far): return True to make this round the last.

    Raises ValueError if the motions nowhere keep the limits, RuntimeError if the semidefinite program fails.
    """
    states = _state_space(model, problem, degree)
    rng = np.random.default_rng(seed)
    Z, given = _feasible_samples(states, motions, FIRST_STRIDE), _feasible_samples(states, motions, 1)
    given_Phi, given_drift, _ = states.columns(given)
    if not Z.shape[1]:
        raise ValueError(
            "the drives to start from keep the limits nowhere: give one that was designed for this problem"
        )
    found = Bound(np.inf, 0.0, np.inf, Z.shape[1], 0, degree)
    proofs: list[tuple[Certificate, float]] = []
    effort = 1
    for k in range(1, rounds + 1):
        Phi, drift, _ = states.columns(Z)
        t, w, certificate = _best_mixture(np.einsum("kri,krj->kij", Phi, Phi), drift)
        # Drives lie on the thin manifold of slips in equilibrium, which random states leave at once.
        off = np.argsort(-_violation(given_Phi, given_drift, certificate))[:WORST_SAMPLES]
        around = np.hstack([Z, given[:, off]])
        fresh, worst = _search_violations(states, certificate, around, effort * population, effort * polished, rng)
        # States found against one certificate count against all
        new_Phi, new_drift, _ = states.columns(fresh)
        proofs = [(x, float(_violation(new_Phi, new_drift, x).max(initial=e))) for x, e in proofs]
        proofs.append((certificate, worst))
        found = replace(
            found,
            mixture=min(found.mixture, float(np.sqrt(t))),
            certified=max(float(np.sqrt(x.proven_bound(e))) for x, e in proofs),
            violation=worst,
            states=int((w > 1e-6 * w.max()).sum()),
            rounds=k,
        )
        enough = progress is not None and progress(found)
        if found.certified > (1 - gap) * found.mixture or not fresh.shape[1]:
            enough = enough or effort > 1
            effort = THOROUGH_FACTOR  # the gap must close for a thorough search too
        if enough:
            break
        e = np.where(w > 1e-9 * w.max(), np.inf, _violation(Phi, drift, certificate))
        best = np.argsort(-e)[:MAX_STATES]
        Z = np.hstack([Z[:, best[e[best] > -KEPT_SLACK]], fresh])
    around = np.hstack([Z, given[:, ::LAST_STRIDE]])
    certificate, violation = _confirm(
        states, proofs, around, THOROUGH_FACTOR * population, THOROUGH_FACTOR * polished, rng
    )
    certified = float(np.sqrt(certificate.proven_bound(violation)))
    return replace(found, certified=certified, violation=violation, certificate=certificate)


def _feasible_samples(states: _StateSpace, motions: Sequence[Motion], stride: int) -> np.ndarray:
    """Return the states (n_z, n_k) of motions and their mirror images that keep the limits."""
    every = [np.hstack([m.q[::stride, list(states.core)], m.nu[::stride], m.u[::stride]]) for m in motions]
    Z = (np.vstack(every) / states.size).T
    return _kept_limits(states, np.hstack([Z, -Z]))


def _confirm(
    states: _StateSpace,
    proofs: list[tuple[Certificate, float]],
    Z: np.ndarray,
    population: int,
    polished: int,
    rng: np.random.Generator,
) -> tuple[Certificate, float]:
    """Search thoroughly against the best certificates; return the one that proves most, and its violation.

    The apparently best certificate is the one most likely to have an overlooked violation.
    """
    left, looked = list(proofs), list[tuple[float, float, Certificate]]()
    while left and len(looked) < 5:
        k = int(np.argmax([x.proven_bound(e) for x, e in left]))
        x, e = left.pop(k)
        if looked and x.proven_bound(e) <= max(t for t, *_ in looked):
            break
        e = max(e, _search_violations(states, x, Z, population, polished, rng)[1])
        looked.append((x.proven_bound(e), e, x))
    _, e, best = max(looked, key=lambda found: found[0])
    return best, e


def _state_space(model: Model, problem: Problem, degree: int) -> _StateSpace:
    machine, n_q = model.machine, len(model.coordinates)
    core = tuple(k for k, c in enumerate(model.coordinates) if c in model.active_coordinates)
    owner = {c: b for b in machine.body for c in b.coordinates}
    at_most = []
    for c in model.coordinates:
        most, contact = owner[c].limit, owner[c].contact
        speed = float(most.rate) if most.rate is not None else 2.5
        if most.rim_speed is not None and contact is not None:
            speed = float(most.rim_speed) / float(contact.radius)
        at_most.append(speed)
    size = [owner[model.coordinates[k]].limit.reach or 1.0 for k in core] + at_most
    size += [float(b.limit.torque) if b.limit.torque is not None else 1e4 for b in machine.actuated]
    z = ca.SX.sym("z", len(size))
    n_x = len(core) + n_q
    q, whole = ca.SX(n_q, 1), z * ca.DM(size)
    for i, k in enumerate(core):
        q[k] = whole[i]
    nu, u = whole[len(core) : n_x], whole[n_x:]
    a = model.accelerate(q, nu, u, ca.DM(model.nominal))
    flow = ca.vertcat(*[model.kinematics(q, nu)[0][k] for k in core], a) / ca.DM(size[:n_x])
    x = ca.SX.sym("x", n_x)
    monomials = [
        _product([x[i] for i in chosen])
        for d in range(1, degree + 1)
        for chosen in combinations_with_replacement(range(n_x), d)
    ]
    slope = ca.Function("slope", [x], [ca.jacobian(ca.vertcat(*monomials, ca.SX(0, 1)), x)])
    drift = slope(z[:n_x]) @ flow
    phi = model.regressor(q, nu, a) @ ca.diag(ca.DM(model.scale))
    kept = [
        g for g in limits.machine_limits(model, problem) if not limits.is_lane_limit(g.name) and g.kind != "torque_rate"
    ]
    g = ca.vertcat(*[k.expression(q, nu, u, ca.SX(len(model.inputs), 1)) / k.range for k in kept])
    low, high = np.array([k.low / k.range for k in kept]), np.array([k.high / k.range for k in kept])

    n = phi.shape[1]
    G, B, m = ca.SX.sym("G", n, n), ca.SX.sym("B", n, n), ca.SX.sym("m", drift.numel())
    gain, gauge = (ca.sum1(ca.sum2((phi @ X) * phi)) for X in (G, B))
    search = {"x": z, "p": ca.vertcat(ca.vec(G), ca.vec(B), m), "f": -(gain - ca.dot(m, drift)) / gauge, "g": g}
    quiet: dict[str, Any] = {
        "print_level": 0,
        "sb": "yes",
        "max_iter": 60,
        "tol": 1e-5,
        "hessian_approximation": "limited-memory",
    }
    polish = ca.nlpsol("polish", "ipopt", search, {"print_time": False, "error_on_fail": False, "ipopt": quiet})
    sample = ca.Function("sample", [z], [phi.T, drift, g], {"cse": True})
    return _StateSpace(core, np.array(size), n, len(model.inputs), sample, low, high, polish)


def _product(factors: list[ca.SX]) -> ca.SX:
    out = factors[0]
    for f in factors[1:]:
        out = out * f
    return out


def _kept_limits(states: _StateSpace, Z: np.ndarray) -> np.ndarray:
    return Z[:, states.columns(Z)[2]]


def _best_mixture(A: np.ndarray, c: np.ndarray) -> tuple[float, np.ndarray, Certificate]:
    """Solve the semidefinite program over information matrices (n_k, n, n) with drifts (n_k, n_phi).

    Returns t (inf if drift remains), weights (n_k,) and the certificate. Matrices are scaled to trace one and drifts to
    one; the interior-point solver stalls otherwise.
    """
    n, n_phi = A.shape[1], c.shape[1]
    scale = 1.0 / np.einsum("kii->k", A)
    w, t = cp.Variable(len(A), nonneg=True), cp.Variable()
    total = cp.reshape((A * scale[:, None, None]).reshape(len(A), -1).T @ w, (n, n), order="C")
    low, high = total >> np.eye(n), t * np.eye(n) >> total
    drift = c * scale[:, None]
    spread = np.maximum(np.abs(drift).max(axis=0, initial=0.0), 1e-12)
    left = cp.Variable(n_phi) if n_phi else cp.Constant(np.zeros(1))
    still = [(drift / spread).T @ w == left] if n_phi else []
    problem = cp.Problem(cp.Minimize(t + DRIFT_PRICE * cp.norm1(left)), [low, high, *still])
    problem.solve(solver=cp.CLARABEL)
    if w.value is None or problem.status not in ("optimal", "optimal_inaccurate"):
        raise RuntimeError(
            f"the semidefinite program over {len(A)} states failed ({problem.status}): start from another or a longer"
            " drive, or take a lower degree"
        )
    U, V = _psd(low.dual_value), _psd(high.dual_value)
    m = np.asarray(still[0].dual_value).ravel() / spread if still else np.zeros(n_phi)
    trace = float(np.trace(V))
    a, b = trace / (2 * float(np.trace(U))), 1 / float(np.sum(w.value))
    both = [Certificate(U / trace, V / trace, sign * m / trace, a, b) for sign in (1, -1)]
    # The sign of an equality's multiplier is the solver's convention: take the one that holds on these columns
    over = [(np.einsum("kij,ij->k", A, x.U - x.V) - c @ x.m).max() for x in both]
    chosen = both[int(np.argmin(over))]
    reached = float(t.value) if np.abs(left.value).max() < ZERO_DRIFT * float(np.sum(w.value)) else np.inf
    return reached, np.maximum(w.value, 0) * scale, chosen


def _psd(matrix: np.ndarray) -> np.ndarray:
    e, Q = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((Q * np.maximum(e, 0)) @ Q.T)


def _violation(Phi: np.ndarray, drift: np.ndarray, x: Certificate) -> np.ndarray:
    """Return (<U - V, A> - m' d phi / dt) / <a (U + V) + b I, A> (n_k,)."""
    gain, gauge = (np.einsum("kri,kri->k", Phi @ M, Phi) for M in (x.U - x.V, x.gauge))
    return np.asarray((gain - drift @ x.m) / gauge)


def _search_violations(
    states: _StateSpace, x: Certificate, Z: np.ndarray, population: int, polished: int, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """Search for states (n_z, n_new) that violate a certificate; return them and the largest violation.

    Two random generations, the second around the worst of the first; the worst distinct states are improved locally.
    """
    known, e = Z, np.zeros(Z.shape[1])
    for _ in range(2):
        centres = known[:, rng.integers(known.shape[1], size=population)]
        low, high = np.log(SEARCH_RADIUS)
        trial = centres + np.exp(rng.uniform(low, high, population)) * rng.standard_normal(centres.shape)
        anew = rng.uniform(size=population) < 0.3  # the motion of a known state under other torques
        trial[:, anew] = centres[:, anew]
        trial[-states.torques :, anew] = rng.uniform(-1, 1, (states.torques, int(anew.sum())))
        trial = np.hstack([known, np.clip(trial, -1.5, 1.5)])
        Phi, drift, inside = states.columns(trial)
        e = np.where(inside, _violation(Phi, drift, x), -np.inf)
        order = np.argsort(-e)[:200]
        known, e = trial[:, order], e[order]
    apart: list[int] = []
    for k in range(known.shape[1]):
        if np.isfinite(e[k]) and all(np.abs(known[:, k] - known[:, j]).max() > 0.1 for j in apart):
            apart.append(k)
    p = np.concatenate([(x.U - x.V).ravel(order="F"), x.gauge.ravel(order="F"), x.m])
    fresh = [known[:, k] for k in apart[: 4 * polished]]
    for k in apart[:polished]:
        found = states.polish(x0=known[:, k], p=p, lbx=-1.5, ubx=1.5, lbg=states.low, ubg=states.high)
        fresh.append(found["x"].full().ravel())
    new = _kept_limits(states, np.column_stack(fresh))
    Phi, drift, _ = states.columns(new)
    e = _violation(Phi, drift, x)
    return new[:, e > 1e-4], float(max(e.max(initial=0.0), 0.0))
