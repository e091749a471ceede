"""How good could a drive be: a bound on cond(Phi) by the best mixture of pointwise feasible states.

Every drive within the limits spreads its samples over states that each keep the limits and the equations of motion.
Its information matrix is then a mixture of the matrices of such states, and what returns to where it began has
E[d phi / dt] = 0 for every function phi of the state (an occupation measure; Lasserre et al., 2008). Relaxing to all
such mixtures, with phi the polynomials up to a degree, gives a semidefinite program whose optimum no drive can beat:

    min t   with   I <= sum_k w_k A_k <= t I,   sum_k w_k d phi_j / dt (s_k) = 0,   w >= 0,   cond >= sqrt(t).

Its dual is a certificate: U, V >= 0 with tr V = 1 and multipliers m such that <U - V, A(s)> <= m' d phi / dt (s) in
every state s prove t >= tr U. Column generation starts from the states of a drive and adds those that violate the
certificate most. Where <U - V, A> - m' d phi / dt <= e <a (U + V) + b I, A> everywhere, the certificate (1 - e a) U,
(1 + e a) V + e b I holds exactly, so that t >= tr U (1 - e a) / (1 + e a + e b n). Violations e are measured with
a = 1 / (2 tr U), b = 1 / tr sum_k w_k A_k: <U + V, A> alone vanishes at states that move a lot.

What is assumed. The search for violating states is local (every sample of the drives that it starts from, a random
population about these and all that were found, the best of it polished by an interior point method), so e is the
largest violation found and the bound a numerical one, not a proof. The parameters are the nominal ones. Not used: the
lane, torque rates, the duration and the knots, so the optimum of the relaxation may lie well below what a drive can
reach. Samples of a motion meet E[d phi / dt] = 0 up to their sum's distance from the integral, O(sample / duration),
and to the tolerances of rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement

import casadi as ca
import cvxpy as cp
import numpy as np

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion
from excite.trajectories import limits

STRIDE = 40  # samples of a drive from one state to the next, at first
WORST = 100  # of all its samples, those about which a round searches as well
SPARSE = 100  # samples of a drive from one state to the next, about which the last search is
INSIDE = 1e-6  # of a limit's range: what a state may exceed
SPREAD = 3e-3, 0.5  # of the population around the states that are known, log-uniform, in half ranges
THOROUGH = 3  # times the search of the first rounds, once these find little, and against what is reported
NEAR = 0.5  # violation below the certificate's boundary by which a state is kept
MOST = 500  # states that are kept
# Of drift that is left over, in t. Samples of a drive hardly ever stand still exactly, so drift is allowed at this
# price. It bounds the multipliers, which keeps them from jumping between rounds (stabilised column generation, du Merle
# et al., 1999); a certificate with bounded multipliers is as valid, and a mixture counts once nothing is left over.
PRICE = 300.0
STILL = 1e-5  # drift that is left over and counts as none, as a share of the largest


@dataclass(frozen=True)
class Certificate:
    """U, V (n, n), multipliers m (n_phi,): <U - V, A> <= m' d phi / dt. a, b: how violations are measured."""

    U: np.ndarray
    V: np.ndarray
    m: np.ndarray
    a: float
    b: float

    @property
    def gauge(self) -> np.ndarray:
        return np.asarray(self.a * (self.U + self.V) + self.b * np.eye(len(self.U)))

    def proves(self, e: float) -> float:
        """The t that is proven where no state violates it by more than e."""
        return float(np.trace(self.U)) * max(0.0, 1 - e * self.a) / (1 + e * (self.a + self.b * len(self.U)))


@dataclass(frozen=True)
class Bound:
    """How low cond(Phi) can be.

    mixture: cond of the best mixture of the states found; the relaxation's optimum is not above it. certified: no drive
    does better, by the best certificate and the largest violation of it that was found, which is `violation`. states:
    in the last mixture. rounds: of column generation. degree: of the polynomials. certificate: what proves it.
    """

    mixture: float
    certified: float
    violation: float
    states: int
    rounds: int
    degree: int
    certificate: Certificate | None = field(default=None, compare=False, repr=False)

    def along(self, model: Model, problem: Problem, motion: Motion) -> float:
        """The largest violation of the certificate by a sample of a motion that keeps the limits."""
        assert self.certificate is not None
        states = _states(model, problem, self.degree)
        Phi, drift, _ = states.columns(_visited(states, [motion], 1))
        return float(_violation(Phi, drift, self.certificate).max(initial=0.0))


