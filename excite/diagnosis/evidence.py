"""Evidence for effects that a model lacks, beside forces that it lacks without a name.

About a fit, parameters, coefficients of unknown forces and amounts of every candidate form one linear Gaussian model:
a Gram matrix of whitened innovations. With parameters and offsets integrated out, the marginal likelihood of any set of
candidates follows from that matrix, with the sizes of the unknown forces at their most likely values. A candidate has
to explain the logs better than curves and slow courses that mean nothing. Sources: MacKay, "Bayesian interpolation",
Neural Computation 4, 1992; Kass and Raftery, "Bayes factors", JASA 90, 1995.

A gain is twice the logarithm of a Bayes factor.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import lapack

from excite.diagnosis.parallel import CallRunner, run_in_turn
from excite.diagnosis.score_test import (
    MIN_PHASE_SHARE,
    MIN_SIGNATURE,
    Candidate,
    FittedLog,
    SignatureColumns,
    renumber_columns,
)
from excite.model.effects import Site
from excite.model.machine import Machine
from excite.smoothing import SIZE_SCATTER, Fit, UnknownForces, sizes_step

AMOUNT_STD = 2.0  # prior standard deviation of an amount, over its typical size
LEVELS = np.linspace(-6.0, 2.0, 9)  # logarithms of the sizes' common level that are tried
NO_SIZE = -30.0  # logarithm of a size that is none
PASSES = 40  # of the fixed point of the sizes
COMPARING_PASSES = 8  # of it where candidates are compared
FINALISTS = 8  # candidates that are compared with the sizes renewed
MIN_ODDS = 20.0  # posterior odds from which a candidate is added, with even odds that some effect is there
CREDIBLE_ODDS = 20.0  # odds against the best below which a rival stays: the 95 % credible set
MIN_SHARE = 0.2  # of the first gain in a turn, down to which first-order gains tell causes from errors of the form
MOST_AT_ONCE = 5  # effects that are added before the model is fitted again


@dataclass(frozen=True)
class Form:
    """Quadratic form of K parameters and offsets, G coefficients without prior, and C candidate columns.

    information (K + G + C, K + G + C), right_side (K + G + C,): the most likely values solve them. Parameters count
    from the fit's values, the others from zero. group (G,): of each coefficient. names: of the groups. amount_std (C,):
    prior standard deviation of each column's factor.
    """

    information: np.ndarray
    right_side: np.ndarray
    outer: int
    group: np.ndarray
    names: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    amount_std: np.ndarray

    def reduced(self) -> Form:
        """Return the form with parameters and offsets integrated out."""
        A, b, o = self.information, self.right_side, slice(0, self.outer)
        i = slice(self.outer, None)
        solved = np.linalg.solve(A[o, o], np.column_stack([A[o, i], b[o]]))
        information = A[i, i] - A[i, o] @ solved[:, :-1]
        return replace(
            self, information=(information + information.T) / 2, right_side=b[i] - A[i, o] @ solved[:, -1], outer=0
        )

    def without(self, at: Sequence[int], value: np.ndarray) -> Form:
        """Return the form with some parameters (k,) held at a distance `value` (k,) from the fit's values."""
        keep = np.setdiff1d(np.arange(len(self.right_side)), at)
        right_side = self.right_side[keep] - self.information[np.ix_(keep, np.asarray(at))] @ value
        return replace(
            self, information=self.information[np.ix_(keep, keep)], right_side=right_side, outer=self.outer - len(at)
        )

    @property
    def nothing(self) -> np.ndarray:
        """Logarithms of sizes (groups,) with which there are no unknown forces."""
        return np.full(len(self.names), NO_SIZE)

    def columns(self, chosen: Sequence[Candidate]) -> np.ndarray:
        """Return the places of candidates' columns among those of coefficients and candidates."""
        return len(self.group) + np.array([c for x in chosen for c in x.columns], int)


@dataclass(frozen=True)
class Posterior:
    """Logarithms of the most likely sizes (groups,) beside some candidates, gain of all, factors' mean and std."""

    logs: np.ndarray
    gain: float
    mean: np.ndarray
    std: np.ndarray

    def factors(self, form: Form, chosen: Sequence[Candidate]) -> list[np.ndarray]:
        """Return the factors of each chosen candidate's columns."""
        ends = np.cumsum([len(x.columns) for x in chosen])
        return np.split(self.mean[len(form.group) :], ends[:-1])


