"""panel: a web page on the machine that carries the arms: see them, set the support, let them down.

It is a ROS client like any other: it uses the topics, services and parameters that `ros2` can use, and nothing depends
on it. The web server (exo_gravity/panel/server.py) runs on a separate thread, which calls the services; this node's
executor receives the answers, collects the state of the arms and sends it to the pages ten times a second. Joint states
arrive hundreds of times a second: their subscription keeps the newest message outside the executor (`HotPath`).
"""

import asyncio
import math
import os
import time
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from exo_gravity import packaged
from exo_gravity.bag.content import MARKERS
from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.nodes.ros.messages import HELD_BY, NOBODY, OK, Diagnostics, Newest, status_values
from exo_gravity.nodes.ros.parameters import NodeParameters, declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import HotPath
from exo_gravity.panel.control import Control
from exo_gravity.panel.recordings import Recordings
from exo_gravity.panel.view import PANEL, LoadChanges, Values, joint_rows, setup_of

STATE_PERIOD = 0.1  # s between two states that the pages get
DISCOVERY_PERIOD = 0.5  # s between two searches for nodes
SILENT = 1.5  # s without diagnostics or joint states after which the last ones are not shown any more
CALL_TIMEOUT = 3.0  # s, longer than can_bridge itself waits
ABSENT_TIMEOUT = 0.5  # s, where the service seems to be absent
LOOK_PERIOD = 0.005  # s between two looks for an answer
TILT = "/imu/pitch_yaw"
BRIDGE, COMPENSATOR = "can_bridge", "compensator"
SIMULATOR = "simulator"
SHOWN = {BRIDGE: "bridge", COMPENSATOR: "compensator", SIMULATOR: "simulator"}  # what the page calls the status of each
ASKED = {  # service and request for each request of a page but `set`
    "let_down": (SetBool, f"{BRIDGE}/enable", SetBool.Request(data=False)),
    "enable": (SetBool, f"{BRIDGE}/enable", SetBool.Request(data=True)),
    "clear_fault": (Trigger, f"{BRIDGE}/clear_fault", Trigger.Request()),
    "resume": (Trigger, f"{BRIDGE}/resume", Trigger.Request()),
    "weigh": (Trigger, f"{COMPENSATOR}/weigh", Trigger.Request()),
}


class ArmClient:
    """One arm, in the namespace `/name`."""

    def __init__(self, node: Node, name: str) -> None:
        self.newest = dict.fromkeys(("joints", *SHOWN.values()), Newest())  #: what the page shows of it
        self.services = {kind: node.create_client(srv, f"/{name}/{leaf}") for kind, (srv, leaf, _) in ASKED.items()}
        self.services["set"] = parameter_client(node, f"/{name}/{COMPENSATOR}")
        self.control = node.create_publisher(KeyValue, f"/{name}/{BRIDGE}/control", 10)
        self._states = HotPath(node, JointState, f"/{name}/joint_states", self._on_states)

    def state(self) -> dict[str, Any]:
        """Take the newest joint states, and return what the page shows; None in the place of what is old."""
        self._states.poll()
        return {kind: newest.within(SILENT) for kind, newest in self.newest.items()}

    def report(self) -> dict[str, str]:
        """Return what the bridge reports; {} if it is silent."""
        return self.newest["bridge"].within(SILENT) or {}

    def _on_states(self, message: JointState, _info: dict[str, Any]) -> None:
        rows = joint_rows(message.name, message.position, message.velocity, message.effort)
        self.newest["joints"] = Newest(rows, time.monotonic())


class Arms:
    """All arms, by name: 'right', 'left', or the namespace that a parameter file gives them; and all other nodes.

    An arm stays in the list when its nodes end: it shows that they do not answer. has_lease: whether a page that holds
    control holds it at the arms too.
    """

    def __init__(self, node: Node, has_lease: bool) -> None:
        self.clients: dict[str, ArmClient] = {}
        self._node = node
        self._lessee = f"panel {os.getpid()}, " if has_lease else ""
        self._parameters: dict[str, NodeParameters] = {}  # by full name, also of nodes that ended
        self._wearers: dict[str, Client] = {}  # the virtual ones, by their simulator's name
        self._markers = node.create_publisher(String, MARKERS, 10)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        node.create_subscription(ParameterEvent, "/parameter_events", self._on_parameter_event, 50)

    @property
    def names(self) -> Collection[str]:
        """The arms that are or were present."""
        return tuple(self.clients)

    def discover(self) -> None:
        """Add the arms and parameters of new nodes, and read parameters that have changed."""
        found = self._node.get_node_names_and_namespaces()
        nodes = {f"{space.rstrip('/')}/{name}" for name, space in found if not name.startswith("_")}
        nodes.discard(self._node.get_fully_qualified_name())
        for name in nodes - set(self._parameters):
            self._parameters[name] = NodeParameters(self._node, name)
            arm, _, leaf = name.strip("/").rpartition("/")
            if leaf == BRIDGE and arm and arm not in self.clients:
                self.clients[arm] = ArmClient(self._node, arm)
            if leaf == SIMULATOR and name not in self._wearers:
                self._wearers[name] = parameter_client(self._node, name)
        for parameters in self._parameters.values():
            parameters.update()

    def state(self) -> dict[str, Any]:
        """Return what the page shows of each arm."""
        return {name: client.state() for name, client in sorted(self.clients.items(), reverse=True)}

    def nodes(self) -> dict[str, tuple[Values, Values]]:
        """Return the newest parameters of bridge and compensator by arm, {} while they are not known."""
        known = {name: parameters.values for name, parameters in self._parameters.items()}
        return {arm: (known[f"/{arm}/{BRIDGE}"], known.get(f"/{arm}/{COMPENSATOR}", {})) for arm in self.names}

    # For a trial (`Device` of exo_gravity.panel.recordings); called on the web server's thread

    def parameters(self) -> dict[str, dict[str, Any]]:
        """Return the parameters of every node that runs, by full name."""
        of_nodes = sorted(self._parameters.copy().items())
        return {name: dict(parameters.values) for name, parameters in of_nodes if parameters.is_present}

    def states(self) -> dict[str, str | None]:
        """Return the state that each bridge reports; None if it is silent."""
        return {name: client.report().get("state") for name, client in self.clients.items()}

    async def perform(self, script: str) -> str:
        """Let the virtual wearers perform the script at this path, '' for none; return '' or why not."""
        problems = []
        for name, client in sorted(self._wearers.items()):
            problem = await call(client, parameter_request({"trial": script}))
            problems += [f"{name}: {problem}"] if problem else []
        return "; ".join(problems)

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
        holder = self.clients[arm].report().get(HELD_BY, NOBODY)
        return "" if holder in (NOBODY, self._lessee + page) else holder

    async def ask(self, kind: str, arm: str, values: Mapping[str, Any]) -> str:
        """Do what a page asks of one arm. The request is sent even where the service seems to be absent."""
        if kind == "bring_home":
            simulator = self._wearers.get(f"/{arm}/{SIMULATOR}")
            script = {"trial": str(packaged("home.yaml"))}
            return await call(simulator, parameter_request(script)) if simulator else "the arm is not simulated"
        request = parameter_request(values) if kind == "set" else ASKED[kind][-1]
        return await call(self.clients[arm].services[kind], request)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            arm, _, leaf = status.name.strip("/").rpartition("/")
            if arm in self.clients and leaf in SHOWN:
                self.clients[arm].newest[SHOWN[leaf]] = Newest(status_values(status), time.monotonic())

    def _on_parameter_event(self, event: ParameterEvent) -> None:
        if event.node in self._parameters:
            self._parameters[event.node].refresh()


