"""Arguments and options that commands share, and the shell's completion of what may be given by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from excite import workflows


def machine_names(incomplete: str) -> list[str]:
    """For the shell's completion: shipped names, looked up without loading anything."""
    from importlib.resources import files

    found = (
        Path(p.name).stem for p in files("excite").joinpath("model", "machines").iterdir() if p.name.endswith(".toml")
    )
    return sorted(n for n in found if n.startswith(incomplete))


def names(option: str) -> Callable[[str], list[str]]:
    """For the shell's completion: what may be given for an option by name."""
    return lambda incomplete: [n for n in workflows.choices(option) if n.startswith(incomplete)]


class Choosing(typer.core.TyperCommand):
    """A command whose help lists what may be given by name; it takes the tables' time to load."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        for p in self.params:
            if isinstance(p, typer.core.TyperOption):
                p.help = workflows.help_with_choices(p.name or "", p.help)
        super().format_help(ctx, formatter)


MachineArgument = Annotated[
    str,
    typer.Argument(metavar="MACHINE", help="a shipped name or a machine file (.toml)", autocompletion=machine_names),
]
DesignArgument = Annotated[Path, typer.Argument(metavar="DESIGN_DIR", help="what `excite design` wrote")]
LogsArgument = Annotated[
    list[Path], typer.Argument(metavar="LOG...", help="one log or several (.csv, .txt, .parquet, .mat, .mf4)")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="folder to write [results/<command>-<machine>]")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the summary as JSON and nothing else")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="same seed, same result")]
KitOption = Annotated[str, typer.Option("--kit", help="sensors", autocompletion=names("kit"))]
MethodOption = Annotated[
    str | None,
    typer.Option("--method", help="estimator, the recommended one by default", autocompletion=names("method")),
]
ProblemOption = Annotated[str | None, typer.Option("--problem", help="design problem; the machine's own by default")]
DurationOption = Annotated[float | None, typer.Option("--duration", help="length of the drive [s]")]
ObjectiveOption = Annotated[
    str, typer.Option("--objective", help="what the drive is best for", autocompletion=names("objective"))
]
StartsOption = Annotated[int, typer.Option("--starts", min=1, help="number of starting guesses")]
SigmaMaxOption = Annotated[
    float | None, typer.Option("--sigma-max", help="what the worst parameter's standard deviation may be [%]")
]
RobustOption = Annotated[bool, typer.Option("--robust", help="for machines up to 20 % off, not the nominal one alone")]
AfterOption = Annotated[
    list[Path] | None, typer.Option("--after", help="log of an earlier drive: design for what it leaves (repeatable)")
]
BudgetOption = Annotated[float | None, typer.Option("--budget", help="stop improving after this many seconds")]
RunsOption = Annotated[int, typer.Option("--runs", min=1, help="simulated test days")]
