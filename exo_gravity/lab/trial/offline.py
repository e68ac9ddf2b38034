"""A trial without bus, ROS or clock: the control code of `core` on the simulated device, as fast as possible.

One cycle does what `can_bridge` and `compensator` do in one cycle, in the same order: the safety machine processes the
newest readings and efforts, every motor gets a command and replies, the compensator computes efforts from the new
angles, and time advances. Torques and angles pass through CAN frames. Nothing is ever late: only a run in real time
shows the delays and lost frames of a busy computer.
"""

import itertools
import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt, gravity_in_trunk
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import DataError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import NO_COMMAND, Drive, EffortCommand, State
from exo_gravity.core.safety.limits import UNKNOWN, JointSample, Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.lab.trial.recording import CARRIED, Recording, ScriptedStep, Span
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.script import IDLE, TrialScript
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_wearer import VirtualWearer

GRACE = 0.5  # s from the end of the script until the arm is let down
CACHED_FRAMES = 64
COLUMNS = 1 + 4 * JOINT_COUNT  # of the recording: time, position, velocity, effort, command
NO_EFFORT = (math.nan,) * JOINT_COUNT


class TrunkReading(NamedTuple):
    """What the `imu` node publishes, vectors (3,) in the trunk's axes."""

    gravity: Sequence[float]  #: unit vector
    specific_force: Sequence[float] | None = None  #: m/s^2, as measured
    angular_velocity: Sequence[float] = ZERO  #: rad/s, as measured


# Called in every cycle with its time in s. Returns a reading when the IMU takes a sample, else None.
TrunkSensor = Callable[[float, TrunkState], TrunkReading | None]


def resting(pitch: float, roll: float) -> TrunkSensor:
    """Return the sensor of a trunk that stays at this measured tilt in rad, and of whose motion nothing is known."""
    reading = TrunkReading(gravity_in_trunk(pitch, roll).tolist())
    return lambda now, state: reading


@dataclass(frozen=True)
class ArmSetup:
    """One arm: `device` is the truth; motors, limits and settings are the controller's parameters."""

    name: str
    device: SimulatedDevice
    motors: Sequence[JointMotor]
    limits: Limits
    settings: Settings
    rate: float  #: control cycles per s
    trunk: TrunkSensor | None  #: None without an IMU


