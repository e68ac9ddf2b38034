# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A ROS node in the test's process that records what the nodes under test publish, and calls their services."""

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from exo_gravity.hardware.network import restrict_to_localhost

from . import CONFIG
from .keys import broken, documented
from .node_thread import NodeThread
from .waiting import wait_until

restrict_to_localhost()

HOME = [0.0, 0.05, 0.05, 0.05]  # rad, hanging and within the limits
HELP_TIME = 20.0  # s for which config/home.yaml holds the arm: a joint with little friction swings out of its limits


class RosProbe:
    """Listens to the arm in the namespace `arm`, on its own thread. It takes no status that breaks docs/keys.md.

    joint_states, effort_commands, wearer_steps: the messages so far. states: those that can_bridge reported so far.
    statuses: the newest DiagnosticStatus by node.
    """

    def __init__(self, arm: str = "/right") -> None:
        self.arm = arm
        self.home_script: Path = CONFIG / "home.yaml"  # that of the paper's arm
        self._thread = NodeThread("ros_probe")
        self.context, self.executor, (self.node,) = self._thread.context, self._thread.executor, self._thread.nodes
        self.close = self._thread.close
        self.joint_states: list[JointState] = []
        self.effort_commands: list[JointState] = []
        self.wearer_steps: list[String] = []
        self.statuses: dict[str, DiagnosticStatus] = {}
        self.states: list[str | None] = []
        self._broken: list[str] = []  # of docs/keys.md, by statuses of our nodes
        self.node.create_subscription(JointState, f"{arm}/joint_states", self.joint_states.append, 1000)
        self.node.create_subscription(JointState, f"{arm}/effort_commands", self.effort_commands.append, 1000)
        self.node.create_subscription(String, f"{arm}/wearer_step", self.wearer_steps.append, 10)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._clients: dict[str, Any] = {}
        self._deadline = float("inf")
        self._thread.start()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.statuses[f"/{status.name}"] = status
            if status.name.rpartition("/")[2] in documented():  # a test may add a node of its own
                self._broken += broken(status.name, {pair.key: pair.value for pair in status.values})
            if f"/{status.name}" == f"{self.arm}/can_bridge":
                self.states.append(self.state)

    def status_contains(self, node: str, text: str) -> bool:
        """Return whether the newest status message of the arm's `node` contains `text`."""
        status = self.statuses.get(f"{self.arm}/{node}")
        return status is not None and text in status.message

    def diagnostic(self, node: str, key: str) -> str | None:
        """Return the newest value of `key` in the diagnostics of the arm's `node`, None if there is none."""
        status = self.statuses.get(f"{self.arm}/{node}")
        return next((pair.value for pair in status.values if pair.key == key), None) if status else None

    def wait_for_report(self) -> None:
        """Wait for the next diagnostics of the bridge."""
        last = self.statuses.get(f"{self.arm}/can_bridge")
        self.wait_until(lambda: self.statuses.get(f"{self.arm}/can_bridge") is not last)

    @property
    def state(self) -> str | None:
        return self.diagnostic("can_bridge", "state")

    @property
    def fault(self) -> str | None:
        """The code of the latched fault that can_bridge reports, or 'none'."""
        return self.diagnostic("can_bridge", "fault")

    def wait_until(self, condition: Callable[[], Any], timeout: float = 60.0) -> None:
        """Wait until `condition()` holds; fail after `timeout` s, or earlier within a `time_limit`."""
        limit = min(timeout, self._deadline - time.monotonic())
        said = lambda: {name: status.message for name, status in self.statuses.items()}  # noqa: E731
        wait_until(condition, timeout=limit, seen=said)
        assert not self._broken, self._broken[:10]

    @contextmanager
    def time_limit(self, seconds: float) -> Iterator[None]:
        """Limit all waiting in the `with` block to `seconds` s together."""
        self._deadline = time.monotonic() + seconds
        try:
            yield
        finally:
            self._deadline = float("inf")

    def call(self, service_type: Any, name: str, request: Any) -> Any:
        client = self._clients.get(name) or self._clients.setdefault(name, self.node.create_client(service_type, name))
        self.wait_until(client.service_is_ready)
        future = client.call_async(request)
        self.wait_until(future.done)
        return future.result()

    def trigger(self, name: str) -> Trigger.Response:
        """Call one of can_bridge's Trigger services."""
        return self.call(Trigger, f"{self.arm}/can_bridge/{name}", Trigger.Request())

    def enable(self, on: bool) -> SetBool.Response:
        """Call can_bridge's service `enable`."""
        return self.call(SetBool, f"{self.arm}/can_bridge/enable", SetBool.Request(data=on))

    def set_parameters(self, node: str, **values: Any) -> SetParametersResult:
        """Set all these parameters or none; `__` in a name stands for a dot."""
        parameters = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=[each.to_parameter_msg() for each in parameters])
        return self.call(SetParametersAtomically, f"{self.arm}/{node}/set_parameters_atomically", request).result

    def joint_angles(self) -> list[float]:
        return list(self.joint_states[-1].position)

    def wearer_is_at(self, action: str) -> bool:
        """Return whether the virtual wearer's newest step is a 'move', 'hold' or 'push', or the end, 'done'."""
        return bool(self.wearer_steps) and json.loads(self.wearer_steps[-1].data)["action"] == action

    def get_carried(self) -> None:
        """Wait until the arm is carried; the wearer moves one that hangs outside its limits or away from home."""
        helped = -math.inf
        while self.state != "active":
            is_outside = self.diagnostic("can_bridge", "joints outside limits") not in (None, "none")
            misplaced = self.fault == "implausible_zero" or is_outside
            if misplaced and time.monotonic() > helped + HELP_TIME:
                helped = time.monotonic()
                self.set_parameters("simulator", trial=str(self.home_script))
            if self.state == "fault":
                self.trigger("clear_fault")
            elif self.state == "disabled":
                self.enable(True)
            self.wait_for_report()

    def bring_to(self, script: object) -> None:
        """Let the virtual wearer move the carried arm by the trial script at the path `script`, and release it."""
        self.get_carried()
        self.wearer_steps.clear()
        assert self.set_parameters("simulator", trial="").successful
        assert self.set_parameters("simulator", trial=str(script)).successful
        self.wait_until(lambda: self.wearer_is_at("hold"))
