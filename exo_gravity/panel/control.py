# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Who operates the arms, and what a page may ask for.

A page is one browser tab. It keeps its secret while it is reloaded, and confirms each few states that it receives. A
page that confirms nothing for 2 s is gone: the laptop is closed, or the network lost. One page at a time holds control,
the others watch. Every page may let the arms down at any time. Each confirmation of the page
that holds control renews its lease at the arms (core/safety/lease.py), if the panel has one: no page, no panel, no
lease. A request is an object such as {"do": "set", "arm": "right", "values": {"support": 0.3}}.
"""

import asyncio
import logging
import secrets
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.panel.view import OF_SUBJECT, SETTABLE

# What a page may ask for in "do", and the other keys of each request.
ARM = frozenset({"arm"})
KEYS: Mapping[str, frozenset[str]] = {
    # of every page
    "let_down": ARM,  # without it: all arms
    "take": frozenset(),  # control
    "marker": frozenset({"text"}),
    # of the page that holds control
    "enable": ARM,
    "activate": ARM,  # and enable: an arm whose bridge waits for its operator
    "clear_fault": ARM,
    "resume": ARM,  # clear and enable, after a fault that leaves nothing to repair
    "confirm_pose": ARM,  # the arm hangs as it is drawn
    "set": frozenset({"arm", "values"}),  # parameters of the compensator
    "weigh": ARM,  # what the hand holds; the compensator's diagnostics tell
    "bring_home": ARM,  # a simulated arm: its virtual wearer lets it hang
    "trial": frozenset({"name"}),
    "open": frozenset({"name", "program"}),  # a recording, on this computer, by a browser on it
    "session": frozenset({"subject", "protocol", "note"}),
    **dict.fromkeys(("release", "record", "stop_recording", "save", "stop_trial", "keep_wearer"), frozenset()),
}
FOR_ALL = ("let_down", "take", "marker")
CHANGEABLE = {**SETTABLE, **OF_SUBJECT}


@dataclass(frozen=True)
class PageLimits:
    """What the panel allows its pages."""

    #: s without a confirmation after which a page is gone; longer than a lease lasts, so that the next page
    #: finds the arm let down
    gone: float = 2.0
    pages: int = 32  #: at once


LIMITS = PageLimits()


def parse(body: Any, arms: Collection[str], trials: Collection[str]) -> dict[str, Any]:
    """Return the request that the JSON value `body` is, with its values in their types. Raises ParameterError."""
    kind = body.get("do") if isinstance(body, dict) else None
    if not isinstance(kind, str) or kind not in KEYS:
        raise ParameterError("do", kind, f"one of {', '.join(KEYS)}")
    allowed = {"do", *KEYS[kind]}
    if unknown := set(body) - allowed:
        raise ParameterError("request", sorted(unknown), f"without keys other than {', '.join(sorted(allowed))}")
    arm, name = body.get("arm", ""), body.get("name", "")
    if "arm" in KEYS[kind] and arm not in arms and (kind != "let_down" or arm != ""):
        raise ParameterError("arm", arm, f"one of {', '.join(sorted(arms)) or 'none: no arm is present'}")
    if not isinstance(name, str) or (kind == "trial" and name not in trials):
        raise ParameterError("name", name, f"one of {', '.join(sorted(trials))}" if kind == "trial" else "a text")
    if kind != "set":
        return dict(body)
    values = body.get("values") if isinstance(body.get("values"), dict) else {}
    if not values or not values.keys() <= CHANGEABLE.keys():
        raise ParameterError("values", list(values), f"an object with some of {', '.join(CHANGEABLE)}")
    checked = {}
    for key, value in values.items():  # of an arm with any number of joints
        param = CHANGEABLE[key].for_joints(len(value)) if isinstance(value, list) and value else CHANGEABLE[key]
        checked[key] = param.check(value)
    return {**body, "values": checked}


def without_value(error: ParameterError) -> str:
    """Return the error for page and log, which must not have the value: it may be the wearer's, or a name."""
    return f"{error.name} must be {error.expected}"


def sentence(request: Mapping[str, Any]) -> str:
    """Describe a request for the log, without the wearer's data."""
    values = request.get("values", {}).items()
    shown = ", ".join(key if key.startswith("wearer.") else f"{key} = {value}" for key, value in values)
    words = (request["do"].replace("_", " "), request.get("arm"), shown, request.get("name"))
    return " ".join(filter(None, words))


@dataclass
class Page:
    """A browser tab."""

    secret: str
    number: int  #: shown to people
    address: str
    seen: float  #: monotonic s of its last confirmation
    connection: Any = None  #: its open live connection

    def __str__(self) -> str:
        """Name the page in log lines."""
        return f"{self.address} page {self.number}"


