"""The machine file (TOML) as frozen, checked records.

A machine is a tree of bodies given by its modified Denavit-Hartenberg table (Khalil and Kleinfinger, 1986), with
inertias, joint friction, contacts with the ground, sensors, limits and design problems. Every number names its source.
All values are SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from excite.errors import MachineError
from excite.model.machine import checks, extends, units
from excite.model.machine.body import Body
from excite.model.machine.problem import Problem
from excite.model.machine.records import FileRecord, NotNegative, Positive, Quantity, Source, Vector3, error_line
from excite.model.machine.sensor import Sensor, Size, TimeUnit
from excite.model.machine.surroundings import Tool, World
from excite.text import closest, did_you_mean

MACHINES = Path(__file__).parents[1] / "machines"


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
        checks.check_tree(self.body)
        checks.check_couplings(self.body, self.locked)
        checks.check_springs(self.body, self.locked)
        checks.check_locked(self.body, self.locked)
        if not self.coordinates:
            raise ValueError("locked: nothing is left to move")
        if not self.actuated:
            raise ValueError("body: no joint is actuated, so nothing can drive the machine")
        checks.check_sensors(self.sensor, self.body, self.locked, self.time_column, self.torque_unit)
        checks.check_surroundings(self.body, self.world, self.tool)
        if self.problem is not None and self.problem not in self.problems:
            allowed = ", ".join(self.problems) or "none is declared"
            hint = did_you_mean(self.problem, self.problems)
            raise ValueError(f"problem: no problem {self.problem}, allowed: {allowed}{hint}")
        for name, problem in self.problems.items():
            checks.check_problem(name, problem, self.body, self.coordinates)
        if self.filter.cutoff_hz.value >= self.sampling_hz.value / 2:
            raise ValueError(
                f"filter.cutoff_hz: must be below half the sampling rate, {self.sampling_hz.value / 2:g} Hz"
                f" (got {self.filter.cutoff_hz.value:g})"
            )
        return self


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
    spelt = {stem.lower(): name for stem, name in known.items()}
    like = closest(path.name.lower().removesuffix(".toml"), spelt)  # an end that all share is no likeness
    return f" (did you mean {spelt[like]}?)" if like else ""


def is_machine_file(path: Path) -> bool:
    """Return True for a TOML file that describes a machine, however wrong."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    except OSError:
        return False
    return "[[body]]" in text or text.startswith("extends") or "\nextends" in text
