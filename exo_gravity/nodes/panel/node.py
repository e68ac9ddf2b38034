# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""panel: a web page on the machine that carries the arms: see them, set the support, let them down.

It is a ROS client like any other: it uses the topics, services and parameters that `ros2` can use, and nothing depends
on it. The web server (exo_gravity/panel/server.py) runs on a separate thread, which calls the services; this node's
executor receives the answers, collects the state of the arms and sends it to the pages ten times a second. Joint states
arrive hundreds of times a second: their subscription keeps the newest message outside the executor (`Latest`).
"""

import asyncio
import math
import os
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import KeyValue
from geometry_msgs.msg import Vector3Stamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from exo_gravity import packaged
from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.lab.bag.content import MARKERS
from exo_gravity.lab.inputs.arms import fitting
from exo_gravity.lab.packages import extras
from exo_gravity.lab.vocabulary import NodeState
from exo_gravity.nodes.others import Latest, OtherNodes, Statuses
from exo_gravity.nodes.ros.messages import HELD_BY, NOBODY, OK, Diagnostics
from exo_gravity.nodes.ros.parameters import declare, plain
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import MANY_REQUESTS, PITCH_YAW
from exo_gravity.panel.control import PANEL, SETTABLE, Control, LoadChanges, Values, joint_rows, setup_of
from exo_gravity.panel.recordings import Recordings

with extras("panel", "report"):
    from exo_gravity.panel.server import PanelServer


@dataclass(frozen=True)
class PanelTiming:
    """When the panel looks, and how long it waits."""

    state_period: float = 0.1  #: s between two states that the pages get
    discovery_period: float = 0.5  #: s between two searches for nodes
    silent: float = 1.5  #: s without diagnostics or joint states after which the last ones are not shown any more
    call_timeout: float = 3.0  #: s, longer than can_bridge itself waits
    transition_timeout: float = 15.0  #: s in which can_bridge opens its buses and starts its watchdog
    absent_timeout: float = 0.5  #: s, where the service seems to be absent
    look_period: float = 0.005  #: s between two looks for an answer


TIMING = PanelTiming()


BRIDGE, COMPENSATOR, WEARER = "can_bridge", "compensator", "wearer"
SIMULATOR = "simulator"
# What the page calls the status of each
SHOWN = {BRIDGE: "bridge", COMPENSATOR: "compensator", WEARER: "wearer", SIMULATOR: "simulator"}
SET = "set_parameters_atomically"
ASKED = {  # service and request for each request of a page; None for the parameters that it names
    "let_down": (SetBool, f"{BRIDGE}/enable", SetBool.Request(data=False)),
    "enable": (SetBool, f"{BRIDGE}/enable", SetBool.Request(data=True)),
    "clear_fault": (Trigger, f"{BRIDGE}/clear_fault", Trigger.Request()),
    "resume": (Trigger, f"{BRIDGE}/resume", Trigger.Request()),
    "confirm_pose": (Trigger, f"{BRIDGE}/confirm_pose", Trigger.Request()),
    "weigh": (Trigger, f"{COMPENSATOR}/weigh", Trigger.Request()),
    "set": (SetParametersAtomically, f"{COMPENSATOR}/{SET}", None),
    "perform": (SetParametersAtomically, f"{SIMULATOR}/{SET}", None),  # of no page
}


class ArmClient:
    """The services of one arm, in the namespace `/name`, its joint states, and who controls it.

    is_wanted: whether the arm was not asked to be let down since it was to be activated.
    """

    def __init__(self, node: Node, name: str) -> None:
        self.services = {
            kind: node.create_client(srv, f"/{name}/{leaf}", qos_profile=MANY_REQUESTS)
            for kind, (srv, leaf, _) in ASKED.items()
        }
        self.settings = node.create_client(GetParameters, f"/{name}/{COMPENSATOR}/get_parameters")
        self._transitions = node.create_client(ChangeState, f"/{name}/{BRIDGE}/change_state")
        self.control = node.create_publisher(KeyValue, f"/{name}/{BRIDGE}/control", 10)
        self.joints = Latest(node, JointState, f"/{name}/joint_states", joint_rows)
        self.is_wanted = False

    async def activate(self) -> str:
        """Configure the bridge, unless it is, and activate it, which enables the arm; return '' or why not.

        Raises ExoGravityError if it does not answer.
        """
        self.is_wanted = True
        for step in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            if not self.is_wanted:
                return "the arm was asked to be let down"
            request = ChangeState.Request(transition=Transition(id=step))
            answer = await answer_of(self._transitions, request, TIMING.transition_timeout)
        return "" if answer.success else "the bridge could not be activated: it is active, or its log says why"


class Arms:
    """All arms, by name: 'right', 'left', or the namespace that a parameter file gives them; and all other nodes.

    An arm is what has a can_bridge with the service `enable`: other programs may have a node of that name. It stays in
    the list when its nodes end: it shows that they do not answer. has_lease: whether a page that holds control holds it
    at the arms too.
    """

    def __init__(self, node: Node, has_lease: bool) -> None:
        self.clients: dict[str, ArmClient] = {}
        self._candidates: dict[str, ArmClient] = {}  # the same, and those whose services were never seen
        self._node = node
        self._lessee = f"panel {os.getpid()}, " if has_lease else ""
        self._others = OtherNodes(node, fitting=fitting)
        self._statuses = Statuses(node)
        self._markers = node.create_publisher(String, MARKERS, 10)
        node.create_subscription(ParameterEvent, "/parameter_events", self._on_parameter_event, 50)

    @property
    def names(self) -> Collection[str]:
        """The arms that are or were present."""
        return tuple(self.clients)

    def discover(self) -> None:
        """Add the arms and parameters of new nodes, and read parameters that have changed."""
        self._others.update()
        for name in self._others.found:
            arm, _, leaf = name.strip("/").rpartition("/")
            if leaf == BRIDGE and arm and arm not in self._candidates:
                self._candidates[arm] = ArmClient(self._node, arm)
        for arm, client in self._candidates.items():
            if arm not in self.clients and client.services["let_down"].service_is_ready():
                self.clients[arm] = client

    def state(self) -> dict[str, Any]:
        """Return what the page shows of each arm; None in the place of what is old."""
        shown = {}
        for name, client in sorted(self.clients.items(), reverse=True):
            statuses = {
                kind: self._statuses.within(TIMING.silent, f"{name}/{leaf}") or None for leaf, kind in SHOWN.items()
            }
            shown[name] = {"joints": client.joints.within(TIMING.silent), **statuses}
        return shown

    def nodes(self) -> dict[str, tuple[Values, Values]]:
        """Return the newest parameters of bridge and compensator by arm, {} while they are not known."""
        return {
            arm: (self._others.values(f"/{arm}/{BRIDGE}"), self._others.values(f"/{arm}/{COMPENSATOR}"))
            for arm in self.names
        }

    # For a trial (`Device` of exo_gravity.panel.recordings); called on the web server's thread

    def parameters(self) -> dict[str, dict[str, Any]]:
        """Return the parameters of every node that runs, by full name."""
        return {
            name: dict(parameters.values)
            for name, parameters in sorted(self._others.found.copy().items())
            if parameters.is_present
        }

    def states(self) -> dict[str, str | None]:
        """Return the state that each bridge reports; None if it is silent."""
        return {name: self._report(name).get("state") for name in self.names}

    async def perform(self, script: str) -> str:
        """Let the virtual wearers perform the script at this path, '' for none; return '' or why not."""
        simulated = [arm for arm in sorted(self.names) if f"/{arm}/{SIMULATOR}" in self._others.found]
        problems = [(arm, await self.ask("perform", arm, {"trial": script})) for arm in simulated]
        return "; ".join(f"/{arm}/{SIMULATOR}: {problem}" for arm, problem in problems if problem)

    def mark(self, text: str) -> str:
        """Publish a marker; return '' or why not."""
        if not self._markers.get_subscription_count():
            return "nothing is being recorded yet"
        self._markers.publish(String(data=text))
        return ""

    # For the pages (`Control`); called on the web server's thread; each coroutine returns '' or why it failed

    def lease(self, page: str, kind: str) -> None:
        """Hold, take or release control of all arms for a page, if the panel has a lease."""
        if self._lessee:
            for client in tuple(self.clients.values()):
                client.control.publish(KeyValue(key=self._lessee + page, value=kind))

    def other_holder(self, arm: str, page: str) -> str:
        """Return the name of another operator who holds control of the arm, as its bridge reports; '' for none."""
        holder: str = self._report(arm).get(HELD_BY, NOBODY)
        return "" if holder in (NOBODY, self._lessee + page) else holder

    async def ask(self, kind: str, arm: str, values: Mapping[str, Any]) -> str:
        """Do what a page asks of one arm. The request is sent even where the service seems to be absent."""
        if kind == "activate":
            return await self.clients[arm].activate()
        if kind == "bring_home":
            if f"/{arm}/{SIMULATOR}" not in self._others.found:
                return "the arm is not simulated"
            kind, values = "perform", {"trial": str(packaged("home.yaml"))}
        self.clients[arm].is_wanted &= kind != "let_down"
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = ASKED[kind][-1] or SetParametersAtomically.Request(parameters=given)
        return await call(self.clients[arm].services[kind], request)

    async def settings_of(self, arm: str) -> dict[str, Any]:
        """Return the settings that the arm's compensator has at this moment, {} for an arm without one.

        Raises ExoGravityError if it does not answer.
        """
        node = f"/{arm}/{COMPENSATOR}"
        if node not in self._others.found:
            return {}
        known = self._others.values(node)
        names = [name for name in SETTABLE if name in known]  # an arm of a URDF has none of them
        answer = await answer_of(self.clients[arm].settings, GetParameters.Request(names=names))
        if not known or len(answer.values) != len(names):
            raise ExoGravityError(f"the parameters of {node} are not known yet")
        values = map(parameter_value_to_python, answer.values)
        return {name: plain(value) for name, value in zip(names, values, strict=True)}

    def _report(self, arm: str) -> dict[str, Any]:
        """Return what the arm's bridge reports; {} if it is silent."""
        return self._statuses.within(TIMING.silent, f"{arm}/{BRIDGE}")

    def _on_parameter_event(self, event: ParameterEvent) -> None:
        if event.node in self._others.found:
            self._others.found[event.node].refresh()


