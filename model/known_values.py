"""Values known of a machine's parameters beforehand: a weighed mass, an inertia from CAD, an offset of zero.

Any quantity of the machine file may be `known`, exactly or with a standard deviation. Each one that is not known is
free; the combinations of base parameters that no free quantity changes are then known. They enter every estimate as
further observations. Source: Theil and Goldberger, "On pure and mixed statistical estimation in economics",
International Economic Review 2, 1961.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from excite.errors import MachineError
from excite.model.machine import Body, Machine, Quantity
from excite.model.mechanics import standard_inertia

EXACT_SHARE = 1e-4  # standard deviation of an exact quantity relative to the scale, for conditioning; chosen
NULL_TOLERANCE = 1e-9  # relative size below which a quantity leaves a combination unchanged; chosen
INERTIA_KEYS = ("XX", "XY", "XZ", "YY", "YZ", "ZZ")
JOINT_KEYS = {
    "drive": {"rotor_inertia": "Ia{}"},
    "friction": {"Fv": "Fv{}", "Fs": "Fs{}", "u0": "u{}0"},
    "contact": {"Kx": "Kx{}", "Ky": "Ky{}"},
}


@dataclass(frozen=True, eq=False)
class KnownValues:
    """Independent observations rows X = values + noise of unit variance, of the base parameters X.

    rows (k, n_base) [1/SI], values (k,). quantities: names of the m known quantities in the machine file.
    pull (m, k): maps values - rows X to the deviation of each quantity [its standard deviations].
    """

    rows: np.ndarray
    values: np.ndarray
    quantities: tuple[str, ...]
    pull: np.ndarray

    def __bool__(self) -> bool:
        return bool(len(self.values))

    def information(self, scale: np.ndarray) -> np.ndarray:
        """Return the information (n_base, n_base) about the base parameters over their scale (n_base,) [SI]."""
        by = self.rows * scale
        return np.asarray(by.T @ by)

    @cached_property
    def std(self) -> np.ndarray:
        """Standard deviation (n_base,) [SI] of each parameter before any log; NaN for one that is not known."""
        found = np.full(self.rows.shape[1], np.nan)
        size = np.linalg.norm(self.rows, axis=0)
        scaled = self.rows / np.where(size > 0, size, 1.0)
        for k in np.flatnonzero(size > 0):
            unit = np.eye(len(size))[k]
            combination = np.linalg.lstsq(scaled.T, unit, rcond=None)[0]
            if np.abs(scaled.T @ combination - unit).max() < 1e-6:
                found[k] = np.linalg.norm(combination) / size[k]
        return found

    def with_zeros(self, machine: Machine, names: Sequence[str]) -> KnownValues:
        """Add what is known of the encoder zeros that are sought; names (n_base)."""
        given = {n: s for n, s in machine.sought_zeros.items() if isinstance(s.zero, Quantity)}
        if not given:
            return self
        std = np.array([float(s.zero.known) for s in given.values() if isinstance(s.zero, Quantity)])
        rows = np.eye(len(names))[[names.index(n) for n in given]] / std[:, None]
        return KnownValues(
            np.concatenate([self.rows, rows]),
            np.concatenate([self.values, np.zeros(len(std))]),
            (*self.quantities, *(f"sensor.{s.name}.zero" for s in given.values())),
            scipy.linalg.block_diag(self.pull, np.eye(len(std))),
        )

    def with_amounts(self, machine: Machine, names: Sequence[str]) -> KnownValues:
        """Add what is known of the amounts of effects; names (n_base)."""
        given = {e.label: e.amount for e in machine.effect if not isinstance(e.amount.known, bool) and e.label in names}
        if not given:
            return self
        std = np.array([float(q.known) for q in given.values()])
        rows = np.eye(len(names))[[names.index(n) for n in given]] / std[:, None]
        return KnownValues(
            np.concatenate([self.rows, rows]),
            np.concatenate([self.values, np.array([float(q) for q in given.values()]) / std]),
            (*self.quantities, *(f"effect.{label}" for label in given)),
            scipy.linalg.block_diag(self.pull, np.eye(len(std))),
        )

    def extended(self, n: int) -> KnownValues:
        """Return the same for n further parameters, of which nothing is known."""
        return KnownValues(np.pad(self.rows, ((0, 0), (0, n))), self.values, self.quantities, self.pull)


def nothing_known(n_base: int) -> KnownValues:
    """Return the knowledge of a machine file that calls nothing known."""
    return KnownValues(np.zeros((0, n_base)), np.zeros(0), (), np.zeros((0, 0)))


def known_values(
    machine: Machine,
    names: Sequence[str],
    matrix: np.ndarray,
    standard: Sequence[str],
    nominal: np.ndarray,
    scale: np.ndarray,
) -> KnownValues:
    """Collect what a machine file calls known.

    names (n_base), matrix (n_base, n_standard), nominal, scale (n_base,): of the base parameters; standard: names of
    the standard parameters. Products of quantities are linearised at the file's values. Raises MachineError for a known
    base parameter that the machine doesn't have.
    """
    free, known, found = [], [], []
    for body in machine.body:
        for name, quantity_known, slope in _quantities(body):
            column = matrix @ np.array([slope.get(s, 0.0) for s in standard]) / scale
            if not quantity_known:
                free.append(column)
            else:
                known.append(column)
                found.append((name, 0.0 if quantity_known is True else float(quantity_known)))
    rows, values, pulls = [], [], []
    if known:
        N = _unchanged(np.array(free).reshape(len(free), len(names)))
        G = N.T @ np.array(known).T  # combinations by the known quantities
        size = np.linalg.norm(G, axis=0)
        seen = size > NULL_TOLERANCE
        given = np.array([s for _, s in found])
        std = np.where(given > 0, given, np.where(seen, EXACT_SHARE / np.where(seen, size, 1.0), 0.0))
        root = np.linalg.cholesky((G * std**2) @ G.T)
        own = scipy.linalg.solve_triangular(root, N.T, lower=True)
        own[np.abs(own) < NULL_TOLERANCE * np.abs(own).max(axis=1, keepdims=True)] = 0.0  # rounding
        own /= scale
        rows.append(own)
        values.append(own @ nominal)
        pulls.append(scipy.linalg.solve_triangular(root, G * std, lower=True).T)
    for name, quantity in machine.known.items():
        if name not in names:
            raise MachineError(f"{machine.name}: known.{name}: no base parameter, allowed: {', '.join(names)}")
        k = list(names).index(name)
        std_k = EXACT_SHARE * scale[k] if isinstance(quantity.known, bool) else float(quantity.known)
        row = np.eye(len(names))[k : k + 1] / std_k
        rows.append(row)
        values.append(row[:, k] * quantity.value)
        pulls.append(np.ones((1, 1)))
        found.append((f"known.{name}", std_k))
    if not rows:
        return nothing_known(len(names))
    return KnownValues(
        np.concatenate(rows), np.concatenate(values), tuple(n for n, _ in found), scipy.linalg.block_diag(*pulls)
    )


Slopes = dict[str, float]  # by standard parameter


def _unchanged(changes: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (n, r) of the combinations that no row of changes (m, n) alters."""
    size = np.linalg.norm(changes, axis=1)
    moving = changes[size > NULL_TOLERANCE] / size[size > NULL_TOLERANCE, None]
    return scipy.linalg.null_space(moving, rcond=NULL_TOLERANCE) if len(moving) else np.eye(changes.shape[1])


