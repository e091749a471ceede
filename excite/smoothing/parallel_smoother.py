"""Smoothing of a chain of linear Gaussian stages by divide and conquer.

A stage leads from x to the next state x+ and observes x: x+ = A x + b + e with e ~ N(0, C), and a log-likelihood
eta' x - x' J x / 2. With the multiplier l (slope of the log-likelihood ahead, e = C l+) it is a scattering element

    x+ = A x + b + C l+          l = A' l+ + eta - J x

and two elements in a row combine to one (Redheffer star product; as an associative operation: Sarkka and
Garcia-Fernandez, "Temporal Parallelization of Bayesian Smoothers", IEEE TAC 66, 2021). Pairs are combined level by
level, each level in one batched call, as a sequential filter in numpy spends its time on call overhead. No inverse of C
or J is formed, so exact dynamics (C of low rank) and unobserved states (J of low rank) need no special treatment.
b and eta have c columns: the data, then the slopes by parameters shared by all stages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

FIELDS = ("A", "b", "C", "eta", "J")
Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Elements:
    """K elements of a chain: A, C, J (K, n, n), b, eta (K, n, c). An element without transition has zero A, b and C."""

    A: np.ndarray
    b: np.ndarray
    C: np.ndarray
    eta: np.ndarray
    J: np.ndarray

    def __len__(self) -> int:
        return len(self.A)

    def part(self, keep: slice) -> Elements:
        return Elements(self.A[keep], self.b[keep], self.C[keep], self.eta[keep], self.J[keep])


@dataclass(frozen=True)
class _CombinationLevel:
    """Pairs combined at one level, kept to recover the states between the two halves of each pair."""

    G: np.ndarray
    first: Elements
    second: Elements
    count: int


@dataclass(frozen=True)
class CombinedElements:
    """Elements combined to one (`total`), and the quadratic form Z (c, c) of the states integrated out."""

    Z: np.ndarray
    total: Elements
    levels: tuple[_CombinationLevel, ...]

    def states_between(self, weights: np.ndarray, left: np.ndarray, right: np.ndarray) -> Pair:
        """States and slopes (K - 1, n, w) between the elements.

        weights (c, w): of the columns. left (n, w): state before the first element. right (n, w): slope after the last.
        """

        def middle(level: _CombinationLevel, before: np.ndarray, after: np.ndarray) -> Pair:
            first, second = level.first, level.second
            slope = second.A.transpose(0, 2, 1) @ after + second.eta @ weights
            state = level.G @ (first.A @ before + first.b @ weights + first.C @ slope)
            return state, slope - second.J @ state

        return self._between(middle, left, right)

    def moments_between(self, left: np.ndarray, right: np.ndarray) -> Pair:
        """Covariances given all stages before, and information from all stages after (K - 1, n, n), of the states.

        left (n, n): covariance before the first element. right (n, n): information after the last.
        """

        def middle(level: _CombinationLevel, before: np.ndarray, after: np.ndarray) -> Pair:
            first, second = level.first, level.second
            ahead = first.A @ shrink(before, first.J) @ first.A.transpose(0, 2, 1) + first.C
            return ahead, second.A.transpose(0, 2, 1) @ shrink(after, second.C) @ second.A + second.J

        return self._between(middle, left, right)

    def _between(
        self, middle: Callable[[_CombinationLevel, np.ndarray, np.ndarray], Pair], left: np.ndarray, right: np.ndarray
    ) -> Pair:
        """Values before and after the states between the elements, from those at both ends, level by level."""
        before_all, after_all = left[None], right[None]
        for level in reversed(self.levels):
            pairs = len(level.G)
            before, after = np.empty((2, level.count, *left.shape))
            before[0 : 2 * pairs : 2], after[1 : 2 * pairs : 2] = before_all[:pairs], after_all[:pairs]
            before[1 : 2 * pairs : 2], after[0 : 2 * pairs : 2] = middle(level, before_all[:pairs], after_all[:pairs])
            if level.count % 2:
                before[-1], after[-1] = before_all[-1], after_all[-1]
            before_all, after_all = before, after
        return before_all[1:], after_all[:-1]


def shrink(P: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Return P (I + J P)^-1 (K, n, n): a covariance P after information J, or information P seen through noise J."""
    return np.asarray(np.linalg.solve(np.eye(P.shape[-1]) + P @ J, P))


