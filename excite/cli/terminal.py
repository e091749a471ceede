"""What people see in the terminal: tables, sentences, progress; nothing but JSON where JSON is asked for."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from excite import reports, workflows
from excite.text import first_lines, format_number, format_p_value, format_percent

SHOWN = 40  # cells of a study in the terminal
PAUSE = 30.0  # s between lines of progress
INTERRUPTED = 130  # exit code of Ctrl-C, as shells have it
TELLING = 10  # runs before the time left can be told


def say(thing: object) -> None:
    """Prints a line or a table, brackets as they are."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if console.is_terminal:
        console.print(thing)
    else:  # a pipe or file has no width: whole lines, whole tables
        Console(highlight=False, markup=False, width=200).print(thing, soft_wrap=True)


def show_json(summary: dict[str, Any]) -> None:
    """The summary as JSON on stdout and nothing else."""
    from excite import output

    sys.stdout.write(output.to_json(summary))


def finish(summary: dict[str, Any], out: Path, json: bool, show: Callable[[dict[str, Any]], None]) -> None:
    """The end of a command: its summary as JSON, or shown with the folder that was written."""
    if json:
        show_json(summary)
        return
    show(summary)
    say(f"written to {out}/")


def fail(message: str, code: int) -> NoReturn:
    """Ends the program with one line on stderr."""
    shown = "".join(c if c.isprintable() else "?" for c in message)  # names from files don't steer the terminal
    sys.stderr.write(f"excite: {shown}\n")
    sys.exit(code)


