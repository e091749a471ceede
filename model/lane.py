"""How often the ground under a contact has been driven over: what compaction remembers of the way along a lane."""

from __future__ import annotations

from collections.abc import Callable
from math import log

import casadi as ca

from model.effect import Memory, Scene, Values

PASS = 10.0  # [m] of way that a pass is worth where these are counted
STANDSTILL = 0.02  # [m/s] over which the way turns
BACK = 0.1  # [m] of way back, within which a reversal counts
EDGE = 0.3  # [m] within which the end of a lane is felt


def _way(s: Scene, k: int) -> tuple[ca.SX, ca.SX]:
    """Speed of a contact's centre, forward or back, nothing at standstill, and which way it goes, 1 or -1."""
    Vx = s.rolling[k].Vx
    ahead = ca.tanh(Vx / STANDSTILL)
    return Vx * ahead, ahead


def _facing(s: Scene, k: int, p: Values) -> ca.SX:
    """How fast the direction that a contact remembers follows the one that it goes."""
    way, ahead = _way(s, k)
    return way * (ahead - s.z["facing"]) / BACK


def _reversing(s: Scene, k: int, p: Values) -> ca.SX:
    """One for each reversal: against the direction that it remembers, which is 0 before any and turns 2 exp(-x) - 1."""
    way, ahead = _way(s, k)
    return ca.fmax(-way * ahead * s.z["facing"], 0) / (BACK * (1 - log(2)))


def _beyond(name: str, side: float) -> Callable[[Scene, int, Values], ca.SX]:
    """How fast an end of the lane is moved on by the contact that is there, a little behind it."""

    def rate(s: Scene, k: int, p: Values) -> ca.SX:
        return side * _way(s, k)[0] * ca.fmax(side * (s.z["place"] - s.z[name]), 0) / EDGE

    return rate


def passes(s: Scene, k: int) -> ca.SX:
    """How often contacts have passed over the place where one is: every one has been on a stretch of the lane of its
    own, about as often anywhere on it, and where the lane ends the ground is new. Contacts behind each other follow one
    track, also in a bend; those beside each other count as far as they overlap."""
    own = s.rolling[k]
    length = s.z["farthest"] - s.z["nearest"]
    often = s.z["distance"] / (length + EDGE)
    over = ca.SX(0)
    for j, other in s.rolling.items():
        width = max((float(own.contact.width) + float(other.contact.width)) / 2, EDGE)
        overlap = max(0.0, 1 - abs(own.y - other.y) / width)
        ahead = own.x - other.x + s.z["place"]
        low, high = (
            (1 + ca.tanh(3 * (room / EDGE + 0.5))) / 2 for room in (s.z["farthest"] - ahead, ahead - s.z["nearest"])
        )
        over += overlap * low * high * ca.fmax(often - 0.5 * (j == k), 1)  # its own last one isn't complete
    return over * length / (length + EDGE)


MEMORY = {
    "distance": Memory(lambda s, k, p: _way(s, k)[0], 1e-6),
    "facing": Memory(_facing, 1e-6),
    "reversals": Memory(_reversing, 1e-6),
    "place": Memory(lambda s, k, p: s.rolling[k].Vx, 1e-6),
    "farthest": Memory(_beyond("farthest", 1.0), 1e-6),
    "nearest": Memory(_beyond("nearest", -1.0), 1e-6),
}
