"""What happens to real rollers and stands in no catalogue: a diagnosis has to leave it unexplained.

Each takes a size between 0 (not there) and 1 (anyone would notice in the log) and draws the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from support.plant import JOINTS, ROLLS, TURNING, Scene

DRAW = np.random.Generator
TORQUES = ("u1_Nm", "u2_Nm", "u4_Nm")


def _window(t: ca.SX, begin: float, end: float, soft: float = 0.3) -> ca.SX:
    return (ca.tanh((t - begin) / soft) - ca.tanh((t - end) / soft)) / 2


def soft_patch(s: Scene, size: float, draw: DRAW) -> None:
    """Some metres of the lane are soft: both rolls hold less there, whenever they pass."""
    along, length = draw.uniform(1.5, 5.0), draw.uniform(1.5, 3.0)
    for roll in ROLLS:

        def change(c: Any) -> None:
            at = c.position[0] - along
            left = 1 - 0.6 * size * (ca.tanh((at + length) / 0.4) - ca.tanh((at - length) / 0.4)) / 2
            c.Kx, c.Ky = c.Kx * left, c.Ky * left

        s.soil[roll].append(change)


def side_wind(s: Scene, size: float, draw: DRAW) -> None:
    """Gusts on the flank of the rear chassis."""
    begin, way = draw.uniform(8, 25), draw.choice([-1, 1])
    gust = _window(s.t, begin, begin + draw.uniform(6, 15)) * (1 + 0.4 * ca.sin(2.3 * s.t))
    s.push("rear", -1.0, 0.0, ca.vertcat(0, way * 2500 * size * gust))


def lost_counts(s: Scene, size: float, draw: DRAW) -> None:
    """A dirty disc: now and then an encoder misses a few dozen counts."""
    column = draw.choice(["theta1_rad", "theta4_rad", "thetal_rad", "thetar_rad"])
    step = 2 * np.pi / (8192 if column in ("theta1_rad", "theta4_rad") else 16384)

    def lose(t: np.ndarray, columns: dict[str, np.ndarray], rng: DRAW) -> None:
        moving = np.abs(np.gradient(columns[column])) > 2 * step
        events = (rng.uniform(size=len(t)) < 0.004) & moving
        way = np.sign(np.gradient(columns[column]))
        lost = np.cumsum(events * way * np.round(size * rng.uniform(10, 60, len(t))))
        columns[column] = columns[column] - lost * step

    s.written.append(lose)


def stuck_bit(s: Scene, size: float, draw: DRAW) -> None:
    """A converter whose bit of some hundred N m is always set."""
    column = draw.choice(TORQUES)
    bit = 2 ** round(np.log2((1024 if column == "u2_Nm" else 256) * size)) if size else 0

    def stick(t: np.ndarray, columns: dict[str, np.ndarray], rng: DRAW) -> None:
        if bit:
            x = columns[column] + 2**15
            columns[column] = x + np.where((x // bit) % 2 == 0, bit, 0) - 2**15

    s.written.append(stick)


def warm_gain(s: Scene, size: float, draw: DRAW) -> None:
    """A strain gauge whose sensitivity follows its temperature up and down."""
    column, period = draw.choice(TORQUES), draw.uniform(25, 60)
    s.read[column] *= 1 + 0.25 * size * ca.sin(2 * np.pi * s.t / period)


def clock_jitter(s: Scene, size: float, draw: DRAW) -> None:
    """The roll encoders are sampled by another computer, whose clock wanders against the others'."""
    column, seed = draw.choice(["theta1_rad", "theta4_rad"]), int(draw.integers(1 << 30))

    def jitter(t: np.ndarray, columns: dict[str, np.ndarray], _: DRAW) -> None:
        rng = np.random.default_rng(seed)
        columns[column] = np.interp(t + 0.02 * size * rng.uniform(-1, 1, len(t)), t, columns[column])

    s.sensed.append(jitter)


def hose_spring(s: Scene, size: float, draw: DRAW) -> None:
    """Hoses across the articulation: a spring that keeps a memory of where it came from (Bouc-Wen)."""
    memory, width = s.state(), draw.uniform(0.04, 0.1)
    w = s.qd[4]
    s.rates[memory] = (w - 0.5 * ca.fabs(w) * memory - 0.5 * w * ca.fabs(memory)) / width
    s.torque[1].append(lambda U: U - size * (2500 * memory + 4000 * s.q[4] ** 3 / 0.05))


