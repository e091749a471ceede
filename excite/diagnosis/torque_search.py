"""Choose effects that explain torques: score tests, Bayesian information, and predictions of withheld stretches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite import identification
from excite.diagnosis import score_test
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.score_test import Candidate
from excite.diagnosis.selection import ProgressCallback
from excite.diagnosis.torque_fit import Term, TorqueFit
from excite.diagnosis.torque_rows import TorqueRows, effect_columns, needed_torques
from excite.model import Model
from excite.model.effects import Effect, PlacedEffect
from excite.model.machine import Filter


@dataclass(frozen=True)
class Settings:
    """The numbers of the regression; all are chosen, and `min_odds` decides about false names.

    min_odds: posterior odds from which an effect is tried, with even odds that there is one.
    tie_odds: odds against the best below which a rival stays. min_stds: of an effect's size over its standard
    deviation. min_share: of the misfit of its joint that an effect takes. max_effects: that are added. finalists:
    candidates whose shapes are refined in a turn. noise_ratio: size of what is left, over the sensors' noise, up to
    which nothing is.
    """

    min_odds: float = 20.0
    tie_odds: float = 20.0
    min_stds: float = 2.0
    min_share: float = 0.02
    max_effects: int = 10
    finalists: int = 5
    noise_ratio: float = 1.3


SETTINGS = Settings()
REACHES = 1.0, 0.35, 0.12  # shares of the way between trial values of shapes at which they are refined in turn; chosen
SHAPE_STEP = 0.03  # relative step of the slope by a shape; chosen
SHORT_DELAYS = 2.0, 8.0  # samples; trial values of delays and lags; chosen
MAX_SETTLING = 12  # passes to the magnitude of an effect that is not proportional to it; chosen
STEPS = 0.3, 3.0  # factors on that magnitude in a pass at least and at most; chosen
SETTLED = 0.02  # logarithm of the coefficient that ends them; chosen
MIN_UNABSORBED_SHARE = 1e-4  # share of a column below which the parameters absorb it; chosen


@dataclass(frozen=True)
class Tested:
    """A candidate beside a fit: chi-squared of the score test, coefficient, and log odds for it."""

    candidate: Candidate
    chi2: float
    coefficient: float
    log_odds: float


def score_columns(fit: TorqueFit, columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return chi-squared (C,) and coefficients (C,) of columns (n_rows, n, C) added to a fit one at a time.

    Zero for a column that the parameters absorb. The variance of a score is the larger one of white innovations and of
    the scatter from stretch to stretch, in whose t distribution chi-squared is expressed.
    """
    C = fit.whiten_all(columns)
    size = np.maximum(np.linalg.norm(C, axis=0), 1e-300)
    C = C / size
    C -= fit.basis @ (fit.basis.T @ C)
    information = (C**2).sum(axis=0)
    shown = information > MIN_UNABSORBED_SHARE
    e, stretch = fit.innovations, fit.stretches(True)
    step = np.where(shown, C.T @ e / np.where(shown, information, 1.0), 0.0)
    variance = float(e @ e) / max(len(e) - fit.basis.shape[1], 1)
    names = np.unique(stretch)
    scores = np.array([C[stretch == c].T @ e[stretch == c] - step * (C[stretch == c] ** 2).sum(axis=0) for c in names])
    scatter = (scores**2).sum(axis=0) * len(names) / max(len(names) - 1, 1)
    white = step**2 * information / variance
    t = step**2 * information**2 / np.maximum(scatter, 1e-300)
    equal = scipy.stats.chi2.isf(np.maximum(scipy.stats.f.sf(t, 1, len(names) - 1), 1e-300), 1)
    return np.where(shown, np.minimum(white, equal), 0.0), step / size


def log_odds(chi2: float, term: PlacedEffect, n: int, n_candidates: int) -> float:
    """Log odds for an effect by its Bayesian information: n rows, candidates that are all as likely before."""
    k = 1 + len(free_shapes(term))
    return 0.5 * chi2 - 0.5 * k * np.log(n) - np.log(n_candidates)


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
    size = coefficient * e.values["A"]
    has_wrong_sign = size < 0 and (e.effect.positive or e.effect.opposes_motion)
    return bool(has_wrong_sign or abs(size) > e.effect.largest)


