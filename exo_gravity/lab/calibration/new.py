# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate new: writes the parameter file of an arm from its URDF, its motors and their CAN IDs.

What the URDF and the motors' records tell is filled in: limits, torques, where the arm hangs. What only the arm itself
can tell, signs, zeros and torque scales, is marked MEASURE. The file is read back as the nodes read it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.hardware.urdf_arm import UrdfArm, read_urdf
from exo_gravity.lab.inputs.arms import carried_arm
from exo_gravity.lab.inputs.parameter_file import load

LARGEST_ANGLE = 3.1  # rad, of a joint without limits
POSES = 2000  # at random, for gravity's largest torque
FALL, STEPS = 0.05, 4000  # rad per Nm and step, by which the arm is let fall; it hangs after so many
DAMIAO_TIMEOUT = 0.3  # s
MEASURE = "MEASURE"


@dataclass(frozen=True)
class NewArm:
    """What the user says of an arm. Raises ParameterError."""

    urdf: str  #: path of the URDF
    motors: Sequence[str]  #: (n,) types
    ids: Sequence[int]  #: (n,) CAN IDs
    joints: Sequence[str] = ()  #: (n,) in this order; () for all turning joints in the order of the URDF
    hand: str = ""  #: the link that holds a load, '' for none
    side: str = "right"
    channel: str = "can0"

    def __post_init__(self) -> None:
        for motor in self.motors:
            if motor not in MOTORS:
                raise ParameterError("motors", motor, f"one of {', '.join(MOTORS)}")


class JointRange(NamedTuple):
    """The limits of a joint in a URDF, rad."""

    low: float
    high: float


def turning_joints(text: str) -> dict[str, JointRange]:
    """Return the limits of each turning joint of a URDF that follows no other one, in its order."""
    found = {}
    for joint in ElementTree.fromstring(text).findall("joint"):
        limit = joint.find("limit")
        if joint.get("type") not in ("revolute", "continuous") or joint.find("mimic") is not None:
            continue
        edges = (math.nan, math.nan) if limit is None else (limit.get("lower"), limit.get("upper"))
        low, high = (float(edge) if edge else math.nan for edge in edges)
        if joint.get("type") == "continuous" or not low < high:
            low, high = -math.inf, math.inf
        found[joint.get("name", "")] = JointRange(max(low, -LARGEST_ANGLE), min(high, LARGEST_ANGLE))
    return found


def hanging(arm: UrdfArm, ranges: Sequence[JointRange]) -> np.ndarray:
    """Return the angles (n,) in rad in which the upright arm comes to rest within its limits when it falls from 0."""
    low, high = np.transpose(ranges)
    theta, upright = np.clip(np.zeros(len(low)), low, high), Tilt.of("left")
    for _ in range(STEPS):
        theta = np.clip(theta - FALL * np.array(arm.torque(theta.tolist(), upright)), low, high)
    return theta


def write_new(new: NewArm, output: Path) -> list[str]:
    """Write the parameter file; return what a person should know, a sentence each. Raises ParameterError."""
    text = read_urdf(new.urdf)
    known = turning_joints(text)
    names = list(new.joints or known)
    if not len(names) == len(new.motors) == len(new.ids):
        expected = f"one motor and one ID for each of the joints {', '.join(names)}"
        raise ParameterError("motors and ids", [*new.motors, *new.ids], expected)
    arm = UrdfArm(text, names, new.hand)
    ranges = [known[name] for name in names]
    low, high = np.transpose(ranges)
    poses = np.random.default_rng(0).uniform(low, high, (POSES, len(names)))
    upright = Tilt.of("left")
    needed = np.max(np.abs(arm.torques(poses, np.tile(upright.direction, (POSES, 1)))), axis=0)
    rated = [MOTORS[motor].rated_torque for motor in new.motors]
    efforts = [min(most, own or most) for most, own in zip(rated, arm.max_effort, strict=True)]
    home = hanging(arm, ranges)
    notes = list(arm.notes)
    for name, effort, most in zip(names, efforts, needed.tolist(), strict=True):
        if most > effort:
            notes.append(f"{name}: gravity takes up to {most:.1f} Nm of it, max_effort is {effort:g} Nm")
    output.write_text(_file(new, names, ranges, efforts, needed.tolist(), home.tolist()), encoding="utf-8")
    try:
        carried_arm(load(output), f"/{new.side}")
    except ParameterError:
        output.unlink()
        raise
    return notes


def _file(
    new: NewArm,
    names: Sequence[str],
    ranges: Sequence[JointRange],
    efforts: Sequence[float],
    needed: Sequence[float],
    home: Sequence[float],
) -> str:
    """Return the text of the parameter file."""
    count = len(names)
    timeouts = [0.0 if MOTORS[motor].family == "ak" else DAMIAO_TIMEOUT for motor in new.motors]
    listed = _row(names)
    return f"""# Written by `calibrate new` from {new.urdf}.
# {MEASURE} marks what only the arm itself can tell: docs/first_arming.md.

/{new.side}/can_bridge:
  ros__parameters:
    joint_names: {listed}
    autostart: false  # an operator arms it
    rate: 250.0
    can: {{interface: socketcan, channel: {new.channel}}}
    motor: {_row(new.motors)}
    can_id: {_row(new.ids)}
    direction: {_row([1] * count)}  # {MEASURE}: 1 or -1, so that a positive angle is that of the URDF
    zero: {_row([0.0] * count)}  # {MEASURE}: rad, the motor's angle where the joint's angle is 0
    torque_scale: {_row([1.0] * count)}  # {MEASURE}: real Nm per commanded Nm
    motor_timeout: {_row(timeouts)}  # s, as set in the motors
    position_min: {_row([edge.low for edge in ranges])}  # rad, the URDF's
    position_max: {_row([edge.high for edge in ranges])}
    max_effort: {_row(efforts)}  # Nm; gravity of the arm alone, upright: up to {_row([round(x, 1) for x in needed])}
    home: {_row([round(angle, 3) for angle in home])}  # rad, where the arm hangs by its URDF

/{new.side}/compensator:
  ros__parameters:
    law: urdf
    urdf: {{file: "{new.urdf}", hand: "{new.hand}"}}
    joint_names: {listed}
    use_imu: false  # true with an IMU on the trunk: docs/imu.md
    max_effort: {_row(efforts)}
    mode: one_g
"""


def _row(values: Sequence[object]) -> str:
    return f"[{', '.join(map(str, values))}]"
