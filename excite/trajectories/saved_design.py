"""Read a design folder back as a model and a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from excite import logs, output
from excite.errors import DesignFolderError, LogError
from excite.model import Model, build
from excite.model.machine import Machine, Problem
from excite.simulation import Motion, play_back


@dataclass(frozen=True)
class SavedDesign:
    """A design folder: its summary, model and problem, and the motion under its torques."""

    summary: dict[str, Any]
    model: Model
    problem: Problem | None
    motion: Motion

    @property
    def title(self) -> str:
        return f"{self.model.machine.title}: {self.summary.get('problem')}"


def read_design_summary(design_dir: Path) -> dict[str, Any]:
    """Read the summary of a design folder.

    Raises DesignFolderError.
    """
    path = design_dir / output.SUMMARY
    if design_dir.is_file():
        raise DesignFolderError(
            f"{design_dir}: not a design, whose folder is needed; `excite score MACHINE {design_dir.name}` makes one of"
            " any drive"
        )
    try:
        logs.drive_file(design_dir)
    except LogError as err:
        raise DesignFolderError(str(err)) from None
    if not path.is_file():
        raise DesignFolderError(
            f"{design_dir}: not a design (no {output.SUMMARY} in it), make one with `excite design MACHINE`"
        )
    try:
        found = output.read_json(path)
    except (OSError, ValueError):
        raise DesignFolderError(f"{path}: damaged or not readable, design again") from None
    whole = isinstance(found, dict) and isinstance(found.get("machine"), str) and "duration_s" in found
    if not whole or not (design_dir / "profile.csv").is_file():
        raise DesignFolderError(f"{design_dir}: not a design, make one with `excite design MACHINE`")
    return dict(found)


def read_design_model(design_dir: Path) -> Model:
    """Read the model of a design folder, with the values that the design is for. Raises DesignFolderError."""
    before = read_design_summary(design_dir)
    path = design_dir / "machine.json"
    try:
        model = build(Machine.model_validate_json(path.read_bytes()))
    except (OSError, ValueError):
        raise DesignFolderError(f"{path}: missing or damaged, design again") from None
    nominal = dict(zip(model.base.names, model.nominal.tolist(), strict=True))
    try:
        # The design may be for values identified from logs. Those of sensors alone are not in the summary.
        nominal |= {n: float(x) for n, x in before.get("nominal", {}).items()}
        float(before["duration_s"])
    except (AttributeError, TypeError, ValueError):
        raise DesignFolderError(f"{design_dir / output.SUMMARY}: damaged, design again") from None
    return replace(model, nominal=np.array([nominal[n] for n in model.base.names]))


def read_design(design_dir: Path) -> SavedDesign:
    """Read a design folder and simulate its profile.

    Raises DesignFolderError, LogError, SimulationError.
    """
    before = read_design_summary(design_dir)
    model = read_design_model(design_dir)
    seconds = float(before["duration_s"])
    drive = logs.read_drive(design_dir / "profile.csv", model)
    torque = drive.torque
    if len(torque) != round(seconds * float(model.machine.sampling_hz)) + 1:
        raise DesignFolderError(
            f"{design_dir / 'profile.csv'}: {len(torque)} rows do not make {seconds:g} s, design again"
        )
    problem = model.machine.problems.get(str(before.get("problem")))
    return SavedDesign(before, model, problem, play_back(model, torque, drive.q0, drive.nu0, drive.planned))
