"""What one does with a machine: design a drive, simulate it, identify from its log, verify, report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from model.prediction import Model


def load(name: str | Path) -> Model:
    """The equations of a machine: a shipped name (`excite machines` lists them) or a machine file (.toml).

    Raises MachineError: one line with file, key, what is wrong, what is allowed.
    """
    from model import machine, prediction  # here, so that `excite --help` needs no CasADi

    return prediction.build(machine.load(name))
