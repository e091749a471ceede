"""The driver's page in a real browser, and the server behind it: timing, hands, score, size, who may connect."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from excite.errors import ServeError
from excite.model import Model, build
from excite.model.machine import Quantity, load_machine
from excite.operator import Trace, ground, page, server as serve
from excite.reports import html as html_page
from excite.simulation import sensors

TRACE = Trace(
    np.array([0.0, 3, 6, 8.5, 11, 14]),
    np.array([0.0, 1.2, 1.2, 0, -0.8, 0]),
    -np.array([[0.0], [0], [0.3], [0.3], [0], [0]]),
    ground.find_levers(build(load_machine("va12"))),
)
STARTS = [0.0, 3, 6, 8.5, 11]


@pytest.fixture(scope="module")
def html(va12: Model) -> str:
    return page.driver_page(va12, TRACE, "A drive")


TANDEM = build(load_machine("tandem"))
FRONT, REAR = ground.find_levers(TANDEM)
TWO = Trace(
    TRACE.times,
    TRACE.speed,
    np.deg2rad([[0.0, 0], [0, -12], [26, -12], [26, 14], [0, 14], [0, 0]]) * [FRONT.left, REAR.left],
    (FRONT, REAR),
)


@pytest.fixture(scope="module")
def two_html() -> str:
    return page.driver_page(TANDEM, TWO, "A drive with two steered joints")


class Tab:
    """The page open in a phone held sideways, with what its console said."""

    def __init__(self, browser: Any, address: str, fake: bool, size: tuple[int, int] = (844, 390)) -> None:
        self.context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, has_touch=True, reduced_motion="reduce"
        )
        self.page = self.context.new_page()
        self.said: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda r: self.said.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
        if fake:
            self.page.clock.install(time=0)
        self.page.goto(address)
        if fake:
            self.page.clock.pause_at(1000)

    def shows(self, id: str, text: str) -> None:
        self.page.locator(id, has_text=text).wait_for(state="attached", timeout=60_000)

    def text(self, id: str) -> str:
        return str(self.page.inner_text(id))

    def seconds(self) -> float:
        return float(self.page.evaluate("aid.time()"))


@pytest.fixture
def open_page(browser: Any, html: str, tmp_path: Path) -> Iterator[Callable[..., Tab]]:
    tabs: list[Tab] = []
    path = tmp_path / "driver.html"

    def open(fake: bool = True, size: tuple[int, int] = (844, 390), text: str = html) -> Tab:
        path.write_text(text, encoding="utf-8")
        tabs.append(Tab(browser, path.as_uri(), fake, size))
        return tabs[-1]

    yield open
    for tab in tabs:
        tab.context.close()
        assert tab.said == []  # no error, no warning, no network


def test_page_is_one_file_without_network(html: str) -> None:
    assert re.findall(r"https?://[\w.]+", html) == []
    assert re.findall(r'(?:src|href)="(?!data:)[^"]*"', html) == []
    assert "default-src 'none'" in html


def test_title_cannot_break_out_of_the_page(va12: Model) -> None:
    evil = "</script><script>alert(1)</script>"
    assert evil not in page.driver_page(va12, TRACE, evil)


def test_phases_come_on_time_over_a_drive(open_page: Callable[..., Tab]) -> None:
    """Every phase appears within 50 ms of its time, whatever frames do; the clock never drifts."""
    tab = open_page()
    tab.page.tap("#start")
    shown = []
    for _ in range(19):
        tab.page.clock.run_for(1000)
        shown.append(tab.seconds())
    assert np.abs(np.array(shown[:18]) - np.arange(-4, 14)).max() < 0.05
    tab.page.clock.run_for(50)  # the frame that sees the end
    events = tab.page.evaluate("aid.events")
    assert [e["phase"] for e in events if e["phase"] >= 0] == [0, 1, 2, 3, 4]
    begin = events[0]["clock"] / 1000 - events[0]["t"]
    for event, due in zip([e for e in events if e["phase"] >= 0], STARTS, strict=True):
        assert 0 <= event["clock"] / 1000 - begin - due < 0.05
    assert tab.text("#action").startswith("Finished")
    assert tab.text("#start") == "Again"


def test_what_the_driver_reads(open_page: Callable[..., Tab]) -> None:
    tab = open_page()
    assert tab.text("#action") == "Get ready: accelerate to 1.2 m/s"
    tab.page.tap("#start")
    tab.page.clock.run_for(5000 + 4200)
    assert tab.text("#action").splitlines() == ["hold 1.2 m/s", "steer to 17° left"]
    assert tab.text("#next") == "then brake to a stop, keep 17° left"
    assert tab.text("#count") == "2"
    assert tab.page.get_attribute("#now", "class") == "soon"
    assert tab.text("#speed .value") == "1.2 m/s"
    assert tab.text("#angle0 .value") == "7° left"
    assert tab.text("#clock") == "0:04 / 0:14"
    tab.page.keyboard.press("u")
    tab.page.clock.run_for(50)
    assert tab.text("#speed .value") == "4.3 km/h"
    assert tab.text("#action").startswith("hold 4.3 km/h")


@pytest.mark.slow
def test_the_driver_reads_every_joint(open_page: Callable[..., Tab], two_html: str, tmp_path: Path) -> None:
    """Targets, words, what a log of the machine's own columns shows, and the score, joint by joint."""
    tab = open_page(text=two_html)
    table = sensors.measure(TANDEM, ground.follow_trace(TANDEM, TWO, None, 4), seed=1)
    table.to_csv(tmp_path / "log.csv", index=False)
    tab.page.set_input_files("#log", tmp_path / "log.csv")
    tab.shows("#note", "begins")
    tab.page.tap("#start")
    tab.page.clock.run_for(5000 + 4500)
    assert tab.text("#action").splitlines() == [
        "hold 1.2 m/s",
        "front steering to 26° left",
        "keep rear steering 12° right",
    ]
    assert tab.text("#next") == "then brake to a stop, rear steering to 14° left"  # what changes
    t = tab.seconds()
    for k, degrees in enumerate(np.interp(t, TWO.times, d) for d in TWO.degrees.T):
        side = "left" if degrees > 0 else "right"
        assert tab.text(f"#angle{k} .value") == f"{abs(degrees):.0f}° {side}"
        assert tab.text(f"#angle{k} .seen").endswith(side)
    tab.page.clock.run_for(11_000)
    score = tab.page.evaluate("aid.score()")
    t = table["t_s"].to_numpy()
    for k, lever in enumerate((FRONT, REAR)):
        got, wanted = table[lever.column], TWO.at(t)[1][:, k]
        low, high = ground.tolerance_band(t, wanted, ground.BAND_ANGLE)
        assert score["angle_percent"][k] == pytest.approx(100 * np.mean((got >= low) & (got <= high)), abs=0.3)
        off = np.rad2deg(np.sqrt(np.mean((got - wanted) ** 2)))
        assert score["angle_rms_deg"][k] == pytest.approx(off, rel=0.01)
    assert ", rear steering by" in tab.text("#next")


