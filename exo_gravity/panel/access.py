"""Who may open the panel: a token, the cookie that replaces it, and the guard in front of every request.

On loopback no token is needed. A page from elsewhere could still reach it through the operator's browser, so the header
`Host` must then name this machine: a foreign name that resolves to 127.0.0.1 (DNS rebinding) is refused. Every request
that changes something must come from the panel's own page (`Origin`). Other headers confine the page.
"""

import hmac
import ipaddress
import re
import secrets
from collections import deque
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qs

from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

ATTEMPTS, ATTEMPT_WINDOW = 5, 60.0  # wrong tokens of one address, and of all addresses ten times as many, in s
COOKIE = "exo_gravity_panel"
MAX_BODY = 4096  # bytes of a request
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
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_same_origin(origin: str, host: str) -> bool:
    """Return whether the page at `origin` (a header's value) came from the server that `host` names."""
    return host != "" and origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")


class Access:
    """Passes on to `app` the requests and live connections of those who may use the panel.

    host: the address at which the panel listens. token: '' for none on loopback, and for a random one elsewhere.
    clock: monotonic s.
    """

    def __init__(self, app: ASGIApp, host: str, token: str, clock: Callable[[], float]) -> None:
        self.on_loopback = is_loopback(host)
        self.token = token or ("" if self.on_loopback else secrets.token_urlsafe(24))
        self.is_open = not self.token  #: whether no token is needed
        self.session = secrets.token_urlsafe(24)  #: the cookie's value: not the token, and another after each start
        self._app = app
        self._clock = clock
        self._failures: deque[tuple[float, str]] = deque(maxlen=10 * ATTEMPTS)
        self._form = (Path(__file__).parent / "static" / "login.html").read_text(encoding="utf-8")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request or live connection."""
        left = MAX_BODY

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

    async def login(self, request: Request) -> Response:
        """Answer the form that asks for the token."""
        given = parse_qs((await request.body()).decode("utf-8", "replace")).get("token", [""])[0]
        return self._opened_by(given, request)

    def allows_host(self, host: str) -> bool:
        """Return whether a request with this header `Host` may be answered."""
        return not self.is_open or is_loopback(re.sub(r":\d*$", "", host).strip("[]"))

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

    def _refusal(self, connection: HTTPConnection) -> Response | None:
        """Return the answer to a request that must not pass, None if it may."""
        scope, headers = connection.scope, connection.headers
        if not self.allows_host(headers.get("host", "")):
            return PlainTextResponse("403: the panel answers on loopback only: see docs/panel.md", 403)
        changes = scope.get("method") not in ("GET", "HEAD")  # a live connection has no method
        if changes and not is_same_origin(headers.get("origin", ""), headers.get("host", "")):
            return PlainTextResponse("403: this request does not come from the panel's page", 403)
        is_login = (scope["path"], scope.get("method")) == ("/login", "POST")
        if is_login or self.allows(connection.cookies.get(COOKIE, "")):
            return None
        return self._opened_by(connection.query_params.get("token", ""), connection)  # as the log shows it

    def _opened_by(self, given: str, connection: HTTPConnection) -> Response:
        """Return the session's cookie if `given` is the token, else the page that asks for it."""
        if not given or not self.is_token(given, address_of(connection)):
            note = "The token is wrong, or too many were tried: wait a minute." if given else ""
            return Response(self._form.replace("<!-- note -->", note), 401, media_type="text/html")
        answer = RedirectResponse("/", 303)
        secure = connection.headers.get("origin", "").startswith("https:")
        answer.set_cookie(COOKIE, self.session, httponly=True, samesite="strict", secure=secure)
        return answer


def address_of(connection: HTTPConnection) -> str:
    """Return the address of the client."""
    return connection.client.host if connection.client else "unknown"


def _equal(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())