def table(*names: str) -> Any:
    """An empty table with these columns."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for k, name in enumerate(names):
        table.add_column(name, justify="left" if k == 0 or name == "what it is" else "right")
    return table


def design_table(summary: dict[str, Any]) -> None:
    """A design in sentences: score, limits, what accuracy it makes attainable."""
    from excite.trajectories import TOLERANCE

    kept = (
        "all limits kept"
        if summary["max_violation"] <= TOLERANCE
        else f"limits exceeded by {100 * summary['max_violation']:.2f} %"
    )
    say(
        f"{summary['machine']} {summary['problem']}: cond(Phi) = {summary['cond_phi']:.2f} (best start"
        f" {summary['cond_phi_start']:.0f}), {summary['duration_s']:g} s, {kept}, designed in {summary['wall_s']:.1f} s"
    )
    if not summary["complete"]:
        say("cut short: this is the best drive so far, more time may find a better one")
    say(
        f"attainable accuracy (Cramer-Rao, one standard deviation): worst {summary['worst_parameter']}"
        f" {format_percent(summary['worst_percent'])}, median {format_percent(summary['median_percent'])}"
    )
    if "driver" in summary:
        by_hand = summary["driver"]
        free, hand = by_hand["played_back"], by_hand["by_hand"]
        from excite.trajectories import titled

        say(
            f"in people's hands, {len(by_hand['phases'])} phases: {titled(summary['objective'], hand['score'])}"
            f" (torques played back {free['score']:.4g}), worst {hand['worst_parameter']}"
            f" {format_percent(hand['worst_percent'])} ({format_percent(free['worst_percent'])}), median"
            f" {format_percent(hand['median_percent'])} ({format_percent(free['median_percent'])})"
        )
        broken = ", ".join(f"{name} by {format_percent(100 * over)}" for name, over in by_hand["limits_broken"].items())
        say(f"people exceed {broken} of the range" if broken else "people keep all limits")
    if summary["advice"] is not None:
        say(summary["advice"])


def verify_table(summary: dict[str, Any]) -> None:
    """A verification, a parameter a line, and which ones are biased."""
    rows = table("parameter", "unit", "true", "mean", "bias %", "spread %", "predicted %", "coverage %")
    for name, row in summary["parameters"].items():
        rows.add_row(
            name,
            row["unit"],
            format_number(row["true"], 6),
            format_number(row["mean"], 6),
            format_number(row["bias_percent"], 3),
            format_number(row["std_percent"], 3),
            format_number(row["predicted_std_percent"], 3),
            format_number(100 * row["coverage95"], 3),
        )
    say(f"{summary['runs']} simulated runs, method {summary['method']}, kit {summary['kit']}")
    say(rows)
    if summary["biased"]:
        say(f"biased, the intervals do not hold: {', '.join(summary['biased'])}")
    if summary["failed"]:
        say(f"{summary['failed']} runs gave no estimate")


def compare_table(summary: dict[str, Any]) -> None:
    """A comparison, a drive a line."""
    rows = table(
        "drive", "cond(Phi)", "cond(W)", "worst std %", "median std %", "kept", "limit broken", "time s", "as good in s"
    )
    for row in summary["designs"]:
        rows.add_row(
            row["name"],
            *(format_number(row[k], 4) for k in ("cond_phi", "cond_w", "worst_std_percent", "median_std_percent")),
            f"{row['kept']}/{row['samples']}",
            "-" if row["breaks"] is None else f"{row['breaks']} by {format_percent(100 * row['max_violation'])}",
            f"{row['wall_s']:.1f}",
            f"not in {row['wall_s']:.0f}" if row["equal_score_s"] is None else f"{row['equal_score_s']:.0f}",
        )
    say(f"{summary['machine']} {summary['problem']}: the designed drive and the usual ones")
    say(rows)
    ratio = summary["ratio_equal_time"]
    if ratio < float("inf"):
        say(f"the best usual drive found in the same time has {ratio:.2g} times the designed one's cond(Phi)")
    else:
        say("no usual drive found in the same time keeps every limit")


def identify_table(summary: dict[str, Any]) -> None:
    """An estimate, a parameter a line, with what there is to remark."""
    rows = table("parameter", "unit", *(heading for heading, *_ in reports.ESTIMATE))
    for name, row in summary["parameters"].items():
        rows.add_row(name, row["unit"], *(format_number(row[k], digits) for _, k, digits in reports.ESTIMATE))
    say(rows)
    say(
        f"method {summary['method']}: relative error {summary['relative_error_percent']:.2f} %,"
        f" cond(W) = {summary['cond_w']:.2f}, cond(Phi) = {summary['cond_phi']:.2f}"
    )
    for name, reason in summary["reasons"].items():
        say(f"{name} can't be identified: {reason}")
    for note in summary["notes"]:
        say(note)
    for check in summary["validation"]:
        errors = ", ".join(f"{n} {v:.1f} %" for n, v in check["torque_error_percent"].items())
        say(f"{check['log']}, not fitted on: torque error {errors}")


def log_table(summary: dict[str, Any]) -> None:
    """What a log holds, a column a line, and what is wrong with it."""
    rows = table("column", "what it is", "unit", "lowest", "highest", "bad cells")
    for c in summary["columns"]:
        rows.add_row(
            c["name"],
            c["what"] or "-",
            c["unit"] or "-",
            format_number(c["low"], 5),
            format_number(c["high"], 5),
            str(c["bad"]),
        )
    say(rows)
    for fault in summary["faults"]:
        say(f"wrong: {fault}")
    for doubt in summary["doubts"]:
        say(f"doubtful: {doubt}")
    for remark in summary["remarks"]:
        say(remark)
    if summary["machine"] is not None and not summary["faults"]:
        say(f"{summary['log']}: a usable log of {summary['machine']}")


def diagnose_table(summary: dict[str, Any]) -> None:
    """A diagnosis: the answer, a finding a line, errors signal by signal, what to drive next."""
    say(summary["answer"])
    if summary["findings"]:
        rows = table("effect", "where", "amount", "std", "unit", "p-value", "gain %", "95 % of it", "tied with")
        for f in summary["findings"]:
            low, high = f["gain_ci95"] or (None, None)
            rows.add_row(
                f["effect"],
                f["where"],
                format_number(f["amount"], 5),
                format_number(f["amount_std"], 2),
                f["unit"],
                format_p_value(f["p_value"]),
                format_number(f["gain_percent"], 3),
                "-" if low is None else f"{format_number(low, 3)} to {format_number(high, 3)}",
                ", ".join(f["tied_with"]) or "-",
            )
        say(rows)
    rows = table("signal", "unit", "error before", "after", "systematic before %", "after %")
    for name, row in summary["signals"].items():
        rows.add_row(
            name,
            row["unit"],
            *(format_number(row[f"rms_{k}"], 3) for k in ("before", "after")),
            *(format_number(row[f"systematic_{k}_percent"], 2) for k in ("before", "after")),
        )
    say(rows)
    for line in first_lines(summary["located"]):
        say(line)
    if summary["separating_run"]:
        say(f"to tell them apart, drive: {summary['separating_run']}")
    if summary["separating_drive"]:
        first, second = (x.partition("=")[0] for x in summary["separating_drive"]["between"])
        where, failed = summary["separating_drive"]["folder"], summary["separating_drive"].get("failed")
        said = f"{where}/profile.csv is designed to" if where else "--next designs a drive to"
        say(f"no drive to tell {first} from {second}: {failed}" if failed else f"{said} tell {first} from {second}")
    if summary["machine_file"]:
        say(f"the machine with what was found, for every command: {summary['machine_file']} in this folder")
    for note in summary["notes"]:
        say(note)


def drive_table(summary: dict[str, Any]) -> None:
    """A drive for a person: its phases, what it keeps of the design, what to mind."""
    rows = table("at", "what it is")
    for phase in summary["phases"]:
        seconds = phase["start_s"]
        rows.add_row(f"{int(seconds // 60)}:{seconds % 60:04.1f}", phase["do"])
    say(rows)
    say(summary["verdict"])
    for warning in summary["warnings"]:
        say(warning)


Advance = Callable[[int, int, float | None], None]


@contextmanager
def bar(label: str) -> Iterator[Advance]:
    """A progress bar on stderr, silent where that is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(label, total=None)

        def advance(done: int, total: int, best: float | None) -> None:
            text = label if best is None or best == float("inf") else f"{label}, best so far {best:.2f}"
            progress.update(task, completed=done, total=total, description=text)

        yield advance


