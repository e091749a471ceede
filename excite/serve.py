"""The driver's page over this machine's own network alone, with live values: `excite drive --serve`.

One small server gives the page and passes on what is measured: from a log that grows, or from any program on this
machine that sends `{"v_m_s": 1.2, "angle_rad": 0.1}` to ws://127.0.0.1:PORT/live. It listens on the loopback address,
takes no connection that a page from elsewhere asks for (Origin and Host are checked: a web site in the same browser
must neither read nor fake measurements) and no message longer than MESSAGE bytes.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from excite import interrupt
from model.machine import Machine
from model.units import UNITS

HOST = "127.0.0.1"
MESSAGE = 1024  # bytes
CLIENTS = 16
KEYS = ("t_s", "v_m_s", "angle_rad")
POLL = 0.05  # s between looks at a growing log
SPAN = 0.2  # s of rolling that a speed is taken from


class ServeError(RuntimeError):
    """The page can't be served: the message says why and what to do."""


@asynccontextmanager
async def serving(page: str, port: int = 0) -> AsyncIterator[tuple[Server, Callable[[dict[str, float]], None]]]:
    """The running server and a function that sends values to every page. Port 0 takes a free one.

    Raises ServeError where the port is taken.
    """
    allowed: set[str] = set()
    pages: set[ServerConnection] = set()

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if host not in allowed or (origin is not None and origin not in {f"http://{h}" for h in allowed}):
            return connection.respond(HTTPStatus.FORBIDDEN, "for pages of this server alone\n")
        if request.path == "/live":
            if len(pages) >= CLIENTS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages\n")
            return None
        if request.path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "only / and /live are here\n")
        body = page.encode()
        headers = Headers(
            [
                ("Content-Type", "text/html; charset=utf-8"),
                ("Content-Length", str(len(body))),
                ("Cache-Control", "no-store"),
                ("X-Content-Type-Options", "nosniff"),
                ("Connection", "close"),
            ]
        )
        return Response(200, "OK", headers, body)

    async def talk(connection: ServerConnection) -> None:
        pages.add(connection)
        try:
            async for message in connection:
                said = checked(message)
                if said is None:
                    await connection.close(1007, "send a JSON object of numbers t_s, v_m_s, angle_rad")
                    return
                broadcast(pages - {connection}, json.dumps(said))
        except ConnectionClosed:
            pass
        finally:
            pages.discard(connection)

    try:
        server = await serve(talk, HOST, port, process_request=answer, max_size=MESSAGE, max_queue=16, compression=None)
    except OSError as err:
        raise ServeError(f"--port {port}: can't listen on {HOST}: {err.strerror}; choose another port") from None
    async with server:
        taken = server.sockets[0].getsockname()[1]
        allowed |= {f"{HOST}:{taken}", f"localhost:{taken}"}
        yield server, lambda said: broadcast(set(pages), json.dumps(said))


def checked(message: str | bytes) -> dict[str, float] | None:
    """A message as numbers by known keys, None where it is anything else."""
    try:
        said = json.loads(message)
    except ValueError:
        return None
    if not isinstance(said, dict) or "v_m_s" not in said or set(said) - set(KEYS):
        return None
    for value in said.values():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return None
    return {k: float(v) for k, v in said.items()}


class Tail:
    """A growing CSV log in a machine's own columns, read as it grows: speed of the rolls' rims and articulation."""

    def __init__(self, path: Path, machine: Machine) -> None:
        self.path, self.machine = path, machine
        self.place = 0
        self.rest = ""
        self.names: list[str] = []
        self.rows: list[tuple[float, float, float | None]] = []  # time [s], way rolled [m], angle [rad]

    def new(self) -> list[dict[str, float]]:
        """The values of the rows that are new since the last call; lines that are no numbers are left out."""
        if not self.path.is_file():
            return []
        if self.path.stat().st_size < self.place:  # begun afresh
            self.__init__(self.path, self.machine)  # type: ignore[misc]
        with self.path.open(encoding="utf-8", errors="replace", newline="") as file:
            file.seek(self.place)
            text = self.rest + file.read()
            self.place = file.tell()
        *lines, self.rest = text.split("\n")
        said = []
        for line in lines:
            cells = [cell.strip() for cell in line.split(",")]
            if not self.names:
                self.names = cells
                continue
            value = self._row(dict(zip(self.names, cells, strict=False)))
            if value is not None:
                said.append(value)
        return said

    def _row(self, cells: dict[str, str]) -> dict[str, float] | None:
        sensors = {s.body: s for s in self.machine.sensors("full") if s.kind == "angle"}
        rolls = [(b, sensors[b.index]) for b in self.machine.contacts if b.index in sensors]
        wheel = next((s for i, s in sensors.items() if self.machine.find(i).contact is None), None)
        try:
            t = UNITS[self.machine.time_unit][1] * float(cells[self.machine.time_column])
            ways = []
            for b, s in rolls:
                number = float(b.contact.radius if b.contact else 0) * s.gain * float(cells[s.column])
                if s.is_rate and self.rows:
                    number = self.rows[-1][1] + number * (t - self.rows[-1][0])
                ways.append(number)
            angle = wheel.gain * float(cells[wheel.column]) if wheel is not None else None
        except (KeyError, ValueError):
            return None
        if not ways or not math.isfinite(t + sum(ways)):
            return None
        self.rows.append((t, sum(ways) / len(ways), angle))
        while len(self.rows) > 2 and self.rows[1][0] <= t - SPAN:
            self.rows.pop(0)
        before = self.rows[0]
        if t <= before[0]:
            return None
        said: dict[str, Any] = {"t_s": t, "v_m_s": (self.rows[-1][1] - before[1]) / (t - before[0])}
        return said if angle is None else said | {"angle_rad": angle}


async def run(page: str, port: int, tail: Tail | None, ready: Callable[[str], None]) -> None:
    """Serves the page until Ctrl-C or a polite kill; `ready` gets its address. Raises ServeError."""
    stop = asyncio.Event()
    with contextlib.suppress(RuntimeError, ValueError):  # not in the main thread: whoever started it stops it
        # A KeyboardInterrupt may be raised anywhere in the loop and get lost there.
        for number in interrupt.SIGNALS:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with serving(page, port) as (server, send):
        ready(f"http://{HOST}:{server.sockets[0].getsockname()[1]}/")
        while not stop.is_set():
            for said in tail.new() if tail else ():
                send(said)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), POLL)
