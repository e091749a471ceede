"""Calls of the functions of `import excite`: what arguments stand for, and what results and errors say of a call."""

from __future__ import annotations

import functools
import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
import pandas as pd

from excite import logs as readers, simulation
from excite.errors import ExciteError, UsageError
from excite.logs import Log, PlannedDrive
from excite.model import Model
from excite.model.machine import shipped_machines
from excite.reports import Shown
from excite.simulation import Motion
from excite.trajectories import Design

Machine = str | Path | Model
Source = str | Path | pd.DataFrame | Log
Drive = str | Path | np.ndarray | pd.DataFrame | Design | Motion

P = ParamSpec("P")
R = TypeVar("R")

CODE = re.compile(r"(`[^`]*`)")  # commands in messages, which keep their options
VALUED = re.compile(r"(?<![\w-])--([a-z][a-z-]*) (?=[A-Z]{2})")  # an option followed by what it takes
LEAST = {"runs": 1, "samples": 1, "starts": 1, "seed": 0}  # least value of arguments that are whole numbers
OPTION = re.compile(r"(?<![\w-])--([a-z][a-z-]*)")


def recorded(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with results that know their call, and errors that name arguments instead of options.

    It raises UsageError for a count that is none, by `LEAST`.
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        for name, value in inspect.signature(function).bind(*args, **kwargs).arguments.items():
            if name in LEAST and not (isinstance(value, int | np.integer) and value >= LEAST[name]):
                raise UsageError(f"{name}: must be a whole number of at least {LEAST[name]} (got {value})")
        try:
            result = function(*args, **kwargs)
        except ExciteError as err:
            err.args = (name_arguments(str(err)),)
            raise
        if isinstance(result, Shown):
            result.keep_call(format_call(function, args, kwargs))
        return result

    return call


def name_arguments(message: str) -> str:
    """Return a message with arguments in place of options: `--sigma-max` is `sigma_max`; commands stay as they are."""
    parts = CODE.split(message)
    for k in range(0, len(parts), 2):
        valued = VALUED.sub(lambda found: f"{found[1].replace('-', '_')}=", parts[k])
        parts[k] = OPTION.sub(lambda found: found[1].replace("-", "_"), valued)
    return "".join(parts)


def format_call(function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> str:
    """Return a call as it is typed: arguments that differ from their defaults, those without a text by their names."""
    signature = inspect.signature(function)
    told = []
    for name, value in signature.bind(*args, **kwargs).arguments.items():
        parameter = signature.parameters[name]
        text = _literal(value)
        if callable(value) or value is parameter.default or (text and text == _literal(parameter.default)):
            continue
        text = name if text is None else text
        told.append(text if parameter.default is parameter.empty else f"{name}={text}")
    return f"excite.{function.__name__}({', '.join(told)})"


def _literal(value: Any) -> str | None:
    """Return a value as it is typed, None for one that has no text: tables, arrays, results."""
    if isinstance(value, Model):
        return json.dumps(value.machine.name) if value.machine.name in shipped_machines() else None
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False)
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        parts = [_literal(one) for one in value]
        return None if None in parts else f"[{', '.join(map(str, parts))}]"
    if isinstance(value, dict):
        values = [_literal(one) for one in value.values()]
        pairs = [f"{_literal(key)}: {one}" for key, one in zip(value, values, strict=True)]
        return None if None in values else f"{{{', '.join(pairs)}}}"
    return None


def as_given(machine: Machine) -> str | Model:
    return machine if isinstance(machine, Model) else str(machine)


def name_of(given: object, otherwise: str) -> str:
    """Return what a log or drive is called: its path, or a word for one that has none."""
    return str(given) if isinstance(given, str | Path) else otherwise


def as_list(logs: Source | Sequence[Source]) -> list[Source]:
    return [logs] if isinstance(logs, str | Path | pd.DataFrame | Log) else list(logs)


def prediction_target(model: Model, target: Source | Drive) -> Source | PlannedDrive:
    """Return what a prediction is along: a log or profile as it is, any other drive with its planned motion."""
    if isinstance(target, np.ndarray | Design | Motion):
        return planned_drive(model, target)
    return target


def planned_drive(model: Model, drive: Drive, any_rate: bool = False) -> PlannedDrive:
    """Return the torques of a drive, the state at its start and the motion that it expects.

    any_rate: as for `excite.logs.read_drive`.
    """
    if isinstance(drive, np.ndarray):
        if drive.ndim != 2 or len(drive) < 2 or drive.shape[1] != len(model.inputs):
            wanted = f"(N >= 2, {len(model.inputs)}) for {', '.join(model.inputs)}"
            raise UsageError(f"drive: torques need shape {wanted} (got {drive.shape})")
        rest = np.zeros(len(model.coordinates))
        return PlannedDrive(drive, rest, rest, placed=False)
    if isinstance(drive, Design):
        drive = drive.motion
    if isinstance(drive, Motion):
        return PlannedDrive(drive.u, drive.q[0], drive.nu[0], drive.q, drive.nu)
    return readers.read_drive(drive, model, any_rate)


def motion_of(model: Model, drive: Drive) -> Motion:
    given = planned_drive(model, drive)
    return simulation.play_back(model, given.torque, given.q0, given.nu0, given.planned)
