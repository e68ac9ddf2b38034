# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms in virtual time that something would throw, and wearers who reach: judged by the truth of the simulated device.

Joint speeds are MuJoCo's, torques those that the motors apply, masses those of the paper's arm and a wearer of 75 kg.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from exo_gravity.core import paper_static_torque
from exo_gravity.core.arm.arm import ArmModel, papers
from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.assist import Assist
from exo_gravity.core.compensation.terms.catalogue import Friction, Inertia, Spring
from exo_gravity.core.compensation.terms.terms import SUM, TermSettings
from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.motion_monitor import MOTION
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor, VirtualWearer
from exo_gravity.sim.events import ACTS, efforts
from exo_gravity.sim.rig import Rig
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_wearer import path_between

from ..support.compensator_run import ROBOT
from ..support.thorough import quick

MASS, COG = (tuple(map(float, load)) for load in Wearer(75.0).on_links(ROBOT.length))
RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)  # Nm
MOMENT = papers(ROBOT).first_moment  # kg m, of the robot
LIFT = 1.5  # s in which the wearer raises the arm to the pose of a case
WINDOW = 0.01  # s, over which a rate of torque is taken
DRIVES = 0.5  # Nm; gravity and the other joints move an arm that gets less
WORN = {"mode": "zero_g", "support": 1.0, "wearer_mass": MASS, "wearer_cog": COG}


class LyingMotor(SimulatedMotor):
    """A motor one of whose replies may report a wrong speed. lie: rad/s to report next, or None."""

    lie: float | None = None

    def receive(
        self, data: bytes, position: float, velocity: float, now: float, frame_id: int | None = None
    ) -> bytes | None:
        velocity, self.lie = velocity if self.lie is None else self.lie, None
        return super().receive(data, position, velocity, now, frame_id)


class ThrownArm(Rig):
    """A right arm that hangs, with a compensator, and what it does, n times from `begin` on.

    time: s. velocity: rad/s. forward, torque: Nm, feed-forward and whole of the motors; all (n, 4).
    """

    def __init__(self, is_worn: bool, rate: float, settings: dict[str, Any] | None = None, **limits: Any) -> None:
        most = limits.setdefault("max_effort", RATED)
        config = ArmConfig(wearer_mass=MASS, wearer_cog=COG) if is_worn else ArmConfig()
        motors = [JointMotor(MOTORS[name], n + 1) for n, name in enumerate(USUAL_MOTORS)]
        device = SimulatedDevice(SimulatedArm(config), [LyingMotor(motor) for motor in motors])
        device.arm.reset((0.0, 0.05, 0.05, 0.05))
        assumed = {"side": "right", "robot": ROBOT, "max_effort": most, **(WORN if is_worn else {}), **(settings or {})}
        self.begin = math.inf
        self.time: list[float] = []
        self.velocity: list[Sequence[float]] = []
        self.forward: list[Sequence[float]] = []
        self.torque: list[Sequence[float]] = []
        limits = Limits(JOINTS, sign_check_torque=0.0, **limits)
        super().__init__(device, Settings(**assumed), motors, limits, rate, look=self.note)

    def note(self) -> None:
        if self.now < self.begin:
            return
        theta, velocity = self.device.arm.positions, self.device.arm.velocities
        at = list(zip(self.motors, theta, velocity, strict=True))
        self.time.append(self.now)
        self.velocity.append(velocity)
        self.forward.append([motor.torque(angle, 0.0) for motor, angle, _ in at])
        self.torque.append([motor.torque(angle, speed) for motor, angle, speed in at])

    def play(self, *steps: dict[str, Any]) -> None:
        """Let the wearer do `steps` of a script."""
        self.act(*steps)
        self.run(self.device.wearer.script.duration)

    def brought(self, pose: Sequence[float], over: float = LIFT, settle: float = 0.0) -> ThrownArm:
        """Carry the arm, let the wearer bring it to `pose` (4,) rad, and judge it from then on."""
        self.carry()
        self.raise_to(pose, over, settle)
        self.begin = self.now
        return self

    def speed(self, until: float = math.inf) -> float:
        """The fastest joint, rad/s, in the first `until` s."""
        speeds = np.abs(self.velocity)[np.array(self.time) - self.begin <= until]
        return float(speeds.max(initial=0.0))


RAISED, OUT = (0.2, 0.35, -0.20, 0.9), (0.1, 0.5, 0.5, 0.6)  # rad, which the rated and the peak torques carry
THROWN = {  # pose, most torque, what happens then, rad/s at most
    "out of the cuff, rated torques": (RAISED, RATED, "out_of_cuff", 2.9),
    "out of the cuff, peak torques": (OUT, PEAK, "out_of_cuff", 2.9),
    "clamped, arm abducted": ((0.0, 1.8, 0.2, 0.2), RATED, "limp", 1.9),
}


