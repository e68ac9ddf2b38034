# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Processes that act on the right arm until their parent has ended: python -m test.faults.players PLAYER.

outer_loop  publishes EFFORTS on /right/assist_efforts; signals make it go wrong. GO_WRONG: NaN from now on. FLOOD: far
            too often. BE_SOUND: neither
successor   publishes zeros there, from the first signal on
holder      holds control of the arm as OPERATOR
"""

from __future__ import annotations

import math
import os
import signal
import sys
import time

import rclpy
from diagnostic_msgs.msg import KeyValue
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.lab.inputs.parameter_file import load

from ..support import CONFIG

TOPIC = "/right/assist_efforts"
NAMES = load(CONFIG / "sim.yaml")["/right/compensator"]["joint_names"]
EFFORTS = (0.0, 0.25, 0.0, 0.0)  # Nm, less than the friction: with it and without it the arm rests
NAN = (0.0, math.nan, 0.0, 0.0)
PERIOD, FLOOD_PERIOD = 0.01, 0.0001  # s
GO_WRONG, FLOOD, BE_SOUND = signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP
MODES: dict[int, tuple[tuple[float, ...], float]] = {
    GO_WRONG: (NAN, PERIOD),
    FLOOD: (EFFORTS, FLOOD_PERIOD),
    BE_SOUND: (EFFORTS, PERIOD),
}
OPERATOR, LEASE_PERIOD = "the operator", 0.3  # s


def assist(node: Node, parent: int, is_successor: bool) -> None:
    """Be an outer loop."""
    signals: list[int] = [] if is_successor else [BE_SOUND]
    for number in MODES:
        signal.signal(number, lambda received, _: signals.append(received))
    publisher = node.create_publisher(JointState, TOPIC, 1)
    message, share = JointState(name=NAMES), 0.0 if is_successor else 1.0
    while os.getppid() == parent:
        efforts, period = MODES[signals[-1]] if signals else (EFFORTS, PERIOD)
        message.effort = [share * effort for effort in efforts]
        message.header.stamp = node.get_clock().now().to_msg()
        if signals:
            publisher.publish(message)
        time.sleep(period)


def hold(node: Node, parent: int) -> None:
    """Hold control of the arm."""
    publisher = node.create_publisher(KeyValue, "/right/can_bridge/control", 1)
    while os.getppid() == parent:
        publisher.publish(KeyValue(key=OPERATOR, value="hold"))
        time.sleep(LEASE_PERIOD)


def main() -> None:
    """Play until the parent process has ended."""
    player, parent = sys.argv[1], os.getppid()
    keep_to_this_machine()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(player, namespace="/right")
    if player == "holder":
        hold(node, parent)
    else:
        assist(node, parent, player == "successor")


if __name__ == "__main__":
    main()