class OfflineTrial:
    """One arm, its controller, and a wearer who performs a script once, `delay` s after the motors are switched on."""

    def __init__(
        self,
        arm: ArmSetup,
        script: TrialScript,
        delay: float,
        compensator: Compensator | None = None,
        wearer: VirtualWearer | None = None,
    ) -> None:
        self.arm, self.script, self.wearer = arm, script, wearer or VirtualWearer(script)
        self.events: list[tuple[float, str]] = []  #: s and text of everything that went wrong
        self.trouble = ""  #: why the trial ended before the script, or ''
        self._delay = delay
        self._start = math.inf  # s, of the script
        self._carried: tuple[Span, ...] = ()  # from the first to the last time at which the motors carried the arm
        self.safety = SafetyMachine(arm.limits, 1.0 / arm.rate, arm.motors)
        self.compensator = compensator or Compensator(arm.settings)
        self._command = NO_COMMAND
        self._reason = ""  # why the compensator has withdrawn
        before = -1.0 / arm.rate
        # On its way, and when it was taken
        self._reading = arm.trunk and arm.trunk(before, arm.device.trunk), before
        self._samples = [UNKNOWN] * JOINT_COUNT
        self._powered = False
        # Both are pure, and an arm at rest repeats its frames: caching them saves the most time.
        self._pack = [lru_cache(CACHED_FRAMES)(motor.command) for motor in arm.motors]
        self._unpack = [lru_cache(CACHED_FRAMES)(motor.joint_reply) for motor in arm.motors]
        self._rows = array("d")

    def run(self, should_stop: Callable[[float], bool] = lambda now: False) -> Recording:
        """Run the script, let the arm down, and return what `recorder` would have recorded.

        should_stop(now) is called once per simulated second, `now` in s. Raises DataError if nothing was recorded.
        """
        self.safety.enable(0.0)
        second = 0.0
        for cycle in itertools.count():
            now = cycle / self.arm.rate
            self._deliver_tilt(now)
            self._cycle(now)
            if self.safety.state in (State.DISABLED, State.FAULT):
                break
            if now >= second:
                second += 1.0
                if should_stop(now) and not self.trouble:
                    self._abort(now, "stopped by the operator")
            self._follow_script(now)
        if self.safety.refusal:
            self._abort(now, f"the arm was never carried: {self.safety.refusal}")
        if self.safety.fault:
            self._abort(now, f"fault: {self.safety.fault.code}: {self.safety.fault.reason}")
        return self._recording()

    def _cycle(self, now: float) -> None:
        arm, effort = self.arm, self._command.effort
        self._exchange(self.safety.step(now, tuple(self._samples), self._command), now)
        if self.safety.state in CARRIED:
            self._carried = ((self._carried[0][0] if self._carried else now, now),)
        position = [joint.position for joint in self._samples]
        if not any(arm.limits.is_silent(now, joint) for joint in self._samples):
            velocity = [joint.velocity for joint in self._samples]
            for values in ((now,), position, velocity, [joint.effort for joint in self._samples], effort or NO_EFFORT):
                self._rows.extend(values)
            answer = self.compensator.step(now, position, velocity)
            answered = min(joint.time for joint in self._samples)
            self._command = EffortCommand(answer.effort, answered, answer.damped)
            if answer.reason and answer.reason != self._reason:
                self._note(now, f"withdrawn: {answer.reason}")
            self._reason = answer.reason
        arm.device.advance(1.0 / arm.rate)

    def _deliver_tilt(self, now: float) -> None:
        """Give the compensator the newest tilt, which arrives one cycle after the sample."""
        arm, (reading, taken) = self.arm, self._reading
        if not arm.settings.use_imu or arm.trunk is None:
            return
        if reading:
            age, turning = now - taken, reading.angular_velocity
            self.compensator.tilt.set_gravity(now, reading.gravity, turning, age)
            self.safety.motion.gravity = Tilt.of_gravity(arm.device.side, reading.gravity).direction
            if reading.specific_force:
                self.compensator.motion.add(now, reading.specific_force, turning, age)
        self._reading = arm.trunk(now, arm.device.trunk), now

    def _exchange(self, drive: Drive, now: float) -> None:
        """Send `drive` to the motors and read their replies, with the same frames as `MotorBus`."""
        device, send = self.arm.device, self.arm.device.exchange
        for joint, motor in enumerate(self.arm.motors):
            command = self._pack[joint]
            if drive.powered and (drive.enter[joint] or not self._powered):
                for frame in ((motor.command_id, command(0.0, 0.0)), *motor.enter):
                    send(*frame)
            reply = None
            if drive.powered or motor.wire_format.replies:
                reply = send(motor.command_id, command(drive.effort[joint], drive.damping[joint]))
            if self._powered and not drive.powered:
                for frame in motor.exit:
                    reply = send(*frame)
            if reply := reply or device.status(joint):
                self._samples[joint] = JointSample(*self._unpack[joint](reply[1])[1:], now)
        self._powered = drive.powered

    def _follow_script(self, now: float) -> None:
        """Start the wearer when the motors are on, and let the arm down after the script."""
        if self._start == math.inf:
            if self._powered:
                self.arm.device.start(self.wearer, self._delay)
                self._start = now + self._delay
        elif now > self._start + self.script.duration + GRACE:
            self.safety.disable(now)

    def _abort(self, now: float, why: str) -> None:
        why = f"{why} ({self._reason})" if self._reason else why
        self._note(now, why)
        self.trouble = self.trouble or self.events[-1][1]
        self.arm.device.start(VirtualWearer(IDLE))
        self.safety.disable(now)

    def _note(self, now: float, text: str) -> None:
        self.events.append((now, f"{self.arm.name}: {text}"))

    def _recording(self) -> Recording:
        if not self._rows:
            raise DataError(self.trouble or f"{self.arm.name}: nothing was recorded")
        table = np.array(self._rows).reshape(-1, COLUMNS)
        position, velocity, effort, command = np.split(table[:, 1:], 4, axis=1)
        steps = self.script.steps
        starts = itertools.accumulate((step.duration for step in steps), initial=self._start)
        end = float(table[-1, 0])
        script = tuple(
            ScriptedStep(step.action, start, min(start + step.duration, end))
            for step, start in zip(steps, starts, strict=False)
            if start < end
        )
        name, joint_names = self.arm.name, self.arm.limits.joint_names
        return Recording(name, joint_names, table[:, 0], position, velocity, effort, command, script, self._carried)
