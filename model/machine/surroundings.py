"""What an arm may touch: shapes around its links, the floor, planes and boxes around it, and where its tool may go."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from excite.model.machine.records import FileRecord, Number, Positive, Quantity, Vector3

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


class Shape(FileRecord):
    """A capsule: all points within `radius` [m] of the line between two `ends` [m]; a sphere with one end.

    In the frame of its body, or of the ground.
    """

    radius: Positive
    ends: Annotated[tuple[Vector3, ...], Field(min_length=1, max_length=2)]


class Plane(FileRecord):
    """A wall: everything stays where `normal` . x > `distance` [m], x in the axes of the ground."""

    name: Name
    normal: Vector3
    distance: Quantity

    @model_validator(mode="after")
    def _consistent(self) -> Plane:
        if not any(self.normal):
            raise ValueError("normal: must not be zero")
        return self


class Box(FileRecord):
    """A box from corner `low` to corner `high` [m] in the axes of the ground, which nothing enters."""

    name: Name
    low: Vector3
    high: Vector3

    @model_validator(mode="after")
    def _consistent(self) -> Box:
        if any(a >= b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low: must be below high in x, y and z (got {self.low}, {self.high})")
        return self


def _none_or_value(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    """Check a quantity that may be left out. Raises ValueError that says what is allowed."""
    if isinstance(value, (dict, Quantity)):
        return Quantity.model_validate(value)
    try:
        return handler(value)
    except ValidationError:
        raise ValueError(f'must be "none" or a table {{ value = ..., source = "..." }} (got {value!r})') from None


class World(FileRecord):
    """Surroundings of an arm, in the axes of the ground.

    floor: height z [m] of a plane that nothing goes below, 0 (the mounting) by default, "none" for none. margin [m]:
    least distance of shapes. shape: those that stand on the ground, such as the robot's base. apart: pairs of bodies,
    planes and boxes by name whose distance does not count; pairs that touch in every pose are left out anyway.
    """

    floor: Annotated[Quantity | Literal["none"], WrapValidator(_none_or_value)] = Quantity(
        value=0.0, source="definition"
    )
    margin: Positive = Quantity(value=0.02, source="assumed")
    shape: tuple[Shape, ...] = ()
    plane: tuple[Plane, ...] = ()
    box: tuple[Box, ...] = ()
    apart: tuple[tuple[str, str], ...] = ()


class Tool(FileRecord):
    """The tool's point, [m] in the frame of a body, and its limits.

    low, high [m]: corners of a box in the axes of the ground that the point stays in. speed [m/s]: its highest.
    """

    body: Annotated[int, Field(strict=True, ge=0, le=99)]
    point: Vector3 = (0.0, 0.0, 0.0)
    low: tuple[Number, Number, Number] | None = None
    high: tuple[Number, Number, Number] | None = None
    speed: Positive | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Tool:
        if (self.low is None) != (self.high is None):
            raise ValueError(f"{'low' if self.low is None else 'high'}: is missing, give both corners of the box")
        if self.low and self.high and any(a >= b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low: must be below high in x, y and z (got {self.low}, {self.high})")
        return self
