"""Smoothing of a chain of linear Gaussian stages by divide and conquer.

A stage leads from x to the next x+ and sees x: x+ = A x + b + e with e ~ N(0, C), and a log-likelihood
eta' x - x' J x / 2. Written with the multiplier l (the slope of what lies ahead, e = C l+) it is a scattering section

    x+ = A x + b + C l+          l = A' l+ + eta - J x

and two sections in a row make one (Redheffer's star product; as an associative operation: Sarkka and Garcia-Fernandez,
"Temporal Parallelization of Bayesian Smoothers", IEEE TAC 66, 2021). Pairs are joined level by level, all pairs of a
level in one batched call, which is what makes it fast in numpy: a sequential filter spends its time in call overhead.
No inverse of C or J is formed, so exact dynamics (C of low rank) and unseen states (J of low rank) need no special
care. b and eta have columns: the first is the data, the others how they move with parameters shared by all stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

FIELDS = ("A", "b", "C", "eta", "J")


@dataclass(frozen=True)
class Stages:
    """K stages: A, C, J (K, n, n), b, eta (K, n, c). A stage without transition has A, b, C zero."""

    A: np.ndarray
    b: np.ndarray
    C: np.ndarray
    eta: np.ndarray
    J: np.ndarray

    def __len__(self) -> int:
        return len(self.A)

    def part(self, keep: slice) -> Stages:
        return Stages(self.A[keep], self.b[keep], self.C[keep], self.eta[keep], self.J[keep])


@dataclass(frozen=True)
class _Level:
    """What is needed to come back to the states between the two halves of each pair."""

    G: np.ndarray
    first: Stages
    second: Stages
    count: int


@dataclass(frozen=True)
class Section:
    """Stages joined to one (`whole`), and the quadratic form Z (c, c) of what was integrated out."""

    Z: np.ndarray
    whole: Stages
    levels: tuple[_Level, ...]

    def between(self, weights: np.ndarray, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States and slopes (K - 1, n, w) between the stages for weights (c, w) of the columns, the state (n, w) before
        the first and the slope (n, w) behind the last."""
        ins, outs = left[None], right[None]
        for level in reversed(self.levels):
            pairs = len(level.G)
            i, j = level.first, level.second
            ahead = j.A.transpose(0, 2, 1) @ outs[:pairs] + j.eta @ weights
            x = level.G @ (i.A @ ins[:pairs] + i.b @ weights + i.C @ ahead)
            before, behind = np.empty((2, level.count, *left.shape))
            before[0 : 2 * pairs : 2], before[1 : 2 * pairs : 2] = ins[:pairs], x
            behind[0 : 2 * pairs : 2], behind[1 : 2 * pairs : 2] = ahead - j.J @ x, outs[:pairs]
            if level.count % 2:
                before[-1], behind[-1] = ins[-1], outs[-1]
            ins, outs = before, behind
        return ins[1:], outs[:-1]


@dataclass(frozen=True)
class Solved:
    """A chain reduced to one quadratic form.

    Z (c, c): twice the negative log-likelihood of all states integrated out is [1 p]' Z [1 p] plus what doesn't depend
    on p, for parameter steps p (c - 1,).
    """

    Z: np.ndarray
    top: Section
    parts: tuple[Section, ...]

    @property
    def closed(self) -> Solved:
        """Without the way back to the states, which is most of its memory."""
        return Solved(self.Z, replace(self.top, levels=()), tuple(replace(p, levels=()) for p in self.parts))

    def states(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The most likely states and slopes (K - 1, n) between the stages for parameter steps p (c - 1,).

        The random part e of a stage is C times the slope behind it.
        """
        states, slopes = self._weighed(np.concatenate([[1.0], p])[:, None])
        return states[:, :, 0], slopes[:, :, 0]

    def slopes(self, of: slice) -> np.ndarray:
        """How the most likely states move with some of the parameters (K - 1, n, w)."""
        return self._weighed(np.eye(len(self.Z))[:, 1:][:, of])[0]

    def _weighed(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Most likely states and slopes (K - 1, n, w) for weights (c, w) of the columns of b and eta."""
        zero = np.zeros((self.top.whole.A.shape[1], weights.shape[1]))
        inner = self.top.between(weights, zero, zero)
        before, behind = np.concatenate([zero[None], inner[0]]), np.concatenate([inner[1], zero[None]])
        states: list[np.ndarray] = []
        slopes: list[np.ndarray] = []
        for part, left, right in zip(self.parts, before, behind, strict=True):
            x, slope = part.between(weights, left, right)
            states += [left[None], x]
            slopes += [slope, right[None]]
        return np.concatenate(states[1:]), np.concatenate(slopes[:-1])


def solve(parts: Sequence[Section]) -> Solved:
    """A chain given as sections in a row. The first begins with what is known of the first state (A zero), the last
    ends with a stage without transition."""
    top = section(Stages(*(np.concatenate([getattr(p.whole, f) for p in parts]) for f in FIELDS)))
    return Solved(sum((p.Z for p in parts), top.Z), top, tuple(parts))


def section(stages: Stages) -> Section:
    """Stages joined pair by pair: about log2(K) batched levels. Some 100 at a time stay in the processor's cache."""
    n, c = stages.b.shape[1:]
    Z = np.zeros((c, c))
    levels: list[_Level] = []
    eye = np.eye(n)
    while len(stages) > 1:
        pairs = len(stages) // 2
        i, j = stages.part(slice(0, 2 * pairs, 2)), stages.part(slice(1, 2 * pairs, 2))
        G = np.linalg.inv(i.C @ j.J + eye)
        # One product for the middle state as it follows from x, from l+ behind and from the data.
        middle = G @ np.concatenate([i.A, i.C, i.b + i.C @ j.eta], axis=2)
        end = j.A @ middle
        seen = j.J @ middle
        slope = j.eta - seen[:, :, 2 * n :]
        back = i.A.transpose(0, 2, 1) @ np.concatenate([seen[:, :, :n], slope], axis=2)
        Z -= _sum_of_products(j.eta, middle[:, :, 2 * n :]) + _sum_of_products(i.b, slope)
        C = end[:, :, n : 2 * n] @ j.A.transpose(0, 2, 1) + j.C
        J = i.J + back[:, :, :n]
        joined = Stages(
            end[:, :, :n],
            end[:, :, 2 * n :] + j.b,
            (C + C.transpose(0, 2, 1)) / 2,
            i.eta + back[:, :, n:],
            (J + J.transpose(0, 2, 1)) / 2,
        )
        levels.append(_Level(G, i, j, len(stages)))
        if len(stages) % 2:
            rest = stages.part(slice(-1, None))
            joined = Stages(*(np.concatenate([getattr(joined, f), getattr(rest, f)]) for f in FIELDS))
        stages = joined
    return Section((Z + Z.T) / 2, stages, tuple(levels))


def _sum_of_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product: np.ndarray = a.reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2])
    return product
