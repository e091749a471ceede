"""Forces that a model lacks, as functions of speed, position and time whose sizes come from the data.

Each curve is piecewise linear on nodes, a Gaussian process with an exponential kernel: the sum of a rough and a smooth
one. A size is the standard deviation of one such component, the same for all its nodes; it maximises the marginal
likelihood of the linear Gaussian coefficients, and is zero where the data show none. Sources: D. MacKay, "Bayesian
interpolation", Neural Computation 4, 1992; H. Zhou et al., "MM algorithms for variance components models", 2019.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite.smoothing.motion_readings import LEAST_GAIN

WITH_SPEED, WITH_POSITION, SLOW = "with speed", "with position", "slow"
SPEED_NODES, POSITION_NODES, TIME_NODES = 7, 20, 6  # of a curve; finer structure counts as fast noise
SPEED_SCALES, POSITION_SCALES, TIME_SCALES = (0.1, 1.0), (0.06, 0.5), (0.5,)  # of kernels, shares of the range
MAX_UPDATES, FEW_UPDATES = 40, 5  # of sizes, for one quadratic form


@dataclass(frozen=True)
class Curve:
    """A piecewise linear function of one variable.

    kind: "with speed", "with position" or "slow". nodes (m,): values of the variable [SI]. sign: of the speeds for
    which it holds, 0 for all. part: index of the log for which it holds, -1 for all. scales: lengths of the
    exponential kernels [SI].
    """

    kind: str
    nodes: np.ndarray
    scales: tuple[float, ...]
    sign: int = 0
    part: int = -1

    def weights(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first of two neighbouring nodes (N,) of each value x (N,), and the weight (N,) of the second."""
        at = np.clip(np.searchsorted(self.nodes, x) - 1, 0, len(self.nodes) - 2)
        share = (x - self.nodes[at]) / np.diff(self.nodes)[at]
        return at, np.clip(share, 0.0, 1.0)

    def roots(self) -> list[np.ndarray]:
        """Return a square root (m, m) of each kernel's covariance between the nodes, for a size of one."""
        distance = np.abs(self.nodes[:, None] - self.nodes)
        jitter = 1e-9 * np.eye(len(distance))
        rough = np.exp(-distance / self.scales[0])
        smooth = [(1 + np.sqrt(3) * distance / s) * np.exp(-np.sqrt(3) * distance / s) for s in self.scales[1:]]
        return [np.linalg.cholesky(one + jitter) for one in (rough, *smooth)]


@dataclass(frozen=True)
class Component:
    """One component of discrepancy whose size is sought: of a channel, by its kind and scale [SI].

    columns: of the standardised coefficients that belong to it.
    """

    channel: int
    kind: str
    scale: float
    columns: np.ndarray


