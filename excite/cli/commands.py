"""The commands. Heavy imports stand inside them, so that --help takes no time."""

from __future__ import annotations

import ipaddress
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from excite import workflows
from excite.cli import options, terminal
from excite.cli.options import (
    AcceptOption,
    AfterOption,
    BudgetOption,
    CommandWithChoices,
    CondSlackOption,
    DesignArgument,
    DrawingCommand,
    DurationOption,
    JsonOption,
    KitOption,
    LogsArgument,
    MachineArgument,
    MethodOption,
    ObjectiveOption,
    OutOption,
    ProblemOption,
    RobustOption,
    RunsOption,
    SeedOption,
    SigmaMaxOption,
    SolverOption,
    StartsOption,
    TrajectoryOption,
)
from excite.errors import InputError, UsageError
from excite.text import count, format_number

app = typer.Typer(
    name="excite",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


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
def _result(
    out: Path, json: bool, describe: Callable[[dict[str, Any]], None], inputs: Sequence[Path] = ()
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Give a command a folder to write into and an empty summary, and describe the summary at the end.

    Before the work the folder is checked, and the result that it will replace is named.
    """
    from excite import output

    output.check_out_folder(out, inputs)
    before = output.describe_result(out)
    if before is not None and not json:
        terminal.say(f"{out}/ will be replaced, it holds the result of {before}; to keep it, give another --out")
    summary: dict[str, Any] = {}
    with output.new_folder(out) as place:
        yield place, summary
    terminal.finish(summary, out, json, describe)


def _machine_file(machine: str) -> list[Path]:
    """Return the machine's file, which no result may replace; none for a shipped machine."""
    return [Path(machine)] if Path(machine).is_file() else []


@app.command()
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


@app.command(cls=DrawingCommand)
def design(
    machine: MachineArgument,
    problem: ProblemOption = None,
    duration: DurationOption = None,
    objective: ObjectiveOption = "cond",
    sigma_max: SigmaMaxOption = None,
    cond_slack: CondSlackOption = 12.0,
    robust: RobustOption = False,
    after: AfterOption = None,
    between: Annotated[
        list[str] | None,
        typer.Option(
            "--between",
            help="given twice or more: effects NAME[@WHERE]=MAGNITUDE that the drive must separate, such as"
            " ground_slope=0.01; `excite docs` lists effects and units",
        ),
    ] = None,
    of: Annotated[
        Path | None,
        typer.Option("--of", help="profile (.csv) or design folder of the drive that --objective prediction is about"),
    ] = None,
    target: Annotated[
        list[str] | None,
        typer.Option(
            "--target",
            help="design the fewest and shortest drives after which the worst parameter has this standard deviation, in"
            " per cent; PARAMETER=PERCENT for a single one (repeatable); with another --objective, a target of its"
            " value",
        ),
    ] = None,
    drives: Annotated[int, typer.Option("--drives", min=1, help="for --target: most drives, designed together")] = 1,
    within: Annotated[
        float | None,
        typer.Option(
            "--within", help="for --target: longest time of driving, in seconds; no drive is longer than --duration"
        ),
    ] = None,
    driver: Annotated[bool, typer.Option("--driver", help="design for a person at the levers, in phases")] = False,
    phase_min: Annotated[float, typer.Option("--phase-min", help="shortest phase for --driver, in seconds")] = 3.0,
    starts: StartsOption = 2,
    seed: SeedOption = 0,
    budget: BudgetOption = None,
    solver: SolverOption = "own",
    trajectory: TrajectoryOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Design a test drive within the machine's limits.

    Finds the torques over time that make every parameter identifiable, and states the attainable accuracy. An arm
    under gravity gets a motion of its joints with the torques that it takes.

    Example: excite design va12 --duration 30 --objective accuracy
    Example: excite design va12 --target 0.5 --drives 3
    Example: excite design ur10 --trajectory fourier
    """
    from excite.workflows import CampaignRequest, DesignRequest

    if between:
        if len(between) < 2 or objective not in ("cond", "discrimination"):
            raise UsageError("--between: give it at least twice, two effects or more, and no other --objective")
        objective = "discrimination"
    if phase_min != 3.0 and not driver:
        raise UsageError("--phase-min needs --driver as well")
    earlier, pair = tuple(after or ()), tuple(between or ())
    request = DesignRequest(
        objective,
        sigma_max,
        robust,
        earlier,
        starts,
        seed,
        budget,
        pair,
        driver,
        phase_min,
        cond_slack,
        solver,
        of,
        trajectory,
    )
    out = out or Path(f"results/design-{workflows.machine_stem(machine)}")
    inputs = [*_machine_file(machine), *(after or []), *([] if of is None else [of])]
    if target is None:
        if drives != 1 or within is not None:
            raise UsageError("--drives and --within need --target as well")
        with _result(out, json, partial(terminal.show, "design"), inputs) as (place, summary):
            summary |= workflows.design(place, machine, problem, duration, request, terminal.bar)
        return
    together = CampaignRequest(*workflows.read_targets(target), drives, within, request)
    with _result(out, json, partial(terminal.show, "campaign"), inputs) as (place, summary):
        summary |= workflows.campaign(place, machine, problem, duration, together, terminal.bar)
    if not summary["reached"]:
        raise typer.Exit(1)


@app.command(cls=DrawingCommand)
def verify(
    design_dir: DesignArgument,
    runs: RunsOption = 50,
    method: MethodOption = None,
    kit: KitOption = "full",
    seed: SeedOption = 0,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Simulate a design with sensor noise, and identify, many times.

    Gives each parameter's bias, standard deviation, and the share of 95 % intervals that hold the truth.

    Example: excite verify results/design-va12 --runs 100
    """
    from excite import trajectories

    name = trajectories.read_design_summary(design_dir)["machine"]
    out = out or Path(f"results/verify-{name}")
    with _result(out, json, partial(terminal.show, "verify"), [design_dir]) as (place, summary):
        summary |= workflows.verify(place, design_dir, runs, method, kit, seed, bar=terminal.bar)


@app.command(cls=DrawingCommand)
def compare(
    machine: MachineArgument,
    problem: ProblemOption = None,
    samples: Annotated[
        int,
        typer.Option(
            "--samples",
            "--runs",
            min=1,
            help="how many drives are drawn of each usual kind that is random; the best that keeps every limit counts",
        ),
    ] = 20,
    against: Annotated[
        list[str] | None,
        typer.Option(
            "--against",
            help="usual drive or profile (.csv) of your own to compare with (repeatable); all usual ones by default",
            autocompletion=options.names("against"),
        ),
    ] = None,
    seed: SeedOption = 0,
    budget: BudgetOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Compare the designed drive with usual ones.

    All have the same problem, limits and computing time.

    Example: excite compare va12 --against multisine --against my.csv
    """
    out = out or Path(f"results/compare-{workflows.machine_stem(machine)}")
    inputs = [*_machine_file(machine), *(Path(name) for name in against or () if Path(name).suffix)]
    with _result(out, json, partial(terminal.show, "compare"), inputs) as (place, summary):
        summary |= workflows.compare(place, machine, problem, samples, tuple(against or ()), seed, budget, terminal.bar)


@app.command(cls=DrawingCommand)
def score(
    machine: MachineArgument,
    profile: Annotated[
        Path, typer.Argument(metavar="PROFILE.csv", help="torques over time, as in a design's profile.csv")
    ],
    problem: ProblemOption = None,
    sensors: Annotated[
        bool,
        typer.Option("--sensors", help="also find what each sensor of --kit buys: left out, added, twice as accurate"),
    ] = False,
    kit: KitOption = "full",
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Judge any drive as a design is: attainable accuracy, condition numbers, limits.

    Its torques are simulated afresh. `excite verify` takes the folder as it takes a design.

    Example: excite score va12 my.csv --sensors
    """
    if kit != "full" and not sensors:
        raise UsageError("--kit needs --sensors as well: accuracy is that of all sensors")
    out = out or Path(f"results/score-{workflows.machine_stem(machine)}")
    with _result(out, json, partial(terminal.show, "score"), [*_machine_file(machine), profile]) as (place, summary):
        summary |= workflows.score(place, machine, profile, problem, sensors, kit)


@app.command(cls=DrawingCommand)
def run(
    machine: MachineArgument,
    problem: ProblemOption = None,
    duration: DurationOption = None,
    objective: ObjectiveOption = "cond",
    sigma_max: SigmaMaxOption = None,
    cond_slack: CondSlackOption = 12.0,
    robust: RobustOption = False,
    starts: StartsOption = 2,
    seed: SeedOption = 0,
    budget: BudgetOption = None,
    runs: RunsOption = 20,
    method: MethodOption = None,
    kit: KitOption = "full",
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Design a test drive and verify it.

    Example: excite run va12_straight
    """
    from excite import output, simulation
    from excite.workflows import DesignRequest

    def describe(both: dict[str, Any]) -> None:
        terminal.show("design", both["design"])
        terminal.show("verify", both["verify"])

    workflows.require_known("--kit", kit, simulation.KITS)
    workflows.choose_method(method, workflows.build_model(machine), kit)
    out = out or Path(f"results/run-{workflows.machine_stem(machine)}")
    with _result(out, json, describe, _machine_file(machine)) as (place, summary):
        designed = place / "design"
        designed.mkdir()
        request = DesignRequest(objective, sigma_max, robust, (), starts, seed, budget, cond_slack=cond_slack)
        first = workflows.design(designed, machine, problem, duration, request, terminal.bar)
        if not first["complete"] and budget is None:
            raise KeyboardInterrupt
        checked = place / "verify"
        checked.mkdir()
        second = workflows.verify(checked, designed, runs, method, kit, seed, out / "design", terminal.bar)
        summary |= {"design": first, "verify": second}
        output.write_summary(place, summary)


@app.command()
def drive(
    design_dir: DesignArgument,
    phases: Annotated[
        int | None,
        typer.Option(
            "--phases",
            min=2,
            help="at most this many phases, instructions such as 'forward at 1.2 m/s for 5 s'; as many as it takes"
            " by default",
        ),
    ] = None,
    shortest: Annotated[
        float,
        typer.Option(
            "--shortest",
            help="seconds that every phase lasts at least: a person needs about 2 s to read and follow one",
        ),
    ] = 2.0,
    need: Annotated[
        float | None,
        typer.Option(
            "--need",
            help="judge the drive by this standard deviation of the worst parameter, in per cent, instead of by the"
            " torques played back",
        ),
    ] = None,
    seed: SeedOption = 0,
    serve: Annotated[
        bool,
        typer.Option(
            "--serve",
            help="serve the driver's page with live values until Ctrl-C. The values come from --live, or from a program"
            ' that sends JSON such as {"t_s": 3.5, "v_m_s": 1.2, "JOINT_rad": 0.1} to ws://HOST:PORT/live: time, speed'
            " (needed) and the angle of each steered joint, JOINT being its name in the machine file",
        ),
    ] = False,
    live: Annotated[
        Path | None, typer.Option("--live", help="for --serve: log (.csv) that grows during the drive")
    ] = None,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="for --serve: port to listen on, 0 for any free one")
    ] = 8765,
    host: Annotated[
        str,
        typer.Option(
            "--host",
            help="for --serve: address to listen on. 127.0.0.1 serves this computer alone; 0.0.0.0 lets a phone, and"
            " anybody else on the same network, open the page and send values",
        ),
    ] = "127.0.0.1",
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Turn a design into a drive that a person can follow.

    Writes a sheet (PDF) and a page (HTML) for the driver.

    Example: excite drive results/design-va12 --serve
    """
    from excite import operator, output, trajectories

    if (live is not None or port != 8765 or host != "127.0.0.1") and not serve:
        raise UsageError("--live, --host and --port need --serve as well")
    try:
        ipaddress.ip_address(host)
    except ValueError:
        raise UsageError(f"--host {host}: is no address, give one such as 0.0.0.0 or 192.168.1.7") from None

    workflows.require_positive("--need", need, "%")
    name = trajectories.read_design_summary(design_dir)["machine"]
    out = out or Path(f"results/drive-{name}")
    with _result(out, json, partial(terminal.show, "drive"), [design_dir]) as (place, summary):
        with terminal.bar("driving") as advance:
            made = operator.prepare(trajectories.read_design(design_dir), phases, shortest, seed, advance, need)
        summary |= {"machine": name, "design": str(design_dir), "seed": seed, **operator.write(made, place)}
        summary["versions"] = workflows.package_versions()
        output.write_summary(place, summary)
    if serve:
        operator.serve(out, made, host, port, live, lambda address: typer.echo(f"{address} (Ctrl-C ends)", err=True))


@app.command(cls=CommandWithChoices)
def simulate(
    machine: MachineArgument,
    profile: Annotated[
        Path, typer.Argument(metavar="PROFILE.csv", help="torques over time, as in a design's profile.csv")
    ],
    out: Annotated[Path, typer.Option("--out", help="log to write (.csv or .parquet)")],
    seed: SeedOption = 0,
    noise: Annotated[
        str, typer.Option("--noise", help="on: sensor noise and encoder steps; off: exact signals")
    ] = "on",
    kit: KitOption = "full",
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="effect that the model lacks, NAME[@WHERE]=MAGNITUDE (repeatable), such as"
            " rolling_resistance@front_roll=30; `excite docs` lists effects, places and units",
            autocompletion=options.names("effect"),
        ),
    ] = None,
    friction: Annotated[
        str,
        typer.Option(
            "--friction",
            help="dry friction near standstill, smoothed over a rate or exact, so that joints stick",
            autocompletion=options.names("friction"),
        ),
    ] = "smoothed",
    json: JsonOption = False,
) -> None:
    """Simulate a drive and write the log that the sensors would write.

    Example: excite simulate va12 results/design-va12/profile.csv --out log.csv
    """
    from excite import output, reports, simulation
    from excite.logs import read_drive

    if noise not in ("on", "off"):
        raise UsageError(f"--noise: {noise} is unknown, allowed: on, off")
    workflows.require_known("--kit", kit, simulation.KITS)
    workflows.require_known("--friction", friction, simulation.FRICTION_LAWS)
    workflows.require_known("--out: ending", out.suffix.lower(), tuple(TABLE_WRITERS))
    model = workflows.build_model(machine)
    if out.resolve() in [path.resolve() for path in (profile, *_machine_file(machine))]:
        raise UsageError(f"--out {out}: is what the log is made from, choose another file")
    planned = read_drive(profile, model)
    nominal, model = model, workflows.with_effects(model, effect or (), len(planned.torque))
    doubts = [f"--effect {line}" for line in workflows.doubtful_effects(nominal, model)]
    with output.new_file(out) as path:
        motion = simulation.play_back(
            model, planned.torque, planned.start, planned.nu0, planned.planned, friction=friction
        )
        table = simulation.measure(model, motion, kit=kit, seed=seed, noise=noise == "on")
        TABLE_WRITERS[out.suffix.lower()](table, path)
    summary = {
        "machine": model.machine.name,
        "profile": str(profile),
        "log": str(out),
        "rows": len(table),
        "columns": list(table.columns),
        "duration_s": float(motion.t[-1]),
        "kit": kit,
        "noise": noise,
        "effects": effect or [],
        "friction": friction,
        "doubts": doubts,
        "violations": workflows.judge_limits(model, motion, placed=planned.placed),
        "share_outside_law": simulation.share_outside_law(model, motion),
        "seed": seed,
    }
    if json:
        terminal.show_json(summary)
    else:
        terminal.say(f"{out}: {count(len(table), 'row')}, {motion.t[-1]:g} s, columns {', '.join(table.columns)}")
        for line in (*doubts, *reports.describe_drive_faults(summary)):
            terminal.say(line)


@app.command(cls=DrawingCommand)
def identify(
    machine: MachineArgument,
    logs: LogsArgument,
    method: MethodOption = None,
    filtering: Annotated[
        str,
        typer.Option(
            "--filter",
            help="smoothing of noisy signals before they are differentiated; machine: cut-off frequency of the machine"
            " file, auto: chosen from the logs",
        ),
    ] = "machine",
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
    _check_logs_and_filter(logs, filtering)
    inputs = [*_machine_file(machine), *logs, *(validate or [])]
    inputs += [unloaded] if unloaded else []
    with _result(out, json, partial(terminal.show, "identify"), inputs) as (place, summary):
        summary |= workflows.identify(
            place, machine, logs, method, filtering, validate or [], terminal.bar, unloaded, accept
        )
    if summary["status"] == "invalid":
        raise typer.Exit(1)


@app.command(cls=DrawingCommand)
def predict(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="folder that `excite identify` wrote")],
    target: Annotated[
        Path,
        typer.Argument(metavar="TARGET", help="a log, or a profile.csv (its columns tell), or a design's folder"),
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
    target = target / "profile.csv" if (target / "profile.csv").is_file() else target
    with _result(out, json, partial(terminal.show, "predict"), [result, target]) as (place, summary):
        summary |= workflows.predict(place, result, target, terminal.bar)


@app.command(cls=DrawingCommand)
def diagnose(
    machine: MachineArgument,
    logs: LogsArgument,
    filtering: Annotated[
        str,
        typer.Option(
            "--filter",
            help="smoothing of noisy signals before the first guess; machine: cut-off frequency of the machine file,"
            " auto: chosen from the logs",
        ),
    ] = "machine",
    design_next: Annotated[
        bool,
        typer.Option(
            "--next", help="also design the drive that separates tied causes, into the folder next/ (minutes)"
        ),
    ] = False,
    budget: Annotated[
        float | None,
        typer.Option("--budget", help="begin nothing new after this many seconds: the best answer so far"),
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
    _check_logs_and_filter(logs, filtering)
    with _result(out, json, partial(terminal.show, "diagnose"), [*_machine_file(machine), *logs]) as (place, summary):
        summary |= workflows.diagnose(
            place, machine, logs, filtering, design_next, terminal.bar, budget, accept, false_alarms
        )


@app.command(cls=DrawingCommand)
def slip(
    table: Annotated[
        Path | None,
        typer.Argument(metavar="[TABLE]", help="forces of a wheel at some slips (.csv, .xlsx, .mat, .parquet, ...)"),
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            help="ROLE=NAME, or ROLE=-NAME for the opposite sign, of a column that is not recognised (repeatable);"
            " roles: slip, speed, rim_speed, spin, angle, load, traction, side, level",
        ),
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option("--unit", help="ROLE=UNIT where the header says none, such as slip=% or angle=deg (repeatable)"),
    ] = None,
    per: Annotated[
        str,
        typer.Option(
            "--per", help="what slips are divided by: `rim` speed as in machine files, or the `larger` of both speeds"
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
    inputs = [*([table] if table else []), *(_machine_file(machine) if machine else [])]
    with _result(out, json, partial(terminal.show, "slip"), inputs) as (place, summary):
        summary |= workflows.slip(place, table, columns, units, per, radius, soil, machine, where)


def _pairs(option: str, given: Sequence[str]) -> dict[str, str]:
    """Return the pairs of an option's NAME=VALUE. Raises UsageError."""
    for text in given:
        if not all(text.partition("=")[::2]):
            raise UsageError(f"{option}: must be ROLE=NAME (got {text})")
    return {role: value for role, _, value in (text.partition("=") for text in given)}


logs = typer.Typer(help="Check or convert a log.", rich_markup_mode=None)
app.add_typer(logs, name="log")


@logs.command("check", cls=DrawingCommand)
def check_log(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="a log (.csv, .txt, .parquet, .mat, .mf4)")],
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
    from excite import reports

    out = out or Path(f"results/log-{path.stem}")
    _write_check(
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
    if {p.resolve() for p in paths} & {path.resolve(), *(p.resolve() for p in _machine_file(machine))}:
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


def _check_logs_and_filter(logs: Sequence[Path], filtering: str) -> None:
    """Raise UsageError for a log given twice or an unknown filter."""
    from excite.identification import FILTERS

    workflows.require_known("--filter", filtering, tuple(FILTERS))
    if len({path.resolve() for path in logs}) < len(logs):
        raise UsageError("LOG: the same file is given twice, which would count it twice")


def _write_check(
    file: Path,
    out: Path,
    json: bool,
    work: Callable[[Path], dict[str, Any]],
    describe: Callable[[dict[str, Any]], None],
    faulty: int = 1,
) -> None:
    """Write and describe the check of a file; end with exit code `faulty` if anything is wrong."""
    with _result(out, json, describe, [file]) as (place, summary):
        summary |= work(place)
    if summary["faults"]:
        raise typer.Exit(faulty)


machine_files = typer.Typer(help="Start or check a machine file.", rich_markup_mode=None)
app.add_typer(machine_files, name="machine")


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
    machine_template.start(name, out, like, origin)
    if json:
        terminal.show_json({"machine": name, "file": str(out)})
    else:
        terminal.say(f"{out}: change what differs, then `excite machine check {out}`")


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
    from excite import identification, output

    if out.resolve() == origin.resolve():
        raise UsageError(f"--out {out}: is what the robot is read from, choose another file")
    saved = identification.read_estimate(result)
    if saved.estimate.status == "invalid":
        raise UsageError(f"{result}: holds no estimate: {saved.estimate.doubt}")
    text, notes = workflows.urdf_with_estimate(origin, saved.model, saved.estimate)
    with output.new_file(out) as part:
        part.write_text(text, encoding="utf-8")
    if json:
        terminal.show_json({"machine": saved.model.machine.name, "file": str(out), "notes": notes})
        return
    terminal.say(f"{out}: {count(len(saved.model.machine.body), 'link')} with identified inertia")
    for line in notes:
        terminal.say(f"- {line}")


@machine_files.command("check", cls=DrawingCommand)
def check_machine(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="a machine file (.toml)")],
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Check a machine file: everything that is wrong or doubtful, and a drawing from above.

    All faults at once, each with its line, name and key, and what was probably meant; values that look like those of
    another unit are doubtful. Ends with exit code 2 if anything is wrong.

    Example: excite machine check my_roller.toml
    """
    out = out or Path(f"results/machine-{file.stem}")
    _write_check(
        file,
        out,
        json,
        lambda place: workflows.check_machine(place, file, workflows.package_versions()),
        partial(terminal.show, "machine"),
        InputError.exit_code,
    )


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
    with _result(out, json, lambda s: terminal.say(", ".join(s["pages"]))) as (place, summary):
        summary |= {"pages": reference.write(place, app), "versions": workflows.package_versions()}
        output.write_summary(place, summary)


@app.command(cls=DrawingCommand)
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
