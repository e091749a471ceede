"""Fit the catalogue's contact laws to a single-wheel test, and weigh them by settings left out of the fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import casadi as ca
import numpy as np
import scipy.optimize
from scipy.special import expit

from excite.errors import NotIdentifiableError
from excite.logs import SlipTable
from excite.model import mechanics
from excite.model.effects import CATALOGUE, ContactMotion, SampleView, Soil
from excite.model.machine import Contact, Quantity

LARGEST_SATURATION = 30.0  # saturation slip over the largest slip, above which the law is linear here; chosen
MIN_STDS = 2.0  # least traction per slip, in its standard deviations; chosen
MIN_SHARE = 1e-3  # least traction per slip, as a share of the largest traction; chosen
RULED_OUT = 0.05  # chance against the best law, below which a law is ruled out; chosen
DRAWS = 2000  # Bayesian bootstrap; chosen
FTOL = 1e-6  # relative change of the sum of squares at which a fit ends; chosen
FOLDS = 16  # parts that settings are divided into, each left out once; fewer settings are left out singly; chosen
LOADS_DIFFER = 0.5  # range of loads over their mean, from which stiffness may depend on load; chosen
BOTH_WAYS = 0.02  # slip that driving and braking must both reach for their laws to differ; chosen
BEND = {"exponential": 0.0, "hyperbolic": 1.0}

Choice = tuple[str, tuple[tuple[str, float], ...]]  # an effect, and its shapes other than default


@dataclass(frozen=True, eq=False)
class SlipLaw:
    """A contact law and its fit to a table.

    effects: of the catalogue, on top of the linear law. by_load: stiffness goes with load, Kx, Ky at the mean load.
    parameters: name -> (value, standard deviation), the latter None at a bound. units: of each.
    rms_fitted, rms_left_out [N]: errors of the mean forces of settings, in the fit and left out of it.
    left_out (settings, forces) [N]: the latter, setting by setting.
    chance: probability that it predicts new settings better than the law with the smallest left-out error; 0.5 is as
        well.
    """

    name: str
    effects: tuple[Choice, ...]
    by_load: bool
    parameters: Mapping[str, tuple[float, float | None]]
    units: Mapping[str, str]
    rms_fitted: float
    rms_left_out: float
    left_out: np.ndarray
    chance: float = 0.5

    @property
    def parts(self) -> frozenset[object]:
        """The law's additions to the linear one."""
        return frozenset((*self.effects, *(("by load",) if self.by_load else ())))

    def forces(self, table: SlipTable) -> np.ndarray:
        """Return the forces (N, forces) [N] of the law at the rows of a table: traction, and side force if fitted."""
        fitted = _Fitting(self.effects, self.by_load, table, "Ky" in self.parameters)
        return fitted.forces(np.array([v for v, _ in self.parameters.values()]))


@dataclass(frozen=True)
class SlipFit:
    """Contact laws fitted to a single-wheel test.

    laws: best prediction of settings left out first. supported: the simplest laws that the data do not rule out; one
    is named by the data, several cannot be told apart by it. repeatability [N]: standard deviation of repeats by force.
    mean_load [N] or None: at which Kx, Ky hold.
    """

    table: SlipTable
    laws: tuple[SlipLaw, ...]
    supported: tuple[SlipLaw, ...]
    repeatability: Mapping[str, float | None]
    mean_load: float | None

    @property
    def named(self) -> SlipLaw | None:
        """The law that the data name, None if several tie."""
        return self.supported[0] if len(self.supported) == 1 else None


def fit_slip_laws(table: SlipTable) -> SlipFit:
    """Fit every law that the table can show, and weigh them by the forces of settings that were left out.

    A law's score is that of its errors on settings left out, as normal ones of unknown size; its chance against the
    best law is the mean over a Bayesian bootstrap of the settings (pseudo-BMA+: Yao et al., Bayesian Analysis 13,
    2018). Laws of a chance above 0.05 are supported, without those that add effects to another such law.
    Raises NotIdentifiableError if there are fewer settings than parameters of the linear law, or if in the simplest
    supported law a force does not grow with its slip.
    """
    sided = "side" in table.forces and float(np.ptp(table.Vy / table.norm)) > BOTH_WAYS
    levels = int(table.level.max()) + 1
    laws = []
    for effects, by_load in _candidates(table, sided):
        fitting = _Fitting(effects, by_load, table, sided)
        if len(fitting.names) < levels - 1:
            laws.append(_fit(fitting, effects, by_load, levels))
    if not laws:
        raise NotIdentifiableError(f"{table.source}: {levels} settings are too few for any law")
    laws.sort(key=lambda law: law.rms_left_out)
    laws = [replace(law, chance=_chance(law.left_out, laws[0].left_out)) for law in laws]
    _require_stiffness(table, _supported(laws)[0])
    load = None if table.load is None else float(np.mean(table.load))
    return SlipFit(table, tuple(laws), _supported(laws), _repeatability(table), load)


