"""Commands about logs: check, identify, predict, diagnose, contact laws. Heavy imports stand inside them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from excite import workflows
from excite.cli import options, terminal
from excite.cli.application import TABLE_WRITERS, machine_file, result_folder, write_check
from excite.cli.options import (
    AcceptOption,
    DrawingCommand,
    JsonOption,
    LogsArgument,
    MachineArgument,
    MethodOption,
    OutOption,
)
from excite.errors import UsageError
from excite.logs import ENDINGS
from excite.text import count, format_number

commands = typer.Typer()


@commands.command(cls=DrawingCommand)
def identify(
    machine: MachineArgument,
    logs: LogsArgument,
    method: MethodOption = None,
    validate: Annotated[
        list[Path] | None, typer.Option("--validate", help="log that is predicted, not fitted (repeatable)")
    ] = None,
    unloaded: Annotated[
        Path | None,
        typer.Option(
            "--unloaded",
            help="result of `identify` without the payload of these logs: its inertia on the last body is given, too",
        ),
    ] = None,
    accept: AcceptOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Estimate the parameters, with uncertainty, from logs.

    Example: excite identify va12 log.csv --validate other.csv
    """
    from excite.model.machine import load_machine

    out = out or Path(f"results/identify-{load_machine(machine).name}")
    _require_different(logs)
    inputs = [*machine_file(machine), *logs, *(validate or [])]
    inputs += [unloaded] if unloaded else []
    with result_folder(out, json, partial(terminal.show, "identify"), inputs) as (place, summary):
        summary |= workflows.identify(place, machine, logs, method, validate or [], terminal.bar, unloaded, accept)
    if summary["status"] == "invalid":
        raise typer.Exit(1)


@commands.command(cls=DrawingCommand)
def predict(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="folder that `excite identify` wrote")],
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="a log, or a profile.csv (its columns tell), or a design's folder")
    ],
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Predict signals along another log or profile, with 95 % bands.

    Along a log: the torque of every drive, and where the readings leave it. Along a profile: the motion under its
    torques.

    Example: excite predict results/identify-va12 results/design-va12/profile.csv
    """
    from excite.identification import read_estimate

    name = read_estimate(result).model.machine.name
    out = out or Path(f"results/predict-{name}")
    with result_folder(out, json, partial(terminal.show, "predict"), [result, target]) as (place, summary):
        summary |= workflows.predict(place, result, target, terminal.bar)


@commands.command(cls=DrawingCommand)
def diagnose(
    machine: MachineArgument,
    logs: LogsArgument,
    design_next: Annotated[
        bool,
        typer.Option(
            "--next", help="also design the drive that separates tied causes, into the folder next/ (minutes)"
        ),
    ] = False,
    budget: Annotated[
        float | None,
        typer.Option(
            "--budget",
            help="begin nothing new after this many seconds: the best answer so far",
            callback=options.positive,
        ),
    ] = None,
    false_alarms: Annotated[
        int,
        typer.Option(
            "--false-alarms",
            min=0,
            help="also diagnose so many clean simulated logs of the fitted machine, and say how many get a name"
            " (some ten seconds each)",
        ),
    ] = 0,
    accept: AcceptOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Find and name what the model gets wrong along logs.

    Gives the magnitude of each cause, and how much the error falls with it in the model. Writes the machine
    file with the causes in it. Ctrl-C ends the search and keeps what was found; pressed again, it discards that.

    Example: excite diagnose va12 log.csv
    """
    from excite.model.machine import load_machine

    out = out or Path(f"results/diagnose-{load_machine(machine).name}")
    _require_different(logs)
    with result_folder(out, json, partial(terminal.show, "diagnose"), [*machine_file(machine), *logs]) as (
        place,
        summary,
    ):
        summary |= workflows.diagnose(place, machine, logs, design_next, terminal.bar, budget, accept, false_alarms)