Progress = Callable[[Bound], bool | None]


@dataclass(frozen=True)
class _States:
    """Pointwise feasible states z (n_z,), scaled to about one: positions that forces depend on, speeds, torques.

    sample: z to Phi' (n, n_rows), d phi / dt (n_phi,), limits (n_g,) between low and high. polish: the local search.
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
        """Phi (n_k, n_rows, n), d phi / dt (n_k, n_phi) and whether the limits hold (n_k,), of states (n_z, n_k)."""
        if not Z.shape[1]:  # CasADi would take it for a number
            n, rows = self.sample.size_out(0)
            return np.zeros((0, rows, n)), np.zeros((0, self.sample.size1_out(1))), np.zeros(0, bool)
        phi, drift, g = (x.full() for x in self.sample(Z))
        inside = ((g >= self.low[:, None] - INSIDE) & (g <= self.high[:, None] + INSIDE)).all(axis=0)
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
    """A lower bound on cond(Phi) of every drive of a problem, from the states of drives within the limits.

    Ends when the certified bound is within `gap` of the mixture for a thorough search, or after so many rounds. degree:
    of the polynomials phi (0: any mixture of states). population, polished: states that are tried in a round, and how
    many of them are made worse locally. progress(found so far) may say True to make this round the last one. Raises
    ValueError where the motions leave the limits everywhere, RuntimeError where the semidefinite program fails.
    """
    states = _states(model, problem, degree)
    rng = np.random.default_rng(seed)
    Z, given = _visited(states, motions, STRIDE), _visited(states, motions, 1)
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
        t, w, certificate = _mixture(np.einsum("kri,krj->kij", Phi, Phi), drift)
        # The drives themselves lie on the thin manifold of slips in equilibrium, which a random search leaves at once.
        off = np.argsort(-_violation(given_Phi, given_drift, certificate))[:WORST]
        around = np.hstack([Z, given[:, off]])
        fresh, worst = _price(states, certificate, around, effort * population, effort * polished, rng)
        # what is found against one certificate counts against every one
        new_Phi, new_drift, _ = states.columns(fresh)
        proofs = [(x, float(_violation(new_Phi, new_drift, x).max(initial=e))) for x, e in proofs]
        proofs.append((certificate, worst))
        found = replace(
            found,
            mixture=min(found.mixture, float(np.sqrt(t))),
            certified=max(float(np.sqrt(x.proves(e))) for x, e in proofs),
            violation=worst,
            states=int((w > 1e-6 * w.max()).sum()),
            rounds=k,
        )
        enough = progress is not None and progress(found)
        if found.certified > (1 - gap) * found.mixture or not fresh.shape[1]:
            enough = enough or effort > 1
            effort = THOROUGH  # closed for a quick look: it has to close for a thorough one
        if enough:
            break
        e = np.where(w > 1e-9 * w.max(), np.inf, _violation(Phi, drift, certificate))
        best = np.argsort(-e)[:MOST]
        Z = np.hstack([Z[:, best[e[best] > -NEAR]], fresh])
    around = np.hstack([Z, given[:, ::SPARSE]])
    certificate, violation = _confirmed(states, proofs, around, THOROUGH * population, THOROUGH * polished, rng)
    certified = float(np.sqrt(certificate.proves(violation)))
    return replace(found, certified=certified, violation=violation, certificate=certificate)


def _visited(states: _States, motions: Sequence[Motion], stride: int) -> np.ndarray:
    """States (n_z, n_k) of motions and of their mirror images that keep the limits."""
    every = [np.hstack([m.q[::stride, list(states.core)], m.nu[::stride], m.u[::stride]]) for m in motions]
    Z = (np.vstack(every) / states.size).T
    return _kept_limits(states, np.hstack([Z, -Z]))


def _confirmed(
    states: _States,
    proofs: list[tuple[Certificate, float]],
    Z: np.ndarray,
    population: int,
    polished: int,
    rng: np.random.Generator,
) -> tuple[Certificate, float]:
    """The certificate that proves most after a thorough search against it, and its violation.

    The best of many certificates is likely to be one whose violations were overlooked: hence the second look.
    """
    left, looked = list(proofs), list[tuple[float, float, Certificate]]()
    while left and len(looked) < 5:
        k = int(np.argmax([x.proves(e) for x, e in left]))
        x, e = left.pop(k)
        if looked and x.proves(e) <= max(t for t, *_ in looked):
            break
        e = max(e, _price(states, x, Z, population, polished, rng)[1])
        looked.append((x.proves(e), e, x))
    _, e, best = max(looked, key=lambda found: found[0])
    return best, e


def _states(model: Model, problem: Problem, degree: int) -> _States:
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
    places = [owner[model.coordinates[k]].limit.position for k in core]
    size = [float(p) if p is not None else 1.0 for p in places] + at_most
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
    kept = [g for g in limits.machine_limits(model, problem) if not limits.of_lane(g.name) and g.kind != "torque_rate"]
    g = ca.vertcat(*[k.expression(q, nu, u, ca.SX(len(model.inputs), 1)) / k.range for k in kept])
    low, high = np.array([k.low / k.range for k in kept]), np.array([k.high / k.range for k in kept])

    n = phi.shape[1]
    G, B, m = ca.SX.sym("G", n, n), ca.SX.sym("B", n, n), ca.SX.sym("m", drift.numel())
    gain, gauge = (ca.sum1(ca.sum2((phi @ X) * phi)) for X in (G, B))
    search = {"x": z, "p": ca.vertcat(ca.vec(G), ca.vec(B), m), "f": -(gain - ca.dot(m, drift)) / gauge, "g": g}
    quiet = {"print_level": 0, "sb": "yes", "max_iter": 60, "tol": 1e-5, "hessian_approximation": "limited-memory"}
    polish = ca.nlpsol("polish", "ipopt", search, {"print_time": False, "error_on_fail": False, "ipopt": quiet})
    sample = ca.Function("sample", [z], [phi.T, drift, g], {"cse": True})
    return _States(core, np.array(size), n, len(model.inputs), sample, low, high, polish)


def _product(factors: list[ca.SX]) -> ca.SX:
    out = factors[0]
    for f in factors[1:]:
        out = out * f
    return out


def _kept_limits(states: _States, Z: np.ndarray) -> np.ndarray:
    return Z[:, states.columns(Z)[2]]


def _mixture(A: np.ndarray, c: np.ndarray) -> tuple[float, np.ndarray, Certificate]:
    """The best mixture of information matrices (n_k, n, n) with drifts (n_k, n_phi).

    t (inf while it drifts), weights (n_k,), certificate.
    Columns are scaled to trace one and drifts to one, without which the interior point stalls.
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
    problem = cp.Problem(cp.Minimize(t + PRICE * cp.norm1(left)), [low, high, *still])
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
    # the sign of an equality's multiplier is the solver's convention: the certificate must hold on its own columns
    over = [(np.einsum("kij,ij->k", A, x.U - x.V) - c @ x.m).max() for x in both]
    chosen = both[int(np.argmin(over))]
    reached = float(t.value) if np.abs(left.value).max() < STILL * float(np.sum(w.value)) else np.inf
    return reached, np.maximum(w.value, 0) * scale, chosen


def _psd(matrix: np.ndarray) -> np.ndarray:
    e, Q = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((Q * np.maximum(e, 0)) @ Q.T)


def _violation(Phi: np.ndarray, drift: np.ndarray, x: Certificate) -> np.ndarray:
    """(n_k,): (<U - V, A> - m' d phi / dt) / <a (U + V) + b I, A>."""
    gain, gauge = (np.einsum("kri,kri->k", Phi @ M, Phi) for M in (x.U - x.V, x.gauge))
    return np.asarray((gain - drift @ x.m) / gauge)


def _price(
    states: _States, x: Certificate, Z: np.ndarray, population: int, polished: int, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """States (n_z, n_new) that violate a certificate, and the largest violation found.

    Two generations around the known states, the second around the worst of the first; the worst that lie apart are
    polished.
    """
    known, e = Z, np.zeros(Z.shape[1])
    for _ in range(2):
        centres = known[:, rng.integers(known.shape[1], size=population)]
        low, high = np.log(SPREAD)
        trial = centres + np.exp(rng.uniform(low, high, population)) * rng.standard_normal(centres.shape)
        anew = rng.uniform(size=population) < 0.3  # the same motion under other torques
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
