"""The driver's page with live values: `excite drive --serve`.

One small server gives the page and passes on what is measured: from a log that grows, or from any program that sends
`{"v_m_s": 1.2, "JOINT_rad": 0.1}` to ws://127.0.0.1:PORT/live, JOINT being the machine file's name of a steered joint.
It listens on the loopback address unless another is asked for, takes no connection that a page from elsewhere asks for
(Origin and Host are checked: a web site in the same browser must neither read nor fake measurements) and no message
longer than MESSAGE bytes. Whoever reaches another address may open the page and send values.
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

from excite import interrupt
from excite.errors import ServeError
from excite.model.machine import UNITS, Machine
from excite.operator.ground import Lever

HOST = "127.0.0.1"
OWN = "ws://127.0.0.1:* ws://localhost:*"  # where a page may connect to, as it says itself
MESSAGE, REASON = 1024, 120  # bytes of a message, and of why a connection ends
CLIENTS = 16
TIME, SPEED = "t_s", "v_m_s"  # and the angle of each steered joint, by the machine file's name of it
POLL = 0.05  # s between looks at a growing log
SPAN = 0.2  # s of rolling that a speed is taken from


@asynccontextmanager
async def serving(
    page: str, angles: Sequence[str], port: int = 0, host: str = HOST
) -> AsyncIterator[tuple[Server, Callable[[dict[str, float]], None]]]:
    """The running server and a function that sends values to every page. Port 0 takes a free one.

    angles: the names of steered joints' angles in a message; host: the address to listen on, 0.0.0.0 for all. Raises
    ServeError where the port is taken or the address is not this machine's.
    """
    keys, at = (TIME, SPEED, *angles), str(ipaddress.ip_address(host))  # an empty one would be all addresses
    pages: set[ServerConnection] = set()

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        # By the number that was dialled: a name could point here from anywhere.
        own, taken = connection.local_address[:2]
        allowed = {f"{literal(own)}:{taken}"} | ({f"localhost:{taken}"} if own == HOST else set())
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if host not in allowed or (origin is not None and origin not in {f"http://{h}" for h in allowed}):
            return connection.respond(HTTPStatus.FORBIDDEN, "for pages of this server alone\n")
        if request.path == "/live":
            if len(pages) >= CLIENTS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages\n")
            return None
        if request.path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "only / and /live are here\n")
        body = page.replace(OWN, f"{OWN} ws://{host}").encode()
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
                said = checked(message, keys)
                if said is None:
                    await connection.close(1007, f"send a JSON object of numbers {', '.join(keys)}"[:REASON])
                    return
                broadcast(pages - {connection}, json.dumps(said))
        except ConnectionClosed:
            pass
        finally:
            pages.discard(connection)

    try:
        server = await serve(talk, at, port, process_request=answer, max_size=MESSAGE, max_queue=16, compression=None)
    except OSError as err:
        if err.errno == errno.EADDRNOTAVAIL:
            said = f"--host {host}: is no address of this machine; 0.0.0.0 listens on all that it has"
        else:
            said = f"--port {port}: can't listen on {host}: {err.strerror}; choose another port"
        raise ServeError(said) from None
    async with server:
        yield server, lambda said: broadcast(set(pages), json.dumps(said))


def literal(address: str) -> str:
    """An address as it stands in a URL: IPv6 in brackets."""
    return f"[{address}]" if ":" in address else address


def reached(host: str) -> list[str]:
    """The addresses to open a page at that listens on `host`: for 0.0.0.0 and :: those that this machine has."""
    if not ipaddress.ip_address(host).is_unspecified:
        return [literal(host)]
    four = ":" not in host
    family, outside, own = (socket.AF_INET, "192.0.2.1", HOST) if four else (socket.AF_INET6, "2001:db8::1", "::1")
    found: list[str] = []
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as udp:
        udp.connect((outside, 9))  # sends nothing: tells which of our addresses would go out
        found.append(str(udp.getsockname()[0]))
    with contextlib.suppress(OSError):
        found += [str(told[4][0]) for told in socket.getaddrinfo(socket.gethostname(), None, family)]
    ways = {a: ipaddress.ip_address(a) for a in found}  # each once, in order
    return [*(literal(a) for a, ip in ways.items() if not (ip.is_loopback or ip.is_link_local)), literal(own)]


def checked(message: str | bytes, keys: Sequence[str]) -> dict[str, float] | None:
    """A message as numbers by known keys, the speed at least; None where it is anything else."""
    try:
        said = json.loads(message)
    except ValueError:
        return None
    if not isinstance(said, dict) or SPEED not in said or set(said) - set(keys):
        return None
    for value in said.values():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return None
    return {k: float(v) for k, v in said.items()}


class Tail:
    """A growing CSV log in a machine's own columns, read as it grows: speed of the contacts' rims, steered angles."""

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
        """The values of the rows that are new since the last call; lines that are no numbers are left out."""
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
        while len(self.rows) > 2 and self.rows[1][0] <= t - SPAN:
            self.rows.pop(0)
        before = self.rows[0]
        if t <= before[0]:
            return None
        return {TIME: t, SPEED: (self.rows[-1][1] - before[1]) / (t - before[0]), **angles}

    def _angles(self, cells: dict[str, str], seconds: float) -> dict[str, float]:
        """The steered angles that a row has, so long after the one before it: the page keeps the last value of any
        other. A rate is summed up from zero."""
        found = {}
        for key, s in self.angles:
            with contextlib.suppress(KeyError, ValueError):
                found[key] = s.gain * float(cells[s.column])
                if s.is_rate:
                    found[key] = self.turned.get(key, 0.0) + found[key] * seconds
        found = {key: angle for key, angle in found.items() if math.isfinite(angle)}
        self.turned |= found
        return found


async def run(
    page: str, angles: Sequence[str], host: str, port: int, tail: Tail | None, ready: Callable[[str], None]
) -> None:
    """Serves the page until Ctrl-C or a polite kill; `ready` gets each of its addresses. Raises as `serving`."""
    stop = asyncio.Event()
    with contextlib.suppress(RuntimeError, ValueError):  # not in the main thread: whoever started it stops it
        # A KeyboardInterrupt may be raised anywhere in the loop and get lost there.
        for number in interrupt.SIGNALS:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with serving(page, angles, port, host) as (server, send):
        for address in reached(host):
            ready(f"http://{address}:{server.sockets[0].getsockname()[1]}/")
        while not stop.is_set():
            for said in tail.new() if tail else ():
                send(said)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), POLL)
