"""The arms as a ROS client sees them: topics, diagnostics, services and parameters of `can_bridge` and `compensator`.

Joint states arrive hundreds of times a second and the page shows ten. Their subscriptions keep the newest message
outside the executor (`hot_path`), and `ArmClient.poll` takes it. Services are called on the web server's thread; the
executor's thread receives the answers.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from exo_gravity.nodes.ros.hot_path import NEWEST, HotPath
from exo_gravity.panel.view import SILENT, Joints, Status, arm_state

CALL_TIMEOUT = 3.0  # s, longer than can_bridge itself waits
BRIDGE = "can_bridge"


class ArmClient:
    """One arm, in the namespace `/name`."""

    def __init__(self, node: Node, name: str) -> None:
        self.joints, self.commands = Joints(), Joints()
        self.bridge, self.compensator = Status(), Status()
        space = f"/{name}"
        self._states = HotPath(node, JointState, f"{space}/joint_states", self._on_states, NEWEST)
        self._efforts = HotPath(node, JointState, f"{space}/effort_commands", self._on_efforts, NEWEST)
        self.enable = node.create_client(SetBool, f"{space}/{BRIDGE}/enable")
        self.clear_fault = node.create_client(Trigger, f"{space}/{BRIDGE}/clear_fault")
        self.set = node.create_client(SetParametersAtomically, f"{space}/compensator/set_parameters_atomically")

    def poll(self) -> None:
        """Take the newest messages."""
        self._states.poll()
        self._efforts.poll()

    def state(self, now: float) -> dict[str, Any]:
        """Return what the page shows."""
        return arm_state(now, self.joints, self.commands, self.bridge, self.compensator)

    def _on_states(self, message: JointState, _info: dict[str, Any]) -> None:
        values = (message.name, message.position, message.velocity, message.effort)
        self.joints = Joints(time.monotonic(), *map(list, values))

    def _on_efforts(self, message: JointState, _info: dict[str, Any]) -> None:
        self.commands = Joints(time.monotonic(), list(message.name), effort=list(message.effort))


class ArmClients:
    """All arms, by name: 'right', 'left', or the namespace that a parameter file gives them.

    `Arms` of `exo_gravity.panel.desk`. An arm stays in the list when its nodes end: it shows that they do not answer.
    """

    def __init__(self, node: Node) -> None:
        self.clients: dict[str, ArmClient] = {}
        self._node = node
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    @property
    def names(self) -> Collection[str]:
        """The arms that are or were present."""
        return tuple(self.clients)

    def discover(self, nodes: Collection[str]) -> None:
        """Add the arms among the full node names."""
        for full_name in nodes:
            arm, _, leaf = full_name.strip("/").rpartition("/")
            if leaf == BRIDGE and arm and arm not in self.clients:
                self.clients[arm] = ArmClient(self._node, arm)

    def state(self) -> dict[str, Any]:
        """Return what the page shows of each arm."""
        now = time.monotonic()
        for client in self.clients.values():
            client.poll()
        return {name: client.state(now) for name, client in sorted(self.clients.items(), reverse=True)}

    def bridge_states(self) -> dict[str, str | None]:
        """Return the state that each bridge reports; None if it is silent."""
        now = time.monotonic()
        of_arms = {name: client.bridge for name, client in self.clients.items()}
        return {name: s.values.get("state") if now - s.time < SILENT else None for name, s in of_arms.items()}

    async def let_down(self, arm: str) -> str:
        """Let one arm down. The request is sent even where the service seems to be absent."""
        return await call(self.clients[arm].enable, SetBool.Request(data=False))

    async def enable(self, arm: str) -> str:
        """Enable one arm."""
        return await call(self.clients[arm].enable, SetBool.Request(data=True))

    async def clear_fault(self, arm: str) -> str:
        """Clear the latched fault of one arm."""
        return await call(self.clients[arm].clear_fault, Trigger.Request())

    async def set(self, arm: str, values: Mapping[str, Any]) -> str:
        """Set parameters of the arm's compensator together."""
        return await call(self.clients[arm].set, parameter_request(values))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            arm, _, leaf = status.name.strip("/").rpartition("/")
            if arm in self.clients and leaf in (BRIDGE, "compensator"):
                values = {pair.key: pair.value for pair in status.values}
                level = int.from_bytes(status.level, "big")
                newest = Status(level, status.message, values, time.monotonic())
                setattr(self.clients[arm], "bridge" if leaf == BRIDGE else leaf, newest)


def parameter_request(values: Mapping[str, Any]) -> SetParametersAtomically.Request:
    """Return the request that sets `values` together."""
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return SetParametersAtomically.Request(parameters=messages)


async def call(client: Client, request: Any) -> str:
    """Send `request` at once; return '' if it was carried out, else why not."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[Any] = loop.create_future()

    def answer(future: Future) -> None:
        loop.call_soon_threadsafe(lambda: None if done.done() else done.set_result(future.result()))

    sent = client.call_async(request)
    sent.add_done_callback(answer)
    try:
        is_there = client.service_is_ready()
        response = await asyncio.wait_for(done, CALL_TIMEOUT if is_there else 0.5)
    except asyncio.TimeoutError:
        client.remove_pending_request(sent)
        return f"{client.srv_name} does not answer"
    result = getattr(response, "result", response)
    if getattr(result, "successful", getattr(result, "success", False)):
        return ""
    return getattr(result, "reason", getattr(result, "message", "")) or "refused without a reason"