def _require_stiffness(table: SlipTable, law: SlipLaw) -> None:
    """Raise NotIdentifiableError if a force of a law does not grow with its slip."""
    for name, role, slip in (("Kx", "traction", "slip"), ("Ky", "side", "the lateral motion")):
        if name not in law.parameters:
            continue
        largest = float(np.abs(table.forces[role]).max())
        stiffness, std = law.parameters[name]
        if largest > 0 and abs(stiffness) >= max(MIN_SHARE * largest, MIN_STDS * (std or 0.0)):
            continue
        force = "traction" if role == "traction" else "side force"
        raise NotIdentifiableError(
            f"{table.source}: the {force} {'does not grow with ' + slip if largest > 0 else 'is 0 in every row'}, so"
            f" there is no contact law: is it the right column ({role}=COLUMN)?"
            f" {'; '.join(n for n in table.notes if n.startswith('columns'))}"
        )


def soil_law(table: SlipTable, soil: mechanics.SoilConstants) -> SlipLaw:
    """Return the law that a soil's constants give (18), with its errors on a table, on which nothing is fitted."""
    sided = "side" in table.forces
    stiffness = {"Kx": soil.stiffness, **({"Ky": soil.stiffness} if sided else {})}
    effects: tuple[Choice, ...] = (("shear_saturation", ()),)
    values = {**stiffness, "shear_saturation": soil.saturation_slip}
    fitting = _Fitting(effects, False, table, sided)
    p = np.array(list(values.values()))
    errors = np.stack([_mean_errors(fitting, p, table.level == k) for k in range(int(table.level.max()) + 1)])
    units = {n: "-" if n == "shear_saturation" else "N" for n in values}
    given = {n: (v, None) for n, v in values.items()}
    return SlipLaw("soil constants (18)", effects, False, given, units, _rms(errors), _rms(errors), errors)


def _supported(laws: Sequence[SlipLaw]) -> tuple[SlipLaw, ...]:
    kept = [law for law in laws if law.chance > RULED_OUT]
    return tuple(law for law in kept if not any(other.parts < law.parts for other in kept))


def _chance(errors: np.ndarray, best: np.ndarray) -> float:
    """Return the probability that a law predicts better than another, from errors (settings, forces) left out."""
    squares = np.stack([(e**2).sum(axis=1) for e in (errors, best)])
    weights = np.random.default_rng(0).dirichlet(np.ones(squares.shape[1]), DRAWS)
    floor = 1e-12 * float(squares.max()) + 1e-300
    score = -squares.shape[1] / 2 * np.log(weights @ squares.T + floor)
    return float(expit(score[:, 0] - score[:, 1]).mean())


def _repeatability(table: SlipTable) -> dict[str, float | None]:
    """Return the pooled standard deviation of repeats [N] by force, None where no setting was repeated."""
    found: dict[str, float | None] = {}
    counts = np.bincount(table.level)
    for role, force in table.forces.items():
        mean = np.bincount(table.level, force) / counts
        free = int((counts - 1).sum())
        found[role] = float(np.sqrt(np.sum((force - mean[table.level]) ** 2) / free)) if free else None
    return found


