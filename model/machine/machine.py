"""The machine file (TOML) as frozen, checked records.

A machine is a tree of bodies given by its modified Denavit-Hartenberg table (Khalil and Kleinfinger, 1986), with
inertias, joint friction, contacts with the ground, sensors, limits and design problems. Every number names its source.
All values are SI.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from excite.errors import MachineError
from excite.model.machine import extends, hydraulics, noise, units
from excite.model.machine.force_loop import ForceLoop
from excite.model.machine.records import (
    BodyPoint,
    FileRecord,
    Flag,
    Negative,
    NotNegative,
    Number,
    Positive,
    Quantity,
    Source,
    Vector3,
    error_line,
)
from excite.model.machine.surroundings import Shape, Tool, World
from excite.text import closest, did_you_mean

MACHINES = Path(__file__).parents[1] / "machines"
# Kinds of sensor whose place matters, by key of that place.
SENSOR_PLACE_KEYS = {
    "radius": ("wheel",),
    "lateral": ("wheel", "forward_speed", "ground_speed", "x", "y"),
    "ahead": ("lateral_speed", "ground_speed", "x", "y"),
}
Index = Annotated[int, Field(strict=True, ge=0, le=99)]

# Checks of a log that a sensor can be left out of (`checks_off`), with what each looks for.
TimeUnit = Literal["s", "ms", "us", "ns", "min", "day"]
TIME_UNITS = get_args(TimeUnit)
LOG_CHECKS = {
    "jumps": "a position that goes further in one row than the joint can: an encoder that was reset, counts that wrap",
    "limits": "readings that the machine's limits rule out: degrees for radians, kN m for N m",
    "speed": "a speed in the place of an angle",
    "spikes": "single readings far from their neighbours, which are repaired",
    "dropouts": "readings that stand still while the machine moves",
    "held": "readings that change in every n-th row only",
    "slow": "readings that are too far apart for the filter's cutoff",
    "constant": "a channel that never changes",
    "range": "readings that stand at the end of their range",
    "counts": "steps that are not whole counts",
    "sign": "an angle or torque with the wrong sign",
    "swapped": "left and right, or front and rear, in each other's place",
    "units": "a unit in the file that is not the machine file's",
}


Size = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _zero() -> Quantity:
    """Return the default of an optional entry."""
    return Quantity(value=0.0, source="definition")


class Inertia(FileRecord):
    """Mass [kg], centre of mass [m] in the body's frame and inertia [kg m2] about the centre of mass.

    A mass of 0, as of a link that a URDF gives none, needs a `note` that says why.
    `axisymmetric`: a roll or wheel, balanced about its joint axis z with its centre of mass at the frame's origin;
    its standard parameters are then M, XX (= YY) and ZZ only.
    """

    mass: Quantity
    com: BodyPoint = BodyPoint(value=(0.0, 0.0, 0.0), source="definition")
    XX: NotNegative = Field(default_factory=_zero)
    XY: Quantity = Field(default_factory=_zero)
    XZ: Quantity = Field(default_factory=_zero)
    YY: NotNegative = Field(default_factory=_zero)
    YZ: Quantity = Field(default_factory=_zero)
    ZZ: NotNegative = Field(default_factory=_zero)
    axisymmetric: Flag = False

    @model_validator(mode="after")
    def _consistent(self) -> Inertia:
        if self.mass.value < 0 or (not self.mass.value and not self.mass.note):
            hint = "" if self.mass.value else "; a body without mass needs a note that says why"
            raise ValueError(f"mass: must be > 0 (got {self.mass.value:g}){hint}")
        if self.axisymmetric:
            if any(self.com.value):
                raise ValueError("com: of an axisymmetric body is at its frame's origin, leave it out")
            for key in ("XY", "XZ", "YZ"):
                if getattr(self, key).value:
                    raise ValueError(f"{key}: of an axisymmetric body is 0, leave it out")
            if self.YY.value not in (0.0, self.XX.value):
                raise ValueError("YY: of an axisymmetric body equals XX, leave it out")
        return self


class Friction(FileRecord):
    """Joint friction U = ... + Fv q' + Fs tanh(q'/smoothing), and the torque sensor's offset u0 (28).

    Simulation can take sgn(q'), set-valued at rest, in place of the tanh.
    Units of a revolute joint [N m s], [N m], [N m], smoothing [rad/s]; of a prismatic one [N s/m], [N], [N], [m/s].
    """

    Fv: NotNegative
    Fs: NotNegative
    u0: Quantity
    smoothing: Positive


def _one() -> Quantity:
    """Return the default of a ratio."""
    return Quantity(value=1.0, source="definition")


class Coupling(FileRecord):
    """A joint that another one takes along. `ratio`: angle (`moves_with`) or torque (`driven_with`) per that of it.

    offset [rad, m]: angle where that of the other one is 0 (`moves_with`), as of a URDF's <mimic>.
    """

    joint: Index
    ratio: Quantity = Field(default_factory=_one)
    offset: Quantity = Field(default_factory=_zero)

    @model_validator(mode="after")
    def _consistent(self) -> Coupling:
        if self.ratio.value == 0:
            raise ValueError("ratio: must not be 0")
        return self


class Drive(FileRecord):
    """Inertia of a joint's geared rotor as seen at the joint: (gear ratio)^2 x that of the rotor [kg m2, kg].

    It adds rotor_inertia q" to the joint's own equation; what the spinning rotor does to other joints is left out.

    turns_with: the rotor turns by the angle of its own joint plus a ratio times that of another one, as where a wrist's
    last motor sits before the joint that carries it. Its torque and inertia then act on both joints.
    """

    rotor_inertia: Positive
    turns_with: Coupling | None = None


class Spring(FileRecord):
    """A spring at a joint, such as a gravity balancer: torque -stiffness (q - rest) - damping q' on the body.

    stiffness [N m/rad, N/m], damping [N m s, N s/m]; rest [rad, m]: where it exerts nothing.

    joint: the spring's other end sits on that joint, q is then the difference of both coordinates, and the spring pulls
    at both: a flexible gear between a motor and its link, both with the coordinate that a stiff gear would have.
    Source: Spong, "Modeling and control of elastic joint robots", Journal of Dynamic Systems 109 (1987).
    """

    stiffness: Positive
    rest: Quantity = Field(default_factory=_zero)
    damping: NotNegative | None = None
    joint: Index | None = None


class Contact(FileRecord):
    """A roll or wheel on the soil (11, 17, 24, 25). Frame: the chassis that carries it, at its own centre.

    `law = "exponential"` is (18) integrated over the patch; it needs `saturation_slip` = K / xi_s, the slip at which
    the shear displacement reaches K at the rear of the patch.
    """

    radius: Positive
    width: NotNegative
    Kx: Negative
    Ky: Negative
    v_eps: Positive
    law: Literal["linear", "exponential"] = "linear"
    saturation_slip: Positive | None = None
    slip_limit: Positive | None = None

    @model_validator(mode="after")
    def _law(self) -> Contact:
        if self.law == "exponential" and self.saturation_slip is None:
            raise ValueError('saturation_slip: law "exponential" needs it (K / xi_s)')
        return self


class JointLimit(FileRecord):
    """Limits of a joint's drive. `rim_speed` is |radius x rate| of a contact [m/s].

    `position`: largest angle or stroke either way; `position_low` and `position_high` where the two differ;
    `position_margin`: what a drive keeps free of either end. `acceleration`, `jerk`: of a motion that is planned.
    """

    torque: Positive | None = None
    torque_rate: Positive | None = None
    position: Positive | None = None
    position_low: Quantity | None = None
    position_high: Quantity | None = None
    position_margin: NotNegative | None = None
    rate: Positive | None = None
    acceleration: Positive | None = None
    jerk: Positive | None = None
    rim_speed: Positive | None = None

    @property
    def position_range(self) -> tuple[float, float] | None:
        """Lowest and highest position [rad, m], None without a limit."""
        if self.position_low is not None and self.position_high is not None:
            return float(self.position_low), float(self.position_high)
        return None if self.position is None else (-float(self.position), float(self.position))

    @property
    def drive_range(self) -> tuple[float, float] | None:
        """Lowest and highest position [rad, m] of a drive, with `position_margin` free; None without a limit."""
        ends, margin = self.position_range, float(self.position_margin or 0.0)
        return None if ends is None else (ends[0] + margin, ends[1] - margin)

    @property
    def reach(self) -> float | None:
        """Largest distance from zero [rad, m], None without a limit."""
        return None if self.position_range is None else max(map(abs, self.position_range))

    @model_validator(mode="after")
    def _consistent(self) -> JointLimit:
        low, high = self.position_low, self.position_high
        if (low is None) != (high is None):
            raise ValueError(f"position_{'low' if low is None else 'high'}: is missing, give both ends of the range")
        if low is not None and high is not None:
            if self.position is not None:
                raise ValueError("position: is the same both ways; leave it out beside position_low, position_high")
            if float(low) >= float(high):
                raise ValueError(f"position_low: must be below position_high (got {float(low):g}, {float(high):g})")
        ends = self.drive_range
        if self.position_margin is not None and (ends is None or ends[0] >= ends[1]):
            raise ValueError("position_margin: needs a range of positions that is wider than it on both sides")
        return self


def _antecedent(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    """Check an antecedent. Raises ValueError that says what is allowed."""
    try:
        return handler(value)
    except ValidationError:
        raise ValueError(f'must be "ground" or the index of a body above (got {value!r})') from None


class Body(FileRecord):
    """One row of the modified Denavit-Hartenberg table, with inertia, friction, contact and limits.

    Transform from the antecedent: Rot(z, gamma) Trans(z, b) Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r);
    the joint's coordinate replaces theta (revolute) or r (prismatic).

    moves_with: this joint's angle is that of another one times a ratio (chained wheels, joints on one lever); it has
    no coordinate of its own. driven_with: its torque is the other's times a ratio while its speed is free (two motors
    on one pump, an open differential).
    """

    index: Index
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    antecedent: Annotated[Index | Literal["ground"], WrapValidator(_antecedent)]
    joint: Literal["planar", "revolute", "prismatic", "fixed"]
    actuated: Flag = False
    moves_with: Coupling | None = None
    driven_with: Coupling | None = None
    place: Annotated[str | None, Field(pattern=r"^[a-z][a-z0-9_]*$")] = None
    gamma: Quantity = Field(default_factory=_zero)
    b: Quantity = Field(default_factory=_zero)
    alpha: Quantity = Field(default_factory=_zero)
    d: Quantity = Field(default_factory=_zero)
    theta: Quantity = Field(default_factory=_zero)
    r: Quantity = Field(default_factory=_zero)
    inertia: Inertia | None = None
    friction: Friction | None = None
    drive: Drive | None = None
    spring: Spring | None = None
    contact: Contact | None = None
    shape: tuple[Shape, ...] = ()
    limit: JointLimit = JointLimit()

    @property
    def where(self) -> str:
        """Name of the joint or contact in effects and reports."""
        return self.place or self.name

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the joint's coordinates."""
        i = self.index
        return {
            "planar": (f"x{i}", f"y{i}", f"theta{i}"),
            "revolute": (f"theta{i}",),
            "prismatic": (f"q{i}",),
            "fixed": (),
        }[self.joint]

    @model_validator(mode="after")
    def _consistent(self) -> Body:
        replaced = {"planar": ("gamma", "b", "alpha", "d", "theta", "r"), "revolute": ("theta",), "prismatic": ("r",)}
        for key in replaced.get(self.joint, ()):
            if getattr(self, key).value:
                raise ValueError(f"{key}: a {self.joint} joint's coordinate takes its place, leave it out")
        if self.joint in ("fixed", "planar"):
            for key in ("actuated", "friction", "drive", "spring", "moves_with", "driven_with"):
                if getattr(self, key):
                    raise ValueError(
                        f"{key}: a {self.joint} joint can't be actuated or have friction, drive, spring or a coupling"
                    )
        for key in ("moves_with", "driven_with"):
            if self.actuated and getattr(self, key):
                raise ValueError(f"{key}: the drive is that of the other joint, leave out actuated here")
        if self.actuated and self.friction is None:
            raise ValueError("friction: an actuated joint needs a [body.friction] table (Fv, Fs, u0, smoothing)")
        if self.joint == "planar" and self.antecedent != "ground":
            raise ValueError(f'antecedent: a planar joint must stand on "ground" (got {self.antecedent})')
        if self.contact and self.joint != "revolute":
            raise ValueError(f"contact: belongs to a roll or wheel, a revolute joint (got {self.joint})")
        return self


