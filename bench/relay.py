"""The floor for rclpy: the same messages between two bare nodes on executors, on the same bus, with the same pacing.

    python -m bench.relay bridge|answer PARAMS ARM RATE

No safety machine, parameters, diagnostics or ramps: `bridge` commands the motors and publishes joint states, `answer`
sends efforts back. Each ends on SIGTERM.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from bench.arm import Arm, paced
from exo_gravity.core.limits import UNKNOWN
from exo_gravity.core.safety import NOTHING, Drive
from exo_gravity.hardware.control_loop import COLLECTING
from exo_gravity.hardware.scheduling import favour
from exo_gravity.nodes.run import keep_to_this_machine

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def bridge(node, arm: Arm, period: float, stopping: list) -> threading.Thread:
    """Return the thread that commands the motors and publishes what they reply."""
    bus, asked = arm.open(), [NOTHING]
    publisher = node.create_publisher(JointState, "joint_states", 1)
    node.create_subscription(JointState, "effort_commands", lambda m: asked.__setitem__(0, tuple(m.effort)), 1)

    def cycle() -> None:
        known = UNKNOWN not in bus.samples  # switched on before that, a motor might not have heard it
        bus.exchange(Drive(asked[0], 0.0, powered=known), time.monotonic() + COLLECTING * period)
        if known:
            position, velocity, effort, *_ = zip(*bus.samples, strict=True)
            message = JointState(name=arm.names, position=position, velocity=velocity, effort=effort)
            message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)

    def run() -> None:
        try:
            paced(period, cycle, stopping)
        finally:
            bus.stop()

    return threading.Thread(target=run)


def answer(node, arm: Arm) -> None:
    """Answer each joint state."""
    publisher = node.create_publisher(JointState, "effort_commands", 1)

    def on_joint_states(message: JointState) -> None:
        command = JointState(name=arm.names, effort=arm.law(message.position))
        command.header.stamp = message.header.stamp
        publisher.publish(command)

    node.create_subscription(JointState, "joint_states", on_joint_states, NEWEST)


def main() -> None:
    """Run one of the two nodes."""
    part, params, space, rate = sys.argv[1:]
    keep_to_this_machine()
    stopping: list[bool] = []
    signal.signal(signal.SIGTERM, lambda *_: stopping.append(True))
    favour(20 if part == "bridge" else 15)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"relay_{part}", namespace=space)
    arm = Arm(params, space)
    thread = None
    if part == "bridge":
        thread = bridge(node, arm, 1.0 / float(rate), stopping)
        thread.start()
    else:
        answer(node, arm)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stopping:
        executor.spin_once(timeout_sec=0.1)
    if thread:
        thread.join()
    os._exit(0)  # without closing Fast DDS: it can hang


if __name__ == "__main__":
    main()
