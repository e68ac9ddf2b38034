# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages from a thread: joint states of an arm at rest, for nodes without a bridge."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Sequence

from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel

PARTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")
NAMES = tuple(f"right_{part}" for part in PARTS)
POSE = (0.2, 0.9, 0.7, 0.6)  # rad
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
PERIOD = 0.005  # s


class StillArm:
    """Publishes the joint states of a still right arm, from a thread, until `close`; their stamps count them in ns.

    effort: of its motors, (n,) Nm. velocity: (n,) rad/s. sinking: rad in each period, of the second joint.
    """

    def __init__(
        self,
        node: Node,
        names: Sequence[str] = NAMES,
        pose: Sequence[float] = POSE,
    ) -> None:
        self.effort: Sequence[float] = ()
        self.velocity: Sequence[float] = (0.0,) * len(names)
        self.sinking = 0.0
        self._message = JointState(name=names, position=pose)
        self._publisher = node.create_publisher(JointState, "/right/joint_states", 1)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for number in itertools.count(1):
            if self._stopping.wait(PERIOD):
                return
            self._message.header.stamp = Time(nanoseconds=number).to_msg()
            self._message.effort, self._message.velocity = self.effort, self.velocity
            self._message.position[1] -= self.sinking
            self._publisher.publish(self._message)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
