# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms in virtual time that their motors would throw, and wearers who reach: what happens to each, by the truth.

The truth is the simulated device's: joint speeds from MuJoCo, torques that its motors apply. Masses are those of the
paper's arm and of a wearer of 75 kg.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.barrier import Barrier
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.controllers import DirectController
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor, VirtualWearer
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_arm import TrunkReading, TrunkSensor, VirtualArm

ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
MASS, COG = (tuple(map(float, load)) for load in Wearer(75.0).on_links(ROBOT.length))
RATED = (3.0, 9.0, 3.0, 3.0)  # Nm
PEAK = (9.0, 18.0, 9.0, 9.0)  # Nm
LIFT = 1.5  # s in which the wearer raises the arm to the pose of a case
LONGEST = 3.0  # s that are judged
WINDOW = 0.01  # s, over which a rate of torque is taken
MOVING = 0.2  # rad/s
DRIVES = 0.5  # Nm; gravity and the other joints move an arm that gets less
TAP = 1.0 / 6.0  # s, half a tap


class LyingMotor(SimulatedMotor):
    """A motor one of whose replies may report a wrong speed. lie: rad/s to report next, or None."""

    lie: float | None = None

    def receive(
        self, data: bytes, position: float, velocity: float, now: float, frame_id: int | None = None
    ) -> bytes | None:
        """Execute a frame; see `SimulatedMotor.receive`."""
        velocity, self.lie = velocity if self.lie is None else self.lie, None
        return super().receive(data, position, velocity, now, frame_id)


def leave_cuff(arm: VirtualArm) -> None:
    """Let the wearer's arm leave the cuffs."""
    arm.device.arm.config = replace(arm.device.arm.config, wearer_mass=(0.0,) * len(MASS))
    arm.device.arm.carry(0.0)


def lie(arm: VirtualArm) -> None:
    """Let the elbow's motor report 3 rad/s once."""
    arm.device.motors[-1].lie = 3.0  # type: ignore[attr-defined]


def nothing(arm: VirtualArm) -> None:
    """Let the wearer relax."""


def warm(arm: VirtualArm) -> None:
    """Let the motors warm to 79 degC within a second, by whole degrees."""
    for degree in range(71, 80):
        arm.clock.later(0.1 * (degree - 70), lambda degree=degree: heat(arm, degree))  # type: ignore[misc]


def heat(arm: VirtualArm, degree: int) -> None:
    """Set the temperature of every motor."""
    for motor in arm.device.motors:
        motor.temperature = degree


def leaning(error: float) -> TrunkSensor:
    """Return the sensor of a trunk's tilt that is wrong by `error` rad about the pitch axis."""

    def read(now: float, state: TrunkState) -> TrunkReading:
        return TrunkReading(gravity_in_trunk(state.pitch + error, state.roll).tolist())

    return read


@dataclass(frozen=True)
class Case:
    """What befalls an arm.

    pose: to which the wearer raises it, rad, before `event`. after: steps of the wearer's script from then on.
    truly: of the device. scale: real torque per commanded Nm. tilt_error: rad, of the IMU from the start on.
    is_innocent: nothing is wrong; the wearer must feel little.
    """

    name: str
    pose: Sequence[float]
    event: Callable[[VirtualArm], None] = nothing
    after: Sequence[dict[str, object]] = ({"hold": LONGEST},)
    max_effort: Sequence[float] = RATED
    extra: float = 0.0  #: kg in the hand, which the settings count to the wearer's arm
    mode: str = "zero_g"
    scale: float = 1.0
    tilt_error: float = 0.0
    is_innocent: bool = False

    @property
    def duration(self) -> float:
        """How many s after the event are judged."""
        return TrialScript.parse({"name": "after", "steps": list(self.after)}).duration


