"""How often the ground under a contact has been driven over: the way, reversals, or a map of the ground."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, floor, hypot, inf, isfinite, log

import casadi as ca
import numpy as np

from excite.model.effects.effect import Memory, SampleView, Values

PASS_LENGTH = 10.0  # [m] of way that a pass is worth where these are counted
DIRECTION_SMOOTHING = 0.02  # [m/s] over which the way turns
REVERSAL_LENGTH = 0.1  # [m] of way back, within which a reversal counts
MAX_PASSES = 12  # passes that are told apart
CELL_SIZE = 0.2  # [m] of the map's cells
POINTS_PER_CELL = 1.5  # places looked at across a contact for each cell
MIN_STEP = 0.03  # [m] of way from which a contact is looked at again
LEAVING_LENGTH = 0.06  # [m] of way from a cell, after which it may be entered again
FOOTPRINT_LENGTH = 0.15  # [m] of way over which what is under a contact becomes another


def _travel(s: SampleView, k: int) -> tuple[ca.SX, ca.SX]:
    """Speed of a contact's centre, forward or back, nothing at standstill, and which way it goes, 1 or -1."""
    Vx = s.rolling[k].Vx
    ahead = ca.tanh(Vx / DIRECTION_SMOOTHING)
    return Vx * ahead, ahead


def _direction_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """How fast the direction that a contact remembers follows the one that it goes."""
    way, ahead = _travel(s, k)
    return way * (ahead - s.z["facing"]) / REVERSAL_LENGTH


def _reversal_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """One for each reversal: against the direction that it remembers, which is 0 before any and turns 2 exp(-x) - 1."""
    way, ahead = _travel(s, k)
    return ca.fmax(-way * ahead * s.z["facing"], 0) / (REVERSAL_LENGTH * (1 - log(2)))


MEMORY = {
    "distance": Memory(lambda s, k, p: _travel(s, k)[0], 1e-6, form=("counted", 0.0)),
    "facing": Memory(_direction_rate, 1e-6, form=("counted", 1.0)),
    "reversals": Memory(_reversal_rate, 1e-6, form=("counted", 1.0)),
}


def pass_effect(over: ca.SX, each: ca.SX) -> ca.SX:
    """What passes have made of the soil under a contact, 0 to 1, where each leaves exp(-PASS / each) of what was still
    to come; over (MOST,): as a scene has it."""
    left = ca.exp(-PASS_LENGTH / each)
    return (1 - left) * ca.dot(over, ca.vertcat(*[left**n for n in range(MAX_PASSES)]))


class GroundMap:
    """A map of the ground that counts how often contacts have entered each of its cells: of every contact, the shares
    of its width that were passed over at least 1, 2, ... MOST times before, each time by any of them. A cell counts as
    left once a contact is LEFT away from where it was on it, so that who swings about a border doesn't pass over it.

    widths (n,) [m]: of the contacts; what is narrower than a cell is told as coarsely as that. Where a contact comes to
    new ground its shares follow over PATCH, about the length of a footprint.
    """

    def __init__(self, widths: Sequence[float]) -> None:
        self.places = [
            np.linspace(-0.5, 0.5, max(2, round(POINTS_PER_CELL * w / CELL_SIZE) + 1)).tolist() for w in widths
        ]
        self.entered: dict[tuple[int, int], int] = {}
        self.trail: list[list[tuple[float, float, set[tuple[int, int]]]]] = [[] for _ in widths]
        self.shares = np.zeros((len(widths), MAX_PASSES))
        self.last: list[tuple[float, float] | None] = [None] * len(widths)

    def come(self, axles: np.ndarray) -> np.ndarray:
        """The shares (n MOST,), contact after contact, when the contacts have come to axles (n, 4): x, y of the middle
        and of the way from one end to the other [m]."""
        for k, (x, y, across, along) in enumerate(axles.tolist()):
            last = self.last[k]
            moved = inf if last is None else hypot(x - last[0], y - last[1])
            if moved < MIN_STEP or not isfinite(x + y + across + along):  # a fit that goes astray may lead anywhere
                continue
            self.last[k] = x, y
            cells = [(floor((x + p * across) / CELL_SIZE), floor((y + p * along) / CELL_SIZE)) for p in self.places[k]]
            now = set(cells)
            near = [one for one in self.trail[k] if hypot(x - one[0], y - one[1]) < LEAVING_LENGTH]
            for cell in now.difference(*(under for _, _, under in near)):
                self.entered[cell] = self.entered.get(cell, 0) + 1
            self.trail[k] = [*near, (x, y, now)]
            before = [min(self.entered[cell] - 1, MAX_PASSES) for cell in cells]  # but for the pass that it is in
            often = np.bincount(before, minlength=MAX_PASSES + 1)
            target = often[:0:-1].cumsum()[::-1] / len(cells)
            self.shares[k] += (1 - exp(-moved / FOOTPRINT_LENGTH)) * (target - self.shares[k])
        return self.shares.ravel().copy()