def _sought_or_value(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    """Check a quantity that may be sought. Raises ValueError that says what is allowed."""
    if isinstance(value, (dict, Quantity)):
        return Quantity.model_validate(value)
    try:
        return handler(value)
    except ValidationError:
        raise ValueError(f'must be "sought" or a table {{ value = ..., source = "..." }} (got {value!r})') from None


class Sensor(FileRecord):
    """One column of a log, in `unit` (see `units`). SI value = `gain` x (number in the column).

    `factor`: SI value of the number 1 in the column, in place of the unit's; needed for units without one, such as V.
    `zero`: SI reading of an encoder where the joint's coordinate is 0; it is subtracted. "sought", or a value that is
    `known` with a standard deviation: what is missing to it is a parameter (`Machine.sought_zeros`).

    kind `angle`: encoder of a joint; `wheel`: measuring wheel of `radius` [m] at `lateral` [m] (+ left) on the axis
    through the body's origin (32); `torque`: delivered torque or force + u0; `yaw_rate`: of the body; `forward_speed`,
    `lateral_speed`: along and across it, such as a fifth wheel's; `ground_speed`: speed over ground without direction,
    `x`, `y`: position on the ground, such as those of GNSS. All but angles and torques sit on the first chassis, at
    `ahead` and `lateral` [m] of its origin (a fifth wheel, an antenna).

    Every sensor is in kit `full`.

    noise: standard deviation of a sample in the unit of the column (bar, rpm, deg, A), of two pressures that of their
    difference; `noise_unit` names another one, "SI" that of what the sensor measures (see `noise_of`).

    sign_bit: bit of a register that holds its sign, the bits below hold the magnitude.

    A torque may be given as two pressures, in `column` and `return_column`: those of a hydraulic motor with its
    `displacement` [m3 per turn of the joint, gear included], u = displacement / (2 pi) (p - p_return), or those of
    `cylinders` (see `hydraulics`). `factor` is then the pressure of the number 1 [Pa], 4e6 for 0-10 V over 0-400 bar.

    gear_ratio: turns of the motor per turn of the joint, of an encoder (`counts_per_turn` of the motor) or a current.

    A torque may be given as the current of its motor: u = `torque_constant` [N m/A at the motor] x `gear_ratio` x
    current. Without the constant all torques must be such currents, or all voltages or duty cycles, of motors of one
    kind; results are then divided by that constant (`Machine.in_ratios`), and what the file calls known gives it.

    A motor driven by a voltage has a `resistance` [ohm] beside its `torque_constant`: u = torque_constant x gear_ratio
    x voltage / resistance, and its back-EMF is a damping (`back_emf_damping`).

    `loop`: the column holds the torque, force or current that the drive was commanded, and this loop delivers it.

    `step`: smallest step of a reading [SI]. `rate_hz`: readings per second, if it has fewer than the log has rows.

    `zero_if_absent`: a log without this torque's column is one with the drive off: a free decay, a coast-down.

    `wraps_at`: reading, in the column's unit, after which an encoder begins anew, such as 360 for degrees; it is then
    counted on. `checks_off`: names of LOG_CHECKS that this sensor is left out of.

    `time_column`, `time_unit`: of a sensor that a logger with a clock of its own recorded; `time_offset` [s] is added
    to its times.

    `time_tolerance` [s], `gain_tolerance` (a share): standard deviations to which its times and its gain are known.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    kind: Literal["angle", "wheel", "torque", "yaw_rate", "lateral_speed", "forward_speed", "ground_speed", "x", "y"]
    body: Index
    column: Annotated[str, Field(min_length=1)]
    unit: str
    factor: Quantity | None = None
    return_column: Annotated[str | None, Field(min_length=1)] = None
    displacement: Positive | None = None
    torque_constant: Quantity | None = None
    resistance: Positive | None = None
    gear_ratio: Quantity | None = None
    loop: ForceLoop | None = None
    zero: Annotated[Quantity | Literal["sought"] | None, WrapValidator(_sought_or_value)] = None
    cylinders: tuple[hydraulics.Cylinder, ...] = ()
    kits: tuple[Literal["paper", "full"], ...] = ("paper", "full")
    place: Annotated[str | None, Field(pattern=r"^[a-z][a-z0-9_]*$")] = None
    counts_per_turn: Positive | None = None
    noise: NotNegative | None = None
    noise_unit: str | None = None
    sign_bit: Annotated[int | None, Field(strict=True, ge=1, le=62)] = None
    step: Positive | None = None
    rate_hz: Positive | None = None
    ahead: Quantity | None = None
    lateral: Quantity | None = None
    radius: Positive | None = None
    wraps_at: Annotated[float | None, Field(gt=0, allow_inf_nan=False)] = None
    zero_if_absent: Flag = False
    checks_off: tuple[str, ...] = ()
    time_column: Annotated[str | None, Field(min_length=1)] = None
    time_unit: TimeUnit | None = None
    time_offset: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    time_tolerance: Size | None = None
    gain_tolerance: Size | None = None

    @property
    def resolution(self) -> float | None:
        """One count [SI unit of the coordinate], None for an analogue sensor."""
        if self.counts_per_turn is None:
            return None
        return 2 * math.pi / (self.counts_per_turn.value * abs(float(self.gear_ratio or 1.0)))

    @property
    def has_noise_figure(self) -> bool:
        """True if the file gives its noise or its counts per turn."""
        return self.noise is not None or self.counts_per_turn is not None

    @property
    def gain(self) -> float:
        """SI value of the number 1 in the column: torque [N m] for a motor's pressure, [Pa] for a cylinder's."""
        one = float(self.factor) if self.factor is not None else units.UNITS[self.unit][1]
        if self.displacement is not None:
            one *= float(self.displacement) / (2 * math.pi)
        gear = float(self.gear_ratio or 1.0)
        per_volt = 1.0 / float(self.resistance or 1.0)
        return one / gear if self.kind == "angle" else one * float(self.torque_constant or 1.0) * gear * per_volt

    @property
    def shift(self) -> float:
        """SI reading where the coordinate is 0: coordinate = gain x number - shift."""
        return float(self.zero) if isinstance(self.zero, Quantity) else 0.0

    @property
    def zero_is_sought(self) -> bool:
        """True if its zero is a parameter to be estimated."""
        return self.zero == "sought" or (isinstance(self.zero, Quantity) and not isinstance(self.zero.known, bool))

    @property
    def driven_by(self) -> str | None:
        """SI unit of the current, voltage or duty cycle that the column holds, None for a torque."""
        motor = self.kind == "torque" and self.factor is None and self.return_column is None
        return units.DRIVEN_BY.get(units.UNITS.get(self.unit, ("",))[0]) if motor else None

    @property
    def is_bare(self) -> bool:
        """True if the column holds a current, voltage or duty cycle without what makes it a torque."""
        return self.driven_by is not None and self.torque_constant is None

    @property
    def back_emf_damping(self) -> float:
        """Damping of the joint [N m s] by the voltage that its turning motor makes, 0 unless a voltage drives it."""
        if self.resistance is None:
            return 0.0
        constant = float(self.torque_constant or 0.0) * float(self.gear_ratio or 1.0)
        return constant**2 / float(self.resistance)

    @property
    def is_rate(self) -> bool:
        """True if the column holds the rate of the sensor's angle."""
        known = units.UNITS.get(self.unit, ("", 1.0))[0]
        return self.kind in ("angle", "wheel") and known in units.RATES

    @property
    def mounted_at(self) -> tuple[float, float]:
        """Distance [m] ahead of and to the left of the body's origin."""
        return float(self.ahead or 0.0), float(self.lateral or 0.0)

    @property
    def least_noise(self) -> float:
        """Standard deviation [SI] that its smallest step alone gives a reading, 0 without one."""
        return 0.0 if self.step is None else float(self.step) / math.sqrt(12)

    @property
    def columns(self) -> tuple[str, ...]:
        """Its columns in a log."""
        return (self.column,) if self.return_column is None else (self.column, self.return_column)

    @model_validator(mode="after")
    def _consistent(self) -> Sensor:
        pressed = self.displacement is not None or bool(self.cylinders)
        if pressed != (self.return_column is not None):
            key = "return_column" if pressed else "displacement"
            raise ValueError(f"{key}: two pressures need column, return_column and displacement (or cylinders)")
        if self.displacement is not None and self.cylinders:
            raise ValueError("cylinders: a joint is turned by a motor of some displacement or by cylinders, not both")
        if pressed and self.kind != "torque":
            key = "cylinders" if self.cylinders else "displacement"
            raise ValueError(f"{key}: makes a torque of pressures, not kind {self.kind}")
        measured = ("pressure",) if pressed else units.QUANTITIES_BY_KIND[self.kind]
        quantity = units.UNITS.get(self.unit, ("",))[0]
        if self.factor is None and self.kind == "torque" and not pressed and quantity == "pressure":
            raise ValueError(
                f"unit: {self.unit!r} is a pressure: a torque of pressures needs return_column, the column of the other"
                " side, and displacement [m3 per turn of the joint], or cylinders"
            )
        if self.factor is None and quantity not in measured:
            raise ValueError(
                f"unit: {self.unit!r} is no {' or '.join(measured)}, allowed for kind {self.kind}:"
                f" {units.units_of(measured)}, or any with its factor (the SI value of one)"
                f"{did_you_mean(self.unit, (u for u, (q, _) in units.UNITS.items() if q in measured))}"
            )
        for key in ("torque_constant", "gear_ratio"):
            given = getattr(self, key)
            if given is not None and self.driven_by is None and (self.kind, key) != ("angle", "gear_ratio"):
                also = ", or an angle of that of a motor" if key == "gear_ratio" else ""
                raise ValueError(
                    f"{key}: makes a torque of a current, voltage or duty cycle, unit A, mA, V, mV or % without"
                    f" factor{also}"
                )
            if given is not None and given.value == 0:
                raise ValueError(f"{key}: must not be 0")
        needs_resistance = self.driven_by in ("V", "1") and self.torque_constant is not None
        if needs_resistance and (self.resistance is None or self.driven_by == "1"):
            raise ValueError(
                "torque_constant: of a motor driven by a voltage needs its resistance [ohm], and the column's unit V;"
                " leave it out for values divided by the unknown torque per volt or duty cycle"
            )
        if self.resistance is not None and not needs_resistance:
            raise ValueError("resistance: is for a motor driven by a voltage, unit V or mV, with its torque_constant")
        if self.loop is not None and (self.kind != "torque" or pressed):
            raise ValueError("loop: is for a commanded torque, force or current, kind torque without pressures")
        if self.loop is not None and self.noise is None:
            raise ValueError(
                f"noise: is missing beside loop: by how much [{self.unit}] the delivered torque or force differs"
                " from the loop's response, which no log of commands shows"
            )
        if self.zero is not None and (self.kind != "angle" or self.is_rate):
            raise ValueError("zero: is for the position of a joint, kind angle without a rate's unit")
        if self.is_rate and self.counts_per_turn is not None:
            raise ValueError("counts_per_turn: is for a column that counts, not for a rate; give its noise instead")
        if self.kind == "wheel" and (self.radius is None or self.lateral is None):
            raise ValueError(f"{'lateral' if self.radius else 'radius'}: a measuring wheel needs radius and lateral")
        for key, kinds in SENSOR_PLACE_KEYS.items():
            if getattr(self, key) is not None and self.kind not in kinds:
                raise ValueError(f"{key}: is for kind {', '.join(kinds)} only")
        if self.zero_if_absent and self.kind != "torque":
            raise ValueError("zero_if_absent: is for kind torque only")
        if self.step is not None and self.counts_per_turn is not None:
            raise ValueError("step: is for a column that does not count turns; leave it or counts_per_turn out")
        if self.factor is not None and self.factor.value == 0:
            raise ValueError("factor: must not be 0")
        if self.wraps_at is not None and (self.kind not in ("angle", "wheel") or self.is_rate):
            raise ValueError("wraps_at: is for a position that is counted, an angle or a measuring wheel")
        for name in self.checks_off:
            if name not in LOG_CHECKS:
                hint = did_you_mean(name, LOG_CHECKS)
                raise ValueError(f"checks_off: {name!r} is unknown, allowed: {', '.join(LOG_CHECKS)}{hint}")
        if line := noise.wrong_noise_unit(self):
            raise ValueError(line)
        if self.noise is not None and self.noise.value == 0 and self.counts_per_turn is None:
            raise ValueError("noise: must be > 0 (got 0); leave it out if it is unknown")
        if "full" not in self.kits:
            raise ValueError(f'kits: "full" has every sensor, add it (got {", ".join(self.kits) or "none"})')
        return self


class Filter(FileRecord):
    """Default processing of a log before least squares.

    Positions pass a zero-phase Butterworth filter, `drop` samples are removed at the start and at the end, and one row
    in `decimation` is kept. `source` is that of the whole numbers.
    """

    source: Source
    cutoff_hz: Positive
    order: Annotated[int, Field(strict=True, ge=1, le=8)] = 4
    decimation: Annotated[int, Field(strict=True, ge=1, le=1000)] = 10
    drop: tuple[Annotated[int, Field(strict=True, ge=0)], Annotated[int, Field(strict=True, ge=0)]] = (0, 0)


class Problem(FileRecord):
    """A design problem: duration, lane and distance of knots. `source` is that of the lane.

    lane_m: length and width of the lane area, centred on 0, 0; lane_polygon_m: corners of a convex area, a second limit
    of the `lane_points`. All three are for machines on the plane. reversals: most reversals of the direction of travel.
    rest: start and end at rest. periodic: end as it starts, also in speed, acceleration and jerk, so that the drive can
    be repeated without a stop; rest is then left out. start_pose, end_pose: positions of joints there, by coordinate;
    those that are not given start at zero, or in the middle of a range with zero outside or at an end, and end where
    they start. An arm's joints without either start where the search finds best.
    """

    source: Source
    duration_s: Positive
    knot_s: Positive
    lane_m: tuple[Number, Number] | None = None
    lane_points: tuple[Index, ...] = ()
    lane_polygon_m: tuple[tuple[Number, Number], ...] = ()
    reversals: Annotated[int, Field(strict=True, ge=0)] | None = None
    rest: Flag = True
    periodic: Flag = False
    start_pose: dict[str, Number] = Field(default={})
    end_pose: dict[str, Number] = Field(default={})

    @property
    def lane(self) -> tuple[float, float]:
        """Length and width of the lane [m], infinite without one."""
        return self.lane_m or (math.inf, math.inf)

    @model_validator(mode="after")
    def _consistent(self) -> Problem:
        if self.lane_m is not None and min(self.lane_m) <= 0:
            raise ValueError(f"lane_m: must be > 0, length and width (got {min(self.lane_m):g})")
        if self.lane_polygon_m and not _convex(self.lane_polygon_m):
            raise ValueError("lane_polygon_m: must be three corners or more, in order, of a convex area")
        if self.periodic and (self.rest or self.end_pose):
            raise ValueError(
                f"{'rest' if self.rest else 'end_pose'}: a periodic drive has no ends: rest = false, no end_pose"
            )
        if self.knot_s.value * 4 > self.duration_s.value:
            least = 4 * self.knot_s.value
            raise ValueError(f"duration_s: must be at least 4 knots long, {least:g} s (got {self.duration_s.value:g})")
        return self

    def lasting(self, seconds: float) -> Problem:
        """Return this problem with another duration [s], rounded to whole knots, four at least."""
        knot = float(self.knot_s)
        duration = self.duration_s.model_copy(update={"value": max(4, round(seconds / knot)) * knot})
        return self.model_copy(update={"duration_s": duration})


class EffectEntry(FileRecord):
    """An effect of the machine beyond the plain model: name in the catalogue, place, magnitude and shapes."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    where: Annotated[str | None, Field(pattern=r"^[a-z][a-z0-9_]*$")] = None
    amount: Quantity
    std: NotNegative | None = None
    shape: dict[str, Quantity] = Field({})

    @property
    def label(self) -> str:
        """Name with place: effect@place."""
        return f"{self.name}@{self.where}"


def _convex(corners: Sequence[tuple[float, float]]) -> bool:
    """True if corners, in order, go once around a convex area."""
    n = len(corners)
    turn, turns = 0.0, []
    for k in range(n):
        (ax, ay), (bx, by), (cx, cy) = (corners[(k + i) % n] for i in range(3))
        cross = (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
        turns.append(cross)
        turn += math.atan2(cross, (bx - ax) * (cx - bx) + (by - ay) * (cy - by))
    one_way = all(t > 0 for t in turns) or all(t < 0 for t in turns)
    return n >= 3 and one_way and abs(abs(turn) - 2 * math.pi) < 1e-6


class Tolerances(FileRecord):
    """Standard deviations of what a machine file takes as exact, where the quantity has no `tolerance` of its own.

    alignment [s]: of a torque channel with the motion, half a sampling period if not given. length [m]: of measured
    lengths and positions. radius, gain: shares of the value. level [rad]: of the ground, a base or a speed sensor.
    """

    alignment: Size | None = None
    length: Size = 0.003
    radius: Size = 0.002
    gain: Size = 0.01
    level: Size = 0.002


class Machine(FileRecord):
    """A machine file. `locked` coordinates are held at zero.

    known: base parameters known beforehand, such as the whole machine's mass from a weighbridge. noise_unit: "SI" in
    files whose noise is in SI units, whatever the columns are in. blank_means: "unchanged" of a logger that writes a
    cell only where its value changes. enabled_column: rows in which it is 0, false or blank are left out. stamps:
    "arrival" of rows that were sampled evenly and stamped when they arrived.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")]
    title: str
    reference: str = ""
    sampling_hz: Positive
    time_column: str = "t_s"
    time_unit: TimeUnit = "s"
    noise_unit: Literal["column", "SI"] = "column"
    blank_means: Literal["missing", "unchanged"] = "missing"
    enabled_column: Annotated[str | None, Field(min_length=1)] = None
    stamps: Literal["sampling", "arrival"] = "sampling"
    gravity: Vector3 = (0.0, 0.0, -9.81)
    power_limit: Positive | None = None
    locked: tuple[str, ...] = ()
    body: Annotated[tuple[Body, ...], Field(min_length=1)]
    sensor: tuple[Sensor, ...]
    filter: Filter
    problem: str | None = None
    problems: dict[str, Problem] = Field({})
    parameter_names: dict[str, str] = Field({})
    scale: dict[str, Positive] = Field({})
    known: dict[str, Quantity] = Field({})
    tolerance: Tolerances = Field(default_factory=lambda: Tolerances())
    effect: tuple[EffectEntry, ...] = ()
    world: World = World()
    tool: Tool | None = None

    def find(self, index: int) -> Body:
        """Return the body with this index. Raises KeyError."""
        for body in self.body:
            if body.index == index:
                return body
        raise KeyError(index)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the free coordinates, in the order of the table."""
        return tuple(c for b in self.body if b.moves_with is None for c in b.coordinates if c not in self.locked)

    @property
    def planar(self) -> bool:
        """True if the root moves on the plane; velocities are then in the chassis' own axes."""
        return self.body[0].joint == "planar"

    @property
    def actuated(self) -> tuple[Body, ...]:
        """Actuated bodies whose coordinate is free, one per drive.

        Their limits of torque are the lowest ones that also keep those of the joints driven with them.
        """
        return tuple(self._with_shared_limits(b) for b in self.body if b.actuated and self.is_free(b))

    def _with_shared_limits(self, body: Body) -> Body:
        """Return a body with limits of torque that also keep those of the joints driven with it."""
        shared = [
            (b.limit, abs(b.driven_with.ratio.value)) for b in self.body if b.driven_with and b in self.drives(body)
        ]
        lowest = {}
        for key in ("torque", "torque_rate"):
            own: Quantity | None = getattr(body.limit, key)
            others = [
                q.model_copy(update={"value": q.value / ratio}) for limit, ratio in shared if (q := getattr(limit, key))
            ]
            lowest[key] = min([*([own] if own else []), *others], key=float, default=None)
        return body.model_copy(update={"limit": body.limit.model_copy(update=lowest)}) if shared else body

    def drives(self, body: Body) -> tuple[Body, ...]:
        """Return the bodies that the drive of an actuated one turns: itself, then those driven with it."""
        return (body, *(b for b in self.body if b.driven_with and b.driven_with.joint == body.index))

    def joint_values(self, body: Body, x: Any) -> Any:
        """Return a joint's rate from velocities x (n_q, ...), or its angle from coordinates without an offset."""
        return self.ratio(body) * x[self.coordinates.index(self.coordinate(body))]

    def joint_positions(self, body: Body, q: Any) -> Any:
        """Return a joint's angle from coordinates q (n_q, ...)."""
        return self.joint_values(body, q) + self.offset(body)

    def turned_with(self, body: Body) -> tuple[Body, float] | None:
        """Return the joint that turns a joint's rotor as well, and by which ratio; None without a free one."""
        coupling = None if body.drive is None else body.drive.turns_with
        if coupling is None or not self.is_free(self.find(coupling.joint)):
            return None
        return self.find(coupling.joint), float(coupling.ratio)

    @property
    def input_matrix(self) -> np.ndarray:
        """Matrix B (n_q, n_u): torques on the coordinates per torque of each drive, S^T of those on the joints."""
        B = np.zeros((len(self.coordinates), len(self.actuated)))
        for k, driven in enumerate(self.actuated):
            if also := self.turned_with(driven):
                B[self.coordinates.index(self.coordinate(also[0])), k] += also[1] * self.ratio(also[0])
            for b in self.drives(driven):
                if self.is_free(b):
                    share = 1.0 if b.driven_with is None else float(b.driven_with.ratio)
                    B[self.coordinates.index(self.coordinate(b)), k] += share * self.ratio(b)
        return B

    @property
    def row_matrix(self) -> np.ndarray:
        """Matrix T (n_q, n_q) of the equations: T B has each drive's torque in the row of its own joint alone."""
        T, B = np.eye(len(self.coordinates)), self.input_matrix
        for k, driven in enumerate(self.actuated):
            row = self.coordinates.index(self.coordinate(driven))
            T[:, row] -= B[:, k]
            T[row, row] = 1.0
        return T

    def is_free(self, body: Body) -> bool:
        """True if a free coordinate moves this body's joint."""
        return bool(body.coordinates) and self.coordinate(body) not in self.locked

    def coordinate(self, body: Body) -> str:
        """Return the coordinate that a joint moves by: its own, or that of the joint that it moves with."""
        return body.coordinates[0] if body.moves_with is None else self.find(body.moves_with.joint).coordinates[0]

    def ratio(self, body: Body) -> float:
        """Return a joint's angle per that of its `coordinate`."""
        return 1.0 if body.moves_with is None else float(body.moves_with.ratio)

    def offset(self, body: Body) -> float:
        """Return a joint's angle [rad, m] where its `coordinate` is 0."""
        return 0.0 if body.moves_with is None else float(body.moves_with.offset)

    @property
    def sought_zeros(self) -> dict[str, Sensor]:
        """Encoders of free joints whose zero is sought, by name of the parameter: q10 of joint 1."""
        return {f"q{s.body}0": s for s in self.sensor if s.zero_is_sought and self.is_free(self.find(s.body))}

    @property
    def joined_by_springs(self) -> tuple[tuple[Body, Body], ...]:
        """Bodies with a spring to another joint, each with the body of that joint."""
        springs = [(b, b.spring.joint) for b in self.body if b.spring is not None]
        return tuple((b, self.find(joint)) for b, joint in springs if joint is not None)

    @property
    def rubbing(self) -> tuple[Body, ...]:
        """Bodies with dry friction whose coordinate is free; a joint that moves with another sticks with it."""
        return tuple(b for b in self.body if b.friction is not None and b.moves_with is None and self.is_free(b))

    @property
    def in_ratios(self) -> bool:
        """True if torques are known up to the motors' torque constant only; values then are divided by it."""
        return any(s.is_bare for s in self.sensor)

    @property
    def torque_unit(self) -> str | None:
        """SI unit that torques are known in instead of N m or N, None if they are known in these."""
        return next((s.driven_by for s in self.sensor if s.is_bare), None)

    @property
    def contacts(self) -> tuple[Body, ...]:
        """Bodies with a contact."""
        return tuple(b for b in self.body if b.contact)

    def clocks(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Return times t (N,) [s] by column, as the log's clock and those of its loggers write them."""
        columns = {self.time_column: t / units.UNITS[self.time_unit][1]}
        for s in self.sensors("full"):
            if s.time_column is not None:
                own = (t - s.time_offset) / units.UNITS[s.time_unit or self.time_unit][1]
                columns.setdefault(s.time_column, own)
        return columns

    def sensors(self, kit: str) -> tuple[Sensor, ...]:
        """Return the sensors of a kit, without those of locked coordinates."""
        return tuple(s for s in self.sensor if kit in s.kits and self._visible(s))

    def si_unit(self, sensor: Sensor) -> str:
        """Return the SI unit of a sensor's values."""
        straight = self.find(sensor.body).joint == "prismatic"
        if sensor.kind in ("angle", "wheel"):
            return ("m" if straight and sensor.kind == "angle" else "rad") + ("/s" if sensor.is_rate else "")
        torque = self.torque_unit or ("N" if straight else "N m")
        return {"torque": torque, "yaw_rate": "rad/s", "x": "m", "y": "m"}.get(sensor.kind, "m/s")

    def _visible(self, sensor: Sensor) -> bool:
        """True if a free coordinate moves what the sensor measures."""
        free = set(self.coordinates)
        body = self.find(sensor.body)
        if sensor.kind in ("angle", "torque"):
            return self.is_free(body)
        if sensor.kind == "yaw_rate":
            return f"theta{self.body[0].index}" in free
        if sensor.kind in ("lateral_speed", "y"):
            return f"y{self.body[0].index}" in free
        return True

    @model_validator(mode="after")
    def _consistent(self) -> Machine:
        self._check_tree()
        self._check_couplings()
        self._check_springs()
        self._check_locked()
        self._check_sensors()
        self._check_world()
        if self.problem is not None and self.problem not in self.problems:
            allowed = ", ".join(self.problems) or "none is declared"
            hint = did_you_mean(self.problem, self.problems)
            raise ValueError(f"problem: no problem {self.problem}, allowed: {allowed}{hint}")
        for name, problem in self.problems.items():
            self._check_problem(name, problem)
        if self.filter.cutoff_hz.value >= self.sampling_hz.value / 2:
            raise ValueError(
                f"filter.cutoff_hz: must be below half the sampling rate, {self.sampling_hz.value / 2:g} Hz"
                f" (got {self.filter.cutoff_hz.value:g})"
            )
        return self

    def _check_problem(self, name: str, problem: Problem) -> None:
        """Check the lane of a machine on the plane, and the joints and ranges of poses."""
        indices = [b.index for b in self.body]
        for i in problem.lane_points:
            if i not in indices:
                raise ValueError(f"problems.{name}.lane_points: no body {i}, allowed: {sorted(indices)}")
        if self.planar and problem.lane_m is None:
            raise ValueError(f"problems.{name}.lane_m: is missing, a machine on the plane needs length and width")
        jointed = {b.coordinates[0]: b for b in self.body if b.joint in ("revolute", "prismatic")}
        free = [c for c in self.coordinates if c in jointed]
        for key in ("start_pose", "end_pose"):
            for c, place in getattr(problem, key).items():
                if c not in free:
                    raise ValueError(f"problems.{name}.{key}: no joint coordinate {c}, allowed: {', '.join(free)}")
                low, high = jointed[c].limit.position_range or (-math.inf, math.inf)
                if not low <= place <= high:
                    raise ValueError(
                        f"problems.{name}.{key}.{c}: must be within the joint's range, {low:g} to {high:g}"
                        f" (got {place:g})"
                    )

    def _check_tree(self) -> None:
        """Check indices, names and antecedents of the bodies."""
        seen: set[int] = set()
        names: set[str] = set()
        for k, body in enumerate(self.body):
            if body.index in seen:
                raise ValueError(f"body[{k}].index: {body.index} is given twice, every body needs its own")
            if k == 0 and body.antecedent != "ground":
                raise ValueError(f'body[0].antecedent: the first body must stand on "ground" (got {body.antecedent})')
            grounded = body.antecedent == "ground" and not self.planar and body.joint != "planar"
            if k > 0 and body.antecedent not in seen and not grounded:
                known = ", ".join(map(str, sorted(seen)))
                raise ValueError(f"body[{k}].antecedent: {body.antecedent} is not a body above it, allowed: {known}")
            if names & {body.name, body.where}:
                raise ValueError(f"body[{k}].name: {body.where} is given twice, every body and place needs its own")
            if body.contact and (body.antecedent == "ground" or not self.planar):
                raise ValueError(f"body[{k}].contact: needs a chassis on a planar root to carry it")
            seen.add(body.index)
            names |= {body.name, body.where}

    def _check_couplings(self) -> None:
        """Check that coupled joints name others that exist, lead and, for a common torque, are driven."""
        known = {b.index: b for b in self.body}
        for k, body in enumerate(self.body):
            turns_with = None if body.drive is None else body.drive.turns_with
            if turns_with is not None:
                other, where = known.get(turns_with.joint), f"body[{k}].drive.turns_with"
                if other is None or other.joint != "revolute" or other is body or not body.actuated:
                    raise ValueError(f"{where}: needs another revolute joint, and a drive at this one (actuated)")
                if other.drive is not None and other.drive.turns_with is not None:
                    raise ValueError(f"{where}.joint: the rotor of joint {other.index} turns with another one itself")
                if turns_with.offset.value:
                    raise ValueError(f"{where}.offset: is for moves_with, a rotor has none")
            for key in ("moves_with", "driven_with"):
                coupling: Coupling | None = getattr(body, key)
                if coupling is None:
                    continue
                where, other = f"body[{k}].{key}.joint", known.get(coupling.joint)
                if other is None or other.joint not in ("revolute", "prismatic") or other is body:
                    joints = [b.index for b in self.body if b.joint in ("revolute", "prismatic") and b is not body]
                    raise ValueError(f"{where}: no other joint {coupling.joint}, allowed: {joints}")
                if key == "driven_with" and coupling.offset.value:
                    raise ValueError(f"body[{k}].driven_with.offset: is for moves_with, a torque has none")
                if key == "driven_with" and not other.actuated:
                    raise ValueError(f"{where}: joint {other.index} isn't actuated: give the drive that both share")
                if key == "moves_with" and other.moves_with is not None:
                    raise ValueError(
                        f"{where}: joint {other.index} moves with joint {other.moves_with.joint} itself: give that one"
                    )
                if key == "moves_with" and body.friction is not None and other.friction is None:
                    raise ValueError(f"{where}: joint {other.index} needs friction of its own, as its speed decides")
                if key == "driven_with" and body.moves_with is not None and known[body.moves_with.joint].actuated:
                    raise ValueError(f"body[{k}].driven_with: it moves with a driven joint; give that one the torque")
                for one in (body, other) if key == "moves_with" else ():
                    if one.coordinates[0] in self.locked:
                        raise ValueError(f"locked: {one.coordinates[0]} is coupled by {key}, take one of both out")

    def _check_springs(self) -> None:
        """Check that springs between joints join two that move on their own."""
        moving = [b for b in self.body if b.joint in ("revolute", "prismatic") and b.moves_with is None]
        for k, body in enumerate(self.body):
            if body.spring is None or body.spring.joint is None:
                continue
            allowed = [b.index for b in moving if b is not body and b.coordinates[0] not in self.locked]
            if body.spring.joint not in allowed:
                raise ValueError(f"body[{k}].spring.joint: no other free joint {body.spring.joint}, allowed: {allowed}")
            if body.joint != self.find(body.spring.joint).joint:
                raise ValueError(f"body[{k}].spring.joint: joins a joint that turns with one that slides")
            if body not in moving or body.coordinates[0] in self.locked:
                raise ValueError(f"body[{k}].spring.joint: joint {body.index} doesn't move on its own")

    def _check_locked(self) -> None:
        """Check that locked coordinates exist and leave a machine that can be driven."""
        every = [c for b in self.body for c in b.coordinates]
        for c in self.locked:
            if c not in every:
                raise ValueError(f"locked: no coordinate {c}, allowed: {', '.join(every)}{did_you_mean(c, every)}")
        if self.planar:
            x, y, heading = self.body[0].coordinates
            if {x, y} & set(self.locked) and heading not in self.locked:
                raise ValueError(f"locked: {x} and {y} can only be held where {heading} is held too")
        for body in self.contacts:
            if body.coordinates[0] in self.locked:
                raise ValueError(f"locked: {body.coordinates[0]} has a contact that must turn, take that out first")
        if not self.coordinates:
            raise ValueError("locked: nothing is left to move")
        if not self.actuated:
            raise ValueError("body: no joint is actuated, so nothing can drive the machine")

    def _check_world(self) -> None:
        """Check the bodies that tool and surroundings name, and that shapes and planned rates belong to an arm."""
        if self.tool is not None and self.tool.body not in {b.index for b in self.body}:
            raise ValueError(f"tool.body: no body {self.tool.body}, allowed: {[b.index for b in self.body]}")
        things = [*(p.name for p in self.world.plane), *(b.name for b in self.world.box)]
        every = ["ground", "floor", *(b.name for b in self.body), *things]
        for name in things:
            if every.count(name) > 1:
                raise ValueError(f"world: the name {name} is used twice")
        for k, pair in enumerate(self.world.apart):
            for name in pair:
                if name not in every:
                    hint = did_you_mean(name, every)
                    raise ValueError(f"world.apart[{k}]: nothing is called {name}, allowed: {', '.join(every)}{hint}")

    def _check_sensors(self) -> None:
        """Check bodies, names and columns of the sensors."""
        known = {b.index: b for b in self.body}
        jointed = [i for i, b in known.items() if b.joint in ("revolute", "prismatic")]
        driven = [i for i, b in known.items() if b.actuated]
        names: set[str] = set()
        columns: set[str] = {self.time_column}
        measured: set[tuple[str, int]] = set()
        for k, sensor in enumerate(self.sensor):
            if sensor.body not in known:
                raise ValueError(f"sensor[{k}].body: no body {sensor.body}, allowed: {sorted(known)}")
            if sensor.kind == "angle" and sensor.body not in jointed:
                raise ValueError(f"sensor[{k}].body: body {sensor.body} has no joint to measure, allowed: {jointed}")
            if sensor.kind == "angle" and self.offset(known[sensor.body]):
                raise ValueError(
                    f"sensor[{k}].body: joint {sensor.body} moves with another one by an offset: measure that one"
                )
            if sensor.kind == "torque" and sensor.body not in driven:
                raise ValueError(
                    f"sensor[{k}].body: joint {sensor.body} isn't actuated, allowed: {driven}; a common torque is that"
                    " of the joint it is driven with"
                )
            if sensor.kind not in ("angle", "torque") and not self.planar:
                raise ValueError(f"sensor[{k}].kind: {sensor.kind} needs a planar root, allowed here: angle, torque")
            if sensor.kind not in ("angle", "torque") and sensor.body != self.body[0].index:
                raise ValueError(
                    f"sensor[{k}].body: {sensor.kind} is measured on the first chassis alone, body {self.body[0].index}"
                    f" (got {sensor.body}); leave the sensor out, or begin the table with that chassis"
                )
            if sensor.name in names:
                raise ValueError(f"sensor[{k}].name: {sensor.name} is used twice")
            for column in sensor.columns:
                if column in columns:
                    raise ValueError(f"sensor[{k}].column: {column} is used twice")
                columns.add(column)
            other = not sensor.is_bare or sensor.driven_by != self.torque_unit
            if self.in_ratios and sensor.kind == "torque" and other:
                raise ValueError(
                    f"sensor[{k}].unit: either every torque is a current (or every one a voltage or a duty cycle) of"
                    " motors whose common torque_constant is unknown, or none: joints share parameters, which can't be"
                    " in two units"
                )
            if sensor.cylinders:
                self._check_cylinders(f"sensor[{k}].cylinders", sensor)
            if sensor.zero_is_sought:
                self._check_sought_zero(f"sensor[{k}].zero", sensor)
            twin = (sensor.kind, sensor.body)
            if sensor.kind in ("angle", "torque") and twin in measured:
                raise ValueError(
                    f"sensor[{k}].kind: joint {sensor.body} has two sensors of kind {sensor.kind}, keep one"
                )
            measured.add(twin)
            names.add(sensor.name)
        if self.in_ratios:
            self._check_ratios()

    def _check_sought_zero(self, key: str, sensor: Sensor) -> None:
        """Check that a zero is sought of the encoder that gives a joint's coordinate."""
        body = self.find(sensor.body)
        if body.moves_with is not None:
            raise ValueError(
                f"{key}: joint {body.index} moves with joint {body.moves_with.joint}: seek that one's zero alone"
            )
        if any(c.anchor is not None for s in self.sensor if s.body == sensor.body for c in s.cylinders):
            raise ValueError(f"{key}: can't be sought, the lever of the cylinders at joint {body.index} depends on it")

    def _check_ratios(self) -> None:
        """Check that the drives of a machine with an unknown torque constant can share it."""
        if len({b.joint for b in self.actuated}) > 1:
            raise ValueError(
                "sensor.torque_constant: revolute and prismatic joints can't share an unknown one, give it"
            )

    def _check_cylinders(self, key: str, sensor: Sensor) -> None:
        """Check that each pressure turns the joint the same way along its range, and that its angle is measured."""
        body = self.find(sensor.body)
        if body.joint != "revolute":
            raise ValueError(f"{key}: turn a revolute joint, joint {body.index} is {body.joint}")
        pinned = any(c.anchor is not None for c in sensor.cylinders)
        angles = [s for s in self.sensor if s.kind == "angle" and s.body == sensor.body and not s.is_rate]
        if pinned and not angles and body.coordinates[0] not in self.locked:
            raise ValueError(f"{key}: the lever depends on the angle of joint {body.index}, which no sensor measures")
        low, high = body.limit.position_range or (-0.5, 0.5)
        for arm in hydraulics.torque_per_pressure(sensor.displacement, sensor.cylinders, np.linspace(low, high, 41)):
            if not (arm > 0).all() and not (arm < 0).all():
                within = f"{high:g} rad" if low == -high else f"{low:g} to {high:g} rad"
                raise ValueError(f"{key}: a pressure has no lever at some angle within {within}, check the pins")


def shipped_machines() -> tuple[str, ...]:
    """Return the names of the machines in the package."""
    return extends.file_names(MACHINES)


def load_machine(name: str | Path) -> Machine:
    """Load a machine by its shipped name, or from a TOML file.

    A file may say `extends = "va12"` and give only what differs: tables merge, values and lists replace; a table
    [body.NAME] or [sensor.NAME] changes the one of that name.
    Raises MachineError: one line with file, key, problem and what is allowed.
    """
    path = _find(str(name))
    try:
        raw, wrong = extends.read(path, MACHINES)
    except ValueError as err:
        raise MachineError(str(err)) from None
    require_right_names(wrong)
    try:
        return Machine.model_validate(raw)
    except ValidationError as err:
        raise MachineError(error_line(path, err, Machine)) from None


def require_right_names(wrong: Sequence[extends.WrongName]) -> None:
    """Raise MachineError for the first wrong name, if there is one."""
    for one in wrong:
        raise MachineError(f"{one.path}: {one}")


def machine_tables(name: str) -> tuple[str, dict[str, Any], tuple[extends.WrongName, ...]]:
    """Return the text of a machine's own file, its tables merged over those that it extends, and wrong names in them.

    name: a shipped name, or a path. Raises MachineError.
    """
    path = _find(name)
    try:
        return path.read_text(encoding="utf-8-sig", errors="replace"), *extends.read(path, MACHINES)
    except ValueError as err:
        raise MachineError(str(err)) from None


def machine_files(name: str | Path) -> list[Path]:
    """Return the user's files behind a machine, including those it extends; none for a shipped machine.

    Raises MachineError.
    """
    try:
        whole = [] if str(name) in shipped_machines() else extends.chain(_find(str(name)), MACHINES)
    except ValueError as err:
        raise MachineError(str(err)) from None
    return [p for k, (p, _) in enumerate(whole) if k == 0 or p.parent != MACHINES]


def _find(name: str) -> Path:
    """Return the file of a machine. Raises MachineError."""
    if name in shipped_machines():
        return MACHINES / f"{name}.toml"
    path = Path(name)
    if path.suffix != ".toml":
        own = Path(f"{name}.toml")
        if own.is_file():
            raise MachineError(f"{name}: is no shipped machine; for the file beside it write {own}")
        raise MachineError(
            f"{name}: no such machine, allowed: {', '.join(shipped_machines())}, or a path to a .toml file"
            f"{_similar_machine(path)}"
        )
    if not path.is_file():
        raise MachineError(f"{name}: no such file{_similar_machine(path)}")
    return path


def _similar_machine(path: Path) -> str:
    """Return " (did you mean X?)" for a wrong name: a machine file in the same folder, or a shipped machine."""
    here = [p for p in sorted(path.parent.glob("*.toml")) if is_machine_file(p)]
    known = {n: n for n in shipped_machines()} | {p.stem: str(p) for p in here}
    spelt = {f"{stem}{end}".lower(): name for stem, name in known.items() for end in (".toml", "")}
    like = closest(path.name.lower(), spelt)
    return f" (did you mean {spelt[like]}?)" if like else ""


def is_machine_file(path: Path) -> bool:
    """Return True for a TOML file that describes a machine, however wrong."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    except OSError:
        return False
    return "[[body]]" in text or text.startswith("extends") or "\nextends" in text