@dataclass
class Motion:
    """What an arm did after the event, n times: s; (n, 4) rad, rad/s; (n, 4) Nm of feed-forward, motor and wearer."""

    time: list[float] = field(default_factory=list)
    position: list[Sequence[float]] = field(default_factory=list)
    velocity: list[Sequence[float]] = field(default_factory=list)
    forward: list[Sequence[float]] = field(default_factory=list)
    torque: list[Sequence[float]] = field(default_factory=list)
    wearer: list[Sequence[float]] = field(default_factory=list)
    fault: str = ""

    @property
    def speed(self) -> float:
        """The fastest joint, rad/s."""
        return float(np.abs(self.velocity).max())

    @property
    def driven(self) -> float:
        """The fastest joint whose feed-forward drives it, by DRIVES at least, rad/s."""
        velocity, forward = np.array(self.velocity), np.array(self.forward)
        is_driven = (velocity * forward > 0.0) & (np.abs(forward) > DRIVES)
        return float(np.where(is_driven, np.abs(velocity), 0.0).max())

    @property
    def energy(self) -> float:
        """The most that one motor has given its joint at any time, J."""
        power = np.array(self.torque) * np.array(self.velocity)
        steps = np.diff(self.time)[:, None]
        return float(np.vstack((np.zeros((1, power.shape[1])), np.cumsum(power[:-1] * steps, axis=0))).max())

    @property
    def rate(self) -> float:
        """The fastest change of a motor's torque over WINDOW, Nm/s."""
        times, torque = np.array(self.time), np.array(self.torque)
        later = np.minimum(np.searchsorted(times, times + WINDOW), len(times) - 1)
        return float((np.abs(torque[later] - torque).max(axis=1) / np.maximum(WINDOW, times[later] - times)).max())


class CaseUnderRule(NamedTuple):
    """A case under a rule. rate: of the loop, Hz."""

    case: str
    rule: str
    rate: float


@dataclass(frozen=True)
class Felt:
    """What a wearer who moves one joint feels of a rule."""

    largest: float  #: Nm, the largest torque of theirs
    brake: float  #: Nm, mean brake of that joint while it moves
    work: float  #: J, what they do more than without a rule


def felt(motion: Motion, free: Motion) -> Felt:
    """Return what the rule of `motion` costs the wearer, against `free`, the same without a rule."""
    joint = int(np.argmax(np.ptp(np.array(free.position), axis=0)))

    def work(run: Motion) -> float:
        power = np.array(run.wearer)[:, joint] * np.array(run.velocity)[:, joint]
        return float((power[:-1] * np.diff(run.time)).sum())

    brake = np.abs(np.array(motion.forward) - np.array(motion.torque))[:, joint]
    moving = np.abs(np.array(motion.velocity)[:, joint]) > MOVING
    largest = float(np.abs(np.array(motion.wearer)[:, joint]).max())
    return Felt(largest, float(brake[moving].mean()), work(motion) - work(free))


def play(case: Case, make: Callable[[Limits, Sequence[float]], Barrier] | None, rate: float = 250.0) -> Motion:
    """Play a case with the barrier that `make` returns, None for the package's own; return what the arm did."""
    hand = MASS[3] + case.extra
    mass = (*MASS[:3], hand)
    cog = (*COG[:3], (MASS[3] * COG[3] + case.extra * ROBOT.length[3]) / hand)
    motors = [JointMotor(MOTORS[name], n + 1) for n, name in enumerate(USUAL_MOTORS)]
    true = [LyingMotor(replace(motor, torque_scale=case.scale)) for motor in motors]
    device = SimulatedDevice(SimulatedArm(ArmConfig(wearer_mass=MASS, wearer_cog=COG)), true)
    device.arm.carry(case.extra)
    limits = Limits(JOINTS, max_effort=case.max_effort, sign_check_torque=0.0)
    compensator = Compensator(
        Settings(
            "right", ROBOT, mode=case.mode, support=1.0, wearer_mass=mass, wearer_cog=cog, max_effort=case.max_effort
        )
    )
    motion = Motion()
    begin = math.inf

    def look() -> None:
        if arm.now >= begin:
            note(motion, arm)

    arm = VirtualArm(device, DirectController(compensator, limits), motors, limits, rate, look=look)
    if make:
        arm.safety.barrier = make(limits, [motor.peak_damping for motor in motors])
    arm.add_imu(leaning(case.tilt_error), compensator, 0.01)
    arm.enable()
    is_early = bool(case.tilt_error)
    begin = arm.now if is_early else math.inf
    if not arm.run_until(lambda: arm.safety.state is State.ACTIVE or arm.safety.fault) or arm.safety.fault:
        motion.fault = str(arm.safety.fault)
        return motion
    lift = {"move": list(case.pose), "over": LIFT}
    script = TrialScript.parse({"name": "case", "steps": [lift, *case.after]})
    if not is_early:
        device.start(VirtualWearer(script))
        arm.run(LIFT)
    begin = min(begin, arm.now)
    case.event(arm)
    arm.run(case.duration)
    motion.fault = str(arm.safety.fault.code) if arm.safety.fault else ""
    arm.bus.close()
    return motion


