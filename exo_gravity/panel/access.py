"""Who may open the panel: a token, the cookie that replaces it, and the guard in front of every request.

On loopback no token is needed. A page from elsewhere could still reach it through the operator's browser, so the header
`Host` must then name this machine: a foreign name that resolves to 127.0.0.1 (DNS rebinding) is refused. Every request
that changes something must come from the panel's own page (`Origin`). Other headers confine the page.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections import deque
from collections.abc import Callable
from urllib.parse import SplitResult, parse_qs, urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

ATTEMPTS, ATTEMPT_WINDOW = 5, 60.0  # wrong tokens of one address, and of all addresses ten times as many, in s
COOKIE = "exo_gravity_panel"
MAX_BODY = 4096  # bytes of a request
POLICY_VIOLATION = 1008  # why a live connection was closed
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


def is_loopback(host: str) -> bool:
    """Return whether `host`, a name or an address, is this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Access:
    """The token, and the cookie of those who gave it.

    host: the address at which the panel listens. token: '' for none on loopback, and for a random one elsewhere.
    clock: monotonic s.
    """

    def __init__(self, host: str, token: str, clock: Callable[[], float]) -> None:
        self.on_loopback = is_loopback(host)
        self.token = token or ("" if self.on_loopback else secrets.token_urlsafe(24))
        self._clock = clock
        self.session = secrets.token_urlsafe(24)  #: the cookie's value: not the token, and another after each start
        self._failures: deque[tuple[float, str]] = deque(maxlen=10 * ATTEMPTS)

    @property
    def is_open(self) -> bool:
        """Whether no token is needed."""
        return not self.token

    def allows_host(self, host: str) -> bool:
        """Return whether a request with this header `Host` may be answered."""
        return not self.is_open or is_loopback(_split(f"//{host}").hostname or "")

    def allows(self, session: str) -> bool:
        """Return whether a request with this cookie may see anything."""
        return self.is_open or _equal(session, self.session)

    def is_token(self, given: str, address: str) -> bool:
        """Return whether `given` is the token, in constant time, and note a wrong one of `address`.

        After too many wrong ones, from `address` or from all, none is compared for a while.
        """
        now = self._clock()
        recent = [origin for time, origin in self._failures if now - time <= ATTEMPT_WINDOW]
        if recent.count(address) >= ATTEMPTS or len(recent) >= 10 * ATTEMPTS:
            return False
        right = not self.is_open and _equal(given, self.token)
        if not right:
            self._failures.append((now, address))
        return right


def is_same_origin(origin: str, host: str) -> bool:
    """Return whether the page at `origin` (a header's value) came from the server that `host` names."""
    parts = _split(origin)
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower() != ""


def _split(address: str) -> SplitResult:
    try:
        return urlsplit(address)
    except ValueError:  # an unclosed [
        return SplitResult("", "", "", "", "")


def _equal(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())


class Guard:
    """Passes on to `app` what `access` allows. form: the page that asks for the token."""

    def __init__(self, app: ASGIApp, access: Access, form: str) -> None:
        self._app = app
        self._access = access
        self._form = form

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request or live connection."""
        connection = HTTPConnection(scope)
        refusal = self._refusal(connection)
        if scope["type"] == "websocket":
            if refusal is None:
                await self._app(scope, receive, send)
            else:
                await receive()
                await send({"type": "websocket.close", "code": POLICY_VIOLATION})
            return

        async def confined(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                answer["content-security-policy"] = REPORT if scope["path"].startswith("/report/") else CONFINED
                answer.update(HEADERS)
            await send(message)

        if refusal is None and scope["path"] == "/login":
            refusal = await self._login(Request(scope, receive))
        await (refusal or self._app)(scope, receive, confined)

    def _refusal(self, connection: HTTPConnection) -> Response | None:
        """Return the answer to a request that must not pass, None if it may."""
        scope, host = connection.scope, connection.headers.get("host", "")
        if not self._access.allows_host(host):
            return PlainTextResponse("403: the panel answers on loopback only: see docs/panel.md", 403)
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if changes and not is_same_origin(connection.headers.get("origin", ""), host):
            return PlainTextResponse("403: this request does not come from the panel's page", 403)
        if scope["path"] == "/login" or self._access.allows(connection.cookies.get(COOKIE, "")):
            return None
        given = connection.query_params.get("token", "") if scope["type"] == "http" else ""
        if given and self._access.is_token(given, address_of(connection)):
            return self._opened(connection)  # the address with the token, as the log shows it
        return self._ask(failed=bool(given))

    async def _login(self, request: Request) -> Response:
        if request.method != "POST":
            return RedirectResponse("/", 303)
        body = await body_of(request)
        given = parse_qs(body.decode("utf-8", "replace")).get("token", [""])[0]
        right = len(body) <= MAX_BODY and self._access.is_token(given, address_of(request))
        return self._opened(request) if right else self._ask(failed=True)

    def _opened(self, connection: HTTPConnection) -> Response:
        answer = RedirectResponse("/", 303)
        secure = connection.headers.get("origin", "").startswith("https:")
        answer.set_cookie(COOKIE, self._access.session, httponly=True, samesite="strict", secure=secure)
        return answer

    def _ask(self, failed: bool) -> Response:
        note = "The token is wrong, or too many were tried: wait a minute." if failed else ""
        return Response(self._form.replace("<!-- note -->", note), 401, media_type="text/html")


def address_of(connection: HTTPConnection) -> str:
    """Return the address of the client."""
    return connection.client.host if connection.client else "unknown"


async def body_of(request: Request) -> bytes:
    """Return the body; more than MAX_BODY bytes, and not all of them, if it is too long."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MAX_BODY:
            break
    return body
