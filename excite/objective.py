"""How good is a drive: scores of the information matrix A = Phi' Phi, Phi = W diag(scale). Lower is better.

An objective is a plain function of the eigenvalues of A, all with one signature, in the table OBJECTIVES. The same
expression runs on numbers and on CasADi symbols. `sharp` tells how closely a largest or smallest eigenvalue is
followed: max_i x_i is replaced by log(sum_i exp(p x_i)) / p, which is smooth and at most log(n)/p above it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from excite.simulate import Motion
from model.prediction import Model

Objective = Callable[[ca.SX, ca.SX], ca.SX]


def _top(x: ca.SX, sharp: ca.SX) -> ca.SX:
    return ca.logsumexp(sharp * x) / sharp


def cond(eigenvalues: ca.SX, sharp: ca.SX) -> ca.SX:
    """log of the largest over the smallest eigenvalue, 2 log cond(Phi): the paper's."""
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


OBJECTIVES: dict[str, Objective] = {"cond": cond, "D": d_optimal, "A": a_optimal, "E": e_optimal}

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
    f = OBJECTIVES[objective](x, sharp)
    H, g = ca.hessian(f, x)
    return ca.Function(objective, [x, sharp], [f, g, ca.densify(H)])


def value(objective: str, A: np.ndarray, sharp: float = EXACT) -> float:
    """The score of an information matrix (n, n); inf where it is singular. Raises KeyError for an unknown name."""
    eigenvalues = np.linalg.eigvalsh(A)
    if not np.isfinite(eigenvalues).all() or eigenvalues[0] <= 1e-14 * eigenvalues[-1]:
        return float("inf")
    return float(_derivatives(objective, len(A))(eigenvalues, sharp)[0])


def reported(objective: str, value: float) -> float:
    """An objective as people read it: cond as the condition number of Phi, the others as they are."""
    return float(np.exp(value / 2)) if objective == "cond" else value


def local(objective: str, A: np.ndarray, rows: np.ndarray, columns: np.ndarray, sharp: float) -> Local:
    """Value, slope and convex curvature of an objective with respect to the entries A[rows, columns], rows <= columns.

    For a function F of the eigenvalues with A = V diag(x) V' and H in the eigenvectors' axes (Lewis and Sendov,
    2001), d2F[H, H] = sum_ij F_ij H_ii H_jj + sum_{i != j} (F_i - F_j) / (x_i - x_j) H_ij^2. Negative parts are
    dropped: the log of the largest eigenvalue is concave along A itself.
    """
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
    e, U = np.linalg.eigh(factor.T @ factor)
    keep = e > 1e-13 * e[-1]
    return Local(float(out[0]), slope, U[:, keep] * np.sqrt(e[keep]))


def phi(model: Model, motion: Motion) -> np.ndarray:
    """Phi = W diag(scale) (rows of all samples, n_base)."""
    W = model.stacked(motion.q.T, motion.nu.T, motion.a.T)
    return (W * model.scale).reshape(-1, len(model.scale))


def _cond(matrix: np.ndarray) -> float:
    s = np.linalg.svd(np.linalg.qr(matrix, mode="r"), compute_uv=False)
    return float(s[0] / s[-1]) if s[-1] > 0 else float("inf")


def cond_phi(model: Model, motion: Motion) -> float:
    """Condition number of Phi over every sample of a motion."""
    return _cond(phi(model, motion))


def cond_w(model: Model, motion: Motion) -> float:
    """Condition number of the regressor W, in SI units, over every sample of a motion."""
    return _cond(phi(model, motion) / model.scale)
