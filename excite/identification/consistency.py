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
from excite.text import format_number

INTERIOR_MARGIN = 1e-6  # distance from the constraints, of a parameter's scale; keeps the mass matrix invertible
NOTABLE_SHIFT = 1e-3  # smallest shift that is reported [standard deviations]; chosen
SAME_TORQUES = 1e-3  # of their size (rms), by which two machines may differ and count as the same
RANDOM_MOTIONS = 300  # over which torques are compared


def nearest_possible(model: Model, estimate: Estimate) -> Estimate:
    """Return the possible parameters nearest to an estimate, in the metric of its covariance.

    For least squares this minimises |Y - W X| over all possible machines. Unidentifiable parameters stay
    unidentifiable, but some possible value must exist for them. Standard deviations are those of the estimate, an upper
    bound at an active constraint. The residual is not recomputed (see `constrained_estimate`). Raises
    NotConsistentError.
    """
    distance, X = _nearest(model, estimate)
    kept = _identified(estimate)
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


def possible_standard(model: Model, estimate: Estimate) -> tuple[dict[str, float], str | None]:
    """Return the standard parameters [SI] by name of a possible machine with the estimated torques, and a note.

    Of all machines with the estimated base parameters, it is the nearest to the machine file, relative to the size of
    each parameter; if none is possible, of those hardly further from the estimate than the nearest one. If torques of a
    joint differ from the estimated ones, the note says of which and how much; otherwise it is None. Raises
    NotConsistentError.
    """
    distance, _ = _nearest(model, estimate)
    scaled, by_name, base = _variables(model)
    nominal = np.array([v for v, _ in standard_parameters(model.machine).values()]) / _scales(model)
    kept = _identified(estimate)
    size = np.abs(model.base.matrix * _scales(model)).max(axis=1)
    same = (base[kept] - estimate.value[kept]) / size[kept] == 0
    # half the margin, and hardly further: the nearest machine lies inside, as the solver needs it
    near = cp.norm(_shift(model, estimate, base)) <= distance + NOTABLE_SHIFT * (1 + distance)
    possible = _possibility_constraints(model, by_name, INTERIOR_MARGIN / 2)
    for goal in (same, near) if distance < NOTABLE_SHIFT else (near,):
        if _solved(cp.Problem(cp.Minimize(cp.norm(scaled - nominal)), [goal, *possible])):
            break
    else:
        raise NotConsistentError("no possible machine found near the estimate")
    standard = {name: float(x.value) for name, x in by_name.items()}
    wanted = np.where(np.isfinite(estimate.value), estimate.value, np.asarray(base.value))
    gaps = _torque_gaps(model, np.asarray(base.value), wanted)
    if max(gaps.values()) < SAME_TORQUES:
        return standard, None
    worst = ", ".join(f"{format_number(100 * x, 2)} % in {q}" for q, x in gaps.items() if x >= SAME_TORQUES)
    return standard, (
        f"no real machine has the identified values: the nearest possible one is written, {distance:.1f} standard"
        f" deviations away; its torques differ by {worst} (rms over random motions)"
    )


def _torque_gaps(model: Model, X: np.ndarray, wanted: np.ndarray) -> dict[str, float]:
    """Return by coordinate how far torques of base parameters X (n_base,) are from those wanted, of their rms.

    The larger gap of two: torques of the bodies, and those of friction and all else, which would hide light bodies.
    """
    rng = np.random.default_rng(0)
    n = len(model.coordinates)
    beside = [np.zeros((x.numel(), RANDOM_MOTIONS)) for x in model.effect_symbols()]
    W = model.stacked_regressor(*rng.uniform(-1, 1, (3, n, RANDOM_MOTIONS)), *beside)
    bodies = [model.base.standard[k].rstrip("0123456789") in INERTIAL for k in model.base.independent]
    gaps = np.zeros(n)
    for part in (np.array(bodies), ~np.array(bodies)):
        gap, size = (np.linalg.norm(W[:, :, part] @ x[part], axis=0) for x in (X - wanted, wanted))
        gaps = np.maximum(gaps, gap / np.maximum(size, max(1e-9 * size.max(), np.finfo(float).tiny)))  # not rounding
    return dict(zip(model.coordinates, gaps.tolist(), strict=True))


def _nearest(model: Model, estimate: Estimate) -> tuple[float, np.ndarray]:
    """Return the distance [standard deviations] and base parameters of the possible machine nearest to an estimate."""
    _, by_name, X = _variables(model)
    cost = cp.sum_squares(_shift(model, estimate, X))
    problem = cp.Problem(cp.Minimize(cost), _possibility_constraints(model, by_name, INTERIOR_MARGIN))
    if not _solved(problem) or X.value is None:
        raise NotConsistentError("no possible machine found near the estimate")
    return float(np.sqrt(max(cost.value, 0.0))), np.asarray(X.value)


def _identified(estimate: Estimate) -> np.ndarray:
    """Return the indices of the parameters that were identified."""
    return np.flatnonzero(np.isfinite(estimate.value) & np.isfinite(estimate.std))