def build_form(
    along: Sequence[FittedLog],
    fit: Fit,
    unknown: UnknownForces,
    found: Sequence[Candidate],
    duration: float,
    runner: CallRunner = run_in_turn,
) -> Form:
    """Return the form about a fit without unknown forces but white ones.

    unknown: shapes of what the model may lack, as the last columns of the fitted logs (`score_test.beside`). duration
    [s]: of the longest log.
    """
    found = renumber_columns(found)
    C, K, count = sum(len(x.columns) for x in found), len(fit.information), unknown.count
    A, b = np.zeros((K + count + C, K + count + C)), np.zeros(K + count + C)
    A[:K, :K], b[:K] = fit.information, fit.right_side
    calls = [partial(_products, log, found) for log in along]
    logs = zip(runner(calls), fit.indices, unknown.index, strict=True)
    for gram, own, index in logs:
        at = np.r_[own, K + index, K + count : K + count + C]
        gram[1 : 1 + len(own), 1 : 1 + len(own)] = 0.0  # in the fit's information
        A[np.ix_(at, at)] += gram[1:, 1:]
        b[at[len(own) :]] -= gram[0, 1 + len(own) :]
    group = np.zeros(count, int)
    for k, one in enumerate(unknown.groups):
        group[one.every] = k
    machine = along[0].space.model.machine
    std = amount_stds(machine, found, duration)
    return Form(A, b, K, group, tuple(g.name for g in unknown.groups), tuple(found), std)


def amount_stds(machine: Machine, found: Sequence[Candidate], duration: float) -> np.ndarray:
    """Return the prior standard deviation of the factor of each candidate's columns, for logs of a duration [s]."""
    found = [x for x in found for _ in x.columns]
    typical = [x.placed.effect.typical_magnitude(Site.of(machine, x.placed.bodies, duration)) for x in found]
    return np.array([AMOUNT_STD * size / abs(x.placed.values["A"]) for x, size in zip(found, typical, strict=True)])


def _products(log: FittedLog, found: Sequence[Candidate]) -> np.ndarray:
    return SignatureColumns(log, found).products()