@dataclass(frozen=True)
class Basis:
    """Curves of all channels, with the map from standardised coefficients to values at their nodes.

    curves: by channel. first: index of each curve's first node among its channel's. count: number of nodes by channel.
    root (n, k): maps standardised coefficients of all components to the values at the nodes of all channels.
    """

    curves: tuple[tuple[Curve, ...], ...]
    first: tuple[tuple[int, ...], ...]
    count: tuple[int, ...]
    root: np.ndarray
    components: tuple[Component, ...]

    @property
    def start(self) -> np.ndarray:
        """Index of the first node of each channel among all."""
        return np.concatenate([[0], np.cumsum(self.count)])[:-1]

    def rows(self, channel: int, part: int, speed: np.ndarray, position: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the weights (N, n_channel) of a channel's nodes in N samples of a log."""
        found = np.zeros((len(t), self.count[channel]))
        for curve, first in zip(self.curves[channel], self.first[channel], strict=True):
            if curve.part not in (-1, part):
                continue
            x = {WITH_SPEED: np.abs(speed), WITH_POSITION: position, SLOW: t}[curve.kind]
            at, share = curve.weights(x)
            on = np.flatnonzero(np.sign(speed) == curve.sign) if curve.sign else np.arange(len(t))
            found[on, first + at[on]] = 1 - share[on]
            found[on, first + at[on] + 1] = share[on]
        return found


def build_basis(
    speed: Sequence[np.ndarray], position: Sequence[np.ndarray], t: Sequence[np.ndarray], channels: int
) -> Basis:
    """Build the curves of all channels from the motions of all logs: speed, position (N, channels), t (N,) of each."""
    curves = tuple(
        tuple(_channel_curves([v[:, k] for v in speed], [x[:, k] for x in position], t)) for k in range(channels)
    )
    sizes = [[len(c.nodes) for c in own] for own in curves]
    first = tuple(tuple(int(i) for i in np.cumsum([0, *own])[:-1]) for own in sizes)
    count = tuple(sum(own) for own in sizes)
    start = np.concatenate([[0], np.cumsum(count)])
    roots: list[np.ndarray] = []
    components: list[Component] = []
    at = 0
    for k, own in enumerate(curves):
        for kind, level in dict.fromkeys((c.kind, i) for c in own for i in range(len(c.scales))):
            columns = at
            for curve, offset in zip(own, first[k], strict=True):
                if curve.kind != kind:
                    continue
                m, row = len(curve.nodes), start[k] + offset
                root = np.zeros((int(start[-1]), m))
                root[row : row + m] = curve.roots()[level]
                roots.append(root)
                at += m
            scale = next(c.scales[level] for c in own if c.kind == kind)
            components.append(Component(k, kind, scale, np.arange(columns, at)))
    root = np.concatenate(roots, axis=1) if roots else np.zeros((int(start[-1]), 0))
    return Basis(curves, first, count, root, tuple(components))


def _channel_curves(
    speed: Sequence[np.ndarray], position: Sequence[np.ndarray], t: Sequence[np.ndarray]
) -> list[Curve]:
    """Return the curves of one channel; those of a variable that does not vary are left out."""
    v, x = np.concatenate(speed), np.concatenate(position)
    found = []
    fastest = float(np.abs(v).max(initial=0.0))
    for sign in (1, -1):
        own = np.sort(np.abs(v[np.sign(v) == sign]))
        if len(own) < 2 * SPEED_NODES:
            continue
        nodes = np.unique(np.concatenate([[0.0], np.quantile(own, np.linspace(0, 1, SPEED_NODES)[1:])]))
        nodes = nodes[np.concatenate([[True], np.diff(nodes) > 1e-3 * fastest])]
        if len(nodes) > 1:
            found.append(Curve(WITH_SPEED, nodes, tuple(s * fastest for s in SPEED_SCALES), sign))
    span = float(np.ptp(x))
    if span > 0:
        nodes = np.linspace(x.min(), x.max(), POSITION_NODES)
        found.append(Curve(WITH_POSITION, nodes, tuple(s * span for s in POSITION_SCALES)))
    longest = max(float(np.ptp(one)) for one in t)
    turns = sum(int((np.diff(np.sign(w[w != 0])) != 0).sum()) for w in speed)
    if turns < 2 * TIME_NODES:  # what changes as fast as the motion is not slow
        return found
    for part, one in enumerate(t):
        count = max(2, round(TIME_NODES * np.ptp(one) / longest))
        nodes = np.linspace(one[0], one[-1], count)
        found.append(Curve(SLOW, nodes, tuple(s * longest for s in TIME_SCALES), part=part))
    return found


@dataclass(frozen=True)
class Sizes:
    """Sizes (n_components,) [SI], and the log-likelihood that each adds given the others."""

    size: np.ndarray
    gain: np.ndarray


def find_sizes(
    basis: Basis, information: np.ndarray, slope: np.ndarray, start: np.ndarray, admit: bool = True
) -> Sizes:
    """Find the sizes of all channels, one channel after another, given the discrepancies of the others.

    information (n, n), slope (n,): twice the negative log-likelihood of values c is c' information c - 2 slope' c and a
    constant, all else integrated out. start (n_components,): sizes to begin with. admit: try those of zero size, too.
    """
    size, gain = start.copy(), np.zeros(len(start))
    owner = np.array([c.channel for c in basis.components])
    for channel in range(len(basis.count)):
        if not admit and not (size[owner == channel] > 0).any():
            continue
        nodes = np.arange(basis.start[channel], basis.start[channel] + basis.count[channel])
        S, h = information[np.ix_(nodes, nodes)], slope[nodes]
        others = [c.columns for k, c in enumerate(basis.components) if c.channel != channel and size[k] > 0]
        if others:
            std = np.concatenate(
                [np.full(len(x), s) for x, s in zip(others, size[(owner != channel) & (size > 0)], strict=True)]
            )
            root = basis.root[:, np.concatenate(others)] * std
            inner = np.eye(root.shape[1]) + root.T @ information @ root
            cross = root.T @ information[:, nodes]
            solved = np.linalg.solve(inner, np.column_stack([cross, root.T @ slope]))
            S, h = S - cross.T @ solved[:, :-1], h - cross.T @ solved[:, -1]
        own = np.flatnonzero(owner == channel)
        columns = np.concatenate([basis.components[k].columns for k in own])
        groups = [basis.components[k].columns - columns[0] for k in own]
        root = basis.root[np.ix_(nodes, columns)]
        size[own], gain[own] = _channel_sizes(root.T @ S @ root, root.T @ h, groups, size[own], admit)
    return Sizes(size, gain)


def _channel_sizes(
    S: np.ndarray, h: np.ndarray, groups: Sequence[np.ndarray], start: np.ndarray, admit: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Find the sizes of one channel's components that maximise the marginal likelihood; return them and their gains."""
    variance = np.where(start > 0, start, admit * _first_sizes(S, h, groups)) ** 2
    S = (S + S.T) / 2 + 1e-10 * np.trace(S) / len(S) * np.eye(len(S))
    for _ in range(MAX_UPDATES if admit else FEW_UPDATES):
        pull, share, _ = _scores(S, h, groups, variance)
        ratio = np.sqrt(pull / np.maximum(share, 1e-300))
        change = np.clip(ratio, 0.1, 10.0)
        variance = np.where((variance * share < 0.02) & (ratio < 1), 0.0, variance * change)
        if (np.abs(np.log(change[variance > 0])) < 0.01).all():
            break
    gain = np.zeros(len(groups))
    while (variance > 0).any():
        *_, whole = _scores(S, h, groups, variance)
        active = np.flatnonzero(variance > 0)
        for k in active:
            without = variance.copy()
            without[k] = 0.0
            gain[k] = whole - _scores(S, h, groups, without)[2]
        worst = active[np.argmin(gain[active])]
        if gain[worst] >= LEAST_GAIN:
            break
        variance[worst] = gain[worst] = 0.0
    return np.sqrt(variance), gain


def _first_sizes(S: np.ndarray, h: np.ndarray, groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return the size of each component that would explain its slope alone."""
    return np.array([np.sqrt(h[g] @ h[g]) / max(np.trace(S[np.ix_(g, g)]), 1e-300) for g in groups])


def _scores(
    S: np.ndarray, h: np.ndarray, groups: Sequence[np.ndarray], variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return, by component, the squared slope and its expectation, and the log-likelihood, at variances."""
    active = [k for k in range(len(groups)) if variance[k] > 0]
    if active:
        use = np.concatenate([groups[k] for k in active])
        std = np.concatenate([np.full(len(groups[k]), np.sqrt(variance[k])) for k in active])
        inner = np.eye(len(use)) + std[:, None] * S[np.ix_(use, use)] * std
        try:
            root = scipy.linalg.cholesky(inner, lower=True)
        except np.linalg.LinAlgError:  # eliminations leave rounding errors
            spectrum, axes = np.linalg.eigh(inner)
            root = np.linalg.cholesky((axes * np.maximum(spectrum, 1.0)) @ axes.T)
        half = scipy.linalg.solve_triangular(root, std[:, None] * S[use], lower=True)
        y = scipy.linalg.solve_triangular(root, std * h[use], lower=True)
        left = h - half.T @ y
        remaining = np.diag(S) - np.einsum("ij,ij->j", half, half)
        value = float(y @ y) / 2 - float(np.log(np.diag(root)).sum())
    else:
        left, remaining, value = h, np.diag(S), 0.0
    pull = np.array([left[g] @ left[g] for g in groups])
    share = np.array([np.maximum(remaining[g], 0.0).sum() for g in groups])
    return pull, share, value