def parameter_client(node: Node, name: str) -> Client:
    """Return a client that sets parameters of the node `name` together."""
    return node.create_client(SetParametersAtomically, f"{name}/set_parameters_atomically")


def parameter_request(values: Mapping[str, Any]) -> SetParametersAtomically.Request:
    """Return the request that sets `values` together."""
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return SetParametersAtomically.Request(parameters=messages)


async def call(client: Client, request: Any) -> str:
    """Send `request` at once; return '' if it was carried out, else why not."""
    sent = client.call_async(request)
    deadline = time.monotonic() + (CALL_TIMEOUT if client.service_is_ready() else ABSENT_TIMEOUT)
    while not sent.done():
        if time.monotonic() > deadline:
            client.remove_pending_request(sent)
            return f"{client.srv_name} does not answer"
        await asyncio.sleep(LOOK_PERIOD)
    response: Any = sent.result()
    result = getattr(response, "result", response)
    if getattr(result, "successful", getattr(result, "success", False)):
        return ""
    return getattr(result, "reason", getattr(result, "message", "")) or "refused without a reason"


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
        self._tilt = Newest()
        self._tilts = HotPath(self, Vector3Stamped, TILT, self._on_tilt)
        scripts = Path(values["trials"]) if values["trials"] else packaged("trials")
        if values["trials"] and not os.path.isdir(values["trials"]):
            raise ParameterError("trials", values["trials"], "a folder")
        self._recordings = Recordings(values["output"], scripts, self._arms, self._note, time.monotonic)
        own = {name: values[name] for name in ("language", "dead_man")}
        self._own_setup = {**own, "trials": list(self._recordings.trials)}
        self._shown: Any = None  # the nodes' parameters that the pages have
        self._changes = LoadChanges()
        control = Control(self._arms, self._recordings, self._note, time.monotonic)
        try:
            from exo_gravity.panel.server import PanelServer
        except ModuleNotFoundError as error:
            missing = f"the Python package {error.name} is not installed: pip install 'exo_gravity[panel]'"
            raise ExoGravityError(missing) from None
        self._server = PanelServer(values["host"], values["port"], values["token"], control)
        self.create_timer(STATE_PERIOD, self._send_state)
        self.create_timer(DISCOVERY_PERIOD, self._arms.discover)
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
            log.warning("anyone on the network path can read the token: put TLS before it (docs/panel.md)")

    def _note(self, text: str) -> None:
        """Write `text` to the log, and to /diagnostics, which recordings hold."""
        self._noted += 1
        self._diagnostics.report(OK, f"action {self._noted}: {text}")

    def _send_state(self) -> None:
        if not self._server.is_running:
            self.failure = RuntimeError("the web server has ended")
        self._tilts.poll()
        nodes = self._arms.nodes()
        if nodes != self._shown:
            self._shown = nodes
            self._server.setup = {**self._own_setup, **setup_of(nodes)}
        tilt = self._tilt.within(SILENT)
        arms = self._changes.with_causes(self._arms.state(), nodes, time.monotonic())
        self._server.state = {"arms": arms, "tilt": tilt, **self._recordings.state()}

    def _on_tilt(self, message: Vector3Stamped, _info: dict[str, Any]) -> None:
        pitch, roll = message.vector.y, message.vector.x
        self._tilt = Newest({"pitch": pitch, "roll": roll} if math.isfinite(pitch + roll) else None, time.monotonic())


def main() -> None:
    """Entry point of the executable `panel`."""
    raise SystemExit(run(Panel, priority=5))  # a press on its page must reach the arm
