"""The server of the window: loopback only, and nothing without the token that the address holds."""

from __future__ import annotations

import asyncio
import errno
import logging
import mimetypes
import os
import secrets
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Awaitable, Callable, Iterator, MutableMapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from excite import output
from excite.app.day import Day
from excite.app.results import is_possible_name
from excite.errors import DiskError, FolderError, ServeError, UsageError
from excite.logs import ENDINGS, SUFFIXES

HOST = "127.0.0.1"
PIECE = 1 << 18  # bytes of a file that are sent at once
TOKEN_BYTES = 24  # random bytes in the address; chosen
MAX_LOG_BYTES = 2 * 10**9  # of a log that the browser hands over; chosen
STOP_S = 20.0  # that a running command gets to keep its best when the window ends [s]; chosen
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline';"
    " img-src 'self' data:; font-src 'self' data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
FILE_POLICY = "sandbox allow-scripts allow-downloads allow-modals; connect-src 'none'; form-action 'none'"
HEADERS = {"Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
ASGI = Callable[[Scope, Receive, Send], Awaitable[None]]


class Gate:
    """Lets a request or websocket pass only if its path begins with the token, and Host and Origin are this server's.

    Without the check of Host, a web site whose name points to this computer could be same-origin with the window.
    """

    def __init__(self, inner: ASGI, token: str, port: int) -> None:
        self.inner, self.prefix = inner, f"/{token}"
        self.hosts = {f"{HOST}:{port}", f"localhost:{port}"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.inner(scope, receive, send)
            return
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        origin = headers.get(b"origin")
        known = headers.get(b"host") in self.hosts and origin in (None, *(f"http://{h}" for h in self.hosts))
        start, _, rest = scope["path"].removeprefix("/").partition("/")
        right = secrets.compare_digest(f"/{start}".encode(), self.prefix.encode())
        if not known or not right or not scope["path"].startswith(f"{self.prefix}/"):
            await _refuse(scope, receive, send)
            return
        path = f"/{rest}"
        # as behind a proxy that serves the window below the token, so that the window's own addresses hold it, too
        forwarded = [(n, v) for n, v in scope["headers"] if n.lower() != b"x-forwarded-prefix"]
        forwarded.append((b"x-forwarded-prefix", self.prefix.encode()))

        async def answer(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                sent = {name.lower() for name, _ in message["headers"]}
                own = {**HEADERS, "Content-Security-Policy": POLICY}
                added = [(n.lower().encode(), v.encode()) for n, v in own.items() if n.lower().encode() not in sent]
                message = {**message, "headers": [*message["headers"], *added]}
            await send(message)

        inside = {**scope, "path": path, "raw_path": quote(path).encode(), "headers": forwarded}
        await self.inner(inside, receive, answer)


async def _refuse(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    body = b"Open the address that `excite app` prints: it holds the key.\n"
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": 403, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def _pieces(opened: BinaryIO) -> Iterator[bytes]:
    """Yield a file piece by piece, as far as it is there: it may be replaced or cut off meanwhile."""
    with opened, suppress(OSError):
        yield from iter(partial(opened.read, PIECE), b"")


def web_app(day: Day) -> Any:
    """Return the web application of a day: the page, files of results, and a way to hand over a log."""
    from fastapi import FastAPI
    from fastapi.responses import PlainTextResponse, StreamingResponse
    from nicegui import ui
    from starlette.requests import ClientDisconnect

    from excite.app.page import Window

    web = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @web.get("/files/{path:path}")
    def file(path: str) -> Any:
        try:
            found = output.real(day.folder / path)
            there = found.is_relative_to(output.real(day.folder)) and found.is_file()
            opened = found.open("rb") if there else None
        except (OSError, ValueError):  # a name that no file can have
            opened = None
        if opened is None:
            return PlainTextResponse("no such file\n", 404)
        policy = {} if found.suffix == ".pdf" else {"Content-Security-Policy": FILE_POLICY}  # a viewer needs no sandbox
        kind = mimetypes.guess_type(found.name)[0] or "application/octet-stream"
        return StreamingResponse(_pieces(opened), headers={"Cache-Control": "no-cache", **policy}, media_type=kind)

    async def log(request: Any) -> Any:
        name = Path(request.path_params["name"].replace("\\", "/")).name
        path = day.folder / name
        possible = is_possible_name(name) and name.isprintable() and not name.startswith(".")
        if path.suffix.lower() not in SUFFIXES or not possible:
            said = f"{name[:60]}: is no name for a log, which ends in {ENDINGS}"
            return PlainTextResponse(said, 400)
        taken = f"{path}: exists already; rename the log, or choose it in the list"
        if path.exists():
            return PlainTextResponse(taken, 409)
        size = 0
        try:
            with output.new_file(path, replace=False) as place, place.open("wb") as file:
                async for chunk in request.stream():
                    size += len(chunk)
                    if size > MAX_LOG_BYTES:
                        raise UsageError(f"{name}: is larger than {MAX_LOG_BYTES / 1e9:g} GB; put it into {day.folder}")
                    file.write(chunk)
        except FileExistsError:
            return PlainTextResponse(taken, 409)
        except ClientDisconnect:
            return PlainTextResponse(f"{name}: came in part only", 400)
        except (UsageError, FolderError, DiskError, OSError) as err:
            return PlainTextResponse(f"{name}: {err}" if isinstance(err, OSError) else str(err), 400)
        day.logs = [str(path)]
        try:
            day.save()
        except (FolderError, DiskError, OSError) as err:
            return PlainTextResponse(f"{path} is there, but the choices of the day can't be stored: {err}", 400)
        return PlainTextResponse(str(path))

    web.add_route("/log/{name}", log, methods=["POST"])

    @ui.page("/")
    def page() -> None:
        Window(day).build()

    ui.run_with(
        web, title="excite", favicon=ICON, language="en-US", tailwind=False, show_welcome_message=False, dark=False
    )
    return web


ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 16 16"><path d="M1 8h3l2-6 4 12 2-6h3" fill="none"'
    ' stroke="#0b4f8a" stroke-width="2"/></svg>'
)


def _redirect(folder: Path, address: str) -> Path:
    """Write a page that only this user can read and that leads to the address, and return its file.

    The browser gets the file's name: its command line, which every user of the computer can list, holds no key.
    Raises FolderError.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=".excite-", suffix=".html", dir=folder)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={address}"><title>excite</title>\n')
    except OSError as err:
        raise FolderError(f"{folder}: can't be written, {err.strerror}") from None
    return Path(name)


def serve(folder: Path, port: int, browser: bool, ready: Callable[[str], None]) -> None:
    """Serve the window of a folder until Ctrl-C; `ready` gets its address, which a browser opens if wanted, through a
    file that only this user can read.

    port: 0 for any free one. A command that runs at the end is stopped, as its own Stop does.
    Raises ServeError if the port is taken, FolderError if the folder can't be written, ModuleNotFoundError without
    the extra `app`.
    """
    import uvicorn

    if folder.is_file():
        raise FolderError(f"{folder}: is a file, give a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise FolderError(f"{folder}: can't be made, {err.strerror}") from None
    day = Day(folder)
    try:
        taken = socket.create_server((HOST, port))
    except OSError as err:
        why = "is taken" if err.errno == errno.EADDRINUSE else str(err.strerror)
        raise ServeError(f"--port {port}: {why}; choose another port, or 0 for any free one") from None
    port, token = taken.getsockname()[1], secrets.token_urlsafe(TOKEN_BYTES)
    address = f"http://{HOST}:{port}/{token}/"
    logging.getLogger("nicegui").setLevel(logging.ERROR)  # it warns of slow refreshes while a command takes all cores
    settings = uvicorn.Config(
        Gate(web_app(day), token, port), log_level="error", access_log=False, timeout_graceful_shutdown=1
    )
    ready(address)
    door = _redirect(folder, address) if browser else None
    if door is not None:
        threading.Timer(0.5, webbrowser.open, (output.real(door).as_uri(),)).start()
    try:
        asyncio.run(uvicorn.Server(settings).serve([taken]))
    except KeyboardInterrupt:
        pass
    finally:
        taken.close()
        if door is not None:
            door.unlink(missing_ok=True)
        if day.running and day.job is not None:
            sys.stderr.write("stopping what runs\n")
            day.job.stop()
            if not day.job.wait(STOP_S):
                day.job.stop()
                day.job.wait(STOP_S)
