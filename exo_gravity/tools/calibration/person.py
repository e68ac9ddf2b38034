"""The person at the terminal: what is said to them, and how the program waits for what they do."""

from __future__ import annotations

import select
import sys
from collections.abc import Callable
from typing import IO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from exo_gravity.core.errors import DataError

REFRESH_PERIOD = 0.1  # s


class Person:
    """Talks through `console` and reads `keys`, by default the terminal."""

    def __init__(self, console: Console | None = None, keys: IO[str] | None = None) -> None:
        self._console = console or Console(highlight=False)
        self._keys = keys or sys.stdin

    def say(self, what: RenderableType) -> None:
        """Print a line or a table."""
        self._console.print(what, markup=False, soft_wrap=isinstance(what, str))

    def ask(self, request: str) -> None:
        """Print `request` and wait for Enter. Raises DataError if there is nobody to press it."""
        self.wait(request, lambda: "")

    def wait(self, request: str, watch: Callable[[], RenderableType]) -> None:
        """Print `request`, and show what `watch()` returns until Enter is pressed. Raises DataError as `ask` does."""
        self._console.print(Text(f"{request}; then press Enter", style="bold"))
        with Live(console=self._console, auto_refresh=False, transient=True) as live:
            while not self._pressed():
                live.update(Group(watch()), refresh=self._console.is_terminal)

    def _pressed(self) -> bool:
        ready, _, _ = select.select([self._keys], [], [], REFRESH_PERIOD)
        if not ready:
            return False
        if not self._keys.readline():
            raise DataError("nobody is there to press Enter: standard input has ended")
        return True
