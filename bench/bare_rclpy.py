# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A peer for the loop: the same messages between two bare rclpy nodes, on the same bus, with the same pacing.

    python -m bench.bare_rclpy bridge|compensator PARAMS NAMESPACE RATE

`bridge` commands the motors and publishes joint states, `compensator` replies with efforts. There is no safety machine,
and there are no parameters, diagnostics or ramps. Each ends on SIGTERM.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from exo_gravity.core.motors.joint_motor import REPLY_SHARE, UNKNOWN
from exo_gravity.core.safety.drive import Drive
from exo_gravity.hardware.clock import favour
from exo_gravity.hardware.network import keep_to_this_machine

from .direct_arm import DirectArm, Starting, run_paced

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def bridge_thread(node: Node, arm: DirectArm, period: float, stopping: list[bool]) -> threading.Thread:
    """Return the thread that commands the motors and publishes what they reply."""
    bus, newest = arm.open(), {"effort": arm.no_torque}
    starting = Starting(bus.replies)

    def on_effort_commands(message: JointState) -> None:
        newest["effort"] = tuple(message.effort)

    publisher = node.create_publisher(JointState, "joint_states", 1)
    node.create_subscription(JointState, "effort_commands", on_effort_commands, 1)

    def cycle() -> None:
        all_replied = UNKNOWN not in bus.samples
        drive = Drive(newest["effort"], arm.no_torque, starting.send, all_replied)
        starting.note(bus.exchange(drive, time.monotonic() + REPLY_SHARE * period))
        if all_replied:
            position, velocity, effort, *_ = zip(*bus.samples, strict=True)
            message = JointState(name=arm.joint_names, position=position, velocity=velocity, effort=effort)
            message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)

    def run() -> None:
        try:
            run_paced(period, cycle, stopping)
        finally:
            bus.stop()

    return threading.Thread(target=run)


def compensate(node: Node, arm: DirectArm) -> None:
    """Reply to each joint state with efforts."""
    publisher = node.create_publisher(JointState, "effort_commands", 1)

    def on_joint_states(message: JointState) -> None:
        command = JointState(name=arm.joint_names, effort=arm.law(message.position))
        command.header.stamp = message.header.stamp
        publisher.publish(command)

    node.create_subscription(JointState, "joint_states", on_joint_states, NEWEST)


def main() -> None:
    """Run one of the two nodes."""
    part, params, namespace, rate = sys.argv[1:]
    keep_to_this_machine()
    stopping: list[bool] = []
    signal.signal(signal.SIGTERM, lambda *_: stopping.append(True))
    favour(20 if part == "bridge" else 15)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"bare_{part}", namespace=namespace)
    arm = DirectArm(params, namespace)
    thread = None
    if part == "bridge":
        thread = bridge_thread(node, arm, 1.0 / float(rate), stopping)
        thread.start()
    else:
        compensate(node, arm)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stopping:
        executor.spin_once(timeout_sec=0.1)
    if thread:
        thread.join()
    os._exit(0)  # without closing Fast DDS, which can hang


if __name__ == "__main__":
    main()