@pytest.mark.parametrize("name", quick(["out of the cuff, peak torques"], THROWN))
def test_whatever_drives_an_arm_by_mistake_does_not_throw_it(name):
    pose, most, event, fastest = THROWN[name]
    arm = ThrownArm(True, 250.0, max_effort=most).brought(pose)
    ACTS[event](arm)
    arm.run(3.0)
    velocity, forward = np.array(arm.velocity), np.array(arm.forward)
    is_driven = (velocity * forward > 0.0) & (np.abs(forward) > DRIVES)
    assert arm.time and arm.fault == ""
    assert np.where(is_driven, np.abs(velocity), 0.0).max() < fastest


def test_an_arm_whose_imu_is_wrong_by_30_degrees_is_not_carried():
    arm = ThrownArm(True, 250.0, max_effort=PEAK)
    arm.imu_error = [math.radians(30.0), 0.0]
    with pytest.raises(RuntimeError, match="torque_while_hanging"):
        arm.carry()


@pytest.mark.thorough
def test_a_wrong_speed_moves_nothing_and_a_wearer_who_reaches_at_1_rad_s_feels_nothing():
    lie = ThrownArm(True, 250.0).brought(RAISED)
    lie.motors[-1].lie = 3.0
    lie.run(3.0)
    times, torque = np.array(lie.time), np.array(lie.torque)
    later = np.minimum(np.searchsorted(times, times + WINDOW), len(times) - 1)
    rates = np.abs(torque[later] - torque).max(axis=1) / np.maximum(WINDOW, times[later] - times)
    assert lie.speed() < 0.02 and rates.max() < 5.0
    low, high = [0.0, 0.2, 0.1, 0.3], [0.0, 0.2, 0.1, 1.5]
    over = 1.875 * 1.2 / 0.75  # s, of a minimum-jerk path that reaches 1 rad/s, three quarters of the step
    reach = ThrownArm(True, 250.0, max_effort=PEAK).brought(low)
    reach.play({"move": high, "over": over}, {"move": low, "over": over})
    np.testing.assert_allclose(reach.torque, reach.forward, atol=0.02)


