"""The desk: performs what pages ask for, notes who asked, and lets the arms down when the operator's page is gone.

Letting down needs no control and has no rate limit: it must work from every page, at any time.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Mapping
from typing import Any, NamedTuple, Protocol

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.panel.actions import WITHOUT_CONTROL, Action, parse
from exo_gravity.panel.control import GONE, Control

RETRY = 1.0  # s between two attempts to let the arms down


class Arms(Protocol):
    """The arms as the desk sees them. Each call returns '' or why it failed."""

    @property
    def names(self) -> Collection[str]:
        """The arms that are or were present."""

    async def let_down(self, arm: str) -> str:
        """Let one arm down."""

    async def enable(self, arm: str) -> str:
        """Enable one arm."""

    async def clear_fault(self, arm: str) -> str:
        """Clear the latched fault of one arm."""

    async def set(self, arm: str, values: Mapping[str, Any]) -> str:
        """Set parameters of the arm's compensator together."""


class Files(Protocol):
    """Recordings, trials and saved parameters. Each call returns '' or why it failed."""

    @property
    def trials(self) -> Collection[str]:
        """The trials to choose from."""

    async def record(self) -> str:
        """Start a recording."""

    async def stop_recording(self) -> str:
        """End the recording."""

    async def trial(self, name: str) -> str:
        """Start a trial."""

    async def stop_trial(self) -> str:
        """End the trial early."""

    async def save(self) -> str:
        """Write the parameters in force as YAML."""


class Outcome(NamedTuple):
    """status: of HTTP. text: '' or why nothing was done."""

    status: int
    text: str = ""


class Desk:
    """Performs requests.

    note: called with a sentence for the log and the recording. clock: monotonic s.
    """

    def __init__(
        self,
        arms: Arms,
        files: Files,
        control: Control,
        note: Callable[[str], None],
        clock: Callable[[], float],
    ) -> None:
        self.control = control
        self._arms = arms
        self._files = files
        self._note = note
        self._clock = clock
        self._attempted = -RETRY  # monotonic s, by `watch`

    async def perform(self, body: Any, secret: str, address: str) -> Outcome:
        """Perform the request `body` of the page with `secret`, at `address`."""
        page = self.control.page(secret)
        who = page.label if page else f"{address} unknown page"
        try:
            action = parse(body, self._arms.names, self._files.trials)
        except ExoGravityError as error:
            return self._refused(secret, who, 400, str(error))
        if action.kind != "let_down":
            if page is None:
                return Outcome(403, "unknown page: reload it")
            if not self.control.spend(secret):
                return Outcome(429, "too many requests: wait a moment")
            if action.kind not in WITHOUT_CONTROL and not self.control.holds(secret):
                return self._refused(secret, who, 403, f"{action}: another page holds control")
        problem = await self._do(action, secret)
        self._note(f"{who}: {action}: {problem or 'done'}")
        return Outcome(409 if problem else 200, problem)

    def _refused(self, secret: str, who: str, status: int, text: str) -> Outcome:
        if self.control.spend(secret):  # a flood of wrong requests must not fill the log
            self._note(f"{who}: refused: {text}")
        return Outcome(status, text)

    async def _do(self, action: Action, secret: str) -> str:
        if action.kind == "let_down":
            return await self.let_down([action.arm] if action.arm else list(self._arms.names))
        if action.kind in ("take", "release"):
            (self.control.take if action.kind == "take" else self.control.release)(secret)
            return ""
        if action.kind == "set":
            return await self._arms.set(action.arm, action.values)
        if action.kind == "trial":
            return await self._files.trial(action.name)
        of_arm: dict[str, Callable[[str], Awaitable[str]]] = {
            "enable": self._arms.enable,
            "clear_fault": self._arms.clear_fault,
        }
        if action.kind in of_arm:
            return await of_arm[action.kind](action.arm)
        of_files: dict[str, Callable[[], Awaitable[str]]] = {
            "record": self._files.record,
            "stop_recording": self._files.stop_recording,
            "stop_trial": self._files.stop_trial,
            "save": self._files.save,
        }
        return await of_files[action.kind]()

    async def let_down(self, arms: Collection[str]) -> str:
        """Let `arms` down, all at once; return '' or which failed and why."""
        if not arms:
            return "no arm is present"
        problems = await asyncio.gather(*map(self._arms.let_down, arms))
        return "; ".join(f"{arm}: {problem}" for arm, problem in zip(arms, problems, strict=True) if problem)

    async def watch(self) -> None:
        """With `dead_man`, let all arms down if the page that holds control is gone; retry until it worked.

        Call it often.
        """
        waits = self._clock() - self._attempted < RETRY
        if not self.control.dead_man or not self.control.is_gone() or waits:
            return
        self._attempted = self._clock()
        holder = self.control.holder
        problem = await self.let_down(list(self._arms.names))
        self._note(f"{holder.label if holder else 'page'} has been gone for {GONE:g} s: let down: {problem or 'done'}")
        if not problem and self.control.holder is holder and self.control.is_gone():
            self.control.release_all()