def test_joints_may_be_called_as_words_end(open_page: Callable[..., Tab]) -> None:
    """What comes says the whole name, here of joints that are called front steer and rear steer."""
    names = ("front_steer", "rear_steer")
    bodies = [j.body.model_copy(update={"place": name}) for j, name in zip(TWO.levers, names, strict=True)]
    levers = tuple(replace(j, body=body) for j, body in zip(TWO.levers, bodies, strict=True))
    tab = open_page(text=page.driver_page(TANDEM, replace(TWO, levers=levers), "A drive"))
    tab.page.tap("#start")
    tab.page.clock.run_for(5000 + 4500)
    assert tab.text("#next") == "then brake to a stop, rear steer to 14° left"


def test_start_pause_and_repeat_by_touch_and_key(open_page: Callable[..., Tab]) -> None:
    tab = open_page()
    tab.page.clock.run_for(3000)
    assert tab.seconds() == -5
    tab.page.keyboard.press("Space")
    tab.page.clock.run_for(8000)
    tab.page.tap("#start")
    paused = tab.seconds()
    assert paused == pytest.approx(3, abs=0.05)
    assert tab.text("#start") == "Go on"
    tab.page.clock.run_for(10_000)
    assert tab.seconds() == paused
    tab.page.tap("#start")
    tab.page.clock.run_for(2000)
    assert tab.seconds() == pytest.approx(paused + 2, abs=0.05)
    tab.page.keyboard.press("r")
    assert tab.seconds() == pytest.approx(-5, abs=0.05)
    tab.page.clock.run_for(6000)
    assert tab.seconds() == pytest.approx(1, abs=0.05)
    tab.page.tap("#repeat")
    assert tab.seconds() == pytest.approx(-5, abs=0.05)
    tab.page.tap("#sound")
    assert tab.page.get_attribute("#sound", "aria-pressed") == "false"


