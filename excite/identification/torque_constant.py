"""Find an unknown torque constant from a known load.

Torques in amperes, volts or duty cycles give every parameter divided by the torque per such unit, k. What the machine
file calls known in SI units, such as a weighed mass on an arm of known length, then gives k: with x = X / k estimated
with covariance C, and rows A X = b + noise of unit variance, the residual b - k A x has the covariance I + k^2 A C A'.
k minimises its weighted square (generalised least squares with errors in the variables).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from excite.identification.estimate import Estimate
from excite.model import Model

ITERATIONS = 50  # of the weights, which depend on the constant
LEAST_SHARE = 4.0  # standard deviations that a known load must show in the estimate to give the constant


@dataclass(frozen=True)
class TorqueConstant:
    """Torque of a motor per ampere, volt or duty cycle, before its gear: value, std and 95 % interval in `unit`.

    known: quantities of the machine file that it follows from. p_value: that they agree on it, NaN for a single one.
    """

    value: float
    std: float
    interval95: tuple[float, float]
    unit: str
    known: tuple[str, ...]
    p_value: float


def torque_constant(model: Model, estimate: Estimate) -> TorqueConstant | None:
    """Return the unknown torque constant of a machine whose file calls a load known, None if nothing shows it."""
    machine, known = model.machine, model.calibration
    unidentified = ~np.isfinite(estimate.value) | ~np.isfinite(estimate.std)
    usable = ~(known.rows[:, unidentified] != 0).any(axis=1) if known else np.zeros(0, bool)
    if machine.torque_unit is None or not usable.any():
        return None
    A = np.where(unidentified, 0.0, known.rows)[usable]
    b, x = known.values[usable], np.nan_to_num(estimate.value)
    C = A @ np.nan_to_num(estimate.covariance) @ A.T
    y = A @ x
    loads = np.flatnonzero(b)
    if not len(loads) or not y @ b or (np.abs(y[loads]) < LEAST_SHARE * np.sqrt(np.diag(C)[loads])).all():
        return None
    k = float(b @ y / (y @ y))
    for _ in range(ITERATIONS):
        weight = np.linalg.inv(np.eye(len(b)) + k**2 * C)
        before, k = k, float(y @ weight @ b / (y @ weight @ y))
        if abs(k - before) < 1e-12 * abs(k):
            break
    std = float(1 / np.sqrt(y @ weight @ y))
    misfit = float((b - k * y) @ weight @ (b - k * y))
    names = tuple(n for n, pull in zip(known.quantities, known.pull[:, usable], strict=True) if pull.any())
    turns = machine.actuated[0].joint == "revolute"
    return TorqueConstant(
        k,
        std,
        (k - estimate.quantile95 * std, k + estimate.quantile95 * std),
        f"{'N m' if turns else 'N'}" + ("" if machine.torque_unit == "1" else f"/{machine.torque_unit}"),
        names,
        float(scipy.stats.chi2.sf(misfit, len(b) - 1)) if len(b) > 1 else np.nan,
    )