async def answer_of(client: Client, request: Any, timeout: float = TIMING.call_timeout) -> Any:
    """Send `request` at once; return the response. Raises ExoGravityError if none comes within `timeout` s."""
    sent = client.call_async(request)
    deadline = time.monotonic() + (timeout if client.service_is_ready() else TIMING.absent_timeout)
    while not sent.done():
        if time.monotonic() > deadline:
            client.remove_pending_request(sent)
            raise ExoGravityError(f"{client.srv_name} does not answer")
        await asyncio.sleep(TIMING.look_period)
    return sent.result()


async def call(client: Client, request: Any) -> str:
    """Send `request` at once; return '' if it was carried out, else why not."""
    try:
        response = await answer_of(client, request)
    except ExoGravityError as error:
        return str(error)
    if isinstance(response, SetParametersAtomically.Response):
        is_done, reason = response.result.successful, response.result.reason
    else:
        is_done, reason = response.success, response.message
    return "" if is_done else reason or "refused without a reason"


class Panel(Node):
    """Collects the state of the arms for the pages, and passes on what they ask for."""

    def __init__(self) -> None:
        super().__init__("panel", automatically_declare_parameters_from_overrides=True)
        # The token is not kept as a parameter, which any node could read and a recording would hold.
        values = declare(self, [replace(param, fixed=param.name != "token") for param in PANEL])
        self.undeclare_parameter("token")
        self.failure: Exception | None = None  # ends the node, see run()
        self._diagnostics = Diagnostics(self)
        self._noted = 0
        self._arms = Arms(self, values["dead_man"])
        self._tilt = Latest(self, Vector3Stamped, PITCH_YAW, tilt_shown)
        scripts = Path(values["trials"]) if values["trials"] else packaged("trials")
        if scripts is None or not scripts.is_dir():
            raise ParameterError("trials", values["trials"], "a folder")
        self._recordings = Recordings(values["output"], scripts, self._arms, self._note, time.monotonic)
        self._own_setup = {
            "trials": list(self._recordings.trials),
            **{name: values[name] for name in ("language", "dead_man", "markers")},
        }
        self._shown: Any = None  # the nodes' parameters that the pages have
        self._changes = LoadChanges()
        control = Control(self._arms, self._recordings, self._note, time.monotonic)
        self._server = PanelServer(values["host"], values["port"], values["token"], control)
        self.create_timer(TIMING.state_period, self._send_state)
        self.create_timer(TIMING.discovery_period, self._arms.discover)
        self._log_address(values["host"], values["port"])

    def close(self) -> None:
        """End the recording and the server. The arms are left as they are."""
        self._recordings.close()
        self._server.stop()

    def _log_address(self, host: str, port: int) -> None:
        access = self._server.access
        shown = f"[{host}]" if ":" in host else host
        log = self.get_logger()
        if access.is_open:
            log.info(f"the panel is at http://{shown}:{port}/, on this machine only")
            return
        log.info(f"the panel is at http://{shown}:{port}/?token={access.token}")
        if not access.on_loopback:
            log.warning("anyone on the network path can read the token: put TLS before it (docs/operating.md)")

    def _note(self, text: str) -> None:
        """Write `text` to the log, and to /diagnostics, which recordings hold."""
        self._noted += 1
        values = {"state": NodeState.RUNNING, "actions": self._noted, "action text": text}
        self._diagnostics.report(OK, f"action {self._noted}: {text}", values)

    def _send_state(self) -> None:
        if not self._server.thread.is_alive():
            self.failure = RuntimeError("the web server has ended")
        nodes = self._arms.nodes()
        if nodes != self._shown:
            self._shown = nodes
            self._server.setup = {**self._own_setup, **setup_of(nodes)}
        self._server.state = {
            "arms": self._changes.with_causes(self._arms.state(), nodes, time.monotonic()),
            "tilt": self._tilt.within(TIMING.silent),
            **self._recordings.state(),
        }


def tilt_shown(message: Vector3Stamped) -> dict[str, float] | None:
    """Return the tilt in rad as the page shows it, None for one that is not finite."""
    pitch, roll = message.vector.y, message.vector.x
    return {"pitch": pitch, "roll": roll} if math.isfinite(pitch + roll) else None


def main() -> None:
    """Entry point of the executable `panel`."""
    raise SystemExit(run(Panel, priority=5))  # a press on its page must reach the arm
