"""Design problems of a machine file: duration, lane, reversals, and poses at both ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

from pydantic import Field, model_validator

from excite.model.machine.body import Index
from excite.model.machine.records import FileRecord, Flag, Number, Positive, Source


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

    def __hash__(self) -> int:
        return hash(self.model_dump_json())

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
