"""Choose effects that explain torques: score tests, Bayesian information, and predictions of withheld stretches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from excite import identification
from excite.diagnosis import score_test
from excite.diagnosis.score_test import Candidate
from excite.diagnosis.selection import TRANSITION, ProgressCallback
from excite.diagnosis.torque_fit import Term, TorqueFit
from excite.diagnosis.torque_rows import TorqueRows, effect_columns, needed_torques
from excite.model import Model
from excite.model.effects import Effect, PlacedEffect
from excite.model.machine import Filter


@dataclass(frozen=True)
class Settings:
    """The numbers of the regression; all are chosen, and `MIN_ODDS` decides about false names.

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
MIN_UNABSORBED_SHARE = 1e-4  # share of a column below which the parameters absorb it; chosen


@dataclass(frozen=True)
class Tested:
    """A candidate beside a fit: chi-squared of the score test, coefficient, and log odds for it."""

    candidate: Candidate
    chi2: float
    coefficient: float
    log_odds: float

    @property
    def score(self) -> score_test.Score:
        values = dict(self.candidate.placed.values)
        return score_test.Score(self.candidate, self.chi2, values, 1.0)


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
    k = 1 + sum(len(s.grid) > 1 and not s.whole and term.values[n] != 0 for n, s in term.shapes.items())
    return 0.5 * chi2 - 0.5 * k * np.log(n) - np.log(n_candidates)


def _is_seen_in_torques(effect: Effect) -> bool:
    """Tell if an effect changes the torques of moving joints: not a sensor's, and not the friction's turn near rest."""
    return effect.reading is None and effect.shaking is None and effect.name != TRANSITION


class Search:
    """Adds effects to a fit as long as one is worth it."""

    def __init__(self, model: Model, rows: Sequence[TorqueRows], filter: Filter, X: np.ndarray) -> None:
        self.model, self.rows, self.filter, self.X = model, rows, filter, X
        self.torques = [needed_torques(model, r, X) for r in rows]
        self.duration = max(float(r.t[-1]) for r in rows)
        # trial values of the machine at the speeds of the logs, whatever rate its file gives for the friction's turn
        self.machine = identification.with_soft_friction(model, [r.log for r in rows], filter).machine
        found = score_test.candidates(self.machine, [s.name for s in self.machine.sensors("full")], self.duration)
        self.candidates = [x for x in found if _is_seen_in_torques(x.placed.effect)]
        self.names = sorted({x.name for x in self.candidates})
        self.columns = self._columns([x.placed for x in self.candidates])

    def _columns(self, placed: Sequence[PlacedEffect]) -> list[np.ndarray]:
        return effect_columns(self.model, self.rows, self.torques, placed, self.X, self.filter)

    def test(self, fit: TorqueFit, candidates: Sequence[Candidate], columns: Sequence[np.ndarray]) -> list[Tested]:
        """Test candidates beside a fit, the likeliest first; a coefficient of impossible sign counts for nothing."""
        chi2, step = score_columns(fit, columns)
        n, found = len(fit.innovations), []
        for x, c, a in zip(candidates, chi2, step, strict=True):
            effect = x.placed.effect
            impossible = a * x.placed.values["A"] < 0 and (effect.positive or effect.opposes_motion)
            c = 0.0 if impossible else float(c)
            found.append(Tested(x, c, float(a), log_odds(c, x.placed, n, len(self.names))))
        return sorted(found, key=lambda x: -x.log_odds)

    def finalists(self, fit: TorqueFit) -> list[Tested]:
        """Return the likeliest candidate of each name, with refined shapes, the likeliest first."""
        taken = {t.name for t in fit.terms}
        best: dict[str, Tested] = {}
        for x in self.test(fit, self.candidates, self.columns):
            if x.candidate.name not in taken:
                best.setdefault(x.candidate.name, x)
        chosen = [x for x in best.values() if x.log_odds > 0][: SETTINGS.finalists]
        for reach in REACHES:
            near = score_test.refine_candidates([x.score for x in chosen], self.machine, self.duration, reach)
            near = [x for x in near if len(x.columns) == 1]
            if near:
                for x in self.test(fit, near, self._columns([x.placed for x in near])):
                    chosen = [x if y.candidate.name == x.candidate.name and x.chi2 > y.chi2 else y for y in chosen]
        return sorted(chosen, key=lambda x: -x.log_odds)

    def term(self, x: Tested) -> Term:
        """Return a candidate as columns, with slopes by its shapes."""
        placed = x.candidate.placed
        free = [n for n, s in placed.shapes.items() if not s.whole and placed.values[n] != 0]
        free += ["A"] if len(placed.effect.grid) > 1 else []
        moved = [
            replace(placed, values={**placed.values, n: placed.values[n] * (1 + sign * SHAPE_STEP)})
            for n in free
            for sign in (1, -1)
        ]
        columns = self._columns([placed, *moved])
        slopes = [(c[:, :, 1::2] - c[:, :, 2::2]) / (2 * SHAPE_STEP) for c in columns]
        return Term(placed, [c[:, :, :1] for c in columns], slopes, tuple(free), x.chi2)

    def extend(self, fit: TorqueFit, report: ProgressCallback) -> tuple[TorqueFit, list[str]]:
        """Add the likeliest effect that holds, and drop those that do not beside it, until none holds.

        Return the last fit, and why effects that were likely were not added.
        """
        reasons: dict[str, str] = {}
        while len(fit.terms) < SETTINGS.max_effects:
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
            weak = [
                t
                for t in added.terms[:-1]
                if abs(added.coefficient(t)[0]) < SETTINGS.min_stds * added.coefficient(t)[1]
            ]
            fit = added.with_terms([t for t in added.terms if t not in weak]) if weak else added
            if weak and len(fit.terms) <= len(added.terms) - 2:
                break
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
    if x * term.effect.values["A"] < 0 and (term.effect.effect.positive or term.effect.effect.opposes_motion):
        return "its sign is impossible"
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