@dataclass(frozen=True)
class Wrong:
    """A compensator that is wrong: by its settings from the start, or from when the bare arm is let go at `pose`.

    Times in s are from then on, or from when the motors were switched on.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    change: Callable[[Sequence[float], Sequence[float]], Sequence[float]] = lambda theta, effort: effort
    pose: Sequence[float] | None = None
    lean: float = 0.0  #: rad, of the trunk
    time: float = math.inf  #: s, in which the fault must come
    speed: float = math.inf  #: rad/s, of any joint at any time
    until: float = math.inf  #: rad/s, until the fault


WRONG = {
    "three times the mass": Wrong({"robot": ArmModel(ROBOT.length, ROBOT.cog, 3.0 * ROBOT.mass)}, time=2.2, speed=0.4),
    "the sign of joint 2": Wrong(
        change=lambda theta, effort: (effort[0], -effort[1], *effort[2:]),
        pose=(0.0, 0.9, 0.3, 0.3),
        time=0.2,
        speed=0.6,
    ),
    "the static law with the encoder's theta_1": Wrong(
        change=lambda theta, effort: tuple(paper_static_torque(ROBOT, theta).tolist()),
        pose=(0.6, 0.9, 0.3, 0.3),
        time=0.2,
        speed=0.6,
    ),
    "the wrong side": Wrong({"side": "left"}, lean=0.3, until=0.6),
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_a_wrong_compensator_is_let_down_before_a_free_arm_is_fast(wrong):
    arm = ThrownArm(False, 100.0, wrong.settings, largest_moment=MOMENT)
    if wrong.pose:
        arm.brought(wrong.pose, 2.0, 1.0)
    else:
        arm.between_cycles(arm.safety.enable)
        arm.run_until(lambda: arm.state is State.PROVING)  # the motors are on
    arm.begin, true = arm.now, arm.device.arm
    efforts(lambda answer: answer._replace(effort=wrong.change(true.positions, answer.effort)))(arm)
    arm.play({"hold": 0.1 if wrong.pose else 4.0}, {"lean": wrong.lean, "over": 1.0}, {"hold": 4.0})
    after = next(change.time for change in arm.changes if change.fault) - arm.begin
    assert arm.fault == "unexplained_torque"
    assert after < wrong.time and arm.speed() < wrong.speed and arm.speed(after) < wrong.until


FASTEST = 3.5  # rad/s, from which on the wearer brakes; 5 rad/s, of the elbow 6, trips over_speed
LOWEST, HIGHEST = (-1.2, 0.1, -0.5, 0.1), (1.2, 1.7, 1.9, 1.9)  # rad, where the wearer moves


class Fast(VirtualWearer):
    """A wearer who reaches, shakes, throws and rests, by chance and as fast as is permitted.

    They brake every joint that is faster than FASTEST, whatever drives it.
    """

    def __init__(self, script: TrialScript, seed: int) -> None:
        super().__init__(script, strength=40.0)
        self._random = random.Random(seed)
        self._end = self._began = self._last = 0.0
        self._path: Callable[[float], Any] | None = None

    def idle(self, elapsed: float, duration: float) -> bool:
        return False

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Sequence[float]:
        if not 0.0 <= elapsed <= self.script.duration:
            return NO_TORQUE
        super().torque(elapsed, theta, velocity)  # follows the script's steps
        if elapsed >= self._end:
            self._began, self._weight = elapsed, [0.0] * 4
            self._end = elapsed + self._begin(tuple(theta))
        period, self._last = elapsed - self._last, elapsed
        since = elapsed - self._began
        torque = self.lead(self._path(since), theta, velocity, period) if self._path else NO_TORQUE
        return [braked(*column) for column in zip((12.0, 30.0, 10.0, 10.0), torque, velocity, strict=True)]

    def _begin(self, theta: tuple[float, ...]) -> float:
        """Begin something, and return for how many s."""
        kind, chance = self._random.choice(("reach", "reach", "throw", "shake", "rest")), self._random.uniform
        to = tuple(map(chance, LOWEST, HIGHEST))
        turn = 2.0 * math.pi * chance(2.0, 3.0)
        size = [share * min(0.2, 0.7 * FASTEST / turn) for share in self._random.sample((0, 0, 1, 1), 4)]
        farthest = max(abs(b - a) for a, b in zip(theta, to, strict=True))
        over = max(0.2, 1.875 * farthest / FASTEST) * chance(1.0, 1.6)  # minimum jerk
        if kind == "shake":
            self._path = lambda since: [
                (angle + most * math.sin(turn * since), most * turn * math.cos(turn * since))
                for angle, most in zip(theta, size, strict=True)
            ]
            return chance(1.0, 2.0)
        self._path = None if kind == "rest" else lambda since: path_between(theta, to, since, over)
        return chance(0.3, 1.0) if kind == "rest" else over * (0.6 if kind == "throw" else 1.1)


def braked(brake: float, torque: float, velocity: float) -> float:
    """Return the wearer's `torque` in Nm on a joint, with their brake of `brake` Nm s/rad beyond FASTEST."""
    excess = max(0.0, abs(velocity) - FASTEST)
    driving = max(0.0, 1.0 - 2.0 * excess) if torque * velocity > 0.0 else 1.0
    return driving * torque - math.copysign(brake * excess, velocity)


@pytest.mark.parametrize("is_assisted", quick([True], [False, True]), ids=["zero_g", "terms_and_assistance"])
def test_a_fast_wearer_is_not_let_down(is_assisted):
    terms = TermSettings(
        friction=Friction(0.8, (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 0.02)),
        inertia=Inertia(0.6),
        spring=Spring((2.0, 4.0, 2.0, 1.0)),
        assist=Assist((2.0, 4.0, 2.0, 2.0)),
    )
    settings, addition = {"max_effort": RATED}, NO_TORQUE
    if is_assisted:
        settings |= {"terms": terms, "inertial": True}
        addition = tuple(map(sum, zip(SUM.effort, terms.assist.max_effort, strict=True)))
    moment = papers(Settings("right", ROBOT, **WORN).arm).first_moment
    arm = ThrownArm(True, 100.0, settings, largest_moment=moment, largest_addition=addition)
    arm.carry()
    arm.begin = arm.now

    def assist(answer):
        """Push the way that the arm moves; the push fades towards FASTEST."""
        pushed = [math.copysign(4.0 * max(0.0, 1.0 - abs(v) / FASTEST), v) for v in arm.device.arm.velocities]
        arm.compensator.terms.assist.receive(arm.now, JOINTS, pushed, arm.now)
        return answer

    arm.controller.change = assist if is_assisted else None
    arm.device.start(Fast(TrialScript.parse({"name": "fast", "steps": [{"hold": 4.0}]}), seed=3))
    largest = 0.0
    while arm.now < arm.begin + 4.0:
        arm.cycle()
        columns = zip(arm.safety.motion.impulse, arm.safety.motion.full, strict=True)
        largest = max(largest, *(impulse / (MOTION.patience * full) for impulse, full in columns if full))
    assert not arm.fault and 3.0 < arm.speed() < 5.0 and largest < 0.5
