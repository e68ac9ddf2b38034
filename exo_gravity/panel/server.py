"""The web server: the page and its files, its actions, and the live connection that carries the state to every page.

It runs uvicorn on a separate thread. A page that is slow or asleep gets the newest state only, so that nothing queues
up.

    GET  /               the page            GET /static/...   its files       GET /strings     its texts
    GET  /parameters     those in force    GET /sessions       subjects, and past recordings
    POST /action         `control.py`        GET /report/NAME  a trial's report
    WS   /live           from the page: {"page": secret, or ""}, then {"seen": number of a state} for every few states
                         to the page: {"type": "page"}, {"type": "setup"}, {"type": "state"}
"""

import asyncio
import socket
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from exo_gravity.core.errors import ParameterError
from exo_gravity.panel.access import Access, address_of
from exo_gravity.panel.control import Control, Page

FOLDER = Path(__file__).parent
SEND_PERIOD = 0.05  # s between two looks for news
HELLO_TIMEOUT = 5.0  # s for a page to send its first message
STOP_TIMEOUT = 3.0  # s
NONE_YET: Mapping[str, Any] = {}
FULL, REPLACED = 4000, 4001  # why a live connection was closed: too many pages; the page was opened again


class PanelServer:
    """Serves the panel at `host` and `port`, on a thread."""

    def __init__(self, host: str, port: int, token: str, control: Control) -> None:
        self.state = NONE_YET  #: what the pages show, replaced by a new object in any thread
        self.setup = NONE_YET  #: what changes rarely, replaced likewise
        self._control = control
        routes = [
            Route("/", lambda request: FileResponse(FOLDER / "static" / "index.html")),
            Route("/strings", lambda request: FileResponse(FOLDER / "strings.json")),
            Route("/action", self._on_action, methods=["POST"]),
            Route("/report/{name:path}", self._on_report),
            Route("/sessions", lambda request: JSONResponse(control.files.past())),
            Route("/parameters", lambda request: JSONResponse(control.arms.parameters())),
            WebSocketRoute("/live", self._on_live),
            Route("/login", self._on_login, methods=["GET", "POST"]),
            Mount("/static", StaticFiles(directory=FOLDER / "static")),
        ]
        self.access = Access(Starlette(routes=routes), host, token, control.clock)
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            expected = f"a free address ({error.strerror or error})"
            raise ParameterError("host, port", f"{host}, {port}", expected) from None
        config = uvicorn.Config(
            self.access, loop="asyncio", log_level="warning", access_log=False, server_header=False,
            proxy_headers=False, lifespan="off", ws_max_size=1024, ws_per_message_deflate=False, ws_ping_interval=5.0,
            ws_ping_timeout=10.0, timeout_graceful_shutdown=1,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name="panel", daemon=True)
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

    async def _on_live(self, connection: WebSocket) -> None:
        """Send to a page and receive its confirmations until it closes."""
        await connection.accept()
        with suppress(WebSocketDisconnect, asyncio.TimeoutError, ValueError, KeyError):
            hello = await asyncio.wait_for(connection.receive_json(), HELLO_TIMEOUT)
            page = self._control.open(_given(hello, "page", str), address_of(connection))
            if page is None:
                await connection.close(FULL)
                return
            replaced, page.connection = page.connection, connection
            if replaced:
                await replaced.close(REPLACED)
            sender = asyncio.create_task(self._send(connection, page))
            try:
                while True:
                    _given(await connection.receive_json(), "seen", int)
                    self._control.confirm(page)
            finally:
                sender.cancel()
                if page.connection is connection:
                    page.connection = None

    async def _send(self, connection: WebSocket, page: Page) -> None:
        """Send the page's number, then setup and state whenever they are new, until it is cancelled."""
        await connection.send_json({"type": "page", "page": page.secret, "number": page.number})
        setup, state, number = NONE_YET, NONE_YET, 0
        while True:
            if self.setup is not setup:
                setup = self.setup
                await connection.send_json({"type": "setup", **setup})
            if self.state is not state:
                state, number = self.state, number + 1
                holder, gone = self._control.holder, self._control.is_gone()
                where = {"gone": gone, "elsewhere": self._control.elsewhere}
                of_holder = {"page": holder.number, "address": holder.address, **where} if holder else None
                await connection.send_json({"type": "state", "number": number, "control": of_holder, **state})
            await asyncio.sleep(SEND_PERIOD)

    async def _on_action(self, request: Request) -> Response:
        try:
            content = await request.json()
        except ValueError:
            return JSONResponse({"error": "the request is not JSON"}, 400)
        secret = request.headers.get("x-panel-page", "")
        status, text = await self._control.perform(content, secret, address_of(request))
        return JSONResponse({"error": text}, status)

    async def _on_login(self, request: Request) -> Response:
        return await self.access.login(request) if request.method == "POST" else RedirectResponse("/")

    async def _on_report(self, request: Request) -> Response:
        path = self._control.files.report(request.path_params["name"])
        return FileResponse(path) if path else PlainTextResponse("404: no such report", 404)


def _given(message: Any, key: str, kind: type) -> Any:
    """Return the value of `key` in a page's message. Raises ValueError if the page sends something else."""
    if not isinstance(message, dict) or type(message.get(key)) is not kind:
        raise ValueError(f"{key} must be given")
    return message[key]
