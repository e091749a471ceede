"""Passes over the ground under a contact: counted by distance, by reversals, or on a map of the ground."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, floor, hypot, inf, isfinite, log

import casadi as ca
import numpy as np

from excite.model.effects.effect import Memory, SampleView, Values

PASS_LENGTH = 10.0  # m, distance that one counted pass stands for; chosen
DIRECTION_SMOOTHING = 0.02  # m/s, speed over which the direction of travel turns; chosen
REVERSAL_LENGTH = 0.1  # m, distance driven back within which a reversal is counted; chosen
MAX_PASSES = 12  # passes counted separately; chosen
CELL_SIZE = 0.2  # m, edge of a cell of the map; chosen
POINTS_PER_CELL = 1.5  # points across a contact per cell; chosen
MIN_STEP = 0.03  # m, distance after which a contact is entered again; chosen
LEAVING_LENGTH = 0.06  # m, distance from a cell after which entering it is a new pass; chosen
FOOTPRINT_LENGTH = 0.15  # m, distance over which the ground under a contact is exchanged; chosen


def _travel(s: SampleView, k: int) -> tuple[ca.SX, ca.SX]:
    """Return speed [m/s] and direction (1 or -1) of a contact's centre, both smoothed to 0 at standstill."""
    Vx = s.contacts[k].Vx
    direction = ca.tanh(Vx / DIRECTION_SMOOTHING)
    return Vx * direction, direction


def _direction_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the rate at which the remembered direction follows the direction of travel."""
    speed, direction = _travel(s, k)
    return speed * (direction - s.z["facing"]) / REVERSAL_LENGTH


def _reversal_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the rate of the count of reversals, which grows by 1 while the remembered direction turns.

    That direction is 2 exp(-x) - 1 after a distance of x REVERSAL_LENGTH, hence the factor 1 - log(2).
    """
    speed, direction = _travel(s, k)
    return ca.fmax(-speed * direction * s.z["facing"], 0) / (REVERSAL_LENGTH * (1 - log(2)))


MEMORY = {
    "distance": Memory(lambda s, k, p: _travel(s, k)[0], 1e-6, form=("counted", 0.0)),
    "facing": Memory(_direction_rate, 1e-6, form=("counted", 1.0)),
    "reversals": Memory(_reversal_rate, 1e-6, form=("counted", 1.0)),
}


def pass_effect(passes: ca.SX, length: ca.SX) -> ca.SX:
    """Return the compaction under a contact, 0 to 1; each pass leaves the share exp(-PASS_LENGTH / length) to go.

    passes (MAX_PASSES,): see `SampleView`; length [m]: the effect's shape `pass`.
    """
    left = ca.exp(-PASS_LENGTH / length)
    return (1 - left) * ca.dot(passes, ca.vertcat(*[left**n for n in range(MAX_PASSES)]))


class GroundMap:
    """A map of the ground that counts how often contacts have entered each of its cells.

    It gives the shares of every contact's width that any contact passed over at least 1, 2, ... MAX_PASSES times
    before. A cell is left once a contact is LEAVING_LENGTH away from where it was on it, so that swinging about a
    border is no pass. On new ground the shares follow over FOOTPRINT_LENGTH.

    widths (n,) [m]: of the contacts; resolved no finer than a cell.
    """

    def __init__(self, widths: Sequence[float]) -> None:
        self.places = [
            np.linspace(-0.5, 0.5, max(2, round(POINTS_PER_CELL * w / CELL_SIZE) + 1)).tolist() for w in widths
        ]
        self.entered: dict[tuple[int, int], int] = {}
        self.trail: list[list[tuple[float, float, set[tuple[int, int]]]]] = [[] for _ in widths]
        self.shares = np.zeros((len(widths), MAX_PASSES))
        self.last: list[tuple[float, float] | None] = [None] * len(widths)

    def update(self, lines: np.ndarray) -> np.ndarray:
        """Enter the contacts and return the shares (n MAX_PASSES,), contact after contact.

        lines (n, 4) [m]: x, y of the middle of each contact, and of the vector from one end to the other.
        """
        for k, (x, y, across, along) in enumerate(lines.tolist()):
            last = self.last[k]
            moved = inf if last is None else hypot(x - last[0], y - last[1])
            if moved < MIN_STEP or not isfinite(x + y + across + along):  # a diverging fit may give any number
                continue
            self.last[k] = x, y
            cells = [(floor((x + p * across) / CELL_SIZE), floor((y + p * along) / CELL_SIZE)) for p in self.places[k]]
            now = set(cells)
            near = [one for one in self.trail[k] if hypot(x - one[0], y - one[1]) < LEAVING_LENGTH]
            for cell in now.difference(*(under for _, _, under in near)):
                self.entered[cell] = self.entered.get(cell, 0) + 1
            self.trail[k] = [*near, (x, y, now)]
            before = [min(self.entered[cell] - 1, MAX_PASSES) for cell in cells]  # without the pass under way
            counts = np.bincount(before, minlength=MAX_PASSES + 1)
            target = counts[:0:-1].cumsum()[::-1] / len(cells)
            self.shares[k] += (1 - exp(-moved / FOOTPRINT_LENGTH)) * (target - self.shares[k])
        return self.shares.ravel().copy()