def note(motion: Motion, arm: VirtualArm) -> None:
    """Add the present state of the device to `motion`."""
    device = arm.device
    theta, velocity = device.arm.positions, device.arm.velocities
    motion.time.append(arm.now)
    motion.position.append(theta)
    motion.velocity.append(velocity)
    at = list(zip(device.motors, theta, velocity, strict=True))
    motion.forward.append([motor.torque(angle, 0.0) for motor, angle, _ in at])
    motion.torque.append([motor.torque(angle, speed) for motor, angle, speed in at])
    total = device.arm.data.qfrc_applied
    motion.wearer.append([float(given - torque) for given, torque in zip(total, motion.torque[-1], strict=True)])


def reach(name: str, start: Sequence[float], end: Sequence[float], speed: float) -> Case:
    """Return a wearer who reaches from `start` to `end` with `speed` rad/s at most, and back."""
    way = max(abs(a - b) for a, b in zip(start, end, strict=True))
    duration = 1.875 * way / speed / 0.75  # of a minimum-jerk path, three quarters of the step
    steps = ({"move": list(end), "over": duration}, {"move": list(start), "over": duration})
    return Case(f"{name} at {speed:g} rad/s, up and down", start, after=steps, max_effort=PEAK, is_innocent=True)


RAISED = (0.2, 0.35, -0.20, 0.9)  # rad, which the rated torques carry
OUT = (0.1, 0.5, 0.5, 0.6)  # rad, which the peak torques carry
TAPS = tuple({"move": [*OUT[:3], OUT[3] + lift], "over": TAP} for lift in (0.2, 0.0) * 4)
WRONG = (
    Case("out of the cuff, rated torques", RAISED, leave_cuff),
    Case("out of the cuff, peak torques", OUT, leave_cuff, max_effort=PEAK),
    Case("clamped above the horizontal", (0.0, 0.3, 1.9, 0.2)),
    Case("clamped, arm abducted", (0.0, 1.8, 0.2, 0.2)),
    Case("derated from 70 to 79 degC", RAISED, warm),
    Case("2 kg lost unseen", (0.1, 0.3, 0.2, 0.5), lambda arm: arm.device.arm.carry(0.0), max_effort=PEAK, extra=2.0),
    Case("motors twice as strong", OUT, max_effort=PEAK, scale=2.0),
    Case("IMU wrong by 30 degrees, from the start", OUT, max_effort=PEAK, tilt_error=math.radians(30.0)),
    Case("a wrong speed of 3 rad/s, once", RAISED, lie),
)
INNOCENT = (
    *(reach("flexion", (0.0, 0.2, 0.0, 0.4), (0.0, 0.2, 1.2, 0.4), speed) for speed in (1.0, 2.0, 3.0)),
    *(reach("elbow", (0.0, 0.2, 0.1, 0.3), (0.0, 0.2, 0.1, 1.5), speed) for speed in (1.0, 2.0, 3.0)),
    *(reach("abduction", (0.0, 0.2, 0.1, 0.3), (0.0, 1.3, 0.1, 0.3), speed) for speed in (1.0, 2.0, 3.0)),
    Case("walking", OUT, after=({"walk": 4.0},), max_effort=PEAK, is_innocent=True),
    Case("tapping, 3 a second", OUT, after=TAPS, max_effort=PEAK, is_innocent=True),
)
