"""Doubts about values of a machine file that look like those of another unit.

Bounds are chosen unless they say otherwise: wider than any machine that was met, narrower than the usual slip.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from excite.model import mechanics
from excite.model.effects import GRAVITY
from excite.model.machine import Body, Machine, Sensor
from excite.text import format_number
from excite.workflows.sensor_table import doubt_sensors

BAR = 1e5  # Pa
MAX_LENGTH = 30.0  # [m] of the table
MAX_LANE = 5e3  # [m]
MAX_SPEED = {"roll": 5.0, "wheel": 70.0}  # [m/s] of rims
ROLL_WIDTH = 1.0  # [m] from which a contact is a roll, not a wheel
MAX_RATE = 60.0  # [rad/s] of a joint without contact: 570 rpm
MAX_SLIDE = 50.0  # [m] of a sliding joint
MAX_SMOOTHING = 1.0  # [rad/s]
DENSITY = (2.0, 2e4)  # [kg/m3] mass over the cube of the machine's length
SPIN_SHARE = 0.1  # least spin inertia of a wheel over mass x radius^2; a hoop has 1, a disc 0.5
MAX_DISPLACEMENT = 0.1  # [m3 per turn of the joint]
MAX_AREA = 0.5  # [m2] of a cylinder
PRESSURE = (20 * BAR, 1000 * BAR)  # that a limit of torque may ask for
SLOWEST_LOOP = 0.5  # usual time constant and dead time of a drive's loop [s]; chosen
FULL_SCALE = {"V": 10.0, "mV": 10e3, "mA": 20.0}  # largest reading of sensors with a factor
SCALE_TIMES = 8.0  # times that a sensor's range may exceed the pressure at the limit of torque


def _angles(machine: Machine) -> Iterator[str]:
    """Find angles in degrees."""
    for b in machine.body:
        for key in ("gamma", "alpha", "theta"):
            value = float(getattr(b, key))
            if abs(value) > 2 * math.pi + 1e-6:
                yield f"{b.name}: {key}: {value:g} rad is more than a turn: in degrees?"
        if b.friction is not None and b.joint == "revolute" and float(b.friction.smoothing) > MAX_SMOOTHING:
            yield (
                f"{b.name}: friction.smoothing: {float(b.friction.smoothing):g} rad/s, usual are {MAX_SMOOTHING:g} at"
                " most: in deg/s?"
            )


def _lengths(machine: Machine) -> Iterator[str]:
    """Find lengths in millimetres."""
    for b in machine.body:
        for key in ("b", "d", "r"):
            value = float(getattr(b, key))
            if abs(value) > MAX_LENGTH:
                yield f"{b.name}: {key}: {value:g} m, usual are {MAX_LENGTH:g} at most: in mm?"
        top = b.limit.reach
        if b.joint == "prismatic" and top is not None and top > MAX_SLIDE:
            yield f"{b.name}: limit.position: {top:g} m, usual are {MAX_SLIDE:g} at most: in mm?"
    for name, problem in machine.problems.items():
        if problem.lane_m is not None and max(problem.lane_m) > MAX_LANE:
            yield f"problems.{name}.lane_m: {max(problem.lane_m):g} m, usual are {MAX_LANE:g} at most: in mm?"


def _speeds(machine: Machine) -> Iterator[str]:
    """Find speeds in km/h and rates in rpm or deg/s."""
    for b in machine.body:
        rate, speed = b.limit.rate, b.limit.rim_speed
        if b.contact is None:
            if rate is not None and b.joint == "revolute" and float(rate) > MAX_RATE:
                yield f"{b.name}: limit.rate: {float(rate):g} rad/s, usual are {MAX_RATE:g} at most: in deg/s or rpm?"
            continue
        kind = "roll" if float(b.contact.width) >= ROLL_WIDTH else "wheel"
        if speed is not None and float(speed) > MAX_SPEED[kind]:
            yield (
                f"{b.name}: limit.rim_speed: {float(speed):g} m/s, usual of a {kind} are {MAX_SPEED[kind]:g} at most:"
                f" in km/h? ({float(speed):g} km/h are {format_number(float(speed) / 3.6, 3)} m/s)"
            )
        rim = float(rate) * float(b.contact.radius) if rate is not None else 0.0
        if rim > (3 * float(speed) if speed is not None else MAX_SPEED[kind]):
            yield (
                f"{b.name}: limit.rate: {float(rate or 0):g} rad/s are {format_number(rim, 3)} m/s at the rim: in rpm?"
                f" ({float(rate or 0):g} rpm are {format_number(float(rate or 0) * math.pi / 30, 3)} rad/s)"
            )


def _masses(machine: Machine) -> Iterator[str]:
    """Find masses in tonnes or grams, and spin inertias in other units than kg m2."""
    places = np.array([P for _, P in mechanics.body_poses(machine, {}).values()])
    wheels = [b for b in machine.contacts if b.contact is not None]
    reach = float(np.ptp(places, axis=0).max()) + 2 * max((_radius(b) for b in wheels), default=0.0)
    bodies = [(b, b.inertia) for b in machine.body if b.inertia is not None]
    mass = sum(float(i.mass) for _, i in bodies)
    if reach > 0 and not DENSITY[0] < mass / reach**3 < DENSITY[1]:
        unit = "t" if mass / reach**3 <= DENSITY[0] else "g"
        yield f"inertia.mass: {mass:g} kg in all for a machine {format_number(reach, 3)} m long: in {unit}?"
    for b, i in bodies:
        if b in wheels and 0 < float(i.ZZ) < SPIN_SHARE * float(i.mass) * _radius(b) ** 2:
            disc = format_number(0.5 * float(i.mass) * _radius(b) ** 2, 3)
            yield f"{b.name}: inertia.ZZ: {float(i.ZZ):g} kg m2, a disc of this mass and radius has {disc}"


def _radius(b: Body) -> float:
    return float(b.contact.radius) if b.contact is not None else 0.0


def _gravity(machine: Machine) -> Iterator[str]:
    size = float(np.linalg.norm(machine.gravity))
    if size and abs(size / GRAVITY - 1) > 0.02:
        yield f"gravity: {size:g} m/s2, the Earth's is {GRAVITY:g} (0 0 0 for none): in another unit?"


def _power(machine: Machine) -> Iterator[str]:
    """Find a power limit in kW: below a tenth of what friction takes at full speed."""
    needed = 0.0
    for b in machine.actuated:
        if b.friction is not None and b.contact is not None and b.limit.rim_speed is not None:
            rate = float(b.limit.rim_speed) / float(b.contact.radius)
            needed += (float(b.friction.Fs) + float(b.friction.Fv) * rate) * rate
    limit = machine.power_limit
    if limit is not None and float(limit) < 0.1 * needed:
        yield (
            f"power_limit: {float(limit):g} W, friction alone takes {format_number(needed, 3)} W at the rim speeds that"
            " are allowed: in kW?"
        )


def _hydraulics(machine: Machine) -> Iterator[str]:
    """Find displacements in cc, areas in cm2, and pressures a tenth or ten times what the torque asks for."""
    for s in machine.sensors("full"):
        if s.displacement is not None and float(s.displacement) > MAX_DISPLACEMENT:
            yield (
                f"sensor {s.name}: displacement: {float(s.displacement):g} m3 per turn, usual are"
                f" {MAX_DISPLACEMENT:g} at most: in cc? (1 cc = 1e-6 m3)"
            )
            continue
        for c in s.cylinders:
            if max(float(c.area), float(c.rod_area)) > MAX_AREA:
                yield f"sensor {s.name}: cylinders: area {float(c.area):g} m2: in cm2? (1 cm2 = 1e-4 m2)"
        yield from _pressures(machine, s)


def _pressures(machine: Machine, s: Sensor) -> Iterator[str]:
    """Compare the pressure behind the limit of torque with usual ones, and with the sensor's range."""
    top = machine.find(s.body).limit.torque
    if s.displacement is None or top is None:
        return
    needed = 2 * math.pi * float(top) / float(s.displacement)
    if not PRESSURE[0] <= needed <= PRESSURE[1]:
        yield (
            f"sensor {s.name}: displacement: {float(s.displacement):g} m3 per turn needs"
            f" {format_number(needed / BAR, 3)} bar for limit.torque {float(top):g} N m, usual are"
            f" {PRESSURE[0] / BAR:g} to {PRESSURE[1] / BAR:g}: gear left out, or another unit?"
        )
    elif s.factor is not None and s.unit in FULL_SCALE:
        reach = abs(float(s.factor)) * FULL_SCALE[s.unit]
        if reach < needed or reach > SCALE_TIMES * needed:
            yield (
                f"sensor {s.name}: factor: {FULL_SCALE[s.unit]:g} {s.unit} are {format_number(reach / BAR, 3)} bar, but"
                f" limit.torque asks for {format_number(needed / BAR, 3)} bar: a tenth or ten times the pressure?"
            )


def _readings(machine: Machine) -> Iterator[str]:
    """Find counts, loops and rates of sampling in other units."""
    for s in machine.sensors("full"):
        if s.counts_per_turn is not None and float(s.counts_per_turn) < 8:
            yield f"sensor {s.name}: counts_per_turn: {float(s.counts_per_turn):g}: the size of a count, or a ratio?"
        for key in ("time_constant", "dead_time") if s.loop is not None else ():
            value = float(getattr(s.loop, key) or 0.0)
            if value > SLOWEST_LOOP:
                yield f"sensor {s.name}: loop.{key}: {value:g} s, usual are {SLOWEST_LOOP:g} at most: in ms?"
    if float(machine.sampling_hz) < 2:
        yield f"sampling_hz: {float(machine.sampling_hz):g} Hz: a time step in s?"


UNIT_DOUBTS: tuple[Callable[[Machine], Iterator[str]], ...] = (
    *(_angles, _lengths, _speeds, _masses, _gravity, _power, _hydraulics, _readings, doubt_sensors),
)
