# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Who operates the arms, and what a page may ask for.

A page is one browser tab. It keeps its secret while it is reloaded, and confirms each few states that it receives. A
page that confirms nothing for 2 s is gone: the laptop is closed, or the network lost. It may only let arms down: its
request may be as late. One page at a time holds control, the others watch. Every page may let the arms down at any
time. Each confirmation of the page that holds control renews its lease at the arms (core/safety/lease.py), if the panel
has one: no page, no panel, no lease. A request is an object such as {"do": "set", "arm": "right", "values": {"support":
0.3}}.
"""

import asyncio
import logging
import math
import secrets
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from exo_gravity.core.compensation.load_change import CAUSE_TIME
from exo_gravity.core.compensation.settings import COMPENSATOR, URDF, WORN_MOMENTS
from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.core.params import Param
from exo_gravity.lab.view import described, urdf
from exo_gravity.lab.vocabulary import source_of

# fmt: off
PANEL = (
    Param("host", "127.0.0.1", "address of the page; other than loopback only with a token", fixed=True),
    Param("port", 8080, "TCP port of the page", (1, 65535), fixed=True),
    Param("token", "", "secret that opens the page; empty: random beyond loopback, in the log",
          fixed=True),
    Param("dead_man", False, "let the arms down when the page that holds control has been gone for 1 s", fixed=True),
    Param("language", "auto", "language of the page until its user chooses another; auto: the browser's",
          choices=("auto", "en", "de"), fixed=True),
    Param("trials", "", "folder with trial scripts; empty: those of the package", fixed=True),
    Param("markers", ["begin", "end", "rest", "fatigue", "pain", "artefact"], "texts of the buttons that set a marker",
          any_length=True, fixed=True),
    Param("output", "recordings", "folder for recordings, trials and saved parameters", fixed=True),
)
# fmt: on
# What the page may change on a compensator. Every limit stays with the compensator and the bridge.
# Found by `calibrate wearer`: the page withdraws them with another wearer's data.
CALIBRATED = ("wearer.first_moment", "wearer.off_axis", *WORN_MOMENTS, "wearer.joint_stiffness")
LOAD = ("mode", "wearer.body_mass", "wearer.sex", "wearer.segment_length", *CALIBRATED, "support", "payload.mass")
SETTABLE = {param.name: param for param in (*COMPENSATOR, *URDF) if param.name in LOAD}
# What belongs to a subject: in the wearer's file, and set by the page together with the wearer's data.
OF_SUBJECT = {p.name: p for p in COMPENSATOR if p.name in (*LOAD[1:4], "limits.lower", "limits.upper")}

Values = Mapping[str, Any]
NEWS_DELAY = 1.5  # s after a fault in which the panel may still learn of a change that came before it


def joint_rows(states: Any) -> list[dict[str, Any]]:
    """Return name, angle in rad, speed in rad/s and torque in Nm of each joint; None for a number that is not known.

    states: a sensor_msgs/JointState.
    """

    def known(values: Sequence[float], n: int) -> float | None:
        return round(values[n], 4) if n < len(values) and math.isfinite(values[n]) else None

    return [
        {"name": name, **{field: known(getattr(states, field), n) for field in ("position", "velocity", "effort")}}
        for n, name in enumerate(states.name)
    ]


def setup_of(nodes: Mapping[str, tuple[Values, Values]]) -> dict[str, Any]:
    """Return limits and settings of every arm, and the picture's URDF, None if it is not known.

    nodes: the parameters of `can_bridge` and `compensator` by arm, {} while they are not known.
    """
    try:
        picture = urdf([described(*both[::-1]) for both in nodes.values() if all(both)])
    except (ExoGravityError, KeyError):
        picture = None
    arms = {}
    for arm, (bridge, compensator) in nodes.items():
        efforts = [values["max_effort"] for values in (bridge, compensator) if values.get("max_effort")]
        # With a URDF, 0 of the compensator stands for the limit in it.
        # Nodes of arms with different joints, which do not work together, may be in one namespace.
        given = [[limit for limit in column if limit > 0.0] for column in zip(*efforts, strict=False)]
        arms[arm] = {
            "max_effort": [min(column, default=None) for column in given] if given else None,
            "settings": {name: compensator.get(name) for name in SETTABLE},
            "source": source_of(bridge, False).value,
        }
    return {"arms": arms, "urdf": picture}


class LoadChanges:
    """Names the change of load that came shortly before an arm's fault, and may be its cause."""

    def __init__(self) -> None:
        # By arm: each load that it had lately, and monotonic s at which that was last in force; the present one is last
        self._loads: dict[str, deque[tuple[Values, float]]] = defaultdict(deque)
        self._faults: dict[str, float] = {}  # monotonic s at which the present one was seen first

    def with_causes(
        self, arms: Mapping[str, Any], nodes: Mapping[str, tuple[Values, Values]], now: float
    ) -> dict[str, Any]:
        """Return the states of `arms`, each with the `cause` of its fault or None. Call it with each new state.

        nodes: the parameters of `can_bridge` and `compensator` by arm.
        now: monotonic s.
        """
        return {arm: {**state, "cause": self._cause(arm, state, nodes[arm][1], now)} for arm, state in arms.items()}

    def _cause(self, arm: str, state: Mapping[str, Any], compensator: Values, now: float) -> dict[str, Any] | None:
        loads, is_faulty = self._loads[arm], (state["bridge"] or {}).get("fault", "none") != "none"
        if not is_faulty:
            self._faults.pop(arm, None)
        began = self._faults.setdefault(arm, now) if is_faulty else now
        if compensator and now - began <= NEWS_DELAY:
            load = {name: compensator.get(name) for name in LOAD}
            if loads and loads[-1][0] == load:
                loads.pop()
            loads.append((load, now))
            if not is_faulty and (state["compensator"] or {}).get("changing load", "none") != "none":
                loads[0] = loads[0][0], now  # the old load still acts
            while began - loads[0][1] > CAUSE_TIME:
                loads.popleft()
        return difference(loads[0][0], loads[-1][0]) if is_faulty and loads else None


