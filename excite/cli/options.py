"""Arguments and options that commands share, with shell completion of names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from excite import workflows


def machine_names(incomplete: str) -> list[str]:
    """Complete the name of a shipped machine, without loading any."""
    from importlib.resources import files

    found = (
        Path(p.name).stem for p in files("excite").joinpath("model", "machines").iterdir() if p.name.endswith(".toml")
    )
    return sorted(n for n in found if n.startswith(incomplete))


def names(option: str) -> Callable[[str], list[str]]:
    """Return the completion of an option that takes a name."""
    return lambda incomplete: [n for n in workflows.choices(option) if n.startswith(incomplete)]


class CommandWithChoices(typer.core.TyperCommand):
    """A command whose help lists the names that its options take."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        for p in self.params:
            if isinstance(p, typer.core.TyperOption):
                p.help = workflows.help_with_choices(p.name or "", p.help)
        super().format_help(ctx, formatter)


MachineArgument = Annotated[
    str,
    typer.Argument(
        metavar="MACHINE",
        help="a shipped machine (`excite machines` lists them) or a machine file (.toml)",
        autocompletion=machine_names,
    ),
]
DesignArgument = Annotated[Path, typer.Argument(metavar="DESIGN_DIR", help="folder that `excite design` wrote")]
LogsArgument = Annotated[
    list[Path], typer.Argument(metavar="LOG...", help="one log or several (.csv, .txt, .parquet, .mat, .mf4)")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="folder to write [results/<command>-<machine>]")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the summary as JSON and nothing else")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="seed of random numbers: same seed, same result")]
KitOption = Annotated[str, typer.Option("--kit", help="set of sensors", autocompletion=names("kit"))]
MethodOption = Annotated[
    str | None,
    typer.Option(
        "--method", help="method of identification, the recommended one by default", autocompletion=names("method")
    ),
]
ProblemOption = Annotated[
    str | None, typer.Option("--problem", help="design problem of the machine file; the machine's own by default")
]
DurationOption = Annotated[
    float | None, typer.Option("--duration", help="length of the drive, in seconds; the problem's own by default")
]
ObjectiveOption = Annotated[
    str, typer.Option("--objective", help="property of the drive to minimise", autocompletion=names("objective"))
]
SolverOption = Annotated[
    str,
    typer.Option(
        "--solver", help="solver of the search, `ipopt` for a check by another one", autocompletion=names("solver")
    ),
]
StartsOption = Annotated[int, typer.Option("--starts", min=1, help="number of starting guesses of the search")]
CondSlackOption = Annotated[
    float,
    typer.Option(
        "--cond-slack",
        min=0,
        help="with objective cond: find the most accurate drive whose cond(Phi) is at most this many per cent above the"
        " lowest one; 0 for the lowest",
    ),
]
SigmaMaxOption = Annotated[
    float | None,
    typer.Option(
        "--sigma-max", help="largest standard deviation that any parameter may have, in per cent of its nominal value"
    ),
]
RobustOption = Annotated[
    bool, typer.Option("--robust", help="design for machines up to 20 % off the machine file as well")
]
AfterOption = Annotated[
    list[Path] | None, typer.Option("--after", help="log of an earlier drive, whose information counts (repeatable)")
]
BudgetOption = Annotated[float | None, typer.Option("--budget", help="stop improving after this many seconds")]
RunsOption = Annotated[int, typer.Option("--runs", min=1, help="number of simulated test days")]
