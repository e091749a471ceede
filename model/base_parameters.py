"""Base parameters: the combinations of the standard parameters that motions show (Gautier, 1991)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from excite.errors import MachineError
from excite.model.machine import Machine
from excite.model.mechanics import independent_columns

INDEPENDENT = 1e-7  # least share of a regressor's column beyond those before it: lengths are rounded to 1e-7 m at most


@dataclass(frozen=True)
class BaseParameters:
    """The identifiable combinations of the standard parameters (Gautier, 1991).

    names, units (n_base): of the base parameters.
    independent (n_base): column of the standard parameter that stands for each base parameter.
    matrix (n_base, n_standard): base values = matrix @ standard values.
    invisible: standard parameters that no motion shows.
    standard (n_standard): names of the standard parameters.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    independent: tuple[int, ...]
    matrix: np.ndarray
    invisible: tuple[str, ...]
    standard: tuple[str, ...]

    @cached_property
    def expand(self) -> np.ndarray:
        """Map base values to standard values with the same motions (n_standard, n_base), all others zero."""
        matrix = np.zeros((len(self.standard), len(self.names)))
        matrix[list(self.independent), range(len(self.names))] = 1.0
        return matrix

    def grouping(self, name: str) -> dict[str, float]:
        """Return the standard parameters that make up a base parameter, with their coefficients."""
        row = self.matrix[self.names.index(name)]
        return {s: float(c) for s, c in zip(self.standard, row, strict=True) if c != 0}


def base_parameters(machine: Machine, W: ca.Function, p: np.ndarray, units: dict[str, str]) -> BaseParameters:
    """Find base parameters by QR of the standard regressor over random motions (Gautier, 1991).

    A column that depends on columns before it is grouped into them; coefficients are cleaned of rounding errors.
    Raises MachineError if no motion shows any parameter.
    """
    standard = tuple(units)
    n = len(machine.coordinates)
    rng = np.random.default_rng(0)
    samples = max(60, 2 * len(standard))
    q, nu, a = (rng.uniform(-1, 1, (n, samples)) for _ in range(3))
    flat = W(q, nu, a, p).full().reshape(n, samples, len(standard))
    A = np.asarray(np.linalg.qr(flat.transpose(1, 0, 2).reshape(-1, len(standard)), mode="r"))
    size = np.linalg.norm(A, axis=0)
    visible = np.flatnonzero(size > 1e-12 * size.max())
    A[:, visible] /= size[visible]
    kept, left = (visible[k] for k in independent_columns(A[:, visible], INDEPENDENT))
    matrix = np.zeros((len(standard), len(standard)))
    matrix[kept, kept] = 1.0
    shares = np.linalg.lstsq(A[:, kept], A[:, left], rcond=None)[0] * size[left] / size[kept, None]
    shares[(np.abs(shares) < 1e-9) | (kept[:, None] > left)] = 0.0
    matrix[np.ix_(kept, left)] = np.round(shares, 12)
    if not len(kept):
        raise MachineError(
            f"{machine.name}: no parameter can be seen in any motion, check the table and what is locked"
        )
    chosen = matrix[kept]
    names = tuple(
        machine.parameter_names.get(standard[j], standard[j] + ("R" if np.count_nonzero(row) > 1 else ""))
        for j, row in zip(kept, chosen, strict=True)
    )
    twice = sorted({s for s in names if names.count(s) > 1})
    if twice:
        raise MachineError(
            f"{machine.name}: parameter_names: two base parameters get the same name: {', '.join(twice)}"
        )
    return BaseParameters(
        names,
        tuple(units[standard[j]] for j in kept),
        tuple(kept.tolist()),
        chosen,
        tuple(name for j, name in enumerate(standard) if j not in visible),
        standard,
    )


def append_parameters(base: BaseParameters, magnitudes: Mapping[str, tuple[float, str, float]]) -> BaseParameters:
    """Append parameters of effects to the base parameters, each independent of all others."""
    n, k, m = len(base.names), len(base.standard), len(magnitudes)
    matrix = np.zeros((n + m, k + m))
    matrix[:n, :k], matrix[n:, k:] = base.matrix, np.eye(m)
    return BaseParameters(
        base.names + tuple(magnitudes),
        base.units + tuple(unit for _, unit, _ in magnitudes.values()),
        base.independent + tuple(range(k, k + m)),
        matrix,
        base.invisible,
        base.standard + tuple(magnitudes),
    )
