"""Checks of what a command asks for by name or number; an unknown or impossible request is a UsageError."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from excite.errors import UsageError
from excite.text import did_you_mean

# Heavy imports happen inside, so that --help is there at once.
if TYPE_CHECKING:
    from excite.model import Model
    from excite.model.machine import Machine, Problem

LONGEST_DRIVE_S = 3600.0  # [s]; chosen
ARM_DURATION_S = 8.0  # of an arm's drive, without a design problem in its file; usual in the field
ARM_KNOT_S = 0.2  # distance of the knots of its free motion; chosen


def build_model(name: str, fit_sensor_effects: bool = True) -> Model:
    """Build the model of a machine by name; see `model.build` for fit_sensor_effects. Raises MachineError."""
    from excite.errors import MachineError
    from excite.model import build as prediction_build
    from excite.model.machine import load_machine

    loaded = load_machine(name)
    try:
        return prediction_build(loaded, fit_sensor_effects)
    except MachineError as err:
        raise MachineError(f"{name}: {str(err).removeprefix(f'{loaded.name}: ')}") from None


def choose_problem(machine: Machine, name: str | None, duration: float | None) -> tuple[str, Problem]:
    """Return a machine's design problem by name, None for its own, with another duration [s] if given."""
    name = name or machine.problem
    problems = machine.problems or arm_problems(machine)
    if not machine.problems:
        name = name or next(iter(problems), None)
    if name is None or not problems:
        raise UsageError(
            f"{machine.name} has no design problem of its own, give its machine file one ([problems.NAME])"
        )
    require_known("--problem", name, tuple(problems))
    found = problems[name]
    if duration is not None:
        knot = float(found.knot_s)
        if not 4 * knot <= duration <= LONGEST_DRIVE_S:
            raise UsageError(f"--duration: must be between {4 * knot:g} and {LONGEST_DRIVE_S:g} s (got {duration:g})")
        found = found.lasting(duration)
    return name, found


def arm_problems(machine: Machine) -> dict[str, Problem]:
    """Return the design problem of an arm whose file has none, by name: from rest to rest; {} for other machines."""
    from excite.model import build_cached
    from excite.model.machine import Problem, Quantity

    if not build_cached(machine.model_dump_json()).follows_positions:
        return {}
    duration, knot = (Quantity(value=x, source="assumed") for x in (ARM_DURATION_S, ARM_KNOT_S))
    return {f"A{ARM_DURATION_S:g}": Problem(source="assumed", duration_s=duration, knot_s=knot)}


def choose_method(name: str | None, model: Model, kit: str | None = None) -> str:
    """Return the name of a method, None for the recommended one. Raises UsageError if the kit lacks a sensor for it."""
    from excite import identification

    name = name or identification.recommend_method(model)
    require_known("--method", name, tuple(identification.METHODS))
    if kit is not None:
        have = {s.name for s in model.machine.sensors(kit)}
        needs = identification.needed_sensors(model, name)
        missing = [s.column for s in model.machine.sensors("full") if s.name in needs and s.name not in have]
        if missing:
            raise UsageError(f"--method: {name} needs {', '.join(missing)}, which kit {kit} does not measure")
    return name


# Package and table of each option that takes a name: help, shell completion and errors read the names from there.
CHOICES = {
    "objective": ("excite.trajectories", "OBJECTIVES"),
    "solver": ("excite.trajectories", "SOLVERS"),
    "trajectory": ("excite.trajectories", "TRAJECTORIES"),
    "method": ("excite.identification", "METHODS"),
    "against": ("excite.trajectories", "BASELINES"),
    "kit": ("excite.simulation", "KITS"),
    "friction": ("excite.simulation", "FRICTION_LAWS"),
    "effect": ("excite.model.effects", "CATALOGUE"),
}
MAX_LISTED = 16  # names that the help of an option lists; chosen


def choices(option: str) -> tuple[str, ...]:
    """Return the names that an option takes, none for an option that takes no name."""
    from importlib import import_module

    module, table = CHOICES.get(option, ("", ""))
    return tuple(getattr(import_module(module), table)) if module else ()


def help_with_choices(option: str, text: str | None) -> str:
    """Return an option's help text, with the names that it takes."""
    names = choices(option)
    return f"{text or ''}: {', '.join(names)}" if 0 < len(names) <= MAX_LISTED else text or ""


def require_known(what: str, value: str, allowed: Sequence[str]) -> None:
    """Raise UsageError for a value that is not allowed. what: the option, as the message begins."""
    if value not in allowed:
        raise UsageError(f"{what}: {value} is unknown, allowed: {', '.join(allowed)}{did_you_mean(value, allowed)}")


def require_objective(name: str, machine: Machine, of: object = None) -> None:
    """Raise UsageError for an unknown objective, or one without what it needs.

    `discrimination` needs two effects that a drive shows; a prediction needs the drive to predict (of), no other does.
    Raises MachineError for effects that this machine can't have.
    """
    from excite.model import build
    from excite.trajectories import OBJECTIVES

    require_known("--objective", name, tuple(OBJECTIVES))
    wanted = OBJECTIVES[name].contrasts
    if (wanted == "prediction") != (of is not None):
        every = [n for n, o in OBJECTIVES.items() if o.contrasts == "prediction"]
        raise UsageError(
            f"--objective {name}: needs --of PROFILE.csv, the drive to predict"
            if of is None
            else f"--of: is for --objective {' or '.join(every)} (got {name})"
        )
    if wanted != "rivals":
        return
    model = build(machine, fit_sensor_effects=False)
    shown = sum(e.name in model.base.names for e in model.effects)
    if shown < 2:
        raise UsageError(
            f"--objective: discrimination: needs two effects to tell apart, {machine.name} has {shown or 'none'} that a"
            " drive shows; give its machine file two ([[effect]]), or `excite design` --between twice"
        )


def require_positive(option: str, value: float | None, unit: str) -> None:
    """Raise UsageError for a number that is given and not positive and finite."""
    if value is not None and not 0 < value < float("inf"):
        raise UsageError(f"{option}: must be > 0 {unit} and finite (got {value:g})")


def machine_stem(machine: str) -> str:
    """Return the name of a machine in the names of output folders."""
    return Path(machine).stem if machine.endswith(".toml") else machine


def acceptance_notes(words: str | None) -> list[str]:
    """Return the note on doubts about logs that somebody accepted, none without words."""
    return [f'doubts about the logs were accepted: "{words}"'] if words else []


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that results depend on."""
    return {name: version(name) for name in ("excite", "casadi", "numpy", "scipy")}