@dataclass(frozen=True)
class SmoothedChain:
    """A chain reduced to one quadratic form.

    Z (c, c): for parameter steps p (c - 1,), twice the negative log-likelihood with all states integrated out is
    [1 p]' Z [1 p] plus a constant.
    """

    Z: np.ndarray
    top: CombinedElements
    parts: tuple[CombinedElements, ...]

    @property
    def without_levels(self) -> SmoothedChain:
        """The chain without the levels that recover its states, which take most of the memory."""
        return SmoothedChain(self.Z, replace(self.top, levels=()), tuple(replace(p, levels=()) for p in self.parts))

    def states(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Most likely states and slopes (K - 1, n) between the elements for parameter steps p (c - 1,).

        The random part e of a stage is C times the slope after it.
        """
        states, slopes = self._states_for(np.concatenate([[1.0], p])[:, None])
        return states[:, :, 0], slopes[:, :, 0]

    def slopes(self, of: slice) -> np.ndarray:
        """Derivatives of the most likely states by some of the parameters (K - 1, n, w)."""
        return self._states_for(np.eye(len(self.Z))[:, 1:][:, of])[0]

    def moments(self) -> Pair:
        """Covariances given all stages before, and information from all stages after (K - 1, n, n), of the states."""
        zero = np.zeros_like(self.top.total.A[0])
        return self._between(CombinedElements.moments_between, zero)

    def _states_for(self, weights: np.ndarray) -> Pair:
        """Most likely states and slopes (K - 1, n, w) for weights (c, w) of the columns of b and eta."""
        zero = np.zeros((self.top.total.A.shape[1], weights.shape[1]))
        return self._between(lambda part, left, right: part.states_between(weights, left, right), zero)

    def _between(self, within: Callable[[CombinedElements, np.ndarray, np.ndarray], Pair], zero: np.ndarray) -> Pair:
        inner = within(self.top, zero, zero)
        before, after = np.concatenate([zero[None], inner[0]]), np.concatenate([inner[1], zero[None]])
        left, right = list[np.ndarray](), list[np.ndarray]()
        for part, first, last in zip(self.parts, before, after, strict=True):
            own = within(part, first, last)
            left += [first[None], own[0]]
            right += [own[1], last[None]]
        return np.concatenate(left[1:]), np.concatenate(right[:-1])


def smooth_chain(parts: Sequence[CombinedElements]) -> SmoothedChain:
    """Combine consecutive sections to one chain.

    The first section begins with the prior of the first state (A zero), the last one ends with an element without
    transition.
    """
    top = combine(Elements(*(np.concatenate([getattr(p.total, f) for p in parts]) for f in FIELDS)))
    return SmoothedChain(sum((p.Z for p in parts), top.Z), top, tuple(parts))


def combine(elements: Elements) -> CombinedElements:
    """Combine elements pair by pair, in about log2(K) batched levels.

    About 100 at a time stay in the processor's cache.
    """
    n, c = elements.b.shape[1:]
    Z = np.zeros((c, c))
    levels: list[_CombinationLevel] = []
    eye = np.eye(n)
    while len(elements) > 1:
        pairs = len(elements) // 2
        i, j = elements.part(slice(0, 2 * pairs, 2)), elements.part(slice(1, 2 * pairs, 2))
        G = np.linalg.inv(i.C @ j.J + eye)
        # The middle state as a function of x, of l+ and of the data, in one product.
        middle = G @ np.concatenate([i.A, i.C, i.b + i.C @ j.eta], axis=2)
        end = j.A @ middle
        weighted = j.J @ middle
        slope = j.eta - weighted[:, :, 2 * n :]
        back = i.A.transpose(0, 2, 1) @ np.concatenate([weighted[:, :, :n], slope], axis=2)
        Z -= _sum_of_products(j.eta, middle[:, :, 2 * n :]) + _sum_of_products(i.b, slope)
        C = end[:, :, n : 2 * n] @ j.A.transpose(0, 2, 1) + j.C
        J = i.J + back[:, :, :n]
        combined = Elements(
            end[:, :, :n],
            end[:, :, 2 * n :] + j.b,
            (C + C.transpose(0, 2, 1)) / 2,
            i.eta + back[:, :, n:],
            (J + J.transpose(0, 2, 1)) / 2,
        )
        levels.append(_CombinationLevel(G, i, j, len(elements)))
        if len(elements) % 2:
            last = elements.part(slice(-1, None))
            combined = Elements(*(np.concatenate([getattr(combined, f), getattr(last, f)]) for f in FIELDS))
        elements = combined
    return CombinedElements((Z + Z.T) / 2, elements, tuple(levels))


def _sum_of_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product: np.ndarray = a.reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2])
    return product
