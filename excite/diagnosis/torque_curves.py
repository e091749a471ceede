"""Smooth curves of the torques that no effect explains, of a machine diagnosed by regression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from excite.diagnosis.curves import FUNCTIONS, Curve, curve_points, relative_std, spline_basis, table_nodes
from excite.diagnosis.hold_out import HoldOutErrors, hold_out_gain, torque_names
from excite.diagnosis.selection import ProgressCallback, identified_entry
from excite.diagnosis.torque_fit import Term, TorqueFit, normalise
from excite.diagnosis.torque_search import MIN_UNABSORBED_SHARE, predicts_better
from excite.model.effects import torque_table
from excite.model.machine import Body, EffectEntry

FINALIST_CURVES = 3  # signals of a torque that are tried on withheld stretches; chosen


def find_curves(fit: TorqueFit, torques: Sequence[np.ndarray], report: ProgressCallback) -> list[Curve]:
    """Find for every torque the signal of which what is left is a smooth function, if such a curve predicts better.

    torques (N, n_u): of each log, as effects see them.
    """
    found, model = [], fit.model
    signals = _signals(fit, torques)
    for k, (row, body) in enumerate(zip(model.actuated, model.machine.actuated, strict=True)):
        report(0.8 + 0.15 * k / len(model.actuated), "drawing what is left")
        tested = []
        for signal in signals:
            if signal.kind == "torque" and signal.body.index != body.index:
                continue
            term = _curve_term(fit, row, signal.values)
            tested.append((_block_chi2(fit, term), signal, term))
        tested.sort(key=lambda x: -x[0])
        best: Curve | None = None
        for chi2, signal, term in tested[:FINALIST_CURVES]:
            if chi2 < 2 * term.width:
                break
            new = fit.with_terms([*fit.terms, term])
            if not predicts_better(fit, new):
                continue
            gain = hold_out_gain(_of_row(fit.hold_out(fit)[1], k), _of_row(new.hold_out(fit)[1], k))
            if gain is None or gain.interval is None or not gain.interval[0] > 0:
                continue
            if best is None or gain.percent > best.percent:
                at = curve_points(signal.values)
                value, std = _evaluate(new, term, signal, at)
                best = Curve(
                    torque_names(model.machine)[k],
                    (signal.name, signal.unit),
                    at,
                    value,
                    std,
                    gain.percent,
                    gain.interval,
                    _entry(new, term, signal, body),
                )
        if best is not None:
            found.append(best)
    return found


@dataclass(frozen=True)
class Signal:
    """Angle, speed or torque (kind) of a body's joint along each log: values (n,) [unit]."""

    kind: str
    body: Body
    unit: str
    values: list[np.ndarray]

    @property
    def name(self) -> str:
        if self.kind == "torque":
            return "its torque"
        angle = "angle" if self.body.joint == "revolute" else "position"
        return f"the {angle if self.kind == 'angle' else 'speed'} of {self.body.where}"


def _signals(fit: TorqueFit, torques: Sequence[np.ndarray]) -> list[Signal]:
    """Return angle and speed of every joint, and the torque of every driven one."""
    model, found = fit.model, list[Signal]()
    for body in (b for b in model.machine.body if b.coordinates):
        unit = "rad" if body.joint == "revolute" else "m"
        angle, speed = partial(model.machine.joint_positions, body), partial(model.machine.joint_values, body)
        found.append(Signal("angle", body, unit, [angle(r.q[r.at].T) for r in fit.rows]))
        found.append(Signal("speed", body, f"{unit}/s", [speed(r.nu[r.at].T) for r in fit.rows]))
    for k, (body, (_, unit)) in enumerate(zip(model.machine.actuated, torque_names(model.machine), strict=True)):
        found.append(Signal("torque", body, unit, [u[r.at, k] for u, r in zip(torques, fit.rows, strict=True)]))
    return found


def _curve_term(fit: TorqueFit, row: int, values: Sequence[np.ndarray]) -> Term:
    columns = []
    for r, v in zip(fit.rows, values, strict=True):
        column = np.zeros((*r.Y.shape, FUNCTIONS))
        column[row] = spline_basis(v, values)
        columns.append(column)
    none = [np.zeros((*r.Y.shape, 0)) for r in fit.rows]
    return Term(None, columns, none)


def _block_chi2(fit: TorqueFit, term: Term) -> float:
    """Chi-squared of a term's columns together, added to a fit."""
    C = normalise(fit.whiten_all(term.columns))
    C -= fit.basis @ (fit.basis.T @ C)
    left, size, _ = np.linalg.svd(C, full_matrices=False)
    e = fit.innovations
    return float(((left[:, size > np.sqrt(MIN_UNABSORBED_SHARE)].T @ e) ** 2).sum() / np.mean(e**2))


def _of_row(errors: HoldOutErrors, k: int) -> HoldOutErrors:
    one = slice(k, k + 1)
    return replace(
        errors,
        sensors=errors.sensors[one],
        squares=errors.squares[:, one],
        counts=errors.counts[:, one],
        signal_variance=errors.signal_variance[one],
        noise_variance=errors.noise_variance[one],
    )


def absorbed(values: np.ndarray, unit: str) -> np.ndarray:
    """Return functions (n, m) of a signal that parameters of a joint explain as well.

    An offset; of a speed or a torque friction and what is proportional to it, of an angle gravity.
    """
    one = np.ones_like(values)
    if unit == "rad":
        return np.column_stack([one, np.cos(values), np.sin(values)])
    return np.column_stack([one] if unit == "m" else [one, values, np.sign(values)])


def _beside_parameters(signal: Signal, at: np.ndarray) -> np.ndarray:
    """Evaluate the splines at points (m,) without what parameters explain as well, (m, FUNCTIONS)."""
    every = np.concatenate(signal.values)
    shares = np.linalg.lstsq(absorbed(every, signal.unit), spline_basis(every, signal.values), rcond=None)[0]
    return np.asarray(spline_basis(at, signal.values) - absorbed(at, signal.unit) @ shares)


def _evaluate(fit: TorqueFit, term: Term, signal: Signal, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve beside what parameters explain as well, and its standard deviations, at points (m,)."""
    B, own = _beside_parameters(signal, at), fit.columns_of(term)
    return B @ fit.x[own], np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", B, fit.covariance[own, own], B), 0.0))


def _entry(fit: TorqueFit, term: Term, signal: Signal, body: Body) -> EffectEntry:
    """Return a curve as a table, at the knots and midway between them."""
    x = table_nodes(signal.values)
    f, std = _evaluate(fit, term, signal, x)
    shapes = torque_table(signal.kind, signal.body.index, x.tolist(), f.tolist())
    entry = identified_entry("torque_map", body.where, 1.0, shapes)
    return entry.model_copy(update={"std": relative_std(f, std)})
