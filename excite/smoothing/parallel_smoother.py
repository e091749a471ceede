"""Smoothing of a chain of linear Gaussian stages by divide and conquer.

A stage leads from x to the next state x+ and observes x: x+ = A x + b + e with e ~ N(0, C), and a log-likelihood
eta' x - x' J x / 2. With the multiplier l (slope of the log-likelihood ahead, e = C l+) it is a scattering element

    x+ = A x + b + C l+          l = A' l+ + eta - J x

and two elements in a row combine to one (Redheffer star product; as an associative operation: Sarkka and
Garcia-Fernandez, "Temporal Parallelization of Bayesian Smoothers", IEEE TAC 66, 2021). Pairs are combined level by
level, each level in one batched call, as a sequential filter in numpy spends its time on call overhead. No inverse of C
or J is formed, so exact dynamics (C of low rank) and unobserved states (J of low rank) need no special treatment.
Matrices are combined once; b and eta, of any number of columns, are combined by them afterwards.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

FIELDS = ("A", "C", "J")
Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Elements:
    """K elements of a chain: A, C, J (K, n, n). An element without transition has zero A and C."""

    A: np.ndarray
    C: np.ndarray
    J: np.ndarray

    def __len__(self) -> int:
        return len(self.A)

    def part(self, keep: slice) -> Elements:
        return Elements(self.A[keep], self.C[keep], self.J[keep])


@dataclass(frozen=True)
class _CombinationLevel:
    """Pairs combined at one level, kept to recover the states between the two halves of each pair."""

    G: np.ndarray
    first: Elements
    second: Elements
    count: int

    def combine(self, b: np.ndarray, eta: np.ndarray) -> Pair:
        """Combine b and eta (count, n, w) of pairs; a last one without partner stays."""
        end = 2 * len(self.G)
        first, second, eta_second = b[0:end:2], b[1:end:2], eta[1:end:2]
        middle = self.G @ (first + self.first.C @ eta_second)
        slope = eta_second - self.second.J @ middle
        return (
            np.concatenate([self.second.A @ middle + second, b[end:]]),
            np.concatenate([eta[0:end:2] + self.first.A.transpose(0, 2, 1) @ slope, eta[end:]]),
        )


@dataclass(frozen=True)
class CombinedElements:
    """Elements combined to one, `total`."""

    total: Elements
    levels: tuple[_CombinationLevel, ...]

    def combine(self, b: np.ndarray, eta: np.ndarray) -> list[Pair]:
        """Return b and eta (K, n, w) of the elements and of each level, the last of all elements (1, n, w)."""
        found = [(b, eta)]
        for level in self.levels:
            found.append(level.combine(*found[-1]))
        return found

    def states_between(self, columns: Sequence[Pair], left: np.ndarray, right: np.ndarray) -> Pair:
        """States and slopes (K - 1, n, w) between the elements.

        columns: what `combine` returns. left (n, w): state before the first element. right (n, w): slope after the
        last.
        """

        def middle(k: int, before: np.ndarray, after: np.ndarray) -> Pair:
            level, end = self.levels[k], 2 * len(self.levels[k].G)
            b, eta = columns[k][0][0:end:2], columns[k][1][1:end:2]
            slope = level.second.A.transpose(0, 2, 1) @ after + eta
            state = level.G @ (level.first.A @ before + b + level.first.C @ slope)
            return state, slope - level.second.J @ state

        return self._between(middle, left, right)

    def moments_between(self, left: np.ndarray, right: np.ndarray) -> Pair:
        """Covariances given all stages before, and information from all stages after (K - 1, n, n), of the states.

        left (n, n): covariance before the first element. right (n, n): information after the last.
        """

        def middle(k: int, before: np.ndarray, after: np.ndarray) -> Pair:
            first, second = self.levels[k].first, self.levels[k].second
            ahead = first.A @ shrink(before, first.J) @ first.A.transpose(0, 2, 1) + first.C
            return ahead, second.A.transpose(0, 2, 1) @ shrink(after, second.C) @ second.A + second.J

        return self._between(middle, left, right)

    def _between(
        self, middle: Callable[[int, np.ndarray, np.ndarray], Pair], left: np.ndarray, right: np.ndarray
    ) -> Pair:
        """Values before and after the states between the elements, from those at both ends, level by level."""
        before_all, after_all = left[None], right[None]
        for k, level in reversed(list(enumerate(self.levels))):
            pairs = len(level.G)
            before, after = np.empty((2, level.count, *left.shape))
            before[0 : 2 * pairs : 2], after[1 : 2 * pairs : 2] = before_all[:pairs], after_all[:pairs]
            before[1 : 2 * pairs : 2], after[0 : 2 * pairs : 2] = middle(k, before_all[:pairs], after_all[:pairs])
            if level.count % 2:
                before[-1], after[-1] = before_all[-1], after_all[-1]
            before_all, after_all = before, after
        return before_all[1:], after_all[:-1]


def shrink(P: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Return P (I + J P)^-1 (K, n, n): a covariance P after information J, or information P seen through noise J."""
    return np.asarray(np.linalg.solve(np.eye(P.shape[-1]) + P @ J, P))


