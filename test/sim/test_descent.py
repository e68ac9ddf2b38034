# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The way down, judged by the simulated arm's true motion: slow, to the ground in time, and no drop at the end."""

from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import Tilt, gravity_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.drive import Send, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.control_loop import NoController
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.truth import TruthRecords
from exo_gravity.sim.virtual_arm import VirtualArm

from ..support.simulated_device import joints_of
from ..support.thorough import quick

MOTORS_OF_ARM = joints_of((MIT,) * 4)
LIMITS = Limits(("rotation", "abduction", "flexion", "elbow"))
RATE = 125.0
TOP_SPEED = 1.0  # rad/s
HORIZONTAL = (0.0, 1.5, 0.0, 0.3)


class Lowered:
    """An arm that its motors hold at `theta` until it is let down. The speed is the arm's own.

    grounded: s until the joints that gravity moves stayed within 0.2 rad of where they ended.
    top_speed, speed_after_exit: rad/s, the latter over the 3 s after EXIT. switched_on_again: whether a motor was taken
    for one that is off.
    """

    def __init__(self, theta, friction, body_mass=0.0, pitch=0.0, roll=0.0, motors=MOTORS_OF_ARM):
        mass, cog = Wearer(body_mass).on_links((0.05, 0.13, 0.3, 0.3)) if body_mass else (NO_TORQUE, NO_TORQUE)
        config = ArmConfig(
            wearer_mass=mass, wearer_cog=cog, coulomb_friction=(friction,) * 4, viscous_friction=(0.0,) * 4
        )
        device = SimulatedDevice(SimulatedArm(config), [SimulatedMotor(motor) for motor in motors])
        device.pitch, device.roll, device.truth = pitch, roll, TruthRecords()
        device.advance(0.001)
        device.arm.reset(theta)
        holding = gravity_torque(config.links.with_wearer(mass, cog), theta, Tilt.of("right", pitch, roll).direction)
        for motor, effort in zip(motors, holding, strict=True):
            for data in (motor.command(effort, 0.0), ENTER):
                device.exchange(motor.can_id, data)
        drives = []
        arm = VirtualArm(device, NoController(), motors, LIMITS, RATE, note=drives.append)
        self.safety = arm.safety
        self.safety.take_over(holding.tolist(), NO_TORQUE, arm.now)
        assert arm.run_until(lambda: arm.loop.is_off) and not device.powered
        self.switched_on_again = any(Send.ENTER in drive.send for drive in drives)
        off = arm.now
        arm.run(3.0)
        arm.bus.stop()
        records = device.truth.records
        down = records["time"] < off
        speed, track = np.abs(records["velocity"]).max(axis=1), records["position"][:, 1:]  # joint 1 has no ground
        self.top_speed, self.speed_after_exit = speed[down].max(), speed[~down].max()
        far = np.flatnonzero(np.abs(track - track[down][-1]).max(axis=1) > 0.2)
        self.grounded = records["time"][far[-1]] if len(far) else 0.0
        self.end = records["position"][-1]


WAYS = {  # theta, friction, and what else is the case; the matrix has horizontal arms, too
    "horizontal": (HORIZONTAL, 0.01, {}),
    "horizontal, worn": (HORIZONTAL, 0.05, {"body_mass": 75.0}),
    "horizontal, much friction": (HORIZONTAL, 0.5, {}),
    "bent, on a tilted trunk": ((1.5, 1.5, -0.7, 2.5), 0.01, {"pitch": 0.4, "roll": -0.3}),
    "flexed": ((0.0, 0.1, 2.3, 0.1), 0.2, {}),
    "worn, where the motors hold it": ((0.0, 0.6, 0.9, 1.5), 0.05, {"body_mass": 75.0}),
    "upright overhead": ((0.0, 3.0, 0.0, 0.0), 0.0, {}),
}


HARD = ("bent, on a tilted trunk", "upright overhead")


@pytest.mark.parametrize("way", quick(HARD, WAYS))
def test_an_arm_comes_down_slowly_in_15_s_and_does_not_drop_when_its_motors_are_switched_off(way):
    theta, friction, more = WAYS[way]
    lowered = Lowered(theta, friction, **more)
    assert lowered.top_speed < TOP_SPEED
    assert lowered.speed_after_exit < TOP_SPEED / 4
    assert lowered.grounded < 15.0
    assert lowered.safety.state is State.DISABLED
    if way == "upright overhead":
        assert abs(lowered.end[1]) < 0.2


def test_motors_that_apply_less_damping_than_asked_for_are_not_taken_for_motors_that_are_off():
    weak = [replace(motor, torque_scale=0.6) for motor in MOTORS_OF_ARM]  # kd_max is then 3 Nm s/rad at the joint
    lowered = Lowered(HORIZONTAL, 0.2, motors=weak)
    assert lowered.safety.fault is None and not lowered.switched_on_again
    assert lowered.top_speed < TOP_SPEED
