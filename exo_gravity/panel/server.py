# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The web server: the page and its files, its actions, and the live connection that carries the state to every page.

It runs uvicorn on a separate thread. A page that is slow or asleep gets the newest state only, so that nothing queues
up. On `/live` a page sends {"page": secret, or ""}, then {"seen": number of a state} for every few states. It gets
{"type": "page"}, {"type": "setup"} and {"type": "state"}.

A guard stands before every request. On loopback no token is needed. A page from elsewhere could still reach it through
the operator's browser, so the header `Host` must then name this machine: a foreign name that resolves to 127.0.0.1 (DNS
rebinding) is refused. Every request that changes something must come from the panel's own page (`Origin`). Other
headers confine the page.
"""

import asyncio
import hmac
import ipaddress
import re
import secrets
import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.lab.inputs.parameter_file import text_of
from exo_gravity.panel.control import Control, Page
from exo_gravity.panel.recordings import FILES, programs

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Serving:
    """How long the server waits, and how much it takes."""

    send_period: float = 0.05  #: s between two looks for news
    hello_timeout: float = 5.0  #: s for a page to send its first message
    stop_timeout: float = 3.0  #: s for the thread to end
    attempts: int = 5  #: wrong tokens of one address, and of all addresses ten times as many
    attempt_window: float = 60.0  #: s in which they count
    longest_request: int = 4096  #: bytes of a request


SERVING = Serving()


NOT_KNOWN: Mapping[str, Any] = {}
FULL, REPLACED = 4000, 4001  # why a live connection was closed: too many pages; the page was opened again
COOKIE = "exo_gravity_panel"
# Nothing from elsewhere, no inline script or style, and no frame around the page, in which a press could be stolen.
CONFINED = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
REPORT = "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; frame-ancestors 'none'"
HEADERS = {
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "same-origin",  # with no-referrer a browser sends `Origin: null` with a form
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}


class PanelServer:
    """Serves the panel at `host` and `port`, on a thread."""

    def __init__(self, host: str, port: int, token: str, control: Control) -> None:
        self.state = NOT_KNOWN  #: what the pages show, replaced by a new object in any thread
        self.setup = NOT_KNOWN  #: what changes rarely, replaced likewise
        self._control = control
        routes = [
            Route("/", lambda request: FileResponse(FOLDER / "static" / "index.html")),
            Route("/strings", lambda request: FileResponse(FOLDER / "strings.json")),
            Route("/action", self._on_action, methods=["POST"]),
            *(Route(f"/{kind}/{{name:path}}", partial(self._on_file, pattern)) for kind, pattern in FILES.items()),
            Route(
                "/sessions",
                lambda request: JSONResponse(
                    {**control.files.past(), "programs": list(programs()) if is_here(request) else []}
                ),
            ),
            Route("/settings/{arm:path}", self._on_settings),
            Route("/parameters", lambda request: PlainTextResponse(text_of(control.arms.parameters()))),
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
        #: alive while it serves
        self.thread = threading.Thread(target=self._server.run, args=([self._socket],), name="panel", daemon=True)
        self.thread.start()

    def stop(self) -> None:
        """Close all connections and end the thread."""
        self._server.should_exit = True
        self.thread.join(SERVING.stop_timeout)
        self._socket.close()

    async def _on_live(self, connection: WebSocket) -> None:
        """Send to a page and receive its confirmations until it closes."""
        await connection.accept()
        with suppress(WebSocketDisconnect, asyncio.TimeoutError, ValueError, LookupError, TypeError, RecursionError):
            hello = await asyncio.wait_for(connection.receive_json(), SERVING.hello_timeout)
            page = self._control.open(str(hello["page"]), address_of(connection))
            if page is None:
                await connection.close(FULL)
                return
            replaced, page.connection = page.connection, connection
            if replaced:
                await replaced.close(REPLACED)
            sender = asyncio.create_task(self._send(connection, page))
            try:
                while (await connection.receive_json())["seen"]:
                    self._control.confirm(page)
            finally:
                sender.cancel()
                if page.connection is connection:
                    page.connection = None

    async def _send(self, connection: WebSocket, page: Page) -> None:
        """Send the page's number, then setup and state whenever they are new, until it is cancelled."""
        await connection.send_json({"type": "page", "page": page.secret, "number": page.number})
        setup, state, number = NOT_KNOWN, NOT_KNOWN, 0
        while True:
            if self.setup is not setup:
                setup = self.setup
                await connection.send_json({"type": "setup", **setup})
            if self.state is not state:
                state, number = self.state, number + 1
                holder, gone = self._control.holder, self._control.is_gone()
                where = {"gone": gone, "elsewhere": self._control.other_operator}
                of_holder = {"page": holder.number, "address": holder.address, **where} if holder else None
                await connection.send_json({"type": "state", "number": number, "control": of_holder, **state})
            await asyncio.sleep(SERVING.send_period)

    async def _on_action(self, request: Request) -> Response:
        try:
            content = await request.json()
        except (ValueError, RecursionError):  # the latter of brackets in brackets
            return JSONResponse({"error": "the request is not JSON"}, 400)
        secret = request.headers.get("x-panel-page", "")
        status, text = await self._control.perform(content, secret, address_of(request), is_here(request))
        return JSONResponse({"error": text}, status)

    async def _on_settings(self, request: Request) -> Response:
        """Answer with the arm's settings at this moment: a question to its operator must not be about older ones."""
        arm = request.path_params["arm"]
        if arm not in self._control.arms.names:
            return JSONResponse({"error": f"there is no arm {arm}"}, 404)
        try:
            return JSONResponse({"settings": await self._control.arms.settings_of(arm)})
        except ExoGravityError as error:
            return JSONResponse({"error": str(error)}, 503)

    async def _on_login(self, request: Request) -> Response:
        """Answer the form that asks for the token."""
        if request.method != "POST":
            return RedirectResponse("/")
        form = parse_qs((await request.body()).decode("utf-8", "replace"))
        return self.access.opened_by(form.get("token", [""])[0], request)

    async def _on_file(self, pattern: str, request: Request) -> Response:
        name = request.path_params["name"]
        if not (path := self._control.files.file(name, pattern)):
            return PlainTextResponse("404: no such file", 404)
        as_name = None if path.suffix == ".html" else f"{Path(name).name}{path.suffix}"  # that one is downloaded
        return FileResponse(path, filename=as_name)


