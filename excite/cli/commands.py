"""The commands. Heavy imports happen inside them, so that --help is there at once."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from excite import workflows
from excite.cli import options, terminal
from excite.cli.options import (
    AfterOption,
    BudgetOption,
    Choosing,
    DesignArgument,
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
    StartsOption,
)
from excite.errors import UsageError

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
    """Designs test drives that make a machine tell you its parameters, verifies them, and identifies from a log."""


@contextmanager
def _result(
    out: Path, json: bool, show: Callable[[dict[str, Any]], None], inputs: Sequence[Path] = ()
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """What most commands do: before the work it is checked that the folder can be written, and said which result it
    will replace; the summary is told at the end. Given are a place to write to and the summary, still empty."""
    from excite import output

    output.check_out_folder(out, inputs)
    before = output.describe_result(out)
    if before is not None and not json:
        terminal.say(f"{out}/ will be replaced, what is there is of {before}; --out keeps both")
    summary: dict[str, Any] = {}
    with output.new_folder(out) as place:
        yield place, summary
    terminal.finish(summary, out, json, show)


def _file(machine: str) -> list[Path]:
    """The machine's file, which no result may take the place of; none of a shipped one."""
    return [Path(machine)] if Path(machine).is_file() else []


@app.command()
def machines(json: JsonOption = False) -> None:
    """Lists the machines that come with excite."""
    from excite.model import build as prediction_build
    from excite.model.machine import load_machine, shipped_machines

    rows: list[dict[str, Any]] = []
    for name in shipped_machines():
        loaded = load_machine(name)
        model = prediction_build(loaded)
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
    table = terminal.table("machine", "what it is", "problem", "parameters")
    for row in rows:
        table.add_row(row["machine"], row["title"], row["problem"] or "-", str(len(row["parameters"])))
    terminal.say(table)


