"""A study file (TOML) as checked records, and the cells that it spans.

    name = "soil"
    runs = 50                               # of every cell, each with other sensor noise
    steps = ["verify"]                      # any of design, simulate, identify, diagnose, verify

    [grid]                                  # every combination; [[grid]] for several
    machine = ["va12", "my_roller.toml"]
    objective = ["cond", "accuracy"]
    duration_s = [30, 60]
    limits = [{}, { rim_speed = 0.5 }]      # factors on the machine's own
    method = ["joint", "ols"]
    effects = [[], ["rolling_resistance@front_roll=30"]]

    [sample]                                # so many cells drawn at random; [[sample]] for several
    count = 100
    machine = ["va12"]
    duration_s = [{ low = 20, high = 60 }]
    effects = [["ground_slope=0.0005..0.005"]]

A cell is one combination: a drive (designed, or a given `profile`), the machine that drives it, its sensors and a
method. Cells with the same drive share its design. Paths are relative to the study file.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError, WrapValidator, model_validator
from pydantic_core import PydanticCustomError

from excite import identification, logs
from excite.errors import LogError, MachineError, StudyError, UsageError
from excite.model import build
from excite.model.effects import DEFAULT_DURATION, parse_effect, place_effect
from excite.model.machine import (
    FileRecord,
    Machine,
    Number,
    error_line,
    load_machine,
    machine_files,
    read_toml,
    shipped_machines,
)
from excite.trajectories import LIMITS
from excite.workflows import requests

STEPS = ("design", "simulate", "identify", "diagnose", "verify")
MAX_RUNS = 1_000_000  # of a study; chosen
MAX_CELLS = 100_000  # of a study; chosen
MAX_LIMIT_FACTOR = 10.0  # on a machine's own limit; chosen: a larger one is meant as per cent
SPAN = re.compile(r"^(?P<what>[^=]*)=(?P<low>[^=]+)\.\.(?P<high>[^=]+)$")


def _as_list(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else [value]


def _effect_sets(value: Any) -> Any:
    """Make every entry a set of effects; a single effect becomes a set of one."""
    return [_as_list(v) for v in _as_list(value)]


class Range(FileRecord):
    """Numbers from low to high, drawn uniformly, or uniformly in their logarithm."""

    low: Number
    high: Number
    log: Annotated[bool, Field(strict=True)] = False

    @model_validator(mode="after")
    def _consistent(self) -> Range:
        if not self.low < self.high or (self.log and self.low <= 0):
            positive = ", which must be > 0 for log" if self.log else ""
            raise ValueError(f"high: must be above low{positive} (got {self.low:g} to {self.high:g})")
        return self

    def draw(self, rng: np.random.Generator) -> float:
        if self.log:
            return float(np.exp(rng.uniform(math.log(self.low), math.log(self.high))))
        return float(rng.uniform(self.low, self.high))


_NUMBER: TypeAdapter[float] = TypeAdapter(Number)


def _number_or_range(value: Any, _: object) -> Any:
    """Read a table as a range and anything else as a number, so that an error names the one that is meant."""
    return Range.model_validate(value) if isinstance(value, dict) else _NUMBER.validate_python(value)


Varied = Annotated[Number | Range, WrapValidator(_number_or_range)]
Text = Annotated[str, Field(min_length=1, max_length=1000)]
Whole = Annotated[int, Field(strict=True, ge=0, le=2**32 - 1)]
Starts = Annotated[int, Field(strict=True, ge=1, le=1000)]


def _limits(value: Any) -> Any:
    """Raise ValidationError for a limit that no machine file has."""
    allowed = [known for known, kind in LIMITS.items() if kind.stated]
    for name in value if isinstance(value, dict) else ():
        if name not in allowed:
            error = PydanticCustomError(
                "value_error", f"no such limit of a machine file, allowed: {', '.join(allowed)}"
            )
            raise ValidationError.from_exception_data("limits", [{"type": error, "loc": (name,), "input": name}])
    return value


Limits = Annotated[dict[str, Number], BeforeValidator(_limits)]
VariedLimits = Annotated[dict[str, Varied], BeforeValidator(_limits)]


class Axes(FileRecord):
    """Values to vary; an axis that is left out has the default of the commands.

    limits: factors on the machine's own limits. effects: sets of NAME[@WHERE]=MAGNITUDE. profile: drives in place of
    designs. seed: of the sensor noise, as in `excite verify`. design_seed: of the search for a design.
    """

    machine: Annotated[tuple[Text, ...], BeforeValidator(_as_list), Field(min_length=1)]
    problem: Annotated[tuple[Text, ...], BeforeValidator(_as_list), Field(min_length=1)] = ()
    objective: Annotated[tuple[Text, ...], BeforeValidator(_as_list), Field(min_length=1)] = ("cond",)
    starts: Annotated[tuple[Starts, ...], BeforeValidator(_as_list), Field(min_length=1)] = (2,)
    design_seed: Annotated[tuple[Whole, ...], BeforeValidator(_as_list), Field(min_length=1)] = (0,)
    profile: Annotated[tuple[Text, ...], BeforeValidator(_as_list), Field(min_length=1)] = ()
    kit: Annotated[tuple[Literal["paper", "full"], ...], BeforeValidator(_as_list), Field(min_length=1)] = ("full",)
    method: Annotated[tuple[Text, ...], BeforeValidator(_as_list), Field(min_length=1)] = ()
    effects: Annotated[tuple[tuple[Text, ...], ...], BeforeValidator(_effect_sets), Field(min_length=1)] = ((),)
    seed: Annotated[tuple[Whole, ...], BeforeValidator(_as_list), Field(min_length=1)] = (0,)

    @model_validator(mode="after")
    def _consistent(self) -> Axes:
        if self.profile:
            named = {"problem", "objective", "starts", "design_seed", "duration_s", "limits"} & self.model_fields_set
            if named:
                raise ValueError(f"profile: is driven as it is, leave out {', '.join(sorted(named))}")
        return self


def _as_toml(value: Any) -> str:
    """Format a value about as a study file has it."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_as_toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name} = {_as_toml(inner)}' for name, inner in value.items())}}}"
    return f"{value:g}" if isinstance(value, float) else str(value)


