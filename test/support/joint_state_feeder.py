# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages from a thread: joint states of an arm at rest, for a compensator without a bridge."""

from __future__ import annotations

import itertools
import threading

from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState

PARTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")
POSE = (0.2, 0.9, 0.7, 0.6)  # rad
PERIOD = 0.02  # s


class Feeder:
    """Calls `send` with a number that counts from 1, every `period` s, from a thread, until `close`."""

    def __init__(self, period: float) -> None:
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(period,))
        self._thread.start()

    def _run(self, period: float) -> None:
        for number in itertools.count(1):
            if self._stopping.wait(period):
                return
            self.send(number)

    def send(self, number: int) -> None:
        """Publish what a subclass feeds."""
        raise NotImplementedError

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()


class JointStateFeeder(Feeder):
    """Publishes the joint states of one arm; their stamps count them in ns."""

    def __init__(self, node: Node, side: str) -> None:
        self._message = JointState(name=[f"{side}_{part}" for part in PARTS], position=POSE)
        self._publisher = node.create_publisher(JointState, f"/{side}/joint_states", 1)
        super().__init__(PERIOD)

    def send(self, number: int) -> None:
        self._message.header.stamp = Time(nanoseconds=number).to_msg()
        self._publisher.publish(self._message)
