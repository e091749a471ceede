"""Folders as other programs and people leave them: a line each in the window, and no answer 500."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import socket
import stat
import threading
import time
from collections.abc import Callable, MutableMapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import pytest

from excite.app.day import Day
from excite.errors import DiskError

pytest.importorskip("nicegui", reason="the extra app is not installed")

DEEP = "[" * 100_000 + "]" * 100_000
ODD = {
    "list": "[1, 2]",
    "number": "3",
    "deep": DEEP,
    "no_json": "{",
    "columns_of_pandas": json.dumps({"columns": ["a", "b"], "index": [0]}),
    "log_of_another_type": json.dumps({"columns": [], "log": 3, "faults": [], "doubts": []}),
    "nul": json.dumps({"columns": {}, "log": "a\0b", "faults": [], "doubts": [], "machine": "va12"}),
    "long": json.dumps({"columns": {}, "log": "a" * 5000, "faults": [], "doubts": [], "machine": "va12"}),
    "findings": json.dumps({"findings": None, "machine": "va12", "logs": []}),
    "phases": json.dumps({"phases": 1}),
    "design": json.dumps({"cond_phi_start": 1, "machine": "va12", "worst_percent": "x"}),
    "half_a_pair": '{"phases": "\\ud800"}',
    "bytes": "\xff\xfe",
}


def folder(place: Path) -> Path:
    results = place / "results"
    for name, text in ODD.items():
        (results / name).mkdir(parents=True)
        (results / name / "summary.json").write_bytes(text.encode("latin-1") if name == "bytes" else text.encode())
    for name in ("pipe", "here"):
        (results / name).mkdir()
    os.mkfifo(results / "pipe" / "summary.json")
    os.mkfifo(results / "fifo.csv")
    os.mkfifo(results / "fifo.toml")
    (results / "folder.csv").mkdir()
    (results / "loop.csv").symlink_to("loop.csv")
    foreign = {"machine": ["x"], "logs": ["a\0", "b" * 5000], "forms": [], "accepted": 3}
    (results / "app.json").write_text(json.dumps(foreign))
    return results


def test_what_no_step_can_show_is_a_line(tmp_path: Path) -> None:
    day = Day(folder(tmp_path))
    with day.glance():
        lines = "\n".join(day.passed_over)
    for name in (*(n for n in ODD if n not in ("number", "list")), "pipe", "fifo.csv", "fifo.toml", "folder.csv"):
        assert f"/{name}" in lines, name
    assert all(len(line) < 500 for line in day.passed_over)
    assert day.known_logs() == []
    assert day.results() == []


def test_choices_of_another_type_are_left_out(tmp_path: Path) -> None:
    kept = {"forms": {"design": {"starts": "x", "budget": 20, "driver": 1, "objective": "accuracy"}}}
    (tmp_path / "app.json").write_text(json.dumps(kept))
    form = Day(tmp_path).forms["design"]
    assert (form["starts"], form["budget"], form["driver"], form["objective"]) == (2, 20, False, "accuracy")


def request(address: str, method: str, path: str, body: bytes | None = None) -> tuple[int, str]:
    at = urlsplit(address)
    link = http.client.HTTPConnection(at.hostname, at.port, timeout=60)
    link.request(method, at.path + path, body)
    got = link.getresponse()
    return got.status, got.read().decode(errors="replace")


def test_the_server_never_answers_500(tmp_path: Path) -> None:
    from test_window import window

    results = folder(tmp_path)
    with window(tmp_path) as (address, _):
        code, page = request(address, "GET", "")
        assert code == 200
        assert "it is not shown" in page
        for odd in ("a" * 5000, "a%00b", "fifo.csv", "loop.csv", "pipe/summary.json", "%ff%fe", "a/" * 2000):
            assert request(address, "GET", f"files/{odd}")[0] in (404, 414), odd
        for odd in ("a" * 5000 + ".csv", "a%00b.csv", "a%0ab.csv", "x.exe", "x", ".csv", "machine.toml", "x.TOML"):
            code, said = request(address, "POST", f"log/{odd}", b"t_s\n0\n")
            assert code in (400, 404, 414), (odd, code, said)
        assert request(address, "POST", "log/fifo.csv", b"x")[0] == 409
        at = urlsplit(address)
        with socket.create_connection((at.hostname, at.port)) as half:  # a reader that goes away
            head = f"POST {at.path}log/half.csv HTTP/1.1\r\nHost: {at.netloc}\r\nContent-Length: 1000000\r\n\r\n"
            half.sendall(head.encode() + b"t_s\n" * 100)
        time.sleep(0.5)
        assert request(address, "POST", f"log/{quote('drive 1.csv')}", b"t_s\n0\n")[0] == 200
        assert request(address, "POST", f"log/{quote('drive 1.csv')}", b"other")[0] == 409
        assert (results / "drive 1.csv").read_bytes() == b"t_s\n0\n"
        assert not (results / "half.csv").exists()

        codes: list[int] = []

        def hand_over(letter: bytes) -> None:
            codes.append(request(address, "POST", "log/both.csv", letter * 3_000_000)[0])

        both = [threading.Thread(target=hand_over, args=(letter,)) for letter in (b"a", b"b")]
        for one in both:
            one.start()
        for one in both:
            one.join()
        assert sorted(codes) == [200, 409]
        assert request(address, "GET", "")[0] == 200


@pytest.mark.parametrize("change", [Path.unlink, lambda path: os.truncate(path, 1_000_000)], ids=["deleted", "cut off"])
def test_a_file_may_go_while_it_is_sent(change: Callable[[Path], None], tmp_path: Path) -> None:
    from excite.app import server

    path = tmp_path / "big.csv"
    path.write_bytes(b"1\n" * 1_000_000)
    sent: list[MutableMapping[str, Any]] = []

    async def send(message: MutableMapping[str, Any]) -> None:
        if not sent:
            change(path)
        sent.append(message)

    async def receive() -> MutableMapping[str, Any]:
        await asyncio.sleep(60)
        return {"type": "http.disconnect"}

    scope = {"type": "http", "method": "GET", "path": "/files/big.csv", "query_string": b"", "headers": []}
    asyncio.run(server.web_app(Day(tmp_path))(scope, receive, send))
    size = sum(len(message.get("body", b"")) for message in sent)
    assert sent[0]["status"] == 200
    assert size >= 1_000_000
    assert int(dict(sent[0]["headers"]).get(b"content-length", size)) == size


def test_the_browser_is_led_by_a_file_that_nobody_else_can_read(tmp_path: Path) -> None:
    from excite.app import server

    door = server._redirect(tmp_path, "http://127.0.0.1:1/secret/")
    assert stat.S_IMODE(door.stat().st_mode) == 0o600
    assert "secret" in door.read_text()
    assert "secret" not in str(door)


def test_an_upload_without_room_is_one_line(tmp_path: Path) -> None:
    from starlette.testclient import TestClient

    from excite.app import server

    def full(_: Path, replace: bool = True) -> None:
        raise DiskError("log.csv: could not be written: No space left on device; free some space")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server.output, "new_file", full)
        answer = TestClient(server.web_app(Day(tmp_path))).post("/log/log.csv", content=b"t_s\n0\n")
    assert answer.status_code == 400
    assert answer.text == "log.csv: could not be written: No space left on device; free some space"