def _shift(model: Model, estimate: Estimate, X: cp.Expression) -> cp.Expression:
    """Return how far identified parameters are from base parameters X [standard deviations, uncorrelated]."""
    kept = _identified(estimate)
    covariance = estimate.covariance[np.ix_(kept, kept)] / np.outer(model.scale[kept], model.scale[kept])
    shift: cp.Expression = _inverse_root(covariance) @ ((X[kept] - estimate.value[kept]) / model.scale[kept])
    return shift


def _solved(problem: cp.Problem, tolerance: float = 1e-10) -> bool:
    """Solve a convex program; return whether it has a solution."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an inaccurate solution, which the status tells as well
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=tolerance)
    except cp.error.SolverError:
        return False
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


def is_possible(model: Model, X: np.ndarray) -> bool:
    """True if some possible machine has these base parameters (n_base,)."""
    _, by_name, base = _variables(model)
    equality = (base - X) / model.scale == 0
    problem = cp.Problem(cp.Minimize(0), [equality, *_possibility_constraints(model, by_name, 0.0)])
    return _solved(problem, tolerance=1e-8)


def _variables(model: Model) -> tuple[cp.Variable, dict[str, cp.Expression], cp.Expression]:
    """Return scaled standard parameters, the same by name [SI], and the base parameters (n_base,) that they give."""
    scale = _scales(model)
    scaled = cp.Variable(len(scale))
    by_name = {name: scaled[k] * scale[k] for k, name in enumerate(standard_parameters(model.machine))}
    return scaled, by_name, (model.base.matrix * scale) @ scaled


def _possibility_constraints(model: Model, p: dict[str, cp.Expression], margin: float) -> list[cp.Constraint]:
    """Constraints of a possible machine on its standard parameters, with a margin relative to their nominal size."""
    size = dict(zip(p, _scales(model), strict=True))
    constraints = [sign * p[name] >= margin * size[name] for name, sign in required_signs(model.machine).items()]
    for body in model.machine.body:
        k = body.index
        if body.inertia is not None:
            parameters = {name: p[f"{name}{k}"] for name in INERTIAL if f"{name}{k}" in p}
            if body.inertia.axisymmetric:
                parameters["YY"] = parameters["XX"]
            m, h, second = _pseudo_inertia(parameters)
            # A length scales the blocks (mass, moments, inertias) to one size.
            mass = size[f"M{k}"]
            length = float(np.sqrt(size[f"ZZ{k}"] / mass))
            S = cp.bmat([[second / length**2, h / length], [h.T / length, cp.reshape(m, (1, 1), order="C")]])
            constraints.append(S / mass >> margin * np.eye(4))
    return constraints


def _pseudo_inertia(parameters: dict[str, cp.Expression]) -> tuple[cp.Expression, cp.Expression, cp.Expression]:
    """Mass, first moments (3, 1) and second moments (3, 3) = tr(I)/2 1 - I of a body; missing parameters are zero."""

    def at(name: str) -> cp.Expression:
        return parameters.get(name, cp.Constant(0.0))

    xx, yy, zz = at("XX"), at("YY"), at("ZZ")
    half = (xx + yy + zz) / 2
    second = cp.bmat(
        [[half - xx, -at("XY"), -at("XZ")], [-at("XY"), half - yy, -at("YZ")], [-at("XZ"), -at("YZ"), half - zz]]
    )
    h = cp.reshape(cp.hstack([at("MX"), at("MY"), at("MZ")]), (3, 1), order="C")
    return at("M"), h, second


def _scales(model: Model) -> np.ndarray:
    """Return a size of each standard parameter, from what the machine file says of the whole body.

    A first moment or product of inertia near zero has the size that a body of that mass and radius of gyration may
    have; a body without mass has the sizes of the others.
    """
    table = {name: value for name, (value, _) in standard_parameters(model.machine).items()}
    usual = max(1.0, float(np.median(model.scale)))
    size = {name: abs(value) or usual for name, value in table.items()}
    bodies = [b.index for b in model.machine.body if b.inertia is not None]
    masses = {k: table[f"M{k}"] for k in bodies}
    around = {k: sum(table.get(f"{n}{k}", 0.0) for n in ("XX", "YY", "ZZ")) for k in bodies}
    lengths = {k: np.sqrt(around[k] / masses[k]) for k in bodies if masses[k] > 0 and around[k] > 0}
    mass = float(np.median([m for m in masses.values() if m > 0] or [1.0]))
    length = float(np.median(list(lengths.values()) or [1.0]))
    for k in bodies:
        m, reach = masses[k] or mass, float(lengths.get(k, length))
        for name in INERTIAL:
            if f"{name}{k}" in size:
                size[f"{name}{k}"] = m * reach ** {"M": 0, "MX": 1, "MY": 1, "MZ": 1}.get(name, 2)
    return np.array(list(size.values()))


def _inverse_root(covariance: np.ndarray) -> np.ndarray:
    """R with R'R = covariance^-1. No direction has less than 1e-7 of the largest standard deviation."""
    variance, v = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((v / np.sqrt(np.maximum(variance, 1e-14 * variance.max()))).T)
