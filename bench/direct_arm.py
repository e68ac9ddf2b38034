# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One arm of a parameter file without its nodes: its motors, its bus and its law, for an upright trunk."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.numbers import Torque
from exo_gravity.core.safety.drive import Send
from exo_gravity.core.safety.start import SwitchingOn
from exo_gravity.hardware.can_port import ArmOnBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import can_options, load

REPLIES = 2  # to a frame that switches a motor on; the first one may be late, and answer the frame before


class DirectArm:
    """The arm in the namespace `namespace` (e.g. /right), with the parameters of its `can_bridge` and `compensator`.

    joint_names: from base to hand. motors: in the same order. no_torque: (n,) Nm. interface, channel,
    options: of the CAN bus.
    """

    def __init__(self, params: str | Path, namespace: str) -> None:
        nodes = load(params)
        arm = read_arm(nodes, namespace)
        self.joint_names = arm.limits.joint_names
        self.motors = arm.motors
        self.no_torque = (0.0,) * len(arm.motors)
        self.interface, self.channel = str(arm.can_bridge["can.interface"]), str(arm.can_bridge["can.channel"])
        self.options = can_options(nodes[f"{namespace}/can_bridge"])
        address = self.interface, self.channel, self.options
        self._on_bus = ArmOnBus(address, arm.motors, arm.limits, 1.0 / arm.can_bridge["rate"])
        settings = arm.settings
        self._law, self._tilt = settings.chosen, Tilt.of(settings.side)

    def law(self, theta: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm for joint angles (n,) in rad."""
        return self._law.torque(theta, self._tilt)

    def open(self) -> MotorBus:
        """Open the bus."""
        return MotorBus(self._on_bus.ports(COMPUTER_CLOCK), self.motors)


class Starting:
    """Switches the motors of an arm on, as `SwitchingOn` does. Each step is repeated until all motors have replied.

    replies: (n,) whether a motor's board replies to commands.

    send: what each motor (n,) is sent in the next cycle. At first they are polled, until all are known.
    """

    def __init__(self, replies: Sequence[bool]) -> None:
        self.send: tuple[Send, ...] = (Send.POLL,) * len(replies)
        self._switching = SwitchingOn(replies)
        self._replies = 0

    def note(self, is_complete: bool) -> None:
        """Note whether all motors have replied to what they were sent."""
        if self._switching.done:
            return
        self._replies += is_complete
        if self._replies == REPLIES:
            self.send, self._replies = self._switching.step(), 0


def run_paced(period: float, cycle: Callable[[], None], stopping: Sequence[object]) -> None:
    """Call `cycle` every `period` s, paced like the control thread of `can_bridge`, until `stopping` is not empty."""
    gc.collect()
    gc.freeze()
    deadline = time.monotonic()
    while not stopping:
        cycle()
        deadline += period
        remaining = deadline - time.monotonic()
        if remaining > 0.0:
            time.sleep(remaining)
        elif remaining < -period:
            deadline = time.monotonic()