def posterior(
    form: Form, chosen: Sequence[Candidate], logs: np.ndarray | None = None, passes: int = PASSES
) -> Posterior:
    """Return the most likely sizes beside some candidates of a reduced form. logs: where the search begins."""
    G, columns, n = len(form.group), form.columns(chosen), len(form.names)
    at = np.r_[np.arange(G), columns]
    information, right_side = form.information[np.ix_(at, at)], form.right_side[at]
    fixed = form.amount_std[columns - G]

    def solve(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        size = np.r_[np.exp(logs)[form.group], fixed]
        if not len(size):
            return size, size, 0.0, size
        whole = size[:, None] * information * size
        whole[range(len(size)), range(len(size))] += 1
        pull = size * right_side
        root, fault = lapack.dpotrf(whole, lower=1)
        if fault:  # eliminations leave rounding errors
            values, axes = np.linalg.eigh(whole)
            values = np.maximum(values, 1.0)
            mean = axes @ (axes.T @ pull / values)
            return mean, axes**2 @ (1 / values), float(pull @ mean - np.log(values).sum()), size
        mean = lapack.dpotrs(root, pull, lower=1)[0]
        variance = np.diag(lapack.dpotri(root, lower=1)[0])
        return mean, variance, float(pull @ mean - 2 * np.log(np.diag(root)).sum()), size

    if logs is None:
        levels = [np.full(n, level) for level in LEVELS]
        logs = max(levels, key=lambda x: solve(x)[2])
    for _ in range(passes if G else 0):
        mean, variance, _, _ = solve(logs)
        logs = logs + sizes_step(mean[:G], variance[:G], form.group, logs, 1 / SIZE_SCATTER**2)
    mean, variance, gain, size = solve(logs)
    scatter = float(np.sum((logs - logs.mean()) ** 2)) / SIZE_SCATTER**2 if G else 0.0
    return Posterior(logs, gain - scatter, mean * size, np.sqrt(np.maximum(variance, 0)) * size)


def factor_of(form: Form, x: Candidate, logs: np.ndarray, beside: Sequence[Candidate] = ()) -> np.ndarray:
    """Return the factor of a candidate beside others, for sizes exp(logs)."""
    return posterior(form, every := [*beside, x], logs, 0).factors(form, every)[-1]


def first_gains(form: Form, chosen: Sequence[Candidate], logs: np.ndarray) -> np.ndarray:
    """Return the gain of each candidate beside those chosen, sizes unchanged; -inf where nothing shows it or its sign
    is impossible."""
    G, columns = len(form.group), form.columns(chosen)
    at, every = np.r_[np.arange(G), columns], np.arange(G, len(form.right_side))
    size = np.r_[np.exp(logs)[form.group], form.amount_std[columns - G]]
    inner = np.diag(size**-2.0) + form.information[np.ix_(at, at)]
    solved = np.linalg.solve(inner, np.column_stack([form.information[np.ix_(at, every)], form.right_side[at]]))
    S = form.information[np.ix_(every, every)] - form.information[np.ix_(every, at)] @ solved[:, :-1]
    g = form.right_side[every] - form.information[np.ix_(every, at)] @ solved[:, -1]
    own = np.diag(form.information)[G:]
    found = np.full(len(form.candidates), -np.inf)
    for k, x in enumerate(form.candidates):
        columns = np.array(x.columns)
        columns = columns[own[columns] > max(MIN_SIGNATURE, MIN_PHASE_SHARE * own[columns].max())]
        if not len(columns):
            continue
        std = form.amount_std[columns]
        whole = np.eye(len(std)) + std[:, None] * S[np.ix_(columns, columns)] * std
        step = np.linalg.solve(whole, std * g[columns])
        if not _is_impossible(x, step * std):
            found[k] = step @ (std * g[columns]) - np.linalg.slogdet(whole)[1]
    return found


def _is_impossible(x: Candidate, factor: np.ndarray) -> bool:
    """Tell if a candidate's factor is impossible: of the wrong sign, or beyond the largest amount."""
    effect = x.placed.effect
    # If negative amounts are tried, too, a step back is one of those; a table has no other sign.
    forward = effect.positive or min(effect.grid, default=-1.0) < 0
    if forward and len(factor) == 1 and factor[0] <= 0:
        return True
    return bool(np.hypot.reduce(factor) * abs(x.placed.values["A"]) > 2 * effect.largest)


@dataclass(frozen=True)
class Chosen:
    """Candidates with the factors of their columns, and the gain of each beside those before it.

    left: gain of unknown forces beside them. sizes: of these, over typical, by group.
    """

    candidates: tuple[Candidate, ...]
    factors: tuple[np.ndarray, ...]
    gains: tuple[float, ...]
    left: float
    sizes: tuple[float, ...]


def least_gain(form: Form, odds: float = MIN_ODDS) -> float:
    """Return the gain from which a candidate is added by its odds, given the number of names tried."""
    return float(2 * np.log(odds * max(len({x.name for x in form.candidates}), 1)))


def choose(form: Form, known: Collection[str] = (), odds: float = MIN_ODDS, most: int = MOST_AT_ONCE) -> Chosen:
    """Add candidates one after the other, the one with the largest gain first, as long as the gain is clear.

    known: names of effects in the model, candidates of which are further harmonics. They are not added, but nothing
    that is as well a harmonic of them is, such as a ripple of another wheel that turns equally fast. odds: posterior
    odds over unknown forces alone from which a candidate is added. most: of them.

    One gain alone counts where later ones are below MIN_SHARE of it: to first order, they may be errors of its form.
    """
    form = form.reduced()
    now = posterior(form, ())
    left = now.gain
    chosen, gains = list[Candidate](), list[float]()
    while len(chosen) < most:
        now = _exchanged(form, chosen, now, known)
        taken = {x.name for x in chosen}
        finalists = list[int]()
        for logs in (now.logs, form.nothing):  # curves hide what they explain as well
            first = _without_harmonics(form, first_gains(form, chosen, logs), known)
            others = [k for k in _best_of_each_variant(form, first) if form.candidates[k].name not in taken]
            finalists += [k for k in others[:FINALISTS] if k not in finalists]
        tried = [(k, _beside(form, [*chosen, form.candidates[k]], now.logs)) for k in finalists]
        tried = [
            (k, p)
            for k, p in tried
            if not _is_impossible(form.candidates[k], p.factors(form, [*chosen, form.candidates[k]])[-1])
        ]
        if not tried:
            break
        k, best = max(tried, key=lambda x: x[1].gain)
        gain = best.gain - now.gain
        if gain < max(least_gain(form, odds), MIN_SHARE * gains[0] if gains else 0.0):
            break
        chosen.append(form.candidates[k])
        gains.append(gain)
        now = posterior(form, chosen, best.logs, COMPARING_PASSES)
    if chosen:
        left = now.gain - posterior(form, chosen, form.nothing, 0).gain
    return Chosen(
        tuple(chosen), tuple(now.factors(form, chosen)) if chosen else (), tuple(gains), left, tuple(np.exp(now.logs))
    )


def likeliest(form: Form, known: Collection[str], count: int) -> list[Chosen]:
    """Return the candidates, each by itself, that gain most, however little."""
    form = form.reduced()
    now = posterior(form, ())
    gains = _without_harmonics(form, first_gains(form, (), now.logs), known)
    found = []
    for k in _best_of_each_variant(form, gains)[:count]:
        one = (form.candidates[k],)
        best = _beside(form, one, now.logs)
        found.append(
            Chosen(one, tuple(best.factors(form, one)), (best.gain - now.gain,), 0.0, tuple(np.exp(best.logs)))
        )
    return found


def _beside(form: Form, chosen: Sequence[Candidate], logs: np.ndarray) -> Posterior:
    """Return the most likely sizes beside some candidates, sought from earlier ones and from next to nothing.

    Where a candidate explains all that the unknown forces did, sizes fall to nothing, which takes many passes.
    """
    starts = (logs, np.full(len(form.names), LEVELS[0]))
    return max((posterior(form, chosen, x, COMPARING_PASSES) for x in starts), key=lambda p: p.gain)


def _without_harmonics(form: Form, gains: np.ndarray, known: Collection[str]) -> np.ndarray:
    """Return the gains without candidates that a harmonic of a known effect explains about as well."""
    harmonic: dict[str, float] = {}
    for x, gain in zip(form.candidates, gains, strict=True):
        if x.name in known:
            effect = x.placed.effect.name
            harmonic[effect] = max(harmonic.get(effect, -np.inf), float(gain) + HARMONIC_GAIN)
    least = [np.inf if x.name in known else harmonic.get(x.placed.effect.name, -np.inf) for x in form.candidates]
    return np.where(gains > least, gains, -np.inf)


HARMONIC_GAIN = 10.0  # by which another effect must be better than a harmonic of a known one


def _exchanged(form: Form, chosen: list[Candidate], now: Posterior, known: Collection[str]) -> Posterior:
    """Exchange chosen candidates, in place, for others that gain more beside the rest."""
    for k in range(len(chosen)):
        others = [*chosen[:k], *chosen[k + 1 :]]
        taken = {x.name for x in others}
        best = _best_of_each_variant(form, _without_harmonics(form, first_gains(form, others, now.logs), known))
        best = [j for j in best if form.candidates[j].name not in taken][:1]
        if not best or form.candidates[best[0]] is chosen[k]:
            continue
        other = [*chosen[:k], form.candidates[best[0]], *chosen[k + 1 :]]
        found = posterior(form, other, now.logs, COMPARING_PASSES)
        if found.gain > now.gain + EXCHANGE_GAIN:
            chosen[k], now = form.candidates[best[0]], found
    return now


EXCHANGE_GAIN = 1.0  # by which another candidate must be better to take a chosen one's place


def _best_of_each_variant(form: Form, gains: np.ndarray) -> list[int]:
    """Return the best candidate of each variant that gains, best first."""
    return best_of_each(form, gains, lambda x: x.variant, 0.0)


def best_of_each(
    form: Form, gains: np.ndarray, kind: Callable[[Candidate], Hashable], least: float | None = None
) -> list[int]:
    """Return the best candidate of each kind, best first. least: gain that it must exceed."""
    best: dict[Hashable, int] = {}
    for k in np.argsort(-gains):
        if least is None or gains[k] > least:
            best.setdefault(kind(form.candidates[k]), int(k))
    return list(best.values())
