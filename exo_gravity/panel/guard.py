"""The guard in front of every request: host, token, origin, size; and the headers that confine the page.

It wraps the application, so that nothing is served before it agrees: neither the page nor its assets nor the live
connection. A request without access gets the form that asks for the token, with status 401.
"""

from __future__ import annotations

from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from exo_gravity.panel.access import Access, is_same_origin

COOKIE = "exo_gravity_panel"
MAX_BODY = 4096  # bytes of a request
REFUSED = 1008  # WebSocket: policy violation
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
                await send({"type": "websocket.close", "code": REFUSED})
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
        if changes and int(headers.get("content-length", "0") or 0) > MAX_BODY:
            return PlainTextResponse("413: too long", 413)
        session = HTTPConnection(scope).cookies.get(COOKIE, "")
        bearer = headers.get("authorization", "").removeprefix("Bearer ")
        if scope["path"] == "/login" or self._access.allows(session) or self._bears(bearer, scope):
            return None
        address = _address(scope)
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if scope["type"] == "http" and given and self._access.is_token(given, address):
            return self._opened(scope)  # the address with the token, as the log shows it
        return self._ask(self._access.is_blocked(address))

    def _bears(self, bearer: str, scope: Scope) -> bool:
        return bool(bearer) and self._access.is_token(bearer, _address(scope))

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
