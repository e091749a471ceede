"""The window: who may open it, and a whole test day in a real browser."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.drives import drive
from support.logs import logged
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from excite.model import Model
from excite.simulation import simulate

pytest.importorskip("nicegui", reason="the extra app is not installed")


@contextmanager
def window(place: Path) -> Iterator[tuple[str, int]]:
    """The window of a folder results/ in a place: its address and process."""
    process = subprocess.Popen(
        [sys.executable, "-m", "excite", "app", "results", "--no-browser"],
        cwd=place,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    assert process.stderr is not None
    try:
        yield process.stderr.readline().split()[0], process.pid
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        process.stderr.close()


def answer(url: str, **headers: str) -> tuple[int, str, Any]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as got:
            return got.status, got.read().decode(errors="replace"), got.headers
    except urllib.error.HTTPError as err:
        return err.code, "", err.headers


def listening(pid: int) -> set[str]:
    """Addresses (hex, as /proc/net has them) on which a process listens."""
    sockets = {os.readlink(fd) for fd in Path(f"/proc/{pid}/fd").iterdir() if fd.is_symlink()}
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets}


def test_nothing_is_answered_without_the_token_or_beyond_this_computer(tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("secret")
    with window(tmp_path) as (address, pid):
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/([\w-]{32})/", address)
        assert found
        base, token = f"http://127.0.0.1:{found[1]}", found[2]
        assert listening(pid) == {"0100007F"}
        code, page, headers = answer(address)
        assert code == 200
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        assert headers["Referrer-Policy"] == "no-referrer"
        linked = set(re.findall(r'(?:src|href)="([^"#]+)"', page))
        assert linked
        assert all(url.startswith((f"/{token}/", "data:")) for url in linked), linked
        asset = next(url for url in linked if url.endswith(".js"))
        assert answer(base + asset)[0] == 200

        wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
        for path in ("/", f"/{wrong}/", f"/{token}", asset.replace(token, wrong), asset.replace(f"/{token}", "")):
            assert answer(base + path)[0] == 403, path
        assert answer(address, Host=f"evil.example:{found[1]}")[0] == 403
        assert answer(address, Origin="http://evil.example")[0] == 403
        for path in ("files/../secret.txt", "files/%2e%2e/secret.txt", "files//etc/passwd"):
            assert answer(address + path)[0] == 404, path

        socket = "_nicegui_ws/socket.io/?EIO=4&transport=websocket"
        url = address.replace("http", "ws")
        with connect(url + socket) as open_one:
            assert str(open_one.recv(10)).startswith("0{")
        for bad, origin in ((url.replace(token, wrong), None), (url, Origin("http://evil.example"))):
            with pytest.raises(InvalidStatus, match="403"):
                connect(bad + socket, origin=origin)


FOCUSED = """() => {
  const e = document.activeElement;
  if (!e || e === document.body) return null;
  const styles = [e, e.closest('.q-field__control') || e].map(p => getComputedStyle(p));
  const labelled = (e.getAttribute('aria-labelledby') || '').split(' ').map(id => document.getElementById(id));
  const name = [e.getAttribute('aria-label'), ...[...(e.labels || [])].map(l => l.innerText), e.innerText,
    ...labelled.map(l => l && l.innerText)].find(text => text && text.trim()) || '';
  return [name.replace(/\\s+/g, ' ').trim(), 
    styles.some(s => s.outlineStyle === 'solid' || s.boxShadow.includes('rgb(217, 102, 10)'))];
}"""


def tabbed(page: Any) -> dict[str, bool]:
    """Names of everything that Tab reaches from the top of the page, and whether its focus shows."""
    page.locator(".nicegui-skip-link").focus()
    page.keyboard.press("Tab")
    page.keyboard.press("Shift+Tab")
    found: dict[str, bool] = {}
    while (said := page.evaluate(FOCUSED)) is not None and len(found) < 60:
        found.setdefault(*said)
        page.keyboard.press("Tab")
    return found


def reaches(page: Any, *names: str) -> None:
    """Check that Tab reaches these, that all it reaches has a name, and that the focus shows on it."""
    reached = tabbed(page)
    assert [name for name, shows in reached.items() if not shows] == []
    assert "" not in reached
    assert {"Skip to the step", *names} <= set(reached)


class Hand:
    """A person at the page, with the keyboard alone."""

    def __init__(self, page: Any) -> None:
        self.page = page
        page.set_default_timeout(300_000)  # after which a page has come to a stop, on a busy machine as well

    def press(self, name: str) -> None:
        button = self.page.locator("#step").get_by_role("button", name=name, exact=True)
        button.focus()
        self.page.wait_for_function("b => !b.disabled", arg=button.element_handle())
        self.page.keyboard.press("Enter")

    def write(self, label: str, text: str) -> None:
        field = self.page.get_by_label(label)
        field.focus()
        self.page.keyboard.press("Control+A")
        self.page.keyboard.type(text)

    def pick(self, file: Path) -> None:
        """Open the picker of files, and choose one in it."""
        with self.page.expect_file_chooser() as opened:
            self.page.locator("#step input[type=file]").press("Enter")
        opened.value.set_files(file)

    def choose(self, label: str, option: str) -> None:
        self.page.get_by_label(label, exact=True).press("Enter")
        self.page.get_by_role("option", name=option, exact=True).wait_for()
        marked = self.page.locator(".q-item.q-manual-focusable--focused")
        for _ in range(30):
            self.page.keyboard.press("ArrowDown")
            if marked.inner_text() == option:
                break
        self.page.keyboard.press("Enter")

    def step(self, name: str) -> None:
        self.page.get_by_role("navigation").get_by_role("button", name=re.compile(f"{name} \\w")).press("Enter")
        self.page.get_by_role("heading", name=name, level=1).wait_for()

    def done(self, step: str) -> None:
        tab = self.page.get_by_role("navigation").get_by_role(
            "button", name=re.compile(f"{step}.*(done|doubtful)", re.S)
        )
        tab.wait_for()


@pytest.mark.slow
def test_a_test_day_from_machine_to_named_cause(tmp_path: Path, browser: Any, straight: Model) -> None:
    motion = simulate(straight, drive(straight, 12, 1, {"u1": 1500, "u4": 1500}))
    (tmp_path / "logger").mkdir()
    logged(straight, motion, tmp_path / "logger" / "log.csv", 3, "roll_unbalance@front_roll=300")
    with window(tmp_path) as (address, _):
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        elsewhere: list[str] = []
        page.on("request", lambda r: None if r.url.startswith((address, "data:")) else elsewhere.append(r.url))
        page.goto(address)
        hand = Hand(page)
        hand.choose("Machine", "va12_straight")
        page.get_by_role("button", name="Check the machine").wait_for()
        reaches(page, "Machine", "Check the machine", "Take the machine file")
        hand.press("Check the machine")
        hand.done("Machine")

        hand.step("Design")
        hand.write("Length of the drive", "-5")
        page.get_by_text("must be 1 or more (got -5)").wait_for()
        page.get_by_role("button", name="Design the drive", disabled=True).wait_for()
        hand.write("Length of the drive", "12")
        hand.write("Starting guesses", "1")
        hand.choose("Minimise", "accuracy")
        reaches(page, "Length of the drive [s]", "Minimise", "Design the drive")
        hand.press("Design the drive")
        page.get_by_text("best so far").wait_for()
        page.close()  # closed in the middle of the design, and opened again, by two browsers
        page, other = (browser.new_page(viewport={"width": w, "height": 1000}) for w in (1400, 800))
        page.goto(address)
        other.goto(address)
        hand = Hand(page)
        for one in (page, other):
            one.get_by_text("best so far").wait_for()
        Hand(other).press("Stop and keep the best")
        hand.done("Design")
        design = json.loads((tmp_path / "results/design-va12_straight/summary.json").read_text())
        assert not design["complete"]
        assert design["max_violation"] < 1e-3

        hand.step("Drive")
        reaches(page, "Make sheet and page")
        hand.press("Make sheet and page")
        hand.done("Drive")
        assert (tmp_path / "results/drive-va12_straight/sheet.pdf").read_bytes().startswith(b"%PDF")
        page.get_by_role("link", name="page for the cab").wait_for()

        hand.step("Log")
        hand.write("Path of another log", "nothing.csv")
        hand.press("Take the log")
        page.get_by_role("alert").get_by_text("nothing.csv").wait_for()
        hand.pick(tmp_path / "logger" / "log.csv")
        page.get_by_text("a log: results/log.csv").wait_for()
        assert (tmp_path / "results/log.csv").read_bytes() == (tmp_path / "logger/log.csv").read_bytes()
        reaches(page, "Path of another log", "Take the log", "Check the log")
        hand.press("Check the log")
        hand.done("Log")

        hand.step("Identify")
        reaches(page, "Method", "Identify")
        hand.press("Identify")
        hand.done("Identify")
        hand.step("Diagnose")
        reaches(page, "Diagnose")
        hand.press("Diagnose")
        hand.done("Diagnose")
        found = json.loads((tmp_path / "results/diagnose-va12_straight/summary.json").read_text())
        assert found["verdict"] == "named"
        assert [(f["effect"], f["where"]) for f in found["findings"]] == [("roll_unbalance", "front_roll")]
        assert abs(found["findings"][0]["amount"] - 300) < 4 * found["findings"][0]["amount_std"]
        page.get_by_text("The log shows roll unbalance").wait_for()
        other.get_by_role("navigation").get_by_role("button", name="Diagnose").get_by_text("done").wait_for()
        width = "document.documentElement.scrollWidth <= innerWidth"
        assert page.evaluate(width)
        assert other.evaluate(width)
        assert not elsewhere
