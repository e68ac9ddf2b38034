# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A peer for the loop: the same law on the same bus in one process, without ROS, safety machine or messages.

    python -m bench.bare_python PARAMS NAMESPACE RATE

Ends on SIGTERM.
"""

from __future__ import annotations

import signal
import sys
import time

from exo_gravity.core.motors.joint_motor import REPLY_SHARE, UNKNOWN
from exo_gravity.core.safety.drive import Drive
from exo_gravity.hardware.clock import favour

from .direct_arm import DirectArm, Starting, run_paced


def main() -> None:
    """Run the loop."""
    params, namespace, rate = sys.argv[1:]
    arm = DirectArm(params, namespace)
    period = 1.0 / float(rate)
    stopping: list[bool] = []
    signal.signal(signal.SIGTERM, lambda *_: stopping.append(True))
    favour(20)
    bus = arm.open()
    starting = Starting(bus.replies)

    def cycle() -> None:
        now = time.monotonic()
        all_replied = UNKNOWN not in bus.samples
        effort = arm.law([joint.position for joint in bus.samples]) if all_replied else arm.no_torque
        drive = Drive(effort, arm.no_torque, starting.send, all_replied)
        starting.note(bus.exchange(drive, now + REPLY_SHARE * period))

    try:
        run_paced(period, cycle, stopping)
    finally:
        bus.stop()


if __name__ == "__main__":
    main()