class Grid(Axes):
    """Cells of every combination of the axes."""

    duration_s: Annotated[tuple[Number, ...], BeforeValidator(_as_list), Field(min_length=1)] = ()
    limits: Annotated[tuple[Limits, ...], BeforeValidator(_as_list), Field(min_length=1)] = ({},)

    @model_validator(mode="after")
    def _no_twins(self) -> Grid:
        """Raise ValueError for a value that is given twice, which would repeat cells with the same runs."""
        for name in AXES:
            seen: set[Any] = set()
            for value in getattr(self, name):
                key = tuple(sorted(value.items())) if isinstance(value, dict) else value
                if key in seen:
                    raise ValueError(f"{name}: a value is given twice, leave one of them out (got {_as_toml(value)})")
                seen.add(key)
        return self

    @property
    def choices(self) -> dict[str, tuple[Any, ...]]:
        """Values by axis, None for the machine's own."""
        return {name: getattr(self, name) or (None,) for name in AXES}

    def __len__(self) -> int:
        return math.prod(len(v) for v in self.choices.values())

    def cells(self) -> Iterator[Cell]:
        for values in itertools.product(*self.choices.values()):
            yield _cell(dict(zip(AXES, values, strict=True)))


class RandomSample(Axes):
    """`count` cells, each axis drawn at random from its values, numbers from ranges."""

    count: Annotated[int, Field(strict=True, ge=1, le=MAX_RUNS)]
    sample_seed: Whole = 0
    duration_s: Annotated[tuple[Varied, ...], BeforeValidator(_as_list), Field(min_length=1)] = ()
    limits: Annotated[tuple[VariedLimits, ...], BeforeValidator(_as_list), Field(min_length=1)] = ({},)

    def __len__(self) -> int:
        return self.count

    def cells(self) -> Iterator[Cell]:
        for k in range(self.count):
            rng = np.random.default_rng([self.sample_seed, k])
            choices = {n: getattr(self, n) or (None,) for n in AXES}
            chosen: dict[str, Any] = {n: c[int(rng.integers(len(c)))] for n, c in choices.items()}
            chosen["duration_s"] = _draw_number(chosen["duration_s"], rng)
            chosen["limits"] = {n: _draw_number(v, rng) for n, v in chosen["limits"].items()}
            chosen["effects"] = tuple(_draw_magnitude(text, rng) for text in chosen["effects"])
            yield _cell(chosen)


def _draw_number(value: Any, rng: np.random.Generator) -> Any:
    """Draw a number from a range, rounded to six digits so that it can be typed again."""
    return float(f"{value.draw(rng):.6g}") if isinstance(value, Range) else value


def _draw_magnitude(text: str, rng: np.random.Generator) -> str:
    """Turn NAME=LOW..HIGH into NAME=MAGNITUDE. Raises StudyError."""
    span = SPAN.match(text)
    if span is None:
        return text
    try:
        between = Range(low=float(span["low"]), high=float(span["high"]))
    except (ValidationError, ValueError):
        raise StudyError(f"effects: {text}: must be NAME[@WHERE]=LOW..HIGH with LOW below HIGH") from None
    return f"{span['what']}={_draw_number(between, rng):.6g}"


@dataclass(frozen=True)
class DriveSpec:
    """A drive to design for a machine within limits, or a given profile. None: the machine's own value."""

    machine: str
    problem: str | None
    objective: str
    duration_s: float | None
    limits: tuple[tuple[str, float], ...]
    starts: int
    seed: int
    profile: str | None


