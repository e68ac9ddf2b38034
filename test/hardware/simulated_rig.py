# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated arm on a separate bus, in real time, for tests of processes and threads."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from typing import Any

from exo_gravity.hardware.can.can_port import ArmOnBus, open_bus
from exo_gravity.hardware.clock import COMPUTER_CLOCK

from ..support.ports import own_ports
from .rig import LIMITS, MOTORS_OF_ARM, POSE, Rig

PERIOD = 0.004  # s

_PORTS = own_ports()


class SimulatedRig(Rig):
    """A simulated arm on a separate bus, in real time.

    interface: 'virtual', or 'udp_multicast' to share it with processes.
    """

    def __init__(
        self, interface: str = "virtual", friction: float = 0.1, pose: Sequence[float] = POSE, carried: bool = False
    ) -> None:
        sys.setswitchinterval(2e-4)  # as in nodes/ros/run.py: with 5 ms the threads here would delay each other
        port = next(_PORTS)
        options: dict[str, Any] = {}
        if interface == "udp_multicast":
            channel, options = "239.74.163.2", {"port": port, "hop_limit": 0}
        else:
            channel = f"simulated_rig_{port}"
        super().__init__(friction, pose, carried, COMPUTER_CLOCK)
        self.arm = ArmOnBus((interface, channel, options), MOTORS_OF_ARM, LIMITS, PERIOD)
        self._stop = threading.Event()
        self._bus = open_bus(*self.arm.address)
        self._thread = threading.Thread(target=self.device.run, args=(self._bus, self._stop.is_set, self.note_speed))
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()


class NoWatchdog:
    """In place of the watchdog of a bridge in this process, which a real one would kill on a busy machine."""

    alive, is_starting = True, False

    def __init__(self, *_: object) -> None:
        pass

    def hand_over(self, reason: str) -> bool:
        return False

    def close(self) -> None:
        pass
