"""Commands about machines: list them, start, check and write their files. Heavy imports stand inside them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from excite import workflows
from excite.cli import options, terminal
from excite.cli.application import write_check
from excite.cli.options import DrawingCommand, JsonOption, OutOption
from excite.errors import InputError, UsageError
from excite.text import count

if TYPE_CHECKING:
    from excite.identification import SavedEstimate

commands = typer.Typer()


@commands.command()
def machines(json: JsonOption = False) -> None:
    """List the machines that come with excite.

    Example: excite machines --json
    """
    from excite import reports
    from excite.model import build
    from excite.model.machine import load_machine, shipped_machines

    rows: list[dict[str, Any]] = []
    for name in shipped_machines():
        loaded = load_machine(name)
        model = build(loaded)
        rows.append(
            {
                "machine": name,
                "title": loaded.title,
                "problem": loaded.problem,
                "inputs": list(model.inputs),
                "parameters": list(model.base.names),
                "groupings": {n: g for n in model.base.names if len(g := model.base.grouping(n)) > 1},
                "invisible": list(model.base.invisible),
            }
        )
    if json:
        terminal.show_json({"machines": rows})
        return
    table = reports.text_table("machine", "what it is", "problem", "parameters")
    for row in rows:
        table.add_row(row["machine"], row["title"], row["problem"] or "-", str(len(row["parameters"])))
    terminal.say(table)


machine_files = typer.Typer(help="Start or check a machine file.", rich_markup_mode=None)


@machine_files.command("new")
def new_machine(
    name: Annotated[str, typer.Argument(metavar="NAME", help="name of the machine")],
    like: Annotated[
        str | None,
        typer.Option(
            "--like",
            help="shipped machine to begin with, such as va12 (`excite machines` lists them): for the same type of"
            " machine with another logger, whose columns and units are left to change; by default an empty form",
            autocompletion=options.machine_names,
        ),
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="shipped machine to copy whole, or a robot's .urdf file, with unit and meaning of every key",
            autocompletion=options.machine_names,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="file to write [NAME.toml]")] = None,
    json: JsonOption = False,
) -> None:
    """Write a commented machine file to start from: a roller, or a shipped machine.

    Example: excite machine new my_tandem --from tandem
    """
    from excite.cli import machine_template
    from excite.model.machine import shipped_machines

    if like is not None:
        workflows.require_known("--like", like, shipped_machines())
    if origin is not None and not machine_template.is_urdf(origin):
        workflows.require_known("--from", origin, shipped_machines())
    if like is not None and origin is not None:
        raise UsageError("--from: writes a whole file, --like one that extends another: leave one out")
    out = out or Path(f"{name}.toml")
    notes = machine_template.start(name, out, like, origin)
    _say_written(name, out, f"{out}: change what differs, then `excite machine check {out}`", notes, json)


def _say_written(machine: str, out: Path, what: str, notes: Sequence[str], json: bool) -> None:
    """Say what was written into a file for a machine, and what to know of it."""
    if json:
        terminal.show_json({"machine": machine, "file": str(out), "notes": list(notes)})
        return
    terminal.say(what)
    for line in notes:
        terminal.say(f"- {line}")


def _read_usable_estimate(result: Path) -> SavedEstimate:
    """Read the estimate in a folder. Raises UsageError for an invalid one."""
    from excite import identification

    saved = identification.read_estimate(result)
    if saved.estimate.status == "invalid":
        raise UsageError(f"{result}: holds no estimate: {saved.estimate.doubt}")
    return saved


@machine_files.command("urdf")
def write_urdf(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="folder that `excite identify` wrote")],
    origin: Annotated[Path, typer.Option("--from", help="the .urdf file that the machine file is from")],
    out: Annotated[Path, typer.Option("--out", help="URDF to write")],
    json: JsonOption = False,
) -> None:
    """Write a robot's URDF with the inertia and friction that were identified.

    Of all physically possible bodies with the identified parameters, the nearest to the machine file's are written.

    Example: excite machine urdf results/identify-my_arm --from robot.urdf --out identified.urdf
    """
    from excite import output

    if output.real(out) == output.real(origin):
        raise UsageError(f"--out {out}: is what the robot is read from, choose another file")
    saved = _read_usable_estimate(result)
    text, notes = workflows.urdf_with_estimate(origin, saved.model, saved.estimate)
    with output.new_file(out) as part:
        part.write_text(text, encoding="utf-8")
    what = f"{out}: {count(len(saved.model.machine.body), 'link')} with identified inertia"
    _say_written(saved.model.machine.name, out, what, notes, json)


@machine_files.command("model")
def write_model(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="folder that `excite identify` wrote")],
    out: Annotated[Path, typer.Option("--out", help="file to write: .urdf, .xml for MuJoCo, .fmu for FMI 3")],
    json: JsonOption = False,
) -> None:
    """Write an arm with its identified parameters for other engines: URDF, MJCF of MuJoCo, FMI 3.

    Of all physically possible bodies with the identified parameters, the nearest to the machine file's are written,
    with friction, in MJCF rotors and springs too. `machine urdf` changes the URDF that a machine file is from instead.

    Example: excite machine model results/identify-ur10 --out ur10.xml
    """
    from excite import identification, output

    if out.suffix not in workflows.MODEL_WRITERS:
        raise UsageError(
            f"--out {out}: ends in {out.suffix or 'nothing'}, allowed: {', '.join(workflows.MODEL_WRITERS)}"
        )
    saved = _read_usable_estimate(result)
    standard, far = identification.possible_standard(saved.model, saved.estimate)
    made, notes = workflows.MODEL_WRITERS[out.suffix](saved.model.machine, standard)
    notes = [*notes, *([] if far is None else [far])]
    with output.new_file(out) as part:
        part.write_bytes(made if isinstance(made, bytes) else made.encode())
    what = f"{out}: {count(len(saved.model.machine.body), 'body', 'bodies')} with identified parameters"
    _say_written(saved.model.machine.name, out, what, notes, json)


@machine_files.command("around")
def write_surroundings(
    meshes: Annotated[
        list[Path],
        typer.Argument(metavar="MESH...", help="meshes of what stands around an arm: .stl, .obj, .ply"),
    ],
    at: Annotated[
        str, typer.Option("--at", help="where their origin is in the ground's frame, in m, with commas between")
    ] = "0,0,0",
    unit: Annotated[float, typer.Option("--unit", help="metres per unit of length in the files, 0.001 for mm")] = 1.0,
    json: JsonOption = False,
) -> None:
    """Print boxes and capsules that hold what meshes show, for [world] of an arm's machine file.

    Example: excite machine around table.stl fence.stl --unit 0.001
    """
    from excite.cli import machine_template

    try:
        place = [float(x) for x in at.split(",")]
    except ValueError:
        place = []
    if len(place) != 3:
        raise UsageError(f"--at: needs three numbers with commas between, such as 0.5,0,-0.1 (got {at})")
    workflows.require_positive("--unit", unit, "m")
    each = [workflows.things_around(mesh, place, unit) for mesh in meshes]
    world = {key: [table for one in each for table in one[key]] for key in ("box", "shape")}
    if json:
        terminal.show_json(world)
        return
    terminal.say(machine_template.world_text(world))


@machine_files.command("check", cls=DrawingCommand)
def check_machine(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="a machine file (.toml)")],
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Check a machine file: everything that is wrong or doubtful, and a drawing from above.

    Of a usable one the folder also holds wiring.csv, for the person who wires the logger (columns, units, rates, signs,
    clocks), and log_template.csv, an empty log.

    All faults at once, each with its line, name and key, and what was probably meant; values that look like those of
    another unit are doubtful. Ends with exit code 2 if anything is wrong.

    Example: excite machine check my_roller.toml
    """
    out = out or Path(f"results/machine-{file.stem}")
    write_check(
        file,
        out,
        json,
        lambda place: workflows.check_machine(place, file, workflows.package_versions()),
        partial(terminal.show, "machine"),
        InputError.exit_code,
    )
