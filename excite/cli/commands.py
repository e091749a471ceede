"""All commands, in the order of the help; here those of the window, the reference and studies.

Heavy imports stand inside the commands, so that --help takes no time.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from excite import workflows
from excite.cli import design_commands, log_commands, machine_commands, terminal
from excite.cli.application import app as app, result_folder
from excite.cli.options import JsonOption, OutOption, StudyCommand
from excite.errors import UsageError

for part in (machine_commands, design_commands, log_commands):  # in the order of the help
    app.registered_commands.extend(part.commands.registered_commands)
app.add_typer(log_commands.logs, name="log")
app.add_typer(machine_commands.machine_files, name="machine")


@app.command(name="app")
def open_window(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="folder of the day's results")] = Path("results"),
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="port, 0 for any free one")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="open the page in the browser")] = True,
    json: JsonOption = False,
) -> None:
    """Open one window for the whole test day: machine, design, drive, log, identify, diagnose.

    Serves a page on this computer alone, until Ctrl-C; its address holds a key without which nothing is answered. Each
    step runs the command of its name and shows the folder that it writes, so the window and the commands take turns.

    Example: excite app results
    """
    from excite import app as window

    def ready(address: str) -> None:
        if json:
            terminal.show_json({"address": address, "folder": str(folder)})
            sys.stdout.flush()
        else:
            typer.echo(f"{address} (Ctrl-C ends)", err=True)

    try:
        window.serve(folder, port, browser, ready)
    except ModuleNotFoundError as err:
        if (err.name or "").partition(".")[0] not in ("nicegui", "fastapi", "uvicorn"):
            raise
        raise UsageError("excite app needs NiceGUI: pip install 'excite[app]'") from None


@app.command()
def docs(out: OutOption = None, json: JsonOption = False) -> None:
    """Write the reference pages.

    Effects, machine file, units, study file, commands, Python interface.

    Example: excite docs --out reference
    """
    from excite import output
    from excite.cli import reference

    out = out or Path("results/docs-excite")
    with result_folder(out, json, lambda s: terminal.say(", ".join(s["pages"]))) as (place, summary):
        summary |= {"pages": reference.write(place, app), "versions": workflows.package_versions()}
        output.write_summary(place, summary)


@app.command(cls=StudyCommand)
def study(
    file: Annotated[
        Path, typer.Argument(metavar="STUDY.toml", help="study file: what to vary and what to do (see `excite docs`)")
    ],
    jobs: Annotated[int | None, typer.Option("--jobs", min=1, help="number of processes; all cores by default")] = None,
    cluster: Annotated[
        str | None, typer.Option("--cluster", help="address of a Dask scheduler (tcp://HOST:PORT) to compute on")
    ] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Carry out a study of many runs, or resume it.

    Example: excite study study.toml --jobs 4
    """
    wanted = workflows.read_study(file)
    out = out or Path(f"results/study-{wanted.study.name}")
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs: a cluster has its own number of workers, leave --jobs or --cluster out")
    try:
        with terminal.study_bar() as tell:
            summary = workflows.run_study(wanted, out, jobs, cluster, tell)
    except (KeyboardInterrupt, typer.Abort):
        terminal.fail("interrupted; finished runs are kept, the same command resumes", terminal.INTERRUPTED)
    terminal.finish(summary, out, json, partial(terminal.show, "study"))