def _quantities(body: Body) -> Iterator[tuple[str, bool | float, Slopes]]:
    """Yield the quantities of a body that its standard parameters depend on.

    Each is name in the file, `known`, and derivative of the standard parameters by it.
    """
    k, where = body.index, f"body.{body.name}"
    for part, keys in JOINT_KEYS.items():
        table = getattr(body, part)
        for key, form in keys.items():
            if table is not None:
                quantity: Quantity = getattr(table, key)
                yield f"{where}.{part}.{key}", quantity.known, {form.format(k): 1.0}
    if body.spring is not None:
        stiffness, rest = body.spring.stiffness, body.spring.rest
        yield f"{where}.spring.stiffness", stiffness.known, {f"Ks{k}": 1.0, f"Ts{k}": float(rest)}
        yield f"{where}.spring.rest", rest.known, {f"Ts{k}": float(stiffness)}
        if body.spring.damping is not None:
            yield f"{where}.spring.damping", body.spring.damping.known, {f"Ds{k}": 1.0}
    if body.inertia is None:
        return
    for key in ("mass", "com.x", "com.y", "com.z", *INERTIA_KEYS):
        if body.inertia.axisymmetric and key not in ("mass", "XX", "ZZ"):
            continue
        yield f"{where}.inertia.{key}", *_inertia_slope(body, key)


def _inertia_slope(body: Body, key: str) -> tuple[bool | float, Slopes]:
    """Return `known` of a quantity of the inertia, and the derivative of the standard parameters by it.

    The standard parameters are quadratic in every quantity, so a central difference is exact.
    """
    assert body.inertia is not None
    sides = []
    for sign in (1.0, -1.0):
        if key.startswith("com."):
            point, axis = body.inertia.com, "xyz".index(key[-1])
            moved = tuple(v + sign * (i == axis) for i, v in enumerate(point.value))
            known: bool | float = point.known
            change = {"com": point.model_copy(update={"value": moved})}
        else:
            quantity = getattr(body.inertia, key)
            known = quantity.known
            change = {key: quantity.model_copy(update={"value": quantity.value + sign})}
        sides.append(standard_inertia(body.model_copy(update={"inertia": body.inertia.model_copy(update=change)})))
    up, down = sides
    return known, {name: (up[name] - down[name]) / 2 for name in up}
