# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One arm in virtual time with its compensator and an IMU, and everything that can go wrong with them.

Tests and studies play it: `ACTS` has what can happen, and `judge` says what the motors did by the arm's true motion.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import Payload
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.frames import ID_BITS, Frame
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.command import Efforts, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can_port import message_of
from exo_gravity.sim.controllers import DirectController, UnreliableController
from exo_gravity.sim.device import SimulatedDevice, TruthRecords, VirtualWearer
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.script import IDLE, TrialScript
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_arm import TrunkReading, VirtualArm
from exo_gravity.sim.virtual_time import Wire

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

    compensator, controller: what carries it. truth: its motion (sim/device.py) since it was last forgotten.
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
            self.loop.call(partial(lambda act: act(self.now), function))

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


RAMP_STEPS = 20  # in which an IMU's error grows, or a motor warms
WARMING = 4.0  # s


def during(rig: Rig, duration: float, begin: Callable[[], None], end: Callable[[], None]) -> None:
    """Call `begin` now and `end` in `duration` s, never if that is infinite."""
    begin()
    if math.isfinite(duration):
        rig.clock.later(duration, end)


def setting(rig: Rig, owner: object, name: str, value: object, normal: object, duration: float) -> None:
    """Give an attribute a value for `duration` s."""
    rig.catch_up()
    during(rig, duration, partial(setattr, owner, name, value), partial(setattr, owner, name, normal))


def gradually(rig: Rig, duration: float, step: Callable[[float], None]) -> None:
    """Call step(share) with a share that grows to 1 within `duration` s."""
    for number in range(1, RAMP_STEPS + 1):
        share = number / RAMP_STEPS
        rig.clock.later(share * duration, partial(step, share))


def request(name: str, then: str, rig: Rig, duration: float = 0.0) -> None:
    """Ask the safety machine for something, and, `duration` s later, for something else, unless that is ''."""
    rig.between_cycles(getattr(rig.safety, name))
    if then:
        rig.clock.later(duration, partial(rig.between_cycles, getattr(rig.safety, then)))


def max_effort(rig: Rig, share: float) -> None:
    """Lower every effort limit to a share of what it is."""
    rig.change(max_effort=tuple(share * most for most in rig.settings.max_effort))


def mode(rig: Rig) -> None:
    """Change from zero-G to one-G, or back."""
    rig.change(mode="one_g" if rig.settings.mode == "zero_g" else "zero_g")


def supply_cut(rig: Rig, motors: Sequence[int], duration: float = math.inf) -> None:
    """Cut the supply. After it the encoders, on the rotors, know the angle only within a turn of the rotor."""

    def power(is_on: bool) -> None:
        rig.catch_up()
        errors = list(rig.device.encoder_error)
        for joint in motors:
            motor = rig.motors[joint]
            motor.unplugged = not is_on
            turn = 2.0 * math.pi / motor.joint.spec.gear_ratio
            errors[joint] = -turn * round(rig.device.arm.positions[joint] / turn)
        rig.device.encoder_error = errors

    during(rig, duration, partial(power, False), partial(power, True))


def unplugged(rig: Rig, joint: int, duration: float = math.inf) -> None:
    """Take the power of one motor away, to the millisecond; it comes back switched off."""
    rig.catch_up()
    rig.device.unplug(joint, duration)


def frames_lost(which: str, ends: str, rig: Rig, motors: Sequence[int], duration: float = math.inf) -> None:
    """Lose the frames of some motors: of the wire's set `which`, by the IDs named `ends`."""
    ids = {getattr(rig.motors[joint].joint, ends) & ID_BITS for joint in motors}
    lost: set[int] = getattr(rig.wire, which)
    during(rig, duration, partial(lost.update, ids), partial(lost.difference_update, ids))


def motors_fail(name: str, rig: Rig, motors: Sequence[int], duration: float = math.inf) -> None:
    """Set a flag of the device for some motors, and clear that of all after a time."""
    normal = [False] * len(rig.motors)
    setting(rig, rig.device, name, [joint in motors for joint in range(len(normal))], normal, duration)


def encoder_slip(rig: Rig, joint: int, error: float) -> None:
    """Add `error` rad to what the encoder of a joint reads."""
    rig.catch_up()
    rig.device.encoder_error = errors = list(rig.device.encoder_error)
    errors[joint] += error


def attribute(owner: str, name: str, value: object, normal: object, rig: Rig, duration: float = math.inf) -> None:
    """Give an attribute of the rig's device or controller a value for a time."""
    setting(rig, getattr(rig, owner), name, value, normal, duration)


def of_motor(name: str, normal: object, rig: Rig, joint: int, value: object, duration: float = math.inf) -> None:
    """Give a motor's attribute a value for a time."""
    setting(rig, rig.motors[joint], name, value, normal, duration)


def motor_warms(rig: Rig, joint: int, most: float) -> None:
    """Warm a motor from 60 to `most` degC."""
    motor = rig.motors[joint]
    gradually(rig, WARMING, lambda share: setattr(motor, "temperature", 60.0 + share * (most - 60.0)))


def foreign_torque(rig: Rig, joint: int, torque: float, rate: float = 500.0, duration: float = 2.0) -> None:
    """Command a motor as another host would: `torque` Nm, `rate` times a second for `duration` s."""
    motor = rig.motors[joint].joint
    for number in range(1 + int(rate * duration)):
        rig.clock.later(number / rate, partial(rig.send, (motor.command_id, motor.command(torque, 0.0))))


