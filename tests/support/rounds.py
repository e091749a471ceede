"""Rounds of cases for the diagnosis: the version of the program that answered, and rows that are stored when done."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from excite.output import new_file

ROOT = Path(__file__).parents[2]

PACKAGES = ("model", "simulation", "logs", "smoothing", "identification", "trajectories", "diagnosis")


def file_hash(files: Sequence[Path]) -> str:
    """Hash the contents of files: eight digits."""
    seen = hashlib.sha1()
    for file in dict.fromkeys(files):
        seen.update(file.read_bytes())
    return seen.hexdigest()[:8]


def program_version(support: Sequence[Path]) -> str:
    """Hash the packages that a diagnosis uses, the machine files and the files that make the cases: eight digits."""
    files = [f for p in PACKAGES for f in sorted((ROOT / "excite" / p).resolve().rglob("*.py"))]
    files += sorted((ROOT / "model").rglob("*.toml"))
    return file_hash([*files, *support])


def store(file: Path, content: Any) -> None:
    """Write a row, whole or not at all."""
    with new_file(file) as part:
        part.write_text(json.dumps(content, default=float))
