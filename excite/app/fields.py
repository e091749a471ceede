"""The settings of each step: fields of the day's forms, which every browser shares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from nicegui import ui

from excite import workflows
from excite.app.day import NUMBERS, Day
from excite.app.job import Job
from excite.app.results import Result, is_readable_file

UPLOAD = """async (event) => {
  const file = event.target.files[0];
  if (!file) return;
  const answer = await fetch('log/' + encodeURIComponent(file.name), {method: 'POST', body: file});
  emit((answer.ok ? '' : '!') + await answer.text());
}"""


class Page(Protocol):
    """The page, which fields bring up to date."""

    def tick(self) -> None: ...


def number(day: Day, step: str, key: str, hint: str = "") -> None:
    """Add a field for a number, which says below it what is wrong with it; an empty one is None."""
    one = NUMBERS[step][key]
    field = ui.number(one.label, validation=lambda value: one.fault(value) or None, step=1 if one.whole else None)
    field.props(_hint(hint)).bind_value(day.forms[step], key).classes("field").validate()


def words(form: dict[str, Any], key: str, label: str, hint: str = "") -> ui.input:
    """Add a field for a line of text."""
    return ui.input(label).props(_hint(hint)).bind_value(form, key).classes("field")


def choice(form: dict[str, Any], key: str, label: str, options: Any, hint: str = "") -> ui.select:
    """Add a field for one of several values."""
    if form[key] not in options:
        form[key] = next(iter(options), None)
    return ui.select(options, label=label).props(_hint(hint)).bind_value(form, key).classes("field")


def tick_box(form: dict[str, Any], key: str, label: str) -> ui.checkbox:
    """Add a field for yes or no."""
    return ui.checkbox(label).bind_value(form, key)


def _hint(text: str) -> str:
    return f'outlined dense stack-label hint="{text}"' if text else "outlined dense stack-label hide-bottom-space"


def row() -> ui.element:
    """Begin a row of fields that wraps."""
    return ui.element("div").classes("fields")


# ------------------------------------------------------------------------------------------------ steps


def design(day: Day, page: Page) -> None:
    """Fields of the design."""
    form, machine = day.forms["design"], day.load()
    arm = {} if machine is None else workflows.arm_problems(machine)
    if machine is None or not (machine.problems or arm):
        ui.label("The machine file has no design problem ([problems.NAME]); give it one in step Machine.")
        return
    problems = {
        name: f"{name}: {float(p.duration_s):g} s" + (f" on {p.lane_m[0]:g} m x {p.lane_m[1]:g} m" if p.lane_m else "")
        for name, p in (machine.problems or arm).items()
    }
    if form["problem"] not in problems:
        form["problem"] = machine.problem or next(iter(problems))
    usual = float((machine.problems or arm)[form["problem"]].duration_s)
    with row():
        choice(form, "problem", "Design problem", problems, "of the machine file")
        number(day, "design", "duration", f"empty: the problem's own, {usual:g} s")
        choice(form, "objective", "Minimise", list(workflows.choices("objective")), "accuracy: the smallest errors")
        number(day, "design", "starts", "more may find a better drive")
        number(day, "design", "budget", "empty: until it converges")
        words(form, "out", "Name of the result", "empty: a new name")
    if not arm:  # whose designs are motions of its joints
        with row():
            tick_box(form, "driver", "for a person at the levers, in phases")
            tick_box(form, "robust", "for machines up to 20 % off as well")
    with ui.expansion("More settings").classes("more-settings"), row():
        number(day, "design", "sigma_max", "empty: no bound")
        number(day, "design", "seed", "same seed, same result")


def drive(day: Day, page: Page) -> None:
    """Fields of the driver's aids."""
    with row():
        choose_design(day)
        number(day, "drive", "phases", "empty: as many as it takes")
        number(day, "drive", "shortest", "empty: 2 s")


def choose_design(day: Day) -> None:
    """Choose the design to drive, once there is one."""
    if names := day.design_names():
        chosen = day.design()
        day.forms["drive"]["design"] = str(chosen.folder) if chosen else None
        choice(day.forms["drive"], "design", "Design", names, "the newest unless you choose another")


