"""Places of committed results and shared measurements."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SHARED = Path(__file__).parents[3] / "shared" / "data"
RESULTS = Path(__file__).parents[2] / "results"


def case(name: str) -> Path:
    """Return a file of the shared cases; the test skips where they are missing."""
    path = SHARED.parent / "cases" / name
    if not path.is_file():
        pytest.skip(f"the shared cases are not here ({path})")
    return path


def study(name: str, script: str = "study") -> ModuleType:
    """A script of a study in results/, as a module."""
    spec = importlib.util.spec_from_file_location(f"{script}_{name}", RESULTS / name / f"{script}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
