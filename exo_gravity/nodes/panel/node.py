"""panel: a web page on the machine that carries the arms: see them, set the support, let them down.

It is a ROS client like any other: it uses the topics, services and parameters that `ros2` can use, and nothing depends
on it. The web server (exo_gravity/panel/server.py) runs on a separate thread; this node's executor collects the state
of the arms and sends it to the pages ten times a second.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.nodes.panel.arms import ArmClients, call, parameter_request
from exo_gravity.nodes.ros.hot_path import NEWEST, HotPath
from exo_gravity.nodes.ros.messages import OK
from exo_gravity.nodes.ros.parameters import NodeParameters, declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.panel.access import Access, is_loopback
from exo_gravity.panel.control import Control
from exo_gravity.panel.desk import Desk
from exo_gravity.panel.facts import Facts
from exo_gravity.panel.params import PANEL, scripts_folder
from exo_gravity.panel.studio import Studio
from exo_gravity.panel.view import SILENT

STATE_PERIOD = 0.1  # s between two states that the pages get
DISCOVERY_PERIOD = 0.5  # s between two searches for nodes
TILT = "/imu/pitch_yaw"


class Panel(Node):
    """Collects the state of the arms for the pages, and passes on what they ask for."""

    def __init__(self) -> None:
        super().__init__("panel", automatically_declare_parameters_from_overrides=True)
        # The token is not kept as a parameter, which any node could read and a recording would hold.
        values = declare(self, [replace(param, fixed=param.name != "token") for param in PANEL])
        self.undeclare_parameter("token")
        self.failure: Exception | None = None  # ends the node, see run()
        self._notes = self.create_publisher(DiagnosticArray, "/diagnostics", 50)
        self._noted = 0
        self._arms = ArmClients(self)
        self._of_nodes: dict[str, NodeParameters] = {}
        self._tilt: tuple[float, Vector3Stamped] | None = None
        self._tilts = HotPath(self, Vector3Stamped, TILT, self._on_tilt, NEWEST)
        self.create_subscription(ParameterEvent, "/parameter_events", self._on_parameter_event, 50)
        self._wearers: dict[str, Client] = {}  # the virtual ones, by their simulator's name
        scripts = scripts_folder(values["trials"])
        self._studio = Studio(values["output"], scripts, self, self._note)
        own = {name: values[name] for name in ("language", "dead_man")}
        self._facts = Facts({**own, "trials": list(self._studio.trials)})
        access = Access(values["host"], values["token"], time.monotonic)
        control = Control(time.monotonic, values["dead_man"])
        desk = Desk(self._arms, self._studio, control, self._note, time.monotonic)
        try:
            from exo_gravity.panel.server import PanelServer
        except ModuleNotFoundError as error:
            missing = f"the Python package {error.name} is not installed: pip install 'exo_gravity[panel]'"
            raise ExoGravityError(missing) from None
        self._server = PanelServer(values["host"], values["port"], access, desk, self._studio.report, self.parameters)
        self._server.start()
        self.create_timer(STATE_PERIOD, self._send_state)
        self.create_timer(DISCOVERY_PERIOD, self._discover)
        self._log_address(values["host"], values["port"], access)

    def close(self) -> None:
        """End the recording and the server. The arms are left as they are."""
        self._studio.close()
        self._facts.close()
        self._server.stop()

    def _log_address(self, host: str, port: int, access: Access) -> None:
        shown = f"[{host}]" if ":" in host else host
        log = self.get_logger()
        if access.is_open:
            log.info(f"the panel is at http://{shown}:{port}/, on this machine only")
            return
        log.info(f"the panel is at http://{shown}:{port}/?token={access.token}")
        if not is_loopback(host):
            log.warning("anyone on the network path can read the token: put TLS before it (docs/panel.md)")

    def _note(self, text: str) -> None:
        """Write `text` to the log, and to /diagnostics, which recordings hold."""
        self._noted += 1
        self.get_logger().info(text)
        status = DiagnosticStatus(level=OK, name="panel", message=f"action {self._noted}: {text}")
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._notes.publish(array)

    def _send_state(self) -> None:
        if not self._server.is_running:
            self.failure = RuntimeError("the web server has ended")
        self._tilts.poll()
        news = self._facts.news()
        if news is not None:
            self._server.publish_setup(news)
        state = {"arms": self._arms.state(), "tilt": self._tilt_state(), **self._studio.state()}
        self._server.publish(state)

    def _tilt_state(self) -> dict[str, float] | None:
        if self._tilt is None or time.monotonic() - self._tilt[0] > SILENT:
            return None
        vector = self._tilt[1].vector
        return {"pitch": vector.y, "roll": vector.x} if math.isfinite(vector.x + vector.y) else None

    def _on_tilt(self, message: Vector3Stamped, _info: dict[str, Any]) -> None:
        self._tilt = time.monotonic(), message

    def _discover(self) -> None:
        found = self.get_node_names_and_namespaces()
        nodes = {f"{space.rstrip('/')}/{name}" for name, space in found if not name.startswith("_")}
        nodes.discard(self.get_fully_qualified_name())
        self._arms.discover(nodes)
        for name in nodes - set(self._of_nodes):
            self._of_nodes[name] = NodeParameters(self, name, self._on_change(name))
            if name.endswith("/simulator") and name not in self._wearers:
                service = f"{name}/set_parameters_atomically"
                self._wearers[name] = self.create_client(SetParametersAtomically, service)
        for name in set(self._of_nodes) - nodes:
            self._of_nodes.pop(name).destroy()
        for parameters in self._of_nodes.values():
            parameters.update()
        self._facts.discover(self._arms.names)

    def _on_change(self, node: str) -> Callable[[], None]:
        def changed() -> None:
            if node in self._of_nodes:
                self._facts.note(node, self._of_nodes[node].values)

        return changed

    def _on_parameter_event(self, event: ParameterEvent) -> None:
        if event.node in self._of_nodes:
            self._of_nodes[event.node].refresh()

    # What a trial needs (`Device` of exo_gravity.panel.studio); called on the web server's thread

    def parameters(self) -> dict[str, dict[str, Any]]:
        """Return the parameters of every node by full name."""
        of_nodes = sorted(self._of_nodes.copy().items())
        return {name: dict(parameters.values) for name, parameters in of_nodes if parameters.is_present}

    def states(self) -> dict[str, str | None]:
        """Return the state of each arm; None if its bridge is silent."""
        return self._arms.bridge_states()

    async def perform(self, script: str) -> str:
        """Let the virtual wearers perform the script at this path; return '' or why not."""
        problems = []
        for name, client in sorted(self._wearers.items()):
            for path in ("", script):  # a script that is set already would not start again
                problem = await call(client, parameter_request({"trial": path}))
            problems += [f"{name}: {problem}"] if problem else []
        return "; ".join(problems)


def main() -> None:
    """Entry point of the executable `panel`."""
    raise SystemExit(run(Panel))
