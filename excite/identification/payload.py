"""Inertia of a payload from two estimates of one machine, with the payload and without it.

A rigid payload on a body adds its ten inertial parameters, in that body's frame, to those of the body. The difference
of the base parameters is then linear in them. Source: Khalil, Gautier and Lemoine, "Identification of the payload
inertial parameters of industrial manipulators", IEEE ICRA, 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from excite.errors import UsageError
from excite.identification.estimate import Estimate
from excite.model import Model, standard_parameters
from excite.model.mechanics import INERTIAL, independent_columns

CLEAR_STDS = 2.0  # standard deviations of the mass, below which the centre is anywhere; chosen
RANK_TOLERANCE = 1e-9  # relative size below which a parameter of the payload is a combination of others


@dataclass(frozen=True)
class Payload:
    """Identifiable inertial parameters of a payload in the frame of the body that carries it.

    names, units (m,); value (m,), covariance (m, m) [SI]. groups: the standard parameters that make up each, with
    their coefficients. centre, centre_std (3,) [m]: centre of mass, None if mass and first moments are not all
    identifiable, or the mass is not clearly above zero. p_value: that the other parameters did not change between the
    two estimates, NaN without redundancy.
    """

    body: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray
    groups: tuple[dict[str, float], ...]
    centre: np.ndarray | None
    centre_std: np.ndarray | None
    p_value: float

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (m,) [SI]."""
        return np.sqrt(np.diag(self.covariance))


def payload_parameters(model: Model, loaded: Estimate, unloaded: Estimate) -> Payload:
    """Return the payload on the last body of a machine by generalised least squares.

    loaded, unloaded: independent estimates of the same machine file. Friction and offsets may differ between them, and
    all other parameters may not. Raises UsageError for estimates of different parameters, or without a common one that
    a payload changes.
    """
    if loaded.names != unloaded.names:
        raise UsageError("--unloaded: holds an estimate of other parameters; identify both with the same machine file")
    body = model.machine.body[-1]
    if body.inertia is None or body.inertia.axisymmetric:
        raise UsageError(f"--unloaded: the last body, {body.name}, carries the payload and needs a full inertia")
    told = np.isfinite(loaded.std) & np.isfinite(unloaded.std)
    rows = [k for k in rigid_parameters(model) if told[k]]
    G = payload_change(model)[rows]
    if not G.any():
        raise UsageError("--unloaded: no parameter that a payload changes is identified from both sets of logs")
    kept, left = told_apart(G)
    groups = [{INERTIAL[k]: 1.0} for k in kept]
    for j in left:
        for k, share in enumerate(np.linalg.lstsq(G[:, kept], G[:, j], rcond=None)[0]):
            if abs(share) > RANK_TOLERANCE:
                groups[k][INERTIAL[j]] = float(share)
    C = (loaded.covariance + unloaded.covariance)[np.ix_(rows, rows)]
    scale = np.sqrt(np.diag(C))
    root = np.linalg.cholesky(C / np.outer(scale, scale))
    A = scipy.linalg.solve_triangular(root, G[:, kept] / scale[:, None], lower=True)
    d = scipy.linalg.solve_triangular(root, (loaded.value - unloaded.value)[rows] / scale, lower=True)
    value = np.linalg.lstsq(A, d, rcond=None)[0]
    covariance = np.linalg.inv(A.T @ A)
    spare = len(d) - len(kept)
    names = [INERTIAL[k] for k in kept]
    table = standard_parameters(model.machine)
    centre, centre_std = _centre(names, groups, value, covariance)
    return Payload(
        body.name,
        tuple(n + ("R" if len(g) > 1 else "") for n, g in zip(names, groups, strict=True)),
        tuple(table[f"{n}{body.index}"][1] for n in names),
        value,
        covariance,
        tuple(groups),
        centre,
        centre_std,
        float(scipy.stats.chi2.sf(np.sum((d - A @ value) ** 2), spare)) if spare else np.nan,
    )


def payload_change(model: Model) -> np.ndarray:
    """Return the change (n_base, 10) of the base parameters by each parameter of a payload on the last body."""
    last = model.machine.body[-1].index
    return np.asarray(model.base.matrix[:, [model.base.standard.index(f"{n}{last}") for n in INERTIAL]])


def rigid_parameters(model: Model) -> tuple[int, ...]:
    """Return the base parameters that friction and sensors leave alone, in which no more than a payload differs."""
    names = {f"{n}{b.index}" for b in model.machine.body for n in (*INERTIAL, "Ia")}
    return tuple(k for k, j in enumerate(model.base.independent) if model.base.standard[j] in names)


def told_apart(change: np.ndarray) -> tuple[list[int], list[int]]:
    """Return the inertial parameters of a payload that a change (rows, 10) tells apart, and the others."""
    size = np.linalg.norm(change, axis=0)
    return independent_columns(change / np.where(size > 0, size, 1.0), RANK_TOLERANCE)


def _centre(
    names: list[str], groups: list[dict[str, float]], value: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the centre of mass (3,) [m] and its standard deviation, None if it is not identifiable."""
    wanted = ("M", "MX", "MY", "MZ")
    if any(n not in names or len(groups[names.index(n)]) > 1 for n in wanted):
        return None, None
    at = [names.index(n) for n in wanted]
    mass, moments = value[at[0]], value[at[1:]]
    if mass < CLEAR_STDS * np.sqrt(covariance[at[0], at[0]]):
        return None, None
    slope = np.column_stack([-moments / mass**2, np.eye(3) / mass])
    return moments / mass, np.sqrt(np.diag(slope @ covariance[np.ix_(at, at)] @ slope.T))