@dataclass(frozen=True)
class Cell:
    """One combination of a drive with effects, sensors and a method."""

    drive: DriveSpec
    kit: str
    method: str | None
    effects: tuple[str, ...]
    seed: int


AXES = (
    *("machine", "problem", "objective", "duration_s", "limits", "starts", "design_seed", "profile"),
    *("kit", "effects", "method", "seed"),
)


def _cell(v: dict[str, Any]) -> Cell:
    limits = tuple(sorted((n, float(f)) for n, f in v["limits"].items()))
    drive = (v["problem"], v["objective"], v["duration_s"], limits, v["starts"], v["design_seed"])
    if v["profile"] is not None:
        drive = (None, "", None, (), 0, 0)
    return Cell(DriveSpec(v["machine"], *drive, v["profile"]), v["kit"], v["method"], tuple(v["effects"]), v["seed"])


class Study(FileRecord):
    """A study file. runs: of every cell. steps: of every run.

    budget_s [s]: time after which each design ends with the best drive so far, which then depends on the computer.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,79}$")]
    title: Annotated[str, Field(max_length=200)] = ""
    runs: Annotated[int, Field(strict=True, ge=1, le=MAX_RUNS)] = 1
    steps: Annotated[
        tuple[Literal["design", "simulate", "identify", "diagnose", "verify"], ...],
        BeforeValidator(_as_list),
        Field(min_length=1),
    ] = ("verify",)
    budget_s: Annotated[float | None, Field(gt=0, allow_inf_nan=False)] = None
    grid: Annotated[tuple[Grid, ...], BeforeValidator(_as_list)] = ()
    sample: Annotated[tuple[RandomSample, ...], BeforeValidator(_as_list)] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Study:
        if not self.grid and not self.sample:
            raise ValueError("grid: is missing, give [grid] or [sample] with the machines at least")
        if len(self) > MAX_RUNS:
            raise ValueError(f"runs: {len(self)} runs in all, at most {MAX_RUNS} are allowed")
        if len(self) // self.runs > MAX_CELLS:
            raise ValueError(f"grid: {len(self) // self.runs} cells, at most {MAX_CELLS} are allowed")
        if "design" in self.steps and any(a.profile for a in self.blocks):
            raise ValueError("steps: design goes without a profile, leave one of them out")
        return self

    @property
    def blocks(self) -> tuple[Grid | RandomSample, ...]:
        return (*self.grid, *self.sample)

    def __len__(self) -> int:
        """Runs in all."""
        return self.runs * sum(len(a) for a in self.blocks)

    def cells(self) -> Iterator[Cell]:
        for axes in self.blocks:
            yield from axes.cells()


@dataclass(frozen=True)
class StudyPlan:
    """A study with its checked cells, and its machines by the name that the study gives them.

    Runs are numbered cell by cell: run r of cell c is number c * runs + r. texts: files of each machine, by file name.
    """

    study: Study
    base: Path
    cells: tuple[Cell, ...]
    machines: dict[str, Machine]
    texts: dict[str, dict[str, str]] = field(default_factory=dict)

    @cached_property
    def drives(self) -> tuple[DriveSpec, ...]:
        """Drives in the order of their first cell."""
        return tuple(dict.fromkeys(c.drive for c in self.cells))

    @cached_property
    def number(self) -> dict[DriveSpec, int]:
        """Index of each drive in `drives`."""
        return {d: k for k, d in enumerate(self.drives)}

    @property
    def total(self) -> int:
        return len(self.cells) * self.study.runs

    def method(self, cell: Cell) -> str:
        return cell.method or self.recommended[cell.drive.machine]

    @cached_property
    def recommended(self) -> dict[str, str]:
        return {name: identification.recommend_method(build(m)) for name, m in self.machines.items()}

    @cached_property
    def parameters(self) -> dict[str, tuple[str, ...]]:
        """Base parameters of each machine, in the machine's order."""
        return {name: build(m).base.names for name, m in self.machines.items()}

    def seeds(self, cell: Cell) -> np.ndarray:
        """Seeds (runs,) of the sensor noise; cells of one seed share them, so all methods meet the same logs."""
        return np.random.SeedSequence(cell.seed).generate_state(self.study.runs)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of everything that the rows depend on, except the program."""
        seen = hashlib.sha256(self.study.model_dump_json().encode())
        for name in sorted(self.machines):
            seen.update(self.machines[name].model_dump_json().encode())
        for name in sorted({d.profile for d in self.drives if d.profile is not None}):
            seen.update(logs.drive_file(self.base / name).read_bytes())
        return seen.hexdigest()

    def design_machine(self, drive: DriveSpec) -> Machine:
        """Return the machine that a drive is designed for, with the study's limits."""
        return scale_limits(self.machines[drive.machine], dict(drive.limits))


