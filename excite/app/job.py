"""A command of `excite` as a process of its own: its progress, its end, and how to stop it."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from excite import output
from excite.workflows import PROGRESS_VARIABLE

PREFIX = "excite: "  # of an error's line on stderr


class Job:
    """A running or finished command.

    label, done, total, best, doing: progress as the command reports it; best None without a score, doing what it does
    now. course: time [s] and score of each improvement. code: exit code, None while it runs. message: its error in one
    line, "" for none. ended: called once, in a thread, when it has ended.
    """

    def __init__(self, step: str, arguments: Sequence[str], out: Path, ended: Callable[[Job], None]) -> None:
        self.step, self.arguments, self.out, self._ended = step, tuple(arguments), out, ended
        self.label, self.done, self.total, self.best = "working", 0, 0, None
        self.doing: str | None = None
        self.course: list[tuple[float, float]] = []
        self.begin = time.monotonic()
        self.seconds = 0.0
        self.code: int | None = None
        self.message = ""
        self.stops = 0
        self._process: subprocess.Popen[str] | None = None
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "excite", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                errors="replace",
                env={**os.environ, PROGRESS_VARIABLE: "json"},
                start_new_session=True,  # a Ctrl-C in the terminal of the window is passed on by `stop`
            )
        except (OSError, ValueError) as err:  # no memory, or a text that no command line can hold
            self.code, self.message = 2, f"the command can't be started: {err}"
            return
        self._thread = threading.Thread(target=self._follow, args=(self._process,), daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        return self.code is None

    @property
    def elapsed_s(self) -> float:
        """Return the time since it began, or that it took [s]."""
        return time.monotonic() - self.begin if self.running else self.seconds

    @property
    def time_left(self) -> str:
        """Return in words how much of a --budget is left, "" without one."""
        if "--budget" not in self.arguments:
            return ""
        left = float(self.arguments[self.arguments.index("--budget") + 1]) - self.elapsed_s
        return f", {left:.0f} s left to search" if left > 0 else ", about to end"

    def stop(self) -> None:
        """Ask the command to stop, as Ctrl-C does: what it has so far it may keep. The second time, end it."""
        self.stops += 1
        if self._process is None:
            return
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGINT if self.stops == 1 else signal.SIGKILL)

    def wait(self, seconds: float) -> bool:
        """Wait until it has ended; return whether it has."""
        if self._process is not None:
            self._thread.join(seconds)
        return not self.running

    def _follow(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        last, defect = "", False
        for line in process.stderr:
            try:
                said = json.loads(line)
                self.label, self.done, self.total, self.best = (said[k] for k in ("label", "done", "total", "best"))
                self.doing = said["doing"]
                if self.best is not None and (not self.course or self.best != self.course[-1][1]):
                    self.course.append((self.elapsed_s, self.best))
            except (ValueError, TypeError, KeyError):
                last = line.strip() or last
                defect = defect or line.startswith("Traceback")
        code = process.wait()
        self.seconds = time.monotonic() - self.begin
        if self.stops > 1:
            output.remove_partial_folders(self.out)
        if last.startswith(PREFIX):
            self.message = last.removeprefix(PREFIX)
        elif self.stops > 1:
            self.message = "stopped, nothing was written"
        elif defect or code not in (0, 1, 2):
            self.message = f"`{command_line(self.arguments)}` ended with {code}: {last}"
        self.code = code
        self._ended(self)


def command_line(arguments: Sequence[str]) -> str:
    """Return a command as it is typed."""
    return shlex.join(["excite", *arguments])