@pytest.mark.slow
def test_real_time_is_kept(open_page: Callable[..., Tab]) -> None:
    """Against this process's own clock: what is painted is the time within 50 ms, after seconds as at the start."""
    tab = open_page(fake=False)
    tab.page.keyboard.press("s")
    tab.page.tap("#start")
    lags, least, most = [], [], []
    for _ in range(10):
        before = time.perf_counter()
        now, painted = tab.page.evaluate("[aid.time(), Number(document.body.dataset.t)]")
        least.append(now - time.perf_counter())  # a busy machine answers late: the page read its clock in between
        most.append(now - before)
        lags.append(now - painted)
        time.sleep(0.35)
    assert max(least) - min(most) < 0.05
    assert float(np.median(lags)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["va12", "tandem"])
@pytest.mark.parametrize("size", [(844, 390), (667, 375), (1280, 800), (390, 844)])
def test_everything_fits_and_is_big(
    open_page: Callable[..., Tab], html: str, two_html: str, name: str, size: tuple[int, int]
) -> None:
    tab = open_page(size=size, text={"va12": html, "tandem": two_html}[name])
    tab.page.tap("#start")
    for wait in (100, 6000, 3500, 2500, 2500, 2500):
        tab.page.clock.run_for(wait)
        for id in ("#now", "#words", "#targets", "#bar", "body"):
            high, room = tab.page.evaluate(f"(e => [e.scrollHeight, e.clientHeight])(document.querySelector('{id}'))")
            assert high <= room + 1, (id, tab.text("#action"))
    style = "e => parseFloat(getComputedStyle(e).fontSize)"
    short = min(size)
    assert tab.page.eval_on_selector("#count", style) >= 0.16 * short  # 10 mm and more on a phone: read at two metres
    assert tab.page.eval_on_selector("#speed .value", style) >= (0.10 if name == "va12" else 0.07) * short
    for target in tab.page.locator(".target").all():
        box = target.bounding_box()
        assert box["x"] + target.evaluate("e => e.scrollWidth") <= size[0]
    for id in ("#start", "#repeat"):
        assert tab.page.locator(id).bounding_box()["height"] >= 40
    seen = tab.page.evaluate(
        "(c => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        " let dark = 0; for (let k = 0; k < d.length; k += 4) dark += d[k + 3] > 200 && d[k] < 60; return dark; })"
        "(document.getElementById('trace'))"
    )
    assert seen > 500


@pytest.mark.parametrize("size", [(844, 390), (667, 375), (1280, 800), (390, 844)])
@pytest.mark.parametrize(("name", "trace"), [("va12", TRACE), ("tandem", TWO)])
def test_where_to_start_is_shown_until_the_drive_begins(
    open_page: Callable[..., Tab], va12: Model, name: str, trace: Trace, size: tuple[int, int]
) -> None:
    model = {"va12": va12, "tandem": TANDEM}[name]
    q = np.zeros((2, len(model.coordinates)))
    q[:, :3] = [-13.1, -14.1, np.deg2rad(-142)]
    motion = replace(ground.follow_trace(model, trace, None, 0), t=np.arange(2) / 100, q=q, nu=np.zeros_like(q))
    start = ground.start_words(model, motion, trace)
    tab = open_page(size=size, text=page.driver_page(model, trace, "A drive", start))
    tab.page.clock.run_for(100)
    assert tab.text("#next") == start
    for id in ("#now", "#words", "body"):
        high, room = tab.page.evaluate(f"(e => [e.scrollHeight, e.clientHeight])(document.querySelector('{id}'))")
        assert high <= room + 1, id
    tab.page.tap("#start")
    tab.page.clock.run_for(100)
    assert "Start, seen" not in tab.text("#now")


