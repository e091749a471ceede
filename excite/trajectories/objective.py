"""Objectives of a design: scores of the information matrix A = Phi' Phi, Phi = W diag(scale). Lower is better.

An objective is a pure function in the table OBJECTIVES, of the eigenvalues of A or of the variances diag(G' A^-1 G) of
contrasts G (n, m), combinations of relative parameter errors: each parameter alone by default. The same expression runs
on numbers and on CasADi symbols. `sharpness` p replaces max_i x_i by log(sum_i exp(p x_i)) / p, which is smooth and at
most log(n) / p above the maximum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np

from excite.model import Model
from excite.model.machine import noise_of
from excite.simulation import Motion, effect_inputs
from excite.text import format_number

ObjectiveFunction = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True)
class Objective:
    """An entry of OBJECTIVES: function(x, sharpness) of the eigenvalues of A or of variances diag(G' A^-1 G).

    of: the input of the function. weighted: divide the rows of Phi by their noise (`row_noise`), so that variances are
    those of the estimate. shown_as: the value for people; the logarithm of a square is shown as a condition number or
    as a relative standard deviation [%]. contrasts: whose variances count.
    """

    function: ObjectiveFunction
    of: Literal["eigenvalues", "variances"]
    weighted: bool
    shown_as: Literal["cond", "percent", "value"] = "value"
    contrasts: Literal["parameters", "rivals", "prediction"] = "parameters"


def _smooth_maximum(x: ca.SX, sharpness: ca.SX) -> ca.SX:
    return ca.logsumexp(sharpness * x) / sharpness


def cond(eigenvalues: ca.SX, sharpness: ca.SX) -> ca.SX:
    """Condition number: log of the largest over the smallest eigenvalue, 2 log cond(Phi)."""
    logs = ca.log(eigenvalues)
    return _smooth_maximum(logs, sharpness) + _smooth_maximum(-logs, sharpness)


def d_optimal(eigenvalues: ca.SX, sharpness: ca.SX) -> ca.SX:
    """-log det A / n: the volume of the confidence ellipsoid."""
    return -ca.sum1(ca.log(eigenvalues)) / eigenvalues.numel()


def a_optimal(eigenvalues: ca.SX, sharpness: ca.SX) -> ca.SX:
    """log tr A^-1: the mean relative variance."""
    return ca.logsumexp(-ca.log(eigenvalues))


def e_optimal(eigenvalues: ca.SX, sharpness: ca.SX) -> ca.SX:
    """-log of the smallest eigenvalue: the longest axis of the confidence ellipsoid."""
    return _smooth_maximum(-ca.log(eigenvalues), sharpness)


def worst_sigma(variances: ca.SX, sharpness: ca.SX) -> ca.SX:
    """log of the largest variance: the least accurate parameter, rival effect or predicted signal."""
    return _smooth_maximum(ca.log(variances), sharpness)


def accuracy(variances: ca.SX, sharpness: ca.SX) -> ca.SX:
    """log of the square of the geometric mean of the largest and the mean relative standard deviation."""
    logs = ca.log(variances)
    return (_smooth_maximum(logs, sharpness) + 2 * (ca.logsumexp(logs / 2) - float(np.log(logs.numel())))) / 2


def mean_variance(variances: ca.SX, sharpness: ca.SX) -> ca.SX:
    """log of the mean variance. Of a prediction's signals: I-optimality."""
    return ca.log(ca.sum1(variances) / variances.numel())


OBJECTIVES: dict[str, Objective] = {
    "cond": Objective(cond, "eigenvalues", False, "cond"),
    "weighted-cond": Objective(cond, "eigenvalues", True, "cond"),
    "D": Objective(d_optimal, "eigenvalues", True),
    "A": Objective(a_optimal, "eigenvalues", True),
    "E": Objective(e_optimal, "eigenvalues", True),
    "worst": Objective(worst_sigma, "variances", True, "percent"),
    "accuracy": Objective(accuracy, "variances", True, "percent"),
    # Magnitudes of rival effects, all other parameters free: to first order, the noncentrality of one effect against
    # the others is the inverse of its variance (T-optimality, Atkinson and Fedorov, Biometrika 62, 1975; Ds-optimality)
    "discrimination": Objective(worst_sigma, "variances", True, "percent", "rivals"),
    # Signals along another drive: I- and G-optimality (Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007)
    "prediction": Objective(mean_variance, "variances", True, "percent", "prediction"),
    "prediction-max": Objective(worst_sigma, "variances", True, "percent", "prediction"),
}

MIN_NOMINAL_SHARE = 0.05  # of its scale, below which a nominal value counts as zero; chosen
EXACT_SHARPNESS = 1e6  # exceeds a reported maximum by at most log(n) / 1e6


@dataclass(frozen=True)
class LocalModel:
    """Quadratic model of an objective near an information matrix.

    value; slope (n_a,); curvature F F' with factor F (n_a, r). n_a: entries of A on and above the diagonal that can be
    non-zero.
    """

    value: float
    slope: np.ndarray
    factor: np.ndarray


@lru_cache(maxsize=32)
def _derivatives(objective: str, n: int) -> ca.Function:
    x, sharpness = ca.SX.sym("x", n), ca.SX.sym("p")
    f = OBJECTIVES[objective].function(x, sharpness)
    H, g = ca.hessian(f, x)
    return ca.Function("objective", [x, sharpness], [f, g, ca.densify(H)])


def score_matrix(
    objective: str, A: np.ndarray, sharpness: float = EXACT_SHARPNESS, contrasts: np.ndarray | None = None
) -> float:
    """Score an information matrix (n, n); inf if it is singular.

    contrasts (n, m): combinations of parameters whose variances count, each parameter by default.
    Raises KeyError for an unknown objective.
    """
    eigenvalues = np.linalg.eigvalsh(A)
    if not np.isfinite(eigenvalues).all() or eigenvalues[0] <= 1e-14 * eigenvalues[-1]:
        return float("inf")
    x = eigenvalues if OBJECTIVES[objective].of == "eigenvalues" else contrast_variances(np.linalg.inv(A), contrasts)
    return float(_derivatives(objective, len(x))(x, sharpness)[0])


def contrast_variances(covariance: np.ndarray, contrasts: np.ndarray | None) -> np.ndarray:
    """Return diag(G' C G) (m,) of a covariance (n, n) and contrasts G (n, m), each parameter by default."""
    if contrasts is None:
        return np.diag(covariance)
    return np.asarray((contrasts * (covariance @ contrasts)).sum(axis=0))


def score_values(objective: str, x: np.ndarray) -> float:
    """Score the eigenvalues or variances (m,) that the objective takes."""
    return float(_derivatives(objective, len(x))(x, EXACT_SHARPNESS)[0])


def reported_value(objective: str, value: float) -> float:
    """Convert a score to a condition number, a relative standard deviation [%], or itself, as `shown_as` says."""
    shown_as = OBJECTIVES[objective].shown_as
    return value if shown_as == "value" else (100 if shown_as == "percent" else 1) * float(np.exp(value / 2))


def is_condition_number(objective: str) -> bool:
    """Return True for objectives that are condition numbers and therefore ignore the signal-to-noise ratio."""
    return objective in OBJECTIVES and OBJECTIVES[objective].shown_as == "cond"


def describe_value(objective: str, value: float) -> str:
    """Write a reported value with its name and unit."""
    shown_as = OBJECTIVES[objective].shown_as
    name = f"{objective}(Phi)" if shown_as == "cond" else f"objective {objective}"
    return f"{name} {format_number(value, 4)}{' %' if shown_as == 'percent' else ''}"


def local_model(
    objective: str,
    A: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    sharpness: float,
    contrasts: np.ndarray | None = None,
) -> LocalModel:
    """Expand an objective in the entries A[rows, columns], rows <= columns, to second order with convex curvature.

    Eigenvalues: with A = V diag(x) V' and H in the axes of V, d2F[H, H] = sum_ij F_ij H_ii H_jj
    + sum_{i != j} (F_i - F_j) / (x_i - x_j) H_ij^2 (Lewis and Sendov, 2001). Negative parts are dropped.
    Variances v_i = g_i' C g_i, C = A^-1, c_i = C g_i: d2F[H, H] = sum_i 2 F_i c_i' H C H c_i
    + sum_ij F_ij (c_i' H c_i) (c_j' H c_j).
    """
    if OBJECTIVES[objective].of == "variances":
        value, slope, curvature = _derivatives_of_variances(objective, A, rows, columns, sharpness, contrasts)
        return LocalModel(value, slope, factor_positive_part(curvature))
    n = len(A)
    x, V = np.linalg.eigh(A)
    value, g, H, E, ratio = _spectral_derivatives(objective, x, V, rows, columns, sharpness)
    slope = np.einsum("lii,i->l", E, g)
    e, U = np.linalg.eigh(x[:, None] * H * x)
    root = (U * np.sqrt(np.maximum(e, 0))).T / x
    i, j = np.triu_indices(n, 1)
    factor = np.vstack([root @ np.einsum("lii->il", E), np.sqrt(2 * np.maximum(ratio, 0))[:, None] * E[:, i, j].T])
    return LocalModel(value, slope, factor_positive_part(factor.T @ factor))


def _spectral_derivatives(
    objective: str, x: np.ndarray, V: np.ndarray, rows: np.ndarray, columns: np.ndarray, sharpness: float
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return value, slope and Hessian in the eigenvalues x, unit entries in the axes of V, and difference quotients.

    Entries E (n_a, n, n); quotients (F_i - F_j) / (x_i - x_j) (n (n - 1) / 2,) of the pairs i < j.
    """
    n = len(x)
    out = _derivatives(objective, n)(x, sharpness)
    g, H = out[1].full().ravel(), out[2].full()
    E = np.einsum("li,lj->lij", V[rows], V[columns])
    E = np.where((rows != columns)[:, None, None], E + E.transpose(0, 2, 1), E)
    i, j = np.triu_indices(n, 1)
    gap = x[j] - x[i]
    close = gap < 1e-7 * x[j]
    ratio = np.where(close, H[j, j] - H[i, j], (g[j] - g[i]) / np.where(close, 1, gap))
    return float(out[0]), g, H, E, ratio


def exact_derivatives(
    objective: str,
    A: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    sharpness: float,
    contrasts: np.ndarray | None = None,
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return value, slope (n_a,) and Hessian (n_a, n_a) of an objective in the entries A[rows, columns].

    The formulas of `local_model` without dropping negative curvature. Raises LinAlgError for a singular A.
    """
    if OBJECTIVES[objective].of == "variances":
        return _derivatives_of_variances(objective, A, rows, columns, sharpness, contrasts)
    n = len(A)
    x, V = np.linalg.eigh(A)
    value, g, H, E, ratio = _spectral_derivatives(objective, x, V, rows, columns, sharpness)
    own = np.einsum("lii->li", E)
    pairs = E[:, *np.triu_indices(n, 1)]
    return value, own @ g, own @ H @ own.T + (pairs * (2 * ratio)) @ pairs.T


def matrix_gradient(
    objective: str, A: np.ndarray, sharpness: float, contrasts: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """Return the value of an objective and its gradient (n, n) in the information matrix A (n, n).

    Raises LinAlgError for a singular A.
    """
    if OBJECTIVES[objective].of == "eigenvalues":
        x, V = np.linalg.eigh(A)
        if x[0] <= 1e-14 * x[-1]:
            raise np.linalg.LinAlgError("singular")
        value, g, *_ = _derivatives(objective, len(x))(x, sharpness)
        return float(value), np.asarray((V * g.full().ravel()) @ V.T)
    C = np.linalg.inv(A)
    through = C if contrasts is None else C @ contrasts  # C g_i
    variances = contrast_variances(C, contrasts)
    if not (variances > 0).all():
        raise np.linalg.LinAlgError("singular")
    value, g, *_ = _derivatives(objective, len(variances))(variances, sharpness)
    return float(value), np.asarray(-(through * g.full().ravel()) @ through.T)


def _derivatives_of_variances(
    objective: str,
    A: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    sharpness: float,
    contrasts: np.ndarray | None,
) -> tuple[float, np.ndarray, np.ndarray]:
    C = np.linalg.inv(A)
    through = C if contrasts is None else C @ contrasts  # c_i
    variances = contrast_variances(C, contrasts)
    out = _derivatives(objective, len(variances))(variances, sharpness)
    g, H = out[1].full().ravel(), out[2].full()
    twice = np.where(rows != columns, 2.0, 1.0)
    moved = twice[:, None] * through[rows] * through[columns]  # c_i' E_l c_i, E_l the unit matrix of entry l
    # sum_i F_i c_i' E_l C E_m c_i = tr(P E_l C E_m), P = sum_i F_i c_i c_i': four products of entries
    P = (through * g) @ through.T
    pairs = sum(P[np.ix_(a, d)] * C[np.ix_(b, c)] for a, b in _ends(rows, columns) for c, d in _ends(rows, columns))
    scale = np.where(rows != columns, 1.0, 0.5)
    return float(out[0]), -moved @ g, moved @ H @ moved.T + 2 * np.outer(scale, scale) * pairs


def _ends(rows: np.ndarray, columns: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return both orders of the entries of a symmetric matrix."""
    return (rows, columns), (columns, rows)


def factor_positive_part(matrix: np.ndarray) -> np.ndarray:
    """Factor the positive part of a symmetric matrix as F F', F (n, r)."""
    e, U = np.linalg.eigh((matrix + matrix.T) / 2)
    keep = e > 1e-13 * e[-1]
    return np.asarray(U[:, keep] * np.sqrt(e[keep]))


def row_noise(model: Model) -> np.ndarray:
    """Return the noise standard deviation (n_rows,) of every equation of motion per sample [N m, N].

    Actuated rows have the noise of their torque sensor. Rows of the root body have none; they get the torque noise that
    contacts transmit as a force, u / R, and its moment at the machine's radius of gyration. This ranks random drives as
    the Cramer-Rao bound of all sensors does (rank correlation 0.95, above torque noise alone and equal rows).
    """
    machine = model.machine
    torque = {s.body: noise_of(machine, s) for s in machine.sensor if s.kind == "torque" and s.noise is not None}
    known = [torque[b.index] for b in machine.actuated if b.index in torque]
    usual = float(np.mean(known)) if known else 1.0
    pushes = [torque.get(b.index, usual) / float(b.contact.radius) for b in machine.contacts if b.contact is not None]
    force = float(np.sqrt(np.mean(np.square(pushes)))) if pushes else usual
    noise = np.full(len(model.coordinates), force)
    for k, body in zip(model.actuated, machine.actuated, strict=True):
        noise[k] = torque.get(body.index, usual)
    if (turn := model.heading) is not None:
        q, nu, _ = model.symbols()
        M = ca.Function("M", [q], [model.equations(q, nu, ca.DM(model.nominal))[0]])(0).full()
        noise[turn] = force * float(np.sqrt(M[turn, turn] / M[0, 0]))
    return noise


def reference_values(model: Model) -> np.ndarray:
    """Return the magnitudes (n_base,) that errors are relative to: |nominal|, the scale where that is almost zero."""
    return np.where(np.abs(model.nominal) > MIN_NOMINAL_SHARE * model.scale, np.abs(model.nominal), model.scale)


def relative_std_percent(model: Model, covariance: np.ndarray) -> np.ndarray:
    """Return relative standard deviations (n_base,) [%] from a covariance (n_base, n_base) [SI^2]."""
    return np.asarray(100 * np.sqrt(np.diag(covariance)) / reference_values(model))


def row_and_column_weights(model: Model, objective: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors of the rows (n_rows,) and columns (n_base,) of W for an objective.

    Raises KeyError for an unknown objective.
    """
    chosen = OBJECTIVES[objective]
    rows = 1 / row_noise(model) if chosen.weighted else np.ones(len(model.coordinates))
    if chosen.of == "eigenvalues":
        return rows, model.scale
    return rows, reference_values(model)


def phi(model: Model, motion: Motion, objective: str = "cond") -> np.ndarray:
    """Return Phi = W diag(scale) (n_rows n_samples, n_base) with the objective's row and column weights."""
    rows, columns = row_and_column_weights(model, objective)
    W = model.stacked_regressor(motion.q.T, motion.nu.T, motion.a.T, *effect_inputs(model, motion)) * rows[:, None]
    return (W * columns).reshape(-1, len(columns))


def _cond(matrix: np.ndarray) -> float:
    s = np.linalg.svd(np.linalg.qr(matrix, mode="r"), compute_uv=False)
    return float(s[0] / s[-1]) if s[-1] > 0 else float("inf")


def cond_phi(model: Model, motion: Motion) -> float:
    """Return the condition number of Phi over every sample of a motion."""
    return _cond(phi(model, motion))


def cond_w(model: Model, motion: Motion) -> float:
    """Return the condition number of the regressor W in SI units over every sample of a motion."""
    return _cond(phi(model, motion) / model.scale)
