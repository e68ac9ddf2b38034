"""Who may open the panel: a token, the session that it opens, and the checks of each request's headers.

On loopback no token is needed. A page from elsewhere could still reach it through the operator's browser, so the header
`Host` must then name this machine: a foreign name that resolves to 127.0.0.1 (DNS rebinding) is refused. Every request
that changes something must come from the panel's own page (`Origin`).
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections import deque
from collections.abc import Callable
from urllib.parse import SplitResult, urlsplit

MIN_TOKEN = 12  # characters of a token that the user chooses
ATTEMPTS, ATTEMPT_WINDOW = 5, 60.0  # wrong tokens of one address, and of all addresses ten times as many, in s
SESSIONS = 64  # open sessions; a further one replaces the oldest


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
        self.token = token or ("" if is_loopback(host) else secrets.token_urlsafe(24))
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
        return self.is_open or any(_equal(session, known) for known in tuple(self._sessions))

    def is_token(self, given: str, address: str) -> bool:
        """Return whether `given` is the token, in constant time. A wrong one counts against `address`."""
        now = self._clock()
        while self._failures and now - self._failures[0][0] > ATTEMPT_WINDOW:
            self._failures.popleft()
        if self.is_blocked(address):
            return False
        right = not self.is_open and _equal(given, self.token)
        if not right:
            self._failures.append((now, address))
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
