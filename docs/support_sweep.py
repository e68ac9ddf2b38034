# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Draws docs/support_sweep.png: `support` increases from 0 to 1 under a wearer's passive arm on the simulated device.

A hand moves the arm to a pose and holds it there. Once a second `support` increases by 0.05, as with `ros2 param set`.
Then the hand lets go. `python docs/support_sweep.py` takes a few seconds and does not need ROS.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.report.html import HOLD_COLOUR, INK, JOINT_COLOURS, make_plain
from exo_gravity.lab.trial.analysis import Recording
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_arm import resting

POSE = [0.3, 0.45, 0.10, 0.4]  # rad; carrying the whole arm of the wearer takes less than rated torque here
HELD, RELEASED = 30.0, 10.0  # s, how long the hand holds the arm in the pose, and how long the arm is alone
SETTLING, PAUSE = 3, 2  # s in the pose: before the figure begins, and from there until the sweep
RATED = (3.0, 9.0, 3.0, 3.0)
JOINTS = ("shoulder rotation", "shoulder abduction", "shoulder flexion", "elbow flexion")


def sweep() -> tuple[Recording, np.ndarray]:
    """Return the recording of the sweep, and its support settings in rows of (time in s, support)."""
    robot = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
    load = Wearer(75.0).on_links(robot.length)
    mass, cog = load.mass.tolist(), load.cog.tolist()
    settings = Settings("right", robot, mode="zero_g", support=0.0, wearer_mass=mass, wearer_cog=cog)
    motors = [JointMotor(MOTORS[name], n) for n, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
    limits = Limits(JOINTS, (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14), (5.0, 5.0, 5.0, 6.0), RATED)
    # 3 % heavier than configured
    true_arm = SimulatedArm(ArmConfig(wearer_mass=[1.03 * m for m in mass], wearer_cog=cog))
    device = SimulatedDevice(true_arm, [SimulatedMotor(motor) for motor in motors])
    steps = [{"move": POSE, "over": 3.0}, {"move": POSE, "over": HELD}, {"hold": RELEASED}]
    script = TrialScript.parse({"name": "support sweep", "steps": steps})
    trial = OfflineTrial(ArmSetup("right", device, motors, limits, settings, 250.0, resting(0.0, 0.0)), script, 8.0)
    supports = [(0.0, 0.0)]
    in_pose = 0  # s

    def every_second(now: float) -> bool:
        nonlocal in_pose
        in_pose += trial.wearer.step == 1
        if in_pose > SETTLING + PAUSE and supports[-1][1] < 1.0:
            supports.append((now, round(supports[-1][1] + 0.05, 2)))
            trial.compensator.apply(replace(settings, support=supports[-1][1]))
        return False

    return trial.run(every_second), np.array(supports)


def draw(recording: Recording, supports: np.ndarray) -> Figure:
    """Return the figure."""
    start, let_go, end = recording.steps[1].start + SETTLING, recording.steps[2].start, recording.steps[2].end
    during = (recording.time >= start) & (recording.time <= end)
    time = recording.time[during] - start
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    set_to, torque, angle = figure.subplots(3, 1, sharex=True, height_ratios=(1.0, 2.2, 1.6))
    set_to.step(np.append(supports[:, 0] - start, end - start), np.append(supports[:, 1], 1.0), color=INK, where="post")
    set_to.set_ylabel("Support (0 to 1)")
    position = np.degrees(recording.position[during])
    for joint, (name, colour) in enumerate(zip(JOINTS, JOINT_COLOURS, strict=True)):
        torque.plot(time, recording.effort[during][:, joint], color=colour, lw=1.6, label=name)
        angle.plot(time, position[:, joint] - position[0, joint], color=colour, lw=1.2)
    torque.set_ylabel("Motor torque (Nm)")
    torque.legend(loc="upper left", frameon=False, fontsize=9)
    angle.set_ylabel("Displacement (deg)")
    angle.set_ylim(-0.5, 0.5)
    angle.set_xlabel("Time (s)")
    for axis in (set_to, torque, angle):
        axis.axvspan(let_go - start, end - start, color=HOLD_COLOUR, lw=0, zorder=0)
        make_plain(axis)
        axis.set_xlim(0.0, end - start)
    set_to.text(let_go - start + 0.2, 0.05, "arm released", fontsize=9)
    return figure


if __name__ == "__main__":
    draw(*sweep()).savefig(Path(__file__).with_name("support_sweep.png"), dpi=120)
