# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint states of an arm at rest, for a compensator without a bridge."""

from __future__ import annotations

import threading

from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState

PARTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")
POSE = (0.2, 0.9, 0.7, 0.6)  # rad
PERIOD = 0.02  # s


class JointStateFeeder:
    """Publishes the joint states of one arm from a thread; their stamps count them in ns."""

    def __init__(self, node: Node, side: str) -> None:
        self._message = JointState(name=[f"{side}_{part}" for part in PARTS], position=POSE)
        self._publisher = node.create_publisher(JointState, f"/{side}/joint_states", 1)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        number = 0
        while not self._stopping.wait(PERIOD):
            number += 1
            self._message.header.stamp = Time(nanoseconds=number).to_msg()
            self._publisher.publish(self._message)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