class Control:
    """The pages, which of them holds control, and what is done for them.

    arms: `Arms` of nodes/panel/node.py.
    files: `Recordings`.
    note: called with a sentence for the log and the recording.
    clock: monotonic s.
    """

    def __init__(self, arms: Any, files: Any, note: Callable[[str], object], clock: Callable[[], float]) -> None:
        self.holder: Page | None = None  #: the page that holds control
        self.arms = arms
        self.files = files
        self._note = note
        self.clock = clock
        self._pages: dict[str, Page] = {}  # by secret
        self._numbers = 0

    def open(self, secret: str, address: str) -> Page | None:
        """Return the page of a new connection; None if there are too many pages.

        A known secret is the same page, reloaded. A page holds control from the start if no other does, or if the other
        is gone.
        """
        page = self._pages.get(secret)
        if page is None:
            if len(self._pages) >= LIMITS.pages:  # those that are closed lose their numbers
                self._pages = {known.secret: known for known in self._pages.values() if known.connection}
            if len(self._pages) >= LIMITS.pages:
                return None
            self._numbers += 1
            page = Page(secrets.token_urlsafe(24), self._numbers, address, self.clock())
            self._pages[page.secret] = page
        if self.holder is None or self.is_gone():
            self.holder = page
        self.confirm(page)
        return page

    def confirm(self, page: Page) -> None:
        """Note that the page shows the present state, and renew its lease."""
        page.seen = self.clock()
        if page is self.holder:
            self.arms.lease(str(page), "hold")

    def is_gone(self) -> bool:
        """Return whether a page holds control that is gone."""
        return self.holder is not None and self.clock() - self.holder.seen > LIMITS.gone

    @property
    def other_operator(self) -> str:
        """The name of another operator who holds control of an arm, instead of this panel's page; '' for none."""
        others = [self.arms.other_holder(arm, str(self.holder)) for arm in self.arms.names]
        return next(filter(None, others), "")

    async def perform(self, body: Any, secret: str, address: str, is_here: bool = False) -> tuple[int, str]:
        """Do what the JSON value `body` asks for, sent by the page with `secret`, at `address`.

        is_here: whether that is a browser on this computer.
        Returns an HTTP status, and '' or what is wrong.
        """
        page = self._pages.get(secret)
        try:
            request = parse(body, self.arms.names, self.files.trials)
        except ParameterError as error:
            return self._answer(page or f"{address} unknown page", "refused", without_value(error), 400)
        kind, arm, text = request["do"], request.get("arm", ""), sentence(request)
        if kind != "let_down":
            if page is None:
                return (403, "unknown page: reload it")
            if kind not in FOR_ALL and page is not self.holder:
                return self._answer(page, text, "another page holds control", 403)
            if arm and (other := self.arms.other_holder(arm, str(page))):
                return self._answer(page, text, f"{other} holds control of this arm", 403)
            if kind == "open" and not is_here:
                return self._answer(page, text, "only a browser on the panel's computer opens programs there", 403)
        if kind in ("enable", "activate", "resume"):  # by a page that confirms nothing, the arm is not carried for long
            self.arms.lease(str(page), "hold")
        try:
            problem = await self._carry_out(request, kind, arm, page)
        except ParameterError as error:
            problem = without_value(error)
        except ExoGravityError as error:  # a package is missing
            problem = str(error)
        except OSError as error:
            problem = f"{error.filename}: {error.strerror}"
        return self._answer(page or f"{address} unknown page", text, problem, 409 if problem else 200)

    def _answer(self, page: Page | str, text: str, problem: str, status: int) -> tuple[int, str]:
        """Note what a page asked for, and return its answer."""
        try:
            self._note(f"{page}: {text}: {problem or 'done'}")
        except Exception:  # what was to be noted has been done, and the next arm or page must not suffer from this
            logging.getLogger(__name__).exception("%s: %s: %s", page, text, problem or "done")
        return (status, problem)

    async def _carry_out(self, request: Mapping[str, Any], kind: str, arm: str, page: Page | None) -> str:
        if kind == "let_down":
            return await self._let_down([arm] if arm else self.arms.names)
        if kind in ("take", "release"):
            self.holder = page if kind == "take" else None
            self.arms.lease(str(page), kind)
            return ""
        if arm:
            return str(await self.arms.ask(kind, arm, request.get("values", {})))
        return str(await getattr(self.files, kind)(**{key: request.get(key, "") for key in KEYS[kind]}))

    async def _let_down(self, arms: Collection[str]) -> str:
        """Let the arms down all at once: none waits for another."""
        asked = (self.arms.ask("let_down", arm, {}) for arm in arms)
        results = await asyncio.gather(*asked, return_exceptions=True)
        problems = [f"{type(r).__name__}: {r}" if isinstance(r, BaseException) else r for r in results]
        failed = [f"{arm}: {problem}" for arm, problem in zip(arms, problems, strict=True) if problem]
        return "; ".join(failed) if arms else "no arm is present"