@pytest.fixture(scope="module")
def followed(va12: Model) -> pd.DataFrame:
    return sensors.measure(va12, ground.follow_trace(va12, TRACE, None, 4), seed=1)


@pytest.mark.slow
def test_a_log_is_replayed_and_scored(
    open_page: Callable[..., Tab], va12: Model, followed: pd.DataFrame, tmp_path: Path
) -> None:
    """The page's score is that of the band, computed here from the same log."""
    followed.to_csv(tmp_path / "log.csv", index=False)
    t = followed["t_s"].to_numpy()
    turned = 0.65 * (followed["theta1_rad"] + followed["theta4_rad"]).to_numpy() / 2
    near, far = np.maximum(np.arange(len(t)) - 10, 0), np.minimum(np.arange(len(t)) + 10, len(t) - 1)
    speed = (turned[far] - turned[near]) / (t[far] - t[near])
    angle = followed["theta2_rad"].to_numpy()
    wanted = TRACE.at(t)
    inside = []
    for value, reference, tolerance in zip(
        (speed, angle), (wanted[0], wanted[1][:, 0]), (ground.BAND_SPEED, ground.BAND_ANGLE), strict=True
    ):
        low, high = ground.tolerance_band(t, reference, tolerance)
        inside.append((value >= low) & (value <= high))
    tab = open_page()
    tab.page.set_input_files("#log", tmp_path / "log.csv")
    tab.shows("#note", "begins")
    assert "1401 rows, the drive begins at 0.0 s" in tab.text("#note")
    tab.page.tap("#start")
    tab.page.clock.run_for(5000 + 5000)
    k = round(100 * tab.seconds())
    assert tab.text("#speed .seen") == f"is {speed[k]:.1f} m/s"
    assert tab.text("#angle0 .seen").endswith("left")
    tab.page.clock.run_for(10_000)
    score = tab.page.evaluate("aid.score()")
    assert score["samples"] == 1401
    assert score["speed_percent"] == pytest.approx(100 * inside[0].mean(), abs=0.3)
    assert score["angle_percent"] == pytest.approx([100 * inside[1].mean()], abs=0.3)
    assert score["in_band_percent"] == pytest.approx(100 * (inside[0] & inside[1]).mean(), abs=0.3)
    assert score["speed_rms_m_s"] == pytest.approx(np.sqrt(np.mean((speed - wanted[0]) ** 2)), rel=0.01)
    off = np.rad2deg(np.sqrt(np.mean((angle - wanted[1][:, 0]) ** 2)))
    assert score["angle_rms_deg"] == pytest.approx([off], rel=0.01)
    assert f"{score['in_band_percent']:.0f} % of the time" in tab.text("#next")


def test_a_log_that_began_earlier_is_found_in_time(
    open_page: Callable[..., Tab], followed: pd.DataFrame, tmp_path: Path
) -> None:
    """Five seconds at rest before the drive, decimal commas: the drive is found in it, as late as the driver was."""
    early = followed.reindex(np.maximum(np.arange(-500, len(followed) + 300), 0), method="nearest")
    early = early.iloc[:].reset_index(drop=True).assign(t_s=lambda x: np.arange(len(x)) / 100)
    early.to_csv(tmp_path / "log.csv", index=False, sep=";", decimal=",")
    tab = open_page()
    tab.page.set_input_files("#log", tmp_path / "log.csv")
    tab.shows("#note", "begins")
    found = re.search(r"begins at ([\d.]+) s", tab.text("#note"))
    assert found
    assert 5.0 <= float(found[1]) <= 6.3
    followed.drop(columns=["theta2_rad"]).to_csv(tmp_path / "other.csv", index=False)
    tab.page.set_input_files("#log", tmp_path / "other.csv")
    tab.shows("#note", "no column")
    assert tab.text("#note") == "the log has no column theta2_rad"


# ------------------------------------------------------------------------------------------------ the server


