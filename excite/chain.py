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

from dataclasses import dataclass

import numpy as np


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
class Solved:
    """A chain reduced to one quadratic form.

    Z (c, c): the negative log-likelihood of all states integrated out is [1 p]' Z [1 p] / 2 plus what doesn't depend
    on p, for parameter steps p (c - 1,).
    """

    Z: np.ndarray
    levels: tuple[_Level, ...]

    def states(self, p: np.ndarray) -> np.ndarray:
        """The most likely states (K - 1, n) between the stages for parameter steps p (c - 1,)."""
        weights = np.concatenate([[1.0], p])
        n = self.levels[0].G.shape[1]
        left, right = np.zeros((1, n, 1)), np.zeros((1, n, 1))
        between = np.zeros((0, n, 1))
        for level in reversed(self.levels):
            pairs = len(level.G)
            i, j = level.first, level.second
            ahead = j.A.transpose(0, 2, 1) @ right[:pairs] + (j.eta @ weights)[:, :, None]
            x = level.G @ (i.A @ left[:pairs] + (i.b @ weights)[:, :, None] + i.C @ ahead)
            slope = ahead - j.J @ x
            wider, behind, joined = (np.empty((level.count, n, 1)) for _ in range(3))
            wider[0 : 2 * pairs : 2], wider[1 : 2 * pairs : 2] = left[:pairs], x
            behind[0 : 2 * pairs : 2], behind[1 : 2 * pairs : 2] = slope, right[:pairs]
            if level.count % 2:
                wider[-1], behind[-1] = left[-1], right[-1]
            joined = joined[: level.count - 1]
            joined[0 : 2 * pairs : 2] = x
            joined[1::2] = between
            left, right, between = wider, behind, joined
        return between[:, :, 0]


def solve(stages: Stages) -> Solved:
    """Join all stages (at least two) pair by pair: about log2(K) batched levels, memory of order K."""
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
            joined = Stages(
                *(np.concatenate([getattr(joined, f), getattr(rest, f)]) for f in ("A", "b", "C", "eta", "J"))
            )
        stages = joined
    return Solved((Z + Z.T) / 2, tuple(levels))


def _sum_of_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product: np.ndarray = a.reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2])
    return product
