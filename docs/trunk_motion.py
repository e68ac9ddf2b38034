# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Draws docs/trunk_motion.png and prints the tables of its motions: an arm on the back of a wearer who moves.

The simulated arm is brought to a pose and let go; then the trunk bows, leans, walks or sits down hard. Everything that
the software does takes part: CAN frames, safety machine, compensator, IMU and estimator. `python docs/trunk_motion.py`
takes ten to twenty minutes and does not need ROS.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from exo_gravity.core import ArmModel
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial, trunk_imu
from exo_gravity.sim import ArmConfig, ImuConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.script import TrialScript

LENGTH = (0.05, 0.13, 0.30, 0.30)
ASSUMED = ArmModel(LENGTH, (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))  # of config/exo.yaml
TRUE = ArmModel(LENGTH, (0.045, 0.115, 0.235, 0.13), (0.60, 0.46, 0.61, 0.198))  # of config/sim.yaml
AT_ENDS = ArmModel(LENGTH, LENGTH, ASSUMED.mass)  # the arm for which EQ1m-EQ4m hold when the trunk is upright
POSES = ([0.0, 0.4, 0.5, 1.0], [0.0, 0.3, 0.1, 0.3], [0.3, 0.8, 0.9, 1.2])  # rad
LOW, USUAL = (0.03,) * 4, (0.2, 0.4, 0.2, 0.2)  # Nm, Coulomb friction; the usual one is the simulator's default
MOUNTING = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
RATE = 250.0  # Hz
JOINTS = ("shoulder rotation", "shoulder abduction", "shoulder flexion", "elbow flexion")
REST = {"hold": 1.0}
MOTIONS: dict[str, tuple[dict[str, Any], float]] = {  # what the trunk does, and the limit of the arm in degrees
    "bow 30° in 3 s": ({"bow": math.radians(30), "over": 3.0}, 2.0),
    "bow 45° in 3 s": ({"bow": math.radians(45), "over": 3.0}, math.nan),
    "lean 30° in 3 s": ({"lean": math.radians(30), "over": 3.0}, math.nan),
    "walk 60 s": ({"walk": 60.0}, 3.0),
    "sit down hard": ({"sit": 2.0}, math.nan),
}
DRAWN = ("bow 30° in 3 s", "walk 60 s")


class Law(NamedTuple):
    """A row of the table: settings of the compensator, and whether the arm is the one that EQ1m-EQ4m assume."""

    name: str
    colour: str
    settings: dict[str, Any]
    at_ends: bool = False


LAWS = (
    Law("exact law, `inertial`", "#0072B2", {"inertial": True}),
    Law("exact law (default)", "#009E73", {}),
    Law("EQ1m-EQ4m", "#D55E00", {"law": "paper_mobile"}, True),
    Law("IMU ignored", "#CC79A7", {"use_imu": False}),
)


class Result(NamedTuple):
    """Samples since the motion began: time in s, and how far the farthest joint has moved in degrees.

    command: (n, 4) Nm. trouble: '' or the fault.
    """

    time: np.ndarray
    moved: np.ndarray
    command: np.ndarray
    trouble: str

    @property
    def text(self) -> str:
        """The largest motion in degrees; with a time, the motors then let the arm down."""
        largest = f"{self.moved.max():.2f}" if self.moved.max() < 9.95 else f"{self.moved.max():.0f}"
        return f"{largest}, lost after {self.time[-1]:.1f} s" if self.trouble else largest


def simulate(
    law: Law, step: dict[str, Any], pose: list[float], friction: tuple[float, ...], imu: ImuConfig | None = None
) -> Result:
    """Return how far the arm moves while the trunk does `step`."""
    true, assumed = (AT_ENDS, AT_ENDS) if law.at_ends else (TRUE, ASSUMED)
    motors = [JointMotor(MOTORS[name], n) for n, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
    rated = (3.0, 9.0, 3.0, 3.0)
    limits = Limits(JOINTS, (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14), (5.0, 5.0, 5.0, 6.0), rated)
    arm = SimulatedArm(ArmConfig(true, coulomb_friction=friction))
    device = SimulatedDevice(arm, [SimulatedMotor(motor) for motor in motors])
    trunk = trunk_imu(imu or ImuConfig(MOUNTING), MOUNTING, RATE)
    steps = [{"move": pose, "over": 3.0}, {"hold": 2.0}, step, REST]
    setup = ArmSetup("right", device, motors, limits, Settings("right", assumed, **law.settings), RATE, trunk)
    trial = OfflineTrial(setup, TrialScript.parse({"name": "trunk", "steps": steps}), 8.0)
    recording = trial.run()
    start, end = recording.steps[2].start, min(recording.steps[-1].end, (recording.carried or ((0.0, 0.0),))[-1][1])
    during = (recording.time >= start) & (recording.time <= end)
    position = np.degrees(recording.position[during])
    moved = np.abs(position - position[0]).max(axis=1)
    return Result(recording.time[during] - start, moved, recording.command[during], trial.trouble)


def worst(law: Law, motion: str, friction: tuple[float, ...]) -> Result:
    """Return the result of the pose in which the arm moves most; an arm that is lost moves more than any other."""
    results = [simulate(law, MOTIONS[motion][0], pose, friction) for pose in POSES]
    result = max(results, key=lambda result: (bool(result.trouble), result.moved.max()))
    print(f"{law.name}, {motion}, {friction[0]:g} Nm: {result.text}", file=sys.stderr, flush=True)
    return result


def table(results: dict[tuple[str, str], Result], motions: list[str]) -> str:
    """Return a Markdown table, a row for each law."""
    lines = [["largest motion of a joint in degrees", *motions], ["---"] * (1 + len(motions))]
    lines += [[law.name, *(results[law.name, motion].text for motion in motions)] for law in LAWS]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def draw(results: dict[tuple[str, str], Result]) -> Figure:
    """Return the figure: the worst pose of each law, during a bow and a walk."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    for axis, motion in zip(figure.subplots(1, 2, sharey=True), DRAWN, strict=True):
        for law in LAWS:
            result = results[law.name, motion]
            moved = np.maximum.accumulate(result.moved)
            axis.semilogy(
                result.time, np.maximum(moved, 0.01), color=law.colour, lw=1.6, label=law.name.replace("`", "")
            )
            if result.trouble:
                axis.plot(result.time[-1], moved[-1], "x", color=law.colour, ms=8, mew=2)
        axis.axhline(MOTIONS[motion][1], color="0.5", lw=0.8, ls="--")
        axis.set_title(motion, fontsize=10)
        axis.set_xlabel("time (s)")
        axis.set_ylim(0.01, 200.0)
        axis.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("largest motion of a joint so far (deg)")
    figure.axes[1].legend(loc="lower right", frameon=False, fontsize=9)
    return figure


def main() -> None:
    """Simulate everything, draw the figure, and print the tables."""
    here = Path(__file__).parent
    low = {(law.name, motion): worst(law, motion, LOW) for law in LAWS for motion in MOTIONS}
    usual = {(law.name, motion): worst(law, motion, USUAL) for law in LAWS for motion in DRAWN}
    draw(low).savefig(here / "trunk_motion.png", dpi=120)
    for content in (table(low, list(MOTIONS)), table(usual, list(DRAWN))):
        print(content)


if __name__ == "__main__":
    main()
