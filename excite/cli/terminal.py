"""The terminal: descriptions of results, progress, errors; only JSON on stdout if JSON is asked for."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NoReturn

from excite import reports, workflows
from excite.errors import StoppedError
from excite.text import format_number

LINE_INTERVAL_S = 30.0  # between lines of progress where there is no terminal; chosen
INTERRUPTED = 130  # exit code of Ctrl-C, as shells have it
MIN_RUNS_FOR_ESTIMATE = 10  # runs before the time left is estimated; chosen


def say(thing: object) -> None:
    """Print a line or a table, with brackets as they are."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if console.is_terminal:
        console.print(thing)
    else:  # whole lines and whole tables
        Console(highlight=False, markup=False, width=reports.PIPE_WIDTH).print(thing, soft_wrap=True)


def show_json(summary: Mapping[str, Any]) -> None:
    """Write the summary as JSON to stdout and nothing else."""
    from excite import output

    sys.stdout.write(output.to_json(summary))


def show(kind: str, summary: Mapping[str, Any]) -> None:
    """Print the description of a summary: title, headline, tables, remarks."""
    from rich.console import Console

    for one in reports.text_parts(reports.describe(kind, summary), Console(), reports.REPORT):
        say(one)


def finish(summary: dict[str, Any], out: Path, json: bool, describe: Callable[[dict[str, Any]], None]) -> None:
    """End a command: print its summary as JSON, or describe it and name the folder that was written."""
    if json:
        from excite import output

        sys.stdout.write((out / output.SUMMARY).read_text(encoding="utf-8"))
        return
    describe(summary)
    say(f"written to {out}/")


def fail(message: str, code: int) -> NoReturn:
    """End the program with one line on stderr."""
    shown = "".join(c if c.isprintable() else "?" for c in message)  # names from files can't steer the terminal
    sys.stderr.write(f"excite: {shown}\n")
    sys.exit(code)


_announced: ContextVar[str | None] = ContextVar("announced", default=None)  # said when the work begins


@contextmanager
def announcing(line: str | None) -> Iterator[None]:
    """Say a line when the work of the block begins, which is when its input was accepted: at its first `bar`.

    Work without a bar has the line said at its end, none if it fails.
    """
    before = _announced.set(line)
    try:
        yield
        _say_announced()
    finally:
        _announced.reset(before)


def _say_announced() -> None:
    line = _announced.get()
    if line is not None:
        _announced.set(None)
        say(line)


@contextmanager
def bar(label: str) -> Iterator[workflows.Advance]:
    """Show a progress bar on stderr; lines of JSON if `PROGRESS_VARIABLE` asks for them, nothing without a terminal.

    Raises StoppedError on Ctrl-C: why there is no result, or how far the work was.
    """
    _say_announced()
    reached = "had only begun"
    with (_json_lines if os.environ.get(workflows.PROGRESS_VARIABLE) == "json" else _drawn_bar)(label) as tell:

        def advance(done: int, total: int, note: float | str | None) -> None:
            nonlocal reached
            reached = f"was at step {done} of {total}"
            tell(done, total, note)

        try:
            yield advance
        except KeyboardInterrupt as stopped:
            raise StoppedError(str(stopped) or f"{label} {reached}") from None


@contextmanager
def _json_lines(label: str) -> Iterator[workflows.Advance]:
    def write(done: int, total: int, note: float | str | None) -> None:
        best = note if note is not None and not isinstance(note, str) and math.isfinite(note) else None
        doing = note if isinstance(note, str) else getattr(note, "doing", None)
        said = {"label": label, "done": done, "total": total, "best": best, "doing": doing}
        sys.stderr.write(f"{json.dumps(said)}\n")
        sys.stderr.flush()

    write(0, 0, None)
    yield write


@contextmanager
def _drawn_bar(label: str) -> Iterator[workflows.Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(label, total=None)

        def advance(done: int, total: int, note: float | str | None) -> None:
            text = label
            if isinstance(note, str):
                text = f"{label}: {note}"
            elif note is not None:
                best = f", best so far {format_number(note, 4)}" if math.isfinite(note) else ""
                text = f"{label}{best}: {doing}" if (doing := getattr(note, "doing", "")) else f"{label}{best}"
            progress.update(task, completed=done, total=total, description=text)

        yield advance


@contextmanager
def study_bar() -> Iterator[Callable[[int, int, str], None]]:
    """Show progress and time left of a study: a bar on a terminal, elsewhere a line on stderr now and then."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _progress_lines()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, speed_estimate_period=120) as progress:
        task = progress.add_task("", total=None)
        shown = ""

        def report(done: int, total: int, what: str) -> None:
            nonlocal shown
            if what != shown:  # another kind of work has another speed
                progress.reset(task, total=total, completed=done, description=what)
                shown = what
            progress.update(task, completed=done)

        yield report


def _progress_lines() -> Callable[[int, int, str], None]:
    """Report progress by a line at the start, at the end, and every LINE_INTERVAL_S."""
    start: dict[str, tuple[float, int]] = {}
    last = -LINE_INTERVAL_S

    def report(done: int, total: int, what: str) -> None:
        nonlocal last
        now = time.monotonic()
        since, before = start.setdefault(what, (now, done))
        if done < total and now - last < LINE_INTERVAL_S:
            return
        last = now
        left = (total - done) * (now - since) / (done - before) if done - before >= MIN_RUNS_FOR_ESTIMATE else None
        tail = "" if left is None or done == total else f", about {_duration_words(left)} left"
        sys.stderr.write(f"{what}: {done} of {total}{tail}\n")
        sys.stderr.flush()

    return report


def _duration_words(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