def roll_bounce(s: Scene, size: float, draw: DRAW) -> None:
    """The front of the machine bounces while it rolls: contact comes and goes."""
    frequency, phase = draw.uniform(1.5, 2.6), draw.uniform(0, 6)
    roll = str(draw.choice(ROLLS))

    def change(c: Any) -> None:
        rolling = ca.tanh((c.rim / 0.4) ** 2)
        left = ca.fmax(1 + 1.2 * size * rolling * ca.sin(2 * np.pi * frequency * s.t + phase), 0.05)
        c.Kx, c.Ky = c.Kx * left, c.Ky * left

    s.soil[roll].append(change)


def tow_rope(s: Scene, size: float, draw: DRAW) -> None:
    """Another machine pulls at the tail, harder and harder, until the rope slips off."""
    begin, takes = draw.uniform(10, 25), draw.uniform(8, 15)
    pull = ca.fmax(ca.fmin((s.t - begin) / takes, 1), 0) * (1 - ca.tanh((s.t - begin - takes) / 0.05)) / 2
    aside = draw.uniform(-0.8, 0.8)
    heading = s.heading("rear") + aside
    s.push("rear", -2.8, 0.0, -2500 * size * pull * ca.vertcat(ca.cos(heading), ca.sin(heading)))


def mains_hum(s: Scene, size: float, draw: DRAW) -> None:
    """A charger's hum on one channel, folded by the sampling."""
    column = draw.choice([*TORQUES, "yaw_rate_rad_s"])
    height = {"u2_Nm": 400.0, "yaw_rate_rad_s": 0.006}.get(str(column), 150.0)
    s.read[column] += size * height * ca.sin(2 * np.pi * draw.uniform(59.0, 61.0) * s.t)


def cg_drift(s: Scene, size: float, draw: DRAW) -> None:
    """A ton of loose ballast creeps sideways on the front chassis for the whole drive."""
    way, time = draw.choice([-1, 1]), draw.uniform(20, 40)
    y = way * 0.6 * size * ca.tanh(s.t / time)
    s.point(1000.0, "front", -0.5, y)
    s.point(-1000.0, "front", -0.5, 0.0)


def sloshing(s: Scene, size: float, draw: DRAW) -> None:
    """The water tank is half full: a part of the mass swings along the chassis on its own."""
    mass, w = 1500.0 * size, 2 * np.pi * draw.uniform(0.5, 0.9)
    damping = 2 * draw.uniform(0.02, 0.06) * w
    c = s.contact["rear_roll"]
    offset, speed = s.state(), s.state()
    s.rates[offset] = speed - c.Vx
    s.rates[speed] = -(w**2) * offset - damping * (speed - c.Vx)
    force = mass * (w**2 * offset + damping * (speed - c.Vx))
    heading = s.heading("rear")
    s.push("rear", 0.0, 0.0, force * ca.vertcat(ca.cos(heading), ca.sin(heading)))


def tight_spot(s: Scene, size: float, draw: DRAW) -> None:
    """A bent pin: the articulation goes hard around one angle."""
    angle, width = draw.uniform(-0.12, 0.12), draw.uniform(0.02, 0.05)
    s.friction[JOINTS["articulation"]].append(
        lambda w, U: 4000 * size * ca.exp(-(((s.q[TURNING["articulation"]] - angle) / width) ** 2)) * ca.tanh(w / 0.005)
    )


def worn_roll(s: Scene, size: float, draw: DRAW) -> None:
    """A roll is smaller than the drawing says: its rim is slower than its encoder tells."""

    def change(c: Any) -> None:
        c.rim = c.rim * (1 - 0.02 * size)

    s.soil[str(draw.choice(ROLLS))].append(change)


SURPRISES: dict[str, Callable[[Scene, float, DRAW], None]] = {
    f.__name__: f
    for f in (
        soft_patch,
        side_wind,
        lost_counts,
        stuck_bit,
        warm_gain,
        clock_jitter,
        hose_spring,
        roll_bounce,
        tow_rope,
        mains_hum,
        cg_drift,
        sloshing,
        tight_spot,
        worn_roll,
    )
}

# What is in the catalogue by another name: the roll's radius in the machine file is wrong.
LISTED_AS = {"worn_roll": "contact_radius"}


def surprise(scene: Scene, name: str, size: float, seed: int) -> None:
    """Puts one of `SURPRISES` into a scene, of a size between 0 and 1; the rest is drawn from the seed."""
    SURPRISES[name](scene, size, np.random.default_rng([seed, 16]))
