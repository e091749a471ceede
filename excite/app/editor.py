"""The machine step: choose or start a file, and edit its text with the messages of its check beside the keys."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nicegui import run, ui

from excite import output
from excite.app import fields, live_view
from excite.app.day import Day
from excite.app.fields import Page
from excite.app.job import Job
from excite.app.key_lines import find_line
from excite.app.results import is_readable_file
from excite.model.machine import shipped_machines

# Places each message at its line, below the one before; again whenever the size of the page changes.
PLACE = """
(() => {
  const place = () => {
    const box = document.querySelector('.beside'), area = document.querySelector('.toml textarea');
    if (!box || !area) return;
    const line = parseFloat(getComputedStyle(area).lineHeight), pad = parseFloat(getComputedStyle(area).paddingTop);
    const top = area.getBoundingClientRect().top - box.getBoundingClientRect().top + pad;
    let free = 0;
    for (const note of box.children) {
      const y = Math.max(free, top + (note.dataset.line - 1) * line);
      note.style.top = y + 'px';
      free = y + note.offsetHeight + 4;
    }
    box.style.minHeight = free + 'px';
  };
  new ResizeObserver(place).observe(document.querySelector('.edit'));
  place();
})()
"""
GO = """
(() => {
  const area = document.querySelector('.toml textarea'), lines = area.value.split('\\n');
  const from = lines.slice(0, LINE - 1).join('\\n').length + (LINE > 1 ? 1 : 0);
  area.focus();
  area.setSelectionRange(from, from + lines[LINE - 1].length);
})()
"""


def is_own(day: Day) -> bool:
    """Return True if the chosen machine is a file of the user's."""
    return day.machine is not None and day.machine not in shipped_machines()


def disk_stamp(day: Day) -> int | None:
    """Return when the chosen machine's file was written."""
    if day.machine is None:
        return None
    path = day.machine_path()
    return path.stat().st_mtime_ns if path.is_file() else None


def build(day: Day, page: Page) -> None:
    """Build the step."""
    form = day.forms["machine"]
    with fields.row():
        names = {m: m if m in shipped_machines() else f"{m} (file)" for m in day.machines()}
        ui.select(
            names, label="Machine", value=day.machine, on_change=lambda event: _choose(day, page, event.value)
        ).props('outlined dense stack-label hint="shipped ones, and files of yours"').classes("field wide")
        fields.words(form, "path", "Path of another machine file", "a .toml on this computer")
        ui.button("Take it", on_click=lambda: _take(day, page)).props(
            'no-caps outline aria-label="Take the machine file"'
        )
    with ui.expansion("Start a machine file").classes("more-settings"), fields.row():
        begins = {
            "": "a commented template",
            **{f"--from {name}": f"all of {name}" for name in shipped_machines()},
            **{f"--like {name}": f"{name} with another logger" for name in shipped_machines()},
        }
        fields.words(form, "new", "Name of the new machine", "letters, digits, _ and -")
        fields.choice(form, "like", "Begin with", begins).classes("wide")
        ui.button("Start the file", on_click=lambda: start_file(day, page)).props("no-caps outline")
    if day.machine is not None and day.machine_path().is_file():
        _edit(day)


def _choose(day: Day, page: Page, machine: str) -> None:
    day.choose(machine)
    page.tick()


def _take(day: Day, page: Page) -> None:
    path = Path(day.forms["machine"]["path"].strip())
    if path.suffix == ".toml" and is_readable_file(path):
        day.choose(str(path))
        day.forms["machine"]["path"] = ""
    else:
        ui.notify(f"{str(path)[:200]}: is no .toml file that is there", type="negative")
    page.tick()


def start_file(day: Day, page: Page) -> None:
    """Start a machine file in the folder and choose it."""
    form = day.forms["machine"]
    name = form["new"].strip()
    path = day.folder / f"{name}.toml"

    def done(job: Job) -> None:
        if job.code == 0:
            form["new"] = ""
            day.choose(str(path))

    day.start("machine", ["machine", "new", name, *form["like"].split(), "--out", str(path)], done)
    page.tick()


def _edit(day: Day) -> None:
    """Build the text of the file with the messages of its last check beside the keys."""
    path = day.machine_path()
    text = path.read_text(encoding="utf-8", errors="replace")
    form = day.forms["machine"]
    if form.get("file") != str(path) or form.get("disk") != text:  # another file, or changed by somebody else
        form |= {"file": str(path), "disk": text, "text": text}
    check = day.result_of("machine")
    said: list[tuple[int | None, str, str]] = []
    if check is not None and check.summary["file"]:
        for kind in ("faults", "doubts", "remarks"):
            for line in check.summary[kind]:
                message = line.removeprefix(f"{check.summary['file']}: ")
                at = find_line(text, message)
                said.append((at, kind, message.removeprefix(f"line {at}: ")))
    said.sort(key=lambda one: one[0] or 0)
    if not is_own(day):
        ui.label(f"{day.machine} comes with excite; to change it, start a machine file like it.").classes("hint")
    with ui.element("div").classes("editor"), ui.element("div").classes("edit"):
        area = ui.textarea(f"Text of {path.name}").props("outlined dense autogrow stack-label spellcheck=false")
        area.classes("toml").bind_value(form, "text")
        if is_own(day):
            area.props("debounce=500")
        else:
            area.props("readonly")
        with ui.element("div").classes("beside").props('role=list aria-label="Messages of the check"'):
            for line, kind, message in said:
                _message(line, kind, message)
    ui.run_javascript(PLACE)
    if is_own(day):
        _view(form, path, area)


def _view(form: dict[str, Any], path: Path, area: ui.textarea) -> None:
    """Build the drawing of the machine from above, which follows the text, with what is wrong with the text so far."""
    with ui.element("figure").classes("live-view"):
        picture = ui.element("img").props('alt="The machine from above, as the text says"')
        picture.set_visibility(False)
        wrong = ui.label().classes("said error").props("role=status")

    async def follow() -> None:
        text = form["text"]
        drawing, fault = await run.io_bound(live_view.draw_text, text, path) or ("", "")
        if picture.is_deleted or text != form["text"]:  # another page, or another text, which is drawn as well
            return
        wrong.text = fault
        if fault:  # the drawing of before stays
            return
        picture.set_visibility(bool(drawing))
        picture.props["src"] = drawing
        picture.update()

    area.on_value_change(follow)
    ui.timer(0.0, follow, once=True)


def _message(line: int | None, kind: str, message: str) -> None:
    note = ui.element("div").classes(f"note {kind}").props(f"role=listitem data-line={line or 1}")
    with note:
        if line is not None:
            button = ui.element("button").props(f'type=button aria-label="Go to line {line}"')
            with button:
                ui.label(f"line {line}")
            button.on("click", js_handler=f"() => {{{GO.replace('LINE', str(line))}}}")
        ui.label({"faults": "wrong", "doubts": "doubtful", "remarks": "note"}[kind]).classes("kind")
        ui.label(message)


def save(day: Day, page: Any) -> bool:
    """Write the text to the file; return False, saying so, if somebody else has changed the file meanwhile."""
    if not is_own(day):
        return True
    form, path = day.forms["machine"], day.machine_path()
    if form.get("file") != str(path):
        return True
    if path.read_text(encoding="utf-8", errors="replace") != form["disk"]:
        ui.notify(f"{path} was changed elsewhere; its new text is shown, make your change again", type="negative")
        page.tick()
        return False
    if form["text"] != form["disk"]:
        with output.new_file(path) as place:
            place.write_text(form["text"], encoding="utf-8")
        form["disk"] = form["text"]
    return True
