"""Sensors of a machine file: columns of a log, what they measure and how well."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from excite.model.machine import hydraulics, units
from excite.model.machine.body import Index
from excite.model.machine.force_loop import ForceLoop
from excite.model.machine.records import FileRecord, Flag, NotNegative, Positive, Quantity
from excite.text import did_you_mean

# Kinds of sensor whose place matters, by key of that place.
SENSOR_PLACE_KEYS = {
    "radius": ("wheel",),
    "lateral": ("wheel", "forward_speed", "ground_speed", "x", "y"),
    "ahead": ("lateral_speed", "ground_speed", "x", "y"),
}
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

IN_SI = "SI"  # noise_unit of a value in the SI unit of what the sensor measures: N m at the joint of a pressure in bar
SI_QUANTITIES = {"torque": ("torque", "force"), "angle": ("angle", "length", "angular rate", "speed")}

Size = Annotated[float, Field(ge=0, allow_inf_nan=False)]


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

    @property
    def is_of_pressures(self) -> bool:
        """True if two pressures are given, of a hydraulic motor or of cylinders."""
        return self.displacement is not None or bool(self.cylinders)

    @model_validator(mode="after")
    def _consistent(self) -> Sensor:
        self._check_pressures()
        self._check_unit()
        self._check_motor()
        self._check_loop()
        self._check_reading()
        for name in self.checks_off:
            if name not in LOG_CHECKS:
                hint = did_you_mean(name, LOG_CHECKS)
                raise ValueError(f"checks_off: {name!r} is unknown, allowed: {', '.join(LOG_CHECKS)}{hint}")
        if line := _wrong_noise_unit(self):
            raise ValueError(line)
        if self.noise is not None and self.noise.value == 0 and self.counts_per_turn is None:
            raise ValueError("noise: must be > 0 (got 0); leave it out if it is unknown")
        if "full" not in self.kits:
            raise ValueError(f'kits: "full" has every sensor, add it (got {", ".join(self.kits) or "none"})')
        return self

    def _check_pressures(self) -> None:
        """Check the keys of a torque that is given as two pressures."""
        pressed = self.is_of_pressures
        if pressed != (self.return_column is not None):
            key = "return_column" if pressed else "displacement"
            raise ValueError(f"{key}: two pressures need column, return_column and displacement (or cylinders)")
        if self.displacement is not None and self.cylinders:
            raise ValueError("cylinders: a joint is turned by a motor of some displacement or by cylinders, not both")
        if pressed and self.kind != "torque":
            key = "cylinders" if self.cylinders else "displacement"
            raise ValueError(f"{key}: makes a torque of pressures, not kind {self.kind}")

    def _check_unit(self) -> None:
        """Check that the unit is one of what the sensor measures."""
        measured = ("pressure",) if self.is_of_pressures else units.QUANTITIES_BY_KIND[self.kind]
        quantity = units.UNITS.get(self.unit, ("",))[0]
        if self.factor is None and self.kind == "torque" and not self.is_of_pressures and quantity == "pressure":
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

    def _check_motor(self) -> None:
        """Check the keys of a torque that is given as a motor's current, voltage or duty cycle."""
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

    def _check_loop(self) -> None:
        """Check the keys of a torque that is commanded."""
        if self.loop is not None and (self.kind != "torque" or self.is_of_pressures):
            raise ValueError("loop: is for a commanded torque, force or current, kind torque without pressures")
        if self.loop is not None and self.noise is None:
            raise ValueError(
                f"noise: is missing beside loop: by how much [{self.unit}] the delivered torque or force differs"
                " from the loop's response, which no log of commands shows"
            )

    def _check_reading(self) -> None:
        """Check keys that only some kinds of sensor have."""
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


def _wrong_noise_unit(sensor: Sensor) -> str:
    """Say why a sensor's `noise_unit` is none, "" where it is one."""
    unit = sensor.noise_unit
    if unit is None or unit in (IN_SI, sensor.unit):
        return ""
    own = () if sensor.factor is not None else units.UNITS.get(sensor.unit, ("",))[:1]
    allowed = (*own, *SI_QUANTITIES.get(sensor.kind, units.QUANTITIES_BY_KIND[sensor.kind]))
    if units.UNITS.get(unit, ("",))[0] in allowed:
        return ""
    return (
        f"noise_unit: {unit!r} is no unit of this sensor's noise: leave it out (noise is then in {sensor.unit}, the"
        f' column\'s unit), or write "{IN_SI}"'
    )