def withdrawn(answer: Efforts) -> Efforts:
    """Return no efforts."""
    return answer._replace(effort=None)


def not_a_number(answer: Efforts) -> Efforts:
    """Return efforts of which the first one is NaN."""
    return answer._replace(effort=(math.nan, *answer.effort[1:])) if answer.effort else answer


def efforts_late(rig: Rig, duration: float, most: float = 0.3) -> None:
    """Delay the compensator's efforts by `duration` s or `most`, for `duration` s."""
    setting(rig, rig.controller, "delay", min(most, duration), 0.0, duration)


def reach(rig: Rig, pose: Sequence[float], duration: float) -> None:
    """Let the wearer move their arm to a pose (n,) rad within `duration` s."""
    rig.act({"move": list(pose), "over": duration})


def resist(rig: Rig, duration: float) -> None:
    """Let the wearer hold their arm where it is for `duration` s."""
    rig.catch_up()
    reach(rig, rig.device.arm.positions, duration)


def trunk(action: str, rig: Rig, duration: float, **angle: float) -> None:
    """Turn the trunk by an angle in rad within `duration` s: 'bow' or 'lean'."""
    rig.act({action: angle[action], "over": duration}, {"hold": HOLD})


def payload_taken(rig: Rig, mass: float, told: float) -> None:
    """Let the wearer pick up `mass` kg; the operator enters `told` times that mass as the payload."""
    rig.catch_up()
    rig.device.arm.carry(mass)
    rig.change(payload=Payload(told * mass))


def payload_dropped(rig: Rig) -> None:
    """Let the wearer drop what they carry."""
    rig.catch_up()
    rig.device.arm.carry(0.0)


def out_of_cuff(rig: Rig) -> None:
    """Let the wearer pull their arm out of the exoskeleton."""
    payload_dropped(rig)
    arm = rig.device.arm
    arm.config = replace(arm.config, wearer_mass=(0.0,) * len(arm.config.wearer_mass))
    arm.carry(0.0)


def imu_wrong(rig: Rig, pitch: float, roll: float, duration: float) -> None:
    """Let the IMU's error grow to `pitch` and `roll` rad within `duration` s."""
    gradually(rig, duration, lambda share: setattr(rig, "imu_error", [share * pitch, share * roll]))


def imu_frozen(rig: Rig, duration: float = math.inf) -> None:
    """Repeat the IMU's newest reading."""
    setting(rig, rig, "imu_frozen", rig.newest_reading, None, duration)


ACTS: Mapping[str, Act] = {
    # The operator. `toggle` and `rearm` enable the arm `duration` s later.
    "disable": partial(request, "disable", ""),
    "enable": partial(request, "enable", ""),
    "clear": partial(request, "clear", ""),
    "resume": partial(request, "resume", ""),
    "toggle": partial(request, "disable", "enable"),
    "rearm": partial(request, "clear", "enable"),
    "settings": lambda rig, **changes: rig.change(**changes),
    "mode": mode,
    "max_effort": max_effort,
    # Hardware. `commands_lost` and `replies_lost` are lost on the bus; a motor that is `mute` sends none.
    "supply_cut": supply_cut,
    "unplugged": unplugged,
    "commands_lost": partial(frames_lost, "commands_lost", "command_id"),
    "replies_lost": partial(frames_lost, "replies_lost", "reply_id"),
    "cut_off": partial(motors_fail, "cut_off"),
    "mute": partial(motors_fail, "mute"),
    "bus_silent": partial(attribute, "device", "bus_silent", True, False),
    "encoder_slip": encoder_slip,
    "encoder_jump": lambda rig, joint: encoder_slip(rig, joint, rig.motors[joint].joint.spec.rotor_turn),
    "wrong_speed": lambda rig, joint, factor, duration: of_motor("speed_factor", 1.0, rig, joint, factor, duration),
    "torque_reversed": lambda rig, joint: of_motor("is_reversed", False, rig, joint, True),
    "motor_error": lambda rig, joint, code: of_motor("error", 0, rig, joint, code),
    "motor_hot": partial(of_motor, "temperature", 30.0),
    "motor_warms": motor_warms,
    "foreign_torque": foreign_torque,
    # Computers.
    "stall": lambda rig, duration: setattr(rig.controller, "stall", duration),
    "efforts_late": efforts_late,
    "efforts_withdrawn": partial(attribute, "controller", "change", withdrawn, None),
    "efforts_nan": partial(attribute, "controller", "change", not_a_number, None),
    # The wearer.
    "wearer": lambda rig, steps: rig.act(*steps),  # of a trial script
    "reach": reach,
    "limp": lambda rig: rig.act(),
    "resist": resist,
    "push": lambda rig, torque, duration: rig.act({"push": list(torque), "over": duration}),  # (n,) Nm
    "payload_taken": payload_taken,
    "payload_dropped": payload_dropped,
    "out_of_cuff": out_of_cuff,
    "bow": partial(trunk, "bow"),
    "lean": partial(trunk, "lean"),
    # The IMU.
    "imu_wrong": imu_wrong,
    "imu_frozen": imu_frozen,
    "imu_silent": lambda rig, duration=math.inf: setting(rig, rig, "imu_silent", True, False, duration),
}