def read_study(path: str | Path) -> StudyPlan:
    """Read a study file and check everything that it names. Raises StudyError, MachineError, LogError."""
    path = Path(path)
    if path.suffix != ".toml":
        raise StudyError(f"{path}: must be a study file (.toml)")
    try:
        raw = read_toml(path)
    except ValueError as err:
        raise StudyError(str(err)) from None
    try:
        study = Study.model_validate(raw)
    except ValidationError as err:
        raise StudyError(error_line(path, err, Study)) from None
    try:
        return plan_study(study, path.parent)
    except UsageError as err:
        said = str(err).removeprefix("--").replace("duration:", "duration_s:", 1)  # keys, not options
        raise StudyError(f"{path}: {said}") from None
    except (MachineError, LogError) as err:
        raise type(err)(f"{path}: {err}") from None


def plan_study(study: Study, base: Path | str = Path()) -> StudyPlan:
    """Read a study's machines and check every cell before anything is computed. Paths are relative to `base`.

    Raises UsageError, MachineError, LogError.
    """
    base = Path(base)
    known: dict[str, Machine] = {}
    texts: dict[str, dict[str, str]] = {}
    for axes in study.blocks:
        for name in dict.fromkeys(axes.machine):
            if name not in known:
                place = name if name in shipped_machines() else base / name
                known[name] = load_machine(place)
                texts[name] = {p.name: p.read_text(encoding="utf-8-sig") for p in machine_files(place)}
    plan = StudyPlan(study, base, tuple(study.cells()), known, texts)
    seen: set[Any] = set()
    for cell in plan.cells:
        _check_cell(plan, cell, seen)
    return plan


def _check_cell(plan: StudyPlan, cell: Cell, seen: set[Any]) -> None:
    """Check a cell, except what `seen` says was checked before.

    Raises UsageError, StudyError, MachineError, LogError.
    """
    d, machine = cell.drive, plan.machines[cell.drive.machine]

    def fresh(*key: Any) -> bool:
        new = key not in seen
        seen.add(key)
        return new

    if fresh(d):
        if d.profile is not None:
            logs.read_profile(plan.base / d.profile, build(machine))
        else:
            requests.require_objective(d.objective, machine)
            requests.choose_problem(plan.design_machine(d), d.problem, d.duration_s)
    if fresh(d.machine, cell.effects):
        own = [place_effect(machine, entry).name for entry in machine.effect]
        labels = [parse_effect(text, machine, DEFAULT_DURATION).label for text in cell.effects]
        for k, label in enumerate(labels):
            if label in labels[:k]:
                raise StudyError(f"effects: {', '.join(cell.effects)}: an effect is given twice, {label}")
            if label in own:
                raise StudyError(f"effects: {cell.effects[k]}: {machine.name} has {label} already, in its machine file")
    if fresh(d.machine, cell.method, cell.kit) and set(plan.study.steps) & {"identify", "verify"}:
        requests.choose_method(plan.method(cell), build(machine), cell.kit)


def scale_limits(machine: Machine, factors: dict[str, float]) -> Machine:
    """Multiply limits of a machine by factors. Raises StudyError for a limit that the machine does not have."""
    if not factors:
        return machine
    raw = json.loads(machine.model_dump_json())
    for name, factor in factors.items():
        if not 0 < factor <= MAX_LIMIT_FACTOR:
            raise StudyError(
                f"limits: {name}: must be a factor on the machine's own limit, above 0 and at most {MAX_LIMIT_FACTOR:g}"
                " (got"
                f" {factor:g}); 0.5 is half of it"
            )
        stated = [_multiply(raw, path, factor) for path in LIMITS[name].stated]
        if not any(stated):
            raise StudyError(f"limits: {machine.name} has no limit {name}")
    return Machine.model_validate_json(json.dumps(raw))


def _multiply(raw: dict[str, Any], path: str, factor: float) -> bool:
    """Multiply the values at a path of a machine's JSON, in every body or problem; return whether there is any."""
    *way, last = path.split(".")
    places = [raw]
    for key in way:
        inner = [place[key] for place in places if place[key]]
        lists = [list(x.values()) if key == "problems" else x if isinstance(x, list) else [x] for x in inner]
        places = [one for several in lists for one in several]
    stated = [place for place in places if place[last]]
    for place in stated:
        place[last] = _times(place[last], factor)
    return bool(stated)


def _times(value: Any, factor: float) -> Any:
    """Multiply a number of a machine's JSON: plain, with its source, or in nested lists."""
    if isinstance(value, dict):
        return value | {"value": factor * value["value"]}
    return [_times(x, factor) for x in value] if isinstance(value, list) else factor * value
