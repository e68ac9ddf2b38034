"""A trial without bus, ROS or clock: the control code of `core` on the simulated device, as fast as it goes.

A cycle is that of `can_bridge` and `compensator` together, in their order: the safety machine decides on the newest
readings and the torque asked, every motor gets its frame and answers, the compensator answers the angles read, and time
goes on. Torques and angles pass as the bytes of CAN frames. Nothing is late here: what a busy computer adds to the
delay of a cycle, and frames that get lost, only the run in real time shows.
"""

from __future__ import annotations

import itertools
import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from exo_gravity.core.arm import JOINT_COUNT
from exo_gravity.core.compensator import Compensator, Settings
from exo_gravity.core.errors import DataError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.limits import UNKNOWN, JointSample, Limits
from exo_gravity.core.motors import ENTER, EXIT
from exo_gravity.core.recording import Recording, ScriptedStep
from exo_gravity.core.drive import Drive, State
from exo_gravity.core.safety import SafetyMachine
from exo_gravity.core.tilt import pitch_roll, rotation_matrix
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.imu import SimulatedImu
from exo_gravity.sim.virtual_wearer import VirtualWearer

LONGEST_START = 60.0  # s until the arm must be carried
GRACE = 0.5  # s from the script's end until the arm is let down
TILT_PERIOD = 0.01  # s between two tilts that the compensator is given
IMU_SAMPLES = 100
REMEMBERED = 64  # frames
COLUMNS = 1 + 4 * JOINT_COUNT  # of the recording: time, position, velocity, effort, command
UNASKED = (math.nan,) * JOINT_COUNT
STANDING = (State.DISABLED, State.FAULT)
CARRIED = (State.RAMPING_IN, State.ACTIVE)


@dataclass(frozen=True)
class ArmSetup:
    """One arm: `device` is what is true of it; motors, limits and settings are what its controller believes.

    rate: control cycles per s. tilt: pitch and roll of the trunk in rad as its IMU tells, None without an IMU.
    """

    name: str
    device: SimulatedDevice
    motors: Sequence[JointMotor]
    limits: Limits
    settings: Settings
    rate: float
    tilt: tuple[float, float] | None


