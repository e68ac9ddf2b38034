# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An independent listener on a simulated CAN bus."""

from __future__ import annotations

from typing import Any, NamedTuple

import can

from exo_gravity.core.motors.frames import ENTER, EXIT

CAN_IDS = (1, 2, 3, 4)


class Frame(NamedTuple):
    """A CAN frame. time: s of the system's clock."""

    time: float
    can_id: int
    data: bytes


class BusListener:
    """Records every frame on the bus, in order, in `frames`."""

    def __init__(self, bus: dict[str, Any]) -> None:
        self.frames: list[Frame] = []
        self._bus = can.Bus(**bus)
        self._notifier = can.Notifier(self._bus, [self._on_message])

    def _on_message(self, message: can.Message) -> None:
        self.frames.append(Frame(message.timestamp, message.arbitration_id, bytes(message.data)))

    def close(self) -> None:
        self._notifier.stop()
        self._bus.shutdown()

    def motors_are_off(self) -> bool:
        """Return whether EXIT is the last of the ENTER and EXIT frames to each motor."""
        return all(self._last_special(can_id) == EXIT for can_id in CAN_IDS)

    def _last_special(self, can_id: int) -> bytes | None:
        special = (f.data for f in reversed(self.frames) if f.can_id == can_id and f.data in (ENTER, EXIT))
        return next(special, None)
