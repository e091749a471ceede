"""The effects of CONTRACT.md section 4, hidden in the second roller by their physics.

Written from the physics and not from the program's catalogue: a dead zone has two masses, passes are counted where
the rolls have been, saturation is integrated over the patch. Shapes (decay speeds, phases, orders) are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from support import plant
from support.plant import JOINTS, ROLLS, TURNING, G, Scene

DRAW = np.random.Generator
Hide = Callable[[Scene, str, float, DRAW], None]
SMOOTH = {"front_roll": 0.02, "articulation": 0.005, "rear_roll": 0.02}
TORQUE_COLUMN = {"front_roll": "u1_Nm", "articulation": "u2_Nm", "rear_roll": "u4_Nm"}
ANGLE_COLUMN = {
    "front_roll": "theta1_rad",
    "rear_roll": "theta4_rad",
    "measuring_wheel_left": "thetal_rad",
    "measuring_wheel_right": "thetar_rad",
}
WHEELS = ("measuring_wheel_left", "measuring_wheel_right")


@dataclass(frozen=True)
class Cause:
    """Where it may sit, the amounts from just visible to strong by place ("" for any), and how it is hidden.

    `signed`: either sign occurs. `none`: the amount at which nothing is there.
    """

    places: tuple[str, ...]
    unit: str
    amounts: dict[str, tuple[float, float]]
    hide: Hide
    signed: bool = False
    none: float = 0.0

    def between(self, place: str) -> tuple[float, float]:
        return self.amounts[place] if place in self.amounts else self.amounts[""]


# ------------------------------------------------------------------------------------------- joints and torques
def stribeck_friction(s: Scene, place: str, A: float, draw: DRAW) -> None:
    speed = draw.uniform(0.02, 0.06) if place == "articulation" else draw.uniform(0.1, 0.4)
    power = draw.uniform(0.8, 1.4)
    s.friction[JOINTS[place]].append(
        lambda w, U: A * ca.exp(-((ca.sqrt(w**2 + 1e-8) / speed) ** power)) * ca.tanh(w / SMOOTH[place])
    )


def _window(s: Scene, begin: float, length: float, soft: float) -> ca.SX:
    """One while something acts, for so long [s], and nothing before and after."""
    return (ca.tanh((s.t - begin) / soft) - ca.tanh((s.t - begin - length) / soft)) / 2


def brake_drag(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """A shoe that lies against its drum for a while, and fades a little as it warms."""
    begin, length, fade = draw.uniform(8, 25), draw.uniform(12, 25), draw.uniform(0, 0.08)
    window = _window(s, begin, length, 0.1)
    warm = 1 - ca.exp(-ca.fmax(s.t - begin, 0) / 8)
    s.friction[JOINTS[place]].append(lambda w, U: A * (1 - fade * warm) * window * ca.tanh(w / SMOOTH[place]))


def load_dependent_friction(s: Scene, place: str, A: float, draw: DRAW) -> None:
    soft = draw.uniform(20, 100)  # pre-load of the mesh: no friction is exactly proportional down to nothing
    s.friction[JOINTS[place]].append(lambda w, U: A * (ca.sqrt(U**2 + soft**2) - soft) * ca.tanh(w / SMOOTH[place]))


def asymmetric_coulomb(s: Scene, place: str, A: float, draw: DRAW) -> None:
    s.friction[JOINTS[place]].append(lambda w, U: A * ca.tanh(w / SMOOTH[place]) ** 2)


def asymmetric_viscous(s: Scene, place: str, A: float, draw: DRAW) -> None:
    bend = draw.uniform(0, 2) * SMOOTH[place]
    s.friction[JOINTS[place]].append(lambda w, U: A * (ca.sqrt(w**2 + bend**2) - bend))


def quadratic_drag(s: Scene, place: str, A: float, draw: DRAW) -> None:
    power, usual = draw.uniform(1.85, 2.15), 0.2 if place == "articulation" else 2.0
    s.friction[JOINTS[place]].append(
        lambda w, U: A * usual**2 * (ca.sqrt(w**2 + 1e-10) / usual) ** (power - 1) * (w / usual)
    )


def friction_warm_up(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Viscosity falls exponentially with a temperature that itself settles exponentially."""
    time = draw.uniform(12, 50)
    s.wear[JOINTS[place]] = s.wear[JOINTS[place]] * (1 + A) ** ca.exp(-s.t / time)


