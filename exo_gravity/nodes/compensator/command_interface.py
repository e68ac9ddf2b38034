"""Where the compensator's efforts go: to `can_bridge`, or to an effort controller of ros2_control.

`can_bridge` watches the age of the efforts and lets the arm down. An effort controller keeps its last command for ever,
so `MultiArrayInterface` watches the age of the joint states itself, on its own thread, and fades the torque
(core/compensation/limiter.py).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from exo_gravity.core.compensation.compensator import Answer
from exo_gravity.core.compensation.limiter import CommandFade, Output
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.tilt_input import MAX_LEAD
from exo_gravity.nodes.ros.hot_path import Repeated
from exo_gravity.nodes.ros.messages import LATE_TILT, by_name, to_nanoseconds, velocity_of

TICK = 0.01  # s between two messages of a fade
JointReading = tuple[Sequence[float], Sequence[float] | None]  # positions (n,) rad, velocities (n,) rad/s if known


class JointStateInterface:
    """Answers each joint state with `effort_commands` of the same stamp; without efforts: withdrawn.

    The frame LATE_TILT says that they are computed from a late tilt: the bridge damps the motion meanwhile.
    """

    topic = "joint_states"
    problem = ""

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self._names = names
        self._publisher = node.create_publisher(JointState, "effort_commands", 1)
        self._command = JointState(name=names)  # one message, reused
        self._still = (0.0,) * len(names)
        self.values: dict[str, object] = {}  # for /diagnostics

    def read(self, message: JointState) -> JointReading:
        """Return positions and velocities of exactly these joints. Raises ParameterError."""
        return by_name(message, "position", self._names), velocity_of(message, self._names)

    def send(self, now: float, message: JointState, answer: Answer) -> None:
        self._command.header.stamp = message.header.stamp
        self._command.effort = answer.effort or ()
        self._command.header.frame_id = LATE_TILT if answer.held else ""
        self._command.velocity = self._still if answer.damped else ()  # asks for damping about standstill
        self._publisher.publish(self._command)


class MultiArrayInterface(Repeated):
    """Sends Float64MultiArray in the order of `names`; fades to zero when there are no fresh, sound efforts.

    values: the compensator's parameters. After a fade zeros follow, so that a controller that starts late has them too,
    until the service `~/clear_fault` is called.
    """

    def __init__(self, node: Node, names: Sequence[str], values: Mapping[str, Any]) -> None:
        super().__init__("fade", self._tick, TICK)
        self.topic = values["multi_array.joint_states"]
        self._names = names
        self._clock = node.get_clock()
        self._timeout = values["multi_array.timeout"]
        self._fade = CommandFade(self._timeout)
        self._lock = threading.Lock()  # guards the fade, and the order of its messages
        self._publisher = node.create_publisher(Float64MultiArray, values["multi_array.topic"], 1)
        self._message = Float64MultiArray()
        self._is_late = False  # the last joint state, by its stamp
        self._applied: Sequence[float] = ()  # Nm, what the joints applied before the first effort
        node.create_service(Trigger, "~/clear_fault", self._clear)

    @property
    def problem(self) -> str:
        """Why no efforts are sent; '' while they are."""
        return self._fade.problem

    @property
    def values(self) -> dict[str, object]:
        """What is known of the output, for /diagnostics."""
        return {"output": self._fade.state.value, "output fault": self._fade.reason or "none"}

    def read(self, message: JointState) -> JointReading:
        """Return positions and velocities of these joints, which may be some of many.

        Raises ParameterError if one is missing, and if the message is old by its stamp: a driver that lost its hardware
        may go on publishing. Raises it, too, while nothing was sent and the message lacks the joints' efforts: the
        controller may hold a torque, from which the next one must begin.
        """
        age = (self._clock.now().nanoseconds - to_nanoseconds(message.header.stamp)) * 1e-9
        self._is_late = not -MAX_LEAD <= age <= self._timeout
        if self._is_late:
            raise ParameterError("age by its stamp", round(age, 3), f"from {-MAX_LEAD:g} to {self._timeout:g} s")
        if self._fade.state is Output.WAITING:
            self._applied = by_name(message, "effort", self._names, exact=False)
        return by_name(message, "position", self._names, exact=False), velocity_of(message, self._names, exact=False)

    def send(self, now: float, message: JointState, answer: Answer) -> None:
        """Send the answer to a joint state, or begin the fade."""
        with self._lock:
            if self._is_late:
                return  # one late message is not yet a reason to let the arm down
            if answer.effort is None:
                self._fade.withdraw(now, answer.reason)
            elif effort := self._fade.take(now, answer.effort, self._applied):
                self._publish(effort)

    def stop(self) -> None:
        """Fade to zero, and end the thread."""
        with self._lock:
            self._fade.withdraw(time.monotonic(), "the node stops")
        while self._fade.state is Output.FADING and not self.failure:
            time.sleep(TICK)
        super().stop()

    def _tick(self) -> None:
        with self._lock:
            effort = self._fade.tick(time.monotonic())
            if effort is not None:
                self._publish(effort)

    def _publish(self, effort: Sequence[float]) -> None:
        self._message.data = effort
        self._publisher.publish(self._message)

    def _clear(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            response.success = self._fade.clear()
        response.message = "cleared: the torque ramps in" if response.success else "nothing to clear, or still fading"
        return response