def _candidates(table: SlipTable, sided: bool) -> list[tuple[tuple[Choice, ...], bool]]:
    """Return the laws that a table can show: effects, and whether stiffness goes with load."""
    kinds: list[tuple[Choice, ...]] = [(), *((("shear_saturation", _bend(b)),) for b in BEND.values())]
    if sided:
        kinds += [(("lateral_saturation", _bend(b)),) for b in BEND.values()]
    both = table.slip.max() > BOTH_WAYS and table.slip.min() < -BOTH_WAYS
    asymmetry: list[tuple[Choice, ...]] = [(), (("drive_brake_asymmetry", ()),)] if both else [()]
    constant: list[tuple[Choice, ...]] = [(), (("rolling_resistance", ()),)]
    loads = [False]
    if table.load is not None and np.ptp(table.load) > LOADS_DIFFER * np.mean(table.load):
        loads.append(True)
    return [((*a, *b, *c), w) for a, b, c, w in product(kinds, asymmetry, constant, loads)]


def _bend(value: float) -> tuple[tuple[str, float], ...]:
    return (("bend", value),) if value else ()


def law_name(effects: Sequence[Choice], by_load: bool) -> str:
    """Name a law in words."""
    words = {"drive_brake_asymmetry": "drive-brake asymmetry", "rolling_resistance": "constant force"}
    forms = {name: "hyperbolic" if dict(shapes).get("bend") else "exponential (18)" for name, shapes in effects}
    first = forms.get("shear_saturation", "linear")
    rest = [
        f"{forms[n]} lateral force" if n == "lateral_saturation" else words[n] for n in forms if n != "shear_saturation"
    ]
    return " + ".join((first, *rest)) + (", Kx as load" if by_load else "")


def _quantity(value: float) -> Quantity:
    return Quantity(value=value, source="definition")


# Slips are given to the law directly, so that neither radius nor v_eps of this contact matters.
_UNIT = Contact(radius=_quantity(1), width=_quantity(1), v_eps=_quantity(1), Kx=_quantity(-1), Ky=_quantity(-1))


@lru_cache(maxsize=64)
def _law(effects: tuple[Choice, ...], sided: bool) -> tuple[ca.Function, ca.Function]:
    """Build the forces [N] at (Vx, Vy, rim, norm, load share), parameters, and their Jacobian."""
    Vx, Vy, rim, norm, share = row = [ca.SX.sym(n) for n in ("Vx", "Vy", "rim", "norm", "share")]
    p = ca.SX.sym("p", 1 + sided + len(effects))
    Ky = p[1] if sided else p[0]
    motion = ContactMotion(_UNIT, Vx, Vy, rim, ca.SX(0))
    soil = Soil(mechanics.Slip((Vx - rim) / norm, Vy / norm, norm), ca.SX(0), p[0] * share, Ky * share)
    none: dict[int, ca.SX] = {}
    scene = SampleView(none, none, none, none, none, {}, none, {}, {1: motion}, none, none, ca.SX(0))
    pushed = [ca.SX(0), ca.SX(0)]
    for k, (name, given) in enumerate(effects):
        effect = CATALOGUE[name]
        shapes = {s: x.default for s, x in effect.shapes.items()} | dict(given)
        shapes |= {"soft": 1e-6} if "soft" in shapes else {}  # steady motion, never near standstill
        values = {"A": p[1 + sided + k]} | {s: ca.SX(x) for s, x in shapes.items()}
        if effect.soil is not None:
            soil = effect.soil(scene, 1, values, soil)
        if effect.push is not None:
            pushed = [a + b for a, b in zip(pushed, effect.push(scene, 1, values), strict=True)]
    wrench = soil.wrench(_UNIT)
    out = ca.vertcat(wrench.Sx + pushed[0], *([wrench.Sy + pushed[1]] if sided else []))
    x = ca.vertcat(*row)
    return ca.Function("law", [x, p], [out]), ca.Function("slope", [x, p], [ca.jacobian(out, p)])