class OfflineTrial:
    """One arm, its controller, and a wearer who carries out a script once, `delay` s after the motors went on.

    step: index of the wearer's step under way, None before the first. events: (s, what went wrong). trouble: why the
    trial ended before the script did, or ''.
    """

    def __init__(self, arm: ArmSetup, script: TrialScript, delay: float):
        self.arm = arm
        self.script = script
        self.events: list[tuple[float, str]] = []
        self.trouble = ""
        self._wearer = VirtualWearer(script)
        self._delay = delay
        self._start = math.inf  # of the script, s
        self._carried: list[float] = []  # the first and the last time that the motors carried the arm, s
        self._safety = SafetyMachine(arm.limits, 1.0 / arm.rate, [motor.peak_effort for motor in arm.motors])
        self._compensator = Compensator(arm.settings)
        self._asked: tuple[Sequence[float] | None, float] = (None, -math.inf)
        self._reason = ""  # why the compensator gives no torque
        self._tilted = -math.inf  # when the compensator was last told the tilt
        self._samples = [UNKNOWN] * JOINT_COUNT
        self._powered = False
        # Both are pure, and an arm at rest asks for the same again and again: the largest gain in speed there is.
        self._packed = [lru_cache(REMEMBERED)(motor.command) for motor in arm.motors]
        self._unpacked = [lru_cache(REMEMBERED)(motor.joint_reply) for motor in arm.motors]
        self._rows = array("d")

    @property
    def step(self) -> int | None:
        """Index of the wearer's step under way."""
        return self._wearer.step

    def apply(self, settings: Settings) -> None:
        """Let the compensator go on with other settings, as when its parameters are set live."""
        self._compensator.apply(settings)

    def run(self, should_stop: Callable[[float], bool] = lambda now: False) -> Recording:
        """Carry the arm through the script, let it down, and return what `recorder` would have recorded.

        should_stop: is asked once per simulated second, with the time in s. DataError: nothing was recorded.
        """
        self._safety.enable(0.0)
        second = 0.0
        for cycle in itertools.count():
            now = cycle / self.arm.rate
            self._cycle(now)
            if self._safety.state in STANDING:
                break
            if now >= second:
                second += 1.0
                if should_stop(now) and not self.trouble:
                    self._end(now, "stopped by the operator")
            self._watch(now)
        if self._safety.fault:
            self._end(now, f"fault: {self._safety.fault.code}: {self._safety.fault.reason}")
        return self._recording()

    def _cycle(self, now: float) -> None:
        arm, (effort, _) = self.arm, self._asked
        self._exchange(self._safety.step(now, tuple(self._samples), *self._asked), now)
        if self._safety.state in CARRIED:
            self._carried[:] = (*self._carried[:1], now)
        position = [joint.position for joint in self._samples]
        if not any(arm.limits.is_silent(now, joint) for joint in self._samples):
            self._record(now, position, effort)
            if arm.tilt and now - self._tilted >= TILT_PERIOD:
                self._compensator.set_tilt(now, *arm.tilt)
                self._tilted = now
            answer = self._compensator.step(now, position)
            self._asked = answer.effort, min(joint.time for joint in self._samples)
            if answer.reason and answer.reason != self._reason:
                self._note(now, f"withdrawn: {answer.reason}")
            self._reason = answer.reason
        arm.device.advance(1.0 / arm.rate)

    def _exchange(self, drive: Drive, now: float) -> None:
        """Give every motor its share of `drive`, and take what it answers: the frames that `MotorBus` sends."""
        give = self.arm.device.exchange
        for joint, motor in enumerate(self.arm.motors):
            command = self._packed[joint]
            if drive.powered and (drive.enter[joint] or not self._powered):
                give(motor.can_id, command(0.0, 0.0))
                give(motor.can_id, ENTER)
            reply = give(motor.can_id, command(drive.effort[joint], drive.damping[joint]))
            if self._powered and not drive.powered:
                reply = give(motor.can_id, EXIT)
            if reply:
                _, *reading = self._unpacked[joint](reply[1])
                self._samples[joint] = JointSample(*reading, now)
        self._powered = drive.powered

    def _watch(self, now: float) -> None:
        """Let the wearer begin once the motors are on, and the arm down once the script or patience has ended."""
        if self._start == math.inf:
            if self._powered:
                self.arm.device.start(self._wearer, self._delay)
                self._start = now + self._delay
            elif now > LONGEST_START:
                self._end(now, f"the arm was never carried: waiting for {self._safety.waiting_for}")
        elif now > self._start + self.script.duration + GRACE:
            self._safety.disable(now)

    def _end(self, now: float, why: str) -> None:
        why = f"{why} ({self._reason})" if self._reason else why
        self._note(now, why)
        self.trouble = self.trouble or self.events[-1][1]
        self._safety.disable(now)

    def _note(self, now: float, text: str) -> None:
        self.events.append((now, f"{self.arm.name}: {text}"))

    def _record(self, now: float, position: Sequence[float], effort: Sequence[float] | None) -> None:
        self._rows.append(now)
        self._rows.extend(position)
        self._rows.extend([joint.velocity for joint in self._samples])
        self._rows.extend([joint.effort for joint in self._samples])
        self._rows.extend(effort or UNASKED)

    def _recording(self) -> Recording:
        if not self._rows:
            raise DataError(self.trouble or f"{self.arm.name}: nothing was recorded")
        table = np.array(self._rows).reshape(-1, COLUMNS)
        columns = np.split(table[:, 1:], 4, axis=1)
        steps = self.script.steps
        starts = itertools.accumulate((step.duration for step in steps), initial=self._start)
        done = float(table[-1, 0])
        script = tuple(
            ScriptedStep(step.action, start, min(start + step.duration, done))
            for step, start in zip(steps, starts, strict=False)
            if start < done
        )
        carried = (tuple(self._carried),) if len(self._carried) == 2 else ()
        return Recording(self.arm.name, self.arm.limits.joint_names, table[:, 0], *columns, script, carried)


def told_tilt(
    pitch: float, roll: float, imu: SimulatedImu, rotation_trunk_from_imu: Sequence[float]
) -> tuple[float, float]:
    """Return pitch and roll (rad) as a second of IMU samples tells them of a trunk at rest at `pitch` and `roll`.

    rotation_trunk_from_imu: unit quaternion (x, y, z, w), as the controller believes.
    """
    rotation = rotation_matrix(rotation_trunk_from_imu, "rotation_trunk_from_imu")
    force = np.mean([imu.sample(pitch, roll)[1] for _ in range(IMU_SAMPLES)], axis=0)
    return pitch_roll(-rotation @ force)
