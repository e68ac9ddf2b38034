# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An outer loop for the benchmark: assist efforts at 500 Hz with every term on, then neither, in turns.

    python -m bench.outer_loop NAMESPACE TURNS SECONDS

Every term is computed, but its torque vanishes in the sum: so the commands stay those of the law, by which
`bench.timing` finds the answer to each reply. It prints {"on": [[begin, end], ...], "off": [...]} in s since 1970.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import rclpy
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from exo_gravity.core.compensation.compensator import JOINTS

RATE = 500.0  # Hz
SETTLING = 1.5  # s after a change of parameters: their transition, and some more
NONE, FAINT = [0.0] * 4, [1e-18] * 4
OFF: dict[str, Any] = {
    "friction.share": 0.0,
    "inertia.share": 0.0,
    "damping.viscosity": NONE,
    "spring.stiffness": NONE,
    "coupling.stiffness": NONE,
    "limits.lower": [-3.15] * 4,
    "limits.upper": [3.15] * 4,
    "assist.max_effort": NONE,
}
ON: dict[str, Any] = {
    "friction.share": 0.4,  # of a friction of 0, which is the default
    "inertia.share": 1e-18,
    "damping.viscosity": FAINT,
    "spring.stiffness": FAINT,
    "coupling.stiffness": FAINT,
    "limits.lower": [-3.149] * 4,
    "limits.upper": [3.149] * 4,
    "assist.max_effort": [1.0] * 4,
}


class OuterLoop(Node):
    """Publishes efforts of 0 Nm and switches the terms of one compensator."""

    def __init__(self, namespace: str) -> None:
        super().__init__("outer_loop", namespace=namespace)
        self._publisher = self.create_publisher(JointState, "assist_efforts", 1)
        self._client = self.create_client(SetParametersAtomically, "compensator/set_parameters_atomically")
        side = namespace.strip("/")
        self._message = JointState(name=[f"{side}_{joint}" for joint in JOINTS], effort=NONE)

    def set(self, values: dict[str, Any]) -> None:
        """Set parameters of the compensator. Raises RuntimeError if it refuses them."""
        if not self._client.wait_for_service(10.0):
            raise RuntimeError("the compensator has no parameter service")
        wanted = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        future = self._client.call_async(SetParametersAtomically.Request(parameters=wanted))
        rclpy.spin_until_future_complete(self, future, timeout_sec=10.0)
        result = future.result()
        if result is None or not result.result.successful:
            raise RuntimeError(f"the compensator refused the terms: {result and result.result.reason}")

    def publish_for(self, seconds: float) -> None:
        """Publish efforts at RATE for `seconds`."""
        deadline = time.monotonic()
        end = deadline + seconds
        while deadline < end:
            self._message.header.stamp = self.get_clock().now().to_msg()
            self._publisher.publish(self._message)
            deadline += 1.0 / RATE
            time.sleep(max(0.0, deadline - time.monotonic()))


def main() -> None:
    """Alternate, and print the times of each turn."""
    namespace, turns, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    windows: dict[str, list[tuple[float, float]]] = {"on": [], "off": []}
    rclpy.init()
    node = OuterLoop(namespace)
    for _ in range(turns):
        for name, values, wait in (("off", OFF, time.sleep), ("on", ON, node.publish_for)):
            node.set(values)
            wait(SETTLING)
            begin = time.time()
            wait(seconds)
            windows[name].append((begin, time.time()))
    rclpy.try_shutdown()
    print(json.dumps(windows))


if __name__ == "__main__":
    main()