class Access:
    """Passes on to `app` the requests and live connections of those who may use the panel.

    host: the address at which the panel listens.
    token: '' for none on loopback, and for a random one elsewhere.
    clock: monotonic s.
    """

    def __init__(self, app: ASGIApp, host: str, token: str, clock: Callable[[], float]) -> None:
        self.on_loopback = is_loopback(host)
        self.token = token or ("" if self.on_loopback else secrets.token_urlsafe(24))
        self.is_open = not self.token  #: whether no token is needed
        self._session = secrets.token_urlsafe(24)  # the cookie's value: not the token, and another after each start
        self._app = app
        self._clock = clock
        self._failures: deque[tuple[float, str]] = deque(maxlen=10 * SERVING.attempts)
        self._form = (FOLDER / "static" / "login.html").read_text(encoding="utf-8")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request or live connection."""
        left = SERVING.longest_request

        async def limited() -> Message:
            nonlocal left
            message = await receive()
            left -= len(message.get("body", b""))
            if left < 0:  # found here, since a proxy need not say how long a request is
                raise HTTPException(413, "413: too long")
            return message

        async def confined(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                answer["content-security-policy"] = REPORT if scope["path"].startswith("/report/") else CONFINED
                answer.update(HEADERS)
            await send(message)

        await (self._refusal(HTTPConnection(scope)) or self._app)(scope, limited, confined)

    def is_token(self, given: str, address: str) -> bool:
        """Return whether `given` is the token, in constant time, and note a wrong one of `address`.

        After too many wrong ones, from `address` or from all, none is compared for a while.
        """
        now = self._clock()
        recent = [origin for time, origin in self._failures if now - time <= SERVING.attempt_window]
        if recent.count(address) >= SERVING.attempts or len(recent) >= 10 * SERVING.attempts:
            return False
        right = not self.is_open and _equal(given, self.token)
        if not right:
            self._failures.append((now, address))
        return right

    def _refusal(self, connection: HTTPConnection) -> Response | None:
        """Return the answer to a request that must not pass, None if it may."""
        scope, headers = connection.scope, connection.headers
        host = headers.get("host", "")
        if self.is_open and not names_loopback(connection):
            return PlainTextResponse("403: the panel answers on loopback only: see docs/operating.md", 403)
        changes = scope.get("method") not in ("GET", "HEAD")  # a live connection has no method
        origins = (f"http://{host.lower()}", f"https://{host.lower()}") if host else ()
        if changes and headers.get("origin", "").lower() not in origins:
            return PlainTextResponse("403: this request does not come from the panel's page", 403)
        is_login = (scope["path"], scope.get("method")) == ("/login", "POST")
        if self.is_open or is_login or _equal(connection.cookies.get(COOKIE, ""), self._session):
            return None
        return self.opened_by(connection.query_params.get("token", ""), connection)  # as the log shows it

    def opened_by(self, given: str, connection: HTTPConnection) -> Response:
        """Return the session's cookie if `given` is the token, else the page that asks for it."""
        if not given or not self.is_token(given, address_of(connection)):
            note = "The token is wrong, or too many were tried: wait a minute." if given else ""
            return Response(self._form.replace("<!-- note -->", note), 401, media_type="text/html")
        answer = RedirectResponse("/", 303)
        secure = connection.headers.get("origin", "").startswith("https:")
        answer.set_cookie(COOKIE, self._session, httponly=True, samesite="strict", secure=secure)
        return answer


def is_loopback(host: str) -> bool:
    """Return whether `host`, a name or an address, is this machine alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def names_loopback(connection: HTTPConnection) -> bool:
    """Return whether the client calls the panel by a name of this machine alone."""
    return is_loopback(re.sub(r":\d*$", "", connection.headers.get("host", "")).strip("[]"))


def is_here(connection: HTTPConnection) -> bool:
    """Return whether the client is on this computer: behind a proxy, which is, it calls the panel by another name."""
    return is_loopback(address_of(connection)) and names_loopback(connection)


def address_of(connection: HTTPConnection) -> str:
    """Return the address of the client."""
    return connection.client.host if connection.client else "unknown"


def _equal(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())