def actuator_lag(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """A slow volume of oil behind a fast valve: two lags one after the other, A in all."""
    if A == 0:
        return
    share = draw.uniform(0.75, 0.95)

    def lag(U: ca.SX) -> ca.SX:
        valve, oil = s.state(), s.state()
        s.rates[valve] = (U - valve) / (A * (1 - share))
        s.rates[oil] = (valve - oil) / (A * share)
        return oil

    s.stiff = True
    s.torque[JOINTS[place]].append(lag)


def channel_delay(s: Scene, place: str, A: float, draw: DRAW) -> None:
    column = TORQUE_COLUMN[place]

    def late(t: np.ndarray, columns: dict[str, np.ndarray], _: DRAW) -> None:
        columns[column] = np.interp(t - A, t, columns[column])

    s.sensed.append(late)


def torque_gain(s: Scene, place: str, A: float, draw: DRAW) -> None:
    s.read[TORQUE_COLUMN[place]] *= 1 + A


def torque_offset_drift(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Warming electronics: fast at first, slower later; A is the mean rate over the first minute."""
    time = draw.uniform(80, 400)
    s.read[TORQUE_COLUMN[place]] += A * 60 * (1 - ca.exp(-s.t / time)) / (1 - np.exp(-60 / time))


def torque_deadband(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Overlap of a spool: nothing is delivered inside it, and all is less by it outside."""
    s.torque[JOINTS[place]].append(lambda U: U - ca.fmax(ca.fmin(U, A), -A))


def relief_valve(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """A worn valve begins to open at a pressure below the sensor's place in the line and is open a little above it:
    of peaks a share is not delivered."""
    top = draw.uniform(1300, 3000)
    width = 0.03 * top

    def left(U: ca.SX) -> ca.SX:
        over = (ca.fabs(U) - top + ca.sqrt((ca.fabs(U) - top) ** 2 + width**2)) / 2
        return U - A * over * ca.sign(U)

    s.torque[JOINTS[place]].append(left)


def pump_coupling(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """A common pump: what the one motor draws changes the other's pressure, through a hose that takes its time."""
    time = draw.uniform(0.01, 0.04)
    s.stiff = True
    for mine, other in ((0, 2), (2, 0)):
        hose = s.state()
        s.rates[hose] = (s.u[other] - hose) / time
        s.torque[mine].append(partial(_added, more=A * hose))


def _added(U: ca.SX, more: ca.SX) -> ca.SX:
    return U + more


def roll_unbalance(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Gravity on a mass off the axis."""
    phase = draw.uniform(0, 2 * np.pi)
    s.torque[JOINTS[place]].append(lambda U: U + A * ca.cos(s.q[TURNING[place]] + phase))


def roll_out_of_round(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """A roll turns about a point A beside its middle and is a little oval; its half of the machine climbs over that."""
    angle, m = s.q[TURNING[place]], s.m
    first, second = draw.uniform(0, 2 * np.pi, 2)
    further = A * (ca.cos(angle + first) + draw.uniform(0, 0.05) * ca.cos(2 * angle + second))
    wheelbase = m.D2 + m.D3
    behind = [(mass, -x if chassis == "front" else m.D2 - x) for mass, chassis, x, _ in s.bodies()]
    share = [(x if place == "rear_roll" else wheelbase - x) / wheelbase * mass for mass, x in behind]
    climb = G * sum(share) * ca.jacobian(further, angle)
    s.torque[JOINTS[place]].append(lambda U: U - climb)

    def change(c: Any) -> None:
        c.R = c.R + further
        c.rim = c.R * c.w
        c.vn = ca.sqrt(c.rim**2 + m.v_eps**2)

    s.soil[place].append(change)


def encoder_eccentricity(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """A disc off its axis: once per turn, with a little of the second harmonic."""
    column, phase, second = ANGLE_COLUMN[place], draw.uniform(0, 2 * np.pi), draw.uniform(-0.08, 0.08)
    angle = s.read[column]
    s.read[column] = angle + A * (ca.sin(angle + phase) + second * ca.sin(2 * angle))


def torque_ripple(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Pistons of the motor: an order of the roll's turn, with harmonics."""
    order, phase = int(draw.integers(5, 19)), draw.uniform(0, 2 * np.pi, 2)
    angle, second = s.q[TURNING[place]], draw.uniform(0.05, 0.25)
    s.torque[JOINTS[place]].append(
        lambda U: U + A * (ca.sin(order * angle + phase[0]) + second * ca.sin(2 * order * angle + phase[1]))
    )


# --------------------------------------------------------------------------------------------------------- soil
_PLACES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


def _developed(slip: ca.SX, A: float) -> ca.SX:
    """Share of the linear law left over a patch of length xi_s, (18) summed over it: 1 without slip."""
    z = slip / A
    total = sum(w / 2 * (1 - ca.exp(-z * (1 + x) / 2)) for x, w in zip(_PLACES, _WEIGHTS, strict=True))
    return ca.if_else(z < 1e-4, 1 - z / 3, 2 * total / (z + 1e-12))


def shear_saturation(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Each strip of the roll's width has its own slip, and saturates on its own; or all of it by that of its middle,
    with the moment or without it."""

    def of_strips(c: Any) -> tuple[ca.SX, ca.SX, ca.SX]:
        Sx, Sy, Mz = ca.SX(0), ca.SX(0), ca.SX(0)
        for x, weight in zip(_PLACES, _WEIGHTS, strict=True):
            y = x * c.L / 2
            gx, gy = (c.Vx - c.yaw * y - c.rim) / c.vn, c.Vy / c.vn
            share = weight / 2 * _developed(ca.sqrt(gx**2 + gy**2 + 1e-16), A)
            Sx, Sy, Mz = Sx + share * c.Kx * gx, Sy + share * c.Ky * gy, Mz - y * share * c.Kx * gx
        return Sx, Sy, Mz

    def of_the_middle(c: Any) -> tuple[ca.SX, ca.SX, ca.SX]:
        Sx, Sy, Mz = plant.linear(c)
        share = _developed(ca.sqrt(((c.Vx - c.rim) ** 2 + c.Vy**2) / c.vn**2 + 1e-16), A)
        return share * Sx, share * Sy, (share if moment else 1) * Mz

    strips, moment = draw.uniform(size=2) < 0.5
    if np.isfinite(A):
        s.law[place] = of_strips if strips else of_the_middle


def lateral_saturation(s: Scene, place: str, A: float, draw: DRAW) -> None:
    def law(c: Any) -> tuple[ca.SX, ca.SX, ca.SX]:
        Sx, Sy, Mz = plant.linear(c)
        return Sx, Sy * _developed(ca.sqrt((c.Vy / c.vn) ** 2 + 1e-16), A), Mz

    if np.isfinite(A):
        s.law[place] = law


def drive_brake_asymmetry(s: Scene, place: str, A: float, draw: DRAW) -> None:
    width = draw.uniform(0.001, 0.004)

    def change(c: Any) -> None:
        excess = (ca.sqrt(c.Vx**2 + 1e-8) - ca.sqrt(c.rim**2 + 1e-8)) / c.vn
        c.Kx = c.Kx * (1 + A * (1 + ca.tanh(excess / width)) / 2)

    s.soil[place].append(change)


def compaction_per_pass(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """A map of the lane counts how often a roll has entered each cell; the soil stiffens with that count."""
    cell, often = 0.3, draw.uniform(1.2, 3.0)
    passes: dict[tuple[int, int], int] = {}
    under: dict[str, set[tuple[int, int]]] = {r: set() for r in ROLLS}
    value = dict.fromkeys(ROLLS, 1.0)

    def covers(roll: str, x: np.ndarray) -> set[tuple[int, int]]:
        machine = plant.Machine()  # its geometry, which does not vary
        at, heading = x[:2], x[2]
        if roll == "rear_roll":
            at = at - machine.D2 * np.array([np.cos(heading), np.sin(heading)])
            heading = heading + x[4]
            at = at - machine.D3 * np.array([np.cos(heading), np.sin(heading)])
        across = np.linspace(-1, 1, 9)[:, None] * machine.L / 2 * np.array([-np.sin(heading), np.cos(heading)])
        # A roll that stands on the border of two cells would enter them with every breath: none starts there.
        return {(int(a), int(b)) for a, b in np.floor((at + across) / cell + 0.37)}

    def update(roll: str) -> Callable[[float, np.ndarray], float]:
        def look(t: float, x: np.ndarray) -> float:
            if t == 0:
                under[roll] = set()
                value[roll] = 1.0
                if roll == ROLLS[0]:
                    passes.clear()
            now = covers(roll, x)
            stiff = np.mean([1 + A * (1 - np.exp(-max(passes.get(c, 0) - (c in under[roll]), 0) / often)) for c in now])
            for c in now - under[roll]:
                passes[c] = passes.get(c, 0) + 1
            under[roll] = now
            value[roll] += 0.1 * (float(stiff) - value[roll])  # the edge between two cells is no step
            return value[roll]

        return look

    for roll in ROLLS:
        factor = s.hold(update(roll))

        def change(c: Any, factor: ca.SX = factor) -> None:
            c.Kx, c.Ky = c.Kx * factor, c.Ky * factor

        s.soil[roll].append(change)


def slip_relaxation(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Soil carries shear as a spring: its deflection d grows with the sliding speed and is left behind after A."""
    if A == 0:
        return
    damping = draw.uniform(2000, 6000)

    def law(c: Any) -> tuple[ca.SX, ca.SX, ca.SX]:
        dx, dy = s.state(), s.state()
        s.rates[dx] = (c.Vx - c.rim) - c.vn / A * dx
        s.rates[dy] = c.Vy - c.vn / A * dy
        _, _, Mz = plant.linear(c)
        near = A / 0.02  # damping of the spring alone, less of it where the spring is short
        return c.Kx * dx / A - damping * near * s.rates[dx], c.Ky * dy / A - damping * near * s.rates[dy], Mz

    s.stiff = True
    s.law[place] = law


def rolling_resistance(s: Scene, place: str, A: float, draw: DRAW) -> None:
    c, soft, rise = s.contact[place], draw.uniform(0.02, 0.05), draw.uniform(0, 0.1)
    force = -A * ca.tanh(c.Vx / soft) * (1 + rise * (c.Vx**2 - 1))
    x = 0.0 if c.chassis == "front" else -s.m.D3
    s.push(c.chassis, x, 0.0, plant.turn(s.heading(c.chassis), force, 0.0))


def ground_slope(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Each body's weight has a part along the ground."""
    down = draw.uniform(0, 2 * np.pi)
    for mass, chassis, x, y in s.bodies():
        s.push(chassis, x, y, mass * G * np.sin(A) * ca.DM([np.cos(down), np.sin(down)]))


def vibration_on(s: Scene, place: str, A: float, draw: DRAW) -> None:
    begin, length = draw.uniform(8, 25), draw.uniform(12, 25)
    frequency, size = draw.uniform(22, 38), draw.uniform(80, 250) * (A > 0)
    window = _window(s, begin, length, 0.15)

    def change(c: Any) -> None:
        c.Kx, c.Ky = c.Kx * (1 - A * window), c.Ky * (1 - A * window)

    s.soil[place].append(change)
    s.read[TORQUE_COLUMN[place]] += size * window * ca.sin(2 * np.pi * frequency * s.t + draw.uniform(0, 6))


# ---------------------------------------------------------------------------------------- geometry and structure
def measuring_wheel_radius(s: Scene, place: str, A: float, draw: DRAW) -> None:
    s.read[ANGLE_COLUMN[place]] /= 1 + A


def _two_masses(s: Scene, spring: Callable[[ca.SX], ca.SX], damping: Callable[[ca.SX, ca.SX], ca.SX], J: float) -> None:
    """The cylinders and their encoder move on their own; what lies between passes the torque on."""
    angle, speed = s.state(), s.state()
    s.rates[angle] = speed

    def transmit(U: ca.SX) -> ca.SX:
        twist, rate = angle - s.q[4], speed - s.qd[4]
        passed = spring(twist) + damping(twist, rate)
        s.rates[speed] = (U - passed) / J
        return passed

    s.stiff = True
    s.torque[1].append(transmit)
    s.read["theta2_rad"] = angle


def articulation_backlash(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Two pins in holes that are too wide: free between the flanks, hard at them. A is the whole play."""
    if A == 0:
        return
    k, J = draw.uniform(2e8, 3e8), draw.uniform(60, 90)  # so hard that the flanks' own give is below a count
    c = 2 * draw.uniform(0.2, 0.4) * np.sqrt(k * J)

    def past(twist: ca.SX) -> ca.SX:
        return twist - ca.fmax(ca.fmin(twist, A / 2), -A / 2)

    _two_masses(
        s,
        lambda twist: k * past(twist),
        lambda twist, rate: c * rate * ca.fmin(ca.fabs(past(twist)) / 2e-6, 1) + 50 * rate,
        J,
    )


def articulation_compliance(s: Scene, place: str, A: float, draw: DRAW) -> None:
    if A == 0:
        return
    J = draw.uniform(40, 80)
    c = 2 * draw.uniform(0.1, 0.3) * np.sqrt(J / A)
    _two_masses(s, lambda twist: twist / A, lambda twist, rate: c * rate, J)


def articulation_stop_spring(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Rubber buffers: progressive, and sometimes only one of them touches."""
    angle, progress = draw.uniform(0.12, 0.25), draw.uniform(0, 4)
    sides = draw.choice([(1, 1), (1, 0), (0, 1)], p=[0.6, 0.2, 0.2])

    def pressed(x: ca.SX) -> ca.SX:
        return A * x * (1 + (progress * x) ** 2)

    s.torque[1].append(
        lambda U: (
            U
            - float(sides[0]) * pressed(ca.fmax(s.q[4] - angle, 0))
            + float(sides[1]) * pressed(ca.fmax(-s.q[4] - angle, 0))
        )
    )


def payload_shift(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """800 kg on the rear chassis slide along it within a second or so: A of first moment in all."""
    when, takes, mass = draw.uniform(15, 35), draw.uniform(0.3, 0.8), 800.0
    at = -0.95 + A / mass * (1 + ca.tanh((s.t - when) / takes)) / 2
    s.point(mass, "rear", at, 0.0)
    s.point(-mass, "rear", -0.95, 0.0)


def friction_transition(s: Scene, place: str, A: float, draw: DRAW) -> None:
    """Dry friction turns more suddenly, or less, and not quite as it did further out."""
    tail = draw.uniform(-0.2, 0.3) * math.tanh(abs(A))
    s.sign[JOINTS[place]] = lambda x: ca.tanh(math.exp(A) * x * (1 + tail * x**2 / (1 + x**2)))


_JOINTS, _WHEELED = tuple(JOINTS), (*ROLLS, *WHEELS)
_TABLE: tuple[tuple[Hide, tuple[str, ...], str, dict[str, tuple[float, float]], dict[str, Any]], ...] = (
    (stribeck_friction, _JOINTS, "N m", {"": (40, 180), "articulation": (200, 1000)}, {}),
    (load_dependent_friction, _JOINTS, "-", {"": (0.012, 0.1), "articulation": (0.02, 0.12)}, {}),
    (asymmetric_coulomb, _JOINTS, "N m", {"": (20, 90), "articulation": (100, 500)}, {"signed": True}),
    (asymmetric_viscous, _JOINTS, "N m s", {"": (6, 40), "articulation": (400, 2500)}, {"signed": True}),
    (quadratic_drag, _JOINTS, "N m s2", {"": (7, 35), "articulation": (3000, 25000)}, {}),
    (friction_warm_up, _JOINTS, "-", {"": (0.1, 0.8), "articulation": (0.15, 0.9)}, {}),
    (actuator_lag, _JOINTS, "s", {"": (0.02, 0.15), "articulation": (0.04, 0.2)}, {}),
    (channel_delay, _JOINTS, "s", {"": (0.02, 0.12), "articulation": (0.03, 0.15)}, {}),
    (torque_gain, _JOINTS, "-", {"": (0.02, 0.12), "articulation": (0.03, 0.15)}, {"signed": True}),
    (torque_offset_drift, _JOINTS, "N m/s", {"": (0.4, 3), "articulation": (3, 20)}, {"signed": True}),
    (torque_deadband, ROLLS, "N m", {"": (20, 150)}, {}),
    (pump_coupling, ("drive",), "-", {"": (0.02, 0.12)}, {"signed": True}),
    (roll_unbalance, ROLLS, "N m", {"": (10, 100)}, {}),
    (encoder_eccentricity, _WHEELED, "rad", {"": (0.001, 0.01)}, {}),
    (torque_ripple, ROLLS, "N m", {"": (20, 150)}, {}),
    (shear_saturation, ROLLS, "-", {"": (0.8, 0.15)}, {"none": np.inf}),
    (lateral_saturation, ROLLS, "-", {"": (0.5, 0.08)}, {"none": np.inf}),
    (drive_brake_asymmetry, ROLLS, "-", {"": (0.03, 0.4)}, {"signed": True}),
    (compaction_per_pass, ("drive",), "-", {"": (0.06, 0.5)}, {}),
    (slip_relaxation, ROLLS, "m", {"": (0.008, 0.06)}, {}),
    (rolling_resistance, ROLLS, "N", {"": (40, 500)}, {}),
    (ground_slope, ("machine",), "rad", {"": (0.0005, 0.012)}, {}),
    (measuring_wheel_radius, WHEELS, "-", {"": (0.0004, 0.01)}, {"signed": True}),
    (articulation_backlash, ("articulation",), "rad", {"": (0.0006, 0.006)}, {}),
    (articulation_compliance, ("articulation",), "rad/(N m)", {"": (3e-8, 5e-7)}, {}),
    (articulation_stop_spring, ("articulation",), "N m/rad", {"": (4000, 40000)}, {}),
    (vibration_on, ROLLS, "-", {"": (0.04, 0.35)}, {}),
    (payload_shift, ("machine",), "kg m", {"": (120, 1000)}, {"signed": True}),
    (relief_valve, ROLLS, "-", {"": (0.15, 1.0)}, {}),
    (friction_transition, _JOINTS, "-", {"": (0.6, 3), "articulation": (0.2, 1.5)}, {"signed": True}),
    # New ones come last: cases are drawn by a cause's place in this table.
    (roll_out_of_round, ROLLS, "m", {"": (0.0002, 0.004)}, {}),
    (brake_drag, ROLLS, "N m", {"": (40, 400)}, {}),
)
CAUSES: dict[str, Cause] = {
    f.__name__: Cause(places, unit, amounts, f, **more) for f, places, unit, amounts, more in _TABLE
}


def hide(scene: Scene, name: str, place: str, amount: float, seed: int) -> None:
    """Hides a cause of `CAUSES` in a scene; its shape is drawn from the seed. Raises ValueError for a wrong place."""
    cause = CAUSES[name]
    if place not in cause.places:
        raise ValueError(f"{name}: sits at {', '.join(cause.places)}, not at {place}")
    cause.hide(scene, place, amount, np.random.default_rng([seed, 15]))
