"""Bodies of a machine file: rows of the modified Denavit-Hartenberg table with what each carries."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from excite.model.machine.records import BodyPoint, FileRecord, Flag, Negative, NotNegative, Positive, Quantity
from excite.model.machine.surroundings import Shape

Index = Annotated[int, Field(strict=True, ge=0, le=99)]


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