class _Fitting:
    """Least squares of one law on the rows of a table."""

    def __init__(self, effects: tuple[Choice, ...], by_load: bool, table: SlipTable, sided: bool) -> None:
        self.names = ("Kx", *(("Ky",) if sided else ()), *(name for name, _ in effects))
        share = np.ones(len(table.rim))
        if by_load and table.load is not None:
            share = table.load / np.mean(table.load)
        self.rows = np.stack([table.Vx, table.Vy, table.rim, table.norm, share])
        self.measured = np.stack([table.forces[k] for k in ("traction", "side")[: 1 + sided]], axis=1)
        self.level = table.level
        self.law, self.slope = _law(effects, sided)
        size = max(float(np.abs(self.measured).max()), 1e-9)
        slip = max(float((np.hypot(self.rows[0] - self.rows[2], self.rows[1]) / self.rows[3]).max()), 1e-9)
        first = {"rolling_resistance": 0.1 * size, "drive_brake_asymmetry": 0.3}
        effect = [CATALOGUE[n] for n in self.names[1 + sided :]]
        magnitudes = [first.get(e.name, 0.3 * slip if e.inverse else 1.0) for e in effect]
        self.size = np.array([size / slip] * (1 + sided) + magnitudes)
        self.first = np.array([-size / slip] * (1 + sided) + magnitudes)
        self.low = np.array([-np.inf] * (1 + sided) + [1e-3 * slip if e.positive else -np.inf for e in effect])
        self.high = np.array([0.0] * (1 + sided) + [LARGEST_SATURATION * slip if e.inverse else np.inf for e in effect])

    def forces(self, p: np.ndarray, at: np.ndarray | slice = slice(None)) -> np.ndarray:
        rows = self.rows[:, at]
        return np.asarray(self.law(rows, np.repeat(p[:, None], rows.shape[1], 1)).full()).T

    def solve(self, at: np.ndarray, starts: Sequence[np.ndarray]) -> scipy.optimize.OptimizeResult:
        rows = self.rows[:, at]

        def error(p: np.ndarray) -> np.ndarray:
            return (self.forces(p, at) - self.measured[at]).ravel()

        def slope(p: np.ndarray) -> np.ndarray:
            wide = self.slope(rows, np.repeat(p[:, None], rows.shape[1], 1)).full()
            return np.asarray(wide.reshape(wide.shape[0], rows.shape[1], len(p)).transpose(1, 0, 2).reshape(-1, len(p)))

        inside = [np.clip(s, self.low + 1e-9 * self.size, self.high - 1e-9 * self.size) for s in starts]
        bounds = (self.low, self.high)
        found = [scipy.optimize.least_squares(error, s, slope, bounds, x_scale=self.size, ftol=FTOL) for s in inside]
        return min(found, key=lambda r: float(r.cost))


def _fit(fitting: _Fitting, effects: tuple[Choice, ...], by_load: bool, levels: int) -> SlipLaw:
    every = np.full(fitting.rows.shape[1], True)
    best = fitting.solve(every, [fitting.first * s for s in (0.5, 2.0)])
    fold = fitting.level % min(levels, FOLDS)
    rest = [fitting.solve(fold != k, [best.x]).x for k in range(fold.max() + 1)]
    left_out = np.stack([_mean_errors(fitting, rest[k % len(rest)], fitting.level == k) for k in range(levels)])
    fitted = np.stack([_mean_errors(fitting, best.x, fitting.level == k) for k in range(levels)])
    bound = (best.x >= fitting.high - 1e-3 * fitting.size) | (best.x <= fitting.low + 1e-3 * fitting.size)
    std = [None if b else float(s) for s, b in zip(_deviations(fitting, best, levels), bound, strict=True)]
    units = {"Kx": "N", "Ky": "N"} | {name: CATALOGUE[name].unit for name, _ in effects}
    return SlipLaw(
        law_name(effects, by_load),
        effects,
        by_load,
        dict(zip(fitting.names, zip(map(float, best.x), std, strict=True), strict=True)),
        {n: units[n] for n in fitting.names},
        _rms(fitted),
        _rms(left_out),
        left_out,
    )


def _mean_errors(fitting: _Fitting, p: np.ndarray, at: np.ndarray) -> np.ndarray:
    return (fitting.forces(p, at) - fitting.measured[at]).mean(axis=0)


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _deviations(fitting: _Fitting, best: scipy.optimize.OptimizeResult, levels: int) -> np.ndarray:
    """Return standard deviations, with errors that the rows of one setting share (sandwich by setting)."""
    forces = fitting.measured.shape[1]
    J, e = best.jac, best.fun
    level = np.repeat(fitting.level, forces)
    bread = np.linalg.pinv(J.T @ J)
    pieces = np.stack([J[level == k].T @ e[level == k] for k in range(levels)])
    covariance = bread @ (pieces.T @ pieces) @ bread * levels / max(levels - len(best.x), 1)
    return np.sqrt(np.maximum(np.diag(covariance), 0))
