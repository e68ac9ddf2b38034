"""Who operates the arms: one page at a time holds control, the others watch.

A page is one browser tab. It keeps its secret while it is reloaded, and confirms each few states that it receives. A
page that confirms nothing for `GONE` seconds is gone: the laptop is closed, or the network lost.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field

GONE = 2.0  # s without a confirmation
FORGOTTEN = 600.0  # s after which a page that is gone loses its number
MAX_PAGES = 32
BURST, REFILL = 20.0, 10.0  # actions that a page may send at once, and per second


@dataclass
class Page:
    """A browser tab. number: shown to people. seen: monotonic s of its last confirmation."""

    number: int
    address: str
    seen: float
    connected: bool = True
    credit: float = BURST
    credited: float = field(default=0.0)

    @property
    def label(self) -> str:
        """The page in log lines."""
        return f"{self.address} page {self.number}"


class Control:
    """The pages, and which of them holds control.

    clock: monotonic s. dead_man: whether the arms are let down when the page that holds control is gone; until they
    are, only a page that takes control replaces it.
    """

    def __init__(self, clock: Callable[[], float], dead_man: bool = False) -> None:
        self.dead_man = dead_man
        self._clock = clock
        self._pages: dict[str, Page] = {}
        self._numbers = 0
        self._holder = ""

    @property
    def holder(self) -> Page | None:
        """The page that holds control."""
        return self._pages.get(self._holder)

    def page(self, secret: str) -> Page | None:
        """Return the page with this secret."""
        return self._pages.get(secret)

    def open(self, secret: str, address: str) -> tuple[str, Page] | None:
        """Return secret and page of a new connection; None if there are too many pages.

        A known secret is the same page, reloaded. A page holds control from the start if no other does, or if the other
        is gone and there is no `dead_man`.
        """
        self._forget()
        page = self._pages.get(secret)
        if page is None:
            if len(self._pages) >= MAX_PAGES:
                return None
            secret = secrets.token_urlsafe(24)
            self._numbers += 1
            page = self._pages[secret] = Page(self._numbers, address, self._clock(), credited=self._clock())
        if self.holder is None or (self.is_gone() and not self.dead_man):
            self._holder = secret
        page.connected, page.seen = True, self._clock()
        return secret, page

    def close(self, secret: str) -> None:
        """Note that the page's connection has ended."""
        if page := self._pages.get(secret):
            page.connected = False

    def confirm(self, secret: str) -> None:
        """Note that the page shows the present state."""
        if page := self._pages.get(secret):
            page.seen = self._clock()

    def holds(self, secret: str) -> bool:
        """Return whether the page holds control."""
        return bool(secret) and secret in self._pages and secret == self._holder

    def take(self, secret: str) -> None:
        """Give control to the page."""
        if secret in self._pages:
            self._holder = secret

    def release(self, secret: str) -> None:
        """Take control from the page, if it holds it."""
        if secret == self._holder:
            self._holder = ""

    def release_all(self) -> None:
        """Leave control free for the next page that takes it."""
        self._holder = ""

    def is_gone(self) -> bool:
        """Return whether a page holds control that is gone."""
        holder = self.holder
        return holder is not None and self._clock() - holder.seen > GONE

    def spend(self, secret: str) -> bool:
        """Return whether the page may send one more action now."""
        page = self._pages.get(secret)
        if page is None:
            return False
        now = self._clock()
        page.credit = min(BURST, page.credit + REFILL * (now - page.credited))
        page.credited = now
        if page.credit < 1.0:
            return False
        page.credit -= 1.0
        return True

    def _forget(self) -> None:
        """Drop pages that are long gone, and any that is closed if there are too many."""
        now, full = self._clock(), len(self._pages) >= MAX_PAGES
        for secret, page in list(self._pages.items()):
            awaited = self.dead_man and secret == self._holder  # by Desk.watch
            if not page.connected and not awaited and (full or now - page.seen > FORGOTTEN):
                del self._pages[secret]
                self.release(secret)
