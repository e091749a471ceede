"""Choose effects that explain torques: by evidence beside curves that mean nothing, and by withheld stretches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.stats

from excite import identification
from excite.diagnosis import evidence, score_test, selection
from excite.diagnosis.acceptance import MIN_STDS
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.evidence import Form
from excite.diagnosis.parallel import run_in_turn
from excite.diagnosis.score_test import MIN_SIGNATURE, Candidate
from excite.diagnosis.selection import ProgressCallback
from excite.diagnosis.torque_fit import Term, TorqueFit
from excite.diagnosis.torque_rows import TorqueRows, effect_columns, needed_torques
from excite.model import Model
from excite.model.effects import Effect, PlacedEffect
from excite.model.machine import EffectEntry, Filter
from excite.smoothing import build_basis

ODDS_OVER_CURVES = 3.0  # of an effect over curves that mean nothing, given the number of names; chosen
MIN_SHARE = 0.02  # of the misfit of its joint that an effect takes; chosen
TYPICAL_SHARE = 0.1  # of a torque's root mean square, about which the sizes of curves are sought; chosen
SHAPE_STEP = 0.03  # relative step of the slope by a shape; chosen
SHORT_DELAYS = 2.0, 8.0  # samples; trial values of delays and lags; chosen
NEARBY = np.linspace(-1, 1, 9)  # magnitudes tried beside one, over the reach
REACHES = 1.0, 0.3, 0.09, 0.03  # [octaves] in turn, of an effect that is not proportional to its magnitude; chosen
MIN_UNABSORBED_SHARE = 1e-4  # share of a column below which the parameters absorb it; chosen


def free_shapes(term: PlacedEffect) -> list[str]:
    """Return the shapes that are fitted."""
    return [n for n, s in term.shapes.items() if not s.whole and len(s.grid) > 1 and term.values[n] != 0]


def is_proportional(effect: Effect) -> bool:
    """Tell if an effect's torque is proportional to its magnitude: not a delay, a lag or a gain."""
    return len(effect.grid) == 1 and effect.channel is None and not effect.inverse


def scaled_magnitude(e: PlacedEffect, coefficient: float) -> float:
    """Return the magnitude that a coefficient of an effect's column stands for."""
    return e.values["A"] / coefficient if e.effect.inverse else e.values["A"] * coefficient


def _is_impossible(e: PlacedEffect, coefficient: float) -> bool:
    """Tell if a coefficient gives an effect a sign or a size that it cannot have."""
    size = scaled_magnitude(e, coefficient) if coefficient else 0.0
    has_wrong_sign = size < 0 and (e.effect.positive or e.effect.opposes_motion)
    return bool(has_wrong_sign or abs(size) > min(e.effect.largest, 1 / selection.SMALLEST_VALUE))


def _phase(e: PlacedEffect) -> str | None:
    """Return the shape that is a phase, None if there is none."""
    return next((n for n, shape in e.shapes.items() if shape.circular), None)


