"""The program `excite` on the command line, and what its commands share: folders of results and their descriptions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from excite.cli import terminal

app = typer.Typer(name="excite", rich_markup_mode=None, pretty_exceptions_enable=False)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        terminal.say(f"excite {version('excite')}")
        raise typer.Exit


@app.callback()
def every(
    version: Annotated[
        bool, typer.Option("--version", help="print the version and end", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Design test drives for machines, simulate them, identify parameters from logs, and diagnose model errors.

    Start with `excite machines`, then `excite run MACHINE`; `excite COMMAND --help` explains each command.
    """


TABLE_WRITERS: dict[str, Callable[[Any, Path], None]] = {
    ".csv": lambda table, path: table.to_csv(path, index=False),
    ".parquet": lambda table, path: table.to_parquet(path, index=False),
}


@contextmanager
def result_folder(
    out: Path, json: bool, describe: Callable[[dict[str, Any]], None], inputs: Sequence[Path] = ()
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Give a command a folder to write into and an empty summary, and describe the summary at the end.

    The folder is checked before the work; the result that it will replace is named once the input was accepted.
    """
    from excite import output

    output.check_out_folder(out, inputs)
    before = output.describe_result(out)
    line = None
    if before is not None and not json:
        line = f"{out}/ will be replaced, it holds the result of {before}; to keep it, give another --out"
    summary: dict[str, Any] = {}
    with output.new_folder(out) as place, terminal.announcing(line):
        yield place, summary
    terminal.finish(summary, out, json, describe)


def machine_file(machine: str) -> list[Path]:
    """Return the machine's file, which no result may replace; none for a shipped machine."""
    return [Path(machine)] if Path(machine).is_file() else []


def write_check(
    file: Path,
    out: Path,
    json: bool,
    work: Callable[[Path], dict[str, Any]],
    describe: Callable[[dict[str, Any]], None],
    faulty: int = 1,
) -> None:
    """Write and describe the check of a file; end with exit code `faulty` if anything is wrong."""
    with result_folder(out, json, describe, [file]) as (place, summary):
        summary |= work(place)
    if summary["faults"]:
        raise typer.Exit(faulty)
