"""Physically possible parameters: the estimate nearest to what the data say that some real machine could have.

A machine is possible where every body has a pseudo-inertia matrix that is positive (Wensing, Kim and Slotine, "Linear
matrix inequalities for physically consistent inertial parameter identification", IEEE RA-L 3, 2018), joints only brake
and the soil only resists. Base parameters are possible where some standard parameters behind them are: a convex set,
so the nearest point is a convex program (Sousa and Cortesao, "Physical feasibility of robot base inertial parameter
identification", IJRR 33, 2014). Which parameter has which sign follows from what the machine file says it belongs to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cvxpy as cp
import numpy as np

from excite.errors import NotConsistentError
from excite.identification.estimate import Estimate, add_notes
from excite.identification.linear_methods import Block, residual, rms_torque
from excite.model import Model, required_signs, standard_parameters
from excite.model.mechanics import INERTIAL

INTERIOR_MARGIN = 1e-6  # of a parameter's scale, kept from the edge: a mass matrix must be invertible
NOTABLE_SHIFT = 1e-3  # of a standard deviation: a shift larger than this is worth a remark


def nearest_possible(model: Model, estimate: Estimate) -> Estimate:
    """The possible parameters nearest to an estimate, in the metric of its covariance.

    For least squares that is the minimum of |Y - W X| over all possible machines. Parameters that the log doesn't show
    stay unidentifiable but are asked to be possible along with the others. Deviations are those of the estimate, an
    upper bound where a constraint holds. The residual is not recomputed here (see `constrained`). Raises NotConsistent.
    """
    kept = np.flatnonzero(np.isfinite(estimate.value) & np.isfinite(estimate.std))
    table = standard_parameters(model.machine)
    scale = _scales(model)
    p = cp.Variable(len(table))
    by_name = {name: p[k] * scale[k] for k, name in enumerate(table)}
    X = (model.base.matrix * scale) @ p
    shift = (X[kept] - estimate.value[kept]) / model.scale[kept]
    covariance = estimate.covariance[np.ix_(kept, kept)] / np.outer(model.scale[kept], model.scale[kept])
    root = _inverse_root(covariance)
    problem = cp.Problem(
        cp.Minimize(cp.sum_squares(root @ shift)), _possibility_constraints(model, by_name, INTERIOR_MARGIN)
    )
    try:
        problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    except cp.error.SolverError as err:
        raise NotConsistentError(f"no possible machine found near the estimate: {err}") from None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or X.value is None:
        raise NotConsistentError(f"no possible machine found near the estimate: the solver says {problem.status}")
    value = np.full(len(estimate.value), np.nan)
    value[kept] = np.asarray(X.value)[kept]
    moved = (value[kept] - estimate.value[kept]) / estimate.std[kept]
    if np.abs(moved).max(initial=0.0) < NOTABLE_SHIFT:
        return add_notes(replace(estimate, method=f"{estimate.method}+consistent"), "consistent: possible as it is")
    distance = float(np.sqrt(max(problem.value, 0.0)))
    worst = [f"{estimate.names[kept[k]]} {moved[k]:+.1f}" for k in np.argsort(-np.abs(moved))[:3]]
    note = (
        f"consistent: no real machine has the unconstrained values; the nearest possible one is {distance:.1f} standard"
        f" deviations away (most: {', '.join(worst)})"
    )
    return add_notes(replace(estimate, method=f"{estimate.method}+consistent", value=value), note)


def constrained_estimate(model: Model, estimate: Estimate, blocks: Sequence[Block]) -> Estimate:
    """`consistent`, with residual and relative error of the filtered rows at the possible values."""
    found = nearest_possible(model, estimate)
    x = np.where(np.isnan(found.value), model.nominal, found.value)
    e = np.concatenate([residual(b, x) for b in blocks], axis=1)
    return replace(found, residual=e, relative_error_percent=100 * float(np.sqrt(np.mean(e**2))) / rms_torque(blocks))


def is_possible(model: Model, X: np.ndarray) -> bool:
    """Whether some possible machine has these base parameters (n_base,)."""
    table = standard_parameters(model.machine)
    scale = _scales(model)
    p = cp.Variable(len(table))
    by_name = {name: p[k] * scale[k] for k, name in enumerate(table)}
    same = ((model.base.matrix * scale) @ p - X) / model.scale == 0
    problem = cp.Problem(cp.Minimize(0), [same, *_possibility_constraints(model, by_name, 0.0)])
    problem.solve(solver=cp.CLARABEL)
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


def _possibility_constraints(model: Model, p: dict[str, cp.Expression], margin: float) -> list[cp.Constraint]:
    """What every real machine obeys, in standard parameters by name, `margin` of their nominal size inside."""
    nominal = {name: abs(value) for name, (value, _) in standard_parameters(model.machine).items()}
    found = [sign * p[name] >= margin * nominal[name] for name, sign in required_signs(model.machine).items()]
    for body in model.machine.body:
        k = body.index
        if body.inertia is not None:
            own = {name: p[f"{name}{k}"] for name in INERTIAL if f"{name}{k}" in p}
            if body.inertia.axisymmetric:
                own["YY"] = own["XX"]
            m, h, second = _pseudo_inertia(own)
            # One size per block: the matrix is scaled by a length, as its entries are masses, moments and inertias.
            inertia = nominal.get(f"ZZ{k}", 0.0)
            length = float(np.sqrt(inertia / nominal[f"M{k}"])) if inertia > 0 else 1.0
            S = cp.bmat([[second / length**2, h / length], [h.T / length, cp.reshape(m, (1, 1), order="C")]])
            found.append(S / nominal[f"M{k}"] >> margin * np.eye(4))
    return found


def _pseudo_inertia(own: dict[str, cp.Expression]) -> tuple[cp.Expression, cp.Expression, cp.Expression]:
    """Mass, first moments (3, 1) and second moments (3, 3) = tr(I)/2 1 - I of a body; what it doesn't have is zero."""

    def at(name: str) -> cp.Expression:
        return own.get(name, cp.Constant(0.0))

    xx, yy, zz = at("XX"), at("YY"), at("ZZ")
    half = (xx + yy + zz) / 2
    second = cp.bmat(
        [
            [half - xx, -at("XY"), -at("XZ")],
            [-at("XY"), half - yy, -at("YZ")],
            [-at("XZ"), -at("YZ"), half - zz],
        ]
    )
    h = cp.reshape(cp.hstack([at("MX"), at("MY"), at("MZ")]), (3, 1), order="C")
    return at("M"), h, second


def _scales(model: Model) -> np.ndarray:
    """Size of each standard parameter, for the solver: its nominal value, or its base parameter's where that is 0."""
    values = np.array([abs(v) for v, _ in standard_parameters(model.machine).values()])
    return np.where(values > 0, values, max(1.0, float(np.median(model.scale))))


def _inverse_root(covariance: np.ndarray) -> np.ndarray:
    """R with R'R = covariance^-1; directions known without error are held to 1e-7 of the least known one."""
    variance, v = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((v / np.sqrt(np.maximum(variance, 1e-14 * variance.max()))).T)