class Search:
    """Adds effects to a fit as long as one is worth it."""

    def __init__(self, model: Model, rows: Sequence[TorqueRows], filter: Filter, X: np.ndarray) -> None:
        self.model, self.rows, self.filter, self.X = model, rows, filter, X
        self.torques = [needed_torques(model, r, X) for r in rows]
        self.duration = max(float(r.t[-1]) for r in rows)
        # trial values of the machine at the speeds of the logs, whatever rate its file gives for the friction's turn
        self.machine = identification.with_soft_friction(model, [r.log for r in rows], filter).machine
        found = score_test.candidates(self.machine, [s.name for s in self.machine.sensors("full")], self.duration)
        # what shows in the torques of moving joints, or in what they seem to need: not near rest alone
        known = {e.name for e in model.effects}
        found = [
            x for x in found if x.placed.effect.shaking is None and not x.placed.unsticking and x.name not in known
        ]
        self.candidates = score_test.renumber_columns([*found, *self._short_delays(found)])
        self.candidate_columns = self._columns(self.candidates)
        self.curves, self.group, self.groups = self._curves()

    @property
    def names(self) -> set[str]:
        """Names of all candidates."""
        return {x.name for x in self.candidates}

    def _short_delays(self, found: Sequence[Candidate]) -> list[Candidate]:
        """Return delays and lags of a few samples, beside the trials that are as long as hydraulics are slow."""
        sample = 1 / float(self.machine.sampling_hz)
        seen = {x.name: x for x in found if x.placed.effect.unit == "s" and not x.placed.effect.timed}
        return [
            replace(x, placed=replace(x.placed, values={**x.placed.values, "A": times * sample}))
            for x in seen.values()
            for times in SHORT_DELAYS
        ]

    def _columns(self, found: Sequence[Candidate]) -> list[np.ndarray]:
        """Return the columns (n_rows, n, C) of candidates along each log, two for one with a phase."""
        placed: list[PlacedEffect] = []
        for x in found:
            phase = _phase(x.placed)
            for turn in range(len(x.columns)):
                shift = {} if phase is None else {phase: x.placed.values[phase] + turn * np.pi / 2}
                placed.append(replace(x.placed, values={**x.placed.values, **shift}))
        return self._columns_of(placed)

    def _columns_of(self, placed: Sequence[PlacedEffect]) -> list[np.ndarray]:
        return effect_columns(self.model, self.rows, self.torques, placed, self.X, self.filter)

    def _curves(self) -> tuple[list[np.ndarray], np.ndarray, tuple[str, ...]]:
        """Return what the model may lack without a name: columns (n_rows, n, G), group (G,) of each, and groups."""
        rows, at = self.rows, list(self.model.actuated)
        basis = build_basis(
            [r.nu[r.at][:, at] for r in rows], [r.q[r.at][:, at] for r in rows], [r.t[r.at] for r in rows], len(at)
        )
        size = TYPICAL_SHARE * np.sqrt(np.mean(np.concatenate([r.Y[at] ** 2 for r in rows], axis=1), axis=1))
        found = []
        for k, r in enumerate(rows):
            columns = np.zeros((*r.Y.shape, basis.root.shape[1]))
            for j, row in enumerate(at):
                weights = basis.rows(j, k, r.nu[r.at, row], r.q[r.at, row], r.t[r.at])
                own = slice(int(basis.start[j]), int(basis.start[j]) + basis.count[j])
                columns[row] = size[j] * (weights @ basis.root[own])
            found.append(columns)
        group = np.zeros(basis.root.shape[1], int)
        for k, one in enumerate(basis.components):
            group[one.columns] = k
        return found, group, tuple(f"{one.kind} {one.channel}" for one in basis.components)

    def form(self, fit: TorqueFit, found: Sequence[Candidate] | None = None, curves: bool = True) -> Form:
        """Return the form of parameters and a fit's effects, of candidates, all by default, and of curves if asked."""
        found = self.candidates if found is None else score_test.renumber_columns(found)
        columns = self.candidate_columns if found is self.candidates else self._columns(found)
        group, groups = (self.group, self.groups) if curves else (self.group[:0], ())
        beside = [self.curves, columns] if curves else [columns]
        Z = np.concatenate([fit.whitened_design, *map(fit.whiten_all, beside)], axis=1)
        o, first = fit.whitened_design.shape[1], fit.whitened_design.shape[1] + len(group)
        Z[:, :o] /= np.maximum(np.linalg.norm(Z[:, :o], axis=0), 1e-300)
        A, b = Z.T @ Z, Z.T @ fit.whitened_torques
        left = Z[:, first:] - fit.basis @ (fit.basis.T @ Z[:, first:])
        square = (left**2).sum(axis=0)
        absorbed = np.flatnonzero(square < np.maximum(MIN_UNABSORBED_SHARE * np.diag(A)[first:], MIN_SIGNATURE))
        likeliest = np.abs(left.T @ fit.innovations) / np.maximum(square, 1e-300)
        likeliest[absorbed], absorbed = 0.0, absorbed + first
        A[absorbed], A[:, absorbed], b[absorbed] = 0.0, 0.0, 0.0
        std = evidence.amount_stds(self.machine, found, self.duration)
        # a prior with heavy tails: what is larger than usual costs no more than its width
        return Form(A, b, o, group, groups, tuple(found), np.maximum(std, likeliest))

    def settle(self, fit: TorqueFit, x: Candidate, factor: np.ndarray) -> PlacedEffect | None:
        """Return a candidate with the magnitude and the phase that its factors stand for; None if of a wrong sign.

        The torque of a delay is not proportional to it: the likeliest one is that with the factor 1.
        """
        placed = x.placed
        if len(factor) == 2:
            turned = placed.values[_phase(placed) or ""] + float(np.arctan2(factor[1], factor[0]))
            placed = replace(placed, values={**placed.values, _phase(placed) or "": turned})
            factor = np.array([np.hypot(*factor)])
        if is_proportional(placed.effect):
            return replace(placed, values={**placed.values, "A": scaled_magnitude(placed, float(factor[0]))})
        if not factor[0] > 0:
            return None
        for reach in REACHES:
            amounts = placed.values["A"] * 2 ** (reach * NEARBY)
            tried = [replace(placed, values={**placed.values, "A": float(x)}) for x in amounts]
            form = self.form(fit, [Candidate(x, (0,)) for x in tried], curves=False).reduced()
            placed = tried[int(np.argmax(2 * form.right_side - np.diag(form.information)))]
        return placed

    def term(self, placed: PlacedEffect) -> Term:
        """Return an effect as columns, with slopes by its shapes."""
        free = free_shapes(placed)
        moved = [
            replace(placed, values={**placed.values, n: placed.values[n] * (1 + sign * SHAPE_STEP)})
            for n in [*free, "A"]
            for sign in (1, -1)
        ]
        columns = self._columns_of([placed, *moved])
        slopes = [(c[:, :, 1::2] - c[:, :, 2::2]) / (2 * SHAPE_STEP) for c in columns]
        sign = -1.0 if placed.effect.inverse else 1.0
        by_magnitude = None if is_proportional(placed.effect) else [sign * s[:, :, -1:] for s in slopes]
        return Term(placed, [c[:, :, :1] for c in columns], [s[:, :, :-1] for s in slopes], tuple(free), by_magnitude)

    def refined(self, fit: TorqueFit, found: evidence.Chosen) -> list[Term]:
        """Return chosen candidates as terms, with refined shapes."""
        stage = selection.Scored(self.machine, self.duration, lambda own, runner: self.form(fit, own))
        found = selection.refined(stage, found, run_in_turn)
        settled = [self.settle(fit, x, f) for x, f in zip(found.candidates, found.factors, strict=True)]
        return [self.term(x) for x in settled if x is not None]

    def extend(
        self, fit: TorqueFit, reasons: dict[str, str], report: ProgressCallback, deadline: Deadline, curves: bool = True
    ) -> TorqueFit:
        """Add the likeliest effects that hold, and drop those that do not, until none holds or time is over.

        reasons: why effects that were likely were not added; they are tried again beside a further effect only. curves:
        effects must explain more than curves that mean nothing.
        """
        tried = {frozenset[str]()}
        while not deadline.is_over():
            report(0.2 + 0.6 * len(reasons) / (len(reasons) + len(fit.terms) + 5), "testing effects on the torques")
            form, out = self.form(fit, curves=curves), {t.name for t in fit.terms} | reasons.keys()
            form = replace(form, candidates=tuple(x for x in form.candidates if x.name not in out))
            chosen = evidence.choose(form, odds=ODDS_OVER_CURVES if curves else evidence.MIN_ODDS, most=1)
            if not chosen.candidates:
                break
            new = fit.with_terms([*fit.terms, *self.refined(fit, chosen)])
            new, given_up = self._that_hold(new)
            wrong = {x.name for x in chosen.candidates} - {t.name for t in new.terms} - set(given_up)
            given_up |= dict.fromkeys(wrong, "its sign is impossible")
            reasons.update(given_up)
            names = frozenset(t.name for t in new.terms)
            if names in tried and not given_up:  # effects that replace each other in turn
                break
            tried.add(names)
            if len(new.terms) > len(fit.terms):  # what failed before may hold beside it
                reasons.clear()
            fit = new
        return fit

    def _that_hold(self, fit: TorqueFit) -> tuple[TorqueFit, dict[str, str]]:
        """Return a fit without the effects that do not hold beside the others, the last ones first, and why."""
        reasons = dict[str, str]()
        for term in reversed(fit.terms):
            rest = fit.without(term)
            why = reason_against(rest, fit, term)
            if why:
                reasons[term.name] = why
                fit = rest
        return fit, reasons

    def gain(self, rest: TorqueFit, placed: PlacedEffect) -> float:
        """Return the gain of an effect beside a fit: twice the logarithm of a Bayes factor."""
        form = self.form(rest, [Candidate(placed, (0,))], curves=False).reduced()
        return evidence.posterior(form, form.candidates, form.nothing, 0).gain

    def rivals(self, fit: TorqueFit, term: Term) -> tuple[EffectEntry, ...]:
        """Return effects that explain the torques about as well as a term does beside the others."""
        rest = fit.without(term)
        own = self.gain(rest, term.effect)
        margin = 2 * np.log(evidence.CREDIBLE_ODDS) + selection.formula_ratio(own)
        form = self.form(rest, curves=False).reduced()
        gains = evidence.first_gains(form, (), form.nothing)
        known = {t.name for t in fit.terms}
        best = [form.candidates[k] for k in evidence.best_of_each(form, gains, lambda x: x.name, 0.0)]
        found = []
        for x in [x for x in best if x.name not in known][: selection.MAX_RIVALS]:
            factor = evidence.factor_of(form, x, form.nothing)
            for rival in self.refined(rest, evidence.Chosen((x,), (factor,), (), 0.0, tuple(np.exp(form.nothing)))):
                if self.gain(rest, rival.effect) < own - margin:
                    continue
                new = rest.with_terms([*rest.terms, rival])
                if not reason_against(rest, new, rival):
                    placed, coefficient = rival.effect, new.coefficient(rival)[0]
                    values = {n: placed.values[n] for n in placed.shapes}
                    magnitude = scaled_magnitude(placed, coefficient)
                    found.append(selection.identified_entry(placed.effect.name, placed.where, magnitude, values))
        return tuple(found)


def reason_against(before: TorqueFit, after: TorqueFit, term: Term) -> str:
    """Say why an effect does not hold, "" if it does."""
    x, std = after.coefficient(term)
    if not abs(x) > MIN_STDS * std:
        return "its size is uncertain"
    if _is_impossible(term.effect, x):
        return "its sign or its size is impossible"
    if not predicts_better(before, after):
        return "it does not predict withheld stretches better"
    if share_of_row(before, after) < MIN_SHARE:
        return "it takes too little"
    return ""


def predicts_better(before: TorqueFit, after: TorqueFit) -> bool:
    """Tell if the log-likelihood of withheld stretches grows, by the lower end of its 95 % interval."""
    each = after.hold_out(before)[0] - before.hold_out(before)[0]
    n = len(each)
    return bool(each.sum() > scipy.stats.t.ppf(0.975, n - 1) * np.sqrt(n) * each.std(ddof=1))


def share_of_row(before: TorqueFit, after: TorqueFit) -> float:
    """Largest share of a row's excess misfit that a further effect takes."""
    old, new = (np.maximum(f.level**2 - f.lowest**2, 0.0) for f in (before, after))
    return float(np.max((old - new) / np.maximum(old, 1e-300)))