def _is_seen_in_torques(e: PlacedEffect) -> bool:
    """Tell if an effect changes the torques of moving joints, or what they seem to need: not near rest alone."""
    return e.effect.shaking is None and not e.unsticking


def _phase(e: PlacedEffect) -> str | None:
    """Return the shape that is a phase, None if there is none."""
    return next((n for n, shape in e.shapes.items() if shape.circular), None)


def _in_quadrature(x: Candidate) -> list[Candidate]:
    """Return a candidate at two phases a quarter of a turn apart, one without a phase as it is."""
    phase = _phase(x.placed)
    if phase is None:
        return [x]
    both = (replace(x.placed, values={**x.placed.values, phase: at}) for at in (0.0, np.pi / 2))
    return [Candidate(placed, (0,)) for placed in both]


class Search:
    """Adds effects to a fit as long as one is worth it."""

    def __init__(self, model: Model, rows: Sequence[TorqueRows], filter: Filter, X: np.ndarray) -> None:
        self.model, self.rows, self.filter, self.X = model, rows, filter, X
        self.torques = [needed_torques(model, r, X) for r in rows]
        self.duration = max(float(r.t[-1]) for r in rows)
        # trial values of the machine at the speeds of the logs, whatever rate its file gives for the friction's turn
        self.machine = identification.with_soft_friction(model, [r.log for r in rows], filter).machine
        found = score_test.candidates(self.machine, [s.name for s in self.machine.sensors("full")], self.duration)
        self.candidates = [y for x in found if _is_seen_in_torques(x.placed) for y in _in_quadrature(x)]
        self.candidates += self._short_delays()
        self.names = sorted({x.name for x in self.candidates})
        self.columns = self._columns([x.placed for x in self.candidates])

    def _columns(self, placed: Sequence[PlacedEffect]) -> list[np.ndarray]:
        return effect_columns(self.model, self.rows, self.torques, placed, self.X, self.filter)

    def _short_delays(self) -> list[Candidate]:
        """Return delays and lags of a few samples, beside the trials that are as long as hydraulics are slow."""
        sample = 1 / float(self.machine.sampling_hz)
        seen = {x.name: x for x in self.candidates if x.placed.effect.unit == "s" and not x.placed.effect.timed}
        return [
            replace(x, placed=replace(x.placed, values={**x.placed.values, "A": times * sample}))
            for x in seen.values()
            for times in SHORT_DELAYS
        ]

    def settle(self, fit: TorqueFit, x: Tested) -> Tested | None:
        """Return a candidate with the magnitude at which its coefficient is 1, None if there is none.

        The torque of a delay is not proportional to it: only there is the column that of the magnitude.
        """
        if is_proportional(x.candidate.placed.effect):
            return x
        for _ in range(MAX_SETTLING):
            if not x.coefficient > 0:
                return None
            if abs(np.log(x.coefficient)) < SETTLED:
                return x
            placed = x.candidate.placed
            value = scaled_magnitude(placed, float(np.clip(x.coefficient, *STEPS)))
            moved = replace(x.candidate, placed=replace(placed, values={**placed.values, "A": value}))
            (x,) = self.test(fit, [moved], self._columns([moved.placed]))
        return None

    def test(self, fit: TorqueFit, candidates: Sequence[Candidate], columns: Sequence[np.ndarray]) -> list[Tested]:
        """Test candidates beside a fit, the likeliest first; a coefficient of impossible sign counts for nothing."""
        chi2, step = score_columns(fit, columns)
        n, found = len(fit.innovations), []
        for x, c, a in zip(candidates, chi2, step, strict=True):
            c = 0.0 if _is_impossible(x.placed, a) else float(c)
            found.append(Tested(x, c, float(a), log_odds(c, x.placed, n, len(self.names))))
        return sorted(found, key=lambda x: -x.log_odds)

    def turn_phase(self, fit: TorqueFit, x: Tested) -> Tested:
        """Return a candidate with the phase that explains most, one without a phase as it is."""
        phase = _phase(x.candidate.placed)
        if phase is None:
            return x
        both = _in_quadrature(x.candidate)
        C = fit.whiten_all(self._columns([y.placed for y in both]))
        C -= fit.basis @ (fit.basis.T @ C)
        sine, cosine = np.linalg.lstsq(C, fit.innovations, rcond=None)[0]
        values = {**x.candidate.placed.values, phase: float(np.arctan2(cosine, sine))}
        turned = replace(both[0], placed=replace(both[0].placed, values=values))
        (other,) = self.test(fit, [turned], self._columns([turned.placed]))
        return other if other.chi2 > x.chi2 else x

    def finalists(self, fit: TorqueFit) -> list[Tested]:
        """Return the likeliest candidate of each name, with refined shapes, the likeliest first."""
        taken = {t.name for t in fit.terms}
        best: dict[str, Tested] = {}
        for x in self.test(fit, self.candidates, self.columns):
            if x.candidate.name not in taken:
                best.setdefault(x.candidate.name, x)
        chosen = [self.turn_phase(fit, x) for x in best.values() if x.log_odds > 0][: SETTINGS.finalists]
        for reach in REACHES:
            near = score_test.refine_candidates([x.candidate for x in chosen], self.machine, self.duration, reach)
            near = [x for x in near if len(x.columns) == 1]
            if near:
                for x in self.test(fit, near, self._columns([x.placed for x in near])):
                    chosen = [x if y.candidate.name == x.candidate.name and x.chi2 > y.chi2 else y for y in chosen]
        settled = [self.settle(fit, x) for x in chosen]
        return sorted((x for x in settled if x is not None), key=lambda x: -x.log_odds)

    def term(self, x: Tested) -> Term:
        """Return a candidate as columns, with slopes by its shapes."""
        placed = x.candidate.placed
        free = free_shapes(placed)
        moved = [
            replace(placed, values={**placed.values, n: placed.values[n] * (1 + sign * SHAPE_STEP)})
            for n in [*free, "A"]
            for sign in (1, -1)
        ]
        columns = self._columns([placed, *moved])
        slopes = [(c[:, :, 1::2] - c[:, :, 2::2]) / (2 * SHAPE_STEP) for c in columns]
        sign = -1.0 if placed.effect.inverse else 1.0
        by_magnitude = None if is_proportional(placed.effect) else [sign * s[:, :, -1:] for s in slopes]
        shapes = [s[:, :, :-1] for s in slopes]
        return Term(placed, [c[:, :, :1] for c in columns], shapes, tuple(free), by_magnitude, x.chi2)

    def extend(self, fit: TorqueFit, report: ProgressCallback, deadline: Deadline) -> tuple[TorqueFit, list[str]]:
        """Add the likeliest effect that holds, and drop those that do not beside it, until none holds or time is over.

        Return the last fit, and why effects that were likely were not added.
        """
        reasons: dict[str, str] = {}
        tried = {frozenset[str]()}
        while len(fit.terms) < SETTINGS.max_effects and not deadline.is_over():
            report(0.2 + 0.6 * len(fit.terms) / SETTINGS.max_effects, "testing effects on the torques")
            added = None
            for x in self.finalists(fit):
                if x.log_odds < np.log(SETTINGS.min_odds):
                    break
                term = self.term(x)
                new = fit.with_terms([*fit.terms, term])
                why = reason_against(fit, new, term)
                if not why:
                    added = new
                    break
                reasons[term.name] = why
            if added is None:
                break
            held = [t for t in added.terms if t is added.terms[-1] or _is_certain(added, t)]
            fit = added if len(held) == len(added.terms) else added.with_terms(held)
            names = frozenset(t.name for t in fit.terms)
            if names in tried:  # effects that replace each other in turn
                break
            tried.add(names)
        found = {t.name for t in fit.terms}
        return fit, [f"{name}: {why}" for name, why in reasons.items() if name not in found]


def _is_certain(fit: TorqueFit, term: Term) -> bool:
    x, std = fit.coefficient(term)
    return abs(x) > SETTINGS.min_stds * std


def reason_against(before: TorqueFit, after: TorqueFit, term: Term) -> str:
    """Say why an effect does not hold, "" if it does."""
    x = after.coefficient(term)[0]
    if not _is_certain(after, term):
        return "its size is uncertain"
    if _is_impossible(term.effect, x):
        return "its sign or its size is impossible"
    if not predicts_better(before, after):
        return "it does not predict withheld stretches better"
    if share_of_row(before, after) < SETTINGS.min_share:
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
