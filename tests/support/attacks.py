"""Attack the diagnosis: unlisted physics, wrong machine files, unequal combinations, poor data, rigs that stick.

The logs come from the second roller (`plant`) or from a rig of one mass with exact dry friction (`sticking`).
Each attack states its answer key before anything is diagnosed; `score` compares the diagnosis with that key only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
from support import plant
from support.blind import Blind, Case
from support.causes import ANGLE_COLUMN, CAUSES, SMOOTH, TORQUE_COLUMN, WHEELS, hide
from support.plant import JOINTS, RATE, ROLLS, TURNING, G, Machine, Motion, Plan, Scene, System
from support.sticking import GAIN, RATE as RIG_RATE, SUBSTEPS, TRUTH, _reference, advance
from support.surprises import SURPRISES, surprise

Draw = np.random.Generator
KINDS = ("unlisted", "file", "combination", "poor", "rig", "surprise")
OUTCOMES = ("right", "partly", "honest", "wrong", "failed")
# Smallest size of an attack by kind, of 1; sizes are drawn evenly in their logarithm.
WEAKEST = {"unlisted": 0.05, "file": 1 / 3, "combination": 0.2, "poor": 0.2, "rig": 0.1, "surprise": 0.2}
SECONDS, SHORT_SECONDS, RIG_SECONDS = 60.0, 20.0, 25.0
WHEEL = {"measuring_wheel_left": "D_l", "measuring_wheel_right": "D_r"}


# -------------------------------------------------------------------------------------------------- answer keys
@dataclass(frozen=True)
class Key:
    """The answers that are right, written down before the diagnosis is asked.

    truths: one group of effect@where per hidden thing that has a name; any name of a group is right.
    related: names of the same physics with another law; a name among them is partly right.
    nothing: nothing is hidden, so `clean` is right and everything else is wrong.
    """

    truths: tuple[tuple[str, ...], ...] = ()
    related: tuple[str, ...] = ()
    nothing: bool = False

    def text(self) -> str:
        if self.nothing:
            return "clean"
        named = " and ".join(" or ".join(group) for group in self.truths)
        kin = f"partly: {', '.join(self.related)}" if self.related else ""
        return "; ".join(part for part in (named, kin, "honest: unexplained, clean, corrections") if part)


def score(key: Key, summary: Mapping[str, Any]) -> str:
    """Return one of OUTCOMES for the summary of `excite diagnose` (CONTRACT.md section 3).

    right: every hidden thing with a name is named, alone or in a tie, and nothing else is.
    partly: some of them are, or a related name, and nothing else; a correction that is true counts as well.
    honest: no cause is named (clean, unexplained, or corrections that are not true).
    wrong: a cause is named that is neither true nor related; anything but `clean` where nothing is hidden.
    """
    findings = summary["findings"]
    if key.nothing:
        return "right" if summary["verdict"] == "clean" and not findings else "wrong"
    ties = [({f"{f['effect']}@{f['where']}", *f["tied_with"]}, f["kind"]) for f in findings]
    causes = [tie for tie, kind in ties if kind == "cause"]
    known = {label for group in key.truths for label in group}
    if any(not tie & (known | set(key.related)) for tie in causes):
        return "wrong"
    if not causes:
        return "partly" if any(tie & known for tie, _ in ties) else "honest"
    covered = [any(tie & set(group) for tie in causes) for group in key.truths]
    return "right" if covered and all(covered) and all(tie & known for tie in causes) else "partly"


# ---------------------------------------------------------------------------------------------- what is built
@dataclass
class Trial:
    """A log while it is being prepared: what the attack adds to the second roller, its plan and its log.

    shift: differences of the true geometry from the machine file's. edits: changes of the finished log.
    """

    scene: Scene
    seed: int
    seconds: float
    shift: dict[str, float] = field(default_factory=dict)
    plans: list[Callable[[Plan], Plan]] = field(default_factory=list)
    edits: list[Callable[[pd.DataFrame], pd.DataFrame]] = field(default_factory=list)
    hidden: list[str] = field(default_factory=list)
    manoeuvre: str = ""
    kit: str = ""

    def sensed(self, column: str, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        """Change a column before the sensor: change(t, values)."""

        def act(t: np.ndarray, columns: dict[str, np.ndarray], _: Draw) -> None:
            columns[column] = change(t, columns[column])

        self.scene.sensed.append(act)


Attacking = Callable[[Trial, float, Draw], Key]


def _roll(draw: Draw) -> str:
    return str(draw.choice(ROLLS))


def _joint(draw: Draw) -> str:
    return str(draw.choice(list(JOINTS)))


def _share(t: Trial, place: str, factor: ca.SX) -> None:
    """Multiply both soil stiffnesses of a roll by a factor."""

    def change(c: Any) -> None:
        c.Kx, c.Ky = c.Kx * factor, c.Ky * factor

    t.scene.soil[place].append(change)


def _law(t: Trial, place: str, change: Callable[[Any, ca.SX, ca.SX, ca.SX], tuple[ca.SX, ca.SX, ca.SX]]) -> None:
    """Change the forces and the moment of the linear law."""
    t.scene.law[place] = lambda c: change(c, *plant.linear(c))


def _full(place: str) -> float:
    """Return the friction torque [N m] that anyone would notice at a joint."""
    return 1200.0 if place == "articulation" else 200.0


def _fast(place: str) -> float:
    """Return the usual speed [rad/s] of a joint."""
    return 0.15 if place == "articulation" else 1.5


# --------------------------------------------------------------------------------------------- unlisted physics
def turn_slip(t: Trial, size: float, draw: Draw) -> Key:
    """A parking moment that saturates and fades with speed. Source: Pacejka, Tire and Vehicle Dynamics, 2012."""
    place, fade = _roll(draw), draw.uniform(0.4, 0.8)

    def change(c: Any, Sx: ca.SX, Sy: ca.SX, Mz: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        return Sx, Sy, Mz - 3000 * size * ca.tanh(c.yaw / 0.04) * ca.exp(-((c.rim / fade) ** 2))

    _law(t, place, change)
    return Key(related=(f"turning_moment@{place}",))


def soil_gradient(t: Trial, size: float, draw: Draw) -> Key:
    """The lane stiffens steadily from one end to the other. Source: Mooney, Rinehart, J. Geotech. Eng. 133 (2007)."""
    per_metre = 0.04 * size * draw.choice([-1, 1])
    for place in ROLLS:
        x = t.scene.contact[place].position[0]
        _share(t, place, 1 + 0.6 * ca.tanh(per_metre * x / 0.6))
    return Key()


def pressure_leakage(t: Trial, size: float, draw: Draw) -> Key:
    """A share of the torque that grows with pressure is lost. Source: Merritt, Hydraulic Control Systems, 1967."""
    place = _roll(draw)
    t.scene.torque[JOINTS[place]].append(lambda U: U * (1 - 0.35 * size * ca.sqrt(U**2 + 100.0) / 5000))
    return Key(((f"torque_nonlinearity@{place}",),), related=(f"relief_valve@{place}",))


def friction_memory(t: Trial, size: float, draw: Draw) -> Key:
    """Friction follows a speed of seconds ago. Source: Hess, Soom, J. Tribology 112 (1990), frictional lag."""
    s, place, time = t.scene, _joint(draw), draw.uniform(0.5, 2.0)
    w, seen = s.qd[TURNING[place]], s.state()
    s.rates[seen] = (ca.sqrt(w**2 + 1e-8) - seen) / time
    fade = 0.3 * _fast(place)
    s.friction[JOINTS[place]].append(
        lambda w, U: size * _full(place) * ca.exp(-seen / fade) * ca.tanh(w / SMOOTH[place])
    )
    return Key(related=(f"stribeck_friction@{place}",))


def dwell_stiction(t: Trial, size: float, draw: Draw) -> Key:
    """Breakaway torque grows with the time at rest. Source: Rabinowicz, Proc. Physical Society 71 (1958)."""
    s, place = t.scene, _roll(draw)
    w, aged = s.qd[TURNING[place]], s.state()
    rest = ca.exp(-((w / 0.05) ** 2))
    s.rates[aged] = rest * (1 - aged) / draw.uniform(1.0, 3.0) - (1 - rest) * aged / draw.uniform(0.15, 0.4)
    s.friction[JOINTS[place]].append(lambda w, U: 400 * size * aged * ca.tanh(w / SMOOTH[place]))
    return Key(related=(f"stribeck_friction@{place}",))


def fine_cogging(t: Trial, size: float, draw: Draw) -> Key:
    """Cogging finer than any listed order. Source: Manring, J. Dyn. Syst. Meas. Control 120 (1998), torque ripple."""
    place, order, phase = _roll(draw), int(draw.integers(24, 48)), draw.uniform(0, 6)
    angle = t.scene.q[TURNING[place]]
    t.scene.torque[JOINTS[place]].append(lambda U: U + 150 * size * ca.sin(order * angle + phase))
    return Key(related=(f"torque_ripple@{place}",))


def load_ripple(t: Trial, size: float, draw: Draw) -> Key:
    """Ripple in proportion to the pressure. Source: Ivantysyn, Hydrostatic Pumps and Motors, 2001."""
    place, order, phase = _roll(draw), int(draw.integers(5, 14)), draw.uniform(0, 6)
    angle = t.scene.q[TURNING[place]]
    t.scene.torque[JOINTS[place]].append(lambda U: U * (1 + 0.2 * size * ca.sin(order * angle + phase)))
    return Key(related=(f"torque_ripple@{place}",))


def pin_damping(t: Trial, size: float, draw: Draw) -> Key:
    """Articulation damping that grows with the angle. Source: Azad, Khajepour, McPhee, Vehicle Syst. Dyn. 45 (2007)."""
    angle = t.scene.q[TURNING["articulation"]]
    t.scene.friction[1].append(lambda w, U: 1.0e5 * size * angle**2 * w)
    return Key()


def lever_arm(t: Trial, size: float, draw: Draw) -> Key:
    """Steering cylinders lose leverage with the angle. Source: Horton, Crolla, Vehicle Syst. Dyn. 15 (1986)."""
    angle, skew = t.scene.q[TURNING["articulation"]], draw.uniform(-0.3, 0.3)
    t.scene.torque[1].append(lambda U: U * (1 - size * (1.2 * angle**2 + skew * angle)))
    return Key()


def combined_slip(t: Trial, size: float, draw: Draw) -> Key:
    """Sliding sideways takes traction away. Source: Pacejka, Tire and Vehicle Dynamics, 2012."""
    place, at = _roll(draw), draw.uniform(0.02, 0.04)

    def change(c: Any, Sx: ca.SX, Sy: ca.SX, Mz: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        gy = c.Vy / c.vn
        return Sx * (1 - 0.6 * size * gy**2 / (gy**2 + at**2)), Sy, Mz

    _law(t, place, change)
    return Key(related=(f"shear_saturation@{place}",))


def ply_steer(t: Trial, size: float, draw: Draw) -> Key:
    """Traction pulls sideways as well: skewed pads. Source: Pottinger, SAE 760731 (1976), plysteer."""
    place, side = _roll(draw), draw.choice([-1, 1])

    def change(c: Any, Sx: ca.SX, Sy: ca.SX, Mz: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        return Sx, Sy + side * 0.3 * size * Sx, Mz

    _law(t, place, change)
    return Key(related=(f"contact_alignment@{place}",))


def lateral_peak(t: Trial, size: float, draw: Draw) -> Key:
    """Lateral force falls beyond a peak. Source: Bakker, Nyborg, Pacejka, SAE 870421 (1987), magic formula."""
    place, at = _roll(draw), draw.uniform(0.03, 0.06)

    def change(c: Any, Sx: ca.SX, Sy: ca.SX, Mz: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        g = ca.sqrt((c.Vy / c.vn) ** 2 + 1e-12) / at
        return Sx, Sy * (1 - 0.8 * size * g**3 / (1 + g**3)), Mz

    _law(t, place, change)
    return Key(related=(f"lateral_saturation@{place}", f"shear_saturation@{place}"))


def side_bulldozing(t: Trial, size: float, draw: Draw) -> Key:
    """The drum's flank pushes a berm aside. Source: Schwanghart, J. Terramechanics 5 (1968), lateral forces."""
    place, soft = _roll(draw), draw.uniform(0.01, 0.03)

    def change(c: Any, Sx: ca.SX, Sy: ca.SX, Mz: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        return Sx, Sy - 1500 * size * ca.tanh(c.Vy / soft), Mz

    _law(t, place, change)
    return Key(related=(f"lateral_saturation@{place}",))


def heating_drag(t: Trial, size: float, draw: Draw) -> Key:
    """Work heats the oil and standing cools it. Source: Bair, High Pressure Rheology, 2007, viscosity-temperature."""
    s, place, time = t.scene, _joint(draw), draw.uniform(6, 20)
    w, warm = s.qd[TURNING[place]], s.state()
    s.rates[warm] = ((w / _fast(place)) ** 2 - warm) / time
    s.wear[JOINTS[place]] = s.wear[JOINTS[place]] * ca.exp(-1.5 * size * warm)
    return Key(related=(f"friction_warm_up@{place}",))


def slip_sinkage(t: Trial, size: float, draw: Draw) -> Key:
    """Slip digs the roll in, which resists. Source: Lyasko, J. Terramechanics 47 (2010), slip sinkage."""
    s, place = t.scene, _roll(draw)
    c = s.contact[place]
    slip = ca.sqrt(((c.Vx - c.rim) / c.vn) ** 2 + 1e-8) / 0.02
    force = -1200 * size * ca.tanh(c.Vx / 0.05) * slip / (1 + slip)
    s.push(c.chassis, 0.0 if c.chassis == "front" else -s.m.D3, 0.0, plant.turn(s.heading(c.chassis), force, 0.0))
    return Key(related=(f"rolling_resistance@{place}",))


def split_soil(t: Trial, size: float, draw: Draw) -> Key:
    """One half of a roll runs on harder ground. Source: Mitschke, Wallentowitz, Dynamik der Kraftfahrzeuge, 2014."""
    place, arm = _roll(draw), draw.choice([-1, 1]) * 0.35 * size

    def change(c: Any, Sx: ca.SX, Sy: ca.SX, Mz: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        return Sx, Sy, Mz - arm * Sx

    _law(t, place, change)
    return Key()


def washboard(t: Trial, size: float, draw: Draw) -> Key:
    """Ripples across the lane push to and fro. Source: Taberlet, Morris, McElwaine, Phys. Rev. Lett. 99 (2007)."""
    s, place, length = t.scene, _roll(draw), draw.uniform(0.6, 1.6)
    c = s.contact[place]
    force = 900 * size * ca.sin(2 * np.pi * c.position[0] / length + draw.uniform(0, 6))
    s.push(c.chassis, 0.0 if c.chassis == "front" else -s.m.D3, 0.0, ca.vertcat(force, 0))
    return Key()


def lane_hollow(t: Trial, size: float, draw: Draw) -> Key:
    """The lane has a hollow: gravity by place. Source: Sayers, Karamihas, Little Book of Profiling, 1998."""
    s, middle, width = t.scene, draw.uniform(0, 5), draw.uniform(1.5, 4)
    for mass, chassis, x, y in s.bodies():
        at = (s.place(chassis, x, y)[0] - middle) / width
        s.push(chassis, x, y, ca.vertcat(-mass * G * 0.02 * size * at * ca.exp(-(at**2)), 0))
    return Key(related=("ground_slope@machine",))


def strain_rate(t: Trial, size: float, draw: Draw) -> Key:
    """Soil is stiffer when sheared faster. Source: Grahn, J. Terramechanics 28 (1991), penetration velocity."""
    middle = draw.uniform(0.5, 1.0)
    for place in ROLLS:
        speed = ca.sqrt(t.scene.contact[place].rim ** 2 + 1e-4)
        _share(t, place, 1 + 0.5 * size * ca.tanh((speed - middle) / 0.4))
    return Key()


def engine_droop(t: Trial, size: float, draw: Draw) -> Key:
    """Load slows the engine, and both pumps give less. Source: Guzzella, Onder, IC Engine Systems, 2010, governor."""
    s, low = t.scene, t.scene.state()
    power = ca.sqrt((s.u[0] * s.qd[3] + s.u[2] * s.qd[5]) ** 2 + 100.0)
    s.rates[low] = (power / 6000 - low) / draw.uniform(0.4, 1.5)
    for j in (0, 2):
        s.torque[j].append(lambda U: U * (1 - 0.5 * size * ca.tanh(low)))
    return Key(related=("pump_coupling@drive",))


def tank_empties(t: Trial, size: float, draw: Draw) -> Key:
    """The sprinkler's tank runs empty, steadily. Source: Meshchersky's equation of a body of variable mass, 1897."""
    s, x = t.scene, draw.uniform(-2.0, -0.8)
    mass = 2500.0 * size * (1 - s.t / 60)
    s.point(mass, "rear", x, 0.0)
    s.push("rear", x, 0.0, ca.jacobian(mass, s.t) * s.velocity(s.place("rear", x, 0.0)))  # water leaves with its speed
    return Key((("mass_drift@machine",),))


def belt_creep(t: Trial, size: float, draw: Draw) -> Key:
    """An encoder's belt creeps under the drive's load. Source: Firbank, Int. J. Mech. Sci. 12 (1970), belt drives."""
    s, place = t.scene, _roll(draw)
    w, U = s.qd[TURNING[place]], s.u[JOINTS[place]]
    s.read[ANGLE_COLUMN[place]] = s.state(w * (1 - 0.02 * size * ca.tanh(U / 1500)))
    return Key(related=(f"encoder_scale@{place}",))


def gyro_lag(t: Trial, size: float, draw: Draw) -> Key:
    """The gyro's own filter is slow. Source: IEEE Std 952, bandwidth of a rate gyro."""
    s = t.scene
    t.kit = "full"
    late = s.state()
    s.rates[late] = (s.qd[2] - late) / (0.4 * size)
    s.read["yaw_rate_rad_s"] = late
    return Key((("yaw_rate_lag@yaw_rate",),))


def double_stribeck(t: Trial, size: float, draw: Draw) -> Key:
    """Seal drag that rises, falls and rises with speed. Source: Nikas, Proc. IMechE J 224 (2010), seals."""
    place = _joint(draw)
    fast, depth = _fast(place), _full(place)
    t.scene.friction[JOINTS[place]].append(
        lambda w, U: (
            size
            * depth
            * ca.exp(-(((ca.sqrt(w**2 + 1e-8) - 0.5 * fast) / (0.25 * fast)) ** 2))
            * ca.tanh(w / SMOOTH[place])
        )
    )
    return Key()


# ------------------------------------------------------------------------------------------- wrong machine files
def _length(size: float, draw: Draw, largest: float) -> float:
    return float(draw.choice([-1, 1]) * largest * size)


def front_length(t: Trial, size: float, draw: Draw) -> Key:
    """Front axle to articulation, up to 10 mm off. Source: tape measure."""
    t.shift["D2"] = _length(size, draw, 0.010)
    return Key((("contact_position@rear_roll", "contact_position@front_roll"),))


def rear_length(t: Trial, size: float, draw: Draw) -> Key:
    """Articulation to rear axle, up to 10 mm off. Source: tape measure."""
    t.shift["D3"] = _length(size, draw, 0.010)
    return Key((("contact_position@rear_roll",),))


def roll_width(t: Trial, size: float, draw: Draw) -> Key:
    """Both rolls bear on another width, up to 100 mm off. Source: worn or crowned rolls."""
    t.shift["L"] = _length(size, draw, 0.100)
    return Key((("turning_moment@front_roll",), ("turning_moment@rear_roll",)))


def roll_radius(t: Trial, size: float, draw: Draw) -> Key:
    """A roll's radius up to 3 mm off. Source: wear, a coat of soil."""
    place, more = _roll(draw), _length(size, draw, 0.003)

    def change(c: Any) -> None:
        c.R = c.R + more
        c.rim = c.R * c.w
        c.vn = ca.sqrt(c.rim**2 + t.scene.m.v_eps**2)

    t.scene.soil[place].append(change)
    return Key(((f"contact_radius@{place}",),))


def both_radii(t: Trial, size: float, draw: Draw) -> Key:
    """Both rolls' radii up to 3 mm off. Source: a data sheet of another roll."""
    t.shift["R"] = _length(size, draw, 0.003)
    return Key((("contact_radius@front_roll",), ("contact_radius@rear_roll",)))


def wheel_radius(t: Trial, size: float, draw: Draw) -> Key:
    """A measuring wheel's radius up to 3 mm off. Source: a worn rubber rim."""
    place = str(draw.choice(WHEELS))
    t.scene.read[ANGLE_COLUMN[place]] /= 1 + _length(size, draw, 0.003) / 0.33
    return Key(((f"measuring_wheel_radius@{place}",),))


def _of_both_wheels(effect: str) -> Key:
    """An error of both measuring wheels, named once or at each."""
    return Key(tuple((f"{effect}@{place}", f"{effect}@measuring_wheels") for place in WHEELS))


def wheel_radii(t: Trial, size: float, draw: Draw) -> Key:
    """Both measuring wheels' radii up to 3 mm off. Source: temperature, load."""
    t.shift["R_wheel"] = _length(size, draw, 0.003)
    return _of_both_wheels("measuring_wheel_radius")


def track(t: Trial, size: float, draw: Draw) -> Key:
    """A measuring wheel's lateral place up to 10 mm off. Source: tape measure."""
    place = str(draw.choice(WHEELS))
    t.shift[WHEEL[place]] = _length(size, draw, 0.010)
    return Key(((f"measuring_wheel_position@{place}",),))


def both_tracks(t: Trial, size: float, draw: Draw) -> Key:
    """Both measuring wheels up to 10 mm further out or in. Source: tape measure."""
    more = _length(size, draw, 0.010)
    t.shift |= {"D_l": more, "D_r": more}
    return _of_both_wheels("measuring_wheel_position")


def roll_counts(t: Trial, size: float, draw: Draw) -> Key:
    """A roll encoder of fewer counts, down to 8000 for 8192. Source: decimal and binary encoders of one series."""
    place = _roll(draw)
    t.scene.read[ANGLE_COLUMN[place]] *= round(8192 - 192 * size) / 8192
    return Key(((f"encoder_scale@{place}",),))


def wheel_counts(t: Trial, size: float, draw: Draw) -> Key:
    """A measuring wheel's encoder of fewer counts, down to 16000 for 16384; by name its radius. Source: see above."""
    place = str(draw.choice(WHEELS))
    t.scene.read[ANGLE_COLUMN[place]] *= round(16384 - 384 * size) / 16384
    return Key(((f"measuring_wheel_radius@{place}",),))


def articulation_counts(t: Trial, size: float, draw: Draw) -> Key:
    """The articulation's encoder of fewer counts, down to 16000 for 16384. Source: see above."""
    t.scene.read["theta2_rad"] *= round(16384 - 384 * size) / 16384
    return Key((("encoder_scale@articulation",),))


def clock_rate(t: Trial, size: float, draw: Draw) -> Key:
    """The logger's clock is up to 1 % off; for the gyro that is a gain. Source: uncompensated RC oscillators."""
    rate = 1 + _length(size, draw, 0.01)
    t.edits.append(lambda log: log.assign(t_s=log.t_s * rate))
    return Key(related=("yaw_rate_gain@yaw_rate",))


def clocks_apart(t: Trial, size: float, draw: Draw) -> Key:
    """One torque channel's clock runs up to 0.2 % slow: later and later. Source: IEEE 1588, drift of free clocks."""
    place = _joint(draw)
    t.sensed(TORQUE_COLUMN[place], lambda at, x: np.interp(at * (1 - 0.002 * size), at, x))
    return Key(((f"clock_drift@{place}",),))


def late_encoder(t: Trial, size: float, draw: Draw) -> Key:
    """A roll's angle arrives up to 60 ms late. Source: CAN bus latency."""
    place = _roll(draw)
    t.sensed(ANGLE_COLUMN[place], lambda at, x: np.interp(at - 0.06 * size, at, x))
    return Key(((f"encoder_delay@{place}",),))


def late_gyro(t: Trial, size: float, draw: Draw) -> Key:
    """The gyro arrives up to 100 ms late; by name a lag. Source: CAN bus latency."""
    t.kit = "full"
    t.sensed("yaw_rate_rad_s", lambda at, x: np.interp(at - 0.1 * size, at, x))
    return Key((("yaw_rate_lag@yaw_rate",),))


def late_torques(t: Trial, size: float, draw: Draw) -> Key:
    """All torques arrive up to 80 ms late. Source: CAN bus latency."""
    for column in TORQUE_COLUMN.values():
        t.sensed(column, lambda at, x: np.interp(at - 0.08 * size, at, x))
    return Key(tuple((f"channel_delay@{place}",) for place in JOINTS))


def _noisier(t: Trial, columns: Sequence[str], times: float) -> None:
    def act(at: np.ndarray, values: dict[str, np.ndarray], rng: Draw) -> None:
        for column in columns:
            values[column] = values[column] + math.sqrt(times**2 - 1) * plant.NOISE[column] * rng.standard_normal(
                len(at)
            )

    t.scene.written.append(act)


def noisy_torques(t: Trial, size: float, draw: Draw) -> Key:
    """Torque noise up to three times the machine file's: no name in the list. Source: data sheets of transducers."""
    _noisier(t, tuple(TORQUE_COLUMN.values()), 1 + 2 * size)
    return Key()


def noisy_motion(t: Trial, size: float, draw: Draw) -> Key:
    """Noise of gyro and lateral speed up to three times the machine file's: no name. Source: engine vibration."""
    t.kit = "full"
    _noisier(t, ("yaw_rate_rad_s", "vy_m_s"), 1 + 2 * size)
    return Key()


def noisy_encoder(t: Trial, size: float, draw: Draw) -> Key:
    """A roll encoder that jitters by up to three counts: no name. Source: quadrature errors, Hanselman, Resolvers."""
    place, counts = _roll(draw), 3 * size

    def act(at: np.ndarray, values: dict[str, np.ndarray], rng: Draw) -> None:
        jitter = np.round(counts * rng.standard_normal(len(at)))
        values[ANGLE_COLUMN[place]] = values[ANGLE_COLUMN[place]] + (jitter - jitter[0]) * 2 * np.pi / 8192

    t.scene.written.append(act)
    return Key()


# ------------------------------------------------------------------------------------------------- combinations
def _hide(t: Trial, name: str, draw: Draw, between: tuple[float, float]) -> str:
    """Hide a listed cause at a share (of 0 to 1) between just visible and strong; return effect@where."""
    cause = CAUSES[name]
    place = str(draw.choice(cause.places))
    weak, strong = (math.log(a) for a in cause.between(place))
    amount = math.exp(weak + draw.uniform(*between) * (strong - weak)) * (draw.choice([-1, 1]) if cause.signed else 1)
    hide(t.scene, name, place, float(amount), t.seed + len(t.hidden))
    t.hidden.append(f"{name}@{place}={amount:.3g}")
    return f"{name}@{place}"


STRONG, WEAK, ANY = (0.7, 1.0), (0.2, 0.5), (0.3, 1.0)


def _cause(draw: Draw, names: Sequence[str] = tuple(CAUSES)) -> str:
    return str(draw.choice(list(names)))


EXCLUSIVE = (  # of each group the second roller holds one
    {"shear_saturation", "lateral_saturation", "slip_relaxation"},
    {"articulation_backlash", "articulation_compliance"},
)


def _causes(draw: Draw, count: int, names: Sequence[str] = tuple(CAUSES)) -> list[str]:
    while True:
        drawn = {str(n) for n in draw.choice(list(names), count, replace=False)}
        if all(len(drawn & group) <= 1 for group in EXCLUSIVE):
            return [str(n) for n in draw.permutation(sorted(drawn))]


def strong_and_weak(t: Trial, size: float, draw: Draw) -> Key:
    """A strong listed cause hides a weak one."""
    names = _causes(draw, 2)
    return Key(tuple((_hide(t, n, draw, b),) for n, b in zip(names, (STRONG, WEAK), strict=True)))


def two_frictions(t: Trial, size: float, draw: Draw) -> Key:
    """Two kinds of friction, a strong and a weak one."""
    kinds = [n for n in CAUSES if "friction" in n or "drag" in n or n.startswith("asymmetric")]
    names = _causes(draw, 2, kinds)
    return Key(tuple((_hide(t, n, draw, b),) for n, b in zip(names, (STRONG, WEAK), strict=True)))


def two_soils(t: Trial, size: float, draw: Draw) -> Key:
    """Two soil effects that do not replace each other's law, a strong and a weak one."""
    law = str(draw.choice(["shear_saturation", "lateral_saturation", "slip_relaxation"]))
    other = str(draw.choice(["drive_brake_asymmetry", "compaction_per_pass", "rolling_resistance", "ground_slope"]))
    return Key(tuple((_hide(t, n, draw, b),) for n, b in ((law, STRONG), (other, WEAK))))


def three_causes(t: Trial, size: float, draw: Draw) -> Key:
    """Three listed causes: strong, middling, weak."""
    names = _causes(draw, 3)
    return Key(tuple((_hide(t, n, draw, b),) for n, b in zip(names, (STRONG, (0.45, 0.7), WEAK), strict=True)))


def cause_and_file(t: Trial, size: float, draw: Draw) -> Key:
    """A listed cause in a machine whose file has a wrong radius."""
    listed = _hide(t, _cause(draw, [n for n in CAUSES if n != "roll_out_of_round"]), draw, ANY)
    t.hidden.append("roll_radius")
    return Key(((listed,), *roll_radius(t, size, draw).truths))


def cause_and_unlisted(t: Trial, size: float, draw: Draw) -> Key:
    """A listed cause of joints or sensors beside unlisted soil physics."""
    soils = [f for f in UNLISTED if f in (soil_gradient, split_soil, washboard, strain_rate)]
    joints = [n for n, c in CAUSES.items() if set(c.places) <= {*JOINTS, *WHEELS}]
    listed = _hide(t, _cause(draw, joints), draw, STRONG)
    other = soils[int(draw.integers(len(soils)))]
    other(t, size, draw)
    t.hidden.append(other.__name__)
    return Key(((listed,),))


# ----------------------------------------------------------------------------------------------------- poor data
def _speed(factor: Callable[[np.ndarray], np.ndarray]) -> Callable[[Plan], Plan]:
    def change(plan: Plan) -> Plan:
        return replace(plan, speed=plan.speed * factor(np.arange(len(plan.speed)) / RATE))

    return change


def _angle(factor: float) -> Callable[[Plan], Plan]:
    return lambda plan: replace(plan, angle=plan.angle * factor)


def short_log(t: Trial, size: float, draw: Draw) -> Key:
    """Twenty seconds with a listed cause."""
    t.seconds = min(t.seconds, SHORT_SECONDS)
    return Key(((_hide(t, _cause(draw), draw, ANY),),))


def little_steering(t: Trial, size: float, draw: Draw) -> Key:
    """A tenth of the usual steering, with a listed cause."""
    t.plans.append(_angle(0.1))
    return Key(((_hide(t, _cause(draw), draw, ANY),),))


def one_direction(t: Trial, size: float, draw: Draw) -> Key:
    """Straight ahead only, with a listed cause of rolls or soil."""
    t.manoeuvre = "one_way"
    t.plans.append(_angle(0.05))
    rolls = [n for n, c in CAUSES.items() if set(c.places) & {*ROLLS, "drive"} and "articulation" not in n]
    return Key(((_hide(t, _cause(draw, rolls), draw, ANY),),))


def long_standstill(t: Trial, size: float, draw: Draw) -> Key:
    """The machine stands for the first 60 %, with a listed cause."""
    begin = 0.6 * t.seconds
    t.plans += [_speed(lambda at: (at > begin).astype(float)), _stand(begin)]
    return Key(((_hide(t, _cause(draw), draw, STRONG),),))


def _stand(begin: float) -> Callable[[Plan], Plan]:
    return lambda plan: replace(plan, angle=np.where(np.arange(len(plan.angle)) / RATE > begin, plan.angle, 0.0))


def crawling(t: Trial, size: float, draw: Draw) -> Key:
    """A fifth of the usual speed, with a listed cause."""
    t.plans.append(_speed(lambda at: np.full_like(at, 0.2)))
    return Key(((_hide(t, _cause(draw), draw, ANY),),))


def short_clean(t: Trial, size: float, draw: Draw) -> Key:
    """Twenty seconds with nothing hidden."""
    t.seconds = min(t.seconds, SHORT_SECONDS)
    return Key(nothing=True)


def straight_clean(t: Trial, size: float, draw: Draw) -> Key:
    """Straight ahead only, with nothing hidden."""
    t.manoeuvre = "one_way"
    t.plans.append(_angle(0.05))
    return Key(nothing=True)


def standing_clean(t: Trial, size: float, draw: Draw) -> Key:
    """The machine stands for the first 60 %, with nothing hidden."""
    begin = 0.6 * t.seconds
    t.plans += [_speed(lambda at: (at > begin).astype(float)), _stand(begin)]
    return Key(nothing=True)


# ---------------------------------------------------------------------------------------------- rigs that stick
@dataclass
class Rig:
    """The friction and the further force of the rig while it moves: state (x, v, t) to values [N].

    dry: level of the dry friction, at rest the breakaway force. force: what else resists. step: advance own memory by
    a time. noise_m, noise_N: of position and force; the shipped machine file states none.
    """

    dry: Callable[[float, float], float] = lambda v, t: TRUTH["Fc"]
    force: Callable[[float, float], float] = lambda x, v: 0.0
    step: Callable[[float, float, float], None] = lambda v, F, dt: None
    edits: list[Callable[[pd.DataFrame], pd.DataFrame]] = field(default_factory=list)
    noise_m: float = 5e-8
    noise_N: float = 0.2


def rig_log(rig: Rig, seed: int, seconds: float) -> pd.DataFrame:
    """Simulate the rig by events under its position controller: columns t, qm, vir of the machine `emps`."""
    rng = np.random.default_rng([seed, 21])
    M, Fv, _, offset = TRUTH.values()
    n, dt = round(seconds * RIG_RATE) + 1, 1 / RIG_RATE
    t = np.arange(n) * dt
    reference = _reference(t, rng)
    speed = np.gradient(reference, dt)
    x, v = float(reference[0]), 0.0
    position, force = np.empty(n), np.empty(n)
    position[0], force[0] = x, 0.0
    for k in range(1, n):
        wanted = 1.6e5 * (reference[k - 1] - x) + 6e3 * (speed[k - 1] - v)
        force[k] = min(max(wanted, -150.0), 150.0)
        for i in range(SUBSTEPS):
            u = force[k - 1] + (i + 0.5) / SUBSTEPS * (force[k] - force[k - 1])
            dry = rig.dry(v, t[k])
            x, v = advance(x, v, u - offset - rig.force(x, v), dt / SUBSTEPS, M, Fv, dry)
            rig.step(v, dry, dt / SUBSTEPS)
        position[k] = x
    measured = force + rig.noise_N * rng.standard_normal(n)
    log = pd.DataFrame({"t": t, "qm": position + rig.noise_m * rng.standard_normal(n), "vir": measured / GAIN})
    for edit in rig.edits:
        log = edit(log)
    return log


RigAttacking = Callable[[Rig, float, Draw], Key]


def sticks(rig: Rig, size: float, draw: Draw) -> Key:
    """Dry friction that truly sticks, nothing else. Source: Coulomb, Theorie des machines simples, 1785."""
    return Key(related=("friction_transition@carriage", "presliding@carriage", "stribeck_friction@carriage"))


def sticks_noisily(rig: Rig, size: float, draw: Draw) -> Key:
    """Friction sticks, and the position sensor is coarse. Source: see above."""
    rig.noise_m, rig.noise_N = 2e-5 * size, 1.0
    return Key(related=("friction_transition@carriage", "presliding@carriage", "stribeck_friction@carriage"))


def sticks_stribeck(rig: Rig, size: float, draw: Draw) -> Key:
    """Sticks with a breakaway force above the sliding one. Source: Armstrong-Helouvry et al., Automatica 30 (1994)."""
    speed = draw.uniform(0.005, 0.03)
    rig.dry = lambda v, t: TRUTH["Fc"] + 15 * size * math.exp(-abs(v) / speed)
    return Key((("stribeck_friction@carriage",),))


def rig_dwell(rig: Rig, size: float, draw: Draw) -> Key:
    """Breakaway grows with the time at rest. Source: Rabinowicz, Proc. Physical Society 71 (1958)."""
    rested, soon = [0.0], draw.uniform(0.02, 0.1)

    def step(v: float, F: float, dt: float) -> None:
        rested[0] = rested[0] + dt if v == 0.0 else rested[0] * (1 - dt / 0.02)

    rig.step, rig.dry = step, lambda v, t: TRUTH["Fc"] + 20 * size * (1 - math.exp(-rested[0] / soon))
    return Key(related=("stribeck_friction@carriage",))


def rig_memory(rig: Rig, size: float, draw: Draw) -> Key:
    """Friction follows a speed of a second ago. Source: Hess, Soom, J. Tribology 112 (1990), frictional lag."""
    seen, time = [0.0], draw.uniform(0.3, 1.5)

    def step(v: float, F: float, dt: float) -> None:
        seen[0] += dt / time * (abs(v) - seen[0])

    rig.step, rig.dry = step, lambda v, t: TRUTH["Fc"] + 15 * size * math.exp(-seen[0] / 0.03)
    return Key(related=("stribeck_friction@carriage",))


def rig_heat(rig: Rig, size: float, draw: Draw) -> Key:
    """Friction falls with the heat it makes, and recovers. Source: Bair, High Pressure Rheology, 2007."""
    heat, time = [0.0], draw.uniform(3, 10)

    def step(v: float, F: float, dt: float) -> None:
        heat[0] += dt / time * (F * abs(v) / 1.5 - heat[0])

    rig.step, rig.dry = step, lambda v, t: TRUTH["Fc"] * math.exp(-0.8 * size * heat[0])
    return Key(related=("friction_warm_up@carriage",))


def rig_cogging(rig: Rig, size: float, draw: Draw) -> Key:
    """A linear motor's cogging by position. Source: Otten et al., IEEE/ASME Trans. Mechatronics 2 (1997)."""
    pitch, phase = draw.uniform(0.016, 0.06), draw.uniform(0, 6)
    rig.force = lambda x, v: 8 * size * math.sin(2 * math.pi * x / pitch + phase)
    return Key()


def rig_cable(rig: Rig, size: float, draw: Draw) -> Key:
    """A cable chain: hysteresis of position. Source: Wen, J. Eng. Mech. 102 (1976)."""
    memory, width = [0.0], draw.uniform(0.005, 0.03)

    def step(v: float, F: float, dt: float) -> None:
        z = memory[0]
        memory[0] = z + dt * (v - 0.5 * abs(v) * z - 0.5 * v * abs(z)) / width

    rig.step, rig.force = step, lambda x, v: 12 * size * memory[0]
    return Key()


def rig_late_position(rig: Rig, size: float, draw: Draw) -> Key:
    """The position arrives up to 5 ms late; a delay of the force is its mirror. Source: CAN bus latency."""
    rig.edits.append(lambda log: log.assign(qm=np.interp(log.t - 0.005 * size, log.t, log.qm)))
    return Key(related=("channel_delay@carriage",))


def rig_gain(rig: Rig, size: float, draw: Draw) -> Key:
    """The drive's gain follows a slow temperature. Source: Gautier, Briot, J. Dyn. Syst. Meas. Control 136 (2014)."""
    period = draw.uniform(8, 20)
    rig.edits.append(lambda log: log.assign(vir=log.vir * (1 + 0.15 * size * np.sin(2 * np.pi * log.t / period))))
    return Key()


# ------------------------------------------------------------------------------------------------------- the list
UNLISTED: tuple[Attacking, ...] = (
    turn_slip,
    soil_gradient,
    pressure_leakage,
    friction_memory,
    dwell_stiction,
    fine_cogging,
    load_ripple,
    pin_damping,
    lever_arm,
    combined_slip,
    ply_steer,
    lateral_peak,
    side_bulldozing,
    heating_drag,
    slip_sinkage,
    split_soil,
    washboard,
    lane_hollow,
    strain_rate,
    engine_droop,
    tank_empties,
    belt_creep,
    gyro_lag,
    double_stribeck,
)
FILES: tuple[Attacking, ...] = (
    front_length,
    rear_length,
    roll_width,
    roll_radius,
    both_radii,
    wheel_radius,
    wheel_radii,
    track,
    both_tracks,
    roll_counts,
    wheel_counts,
    articulation_counts,
    clock_rate,
    clocks_apart,
    late_encoder,
    late_gyro,
    late_torques,
    noisy_torques,
    noisy_motion,
    noisy_encoder,
)
COMBINATIONS: tuple[Attacking, ...] = (
    strong_and_weak,
    two_frictions,
    two_soils,
    three_causes,
    cause_and_file,
    cause_and_unlisted,
)
POOR: tuple[Attacking, ...] = (
    short_log,
    little_steering,
    one_direction,
    long_standstill,
    crawling,
    short_clean,
    straight_clean,
    standing_clean,
)
RIGS: tuple[RigAttacking, ...] = (
    sticks,
    sticks_noisily,
    sticks_stribeck,
    rig_dwell,
    rig_memory,
    rig_heat,
    rig_cogging,
    rig_cable,
    rig_late_position,
    rig_gain,
)


def _surprising(name: str) -> Attacking:
    def act(t: Trial, size: float, draw: Draw) -> Key:
        t.kit = "full" if name == "mains_hum" else t.kit
        surprise(t.scene, name, size, t.seed)
        # A worn roll slips on its encoder: its radius in the machine file is wrong.
        return Key(tuple(("contact_radius@" + r,) for r in _worn(t.seed))) if name == "worn_roll" else Key()

    return act


def _worn(seed: int) -> tuple[str, ...]:
    """Return the roll that the surprise `worn_roll` draws from this seed."""
    return (str(np.random.default_rng([seed, 16]).choice(ROLLS)),)


ROLLER_ATTACKS: dict[str, tuple[str, Attacking]] = {
    **{f.__name__: ("unlisted", f) for f in UNLISTED},
    **{f.__name__: ("file", f) for f in FILES},
    **{f.__name__: ("combination", f) for f in COMBINATIONS},
    **{f.__name__: ("poor", f) for f in POOR},
    **{name: ("surprise", _surprising(name)) for name in SURPRISES},
}
RIG_ATTACKS: dict[str, RigAttacking] = {f.__name__: f for f in RIGS}
# Cases are drawn by a name, not by its place here: attacks may be added anywhere.
ATTACKS: dict[str, str] = {name: kind for name, (kind, _) in ROLLER_ATTACKS.items()} | dict.fromkeys(RIG_ATTACKS, "rig")


@dataclass(frozen=True)
class Attack:
    """A case of an attack: all that its log and its key follow from. size: up to 1 (strong)."""

    name: str
    kind: str
    number: int
    seed: int
    size: float
    manoeuvre: str
    kit: str
    seconds: float

    @property
    def label(self) -> str:
        return f"{self.name}-{self.number:03d}"

    @property
    def machine(self) -> str:
        return "emps" if self.kind == "rig" else "va12"


@dataclass(frozen=True)
class Attacked:
    """The log of an attack, its key, what is hidden in words, and for the roller the drive behind it."""

    log: pd.DataFrame
    key: Key
    hidden: tuple[str, ...]
    drive: Blind | None


def attack(name: str, number: int = 0, seconds: float | None = None) -> Attack:
    """Return the number-th case of an attack. Raises KeyError for an unknown name."""
    kind = ATTACKS[name]
    rng = np.random.default_rng([*name.encode(), number, 31])
    seed = int(rng.integers(1 << 31))
    size = float(math.exp(rng.uniform(math.log(WEAKEST[kind]), 0)))
    manoeuvre = str(rng.choice(list(plant.MANOEUVRES)))
    kit = str(rng.choice(["full", "paper"], p=[0.65, 0.35]))
    usual = RIG_SECONDS if kind == "rig" else SECONDS
    return Attack(name, kind, number, seed, size, manoeuvre, kit, usual if seconds is None else seconds)


def key_of(one: Attack) -> Key:
    """Return the key of a case without simulating it."""
    draw = np.random.default_rng([one.seed, 32])
    if one.kind == "rig":
        return RIG_ATTACKS[one.name](Rig(), one.size, draw)
    return ROLLER_ATTACKS[one.name][1](Trial(Scene(), one.seed, one.seconds), one.size, draw)


def simulate(one: Attack) -> Attacked:
    """Simulate the log of a case. Raises RuntimeError if the motion diverges."""
    draw = np.random.default_rng([one.seed, 32])
    if one.kind == "rig":
        rig = Rig()
        key = RIG_ATTACKS[one.name](rig, one.size, draw)
        return Attacked(rig_log(rig, one.seed, one.seconds), key, (one.name,), None)
    trial = Trial(Scene(), one.seed, one.seconds)
    key = ROLLER_ATTACKS[one.name][1](trial, one.size, draw)
    manoeuvre, kit = trial.manoeuvre or one.manoeuvre, trial.kit or one.kit
    system, machine = shifted(trial.scene.assemble(), trial.shift), plant.vary(one.seed)
    wanted = plant.plan(manoeuvre, trial.seconds, one.seed)
    for change in trial.plans:
        wanted = change(wanted)
    motion: Motion = plant.drive(system, machine, wanted, one.seed)
    log = plant.measure(system, machine, motion, kit, one.seed)
    case = Case(one.kind, one.number, one.seed, manoeuvre, trial.seconds, kit, ())
    drive = Blind(case, machine, system, motion, log)
    for edit in trial.edits:
        log = edit(log)
    hidden = tuple(trial.hidden) or (("nothing",) if key.nothing else (one.name,))
    return Attacked(log, key, hidden, drive)


def shifted(system: System, shift: Mapping[str, float]) -> System:
    """Return the system of a machine whose values differ from those it is given by `shift`."""
    if not shift:
        return system
    more = ca.DM([shift.get(f.name, 0.0) for f in fields(Machine)])

    def of(f: ca.Function, at: int) -> ca.Function:
        inputs = [ca.MX.sym(f"i{k}", f.sparsity_in(k)) for k in range(f.n_in())]
        moved = [x + more if k == at else x for k, x in enumerate(inputs)]
        return ca.Function(f.name(), inputs, f.call(moved))

    return replace(
        system,
        rate=of(system.rate, 3),
        fine=of(system.fine, 4),
        coarse=of(system.coarse, 4),
        read=of(system.read, 3),
        slip=of(system.slip, 1),
    )