@contextmanager
def running(html: str, host: str = serve.HOST) -> Iterator[tuple[str, Callable[[dict[str, float]], object]]]:
    loop, ready = asyncio.new_event_loop(), threading.Event()
    found: dict[str, Any] = {}

    async def work() -> None:
        found["end"] = asyncio.Event()
        async with serve.running_server(html, ("articulation_rad",), host=host) as (server, send):
            found["address"] = f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
            found["send"] = send
            ready.set()
            await found["end"].wait()

    thread = threading.Thread(target=loop.run_until_complete, args=(work(),), daemon=True)
    thread.start()
    assert ready.wait(10)
    try:
        yield found["address"], lambda said: loop.call_soon_threadsafe(found["send"], said)
    finally:
        loop.call_soon_threadsafe(found["end"].set)
        thread.join(20)
        loop.close()


def test_live_values_are_shown(browser: Any, html: str) -> None:
    with running(html) as (address, send):
        tab = Tab(browser, f"http://{address}/", fake=False)
        tab.shows("#note", "live values")
        send({"v_m_s": 0.74, "articulation_rad": -0.2})
        tab.shows("#speed .seen", "is 0.7 m/s")
        assert tab.text("#angle0 .seen") == "is 11° left"  # what is negative turns this machine to the left
        with connect(f"ws://{address}/live") as logger:
            logger.send(json.dumps({"t_s": 1, "v_m_s": -0.3, "articulation_rad": 0.1}))
            tab.shows("#speed .seen", "is 0.3 m/s backward")
        assert [s for s in tab.said if "127.0.0.1" not in s] == []
        tab.context.close()


def test_pages_from_elsewhere_are_refused(html: str) -> None:
    with running(html) as (address, _):
        port = int(address.split(":")[1])
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{address}/live", origin=Origin("https://evil.example"))
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{address}/live", origin=Origin("null"))
        with connect(f"ws://{address}/live", origin=Origin(f"http://{address}")):
            pass
        for host, status in (
            (f"evil.example:{port}", b"403"),
            (address, b"200"),
        ):  # a name that points here (rebinding)
            with socket.create_connection(("127.0.0.1", port)) as plain:
                plain.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
                answer = plain.recv(1000)
            assert answer.split()[1] == status


def test_a_phone_on_the_network_gets_live_values(browser: Any, html: str) -> None:
    """By another address than the loopback one of a server that listens on all; by its number alone, still."""
    with running(html, "0.0.0.0") as (address, send):
        port = int(address.split(":")[1])
        tab = Tab(browser, f"http://127.0.0.2:{port}/", fake=False)
        tab.shows("#note", "live values")
        send({"v_m_s": 0.74, "articulation_rad": -0.2})
        tab.shows("#speed .seen", "is 0.7 m/s")
        tab.context.close()
        for host, status in ((f"127.0.0.2:{port}", 200), (f"localhost:{port}", 403), (f"evil.example:{port}", 403)):
            with socket.create_connection(("127.0.0.2", port)) as plain:
                plain.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
                assert int(plain.recv(1000).split()[1]) == status
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.2:{port}/live", origin=Origin("https://evil.example"))


def test_addresses_to_open_are_numbers_of_this_machine() -> None:
    assert serve.reachable_addresses(serve.HOST) == ["127.0.0.1"]
    assert serve.reachable_addresses("192.168.1.7") == ["192.168.1.7"]
    assert serve.reachable_addresses("::1") == ["[::1]"]
    *others, last = serve.reachable_addresses("0.0.0.0")
    assert last == "127.0.0.1"
    for other in others:
        with socket.socket() as listener:
            listener.bind((other, 0))  # raises where it is another machine's
    assert serve.reachable_addresses("::")[-1] == "[::1]"


def test_an_address_that_is_not_this_machines_is_refused(html: str, excite: Excite) -> None:
    async def listen() -> None:
        async with serve.running_server(html, (), host="192.0.2.1"):
            pass

    # in a thread of its own, for the browser's loop runs in this one
    with (
        ThreadPoolExecutor() as pool,
        pytest.raises(ServeError, match=r"--host 192.0.2.1: is no address of this"),
    ):
        pool.submit(asyncio.run, listen()).result(20)
    for host in ("", "roller"):
        code, _, said = excite("drive", "nowhere", "--serve", "--host", host)
        assert code == 2
        assert f"--host {host}: is no address, give one such as" in said
    code, _, said = excite("drive", "nowhere", "--host", "0.0.0.0")
    assert code == 2
    assert "need --serve as well" in said


