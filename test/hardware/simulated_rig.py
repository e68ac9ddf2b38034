"""A simulated arm on a CAN bus, and the truth about it: how fast its joints really turn, and which motors are on."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from typing import Any

from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.motors.wire_formats import MIT, WireFormat
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can.can_port import ArmOnBus, open_bus
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.sim import ArmConfig

from ..support.ports import own_ports
from ..support.simulated_device import joints_of, make_device

MOTORS_OF_ARM = joints_of((MIT,) * 4)
LIMITS = Limits(("a", "b", "c", "d"), (-1.6,) * 4, (3.1,) * 4, (6.0,) * 4, (3.0, 9.0, 3.0, 3.0))
PERIOD = 0.004
POSE = (0.0, 0.6, 0.3, 0.3)
SAFE_SPEED = 1.0  # rad/s
AFTER_EXIT = 0.5  # s for which a joint that was dropped would turn

_PORTS = own_ports(30_000)


class Rig:
    """A simulated arm at rest in `pose`. carried: its motors are on and hold it, as if a dead process had left them.

    carrying: (4,) Nm, what holds it in `POSE`. top_speed: rad/s, the largest true speed of a joint so far.
    """

    def __init__(
        self, friction: float, pose: Sequence[float], carried: bool, clock: Clock, wire_format: WireFormat = MIT
    ) -> None:
        config = ArmConfig(coulomb_friction=(friction,) * 4)
        self.clock = clock
        self.motors = joints_of((wire_format,) * 4)
        self.device = make_device(config=config, formats=(wire_format,) * 4)
        self.device.arm.reset(pose)
        self.links = config.links
        self.carrying = tuple(gravity_torque(self.links, POSE))
        self.top_speed = 0.0
        if carried:
            for joint, torque in zip(self.motors, self.carrying, strict=True):
                self.device.exchange(joint.command_id, joint.command(torque, 0.0))
                for frame in joint.enter:
                    self.device.exchange(*frame)

    @property
    def motors_on(self) -> list[bool]:
        """Whether each motor is on."""
        return [motor.entered for motor in self.device.motors]

    def note_speed(self, _now: float = 0.0) -> None:
        self.top_speed = max(self.top_speed, *map(abs, self.device.arm.velocities))

    def assert_let_down(self) -> None:
        """The motors are off, and no joint turned fast, not even once nothing held it."""
        assert self.motors_on == [False] * 4
        self.clock.sleep(AFTER_EXIT)
        assert self.top_speed < SAFE_SPEED
        assert abs(self.device.arm.positions[1]) < 0.4  # from 0.6


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
