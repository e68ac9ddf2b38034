"""One arm of a parameter file without its nodes: its motors, its bus and its law, for a trunk that stays upright."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence

from exo_gravity.core.control_params import CAN_BRIDGE, COMPENSATOR, OPTIONS, motors_of, settings_of
from exo_gravity.core.gravity import LAWS, Torque
from exo_gravity.core.param_table import values_of
from exo_gravity.core.tilt import Tilt
from exo_gravity.hardware.motor_bus import MotorBus, open_bus
from exo_gravity.tools.inputs.parameter_file import load


class Arm:
    """What `can_bridge` and `compensator` of the namespace `space` (e.g. /right) are told."""

    def __init__(self, params: str, space: str):
        nodes = load(params)
        bridge = values_of(CAN_BRIDGE, nodes[f"{space}/can_bridge"], OPTIONS)
        options = {
            name.removeprefix(f"{OPTIONS}."): value
            for name, value in nodes[f"{space}/can_bridge"].items()
            if name.startswith(OPTIONS)
        }
        settings = settings_of(values_of(COMPENSATOR, nodes[f"{space}/compensator"]))
        self.names = bridge["joint_names"]
        self.motors = motors_of(bridge)
        self.address = bridge["can.interface"], bridge["can.channel"], options
        self._model, self._law, self._tilt = settings.arm, LAWS[settings.law], Tilt.of(settings.side)

    def law(self, theta: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm for joint angles (4,) in rad."""
        return self._law.torque(self._model, theta, self._tilt)

    def open(self) -> MotorBus:
        """Open the bus."""
        return MotorBus(open_bus(*self.address), self.motors)


def paced(period: float, cycle: Callable[[], None], stopping: Sequence) -> None:
    """Call `cycle` every `period` s until `stopping` holds something, as the control thread of `can_bridge` does."""
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
