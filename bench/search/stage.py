# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm of a case in virtual time, and everything that can be done to it: VirtualArm with a device that fails."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

import can
import numpy as np

from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample
from exo_gravity.core.safety.drive import NO_EFFORTS, Efforts
from exo_gravity.lab.controllers import DirectController
from exo_gravity.sim import SimulatedDevice, SimulatedMotor, VirtualWearer
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.truth import TruthRecords
from exo_gravity.sim.virtual_arm import TrunkReading, VirtualArm
from exo_gravity.sim.virtual_time import VirtualBus, VirtualClock, Wire

from ..arms import ARMS, Friction, of_family
from .case import BODY_MASS, CARRIED, Case

IMU_PERIOD = 0.01  # s
TILT_TIMEOUT = 0.08  # s, that of a real arm
NOTHING = TrialScript("nothing", ())


class FailingMotor(SimulatedMotor):
    """A motor whose wiring or encoder may be wrong.

    reversed: whether its torque turns the joint the other way. speed_factor: of the velocity that its replies show.
    """

    def __init__(self, joint: JointMotor) -> None:
        super().__init__(joint)
        self.reversed, self.speed_factor = False, 1.0

    def advance(self, position: float, velocity: float, dt: float) -> float:
        """Return the torque on the joint in Nm; see `SimulatedMotor.advance`."""
        torque = super().advance(position, velocity, dt)
        return -torque if self.reversed else torque

    def damps_at_once(self, torque: float) -> bool:
        """Return whether its damping follows the velocity without delay; see `SimulatedMotor.damps_at_once`."""
        return not self.reversed and super().damps_at_once(torque)

    def _state(self, position: float, velocity: float) -> bytes:
        return super()._state(position, self.speed_factor * velocity)


class LossyWire(Wire):
    """A bus that loses the commands to some motors, or their replies.

    commands_lost, replies_lost: joints (0..).
    """

    def __init__(self, ids: Sequence[int]) -> None:
        super().__init__(start=0.0)
        self._ids = ids
        self.commands_lost: set[int] = set()
        self.replies_lost: set[int] = set()

    def carry(
        self, sender: object, message: can.Message, controller: Hashable = None, retransmits: bool = True
    ) -> None:
        """Deliver a frame to every end but its sender's, unless it is lost."""
        lost = self.commands_lost if isinstance(sender, VirtualBus) else self.replies_lost
        if message.arbitration_id not in {self._ids[joint] for joint in lost}:
            super().carry(sender, message, controller, retransmits)


