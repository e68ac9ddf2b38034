# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint states out, effort commands in: which effort command answers which joint state, and how old that state is.

Efforts carry the stamp of the joint state that they answer. The exchange remembers when, on the monotonic clock, each
stamped state was measured: so the age of an answer does not depend on the wall clock, and an unknown stamp is refused.
While the load changes, the compensator asks for the motors' damping by velocities of 0. Others are refused.

A compensator in this process is called with each joint state. Its efforts are published too, and noticed there without
being taken a second time: what is not next in their numbers comes from another commander.
"""

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.command import CARRYING, NO_EFFORTS, Efforts, FaultCode
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.vocabulary import NO_REASON, RefusedEfforts, Status
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.nodes.ros.messages import LATE_TILT, by_name, to_nanoseconds
from exo_gravity.nodes.ros.subscriptions import SHORT_QUEUE, PolledSubscription, Publishers

REMEMBERED = 256  # stamps of joint states: more than command_timeout covers on a real bus
Answer = Callable[[JointState], JointState | None]  # efforts for a joint state, of a compensator in this process


class EffortExchange:
    """The topics `joint_states` and `effort_commands` of `node`, the controller of the loop.

    get_loop returns the present control loop, None while the node is inactive. refusal: why the last message that was
    refused was. answer: of a compensator in this process. poll: called at the end of each cycle with replies.
    """

    def __init__(
        self,
        node: Node,
        limits: Limits,
        get_loop: Callable[[], ControlLoop | None],
        answer: Answer | None = None,
        poll: Callable[[], object] = lambda: None,
    ) -> None:
        self.refusal = NO_REASON
        self._answer, self._poll = answer, poll
        self._limits = limits
        self._get_loop = get_loop
        self._clock = node.get_clock()
        self.newest = NO_EFFORTS  #: from the compensator
        self._measured = -math.inf  # monotonic s, when the last published joint state was measured
        self._published: OrderedDict[int, float] = OrderedDict()
        self._commander = Publishers()
        self._publisher = node.create_publisher(JointState, "joint_states", 1)
        self._joint_states = JointState(name=list(limits.joint_names))  # one message, reused
        # Not reliable: an old effort sent again is useless, and acknowledging each one wakes a thread in both nodes
        # (measured: 2 % of a core).
        self._efforts = PolledSubscription(
            node, JointState, "effort_commands", self._on_efforts, SHORT_QUEUE, raw=answer is not None
        )

    def efforts(self, latest: float) -> Efforts:
        """Return the newest efforts; wait until `latest` (monotonic s) for the answer to the last joint state."""
        self._efforts.poll()
        if self._answer is None and self.newest.answered < self._measured:
            self._efforts.poll(latest - time.monotonic())
        return self.newest

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Publish a joint state if every motor has replied recently: an unknown angle is never sent as a number."""
        if any(self._limits.is_silent(now, sample) for sample in samples):
            return
        position, velocity, effort, *_ = zip(*samples, strict=True)
        # A compensator in this process keeps the message.
        message = JointState(name=self._joint_states.name) if self._answer else self._joint_states
        message.position, message.velocity, message.effort = position, velocity, effort
        message.header.stamp = self._clock.now().to_msg()
        self._measured = min(sample.time for sample in samples)
        # Of states with one stamp, by a clock that stands still, efforts answer the first: they grow old.
        self._published.setdefault(to_nanoseconds(message.header.stamp), self._measured)
        if len(self._published) > REMEMBERED:
            self._published.popitem(last=False)
        self._publisher.publish(message)
        if self._answer and (loop := self._get_loop()) and (efforts := self._answer(message)):
            self._receive(loop, efforts)
        self._poll()

    def _on_efforts(self, message: JointState | bytes, info: dict[str, Any]) -> None:
        loop = self._get_loop()
        if loop is None:
            return
        if self._commander.note(info):
            self.refusal = Status(RefusedEfforts.SECOND_PUBLISHER, "a second publisher of effort_commands")
            self.newest = Efforts(None, time.monotonic(), False, False)  # fails the start gate
            if loop.safety.state in CARRYING:
                loop.trip(FaultCode.SECOND_COMMANDER, "more than one publisher of effort_commands")
        elif not isinstance(message, bytes):
            self._receive(loop, message)

    def _receive(self, loop: ControlLoop, message: JointState) -> None:
        answered = self._published.get(to_nanoseconds(message.header.stamp))
        if answered is None:
            unknown = f"stamp {to_nanoseconds(message.header.stamp)} ns answers no joint state of this bridge"
            self.refusal = Status(RefusedEfforts.UNKNOWN_STAMP, unknown)
        else:
            try:
                effort = by_name(message, "effort", self._limits.joint_names) if message.effort else None
                if any(message.velocity):
                    raise ParameterError("velocity", list(message.velocity), "empty, or zeros to ask for damping")
            except ParameterError as error:
                effort, self.refusal = None, Status(RefusedEfforts.INVALID, str(error))
                loop.trip(FaultCode.COMMAND_IMPOSSIBLE, f"effort_commands: {error.name} must be {error.expected}")
            is_late = message.header.frame_id == LATE_TILT
            self.newest = Efforts(effort, answered, bool(message.velocity), is_late)
