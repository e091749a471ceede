"""Commands about drives: design, score, verify, compare, drive, simulate. Heavy imports stand inside them."""

from __future__ import annotations

import ipaddress
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from excite import workflows
from excite.cli import options, terminal
from excite.cli.application import TABLE_WRITERS, machine_file, result_folder
from excite.cli.options import (
    AfterOption,
    BudgetOption,
    CommandWithChoices,
    CondSlackOption,
    DesignArgument,
    DrawingCommand,
    DurationOption,
    JsonOption,
    KitOption,
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
from excite.errors import UsageError
from excite.text import count

commands = typer.Typer()


BetweenOption = Annotated[
    list[str] | None,
    typer.Option(
        "--between",
        help="given twice or more: effects NAME[@WHERE]=MAGNITUDE that the drive must separate, such as"
        " ground_slope=0.01; `excite docs` lists effects and units",
    ),
]
OfOption = Annotated[
    Path | None,
    typer.Option(
        "--of", help="profile (.csv), or a design's folder, of the drive that --objective prediction is about"
    ),
]
TargetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--target",
        help="design the fewest and shortest drives after which the worst parameter has this standard deviation, in"
        " per cent; PARAMETER=PERCENT for a single one (repeatable); with another --objective, a target of its"
        " value",
    ),
]
DrivesOption = Annotated[int, typer.Option("--drives", min=1, help="for --target: most drives, designed together")]
WithinOption = Annotated[
    float | None,
    typer.Option(
        "--within", help="for --target: longest time of driving, in seconds; no drive is longer than --duration"
    ),
]
PayloadOption = Annotated[
    float | None,
    typer.Option(
        "--payload",
        help="of an arm: mass in kg of a payload whose inertia, from the difference between driving without and with"
        " it, is to be accurate; limits are kept in both",
    ),
]
DriverOption = Annotated[bool, typer.Option("--driver", help="design for a person at the levers, in phases")]
PhaseMinOption = Annotated[float, typer.Option("--phase-min", help="shortest phase for --driver, in seconds")]