@dataclass(frozen=True)
class SmoothedChain:
    """A chain of consecutive parts: each combined, and these combined with each other (`top`)."""

    top: CombinedElements
    parts: tuple[CombinedElements, ...]

    @property
    def without_levels(self) -> SmoothedChain:
        """The chain without the levels that recover its states, which take much memory."""
        return SmoothedChain(replace(self.top, levels=()), tuple(replace(p, levels=()) for p in self.parts))

    def states(self, b: np.ndarray, eta: np.ndarray) -> Pair:
        """Most likely states and slopes (K - 1, n, w) between the elements, for their b and eta (K, n, w).

        The random part e of an element is C times the slope after it.
        """
        ends = np.cumsum([0, *(p.levels[0].count if p.levels else 1 for p in self.parts)])
        assert ends[-1] == len(b)  # else the levels are gone
        cuts = [slice(*own) for own in itertools.pairwise(ends)]
        columns = [part.combine(b[own], eta[own]) for part, own in zip(self.parts, cuts, strict=True)]
        above = self.top.combine(*(np.concatenate(x) for x in zip(*(own[-1] for own in columns), strict=True)))
        inner = self.top.states_between(above, *np.zeros((2, *b.shape[1:])))
        return self._between(lambda k, left, right: self.parts[k].states_between(columns[k], left, right), inner)

    def moments(self) -> Pair:
        """Covariances given all stages before, and information from all stages after (K - 1, n, n), of the states."""
        inner = self.top.moments_between(*np.zeros((2, *self.top.total.A.shape[1:])))
        return self._between(lambda k, left, right: self.parts[k].moments_between(left, right), inner)

    def _between(self, within: Callable[[int, np.ndarray, np.ndarray], Pair], inner: Pair) -> Pair:
        """Values before and after the states between all elements, from those between the parts."""
        zero = np.zeros_like(inner[0][:1])
        before, after = np.concatenate([zero, inner[0]]), np.concatenate([inner[1], zero])
        left, right = list[np.ndarray](), list[np.ndarray]()
        for k, (first, last) in enumerate(zip(before, after, strict=True)):
            own = within(k, first, last)
            left += [first[None], own[0]]
            right += [own[1], last[None]]
        return np.concatenate(left[1:]), np.concatenate(right[:-1])


def smooth_chain(parts: Sequence[CombinedElements]) -> SmoothedChain:
    """Combine consecutive sections to one chain.

    The first section begins with the prior of the first state (A zero), the last one ends with an element without
    transition.
    """
    top = combine(Elements(*(np.concatenate([getattr(p.total, f) for p in parts]) for f in FIELDS)))
    return SmoothedChain(top, tuple(parts))


def combine(elements: Elements) -> CombinedElements:
    """Combine elements pair by pair, in about log2(K) batched levels.

    About 100 at a time stay in the processor's cache.
    """
    n = elements.A.shape[1]
    levels: list[_CombinationLevel] = []
    eye = np.eye(n)
    while len(elements) > 1:
        pairs = len(elements) // 2
        i, j = elements.part(slice(0, 2 * pairs, 2)), elements.part(slice(1, 2 * pairs, 2))
        G = np.linalg.inv(i.C @ j.J + eye)
        # The middle state as a function of x and of l+, in one product.
        middle = G @ np.concatenate([i.A, i.C], axis=2)
        end = j.A @ middle
        C = end[:, :, n:] @ j.A.transpose(0, 2, 1) + j.C
        J = i.J + i.A.transpose(0, 2, 1) @ j.J @ middle[:, :, :n]
        combined = Elements(end[:, :, :n], (C + C.transpose(0, 2, 1)) / 2, (J + J.transpose(0, 2, 1)) / 2)
        levels.append(_CombinationLevel(G, i, j, len(elements)))
        if len(elements) % 2:
            last = elements.part(slice(-1, None))
            combined = Elements(*(np.concatenate([getattr(combined, f), getattr(last, f)]) for f in FIELDS))
        elements = combined
    return CombinedElements(elements, tuple(levels))
