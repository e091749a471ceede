"""Nearest physically possible parameters of an estimate.

A machine is possible if every body has a positive pseudo-inertia matrix (Wensing, Kim and Slotine, "Linear matrix
inequalities for physically consistent inertial parameter identification", IEEE RA-L 3, 2018), joints dissipate and
the soil resists. Base parameters are possible if some possible standard parameters give them. That set is convex, so
the nearest point is a convex program (Sousa and Cortesao, "Physical feasibility of robot base inertial parameter
identification", IJRR 33, 2014).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import cvxpy as cp
import numpy as np

from excite.errors import NotConsistentError
from excite.identification.estimate import Estimate, add_notes
from excite.identification.linear_methods import Block, residual, rms_torque
from excite.model import Model, required_signs, standard_parameters
from excite.model.mechanics import INERTIAL

INTERIOR_MARGIN = 1e-6  # distance from the constraints, of a parameter's scale; keeps the mass matrix invertible
PULL = 0.01  # of bodies to the machine file's: 100 % off there costs as much as 0.1 standard deviations; chosen
NOTABLE_SHIFT = 1e-3  # smallest shift that is reported [standard deviations]; chosen


def nearest_possible(model: Model, estimate: Estimate) -> Estimate:
    """Return the possible parameters nearest to an estimate, in the metric of its covariance.

    For least squares this minimises |Y - W X| over all possible machines. Unidentifiable parameters stay
    unidentifiable, but some possible value must exist for them. Standard deviations are those of the estimate, an upper
    bound at an active constraint. The residual is not recomputed (see `constrained_estimate`). Raises
    NotConsistentError.
    """
    kept, distance, _, X = _nearest(model, estimate, 0.0)
    value = np.full(len(estimate.value), np.nan)
    value[kept] = X[kept]
    shift_in_stds = (value[kept] - estimate.value[kept]) / estimate.std[kept]
    if np.abs(shift_in_stds).max(initial=0.0) < NOTABLE_SHIFT:
        return add_notes(replace(estimate, method=f"{estimate.method}+consistent"), "consistent: possible as it is")
    worst = [f"{estimate.names[kept[k]]} {shift_in_stds[k]:+.1f}" for k in np.argsort(-np.abs(shift_in_stds))[:3]]
    note = (
        f"consistent: no real machine has the unconstrained values; the nearest possible one is {distance:.1f} standard"
        f" deviations away (most: {', '.join(worst)})"
    )
    return add_notes(replace(estimate, method=f"{estimate.method}+consistent", value=value), note)


def constrained_estimate(model: Model, estimate: Estimate, blocks: Sequence[Block]) -> Estimate:
    """Return the nearest possible estimate, with residual and relative error of the filtered rows at its values."""
    found = nearest_possible(model, estimate)
    x = found.value_or(model.nominal)
    e = np.concatenate([residual(b, x) for b in blocks], axis=1)
    return replace(found, residual=e, relative_error_percent=100 * float(np.sqrt(np.mean(e**2))) / rms_torque(blocks))


def possible_standard(model: Model, estimate: Estimate) -> dict[str, float]:
    """Return the standard parameters [SI] of a possible machine near the estimate and near the machine file, by name.

    What the logs do not show is that of the machine file, if possible. What they show is the estimate, to a small share
    of its standard deviations if that is possible: the pull to the machine file keeps bodies of a usual size where only
    extreme ones have the estimated values. Raises NotConsistentError.
    """
    return _nearest(model, estimate, PULL)[2]


def _nearest(model: Model, estimate: Estimate, pull: float) -> tuple[np.ndarray, float, dict[str, float], np.ndarray]:
    """Find the nearest possible machine in the metric of the estimate's covariance.

    pull: weight of the squared distance to the machine file, relative to the size of each standard parameter.
    Returns identified parameters (indices), distance [standard deviations], standard parameters, base parameters.
    """
    kept = np.flatnonzero(np.isfinite(estimate.value) & np.isfinite(estimate.std))
    scaled, by_name, X = _variables(model)
    nominal = np.array([v for v, _ in standard_parameters(model.machine).values()]) / _scales(model)
    shift = (X[kept] - estimate.value[kept]) / model.scale[kept]
    covariance = estimate.covariance[np.ix_(kept, kept)] / np.outer(model.scale[kept], model.scale[kept])
    cost = cp.sum_squares(_inverse_root(covariance) @ shift)
    far = pull * cp.sum_squares(scaled - nominal) if pull else 0.0
    problem = cp.Problem(cp.Minimize(cost + far), _possibility_constraints(model, by_name, INTERIOR_MARGIN))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an inaccurate solution, which the status tells as well
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    except cp.error.SolverError as err:
        raise NotConsistentError(f"no possible machine found near the estimate: {err}") from None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or X.value is None:
        raise NotConsistentError(f"no possible machine found near the estimate: the solver says {problem.status}")
    standard = {name: float(x.value) for name, x in by_name.items()}
    return kept, float(np.sqrt(max(cost.value, 0.0))), standard, np.asarray(X.value)


def is_possible(model: Model, X: np.ndarray) -> bool:
    """True if some possible machine has these base parameters (n_base,)."""
    _, by_name, base = _variables(model)
    equality = (base - X) / model.scale == 0
    problem = cp.Problem(cp.Minimize(0), [equality, *_possibility_constraints(model, by_name, 0.0)])
    problem.solve(solver=cp.CLARABEL)
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


def _variables(model: Model) -> tuple[cp.Variable, dict[str, cp.Expression], cp.Expression]:
    """Return scaled standard parameters, the same by name [SI], and the base parameters (n_base,) that they give."""
    scale = _scales(model)
    scaled = cp.Variable(len(scale))
    by_name = {name: scaled[k] * scale[k] for k, name in enumerate(standard_parameters(model.machine))}
    return scaled, by_name, (model.base.matrix * scale) @ scaled


def _possibility_constraints(model: Model, p: dict[str, cp.Expression], margin: float) -> list[cp.Constraint]:
    """Constraints of a possible machine on its standard parameters, with a margin relative to their nominal size."""
    nominal = {name: abs(value) for name, (value, _) in standard_parameters(model.machine).items()}
    constraints = [sign * p[name] >= margin * nominal[name] for name, sign in required_signs(model.machine).items()]
    for body in model.machine.body:
        k = body.index
        if body.inertia is not None:
            parameters = {name: p[f"{name}{k}"] for name in INERTIAL if f"{name}{k}" in p}
            if body.inertia.axisymmetric:
                parameters["YY"] = parameters["XX"]
            m, h, second = _pseudo_inertia(parameters)
            # A length scales the blocks (mass, moments, inertias) to one size.
            inertia = nominal.get(f"ZZ{k}", 0.0)
            length = float(np.sqrt(inertia / nominal[f"M{k}"])) if inertia > 0 else 1.0
            S = cp.bmat([[second / length**2, h / length], [h.T / length, cp.reshape(m, (1, 1), order="C")]])
            constraints.append(S / nominal[f"M{k}"] >> margin * np.eye(4))
    return constraints


def _pseudo_inertia(parameters: dict[str, cp.Expression]) -> tuple[cp.Expression, cp.Expression, cp.Expression]:
    """Mass, first moments (3, 1) and second moments (3, 3) = tr(I)/2 1 - I of a body; missing parameters are zero."""

    def at(name: str) -> cp.Expression:
        return parameters.get(name, cp.Constant(0.0))

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
    """Size of each standard parameter: its nominal value, or the base parameters' median scale if that is zero."""
    values = np.array([abs(v) for v, _ in standard_parameters(model.machine).values()])
    return np.where(values > 0, values, max(1.0, float(np.median(model.scale))))


def _inverse_root(covariance: np.ndarray) -> np.ndarray:
    """R with R'R = covariance^-1. No direction has less than 1e-7 of the largest standard deviation."""
    variance, v = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((v / np.sqrt(np.maximum(variance, 1e-14 * variance.max()))).T)
