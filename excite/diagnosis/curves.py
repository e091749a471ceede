"""Smooth curves: what no effect explains, as a function of one signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.interpolate

from excite.diagnosis.hold_out import HoldOutErrors, hold_out_gain, torque_names
from excite.diagnosis.selection import ProgressCallback
from excite.diagnosis.torque_fit import Term, TorqueFit, normalise
from excite.diagnosis.torque_search import MIN_UNABSORBED_SHARE, predicts_better
from excite.text import format_number, format_percent, format_uncertain

FUNCTIONS = 8  # B-splines of a curve; chosen
FINALIST_CURVES = 3  # signals of a torque that are tried on withheld stretches; chosen
CURVE_POINTS = 41  # of a curve


@dataclass(frozen=True)
class Curve:
    """A torque that the model lacks as a smooth function of one signal.

    row: name and unit of the torque sensor. signal: name and unit. at (M,) [signal's unit]. value, std (M,) [row's
    unit]: without what parameters explain as well (`absorbed`). percent: by how much the error of that torque on
    withheld stretches is smaller, with its 95 % interval.
    """

    row: tuple[str, str]
    signal: tuple[str, str]
    at: np.ndarray
    value: np.ndarray
    std: np.ndarray
    percent: float
    interval: tuple[float, float]

    def __str__(self) -> str:
        low, high = int(np.argmin(self.value)), int(np.argmax(self.value))
        (row, unit), (signal, of) = self.row, self.signal
        ends = " to ".join(
            f"{format_uncertain(self.value[k], self.std[k], unit)} at {format_number(self.at[k], 3)} {of}"
            for k in sorted((low, high))
        )
        return (
            f"{row} lacks a torque that depends on {signal}: {ends}; with this curve its error on withheld stretches is"
            f" {format_percent(self.percent)} smaller (95 %: {format_number(self.interval[0], 2)} to"
            f" {format_percent(self.interval[1])})"
        )


def find_curves(fit: TorqueFit, torques: Sequence[np.ndarray], report: ProgressCallback) -> list[Curve]:
    """Find for every torque the signal of which what is left is a smooth function, if such a curve predicts better.

    torques (N, n_u): of each log, as effects see them.
    """
    found, model = [], fit.model
    signals = _signals(fit, torques)
    for k, row in enumerate(model.actuated):
        report(0.8 + 0.15 * k / len(model.actuated), "drawing what is left")
        tested = []
        for signal, values in signals.items():
            if signal[1] in ("N m", "N") and signal[0] != f"the torque u{k}":
                continue
            term = _curve_term(fit, row, values)
            tested.append((_block_chi2(fit, term), signal, values, term))
        tested.sort(key=lambda x: -x[0])
        best: Curve | None = None
        for chi2, (name, unit), values, term in tested[:FINALIST_CURVES]:
            if chi2 < 2 * term.width:
                break
            new = fit.with_terms([*fit.terms, term])
            if not predicts_better(fit, new):
                continue
            gain = hold_out_gain(_of_row(fit.hold_out(fit)[1], k), _of_row(new.hold_out(fit)[1], k))
            if gain is None or gain.interval is None or not gain.interval[0] > 0:
                continue
            if best is None or gain.percent > best.percent:
                at, value, std = _evaluate(new, term, values, unit)
                label = name.replace(f"the torque u{k}", "its torque")
                best = Curve(torque_names(model.machine)[k], (label, unit), at, value, std, gain.percent, gain.interval)
        if best is not None:
            found.append(best)
    return found


def _signals(fit: TorqueFit, torques: Sequence[np.ndarray]) -> dict[tuple[str, str], list[np.ndarray]]:
    """Return signals (n,) of each log by name and unit."""
    model, found = fit.model, dict[tuple[str, str], list[np.ndarray]]()
    for body in (b for b in model.machine.body if b.coordinates):
        turns = body.joint == "revolute"
        k = model.coordinates.index(body.coordinates[0])
        angle, unit = ("angle", "rad") if turns else ("position", "m")
        found[f"the {angle} of {body.where}", unit] = [r.q[r.at, k] for r in fit.rows]
        found[f"the speed of {body.where}", f"{unit}/s"] = [r.nu[r.at, k] for r in fit.rows]
    for k, (_, unit) in enumerate(torque_names(model.machine)):
        found[f"the torque u{k}", unit] = [u[r.at, k] for u, r in zip(torques, fit.rows, strict=True)]
    return found


def _basis(values: np.ndarray, along: Sequence[np.ndarray]) -> np.ndarray:
    """Evaluate cubic B-splines (n, functions) with knots at quantiles of a signal along all logs."""
    n = FUNCTIONS
    inner = np.quantile(np.concatenate(list(along)), np.linspace(0, 1, n - 2))
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    inside = np.clip(values, inner[0], inner[-1])
    return np.asarray(scipy.interpolate.BSpline.design_matrix(inside, knots, 3).toarray())


def _curve_term(fit: TorqueFit, row: int, values: Sequence[np.ndarray]) -> Term:
    columns = []
    for r, v in zip(fit.rows, values, strict=True):
        column = np.zeros((*r.Y.shape, FUNCTIONS))
        column[row] = _basis(v, values)
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


def _evaluate(
    fit: TorqueFit, term: Term, values: Sequence[np.ndarray], unit: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate a curve beside what parameters explain as well: points, values, standard deviations."""
    every = np.concatenate(list(values))
    low, high = (float(x) for x in np.quantile(every, [0.01, 0.99]))
    at = np.linspace(low, high, CURVE_POINTS)
    shares = np.linalg.lstsq(absorbed(every, unit), _basis(every, values), rcond=None)[0]
    B = _basis(at, values) - absorbed(at, unit) @ shares
    own = fit.columns_of(term)
    return at, B @ fit.x[own], np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", B, fit.covariance[own, own], B), 0.0))
