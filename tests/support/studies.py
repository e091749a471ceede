"""Options that every study in results/ has, and the entries of its summary that say how it was made."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from excite import output
from excite.workflows import package_versions

RESULTS = Path(__file__).parents[2] / "results"


def default_out(script: str) -> Path:
    """Return the folder that a study writes unless told otherwise: results/STUDY-rebuilt, which git ignores."""
    return RESULTS / f"{Path(script).resolve().parent.name}-rebuilt"


def parse(parser: argparse.ArgumentParser, script: str, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Add `--out` to a study's options and parse them; make the folder.

    Published results are replaced on request only: see `default_out`.
    script: `__file__` of the study. argv: arguments, those of the command line if None.
    """
    parser.add_argument("--out", type=Path, default=default_out(script), help="folder that is written")
    given = parser.parse_args(argv)
    given.out.mkdir(parents=True, exist_ok=True)
    return given


def origin(script: str, seed: int) -> dict[str, Any]:
    """Return command, seed, package versions and commit of a run of a study."""
    where = Path(script).resolve().relative_to(RESULTS.parent)
    return {
        "command": " ".join(["python", where.as_posix(), *sys.argv[1:]]),
        "seed": seed,
        "versions": package_versions(),
        "commit": output.commit(),
    }
