"""What is asked for, checked: machines, problems, methods, sensors. Whatever can't be had is a UsageError."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from excite.errors import UsageError

# Heavy imports happen inside, so that --help is there at once.
if TYPE_CHECKING:
    from excite.model import Model
    from excite.model.machine import Machine, Problem

LONGEST = 3600.0  # drive [s]


def build_model(name: str, flaws: bool = True) -> Model:
    """The model of a machine; without `flaws` effects that no equation of motion shows are no parameters."""
    from excite.errors import MachineError
    from excite.model import build as prediction_build
    from excite.model.machine import load_machine

    loaded = load_machine(name)
    try:
        return prediction_build(loaded, flaws)
    except MachineError as err:
        raise MachineError(f"{name}: {str(err).removeprefix(f'{loaded.name}: ')}") from None


def choose_problem(machine: Machine, name: str | None, duration: float | None) -> tuple[str, Problem]:
    """A machine's design problem, its own by default, with another duration [s] where given."""
    name = name or machine.problem
    if name is None or not machine.problems:
        raise UsageError(
            f"{machine.name} has no design problem of its own, give its machine file one ([problems.NAME])"
        )
    require_known("--problem", name, tuple(machine.problems))
    found = machine.problems[name]
    if duration is not None:
        knot = float(found.knot_s)
        if not 4 * knot <= duration <= LONGEST:
            raise UsageError(f"--duration: must be between {4 * knot:g} and {LONGEST:g} s (got {duration:g})")
        longer = found.duration_s.model_copy(update={"value": round(duration / knot) * knot})
        found = found.model_copy(update={"duration_s": longer})
    return name, found


def choose_method(name: str | None, model: Model, kit: str | None = None) -> str:
    """An estimator's name, the recommended one by default; all that it needs is measured by a kit."""
    from excite import identification

    name = name or identification.recommended(model)
    require_known("--method", name, tuple(identification.METHODS))
    if kit is not None:
        have = {s.name for s in model.machine.sensors(kit)}
        needs = identification.needed_sensors(model, name)
        missing = [s.column for s in model.machine.sensors("full") if s.name in needs and s.name not in have]
        if missing:
            raise UsageError(f"--method: {name} needs {', '.join(missing)}, which kit {kit} does not measure")
    return name


# Where the tables are of what may be given by name: a new entry is in the help, the shell's completion and the errors.
CHOICES = {
    "objective": ("excite.trajectories", "OBJECTIVES"),
    "method": ("excite.identification", "METHODS"),
    "against": ("excite.trajectories", "USUAL"),
    "kit": ("excite.simulation", "KITS"),
    "effect": ("excite.model.effects", "CATALOGUE"),
}
LISTED = 12  # names that help still lists


def choices(option: str) -> tuple[str, ...]:
    """What may be given for an option by name; nothing for an option that takes something else."""
    from importlib import import_module

    module, table = CHOICES.get(option, ("", ""))
    return tuple(getattr(import_module(module), table)) if module else ()


def helped(option: str, text: str | None) -> str:
    """An option's help with the names that may be given for it."""
    names = choices(option)
    return f"{text or ''}: {', '.join(names)}" if 0 < len(names) <= LISTED else text or ""


def require_known(what: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise UsageError(f"{what}: {value} is unknown, allowed: {', '.join(allowed)}")


def require_objective(name: str, machine: Machine) -> None:
    """Refuses a design objective that there isn't, and `discrimination` without two effects that a drive shows. Raises
    MachineError for effects that can't be had."""
    from excite.model import build
    from excite.trajectories import OBJECTIVES

    require_known("--objective", name, tuple(OBJECTIVES))
    if name != "discrimination":
        return
    model = build(machine, flaws=False)
    shown = sum(e.name in model.base.names for e in model.effects)
    if shown < 2:
        raise UsageError(
            f"--objective: discrimination: needs two effects to tell apart, {machine.name} has {shown or 'none'} that a"
            " drive shows; give its machine file two ([[effect]]), or `excite design` --between twice"
        )


def require_positive(option: str, value: float | None, unit: str) -> None:
    if value is not None and not value > 0:
        raise UsageError(f"{option}: must be > 0 {unit} (got {value:g})")


def stem(machine: str) -> str:
    """What folders of a machine are called."""
    return Path(machine).stem if machine.endswith(".toml") else machine


def versions() -> dict[str, str]:
    """Of what numbers depend on."""
    return {name: version(name) for name in ("excite", "casadi", "numpy", "scipy")}
