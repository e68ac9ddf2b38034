"""The web server: the page and its files, its actions, and the live connection that carries the state to every page.

It runs uvicorn on a separate thread. `publish` may be called from any thread. A page that is slow or asleep gets the
newest state only, so that nothing queues up.

    GET  /               the page            GET /static/...   its files       GET /strings     its texts
    GET  /parameters     those in force
    POST /action         `control.py`        GET /report/NAME  a trial's report
    WS   /live           from the page: {"page": secret, or ""}, then {"seen": number of a state} for every few states
                         to the page: {"type": "page"}, {"type": "setup"}, {"type": "state"}
"""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from exo_gravity.core.errors import ParameterError
from exo_gravity.panel.access import MAX_BODY, Access, Guard
from exo_gravity.panel.control import Control, Page

FOLDER = Path(__file__).parent
WATCH_PERIOD = 0.1  # s
HELLO_TIMEOUT = 5.0  # s for a page to send its first message
STOP_TIMEOUT = 3.0  # s
FULL, REPLACED = 4000, 4001  # why a live connection was closed: too many pages; the page was opened again


class LivePage:
    """One live connection; holds the newest messages that it has not sent yet, by type."""

    def __init__(self, connection: WebSocket) -> None:
        self.connection = connection
        self._news = asyncio.Event()
        self._waiting: dict[str, str] = {}

    def put(self, kind: str, text: str) -> None:
        """Send `text` soon, in place of an older message of this kind."""
        self._waiting[kind] = text
        self._news.set()

    async def send(self) -> None:
        """Send what `put` gets, until it is cancelled."""
        while True:
            await self._news.wait()
            self._news.clear()
            waiting, self._waiting = self._waiting, {}
            for text in waiting.values():
                await self.connection.send_text(text)


class PanelServer:
    """Serves the panel at `host` and `port`.

    report: returns the report of a trial by name, or None. parameters: returns those in force by node. clock: of
    `access`, monotonic s.
    """

    def __init__(
        self,
        host: str,
        port: int,
        token: str,
        control: Control,
        report: Callable[[str], Path | None],
        parameters: Callable[[], Mapping[str, Any]],
        clock: Callable[[], float],
    ) -> None:
        self.access = Access(host, token, clock)
        self._control = control
        self._report = report
        self._pages: dict[str, LivePage] = {}  # by secret
        self._setup = ""  # none yet
        self._number = 0  # of the newest state
        self._loop: asyncio.AbstractEventLoop | None = None
        routes = [
            Route("/", lambda request: FileResponse(FOLDER / "static" / "index.html")),
            Route("/strings", lambda request: FileResponse(FOLDER / "strings.json")),
            Route("/action", self._on_action, methods=["POST"]),
            Route("/report/{name}", self._on_report),
            Route("/parameters", lambda request: JSONResponse(parameters())),
            WebSocketRoute("/live", self._on_live),
            Mount("/static", StaticFiles(directory=FOLDER / "static")),
        ]
        form = (FOLDER / "static" / "login.html").read_text(encoding="utf-8")
        app = Guard(Starlette(routes=routes, lifespan=self._lifespan), self.access, form)
        self._socket = _listen(host, port)
        config = uvicorn.Config(
            app, log_level="warning", access_log=False, server_header=False, proxy_headers=False, ws_max_size=1024,
            ws_per_message_deflate=False, ws_ping_interval=5.0, ws_ping_timeout=10.0, timeout_graceful_shutdown=1,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name="panel", daemon=True)

    def start(self) -> None:
        """Start to serve, on a thread."""
        self._thread.start()

    def stop(self) -> None:
        """Close all connections and end the thread."""
        self._server.should_exit = True
        self._thread.join(STOP_TIMEOUT)
        self._socket.close()

    @property
    def is_running(self) -> bool:
        """Whether it still serves."""
        return self._thread.is_alive()

    def publish(self, state: Mapping[str, Any]) -> None:
        """Send the state to all pages."""
        self._on_loop(self._send_state, state)

    def publish_setup(self, setup: Mapping[str, Any]) -> None:
        """Send what changes rarely to all pages, and to those that open later."""
        self._setup = json.dumps({"type": "setup", **setup})
        self._on_loop(self._send, "setup", self._setup)

    def _on_loop(self, function: Callable[..., None], *args: Any) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # the loop has just been closed
                self._loop.call_soon_threadsafe(function, *args)

    @asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        self._loop = asyncio.get_running_loop()
        watch = asyncio.create_task(self._watch())
        yield
        self._loop = None
        watch.cancel()

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(WATCH_PERIOD)
            await self._control.watch()

    def _send_state(self, state: Mapping[str, Any]) -> None:
        self._number += 1
        if not self._pages:
            return
        holder, gone = self._control.holder, self._control.is_gone()
        of_holder = {"page": holder.number, "address": holder.address, "gone": gone} if holder else None
        self._send("state", json.dumps({"type": "state", "number": self._number, "control": of_holder, **state}))

    def _send(self, kind: str, text: str) -> None:
        for page in self._pages.values():
            page.put(kind, text)

    async def _on_live(self, connection: WebSocket) -> None:
        await connection.accept()
        with suppress(WebSocketDisconnect, asyncio.TimeoutError, ValueError, KeyError):
            hello = await asyncio.wait_for(connection.receive_json(), HELLO_TIMEOUT)
            address = connection.client.host if connection.client else "unknown"
            page = self._control.open(_given(hello, "page", str), address)
            if page is None:
                await connection.close(FULL)
                return
            await self._serve(connection, page)

    async def _serve(self, connection: WebSocket, page: Page) -> None:
        if page.secret in self._pages:
            await self._pages[page.secret].connection.close(REPLACED)
        live = self._pages[page.secret] = LivePage(connection)
        live.put("page", json.dumps({"type": "page", "page": page.secret, "number": page.number}))
        if self._setup:
            live.put("setup", self._setup)
        sender = asyncio.create_task(live.send())
        try:
            while True:
                _given(await connection.receive_json(), "seen", int)
                self._control.confirm(page)
        finally:
            sender.cancel()
            if self._pages.get(page.secret) is live:
                del self._pages[page.secret]
                page.connected = False

    async def _on_action(self, request: Request) -> Response:
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > MAX_BODY:
                return PlainTextResponse("413: too long", 413)
        try:
            content = json.loads(body)
        except ValueError:
            return JSONResponse({"error": "the request is not JSON"}, 400)
        address = request.client.host if request.client else "unknown"
        status, text = await self._control.perform(content, request.headers.get("x-panel-page", ""), address)
        return JSONResponse({"error": text}, status)

    async def _on_report(self, request: Request) -> Response:
        path = self._report(request.path_params["name"])
        return FileResponse(path) if path else PlainTextResponse("404: no such report", 404)


def _given(message: Any, key: str, kind: type) -> Any:
    """Return the value of `key` in a page's message. Raises ValueError if the page sends something else."""
    if not isinstance(message, dict) or type(message.get(key)) is not kind:
        raise ValueError(f"{key} must be given")
    return message[key]


def _listen(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise ParameterError("host, port", f"{host}, {port}", f"a free address ({error.strerror or error})") from None