class FailingController:
    """A compensator whose answers may be late, withdrawn or NaN, on a computer that may stand still.

    fault: what is wrong: '', 'late', 'withdrawn' or 'nan'. stall: s for which the next cycle stands still.
    delay: s of late answers.
    """

    def __init__(self, controller: DirectController, clock: VirtualClock) -> None:
        self.fault, self.stall, self.delay = "", 0.0, 0.0
        self.was_clamped = False  #: so far
        self._controller, self._clock = controller, clock
        self._answers: deque[tuple[float, Efforts]] = deque()  # by their time of arrival
        self._newest = NO_EFFORTS

    def efforts(self, latest: float) -> Efforts:
        """Return the newest efforts that have arrived."""
        if self.stall:
            self._clock.stall(self.stall)
            self.stall = 0.0
        while self._answers and self._answers[0][0] <= self._clock.monotonic():
            self._newest = self._answers.popleft()[1]
        return self._newest

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Answer the samples; answers arrive in order."""
        self._controller.take(now, samples)
        self.was_clamped |= bool(self._controller.answer.clamped)
        answer = self._controller.efforts(now)
        if self.fault == "withdrawn":
            answer = answer._replace(effort=None)
        elif self.fault == "nan" and answer.effort:
            answer = answer._replace(effort=(math.nan, *answer.effort[1:]))
        due = now + (self.delay if self.fault == "late" else 0.0)
        self._answers.append((max(due, self._answers[-1][0]) if self._answers else due, answer))


class Stage:
    """The arm of `case`, hanging, with its motors off, and an IMU on the trunk.

    imu_error: rad of pitch and roll that the IMU adds, as one that comes loose: its gyroscope agrees. imu_frozen: the
    reading that it repeats. imu_silent: whether it sends nothing.
    """

    def __init__(self, case: Case) -> None:
        self.played = ARMS[case.arm]
        configured = self.played.carried
        settings = replace(configured.settings, tilt_timeout=TILT_TIMEOUT, payload_mass=case.payload)
        load = self.played.load_of(BODY_MASS) if self.played.worn else None
        worn = {"wearer_mass": load.mass.tolist(), "wearer_cog": load.cog.tolist()} if load else {}
        mode = "zero_g" if case.worn else "one_g"
        self.settings: Settings = replace(settings, mode=mode, support=1.0, **worn)
        device_arm = self.played.device_arm(Friction(case.friction), load if case.worn else None)
        device_arm.carry(case.payload)
        self.motors = [of_family(FailingMotor, joint.spec.family)(joint) for joint in configured.motors]
        self.device = SimulatedDevice(device_arm, self.motors)
        self.truth = self.device.truth = TruthRecords()
        limits = self.played.limits(case.rate)
        if case.begin == CARRIED:  # its signs are as good as proven, which takes 5 s
            limits = replace(limits, sign_check_torque=0.0)
        self.wire = LossyWire([motor.can_id for motor in configured.motors])
        self.clock = self.wire.clock
        self.compensator = Compensator(self.settings, configured.limits.joint_names)
        self.controller = FailingController(DirectController(self.compensator, limits), self.clock)
        self.arm = VirtualArm(self.device, self.controller, configured.motors, limits, case.rate, self.wire)
        self.safety = self.arm.safety
        self.imu_error = [0.0, 0.0]
        self._last_error = [0.0, 0.0]  # at the last reading
        self.imu_frozen: TrunkReading | None = None
        self.imu_silent = False
        self.newest_reading: TrunkReading | None = None
        self.states: list[tuple[float, str, str]] = []  #: when the state changed, the state, and the fault's sentence
        self.clock.every(IMU_PERIOD, self._read_imu)
        self.clock.run(2.0 * IMU_PERIOD)

    @property
    def now(self) -> float:
        """The time in s."""
        return self.clock.monotonic()

    def run(self, duration: float, until: Callable[[], object] = lambda: False) -> None:
        """Run the loop for `duration` s, or less: until `until()`."""
        end = self.now + duration
        while self.now < end and not until() and self.arm.loop.cycle():
            fault = self.safety.fault
            state = self.safety.state.value
            if not self.states or self.states[-1][1] != state:
                self.states.append((self.now, state, f"{fault.code}: {fault.reason}" if fault else ""))

    def between_cycles(self, *functions: Callable[[float], object]) -> None:
        """Call each function with the time, before the next cycle."""
        for function in functions:
            self.arm.loop.call(lambda function=function: function(self.now))  # type: ignore[misc]

    def act(self, *steps: dict[str, object]) -> None:
        """Let the wearer do these steps of a trial script from now on; nothing without steps."""
        self.arm.catch_up()
        script = TrialScript.parse({"name": "event", "steps": list(steps)}) if steps else NOTHING
        self.device.start(VirtualWearer(script))

    def change(self, **changes: object) -> None:
        """Let the operator change the compensator's settings."""
        self.settings = replace(self.settings, **changes)  # type: ignore[arg-type]
        self.compensator.apply(self.settings)

    def _read_imu(self) -> None:
        self.arm.catch_up()
        trunk = self.device.trunk
        pitch_rate, roll_rate = np.subtract(self.imu_error, self._last_error) / IMU_PERIOD
        self._last_error = list(self.imu_error)
        seen = trunk._replace(
            pitch=trunk.pitch + self.imu_error[0],
            roll=trunk.roll + self.imu_error[1],
            pitch_rate=trunk.pitch_rate + pitch_rate,
            roll_rate=trunk.roll_rate + roll_rate,
        )
        gravity = gravity_in_trunk(seen.pitch, seen.roll).tolist()
        reading = self.imu_frozen or TrunkReading(gravity, None, seen.angular_velocity)
        self.newest_reading = reading
        if not self.imu_silent:
            taken = self.now
            self.clock.later(IMU_PERIOD, lambda: self._deliver(reading, taken))

    def _deliver(self, reading: TrunkReading, taken: float) -> None:
        with contextlib.suppress(ParameterError):  # the node refuses it, too
            self.arm.tell(self.compensator, reading, taken)
