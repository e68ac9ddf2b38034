# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Peers for the loop: the same law on the same bus, with the same pacing, without safety machine, ramps or diagnostics.

    python -m bench.peers python|bridge|compensator PARAMS NAMESPACE RATE

`python` is one process without ROS. `bridge` and `compensator` are two bare rclpy nodes with the messages of ours. Each
ends on SIGTERM.
"""

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.motors.joint_motor import REPLY_SHARE, UNKNOWN
from exo_gravity.core.numbers import Torque
from exo_gravity.core.safety.command import Command, Send
from exo_gravity.core.safety.start import SwitchingOn
from exo_gravity.hardware.can_port import ArmOnBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK, raise_priority
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import can_options, load

REPLIES = 2  # to a frame that switches a motor on; the first one may be late, and answer the frame before
Joints = tuple[Sequence[float], ...]  # position, velocity and effort of the joints (n,)


class DirectArm:
    """The arm in `namespace` (e.g. /right) of a parameter file without its nodes: motors, bus, law of an upright trunk.

    joint_names: from base to hand. motors: in the same order. channel, options: of the CAN bus.
    """

    def __init__(self, params: str | Path, namespace: str) -> None:
        nodes = load(params)
        arm = read_arm(nodes, namespace)
        self.joint_names, self.motors = arm.limits.joint_names, arm.motors
        self.channel, self.options = str(arm.can_bridge["can.channel"]), can_options(nodes[f"{namespace}/can_bridge"])
        address = str(arm.can_bridge["can.interface"]), self.channel, self.options
        self._on_bus = ArmOnBus(address, arm.motors, arm.limits, 1.0 / arm.can_bridge["rate"])
        self._law, self._tilt = arm.settings.chosen, Tilt.of(arm.settings.side)

    def law(self, theta: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm for joint angles (n,) in rad."""
        return self._law.torque(theta, self._tilt)

    def run(
        self, period: float, efforts: Callable[[], Sequence[float]], told: Callable[[Joints], None], stopping: list[int]
    ) -> None:
        """Command the motors every `period` s, paced like the control thread of `can_bridge`, until `stopping`.

        efforts: those to command, (n,) Nm. told: called with what the motors of a cycle have replied, if all have.
        Each step that switches the motors on is repeated until all have replied; at first they are polled.
        """
        gc.collect()
        gc.freeze()
        bus = MotorBus(self._on_bus.ports(COMPUTER_CLOCK), self.motors)
        switching, replies, nothing = SwitchingOn(bus.replies), 0, (0.0,) * len(self.motors)
        send: Sequence[Send] = (Send.POLL,) * len(nothing)
        deadline = time.monotonic()
        while not stopping:
            is_known = UNKNOWN not in bus.samples
            command = Command(tuple(efforts()) if is_known else nothing, nothing, tuple(send), is_known)
            replies += bus.exchange(command, time.monotonic() + REPLY_SHARE * period)
            if replies == REPLIES and not switching.done:
                send, replies = switching.step(), 0
            if UNKNOWN not in bus.samples:
                told(tuple(zip(*bus.samples, strict=True))[:3])
            deadline += period
            remaining = deadline - time.monotonic()
            if remaining > 0.0:
                time.sleep(remaining)
            elif remaining < -period:
                deadline = time.monotonic()
        bus.stop()


def run_node(part: str, arm: DirectArm, namespace: str, period: float, stopping: list[int]) -> None:
    """Run `bridge`, which publishes joint states and takes efforts, or `compensator`, which answers them."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import JointState

    from exo_gravity.hardware.network import restrict_to_localhost

    restrict_to_localhost()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node, newest = rclpy.create_node(f"bare_{part}", namespace=namespace), [[0.0] * len(arm.motors)]
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    if part == "compensator":
        publisher = node.create_publisher(JointState, "effort_commands", 1)

        def answer(message: JointState) -> None:
            command = JointState(name=arm.joint_names, effort=arm.law(message.position))
            command.header.stamp = message.header.stamp
            publisher.publish(command)

        node.create_subscription(
            JointState, "joint_states", answer, QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
    else:
        publisher = node.create_publisher(JointState, "joint_states", 1)

        def publish(joints: Joints) -> None:
            position, velocity, effort = joints
            message = JointState(name=arm.joint_names, position=position, velocity=velocity, effort=effort)
            message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)

        node.create_subscription(
            JointState, "effort_commands", lambda message: newest.__setitem__(0, message.effort.tolist()), 1
        )
        thread = threading.Thread(target=arm.run, args=(period, lambda: newest[0], publish, stopping))
        thread.start()
    while not stopping:
        executor.spin_once(0.1)
    if part == "bridge":
        thread.join()
    os._exit(0)  # without closing Fast DDS, which can hang


def main() -> None:
    """Run one of the peers."""
    part, params, namespace, rate = sys.argv[1:]
    stopping: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: stopping.append(True))
    raise_priority(15 if part == "compensator" else 20)
    arm, period = DirectArm(params, namespace), 1.0 / float(rate)
    if part != "python":
        run_node(part, arm, namespace, period, stopping)
    newest: list[Joints] = []
    arm.run(period, lambda: arm.law(newest[0][0]), lambda joints: newest.__setitem__(slice(None), [joints]), stopping)


if __name__ == "__main__":
    main()
