"""The command line. Heavy imports happen inside the commands, so that --help is there at once."""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

# One BLAS thread: our matrices are small, and threads turn a 0.3 ms eigenproblem into 100 ms.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402

from excite import interrupt, terminal  # noqa: E402

if TYPE_CHECKING:
    from excite.brief import Brief
    from excite.identify import Estimate
    from excite.log import Log
    from model.machine import Filter, Machine, Problem
    from model.prediction import Model

app = typer.Typer(
    name="excite",
    help="Designs test drives that make a machine tell you its parameters, verifies them, and identifies from a log.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _machine_names(incomplete: str) -> list[str]:
    """For the shell's completion: shipped names, looked up without loading anything."""
    from importlib.resources import files

    names = (Path(p.name).stem for p in files("model").joinpath("machines").iterdir() if p.name.endswith(".toml"))
    return sorted(n for n in names if n.startswith(incomplete))


MachineArgument = Annotated[
    str,
    typer.Argument(metavar="MACHINE", help="a shipped name or a machine file (.toml)", autocompletion=_machine_names),
]
DesignArgument = Annotated[Path, typer.Argument(metavar="DESIGN_DIR", help="what `excite design` wrote")]
OutOption = Annotated[Path | None, typer.Option("--out", help="folder to write [results/<command>-<machine>]")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the summary as JSON and nothing else")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="same seed, same result")]
KitOption = Annotated[str, typer.Option("--kit", help="sensors: paper or full")]
MethodOption = Annotated[str | None, typer.Option("--method", help="estimator; the recommended one by default")]
ProblemOption = Annotated[str | None, typer.Option("--problem", help="design problem; the machine's own by default")]
DurationOption = Annotated[float | None, typer.Option("--duration", help="length of the drive [s]")]
ObjectiveOption = Annotated[str, typer.Option("--objective", help="what the drive is best for")]
StartsOption = Annotated[int, typer.Option("--starts", min=1, help="number of starting guesses")]
SigmaMaxOption = Annotated[
    float | None, typer.Option("--sigma-max", help="what the worst parameter's standard deviation may be [%]")
]
RobustOption = Annotated[
    bool, typer.Option("--robust", help="for every machine within 20 %, not the nominal one alone")
]
AfterOption = Annotated[
    list[Path] | None, typer.Option("--after", help="log of an earlier drive: design for what it leaves (repeatable)")
]
BudgetOption = Annotated[float | None, typer.Option("--budget", help="stop improving after this many seconds")]
RunsOption = Annotated[int, typer.Option("--runs", min=1, help="simulated test days")]


INTERRUPTED = 130  # exit code of Ctrl-C, as shells have it


class UsageError(ValueError):
    """Something asked for on the command line that can't be had: exit 2."""


@app.command()
def machines(json: JsonOption = False) -> None:
    """Lists the machines that come with excite."""
    from model import machine, prediction

    rows: list[dict[str, Any]] = []
    for name in machine.shipped():
        loaded = machine.load(name)
        model = prediction.build(loaded)
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


@app.command()
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
    from excite import folder
    from excite.brief import Brief

    out = out or Path(f"results/design-{_stem(machine)}")
    folder.claim(out, after or [])
    if between:
        if len(between) != 2 or objective not in ("cond", "discrimination"):
            raise UsageError("--between: give it twice, two effects, and no other --objective")
        objective = "discrimination"
    if phase_min != 3.0 and not driver:
        raise UsageError("--phase-min is for --driver, give that too")
    known, pair = tuple(after or ()), tuple(between or ())
    brief = Brief(objective, sigma_max, robust, known, starts, seed, budget, pair, driver, phase_min)
    with folder.writing(out) as place:
        summary = _design(place, machine, problem, duration, brief)
    terminal.finish(summary, out, json, terminal.design_table)


@app.command()
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
    from excite import folder, stored

    name = stored.summary(design_dir)["machine"]
    out = out or Path(f"results/verify-{name}")
    folder.claim(out, [design_dir])
    with folder.writing(out) as place:
        summary = _verify(place, design_dir, runs, method, kit, seed)
    terminal.finish(summary, out, json, terminal.verify_table)


@app.command()
def compare(
    machine: MachineArgument,
    problem: ProblemOption = None,
    samples: Annotated[int, typer.Option("--samples", "--runs", min=1, help="of every random kind of drive")] = 20,
    seed: SeedOption = 0,
    budget: BudgetOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Compares a designed drive with the usual ones on the same problem, limits and time."""
    from excite import folder

    out = out or Path(f"results/compare-{_stem(machine)}")
    folder.claim(out)
    with folder.writing(out) as place:
        summary = _compare(place, machine, problem, samples, seed, budget)
    terminal.finish(summary, out, json, terminal.compare_table)


@app.command()
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
    from excite import folder
    from excite.brief import Brief

    out = out or Path(f"results/run-{_stem(machine)}")
    folder.claim(out)
    with folder.writing(out) as place:
        designed = place / "design"
        designed.mkdir()
        brief = Brief(objective, sigma_max, robust, (), starts, seed, budget)
        first = _design(designed, machine, problem, duration, brief)
        if not first["complete"] and budget is None:
            raise KeyboardInterrupt
        checked = place / "verify"
        checked.mkdir()
        second = _verify(checked, designed, runs, method, kit, seed)
        summary = {"design": first, "verify": second}
        (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")

    def show(both: dict[str, Any]) -> None:
        terminal.design_table(both["design"])
        terminal.verify_table(both["verify"])

    terminal.finish(summary, out, json, show)


@app.command()
def drive(
    design_dir: DesignArgument,
    phases: Annotated[
        int | None, typer.Option("--phases", min=2, help="at most so many phases; as many as it takes by default")
    ] = None,
    shortest: Annotated[float, typer.Option("--shortest", help="of a phase [s]")] = 2.0,
    seed: SeedOption = 0,
    serve: Annotated[bool, typer.Option("--serve", help="show the page with live values until Ctrl-C")] = False,
    live: Annotated[Path | None, typer.Option("--live", help="log (.csv) that grows, for --serve")] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="for --serve; 0: any free one")] = 8765,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Turns a design into a drive that a person can follow: sheet (PDF) and page (HTML) for the driver."""
    from excite import cab, folder, stored

    if (live is not None or port != 8765) and not serve:
        raise UsageError("--live and --port are for --serve, give that too")

    name = stored.summary(design_dir)["machine"]
    out = out or Path(f"results/drive-{name}")
    folder.claim(out, [design_dir])
    with folder.writing(out) as place:
        with terminal.bar("driving") as advance:
            made = cab.prepare(stored.read(design_dir), phases, shortest, seed, advance)
        summary = {"machine": name, "design": str(design_dir), "seed": seed, **cab.write(made, place)}
        summary["versions"] = _versions()
        (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")
    terminal.finish(summary, out, json, terminal.drive_table)
    if serve:
        cab.serve(out, made, port, live, lambda address: typer.echo(f"{address} (Ctrl-C ends)", err=True))


@app.command()
def simulate(
    machine: MachineArgument,
    profile: Annotated[Path, typer.Argument(metavar="PROFILE.csv", help="torques to drive")],
    out: Annotated[Path, typer.Option("--out", help="log to write (.csv or .parquet)")],
    seed: SeedOption = 0,
    noise: Annotated[str, typer.Option("--noise", help="on, or off for exact signals")] = "on",
    kit: KitOption = "full",
    effect: Annotated[
        list[str] | None, typer.Option("--effect", help="NAME[@WHERE]=AMOUNT: what else the machine does (repeatable)")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Drives a profile in simulation and writes the log that the sensors would write."""
    from excite import folder, log, sensors
    from excite.simulate import simulate as drive
    from model import effects
    from model.prediction import build

    if noise not in ("on", "off"):
        raise UsageError(f"--noise: {noise} is unknown, allowed: on, off")
    _known("--kit", kit, sensors.KITS)
    writers = {".csv": lambda t, p: t.to_csv(p, index=False), ".parquet": lambda t, p: t.to_parquet(p, index=False)}
    _known("--out: ending", out.suffix.lower(), tuple(writers))
    model = _model(machine)
    torque, q0, nu0 = log.read_profile(profile, model)
    if effect:
        seconds = (len(torque) - 1) / float(model.machine.sampling_hz)
        entries = [effects.parse(text, model.machine, seconds) for text in effect]
        model = build(effects.extended(model.machine, *entries))
    with folder.writing_file(out) as path:
        motion = drive(model, torque, q0=q0, nu0=nu0)
        table = sensors.measure(model, motion, kit=kit, seed=seed, noise=noise == "on")
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
        "seed": seed,
    }
    if json:
        terminal.show_json(summary)
    else:
        terminal.say(f"{out}: {len(table)} rows, {motion.t[-1]:g} s, columns {', '.join(table.columns)}")


@app.command()
def identify(
    machine: MachineArgument,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="one log or several (.csv, .parquet, .mat)")],
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
    from excite import crosscheck, examine, folder, gaps, identify, log, report, reports

    model = _model(machine)
    out = out or Path(f"results/identify-{model.machine.name}")
    folder.claim(out, [*logs, *(validate or [])])
    if len({path.resolve() for path in logs}) < len(logs):
        raise UsageError("LOG: the same file is given twice, which would count it twice")
    method = _method(method, model)
    _known("--filter", filtering, ("machine", "auto"))
    needs = identify.needed_sensors(model, method)
    parts = [gaps.read(path, model.machine, needs) for path in logs]
    read, cut = [one for some, _ in parts for one in some], [note for _, notes in parts for note in notes]
    fresh = [log.read(path, model.machine, needs) for path in validate or []]
    with terminal.busy("identifying"):
        chosen, reason = examine.choose(model, read) if filtering == "auto" else (model.machine.filter, "")
        estimate = identify.identify(model, read, method, chosen)
        if model.slips and method.partition("+")[0] in ("ols", "wls"):  # slips measured with noise bias these
            estimate = identify.with_bias(model, read, estimate, chosen)
        late = [remark for one in read for remark in examine.late_channels(model, one, chosen)]
    checks = [_check(model, one, estimate, chosen) for one in fresh]
    with folder.writing(out) as place:
        summary = {
            "machine": model.machine.name,
            "logs": [one.source for one in read],
            "method": estimate.method,
            "parameters": _parameters(estimate),
            "cond_w": estimate.cond_w,
            "cond_phi": estimate.cond_phi,
            "relative_error_percent": estimate.relative_error_percent,
            "unidentifiable": list(estimate.unidentifiable),
            "reasons": dict(estimate.unidentifiable),
            "notes": [*cut, *([reason] if reason else []), *estimate.notes, *late],
            "validation": checks,
            "versions": _versions(),
        }
        for kind, several in (("fit", read), ("validation", fresh)):
            for k, one in enumerate(several):
                title = f"{model.machine.title}: {one.source}"
                figure = report.comparison_figure(model, crosscheck.torques(model, one, estimate, chosen), title)
                report.save(figure, place / (f"{kind}-{k + 1}.png" if len(several) > 1 else f"{kind}.png"))
        reports.write(place, "identify", summary)
        (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")
    terminal.finish(summary, out, json, terminal.identify_table)


@app.command()
def diagnose(
    machine: MachineArgument,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="one log or several (.csv, .parquet, .mat)")],
    filtering: Annotated[
        str, typer.Option("--filter", help="of the first guess; machine: the machine file's, or auto: by evidence")
    ] = "machine",
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Shows what the simulation gets wrong, names the cause, extends the machine file, measures the gain."""
    from excite import checkup, folder

    model = _model(machine)
    out = out or Path(f"results/diagnose-{model.machine.name}")
    folder.claim(out, logs)
    if len({path.resolve() for path in logs}) < len(logs):
        raise UsageError("LOG: the same file is given twice, which would count it twice")
    _known("--filter", filtering, ("machine", "auto"))
    with folder.writing(out) as place, terminal.bar("diagnosing") as advance:
        summary = checkup.write(place, machine, model, logs, filtering, _versions(), advance)
    terminal.finish(summary, out, json, terminal.diagnose_table)


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
    _checked(path, out, json, lambda place: reports.check_log(place, path, machine, _versions()), terminal.log_table)


def _checked(
    file: Path,
    out: Path,
    json: bool,
    work: Callable[[Path], dict[str, Any]],
    show: Callable[[dict[str, Any]], None],
) -> None:
    """What is wrong with a file, as a folder and on the terminal; exit code 1 where anything is."""
    from excite import folder

    folder.claim(out, [file])
    with folder.writing(out) as place:
        summary = work(place)
    terminal.finish(summary, out, json, show)
    if summary["faults"]:
        raise typer.Exit(1)


machine_files = typer.Typer(help="A machine file: one to start from, what is wrong with one.", rich_markup_mode=None)
app.add_typer(machine_files, name="machine")


@machine_files.command("new")
def new_machine(
    name: Annotated[str, typer.Argument(metavar="NAME", help="of the machine")],
    out: Annotated[Path | None, typer.Option("--out", help="file to write [NAME.toml]")] = None,
    json: JsonOption = False,
) -> None:
    """Writes a commented machine file to start from."""
    from excite import machinecheck

    out = out or Path(f"{name}.toml")
    machinecheck.start(name, out)
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
    from excite import machinecheck

    out = out or Path(f"results/machine-{file.stem}")
    _checked(file, out, json, lambda place: machinecheck.write(place, file, _versions()), machinecheck.show)


@app.command()
def docs(out: OutOption = None, json: JsonOption = False) -> None:
    """Writes reference pages made from the code: effects, machine file, units, commands, Python interface."""
    from excite import folder, reference

    out = out or Path("results/docs-excite")
    folder.claim(out)
    with folder.writing(out) as place:
        summary = {"pages": reference.write(place), "versions": _versions()}
        (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")
    terminal.finish(summary, out, json, lambda s: terminal.say(", ".join(s["pages"])))


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
    from excite import plan
    from excite import study as studies

    wanted = plan.read(file)
    out = out or Path(f"results/study-{wanted.study.name}")
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs: the cluster's workers are as many as they are, leave --jobs or --cluster out")
    try:
        with terminal.study_bar() as tell:
            summary = studies.carry(wanted, out, jobs, cluster, tell)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted; what is done is kept, the same command goes on", INTERRUPTED)
    terminal.finish(summary, out, json, terminal.study_table)


# ------------------------------------------------------------------------------------------------ the work


def _design(place: Path, machine: str, problem: str | None, duration: float | None, brief: Brief) -> dict[str, Any]:
    import time

    from excite import folder, log, report, reports
    from excite.brief import answer, rivals
    from excite.brief import summary as said
    from excite.objective import OBJECTIVES

    model = _model(machine, flaws=False)
    name, chosen = _problem(model.machine, problem, duration)
    _known("--objective", brief.objective, tuple(OBJECTIVES))
    if brief.between:
        model = rivals(model, brief.between, float(chosen.duration_s))
    elif brief.objective == "discrimination" and len(model.effects) < 2:
        raise UsageError("--objective discrimination: needs two effects to tell apart, give --between twice")
    for option, value, unit in (("--budget", brief.budget_s, "s"), ("--sigma-max", brief.sigma_max, "%")):
        if value is not None and not value > 0:
            raise UsageError(f"{option}: must be > 0 {unit} (got {value:g})")
    begin = time.perf_counter()
    with terminal.bar("designing") as advance:
        found = answer(model, chosen, brief, advance)
    wall = time.perf_counter() - begin
    log.profile(found.model, found.design.motion).to_csv(place / "profile.csv", index=False)
    (place / "machine.json").write_text(model.machine.model_dump_json(indent=1) + "\n", encoding="utf-8")
    summary: dict[str, Any] = {
        "machine": model.machine.name,
        "problem": name,
        "duration_s": float(chosen.duration_s),
        **said(brief, found),
        "wall_s": wall,
        "versions": _versions(),
    }
    title = f"{model.machine.title}: {name}, cond(Phi) = {found.design.cond_phi:.2f}"
    report.save(report.design_figure(found.model, chosen, found.design.motion, title), place / "design.png")
    report.save(report.sigma_figure(summary["sigma_percent"], title), place / "sigma.png")
    reports.write(place, "design", summary)
    (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")
    return summary


def _verify(place: Path, design_dir: Path, runs: int, method: str | None, kit: str, seed: int) -> dict[str, Any]:
    from excite import folder, identify, report, reports, sensors, stored
    from excite.verify import biased, verify
    from excite.verify import summary as table

    _known("--kit", kit, sensors.KITS)
    design = stored.read(design_dir)
    if design.summary.get("after"):
        raise UsageError(
            f"{design_dir}: was designed for the machine that {', '.join(design.summary['after'])} told of, not for the"
            " machine file's; verify a design made without --after"
        )
    model, motion = design.model, design.motion
    method = _method(method, model)
    _check_needs(model, method, kit)
    with terminal.bar("verifying") as advance:
        result = verify(model, motion, method, kit, runs, seed, progress=lambda done, total: advance(done, total, None))
    if len(result.failures) == runs:
        raise identify.NotIdentifiable(f"all {runs} runs failed, the first one: {result.failures[0]}")
    parameters = table(result)
    summary = {
        "machine": model.machine.name,
        "problem": design.summary.get("problem"),
        "design": str(design_dir),
        "runs": runs,
        "method": method,
        "kit": kit,
        "seed": seed,
        "failed": len(result.failures),
        "failures": result.failures,
        "parameters": parameters,
        "biased": biased(parameters),
        "versions": _versions(),
    }
    title = f"{model.machine.title}: {runs} simulated runs, {method}, kit {kit}"
    report.save(report.verify_figure(result, title), place / "verify.png")
    reports.write(place, "verify", summary)
    (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")
    return summary


def _compare(
    place: Path, machine: str, problem: str | None, samples: int, seed: int, budget: float | None
) -> dict[str, Any]:
    import pandas as pd

    from excite import compare, folder, report, reports

    model = _model(machine, flaws=False)
    name, chosen = _problem(model.machine, problem, None)
    if budget is not None and not budget > 0:
        raise UsageError(f"--budget: must be > 0 s (got {budget:g})")
    with terminal.bar("comparing") as advance:
        result = compare.compare(model, chosen, samples, seed, budget, advance)
    columns = ["t_s", *[f"{u}_{'Nm' if b.joint == 'revolute' else 'N'}" for u, b in _inputs(model)]]
    (place / "drives").mkdir()
    designs = []
    for row in result.rows:
        knots = f"drives/{row.name.replace(',', '').replace(' ', '-')}.csv"
        table = pd.DataFrame([[t, *u] for t, u in zip(row.manoeuvre.times, row.manoeuvre.torque, strict=True)])
        table.to_csv(place / knots, index=False, header=columns, float_format="%.12g")
        designs.append(
            {
                "name": row.name,
                "cond_phi": row.cond_phi,
                "cond_w": row.cond_w,
                "worst_std_percent": row.worst_std_percent,
                "median_std_percent": row.median_std_percent,
                "max_violation": row.max_violation,
                "breaks": row.breaks,
                "kept": row.kept,
                "samples": row.samples,
                "wall_s": row.wall_s,
                "equal_score_s": row.equal_s,
                "knots": knots,
                "start": dict(zip(model.coordinates, row.start, strict=True)),
            }
        )
    summary = {
        "machine": model.machine.name,
        "problem": name,
        "objective": "cond",
        "samples": samples,
        "seed": seed,
        "budget_s": budget,
        "designs": designs,
        "ratio_equal_time": result.ratio_equal_time,
        "versions": _versions(),
    }
    title = f"{model.machine.title}: {name}, the designed drive and the usual ones"
    report.save(report.compare_figure(result.rows, title), place / "compare.png")
    reports.write(place, "compare", summary)
    (place / folder.SUMMARY).write_text(folder.dump(summary), encoding="utf-8")
    return summary


def _inputs(model: Model) -> list[tuple[str, Any]]:
    return list(zip(model.inputs, model.machine.actuated, strict=True))


def _parameters(estimate: Estimate) -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    for k, (name, unit) in enumerate(zip(estimate.names, estimate.units, strict=True)):
        rows[name] = {
            "unit": unit,
            "value": estimate.value[k],
            "std": estimate.std[k],
            "std_percent": estimate.std_percent[k],
        }
        if estimate.bias is not None and estimate.bias_std is not None:
            rows[name] |= {"bias": estimate.bias[k], "bias_std": estimate.bias_std[k]}
    return rows


def _check(model: Model, one: Log, estimate: Estimate, chosen: Filter) -> dict[str, Any]:
    """How well an estimate predicts a log that it was not fitted on: torques, and signals by direct simulation."""
    from excite import crosscheck
    from excite.simulate import SimulationError

    torques = crosscheck.torques(model, one, estimate, chosen)
    shown: dict[str, Any] = {
        "log": one.source,
        "torque_error_percent": dict(zip(torques.names, torques.percent, strict=True)),
    }
    try:
        signals = crosscheck.motions(model, one, estimate, chosen)
    except (ValueError, SimulationError) as err:
        return shown | {"simulation": f"not possible: {err}"}
    return shown | {
        "simulation_rms": {
            n: {"rms": r, "unit": u} for n, r, u in zip(signals.names, signals.rms, signals.units, strict=True)
        }
    }


def _check_needs(model: Model, method: str, kit: str) -> None:
    from excite import identify

    have = {s.name for s in model.machine.sensors(kit)}
    missing = [
        s.column
        for s in model.machine.sensors("full")
        if s.name in identify.needed_sensors(model, method) and s.name not in have
    ]
    if missing:
        raise UsageError(
            f"--method {method} needs {', '.join(missing)}, which kit {kit} does not measure; try --kit full"
        )


def _model(name: str, flaws: bool = True) -> Model:
    """The model of a machine; without `flaws` effects that no equation of motion shows are no parameters."""
    from model import machine, prediction

    loaded = machine.load(name)
    try:
        return prediction.build(loaded, flaws)
    except machine.MachineError as err:
        raise machine.MachineError(f"{name}: {str(err).removeprefix(f'{loaded.name}: ')}") from None


def _problem(machine: Machine, name: str | None, duration: float | None) -> tuple[str, Problem]:
    name = name or machine.problem
    if name is None:
        raise UsageError(
            f"{machine.name} has no design problem of its own, give its machine file one ([problems.NAME])"
        )
    _known("--problem", name, tuple(machine.problems))
    problem = machine.problems[name]
    if duration is not None:
        if not 4 * float(problem.knot_s) <= duration <= 3600:
            raise UsageError(f"--duration: must be between {4 * float(problem.knot_s):g} and 3600 s (got {duration:g})")
        steps = round(duration / float(problem.knot_s))
        longer = problem.duration_s.model_copy(update={"value": steps * float(problem.knot_s)})
        problem = problem.model_copy(update={"duration_s": longer})
    return name, problem


def _method(method: str | None, model: Model) -> str:
    from excite import identify

    method = method or identify.recommended(model)
    _known("--method", method, tuple(identify.METHODS))
    return method


def _known(option: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise UsageError(f"{option}: {value} is unknown, allowed: {', '.join(allowed)}")


def _stem(machine: str) -> str:
    return Path(machine).stem if machine.endswith(".toml") else machine


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    return {name: version(name) for name in ("excite", "casadi", "numpy", "scipy")}


# ------------------------------------------------------------------------------------------------ errors


def main() -> None:
    """Runs a command: exit 0 done, 1 could not be done, 2 bad input or usage; one clear line on stderr."""
    signal.signal(signal.SIGTERM, _terminate)
    with interrupt.heard() as said:
        try:
            result = app(args=sys.argv[1:] or ["--help"], standalone_mode=False)
        except typer.TyperException as err:
            _fail(" ".join(err.format_message().split()), 2)
        except (KeyboardInterrupt, typer.Abort):
            _fail("interrupted, nothing was written", INTERRUPTED)
        except Exception as err:
            code = _exit_code(err)
            if code is not None:
                _fail(" ".join(str(err).split()), code)
            if not said.stop:
                raise
            _fail("interrupted, nothing was written", INTERRUPTED)
    if result == INTERRUPTED:  # typer makes an exit code of Ctrl-C
        _fail("interrupted, nothing was written", INTERRUPTED)
    sys.exit(result if isinstance(result, int) else 0)


def _terminate(*_: object) -> None:
    """A polite kill ends like Ctrl-C: workers are stopped, nothing half written stays."""
    raise KeyboardInterrupt


def _exit_code(err: Exception) -> int | None:
    """What an error means for the person who must act; None for a defect of ours, which shows its traceback."""
    from excite.drive import DriveError
    from excite.engine import EngineError
    from excite.estimate import NoEstimate
    from excite.folder import FolderError
    from excite.limit import InfeasibleError
    from excite.log import LogError
    from excite.plan import StudyError
    from excite.serve import ServeError
    from excite.simulate import SimulationError
    from excite.store import StoreError
    from excite.stored import StoredError
    from model.machine import MachineError

    if isinstance(err, UsageError | MachineError | LogError | FolderError | StoredError | DriveError | StudyError):
        return 2
    if isinstance(err, OSError) and err.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
        return 1
    if isinstance(err, NoEstimate | InfeasibleError | SimulationError | ServeError | EngineError | StoreError):
        return 1
    return None


def _fail(message: str, code: int) -> NoReturn:
    shown = "".join(c if c.isprintable() else "?" for c in message)  # names from files don't steer the terminal
    sys.stderr.write(f"excite: {shown}\n")
    sys.exit(code)


if __name__ == "__main__":
    main()
