"""Arguments and options that commands share, with shell completion of names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from excite import workflows
from excite.logs import ENDINGS


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


def _figure_options(
    figures: Annotated[
        str,
        typer.Option(
            "--figures",
            metavar="FORMATS",
            help="formats of the figures, such as png,svg,pdf; the png is always written, report.html shows it",
        ),
    ] = "png",
    figure_width: Annotated[
        str | None,
        typer.Option(
            "--figure-width",
            metavar="WIDTH",
            help="width of every figure in print, with its unit, such as 88mm or 8.8cm, with letters of at least 6 pt"
            " where they fit; as wide as it needs by default",
        ),
    ] = None,
) -> None:
    """Declare the options of `DrawingCommand`."""


class DrawingCommand(CommandWithChoices):
    """A command that writes figures: it takes the options of their files, its function need not know them."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        only = typer.Typer(add_completion=False)
        only.command()(_figure_options)
        own: list[Any] = [p for p in typer.main.get_command(only).params if p.name in ("figures", "figure_width")]
        before = next((k for k, p in enumerate(self.params) if p.name == "out"), len(self.params))
        self.params[before:before] = own

    def invoke(self, ctx: Any) -> Any:
        formats, width = ctx.params.pop("figures"), ctx.params.pop("figure_width")
        if formats == "png" and width is None:
            return super().invoke(ctx)
        from excite import reports

        files = reports.FigureFiles(
            reports.read_formats("--figures", formats),
            None if width is None else reports.read_width("--figure-width", width),
            lambda line: typer.echo(line, err=True),
        )
        with reports.writing_figures(files):
            return super().invoke(ctx)


class StudyCommand(DrawingCommand):
    """The command of studies, whose help lists the keys of a study file."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        from excite.cli import reference

        super().format_epilog(ctx, formatter)
        for title, rows in reference.study_keys():
            with formatter.section(title):
                formatter.write_dl(rows)


MachineArgument = Annotated[
    str,
    typer.Argument(
        metavar="MACHINE",
        help="a shipped machine (`excite machines` lists them) or a machine file (.toml)",
        autocompletion=machine_names,
    ),
]
DesignArgument = Annotated[Path, typer.Argument(metavar="DESIGN_DIR", help="folder that `excite design` wrote")]
LogsArgument = Annotated[list[Path], typer.Argument(metavar="LOG...", help=f"one log or several ({ENDINGS})")]
OutOption = Annotated[Path | None, typer.Option("--out", help="folder to write [results/<command>-<machine>]")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the summary as JSON and nothing else")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="seed of random numbers: same seed, same result")]
KitOption = Annotated[
    str,
    typer.Option(
        "--kit",
        help="which sensors the machine carries: paper has the angles, the measuring wheels and the torques, full also"
        " yaw rate and lateral speed where the machine file has them",
        autocompletion=names("kit"),
    ),
]
MethodOption = Annotated[
    str | None,
    typer.Option(
        "--method",
        help="method of identification; by default the one recommended for the machine, joint where it has contacts"
        " with the ground",
        autocompletion=names("method"),
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
TrajectoryOption = Annotated[
    str | None,
    typer.Option(
        "--trajectory",
        help="for arms under gravity, whose designs are motions of the joints: `free` (splines, the default) or"
        " `fourier` (series of five harmonics)",
        autocompletion=names("trajectory"),
    ),
]
StartsOption = Annotated[
    int,
    typer.Option(
        "--starts",
        min=1,
        help="how often the search begins anew, each time from another random drive; the best result is kept, time"
        " grows in proportion",
    ),
]
CondSlackOption = Annotated[
    float,
    typer.Option(
        "--cond-slack",
        min=0,
        help="with objective cond: allow a condition number up to this many per cent above the lowest one found, and"
        " give the most accurate of these drives; 0 gives the lowest",
    ),
]
SigmaMaxOption = Annotated[
    float | None,
    typer.Option(
        "--sigma-max", help="largest standard deviation that any parameter may have, in per cent of its nominal value"
    ),
]
RobustOption = Annotated[
    bool,
    typer.Option(
        "--robust",
        help="also keep limits and accuracy if the real machine's parameters are up to 20 % off the machine file; some"
        " accuracy is lost, the search takes longer",
    ),
]
AfterOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--after",
        help="log of a test drive done before: the new drive is designed for the machine as identified from it, and for"
        " what it left uncertain (repeatable)",
    ),
]


def positive(param: typer.CallbackParam, value: float | None) -> float | None:
    """Return the value of an option. Raises UsageError unless it is positive and finite."""
    if value is not None:
        workflows.require_positive(param.opts[0], value, "s")
    return value


BudgetOption = Annotated[
    float | None,
    typer.Option(
        "--budget",
        help="seconds of searching after which the best so far is given; no limit by default",
        callback=positive,
    ),
]
RunsOption = Annotated[
    int, typer.Option("--runs", min=1, help="number of simulated test days, each with sensor noise of its own")
]
AcceptOption = Annotated[
    str | None,
    typer.Option(
        "--accept", help="why the doubts about the logs may stand; the result keeps these words", metavar="WORDS"
    ),
]
