"""Serve the driver's page with live values: `excite drive --serve`.

The server gives the page and passes on measured values, from a growing log or from any program that sends
`{"v_m_s": 1.2, "JOINT_rad": 0.1}` to ws://127.0.0.1:PORT/live (JOINT: a steered joint's name in the machine file).
It listens on the loopback address by default. Origin and Host are checked, so that no web site in the same browser can
read or fake values. On another address anybody who reaches it may open the page and send values.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import ipaddress
import json
import math
import socket
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from http import HTTPStatus
from pathlib import Path

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from excite import interrupt, output
from excite.errors import ServeError
from excite.model.machine import UNITS, Machine
from excite.operator.ground import Lever

HOST = "127.0.0.1"
LOOPBACK_SOURCES = "ws://127.0.0.1:* ws://localhost:*"  # addresses in the page's content security policy
MAX_MESSAGE = 1024  # of a message [bytes]; chosen
MAX_REASON = 120  # of the reason for closing a connection [bytes]; the protocol allows 123
MAX_CLIENTS = 16  # chosen
TIME, SPEED = "t_s", "v_m_s"  # keys of a message, beside the angle of each steered joint
POLL_S = 0.05  # between looks at a growing log [s]; chosen
SPEED_SPAN_S = 0.2  # time over which a speed is measured [s]; chosen


@asynccontextmanager
async def running_server(
    page: str, angles: Sequence[str], port: int = 0, host: str = HOST
) -> AsyncIterator[tuple[Server, Callable[[dict[str, float]], None]]]:
    """Run the server; give it and a function that sends values to every page.

    angles: keys of the steered joints' angles. port: 0 for any free one. host: address to listen on, 0.0.0.0 for all.
    Raises ServeError if the port is taken or the address is not this computer's.
    """
    keys, at = (TIME, SPEED, *angles), str(ipaddress.ip_address(host))  # an empty address would mean all
    pages: set[ServerConnection] = set()

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        # Compare with the numeric address: a foreign host name could point here.
        own, taken = connection.local_address[:2]
        allowed = {f"{url_host(own)}:{taken}"} | ({f"localhost:{taken}"} if own == HOST else set())
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if host not in allowed or (origin is not None and origin not in {f"http://{h}" for h in allowed}):
            return connection.respond(HTTPStatus.FORBIDDEN, "for pages of this server alone\n")
        if request.path == "/live":
            if len(pages) >= MAX_CLIENTS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages\n")
            return None
        if request.path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "only / and /live are here\n")
        body = page.replace(LOOPBACK_SOURCES, f"{LOOPBACK_SOURCES} ws://{host}").encode()
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
                said = parse_message(message, keys)
                if said is None:
                    await connection.close(1007, f"send a JSON object of numbers {', '.join(keys)}"[:MAX_REASON])
                    return
                broadcast(pages - {connection}, json.dumps(said))
        except ConnectionClosed:
            pass
        finally:
            pages.discard(connection)

    try:
        server = await serve(
            talk, at, port, process_request=answer, max_size=MAX_MESSAGE, max_queue=16, compression=None
        )
    except OSError as err:
        if err.errno == errno.EADDRNOTAVAIL:
            said = f"--host {host}: is no address of this machine; 0.0.0.0 listens on all that it has"
        else:
            said = f"--port {port}: can't listen on {host}: {err.strerror}; choose another port"
        raise ServeError(said) from None
    async with server:
        yield server, lambda said: broadcast(set(pages), json.dumps(said))


def url_host(address: str) -> str:
    """Write an address for a URL: IPv6 in brackets."""
    return f"[{address}]" if ":" in address else address


def reachable_addresses(host: str) -> list[str]:
    """Return the addresses at which a page can be opened; for 0.0.0.0 and :: all that this computer has."""
    if not ipaddress.ip_address(host).is_unspecified:
        return [url_host(host)]
    four = ":" not in host
    family, outside, own = (socket.AF_INET, "192.0.2.1", HOST) if four else (socket.AF_INET6, "2001:db8::1", "::1")
    found: list[str] = []
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as udp:
        udp.connect((outside, 9))  # sends nothing: shows which address would be used
        found.append(str(udp.getsockname()[0]))
    with contextlib.suppress(OSError):
        found += [str(told[4][0]) for told in socket.getaddrinfo(socket.gethostname(), None, family)]
    ways = {a: ipaddress.ip_address(a) for a in found}  # each once, in order
    return [*(url_host(a) for a, ip in ways.items() if not (ip.is_loopback or ip.is_link_local)), url_host(own)]


def parse_message(message: str | bytes, keys: Sequence[str]) -> dict[str, float] | None:
    """Parse a message into numbers by known keys, the speed among them; None for anything else."""
    try:
        said = output.parse_json(message)
    except ValueError:
        return None
    if not isinstance(said, dict) or SPEED not in said or set(said) - set(keys):
        return None
    for value in said.values():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return None
    return {k: float(v) for k, v in said.items()}


class GrowingLog:
    """A growing CSV log in a machine's columns, read as it grows: rim speed of the contacts, steering angles."""

    def __init__(self, path: Path, machine: Machine, levers: Sequence[Lever]) -> None:
        self.path, self.machine, self.levers = path, machine, levers
        sensors = {s.body: s for s in machine.sensors("full") if s.kind == "angle"}
        rolling = [b for b in machine.contacts if b.index in sensors]
        self.rims = [(float(b.contact.radius), sensors[b.index]) for b in rolling if b.contact]
        self.angles = [(lever.column, sensors[lever.body.index]) for lever in levers if lever.body.index in sensors]
        self.place = 0
        self.rest = ""
        self.names: list[str] = []
        self.rows: list[tuple[float, float]] = []  # time [s], way rolled [m]
        self.turned: dict[str, float] = {}  # the last angles [rad]

    def new(self) -> list[dict[str, float]]:
        """Return the values of rows added since the last call; lines without numbers are skipped."""
        if not self.path.is_file():
            return []
        if self.path.stat().st_size < self.place:  # begun afresh
            self.__init__(self.path, self.machine, self.levers)  # type: ignore[misc]
        with self.path.open(encoding="utf-8", errors="replace", newline="") as file:
            file.seek(self.place)
            text = self.rest + file.read()
            self.place = file.tell()
        *lines, self.rest = text.removeprefix("\ufeff").split("\n")
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
        try:
            t = UNITS[self.machine.time_unit][1] * float(cells[self.machine.time_column])
            ways = []
            for radius, s in self.rims:
                number = radius * s.gain * float(cells[s.column])
                if s.is_rate and self.rows:
                    number = self.rows[-1][1] + number * (t - self.rows[-1][0])
                ways.append(number)
        except (KeyError, ValueError):
            return None
        if not ways or not math.isfinite(t + sum(ways)):
            return None
        angles = self._angles(cells, t - self.rows[-1][0] if self.rows else 0.0)
        self.rows.append((t, sum(ways) / len(ways)))
        while len(self.rows) > 2 and self.rows[1][0] <= t - SPEED_SPAN_S:
            self.rows.pop(0)
        before = self.rows[0]
        if t <= before[0]:
            return None
        return {TIME: t, SPEED: (self.rows[-1][1] - before[1]) / (t - before[0]), **angles}

    def _angles(self, cells: dict[str, str], seconds: float) -> dict[str, float]:
        """Return the steering angles of a row, `seconds` after the row before; a rate is integrated from zero."""
        found = {}
        for key, s in self.angles:
            with contextlib.suppress(KeyError, ValueError):
                found[key] = s.gain * float(cells[s.column]) - s.shift
                if s.is_rate:
                    found[key] = self.turned.get(key, 0.0) + found[key] * seconds
        found = {key: angle for key, angle in found.items() if math.isfinite(angle)}
        self.turned |= found
        return found


async def serve_page(
    page: str, angles: Sequence[str], host: str, port: int, tail: GrowingLog | None, ready: Callable[[str], None]
) -> None:
    """Serve the page until Ctrl-C or SIGTERM; `ready` gets each of its addresses. Raises ServeError."""
    stop = asyncio.Event()
    with contextlib.suppress(RuntimeError, ValueError):  # outside the main thread there are no signals
        # A KeyboardInterrupt inside the event loop may be lost.
        for number in interrupt.SIGNALS:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with running_server(page, angles, port, host) as (server, send):
        for address in reachable_addresses(host):
            ready(f"http://{address}:{server.sockets[0].getsockname()[1]}/")
        while not stop.is_set():
            for said in tail.new() if tail else ():
                send(said)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), POLL_S)
