"""How good is a drive: scores of the information matrix A = Phi' Phi, Phi = W diag(scale). Lower is better.

An objective is a plain function in the table OBJECTIVES, of the eigenvalues of A or of the relative variances, the
diagonal of its inverse; the table says which, and whether rows count by their noise. The same expression runs on
numbers and on CasADi symbols. `sharp` tells how closely a largest or smallest value is followed: max_i x_i is replaced
by log(sum_i exp(p x_i)) / p, which is smooth and at most log(n)/p above it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np

from excite.model import Model
from excite.simulation import Motion, effect_inputs

Function = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True)
class Objective:
    """A function(x, sharp) of `of`: the eigenvalues of A or the relative variances diag(A^-1), x (n,).

    `weighted`: Phi's rows are divided by their noise (`row_noise`), so that variances are those of the estimate.
    `read`: how people read its value, which is then the logarithm of a square: as a condition number, or as a relative
    standard deviation [%]; else as it is.
    """

    function: Function
    of: Literal["eigenvalues", "variances"]
    weighted: bool
    read: Literal["cond", "percent", "value"] = "value"


def _top(x: ca.SX, sharp: ca.SX) -> ca.SX:
    return ca.logsumexp(sharp * x) / sharp


def cond(eigenvalues: ca.SX, sharp: ca.SX) -> ca.SX:
    """Condition number: log of the largest over the smallest eigenvalue, 2 log cond(Phi)."""
    logs = ca.log(eigenvalues)
    return _top(logs, sharp) + _top(-logs, sharp)


def d_optimal(eigenvalues: ca.SX, sharp: ca.SX) -> ca.SX:
    """-log det A / n: the volume of the confidence ellipsoid."""
    return -ca.sum1(ca.log(eigenvalues)) / eigenvalues.numel()


def a_optimal(eigenvalues: ca.SX, sharp: ca.SX) -> ca.SX:
    """log tr A^-1: the mean relative variance."""
    return ca.logsumexp(-ca.log(eigenvalues))


def e_optimal(eigenvalues: ca.SX, sharp: ca.SX) -> ca.SX:
    """-log of the smallest eigenvalue: the longest axis of the confidence ellipsoid."""
    return _top(-ca.log(eigenvalues), sharp)


def worst_sigma(variances: ca.SX, sharp: ca.SX) -> ca.SX:
    """log of the largest relative variance: the parameter that comes out worst."""
    return _top(ca.log(variances), sharp)


def accuracy(variances: ca.SX, sharp: ca.SX) -> ca.SX:
    """log of the largest relative variance and of the mean relative standard deviation squared, half and half."""
    logs = ca.log(variances)
    return (_top(logs, sharp) + 2 * (ca.logsumexp(logs / 2) - float(np.log(logs.numel())))) / 2


def discrimination(variances: ca.SX, sharp: ca.SX) -> ca.SX:
    """log of the larger relative variance of the last two parameters, the amounts of two rival effects.

    The drive on which the two explanations differ most, once each may take on all that the base parameters and the
    other one can: to first order the noncentrality of the one against the other is the inverse of that variance
    (T-optimality, Atkinson and Fedorov, Biometrika 62, 1975; with all others free Ds-optimality).
    """
    return _top(ca.log(variances[-2:]), sharp)


OBJECTIVES: dict[str, Objective] = {
    "cond": Objective(cond, "eigenvalues", False, "cond"),
    "weighted-cond": Objective(cond, "eigenvalues", True, "cond"),
    "D": Objective(d_optimal, "eigenvalues", True),
    "A": Objective(a_optimal, "eigenvalues", True),
    "E": Objective(e_optimal, "eigenvalues", True),
    "worst": Objective(worst_sigma, "variances", True, "percent"),
    "accuracy": Objective(accuracy, "variances", True),
    "discrimination": Objective(discrimination, "variances", True, "percent"),
}

EXACT = 1e6  # sharp enough for a score that is reported


@dataclass(frozen=True)
class Local:
    """An objective near an information matrix: value, slope (n_a,) and convex curvature factor F (n_a, r), F F'.

    n_a: the entries of A on and above the diagonal that can be non-zero.
    """

    value: float
    slope: np.ndarray
    factor: np.ndarray


@lru_cache(maxsize=32)
def _derivatives(objective: str, n: int) -> ca.Function:
    x, sharp = ca.SX.sym("x", n), ca.SX.sym("p")
    f = OBJECTIVES[objective].function(x, sharp)
    H, g = ca.hessian(f, x)
    return ca.Function("objective", [x, sharp], [f, g, ca.densify(H)])


def value(objective: str, A: np.ndarray, sharp: float = EXACT) -> float:
    """The score of an information matrix (n, n); inf where it is singular. Raises KeyError for an unknown name."""
    eigenvalues = np.linalg.eigvalsh(A)
    if not np.isfinite(eigenvalues).all() or eigenvalues[0] <= 1e-14 * eigenvalues[-1]:
        return float("inf")
    x = eigenvalues if OBJECTIVES[objective].of == "eigenvalues" else np.diag(np.linalg.inv(A))
    return float(_derivatives(objective, len(A))(x, sharp)[0])


def of_values(objective: str, x: np.ndarray) -> float:
    """The score of eigenvalues or relative variances (n,) as they are, whichever the objective looks at."""
    return float(_derivatives(objective, len(x))(x, EXACT)[0])


def reported(objective: str, value: float) -> float:
    """An objective as people read it: a condition number, a relative standard deviation [%], others as they are."""
    read = OBJECTIVES[objective].read
    return value if read == "value" else (100 if read == "percent" else 1) * float(np.exp(value / 2))


def conditions(objective: str) -> bool:
    """Whether an objective is a condition number, which is blind to signal against noise."""
    return objective in OBJECTIVES and OBJECTIVES[objective].read == "cond"


def titled(objective: str, value: float) -> str:
    """A value as `reported`, with its name and unit."""
    read = OBJECTIVES[objective].read
    name = f"{objective}(Phi)" if read == "cond" else f"objective {objective}"
    return f"{name} {value:.4g}{' %' if read == 'percent' else ''}"


def local(objective: str, A: np.ndarray, rows: np.ndarray, columns: np.ndarray, sharp: float) -> Local:
    """Value, slope and convex curvature of an objective with respect to the entries A[rows, columns], rows <= columns.

    For a function F of the eigenvalues with A = V diag(x) V' and H in the eigenvectors' axes (Lewis and Sendov,
    2001), d2F[H, H] = sum_ij F_ij H_ii H_jj + sum_{i != j} (F_i - F_j) / (x_i - x_j) H_ij^2. Negative parts are
    dropped: the log of the largest eigenvalue is concave along A itself. Of the variances v_i = c_i[i], C = A^-1,
    d2F[H, H] = sum_i 2 F_i c_i' H C H c_i + sum_ij F_ij (c_i' H c_i) (c_j' H c_j); log max_i v_i is convex in A.
    """
    if OBJECTIVES[objective].of == "variances":
        return _local_variances(objective, A, rows, columns, sharp)
    n = len(A)
    x, V = np.linalg.eigh(A)
    out = _derivatives(objective, n)(x, sharp)
    g, H = out[1].full().ravel(), out[2].full()
    E = np.einsum("li,lj->lij", V[rows], V[columns])
    E = np.where((rows != columns)[:, None, None], E + E.transpose(0, 2, 1), E)
    slope = np.einsum("lii,i->l", E, g)
    e, U = np.linalg.eigh(x[:, None] * H * x)
    root = (U * np.sqrt(np.maximum(e, 0))).T / x
    i, j = np.triu_indices(n, 1)
    gap = x[j] - x[i]
    close = gap < 1e-7 * x[j]
    ratio = np.where(close, H[j, j] - H[i, j], (g[j] - g[i]) / np.where(close, 1, gap))
    factor = np.vstack([root @ np.einsum("lii->il", E), np.sqrt(2 * np.maximum(ratio, 0))[:, None] * E[:, i, j].T])
    return Local(float(out[0]), slope, factored(factor.T @ factor))


def _local_variances(objective: str, A: np.ndarray, rows: np.ndarray, columns: np.ndarray, sharp: float) -> Local:
    C = np.linalg.inv(A)
    out = _derivatives(objective, len(A))(np.diag(C), sharp)
    g, H = out[1].full().ravel(), out[2].full()
    twice = np.where(rows != columns, 2.0, 1.0)
    through = twice[:, None] * C[rows] * C[columns]  # c_i' E_l c_i, E_l the unit matrix of entry l
    curvature = through @ H @ through.T
    for i, weight in enumerate(g):
        moved = np.zeros((len(rows), len(A)))  # E_l c_i
        np.add.at(moved, (np.arange(len(rows)), rows), C[columns, i])
        off = rows != columns
        np.add.at(moved, (np.flatnonzero(off), columns[off]), C[rows[off], i])
        curvature += 2 * weight * moved @ C @ moved.T
    return Local(float(out[0]), -through @ g, factored(curvature))


def factored(matrix: np.ndarray) -> np.ndarray:
    """F (n, r) with F F' the positive part of a symmetric matrix."""
    e, U = np.linalg.eigh((matrix + matrix.T) / 2)
    keep = e > 1e-13 * e[-1]
    return np.asarray(U[:, keep] * np.sqrt(e[keep]))


def row_noise(model: Model) -> np.ndarray:
    """(n_rows,) noise of every equation per sample [N m, N]: of the torque sensor in an actuated row.

    Rows of a root hold no torque; what disturbs them is the torque noise that the contacts pass on, u / R, and the
    moment of it at the machine's radius of gyration. Drives then rank as by the Cramer-Rao bound of all sensors
    together (rank correlation 0.95 over random drives, torque noise alone and equal rows do worse).
    """
    machine = model.machine
    torque = {s.body: float(s.noise) for s in machine.sensor if s.kind == "torque" and s.noise is not None}
    known = [torque[b.index] for b in machine.actuated if b.index in torque]
    usual = float(np.mean(known)) if known else 1.0
    pushes = [torque.get(b.index, usual) / float(b.contact.radius) for b in machine.contacts if b.contact is not None]
    force = float(np.sqrt(np.mean(np.square(pushes)))) if pushes else usual
    noise = np.full(len(model.coordinates), force)
    for k, body in zip(model.actuated, machine.actuated, strict=True):
        noise[k] = torque.get(body.index, usual)
    if machine.planar and machine.body[0].coordinates[2] in model.coordinates:
        q, nu, _ = model.symbols()
        M = ca.Function("M", [q], [model.equations(q, nu, ca.DM(model.nominal))[0]])(0).full()
        turn = model.coordinates.index(machine.body[0].coordinates[2])
        noise[turn] = force * float(np.sqrt(M[turn, turn] / M[0, 0]))
    return noise


def relative(model: Model) -> np.ndarray:
    """(n_base,) what errors are relative to: the nominal value's size, the scale where that is zero."""
    return np.where(model.nominal != 0, np.abs(model.nominal), model.scale)


def percent(model: Model, covariance: np.ndarray) -> np.ndarray:
    """(n_base,) relative standard deviations [%] of a covariance (n_base, n_base) [SI^2]."""
    return np.asarray(100 * np.sqrt(np.diag(covariance)) / relative(model))


def weights(model: Model, objective: str) -> tuple[np.ndarray, np.ndarray]:
    """(n_rows,), (n_base,): what an objective multiplies the rows and the columns of W with.

    Columns count in `scale`; for relative variances in the nominal value itself, where it is not zero. Raises KeyError
    for an unknown name.
    """
    chosen = OBJECTIVES[objective]
    rows = 1 / row_noise(model) if chosen.weighted else np.ones(len(model.coordinates))
    if chosen.of == "eigenvalues":
        return rows, model.scale
    return rows, relative(model)


def phi(model: Model, motion: Motion, objective: str = "cond") -> np.ndarray:
    """Phi = W diag(scale) (rows of all samples, n_base), rows and columns weighted as the objective asks."""
    rows, columns = weights(model, objective)
    W = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T, *effect_inputs(model, motion)) * rows[:, None]
    return (W * columns).reshape(-1, len(columns))


def _cond(matrix: np.ndarray) -> float:
    s = np.linalg.svd(np.linalg.qr(matrix, mode="r"), compute_uv=False)
    return float(s[0] / s[-1]) if s[-1] > 0 else float("inf")


def cond_phi(model: Model, motion: Motion) -> float:
    """Condition number of Phi over every sample of a motion."""
    return _cond(phi(model, motion))


def cond_w(model: Model, motion: Motion) -> float:
    """Condition number of the regressor W, in SI units, over every sample of a motion."""
    return _cond(phi(model, motion) / model.scale)