def test_only_this_machine_reaches_the_server(html: str) -> None:
    with running(html) as (address, _):
        unreachable(int(address.split(":")[1]))


def unreachable(port: int) -> None:
    """Nothing listens at this port but on 127.0.0.1, and no other address of this machine gets there."""
    addresses = {"127.0.0.2", "::1"}  # loopback too, but not the one that is listened on
    with suppress(OSError):
        addresses |= {str(found[4][0]) for found in socket.getaddrinfo(socket.gethostname(), None)}
    for family, outside in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as udp:
            udp.connect((outside, 9))  # sends nothing: tells which of our addresses would go there
            addresses.add(str(udp.getsockname()[0]))
    for other in addresses - {"127.0.0.1"}:
        with pytest.raises(OSError, match=r"."):
            socket.create_connection((other, port), timeout=2)
    listening = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            if state == "0A" and int(local.partition(":")[2], 16) == port:
                listening.add(local.partition(":")[0])
    assert listening == {"0100007F"}  # 127.0.0.1


def test_a_message_may_be_as_long_as_is_said_and_no_longer(html: str) -> None:
    """Also one that comes in pieces, each of them short."""
    good = '{"v_m_s": 1}'
    with running(html) as (address, _), connect(f"ws://{address}/live") as listener:
        with connect(f"ws://{address}/live") as logger:
            logger.send(good.ljust(serve.MAX_MESSAGE))
            assert json.loads(listener.recv(timeout=5)) == {"v_m_s": 1.0}
            logger.send(good.ljust(serve.MAX_MESSAGE + 1))
            ends(logger, 1009)
        with connect(f"ws://{address}/live") as logger:
            with suppress(ConnectionClosed):
                logger.send([good, *[" " * 100] * 11])
            ends(logger, 1009)
        with pytest.raises(TimeoutError):
            listener.recv(timeout=0.1)


def ends(logger: Any, code: int) -> None:
    """The server ends this connection, for this reason."""
    with pytest.raises(ConnectionClosed) as end:
        logger.recv(timeout=20)
    assert end.value.rcvd is not None
    assert end.value.rcvd.code == code


def test_more_pages_than_are_allowed_are_refused(html: str) -> None:
    with running(html) as (address, _), ExitStack() as stack:
        for _ in range(serve.MAX_CLIENTS):
            stack.enter_context(connect(f"ws://{address}/live"))
        with pytest.raises(InvalidStatus, match="503"):
            connect(f"ws://{address}/live")


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ("x" * 2000, 1009),
        ("not json", 1007),
        ('{"v_m_s": "fast"}', 1007),
        ('{"v_m_s": NaN}', 1007),
        ('{"v_m_s": 1, "evil": 2}', 1007),
        ("[1, 2]", 1007),
        ('{"articulation_rad": 1}', 1007),
    ],
)
def test_bad_messages_end_the_connection(html: str, message: str, code: int) -> None:
    with running(html) as (address, _), connect(f"ws://{address}/live") as listener:
        with connect(f"ws://{address}/live") as logger:
            logger.send(message)
            ends(logger, code)
        with pytest.raises(TimeoutError):
            listener.recv(timeout=0.1)


def test_growing_log_becomes_values(va12: Model, followed: pd.DataFrame, tmp_path: Path) -> None:
    """Written in pieces that end anywhere, even within a number: every row counts once, nothing is misread."""
    path = tmp_path / "log.csv"
    tail = serve.GrowingLog(path, va12.machine, TRACE.levers)
    assert tail.new() == []
    text = followed.to_csv(index=False)
    said = []
    for a, b in zip([0, 333, 5000, 5001, 40_000], [333, 5000, 5001, 40_000, len(text)], strict=True):
        with path.open("a", newline="") as file:
            file.write(text[a:b])
        said += tail.new()
    assert len(said) == len(followed) - 1
    turned = 0.65 * (followed["theta1_rad"] + followed["theta4_rad"]).to_numpy() / 2
    assert said[499]["v_m_s"] == pytest.approx((turned[500] - turned[480]) / 0.2)
    assert said[499]["articulation_rad"] == pytest.approx(followed["theta2_rad"][500])
    path.write_text("t_s,other\n")
    assert tail.new() == []