@app.command(cls=Choosing)
def design(
    machine: MachineArgument,
    problem: ProblemOption = None,
    duration: DurationOption = None,
    objective: ObjectiveOption = "cond",
    sigma_max: SigmaMaxOption = None,
    robust: RobustOption = False,
    after: AfterOption = None,
    between: Annotated[
        list[str] | None,
        typer.Option("--between", help="twice: NAME[@WHERE]=AMOUNT, two effects that the drive is to tell apart"),
    ] = None,
    driver: Annotated[bool, typer.Option("--driver", help="a drive that people can follow, in phases")] = False,
    phase_min: Annotated[float, typer.Option("--phase-min", help="shortest phase for --driver [s]")] = 3.0,
    starts: StartsOption = 2,
    seed: SeedOption = 0,
    budget: BudgetOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Designs a test drive."""
    from excite import workflows
    from excite.workflows import DesignRequest

    if between:
        if len(between) != 2 or objective not in ("cond", "discrimination"):
            raise UsageError("--between: give it twice, two effects, and no other --objective")
        objective = "discrimination"
    if phase_min != 3.0 and not driver:
        raise UsageError("--phase-min is for --driver, give that too")
    known, pair = tuple(after or ()), tuple(between or ())
    brief = DesignRequest(objective, sigma_max, robust, known, starts, seed, budget, pair, driver, phase_min)
    out = out or Path(f"results/design-{workflows.machine_stem(machine)}")
    with _result(out, json, terminal.design_table, [*_file(machine), *(after or [])]) as (place, summary):
        summary |= workflows.design(place, machine, problem, duration, brief, terminal.bar)


@app.command(cls=Choosing)
def verify(
    design_dir: DesignArgument,
    runs: RunsOption = 50,
    method: MethodOption = None,
    kit: KitOption = "full",
    seed: SeedOption = 0,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Simulates a designed drive and identifies from it, many times: how true and how sure is each parameter."""
    from excite import trajectories, workflows

    name = trajectories.read_design_summary(design_dir)["machine"]
    out = out or Path(f"results/verify-{name}")
    with _result(out, json, terminal.verify_table, [design_dir]) as (place, summary):
        summary |= workflows.verify(place, design_dir, runs, method, kit, seed, bar=terminal.bar)


@app.command(cls=Choosing)
def compare(
    machine: MachineArgument,
    problem: ProblemOption = None,
    samples: Annotated[int, typer.Option("--samples", "--runs", min=1, help="of every random kind of drive")] = 20,
    against: Annotated[
        list[str] | None,
        typer.Option(
            "--against",
            help="one of the usual drives (repeatable), all by default",
            autocompletion=options.names("against"),
        ),
    ] = None,
    seed: SeedOption = 0,
    budget: BudgetOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Compares a designed drive with the usual ones on the same problem, limits and time."""
    from excite import workflows

    out = out or Path(f"results/compare-{workflows.machine_stem(machine)}")
    with _result(out, json, terminal.compare_table, _file(machine)) as (place, summary):
        summary |= workflows.compare(place, machine, problem, samples, tuple(against or ()), seed, budget, terminal.bar)


@app.command(cls=Choosing)
def run(
    machine: MachineArgument,
    problem: ProblemOption = None,
    duration: DurationOption = None,
    objective: ObjectiveOption = "cond",
    sigma_max: SigmaMaxOption = None,
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
    """Designs a test drive and verifies it, in one go."""
    from excite import output, simulation, workflows
    from excite.workflows import DesignRequest

    def show(both: dict[str, Any]) -> None:
        terminal.design_table(both["design"])
        terminal.verify_table(both["verify"])

    workflows.require_known("--kit", kit, simulation.KITS)
    workflows.choose_method(method, workflows.build_model(machine), kit)
    out = out or Path(f"results/run-{workflows.machine_stem(machine)}")
    with _result(out, json, show, _file(machine)) as (place, summary):
        designed = place / "design"
        designed.mkdir()
        brief = DesignRequest(objective, sigma_max, robust, (), starts, seed, budget)
        first = workflows.design(designed, machine, problem, duration, brief, terminal.bar)
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
        int | None, typer.Option("--phases", min=2, help="at most so many phases; as many as it takes by default")
    ] = None,
    shortest: Annotated[float, typer.Option("--shortest", help="of a phase [s]")] = 2.0,
    seed: SeedOption = 0,
    serve: Annotated[
        bool,
        typer.Option(
            "--serve",
            help="show the page with live values until Ctrl-C: of --live, or of a program that sends JSON such as"
            ' {"t_s": 3.5, "v_m_s": 1.2, "JOINT_rad": 0.1} to ws://HOST:PORT/live, JOINT the machine file\'s name of a'
            " steered joint (columns as in phases.csv); v_m_s is needed",
        ),
    ] = False,
    live: Annotated[Path | None, typer.Option("--live", help="log (.csv) that grows, for --serve")] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="for --serve; 0: any free one")] = 8765,
    host: Annotated[
        str,
        typer.Option(
            "--host",
            help="for --serve, the address to listen on: 127.0.0.1 is for this machine alone, 0.0.0.0 lets a phone on"
            " the same network open the page; anybody there can, and can send values",
        ),
    ] = "127.0.0.1",
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Turns a design into a drive that a person can follow: sheet (PDF) and page (HTML) for the driver."""
    from excite import operator, output, trajectories

    if (live is not None or port != 8765 or host != "127.0.0.1") and not serve:
        raise UsageError("--live, --host and --port are for --serve, give that too")
    try:
        ipaddress.ip_address(host)
    except ValueError:
        raise UsageError(f"--host {host}: is no address, give a number such as 0.0.0.0 or 192.168.1.7") from None

    name = trajectories.read_design_summary(design_dir)["machine"]
    out = out or Path(f"results/drive-{name}")
    with _result(out, json, terminal.drive_table, [design_dir]) as (place, summary):
        with terminal.bar("driving") as advance:
            made = operator.prepare(trajectories.read_design(design_dir), phases, shortest, seed, advance)
        summary |= {"machine": name, "design": str(design_dir), "seed": seed, **operator.write(made, place)}
        summary["versions"] = workflows.package_versions()
        output.write_summary(place, summary)
    if serve:
        operator.serve(out, made, host, port, live, lambda address: typer.echo(f"{address} (Ctrl-C ends)", err=True))


@app.command(cls=Choosing)
def simulate(
    machine: MachineArgument,
    profile: Annotated[Path, typer.Argument(metavar="PROFILE.csv", help="torques to drive")],
    out: Annotated[Path, typer.Option("--out", help="log to write (.csv or .parquet)")],
    seed: SeedOption = 0,
    noise: Annotated[str, typer.Option("--noise", help="on, or off for exact signals")] = "on",
    kit: KitOption = "full",
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="NAME[@WHERE]=AMOUNT: what else the machine does; `excite docs` lists all (repeatable)",
            autocompletion=options.names("effect"),
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Drives a profile in simulation and writes the log that the sensors would write."""
    from excite import output, simulation
    from excite.logs import read_profile
    from excite.simulation import simulate as drive

    if noise not in ("on", "off"):
        raise UsageError(f"--noise: {noise} is unknown, allowed: on, off")
    workflows.require_known("--kit", kit, simulation.KITS)
    writers = {".csv": lambda t, p: t.to_csv(p, index=False), ".parquet": lambda t, p: t.to_parquet(p, index=False)}
    workflows.require_known("--out: ending", out.suffix.lower(), tuple(writers))
    model = workflows.build_model(machine)
    if out.resolve() in [path.resolve() for path in (profile, *_file(machine))]:
        raise UsageError(f"--out {out}: is what the log is made from, choose another file")
    torque, q0, nu0 = read_profile(profile, model)
    nominal, model = model, workflows.with_effects(model, effect or (), len(torque))
    doubts = [f"--effect {line}" for line in workflows.doubtful_effects(nominal, model)]
    with output.new_file(out) as path:
        motion = drive(model, torque, q0=q0, nu0=nu0)
        table = simulation.measure(model, motion, kit=kit, seed=seed, noise=noise == "on")
        writers[out.suffix.lower()](table, path)
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
        "doubts": doubts,
        "seed": seed,
    }
    if json:
        terminal.show_json(summary)
    else:
        terminal.say(f"{out}: {len(table)} rows, {motion.t[-1]:g} s, columns {', '.join(table.columns)}")
        for line in doubts:
            terminal.say(line)


@app.command(cls=Choosing)
def identify(
    machine: MachineArgument,
    logs: LogsArgument,
    method: MethodOption = None,
    filtering: Annotated[
        str, typer.Option("--filter", help="machine: the machine file's, or auto: by evidence")
    ] = "machine",
    validate: Annotated[
        list[Path] | None, typer.Option("--validate", help="another log: how well the result predicts it (repeatable)")
    ] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Estimates the parameters, with uncertainty, from logs."""
    from excite import workflows

    model = workflows.build_model(machine)
    out = out or Path(f"results/identify-{model.machine.name}")
    _had(logs, filtering)
    with _result(out, json, terminal.identify_table, [*_file(machine), *logs, *(validate or [])]) as (place, summary):
        summary |= workflows.identify(place, machine, logs, method, filtering, validate or [], terminal.bar)


@app.command()
def diagnose(
    machine: MachineArgument,
    logs: LogsArgument,
    filtering: Annotated[
        str, typer.Option("--filter", help="of the first guess; machine: the machine file's, or auto: by evidence")
    ] = "machine",
    onward: Annotated[
        bool, typer.Option("--next", help="also design the drive that separates what is tied (folder next/; minutes)")
    ] = False,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Shows what the simulation gets wrong, names the cause, extends the machine file, measures the gain."""
    from excite import workflows
    from excite.model.machine import load_machine

    out = out or Path(f"results/diagnose-{load_machine(machine).name}")
    _had(logs, filtering)
    with _result(out, json, terminal.diagnose_table, [*_file(machine), *logs]) as (place, summary):
        summary |= workflows.diagnose(place, machine, logs, filtering, onward, terminal.bar)


logs = typer.Typer(help="What is in a log.", rich_markup_mode=None)
app.add_typer(logs, name="log")


@logs.command("check")
def check_log(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="a log (.csv, .txt, .parquet, .mat, .mf4)")],
    machine: Annotated[str | None, typer.Option("--machine", help="whose log it is; guessed by default")] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Says what is in a log and everything that is wrong with it, with a picture."""
    from excite import reports

    out = out or Path(f"results/log-{path.stem}")
    _checked(
        path,
        out,
        json,
        lambda place: reports.check_log(place, path, machine, workflows.package_versions()),
        terminal.log_table,
    )


def _had(logs: Sequence[Path], filtering: str) -> None:
    """Raises UsageError for logs or a filter that can't be had."""
    from excite.identification import FILTERS

    workflows.require_known("--filter", filtering, tuple(FILTERS))
    if len({path.resolve() for path in logs}) < len(logs):
        raise UsageError("LOG: the same file is given twice, which would count it twice")


def _checked(
    file: Path,
    out: Path,
    json: bool,
    work: Callable[[Path], dict[str, Any]],
    show: Callable[[dict[str, Any]], None],
) -> None:
    """What is wrong with a file, as a folder and on the terminal; exit code 1 where anything is."""
    with _result(out, json, show, [file]) as (place, summary):
        summary |= work(place)
    if summary["faults"]:
        raise typer.Exit(1)


machine_files = typer.Typer(help="A machine file: one to start from, what is wrong with one.", rich_markup_mode=None)
app.add_typer(machine_files, name="machine")


@machine_files.command("new")
def new_machine(
    name: Annotated[str, typer.Argument(metavar="NAME", help="of the machine")],
    like: Annotated[
        str | None,
        typer.Option(
            "--like",
            help="a shipped machine that it is but for its logger: columns and units to change",
            autocompletion=options.machine_names,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="file to write [NAME.toml]")] = None,
    json: JsonOption = False,
) -> None:
    """Writes a commented machine file to start from."""
    from excite.cli import machine_template
    from excite.model.machine import shipped_machines

    if like is not None:
        workflows.require_known("--like", like, shipped_machines())
    out = out or Path(f"{name}.toml")
    machine_template.start(name, out, like)
    if json:
        terminal.show_json({"machine": name, "file": str(out)})
    else:
        terminal.say(f"{out}: change what differs, then `excite machine check {out}`")


@machine_files.command("check")
def check_machine(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="a machine file (.toml)")],
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Says what is wrong or doubtful in a machine file, and draws the machine from above."""
    from excite import workflows

    out = out or Path(f"results/machine-{file.stem}")
    _checked(
        file,
        out,
        json,
        lambda place: workflows.check_machine(place, file, workflows.package_versions()),
        terminal.machine_table,
    )


@app.command()
def docs(out: OutOption = None, json: JsonOption = False) -> None:
    """Writes reference pages made from the code: effects, machine file, units, commands, Python interface."""
    from excite import output
    from excite.cli import reference

    out = out or Path("results/docs-excite")
    with _result(out, json, lambda s: terminal.say(", ".join(s["pages"]))) as (place, summary):
        summary |= {"pages": reference.write(place, app), "versions": workflows.package_versions()}
        output.write_summary(place, summary)


@app.command()
def study(
    file: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="what to vary, and what to do with each")],
    jobs: Annotated[int | None, typer.Option("--jobs", min=1, help="processes; every core by default")] = None,
    cluster: Annotated[
        str | None, typer.Option("--cluster", help="address of a Dask scheduler (tcp://...) to compute on")
    ] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Carries out a scripted study, or goes on with one that was interrupted."""
    from excite import workflows

    wanted = workflows.read_study(file)
    out = out or Path(f"results/study-{wanted.study.name}")
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs: the cluster's workers are as many as they are, leave --jobs or --cluster out")
    try:
        with terminal.study_bar() as tell:
            summary = workflows.run_study(wanted, out, jobs, cluster, tell)
    except (KeyboardInterrupt, typer.Abort):
        terminal.fail("interrupted; what is done is kept, the same command goes on", terminal.INTERRUPTED)
    terminal.finish(summary, out, json, terminal.study_table)