@commands.command(cls=DrawingCommand)
def design(
    machine: MachineArgument,
    problem: ProblemOption = None,
    duration: DurationOption = None,
    objective: ObjectiveOption = "cond",
    sigma_max: SigmaMaxOption = None,
    cond_slack: CondSlackOption = 12.0,
    robust: RobustOption = False,
    after: AfterOption = None,
    between: BetweenOption = None,
    of: OfOption = None,
    target: TargetOption = None,
    drives: DrivesOption = 1,
    within: WithinOption = None,
    payload: PayloadOption = None,
    driver: DriverOption = False,
    phase_min: PhaseMinOption = 3.0,
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
    Example: excite design ur10 --payload 3 --target 5 --drives 2
    """
    from excite.workflows import CampaignRequest, DesignRequest

    if between:
        if len(between) < 2 or objective not in ("cond", "discrimination"):
            raise UsageError("--between: give it at least twice, two effects or more, and no other --objective")
        objective = "discrimination"
    if phase_min != 3.0 and not driver:
        raise UsageError("--phase-min needs --driver as well")
    request = DesignRequest(
        objective,
        sigma_max,
        robust,
        tuple(after or ()),
        starts,
        seed,
        budget,
        tuple(between or ()),
        driver,
        phase_min,
        cond_slack,
        solver,
        of,
        trajectory,
        payload_kg=payload,
    )
    out = out or Path(f"results/design-{workflows.machine_stem(machine)}")
    inputs = [*machine_file(machine), *(after or []), *([] if of is None else [of])]
    if target is None:
        if drives != 1 or within is not None:
            raise UsageError("--drives and --within need --target as well")
        with result_folder(out, json, partial(terminal.show, "design"), inputs) as (place, summary):
            summary |= workflows.design(place, machine, problem, duration, request, terminal.bar)
        return
    together = CampaignRequest(*workflows.read_targets(target), drives, within, request)
    with result_folder(out, json, partial(terminal.show, "campaign"), inputs) as (place, summary):
        summary |= workflows.campaign(place, machine, problem, duration, together, terminal.bar)
    if not summary["reached"]:
        raise typer.Exit(1)


@commands.command(cls=DrawingCommand)
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
    with result_folder(out, json, partial(terminal.show, "verify"), [design_dir]) as (place, summary):
        summary |= workflows.verify(place, design_dir, runs, method, kit, seed, bar=terminal.bar)


@commands.command()
def handover(
    design_dir: DesignArgument,
    rate: Annotated[float | None, typer.Option("--rate", help="rows a second in the files [125]")] = None,
    slower: Annotated[
        float, typer.Option("--slower", help="how many times as slow the motion is, for a rehearsal on the machine")
    ] = 1.0,
    joints: Annotated[
        str | None,
        typer.Option("--joints", help="names of the joints for ROS, with commas between [those of the machine file]"),
    ] = None,
    bag: Annotated[bool, typer.Option("--bag", help="write a ROS 2 bag as well")] = False,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Write an arm's designed motion for its controller.

    A table at any rate, a JointTrajectory of ROS 2, for arms of six axes programs in URScript, KRL and RAPID, and a
    rehearsal that says in words what will move where.

    Example: excite handover results/design-ur10 --slower 10
    """
    from excite import trajectories

    name = trajectories.read_design_summary(design_dir)["machine"]
    out = out or Path(f"results/handover-{name}")
    with result_folder(out, json, partial(terminal.show, "handover"), [design_dir]) as (place, summary):
        summary |= workflows.hand_over(place, design_dir, rate, slower, joints, bag)


@commands.command(cls=DrawingCommand)
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
            help="usual drive, or a profile (.csv) or design's folder to compare with (repeatable); all usual ones by"
            " default",
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
    inputs = [*machine_file(machine), *(Path(name) for name in against or () if workflows.is_own_drive(name))]
    with result_folder(out, json, partial(terminal.show, "compare"), inputs) as (place, summary):
        summary |= workflows.compare(place, machine, problem, samples, tuple(against or ()), seed, budget, terminal.bar)


@commands.command(cls=DrawingCommand)
def score(
    machine: MachineArgument,
    profile: Annotated[
        Path,
        typer.Argument(metavar="PROFILE", help="torques over time (.csv), as in a design's folder, or that folder"),
    ],
    problem: ProblemOption = None,
    duration: DurationOption = None,
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
    with result_folder(out, json, partial(terminal.show, "score"), [*machine_file(machine), profile]) as (
        place,
        summary,
    ):
        summary |= workflows.score(place, machine, profile, problem, sensors, kit, duration)


@commands.command(cls=DrawingCommand)
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
    with result_folder(out, json, describe, machine_file(machine)) as (place, summary):
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


@commands.command()
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
    with result_folder(out, json, partial(terminal.show, "drive"), [design_dir]) as (place, summary):
        with terminal.bar("driving") as advance:
            made = operator.prepare(trajectories.read_design(design_dir), phases, shortest, seed, advance, need)
        summary |= {"machine": name, "design": str(design_dir), "seed": seed, **operator.write(made, place)}
        summary["versions"] = workflows.package_versions()
        output.write_summary(place, summary)
    if serve:
        operator.serve(out, made, host, port, live, lambda address: typer.echo(f"{address} (Ctrl-C ends)", err=True))


@commands.command(cls=CommandWithChoices)
def simulate(
    machine: MachineArgument,
    profile: Annotated[
        Path,
        typer.Argument(metavar="PROFILE", help="torques over time (.csv), as in a design's folder, or that folder"),
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
    from excite.logs import drive_file, read_drive

    if noise not in ("on", "off"):
        raise UsageError(f"--noise: {noise} is unknown, allowed: on, off")
    workflows.require_known("--kit", kit, simulation.KITS)
    workflows.require_known("--friction", friction, simulation.FRICTION_LAWS)
    workflows.require_known("--out: ending", out.suffix.lower(), tuple(TABLE_WRITERS))
    model = workflows.build_model(machine)
    if output.real(out) in map(output.real, (drive_file(profile), *machine_file(machine))):
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
    violations = workflows.judge_limits(model, motion, placed=planned.placed)
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
        "violations": violations,
        "excesses": workflows.excesses(model, motion, violations),
        "share_outside_law": simulation.share_outside_law(model, motion),
        "seed": seed,
    }
    if json:
        terminal.show_json(summary)
    else:
        terminal.say(f"{out}: {count(len(table), 'row')}, {motion.t[-1]:g} s, columns {', '.join(table.columns)}")
        for line in (*doubts, *reports.describe_drive_faults(summary)):
            terminal.say(line)