def log(day: Day, page: Page) -> None:
    """Choose logs, hand one over from the browser, or simulate one."""
    known, form = day.known_logs(), day.forms["log"]

    def add(path: str) -> None:
        path = path.strip()
        if not is_readable_file(path):
            note.text = f"{path[:200] or 'no path'}: no such file"
            return
        day.logs = [path] if path not in day.logs else day.logs
        form["path"] = ""
        day.save()
        page.tick()

    def taken(event: Any) -> None:
        said = event.args[0] if isinstance(event.args, list) else event.args
        note.text = str(said).removeprefix("!") if str(said).startswith("!") else ""
        page.tick()

    def chosen() -> None:
        day.save()
        page.tick()

    with row():
        if known:
            ui.select(known, label="Logs of the drive", multiple=True, on_change=chosen).bind_value(day, "logs").props(
                'outlined dense stack-label use-chips hint="several are used together"'
            ).classes("field wide")
        words(form, "path", "Path of another log", "on this computer").on("keydown.enter", lambda: add(form["path"]))
        ui.button("Take it", on_click=lambda: add(form["path"])).props('no-caps outline aria-label="Take the log"')
        with ui.element("label").classes("upload"):
            ui.label("or a file")
            ui.element("input").props("type=file").on("change", taken, js_handler=UPLOAD)
    note = ui.label().classes("said error").props("role=alert")
    if day.design() is None:
        return
    with ui.expansion("No log yet? Simulate one").classes("more-settings"), row():
        words(form, "effect", "Effect that the model lacks", "such as ground_slope=0.01; empty for none")
        number(day, "log", "seed", "of the sensors' noise")
        ui.button("Simulate a log of the design", on_click=lambda: simulate(day, page)).props("no-caps outline")


def simulate(day: Day, page: Page) -> None:
    """Simulate a log of the design and choose it."""
    chosen, form = day.design(), day.forms["log"]
    if chosen is None or day.machine is None or day.wrong_numbers("log"):
        return
    names = (day.folder / f"simulated{'' if k == 1 else f'-{k}'}.csv" for k in range(1, 1000))
    path = next(p for p in names if not p.exists())
    effect = ["--effect", form["effect"]] if form["effect"] else []
    seed = ["--seed", str(int(form["seed"]))]
    arguments = ["simulate", day.machine, str(chosen.folder / "profile.csv"), *effect, *seed, "--out", str(path)]

    def done(job: Job) -> None:
        if job.code == 0:
            day.logs = [str(path)]

    day.start("log", arguments, done)
    page.tick()


def check_logs(day: Day) -> None:
    """Check the chosen logs, one after another."""
    left = list(day.logs)

    def next_one(job: Job | None = None) -> None:
        if left and (job is None or not (job.message or job.stops)):
            day.start("log", day.command("log", left.pop(0)), next_one)

    next_one()


def identify(day: Day, page: Page) -> None:
    """Fields of the identification, and the acceptance of doubts in words."""
    form = day.forms["identify"]
    methods: dict[str | None, str] = {None: "the recommended one"}
    methods |= {name: name for name in workflows.choices("method")}
    with row():
        choice(form, "method", "Method", methods)
        words(form, "out", "Name of the result", f"empty: {day.out('identify').name}" if day.machine else "")
    doubts, accepted = day.doubts(), day.accepted_words()
    if not doubts:
        return

    def accept(said: str) -> Callable[[], None]:
        def act() -> None:
            day.accepted = {"words": form["words"].strip() if said else "", "doubts": doubts if said else []}
            day.save()
            page.tick()

        return act

    with ui.element("section").classes("card doubtful").props('aria-label="Doubts about the log"'):
        with ui.element("h2"):
            ui.label("The check of the log doubts")
        with ui.element("ul"):
            for line in doubts:
                with ui.element("li"):
                    ui.label(line)
        if accepted:
            ui.label(f'Accepted: "{accepted}". These words are stored with the result.')
            ui.button("Withdraw", on_click=accept("")).props("no-caps outline")
            return
        ui.label("Mend the log or the machine file and check again; or say in words why these doubts may stand.")
        text = ui.textarea("Why they may stand").props("outlined dense stack-label autogrow").bind_value(form, "words")
        text.classes("wide")
        button = ui.button("Accept the doubts", on_click=accept("yes")).props("no-caps outline")
        button.bind_enabled_from(form, "words", backward=lambda said: bool(str(said or "").strip()))


def diagnose(day: Day, page: Page) -> None:
    """Fields of the diagnosis."""
    form = day.forms["diagnose"]
    with row():
        number(day, "diagnose", "budget", "empty: until it is done")
        words(form, "out", "Name of the result", f"empty: {day.out('diagnose').name}" if day.machine else "")
    tick_box(form, "next", "also design the drive that separates tied causes (minutes)")


def compare(day: Day, page: Page) -> None:
    """Choose two designs."""
    form, names = day.forms["compare"], day.design_names()
    if len(names) < 2:
        return
    first, second, *_ = names
    for key, usual in (("left", second), ("right", first)):
        if form[key] not in names:
            form[key] = usual
    with row():
        choice(form, "left", "First design", names)
        choice(form, "right", "Second design", names)


def compared(day: Day) -> list[Result]:
    """Return the two designs that are compared, none without two."""
    every = {str(r.folder): r for r in day.designs()}
    found = [every.get(str(day.forms["compare"][key])) for key in ("left", "right")]
    return [r for r in found if r is not None] if None not in found else []
