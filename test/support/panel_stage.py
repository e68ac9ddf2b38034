# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The panel's web server with two arms that a test plays: everything but ROS and the device is real."""

import asyncio
import math
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.panel.control import SETTABLE, Control, LoadChanges, joint_rows, setup_of
from exo_gravity.panel.server import PanelServer

from . import PARTS
from .ports import free_port

PERIOD = 0.1  # s between two states
#: What a subject's file holds.
WEARER_FILE = {
    "wearer.body_mass": 61.5,
    "wearer.sex": "female",
    "wearer.segment_length": [0.3, 0.25, 0.08],
    "limits.lower": [-0.5, -0.2, -0.2, 0.0],
    "limits.upper": [0.5, 1.5, 1.5, 2.0],
}
STATE_AFTER = {
    "let_down": "letting down",
    "enable": "active",
    "activate": "active",
    "resume": "active",
    "clear_fault": "disabled",
}


@dataclass
class PlayedArms:
    """`Arms` of the panel. calls: what was asked for, in order. problem: the answer to each call. errors: by arm.

    leases: what pages asked for of control, in order.
    others: who else holds control, by arm.
    """

    names: tuple[str, ...] = ("right", "left")
    states: dict[str, str] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    calls: list[tuple[str, ...]] = field(default_factory=list)
    problem: str = ""
    errors: dict[str, Exception] = field(default_factory=dict)
    compensator: dict[str, str] = field(default_factory=dict)  #: further keys of a compensator
    wearer: dict[str, str] = field(default_factory=dict)  #: and of `wearer`
    pose: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  #: rad, about which the joints swing
    sinking: float = 0.0  #: rad/s at which the joints give way to gravity
    reports: dict[str, dict[str, str]] = field(default_factory=dict)  #: further keys of the bridges, by arm
    #: settings that the panel still shows of an arm, in place of those in force
    shown: dict[str, dict[str, Any]] = field(default_factory=dict)
    holds: bool = False  #: whether the settings are not read yet
    reads: int = 0  #: how often they were
    silent: set[str] = field(default_factory=set)  #: arms of which no joint states arrive
    #: what the simulators report
    simulator: dict[str, str] | None = field(
        default_factory=lambda: {"longest stall (ms)": "3", "longest silence (ms)": "14", "disconnected": "no"}
    )
    asked: dict[str, str] = field(default_factory=dict)  #: poses to confirm in degrees, by arm
    leases: list[tuple[str, str]] = field(default_factory=list)
    others: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.states = dict.fromkeys(self.names, "disabled")
        for name in self.names:
            given = {"side": name, "joint_names": [f"{name}_{leaf}" for leaf in PARTS], "wearer.body_mass": 75.0}
            self.settings[name] = values_of(COMPENSATOR, {**given, "support": 0.05})

    def parameters(self) -> dict[str, Any]:
        return {"/camera": {"depth.far": math.inf}}  # of another program; JSON has no such number

    def lease(self, page: str, kind: str) -> None:
        self.leases.append((page, kind))

    def other_holder(self, arm: str, page: str) -> str:
        return self.others.get(arm, "")

    async def settings_of(self, arm: str) -> dict[str, Any]:
        while self.holds:
            await asyncio.sleep(0.01)
        self.reads += 1
        if self.problem:
            raise ExoGravityError(self.problem)
        return {name: value for name, value in self.settings[arm].items() if name in SETTABLE}

    async def ask(self, kind: str, arm: str, values: Mapping[str, Any]) -> str:
        self.calls.append((kind, arm, str(dict(values))) if values else (kind, arm))
        if arm in self.errors:
            raise self.errors[arm]
        if self.problem:
            return self.problem
        self.settings[arm].update(values)
        if kind == "confirm_pose":
            self.asked.pop(arm, None)
        if kind in ("clear_fault", "resume"):
            self.faults.pop(arm, None)
        if kind != "let_down" or self.states[arm] == "active":
            self.states[arm] = STATE_AFTER.get(kind, self.states[arm])
        return ""

    def fail(self, arm: str, code: str) -> None:
        self.faults[arm], self.states[arm] = code, "fault"

    def state(self, name: str, now: float) -> dict[str, Any]:
        """Return the state of one arm as the node makes it."""
        names = self.settings[name]["joint_names"]
        position = [middle + 0.3 * math.sin(0.5 * now + n) for n, middle in enumerate(self.pose)]
        effort = [0.8 * math.sin(0.5 * now + n) for n in range(len(names))]
        state, fault = self.states[name], self.faults.get(name, "none")
        bridge = {
            "level": 2 if fault != "none" else 0,
            "message": f"fault: {fault}: {name} elbow" if fault != "none" else state,
            "state": state,
            "fault": fault,
            "rate (Hz)": "250.0",
            "age of efforts (ms)": "4.1",
            "limits acting": "none",
            "damped by": "still joint (elbow)",
            **{f"{joint} temperature (degC)": "31" for joint in names},
            "pose to confirm (deg)": self.asked.get(name, "none"),
            "resume": "possible" if fault == "command_stale" else "has_cause",
            "source": "simulated",
            "motors": "on" if state in ("proving signs", "ramping in", "active", "letting down") else "off",
            "refusal": "none",
            "waiting for": "none",
            "joints outside limits": "none",
            "turn back (deg)": "none",
            **self.reports.get(name, {}),
        }
        carried = {
            "mass carried (kg)": "1.854",
            "level": 0,
            "message": "compensating",
            "state": "compensating",
            "changing load": "none",
            "reason": "none",
            "weighing": "none",
            "wearer mass (kg)": f"0, {self.settings[name]['wearer.body_mass']:g}",
            **self.compensator,
        }
        share = dict.fromkeys(("share of the wearer (%)", "share band (%)"), "unknown")
        of_wearer = {"largest support": "0.068", "support adapts": "off", **share, **self.wearer}
        velocity = [-self.sinking * math.copysign(1.0, tau) for tau in effort]
        joints = joint_rows(SimpleNamespace(name=names, position=position, velocity=velocity, effort=effort))
        statuses = {"bridge": bridge, "compensator": carried, "wearer": of_wearer, "simulator": self.simulator}
        return {**statuses, "joints": None if name in self.silent else joints}