def study_table(summary: dict[str, Any]) -> None:
    """A study, a cell a line, and how many runs ended how."""
    rows = table("cell", "done", "failed", "worst parameter", "rms %", "median rms %", "coverage %", "verdicts")
    for row in summary["cells"][:SHOWN]:
        rows.add_row(
            row["cell"],
            str(row["done"]),
            str(row["failed"] + row["defect"]),
            row.get("worst_parameter", "-"),
            format_number(row.get("worst_rms_percent"), 3),
            format_number(row.get("median_rms_percent"), 3),
            format_number(100 * row["coverage95"] if row.get("coverage95") is not None else None, 3),
            ", ".join(f"{k} {v}" for k, v in row.get("verdicts", {}).items()) or "-",
        )
    say(rows)
    if len(summary["cells"]) > SHOWN:
        say(f"and {len(summary['cells']) - SHOWN} cells more, see the report")
    say(f"{summary['runs']} runs: {summary['done']} gave a result, {summary['failed']} could not")
    if summary["defects"]:
        say(f"{summary['defects']} runs showed a defect of the program, column `reason` of the table says which")


@contextmanager
def study_bar() -> Iterator[Callable[[int, int, str], None]]:
    """What is done of a study and the time left: a bar on a terminal, elsewhere a line on stderr now and then."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, speed_estimate_period=120) as progress:
        task = progress.add_task("", total=None)
        shown = ""

        def tell(done: int, total: int, what: str) -> None:
            nonlocal shown
            if what != shown:  # what was there before says nothing of the speed
                progress.reset(task, total=total, completed=done, description=what)
                shown = what
            progress.update(task, completed=done)

        yield tell


def _lines() -> Callable[[int, int, str], None]:
    """Progress for a file that is looked into: a line at the start, then every PAUSE seconds."""
    began: dict[str, tuple[float, int]] = {}
    last = -PAUSE

    def tell(done: int, total: int, what: str) -> None:
        nonlocal last
        now = time.monotonic()
        since, before = began.setdefault(what, (now, done))
        if done < total and now - last < PAUSE:
            return
        last = now
        left = (total - done) * (now - since) / (done - before) if done - before >= TELLING else None
        tail = "" if left is None or done == total else f", about {_span(left)} left"
        sys.stderr.write(f"{what}: {done} of {total}{tail}\n")
        sys.stderr.flush()

    return tell


def _span(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@contextmanager
def busy(label: str) -> Iterator[None]:
    """A bar for work that can't tell how far it is."""
    with bar(label):
        yield


def machine_table(summary: dict[str, Any]) -> None:
    """A check on the terminal."""
    if summary["parameters"]:
        shown = table(*workflows.MACHINE_COLUMNS)
        for row in workflows.machine_rows(summary):
            shown.add_row(*row)
        say(shown)
    for word, lines in (("wrong: ", summary["faults"]), ("doubtful: ", summary["doubts"]), ("", summary["remarks"])):
        for line in lines:
            say(f"{word}{line}")
    say(workflows.machine_answer(summary))