@commands.command(cls=DrawingCommand)
def slip(
    table: Annotated[
        Path | None, typer.Argument(metavar="[TABLE]", help=f"forces of a wheel at some slips ({ENDINGS})")
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            help="ROLE=NAME, or ROLE=-NAME for the opposite sign, of a column that is not recognised (repeatable);"
            " roles: slip (taken as divided by the larger of rim and forward speed), speed, rim_speed, spin, angle,"
            " load, traction, side, level",
        ),
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option("--unit", help="ROLE=UNIT where the header says none, such as slip=% or angle=deg (repeatable)"),
    ] = None,
    per: Annotated[
        str,
        typer.Option(
            "--per",
            help="what the laws divide slip by: `rim` speed as in machine files, or the `larger` of both speeds; the"
            " table's slips are converted, and braking slips grow by it, so the law that is found depends on it",
        ),
    ] = "rim",
    radius: Annotated[float | None, typer.Option("--radius", help="of the wheel [m], for a rate of turn")] = None,
    machine: Annotated[
        str | None,
        typer.Option(
            "--machine",
            help="machine that the contact is written for; a table to paste by default",
            autocompletion=options.machine_names,
        ),
    ] = None,
    where: Annotated[str | None, typer.Option("--where", help="its wheel or roll, all by default")] = None,
    cohesion: Annotated[float | None, typer.Option("--cohesion", help="c of the soil [Pa]")] = None,
    friction_angle: Annotated[
        float | None, typer.Option("--friction-angle", help="phi of the soil, in degrees")
    ] = None,
    shear_modulus: Annotated[float | None, typer.Option("--shear-modulus", help="K of the soil [m]")] = None,
    contact_length: Annotated[float | None, typer.Option("--contact-length", help="of the patch [m]")] = None,
    width: Annotated[float | None, typer.Option("--width", help="of the patch [m]")] = None,
    load: Annotated[float | None, typer.Option("--load", help="on the patch [N]")] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Fit contact laws to a single-wheel test, or take the contact from a soil's constants.

    Says which of the catalogue's laws the table supports, by settings left out of the fit, and writes the contact for a
    machine file (contact.toml). With the six constants of the soil, their law (18) is compared with the table; without
    a table it is the result.

    Example: excite slip wheel.csv --column traction=DP_N --unit slip=% --machine va12
    """
    from math import radians

    from excite.logs import SLIP_PER
    from excite.model.mechanics import SoilConstants

    given = (cohesion, friction_angle, shear_modulus, contact_length, width, load)
    soil = None
    if any(x is not None for x in given):
        if None in given:
            raise UsageError(
                "--cohesion, --friction-angle, --shear-modulus, --contact-length, --width, --load: give all six or none"
            )
        c, phi, K, length, wide, weight = (float(x) for x in given if x is not None)
        try:
            soil = SoilConstants(c, radians(phi), K, length, wide, weight)
        except ValueError as err:
            raise UsageError(f"soil: {err}") from None
    workflows.require_known("--per", per, SLIP_PER)
    columns, units = (_pairs(option, x or []) for option, x in (("--column", column), ("--unit", unit)))
    out = out or Path(f"results/slip-{table.stem if table else 'soil'}")
    inputs = [*([table] if table else []), *(machine_file(machine) if machine else [])]
    with result_folder(out, json, partial(terminal.show, "slip"), inputs) as (place, summary):
        summary |= workflows.slip(place, table, columns, units, per, radius, soil, machine, where)


def _pairs(option: str, given: Sequence[str]) -> dict[str, str]:
    """Return the pairs of an option's NAME=VALUE. Raises UsageError."""
    for text in given:
        if not all(text.partition("=")[::2]):
            raise UsageError(f"{option}: must be ROLE=NAME (got {text})")
    return {role: value for role, _, value in (text.partition("=") for text in given)}


logs = typer.Typer(help="Check or convert a log.", rich_markup_mode=None)


@logs.command("check", cls=DrawingCommand)
def check_log(
    path: Annotated[Path, typer.Argument(metavar="FILE", help=f"a log ({ENDINGS})")],
    machine: Annotated[
        str | None, typer.Option("--machine", help="machine of the log; guessed from its columns by default")
    ] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Check a log: its columns, everything that is wrong with it, and a figure.

    Ends with exit code 1 if anything is wrong.

    Example: excite log check log.csv --machine va12
    """
    from excite import output, reports

    out = out or output.folder_of_check(Path("results"), path)
    write_check(
        path,
        out,
        json,
        lambda place: reports.check_log(place, path, machine, workflows.package_versions()),
        partial(terminal.show, "log"),
    )


@logs.command("convert")
def convert_log(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="a log of any kind that is read")],
    machine: Annotated[str, typer.Option("--machine", help="machine of the log")],
    out: Annotated[Path, typer.Option("--out", help="log to write (.parquet or .csv); several stretches get numbers")],
    si: Annotated[bool, typer.Option("--si", help="columns named after the sensors, in SI units")] = False,
    json: JsonOption = False,
) -> None:
    """Write a log as it is used: on an even grid of time, checked and repaired, in the machine file's columns.

    Identify from the log itself: where its times are uneven it also says when each count of an encoder came.

    Example: excite log convert log.mf4 --machine va12 --out log.parquet
    """
    from excite import output
    from excite.logs import convert

    workflows.require_known("--out: ending", out.suffix.lower(), tuple(TABLE_WRITERS))
    model = workflows.build_model(machine)
    tables, rate, notes = convert(model, path, si)
    numbered = [out.with_name(f"{out.stem}-{k + 1}{out.suffix}") for k in range(len(tables))]
    paths = [out] if len(tables) == 1 else numbered
    if {*map(output.real, paths)} & {output.real(path), *map(output.real, machine_file(machine))}:
        raise UsageError(f"--out {out}: is what the log is made from, choose another file")
    for table, file in zip(tables, paths, strict=True):
        with output.new_file(file) as part:
            TABLE_WRITERS[out.suffix.lower()](table, part)
    files: list[dict[str, Any]] = [
        {"path": str(file), "rows": len(table), "rate_hz": rate, "duration_s": (len(table) - 1) / rate}
        for table, file in zip(tables, paths, strict=True)
    ]
    if json:
        terminal.show_json({"machine": model.machine.name, "log": str(path), "files": files, "notes": notes})
        return
    for one in files:
        terminal.say(
            f"{one['path']}: {count(one['rows'], 'row')}, {format_number(one['duration_s'], 4)} s at"
            f" {format_number(one['rate_hz'], 4)} Hz"
        )
    for line in notes:
        terminal.say(f"- {line}")


def _require_different(logs: Sequence[Path]) -> None:
    """Raise UsageError for a log given twice."""
    from excite import output

    if len({*map(output.real, logs)}) < len(logs):
        raise UsageError("LOG: the same file is given twice, which would count it twice")
