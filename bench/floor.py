"""The floor for Python: the same law on the same bus in one process without ROS, safety machine or messages.

    python -m bench.floor PARAMS ARM RATE

Ends on SIGTERM.
"""

from __future__ import annotations

import signal
import sys
import time

from bench.arm import Arm, paced
from exo_gravity.core.limits import UNKNOWN
from exo_gravity.core.safety import NOTHING, Drive
from exo_gravity.hardware.control_loop import COLLECTING
from exo_gravity.hardware.scheduling import favour


def main() -> None:
    """Run the loop."""
    arm = Arm(sys.argv[1], sys.argv[2])
    period = 1.0 / float(sys.argv[3])
    stopping = []
    signal.signal(signal.SIGTERM, lambda *_: stopping.append(True))
    favour(20)
    bus = arm.open()

    def cycle() -> None:
        now = time.monotonic()
        known = UNKNOWN not in bus.samples  # switched on before that, a motor might not have heard it
        effort = arm.law([joint.position for joint in bus.samples]) if known else NOTHING
        bus.exchange(Drive(effort, 0.0, powered=known), now + COLLECTING * period)

    try:
        paced(period, cycle, stopping)
    finally:
        bus.stop()


if __name__ == "__main__":
    main()