def test_a_steered_joint_measured_as_a_rate_is_summed_up(va12: Model, tmp_path: Path) -> None:
    """And a byte-order mark is no part of the first column's name."""
    angle = next(s for s in va12.machine.sensor if s.name == "theta2")
    rate = angle.model_copy(
        update={"unit": "deg/s", "counts_per_turn": None, "noise": Quantity(value=0.01, source="assumed")}
    )
    others = tuple(rate if s is angle else s for s in va12.machine.sensor)
    machine = va12.machine.model_copy(update={"sensor": others})
    path = tmp_path / "log.csv"
    rows = "".join(f"{0.1 * k:g},0,0,{9 if k < 11 else 0}\n" for k in range(21))
    path.write_text("\ufefft_s,theta1_rad,theta4_rad,theta2_rad\n" + rows, encoding="utf-8")
    said = serve.GrowingLog(path, machine, TRACE.levers).new()
    assert len(said) == 20
    assert said[-1]["articulation_rad"] == pytest.approx(np.deg2rad(9.0))


def test_an_angle_that_is_missing_silences_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    tail = serve.GrowingLog(path, TANDEM.machine, (FRONT, REAR))
    rims, columns = [s.column for _, s in tail.rims], [s.column for _, s in tail.angles]
    with path.open("w") as file:
        file.write(",".join(["t_s", *rims, columns[0]]) + "\n")
        for k, angle in enumerate(["0.1", "0.1", "nan", "", "inf", "0.2"]):
            file.write(",".join([str(k), *["0" for _ in rims], angle]) + "\n")
    said = tail.new()
    assert [s["v_m_s"] for s in said] == [0] * 5
    assert [set(s) - {"t_s", "v_m_s"} for s in said] == [{FRONT.column}, set(), set(), set(), {FRONT.column}]
    path.write_text(
        ",".join(["t_s", *rims, *columns]) + "\n" + "".join(f"{k},{'0,' * len(rims)}nan,0.3\n" for k in (0, 1))
    )
    assert [set(s) for s in tail.new()] == [{"t_s", "v_m_s", REAR.column}]


@pytest.mark.slow
def test_serve_command_shows_the_page_until_it_is_stopped(tmp_path: Path) -> None:
    """The real command: the page for this machine alone, for no page from elsewhere, with no long message."""
    design = Path(__file__).parents[2] / "results" / "S40" / "design"
    command = [sys.executable, "-m", "excite", "drive", str(design), "--phases", "6", "--serve", "--port", "0"]
    with (
        subprocess.Popen(
            [*command, "--out", str(tmp_path / "d")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as run,
        ExitStack() as ends_whatever_fails,
    ):
        ends_whatever_fails.callback(run.kill)
        assert run.stderr is not None
        line = next(line for line in run.stderr if "http" in line)  # whatever libraries say before
        address = line.split()[0]
        port = int(address.rstrip("/").rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port)) as plain:
            plain.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            assert b"200" in plain.recv(100)
        unreachable(port)
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{port}/live", origin=Origin("https://evil.example"))
        with connect(f"ws://127.0.0.1:{port}/live") as logger:
            logger.send('{"v_m_s": 1}'.ljust(serve.MAX_MESSAGE + 1))
            ends(logger, 1009)
        run.terminate()
        assert run.wait(20) == 0
    assert (tmp_path / "d" / "driver.html").is_file()


def test_remarks_are_sentences_and_commands_set_off() -> None:
    assert str(html_page.sentence("a low cond hides it")) == "A low cond hides it."
    assert (
        str(html_page.sentence("poor accuracy: run `excite design`"))
        == "Poor accuracy: run <code>excite design</code>."
    )
    assert str(html_page.sentence("u1_Nm is <late>!")) == "u1_Nm is &lt;late&gt;!"
    assert str(html_page.sentence("machine.toml beside it works.")) == "machine.toml beside it works."


def test_words_stand_left_and_numbers_right() -> None:
    table = html_page.Table(
        "t", ("what", "unit", "value", "95 %", "kept"), (("M", "kg", "-3.1", "-", "3/20"), ("x", "m", "-", "-", "-"))
    )
    assert table.text_columns == (0, 1, 3)