@dataclass
class PlayedFiles:
    """`Files` of the panel."""

    trials: tuple[str, ...] = ("demo", "two_poses")
    calls: list[str] = field(default_factory=list)
    reports: dict[str, Path] = field(default_factory=dict)  #: of trials, by name
    recorded: list[dict[str, Any]] = field(default_factory=list)  #: the past recordings
    wearers: dict[str, Any] = field(default_factory=dict)  #: the content of each subject's file
    content: dict[str, Any] = field(
        default_factory=lambda: {
            "recording": {"on": False, "foreign": False, "folder": "", "seconds": 0},
            "trial": {"phase": "none"},
            "saved": "",
            "session": {"subject": "", "protocol": "", "note": "", "folder": "/data", "wearer": {}},
        }
    )

    def file(self, name: str, pattern: str) -> Path | None:
        path = self.reports.get(name)
        return path and next(path.parent.glob(pattern), None)

    async def record(self) -> str:
        self.content["recording"] = {"on": True, "foreign": False, "folder": "recordings/r", "seconds": 1}
        return self._noted("record")

    async def stop_recording(self) -> str:
        self.content["recording"] = {"on": False, "foreign": False, "folder": "", "seconds": 0}
        return self._noted("stop_recording")

    def __getattr__(self, call: str) -> Callable[..., Coroutine[None, None, str]]:
        """Return what notes any other call with its words."""

        async def noted(**words: str) -> str:
            return self._noted(" ".join((call, *(words[key] for key in sorted(words)))))

        return noted

    def past(self) -> dict[str, Any]:
        return {"subjects": sorted(self.wearers), "past": self.recorded}

    async def session(self, subject: str, protocol: str, note: str) -> str:
        present = {"subject": subject, "protocol": protocol, "note": note, "folder": f"/data/{subject}"}
        self.content["session"] = {**present, "wearer": self.wearers.get(subject, {})}
        return self._noted(f"session {subject}, {protocol}, {note}")

    def _noted(self, call: str) -> str:
        self.calls.append(call)
        return ""


class Stage:
    """A running panel at `url`. notes: what it wrote to the log."""

    def __init__(self, host: str = "127.0.0.1", token: str = "") -> None:
        self.arms = PlayedArms()
        self.files, self.notes = PlayedFiles(), list[str]()
        self.control = Control(self.arms, self.files, self.notes.append, time.monotonic)
        self.port, self.token = free_port(), token
        self.url = f"http://127.0.0.1:{self.port}/"
        self.server = PanelServer(host, self.port, token, self.control)
        trials, markers = list(self.files.trials), ["begin", "end", "a text of one's own"]
        self._own_setup = {"language": "auto", "dead_man": False, "trials": trials, "markers": markers}
        self._bridge = values_of(CAN_BRIDGE, {"can.interface": "virtual", "can.channel": "stage"}, "can.options")
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self.server.stop()

    def _play(self) -> None:
        shown: Any = None
        changes = LoadChanges()
        while not self._stopping.wait(PERIOD):
            nodes = {
                arm: ({**self._bridge, "joint_names": settings["joint_names"]}, dict(settings))
                for arm, settings in (self.arms.settings | self.arms.shown).items()
            }
            if nodes != shown:
                shown = nodes
                self.server.setup = {**self._own_setup, **setup_of(nodes)}
            now = time.monotonic()
            arms = changes.with_causes({arm: self.arms.state(arm, now) for arm in self.arms.names}, nodes, now)
            self.server.state = {"arms": arms, "tilt": {"pitch": 0.2, "roll": -0.1}, **self.files.content}
