"""A user's outer loop as a process, which signals make go wrong: python -m test.faults.outer_loop.

It publishes EFFORTS on /right/assist_efforts; with the argument 0 zeros, from the first signal on. GO_WRONG: NaN from
now on. FLOOD: far too often. BE_SOUND: neither.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import time

import rclpy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.lab.inputs.parameter_file import load

from ..support import CONFIG

TOPIC = "/right/assist_efforts"
NAMES = load(CONFIG / "sim.yaml")["/right/compensator"]["joint_names"]
EFFORTS = (0.0, 0.25, 0.0, 0.0)  # Nm, less than the friction: with it and without it the arm rests
NOTHING = (0.0, 0.0, 0.0, 0.0)
NAN = (0.0, math.nan, 0.0, 0.0)
PERIOD, FLOOD_PERIOD = 0.01, 0.0001  # s
GO_WRONG, FLOOD, BE_SOUND = signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP
MODES: dict[int, tuple[tuple[float, ...], float]] = {
    GO_WRONG: (NAN, PERIOD),
    FLOOD: (EFFORTS, FLOOD_PERIOD),
    BE_SOUND: (EFFORTS, PERIOD),
}


def main() -> None:
    """Publish until the parent process has ended."""
    is_next = "0" in sys.argv[1:]
    signals: list[int] = [] if is_next else [BE_SOUND]
    for number in MODES:
        signal.signal(number, lambda received, _: signals.append(received))
    keep_to_this_machine()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("outer_loop", namespace="/right")
    publisher = node.create_publisher(JointState, TOPIC, 1)
    message, parent, share = JointState(name=NAMES), os.getppid(), 0.0 if is_next else 1.0
    while os.getppid() == parent:
        efforts, period = MODES[signals[-1]] if signals else (NOTHING, PERIOD)
        message.effort = [share * effort for effort in efforts]
        message.header.stamp = node.get_clock().now().to_msg()
        if signals:
            publisher.publish(message)
        time.sleep(period)


if __name__ == "__main__":
    main()
