"""Who may open the panel: a token, the session that it opens, and the guard in front of every request.

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

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

ATTEMPTS, ATTEMPT_WINDOW = 5, 60.0  # wrong tokens of one address, and of all addresses ten times as many, in s
SESSIONS = 64  # open sessions; a further one replaces the oldest
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
    """The token and the sessions that it opened.

    host: the address at which the panel listens. token: '' for none on loopback, and for a random one elsewhere.
    clock: monotonic s.
    """

    def __init__(self, host: str, token: str, clock: Callable[[], float]) -> None:
        self.on_loopback = is_loopback(host)
        self.token = token or ("" if self.on_loopback else secrets.token_urlsafe(24))
        self._clock = clock
        self._sessions: deque[str] = deque(maxlen=SESSIONS)
        self._failures: deque[tuple[float, str]] = deque(maxlen=10 * ATTEMPTS)

    @property
    def is_open(self) -> bool:
        """Whether no token is needed."""
        return not self.token

    def allows_host(self, host: str) -> bool:
        """Return whether a request with this header `Host` may be answered."""
        return not self.is_open or is_loopback(_split(f"//{host}").hostname or "")

    def allows(self, session: str) -> bool:
        """Return whether a request with this session may see anything."""
        return self.is_open or any(_equal(session, known) for known in self._sessions)

    def is_token(self, given: str, address: str) -> bool:
        """Return whether `given` is the token, in constant time, and note a wrong one of `address`."""
        if self.is_blocked(address):
            return False
        right = not self.is_open and _equal(given, self.token)
        if not right:
            self._failures.append((self._clock(), address))
        return right

    def is_blocked(self, address: str) -> bool:
        """Return whether so many wrong tokens came from `address`, or from all, that none is compared now."""
        now = self._clock()
        recent = [origin for time, origin in self._failures if now - time <= ATTEMPT_WINDOW]
        return recent.count(address) >= ATTEMPTS or len(recent) >= 10 * ATTEMPTS

    def open_session(self) -> str:
        """Return the secret of a new session."""
        self._sessions.append(secrets.token_urlsafe(24))
        return self._sessions[-1]


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
        """Serve one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        if scope["type"] == "websocket":
            if refusal:
                await receive()
                await send({"type": "websocket.close", "code": POLICY_VIOLATION})
                return
            await self._app(scope, receive, send)
            return

        async def confined(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                answer["content-security-policy"] = REPORT if scope["path"].startswith("/report/") else CONFINED
                answer.update(HEADERS)
            await send(message)

        if refusal is None and scope["path"] == "/login":
            refusal = await self._login(scope, headers, receive)
        await (refusal or self._app)(scope, receive, confined)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the answer to a request that must not pass, None if it may."""
        host = headers.get("host", "")
        if not self._access.allows_host(host):
            return PlainTextResponse("403: the panel answers on loopback only: see docs/panel.md", 403)
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if changes and not is_same_origin(headers.get("origin", ""), host):
            return PlainTextResponse("403: this request does not come from the panel's page", 403)
        if scope["path"] == "/login" or self._access.allows(HTTPConnection(scope).cookies.get(COOKIE, "")):
            return None
        address = _address(scope)
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if scope["type"] == "http" and given and self._access.is_token(given, address):
            return self._opened(scope)  # the address with the token, as the log shows it
        return self._ask(self._access.is_blocked(address))

    async def _login(self, scope: Scope, headers: Headers, receive: Receive) -> Response:
        if scope["method"] != "POST":
            return RedirectResponse("/", 303)
        body = b""
        while len(body) <= MAX_BODY:
            message = await receive()
            body += message.get("body", b"")
            if not message.get("more_body"):
                break
        address = _address(scope)
        given = parse_qs(body[:MAX_BODY].decode("utf-8", "replace")).get("token", [""])[0]
        return self._opened(scope) if self._access.is_token(given, address) else self._ask(True)

    def _opened(self, scope: Scope) -> Response:
        answer = RedirectResponse("/", 303)
        secure = Headers(scope=scope).get("origin", "").startswith("https:")
        answer.set_cookie(COOKIE, self._access.open_session(), httponly=True, samesite="strict", secure=secure)
        return answer

    def _ask(self, failed: bool) -> Response:
        note = "The token is wrong, or too many were tried: wait a minute." if failed else ""
        return Response(self._form.replace("<!-- note -->", note), 401, media_type="text/html")


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return client[0] if client else "unknown"