def difference(before: Values, load: Values) -> dict[str, Any] | None:
    """Return how `load` differs from the load before, None if it does not; of the wearer's data, only that they do."""
    acting = LOAD if load["mode"] == "zero_g" else ("mode", "payload.mass")
    name = next((name for name in acting if load[name] != before[name]), "")
    what = name.partition(".")[0]
    if what in ("", "wearer"):
        return {"what": what} if what else None
    return {"what": what, "from": before[name], "to": load[name]}


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


# s without a confirmation after which a page is gone; longer than a lease lasts: the next page finds the arm let down
GONE = 2.0
MOST_PAGES = 32  # at once


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
    shown = ", ".join(
        key if key.startswith("wearer.") else f"{key} = {value}" for key, value in request.get("values", {}).items()
    )
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
            if len(self._pages) >= MOST_PAGES:  # those that are closed lose their numbers
                self._pages = {known.secret: known for known in self._pages.values() if known.connection}
            if len(self._pages) >= MOST_PAGES:
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
        return self.holder is not None and self.clock() - self.holder.seen > GONE

    @property
    def other_operator(self) -> str:
        """The name of another operator who holds control of an arm, instead of this panel's page; '' for none."""
        return next(filter(None, (self.arms.other_holder(arm, str(self.holder)) for arm in self.arms.names)), "")

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
            if arm and self.is_gone():  # the network may have delayed the request
                return self._answer(page, text, "this page was out of touch for 2 s: look at the arm first", 403)
            if kind in ("enable", "activate", "resume"):
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
        results = await asyncio.gather(*(self.arms.ask("let_down", arm, {}) for arm in arms), return_exceptions=True)
        problems = [f"{type(r).__name__}: {r}" if isinstance(r, BaseException) else r for r in results]
        failed = [f"{arm}: {problem}" for arm, problem in zip(arms, problems, strict=True) if problem]
        return "; ".join(failed) if arms else "no arm is present"
