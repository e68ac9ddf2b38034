# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One arm in virtual time with its compensator and an IMU, and everything that can go wrong with them.

Tests and studies play it: `events` has what can happen, and `judge` says what the motors did by the arm's true motion.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.frames import Frame
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can_port import message_of
from exo_gravity.sim.controllers import DirectController, UnreliableController
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.script import IDLE, TrialScript
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.truth import TruthRecords
from exo_gravity.sim.virtual_arm import TrunkReading, VirtualArm
from exo_gravity.sim.virtual_time import Wire
from exo_gravity.sim.virtual_wearer import VirtualWearer

IMU_PERIOD = 0.01  # s
START = 90.0  # s within which an arm without a fault is carried
HOLD = 600.0  # s for which a wearer stays as their last step left them

Act = Callable[..., None]  # on a Rig, with values by name


class Change(NamedTuple):
    """A change of the arm's state."""

    time: float  #: s
    state: str  #: of `State`
    fault: str  #: the fault's code and sentence, '' without one


class Rig(VirtualArm):
    """The arm of `device`, hanging, with its motors off. Arguments and `options` are those of `VirtualArm`.

    settings: of the compensator that carries it.
    late: share of cycles and answers that are late by chance (`UnreliableController`).

    compensator, controller: what carries it. truth: its motion (sim/truth.py) since it was last forgotten.
    imu_error: rad of pitch and roll that the IMU adds, as one that comes loose: its gyroscope agrees. imu_frozen: the
    reading that it repeats. imu_silent: whether it sends nothing. gyro_bias: rad/s of pitch that it adds: a
    gyroscope that reads exactly 0 counts as none. changes: of the state so far.
    """

    def __init__(
        self,
        device: SimulatedDevice,
        settings: Settings,
        motors: Sequence[JointMotor],
        limits: Limits,
        rate: float,
        wire: Wire | None = None,
        late: float = 0.0,
        **options: Any,
    ) -> None:
        wire = wire or Wire(start=0.0)
        self.settings = settings
        self.compensator = Compensator(settings, limits.joint_names)
        self.direct = DirectController(self.compensator, limits)
        self.controller = UnreliableController(self.direct, wire.clock, late)
        super().__init__(device, self.controller, motors, limits, rate, wire, **options)
        self.forget()
        self.changes: list[Change] = []
        self.imu_error, self._last_error = [0.0, 0.0], [0.0, 0.0]
        self.imu_frozen: TrunkReading | None = None
        self.imu_silent, self.gyro_bias = False, 0.0
        self.newest_reading: TrunkReading | None = None
        self.add_imu(self._sense, self.compensator, IMU_PERIOD)

    @property
    def state(self) -> State:
        """The state of the arm."""
        return self.safety.state

    @property
    def fault(self) -> str:
        """The code of the latched fault, '' without one."""
        return str(self.safety.fault.code) if self.safety.fault else ""

    @property
    def motors(self) -> Sequence[Any]:
        """The simulated motors, from the shoulder on."""
        return self.device.motors

    def cycle(self) -> bool:
        """Run one cycle of the loop, and note a change of state; return False once the loop has ended."""
        if not self.loop.cycle():
            return False
        state, fault = self.safety.state.value, self.safety.fault
        if not self.changes or self.changes[-1].state != state:
            self.changes.append(Change(self.now, state, f"{fault.code}: {fault.reason}" if fault else ""))
        return True

    def carry(self) -> None:
        """Enable the hanging arm, and run until it is carried. Raises RuntimeError if it is not."""
        self.between_cycles(self.safety.enable)
        if not self.run_until(lambda: self.state is State.ACTIVE or self.safety.fault, START) or self.safety.fault:
            raise RuntimeError(f"the arm was not carried: {self.safety.fault or self.safety.waiting_for}")

    def raise_to(self, pose: Sequence[float], over: float = 1.6, settle: float = 0.8) -> None:
        """Let the wearer bring the carried arm to a pose (n,) in rad within `over` s, and leave it for `settle` s."""
        self.act({"move": list(pose), "over": over})
        self.run(over + settle)

    def let_down(self, timeout: float = 60.0) -> bool:
        """Disable the arm, and run until its motors are off; return whether they are, within `timeout` s."""
        self.between_cycles(self.safety.disable)
        off = State.DISABLED, State.FAULT
        return self.run_until(lambda: self.state in off and not self.device.powered, timeout)

    def between_cycles(self, *functions: Callable[[float], object]) -> None:
        """Call each function with the time in s, before the next cycle."""
        for function in functions:
            self.loop.call(partial(_call, function, self.clock.monotonic))

    def act(self, *steps: Mapping[str, object]) -> None:
        """Let the wearer do these steps of a trial script from now on; nothing without steps."""
        self.catch_up()
        script = TrialScript.parse({"name": "event", "steps": list(steps)}) if steps else IDLE
        self.device.start(VirtualWearer(script))

    def change(self, **changes: Any) -> None:
        """Let the operator change the compensator's settings."""
        self.settings = replace(self.settings, **changes)
        self.compensator.apply(self.settings)

    def send(self, frame: Frame) -> None:
        """Send a frame on the bus, as a foreign host does."""
        self.wire.carry(None, message_of(frame, any(self.device.is_fd)))

    def schedule(self, events: Iterable[tuple[float, str, Mapping[str, Any]]], acts: Mapping[str, Act]) -> None:
        """Let events happen: each is a time in s from now on, a name in `acts`, and its values."""
        for time, name, values in events:
            self.clock.later(time, partial(acts[name], self, **values))

    def forget(self) -> None:
        """Forget how the arm has moved so far."""
        self.truth = self.device.truth = TruthRecords()

    @property
    def caused(self) -> Driven:
        """What the motors have caused since the motion was last forgotten."""
        return driven(self.truth.records, [motor.joint.spec for motor in self.motors])

    def _sense(self, _now: float, trunk: TrunkState) -> TrunkReading | None:
        pitch_rate, roll_rate = np.subtract(self.imu_error, self._last_error) / IMU_PERIOD
        self._last_error = list(self.imu_error)
        seen = trunk._replace(
            pitch=trunk.pitch + self.imu_error[0],
            roll=trunk.roll + self.imu_error[1],
            pitch_rate=trunk.pitch_rate + pitch_rate + self.gyro_bias,
            roll_rate=trunk.roll_rate + roll_rate,
        )
        gravity = gravity_in_trunk(seen.pitch, seen.roll).tolist()
        self.newest_reading = self.imu_frozen or TrunkReading(gravity, None, seen.angular_velocity)
        return None if self.imu_silent else self.newest_reading


def _call(function: Callable[[float], object], clock: Callable[[], float]) -> None:
    function(clock())
