"""The page: steps of the day on the left, and for the step that is shown what it needs, its fields and its result."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import ui

from excite import output, reports, trajectories
from excite.app import editor, fields
from excite.app.course import draw_course
from excite.app.day import STEPS, Day
from excite.app.job import Job, command_line
from excite.app.results import Result
from excite.reports import Description, Table
from excite.text import format_number

TICK_S = 0.4  # between looks at the day [s]; chosen
COMPARE = "compare"
TITLES = {**STEPS, COMPARE: "Compare designs"}
PURPOSE = {
    "machine": "Choose the machine, or describe it, and have its file checked.",
    "design": "Find the drive that shows every parameter. Stopping keeps the best drive so far.",
    "drive": "Turn the design into a sheet for the clipboard and a page for the cab.",
    "log": "Have what the logger wrote checked before anything is computed from it.",
    "identify": "Estimate the parameters, with 95 % intervals.",
    "diagnose": "Find what the model gets wrong, and name the cause.",
    COMPARE: "Two designs of this machine, side by side.",
}
ACTIONS = {
    "machine": "Check the machine",
    "design": "Design the drive",
    "drive": "Make sheet and page",
    "log": "Check the log",
    "identify": "Identify",
    "diagnose": "Diagnose",
}
LINKS = {
    "report.html": "report, with plots that zoom",
    "motion.html": "motion in a window of its own",
    "sheet.pdf": "sheet for the driver (PDF)",
    "driver.html": "page for the cab",
    "profile.csv": "profile (CSV)",
    "machine.toml": "machine file with what was found",
}  # files of a result that one opens
STOPS = {"design": "Stop and keep the best", "diagnose": "Stop and keep what was found"}
MARKS = {"done": "✓", "doubtful": "?", "failed": "✗", "running": "…", "to do again": "↻", "ready": "→", "waiting": ""}


class Window:
    """The page of one browser; everything that it shows is of the day, except which step it shows."""

    def __init__(self, day: Day) -> None:
        self.day = day
        open_steps = [s for s in STEPS if day.state(s) not in ("done", "doubtful")]
        running = day.job.step if day.running and day.job else None
        self.step = running or (open_steps[0] if open_steps else "diagnose")
        self.shown: dict[str, Any] = {}

    def build(self) -> None:
        """Build the page and keep it up to date."""
        ui.colors(primary="#0b4f8a")
        ui.add_head_html(reports.templates().get_template("app.html").render())
        with ui.element("div").classes("window"):
            with ui.element("header"):
                with ui.element("div").classes("brand"):
                    ui.label("excite")
                self.heading = ui.label().classes("day")
            with ui.element("nav").props('aria-label="Steps of the test day"'):
                self.tabs = {step: self._tab(step, title) for step, title in TITLES.items()}
            with ui.element("div").classes("step").props("id=step tabindex=-1") as main:
                self._running_bar()
                self.title = ui.element("h1")
                self.purpose = ui.label().classes("purpose")
                self.needs = ui.element("ul").classes("needs").props('aria-label="What this step needs"')
                self.form = ui.element("section").props('aria-label="Settings"')
                self._action_row()
                self.result = ui.element("section").classes("result").props('aria-label="Result"')
                self.passed = ui.element("ul").classes("needs").props('aria-label="In the folder, but not shown"')
        ui.skip_link("Skip to the step", target=main)
        self.show(self.step)
        ui.timer(TICK_S, self.tick)

    # ---------------------------------------------------------------------------------------------- fixed parts

    def _tab(self, step: str, title: str) -> tuple[ui.element, ui.label, ui.label]:
        button = ui.element("button").classes("tab").props("type=button").on("click", partial(self.show, step))
        with button:
            mark = ui.label().classes("mark").props("aria-hidden=true")
            ui.label(title)
            state = ui.label().classes("state")
            state.set_visibility(step != COMPARE)
        return button, mark, state

    def _running_bar(self) -> None:
        with ui.element("section").classes("progress").props('aria-label="Progress"') as self.bar:
            with ui.element("div").classes("text"):
                self.doing = ui.label().classes("doing")
                self.numbers = ui.label()
            self.progress = ui.linear_progress(show_value=False).props('aria-label="Progress" instant-feedback')
            self.stop = ui.button("Stop", on_click=self._stop).props("no-caps outline")
            self.course = ui.html("", sanitize=False).classes("course")
        self.said = ui.label().classes("said").props("role=status aria-live=polite")

    def _action_row(self) -> None:
        with ui.element("div").classes("action") as self.action:
            self.go = ui.button("", on_click=self._go).props("no-caps unelevated color=primary")
            with ui.element("div"):
                self.command = ui.element("code").props('aria-label="The same as a command"')
                self.replaced = ui.label().classes("hint")

    def _go(self) -> None:
        if not self.day.ready(self.step):
            return
        if self.step == "log":
            fields.check_logs(self.day)
        elif self.step != "machine" or editor.save(self.day, self):
            self.day.start(self.step)
        self.tick()

    def _stop(self) -> None:
        if self.day.job is not None and self.day.running:
            self.day.job.stop()
        self.tick()

    def show(self, step: str) -> None:
        """Show a step."""
        self.step = step
        self.shown.clear()
        self.title.clear()
        with self.title:
            ui.label(TITLES[step])
        self.purpose.text = PURPOSE[step]
        self.tick()

    # ---------------------------------------------------------------------------------------------- what changes

    def tick(self) -> None:
        """Bring everything up to date with the day."""
        day = self.day
        with day.glance():
            machine = day.load()
            self.heading.text = f"{machine.title if machine else day.machine or 'no machine yet'} · {day.folder}/"
            self._tabs_now()
            self._running_now()
            needs = [] if self.step == COMPARE else day.needs(self.step)
            self._changed("needs", needs, self.needs, partial(self._needs, needs))
            self._changed("form", self._form_key(), self.form, self._form)
            self._action_now()
            self._changed("passed", day.passed_over, self.passed, partial(self._passed_over, day.passed_over))
            results = self._results()
            key = [(r.folder, r.time, day.outdated(r)) for r in results], self._compare_key()
            self._changed("result", key, self.result, partial(self._result, results))

    def _changed(self, name: str, key: object, place: ui.element, build: Callable[[], None]) -> None:
        """Build a part of the page anew if what it shows has changed."""
        if name in self.shown and self.shown[name] == key:
            return
        self.shown[name] = key
        place.clear()
        with place:
            build()

    def _tabs_now(self) -> None:
        for step, (button, mark, state) in self.tabs.items():
            now = "" if step == COMPARE else self.day.state(step)
            button.props(f"aria-current={'step' if step == self.step else 'false'}")
            button.classes(replace=f"tab {now.replace(' ', '-')}{' current' if step == self.step else ''}")
            mark.text, state.text = MARKS.get(now, "⇆"), now

    def _running_now(self) -> None:
        job = self.day.job
        self.bar.set_visibility(self.day.running)
        if job is None:
            return
        what = STEPS.get(job.step, job.step)
        if job.running:
            best = "" if job.best is None else f", best so far: {_score(job)}"
            self.doing.text = f"{what}: {'stopping' if job.stops else job.doing or job.label}"
            self.numbers.text = f"{job.elapsed_s:.0f} s{job.time_left}{best}"
            self.progress.props(f"{'indeterminate' if not job.total else ':indeterminate=false'}")
            self.progress.value = job.done / job.total if job.total else 0.0
            self.course.content = draw_course(job.course, job.elapsed_s)
            self.stop.text = "End it at once" if job.stops else STOPS.get(job.step, "Stop")
            said = f"{what} is running."
        elif job.step != self.step:  # a message is of its own step
            said = ""
        elif job.message:
            said = f"{what}: {job.message}"
        else:
            kept = "stopped, and what it had found is kept," if job.stops else "ended"
            said = f"{what}: {kept} after {job.elapsed_s:.0f} s."
        failed = bool(said) and not job.running and bool(job.message)
        look = "error" if failed else "unseen" if job.running else ""
        self.said.classes(replace=f"said {look}").props(f"role={'alert' if failed else 'status'}")
        self.said.text = said

    def _needs(self, needs: list[Any]) -> None:
        for need in needs:
            with ui.element("li").classes("met" if need.met else "missing"):
                ui.label(f"{'✓ Has' if need.met else '✗ Needs'} {need.text}")

    def _action_now(self) -> None:
        day, step = self.day, self.step
        self.action.set_visibility(step != COMPARE and day.machine is not None)
        if step == COMPARE or day.machine is None:
            return
        own = step == "machine" and editor.is_own(day)
        self.go.text = "Save and check" if own else ACTIONS[step] + ("s" if step == "log" and len(day.logs) > 1 else "")
        self.go.set_enabled(day.ready(step))
        commands = [day.command(step, log) for log in day.logs] if step == "log" else [day.command(step)]
        text = " && ".join(map(command_line, commands))
        if self.shown.get("command") != text:
            self.shown["command"] = text
            self.command.clear()
            with self.command:
                ui.label(text)
        if day.running and day.job is not None:
            self.replaced.text = f"waits until {STEPS[day.job.step]} has ended"
            return
        before = None if step == "log" else output.describe_result(day.out(step))
        self.replaced.text = "" if before is None else f"replaces {day.out(step)}/, the result of {before}"

    # ---------------------------------------------------------------------------------------------- settings, result

    def _form_key(self) -> object:
        day, step = self.day, self.step
        designs = [str(r.folder) for r in day.designs()]
        match step:
            case "machine":
                check = day.result_of(step)
                return day.machine, day.machines(), check and check.time, editor.disk_stamp(day)
            case "design":
                return day.machine, day.machine_error()
            case "drive" | "compare":
                return designs
            case "log":
                return day.machine, day.known_logs(), designs[:1]
            case _:
                return day.machine, day.doubts(), day.accepted_words()

    def _passed_over(self, lines: list[str]) -> None:
        for line in lines:
            with ui.element("li"):
                ui.label(f"{line}; it is not shown").classes("hint")

    def _form(self) -> None:
        {
            "machine": editor.build,
            "design": fields.design,
            "drive": fields.drive,
            "log": fields.log,
            "identify": fields.identify,
            "diagnose": fields.diagnose,
            COMPARE: fields.compare,
        }[self.step](self.day, self)

    def _results(self) -> list[Result]:
        if self.step == COMPARE:
            return fields.compared(self.day)
        if self.step == "log":
            return [check for log in self.day.logs if (check := self.day.check_of(log))]
        found = self.day.result_of(self.step)
        return [found] if found else []

    def _compare_key(self) -> object:
        return tuple(self.day.forms[COMPARE].values()) if self.step == COMPARE else None

    def _result(self, results: list[Result]) -> None:
        if self.step == COMPARE:
            self._comparison(results)
            return
        if self.step == "design" and len(self.day.designs()) > 1:
            with fields.row():
                fields.choose_design(self.day)
        for result in results:
            said = reports.describe(result.kind, result.summary)
            status = "invalid" if result.summary.get("faults") else said.status
            status = "doubtful" if status == "valid" and result.summary.get("doubts") else status
            with ui.element("article").classes(f"card {status}"):
                changed = self.day.outdated(result)
                when = time.strftime("%Y-%m-%d %H:%M", time.localtime(result.time))
                ui.label(f"{result.folder}/, {when}").classes("hint")
                if changed:
                    ui.label(f"{changed}: do this step again.").classes("changed")
                ui.html(reports.result_fragment(said), sanitize=False)
                self._links(result)
                self._settings(result)
                self._figures(result)

    def _settings(self, result: Result) -> None:
        """Show by which settings a result was made."""
        with ui.expansion("How it was made").classes("more-settings"), ui.element("dl").classes("how"):
            for name, value in reports.provenance(result.summary, result.summary.get("command")).items():
                for tag, text in (("dt", name), ("dd", value)):
                    with ui.element(tag):
                        ui.label(text)

    def _figures(self, result: Result) -> None:
        if (result.folder / reports.MOTION_PAGE).is_file():
            frame = ui.element("iframe").style("width: 100%; aspect-ratio: 1.35; border: 0")
            frame.props["src"], frame.props["title"] = self._url(result.folder / reports.MOTION_PAGE), "the motion"
        for picture in reports.folder_pictures(result.folder, result.summary):
            with ui.expansion(picture.folded).classes("more-settings") if picture.folded else nullcontext():
                self._figure(picture.path, picture.caption)

    def _links(self, result: Result) -> None:
        with ui.element("p").classes("links"):
            for name, what in LINKS.items():
                if (result.folder / name).is_file():
                    ui.link(f"Open the {what}", self._url(result.folder / name), new_tab=True)

    def _url(self, path: Path) -> str:
        return f"files/{quote(str(path.relative_to(self.day.folder)))}?{path.stat().st_mtime_ns}"

    def _figure(self, path: Path, caption: str) -> None:
        with ui.element("figure"):
            with ui.link(target=self._url(path), new_tab=True).props(f'aria-label="{path.stem}, full size"'):
                ui.element("img").props["src"] = self._url(path)
            with ui.element("figcaption"):
                ui.label(caption)

    def _comparison(self, results: list[Result]) -> None:
        results = [r for r in results if r.summary["worst_percent"] is not None]
        if len(results) < 2:
            ui.label("Needs two designs of this machine: step Design makes another, under a name of its own.")
            return
        one, other = (r.summary for r in results)
        names = [str(r.folder.relative_to(self.day.folder)) for r in results]
        ordered = sorted((r.summary["worst_percent"], name) for r, name in zip(results, names, strict=True))
        reach = [f"{format_number(value, 3)} %" for value, _ in ordered]
        words = f"{ordered[0][1]} is the more accurate one: every parameter to {reach[0]} or better, the other to "
        words = f"{words}{reach[1]}." if reach[0] != reach[1] else f"Both give every parameter to {reach[0]} or better."
        ui.html(
            reports.result_fragment(
                Description("Two designs", words, (_numbers(names, one, other), _accuracy(names, one, other)))
            ),
            sanitize=False,
        )
        with ui.element("div").classes("two"):
            for result in results:
                with ui.element("article").classes("card"):
                    ui.label(f"{result.folder}/").classes("hint")
                    self._links(result)
                    self._figures(result)


def _score(job: Job) -> str:
    """Write the best score of a design so far as its objective names it."""
    asked = job.arguments
    objective = asked[asked.index("--objective") + 1] if "--objective" in asked else "cond"
    return trajectories.describe_value(objective, job.best or 0.0)


COMPARED = {
    "duration_s": "duration [s]",
    "objective": "objective",
    "cond_phi": "cond(Phi)",
    "cond_w": "cond(W)",
    "worst_parameter": "worst parameter",
    "worst_percent": "its standard deviation [%]",
    "median_percent": "median standard deviation [%]",
    "max_violation": "worst excess of a limit [share of its range]",
    "starts": "starts",
    "seed": "seed",
    "wall_s": "computed in [s]",
}  # numbers of a design that are compared


def _numbers(names: list[str], one: dict[str, Any], other: dict[str, Any]) -> Table:
    def cell(value: Any) -> str:
        return format_number(value, 3) if isinstance(value, float) else str(value)

    rows = tuple((text, cell(one.get(key)), cell(other.get(key))) for key, text in COMPARED.items())
    return Table("What was asked for and what came of it.", ("", *names), rows)


def _accuracy(names: list[str], one: dict[str, Any], other: dict[str, Any]) -> Table:
    a, b = one["sigma_percent"], other["sigma_percent"]
    rows = tuple(
        (name, format_number(a[name], 2), format_number(b[name], 2), format_number(b[name] / a[name], 2))
        for name in a
        if a[name] and b.get(name) is not None
    )
    marked = tuple(k for k, row in enumerate(rows) if row[0] in (one["worst_parameter"], other["worst_parameter"]))
    columns = ("parameter", f"{names[0]} [%]", f"{names[1]} [%]", "second / first")
    return Table("Attainable standard deviation of each parameter; each design's worst in bold.", columns, rows, marked)
